"""The strains of elements of frames, and their first and second derivatives, written out.

Seen from the middle of an element its ends turn by the rotation vectors v = s(x) r, where r is the vector part of a
quaternion and x = r . r. With u for the v of the other end, h times the strain at an end is, to the sign,

    T = 3 v + u - a v x u + b v x (v x u) = 3 s r + u - A r x u + B [r (r . u) - x u],    A = a s,  B = b s^2,

and that in the middle the difference of both v. The derivatives of s, A and B by x are from JAX, all others from vector
algebra: so they take a third of the program that JAX makes of the strains. Arrays have the components first, then both
ends, then the elements; matrices rows and columns first.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.linalg import short_sum
from rodjax.vectors import cross, diagonal, dot, skew


class ByOneSize(NamedTuple):
    """A function of x and its derivatives."""

    value: Float[Array, "2 n"]
    first: Float[Array, "2 n"]
    second: Float[Array, "2 n"]


class ElementStrains(NamedTuple):
    """At the ends of elements of length `h`, seen from their middles: vector parts, rotation vectors, those of the
    other ends, their derivatives by the vector parts, and the functions s, A, B.
    """

    h: Float[Array, "n"]
    parts: Float[Array, "3 2 n"]
    vectors: Float[Array, "3 2 n"]
    others: Float[Array, "3 2 n"]
    by_parts: Float[Array, "3 3 2 n"]
    sizes: ByOneSize
    first_order: ByOneSize
    second_order: ByOneSize

    @staticmethod
    def of(parts: Float[Array, "3 2 n"], h: Float[Array, "n"]) -> "ElementStrains":
        x = dot(parts, parts)
        one = jnp.ones_like(x)
        value, (first, second) = (
            coefficients(x),
            jax.jvp(lambda x: jax.jvp(coefficients, (x,), (one,))[1], (x,), (one,)),
        )
        s, a, b = (ByOneSize(value[k], first[k], second[k]) for k in range(3))
        vectors = _times(s.value, parts)
        by_parts = diagonal(s.value) + _times(2 * s.first, _outer(parts, parts))
        return ElementStrains(h, parts, vectors, vectors[:, ::-1], by_parts, s, a, b)

    @property
    def values(self) -> Float[Array, "3 3 n"]:
        """Curvature along d1 and d2, and twist, at start, middle and end."""
        r, u, x = self.parts, self.others, dot(self.parts, self.parts)
        a, b = self.first_order.value, self.second_order.value
        ends = 3 * self.vectors + u - _times(a, cross(r, u)) + _times(b, _times(dot(r, u), r) - _times(x, u))
        middle = self.vectors[:, 1] - self.vectors[:, 0]
        return jnp.stack([-ends[:, 0], middle, ends[:, 1]], axis=1) / self.h[None, None]

    @property
    def jacobian(self) -> Float[Array, "3 3 3 2 n"]:
        """[i, k, j, e]: of component i of the strain at point k by component j of the part at end e."""
        r, u, x = self.parts, self.others, dot(self.parts, self.parts)
        a, b = self.first_order, self.second_order
        w = dot(r, u)
        own = 3 * self.by_parts + skew(_times(a.value, u)) - 2 * _outer(_times(a.first, cross(r, u)), r)
        own += _times(b.value, diagonal(w) + _outer(r, u) - 2 * _outer(u, r))
        own += 2 * _outer(_times(b.first, _times(w, r) - _times(x, u)), r)
        by_other = diagonal(1 - b.value * x) - skew(_times(a.value, r)) + _outer(_times(b.value, r), r)
        by_other = _product(by_other, self.by_parts[:, :, ::-1])
        ends = [
            [-own[:, :, 0], -by_other[:, :, 0]],
            [-self.by_parts[:, :, 0], self.by_parts[:, :, 1]],
            [by_other[:, :, 1], own[:, :, 1]],
        ]
        return jnp.stack([jnp.stack(end, axis=2) for end in ends], axis=1) / self.h[None, None, None, None]

    def curving(self, moments: Float[Array, "3 3 n"]) -> Float[Array, "2 3 2 3 n"]:
        """Second derivatives of the strains by the parts, times moments at their points: [e, i, f, j]."""
        m = jnp.stack([-moments[:, 0], moments[:, 2]], axis=1) / self.h[None, None]
        r, u, x = self.parts, self.others, dot(self.parts, self.parts)
        s, a, b = self.sizes, self.first_order, self.second_order
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
        mixed = _product(mixed, self.by_parts[:, :, ::-1])
        between = mixed[:, :, 0] + jnp.swapaxes(mixed[:, :, 1], 0, 1)
        rows = [[own[:, :, 0], between], [jnp.swapaxes(between, 0, 1), own[:, :, 1]]]
        return jnp.stack([jnp.stack(row, axis=1) for row in rows])


def coefficients(x: Float[Array, "2 n"]) -> Float[Array, "3 2 n"]:
    """s, A and B.

    s^2/4 is t^2/(4 x), with sin(t/2)^2 = x, to fourth order in x, and growing to infinity at 1.
    """
    above = 1 / 3 + x * (8 / 45) + x**2 * (4 / 35) + x**3 * (128 / 1575) / (1 - x)
    ratio, rest = 1 + x * above, 1 + above  # the second: by how much the first is above 1 - x, by x
    s = 2 * jnp.sqrt(ratio)
    by_sine = jnp.sqrt((1 - x) / ratio)  # sin(t)/t
    second = rest / (4 * ratio**2 * (1 + by_sine))  # (t - sin t)/t^3
    first = 1 / (2 * ratio)  # (1 - cos t)/t^2
    return jnp.stack([s, first * s, second * s**2])


def _times(x: Float[Array, "*k"], array: Float[Array, "..."]) -> Float[Array, "..."]:
    return x.reshape(*[1] * (array.ndim - x.ndim), *x.shape) * array


def _outer(a: Float[Array, "3 *k"], b: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    return a[:, None] * b[None]


def _both(a: Float[Array, "3 *k"], b: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    return _outer(a, b) + _outer(b, a)


def _product(a: Float[Array, "i k *m"], b: Float[Array, "k j *m"]) -> Float[Array, "i j *m"]:
    return short_sum(a[:, :, None] * b[None], axis=1)
