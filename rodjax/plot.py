"""Pictures of equilibria, as matplotlib figures without pyplot: save them with `figure.savefig("rod.png")`."""

import base64
import io
from collections.abc import Callable, Sequence
from typing import Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullFormatter
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from rodjax.analysis.reactions import reactions
from rodjax.analysis.samples import framed_at
from rodjax.checks import instance, leaf, positive
from rodjax.model.along import Along, Value, value_at
from rodjax.model.obstacles import Obstacle
from rodjax.model.surfaces import Faces, collar, quads, surfaces
from rodjax.programs.compilation import compiled
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium

Field = Literal["curvature", "twist", "tension"]
LABELS = {"curvature": "curvature [1/m]", "twist": "twist rate [rad/m]", "tension": "tension [N]"}
STAGES = ["circle segment", "upside-down Omega, no twist"]
STAGES += [f"end frame turned by {turn}°" for turn in (90, 180, 270, 360)]

COLOR_MAP = "viridis"
# Faces around the tube, and how many of them each strip takes: narrower is lost, wider hides the field.
FACES_AROUND = 24
STRIP_FACES = 4
# Black along d1, white along -d1: one of the two is in sight.
STRIPS = ((0, (0.0, 0.0, 0.0)), (FACES_AROUND // 2, (1.0, 1.0, 1.0)))
# Parts of the picture's size: the thinnest tube, the longest arrow, the least depth of the box around a flat rod.
LEAST_RADIUS = 0.018
ARROW_LENGTH = 0.22
LEAST_DEPTH = 0.3
# Width and height of what is written at an arrow, by the length of the longest one.
LABEL_SIZE = (0.6, 0.2)
# Forces below this part of EI/L^2, moments of EI/L, are rounding and get no arrow.
LEAST_LOAD = 1e-6
# Of clips and of obstacles, one after another, and how much of what is behind an obstacle it hides.
CLIP_COLOR = "#3a3a3a"
PALETTE = ("#8d99a6", "#b5976a", "#7d9b76", "#a083a8", "#6f93b8", "#b57f7f", "#9c9c5e", "#5f9c95")
OPACITY = 0.35
HALO = withStroke(linewidth=2, foreground="white")
# The view [degrees].
ELEVATION, AZIMUTH = 22, -62


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
    norm = Normalize(*_limits(getattr(equilibrium, color_by)))
    points = [_draw_tube(axes, equilibrium, radius, color_by, norm, _surroundings(equilibrium, radius))]
    if loads:
        points.append(_draw_loads(axes, equilibrium))
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
    norm = Normalize(*_limits(np.concatenate([getattr(rod, color_by) for rod in rods])))
    points, drawn = [], []
    for (name, rod), own in zip(result.items(), true, strict=True):
        radius = thick * own / true[first] if own else thick
        new = [obstacle for obstacle in rod.scene.obstacles if not any(eqx.tree_equal(obstacle, one) for one in drawn)]
        drawn += new
        points.append(_draw_tube(axes, rod, radius, color_by, norm, _surroundings(rod, radius, tuple(new))))
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
        low, high = _limits(values)
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
    norm = Normalize(*_limits(np.concatenate([getattr(equilibrium, color_by) for equilibrium in shown])))
    points = [_draw_tube(axes, rod, radius, color_by, norm) for axes, rod in zip(panels, shown, strict=True)]
    grids = [set_view(axes, np.concatenate(points), labels=False, zoom=1.1) for axes in panels]
    for axes, stage, equilibrium in zip(panels, stages, shown, strict=True):
        twist = f"{round(np.degrees(float(equilibrium.total_twist)))}°"
        axes.set_title(f"({'abcdef'[stage]}) {STAGES[stage]}\ntotal twist {twist}", fontsize=10, y=0.95)
    figure.colorbar(ScalarMappable(norm, COLOR_MAP), ax=panels, label=LABELS[color_by], shrink=0.6)
    figure.supxlabel(f"grid {grids[0]:g} m   {note}", fontsize=9, color="0.4")
    return figure


def tube(
    equilibrium: Equilibrium, radius: float
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 3"], Float[np.ndarray, "k m 3"]]:
    """A tube around one equilibrium, smooth between the nodes: arclengths, centerline, points of its surface [m].

    `radius` [m]: where the rod is thickest. The faces of each ring, from point j to j + 1, go around right-handed about
    the tangent; the middle of the first `STRIP_FACES` is along d1.
    """
    turns = abs(float(equilibrium.total_twist)) / (2 * np.pi)
    nodes = np.asarray(equilibrium.s)
    s = leaf(np.linspace(nodes[0], nodes[-1], int(max(200, 24 * turns)) + 1, dtype=nodes.dtype))
    centerline, tangents, d1 = map(np.asarray, _framed(equilibrium, s))
    d2 = np.cross(tangents, d1)
    angle = 2 * np.pi / FACES_AROUND * (np.arange(FACES_AROUND + 1) - STRIP_FACES / 2)
    around = np.cos(angle)[:, None] * d1[:, None] + np.sin(angle)[:, None] * d2[:, None]
    true = equilibrium.scene.rod.radius
    rings = np.full(len(s), radius)
    if isinstance(true, Along):
        rings *= radius_along(true, s) / largest_radius(true)
    return np.asarray(s), centerline, centerline[:, None] + rings[:, None, None] * around


def radius_along(radius: Value, s: Float[jax.Array, "k"]) -> Float[np.ndarray, "k"]:
    """[m] At equally spaced arclengths; a jump takes the space from one to the next."""
    half = (s[1] - s[0]) / 2
    return np.asarray(value_at(radius, s, jnp.maximum(s - half, s[0]), jnp.minimum(s + half, s[-1])))


def largest_radius(radius: Value) -> float:
    """[m] Along the rod."""
    return float(jnp.max(radius.samples) if isinstance(radius, Along) else radius)


@compiled
def _framed(
    equilibrium: Equilibrium, s: Float[jax.Array, "k"]
) -> tuple[Float[jax.Array, "k 3"], Float[jax.Array, "k 3"], Float[jax.Array, "k 3"]]:
    return framed_at(equilibrium, s)


def _surroundings(
    equilibrium: Equilibrium, radius: float, obstacles: Sequence[Obstacle] | None = None
) -> list[tuple[Faces, tuple[float, ...]]]:
    """Faces of a collar for each clip of a rod that is drawn this thick, and of the obstacles near it, all of the scene
    for `None`, with their colors.
    """
    scene = equilibrium.scene
    obstacles = scene.obstacles if obstacles is None else obstacles
    clips = reactions(equilibrium)[1:-1] if scene.clips else []
    drawn = [(collar(clip.position, clip.axes[0], radius), to_rgba(CLIP_COLOR)) for clip in clips]
    if obstacles:
        nodes = np.asarray(equilibrium.nodes)
        # The room that the tube takes, so that a patch of a floor lies below all of it.
        seen = surfaces(obstacles, np.concatenate([nodes - radius, nodes + radius]))
        drawn += [(faces, to_rgba(PALETTE[k % len(PALETTE)], OPACITY)) for k, faces in enumerate(seen)]
    return drawn


def _draw_tube(
    axes: Axes3D,
    equilibrium: Equilibrium,
    radius: float,
    color_by: Field,
    norm: Normalize,
    others: Sequence[tuple[Faces, tuple[float, ...]]] = (),
) -> Float[np.ndarray, "p 3"]:
    """Draws one rod and other faces, all of which are sorted in depth together; returns points of them."""
    scale = ScalarMappable(norm, COLOR_MAP)
    nodes, values = np.asarray(equilibrium.s), np.asarray(getattr(equilibrium, color_by))
    faces, colors = tube_faces(equilibrium, radius, lambda s: scale.to_rgba(np.interp(s, nodes, values)))
    if others:
        shades = [np.pad(colors, ((0, 0), (0, 1)), constant_values=1.0)]
        shades += [np.tile(color, (len(other), 1)) for other, color in others]
        faces, colors = np.concatenate([faces, *(other for other, _ in others)]), np.concatenate(shades)
    draw_faces(axes, faces, colors)
    return faces.reshape(-1, 3)


def tube_faces(
    equilibrium: Equilibrium,
    radius: float,
    color_at: Callable[[Float[np.ndarray, "k"]], Float[np.ndarray, "k 4"]],
    strips: Sequence[tuple[int, tuple[float, float, float]]] = STRIPS,
) -> tuple[Float[np.ndarray, "f 4 3"], Float[np.ndarray, "f 3"]]:
    """The faces of one rod with its caps, and their colors: those at arclengths [m], and the strips."""
    s, centerline, points = tube(equilibrium, radius)
    rings = color_at((s[:-1] + s[1:]) / 2)[:, :3]
    colors = np.repeat(rings[:, None], FACES_AROUND, axis=1)
    # The strip is faces of the tube: a line of its own would be sorted in depth as a whole, in front or behind.
    for first, color in strips:
        colors[:, first : first + STRIP_FACES] = color
    # Caps, with a hole too small to see: faces without an area have no normal for the shading.
    hole = 1e-3
    caps = [centerline[k] + hole * (points[k] - centerline[k]) for k in (0, -1)]
    colors = np.pad(colors, ((1, 1), (0, 0), (0, 0)), mode="edge")
    return quads(np.concatenate([caps[:1], points, caps[1:]])), colors.reshape(-1, 3)


def draw_faces(
    axes: Axes3D, faces: Float[np.ndarray, "f 4 3"], colors: Float[np.ndarray, "f c"], azimuth: float = AZIMUTH
) -> None:
    """Draws shaded faces, each in front of those that are further away."""
    light = LightSource(azdeg=azimuth - 20, altdeg=55)
    drawn = Poly3DCollection(
        list(faces), facecolors=colors, shade=True, lightsource=light, linewidths=0, antialiased=False
    )
    axes.add_collection3d(drawn)


def _draw_loads(axes: Axes3D, equilibrium: Equilibrium) -> Float[np.ndarray, "p 3"]:
    """Arrows for the forces and moments that the supports apply to the rod at its ends; returns their tips."""
    nodes = np.asarray(equilibrium.nodes)
    length = ARROW_LENGTH * np.max(np.ptp(nodes, axis=0))
    units = equilibrium.state.units
    # At s = 0 what the support applies is the reverse of the section force.
    forces = np.stack([-equilibrium.start_force, equilibrium.end_force])
    moments = np.stack([-equilibrium.start_moment, equilibrium.end_moment])
    feet = nodes[[0, -1]]
    tips = [
        draw_arrows(axes, feet, forces, "N", LEAST_LOAD * float(units.force), length, "tab:red"),
        draw_arrows(axes, feet, moments, "N m", LEAST_LOAD * float(units.energy), length, "tab:purple", (1.0, 0.8)),
    ]
    return np.concatenate(tips)


def draw_arrows(
    axes: Axes3D,
    feet: Float[np.ndarray, "k 3"],
    loads: Float[np.ndarray, "k 3"],
    unit: str,
    least: float,
    length: float,
    color: str,
    heads: Sequence[float] = (1.0,),
    azimuth: float = AZIMUTH,
) -> Float[np.ndarray, "p 3"]:
    """Arrows for loads not smaller than `least`, with their magnitudes, the largest `length` [m] long; returns their
    tips.
    """
    sizes = np.linalg.norm(loads, axis=1)
    right, up, _ = seen_axes(azimuth)
    tips, written = [], []
    for foot, load, size in zip(feet, loads, sizes, strict=True):
        if size < least:
            continue
        along, reach = load / size, length * size / max(sizes)
        for head in heads:
            (fx, fy, fz), (x, y, z) = foot, head * reach * along
            ratio = 0.2 * length / (head * reach)
            axes.quiver(fx, fy, fz, x, y, z, color=color, arrow_length_ratio=ratio, linewidth=1.8)
        # Beyond the tip, or where something is written there already before the foot.
        for at, sign in ((foot + (reach + 0.05 * length) * along, 1), (foot - 0.1 * length * along, -1)):
            side, rise = np.sign(sign * along @ right) or 1.0, np.sign(sign * along @ up) or 1.0
            middle = np.array([at @ right, at @ up]) + np.array([side, rise]) * np.array(LABEL_SIZE) * length / 2
            if not any(np.all(np.abs(middle - other) < np.array(LABEL_SIZE) * length) for other in written):
                break
        written.append(middle)
        x, y, z = at
        ha, va = "left" if side > 0 else "right", "bottom" if rise > 0 else "top"
        axes.text(x, y, z, f"{size:.3g} {unit}", color=color, ha=ha, va=va, path_effects=[HALO])
        tips.append((x, y, z))
    return np.reshape(tips, (-1, 3))


def seen_axes(azimuth: float) -> Float[np.ndarray, "3 3"]:
    """Rows: what is right, up and towards the viewer in a picture."""
    a, e = np.radians(azimuth), np.radians(ELEVATION)
    right = (-np.sin(a), np.cos(a), 0.0)
    up = (-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e))
    return np.array([right, up, (np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e))])


def set_view(
    axes: Axes3D,
    points: Float[np.ndarray, "p 3"],
    labels: bool = True,
    zoom: float = 0.85,
    azimuth: float = AZIMUTH,
) -> float:
    """Limits around the points, one scale and one grid on all axes; returns the spacing of the grid [m]."""
    low, high = points.min(axis=0), points.max(axis=0)
    spans = 1.04 * np.maximum(high - low, LEAST_DEPTH * np.max(high - low))
    ticks = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0.0, np.max(spans))
    grid = float(ticks[1] - ticks[0])
    for axis, center, span in zip((axes.xaxis, axes.yaxis, axes.zaxis), (low + high) / 2, spans, strict=True):
        axis.axes.set(**{f"{axis.axis_name}lim": (center - span / 2, center + span / 2)})
        axis.set_major_locator(MultipleLocator(grid))
        if labels:
            axis.set_label_text(f"{axis.axis_name} [m]")
            axis.labelpad = 12  # clear of the tick labels
        else:
            axis.set_major_formatter(NullFormatter())
    axes.set_box_aspect(tuple(spans), zoom=zoom)  # pyright: ignore[reportArgumentType]
    axes.set_proj_type("ortho")
    axes.view_init(ELEVATION, azimuth)
    return grid


