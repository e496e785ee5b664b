"""route(): the best place of clips, ends and cable within limits, from many starts at once."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from tqdm import tqdm

from rodjax.batch import solve_first, solve_stack
from rodjax.checks import instance, positive, whole_number
from rodjax.equilibrium import Options, Solver, checked_options, solve
from rodjax.result import Equilibrium, NotConvergedWarning
from rodjax.routing.limits import Limits
from rodjax.routing.margins import Margins, checked, margins
from rodjax.routing.objective import Objective
from rodjax.routing.problem import (
    Evaluation,
    Problem,
    arranged,
    chosen,
    evaluated,
    nothing_evaluated,
    scenes_of,
    spare_lengths,
)
from rodjax.routing.rounds import Rounds
from rodjax.routing.search import Asked, Numbers, Outcome, Search, Settings
from rodjax.routing.variables import checked_variables, first_numbers, leaf_names, number_of
from rodjax.scene import Scene, slides
from rodjax.solvers.newton import Newton

SEGMENTS = 48
# Of each limit so much is kept in reserve, as a part of it, for the error of the mesh.
RESERVE = 1e-3
TOLERANCE = 1e-6
ITERATIONS = 100
# SLSQP begins as if second derivatives by the variables in 0 to 1 were so much, as a part of the objective.
FIRST_CURVATURE = 0.3
# A start is drawn so many times, of which the first counts whose clips leave the rod long enough between them; where
# it has no equilibrium it is drawn again, so often.
DRAWS = 64
REDRAWS = 3
# The best designs that are solved again on a finer mesh, until one keeps to the limits there.
VERIFIED = 5


class Starts(eqx.Module):
    """How the searches from k starts ended; the first begins at the nominal scene.

    - `designs` (k, n): where they ended, in SI units, as `Route.numbers`; `objective` (k,)
    - `violation` (k,): the largest, as a part of the limit and beside it; 0 where `feasible` (k,)
    - `violated`: what it is of, "" of feasible ones
    - `iterations`, `solves` (k,); `message`: of SLSQP, for each
    """

    designs: Float[np.ndarray, "k n"]
    objective: Float[np.ndarray, "k"]
    violation: Float[np.ndarray, "k"]
    feasible: Bool[np.ndarray, "k"]
    iterations: Int[np.ndarray, "k"]
    solves: Int[np.ndarray, "k"]
    violated: tuple[str, ...] = eqx.field(static=True)
    message: tuple[str, ...] = eqx.field(static=True)


class Route(eqx.Module):
    """The best of the routes found; `feasible`: it keeps to all limits, on the finer mesh too.

    - `scene`; `equilibrium`: on the mesh of the search; `verified`: on one twice as fine, and `margins` of that
    - `objective`: what was least
    - `names`, `units` (n): of the numbers that varied; `numbers` (n,): what they are in SI units; `values`: by the key
      of each variable, what the scene has
    - `gradients`: by the names of the margins, and "objective": the derivatives by `numbers`, (n,); of the margins at
      the worst place, on the mesh of the search
    - `starts`: how each start ended
    - `solves`: of the equilibrium, in all; each but the first of a start came with all derivatives: `with_gradients`;
      `failed`: those without an equilibrium; `redrawn`: starts that had none
    """

    feasible: bool = eqx.field(static=True)
    scene: Scene
    equilibrium: Equilibrium
    verified: Equilibrium
    margins: Margins
    objective: float
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    numbers: Float[np.ndarray, "n"]
    values: dict[str, np.ndarray]
    gradients: dict[str, Float[np.ndarray, "n"]]
    starts: Starts
    solves: int = eqx.field(static=True)
    with_gradients: int = eqx.field(static=True)
    failed: int = eqx.field(static=True)
    redrawn: int = eqx.field(static=True)

    def __str__(self) -> str:
        """What was found, in one paragraph."""
        count, kept = len(self.starts.feasible), int(np.sum(self.starts.feasible))
        worst = int(np.argmin(self.margins.margin))
        name, margin = self.margins.names[worst], float(self.margins.margin[worst])
        effort = f"{self.solves} solves, {self.with_gradients} of them with derivatives by {len(self.names)} numbers"
        effort += f"; {self.failed} found no equilibrium" if self.failed else ""
        if self.feasible:
            return (
                f"A route that keeps to all limits, with the objective {self.objective:.6g}: {kept} of {count} starts "
                f"came to one. The least margin is that of {name}, {100 * margin:.2g} %, on a mesh of "
                f"{self.verified.s.shape[-1] - 1} segments. It took {effort}."
            )
        gap = self.starts.violated[int(np.argmin(self.starts.violation))]
        return (
            f"No route was found that keeps to all limits: {kept} of {count} starts came to one on the mesh of the "
            f"search. The one that violates them least fails in {gap or name}; on the finer mesh {name} has the margin "
            f"{100 * margin:.2g} %. It took {effort}."
        )


def route(
    scene: Scene,
    variables: Any,
    *,
    limits: Limits | None = None,
    objective: Objective | None = None,
    obstacles: Any = (),
    names: Any = None,
    starts: int = 16,
    seed: int = 0,
    segments: int | None = None,
    solver: Solver | None = None,
    tolerance: Any = TOLERANCE,
    iterations: int = ITERATIONS,
    reserve: Any = RESERVE,
    progress: bool = False,
) -> Route:
    """The design of least cost that keeps to limits: where clips sit, how long the cable is, how its ends point.

    Each start is a search by scipy's SLSQP with exact derivatives; all starts are computed together. The first begins
    at the nominal scene, the others at random designs.

    **Arguments:**

    - `scene`: `Scene`, which gives all that does not vary.
    - `variables`: a list of `Between`, `OnLine`, `OnPatch`, `OnSurface` and `Turned`, of different numbers.
    - `limits`: `Limits`; `None` for none.
    - `objective`: `Objective`; `None`: the length where it varies, else the elastic energy.
    - `obstacles`, `names`: as for `rodjax.margins`.
    - `starts`: how many, and `seed` of the random ones.
    - `segments`: of the mesh, Hermite elements; `None` for 48.
    - `solver`: a `Newton`; `None` for `Newton()`.
    - `tolerance`: of SLSQP, on the objective as a part of that of the first start; `iterations`: most of each attempt.
    - `reserve`: of each limit so much more is asked, as a part of it, for the error of the mesh.
    - `progress`: show a progress bar of rounds of solves.

    Limits all along the rod are kept at its worst place in each of 8 equal parts of the mesh, a constraint for each
    part: no mean or softened maximum is taken, so that a constraint is off by nothing but the mesh. Its derivative is
    that of the worst place, and jumps where another place of the same part becomes worst.

    Where the length, positions or arclengths vary, the rod between two held places is kept at least as long as the
    straight way between them. A trial that would pull the rod taut there is stepped back from without a solve, as is
    one where clips would not follow one another; so is one without an equilibrium. A search that ends outside of the
    limits is led to the least violation, and goes on from there.

    The same arguments give the same route to the last bit. Where no start keeps to the limits, the result is that of
    the least violation, `feasible` is False, and `str` says what is missing. Raises `ValueError` or `TypeError` for
    arguments that make no sense, and `ValueError` where no start has an equilibrium.
    """
    problem, names = _problem(scene, variables, limits, objective, obstacles, names, segments, solver)
    count = whole_number(starts, "starts", 1, 100_000)
    rng = np.random.default_rng(whole_number(seed, "seed", 0, 2**63 - 1))
    reserve = float(positive(reserve, "reserve"))
    tolerance = float(positive(tolerance, "tolerance"))
    iterations = whole_number(iterations, "iterations", 1, 1_000_000)
    instance(progress, "progress", bool)

    fleet = _Fleet(problem, count, rng, progress)
    found = fleet.search(tolerance, iterations, reserve)
    return _best(problem, names, fleet, found)


def _problem(
    scene: Any, variables: Any, limits: Any, objective: Any, obstacles: Any, names: Any, segments: Any, solver: Any
) -> tuple[Problem, tuple[str, ...]]:
    instance(scene, "scene", Scene)
    variables = checked_variables(variables, scene)
    if limits is None and obstacles:
        raise ValueError("limits must have a clearance where there are obstacles, got None")
    obstacles, names = ((), ()) if limits is None else checked(scene, limits, obstacles, names)
    if objective is None:
        varies = "rod.length" in leaf_names(scene, variables)
        objective = Objective(length=1.0) if varies else Objective(energy=1.0)
    instance(objective, "objective", Objective)
    solver = Newton() if solver is None else solver
    instance(solver, "solver", Newton)
    segments = SEGMENTS if segments is None else segments
    checked_options(scene, segments, None, "hermite", solver, None, False)
    if limits is not None and limits.stability is not None and slides(scene):
        raise ValueError("limits.stability must be None for a scene with sliding clips")
    return Problem(scene, variables, limits, obstacles, objective, segments, solver), names


class _Fleet:
    """All searches: where they stand, the best of each, and what evaluates them."""

    def __init__(self, problem: Problem, count: int, rng: np.random.Generator, progress: bool):
        self._problem, self._progress = problem, progress
        self._options: Options = checked_options(
            problem.scene, problem.segments, None, "hermite", problem.solver, None, False
        )[0]
        self.solves = np.zeros(count, int)
        self.failed = self.redrawn = 0
        self._starts, self._guesses = self._begin(count, rng)
        designs = jnp.asarray(self._starts)
        self.last = nothing_evaluated(problem, designs, self._guesses)
        self.best = self.last
        self._reserve = 0.0
        # Of the best of each search: by how much its slacks lack the reserve, and its objective.
        self.lacking, self.objective = np.full(count, np.inf), np.full(count, np.inf)

    def _begin(self, count: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "k n"], Equilibrium]:
        """Designs that have equilibria, with these; where there is none after all that of another start stands in."""
        nominal = first_numbers(self._problem.scene, self._problem.variables)
        designs = np.concatenate([nominal[None], self._drawn(count - 1, rng)])
        results = self._solved_cold(designs)
        converged = np.asarray(results.converged)
        for _ in range(REDRAWS):
            if np.all(converged):
                break
            again = np.flatnonzero(~converged)
            self.redrawn += len(again)
            designs[again] = self._drawn(len(again), rng)
            new = self._solved_cold(designs)
            results = chosen(jnp.asarray(converged), results, new)
            converged = converged | np.asarray(new.converged)
            self.solves[again] += 1
        self.solves += 1
        if not np.any(converged):
            raise ValueError(
                f"variables must leave designs with an equilibrium: of {count} starts, each drawn {REDRAWS + 1} times, "
                "none has one"
            )
        stand_in = np.where(converged, np.arange(count), np.flatnonzero(converged)[0])
        return designs[stand_in], jax.tree.map(lambda leaf: leaf[jnp.asarray(stand_in)], results)

    def _drawn(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "k n"]:
        size = (count, DRAWS, sum(variable.count for variable in self._problem.variables))
        designs = rng.random(size)
        if not count:
            return designs[:, 0]
        spare = np.asarray(spare_lengths(self._problem, jnp.asarray(designs.reshape(-1, size[-1]))))
        spare = spare.reshape(size[:2])
        first = np.where(np.any(spare > 0, axis=1), np.argmax(spare > 0, axis=1), np.argmax(spare, axis=1))
        return designs[np.arange(count), first]

    def _spare(self, design: Float[np.ndarray, "n"]) -> float:
        return float(spare_lengths(self._problem, jnp.asarray(design)[None])[0])

    def _solved_cold(self, designs: Float[np.ndarray, "k n"]) -> Equilibrium:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotConvergedWarning)
            scenes = scenes_of(self._problem, jnp.asarray(designs))
            options: dict[str, Any] = dict(segments=self._problem.segments, solver=self._problem.solver)
            return solve_stack(scenes, **options, strain_limit=None)

    def search(self, tolerance: float, iterations: int, reserve: float) -> list[Outcome]:
        """How the searches ended."""
        count, self._reserve = len(self._starts), reserve
        first = self.evaluate({k: Asked(start, False) for k, start in enumerate(self._starts)})
        usable = [abs(numbers.objective) for numbers in first.values() if numbers.is_valid]
        scale = FIRST_CURVATURE * (usable[0] if usable and usable[0] > 0 else 1.0)
        settings = Settings(scale, reserve, tolerance / FIRST_CURVATURE, iterations)

        def search(k: int) -> Callable[[Callable[[Asked], Numbers]], Outcome]:
            return lambda ask: Search(self._starts[k], first[k], settings, ask, self._spare).run()

        with tqdm(disable=not self._progress, unit="round") as bar:

            def evaluate(asked: dict[int, Asked]) -> dict[int, Numbers]:
                bar.update()
                bar.set_postfix(running=len(asked))
                return self.evaluate(asked)

            return Rounds([search(k) for k in range(count)], evaluate).run()

    def evaluate(self, asked: dict[int, Asked]) -> dict[int, Numbers]:
        """One design of each search that asked."""
        count, order = len(asked), np.fromiter(asked, int)
        accepted = np.zeros(len(self._starts), bool)
        designs = self._starts.copy()
        for k, (design, is_accepted) in asked.items():
            accepted[k], designs[k] = is_accepted, design
        if np.any(accepted):
            self._guesses = chosen(jnp.asarray(accepted), self.last.result, self._guesses)
        order = jnp.asarray(np.pad(order, (0, len(designs) - count), mode="edge"))
        placed, scenes, guesses = arranged(self._problem, jnp.asarray(designs), self._guesses, order)
        results = solve_first(scenes, guesses, count, self._options)
        self.last = evaluated(self._problem, placed, results, self.last, order, jnp.asarray(count))
        objective, slacks, rates, is_valid = (
            np.asarray(x) for x in (self.last.objective, self.last.slacks, self.last.rates, self.last.is_valid)
        )
        self.solves[list(asked)] += 1
        self.failed += sum(not is_valid[k] for k in asked)
        self._keep_best(list(asked), objective, slacks, is_valid)
        m = slacks.shape[1]
        return {k: Numbers(float(objective[k]), slacks[k], rates[k, : m + 1], bool(is_valid[k])) for k in asked}

    def _keep_best(
        self,
        asked: list[int],
        objective: Float[np.ndarray, "k"],
        slacks: Float[np.ndarray, "k m"],
        is_valid: Bool[np.ndarray, "k"],
    ) -> None:
        # SLSQP keeps constraints to its tolerance only.
        lacking = np.maximum(0.9 * self._reserve - np.min(slacks, axis=1, initial=np.inf), 0.0)
        is_better = (lacking < self.lacking) | ((lacking == self.lacking) & (objective < self.objective))
        is_better &= is_valid & np.isin(np.arange(len(is_valid)), asked)
        self.lacking = np.where(is_better, lacking, self.lacking)
        self.objective = np.where(is_better, objective, self.objective)
        if np.any(is_better):
            self.best = chosen(jnp.asarray(is_better), self.last, self.best)


def _best(problem: Problem, names: tuple[str, ...], fleet: _Fleet, outcomes: list[Outcome]) -> Route:
    feasible = fleet.lacking == 0
    order = np.lexsort((fleet.objective, fleet.lacking))
    if not np.isfinite(fleet.lacking[order[0]]):
        raise ValueError("variables must leave designs whose equilibrium has derivatives: none of the starts has")
    best, verified, kept, is_kept = order[0], None, None, False
    for k in order[:VERIFIED]:
        if not feasible[k] and verified is not None:
            break
        here = jax.tree.map(lambda leaf, k=k: leaf[k], fleet.best.result)
        finer = solve(here.scene, segments=2 * problem.segments, guess=here, solver=problem.solver)
        found = _margins(finer, problem, names)
        is_kept = bool(feasible[k]) and bool(finer.converged) and bool(np.all(np.asarray(found.margin) >= 0))
        if is_kept or verified is None:
            best, verified, kept = k, finer, found
        if is_kept:
            break
    assert verified is not None
    assert kept is not None
    at = jax.tree.map(lambda leaf: leaf[best], fleet.best)
    variables = problem.variables
    scales = np.concatenate([variable.scales() for variable in variables])
    rates = np.asarray(at.rates) / scales[None]
    rows = {"objective": rates[0], **dict(zip(kept.names, rates[1 + at.slacks.shape[-1] :], strict=True))}
    offsets = _offsets(problem)
    return Route(
        feasible=is_kept,
        scene=at.result.scene,
        equilibrium=at.result,
        verified=verified,
        margins=kept,
        objective=float(at.objective),
        names=tuple(label for variable in variables for label in variable.labels()),
        units=tuple(unit for variable in variables for unit in variable.units()),
        numbers=offsets + scales * np.asarray(at.design),
        values={variable.key: np.asarray(number_of(at.result.scene, variable)) for variable in variables},
        gradients=rows,
        starts=_starts(fleet, outcomes, feasible, offsets, scales, kept.names),
        solves=int(np.sum(fleet.solves)),
        with_gradients=int(np.sum(fleet.solves)) - len(feasible) - fleet.redrawn,
        failed=fleet.failed,
        redrawn=fleet.redrawn,
    )


def _offsets(problem: Problem) -> Float[np.ndarray, "n"]:
    return np.concatenate([variable.offsets() for variable in problem.variables])


def _margins(equilibrium: Equilibrium, problem: Problem, names: tuple[str, ...]) -> Margins:
    if problem.limits is None:
        nothing = jnp.zeros(0, equilibrium.s.dtype)
        return Margins((), (), (), nothing, nothing, nothing, nothing)
    return margins(equilibrium, problem.limits, problem.obstacles, names)


def _starts(
    fleet: _Fleet,
    outcomes: list[Outcome],
    feasible: Bool[np.ndarray, "k"],
    offsets: Float[np.ndarray, "n"],
    scales: Float[np.ndarray, "n"],
    names: tuple[str, ...],
) -> Starts:
    best: Evaluation = fleet.best
    margin = [np.asarray(each.margin)[:, 0] for each in best.kept]
    spare = np.asarray(best.spare)
    count = spare.shape[-1]
    table = np.concatenate([spare, *(each[:, None] for each in margin)], axis=1)
    labels = (*(f"length of the rod in span {k}" for k in range(count)), *names)
    violation = np.maximum(-np.min(table, axis=1, initial=np.inf), 0.0)
    worst = np.argmin(table, axis=1) if labels else np.zeros(len(table), int)
    return Starts(
        designs=offsets[None] + scales[None] * np.asarray(best.design),
        objective=fleet.objective,
        violation=np.where(feasible, 0.0, np.where(np.isfinite(fleet.lacking), violation, np.inf)),
        feasible=feasible,
        iterations=np.array([outcome.iterations for outcome in outcomes]),
        solves=fleet.solves,
        violated=tuple(
            "" if feasible[k] or not labels else f"{labels[w]} by {100 * violation[k]:.2g} %"
            for k, w in enumerate(worst)
        ),
        message=tuple(outcome.message for outcome in outcomes),
    )
