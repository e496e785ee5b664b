"""Fits anew from an estimate, many in one batch: without a cluster, with an unknown held, of measurements made up."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from rodjax.checks import leaf, number_list, whole_number
from rodjax.compilation import compiled
from rodjax.identification.lanes import in_lanes
from rodjax.identification.least_squares import Coordinates
from rodjax.identification.measurements import Experiment
from rodjax.identification.problem import Found, Problem, Rows, Structure, looked_at, search, values
from rodjax.identification.setup import Setup, beginnings, begun, name_of, prepared, stacked, structure_of
from rodjax.identification.statistics import Blocks
from rodjax.identification.unknowns import outside
from rodjax.result import Equilibrium

Equilibria = tuple[Equilibrium, ...]


class _Refit(eqx.Module):
    shared: Float[Array, "... p"]
    squares: Float[Array, "..."]
    converged: Bool[Array, "..."]


def _refit(structure: Structure, problem: Problem, start: Coordinates, guesses: Equilibria) -> _Refit:
    found = search(structure, problem, start, guesses)
    return _Refit(values(structure, problem, found.at)[0], found.squares, found.converged)


# --- without a cluster -----------------------------------------------------------------------------------------------


def leave_one_out(setup: Setup, structure: Structure, problem: Problem, found: Found) -> dict[str, dict[str, float]]:
    labels = np.array([setup.experiments[k].cluster or name_of(setup, k) for k in setup.order])
    clusters = sorted(set(labels.tolist()))
    if len(clusters) < 2:
        raise ValueError(f"experiments must be of at least two clusters to leave one out, got {len(clusters)}")
    given = np.concatenate([np.asarray(group.weights) for group in problem.groups])
    weights = leaf(np.stack([given * (labels != name) for name in clusters]))
    fits = _without(structure, problem, found.at, found.evaluation.results, weights)
    names = [unknown.label for unknown in setup.shared]
    estimates = np.where(np.asarray(fits.converged)[:, None], np.asarray(fits.shared), np.nan)[:, : len(names)]
    return {name: dict(zip(names, row, strict=True)) for name, row in zip(clusters, estimates.tolist(), strict=True)}


@functools.partial(compiled, static_argnames=("structure",))
def _without(
    structure: Structure, problem: Problem, at: Coordinates, guesses: Equilibria, weights: Float[Array, "c e"]
) -> _Refit:
    sizes = [group.weights.shape[0] for group in problem.groups]
    ends = np.cumsum(sizes)[:-1].tolist()

    def one(weights: Float[Array, "e"]) -> _Refit:
        parts = jnp.split(weights, ends)
        less = eqx.tree_at(lambda problem: [group.weights for group in problem.groups], problem, parts)
        return _refit(structure, less, at, guesses)

    return in_lanes(one, (weights,), weights.shape[1])


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
    held = eqx.tree_at(lambda problem: problem.is_free.shared, problem, leaf(is_free))
    starts = np.tile(np.asarray(found.at.shared), (len(x), 1))
    starts[:, k] = x
    fits = _held(structure, held, leaf(starts), found.at.own, found.evaluation.results)
    converged = np.asarray(fits.converged)
    deviance = (np.asarray(fits.squares) - float(found.squares)) / dispersion
    return Profile(
        unknown.label,
        unknown.unit,
        chosen,
        np.where(converged, deviance, np.nan),
        np.where(converged[:, None], np.asarray(fits.shared), np.nan)[:, : len(setup.shared)],
    )


@functools.partial(compiled, static_argnames=("structure",))
def _held(
    structure: Structure, problem: Problem, starts: Float[Array, "k p"], own: Float[Array, "e q"], guesses: Equilibria
) -> _Refit:
    return in_lanes(
        lambda shared: _refit(structure, problem, Coordinates(shared, own), guesses), (starts,), own.shape[0]
    )


# --- of measurements made up -----------------------------------------------------------------------------------------


def bootstrap(
    setup: Setup, structure: Structure, problem: Problem, found: Found, count: int, seed: int, dispersion: float
) -> dict[str, Float[np.ndarray, "count"]]:
    if setup.critical:
        raise ValueError("bootstrap is not made for critical values, which are not part of a compiled program")
    whole_number(count, "count", 1, 10**6)
    whole_number(seed, "seed", 0, 2**31)
    keys = jax.random.split(jax.random.key(seed), count)
    scatter = leaf(np.asarray(np.sqrt(dispersion), problem.scale.dtype))
    rows = found.evaluation.rows
    fits = _made_up(structure, problem, found.at, found.evaluation.results, rows, keys, scatter)
    estimates = np.where(np.asarray(fits.converged)[:, None], np.asarray(fits.shared), np.nan)
    return dict(zip([unknown.label for unknown in setup.shared], estimates.T, strict=False))


@functools.partial(compiled, static_argnames=("structure",))
def _made_up(
    structure: Structure,
    problem: Problem,
    at: Coordinates,
    guesses: Equilibria,
    found: tuple[Rows, ...],
    keys: PRNGKeyArray,
    scatter: Float[Array, ""],
) -> _Refit:
    """`found`: the deviations, whose opposite leads from what was measured to what is computed."""

    def one(key: PRNGKeyArray) -> _Refit:
        groups = []
        for group, rows in zip(problem.groups, found, strict=True):
            measured = []
            for measurement, x in zip(group.experiments.measured, rows, strict=True):
                key, own_key = jax.random.split(key)
                noise = scatter * jax.random.normal(own_key, x.shape, x.dtype)
                weights = measurement.weights[..., None]
                change = (problem.scale * noise - x) / jnp.where(weights > 0, weights, 1.0)
                measured.append(jax.vmap(lambda m, change: m.moved(change))(measurement, change))
            groups.append(eqx.tree_at(lambda group: group.experiments.measured, group, tuple(measured)))
        return _refit(structure, eqx.tree_at(lambda problem: problem.groups, problem, tuple(groups)), at, guesses)

    return in_lanes(one, (keys,), at.own.shape[0])


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
    settings = structure._replace(factors=())._asdict()
    of_candidates = structure_of(planned, **{k: v for k, v in settings.items() if k not in ("shared", "own")})
    told = looked_at(of_candidates, there, at, beginnings(of_candidates, there, at, guesses))
    normal = told.information
    is_free = np.asarray(there.is_free.own)
    own = np.asarray(normal.oo) + np.eye(is_free.shape[1])[None] * ~is_free[..., None]
    known = _on_shared(problem, found)[:p, :p]
    converged = np.asarray(told.evaluation.is_used)
    gains, errors = np.full(len(planned.order), np.nan), np.full((len(planned.order), len(setup.shared)), np.nan)
    for row, k in enumerate(planned.order):
        if not converged[row]:
            continue
        alone = Blocks(np.asarray(normal.each[row]), np.asarray(normal.so[row : row + 1]), own[row : row + 1])
        both = known + alone.on_shared
        gains[k] = 0.5 * (np.linalg.slogdet(both)[1] - np.linalg.slogdet(known)[1])
        errors[k] = np.sqrt(dispersion * np.diag(np.linalg.inv(both)))
    shared = np.asarray(values(structure, problem, found.at)[0])
    sizes = [float(x) for x in problem.shared.size[:p]]
    rates = [
        x * size if one.scale == "log" else size for one, x, size in zip(setup.shared, shared[:p], sizes, strict=True)
    ]
    order = [int(k) for k in np.argsort(-np.where(np.isnan(gains), -np.inf, gains))]
    labels = [unknown.label for unknown in setup.shared]
    return Ranking(order, gains, {label: errors[:, k] * rates[k] for k, label in enumerate(labels)})


def _on_shared(problem: Problem, found: Found) -> Float[np.ndarray, "p p"]:
    normal = found.information
    is_free = np.asarray(problem.is_free.own)
    fixed = np.eye(is_free.shape[1])[None] * ~is_free[..., None]
    return Blocks(np.asarray(normal.ss), np.asarray(normal.so), np.asarray(normal.oo) + fixed).on_shared
