"""route(): the best place of clips, ends and cable within limits, from many starts at once."""

import itertools
import math
from concurrent.futures import Executor
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from rodjax.checks import instance, leaf, positive, whole_number
from rodjax.model.harness import Harness, check_without_friction, scenes_of
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene
from rodjax.paths.batch import solve_stack
from rodjax.programs.answers import one_answer
from rodjax.programs.tasks import Workers, checked_executor, checked_threads, in_order, rows_of
from rodjax.routing.group import GROUP, Found, Targets, searched
from rodjax.routing.limits import Limits
from rodjax.routing.margins import Margins, checked, margins, measured_margins
from rodjax.routing.objective import Objective
from rodjax.routing.optimality import Optimality, optimality
from rodjax.routing.problem import (
    Evaluation,
    Problem,
    chosen,
    group_starts,
    nothing_evaluated,
    scenes_at,
    span_names,
    spare_lengths,
)
from rodjax.routing.search import KEPT, REGION, Outcome
from rodjax.routing.variables import checked_variables, first_numbers, leaf_names, number_of
from rodjax.solving.harness_result import Solution, results_of, solved_in
from rodjax.solving.harness_rods import clamped_rods
from rodjax.solving.newton import Newton
from rodjax.solving.options import Solver, checked_options
from rodjax.solving.result_warnings import NotConvergedWarning
from rodjax.solving.solve import solve
from rodjax.warn import silenced

SEGMENTS = 48
SEGMENTS_OF_CABLES = 16
# Of each limit so much is kept in reserve, as a part of it, until the error of the mesh is known.
RESERVE = 1e-3
# The reserve is then that error, as a finer mesh has it, and this part of it for what that mesh lacks itself: elements
# are of fourth order, by which it is a fifteenth.
BEYOND = 0.1
TOLERANCE = 1e-6
ITERATIONS = 100
# A search begins as if second derivatives by the variables in 0 to 1 were so much, as a part of the objective.
FIRST_CURVATURE = 0.3
# A start is drawn so many times, of which the first counts whose clips leave the rod long enough between them; where
# it has no equilibrium it is drawn again, so often.
DRAWS = 64
REDRAWS = 3
# The best designs that are solved again on a finer mesh, and searched on with the reserve that it asks for, so often.
VERIFIED = 5
FINISHED = 3
# Slacks of the finer mesh above this are far from their limits.
MATTERS = 0.05
# Multipliers below this part of the objective are none.
NOTHING = 1e-6
T = TypeVar("T")


class Starts(eqx.Module):
    """How the searches from k starts ended; the first begins at the nominal scene.

    - `designs` (k, n): where they ended, in SI units, as `Route.numbers`; `objective` (k,)
    - `violation` (k,): the largest, as a part of the limit and beside it; 0 where `feasible` (k,)
    - `violated`: what it is of, "" of feasible ones
    - `gain` (k,): by how much the objective falls at most, to first order, where no variable moves by more than a
        thousandth of its range and all limits are kept; `optimal` (k,): whether that is below the tolerance
    - `iterations`, `solves` (k,); `message`: how each search ended
    """

    designs: Float[np.ndarray, "k n"]
    objective: Float[np.ndarray, "k"]
    violation: Float[np.ndarray, "k"]
    feasible: Bool[np.ndarray, "k"]
    gain: Float[np.ndarray, "k"]
    optimal: Bool[np.ndarray, "k"]
    iterations: Int[np.ndarray, "k"]
    solves: Int[np.ndarray, "k"]
    violated: tuple[str, ...] = eqx.field(static=True)
    message: tuple[str, ...] = eqx.field(static=True)


