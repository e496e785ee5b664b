"""How far the sections of a rod turn within a cell of a mesh at rest, or by the turns that are asked for.

The frames at two neighbouring points tell a turn by less than half of a whole one: on fewer segments a coil loses some
of its coils, without a stress that would tell.
"""

from types import ModuleType

import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import Numbers, namespace
from rodjax.model.along import Along, Smooth, Steps, Value
from rodjax.model.rest import SpaceCurve
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene, needs_frames

# What two frames tell is less [rad]; elements have one in their middle too.
HALF_TURN = np.pi
POINTS_OF_SEGMENT = {"finite_difference": 1, "hermite": 2}
# Equal parts of a rod in each of which what varies along it counts as constant.
PARTS = 1024


def turn_between_points(scene: Scene, segments: int, discretization: str) -> Float[Numbers, "..."] | None:
    """The largest angle [rad] by which the sections of a rod turn between neighbouring points of a mesh of equal
    segments, at rest or by `turns`; `None` where neither has to be resolved. Also of stacked scenes, known or traced.
    """
    if not needs_frames(scene):
        return None
    xp, count = namespace(scene), segments * POINTS_OF_SEGMENT[discretization]
    asked = None if scene.turns is None else 2 * np.pi / count * xp.abs(xp.asarray(scene.turns))
    rates = _rest_rates(scene.rod, xp)
    if rates is None:
        return asked
    if rates.shape[-1] == 1:
        at_rest = rates[..., 0] / count
    else:
        s = xp.linspace(0.0, 1.0, count + 1, dtype=rates.dtype)
        s = xp.broadcast_to(s, (*rates.shape[:-1], count + 1))
        before = (xp.cumsum(rates, axis=-1) - rates) / PARTS
        part = xp.clip(xp.floor(s * PARTS), 0, PARTS - 1)
        within, part = s - part / PARTS, part.astype(int)
        angles = xp.take_along_axis(before, part, -1) + within * xp.take_along_axis(rates, part, -1)
        at_rest = xp.max(xp.diff(angles, axis=-1), axis=-1)
    return at_rest if asked is None else xp.maximum(asked, at_rest)


def _rest_rates(rod: Rod, xp: ModuleType) -> Float[Numbers, "... parts"] | None:
    """By how much the sections of the rod at rest turn [rad] along its length, in `PARTS` of it; in one if it is the
    same everywhere; `None` of a straight one.
    """
    curve = rod.rest_centerline
    values = [value for value in (*(rod.rest_curvature or ()), rod.rest_twist) if value is not None]
    if curve is None and not values:
        return None
    parts = 1 if curve is None and not any(isinstance(value, Along) for value in values) else PARTS
    middles = xp.asarray((np.arange(parts) + 0.5) / parts, rod.length.dtype)
    s = xp.broadcast_to(middles, (*rod.length.shape, parts))
    if curve is not None:
        return _of_curve(curve, s, xp)
    length = xp.asarray(rod.length)[..., None]
    return length * xp.sqrt(sum(_along(value, s * length, xp) ** 2 for value in values))


def _along(value: Value, s: Float[Numbers, "... k"], xp: ModuleType) -> Float[Numbers, "... k"]:
    """A number or `Along` at these arclengths, of stacked rods too; `Smooth` by straight lines between its values."""
    if isinstance(value, Steps):
        return _beyond(xp.asarray(value.jumps), xp.asarray(value.values), s, xp)
    if isinstance(value, Smooth):
        knots, values = xp.asarray(value.s), xp.asarray(value.values)
        lengths = xp.diff(knots, axis=-1)
        first, slope, begin = (
            _beyond(knots[..., 1:-1], x, s, xp)
            for x in (values[..., :-1], xp.diff(values, axis=-1) / lengths, knots[..., :-1])
        )
        return first + slope * (s - begin)
    return xp.broadcast_to(xp.asarray(value)[..., None], s.shape)


def _beyond(
    jumps: Float[Numbers, "... j"], values: Float[Numbers, "... j+1"], s: Float[Numbers, "... k"], xp: ModuleType
) -> Float[Numbers, "... k"]:
    """The value between those two jumps between which each arclength lies."""
    count = xp.sum(s[..., :, None] >= jumps[..., None, :], axis=-1)
    return xp.take_along_axis(values, count, -1)


def _of_curve(rest: SpaceCurve, s: Float[Numbers, "... k"], xp: ModuleType) -> Float[Numbers, "... k"]:
    """From point to point by the angle between chords and that between the directors, as parts of the length."""
    points, d1 = xp.asarray(rest.points), xp.asarray(rest.d1)
    chords = xp.diff(points, axis=-2)
    ways = xp.diff(xp.asarray(rest.s), axis=-1)
    bends = _angles(chords[..., :-1, :], chords[..., 1:, :], xp) / ((ways[..., 1:] + ways[..., :-1]) / 2)
    # Each bend belongs to both of its neighbours.
    bends = xp.maximum(
        xp.concatenate([bends[..., :1], bends], axis=-1), xp.concatenate([bends, bends[..., -1:]], axis=-1)
    )
    spins = _angles(d1[..., :-1, :], d1[..., 1:, :], xp) / ways
    return _beyond(xp.asarray(rest.s)[..., 1:-1], xp.maximum(bends, spins), s, xp)


def _angles(a: Array, b: Array, xp: ModuleType) -> Array:
    return xp.arctan2(xp.linalg.norm(xp.cross(a, b), axis=-1), xp.sum(a * b, axis=-1))
