"""Quantities that a sweep writes where they are asked for by name."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rodjax.analysis.clearance import clearance
from rodjax.analysis.curvature import curvature_along
from rodjax.checks import sequence, shown
from rodjax.model.harness import Harness, scenes_of
from rodjax.model.scene import Scene
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_form import over_leading_axes
from rodjax.sweeps.cases import SweepError


class Quantity(NamedTuple):
    """Of each case of a stack: its unit, what it is, and what a scene must have for it, by the names of its fields."""

    unit: str
    description: str
    of: Callable[[Equilibrium], Any]
    needs: tuple[str, ...] = ()


def _bend_radius(result: Equilibrium) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return 1 / np.max(np.asarray(curvature_along(result)[1]), axis=-1)


@over_leading_axes
def _clearance(result: Equilibrium):
    return clearance(result, result.scene.obstacles).distance


QUANTITIES = {
    "bend_radius": Quantity("m", "smallest bend radius of the centerline, infinite of a straight rod", _bend_radius),
    "clearance": Quantity(
        "m",
        "least distance of the surface of the rod from each obstacle",
        _clearance,
        ("obstacles", "rod.radius"),
    ),
    "clip_forces": Quantity("N", "force of each clip on the rod", lambda result: result.clip_forces, ("clips",)),
    "clip_moments": Quantity(
        "N m", "moment of each clip on the rod, about its position", lambda result: result.clip_moments, ("clips",)
    ),
    "obstacle_forces": Quantity(
        "N",
        "force of each obstacle on the rod",
        lambda result: np.sum(np.asarray(result.obstacle_forces), axis=-2),
        ("obstacles",),
    ),
    "largest_tension": Quantity("N", "largest tension at a node", lambda result: np.max(result.tension, axis=-1)),
    "least_tension": Quantity(
        "N", "least tension at a node, negative where the rod is compressed", lambda r: np.min(r.tension, axis=-1)
    ),
    "largest_strain": Quantity(
        "1", "largest magnitude of the axial strain at a node", lambda r: np.max(np.abs(r.axial_strain), axis=-1)
    ),
}


def checked_quantities(names: Any, scene: Scene | Harness) -> tuple[str, ...]:
    """The names, where there are such quantities of the scene, or of all cables. Raises `SweepError`."""
    try:
        given: Sequence[Any] = sequence(names, "also", "names of quantities")
    except TypeError as error:
        raise SweepError(str(error)) from None
    for name in given:
        if not isinstance(name, str) or name not in QUANTITIES:
            raise SweepError(f"also must be some of {', '.join(QUANTITIES)}, got {shown(name)}")
        for need in QUANTITIES[name].needs:
            for cable, own in scenes_of(scene).items():
                value = getattr(own.rod if need.startswith("rod.") else own, need.removeprefix("rod."))
                if value is None or (isinstance(value, tuple) and not value):
                    of_cable = f": the cable {cable!r}" if cable else ""
                    raise SweepError(f"also: {name} needs a scene with {need}, got one without{of_cable}")
    if len({*given}) < len(given):
        raise SweepError(f"also must be different names, got {', '.join(given)}")
    return tuple(given)
