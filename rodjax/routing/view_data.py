"""What pictures of routes show of each cable: its course, colors and what holds it."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize

from rodjax.analysis.curvature import curvature_along
from rodjax.analysis.pushes import Push, pushes
from rodjax.analysis.reactions import Reaction, reactions
from rodjax.drawing import AZIMUTH, COLOR_MAP, LABELS, LEAST_LOAD, largest_radius, radius_along, seen_axes
from rodjax.model.obstacles import Obstacle, Plane
from rodjax.model.surfaces import Faces, collar, parts_of, surfaces
from rodjax.routing.limits import Limits
from rodjax.solving.result import Equilibrium

# Margins of the bend radius between which colors differ, and the colors: of none red, from none on yellow to blue.
LEAST_MARGIN, MOST_MARGIN = -0.5, 1.0
NONE = -LEAST_MARGIN / (MOST_MARGIN - LEAST_MARGIN)
MARGIN_COLORS = LinearSegmentedColormap.from_list(
    "bend margin",
    [(0.0, "#67000d"), (NONE, "#ef3b2c"), (NONE, "#fed976"), (0.55, "#78c679"), (0.75, "#41b6c4"), (1.0, "#225ea8")],
)
# The margin that is told of a place that is nearly straight, at most.
FREE = 99.0
WITHOUT_LIMIT = (0.6, 0.6, 0.6, 1.0)
# By the largest extent of the cables: the thinnest that is drawn.
LEAST_RADIUS = 0.005
POINTS = 240


class CableView(NamedTuple):
    """One cable, and along it at k arclengths `s` [m]:

    `centerline` (k, 3) [m]; `radii` [m] as they are drawn; `curvature` [1/m]; `bend` [m], the bend radius, the inside
    one where the rod has a radius; `tension` [N]; and where the bend radius has a limit its `margin`.
    """

    name: str
    equilibrium: Equilibrium
    s: Float[np.ndarray, "k"]
    centerline: Float[np.ndarray, "k 3"]
    radii: Float[np.ndarray, "k"]
    curvature: Float[np.ndarray, "k"]
    bend: Float[np.ndarray, "k"]
    tension: Float[np.ndarray, "k"]
    margin: Float[np.ndarray, "k"] | None
    reactions: list[Reaction]
    pushes: list[Push]

    @property
    def radius(self) -> float:
        """As it is drawn where thickest [m]."""
        return float(np.max(self.radii))

    @property
    def forces(self) -> list[Reaction | Push]:
        """Of supports and obstacles, those that are more than rounding."""
        least = LEAST_LOAD * float(self.equilibrium.state.units.force)
        return [one for one in (*self.reactions, *self.pushes) if np.linalg.norm(one.force) > least]


class Coloring(NamedTuple):
    """How cables are colored: by the margins of their bend radii, or by curvature where none of them has a limit."""

    label: str
    norm: Normalize
    color_map: Colormap | str
    is_margin: bool

    def of(self, cable_view: CableView, s: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k 4"]:
        values = cable_view.margin if self.is_margin else cable_view.curvature
        if values is None:
            return np.tile(WITHOUT_LIMIT, (len(s), 1))
        return np.asarray(ScalarMappable(self.norm, self.color_map).to_rgba(np.interp(s, cable_view.s, values)))


def cable_view(name: str, equilibrium: Equilibrium, limits: Limits | None, extent: float) -> CableView:
    """One cable in a scene of this largest extent [m]."""
    true = equilibrium.scene.rod.radius
    s = jnp.linspace(equilibrium.s[0], equilibrium.s[-1], POINTS + 1)
    along, nodes = np.asarray(s), np.asarray(equilibrium.s)
    arclengths, curvatures = (np.asarray(x) for x in curvature_along(equilibrium))
    curvature = np.asarray(np.interp(along, arclengths, curvatures))
    radii = np.zeros(len(s)) if true is None else radius_along(true, s)
    with np.errstate(divide="ignore"):
        bend = 1 / curvature - radii
    margin = None
    if limits is not None and limits.bend_radius is not None:
        margin = np.minimum(bend / (2 * float(limits.bend_radius) * radii) - 1, FREE)
    thickest = 0.0 if true is None else largest_radius(true)
    least = LEAST_RADIUS * extent
    drawn = np.full(len(s), least) if thickest == 0 else radii * max(1.0, least / thickest)
    return CableView(
        name,
        equilibrium,
        along,
        np.asarray(equilibrium.position_at(s)),
        drawn,
        curvature,
        bend,
        np.asarray(np.interp(along, nodes, np.asarray(equilibrium.tension))),
        margin,
        reactions(equilibrium),
        pushes(equilibrium),
    )


def extent(equilibria: Sequence[Equilibrium]) -> float:
    """The largest extent of cables along an axis of the scene [m]."""
    nodes = np.concatenate([np.asarray(equilibrium.nodes) for equilibrium in equilibria])
    return float(np.max(np.ptp(nodes, axis=0)))


def coloring(cable_views: Sequence[CableView]) -> Coloring:
    if any(cable_view.margin is not None for cable_view in cable_views):
        norm = Normalize(LEAST_MARGIN, MOST_MARGIN)
        return Coloring("margin of the inside bend radius", norm, MARGIN_COLORS, True)
    largest = max(float(np.max(cable_view.curvature)) for cable_view in cable_views)
    return Coloring(LABELS["curvature"], Normalize(0.0, largest if largest > 1e-9 else 1.0), COLOR_MAP, False)


def thickness_note(cable_views: Sequence[CableView]) -> str:
    """What to say of cables that are not as thick as they are drawn."""
    radii = [cable_view.equilibrium.scene.rod.radius for cable_view in cable_views]
    if any(radius is None for radius in radii):
        return "thickness not to scale"
    times = max(
        cable_view.radius / largest_radius(radius) for cable_view, radius in zip(cable_views, radii, strict=True)
    )
    return f"drawn up to {times:.2g} times as thick as it is" if times > 1.01 else ""


def clip_faces(cable_view: CableView) -> list[Faces]:
    """A collar around the cable for each clip."""
    return [collar(clip.position, clip.axes[0], cable_view.radius) for clip in cable_view.reactions[1:-1]]


def azimuth(cable_views: Sequence[CableView], obstacles: Sequence[Obstacle]) -> float:
    """From where to look [degrees]: as all pictures do, or where that is from behind a wall, by right angles aside.

    Of places before all walls, the one from which the cables are seen widest.
    """
    walls = [np.asarray(part.normal) for one in obstacles for part in parts_of(one) if isinstance(part, Plane)]
    points = np.concatenate([cable_view.centerline for cable_view in cable_views])

    def hidden(place: float) -> float:
        # Rounding shall not choose.
        return round(sum(max(0.0, -float(seen_axes(place)[2] @ wall)) for wall in walls), 6)

    if hidden(AZIMUTH) == 0:
        return AZIMUTH
    azimuths = [AZIMUTH + turn for turn in (0, 180, 90, -90)]
    return min(azimuths, key=lambda place: (hidden(place), -round(float(np.std(points @ seen_axes(place)[0])), 6)))


def seen_surfaces(cable_views: Sequence[CableView], obstacles: Sequence[Obstacle]) -> list[Faces]:
    """Those of obstacles near the cables."""
    points = np.concatenate([cable_view.centerline for cable_view in cable_views])
    thickest = max(cable_view.radius for cable_view in cable_views)
    # The room that the tubes take, so that a patch of a floor lies below all of it.
    return surfaces(obstacles, np.concatenate([points - thickest, points + thickest])) if obstacles else []