class Route(eqx.Module):
    """The best of the routes found; `feasible`: it keeps to all limits, on the finer mesh too.

    - `limits`, `obstacles`, `obstacle_names`: what was asked for
    - `scene`; `equilibrium`: on the mesh of the search; `verified`: on one twice as fine, and `margins` of that
    - `objective`: what was least; `optimal`: whether conditions of optimality to first order hold there: `gain`, by
        how much it falls at most, to first order, within a thousandth of the range of each variable and the limits, is
        below the tolerance
    - `multipliers`: of the active constraints by name, the decrease of the objective if the constraint is relaxed by
        the whole limit, or a bound of a variable by its whole range; spans of the rod that are kept from being pulled
        taut count too
    - `names`, `units` (n): of the numbers that varied; `numbers` (n,): what they are in SI units, between `lower` and
      `upper`; `values`: by the key of each variable, what the scene has
    - `gradients`: by the names of the margins, and "objective": the derivatives by `numbers`, (n,); of the margins at
      the worst place, on the mesh of the search
    - `starts`: how each start ended
    - `designs`: the scenes at which the search that led here stood, one after another along a leading axis; the last is
        `scene`. `rodjax.view(route)` shows them, `rodjax.solve_path(route.designs, segments=48)` solves them
    - `solves`: of the equilibrium, in all; each but the first of a start came with all derivatives: `with_gradients`;
      `failed`: those without an equilibrium; `redrawn`: starts that had none
    """

    feasible: bool = eqx.field(static=True)
    limits: Limits | None
    obstacles: tuple[Obstacle, ...]
    obstacle_names: tuple[str, ...] = eqx.field(static=True)
    scene: Scene | Harness
    equilibrium: Solution
    verified: Solution
    margins: Margins
    objective: float
    optimal: bool = eqx.field(static=True)
    gain: float
    multipliers: dict[str, float]
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    numbers: Float[np.ndarray, "n"]
    lower: Float[np.ndarray, "n"]
    upper: Float[np.ndarray, "n"]
    values: dict[str, np.ndarray]
    gradients: dict[str, Float[np.ndarray, "n"]]
    starts: Starts
    designs: Scene | Harness
    solves: int = eqx.field(static=True)
    with_gradients: int = eqx.field(static=True)
    failed: int = eqx.field(static=True)
    redrawn: int = eqx.field(static=True)

    def __str__(self) -> str:
        """What was found, in one paragraph."""
        count, kept = len(self.starts.feasible), int(np.sum(self.starts.feasible))
        worst = int(np.argmin(self.margins.margin))
        name, margin = self.margins.names[worst], float(self.margins.margin[worst])
        effort = f"{self.solves} solves, {self.with_gradients} of them with gradients in {len(self.names)} variables"
        effort += f"; {self.failed} found no equilibrium" if self.failed else ""
        if self.feasible:
            least = f" The least margin is that of {name}, {100 * margin:.2g} %," if self.margins.names else " Solved"
            return (
                f"A route that keeps to all limits, with the objective {self.objective:.6g}: {kept} of {count} starts "
                f"led to a feasible route. {self.optimality}{least} on a mesh of "
                f"{self.segments} segments. It took {effort}."
            )
        gap = self.starts.violated[int(np.argmin(self.starts.violation))]
        return (
            f"No route was found that keeps to all limits: {kept} of {count} starts led to one on the mesh of the "
            f"search. The one that violates them least fails in {gap or name}; on the finer mesh {name} has the margin "
            f"{100 * margin:.2g} %. It took {effort}."
        )

    @property
    def segments(self) -> int:
        """Of the mesh on which the route is verified, of each cable."""
        return max(rod.s.shape[-1] - 1 for rod in results_of(self.verified).values())

    @property
    def optimality(self) -> str:
        """Whether the objective is an optimum, and what holds it, in words."""
        gain = f"within a thousandth of the ranges the objective decreases by at most {max(self.gain, 0.0) + 0.0:.1g}"
        if not self.optimal:
            return f"It is NOT known to be an optimum, the search stalled: {gain}."
        held = sorted(self.multipliers.items(), key=lambda item: -item[1])
        told = ", ".join(f"{name} ({value / 100:.2g} for 1 %)" for name, value in held)
        return f"It is optimal to first order: {gain}; active limits: {told or 'none'}."


