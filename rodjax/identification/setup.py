"""From experiments and unknowns as a user gives them to the arrays of a problem, with the first equilibria."""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import instance, leaf, one_of, positive, sequence, whole_number
from rodjax.identification.least_squares import Coordinates
from rodjax.identification.loss import THRESHOLDS, Loss
from rodjax.identification.measurements import Centerline, CriticalValue, Experiment
from rodjax.identification.plausible import check_points
from rodjax.identification.problem import Critical, Group, Problem, Ranges, Sought, Structure, values, with_unknowns
from rodjax.identification.unknowns import Subject, Unknown, known_names, nominal, outside
from rodjax.model.harness import Harness, scenes_of
from rodjax.model.scene import Scene, held_position
from rodjax.paths.harness_path import are_harnesses, harness_batch, stack_harnesses, unstacked
from rodjax.paths.path import stack_scenes
from rodjax.programs.compilation import compiled
from rodjax.solving.first_state import first_state
from rodjax.solving.guess import Guess
from rodjax.solving.harness_result import Solution, results_of
from rodjax.solving.harness_rods import clamped_rods
from rodjax.solving.options import Discretization, checked_options
from rodjax.solving.refinement import SAFETY, SIZES, next_size
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_errors import estimated_errors
from rodjax.solving.result_warnings import NotConvergedWarning
from rodjax.solving.solve import solve
from rodjax.warn import warn

DEFAULT_RTOL = 1e-4
MAX_STEPS = 100
# Points of a first shape, as all of a group have the same number.
GUESS_POINTS = 65
# Of a rod that a measured centerline must span to serve for the first shape.
SPANNED = 0.9
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

    @property
    def length(self) -> float:
        """Of the rod of the first experiment, of a harness the longest [m]."""
        return max(float(scene.rod.length) for scene in scenes_of(self.experiments[0].scene).values())


def prepared(experiments: Any, unknowns: Any, *, needs_all: bool = True) -> Setup:
    """The checked experiments, grouped by what programs depend on, and the unknowns.

    `needs_all`: whether there must be a number for each unknown.
    """
    given = sequence(experiments, "experiments", "Experiment")
    for k, one in enumerate(given):
        instance(one, f"experiments[{k}]", (Experiment, CriticalValue))
    if not any(isinstance(one, Experiment) for one in given):
        raise ValueError(f"experiments must hold at least one Experiment, got {len(given)} others")
    unknowns = sequence(unknowns, "unknowns", "Unknown")
    if not unknowns:
        raise ValueError("unknowns must hold at least one Unknown, got none")
    unknowns = tuple(Unknown(one) if isinstance(one, str) else one for one in unknowns)
    for k, one in enumerate(unknowns):
        instance(one, f"unknowns[{k}]", Unknown)
    labels = [unknown.label for unknown in unknowns]
    if len(set(labels)) < len(labels):
        raise ValueError(f"unknowns must have different labels, got {', '.join(labels)}")
    names = [name for unknown in unknowns for name in unknown.names]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"unknowns must each have names of their own, got {twice[0]} twice")
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
    setup = Setup(
        measured,
        critical,
        tuple(unknown for unknown in unknowns if unknown.per == "all"),
        tuple(unknown for unknown in unknowns if unknown.per == "experiment"),
        tuple(k for members in kinds.values() for k in members),
        _has_sd(measured, critical),
    )
    if needs_all:  # of what is yet to be measured the numbers do not matter
        check_points(measured, [name_of(setup, k) for k in range(len(measured))], names)
    return setup


def _one_scene(value: CriticalValue) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], value.scenes)


def _kind(experiment: Experiment) -> Any:
    """What experiments must have in common to be stacked."""
    scene = experiment.scene
    shapes = tuple(leaf.shape for leaf in jax.tree.leaves(scene))
    return jax.tree.structure(scene), shapes, tuple(m.kind for m in experiment.measured), _tells_shape(experiment)


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


def _tells_shape(experiment: Experiment) -> bool:
    """Whether there is a first shape in what was given or measured."""
    return experiment.guess is not None or _spanning(experiment) is not None


