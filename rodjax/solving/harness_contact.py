"""Which contacts of a harness are closed: the minimum of the model of a step, of all its rods and bodies together.

As `linalg.unilateral` has it: a solution is one factorisation of each rod with the contacts closed that are so at the
last iterate, eliminated to the motions of the bodies. Contacts of a rod know of its nodes and of the motions of its two
ends; contacts of a body, where a rod ends in it, of these motions alone. Where the stiffness of the bodies is negative
along a motion, it is reversed for the rest of the search, and a rod without a minimum becomes stiffer, so that the
model only gains stiffness while its minimum is sought.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import Linearization
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.node_contacts import contact_model
from rodjax.linalg.chain import ChainSystem, factor_chain
from rodjax.linalg.unilateral import Unilateral, closed_softly, sought, with_pressures, work
from rodjax.solving.coupling import Coupling, EndContacts
from rodjax.solving.newton import FIRST_SHIFT, MAX_FACTORS, SHIFT_GROWTH


class RodsInContact(eqx.Module):
    """Rods of one structure beside obstacles, stacked along a first axis of every array.

    `contacts`: at nodes and within elements; `f`, `c`: right sides without them; `at_ends`: contacts of the bodies in
    which the rods end; `first`: the derivative of L by the motions of the ends without contacts; `body`: of each end;
    `shares`: the unit of energy of each rod, in that of the bodies.
    """

    system: ChainSystem
    coupling: Coupling
    contacts: Unilateral
    f: Float[Array, "k b m"]
    c: Float[Array, "k j"]
    at_ends: EndContacts
    first: Float[Array, "k 12"]
    body: Int[Array, "k 2"]
    shares: Float[Array, "k"]

    @staticmethod
    def of(
        forms: NodalForm,
        points: Any,
        here: Linearization,
        coupling: Coupling,
        at_ends: EndContacts,
        pushes: Float[Array, "k b m"],
        body: Int[Array, "k 2"],
        shares: Float[Array, "k"],
    ) -> "RodsInContact":
        def of_rod(
            form: NodalForm, point: Any, here: Linearization, coupling: Coupling, at_ends: EndContacts, push: Array
        ):
            system, forces = here.system, point.nodal.contact_forces
            assert isinstance(system, ChainSystem)
            assert here.gaps is not None
            assert coupling.of_gaps is not None
            moments, c = form.without_contacts(here, forces)
            contacts = contact_model(form, point, here.gaps, here.reference_displacements)
            system = system.closed_where(form.first_closed(system.contacts.is_closed, contacts))
            first = coupling.first + jnp.einsum("rni,rn->i", coupling.of_gaps, forces)
            first += jnp.einsum("oei,oe->ei", at_ends.rates, at_ends.pressures).reshape(12)
            return system, contacts, push + moments, c, first

        system, contacts, f, c, first = jax.vmap(of_rod)(forms, points, here, coupling, at_ends, pushes)
        return RodsInContact(system, coupling, contacts, f, c, at_ends, first, body, shares)

    @property
    def size(self) -> int:
        """How many contacts all rods have."""
        return self.contacts.gaps.size + self.at_ends.gaps.size

    @property
    def contact_compliance(self) -> Float[Array, "size"]:
        """Of all contacts, in a row."""
        contact_compliance = self.system.contacts.contact_compliance
        return self.row(*(jnp.broadcast_to(contact_compliance[:, None, None], x.shape) for x in self._shapes))

    @property
    def weights(self) -> Float[Array, "size"]:
        return self.row(*(jnp.broadcast_to(self.shares[:, None, None], x.shape) for x in self._shapes))

    @property
    def _shapes(self) -> tuple[Array, Array]:
        return self.contacts.gaps, self.at_ends.gaps

    def row(self, of_rods: Array, at_ends: Array) -> Array:
        return jnp.concatenate([of_rods.reshape(-1), at_ends.reshape(-1)])

    def split(self, row: Array) -> tuple[Array, Array]:
        of_rods, at_ends = self._shapes
        return row[: of_rods.size].reshape(of_rods.shape), row[of_rods.size :].reshape(at_ends.shape)

    def of_ends(self, motions: Float[Array, "j+1 6"]) -> Float[Array, "k 12"]:
        return motions[self.body].reshape(-1, 12)

    def opening(self, motion: tuple[Array, Array], motions: Float[Array, "j+1 6"]) -> Float[Array, "size"]:
        of_ends = self.of_ends(motions)

        def of_rod(system: ChainSystem, coupling: Coupling, x: Array, y: Array, q: Array) -> Array:
            assert coupling.of_gaps is not None
            return system.contacts.rates(x, system.split(y)[2]) + coupling.of_gaps @ q

        rates = jax.vmap(of_rod)(self.system, self.coupling, *motion, of_ends)
        return self.row(rates, jnp.einsum("koei,kei->koe", self.at_ends.rates, of_ends.reshape(-1, 2, 6)))


class Eliminated(NamedTuple):
    """Rods with some contacts closed, under a shift: whether they have a minimum, negative eigenvalues, solutions
    without motions of the ends and by these, and what is left for the ends: stiffness, and forces.
    """

    is_minimum: Bool[Array, "k"]
    negative: Int[Array, "k"]
    motion: tuple[Array, Array]
    by_motions: tuple[Array, Array]
    stiffness: Float[Array, "k 12 12"]
    force: Float[Array, "k 12"]


def _eliminated(
    rods: RodsInContact, is_closed: Array, contact_compliance: Array, shift: Float[Array, "k"]
) -> Eliminated:
    def of_rod(
        rod: RodsInContact, is_closed: Array, closed_end: Array, contact_compliance: Array, shift: Array
    ) -> Eliminated:
        coupling, at_ends, m = rod.coupling, rod.at_ends, rod.f.shape[1]
        assert coupling.of_gaps is not None
        system = closed_softly(rod.system, is_closed, contact_compliance)
        f, c = with_pressures(system, rod.contacts, rod.f, rod.c)
        factors = factor_chain(system.shifted(shift / m))
        rates = jnp.where(is_closed[..., None], coupling.of_gaps, 0.0)
        size = len(system.compliance)
        of_constraints = coupling.of_constraints.at[size : size + is_closed.size].add(-rates.reshape(-1, 12))
        x, y = factors.solve_softly(f, c)
        by_motions = jax.vmap(factors.solve_softly, (-1, -1), -1)(coupling.of_gradient, of_constraints)
        stiffness = coupling.second - jnp.einsum("bmi,bmj->ij", coupling.of_gradient, by_motions[0])
        stiffness -= of_constraints.T @ by_motions[1]
        force = jnp.einsum("rni,rn->i", rates, rod.contacts.pressures) - rod.first
        force -= jnp.einsum("bmi,bm->i", coupling.of_gradient, x) + of_constraints.T @ y
        # Contacts of the bodies have no unknowns of the rod.
        rates = jnp.where(closed_end[..., None], at_ends.rates, 0.0)
        pressures = at_ends.pressures - at_ends.gaps / contact_compliance
        stiff = jnp.einsum("oei,oej->eij", rates, rates) / contact_compliance
        pushed = jnp.einsum("oei,oe->ei", rates, pressures)
        stiffness += jax.scipy.linalg.block_diag(*stiff)
        return Eliminated(
            factors.is_minimum, factors.negative, (x, y), by_motions, stiffness, force + pushed.reshape(12)
        )

    closed_rods, closed_ends = rods.split(is_closed)
    of_rods, _ = rods.split(contact_compliance)
    return jax.vmap(of_rod)(rods, closed_rods, closed_ends, of_rods[:, 0, 0], shift)


class BodyContacts(eqx.Module):
    """The contacts of all rods and bodies in a row, as `linalg.unilateral.Unilateral` those of one rod."""

    gaps: Float[Array, "c"]
    pressures: Float[Array, "c"]
    weights: Float[Array, "c"]

    def allowed(self, trial: Float[Array, "c"]) -> Float[Array, "c"]:
        return jnp.where(trial > 0, trial, 0.0)

    def is_closed(self, trial: Float[Array, "c"]) -> Bool[Array, "c"]:
        return trial > 0

    def energy(self, trial: Float[Array, "c"], contact_compliance: Float[Array, "c"]) -> Float[Array, ""]:
        return jnp.sum(self.weights * contact_compliance / 2 * self.allowed(trial) ** 2)

    def slope(
        self, trial: Float[Array, "c"], falls: Float[Array, "c"], contact_compliance: Float[Array, "c"]
    ) -> Float[Array, ""]:
        return -jnp.sum(self.weights * contact_compliance * self.allowed(trial) * falls)

    def growth(
        self, trial: Float[Array, "c"], falls: Float[Array, "c"], contact_compliance: Float[Array, "c"]
    ) -> Float[Array, ""]:
        return jnp.sum(jnp.where(trial > 0, self.weights * contact_compliance * falls, 0.0) * falls)

    def turned(self, trial: Array, other: Array) -> Bool[Array, ""]:
        return jnp.array(False)


class Memory(eqx.Module):
    """Shifts of the rods of each group, and how many negative eigenvalues they had; of the bodies what their stiffness
    was reversed by, how many of its eigenvalues were negative, and the force of a push aside.
    """

    shifts: tuple[Float[Array, "k"], ...]
    negative: tuple[Int[Array, "k"], ...]
    reversal: Float[Array, "q q"]
    below: Int[Array, ""]
    push: Float[Array, "q"]


class ContactModel(eqx.Module):
    """The model of a step. `stiffness`, `force`: of the bodies and of the rods that touch nothing, along `motions`.

    `push`: by how much a negative stiffness is answered with a force along its motion; `least`: below it a stiffness is
    negative; `may_reverse`: whether a minimum is sought.
    """

    groups: tuple[RodsInContact, ...]
    motions: Float[Array, "6j q"]
    stiffness: Float[Array, "q q"]
    force: Float[Array, "q"]
    push: Float[Array, ""]
    pattern: Float[Array, "q"]
    least: float = eqx.field(static=True)
    may_reverse: bool = eqx.field(static=True)

    is_symmetric = True

    def begin(self, shifts: tuple[Float[Array, "k"], ...], damping: Float[Array, ""]) -> Memory:
        size = len(self.force)
        none = tuple(jnp.zeros(len(shift), int) for shift in shifts)
        reversal = damping * jnp.eye(size, dtype=self.force.dtype)
        return Memory(shifts, none, reversal, jnp.zeros((), int), jnp.zeros_like(self.force))

    def nowhere(self) -> Any:
        of_rods = tuple((jnp.zeros_like(rods.f), jnp.zeros_like(rods.c)) for rods in self.groups)
        return of_rods, jnp.zeros_like(self.force)

    def bodies(self, q: Float[Array, "q"]) -> Float[Array, "j+1 6"]:
        """Their motions, and none of what is no body."""
        motions = self.motions @ q
        return jnp.concatenate([motions.reshape(-1, 6), jnp.zeros((1, 6), q.dtype)])

    def rows(self, parts: list[Array]) -> Array:
        return jnp.concatenate(parts)

    def split(self, row: Array) -> list[Array]:
        found, first = [], 0
        for rods in self.groups:
            found.append(row[first : first + rods.size])
            first += rods.size
        return found

    def _regularized(
        self, rods: RodsInContact, is_closed: Array, contact_compliance: Array, shift: Float[Array, "k"]
    ) -> tuple[Eliminated, Float[Array, "k"]]:
        """Stiffer until each rod by itself has a minimum."""
        if not self.may_reverse:
            return _eliminated(rods, is_closed, contact_compliance, shift), shift

        def again(trial: tuple[Array, Array, Eliminated]) -> tuple[Array, Array, Eliminated]:
            shift, tries, found = trial
            larger = jnp.maximum(SHIFT_GROWTH * shift, FIRST_SHIFT)
            shift = jnp.where((tries > 0) & ~found.is_minimum, larger, shift)
            return shift, tries + 1, _eliminated(rods, is_closed, contact_compliance, shift)

        kinds = jax.eval_shape(_eliminated, rods, is_closed, contact_compliance, shift)
        blank = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), kinds)
        shift, _, found = jax.lax.while_loop(
            lambda trial: (trial[1] == 0) | (~jnp.all(trial[2].is_minimum) & (trial[1] < MAX_FACTORS)),
            again,
            (shift, jnp.zeros((), int), blank),
        )
        return found, shift

    def solved(
        self, is_closed: Array, trial: Array, contact_compliance: Array, memory: Memory
    ) -> tuple[Array, Any, Memory]:
        stiffness, force = self.stiffness + memory.reversal, self.force + memory.push
        all_found, shifts, is_minimum = [], [], jnp.array(True)
        for rods, closed, soft, last in zip(
            self.groups, self.split(is_closed), self.split(contact_compliance), memory.shifts, strict=True
        ):
            found, shift = self._regularized(rods, closed, soft, last)
            all_found.append(found)
            shifts.append(shift)
            is_minimum &= jnp.all(found.is_minimum)
            at_bodies = self._at_ends(rods)
            stiffness += jnp.einsum("k,kiq,kij,kjp->qp", rods.shares, at_bodies, found.stiffness, at_bodies)
            force += jnp.einsum("k,kiq,ki->q", rods.shares, at_bodies, found.force)
        values, vectors = jnp.linalg.eigh((stiffness + stiffness.T) / 2)
        is_below = values < -self.least
        reversal, push = memory.reversal, memory.push
        if self.may_reverse:
            reversed_by = jnp.where(is_below, -2 * values, 0.0)
            reversal += (vectors * reversed_by[None]) @ vectors.T
            sides = jnp.where(vectors.T @ self.pattern < 0, -1.0, 1.0)
            aside = vectors @ jnp.where(is_below, self.push * jnp.abs(values) * sides, 0.0)
            push += aside
            force += aside
            regularized = jnp.maximum(jnp.abs(values), self.least)
        else:
            regularized = jnp.where(jnp.abs(values) < self.least, self.least, values)
            is_minimum &= ~jnp.any(is_below)
        q = vectors @ ((vectors.T @ force) / regularized)
        bodies, motions = self.bodies(q), []
        for rods, found in zip(self.groups, all_found, strict=True):
            of_ends = rods.of_ends(bodies)
            by_ends = (jnp.einsum("k...i,ki->k...", by, of_ends) for by in found.by_motions)
            motions.append(tuple(jax.tree.map(jnp.subtract, found.motion, tuple(by_ends))))
        negative = tuple(found.negative for found in all_found)
        below = jnp.where(jnp.any(is_below), jnp.sum(is_below), memory.below)
        return is_minimum, (tuple(motions), q), Memory(tuple(shifts), negative, reversal, below, push)

    def _at_ends(self, rods: RodsInContact) -> Float[Array, "k 12 q"]:
        """The motions of the ends of rods by q."""
        padded = jnp.pad(self.motions, ((0, 6), (0, 0))).reshape(-1, 6, self.motions.shape[1])
        return padded[rods.body].reshape(len(rods.body), 12, -1)

    def opening(self, motion: Any) -> Array:
        of_rods, q = motion
        bodies = self.bodies(q)
        return self.rows([rods.opening(each, bodies) for rods, each in zip(self.groups, of_rods, strict=True)])

    def along(self, motion: Any, change: Any, memory: Memory) -> tuple[Float[Array, ""], Float[Array, ""]]:
        stiffness = self.stiffness + memory.reversal
        (of_rods, q), (changes, dq) = motion, change
        slope = q @ stiffness @ dq - (self.force + memory.push) @ dq
        curvature = dq @ stiffness @ dq
        for rods, here, ahead, shift in zip(self.groups, of_rods, changes, memory.shifts, strict=True):
            slopes, curvatures = jax.vmap(_along_rod)(
                rods, shift, (*here, rods.of_ends(self.bodies(q))), (*ahead, rods.of_ends(self.bodies(dq)))
            )
            slope += jnp.sum(rods.shares * slopes)
            curvature += jnp.sum(rods.shares * curvatures)
        return slope, curvature


def _along_rod(
    rod: RodsInContact, shift: Float[Array, ""], here: tuple[Array, Array, Array], ahead: tuple[Array, Array, Array]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    coupling = rod.coupling
    system = rod.system.closed_where(jnp.zeros(rod.contacts.gaps.shape, bool)).shifted(shift / rod.f.shape[1])

    def times(x: Array, y: Array, q: Array) -> tuple[Array, Array, Array]:
        moments, rows = system.times(x, y)
        by_bodies = (
            coupling.second @ q + coupling.of_constraints.T @ y + jnp.einsum("bmi,bm->i", coupling.of_gradient, x)
        )
        return moments + coupling.of_gradient @ q, rows + coupling.of_constraints @ q, by_bodies

    def works(motion: tuple[Array, Array, Array], by: tuple[Array, Array, Array]) -> Float[Array, ""]:
        x, y, q = motion
        moments, rows, by_bodies = by
        return work(system, (x, y), (moments, rows)) + q @ by_bodies

    x, y, q = ahead
    by_ahead = times(*ahead)
    _, _, u, _ = system.split(y)
    _, _, of_nodes, _ = system.split(rod.c)
    linear = jnp.sum(rod.f * x) + jnp.sum(of_nodes * u) - rod.first @ q
    slope = (works(here, by_ahead) + works(ahead, times(*here))) / 2 - linear
    return slope, works(ahead, by_ahead)


class ContactStep(NamedTuple):
    """The step that a search found: of each group rotations, multipliers, the pressures at the ends, shifts, and
    negative eigenvalues; motions of the bodies; whether the contacts were found and the rods have a minimum.
    """

    motions: tuple[tuple[Array, Array], ...]
    at_ends: tuple[Float[Array, "k o 2"], ...]
    shifts: tuple[Float[Array, "k"], ...]
    negative: Int[Array, ""]
    bodies: Float[Array, "q"]
    below: Int[Array, ""]
    is_found: Bool[Array, ""]


def contact_step(model: ContactModel, shifts: tuple[Float[Array, "k"], ...], damping: Float[Array, ""]) -> ContactStep:
    """The minimum of a model."""
    groups = model.groups
    contacts = BodyContacts(
        *(
            model.rows(list(row))
            for row in (
                [rods.row(rods.contacts.gaps, rods.at_ends.gaps) for rods in groups],
                [rods.row(rods.contacts.pressures, rods.at_ends.pressures) for rods in groups],
                [rods.weights for rods in groups],
            )
        )
    )
    is_closed = model.rows([rods.row(rods.system.contacts.is_closed, rods.at_ends.is_closed) for rods in groups])
    contact_compliance = model.rows([rods.contact_compliance for rods in groups])
    end = sought(model, contacts, is_closed, contact_compliance, model.nowhere(), model.begin(shifts, damping))
    of_rods, q = end.motion
    change = contacts.allowed(contacts.pressures - (contacts.gaps + model.opening(end.motion)) / contact_compliance)
    change -= contacts.pressures
    motions, at_ends = [], []
    for rods, (x, y), row in zip(groups, of_rods, model.split(change), strict=True):
        in_rods, in_ends = rods.split(row)
        size = rods.system.compliance.shape[-1]
        y = y.at[:, size : size + in_rods[0].size].set(in_rods.reshape(len(y), -1))
        motions.append((x, y))
        at_ends.append(in_ends)
    negative = sum((jnp.sum(each) for each in end.memory.negative), jnp.zeros((), int))
    return ContactStep(
        tuple(motions),
        tuple(at_ends),
        end.memory.shifts,
        negative,
        q,
        end.memory.below,
        end.is_minimum & end.is_done,
    )
