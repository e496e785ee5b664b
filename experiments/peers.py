"""How do other programs fare on three benchmark problems: the time of a solve beside its shape error?

P1, a cantilever under a dead tip force, P2, the path of Fig. 1 of Linn & Stephan (2008), and P3, a hanging cable, by
rodjax (finite differences and Hermite elements, these for P1 and P3 also with the unknowns of their plane alone) and by
those of these programs that are installed (`pip install 'rodjax[peers]'`):

- Exudyn, multibody dynamics with beam elements and a static solver (full Newton steps, no line search);
- PyElastica, explicit dynamics of Cosserat rods, damped to rest;
- MuJoCo with its cable plugin, rigid bodies on ball joints, damped to rest (3.3.7 is the last wheel with the plugin).

Each runs with the settings that served it best here, on one thread, and only its solve is timed: no compiling, building
or writing. All take turns, since a shared machine is quicker in one minute than in the next. The error is the largest
distance of a node from the continuum at the same arclength, over L; that of P2 is at its last step.
"""

import argparse
import importlib.util
import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from measuring import Timed, conditions, save_rows, set_up
from peer_programs import (
    Contender,
    ExudynBeam,
    ExudynCable,
    MuJoCo,
    Problem,
    PyElastica,
    Rodjax,
    arclengths,
    benchmark_problems,
)

# Richardson extrapolation from these two meshes stands for the continuum.
FINE = (500, 1000)
# A slow solve is repeated for about so long [s] in a round, once at least.
ROUND_SECONDS = 3.0


class Row(NamedTuple):
    """A line of the table; times are of one scene: a solve of P1 and P3, a step of P2."""

    problem: str
    program: str
    elements: int
    ms_median: float
    ms_min: float
    runs: int
    error: float  # NaN where the program did not get to the last scene
    notes: str


def continuum(problem: Problem) -> Callable[[np.ndarray], np.ndarray]:
    """Positions at arclengths, where finite differences of second order lead to as the mesh is refined.

    Within 2e-8 L of a shooting solution of the rod's differential equations.
    """
    coarse, fine = (Rodjax(problem, segments, "finite_difference").result for segments in FINE)

    def positions(s: np.ndarray) -> np.ndarray:
        at = [np.asarray(result.position_at(s)).reshape(-1, len(s), 3)[-1] for result in (coarse, fine)]
        refined = (FINE[1] / FINE[0]) ** 2
        return (refined * at[1] - at[0]) / (refined - 1)

    return positions


def contenders(problem: Problem, arguments: argparse.Namespace) -> list[Contender]:
    """All programs on all meshes, as far as they are installed."""
    exudyn = ExudynBeam if len(problem.scenes) > 1 else ExudynCable
    marched = [n for n in arguments.elements if n <= arguments.marched_up_to]
    # On finer meshes the welds need time steps that are too small to come to rest in minutes.
    jointed = [n for n in marched if n <= 20]
    found: list[Contender] = [Rodjax(problem, n, "finite_difference") for n in arguments.segments]
    found += [Rodjax(problem, n, "hermite") for n in arguments.hermite]
    if len(problem.scenes) == 1:  # P1 and P3 lie in a plane; the end frame of P2 turns out of it
        found += [Rodjax(problem, n, "hermite", planar=True) for n in arguments.hermite]
    for module, model, meshes in (
        ("exudyn", exudyn, arguments.elements),
        ("elastica", PyElastica, marched),
        ("mujoco", MuJoCo, jointed),
    ):
        if importlib.util.find_spec(module) is not None:
            found += [model(problem, n) for n in meshes]
    return found


