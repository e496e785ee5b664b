"""Newton's method for rods that meet in rigid bodies: all of them and all poses at once.

A step solves the linearised equilibrium of rods and bodies, with the rods eliminated (`condensation`).
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import Form
from rodjax.discretization.nearest_places import GROWS
from rodjax.discretization.rod_pairs import GROWS_OF_PAIRS
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, State
from rodjax.solving.assembly_balance import (
    Balance,
    Here,
    balance_at,
    changed_in_contact,
    linearized_rod,
    sliding_once_settled,
)
from rodjax.solving.assembly_step import Steps, Trial, searched, steps_from
from rodjax.solving.condensation import body_motions, eliminated_rods, with_contacts
from rodjax.solving.loading import put_on
from rodjax.solving.newton import FIRST_SHIFT, MAX_PUSHES, MAX_SHIFT, SHIFT_GROWTH, STAGNATION, Find, Newton, NewtonEnd
from rodjax.solving.rod_contact import are_crowded
from rodjax.solving.status import Outcome, Status, is_converged

# Iterations after which a search under loads without a potential is given up: those that end take 5 to 30.
MOST_UNJUDGED = 40


def find_assembly(assembly: Assembly, begin: State, solver: Newton, find: Find, is_cold: Bool[Array, ""]) -> State:
    """The equilibrium that is reached; `is_cold`: whether the search begins where there is none of other loads."""
    if assembly.has_potential:
        return _found(assembly, begin, solver, find)

    def search(part: Float[Array, ""] | None, begin: State) -> NewtonEnd:
        here = assembly.bearing(part)
        start = here.begin(begin.points, begin.at_ends, begin.pairs, begin.is_wide, begin.poses)
        end = _found(here, start, solver, find)
        outcome = Outcome(end.residual, end.iterations, end.evaluations, end.status)
        return NewtonEnd(end, outcome, end.negative == 0)

    end = put_on(search, begin, is_cold, begin.residual.dtype)
    outcome, found = end.outcome, end.point
    return found._replace(
        iterations=begin.iterations + outcome.iterations,
        evaluations=begin.evaluations + outcome.evaluations,
        status=outcome.status,
    )


def _found(assembly: Assembly, begin: State, solver: Newton, find: Find) -> State:
    if not assembly.has_potential:
        # Steps are not judged: what they lead to is near, or parts of the loads are.
        find = "equilibrium"
        fewer = jnp.minimum(solver.max_iterations, MOST_UNJUDGED)
        solver = eqx.tree_at(lambda solver: solver.max_iterations, solver, fewer)
    begin = begin._replace(points=_of_each(assembly, begin.points, lambda form, point: form.searching(point)))
    end = jax.lax.while_loop(
        lambda state: state.status == Status.RUNNING, lambda state: _turn(assembly, state, solver, find), begin
    )
    return end._replace(points=_of_each(assembly, end.points, lambda form, point: form.ended(point)))


def _of_each(assembly: Assembly, points: tuple[Any, ...], changed: Callable[[Form, Any], Any]) -> tuple[Any, ...]:
    """Of each group the points, changed where a search changes them at its beginning or end alone."""
    return tuple(
        of_each(changed)(group.form, of_group) if group.form.refines else of_group
        for group, of_group in zip(assembly.groups, points, strict=True)
    )


def _turn(assembly: Assembly, state: State, solver: Newton, find: Find) -> State:
    """One linearisation, the step that follows from it, and the part of it that is taken."""
    touching = assembly.contacts(state)
    assembly = assembly.touched(touching)
    all_here = []
    for group, points, pressures in zip(assembly.groups, state.points, state.at_ends, strict=True):
        rods = assembly.rods(group, state.poses)
        all_here.append(Here(rods, *of_each(linearized_rod)(rods, points, pressures)))
    balance = balance_at(assembly, all_here, touching, state, solver)
    all_here = sliding_once_settled(all_here, state, balance)
    rods = eliminated_rods(all_here, state, balance, find)
    if all(here.at_ends is None for here in all_here):
        bodies, contacts = body_motions(assembly, all_here, rods, state, balance, find), None
    else:
        rods, bodies, contacts = with_contacts(assembly, all_here, touching, rods, state, balance, find)
    steps = steps_from(assembly, all_here, rods, bodies, contacts, balance, solver)
    is_sought = (rods.is_definite & (bodies.below == 0)) if find == "minimum" else jnp.array(True)
    is_pushed = rods.is_pushed | bodies.is_pushed
    is_unjudged = is_pushed | (find != "minimum")
    trial = searched(assembly, all_here, touching, state, steps, balance, is_unjudged, is_sought)
    status = _status(state, balance, trial, steps, is_sought, solver)
    for group, here in zip(assembly.groups, all_here, strict=True):
        is_given_up = (status == Status.MAX_ITERATIONS) | (status == Status.LINE_SEARCH_FAILED)
        slid_out = of_each(lambda form, point, ends: form.has_slid_out(point, ends), (0, 0, None))
        has_slid_out = slid_out(group.form, here.points, is_given_up)
        if has_slid_out is not None:
            is_open = is_given_up | (status == Status.RUNNING)
            status = jnp.where(jnp.any(has_slid_out) & is_open, Status.SLID_OUT, status)
        is_blocked = of_each(lambda form, point: form.is_blocked(point))(group.form, here.points)
        if is_blocked is not None:
            status = jnp.where(jnp.any(is_blocked) & (status == Status.RUNNING), Status.MAX_ITERATIONS, status)
    is_given_up = (status == Status.MAX_ITERATIONS) | (status == Status.LINE_SEARCH_FAILED)
    for pairs, contacts_of_pairs in zip(assembly.pairs, touching, strict=True):
        status = jnp.where(is_given_up & are_crowded(pairs, contacts_of_pairs), Status.CROWDED, status)
    points_here, changes = _refined(assembly, all_here, state, balance, status)
    is_wide, has_ended, differ = _wells(assembly, state, balance, status)
    changes |= differ
    status = jnp.where(changes, Status.RUNNING, status)
    goes = (status == Status.RUNNING) & trial.is_better & ~changes
    taken = jnp.where(goes, trial.part, 0.0)
    # Forces and pressures change as the merit has them.
    pushed = jnp.where(goes, steps.part, 0.0)
    there = state.poses.retract(taken * steps.bodies, assembly.length), trial.points
    poses, points = jax.tree.map(lambda new, old: jnp.where(goes, new, old), there, (state.poses, points_here))
    at_ends = state.at_ends
    if contacts is not None:
        at_ends = changed_in_contact(
            all_here, at_ends, contacts.at_ends, lambda pressures, change: pressures + pushed * change
        )
    pairs = state.pairs
    if contacts is not None and contacts.between is not None:
        changes = contacts.between.changed(state.pairs)
        pairs = tuple(pressures + pushed * change for pressures, change in zip(pairs, changes, strict=True))
    return State(
        points=points,
        at_ends=at_ends,
        pairs=pairs,
        is_wide=is_wide,
        has_ended=has_ended,
        poses=poses,
        shifts=rods.shifts,
        damping=_damping(state, trial),
        residual=balance.residual,
        residuals=balance.residuals,
        pushes=state.pushes + jnp.where(goes & is_pushed, 1, 0),
        iterations=state.iterations + jnp.where(goes, 1, 0),
        evaluations=state.evaluations + jnp.maximum(trial.tries, 1),
        status=status.astype(int),
        negative=(rods.negative + bodies.below).astype(int),
    )


# --- what follows ----------------------------------------------------------------------------------------------------


def _status(
    state: State, balance: Balance, trial: Trial, steps: Steps, is_sought: Bool[Array, ""], solver: Newton
) -> Int[Array, ""]:
    is_balanced, fails = balance.is_balanced, ~trial.is_better
    status = jnp.where(state.iterations >= solver.max_iterations, Status.MAX_ITERATIONS, Status.RUNNING)
    is_at_floor = fails & (balance.residual <= STAGNATION * balance.floor)
    status = jnp.where(is_at_floor, Status.ROUNDING_FLOOR, status)
    is_stuck = fails & ~is_at_floor & (state.damping > MAX_SHIFT)
    status = jnp.where(is_stuck & (status == Status.RUNNING), Status.LINE_SEARCH_FAILED, status)
    has_saddle = is_balanced & ~is_sought & (state.pushes >= MAX_PUSHES)
    status = jnp.where(has_saddle, Status.SADDLE, status)
    status = jnp.where(is_balanced & is_sought, balance.balanced, status)
    return jnp.where(steps.is_finite | is_balanced, status, Status.NOT_FINITE)


def _refined(
    assembly: Assembly, all_here: list[Here], state: State, balance: Balance, status: Int[Array, ""]
) -> tuple[tuple[Any, ...], Bool[Array, ""]]:
    """The points, with what a search changes at its beginning or end alone; whether it goes on from there."""
    points, changes = [], jnp.array(False)
    begins = (state.iterations == 0) & ~balance.is_balanced & (status == Status.RUNNING)  # finite, then
    ends = is_converged(status)
    for group, here in zip(assembly.groups, all_here, strict=True):
        if not group.form.refines:
            points.append(here.points)
            continue
        found, differ = of_each(lambda form, point: form.refined(point, ends))(group.form, here.points)
        is_new = (a != b for a, b in zip(*map(jax.tree.leaves, (found, here.points)), strict=True))
        differs = functools.reduce(jnp.logical_or, map(jnp.any, is_new))
        changes |= (begins & differs) | (ends & jnp.any(differ))
        points.append(jax.tree.map(lambda new, old: jnp.where(begins | ends, new, old), found, here.points))
    return tuple(points), changes


def _wells(
    assembly: Assembly, state: State, balance: Balance, status: Int[Array, ""]
) -> tuple[tuple[Bool[Array, "p n"], ...], Bool[Array, ""], Bool[Array, ""]]:
    """Which elements have wide wells in contacts between rods: from a start that is not balanced all but those where
    rods cross, then those that an equilibrium has; whether it has come to these, and whether the search goes on.
    """
    if not assembly.pairs:
        return state.is_wide, state.has_ended, jnp.array(False)
    begins = (state.iterations == 0) & ~balance.is_balanced & (status == Status.RUNNING)
    ends = is_converged(status)

    def anew() -> tuple[tuple[Array, ...], Bool[Array, ""]]:
        found, changes = [], jnp.array(False)
        for growth, before in zip(assembly.growth(state.points, state.poses), state.is_wide, strict=True):
            # Once wide again, none becomes narrow a second time.
            is_wide = (growth < GROWS_OF_PAIRS) | (before & state.has_ended)
            found.append(jnp.where(begins, growth < GROWS, is_wide))
        for here, before in zip(assembly.contacts(state._replace(is_wide=tuple(found))), state.is_wide, strict=True):
            changes |= jnp.any((here.is_wide != before) & (begins | (here.pressures > 0) | (here.gaps < 0)))
        return tuple(found), changes

    is_wide, changes = jax.lax.cond(begins | ends, anew, lambda: (state.is_wide, jnp.array(False)))
    return is_wide, jnp.where(begins, False, state.has_ended | ends), changes


def _damping(state: State, trial: Trial) -> Float[Array, ""]:
    """What stiffens rods and bodies in the next step: more where no part of this one is better."""
    less, more = state.damping / SHIFT_GROWTH**2, jnp.maximum(SHIFT_GROWTH * state.damping, FIRST_SHIFT)
    return jnp.where(trial.is_better, jnp.where(less < FIRST_SHIFT, 0.0, less), more)
