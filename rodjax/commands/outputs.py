"""Files and folders that commands write: whether they can be is found out before a long solve."""

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rodjax.atomic_write import replace_file
from rodjax.commands.errors import CommandError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def check_output(path: Path | None, option: str, suffixes: tuple[str, ...]) -> None:
    """Finds out before a long solve that its result could not be written."""
    if path is None:
        return
    if path.suffix not in suffixes:
        raise CommandError(f"{option} must end in {' or '.join(suffixes)}, got {str(path)!r}")
    if not path.parent.is_dir():
        raise CommandError(f"{option} must be in a folder that exists, got {str(path)!r}")
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise CommandError(f"{option} must be a file that can be written, got {str(path)!r}")


def check_folder(path: Path, option: str) -> None:
    """The same of a folder, which is made where it is not there."""
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise CommandError(f"{option} must be a folder that can be written, got {str(path)!r}")


def save_figure(figure: "Figure", path: Path, **options: Any) -> None:
    # Put together in memory, so that a full disk leaves the picture that was there.
    image = io.BytesIO()
    figure.savefig(image, format=path.suffix[1:], **options)
    replace_file(path, image.getvalue())