@one_answer
def route(
    scene: Scene | Harness,
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
    reserve: Any = None,
    executor: Executor | None = None,
    threads: int | None = None,
    progress: bool | None = None,
) -> Route:
    """The design of least cost within limits: positions of clips, length of the cable, directions of its ends.

    Each start is a search by sequential quadratic programming with exact derivatives; eight starts at a time are
    computed together. The first begins at the nominal scene, the others at random designs.

    **Arguments:**

    - `scene`: `Scene` or `Harness`, which gives all that does not vary. Of a harness the limits are of each cable, as
        for `rodjax.margins`, and the objective is the sum over the cables.
    - `variables`: a list of `Between`, `OnLine`, `OnPatch`, `OnSurface` and `Turned`, of different numbers.
    - `limits`: `Limits`; `None` for none.
    - `objective`: `Objective`; `None`: the length where it varies, else the elastic energy.
    - `obstacles`, `names`: as for `rodjax.margins`.
    - `starts`: how many, and `seed` of the random ones.
    - `segments`: of the mesh, Hermite elements; `None` for 48, of each cable of a harness 16.
    - `solver`: a `Newton`; `None` for `Newton()`.
    - `tolerance`: an objective is optimal where it falls by no more than this part of that of the first start within a
        thousandth of the ranges; `iterations`: most of each search.
    - `reserve`: of each limit so much more is asked, as a part of it, for the error of the mesh; `None`: a thousandth,
        and of the best five designs in the end as much as a mesh twice as fine differs.
    - `executor`: what searches from the starts, eight of them a task: anything with the interface of
        `concurrent.futures.Executor`, such as `client.get_executor()` of Dask; `None`: threads of this process.
    - `threads`: how many, `None`: the environment variable `RODJAX_THREADS`, or one for each core. Neither changes the
        result.
    - `progress`: whether a bar on stderr tells of it, by rounds of solves, of more than eight starts by groups of
        eight; `None`: in a terminal or notebook, after 2 s.

    Limits all along the rod are kept at every place that `rodjax.margins` looks at, each place a constraint: so all
    constraints are smooth, and no softened maximum is taken. The result is called optimal where the conditions of
    optimality hold to first order, with the multipliers told; else the search stalled, and it says so.

    Where the length, positions or arclengths vary, the rod between two held places is kept as long as the straight way
    between them, or as little shorter as it is where it is pulled by as much as the limits of force at ends and clips
    allow. A trial that would pull the rod more taut is stepped back from without a solve, as is one where clips would
    not follow one another, or one would come nearer to a jump of the rod or of a load than the mesh can tell; so is one
    without an equilibrium.

    The same arguments give the same route to the last bit, as executables (`rodjax.numpy_first`). Where no start keeps
    to the limits, the result is that of the least violation, `feasible` is False, and `str` says what is missing.
    Raises `ValueError` or `TypeError` for invalid arguments, and `ValueError` where no start has an equilibrium.
    """
    workers = Workers(checked_executor(executor), checked_threads(threads))
    problem, names = _problem(scene, variables, limits, objective, obstacles, names, segments, solver)
    count = whole_number(starts, "starts", 1, 100_000)
    rng = np.random.default_rng(whole_number(seed, "seed", 0, 2**63 - 1))
    given = None if reserve is None else float(positive(reserve, "reserve"))
    tolerance = float(positive(tolerance, "tolerance"))
    iterations = whole_number(iterations, "iterations", 1, 1_000_000)

    fleet = _Fleet(problem, count, rng, workers)
    fleet.search(tolerance, iterations, RESERVE if given is None else given)
    return _best(fleet, names, is_finished=given is None)


