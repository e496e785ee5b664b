"""fit_each(): many experiments, each fitted by itself, a few of them at a time in one program."""

import dataclasses
import functools
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import stats

from rodjax.checks import leaf
from rodjax.identification.batch_slots import LANES
from rodjax.identification.least_squares import Coordinates
from rodjax.identification.loss import Loss
from rodjax.identification.measurements import Experiment
from rodjax.identification.problem import Group, Problem, Structure, search, values
from rodjax.identification.setup import (
    MAX_STEPS,
    Setup,
    beginnings,
    begun,
    checked_threshold,
    finer,
    largest_error,
    prepared,
    stacked,
    structure_of,
)
from rodjax.identification.statistics import LARGEST_DEVIATION, inverse, rates
from rodjax.identification.unknowns import Unknown
from rodjax.model.summaries import counted, range_text
from rodjax.programs.answers import one_answer
from rodjax.programs.compilation import compiled
from rodjax.programs.tasks import checked_executor, checked_threads, in_order, rows_of
from rodjax.solving.harness_result import Solution
from rodjax.solving.options import Discretization


@dataclasses.dataclass(frozen=True)
class Fits:
    """The fits of e experiments, each by itself. Arrays are in the order of the experiments.

    - `labels`, `units`: of the p unknowns
    - `estimates` (e, p); `standard_errors` (e, p), NaN of what was not free; `covariances` (e, p, p)
    - `sigma` (e,): scatter of the deviations, in the unit of the measurement or beside the given standard deviations;
      `degrees_of_freedom` (e,)
    - `rms` (e, m): root mean square length of the rows of deviations of each measurement, in its unit
    - `converged` (e,), `steps` (e,); `determined` (e,): whether the data determine all that was free
    - `equilibria`: with a leading axis; `error_estimate`: largest of theirs
    """

    labels: list[str]
    units: dict[str, str]
    estimates: Float[np.ndarray, "e p"]
    standard_errors: Float[np.ndarray, "e p"]
    covariances: Float[np.ndarray, "e p p"]
    sigma: Float[np.ndarray, "e"]
    degrees_of_freedom: Int[np.ndarray, "e"]
    rms: Float[np.ndarray, "e m"]
    converged: Bool[np.ndarray, "e"]
    steps: Int[np.ndarray, "e"]
    determined: Bool[np.ndarray, "e"]
    equilibria: Any
    error_estimate: float
    is_log: Bool[np.ndarray, "p"]

    def __str__(self) -> str:
        """How many converged, and of each unknown the range of its estimates and of their standard errors."""
        count, converged = len(self.converged), int(np.sum(self.converged))
        lines = [f"{counted(count, 'fit')}, {converged} converged in {range_text(self.steps)} steps"]
        for j, label in enumerate(self.labels):
            unit, found = self.units[label], np.isfinite(self.estimates[:, j]) & self.converged
            if np.any(found):
                error = self.standard_errors[found, j]
                known = f"standard error {range_text(error, unit)}" if np.all(np.isfinite(error)) else "not always free"
                lines.append(f"{label}: {range_text(self.estimates[found, j], unit)}, {known}")
        return "\n  ".join(lines)

    def intervals(self, level: float = 0.95) -> tuple[Float[np.ndarray, "e p"], Float[np.ndarray, "e p"]]:
        """The ends of the confidence intervals, by Student's distribution; symmetric on the scale of each unknown."""
        reach = stats.t.ppf((1 + level) / 2, self.degrees_of_freedom)[:, None] * self.standard_errors
        with np.errstate(all="ignore"):  # of those on a linear scale
            factor = np.exp(reach / self.estimates)
            low = np.where(self.is_log, self.estimates / factor, self.estimates - reach)
        return low, np.where(self.is_log, self.estimates * factor, self.estimates + reach)


