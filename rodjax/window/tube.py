"""The surface of a rod as triangles, in bands of one colour each, with strips along its directors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.ticker import MaxNLocator

from rodjax.plot import COLOR_MAP, FACES_AROUND, STRIP_FACES, STRIPS

# So many bands of colour at most: more cannot be told from one another, nor read off a legend.
MOST_BANDS = 12
# Ranges narrower than this part of their values, or than this, are rounding.
LEAST_RANGE, LEAST_VALUE = 1e-3, 1e-9


class Part(NamedTuple):
    """Triangles: vertices (v, 3) [m], and three of their numbers for each."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


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


def rings(
    centerline: Float[np.ndarray, "k 3"],
    d1: Float[np.ndarray, "k 3"],
    d2: Float[np.ndarray, "k 3"],
    radius: float | Float[np.ndarray, "k"],
) -> Float[np.ndarray, "k m 3"]:
    """Points around the rod, right-handed about its tangent; the middle of the first `STRIP_FACES` is along d1."""
    angle = 2 * np.pi / FACES_AROUND * (np.arange(FACES_AROUND) - STRIP_FACES / 2)
    around = np.cos(angle)[:, None] * d1[:, None] + np.sin(angle)[:, None] * d2[:, None]
    return centerline[:, None] + np.broadcast_to(radius, len(centerline))[:, None, None] * around


def strip_columns() -> list[Int[np.ndarray, "c"]]:
    """The columns of faces of each strip."""
    return [(first + np.arange(STRIP_FACES)) % FACES_AROUND for first, _ in STRIPS]


def strip_colors() -> list[tuple[int, int, int]]:
    # Not quite black and white, which would hide the shading.
    return [(30, 30, 30) if sum(color) == 0 else (245, 245, 245) for _, color in STRIPS]


def strips(points: Float[np.ndarray, "k m 3"]) -> list[Part]:
    """The strips all along the rod."""
    return [_part(points, np.arange(len(points) - 1), columns) for columns in strip_columns()]


def bands(points: Float[np.ndarray, "k m 3"], values: Float[np.ndarray, "k"], scale: Scale) -> list[Part]:
    """What is between the strips, by the band of the mean value of each pair of rings. A band may be empty."""
    between = np.setdiff1d(np.arange(FACES_AROUND), np.concatenate(strip_columns()))
    means = (values[1:] + values[:-1]) / 2
    band = np.clip(np.searchsorted(scale.edges, means, side="right") - 1, 0, len(scale.colors) - 1)
    return [_part(points, np.flatnonzero(band == k), between) for k in range(len(scale.colors))]


def caps(points: Float[np.ndarray, "k m 3"], centerline: Float[np.ndarray, "k 3"]) -> Part:
    """The two ends."""
    vertices = np.concatenate([points[0], points[-1], centerline[[0, -1]]])
    around = np.arange(FACES_AROUND)
    onward, middle = (around + 1) % FACES_AROUND, 2 * FACES_AROUND
    first = np.stack([np.full_like(around, middle), onward, around], axis=1)
    last = np.stack([np.full_like(around, middle + 1), FACES_AROUND + around, FACES_AROUND + onward], axis=1)
    return Part(vertices.astype(np.float32), np.concatenate([first, last]).astype(np.uint32))


def _part(points: Float[np.ndarray, "k m 3"], rows: Int[np.ndarray, "r"], columns: Int[np.ndarray, "c"]) -> Part:
    """The faces from these rows of rings to the next, at these columns; neighbours share their vertices."""
    if not len(rows):
        # One triangle without an area: a mesh that is empty has no middle.
        return Part(points[0, [0, 0, 0]].astype(np.float32), np.array([[0, 1, 2]], np.uint32))
    onward = (columns + 1) % points.shape[1]
    used, around = np.union1d(rows, rows + 1), np.union1d(columns, onward)
    at = np.searchsorted(used, rows)[:, None] * len(around)
    left, right = np.searchsorted(around, columns)[None], np.searchsorted(around, onward)[None]
    a, b, c, d = at + left, at + right, at + len(around) + right, at + len(around) + left
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return Part(points[np.ix_(used, around)].reshape(-1, 3).astype(np.float32), faces.astype(np.uint32))