def _problem(
    scene: Any, variables: Any, limits: Any, objective: Any, obstacles: Any, names: Any, segments: Any, solver: Any
) -> tuple[Problem, tuple[str, ...]]:
    instance(scene, "scene", (Scene, Harness))
    check_without_friction(scene, "a route")
    if any(rod.rod.length.ndim for rod in scenes_of(scene).values()):
        raise ValueError("scene must be a single one, got a stack: route takes one after another")
    variables = checked_variables(variables, scene)
    if limits is None and obstacles:
        raise ValueError("limits must have a clearance where there are obstacles, got None")
    obstacles, names = ((), ()) if limits is None else checked(scene, limits, obstacles, names)
    if objective is None:
        varies = any(name.endswith("rod.length") for name in leaf_names(scene, variables))
        objective = Objective(length=1.0) if varies else Objective(energy=1.0)
    instance(objective, "objective", Objective)
    solver = Newton() if solver is None else solver
    instance(solver, "solver", Newton)
    if segments is None:
        segments = SEGMENTS if isinstance(scene, Scene) else SEGMENTS_OF_CABLES
    for rod in [scene] if isinstance(scene, Scene) else clamped_rods(scene):
        checked_options(rod, segments, None, "hermite", solver)
    return Problem(scene, variables, limits, obstacles, objective, segments, solver), names


class _Fleet:
    """All searches, in groups: where they start, and the best of each."""

    def __init__(self, problem: Problem, count: int, rng: np.random.Generator, workers: Workers):
        self.problem, self._workers = problem, workers
        self.solves = np.zeros(count, int)
        self.failed = self.redrawn = 0
        starts, guesses = self._begin(count, rng)
        self._starts, self._guesses = starts, jax.tree.map(np.asarray, guesses)
        self.best = jax.tree.map(np.asarray, nothing_evaluated(problem, jnp.asarray(starts), guesses))
        # Of each search, what is asked of the slacks; of its best, by how much they lack that, and its objective.
        self.reserves = np.zeros((count, self.best.slacks.shape[-1]))
        self.lacking, self.objective = np.full(count, np.inf), np.full(count, np.inf)
        self.outcomes = [Outcome(0, "")] * count
        self.groups = group_starts(problem, guesses)
        self.scale = self.tolerance = 1.0
        self._iterations = ITERATIONS

    def _begin(self, count: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "k n"], Solution]:
        """Designs that have equilibria, with these; where there is none after all that of another start stands in."""
        nominal = first_numbers(self.problem.scene, self.problem.variables)
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
        size = (count, DRAWS, sum(variable.count for variable in self.problem.variables))
        designs = rng.random(size)
        if not count:
            return designs[:, 0]
        spare = np.asarray(spare_lengths(self.problem, jnp.asarray(designs.reshape(-1, size[-1]))))
        spare = spare.reshape(size[:2])
        first = np.where(np.any(spare > 0, axis=1), np.argmax(spare > 0, axis=1), np.argmax(spare, axis=1))
        return designs[np.arange(count), first]

    def _solved_cold(self, designs: Float[np.ndarray, "k n"]) -> Solution:
        with silenced(NotConvergedWarning):
            scenes = scenes_at(self.problem, jnp.asarray(designs))
            options: dict[str, Any] = dict(segments=self.problem.segments, solver=self.problem.solver)
            return solve_stack(scenes, **options, strain_limit=None, threads=self._workers.threads)

    def search(self, tolerance: float, iterations: int, reserve: float) -> None:
        """All searches from their starts, with this reserve of each limit."""
        self.reserves[:, self.best.spare.shape[-1] :] = reserve
        first = abs(float(self.problem.objective.of(_row(self._guesses, 0))))
        self.scale = FIRST_CURVATURE * (first if math.isfinite(first) and first > 0 else 1.0)
        self.tolerance, self._iterations = tolerance / FIRST_CURVATURE, iterations
        self._search(np.arange(len(self._starts)), 1.0)

    def finish(self, reserves: dict[int, Float[np.ndarray, "m"]]) -> None:
        """These searches again, from the best they found, with another reserve."""
        which = np.array(list(reserves))
        for k in which:
            self.reserves[k] = reserves[k]
        self.lacking[which] = self.objective[which] = np.inf
        self._starts[which] = self.best.design[which]
        self._guesses = _with_rows(self._guesses, which, _rows(self.best.result, which))
        self._search(which, REGION)

    def _search(self, which: Int[np.ndarray, "w"], region: float) -> None:
        size, count = min(GROUP, len(self._starts)), len(which)
        targets = Targets(self.scale, self.tolerance, self._iterations, region)
        firsts = range(0, count, size)

        def part(first: int) -> tuple[Any, ...]:
            rows = which[rows_of(first, size, count)]
            starts, guesses, reserves = _rows((self._starts, self._guesses, self.reserves), rows)
            return self.problem, starts, guesses, reserves, min(size, count - first), targets

        parts = [part(first) for first in firsts]
        for first, found in zip(
            firsts, in_order(searched, parts, **self._workers._asdict(), unit="groups of starts"), strict=True
        ):
            self._put(which[first : first + size], found)

    def _put(self, which: Int[np.ndarray, "w"], found: Found) -> None:
        """What these searches have found; one that has found nothing keeps what it had."""
        number = np.flatnonzero(np.isfinite(found.lacking[: len(which)]))
        self.best = _with_rows(self.best, which[number], _rows(found.best, number))
        self.lacking[which], self.objective[which] = found.lacking[: len(which)], found.objective[: len(which)]
        self.solves[which] += found.solves[: len(which)]
        self.failed += found.failed
        for k, outcome in zip(which, found.outcomes, strict=True):
            before = self.outcomes[k]
            designs = before.designs + outcome.designs
            self.outcomes[k] = Outcome(before.iterations + outcome.iterations, outcome.message, designs)

    def stood(self, k: int) -> Any:
        """Where a search stood, one after another, and what is its best last: as stacked scenes."""
        best = self.best.design[k]
        designs = [design for design in self.outcomes[k].designs if not np.array_equal(design, best)]
        designs = np.stack([*designs, best])
        # So many at a time as there are starts, for which there is a program already.
        size, total = len(self._starts), len(designs)
        parts = [scenes_at(self.problem, jnp.asarray(designs[rows_of(j, size, total)])) for j in range(0, total, size)]
        return jax.tree.map(lambda *leaves: leaf(np.concatenate(leaves)[:total]), *parts)

    def optimality(self, k: int) -> Optimality:
        """Of the best design of a search, in units of the objective."""
        slacks, rates = self.best.slacks[k], self.best.rates[k]
        m = len(slacks)
        return optimality(rates[0], slacks - self.reserves[k], rates[1 : m + 1], self.best.design[k])

    def is_optimal(self, gain: float) -> bool:
        # As the searches, to rounding.
        return bool(gain <= self.scale * self.tolerance * (1 + 1e-6))