def _limits(values: Float[np.ndarray, "p"]) -> tuple[float, float]:
    """Range of the values; 10 % around them, or -1 to 1, where they are all the same but for rounding."""
    low, high = float(values.min()), float(values.max())
    size = max(abs(low), abs(high))
    if high - low > 1e-5 * size:
        return low, high
    margin = 0.1 * size if size > 1e-9 else 1.0
    return low - margin, high + margin


def thickness(equilibria: Sequence[Equilibrium], radius: float | None = None) -> tuple[float, str]:
    """Radius of the tubes where thickest [m], as asked for or to be seen, and what to say of it in the picture."""
    given = equilibria[0].scene.rod.radius
    true = 0.0 if given is None else largest_radius(given)
    if radius is None:
        nodes = np.concatenate([equilibrium.nodes for equilibrium in equilibria])
        radius = max(LEAST_RADIUS * float(np.max(np.ptp(nodes, axis=0))), true)
    if abs(radius - true) < 0.01 * radius:
        return radius, ""
    return radius, f"drawn {radius / true:.2g} times as thick as it is" if true else "thickness not to scale"


def _check(equilibrium: Equilibrium, name: str, color_by: str = "curvature") -> None:
    instance(equilibrium, name, Equilibrium)
    if equilibrium.s.ndim != 1:
        raise ValueError(
            f"{name} must be a single equilibrium, got a stack of shape {equilibrium.s.shape[:-1]}; "
            "jax.tree.map(lambda leaf: leaf[-1], path) takes the last one"
        )
    if color_by not in LABELS:
        raise ValueError(f"color_by must be {' or '.join(map(repr, LABELS))}, got {color_by!r}")
