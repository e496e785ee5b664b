"""A report of routes as plain data, for JSON and CSV, in SI units."""

import csv
import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from rodjax.routing.cable_report import Cable, Gradients
from rodjax.routing.report_text import inputs
from rodjax.solving.status import Status
from rodjax.version import __version__

if TYPE_CHECKING:
    from rodjax.routing.report import Report

HEADER = ("cable", "kind", "name", "value", "unit", "asked", "limit", "margin", "s [m]", "note")


def plain(value: Any) -> Any:
    """Numbers as JSON knows them, which has none that is no number."""
    if np.ndim(value):
        return [plain(x) for x in value]
    if value is None:
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def as_dict(report: "Report") -> dict[str, Any]:
    return {
        "title": report.title,
        "verdict": report.verdict,
        "kept": report.kept,
        "date": report.date,
        "version": __version__,
        "source": report.source,
        "converged": all(cable.converged for cable in report.cables),
        "margins": {name: plain(margin) for name, margin in report.margins.items()},
        "cables": [_cable(report, cable) for cable in report.cables],
    }


def _cable(report: "Report", cable: Cable) -> dict[str, Any]:
    return {
        "name": cable.name,
        "kept": cable.kept,
        "converged": cable.converged,
        "stable": bool(cable.equilibrium.stable),
        "status": Status(int(cable.equilibrium.status)).name.lower(),
        "outcome": cable.outcome,
        "limits": _limits(cable),
        "facts": {
            fact.name: {"value": plain(fact.value), "unit": fact.unit, "s": plain(fact.s), "note": fact.note}
            for fact in cable.facts
        },
        "supports": [
            {
                "name": reaction.name,
                "kind": reaction.kind,
                "s": reaction.s,
                "position": plain(reaction.position),
                "force": plain(reaction.force),
                "moment": plain(reaction.moment),
                "force_magnitude": plain(np.linalg.norm(reaction.force)),
                "moment_magnitude": plain(np.linalg.norm(reaction.moment)),
                "axes": dict(zip(("tangent", "left", "up"), plain(reaction.axes), strict=True)),
                "force_in_axes": plain(reaction.axes @ reaction.force),
                "moment_in_axes": plain(reaction.axes @ reaction.moment),
            }
            for reaction in cable.reactions
        ],
        "contacts": [
            {
                "name": push.name,
                "first": push.first,
                "last": push.last,
                "position": plain(push.position),
                "force": plain(push.force),
                "force_magnitude": plain(np.linalg.norm(push.force)),
            }
            for push in cable.pushes
        ],
        "inputs": dict(inputs(report, cable)),
        "gradients": None if cable.gradients is None else _gradients(cable.gradients),
    }


def _limits(cable: Cable) -> list[dict[str, Any]]:
    found = cable.margins
    if found is None:
        return []
    return [
        {
            "name": name,
            "unit": found.units[k],
            "kind": found.kinds[k],
            "value": plain(found.value[k]),
            "limit": plain(found.limit[k]),
            "margin": plain(found.margin[k]),
            "kept": bool(found.margin[k] >= 0),
            "s": plain(found.s[k]),
        }
        for k, name in enumerate(found.names)
    ]


def _gradients(gradients: Gradients) -> dict[str, Any]:
    derivatives = np.asarray(gradients.derivatives)
    return {
        variable: {
            "unit": gradients.units[j],
            "value": plain(gradients.values[j]),
            "margins": dict(zip(gradients.margins, plain(derivatives[:, j]), strict=True)),
        }
        for j, variable in enumerate(gradients.variables)
    }


def csv_text(report: "Report") -> str:
    """One row for each number, in SI units; cells are empty where there is none."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(HEADER)
    for cable in report.cables:
        rows: list[tuple[Any, ...]] = [
            ("limit", *(row[key] for key in ("name", "value", "unit", "kind", "limit", "margin", "s")), "")
            for row in _limits(cable)
        ]
        rows += [("fact", f.name, plain(f.value), f.unit, None, None, None, plain(f.s), f.note) for f in cable.facts]
        for reaction in cable.reactions:
            for kind, load, unit in (("force", reaction.force, "N"), ("moment", reaction.moment, "N m")):
                own = reaction.axes @ load
                values = dict(zip("xyz", load, strict=True)) | {"magnitude": np.linalg.norm(load)}
                values |= dict(zip(("tangent", "left", "up"), own, strict=True))
                rows += [
                    (kind, f"{reaction.name} {axis}", plain(value), unit, None, None, None, reaction.s, reaction.kind)
                    for axis, value in values.items()
                ]
        for push in cable.pushes:
            middle, values = (push.first + push.last) / 2, dict(zip("xyz", push.force, strict=True))
            values |= {"magnitude": np.linalg.norm(push.force)}
            rows += [
                ("contact", f"{push.name} {axis}", plain(value), "N", None, None, None, middle, "")
                for axis, value in values.items()
            ]
        if cable.gradients is not None:
            for variable, of in _gradients(cable.gradients).items():
                unit = f"1/({of['unit']})" if of["unit"] else ""
                rows += [
                    ("gradient", f"{name} by {variable}", value, unit, None, None, None, None, "")
                    for name, value in of["margins"].items()
                ]
        for row in rows:
            writer.writerow(["" if cell is None else cell for cell in (cable.name, *row)])
    return file.getvalue()
