"""The command `rodjax`.

Exit codes: 0 all converged, and all limits are kept where there are any; 2 bad input, one line on stderr; 3 something
did not converge, a cable that is reported does not keep to a limit, or no route was found within limits: stderr names
what.
"""

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import jax
import numpy as np

import rodjax
from rodjax.analysis.curvature import curvature_along
from rodjax.atomic_write import replace_file
from rodjax.cluster import ClusterError, connected
from rodjax.io.cad import SUFFIX as CAD_SUFFIX
from rodjax.io.cad import write_dxf
from rodjax.io.files import SUFFIX, load, save
from rodjax.io.harness_file import HarnessFile, is_harness_file, read_harness_file
from rodjax.io.scene_file import SceneFile, SceneFileError, read_scene_file
from rodjax.io.tables import SUFFIX as TABLE_SUFFIX
from rodjax.io.tables import write_table
from rodjax.model.scene import Scene, has_no_place
from rodjax.notes import note, told
from rodjax.programs import kept
from rodjax.programs.tasks import TaskError
from rodjax.solving.equilibrium import DEFAULT_RTOL, MAX_SEGMENTS
from rodjax.solving.result import Equilibrium, MeshWarning, NotConvergedWarning, OverstretchedWarning
from rodjax.solving.status import Status
from rodjax.sweeps.cases import SweepError
from rodjax.sweeps.quantities import QUANTITIES
from rodjax.sweeps.result import PARQUET_SUFFIX, Summary, check_parquet, merge, write_csv, write_parquet
from rodjax.sweeps.sweep import SUFFIX as SWEEP_SUFFIX
from rodjax.sweeps.sweep import sweep

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from matplotlib.figure import Figure

    from rodjax.identification.refits import Profile

Result = TypeVar("Result", Equilibrium, rodjax.HarnessEquilibrium)

PLOT_SUFFIXES = (".png", ".pdf", ".svg")
# The exit code where nobody reads what is printed, as after `| head`: that of other commands, which a signal ends.
NOBODY_READS = 128 + 13


