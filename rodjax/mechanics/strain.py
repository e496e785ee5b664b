"""Strain measures of a framed curve from the derivatives of its centerline by reference arclength, point by point."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.geometry.vectors import dot, triple_product
from rodjax.programs.parts import traced_once


def axial_strain(dphi: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """|phi'| - 1 [1], eq. (5) of Linn & Stephan (2008)."""
    return jnp.sqrt(jnp.sum(dphi * dphi, axis=-1)) - 1


def squared_curvature_between(
    squared_difference: Float[Array, "*k"], spacing: Float[Array, "*k"]
) -> Float[Array, "*k"]:
    """|t x t'|^2 [1/m^2] from the squared difference of two unit tangents: (2 tan(a/2)/h)^2 for the angle a.

    The bending strain of eq. (3) of Linn & Stephan (2008) by central differences. It grows beyond bounds as the
    tangents turn against each other, so that a rod has no way through a fold.
    """
    return 4 * squared_difference / ((4 - squared_difference) * spacing**2)


@traced_once
def swept_angle(
    tangent: Float[Array, "3 *k"],
    next_tangent: Float[Array, "3 *k"],
    reference: Float[Array, "3 *k"],
    next_reference: Float[Array, "3 *k"],
) -> Float[Array, "*k"]:
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
    a: Float[Array, "3 *k"], b: Float[Array, "3 *k"], c: Float[Array, "3 *k"]
) -> tuple[Float[Array, "*k"], Float[Array, "*k"]]:
    return 1 + dot(a, b) + dot(b, c) + dot(c, a), triple_product(a, b, c)
