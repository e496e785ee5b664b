"""A step of all rods and bodies of an assembly, and the part of it that is taken.

Steps are judged as those of `newton`: by L with the new forces and the square of the constraint residuals.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.form import Form, Linearization
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.sliding import SlidingForm
from rodjax.linalg.chain import ChainSystem
from rodjax.mechanics.energy import dead_load_energy
from rodjax.model.scene import held_position
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, State
from rodjax.solving.assembly_balance import Balance, Here
from rodjax.solving.condensation import BodyMotions, EliminatedRods
from rodjax.solving.coupling import Coupling, EndContacts, RodInBodies, end_contact_energy, end_contact_rate
from rodjax.solving.harness_contact import ContactStep
from rodjax.solving.newton import CLOSURE_WEIGHT, MAX_HALVINGS, SUFFICIENT_DECREASE, Newton, energy_rounding
from rodjax.solving.rod_contact import BetweenStep, Contacts, Curves, contact_energy, passes


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


class Steps(NamedTuple):
    """A step of all rods and bodies, of which `part` is the most that may be taken; forces change by that part."""

    rods: list[RodStep]
    ends: list[Float[Array, "k 2 6"]]
    bodies: Float[Array, "j 6"]
    part: Float[Array, ""]
    is_finite: Bool[Array, ""]
    between: BetweenStep | None


class Trial(NamedTuple):
    """A part of a step, how many were tried before it, the merit where the step begins, whether this one is better,
    and the points of the rods.
    """

    part: Float[Array, ""]
    tries: Int[Array, ""]
    first: Float[Array, ""]
    is_better: Bool[Array, ""]
    points: tuple[Any, ...]


def steps_from(
    assembly: Assembly,
    all_here: list[Here],
    rods: EliminatedRods,
    bodies: BodyMotions,
    contacts: ContactStep | None,
    balance: Balance,
    solver: Newton,
) -> Steps:
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
        change = of_each(lambda form, y: form.layout.forces(form.force_components(y)))(group.form, multipliers)
        others = of_each(lambda form, y: form.others(y))(group.form, multipliers)
        at_ends_change = None if here.at_ends is None else next(at_ends_changes)
        bases = here.linearization.bases
        steps.append(RodStep(here.points, bases, rotation, change, others, here.at_ends, at_ends_change))
        ends.append(of_ends)
        largest = jnp.maximum(largest, jnp.max(jnp.sum(rotation**2, axis=1)))
        longest = of_each(lambda form, *parts: form.longest_step(*parts))(group.form, here.points, others)
        limits += [] if longest is None else [jnp.min(longest)]
    part = jnp.minimum(1.0, solver.max_rotation / jnp.sqrt(largest))
    for limit in limits:
        part = jnp.minimum(part, limit)
    steps = [
        step._replace(
            force_change=part * step.force_change,
            others=of_each(lambda form, others: form.scaled(others, 1.0, part))(group.form, step.others),
            at_ends_change=None if step.at_ends_change is None else part * step.at_ends_change,
        )
        for group, step in zip(assembly.groups, steps, strict=True)
    ]
    is_finite = jnp.isfinite(balance.residual) & jnp.isfinite(largest)
    return Steps(steps, ends, bodies.motions, part, is_finite, None if contacts is None else contacts.between)


def searched(
    assembly: Assembly,
    all_here: list[Here],
    touching: tuple[Contacts, ...],
    state: State,
    steps: Steps,
    balance: Balance,
    is_unjudged: Bool[Array, ""],
    is_sought: Bool[Array, ""],
) -> Trial:
    """The part of a step that is taken: the first of ever shorter ones that lowers the merit, or that is not judged."""

    def curves_at(part: Float[Array, ""], points: tuple[Any, ...]) -> Curves:
        return assembly.curves(assembly.forms(state.poses, tuple(part * ends for ends in steps.ends)), points)

    def merit_at(part: Float[Array, ""]) -> tuple[Float[Array, ""], tuple[Any, ...]]:
        """The energy, with L of the rods and the squared closures, and the points of the rods."""
        energy = jnp.sum(assembly.body_energies(state.poses, part * steps.bodies))
        lacking, points = jnp.zeros_like(energy), []
        for group, here, step, of_ends in zip(assembly.groups, all_here, steps.rods, steps.ends, strict=True):
            shares = assembly.shares(group)
            value, constraint_residual, point = of_each(
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

    def tried(trial: Trial) -> Trial:
        """First where the step begins, under the new forces; then all of it, and ever shorter parts."""
        tries = trial.tries + 1
        next_part = jnp.where(tries == 1, steps.part, trial.part / 2)
        merit, points = merit_at(jnp.where(tries == 0, 0.0, next_part))
        bound = trial.first + SUFFICIENT_DECREASE * next_part * jnp.minimum(slope, 0.0)
        bound += energy_rounding(trial.first)
        is_better = (tries > 0) & (is_unjudged | (merit <= bound))
        for group, here, point in zip(assembly.groups, all_here, points, strict=True):
            if here.at_ends is not None:
                stays = of_each(
                    lambda form, here, there, is_better: form.accepts(here, there, is_better), (0, 0, 0, None)
                )
                is_better &= jnp.all(stays(group.form, here.points, point, is_better))
        if touching:
            curves = curves_at(jnp.where(tries == 0, 0.0, next_part), points)
            for pairs, contacts in zip(assembly.pairs, touching, strict=True):
                is_better &= passes(pairs, contacts, curves)
        return Trial(next_part, tries, jnp.where(tries == 0, merit, trial.first), is_better, points)

    # At the end no step is tried.
    is_done, here = balance.is_balanced & is_sought, tuple(here.points for here in all_here)
    start = Trial(steps.part, jnp.full((), -1), jnp.zeros_like(slope), is_done, here)
    return jax.lax.while_loop(lambda trial: ~trial.is_better & (trial.tries <= MAX_HALVINGS), tried, start)


def _slopes(
    assembly: Assembly, all_here: list[Here], steps: Steps, gradient: Float[Array, "j 6"]
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


def _rates(here: Here, step: RodStep, of_ends: Float[Array, "k 2 6"]) -> tuple[Any, Any]:
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

    return of_each(of_rod)(step, here.rods, here.linearization, here.coupling, of_ends)
