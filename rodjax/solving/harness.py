"""The equilibrium of a harness: of all its rods, and of the bodies in which they end."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import instance, is_known, leaf
from rodjax.discretization.first_twist import FirstTwist
from rodjax.discretization.forms import form_of
from rodjax.model.harness import (
    Bodies,
    Harness,
    clamp_at,
    clamped,
    end_radii,
    floating,
    joint_ends,
    of_one_rod,
    rotated,
)
from rodjax.model.loads import ContactLoads
from rodjax.model.scene import Scene, nondimensional, under_contact
from rodjax.model.supports import Clamp, Joint
from rodjax.programs.compilation import compiled
from rodjax.programs.linear import linear
from rodjax.solving.assembly import Assembly, Poses, Rods, State, find_assembly
from rodjax.solving.equilibrium import (
    DEFAULT_RTOL,
    Options,
    Search,
    _finer,
    _fits,
    check_single,
    checked_options,
    checked_strain_limit,
    first_state,
    in_units_of,
    is_here,
    last_twist,
    on_one_side,
)
from rodjax.solving.first_poses import first_poses
from rodjax.solving.guess import Guess
from rodjax.solving.harness_result import HarnessEquilibrium, Solution
from rodjax.solving.implicit import differentiable, not_differentiated, with_zeros
from rodjax.solving.newton import Newton
from rodjax.solving.refinement import SAFETY, SIZES, Depth, error_by_rtol, next_size, normalized
from rodjax.solving.result import (
    DEFAULT_STRAIN_LIMIT,
    Equilibrium,
    Found,
    NotConvergedWarning,
    SolverState,
    build_result,
    estimated_errors,
    warn_if_coarse,
    warn_of_outcome,
)
from rodjax.solving.rod_contact import Members, Pairs, in_contact, pairs_of
from rodjax.solving.rod_contact_results import touching_rods
from rodjax.solving.status import Outcome, is_converged
from rodjax.warn import warn

# Motions of the bodies, what is unknown of contacts between rods, pressures of those of bodies with obstacles.
Unknown = tuple[Float[Array, "k"], Float[Array, "t"], Float[Array, "c"]]

# Of contacts of bodies, beside the stiffest motion of these, and how often what it gives way by is asked for again.
ENDS_COMPLIANCE = 1e-4
ENDS_HARDENINGS = 4


def solve_harness(
    harness: Harness,
    *,
    segments: int | list[int] | None = None,
    rtol: float | None = None,
    discretization: str | None = None,
    solver: Any = None,
    guess: HarnessEquilibrium | None = None,
    planar: bool = False,
    find: Any = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
    shape: Guess | None = None,
    is_told: bool = True,
) -> HarnessEquilibrium:
    """See `rodjax.solving.solve.solve`; `segments` may be those of each rod; `shape`: with which all rods begin where
    there is no guess; `is_told`: whether warnings say what is wrong with the result.
    """
    if discretization not in (None, "hermite"):
        raise ValueError(f"discretization must be 'hermite' where poses of ends are unknown, got {discretization!r}")
    if solver is not None:
        instance(solver, "solver", Newton)
    if planar:
        raise ValueError("planar must be False where poses are unknown, in space")
    if guess is not None:
        instance(guess, "guess", HarnessEquilibrium)
        if guess.energy.ndim:
            raise ValueError(f"guess must be a single equilibrium, got a stack of shape {guess.energy.shape}")
        if (guess.harness.names, guess.harness.joint_names) != (harness.names, harness.joint_names):
            raise ValueError("guess must be an equilibrium of a harness with the same cables and joints in this order")
    fixed, guess = not_differentiated(harness, guess)
    strain_limit = checked_strain_limit(strain_limit)
    if not harness.bodies:
        bodies = Bodies.of(harness)
        poses = Poses(bodies.position, bodies.frame)
    else:
        poses = first_poses(fixed) if guess is None else _followed(fixed, guess)
    kept = [None] * len(fixed) if guess is None else guess.segments
    counts = segments if isinstance(segments, list) else [segments] * len(fixed)
    all_options, tolerance = [], rtol
    for scene, count, before in zip(clamped_rods(fixed), counts, kept, strict=True):
        # The mesh of a guess comes first, as of one rod.
        wanted = before if count is None and rtol is None else count
        options, tolerance = checked_options(scene, wanted, rtol, "hermite", solver, find=find)
        if count is None and before is not None:
            options = dataclasses.replace(options, segments=before)
        all_options.append(options)
    result = _solved(fixed, poses, tuple(all_options), guess, strain_limit, shape=shape)
    if is_known(result.status) and is_here(result.groups[0]):
        if segments is None:
            result = _refined(
                result, tuple(all_options), DEFAULT_RTOL if tolerance is None else tolerance, strain_limit
            )
        elif is_told:
            for group in result.groups:
                warn_if_coarse(group)
        if is_told:
            warn_of_harness(result, strain_limit)
    return result if fixed is harness else differentiable_harness(harness, result)


def solve_movable(scene: Scene, *, guess: Guess | Equilibrium | None = None, **options: Any) -> Equilibrium:
    """The equilibrium of a scene with an end that is a `Hinge`, `Slider` or `Spring`."""
    harness = of_one_rod(scene)
    shape, earlier = None, None
    if isinstance(guess, Guess):
        shape = guess
    elif guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
        check_single(guess)
        earlier = _as_harness(harness, guess)
    return _of_one_rod(solve_harness(harness, guess=earlier, shape=shape, **options))


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


def warn_of_harness(result: HarnessEquilibrium, strain_limit: Any) -> None:
    """Outside `jit`, what is wrong with the result."""
    if not bool(result.converged):
        warn(result.in_words().splitlines()[0], NotConvergedWarning)
        return
    for rod in result.groups:
        warn_of_outcome(rod, strain_limit)


# --- the start -------------------------------------------------------------------------------------------------------


@compiled
def _followed(harness: Harness, guess: HarnessEquilibrium) -> Poses:
    """The poses of an earlier equilibrium, displaced with the supports."""
    return Poses(*Bodies.of(harness).followed(Bodies.of(guess.harness), guess.positions, guess.frames))


def clamped_rods(harness: Harness, counts: Sequence[int] | None = None) -> list[Scene]:
    """The scenes of the rods with clamps, at no place in particular, where their ends are joints; `counts`: of elements
    of each rod, where they are known.
    """
    clamp = _clamp(harness.scenes[0].rod.length.dtype)

    def structure(scene: Scene) -> Scene:
        # `eqx.tree_at` would take longer than the solve.
        new = object.__new__(Scene)
        for field in dataclasses.fields(Scene):
            value = getattr(scene, field.name)
            object.__setattr__(new, field.name, clamp if isinstance(value, Joint) else value)
        return new

    found = [structure(scene) for scene in harness.scenes]
    return (
        found
        if counts is None
        else [_touchable(harness, *each) for each in zip(range(len(found)), found, counts, strict=True)]
    )


def _touchable(harness: Harness, number: int, scene: Scene, elements: int) -> Scene:
    """The scene of a rod on a mesh, with what others apply to it, nothing at first, if it may touch any."""
    if not any(number in pair for pair in harness.contact):
        return scene
    nothing = np.zeros((3, 2, elements), scene.rod.length.dtype)
    return under_contact(scene, ContactLoads(leaf(nothing), leaf(nothing)))


@functools.cache
def _clamp(dtype: Any) -> Clamp:
    return Clamp(np.zeros(3, dtype), np.eye(3, dtype=dtype))


def _members(structures: list[Scene], all_options: tuple[Options, ...]) -> Members:
    """The numbers of the rods of one structure and mesh."""
    found: dict[Any, list[int]] = {}
    for number, (scene, options) in enumerate(zip(structures, all_options, strict=True)):
        leaves, tree = jax.tree.flatten(scene)
        key = tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), options.segments
        found.setdefault(key, []).append(number)
    return tuple(map(tuple, found.values()))


def _stack(parts: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)


def _solved(
    harness: Harness,
    poses: Poses,
    all_options: tuple[Options, ...],
    guess: HarnessEquilibrium | None,
    strain_limit: Any,
    finer: dict[int, SolverState] | None = None,
    shape: Guess | None = None,
) -> HarnessEquilibrium:
    """On given meshes; `finer`: what rods begin with whose mesh is another one than that of the guess."""
    structures = clamped_rods(harness, [options.segments for options in all_options])
    members = _members(structures, all_options)
    starts = []
    for group in members:
        options = all_options[group[0]]
        start = None
        if guess is not None and group in guess.members:
            start = _as_it_was(structures[group[0]], guess.groups[guess.members.index(group)], options)
        if start is None:
            each = []
            for number in group:
                rod = shape if guess is None else guess.rod(number)
                if finer is not None and number in finer:
                    assert isinstance(rod, Equilibrium)
                    each.append((finer[number], last_twist(rod)))
                else:
                    scene = _touchable(harness, number, harness.scenes[number], options.segments)
                    scene = _at(scene, _bodies_of(harness, number), poses)
                    each.append(first_state(scene, rod, options))
            start = _stacked_starts(tuple(each))
        starts.append(start)
    options = tuple(all_options[group[0]] for group in members)
    pressures = no_pressures(harness, members) if guess is None else guess.end_pressures
    if guess is not None and (guess.members != members or pressures.shape != no_pressures(harness, members).shape):
        pressures = no_pressures(harness, members)
    of_rods = no_rod_pressures(harness, members, options)
    if guess is not None and guess.members == members and guess.rod_pressures.shape == of_rods.shape:
        of_rods = guess.rod_pressures
    return _solve(harness, poses, tuple(starts), pressures, of_rods, strain_limit, options, members=members)


@compiled
def _stacked_starts(each: tuple[tuple[SolverState, FirstTwist], ...]) -> tuple[SolverState, FirstTwist]:
    return _stack(list(each))


def _as_it_was(scene: Scene, group: Equilibrium, options: Options) -> tuple[SolverState, FirstTwist] | None:
    """The state of stacked equilibria, where it has the unknowns and the mesh of their scenes."""
    if group.s.shape[-1] - 1 != options.segments or jax.tree.structure(group.scene) != jax.tree.structure(scene):
        return None
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), group)
    if not eqx.tree_equal(*(jax.tree.map(jnp.shape, each.obstacles) for each in (one.scene, scene))):
        return None
    return (group.state, last_twist(group)) if _fits(scene, one, options) else None


def _bodies_of(harness: Harness, number: int) -> tuple[int, int]:
    return joint_ends(harness.scenes[number], harness.joint_names)[0]


@compiled
def _at(scene: Scene, bodies: tuple[int, int], poses: Poses) -> Scene:
    """With clamps in the place of joints, which the rod has with these bodies."""
    ends = []
    for end, body in zip((scene.start, scene.end), bodies, strict=True):
        ends.append(clamp_at(end, poses.positions[body], poses.frames[body]) if isinstance(end, Joint) else end)
    return eqx.tree_at(lambda scene: (scene.start, scene.end), scene, tuple(ends))


# --- the solve -------------------------------------------------------------------------------------------------------


@functools.partial(compiled, static_argnames=("members",))
def _solve(
    harness: Harness,
    poses: Poses,
    starts: tuple[tuple[SolverState, FirstTwist], ...],
    end_pressures: Float[Array, "c"],
    rod_pressures: Float[Array, "c"],
    strain_limit: Float[Array, ""] | float,
    options: tuple[Options, ...],
    members: Members,
) -> HarnessEquilibrium:
    groups, points, all_searches, at_ends = [], [], [], []
    of_groups = split_pressures(harness, members, end_pressures)
    for numbers, (states, firsts), option, pressures in zip(members, starts, options, of_groups, strict=True):
        elements = option.segments
        stacked = _stack(
            [_touchable(harness, k, clamped(harness.scenes[k], harness, *poses), elements) for k in numbers]
        )

        def begin(scene: Scene, state: SolverState, first: FirstTwist, option: Options = option) -> Search:
            return Search.of(*in_units_of(scene, state), first, option)

        searches = jax.vmap(begin)(stacked, states, firsts)
        body, frame, offset = ends_of(harness, numbers)
        groups.append(Rods(searches.form, searches.shape, searches.units, body, frame, offset))
        points.append(searches.point)
        all_searches.append((searches, states))
        at_ends.append(None if pressures is None else pressures / searches.units.force[:, None, None])
    bodies, pairs = Bodies.of(harness), pairs_of(harness.contact, members)
    assembly = Assembly.of(tuple(groups), bodies, pairs)
    counts = [option.segments for option in options]
    between = split_rod_pressures(pairs, counts, rod_pressures / assembly.force)
    solver = options[0].solver
    assert isinstance(solver, Newton)
    end = find_assembly(assembly, tuple(points), tuple(at_ends), between, poses, solver, options[0].find)
    return harness_equilibrium(harness, members, assembly, end, end_pressures, strain_limit, tuple(all_searches))


def harness_equilibrium(
    harness: Harness,
    members: Members,
    assembly: Assembly,
    end: State,
    end_pressures: Float[Array, "c"],
    strain_limit: Float[Array, ""] | float,
    all_begun: tuple[tuple[Search | None, SolverState | None], ...],
) -> HarnessEquilibrium:
    """What a search found, whose rods are those of `assembly`; `all_begun`: where it began, of rods with obstacles."""
    groups, bodies, pairs = assembly.groups, assembly.bodies, assembly.pairs
    loads = assembly.contacts(end)
    is_stable = is_converged(end.status) & (end.negative == 0) & harness.has_potential
    rods = []
    for number, (rod, numbers, begun) in enumerate(zip(groups, members, all_begun, strict=True)):
        now = _stack([clamped(harness.scenes[k], harness, *end.poses) for k in numbers])
        if number in in_contact(pairs):
            now = under_contact(now, assembly.contact_loads(loads, number).times(assembly.force, assembly.energy))
        rods.append(_equilibria(now, rod, begun, end, number, is_stable, strain_limit))
    pressures = [
        (pressures * rod.units.force[:, None, None]).reshape(-1)
        for rod, pressures in zip(groups, end.at_ends, strict=True)
        if pressures is not None
    ]
    end_pressures = jnp.concatenate(pressures) if pressures else end_pressures
    between = [jnp.zeros(0, end.poses.positions.dtype), *(pressures.reshape(-1) for pressures in end.pairs)]
    rod_pressures = assembly.force * jnp.concatenate(between)
    status = end.status
    for rod in rods:
        # A strain beyond the limit in one of them is said of the whole.
        worst = jnp.max(jnp.where(rod.status == end.status, end.status, rod.status))
        status = jnp.where(is_converged(status), jnp.where(worst == end.status, status, worst), status)
    return HarnessEquilibrium(
        groups=tuple(rods),
        positions=end.poses.positions,
        frames=end.poses.frames,
        energy=_energy(rods, bodies, end.poses),
        converged=is_converged(status),
        stable=is_stable,
        index=end.negative,
        status=status,
        iterations=end.iterations,
        evaluations=end.evaluations,
        residual=end.residual,
        contact_forces=contact_forces(harness, members, end.poses, end_pressures)[0][:, :3],
        end_pressures=end_pressures,
        rod_pressures=rod_pressures,
        harness=harness,
        members=members,
    )


def ends_of(harness: Harness, numbers: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Of some rods the bodies, frames and offsets of both ends; the number of all bodies for none."""
    count, dtype = len(harness.bodies), harness.scenes[0].rod.length.dtype
    found = [joint_ends(harness.scenes[number], harness.joint_names) for number in numbers]
    bodies = jnp.array([[count if j < 0 else j for j in body] for body, _, _ in found])
    frames = jnp.stack([jnp.stack([jnp.asarray(frame, dtype) for frame in two]) for _, two, _ in found])
    offsets = jnp.stack([jnp.stack([jnp.asarray(offset, dtype) for offset in two]) for _, _, two in found])
    return bodies, frames, offsets


