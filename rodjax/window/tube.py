"""Rods as short cylinders, each of one colour, and strips along their directors: all that changes in a move are places,
turns and colours of the same meshes.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.ticker import MaxNLocator

from rodjax.drawing import COLOR_MAP

# Faces around a rod, and of them those of a strip.
AROUND, STRIP = 24, 3
STRIP_COLORS = ((30, 30, 30), (245, 245, 245))
# By the radius, how far strips stand out.
OUT = 1.06
# So many bands of colour at most: more cannot be told from one another, nor read off a legend.
MOST_BANDS = 12
# Ranges narrower than this part of their values, or than this, are rounding.
LEAST_RANGE, LEAST_VALUE = 1e-3, 1e-9


class Faces(NamedTuple):
    """Triangles: vertices (v, 3), and three of their numbers for each."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def cylinder() -> Faces:
    """Of radius 1 and length 1 about the z axis, with both ends."""
    angles = 2 * np.pi / AROUND * np.arange(AROUND)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    around = np.arange(AROUND)
    onward = (around + 1) % AROUND
    low, high = around, AROUND + around
    sides = [np.stack([low, onward, AROUND + onward], axis=1), np.stack([low, AROUND + onward, high], axis=1)]
    # Points of their own, so that edges are sharp.
    base, top = 2 * AROUND, 3 * AROUND
    caps = [
        np.stack([np.full(AROUND, 4 * AROUND), base + onward, base + around], axis=1),
        np.stack([np.full(AROUND, 4 * AROUND + 1), top + around, top + onward], axis=1),
    ]
    levels = [np.column_stack([ring, np.full(AROUND, z)]) for z in (-0.5, 0.5)]
    vertices = np.concatenate([*levels, *levels, [[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]]])
    return Faces(vertices.astype(np.float32), np.concatenate([*sides, *caps]).astype(np.uint32))


def strip() -> Faces:
    """Of a slightly larger cylinder, about the x axis."""
    angles = 2 * np.pi / AROUND * (np.arange(STRIP + 1) - STRIP / 2)
    ring = OUT * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate([np.column_stack([ring, np.full(STRIP + 1, z)]) for z in (-0.5, 0.5)])
    low = np.arange(STRIP)
    high = STRIP + 1 + low
    faces = [np.stack([low, low + 1, high + 1], axis=1), np.stack([low, high + 1, high], axis=1)]
    return Faces(vertices.astype(np.float32), np.concatenate(faces).astype(np.uint32))


def ball() -> Faces:
    """Of radius 1: an octahedron of which each face has been parted three times."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    triangles = corners[[[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]]
    for _ in range(3):
        a, b, c = np.moveaxis(triangles, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return Faces(vertices.astype(np.float32), faces.reshape(-1, 3).astype(np.uint32))


def half_turned(wxyzs: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "k 4"]:
    """Quaternions (w, x, y, z) turned by half a turn about their own z axes."""
    w, x, y, z = wxyzs.T
    return np.stack([-z, y, -x, w], axis=1)


class Scale(NamedTuple):
    """Edges of the bands, and a colour for each, (bands, 3), 0 to 255."""

    edges: Float[np.ndarray, "bands+1"]
    colors: Int[np.ndarray, "bands 3"]


def scale_over(low: float, high: float) -> Scale:
    """Bands with round edges from below `low` to above `high`."""
    middle = (low + high) / 2
    half = max((high - low) / 2, LEAST_RANGE * abs(middle), LEAST_VALUE)
    ticks = MaxNLocator(MOST_BANDS - 2, steps=[1, 2, 2.5, 5, 10]).tick_values(middle - half, middle + half)
    edges = np.asarray(ticks)
    shares = (np.arange(len(edges) - 1) + 0.5) / (len(edges) - 1)
    return Scale(edges, np.round(255 * colormaps[COLOR_MAP](shares)[:, :3]).astype(int))


def covers(scale: Scale, values: Float[np.ndarray, "k"]) -> bool:
    return bool(scale.edges[0] <= np.min(values) and np.max(values) <= scale.edges[-1])


def as_light(colors: Int[np.ndarray, "k 3"]) -> Int[np.ndarray, "k 3"]:
    """Colours of a screen, 0 to 255, as amounts of light: so viser's batched meshes take them."""
    shares = np.asarray(colors) / 255
    light = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return np.round(255 * light).astype(np.uint8)


def colors_of(values: Float[np.ndarray, "k+1"], scale: Scale) -> Int[np.ndarray, "k 3"]:
    """By the bands of the mean values of neighbours."""
    means = (values[1:] + values[:-1]) / 2
    band = np.clip(np.searchsorted(scale.edges, means, side="right") - 1, 0, len(scale.colors) - 1)
    return scale.colors[band].astype(np.uint8)
