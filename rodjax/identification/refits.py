"""Fits anew from an estimate, many in one batch: without a cluster, with an unknown held, of measurements made up."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import number_list, whole_number
from rodjax.identification.batch_slots import LANES
from rodjax.identification.least_squares import Coordinates
from rodjax.identification.measurements import Experiment, Measurement
from rodjax.identification.problem import Found, Problem, Structure, looked_at, search, values
from rodjax.identification.setup import Setup, beginnings, begun, clusters_of, prepared, stacked
from rodjax.identification.statistics import Blocks, rates
from rodjax.identification.unknowns import outside
from rodjax.programs.compilation import compiled
from rodjax.solving.harness_result import Solution

Equilibria = tuple[Solution, ...]


class _Refits(NamedTuple):
    """Of k fits: the unknowns in common, not numbers where the fit did not converge, and the sums of squares."""

    shared: Float[np.ndarray, "k p"]
    squares: Float[np.ndarray, "k"]


def _refits(
    structure: Structure, problems: Iterable[Problem], starts: Iterable[Coordinates], guesses: Equilibria
) -> _Refits:
    """Fits of problems of one structure, some side by side in one program, which is compiled once for all kinds."""
    shared, squares = [], []
    pairs = list(zip(problems, starts, strict=True))
    lanes = max(1, LANES // pairs[0][1].own.shape[0])
    for first in range(0, len(pairs), lanes):
        chosen = [pairs[min(k, len(pairs) - 1)] for k in range(first, first + lanes)]
        stack = jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *chosen)
        at, sums, converged = _side_by_side(structure, *stack, guesses)
        shared.append(np.where(np.asarray(converged)[:, None], np.asarray(at), np.nan))
        squares.append(np.asarray(sums))
    return _Refits(np.concatenate(shared)[: len(pairs)], np.concatenate(squares)[: len(pairs)])


@functools.partial(compiled, static_argnames=("structure",))
def _side_by_side(
    structure: Structure, problems: Problem, starts: Coordinates, guesses: Equilibria
) -> tuple[Float[Array, "k p"], Float[Array, "k"], Bool[Array, "k"]]:
    def one(problem: Problem, start: Coordinates) -> tuple[Float[Array, "p"], Float[Array, ""], Bool[Array, ""]]:
        found = search(structure, problem, start, guesses)
        return values(structure, problem, found.at)[0][: len(structure.shared)], found.squares, found.converged

    return jax.vmap(one)(problems, starts)


# --- without a cluster -----------------------------------------------------------------------------------------------


def leave_one_out(setup: Setup, structure: Structure, problem: Problem, found: Found) -> dict[str, dict[str, float]]:
    labels = clusters_of(setup)
    clusters = sorted(set(labels))
    if len(clusters) < 2:
        raise ValueError(f"experiments must be of at least two clusters to leave one out, got {len(clusters)}")

    def without(cluster: tuple[str, ...]) -> Problem:
        is_left = np.array([label != cluster for label in labels], problem.scale.dtype)
        weights = [
            np.asarray(group.weights) * is_left[here]
            for group, here in zip(problem.groups, problem.slices, strict=True)
        ]
        return eqx.tree_at(lambda problem: [group.weights for group in problem.groups], problem, weights)

    fits = _refits(structure, map(without, clusters), [found.at] * len(clusters), found.evaluation.results)
    names = [unknown.label for unknown in setup.shared]
    return {
        name[0]: dict(zip(names, row, strict=True)) for name, row in zip(clusters, fits.shared.tolist(), strict=True)
    }


# --- with an unknown held --------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Profile:
    """The profile likelihood of an unknown: `deviance` (k,), twice the fall of the log-likelihood, at `values` (k,).

    `others` (k, p): all unknowns in common there; NaN where the fit did not converge.
    """

    label: str
    unit: str
    values: Float[np.ndarray, "k"]
    deviance: Float[np.ndarray, "k"]
    others: Float[np.ndarray, "k p"]

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Where the deviance is below the quantile of the chi-square distribution; NaN where the values do not reach
        so far.
        """
        from scipy import stats

        limit = float(np.sqrt(stats.chi2.ppf(level, 1)))
        best = int(np.nanargmin(self.deviance))
        root = np.sqrt(np.maximum(self.deviance, 0.0))
        signed = np.where(np.arange(len(root)) < best, -root, root)
        if not np.all(np.isfinite(signed)) or np.any(np.diff(signed) <= 0):
            return np.nan, np.nan
        low, high = np.interp([-limit, limit], signed, self.values, left=np.nan, right=np.nan)
        return float(low), float(high)


