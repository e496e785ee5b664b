"""Which contacts of a harness are closed: the minimum of the model of a step, of all its rods and bodies together.

As `linalg.unilateral` has it: a solution is one factorisation of each rod with the contacts closed that are so at the
last iterate, eliminated to the motions of the bodies. Contacts of a rod know of its nodes and of the motions of its two
ends; contacts of a body, where a rod ends in it, of these motions alone. Where the stiffness of the bodies is negative
along a motion, it is reversed for the rest of the search, and a rod without a minimum becomes stiffer, so that the
model only gains stiffness while its minimum is sought.

Contacts between rods are unknowns beside the motions of the bodies: the forces -p of closed ones, with the compliance
of the model, and what their curvature takes and adds (`linalg.far_rows`). Each rod is eliminated to its columns of
these as it is to the motions of its ends. Rods and contacts have a minimum between held bodies where all negative
eigenvalues are those of compliances (Haynsworth 1968): a rod alone need not have one, as where it leans on another.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import Linearization
from rodjax.discretization.nodal import NodalForm, held_back
from rodjax.discretization.node_contacts import contact_model
from rodjax.linalg.chain import ChainSystem, factor_chain
from rodjax.linalg.small_matrices import inverse_matrix, solved_where_regular
from rodjax.linalg.unilateral import Unilateral, closed_softly, sought, with_pressures, work
from rodjax.solving.coupling import Coupling, EndContacts
from rodjax.solving.newton import FIRST_SHIFT, MAX_FACTORS, SHIFT_GROWTH
from rodjax.solving.rod_contact import Between, BetweenStep, Columns


class RodsInContact(eqx.Module):
    """Rods of one structure beside obstacles, stacked along a first axis of every array.

    `contacts`: at nodes and within elements; `f`, `c`: right sides without them; `at_ends`: contacts of the bodies in
    which the rods end; `first`: the derivative of L by the motions of the ends without contacts; `body`: of each end;
    `shares`: the unit of energy of each rod, in that of the bodies; `columns`: of contacts with other rods, `None`
    without such.
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
    columns: Columns | None = None

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
            moments, c = form.without_contacts(here, forces)
            contacts = contact_model(form, point, here.gaps, here.reference_displacements)
            system = system.closed_where(form.first_closed(system.contacts.is_closed, contacts))
            first = coupling.first + jnp.einsum("rni,rn->i", _of_gaps(system, coupling), forces)
            first += jnp.einsum("oei,oe->ei", at_ends.rates, at_ends.pressures).reshape(12)
            return system, contacts, push + moments, c, first

        system, contacts, f, c, first = jax.vmap(of_rod)(forms, points, here, coupling, at_ends, pushes)
        return RodsInContact(system, coupling, contacts, f, c, at_ends, first, body, shares)

    def touched(self, columns: Columns, pressures: Float[Array, "c"]) -> "RodsInContact":
        """By other rods, whose pressures are among the loads so far."""
        gaps = columns.gaps(len(pressures))
        f, c, first = (
            self.f - gaps.rotation @ pressures,
            self.c - gaps.rows @ pressures,
            self.first + gaps.ends @ pressures,
        )
        return dataclasses.replace(self, f=f, c=c, first=first, columns=columns)

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
            return system.contacts.rates(x, system.split(y)[2]) + _of_gaps(system, coupling) @ q

        rates = jax.vmap(of_rod)(self.system, self.coupling, *motion, of_ends)
        return self.row(rates, jnp.einsum("koei,kei->koe", self.at_ends.rates, of_ends.reshape(-1, 2, 6)))


class Eliminated(NamedTuple):
    """Rods with some contacts closed, under a shift: whether they have a minimum, negative eigenvalues, solutions
    without motions of the ends and by these, and what is left for the ends: stiffness, and forces. After the motions of
    the ends stand the unknowns of contacts with other rods.
    """

    is_minimum: Bool[Array, "k"]
    negative: Int[Array, "k"]
    motion: tuple[Array, Array]
    by_motions: tuple[Array, Array]
    stiffness: Float[Array, "k 12+z 12+z"]
    force: Float[Array, "k 12+z"]


def _of_gaps(system: ChainSystem, coupling: Coupling) -> Float[Array, "r n+1 12"]:
    """None of a rod without obstacles."""
    if coupling.of_gaps is not None:
        return coupling.of_gaps
    return jnp.zeros((*system.contacts.is_closed.shape, 12), coupling.first.dtype)


