"""What does a given accuracy cost? Run time against shape error, over mesh, discretization and solver.

P1, a cantilever under a tip force, and P3, a cable hanging between two clamps, by one cold solve; P2, Fig. 1 of Linn &
Stephan (2008), by its path of 25 steps, time a step. The error is the largest distance of a node from the continuum in
the last scene, over the length; the continuum is extrapolated from two fine meshes of finite differences. Beside
rodjax: with `--limit`, hand-written C++ (banded Newton, analytic derivatives), and the minimisers of scipy and
optimistix on the same compiled energy, what one would otherwise write.
"""

import argparse
import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import scipy.optimize
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from measuring import ROUND_SECONDS, CppRuns, Timed, compiled, conditions, machine, number, save_rows, set_up
from scipy.interpolate import CubicSpline

import rodjax
from rodjax import problems
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.first_twist import FirstTwist
from rodjax.model.scene import nondimensional
from rodjax.paths.path import stack_scenes
from rodjax.solving.first_state import first_state
from rodjax.solving.options import Discretization, Options

TOLERANCE = 1e-8  # largest component of the gradient [EI/L^2], of every method
# Above this mesh the C++ program, which keeps positions and not edges, cannot reach that, and gets a looser one.
CPP_FINEST, CPP_LOOSE = 500, "1e-5"
TARGETS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # errors of which the cost is printed


class Problem(NamedTuple):
    """Scenes of which each is solved from the last."""

    name: str
    title: str
    scenes: list[rodjax.Scene]
    guess: rodjax.Guess | None
    others_up_to: int  # finest mesh for the minimisers of scipy and optimistix

    @property
    def unit(self) -> str:
        return "solve" if len(self.scenes) == 1 else "step"


class Outcome(NamedTuple):
    """What a run reached; iterations a scene, residual the largest of all scenes."""

    nodes: Float[np.ndarray, "n+1 3"]  # of the last scene [m]
    iterations: float
    residual: float
    converged: bool


class Prepared(NamedTuple):
    """A compiled method on a mesh: what is timed, and what its result says."""

    run: Callable[[], Any]
    outcome: Callable[[Any], Outcome]
    compile_s: float


class Method(Protocol):
    name: str

    def serves(self, problem: Problem, segments: int) -> bool:
        """Whether the method is for this problem and mesh."""
        ...

    def prepared(self, problem: Problem, segments: int) -> Prepared: ...


class Row(NamedTuple):
    """A line of the table; time and iterations are of one solve, in a path of one step."""

    problem: str
    method: str
    segments: int
    error: float
    ms_median: float
    ms_min: float
    runs: int
    iterations: float
    residual: float
    converged: bool
    compile_s: float  # NaN for C++


class Rodjax:
    """A discretization and a solver of this library, on the problems and meshes it is meant for."""

    def __init__(
        self,
        name: str,
        discretization: Discretization,
        solver: Any,
        on: Sequence[str] = ("P1", "P2", "P3"),
        up_to: int = 1000,
    ):
        self.name, self.discretization, self.solver, self.on, self.up_to = name, discretization, solver, on, up_to

    def serves(self, problem: Problem, segments: int) -> bool:
        return problem.name in self.on and segments <= self.up_to

    def prepared(self, problem: Problem, segments: int) -> Prepared:
        options: dict[str, Any] = {
            "segments": segments,
            "discretization": self.discretization,
            "solver": self.solver,
        }
        if problem.unit == "solve":
            scenes, solve = problem.scenes[0], rodjax.solve
        else:
            scenes, solve = stack_scenes(problem.scenes), rodjax.solve_path
        arguments = (scenes, problem.guess)
        program, seconds = compiled(lambda scenes, guess: solve(scenes, guess=guess, **options), *arguments)
        return Prepared(lambda: program(*arguments), self.outcome, seconds)

    @staticmethod
    def outcome(result: rodjax.Equilibrium) -> Outcome:
        return Outcome(
            nodes=np.asarray(result.nodes).reshape(-1, *result.nodes.shape[-2:])[-1],
            iterations=float(np.mean(result.iterations)),
            residual=float(np.max(result.residual)),
            converged=bool(np.all(result.converged)),
        )


# --- what one would otherwise write: a library's minimiser on the same energy ----------------------------------------