def profile(
    setup: Setup, structure: Structure, problem: Problem, found: Found, k: int, at: Any, dispersion: float
) -> Profile:
    unknown = setup.shared[k]
    chosen = np.asarray(number_list(at, "at"), float)
    if unknown.scale == "log" and not np.all(chosen > 0):
        raise ValueError(f"at must be positive for {unknown.label}, got {float(np.min(chosen)):g}")
    size, low, high = (float(x[k]) for x in (problem.shared.size, problem.shared.low, problem.shared.high))
    z = (np.log(chosen) if unknown.scale == "log" else chosen) / size
    if not (np.all(z > low) and np.all(z < high)):
        raise ValueError(f"at must lie within the bounds of {unknown.label}, {unknown.bounds}")
    x = outside(z, np.full_like(z, low), np.full_like(z, high))
    is_free = np.asarray(problem.is_free.shared).copy()
    is_free[k] = False
    held = eqx.tree_at(lambda problem: problem.is_free.shared, problem, is_free)
    starts = [eqx.tree_at(lambda at: at.shared, found.at, np.array(found.at.shared)) for _ in x]
    for start, place in zip(starts, x, strict=True):
        start.shared[k] = place
    fits = _refits(structure, [held] * len(x), starts, found.evaluation.results)
    deviance = (fits.squares - float(found.squares)) / dispersion
    return Profile(
        unknown.label, unknown.unit, chosen, np.where(np.isnan(fits.shared[:, 0]), np.nan, deviance), fits.shared
    )


# --- of measurements made up -----------------------------------------------------------------------------------------


def bootstrap(
    setup: Setup, structure: Structure, problem: Problem, found: Found, count: int, seed: int, dispersion: float
) -> dict[str, Float[np.ndarray, "count"]]:
    if setup.critical:
        raise ValueError("bootstrap is not made for critical values, which are not part of a compiled program")
    whole_number(count, "count", 1, 10**6)
    whole_number(seed, "seed", 0, 2**31)
    draw = np.random.default_rng(seed)
    scatter = math.sqrt(dispersion) * float(problem.scale)

    def made_up(_: int) -> Problem:
        """With measurements that are the computed ones with noise."""
        groups = []
        for group, rows in zip(problem.groups, found.evaluation.rows, strict=True):
            measured = []
            for measurement, deviations in zip(group.experiments.measured, rows, strict=True):
                weights = np.asarray(measurement.weights)[..., None]
                noise = scatter * draw.standard_normal(deviations.shape)
                change = (noise - np.asarray(deviations)) / np.where(weights > 0, weights, 1.0)
                measured.append(jax.vmap(_moved)(measurement, jnp.asarray(change, problem.scale.dtype)))
            groups.append(eqx.tree_at(lambda group: group.experiments.measured, group, tuple(measured)))
        return eqx.tree_at(lambda problem: problem.groups, problem, tuple(groups))

    fits = _refits(structure, map(made_up, range(count)), [found.at] * count, found.evaluation.results)
    return dict(zip([unknown.label for unknown in setup.shared], fits.shared.T, strict=True))


def _moved(measurement: Measurement, change: Float[Array, "k d"]) -> Measurement:
    return measurement.moved(change)


# --- which to do next ------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Ranking:
    """Candidates by how much they would tell, best first: `order`, their numbers; and in the order of the candidates
    `gain`, the natural logarithm of the factor by which the volume of the confidence region shrinks, and
    `standard_errors` {label: array}, those of all data together.
    """

    order: list[int]
    gain: Float[np.ndarray, "c"]
    standard_errors: dict[str, Float[np.ndarray, "c"]]


def next_experiment(
    setup: Setup,
    structure: Structure,
    problem: Problem,
    found: Found,
    candidates: Sequence[Experiment],
    dispersion: float,
) -> Ranking:
    planned = prepared(candidates, (*setup.shared, *setup.own), needs_all=False)
    if planned.has_sd != setup.has_sd:
        raise ValueError("candidates must have an sd where the experiments of the fit have one, and only there")
    groups, guesses = stacked(planned)
    there, start = begun(planned, groups, float(problem.threshold))
    there = eqx.tree_at(lambda p: p.scale, there, problem.scale)
    p = len(setup.shared)
    at = Coordinates(found.at.shared[:p], start.own)
    of_candidates = structure._replace(factors=())
    told = looked_at(of_candidates, there, at, beginnings(of_candidates, there, at, guesses))
    each = np.asarray(told.information.each, float)
    blocks = Blocks.of(told.information, np.asarray(there.is_free.own))
    is_free = np.asarray(problem.is_free.own) & np.asarray(found.evaluation.is_used)[:, None]
    known = Blocks.of(found.information, is_free).of_shared(p).on_shared
    converged = np.asarray(told.evaluation.is_used)
    gains, errors = np.full(len(planned.order), np.nan), np.full((len(planned.order), len(setup.shared)), np.nan)
    for row, k in enumerate(planned.order):
        if not converged[row]:
            continue
        alone = Blocks(each[row], blocks.so[row : row + 1], blocks.oo[row : row + 1])
        both = known + alone.on_shared
        gains[k] = 0.5 * (np.linalg.slogdet(both)[1] - np.linalg.slogdet(known)[1])
        errors[k] = np.sqrt(dispersion * np.diag(np.linalg.inv(both)))
    shared = np.asarray(values(structure, problem, found.at)[0], float)[:p]
    errors = errors * rates(setup.shared, shared, setup.length)
    order = [int(k) for k in np.argsort(-np.where(np.isnan(gains), -np.inf, gains))]
    labels = [unknown.label for unknown in setup.shared]
    return Ranking(order, gains, {label: errors[:, k] for k, label in enumerate(labels)})
