"""Which of two cables that cross one another lies above: the one whose line between its supports does.

A rod that is longer than its way begins sagging, perhaps through a rod below it, and rods that reach a floor begin on
it, one within the other. What is so is drawn towards the line between the places that hold it until it passes the other
rod on the side of that line.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import is_known
from rodjax.discretization.first_shape import first_shape
from rodjax.model.scene import Scene, nondimensional
from rodjax.model.supports import Held
from rodjax.programs.compilation import compiled
from rodjax.solving.first_poses import Shapes
from rodjax.solving.guess import Guess, beside_obstacles

# Pieces of a shape; it is drawn towards the line by this part of its sag at a time, until it passes the other rod by
# this part of both radii.
PIECES = 64
STEPS = 8
BESIDE = 1.1


class _Cable(NamedTuple):
    """A shape as it begins, the line between the places that hold it, at the same arclengths; where these places stand
    along both, and its thickest radius; lengths in metres.
    """

    shape: Float[np.ndarray, "m 3"]
    line: Float[np.ndarray, "m 3"]
    held: Float[np.ndarray, "h"]
    radius: float

    def drawn(self, step: int) -> Float[np.ndarray, "m 3"]:
        return self.line + (1 - step / STEPS) * (self.shape - self.line)

    def between(self, span: int) -> slice:
        """The places of a span."""
        first, last = np.searchsorted(np.linspace(0, 1, PIECES + 1), self.held[span : span + 2])
        return slice(int(first), int(last) + 1)


class _Crossing(NamedTuple):
    """The numbers of two cables whose lines cross, of the spans that do, and the direction across both, from the first
    line to the second one.
    """

    cables: tuple[int, int]
    spans: tuple[int, int]
    across: Float[np.ndarray, "3"]


def on_their_sides(scenes: Sequence[Scene], pairs: Sequence[tuple[int, int]], shapes: Shapes) -> Shapes:
    """Shapes to begin with, with those of rods that else would begin on the wrong side of another one, or within it;
    `scenes`: with clamps in the place of joints; `pairs`: of rods that may touch. Rods for which a shape is given, that
    have a free end or another shape at rest, begin as they do; so do all in traced code.
    """
    cables: dict[int, _Cable] = {}
    for number in sorted({number for pair in pairs for number in pair}):
        scene = scenes[number]
        has_both_ends = isinstance(scene.start, Held) and isinstance(scene.end, Held)
        if shapes[number] is None and has_both_ends and scene.rod.rest_shape is None and is_known(scene):
            cables[number] = _cable(scene)
    crossings = [crossing for pair in pairs if set(pair) <= set(cables) for crossing in _crossings(pair, cables)]
    steps = dict.fromkeys(cables, 0)
    for _ in range(STEPS * len(cables)):
        moved = {_drawn_in(crossing, cables, steps) for crossing in crossings} - {None}
        if not moved:
            break
        for number in moved:
            assert number is not None
            steps[number] += 1
    return tuple(
        Guess(cables[number].drawn(steps[number])) if steps.get(number, 0) else shape
        for number, shape in enumerate(shapes)
    )


@compiled
def _begin(scene: Scene) -> Float[Array, "m 3"]:
    scaled, units = nondimensional(scene)
    return units.origin[None] + units.length * beside_obstacles(scaled, first_shape(scaled, PIECES), PIECES)


def _cable(scene: Scene) -> _Cable:
    places: list[Any] = [scene.start, *scene.clips, scene.end]
    positions = np.array([np.asarray(place.position) for place in places])
    held = np.array([0.0, *(float(clip.at / scene.rod.length) for clip in scene.clips), 1.0])
    along = np.linspace(0, 1, PIECES + 1)
    line = np.stack([np.interp(along, held, part) for part in positions.T], axis=1)
    radius = scene.rod.radius
    assert radius is not None, "a rod that may touch others has a radius"
    return _Cable(np.asarray(_begin(scene)), line, held, float(np.max(getattr(radius, "values", radius))))


def _crossings(pair: tuple[int, int], cables: dict[int, _Cable]) -> list[_Crossing]:
    """Where the lines of two cables pass one another, not nearer than these are thick."""
    found = []
    first, second = (cables[number] for number in pair)
    lines = [
        np.stack([np.interp(cable.held, np.linspace(0, 1, PIECES + 1), part) for part in cable.line.T], axis=1)
        for cable in (first, second)
    ]
    for spans in itertools.product(range(len(first.held) - 1), range(len(second.held) - 1)):
        begins, ways = zip(
            *((line[k], line[k + 1] - line[k]) for line, k in zip(lines, spans, strict=True)), strict=True
        )
        across = np.cross(*ways)
        size = np.linalg.norm(across)
        if size <= 1e-6 * np.linalg.norm(ways[0]) * np.linalg.norm(ways[1]):
            continue
        across /= size
        apart = begins[1] - begins[0]
        parts = np.linalg.solve(np.stack([ways[0], -ways[1], across], axis=1), apart)
        if not np.all((parts[:2] > 0) & (parts[:2] < 1)) or abs(parts[2]) < first.radius + second.radius:
            continue
        found.append(_Crossing(pair, spans, np.sign(parts[2]) * across))
    return found


def _drawn_in(crossing: _Crossing, cables: dict[int, _Cable], steps: dict[int, int]) -> int | None:
    """The cable that is to be drawn towards its line, as the two do not pass one another as their lines do."""
    both = [cables[number] for number in crossing.cables]
    where = [cable.between(span) for cable, span in zip(both, crossing.spans, strict=True)]
    shapes = [cable.drawn(steps[number])[at] for cable, number, at in zip(both, crossing.cables, where, strict=True)]
    apart = shapes[1][None] - shapes[0][:, None]
    heights = apart @ crossing.across
    aside = np.sqrt(np.maximum(np.sum(apart**2, axis=2) - heights**2, 0.0))
    thick = both[0].radius + both[1].radius
    is_near = aside <= max(thick, 1.5 * np.min(aside))
    places = np.unravel_index(np.argmin(np.where(is_near, heights, np.inf)), heights.shape)
    if heights[places] >= BESIDE * thick:
        return None
    sags = []
    for cable, number, shape, at, place, side in zip(
        both, crossing.cables, shapes, where, places, (1, -1), strict=True
    ):
        sag = side * float((shape - cable.line[at])[place] @ crossing.across)
        sags.append(sag if steps[number] < STEPS else 0.0)
    return crossing.cables[int(np.argmax(sags))] if max(sags) > 0 else None
