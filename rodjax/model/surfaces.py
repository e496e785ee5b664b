"""Surfaces of obstacles as faces to be drawn, near what shall be seen beside them."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.model.obstacles import Box, Capsule, Cylinder, Obstacle, Pipe, Plane, Sphere, Union
from rodjax.model.triangle_mesh import Mesh
from rodjax.programs.compilation import compiled

# Corners of faces; a triangle has its last one twice.
Faces = Float[np.ndarray, "f 4 3"]

# By the largest extent of what shall be seen: how far around it obstacles are drawn, and a plane reaches beyond it.
AROUND = 0.75
BEYOND = 0.08
# Faces around something round, along its meridian, along an edge of the largest extent, and cells of a grid along it.
FACES_AROUND = 32
FACES_ALONG = 12
CELLS = 28
# A collar, by the radius of the rod: its own, and half of its length.
COLLAR_RADIUS, COLLAR_LENGTH = 1.7, 1.4
# What is deeper within a pipe, by its radius, is no flat face of it.
LEAST_DEPTH = 0.03
# Triangles of a mesh at most; more are joined.
MOST_TRIANGLES = 4000
# Steps onto the surface of what has only a distance.
STEPS = 2

CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


class Region(NamedTuple):
    """A box between two corners [m], and the largest extent of what shall be seen in it."""

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    extent: float


def surfaces(obstacles: Sequence[Obstacle], points: Float[np.ndarray, "p 3"]) -> list[Faces]:
    """Faces of each obstacle [m], as far as they are near the points: a plane as a patch below all the others."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(np.max(high - low))
    region = Region(low - AROUND * extent, high + AROUND * extent, extent)
    parts = [list(parts_of(obstacle)) for obstacle in obstacles]
    near = [[_near(_faces(part, region), region) for part in own if not isinstance(part, Plane)] for own in parts]
    seen = np.concatenate([points, *(faces.reshape(-1, 3) for own in near for faces in own)])
    for own, faces in zip(parts, near, strict=True):
        faces += [_patch(part, seen, region) for part in own if isinstance(part, Plane)]
    return [np.concatenate([np.zeros((0, 4, 3)), *faces]) for faces in near]


def quads(grid: Float[np.ndarray, "p q 3"]) -> Float[np.ndarray, "f 4 3"]:
    """The faces between neighbours in a grid of points, row by row."""
    corners = (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1])
    return np.stack(corners, axis=2).reshape(-1, 4, 3)


def parts_of(obstacle: Obstacle) -> list[Obstacle]:
    """An obstacle, or those that a union is of."""
    if not isinstance(obstacle, Union):
        return [obstacle]
    return [part for one in obstacle.obstacles for part in parts_of(one)]


def _faces(obstacle: Obstacle, region: Region) -> Faces:
    if isinstance(obstacle, Sphere):
        return round_faces(obstacle.center, obstacle.center, float(obstacle.radius), region.extent, has_caps=True)
    if isinstance(obstacle, Capsule | Cylinder):
        has_caps = isinstance(obstacle, Capsule)
        return round_faces(obstacle.start, obstacle.end, float(obstacle.radius), region.extent, has_caps)
    if isinstance(obstacle, Pipe):
        radius, ends = float(obstacle.radius), itertools.pairwise(np.asarray(obstacle.points))
        faces = np.concatenate([round_faces(*pair, radius, region.extent, has_caps=True) for pair in ends])
        # Not those of one straight part within the next.
        return faces[np.asarray(obstacle.distance(faces.mean(axis=1))) > -LEAST_DEPTH * radius]
    if isinstance(obstacle, Box):
        return _box(obstacle, region.extent)
    if isinstance(obstacle, Mesh):
        triangles = _split(_joined(np.asarray(obstacle.triangles)), region.extent / FACES_ALONG)
        return np.concatenate([triangles, triangles[:, -1:]], axis=1)
    return _level_set(obstacle, region)


def _near(faces: Faces, region: Region) -> Faces:
    middles = faces.mean(axis=1)
    return faces[np.all((middles >= region.low) & (middles <= region.high), axis=1)]