def _eliminated(
    rods: RodsInContact, is_closed: Array, contact_compliance: Array, shift: Float[Array, "k"]
) -> Eliminated:
    def of_rod(
        rod: RodsInContact, is_closed: Array, closed_end: Array, contact_compliance: Array, shift: Array
    ) -> Eliminated:
        coupling, at_ends, m = rod.coupling, rod.at_ends, rod.f.shape[1]
        system = closed_softly(rod.system, is_closed, contact_compliance)
        f, c = with_pressures(system, rod.contacts, rod.f, rod.c)
        factors = factor_chain(held_back(system, shift / m))
        rates = jnp.where(is_closed[..., None], _of_gaps(system, coupling), 0.0)
        size = len(system.compliance)
        of_gradient, second = coupling.of_gradient, coupling.second
        contacts = slice(size, size + is_closed.size)
        of_constraints = coupling.of_constraints.at[contacts].add(-rates.reshape(-1, 12))
        by_rotations, by_multipliers = coupling.by_rotations, coupling.by_multipliers
        by_multipliers = by_multipliers.at[contacts].add(-rates.reshape(-1, 12))
        force = jnp.einsum("rni,rn->i", rates, rod.contacts.pressures) - rod.first
        if rod.columns is not None:
            of_gradient = jnp.concatenate([of_gradient, rod.columns.rotation], axis=2)
            of_constraints = jnp.concatenate([of_constraints, rod.columns.rows], axis=1)
            by_rotations = jnp.concatenate([by_rotations, rod.columns.rotation], axis=2)
            by_multipliers = jnp.concatenate([by_multipliers, rod.columns.rows], axis=1)
            count = rod.columns.ends.shape[1]
            force, second = jnp.pad(force, (0, count)), jnp.pad(second, (0, count))
            second = second.at[:12, 12:].set(rod.columns.ends).at[12:, :12].set(rod.columns.ends.T)
        x, y = factors.solve_softly(f, c)
        by_motions = jax.vmap(factors.solve_softly, (-1, -1), -1)(of_gradient, of_constraints)
        stiffness = second - jnp.einsum("bmi,bmj->ij", by_rotations, by_motions[0])
        stiffness -= by_multipliers.T @ by_motions[1]
        force -= jnp.einsum("bmi,bm->i", by_rotations, x) + by_multipliers.T @ y
        # Contacts of the bodies have no unknowns of the rod.
        rates = jnp.where(closed_end[..., None], at_ends.rates, 0.0)
        pressures = at_ends.pressures - at_ends.gaps / contact_compliance
        stiff = jnp.einsum("oei,oej->eij", rates, rates) / contact_compliance
        pushed = jnp.einsum("oei,oe->ei", rates, pressures)
        stiffness = stiffness.at[:12, :12].add(jax.scipy.linalg.block_diag(*stiff))
        force = force.at[:12].add(pushed.reshape(12))
        return Eliminated(factors.is_minimum, factors.negative, (x, y), by_motions, stiffness, force)

    closed_rods, closed_ends = rods.split(is_closed)
    of_rods, _ = rods.split(contact_compliance)
    count = len(shift)
    # Of a rod without obstacles there is none.
    soft = of_rods[:, 0, 0] if of_rods.size else rods.system.contacts.contact_compliance
    return jax.vmap(of_rod)(rods, closed_rods, closed_ends, jnp.broadcast_to(soft, (count,)), shift)


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
    negative; `may_reverse`: whether a minimum is sought; `between`: the contacts of rods with one another, `None`
    without such; `is_symmetric`: else steps are exact once the symmetric part of the stiffness is positive.
    """

    groups: tuple[RodsInContact, ...]
    motions: Float[Array, "6j q"]
    stiffness: Float[Array, "q q"]
    force: Float[Array, "q"]
    push: Float[Array, ""]
    pattern: Float[Array, "q"]
    least: float = eqx.field(static=True)
    may_reverse: bool = eqx.field(static=True)
    between: Between | None = None
    is_symmetric: bool = eqx.field(static=True, default=True)

    def begin(self, shifts: tuple[Float[Array, "k"], ...], damping: Float[Array, ""]) -> Memory:
        size = len(self.force)
        none = tuple(jnp.zeros(len(shift), int) for shift in shifts)
        reversal = damping * jnp.eye(size, dtype=self.force.dtype)
        return Memory(shifts, none, reversal, jnp.zeros((), int), jnp.zeros_like(self.force))

    def nowhere(self) -> Any:
        """Motions of rods and bodies, and the multipliers of the contacts between rods, if there are any."""
        of_rods = tuple((jnp.zeros_like(rods.f), jnp.zeros_like(rods.c)) for rods in self.groups)
        between = None if self.between is None else jnp.zeros(5 * len(self.between.gaps), self.force.dtype)
        return of_rods, jnp.zeros_like(self.force), between

    def bodies(self, q: Float[Array, "q"]) -> Float[Array, "j+1 6"]:
        """Their motions, and none of what is no body."""
        motions = self.motions @ q
        return jnp.concatenate([motions.reshape(-1, 6), jnp.zeros((1, 6), q.dtype)])

    def rows(self, parts: list[Array]) -> Array:
        return jnp.concatenate(parts)

    def split(self, row: Array) -> list[Array]:
        """Of the groups, then of contacts between rods."""
        found, first = [], 0
        for rods in self.groups:
            found.append(row[first : first + rods.size])
            first += rods.size
        return [*found, row[first:]]

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
        stiffness, force, touching = self.stiffness + memory.reversal, self.force + memory.push, None
        *of_groups, of_pairs = self.split(is_closed)
        *softness, soft_pairs = self.split(contact_compliance)
        if self.between is None:
            each = zip(self.groups, of_groups, softness, memory.shifts, strict=True)
            all_found, shifts = zip(*(self._regularized(*given) for given in each), strict=True)
        else:
            closed = self._with_closed(of_pairs)
            all_found, shifts, touching = self._together(
                closed, of_groups, softness, (of_pairs, soft_pairs), memory.shifts
            )
        is_minimum = jnp.array(True) if touching is None else touching.is_minimum
        for rods, found in zip(self.groups, all_found, strict=True):
            if touching is None:
                is_minimum &= jnp.all(found.is_minimum)
            at_bodies, of_ends = self._at_ends(rods), found.stiffness[:, :12, :12]
            stiffness += jnp.einsum("k,kiq,kij,kjp->qp", rods.shares, at_bodies, of_ends, at_bodies)
            force += jnp.einsum("k,kiq,ki->q", rods.shares, at_bodies, found.force[:, :12])
        if touching is not None:
            stiffness -= touching.by_bodies.T @ touching.inverse @ touching.by_bodies
            force -= touching.by_bodies.T @ touching.inverse @ touching.force
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
        if not self.is_symmetric:
            values = values if self.may_reverse else jnp.abs(values)
            q = solved_where_regular(stiffness, force, values, self.least, q)
        bodies, motions = self.bodies(q), []
        between = None if touching is None else touching.inverse @ (touching.force - touching.by_bodies @ q)
        for rods, found in zip(self.groups, all_found, strict=True):
            of_ends = rods.of_ends(bodies)
            if rods.columns is not None:
                assert between is not None
                of_ends = jnp.concatenate([of_ends, jnp.tile(between[None], (len(of_ends), 1))], axis=1)
            by_ends = (jnp.einsum("k...i,ki->k...", by, of_ends) for by in found.by_motions)
            motions.append(tuple(jax.tree.map(jnp.subtract, found.motion, tuple(by_ends))))
        negative = tuple(found.negative for found in all_found)
        if touching is not None:
            # What contacts take from them counts with the first group.
            negative = (negative[0].at[0].add(touching.excess), *negative[1:])
        below = jnp.where(jnp.any(is_below), jnp.sum(is_below), memory.below)
        return is_minimum, (tuple(motions), q, between), Memory(tuple(shifts), negative, reversal, below, push)

    def _at_ends(self, rods: RodsInContact) -> Float[Array, "k 12 q"]:
        """The motions of the ends of rods by q."""
        rows, columns = self.motions.shape
        padded = jnp.pad(self.motions, ((0, 6), (0, 0))).reshape(rows // 6 + 1, 6, columns)
        return padded[rods.body].reshape(len(rods.body), 12, columns)

    def _with_closed(self, is_closed: Bool[Array, "c"]) -> list[RodsInContact]:
        """The rods with the columns of closed contacts between them."""
        found = []
        for rods in self.groups:
            columns = None if rods.columns is None else jax.vmap(lambda columns: columns.where(is_closed))(rods.columns)
            found.append(dataclasses.replace(rods, columns=columns))
        return found

    def _together(
        self,
        groups: list[RodsInContact],
        is_closed: list[Array],
        contact_compliance: list[Array],
        pairs: tuple[Array, Array],
        shifts: tuple[Float[Array, "k"], ...],
    ) -> tuple[list[Eliminated], tuple[Float[Array, "k"], ...], "_Touching"]:
        """Stiffer until all rods and their contacts have a minimum between held bodies. `pairs`: which contacts between
        rods are closed, and their compliance.
        """

        def of_all(shifts: tuple[Array, ...]) -> tuple[list[Eliminated], _Touching]:
            found = [_eliminated(*given) for given in zip(groups, is_closed, contact_compliance, shifts, strict=True)]
            return found, self._touching(found, *pairs)

        if not self.may_reverse:
            found, touching = of_all(shifts)
            return found, shifts, touching

        def again(trial: tuple[Any, Array, list[Eliminated], _Touching]):
            shifts, tries, found, _ = trial
            is_first, alone = tries == 0, [each.is_minimum for each in found]
            # Where each rod alone has a minimum, the curvature of contacts takes it away.
            none = functools.reduce(jnp.logical_and, [jnp.all(each) for each in alone])
            stiffer = tuple(
                jnp.where(~is_first & (~each | none), jnp.maximum(SHIFT_GROWTH * shift, FIRST_SHIFT), shift)
                for shift, each in zip(shifts, alone, strict=True)
            )
            return stiffer, tries + 1, *of_all(stiffer)

        blank = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), jax.eval_shape(of_all, shifts))
        shifts, _, found, touching = jax.lax.while_loop(
            lambda trial: (trial[1] == 0) | (~trial[3].is_minimum & (trial[1] < MAX_FACTORS)),
            again,
            (shifts, jnp.zeros((), int), *blank),
        )
        return found, shifts, touching

    def _touching(self, all_found: list[Eliminated], is_closed: Array, contact_compliance: Array) -> "_Touching":
        between = self.between
        assert between is not None
        compliances = between.compliances(is_closed, contact_compliance)
        matrix, by_bodies, negative = -jnp.diag(compliances), 0.0, jnp.zeros((), int)
        given = jnp.where(is_closed, contact_compliance * between.pressures - between.gaps, 0.0)
        force = jnp.pad(given, (0, 4 * len(given)))
        for rods, found in zip(self.groups, all_found, strict=True):
            negative += jnp.sum(found.negative)
            if rods.columns is None:
                continue
            matrix += jnp.einsum("k,kzy->zy", rods.shares, found.stiffness[:, 12:, 12:])
            by_bodies += jnp.einsum("k,kzi,kiq->zq", rods.shares, found.stiffness[:, 12:, :12], self._at_ends(rods))
            force += jnp.einsum("k,kz->z", rods.shares, found.force[:, 12:])
        excess = jnp.sum(jnp.linalg.eigvalsh(matrix) < 0) - between.positive
        is_minimum = (negative + excess == 0) & jnp.isfinite(jnp.sum(matrix))
        return _Touching(is_minimum, excess, inverse_matrix(matrix), jnp.asarray(by_bodies), force)

    def opening(self, motion: Any) -> Array:
        of_rods, q, _ = motion
        bodies = self.bodies(q)
        rows = [rods.opening(each, bodies) for rods, each in zip(self.groups, of_rods, strict=True)]
        if self.between is not None:
            rows.append(self.rates(motion)[: len(self.between.gaps)])
        return self.rows(rows)

    def rates(self, motion: Any) -> Float[Array, "5c"]:
        """Of the gaps between rods, and along the vectors of their curvature."""
        of_rods, q, _ = motion
        total = 0.0
        for rods, (x, y) in zip(self.groups, of_rods, strict=True):
            if rods.columns is not None:
                total += rods.shares @ rods.columns.rates(x, y, rods.of_ends(self.bodies(q)))
        return jnp.asarray(total)

    def along(self, motion: Any, change: Any, memory: Memory) -> tuple[Float[Array, ""], Float[Array, ""]]:
        stiffness = self.stiffness + memory.reversal
        (of_rods, q, _), (changes, dq, _) = motion, change
        slope = q @ stiffness @ dq - (self.force + memory.push) @ dq
        curvature = dq @ stiffness @ dq
        for rods, here, ahead, shift in zip(self.groups, of_rods, changes, memory.shifts, strict=True):
            slopes, curvatures = jax.vmap(_along_rod)(
                rods, shift, (*here, rods.of_ends(self.bodies(q))), (*ahead, rods.of_ends(self.bodies(dq)))
            )
            slope += jnp.sum(rods.shares * slopes)
            curvature += jnp.sum(rods.shares * curvatures)
        if self.between is not None:
            count, signs = len(self.between.gaps), self.between.signs.astype(slope.dtype)
            here, ahead = self.rates(motion)[count:], self.rates(change)[count:]
            slope += jnp.sum(signs * here * ahead)
            curvature += jnp.sum(signs * ahead**2)
        return slope, curvature


class _Touching(NamedTuple):
    """Contacts between rods with these eliminated: whether all have a minimum between held bodies, by how many more
    eigenvalues than compliances are negative, the inverse of what is left, that by the motions of the bodies, and the
    right side.
    """

    is_minimum: Bool[Array, ""]
    excess: Int[Array, ""]
    inverse: Float[Array, "z z"]
    by_bodies: Float[Array, "z q"]
    force: Float[Array, "z"]


def _along_rod(
    rod: RodsInContact, shift: Float[Array, ""], here: tuple[Array, Array, Array], ahead: tuple[Array, Array, Array]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    coupling = rod.coupling
    system = rod.system.closed_where(jnp.zeros(rod.contacts.gaps.shape, bool))
    system = held_back(system, shift / rod.f.shape[1])

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
    negative eigenvalues; motions of the bodies; whether the contacts were found and the rods have a minimum; `between`:
    of contacts between rods, `None` without such.
    """

    motions: tuple[tuple[Array, Array], ...]
    at_ends: tuple[Float[Array, "k o 2"], ...]
    shifts: tuple[Float[Array, "k"], ...]
    negative: Int[Array, ""]
    bodies: Float[Array, "q"]
    below: Int[Array, ""]
    is_found: Bool[Array, ""]
    between: BetweenStep | None


