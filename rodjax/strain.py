"""Strain measures of a framed curve from the derivatives of its centerline by reference arclength, point by point."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def stretch(dphi: Float[Array, "3"]) -> Float[Array, ""]:
    """|phi'| [1]."""
    return jnp.sqrt(jnp.sum(dphi * dphi))


def axial_strain(dphi: Float[Array, "3"]) -> Float[Array, ""]:
    """|phi'| - 1 [1], eq. (5) of Linn & Stephan (2008)."""
    return stretch(dphi) - 1


def curvature(dphi: Float[Array, "3"], ddphi: Float[Array, "3"]) -> Float[Array, "3"]:
    """t x t' = phi' x phi'' / |phi'|^2 [1/m], the bending strain of eq. (3) of Linn & Stephan (2008)."""
    return jnp.cross(dphi, ddphi) / jnp.sum(dphi * dphi)


def swept_angle(
    tangent: Float[Array, "3"],
    next_tangent: Float[Array, "3"],
    reference: Float[Array, "3"],
    next_reference: Float[Array, "3"],
) -> Float[Array, ""]:
    """Area on the unit sphere swept by the arc from `tangent` to `next_tangent` as it comes from that of the reference.

    By so much [rad] the twist between two neighbouring cross sections grows when the tangents move from the
    reference to their place while the frames follow by smallest rotations (the reference twist of Bergou et al. 2010;
    Fuller's difference formula for polygons). All arguments are unit vectors; smooth while no tangent turns by pi.
    """
    # Two spherical triangles by the half-angle formula of van Oosterom & Strackee (1983), added as complex numbers.
    real_1, imag_1 = _half_solid_angle(reference, next_reference, next_tangent)
    real_2, imag_2 = _half_solid_angle(reference, next_tangent, tangent)
    return 2 * jnp.arctan2(real_1 * imag_2 + imag_1 * real_2, real_1 * real_2 - imag_1 * imag_2)


def _half_solid_angle(
    a: Float[Array, "3"], b: Float[Array, "3"], c: Float[Array, "3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    ab, bc, ca = (jnp.sum(x * y) for x, y in ((a, b), (b, c), (c, a)))
    return 1 + ab + bc + ca, jnp.sum(a * jnp.cross(b, c))