class CommandError(ValueError):
    """What the user can mend on the command line; the message is one line."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs `rodjax` with these arguments, or those of the process; returns the exit code."""
    try:
        arguments = _parser().parse_args(argv)
        _set_up_jax()
        # A window lives for hours, and tells of each of its solves.
        has_window = arguments.run is _view or getattr(arguments, "view", False)
        with contextlib.nullcontext() if has_window else told(None):
            code = arguments.run(arguments)
        sys.stdout.flush()
        return code
    except (CommandError, ClusterError, SceneFileError, SweepError) as error:
        message = str(error)
    except BrokenPipeError:  # of stdout, as nothing else that a command writes to is a pipe
        _drop_what_cannot_be_printed()
        return NOBODY_READS
    except OSError as error:
        message = f"{error.strerror or error}: {error.filename}" if error.filename else str(error)
        _drop_what_cannot_be_printed()
    print(f"rodjax: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _drop_what_cannot_be_printed() -> None:
    """Where stdout goes to a full disk, or nobody reads it, Python would try again as it ends, and fail with lines and
    a code of its own.
    """
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise CommandError(f"{message}; `{self.prog} --help` tells more")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="rodjax", description="Shape and forces of cables, hoses and wires.")
    parser.add_argument("--version", action="version", version=f"rodjax {rodjax.__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    solve = commands.add_parser("solve", help="solve the scene, or the path, in a TOML file")
    solve.add_argument("scene", metavar="SCENE.toml", type=Path, help="its format: pydoc rodjax.io.scene_file")
    solve.add_argument("-o", "--output", metavar=f"OUT{SUFFIX}", type=Path, help="write the result, for ParaView")
    solve.add_argument("--plot", metavar="OUT.png", type=Path, help="draw the rod, of a path its last step")
    solve.add_argument(
        "--csv", metavar="OUT.csv", type=Path, help="write the centerline, curvature, force and moment along it"
    )
    solve.add_argument("--dxf", metavar="OUT.dxf", type=Path, help="write the centerline as a spline, for CAD")
    solve.set_defaults(run=_solve)
    _add_view(commands)
    _add_sweep(commands)
    _add_fit(commands)
    _add_report(commands)
    demo = commands.add_parser("demo", help="solve and draw the figure of Linn & Stephan (2008)")
    demo.add_argument("--out", metavar="DIR", type=Path, default=Path("rodjax-demo"), help="folder for the results")
    demo.add_argument("--segments", metavar="N", type=_segments, default=10, help="of the mesh; 10, as in the paper")
    demo.set_defaults(run=_demo)
    warm = commands.add_parser("warm", help="compile programs ahead of time, so that first answers come at once")
    warm.add_argument(
        "file", metavar="FILE.toml", type=Path, nargs="?", help="of a scene, fit, report or route; the usual scenes"
    )
    warm.add_argument("data", metavar="DATA.csv", type=Path, nargs="*", help="of a fit: what was measured")
    warm.set_defaults(run=_warm)
    return parser


def _add_view(commands: Any) -> None:
    view = commands.add_parser("view", help="move the rods of a scene by the mouse, in a window of the browser")
    view.add_argument(
        "scene",
        metavar="SCENE.toml",
        type=Path,
        help=f"of a rod or a harness; or a result{SUFFIX}, such as a recording",
    )
    _add_window(view)
    view.set_defaults(run=_view)


def _add_window(command: Any) -> None:
    command.add_argument(
        "--port", metavar="N", type=_port, default=8080, help="of the window; 0 for any that is free; 8080"
    )
    command.add_argument(
        "--host",
        metavar="ADDRESS",
        default="127.0.0.1",
        help="address to listen on: by default this machine only; whoever reaches it can move the rod",
    )
    command.add_argument("--no-browser", action="store_true", help="do not open it in the browser")
    command.add_argument("--dark", action="store_true", help="a dark page")


def _add_sweep(commands: Any) -> None:
    output = dict(
        metavar=f"SWEEP{SWEEP_SUFFIX}", type=Path, required=True, help="the file to write: pydoc rodjax.sweeps"
    )
    run = commands.add_parser("sweep", help="solve a scene for all cases of a grid or table, many or few")
    run.add_argument("scene", metavar="SCENE.toml", type=Path, help="its format: pydoc rodjax.io.scene_file")
    run.add_argument("--over", metavar="GRID.toml|TABLE.csv", type=Path, required=True, help="pydoc rodjax.sweeps")
    run.add_argument("-o", "--output", **output)
    run.add_argument(
        "--shard", metavar="i/n", type=_shard, default=(1, 1), help="only part i of n, to be merged: for array jobs"
    )
    run.add_argument("--resume", action="store_true", help="go on where an earlier run was stopped")
    run.add_argument("--chunk", metavar="N", type=_chunk, help="cases solved, and written, at a time; 1024")
    run.add_argument(
        "--also", metavar="NAME,...", default="", help=f"further quantities to write: {', '.join(QUANTITIES)}"
    )
    run.add_argument("--csv", metavar="OUT.csv", type=Path, help="write all but the nodes as a table too")
    run.add_argument("--parquet", metavar="OUT.parquet", type=Path, help="the same as an Apache Parquet file")
    _add_scheduler(run)
    run.set_defaults(run=_sweep)
    join = commands.add_parser("merge", help="merge the shards of a sweep")
    join.add_argument("shards", metavar=f"SHARD{SWEEP_SUFFIX}", type=Path, nargs="+")
    join.add_argument("-o", "--output", **output)
    join.set_defaults(run=_merge)


def _add_fit(commands: Any) -> None:
    fit = commands.add_parser("fit", help="identify parameters of a scene from measured centerlines and end forces")
    fit.add_argument("fit", metavar="FIT.toml", type=Path, help="the unknowns: pydoc rodjax.identification.files")
    fit.add_argument("data", metavar="DATA.csv", type=Path, help="the measurements, same place")
    fit.add_argument("--out", metavar="DIR", type=Path, default=Path("rodjax-fit"), help="folder for the results")
    fit.add_argument("--profiles", action="store_true", help="draw profile likelihoods too, which doubles the time")
    fit.set_defaults(run=_fit)


def _add_report(commands: Any) -> None:
    report = commands.add_parser(
        "report", help="check a cable against limits, with pictures and a web page; exit code 3 where one is not kept"
    )
    report.add_argument("file", metavar="FILE.toml", type=Path, help="its format: pydoc rodjax.routing.files")
    report.add_argument(
        "--result",
        metavar=f"RESULT{SUFFIX}",
        type=Path,
        help="of `rodjax solve`, instead of solving the scene in the file; of a path its last step",
    )
    report.add_argument("--out", metavar="DIR", type=Path, default=Path("rodjax-report"), help="folder for the report")
    report.set_defaults(run=_report)
    route = commands.add_parser("route", help="find the best clip positions, ends and cable length within limits")
    route.add_argument("file", metavar="ROUTE.toml", type=Path, help="its format: pydoc rodjax.routing.files")
    route.add_argument("--out", metavar="DIR", type=Path, default=Path("rodjax-route"), help="folder for the results")
    route.add_argument("--starts", metavar="N", type=_chunk, help="starting points of the search; 16")
    _add_scheduler(route)
    route.add_argument("--view", action="store_true", help="show the designs of the search in a window, as view does")
    _add_window(route.add_argument_group("the window of --view"))
    route.set_defaults(run=_route)


def _add_scheduler(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--scheduler", metavar="tcp://HOST:8786", help="have the workers of a Dask scheduler compute: docs/cluster.md"
    )


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (text.isascii() and index.isdigit() and count.isdigit() and 1 <= int(index) <= int(count)):
        raise argparse.ArgumentTypeError(f"must be i/n with i from 1 to n, such as 2/8, got {text!r}")
    return int(index), int(count)


def _chunk(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) >= 1):
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, got {text!r}")
    return int(text)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 65535, got {text!r}")
    return int(text)


