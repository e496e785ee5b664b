"""The command `rodjax`.

Exit codes: 0 all converged, and all limits are kept where there are any; 2 bad input, one line on stderr; 3 something
did not converge, a cable that is reported does not keep to a limit, or no route was found within limits: stderr names
what.
"""

import argparse
import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax

import rodjax
from rodjax.cluster import ClusterError
from rodjax.commands.errors import CommandError
from rodjax.commands.fit import run_fit
from rodjax.commands.report import run_report
from rodjax.commands.route import run_route
from rodjax.commands.solve import run_solve
from rodjax.commands.sweep import run_merge, run_sweep
from rodjax.commands.view import run_view
from rodjax.io.files import SUFFIX
from rodjax.io.scene_file import SceneFileError
from rodjax.notes import told
from rodjax.programs import kept
from rodjax.solving.options import MAX_SEGMENTS
from rodjax.sweeps.cases import SweepError
from rodjax.sweeps.quantities import QUANTITIES
from rodjax.sweeps.sweep import SUFFIX as SWEEP_SUFFIX

# The exit code where nobody reads what is printed, as after `| head`: that of other commands, which a signal ends.
NOBODY_READS = 128 + 13


def main(argv: Sequence[str] | None = None) -> int:
    """Runs `rodjax` with these arguments, or those of the process; returns the exit code."""
    try:
        arguments = _parser().parse_args(argv)
        _set_up_jax()
        # A window lives for hours, and tells of each of its solves.
        has_window = arguments.run is run_view or getattr(arguments, "view", False)
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
    solve.set_defaults(run=run_solve)
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
    view.set_defaults(run=run_view)


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
    run.set_defaults(run=run_sweep)
    join = commands.add_parser("merge", help="merge the shards of a sweep")
    join.add_argument("shards", metavar=f"SHARD{SWEEP_SUFFIX}", type=Path, nargs="+")
    join.add_argument("-o", "--output", **output)
    join.set_defaults(run=run_merge)


def _add_fit(commands: Any) -> None:
    fit = commands.add_parser("fit", help="identify parameters of a scene from measured centerlines and end forces")
    fit.add_argument("fit", metavar="FIT.toml", type=Path, help="the unknowns: pydoc rodjax.identification.files")
    fit.add_argument("data", metavar="DATA.csv", type=Path, help="the measurements, same place")
    fit.add_argument("--out", metavar="DIR", type=Path, default=Path("rodjax-fit"), help="folder for the results")
    fit.add_argument("--profiles", action="store_true", help="draw profile likelihoods too, which doubles the time")
    fit.set_defaults(run=run_fit)


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
    report.set_defaults(run=run_report)
    route = commands.add_parser("route", help="find the best clip positions, ends and cable length within limits")
    route.add_argument("file", metavar="ROUTE.toml", type=Path, help="its format: pydoc rodjax.routing.files")
    route.add_argument("--out", metavar="DIR", type=Path, default=Path("rodjax-route"), help="folder for the results")
    route.add_argument("--starts", metavar="N", type=_chunk, help="starting points of the search; 16")
    _add_scheduler(route)
    route.add_argument("--view", action="store_true", help="show the designs of the search in a window, as view does")
    _add_window(route.add_argument_group("the window of --view"))
    route.set_defaults(run=run_route)


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
