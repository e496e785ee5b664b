"""Forms in whose cells forces of their own run through the rod, with what belongs to stretch summed over the cells.

A cell lies between two nodes. Where something between the ends holds or pushes the rod, the force jumps, and with it
the tension: so each point counts with the force on its side of a node, in each cell that it belongs to.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.form import FLOOR_SAFETY
from rodjax.discretization.mixed import MixedForm, MixedPoint
from rodjax.discretization.spans import held_places, nodes_along
from rodjax.energy import axial_strain_under, density
from rodjax.scene import held_position
from rodjax.supports import Free
from rodjax.vectors import dot


class ByCells(NamedTuple):
    """Parts of a `Linearization`, and by the p points of n cells their lengths, tangents and softness against tension;
    `by_force`: the derivatives of what a cell lacks of its way, by rotations of its points.
    """

    energy: Float[Array, ""]
    gradient: Float[Array, "b m"]
    diagonal: Float[Array, "b b m"]
    lengths: Float[Array, "p n"]
    along: Float[Array, "3 p n"]
    softness: Float[Array, "p n"]
    by_force: Float[Array, "b 3 p n"]


class PartedForm(MixedForm):
    """A nondimensional scene on a field of tangents; the `end_force` of its points is (3, parts), as `of_cells` has it.

    `side_forces`: as `forces_beyond`, by cells.
    """

    side_forces: Float[Array, "3 p n"] = eqx.field(kw_only=True)

    @abstractmethod
    def of_cells(self, end_force: Float[Array, "3 parts"]) -> Float[Array, "3 n"]:
        """The force through each cell besides that of the loads."""

    @property
    def held_places(self) -> tuple[Float[Array, "3 h"], Int[Array, "h"]]:
        """The positions that are held along the rod, and the numbers of the nodes there."""
        return held_places(self.scene, self.field.s, self.field.clip_nodes)

    def with_end_force(self, point: MixedPoint, loads: Float[Array, "3 *c n"]) -> Float[Array, "3 *c n"]:
        return self.of_cells(point.end_force).reshape(3, *[1] * (loads.ndim - 2), -1) + loads

    def nodes(self, edges: Float[Array, "n 3"]) -> Float[Array, "n+1 3"]:
        """Nodes along the edges, at held places to the last digit."""
        return nodes_along(edges, self.field.s, *self.held_places)

    def end_forces(self, point: MixedPoint) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The section forces at s = 0 and s = L."""
        start, end = self.scene.start, self.scene.end
        first, last = point.end_force[:, 0], point.end_force[:, -1]
        total = total_force(self.scene)
        if isinstance(end, Free):
            return first + total, jnp.zeros_like(total) if end.force is None else end.force
        if isinstance(start, Free):
            return jnp.zeros_like(total) if start.force is None else -start.force, last - total
        return first + total, last

    # --- stretch -----------------------------------------------------------------------------------------------------

    def _by_sides(
        self, tangents: Float[Array, "3 m"], end_force: Float[Array, "3 parts"]
    ) -> tuple[Float[Array, "3 p n"], Float[Array, "p n"]]:
        """The forces, and the tensions under them."""
        forces = self.of_cells(end_force)[:, None] + self.side_forces
        return forces, dot(forces, self.field.of_sides(tangents))

    def edge_tension(self, point: MixedPoint) -> Float[Array, "m"]:
        _, tension = self._by_sides(point.tangents, point.end_force)
        return self.field.of_points(self.field.side_weights * tension) / self.field.weights

    def edges(self, point: MixedPoint) -> Float[Array, "n 3"]:
        return jnp.sum(self._ways(point), axis=1).T

    def _ways(self, point: MixedPoint) -> Float[Array, "3 p n"]:
        _, tension = self._by_sides(point.tangents, point.end_force)
        lengths = self.field.side_weights * (1 + axial_strain_under(self.scene.rod, tension))
        return lengths[None] * self.field.of_sides(point.tangents)

    def load_energy(self, point: MixedPoint) -> Float[Array, ""]:
        return -jnp.sum(self.side_forces * self._ways(point)) - jnp.sum(
            total_force(self.scene) * held_position(self.scene)
        )

    def elastic_energy(self, point: MixedPoint) -> Float[Array, ""]:
        rod = self.scene.rod
        _, tension = self._by_sides(point.tangents, point.end_force)
        stretching = density(rod, axial_strain=axial_strain_under(rod, tension))
        bending = self.field.bending_energy(self.scene, point.tangents)
        return bending + jnp.sum(self.field.side_weights * stretching) + density(rod, twist=point.total_twist)

    def _by_cells(
        self,
        point: MixedPoint,
        bases: Float[Array, "3 b m"],
        gradient: Float[Array, "b m"],
        diagonal: Float[Array, "b b m"],
    ) -> ByCells:
        """With what stretch and the forces through the cells add to the derivatives of bending and torsion."""
        rod, field = self.scene.rod, self.field
        weights = field.side_weights
        forces, tension = self._by_sides(point.tangents, point.end_force)
        strain, softness = jax.jvp(
            lambda tension: axial_strain_under(rod, tension), (tension,), (jnp.ones_like(tension),)
        )
        lengths, softness = weights * (1 + strain), weights * softness
        along, directions = field.of_sides(point.tangents), field.of_sides(bases)
        across = jnp.sum(directions * forces[:, None], axis=0)
        gradient -= field.of_points(lengths[None] * across)
        identity = jnp.eye(bases.shape[1], dtype=gradient.dtype)[..., None]
        diagonal += field.of_points(lengths * tension)[None, None] * identity
        diagonal -= field.of_points(softness[None, None] * across[:, None] * across[None])
        by_force = -lengths[None, None] * jnp.swapaxes(directions, 0, 1)
        by_force -= softness[None, None] * across[:, None] * along[None]
        energy = jnp.sum(weights * (density(rod, axial_strain=strain) - tension * (1 + strain)))
        return ByCells(energy, gradient, diagonal, lengths, along, softness, by_force)

    def rounding_floor(self, point: MixedPoint) -> Float[Array, ""]:
        forces, _ = self._by_sides(point.tangents, point.end_force)
        largest = jnp.max(jnp.abs(forces))
        eps = jnp.finfo(largest.dtype).eps
        return FLOOR_SAFETY * eps * (4.0 * largest + 4.0 / self.field.finest**2)