def _spanning(experiment: Experiment) -> Centerline | None:
    """The measured centerline that spans the rod, if there is one."""
    if isinstance(experiment.scene, Harness):
        return None
    length = float(experiment.scene.rod.length)
    for measured in experiment.measured:
        if isinstance(measured, Centerline) and measured.s is not None and measured.is_affine:
            s = np.asarray(measured.s)
            if np.ptp(s) >= SPANNED * length:
                return measured
    return None


def _first_guess(experiment: Experiment) -> Guess:
    """The first shape of an experiment that tells one."""
    if experiment.guess is not None:
        points, twist = np.asarray(experiment.guess.points), experiment.guess.total_twist
        return Guess(_resampled(np.linspace(0, 1, len(points)), points, np.linspace(0, 1, GUESS_POINTS)), twist)
    measured, scene = _spanning(experiment), experiment.scene
    assert isinstance(scene, Scene)
    assert measured is not None
    assert measured.s is not None
    points = measured.lifted(np.asarray(held_position(scene)))
    at = np.linspace(0, float(scene.rod.length), GUESS_POINTS)
    return Guess(_resampled(np.asarray(measured.s), points, at))


def _resampled(s: np.ndarray, points: np.ndarray, at: np.ndarray) -> np.ndarray:
    order = np.argsort(s)
    return np.stack([np.interp(at, s[order], x) for x in points[order].T], axis=1)


def stacked(setup: Setup) -> tuple[tuple[Group, ...], tuple[Guess | None, ...]]:
    """The experiments of each kind as one, in the order of `setup.order`, and their first shapes."""
    groups, guesses = [], []
    kinds = [_kind(setup.experiments[k]) for k in setup.order]
    for _, members in itertools.groupby(range(len(kinds)), key=lambda place: kinds[place]):
        chosen = [setup.experiments[setup.order[place]] for place in members]
        most = [max(len(m.weights) for m in same) for same in zip(*(one.measured for one in chosen), strict=True)]
        measured = [tuple(m.with_rows(rows) for m, rows in zip(one.measured, most, strict=True)) for one in chosen]
        bare = Experiment(chosen[0].scene, chosen[0].measured)
        each: Any = [one.scene for one in chosen]
        scenes = stack_harnesses(each) if are_harnesses(each) else stack_scenes(each)
        experiments = eqx.tree_at(lambda one: (one.scene, one.measured), bare, (scenes, _stack(measured)))
        (rod, *_) = scenes_of(scenes).values()
        groups.append(Group(experiments, leaf(np.ones(len(chosen), rod.rod.length.dtype))))
        guesses.append(_stack([_first_guess(one) for one in chosen]) if _tells_shape(chosen[0]) else None)
    return tuple(groups), tuple(guesses)


def _stack(parts: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: leaf(np.stack([np.asarray(x) for x in leaves])), *parts)


def begun(setup: Setup, groups: tuple[Group, ...], threshold: float) -> tuple[Problem, Coordinates]:
    """The problem, and the unknowns as nominal."""
    subjects: list[Subject] = [*setup.experiments, *(_one_scene(value) for value in setup.critical)]
    shared = [_start(unknown, _first_with(unknown, subjects)) for unknown in setup.shared]
    own, is_free = (np.concatenate(x) for x in zip(*(_of_group(setup.own, group) for group in groups), strict=True))
    dtype = np.asarray(groups[0].weights).dtype
    of_shared, of_own = (_ranges(unknowns, setup.length, dtype) for unknowns in (setup.shared, setup.own))
    p = len(setup.shared)
    problem = Problem(
        groups=groups,
        shared=of_shared,
        own=of_own,
        is_free=Coordinates(leaf(np.ones(p, bool)), leaf(is_free)),
        scale=leaf(np.asarray(1.0 if setup.has_sd else _first_scale(setup), dtype)),
        threshold=leaf(np.asarray(threshold, dtype)),
        critical=Critical(leaf(np.zeros(p, dtype)), leaf(np.zeros(0, dtype)), leaf(np.zeros((0, p), dtype))),
    )
    start = Coordinates(
        _varied(np.array(shared, dtype), of_shared, setup.shared),
        _varied(own.astype(dtype), of_own, setup.own),
    )
    return problem, start