def _rows(stack: T, which: Int[np.ndarray, "w"]) -> T:
    return jax.tree.map(lambda leaf: leaf[which], stack)


def _row(stack: T, k: int) -> T:
    return jax.tree.map(lambda leaf: jax.device_put(leaf[k]), stack)


def _with_rows(stack: T, which: Int[np.ndarray, "w"], rows: T) -> T:
    def put(all: np.ndarray, new: np.ndarray) -> np.ndarray:
        all = all.copy()
        all[which] = new
        return all

    return jax.tree.map(put, stack, rows)


def _best(fleet: _Fleet, names: tuple[str, ...], *, is_finished: bool) -> Route:
    """The best of the searches that keeps to the limits on a finer mesh."""
    problem = fleet.problem
    order = np.lexsort((fleet.objective, fleet.lacking))
    if not np.isfinite(fleet.lacking[order[0]]):
        raise ValueError("variables must leave designs whose equilibrium has derivatives: none of the starts has")
    candidates = [int(k) for k in order[:VERIFIED] if fleet.lacking[k] == 0] or [int(order[0])]
    finer = {k: _finer(fleet, k) for k in candidates}
    for _ in range(FINISHED if is_finished and problem.limits is not None else 0):
        reserves = {k: _reserve(fleet, k, finer[k]) for k in candidates if _is_open(fleet, k, finer[k])}
        if not reserves:
            break
        fleet.finish(reserves)
        finer |= {k: _finer(fleet, k) for k in reserves}
    kept = {k: fleet.lacking[k] == 0 and _is_kept(finer[k]) for k in candidates}
    best = min(candidates, key=lambda k: (not kept[k], fleet.lacking[k], fleet.objective[k]))
    verified = finer[best][0]
    found = _margins(verified, problem, names)
    feasible = fleet.lacking == 0
    feasible[[k for k in candidates if not kept[k]]] = False
    at = _row(fleet.best, best)
    variables = problem.variables
    scales = np.concatenate([variable.scales() for variable in variables])
    rates = np.asarray(at.rates) / scales[None]
    rows = {"objective": rates[0], **dict(zip(found.names, rates[1 + at.slacks.shape[-1] :], strict=True))}
    offsets = _offsets(problem)
    labels = tuple(label for variable in variables for label in variable.labels())
    conditions = fleet.optimality(best)
    return Route(
        feasible=bool(kept[best]),
        limits=problem.limits,
        obstacles=problem.obstacles,
        obstacle_names=names,
        scene=solved_in(at.result),
        equilibrium=at.result,
        verified=verified,
        margins=found,
        objective=float(at.objective),
        optimal=bool(kept[best]) and fleet.is_optimal(conditions.gain),
        gain=float(conditions.gain),
        multipliers=_multipliers(fleet, at, conditions, found.names, labels),
        names=labels,
        units=tuple(unit for variable in variables for unit in variable.units()),
        numbers=offsets + scales * np.asarray(at.design),
        lower=np.minimum(offsets, offsets + scales),
        upper=np.maximum(offsets, offsets + scales),
        values={variable.key: np.asarray(number_of(solved_in(at.result), variable)) for variable in variables},
        gradients=rows,
        starts=_starts(fleet, feasible, offsets, scales, found.names),
        designs=fleet.stood(best),
        solves=int(np.sum(fleet.solves)),
        with_gradients=int(np.sum(fleet.solves)) - len(feasible) - fleet.redrawn,
        failed=fleet.failed,
        redrawn=fleet.redrawn,
    )