def _equilibria(
    scenes: Scene,
    rods: Rods,
    begun: tuple[Search | None, SolverState | None],
    end: State,
    group: int,
    is_stable: Array,
    strain_limit: Any,
) -> Equilibrium:
    def one(
        scene: Scene, rod: Rods, search: Search | None, begin: SolverState | None, point: Any, residual: Array
    ) -> Equilibrium:
        scaled, units = nondimensional(scene)
        form = form_of(scaled, rod.shape)
        if point.nodal is not None:
            # From the units of the search, whose origin is where the rod began.
            positions = point.nodal.positions + (rod.units.origin - units.origin)[None] / units.length
            point = dataclasses.replace(point, nodal=dataclasses.replace(point.nodal, positions=positions))
        point = form.settled(form.holding(point))
        pressures = point.nodal.pressures if scene.obstacles else None
        state = SolverState(rod.shape.reached(form, point), point.end_force, units, pressures=pressures)
        outcome = Outcome(residual, end.iterations, end.evaluations, end.status)
        found = Found(state, point, outcome, is_stable)
        if scene.obstacles:
            assert search is not None
            assert begin is not None
            found = on_one_side(search, form, found, begin.before)
        return build_result(scene, found, jnp.ones((), int), strain_limit)

    return jax.vmap(one)(scenes, rods, *begun, end.points[group], end.residuals[group])


