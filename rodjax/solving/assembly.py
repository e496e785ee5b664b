"""Newton's method for rods that meet in rigid bodies: all of them and all poses at once.

Each rod is an ordinary form between clamps, whose poses are those of its bodies. A step solves the linearised
equilibrium of rods and bodies: the system of each rod is factorised by itself, its columns for the motions of its two
ends are eliminated with it, and what is left is a small dense system for the motions of the bodies,

    S q = -h - sum B^T K^-1 (g, c),    S = D - sum B^T K^-1 B,

with the system K, gradient g and constraint residual c of a rod, their derivatives B by the motions of its ends, and
first and second derivatives h, D of L by these. Negative eigenvalues of the whole are those of the rods and those of S
(Haynsworth 1968). Rods of one structure and mesh are stacked: one after another along an axis of every array.

Steps are judged as those of `newton`: by L with the new forces and the square of the constraint residuals. Motions (u,
r) of a body: displacement in parts of a mean length, and rotation vector about global axes.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.curve_distance import Curve
from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.form import NEUTRAL, Form, Linearization
from rodjax.discretization.joints import generic_field
from rodjax.discretization.nearest_places import GROWS
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.rod_pairs import GROWS_OF_PAIRS
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SETTLED, SlidingForm
from rodjax.discretization.sliding_point import SlidingLinearization
from rodjax.geometry.vectors import components
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import factor
from rodjax.linalg.small_matrices import solved_where_regular
from rodjax.mechanics.energy import dead_load_energy
from rodjax.model.harness import Bodies, rotated
from rodjax.model.loads import ContactLoads
from rodjax.model.scene import held_position, scene_axes, under_contact
from rodjax.solving.coupling import (
    Coupling,
    EndContacts,
    RodInBodies,
    end_contact_energy,
    end_contact_rate,
    end_contacts,
    free_points,
    linearized_with_ends,
    solved_with_columns,
)
from rodjax.solving.harness_contact import BetweenStep, ContactModel, ContactStep, RodsInContact, contact_step, moved_by
from rodjax.solving.loading import bearing, put_on
from rodjax.solving.newton import (
    CLOSURE_WEIGHT,
    ENERGY_ROUNDING,
    FIRST_SHIFT,
    MAX_FACTORS,
    MAX_HALVINGS,
    MAX_PUSHES,
    MAX_SHIFT,
    NEAR,
    PUSH,
    SHIFT_GROWTH,
    STAGNATION,
    SUFFICIENT_DECREASE,
    Find,
    Newton,
    NewtonEnd,
)
from rodjax.solving.rod_contact import (
    Columns,
    Contacts,
    Pairs,
    are_crowded,
    between,
    columns_of,
    contact_energy,
    contacts_between,
    curves_of,
    growth_between,
    in_contact,
    loads_of,
    passes,
)
from rodjax.solving.status import Outcome, Status, is_converged
from rodjax.units import Units

# A motion of the bodies with less stiffness than this part of the largest energy unit of the rods counts as neutral.
LEAST_STIFFNESS = NEUTRAL
# Of the shifts of a rod that is not definite, the least one [EI/L^2].
LEAST_SHIFT = 1e-3
# Iterations after which a search under loads without a potential is given up: those that end take 5 to 30.
MOST_UNJUDGED = 40


class Poses(NamedTuple):
    """Of the bodies: positions [m] and frames."""

    positions: Float[Array, "j 3"]
    frames: Float[Array, "j 3 3"]

    def retract(self, motions: Float[Array, "j 6"], length: Float[Array, ""]) -> "Poses":
        frames = rotated(self.frames, motions[:, 3:])
        # One step towards orthonormal columns: rounding would grow with every step.
        frames = frames @ (1.5 * jnp.eye(3, dtype=frames.dtype)[None] - 0.5 * jnp.swapaxes(frames, 1, 2) @ frames)
        return Poses(self.positions + length * motions[:, :3], frames)


class Rods(eqx.Module):
    """Rods of one structure and mesh, stacked along a first axis of every array.

    `form`: of the nondimensional scene, with clamps where an end belongs to a body; `body`: the number of that, the
    number of all bodies where an end belongs to none; `frame`, `offset`: of the ends in their bodies.
    """

    form: Form
    shape: Shape
    units: Units
    body: Int[Array, "k 2"]
    frame: Float[Array, "k 2 3 3"]
    offset: Float[Array, "k 2 3"]

    def under(self, poses: Poses) -> tuple[Float[Array, "k 2 3"], Float[Array, "k 2 3 3"]]:
        """The poses of the bodies at both ends."""
        positions = jnp.pad(poses.positions, ((0, 1), (0, 0)))
        frames = jnp.pad(poses.frames, ((0, 1), (0, 0), (0, 0)))
        return positions[self.body], frames[self.body]

    def touched(self, loads: ContactLoads) -> "Rods":
        """The same under forces of other rods."""
        scene = under_contact(self.form.scene, loads)
        return dataclasses.replace(self, form=eqx.tree_at(lambda form: form.scene, self.form, scene))


class RodStep(NamedTuple):
    """Where a rod is, and a step from there; `others`: as of `Form.others`; `at_ends`: contacts of its bodies, and how
    their pressures change.
    """

    point: Any
    bases: Float[Array, "3 b m"]
    rotation: Float[Array, "b m"]
    force_change: Float[Array, "3 parts"]
    others: Any = None
    at_ends: EndContacts | None = None
    at_ends_change: Float[Array, "o 2"] | None = None

    def value(
        self, rod: RodInBodies, motions: Float[Array, "2 6"], part: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, "c"], Any]:
        """L after a part of the rotations, under the new forces and pressures, with its ends moved and the energy of
        contacts; what it lacks of its spans; the point there.
        """
        form, value, constraint_residual, there = self.without_contacts(rod, motions, part)
        if self.at_ends is not None:
            assert isinstance(form, NodalForm | SlidingForm)
            assert self.at_ends_change is not None
            value += form.contact_energy(there, self.point, self.others)
            value += end_contact_energy(rod, form, self.at_ends, self.at_ends_change)
        return value, constraint_residual, there

    def without_contacts(
        self, rod: RodInBodies, motions: Float[Array, "2 6"], part: Float[Array, ""]
    ) -> tuple[Form, Float[Array, ""], Float[Array, "c"], Any]:
        """With the form there."""
        form = rod.form_at(motions)
        others = form.scaled(self.others, part, 1.0)
        there = form.holding(form.retract(self.point, self.bases, part * self.rotation, self.force_change, others))
        value, constraint_residual = form.lagrangian(there)
        scene = form.scene
        if isinstance(form, SlidingForm):
            value -= self.point.excess_at(there.arclengths)
        return form, value + dead_load_energy(total_force(scene), held_position(scene)), constraint_residual, there

    def contact_rate(
        self, form: NodalForm, here: Linearization, coupling: Coupling, motions: Float[Array, "2 6"]
    ) -> Float[Array, ""]:
        """How fast the energy of contacts changes as the step begins."""
        assert isinstance(here.system, ChainSystem)
        assert self.at_ends is not None
        assert self.at_ends_change is not None
        rates = here.system.contacts.rates(self.rotation, self.others.displacements)
        if coupling.of_gaps is not None:
            rates += coupling.of_gaps @ motions.reshape(12)
        rate = form.contact_rate(here, self.point, self.others, rates)
        return rate + end_contact_rate(self.at_ends, self.at_ends_change, motions)


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


class State(NamedTuple):
    """What a turn leaves to the next one; of each group of rods points, pressures of the bodies where these end (`None`
    of rods that touch nothing), and shifts of their systems; of the contacts of each kind of `Pairs` pressures, and
    which elements have wide wells, and whether these are those of an equilibrium.
    """

    points: tuple[Any, ...]
    at_ends: tuple[Float[Array, "k o 2"] | None, ...]
    pairs: tuple[Float[Array, "p n"], ...]
    is_wide: tuple[Bool[Array, "p n"], ...]
    has_ended: Bool[Array, ""]
    poses: Poses
    shifts: tuple[Float[Array, "k"], ...]
    damping: Float[Array, ""]
    residual: Float[Array, ""]
    residuals: tuple[Float[Array, "k"], ...]
    pushes: Int[Array, ""]
    iterations: Int[Array, ""]
    evaluations: Int[Array, ""]
    status: Int[Array, ""]
    negative: Int[Array, ""]


class Assembly(eqx.Module):
    """All rods and bodies of a harness, with the units of its system: `energy` that of the stiffest rod, `length` the
    mean of all. `pairs`: of rods that may touch.
    """

    groups: tuple[Rods, ...]
    bodies: Bodies
    energy: Float[Array, ""]
    length: Float[Array, ""]
    pairs: tuple[Pairs, ...] = eqx.field(static=True)

    @staticmethod
    def of(groups: tuple[Rods, ...], bodies: Bodies, pairs: tuple[Pairs, ...] = ()) -> "Assembly":
        energies = jnp.concatenate([rods.units.energy for rods in groups])
        lengths = jnp.concatenate([rods.units.length for rods in groups])
        return Assembly(groups, bodies, jnp.max(energies), jnp.mean(lengths), pairs)

    @property
    def has_potential(self) -> bool:
        """Whether the loads on all rods have one."""
        return all(group.form.has_potential for group in self.groups)

    def bearing(self, part: Float[Array, ""] | None) -> "Assembly":
        """With a part of the loads without a potential on rods, or without them."""

        def borne(form: Form) -> Form:
            return eqx.tree_at(lambda form: form.scene, form, bearing(form.scene, part))

        groups = (
            group if group.form.has_potential else dataclasses.replace(group, form=jax.vmap(borne)(group.form))
            for group in self.groups
        )
        return dataclasses.replace(self, groups=tuple(groups))

    @property
    def force(self) -> Float[Array, ""]:
        """The unit of pressures between rods."""
        return self.energy / self.length

    def curves(self, forms: tuple[Form, ...], points: tuple[Any, ...]) -> dict[int, Curve]:
        """Of the groups of which a rod may touch another one; forms with their ends where the bodies are."""
        origin, found = self.groups[0].units.origin[0], {}
        for number in in_contact(self.pairs):
            units, form = self.groups[number].units, forms[number]
            assert isinstance(form, NodalForm)
            found[number] = curves_of(form, points[number], units, self.length, origin)
        return found

    def forms(self, poses: Poses, motions: tuple[Float[Array, "k 2 6"], ...] | None = None) -> tuple[Form, ...]:
        """Of the groups, with their ends where the bodies are after these motions of their ends."""
        found = []
        for number, group in enumerate(self.groups):
            rods = self.rods(group, poses)
            if motions is None:
                found.append(jax.vmap(lambda rod: rod.form_at())(rods))
            else:
                found.append(jax.vmap(lambda rod, moved: rod.form_at(moved))(rods, motions[number]))
        return tuple(found)

    def contacts(self, state: "State") -> tuple[Contacts, ...]:
        """Between rods."""
        if not self.pairs:
            return ()
        curves = self.curves(self.forms(state.poses), state.points)
        each = zip(self.pairs, state.pairs, state.is_wide, strict=True)
        return tuple(contacts_between(pairs, curves, *of_pairs) for pairs, *of_pairs in each)

    def growth(self, points: tuple[Any, ...], poses: Poses) -> tuple[Float[Array, "p n"], ...]:
        """By which it is told which elements have wide wells in contacts between rods."""
        curves = self.curves(self.forms(poses), points)
        return tuple(growth_between(pairs, curves) for pairs in self.pairs)

    def touched(self, contacts: tuple[Contacts, ...]) -> "Assembly":
        """With the loads of contacts between rods."""
        groups = list(self.groups)
        for number in in_contact(self.pairs):
            loads = self.contact_loads(contacts, number)
            per_force = self.force / groups[number].units.force
            per_length = self.length / groups[number].units.length
            groups[number] = groups[number].touched(
                ContactLoads(
                    loads.on_positions * per_force[:, None, None, None],
                    loads.on_tangents * (per_force * per_length)[:, None, None, None],
                )
            )
        return dataclasses.replace(self, groups=tuple(groups))

    def contact_loads(self, contacts: tuple[Contacts, ...], number: int) -> ContactLoads:
        """Of a group, in the units of the assembly."""
        like = self.groups[number].form.scene.contact_loads
        assert like is not None
        return loads_of(self.pairs, contacts, number, like)

    @property
    def count(self) -> int:
        return len(self.bodies.position)

    def rods(self, group: Rods, at: Poses) -> RodInBodies:
        """Stacked."""
        positions, frames = group.under(at)
        length = jnp.broadcast_to(self.length, group.units.length.shape)
        is_joint, touches = group.body < self.count, jnp.array([*self.bodies.floats, False])[group.body]
        poses = group.frame, group.offset, positions, frames
        return RodInBodies(group.form, group.units, is_joint, *poses, length, touches)

    def shares(self, group: Rods) -> Float[Array, "k"]:
        """The unit of energy of each rod, in that of the assembly."""
        return group.units.energy / self.energy

    def body_energies(self, poses: Poses, motions: Float[Array, "j 6"]) -> Float[Array, "j"]:
        there = poses.retract(motions, self.length)
        return self.bodies.energies(there.positions, there.frames, motions[:, 3:]) / self.energy

    def body_derivatives(self, poses: Poses) -> tuple[Float[Array, "j 6"], Float[Array, "j 6 6"]]:
        """First and second ones of the energies by the motions of each body."""
        nowhere = jnp.zeros((self.count, 6), poses.positions.dtype)

        def first(motions: Array) -> Array:
            return jax.grad(lambda motions: jnp.sum(self.body_energies(poses, motions)))(motions)

        # The energy of a body knows of no other: one direction of all bodies at once.
        def column(direction: Float[Array, "6"]) -> Float[Array, "j 6"]:
            return jax.jvp(first, (nowhere,), (jnp.broadcast_to(direction[None], nowhere.shape),))[1]

        second = jax.vmap(column, out_axes=-1)(jnp.eye(6, dtype=nowhere.dtype))
        return first(nowhere), second

    def balance_of_bodies(
        self, gradient: Float[Array, "j 6"], forces: tuple[Float[Array, "k 12"], ...]
    ) -> tuple[Float[Array, "j 6"], Float[Array, ""]]:
        """The gradient of the bodies, that of springs and loads given, with what the rods of each group give their
        ends; its largest component along the motions that supports leave, of a body in the unit of its stiffest rod.
        """
        gradient, scale = jnp.pad(gradient, ((0, 1), (0, 0))), jnp.zeros(self.count + 1, gradient.dtype)
        for group, of_group in zip(self.groups, forces, strict=True):
            shares = self.shares(group)
            of_ends = shares[:, None, None] * of_group.reshape(-1, 2, 6)
            for end in range(2):
                gradient = gradient.at[group.body[:, end]].add(of_ends[:, end])
                scale = scale.at[group.body[:, end]].max(shares)
        motions, gradient, scale = self.bodies.motions, gradient[: self.count], scale[: self.count]
        out_of_balance = (motions.T @ gradient.reshape(-1)) / (jnp.repeat(scale, 6) @ jnp.abs(motions))
        return gradient, jnp.max(jnp.abs(out_of_balance), initial=0.0)

    def begin(
        self,
        points: tuple[Any, ...],
        at_ends: tuple[Array | None, ...],
        pairs: tuple[Array, ...],
        is_wide: tuple[Array, ...],
        poses: Poses,
    ) -> State:
        """A search from points of the rods, pressures of the bodies where these end, pressures and wells of contacts
        between rods, and poses of the bodies.
        """
        dtype = poses.positions.dtype
        zero, count = jnp.zeros((), dtype), jnp.zeros((), int)
        nothing = tuple(jnp.zeros(len(group.body), dtype) for group in self.groups)
        status = jnp.full((), Status.RUNNING, int)
        # All are wide where no equilibrium tells which are.
        has_ended = ~functools.reduce(jnp.logical_and, map(jnp.all, is_wide), jnp.array(True))
        of_contacts, counts = (pairs, is_wide, has_ended), (count, count, count, status, count)
        return State(points, at_ends, *of_contacts, poses, nothing, zero, zero, nothing, *counts)


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
        jax.vmap(changed)(group.form, of_group) if group.form.refines else of_group
        for group, of_group in zip(assembly.groups, points, strict=True)
    )


class _Here(NamedTuple):
    """Of a group of rods at a state."""

    rods: RodInBodies
    points: Any
    linearization: Linearization
    coupling: Coupling
    at_ends: EndContacts | None
    floor: Float[Array, "k"]
    aside: Float[Array, "k b m"]


class _Balance(NamedTuple):
    """What is out of balance: of the bodies before their supports, `gradient`, and the largest of all; `balanced`: the
    status with which the search may end, else RUNNING; `is_settled`: near an equilibrium, sliding apart.
    """

    gradient: Float[Array, "j 6"]
    stiffness: Float[Array, "j 6 6"]
    residuals: tuple[Float[Array, "k"], ...]
    residual: Float[Array, ""]
    floor: Float[Array, ""]
    balanced: Int[Array, ""]
    is_balanced: Bool[Array, ""]
    is_settled: Bool[Array, ""]


class _Rods(NamedTuple):
    """The systems of all rods eliminated, group by group, and what these tell together; `None` of those with contacts,
    which are sought together.
    """

    found: list["Eliminated | None"]
    shifts: tuple[Float[Array, "k"], ...]
    is_definite: Bool[Array, ""]
    negative: Int[Array, ""]
    is_pushed: Bool[Array, ""]


class _Bodies(NamedTuple):
    """The motions of the bodies that bring all into balance, and what their condensed stiffness tells."""

    motions: Float[Array, "j 6"]
    below: Int[Array, ""]
    is_pushed: Bool[Array, ""]


class _Steps(NamedTuple):
    """A step of all rods and bodies, of which `part` is the most that may be taken; forces change by that part."""

    rods: list[RodStep]
    ends: list[Float[Array, "k 2 6"]]
    bodies: Float[Array, "j 6"]
    part: Float[Array, ""]
    is_finite: Bool[Array, ""]
    between: BetweenStep | None


class _Trial(NamedTuple):
    """A part of a step, how many were tried before it, the merit where the step begins, whether this one is better,
    and the points of the rods.
    """

    part: Float[Array, ""]
    tries: Int[Array, ""]
    first: Float[Array, ""]
    is_better: Bool[Array, ""]
    points: tuple[Any, ...]


def _turn(assembly: Assembly, state: State, solver: Newton, find: Find) -> State:
    """One linearisation, the step that follows from it, and the part of it that is taken."""
    touching = assembly.contacts(state)
    assembly = assembly.touched(touching)
    all_here = []
    for group, points, pressures in zip(assembly.groups, state.points, state.at_ends, strict=True):
        rods = assembly.rods(group, state.poses)
        all_here.append(_Here(rods, *jax.vmap(_linearized)(rods, points, pressures)))
    balance = _balance(assembly, all_here, touching, state, solver)
    all_here = _sliding(all_here, state, balance)
    rods = _eliminated_rods(all_here, state, balance, find)
    if all(here.at_ends is None for here in all_here):
        bodies, contacts = _condensed(assembly, all_here, rods, state, balance, find), None
    else:
        rods, bodies, contacts = _with_contacts(assembly, all_here, touching, rods, state, balance, find)
    steps = _steps(assembly, all_here, rods, bodies, contacts, balance, solver)
    is_sought = (rods.is_definite & (bodies.below == 0)) if find == "minimum" else jnp.array(True)
    is_pushed = rods.is_pushed | bodies.is_pushed
    is_unjudged = is_pushed | (find != "minimum")
    trial = _searched(assembly, all_here, touching, state, steps, balance, is_unjudged, is_sought)
    status = _status(state, balance, trial, steps, is_sought, solver)
    for group, here in zip(assembly.groups, all_here, strict=True):
        is_given_up = (status == Status.MAX_ITERATIONS) | (status == Status.LINE_SEARCH_FAILED)
        slid_out = jax.vmap(lambda form, point, ends: form.has_slid_out(point, ends), (0, 0, None))
        has_slid_out = slid_out(group.form, here.points, is_given_up)
        if has_slid_out is not None:
            is_open = is_given_up | (status == Status.RUNNING)
            status = jnp.where(jnp.any(has_slid_out) & is_open, Status.SLID_OUT, status)
        is_blocked = jax.vmap(lambda form, point: form.is_blocked(point))(group.form, here.points)
        if is_blocked is not None:
            status = jnp.where(jnp.any(is_blocked) & (status == Status.RUNNING), Status.MAX_ITERATIONS, status)
    is_given_up = (status == Status.MAX_ITERATIONS) | (status == Status.LINE_SEARCH_FAILED)
    for contacts_of_pairs in touching:
        status = jnp.where(is_given_up & are_crowded(contacts_of_pairs), Status.CROWDED, status)
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
        at_ends = _split(all_here, at_ends, contacts.at_ends, lambda pressures, change: pressures + pushed * change)
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


def _linearized(
    rod: RodInBodies, point: Any, pressures: Float[Array, "o 2"] | None
) -> tuple[Any, Linearization, Coupling, EndContacts | None, Array, Array]:
    form = rod.form_at()
    point = form.holding(point)
    here, coupling = linearized_with_ends(rod, form, point)
    point, at_ends = form.accepted(point, here), None
    if pressures is not None:
        assert isinstance(form, NodalForm | SlidingForm)
        at_ends, coupling = end_contacts(rod, form, pressures, coupling)
        here = dataclasses.replace(here, residual=jnp.maximum(here.residual, at_ends.residual))
    aside = components(here.bases, generic_field(point.tangents, scene_axes(form.scene)))
    return point, here, coupling, at_ends, form.rounding_floor(point), aside


def _split(all_here: list[_Here], of_all: Any, of_contacts: Any, changed: Any) -> tuple[Any, ...]:
    """What all groups have, changed by what those with contacts have."""
    in_contact = iter(of_contacts)
    return tuple(
        one if here.at_ends is None else changed(one, next(in_contact))
        for here, one in zip(all_here, of_all, strict=True)
    )


# --- balance ---------------------------------------------------------------------------------------------------------


def _balance(
    assembly: Assembly, all_here: list[_Here], touching: tuple[Contacts, ...], state: State, solver: Newton
) -> _Balance:
    forces = tuple(here.coupling.first for here in all_here)
    gradient, stiffness = assembly.body_derivatives(state.poses)
    gradient, residual = assembly.balance_of_bodies(gradient, forces)
    is_settled = residual <= SETTLED
    floor, is_closed = jnp.zeros_like(residual), jnp.array(True)
    for group, here in zip(assembly.groups, all_here, strict=True):
        residual = jnp.maximum(residual, jnp.max(here.linearization.residual))
        is_settled &= jnp.all(_is_settled(here.linearization))
        floor = jnp.maximum(floor, jnp.max(here.floor))
        closed = jax.vmap(lambda form, constraint_residual: form.is_closed(constraint_residual, solver.tolerance))
        is_closed &= jnp.all(closed(group.form, here.linearization.constraint_residual))
    for contacts in touching:
        residual = jnp.maximum(residual, contacts.residual)
    balanced = jnp.where(residual <= floor, Status.ROUNDING_FLOOR, Status.RUNNING)
    balanced = jnp.where(residual <= solver.tolerance, Status.CONVERGED, balanced)
    stagnates = (state.iterations > 0) & (residual > state.residual / 2) & (residual <= STAGNATION * floor)
    balanced = jnp.where(stagnates & (balanced == Status.RUNNING), Status.ROUNDING_FLOOR, balanced)
    is_balanced = is_closed & (balanced != Status.RUNNING)
    residuals = tuple(here.linearization.residual for here in all_here)
    return _Balance(gradient, stiffness, residuals, residual, floor, balanced, is_balanced, is_settled)


def _is_settled(here: Linearization) -> Bool[Array, "k"]:
    return here.slides if isinstance(here, SlidingLinearization) else here.residual <= SETTLED


def _sliding(all_here: list[_Here], state: State, balance: _Balance) -> list[_Here]:
    """Rods slide through clips once all of the harness is near its equilibrium at the arclengths where they are."""
    found = []
    for here, last in zip(all_here, state.points, strict=True):
        linearization = here.linearization
        if isinstance(linearization, SlidingLinearization):
            slides = last.slides | balance.is_settled
            here = here._replace(
                points=dataclasses.replace(here.points, slides=slides),
                linearization=dataclasses.replace(linearization, slides=slides),
            )
        found.append(here)
    return found


# --- the rods eliminated ---------------------------------------------------------------------------------------------


def _eliminated_rods(all_here: list[_Here], state: State, balance: _Balance, find: Find) -> _Rods:
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
    return _Rods(all_found, tuple(shifts), is_definite, negative, is_pushed)


def _eliminated(
    here: _Here, last: Float[Array, "k"], state: State, balance: _Balance, find: Find
) -> tuple[Eliminated, Float[Array, "k"], Bool[Array, ""]]:
    """Under the least shifts with which each rod by itself has a minimum, and those; whether a rod is pushed aside."""
    least = jnp.asarray(NEUTRAL, last.dtype)
    h = 1 / here.linearization.gradient.shape[2]
    nothing = jnp.zeros_like(here.aside)
    systems = here.rods.form, here.linearization, here.coupling
    if find == "equilibrium":
        shift = jnp.full_like(last, least)
        found = jax.vmap(eliminated)(*systems, shift, nothing)
        return found, shift, jnp.array(False)
    shift = _first_shift(last, state, balance)

    def pushes(shift: Float[Array, "k"]) -> Float[Array, "k"]:
        return PUSH * h * _pushing(shift, state, balance)

    def again(trial: tuple[Array, Array, Eliminated]) -> tuple[Array, Array, Eliminated]:
        shift, tries, found = trial
        larger = jnp.maximum(SHIFT_GROWTH * shift, _least_shift(last))
        shift = jnp.where((tries > 0) & ~found.is_minimum, larger, shift)
        push = pushes(shift)[:, None, None] * here.aside
        return shift, tries + 1, jax.vmap(eliminated)(*systems, shift, push)

    kinds = jax.eval_shape(jax.vmap(eliminated), *systems, shift, nothing)
    blank = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), kinds)
    shift, _, found = jax.lax.while_loop(
        lambda trial: (trial[1] == 0) | (~jnp.all(trial[2].is_minimum) & (trial[1] < MAX_FACTORS)),
        again,
        (shift, jnp.zeros((), int), blank),
    )
    return found, shift, jnp.any(pushes(shift) > 0)


def _first_shift(last: Float[Array, "k"], state: State, balance: _Balance) -> Float[Array, "k"]:
    least = jnp.asarray(NEUTRAL, last.dtype)
    shift = jnp.where(balance.is_balanced | (last <= FIRST_SHIFT), least, last / SHIFT_GROWTH**2)
    return jnp.maximum(shift, state.damping)


def _least_shift(last: Float[Array, "k"]) -> Float[Array, "k"]:
    """That is tried where one of nothing is too little: less than last time, as shifts that are much larger than a
    negative stiffness are crawled along.
    """
    return jnp.where(last > NEUTRAL, jnp.clip(last / SHIFT_GROWTH, LEAST_SHIFT, FIRST_SHIFT), FIRST_SHIFT)


def _pushing(shift: Float[Array, "k"], state: State, balance: _Balance) -> Float[Array, "k"]:
    """The shifts of rods that are to be pushed aside, of others 0."""
    is_near = balance.is_balanced | (balance.residual <= NEAR * shift)
    pushed = (state.pushes < MAX_PUSHES) & ((state.pushes == 0) | is_near) & (shift > NEUTRAL) & (state.damping == 0)
    return jnp.where(pushed, shift, 0.0)


# --- the bodies ------------------------------------------------------------------------------------------------------


def _condensed(
    assembly: Assembly, all_here: list[_Here], rods: _Rods, state: State, balance: _Balance, find: Find
) -> _Bodies:
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
    return _Bodies((motions @ coordinates).reshape(assembly.count, 6), below, is_pushed)


def _is_symmetric(assembly: Assembly, all_here: list[_Here]) -> bool:
    """Whether S is: else steps are those of its symmetric part until that is positive, and then its own."""
    return assembly.bodies.moment is None and all(here.coupling.is_symmetric for here in all_here)


def _condensed_system(
    assembly: Assembly, all_here: list[_Here], rods: _Rods, balance: _Balance
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


def _with_contacts(
    assembly: Assembly,
    all_here: list[_Here],
    touching: tuple[Contacts, ...],
    rods: _Rods,
    state: State,
    balance: _Balance,
    find: Find,
) -> tuple[_Rods, _Bodies, ContactStep]:
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
    together, chosen = between(touching) if touching else (None, ())
    of_pairs = in_contact(assembly.pairs)
    for number, (group, here, last) in enumerate(zip(assembly.groups, all_here, state.shifts, strict=True)):
        if here.at_ends is None:
            continue
        shift = _first_shift(last, state, balance) if find == "minimum" else jnp.full_like(last, least)
        pushing = _pushing(last, state, balance) if find == "minimum" else jnp.zeros_like(last)
        is_pushed |= jnp.any(pushing > 0)
        pushes = (PUSH / here.aside.shape[2] * pushing)[:, None, None] * here.aside
        forms = jax.vmap(lambda rod: rod.form_at())(here.rods)
        parts = forms, here.points, here.linearization, here.coupling, here.at_ends, pushes
        touched = RodsInContact.of(*parts, moved[len(groups)], assembly.shares(group))
        if together is not None and number in of_pairs:
            columns = _columns(assembly, number, here, forms, chosen)
            touched = touched.touched(columns, together.pressures)
        groups.append(touched)
        shifts.append(shift)
        least_shifts.append(_least_shift(last))
    push = jnp.where(may_push & balance.is_balanced, PUSH, 0.0).astype(dtype)
    pattern = jnp.asarray(_generic(len(force), dtype))
    parts = stiffness, force, push, pattern, LEAST_STIFFNESS, find == "minimum"
    model = ContactModel(tuple(groups), tuple(least_shifts), *parts, together, _is_symmetric(assembly, all_here))
    found = contact_step(model, tuple(shifts), state.damping)
    is_definite = rods.is_definite & found.is_found
    for shift in found.shifts:
        is_definite &= jnp.all(shift <= least)
    all_rods = _Rods(
        rods.found,
        _split(all_here, rods.shifts, found.shifts, lambda _, shift: shift),
        is_definite,
        rods.negative + found.negative,
        is_pushed,
    )
    pushes_bodies = (found.below > 0) & (push > 0)
    motions = (assembly.bodies.motions @ found.q[:count]).reshape(assembly.count, 6)
    return all_rods, _Bodies(motions, found.below, pushes_bodies), found


def _columns(assembly: Assembly, number: int, here: _Here, forms: NodalForm, chosen: Any) -> Columns:
    group, system = assembly.groups[number], here.linearization.system
    assert isinstance(system, ChainSystem)
    free = jax.vmap(free_points)(forms, here.linearization)
    scales = group.units.length / assembly.length, assembly.shares(group)
    return columns_of(number, assembly.pairs, chosen, system, here.coupling, free, scales)


# --- the step --------------------------------------------------------------------------------------------------------


def _steps(
    assembly: Assembly,
    all_here: list[_Here],
    rods: _Rods,
    bodies: _Bodies,
    contacts: ContactStep | None,
    balance: _Balance,
    solver: Newton,
) -> _Steps:
    largest = jnp.max(jnp.sum(bodies.motions[:, 3:] ** 2, axis=1), initial=0.0)
    padded = jnp.pad(bodies.motions, ((0, 1), (0, 0)))
    steps, ends, limits = [], [], []
    in_contact = iter(() if contacts is None else contacts.motions)
    at_ends_changes = iter(() if contacts is None else contacts.at_ends)
    for group, here, found in zip(assembly.groups, all_here, rods.found, strict=True):
        of_ends = padded[group.body]
        if found is None:
            rotation, multipliers = next(in_contact)
        else:
            flat = of_ends.reshape(-1, 12)
            rotation = found.rotation - jnp.einsum("kbmi,ki->kbm", found.rotations, flat)
            multipliers = found.multipliers - jnp.einsum("kci,ki->kc", found.multipliers_by_motions, flat)
        change = jax.vmap(lambda form, y: form.layout.forces(form.force_components(y)))(group.form, multipliers)
        others = jax.vmap(lambda form, y: form.others(y))(group.form, multipliers)
        at_ends_change = None if here.at_ends is None else next(at_ends_changes)
        bases = here.linearization.bases
        steps.append(RodStep(here.points, bases, rotation, change, others, here.at_ends, at_ends_change))
        ends.append(of_ends)
        largest = jnp.maximum(largest, jnp.max(jnp.sum(rotation**2, axis=1)))
        longest = jax.vmap(lambda form, *parts: form.longest_step(*parts))(group.form, here.points, others)
        limits += [] if longest is None else [jnp.min(longest)]
    part = jnp.minimum(1.0, solver.max_rotation / jnp.sqrt(largest))
    for limit in limits:
        part = jnp.minimum(part, limit)
    steps = [
        step._replace(
            force_change=part * step.force_change,
            others=jax.vmap(lambda form, others: form.scaled(others, 1.0, part))(group.form, step.others),
            at_ends_change=None if step.at_ends_change is None else part * step.at_ends_change,
        )
        for group, step in zip(assembly.groups, steps, strict=True)
    ]
    is_finite = jnp.isfinite(balance.residual) & jnp.isfinite(largest)
    return _Steps(steps, ends, bodies.motions, part, is_finite, None if contacts is None else contacts.between)


def _searched(
    assembly: Assembly,
    all_here: list[_Here],
    touching: tuple[Contacts, ...],
    state: State,
    steps: _Steps,
    balance: _Balance,
    is_unjudged: Bool[Array, ""],
    is_sought: Bool[Array, ""],
) -> _Trial:
    """The part of a step that is taken: the first of ever shorter ones that lowers the merit, or that is not judged."""

    def curves_at(part: Float[Array, ""], points: tuple[Any, ...]) -> dict[int, Curve]:
        return assembly.curves(assembly.forms(state.poses, tuple(part * ends for ends in steps.ends)), points)

    def merit_at(part: Float[Array, ""]) -> tuple[Float[Array, ""], tuple[Any, ...]]:
        """The energy, with L of the rods and the squared closures, and the points of the rods."""
        energy = jnp.sum(assembly.body_energies(state.poses, part * steps.bodies))
        lacking, points = jnp.zeros_like(energy), []
        for group, here, step, of_ends in zip(assembly.groups, all_here, steps.rods, steps.ends, strict=True):
            shares = assembly.shares(group)
            value, constraint_residual, point = jax.vmap(
                lambda step, rod, of_ends: step.value(rod, part * of_ends, part)
            )(step, here.rods, of_ends)
            energy += jnp.sum(shares * value)
            lacking += jnp.sum(shares[:, None] * constraint_residual**2) / 2
            points.append(point)
        if touching:
            assert steps.between is not None
            curves = curves_at(part, tuple(points))
            changes = steps.between.changed(state.pairs)
            for pairs, contacts, change in zip(assembly.pairs, touching, changes, strict=True):
                energy += contact_energy(pairs, curves, contacts, steps.part * change)
        return energy + weight * lacking, tuple(points)

    slope, rate = _slopes(assembly, all_here, steps, balance.gradient)
    if steps.between is not None:
        slope += steps.between.slope(steps.part)
    weight = jnp.maximum(CLOSURE_WEIGHT, 2 * slope / jnp.where(rate < 0, -rate, jnp.inf))
    slope += weight * rate

    def tried(trial: _Trial) -> _Trial:
        """First where the step begins, under the new forces; then all of it, and ever shorter parts."""
        tries = trial.tries + 1
        next_part = jnp.where(tries == 1, steps.part, trial.part / 2)
        merit, points = merit_at(jnp.where(tries == 0, 0.0, next_part))
        bound = trial.first + SUFFICIENT_DECREASE * next_part * jnp.minimum(slope, 0.0)
        bound += ENERGY_ROUNDING * (1 + jnp.abs(trial.first))
        is_better = (tries > 0) & (is_unjudged | (merit <= bound))
        for group, here, point in zip(assembly.groups, all_here, points, strict=True):
            if here.at_ends is not None:
                stays = jax.vmap(
                    lambda form, here, there, is_better: form.accepts(here, there, is_better), (0, 0, 0, None)
                )
                is_better &= jnp.all(stays(group.form, here.points, point, is_better))
        if touching:
            curves = curves_at(jnp.where(tries == 0, 0.0, next_part), points)
            for pairs, contacts in zip(assembly.pairs, touching, strict=True):
                is_better &= passes(pairs, contacts, curves)
        return _Trial(next_part, tries, jnp.where(tries == 0, merit, trial.first), is_better, points)

    # At the end no step is tried.
    is_done, here = balance.is_balanced & is_sought, tuple(here.points for here in all_here)
    start = _Trial(steps.part, jnp.full((), -1), jnp.zeros_like(slope), is_done, here)
    return jax.lax.while_loop(lambda trial: ~trial.is_better & (trial.tries <= MAX_HALVINGS), tried, start)


def _slopes(
    assembly: Assembly, all_here: list[_Here], steps: _Steps, gradient: Float[Array, "j 6"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How fast L, and half of the squared closures, change as a step begins under the new forces, which L has to first
    order.
    """
    slope, rate = jnp.sum(gradient * steps.bodies), jnp.zeros((), gradient.dtype)
    for group, here, step, of_ends in zip(assembly.groups, all_here, steps.rods, steps.ends, strict=True):
        shares = assembly.shares(group)
        if isinstance(group.form, NodalForm | SlidingForm):
            (_, closing), (along, rates) = _rates(here, step, of_ends)
            # What the motions of the ends do without contacts is in the gradient of the bodies.
            known = jnp.sum(here.coupling.first * of_ends.reshape(-1, 12), axis=1)
            slope += jnp.sum(shares * (along - known))
            rate += jnp.sum(shares[:, None] * closing * rates)
            continue

        def of_rod(form: Form, here: Linearization, coupling: Coupling, step: RodStep, motions: Array):
            nothing = jnp.zeros_like(here.gradient)
            change = jnp.zeros_like(here.constraint_residual)
            count = len(change)
            change = change.at[count - form.layout.size :].set(form.layout.components(step.force_change))
            by_force, lost = here.system.times(nothing, change)
            _, closing = here.system.times(step.rotation, jnp.zeros_like(change))
            closing += coupling.of_constraints @ motions
            along = jnp.sum((here.gradient + by_force) * step.rotation) + jnp.sum(
                change * (coupling.of_constraints @ motions)
            )
            return along, jnp.sum(
                form.force_components(here.constraint_residual + lost) * form.force_components(closing)
            )

        along, closing = jax.vmap(of_rod)(group.form, here.linearization, here.coupling, step, of_ends.reshape(-1, 12))
        slope += jnp.sum(shares * along)
        rate += jnp.sum(shares * closing)
    return slope, rate


