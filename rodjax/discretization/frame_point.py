"""The unknowns of a rod by frames, and the strains that follow from them and from the forces through the rod."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.discretization.cells import REFERENCE, Cells
from rodjax.discretization.nodal_point import Nodal
from rodjax.discretization.rest_correction import RestCorrection, part
from rodjax.geometry.rotations import (
    align_tangent,
    columns,
    inverse,
    rotate_about_tangent,
    rotated,
    tangent,
)
from rodjax.geometry.vectors import dot
from rodjax.linalg.blocks import short_sum
from rodjax.mechanics.energy import Sections


class FramePoint(eqx.Module):
    """Frames along the rod; forces of the layout, zero where none is unknown; the total twist [rad], where known;
    `nodal`: where positions of nodes are unknowns.
    """

    quaternions: Float[Array, "4 m"]
    end_force: Float[Array, "3 parts"]
    total_twist: Float[Array, ""]
    nodal: Nodal | None = None

    @property
    def tangents(self) -> Float[Array, "3 m"]:
        return tangent(self.quaternions)

    def flattened(self, normal: Float[Array, "3"], across: Float[Array, "3"]) -> "FramePoint":
        """The point turned into a plane: with the normal along `across` in the axes of each frame."""
        tangents = self.tangents
        in_plane = tangents - normal[:, None] * (normal @ tangents)[None]
        sizes = jnp.sqrt(dot(in_plane, in_plane))[None]
        swung_into = align_tangent(self.quaternions, in_plane / jnp.where(sizes > 0, sizes, 1.0))
        seen = rotated(inverse(swung_into), jnp.broadcast_to(normal[:, None], tangents.shape))
        turn = jnp.arctan2(seen[1], seen[0]) - jnp.arctan2(across[1], across[0])
        force = self.end_force - normal[:, None] * (normal @ self.end_force)[None]
        nodal = None if self.nodal is None else self.nodal.without(normal)
        return FramePoint(rotate_about_tangent(swung_into, turn), force, jnp.zeros_like(self.total_twist), nodal)


class Kinematics(NamedTuple):
    """Quantities that depend on the frames of cells alone.

    `strains`: minus those at rest; `rests`: the part of the correction at rest that turns with the reference frames;
    `along`: its part along the tangents; `across`: d1 and d2 where sections shear.
    """

    strains: Float[Array, "3 p n"]
    tangents: Float[Array, "3 p n"]
    rests: Float[Array, "3 n"]
    along: Float[Array, "p n"] | None
    across: Float[Array, "3 2 p n"] | None = None

    @staticmethod
    def of(
        field: Cells,
        rest_strains: Float[Array, "3 k n"] | None,
        rest_correction: RestCorrection | None,
        has_shear: bool,
        quaternions: Float[Array, "4 p n"],
    ) -> "Kinematics":
        """The kinematics of cells with these frames."""
        strains = field.strains(field.seen(quaternions)[field.coordinates]).values
        if rest_strains is not None:
            strains -= rest_strains
        rests = turned_correction(rest_correction, quaternions, jnp.zeros_like(strains[:, 0]))
        along = None
        if rest_correction is not None and rest_correction.along is not None:
            assert rest_strains is not None
            along = rest_correction.along * part(strains[:2], rest_strains[:2])
        across = columns(quaternions)[:, :2] if has_shear else None
        return Kinematics(strains, tangent(quaternions), rests, along, across)


class Strained(eqx.Module):
    """Strains and slopes at the strain points of cells.

    `curvature`, `twist`, `axial`: strains minus those at rest, `axial` under the `tension`; `stretched`: with the axial
    strain at rest; `lengths`: of the segment vectors along the `tangents`; `weights`: quadrature weights, lengths of
    rod; `shear`: shear strains, and `sideways` what they add to phi', `None` without shear.
    """

    curvature: Float[Array, "2 p n"]
    twist: Float[Array, "p n"]
    axial: Float[Array, "p n"]
    stretched: Float[Array, "p n"]
    tension: Float[Array, "p n"]
    tangents: Float[Array, "3 p n"]
    lengths: Float[Array, "p n"]
    weights: Float[Array, "p n"]
    shear: Float[Array, "2 p n"] | None
    sideways: Float[Array, "3 p n"] | None

    @staticmethod
    def of(field: Cells, sections: Sections, here: Kinematics, forces: Float[Array, "3 p n"]) -> "Strained":
        """The strains of cells under these section forces."""
        strains, tangents = here.strains, here.tangents
        tension = dot(forces, tangents)
        axial = sections.axial_strain_under(tension, (strains[0], strains[1]), strains[2])
        weights = field.lengths
        stretched = sections.stretched(axial)
        lengths = weights * (1 + stretched)
        if here.along is not None:
            lengths += here.along
        shear = sideways = None
        if here.across is not None:
            shear = sections.shear_under(short_sum(here.across * forces[:, None], axis=0))
            sideways = short_sum(here.across * shear[None], axis=1)
        of_axis = strains[2], axial, stretched, tension
        return Strained(strains[:2], *of_axis, tangents, lengths, weights, shear, sideways)

    @property
    def weighted_slopes(self) -> Float[Array, "3 p n"]:
        """h phi': what each strain point adds to the segment vector."""
        along = self.lengths[None] * self.tangents
        return along if self.sideways is None else along + self.weights[None] * self.sideways

    @property
    def slopes(self) -> Float[Array, "3 p n"]:
        """The derivative of the centerline by arclength, phi'."""
        along = (1 + self.stretched)[None] * self.tangents
        return along if self.sideways is None else along + self.sideways

    def work(self, forces: Float[Array, "3 p n"]) -> Float[Array, "p n"]:
        """The work of forces on the weighted slopes."""
        along = self.lengths * dot(forces, self.tangents)
        return along if self.sideways is None else along + self.weights * dot(forces, self.sideways)


class HeldFrame(NamedTuple):
    """The part of a frame that a support holds, with the number of the frame: the tangent, or all of it (`frame`)."""

    number: int | Int[Array, ""]
    tangent: Float[Array, "3"]
    frame: Float[Array, "3 3"] | None


def turned_correction(
    rest: RestCorrection | None, quaternions: Float[Array, "4 p n"], nothing: Float[Array, "3 n"]
) -> Float[Array, "3 n"]:
    """The part of the correction at rest that turns with the reference frames of the cells; `nothing`: zeros."""
    return nothing if rest is None else rotated(quaternions[:, REFERENCE], rest.turning)
