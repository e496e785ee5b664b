"""Newton's method on the mixed form: independent of mesh and slenderness, and safeguarded to end in a minimum."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import not_negative, plain_number, whole_number
from rodjax.discretization.form import NEUTRAL, Form, HeldLoads, Linearization, Point
from rodjax.discretization.joints import generic_field
from rodjax.geometry.vectors import components, dot
from rodjax.linalg.saddle_point import factor
from rodjax.model.scene import has_node_positions, scene_axes
from rodjax.solving.status import Outcome, Status


class Newton(eqx.Module):
    """Newton's method with tangents of the edges and the force through the rod as unknowns.

    A step solves the linearised equilibrium. Where the energy has negative curvature the Hessian is shifted until it
    has none. A step is shortened until an augmented Lagrangian falls: energy, closure constraint of the polyline and
    its square; loads without a potential do the work of what they are before the step.

    **Arguments:**

    - `tolerance`: largest force on a node, in units of EI/L^2, at which a solve has converged. Where the rounding of
        the mesh does not let it fall so far, that floor is the tolerance, and the status says so.
    - `max_iterations`: iterations after which a solve is given up.
    - `max_rotation` [rad]: the most by which a step may turn a tangent; below pi, as the total twist is carried along.
    """

    tolerance: float = eqx.field(default=1e-8, converter=plain_number("tolerance"))
    max_iterations: int = 100
    max_rotation: float = eqx.field(default=1.0, converter=plain_number("max_rotation"))

    def __check_init__(self):
        not_negative(self.tolerance, "tolerance")
        whole_number(self.max_iterations, "max_iterations", 1, 10**9)
        if not 0.0 < self.max_rotation < 3.0:
            raise ValueError(f"max_rotation must lie between 0 and 3 rad, got {self.max_rotation!r}")


# What is sought: a minimum of the energy, or the equilibrium that Newton's steps lead to, whatever its stability.
Find = Literal["minimum", "equilibrium"]

# Where the shift by NEUTRAL is not enough, it starts with the force that is out of balance, between these two, and
# grows by SHIFT_GROWTH until the Hessian is definite. Later steps start with less than the last one had, down to
# LEAST_SHIFT: under a shift much larger than the negative curvature a search crawls.
FIRST_SHIFT, MOST_FIRST_SHIFT = 1.0, 64.0
LEAST_SHIFT = 1e-3
SHIFT_GROWTH = 4.0
MAX_FACTORS = 30
# Weight of the squared constraint residual in the augmented Lagrangian [EI/L^3]: about the stiffness of a bent rod.
CLOSURE_WEIGHT = 100.0
# A step is accepted when this fraction of the fall that its slope promises comes true, up to the rounding of energies.
SUFFICIENT_DECREASE = 1e-4
ENERGY_ROUNDING, UNITS_OF_ROUNDING = 1e-9, 32  # the larger one: the latter in single precision
# Under loads without a potential a whole step is accepted as well when it makes the square of what is out of balance
# less by this part.
FALL_OF_SQUARE = 0.2
MAX_HALVINGS = 12
# A step that finds no better point in so many halvings is sought anew with a larger shift, below this one.
MAX_SHIFT = 1e8
# A saddle, such as a planar shape in a symmetric scene, is left along its negative curvature by a push of this size
# [rad], at most so many times, where the residual is below NEAR times the shift: with a shift Newton's method crawls. A
# search that fails within STAGNATION times the rounding floor has met that floor.
PUSH = 0.03
NEAR = 1e-3
MAX_PUSHES = 5
STAGNATION = 10.0


class NewtonEnd(eqx.Module):
    """Where the method stopped. `is_stable`: whether the energy has no negative curvature there."""

    point: Any
    outcome: Outcome
    is_stable: Bool[Array, ""]


class NewtonState(eqx.Module):
    """What a turn leaves to the next one."""

    # The last accepted point, and the step from it.
    point: Point
    bases: Float[Array, "3 b n"]
    residual: Float[Array, ""]
    floor: Float[Array, ""]  # what rounding leaves of the residual
    shift: Float[Array, ""]
    last_shift: Float[Array, ""]  # of the last step that needed more than NEUTRAL
    rotation: Float[Array, "b n"]
    force_change: Float[Array, "3 parts"]
    others: Any  # what else it changes, as of `Form.others`
    # Of the point, where steps are judged with loads held: these, and the square of what is out of balance.
    loads: HeldLoads | None
    squares: Float[Array, ""] | None
    # The augmented Lagrangian at the point with the new force, its slope along the step, and the fraction of it to try.
    weight: Float[Array, ""]
    merit: Float[Array, ""]
    slope: Float[Array, ""]
    step: Float[Array, ""]
    halvings: Int[Array, ""]
    restart: Bool[Array, ""]  # the next trial is the point itself
    tries: Int[Array, ""]  # factorisations at the point that showed negative curvature
    is_pushed: Bool[Array, ""]  # the step leaves a saddle, and is not judged
    pushes: Int[Array, ""]
    iterations: Int[Array, ""]
    evaluations: Int[Array, ""]
    status: Int[Array, ""]
    is_stable: Bool[Array, ""]


def is_stable(form: Form, point: Point) -> Bool[Array, ""]:
    """Whether the energy has no negative curvature at an equilibrium, neutral modes apart."""
    return factor(form.regular(form.linearized(point).system), is_regularized=True).is_minimum


def find_equilibrium(form: Form, point: Point, solver: Newton, find: Find = "minimum") -> NewtonEnd:
    """The equilibrium reached from `point`."""
    state = jax.lax.while_loop(is_running, lambda state: turn(form, state, solver, find), begin(form, point, find))
    return ended(form, state)


def is_running(state: NewtonState) -> Bool[Array, ""]:
    return state.status == Status.RUNNING


def ended(form: Form, state: NewtonState) -> NewtonEnd:
    return NewtonEnd(
        point=form.ended(state.point),
        outcome=Outcome(state.residual, state.iterations, state.evaluations, state.status),
        is_stable=state.is_stable & form.has_potential,
    )


def turn(form: Form, state: NewtonState, solver: Newton, find: Find) -> NewtonState:
    """One evaluation of all derivatives, at most one factorisation, and so the same work for every rod of a batch.

    The trial is accepted, factorised and gives the next step; or the step is halved; or, where the Hessian has negative
    curvature on the way to a minimum, it is shifted, and factorised again in the next turn.
    """
    descends = _descends(form, find)
    rotation = state.step * state.rotation
    force_change = state.force_change if descends else state.step * state.force_change
    others = form.scaled(state.others, state.step, 1.0 if descends else state.step)
    retracted = form.retract(state.point, state.bases, rotation, force_change, others)
    trial = jax.tree.map(lambda here, there: jnp.where(state.restart, here, there), state.point, retracted)
    linearization = form.linearized(trial)
    constraint_residual = form.force_components(linearization.constraint_residual)
    objective = (
        form.objective(linearization, state.point, state.others) if descends else form.half_square(linearization)
    )
    if state.loads is not None:
        objective -= state.loads.work(rotation, others)
    merit = objective + state.weight / 2 * jnp.sum(constraint_residual**2)
    promised = SUFFICIENT_DECREASE * state.step * jnp.minimum(state.slope, 0.0)
    bound = state.merit + promised + energy_rounding(state.merit)
    is_better = merit <= bound
    if state.squares is not None:
        falls = _squares(form, linearization) <= (1 - FALL_OF_SQUARE * state.step) * state.squares
        is_better |= (state.halvings == 0) & falls
    state = eqx.tree_at(lambda state: state.evaluations, state, state.evaluations + 1)
    # Out of the branches XLA computes once for all turns what does not change.
    floor = form.rounding_floor(trial)
    pattern = generic_field(trial.tangents, scene_axes(form.scene))
    return jax.lax.cond(
        state.restart | form.accepts(state.point, trial, state.is_pushed | is_better),
        lambda: _advanced(form, state, trial, linearization, floor, pattern, solver, find),
        lambda: _shortened(form, state, find),
    )


def least_shift(last: Float[Array, "*k"], first: ArrayLike = FIRST_SHIFT) -> Float[Array, "*k"]:
    """The shift that is tried first where NEUTRAL is too little [EI/L^2]: a quarter of `last`, that of the last step
    that needed more, or `first` where none did.
    """
    return jnp.where(last > NEUTRAL, jnp.clip(last / SHIFT_GROWTH, LEAST_SHIFT, FIRST_SHIFT), first)


def energy_rounding(merit: Float[Array, ""]) -> Float[Array, ""]:
    """What energies that are equal may differ by [EI/L]."""
    return max(ENERGY_ROUNDING, UNITS_OF_ROUNDING * float(jnp.finfo(merit.dtype).eps)) * (1 + jnp.abs(merit))


def _descends(form: Form, find: Find) -> bool:
    """Whether steps are judged by the energy, with the work of loads that have none; else by the square of what is out
    of balance, which a step makes less.
    """
    return find == "minimum" and (form.has_potential or form.holds_loads)


def _squares(form: Form, here: Linearization) -> Float[Array, ""]:
    closure = form.force_components(here.constraint_residual)
    return form.half_square(here) + CLOSURE_WEIGHT / 2 * jnp.sum(closure**2)


def _advanced(
    form: Form,
    state: NewtonState,
    point: Point,
    here: Linearization,
    floor: Float[Array, ""],
    pattern: Float[Array, "3 m"],
    solver: Newton,
    find: Find,
) -> NewtonState:
    point = form.accepted(point, here)
    dtype = point.tangents.dtype
    h = 1 / point.tangents.shape[1]
    iterations = state.iterations + jnp.where(state.restart, 0, 1)
    balanced = jnp.where(here.residual <= floor, Status.ROUNDING_FLOOR, Status.RUNNING)
    balanced = jnp.where(here.residual <= solver.tolerance, Status.CONVERGED, balanced)
    # Just above the floor, steps that no longer help show that it is reached.
    stagnates = (iterations > 0) & (here.residual > state.residual / 2) & (here.residual <= STAGNATION * floor)
    balanced = jnp.where(stagnates & (balanced == Status.RUNNING), Status.ROUNDING_FLOOR, balanced)
    balanced = jnp.where(form.is_closed(here.constraint_residual, solver.tolerance), balanced, Status.RUNNING)
    is_balanced = balanced != Status.RUNNING

    # Whether the point is a minimum shows without shift; on the way there the shift need not be found anew.
    least = jnp.asarray(NEUTRAL, dtype)
    first = jnp.where(is_balanced | (state.shift <= FIRST_SHIFT), least, state.shift / SHIFT_GROWTH**2)
    # Contact forces are part of what is out of balance, and where they act the negative curvature of one step tells
    # little of the next one.
    is_bending = form.has_potential and not has_node_positions(form.scene)
    of_first = jnp.clip(here.residual, FIRST_SHIFT, MOST_FIRST_SHIFT) if is_bending else FIRST_SHIFT
    of_next = jnp.where(form.touches(point), FIRST_SHIFT, least_shift(state.last_shift, of_first))
    larger = jnp.maximum(SHIFT_GROWTH * state.shift, of_next)
    shift = jnp.where(state.tries == 0, first, larger)
    is_near = is_balanced | ((here.residual <= NEAR * shift) & (state.pushes < MAX_PUSHES))
    may_push = (state.pushes == 0) | is_near
    push = jnp.where(may_push & (shift > least), PUSH * h * shift, 0.0)
    system, aside = form.shifted(here.system, h * shift), push * components(here.bases, pattern)
    is_definite, rotation, multipliers = form.sought(here, point, system, aside)
    others = form.others(multipliers)
    is_finite = jnp.isfinite(here.residual + here.energy)
    is_stable = is_definite & (shift <= least)
    if find == "minimum":
        again = ~is_definite & is_finite & (state.tries < MAX_FACTORS)
        is_pushed = is_definite & ~is_stable & may_push
        is_sought, may_go_on = is_stable, is_definite
    else:
        again = is_pushed = jnp.array(False)
        is_sought = may_go_on = jnp.array(True)
    force_change = form.layout.forces(form.force_components(multipliers))
    largest = jnp.sqrt(jnp.max(dot(rotation, rotation)))
    step = jnp.minimum(1.0, solver.max_rotation / largest)
    longest = form.longest_step(point, others)
    if longest is not None:
        step = jnp.minimum(step, longest)
    if _descends(form, find):
        force_change, others = step * force_change, form.scaled(others, 1.0, step)

    loads, squares = state.loads, state.squares
    if loads is not None:
        loads, squares = form.held_loads(point), _squares(form, here)

    if _descends(form, find):
        # With the new forces in place of the old ones.
        constraint_residual, constraint_rate, change, along = form.under_force(
            point, here, rotation, force_change, others
        )
        objective = form.objective(here, point, others) + change
        along += jnp.sum(rotation * here.gradient)
        if loads is not None:  # whose moments the gradient has
            along -= loads.work(jnp.zeros_like(rotation), others)
    else:
        constraint_residual = form.force_components(here.constraint_residual)
        constraint_rate = -constraint_residual
        objective = form.half_square(here)
        along = -2 * objective
    falls = -jnp.sum(constraint_residual * constraint_rate)
    weight = jnp.maximum(CLOSURE_WEIGHT, 2 * along / jnp.where(falls > 0, falls, jnp.inf))

    status = jnp.where(iterations >= solver.max_iterations, Status.MAX_ITERATIONS, Status.RUNNING)
    has_saddle = is_balanced & ~is_sought & (state.pushes >= MAX_PUSHES)
    status = jnp.where(has_saddle, Status.SADDLE, status)
    status = jnp.where(is_balanced & is_sought, balanced, status)
    # A zero-iteration solve ends before its step is known to be finite, or needed.
    status = jnp.where(may_go_on | is_balanced, status, Status.LINE_SEARCH_FAILED)
    status = jnp.where(is_finite, status, Status.NOT_FINITE)
    is_lost = jnp.array(False)
    if form.carries_twist:
        # The search goes on where the total twist has lost a part of a turn on the way.
        twist = jax.lax.cond(is_balanced & ~again, lambda: form.allowed_twist(point), lambda: point.total_twist)
        is_lost = jnp.abs(twist - point.total_twist) > 0  # not where it is not a number
        point = eqx.tree_at(lambda point: point.total_twist, point, twist)
    if form.refines:
        # What a search changes at its beginning or end alone.
        begins = (iterations == 0) & ~is_balanced
        point, changes = jax.lax.cond(
            begins | (is_balanced & ~again & ~is_lost),
            lambda: form.refined(point, is_balanced),
            lambda: (point, jnp.array(False)),
        )
        is_lost |= changes
    again |= is_lost
    status = jnp.where(again, Status.RUNNING, status)
    is_given_up = status == Status.MAX_ITERATIONS
    has_slid_out = form.has_slid_out(point, is_given_up)
    if has_slid_out is not None:
        is_open = is_given_up | (status == Status.RUNNING)
        status = jnp.where(has_slid_out & is_open, Status.SLID_OUT, status)
    is_blocked = form.is_blocked(point)
    if is_blocked is not None:
        status = jnp.where(is_blocked & (status == Status.RUNNING), Status.MAX_ITERATIONS, status)
    return NewtonState(
        point=point,
        bases=here.bases,
        residual=jnp.where(again, state.residual, here.residual),
        floor=floor,
        shift=shift,
        last_shift=jnp.where(is_definite & (shift > least), shift, state.last_shift),
        rotation=rotation,
        force_change=force_change,
        others=others,
        loads=loads,
        squares=squares,
        weight=weight,
        merit=objective + weight / 2 * jnp.sum(constraint_residual**2),
        slope=along - weight * falls,
        step=step,
        halvings=jnp.zeros((), int),
        restart=again,
        tries=jnp.where(again & ~is_lost, state.tries + 1, 0),
        is_pushed=is_pushed,
        pushes=state.pushes + jnp.where(is_pushed, 1, 0),
        iterations=iterations,
        evaluations=state.evaluations,
        status=status.astype(int),
        is_stable=is_stable,
    )


def _shortened(form: Form, state: NewtonState, find: Find) -> NewtonState:
    halvings = state.halvings + 1
    failed = halvings > MAX_HALVINGS
    stagnated = state.residual <= STAGNATION * state.floor
    reason = jnp.where(stagnated, Status.ROUNDING_FLOOR, Status.LINE_SEARCH_FAILED)
    # On the way to a minimum a larger shift gives a shorter step in a direction that goes down more surely.
    again = failed & ~stagnated & (state.shift < MAX_SHIFT) & _descends(form, find)
    return eqx.tree_at(
        lambda state: (state.step, state.halvings, state.restart, state.tries, state.status),
        state,
        (
            state.step / 2,
            jnp.where(again, 0, halvings),
            again,
            jnp.where(again, 1, state.tries),
            jnp.where(failed & ~again, reason, state.status).astype(int),
        ),
    )


def begin(form: Form, point: Point, find: Find) -> NewtonState:
    """Before the first turn, whose trial is the point itself."""
    point = form.searching(point)
    dtype, holds_loads = point.tangents.dtype, _descends(form, find) and form.holds_loads
    zero = jnp.zeros((), dtype)
    of_bases = jax.eval_shape(form.bases_at, point)
    bases = jnp.zeros(of_bases.shape, of_bases.dtype)
    count = jnp.zeros((), int)
    no = jnp.array(False)
    return NewtonState(
        point=point,
        bases=bases,
        residual=zero,
        floor=zero,
        shift=zero,
        last_shift=zero,
        rotation=jnp.zeros(bases.shape[1:], dtype),
        force_change=jnp.zeros_like(point.end_force),
        others=form.no_others(point),
        loads=form.held_loads(point) if holds_loads else None,
        squares=zero if holds_loads else None,
        weight=zero,
        merit=zero,
        slope=zero,
        step=zero,
        halvings=count,
        restart=jnp.array(True),
        tries=count,
        is_pushed=no,
        pushes=count,
        iterations=count,
        evaluations=count,
        status=jnp.full((), Status.RUNNING, int),
        is_stable=no,
    )
