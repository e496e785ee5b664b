"""`rodjax report`: cables, solved or from a result, against limits."""

import argparse
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rodjax
from rodjax.commands.errors import CommandError
from rodjax.commands.outputs import check_folder
from rodjax.io.files import load
from rodjax.io.harness_file import HarnessFile
from rodjax.io.scene_file import SceneFile
from rodjax.solving.options import DEFAULT_RTOL
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_warnings import NotConvergedWarning, OverstretchedWarning


def run_report(arguments: argparse.Namespace) -> int:
    from rodjax.routing.files import read_route_file

    check_folder(arguments.out, "--out")
    file = read_route_file(arguments.file, with_scene=arguments.result is None)
    scenes = file.cables.values() if file.harness is None else [file.harness]
    if arguments.result is not None:
        result = _last(arguments.result)
        cables = {"cable": result} if isinstance(result, Equilibrium) else dict(result.items())
    elif file.harness is None:
        cables = {name: _solved(scene.scenes[0], scene.settings) for name, scene in file.cables.items()}
    else:
        cables = dict(_solved(file.harness.harness, file.harness.settings).items())
    try:
        report = rodjax.report(
            cables,
            limits=file.limits,
            obstacles=file.obstacles,
            names=file.names,
            title=file.title or str(arguments.file),
            source=_source(arguments.file, *scenes) if arguments.result is None else str(arguments.result),
        )
    except ValueError as error:
        if all(np.all(cable.converged) for cable in cables.values()):
            message = str(error).replace("must be None for", "is not allowed for")
            raise CommandError(f"{arguments.file}: {message}") from None
        # A shape that is not finite leaves nothing to tell.
        print(f"rodjax: {arguments.file}: {error}", file=sys.stderr)
        return 3
    print(report, flush=True)
    print(f"\nwritten: {', '.join(map(str, report.save(arguments.out)))}")
    lost = [f"{cable.name}: {cable.outcome}" for cable in report.cables if not cable.converged]
    if not lost and report.kept is not False:
        return 0
    print(f"rodjax: {arguments.file}: {'; '.join(lost) or f'limits: {report.verdict}'}", file=sys.stderr)
    return 3


def _source(path: Path, *scenes: SceneFile | HarnessFile) -> str:
    """What a report is made of, and how exactly."""
    meshes = [
        f"rtol = {scene.rtol or DEFAULT_RTOL:g}" if scene.segments is None else f"{scene.segments} segments"
        for scene in scenes
    ]
    return ", ".join([str(path), *dict.fromkeys(meshes)])


def _solved(scene: Any, settings: dict[str, Any]) -> Any:
    with warnings.catch_warnings():
        # Said in the report.
        warnings.simplefilter("ignore", NotConvergedWarning)
        warnings.simplefilter("ignore", OverstretchedWarning)
        return rodjax.solve(scene, **settings)


def _last(path: Path) -> Equilibrium | rodjax.HarnessEquilibrium:
    """The equilibrium in a file, or the last of a path."""
    try:
        result = load(path)
    except ValueError as error:
        raise CommandError(f"--result: {error}") from None
    return jax.tree.map(lambda leaf: leaf[-1], result) if result.energy.ndim else result
