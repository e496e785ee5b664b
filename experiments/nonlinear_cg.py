"""What does the preconditioner buy on Fig. 1 of Linn & Stephan (2008), and how far is it from the machine's limit?

The 25 steps of Fig. 1 by plain nonlinear conjugate gradients, the report's method, and by the preconditioned default.
With `--limit`, hand-written C++ (analytic derivatives; banded Newton and plain NCG) runs in turn with them, since a
shared machine is quicker in one minute than in the next: `ratio` compares runs that lay side by side.
"""

import argparse
import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from measuring import ROUND_SECONDS, CppRuns, Timed, compiled, conditions, machine, number, save_rows, set_up

import rodjax
from rodjax import problems
from rodjax.paths.path import stack_scenes

STEPS = 25


class Limit(NamedTuple):
    """A method of the C++ program."""

    name: str
    argument: Literal["newton", "ncg"]
    tolerance: str
    color: str


class Method(NamedTuple):
    """A solver of rodjax, and the C++ method it is compared with, at the same tolerance."""

    name: str
    solver: rodjax.NonlinearCG
    limit: Limit | None
    color: str


class Row(NamedTuple):
    """A line of the table; counts and times are per step."""

    segments: int
    method: str
    tolerance: float
    iterations_median: float  # NaN where only the mean is known
    iterations_mean: float
    iterations_max: int
    evaluations: float
    ms_median: float
    ms_min: float
    paths: int
    compile_s: float  # NaN for C++
    converged: bool
    energy: float  # of stage (f) [EI/L]
    ratio: float = math.nan  # median over the rounds, to the C++ method


def plain(tolerance: float) -> rodjax.NonlinearCG:
    return rodjax.NonlinearCG(preconditioner=None, tolerance=tolerance, max_iterations=1_000_000)


NEWTON = Limit("C++ Newton", "newton", "1e-8", "C0")
NCG = Limit("C++ plain NCG", "ncg", "1e-4", "C1")
PLAIN = (Method("plain NCG", plain(1e-4), NCG, "C1"), Method("plain NCG", plain(1e-8), None, "C3"))
PRECONDITIONED = Method("preconditioned", rodjax.NonlinearCG(), NEWTON, "C0")


class OurRuns:
    """The compiled path of one method, and the times of its runs."""

    def __init__(self, method: Method, segments: int):
        self.method, self.segments = method, segments
        scenes, guess = stack_scenes(problems.figure_1()), problems.figure_1_start()

        def path(scenes, guess):
            return rodjax.solve_path(
                scenes, segments=segments, discretization="finite_difference", guess=guess, solver=method.solver
            )

        program, self.compile_s = compiled(path, scenes, guess)
        self.path: Timed[rodjax.Equilibrium] = Timed(lambda: program(scenes, guess))

    def round(self, repeats: int) -> float:
        """Median time of some runs [ms a step]."""
        return self.path.round(repeats) / STEPS

    def row(self, ratios: Sequence[float]) -> Row:
        path, scale = self.path.result, float(problems.cable().EI / problems.cable().length)
        iterations = np.asarray(path.iterations)
        return Row(
            segments=self.segments,
            method=self.method.name,
            tolerance=self.method.solver.tolerance,
            iterations_median=float(np.median(iterations)),
            iterations_mean=float(np.mean(iterations)),
            iterations_max=int(np.max(iterations)),
            evaluations=float(np.mean(path.evaluations)),
            ms_median=statistics.median(self.path.times) / STEPS,
            ms_min=min(self.path.times) / STEPS,
            paths=len(self.path.times),
            compile_s=self.compile_s,
            converged=bool(np.all(path.converged)),
            energy=float(path.energy[-1]) / scale,
            ratio=statistics.median(ratios) if ratios else math.nan,
        )


def cpp_row(limit: Limit, segments: int, reports: Sequence[dict[str, float]]) -> Row:
    """The line of a C++ method, from what its runs report."""
    last = reports[-1]
    return Row(
        segments=segments,
        method=limit.name,
        tolerance=float(limit.tolerance),
        iterations_median=math.nan,
        iterations_mean=last["iterations"] / STEPS,
        iterations_max=int(last["most"]),
        evaluations=last["evals"] / STEPS,
        ms_median=statistics.median(report["median"] for report in reports),
        ms_min=min(report["min"] for report in reports),
        paths=len(reports),
        compile_s=math.nan,
        converged=last["failures"] == 0,
        energy=last["energy"],
    )


def measured(segments: int, methods: Sequence[Method], program: Path | None, rounds: int, repeats: int) -> list[Row]:
    """All methods at one mesh; those with a C++ partner in rounds of ours, C++, ours, C++, ..."""
    rows = []
    for method in methods:
        ours, limit = OurRuns(method, segments), method.limit
        if program is None or limit is None:
            ours.round(repeats)
            rows.append(ours.row([]))
        else:
            cpp = CppRuns(program, "p2", limit.argument, limit.tolerance, segments)
            ratios = [ours.round(repeats) / cpp.round() for _ in range(rounds)]
            rows += [ours.row(ratios), cpp_row(limit, segments, cpp.reports)]
    return rows


