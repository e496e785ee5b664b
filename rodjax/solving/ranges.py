"""Ranges of the numbers of scenes whose making could not check them: of stacks, and inside `jit`, `vmap`, `grad`."""

import functools
import inspect
import itertools
import operator
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rodjax.checks import ROTATION_TOLERANCE, Numbers, is_known, namespace
from rodjax.discretization.cells import segments_for_jumps
from rodjax.discretization.turning import HALF_TURN, turn_between_points
from rodjax.model.along import Along, Smooth, Steps
from rodjax.model.obstacles import Box, Capsule, Cylinder, Pipe, Plane, Sphere, Union
from rodjax.model.rod import ARCLENGTH_TOLERANCE, Law, Rod
from rodjax.model.scene import MAX_SPAN, ONE_PLACE, Scene, loaded_parts, loads_at_nodes
from rodjax.model.supports import Clamp, Clip, Held
from rodjax.solving.result import Equilibrium
from rodjax.solving.status import Status

# The obstacles whose numbers are looked at in all scenes at once; others, and unions of them, are made anew.
CHECKED = (Plane, Sphere, Capsule, Cylinder, Pipe, Box)


def check_ranges(scenes: Scene) -> None:
    """Raises, for the first of stacked scenes with numbers out of range, what making it alone would have raised.

    Nothing is looked at where the numbers are traced: see `with_ranges`.
    """
    if not is_known(scenes):
        return
    scenes = jax.tree.map(np.asarray, scenes)
    shape = scenes.rod.length.shape
    is_suspect = np.ones(shape, bool)
    parts = jax.tree.leaves(_checked_when_made(scenes))
    first = (0,) * len(shape)
    if shape and all(np.all(leaf == leaf[first]) for leaf in parts):
        is_suspect = suspects(scenes)
        # What is the same in all of them is looked at in the first.
        is_suspect[first] |= bool(parts)
    for case in np.argwhere(is_suspect):
        name = f"scenes{''.join(f'[{k}]' for k in case)}" if shape else "scene"
        _made(jax.tree.map(lambda leaf, case=case: leaf[tuple(case)], scenes), name)


def suspects(scenes: Scene) -> Bool[np.ndarray, "..."]:
    """Which of stacked scenes may have numbers that making them would have refused; those of obstacles of one's own,
    and of what varies along a rod, are not looked at.
    """
    with np.errstate(all="ignore"):
        wrong = [_is_wrong_obstacle(obstacle, scenes) for obstacle in scenes.obstacles]
        wrong = [np.asarray(_is_wrong(scenes)), _is_misplaced(scenes), *wrong]
    return np.any(np.stack(wrong), axis=0)


def with_ranges(scenes: Scene, result: Equilibrium) -> Equilibrium:
    """The result of scenes whose numbers are traced: `OUT_OF_RANGE` where they make no sense."""
    if is_known(scenes):
        return result
    scenes = jax.lax.stop_gradient(scenes)
    is_wrong = _is_wrong(scenes)
    # What is told by an error where numbers are known, as the mesh is chosen.
    segments = result.s.shape[-1] - 1
    needed = segments_for_jumps(scenes) if result.discretization == "hermite" else None
    if needed is not None:
        is_wrong |= needed[0] > segments
    turn = turn_between_points(scenes, segments, result.discretization)
    if turn is not None:
        is_wrong |= turn >= HALF_TURN
    flags = (
        jnp.where(is_wrong, Status.OUT_OF_RANGE, result.status),
        result.converged & ~is_wrong,
        result.stable & ~is_wrong,
    )
    return eqx.tree_at(lambda result: (result.status, result.converged, result.stable), result, flags)


def _made(part: Any, name: str) -> Any:
    """The same part made anew, which checks it; `name` is for the message."""
    if isinstance(part, tuple):
        return tuple(_made(one, f"{name}[{k}]") for k, one in enumerate(part))
    if not isinstance(part, eqx.Module) or isinstance(part, Law):
        return part
    parameters = _parameters(type(part))
    if not all(hasattr(part, argument) for argument in parameters):
        return part
    arguments = {argument: _made(getattr(part, argument), f"{name}.{argument}") for argument in parameters}
    if any(parameter.kind is inspect.Parameter.VAR_POSITIONAL for parameter in parameters.values()):
        return part
    try:
        return type(part)(**arguments)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


@functools.cache
def _parameters(kind: type) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(kind).parameters


def _checked_when_made(scenes: Scene) -> Any:
    """The parts of scenes that only their making can check."""
    others = [obstacle for obstacle in scenes.obstacles if not isinstance(obstacle, CHECKED)]
    return [value for value in _values_of(scenes.rod) if isinstance(value, Along)], others


def _values_of(rod: Rod) -> list[Any]:
    """What may vary along the rod."""
    values = [
        *rod.stiffnesses,
        *(rod.shear_pair or ()),
        rod.mass_per_length,
        rod.radius,
        rod.rest_twist,
        rod.rest_strain,
    ]
    return [value for value in (*values, *(rod.rest_curvature or ())) if value is not None]


