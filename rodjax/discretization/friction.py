"""Coulomb friction at the nodes: slips s, and the tangential forces q of f obstacles, no longer than mu p.

As of pressures and gaps, either the slip is zero or the force is as long as its bound, and against the slip:
q = -mu p s/|s|. So q is what q - W s is where that is cut to the bound, whatever the weight W.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.geometry.vectors import root

# A slip counts as so much of a force in EI/L^2, as gaps do, when it is asked whether a search has ended.
SLIP_WEIGHT = 1e4
# A node that went less far than this along an obstacle has not slipped [L].
LEAST_SLIP = 1e-12


def tangential(vectors: Float[Array, "#f n+1 3"], normals: Float[Array, "f n+1 3"]) -> Float[Array, "f n+1 3"]:
    """What of vectors is along the surfaces."""
    return vectors - normals * jnp.sum(vectors * normals, axis=-1, keepdims=True)


def pulled(
    forces: Float[Array, "f n+1 3"], displacements: Float[Array, "n+1 3"], normals: Float[Array, "f n+1 3"]
) -> tuple[Float[Array, "f n+1 3"], Float[Array, "f n+1 3"]]:
    """What would hold nodes where they were, q - W s, without bounds; and the slips."""
    slips = tangential(displacements[None], normals)
    return tangential(forces, normals) - SLIP_WEIGHT * slips, slips


def within(forces: Float[Array, "f n+1 3"], bounds: Float[Array, "f n+1"]) -> Float[Array, "f n+1 3"]:
    """Forces cut to their bounds."""
    sizes, bounds = lengths(forces), bounds[..., None]
    return forces * jnp.where(sizes > bounds, bounds / jnp.where(sizes > 0, sizes, 1.0), 1.0)


def directions(exerted: Float[Array, "f n+1 3"], slips: Float[Array, "f n+1 3"]) -> Float[Array, "f n+1 3"]:
    """Of friction: that of `exerted`, which is against the slips, with the derivatives of -s/|s|; zero without slip."""
    fixed = jax.lax.stop_gradient(slips)
    has_slipped = lengths(fixed) > LEAST_SLIP
    ratio = jax.lax.stop_gradient(lengths(exerted)) / jnp.where(has_slipped, lengths(fixed), 1.0)
    against = jnp.where(has_slipped, exerted - ratio * (slips - fixed), 1.0)
    return jnp.where(has_slipped, against / lengths(against), 0.0)


def lengths(vectors: Float[Array, "f n+1 3"]) -> Float[Array, "f n+1 1"]:
    return root(jnp.sum(vectors**2, axis=-1, keepdims=True))
