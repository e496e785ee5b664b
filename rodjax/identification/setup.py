"""From experiments and unknowns as a user gives them to the arrays of a problem, with the first equilibria."""

import functools
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import instance, leaf, sequence
from rodjax.compilation import compiled
from rodjax.guess import Guess
from rodjax.identification.least_squares import Coordinates
from rodjax.identification.measurements import Centerline, CriticalValue, Experiment
from rodjax.identification.problem import Critical, Group, Problem, Ranges, Sought, Structure, solved_experiment, values
from rodjax.identification.unknowns import Subject, Unknown, known_names, nominal, outside
from rodjax.refinement import SAFETY, SIZES, next_size
from rodjax.result import Equilibrium, NotConvergedWarning, estimated_errors
from rodjax.scene import Scene
from rodjax.supports import Held

# Points of a first shape, as all of a group have the same number.
GUESS_POINTS = 65
# Of a rod that a measured centerline must span to serve for the first shape.
SPANNED = 0.9
# Solved side by side, as many as fit into a processor's cache.
LANES = 16
# Without standard deviations: of the scatter of the measured numbers, what deviations are first compared with.
FIRST_SCALE = 0.01


class Setup(NamedTuple):
    """What a fit is made from. `order`: for each row of the problem the number of its experiment."""

    experiments: tuple[Experiment, ...]
    critical: tuple[CriticalValue, ...]
    shared: tuple[Unknown, ...]
    own: tuple[Unknown, ...]
    order: tuple[int, ...]
    has_sd: bool


def prepared(experiments: Any, unknowns: Any, *, needs_all: bool = True) -> Setup:
    """The checked experiments, grouped by what programs depend on, and the unknowns.

    `needs_all`: whether there must be a number for each unknown.
    """
    given = sequence(experiments, "experiments", "Experiment")
    if not any(isinstance(one, Experiment) for one in given):
        raise ValueError(f"experiments must hold at least one Experiment, got {len(given)} others")
    for k, one in enumerate(given):
        instance(one, f"experiments[{k}]", (Experiment, CriticalValue))
    unknowns = sequence(unknowns, "unknowns", "Unknown")
    if not unknowns:
        raise ValueError("unknowns must hold at least one Unknown, got none")
    unknowns = tuple(Unknown(one) if isinstance(one, str) else one for one in unknowns)
    for k, one in enumerate(unknowns):
        instance(one, f"unknowns[{k}]", Unknown)
    labels = [unknown.label for unknown in unknowns]
    if len(set(labels)) < len(labels):
        raise ValueError(f"unknowns must have different labels, got {', '.join(labels)}")
    measured = tuple(one for one in given if isinstance(one, Experiment))
    critical = tuple(one for one in given if isinstance(one, CriticalValue))
    subjects: list[Subject] = [*measured, *(_one_scene(value) for value in critical)]
    for unknown in unknowns:
        if needs_all and all(nominal(unknown.names, subject) is None for subject in subjects):
            names = ", ".join(known_names(subjects[0]))
            raise ValueError(
                f"unknowns must be numbers of the experiments, got {unknown.label!r}; the first has {names}"
            )
    kinds: dict[Any, list[int]] = {}
    for k, one in enumerate(measured):
        kinds.setdefault(_kind(one), []).append(k)
    return Setup(
        measured,
        critical,
        tuple(unknown for unknown in unknowns if unknown.per == "all"),
        tuple(unknown for unknown in unknowns if unknown.per == "experiment"),
        tuple(k for members in kinds.values() for k in members),
        _has_sd(measured, critical),
    )


def _one_scene(value: CriticalValue) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], value.scenes)


def _kind(experiment: Experiment) -> Any:
    """What experiments must have in common to be stacked."""
    bare = _bare(experiment, 1)
    return jax.tree.structure(bare), tuple(x.shape for x in jax.tree.leaves(bare)), first_guess(experiment) is None


def _bare(experiment: Experiment, rows: int) -> Experiment:
    """Without what differs between experiments of a kind and does not enter programs."""
    measured = tuple(measurement.with_rows(rows) for measurement in experiment.measured)
    return Experiment(experiment.scene, measured)


def _has_sd(experiments: Sequence[Experiment], critical: Sequence[CriticalValue]) -> bool:
    kinds = {(m.unit, m.has_sd) for experiment in experiments for m in experiment.measured}
    given = {has_sd for _, has_sd in kinds}
    if given == {True}:
        return True
    if len(kinds) > 1 or critical:
        raise ValueError(
            "sd must be given for every measurement where there are measurements of several units, or some have it"
        )
    return False


