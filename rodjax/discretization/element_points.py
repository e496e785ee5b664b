"""Values at the points of elements, nodes and middles in turn: gathered by elements, and summed over them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.element_bending import SIMPSON


def of_elements(by_point: Float[Array, "... m"]) -> tuple[Array, Array, Array]:
    """What belongs to start, middle and end of the elements."""
    return by_point[..., 0:-1:2], by_point[..., 1::2], by_point[..., 2::2]


def interleaved(nodes: Float[Array, "... n+1"], middles: Float[Array, "... n"]) -> Float[Array, "... m"]:
    pairs = jnp.stack([nodes, _padded(middles, 0, 1)], axis=-1)
    return pairs.reshape(*nodes.shape[:-1], -1)[..., :-1]


def scatter_add(start: Float[Array, "... n"], middle: Float[Array, "... n"], end: Float[Array, "... n"]) -> Array:
    """Sums over the elements at each point."""
    return interleaved(_padded(start, 0, 1) + _padded(end, 1, 0), middle)


def _padded(x: Float[Array, "... n"], before: int, after: int) -> Float[Array, "... k"]:
    return jax.lax.pad(x, jnp.zeros((), x.dtype), [*[(0, 0, 0)] * (x.ndim - 1), (before, after, 0)])


def parts_before(s: Float[Array, "n+1"], at: Float[Array, ""]) -> Float[Array, "3 n"]:
    """How much of the weight of each point of the elements between nodes at `s` lies before an arclength: parabolas,
    integrated so far.
    """
    x = jnp.clip((at - s[:-1]) / jnp.diff(s), 0.0, 1.0)
    parts = (x - 3 * x**2 / 2 + 2 * x**3 / 3, 2 * x**2 - 4 * x**3 / 3, 2 * x**3 / 3 - x**2 / 2)
    return jnp.stack([part / weight for part, weight in zip(parts, SIMPSON, strict=True)])
