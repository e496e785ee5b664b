"""A report of routes as one page that turns with the mouse and loads nothing."""

import importlib.resources
import io
import json
import math
import re
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.colors import Colormap, to_hex

from rodjax.drawing import ARROW_LENGTH, CLIP_COLOR, ELEVATION, PALETTE
from rodjax.model.surfaces import Faces
from rodjax.routing import report_text
from rodjax.routing.cable_report import Cable, Gradients
from rodjax.routing.records import plain
from rodjax.routing.view_data import (
    CableView,
    Coloring,
    azimuth,
    clip_faces,
    coloring,
    extent,
    seen_surfaces,
    thickness_note,
)

TEMPLATE = "page.html"
OPACITY = 0.3
# Colors of the legend, and digits of lengths by the extent of the scene.
COLORS, DIGITS = 61, 1e-5
TICKS = 4


def web_page(report: Any, cable_views: Sequence[CableView]) -> str:
    """The page. Names in it are escaped, the scene is JSON in it."""
    colors = coloring(cable_views)
    scene = _scene(report, cable_views, colors)
    # In a script nothing but the end of it is looked for.
    data = json.dumps(scene, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "TITLE": escape(report.title),
        "LABEL": escape(colors.label),
        "TICKS": _ticks(colors),
        "NOTE": escape(thickness_note(cable_views)),
        "PANEL": _panel(report),
        "DATA": data,
    }
    page = importlib.resources.files("rodjax.routing").joinpath(TEMPLATE).read_text(encoding="utf-8")
    # What is put in is not looked through again: a name may be "@DATA@".
    return re.sub("@([A-Z]+)@", lambda match: parts[match[1]], page)


# --- the scene -------------------------------------------------------------------------------------------------------


def _scene(report: Any, cable_views: Sequence[CableView], colors: Coloring) -> dict[str, Any]:
    size, drawn = extent([cable_view.equilibrium for cable_view in cable_views]), [*report.drawn.values()]
    decimals = max(0, -math.floor(math.log10(DIGITS * size)))
    obstacles = [
        _surface(faces, PALETTE[k % len(PALETTE)], OPACITY, decimals)
        for k, faces in enumerate(seen_surfaces(cable_views, drawn))
    ]
    clips = [
        _surface(faces, CLIP_COLOR, 1.0, decimals) for cable_view in cable_views for faces in clip_faces(cable_view)
    ]
    forces = _forces(cable_views, ARROW_LENGTH * size, decimals)
    corners = [cable_view.centerline for cable_view in cable_views]
    corners += [np.reshape(surface["vertices"], (-1, 3)) for surface in obstacles]
    corners += [np.reshape([force["tip"] for force in forces], (-1, 3))]
    everything = np.concatenate(corners)
    low, high = everything.min(axis=0), everything.max(axis=0)
    return {
        "azimuth": azimuth(cable_views, drawn),
        "elevation": ELEVATION,
        "center": _rounded((low + high) / 2, decimals),
        "size": float(np.linalg.norm(high - low)),
        "colors": [to_hex(color) for color in _map(colors)(np.linspace(0.0, 1.0, COLORS))],
        "cables": [_cable(cable_view, colors, decimals) for cable_view in cable_views],
        "obstacles": obstacles,
        "clips": clips,
        "forces": forces,
        "labels": _labels(cable_views, decimals),
    }


def _map(colors: Coloring) -> Colormap:
    return colormaps[colors.color_map] if isinstance(colors.color_map, str) else colors.color_map


def _rounded(values: np.ndarray, decimals: int) -> Any:
    # Adding zero makes zeros of -0.
    return (np.round(np.asarray(values, float), decimals) + 0.0).tolist()


def _significant(values: np.ndarray) -> list[float | None]:
    return [None if x is None else float(f"{x:.5g}") for x in plain(values)]


def _cable(cable_view: CableView, colors: Coloring, decimals: int) -> dict[str, Any]:
    return {
        "name": cable_view.name,
        "points": _rounded(cable_view.centerline, decimals),
        "radii": _rounded(cable_view.radii, decimals + 1),
        "colors": [to_hex(color) for color in colors.of(cable_view, (cable_view.s[:-1] + cable_view.s[1:]) / 2)],
        "s": _significant(cable_view.s),
        "bend": _significant(cable_view.bend),
        "inside": cable_view.equilibrium.scene.rod.radius is not None,
        "margins": None if cable_view.margin is None else _significant(cable_view.margin),
        "tension": _significant(cable_view.tension),
    }