def _energy(rods: list[Equilibrium], bodies: Bodies, poses: Poses) -> Float[Array, ""]:
    energies = bodies.energies(*poses, jnp.zeros_like(poses.positions))
    return jnp.sum(energies) + sum(jnp.sum(rod.energy) for rod in rods)


# --- contacts of the bodies ------------------------------------------------------------------------------------------


def _of_obstacles(harness: Harness, members: Members) -> list[int]:
    """How many obstacles the rods of each group have."""
    return [len(harness.scenes[numbers[0]].obstacles) for numbers in members]


def no_pressures(harness: Harness, members: Members) -> Float[Array, "c"]:
    counts = [2 * count * len(numbers) for count, numbers in zip(_of_obstacles(harness, members), members, strict=True)]
    return leaf(np.zeros(sum(counts), harness.scenes[0].rod.length.dtype))


def split_pressures(harness: Harness, members: Members, pressures: Float[Array, "c"]) -> list[Array | None]:
    """Of each group (rods, obstacles, ends); `None` of rods that touch neither obstacles nor other rods."""
    found, first, touched = [], 0, in_contact(pairs_of(harness.contact, members))
    for group, (count, numbers) in enumerate(zip(_of_obstacles(harness, members), members, strict=True)):
        size = 2 * count * len(numbers)
        of_group = pressures[first : first + size].reshape(len(numbers), count, 2)
        found.append(of_group if count or group in touched else None)
        first += size
    return found


