"""Total twist of a framed polyline: how far its end frame is turned against its start frame carried along without twist.

The twist follows from the tangents alone, up to a turn. It is carried from a reference polyline by a formula local in s
(`strain.swept_angle`), so that turns are kept while the end frames turn by less than pi from the reference.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.strain import cross, swept_angle


class TwistReference(eqx.Module):
    """A state of known total twist. Ends that do not hold the twist have no director.

    `tangents`: (k, 3) unit tangents along the rod, `start_d1`, `end_d1`: (3,) directors d1 of the end frames,
    `total_twist` [rad].
    """

    tangents: Float[Array, "k 3"]
    start_d1: Float[Array, "3"] | None
    end_d1: Float[Array, "3"] | None
    total_twist: Float[Array, ""]


def total_twist(
    reference: TwistReference,
    tangents: Float[Array, "k 3"],
    start_d1: Float[Array, "3"] | None,
    end_d1: Float[Array, "3"] | None,
) -> Float[Array, ""]:
    """Total twist [rad], carried from the reference; arguments as the fields of `TwistReference`."""
    swept = jax.vmap(swept_angle)(tangents[:-1], tangents[1:], reference.tangents[:-1], reference.tangents[1:])
    twist = reference.total_twist + jnp.sum(swept)
    if start_d1 is not None:
        twist -= angle_about(tangents[0], transport(reference.start_d1, reference.tangents[0], tangents[0]), start_d1)
    if end_d1 is not None:
        twist += angle_about(tangents[-1], transport(reference.end_d1, reference.tangents[-1], tangents[-1]), end_d1)
    return twist


def transport(
    vector: Float[Array, "3"], tangent: Float[Array, "3"], next_tangent: Float[Array, "3"]
) -> Float[Array, "3"]:
    """`vector`, at right angles to `tangent`, moved by the smallest rotation that carries `tangent` to `next_tangent`."""
    along = jnp.sum(vector * next_tangent) / (1 + jnp.sum(tangent * next_tangent))
    return vector - along * (tangent + next_tangent)


def transport_along(vector: Float[Array, "3"], tangents: Float[Array, "k 3"]) -> Float[Array, "k 3"]:
    """`vector`, at right angles to the first tangent, carried along all of them without twist."""

    def step(carry, tangent):
        previous, moved = carry
        moved = transport(moved, previous, tangent)
        return (tangent, moved), moved

    _, moved = jax.lax.scan(step, (tangents[0], vector), tangents[1:])
    return jnp.concatenate([vector[None], moved])


def angle_about(axis: Float[Array, "3"], vector: Float[Array, "3"], other: Float[Array, "3"]) -> Float[Array, ""]:
    """Right-handed angle about the unit `axis` from `vector` to `other` [rad], both at right angles to it."""
    return jnp.arctan2(jnp.sum(axis * cross(vector, other)), jnp.sum(vector * other))
