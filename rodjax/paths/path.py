"""Quasistatic paths: a sequence of scenes, each solved from the last, in one compiled scan."""

import dataclasses
import functools
import math
import typing
from collections.abc import Sequence
from typing import Any, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import instance, is_known, leaf, namespace, one_of, sequence
from rodjax.discretization.first_twist import FirstTwist, Last, last_of
from rodjax.discretization.nodal_point import Nodal
from rodjax.model.harness import Harness
from rodjax.model.scene import (
    Scene,
    between,
    has_friction,
    has_node_positions,
    has_potential,
    nondimensional,
    slides,
)
from rodjax.notes import note
from rodjax.paths.branch import count_of
from rodjax.paths.harness_path import are_harnesses, harness_path, stack_harnesses
from rodjax.paths.tracing import DEFAULT_STEPS, trace
from rodjax.programs.answers import one_answer
from rodjax.programs.compilation import compiled
from rodjax.solving.equilibrium import refined_together
from rodjax.solving.first_state import first_state
from rodjax.solving.guess import Guess
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.implicit import differentiable, not_differentiated
from rodjax.solving.newton import Find
from rodjax.solving.options import Discretization, Options, Solver, check_single, checked_options, checked_strain_limit
from rodjax.solving.ranges import check_ranges, with_ranges
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium, build_result
from rodjax.solving.result_warnings import warn_of_outcome
from rodjax.solving.search import solve_from
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.status import Outcome, is_converged

# What a path does where its branch of equilibria loses its stability.
AtCritical = Literal["jump", "stop"]

# A step is halved at most so often, to a sixty-fourth of it.
MAX_SPLITS = 6
# The last step points on where the scene changes at less than 37 degrees from how it did, and less than twice as far.
LEAST_ALIGNMENT = 0.8
MOST_EXTRAPOLATION = 2.0


@one_answer
def solve_path(
    scenes: Sequence[Scene] | Scene | Sequence[Harness],
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Any = None,
    planar: bool = False,
    find: Find = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
    at_critical: AtCritical = "jump",
    progress: bool | None = None,
) -> Any:
    """The equilibria of a sequence of scenes, each solved from the last; turns are carried along.

    **Arguments:**

    - `scenes`: `Scene`s of one structure, or one `Scene` whose leaves have a leading axis. The frames of ends and
      clips may turn by less than pi from one to the next.
    - `at_critical`: `"jump"`: where the branch of equilibria loses its stability the path goes on with the minimum
        found beyond, as a cable does. `"stop"`: it ends with the last scene before the first critical point of the
        branch, see `rodjax.follow`; eager only.
    - `progress`: whether a call that takes longer than 2 s says on stderr what it does; `None`: in a terminal or
      notebook; `True`: by a bar, which asks for a program of its own.

    A step starts from the last equilibrium, or from the extrapolation of the last two as far as the scenes change as
    they did before. A step that does not converge is halved, and halved again; `Equilibrium.substeps` counts the solves
    it took.

    Friction of obstacles acts from step to step: the slip of a node is its displacement along an obstacle from one
    equilibrium to the next. The tangential force is at most mu times the pressure; where the node slips it equals that
    bound and opposes the slip. The first scene is solved from rest, without friction, unless the guess is an
    equilibrium. A step that is split has more equilibria on its way, and slips are counted from each. Obstacles with
    friction stay where they are. Derivatives are those of each step, with the places of the last equilibrium held.

    - `segments`, `rtol`, `discretization`, `solver`, `guess`, `planar`, `find`, `strain_limit`: as for `rodjax.solve`.
        The guess is for the first scene; where the estimated error of any step is above `rtol`, the whole path is
        solved on a finer mesh of equal segments.

    Returns an `Equilibrium`, of harnesses a `HarnessEquilibrium`, with a leading axis, one entry a scene.
    """
    one_of(at_critical, "at_critical", typing.get_args(AtCritical))
    if are_harnesses(scenes):
        harnesses = cast(Sequence[Harness], scenes)
        stack = stack_harnesses(harnesses)
        for name, of_rod in zip(stack, stack.scenes, strict=True):
            check_still(of_rod, of=f"cables[{name!r}].")
        if at_critical == "stop":
            _check_stop(stack)
        numbers: dict[str, Any] = {"segments": segments, "rtol": rtol, "guess": guess, "strain_limit": strain_limit}
        how: dict[str, Any] = {"discretization": discretization, "solver": solver, "planar": planar, "find": find}
        path = harness_path(harnesses, **numbers, **how)
        if at_critical == "stop":
            count = _before_critical(stack, jax.lax.stop_gradient(path))
            path = jax.tree.map(lambda leaf: leaf[:count], path)
        return path
    scenes = cast(Sequence[Scene] | Scene, scenes)
    if guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
    stacked = stack_scenes(scenes)
    fixed_scenes, guess = not_differentiated(stacked, guess)
    if isinstance(scenes, Scene) or fixed_scenes is not stacked:
        check_ranges(fixed_scenes)
    check_still(fixed_scenes)
    check_single(guess)
    options, rtol = checked_options(fixed_scenes, segments, rtol, discretization, solver, guess, planar, find)
    strain_limit = checked_strain_limit(strain_limit)
    if at_critical == "stop":
        _check_stop(fixed_scenes)

    def solve(options: Options, _: Equilibrium | None) -> Equilibrium:
        return path_from(fixed_scenes, guess, strain_limit, options, bool(progress))

    path = with_ranges(fixed_scenes, refined_together(solve, options, rtol))
    warn_of_outcome(path, strain_limit)
    if at_critical == "stop":
        count = _before_critical(fixed_scenes, path)
        stacked, path = jax.tree.map(lambda leaf: leaf[:count], (stacked, path))
    return differentiable(stacked, path)