def no_rod_pressures(harness: Harness, members: Members, options: tuple[Options, ...]) -> Float[Array, "c"]:
    """Of contacts between rods, of each kind of pairs by pair and element of its first rod."""
    pairs = pairs_of(harness.contact, members)
    count = sum(len(each.places) * options[each.groups[0]].segments for each in pairs)
    return leaf(np.zeros(count, harness.scenes[0].rod.length.dtype))


def split_rod_pressures(
    pairs: tuple[Pairs, ...], counts: Sequence[int], pressures: Float[Array, "c"]
) -> tuple[Float[Array, "p n"], ...]:
    """`counts`: of elements of the rods of each group."""
    found, first = [], 0
    for each in pairs:
        shape = len(each.places), counts[each.groups[0]]
        found.append(pressures[first : first + shape[0] * shape[1]].reshape(shape))
        first += shape[0] * shape[1]
    return tuple(found)


def contact_forces(
    harness: Harness, members: Members, poses: Poses, pressures: Float[Array, "c"]
) -> tuple[Float[Array, "j 6"], Float[Array, "c"]]:
    """Forces [N] of obstacles on the bodies where rods end in them, and moments about their positions [N m]; the gaps
    there [m], none at ends that are in no body.
    """
    count, floats = len(harness.bodies), floating(harness)
    total, gaps = jnp.zeros((count + 1, 6), poses.positions.dtype), []
    for numbers, of_group in zip(members, split_pressures(harness, members, pressures), strict=True):
        if of_group is None:
            continue
        for number, of_rod in zip(numbers, of_group, strict=True):
            scene = harness.scenes[number]
            bodies, _, offsets = joint_ends(scene, harness.joint_names)
            radius = end_radii(scene)
            for obstacle, of_ends in zip(scene.obstacles, of_rod, strict=True):
                of_obstacle = []
                for body, offset, thick, pressure in zip(bodies, offsets, radius, of_ends, strict=True):
                    if body < 0 or not floats[body]:
                        of_obstacle.append(jnp.ones_like(thick))
                        continue
                    arm = poses.frames[body] @ offset
                    distance, normal = jax.value_and_grad(obstacle.at)(poses.positions[body] + arm)
                    force = pressure * normal
                    total = total.at[body].add(jnp.concatenate([force, jnp.cross(arm, force)]))
                    of_obstacle.append(distance - thick)
                gaps.append(jnp.stack(of_obstacle))
    return total[:count], jnp.concatenate(gaps) if gaps else jnp.zeros_like(pressures)


