"""The centerline as a spline that CAD programs read."""

import io
import os

import numpy as np

from rodjax.analysis.samples import smooth_samples
from rodjax.atomic_write import replace_file
from rodjax.checks import file_path, instance, is_known
from rodjax.solving.result import Equilibrium

SUFFIX = ".dxf"
# Of the file: millimetres, as CAD programs take a DXF file for.
PER_METRE = 1e3
LAYERS = {"CENTERLINE": 5, "CLIPS": 1}  # with their colors


def write_dxf(equilibrium: Equilibrium, path: str | os.PathLike[str]) -> None:
    """Writes the centerline of one equilibrium as a cubic B-spline to a DXF file (R2010, in millimetres).

    The spline passes through the nodes and points between them, with the tangents of the rod at its ends, and departs
    from `Equilibrium.position_at` by less than 1e-5 of the length where the rod has no kinks. Clips are points in a
    layer of their own. The file is replaced as a whole.

    Raises `ImportError` without ezdxf (`pip install 'rodjax[cad]'`), `ValueError` or `TypeError` for what is not a
    single equilibrium of a finite shape, `OSError` where the file cannot be written.
    """
    instance(equilibrium, "equilibrium", Equilibrium)
    path = file_path(path, "path", SUFFIX)
    if not is_known(equilibrium) or equilibrium.s.ndim != 1:
        raise ValueError(
            "equilibrium must be a single one that holds numbers; jax.tree.map(lambda leaf: leaf[-1], path) takes the "
            "last one of a path"
        )
    if not np.all(np.isfinite(equilibrium.nodes)):
        raise ValueError("equilibrium must have a finite shape to be drawn")
    try:
        import ezdxf
        from ezdxf import units
        from ezdxf.math import global_bspline_interpolation
    except ImportError:
        raise ImportError("write_dxf needs ezdxf: pip install 'rodjax[cad]'") from None
    samples = smooth_samples(equilibrium)
    points = PER_METRE * samples.positions
    ends = samples.frames[[0, -1], :, 2]
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    spline = global_bspline_interpolation(
        [tuple(point) for point in points], tangents=[tuple(np.sum(chords) * end) for end in ends], method="chord"
    )
    drawing = ezdxf.new("R2010", units=units.MM)  # pyright: ignore[reportPrivateImportUsage]
    for name, color in LAYERS.items():
        drawing.layers.add(name, color=color)
    space = drawing.modelspace()
    space.add_spline(dxfattribs={"layer": "CENTERLINE"}).apply_construction_tool(spline)
    for clip in equilibrium.scene.clips:
        space.add_point(tuple(PER_METRE * np.asarray(clip.position)), dxfattribs={"layer": "CLIPS"})
    text = io.StringIO()
    drawing.write(text)
    replace_file(path, text.getvalue().encode())
