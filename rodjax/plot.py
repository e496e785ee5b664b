"""Pictures of equilibria, as matplotlib figures without pyplot: save them with `figure.savefig("rod.png")`."""

import base64
import io
from collections.abc import Sequence
from typing import cast

import equinox as eqx
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from rodjax.checks import instance, positive
from rodjax.drawing import (
    COLOR_MAP,
    HALO,
    LABELS,
    Field,
    color_limits,
    draw_end_loads,
    draw_tube,
    largest_radius,
    set_view,
    surroundings,
    thickness,
)
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium

STAGES = ["circle segment", "upside-down Omega, no twist"]
STAGES += [f"end frame turned by {turn}°" for turn in (90, 180, 270, 360)]


def plot_rod(
    equilibrium: Equilibrium,
    *,
    color_by: Field = "curvature",
    loads: bool = False,
    radius: float | None = None,
    axes: Axes3D | None = None,
) -> Figure:
    """One equilibrium as a shaded tube of equal scale on all axes.

    **Arguments:**

    - `equilibrium`: a single one; of a path, take one with `jax.tree.map(lambda leaf: leaf[k], path)`.
    - `color_by`: `"curvature"`, `"twist"` or `"tension"`.
    - `loads`: draw the forces and moments (two-headed arrows) that act on the rod at its ends, with their magnitude.
    - `radius` [m] of the tube, of a rod whose radius varies at the thickest place; `None`: that of the rod, or thicker
      than life, 1.8 % of the picture, where the rod would be too thin to see: the figure says so.
    - `axes`: 3-D axes to draw in; `None`: a new figure.

    The black strip runs along the director d1, the white one along -d1: where the rod twists they wind around it. Clips
    are dark collars. Obstacles are translucent, and drawn as far as they are near the rod.
    Raises `ValueError` or `TypeError` for arguments that make no sense.
    """
    _check(equilibrium, "equilibrium", color_by)
    if axes is None:
        axes = Figure(figsize=(7, 5), layout="constrained").add_subplot(projection="3d")
    instance(axes, "axes", Axes3D)
    radius, note = thickness([equilibrium], None if radius is None else float(positive(radius, "radius")))
    norm = Normalize(*color_limits(getattr(equilibrium, color_by)))
    points = [draw_tube(axes, equilibrium, radius, color_by, norm, surroundings(equilibrium, radius))]
    if loads:
        points.append(draw_end_loads(axes, equilibrium))
    set_view(axes, np.concatenate(points))
    axes.text2D(0.0, 0.0, note, transform=axes.transAxes, fontsize=8, color="0.4")
    figure = cast(Figure, axes.get_figure(root=True))
    figure.colorbar(ScalarMappable(norm, COLOR_MAP), ax=axes, label=LABELS[color_by], shrink=0.6, pad=0.08)
    return figure


def picture_html(equilibrium: Equilibrium) -> str:
    """A picture of one equilibrium with its loads, as HTML; nothing where it has no numbers."""
    if not np.all(np.isfinite(np.asarray(equilibrium.nodes))):
        return ""
    content = io.BytesIO()
    plot_rod(equilibrium, loads=True).savefig(content, format="png", dpi=80)
    encoded = base64.b64encode(content.getvalue()).decode()
    return f'<img alt="the rod, coloured by curvature" src="data:image/png;base64,{encoded}">'