def begun(scene: rodjax.Scene, polyline: Polyline, twist: Float[Array, ""]) -> tuple[FiniteDifference, Polyline]:
    """The discretized scene, and where to begin."""
    return FiniteDifference.begin(nondimensional(scene)[0], polyline, FirstTwist(twist))


def displaced(problem: FiniteDifference, polyline: Polyline, x: Float[Array, "3*m"]) -> Polyline:
    return problem.displaced(polyline, x.reshape(-1, 3))


def energy(problem: FiniteDifference, polyline: Polyline, x: Float[Array, "3*m"]) -> Float[Array, ""]:
    return problem.energies(displaced(problem, polyline, x)).total


energy_and_gradient = jax.value_and_grad(energy, argnums=2)


def hessian_times(problem: FiniteDifference, polyline: Polyline, x: Float[Array, "3*m"], vector: Float[Array, "3*m"]):
    return jax.jvp(lambda x: energy_and_gradient(problem, polyline, x)[1], (x,), (vector,))[1]


def reached(problem: FiniteDifference, polyline: Polyline, x: Float[Array, "3*m"]):
    """The new polyline, its total twist, and the largest component of the gradient."""
    end = displaced(problem, polyline, x)
    return end, problem.total_twist(end), jnp.max(jnp.abs(energy_and_gradient(problem, polyline, x)[1]))


class Minimizer:
    """A minimiser called scene by scene; a subclass compiles what it needs and finds the displacements of a scene."""

    def __init__(self, name: str):
        self.name = name

    def serves(self, problem: Problem, segments: int) -> bool:
        return segments <= problem.others_up_to

    def found(self, start: tuple[FiniteDifference, Polyline], x: Float[Array, "3*m"]) -> tuple[Callable, float]:
        """`minimized(problem, polyline, x) -> x, iterations`, and the seconds it took to compile."""
        raise NotImplementedError

    def prepared(self, problem: Problem, segments: int) -> Prepared:
        options = Options(segments, "finite_difference", rodjax.Newton(), planar=False)
        state, (twist, _) = first_state(problem.scenes[0], problem.guess, options)
        assert isinstance(state.shape, Polyline)
        first = state.shape
        begin, begin_s = compiled(begun, problem.scenes[0], first, twist)
        start = begin(problem.scenes[0], first, twist)
        zero = jnp.zeros(start[0].no_displacement(start[1]).size)
        finish, finish_s = compiled(reached, *start, zero)
        minimized, minimized_s = self.found(start, zero)

        def run() -> tuple[Polyline, list[int], list[Float[Array, ""]]]:
            polyline, total_twist, iterations, residuals = first, twist, [], []
            for scene in problem.scenes:
                here = begin(scene, polyline, total_twist)
                x, count = minimized(*here, zero)
                polyline, total_twist, residual = finish(*here, x)
                iterations.append(count)
                residuals.append(residual)
            return polyline, iterations, residuals

        def outcome(result) -> Outcome:
            polyline, iterations, residuals = result
            units, residual = state.units, float(max(residuals))
            nodes = np.asarray(units.origin[None] + units.length * polyline.nodes)
            return Outcome(nodes, float(np.mean(iterations)), residual, residual <= TOLERANCE)

        return Prepared(run, outcome, begin_s + finish_s + minimized_s)


class Scipy(Minimizer):
    """A method of `scipy.optimize.minimize`, given the gradient, and products with the Hessian where it wants them."""

    def __init__(self, method: str, options: dict[str, float], uses_hessian: bool = False):
        super().__init__(f"scipy {method}")
        self.method, self.options, self.uses_hessian = method, options, uses_hessian

    def found(self, start, x) -> tuple[Callable, float]:
        objective, seconds = compiled(energy_and_gradient, *start, x)
        product: Any = None
        if self.uses_hessian:
            product, more = compiled(hessian_times, *start, x, x)
            seconds += more

        def minimized(problem, polyline, x):
            def value_and_gradient(x):
                value, gradient = objective(problem, polyline, x)
                return float(value), np.asarray(gradient)

            result = scipy.optimize.minimize(
                value_and_gradient,
                np.asarray(x),
                jac=True,
                hessp=product and (lambda x, vector: np.asarray(product(problem, polyline, x, vector))),
                method=self.method,
                options=self.options,
            )
            return result.x, result.nit

        return minimized, seconds


