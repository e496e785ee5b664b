"""Experiments and unknowns as one problem of least squares: arrays to be compiled, and what programs depend on."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.identification.batch_slots import in_lanes
from rodjax.identification.least_squares import Coordinates, NormalEquations, Residuals, least_squares
from rodjax.identification.loss import Loss, influence, robust
from rodjax.identification.measurements import Experiment
from rodjax.identification.unknowns import Scale, inside, nominal, with_values
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.programs.compilation import compiled
from rodjax.programs.parts import traced_once
from rodjax.solving.harness_derivatives import jacobian
from rodjax.solving.harness_result import Solution
from rodjax.solving.newton import Newton
from rodjax.solving.options import Discretization
from rodjax.solving.solve import solve

# Of harnesses. Their steps end less far below the tolerance than those of one rod: with 1e-8 EI/L^2 what is left undone
# hides the last step of a search, which then goes on to the smallest steps (22 evaluations in the place of 5).
OF_HARNESSES = Newton(tolerance=1e-11)


class Sought(NamedTuple):
    """What a program needs to know of an unknown."""

    names: tuple[str, ...]
    scale: Scale


class Structure(NamedTuple):
    """What the programs of a fit are compiled for, besides the shapes of arrays.

    `factors`: names of numbers of the scenes that are not sought, whose factors are further unknowns in common.
    """

    shared: tuple[Sought, ...]
    own: tuple[Sought, ...]
    loss: Loss
    segments: int
    discretization: Discretization
    planar: bool
    max_steps: int
    factors: tuple[str, ...] = ()


class Group(eqx.Module):
    """Experiments of one structure, stacked; `weights` (e,): 0 of those left out, else 1."""

    experiments: Experiment
    weights: Float[Array, "e"]


class Ranges(eqx.Module):
    """Of each unknown (n,): the change that counts as large, and by it the bounds and the prior.

    All on the scale on which it is sought; `information`: the inverse standard deviation of the prior, 0 for none.
    """

    size: Float[Array, "n"]
    low: Float[Array, "n"]
    high: Float[Array, "n"]
    prior: Float[Array, "n"]
    information: Float[Array, "n"]

    def within(self, x: Float[Array, "*e n"]) -> Float[Array, "*e n"]:
        """Between the bounds, by the sizes, from what the solver varies."""
        return inside(x, jnp.broadcast_to(self.low, x.shape), jnp.broadcast_to(self.high, x.shape))

    def coordinates(self, x: Float[Array, "*e n"]) -> Float[Array, "*e n"]:
        """On the scale on which they are sought."""
        return jnp.broadcast_to(self.size, x.shape) * self.within(x)

    def deviations(self, x: Float[Array, "*e n"]) -> Float[Array, "*e n"]:
        """From the prior, by its standard deviations."""
        return jnp.broadcast_to(self.information, x.shape) * (self.within(x) - jnp.broadcast_to(self.prior, x.shape))

    @property
    def unbounded(self) -> "Ranges":
        infinite = jnp.full_like(self.low, jnp.inf)
        return Ranges(self.size, -infinite, infinite, self.prior, self.information)


class Problem(eqx.Module):
    """All numbers of a fit.

    `scale`: of the deviations, 1 where standard deviations are given; `threshold`: of the loss, in standard deviations;
    `critical`: critical values.
    """

    groups: tuple[Group, ...]
    shared: Ranges
    own: Ranges
    is_free: Coordinates
    scale: Float[Array, ""]
    threshold: Float[Array, ""]
    critical: "Critical"

    @property
    def slices(self) -> list[slice]:
        """Of the experiments of each group among all."""
        ends = np.cumsum([0, *(group.weights.shape[0] for group in self.groups)]).tolist()
        return [slice(first, end) for first, end in itertools.pairwise(ends)]

    @property
    def unbounded(self) -> "Problem":
        """What is varied are then the unknowns by their sizes."""
        return eqx.tree_at(
            lambda problem: (problem.shared, problem.own), self, (self.shared.unbounded, self.own.unbounded)
        )


class Critical(eqx.Module):
    """Deviations of critical values by their standard deviations, linear about a point in coordinates.

    They are found by searches that cannot be part of a compiled program; what they depend on is linearised anew until
    the point stays where it is.
    """

    at: Float[Array, "p"]
    deviation: Float[Array, "k"]
    slope: Float[Array, "k p"]

    def __call__(self, coordinates: Float[Array, "p"]) -> Float[Array, "k"]:
        return self.deviation + self.slope @ (coordinates - self.at)


def in_units(sought: Sequence[Sought], coordinates: Float[Array, "*e n"]) -> Float[Array, "*e n"]:
    """The numbers themselves, from what they are on the scale on which they are sought."""
    logs = np.broadcast_to(np.array([one.scale == "log" for one in sought], bool), coordinates.shape)
    return jnp.where(logs, jnp.exp(jnp.where(logs, coordinates, 0.0)), coordinates)


def values(structure: Structure, problem: Problem, at: Coordinates) -> tuple[Float[Array, "p"], Float[Array, "e q"]]:
    """Of the unknowns, in their units; factors of what is held follow those in common."""
    factors = tuple(Sought((name,), "log") for name in structure.factors)
    shared = in_units((*structure.shared, *factors), problem.shared.coordinates(at.shared))
    return shared, in_units(structure.own, problem.own.coordinates(at.own))


def with_unknowns(
    structure: Structure, experiment: Experiment, shared: Float[Array, "p"], own: Float[Array, "q"]
) -> Experiment:
    """The experiment with these values of the unknowns."""
    sought = (*structure.shared, *structure.own)
    numbers = [*shared[: len(structure.shared)], *own]
    experiment = with_values(experiment, [one.names for one in sought], [one.scale for one in sought], numbers)
    if not structure.factors:
        return experiment
    names = [(name,) for name in structure.factors]
    held = [nominal(name, experiment) for name in names]
    factors = shared[len(structure.shared) :]
    numbers = [jnp.asarray(number) * factor for number, factor in zip(held, factors, strict=True)]
    return with_values(experiment, names, ["linear"] * len(names), numbers)


def solved(structure: Structure, scene: Scene | Harness, guess: Solution) -> Solution:
    options: Any = {"segments": structure.segments, "guess": guess}
    if isinstance(scene, Harness):
        return solve(scene, solver=OF_HARNESSES, **options)
    return solve(scene, discretization=structure.discretization, planar=structure.planar, **options)


Rows = list[Float[Array, "e k d"]]


class Evaluation(eqx.Module):
    """The experiments with some values of the unknowns.

    `rows`: deviations of each measurement of each group by their weights; `changes`: their derivatives by the unknowns
    in common and then by those of each experiment, by their sizes, along a leading axis p + q; `results`: the
    equilibria; `is_used` (e,): the experiments that count.
    """

    rows: tuple[Rows, ...]
    changes: tuple[Rows, ...]
    results: tuple[Solution, ...]
    is_used: Bool[Array, "e"]

    @property
    def converged(self) -> Bool[Array, "e"]:
        return jnp.concatenate([result.converged for result in self.results])


@functools.partial(traced_once, static="structure")
def evaluation(
    structure: Structure, problem: Problem, z: Coordinates, guesses: tuple[Solution, ...], is_used: Bool[Array, "e"]
) -> Evaluation:
    """At unknowns by their sizes, on the scale on which they are sought."""
    p = z.shared.shape[0]

    def one(experiment: Experiment, own: Float[Array, "q"], guess: Solution) -> Any:
        def placed(u: Float[Array, "n"]) -> Experiment:
            shared, own = values(structure, problem.unbounded, Coordinates(u[:p], u[p:]))
            return with_unknowns(structure, experiment, shared, own)

        def rows(u: Float[Array, "n"], _: Scene | Harness, result: Solution) -> tuple[list[Float[Array, "k d"]], Any]:
            deviations = [(each.weights, each.deviations(each.of_rod(result))) for each in placed(u).measured]
            return [weights[:, None] * rows for weights, rows in deviations], result

        def scene_at(u: Float[Array, "n"]) -> Scene | Harness:
            return placed(u).scene

        u = jnp.concatenate([z.shared, own])
        return jacobian(rows, scene_at, u, solved(structure, scene_at(u), guess))

    parts = [
        in_lanes(one, (group.experiments, z.own[here], guess))
        for group, here, guess in zip(problem.groups, problem.slices, guesses, strict=True)
    ]
    found, changes, results = zip(*parts, strict=True)
    changes = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), changes)
    return Evaluation(found, changes, results, is_used)


def _laid_out(problem: Problem, rows: tuple[Rows, ...], own: Float[Array, "e j"]) -> Float[Array, "e m"]:
    """The deviations of each experiment in one row, with `own` behind them."""
    parts = []
    for group, here in zip(rows, problem.slices, strict=True):
        count = here.stop - here.start
        parts.append(jnp.concatenate([*(x.reshape(count, -1) for x in group), own[here]], axis=1))
    width = max(part.shape[1] for part in parts)
    return jnp.concatenate([jnp.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in parts])


def _used(problem: Problem, rows: tuple[Rows, ...], is_used: Bool[Array, "e"]) -> tuple[Rows, ...]:
    """Rows by the scale, 0 of experiments that do not count."""
    return tuple(
        [jnp.where(is_used[here][:, None, None], x / problem.scale, 0.0) for x in group]
        for group, here in zip(rows, problem.slices, strict=True)
    )


def _normal_equations(
    problem: Problem,
    at: Coordinates,
    found: Evaluation,
    transform: Callable[[Float[Array, "k d"]], Float[Array, "k d"]],
) -> tuple[NormalEquations, Residuals]:
    """Of deviations so transformed and of priors and critical values, by the unknowns that a solver varies."""
    changes = found.changes

    def counted(rows: tuple[Rows, ...]) -> tuple[Rows, ...]:
        return jax.tree.map(jax.vmap(transform), _used(problem, rows, found.is_used))

    def beyond(at: Coordinates) -> tuple[Float[Array, "e q"], Float[Array, "k"]]:
        critical = problem.critical(problem.shared.coordinates(at.shared))
        return problem.own.deviations(at.own), jnp.concatenate([problem.shared.deviations(at.shared), critical])

    def within(at: Coordinates) -> Coordinates:
        return Coordinates(problem.shared.within(at.shared), problem.own.within(at.own))

    (p,), (e, q) = at.shared.shape, at.own.shape
    units = jnp.eye(p + q, dtype=at.shared.dtype)
    bases = Coordinates(units[:, :p], jnp.broadcast_to(units[:, None, p:], (p + q, e, q)))

    def column(base: Coordinates, change_of_rows: tuple[Rows, ...]) -> Residuals:
        base = jax.tree.map(lambda x, free: jnp.where(free, x, 0.0), base, problem.is_free)
        _, rates = jax.jvp(within, (at,), (base,))
        # Of unknowns in common the same rate for all, of the others that of each experiment.
        rate = jnp.sum(rates.shared) + jnp.sum(rates.own, axis=1)
        _, change = jax.jvp(counted, (found.rows,), (change_of_rows,))
        scaled = tuple(
            [x * rate[here][:, None, None] for x in group] for group, here in zip(change, problem.slices, strict=True)
        )
        _, (own, alone) = jax.jvp(beyond, (at,), (base,))
        return Residuals(_laid_out(problem, scaled, own), alone)

    own, alone = beyond(at)
    residuals = Residuals(_laid_out(problem, counted(found.rows), own), alone)
    return NormalEquations.of(jax.vmap(column)(bases, changes), residuals, p), residuals


class Found(eqx.Module):
    """Where a search ended, and what the data say there.

    `information`: the normal equations of the deviations themselves, whatever the loss, by the unknowns' sizes, with
    the gradient of how much they count; `counted`: sum of squares of how much they count; `slope`: mean of its
    derivative.
    """

    at: Coordinates
    evaluation: Evaluation
    squares: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    information: NormalEquations
    counted: Float[Array, ""]
    slope: Float[Array, ""]


def search(structure: Structure, problem: Problem, start: Coordinates, guesses: tuple[Solution, ...]) -> Found:
    """The least squares of a problem, from a start.

    Experiments without an equilibrium there do not count.
    """
    robustly = functools.partial(robust, loss=structure.loss, threshold=problem.threshold)
    weights = jnp.concatenate([group.weights for group in problem.groups]) > 0

    def evaluated(
        at: Coordinates, last: Evaluation, is_first: Bool[Array, ""]
    ) -> tuple[NormalEquations, Float[Array, ""], Evaluation]:
        z = Coordinates(problem.shared.within(at.shared), problem.own.within(at.own))
        found = evaluation(structure, problem, z, last.results, last.is_used)
        is_used = jnp.where(is_first, weights & found.converged, last.is_used)
        found = eqx.tree_at(lambda found: found.is_used, found, is_used)
        normal, residuals = _normal_equations(problem, at, found, robustly)
        squares = jnp.sum(residuals.own**2) + jnp.sum(residuals.shared**2)
        # A step to where there is no equilibrium is taken back.
        return normal, jnp.where(jnp.all(found.converged | ~is_used), squares, jnp.nan), found

    def first() -> Evaluation:
        z = Coordinates(problem.shared.within(start.shared), problem.own.within(start.own))
        return evaluation(structure, problem, z, guesses, weights)

    blank = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), jax.eval_shape(first))
    before = eqx.tree_at(lambda found: (found.results, found.is_used), blank, (guesses, weights))
    numbers = jnp.asarray(float(sum(x.size for group in blank.rows for x in group)), problem.scale.dtype)
    end = least_squares(evaluated, start, before, problem.is_free, numbers, structure.max_steps)
    found = end.beside
    told = _information(structure, problem, end.at, found)
    return Found(end.at, found, end.squares, end.converged & jnp.any(found.is_used), end.steps, *told)


search_compiled = functools.partial(compiled, static_argnames=("structure",))(search)


@functools.partial(compiled, static_argnames=("structure",))
def looked_at(structure: Structure, problem: Problem, at: Coordinates, guesses: tuple[Solution, ...]) -> Found:
    """What a search that takes no step finds."""
    weights = jnp.concatenate([group.weights for group in problem.groups]) > 0
    z = Coordinates(problem.shared.within(at.shared), problem.own.within(at.own))
    found = evaluation(structure, problem, z, guesses, weights)
    found = eqx.tree_at(lambda found: found.is_used, found, found.is_used & found.converged)
    told = _information(structure, problem, at, found)
    return Found(at, found, jnp.zeros_like(problem.scale), jnp.array(True), jnp.zeros((), int), *told)


def _information(
    structure: Structure, problem: Problem, at: Coordinates, found: Evaluation
) -> tuple[NormalEquations, Float[Array, ""], Float[Array, ""]]:
    z = Coordinates(problem.shared.within(at.shared), problem.own.within(at.own))
    # Statistics are on the scale of the unknowns, not on that which the bounds bend; and of what is held, too.
    is_factor = jnp.arange(at.shared.shape[0]) >= len(structure.shared)
    natural = eqx.tree_at(lambda problem: problem.is_free.shared, problem.unbounded, problem.is_free.shared | is_factor)
    normal, _ = _normal_equations(natural, z, found, lambda rows: rows)
    rows = _used(problem, found.rows, found.is_used)
    how_much = functools.partial(influence, loss=structure.loss, threshold=problem.threshold)
    pairs = [[jax.vmap(how_much)(x) for x in group] for group in rows]
    counts = tuple([count for count, _ in group] for group in pairs)
    squares = sum((jnp.sum(x**2) for group in counts for x in group), jnp.zeros_like(problem.scale))
    slopes, numbers = jnp.zeros_like(squares), jnp.zeros_like(squares)
    for of_group, group, here in zip(pairs, problem.groups, problem.slices, strict=True):
        for (_, slope), measured in zip(of_group, group.experiments.measured, strict=True):
            weight = (measured.weights > 0) & found.is_used[here][:, None]
            slopes += jnp.sum(jnp.where(weight, slope, 0.0))
            numbers += jnp.sum(weight).astype(numbers.dtype)
    if structure.loss != "linear":
        # The gradient of how much deviations count.
        plain = Evaluation(
            jax.tree.map(lambda x: x * problem.scale, counts), found.changes, found.results, found.is_used
        )
        weighted, _ = _normal_equations(natural, z, plain, lambda rows: rows)
        normal = eqx.tree_at(
            lambda normal: (normal.gradient, normal.scores), normal, (weighted.gradient, weighted.scores)
        )
    return normal, squares, slopes / numbers
