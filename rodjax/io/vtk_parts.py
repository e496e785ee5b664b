"""A result as a picture for ParaView: a `vtkPartitionedDataSetCollection` in VTKHDF, with the parts

- `cable`: one polyline, smooth between the nodes of the mesh, with the point data of `cable_data`
- `supports`: a point at each end and clip, with the force and the moment there on the rod
- `clips`: a collar around the rod at each clip
- `obstacle_0`, ...: their surfaces, near the rod

of which those that the scene lacks are left out; along a path all of them over time steps. Of a harness `trunk`,
`trunk_supports`, ... for each cable by its name, of which all characters but letters, digits and _ become _; and
`joints`, a point at the position of each. The names of the point data end with their SI units, as powers: HDF5 has no
names with a slash. The format is that of
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import h5py
import jax
import numpy as np
from jaxtyping import Float

from rodjax.analysis.reactions import reactions
from rodjax.analysis.samples import Samples, smooth_samples
from rodjax.model.surfaces import Faces, collar, surfaces
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium

# A bend radius beyond so many lengths of the rod is told as that: an infinite one would leave ParaView no scale.
LARGEST_BEND_RADIUS = 1e3
# Of a rod without a radius, the one that collars are drawn for, by its length.
LEAST_RADIUS = 5e-3
CELLS = ("Vertices", "Lines", "Polygons", "Strips")


class Piece(NamedTuple):
    """One part at one time: points, cells by their kind as lists of points, and data of the points."""

    points: Float[np.ndarray, "p 3"]
    kind: str
    cells: list[np.ndarray]
    data: dict[str, np.ndarray]


def write_picture(root: h5py.Group, result: Equilibrium | HarnessEquilibrium) -> None:
    """Into an empty group that tracks the order of its links."""
    root.attrs["Version"] = (2, 3)
    root.attrs["Type"] = np.bytes_("PartitionedDataSetCollection")  # VTK reads no string of variable length here
    assembly = root.create_group("Assembly", track_order=True)
    parts = _parts(result) if isinstance(result, Equilibrium) else _parts_of_harness(result)
    steps = result.energy.shape[0] if result.energy.ndim else None
    for number, (name, pieces) in enumerate(parts.items()):
        part = root.create_group(name)
        part.attrs["Index"] = number
        _write_part(part, pieces, steps)
        assembly[name] = h5py.SoftLink(f"{root.name}/{name}")


def _parts_of_harness(result: HarnessEquilibrium) -> dict[str, list[Piece]]:
    parts = {}
    for number, (cable, rod) in enumerate(result.items()):
        plain = re.sub(r"\W", "_", cable, flags=re.ASCII)
        for name, pieces in _parts(rod).items():
            name = plain if name == "cable" else f"{plain}_{name}"
            parts[f"{name}_{number}" if name in parts or name in ("joints", "Assembly") else name] = pieces
    positions = np.asarray(result.positions)
    cells = [np.array([j]) for j in range(positions.shape[-2])]
    if cells:
        parts["joints"] = [Piece(points, "Vertices", cells, {}) for points in positions.reshape(-1, len(cells), 3)]
    return parts


def cable_data(samples: Samples) -> dict[str, np.ndarray]:
    """What is drawn along the cable, by the name that ParaView shows."""
    length = (samples.s[..., -1] - samples.s[..., 0])[..., None]
    bend_radius = 1 / np.maximum(samples.curvature, 1 / (LARGEST_BEND_RADIUS * length))
    data = {
        "arclength [m]": samples.s,
        "node": np.broadcast_to(samples.is_node.astype(np.uint8), samples.s.shape),
        "curvature [m^-1]": samples.curvature,
        "bend radius [m]": bend_radius,
        "twist [rad m^-1]": samples.twist,
        "tension [N]": samples.tension,
        "d1": samples.frames[..., 0],
        "d2": samples.frames[..., 1],
        "tangent": samples.frames[..., 2],
        "radius [m]": samples.radius,
        "force [N]": samples.force,
        "moment [N m]": samples.moment,
        "contact force [N m^-1]": samples.contact,
    }
    return {name: values for name, values in data.items() if values is not None}


def _parts(equilibrium: Equilibrium) -> dict[str, list[Piece]]:
    """The pieces of each part, one a time step, or a single one where nothing of it changes."""
    samples = smooth_samples(equilibrium)
    data = cable_data(samples)
    steps = [slice(None)] if equilibrium.s.ndim == 1 else list(range(len(equilibrium.s)))
    single = [jax.tree.map(lambda leaf, k=k: leaf[k], equilibrium) if k != slice(None) else equilibrium for k in steps]
    line = [np.arange(samples.s.shape[-1])]
    parts = {
        "cable": [
            Piece(samples.positions[k], "Lines", line, {name: values[k] for name, values in data.items()})
            for k in steps
        ],
        "supports": [_supports(one) for one in single],
    }
    if not np.all(np.isfinite(samples.positions)):
        return parts
    if equilibrium.scene.clips:
        parts["clips"] = [_surface(_collars(one)) for one in single]
    obstacles = equilibrium.scene.obstacles
    if obstacles:
        thickest = _radius(equilibrium)
        points = np.reshape(samples.positions, (-1, 3))
        seen = np.concatenate([points - thickest, points + thickest])
        # Obstacles seldom move along a path.
        still = equilibrium.s.ndim == 1 or all(
            np.array_equal(leaf, np.broadcast_to(leaf[0], leaf.shape))
            for leaf in map(np.asarray, jax.tree.leaves(obstacles))
        )
        drawn = [surfaces(one.scene.obstacles, seen) for one in (single[:1] if still else single)]
        for k in range(len(obstacles)):
            parts[f"obstacle_{k}"] = [_surface(faces[k]) for faces in drawn]
    return parts


def _supports(equilibrium: Equilibrium) -> Piece:
    """What supports and clips apply to the rod, at the places where they do."""
    found = reactions(equilibrium)
    points = np.stack([reaction.position for reaction in found])
    data = {
        "arclength [m]": np.array([reaction.s for reaction in found]),
        "force on the rod [N]": np.stack([reaction.force for reaction in found]),
        "moment on the rod [N m]": np.stack([reaction.moment for reaction in found]),
    }
    return Piece(points, "Vertices", [np.array([k]) for k in range(len(points))], data)


def _radius(equilibrium: Equilibrium) -> float:
    """[m] Of the rod where it is thickest, or of what stands for it."""
    radius = equilibrium.scene.rod.radius
    if radius is None:
        return LEAST_RADIUS * float(np.max(np.asarray(equilibrium.s)[..., -1]))
    return float(np.max(np.asarray(getattr(radius, "samples", radius))))


def _collars(equilibrium: Equilibrium) -> Faces:
    radius = _radius(equilibrium)
    return np.concatenate([collar(clip.position, clip.axes[0], radius) for clip in reactions(equilibrium)[1:-1]])


def _surface(faces: Faces) -> Piece:
    """Faces, of which a triangle has its last corner twice, with points in common."""
    points, index = np.unique(faces.reshape(-1, 3), axis=0, return_inverse=True)
    cells = [np.array(list(dict.fromkeys(row))) for row in index.reshape(-1, 4).tolist()]
    return Piece(points, "Polygons", [cell for cell in cells if len(cell) > 2], {})


def _write_part(part: h5py.Group, pieces: Sequence[Piece], steps: int | None) -> None:
    """VTKHDF PolyData: the pieces one after another, and where each time step finds its own."""
    part.attrs["Version"] = (2, 3)
    part.attrs["Type"] = np.bytes_("PolyData")
    points = np.array([len(piece.points) for piece in pieces])
    part["NumberOfPoints"] = points
    part["Points"] = np.concatenate([piece.points for piece in pieces])
    counts, ids = {}, {}
    # VTK takes the file for empty where one of the four kinds of cells is missing.
    for kind in CELLS:
        own = [piece.cells if piece.kind == kind else [] for piece in pieces]
        counts[kind] = np.array([len(cells) for cells in own])
        ids[kind] = np.array([sum(map(len, cells)) for cells in own])
        group = part.create_group(kind)
        group["NumberOfCells"], group["NumberOfConnectivityIds"] = counts[kind], ids[kind]
        group["Connectivity"] = np.concatenate([np.zeros(0, int), *(cell for cells in own for cell in cells)])
        group["Offsets"] = np.concatenate([np.cumsum([0, *map(len, cells)]) for cells in own])
    for name in pieces[0].data:
        part[f"PointData/{name}"] = np.concatenate([piece.data[name] for piece in pieces])
    if steps is None:
        return
    which = np.arange(steps) if len(pieces) == steps else np.zeros(steps, int)

    def begins(sizes: np.ndarray) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(sizes)[:-1]])[which]

    times = part.create_group("Steps")
    times.attrs["NSteps"] = steps
    times["Values"] = np.arange(steps, dtype=float)
    times["PartOffsets"] = which
    times["NumberOfParts"] = np.ones(steps, int)
    times["PointOffsets"] = begins(points)
    times["CellOffsets"] = np.stack([begins(counts[kind]) for kind in CELLS], axis=1)
    times["ConnectivityIdOffsets"] = np.stack([begins(ids[kind]) for kind in CELLS], axis=1)
    for name in pieces[0].data:
        times[f"PointDataOffsets/{name}"] = begins(points)
