"""Factorisation of a `chain.ChainSystem` by block elimination from node to node.

Pressures are eliminated first, each by itself, then the points in the middle of elements; then a node has b + 6
unknowns, rotation, force of the element before it and displacement, coupled with those of its neighbours only: O(n).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.blocks import inverse_of_blocks
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.chain_border import Border, Columns
from rodjax.linalg.chain_nodes import at_points, on_nodes
from rodjax.linalg.chain_rows import ContactRows
from rodjax.linalg.small_matrices import inverse_matrix, negative_count
from rodjax.linalg.substitution import substituted
from rodjax.programs.parts import traced_once

# Solutions with soft contacts, after the first one.
HARDENINGS = 5
# In these, contacts between elements have this part of their compliance.
HARD = 1e-4


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
        at = k + 5 * np.arange(len(far.elements))
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
            of_far = jnp.zeros((len(of_far), 5), of_far.dtype).at[:, 0].set(of_far)
            first = jnp.concatenate([first, of_far.reshape(-1)])
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
            found = jnp.where(here, -multipliers[k::5], -given[far.row, far.elements])
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
            of_positions -= on_nodes(reduction[:, 2 * b + 3 : 2 * b + 6], reduction[:, 2 * b + 6 :])
        with_force = _before if system.is_loose else _after
        right = jnp.concatenate([rotations, with_force(forces), of_positions], axis=1)
        right = jnp.einsum("npq,nqr->npr", self.inverses, right)

        z = substituted(self.after, substituted(self.before, right), backward=True)
        forces = (z[:-1] if system.is_loose else z[1:])[:, b : b + 3]
        around = jnp.concatenate([z[:-1, :b], z[1:, :b], forces], axis=1)
        of_middles = jnp.einsum("npq,nqr->npr", middles.inverse, of_middles)
        of_middles -= jnp.einsum("npq,nqr->npr", middles.solved, around)
        x = at_points(z[:, :b].transpose(1, 2, 0), of_middles.transpose(1, 2, 0))
        return x, z[:, b + 3 :].transpose(2, 0, 1), forces.transpose(2, 0, 1)


@traced_once
def factor_chain(system: ChainSystem) -> ChainFactors:
    """Factorisation from node to node, O(n)."""
    whole, contacts, system = system, system.contacts.needed_first(), system.condensed()
    b, n = system.across.shape[-2:]
    dtype = system.diagonal.dtype
    middles, elements, negative = _eliminated(system)
    free = jnp.where(system.held, 0.0, 1.0).astype(dtype)
    identity = jnp.eye(3, dtype=dtype)
    start, end, gap = slice(0, b), slice(b, 2 * b), slice(2 * b, 2 * b + 3)  # of an element
    turn, pull, place = slice(0, b), slice(b, b + 3), slice(b + 3, None)  # of the unknowns of a node
    none = jnp.zeros((n + 1, b, 3), dtype)
    turning = none if system.turning is None else system.turning.transpose(2, 0, 1) * free[:, None, None]
    turns = system.diagonal[..., ::2].transpose(2, 0, 1) + on_nodes(elements[:, start, start], elements[:, end, end])
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


def _matrices(*rows: list[Array]) -> Float[Array, "n i j"]:
    """Of their blocks, row by row."""
    return jnp.concatenate([jnp.concatenate(blocks, axis=2) for blocks in rows], axis=1)


def _after(of_elements: Float[Array, "n *c"]) -> Float[Array, "n+1 *c"]:
    """What nodes have of the element before them."""
    return jnp.concatenate([jnp.zeros_like(of_elements[:1]), of_elements])


def _before(of_elements: Float[Array, "n *c"]) -> Float[Array, "n+1 *c"]:
    """What nodes have of the element beyond them."""
    return jnp.concatenate([of_elements, jnp.zeros_like(of_elements[:1])])
