"""Rods that meet in rigid bodies as one system, and the state of a search for its equilibrium.

Each rod is an ordinary form between clamps, whose poses are those of its bodies. Rods of one structure and mesh are
stacked: one after another along an axis of every array. Motions (u, r) of a body: displacement in parts of a mean
length, and rotation vector about global axes.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import Form
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.shape import Shape
from rodjax.model.harness import Bodies, rotated
from rodjax.model.loads import ContactLoads
from rodjax.model.scene import under_contact
from rodjax.programs.stacks import of_each
from rodjax.solving.coupling import RodInBodies
from rodjax.solving.loading import bearing
from rodjax.solving.rod_contact import (
    Contacts,
    Curves,
    Pairs,
    contacts_between,
    curves_of,
    growth_between,
    in_contact,
    loads_of,
    stacked_curves,
)
from rodjax.solving.status import Status
from rodjax.units import Units


class Poses(NamedTuple):
    """Of the bodies: positions [m] and frames."""

    positions: Float[Array, "j 3"]
    frames: Float[Array, "j 3 3"]

    def retract(self, motions: Float[Array, "j 6"], length: Float[Array, ""]) -> "Poses":
        frames = rotated(self.frames, motions[:, 3:])
        # One step towards orthonormal columns: rounding would grow with every step.
        frames = frames @ (1.5 * jnp.eye(3, dtype=frames.dtype)[None] - 0.5 * jnp.swapaxes(frames, 1, 2) @ frames)
        return Poses(self.positions + length * motions[:, :3], frames)


class Rods(eqx.Module):
    """Rods of one structure and mesh, stacked along a first axis of every array.

    `form`: of the nondimensional scene, with clamps where an end belongs to a body; `body`: the number of that, the
    number of all bodies where an end belongs to none; `frame`, `offset`: of the ends in their bodies.
    """

    form: Form
    shape: Shape
    units: Units
    body: Int[Array, "k 2"]
    frame: Float[Array, "k 2 3 3"]
    offset: Float[Array, "k 2 3"]

    def under(self, poses: Poses) -> tuple[Float[Array, "k 2 3"], Float[Array, "k 2 3 3"]]:
        """The poses of the bodies at both ends."""
        positions = jnp.pad(poses.positions, ((0, 1), (0, 0)))
        frames = jnp.pad(poses.frames, ((0, 1), (0, 0), (0, 0)))
        return positions[self.body], frames[self.body]

    def touched(self, loads: ContactLoads) -> "Rods":
        """The same under forces of other rods."""
        scene = under_contact(self.form.scene, loads)
        return dataclasses.replace(self, form=eqx.tree_at(lambda form: form.scene, self.form, scene))


class State(NamedTuple):
    """What a turn leaves to the next one; of each group of rods points, pressures of the bodies where these end (`None`
    of rods that touch nothing), and shifts of their systems; of the contacts of each kind of `Pairs` pressures, and
    which elements have wide wells, and whether these are those of an equilibrium.
    """

    points: tuple[Any, ...]
    at_ends: tuple[Float[Array, "k o 2"] | None, ...]
    pairs: tuple[Float[Array, "p n"], ...]
    is_wide: tuple[Bool[Array, "p n"], ...]
    has_ended: Bool[Array, ""]
    poses: Poses
    shifts: tuple[Float[Array, "k"], ...]
    damping: Float[Array, ""]
    residual: Float[Array, ""]
    residuals: tuple[Float[Array, "k"], ...]
    pushes: Int[Array, ""]
    iterations: Int[Array, ""]
    evaluations: Int[Array, ""]
    status: Int[Array, ""]
    negative: Int[Array, ""]


class Assembly(eqx.Module):
    """All rods and bodies of a harness, with the units of its system: `energy` that of the stiffest rod, `length` the
    mean of all. `pairs`: of rods that may touch.
    """

    groups: tuple[Rods, ...]
    bodies: Bodies
    energy: Float[Array, ""]
    length: Float[Array, ""]
    pairs: tuple[Pairs, ...] = eqx.field(static=True)

    @staticmethod
    def of(groups: tuple[Rods, ...], bodies: Bodies, pairs: tuple[Pairs, ...] = ()) -> "Assembly":
        energies = jnp.concatenate([rods.units.energy for rods in groups])
        lengths = jnp.concatenate([rods.units.length for rods in groups])
        return Assembly(groups, bodies, jnp.max(energies), jnp.mean(lengths), pairs)

    @property
    def has_potential(self) -> bool:
        """Whether the loads on all rods have one."""
        return all(group.form.has_potential for group in self.groups)

    def bearing(self, part: Float[Array, ""] | None) -> "Assembly":
        """With a part of the loads without a potential on rods, or without them."""

        def borne(form: Form) -> Form:
            return eqx.tree_at(lambda form: form.scene, form, bearing(form.scene, part))

        groups = (
            group if group.form.has_potential else dataclasses.replace(group, form=of_each(borne)(group.form))
            for group in self.groups
        )
        return dataclasses.replace(self, groups=tuple(groups))

    @property
    def force(self) -> Float[Array, ""]:
        """The unit of pressures between rods."""
        return self.energy / self.length

    def curves(self, forms: tuple[Form, ...], points: tuple[Any, ...]) -> Curves:
        """Of rods that may touch another one; forms with their ends where the bodies are."""
        origin, found = self.groups[0].units.origin[0], {}
        for number in in_contact(self.pairs):
            units, form = self.groups[number].units, forms[number]
            assert isinstance(form, NodalForm)
            found[number] = curves_of(form, points[number], units, self.length, origin)
        return stacked_curves(self.pairs, found)

    def forms(self, poses: Poses, motions: tuple[Float[Array, "k 2 6"], ...] | None = None) -> tuple[Form, ...]:
        """Of the groups, with their ends where the bodies are after these motions of their ends."""
        found = []
        for number, group in enumerate(self.groups):
            rods = self.rods(group, poses)
            if motions is None:
                found.append(of_each(lambda rod: rod.form_at())(rods))
            else:
                found.append(of_each(lambda rod, moved: rod.form_at(moved))(rods, motions[number]))
        return tuple(found)

    def contacts(self, state: "State") -> tuple[Contacts, ...]:
        """Between rods."""
        if not self.pairs:
            return ()
        curves = self.curves(self.forms(state.poses), state.points)
        each = zip(self.pairs, state.pairs, state.is_wide, strict=True)
        return tuple(contacts_between(pairs, curves, *of_pairs) for pairs, *of_pairs in each)

    def growth(self, points: tuple[Any, ...], poses: Poses) -> tuple[Float[Array, "p n"], ...]:
        """By which it is told which elements have wide wells in contacts between rods."""
        curves = self.curves(self.forms(poses), points)
        return tuple(growth_between(pairs, curves) for pairs in self.pairs)

    def touched(self, contacts: tuple[Contacts, ...]) -> "Assembly":
        """With the loads of contacts between rods."""
        groups = list(self.groups)
        for number, loads in self.contact_loads(contacts).items():
            per_force = self.force / groups[number].units.force
            per_length = self.length / groups[number].units.length
            groups[number] = groups[number].touched(
                ContactLoads(
                    loads.on_positions * per_force[:, None, None, None],
                    loads.on_tangents * (per_force * per_length)[:, None, None, None],
                )
            )
        return dataclasses.replace(self, groups=tuple(groups))

    def contact_loads(self, contacts: tuple[Contacts, ...]) -> dict[int, ContactLoads]:
        """Of the groups of which a rod may touch another one, in the units of the assembly."""
        like = {}
        for number in in_contact(self.pairs):
            loads = self.groups[number].form.scene.contact_loads
            assert loads is not None
            like[number] = loads
        return loads_of(self.pairs, contacts, like)

    @property
    def count(self) -> int:
        return len(self.bodies.position)

    def rods(self, group: Rods, at: Poses) -> RodInBodies:
        """Stacked."""
        positions, frames = group.under(at)
        length = jnp.broadcast_to(self.length, group.units.length.shape)
        is_joint, touches = group.body < self.count, jnp.array([*self.bodies.floats, False])[group.body]
        poses = group.frame, group.offset, positions, frames
        return RodInBodies(group.form, group.units, is_joint, *poses, length, touches)

    def shares(self, group: Rods) -> Float[Array, "k"]:
        """The unit of energy of each rod, in that of the assembly."""
        return group.units.energy / self.energy

    def body_energies(self, poses: Poses, motions: Float[Array, "j 6"]) -> Float[Array, "j"]:
        there = poses.retract(motions, self.length)
        return self.bodies.energies(there.positions, there.frames, motions[:, 3:]) / self.energy

    def body_derivatives(self, poses: Poses) -> tuple[Float[Array, "j 6"], Float[Array, "j 6 6"]]:
        """First and second ones of the energies by the motions of each body."""
        nowhere = jnp.zeros((self.count, 6), poses.positions.dtype)

        def first(motions: Array) -> Array:
            return jax.grad(lambda motions: jnp.sum(self.body_energies(poses, motions)))(motions)

        # The energy of a body knows of no other: one direction of all bodies at once.
        def column(direction: Float[Array, "6"]) -> Float[Array, "j 6"]:
            return jax.jvp(first, (nowhere,), (jnp.broadcast_to(direction[None], nowhere.shape),))[1]

        second = jax.vmap(column, out_axes=-1)(jnp.eye(6, dtype=nowhere.dtype))
        return first(nowhere), second

    def balance_of_bodies(
        self, gradient: Float[Array, "j 6"], forces: tuple[Float[Array, "k 12"], ...]
    ) -> tuple[Float[Array, "j 6"], Float[Array, ""]]:
        """The gradient of the bodies, that of springs and loads given, with what the rods of each group give their
        ends; its largest component along the motions that supports leave, of a body in the unit of its stiffest rod.
        """
        gradient, scale = jnp.pad(gradient, ((0, 1), (0, 0))), jnp.zeros(self.count + 1, gradient.dtype)
        for group, of_group in zip(self.groups, forces, strict=True):
            shares = self.shares(group)
            of_ends = shares[:, None, None] * of_group.reshape(-1, 2, 6)
            for end in range(2):
                gradient = gradient.at[group.body[:, end]].add(of_ends[:, end])
                scale = scale.at[group.body[:, end]].max(shares)
        motions, gradient, scale = self.bodies.motions, gradient[: self.count], scale[: self.count]
        out_of_balance = (motions.T @ gradient.reshape(-1)) / (jnp.repeat(scale, 6) @ jnp.abs(motions))
        return gradient, jnp.max(jnp.abs(out_of_balance), initial=0.0)

    def begin(
        self,
        points: tuple[Any, ...],
        at_ends: tuple[Array | None, ...],
        pairs: tuple[Array, ...],
        is_wide: tuple[Array, ...],
        poses: Poses,
    ) -> State:
        """A search from points of the rods, pressures of the bodies where these end, pressures and wells of contacts
        between rods, and poses of the bodies.
        """
        dtype = poses.positions.dtype
        zero, count = jnp.zeros((), dtype), jnp.zeros((), int)
        nothing = tuple(jnp.zeros(len(group.body), dtype) for group in self.groups)
        status = jnp.full((), Status.RUNNING, int)
        # All are wide where no equilibrium tells which are.
        has_ended = ~functools.reduce(jnp.logical_and, map(jnp.all, is_wide), jnp.array(True))
        of_contacts, counts = (pairs, is_wide, has_ended), (count, count, count, status, count)
        return State(points, at_ends, *of_contacts, poses, nothing, zero, zero, nothing, *counts)