# --- the mesh --------------------------------------------------------------------------------------------------------


def _refined(
    result: HarnessEquilibrium, all_options: tuple[Options, ...], rtol: float, strain_limit: Any
) -> HarnessEquilibrium:
    """Solved again with more elements in rods of a structure of which one's estimated error is too large, until none
    is.
    """
    iterations, evaluations = int(result.iterations), int(result.evaluations)
    depths: dict[tuple[int, ...], Depth] = {}
    while bool(result.converged):
        counts, worst, all_defects = finer_meshes(result, rtol, depths)
        options = [dataclasses.replace(old, segments=count) for old, count in zip(all_options, counts, strict=True)]
        finer = {
            number: _finer(result.rod(number), all_defects[number], new)
            for number, (new, old) in enumerate(zip(options, all_options, strict=True))
            if new.segments != old.segments
        }
        if not finer:
            if worst > rtol:
                warn(
                    f"the estimated error {worst:.1e} (of the shape, or a tenth of that of forces, moments or "
                    f"curvature) of a rod is above rtol = {rtol:g} on the finest mesh",
                    NotConvergedWarning,
                )
            break
        all_options = tuple(options)
        poses = Poses(result.positions, result.frames)
        result = _solved(result.harness, poses, all_options, result, strain_limit, finer)
        iterations, evaluations = iterations + int(result.iterations), evaluations + int(result.evaluations)
    counts = jnp.asarray(iterations), jnp.asarray(evaluations)
    return eqx.tree_at(lambda result: (result.iterations, result.evaluations), result, counts)


