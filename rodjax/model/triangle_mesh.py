"""Closed meshes of triangles as obstacles."""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.checks import file_path, leaf, line, positive, shown
from rodjax.geometry.vectors import cross, dot, root
from rodjax.model.obstacles import Obstacle, coefficient, least, rows, squared_distance_to_segment

# Edges without a partner that a message shows.
MOST_EDGES = 3


class Mesh(Obstacle):
    """The body within closed surfaces of triangles; `Mesh.from_stl` reads a file.

    - `vertices`: (v, 3) [m].
    - `faces`: (f, 3) whole numbers, the vertices of each triangle in the same sense as seen from outside.

    Distances are exact, and found without a tree: of every point from every triangle, some 300 f operations and half a
    millisecond a point for 5000 triangles on one processor core; memory grows as f alone. Derivatives are those of the
    distance from the nearest triangle, at the price of one.

    The inside is where the winding number is not zero (Jacobson, Kavan & Sorkine-Hornung 2013, "Robust inside-outside
    segmentation using generalized winding numbers"). Bodies may so overlap; there the depth is the distance from the
    nearest triangle, be it inside of another body.

    Raises `ValueError` where the triangles leave holes: where an edge is not run along as often in each sense.
    """

    triangles: Float[Array, "f 3 3"]

    def __init__(self, vertices: Any, faces: Any, friction: Any = 0.0):
        self.friction = coefficient(friction)
        vertices = rows(vertices, "vertices", least=4, shape="(v, 3), v >= 4")
        if vertices.ndim != 2:
            raise ValueError(
                f"vertices must be numbers of shape (v, 3), v >= 4, got an array of shape {vertices.shape}"
            )
        faces = _faces(faces, len(vertices))
        _check_closed(faces)
        self.triangles = leaf(vertices[faces])

    @staticmethod
    def from_stl(path: str | os.PathLike[str], scale: Any = 1.0, friction: Any = 0.0) -> "Mesh":
        """The body in an STL file, text or binary. It takes `pip install 'rodjax[meshes]'`.

        `scale`: metres in the unit of the file, which STL does not tell: 1e-3 where it is in mm.

        Raises `ValueError` where the file is no STL or its surface has holes, `OSError` where it cannot be read.
        """
        path, scale = file_path(path, "path"), positive(scale, "scale")
        try:
            import trimesh  # 1 s, which a scene without meshes need not wait for
        except ImportError:
            raise ImportError("Mesh.from_stl needs trimesh, got none: pip install 'rodjax[meshes]'") from None
        try:
            with path.open("rb") as file:
                # Processing joins the corners of triangles that STL stores apart.
                read = trimesh.load_mesh(file, file_type="stl", process=True)
            vertices, faces = np.asarray(read.vertices), np.asarray(read.faces)
        except OSError:
            raise
        except Exception as error:  # of many kinds, for a file that is something else
            raise ValueError(f"path must name an STL file, got {str(path)!r}: {line(str(error))}") from None
        if len(faces) == 0:
            raise ValueError(f"path must name an STL file with triangles, got {str(path)!r} with none")
        try:
            return Mesh(scale * vertices, faces, friction)
        except ValueError as error:
            raise ValueError(f"path must name an STL file of a closed surface, got {str(path)!r}: {error}") from None

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        here, corners = jax.lax.stop_gradient((point[:, None], jnp.transpose(self.triangles, (1, 2, 0))))
        nearest = jnp.argmin(_squared_distance_to_triangle(here, *corners))
        sign = jnp.where(jnp.abs(_winding_number(corners - here[None])) > 0.5, -1.0, 1.0).astype(point.dtype)
        return sign * root(_squared_distance_to_triangle(point, *self.triangles[nearest]))


def _squared_distance_to_triangle(
    point: Float[Array, "3 *k"], a: Float[Array, "3 *k"], b: Float[Array, "3 *k"], c: Float[Array, "3 *k"]
) -> Float[Array, "*k"]:
    """[m^2]: from the plane where the foot of the perpendicular lies within, else from the nearest edge."""
    normal = cross(b - a, c - a)
    edges = ((a, b), (b, c), (c, a))
    is_above = jnp.stack([dot(cross(end - start, point - start), normal) > 0 for start, end in edges])
    squared_normal = dot(normal, normal)
    # A triangle without area has no plane, only edges.
    is_plane = jnp.all(is_above, axis=0) & (squared_normal > 0)
    from_plane = dot(point - a, normal) ** 2 / jnp.where(is_plane, squared_normal, 1.0)
    from_edges = least(*(squared_distance_to_segment(point, *edge) for edge in edges))
    return jnp.where(is_plane, from_plane, from_edges)


def _winding_number(corners: Float[Array, "3 3 f"]) -> Float[Array, ""]:
    """How often triangles with these corners, counted from a point, go around it.

    Solid angles by van Oosterom & Strackee 1983, "The solid angle of a plane triangle".
    """
    a, b, c = corners
    la, lb, lc = (root(dot(corner, corner)) for corner in (a, b, c))
    volume = dot(a, cross(b, c))
    angles = 2 * jnp.arctan2(volume, la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb)
    return jnp.sum(angles) / (4 * np.pi)


def _faces(faces: Any, vertices: int) -> Int[np.ndarray, "f 3"]:
    try:
        array = np.asarray(faces)
        if not np.issubdtype(array.dtype, np.integer):
            raise TypeError
    except (TypeError, ValueError):
        raise TypeError(f"faces must be whole numbers of shape (f, 3), f >= 4, got {shown(faces)}") from None
    if array.ndim != 2 or array.shape[1] != 3 or len(array) < 4:
        raise ValueError(f"faces must be whole numbers of shape (f, 3), f >= 4, got an array of shape {array.shape}")
    if np.min(array) < 0 or np.max(array) >= vertices:
        raise ValueError(f"faces must be from 0 to {vertices - 1}, got {np.min(array)} to {np.max(array)}")
    return array


def _check_closed(faces: Int[np.ndarray, "f 3"]) -> None:
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, first = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    senses = np.sign(directed[:, 1] - directed[:, 0])  # an edge from a vertex to itself needs no partner
    balance = np.bincount(first.reshape(-1), weights=senses)
    open_edges = edges[balance != 0]
    if len(open_edges):
        raise ValueError(
            f"faces must close a surface, each edge run along as often in each sense, got {len(open_edges)} edges that "
            f"are not, such as {open_edges[:MOST_EDGES].tolist()}; trimesh.repair may mend it"
        )
