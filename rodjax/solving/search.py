"""The search for an equilibrium of one scene, from the state where it begins to where the solver stops."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.first_twist import FirstTwist
from rodjax.discretization.form import Form, Point
from rodjax.discretization.forms import field_of, form_of
from rodjax.discretization.frame_point import FramePoint
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.hermite import Curve, QuadraticRotationElements
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.mechanics.passage import Before, passage
from rodjax.model.plane import is_planar, plane
from rodjax.model.scene import (
    Scene,
    has_contacts,
    has_node_positions,
    has_potential,
    nondimensional,
    slid,
    slides,
    sliding_arclengths,
)
from rodjax.solving.loading import found_under_loads
from rodjax.solving.newton import Find, Newton, NewtonEnd, find_equilibrium, is_stable
from rodjax.solving.nonlinear_cg import minimize
from rodjax.solving.options import Options
from rodjax.solving.penetration import sampled
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.status import Outcome, Status, is_converged
from rodjax.units import Units

# Shapes that differ by so many roundings are the same.
SAME_SHAPE = 64
# On so many meshes at most a rod slides through its clips.
MOST_MESHES = 12


def solve_from(scene: Scene, state: SolverState, first: FirstTwist, options: Options) -> Found:
    """The one code path of every solve: from a state to where the solver stops."""
    # To the same bits, whatever is made of it in the same program.
    find = _slid if slides(scene) else _found
    return jax.lax.optimization_barrier(find(*in_units_of(scene, state), first, options))


def in_units_of(scene: Scene, state: SolverState) -> tuple[Scene, SolverState]:
    """The scene, nondimensional, and a state in its units."""
    scaled, units = nondimensional(scene)
    return scaled, in_units(state, units)


class Search(eqx.Module):
    """Where Newton's method begins: the form it makes stationary, the first point, and the shape that belongs to it.

    `normal`: of the plane in which it stays, if it does.
    """

    form: Form
    point: Point
    shape: Shape
    units: Units
    is_within_plane: Bool[Array, ""] | None
    normal: Float[Array, "3"] | None

    @staticmethod
    def of(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> "Search":
        form = form_of(scene, guess.shape)
        shape, point = first_point(form, guess, first)
        if not options.planar:
            return Search(form, point, shape, guess.units, None, None)
        normal, axes = plane(scene, point.tangents)
        within = is_planar(scene, first.total_twist)
        return Search(*form.in_plane(point, normal, axes), shape, guess.units, within, normal)

    def found(self, end: NewtonEnd) -> Found:
        point, outcome, stable = self.form.settled(end.point), end.outcome, end.is_stable
        start, reached = self.shape, self.shape.reached(self.form, point)
        # An unchanged scene gives back the same bits. (A straight rod under another pull takes no iteration either.)
        is_same = start.change_to(reached) <= SAME_SHAPE * jnp.finfo(reached.nodes.dtype).eps
        is_start = (outcome.iterations == 0) & is_same
        shape = jax.tree.map(lambda old, new: jnp.where(is_start, old, new), start, reached)
        if self.normal is not None and self.is_within_plane is not None:
            stable &= is_stable(self.form.out_of_plane(self.normal), point)
            # Inside a user's own jit the scene could not be checked before.
            within = self.is_within_plane & (self.form.stays_in_plane(point) | ~is_converged(outcome.status))
            status = jnp.where(within, outcome.status, Status.NOT_PLANAR)
            outcome = eqx.tree_at(lambda outcome: outcome.status, outcome, status)
        arclengths = sliding_arclengths(self.form.scene)
        pressures, friction = (
            (point.nodal.pressures, point.nodal.friction) if has_contacts(self.form.scene) else (None, None)
        )
        state = SolverState(shape, point.end_force, self.units, arclengths, pressures=pressures, friction=friction)
        return Found(state, point, outcome, stable)


def _found(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> Found:
    solver = options.solver
    if isinstance(solver, Newton):
        search = Search.of(scene, guess, first, options)
        found = search.found(_sought(search.form, search.point, guess, solver, options.find))
        return on_one_side(search, search.form, found, guess.before) if scene.obstacles else found
    assert isinstance(guess.shape, Polyline)
    problem, start = FiniteDifference.begin(scene, guess.shape, first)
    minimum = minimize(problem, start, solver)
    point = minimum.problem.mixed_point(minimum.point)
    stable = is_stable(MixedForm.of(scene, field_of(scene, guess.shape)), point)
    return Found(SolverState(minimum.point, point.end_force, guess.units), point, minimum.outcome, stable)


def _sought(form: Form, point: Point, guess: SolverState, solver: Newton, find: Find) -> NewtonEnd:
    """Where the search ends that begins at a point."""
    if not has_potential(form.scene) and (has_node_positions(form.scene) or slides(form.scene)):
        return found_under_loads(form, point, solver, find, jnp.all(guess.end_force == 0))
    return find_equilibrium(form, point, solver, find)


def on_one_side(search: Search, form: Form, found: Found, before: Before | None) -> Found:
    """Not converged where the rod came through an obstacle on the way, or lies within one; `form`: of what was found.

    No step of the search leads through. So a rod that begins on the side of all obstacles where it last was sound has
    stayed there, however far it slid around one; of others the shape in the end is compared with the last sound one.
    """
    begun = search.form
    assert isinstance(begun, NodalForm)
    assert isinstance(form, NodalForm)
    assert before is not None
    assert search.point.nodal is not None
    positions = search.point.nodal.positions
    begin = sampled(begun, search.point, positions, search.units)
    now = sampled(form, found.point, found.state.shape.nodes, found.state.units)
    before = dataclasses.replace(before, points=jnp.where(jnp.isnan(before.points), begin.points, before.points))
    passed = passage(before, now)

    def stayed() -> Bool[Array, ""]:
        return passage(before, begin).is_sound & ~passed.lies_within

    is_sound = jax.lax.cond(passed.is_sound, lambda: jnp.array(True), stayed)
    converged = is_converged(found.outcome.status)
    status = jnp.where(converged & ~is_sound, Status.PASSED_THROUGH, found.outcome.status)
    kept = jax.tree.map(lambda new, old: jnp.where(converged & is_sound, new, old), now.before, before)
    return eqx.tree_at(
        lambda found: (found.outcome.status, found.state.before),
        found,
        (status, kept),
        is_leaf=lambda value: value is None,
    )


def _slid(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> Found:
    """The same where the rod slides through clips: their arclengths are unknowns.

    The mesh goes along with them. Where it was stretched by that, or another one belongs to where they have come, the
    search goes on from there on a mesh that is made anew.
    """
    scene, guess, point = _with_first_turns(scene, guess, first)

    def search(last: _Sliding) -> _Sliding:
        state = last.found.state
        assert state.arclengths is not None
        here = slid(scene, state.arclengths)
        anew = on_mesh_of(here, state.shape, guess.shape)
        shape = jax.tree.map(lambda old, new: jnp.where(last.count == 0, old, new), state.shape, anew)
        state = dataclasses.replace(state, shape=shape)
        found, goes_on = _slid_once(here, state, FirstTwist(last.found.point.total_twist), options)
        before, after = last.found.outcome, found.outcome
        count = last.count + 1
        outcome = Outcome(
            after.residual,
            before.iterations + after.iterations,
            before.evaluations + after.evaluations,
            jnp.where(goes_on & (count == MOST_MESHES), Status.MAX_ITERATIONS, after.status),
        )
        return _Sliding(dataclasses.replace(found, outcome=outcome), count, goes_on)

    count = jnp.zeros((), int)
    nothing = Outcome(jnp.zeros_like(point.total_twist), count, count, count)
    begin = _Sliding(Found(guess, point, nothing, jnp.array(False)), count, jnp.array(True))
    return jax.lax.while_loop(lambda last: last.goes_on & (last.count < MOST_MESHES), search, begin).found


def _with_first_turns(scene: Scene, guess: SolverState, first: FirstTwist) -> tuple[Scene, SolverState, Point]:
    """A scene without turns, which are those of the first shape, that shape, and the point there."""
    assert guess.arclengths is not None
    shape, point = first_point(form_of(slid(scene, guess.arclengths), guess.shape), guess, first)
    if scene.turns is not None:
        guess = dataclasses.replace(guess, shape=shape.with_unknowns(point))
        scene = eqx.tree_at(lambda scene: scene.turns, scene, None)
    return scene, guess, point


class _Sliding(eqx.Module):
    """What has been found on so many meshes, and whether another one is needed."""

    found: Found
    count: Int[Array, ""]
    goes_on: Bool[Array, ""]


def _slid_once(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> tuple[Found, Bool[Array, ""]]:
    """What a search finds on one mesh, and whether it is to go on on another one."""
    assert isinstance(options.solver, Newton)
    search = Search.of(scene, guess, first, options)
    form, point = _with_arclengths(search, scene, guess, options)
    end = _sought(form, point, guess, options.solver, options.find)
    assert isinstance(end.point, SlidingPoint)
    reached = dataclasses.replace(search, form=form.at(end.point.arclengths))
    found = reached.found(dataclasses.replace(end, point=end.point.inner))
    if scene.obstacles:
        found = on_one_side(search, reached.form, found, guess.before)
    goes_on = is_converged(end.outcome.status) & form.is_misplaced(end.point)
    is_blocked = form.is_blocked(end.point)
    return found, goes_on if is_blocked is None else goes_on | is_blocked


def sliding_search(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> Search:
    """Where a search begins whose unknowns are the arclengths of sliding clips too."""
    scene, guess, point = _with_first_turns(scene, guess, first)
    assert guess.arclengths is not None
    scene = slid(scene, guess.arclengths)
    search = Search.of(scene, guess, FirstTwist(point.total_twist), options)
    form, point = _with_arclengths(search, scene, guess, options)
    return dataclasses.replace(search, form=form, point=point)


def _with_arclengths(
    search: Search, scene: Scene, guess: SolverState, options: Options
) -> tuple[SlidingForm, SlidingPoint]:
    """The form and point of a search with the arclengths of sliding clips, from a scene with its clips at those."""
    assert guess.arclengths is not None
    descends = options.find == "minimum"
    form = SlidingForm(scene=scene, made=scene, shape=search.shape, first=search.form, descends=descends)  # pyright: ignore
    is_warm = jnp.any(guess.end_force != 0)
    return form, SlidingPoint(search.point, guess.arclengths, is_warm, jnp.zeros_like(guess.arclengths))


def on_mesh_of(scene: Scene, shape: Shape, other: Shape) -> Shape:
    """A shape on the mesh of another one, as a scene has it."""
    if isinstance(shape, Curve) and isinstance(other, Curve):
        return shape.on(form_of(scene, shape.on(other.s)).field.s)
    if isinstance(shape, FramedCurve) and isinstance(other, FramedCurve):
        nodes = form_of(scene, shape.on(other.s, of_joints=False)).field.s
        return shape.on(nodes, of_joints=False)
    return shape


def first_point(form: Form, guess: SolverState, first: FirstTwist) -> tuple[Shape, Point]:
    """The shape from which to seek the solution, and the same as the unknowns of its form."""
    scene, shape, field = form.scene, guess.shape, form.field
    end_force = form.layout.forces(form.layout.components(guess.end_force))
    if isinstance(form, FrameForm):
        assert isinstance(shape, FramedCurve)
        point = form.holding(FramePoint(shape.turned_to_ends(form, first), end_force, first.total_twist))
        return shape, form.begun(point, shape.nodes, guess.pressures, guess.friction)
    assert isinstance(form, MixedForm)
    if isinstance(shape, Curve):
        assert isinstance(field, QuadraticRotationElements)
        tangents = field.apply_prescribed(scene, shape.turned_to_ends(scene, field.arclengths))
    else:
        assert isinstance(shape, Polyline)
        if not scene.clips:
            problem, start = FiniteDifference.begin(scene, shape, first)
            return start, eqx.tree_at(lambda point: point.end_force, problem.mixed_point(start), end_force)
        tangents = shape.tangents
    point = MixedPoint(tangents, end_force, form.first_twist(shape, tangents, first))
    return shape, form.begun(point, shape.nodes, guess.pressures, guess.friction)


def in_units(state: SolverState, units: Units) -> SolverState:
    """The unknowns in other units; unchanged to the last bit where the units are the same."""
    shape = state.shape.in_units(state.units.length / units.length, (state.units.origin - units.origin) / units.length)
    force = state.end_force * (state.units.force / units.force)
    pressures = None if state.pressures is None else state.pressures * (state.units.force / units.force)
    friction = state.friction
    if friction is not None:
        forces = friction.forces * (state.units.force / units.force)
        friction = dataclasses.replace(friction, forces=forces)
    return SolverState(
        shape, force, units, state.arclengths, before=state.before, pressures=pressures, friction=friction
    )