def check_still(scenes: Scene, axis: int = 0, of: str = "") -> None:
    """Raises `ValueError` where an obstacle with friction moves along a path, whose steps are along an axis; `of`: what
    the names of obstacles begin with.
    """
    for k, obstacle in enumerate(scenes.obstacles):
        if obstacle.friction is None:
            continue
        body = jax.tree.leaves(eqx.tree_at(lambda body: body.friction, obstacle, None))
        if is_known(body) and any(np.any(np.ptp(np.asarray(leaf), axis=axis) > 0) for leaf in body):
            raise ValueError(f"{of}obstacles[{k}] must stay the same along a path, as it has friction")


def _check_stop(scenes: Scene | Harness) -> None:
    if not is_known(scenes):
        raise ValueError("at_critical must be 'jump' inside jax.jit or vmap: how many scenes a path has must be known")
    lacking = not_followed(scenes)
    if lacking == "potential":
        raise ValueError(
            "at_critical must be 'jump' for dead moments, couples and follower loads, which have no potential"
        )
    if lacking is not None:
        raise ValueError(f"at_critical must be 'jump' for scenes with {lacking}")


def not_followed(scenes: Scene | Harness) -> str | None:
    """What keeps branches of scenes from being followed: "potential", where loads have none, "friction",
    "self_contact", and of the rods of a harness "obstacles", "contact" or "sliding clips"; `None` where nothing does.
    """
    each = scenes.scenes if isinstance(scenes, Harness) else (scenes,)
    if not all(map(has_potential, each)) or (isinstance(scenes, Harness) and not scenes.has_potential):
        return "potential"
    if any(map(has_friction, each)):
        return "friction"
    if isinstance(scenes, Harness) and (scenes.contact or any(scene.obstacles for scene in each)):
        return "contact" if scenes.contact else "obstacles"
    if isinstance(scenes, Harness) and any(map(slides, each)):
        return "sliding clips"
    return "self_contact" if any(scene.self_contact for scene in each) else None


def _before_critical(scenes: Scene | Harness, path: Equilibrium | HarnessEquilibrium) -> int:
    """How many scenes of a path come before the first critical point of its branch."""
    count = count_of(scenes)
    if count == 1:
        return 1
    first = jax.tree.map(lambda leaf: leaf[0], path)
    crossings = trace(scenes, 0.0, first, 1.0, DEFAULT_STEPS, only_first=True).crossings
    return math.floor(crossings[0].station.parameter) + 1 if crossings else count