class Optimistix(Minimizer):
    """A minimiser of optimistix, one compiled program a scene. It stops by the changes of x and of the energy."""

    def __init__(self, minimiser: Any, most: int):
        super().__init__(f"optimistix {type(minimiser).__name__}")
        self.minimiser, self.most = minimiser, most

    def found(self, start, x) -> tuple[Callable, float]:
        def minimized(problem, polyline, x):
            solution = optimistix.minimise(
                lambda x, _: energy(problem, polyline, x), self.minimiser, x, max_steps=self.most, throw=False
            )
            return solution.value, solution.stats["num_steps"]

        return compiled(minimized, *start, x)


NEWTON, HERMITE = "finite differences, Newton", "Hermite elements, Newton"
METHODS: list[Method] = [
    Rodjax(HERMITE, "hermite", rodjax.Newton(tolerance=TOLERANCE), up_to=200),
    Rodjax(NEWTON, "finite_difference", rodjax.Newton(tolerance=TOLERANCE)),
    Rodjax("finite differences, NCG", "finite_difference", rodjax.NonlinearCG(tolerance=TOLERANCE)),
    Rodjax(
        "finite differences, plain NCG",
        "finite_difference",
        rodjax.NonlinearCG(preconditioner=None, tolerance=TOLERANCE, max_iterations=1_000_000),
        on=("P2",),
        up_to=20,
    ),
    # Each until it can go no further: the changes of energy by which they judge a step drown in rounding.
    Scipy("L-BFGS-B", {"gtol": TOLERANCE, "ftol": 0.0, "maxiter": 100_000, "maxfun": 200_000}),
    Scipy("BFGS", {"gtol": TOLERANCE, "maxiter": 20_000}),
    Scipy("Newton-CG", {"xtol": 1e-14, "maxiter": 1000}, uses_hessian=True),
    Optimistix(optimistix.BFGS(rtol=1e-12, atol=1e-12), 20_000),
    Optimistix(optimistix.LBFGS(rtol=1e-12, atol=1e-12), 100_000),
]
CPP = "C++ Newton"
STYLES = {
    HERMITE: ("C5", "o-"),
    NEWTON: ("C0", "o-"),
    "finite differences, NCG": ("C1", "o-"),
    "finite differences, plain NCG": ("C3", "o-"),
    CPP: ("0.3", "s--"),
    "scipy L-BFGS-B": ("C2", "v:"),
    "scipy BFGS": ("C2", "^:"),
    "scipy Newton-CG": ("C2", "D:"),
    "optimistix BFGS": ("C4", "v:"),
    "optimistix LBFGS": ("C4", "^:"),
}


def benchmark(others: Sequence[int]) -> list[Problem]:
    """P1 to P3, with the finest mesh of the minimisers of scipy and optimistix on each."""
    return [
        Problem("P1", "P1: cantilever, cold solve", [problems.cantilever()], None, others[0]),
        Problem("P2", "P2: Fig. 1, a step of 25", problems.figure_1(), problems.figure_1_start(), others[1]),
        Problem("P3", "P3: hanging cable, cold solve", [problems.hanging_cable()], None, others[2]),
    ]


def continuum(problem: Problem, segments: int) -> CubicSpline:
    """The last shape in the continuum [m] by s/L: what meshes of `segments` and twice as many extrapolate to.

    Against shooting (`tests/continuum.py`), 2000 and 4000 segments are off by 1e-10 (P2) to 4e-10 L (P3).
    """
    exact = Rodjax("", "finite_difference", rodjax.NonlinearCG(tolerance=0.0))  # down to the rounding floor
    last = []
    for count in (segments, 2 * segments):
        fine = exact.prepared(problem, count)
        outcome = fine.outcome(fine.run())
        if not outcome.converged:
            raise RuntimeError(f"{problem.name} did not converge with {count} segments: {outcome.residual:.1e} EI/L^2")
        last.append(outcome.nodes)
    return CubicSpline(np.linspace(0, 1, segments + 1), (4 * last[1][::2] - last[0]) / 3)