def _first_with(unknown: Unknown, subjects: Sequence[Subject]) -> Subject:
    return next((x for x in subjects if nominal(unknown.names, x) is not None), subjects[0])


def _of_group(unknowns: Sequence[Unknown], group: Group) -> tuple[Float[np.ndarray, "e q"], Bool[np.ndarray, "e q"]]:
    """Where the unknowns of each experiment start; and whether there are such numbers, all over the group."""
    count = group.weights.shape[0]
    columns, are_there = [], []
    for unknown in unknowns:
        numbers = jax.vmap(functools.partial(_nominal, unknown))(group.experiments)
        columns.append(np.zeros(count) if numbers is None else _started(unknown, np.asarray(numbers)))
        are_there.append(np.full(count, numbers is not None))
    nothing = np.zeros((count, 0))
    return np.stack(columns, axis=1) if columns else nothing, np.stack(are_there, 1) if columns else nothing > 0


def _nominal(unknown: Unknown, experiment: Experiment) -> Float[Array, ""] | None:
    return nominal(unknown.names, experiment)


def _start(unknown: Unknown, subject: Subject) -> float:
    number = nominal(unknown.names, subject)
    return 0.0 if number is None else float(_started(unknown, np.asarray(number)))


def _started(unknown: Unknown, numbers: Float[np.ndarray, "*e"]) -> Float[np.ndarray, "*e"]:
    """On the scale on which it is sought."""
    if unknown.start is not None:
        numbers = np.full_like(numbers, unknown.start)
    if unknown.scale == "linear":
        return numbers
    if not np.all(numbers > 0):
        raise ValueError(f"start of {unknown.label} must be positive on a log scale, got {float(np.min(numbers)):g}")
    return np.log(numbers)


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
            start = (z[..., k] * float(ranges.size[k])).flat[0]
            start = np.exp(start) if unknown.scale == "log" else start
            raise ValueError(
                f"bounds of {unknown.label} must hold the start, {start:g}, between them, got {unknown.bounds}"
            )
    return leaf(outside(z, low, high).astype(z.dtype))


def _first_scale(setup: Setup) -> float:
    numbers = [np.asarray(m.values) for experiment in setup.experiments for m in experiment.measured]
    scatter = max(float(np.max(np.ptp(x, axis=0))) if x.ndim > 1 else float(np.max(np.abs(x))) for x in numbers)
    return FIRST_SCALE * (scatter or 1.0)


def structure_of(
    setup: Setup,
    loss: Loss,
    rtol: float | None,
    segments: int | None,
    discretization: Discretization | None,
    planar: bool,
    max_steps: int,
) -> tuple[Structure, float | None]:
    """What is compiled for these arguments of a fit; and the tolerance to refine for, `None` for a fixed mesh."""
    if rtol is None and segments is None:
        rtol = DEFAULT_RTOL
    scene = setup.experiments[0].scene
    if isinstance(scene, Harness):
        if discretization not in (None, "hermite"):
            raise ValueError(f"discretization must be 'hermite' for a harness, got {discretization!r}")
        if planar:
            raise ValueError("planar must be False for a harness, in space")
    each = [
        checked_options(one, segments, rtol, discretization, None, None, planar)
        for one in (clamped_rods(scene) if isinstance(scene, Harness) else [scene])
    ]
    # The rods of a harness all get as many as one needs.
    options, tolerance = max(each, key=lambda found: found[0].segments)
    structure = Structure(
        shared=tuple(Sought(unknown.names, unknown.scale) for unknown in setup.shared),
        own=tuple(Sought(unknown.names, unknown.scale) for unknown in setup.own),
        loss=loss,
        segments=options.segments,
        discretization=options.discretization,
        planar=planar,
        max_steps=whole_number(max_steps, "max_steps", 1, 10_000),
    )
    return structure, tolerance


