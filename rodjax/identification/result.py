"""Fit: what fit() returns."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from rodjax.checks import leaf, number_array
from rodjax.identification import refits
from rodjax.identification.least_squares import Coordinates
from rodjax.identification.measurements import Experiment
from rodjax.identification.problem import Found, Problem, Structure, values
from rodjax.identification.setup import Setup, clusters_of
from rodjax.identification.statistics import Blocks, Combination, clustered, held_numbers, rates, undetermined
from rodjax.identification.unknowns import Unknown
from rodjax.solving.status import Status

# Deviations so many times as large as the standard deviations are not of the measuring.
FAR = 30.0


class NotIdentifiableError(ValueError):
    """The data do not determine a combination of the unknowns. `fit`: what came out nevertheless."""

    def __init__(self, fit: "Fit"):
        words = "; ".join(combination.words for combination in fit.undetermined)
        super().__init__(
            f"unknowns cannot be told from these measurements: {words} leaves all of them as they are, or within their "
            f"scatter; measure what tells them apart, give a prior, or hold one of them{_ran_off(fit)}"
        )
        self.fit = fit


def _ran_off(fit: "Fit") -> str:
    """Where no values of the unknowns come near the measurements, as where a measured force has the wrong sign."""
    if not fit.setup.has_sd or not fit.degrees_of_freedom or fit.sigma < FAR:
        return ""
    told = [f"{label} = {fit.estimate[label]:.3g} {fit.units[label]}".rstrip() for label in fit.labels]
    where = f", at {', '.join(told)}," if told else ""
    return (
        f". The best that was found{where} deviates {fit.sigma:.3g} times as much as the standard deviations say: are "
        "all signs and units right? Measured forces and moments are those that the support applies to the rod"
    )


@dataclasses.dataclass(frozen=True)
class Fit:
    """The estimate, what it is worth, and how well the computed rods agree with the measured ones.

    - `labels`, `units`: of the unknowns in common, p of them; `estimate`: {label: value}, of an unknown of each
      experiment an array (e,) in the order of the experiments.
    - `standard_error`: the same; classical, from the scatter of all deviations as if they were independent.
      `clustered_error`: of the unknowns in common, from the scatter of the clusters as wholes.
    - `covariance`, `clustered_covariance`, `correlation` (p, p), in the units of the unknowns.
    - `sigma`: the scatter of the deviations, in the unit of the measurement, or beside the given standard deviations;
      `degrees_of_freedom`.
    - `residuals`: for each experiment a list of arrays (k, d), measured minus computed, one for each measurement;
      `rms`: for each experiment the root mean square lengths of their rows, an array.
    - `converged`, `steps`; `statuses` (e,): `rodjax.Status` of the solve of each experiment.
    - `undetermined`: combinations of unknowns that the data do not determine; `held`: sentences on what was held.
    - `error_estimate`: of the meshes, largest distance of a node from the continuum by the length.
    """

    setup: Setup
    structure: Structure
    problem: Problem
    found: Found
    estimate: dict[str, Any]
    standard_error: dict[str, Any]
    clustered_error: dict[str, float]
    covariance: Float[np.ndarray, "p p"]
    clustered_covariance: Float[np.ndarray, "p p"]
    sigma: float
    dispersion: float
    degrees_of_freedom: int
    clusters: int
    numbers: int
    residuals: list[list[Float[np.ndarray, "k d"]]]
    statuses: list[Status]
    undetermined: list[Combination]
    held: list[str]
    at_bounds: list[str]
    error_estimate: float

    @staticmethod
    def of(
        setup: Setup,
        structure: Structure,
        problem: Problem,
        found: Found,
        held: Sequence[Unknown],
        error: float,
    ) -> "Fit":
        length = setup.length
        p = len(setup.shared)
        is_used = np.asarray(found.evaluation.is_used)
        is_free = np.asarray(problem.is_free.own) & is_used[:, None]
        whole = Blocks.of(found.information, is_free)
        blocks = whole.of_shared(p)
        numbers = count_of_numbers(setup, is_used)
        priors = int(np.sum(np.asarray(problem.shared.information) > 0))
        priors += int(np.sum(is_free * (np.asarray(problem.own.information) > 0)[None]))
        count = p + int(np.sum(is_free))
        freedom = numbers + priors - count
        slope = float(found.slope)
        beyond = (
            np.asarray(problem.critical.deviation),
            np.asarray(problem.shared.deviations(found.at.shared)),
            np.where(is_free, np.asarray(problem.own.deviations(found.at.own)), 0.0),
        )
        scatter = float(found.counted) + sum(float(np.sum(x**2)) for x in beyond)
        dispersion = scatter / freedom / slope**2 if freedom > 0 else (1.0 if setup.has_sd else math.nan)
        shared, own = (np.asarray(x, float) for x in values(structure, problem, found.at))
        shared = shared[:p]
        covariance, own_covariance = blocks.covariance()
        scores = np.asarray(found.information.scores, float)[:, :p]
        robust, clusters = clustered(blocks, scores, clusters_of(setup), slope, numbers, count, is_used)
        by_size = rates(setup.shared, shared, length)
        order = np.argsort(np.array(setup.order))
        own_errors = rates(setup.own, own, length) * np.sqrt(dispersion * np.diagonal(own_covariance, axis1=1, axis2=2))
        own, own_errors = np.where(is_free, own, np.nan)[order], np.where(is_free, own_errors, np.nan)[order]
        names = [unknown.label for unknown in setup.shared]
        own_names = [unknown.label for unknown in setup.own]
        errors = np.sqrt(dispersion * np.diag(covariance)) * by_size
        with np.errstate(invalid="ignore"):
            robust_errors = np.sqrt(np.diag(robust)) * by_size
        is_known = not math.isnan(dispersion)
        return Fit(
            setup=setup,
            structure=structure,
            problem=problem,
            found=found,
            estimate=dict(zip(names, shared.tolist(), strict=True)) | dict(zip(own_names, own.T, strict=True)),
            standard_error=dict(zip(names, errors.tolist(), strict=True))
            | dict(zip(own_names, own_errors.T, strict=True)),
            clustered_error=dict(zip(names, robust_errors.tolist(), strict=True)),
            covariance=dispersion * covariance * np.outer(by_size, by_size),
            clustered_covariance=robust * np.outer(by_size, by_size),
            sigma=math.sqrt(dispersion) * float(problem.scale),
            dispersion=dispersion,
            degrees_of_freedom=freedom,
            clusters=clusters,
            numbers=numbers,
            residuals=_residuals(setup, found),
            statuses=_statuses(setup, found),
            undetermined=undetermined(blocks, dispersion, setup.shared, setup.own, length) if is_known else [],
            held=held_numbers(whole, dispersion, setup.shared, held, length) if is_known else [],
            at_bounds=_at_bounds(setup, problem, found.at),
            error_estimate=error,
        )

    @property
    def labels(self) -> list[str]:
        return [unknown.label for unknown in self.setup.shared]

    @property
    def units(self) -> dict[str, str]:
        return {unknown.label: unknown.unit for unknown in (*self.setup.shared, *self.setup.own)}

    @property
    def correlation(self) -> Float[np.ndarray, "p p"]:
        sizes = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(sizes, sizes)

    @property
    def converged(self) -> bool:
        return bool(self.found.converged)

    @property
    def steps(self) -> int:
        return int(self.found.steps)

    @property
    def rms(self) -> list[Float[np.ndarray, "m"]]:
        return [
            np.array([math.sqrt(float(np.mean(np.sum(rows**2, axis=1)))) for rows in of_one])
            for of_one in self.residuals
        ]

    def interval(self, label: str, level: float = 0.95, *, clustered: bool = False) -> tuple[float, float]:
        """The confidence interval of an unknown in common, by Student's distribution; symmetric on its scale.

        `clustered`: from the scatter of the clusters, with as many degrees of freedom as there are clusters less one.
        """
        level = float(number_array(level, "level"))
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level:g}")
        k = self._index(label)
        value = self.estimate[label]
        error = (self.clustered_error if clustered else self.standard_error)[label]
        freedom = self.clusters - 1 if clustered else self.degrees_of_freedom
        reach = float(stats.t.ppf((1 + level) / 2, freedom)) * error
        if self.setup.shared[k].scale == "log":
            with np.errstate(over="ignore"):  # of what is hardly known
                return float(value * np.exp(-reach / value)), float(value * np.exp(reach / value))
        return value - reach, value + reach

    def equilibrium(self, k: int) -> Any:
        """That of the k-th experiment with the estimate, an `Equilibrium` or `HarnessEquilibrium`."""
        row = self.setup.order.index(k)
        for result in self.found.evaluation.results:
            count = result.energy.shape[0]
            if row < count:
                # Not JAX's arrays, of which each shape would be a program.
                return jax.tree.map(lambda numbers, row=row: leaf(np.asarray(numbers)[row]), result)
            row -= count
        raise IndexError(k)

    def leave_one_out(self) -> dict[str, dict[str, float]]:
        """The unknowns in common from all clusters but one: {cluster left out: {label: value}}. One batch."""
        return refits.leave_one_out(self.setup, self.structure, self.problem, self.found)

    def profile(self, label: str, at: Any = None) -> refits.Profile:
        """How much worse the fit is with an unknown in common held at each of some values, all else fitted. One batch.

        `at` (k,): values; `None`: 13 of them, within 3 standard errors.
        """
        k = self._index(label)
        if not self.dispersion > 0:
            raise ValueError("profile needs a fit with more numbers than unknowns and some scatter, which this has not")
        if at is None:
            low, high = self.estimate[label], self.standard_error[label]
            offsets = np.linspace(-3, 3, 13) * high
            at = low * np.exp(offsets / low) if self.setup.shared[k].scale == "log" else low + offsets
            if not np.all(np.isfinite(at)):
                raise ValueError(f"at must be given for {label}, whose standard error is not known")
            least, largest = self.setup.shared[k].bounds
            inside = (at > (-math.inf if least is None else least)) & (at < (math.inf if largest is None else largest))
            at = at[inside]
        return refits.profile(self.setup, self.structure, self.problem, self.found, k, at, self.dispersion)

    def bootstrap(self, count: int = 200, seed: int = 0) -> dict[str, Float[np.ndarray, "count"]]:
        """The unknowns in common from measurements made up: those computed with the estimate, with normal noise of the
        scatter found. Parametric bootstrap (Efron & Tibshirani 1993), one batch. Fits that did not converge are NaN.
        """
        return refits.bootstrap(self.setup, self.structure, self.problem, self.found, count, seed, self.dispersion)

    def next_experiment(self, candidates: Sequence[Experiment]) -> refits.Ranking:
        """The experiments by how much they would add to what is known of the unknowns in common (D-optimality).

        `candidates`: what would be measured; the measured numbers in them do not matter, their `sd` does.
        """
        return refits.next_experiment(self.setup, self.structure, self.problem, self.found, candidates, self.dispersion)

    def __str__(self) -> str:
        return self.report()

    def report(self) -> str:
        """The fit in words and tables."""
        from rodjax.identification.report import text

        return text(self)

    def as_dict(self) -> dict[str, Any]:
        """The fit as plain numbers, lists and strings, as JSON has them."""
        from rodjax.identification.report import plain

        return plain(self)

    def _index(self, label: str) -> int:
        if label not in self.labels:
            raise ValueError(f"label must be of an unknown in common, {', '.join(self.labels)}, got {label!r}")
        return self.labels.index(label)


def count_of_numbers(setup: Setup, is_used: Bool[np.ndarray, "e"]) -> int:
    """How many were measured."""
    used = [setup.experiments[k] for k, is_in in zip(setup.order, is_used, strict=True) if is_in]
    return sum(m.numbers * len(m.weights) for one in used for m in one.measured) + len(setup.critical)


def _residuals(setup: Setup, found: Found) -> list[list[Float[np.ndarray, "k d"]]]:
    of_experiments = (x for group in found.evaluation.rows for x in zip(*map(np.asarray, group), strict=True))
    residuals: dict[int, list[np.ndarray]] = {}
    for k, rows in zip(setup.order, of_experiments, strict=True):
        weights = [np.asarray(measured.weights) for measured in setup.experiments[k].measured]
        residuals[k] = [np.asarray(x)[: len(w)] / w[:, None] for x, w in zip(rows, weights, strict=True)]
    return [residuals[k] for k in range(len(setup.experiments))]


def _statuses(setup: Setup, found: Found) -> list[Status]:
    codes = np.concatenate([np.asarray(result.status) for result in found.evaluation.results])
    return [Status(int(code)) for code in codes[np.argsort(np.array(setup.order))]]


def _at_bounds(setup: Setup, problem: Problem, at: Coordinates) -> list[str]:
    """Labels of unknowns that the bounds hold back: nearer to one than a thousandth of their size."""
    found = []
    for unknowns, ranges, x in ((setup.shared, problem.shared, at.shared), (setup.own, problem.own, at.own)):
        z = np.asarray(ranges.within(x))
        for k, unknown in enumerate(unknowns):
            gap = np.minimum(z[..., k] - float(ranges.low[k]), float(ranges.high[k]) - z[..., k])
            if np.any(gap < 1e-3):
                found.append(unknown.label)
    return found
