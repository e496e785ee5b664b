"""Rows of a `chain.ChainSystem`: the gradients of gaps, and what loads without a potential add."""

import dataclasses
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.linalg.chain_nodes import at_ends, on_nodes
from rodjax.linalg.far_rows import FarRows

if TYPE_CHECKING:
    from rodjax.linalg.chain import ChainSystem


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
            by_rotation=self.by_rotation * at_ends(turns[None])[None],
            by_position=self.by_position * at_ends(moves[None])[None],
        )

    def rates(self, x: Float[Array, "b m"], u: Float[Array, "n+1 3"]) -> Float[Array, "q n+1"]:
        nodes, displacements = at_ends(x[:, ::2]), at_ends(u.T)
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
        return on_nodes(start, end)

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

    def needed_first(self) -> "ContactRows":
        """Of those between elements first the ones that are closed or have curvature."""
        if self.far is None:
            return self
        is_closed = self.is_closed[self.far.row, self.far.elements]
        return dataclasses.replace(self, far=self.far.needed_first(is_closed))

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
