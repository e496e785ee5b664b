"""The energy of a rod: its density and the work of dead loads. Every force and derivative comes from these."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.rod import Rod


def density(
    rod: Rod,
    squared_curvature: Float[Array, "*n"] | None = None,
    twist: Float[Array, "*n"] | None = None,
    axial_strain: Float[Array, "*n"] | None = None,
) -> Float[Array, "*n"]:
    """w = EI/2 |t x t'|^2 + GJ/2 Omega^2 + EA/2 (|phi'| - 1)^2 [J/m], eq. (7) of Linn & Stephan (2008).

    Strains that are `None` are left out: a discretization may take each at points of its own.
    """
    terms = []
    if squared_curvature is not None:
        terms.append(rod.EI / 2 * squared_curvature)
    if twist is not None:
        terms.append(rod.GJ / 2 * twist**2)
    if axial_strain is not None:
        terms.append(rod.EA / 2 * axial_strain**2)
    return sum(terms[1:], terms[0])


def axial_strain_under(rod: Rod, tension: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The axial strain [1] at which the tension dw/d(axial strain) is the given one [N].

    One Newton step from zero strain, exact for a density quadratic in it.
    """

    def tension_at(strain):
        return jax.grad(lambda strain: jnp.sum(density(rod, axial_strain=strain)))(strain)

    at_rest = jnp.zeros_like(tension)
    first, stiffness = jax.jvp(tension_at, (at_rest,), (jnp.ones_like(tension),))
    return (tension - first) / stiffness


def dead_load_energy(force: Float[Array, "3"], position: Float[Array, "3"]) -> Float[Array, ""]:
    """- F . phi [J], the potential of a dead force; zero at the origin. eq. (6) of Linn & Stephan (2008)."""
    return -jnp.sum(force * position)
