"""Rods of a harness in contact, eliminated to what moves them with some of their contacts closed.

What moves a rod: the motions of its two ends, the arclengths at which it slides through clips, and the unknowns of its
contacts with other rods. Contacts of a rod know of its nodes and of the motions of its two ends; contacts of a body,
where a rod ends in it, of these motions alone.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import Linearization
from rodjax.discretization.nodal import NodalForm, first_closed, held_back
from rodjax.discretization.node_contacts import contact_model
from rodjax.discretization.sliding import SlidingForm, at_its_arclengths
from rodjax.discretization.sliding_point import SlidingLinearization
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.chain_factors import factor_chain
from rodjax.linalg.unilateral import Unilateral, closed_softly, with_pressures, with_slips, work
from rodjax.programs.stacks import of_each
from rodjax.solving.coupling import Coupling, EndContacts, sliding_along
from rodjax.solving.rod_contact import Columns

# Of so many contacts with other rods columns are solved side by side.
AT_A_TIME = 4


class RodsInContact(eqx.Module):
    """Rods of one structure beside obstacles, stacked along a first axis of every array.

    `contacts`: at nodes and within elements; `f`, `c`: right sides without them; `at_ends`: contacts of the bodies in
    which the rods end; `first`: the derivative of L by the motions of the ends and arclengths of sliding clips, which
    move a rod, without contacts; `by_q`: how these follow from the unknowns of all; `shares`: the unit of energy of
    each rod, in that of the bodies; `columns`: of contacts with other rods, `None` without such.
    """

    system: ChainSystem
    coupling: Coupling
    contacts: Unilateral
    f: Float[Array, "k b m"]
    c: Float[Array, "k j"]
    at_ends: EndContacts
    first: Float[Array, "k 12+a"]
    by_q: Float[Array, "k 12+a q"]
    shares: Float[Array, "k"]
    columns: Columns | None = None

    @staticmethod
    def of(
        forms: NodalForm | SlidingForm,
        points: Any,
        here: Linearization,
        coupling: Coupling,
        at_ends: EndContacts,
        pushes: Float[Array, "k b m"],
        by_q: Float[Array, "k 12+a q"],
        shares: Float[Array, "k"],
    ) -> "RodsInContact":
        def of_rod(form: Any, point: Any, here: Linearization, coupling: Coupling, at_ends: EndContacts, push: Array):
            if isinstance(form, SlidingForm):
                assert isinstance(here, SlidingLinearization)
                coupling, here = sliding_along(here, coupling), here.at_arclengths
            form, point = at_its_arclengths(form, point)
            assert isinstance(form, NodalForm)
            system, forces = here.system, point.nodal.contact_forces
            assert isinstance(system, ChainSystem)
            assert here.gaps is not None
            moments, c = form.without_contacts(here, forces)
            contacts = contact_model(form, point, here.gaps, here.reference_displacements)
            system = first_closed(system, contacts)
            first = coupling.first.at[:12].add(jnp.einsum("rni,rn->i", _of_gaps(system, coupling)[..., :12], forces))
            first = first.at[:12].add(jnp.einsum("oei,oe->ei", at_ends.rates, at_ends.pressures).reshape(12))
            return system, coupling, contacts, push + moments, c, first

        system, coupling, contacts, f, c, first = of_each(of_rod)(forms, points, here, coupling, at_ends, pushes)
        return RodsInContact(system, coupling, contacts, f, c, at_ends, first, by_q, shares)

    def touched(self, columns: Columns, pressures: Float[Array, "c"]) -> "RodsInContact":
        """By other rods, whose pressures are among the loads so far."""

        def of_rod(columns: Columns, system: ChainSystem, f: Array, c: Array, first: Array):
            border, contacts, nodes, gaps = system.split(c)
            nodes -= columns.rows.pushed_by(0, pressures, len(nodes))
            c = jnp.concatenate([part.reshape(-1) for part in (border, contacts, nodes, gaps)])
            first = first.at[:12].add(columns.ends[:, 0] @ pressures)
            return f - columns.rows.turned_by(0, pressures, f.shape[1]), c, first

        f, c, first = of_each(of_rod)(columns, self.system, self.f, self.c, self.first)
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

    def moved(self, q: Float[Array, "q"]) -> Float[Array, "k 12+a"]:
        return self.by_q @ q

    def opening(self, motion: tuple[Array, Array], q: Float[Array, "q"]) -> Float[Array, "size"]:
        moved = self.moved(q)

        def of_rod(system: ChainSystem, coupling: Coupling, x: Array, y: Array, q: Array) -> Array:
            return system.contacts.rates(x, system.split(y)[2]) + _of_gaps(system, coupling) @ q

        rates = of_each(of_rod)(self.system, self.coupling, *motion, moved)
        return self.row(rates, jnp.einsum("koei,kei->koe", self.at_ends.rates, moved[:, :12].reshape(-1, 2, 6)))


def moved_by(
    groups: list[tuple[Int[Array, "k 2"], int]], motions: Float[Array, "6j q"]
) -> list[Float[Array, "k 12+a q+s"]]:
    """What moves the rods of each group, of which the bodies at the ends and the number of sliding clips are given, by
    the unknowns of all: those of `motions` of the bodies, then the arclengths of the clips of rod after rod.
    """
    rows, bodies = motions.shape
    motions = jnp.pad(motions, ((0, 6), (0, 0))).reshape(rows // 6 + 1, 6, bodies)
    total = bodies + sum(len(body) * clips for body, clips in groups)
    found, first = [], bodies
    for body, clips in groups:
        k = len(body)
        by_q = jnp.zeros((k, 12 + clips, total), motions.dtype)
        by_q = by_q.at[:, :12, :bodies].set(motions[body].reshape(k, 12, bodies))
        rod, clip = np.indices((k, clips)).reshape(2, -1)
        found.append(by_q.at[rod, 12 + clip, first + clips * rod + clip].set(1.0))
        first += k * clips
    return found


class Touched(NamedTuple):
    """Rods eliminated to their contacts with other rods: what is left for these, stiffness, how it changes as the rods
    are moved, and forces; and solutions by the columns of these.
    """

    stiffness: Float[Array, "k 5c 5c"]
    by_moves: Float[Array, "k 5c 12+a"]
    force: Float[Array, "k 5c"]
    by_columns: tuple[Float[Array, "k b 5c m"], Float[Array, "k 5c j"]]


class Eliminated(NamedTuple):
    """Rods with some contacts closed, under a shift: whether they have a minimum, negative eigenvalues, solutions
    without what moves them and by that, and what is left for it: stiffness, and forces. After the motions of the ends
    stand the arclengths of sliding clips. `touched`: `None` without contacts with other rods.
    """

    is_minimum: Bool[Array, "k"]
    negative: Int[Array, "k"]
    motion: tuple[Float[Array, "k b m"], Float[Array, "k j"]]
    by_moves: tuple[Float[Array, "k b 12+a m"], Float[Array, "k 12+a j"]]
    stiffness: Float[Array, "k 12+a 12+a"]
    force: Float[Array, "k 12+a"]
    touched: Touched | None

    def moved(self, q: Float[Array, "k 12+a"], between: Float[Array, "5c"] | None) -> tuple[Array, Array]:
        """The solutions, with what moves the rods."""
        (x, y), (x_by, y_by) = self.motion, self.by_moves
        x, y = x - jnp.einsum("kbrm,kr->kbm", x_by, q), y - jnp.einsum("krj,kr->kj", y_by, q)
        if self.touched is None:
            return x, y
        assert between is not None
        x_by, y_by = self.touched.by_columns
        return x - jnp.einsum("kbrm,r->kbm", x_by, between), y - jnp.einsum("krj,r->kj", y_by, between)


def _of_gaps(system: ChainSystem, coupling: Coupling) -> Float[Array, "r n+1 12+a"]:
    """None of a rod without obstacles."""
    if coupling.of_gaps is not None:
        return coupling.of_gaps
    return jnp.zeros((*system.contacts.is_closed.shape, len(coupling.first)), coupling.first.dtype)


def eliminated(
    rods: RodsInContact,
    is_closed: Array,
    trial: Array,
    contact_compliance: Array,
    shift: Float[Array, "k"],
    needed: Int[Array, ""] | None = None,
) -> Eliminated:
    """`needed`: so many of the contacts with other rods, from the first one on, have columns."""

    def of_rod(
        rod: RodsInContact, is_closed: Array, closed_end: Array, trial: Array, contact_compliance: Array, shift: Array
    ) -> Eliminated:
        coupling, at_ends, m = rod.coupling, rod.at_ends, rod.f.shape[1]
        system = closed_softly(rod.system, is_closed, contact_compliance)
        f, c = with_pressures(system, rod.contacts, rod.f, rod.c)
        system, c = with_slips(system, rod.contacts, c, trial)
        factors = factor_chain(held_back(system, shift / m))
        rates = jnp.where(is_closed[..., None], _of_gaps(system, coupling), 0.0)
        size = len(system.compliance)
        of_gradient, second = coupling.of_gradient, coupling.second
        contacts = slice(size, size + is_closed.size)
        moves = len(coupling.first)
        of_constraints = coupling.of_constraints.at[contacts].add(-rates.reshape(-1, moves))
        by_rotations, by_multipliers = coupling.by_rotations, coupling.by_multipliers
        # What a clip applies along the rod knows of no contacts.
        of_ends = rates[..., :12]
        by_multipliers = by_multipliers.at[contacts, :12].add(-of_ends.reshape(-1, 12))
        force = (-rod.first).at[:12].add(jnp.einsum("rni,rn->i", of_ends, rod.contacts.pressures))
        slides = np.arange(12, moves)
        second = second.at[slides, slides].add(shift)
        right = jnp.concatenate([f[..., None], of_gradient], 2), jnp.concatenate([c[:, None], of_constraints], 1)
        if rod.columns is None:
            touched, (x, y) = None, jax.vmap(factors.solve_softly, (-1, -1), (1, 0))(*right)
        else:
            assert needed is not None
            (x, y), by_columns, times = _solved_in_pieces(factors.solve_softly, system, right, rod.columns, needed)
            ends = rod.columns.ends.T.reshape(-1, 12)
            by_moves = (-times[:, 1 : 1 + moves]).at[:, :12].add(ends)
            touched = Touched(-times[:, 1 + moves :], by_moves, -times[:, 0], by_columns)
        lost = jnp.einsum("bmi,brm->ir", by_rotations, x) + by_multipliers.T @ y.T
        stiffness, force = second - lost[:, 1:], force - lost[:, 0]
        # Contacts of the bodies have no unknowns of the rod.
        rates = jnp.where(closed_end[..., None], at_ends.rates, 0.0)
        pressures = at_ends.pressures - at_ends.gaps / contact_compliance
        stiff = jnp.einsum("oei,oej->eij", rates, rates) / contact_compliance
        pushed = jnp.einsum("oei,oe->ei", rates, pressures)
        stiffness = stiffness.at[:12, :12].add(jax.scipy.linalg.block_diag(*stiff))
        force = force.at[:12].add(pushed.reshape(12))
        motion, by_moves = (x[:, 0], y[0]), (x[:, 1:], y[1:])
        return Eliminated(factors.is_minimum, factors.negative, motion, by_moves, stiffness, force, touched)

    closed_rods, closed_ends = rods.split(is_closed)
    trials, _ = rods.split(trial)
    of_rods, _ = rods.split(contact_compliance)
    count = len(shift)
    # Of a rod without obstacles there is none.
    soft = of_rods[:, 0, 0] if of_rods.size else rods.system.contacts.contact_compliance
    return of_each(of_rod)(rods, closed_rods, closed_ends, trials, jnp.broadcast_to(soft, (count,)), shift)


def _solved_in_pieces(
    solve: Callable[[Array, Array], tuple[Array, Array]],
    system: ChainSystem,
    right: tuple[Float[Array, "b m r"], Float[Array, "j r"]],
    columns: Columns,
    needed: Int[Array, ""],
) -> tuple[tuple[Array, Array], tuple[Array, Array], Float[Array, "5c r+5c"]]:
    """Solutions for right sides, then for the columns of the first contacts, of others zero, and what these columns do
    to all of them: piece by piece, in one loop.
    """
    m, (j, r), dtype, count = right[0].shape[1], right[1].shape, right[1].dtype, columns.ends.shape[-1]
    piece = 5 * AT_A_TIME
    first, others = -(-r // piece), -(-count // AT_A_TIME)  # pieces

    def wider(part: Array, size: int) -> Array:
        return jnp.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, size - part.shape[-1])])

    # After the last right side there is a piece of nothing.
    all_f, all_c = (wider(side, piece * (first + 1)) for side in right)
    all_rows = jax.tree.map(lambda part: wider(part, AT_A_TIME * others), columns.rows)
    is_column = jnp.ones((5, AT_A_TIME), dtype)

    def of_piece(number: Int[Array, ""], found: tuple[Array, ...]) -> tuple[Array, ...]:
        at = piece * jnp.minimum(number, first)
        f, c = (jax.lax.dynamic_slice_in_dim(side, at, piece, -1) for side in (all_f, all_c))
        at = AT_A_TIME * jnp.maximum(number - first, 0)
        rows = jax.tree.map(lambda part: jax.lax.dynamic_slice_in_dim(part, at, AT_A_TIME, -1), all_rows)
        by_rotation, by_position = rows.columns(jnp.where(number < first, 0.0, is_column), m)
        before = j - by_position[0].size - 3 * (len(system.held) - 1)
        by_position = jnp.pad(by_position.reshape(piece, -1), ((0, 0), (before, j - before - by_position[0].size)))
        x, y = jax.vmap(solve, (1, 0), (1, 0))(jnp.moveaxis(f, -1, 1) + by_rotation, c.T + by_position)
        times = columns.times(x, jax.vmap(system.split)(y)[2])
        at = piece * number
        return tuple(
            jax.lax.dynamic_update_slice_in_dim(whole, part, at, axis)
            for whole, part, axis in zip(found, (x, y, times), (1, 0, 1), strict=True)
        )

    size = piece * (first + others)
    blank = jnp.zeros((len(all_f), size, m), dtype), jnp.zeros((size, j), dtype)
    pieces = first + (needed + AT_A_TIME - 1) // AT_A_TIME
    x, y, times = jax.lax.fori_loop(0, pieces, of_piece, (*blank, jnp.zeros((5 * count, size), dtype)))
    of_columns = slice(piece * first, piece * first + 5 * count)
    times = jnp.concatenate([times[:, :r], times[:, of_columns]], axis=1)
    return (x[:, :r], y[:r]), (x[:, of_columns], y[of_columns]), times


def along_rod(
    rod: RodsInContact, shift: Float[Array, ""], here: tuple[Array, Array, Array], ahead: tuple[Array, Array, Array]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    coupling = rod.coupling
    system = rod.system.closed_where(jnp.zeros(rod.contacts.gaps.shape, bool))
    system = held_back(system, shift / rod.f.shape[1])

    def times(x: Array, y: Array, q: Array) -> tuple[Array, Array, Array]:
        moments, rows = system.times(x, y)
        by_bodies = (
            coupling.second @ q + coupling.by_multipliers.T @ y + jnp.einsum("bmi,bm->i", coupling.by_rotations, x)
        )
        by_bodies = by_bodies.at[12:].add(shift * q[12:])
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
