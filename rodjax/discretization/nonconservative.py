"""Loads without a potential: couples, forces that follow the rod, and dead moments on a free end.

Those at a point inside the rod are of the element that begins there.

Of each element they are a function of its frames alone, where the rod has a force of its own in each: what follower
forces exert within it, from a point to its end; the force of all of it, which stands in the balance of the node where
it begins; couples on its frames. Their virtual work enters the gradient.
"""

import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import ElementCells
from rodjax.discretization.element_bending import SIMPSON
from rodjax.geometry.rotations import inverse, rotated
from rodjax.model.loads import DistributedCouple, DistributedForce, PointCouple, PointForce, per_length
from rodjax.model.scene import Scene, dead_forces
from rodjax.model.supports import Free, Support


def following(scene: Scene, field: ElementCells, quaternions: Float[Array, "4 3 n"]) -> Float[Array, "3 3 n"] | None:
    """What the follower forces along the rod exert on each strain point from there to the end of its element, by
    parabolas through the three points; `None` without such.
    """
    force = _follower_force(scene, field, quaternions)
    if force is None:
        return None
    a, b, c = (force[:, k] for k in range(3))
    whole = _whole(field, force)
    second_half = field.h[None] * (-a + 8 * b + 5 * c) / 24
    return jnp.stack([whole, second_half, jnp.zeros_like(whole)], axis=1)


def on_nodes(scene: Scene, field: ElementCells, quaternions: Float[Array, "4 3 n"]) -> Float[Array, "2 3 n"]:
    """What follower forces are for the balance of the nodes at both ends of each element."""
    force = _follower_force(scene, field, quaternions)
    loads = jnp.zeros((2, *quaternions[1:, 0].shape), quaternions.dtype)
    if force is not None:
        loads = loads.at[0].set(_whole(field, force))
    for end, k in ((scene.start, 0), (scene.end, -1)):
        if isinstance(end, Free) and end.follower and end.force is not None:
            loads = loads.at[k, :, k].add(rotated(quaternions[:, k, k], end.force))
    for load in scene.point_forces:
        if load.follower:
            loads = loads.at[0].add(rotated(quaternions[:, 0], _beginning_at(load.at, field, load.force)))
    return loads


def _beginning_at(at: Float[Array, ""], field: ElementCells, load: Float[Array, "3"]) -> Float[Array, "3 n"]:
    """A load on the first points of elements: of the one that begins at an arclength inside the rod."""
    node = jnp.argmin(jnp.abs(field.s[1:-1] - at)) + 1
    return jnp.where((jnp.arange(len(field.h)) == node)[None], load[:, None], 0.0)


def _follower_force(
    scene: Scene, field: ElementCells, quaternions: Float[Array, "4 3 n"]
) -> Float[Array, "3 3 n"] | None:
    """Per length, global axes."""
    parts = [
        rotated(quaternions, _at_points(load, field))
        for load in scene.distributed
        if isinstance(load, DistributedForce) and load.follower
    ]
    return functools.reduce(jnp.add, parts) if parts else None


def _at_points(load: DistributedForce | DistributedCouple, field: ElementCells) -> Float[Array, "3 3 n"]:
    """Per length at the points of elements, on which it is the same: a part has nodes where it ends."""
    by_element = per_length(load, field.strain_arclengths[1])
    return jnp.broadcast_to(by_element[:, None], (3, *field.strain_arclengths.shape))


def _whole(field: ElementCells, force: Float[Array, "3 3 n"]) -> Float[Array, "3 n"]:
    return field.h[None] * (SIMPSON[0] * (force[:, 0] + force[:, 2]) + SIMPSON[1] * force[:, 1])


def couples_along(
    scene: Scene, field: ElementCells, quaternions: Float[Array, "4 3 n"]
) -> Float[Array, "3 3 n"] | None:
    """The couples along the rod on the strain points, in the axes of the frames; `None` where there are none."""
    parts = []
    for load in scene.distributed:
        if isinstance(load, DistributedCouple):
            couple = _at_points(load, field)
            parts.append(field.lengths[None] * (couple if load.follower else rotated(inverse(quaternions), couple)))
    return functools.reduce(jnp.add, parts) if parts else None


def couples(scene: Scene, field: ElementCells, quaternions: Float[Array, "4 3 n"]) -> Float[Array, "3 3 n"]:
    """The same, with those at points and on free ends."""
    along = couples_along(scene, field, quaternions)
    total = jnp.zeros_like(quaternions[1:]) if along is None else along
    for end, k in ((scene.start, 0), (scene.end, -1)):
        if isinstance(end, Free) and end.moment is not None:
            moment = end.moment if end.follower else rotated(inverse(quaternions[:, k, k]), end.moment)
            total = total.at[:, k, k].add(moment)
    at_points = point_couples(scene, field, quaternions)
    return total if at_points is None else total.at[:, 0].add(at_points)


def point_couples(scene: Scene, field: ElementCells, quaternions: Float[Array, "4 3 n"]) -> Float[Array, "3 n"] | None:
    """The couples at points inside the rod, on the first frames of elements, in the axes of these; `None` for none."""
    parts = []
    for load in scene.point_couples:
        couple = _beginning_at(load.at, field, load.couple)
        parts.append(couple if load.follower else rotated(inverse(quaternions[:, 0]), couple))
    return functools.reduce(jnp.add, parts) if parts else None


def conservative(scene: Scene) -> Scene:
    """The scene without these loads."""
    dead = [load for load in scene.distributed if not _is_nonconservative(load)]

    def dead_alone(end: Support) -> Support:
        return Free(None if end.follower else end.force) if isinstance(end, Free) else end

    ends = dead_alone(scene.start), dead_alone(scene.end)
    return eqx.tree_at(_loaded, scene, (tuple(dead), *ends, tuple(dead_forces(scene)), ()))


def _loaded(scene: Scene) -> tuple[Any, ...]:
    """The parts of a scene that may be such loads."""
    return scene.distributed, scene.start, scene.end, scene.point_forces, scene.point_couples


def scaled(scene: Scene, part: Float[Array, ""]) -> Scene:
    """The scene with a part of these loads."""

    def of(load: Any) -> Any:
        if not _is_nonconservative(load):
            return load
        if isinstance(load, DistributedCouple):
            return DistributedCouple(part * load.couple, load.follower, load.part)
        return DistributedForce(part * load.force, load.follower, load.part)

    def at(end: Support) -> Support:
        if not isinstance(end, Free):
            return end
        moment = None if end.moment is None else part * end.moment
        force = part * end.force if end.follower and end.force is not None else end.force
        return Free(force, moment, end.follower)

    loads = tuple(of(load) for load in scene.distributed)
    forces = tuple(
        PointForce(load.at, part * load.force, True) if load.follower else load for load in scene.point_forces
    )
    couples = tuple(PointCouple(load.at, part * load.couple, load.follower) for load in scene.point_couples)
    return eqx.tree_at(_loaded, scene, (loads, at(scene.start), at(scene.end), forces, couples))


def _is_nonconservative(load: Any) -> bool:
    return isinstance(load, DistributedCouple) or load.follower
