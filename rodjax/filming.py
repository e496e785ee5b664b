"""Films of paths: pictures one after another, as GIF or MP4."""

import importlib.util
import io
import os
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from rodjax.atomic_write import replace_file
from rodjax.checks import file_path, instance, one_of, positive
from rodjax.drawing import COLOR_MAP, LABELS, Field, color_limits, draw_tube, set_view, surroundings, thickness
from rodjax.solving.result import Equilibrium

SUFFIXES = (".gif", ".mp4")
FPS = 25.0
# Pictures of 960 by 640.
SIZE, DPI = (8.0, 16 / 3), 120
Frame = UInt8[np.ndarray, "height width 3"]


def film(path: Equilibrium, file: str | os.PathLike[str], *, color_by: Field = "curvature", fps: float = FPS) -> None:
    """Writes a path, or a batch, as a film: a picture of each equilibrium, in one view, with one scale of length and
    colour.

    **Arguments:**

    - `path`: an `Equilibrium` with one leading axis, as of `rodjax.solve_path`, or loaded from a recording.
    - `file`: ends in `.gif`, or in `.mp4`, which takes `pip install 'rodjax[film]'`.
    - `color_by`: `"curvature"`, `"twist"` or `"tension"`. `fps`: pictures per second.

    Raises `ValueError` or `TypeError` for arguments that make no sense, `ImportError` without what writes `.mp4`.
    """
    instance(path, "path", Equilibrium)
    if path.s.ndim != 2:
        raise ValueError(f"path must have one leading axis, got {path.s.shape[:-1]}")
    one_of(color_by, "color_by", tuple(LABELS))
    fps, target = float(positive(fps, "fps")), file_path(file, "file")
    if target.suffix not in SUFFIXES:
        raise ValueError(f"file must end in {' or '.join(SUFFIXES)}, got {str(target)!r}")
    if target.suffix == ".mp4":
        _check_encoder()
    replace_file(target, film_content(list(frames(path, color_by)), target.name, fps))


def frames(path: Equilibrium, color_by: Field = "curvature") -> Iterator[Frame]:
    """A picture of each equilibrium of a path."""
    rods = [jax.tree.map(lambda leaf, k=k: leaf[k], path) for k in range(path.s.shape[0])]
    radius, note = thickness(rods)
    norm = Normalize(*color_limits(np.asarray(getattr(path, color_by))))
    nodes = np.asarray(path.nodes).reshape(-1, 3)
    room = np.concatenate([nodes - radius, nodes + radius])
    for rod in rods:
        figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
        axes = figure.add_subplot(projection="3d")
        assert isinstance(axes, Axes3D)
        draw_tube(axes, rod, radius, color_by, norm, surroundings(rod, radius))
        set_view(axes, room)
        axes.text2D(0.0, 0.0, note, transform=axes.transAxes, fontsize=8, color="0.4")
        figure.colorbar(ScalarMappable(norm, COLOR_MAP), ax=axes, label=LABELS[color_by], shrink=0.6, pad=0.08)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def best_suffix() -> str:
    """MP4 where what writes it is installed."""
    return ".mp4" if importlib.util.find_spec("av") and importlib.util.find_spec("imageio") else ".gif"


def film_content(pictures: Sequence[Frame], name: str, fps: float = FPS) -> bytes:
    """Pictures of one size as the file of that name."""
    if name.endswith(".gif"):
        from PIL import Image  # matplotlib needs it anyway

        images = [Image.fromarray(np.ascontiguousarray(picture)) for picture in pictures]
        content = io.BytesIO()
        images[0].save(content, "GIF", save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
        return content.getvalue()
    _check_encoder()
    import imageio.v3 as imageio

    # H.264 wants both sides even.
    height, width = (size // 2 * 2 for size in pictures[0].shape[:2])
    stacked = np.stack([picture[:height, :width] for picture in pictures])
    return imageio.imwrite("<bytes>", stacked, extension=".mp4", plugin="pyav", fps=round(fps), codec="libx264")


def _check_encoder() -> None:
    if best_suffix() != ".mp4":
        raise ImportError("a film in .mp4 needs imageio and av, got none: pip install 'rodjax[film]', or take .gif")