def _segments(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 2 <= int(text) <= MAX_SEGMENTS):
        raise argparse.ArgumentTypeError(f"must be a whole number from 2 to {MAX_SEGMENTS}, got {text!r}")
    return int(text)


def _set_up_jax() -> None:
    jax.config.update("jax_enable_x64", True)


def _warm(arguments: argparse.Namespace) -> int:
    from rodjax.warm import command_for, usual_jobs, warm

    if arguments.file is None:
        warm(usual_jobs())
    else:
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
            code = main(command_for(arguments.file, arguments.data, Path(folder)))
        if code == 2:  # bad input; what did not converge has its programs all the same
            return code
    folder = kept.folder()
    print("no programs are kept" if folder is None else f"programs are kept in {folder}")
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from rodjax.demo import run

    return run(arguments.out, arguments.segments)


def _solve(arguments: argparse.Namespace) -> int:
    _check_output(arguments.output, "-o", (SUFFIX,))
    _check_output(arguments.plot, "--plot", PLOT_SUFFIXES)
    _check_output(arguments.csv, "--csv", (TABLE_SUFFIX,))
    _check_output(arguments.dxf, "--dxf", (CAD_SUFFIX,))
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
    print("\n".join([_header(arguments.scene, file, result), *(_rows if file.is_path else _table)(result)]))
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
                f"{arguments.scene}: {_counted(len(result), 'cable')}, {_counted(len(result.joints), 'joint')}",
                *_cables(result),
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


def _counted(count: int, name: str) -> str:
    return f"{count} {name}" if count == 1 else f"{count} {name}s"


def _cables(result: rodjax.HarnessEquilibrium) -> list[str]:
    """One row for each cable and each joint."""
    wide = max(map(len, (*result, *result.joints, "cable")))
    rows = [f"{'cable':{wide}}  length [m]  segments  bend radius [m]  |f| s=0 [N]  |f| s=L [N]  |m| s=0, s=L [N m]"]
    for name, rod in result.items():
        bend = 1 / max(float(np.max(curvature_along(rod)[1])), 1e-300)
        forces = [float(np.linalg.norm(force)) for force in (rod.start_force, rod.end_force)]
        moments = [float(np.linalg.norm(moment)) for moment in (rod.start_moment, rod.end_moment)]
        rows.append(
            f"{name:{wide}}{float(rod.s[-1]):12.4g}{rod.s.shape[-1] - 1:10}{bend:17.4g}"
            f"{forces[0]:13.4g}{forces[1]:13.4g}{moments[0]:12.4g}{moments[1]:10.4g}"
        )
    rows.append(f"{'joint':{wide}}  position [m]")
    for name, body in result.joints.items():
        rows.append(f"{name:{wide}}" + "".join(f"{float(value) + 0.0:12.4g}" for value in body.position))
    return [rodjax.describe(result), f"energy       {float(result.energy):.6g} J", *rows]


def _file_to_view(path: Path) -> SceneFile | HarnessFile | rodjax.Equilibrium | rodjax.HarnessEquilibrium:
    if path.suffix != SUFFIX:
        return read_harness_file(path) if is_harness_file(path) else read_scene_file(path)
    try:
        return rodjax.load(path)
    except ValueError as error:
        raise CommandError(f"{path}: {' '.join(str(error).split())}") from None


