"""`rodjax route`: the best design within limits, its report, and the designs of the search in a window."""

import argparse
import sys
import warnings
from importlib.util import find_spec
from typing import Any

import rodjax
from rodjax.cluster import ClusterError
from rodjax.commands.errors import CommandError
from rodjax.commands.outputs import check_folder
from rodjax.commands.sweep import connection
from rodjax.commands.view import show_session
from rodjax.programs.tasks import TaskError
from rodjax.solving.result_warnings import MeshWarning, NotConvergedWarning, OverstretchedWarning


def run_route(arguments: argparse.Namespace) -> int:
    from rodjax.routing.files import read_route_file
    from rodjax.routing.outcome import starts_table, written_route

    check_folder(arguments.out, "--out")
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
            with connection(arguments.scheduler) as executor:
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
        show_session(session, arguments, route.limits)
    return 0 if route.feasible else 3