def shape_error(problem: Problem, nodes: Float[np.ndarray, "n+1 3"], truth: CubicSpline) -> float:
    """Largest distance of a node from the continuum, over the length."""
    distances = np.linalg.norm(nodes - truth(np.linspace(0, 1, len(nodes))), axis=1)
    return float(np.max(distances) / problem.scenes[0].rod.length)


class Runs:
    """One method on one mesh."""

    def __init__(self, method: Method, problem: Problem, segments: int):
        self.method, self.problem, self.segments = method, problem, segments
        self.prepared = method.prepared(problem, segments)
        self.timed = Timed(self.prepared.run)

    def round(self, repeats: int) -> None:
        self.timed.round(repeats)

    def row(self, truth: CubicSpline) -> Row:
        outcome, steps = self.prepared.outcome(self.timed.result), len(self.problem.scenes)
        return Row(
            problem=self.problem.name,
            method=self.method.name,
            segments=self.segments,
            error=shape_error(self.problem, outcome.nodes, truth),
            ms_median=statistics.median(self.timed.times) / steps,
            ms_min=min(self.timed.times) / steps,
            runs=len(self.timed.times),
            iterations=outcome.iterations,
            residual=outcome.residual,
            converged=outcome.converged,
            compile_s=self.prepared.compile_s,
        )


class CppNewton:
    """The C++ program on one mesh; P1 in four load steps, of which this counts the sum."""

    def __init__(self, program: Path, problem: Problem, segments: int):
        self.problem, self.segments = problem, segments
        tolerance = f"{TOLERANCE:.0e}" if segments <= CPP_FINEST else CPP_LOOSE
        self.runs = CppRuns(program, problem.name.lower(), "newton", tolerance, segments)

    def round(self, repeats: int) -> None:  # it repeats as it sees fit
        self.runs.round()

    def row(self, truth: CubicSpline) -> Row:
        reports, nodes = self.runs.reports, self.runs.nodes
        return Row(
            problem=self.problem.name,
            method=CPP,
            segments=self.segments,
            error=shape_error(self.problem, nodes - nodes[0] + truth(0.0), truth),  # its P3 is centered
            ms_median=statistics.median(report["median"] for report in reports),
            ms_min=min(report["min"] for report in reports),
            runs=len(reports),
            iterations=reports[-1]["iterations"] / len(self.problem.scenes),
            residual=reports[-1]["residual"],
            converged=reports[-1]["failures"] == 0,
            compile_s=math.nan,
        )


def measured(
    problem: Problem, segments: int, truth: CubicSpline, program: Path | None, rounds: int, repeats: int
) -> list[Row]:
    """Every method on one mesh, in turns, since a shared machine is quicker in one minute than in the next."""
    runs: list[Runs | CppNewton] = [
        Runs(method, problem, segments) for method in METHODS if method.serves(problem, segments)
    ]
    if program is not None:
        runs.append(CppNewton(program, problem, segments))
    for _ in range(rounds):
        for run in runs:
            run.round(repeats)
    return [run.row(truth) for run in runs]


HEADER = (
    f"{'':2}  {'method':30}{'N':>5}{'error / L':>11}{'ms median':>11}{'min':>10}{'runs':>5}{'iterations':>12}"
    f"{'residual':>10}{'converged':>11}{'compile s':>11}"
)


def line(row: Row) -> str:
    return (
        f"{row.problem}  {row.method:30}{row.segments:5}{row.error:11.2e}{row.ms_median:11.4f}{row.ms_min:10.4f}"
        f"{row.runs:5}{row.iterations:12.1f}{row.residual:10.1e}{'yes' if row.converged else 'STOPPED':>11}"
        f"{number(row.compile_s, '.1f', 11)}"
    )


def costs(rows: Sequence[Row]) -> list[str]:
    """The least time [ms] of a method with no more than a given error, and its mesh: what an accuracy costs."""
    words = [f"{'':2}  {'least ms (N) with an error below':30}" + "".join(f"{target:>16.0e}" for target in TARGETS)]
    for problem, method in dict.fromkeys((row.problem, row.method) for row in rows):
        cells = []
        for target in TARGETS:
            good = [r for r in rows if (r.problem, r.method) == (problem, method) and r.error <= target]
            best = min(good, key=lambda row: row.ms_median, default=None)
            cells.append("-" if best is None else f"{best.ms_median:.3g} ({best.segments})")
        words.append(f"{problem}  {method:32}" + "".join(f"{cell:>16}" for cell in cells))
    return words


