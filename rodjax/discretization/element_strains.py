"""The strains of elements of frames, and their first and second derivatives, written out.

Seen from the middle of an element its ends turn by the rotation vectors v = s(x) r, where r is the vector part of a
quaternion and x = r . r. With u for the v of the other end, h times the strain at an end is, to the sign,

    T = 3 v + u - a v x u + b v x (v x u) = 3 s r + u - A r x u + B [r (r . u) - x u],    A = a s,  B = b s^2,

and that in the middle the difference of both v. Derivatives from vector algebra take a third of the program that JAX
makes of the strains. Arrays have the components first, then both ends, then the elements; matrices rows and columns
first.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.geometry.vectors import cross, diagonal, dot, skew
from rodjax.linalg.blocks import product


class ByOneSize(NamedTuple):
    """A function of x and its derivatives."""

    value: Float[Array, "2 n"]
    first: Float[Array, "2 n"]
    second: Float[Array, "2 n"]


@dataclasses.dataclass(frozen=True)
class ElementStrains:
    """At the ends of elements of length `h`, seen from their middles: the vector parts r."""

    parts: Float[Array, "3 2 n"]
    h: Float[Array, "n"]

    @functools.cached_property
    def squares(self) -> Float[Array, "2 n"]:
        """x."""
        return dot(self.parts, self.parts)

    @functools.cached_property
    def coefficients(self) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"], Float[Array, "2 n"]]:
        return coefficients(self.squares)

    @functools.cached_property
    def slopes(self) -> tuple[ByOneSize, ByOneSize, ByOneSize]:
        """s, A and B with their derivatives."""
        return slopes(self.squares)

    @functools.cached_property
    def vectors(self) -> Float[Array, "3 2 n"]:
        """v."""
        return _times(self.coefficients[0], self.parts)

    @functools.cached_property
    def others(self) -> Float[Array, "3 2 n"]:
        """u."""
        return self.vectors[:, ::-1]

    @functools.cached_property
    def by_parts(self) -> Float[Array, "3 3 2 n"]:
        """The derivatives of v by r."""
        s = self.slopes[0]
        return diagonal(s.value) + _outer(_times(2 * s.first, self.parts), self.parts)

    @property
    def values(self) -> Float[Array, "3 3 n"]:
        """Curvature along d1 and d2, and twist, at start, middle and end."""
        r, u, x = self.parts, self.others, self.squares
        _, a, b = self.coefficients
        ends = 3 * self.vectors + u - _times(a, cross(r, u)) + _times(b, _times(dot(r, u), r) - _times(x, u))
        middle = self.vectors[:, 1] - self.vectors[:, 0]
        return jnp.stack([-ends[:, 0], middle, ends[:, 1]], axis=1) / self.h[None, None]

    @property
    def jacobian(self) -> Float[Array, "3 3 3 2 n"]:
        """[i, k, j, e]: of component i of the strain at point k by component j of the part at end e."""
        r, u, x = self.parts, self.others, self.squares
        _, a, b = self.slopes
        w = dot(r, u)
        own = 3 * self.by_parts + skew(_times(a.value, u)) - 2 * _outer(_times(a.first, cross(r, u)), r)
        own += _times(b.value, diagonal(w) + _outer(r, u) - 2 * _outer(u, r))
        own += 2 * _outer(_times(b.first, _times(w, r) - _times(x, u)), r)
        by_other = diagonal(1 - b.value * x) - skew(_times(a.value, r)) + _outer(_times(b.value, r), r)
        by_other = product(by_other, self.by_parts[:, :, ::-1])
        ends = [
            [-own[:, :, 0], -by_other[:, :, 0]],
            [-self.by_parts[:, :, 0], self.by_parts[:, :, 1]],
            [by_other[:, :, 1], own[:, :, 1]],
        ]
        return jnp.stack([jnp.stack(end, axis=2) for end in ends], axis=1) / self.h[None, None, None, None]

    def curving(self, moments: Float[Array, "3 3 n"]) -> Float[Array, "2 3 2 3 n"]:
        """Second derivatives of the strains by the parts, times moments at their points: [e, i, f, j]."""
        m = jnp.stack([-moments[:, 0], moments[:, 2]], axis=1) / self.h[None, None]
        r, u, x = self.parts, self.others, self.squares
        s, a, b = self.slopes
        p, q, w = dot(m, r), dot(m, u), dot(r, u)
        across = cross(u, m)
        k = dot(r, across)
        rest = p * w - q * x
        along = _times(6 * s.first, m) - _times(2 * a.first, across)
        along += _times(2 * b.first, _times(w, m) + _times(p, u) - _times(2 * q, r))
        own = _both(along, r) + _both(_times(b.value, m), u)
        own += diagonal(6 * s.first * p - 2 * a.first * k - 2 * b.value * q + 2 * b.first * rest)
        own += _outer(_times(12 * s.second * p - 4 * a.second * k + 4 * b.second * rest, r), r)
        pressed = _times(p, r) - _times(x, m)
        mixed = skew(_times(a.value, m)) + _times(b.value, _outer(m, r) + diagonal(p) - 2 * _outer(r, m))
        mixed += _outer(r, _times(-2 * a.first, cross(m, r)) + _times(2 * b.first, pressed))
        # By the rotation vectors, as the other ends of those that have them and in the middle.
        by_other = m - _times(a.value, cross(m, r)) + _times(b.value, pressed)
        middle = moments[:, 1] / self.h[None]
        by_vectors = by_other[:, ::-1] + jnp.stack([-middle, middle], axis=1)
        g = dot(by_vectors, r)
        own += _times(2 * s.first, _both(by_vectors, r) + diagonal(g)) + _outer(_times(4 * s.second * g, r), r)
        mixed = product(mixed, self.by_parts[:, :, ::-1])
        between = mixed[:, :, 0] + jnp.swapaxes(mixed[:, :, 1], 0, 1)
        rows = [[own[:, :, 0], between], [jnp.swapaxes(between, 0, 1), own[:, :, 1]]]
        return jnp.stack([jnp.stack(row, axis=1) for row in rows])


# With sin(t/2)^2 = x, the series of t^2/(4 x) to the fourth order in x, continued so that it grows to infinity at 1:
# P = 1 + x/3 + ... = GROWTH/(1 - x) + a polynomial, and Q = (P - (1 - x))/x likewise.
GROWTH = 128 / 1575
RATIO = (1 - GROWTH, 1 / 3 - GROWTH, 8 / 45 - GROWTH, 4 / 35 - GROWTH)
REST = (4 / 3 - GROWTH, 8 / 45 - GROWTH, 4 / 35 - GROWTH)
# (1 - x) P has no pole.
SQUARE = (1.0, RATIO[1] - RATIO[0], RATIO[2] - RATIO[1], RATIO[3] - RATIO[2], -RATIO[3])


def coefficients(x: Float[Array, "2 n"]) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"], Float[Array, "2 n"]]:
    """s, A and B: of s^2/4 = P, a = (1 - cos t)/t^2 = 1/(2 P) and b = (t - sin t)/t^3, where sin(t)/t is
    sqrt((1 - x)/P).
    """
    pole = GROWTH / (1 - x)
    ratio = pole + _polynomial(RATIO, x)
    s = 2 * jnp.sqrt(ratio)
    return s, 2 / s, (pole + _polynomial(REST, x)) / (ratio + jnp.sqrt(_polynomial(SQUARE, x)))


def slopes(x: Float[Array, "2 n"]) -> tuple[ByOneSize, ByOneSize, ByOneSize]:
    """s, A and B with their derivatives."""
    by_gap = 1 / (1 - x)
    pole = GROWTH * by_gap
    first_pole = pole * by_gap
    poles = pole, first_pole, 2 * first_pole * by_gap
    p, q = (
        ByOneSize(*(k + of_pole for k, of_pole in zip(_derivatives(polynomial, x), poles, strict=True)))
        for polynomial in (RATIO, REST)
    )
    s = _root(p)
    w = _root(ByOneSize(*_derivatives(SQUARE, x)))
    s = ByOneSize(2 * s.value, 2 * s.first, 2 * s.second)
    first_order = 2 / s.value
    slope = -first_order * s.first / s.value
    a = ByOneSize(first_order, slope, -(first_order * s.second + 2 * slope * s.first) / s.value)
    d = ByOneSize(p.value + w.value, p.first + w.first, p.second + w.second)
    value = q.value / d.value
    first = (q.first - value * d.first) / d.value
    return s, a, ByOneSize(value, first, (q.second - 2 * first * d.first - value * d.second) / d.value)


def _polynomial(polynomial: Sequence[float], x: Array) -> Array:
    *others, last = polynomial
    value = jnp.full_like(x, last)
    for c in reversed(others):
        value = c + x * value
    return value


def _derivatives(polynomial: Sequence[float], x: Array) -> tuple[Array, Array, Array]:
    """Of a polynomial: value, first and second."""
    first = [k * c for k, c in enumerate(polynomial)][1:]
    second = [k * c for k, c in enumerate(first)][1:]
    return _polynomial(polynomial, x), _polynomial(first, x), _polynomial(second, x)


def _root(of: ByOneSize) -> ByOneSize:
    value = jnp.sqrt(of.value)
    first = of.first / (2 * value)
    return ByOneSize(value, first, (of.second / 2 - first**2) / value)


def _times(x: Float[Array, "*k"], array: Float[Array, "..."]) -> Float[Array, "..."]:
    return x.reshape(*[1] * (array.ndim - x.ndim), *x.shape) * array


def _outer(a: Float[Array, "3 *k"], b: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    return a[:, None] * b[None]


def _both(a: Float[Array, "3 *k"], b: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    return _outer(a, b) + _outer(b, a)
