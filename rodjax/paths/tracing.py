"""Along a branch of equilibria step by step, from scene to scene and through folds; its critical points, located."""

import enum
import math
from typing import Any, NamedTuple

import jax.numpy as jnp

from rodjax.discretization.form import NEUTRAL
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene, slides
from rodjax.notes import note
from rodjax.paths.branch import (
    BranchTangent,
    Station,
    closed_contacts,
    count_of,
    is_misplaced,
    no_motion,
    on_new_mesh,
)
from rodjax.paths.corners import Corner, TooLongError, corner_in
from rodjax.paths.line import Line, Step, towards
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium

# A step that turns the tangent of the branch by more than 26 degrees is halved, and one of 14 is not made longer.
LEAST_ALIGNMENT, GOOD_ALIGNMENT = 0.9, 0.97
# Corrections up to which the next step is longer, and from which it is shorter, by these factors.
FEW_ITERATIONS, MANY_ITERATIONS = 4, 7
LONGER, SHORTER = 1.5, 0.7
# A branch on which steps become shorter than this part of the longest is given up.
LEAST_STEP = 1e-6
# The search for a critical point ends where an eigenvalue [EI/L^2], or a rate of the parameter, is this near to zero,
# or at this part of a step; then so many steps of Newton's method follow. (An index counts -NEUTRAL as positive.)
NEAR = 10 * NEUTRAL
LEAST_BRACKET = 1e-12
MAX_TRIALS = 80
POLISHES = 2
# Of the trials every so many halves the bracket.
HALVED = 4


class BranchEnd(enum.Enum):
    """Why a branch was followed no further."""

    SCENES = "it reached the end of the scenes"
    FIRST_CRITICAL = "it reached its first critical point"
    MAX_POINTS = "it has as many points as were allowed"
    LEAST_STEP = "no step along it converged, however short"
    NOT_CONVERGED = "no equilibrium was found to begin with"


class StepControl(NamedTuple):
    """How long the first step is, and the longest [rad of a rod that turns as a whole, or the whole path of scenes]."""

    first: float
    longest: float
    most: int


DEFAULT_STEPS = StepControl(first=0.02, longest=0.1, most=1000)


class Crossing(NamedTuple):
    """A critical point, the index on both sides, whether the parameter turns round, and the row and node of a contact
    that opens or closes there; `None` where that is not what makes it critical.
    """

    station: Station
    index_before: int
    index_after: int
    turns: bool
    contact: tuple[int, int] | None = None


class Trace(NamedTuple):
    stations: list[Station]
    crossings: list[Crossing]
    ended: BranchEnd


def begun(
    scenes: Scene | Harness,
    parameter: float,
    result: Equilibrium | HarnessEquilibrium,
    direction: float,
    closed: Any = None,
) -> tuple[int, Station]:
    """The station of an equilibrium under the scene of a parameter, which is to grow or to fall from there; `closed`:
    its closed contacts, `None` for those that press.
    """
    last = count_of(scenes) - 1
    segment = math.floor(parameter) if direction > 0 else math.ceil(parameter) - 1
    segment = min(max(segment, 0), last - 1)
    dtype = result.energy.dtype
    along = BranchTangent(no_motion(result), jnp.asarray(direction, dtype))
    if closed is None and isinstance(result, Equilibrium):
        closed = closed_contacts(result)
    return segment, towards(scenes, segment, jnp.asarray(parameter, dtype), result, along, 0.0, parameter, closed)


def trace(
    scenes: Scene | Harness,
    start: float,
    first: Equilibrium | HarnessEquilibrium,
    direction: float,
    steps: StepControl,
    only_first: bool = False,
) -> Trace:
    """The branch from an equilibrium under the scene of the parameter `start`, or that as far as a critical point."""
    last = count_of(scenes) - 1
    segment, station = begun(scenes, start, first, direction)
    stations, crossings = [station], []
    mesh: Any = station.equilibrium
    made: Any = mesh
    if not station.equilibrium.converged:
        return Trace(stations, crossings, BranchEnd.NOT_CONVERGED)
    if float(station.parameter) == (last if direction > 0 else 0):
        return Trace(stations, crossings, BranchEnd.SCENES)
    distance = steps.first
    while len(stations) < steps.most:
        note(f"following a branch, {len(stations)} equilibria so far")
        line = Line(scenes, segment, station)
        step, corner = _as_far_as_a_corner(line, distance)
        if step is None:
            distance /= 2
            if distance < LEAST_STEP * steps.longest:
                return Trace(stations, crossings, BranchEnd.LEAST_STEP)
            continue
        found = _crossings(line, step)
        if corner is not None:
            found += _at_corner(step.there, corner)
        crossings += found[:1] if only_first else found
        if only_first and found:
            return Trace(stations, crossings, BranchEnd.FIRST_CRITICAL)
        station = step.there if corner is None else corner.beyond
        # Contacts belong to the nodes of a mesh.
        if isinstance(scenes, Scene) and slides(scenes) and not scenes.obstacles:
            station, made = _on_its_mesh(Line(scenes, segment, station), step.bound, made, mesh)
        stations.append(station)
        if step.bound is not None:
            rising = step.bound > segment
            if step.bound in (0, last):
                return Trace(stations, crossings, BranchEnd.SCENES)
            way = 1.0 if rising else -1.0
            segment, station = begun(scenes, step.bound, station.equilibrium, way, station.closed)
        distance = min(distance * step.growth, steps.longest)
    return Trace(stations, crossings, BranchEnd.MAX_POINTS)