def first_guess(experiment: Experiment) -> Guess | None:
    """The first shape that an experiment tells."""
    if experiment.guess is not None:
        return experiment.guess
    length = float(experiment.scene.rod.length)
    for measured in experiment.measured:
        if isinstance(measured, Centerline) and measured.s is not None and measured.is_affine:
            s = np.asarray(measured.s)
            if np.ptp(s) >= SPANNED * length:
                points = _lifted(measured, experiment.scene)
                return Guess(_resampled(s, points, np.linspace(0, length, GUESS_POINTS)))
    return None


def _lifted(measured: Centerline, scene: Scene) -> Float[np.ndarray, "m 3"]:
    """Measured points in the scene; those of a picture at the depth of a held end."""
    held = scene.start if isinstance(scene.start, Held) else scene.end
    assert isinstance(held, Held), "a scene holds at least one position"
    origin = held.position[None]
    linear = np.asarray(measured.seen(jnp.eye(3)) - measured.seen(jnp.zeros((3, 3))))
    return np.asarray(origin) + np.asarray(measured.points - measured.seen(origin)) @ np.linalg.pinv(linear)


def _resampled(s: np.ndarray, points: np.ndarray, at: np.ndarray) -> np.ndarray:
    order = np.argsort(s)
    return np.stack([np.interp(at, s[order], x) for x in points[order].T], axis=1)


def stacked(setup: Setup) -> tuple[tuple[Group, ...], tuple[Guess | None, ...]]:
    """The experiments of each kind as one, in the order of `setup.order`, and their first shapes."""
    groups, guesses = [], []
    members: list[list[int]] = []
    for k in setup.order:
        if members and _kind(setup.experiments[members[-1][0]]) == _kind(setup.experiments[k]):
            members[-1].append(k)
        else:
            members.append([k])
    for of_kind in members:
        chosen = [setup.experiments[k] for k in of_kind]
        most = max(len(m.weights) for one in chosen for m in one.measured)
        experiments = _stack([_bare(one, most) for one in chosen])
        groups.append(Group(experiments, leaf(np.ones(len(chosen), experiments.scene.rod.length.dtype))))
        shapes = [first_guess(one) for one in chosen]
        known = [Guess(_spread(np.asarray(g.points)), g.total_twist) for g in shapes if g is not None]
        guesses.append(_stack(known) if known else None)
    return tuple(groups), tuple(guesses)


def _spread(points: np.ndarray) -> np.ndarray:
    places = np.linspace(0, 1, len(points))
    return _resampled(places, points, np.linspace(0, 1, GUESS_POINTS))


def _stack(parts: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: leaf(np.stack([np.asarray(x) for x in leaves])), *parts)


def begun(setup: Setup, groups: tuple[Group, ...], threshold: float) -> tuple[Problem, Coordinates]:
    """The problem, and the unknowns as nominal."""
    length = float(setup.experiments[0].scene.rod.length)
    subjects: list[Subject] = [*setup.experiments, *(_one_scene(value) for value in setup.critical)]
    ordered = [setup.experiments[k] for k in setup.order]
    shared = [_start(unknown, _first_with(unknown, subjects)) for unknown in setup.shared]
    own = [[_start(unknown, experiment) for unknown in setup.own] for experiment in ordered]
    is_free = [[nominal(unknown.names, one) is not None for unknown in setup.own] for one in ordered]
    dtype = np.asarray(groups[0].weights).dtype
    of_shared, of_own = _ranges(setup.shared, length, dtype), _ranges(setup.own, length, dtype)
    p, q = len(setup.shared), len(setup.own)
    problem = Problem(
        groups=groups,
        shared=of_shared,
        own=of_own,
        is_free=Coordinates(leaf(np.ones(p, bool)), leaf(np.array(is_free, bool).reshape(len(ordered), q))),
        scale=leaf(np.asarray(1.0 if setup.has_sd else _first_scale(setup), dtype)),
        threshold=leaf(np.asarray(threshold, dtype)),
        critical=Critical(leaf(np.zeros(p, dtype)), leaf(np.zeros(0, dtype)), leaf(np.zeros((0, p), dtype))),
    )
    start = Coordinates(
        _varied(np.array(shared, dtype), of_shared, setup.shared),
        _varied(np.array(own, dtype).reshape(len(ordered), q), of_own, setup.own),
    )
    return problem, start


def _first_with(unknown: Unknown, subjects: Sequence[Subject]) -> Subject:
    return next((x for x in subjects if nominal(unknown.names, x) is not None), subjects[0])


def _start(unknown: Unknown, subject: Subject) -> float:
    """On the scale on which it is sought; anything where there is no such number."""
    number = nominal(unknown.names, subject)
    if number is None:
        return 0.0
    value = float(number) if unknown.start is None else unknown.start
    if unknown.scale == "log":
        if not value > 0:
            raise ValueError(f"start of {unknown.label} must be positive on a log scale, got {value:g}")
        value = float(np.log(value))
    return value


