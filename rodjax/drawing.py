"""Parts of pictures of rods: tubes as shaded faces, clips and obstacles around them, arrows, views and scales."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib import rcParams
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize, to_rgba
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullFormatter
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from rodjax.analysis.reactions import reactions
from rodjax.analysis.samples import framed_at, lengths_at_nodes
from rodjax.checks import leaf
from rodjax.model.along import Along, Value, value_at
from rodjax.model.obstacles import Obstacle
from rodjax.model.surfaces import Faces, collar, quads, surfaces
from rodjax.programs.compilation import compiled
from rodjax.solving.result import Equilibrium

Field = Literal["curvature", "twist", "tension"]
LABELS = {"curvature": "curvature [1/m]", "twist": "twist rate [rad/m]", "tension": "tension [N]"}

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
# Width of a letter and height of what is written at an arrow [points].
LABEL_SIZE = (6.4, 14.0)
# Forces below this part of EI/L^2, moments of EI/L, are rounding and get no arrow.
LEAST_LOAD = 1e-6
# Of lines for contact forces: beside the longest arrow, and their color.
CONTACT_LENGTH, CONTACT_COLOR = 0.6, "tab:orange"
# Of the names of axes, clear of the numbers and of the color bar on the right [points].
LABEL_PADS = {"x": 18, "y": 14, "z": 8}
# Of clips and of obstacles, one after another, and how much of what is behind an obstacle it hides.
CLIP_COLOR = "#3a3a3a"
PALETTE = ("#8d99a6", "#b5976a", "#7d9b76", "#a083a8", "#6f93b8", "#b57f7f", "#9c9c5e", "#5f9c95")
OPACITY = 0.35
# Of flat scenes, and how much less it is of those as high as they are wide.
ZOOM, LESS = 0.95, 0.15
# The view [degrees].
ELEVATION, AZIMUTH = 22, -62


def halo() -> list[withStroke]:
    """Around words, of the color of the page, light or dark, so that they can be read on lines."""
    return [withStroke(linewidth=2, foreground=rcParams["figure.facecolor"])]


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


def surroundings(
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


def draw_tube(
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


def draw_end_loads(axes: Axes3D, equilibrium: Equilibrium) -> Float[np.ndarray, "p 3"]:
    """Arrows for the forces and moments that the supports apply to the rod at its ends; returns their tips."""
    nodes = np.asarray(equilibrium.nodes)
    length = ARROW_LENGTH * np.max(np.ptp(nodes, axis=0))
    units = equilibrium.state.units
    # At s = 0 what the support applies is the reverse of the section force.
    forces = np.stack([-equilibrium.start_force, equilibrium.end_force])
    moments = np.stack([-equilibrium.start_moment, equilibrium.end_moment])
    feet, labels = nodes[[0, -1]], Labels(axes, nodes, length, AZIMUTH)
    tips = [
        draw_arrows(axes, feet, forces, "N", LEAST_LOAD * float(units.force), length, "tab:red", labels),
        draw_arrows(
            axes, feet, moments, "N m", LEAST_LOAD * float(units.energy), length, "tab:purple", labels, (1.0, 0.8)
        ),
    ]
    return np.concatenate(tips)


def draw_contacts(axes: Axes3D, equilibria: Sequence[Equilibrium], radii: Sequence[float]) -> str:
    """Draws contact forces on rods drawn this thick as lines that end on their surface, as long as the force per length
    is large; returns what to say of them in the picture.
    """
    feet, loads = [], []
    for equilibrium, radius in zip(equilibria, radii, strict=True):
        forces = np.asarray(equilibrium.contact_forces)
        sizes = np.linalg.norm(forces, axis=1)
        touches = sizes > LEAST_LOAD * float(equilibrium.state.units.force)
        along = forces[touches] / sizes[touches, None]
        feet.append(np.asarray(equilibrium.nodes)[touches] - radius * along)
        loads.append(forces[touches] / lengths_at_nodes(np.asarray(equilibrium.s))[touches, None])
    begins, pressures = np.concatenate(feet), np.concatenate(loads)
    if not len(begins):
        return ""
    nodes = np.concatenate([np.asarray(equilibrium.nodes) for equilibrium in equilibria])
    largest = np.max(np.linalg.norm(pressures, axis=1))
    ends = begins - CONTACT_LENGTH * ARROW_LENGTH * np.max(np.ptp(nodes, axis=0)) * pressures / largest
    lines = np.stack([begins, ends], axis=1)
    axes.add_collection3d(Line3DCollection(list(lines), colors=CONTACT_COLOR, linewidths=1.2))
    return f"orange: contact, at most {largest:.3g} N/m"


class Labels:
    """Words in a picture of `points` with arrows as long as `beyond` [m] at them; none is written on another."""

    def __init__(self, axes: Axes3D, points: Float[np.ndarray, "p 3"], beyond: float, azimuth: float):
        self.axes, (self.right, self.up, _) = axes, seen_axes(azimuth)
        extent = np.ptp(points @ np.stack([self.right, self.up], axis=1), axis=0) + 2 * beyond
        figure, place = axes.get_figure(root=True), axes.get_position()
        assert figure is not None
        page = 72 * np.array(figure.get_size_inches()) * [place.width, place.height]
        self._point = float(np.max(extent / page))  # [m]
        self._written: list[tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]] = []

    def write(
        self,
        text: str,
        color: str,
        choices: Sequence[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]],
        fontsize: float = 10,
    ) -> Float[np.ndarray, "3"]:
        """At the first of the places that is free, on the side of it that a direction tells; else, with a line to the
        first, as near to that as there is room. Returns the place.
        """
        size = self._point * fontsize / 10 * np.array([LABEL_SIZE[0] * len(text), LABEL_SIZE[1]])
        first, along = choices[0]
        steps = sorted(itertools.product(range(-8, 9), range(-8, 9)), key=lambda step: np.hypot(*step))
        aside = [first + size[1] * (x * self.right + y * self.up) for x, y in steps]
        places = [*choices, *((place, along) for place in aside)]
        at, towards = next((one for one in places if self._is_free(*self._box(one[0], one[1], size))), choices[0])
        self._written.append(self._box(at, towards, size))
        if not any(at is place for place, _ in choices):
            self.axes.plot(*np.stack([first, at], axis=1), color=color, linewidth=0.7, alpha=0.6)
        x, y, z = at
        ha, va = "right" if towards @ self.right < 0 else "left", "top" if towards @ self.up < 0 else "bottom"
        self.axes.text(x, y, z, text, color=color, fontsize=fontsize, ha=ha, va=va, path_effects=halo())
        return at

    def _box(self, at: Any, towards: Any, size: Any) -> tuple[Any, Any]:
        """The middle of what is written there, and its size."""
        side = np.where([towards @ self.right < 0, towards @ self.up < 0], -1.0, 1.0)
        return np.array([at @ self.right, at @ self.up]) + side * size / 2, size

    def _is_free(self, middle: Any, size: Any) -> bool:
        return not any(np.all(np.abs(middle - other) < (size + its) / 2) for other, its in self._written)


def draw_arrows(
    axes: Axes3D,
    feet: Float[np.ndarray, "k 3"],
    loads: Float[np.ndarray, "k 3"],
    unit: str,
    least: float,
    length: float,
    color: str,
    labels: Labels,
    heads: Sequence[float] = (1.0,),
) -> Float[np.ndarray, "p 3"]:
    """Arrows for loads not smaller than `least`, with their magnitudes, the largest `length` [m] long; returns their
    tips.
    """
    sizes = np.linalg.norm(loads, axis=1)
    tips = []
    for foot, load, size in zip(feet, loads, sizes, strict=True):
        if size < least:
            continue
        along, reach = load / size, length * size / max(sizes)
        for head in heads:
            (fx, fy, fz), (x, y, z) = foot, head * reach * along
            ratio = min(0.2 * length / (head * reach), 1.0)
            axes.quiver(fx, fy, fz, x, y, z, color=color, arrow_length_ratio=ratio, linewidth=1.8)
        # Beyond the tip, or where something is written there already before the foot.
        choices = [(foot + (reach + 0.05 * length) * along, along), (foot - 0.1 * length * along, -along)]
        tips.append(labels.write(f"{size:.3g} {unit}", color, choices))
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
    zoom: float | None = None,
    azimuth: float = AZIMUTH,
) -> float:
    """Limits around the points, one scale and one grid on all axes; returns the spacing of the grid [m]. `zoom`: `None`
    for as large as the names of the axes allow.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    spans = 1.04 * np.maximum(high - low, LEAST_DEPTH * np.max(high - low))
    ticks = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0.0, np.max(spans))
    grid = float(ticks[1] - ticks[0])
    for axis, center, span in zip((axes.xaxis, axes.yaxis, axes.zaxis), (low + high) / 2, spans, strict=True):
        axis.axes.set(**{f"{axis.axis_name}lim": (center - span / 2, center + span / 2)})
        axis.set_major_locator(MultipleLocator(grid))
        if labels:
            axis.set_label_text(f"{axis.axis_name} [m]")
            axis.labelpad = LABEL_PADS[axis.axis_name]
        else:
            axis.set_major_formatter(NullFormatter())
    if zoom is None:
        zoom = ZOOM - LESS * min(spans[2] / max(spans[:2]), 1.0)
    axes.set_box_aspect(tuple(spans), zoom=zoom)  # pyright: ignore[reportArgumentType]
    axes.set_proj_type("ortho")
    axes.view_init(ELEVATION, azimuth)
    return grid


def color_limits(values: Float[np.ndarray, "p"]) -> tuple[float, float]:
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
