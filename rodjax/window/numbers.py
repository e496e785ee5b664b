"""The numbers of a rod in the hand, each against its limit where there is one."""

from typing import NamedTuple

import numpy as np

from rodjax.drawing import largest_radius
from rodjax.model.scene import Scene
from rodjax.routing.limits import Limits
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium
from rodjax.solving.status import Status
from rodjax.window.bounds import held_places
from rodjax.window.session import Report, Session

# Below so many radians along the whole rod a twist is rounding.
ROUNDING = 1e-9


class Row(NamedTuple):
    """One number in words; `is_bad`: it breaks its limit, or warns."""

    label: str
    text: str
    is_bad: bool = False


def rows(session: Session, report: Report, limits: Limits | None = None) -> list[Row]:
    """All numbers that the window shows."""
    result = session.result
    status = Status(int(result.status))
    found = [Row("state", "at rest" if bool(result.converged) else status.message, not bool(result.converged))]
    found += _stability_rows(session, limits)
    if isinstance(result, Equilibrium):
        found += _rod_rows(session, result, limits)
    else:
        for number, name in enumerate(result):
            found += _cable_rows(session, number, name, limits)
    energy = result.elastic_energy if isinstance(result, Equilibrium) else result.energy
    label = "elastic energy" if isinstance(result, Equilibrium) else "energy"
    found.append(_most(label, float(energy), "J", limits, "energy"))
    found.append(Row("last move", f"{report.iterations} iterations, {report.milliseconds:.1f} ms"))
    return found


def _stability_rows(session: Session, limits: Limits | None) -> list[Row]:
    if session.softest is None and not isinstance(session.result, Equilibrium):
        is_stable = bool(session.result.stable)
        return [Row("stability", "stable" if is_stable else "not stable, or not known", not is_stable)]
    if session.softest is None:
        return [] if session.can_settle else [Row("softest motion", "not known with these loads")]
    stability = None if limits is None else limits.stability
    is_low = session.is_soft or (stability is not None and session.softest < float(stability))
    remark = ", about to snap" if session.is_soft else ""
    return [Row("softest motion", f"{session.softest:.3g} N{remark}", is_low)]


def _rod_rows(session: Session, result: Equilibrium, limits: Limits | None) -> list[Row]:
    reading, scene = session.reading, result.scene
    found = [_bend_row("smallest bend radius", float(session.figures[0].bend_radius), scene, limits)]
    found += _clearance_rows(session, limits)
    found += _load_rows(session, scene, limits)
    twist, rate = float(result.total_twist), float(np.max(np.abs(reading.values["twist"])))
    degrees, turns = round(np.degrees(twist), 1) + 0.0, round(twist / (2 * np.pi), 2) + 0.0  # no -0.0
    return [
        *found,
        Row("total twist", f"{degrees:.1f}°, {turns:.2f} turns"),
        _most("twist rate", rate if rate * float(scene.rod.length) > ROUNDING else 0.0, "rad/m", limits, "twist"),
        _strain_row("axial strain", np.asarray(result.axial_strain), session, limits),
    ]


def _cable_rows(session: Session, number: int, name: str, limits: Limits | None) -> list[Row]:
    """Of a rod of a harness."""
    result, reading = session.result, session.readings[number]
    assert isinstance(result, HarnessEquilibrium)
    scene = result.harness[name]
    radius = float(session.figures[number].bend_radius)
    forces = np.linalg.norm(reading.forces, axis=1)

    def beyond_limit(k: int) -> tuple[float, float]:
        limit = None if limits is None else limits.end_force if k < 2 else limits.clip_force
        return -np.inf if limit is None else float(forces[k]) - float(limit), float(forces[k])

    # Of the forces that which breaks its limit by most, or is nearest to it; the largest where there are none.
    most = max(range(len(forces)), key=beyond_limit)
    where = "start" if most == 0 else "end" if most == 1 else f"clip {most - 2}"
    loads = [
        _most(f"{name}: force, {where}", float(forces[most]), "N", limits, "end_force" if most < 2 else "clip_force")
    ]
    if limits is not None and limits.end_moment is not None:
        moment = float(np.max(np.linalg.norm(reading.moments, axis=1)))
        loads.append(_most(f"{name}: end moment", moment, "N m", limits, "end_moment"))
    # From the obstacle with the least margin.
    clearances = sorted(_clearances(session, number, limits), key=lambda one: one.margin)[:1]
    nearest = [Row(f"{name}: clearance, {one.name}", one.text, one.is_bad) for one in clearances]
    return [_bend_row(f"{name}: bend radius", radius, scene, limits), *nearest, *loads]


