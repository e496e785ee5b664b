"""Do time and iterations depend on mesh and slenderness?

Fig. 1 of Linn & Stephan (2008), the path of 25 steps by finite differences: from 10 to 10000 segments at L/R = 200, and
from L/R = 10 to a million at 50 segments: time, iterations and evaluations a step, residual reached, memory. Then both
end tangents turned by a whole radian at once, at every slenderness, beside the same in ten steps.
"""

import argparse
import math
import resource
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from measuring import ROUND_SECONDS, Timed, compiled, conditions, machine, number, save_rows, set_up

import rodjax
from rodjax import problems
from rodjax.paths.path import stack_scenes

DISCRETIZATION = "finite_difference"
SOLVERS = {"default": None, "newton": rodjax.Newton(), "ncg": rodjax.NonlinearCG()}
STEPS = 25
SLENDERNESS, SEGMENTS = 200.0, 50  # of the sweep over the other
REFERENCE = 200  # segments to whose time per segment the others are compared
SMALL_STEPS = 10
MIB = 2**20


class Row(NamedTuple):
    """A line of the table; times, iterations and evaluations are of a step."""

    solver: str
    segments: int
    slenderness: float
    ms_median: float
    ms_min: float
    runs: int
    iterations_median: float
    iterations_max: int
    evaluations: float  # mean
    substeps: float  # most in a step; NaN where a path has none
    converged: int  # steps
    residual: float  # largest [EI/L^2]
    program_mib: float  # arguments, results and scratch of the compiled program
    resident_mib: float  # most of the process so far
    compile_s: float
    per_segment: float = math.nan  # time a step and segment, relative to that at N = 200


class Radian(NamedTuple):
    """Both end tangents turned by 1 rad at once, at 50 segments."""

    solver: str
    slenderness: float
    ms_median: float
    iterations: int
    converged: bool
    residual: float
    small_iterations: int  # the sum over ten steps
    small_converged: bool
    distance: float  # largest of a node from the shape that ten steps reach, over L


def fig_1_row(name: str, segments: int, slenderness: float, repeats: int) -> Row:
    rod = problems.cable(slenderness)
    arguments = stack_scenes(problems.figure_1(rod)), problems.figure_1_start()

    def path(scenes, guess):
        return rodjax.solve_path(
            scenes, segments=segments, discretization=DISCRETIZATION, guess=guess, solver=SOLVERS[name]
        )

    program, seconds = compiled(path, *arguments)
    runs: Timed[rodjax.Equilibrium] = Timed(lambda: program(*arguments))
    runs.round(repeats)
    result, iterations = runs.result, np.asarray(runs.result.iterations)
    substeps = getattr(result, "substeps", None)
    return Row(
        solver=name,
        segments=segments,
        slenderness=slenderness,
        ms_median=statistics.median(runs.times) / STEPS,
        ms_min=min(runs.times) / STEPS,
        runs=len(runs.times),
        iterations_median=float(np.median(iterations)),
        iterations_max=int(np.max(iterations)),
        evaluations=float(np.mean(result.evaluations)),
        substeps=math.nan if substeps is None else float(np.max(substeps)),
        converged=int(np.sum(result.converged)),
        residual=float(np.max(result.residual)),
        program_mib=program_mib(program),
        resident_mib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,  # KiB on Linux
        compile_s=seconds,
    )


def program_mib(program: Any) -> float:
    memory = program.memory_analysis()
    return (memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes) / MIB


def relative(rows: Sequence[Row]) -> list[Row]:
    """The rows with their time a step and segment against that at the reference mesh, where there is one."""
    known = {row.solver: row.ms_median / row.segments for row in rows if row.segments == REFERENCE}
    return [row._replace(per_segment=row.ms_median / row.segments / known.get(row.solver, math.nan)) for row in rows]


def radian_row(name: str, slenderness: float, repeats: int) -> Radian:
    rod = problems.cable(slenderness)
    before = problems.omega(problems.ARC_HALF_ANGLE, 0.0, rod)
    tilts = problems.ARC_HALF_ANGLE - np.linspace(0.0, 1.0, SMALL_STEPS + 1)[1:]
    small = stack_scenes([problems.omega(tilt, 0.0, rod) for tilt in tilts])
    after = problems.omega(tilts[-1], 0.0, rod)

    options: dict[str, Any] = {"segments": SEGMENTS, "discretization": DISCRETIZATION, "solver": SOLVERS[name]}

    # Compiled by us and not called as is, a solve that does not converge gives no warning: the table says it.
    def solve(scene, guess):
        return rodjax.solve(scene, guess=guess, **options)

    def solve_small(scenes, guess):
        return rodjax.solve_path(scenes, guess=guess, **options)

    first = compiled(solve, before, problems.figure_1_start())[0](before, problems.figure_1_start())
    program, _ = compiled(solve, after, first)
    runs: Timed[rodjax.Equilibrium] = Timed(lambda: program(after, first))
    runs.round(repeats)
    large, path = runs.result, compiled(solve_small, small, first)[0](small, first)
    apart = np.linalg.norm(np.asarray(large.nodes - path.nodes[-1]), axis=1)
    return Radian(
        solver=name,
        slenderness=slenderness,
        ms_median=statistics.median(runs.times),
        iterations=int(large.iterations),
        converged=bool(large.converged),
        residual=float(large.residual),
        small_iterations=int(np.sum(path.iterations)),
        small_converged=bool(np.all(path.converged)),
        distance=float(np.max(apart) / rod.length),
    )


