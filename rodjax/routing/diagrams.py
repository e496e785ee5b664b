"""Diagrams along the cables of a report, with their limits drawn, as matplotlib figures without pyplot."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rodjax.analysis.clearance import radius_at
from rodjax.analysis.samples import Samples, samples_at
from rodjax.drawing import PALETTE
from rodjax.model.obstacles import Obstacle
from rodjax.programs.compilation import compiled
from rodjax.routing.cable_report import Cable

LIMIT_COLOR = "#c0271c"
CABLE_COLORS = ("#225ea8", "#b3641e", "#3f7f3f", "#7a4f9a", "#555555")
PER_METRE = 1e3
POINTS, JUST_BEFORE = 401, 1e-6
# A limit further away than so many of the largest value would press the curve flat: it is not on the axis then.
FAR = 3.0
PANEL_HEIGHT = 1.7


class Curve(NamedTuple):
    """A line of a panel: its label, its values, and the limits on it, as lines of their own."""

    label: str
    values: Float[np.ndarray, "k"]
    color: str
    style: str = "-"


class Panel(NamedTuple):
    """What one panel shows of one cable; `limits`: values along s that must not be crossed, each in the color of what
    it limits.
    """

    label: str
    curves: list[Curve]
    limits: list[Float[np.ndarray, "k"]]
    limit_colors: tuple[str, ...] = ()


def plot_along(cables: Sequence[Cable], obstacles: Sequence[Obstacle], names: Sequence[str]) -> Figure:
    """Curvature with the bend radius, twist, tension, moment and clearances of each cable over its arclength."""
    all_panels = [_panels(cable, obstacles, names, k) for k, cable in enumerate(cables)]
    rows = max(len(panels) for _, panels in all_panels)
    figure = Figure(figsize=(7.2 * len(cables), PANEL_HEIGHT * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, len(cables), sharex="col", squeeze=False)
    for column, (cable, (s, panels)) in enumerate(zip(cables, all_panels, strict=True)):
        for axes, panel in zip(grid[:, column], panels, strict=False):
            _draw(axes, s, panel)
        for axes in grid[len(panels) :, column]:
            axes.set_visible(False)
        clips = cable.reactions[1:-1]
        for axes in grid[: len(panels), column]:
            for clip in clips:
                axes.axvline(PER_METRE * clip.s, color="0.75", linewidth=0.8, zorder=0)
        for clip in clips:
            grid[0, column].annotate(
                clip.name,
                (PER_METRE * clip.s, 1.0),
                (0, 2),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=7,
                color="0.35",
            )
        _mark_bend_radii(grid[0, column])
        grid[len(panels) - 1, column].set_xlabel("arclength s [mm]")
        if len(cables) > 1:
            grid[0, column].set_title(cable.name, fontsize=10, pad=14 if len(clips) else None)
        figure.align_ylabels(grid[: len(panels), column])
    return figure


def _panels(
    cable: Cable, obstacles: Sequence[Obstacle], names: Sequence[str], number: int
) -> tuple[Float[np.ndarray, "k"], list[Panel]]:
    limits, color = cable.limits, CABLE_COLORS[number % len(CABLE_COLORS)]
    length, held = float(cable.equilibrium.s[-1]), [reaction.s for reaction in cable.reactions[1:-1]]
    # And on both sides of clips, where force, moment and curvature jump.
    arclengths = [np.linspace(0.0, length, POINTS), *([(1 - JUST_BEFORE) * s, s] for s in held)]
    samples = samples_at(cable.equilibrium, np.unique(np.concatenate(arclengths)))
    s, ones = samples.s, np.ones_like(samples.s)

    def limit(name: str, unit: float = 1.0, of: Callable[[float], np.ndarray] = lambda x: x * ones) -> list[np.ndarray]:
        value = None if limits is None else getattr(limits, name)
        return [] if value is None else [unit * of(float(value))]

    radius = samples.radius
    bent = [] if radius is None else limit("bend_radius", of=lambda multiple: 1 / ((2 * multiple + 1) * radius))
    twist = 180 / np.pi * samples.twist
    twists = limit("twist", 180 / np.pi)
    panels = [
        Panel("curvature [1/m]", [Curve("", samples.curvature, color)], bent),
        Panel("twist [deg/m]", [Curve("", twist, color)], twists + [-x for x in twists]),
        Panel("tension [N]", [Curve("", samples.tension, color)], []),
    ]
    if samples.moment is not None:
        panels.append(Panel("moment [N m]", _moments(samples, color), []))
    if obstacles and radius is not None:
        away = np.asarray(_clearances(cable.equilibrium, tuple(obstacles), s))
        curves = [
            Curve(name, PER_METRE * row, PALETTE[k % len(PALETTE)])
            for k, (name, row) in enumerate(zip(names, away, strict=True))
        ]
        lines, colors = [], ()
        if limits is not None and limits.clearance is not None:
            asked = np.broadcast_to(np.asarray(limits.clearance), (len(obstacles),))
            is_one = len(np.unique(asked)) == 1
            lines = [PER_METRE * float(x) * ones for x in (asked[:1] if is_one else asked)]
            colors = () if is_one else tuple(curve.color for curve in curves)
        panels.append(Panel("clearance [mm]", curves, lines, colors))
    return PER_METRE * s, panels


def _moments(samples: Samples, color: str) -> list[Curve]:
    assert samples.moment is not None
    tangents = samples.frames[..., 2]
    torque = np.sum(samples.moment * tangents, axis=-1)
    bending = np.linalg.norm(samples.moment - torque[:, None] * tangents, axis=-1)
    return [Curve("bending", bending, color), Curve("torsion", torque, color, "--")]


@compiled
def _along(
    obstacles: tuple[Obstacle, ...], positions: Float[Array, "k 3"], radius: Float[Array, "k"]
) -> Float[Array, "m k"]:
    return jnp.stack([jax.vmap(obstacle.at)(positions) - radius for obstacle in obstacles])


def _clearances(equilibrium, obstacles: tuple[Obstacle, ...], s: Float[np.ndarray, "k"]) -> Float[Array, "m k"]:
    arclengths = jnp.asarray(s)
    return _along(obstacles, equilibrium.position_at(arclengths), radius_at(equilibrium.scene.rod, arclengths))


def _draw(axes: Axes, s: Float[np.ndarray, "k"], panel: Panel) -> None:
    for curve in panel.curves:
        axes.plot(s, curve.values, curve.style, color=curve.color, linewidth=1.3, label=curve.label or None)
    low, high = axes.get_ylim()
    reach = FAR * max(float(np.max(np.abs(curve.values))) for curve in panel.curves)
    colors = panel.limit_colors or (LIMIT_COLOR,) * len(panel.limits)
    shown = [pair for pair in zip(panel.limits, colors, strict=True) if np.min(np.abs(pair[0])) < reach]
    for values, color in shown:
        axes.plot(s, values, ":", color=color, linewidth=1.5)
    near = [values for values, _ in shown]
    if near:
        axes.plot([], [], ":", color="0.4" if panel.limit_colors else LIMIT_COLOR, label="limit")
        margin = 0.04 * (max(high, np.max(near)) - min(low, np.min(near)))
        axes.set_ylim(min(low, np.min(near) - margin), max(high, np.max(near) + margin))
    axes.set_xlim(s[0], s[-1])
    axes.set_ylabel(panel.label, fontsize=9)
    axes.grid(color="0.92")
    axes.tick_params(labelsize=8)
    if panel.limits and not near:
        far = min(float(np.min(np.abs(values))) for values in panel.limits)
        axes.plot([], [], ":", color=LIMIT_COLOR, label=f"limit at {far:.4g}, beyond the axis")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc="best", ncols=4, framealpha=0.8)


def _mark_bend_radii(axes: Axes) -> None:
    """Beside the curvature, the bend radii of the centerline that it means."""
    beside = axes.twinx()
    beside.set_ylim(axes.get_ylim())
    low, high = axes.get_ylim()
    ticks = [tick for tick in axes.get_yticks() if max(low, 0) < tick <= high]
    beside.set_yticks(ticks, [f"{PER_METRE / tick:.3g}" for tick in ticks])
    beside.set_ylabel("bend radius [mm]", fontsize=9)
    beside.tick_params(labelsize=8)