def checked_threshold(loss: Loss, threshold: float | None) -> float:
    one_of(loss, "loss", get_args(Loss))
    if threshold is None:
        return THRESHOLDS[loss]
    if loss == "linear":
        raise ValueError("threshold must be None where loss is 'linear', which has none")
    return float(positive(threshold, "threshold"))


def finer(structure: Structure, error: float, tolerance: float | None) -> Structure | None:
    """The same on a mesh that should have an error of the shapes below the tolerance; `None` where that has it."""
    finest = SIZES[structure.discretization][-1]
    if tolerance is None or SAFETY * error <= tolerance or structure.segments >= finest:
        return None
    return structure._replace(segments=next_size(structure.segments, error, tolerance, structure.discretization))


def beginnings(
    structure: Structure, problem: Problem, at: Coordinates, guesses: tuple[Any, ...]
) -> tuple[Solution, ...]:
    """What a solve begins from, with some values of the unknowns: equilibria of which only the state is one.

    `guesses`: for each group first shapes, `None`, or equilibria on another mesh.
    """
    found = _beginnings(structure, problem, at, guesses)
    return tuple(
        # A harness has no first shape that is not solved for.
        harness_batch(list(unstacked(one)), segments=structure.segments, guess=guess, strain_limit=None, is_told=False)
        if isinstance(one, Harness)
        else one
        for one, guess in zip(found, guesses, strict=True)
    )


@functools.partial(compiled, static_argnames=("structure",))
def _beginnings(
    structure: Structure, problem: Problem, at: Coordinates, guesses: tuple[Any, ...]
) -> tuple[Equilibrium | Harness, ...]:
    """The same; of a harness what is to be solved."""
    shared, own = values(structure, problem, at)

    def one(experiment: Experiment, own: Float[Array, "q"], guess: Any) -> Equilibrium | Harness:
        scene = with_unknowns(structure, experiment, shared, own).scene
        if isinstance(scene, Harness):
            return scene
        options, _ = checked_options(
            scene, structure.segments, None, structure.discretization, None, guess, structure.planar
        )
        state, first = first_state(scene, guess, options)
        solve_it = functools.partial(
            solve, segments=structure.segments, discretization=structure.discretization, planar=structure.planar
        )
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(solve_it, scene))
        return eqx.tree_at(
            lambda result: (result.scene, result.state, result.total_twist), blank, (scene, state, first.total_twist)
        )

    return tuple(
        jax.vmap(one)(group.experiments, own[here], guess)
        for group, here, guess in zip(problem.groups, problem.slices, guesses, strict=True)
    )


def largest_error(results: tuple[Solution, ...], tolerance: float | None) -> float:
    """Of the shapes that have converged, by the length; not a number where nobody asks for a tolerance."""
    if tolerance is None:
        return math.nan
    errors = [
        np.max(np.linalg.norm(estimated_errors(rod).nodes, axis=-1), axis=-1)[np.asarray(rod.converged)]
        for result in results
        for rod in results_of(result).values()
    ]
    return float(np.max(np.concatenate(errors), initial=0.0))


def warn_of_lost(setup: Setup, is_used: Bool[np.ndarray, "e"]) -> None:
    """Names the experiments that have no equilibrium to begin with."""
    names = [name_of(setup, k) for k, is_in in zip(setup.order, is_used, strict=True) if not is_in]
    if not names:
        return
    if len(names) == len(setup.order):
        raise ValueError(
            "experiments must have an equilibrium where the search begins, but no solve converged: better values to "
            "start from (Unknown's start, the scene's numbers) or a guess of the shape may help"
        )
    shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
    warn(
        f"{len(names)} experiments are left out of the fit, as no equilibrium was found where it begins: {shown}",
        NotConvergedWarning,
    )


def clusters_of(setup: Setup) -> list[tuple[str, ...]]:
    """Of each row of the problem what tells its cluster from others; an experiment without one is its own."""
    return [
        (name_of(setup, k), str(k)) if setup.experiments[k].cluster is None else (str(setup.experiments[k].cluster),)
        for k in setup.order
    ]


def name_of(setup: Setup, k: int) -> str:
    return setup.experiments[k].name or f"experiments[{k}]"
