"""Pictures of equilibria by matplotlib, without pyplot: each function draws in given axes, or in those of a new figure,
and returns them. Page and words have the colors of matplotlib's style, also within
`matplotlib.style.context("dark_background")`. `axes.figure.savefig("rod.png")` saves the picture.
"""

import base64
import io
from collections.abc import Iterable, Sequence
from typing import TypeVar, cast

import equinox as eqx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from rodjax.checks import instance, positive, sequence
from rodjax.drawing import (
    COLOR_MAP,
    LABELS,
    Field,
    color_limits,
    draw_contacts,
    draw_end_loads,
    draw_tube,
    halo,
    largest_radius,
    set_view,
    surroundings,
    thickness,
)
from rodjax.solving.harness_result import HarnessEquilibrium, results_of
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
) -> Axes3D:
    """One equilibrium as a shaded tube of equal scale on all axes.

    **Arguments:**

    - `equilibrium`: a single one; of a path, take one with `jax.tree.map(lambda leaf: leaf[k], path)`.
    - `color_by`: `"curvature"`, `"twist"` or `"tension"`.
    - `loads`: draw the forces and moments (two-headed arrows) that act on the rod at its ends, with their magnitude,
        and contact forces as lines that end on the rod, as long as the force per length is large.
    - `radius` [m] of the tube, of a rod whose radius varies at the thickest place; `None`: that of the rod, or thicker
      than life, 1.8 % of the picture, where the rod would be too thin to see: the figure says so.
    - `axes`: 3-D axes to draw in; `None`: those of a new figure.

    Returns the axes. The black strip runs along the director d1, the white one along -d1: where the rod twists they
    wind around it. Clips are dark collars. Obstacles are translucent, and drawn as far as they are near the rod.
    Raises `ValueError` or `TypeError` for arguments that make no sense.
    """
    _check(equilibrium, "equilibrium", color_by)
    axes = _axes_in_space(axes, (7, 5))
    radius, note = thickness([equilibrium], None if radius is None else float(positive(radius, "radius")))
    norm = Normalize(*color_limits(getattr(equilibrium, color_by)))
    points = [draw_tube(axes, equilibrium, radius, color_by, norm, surroundings(equilibrium, radius))]
    if loads:
        points.append(draw_end_loads(axes, equilibrium))
        note = _noted(note, draw_contacts(axes, [equilibrium], [radius]))
    set_view(axes, np.concatenate(points))
    axes.text2D(0.0, 0.0, note, transform=axes.transAxes, fontsize=8, color="0.4")
    _add_color_bar([axes], norm, color_by, pad=0.08)
    return axes


def picture_html(equilibrium: Equilibrium | HarnessEquilibrium) -> str:
    """A picture of one equilibrium with its loads, as HTML; nothing where it has no numbers."""
    rods = results_of(equilibrium).values()
    if not all(np.all(np.isfinite(np.asarray(rod.nodes))) for rod in rods):
        return ""
    if isinstance(equilibrium, HarnessEquilibrium):
        name, axes = "harness", plot_harness(equilibrium, loads=True)
    else:
        name, axes = "rod", plot_rod(equilibrium, loads=True)
    content = io.BytesIO()
    figure_of(axes).savefig(content, format="png", dpi=80)
    encoded = base64.b64encode(content.getvalue()).decode()
    return f'<img alt="the {name}, coloured by curvature" src="data:image/png;base64,{encoded}">'


