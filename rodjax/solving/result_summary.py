"""Equilibria in a few lines, with values and units: what `print` and notebooks show of them."""

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from rodjax.checks import is_known
from rodjax.model.summaries import counted, range_text, value_text
from rodjax.solving.status import Status

if TYPE_CHECKING:
    from rodjax.solving.harness_result import HarnessEquilibrium
    from rodjax.solving.result import Equilibrium

Told = list[tuple[str, str]]
NOT_KNOWN: Told = [("values", "not known inside jax.jit, vmap or grad")]


def told_text(title: str, told: Told) -> str:
    return "\n".join([title, *(f"  {name}: {line}" for name, line in told)])


def told_html(title: str, told: Told, pictures: Sequence[str] = ()) -> str:
    """The same as a table, for notebooks, with pictures behind it."""
    rows = "".join(
        f"<tr><td style='text-align:left'>{escape(name)}</td><td style='text-align:left'>{escape(line)}</td></tr>"
        for name, line in told
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>" + "".join(pictures)


def title_of(equilibrium: "Equilibrium") -> str:
    return f"Equilibrium of {_stack(equilibrium.s.shape[:-1])}{equilibrium.s.shape[-1] - 1} segments"


def values_told(equilibrium: "Equilibrium") -> Told:
    """What `print` shows: of several rods the range of each value. Nothing that takes a program to be computed."""
    if not is_known(equilibrium):
        return NOT_KNOWN
    told = [*_search_told(equilibrium), ("length", range_text(equilibrium.scene.rod.length, "m"))]
    told += [("energy", range_text(equilibrium.energy, "J"))]
    told += [
        (name.replace("_", " "), range_text(getattr(equilibrium, name), unit))
        for name, unit in (
            ("elastic_energy", "J"),
            ("total_twist", "rad"),
            ("curvature", "1/m"),
            ("tension", "N"),
            ("axial_strain", ""),
        )
    ]
    return told + [
        (f"{end} {kind}", _vectors(getattr(equilibrium, f"{end}_{kind}"), unit))
        for end in ("start", "end")
        for kind, unit in (("force", "N"), ("moment", "N m"))
    ]


def title_of_harness(result: "HarnessEquilibrium") -> str:
    cables, joints = counted(len(result.names), "cable"), counted(len(result.harness.joint_names), "joint")
    return f"Equilibrium of {_stack(result.energy.shape, 'harnesses')}{cables}, {joints}"


def harness_told(result: "HarnessEquilibrium") -> Told:
    """Of the whole, of each joint its position, and of each cable a line."""
    if not is_known(result):
        return NOT_KNOWN
    told = [*_search_told(result), ("energy", range_text(result.energy, "J"))]
    told += [(f"joint {name}", f"position {_ranges(body.position, 'm')}") for name, body in result.joints.items()]
    return told + [(name, _cable_told(rod)) for name, rod in result.items()]


def motion_text(displacement: Any) -> str:
    """Of a motion with its largest displacement: which node has it, and which way it goes."""
    displacement = np.asarray(displacement)
    k = int(np.argmax(np.sum(displacement**2, axis=-1)))
    # What is only rounding is no direction.
    way = np.round(displacement[k], 6)
    return f"{value_text(way)} at node {k} of {len(displacement) - 1}"


def _cable_told(rod: "Equilibrium") -> str:
    parts = [f"{rod.s.shape[-1] - 1} segments"]
    parts += [f"curvature {range_text(rod.curvature, '1/m')}", f"tension {range_text(rod.tension, 'N')}"]
    parts += [f"{end} force {_vectors(getattr(rod, f'{end}_force'), 'N')}" for end in ("start", "end")]
    return ", ".join(parts)


def _stack(shape: tuple[int, ...], name: str = "scenes") -> str:
    return f"{' x '.join(map(str, shape))} {name}, " if shape else ""


def _search_told(result: Any) -> Told:
    codes, counts = np.unique(np.asarray(result.status), return_counts=True)
    many = result.status.ndim > 0
    outcome = "; ".join(
        f"{count} {Status(code).message}" if many else Status(code).message
        for code, count in zip(codes, counts, strict=True)
    )
    return [
        ("status", outcome),
        ("residual", range_text(result.residual, "EI/L^2")),
        ("iterations", range_text(result.iterations)),
    ]


def _vectors(values: Any, unit: str) -> str:
    """A vector, or of several the range of their magnitudes."""
    values = np.asarray(values)
    if values.ndim > 1:
        return f"{range_text(np.linalg.norm(values, axis=-1), unit)} in magnitude"
    return value_text(values, unit)


def _ranges(values: Any, unit: str) -> str:
    """A vector, or of several the range of each component."""
    values = np.asarray(values)
    if values.ndim == 1:
        return value_text(values, unit)
    return f"({', '.join(range_text(column) for column in values.reshape(-1, values.shape[-1]).T)}) {unit}"
