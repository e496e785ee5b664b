"""Total twist of a framed polyline: the turn of its end frame against its start frame carried along without twist.

The twist follows from the tangents alone, up to a turn. It is carried from a reference polyline by a formula local in s
(`strain.swept_angle`), so that turns are kept while the end frames turn by less than pi from the reference.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.strain import swept_angle


class FramedTangents(eqx.Module):
    """Unit tangents along the rod, (k, 3), and the directors d1 of the end frames, `None` at an end free to spin."""

    tangents: Float[Array, "k 3"]
    start_d1: Float[Array, "3"] | None
    end_d1: Float[Array, "3"] | None


class TwistReference(eqx.Module):
    """A state of known total twist [rad]."""

    state: FramedTangents
    total_twist: Float[Array, ""]


def total_twist(reference: TwistReference, state: FramedTangents) -> Float[Array, ""]:
    """Total twist of a state [rad], carried from the reference."""
    old, new = reference.state, state
    swept = jax.vmap(swept_angle)(new.tangents[:-1], new.tangents[1:], old.tangents[:-1], old.tangents[1:])
    twist = reference.total_twist + jnp.sum(swept)
    if old.start_d1 is not None and new.start_d1 is not None:
        carried = transport(old.start_d1, old.tangents[0], new.tangents[0])
        twist -= angle_about(new.tangents[0], carried, new.start_d1)
    if old.end_d1 is not None and new.end_d1 is not None:
        carried = transport(old.end_d1, old.tangents[-1], new.tangents[-1])
        twist += angle_about(new.tangents[-1], carried, new.end_d1)
    return twist


def transport(
    vector: Float[Array, "3"], tangent: Float[Array, "3"], next_tangent: Float[Array, "3"]
) -> Float[Array, "3"]:
    """`vector`, at right angles to `tangent`, moved by the smallest rotation from `tangent` to `next_tangent`."""
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
    return jnp.arctan2(jnp.sum(axis * jnp.cross(vector, other)), jnp.sum(vector * other))