def stack_scenes(scenes: Sequence[Scene] | Scene) -> Scene:
    """Scenes of one structure as one `Scene` whose leaves have a leading axis."""
    if isinstance(scenes, Scene):
        if scenes.rod.length.ndim != 1:
            raise ValueError(
                "scenes must be a list, or one Scene with a leading axis on every leaf; got a single scene"
            )
        return scenes
    scenes = sequence(scenes, "scenes", "Scene")
    if not scenes:
        raise ValueError("scenes must hold at least one scene, got none")
    for k, scene in enumerate(scenes):
        if isinstance(scene, Harness):
            raise ValueError(
                f"scenes[{k}] is a Harness: rodjax.solve_path and solve_batch take lists of these alone, and so do "
                "follow, critical_point and critical_points"
            )
        instance(scene, f"scenes[{k}]", Scene)
        if jax.tree.structure(scene) != jax.tree.structure(scenes[0]):
            raise ValueError(
                f"scenes must all have the same supports and the same kinds of loads, "
                f"got scenes[0] with {_structure(scenes[0])} and scenes[{k}] with {_structure(scene)}"
            )
    xp = namespace(scenes)
    return jax.tree.map(lambda *leaves: leaf(xp.stack(leaves)), *scenes)


def _structure(scene: Scene) -> str:
    parts = [f"{type(scene.start).__name__}-{type(scene.end).__name__}"]
    parts += [name for name in ("gravity", "turns") if getattr(scene, name) is not None]
    parts.append(f"{len(scene.point_forces)} point forces")
    parts += [f"{len(scene.point_couples)} point couples"] if scene.point_couples else []
    parts += [f"{len(scene.clips)} clips"] if scene.clips else []
    parts += [", ".join(type(obstacle).__name__ for obstacle in scene.obstacles)] if scene.obstacles else []
    return ", ".join(parts)


@functools.partial(compiled, static_argnames=("progress",))
def _solve_path(
    scenes: Scene,
    state: SolverState,
    first: FirstTwist,
    strain_limit: Float[Array, ""] | float,
    options: Options,
    progress: bool,
) -> Equilibrium:
    count = scenes.rod.length.shape[0]
    meter = _progress_meter() if progress else None
    first_scene = jax.tree.map(lambda leaf: leaf[0], scenes)

    def step(carry, numbered):
        last, before, bar = carry
        number, scene = numbered
        found, substeps = _step(last, before, scene, options, may_split=number > 0)
        if meter is not None:
            bar = meter.step(bar, (number + 1) / count)
        state = found.state
        if has_friction(scenes):
            converged = is_converged(found.outcome.status)
            state = jax.tree.map(lambda new, old: jnp.where(converged, new, old), state.as_memory(), state)
        return (_Station(scene, state, found.point.total_twist, last_of(scene)), last, bar), (found, substeps)

    bar = None if meter is None else meter.init()
    assert first.last is not None
    start = _Station(first_scene, state, first.total_twist, first.last)
    (_, _, bar), (found, substeps) = jax.lax.scan(step, (start, start, bar), (jnp.arange(count), scenes))
    if meter is not None and bar is not None:
        meter.close(bar)
    return jax.vmap(build_result, (0, 0, 0, None))(scenes, found, substeps, strain_limit)


def path_from(
    scenes: Scene,
    guess: Guess | Equilibrium | None,
    strain_limit: Float[Array, ""] | float,
    options: Options,
    progress: bool = False,
) -> Equilibrium:
    """A path on one mesh; the guess is for its first scene."""
    # NumPy's, where the numbers are known: JAX takes as long for each of them as for a step.
    first = jax.tree.map(lambda leaf: namespace(leaf).asarray(leaf)[0], scenes)
    count = scenes.rod.length.shape[0]
    note("" if progress else f"solving {count} scenes one after another, on {options.segments} segments")
    return _solve_path(scenes, *first_state(first, guess, options), strain_limit, options, progress)


class _Station(eqx.Module):
    """A scene on the path, the state found for it, and what the next one carries on from there."""

    scene: Scene
    state: SolverState
    total_twist: Float[Array, ""]
    last: Last


class _Progress(eqx.Module):
    """How far a step has come: what is reached, where the next solve begins, and what the last one found."""

    reached: SolverState
    begin: SolverState
    total_twist: Float[Array, ""]
    last: Last
    fraction: Float[Array, ""]
    share: Float[Array, ""]
    is_last_try: Bool[Array, ""]
    solves: Int[Array, ""]
    found: Found
    is_finished: Bool[Array, ""]


