"""Meshes for an accuracy that is asked for: how many elements, and where."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Numbers of elements: few, as each is a program to compile.
SIZES = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)
# The estimated error may be off by a few percent, and a mesh that just misses costs another solve.
SAFETY = 1.2
ORDER = 4
# The mesh grows by this much at least, and at most: an estimate on a mesh too coarse is not to be believed that far.
LEAST_GROWTH, MOST_GROWTH = 1.2, 4.0
# The longest element is at most so many times as long as one of equal elements, and neighbours differ by this factor.
LONGEST = 2.0
GRADING = 2.0


def next_size(segments: int, error: float, rtol: float) -> int:
    """The number of elements for a relative error `rtol`, after `segments` had an estimated `error` (NaN: unknown)."""
    growth = (SAFETY * error / rtol) ** (1 / ORDER) if error == error else 2.0
    wanted = segments * min(max(growth, LEAST_GROWTH), MOST_GROWTH)
    return next((size for size in SIZES if size >= wanted), SIZES[-1])


def graded(s: Float[Array, "n+1"], defects: Float[Array, "n"], segments: int) -> Float[Array, "k+1"]:
    """Nodes of a mesh on which all elements would have the same defect, of fifth order in their length."""
    h = jnp.diff(s)
    density = (defects + jnp.finfo(h.dtype).tiny) ** (1 / (ORDER + 1)) / h
    density /= jnp.sum(density * h)
    density = jnp.maximum(density, 1 / LONGEST)

    def spread(density, _):
        beside = jnp.maximum(jnp.concatenate([density[1:], density[-1:]]), jnp.concatenate([density[:1], density[:-1]]))
        return jnp.maximum(density, beside / GRADING), None

    density, _ = jax.lax.scan(spread, density, length=8)
    sums = jnp.concatenate([jnp.zeros(1, h.dtype), jnp.cumsum(density * h)])
    nodes = jnp.interp(jnp.linspace(0.0, 1.0, segments + 1, dtype=h.dtype) * sums[-1], sums, s)
    return nodes.at[0].set(0.0).at[-1].set(1.0)