def round_faces(start, end, radius: float, extent: float, has_caps: bool) -> Faces:
    """Those of a cylinder from start to end, its ends flat or half balls; `extent` [m] of what is seen beside it."""
    start, end = np.asarray(start), np.asarray(end)
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    along = np.linspace(0.0, length, _pieces(length, extent) + 1)
    wall = np.stack([along, np.full(len(along), radius)], axis=1)
    if has_caps:
        angles = np.linspace(0.0, np.pi / 2, FACES_AROUND // 4 + 1)[:-1]
        cap = radius * np.stack([-np.cos(angles), np.sin(angles)], axis=1)
    else:
        cap = np.stack([np.zeros(3), radius * np.array([0.0, 0.4, 0.75])], axis=1)
    beyond = cap[::-1] * np.array([-1.0, 1.0]) + np.array([length, 0.0])
    profile = np.concatenate([cap, wall if length > 0 else wall[:1], beyond])
    first, second = normals_of(axis)
    angles = np.linspace(0.0, 2 * np.pi, FACES_AROUND + 1)
    around = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    return quads(start + profile[:, :1, None] * axis + profile[:, 1:, None] * around)


def collar(position, axis, radius: float) -> Faces:
    """What shows a clip: a short cylinder around a rod of this radius [m], about the unit vector `axis`."""
    reach = COLLAR_LENGTH * radius * np.asarray(axis)
    position = np.asarray(position)
    return round_faces(position - reach, position + reach, COLLAR_RADIUS * radius, 1e3 * radius, has_caps=False)


def normals_of(axis: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Two unit vectors that make a right-handed frame with a third."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _pieces(length: float, extent: float) -> int:
    return int(np.clip(np.ceil(FACES_ALONG * length / extent), 1, 4 * FACES_ALONG))


def _box(box: Box, extent: float) -> Faces:
    frame = np.eye(3) if box.frame is None else np.asarray(box.frame)
    edges = (np.asarray(box.size) / 2)[:, None] * frame.T
    sides = []
    for k in range(3):
        u, v = edges[k - 1], edges[k - 2]
        sides += [_grid(sign * (edges[k] - v) - u, 2 * u, 2 * sign * v, extent) for sign in (-1.0, 1.0)]
    return np.asarray(box.center) + np.concatenate(sides)


def _grid(corner: np.ndarray, u: np.ndarray, v: np.ndarray, extent: float) -> Faces:
    """A parallelogram, seen from where v x u points, in small faces, which are sorted in depth each for itself."""
    i, j = (np.linspace(0.0, 1.0, _pieces(float(np.linalg.norm(edge)), extent) + 1) for edge in (u, v))
    return quads(corner + i[:, None, None] * u + j[:, None] * v)


def _patch(plane: Plane, seen: Float[np.ndarray, "p 3"], region: Region) -> Faces:
    """The part of a plane that all which is seen is above, or nothing of a plane far away."""
    normal = np.asarray(plane.normal)
    heights = (seen - np.asarray(plane.point)) @ normal
    if np.min(np.abs(heights)) > AROUND * region.extent and np.all(heights > 0):
        return np.zeros((0, 4, 3))
    # Along the axes of the scene where the plane is.
    first = np.eye(3)[np.argmin(np.abs(normal))]
    first = first - (first @ normal) * normal
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    foot = seen[0] - heights[0] * normal
    coordinates = (seen - foot) @ np.stack([first, second], axis=1)
    low = coordinates.min(axis=0) - BEYOND * region.extent
    width, depth = coordinates.max(axis=0) + BEYOND * region.extent - low
    return _grid(foot + low[0] * first + low[1] * second, depth * second, width * first, region.extent)


def _joined(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "k 3 3"]:
    """A mesh of few enough triangles: corners in one cell of a grid become one."""
    low = triangles.min(axis=(0, 1))
    size = np.max(triangles.max(axis=(0, 1)) - low)
    cells = 64.0
    while len(triangles) > MOST_TRIANGLES:
        corners_of_cells = np.round((triangles - low) * (cells / size))
        corners, index = np.unique(corners_of_cells.reshape(-1, 3), axis=0, return_inverse=True)
        faces = index.reshape(-1, 3)
        faces = faces[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]]
        faces = faces[np.all(faces != np.roll(faces, 1, axis=1), axis=1)]
        if len(faces) <= MOST_TRIANGLES:
            return low + corners[faces] * (size / cells)
        cells *= 0.8
    return triangles


def _split(triangles: Float[np.ndarray, "f 3 3"], longest: float) -> Float[np.ndarray, "k 3 3"]:
    """Triangles with edges that are not much longer than that, where they do not become too many."""
    while True:
        is_long = np.max(np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2), axis=1) > 2 * longest
        if not np.any(is_long) or len(triangles) + 3 * np.sum(is_long) > MOST_TRIANGLES:
            return triangles
        corners = triangles[is_long]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        parts = [np.stack([corners[:, k], middles[:, k], middles[:, k - 1]], axis=1) for k in range(3)]
        triangles = np.concatenate([triangles[~is_long], *parts, middles])


