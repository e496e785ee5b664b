"""Contacts between elements that are far from one another along the rod, as rows and columns of a chain's border; and
what contacts between rods have of each of these.

Each of p contacts has the gradient of its gap by the rotations and positions of the nodes of its two elements. Its
curvature couples both elements too: it is kept as four more vectors v, the first two of which take v v^T from the
stiffness, while the others add it (`SIGNS`). In rows of all five of each contact one contact follows another.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

# By what the outer product of each vector of the curvature enters the stiffness.
SIGNS = np.array([-1.0, -1.0, 1.0, 1.0])


def compliances_of(gaps: Float[Array, "p"]) -> Float[Array, "5p"]:
    """Of all columns, where those of the gaps are given."""
    signs = jnp.broadcast_to(jnp.asarray(SIGNS, gaps.dtype)[None], (len(gaps), len(SIGNS)))
    return jnp.concatenate([gaps[:, None], signs], axis=1).reshape(-1)


class NodeRows(eqx.Module):
    """`by_rotation`, `by_position`: of each contact the gradient of the gap and the four vectors of its curvature, by
    rotation and place of the nodes of this rod, q of them; `nodes`: their numbers.
    """

    by_rotation: Float[Array, "5 b q p"]
    by_position: Float[Array, "5 3 q p"]
    nodes: Int[Array, "q p"]

    def times(
        self, factors: Float[Array, "5 p"], x: Float[Array, "b r m"], u: Float[Array, "r n+1 3"]
    ) -> Float[Array, "5p r"]:
        """All of these columns, by these factors, times others."""
        turns, moves = x[:, :, 2 * self.nodes], u[:, self.nodes]  # [b, r, q, p], [r, q, p, 3]
        product = jnp.einsum("kbqp,brqp->pkr", self.by_rotation, turns)
        product += jnp.einsum("kcqp,rqpc->pkr", self.by_position, moves)
        return (factors.T[..., None] * product).reshape(factors.size, len(u))

    def columns(
        self, factors: Float[Array, "5 p"], points: int
    ) -> tuple[Float[Array, "b 5p m"], Float[Array, "5p n+1 3"]]:
        """As columns, by these factors: by rotations and by positions."""
        is_there = (self.nodes[..., None] == np.arange((points + 1) // 2)[None, None]).astype(factors.dtype)
        by_node = jnp.einsum("kbqp,kp,qpn->bpkn", self.by_rotation, factors, is_there)
        by_point = jnp.zeros((*by_node.shape[:-1], points), factors.dtype).at[..., ::2].set(by_node)
        by_position = jnp.einsum("kcqp,kp,qpn->pknc", self.by_position, factors, is_there)
        columns, nodes = factors.size, by_position.shape[2]
        return by_point.reshape(len(by_point), columns, points), by_position.reshape(columns, nodes, 3)

    def turned_by(self, k: int, along: Float[Array, "p"], points: int) -> Float[Array, "b m"]:
        """By rotations, the sum of one column of each contact times these numbers."""
        by_rotation = self.by_rotation[k] * along[None, None]
        return jnp.zeros((len(by_rotation), points), along.dtype).at[:, 2 * self.nodes].add(by_rotation)

    def pushed_by(self, k: int, along: Float[Array, "p"], nodes: int) -> Float[Array, "n+1 3"]:
        """And by positions."""
        return jnp.zeros((3, nodes), along.dtype).at[:, self.nodes].add(self.by_position[k] * along[None, None]).T


class FarRows(NodeRows):
    """Of both elements; `elements`: where the contact stands in its row of n + 1 numbers, whose other numbers stand for
    nothing. `row`: the number of that row among those of all contacts.
    """

    elements: Int[Array, "p"]
    row: int = eqx.field(static=True)

    def rates(self, x: Float[Array, "b m"], u: Float[Array, "n+1 3"]) -> Float[Array, "n+1"]:
        """Of the gaps, as the rod turns and nodes move."""
        return jnp.zeros(len(u), u.dtype).at[self.elements].set(self._along(0, x, u), unique_indices=True)

    def turned(self, pressures: Float[Array, "n+1"]) -> Float[Array, "b m"]:
        """The moments of pressures on the points of the rod."""
        return self.turned_by(0, pressures[self.elements], 2 * len(pressures) - 1)

    def pushed(self, pressures: Float[Array, "n+1"]) -> Float[Array, "n+1 3"]:
        """The forces of pressures on the nodes."""
        return self.pushed_by(0, pressures[self.elements], len(pressures))

    def curved(self, x: Float[Array, "b m"], u: Float[Array, "n+1 3"]) -> tuple[Array, Array]:
        """What the curvature does to the moments on the points, and to the forces on the nodes."""
        moments, forces = jnp.zeros_like(x), jnp.zeros_like(u)
        for k, sign in enumerate(SIGNS, 1):
            along = sign * self._along(k, x, u)
            moments += self.turned_by(k, along, x.shape[1])
            forces += self.pushed_by(k, along, len(u))
        return moments, forces

    def first(self, count: int) -> "FarRows":
        """The first contacts alone."""
        return FarRows(
            self.by_rotation[..., :count],
            self.by_position[..., :count],
            self.nodes[:, :count],
            self.elements[:count],
            self.row,
        )

    def needed_first(self, is_closed: Bool[Array, "p"]) -> "FarRows":
        """With those first that are closed or have curvature."""
        order = jnp.argsort(~self.are_needed(is_closed))
        return jax.tree.map(lambda part: part[..., order], self)

    def are_needed(self, is_closed: Bool[Array, "p"]) -> Bool[Array, "p"]:
        """Which are closed or have curvature."""
        return is_closed | (self.by_rotation[1:] != 0).any((0, 1, 2)) | (self.by_position[1:] != 0).any((0, 1, 2))

    def mirrored(self, nodes: int) -> "FarRows":
        """With the nodes counted from the end."""
        return dataclasses.replace(self, nodes=nodes - 1 - self.nodes)

    def holding(self, turns: Float[Array, "n+1"], moves: Float[Array, "n+1"]) -> "FarRows":
        """`turns`, `moves`: 0 at nodes whose rotation or place is held, else 1."""
        return dataclasses.replace(
            self,
            by_rotation=self.by_rotation * turns[self.nodes][None, None],
            by_position=self.by_position * moves[self.nodes][None, None],
        )

    @property
    def positive(self) -> int:
        """The number of the columns whose compliance is positive."""
        return len(self.elements) * (1 + int(np.sum(SIGNS > 0)))

    def _along(self, k: int, x: Float[Array, "b m"], u: Float[Array, "n+1 3"]) -> Float[Array, "p"]:
        turns, moves = x[:, 2 * self.nodes], u.T[:, self.nodes]
        return jnp.sum(self.by_rotation[k] * turns, axis=(0, 1)) + jnp.sum(self.by_position[k] * moves, axis=(0, 1))
