"""Saddle-point systems of a rod whose nodes have positions of their own.

The rotations of tangents or frames, b at each point, and the force in each element are the unknowns, as in
`saddle_point`, and the positions of the nodes, and the pressures of contacts at nodes and within elements. The force of
an element is the multiplier of its segment vector, the pressure that of a gap.

    rotation     H theta + B F + T u + border y - M q = f
    gap          B^T theta - C F + u_after - u_before = gap,       for each element
    balance      S u + T^T theta - N p - K q + F_before - F_after = balance,   for each node that is not held
    border       border^T theta - compliance y = c
    pressure     -N^T u - c p = d  where a contact is closed; else  -p = d, and p pushes at nothing
    within       -M^T theta - K^T u - c q = d, the same

with the contact compliance c. Loads without a potential add rows of their own to the first three, without symmetry
(`chain_rows.LoadRows`).
"""

import dataclasses
import enum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.linalg.chain_nodes import at_points, on_nodes
from rodjax.linalg.chain_rows import ContactRows, LoadRows
from rodjax.programs.parts import traced_once

# Of a rod with two free ends the stiffness that holds its last node while it is factorised [EI/L^3]: displacements that
# nothing else holds, as along a floor, are regular by it.
LOOSE = 1e-4


class Elimination(enum.Enum):
    """From which node to which one: a first node that nothing holds or touches has no pivot by itself.

    `FROM_START`, also of an end that is free; `FROM_END`, of a start that is free; `WITH_FORCES`, of two free ends: the
    force of an element goes with the node before it, and the last node is held softly (`LOOSE`).
    """

    FROM_START = enum.auto()
    FROM_END = enum.auto()
    WITH_FORCES = enum.auto()


class ChainSystem(eqx.Module):
    """The matrix above, for n elements with m = 2 n + 1 points, nodes and middles in turn.

    `diagonal`, `lower`, `across`: the blocks of H, as in `saddle_point.SaddlePointSystem`; `by_force`: those of B at
    start, middle and end of each element; `cell_compliance`: C; `stiffness`: S; `contacts`: N; `held`: the nodes whose
    place is given; `turning`: T, of what a field of forces has of both the place and the rotation of a node, `None` for
    none. What is no rotation comes as one vector: border, contacts, then the nodes, then the elements.
    `between`: what rotations and place (b, 3) of the last node of an element have by those of its first, beside H;
    `None` for none. `loads`: `None` where all have a potential.
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
    elimination: Elimination = eqx.field(static=True, default=Elimination.FROM_START)

    @property
    def is_backward(self) -> bool:
        return self.elimination is Elimination.FROM_END

    @property
    def is_loose(self) -> bool:
        return self.elimination is Elimination.WITH_FORCES

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
        nodes = jnp.einsum("pqn,qn->pn", self.nodes, at_nodes) + on_nodes(before.T, after.T).T
        middles += jnp.einsum("ijn,jn->in", self.diagonal[..., 1::2], x[:, 1::2])
        f, balance, gap = at_points(nodes[:b], middles), nodes[b:].T, gap.T
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


def _transposed(blocks: Float[Array, "i j n"]) -> Float[Array, "j i n"]:
    return jnp.swapaxes(blocks, 0, 1)


def _row(parts: list[Any]) -> Float[Array, "i j n"]:
    """Of blocks side by side; a number is that of columns that are zero."""
    like = next(part for part in parts if not isinstance(part, int))

    def filled(part: Any) -> Array:
        return jnp.zeros((len(like), part, like.shape[2]), like.dtype) if isinstance(part, int) else part

    return jnp.concatenate([filled(part) for part in parts], axis=1)
