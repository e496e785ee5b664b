"""Vectors along a rod, components first: (3, *k) for a row of them."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.linalg.blocks import short_sum


def components(basis: Float[Array, "3 b *k"], vectors: Float[Array, "3 *k"]) -> Float[Array, "b *k"]:
    return short_sum(basis * vectors[:, None], axis=0)


def dot(a: Float[Array, "c *k"], b: Float[Array, "c *k"]) -> Float[Array, "*k"]:
    return short_sum(a * b, axis=0)


def cross(a: Float[Array, "3 *k"], b: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    (a1, a2, a3), (b1, b2, b3) = jnp.unstack(a), jnp.unstack(b)
    return jnp.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1])


def triple_product(a: Float[Array, "3 *k"], b: Float[Array, "3 *k"], c: Float[Array, "3 *k"]) -> Float[Array, "*k"]:
    """a . (b x c)"""
    (a1, a2, a3), (b1, b2, b3), (c1, c2, c3) = map(jnp.unstack, (a, b, c))
    return a1 * (b2 * c3 - b3 * c2) + a2 * (b3 * c1 - b1 * c3) + a3 * (b1 * c2 - b2 * c1)


def root(x: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """Square root, with the derivative 0 at 0."""
    is_zero = x == 0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, x)))


def diagonal(x: Float[Array, "*k"]) -> Float[Array, "3 3 *k"]:
    """The identity times each number."""
    return jnp.eye(3, dtype=x.dtype).reshape(3, 3, *[1] * x.ndim) * x[None, None]


def skew(x: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    """The matrices of the cross product with x from the left."""
    x1, x2, x3 = jnp.unstack(x)
    y1, y2, y3 = jnp.unstack(-x)
    nothing = jnp.zeros_like(x1)
    rows = [[nothing, y3, x2], [x3, nothing, y1], [y2, x1, nothing]]
    return jnp.stack([jnp.stack(row) for row in rows])
