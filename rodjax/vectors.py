"""Vectors along a rod, components first: (3, *k) for a row of them."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.linalg import short_sum


def components(basis: Float[Array, "3 b *k"], vectors: Float[Array, "3 *k"]) -> Float[Array, "b *k"]:
    return short_sum(basis * vectors[:, None], axis=0)


def dot(a: Float[Array, "c *k"], b: Float[Array, "c *k"]) -> Float[Array, "*k"]:
    return short_sum(a * b, axis=0)


def cross(a: Float[Array, "3 *k"], b: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def root(x: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """Square root, with the derivative 0 at 0."""
    is_zero = x == 0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, x)))


def diagonal(x: Float[Array, "*k"]) -> Float[Array, "3 3 *k"]:
    """The identity times each number."""
    return jnp.eye(3, dtype=x.dtype).reshape(3, 3, *[1] * x.ndim) * x[None, None]


def skew(x: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    """The matrices of the cross product with x from the left."""
    nothing = jnp.zeros_like(x[0])
    rows = [[nothing, -x[2], x[1]], [x[2], nothing, -x[0]], [-x[1], x[0], nothing]]
    return jnp.stack([jnp.stack(row) for row in rows])
