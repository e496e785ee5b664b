"""Small blocks along a rod, (b, b, n), b = 1 to 3: sums written out, products, inverses, the signs of eigenvalues."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def short_sum(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """Sum over an axis of few entries, written out: XLA makes a sum over an axis a loop at each place along the rod."""
    return functools.reduce(jnp.add, jnp.unstack(x, axis=axis)) if x.shape[axis] else jnp.sum(x, axis=axis)


def partial_sums(x: Float[Array, "*c n"]) -> Float[Array, "*c n+1"]:
    """Sums of the first 0, 1, ..., n numbers along the last axis, in rows of about sqrt(n).

    Two small matrix products: `jnp.cumsum` is five loops.
    """
    n = x.shape[-1]
    m = math.isqrt(n) + 1
    rows = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, m * m - n)]).reshape(*x.shape[:-1], m, m)
    before = np.triu(np.ones((m, m + 1), x.dtype), 1)
    within = jnp.matmul(rows, before, precision=jax.lax.Precision.HIGHEST)
    of_rows = jnp.matmul(within[..., m], before[:, :m], precision=jax.lax.Precision.HIGHEST)
    return (within[..., :m] + of_rows[..., None]).reshape(*x.shape[:-1], m * m)[..., : n + 1]


def product(a: Float[Array, "i k *m"], b: Float[Array, "k j *m"]) -> Float[Array, "i j *m"]:
    """a b block by block."""
    return short_sum(a[:, :, None] * b[None], axis=1)


def transpose_product(a: Float[Array, "k i *m"], b: Float[Array, "k j *m"]) -> Float[Array, "i j *m"]:
    """a^T b block by block."""
    return short_sum(a[:, :, None] * b[:, None], axis=0)


def inverse_of_blocks(
    blocks: Float[Array, "b b m"], least: Float[Array, ""] | None = None
) -> tuple[Float[Array, "b b m"], Int[Array, ""]]:
    """Inverses of symmetric blocks, and how many negative eigenvalues these have together.

    Blocks with an eigenvalue within about `least` of zero are made stiffer by twice that before. So soft is a part of
    the rod by itself, between neighbours that are held, only by chance or by symmetry, as half of a ring is.
    Elimination would lose the square of its softness in digits; so it gives the solution and the inertia of a matrix
    that differs by this much in a few places.
    """
    if len(blocks) == 1:
        a = blocks[0, 0]
        if least is not None:
            a += jnp.where(jnp.abs(a) <= least, 2 * least, 0.0)
        return (1 / a)[None, None], jnp.sum(a < 0)
    if len(blocks) == 3:
        return _inverse_of_three(blocks, least)
    a, b, d = blocks[0, 0], blocks[1, 0], blocks[1, 1]
    if least is not None:
        is_soft = jnp.abs(a * d - b * b) <= least * (jnp.abs(a) + jnp.abs(d))
        added = jnp.where(is_soft, 2 * least, 0.0)
        a, d = a + added, d + added
    determinant = a * d - b * b
    off = -b / determinant
    inverse = jnp.stack([jnp.stack([d / determinant, off]), jnp.stack([off, a / determinant])])
    return inverse, jnp.sum(jnp.where(determinant < 0, 1, jnp.where(a < 0, 2, 0)))


def _inverse_of_three(
    blocks: Float[Array, "3 3 m"], least: Float[Array, ""] | None
) -> tuple[Float[Array, "3 3 m"], Int[Array, ""]]:
    (a, *_), (b, d, _), (c, e, f) = map(jnp.unstack, jnp.unstack(blocks))
    if least is not None:
        minors = d * f - e * e, a * f - c * c, a * d - b * b
        determinant = a * minors[0] + b * (c * e - b * f) + c * (b * e - c * d)
        is_soft = jnp.abs(determinant) <= least * sum(jnp.abs(minor) for minor in minors)
        added = jnp.where(is_soft, 2 * least, 0.0)
        a, d, f = a + added, d + added, f + added
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    minor = a * d - b * b
    determinant = a * first + b * second + c * third
    inverse = [[first, second, third], [second, a * f - c * c, b * c - a * e], [third, b * c - a * e, minor]]
    # By Sylvester's criterion all eigenvalues are positive, or all of them negative; else the determinant tells.
    is_positive = (a > 0) & (minor > 0) & (determinant > 0)
    is_negative = (a < 0) & (minor > 0) & (determinant < 0)
    count = jnp.where(is_positive, 0, jnp.where(is_negative, 3, jnp.where(determinant < 0, 1, 2)))
    return jnp.stack([jnp.stack(row) for row in inverse]) / determinant[None, None], jnp.sum(count)
