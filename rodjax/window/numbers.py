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
    if not isinstance(session.result, Equilibrium):
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
    most = max(range(len(forces)), key=lambda k: float(forces[k]))
    where = "start" if most == 0 else "end" if most == 1 else f"clip {most - 2}"
    load = _most(f"{name}: force, {where}", float(forces[most]), "N", limits, "end_force" if most < 2 else "clip_force")
    return [_bend_row(f"{name}: bend radius", radius, scene, limits), load]


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


def _clearance_rows(session: Session, limits: Limits | None) -> list[Row]:
    least = None if limits is None or limits.clearance is None else np.asarray(limits.clearance)
    figures, found = session.figures[0], []
    touching = len(figures.obstacle_forces)
    names = [*(f"obstacle {k}" for k in range(touching)), *session.beside]
    # Limits are those of the obstacles beside the rod, where there are such.
    first = touching if session.beside else 0
    for k, (name, clearance) in enumerate(zip(names, figures.clearances, strict=True)):
        text = metres(float(clearance))
        if k < touching:
            push = float(np.linalg.norm(figures.obstacle_forces[k]))
            text += " between nodes" if clearance < 0 else ""
            text += f", pushed by {push:.3g} N" if push else ""
        limit = None if least is None or k < first else float(least if least.ndim == 0 else least[k - first])
        found.append(Row(f"clearance, {name}", text, limit is not None and float(clearance) < limit))
    return found


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
