"""Total twist of a framed polyline: the turn of its end frame against its start frame carried along without twist.

The twist follows from the tangents alone, up to a turn. It is carried from a reference polyline by a formula local in s
(`strain.swept_angle`), so that turns are kept while the end frames turn by less than pi from the reference.
Arrays along the rod have the components first.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.joints import tangent_bases
from rodjax.geometry.vectors import components, dot, triple_product
from rodjax.linalg.blocks import partial_sums
from rodjax.mechanics.energy import twist_under
from rodjax.mechanics.strain import swept_angle
from rodjax.model.scene import Scene, dead_end_moment
from rodjax.model.supports import Free


class FramedTangents(eqx.Module):
    """Unit tangents along the rod, (3, k), and the directors d1 of the end frames, `None` at an end free to spin."""

    tangents: Float[Array, "3 k"]
    start_d1: Float[Array, "3"] | None
    end_d1: Float[Array, "3"] | None


class TwistReference(eqx.Module):
    """A state of known total twist [rad]."""

    state: FramedTangents
    total_twist: Float[Array, ""]


def total_twist(reference: TwistReference, state: FramedTangents) -> Float[Array, ""]:
    """Total twist of a state [rad], carried from the reference."""
    old, new = reference.state, state
    twist = reference.total_twist + swept_twist(old.tangents, new.tangents)
    if old.start_d1 is not None and new.start_d1 is not None:
        carried = transport(old.start_d1, old.tangents[:, 0], new.tangents[:, 0])
        twist -= angle_about(new.tangents[:, 0], carried, new.start_d1)
    if old.end_d1 is not None and new.end_d1 is not None:
        carried = transport(old.end_d1, old.tangents[:, -1], new.tangents[:, -1])
        twist += angle_about(new.tangents[:, -1], carried, new.end_d1)
    return twist


def swept_twist(old: Float[Array, "3 k"], new: Float[Array, "3 k"]) -> Float[Array, ""]:
    """What the total twist gains as the tangents move while the end frames follow by smallest rotations [rad]."""
    return jnp.sum(swept_angle(new[:, :-1], new[:, 1:], old[:, :-1], old[:, 1:]))


def transport(
    vector: Float[Array, "3 *k"], tangent: Float[Array, "3 *k"], next_tangent: Float[Array, "3 *k"]
) -> Float[Array, "3 *k"]:
    """`vector`, at right angles to `tangent`, moved by the smallest rotation from `tangent` to `next_tangent`."""
    along = dot(vector, next_tangent) / (1 + dot(tangent, next_tangent))
    return vector - along[None] * (tangent + next_tangent)


def transport_along(vector: Float[Array, "3"], tangents: Float[Array, "3 k"]) -> Float[Array, "3 k"]:
    """`vector`, at right angles to the first tangent, carried along all of them without twist."""
    bases = tangent_bases(tangents)
    return carried_in_bases(vector, bases, partial_sums(turns_of_bases(tangents, bases)))


def turns_of_bases(tangents: Float[Array, "3 k"], bases: Float[Array, "3 2 k"]) -> Float[Array, "k-1"]:
    """The angles by which the bases turn about the tangents from one to the next [rad]."""
    d1 = bases[:, 0]
    carried = transport(d1[:, :-1], tangents[:, :-1], tangents[:, 1:])
    return angle_about(tangents[:, 1:], carried, d1[:, 1:])


def carried_in_bases(
    vector: Float[Array, "3"], bases: Float[Array, "3 2 k"], turned: Float[Array, "j"]
) -> Float[Array, "3 j"]:
    """`vector`, at right angles to the first tangent, in the last j bases, which have turned so far about it."""
    x, y = components(bases[..., 0], vector)
    d1, d2 = bases[..., -len(turned) :].swapaxes(0, 1)
    cosine, sine = jnp.cos(turned), jnp.sin(turned)
    return (x * cosine + y * sine)[None] * d1 + (y * cosine - x * sine)[None] * d2


def angle_about(
    axis: Float[Array, "3 *k"], vector: Float[Array, "3 *k"], other: Float[Array, "3 *k"]
) -> Float[Array, "*k"]:
    """Right-handed angle about the unit `axis` from `vector` to `other` [rad], both at right angles to it."""
    return jnp.arctan2(triple_product(axis, vector, other), dot(vector, other))


def nearest_twist(
    principal: Float[Array, ""], guess: Float[Array, ""], turns: Float[Array, ""] | None
) -> Float[Array, ""]:
    """The total twist [rad] which is `principal` up to whole turns: these turns, or those nearest to a guess."""
    if turns is None:
        turns = jnp.round((guess - principal) / (2 * jnp.pi))
    return principal + 2 * jnp.pi * turns


def twist_under_moment(scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, ""]:
    """The total twist that a dead moment on the free end raises: its part about the end tangent, constant in s."""
    moment = dead_end_moment(scene)
    assert moment is not None
    sign, edge = (-1, 0) if isinstance(scene.start, Free) else (1, -1)
    return twist_under(scene.rod, sign * jnp.sum(moment * tangents[:, edge]))
