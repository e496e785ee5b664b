"""Poses of the bodies of a harness to begin with."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.geometry.rotations import columns
from rodjax.model.harness import Bodies, Harness, end_radii
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Held, Joint, Swivel
from rodjax.programs.compilation import compiled
from rodjax.solving.assembly import Poses
from rodjax.solving.guess import Guess

# Of each rod, where the user gives one.
Shapes = tuple[Guess | None, ...]
# Of the frames that neighbouring clamps suggest, beside the directions of the rods.
FRAME_WEIGHT = 0.05
# A chord shorter than this part of the rod has no direction.
LEAST_CHORD = 1e-6
# How far rods longer than their chords let a body down, as a part of how far they would reach taut.
SAG = 0.7
# How often the way down is looked at: each time on by the distance from what is nearest.
MOST_LOOKS = 16


class _Reach(NamedTuple):
    """From an end of a rod at a body to the next place: another body by its number, or a fixed place.

    `sign`: 1 where the rod begins here, -1 where it ends here; `begins`, `along`: place of its end here and its unit
    tangent there, where the shape of the rod is given.
    """

    body: int
    other: int | None
    place: Any
    frame: Any
    length: Any
    sign: int
    joint: Joint
    other_joint: Joint | None
    obstacles: tuple[Obstacle, ...] = ()
    radius: Any = None
    begins: Any = None
    along: Any = None


@compiled
def first_poses(harness: Harness, shapes: Shapes) -> Poses:
    """Each body where given shapes of its rods end; else where springs along the rods, as soft as these are long, would
    hold it, let down as far as the rods are longer; what hangs on a single fixed place straight on from there. Axes so
    that the ends point as on these shapes, else along the chords of their rods.
    """
    bodies = Bodies.of(harness)
    reaches = [
        reach for scene, shape in zip(harness.scenes, shapes, strict=True) for reach in _reaches(scene, shape, harness)
    ]
    count = len(harness.bodies)
    is_fixed = [body.support is not None for body in harness.bodies]
    positions: list[Any] = [bodies.position[j] if is_fixed[j] else None for j in range(count)]
    frames: list[Any] = [bodies.frame[j] if bodies.has_frame[j] else None for j in range(count)]
    ends = {j: [reach for reach in _at(j, reaches) if reach.begins is not None] for j in range(count)}
    sketched = [j for j in range(count) if ends[j] and not is_fixed[j]]
    for j in sketched:
        positions[j] = jnp.mean(jnp.stack([reach.begins for reach in ends[j]]), axis=0)
    for j in sketched:  # as seen from where its rods end; then its own place beside these
        if frames[j] is None:
            frames[j] = _frame_at(j, positions, reaches)
    for j in sketched:
        positions[j] -= frames[j] @ jnp.mean(jnp.stack([reach.joint.offset for reach in ends[j]]), axis=0)
    is_fixed = [fixed or j in sketched for j, fixed in enumerate(is_fixed)]
    hangs = _hanging(reaches, is_fixed)

    gravity = next((scene.gravity for scene in harness.scenes if scene.gravity is not None), None)
    free = [j for j in range(count) if not is_fixed[j] and j not in hangs]
    if free:
        place = {j: k for k, j in enumerate(free)}
        dtype = bodies.position.dtype
        matrix, right = jnp.zeros((len(free), len(free)), dtype), jnp.zeros((len(free), 3), dtype)
        for reach in reaches:
            if reach.body not in place:
                continue
            here, weight = place[reach.body], 1 / reach.length
            matrix = matrix.at[here, here].add(weight)
            if reach.other in place:
                matrix = matrix.at[here, place[reach.other]].add(-weight)
            elif reach.other is not None and is_fixed[reach.other]:
                right = right.at[here].add(weight * positions[reach.other])
            elif reach.other is None and reach.place is not None:
                right = right.at[here].add(weight * reach.place)
            else:  # what only hangs here pulls nowhere
                matrix = matrix.at[here, here].add(-weight)
        found = jnp.linalg.solve(matrix, right)
        for j, k in place.items():
            positions[j] = found[k]
        lowered = {j: _lowered(j, positions, reaches, gravity) for j in free} if gravity is not None else {}
        for j, position in lowered.items():
            positions[j] = position
    for j in range(count):
        if positions[j] is not None and frames[j] is None:
            frames[j] = _frame_at(j, positions, reaches)

    # Straight on from what is known, body after body.
    waiting = True
    while waiting:
        waiting = False
        for reach in reaches:
            if positions[reach.body] is not None:
                continue
            known = _end_beyond(reach, positions, frames)
            if known is None:
                continue
            place, frame = known
            frames[reach.body] = frame @ reach.joint.frame.T
            here = place - reach.sign * reach.length * frame[:, 2]
            positions[reach.body] = here - frames[reach.body] @ reach.joint.offset
            waiting = True
    identity = jnp.eye(3, dtype=bodies.position.dtype)
    return Poses(
        jnp.stack([bodies.position[j] if positions[j] is None else positions[j] for j in range(count)]),
        jnp.stack([identity if frames[j] is None else frames[j] for j in range(count)]),
    )


def _at(body: int, reaches: list[_Reach]) -> list[_Reach]:
    return [reach for reach in reaches if reach.body == body]


def _reaches(scene: Scene, shape: Guess | None, harness: Harness) -> list[_Reach]:
    found = []
    length = scene.rod.length
    for here, there, sign in ((scene.start, scene.end, 1), (scene.end, scene.start, -1)):
        if not isinstance(here, Joint):
            continue
        body = harness.joint_names.index(here.name)
        if scene.clips:
            clip = scene.clips[0 if sign == 1 else -1]
            way = clip.at if sign == 1 else length - clip.at
            found.append(_Reach(body, None, clip.position, clip.frame, way, sign, here, None))
        elif isinstance(there, Joint):
            other = harness.joint_names.index(there.name)
            found.append(_Reach(body, other, None, None, length, sign, here, there))
        elif isinstance(there, Held):
            frame = there.frame if isinstance(there, Clamp) else None
            if isinstance(there, Swivel):
                frame = _any_frame(there.tangent)
            found.append(_Reach(body, None, there.position, frame, length, sign, here, None))
        else:
            found.append(_Reach(body, None, None, None, length, sign, here, None))
        if scene.obstacles:
            radius = end_radii(scene)[0 if sign == 1 else 1]
            found[-1] = found[-1]._replace(obstacles=scene.obstacles, radius=radius)
        if shape is not None:
            edge = (shape.points[1] - shape.points[0]) if sign == 1 else (shape.points[-1] - shape.points[-2])
            length_of_edge = jnp.sqrt(jnp.sum(edge**2))
            along = edge / jnp.where(length_of_edge > 0, length_of_edge, 1.0)
            found[-1] = found[-1]._replace(begins=shape.points[0 if sign == 1 else -1], along=along)
    return found


def _hanging(reaches: list[_Reach], is_fixed: list[bool]) -> set[int]:
    """The bodies of which all ways to a fixed place lead through the same one."""
    hanging = set()
    for j, fixed in enumerate(is_fixed):
        if fixed:
            continue
        seen, reached_ends, waiting = {j}, set(), [j]
        while waiting:
            body = waiting.pop()
            for k, reach in enumerate(reaches):
                if reach.body != body:
                    continue
                if reach.other is None:
                    if reach.place is not None:
                        reached_ends.add(("place", k))
                elif is_fixed[reach.other]:
                    reached_ends.add(("body", reach.other))
                elif reach.other not in seen:
                    seen.add(reach.other)
                    waiting.append(reach.other)
        if len(reached_ends) < 2:
            hanging.add(j)
    return hanging


def _end_beyond(reach: _Reach, positions: list[Any], frames: list[Any]) -> tuple[Any, Any] | None:
    """Position and frame of the far end of a rod, where these are known."""
    if reach.other is None:
        if reach.place is None:
            return None
        return reach.place, _any_frame(jnp.array([0.0, 0.0, 1.0])) if reach.frame is None else reach.frame
    if positions[reach.other] is None or frames[reach.other] is None:
        return None
    assert reach.other_joint is not None
    frame = frames[reach.other]
    return positions[reach.other] + frame @ reach.other_joint.offset, frame @ reach.other_joint.frame


def _lowered(body: int, positions: list[Any], reaches: list[_Reach], gravity: Float[Array, "3"]) -> Float[Array, "3"]:
    """The position of a body as far down as the rods between it and fixed places, else all of its rods, let it."""
    beside = _at(body, reaches)
    fixed = [reach for reach in beside if reach.place is not None]
    falls = []
    for reach in fixed or beside:
        place = reach.place if reach.other is None else positions[reach.other]
        if place is not None:
            falls.append(reach.length**2 - jnp.sum((place - positions[body]) ** 2))
    size = jnp.sqrt(jnp.sum(gravity**2))
    down = gravity / jnp.where(size > 0, size, 1.0)
    fall = jnp.min(jnp.stack(falls)) if falls else jnp.zeros_like(size)
    fall = SAG * jnp.sqrt(jnp.maximum(fall, 0.0))
    near = [(obstacle, reach.radius) for reach in beside for obstacle in reach.obstacles]
    if near:
        fall = _until_touched(positions[body], down, fall, near)
    return positions[body] + fall * down


def _until_touched(
    position: Float[Array, "3"], down: Float[Array, "3"], fall: Float[Array, ""], near: list[tuple[Obstacle, Any]]
) -> Float[Array, ""]:
    """How far a body falls before an end of a rod in it would touch an obstacle."""

    def further(_, fallen: Float[Array, ""]) -> Float[Array, ""]:
        gaps = [obstacle.at(position + fallen * down) - radius for obstacle, radius in near]
        return jnp.minimum(fallen + jnp.maximum(jnp.min(jnp.stack(gaps)), 0.0), fall)

    return jax.lax.fori_loop(0, MOST_LOOKS, further, jnp.zeros_like(fall))


def _frame_at(body: int, positions: list[Any], reaches: list[_Reach]) -> Float[Array, "3 3"]:
    """The rotation that takes the tangents of the ends nearest to those of given shapes, else to the chords of their
    rods: Davenport's method.
    """
    pairs, beside = [], _at(body, reaches)
    for reach in [reach for reach in beside if reach.along is not None] or beside:
        if reach.along is None:
            place = reach.place if reach.other is None else positions[reach.other]
            if place is None:
                continue
            chord = reach.sign * (place - positions[body])
            size = jnp.sqrt(jnp.sum(chord**2))
            is_long = size > LEAST_CHORD * reach.length
            along = chord / jnp.where(is_long, size, 1.0)
        else:
            along = reach.along
            is_long = jnp.sum(along**2) > 0
        weight = jnp.where(is_long, 1.0, 0.0)
        pairs.append((reach.joint.frame[:, 2], along, weight))
        if reach.frame is not None:
            align_tangent = _swung(reach.frame, jnp.where(is_long, along, reach.frame[:, 2]))
            pairs += [(reach.joint.frame[:, k], align_tangent[:, k], FRAME_WEIGHT * (1 + 0 * weight)) for k in range(3)]
    dtype = positions[body].dtype
    table = 1e-3 * FRAME_WEIGHT * jnp.eye(3, dtype=dtype)
    for own, seen, weight in pairs:
        table += weight * seen[:, None] * own[None]
    trace = jnp.trace(table)
    skew = jnp.stack([table[2, 1] - table[1, 2], table[0, 2] - table[2, 0], table[1, 0] - table[0, 1]])
    lower = table + table.T - trace * jnp.eye(3, dtype=dtype)
    upper = jnp.concatenate([trace[None], skew])[None]
    matrix = jnp.concatenate([upper, jnp.concatenate([skew[:, None], lower], axis=1)])
    return columns(jnp.linalg.eigh(matrix)[1][:, -1])


def _any_frame(tangent: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """With this tangent."""
    least = jnp.argmin(jnp.abs(tangent))
    across = jnp.where(np.arange(3) == least, 1.0, 0.0) - tangent[least] * tangent
    d1 = across / jnp.sqrt(jnp.sum(across**2))
    return jnp.stack([d1, jnp.cross(tangent, d1), tangent], axis=1)


def _swung(frame: Float[Array, "3 3"], tangent: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Turned by the smallest rotation that takes its tangent to another one; not where these are opposite."""
    old = frame[:, 2]
    cosine = jnp.sum(old * tangent)
    axis = jnp.cross(old, tangent)
    is_opposite = cosine < -0.99
    skew = jnp.cross(axis[:, None], frame, axis=0)
    twice = jnp.cross(axis[:, None], skew, axis=0)
    turned = frame + skew + twice / jnp.where(is_opposite, 1.0, 1 + cosine)
    return jnp.where(is_opposite, frame, turned)
