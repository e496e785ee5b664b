"""The shape that a user gives a solve to begin with."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import leaf, number_array, shown
from rodjax.discretization.first_shape import first_shape, hanging_arc
from rodjax.discretization.joints import generic_field
from rodjax.geometry.interpolation import resampled, through
from rodjax.mechanics.taut import DRAWN_PIECES, drawn_in, led_out
from rodjax.model.scene import Scene, has_no_place, nondimensional, scene_axes
from rodjax.model.supports import Clip, Directed, Held
from rodjax.model.triangle_mesh import Mesh
from rodjax.programs.compilation import compiled
from rodjax.programs.stacks import of_each
from rodjax.units import Units

# Cosine between neighbouring edges below which a guess counts as folded, and by how much of an edge it is unfolded.
FOLDED = -0.99
ASIDE = 0.05
ARC_PIECES = 64
# A free end is led out against gravity; where that has no part across the rod, to this side of the scene's axes.
UPWARDS = np.array([3e-6, 2e-6, 1e-6])
# Beside a mesh of more triangles no shape is led out: a round takes 6 us for each triangle, and there may be thousands.
MOST_TRIANGLES = 500


class Guess(eqx.Module):
    """An initial shape; it need not match the supports, the length or the mesh.

    Beside obstacles it tells on which side the rod passes them. It is led out of obstacles first, and between two
    supports or clips drawn in where it is longer than the rod. A rod with two free ends and no clip, which friction
    may hold, lies where its guess is: from there it slips.

    `points`: (m, 3) [m], m >= 2, equally spaced in arclength; `total_twist` [rad]: of the total twists that the end
    frames allow on this shape, the solution has the one nearest to this.
    """

    points: Float[Array, "m 3"]
    total_twist: Float[Array, ""]

    def __init__(self, points: Any, total_twist: Any = 0.0):
        try:
            shape = np.shape(points)
        except ValueError:
            raise TypeError(f"points must be numbers of shape (m, 3), got {shown(points)}") from None
        if len(shape) != 2 or shape[0] < 2 or shape[1] != 3:
            raise ValueError(f"points must have the shape (m, 3) with m >= 2, got {shape}")
        self.points = leaf(number_array(points, "points", shape))
        self.total_twist = leaf(number_array(total_twist, "total_twist"))

    def nodes(self, scene: Scene, units: Units, segments: int) -> Float[Array, "n+1 3"]:
        """The nodes of a mesh on this shape, for a nondimensional scene; beside obstacles as of `beside_obstacles`."""
        points = (self.points - units.origin[None]) / units.length
        return _unfolded(beside_obstacles(scene, points, segments), scene_axes(scene))


def beside_obstacles(scene: Scene, points: Float[Array, "m 3"], segments: int) -> Float[Array, "n+1 3"]:
    """The nodes of a mesh on a shape, for a nondimensional scene; where obstacles are near, on one that is drawn in or
    led out, if it is longer than the rod between two supports or lies within an obstacle: each span between two places
    that are held, and what is beyond the last one, by itself.

    Not where no place is held, and not beside a `Mesh` of many triangles, whose distance is dear.
    """
    nodes = resampled(points, segments)
    start, end, radius, obstacles = scene.start, scene.end, scene.rod.radius, scene.obstacles
    is_dear = any(map(_is_dear, jax.tree.leaves(obstacles, is_leaf=_is_dear)))
    if not obstacles or is_dear or has_no_place(scene):
        return nodes
    assert radius is not None, "a rod beside obstacles has a radius"
    thickest = jnp.max(getattr(radius, "values", radius))
    zero = jnp.zeros((), nodes.dtype)
    held: list[tuple[Array, Held | Clip]] = [(clip.at, clip) for clip in scene.clips]
    if isinstance(start, Held):
        held.insert(0, (zero, start))
    if isinstance(end, Held):
        held.append((zero + 1, end))
    at = jnp.stack([at for at, _ in held])
    position = jnp.stack([support.position for _, support in held])
    tangent = jnp.stack([_tangent(support) for _, support in held])
    pieces = jnp.linspace(0.0, 1.0, DRAWN_PIECES + 1, dtype=nodes.dtype)
    s = jnp.linspace(0.0, 1.0, segments + 1, dtype=nodes.dtype)

    def on_string(string: Array, is_needed: Array, first: Array, last: Array) -> tuple[Array, Array]:
        """The nodes that lie on it, and which do."""
        u = (s - first) / (last - first)
        return through(string, jnp.clip(u, 0.0, 1.0)), is_needed & (u >= 0) & (u <= 1)

    def drawn(at: Array, positions: Array, tangents: Array) -> tuple[Array, Array]:
        length = at[1] - at[0]
        span = through(points, at[0] + length * pieces).at[0].set(positions[0]).at[-1].set(positions[1])
        return on_string(*drawn_in(span, tangents, obstacles, thickest, length), at[0], at[1])

    def led(first: Array, last: Array, position: Array, tangent: Array) -> tuple[Array, Array]:
        """From a place that is held to a free end, forwards or backwards."""
        upwards = scene_axes(scene) @ UPWARDS - (0.0 if scene.gravity is None else scene.gravity)
        beyond, length = through(points, first + (last - first) * pieces).at[0].set(position), last - first
        string = led_out(beyond, jnp.sign(length) * tangent, upwards, obstacles, thickest, jnp.abs(length))
        return on_string(*string, first, last)

    found: list[tuple[Array, Array]] = []
    if len(held) > 1:
        spans = (jnp.stack([of_places[:-1], of_places[1:]], axis=1) for of_places in (at, position, tangent))
        found += zip(*of_each(drawn)(*spans), strict=True)
    if not isinstance(start, Held):
        found.append(led(at[0], zero, position[0], tangent[0]))
    if not isinstance(end, Held):
        found.append(led(at[-1], zero + 1, position[-1], tangent[-1]))
    for there, is_there in found:
        nodes = jnp.where(is_there[:, None], there, nodes)
    return nodes


def _tangent(support: Held | Clip) -> Float[Array, "3"]:
    """Zero where it holds none."""
    if isinstance(support, Directed):
        return support.tangent
    tangent = support.direction if isinstance(support, Clip) else None
    return jnp.zeros_like(support.position) if tangent is None else tangent


def other_guess(scene: Scene, *, planar: bool) -> Guess | None:
    """Another shape to begin with: the arc that hangs between two supports, whatever tangents they hold; a rod with a
    free end that began in its shape at rest, straight. `None` with clips, and where there is no other.
    """
    has_free_end = not (isinstance(scene.start, Held) and isinstance(scene.end, Held))
    if scene.clips or has_no_place(scene) or (scene.rod.rest_shape is None if has_free_end else planar):
        return None
    return Guess(_other_points(scene))


@compiled
def _other_points(scene: Scene) -> Float[Array, "m 3"]:
    scaled, units = nondimensional(scene)
    is_held = isinstance(scene.start, Held) and isinstance(scene.end, Held)
    points = hanging_arc(scaled, ARC_PIECES) if is_held else first_shape(scaled, ARC_PIECES)
    return units.origin[None] + units.length * points


def _is_dear(obstacle: Any) -> bool:
    return isinstance(obstacle, Mesh) and len(obstacle.triangles) > MOST_TRIANGLES


def _unfolded(nodes: Float[Array, "n+1 3"], axes: Float[Array, "3 3"]) -> Float[Array, "n+1 3"]:
    """Where an edge runs back along the last one, or has no length, all edges a little aside: such have no torsion."""
    edges = jnp.diff(nodes, axis=0)
    lengths = jnp.sqrt(jnp.sum(edges**2, axis=1))
    least = ASIDE * jnp.maximum(jnp.mean(lengths), ASIDE / len(edges))
    aside = edges + least * generic_field(edges.T, axes).T
    cosines = jnp.sum(edges[1:] * edges[:-1], axis=1) / jnp.maximum(lengths[1:] * lengths[:-1], least**2)
    is_folded = jnp.any(cosines < FOLDED) | jnp.any(lengths < least)
    unfolded = nodes[:1] + jnp.concatenate([jnp.zeros((1, 3), nodes.dtype), jnp.cumsum(aside, axis=0)])
    return jnp.where(is_folded, unfolded, nodes)