@one_answer
def fit_each(
    experiments: Sequence[Experiment],
    unknowns: Sequence[Unknown | str],
    *,
    free: Any = None,
    loss: Loss = "linear",
    threshold: float | None = None,
    rtol: float | None = None,
    segments: int | None = None,
    discretization: Discretization | None = None,
    planar: bool = False,
    max_steps: int = MAX_STEPS,
    executor: Executor | None = None,
    threads: int | None = None,
    progress: bool | None = None,
) -> Fits:
    """The unknowns of each experiment from its own measurements alone, sixteen at a time in one compiled program.

    **Arguments:** as for `rodjax.fit`, save that

    - `experiments` must be alike: the same supports, loads and kinds of measurements; points may differ in number.
    - every unknown is one of each experiment, whatever its `per`.
    - `free`: (e, p) of bool, which unknowns are free in which experiment; the others stay as they are at the start.
        `None`: all. The same experiment with several choices compares models.
    - a `loss` other than `"linear"`, and priors, need standard deviations.
    - `executor`: what computes the fits, anything with the interface of `concurrent.futures.Executor`, such as
        `client.get_executor()` of Dask; `None`: threads of this process.
    - `threads`: how many, `None`: the environment variable `RODJAX_THREADS`, or one for each core. Neither changes the
        result.
    - `progress`: whether a bar on stderr tells of it; `None`: in a terminal or notebook, after 2 s.

    Returns `Fits`; an experiment that does not converge is marked and does not affect others. Raises `ValueError` or
    `TypeError` for invalid arguments.
    """
    executor, threads = checked_executor(executor), checked_threads(threads)
    threshold = checked_threshold(loss, threshold)
    setup = prepared(experiments, unknowns)
    labels = [one if isinstance(one, str) else one.label for one in unknowns]
    both = sorted((*setup.shared, *setup.own), key=lambda unknown: labels.index(unknown.label))
    setup = setup._replace(shared=tuple(both), own=())
    if setup.critical:
        raise ValueError("experiments must be of Experiment for fit_each; rodjax.fit takes CriticalValue too")
    groups, guesses = stacked(setup)
    if len(groups) > 1:
        raise ValueError(
            f"experiments must be alike in supports, loads and kinds of measurements, got {len(groups)} kinds of them"
        )
    if not setup.has_sd and (loss != "linear" or any(unknown.prior for unknown in setup.shared)):
        raise ValueError("sd must be given for a loss other than 'linear', and for priors")
    count, p = len(setup.order), len(setup.shared)
    is_free = np.ones((count, p), bool) if free is None else np.asarray(free)
    if is_free.shape != (count, p) or is_free.dtype != bool:
        raise ValueError(f"free must be of bool of shape {(count, p)}, got {is_free.dtype} of shape {is_free.shape}")
    is_free = is_free[np.array(setup.order)]
    structure, tolerance = structure_of(setup, loss, rtol, segments, discretization, planar, max_steps)
    problem, starts = _begun(setup, groups, threshold)
    first = Coordinates(jnp.zeros(0, starts.dtype), starts)
    as_own = structure._replace(shared=(), own=structure.shared)
    at_start = eqx.tree_at(lambda p: (p.shared, p.own), problem, (problem.own, problem.shared))
    shapes = beginnings(as_own, at_start, first, guesses)[0]
    while True:
        found = _in_parts(structure, problem, starts, is_free, shapes, executor, threads)
        error = largest_error((found.equilibria,), tolerance)
        better = finer(structure, error, tolerance)
        if better is None:
            break
        structure, starts = better, found.at
        as_own = as_own._replace(segments=better.segments)
        shapes = beginnings(as_own, at_start, first._replace(own=starts), (found.equilibria,))[0]
    return _fits(setup, structure, problem, found, is_free, error)


def _begun(setup: Setup, groups: tuple[Group, ...], threshold: float) -> tuple[Problem, Float[Array, "e p"]]:
    """The problem of all, and where each experiment starts."""
    as_own = setup._replace(own=setup.shared, shared=())
    problem, start = begun(as_own, groups, threshold)
    none = jax.tree.map(lambda x: x[:0], problem.shared)
    p = len(setup.shared)
    problem = eqx.tree_at(
        lambda problem: (problem.shared, problem.own, problem.critical.at, problem.critical.slope),
        problem,
        (problem.own, none, leaf(np.zeros(p, problem.scale.dtype)), leaf(np.zeros((0, p), problem.scale.dtype))),
    )
    return problem, start.own


class _Found(eqx.Module):
    at: Float[Array, "e p"]
    values: Float[Array, "e p"]
    information: Float[Array, "e p p"]
    squares: Float[Array, "e"]
    slope: Float[Array, "e"]
    rms: Float[Array, "e m"]
    converged: Bool[Array, "e"]
    steps: Int[Array, "e"]
    equilibria: Any


def _in_parts(
    structure: Structure,
    problem: Problem,
    starts: Float[Array, "e p"],
    is_free: Bool[np.ndarray, "e p"],
    shapes: Solution,
    executor: Executor | None,
    threads: int,
) -> _Found:
    """All fits, a part of the experiments at a time."""
    count = len(is_free)
    size = min(LANES, count)
    each = jax.tree.map(np.asarray, (problem.groups[0], starts, is_free, shapes))

    def part(first: int) -> tuple[Any, ...]:
        group, *others = jax.tree.map(lambda leaf: leaf[rows_of(first, size, count)], each)
        here = eqx.tree_at(lambda problem: (problem.groups, problem.is_free), problem, ((group,), None))
        return structure, here, *others

    parts = [part(first) for first in range(0, count, size)]
    found = in_order(_part_fitted, parts, executor=executor, threads=threads, unit="parts of the experiments")
    return jax.tree.map(lambda *leaves: leaf(np.concatenate(leaves)[:count]), *found)