def measured(problem: Problem, arguments: argparse.Namespace) -> list[Row]:
    """Rounds in which all take turns."""
    everyone = contenders(problem, arguments)
    timed = [Timed(contender.solve) for contender in everyone]
    for _ in range(arguments.rounds):
        for mine in timed:
            mine.round(arguments.repeats, ROUND_SECONDS)
    truth, scenes = continuum(problem), len(problem.scenes)
    rows = []
    for contender, mine in zip(everyone, timed, strict=True):
        off = contender.nodes() - truth(arclengths(contender.elements))
        rows.append(
            Row(
                problem=problem.name,
                program=contender.program,
                elements=contender.elements,
                ms_median=statistics.median(mine.times) / scenes,
                ms_min=min(mine.times) / scenes,
                runs=len(mine.times),
                error=float(np.max(np.linalg.norm(off, axis=1))),
                notes=contender.notes,
            )
        )
    return rows


HEADER = f"{'':3} {'program':32}{'elements':>8}{'ms median':>11}{'min':>9}{'runs':>6}{'error/L':>10}  notes"


def line(row: Row) -> str:
    error = "failed" if math.isnan(row.error) else f"{row.error:.1e}"
    return (
        f"{row.problem:3} {row.program:32}{row.elements:8}{row.ms_median:11.3f}{row.ms_min:9.3f}{row.runs:6}"
        f"{error:>10}  {row.notes}"
    )


def picture(rows: Sequence[Row]) -> Figure:
    """Time against error, a panel a problem and a curve a program."""
    titles = {problem.name: problem.title for problem in benchmark_problems()}
    shown = [name for name in titles if any(row.problem == name for row in rows)]
    programs = list(dict.fromkeys(row.program for row in rows))
    figure = Figure(figsize=(4.4 * len(shown), 4.6), layout="constrained")
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, name in zip(panels, shown, strict=True):
        for k, program in enumerate(programs):
            curve = [row for row in rows if (row.problem, row.program) == (name, program) and row.error > 0]
            if not curve:
                continue
            axes.loglog(
                [row.error for row in curve], [row.ms_median for row in curve], "o-", color=f"C{k}", label=program
            )
            for row in curve:
                at = (row.error, row.ms_median)
                axes.annotate(str(row.elements), at, (4, 4), textcoords="offset points", fontsize=8, color=f"C{k}")
        axes.set(title=titles[name], xlabel="largest node error / L")
        axes.invert_xaxis()
        axes.margins(0.1)
        axes.grid(color="0.9")
    panels[0].set_ylabel("time [ms]")
    panels[0].legend()
    figure.suptitle("Time of a solve against its error; at each point the number of elements")
    return figure


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=["P1", "P2", "P3"], default=["P1", "P2", "P3"])
    parser.add_argument(
        "--segments", type=int, nargs="+", default=[10, 20, 50, 100, 200, 500, 1000], help="of rodjax's differences"
    )
    parser.add_argument("--hermite", type=int, nargs="+", default=[4, 6, 8, 12, 16, 24], help="of rodjax's elements")
    parser.add_argument("--elements", type=int, nargs="+", default=[10, 20, 40, 80], help="of the others")
    parser.add_argument(
        "--marched-up-to", type=int, default=40, help="largest mesh for PyElastica, and for MuJoCo up to 20"
    )
    parser.add_argument("--rounds", type=int, default=3, help="turns of all")
    parser.add_argument("--repeats", type=int, default=7, help="runs of each in a round")
    parser.add_argument("--out", type=Path, help="folder for peers.csv and peers.png")
    arguments = parser.parse_args(argv)
    set_up()
    print(conditions())
    for module, package in (("exudyn", "exudyn"), ("elastica", "pyelastica"), ("mujoco", "mujoco==3.3.7")):
        if importlib.util.find_spec(module) is None:
            print(f"skipped, not installed: {package}")
    print(HEADER)
    rows = []
    for problem in benchmark_problems():
        if problem.name in arguments.problems:
            found = measured(problem, arguments)
            print("\n".join(map(line, found)), flush=True)
            rows += found
    if arguments.out is not None:
        save_rows(rows, arguments.out / "peers.csv")
        picture(rows).savefig(arguments.out / "peers.png", dpi=110)
    return rows


if __name__ == "__main__":
    main()
