"""What contacts between the rods of a harness are in a result, and how they change with it.

In SI units, from the results of the rods. Derivatives are by the implicit function theorem: of each contact that pushes
five numbers are unknown, the force on the first rod and the places of both rods, as parts of their lengths. For these
the gap stays closed, the force has no component across the line between both places, and the places stay nearest.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.curve_distance import Curve, direction, seen_distance, side_at, sides_at, with_wells
from rodjax.discretization.nearest_places import Nearest
from rodjax.discretization.rod_pairs import NARROW_OF_PAIRS, found_between, joined, with_pair_wells
from rodjax.discretization.self_contact import exerted_at, moving_gaps
from rodjax.model.along import value_at
from rodjax.model.harness import Harness
from rodjax.model.loads import ContactLoads
from rodjax.model.scene import Scene, under_contact
from rodjax.programs.compilation import compiled
from rodjax.programs.stacks import of_each
from rodjax.solving.result import Equilibrium
from rodjax.solving.rod_contact import (
    Curves,
    Members,
    Pairs,
    in_contact,
    joined_curves,
    pairs_of,
    split_by_pairs,
    stacked_curves,
)

# Of the contacts between rods of two groups, at most so many that push have derivatives; of more they are NaN. Of those
# of several groups on the same meshes as many times that.
MOST_TOUCHING = 32


class RodContacts(eqx.Module):
    """Where each of n elements of a rod of a harness is nearest to another rod, and what this one applies to it there.

    - `s`, `other_s` [..., n] arclengths of both places, m
    - `gaps` [..., n] m between the surfaces there
    - `forces` [..., n, 3] N: on the first rod at `s`, and their reverse on the other one at `other_s`; zero where they
      do not touch
    """

    s: Float[Array, "... n"]
    other_s: Float[Array, "... n"]
    gaps: Float[Array, "... n"]
    forces: Float[Array, "... n 3"]


def curves_of_results(groups: tuple[Equilibrium, ...], pairs: tuple[Pairs, ...], length: Any) -> Curves:
    """Of rods that may touch, in units of a length."""

    def of_rod(rod: Equilibrium) -> Curve:
        begin, end = rod.s[:-1], rod.s[1:]
        radius = rod.scene.rod.radius
        assert radius is not None
        middles = value_at(radius, (begin + end) / 2, begin, end)
        nowhere = jnp.zeros((3, 1, len(rod.s)), rod.s.dtype)
        return Curve(
            rod.s / length, rod.nodes / length, rod.tangents.T, nowhere, jnp.ones_like(rod.s), middles / length
        )

    return stacked_curves(pairs, {number: of_each(of_rod)(groups[number]) for number in in_contact(pairs)})


def mean_length(groups: tuple[Equilibrium, ...]) -> Float[Array, ""]:
    return jnp.mean(jnp.concatenate([group.s[:, -1] for group in groups]))


@functools.partial(compiled, static_argnames=("members",))
def rod_contacts(
    harness: Harness,
    groups: tuple[Equilibrium, ...],
    rod_pressures: Float[Array, "... c"],
    wide_wells: Bool[Array, "... c"],
    members: Members,
) -> dict[tuple[str, str], RodContacts]:
    """By the names of both rods, those of pairs in the order of the harness."""
    pairs = pairs_of(harness.contact, members, _counts(groups))
    mapped = functools.partial(_rod_contacts, names=harness.names, pairs=pairs, members=members)
    for _ in range(rod_pressures.ndim - 1):
        mapped = jax.vmap(mapped)
    found = mapped(groups, rod_pressures, wide_wells)
    return {pair: found[pair] for pair in harness.contact_names}


def _rod_contacts(
    groups: tuple[Equilibrium, ...],
    rod_pressures: Float[Array, "c"],
    wide_wells: Bool[Array, "c"],
    names: tuple[str, ...],
    pairs: tuple[Pairs, ...],
    members: Members,
) -> dict[tuple[str, str], RodContacts]:
    length = mean_length(groups)
    curves, found = curves_of_results(groups, pairs, length), {}
    split = (split_by_pairs(pairs, _counts(groups), each) for each in (rod_pressures, wide_wells))
    for each, pressures, is_wide in zip(pairs, *split, strict=True):
        elements = pressures.shape[1]

        def of_pair(curve: Curve, pressures: Array, is_wide: Array, elements: int = elements) -> RodContacts:
            curve = with_pair_wells(curve, is_wide)
            places = exerted_at(curve, jnp.pad(pressures, (0, 1)), found_between(curve, elements))
            offset = curve.s[elements + 1]
            return RodContacts(
                places.s * length, (places.beyond - offset) * length, places.gaps * length, places.forces.T
            )

        stacked = of_each(of_pair)(joined_curves(each, curves), pressures, is_wide)
        named = [[names[number] for group in groups for number in members[group]] for groups in each.groups]
        for k, (first, second) in enumerate(each.places):
            found[named[0][first], named[1][second]] = jax.tree.map(lambda leaf, k=k: leaf[k], stacked)
    return found


def _counts(groups: tuple[Equilibrium, ...]) -> list[int]:
    """Of the elements of rods of each group, stacked once and more."""
    return [group.s.shape[-1] - 1 for group in groups]


class _Touch(NamedTuple):
    """Of t contacts between rods of one kind of pairs: the place of both rods in these, their elements there, and the
    element of the first one whose contact it is, and whether that has a wide well; whether the place within the element
    stays; two directions across the force; whether it is there; and its number among all pressures.
    """

    rods: Int[Array, "2 t"]
    elements: Int[Array, "2 t"]
    cell: Int[Array, "t"]
    is_wide: Bool[Array, "t"]
    stays: Bool[Array, "2 t"]
    across: Float[Array, "2 3 t"]
    along: Float[Array, "3 t"]
    exists: Bool[Array, "t"]
    number: Int[Array, "t"]


class TouchingRods(eqx.Module):
    """Contacts that push. `values`: what is unknown of them; `meshes`: of each group the nodes, as parts of the
    lengths; `force`: a unit [N].
    """

    pairs: tuple[Pairs, ...] = eqx.field(static=True)
    touches: tuple[_Touch, ...]
    values: Float[Array, "5t"]
    meshes: tuple[Float[Array, "k n+1"], ...]
    length: Float[Array, ""]
    force: Float[Array, ""]

    def _split(self, values: Float[Array, "5t"]) -> list[tuple[Array, Array]]:
        """Forces (3, t) [N] and places (2, t), as parts of the lengths, of the contacts between each two groups."""
        found, first = [], 0
        for touch in self.touches:
            count = len(touch.exists)
            each = values[first : first + 5 * count].reshape(5, count)
            first += 5 * count
            found.append((self.force * each[:3], each[3:]))
        return found

    def loaded(self, scenes: Scene, group: int, values: Float[Array, "5t"]) -> Scene:
        """The scenes of a group with what contacts apply to them."""
        if group not in in_contact(self.pairs):
            return scenes
        mesh, lengths = self.meshes[group], scenes.rod.length
        on_positions = on_tangents = jnp.zeros((len(lengths), 3, 2, mesh.shape[1] - 1), mesh.dtype)
        for pairs, touch, (forces, places) in zip(self.pairs, self.touches, self._split(values), strict=True):
            for side, ((groups, begins, _), sign) in enumerate(zip(pairs.sides, (1.0, -1.0), strict=True)):
                if group not in groups:
                    continue
                rods, elements = touch.rods[side] - begins[groups.index(group)], touch.elements[side]
                is_here = touch.exists & (rods >= 0) & (rods < len(lengths))
                rods = jnp.clip(rods, 0, len(lengths) - 1)
                # Of a curve of no place, as the weights are.
                nowhere = jnp.zeros((len(rods), mesh.shape[1], 3), mesh.dtype)
                along = lengths[rods][:, None] * mesh[rods]
                weights = of_each(_at)(along, nowhere, nowhere, elements, lengths[rods] * places[side])
                pushes = sign * jnp.where(is_here[None], forces, 0.0).T[..., None]
                at = rods, slice(None), slice(None), elements
                on_positions = on_positions.at[at].add(pushes * weights.of_positions[:, 0, :, 0][:, None])
                on_tangents = on_tangents.at[at].add(pushes * weights.of_tangents[:, 0, :, 0][:, None])
        return under_contact(scenes, ContactLoads(on_positions, on_tangents))

    def lacking(self, rods: list[Equilibrium], values: Float[Array, "5t"]) -> Float[Array, "5t"]:
        """What is to vanish; of contacts that are not there, how far they are from what they were."""
        curves = curves_of_results(tuple(rods), self.pairs, self.length)
        found = []
        parts = zip(self.pairs, self.touches, self._split(values), self._split(self.values), strict=True)
        for pairs, touch, (forces, places), (before, begin) in parts:
            joined_pairs = [curves[groups] for groups in pairs.groups]

            def of_contact(
                rods, elements, cell, is_wide, stays, across, force, place, begin, joined_pairs=joined_pairs
            ):
                first, second = (
                    jax.tree.map(lambda leaf, k=k: leaf[k], curve) for curve, k in zip(joined_pairs, rods, strict=True)
                )
                curve, count = with_wells(joined(first, second), is_wide, NARROW_OF_PAIRS), len(first.s)
                here, there = elements[:1], count + elements[1:]
                a, b = (first.s[-1] * place[:1]), curve.s[count] + second.s[-1] * place[1:]
                distance, slopes, _ = seen_distance(curve, cell[None], here, there, a, b)
                _, normal = direction(sides_at(curve, here, there, a, b))
                force, normal = force / self.force, normal[:, 0]
                gap = distance - curve.radius[cell[None]] - curve.radius[there]
                slopes = jnp.where(stays, place - begin, jnp.concatenate(slopes))
                return jnp.concatenate([gap, across @ (force - (force @ normal) * normal), slopes])

            lacking = jax.vmap(of_contact, (1, 1, 0, 0, 1, 2, 1, 1, 1), 1)(
                touch.rods, touch.elements, touch.cell, touch.is_wide, touch.stays, touch.across, forces, places, begin
            )
            change = jnp.concatenate([(forces - before) / self.force, places - begin])
            found.append(jnp.where(touch.exists[None], lacking, change).reshape(-1))
        return jnp.concatenate(found)

    def pressures(self, begin: Float[Array, "c"], values: Float[Array, "5t"]) -> Float[Array, "c"]:
        """Of all contacts."""
        for touch, (forces, _) in zip(self.touches, self._split(values), strict=True):
            along = jnp.sum(touch.along * forces, axis=0)
            begin = begin.at[touch.number].set(jnp.where(touch.exists, along, begin[touch.number]))
        return begin


def _at(s: Array, nodes: Array, tangents: Array, element: Array, place: Array):
    """One place of a curve."""
    nothing = jnp.zeros((3, 1, len(s)), s.dtype)
    curve = Curve(s, nodes, tangents.T, nothing, jnp.ones_like(s), jnp.ones_like(s[1:]))
    return side_at(curve, element[None], place[None])


def touching_rods(
    harness: Harness,
    groups: tuple[Equilibrium, ...],
    rod_pressures: Float[Array, "c"],
    wide_wells: Bool[Array, "c"],
    members: Members,
) -> TouchingRods | None:
    """At a result; `None` of a harness whose rods do not touch. `values` are NaN where too many push."""
    pairs = pairs_of(harness.contact, members, _counts(groups))
    if not pairs:
        return None
    length = mean_length(groups)
    curves = curves_of_results(groups, pairs, length)
    force = jnp.maximum(jnp.max(rod_pressures), jnp.finfo(length.dtype).tiny)
    touches, values, first = [], [], 0
    split = (split_by_pairs(pairs, _counts(groups), each) for each in (rod_pressures, wide_wells))
    for each, pressures, is_wide in zip(pairs, *split, strict=True):
        elements, both = pressures.shape[1], joined_curves(each, curves)

        def of_pair(curve: Curve, is_wide: Array, elements: int = elements) -> tuple[Nearest, Array, Array, Array]:
            curve = with_pair_wells(curve, is_wide)
            found = found_between(curve, elements)
            _, a, b = moving_gaps(curve, found)
            _, normal = direction(sides_at(curve, found.element, found.other, a, b))
            ends = curve.s[elements], curve.s[-1] - curve.s[elements + 1]
            return found, a / ends[0], (b - curve.s[elements + 1]) / ends[1], normal

        found, a, b, normal = of_each(of_pair)(both, is_wide)
        most = each.kinds * MOST_TOUCHING
        pick = jnp.argsort(-pressures.reshape(-1))[:most]
        force = jnp.where(jnp.sum(pressures > 0) > most, jnp.nan, force)
        pair, cell = pick // elements, pick % elements
        rods = jnp.stack([jnp.asarray(each.first)[pair], jnp.asarray(each.second)[pair]])
        normal = normal[pair, :, cell].T
        side = jnp.cross(normal, jnp.eye(3, dtype=normal.dtype)[jnp.argmin(jnp.abs(normal), axis=0)].T, axis=0)
        side /= jnp.linalg.norm(side, axis=0)[None]
        across = jnp.stack([side, jnp.cross(normal, side, axis=0)])
        both_elements = jnp.stack([found.element[pair, cell], found.other[pair, cell] - elements - 1])
        stays, pushing = found.stays[pair, :, cell].T, pressures[pair, cell]
        of_cell = cell, is_wide[pair, cell], stays
        touches.append(_Touch(rods, both_elements, *of_cell, across, normal, pushing > 0, first + pick))
        each_place = jnp.stack([a[pair, cell], b[pair, cell]])
        values.append(jnp.concatenate([pushing[None] * normal / force, each_place]).reshape(-1))
        first += pressures.size
    meshes = tuple(group.s / group.s[:, -1:] for group in groups)
    return TouchingRods(pairs, tuple(touches), jnp.concatenate(values), meshes, length, force)
