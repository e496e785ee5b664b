"""The total twist with which a solve begins, and how it follows from the equilibrium that the solve begins from.

Two clamps allow total twists that differ by whole turns. The one that belongs to the last equilibrium is carried to the
first shape of a solve: each tangent and each held frame moves from where it was by its smallest rotation. So a frame
may turn by less than pi, and quaternions along the rod keep their sign against those of the held frames.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.tangent_field import TangentField
from rodjax.discretization.twist import FramedTangents, TwistReference, nearest_twist, total_twist
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp


class Last(NamedTuple):
    """The equilibrium that a solve begins from: the frames of its clamps, `None` at other ends; the turns that its
    scene states; its shape, `None` where it is the one from which the solve begins.
    """

    start_frame: Float[Array, "3 3"] | None
    end_frame: Float[Array, "3 3"] | None
    turns: Float[Array, ""] | None
    shape: Any = None


class FirstTwist(NamedTuple):
    """A total twist [rad], and where it was found; `last` is `None` where the first shape shall have the nearest."""

    total_twist: Float[Array, ""]
    last: Last | None = None


def last_of(scene: Scene, shape: Any = None) -> Last:
    start, end = scene.start, scene.end
    return Last(
        start.frame if isinstance(start, Clamp) else None,
        end.frame if isinstance(end, Clamp) else None,
        scene.turns,
        shape,
    )


def more_turns(scene: Scene, last: Last | None) -> Float[Array, ""] | None:
    """Whole turns by which a scene has more than the last one; `None` where not both state theirs."""
    if last is None or last.turns is None or scene.turns is None:
        return None
    return scene.turns - last.turns


def twist_on(
    scene: Scene, field: TangentField, begin: Any, tangents: Float[Array, "3 m"], first: FirstTwist
) -> Float[Array, ""]:
    """The total twist [rad] on the first tangents of a solve between two clamps, made of those of `begin`."""
    principal = field.principal_twist(scene, tangents)
    start, end, last = scene.start, scene.end, first.last
    assert isinstance(start, Clamp)
    assert isinstance(end, Clamp)
    if last is None or last.start_frame is None or last.end_frame is None:
        return nearest_twist(principal, first.total_twist, scene.turns)
    if scene.turns is not None and last.turns is None:
        return nearest_twist(principal, first.total_twist, scene.turns)
    before = eqx.tree_at(lambda scene: (scene.start.frame, scene.end.frame), scene, (last.start_frame, last.end_frame))
    shape = begin if last.shape is None else last.shape
    old = field.append_prescribed(before, shape.tangents)
    # A shape from another mesh meets the frames only nearly.
    number = jnp.arange(old.shape[1])
    old = jnp.where(number == 0, last.start_frame[:, 2:], old)
    old = jnp.where(number == old.shape[1] - 1, last.end_frame[:, 2:], old)
    reference = TwistReference(FramedTangents(old, last.start_frame[:, 0], last.end_frame[:, 0]), first.total_twist)
    new = FramedTangents(field.append_prescribed(scene, tangents), start.frame[:, 0], end.frame[:, 0])
    carried = total_twist(reference, new)
    more = more_turns(scene, last)
    if more is not None:
        carried += 2 * jnp.pi * more
    # Of a tangent that turns by pi no rotation is the smallest.
    return nearest_twist(principal, jnp.where(jnp.isfinite(carried), carried, first.total_twist), None)