def _is_wrong(scenes: Scene) -> Bool[Numbers, "..."]:
    """Which scenes have numbers that are not finite or out of range; of those along a rod at what they are given."""
    xp = namespace(scenes)
    rod, clips, length = scenes.rod, scenes.clips, scenes.rod.length

    good = [
        _each(xp.isfinite(leaf), scenes) for leaf in jax.tree.leaves(scenes) if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    positive = [length, *rod.stiffnesses, *(rod.shear_pair or ()), *([] if rod.radius is None else [rod.radius])]
    good += [_each(_numbers(value) > 0, scenes) for value in positive]
    good.append(_each(_numbers(rod.mass_per_length) >= 0, scenes))
    good += [] if rod.rest_strain is None else [_each(_numbers(rod.rest_strain) > -1, scenes)]
    arclengths = [xp.zeros_like(length), *(clip.at for clip in clips), length]
    good += [before < after for before, after in itertools.pairwise(arclengths)]
    good += [(force.at >= 0) & (force.at <= length) for force in scenes.point_forces]
    for part in loaded_parts(scenes):
        good += [part[..., 0] >= 0, part[..., 0] < part[..., 1], part[..., 1] <= length * (1 + ARCLENGTH_TOLERANCE)]
    good += [(load.at > 0) & (load.at < length) for load in loads_at_nodes(scenes)]
    frames = [end.frame for end in (scenes.start, scenes.end) if isinstance(end, Clamp)]
    good += [
        _each(_is_rotation(frame), scenes) for frame in (*frames, *(clip.frame for clip in clips)) if frame is not None
    ]
    if scenes.turns is not None:
        good.append(scenes.turns == xp.round(scenes.turns))
    for value in _values_of(rod):
        if isinstance(value, Steps):
            bounds = xp.concatenate([xp.zeros_like(length)[..., None], value.jumps, length[..., None]], axis=-1)
            good.append(_each(xp.diff(bounds) > 0, scenes))
        if isinstance(value, Smooth):
            good += [_each(xp.diff(value.s) > 0, scenes), xp.abs(value.s[..., 0]) <= ARCLENGTH_TOLERANCE * length]
            good.append(xp.abs(value.s[..., -1] - length) <= ARCLENGTH_TOLERANCE * length)
    return ~functools.reduce(operator.and_, good)


def _is_wrong_obstacle(obstacle: Any, scenes: Scene) -> Bool[np.ndarray, "..."]:
    wrong: Any = np.zeros(scenes.rod.length.shape, bool)
    if isinstance(obstacle, Union):
        return functools.reduce(operator.or_, (_is_wrong_obstacle(part, scenes) for part in obstacle.obstacles), wrong)
    if isinstance(obstacle, Sphere | Capsule | Cylinder | Pipe):
        wrong = ~(obstacle.radius > 0)
    if isinstance(obstacle, Capsule | Cylinder):
        wrong |= np.all(obstacle.start == obstacle.end, axis=-1)
    if isinstance(obstacle, Box):
        wrong = ~np.all(obstacle.size > 0, axis=-1)
        if obstacle.frame is not None:
            wrong |= ~np.asarray(_each(_is_rotation(obstacle.frame), scenes))
    return wrong


def _each(holds: Bool[Numbers, "..."], scenes: Scene) -> Bool[Numbers, "..."]:
    """Of each scene whether it holds for all its numbers."""
    return namespace(holds).all(holds.reshape(*scenes.rod.length.shape, -1), axis=-1)


def _numbers(value: Any) -> Float[Numbers, "..."]:
    return value.values if isinstance(value, Along) else value


def _is_rotation(frame: Float[Numbers, "... 3 3"]) -> Bool[Numbers, "..."]:
    # By components: of many frames `einsum` takes ten times as long.
    (a, b, c), (d, e, f), (g, h, i) = ([frame[..., row, column] for row in range(3)] for column in range(3))
    off = [a * d + b * e + c * f, d * g + e * h + f * i, g * a + h * b + i * c]
    lengths = [a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i]
    volume = (b * f - c * e) * g + (c * d - a * f) * h + (a * e - b * d) * i
    close = [abs(value) <= ROTATION_TOLERANCE for value in (*off, *(length - 1 for length in lengths))]
    return functools.reduce(operator.and_, close, volume > 0)


def _is_misplaced(scenes: Scene) -> Bool[np.ndarray, "..."]:
    """Which scenes have neighbouring supports further apart than the rod between them is taken to reach, or all of
    them at one place, which some may not.
    """
    length = scenes.rod.length
    ends = [(np.zeros_like(length), scenes.start), *((clip.at, clip) for clip in scenes.clips), (length, scenes.end)]
    held = [(s, end.position) for s, end in ends if isinstance(end, Held | Clip)]
    found = np.full(length.shape, len(held) > 1)
    for _, position in held[1:]:
        found &= np.max(np.abs(position - held[0][1]), axis=-1) <= ONE_PLACE * length
    for (s, position), (other_s, other) in itertools.pairwise(held):
        found |= ~(np.linalg.norm(other - position, axis=-1) <= MAX_SPAN * (other_s - s))
    return found
