"""The compiled search for the equilibrium of a harness on given meshes, from starts of its rods to its result."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.first_twist import FirstTwist
from rodjax.discretization.forms import form_of
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm
from rodjax.discretization.sliding_point import SlidingPoint
from rodjax.model.harness import Bodies, Harness, clamped
from rodjax.model.scene import Scene, has_contacts, nondimensional, slid, slides, under_contact
from rodjax.programs.compilation import compiled
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, Poses, Rods, State
from rodjax.solving.assembly_newton import find_assembly
from rodjax.solving.harness_forces import contact_forces, ends_of, energy_of, split_pressures, stacked
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.harness_rods import touchable
from rodjax.solving.newton import Newton
from rodjax.solving.options import Options
from rodjax.solving.result import Equilibrium, build_result
from rodjax.solving.rod_contact import Members, pairs_of, split_by_pairs
from rodjax.solving.search import MOST_MESHES, Search, in_units_of, on_mesh_of, on_one_side, sliding_search
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.status import Outcome, Status, is_converged
from rodjax.units import Units


@functools.partial(compiled, static_argnames=("members",))
def find_harness(
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
            [touchable(harness, k, clamped(harness.scenes[k], harness, *poses), elements) for k in numbers]
        )

        def begin(scene: Scene, state: SolverState, first: FirstTwist, option: Options = option) -> Search:
            scaled, state = in_units_of(scene, state)
            of_kind = sliding_search if slides(scene) else Search.of
            return of_kind(scaled, state, first, option)

        searches = of_each(begin)(scenes, states, firsts)
        body, frame, offset = ends_of(harness, numbers)
        groups.append(Rods(searches.form, searches.shape, searches.units, body, frame, offset))
        points.append(searches.point)
        all_searches.append((searches, states))
        at_ends.append(None if pressures is None else pressures / searches.units.force[:, None, None])
    counts = [option.segments for option in options]
    bodies, pairs = Bodies.of(harness), pairs_of(harness.contact, members, counts)
    assembly = Assembly.of(tuple(groups), bodies, pairs)
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
                found = of_each(functools.partial(_made_anew, options=options[number]))(*parts)
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
                misplaced = of_each(lambda form, point: form.is_misplaced(point))(form, points)
                goes_on |= is_converged(end.status) & jnp.any(misplaced)
                is_blocked = of_each(lambda form, point: form.is_blocked(point))(form, points)
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
    groups, bodies = assembly.groups, assembly.bodies
    loads = assembly.contact_loads(assembly.contacts(end))
    is_stable = is_converged(end.status) & (end.negative == 0) & harness.has_potential
    rods = []
    for number, (rod, numbers, begun) in enumerate(zip(groups, members, all_begun, strict=True)):
        now = stacked([clamped(harness.scenes[k], harness, *end.poses) for k in numbers])
        if number in loads:
            now = under_contact(now, loads[number].times(assembly.force, assembly.energy))
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

    return of_each(one)(scenes, rods, *begun, end.points[group], end.residuals[group])
