"""Pictures of routes, as matplotlib figures without pyplot: save them with `figure.savefig("route.png")`."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter

from rodjax.checks import line
from rodjax.drawing import (
    ARROW_LENGTH,
    CLIP_COLOR,
    OPACITY,
    PALETTE,
    Labels,
    draw_arrows,
    draw_faces,
    seen_axes,
    set_view,
    tube_faces,
)
from rodjax.model.obstacles import Obstacle
from rodjax.routing.view_data import (
    CableView,
    azimuth,
    clip_faces,
    coloring,
    extent,
    seen_surfaces,
    thickness_note,
)

FORCE_COLOR, NAME_COLOR = "tab:red", "black"
# Of flat scenes, and how much less it is of those as high as they are wide.
ZOOM, LESS = 1.2, 0.35
# How far beside a place its name stands, by the extent of the cables.
ASIDE = 0.04
# Characters of a line of the title.
WIDTH = 100


def plot_route(cable_views: Sequence[CableView], obstacles: Mapping[str, Obstacle], title: str) -> Figure:
    """Cables as tubes colored by the margin of their bend radius, between translucent obstacles.

    Clips are collars, forces that supports and obstacles apply to the cables arrows with their sizes. Each obstacle has
    its name in the legend.
    """
    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    axes.computed_zorder = False  # arrows and words in front of all faces
    colors = coloring(cable_views)
    faces, shades = [], []
    for cable_view in cable_views:
        tube, shade = tube_faces(
            cable_view.equilibrium, cable_view.radius, lambda s, cable_view=cable_view: colors.of(cable_view, s), ()
        )
        faces.append(tube)
        shades.append(np.pad(shade, ((0, 0), (0, 1)), constant_values=1.0))
        for collar in clip_faces(cable_view):
            faces.append(collar)
            shades.append(np.tile(to_rgba(CLIP_COLOR), (len(collar), 1)))
    legend = []
    for k, (surface, name) in enumerate(zip(seen_surfaces(cable_views, [*obstacles.values()]), obstacles, strict=True)):
        color = to_rgba(PALETTE[k % len(PALETTE)], OPACITY)
        faces.append(surface)
        shades.append(np.tile(color, (len(surface), 1)))
        label = line(name) if len(surface) else f"{line(name)} (not in the picture)"
        legend.append(Patch(facecolor=to_rgba(color, 0.8), label=label))
    # All faces together: each artist by itself would be sorted in depth as a whole.
    view = azimuth(cable_views, [*obstacles.values()])
    draw_faces(axes, np.concatenate(faces), np.concatenate(shades), view)
    size = extent([cable_view.equilibrium for cable_view in cable_views])
    acting = [force for cable_view in cable_views for force in cable_view.forces]
    centerlines = np.concatenate([cable_view.centerline for cable_view in cable_views])
    labels = Labels(axes, centerlines, ARROW_LENGTH * size, view)
    right, up, _ = seen_axes(view)
    for cable_view in cable_views:
        _name(labels, cable_view, size * (right - up), len(cable_views) > 1)
    feet = np.reshape([one.position for one in acting], (-1, 3))
    forces = np.reshape([one.force for one in acting], (-1, 3))
    tips = draw_arrows(axes, feet, forces, "N", 0.0, ARROW_LENGTH * size, FORCE_COLOR, labels)
    points = np.concatenate([np.concatenate(faces).reshape(-1, 3), tips])
    width, depth, height = np.ptp(points, axis=0)
    set_view(axes, points, zoom=ZOOM - LESS * min(height / max(width, depth), 1.0), azimuth=view)
    axes.text2D(0.0, 0.0, thickness_note(cable_views), transform=axes.transAxes, fontsize=8, color="0.4")
    bar = figure.colorbar(
        ScalarMappable(colors.norm, colors.color_map),
        ax=axes,
        label=colors.label,
        shrink=0.6,
        pad=0.08,
        panchor=False,  # the axes stay in the middle of what is left, not at the bar
        extend="both" if colors.is_margin else "neither",
        format=PercentFormatter(1.0) if colors.is_margin else None,
    )
    bar.ax.tick_params(labelsize=9)
    if legend:
        figure.legend(handles=legend, loc="outside lower center", ncols=min(len(legend), 4), frameon=False, fontsize=9)
    for space, kept in ((" %", "\u00a0%"), (" = ", "\u00a0=\u00a0")):
        title = title.replace(space, kept)
    figure.suptitle("\n".join(textwrap.wrap(title, WIDTH)), fontsize=10)
    return figure


def _name(labels: Labels, cable_view: CableView, aside: Float[np.ndarray, "3"], has_name: bool) -> None:
    """Words beside the clips, and the name of one cable of several beside its middle."""
    named = [(reaction.name, reaction.position) for reaction in cable_view.reactions[1:-1]]
    if has_name:
        named.append((line(cable_view.name), cable_view.centerline[len(cable_view.centerline) // 2]))
    for name, position in named:
        labels.write(name, NAME_COLOR, [(position + ASIDE * aside, aside)], fontsize=8)