def finer_meshes(
    result: HarnessEquilibrium, rtol: float, depths: dict[tuple[int, ...], Depth]
) -> tuple[list[int], float, dict[int, Any]]:
    """How many elements rods of one structure need, at least as many as they have; the largest estimated error, of
    several equilibria of those that converged; the defects of each rod. `depths`: how deep contacts press the rods of
    each group in, from mesh to mesh.
    """
    counts, worst, all_defects = result.segments, 0.0, {}
    axis = result.energy.ndim
    for numbers, group in zip(result.members, result.groups, strict=True):
        errors = estimated_errors(group)
        sizes = np.moveaxis(np.asarray(error_by_rtol(errors)), axis, 0)
        converged = np.moveaxis(np.asarray(group.converged), axis, 0)
        error = float(np.max(sizes[converged], initial=0.0))
        worst = max(worst, error)
        depth = depths.setdefault(numbers, Depth())
        penetration = depth.lacking(errors, counts[numbers[0]], np.asarray(group.converged))
        for place, number in enumerate(numbers):
            defects = None if errors.defects is None or axis else errors.defects[place]
            if penetration and defects is not None and errors.depths is not None:
                defects = SAFETY * error / rtol * normalized(defects) + penetration * normalized(errors.depths[place])
            all_defects[number] = defects
            # As many as the neediest: each size of mesh would be a larger program.
            if max(SAFETY * error / rtol, penetration) > 1 and counts[number] < SIZES["hermite"][-1]:
                counts[number] = next_size(counts[number], max(error, penetration * rtol / SAFETY), rtol, "hermite")
    return counts, worst, all_defects