def _part_fitted(*part: Any) -> _Found:
    return jax.tree.map(np.asarray, _each(*part))


@functools.partial(compiled, static_argnames=("structure",))
def _each(
    structure: Structure,
    problem: Problem,
    starts: Float[Array, "e p"],
    is_free: Bool[Array, "e p"],
    shapes: Solution,
) -> _Found:
    def one(experiment: Experiment, start: Float[Array, "p"], is_free: Bool[Array, "p"], shape: Solution) -> _Found:
        alone = Group(jax.tree.map(lambda x: x[None], experiment), jnp.ones(1, starts.dtype))
        here = eqx.tree_at(
            lambda problem: (problem.groups, problem.is_free),
            problem,
            ((alone,), Coordinates(is_free, jnp.zeros((1, 0), bool))),
            is_leaf=lambda x: x is None,
        )
        at = Coordinates(start, jnp.zeros((1, 0), starts.dtype))
        found = search(structure, here, at, (jax.tree.map(lambda x: x[None], shape),))
        weights = [measured.weights for measured in experiment.measured]
        lengths = [
            jnp.sum(_by_weight(x[0], weight) ** 2) / jnp.sum(weight > 0).astype(weight.dtype)
            for x, weight in zip(found.evaluation.rows[0], weights, strict=True)
        ]
        return _Found(
            at=found.at.shared,
            values=values(structure, here, found.at)[0],
            information=found.information.ss,
            squares=found.counted,
            slope=found.slope,
            rms=jnp.sqrt(jnp.stack(lengths)),
            converged=found.converged,
            steps=found.steps,
            equilibria=jax.tree.map(lambda x: x[0], found.evaluation.results[0]),
        )

    return jax.vmap(one)(problem.groups[0].experiments, starts, is_free, shapes)


def _by_weight(rows: Float[Array, "k d"], weights: Float[Array, "k"]) -> Float[Array, "k d"]:
    return rows / jnp.where(weights > 0, weights, 1.0)[:, None]


def _fits(
    setup: Setup, structure: Structure, problem: Problem, found: _Found, is_free: Bool[np.ndarray, "e p"], error: float
) -> Fits:
    order = np.argsort(np.array(setup.order))
    matrix = np.asarray(found.information, float) + np.eye(is_free.shape[1])[None] * ~is_free[..., None]
    numbers = np.array([sum(m.numbers * len(m.weights) for m in setup.experiments[k].measured) for k in setup.order])
    priors = np.array([unknown.prior is not None for unknown in setup.shared])
    freedom = numbers + np.sum(is_free & priors[None], axis=1) - np.sum(is_free, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        estimated = np.asarray(found.squares) / freedom / np.asarray(found.slope) ** 2
    dispersion = np.where(freedom > 0, estimated, 1.0 if setup.has_sd else np.nan)
    finite = np.all(np.isfinite(matrix), axis=(1, 2))[:, None, None]
    covariance = np.where(finite, inverse(np.where(finite, matrix, np.eye(matrix.shape[1]))), np.nan)
    covariance = covariance * dispersion[:, None, None]
    deviations = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    is_log = np.array([unknown.scale == "log" for unknown in setup.shared])
    estimates = np.asarray(found.values, float)
    by_size = rates(setup.shared, estimates, setup.length)
    covariance = covariance * by_size[:, :, None] * by_size[:, None, :]
    errors = np.where(is_free, deviations * by_size, np.nan)
    determined = np.all((deviations < LARGEST_DEVIATION) | ~is_free, axis=1)
    return Fits(
        labels=[unknown.label for unknown in setup.shared],
        units={unknown.label: unknown.unit for unknown in setup.shared},
        estimates=estimates[order],
        standard_errors=errors[order],
        covariances=covariance[order],
        sigma=(np.sqrt(dispersion) * float(problem.scale))[order],
        degrees_of_freedom=freedom[order],
        rms=np.asarray(found.rms)[order],
        converged=np.asarray(found.converged)[order],
        steps=np.asarray(found.steps)[order],
        determined=determined[order],
        equilibria=jax.tree.map(lambda x: x[order], found.equilibria),
        error_estimate=error,
        is_log=is_log,
    )
