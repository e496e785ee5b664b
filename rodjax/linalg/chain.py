"""Saddle-point systems of a rod whose nodes have positions of their own, by block elimination from node to node.

The rotations of tangents or frames, b at each point, and the force in each element are the unknowns, as in `linalg`,
and the positions of the nodes, at which something may push: its stiffness stands on their diagonal. The force of an
element is the multiplier of its way from node to node. The points in the middle of elements go first; then a node has
b + 6 unknowns, rotation, force of the element before it and displacement, coupled with those of its neighbours only:
O(n).

    rotation     H theta + B F + border y = f
    gap          B^T theta - C F + u_after - u_before = gap,    for each element
    balance      S u + F_before - F_after = balance,            for each node that is not held
    border       border^T theta - compliance y = c
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.blocks import inverse_of_blocks


class ChainSystem(eqx.Module):
    """The matrix above, for n elements with m = 2 n + 1 points, nodes and middles in turn.

    `diagonal`, `lower`, `across`: the blocks of H, as in `saddle_point.SaddlePointSystem`; `by_force`: those of B at
    start, middle and end of each element; `cell_compliance`: C; `stiffness`: S; `held`: the nodes whose place is given.
    What is no rotation comes as one vector: border, then the nodes, then the elements. `is_backward`: elimination
    begins at the end, for a free start: a first node that nothing holds or touches has no pivot.
    """

    diagonal: Float[Array, "b b m"]
    lower: Float[Array, "b b m-1"]
    across: Float[Array, "b b n"]
    border: Float[Array, "b k m"]
    compliance: Float[Array, "k k"]
    by_force: Float[Array, "b 3 3 n"]
    cell_compliance: Float[Array, "3 3 n"]
    stiffness: Float[Array, "n+1 3 3"]
    held: Bool[Array, "n+1"]
    is_backward: bool = eqx.field(static=True, default=False)

    def mirrored(self) -> "ChainSystem":
        """The same system of the rod counted from its end: the forces through the elements have the other sign."""
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
        )

    def shifted(self, shift: Float[Array, ""] | Float[Array, "m"]) -> "ChainSystem":
        """H + shift I in the place of H, with one shift or one for each point."""
        identity = jnp.eye(len(self.diagonal), dtype=shift.dtype)[..., None]
        shift = jnp.broadcast_to(shift, self.diagonal.shape[-1:])
        return eqx.tree_at(lambda system: system.diagonal, self, self.diagonal + shift[None, None] * identity)

    def times(self, x: Float[Array, "b m"], y: Float[Array, "j"]) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
        """The matrix times (x, y): the right sides."""
        first, u, force = self.parted(y)
        u = jnp.where(self.held[:, None], 0.0, u)
        f = jnp.einsum("ijm,jm->im", self.diagonal, x) + jnp.einsum("ikm,k->im", self.border, first)
        f = f.at[:, 1:].add(jnp.einsum("ijm,jm->im", self.lower, x[:, :-1]))
        f = f.at[:, :-1].add(jnp.einsum("jim,jm->im", self.lower, x[:, 1:]))
        f = f.at[:, 2::2].add(jnp.einsum("ijm,jm->im", self.across, x[:, :-1:2]))
        f = f.at[:, :-1:2].add(jnp.einsum("jim,jm->im", self.across, x[:, 2::2]))
        gap = jnp.diff(u, axis=0) - jnp.einsum("ijn,nj->ni", self.cell_compliance, force)
        for point, at in enumerate((slice(0, -1, 2), slice(1, None, 2), slice(2, None, 2))):
            f = f.at[:, at].add(jnp.einsum("icn,nc->in", self.by_force[:, :, point], force))
            gap += jnp.einsum("icn,in->nc", self.by_force[:, :, point], x[:, at])
        none = jnp.zeros_like(force[:1])
        balance = jnp.concatenate([none, force]) - jnp.concatenate([force, none])
        balance = jnp.where(
            self.held[:, None], self.parted(y)[1], balance + jnp.einsum("kij,kj->ki", self.stiffness, u)
        )
        first = jnp.einsum("ikm,im->k", self.border, x) - self.compliance @ first
        return f, jnp.concatenate([first, balance.reshape(-1), gap.reshape(-1)])

    def parted(self, y: Float[Array, "j"]) -> tuple[Float[Array, "k"], Float[Array, "n+1 3"], Float[Array, "n 3"]]:
        """What belongs to the border, the nodes and the elements."""
        k, nodes = len(self.compliance), len(self.held)
        return y[:k], y[k : k + 3 * nodes].reshape(nodes, 3), y[k + 3 * nodes :].reshape(nodes - 1, 3)


class _Middles(eqx.Module):
    """The elimination of the points in the middle: what couples them to start, end and force, before and after."""

    solved: Float[Array, "n b 2b+3"]
    inverse: Float[Array, "n b b"]


class ChainFactors(eqx.Module):
    """The factorisation of a `ChainSystem`; `negative` as in `saddle_point.Factors`.

    Where elimination begins at the end, `system` and all else is mirrored.
    """

    system: ChainSystem
    middles: _Middles
    inverses: Float[Array, "n+1 c c"]
    below: Float[Array, "n c c"]
    border_solution: tuple[Float[Array, "b k m"], Float[Array, "k j"]]
    complement: Float[Array, "k k"]
    negative: Int[Array, ""]

    @property
    def is_minimum(self) -> Bool[Array, ""]:
        """Whether H is positive definite under the constraints."""
        return (self.negative == 0) & jnp.isfinite(jnp.sum(self.inverses)) & jnp.isfinite(jnp.sum(self.complement))

    def solve(self, f: Float[Array, "b m"], c: Float[Array, "j"]) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
        first, nodes, gaps = self.system.parted(c)
        if self.system.is_backward:
            f, nodes, gaps = f[:, ::-1], nodes[::-1], -gaps[::-1]
        x, y = self._without_border(f[:, None], nodes[None], gaps[None])
        x, y = x[:, 0], y[0]
        by_border, of_border = self.border_solution
        multipliers = self.complement @ (first - jnp.einsum("ikm,im->k", self.system.border, x))
        x -= jnp.einsum("ikm,k->im", by_border, multipliers)
        y = jnp.concatenate([multipliers, y - multipliers @ of_border])
        if self.system.is_backward:
            _, displacements, forces = self.system.parted(y)
            y = jnp.concatenate([multipliers, displacements[::-1].reshape(-1), -forces[::-1].reshape(-1)])
            x = x[:, ::-1]
        return x, y

    def _without_border(
        self, f: Float[Array, "b r m"], nodes: Float[Array, "r n+1 3"], gaps: Float[Array, "r n 3"]
    ) -> tuple[Float[Array, "b r m"], Float[Array, "r j"]]:
        middles, b = self.middles, len(f)
        of_nodes, of_middles = f[..., ::2].transpose(2, 0, 1), f[..., 1::2].transpose(2, 0, 1)
        moved = jnp.einsum("npq,npr->nqr", middles.solved, of_middles)
        none = jnp.zeros_like(of_nodes[:1])
        rotations = of_nodes - jnp.concatenate([moved[:, :b], none]) - jnp.concatenate([none, moved[:, b : 2 * b]])
        forces = gaps.transpose(1, 2, 0) - moved[:, 2 * b :]
        right = jnp.concatenate(
            [rotations, jnp.pad(forces, ((1, 0), (0, 0), (0, 0))), nodes.transpose(1, 2, 0)], axis=1
        )

        def forward(before: Array, given: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            inverse, below, right = given
            here = inverse @ (right - below @ before)
            return here, here

        def backward(after: Array, given: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            inverse, above, here = given
            here -= inverse @ (above.T @ after)
            return here, here

        first = self.inverses[0] @ right[0]
        _, reached = jax.lax.scan(forward, first, (self.inverses[1:], self.below, right[1:]))
        last = reached[-1]
        reached = jnp.concatenate([first[None], reached[:-1]])
        _, solved = jax.lax.scan(backward, last, (self.inverses[:-1], self.below, reached), reverse=True)
        z = jnp.concatenate([solved, last[None]])
        around = jnp.concatenate([z[:-1, :b], z[1:, : b + 3]], axis=1)
        of_middles = jnp.einsum("npq,nqr->npr", middles.inverse, of_middles)
        of_middles -= jnp.einsum("npq,nqr->npr", middles.solved, around)
        x = jnp.zeros_like(f).at[..., ::2].set(z[:, :b].transpose(1, 2, 0))
        x = x.at[..., 1::2].set(of_middles.transpose(1, 2, 0))
        r = f.shape[1]
        displacements, forces = z[:, b + 3 :].transpose(2, 0, 1), z[1:, b : b + 3].transpose(2, 0, 1)
        return x, jnp.concatenate([displacements.reshape(r, -1), forces.reshape(r, -1)], axis=1)


def factor_chain(system: ChainSystem) -> ChainFactors:
    """Factorisation from node to node, O(n)."""
    system = system.mirrored() if system.is_backward else system
    b, n = system.across.shape[-2:]
    dtype = system.diagonal.dtype
    middles, coupled, negative = _eliminated(system)
    start, end, force = slice(0, b), slice(b, 2 * b), slice(2 * b, None)
    of_nodes = system.diagonal[..., ::2].transpose(2, 0, 1)
    of_nodes = of_nodes.at[:-1].add(-coupled[:, start, start]).at[1:].add(-coupled[:, end, end])
    free = jnp.where(system.held, 0.0, 1.0).astype(dtype)
    identity = jnp.eye(3, dtype=dtype)
    by_end = system.by_force[:, :, 2].transpose(2, 1, 0) - coupled[:, force, end]
    of_force = -system.cell_compliance.transpose(2, 0, 1) - coupled[:, force, force]
    turn, pull, place = slice(0, b), slice(b, b + 3), slice(b + 3, None)  # of the unknowns of a node
    blocks = jnp.zeros((n + 1, b + 6, b + 6), dtype)
    blocks = blocks.at[:, turn, turn].set(of_nodes)
    blocks = blocks.at[1:, pull, turn].set(by_end).at[1:, turn, pull].set(by_end.transpose(0, 2, 1))
    # The first node has no element before it.
    blocks = blocks.at[1:, pull, pull].set(of_force).at[0, pull, pull].set(-identity)
    pushed = free[1:, None, None] * identity[None]
    blocks = blocks.at[1:, pull, place].set(pushed).at[1:, place, pull].set(pushed)
    blocks = blocks.at[:, place, place].set(jnp.where(system.held[:, None, None], identity[None], system.stiffness))
    below = jnp.zeros((n, b + 6, b + 6), dtype)
    below = below.at[:, turn, turn].set(system.across.transpose(2, 0, 1) - coupled[:, end, start])
    below = below.at[:, pull, turn].set(system.by_force[:, :, 0].transpose(2, 1, 0) - coupled[:, force, start])
    below = below.at[:, pull, place].set(-free[:-1, None, None] * identity[None])

    # Contacts are stiffer than rods by many orders: pivots are inverted, and their signs counted, in units of them.
    stiffness = jnp.trace(system.stiffness, axis1=1, axis2=2) / 3
    unit = jnp.sqrt(jnp.where(system.held | (stiffness < 1), 1.0, stiffness))
    scale = jnp.concatenate(
        [jnp.ones((n + 1, b), dtype), jnp.tile(unit[:, None], 3), jnp.tile(1 / unit[:, None], 3)], 1
    )

    def inverted(block: Array, scale: Array) -> tuple[Array, Array]:
        pivot = scale[:, None] * block * scale[None]
        return pivot, scale[:, None] * jnp.linalg.inv(pivot) * scale[None]

    def eliminated(inverse: Array, given: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        block, below, scale = given
        pivot, inverse = inverted(block - below @ inverse @ below.T, scale)
        return inverse, (pivot, inverse)

    begin, first = inverted(blocks[0], scale[0])
    _, (pivots, inverses) = jax.lax.scan(eliminated, first, (blocks[1:], below, scale[1:]))
    pivots, inverses = jnp.concatenate([begin[None], pivots]), jnp.concatenate([first[None], inverses])
    # Each force is a multiplier, and so is that of the element before the first node.
    signs = jnp.linalg.eigvalsh(jax.lax.stop_gradient(pivots))
    negative += jnp.sum(signs < 0) - 3 * (n + 1)
    k = len(system.compliance)
    nothing = jnp.zeros((k, n + 1, 3), dtype), jnp.zeros((k, n, 3), dtype)
    blank = jnp.zeros((b, k, 2 * n + 1), dtype), jnp.zeros((k, 6 * n + 3), dtype)
    factors = ChainFactors(system, middles, inverses, below, blank, jnp.zeros((k, k), dtype), negative)
    if not k:
        return factors
    by_border, of_border = factors._without_border(system.border, *nothing)
    matrix = -system.compliance - jnp.einsum("ikm,ijm->kj", system.border, by_border)
    negative += jnp.sum(jnp.linalg.eigvalsh(jax.lax.stop_gradient(matrix)) < 0) - k
    return ChainFactors(system, middles, inverses, below, (by_border, of_border), jnp.linalg.inv(matrix), negative)


def _eliminated(system: ChainSystem) -> tuple[_Middles, Float[Array, "n d d"], Int[Array, ""]]:
    """The middles eliminated, what that takes from start, end and force, and how many negative eigenvalues they had."""
    before = system.lower[..., 0::2].transpose(2, 0, 1)
    after = system.lower[..., 1::2].transpose(2, 1, 0)
    coupling = jnp.concatenate([before, after, system.by_force[:, :, 1].transpose(2, 0, 1)], axis=2)
    inverse, negative = inverse_of_blocks(system.diagonal[..., 1::2])
    inverse = inverse.transpose(2, 0, 1)
    solved = inverse @ coupling
    return _Middles(solved, inverse), coupling.transpose(0, 2, 1) @ solved, negative
