"""The unknowns of a rod by tangents, and the parts of its linearisation."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.discretization.nodal_point import Nodal
from rodjax.discretization.tangent_field import Blocks, TangentField
from rodjax.geometry.vectors import dot
from rodjax.linalg.blocks import short_sum
from rodjax.mechanics.energy import axial_strain_under, density
from rodjax.model.rod import Rod


class MixedPoint(eqx.Module):
    """Unit tangents; forces of the layout, zero where none is unknown; total twist [rad], zero where there is no
    torsion; `nodal`: where positions of nodes are unknowns.
    """

    tangents: Float[Array, "3 m"]
    end_force: Float[Array, "3 parts"]
    total_twist: Float[Array, ""]
    nodal: Nodal | None = None

    def flattened(self, axes: Float[Array, "3 2"]) -> "MixedPoint":
        """The point without what leaves the plane of these two axes, and without twist."""
        in_plane = axes.T @ self.tangents
        sizes = jnp.sqrt(dot(in_plane, in_plane))[None]
        in_plane = jnp.where(sizes > 0, in_plane / jnp.where(sizes > 0, sizes, 1.0), jnp.eye(2, 1, dtype=sizes.dtype))
        nodal = None if self.nodal is None else self.nodal.flattened(axes)
        return MixedPoint(axes @ in_plane, axes @ (axes.T @ self.end_force), jnp.zeros_like(self.total_twist), nodal)


class Elastic(NamedTuple):
    """The terms of bending and torsion in a `Linearization`.

    `torque_column`: by the torque, by the points of each cell; `torsional_compliance`: 1/GJ where the total twist is
    given; else `None`.
    """

    bases: Float[Array, "3 b m"]
    energy: Float[Array, ""]
    blocks: Blocks
    torque_column: Float[Array, "b 1 p n"] | None
    torsional_compliance: Float[Array, ""] | None


class ByCells(NamedTuple):
    """Parts of a `Linearization`, and by the p points of n cells their lengths, tangents and compliance under tension;
    `by_force`: the derivatives of minus the segment vector by the rotations of the points of its cell.
    """

    energy: Float[Array, ""]
    gradient: Float[Array, "b p n"]
    diagonal: Float[Array, "b b p n"]
    lengths: Float[Array, "p n"]
    along: Float[Array, "3 p n"]
    axial_compliance: Float[Array, "p n"]
    by_force: Float[Array, "b 3 p n"]

    @staticmethod
    def of(
        rod: Rod,
        field: TangentField,
        point: MixedPoint,
        bases: Float[Array, "3 b m"],
        blocks: Blocks,
        forces: Float[Array, "3 p n"],
        tension: Float[Array, "p n"],
    ) -> "ByCells":
        """`forces`, `tension`: through the cells; `blocks`: the derivatives of bending and torsion."""
        weights = field.quadrature_weights
        strain, axial_compliance = jax.jvp(
            lambda tension: axial_strain_under(rod, tension), (tension,), (jnp.ones_like(tension),)
        )
        lengths, axial_compliance = weights * (1 + strain), weights * axial_compliance
        along, directions = field.gather(point.tangents), field.gather(bases)
        across = short_sum(directions * forces[:, None], axis=0)
        gradient = blocks.gradient - lengths[None] * across
        identity = np.eye(bases.shape[1], dtype=gradient.dtype)[..., None, None]
        diagonal = blocks.diagonal + (lengths * tension)[None, None] * identity
        diagonal -= axial_compliance[None, None] * across[:, None] * across[None]
        by_force = -lengths[None, None] * jnp.swapaxes(directions, 0, 1)
        by_force -= axial_compliance[None, None] * across[:, None] * along[None]
        energy = jnp.sum(weights * (density(rod, axial_strain=strain) - tension * (1 + strain)))
        return ByCells(energy, gradient, diagonal, lengths, along, axial_compliance, by_force)

    @property
    def compliance(self) -> Float[Array, "3 3 n"]:
        """The derivative of each segment vector by the force through it."""
        softer = self.axial_compliance[None] * self.along
        return short_sum(softer[:, None] * self.along[None], axis=2)
