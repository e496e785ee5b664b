"""The scene: a rod, what holds its ends and what loads it, in SI units or in the units of the rod."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import instance, is_known, leaf, number_array, sequence, vector
from rodjax.geometry.rotations import rotation_vector
from rodjax.model.loads import (
    ContactLoads,
    DistributedCouple,
    DistributedForce,
    PointCouple,
    PointForce,
    Potential,
    check_potential,
)
from rodjax.model.obstacles import InUnits, Obstacle, checked_obstacles, friction_coefficient
from rodjax.model.rod import Rod
from rodjax.model.summaries import scene_text
from rodjax.model.supports import Clamp, Clip, Free, Held, Hinge, Movable, Pin, Slider, Spring, Support, Swivel, rotate
from rodjax.units import Units

# Supports further apart than this many lengths of the rod between them are taken for a mistake: no cable is stretched
# by half of its length.
MAX_SPAN = 1.5
# Positions nearer to one another than this part of the length are one place.
ONE_PLACE = 1e-6


class Scene(eqx.Module):
    """A rod with its supports and loads.

    What is present is static structure; the numbers are differentiable leaves.

    **Arguments:**

    - `rod`: `Rod`.
    - `start`, `end`: what holds s = 0 and s = L: `Clamp`, `Swivel`, `Pin` or `Free`; `Hinge`, `Slider` or `Spring`,
        whose pose `rodjax.solve` finds; `Joint` in a scene of a `Harness`. Both may be `Free` where clips hold the
        rod, or, of a solve with a guess, obstacles with friction or potentials do.
    - `gravity`: (3,) [m/s^2], or `None` for no weight.
    - `point_forces`: `PointForce`s along the rod.
    - `turns`: whole turns of the end frame beyond the total twist in (-pi, pi] of the initial shape; where that is an
        earlier equilibrium whose scene states its turns too, beyond those. `None`: the turns of an earlier equilibrium,
        whose frames turn by less than pi to those of this scene, so that turns are carried along a path; else the total
        twist nearest to that of the initial shape. Two clamps only, and no clip with a frame between them: there an
        earlier equilibrium as a guess carries the turns of each span.
    - `distributed`: `DistributedForce`s and `DistributedCouple`s all along the rod, or along a part of it.
    - `clips`: `Clip`s that hold places between the ends, in the order of their arclengths.
    - `obstacles`: `Obstacle`s that the rod, which has a radius, cannot enter: they push it back, and with friction hold
        it along a path (`rodjax.solve_path`), at the nodes of the mesh, where it touches them to rounding, and without
        friction within each element too, where that comes nearest, to 1e-4 of the radius where it sags by less between
        nodes (in its middle by a `Mesh`, or beside a support within the obstacle). Else, of a mesh that is chosen for a
        tolerance, elements lie no deeper than that between their nodes either, as far as finer ones help: over an edge,
        or on a mesh that is given, the rod may: `rodjax.describe` says so, and `rodjax.clearance` tells where. A rod
        that came through an obstacle since its guess or the last step of its path, or whose centerline lies within one,
        is not converged. Where no obstacle touches the rod they only cost time: to see how far it is from what it stays
        away from, `rodjax.clearance` needs none in the scene. Double precision only.
    - `potentials`: `Potential`s, fields of forces all along the rod, or along a part of it. Elements only.
    - `point_couples`: `PointCouple`s along the rod.
    - `self_contact`: whether the rod, which has a radius, touches itself without friction, where each element is
        nearest to the rod beyond it: at places that follow the shape, at most 48 at a time. Parts that wind around one
        another ask for elements no longer than 1.5 radii; there, the rod counts as thinner between such places, by 6 %
        of its radius at most (2.5 % with elements as long as a radius). Elements and double precision only. A step of
        the search leads no part of the rod through another; a start whose parts overlap is led out. Where the rod stays
        away from itself that only costs time.

    Raises `ValueError` where the supports and loads leave the rod without an equilibrium, where a point force lies
    beyond the rod, where clips do not follow one another along it, or where neighbouring supports are further apart
    than 1.5 lengths of the rod between them.
    """

    rod: Rod
    start: Support
    end: Support
    gravity: Float[Array, "3"] | None
    point_forces: tuple[PointForce, ...]
    turns: Float[Array, ""] | None
    distributed: tuple[DistributedForce | DistributedCouple, ...]
    clips: tuple[Clip, ...]
    obstacles: tuple[Obstacle, ...]
    potentials: tuple[Potential, ...]
    point_couples: tuple[PointCouple, ...]
    # Of a rod of a harness whose rods may touch, where they were found; `None` in a scene that is given.
    contact_loads: ContactLoads | None = eqx.field(init=False)
    self_contact: bool = eqx.field(static=True, default=False)

    def __init__(
        self,
        rod: Rod,
        start: Support,
        end: Support,
        gravity: Any = None,
        point_forces: Sequence[PointForce] = (),
        turns: Any = None,
        distributed: Sequence[DistributedForce | DistributedCouple] = (),
        clips: Sequence[Clip] = (),
        obstacles: Sequence[Obstacle] = (),
        potentials: Sequence[Potential] = (),
        point_couples: Sequence[PointCouple] = (),
        self_contact: bool = False,
    ):
        instance(rod, "rod", Rod)
        instance(start, "start", Support)
        instance(end, "end", Support)
        point_forces = sequence(point_forces, "point_forces", "PointForce")
        for k, force in enumerate(point_forces):
            instance(force, f"point_forces[{k}]", PointForce)
        gravity = None if gravity is None else leaf(vector(gravity, "gravity"))
        turns = None if turns is None else leaf(number_array(turns, "turns"))
        distributed = sequence(distributed, "distributed", "DistributedForce or DistributedCouple")
        for k, load in enumerate(distributed):
            instance(load, f"distributed[{k}]", (DistributedForce, DistributedCouple))
        clips = sequence(clips, "clips", "Clip")
        for k, clip in enumerate(clips):
            instance(clip, f"clips[{k}]", Clip)
        obstacles = checked_obstacles(obstacles, least=0)
        potentials = sequence(potentials, "potentials", "Potential")
        for k, potential in enumerate(potentials):
            instance(potential, f"potentials[{k}]", Potential)
        point_couples = sequence(point_couples, "point_couples", "PointCouple")
        for k, couple in enumerate(point_couples):
            instance(couple, f"point_couples[{k}]", PointCouple)
        along = (distributed, clips, obstacles, potentials, point_couples)
        parts = _of_one_precision((rod, start, end, gravity, point_forces, turns, *along))
        self.rod, self.start, self.end, self.gravity, self.point_forces, self.turns, *rest = parts
        self.distributed, self.clips, self.obstacles, self.potentials, self.point_couples = rest
        instance(self_contact, "self_contact", bool)
        self.self_contact, self.contact_loads = self_contact, None
        for k, potential in enumerate(self.potentials):
            check_potential(potential, f"potentials[{k}]")
        _check_supports(self)
        _check_contacts(self)
        _check_numbers(self)

    def __str__(self) -> str:
        return scene_text(self)


def _of_one_precision(parts: Any) -> Any:
    """With all numbers of the highest precision among them: a compiled program takes no mixture."""
    dtypes = {leaf.dtype for leaf in jax.tree.leaves(parts)}
    if len(dtypes) == 1:
        return parts
    return jax.tree.map(lambda leaf: leaf.astype(max(dtypes, key=lambda dtype: dtype.itemsize)), parts)


def _check_supports(scene: Scene) -> None:
    ends = (scene.start, scene.end)
    pair = f"{type(scene.start).__name__} at the start and {type(scene.end).__name__} at the end"
    if has_free_ends(scene) and not (scene.clips or has_friction(scene) or scene.potentials):
        raise ValueError(
            f"{pair} hold no position: the rod would fly off; make one a Clamp, Swivel or Pin, or hold the rod by a "
            "Clip, by obstacles with friction or by a potential"
        )
    for end, other in (ends, ends[::-1]):
        if not isinstance(end, Free):
            continue
        along = [load for load in scene.distributed if isinstance(load, DistributedForce)]
        loaded = scene.gravity is not None or scene.point_forces or end.force is not None or along
        if isinstance(other, Pin) and not loaded and not scene.clips:
            raise ValueError(f"{pair}: without gravity or a force the rod can turn freely about the pin")
        resists = isinstance(other, Clamp | Movable) or any(clip.frame is not None for clip in scene.clips)
        if end.moment is not None and not resists:
            raise ValueError(
                f"{pair}: a moment on a free end needs a Clamp at the other end, or a Clip with a frame, to resist it"
            )
    if scene.turns is not None and not all(isinstance(end, Clamp) for end in ends):
        raise ValueError(f"turns need a Clamp at both ends, got {pair}, which leaves the rod free to spin")
    if scene.turns is not None and any(clip.frame is not None for clip in scene.clips):
        raise ValueError(
            "turns must be None where a clip has a frame: each span between held frames has turns of its own, which an "
            "earlier equilibrium as a guess carries"
        )


def _check_contacts(scene: Scene) -> None:
    if not has_contacts(scene):
        return
    there_are, name, without = "there are obstacles", "obstacles", "()"
    if not scene.obstacles:
        there_are, name, without = "it may touch itself", "self_contact", "False"
    if scene.rod.radius is None:
        raise ValueError(f"rod must have a radius where {there_are}, got None; rodjax.Rod takes one")
    if scene.rod.length.dtype != jnp.float64:
        raise ValueError(
            f"{name} must be {without} in single precision, in which contacts have no digits: "
            "jax.config.update('jax_enable_x64', True) before making the scene"
        )


def _check_numbers(scene: Scene) -> None:
    if not is_known(scene):
        return
    if scene.turns is not None and float(scene.turns) != np.round(float(scene.turns)):
        raise ValueError(f"turns must be a whole number, got {float(scene.turns):g}")
    length = float(scene.rod.length)
    for k, force in enumerate(scene.point_forces):
        if float(force.at) > length:
            raise ValueError(f"point_forces[{k}].at must lie in 0 to {length:g} m, got {float(force.at):g} m")
    inside = [(f"point_forces[{k}].at", load) for k, load in enumerate(scene.point_forces) if load.follower]
    inside += [(f"point_couples[{k}].at", load) for k, load in enumerate(scene.point_couples)]
    for name, load in inside:
        if not 0 < float(load.at) < length:
            raise ValueError(
                f"{name} must lie inside 0 to {length:g} m, got {float(load.at):g} m; rodjax.Free takes loads on an end"
            )
    for name, loads in (("distributed", scene.distributed), ("potentials", scene.potentials)):
        for k, load in enumerate(loads):
            if load.part is not None and float(load.part[1]) > length * (1 + ONE_PLACE):
                raise ValueError(
                    f"{name}[{k}].part must lie in 0 to {length:g} m, got {np.asarray(load.part).tolist()}"
                )
    start, end = scene.start, scene.end
    if isinstance(start, Held) and isinstance(end, Held):
        with np.errstate(over="ignore"):
            span = float(np.linalg.norm(np.subtract(end.position, start.position)))
        if span > MAX_SPAN * length:
            raise ValueError(
                f"the ends are {span:g} m apart, but a rod of length {length:g} m "
                f"reaches at most {MAX_SPAN * length:g} m"
            )
    _check_clips(scene, length)
    _check_turning(scene, length)


def is_kept_from_turning(scene: Scene) -> bool:
    """Whether supports, clips or loads keep the rod from turning freely about a place, wherever supports are."""
    ends = scene.start, scene.end
    loads = scene.point_forces, scene.distributed, scene.obstacles, scene.potentials, scene.point_couples
    return (
        any(isinstance(end, Clamp | Swivel | Movable) for end in ends)
        or any(clip.direction is not None for clip in scene.clips)
        or scene.gravity is not None
        or any(loads)
        or any(isinstance(end, Free) and end.force is not None for end in ends)
    )


def _check_turning(scene: Scene, length: float) -> None:
    """Refuses a rod that is held at one place alone, about which nothing keeps it from turning."""
    if is_kept_from_turning(scene):
        return
    held = [
        np.asarray(held.position) for held in (scene.start, *scene.clips, scene.end) if isinstance(held, Pin | Clip)
    ]
    if max(float(np.max(np.abs(position - held[0]))) for position in held) <= ONE_PLACE * length:
        raise ValueError(
            f"all pins and clips are at one place, {held[0].tolist()} m: without gravity or a force the rod can turn "
            "freely about it; move one of them or make one hold the tangent"
        )


def _check_clips(scene: Scene, length: float) -> None:
    for k, clip in enumerate(scene.clips):
        at = float(clip.at)
        if not at < length:
            raise ValueError(f"clips[{k}].at must lie between 0 and {length:g} m, got {at:g} m")
        before = float(scene.clips[k - 1].at) if k else 0.0
        if not at > before:
            raise ValueError(f"clips[{k}].at must be larger than clips[{k - 1}].at = {before:g} m, got {at:g} m")
    held = [(f"clips[{k}]", float(clip.at), clip.position) for k, clip in enumerate(scene.clips)]
    if isinstance(scene.start, Held):
        held = [("the start", 0.0, scene.start.position), *held]
    if isinstance(scene.end, Held):
        held = [*held, ("the end", length, scene.end.position)]
    for (name, s, position), (other_name, other_s, other_position) in itertools.pairwise(held if scene.clips else []):
        with np.errstate(over="ignore"):
            span = float(np.linalg.norm(np.subtract(other_position, position)))
        if span > MAX_SPAN * (other_s - s):
            raise ValueError(
                f"{name} and {other_name} are {span:g} m apart, but the {other_s - s:g} m of rod between them "
                f"reach at most {MAX_SPAN * (other_s - s):g} m"
            )


def between(scene: Scene, other: Scene, fraction: Float[Array, ""]) -> Scene:
    """A scene on the way from one to another: numbers linear, frames by the smallest rotation, as `fraction` of it."""

    def number(a, b):
        return a + fraction * (b - a)

    def clip(mixed: Clip, first: Clip, other: Clip) -> Clip:
        if first.frame is None or other.frame is None:
            return Clip(mixed.at, mixed.position, mixed.tangent, mixed.sliding)
        frame = frame_between(first.frame, other.frame, fraction)
        return eqx.tree_at(lambda mixed: mixed.frame, mixed, frame)

    ends = [support_between(*both, fraction) for both in ((scene.start, other.start), (scene.end, other.end))]
    mixed = jax.tree.map(number, scene, other)
    mixed = eqx.tree_at(lambda mixed: (mixed.start, mixed.end), mixed, tuple(ends))
    if not scene.clips:
        return mixed
    clips = tuple(clip(*of_three) for of_three in zip(mixed.clips, scene.clips, other.clips, strict=True))
    return eqx.tree_at(lambda mixed: mixed.clips, mixed, clips)


def support_between(support: Support, other: Support, fraction: Float[Array, ""]) -> Support:
    """The same of supports of one kind."""
    mixed = jax.tree.map(lambda a, b: a + fraction * (b - a), support, other)
    if isinstance(support, Spring) and isinstance(other, Spring):
        inner = support_between(support.support, other.support, fraction)
        return eqx.tree_at(lambda mixed: mixed.support, mixed, inner)
    if isinstance(support, Swivel):
        return Swivel(mixed.position, mixed.tangent)
    frame, last = getattr(support, "frame", None), getattr(other, "frame", None)
    if frame is not None and last is not None:
        mixed = eqx.tree_at(lambda mixed: mixed.frame, mixed, frame_between(frame, last, fraction))
    if isinstance(support, Hinge):
        return Hinge(mixed.position, mixed.frame, mixed.axis)
    if isinstance(support, Slider):
        return Slider(mixed.position, mixed.directions, mixed.frame)
    return mixed


def frame_between(
    frame: Float[Array, "3 3"], other: Float[Array, "3 3"], fraction: Float[Array, ""]
) -> Float[Array, "3 3"]:
    return rotate(frame, fraction * rotation_vector(frame, other))


def has_free_ends(scene: Scene) -> bool:
    """Whether nothing is at either end, so that clips, obstacles or fields hold the rod."""
    return isinstance(scene.start, Free) and isinstance(scene.end, Free)


def has_no_place(scene: Scene) -> bool:
    """Whether no end and no clip tells where the rod lies, so that a solve needs a guess."""
    return has_free_ends(scene) and not scene.clips


def held_position(scene: Scene) -> Float[Array, "3"]:
    """The position of the start where it is held, else of the end, else of the first clip, else the origin."""
    for held in (scene.start, scene.end, *scene.clips):
        if isinstance(held, Held | Clip):
            return held.position
    return jnp.zeros(3, scene.rod.length.dtype)


def scene_axes(scene: Scene) -> Float[Array, "3 3"]:
    """Three unit vectors, the columns, that turn with the scene: where a search has to choose a direction and none is
    better than the others, its choice is one of these.

    A held frame; else by the first two directions that the scene has, of gravity, held tangents, ways between
    positions, and loads. In a scene that has no two, all across the one are alike.
    """
    start, end = scene.start, scene.end
    frames = [held.frame for held in (start, end, *scene.clips) if isinstance(held, Clamp | Clip)]
    for frame in frames:
        if frame is not None:
            return frame
    directions = [] if scene.gravity is None else [scene.gravity]
    directions += [end.tangent for end in (start, end) if isinstance(end, Swivel)]
    directions += [clip.tangent for clip in scene.clips if clip.tangent is not None]
    positions = [held.position for held in (start, *scene.clips, end) if isinstance(held, Held | Clip)]
    directions += [position - positions[0] for position in positions[1:]]
    directions += [load.force for load in dead_forces(scene)]
    directions += [load.couple for load in scene.point_couples if not load.follower]
    ends = [end for end in (start, end) if isinstance(end, Free) and not end.follower]
    directions += [load for end in ends for load in (end.force, end.moment) if load is not None]
    for load in scene.distributed:
        if not load.follower:
            directions.append(load.force if isinstance(load, DistributedForce) else load.couple)
    identity = jnp.eye(3, dtype=scene.rod.length.dtype)
    # Of none of these the last axis, and of one another one that is not along it.
    along = _first_of(jnp.stack([*directions, identity[2]]))
    others = jnp.stack([*directions, identity[0], identity[1]])
    sizes = jnp.sqrt(jnp.sum(others**2, axis=1))
    others /= jnp.where(sizes > LEAST_DIRECTION, sizes, 1.0)[:, None]
    across = others - (others @ along)[:, None] * along[None]
    d1 = _first_of(jnp.where(jnp.sum(across**2, axis=1) > LEAST_ANGLE**2, across.T, 0.0).T)
    return jnp.stack([d1, jnp.cross(along, d1), along], axis=1)


# Vectors in the units of the rod, and parts of unit vectors across others, that are taken for none: roundings are less.
LEAST_DIRECTION = 1e-9
LEAST_ANGLE = 1e-3


def _first_of(vectors: Float[Array, "k 3"]) -> Float[Array, "3"]:
    """The first that is not zero, at the length 1."""
    sizes = jnp.sqrt(jnp.sum(vectors**2, axis=1))
    k = jnp.argmax(sizes > LEAST_DIRECTION)
    return vectors[k] / sizes[k]


def held_at_both_ends(scene: Scene) -> bool:
    """Whether the positions of both ends are given."""
    return isinstance(scene.start, Held) and isinstance(scene.end, Held)


def slides(scene: Scene) -> bool:
    """Whether the rod slides through a clip."""
    return any(clip.sliding for clip in scene.clips)


def sliding_arclengths(scene: Scene) -> Float[Array, "slides"] | None:
    """The arclengths of the sliding clips; `None` where there are none."""
    return jnp.stack([clip.at for clip in scene.clips if clip.sliding]) if slides(scene) else None


def slid(scene: Scene, arclengths: Float[Array, "slides"]) -> Scene:
    """The scene with its sliding clips at other arclengths."""
    return eqx.tree_at(lambda scene: [clip.at for clip in scene.clips if clip.sliding], scene, list(arclengths))


def dead_end_moment(scene: Scene) -> Float[Array, "3"] | None:
    """The dead moment on a free end, if there is one."""
    for end in (scene.start, scene.end):
        if isinstance(end, Free) and end.moment is not None:
            return end.moment
    return None


def needs_frames(scene: Scene) -> bool:
    """Whether the rod, its loads or clips ask for the angle of the sections about the tangent, all along the rod."""
    if scene.distributed or not scene.rod.is_plain or _follows(scene.start) or _follows(scene.end):
        return True
    if loads_at_nodes(scene):
        return True
    if scene.clips and any(clip.frame is not None for clip in scene.clips):
        return True
    return has_fields(scene) and dead_end_moment(scene) is not None


def with_plain_rod(scene: Scene) -> Scene:
    """The same scene with a straight isotropic rod of its mean stiffnesses."""
    rod = scene.rod
    EI1, EI2, GJ, EA = (rod.mean(stiffness) for stiffness in rod.stiffnesses)
    plain = Rod(rod.length, (EI1 + EI2) / 2, GJ, EA, rod.mean_mass_per_length)
    return Scene(plain, scene.start, scene.end, scene.gravity, dead_forces(scene), scene.turns)


def with_pins(scene: Scene) -> Scene:
    """The same scene whose ends may turn where clamps hold them."""
    ends = [Pin(end.position) if isinstance(end, Clamp) else end for end in (scene.start, scene.end)]
    return eqx.tree_at(lambda scene: (scene.start, scene.end), scene, tuple(ends))


def dead_forces(scene: Scene) -> list[PointForce]:
    """The point forces that do not follow the rod."""
    return [load for load in scene.point_forces if not load.follower]


def loaded_parts(scene: Scene) -> list[Float[Array, "2"]]:
    """The arclengths between which loads along parts of the rod act."""
    return [load.part for load in (*scene.distributed, *scene.potentials) if load.part is not None]


def loads_at_nodes(scene: Scene) -> list[PointForce | PointCouple]:
    """The loads at points inside the rod that have no potential."""
    return [*(load for load in scene.point_forces if load.follower), *scene.point_couples]


def has_node_positions(scene: Scene) -> bool:
    """Whether forces along the rod depend on where it is or how it turns, so that the positions of the nodes, and a
    force in each element, are unknowns: where the rod may touch obstacles or itself, in fields of forces, and of rods
    by frames under loads without a potential.
    """
    return has_fields(scene) or (needs_frames(scene) and not has_potential(scene))


def has_fields(scene: Scene) -> bool:
    """Whether forces along the rod depend on where it is: those of contacts, and of fields."""
    return bool(has_contacts(scene) or scene.potentials) or scene.contact_loads is not None


def under_contact(scene: Scene, loads: ContactLoads | None) -> Scene:
    """The same scene with what other rods apply to it."""
    # `eqx.tree_at` would take longer than the solve.
    new = object.__new__(Scene)
    for field in dataclasses.fields(Scene):
        object.__setattr__(new, field.name, getattr(scene, field.name))
    object.__setattr__(new, "contact_loads", loads)
    return new


def has_contacts(scene: Scene) -> bool:
    """Whether the rod may touch obstacles or itself."""
    return bool(scene.obstacles) or scene.self_contact


def has_friction(scene: Scene) -> bool:
    """Whether an obstacle has friction, so that an equilibrium depends on how the rod came there."""
    return any(friction_coefficient(obstacle) is not None for obstacle in scene.obstacles)


def _follows(end: Support) -> bool:
    return type(end) is Free and end.follower


def has_potential(scene: Scene) -> bool:
    """Whether all loads have one: a dead moment, a couple on the rod and a load that follows the rod have none."""
    follows = _follows(scene.start) or _follows(scene.end) or bool(loads_at_nodes(scene))
    follows |= any(isinstance(load, DistributedCouple) or load.follower for load in scene.distributed)
    return dead_end_moment(scene) is None and not follows


def nondimensional(scene: Scene) -> tuple[Scene, Units]:
    """The same scene with L = 1, EI = 1, weight per length = gravity and a held end at the origin, and the way back.

    Tolerances then mean the same for thin and thick rods, and a scene far from the origin loses no digits.
    """
    rod = scene.rod
    units = Units(origin=held_position(scene), length=rod.length, energy=rod.bending_scale / rod.length)
    gravity = None if scene.gravity is None else scene.gravity * (rod.mean_mass_per_length * rod.length / units.force)
    scaled = Scene(
        rod.in_units(units),
        scene.start.in_units(units),
        scene.end.in_units(units),
        gravity,
        [force.in_units(units) for force in scene.point_forces],
        scene.turns,
        [load.in_units(units) for load in scene.distributed],
        [clip.in_units(units) for clip in scene.clips],
        [InUnits(obstacle, units.origin, units.length) for obstacle in scene.obstacles],
        [potential.in_units(units) for potential in scene.potentials],
        [couple.in_units(units) for couple in scene.point_couples],
        scene.self_contact,
    )
    if scene.contact_loads is not None:
        scaled = under_contact(scaled, scene.contact_loads.in_units(units))
    return scaled, units