def _finer(fleet: _Fleet, k: int) -> tuple[Solution, Float[np.ndarray, "g"]]:
    """The best design of a search on a mesh twice as fine, and the least slack of each limit there."""
    problem = fleet.problem
    here = _row(fleet.best.result, k)
    with silenced(NotConvergedWarning):  # what did not converge is not kept
        finer: Any = solve(solved_in(here), segments=2 * problem.segments, guess=here, solver=problem.solver)
    if problem.limits is None:
        return finer, np.zeros(0)
    found = measured_margins(finer, problem.limits, problem.obstacles)
    return finer, np.array([float(each.slack[0]) for each in found])


def _is_kept(finer: tuple[Solution, Float[np.ndarray, "g"]]) -> bool:
    return bool(finer[0].converged) and float(np.min(finer[1], initial=0.0)) >= 0


def _errors(fleet: _Fleet, k: int, finer: tuple[Solution, Float[np.ndarray, "g"]]) -> Float[np.ndarray, "g"]:
    """By how much the slack of each limit is too large on the mesh of the search."""
    spans = fleet.best.spare.shape[-1]
    return np.minimum.reduceat(np.asarray(fleet.best.slacks[k]), np.array(fleet.groups))[spans:] - finer[1]


def _reserve(fleet: _Fleet, k: int, finer: tuple[Solution, Float[np.ndarray, "g"]]) -> Float[np.ndarray, "m"]:
    """For the error of the mesh, of what is limited within reach."""
    spans, m = fleet.best.spare.shape[-1], fleet.reserves.shape[1]
    error = _errors(fleet, k, finer)
    # Far from its limit a slack may be off by more than it matters.
    error = np.clip(error, -RESERVE, None) + BEYOND * np.abs(error) + 2 * KEPT
    is_near = finer[1] < MATTERS
    each = np.where(is_near, error, RESERVE)
    return np.concatenate([np.zeros(spans), np.repeat(each, np.diff([*fleet.groups[spans:], m]))])


