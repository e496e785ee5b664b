"""The equilibrium of a harness: of all its rods, and of the bodies in which they end."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import instance, is_known, leaf
from rodjax.discretization.first_twist import FirstTwist
from rodjax.discretization.forms import form_of
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm
from rodjax.discretization.sliding_point import SlidingPoint
from rodjax.model.harness import (
    Bodies,
    Harness,
    clamp_at,
    clamped,
    joint_ends,
    of_one_rod,
)
from rodjax.model.loads import ContactLoads
from rodjax.model.scene import Scene, has_contacts, has_friction, nondimensional, slid, slides, under_contact
from rodjax.model.supports import Clamp, Joint
from rodjax.programs.compilation import compiled
from rodjax.solving.assembly import Assembly, Poses, Rods, State
from rodjax.solving.assembly_newton import find_assembly
from rodjax.solving.equilibrium import (
    DEFAULT_RTOL,
    MOST_MESHES,
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
    on_mesh_of,
    on_one_side,
    sliding_search,
)
from rodjax.solving.first_poses import Shapes, first_poses
from rodjax.solving.guess import Guess
from rodjax.solving.harness_derivatives import differentiable_harness
from rodjax.solving.harness_forces import (
    contact_forces,
    ends_of,
    energy_of,
    no_pressures,
    no_rod_pressures,
    split_pressures,
    stacked,
)
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.implicit import not_differentiated
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
from rodjax.solving.rod_contact import Members, in_contact, pairs_of, split_by_pairs
from rodjax.solving.status import Outcome, Status, is_converged
from rodjax.units import Units
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
    result = _solved(fixed, poses, tuple(all_options), earlier, strain_limit, shapes=shapes)
    if is_known(result.status) and is_here(result.groups[0]):
        if segments is None:
            result = _refined(
                result, tuple(all_options), DEFAULT_RTOL if tolerance is None else tolerance, strain_limit
            )
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
    if is_given:
        for group in result.groups:
            warn_if_coarse(group)
    if not bool(result.converged):
        warn(result.in_words().splitlines()[0], NotConvergedWarning)
        return
    for rod in result.groups:
        warn_of_outcome(rod, strain_limit)


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


def _solved(
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
                rod = shapes[number] if guess is None else guess.rod(number)
                if finer is not None and number in finer:
                    assert isinstance(rod, Equilibrium)
                    each.append((finer[number], last_twist(rod)))
                else:
                    scene = _touchable(harness, number, harness.scenes[number], options.segments)
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
    return _solve(harness, poses, tuple(starts), pressures, of_rods, is_wide, strain_limit, options, members=members)


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
    wide_wells: Bool[Array, "c"],
    strain_limit: Float[Array, ""] | float,
    options: tuple[Options, ...],
    members: Members,
) -> HarnessEquilibrium:
    groups, points, all_searches, at_ends = [], [], [], []
    of_groups = split_pressures(harness, members, end_pressures)
    for numbers, (states, firsts), option, pressures in zip(members, starts, options, of_groups, strict=True):
        elements = option.segments
        scenes = stacked(
            [_touchable(harness, k, clamped(harness.scenes[k], harness, *poses), elements) for k in numbers]
        )

        def begin(scene: Scene, state: SolverState, first: FirstTwist, option: Options = option) -> Search:
            scaled, state = in_units_of(scene, state)
            of_kind = sliding_search if slides(scene) else Search.of
            return of_kind(scaled, state, first, option)

        searches = jax.vmap(begin)(scenes, states, firsts)
        body, frame, offset = ends_of(harness, numbers)
        groups.append(Rods(searches.form, searches.shape, searches.units, body, frame, offset))
        points.append(searches.point)
        all_searches.append((searches, states))
        at_ends.append(None if pressures is None else pressures / searches.units.force[:, None, None])
    bodies, pairs = Bodies.of(harness), pairs_of(harness.contact, members)
    assembly = Assembly.of(tuple(groups), bodies, pairs)
    counts = [option.segments for option in options]
    between = split_by_pairs(pairs, counts, rod_pressures / assembly.force)
    is_wide = split_by_pairs(pairs, counts, wide_wells)
    solver = options[0].solver
    assert isinstance(solver, Newton)
    start = assembly.begin(tuple(points), tuple(at_ends), between, is_wide, poses)
    is_cold = functools.reduce(jnp.logical_and, [jnp.all(states.end_force == 0) for states, _ in starts])
    if any(isinstance(group.form, SlidingForm) for group in groups):
        assembly, end = _slid(assembly, start, solver, options, is_cold)
    else:
        end = find_assembly(assembly, start, solver, options[0].find, is_cold)
    return harness_equilibrium(harness, members, assembly, end, end_pressures, strain_limit, tuple(all_searches))


def _slid(
    assembly: Assembly, begin: State, solver: Newton, options: tuple[Options, ...], is_cold: Array
) -> tuple[Assembly, State]:
    """What is found where rods slide through clips. Their meshes go along with these; where one was stretched by that,
    or another one belongs to where the clips have come, the search goes on from there on meshes that are made anew.
    """
    first = [group.shape for group in assembly.groups]

    def anew(groups: tuple[Rods, ...], state: State) -> tuple[tuple[Rods, ...], State]:
        made, points = list(groups), list(state.points)
        forms = dataclasses.replace(assembly, groups=groups).forms(state.poses)
        for number, form in enumerate(forms):
            if isinstance(form, SlidingForm):
                parts = form, state.points[number], groups[number].units, first[number]
                found = jax.vmap(functools.partial(_made_anew, options=options[number]))(*parts)
                made[number] = dataclasses.replace(groups[number], form=found.form, shape=found.shape)
                points[number] = found.point
        return tuple(made), state._replace(points=tuple(points))

    def search(last: tuple[tuple[Rods, ...], State, Array, Array]) -> tuple[tuple[Rods, ...], State, Array, Array]:
        groups, state, count, _ = last
        made = anew(groups, state)
        groups, state = jax.tree.map(lambda old, new: jnp.where(count == 0, old, new), (groups, state), made)
        here = dataclasses.replace(assembly, groups=groups)
        again = here.begin(state.points, state.at_ends, state.pairs, state.is_wide, state.poses)
        begin = again._replace(iterations=state.iterations, evaluations=state.evaluations)
        end = find_assembly(here, begin, solver, options[0].find, is_cold & (count == 0))
        goes_on = jnp.array(False)
        for form, points in zip(here.forms(end.poses), end.points, strict=True):
            if isinstance(form, SlidingForm):
                misplaced = jax.vmap(lambda form, point: form.is_misplaced(point))(form, points)
                goes_on |= is_converged(end.status) & jnp.any(misplaced)
                is_blocked = jax.vmap(lambda form, point: form.is_blocked(point))(form, points)
                goes_on |= False if is_blocked is None else jnp.any(is_blocked)
        status = jnp.where(goes_on & (count == MOST_MESHES - 1), Status.MAX_ITERATIONS, end.status)
        return groups, end._replace(status=status), count + 1, goes_on

    start = assembly.groups, begin, jnp.zeros((), int), jnp.array(True)
    groups, end, _, _ = jax.lax.while_loop(lambda last: last[3] & (last[2] < MOST_MESHES), search, start)
    return dataclasses.replace(assembly, groups=groups), end


def _made_anew(form: SlidingForm, point: SlidingPoint, units: Units, mesh: Shape, options: Options) -> Search:
    """On a mesh like that of a shape, for a rod with its ends where the bodies are."""
    scene, reached = slid(form.scene, point.arclengths), form.at(point.arclengths)
    shape = on_mesh_of(scene, form.shape.reached(reached, reached.settled(point.inner)), mesh)
    state = SolverState(shape, point.end_force, units, point.arclengths, **_of_contacts(scene, point))
    return sliding_search(scene, state, FirstTwist(point.total_twist), options)


def _of_contacts(scene: Scene, point: Any) -> dict[str, Any]:
    """What a state has of them."""
    if not has_contacts(scene):
        return {}
    return {"pressures": point.nodal.pressures, "friction": point.nodal.friction}


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
        now = stacked([clamped(harness.scenes[k], harness, *end.poses) for k in numbers])
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
    wide_wells = jnp.concatenate([jnp.zeros(0, bool), *(is_wide.reshape(-1) for is_wide in end.is_wide)])
    status = end.status
    for rod in rods:
        # A strain beyond the limit in one of them is said of the whole.
        worst = jnp.max(jnp.where(rod.status == end.status, end.status, rod.status))
        status = jnp.where(is_converged(status), jnp.where(worst == end.status, status, worst), status)
    return HarnessEquilibrium(
        groups=tuple(rods),
        positions=end.poses.positions,
        frames=end.poses.frames,
        energy=energy_of(rods, bodies, end.poses),
        converged=is_converged(status),
        stable=is_stable,
        index=end.negative if harness.has_potential else jnp.full_like(end.negative, -1),
        status=status,
        iterations=end.iterations,
        evaluations=end.evaluations,
        residual=end.residual,
        contact_forces=contact_forces(harness, members, end.poses, end_pressures)[0][:, :3],
        end_pressures=end_pressures,
        rod_pressures=rod_pressures,
        wide_wells=wide_wells,
        harness=harness,
        members=members,
    )


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
        arclengths = None
        if isinstance(rod.form, SlidingForm):
            arclengths, made = point.arclengths, slid(scaled, rod.form.made_at)
            form, point = SlidingForm.of(made, rod.shape).at(arclengths), point.inner
        else:
            form = form_of(scaled, rod.shape)
        if point.nodal is not None:
            # From the units of the search, whose origin is where the rod began.
            positions = point.nodal.positions + (rod.units.origin - units.origin)[None] / units.length
            point = dataclasses.replace(point, nodal=dataclasses.replace(point.nodal, positions=positions))
        point = form.settled(form.holding(point))
        shape = rod.shape.reached(form, point)
        state = SolverState(shape, point.end_force, units, arclengths, **_of_contacts(scene, point))
        outcome = Outcome(residual, end.iterations, end.evaluations, end.status)
        found = Found(state, point, outcome, is_stable)
        if scene.obstacles:
            assert search is not None
            assert begin is not None
            if isinstance(search.form, SlidingForm):
                assert isinstance(search.point, SlidingPoint)
                search = dataclasses.replace(search, form=search.form.first, point=search.point.inner)
            found = on_one_side(search, form, found, begin.before)
        return build_result(scene, found, jnp.ones((), int), strain_limit)

    return jax.vmap(one)(scenes, rods, *begun, end.points[group], end.residuals[group])


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