HEADER = (
    f"{'':8}{'':7}{'':8}|{'ms a step':^18}{'a segment':>10}{'':5}|{'iterations':^13}{'evals':>9}{'sub-':>6}{'con-':>7}"
    f"{'residual':>10} |{'MiB of':>8}{'MiB resi-':>10}{'compile':>8}\n"
    f"{'solver':8}{'N':>7}{'L/R':>8}|{'median':>9}{'min':>9}{'to N=200':>10}{'runs':>5}|{'median':>7}{'max':>6}"
    f"{'mean':>9}{'steps':>6}{'verged':>7}{'EI/L^2':>10} |{'program':>8}{'dent, max':>10}{'s':>8}"
)


def line(row: Row) -> str:
    return (
        f"{row.solver:8}{row.segments:7}{row.slenderness:8g}|{row.ms_median:9.3f}{row.ms_min:9.3f}"
        f"{number(row.per_segment, '.2f', 10)}{row.runs:5}|{row.iterations_median:7.0f}{row.iterations_max:6}"
        f"{row.evaluations:9.1f}{number(row.substeps, '.0f', 6)}{row.converged:7}{row.residual:10.1e} |"
        f"{row.program_mib:8.2f}{row.resident_mib:10.0f}{row.compile_s:8.1f}"
    )


RADIAN_HEADER = (
    f"{'':8}{'':8}{'1 rad in one step':>18}{'':17}{'residual':>10} |{'in ten steps':>12}{'':9}{'distance':>10}\n"
    f"{'solver':8}{'L/R':>8}{'ms':>9}{'iterations':>12}{'converged':>11}{'EI/L^2':>13} |"
    f"{'iterations':>11}{'converged':>10}{'/ L':>10}"
)


def radian_line(row: Radian) -> str:
    return (
        f"{row.solver:8}{row.slenderness:8g}{row.ms_median:9.3f}{row.iterations:12}{yes(row.converged):>11}"
        f"{row.residual:13.1e} |{row.small_iterations:11}{yes(row.small_converged):>10}{row.distance:10.1e}"
    )


def yes(is_so: bool) -> str:
    return "yes" if is_so else "NO"


def picture(over_mesh: Sequence[Row], over_slenderness: Sequence[Row]) -> Figure:
    """Time and iterations a step against mesh (left) and slenderness (right); hollow where not all steps converged."""
    figure = Figure(figsize=(12, 7.2), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col", sharey="row")
    sweeps = (
        ("segments", "segments N", over_mesh, f"L/R = {SLENDERNESS:g}"),
        ("slenderness", "slenderness L/R", over_slenderness, f"N = {SEGMENTS}"),
    )
    for (time, iterations), (field, label, rows, title) in zip(panels.T, sweeps, strict=True):
        for k, solver in enumerate(dict.fromkeys(row.solver for row in rows)):
            curve = [row for row in rows if row.solver == solver]
            x = [getattr(row, field) for row in curve]
            most = [row.iterations_max for row in curve]
            time.loglog(x, [row.ms_median for row in curve], "-", color=f"C{k}", label=solver)
            for row in curve:
                fill = f"C{k}" if row.converged == STEPS else "white"
                time.plot(getattr(row, field), row.ms_median, "o", color=f"C{k}", markerfacecolor=fill)
            iterations.loglog(
                x, [row.iterations_median for row in curve], "o-", color=f"C{k}", label=f"{solver}: median"
            )
            iterations.loglog(x, most, "v:", color=f"C{k}", label=f"{solver}: most")
        time.set_title(title)
        iterations.set_xlabel(label)
        for axes in (time, iterations):
            axes.grid(color="0.92")
    panels[0, 0].set_ylabel("time of a step [ms]")
    panels[1, 0].set_ylabel("iterations a step")
    panels[0, 0].legend()
    panels[1, 0].legend()
    figure.suptitle(f"Fig. 1 over mesh and slenderness\n{machine()}, one thread, double precision, without compiling")
    return figure


def main(argv: Sequence[str] | None = None) -> tuple[list[Row], list[Row], list[Radian]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solver", nargs="+", choices=list(SOLVERS), default=["default"])
    meshes = [10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000]
    parser.add_argument("--segments", type=int, nargs="+", default=meshes, help=f"meshes at L/R = {SLENDERNESS:g}")
    slender = [10.0, 20.0, 200.0, 2e3, 2e4, 2e5, 1e6]
    parser.add_argument("--slenderness", type=float, nargs="+", default=slender, help=f"L/R at N = {SEGMENTS}")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path, help="folder for scaling.csv, scaling_radian.csv and scaling.png")
    arguments = parser.parse_args(argv)
    set_up()
    print(f"Fig. 1, {STEPS} steps; {conditions()}")
    print(f"times: median of {arguments.repeats} paths, or as many as fit in {ROUND_SECONDS:.0f} s, at least one")
    print(HEADER)
    over_mesh: list[Row] = []
    over_slenderness: list[Row] = []
    for name in arguments.solver:
        over_mesh += relative([fig_1_row(name, n, SLENDERNESS, arguments.repeats) for n in arguments.segments])
        print("\n".join(line(row) for row in over_mesh if row.solver == name), flush=True)
    for name in arguments.solver:
        for slenderness in arguments.slenderness:
            over_slenderness.append(fig_1_row(name, SEGMENTS, slenderness, arguments.repeats))
            print(line(over_slenderness[-1]), flush=True)
    print(RADIAN_HEADER)
    radians = []
    for name in arguments.solver:
        for slenderness in arguments.slenderness:
            radians.append(radian_row(name, slenderness, arguments.repeats))
            print(radian_line(radians[-1]), flush=True)
    if arguments.out is not None:
        save_rows(over_mesh + over_slenderness, arguments.out / "scaling.csv")
        save_rows(radians, arguments.out / "scaling_radian.csv")
        picture(over_mesh, over_slenderness).savefig(arguments.out / "scaling.png", dpi=110)
    return over_mesh, over_slenderness, radians


if __name__ == "__main__":
    main()