def _step(
    last: _Station, before: _Station, scene: Scene, options: Options, *, may_split: Bool[Array, ""]
) -> tuple[Found, Int[Array, ""]]:
    """The equilibrium of a scene from the last one, at once or by way of scenes between the two; solves it took."""

    def attempt(progress: _Progress) -> _Progress:
        target = jnp.minimum(progress.fraction + progress.share, 1.0)
        here = jax.lax.cond(target < 1.0, lambda: between(last.scene, scene, target), lambda: scene)
        first = FirstTwist(progress.total_twist, progress.last._replace(shape=progress.reached.shape))
        found = solve_from(here, progress.begin, first, options)
        converged = is_converged(found.outcome.status)
        reached = jax.tree.map(
            lambda new, old: jnp.where(converged, new, old), found.state.as_memory(), progress.reached
        )
        is_smallest = progress.share <= 0.5**MAX_SPLITS
        return _Progress(
            reached=reached,
            begin=reached,
            total_twist=jnp.where(converged, found.point.total_twist, progress.total_twist),
            last=jax.tree.map(lambda new, old: jnp.where(converged, new, old), last_of(here), progress.last),
            fraction=jnp.where(converged, target, progress.fraction),
            share=jnp.where(converged, 2 * progress.share, jnp.where(is_smallest, 1.0, progress.share / 2)),
            is_last_try=~converged & is_smallest,
            solves=progress.solves + 1,
            found=eqx.tree_at(
                lambda found: (found.outcome.iterations, found.outcome.evaluations),
                found,
                (
                    progress.found.outcome.iterations + found.outcome.iterations,
                    progress.found.outcome.evaluations + found.outcome.evaluations,
                ),
            ),
            is_finished=(target >= 1.0) & (converged | progress.is_last_try | ~may_split),
        )

    zero, count, no = jnp.zeros_like(last.total_twist), jnp.zeros((), int), jnp.array(False)
    point = last.state.point(zero)
    if point.nodal is None and has_node_positions(scene):
        nodes = last.state.shape.nodes
        point = dataclasses.replace(point, nodal=Nodal(nodes, jnp.zeros((0, len(nodes)), nodes.dtype), nodes[:0, 0]))
    nowhere = jax.tree.map(jnp.zeros_like, point)
    progress = _Progress(
        reached=last.state,
        begin=_predicted(last, before, scene),
        total_twist=last.total_twist,
        last=last.last,
        fraction=zero,
        share=jnp.ones_like(zero),
        is_last_try=no,
        solves=count,
        found=Found(last.state, nowhere, Outcome(zero, count, count, count), no),
        is_finished=no,
    )
    progress = jax.lax.while_loop(lambda progress: ~progress.is_finished, attempt, progress)
    return progress.found, progress.solves


def _predicted(last: _Station, before: _Station, scene: Scene) -> SolverState:
    """Where the last two equilibria point, as far as the scenes go on in the direction in which they went."""
    flat = [ravel_pytree(nondimensional(scene)[0])[0] for scene in (before.scene, last.scene, scene)]
    previous, change = flat[1] - flat[0], flat[2] - flat[1]
    sizes = jnp.sqrt(jnp.sum(previous**2)), jnp.sqrt(jnp.sum(change**2))
    is_aligned = jnp.sum(previous * change) > LEAST_ALIGNMENT * sizes[0] * sizes[1]
    ratio = sizes[1] / jnp.where(is_aligned, sizes[0], 1.0)
    goes_on = is_aligned & (ratio < MOST_EXTRAPOLATION)
    ratio = jnp.where(goes_on, ratio, 0.0)

    state = last.state
    shape = state.shape.extrapolated(before.state.shape, ratio)
    force = before.state.end_force * (before.state.units.force / state.units.force)
    predicted = dataclasses.replace(state, shape=shape, end_force=state.end_force + ratio * (state.end_force - force))
    return jax.tree.map(lambda new, old: jnp.where(goes_on, new, old), predicted, state)


def _progress_meter():
    # diffrax's meters work under jit; its import takes a second that a solve without one need not wait for.
    from diffrax import TqdmProgressMeter

    return TqdmProgressMeter(refresh_steps=1)
