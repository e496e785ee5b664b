"""Experiments and unknowns as one problem of least squares: arrays to be compiled, and what programs depend on."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.compilation import compiled
from rodjax.equilibrium import Discretization, solve
from rodjax.identification.least_squares import Coordinates, LeastSquares, NormalEquations, Residuals, least_squares
from rodjax.identification.loss import Loss, influence, robust
from rodjax.identification.measurements import Experiment
from rodjax.identification.unknowns import Scale, inside, nominal, with_values
from rodjax.result import Equilibrium

# Of the unknowns, those of large size being 1, and of the residuals by the largest of them.
TOLERANCE = 1e-8


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


def solved_experiment(
    structure: Structure, experiment: Experiment, shared: Float[Array, "p"], own: Float[Array, "q"], guess: Any
) -> tuple[Experiment, Equilibrium]:
    """The experiment with these values of the unknowns, and its equilibrium."""
    sought = (*structure.shared, *structure.own)
    numbers = [*shared[: len(structure.shared)], *own]
    experiment = with_values(experiment, [one.names for one in sought], [one.scale for one in sought], numbers)
    if structure.factors:
        factors = shared[len(structure.shared) :]
        names = [(name,) for name in structure.factors]
        held = [nominal(name, experiment) for name in names]
        numbers = [jnp.asarray(number) * factor for number, factor in zip(held, factors, strict=True)]
        experiment = with_values(experiment, names, ["linear"] * len(names), numbers)
    result = solve(
        experiment.scene,
        segments=structure.segments,
        discretization=structure.discretization,
        planar=structure.planar,
        guess=guess,
    )
    return experiment, result


def rows(experiment: Experiment, result: Equilibrium) -> list[Float[Array, "k d"]]:
    """The deviations of each measurement by their standard deviations."""
    return [measurement.weights[:, None] * measurement.deviations(result) for measurement in experiment.measured]


Rows = list[Float[Array, "e k d"]]


def deviations(
    structure: Structure, problem: Problem, at: Coordinates, guesses: tuple[Equilibrium, ...]
) -> tuple[tuple[Rows, ...], tuple[Equilibrium, ...]]:
    """Of each measurement of each group by their scale, 0 of experiments that are left out; and the equilibria.

    Not a number where a solve did not converge, so that the step is not accepted.
    """
    shared, own = values(structure, problem, at)

    def one(experiment: Experiment, own: Float[Array, "q"], guess: Equilibrium):
        experiment, result = solved_experiment(structure, experiment, shared, own, guess)
        return rows(experiment, result), result

    found, results = [], []
    first = 0
    for group, guess in zip(problem.groups, guesses, strict=True):
        count = group.weights.shape[0]
        here, result = jax.vmap(one)(group.experiments, own[first : first + count], guess)
        is_used, is_found = (x[:, None, None] for x in (group.weights > 0, result.converged))
        found.append([jnp.where(is_used, jnp.where(is_found, x, jnp.nan) / problem.scale, 0.0) for x in here])
        results.append(result)
        first += count
    return tuple(found), tuple(results)


def laid_out(problem: Problem, at: Coordinates, found: tuple[Rows, ...]) -> Residuals:
    """Deviations as residuals: those of one experiment, with the prior of its own unknowns, in one row."""
    priors = problem.own.deviations(at.own)
    parts = []
    first = 0
    for group in found:
        count = group[0].shape[0]
        flat = [x.reshape(count, -1) for x in group]
        parts.append(jnp.concatenate([*flat, priors[first : first + count]], axis=1))
        first += count
    width = max(part.shape[1] for part in parts)
    own = jnp.concatenate([jnp.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in parts])
    critical = problem.critical(problem.shared.coordinates(at.shared))
    return Residuals(own, jnp.concatenate([problem.shared.deviations(at.shared), critical]))


def search(
    structure: Structure, problem: Problem, start: Coordinates, guesses: tuple[Equilibrium, ...]
) -> LeastSquares:
    """The least squares of a problem, from a start with its equilibria."""

    def counted(at: Coordinates, guesses: tuple[Equilibrium, ...]) -> tuple[Residuals, tuple[Equilibrium, ...]]:
        free = jax.tree.map(lambda x, x0, free: jnp.where(free, x, x0), at, start, problem.is_free)
        found, results = deviations(structure, problem, free, guesses)
        robustly = functools.partial(robust, loss=structure.loss, threshold=problem.threshold)
        return laid_out(problem, free, jax.tree.map(jax.vmap(robustly), found)), results

    return least_squares(counted, start, guesses, problem.is_free, TOLERANCE, structure.max_steps)


search_compiled = functools.partial(compiled, static_argnames=("structure",))(search)


class Information(eqx.Module):
    """What the data say about the unknowns where a search ended, by the sizes of the unknowns.

    `normal`: of the deviations themselves, whatever the loss, with the gradient of how much they count; `squares`: sum
    of the squares of how much they count; `slope`: mean of its derivative; `rows`: deviations of each measurement of
    each group by their scale.
    """

    normal: NormalEquations
    squares: Float[Array, ""]
    slope: Float[Array, ""]
    rows: tuple[Rows, ...]


@functools.partial(compiled, static_argnames=("structure",))
def information(
    structure: Structure, problem: Problem, at: Coordinates, guesses: tuple[Equilibrium, ...]
) -> Information:
    here = Coordinates(problem.shared.within(at.shared), problem.own.within(at.own))
    # Statistics are on the scale of the unknowns, not on that which the bounds bend.
    problem = eqx.tree_at(
        lambda problem: (problem.shared, problem.own), problem, (problem.shared.unbounded, problem.own.unbounded)
    )

    def plain(z: Coordinates) -> tuple[Residuals, tuple[Rows, ...]]:
        found, _ = deviations(structure, problem, z, guesses)
        return laid_out(problem, z, found), found

    _, jacobian, found = jax.linearize(plain, here, has_aux=True)

    def by_free(change: Coordinates) -> Residuals:
        return jacobian(jax.tree.map(lambda x, free: jnp.where(free, x, 0.0), change, problem.is_free))

    how_much = functools.partial(influence, loss=structure.loss, threshold=problem.threshold)
    pairs = [[jax.vmap(how_much)(x) for x in group] for group in found]
    counts = tuple([count for count, _ in group] for group in pairs)
    weights = [
        [(measurement.weights > 0) & (group.weights > 0)[:, None] for measurement in group.experiments.measured]
        for group in problem.groups
    ]
    slopes = [
        jnp.sum(jnp.where(weight, slope, 0.0))
        for of_group, weight_of_group in zip(pairs, weights, strict=True)
        for (_, slope), weight in zip(of_group, weight_of_group, strict=True)
    ]
    numbers = [jnp.sum(weight).astype(problem.scale.dtype) for of_group in weights for weight in of_group]
    return Information(
        normal=NormalEquations.of(by_free, laid_out(problem, here, counts), here),
        squares=sum((jnp.sum(x**2) for group in counts for x in group), jnp.zeros_like(problem.scale)),
        slope=sum(slopes[1:], slopes[0]) / sum(numbers[1:], numbers[0]),
        rows=found,
    )
