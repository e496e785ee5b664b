"""The shape that a user gives a solve to begin with."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import leaf, number_array, shown
from rodjax.discretization.joints import generic_field
from rodjax.geometry.interpolation import resampled
from rodjax.model.scene import Scene, scene_axes
from rodjax.units import Units

# Cosine between neighbouring edges below which a guess counts as folded, and by how much of an edge it is unfolded.
FOLDED = -0.99
ASIDE = 0.05


class Guess(eqx.Module):
    """An initial shape; it need not match the supports, the length or the mesh.

    `points`: (m, 3) [m], m >= 2, equally spaced in arclength; `total_twist` [rad]: of the total twists that the end
    frames allow on this shape, the solution has the one nearest to this.
    """

    points: Float[Array, "m 3"]
    total_twist: Float[Array, ""]

    def __init__(self, points: Any, total_twist: Any = 0.0):
        try:
            shape = np.shape(points)
        except ValueError:
            raise TypeError(f"points must be numbers of shape (m, 3), got {shown(points)}") from None
        if len(shape) != 2 or shape[0] < 2 or shape[1] != 3:
            raise ValueError(f"points must have the shape (m, 3) with m >= 2, got {shape}")
        self.points = leaf(number_array(points, "points", shape))
        self.total_twist = leaf(number_array(total_twist, "total_twist"))

    def nodes(self, scene: Scene, units: Units, segments: int) -> Float[Array, "n+1 3"]:
        """The nodes of a mesh on this shape, for a nondimensional scene."""
        nodes = resampled((self.points - units.origin[None]) / units.length, segments)
        return _unfolded(nodes, scene_axes(scene))


def _unfolded(nodes: Float[Array, "n+1 3"], axes: Float[Array, "3 3"]) -> Float[Array, "n+1 3"]:
    """Where an edge runs back along the last one, or has no length, all edges a little aside: such have no torsion."""
    edges = jnp.diff(nodes, axis=0)
    lengths = jnp.sqrt(jnp.sum(edges**2, axis=1))
    least = ASIDE * jnp.maximum(jnp.mean(lengths), ASIDE / len(edges))
    aside = edges + least * generic_field(edges.T, axes).T
    cosines = jnp.sum(edges[1:] * edges[:-1], axis=1) / jnp.maximum(lengths[1:] * lengths[:-1], least**2)
    is_folded = jnp.any(cosines < FOLDED) | jnp.any(lengths < least)
    unfolded = nodes[:1] + jnp.concatenate([jnp.zeros((1, 3), nodes.dtype), jnp.cumsum(aside, axis=0)])
    return jnp.where(is_folded, unfolded, nodes)