# --- what has only a distance ----------------------------------------------------------------------------------------


def _level_set(obstacle: Obstacle, region: Region) -> Faces:
    """The surface by a vertex in each cell of a grid through which it passes (Gibson 1998, "Constrained elastic
    surface nets"), moved onto it along the gradient."""
    grid, distance, width = _sampled(obstacle, region.low, region.high)
    # Again where it is, as it may be small.
    is_near = np.abs(distance) <= width
    if not np.any(is_near):
        return np.zeros((0, 4, 3))
    low, high = (np.clip(x, region.low, region.high) for x in _around(grid[is_near], width))
    grid, distance, width = _sampled(obstacle, low, high)
    low, counts = grid[0, 0, 0], np.array(distance.shape) - 1
    is_inside = distance < 0
    corners = [tuple(slice(k, n + k) for k, n in zip(corner, counts, strict=True)) for corner in CORNERS]
    inside = sum(is_inside[corner].astype(int) for corner in corners)
    cells = np.argwhere((inside > 0) & (inside < len(corners)))
    if not len(cells):
        return np.zeros((0, 4, 3))
    # In a cell, the mean of the places where the surface crosses its edges.
    at_corners = np.stack([distance[tuple((cells + corner).T)] for corner in CORNERS], axis=1)
    total, count = np.zeros((len(cells), 3)), np.zeros((len(cells), 1))
    for a, b in itertools.combinations(range(len(CORNERS)), 2):
        if np.sum(CORNERS[a] != CORNERS[b]) != 1:
            continue
        from_a, from_b = at_corners[:, a], at_corners[:, b]
        crosses = (from_a < 0) != (from_b < 0)
        part = np.where(crosses, from_a / np.where(crosses, from_a - from_b, 1.0), 0.0)
        total += crosses[:, None] * (CORNERS[a] + part[:, None] * (CORNERS[b] - CORNERS[a]))
        count += crosses[:, None]
    vertices = low + width * (cells + total / count)
    vertices = np.asarray(_onto(obstacle, jnp.asarray(vertices), jnp.asarray(width)))
    index = np.full(counts, -1)
    index[tuple(cells.T)] = np.arange(len(cells))
    return vertices[np.concatenate([_around_edges(is_inside, index, axis) for axis in range(3)])]


def _sampled(
    obstacle: Obstacle, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "i j k 3"], Float[np.ndarray, "i j k"], float]:
    """The corners of cubes that fill a box, the distances there, and the edge of the cubes."""
    width = float(np.max(high - low)) / CELLS
    counts = np.maximum(np.ceil((high - low) / width - 1e-9), 1).astype(int)
    grid = low + width * np.stack(np.meshgrid(*(np.arange(n + 1) for n in counts), indexing="ij"), axis=-1)
    return grid, np.asarray(obstacle.distance(grid)), width


def _around(points: Float[np.ndarray, "p 3"], width: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return points.min(axis=0) - width, points.max(axis=0) + width


def _around_edges(is_inside: np.ndarray, index: np.ndarray, axis: int) -> np.ndarray:
    """The four cells around each edge of the grid along an axis that crosses the surface, (f, 4)."""
    is_inside, index = np.moveaxis(is_inside, axis, 0), np.moveaxis(index, axis, 0)
    crosses = is_inside[1:] != is_inside[:-1]
    i, j, k = np.argwhere(crosses[:, 1:-1, 1:-1]).T
    cells = np.stack((index[i, j, k], index[i, j + 1, k], index[i, j + 1, k + 1], index[i, j, k + 1]), axis=1)
    # Seen from outside: the other two axes are in the order of a left-handed frame about the second.
    turns = is_inside[i + 1, j + 1, k + 1] != (axis == 1)
    return np.where(turns[:, None], cells[:, ::-1], cells)


@compiled
def _onto(obstacle: Obstacle, points: Float[Array, "v 3"], most: Float[Array, ""]) -> Float[Array, "v 3"]:
    """Points moved onto the surface, by no more than `most` a step."""

    def moved(point: Float[Array, "3"]) -> Float[Array, "3"]:
        distance, slope = jax.value_and_grad(obstacle.at)(point)
        squared = jnp.sum(slope**2)
        way = distance / jnp.where(squared > 0, squared, 1.0) * slope
        length = jnp.sqrt(jnp.sum(way**2))
        fits = jnp.isfinite(length) & (length < most)
        return jnp.where(fits, point - way, point)

    for _ in range(STEPS):
        points = jax.vmap(moved)(points)
    return points
