"""Steps from a point of a branch, of any length, or to given parameters."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.paths.branch import BranchTangent, Station, stepped
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium


class Line(NamedTuple):
    """The points that steps of several lengths from one station find, or from there to given parameters."""

    scenes: Scene | Harness
    segment: int
    station: Station

    def at(self, distance: float, target: float = math.nan) -> Station:
        station, closed = self.station, self.station.closed
        return towards(
            self.scenes, self.segment, station.parameter, station.equilibrium, station.along, distance, target, closed
        )


def towards(
    scenes: Scene | Harness,
    segment: int,
    parameter: Float[Array, ""],
    result: Equilibrium | HarnessEquilibrium,
    along: BranchTangent,
    distance: float,
    target: float = math.nan,
    closed: Any = None,
) -> Station:
    """As `stepped`, with plain numbers."""
    number = functools.partial(jnp.asarray, dtype=parameter.dtype)
    where = jnp.asarray(segment, int)
    return stepped(scenes, where, parameter, result, along, number(distance), number(target), closed)


class Step(NamedTuple):
    """What a step found, `at` any part of it; `bound`: the number of the scene at which it stopped, if it did."""

    there: Station
    length: float
    at: Callable[[float], Station]
    bound: int | None
    growth: float