# --- derivatives -----------------------------------------------------------------------------------------------------


def differentiable_harness(harness: Harness, result: HarnessEquilibrium) -> HarnessEquilibrium:
    """What a search found, with the derivatives by the harness that the search for it has not."""
    return result if is_known(harness) else _differentiable(harness, result)


def differentiable_by(subject: Scene | Harness, result: Solution) -> Any:
    """The same of a scene or a harness."""
    if isinstance(subject, Harness):
        assert isinstance(result, HarnessEquilibrium)
        return differentiable_harness(subject, result)
    assert isinstance(result, Equilibrium)
    return differentiable(subject, result)


@eqx.filter_custom_jvp
def _differentiable(harness: Harness, result: HarnessEquilibrium) -> HarnessEquilibrium:
    return result


@_differentiable.def_jvp
def _(primals, tangents):
    harness, result = primals
    change = with_zeros(tangents[0], harness)
    value = _differentiable(harness, result)
    return value, _change_of_result(*jax.lax.optimization_barrier((harness, value)), change)


@linear
def _change_of_result(harness: Harness, result: HarnessEquilibrium, change: Harness) -> HarnessEquilibrium:
    """By the implicit function theorem on the balance of the bodies, as functions of their poses; the rods between
    clamps at these have derivatives of their own.
    """
    fixed = jax.lax.stop_gradient(harness)
    others = Bodies.of(fixed)
    count = len(harness.bodies)

    def poses(harness: Harness, motions: Float[Array, "k"]) -> Poses:
        bodies = Bodies.of(harness)
        positions, frames = bodies.followed(others, result.positions, result.frames)
        each = (bodies.motions @ motions).reshape(count, 6)
        return Poses(positions + each[:, :3], rotated(frames, each[:, 3:]))

    touching = touching_rods(*jax.lax.stop_gradient((harness, result.groups, result.rod_pressures)), result.members)

    def rods_at(harness: Harness, motions: Float[Array, "k"], touches: Float[Array, "t"]) -> list[Equilibrium]:
        there, found = poses(harness, motions), []
        for number, (numbers, group) in enumerate(zip(result.members, result.groups, strict=True)):
            scenes = _stack([clamped(harness.scenes[k], harness, *there) for k in numbers])
            if touching is not None:
                scenes = touching.loaded(scenes, number, touches)
            found.append(differentiable(scenes, group))
        return found

    is_closed = jax.lax.stop_gradient(result.end_pressures > 0)

    def out_of_balance(harness: Harness, unknown: Unknown) -> Float[Array, "k+t+c"]:
        """Of the bodies, what contacts between rods lack, and the gaps of bodies that are closed, pressures where they
        are open.
        """
        motions, touches, pressures = unknown
        bodies, there = Bodies.of(harness), poses(harness, motions)
        rods = rods_at(harness, motions, touches)
        forces = body_forces(harness, rods, bodies, there, result.members)
        pushes, gaps = contact_forces(harness, result.members, there, pressures)
        balance = bodies.motions.T @ (forces + pushes).reshape(-1)
        lacking = touches if touching is None else touching.lacking(rods, touches)
        return jnp.concatenate([balance, lacking, jnp.where(is_closed, gaps, pressures)])

    def whole(harness: Harness, unknown: Unknown) -> HarnessEquilibrium:
        motions, touches, pressures = unknown
        rods, there, bodies = rods_at(harness, motions, touches), poses(harness, motions), Bodies.of(harness)
        rod_pressures = result.rod_pressures if touching is None else touching.pressures(result.rod_pressures, touches)
        return dataclasses.replace(
            result,
            groups=tuple(rods),
            positions=there.positions,
            frames=there.frames,
            energy=_energy(rods, bodies, there),
            contact_forces=contact_forces(harness, result.members, there, pressures)[0][:, :3],
            end_pressures=pressures,
            rod_pressures=rod_pressures,
            harness=harness,
        )

    touches = jnp.zeros(0, result.positions.dtype) if touching is None else touching.values
    nowhere = jnp.zeros(len(others.columns), result.positions.dtype), touches, result.end_pressures
    stiffness = jax.jacfwd(lambda unknown: out_of_balance(harness, unknown))(nowhere)
    stiffness = jnp.concatenate(stiffness, axis=1)
    _, lacking = jax.jvp(lambda harness: out_of_balance(harness, nowhere), (harness,), (change,))
    sizes = np.cumsum([len(part) for part in nowhere])
    unknown = tuple(jnp.split(_solved_with_contacts(stiffness, -lacking, *sizes[:2]), sizes[:2]))
    _, found = jax.jvp(whole, (harness, nowhere), (change, unknown))
    return jax.tree.map(lambda leaf: None if leaf.dtype == jax.dtypes.float0 else leaf, found)


