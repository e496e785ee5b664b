"""Which contacts of a harness are closed: the minimum of the model of a step, of all its rods and bodies together.

As `linalg.unilateral` has it: a solution is one factorisation of each rod with the contacts closed that are so at the
last iterate, eliminated to the motions of the bodies. Where the stiffness of the bodies is negative along a motion, it
is reversed for the rest of the search, and a rod without a minimum becomes stiffer, so that the model only gains
stiffness while its minimum is sought.

Arclengths at which rods slide through clips are sought as motions of the bodies are, with columns and rows of their own
for each rod.

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

from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.far_rows import SIGNS
from rodjax.linalg.small_matrices import solved_where_regular
from rodjax.linalg.unilateral import Unilateral, sought
from rodjax.programs.stacks import of_each
from rodjax.solving.contact_elimination import Eliminated, RodsInContact, along_rod, eliminated
from rodjax.solving.newton import MAX_FACTORS, SHIFT_GROWTH
from rodjax.solving.rod_contact import Between, BetweenStep, Columns, Needed


class BodyContacts(eqx.Module):
    """The contacts of all rods and bodies in a row, as `linalg.unilateral.Unilateral` those of one rod; `rough`: of
    rods with friction the place of the first contact in the row, and all of theirs.
    """

    gaps: Float[Array, "c"]
    pressures: Float[Array, "c"]
    weights: Float[Array, "c"]
    rough: tuple[tuple[int, Unilateral], ...]

    def _of_rough(self, row: Array) -> list[tuple[slice, Unilateral, Array]]:
        found = []
        for first, contacts in self.rough:
            where = slice(first, first + contacts.gaps.size)
            found.append((where, contacts, row[where].reshape(contacts.gaps.shape)))
        return found

    def allowed(self, trial: Float[Array, "c"]) -> Float[Array, "c"]:
        row = jnp.where(trial > 0, trial, 0.0)
        for where, contacts, of_rods in self._of_rough(trial):
            row = row.at[where].set(jax.vmap(lambda each, trial: each.allowed(trial))(contacts, of_rods).reshape(-1))
        return row

    def is_closed(self, trial: Float[Array, "c"]) -> Bool[Array, "c"]:
        row = trial > 0
        for where, contacts, of_rods in self._of_rough(trial):
            row = row.at[where].set(jax.vmap(lambda each, trial: each.is_closed(trial))(contacts, of_rods).reshape(-1))
        return row

    def energy(self, trial: Float[Array, "c"], contact_compliance: Float[Array, "c"]) -> Float[Array, ""]:
        # c p^2 / 2, and of what is beyond its bound c b (2 |trial| - b) / 2.
        exerted = self.allowed(trial)
        return jnp.sum(self.weights * contact_compliance / 2 * exerted * (2 * trial - exerted))

    def slope(
        self, trial: Float[Array, "c"], falls: Float[Array, "c"], contact_compliance: Float[Array, "c"]
    ) -> Float[Array, ""]:
        return -jnp.sum(self.weights * contact_compliance * self.allowed(trial) * falls)

    def growth(
        self, trial: Float[Array, "c"], falls: Float[Array, "c"], contact_compliance: Float[Array, "c"]
    ) -> Float[Array, ""]:
        return jnp.sum(self.weights * contact_compliance * falls * jax.jvp(self.allowed, (trial,), (falls,))[1])

    def turned(self, trial: Array, other: Array) -> Bool[Array, ""]:
        turned = jnp.array(False)
        for (_, contacts, here), (_, _, there) in zip(self._of_rough(trial), self._of_rough(other), strict=True):
            turned |= jnp.any(of_each(lambda each, *trials: each.turned(*trials))(contacts, here, there))
        return turned


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
    """The model of a step. Its unknowns q: how far the bodies move as their supports let them, then the arclengths of
    sliding clips. `stiffness`, `force`: of the bodies and of the rods that touch nothing.

    `least_shifts`: of each rod the least shift of those that are tried where one of nothing is too little; `push`: by
    how much a negative stiffness is answered with a force along its motion; `least`: below it a stiffness is
    negative; `may_reverse`: whether a minimum is sought; `between`: the contacts of rods with one another, `None`
    without such; `has_symmetry`: else steps are exact once the symmetric part of the stiffness is positive.
    """

    groups: tuple[RodsInContact, ...]
    least_shifts: tuple[Float[Array, "k"], ...]
    stiffness: Float[Array, "q q"]
    force: Float[Array, "q"]
    push: Float[Array, ""]
    pattern: Float[Array, "q"]
    least: float = eqx.field(static=True)
    may_reverse: bool = eqx.field(static=True)
    between: Between | None = None
    has_symmetry: bool = eqx.field(static=True, default=True)

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
        self,
        rods: RodsInContact,
        least: Float[Array, "k"],
        is_closed: Array,
        at: Array,
        contact_compliance: Array,
        shift: Float[Array, "k"],
    ) -> tuple[Eliminated, Float[Array, "k"]]:
        """Stiffer until each rod by itself has a minimum; `at`: what contacts would exert at the last iterate."""
        if not self.may_reverse:
            return eliminated(rods, is_closed, at, contact_compliance, shift), shift

        def again(trial: tuple[Array, Array, Eliminated]) -> tuple[Array, Array, Eliminated]:
            shift, tries, found = trial
            larger = jnp.maximum(SHIFT_GROWTH * shift, least)
            shift = jnp.where((tries > 0) & ~found.is_minimum, larger, shift)
            return shift, tries + 1, eliminated(rods, is_closed, at, contact_compliance, shift)

        kinds = jax.eval_shape(eliminated, rods, is_closed, at, contact_compliance, shift)
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
        *trials, _ = self.split(trial)
        needed = None if self.between is None else self.between.first_needed(of_pairs, soft_pairs)
        if needed is None:
            each = zip(self.groups, self.least_shifts, of_groups, trials, softness, memory.shifts, strict=True)
            all_found, shifts = zip(*(self._regularized(*given) for given in each), strict=True)
        else:
            all_found, shifts, touching = self._together(needed, of_groups, trials, softness, memory.shifts)
        is_minimum = jnp.array(True) if touching is None else touching.is_minimum
        for rods, found in zip(self.groups, all_found, strict=True):
            if touching is None:
                is_minimum &= jnp.all(found.is_minimum)
            stiffness += jnp.einsum("k,kiq,kij,kjp->qp", rods.shares, rods.by_q, found.stiffness, rods.by_q)
            force += jnp.einsum("k,kiq,ki->q", rods.shares, rods.by_q, found.force)
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
        if not self.has_symmetry:
            values = values if self.may_reverse else jnp.abs(values)
            q = solved_where_regular(stiffness, force, values, self.least, q)
        between = None if touching is None else touching.inverse @ (touching.force - touching.by_bodies @ q)
        each = zip(self.groups, all_found, strict=True)
        motions = tuple(found.moved(rods.moved(q), between) for rods, found in each)
        if between is not None and needed is not None:
            between = needed.of_model(between)
        negative = tuple(found.negative for found in all_found)
        if touching is not None:
            # What contacts take from them counts with the first group.
            negative = (negative[0].at[0].add(touching.excess), *negative[1:])
        below = jnp.where(jnp.any(is_below), jnp.sum(is_below), memory.below)
        return is_minimum, (motions, q, between), Memory(tuple(shifts), negative, reversal, below, push)

    def _together(
        self,
        contacts: Needed,
        is_closed: list[Array],
        trials: list[Array],
        contact_compliance: list[Array],
        shifts: tuple[Float[Array, "k"], ...],
    ) -> tuple[list[Eliminated], tuple[Float[Array, "k"], ...], "_Touching"]:
        """Stiffer until all rods and their contacts with one another have a minimum between held bodies."""
        groups = []
        for rods in self.groups:
            columns = rods.columns and of_each(lambda columns: columns.needed(contacts))(rods.columns)
            groups.append(dataclasses.replace(rods, columns=columns))

        def of_all(shifts: tuple[Array, ...]) -> tuple[list[Eliminated], _Touching]:
            each = zip(groups, is_closed, trials, contact_compliance, shifts, strict=True)
            found = [eliminated(*given, contacts.total) for given in each]
            return found, self._touching(found, contacts)

        if not self.may_reverse:
            found, touching = of_all(shifts)
            return found, shifts, touching

        def again(trial: tuple[Any, Array, list[Eliminated], _Touching]):
            shifts, tries, found, _ = trial
            is_first, alone = tries == 0, [each.is_minimum for each in found]
            # Where each rod alone has a minimum, the curvature of contacts takes it away.
            none = functools.reduce(jnp.logical_and, [jnp.all(each) for each in alone])
            stiffer = tuple(
                jnp.where(~is_first & (~each | none), jnp.maximum(SHIFT_GROWTH * shift, least), shift)
                for shift, least, each in zip(shifts, self.least_shifts, alone, strict=True)
            )
            return stiffer, tries + 1, *of_all(stiffer)

        blank = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), jax.eval_shape(of_all, shifts))
        shifts, _, found, touching = jax.lax.while_loop(
            lambda trial: (trial[1] == 0) | (~trial[3].is_minimum & (trial[1] < MAX_FACTORS)),
            again,
            (shifts, jnp.zeros((), int), *blank),
        )
        return found, shifts, touching

    def _touching(self, all_found: list[Eliminated], contacts: Needed) -> "_Touching":
        matrix, by_bodies, force = -jnp.diag(contacts.compliances), 0.0, contacts.right
        negative = jnp.zeros((), int)
        for rods, found in zip(self.groups, all_found, strict=True):
            negative += jnp.sum(found.negative)
            if found.touched is None:
                continue
            matrix += jnp.einsum("k,kzy->zy", rods.shares, found.touched.stiffness)
            by_bodies += jnp.einsum("k,kzi,kiq->zq", rods.shares, found.touched.by_moves, rods.by_q)
            force += jnp.einsum("k,kz->z", rods.shares, found.touched.force)
        inverse, excess = contacts.inverse(matrix)
        is_minimum = (negative + excess == 0) & jnp.isfinite(jnp.sum(matrix))
        return _Touching(is_minimum, excess, inverse, jnp.asarray(by_bodies), force)

    def opening(self, motion: Any) -> Array:
        of_rods, q, _ = motion
        rows = [rods.opening(each, q) for rods, each in zip(self.groups, of_rods, strict=True)]
        if self.between is not None:
            rows.append(self.rates(motion)[::5])
        return self.rows(rows)

    def rates(self, motion: Any) -> Float[Array, "5c"]:
        """Of the gaps between rods, and along the vectors of their curvature."""
        of_rods, q, _ = motion
        total = 0.0
        for rods, (x, y) in zip(self.groups, of_rods, strict=True):
            if rods.columns is not None:

                def of_rod(columns: Columns, system: ChainSystem, x: Array, y: Array, moved: Array) -> Array:
                    return columns.rates(x, system.split(y)[2], moved)

                total += rods.shares @ of_each(of_rod)(rods.columns, rods.system, x, y, rods.moved(q))
        return jnp.asarray(total)

    def along(self, motion: Any, change: Any, memory: Memory) -> tuple[Float[Array, ""], Float[Array, ""]]:
        stiffness = self.stiffness + memory.reversal
        (of_rods, q, _), (changes, dq, _) = motion, change
        slope = (q @ stiffness @ dq + dq @ stiffness @ q) / 2 - (self.force + memory.push) @ dq
        curvature = dq @ stiffness @ dq
        for rods, here, ahead, shift in zip(self.groups, of_rods, changes, memory.shifts, strict=True):
            slopes, curvatures = of_each(along_rod)(rods, shift, (*here, rods.moved(q)), (*ahead, rods.moved(dq)))
            slope += jnp.sum(rods.shares * slopes)
            curvature += jnp.sum(rods.shares * curvatures)
        if self.between is not None:
            signs = jnp.asarray(SIGNS, slope.dtype)[None]
            here, ahead = (self.rates(each).reshape(-1, 5)[:, 1:] for each in (motion, change))
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


class ContactStep(NamedTuple):
    """The step that a search found: of each group rotations, multipliers as of its form, the pressures at the ends,
    shifts, and negative eigenvalues; the unknowns of bodies and sliding clips; whether the contacts were found and the
    rods have a minimum; `between`: of contacts between rods, `None` without such.
    """

    motions: tuple[tuple[Array, Array], ...]
    at_ends: tuple[Float[Array, "k o 2"], ...]
    shifts: tuple[Float[Array, "k"], ...]
    negative: Int[Array, ""]
    q: Float[Array, "q"]
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
    rough, first = [], 0
    for rods in groups:
        rough += [] if rods.contacts.bounds is None else [(first, rods.contacts)]
        first += rods.size
    gaps, pressures, weights = of_contacts
    contacts = BodyContacts(gaps, pressures, weights, tuple(rough))
    end = sought(model, contacts, is_closed, contact_compliance, model.nowhere(), model.begin(shifts, damping))
    of_rods, q, multipliers = end.motion
    found = end.exerted(contacts, model.opening(end.motion), contact_compliance)
    if between is not None:
        # Of closed ones the multipliers: by the gaps they would be off by rounding over a small compliance.
        of_pairs = found[-len(between.gaps) :]
        is_known = (of_pairs > 0) & end.is_done
        found = found.at[-len(between.gaps) :].set(jnp.where(is_known, -multipliers[::5], of_pairs))
    change = contacts.allowed(found) - contacts.pressures
    motions, at_ends = [], []
    *changes, of_pairs = model.split(change)
    for rods, (x, y), row in zip(groups, of_rods, changes, strict=True):
        in_rods, in_ends = rods.split(row)
        size = rods.system.compliance.shape[-1]
        y = y.at[:, size : size + in_rods[0].size].set(in_rods.reshape(len(y), -1))
        motions.append((x, jnp.concatenate([rods.moved(q)[:, 12:], y], axis=1)))
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
        None if between is None else BetweenStep(between, of_pairs, model.rates(end.motion)[::5]),
    )