def _strain_row(label: str, strains: np.ndarray, session: Session, limits: Limits | None) -> Row:
    strain = float(np.max(np.abs(strains)))
    most = session.strain_limit if limits is None or limits.strain is None else float(limits.strain)
    return Row(label, f"{100 * strain:.3g} %", strain > most)


def least_bend_radius(scene: Scene, limits: Limits | None) -> float | None:
    """That of the centerline which a limit allows [m]; `None` without one."""
    radius = scene.rod.radius
    if limits is None or limits.bend_radius is None or radius is None:
        return None
    return (2 * float(limits.bend_radius) + 1) * largest_radius(radius)


def _bend_row(label: str, radius: float, scene: Scene, limits: Limits | None) -> Row:
    least = least_bend_radius(scene, limits)
    text = "straight" if not np.isfinite(radius) else metres(radius)
    if least is None:
        return Row(label, text)
    return Row(label, f"{text} of at least {metres(least)}", radius < least)


class _Clearance(NamedTuple):
    """From an obstacle [m], the force [N] with which it pushes the rod, `None` where it does not touch rods, and the
    least distance that a limit allows.
    """

    name: str
    distance: float
    push: float | None
    least: float | None

    @property
    def is_bad(self) -> bool:
        return self.least is not None and self.distance < self.least

    @property
    def margin(self) -> float:
        return self.distance - (self.least or 0.0)

    @property
    def text(self) -> str:
        between = " between nodes" if self.push is not None and self.distance < 0 else ""
        return metres(self.distance) + between + (f", pushed by {self.push:.3g} N" if self.push else "")


def _clearances(session: Session, number: int, limits: Limits | None) -> list[_Clearance]:
    """Of a rod, from the obstacles of its scene and those beside it."""
    least = None if limits is None or limits.clearance is None else np.asarray(limits.clearance)
    figures, found = session.figures[number], []
    touching = len(figures.obstacle_forces)
    names = [*(f"obstacle {k}" for k in range(touching)), *session.beside]
    # Limits are those of the obstacles beside the rod, where there are such.
    first = touching if session.beside else 0
    for k, (name, distance) in enumerate(zip(names, figures.clearances, strict=True)):
        push = float(np.linalg.norm(figures.obstacle_forces[k])) if k < touching else None
        limit = None if least is None or k < first else float(least if least.ndim == 0 else least[k - first])
        found.append(_Clearance(name, float(distance), push, limit))
    return found


def _clearance_rows(session: Session, limits: Limits | None) -> list[Row]:
    return [Row(f"clearance, {one.name}", one.text, one.is_bad) for one in _clearances(session, 0, limits)]


def _load_rows(session: Session, scene: Scene, limits: Limits | None) -> list[Row]:
    reading = session.reading
    forces = np.linalg.norm(reading.forces, axis=1)
    moments = np.linalg.norm(reading.moments, axis=1)
    found = []
    for k, name in enumerate(("start", "end")):
        found.append(_most(f"force, {name}", float(forces[k]), "N", limits, "end_force"))
        found.append(_most(f"moment, {name}", float(moments[k]), "N m", limits, "end_moment"))
    clips = [name for name, _, _ in held_places(scene) if name.startswith("clip")]
    for k, name in enumerate(clips):
        found.append(_most(f"force, {name}", float(forces[2 + k]), "N", limits, "clip_force"))
    return found


def _most(label: str, value: float, unit: str, limits: Limits | None, name: str) -> Row:
    limit = None if limits is None else getattr(limits, name)
    if limit is None:
        return Row(label, f"{value:.4g} {unit}")
    return Row(label, f"{value:.4g} of at most {float(limit):.4g} {unit}", value > float(limit))


def metres(value: float) -> str:
    """A length in the unit in which cables are drawn."""
    return f"{1e3 * value:.4g} mm" if abs(value) < 1 else f"{value:.4g} m"