HEADER = (
    f"{'':27} |{'iterations a step':^23}|{'evals':>8}{'ms a step':>11}{'':9}{'us an':>9}{'':6} |{'compile':>8}"
    f"{'con-':>7}  {'energy f':13}{'ratio':>6}\n"
    f"{'N':>4}  {'method':15}{'tol':>6} |{'median':>8}{'mean':>8}{'max':>7}|{'a step':>8}{'median':>11}{'min':>9}"
    f"{'eval':>9}{'runs':>6} |{'s':>8}{'verged':>7}  {'EI/L':13}{'to C++':>6}"
)


def line(row: Row) -> str:
    return (
        f"{row.segments:4}  {row.method:15}{row.tolerance:6.0e} |{number(row.iterations_median, '.0f', 8)}"
        f"{row.iterations_mean:8.1f}{row.iterations_max:7}|{row.evaluations:8.1f}{row.ms_median:11.4f}{row.ms_min:9.4f}"
        f"{1e3 * row.ms_median / row.evaluations:9.2f}{row.paths:6} |{number(row.compile_s, '.1f', 8)}"
        f"{'yes' if row.converged else 'NO':>7}  {row.energy:<13.9f}{number(row.ratio, '.1f', 6)}"
    )


def gains(rows: Sequence[Row]) -> list[str]:
    """What the preconditioner buys where both ran at the same tolerance."""
    tolerance = PRECONDITIONED.solver.tolerance
    found = {(row.segments, row.method): row for row in rows if row.tolerance == tolerance}
    words = []
    for (segments, name), slow in found.items():
        quick = found[segments, PRECONDITIONED.name]
        if name == PLAIN[0].name:
            iterations, seconds = slow.iterations_mean / quick.iterations_mean, slow.ms_median / quick.ms_median
            words.append(
                f"N = {segments}: the preconditioner takes {iterations:.0f} times fewer iterations "
                f"and {seconds:.0f} times less time (both to {tolerance:.0e})"
            )
    return words


def picture(rows: Sequence[Row]) -> Figure:
    """Time of a step against the number of segments."""
    figure = Figure(figsize=(8, 5.6), layout="constrained")
    axes = figure.subplots()
    colors = {(method.name, method.solver.tolerance): method.color for method in (*PLAIN, PRECONDITIONED)}
    colors |= {(limit.name, float(limit.tolerance)): limit.color for limit in (NCG, NEWTON)}
    for (name, tolerance), color in colors.items():
        curve = [row for row in rows if row.method == name and row.tolerance == tolerance]
        if not curve:
            continue
        segments, ms = [row.segments for row in curve], [row.ms_median for row in curve]
        label = f"{name}, to $10^{{{round(math.log10(tolerance))}}}$"
        style = "s--" if name.startswith("C++") else "o-"
        axes.loglog(segments, ms, style, color=color, label=label)
        below = (name, tolerance) == (PLAIN[0].name, 1e-4) or name in (PRECONDITIONED.name, NEWTON.name)
        for x, y in zip(segments, ms, strict=True):
            offset = (0, -15 if below else 8)
            axes.annotate(f"{y:.3g}", (x, y), offset, textcoords="offset points", ha="center", fontsize=8, color=color)
    ticks = sorted({row.segments for row in rows})
    axes.set_xticks(ticks, [str(n) for n in ticks], minor=False)
    axes.set_xticks([], minor=True)
    axes.margins(y=0.1)
    axes.set(xlabel="segments N", ylabel="time of one step of Fig. 1 [ms]")
    axes.set_title(f"Nonlinear conjugate gradients on Fig. 1 (25 steps)\n{machine()}, one thread, double precision")
    axes.grid(color="0.9")
    axes.legend()
    return figure


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--segments", type=int, nargs="+", default=[10, 20, 50, 100, 200])
    parser.add_argument("--plain-up-to", type=int, default=50, help="largest mesh for plain NCG, ours and C++")
    parser.add_argument("--rounds", type=int, default=3, help="turns of ours and C++ at each mesh")
    parser.add_argument("--repeats", type=int, default=7, help="runs of ours in a round")
    parser.add_argument("--limit", type=Path, help="the C++ program that stands in for the machine's limit")
    parser.add_argument("--out", type=Path, help="folder for nonlinear_cg.csv and nonlinear_cg.png")
    arguments = parser.parse_args(argv)
    set_up()
    print(f"Fig. 1, {STEPS} steps; {conditions()}")
    repeats = f"{arguments.repeats} runs in a round, or as many as fit in {ROUND_SECONDS:.0f} s, at least one"
    print(f"times: median over all runs, {repeats}; a C++ run repeats the path for 2 s")
    print("tolerance: largest component of the gradient [EI/L^2], ours and C++ alike")
    print("ratio: ours to C++, side by side: preconditioned NCG to Newton (1e-8), plain NCG to plain NCG (1e-4)")
    print(HEADER)
    rows = []
    for segments in arguments.segments:
        methods = (*PLAIN, PRECONDITIONED) if segments <= arguments.plain_up_to else (PRECONDITIONED,)
        found = measured(segments, methods, arguments.limit, arguments.rounds, arguments.repeats)
        print("\n".join(map(line, found)), flush=True)
        rows += found
    print("\n".join(gains(rows)))
    if arguments.out is not None:
        save_rows(rows, arguments.out / "nonlinear_cg.csv")
        picture(rows).savefig(arguments.out / "nonlinear_cg.png", dpi=110)
    return rows


if __name__ == "__main__":
    main()
