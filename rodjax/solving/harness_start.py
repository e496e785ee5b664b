"""A harness solved on given meshes: what its rods begin with there, from a guess or without."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rodjax.discretization.first_twist import FirstTwist
from rodjax.model.harness import Harness, clamp_at, joint_ends
from rodjax.model.scene import Scene
from rodjax.model.supports import Joint
from rodjax.programs.compilation import compiled
from rodjax.solving.assembly import Poses
from rodjax.solving.first_poses import Shapes
from rodjax.solving.first_state import first_state, fits, last_twist
from rodjax.solving.harness_forces import no_pressures, no_rod_pressures, stacked
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.harness_rods import clamped_rods, members_of, touchable
from rodjax.solving.harness_search import find_harness
from rodjax.solving.options import Options
from rodjax.solving.result import Equilibrium
from rodjax.solving.solver_state import SolverState


def solved_on_meshes(
    harness: Harness,
    poses: Poses,
    all_options: tuple[Options, ...],
    guess: HarnessEquilibrium | None,
    strain_limit: Any,
    finer: dict[int, SolverState] | None = None,
    shapes: Shapes = (),
) -> HarnessEquilibrium:
    """On given meshes; `finer`: what rods begin with whose mesh is another one than that of the guess; `shapes`: with
    which rods begin where there is none.
    """
    structures = clamped_rods(harness, [options.segments for options in all_options])
    members = members_of(structures, all_options)
    starts = []
    for group in members:
        options = all_options[group[0]]
        start = None
        if guess is not None and group in guess.members:
            start = _as_it_was(structures[group[0]], guess.groups[guess.members.index(group)], options)
        if start is None:
            each = []
            for number in group:
                rod = shapes[number] if guess is None else guess.rod(number)
                if finer is not None and number in finer:
                    assert isinstance(rod, Equilibrium)
                    each.append((finer[number], last_twist(rod)))
                else:
                    scene = touchable(harness, number, harness.scenes[number], options.segments)
                    scene = _at(scene, _bodies_of(harness, number), poses)
                    state, first = first_state(scene, rod, options)
                    if isinstance(rod, Equilibrium) and _same_memory(rod.state, state):
                        state = dataclasses.replace(state, friction=rod.state.friction)
                    each.append((state, first))
            start = _stacked_starts(tuple(each))
        starts.append(start)
    options = tuple(all_options[group[0]] for group in members)
    pressures = no_pressures(harness, members) if guess is None else guess.end_pressures
    if guess is not None and (guess.members != members or pressures.shape != no_pressures(harness, members).shape):
        pressures = no_pressures(harness, members)
    of_rods, is_wide = no_rod_pressures(harness, members, options)
    if guess is not None and guess.members == members and guess.rod_pressures.shape == of_rods.shape:
        of_rods, is_wide = guess.rod_pressures, guess.wide_wells
    return find_harness(
        harness, poses, tuple(starts), pressures, of_rods, is_wide, strain_limit, options, members=members
    )


def _same_memory(one: SolverState, other: SolverState) -> bool:
    """Whether both have a memory of friction, on meshes of as many elements."""
    if one.friction is None or other.friction is None:
        return False
    return one.friction.forces.shape == other.friction.forces.shape


@compiled
def _stacked_starts(each: tuple[tuple[SolverState, FirstTwist], ...]) -> tuple[SolverState, FirstTwist]:
    return stacked(list(each))


def _as_it_was(scene: Scene, group: Equilibrium, options: Options) -> tuple[SolverState, FirstTwist] | None:
    """The state of stacked equilibria, where it has the unknowns and the mesh of their scenes."""
    if group.s.shape[-1] - 1 != options.segments or jax.tree.structure(group.scene) != jax.tree.structure(scene):
        return None
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), group)
    if not eqx.tree_equal(*(jax.tree.map(jnp.shape, each.obstacles) for each in (one.scene, scene))):
        return None
    return (group.state, last_twist(group)) if fits(scene, one, options) else None


def at_poses(harness: Harness, poses: Poses) -> list[Scene]:
    """The scenes of its rods, with clamps in the place of joints."""
    return [_at(scene, _bodies_of(harness, number), poses) for number, scene in enumerate(harness.scenes)]


def _bodies_of(harness: Harness, number: int) -> tuple[int, int]:
    return joint_ends(harness.scenes[number], harness.joint_names)[0]


@compiled
def _at(scene: Scene, bodies: tuple[int, int], poses: Poses) -> Scene:
    """With clamps in the place of joints, which the rod has with these bodies."""
    ends = []
    for end, body in zip((scene.start, scene.end), bodies, strict=True):
        ends.append(clamp_at(end, poses.positions[body], poses.frames[body]) if isinstance(end, Joint) else end)
    return eqx.tree_at(lambda scene: (scene.start, scene.end), scene, tuple(ends))
