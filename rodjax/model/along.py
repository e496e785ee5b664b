"""Quantities that vary along a rod: constant piece by piece, or smooth."""

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import Numbers, is_known, leaf, number_list


class Along(eqx.Module):
    """A number at every arclength: `Steps` or `Smooth`. Arclengths and values are differentiable."""

    values: eqx.AbstractVar[Float[Array, "k"]]

    @abstractmethod
    def scaled(self, length: Float[Array, ""], value: Float[Array, ""]) -> "Along":
        """In other units: arclengths divided by `length`, values by `value`."""

    @abstractmethod
    def at(self, s: Float[Array, "*k"], a: Float[Array, "*k"], b: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """The values at arclengths that each lie from a to b; of `Steps` the mean there, as these jump at a and b."""

    @abstractmethod
    def integral(self, s: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """From 0 to these arclengths."""

    @property
    @abstractmethod
    def samples(self) -> Float[Numbers, "m"]:
        """Values close enough to one another to tell the least and the largest."""

    def mean(self, a: Float[Array, "*k"], b: Float[Array, "*k"]) -> Float[Array, "*k"]:
        return (self.integral(b) - self.integral(a)) / (b - a)


class Steps(Along):
    """Constant between jumps. Meshes of elements have a node at each jump, of so many segments that the elements
    between two of them are not shorter than 0.05 L/segments: a solve chooses these, and refuses fewer.

    `jumps`: (k,) [m], increasing, inside the rod; `values`: (k + 1,), before, between and beyond them.
    """

    jumps: Float[Array, "k"]
    values: Float[Array, "k+1"]

    def __init__(self, jumps: Any, values: Any):
        self.jumps = leaf(number_list(jumps, "jumps"))
        self.values = leaf(number_list(values, "values"))
        if len(self.values) != len(self.jumps) + 1:
            raise ValueError(
                f"values must be one more than jumps, got {len(self.values)} values and {len(self.jumps)} jumps"
            )
        _check_increasing(self.jumps, "jumps")

    @property
    def samples(self) -> Float[Array, "k+1"]:
        return self.values

    def scaled(self, length: Float[Array, ""], value: Float[Array, ""]) -> "Steps":
        return Steps(self.jumps / length, self.values / value)

    def at(self, s: Float[Array, "*k"], a: Float[Array, "*k"], b: Float[Array, "*k"]) -> Float[Array, "*k"]:
        return self.mean(a, b)

    def integral(self, s: Float[Array, "*k"]) -> Float[Array, "*k"]:
        found = self.values[0] * s
        for jump, before, after in zip(self.jumps, self.values[:-1], self.values[1:], strict=True):
            found += (after - before) * jnp.maximum(s - jump, 0.0)
        return found


class Smooth(Along):
    """A cubic spline through values, with two continuous derivatives.

    `s`: (k,) [m], k >= 2, increasing, from 0 to the length of the rod; `values`: (k,).
    """

    s: Float[Array, "k"]
    values: Float[Array, "k"]

    def __init__(self, s: Any, values: Any):
        self.s = leaf(number_list(s, "s"))
        self.values = leaf(number_list(values, "values"))
        if len(self.s) < 2 or len(self.values) != len(self.s):
            raise ValueError(
                f"values must be as many as s, at least 2, got {len(self.values)} values at {len(self.s)} arclengths"
            )
        _check_increasing(self.s, "s")

    @property
    def samples(self) -> Float[Numbers, "m"]:
        # Between its values a spline may overshoot.
        if is_known(self):
            from scipy.interpolate import CubicSpline  # the same spline; JAX would compile a program for each operation

            s, values = np.asarray(self.s), np.asarray(self.values)
            return np.concatenate([values, CubicSpline(s, values)(np.linspace(s[0], s[-1], 8 * len(s)))])
        fine = jnp.linspace(self.s[0], self.s[-1], 8 * len(self.s))
        return jnp.concatenate([self.values, self.at(fine, fine, fine)])

    def scaled(self, length: Float[Array, ""], value: Float[Array, ""]) -> "Smooth":
        return Smooth(self.s / length, self.values / value)

    def at(self, s: Float[Array, "*k"], a: Float[Array, "*k"], b: Float[Array, "*k"]) -> Float[Array, "*k"]:
        return Spline.through(self.s, self.values[:, None]).at(s)[0]

    def integral(self, s: Float[Array, "*k"]) -> Float[Array, "*k"]:
        return Spline.through(self.s, self.values[:, None]).integral(s)[0]


class Spline(eqx.Module):
    """Cubic splines of c numbers on the same knots, their third derivatives continuous at the knots next to the ends.

    `bends`: the second derivatives at the knots.
    """

    knots: Float[Array, "k"]
    values: Float[Array, "k c"]
    bends: Float[Array, "k c"]

    @staticmethod
    def through(knots: Float[Array, "k"], values: Float[Array, "k c"]) -> "Spline":
        k = len(knots)
        h = jnp.diff(knots)
        if k == 2:
            return Spline(knots, values, jnp.zeros_like(values))
        slopes = jnp.diff(values, axis=0) / h[:, None]
        inner = jnp.arange(1, k - 1)
        matrix = jnp.zeros((k, k), h.dtype)
        matrix = matrix.at[inner, inner - 1].set(h[:-1] / 6).at[inner, inner + 1].set(h[1:] / 6)
        matrix = matrix.at[inner, inner].set((h[:-1] + h[1:]) / 3)
        # A parabola through three points has one second derivative; more points make a cubic of the first two pieces.
        if k == 3:
            ends = jnp.array([1.0, -1.0, 0.0]), jnp.array([0.0, -1.0, 1.0])
        else:
            zero = jnp.zeros(k, h.dtype)
            ends = (
                zero.at[:3].set(jnp.stack([h[1], -h[0] - h[1], h[0]])),
                zero.at[-3:].set(jnp.stack([h[-1], -h[-2] - h[-1], h[-2]])),
            )
        scale = 1 / (h[0] + h[-1])
        matrix = matrix.at[0].set(scale * ends[0].astype(h.dtype)).at[-1].set(scale * ends[1].astype(h.dtype))
        right = jnp.zeros_like(values).at[1:-1].set(jnp.diff(slopes, axis=0))
        return Spline(knots, values, jnp.linalg.solve(matrix, right))

    def _cells(self, s: Float[Array, "*k"]) -> tuple[Array, Array, Array, Array, Array, Array]:
        cell = jnp.clip(jnp.searchsorted(self.knots, s, side="right") - 1, 0, len(self.knots) - 2)
        h = (self.knots[cell + 1] - self.knots[cell])[None]
        x = (s - self.knots[cell])[None] / h
        return cell, h, x, self.values.T[:, cell], self.values.T[:, cell + 1], self.bends.T[:, cell]

    def at(self, s: Float[Array, "*k"]) -> Float[Array, "c *k"]:
        cell, h, x, before, after, bend = self._cells(s)
        y, next_bend = 1 - x, self.bends.T[:, cell + 1]
        return y * before + x * after + h**2 / 6 * ((y**3 - y) * bend + (x**3 - x) * next_bend)

    def integral(self, s: Float[Array, "*k"]) -> Float[Array, "c *k"]:
        """From the first knot."""
        h = jnp.diff(self.knots)[:, None]
        whole = h * (self.values[:-1] + self.values[1:]) / 2 - h**3 / 24 * (self.bends[:-1] + self.bends[1:])
        sums = jnp.concatenate([jnp.zeros_like(whole[:1]), jnp.cumsum(whole, axis=0)])
        cell, h, x, before, after, bend = self._cells(s)
        y, next_bend = 1 - x, self.bends.T[:, cell + 1]
        values = (1 - y**2) / 2 * before + x**2 / 2 * after
        bends = ((1 - y**4) / 4 - (1 - y**2) / 2) * bend + (x**4 / 4 - x**2 / 2) * next_bend
        return sums.T[:, cell] + h * values + h**3 / 6 * bends


if TYPE_CHECKING:
    # What works on plain rods alone takes them for arrays, which a checker of types cannot know.
    Value = Any
    Pair = Any
else:
    Value = Float[Array, ""] | Along
    Pair = tuple[Value, Value]


def value_at(value: Value, s: Float[Array, "*k"], a: Float[Array, "*k"], b: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """A number or `Along` at arclengths that each lie from a to b."""
    return value.at(s, a, b) if isinstance(value, Along) else jnp.broadcast_to(value, s.shape)


def largest_beside(value: Value, s: Float[Array, "k"]) -> Float[Array, "k"]:
    """A number or `Along` at arclengths one after another; of `Steps` the larger mean on both sides of each."""
    if not isinstance(value, Steps):
        return value_at(value, s, s, s)
    means = value.mean(s[:-1], s[1:])
    before, beyond = jnp.append(means[:1], means), jnp.append(means, means[-1:])
    return jnp.where(before > beyond, before, beyond)


def stiffness_at(
    value: Value, s: Float[Array, "*k"], a: Float[Array, "*k"], b: Float[Array, "*k"]
) -> Float[Array, "*k"]:
    """The same of a stiffness: of `Steps` by the mean of the compliance, as of springs in a row."""
    if isinstance(value, Steps):
        return 1 / Steps(value.jumps, 1 / value.values).mean(a, b)
    return value_at(value, s, a, b)


def scaled(value: Value, length: Float[Array, ""], unit: Float[Array, ""]) -> Value:
    return value.scaled(length, unit) if isinstance(value, Along) else value / unit


def _check_increasing(s: Float[Array, "k"], name: str) -> None:
    if is_known(s) and not np.all(np.diff(np.asarray(s)) > 0):
        raise ValueError(f"{name} must increase, got {np.asarray(s).tolist()}")
