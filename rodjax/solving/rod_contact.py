"""Contact between the rods of a harness: pairs of rods, stacked by the meshes of both.

Lengths are those of the assembly and forces its energy by its length. The pressure of each contact is a number that all
have in common; what the pressures apply to a rod are loads of its scene (`model.loads.ContactLoads`), so that a rod by
itself, its balance and its results, know nothing of others. What couples two rods in the model of a step are columns of
their systems (`columns_of`): gradients of gaps and vectors of their curvature, five for each contact.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from rodjax.discretization.contact_gaps import curve
from rodjax.discretization.curve_distance import Curve
from rodjax.discretization.nearest_places import Nearest, comes_through
from rodjax.discretization.nodal import MERIT_COMPLIANCE, NodalForm
from rodjax.discretization.node_contacts import GAP_WEIGHT, LEAST_RELAXED, LIES_ON
from rodjax.discretization.rod_pairs import (
    MOST_OF_PAIR,
    found_between,
    gaps_between,
    growth_of_pair,
    joined,
    loads_between,
    pair_contacts,
    with_pair_wells,
)
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.far_rows import SIGNS, NodeRows, compliances_of
from rodjax.linalg.small_matrices import inverse_matrix, negative_count
from rodjax.model.loads import ContactLoads
from rodjax.programs.stacks import of_each
from rodjax.solving.coupling import Coupling

# The numbers of the rods of each group.
Members = tuple[tuple[int, ...], ...]
# Of all contacts between rods of two groups, at most so many are sought in the model of a step; of those of several
# groups on the same meshes as many times that.
MOST_BETWEEN = 64
# Compliance of contacts in the model of a step [L^3/EI]. Where the cells of two elements overlap, both may have a
# contact at one place; what one of them lacks to touch is below 1e-8 L.
CONTACT_COMPLIANCE = 1e-9
# What is left of them is inverted with the first so many, or with all; of each contact so many columns have a positive
# compliance.
FEW = (8,)
POSITIVE = 1 + int(np.sum(SIGNS > 0))


class Pairs(NamedTuple):
    """Rods that may touch. Of both sides the numbers of the groups with as many elements, whose rods are stacked one
    after another, where those of each group begin in the stack, and of each pair the places of both rods there;
    `kinds`: of how many two groups they are.
    """

    groups: tuple[tuple[int, ...], tuple[int, ...]]
    begins: tuple[tuple[int, ...], tuple[int, ...]]
    places: tuple[tuple[int, int], ...]
    kinds: int

    @property
    def most(self) -> int:
        """How many contacts of all pairs are sought in the model of a step."""
        return self.kinds * MOST_BETWEEN

    @property
    def first(self) -> np.ndarray:
        return np.array([place for place, _ in self.places])

    @property
    def second(self) -> np.ndarray:
        return np.array([place for _, place in self.places])

    @property
    def sides(self) -> tuple[tuple[tuple[int, ...], tuple[int, ...], np.ndarray], ...]:
        """Groups, where these begin, and places."""
        return tuple(zip(self.groups, self.begins, (self.first, self.second), strict=True))


# Of rods that may touch, by the groups of `Pairs` in which they are stacked.
Curves = dict[tuple[int, ...], Curve]


def pairs_of(contact: tuple[tuple[int, int], ...], members: Members, counts: Sequence[int]) -> tuple[Pairs, ...]:
    """Of pairs of numbers of rods, by the groups of both; `counts`: of elements of the rods of each group. Pairs that
    follow one another on the same meshes are of one kind, so that a harness of many structures has one program for all.
    """
    where = {number: (group, place) for group, numbers in enumerate(members) for place, number in enumerate(numbers)}
    by_groups: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for pair in contact:
        (first, place), (second, other) = (where[number] for number in pair)
        by_groups.setdefault((first, second), []).append((place, other))
    touching = groups_in_contact(contact, members)
    stacks = {group: tuple(one for one in touching if counts[one] == counts[group]) for group in touching}
    begins = {group: sum(len(members[one]) for one in stacks[group] if one < group) for group in touching}
    found: list[Pairs] = []
    for (first, second), places in by_groups.items():
        groups = stacks[first], stacks[second]
        stacked = tuple((begins[first] + place, begins[second] + other) for place, other in places)
        if found and found[-1].groups == groups:
            last = found.pop()
            found.append(last._replace(places=last.places + stacked, kinds=last.kinds + 1))
        else:
            of_groups = tuple(begins[group] for group in groups[0]), tuple(begins[group] for group in groups[1])
            found.append(Pairs(groups, of_groups, stacked, 1))
    return tuple(found)


def groups_in_contact(contact: tuple[tuple[int, int], ...], members: Members) -> list[int]:
    """The numbers of the groups of which a rod may touch another one."""
    touching = {number for pair in contact for number in pair}
    return [group for group, numbers in enumerate(members) if touching.intersection(numbers)]


def in_contact(pairs: tuple[Pairs, ...]) -> list[int]:
    """The same, of pairs."""
    return sorted({group for between in pairs for groups in between.groups for group in groups})


def split_by_pairs(
    pairs: tuple[Pairs, ...], counts: Sequence[int], of_contacts: Shaped[Array, "c"]
) -> tuple[Shaped[Array, "p n"], ...]:
    """Pressures or wells of all contacts, of each kind of pairs by pair and element of its first rod. `counts`: of
    elements of the rods of each group.
    """
    found, first = [], 0
    for each in pairs:
        shape = len(each.places), counts[each.groups[0][0]]
        found.append(of_contacts[first : first + shape[0] * shape[1]].reshape(shape))
        first += shape[0] * shape[1]
    return tuple(found)


class Contacts(NamedTuple):
    """Of p pairs of rods: their curves, where these are nearest, gaps and pressures of the n elements of the first
    ones, which of these have wide wells, and what is added to the gaps in a step.
    """

    curves: Curve
    found: Nearest
    gaps: Float[Array, "p n"]
    pressures: Float[Array, "p n"]
    is_wide: Bool[Array, "p n"]
    relaxed: Float[Array, "p n"]

    @property
    def residual(self) -> Float[Array, ""]:
        """Of a gap and a pressure one is zero, none is negative."""
        weighted = GAP_WEIGHT * self.gaps
        return jnp.max(jnp.abs(jnp.where(self.pressures < weighted, self.pressures, weighted)))


class Between(NamedTuple):
    """The contacts of a model, c of all pairs: gaps, pressures, whether they count as closed at first; and where each
    stands in the row of the pressures of its pairs.
    """

    gaps: Float[Array, "c"]
    pressures: Float[Array, "c"]
    is_closed: Bool[Array, "c"]
    places: tuple[Int[Array, "c"], ...]

    @property
    def contact_compliance(self) -> Float[Array, "c"]:
        return jnp.full_like(self.gaps, CONTACT_COMPLIANCE)

    def first_needed(self, is_closed: Bool[Array, "c"], contact_compliance: Float[Array, "c"]) -> "Needed":
        """With these closed."""
        is_needed = is_closed | (self.pressures > 0)
        order = jnp.argsort(~is_needed)
        gaps, pressures, is_closed, contact_compliance = (
            row[order] for row in (self.gaps, self.pressures, is_closed, contact_compliance)
        )
        return Needed(gaps, pressures, is_closed, contact_compliance, order, jnp.sum(is_needed))


class Needed(NamedTuple):
    """The contacts of a model, first those that are closed or have curvature, `total` of them; `order`: their numbers
    in the model.
    """

    gaps: Float[Array, "c"]
    pressures: Float[Array, "c"]
    is_closed: Bool[Array, "c"]
    contact_compliance: Float[Array, "c"]
    order: Int[Array, "c"]
    total: Int[Array, ""]

    @property
    def compliances(self) -> Float[Array, "5c"]:
        """Of all columns; an open contact is a number by itself."""
        return compliances_of(jnp.where(self.is_closed, self.contact_compliance, 1.0))

    @property
    def right(self) -> Float[Array, "5c"]:
        """The right sides of their rows."""
        given = jnp.where(self.is_closed, self.contact_compliance * self.pressures - self.gaps, 0.0)
        return jnp.zeros((len(given), 5), given.dtype).at[:, 0].set(given).reshape(-1)

    def inverse(self, matrix: Float[Array, "5c 5c"]) -> tuple[Float[Array, "5c 5c"], Int[Array, ""]]:
        """Of a matrix of all columns, and by how many more of its eigenvalues than of compliances are negative. Each
        column that is not needed is a number by itself.
        """

        def with_first(count: int) -> tuple[Array, Array]:
            first = slice(5 * count)
            part = matrix[first, first]
            inverse = jnp.diag(1 / jnp.diagonal(matrix)).at[first, first].set(inverse_matrix(part))
            return inverse, negative_count(jax.lax.stop_gradient(part)[None]) - POSITIVE * count

        few = [count for count in FEW if count < len(self.gaps)]
        branches = [functools.partial(with_first, count) for count in (*few, len(self.gaps))]
        return jax.lax.switch(jnp.sum(self.total > np.array(few, int)), branches)

    def of_model(self, multipliers: Float[Array, "5c"]) -> Float[Array, "5c"]:
        """As the contacts stand in the model."""
        return multipliers.reshape(-1, 5)[jnp.argsort(self.order)].reshape(-1)


class BetweenStep(NamedTuple):
    """From the contacts of a model: the change of their pressures, and the rates of their gaps."""

    begin: Between
    change: Float[Array, "c"]
    rates: Float[Array, "c"]

    def slope(self, part: Float[Array, ""]) -> Float[Array, ""]:
        """The rate of `contact_energy`, with this part of the change."""
        pushing = self.begin.pressures + part * self.change - self.begin.gaps / MERIT_COMPLIANCE
        return -jnp.sum(jnp.where(pushing > 0, pushing, 0.0) * self.rates)

    def changed(self, like: tuple[Float[Array, "p n"], ...]) -> list[Float[Array, "p n"]]:
        """The changes of the pressures of all pairs."""
        found, first = [], 0
        for pressures, places in zip(like, self.begin.places, strict=True):
            change = self.change[first : first + len(places)]
            first += len(places)
            found.append(jnp.zeros(pressures.size, change.dtype).at[places].set(change).reshape(pressures.shape))
        return found


class Columns(NamedTuple):
    """Of a rod what its gaps and the vectors of curvature are by the rotations and positions of its nodes, and by the
    motions of its ends, in the units of its system.
    """

    rows: NodeRows
    ends: Float[Array, "12 5 c"]

    def needed(self, contacts: Needed) -> "Columns":
        """In their order, without the gaps of open ones."""
        kept = contacts.is_closed[None] | (np.arange(5) > 0)[:, None]
        by_rotation, by_position, nodes, ends = (
            part[..., contacts.order]
            for part in (self.rows.by_rotation, self.rows.by_position, self.rows.nodes, self.ends)
        )
        by_rotation, by_position = (jnp.where(kept[:, None, None], part, 0.0) for part in (by_rotation, by_position))
        return Columns(NodeRows(by_rotation, by_position, nodes), jnp.where(kept[None], ends, 0.0))

    def rates(
        self, x: Float[Array, "b m"], u: Float[Array, "n+1 3"], of_ends: Float[Array, "12"]
    ) -> Float[Array, "5c"]:
        """As the rod turns, and its nodes and ends move."""
        return self.times(x[:, None], u[None])[:, 0] + jnp.einsum("izc,i->cz", self.ends, of_ends).reshape(-1)

    def times(self, x: Float[Array, "b r m"], u: Float[Array, "r n+1 3"]) -> Float[Array, "5c r"]:
        """As the rod turns, and its nodes move, in r ways."""
        return self.rows.times(jnp.ones(self.ends.shape[1:], x.dtype), x, u)


def curves_of(forms: NodalForm, points: Any, units: Any, length: Float[Array, ""], origin: Float[Array, "3"]) -> Curve:
    """Of stacked rods, with ends that bodies may move."""

    def of_rod(form: NodalForm, point: Any, units: Any) -> Curve:
        found = curve(dataclasses.replace(form, ends_move=True), form.holding(point))
        ratio, b = units.length / length, found.axes.shape[1]
        return Curve(
            ratio * found.s,
            (units.origin - origin)[None] / length + ratio * found.positions,
            found.tangents,
            jnp.pad(found.axes, ((0, 0), (0, 3 - b), (0, 0))),
            jnp.ones_like(found.free),
            ratio * found.radius,
        )

    return of_each(of_rod)(forms, points, units)


def stacked_curves(pairs: tuple[Pairs, ...], curves: dict[int, Curve]) -> Curves:
    """Of the curves of each group."""
    stacks = {groups for each in pairs for groups in each.groups}
    return {
        groups: jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(curves[group] for group in groups))
        for groups in sorted(stacks)
    }


def joined_curves(pairs: Pairs, curves: Curves) -> Curve:
    first, second = (
        jax.tree.map(lambda leaf, places=places: leaf[places], curves[groups]) for groups, _, places in pairs.sides
    )
    return of_each(joined)(first, second)


def growth_between(pairs: Pairs, curves: Curves) -> Float[Array, "p n"]:
    """By which it is told which elements are to have wide wells."""
    elements = curves[pairs.groups[0]].radius.shape[1]
    return of_each(lambda curve: growth_of_pair(curve, elements))(joined_curves(pairs, curves))


def contacts_between(
    pairs: Pairs, curves: Curves, pressures: Float[Array, "p n"], is_wide: Bool[Array, "p n"]
) -> Contacts:
    elements = pressures.shape[1]

    def of_pair(curve: Curve, is_wide: Bool[Array, "n"]) -> tuple[Curve, Nearest, Array]:
        curve = with_pair_wells(curve, is_wide)
        found = found_between(curve, elements)
        return curve, found, gaps_between(curve, found)

    both, found, gaps = of_each(of_pair)(joined_curves(pairs, curves), is_wide)
    return Contacts(both, found, gaps, pressures, is_wide, jnp.where(gaps < -LEAST_RELAXED, -gaps / 2, 0.0))


def contact_energy(pairs: Pairs, curves: Curves, here: Contacts, change: Float[Array, "p n"]) -> Float[Array, ""]:
    """As of `NodalForm.contact_energy`, where a step leads that begins here and changes the pressures."""
    there = contacts_between(pairs, curves, here.pressures, here.is_wide)
    pushing = here.pressures + change - (there.gaps + here.relaxed) / MERIT_COMPLIANCE
    return MERIT_COMPLIANCE / 2 * jnp.sum(jnp.where(pushing > 0, pushing, 0.0) ** 2)


def are_crowded(pairs: Pairs, contacts: Contacts) -> Bool[Array, ""]:
    """Whether more elements touch than are sought in the model of a step."""
    count = jnp.sum((contacts.pressures > 0) | (contacts.gaps < 0), axis=1)
    return jnp.any(count > MOST_OF_PAIR) | (jnp.sum(count) > pairs.most)


def passes(pairs: Pairs, before: Contacts, curves: Curves) -> Bool[Array, ""]:
    """Whether a step leads no rod through another one."""
    return ~jnp.any(of_each(comes_through)(before.curves, before.found, joined_curves(pairs, curves)))


def loads_of(
    all_pairs: tuple[Pairs, ...], all_contacts: tuple[Contacts, ...], like: dict[int, ContactLoads]
) -> dict[int, ContactLoads]:
    """What contacts apply to the rods of each group."""
    stacks = {groups for pairs in all_pairs for groups in pairs.groups}
    totals = {
        groups: tuple(
            jnp.concatenate([jnp.zeros_like(leaf) for leaf in leaves])
            for leaves in zip(*((like[group].on_positions, like[group].on_tangents) for group in groups), strict=True)
        )
        for groups in sorted(stacks)
    }
    begins = {}
    for pairs, contacts in zip(all_pairs, all_contacts, strict=True):
        both = of_each(loads_between)(contacts.curves, contacts.found, contacts.pressures)
        for (groups, of_groups, places), of_rods in zip(pairs.sides, both, strict=True):
            totals[groups] = tuple(
                total.at[places].add(part) for total, part in zip(totals[groups], of_rods, strict=True)
            )
            begins |= {group: (groups, begin) for group, begin in zip(groups, of_groups, strict=True)}
    found = {}
    for group, (groups, begin) in begins.items():
        here = slice(begin, begin + len(like[group].on_positions))
        found[group] = ContactLoads(*(total[here] for total in totals[groups]))
    return found


class _Chosen(NamedTuple):
    """Of the contacts of a model between two groups: the pair to which each belongs, and its vectors and nodes."""

    pair: Int[Array, "c"]
    vectors: Float[Array, "5 6 4 c"]
    nodes: Int[Array, "4 c"]


def between(all_pairs: tuple[Pairs, ...], all_contacts: tuple[Contacts, ...]) -> tuple[Between, tuple[_Chosen, ...]]:
    """Of all pairs those contacts that are nearest to touching."""
    parts, all_chosen = [], []
    for pairs, contacts in zip(all_pairs, all_contacts, strict=True):
        found = of_each(pair_contacts)(contacts.curves, contacts.found, contacts.pressures)
        count, (_, elements) = found.chosen.shape[1], contacts.gaps.shape
        at = (jnp.arange(len(found.chosen))[:, None] * elements + found.chosen).reshape(-1)
        gaps, pressures = (contacts.gaps + contacts.relaxed).reshape(-1)[at], contacts.pressures.reshape(-1)[at]
        pick = jnp.argsort(jnp.where(pressures > 0, -1.0, gaps))[: min(len(at), pairs.most)]
        vectors = jnp.moveaxis(found.vectors, 0, 3).reshape(5, 6, 4, -1)[..., pick]
        nodes = jnp.moveaxis(found.nodes, 0, 1).reshape(4, -1)[:, pick]
        all_chosen.append(_Chosen(pick // count, vectors, nodes))
        parts.append((gaps[pick], pressures[pick], at[pick]))
    gaps, pressures = (jnp.concatenate([part[k] for part in parts]) for k in (0, 1))
    is_closed = (pressures > GAP_WEIGHT * gaps) | (gaps < LIES_ON)
    return Between(gaps, pressures, is_closed, tuple(part[2] for part in parts)), tuple(all_chosen)


def columns_of(
    group: int,
    all_pairs: tuple[Pairs, ...],
    all_chosen: tuple[_Chosen, ...],
    system: ChainSystem,
    coupling: Coupling,
    free: Float[Array, "k m"],
    scales: tuple[Float[Array, "k"], Float[Array, "k"]],
) -> Columns:
    """Of the rods of a group, stacked. `free`: 0 where clamps hold rotations, else 1; `scales`: the unit of length and
    that of energy of each rod, in those of the assembly.
    """
    lengths, shares = scales
    (k, b), nodes = system.diagonal.shape[:2], system.held.shape[1]
    count = sum(chosen.nodes.shape[1] for chosen in all_chosen)
    at, vectors, first = jnp.zeros((k, 2, count), int), jnp.zeros((k, 5, 6, 2, count), lengths.dtype), 0
    for pairs, chosen in zip(all_pairs, all_chosen, strict=True):
        numbers = first + np.arange(chosen.nodes.shape[1])
        first += len(numbers)
        for (groups, begins, places), of_side in zip(pairs.sides, (slice(0, 2), slice(2, 4)), strict=True):
            if group not in groups:
                continue
            # Rods of other groups are dropped: they have no place here.
            rods = jnp.asarray(places - begins[groups.index(group)])[chosen.pair]
            rods = jnp.where((rods >= 0) & (rods < k), rods, k)
            at = at.at[rods, :, numbers].set(chosen.nodes[of_side].T)
            vectors = vectors.at[rods, ..., numbers].set(jnp.moveaxis(chosen.vectors[:, :, of_side], -1, 0))
    vectors /= shares[:, None, None, None, None]
    by_rotation, by_position = vectors[:, :, :b], lengths[:, None, None, None, None] * vectors[:, :, 3:]
    is_end = (at[:, None] == np.array([0, nodes - 1])[None, :, None, None]).astype(vectors.dtype)
    at_ends = jnp.einsum("kziqc,keqc->kezic", jnp.concatenate([by_rotation, by_position], axis=2), is_end)
    assert coupling.of_nodes is not None
    ends = jnp.einsum("kezic,keij->kejzc", at_ends, coupling.of_nodes).reshape(k, 12, 5, count)
    turns, moves = (
        jnp.take_along_axis(part, at.reshape(k, -1), axis=1).reshape(at.shape)[:, None, None]
        for part in (free[:, ::2], jnp.where(system.held, 0.0, 1.0).astype(vectors.dtype))
    )
    return Columns(NodeRows(by_rotation * turns, by_position * moves, at), ends)
