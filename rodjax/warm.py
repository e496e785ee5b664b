"""`rodjax warm`: compiles what will be needed, so that the first answers come at once."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from rodjax.io.quantities import in_file
from rodjax.io.scene_file import read_text, toml_tables
from rodjax.model.obstacles import Plane
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Clip
from rodjax.notes import bar
from rodjax.paths.path import solve_path
from rodjax.problems import cable, figure_1, figure_1_start, hanging_cable
from rodjax.programs.answers import numpy_first
from rodjax.solving.description import describe
from rodjax.solving.result import Equilibrium
from rodjax.solving.solve import solve

# Of an experiment's or a route's file, tables that no scene has.
OF_FITS, OF_ROUTES, OF_REPORTS = (
    {"unknown", "measured", "experiments"},
    {"variables", "objective"},
    {"limits", "cables"},
)


def usual_jobs() -> dict[str, Callable[[], object]]:
    """Cables as most are, each between two clamps under its own weight, by what is special about them."""
    plain = hanging_cable()
    curvatures = None, (1.0, 0.0)
    rods = [Rod(1.0, (4e-3, 8e-3), 4e-3, 800.0, 0.1, radius=5e-3, rest_curvature=at_rest) for at_rest in curvatures]
    clip, floor = Clip(0.5, (0.4, 0.05, -0.1)), Plane((0.0, 0.0, -0.15), (0.0, 0.0, 1.0))
    scenes = {
        "a cable": plain,
        "a flat cable": hanging_cable(rod=rods[0]),
        "a curved hose": hanging_cable(rod=rods[1]),
        "a cable in a clip": Scene(cable(), plain.start, plain.end, plain.gravity, clips=[clip]),
        "a cable on a floor": Scene(cable(), plain.start, plain.end, plain.gravity, obstacles=[floor]),
    }

    def solved(scene: Scene) -> Equilibrium:
        result = solve(scene)
        describe(result)
        return solve(scene, guess=result)

    jobs: dict[str, Callable[[], object]] = {name: lambda scene=scene: solved(scene) for name, scene in scenes.items()}
    jobs["a path"] = lambda: solve_path(figure_1(), segments=16, guess=figure_1_start())
    return jobs


def command_for(file: Path, data: Sequence[Path], folder: Path) -> list[str]:
    """The command that a file is for, its results in a folder."""
    with in_file(file):
        tables = set(toml_tables(read_text(file)))
    of_tables = {"fit": OF_FITS, "route": OF_ROUTES, "report": OF_REPORTS}
    command = next((name for name, known in of_tables.items() if tables & known), "solve")
    output = ["-o", str(folder / "result.vtkhdf")] if command == "solve" else ["--out", str(folder)]
    return [command, str(file), *map(str, data), *output]


def warm(jobs: dict[str, Callable[[], object]]) -> None:
    """Does each of the jobs, with a bar that names it."""
    with bar(len(jobs), "jobs") as drawn, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, job in jobs.items():
            drawn.describe(name)
            job()  # what a first answer needs
            with numpy_first(False):  # and all others
                job()
            drawn.update()
