"""The energy of a rod: its density and the work of dead loads. Every force and derivative comes from these."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.rod import Rod


def density(
    rod: Rod,
    curvature: Float[Array, "3"] | None = None,
    twist: Float[Array, ""] | None = None,
    axial_strain: Float[Array, ""] | None = None,
) -> Float[Array, ""]:
    """w = EI/2 |t x t'|^2 + GJ/2 Omega^2 + EA/2 (|phi'| - 1)^2 [J/m], eq. (7) of Linn & Stephan (2008).

    Strains that are `None` are left out: a discretization may take each at points of its own.
    """
    w = jnp.zeros_like(rod.EI)
    if curvature is not None:
        w += rod.EI / 2 * jnp.sum(curvature * curvature)
    if twist is not None:
        w += rod.GJ / 2 * twist**2
    if axial_strain is not None:
        w += rod.EA / 2 * axial_strain**2
    return w


def dead_load_energy(force: Float[Array, "3"], position: Float[Array, "3"]) -> Float[Array, ""]:
    """- F . phi [J], the potential of a dead force; zero at the origin. eq. (6) of Linn & Stephan (2008)."""
    return -jnp.sum(force * position)
