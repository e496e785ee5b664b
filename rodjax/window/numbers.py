"""The numbers of a rod in the hand, each against its limit where there is one."""

from typing import NamedTuple

import numpy as np

from rodjax.plot import largest_radius
from rodjax.routing.limits import Limits
from rodjax.solving.status import Status
from rodjax.window.bounds import held_places
from rodjax.window.session import Report, Session


class Row(NamedTuple):
    """One number in words; `is_bad`: it breaks its limit, or warns."""

    label: str
    text: str
    is_bad: bool = False


def rows(session: Session, report: Report, limits: Limits | None = None) -> list[Row]:
    """All numbers that the window shows."""
    result, reading = session.result, report.reading
    status = Status(int(result.status))
    found = [Row("state", "at rest" if bool(result.converged) else status.message, not bool(result.converged))]
    if session.softest is not None:
        stability = None if limits is None else limits.stability
        is_low = session.is_soft or (stability is not None and session.softest < float(stability))
        remark = ", about to snap" if session.is_soft else ""
        found.append(Row("softest motion", f"{session.softest:.3g} N{remark}", is_low))
    elif not session.can_settle:
        found.append(Row("softest motion", "not known with these loads or clips"))
    found.append(_bend_row(session, reading.bend_radius, limits))
    found += _clearance_rows(session, report, limits)
    found += _load_rows(session, report, limits)
    strain = float(np.max(np.abs(np.asarray(result.axial_strain))))
    most = session.strain_limit if limits is None or limits.strain is None else float(limits.strain)
    twist = float(result.total_twist)
    found += [
        Row("total twist", f"{np.degrees(twist):.1f}°, {twist / (2 * np.pi):.2f} turns"),
        _most("twist rate", float(np.max(np.abs(reading.values["twist"]))), "rad/m", limits, "twist"),
        Row("axial strain", f"{100 * strain:.3g} %", strain > most),
        _most("elastic energy", float(result.elastic_energy), "J", limits, "energy"),
        Row("last move", f"{report.iterations} iterations, {report.milliseconds:.1f} ms"),
    ]
    return found


def least_bend_radius(session: Session, limits: Limits | None) -> float | None:
    """That of the centerline which a limit allows [m]; `None` without one."""
    radius = session.scene.rod.radius
    if limits is None or limits.bend_radius is None or radius is None:
        return None
    return (2 * float(limits.bend_radius) + 1) * largest_radius(radius)


def _bend_row(session: Session, radius: float, limits: Limits | None) -> Row:
    least = least_bend_radius(session, limits)
    text = "straight" if not np.isfinite(radius) else metres(radius)
    if least is None:
        return Row("smallest bend radius", text)
    return Row("smallest bend radius", f"{text} of at least {metres(least)}", radius < least)


def _clearance_rows(session: Session, report: Report, limits: Limits | None) -> list[Row]:
    least = None if limits is None or limits.clearance is None else np.asarray(limits.clearance)
    found = []
    for k, clearance in enumerate(report.reading.clearances):
        push = float(np.linalg.norm(report.reading.obstacle_forces[k]))
        text = metres(float(clearance)) + (" between nodes" if clearance < 0 else "")
        text += f", pushed by {push:.3g} N" if push else ""
        limit = None if least is None else float(least if least.ndim == 0 else least[k])
        found.append(Row(f"clearance, obstacle {k}", text, limit is not None and float(clearance) < limit))
    return found


def _load_rows(session: Session, report: Report, limits: Limits | None) -> list[Row]:
    reading = report.reading
    forces = np.linalg.norm(reading.forces, axis=1)
    moments = np.linalg.norm(reading.moments, axis=1)
    found = []
    for k, name in enumerate(("start", "end")):
        found.append(_most(f"force, {name}", float(forces[k]), "N", limits, "end_force"))
        found.append(_most(f"moment, {name}", float(moments[k]), "N m", limits, "end_moment"))
    clips = [name for name, _, _ in held_places(session.scene) if name.startswith("clip")]
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