def plot_harness(
    result: HarnessEquilibrium,
    *,
    color_by: Field = "curvature",
    loads: bool = False,
    radius: float | None = None,
    axes: Axes3D | None = None,
) -> Axes3D:
    """All rods of one equilibrium of a harness in one picture, with one scale of length and colour, and their names;
    obstacles near the first rod that has them.

    `color_by` and `axes` as for `plot_rod`; `loads`: draw contact forces, of obstacles and of rods on one another, as
    `plot_rod` does; `radius` [m]: of the thickest. Returns the axes. Raises `ValueError` or `TypeError` for arguments
    that make no sense.
    """
    instance(result, "result", HarnessEquilibrium)
    if result.energy.ndim:
        raise ValueError(f"result must be a single equilibrium, got a stack of shape {result.energy.shape}")
    rods = result.values()
    for name, rod in result.items():
        _check(rod, f"result[{name!r}]", color_by)
    axes = _axes_in_space(axes, (8, 6))
    true = [0.0 if rod.scene.rod.radius is None else largest_radius(rod.scene.rod.radius) for rod in rods]
    first = int(np.argmax(true))
    by_size = [rods[first], *rods]
    thick, note = thickness(by_size, None if radius is None else float(positive(radius, "radius")))
    norm = Normalize(*color_limits(np.concatenate([getattr(rod, color_by) for rod in rods])))
    points, drawn, radii = [], [], []
    for (name, rod), own in zip(result.items(), true, strict=True):
        radius = thick * own / true[first] if own else thick
        radii.append(radius)
        new = [obstacle for obstacle in rod.scene.obstacles if not any(eqx.tree_equal(obstacle, one) for one in drawn)]
        drawn += new
        points.append(draw_tube(axes, rod, radius, color_by, norm, surroundings(rod, radius, tuple(new))))
        middle = np.asarray(rod.nodes)[len(rod.s) // 2]
        x, y, z = map(float, middle)
        axes.text(x, y, z, name, fontsize=8, path_effects=halo(), zorder=10)
    if loads:
        note = _noted(note, draw_contacts(axes, rods, radii))
    set_view(axes, np.concatenate(points))
    axes.text2D(0.0, 0.0, note, transform=axes.transAxes, fontsize=8, color="0.4")
    _add_color_bar([axes], norm, color_by, pad=0.08)
    return axes


def plot_along(equilibrium: Equilibrium, *, axes: Iterable[Axes] | None = None) -> tuple[Axes, ...]:
    """Curvature, twist rate and tension of one equilibrium over the arclength.

    `axes`: three, one below the other, to draw in; `None`: those of a new figure. Returns them.
    """
    _check(equilibrium, "equilibrium")
    figure = Figure(figsize=(6, 6), layout="constrained")
    panels = figure.subplots(len(LABELS), 1, sharex=True) if axes is None else axes
    panels = _checked_axes(panels, len(LABELS), Axes)
    s = np.asarray(equilibrium.s)
    for panel, (name, label) in zip(panels, LABELS.items(), strict=True):
        values = np.asarray(getattr(equilibrium, name))
        low, high = color_limits(values)
        margin = 0.05 * (high - low)
        panel.plot(s, values, marker="." if len(s) < 60 else None)
        panel.set(ylabel=label, ylim=(low - margin, high + margin), xlim=(s[0], s[-1]))
        panel.ticklabel_format(axis="y", useOffset=False)
        panel.grid(color="0.5", alpha=0.2)
    panels[-1].set_xlabel("arclength s [m]")
    figure_of(panels[0]).align_ylabels(panels)
    return panels


def plot_figure_1(
    path: Sequence[Equilibrium],
    *,
    stages: Sequence[int] = range(len(STAGES)),
    color_by: Field = "curvature",
    axes: Iterable[Axes3D] | None = None,
) -> tuple[Axes3D, ...]:
    """The pictures (a) to (f) of Fig. 1 of Linn & Stephan (2008), in one view, with one scale of length and colour.

    `path`: the six equilibria: circle segment, Omega, and with the end frame turned by 90, 180, 270 and 360 degrees.
    `stages`: which of them to draw, 0 for (a) to 5 for (f). `color_by` and the tube as for `plot_rod`. `axes`: 3-D axes
    to draw in, one a stage; `None`: those of a new figure. Returns them.
    """
    instance(path, "path", (list, tuple))
    for k, equilibrium in enumerate(path):
        _check(equilibrium, f"path[{k}]", color_by)
    if len(path) != len(STAGES):
        raise ValueError(f"path must hold the {len(STAGES)} stages (a) to (f), got {len(path)} equilibria")
    if len(stages) == 0 or not set(stages) <= set(range(len(STAGES))):
        raise ValueError(f"stages must be some of 0 to {len(STAGES) - 1}, got {list(stages)}")
    shown = [path[stage] for stage in stages]
    if axes is None:
        columns = min(3, len(shown))
        rows = -(-len(shown) // columns)
        figure = Figure(figsize=(4 * columns + 1, 3.7 * rows), layout="constrained")
        axes = [cast(Axes3D, figure.add_subplot(rows, columns, k + 1, projection="3d")) for k in range(len(shown))]
    panels = _checked_axes(axes, len(shown), Axes3D)
    radius, note = thickness(shown)
    norm = Normalize(*color_limits(np.concatenate([getattr(equilibrium, color_by) for equilibrium in shown])))
    points = [draw_tube(panel, rod, radius, color_by, norm) for panel, rod in zip(panels, shown, strict=True)]
    grids = [set_view(panel, np.concatenate(points), labels=False, zoom=1.1) for panel in panels]
    for panel, stage, equilibrium in zip(panels, stages, shown, strict=True):
        twist = f"{round(np.degrees(float(equilibrium.total_twist)))}°"
        panel.set_title(f"({'abcdef'[stage]}) {STAGES[stage]}\ntotal twist {twist}", fontsize=10, y=0.95)
    told = f"grid {grids[0]:g} m   {note}"
    panels[-1].text2D(1.0, 0.0, told, transform=panels[-1].transAxes, fontsize=9, color="0.4", ha="right")
    _add_color_bar(panels, norm, color_by)
    return panels


AnyAxes = TypeVar("AnyAxes", bound=Axes)


def _axes_in_space(axes: Axes3D | None, size: tuple[float, float]) -> Axes3D:
    """Those given, or those of a new figure of this size [inch]."""
    if axes is None:
        axes = cast(Axes3D, Figure(figsize=size, layout="constrained").add_subplot(projection="3d"))
    instance(axes, "axes", Axes3D)
    return axes


def _checked_axes(axes: Iterable[AnyAxes], count: int, kind: type[AnyAxes]) -> tuple[AnyAxes, ...]:
    """So many, of this kind."""
    panels = sequence(axes, "axes", "axes")
    if len(panels) != count:
        raise ValueError(f"axes must hold {count} axes, one for each panel, got {len(panels)}")
    for k, panel in enumerate(panels):
        instance(panel, f"axes[{k}]", kind)
    return panels


def figure_of(axes: Axes) -> Figure:
    """The whole figure of which axes are a part."""
    return cast(Figure, axes.get_figure(root=True))


def _noted(*notes: str) -> str:
    return "; ".join(filter(None, notes))


def _add_color_bar(panels: Sequence[Axes3D], norm: Normalize, color_by: str, pad: float = 0.05) -> None:
    scale = ScalarMappable(norm, COLOR_MAP)
    figure_of(panels[0]).colorbar(scale, ax=panels, label=LABELS[color_by], shrink=0.6, pad=pad)


def _check(equilibrium: Equilibrium, name: str, color_by: str = "curvature") -> None:
    instance(equilibrium, name, Equilibrium)
    if equilibrium.s.ndim != 1:
        raise ValueError(
            f"{name} must be a single equilibrium, got a stack of shape {equilibrium.s.shape[:-1]}; "
            "jax.tree.map(lambda leaf: leaf[-1], path) takes the last one"
        )
    if color_by not in LABELS:
        raise ValueError(f"color_by must be {' or '.join(map(repr, LABELS))}, got {color_by!r}")
