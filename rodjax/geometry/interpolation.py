"""Curves through given points."""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float


def resampled(points: Float[Array, "m 3"], segments: int) -> Float[Array, "n+1 3"]:
    """Points at equal steps of the curve through equally spaced `points`, as of `through`."""
    if len(points) - 1 == segments:
        return points
    return through(points, jnp.linspace(0.0, 1.0, segments + 1, dtype=points.dtype))


def through(points: Float[Array, "m 3"], u: Float[Array, "k"]) -> Float[Array, "k 3"]:
    """The curve through equally spaced `points` at parts u of it: cubic, by central differences."""
    ends = (2 * points[:1] - points[1:2], 2 * points[-1:] - points[-2:-1])
    extended = jnp.concatenate([ends[0], points, ends[1]])
    slopes = (extended[2:] - extended[:-2]) / 2
    knots = jnp.arange(len(points), dtype=points.dtype)
    return cubic(knots, points, slopes, knots[-1] * u)


def cubic(
    knots: Float[Array, "m"], points: Float[Array, "m 3"], slopes: Float[Array, "m 3"], x: Float[Array, "k"]
) -> Float[Array, "k 3"]:
    """Cubic Hermite interpolation: `points` and `slopes` are value and derivative at the increasing `places`."""
    cell = jnp.clip(jnp.searchsorted(knots, x, side="right") - 1, 0, len(points) - 2)
    width = knots[cell + 1] - knots[cell]
    t, h = ((x - knots[cell]) / width)[:, None], width[:, None]
    weights = ((1 + 2 * t) * (1 - t) ** 2, h * t * (1 - t) ** 2, t**2 * (3 - 2 * t), h * t**2 * (t - 1))
    values = (points[cell], slopes[cell], points[cell + 1], slopes[cell + 1])
    return functools.reduce(jnp.add, (weight * value for weight, value in zip(weights, values, strict=True)))