def _as_far_as_a_corner(line: Line, distance: float) -> tuple[Step | None, Corner | None]:
    """A step, `None` where it must be shorter, and the corner of the branch at which it ends, if it does."""
    step = _step(line, distance)
    if step is None:
        return None, None
    try:
        corner = corner_in(line, step)
    except TooLongError:
        return None, None
    return (step, None) if corner is None else (corner.step, corner)


def _at_corner(before: Station, corner: Corner) -> list[Crossing]:
    """Where the index or the way of the parameter changes as a contact opens or closes."""
    beyond = corner.beyond
    turns = float(before.along.rate * beyond.along.rate) < 0
    indices = int(before.index), int(beyond.index)
    return [Crossing(before, *indices, turns, corner.contact)] if turns or indices[0] != indices[1] else []


def _on_its_mesh(line: Line, bound: int | None, made: Any, mesh: Any) -> tuple[Station, Any]:
    """The station on a mesh that fits where the rod has slid to, and the equilibrium for which that was made; `made`:
    for which the mesh was; `mesh`: of the first equilibrium, as which meshes are made.
    """
    station: Any = line.station
    if not is_misplaced(station.equilibrium, made):
        return station, made
    result, along = on_new_mesh(station.equilibrium, station.along, mesh.state.shape)
    target = math.nan if bound is None else bound
    there = towards(line.scenes, line.segment, station.parameter, result, along, 0.0, target)
    return (there, there.equilibrium) if _is_good(there) else (station, made)


def _step(line: Line, distance: float) -> Step | None:
    """A step along the branch, no further than the next scene; `None` where it must be shorter."""
    there = line.at(distance)
    if not _is_good(there):
        return None
    growth = _growth(there)
    begin, end = float(line.station.parameter), float(there.parameter)
    if line.segment < end < line.segment + 1:
        return Step(there, distance, lambda part: line.at(part * distance), None, growth)
    bound = line.segment if end <= line.segment else line.segment + 1
    if begin == bound:
        return None
    share = distance * (bound - begin) / (end - begin)

    def at(part: float) -> Station:
        return line.at(part * share, begin + part * (bound - begin) if part < 1 else bound)

    landed = at(1.0)
    if not _is_good(landed) or landed.along.rate * line.station.along.rate <= 0:
        return None
    return Step(landed, share, at, bound, growth)


def _is_good(station: Station) -> bool:
    return bool(station.equilibrium.converged) and float(station.alignment) > LEAST_ALIGNMENT


def _growth(station: Station) -> float:
    iterations = int(station.equilibrium.iterations)
    if iterations >= MANY_ITERATIONS:
        return SHORTER
    return LONGER if iterations <= FEW_ITERATIONS and float(station.alignment) > GOOD_ALIGNMENT else 1.0


# --- critical points -------------------------------------------------------------------------------------------------


class _Side(NamedTuple):
    """A part of a step, what was found there, and the number whose zero is sought."""

    part: float
    station: Station
    value: float

    @property
    def negative(self) -> int:
        return int(self.station.index)


def _crossings(line: Line, step: Step) -> list[Crossing]:
    if not step.length:
        return []
    return _between(line, step, (0.0, line.station), (1.0, step.there))


def _between(line: Line, step: Step, before: tuple[float, Station], after: tuple[float, Station]) -> list[Crossing]:
    """The critical points between two parts of a step: where the index changes, or the parameter turns round.

    By regula falsi on the eigenvalue nearest to zero, or the rate of the parameter, and by halves where that does not
    tell the sides. Several points are parted by the index.
    """
    indices = int(before[1].index), int(after[1].index)
    changes = indices[0] != indices[1]
    # The eigenvalue falls through zero where the index grows.
    sign = math.copysign(1.0, indices[1] - indices[0] if changes else float(before[1].along.rate))

    def side(part: float, station: Station) -> _Side:
        return _Side(part, station, sign * float(station.stiffness if changes else station.along.rate))

    low, high = side(*before), side(*after)
    if not changes and high.value > 0:
        return []
    weights, kept = (1.0, 1.0), 0  # less of a value that is kept twice in turn: the Illinois method
    best = min(low, high, key=lambda side: abs(side.value))
    for trial in range(1, MAX_TRIALS):
        width = high.part - low.part
        if abs(best.value) <= NEAR or width <= LEAST_BRACKET:
            break
        values = weights[0] * low.value, weights[1] * high.value
        tells = values[0] > 0 > values[1] and trial % HALVED != 0
        part = low.part + (values[0] / (values[0] - values[1]) if tells else 0.5) * width
        here = side(part, step.at(part))
        is_near = abs(here.value) <= NEAR
        if not is_near and here.negative not in (indices if changes else indices[:1]):
            middle = (part, here.station)
            return [
                *_between(line, step, (low.part, low.station), middle),
                *_between(line, step, middle, (high.part, high.station)),
            ]
        best = min(best, here, key=lambda side: abs(side.value))
        if here.value > 0 if is_near or not changes else here.negative == indices[0]:
            low, weights, kept = here, (1.0, weights[1] / 2 if kept > 0 else 1.0), 1
        else:
            high, weights, kept = here, (weights[0] / 2 if kept < 0 else 1.0, 1.0), -1
    slope = (high.value - low.value) / ((high.part - low.part) * step.length)
    for _ in range(POLISHES):
        # From where the search ended: on the way from afar the steps of the corrector would be noise so near.
        closer = side(best.part, line._replace(station=best.station).at(-best.value / slope))
        best = min(best, closer, key=lambda side: abs(side.value))
    return [Crossing(best.station, *indices, turns=float(before[1].along.rate * after[1].along.rate) < 0)]
