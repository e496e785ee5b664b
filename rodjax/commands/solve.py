"""`rodjax solve`: the scene, the path or the harness in a file."""

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np

import rodjax
from rodjax.commands.errors import CommandError
from rodjax.commands.outputs import check_output, save_figure
from rodjax.commands.solve_text import harness_table, header, path_table, rod_table
from rodjax.io.cad import SUFFIX as CAD_SUFFIX
from rodjax.io.cad import write_dxf
from rodjax.io.files import SUFFIX, save
from rodjax.io.harness_file import is_harness_file, read_harness_file
from rodjax.io.scene_file import read_scene_file
from rodjax.io.tables import SUFFIX as TABLE_SUFFIX
from rodjax.io.tables import write_table
from rodjax.model.scene import Scene, has_no_place
from rodjax.model.summaries import counted
from rodjax.notes import note
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_warnings import MeshWarning, NotConvergedWarning, OverstretchedWarning

Result = TypeVar("Result", Equilibrium, rodjax.HarnessEquilibrium)

PLOT_SUFFIXES = (".png", ".pdf", ".svg")


def run_solve(arguments: argparse.Namespace) -> int:
    check_output(arguments.output, "-o", (SUFFIX,))
    check_output(arguments.plot, "--plot", PLOT_SUFFIXES)
    check_output(arguments.csv, "--csv", (TABLE_SUFFIX,))
    check_output(arguments.dxf, "--dxf", (CAD_SUFFIX,))
    note(f"reading {arguments.scene}")
    if is_harness_file(arguments.scene):
        return _solve_harness(arguments)
    file = read_scene_file(arguments.scene)
    _check_places(arguments.scene, file.scenes)
    with warnings.catch_warnings(record=True) as caught:
        # Said below, in the command's own way.
        warnings.simplefilter("ignore", NotConvergedWarning)
        warnings.simplefilter("ignore", MeshWarning)  # the errors are told
        warnings.simplefilter("always", OverstretchedWarning)
        if file.is_path:
            result = rodjax.solve_path(file.scenes, **file.settings, progress=sys.stderr.isatty())
        else:
            result = rodjax.solve(file.scenes[0], **file.settings)
    print("\n".join([header(arguments.scene, file, result), *(path_table if file.is_path else rod_table)(result)]))
    if arguments.output:
        save(result, arguments.output)
    last = jax.tree.map(lambda leaf: leaf[-1], result) if file.is_path else result
    if arguments.plot:
        _draw(arguments.plot, last, _plot)
    if arguments.csv:
        _draw(arguments.csv, last, lambda _, path: write_table(result, path))
    if arguments.dxf:
        _draw(arguments.dxf, last, _write_dxf)
    for warning in caught:
        print(f"rodjax: {arguments.scene}: warning: {warning.message}", file=sys.stderr)
    if np.all(result.converged):
        return 0
    steps = f"steps {', '.join(map(str, np.flatnonzero(~np.asarray(result.converged))))}: " if file.is_path else ""
    outcome = rodjax.describe(result).replace("\n", ", ")
    print(f"rodjax: {arguments.scene}: {steps}{outcome}", file=sys.stderr)
    return 3


def _check_places(path: Path, scenes: Sequence[Scene]) -> None:
    if any(map(has_no_place, scenes)):
        raise CommandError(
            f"{path}: no end and no clip is held, and a file has no guess that would tell where the rod lies; "
            "rodjax.solve takes one"
        )


def _solve_harness(arguments: argparse.Namespace) -> int:
    if arguments.dxf:
        raise CommandError(
            f"--dxf is for one cable: {arguments.scene} has several; rodjax.write_dxf takes each of them"
        )
    file = read_harness_file(arguments.scene)
    _check_places(arguments.scene, file.harness.scenes)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore", NotConvergedWarning)
        warnings.simplefilter("ignore", MeshWarning)
        warnings.simplefilter("always", OverstretchedWarning)
        result = rodjax.solve(file.harness, **file.settings)
    print(
        "\n".join(
            [
                f"{arguments.scene}: {counted(len(result), 'cable')}, {counted(len(result.joints), 'joint')}",
                *harness_table(result),
            ]
        )
    )
    if arguments.output:
        save(result, arguments.output)
    if arguments.plot:
        _draw(arguments.plot, result, _plot_harness)
    if arguments.csv:
        _draw(arguments.csv, result, write_table)
    for warning in caught:
        print(f"rodjax: {arguments.scene}: warning: {warning.message}", file=sys.stderr)
    if np.all(result.converged):
        return 0
    print(f"rodjax: {arguments.scene}: {rodjax.describe(result).splitlines()[0]}", file=sys.stderr)
    return 3


def _draw(path: Path, equilibrium: Result, write: Callable[[Result, Path], None]) -> None:
    """Writes a file of a shape, which must be finite."""
    rods = [equilibrium] if isinstance(equilibrium, Equilibrium) else equilibrium.values()
    if not all(np.all(np.isfinite(rod.nodes)) for rod in rods):
        print(f"rodjax: {path} is not written: the shape is not finite", file=sys.stderr)
        return
    write(equilibrium, path)


def _plot_harness(result: rodjax.HarnessEquilibrium, path: Path) -> None:
    from rodjax.plot import figure_of, plot_harness

    save_figure(figure_of(plot_harness(result)), path)


def _plot(equilibrium: Equilibrium, path: Path) -> None:
    from rodjax.plot import figure_of, plot_rod

    save_figure(figure_of(plot_rod(equilibrium)), path)


def _write_dxf(equilibrium: Equilibrium, path: Path) -> None:
    try:
        write_dxf(equilibrium, path)
    except ImportError as error:
        raise CommandError(str(error)) from None