def _view(arguments: argparse.Namespace) -> int:
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
    _show(session, arguments)
    return 0


def _show(session: Any, arguments: argparse.Namespace, limits: rodjax.Limits | None = None) -> None:
    """A session in its window, until Ctrl-C."""
    from rodjax.window.opening import show

    try:
        show(session, arguments.port, arguments.host, not arguments.no_browser, limits=limits, dark=arguments.dark)
    except ImportError as error:
        raise CommandError(str(error)) from None


def _sweep(arguments: argparse.Namespace) -> int:
    _check_output(arguments.output, "-o", (SWEEP_SUFFIX,))
    _check_output(arguments.csv, "--csv", (TABLE_SUFFIX,))
    _check_output(arguments.parquet, "--parquet", (PARQUET_SUFFIX,))
    if arguments.parquet:
        try:
            check_parquet()
        except ImportError as error:
            raise CommandError(str(error)) from None
    with _connected(arguments.scheduler) as executor:
        summary = sweep(
            arguments.scene,
            arguments.over,
            arguments.output,
            shard=arguments.shard,
            chunk=arguments.chunk,
            resume=arguments.resume,
            also=[name.strip() for name in arguments.also.split(",") if name.strip()],
            executor=executor,
            say=lambda line: print(line, flush=True),
        )
    if arguments.csv:
        write_csv(arguments.output, arguments.csv)
    if arguments.parquet:
        write_parquet(arguments.output, arguments.parquet)
    return _swept(arguments.output, summary)


def _connected(scheduler: str | None) -> "contextlib.AbstractContextManager[Executor | None]":
    return connected(scheduler, lambda line: print(f"rodjax: {line}", file=sys.stderr, flush=True))


def _merge(arguments: argparse.Namespace) -> int:
    _check_output(arguments.output, "-o", (SWEEP_SUFFIX,))
    return _swept(arguments.output, merge(arguments.shards, arguments.output))


def _swept(path: Path, summary: Summary) -> int:
    """Says what a sweep gave."""
    converged = f"{summary.cases - len(summary.failed)} of {summary.cases} cases converged"
    converged += f", {len(summary.missed)} of them not to rtol = {summary.rtol:g}" if summary.missed else ""
    print(f"{path}: {converged}, error of the shape up to about {summary.error:.0e} of the length")

    def tell(cases: list[int], what: str) -> None:
        first = ", ".join(map(str, cases[:10])) + (", ..." if len(cases) > 10 else "")
        print(f"rodjax: {path}: {len(cases)} of {summary.cases} cases {what}: {first}", file=sys.stderr)

    if summary.failed:
        tell(summary.failed, "not converged")
    if summary.missed:
        tell(summary.missed, f"above rtol = {summary.rtol:g} on the finest mesh")
    if summary.overstretched:
        tell(summary.overstretched, "strained by more than strain_limit")
    return 3 if summary.failed or summary.missed else 0