def _surface(faces: Faces, color: str, opacity: float, decimals: int) -> dict[str, Any]:
    corners, index = np.unique(np.round(faces.reshape(-1, 3), decimals) + 0.0, axis=0, return_inverse=True)
    rows = [list(dict.fromkeys(row)) for row in index.reshape(-1, 4).tolist()]
    return {
        "color": color,
        "opacity": opacity,
        "vertices": _rounded(corners, decimals),
        "faces": [row for row in rows if len(row) > 2],
    }


def _forces(cable_views: Sequence[CableView], length: float, decimals: int) -> list[dict[str, Any]]:
    acting = [force for cable_view in cable_views for force in cable_view.forces]
    sizes = [float(np.linalg.norm(one.force)) for one in acting]
    return [
        {
            "foot": _rounded(one.position, decimals),
            "tip": _rounded(one.position + length / max(sizes) * one.force, decimals),
            "label": f"{size:.3g} N",
        }
        for one, size in zip(acting, sizes, strict=True)
    ]


def _labels(cable_views: Sequence[CableView], decimals: int) -> list[dict[str, Any]]:
    labels = []
    for cable_view in cable_views:
        labels += [(reaction.name, reaction.position) for reaction in cable_view.reactions[1:-1]]
        if len(cable_views) > 1:
            labels.append((cable_view.name, cable_view.centerline[len(cable_view.centerline) // 2]))
    return [{"text": text, "at": _rounded(at, decimals)} for text, at in labels]


# --- what stands beside it -------------------------------------------------------------------------------------------


def _ticks(colors: Coloring) -> str:
    low, high = float(colors.norm.vmin or 0.0), float(colors.norm.vmax or 1.0)
    values = [low, 0.0, 0.5 * high, high] if colors.is_margin else np.linspace(low, high, TICKS).tolist()
    told = [f"{100 * x:.0f} %" if colors.is_margin else f"{x:.3g}" for x in values]
    if colors.is_margin:
        told[0], told[-1] = f"≤ {told[0]}", f"≥ {told[-1]}"
    offsets = [100 * (x - low) / (high - low) for x in values]
    return "".join(f'<span style="left:{place:.4g}%">{text}</span>' for place, text in zip(offsets, told, strict=True))


def _panel(report: Any) -> str:
    kind = {None: "", True: ' class="kept"', False: ' class="broken"'}[report.kept]
    parts = [f"<h1>{escape(report.title)}</h1>", f'<p id="verdict"{kind}>{escape(report.verdict)}</p>']
    parts.append(f'<p class="soft">{escape(report_text.made(report))}</p>')
    if report.design is not None:
        parts.append("<h2>design</h2>" + _found(report.design))
    for k, cable in enumerate(report.cables):
        if len(report.cables) > 1:
            parts.append(f"<h2>{escape(cable.name)}</h2>")
        parts += [_limits(cable, k), _facts(cable, k), _supports(cable), _pushes(cable, k)]
        if cable.gradients is not None:
            parts.append(_gradients(cable.gradients))
        parts.append(f'<p class="soft">{escape(cable.outcome)}</p>')
        rows = [_row([name, text], k, None) for name, text in report_text.inputs(report, cable)]
        parts.append("<h2>inputs</h2>" + _table(("", ">SI units"), rows, ' class="inputs"'))
    if report.drawn:
        boxes = "".join(
            f'<li><label><input type="checkbox" checked data-obstacle="{k}">'
            f'<span class="swatch" style="background:{PALETTE[k % len(PALETTE)]}"></span>{escape(name)}</label></li>'
            for k, name in enumerate(report.drawn)
        )
        parts.append(f"<h2>obstacles</h2><ul>{boxes}</ul>")
    parts.append(f'<div id="along"><h2>along the cable</h2>{_diagrams(report)}</div>')
    return "\n".join(part for part in parts if part)


def _table(heads: Sequence[str], rows: Sequence[str], kind: str = "") -> str:
    head = "".join(f'<th class="number">{h[1:]}</th>' if h.startswith(">") else f"<th>{h}</th>" for h in heads)
    return f"<table{kind}><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _row(cells: Sequence[str], number: int, s: float | None, kind: str = "") -> str:
    """Cells after the first are numbers; where there is an arclength, the place can be looked at."""
    has_place = s is not None and math.isfinite(s)
    kinds = " ".join(name for name in (kind, "place" if has_place else "") if name)
    place = f' data-cable="{number}" data-s="{s:.6g}"' if has_place else ""
    told = f"<td>{escape(cells[0])}</td>" + "".join(f'<td class="number">{escape(cell)}</td>' for cell in cells[1:])
    return f'<tr class="{kinds}"{place}>{told}</tr>'


def _limits(cable: Cable, number: int) -> str:
    found = cable.margins
    if found is None:
        return ""
    rows = []
    for k, name in enumerate(found.names):
        value, limit, margin, s = (float(getattr(found, field)[k]) for field in ("value", "limit", "margin", "s"))
        sign = {"least": "≥", "most": "≤"}[found.kinds[k]]
        cells = [
            name,
            report_text.amount(value, found.units[k]),
            f"{sign} {report_text.amount(limit, found.units[k])}",
            report_text.percent(margin, limit, found.units[k]),
            report_text.amount(s, "m"),
        ]
        rows.append(_row(cells, number, s, "" if margin >= 0 else "broken"))
    return _table(("limit", ">value", ">asked", ">margin", ">at s"), rows)


def _facts(cable: Cable, number: int) -> str:
    rows = []
    for fact in cable.facts:
        name = f"{fact.name}, {fact.note}" if fact.note else fact.name
        place = "" if fact.s is None else report_text.amount(fact.s, "m")
        rows.append(_row([name, report_text.amount(fact.value, fact.unit), place], number, fact.s))
    return "<h2>shape</h2>" + _table(("", ">value", ">at s"), rows)


def _supports(cable: Cable) -> str:
    """For each support a block: force and moment by component, in the axes of the scene and in its own."""
    rows = []
    for reaction in cable.reactions:
        rows.append(f'<tr class="support"><td colspan="6">{escape(report_text.support(reaction))}</td></tr>')
        for name, load, unit in (("force", reaction.force, "N"), ("moment", reaction.moment, "N m")):
            least = report_text.ROUNDING * float(np.linalg.norm(load))
            for axes, values in (("x, y, z", load), ("tangent, left, up", reaction.axes @ load)):
                magnitude = report_text.amount(float(np.linalg.norm(load)), unit) if values is load else ""
                cells = [f"{name} [{unit}]" if values is load else "", axes]
                cells += [*(report_text.above(float(x), least) for x in values), _unbroken(magnitude)]
                rows.append(_row(cells, 0, None))
    heads = ("what supports apply", ">axes", ">1", ">2", ">3", ">magnitude")
    return "<h2>supports</h2>" + _table(heads, rows, ' class="vectors"')


def _pushes(cable: Cable, number: int) -> str:
    """For each stretch of contact a block, that can be looked at."""
    if not cable.pushes:
        return ""
    rows = []
    for push in cable.pushes:
        size = float(np.linalg.norm(push.force))
        rows.append(f'<tr class="support"><td colspan="5">{escape(report_text.stretch(push))}</td></tr>')
        numbers = [report_text.above(float(x), report_text.ROUNDING * size) for x in push.force]
        cells = ["force [N]", *numbers, _unbroken(report_text.amount(size, "N"))]
        rows.append(_row(cells, number, (push.first + push.last) / 2))
    heads = ("what obstacles apply", ">x", ">y", ">z", ">magnitude")
    return "<h2>contacts</h2>" + _table(heads, rows, ' class="vectors"')


def _gradients(gradients: Gradients) -> str:
    """What a route found, and by how much each design variable changes each margin."""
    told = f"<p>{escape(report_text.CHANGES)}</p>"
    return "".join(["<h2>design</h2>", _found(gradients), told, *map(_design, report_text.derivatives(gradients))])


def _found(gradients: Gradients) -> str:
    """Whether it is an optimum, and between which bounds the design lies."""
    bounds = report_text.ranges(gradients)
    remark = f'<p class="soft">{escape(gradients.remark)}</p>' if gradients.remark else ""
    return remark + (_design(bounds) if bounds else "")


def _design(rows: Sequence[Sequence[str]]) -> str:
    heads = [escape(rows[0][0]), *(f">{escape(name)}" for name in rows[0][1:])]
    return _table(heads, [_row(row, 0, None) for row in rows[1:]], ' class="vectors design"')


def _diagrams(report: Any) -> str:
    """Inline, as the page loads nothing."""
    image = io.StringIO()
    with rc_context({"svg.hashsalt": "rodjax", "svg.fonttype": "none", "font.family": "sans-serif"}):
        report.along().savefig(image, format="svg", metadata={"Date": None, "Creator": None})
    text = image.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub("<metadata>.*?</metadata>", "", text, flags=re.S)
    return re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)


def _unbroken(told: str) -> str:
    return told.replace(" ", "\u00a0")
