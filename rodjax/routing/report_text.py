"""A report of routes in words and tables, verdict first, in the units of engineers."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rodjax.analysis.pushes import Push
from rodjax.analysis.reactions import Reaction
from rodjax.checks import line
from rodjax.model.summaries import part_text, scene_text
from rodjax.routing.cable_report import Cable, Fact, Gradients
from rodjax.solving.result import Equilibrium
from rodjax.solving.status import Status
from rodjax.version import __version__

if TYPE_CHECKING:
    from rodjax.routing.report import Report

# Units in which numbers are told, and how many of them the SI unit is.
TOLD = {"m": ("mm", 1e3), "rad/m": ("deg/m", 180 / math.pi), "rad": ("deg", 180 / math.pi), "": ("%", 1e2)}
# Limits told by name in the verdict; of more the number.
MOST_NAMED = 3
# Design variables beside each other in the table of derivatives.
COLUMNS = 4
# Components of loads below this part of their size, or of EI/L^2 and EI/L, are told as 0.
ROUNDING = 1e-9
CHANGES = "Change of each margin by the design variables:"
SIGNS = {"least": ">=", "most": "<="}


def amount(value: float | None, unit: str) -> str:
    """A number in the unit in which it is told, with that unit."""
    shown, factor = TOLD.get(unit, (unit, 1.0))
    if value is None or not math.isfinite(value):
        return "-" if value is None or math.isnan(value) else ("infinite" if value > 0 else "-infinite")
    # Adding zero makes zeros of -0.
    return f"{factor * value + 0.0:.4g} {shown}"


def percent(margin: float, limit: float, unit: str) -> str:
    """A margin; of a limit of 0 it has the unit of that."""
    if not math.isfinite(margin):
        return "unlimited" if margin > 0 else "not a number"
    return f"{100 * margin:+.1f} %" if limit != 0 else f"+{amount(margin, unit)}".replace("+-", "-")


def verdict(report: "Report") -> str:
    """Whether all limits are kept, and which of them are the tightest or are not."""
    lost = [cable for cable in report.cables if not cable.converged]
    if lost:
        names = f" for {', '.join(cable.name for cable in lost)}" if len(report.cables) > 1 else ""
        return f"NOT converged{names}: the numbers below are not those of an equilibrium"
    shaky = [cable for cable in report.cables if is_unstable(cable.equilibrium)]
    names = f" of {', '.join(cable.name for cable in shaky)}" if len(report.cables) > 1 else ""
    remark = f"; but the equilibrium{names} is NOT stable" if shaky else ""
    taut = [cable for cable in report.cables if _is_overstretched(cable)]
    names = f" in {', '.join(cable.name for cable in taut)}" if len(report.cables) > 1 else ""
    strain = max((float(np.max(np.abs(cable.equilibrium.axial_strain))) for cable in taut), default=0.0)
    remark += f"; but the axial strain{names} reaches {100 * strain:.3g} %, which has no limit here" if taut else ""
    within = [cable for cable in report.cables if cable.within > 0]
    if within:
        deepest = max(within, key=lambda cable: cable.within)
        name = f"{deepest.name} lies" if len(report.cables) > 1 else "it lies"
        remark += (
            f"; but {name} {amount(deepest.within, 'm')} within an obstacle, which pushes nothing and has no limit here"
        )
    return _kept_or_not(report) + remark


def _is_overstretched(cable: Cable) -> bool:
    """Whether it is strained by more than its solve takes without a remark, and no limit of the report says so."""
    has_limit = cable.limits is not None and cable.limits.strain is not None
    return int(cable.equilibrium.status) == Status.OVERSTRETCHED and not has_limit


def is_unstable(equilibrium: Equilibrium) -> bool:
    """Whether the energy falls along some motion, where that is examined."""
    return int(equilibrium.index) > 0


def _kept_or_not(report: "Report") -> str:
    if report.kept is None:
        return "no limits given"
    rows = [(margin, *_of(cable, k, len(report.cables) > 1)) for cable in report.cables for k, margin in _rows(cable)]
    broken = sorted((row for row in rows if not row[0] >= 0), key=lambda row: (not math.isnan(row[0]), row[0]))
    if not broken:
        _, name, told = min(rows)
        return f"kept: {_all(len(rows))}; tightest: {name}, {told}"
    told = "; ".join(f"{name}, {told}" for _, name, told in broken[:MOST_NAMED])
    more = f"; and {len(broken) - MOST_NAMED} more" if len(broken) > MOST_NAMED else ""
    return f"NOT kept: {len(broken)} of {len(rows)} {'limit' if len(rows) == 1 else 'limits'}: {told}{more}"


def _all(count: int) -> str:
    return "the one limit" if count == 1 else f"all {count} limits"


def _rows(cable: Cable) -> list[tuple[int, float]]:
    return [] if cable.margins is None else list(enumerate(np.asarray(cable.margins.margin).tolist()))


def _of(cable: Cable, k: int, has_name: bool) -> tuple[str, str]:
    """The name of a limit, and what it asks for beside what there is."""
    assert cable.margins is not None
    kind, unit = cable.margins.kinds[k], cable.margins.units[k]
    value, limit, margin, s = (float(getattr(cable.margins, name)[k]) for name in ("value", "limit", "margin", "s"))
    name = cable.margins.names[k]
    place = f" at s = {amount(s, 'm')}" if math.isfinite(s) else ""
    told = f"{amount(value, unit)} of at {kind} {amount(limit, unit)} ({percent(margin, limit, unit)}){place}"
    return f"{cable.name}: {name}" if has_name else name, told


def text(report: "Report") -> str:
    parts = [report.title, f"{report.verdict}\n{made(report)}"]
    if report.design is not None:
        parts.append("\n".join(_design(report.design)))
    for cable in report.cables:
        heading = [f"--- {cable.name}: {_kept(cable)}"] if len(report.cables) > 1 else []
        parts.append("\n".join([*heading, cable.outcome]))
        told = (
            _limits(cable),
            _facts(cable),
            _reactions(cable),
            _pushes(cable),
            gradients(cable),
            _inputs(report, cable),
        )
        parts += [part for part in told if part]
    return "\n\n".join(["\n".join(parts[:2]), *parts[2:]])


def made(report: "Report") -> str:
    """When, by what and of what a report was made."""
    source = "" if report.source is None else f" of {report.source}"
    return f"made on {report.date} by rodjax {__version__}{source}"


def inputs(report: "Report", cable: Cable) -> list[tuple[str, str]]:
    """What a cable was computed from: its scene part by part, the obstacles, and the mesh."""
    rows = scene_text(cable.equilibrium.scene).split("\n  ")[1:]
    pairs = [row.split(": ", 1) for row in rows]
    told = [(name.lower(), text) for name, text in pairs]
    told += [
        (f"obstacle {line(name)}", part_text(obstacle))
        for name, obstacle in zip(report.names, report.obstacles, strict=True)
    ]
    count = cable.equilibrium.s.shape[-1] - 1
    return [*told, ("mesh", f"{count} segments ({cable.equilibrium.discretization.replace('_', ' ')})")]


def _inputs(report: "Report", cable: Cable) -> str:
    return "\n".join(["inputs, in SI units", table(inputs(report, cable), "<<")])


def _kept(cable: Cable) -> str:
    if not cable.converged:
        return "NOT converged"
    return {None: "no limits", True: "kept", False: "NOT kept"}[cable.kept]


def _limits(cable: Cable) -> str:
    if cable.margins is None:
        return ""
    rows = [("limit", "value", "", "asked", "margin", "at s", "")]
    columns = (cable.margins.names, cable.margins.kinds, cable.margins.units)
    numbers = (np.asarray(getattr(cable.margins, name)) for name in ("value", "limit", "margin", "s"))
    for name, kind, unit, value, limit, margin, s in zip(*columns, *numbers, strict=True):
        place = amount(float(s), "m") if np.isfinite(s) else ""
        told = percent(float(margin), float(limit), unit)
        remark = "" if margin >= 0 else "NOT KEPT"
        rows.append((name, amount(float(value), unit), SIGNS[kind], amount(float(limit), unit), told, place, remark))
    return table(rows, "<>>>>><")


def _facts(cable: Cable) -> str:
    return table([(fact.name, amount(fact.value, fact.unit), _where(fact)) for fact in cable.facts], "<><")


def _where(fact: Fact) -> str:
    place = f"at s = {amount(fact.s, 'm')}" if fact.s is not None else ""
    return ", ".join(part for part in (fact.note, place) if part)


def _reactions(cable: Cable) -> str:
    units = cable.equilibrium.state.units
    rows: list[tuple[str, ...]] = [
        ("what supports apply to the cable", "force [N]", "", "", "magnitude", "moment [N m]", "", "", "magnitude")
    ]
    for reaction in cable.reactions:
        cells, own = [f"{support(reaction)}, axes x, y, z"], ["  tangent, left, up"]
        for load, unit in ((reaction.force, units.force), (reaction.moment, units.energy)):
            size = float(np.linalg.norm(load))
            # Of what is smaller nothing but rounding is left.
            least = ROUNDING * max(size, float(unit))
            cells += [above(x, least) for x in (*load, size)]
            own += [*(above(x, least) for x in reaction.axes @ load), ""]
        rows += [tuple(cells), tuple(own)]
    axes: list[tuple[str, ...]] = [("axes of the supports", "tangent", "", "", "left", "", "", "up", "", "")]
    axes += [
        (reaction.name, *(f"{round(float(x), 4) + 0.0:.4f}" for x in reaction.axes.ravel()))
        for reaction in cable.reactions
    ]
    told = "Moments are about the centerline; left is level, up the normal at right angles to it and to the tangent."
    return "\n".join([table(rows, "<>>>>>>>>"), told, table(axes, "<>>>>>>>>>")])


def _pushes(cable: Cable) -> str:
    if not cable.pushes:
        return ""
    rows: list[tuple[str, ...]] = [
        ("what obstacles apply to the cable, axes x, y, z", "force [N]", "", "", "magnitude")
    ]
    for push in cable.pushes:
        size = float(np.linalg.norm(push.force))
        rows.append((stretch(push), *(above(float(x), ROUNDING * size) for x in (*push.force, size))))
    return table(rows, "<>>>>")


def stretch(push: Push) -> str:
    first, last = amount(push.first, "m"), amount(push.last, "m")
    return f"{push.name} " + (f"at s = {first}" if first == last else f"between s = {first} and {last}")


def support(reaction: Reaction) -> str:
    kind = "" if reaction.kind == "clip" else f" ({reaction.kind})"
    return f"{reaction.name}{kind} at s = {amount(reaction.s, 'm')}"


def above(x: float, least: float) -> str:
    return f"{x:.4g}" if abs(x) > least else "0"


def gradients(cable: Cable) -> str:
    """A table of the derivatives of margins by design variables, where there are some."""
    if cable.gradients is None:
        return ""
    found = cable.gradients
    parts = [table(rows, "<" + ">" * (len(rows[0]) - 1)) for rows in derivatives(found)]
    between = [] if found.ranges is None else [""]
    return "\n".join([*_design(found), *between, CHANGES, *parts])


def _design(gradients: Gradients) -> list[str]:
    """Whether it is an optimum, and a table of `ranges`; nothing of what is not of a route."""
    bounds = [table(rows, "<>>><")] if (rows := ranges(gradients)) else []
    return [*([gradients.remark] if gradients.remark else []), *bounds]


def ranges(gradients: Gradients) -> list[tuple[str, ...]]:
    """What a route found, between which bounds, and which of them hold it; nothing of what is not of a route."""
    if gradients.ranges is None:
        return []
    rows: list[tuple[str, ...]] = [("design variable", "found", "lower bound", "upper bound", "")]
    each = zip(gradients.variables, gradients.units, gradients.values, gradients.ranges, gradients.active, strict=True)
    for name, unit, value, bounds, active in each:
        # Numbers without a unit are told as they are, not in percent as strains.
        cells = [amount(float(x), unit) if unit else f"{float(x):.4g}" for x in (value, *bounds)]
        rows.append((name, *cells, f"at its {active} bound" if active else ""))
    return rows


def derivatives(gradients: Gradients) -> list[list[tuple[str, ...]]]:
    """Rows of tables, each of a few design variables: what they are, and by how much they change each margin."""
    count = len(gradients.variables)
    return [_columns(gradients, range(k, min(k + COLUMNS, count))) for k in range(0, count, COLUMNS)]


def _columns(gradients: Gradients, which: Sequence[int]) -> list[tuple[str, ...]]:
    # Numbers without a unit are told as they are, not in percent as strains.
    units = [TOLD.get(gradients.units[k] or "1", (gradients.units[k] or "1", 1.0)) for k in which]
    values = [
        f"{factor * float(gradients.values[k]):.4g}{'' if unit == '1' else f' {unit}'}"
        for k, (unit, factor) in zip(which, units, strict=True)
    ]
    rows = [("", *(gradients.variables[k] for k in which)), ("now", *values)]
    for name, row in zip(gradients.margins, np.asarray(gradients.derivatives), strict=True):
        cells = [f"{100 * row[k] / factor + 0.0:+.3g} %/{unit}" for k, (unit, factor) in zip(which, units, strict=True)]
        rows.append((name, *cells))
    return rows


def table(rows: Sequence[Sequence[str]], sides: str) -> str:
    """Rows of cells, each column aligned to its side."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(sides))]
    return "\n".join(
        "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)).rstrip()
        for row in rows
    )