def _fit(arguments: argparse.Namespace) -> int:
    # With what it imports it takes a second, which the other commands need not wait for.
    from rodjax.identification.files import read_fit_files

    _check_folder(arguments.out, "--out")
    files = read_fit_files(arguments.fit, arguments.data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NotConvergedWarning)
        try:
            fit = rodjax.fit(files.experiments, files.unknowns, **files.options)
        except ValueError as error:
            raise CommandError(f"{arguments.fit}: {error}") from None
    report = fit.report()
    print(report, flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    written = [arguments.out / "report.txt", arguments.out / "report.json"]
    replace_file(written[0], f"{report}\n".encode())
    replace_file(written[1], f"{json.dumps(fit.as_dict(), indent=1, allow_nan=False)}\n".encode())
    written += _draw_fit(fit, arguments.out, arguments.profiles)
    print(f"written: {', '.join(map(str, written))}")
    told = "; ".join(str(w.message) for w in caught if issubclass(w.category, NotConvergedWarning))
    if fit.converged and not told:
        return 0
    print(f"rodjax: {arguments.fit}: {' '.join(told.split())}", file=sys.stderr)
    return 3


def _draw_fit(fit: "rodjax.Fit", folder: Path, profiles: bool) -> list[Path]:
    """Draws what there is to draw; returns the names of the files."""
    from rodjax.identification import plots

    figures = {}
    if plots.has_centerlines(fit):
        figures |= {"shapes": plots.plot_shapes(fit), "residuals": plots.plot_residuals(fit)}
    if len(fit.labels) > 1:
        figures["correlation"] = plots.plot_correlation(fit)
    found = _profiles(fit) if profiles else []
    if found:
        figures["profiles"] = plots.plot_profiles(found)
    for name, figure in figures.items():
        _save_figure(figure, folder / f"{name}.png", dpi=150)
    return [folder / f"{name}.png" for name in figures]


def _profiles(fit: "rodjax.Fit") -> "list[Profile]":
    found = []
    for label in fit.labels:
        try:
            found.append(fit.profile(label))
        except ValueError as error:  # three standard errors reach beyond the bounds
            print(f"rodjax: the profile of {label} is not drawn: {error}", file=sys.stderr)
    return found


def _report(arguments: argparse.Namespace) -> int:
    from rodjax.routing.files import read_route_file

    _check_folder(arguments.out, "--out")
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


def _route(arguments: argparse.Namespace) -> int:
    from rodjax.routing.files import read_route_file
    from rodjax.routing.outcome import starts_table, written_route

    _check_folder(arguments.out, "--out")
    if arguments.view and find_spec("viser") is None:
        raise CommandError("--view needs viser, got none: pip install 'rodjax[view]'")
    file = read_route_file(arguments.file, for_route=True)
    scene = file.of_route
    starts = arguments.starts or file.starts
    options: dict[str, Any] = {} if starts is None else {"starts": starts}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConvergedWarning)  # said by the report
        warnings.simplefilter("ignore", OverstretchedWarning)
        try:
            with _connected(arguments.scheduler) as executor:
                route = rodjax.route(
                    scene.scenes[0],
                    file.variables,
                    limits=file.limits,
                    objective=file.objective,
                    obstacles=file.obstacles,
                    names=file.names,
                    segments=scene.segments,
                    executor=executor,
                    **options,
                )
        except ClusterError:
            raise
        except (ValueError, TaskError) as error:
            raise CommandError(f"{arguments.file}: {error}") from None
    title = file.title or str(arguments.file)
    report = rodjax.report(
        route,
        obstacles=file.obstacles,
        names=file.names,
        title=title,
        source=f"{arguments.file}, {route.segments} segments",
    )
    print(f"{route}\n\n{starts_table(route)}\n\n{report}", flush=True)
    written = [*report.save(arguments.out), *written_route(route, arguments.out)]
    print(f"\nwritten: {', '.join(map(str, written))}", flush=True)
    if not route.feasible:
        print(
            f"rodjax: {arguments.file}: no route was found that keeps to all limits; {report.verdict}", file=sys.stderr
        )
    if arguments.view:
        from rodjax.window.opening import session_of

        with warnings.catch_warnings():
            for category in (NotConvergedWarning, OverstretchedWarning, MeshWarning):
                warnings.simplefilter("ignore", category)  # said by the window
            session = session_of(route, None)
        _show(session, arguments, route.limits)
    return 0 if route.feasible else 3


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


def _check_output(path: Path | None, option: str, suffixes: tuple[str, ...]) -> None:
    """Finds out before a long solve that its result could not be written."""
    if path is None:
        return
    if path.suffix not in suffixes:
        raise CommandError(f"{option} must end in {' or '.join(suffixes)}, got {str(path)!r}")
    if not path.parent.is_dir():
        raise CommandError(f"{option} must be in a folder that exists, got {str(path)!r}")
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise CommandError(f"{option} must be a file that can be written, got {str(path)!r}")


def _check_folder(path: Path, option: str) -> None:
    """The same of a folder, which is made where it is not there."""
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise CommandError(f"{option} must be a folder that can be written, got {str(path)!r}")


def _draw(path: Path, equilibrium: Result, write: Callable[[Result, Path], None]) -> None:
    """Writes a file of a shape, which must be finite."""
    rods = [equilibrium] if isinstance(equilibrium, Equilibrium) else equilibrium.values()
    if not all(np.all(np.isfinite(rod.nodes)) for rod in rods):
        print(f"rodjax: {path} is not written: the shape is not finite", file=sys.stderr)
        return
    write(equilibrium, path)


def _plot_harness(result: rodjax.HarnessEquilibrium, path: Path) -> None:
    from rodjax.plot import figure_of, plot_harness

    _save_figure(figure_of(plot_harness(result)), path)


def _plot(equilibrium: Equilibrium, path: Path) -> None:
    from rodjax.plot import figure_of, plot_rod

    _save_figure(figure_of(plot_rod(equilibrium)), path)


