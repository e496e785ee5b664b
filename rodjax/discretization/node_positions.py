"""Rods whose nodes have positions of their own, and a force in each element: supports, loads and fields at the nodes.

The force F through an element is the multiplier of its vector from node to node, and the positions x of the nodes are
unknowns of their own,

    L = L of the elements + sum F . (x_after - x_before - segment vector of the element),

so what acts on an element depends on what is local, the system is a chain, and a step of Newton's method moves nodes
along straight lines. `nodal.NodalForm` adds contacts.
"""

import dataclasses
import functools
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization import potentials
from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.form import Form, Linearization
from rodjax.discretization.layout import CellForces, SpanForces
from rodjax.discretization.nodal_point import Nodal
from rodjax.discretization.potentials import NodeEnergy
from rodjax.geometry.interpolation import cubic
from rodjax.mechanics.passage import SAMPLES
from rodjax.model.along import Value, largest_beside, value_at
from rodjax.model.scene import has_free_ends, held_position
from rodjax.model.supports import Clamp, Held

# Where it is looked whether a rod has come through: beside nodes and middles of most meshes, by this part of a step.
BESIDE = 0.3


class PositionForm(Form):
    """A nondimensional scene; the `end_force` of its points is (3, n): that through each element, and their `nodal` is
    there. `ends_move`: of a linearisation in which clamped ends have no given position (`released`). `pushed`: which
    ends are in bodies that obstacles push out, `None` where none is. `closed`: the contacts that count as closed, of
    all rows of pressures; `None` for those that press.
    """

    ends_move: bool = eqx.field(kw_only=True, static=True, default=False)
    pushed: Bool[Array, "2"] | None = eqx.field(kw_only=True, default=None)
    closed: Bool[Array, "k n+1"] | None = eqx.field(kw_only=True, default=None)

    @property
    def normal(self) -> Float[Array, "3"] | None:
        """Of the plane of a rod that stays in one."""
        assert isinstance(self.layout, CellForces)
        return self.layout.normal

    def released(self, point: Any) -> Linearization:
        """The ends that clamps hold may turn and move; `residual` without these."""
        return dataclasses.replace(self, ends_move=True).linearized(point)

    @abstractmethod
    def node_slopes(self, point: Any) -> Float[Array, "n+1 3"]:
        """The derivative of the centerline by arclength at the nodes."""

    @abstractmethod
    def node_axes(self, point: Any) -> Float[Array, "3 b n+1"]:
        """The axes about which the unknown rotations turn the tangents of the nodes."""

    @abstractmethod
    def in_elements(self, point: Any, elements: Any, change: Float[Array, "3 n"]) -> tuple[Array, Array]:
        """The terms of L from stretch and forces under changed forces, and the segment vectors; `elements`: the first
        result of `turning_elements`.
        """

    @abstractmethod
    def in_cells_at(self, point: Any) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        """All terms of L from the cells, and their segment vectors."""

    @abstractmethod
    def turning_elements(self, point: Any, rotation: Float[Array, "b m"], bases: Float[Array, "3 b m"]) -> Any:
        """The arguments of `in_elements`, and their rates along rotations."""

    # --- what is unknown ---------------------------------------------------------------------------------------------

    def multipliers_turned(
        self, point: Any, axis: Float[Array, "3"], multipliers: Float[Array, "k"]
    ) -> Float[Array, "k"]:
        arms = jnp.where(self.is_held[:, None], 0.0, point.nodal.positions - held_position(self.scene)[None])
        by_node = jnp.cross(axis[None], arms).reshape(-1)
        of_force = self.force_turned(point, axis)
        return multipliers.at[-len(by_node) - len(of_force) :].set(jnp.concatenate([by_node, of_force]))

    def clip_forces(self, point: Any) -> Float[Array, "3 clips"]:
        assert self.clip_nodes is not None
        return self.applied(point)[:, self.clip_nodes]

    def is_closed(self, constraint_residual: Float[Array, "k"], tolerance: float) -> Bool[Array, ""]:
        return super().is_closed(self.force_components(constraint_residual), tolerance)

    def nodal_held(self, nodal: Nodal | None) -> Nodal | None:
        if nodal is None:
            return None
        positions, held = self.held_positions
        return dataclasses.replace(nodal, positions=nodal.positions.at[held].set(positions.T))

    def forces_in_elements(self, point: Any) -> Float[Array, "3 n"]:
        """The forces through the elements from those in the spans, which files until format 10 have."""
        members = SpanForces.of(self.scene, self.clip_nodes, len(self.field.s) - 1)
        forces = jnp.broadcast_to(members.gather(point.end_force), (3, len(self.field.s) - 1))
        loads = self.loads_on_nodes(point)
        if loads is None:
            return forces
        if self._on_first_node is not None:
            loads -= self._on_first_node.T
        if isinstance(self.scene.start, Held):
            return forces + jnp.cumsum(loads[:, :0:-1], axis=1)[:, ::-1]
        return forces - jnp.cumsum(loads[:, :-1], axis=1)

    # --- supports, and the radius ------------------------------------------------------------------------------------

    @property
    def is_held(self) -> Bool[Array, "n+1"]:
        """Whether the position of a node is given."""
        return self.is_at_support & ~self._is_at_joint if self.ends_move else self.is_at_support

    @property
    def is_at_support(self) -> Bool[Array, "n+1"]:
        _, nodes = self.held_positions
        return jnp.zeros(len(self.field.s), bool).at[nodes].set(True)

    @property
    def _is_at_joint(self) -> Bool[np.ndarray, "n+1"]:
        """At ends that clamps hold, whose poses bodies of a harness may have."""
        is_at_joint = np.zeros(len(self.field.s), bool)
        is_at_joint[[0, -1]] = [isinstance(end, Clamp) for end in (self.scene.start, self.scene.end)]
        return is_at_joint

    @property
    def radius(self) -> Float[Array, "n+1"]:
        """The radius at the nodes; where it jumps, the larger of both sides."""
        return largest_beside(self.radius_along, self.field.s)

    def radius_in_elements(self, parts: Float[Array, "k"]) -> Float[Array, "n k"]:
        """The radius in each element at relative positions 0 to 1."""
        s = self.field.s
        begin, end = (jnp.broadcast_to(side[:, None], (len(s) - 1, len(parts))) for side in (s[:-1], s[1:]))
        return value_at(self.radius_along, begin + parts[None] * (end - begin), begin, end)

    @property
    def radius_along(self) -> Value:
        radius = self.scene.rod.radius
        assert radius is not None, "a scene with obstacles has a radius"
        return radius

    def samples(self, nodes: Float[Array, "n+1 3"], point: Any) -> tuple[Array, Array, Array]:
        """At `passage.SAMPLES` arclengths: the centerline, the radius, and the position of a held node at an end of the
        element, NaN without one.
        """
        s = self.field.s
        x = jnp.linspace(0.0, 1.0, SAMPLES, dtype=s.dtype)
        x = x.at[1:-1].add(BESIDE * x[1])
        points = cubic(s, nodes, self.node_slopes(point), x)
        cell = jnp.clip(jnp.searchsorted(s, x, side="right") - 1, 0, len(s) - 2)
        radius = value_at(self.radius_along, x, s[cell], s[cell + 1])
        beside = jnp.where(self.is_held[cell + 1][:, None], nodes[cell + 1], jnp.nan)
        return points, radius, jnp.where(self.is_held[cell][:, None], nodes[cell], beside)

    # --- loads and fields --------------------------------------------------------------------------------------------

    def loads_on_nodes(self, point: Any) -> Float[Array, "3 n+1"] | None:
        """The forces of fields, and of other rods, on the nodes, and what `_on_first_node` has; `None` without such."""
        loads = self.of_energies_at_nodes(point)
        if self.scene.contact_loads is None:
            return loads
        of_rods = potentials.at_both(self.scene.contact_loads.on_positions)
        return of_rods if loads is None else loads + of_rods

    def of_energies_at_nodes(self, point: Any) -> Float[Array, "3 n+1"] | None:
        """The forces on the nodes that have an energy there; `None` without such."""
        loads = None if self._on_first_node is None else self._on_first_node.T
        if not self.scene.potentials:
            return loads
        of_fields = -potentials.by_position(self.scene, self.field.s, *self.node_lines(point)).T
        return of_fields if loads is None else of_fields + loads

    @property
    def _on_first_node(self) -> Float[Array, "n+1 3"] | None:
        """Of a rod whose ends are both free, all dead loads, on its first node or in its first clip: in the forces
        through elements they count from there (`dead_loads.counted_from`). `None` where an end is held.
        """
        if not has_free_ends(self.scene):
            return None
        first = 0 if self.clip_nodes is None else self.clip_nodes[0]
        return jnp.zeros((len(self.field.s), 3), self.field.s.dtype).at[first].set(total_force(self.scene))

    def node_lines(self, point: Any) -> tuple[Float[Array, "n+1 3"], Float[Array, "3 n+1"]]:
        """The positions and tangents of the nodes."""
        return point.nodal.positions, point.tangents[:, ::2]

    def at_nodes(self, point: Any) -> NodeEnergy | None:
        """Energies of fields at the nodes and their derivatives by the unknowns, with those of the work of other rods,
        whose energy is not counted, and that of `_on_first_node`; `None` without such.
        """
        parts, axes, tangents = [], self.node_axes(point), point.tangents[:, ::2]
        if self.scene.potentials:
            parts.append(potentials.at_nodes(self.scene, self.field.s, *self.node_lines(point), axes))
        if self.scene.contact_loads is not None:
            pulls = potentials.at_both(self.scene.contact_loads.on_tangents)
            parts.append(potentials.of_pulls(pulls, tangents, axes))
        if self._on_first_node is not None:
            without = potentials.of_pulls(jnp.zeros_like(tangents), tangents, axes)
            parts.append(without._replace(energy=self._energy_of_first(point, self._on_first_node)))
        if not parts:
            return None
        return functools.reduce(lambda one, other: NodeEnergy(*map(jnp.add, one, other)), parts)

    def _energy_of_first(self, point: Any, force: Float[Array, "n+1 3"]) -> Float[Array, "n+1"]:
        return -jnp.sum(force * point.nodal.positions, axis=1)

    def _energy_at_nodes(self, point: Any) -> Float[Array, ""]:
        """Of fields, and of `_on_first_node`."""
        energy = jnp.zeros((), point.tangents.dtype)
        if self.scene.potentials:
            energy += jnp.sum(potentials.node_energies(self.scene, self.field.s, *self.node_lines(point)))
        force = self._on_first_node
        return energy if force is None else energy + jnp.sum(self._energy_of_first(point, force))

    def load_energy(self, point: Any) -> Float[Array, ""]:
        return super().load_energy(point) + self._energy_at_nodes(point)  # pyright: ignore

    def applied(self, point: Any) -> Float[Array, "3 n+1"]:
        """The forces that clips, contacts and supports apply at the nodes."""
        around = jnp.pad(point.end_force, ((0, 0), (1, 1)))
        applied, loads = around[:, :-1] - around[:, 1:], self.loads_on_nodes(point)
        return applied if loads is None else applied - loads

    def lagrangian(self, point: Any) -> tuple[Float[Array, ""], Float[Array, "c"]]:
        """L without contacts, and the residual of the closure of each element."""
        energy, segment_vectors = self.in_cells_at(point)
        energy += jnp.sum(point.end_force.T * jnp.diff(point.nodal.positions, axis=0))
        energy += self._energy_at_nodes(point)
        return energy, self.gap_of_elements(point, segment_vectors).reshape(-1)

    def gap_of_elements(self, point: Any, segment_vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """The vectors between nodes minus the segment vectors of the elements."""
        return jnp.diff(point.nodal.positions, axis=0) - segment_vectors
