"""The surface of a rod as triangles, in bands of one colour each, with strips along its directors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.ticker import MaxNLocator

from rodjax.plot import COLOR_MAP

# Faces around the rod, and of them those of each strip: along d1, and on the other side.
AROUND, STRIP = 16, 2
STRIP_COLORS = ((30, 30, 30), (245, 245, 245))
# So many bands of colour at most: more cannot be told from one another, nor read off a legend.
MOST_BANDS = 12
# Ranges narrower than this part of their values, or than this, are rounding.
LEAST_RANGE, LEAST_VALUE = 1e-3, 1e-9


_ANGLES = 2 * np.pi / AROUND * (np.arange(AROUND) - STRIP / 2)
_COSINE, _SINE = np.cos(_ANGLES)[:, None], np.sin(_ANGLES)[:, None]
# The points of a ring that are those of each strip, and of both sides between them.
_STRIPS = [np.arange(first, first + STRIP + 1) for first in (0, AROUND // 2)]
_BETWEEN = np.concatenate([np.arange(first + STRIP, first + AROUND // 2 + 1) % AROUND for first in (0, AROUND // 2)])


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


class Surface:
    """The surface of one rod: strips along its directors, caps, and bands of colour between the strips."""

    def __init__(
        self,
        centerline: Float[np.ndarray, "k 3"],
        d1: Float[np.ndarray, "k 3"],
        d2: Float[np.ndarray, "k 3"],
        radius: float | Float[np.ndarray, "k"],
    ):
        self.centerline = centerline.astype(np.float32)
        radii = np.broadcast_to(radius, len(centerline))[:, None, None]
        around = _COSINE * d1[:, None] + _SINE * d2[:, None]
        self.rings = (centerline[:, None] + radii * around).astype(np.float32)

    @property
    def strips(self) -> list[Part]:
        """Along d1 and along -d1."""
        rows = np.arange(len(self.rings) - 1)
        return [_part(self.rings[:, columns], rows) for columns in _STRIPS]

    def bands(self, values: Float[np.ndarray, "k"], scale: Scale) -> list[Part]:
        """By the band of the mean value of each pair of rings, on both sides of the strips. A band may be empty."""
        means = (values[1:] + values[:-1]) / 2
        band = np.clip(np.searchsorted(scale.edges, means, side="right") - 1, 0, len(scale.colors) - 1)
        between = self.rings[:, _BETWEEN]
        return [_part(between, np.flatnonzero(band == k), sides=2) for k in range(len(scale.colors))]

    @property
    def caps(self) -> Part:
        """The two ends."""
        vertices = np.concatenate([self.rings[0], self.rings[-1], self.centerline[[0, -1]]])
        around = np.arange(AROUND)
        onward, middle = (around + 1) % AROUND, 2 * AROUND
        first = np.stack([np.full_like(around, middle), onward, around], axis=1)
        last = np.stack([np.full_like(around, middle + 1), AROUND + around, AROUND + onward], axis=1)
        return Part(vertices, np.concatenate([first, last]).astype(np.uint32))


def _part(rings: Float[np.ndarray, "k m 3"], rows: Int[np.ndarray, "r"], sides: int = 1) -> Part:
    """The faces from these rows of rings to the next; neighbours share their vertices. Each ring is of so many sides,
    between which there are no faces.
    """
    if not len(rows):
        # One triangle without an area: a mesh that is empty has no middle.
        return Part(np.repeat(rings[0, :1], 3, axis=0), np.array([[0, 1, 2]], np.uint32))
    count = rings.shape[1]
    is_used = np.zeros(len(rings), bool)
    is_used[rows] = is_used[rows + 1] = True
    at = (np.cumsum(is_used) - 1)[rows, None] * count
    left = np.arange(count).reshape(sides, -1)[:, :-1].reshape(-1)
    corners = np.stack([left, left + 1, left + count + 1, left, left + count + 1, left + count], axis=-1).reshape(-1)
    return Part(rings[is_used].reshape(-1, 3), (at + corners).reshape(-1, 3).astype(np.uint32))
