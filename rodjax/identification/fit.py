"""fit(): parameters of rods and rigs from what was measured on them."""

import functools
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from rodjax.analysis.sensitivity import named_numbers
from rodjax.checks import leaf
from rodjax.identification.least_squares import Coordinates
from rodjax.identification.loss import Loss
from rodjax.identification.measurements import CriticalValue, Experiment
from rodjax.identification.problem import Critical, Found, Group, Problem, Ranges, Structure, in_units, search_compiled
from rodjax.identification.result import Fit, NotIdentifiableError
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
    warn_of_lost,
)
from rodjax.identification.unknowns import Unknown, with_values
from rodjax.notes import note
from rodjax.paths.continuation import critical_point
from rodjax.programs.answers import one_answer
from rodjax.solving.harness_result import Solution
from rodjax.solving.options import Discretization
from rodjax.solving.result_warnings import NotConvergedWarning
from rodjax.warn import warn

# The scatter of robust fits, and points about which critical values are linear, settle in some 3 to 5 rounds.
MAX_ROUNDS = 20
SETTLED = 1e-6


@one_answer
def fit(
    experiments: Sequence[Experiment | CriticalValue],
    unknowns: Sequence[Unknown | str],
    *,
    loss: Loss = "linear",
    threshold: float | None = None,
    rtol: float | None = None,
    segments: int | None = None,
    discretization: Discretization | None = None,
    planar: bool = False,
    max_steps: int = MAX_STEPS,
    progress: bool | None = None,
) -> Fit:
    """The parameters of scenes and rigs with which the computed rods agree best with the measured ones.

    Levenberg and Marquardt's method on implicit derivatives: all experiments of one structure are one batch, compiled
    once, each solve warm-started from the last.

    **Arguments:**

    - `experiments`: `Experiment`s, of scenes and harnesses of any structures, and `CriticalValue`s, of scenes.
    - `unknowns`: `Unknown`s, or their names.
    - `loss`: `"linear"`: least squares; `"huber"`, `"cauchy"`, `"welsch"`: deviations beyond `threshold` standard
        deviations count less, those of `"welsch"` in the end not at all. `threshold`: `None` for 95 % efficiency
        without outliers. Where no standard deviations are given the scatter is found with the fit.
    - `rtol`: relative error of the shapes from the mesh, 1e-4; or `segments`: a fixed mesh. `discretization`, `planar`:
        as for `rodjax.solve`.
    - `max_steps`: of the method, evaluations of all experiments.
    - `progress`: whether a call that takes longer than 2 s says on stderr what it does; `None`: in a terminal or
        notebook.

    Returns a `Fit`. Raises `NotIdentifiableError` where the data do not determine a combination of the unknowns, which
    it names; `ValueError` or `TypeError` for invalid arguments. Experiments without an equilibrium at the start are
    left out, with a `NotConvergedWarning`.
    """
    threshold = checked_threshold(loss, threshold)
    setup = prepared(experiments, unknowns)
    structure, tolerance = structure_of(setup, loss, rtol, segments, discretization, planar, max_steps)
    groups, guesses = stacked(setup)
    problem, at = begun(setup, groups, threshold)
    held = _held_numbers(setup, groups)
    structure, problem, at = _with_held(setup, structure, problem, at, held)
    results = beginnings(structure, problem, at, guesses)
    while True:
        note(f"fitting {len(setup.experiments)} experiments on {structure.segments} segments")
        found, problem = _settled(setup, structure, problem, at, results)
        at, results = found.at, found.evaluation.results
        error = largest_error(results, tolerance)
        better = finer(structure, error, tolerance)
        if better is None:
            break
        structure, results = better, beginnings(better, problem, at, results)
    warn_of_lost(setup, np.asarray(found.evaluation.is_used))
    if not found.converged:
        warn(
            f"the fit has not converged in {int(found.steps)} steps: better values to start from, bounds or priors may "
            "help",
            NotConvergedWarning,
        )
    result = Fit.of(setup, structure, problem, found, held, error)
    if result.undetermined:
        raise NotIdentifiableError(result)
    return result


def _settled(
    setup: Setup, structure: Structure, problem: Problem, at: Coordinates, results: tuple[Solution, ...]
) -> tuple[Found, Problem]:
    """Searched until the scatter and the critical values, which are found between searches, stay as they are."""
    needs_scale = not setup.has_sd and (structure.loss != "linear" or _has_priors(problem))
    found = None
    for _ in range(MAX_ROUNDS):
        if setup.critical:
            problem = eqx.tree_at(lambda problem: problem.critical, problem, _critical(setup, structure, problem, at))
        found = search_compiled(structure, problem, at, results)
        change = float(jnp.max(jnp.abs(found.at.shared - at.shared), initial=0.0)) if setup.critical else 0.0
        at, results = found.at, found.evaluation.results
        if needs_scale:
            scale = _scatter(setup, found, structure.loss)
            change = max(change, abs(scale / float(problem.scale) - 1) * 1e-3)
            problem = eqx.tree_at(lambda p: p.scale, problem, leaf(np.asarray(scale, problem.scale.dtype)))
        if change < SETTLED or not found.converged:
            break
    assert found is not None, "there is at least one round"
    return found, problem