def _is_open(fleet: _Fleet, k: int, finer: tuple[Solution, Float[np.ndarray, "g"]]) -> bool:
    """Whether a search has more in reserve than its mesh needs, or less."""
    if fleet.lacking[k] > 0 or not bool(finer[0].converged):
        return False
    wanted = _reserve(fleet, k, finer)
    return bool(np.max(np.abs(wanted - fleet.reserves[k]), initial=0.0) > 4 * KEPT) or not _is_kept(finer)


def _multipliers(
    fleet: _Fleet, at: Evaluation, conditions: Optimality, names: tuple[str, ...], labels: tuple[str, ...]
) -> dict[str, float]:
    """What holds the objective, by name, per whole limit; per range of the variables at their ends."""
    slacks, rates, spans = np.asarray(at.slacks), np.asarray(at.rates), at.spare.shape[-1]
    m, found, of_spans = len(slacks), {}, span_names(fleet.problem)
    bounds = [*fleet.groups, m]
    for g, (first, last) in enumerate(itertools.pairwise(bounds)):
        multiplier = float(np.sum(conditions.multipliers[first:last]))
        if g >= spans and multiplier > 0:
            # Slacks are in units of their own: by how much for a margin, their derivatives tell.
            worst, row = first + int(np.argmin(slacks[first:last])), rates[1 + m + g - spans]
            multiplier *= float(rates[1 + worst] @ row) / max(float(row @ row), np.finfo(float).tiny)
        found[names[g - spans] if g >= spans else of_spans[g]] = multiplier
    for values, end in ((conditions.lower, "lower"), (conditions.upper, "upper")):
        found |= {f"{label} at its {end} bound": float(value) for label, value in zip(labels, values, strict=True)}
    # What the program leaves of others is nothing.
    least = NOTHING * abs(float(at.objective))
    return {name: value for name, value in found.items() if value > least}


def _offsets(problem: Problem) -> Float[np.ndarray, "n"]:
    return np.concatenate([variable.offsets() for variable in problem.variables])


def _margins(equilibrium: Solution, problem: Problem, names: tuple[str, ...]) -> Margins:
    if problem.limits is None:
        nothing = jnp.zeros(0, equilibrium.energy.dtype)
        return Margins((), (), (), nothing, nothing, nothing, nothing)
    return margins(equilibrium, problem.limits, problem.obstacles, names)


def _starts(
    fleet: _Fleet,
    feasible: Bool[np.ndarray, "k"],
    offsets: Float[np.ndarray, "n"],
    scales: Float[np.ndarray, "n"],
    names: tuple[str, ...],
) -> Starts:
    best: Evaluation = fleet.best
    margin = [np.asarray(each.margin)[:, 0] for each in best.kept]
    table = np.concatenate([np.asarray(best.spare), *(each[:, None] for each in margin)], axis=1)
    labels = (*span_names(fleet.problem), *names)
    violation = np.maximum(-np.min(table, axis=1, initial=np.inf), 0.0)
    worst = np.argmin(table, axis=1) if labels else np.zeros(len(table), int)
    usable = np.isfinite(fleet.lacking)
    gain = np.array([fleet.optimality(k).gain if usable[k] else np.inf for k in range(len(feasible))])
    return Starts(
        designs=offsets[None] + scales[None] * np.asarray(best.design),
        objective=fleet.objective,
        violation=np.where(feasible, 0.0, np.where(np.isfinite(fleet.lacking), violation, np.inf)),
        feasible=feasible,
        gain=gain,
        optimal=feasible & np.array([fleet.is_optimal(one) for one in gain]),
        iterations=np.array([outcome.iterations for outcome in fleet.outcomes]),
        solves=fleet.solves,
        violated=tuple(
            ""
            if feasible[k] or not labels
            else f"{labels[w]} by {100 * violation[k]:.2g} %"
            if fleet.lacking[k] > 0
            else f"{labels[w]} on the finer mesh"
            for k, w in enumerate(worst)
        ),
        message=tuple(outcome.message for outcome in fleet.outcomes),
    )
