"""Measured points beside the rod that they are of: units and the end from which they are listed, before any solve."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rodjax.identification.measurements import Centerline, Experiment
from rodjax.model.harness import Harness
from rodjax.model.scene import MAX_SPAN, Scene
from rodjax.model.supports import Held

# Extents by the rod's length that points in the wrong unit have, a thousand times too large.
MILLIMETRES = 100.0, 2000.0
# Points are so much shorter than the arclengths between them only in a wrong unit, and not where they are very few.
LEAST_EXTENT = 0.01
LEAST_POINTS = 5
# By the length: so far away from a support lies a point that is not of that arclength, and so near one that may be.
FAR, NEAR = 0.1, 0.02


def check_points(experiments: Sequence[Experiment], names: Sequence[str], sought: Sequence[str]) -> None:
    """Raises `ValueError` where points cannot be of the rod as they are, but could in another unit or order.

    `names`: of the experiments; `sought`: names of unknowns, as what a fit may still find is not looked at.
    """
    for experiment, name in zip(experiments, names, strict=True):
        for k, measured in enumerate(experiment.measured):
            scene = experiment.scene
            if isinstance(scene, Harness) and measured.cable is not None:
                scene = scene[measured.cable]
            if isinstance(measured, Centerline) and measured.is_affine:
                assert isinstance(scene, Scene)
                _check(measured, scene, f"{name}: measured[{k}]", _kinds(sought, k))


def _kinds(sought: Sequence[str], k: int) -> set[str]:
    """What is sought of the rig of the k-th measurement, and whether lengths or positions of the scene are."""
    rig = {name.split(".")[2] for name in sought if name.startswith(f"measured.{k}.")}
    of_places = "start.position", "end.position", "rod.length"
    places = {"place" for name in sought if any(f".{part}" in f".{name}" for part in of_places)}
    return rig | places


def _check(measured: Centerline, scene: Scene, name: str, sought: set[str]) -> None:
    length = float(scene.rod.length)
    held = scene.start if isinstance(scene.start, Held) else scene.end
    if not isinstance(held, Held):  # between joints of a harness
        return
    points = measured.lifted(np.asarray(held.position))
    if "scale" not in sought:
        _check_units(points, None if measured.s is None else np.asarray(measured.s), length, name)
    if measured.s is not None and not sought & {"scale", "turn", "offset", "shift", "place"}:
        _check_order(measured, scene, length, name)


def _check_units(points: Float[np.ndarray, "m 3"], s: Float[np.ndarray, "m"] | None, length: float, name: str) -> None:
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if extent > MAX_SPAN * length:
        least, most = MILLIMETRES
        unit = "they look like millimetres" if least < extent / length < most else "look at their unit"
        raise ValueError(
            f"{name}.points must lie along a rod that is {length:g} m long, got points over {extent:.4g} m: {unit}, "
            "points are in m"
        )
    if s is None or len(points) < LEAST_POINTS:
        return
    order = np.argsort(s)
    along = float(np.sum(np.linalg.norm(np.diff(points[order], axis=0), axis=1)))
    if along < LEAST_EXTENT * float(np.ptp(s)):
        raise ValueError(
            f"{name}.points must be about as far apart as their arclengths, got a line of {along:.4g} m over "
            f"{float(np.ptp(s)):g} m of rod: look at the units of points, s and rod.length, which are in m"
        )


def _check_order(measured: Centerline, scene: Scene, length: float, name: str) -> None:
    s = np.asarray(measured.s)

    def beyond(s: Float[np.ndarray, "m"]) -> float:
        """By how much points are further away from a held end than the rod between the two is long, by its length."""
        most = 0.0
        for end, reach in ((scene.start, s), (scene.end, length - s)):
            if isinstance(end, Held):
                position = np.asarray(end.position)
                away = np.linalg.norm(measured.lifted(position) - position, axis=1)
                most = max(most, float(np.max(away - reach)))
        return most / length

    if beyond(s) > FAR and beyond(length - s) < NEAR:
        raise ValueError(
            f"{name}.points must be listed with arclengths from the start on, got points that only reach both ends "
            f"when s is counted from the other end: take s = {length:g} m - s, or exchange start and end of the scene"
        )