def _solved_with_contacts(
    matrix: Float[Array, "k+t+c k+t+c"], right: Float[Array, "k+t+c"], bodies: int, count: int
) -> Float[Array, "k+t+c"]:
    """Where contacts of several rods with a body are one, who bears it is undetermined: softened, and what that gives
    way by asked for again. `bodies`: how many unknowns are motions of these; `count`: how many are no pressures.
    """
    if len(right) == count:
        return jnp.linalg.solve(matrix, right) if count else right
    stiffest = jnp.max(jnp.abs(jnp.diagonal(matrix)[:bodies]))
    is_pressure = np.arange(len(right)) >= count
    soft = matrix + jnp.diag(jnp.where(is_pressure, ENDS_COMPLIANCE / stiffest, 0.0).astype(right.dtype))
    found = jnp.linalg.solve(soft, right)
    for _ in range(ENDS_HARDENINGS):
        found += jnp.linalg.solve(soft, right - matrix @ found)
    return found


def body_forces(
    harness: Harness, rods: list[Equilibrium], bodies: Bodies, poses: Poses, members: Members
) -> Float[Array, "j 6"]:
    """Forces [N] and moments about their positions [N m] on the bodies, of rods, springs and dead loads, global axes:
    what supports hold against.
    """
    count = len(harness.bodies)
    total = jnp.zeros((count + 1, 6), poses.positions.dtype)
    frames = jnp.pad(poses.frames, ((0, 1), (0, 0), (0, 0)))
    for numbers, group in zip(members, rods, strict=True):
        body, _, offset = ends_of(harness, numbers)
        of_ends = (group.start_force, group.start_moment), (group.end_force, group.end_moment)
        for end, (sign, (force, moment)) in enumerate(zip((1, -1), of_ends, strict=True)):
            arms = jnp.einsum("kij,kj->ki", frames[body[:, end]], offset[:, end])
            about = moment + jnp.cross(arms, force)
            total = total.at[body[:, end]].add(sign * jnp.concatenate([force, about], axis=1))

    def energy(motions: Float[Array, "j 6"]) -> Float[Array, ""]:
        there = poses.positions + motions[:, :3], rotated(poses.frames, motions[:, 3:])
        return jnp.sum(bodies.energies(*there, motions[:, 3:]))

    return total[:count] - jax.grad(energy)(jnp.zeros((count, 6), total.dtype))
