"""`rodjax view`: a file in a window of the browser."""

import argparse
import sys
import warnings
from pathlib import Path
from typing import Any

import rodjax
from rodjax.commands.errors import CommandError
from rodjax.io.files import SUFFIX
from rodjax.io.harness_file import HarnessFile, is_harness_file, read_harness_file
from rodjax.io.scene_file import SceneFile, read_scene_file
from rodjax.solving.result_warnings import MeshWarning, NotConvergedWarning, OverstretchedWarning


def _file_to_view(path: Path) -> SceneFile | HarnessFile | rodjax.Equilibrium | rodjax.HarnessEquilibrium:
    if path.suffix != SUFFIX:
        return read_harness_file(path) if is_harness_file(path) else read_scene_file(path)
    try:
        return rodjax.load(path)
    except ValueError as error:
        raise CommandError(f"{path}: {' '.join(str(error).split())}") from None


def run_view(arguments: argparse.Namespace) -> int:
    file = _file_to_view(arguments.scene)
    from rodjax.window.opening import session_of  # takes a second, which the other commands need not wait for

    with warnings.catch_warnings():
        for category in (NotConvergedWarning, OverstretchedWarning, MeshWarning):
            warnings.simplefilter("ignore", category)  # said by the window
        try:
            if isinstance(file, HarnessFile):
                session = session_of(file.harness, file.segments, file.strain_limit)
            elif not isinstance(file, SceneFile):
                session = session_of(file, None)
            else:
                shown = rodjax.solve_path(file.scenes, **file.settings) if file.is_path else file.scenes[0]
                session = session_of(shown, file.segments, file.strain_limit)
        except ValueError as error:
            print(f"rodjax: {arguments.scene}: {' '.join(str(error).split())}", file=sys.stderr)
            return 3
    show_session(session, arguments)
    return 0


def show_session(session: Any, arguments: argparse.Namespace, limits: rodjax.Limits | None = None) -> None:
    """A session in its window, until Ctrl-C."""
    from rodjax.window.opening import show

    try:
        show(session, arguments.port, arguments.host, not arguments.no_browser, limits=limits, dark=arguments.dark)
    except ImportError as error:
        raise CommandError(str(error)) from None