def _ranges(unknowns: Sequence[Unknown], length: float, dtype: Any) -> Ranges:
    def array(numbers: list[float]) -> Float[Array, "n"]:
        return leaf(np.array(numbers, dtype))

    sizes = [unknown.natural_size(length) for unknown in unknowns]
    low, high, prior, weight = [], [], [], []
    for unknown, size in zip(unknowns, sizes, strict=True):
        is_log = unknown.scale == "log"
        least, largest = unknown.bounds
        low.append(-np.inf if least is None else (np.log(least) if is_log else least) / size)
        high.append(np.inf if largest is None else (np.log(largest) if is_log else largest) / size)
        mean, sd = unknown.prior or (1.0 if is_log else 0.0, np.inf)
        prior.append((np.log(mean) if is_log else mean) / size)
        weight.append(size / sd)
    return Ranges(array(sizes), array(low), array(high), array(prior), array(weight))


def _varied(x: Float[np.ndarray, "*e n"], ranges: Ranges, unknowns: Sequence[Unknown]) -> Float[Array, "*e n"]:
    z = x / np.asarray(ranges.size)
    low, high = (np.broadcast_to(np.asarray(bound), z.shape) for bound in (ranges.low, ranges.high))
    for k, unknown in enumerate(unknowns):
        if not (np.all(z[..., k] > low[..., k]) and np.all(z[..., k] < high[..., k])):
            raise ValueError(f"bounds of {unknown.label} must hold the start between them, got {unknown.bounds}")
    return leaf(outside(z, low, high).astype(z.dtype))


def _first_scale(setup: Setup) -> float:
    numbers = [np.asarray(m.values) for experiment in setup.experiments for m in experiment.measured]
    scatter = max(float(np.max(np.ptp(x, axis=0))) if x.ndim > 1 else float(np.max(np.abs(x))) for x in numbers)
    return FIRST_SCALE * (scatter or 1.0)


def structure_of(setup: Setup, **settings: Any) -> Structure:
    return Structure(
        shared=tuple(Sought(unknown.names, unknown.scale) for unknown in setup.shared),
        own=tuple(Sought(unknown.names, unknown.scale) for unknown in setup.own),
        **settings,
    )


@functools.partial(compiled, static_argnames=("structure",))
def _solutions(
    structure: Structure, problem: Problem, at: Coordinates, guesses: tuple[Any, ...]
) -> tuple[Equilibrium, ...]:
    shared, own = values(structure, problem, at)
    results = []
    first = 0
    for group, guess in zip(problem.groups, guesses, strict=True):
        count = group.weights.shape[0]
        each = (group.experiments, own[first : first + count], guess)
        results.append(
            jax.lax.map(
                lambda one: solved_experiment(structure, one[0], shared, one[1], one[2])[1], each, batch_size=LANES
            )
        )
        first += count
    return tuple(results)


def solutions(
    structure: Structure, problem: Problem, at: Coordinates, guesses: tuple[Any, ...], rtol: float | None
) -> tuple[Structure, tuple[Equilibrium, ...]]:
    """The equilibria at some values of the unknowns, on a mesh fine enough for `rtol` (`None`: that of `structure`)."""
    while True:
        results = _solutions(structure, problem, at, guesses)
        error = largest_error(results)
        finest = SIZES[structure.discretization][-1]
        if rtol is None or SAFETY * error <= rtol or structure.segments >= finest:
            return structure, results
        structure = structure._replace(segments=next_size(structure.segments, error, rtol, structure.discretization))
        guesses = results


def largest_error(results: tuple[Equilibrium, ...]) -> float:
    """Of the shapes that have converged, by the length."""
    errors = [
        np.max(np.linalg.norm(estimated_errors(result).nodes, axis=-1), axis=-1)[np.asarray(result.converged)]
        for result in results
    ]
    return float(np.max(np.concatenate(errors), initial=0.0))


def only_converged(setup: Setup, problem: Problem, results: tuple[Equilibrium, ...]) -> Problem:
    """The problem without the experiments that have no equilibrium to begin with, which a warning names."""
    converged = [np.asarray(result.converged) for result in results]
    pairs = zip(setup.order, np.concatenate(converged), strict=True)
    names = [name_of(setup, k) for k, is_found in pairs if not is_found]
    if not names:
        return problem
    if len(names) == len(setup.order):
        raise ValueError(
            "experiments must have an equilibrium where the search begins, but no solve converged: better values to "
            "start from (Unknown's start, the scene's numbers) or a guess of the shape may help"
        )
    shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
    warnings.warn(
        f"{len(names)} experiments are left out of the fit, as no equilibrium was found where it begins: {shown}",
        NotConvergedWarning,
        stacklevel=3,
    )
    dtype = problem.scale.dtype
    weights = [leaf(found.astype(dtype)) for found in converged]
    return eqx.tree_at(lambda problem: [group.weights for group in problem.groups], problem, weights)


def name_of(setup: Setup, k: int) -> str:
    return setup.experiments[k].name or f"experiments[{k}]"