def picture(rows: Sequence[Row], benchmark: Sequence[Problem]) -> Figure:
    """Time against error; hollow where a run stopped above the tolerance."""
    figure = Figure(figsize=(14, 5.4), layout="constrained")
    panels = figure.subplots(1, len(benchmark), sharey=True, squeeze=False)[0]
    for axes, problem in zip(panels, benchmark, strict=True):
        for method, (color, style) in STYLES.items():
            curve = [row for row in rows if (row.problem, row.method) == (problem.name, method)]
            error, ms = [row.error for row in curve], [row.ms_median for row in curve]
            axes.loglog(error, ms, style[1:], color=color, lw=1.2)
            for kind, fill in ((True, color), (False, "white")):
                dots = [row for row in curve if row.converged is kind]
                axes.loglog(
                    [row.error for row in dots],
                    [row.ms_median for row in dots],
                    style[0],
                    color=color,
                    markerfacecolor=fill,
                    markersize=5,
                )
            for row in curve if method in (NEWTON, HERMITE) else ():
                offset = {"textcoords": "offset points", "xytext": (0, 7), "fontsize": 7, "color": color}
                axes.annotate(str(row.segments), (row.error, row.ms_median), ha="center", **offset)
        axes.invert_xaxis()
        axes.set(title=problem.title, xlabel="largest node error / L")
        axes.grid(color="0.92")
    panels[0].set_ylabel("time [ms]")
    present = {row.method for row in rows}
    for method, (color, style) in STYLES.items():
        if method in present:
            panels[0].plot([], [], style, color=color, label=method, markersize=5)
    figure.legend(loc="outside lower center", ncols=5, fontsize=8)
    figure.suptitle(
        f"Time against error; numbers: segments; hollow: stopped above the tolerance of {TOLERANCE:.0e} EI/L^2\n"
        f"{machine()}, one thread, double precision, without compiling",
        fontsize=10,
    )
    return figure


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, nargs="+", default=[8, 10, 16, 20, 32, 50, 100, 200, 500, 1000])
    parser.add_argument("--problems", nargs="+", choices=["P1", "P2", "P3"], default=["P1", "P2", "P3"])
    parser.add_argument(
        "--others-up-to",
        type=int,
        nargs=3,
        default=[50, 10, 50],
        metavar=("P1", "P2", "P3"),
        help="finest mesh for the minimisers of scipy and optimistix; 0: none",
    )
    parser.add_argument("--truth", type=int, default=2000, help="coarser mesh of the two that give the continuum")
    parser.add_argument("--rounds", type=int, default=3, help="turns of all methods at each mesh")
    parser.add_argument("--repeats", type=int, default=7, help="runs of a method in a round")
    parser.add_argument("--limit", type=Path, help="the C++ program that stands in for the machine's limit")
    parser.add_argument("--out", type=Path, help="folder for work_precision.csv and work_precision.png")
    arguments = parser.parse_args(argv)
    set_up()
    print(conditions())
    print(f"times: P1, P3 a cold solve, P2 a step of the path; {arguments.rounds} rounds of up to {arguments.repeats}")
    print(f"runs, as many as fit in {ROUND_SECONDS:.0f} s, at least one; a C++ run repeats for 2 s; compiling is apart")
    print(f"tolerance: {TOLERANCE:.0e} EI/L^2; C++ above N = {CPP_FINEST} {CPP_LOOSE}")
    chosen = [problem for problem in benchmark(arguments.others_up_to) if problem.name in arguments.problems]
    rows = []
    for problem in chosen:
        truth = continuum(problem, arguments.truth)
        print(HEADER)
        for segments in arguments.segments:
            found = measured(problem, segments, truth, arguments.limit, arguments.rounds, arguments.repeats)
            print("\n".join(map(line, found)), flush=True)
            rows += found
            if arguments.out is not None:
                save_rows(rows, arguments.out / "work_precision.csv")
    print("\n".join(costs(rows)))
    if arguments.out is not None:
        picture(rows, chosen).savefig(arguments.out / "work_precision.png", dpi=110)
    return rows


if __name__ == "__main__":
    main()