def _write_dxf(equilibrium: Equilibrium, path: Path) -> None:
    try:
        write_dxf(equilibrium, path)
    except ImportError as error:
        raise CommandError(str(error)) from None


def _save_figure(figure: "Figure", path: Path, **options: Any) -> None:
    # Put together in memory, so that a full disk leaves the picture that was there.
    image = io.BytesIO()
    figure.savefig(image, format=path.suffix[1:], **options)
    replace_file(path, image.getvalue())


def _header(path: Path, file: SceneFile, result: Equilibrium) -> str:
    scene = file.scenes[0]
    supports = " to ".join(
        "clamp fitted without torsion" if name in file.unclocked else type(end).__name__.lower()
        for name, end in (("start", scene.start), ("end", scene.end))
    )
    scenes = f", {len(file.scenes)} scenes" if file.is_path else ""
    mesh = f"{result.s.shape[-1] - 1} segments"
    if file.segments is None:  # otherwise the estimate would be a program more to compile
        error = np.max(np.asarray(result.error_estimate)[np.asarray(result.converged)], initial=0.0)
        mesh += f", error of the shape about {error:.0e} of the length"
    return f"{path}: {supports}, {float(scene.rod.length):g} m{scenes}, {mesh}"


def _table(result: Equilibrium) -> list[str]:
    def vector(values: Any) -> str:
        # Adding zero makes zeros of -0.
        return "".join(f"{float(value) + 0.0:12.4g}" for value in values)

    twist, elastic, scene = float(result.total_twist), float(result.elastic_energy), result.scene
    forces, moments = np.asarray(result.clip_forces), np.asarray(result.clip_moments)
    rows = [f"{f'clip {k}':9}{vector(forces[k])}   {vector(moments[k])}" for k in range(len(scene.clips))]
    for k, forces in enumerate(np.asarray(result.obstacle_forces)):
        rows.append(f"{'':9}{vector(forces.sum(0))}   {_named(result, k)}")
    return [
        rodjax.describe(result),
        f"energy       {elastic:.6g} J elastic, {float(result.energy) - elastic:.6g} J of the loads",
        f"total twist  {twist:.6g} rad ({np.degrees(twist):.4g} deg)",
        "The part of the rod beyond s exerts on the part before it, at the end the support on the rod:",
        f"{'':9}{'force [N]':>36}   {'moment [N m]':>36}",
        f"{'s = 0':9}{vector(result.start_force)}   {vector(result.start_moment)}",
        f"{'s = L':9}{vector(result.end_force)}   {vector(result.end_moment)}",
        *(["Clips and obstacles exert on the rod:"] if rows else []),
        *rows,
        *_bends_and_clearances(result),
    ]


def _bends_and_clearances(result: Equilibrium) -> list[str]:
    largest = float(np.max(curvature_along(result)[1]))
    first, last = (round(float(s), 4) for s in rodjax.most_curved(result))
    rows = [f"smallest bend radius  {1 / largest:.4g} m, between s = {first:g} and {last:g} m"] if largest else []
    if result.scene.obstacles:
        found = rodjax.clearance(result, result.scene.obstacles)
        for k, (distance, s) in enumerate(zip(np.asarray(found.distance), np.asarray(found.s), strict=True)):
            rows.append(f"clearance to {_named(result, k)}  {distance:.4g} m at s = {s:.4g} m")
    return rows


def _named(result: Equilibrium, k: int) -> str:
    return f"obstacles[{k}] ({type(result.scene.obstacles[k]).__name__})"


def _rows(path: Equilibrium) -> list[str]:
    titles = ("twist [deg]", "energy [J]", "|end force| [N]", "|end moment| [N m]", "residual", "iterations")
    rows = [f"{'step':>4}" + "".join(f"{title:>{len(title) + 3}}" for title in titles) + "   status"]
    columns = [
        np.degrees(path.total_twist),
        path.energy,
        np.linalg.norm(path.end_force, axis=-1),
        np.linalg.norm(path.end_moment, axis=-1),
        path.residual,
        path.iterations,
    ]
    for step, status in enumerate(np.asarray(path.status)):
        cells = [f"{float(c[step]):{len(t) + 3}.5g}" for t, c in zip(titles, columns, strict=True)]
        rows.append(f"{step:4}" + "".join(cells) + f"   {Status(status).name.lower().replace('_', ' ')}")
    return rows
