"""Saddle-point systems of a rod whose nodes have positions of their own, by block elimination from node to node.

The rotations of tangents or frames, b at each point, and the force in each element are the unknowns, as in
`saddle_point`, and the positions of the nodes, and the pressures of contacts at nodes and within elements. The force of
an element is the multiplier of its segment vector, the pressure that of a gap. Pressures are eliminated first,
each by itself, then the points in the middle of elements; then a node has b + 6 unknowns, rotation, force of the
element before it and displacement, coupled with those of its neighbours only: O(n).

    rotation     H theta + B F + T u + border y - M q = f
    gap          B^T theta - C F + u_after - u_before = gap,       for each element
    balance      S u + T^T theta - N p - K q + F_before - F_after = balance,   for each node that is not held
    border       border^T theta - compliance y = c
    pressure     -N^T u - c p = d  where a contact is closed; else  -p = d, and p pushes at nothing
    within       -M^T theta - K^T u - c q = d, the same

with the contact compliance c. Loads without a potential add rows of their own to the first three, without symmetry
(`LoadRows`).
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.blocks import inverse_of_blocks
from rodjax.linalg.chain_border import Border, Columns
from rodjax.linalg.far_rows import FarRows
from rodjax.linalg.small_matrices import inverse_matrix, negative_count
from rodjax.linalg.substitution import substituted
from rodjax.programs.parts import traced_once

# Solutions with soft contacts, after the first one.
HARDENINGS = 5
# In these, contacts between elements have this part of their compliance.
HARD = 1e-4
# Of a rod with two free ends the stiffness that holds its last node while it is factorised [EI/L^3]: displacements that
# nothing else holds, as along a floor, are regular by it.
LOOSE = 1e-4


class InnerRows(eqx.Module):
    """The gradients of q gaps within each element, by the rotations (M) and the positions (K) of its first and last
    node.

    `first`: the number of the first of q rows among those of all contacts; a row has the elements in turn, and a last
    number that stands for nothing.
    """

    by_rotation: Float[Array, "q b 2 n"]
    by_position: Float[Array, "q 3 2 n"]
    first: int = eqx.field(static=True)

    @property
    def rows(self) -> slice:
        return slice(self.first, self.first + len(self.by_position))

    def holding(self, turns: Float[Array, "n+1"], moves: Float[Array, "n+1"]) -> "InnerRows":
        """`turns`, `moves`: 0 at nodes whose rotation or place is held, else 1."""
        return dataclasses.replace(
            self,
            by_rotation=self.by_rotation * _at_ends(turns[None])[None],
            by_position=self.by_position * _at_ends(moves[None])[None],
        )

    def rates(self, x: Float[Array, "b m"], u: Float[Array, "n+1 3"]) -> Float[Array, "q n+1"]:
        nodes, displacements = _at_ends(x[:, ::2]), _at_ends(u.T)
        rates = jnp.einsum("qben,ben->qn", self.by_rotation, nodes) + jnp.einsum(
            "qcen,cen->qn", self.by_position, displacements
        )
        return jnp.pad(rates, ((0, 0), (0, 1)))

    def turned(self, pressures: Float[Array, "q n+1"]) -> Float[Array, "b m"]:
        """The moments on the points of the rod."""
        start, end = jnp.moveaxis(jnp.einsum("qben,qn->ben", self.by_rotation, pressures[:, :-1]), 1, 0)
        nodes = jnp.pad(start, ((0, 0), (0, 1))) + jnp.pad(end, ((0, 0), (1, 0)))
        return jnp.zeros((len(nodes), 2 * nodes.shape[1] - 1), nodes.dtype).at[:, ::2].set(nodes)

    def pushed(self, pressures: Float[Array, "q n+1"]) -> Float[Array, "n+1 3"]:
        """The forces on the nodes."""
        start, end = jnp.einsum("qcen,qn->enc", self.by_position, pressures[:, :-1])
        return _on_nodes(start, end)

    def condensed(self, weights: Float[Array, "q n"]) -> Float[Array, "2b+6 2b+6 n"]:
        """What contacts of these stiffnesses add, by rotation and place of the first node of each element, then of the
        last one.
        """
        rates = jnp.concatenate([self.by_rotation, self.by_position], axis=1)
        rates = jnp.swapaxes(rates, 1, 2).reshape(len(rates), -1, rates.shape[-1])
        return jnp.einsum("qin,qn,qjn->ijn", rates, weights, rates)


class ContactRows(eqx.Module):
    """The gradients N of the gaps between nodes and k obstacles, zero at nodes that are held.
    `contact_compliance`: penetration by pressure; `is_closed`: where there is a pressure. `pushes`: along what a
    pressure pushes, where that is not N, as where it brings friction with it, without symmetry then. `inner`: of the
    rows that belong to elements, whose N are zero; `far`: of the row between elements; `None` without such.
    """

    normals: Float[Array, "k n+1 3"]
    contact_compliance: Float[Array, ""]
    is_closed: Bool[Array, "k n+1"]
    pushes: Float[Array, "k n+1 3"] | None = None
    inner: InnerRows | None = None
    far: FarRows | None = None

    def rates(self, x: Float[Array, "b m"], u: Float[Array, "n+1 3"]) -> Float[Array, "k n+1"]:
        """Of the gaps, as the rod turns and nodes move."""
        rates = jnp.einsum("knc,nc->kn", self.normals, u)
        if self.inner is not None:
            rates = rates.at[self.inner.rows].set(self.inner.rates(x, u))
        return rates if self.far is None else rates.at[self.far.row].set(self.far.rates(x, u))

    def pushed(self, pressures: Float[Array, "k n+1"]) -> Float[Array, "n+1 3"]:
        """The forces of pressures on the nodes."""
        pushed = jnp.einsum("knc,kn->nc", self._pushes, pressures)
        if self.inner is not None:
            pushed += self.inner.pushed(pressures[self.inner.rows])
        return pushed if self.far is None else pushed + self.far.pushed(pressures[self.far.row])

    def turned(self, pressures: Float[Array, "k n+1"], moments: Float[Array, "b m"]) -> Float[Array, "b m"]:
        """Moments on the rod with those of pressures."""
        if self.inner is not None:
            moments = moments + self.inner.turned(pressures[self.inner.rows])
        return moments if self.far is None else moments + self.far.turned(pressures[self.far.row])

    def condensed(self, system: "ChainSystem") -> "ChainSystem":
        """The system with what closed contacts add to its stiffness, but for those between elements."""
        weights = jnp.where(self.is_closed, 1 / self.contact_compliance, 0.0)
        stiffness = jnp.einsum("knc,kne,kn->nce", self._pushes, self.normals, weights)
        system = dataclasses.replace(system, stiffness=system.stiffness + stiffness)
        if self.inner is None:
            return system
        return system.with_elements(self.inner.condensed(weights[self.inner.rows, :-1]))

    @property
    def _pushes(self) -> Float[Array, "k n+1 3"]:
        return self.normals if self.pushes is None else self.pushes


class LoadRows(eqx.Module):
    """What loads without a potential add, of each element by the rotations of its start, middle and end: [.., c, j, n]
    by component c of point j.

    `rotation`: [a, i, ..] to the row of component a of point i; `segment_vectors`: to those of the gap; `balance`: [k,
    ..] to those of the node at its start and its end.
    """

    rotation: Float[Array, "b 3 b 3 n"]
    segment_vectors: Float[Array, "3 b 3 n"]
    balance: Float[Array, "2 3 b 3 n"]

    def holding(self, turns: Float[Array, "3 n"], moves: Float[Array, "2 n"]) -> "LoadRows":
        """With the rotations of points, and the positions of nodes at both ends, held where these are 0, else 1."""
        columns = turns[None]
        return LoadRows(
            self.rotation * turns[None, :, None, None] * columns[None, None],
            self.segment_vectors * columns[None],
            self.balance * moves[:, None, None, None] * columns[None, None],
        )

    def mirrored(self) -> "LoadRows":
        return LoadRows(
            self.rotation[:, ::-1, :, ::-1, ::-1],
            -self.segment_vectors[:, :, ::-1, ::-1],
            self.balance[::-1, ..., ::-1, ::-1],
        )


class ChainSystem(eqx.Module):
    """The matrix above, for n elements with m = 2 n + 1 points, nodes and middles in turn.

    `diagonal`, `lower`, `across`: the blocks of H, as in `saddle_point.SaddlePointSystem`; `by_force`: those of B at
    start, middle and end of each element; `cell_compliance`: C; `stiffness`: S; `contacts`: N; `held`: the nodes whose
    place is given; `turning`: T, of what a field of forces has of both the place and the rotation of a node, `None` for
    none. What is no rotation comes as one vector: border, contacts, then the nodes, then the elements.
    `between`: what rotations and place (b, 3) of the last node of an element have by those of its first, beside H;
    `None` for none. `is_backward`: elimination begins at the end, for a free start: a first node that nothing holds or
    touches has no pivot. `is_loose`: both ends are free, and elimination takes the force of an element with the node
    before it; the last node is held softly (`LOOSE`). `loads`: `None` where all have a potential.
    """

    diagonal: Float[Array, "b b m"]
    lower: Float[Array, "b b m-1"]
    across: Float[Array, "b b n"]
    border: Float[Array, "b k m"]
    compliance: Float[Array, "k k"]
    by_force: Float[Array, "b 3 3 n"]
    cell_compliance: Float[Array, "3 3 n"]
    stiffness: Float[Array, "n+1 3 3"]
    contacts: ContactRows
    held: Bool[Array, "n+1"]
    loads: LoadRows | None = None
    turning: Float[Array, "b 3 n+1"] | None = None
    between: Float[Array, "b+3 b+3 n"] | None = None
    is_backward: bool = eqx.field(static=True, default=False)
    is_loose: bool = eqx.field(static=True, default=False)

    def mirrored(self) -> "ChainSystem":
        """The same system of the rod counted from its end: the forces through the elements have the other sign.

        Without contacts, which are eliminated before.
        """
        return dataclasses.replace(
            self,
            diagonal=self.diagonal[..., ::-1],
            lower=jnp.swapaxes(self.lower, 0, 1)[..., ::-1],
            across=jnp.swapaxes(self.across, 0, 1)[..., ::-1],
            border=self.border[..., ::-1],
            by_force=-self.by_force[:, :, ::-1, ::-1],
            cell_compliance=self.cell_compliance[..., ::-1],
            stiffness=self.stiffness[::-1],
            held=self.held[::-1],
            loads=None if self.loads is None else self.loads.mirrored(),
            turning=None if self.turning is None else self.turning[..., ::-1],
            between=None if self.between is None else jnp.swapaxes(self.between, 0, 1)[..., ::-1],
        )

    def shifted(self, shift: Float[Array, ""] | Float[Array, "m"]) -> "ChainSystem":
        """H + shift I in the place of H, with one shift or one for each point."""
        identity = jnp.eye(len(self.diagonal), dtype=shift.dtype)[..., None]
        shift = jnp.broadcast_to(shift, self.diagonal.shape[-1:])
        return eqx.tree_at(lambda system: system.diagonal, self, self.diagonal + shift[None, None] * identity)

    def holding(self, turns: Float[Array, "m"], moves: Float[Array, "n+1"]) -> "ChainSystem":
        """With the rotations of points, and the positions of nodes, held where these are 0, else 1."""
        identity = jnp.eye(len(self.diagonal), dtype=turns.dtype)[..., None]
        of_elements = jnp.stack([turns[:-1:2], turns[1::2], turns[2::2]])
        b, contacts = len(self.diagonal), self.contacts
        of_nodes = jnp.concatenate([jnp.tile(turns[None, ::2], (b, 1)), jnp.tile(moves[None], (3, 1))])
        if contacts.inner is not None:
            contacts = dataclasses.replace(contacts, inner=contacts.inner.holding(turns[::2], moves))
        if contacts.far is not None:
            contacts = dataclasses.replace(contacts, far=contacts.far.holding(turns[::2], moves))
        between, turning, loads = self.between, self.turning, self.loads
        if loads is not None:
            loads = loads.holding(of_elements, jnp.stack([moves[:-1], moves[1:]]))
        if between is not None:
            between = of_nodes[:, None, 1:] * between * of_nodes[None, :, :-1]
        if turning is not None:
            turning = turning * (turns[::2] * moves)[None, None]
        return dataclasses.replace(
            self,
            diagonal=self.diagonal * turns[None, None] + identity * (1 - turns)[None, None],
            lower=self.lower * (turns[1:] * turns[:-1])[None, None],
            across=self.across * (turns[2::2] * turns[:-1:2])[None, None],
            border=self.border * turns[None, None],
            by_force=self.by_force * of_elements[None, None],
            held=self.held | (moves == 0),
            contacts=contacts,
            loads=loads,
            turning=turning,
            between=between,
        )

    def closed_where(self, is_closed: Bool[Array, "k p"]) -> "ChainSystem":
        """With these contacts closed."""
        return dataclasses.replace(self, contacts=dataclasses.replace(self.contacts, is_closed=is_closed))

    @traced_once
    def times(self, x: Float[Array, "b m"], y: Float[Array, "j"]) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
        """The matrix times (x, y): the right sides."""
        first, pressures, u, force = self.split(y)
        b, is_closed = len(x), self.contacts.is_closed
        displacements = jnp.where(self.held[:, None], 0.0, u)
        at_nodes = jnp.concatenate([x[:, ::2], displacements.T])
        of_elements = jnp.concatenate([at_nodes[:, :-1], x[:, 1::2], force.T, at_nodes[:, 1:]])
        before, middles, gap, after = jnp.split(
            jnp.einsum("pqn,qn->pn", self.elements, of_elements), [b + 3, 2 * b + 3, 2 * b + 6]
        )
        nodes = jnp.einsum("pqn,qn->pn", self.nodes, at_nodes) + _on_nodes(before.T, after.T).T
        middles += jnp.einsum("ijn,jn->in", self.diagonal[..., 1::2], x[:, 1::2])
        f, balance, gap = _at_points(nodes[:b], middles), nodes[b:].T, gap.T
        if len(first):
            f += jnp.einsum("ikm,k->im", self.border, first)
        pressing = jnp.where(is_closed, pressures, 0.0)
        balance -= self.contacts.pushed(pressing)
        if self.contacts.inner is not None or self.contacts.far is not None:
            f -= self.contacts.turned(pressing, jnp.zeros_like(f))
        if self.contacts.far is not None:
            moments, forces = self.contacts.far.curved(x, displacements)
            f += moments
            balance += forces
        balance = jnp.where(self.held[:, None], u, balance)
        gaps = -jnp.where(
            is_closed, self.contacts.rates(x, displacements) + self.contacts.contact_compliance * pressures, pressures
        )
        first = jnp.einsum("ikm,im->k", self.border, x) - self.compliance @ first
        return f, jnp.concatenate([first, gaps.reshape(-1), balance.reshape(-1), gap.reshape(-1)])

    @property
    def elements(self) -> Float[Array, "3b+9 3b+9 n"]:
        """What couples the unknowns of each element: rotation and place of its first node, rotation of its middle, its
        force, rotation and place of its last node. Without what `nodes` and the middles have by themselves.
        """
        b, n = self.across.shape[1:]
        identity = jnp.broadcast_to(jnp.eye(3, dtype=self.across.dtype)[..., None], (3, 3, n))
        first, second = self.lower[..., ::2], self.lower[..., 1::2]
        start, middle, end = (self.by_force[:, :, k] for k in range(3))
        rows = [
            [b + 3, _transposed(first), start, _transposed(self.across), 3],
            [2 * b + 3, -identity, b + 3],
            [first, b + 3, middle, _transposed(second), 3],
            [_transposed(start), -identity, _transposed(middle), -self.cell_compliance, _transposed(end), identity],
            [self.across, 3, second, end, b + 3],
            [2 * b + 3, identity, b + 3],
        ]
        matrix = jnp.concatenate([_row(parts) for parts in rows])
        if self.between is not None:
            matrix = matrix.at[2 * b + 6 :, : b + 3].add(self.between)
            matrix = matrix.at[: b + 3, 2 * b + 6 :].add(_transposed(self.between))
        if self.loads is None:
            return matrix
        points, places = np.arange(b), np.arange(b, b + 3)
        points = np.concatenate([points, b + 3 + points, 2 * b + 6 + points])
        rows = np.concatenate([points, 2 * b + 3 + np.arange(3), places, 2 * b + 6 + places])
        loads = self.loads
        added = [loads.rotation.transpose(1, 0, 3, 2, 4), jnp.swapaxes(loads.segment_vectors, 1, 2)]
        added = [part.reshape(-1, 3 * b, n) for part in (*added, jnp.swapaxes(loads.balance, 2, 3))]
        return matrix.at[rows[:, None], points[None]].add(jnp.concatenate(added))

    @property
    def nodes(self) -> Float[Array, "b+3 b+3 n+1"]:
        """What couples the rotation of each node, and its place, with these."""
        of_places = self.stiffness.transpose(1, 2, 0)
        if self.turning is None:
            turning = jnp.zeros((len(self.diagonal), 3, len(self.held)), of_places.dtype)
        else:
            turning = self.turning
        turns = jnp.concatenate([self.diagonal[..., ::2], turning], axis=1)
        return jnp.concatenate([turns, jnp.concatenate([_transposed(turning), of_places], axis=1)])

    def split(self, y: Float[Array, "j"]) -> tuple[Array, Array, Array, Array]:
        """What belongs to the border (k,), the contacts (k, p), the nodes (n+1, 3) and the elements (n, 3)."""
        nodes, is_closed = len(self.held), self.contacts.is_closed
        first, contacts, displacements, forces = jnp.split(
            y, np.cumsum([len(self.compliance), is_closed.size, 3 * nodes])
        )
        return first, contacts.reshape(is_closed.shape), displacements.reshape(nodes, 3), forces.reshape(nodes - 1, 3)

    def with_elements(self, blocks: Float[Array, "2b+6 2b+6 n"]) -> "ChainSystem":
        """With what elements have beside H and S by rotation and place of their first node, then of their last one."""
        b, half = len(self.diagonal), len(blocks) // 2
        at_nodes = jnp.pad(blocks[:half, :half], ((0, 0), (0, 0), (0, 1)))
        at_nodes += jnp.pad(blocks[half:, half:], ((0, 0), (0, 0), (1, 0)))
        turning, between = at_nodes[:b, b:], blocks[half:, :half]
        return dataclasses.replace(
            self,
            diagonal=self.diagonal.at[..., ::2].add(at_nodes[:b, :b]),
            stiffness=self.stiffness + at_nodes[b:, b:].transpose(2, 0, 1),
            turning=turning if self.turning is None else self.turning + turning,
            between=between if self.between is None else self.between + between,
        )

    def in_plane(self, normal: Float[Array, "3"] | None) -> "ChainSystem":
        """Without what obstacles and fields do along a normal to displacements, of which a rod in a plane has none."""
        if normal is None:
            return self
        b, identity = len(self.diagonal), jnp.eye(3, dtype=normal.dtype)
        within = identity - normal[:, None] * normal[None]
        turning, between = self.turning, self.between
        if turning is not None:
            turning = jnp.einsum("icn,cd->idn", turning, within)
        if between is not None:
            both = jax.scipy.linalg.block_diag(jnp.eye(b, dtype=normal.dtype), within)
            between = jnp.einsum("pi,ijn,jq->pqn", both, between, both)
        return dataclasses.replace(self, stiffness=within @ self.stiffness @ within, turning=turning, between=between)

    def condensed(self) -> "ChainSystem":
        """Without the pressures, as elimination goes along the rod."""
        system = self.contacts.condensed(self)
        if self.is_loose:
            softly = LOOSE * jnp.eye(3, dtype=system.stiffness.dtype)
            system = dataclasses.replace(system, stiffness=system.stiffness.at[-1].add(softly))
        return system.mirrored() if self.is_backward else system


class _Middles(eqx.Module):
    """The elimination of the points in the middle: the inverse times what couples them to start, end and force;
    `left`: what couples the rows of start, end, gap and both nodes to them, times the inverse. Of a symmetric system
    the nodes are not coupled, and the other rows are those of `solved`.
    """

    solved: Float[Array, "n b 2b+3"]
    inverse: Float[Array, "n b b"]
    left: Float[Array, "n 2b+9 b"] | None

    def reduction(self, of_middles: Float[Array, "n b r"]) -> Float[Array, "n rows r"]:
        """What the right sides of the other rows lose."""
        if self.left is None:
            return jnp.einsum("npq,npr->nqr", self.solved, of_middles)
        return self.left @ of_middles


class ChainFactors(eqx.Module):
    """The factorisation of a `ChainSystem`; `negative` as in `saddle_point.Factors`, 0 without symmetry.

    `whole`: the system; `system`: that without pressures. Where elimination begins at the end, it and all below is
    mirrored.
    """

    contacts: ContactRows
    whole: ChainSystem
    system: ChainSystem
    middles: _Middles
    inverses: Float[Array, "n+1 c c"]
    before: Float[Array, "n c c"]  # of all nodes but the first: the inverse times the block that couples the one before
    after: Float[Array, "n c c"]
    border: Border
    border_solution: tuple[Float[Array, "b k m"], Float[Array, "k n+1 3"], Float[Array, "k n 3"]]
    bordered: Float[Array, "k k"]
    complement: Float[Array, "k k"]
    negative: Int[Array, ""]

    @property
    def is_minimum(self) -> Bool[Array, ""]:
        """Whether H is positive definite under the constraints."""
        return (self.negative == 0) & jnp.isfinite(jnp.sum(self.inverses)) & jnp.isfinite(jnp.sum(self.complement))

    @traced_once
    def solve(self, f: Float[Array, "b m"], c: Float[Array, "j"]) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
        """With rigid contacts, by iterative refinement: each correction reduces the penetration by the contact
        compliance times the stiffness of the rod, and with it what rounding has left.
        """
        if not self.contacts.is_closed.size:
            return self.solve_softly(f, c)
        hard = dataclasses.replace(self.contacts, contact_compliance=jnp.zeros_like(self.contacts.contact_compliance))
        hard = dataclasses.replace(self.whole, contacts=hard)
        return self._refined(f, c, hard, self._hard_complement(), 1 + HARDENINGS)

    def _hard_complement(self) -> Float[Array, "k k"]:
        """With contacts between elements that are all but rigid: a border is no softer for that."""
        far, k = self.contacts.far, len(self.whole.compliance)
        if far is None:
            return self.complement
        at = np.arange(k, k + len(far.elements))
        is_closed = self.contacts.is_closed[far.row, far.elements]
        harder = jnp.where(is_closed, (1 - HARD) * self.contacts.contact_compliance, 0.0)
        return self.border.inverse(self.bordered.at[at, at].add(harder))

    def solve_softly(
        self, f: Float[Array, "b m"], c: Float[Array, "j"]
    ) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
        """With the contact compliance. Contacts within elements couple their nodes so stiffly that elimination loses
        half of the digits, and so it does with contacts where there is no symmetry; what is left is asked for again.
        So is what holds a loose rod, three times.
        """
        without_symmetry = self.system.loads is not None and self.contacts.is_closed.size > 0
        if not (self.whole.is_loose or self.contacts.inner is not None or without_symmetry):
            return self._solved_once(f, c, self.complement)
        return self._refined(f, c, self.whole, self.complement, 4 if self.whole.is_loose else 2)

    def _refined(
        self,
        f: Float[Array, "b m"],
        c: Float[Array, "j"],
        system: ChainSystem,
        complement: Float[Array, "k k"],
        count: int,
    ) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
        """By so many solutions for what is left; the first one, for all of it, is in the loop too, that a program has
        one.
        """

        def nearer(found: tuple[Array, Array], _) -> tuple[tuple[Array, Array], None]:
            left = jax.tree.map(jnp.subtract, (f, c), system.times(*found))
            return jax.tree.map(jnp.add, found, self._solved_once(left[0], left[1], complement)), None

        found, _ = jax.lax.scan(nearer, (jnp.zeros_like(f), jnp.zeros_like(c)), None, length=count)
        return found

    def _solved_once(
        self, f: Float[Array, "b m"], c: Float[Array, "j"], complement: Float[Array, "k k"]
    ) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
        system, contacts = self.system, self.contacts
        first, given, nodes, gaps = system.split(c)
        pulling = -jnp.where(contacts.is_closed, given / contacts.contact_compliance, 0.0)
        if contacts.far is not None:
            # These are columns of the border.
            pulling = pulling.at[contacts.far.row].set(0.0)
            of_far = jnp.where(contacts.is_closed, -given, 0.0)[contacts.far.row, contacts.far.elements]
            first = jnp.pad(jnp.concatenate([first, of_far]), (0, 4 * len(of_far)))
        nodes += contacts.pushed(pulling)
        f = contacts.turned(pulling, f)
        if system.is_backward:
            f, nodes, gaps = f[:, ::-1], nodes[::-1], -gaps[::-1]
        x, displacements, forces = self._without_border(f[:, None], nodes[None], gaps[None])
        x, displacements, forces = x[:, 0], displacements[0], forces[0]
        by_border, u_by_border, force_by_border = self.border_solution
        multipliers = complement @ (first - self.border.times(x[:, None], displacements[None])[:, 0])
        x -= jnp.einsum("ikm,k->im", by_border, multipliers)
        displacements -= jnp.tensordot(multipliers, u_by_border, 1)
        forces -= jnp.tensordot(multipliers, force_by_border, 1)
        if system.is_backward:
            x, displacements, forces = x[:, ::-1], displacements[::-1], -forces[::-1]
        rates = contacts.rates(x, displacements)
        pressures = jnp.where(contacts.is_closed, -(given + rates) / contacts.contact_compliance, -given)
        if contacts.far is not None:
            far, k = contacts.far, len(system.compliance)
            here = contacts.is_closed[far.row, far.elements]
            found = jnp.where(here, -multipliers[k : k + len(here)], -given[far.row, far.elements])
            pressures = pressures.at[far.row].set(-given[far.row])
            pressures = pressures.at[far.row, far.elements].set(found, unique_indices=True)
            multipliers = multipliers[:k]
        parts = (multipliers, pressures, displacements, forces)
        return x, jnp.concatenate([part.reshape(-1) for part in parts])

    def _without_border(
        self, f: Float[Array, "b r m"], nodes: Float[Array, "r n+1 3"], gaps: Float[Array, "r n 3"]
    ) -> tuple[Float[Array, "b r m"], Float[Array, "r n+1 3"], Float[Array, "r n 3"]]:
        system, middles, b = self.system, self.middles, len(f)
        of_nodes, of_middles = f[..., ::2].transpose(2, 0, 1), f[..., 1::2].transpose(2, 0, 1)
        reduction = middles.reduction(of_middles)
        none = jnp.zeros_like(of_nodes[:1])
        rotations = (
            of_nodes - jnp.concatenate([reduction[:, :b], none]) - jnp.concatenate([none, reduction[:, b : 2 * b]])
        )
        forces = gaps.transpose(1, 2, 0) - reduction[:, 2 * b : 2 * b + 3]
        of_positions = nodes.transpose(1, 2, 0)
        if middles.left is not None:
            of_positions -= _on_nodes(reduction[:, 2 * b + 3 : 2 * b + 6], reduction[:, 2 * b + 6 :])
        with_force = _before if system.is_loose else _after
        right = jnp.concatenate([rotations, with_force(forces), of_positions], axis=1)
        right = jnp.einsum("npq,nqr->npr", self.inverses, right)

        z = substituted(self.after, substituted(self.before, right), backward=True)
        forces = (z[:-1] if system.is_loose else z[1:])[:, b : b + 3]
        around = jnp.concatenate([z[:-1, :b], z[1:, :b], forces], axis=1)
        of_middles = jnp.einsum("npq,nqr->npr", middles.inverse, of_middles)
        of_middles -= jnp.einsum("npq,nqr->npr", middles.solved, around)
        x = _at_points(z[:, :b].transpose(1, 2, 0), of_middles.transpose(1, 2, 0))
        return x, z[:, b + 3 :].transpose(2, 0, 1), forces.transpose(2, 0, 1)


@traced_once
def factor_chain(system: ChainSystem) -> ChainFactors:
    """Factorisation from node to node, O(n)."""
    whole, contacts, system = system, system.contacts, system.condensed()
    b, n = system.across.shape[-2:]
    dtype = system.diagonal.dtype
    middles, elements, negative = _eliminated(system)
    free = jnp.where(system.held, 0.0, 1.0).astype(dtype)
    identity = jnp.eye(3, dtype=dtype)
    start, end, gap = slice(0, b), slice(b, 2 * b), slice(2 * b, 2 * b + 3)  # of an element
    turn, pull, place = slice(0, b), slice(b, b + 3), slice(b + 3, None)  # of the unknowns of a node
    none = jnp.zeros((n + 1, b, 3), dtype)
    turning = none if system.turning is None else system.turning.transpose(2, 0, 1) * free[:, None, None]
    turns = system.diagonal[..., ::2].transpose(2, 0, 1) + _on_nodes(elements[:, start, start], elements[:, end, end])
    # A force is with the node after its element, and the first node has none; with the one before if that is loose.
    near, far = (start, end) if system.is_loose else (end, start)
    with_force = _before if system.is_loose else _after
    moved = [-free[:-1, None, None] * identity[None], free[1:, None, None] * identity[None]]
    moved_near, moved_far = moved if system.is_loose else moved[::-1]
    pulling, pushed = with_force(elements[:, gap, near]), with_force(moved_near)
    places = jnp.where(system.held[:, None, None], identity[None], system.stiffness)
    # In the unit of the node, as below, no larger than the rest of its pivot.
    lacking = -identity / jnp.maximum(1.0, jnp.trace(places[-1]) / 3) if system.is_loose else -identity
    pulls = with_force(elements[:, gap, gap]).at[-1 if system.is_loose else 0].set(lacking)
    blocks = _matrices(
        [turns, with_force(elements[:, near, gap]), turning],
        [pulling, pulls, pushed],
        [turning.transpose(0, 2, 1), pushed, places],
    )
    # From a node to the one that has the force between them, and back.
    apart = jnp.zeros((n, 3, b + 6), dtype)
    onto = _matrices(
        [elements[:, near, far], apart[..., :b].transpose(0, 2, 1), none[1:]],
        [elements[:, gap, far], apart[..., :3], moved_far],
        [apart],
    )
    back = onto.transpose(0, 2, 1)
    if system.loads is not None:
        back = back.at[:, turn, turn].set(elements[:, far, near]).at[:, turn, pull].set(elements[:, far, gap])
        before, after = elements[:, 2 * b + 3 : 2 * b + 6], elements[:, 2 * b + 6 :]
        blocks = blocks.at[:-1, place, turn].add(before[..., start]).at[1:, place, turn].add(after[..., end])
        on_near, on_far = (before, after) if system.is_loose else (after, before)
        blocks = blocks.at[slice(-1) if system.is_loose else slice(1, None), place, pull].add(on_near[..., gap])
        onto = onto.at[:, place, turn].set(on_near[..., far])
        back = back.at[:, place, turn].set(on_far[..., near]).at[:, place, pull].add(on_far[..., gap])
    below, above = (back, onto) if system.is_loose else (onto, back)
    if system.between is not None:
        between = system.between.transpose(2, 0, 1)
        for rows, columns, part in (
            (turn, turn, between[:, :b, :b]),
            (turn, place, between[:, :b, b:]),
            (place, turn, between[:, b:, :b]),
            (place, place, between[:, b:, b:]),
        ):
            below = below.at[:, rows, columns].add(part)
            above = above.at[:, columns, rows].add(part.transpose(0, 2, 1))

    # Contacts are stiffer than rods by many orders: pivots are inverted, and their signs counted, in units of them. A
    # node that has the force beyond it is as stiff as all before it.
    def scale_of(places: Float[Array, "*k 3 3"]) -> Float[Array, "*k c"]:
        stiffness = jnp.trace(places, axis1=-2, axis2=-1)[..., None] / 3
        unit = jnp.sqrt(jnp.where(stiffness < 1, 1.0, stiffness))
        turns, three = (jnp.ones((*stiffness.shape[:-1], count), dtype) for count in (b, 3))
        return jnp.concatenate([turns, unit * three, three / unit], axis=-1)

    def inverted(block: Array, scale: Array) -> tuple[Array, Array]:
        if system.is_loose:
            scale = scale_of(block[place, place])
        pivot = scale[:, None] * block * scale[None]
        return pivot, scale[:, None] * inverse_matrix(pivot) * scale[None]

    def eliminated(before: Array, given: tuple[Array, Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        block, below, above, scale = given
        pivot, here = inverted(block - below @ before @ above, scale)
        return here, (pivot, here)

    scale = scale_of(places)
    begin, first = inverted(blocks[0], scale[0])
    _, (pivots, inverses) = jax.lax.scan(eliminated, first, (blocks[1:], below, above, scale[1:]))
    pivots, inverses = jnp.concatenate([begin[None], pivots]), jnp.concatenate([first[None], inverses])
    is_symmetric = system.loads is None and contacts.pushes is None
    if is_symmetric:
        # Each force is a multiplier, and so is that of the element that a node at an end lacks.
        negative += negative_count(jax.lax.stop_gradient(pivots)) - 3 * (n + 1)
    border = _border_of(system, contacts)
    blank, no_complement = border.columns(), jnp.zeros((border.size, border.size), dtype)
    before = jnp.einsum("npq,nqr->npr", inverses[1:], below)
    after = jnp.einsum("npq,nqr->npr", inverses[:-1], above)
    chain = contacts, whole, system, middles, inverses, before, after
    factors = ChainFactors(*chain, border, blank, no_complement, no_complement, negative)
    if not border.size:
        return factors

    def solved(border: Border) -> tuple[Columns, Float[Array, "k k"], Int[Array, ""]]:
        columns = border.columns()
        if not border.size:
            return columns, border.whole_compliance(), jnp.zeros_like(negative)
        solution = factors._without_border(*columns)
        matrix = -border.whole_compliance() - border.times(*solution[:2])
        if not is_symmetric:
            return solution, matrix, jnp.zeros_like(negative)
        return solution, matrix, negative_count(jax.lax.stop_gradient(matrix)[None]) - border.positive

    solution, matrix, more = border.by_need(solved)
    return ChainFactors(*chain, border, solution, matrix, border.inverse(matrix), negative + more)


def _border_of(system: ChainSystem, contacts: ContactRows) -> Border:
    """Of a system that may be mirrored, with contacts that are not."""
    far = contacts.far
    if far is None:
        return Border(system.border, system.compliance)
    is_closed = contacts.is_closed[far.row, far.elements]
    far = far.mirrored(len(system.held)) if system.is_backward else far
    return Border(system.border, system.compliance, far, is_closed, contacts.contact_compliance)


def _eliminated(system: ChainSystem) -> tuple[_Middles, Float[Array, "n rows 2b+3"], Int[Array, ""]]:
    """The middles eliminated; what then couples the rows of an element, of start, end and gap, and where loads have no
    potential of both nodes, to its start, end and force; how many negative eigenvalues the middles had.
    """
    b, loads = len(system.diagonal), system.loads
    start, middle, end = system.by_force.transpose(2, 3, 0, 1)
    of_middle = jnp.concatenate(
        [system.lower[..., 0::2].transpose(2, 0, 1), system.lower[..., 1::2].transpose(2, 1, 0), middle], axis=2
    )
    across = system.across.transpose(2, 0, 1)
    none = jnp.zeros_like(across)
    upper = jnp.concatenate([none, across.transpose(0, 2, 1), start], axis=2)
    lower = jnp.concatenate([across, none, end], axis=2)
    gaps = jnp.concatenate(
        [start.transpose(0, 2, 1), end.transpose(0, 2, 1), -system.cell_compliance.transpose(2, 0, 1)], axis=2
    )
    direct = jnp.concatenate([upper, lower, gaps], axis=1)
    if loads is None:
        inverse, negative = inverse_of_blocks(system.diagonal[..., 1::2])
        inverse = inverse.transpose(2, 0, 1)
        solved = inverse @ of_middle
        return _Middles(solved, inverse, None), direct - of_middle.transpose(0, 2, 1) @ solved, negative
    of_rotations, of_gaps = loads.rotation.transpose(4, 1, 0, 3, 2), loads.segment_vectors.transpose(3, 0, 2, 1)
    free = jnp.where(system.held, 0.0, 1.0).astype(none.dtype)
    of_nodes = loads.balance.transpose(4, 0, 1, 3, 2) * jnp.stack([free[:-1], free[1:]], 1)[:, :, None, None, None]
    of_nodes = of_nodes.reshape(-1, 6, 3, b)

    def of_point(j: int) -> Float[Array, "n rows b"]:
        """What the rows have of the loads by the rotation of a point."""
        return jnp.concatenate(
            [of_rotations[:, 0, :, j], of_rotations[:, 2, :, j], of_gaps[:, :, j], of_nodes[:, :, j]], 1
        )

    inverse = inverse_matrix(system.diagonal[..., 1::2].transpose(2, 0, 1) + of_rotations[:, 1, :, 1])
    columns = of_middle.at[..., :b].add(of_rotations[:, 1, :, 0]).at[..., b : 2 * b].add(of_rotations[:, 1, :, 2])
    rows = of_point(1).at[:, : 2 * b + 3].add(of_middle.transpose(0, 2, 1))
    direct = jnp.pad(direct, ((0, 0), (0, 6), (0, 0)))
    direct = direct.at[..., :b].add(of_point(0)).at[..., b : 2 * b].add(of_point(2))
    solved = inverse @ columns
    return _Middles(solved, inverse, rows @ inverse), direct - rows @ solved, jnp.zeros((), int)


def _transposed(blocks: Float[Array, "i j n"]) -> Float[Array, "j i n"]:
    return jnp.swapaxes(blocks, 0, 1)


def _row(parts: list[Any]) -> Float[Array, "i j n"]:
    """Of blocks side by side; a number is that of columns that are zero."""
    like = next(part for part in parts if not isinstance(part, int))

    def filled(part: Any) -> Array:
        return jnp.zeros((len(like), part, like.shape[2]), like.dtype) if isinstance(part, int) else part

    return jnp.concatenate([filled(part) for part in parts], axis=1)


def _matrices(*rows: list[Array]) -> Float[Array, "n i j"]:
    """Of their blocks, row by row."""
    return jnp.concatenate([jnp.concatenate(blocks, axis=2) for blocks in rows], axis=1)


def _at_points(nodes: Float[Array, "*c n+1"], middles: Float[Array, "*c n"]) -> Float[Array, "*c m"]:
    """Nodes and middles in turn."""
    pairs = jnp.stack([nodes[..., :-1], middles], axis=-1).reshape(*middles.shape[:-1], -1)
    return jnp.concatenate([pairs, nodes[..., -1:]], axis=-1)


def _after(of_elements: Float[Array, "n *c"]) -> Float[Array, "n+1 *c"]:
    """What nodes have of the element before them."""
    return jnp.concatenate([jnp.zeros_like(of_elements[:1]), of_elements])


def _before(of_elements: Float[Array, "n *c"]) -> Float[Array, "n+1 *c"]:
    """What nodes have of the element beyond them."""
    return jnp.concatenate([of_elements, jnp.zeros_like(of_elements[:1])])


def _on_nodes(before: Float[Array, "n *c"], after: Float[Array, "n *c"]) -> Float[Array, "n+1 *c"]:
    """What elements have for the nodes at their start and their end."""
    none = jnp.zeros_like(before[:1])
    return jnp.concatenate([before, none]) + jnp.concatenate([none, after])


def _at_ends(of_nodes: Float[Array, "c n+1"]) -> Float[Array, "c 2 n"]:
    """At the start and the end of each element."""
    return jnp.stack([of_nodes[:, :-1], of_nodes[:, 1:]], axis=1)