def contact_step(model: ContactModel, shifts: tuple[Float[Array, "k"], ...], damping: Float[Array, ""]) -> ContactStep:
    """The minimum of a model."""
    groups, between = model.groups, model.between
    rows = [
        [rods.row(rods.contacts.gaps, rods.at_ends.gaps) for rods in groups],
        [rods.row(rods.contacts.pressures, rods.at_ends.pressures) for rods in groups],
        [rods.weights for rods in groups],
        [rods.row(rods.system.contacts.is_closed, rods.at_ends.is_closed) for rods in groups],
        [rods.contact_compliance for rods in groups],
    ]
    if between is not None:
        of_pairs = between.gaps, between.pressures, jnp.ones_like(between.gaps), between.is_closed
        for row, part in zip(rows, (*of_pairs, between.contact_compliance), strict=True):
            row.append(part)
    *of_contacts, is_closed, contact_compliance = map(model.rows, rows)
    contacts = BodyContacts(*of_contacts)
    end = sought(model, contacts, is_closed, contact_compliance, model.nowhere(), model.begin(shifts, damping))
    of_rods, q, multipliers = end.motion
    found = contacts.pressures - (contacts.gaps + model.opening(end.motion)) / contact_compliance
    if between is not None:
        # Of closed ones the multipliers: by the gaps they would be off by rounding over a small compliance.
        of_pairs = found[-len(between.gaps) :]
        is_known = (of_pairs > 0) & end.is_done
        found = found.at[-len(between.gaps) :].set(jnp.where(is_known, -multipliers[: len(between.gaps)], of_pairs))
    change = contacts.allowed(found) - contacts.pressures
    motions, at_ends = [], []
    *changes, of_pairs = model.split(change)
    for rods, (x, y), row in zip(groups, of_rods, changes, strict=True):
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
        None if between is None else BetweenStep(between, of_pairs, model.rates(end.motion)[: len(of_pairs)]),
    )
