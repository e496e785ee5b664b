"""The rods of an assembly eliminated, and the condensed system that is left for its bodies.

The system of each rod is factorised by itself, its columns for the motions of its two ends are eliminated with it, and
what is left is a small dense system for the motions of the bodies,

    S q = -h - sum B^T K^-1 (g, c),    S = D - sum B^T K^-1 B,

with the system K, gradient g and constraint residual c of a rod, their derivatives B by the motions of its ends, and
first and second derivatives h, D of L by these. Negative eigenvalues of the whole are those of the rods and those of S
(Haynsworth 1968). Where rods touch something, which contacts are closed is sought with both (`harness_contact`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import NEUTRAL, Form, Linearization
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.sliding import SlidingForm
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import factor
from rodjax.linalg.small_matrices import solved_where_regular
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, State
from rodjax.solving.assembly_balance import Balance, Here, changed_in_contact
from rodjax.solving.contact_elimination import RodsInContact, moved_by
from rodjax.solving.coupling import Coupling, free_points, solved_with_columns
from rodjax.solving.harness_contact import ContactModel, ContactStep, contact_step
from rodjax.solving.newton import FIRST_SHIFT, MAX_FACTORS, MAX_PUSHES, NEAR, PUSH, SHIFT_GROWTH, Find, least_shift
from rodjax.solving.rod_contact import Columns, Contacts, between, columns_of, in_contact

# A motion of the bodies with less stiffness than this part of the largest energy unit of the rods counts as neutral.
LEAST_STIFFNESS = NEUTRAL


class Eliminated(NamedTuple):
    """A rod's system under a shift: whether it has a minimum, its negative eigenvalues, and the solutions for what is
    out of balance and for the motions of the ends.
    """

    is_minimum: Bool[Array, ""]
    negative: Int[Array, ""]
    rotation: Float[Array, "b m"]
    multipliers: Float[Array, "k"]
    rotations: Float[Array, "b m 12"]
    multipliers_by_motions: Float[Array, "k 12"]


class EliminatedRods(NamedTuple):
    """The systems of all rods eliminated, group by group, and what these tell together; `None` of those with contacts,
    which are sought together.
    """

    found: list["Eliminated | None"]
    shifts: tuple[Float[Array, "k"], ...]
    is_definite: Bool[Array, ""]
    negative: Int[Array, ""]
    is_pushed: Bool[Array, ""]


class BodyMotions(NamedTuple):
    """The motions of the bodies that bring all into balance, and what their condensed stiffness tells."""

    motions: Float[Array, "j 6"]
    below: Int[Array, ""]
    is_pushed: Bool[Array, ""]


# --- the rods eliminated ---------------------------------------------------------------------------------------------


def eliminated(
    form: Form, here: Linearization, coupling: Coupling, shift: Float[Array, ""], push: Float[Array, "b m"]
) -> Eliminated:
    h = 1 / here.gradient.shape[1]
    system, constraint_residual = here.system.shifted(h * shift), here.constraint_residual
    if isinstance(form, SlidingForm):
        system, constraint_residual = form.sliding(here, system)
    factors = factor(system, is_regularized=True)
    right = push - here.gradient, -constraint_residual
    columns = coupling.of_gradient, coupling.of_constraints
    (rotation, multipliers), by_motions = solved_with_columns(factors.solve, right, columns)
    is_sliding = isinstance(form, SlidingForm)
    is_minimum = form.has_minimum(factors, multipliers) if is_sliding else factors.is_minimum
    return Eliminated(is_minimum, factors.negative, rotation, multipliers, *by_motions)


def eliminated_rods(all_here: list[Here], state: State, balance: Balance, find: Find) -> EliminatedRods:
    least = jnp.asarray(NEUTRAL, balance.residual.dtype)
    all_found, shifts = [], []
    is_definite, negative, is_pushed = jnp.array(True), jnp.zeros((), int), jnp.array(False)
    for here, last in zip(all_here, state.shifts, strict=True):
        if here.at_ends is not None:
            all_found.append(None)
            shifts.append(last)
            continue
        found, shift, pushed = _eliminated(here, last, state, balance, find)
        all_found.append(found)
        shifts.append(shift)
        is_definite &= jnp.all(found.is_minimum & (shift <= least))
        negative += jnp.sum(found.negative)
        is_pushed |= pushed
    return EliminatedRods(all_found, tuple(shifts), is_definite, negative, is_pushed)


def _eliminated(
    here: Here, last: Float[Array, "k"], state: State, balance: Balance, find: Find
) -> tuple[Eliminated, Float[Array, "k"], Bool[Array, ""]]:
    """Under the least shifts with which each rod by itself has a minimum, and those; whether a rod is pushed aside."""
    least = jnp.asarray(NEUTRAL, last.dtype)
    h = 1 / here.linearization.gradient.shape[2]
    nothing = jnp.zeros_like(here.aside)
    systems = here.rods.form, here.linearization, here.coupling
    if find == "equilibrium":
        shift = jnp.full_like(last, least)
        found = of_each(eliminated)(*systems, shift, nothing)
        return found, shift, jnp.array(False)
    shift = _first_shift(last, state, balance)

    def pushes(shift: Float[Array, "k"]) -> Float[Array, "k"]:
        return PUSH * h * _pushing(shift, state, balance)

    def again(trial: tuple[Array, Array, Eliminated]) -> tuple[Array, Array, Eliminated]:
        shift, tries, found = trial
        larger = jnp.maximum(SHIFT_GROWTH * shift, least_shift(last))
        shift = jnp.where((tries > 0) & ~found.is_minimum, larger, shift)
        push = pushes(shift)[:, None, None] * here.aside
        return shift, tries + 1, of_each(eliminated)(*systems, shift, push)

    kinds = jax.eval_shape(of_each(eliminated), *systems, shift, nothing)
    blank = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), kinds)
    shift, _, found = jax.lax.while_loop(
        lambda trial: (trial[1] == 0) | (~jnp.all(trial[2].is_minimum) & (trial[1] < MAX_FACTORS)),
        again,
        (shift, jnp.zeros((), int), blank),
    )
    return found, shift, jnp.any(pushes(shift) > 0)


def _first_shift(last: Float[Array, "k"], state: State, balance: Balance) -> Float[Array, "k"]:
    least = jnp.asarray(NEUTRAL, last.dtype)
    shift = jnp.where(balance.is_balanced | (last <= FIRST_SHIFT), least, last / SHIFT_GROWTH**2)
    return jnp.maximum(shift, state.damping)


def _pushing(shift: Float[Array, "k"], state: State, balance: Balance) -> Float[Array, "k"]:
    """The shifts of rods that are to be pushed aside, of others 0."""
    is_near = balance.is_balanced | (balance.residual <= NEAR * shift)
    pushed = (state.pushes < MAX_PUSHES) & ((state.pushes == 0) | is_near) & (shift > NEUTRAL) & (state.damping == 0)
    return jnp.where(pushed, shift, 0.0)


# --- the bodies ------------------------------------------------------------------------------------------------------


def body_motions(
    assembly: Assembly, all_here: list[Here], rods: EliminatedRods, state: State, balance: Balance, find: Find
) -> BodyMotions:
    matrix, right = _condensed_system(assembly, all_here, rods, balance)
    motions, dtype = assembly.bodies.motions, right.dtype
    values, vectors = jnp.linalg.eigh((matrix + matrix.T) / 2)
    is_below = values < -LEAST_STIFFNESS
    below = jnp.sum(is_below)
    if find == "minimum":
        is_pushed = balance.is_balanced & (below > 0) & (state.pushes < MAX_PUSHES)
        sides = jnp.where(jnp.sum(vectors * _generic(len(values), dtype)[:, None], axis=0) < 0, -1.0, 1.0)
        aside = jnp.where(is_pushed & is_below, PUSH * jnp.abs(values) * sides.astype(dtype), 0.0)
        stiffness = jnp.maximum(jnp.abs(values), LEAST_STIFFNESS) + state.damping
        coordinates = vectors @ ((vectors.T @ right + aside) / stiffness)
    else:
        is_pushed = jnp.array(False)
        stiffness = jnp.where(jnp.abs(values) < LEAST_STIFFNESS, LEAST_STIFFNESS, values)
        coordinates = vectors @ ((vectors.T @ right) / stiffness)
    if not _is_symmetric(assembly, all_here):
        damped = matrix + state.damping * jnp.eye(len(values), dtype=dtype)
        values = values if find == "minimum" else jnp.abs(values)
        coordinates = solved_where_regular(damped, right, values, LEAST_STIFFNESS, coordinates)
    return BodyMotions((motions @ coordinates).reshape(assembly.count, 6), below, is_pushed)


def _is_symmetric(assembly: Assembly, all_here: list[Here]) -> bool:
    """Whether S is: else steps are those of its symmetric part until that is positive, and then its own."""
    return assembly.bodies.moment is None and all(here.coupling.is_symmetric for here in all_here)


def _condensed_system(
    assembly: Assembly, all_here: list[Here], rods: EliminatedRods, balance: Balance
) -> tuple[Float[Array, "k k"], Float[Array, "k"]]:
    """S and its right side, along the motions that the supports of the bodies leave."""
    count, dtype = assembly.count, balance.gradient.dtype
    full = jnp.zeros((count + 1, 6, count + 1, 6), dtype)
    number = np.arange(count)
    full = full.at[number, :, number, :].add(balance.stiffness)
    if assembly.bodies.moment is not None:
        full = full.at[number, 3:, number, 3:].add(assembly.bodies.under_moments / assembly.energy)
    right = -jnp.pad(balance.gradient, ((0, 1), (0, 0)))
    for group, here, found in zip(assembly.groups, all_here, rods.found, strict=True):
        shares, couple = assembly.shares(group), here.coupling
        if found is None:  # its forces are those of the model
            of_ends = shares[:, None, None] * couple.first.reshape(-1, 2, 6)
            right = right.at[group.body].add(of_ends)
            continue
        by_rotations, by_multipliers = couple.by_rotations, couple.by_multipliers
        condensed = couple.second - jnp.einsum("kbmi,kbmj->kij", by_rotations, found.rotations)
        condensed -= jnp.einsum("kci,kcj->kij", by_multipliers, found.multipliers_by_motions)
        loads = jnp.einsum("kbmi,kbm->ki", by_rotations, found.rotation)
        loads += jnp.einsum("kci,kc->ki", by_multipliers, found.multipliers)
        condensed = (shares[:, None, None] * condensed).reshape(-1, 2, 6, 2, 6)
        loads = (shares[:, None] * loads).reshape(-1, 2, 6)
        for a in range(2):
            right = right.at[group.body[:, a]].add(-loads[:, a])
            for b in range(2):
                full = full.at[group.body[:, a], :, group.body[:, b], :].add(condensed[:, a, :, b])
    motions = assembly.bodies.motions
    full = full[:count, :, :count].reshape(6 * count, 6 * count)
    return motions.T @ full @ motions, motions.T @ right[:count].reshape(-1)


def _generic(count: int, dtype: Any) -> Float[np.ndarray, "k"]:
    """A direction along no other."""
    return np.cos(1.0 + 2.0 * np.arange(count)).astype(dtype)


def with_contacts(
    assembly: Assembly,
    all_here: list[Here],
    touching: tuple[Contacts, ...],
    rods: EliminatedRods,
    state: State,
    balance: Balance,
    find: Find,
) -> tuple[EliminatedRods, BodyMotions, ContactStep]:
    """The same with the contacts of rods and bodies, which are sought with both."""
    stiffness, force = _condensed_system(assembly, all_here, rods, balance)
    in_touch = [group for group, here in zip(assembly.groups, all_here, strict=True) if here.at_ends is not None]
    moved = moved_by([(group.body, group.form.sliding_count) for group in in_touch], assembly.bodies.motions)
    count = len(force)
    slide = moved[0].shape[2] - count
    stiffness, force = jnp.pad(stiffness, ((0, slide), (0, slide))), jnp.pad(force, (0, slide))
    least, dtype = jnp.asarray(NEUTRAL, force.dtype), force.dtype
    may_push = jnp.array(find == "minimum") & (state.pushes < MAX_PUSHES)
    groups, shifts, least_shifts, is_pushed = [], [], [], rods.is_pushed
    together, chosen = between(assembly.pairs, touching) if touching else (None, ())
    of_pairs = in_contact(assembly.pairs)
    for number, (group, here, last) in enumerate(zip(assembly.groups, all_here, state.shifts, strict=True)):
        if here.at_ends is None:
            continue
        shift = _first_shift(last, state, balance) if find == "minimum" else jnp.full_like(last, least)
        pushing = _pushing(last, state, balance) if find == "minimum" else jnp.zeros_like(last)
        is_pushed |= jnp.any(pushing > 0)
        pushes = (PUSH / here.aside.shape[2] * pushing)[:, None, None] * here.aside
        forms = of_each(lambda rod: rod.form_at())(here.rods)
        parts = forms, here.points, here.linearization, here.coupling, here.at_ends, pushes
        touched = RodsInContact.of(*parts, moved[len(groups)], assembly.shares(group))
        if together is not None and number in of_pairs:
            columns = _columns(assembly, number, here, forms, chosen)
            touched = touched.touched(columns, together.pressures)
        groups.append(touched)
        shifts.append(shift)
        least_shifts.append(least_shift(last))
    push = jnp.where(may_push & balance.is_balanced, PUSH, 0.0).astype(dtype)
    pattern = jnp.asarray(_generic(len(force), dtype))
    parts = stiffness, force, push, pattern, LEAST_STIFFNESS, find == "minimum"
    model = ContactModel(tuple(groups), tuple(least_shifts), *parts, together, _is_symmetric(assembly, all_here))
    found = contact_step(model, tuple(shifts), state.damping)
    is_definite = rods.is_definite & found.is_found
    for shift in found.shifts:
        is_definite &= jnp.all(shift <= least)
    all_rods = EliminatedRods(
        rods.found,
        changed_in_contact(all_here, rods.shifts, found.shifts, lambda _, shift: shift),
        is_definite,
        rods.negative + found.negative,
        is_pushed,
    )
    pushes_bodies = (found.below > 0) & (push > 0)
    motions = (assembly.bodies.motions @ found.q[:count]).reshape(assembly.count, 6)
    return all_rods, BodyMotions(motions, found.below, pushes_bodies), found


def _columns(assembly: Assembly, number: int, here: Here, forms: NodalForm, chosen: Any) -> Columns:
    group, system = assembly.groups[number], here.linearization.system
    assert isinstance(system, ChainSystem)
    free = of_each(free_points)(forms, here.linearization)
    scales = group.units.length / assembly.length, assembly.shares(group)
    return columns_of(number, assembly.pairs, chosen, system, here.coupling, free, scales)