def _has_priors(problem: Problem) -> bool:
    return bool(np.any(np.asarray(problem.shared.information)) or np.any(np.asarray(problem.own.information)))


def _scatter(setup: Setup, found: Found, loss: Loss) -> float:
    """The scatter of single deviations: of a robust fit from the median, which outliers do not move."""
    pairs = zip(setup.order, (x for group in found.evaluation.rows for x in zip(*group, strict=True)), strict=True)
    rows = [
        np.asarray(x)[: len(measured.weights)]
        for k, of_one in pairs
        for x, measured in zip(of_one, setup.experiments[k].measured, strict=True)
    ]
    if loss == "linear":
        numbers = sum(m.numbers * len(m.weights) for one in setup.experiments for m in one.measured)
        return float(np.sqrt(sum(np.sum(x**2) for x in rows) / numbers))
    # Of the lengths of rows of d normal deviations the median is that of the chi distribution.
    d = max(m.numbers for one in setup.experiments for m in one.measured)
    return float(np.median(np.concatenate([np.linalg.norm(x, axis=1) for x in rows])) / stats.chi.median(d))


def _held_numbers(setup: Setup, groups: Sequence[Group]) -> list[Unknown]:
    """Material numbers of all rods that are not sought: whether the data would tell them is worth a sentence."""
    sought = {name for unknown in (*setup.shared, *setup.own) for name in unknown.names}
    numbers = [named_numbers(group.experiments.scene) for group in groups]
    found = []
    for kind in ("EI", "GJ", "EA", "mass_per_length"):
        for name in numbers[0]:
            values = [of_group[name] for of_group in numbers if name in of_group]
            # One number a rod, along the axis of the experiments.
            is_number = len(values) == len(numbers) and all(value.ndim == 1 for value in values)
            is_kind = name == f"rod.{kind}" or name.endswith(f".rod.{kind}")
            if is_kind and is_number and name not in sought and all(np.all(np.asarray(value) > 0) for value in values):
                found.append(Unknown(name))
    return found


def _with_held(
    setup: Setup, structure: Structure, problem: Problem, at: Coordinates, held: Sequence[Unknown]
) -> tuple[Structure, Problem, Coordinates]:
    """With what was held as unknowns in common behind the others, each by a factor of what it is in each scene."""
    more = structure._replace(factors=tuple(unknown.names[0] for unknown in held))
    k = len(held)

    def longer(x: Float[Array, "p"], fill: float) -> Float[Array, "p+k"]:
        return jnp.concatenate([x, jnp.full(k, fill, x.dtype)])

    ranges = Ranges(
        longer(problem.shared.size, 1.0),
        longer(problem.shared.low, -math.inf),
        longer(problem.shared.high, math.inf),
        longer(problem.shared.prior, 0.0),
        longer(problem.shared.information, 0.0),
    )
    critical = eqx.tree_at(
        lambda critical: (critical.at, critical.slope),
        problem.critical,
        (longer(problem.critical.at, 0.0), jnp.pad(problem.critical.slope, ((0, 0), (0, k)))),
    )
    is_free = jnp.concatenate([problem.is_free.shared, jnp.zeros(k, bool)])
    extended = eqx.tree_at(
        lambda problem: (problem.shared, problem.critical, problem.is_free.shared), problem, (ranges, critical, is_free)
    )
    return more, extended, Coordinates(longer(at.shared, 0.0), at.own)


def _critical(setup: Setup, structure: Structure, problem: Problem, at: Coordinates) -> Critical:
    """The deviations of critical values at a point, and their derivatives by the unknowns in common."""
    sought = structure.shared
    coordinates = problem.shared.coordinates(at.shared)
    here = coordinates[: len(sought)]
    held = len(structure.factors)

    def parameter(value: CriticalValue, coordinates: Float[Array, "p"]) -> Float[Array, ""]:
        numbers = in_units(sought, coordinates)
        names, scales = [one.names for one in sought], [one.scale for one in sought]
        scenes = jax.vmap(lambda scene: with_values(scene, names, scales, list(numbers)))(value.scenes)
        return critical_point(scenes, **dict(value.options)).parameter

    deviations, slopes = [], []
    for value in setup.critical:
        computed, slope = jax.value_and_grad(functools.partial(parameter, value))(here)
        deviations.append((value.value - computed) / value.sd)
        slopes.append(-slope / value.sd)
    return Critical(coordinates, jnp.stack(deviations), jnp.pad(jnp.stack(slopes), ((0, 0), (0, held))))