def _rates(here: _Here, step: RodStep, of_ends: Float[Array, "k 2 6"]) -> tuple[Any, Any]:
    """L of rods that slide or have positions of nodes, and what they lack of their spans, and how fast these change as
    a step begins under the new forces.
    """

    def of_rod(
        step: RodStep, rod: RodInBodies, here: Linearization, coupling: Coupling, of_ends: Float[Array, "2 6"]
    ) -> tuple[Any, Any]:
        zero, form = jnp.zeros((), of_ends.dtype), rod.form
        if step.at_ends is None or not isinstance(form, NodalForm):
            return jax.jvp(lambda part: step.value(rod, part * of_ends, part)[:2], (zero,), (jnp.ones_like(zero),))
        values, (along, rates) = jax.jvp(
            lambda part: step.without_contacts(rod, part * of_ends, part)[1:3], (zero,), (jnp.ones_like(zero),)
        )
        return values, (along + step.contact_rate(form, here, coupling, of_ends), rates)

    return jax.vmap(of_rod)(step, here.rods, here.linearization, here.coupling, of_ends)


# --- what follows ----------------------------------------------------------------------------------------------------


def _status(
    state: State, balance: _Balance, trial: _Trial, steps: _Steps, is_sought: Bool[Array, ""], solver: Newton
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
    assembly: Assembly, all_here: list[_Here], state: State, balance: _Balance, status: Int[Array, ""]
) -> tuple[tuple[Any, ...], Bool[Array, ""]]:
    """The points, with what a search changes at its beginning or end alone; whether it goes on from there."""
    points, changes = [], jnp.array(False)
    begins = (state.iterations == 0) & ~balance.is_balanced & (status == Status.RUNNING)  # finite, then
    ends = is_converged(status)
    for group, here in zip(assembly.groups, all_here, strict=True):
        if not group.form.refines:
            points.append(here.points)
            continue
        found, differ = jax.vmap(lambda form, point: form.refined(point, ends))(group.form, here.points)
        is_new = (a != b for a, b in zip(*map(jax.tree.leaves, (found, here.points)), strict=True))
        differs = functools.reduce(jnp.logical_or, map(jnp.any, is_new))
        changes |= (begins & differs) | (ends & jnp.any(differ))
        points.append(jax.tree.map(lambda new, old: jnp.where(begins | ends, new, old), found, here.points))
    return tuple(points), changes


def _wells(
    assembly: Assembly, state: State, balance: _Balance, status: Int[Array, ""]
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


def _damping(state: State, trial: _Trial) -> Float[Array, ""]:
    """What stiffens rods and bodies in the next step: more where no part of this one is better."""
    less, more = state.damping / SHIFT_GROWTH**2, jnp.maximum(SHIFT_GROWTH * state.damping, FIRST_SHIFT)
    return jnp.where(trial.is_better, jnp.where(less < FIRST_SHIFT, 0.0, less), more)
