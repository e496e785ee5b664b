"""The equilibrium of a harness: of all its rods, and of the bodies in which they end."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.checks import instance, is_known
from rodjax.model.harness import Bodies, Harness, of_one_rod
from rodjax.model.scene import Scene, has_friction
from rodjax.programs.compilation import compiled
from rodjax.solving.assembly import Poses
from rodjax.solving.description import places_told
from rodjax.solving.equilibrium import is_here
from rodjax.solving.first_poses import Shapes, first_poses
from rodjax.solving.first_sides import on_their_sides
from rodjax.solving.guess import Guess
from rodjax.solving.harness_derivatives import differentiable_harness
from rodjax.solving.harness_forces import no_pressures
from rodjax.solving.harness_refinement import refined
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.harness_rods import clamped_rods
from rodjax.solving.harness_start import at_poses, solved_on_meshes
from rodjax.solving.implicit import not_differentiated
from rodjax.solving.newton import Newton
from rodjax.solving.options import DEFAULT_RTOL, check_single, checked_options, checked_strain_limit
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium
from rodjax.solving.result_warnings import NotConvergedWarning, warn_if_coarse, warn_of_outcome
from rodjax.warn import warn


def solve_harness(
    harness: Harness,
    *,
    segments: int | list[int] | None = None,
    rtol: float | None = None,
    discretization: str | None = None,
    solver: Any = None,
    guess: HarnessEquilibrium | Mapping[str, Guess] | None = None,
    planar: bool = False,
    find: Any = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
    is_told: bool = True,
) -> HarnessEquilibrium:
    """See `rodjax.solving.solve.solve`; `segments` may be those of each rod; `is_told`: whether warnings say what is
    wrong with the result.
    """
    if discretization not in (None, "hermite"):
        raise ValueError(f"discretization must be 'hermite' where poses of ends are unknown, got {discretization!r}")
    if solver is not None:
        instance(solver, "solver", Newton)
    if planar:
        raise ValueError("planar must be False where poses are unknown, in space")
    fixed, earlier, shapes = not_differentiated(harness, *_begins(harness, guess))
    if earlier is not None and any(map(has_friction, harness.scenes)):
        earlier = _as_memory(earlier)
    strain_limit = checked_strain_limit(strain_limit)
    if not harness.bodies:
        bodies = Bodies.of(harness)
        poses = Poses(bodies.position, bodies.frame)
    else:
        poses = first_poses(fixed, shapes) if earlier is None else _followed(fixed, earlier)
    if earlier is None and fixed.contact:
        shapes = on_their_sides(at_poses(fixed, poses), fixed.contact, shapes)
    kept = [None] * len(fixed) if earlier is None else earlier.segments
    counts = segments if isinstance(segments, list) else [segments] * len(fixed)
    all_options, tolerance = [], rtol
    for scene, count, before in zip(clamped_rods(fixed), counts, kept, strict=True):
        # The mesh of a guess comes first, as of one rod.
        wanted = before if count is None and rtol is None else count
        options, tolerance = checked_options(scene, wanted, rtol, "hermite", solver, find=find)
        if count is None and before is not None:
            options = dataclasses.replace(options, segments=before)
        all_options.append(options)
    result = solved_on_meshes(fixed, poses, tuple(all_options), earlier, strain_limit, shapes=shapes)
    if is_known(result.status) and is_here(result.groups[0]):
        if segments is None:
            result = refined(result, tuple(all_options), DEFAULT_RTOL if tolerance is None else tolerance, strain_limit)
        if is_told:
            warn_of_harness(result, strain_limit, is_given=segments is not None)
    return result if fixed is harness else differentiable_harness(harness, result)


def solve_movable(scene: Scene, *, guess: Guess | Equilibrium | None = None, **options: Any) -> Equilibrium:
    """The equilibrium of a scene with an end that is a `Hinge`, `Slider` or `Spring`."""
    harness = of_one_rod(scene)
    earlier = None
    if isinstance(guess, Guess):
        earlier = dict.fromkeys(harness.names, guess)
    elif guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
        check_single(guess)
        earlier = _as_harness(harness, guess)
    return _of_one_rod(solve_harness(harness, guess=earlier, **options))


def _as_harness(harness: Harness, guess: Equilibrium) -> HarnessEquilibrium:
    """An equilibrium of its one rod, which ends where the bodies are."""
    frames = {"start": guess.frames[0], "end": guess.frames[-1]}
    nodes = {"start": guess.nodes[0], "end": guess.nodes[-1]}
    return HarnessEquilibrium(
        groups=(jax.tree.map(lambda leaf: leaf[None], guess),),
        positions=jnp.stack([nodes[name] for name in harness.joint_names]),
        frames=jnp.stack([frames[name] for name in harness.joint_names]),
        energy=guess.energy,
        converged=guess.converged,
        stable=guess.stable,
        index=jnp.zeros((), int),
        status=guess.status,
        iterations=guess.iterations,
        evaluations=guess.evaluations,
        residual=guess.residual,
        contact_forces=jnp.zeros((len(harness.bodies), 3), guess.energy.dtype),
        end_pressures=no_pressures(harness, ((0,),)),
        rod_pressures=jnp.zeros(0, guess.energy.dtype),
        wide_wells=jnp.zeros(0, bool),
        harness=harness,
        members=((0,),),
    )


def _of_one_rod(result: HarnessEquilibrium) -> Equilibrium:
    return dataclasses.replace(
        result.rod(0),
        energy=result.energy,
        converged=result.converged,
        stable=result.stable,
        status=result.status,
        iterations=result.iterations,
        evaluations=result.evaluations,
        residual=result.residual,
        free_index=result.index,
    )


def warn_of_harness(result: HarnessEquilibrium, strain_limit: Any, *, is_given: bool = False) -> None:
    """Outside `jit`, what is wrong with the result; `is_given`: whether its mesh was, which may be too coarse."""
    names = [f"cable {name!r}" for name in result.names] if len(result) > 1 else ["the rod"]
    if is_given:
        for members, group in zip(result.members, result.groups, strict=True):
            warn_if_coarse(group, [names[number] for number in members])
    if not bool(result.converged):
        told = [
            f"{name}: {part}" for name, rod in zip(names, result.values(), strict=True) for part in places_told(rod)
        ]
        warn("; ".join([result.outcome, *told]), NotConvergedWarning)
        return
    if any(np.any(np.asarray(group.status)) for group in result.groups):
        for name, rod in zip(names, result.values(), strict=True):
            warn_of_outcome(rod, strain_limit, name)


# --- the start -------------------------------------------------------------------------------------------------------


def _begins(
    harness: Harness, guess: HarnessEquilibrium | Mapping[str, Guess] | None
) -> tuple[HarnessEquilibrium | None, Shapes]:
    """An earlier equilibrium, or the shapes of cables in the order of the harness."""
    if isinstance(guess, Mapping):
        for name, shape in guess.items():
            if name not in harness.names:
                raise ValueError(f"guess names the cable {name!r}, allowed are {', '.join(map(repr, harness.names))}")
            instance(shape, f"guess[{name!r}]", Guess)
        return None, tuple(guess.get(name) for name in harness.names)
    if guess is not None:
        instance(guess, "guess", (HarnessEquilibrium, dict))
        if guess.energy.ndim:
            raise ValueError(f"guess must be a single equilibrium, got a stack of shape {guess.energy.shape}")
        if (guess.harness.names, guess.harness.joint_names) != (harness.names, harness.joint_names):
            raise ValueError("guess must be an equilibrium of a harness with the same cables and joints in this order")
    return guess, (None,) * len(harness.scenes)


@compiled
def _as_memory(guess: HarnessEquilibrium) -> HarnessEquilibrium:
    """With slips counted from there, if that is an equilibrium."""

    def of_rod(rod: Equilibrium) -> Equilibrium:
        state = jax.tree.map(lambda new, old: jnp.where(guess.converged, new, old), rod.state.as_memory(), rod.state)
        return dataclasses.replace(rod, state=state)

    return dataclasses.replace(guess, groups=tuple(map(jax.vmap(of_rod), guess.groups)))


@compiled
def _followed(harness: Harness, guess: HarnessEquilibrium) -> Poses:
    """The poses of an earlier equilibrium, displaced with the supports."""
    return Poses(*Bodies.of(harness).followed(Bodies.of(guess.harness), guess.positions, guess.frames))