def plot_harness(result: HarnessEquilibrium, *, color_by: Field = "curvature", radius: float | None = None) -> Figure:
    """All rods of one equilibrium of a harness in one picture, with one scale of length and colour, and their names;
    obstacles near the first rod that has them.

    `color_by` as for `plot_rod`; `radius` [m]: of the thickest. Raises `ValueError` or `TypeError` for arguments that
    make no sense.
    """
    instance(result, "result", HarnessEquilibrium)
    if result.energy.ndim:
        raise ValueError(f"result must be a single equilibrium, got a stack of shape {result.energy.shape}")
    rods = result.values()
    for name, rod in result.items():
        _check(rod, f"result[{name!r}]", color_by)
    axes = Figure(figsize=(8, 6), layout="constrained").add_subplot(projection="3d")
    assert isinstance(axes, Axes3D)
    true = [0.0 if rod.scene.rod.radius is None else largest_radius(rod.scene.rod.radius) for rod in rods]
    first = int(np.argmax(true))
    by_size = [rods[first], *rods]
    thick, note = thickness(by_size, None if radius is None else float(positive(radius, "radius")))
    norm = Normalize(*color_limits(np.concatenate([getattr(rod, color_by) for rod in rods])))
    points, drawn = [], []
    for (name, rod), own in zip(result.items(), true, strict=True):
        radius = thick * own / true[first] if own else thick
        new = [obstacle for obstacle in rod.scene.obstacles if not any(eqx.tree_equal(obstacle, one) for one in drawn)]
        drawn += new
        points.append(draw_tube(axes, rod, radius, color_by, norm, surroundings(rod, radius, tuple(new))))
        middle = np.asarray(rod.nodes)[len(rod.s) // 2]
        x, y, z = map(float, middle)
        axes.text(x, y, z, name, fontsize=8, path_effects=[HALO], zorder=10)
    set_view(axes, np.concatenate(points))
    axes.text2D(0.0, 0.0, note, transform=axes.transAxes, fontsize=8, color="0.4")
    figure = cast(Figure, axes.get_figure(root=True))
    figure.colorbar(ScalarMappable(norm, COLOR_MAP), ax=axes, label=LABELS[color_by], shrink=0.6, pad=0.08)
    return figure


def plot_along(equilibrium: Equilibrium) -> Figure:
    """Curvature, twist rate and tension of one equilibrium over the arclength."""
    _check(equilibrium, "equilibrium")
    figure = Figure(figsize=(6, 6), layout="constrained")
    s = np.asarray(equilibrium.s)
    panels = figure.subplots(len(LABELS), 1, sharex=True)
    for axes, (name, label) in zip(panels, LABELS.items(), strict=True):
        values = np.asarray(getattr(equilibrium, name))
        low, high = color_limits(values)
        margin = 0.05 * (high - low)
        axes.plot(s, values, marker="." if len(s) < 60 else None)
        axes.set(ylabel=label, ylim=(low - margin, high + margin), xlim=(s[0], s[-1]))
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.grid(color="0.9")
    panels[-1].set_xlabel("arclength s [m]")
    figure.align_ylabels()
    return figure


def plot_figure_1(
    path: Sequence[Equilibrium], *, stages: Sequence[int] = range(len(STAGES)), color_by: Field = "curvature"
) -> Figure:
    """The pictures (a) to (f) of Fig. 1 of Linn & Stephan (2008), in one view, with one scale of length and colour.

    `path`: the six equilibria: circle segment, Omega, and with the end frame turned by 90, 180, 270 and 360 degrees.
    `stages`: which of them to draw, 0 for (a) to 5 for (f). `color_by` and the tube as for `plot_rod`.
    """
    instance(path, "path", (list, tuple))
    for k, equilibrium in enumerate(path):
        _check(equilibrium, f"path[{k}]", color_by)
    if len(path) != len(STAGES):
        raise ValueError(f"path must hold the {len(STAGES)} stages (a) to (f), got {len(path)} equilibria")
    if len(stages) == 0 or not set(stages) <= set(range(len(STAGES))):
        raise ValueError(f"stages must be some of 0 to {len(STAGES) - 1}, got {list(stages)}")
    shown = [path[stage] for stage in stages]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(4 * columns + 1, 3.7 * rows), layout="constrained")
    panels = [figure.add_subplot(rows, columns, k + 1, projection="3d") for k in range(len(shown))]
    radius, note = thickness(shown)
    norm = Normalize(*color_limits(np.concatenate([getattr(equilibrium, color_by) for equilibrium in shown])))
    points = [draw_tube(axes, rod, radius, color_by, norm) for axes, rod in zip(panels, shown, strict=True)]
    grids = [set_view(axes, np.concatenate(points), labels=False, zoom=1.1) for axes in panels]
    for axes, stage, equilibrium in zip(panels, stages, shown, strict=True):
        twist = f"{round(np.degrees(float(equilibrium.total_twist)))}°"
        axes.set_title(f"({'abcdef'[stage]}) {STAGES[stage]}\ntotal twist {twist}", fontsize=10, y=0.95)
    figure.colorbar(ScalarMappable(norm, COLOR_MAP), ax=panels, label=LABELS[color_by], shrink=0.6)
    figure.supxlabel(f"grid {grids[0]:g} m   {note}", fontsize=9, color="0.4")
    return figure


def _check(equilibrium: Equilibrium, name: str, color_by: str = "curvature") -> None:
    instance(equilibrium, name, Equilibrium)
    if equilibrium.s.ndim != 1:
        raise ValueError(
            f"{name} must be a single equilibrium, got a stack of shape {equilibrium.s.shape[:-1]}; "
            "jax.tree.map(lambda leaf: leaf[-1], path) takes the last one"
        )
    if color_by not in LABELS:
        raise ValueError(f"color_by must be {' or '.join(map(repr, LABELS))}, got {color_by!r}")
