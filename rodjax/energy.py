"""The energy of a rod: its density and the work of dead loads. Every force and derivative comes from these."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.rod import Law, Rod

# Steps of Newton's method for the axial strain under a law: a law that is quadratic in it takes one.
AXIAL_STEPS = 4


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


class Sections(eqx.Module):
    """What resists at k places along a rod that is not the same everywhere, or has a law of its own.

    `EI`: of the components of t x t' along d1 and d2; `s`: arclengths.
    """

    EI: Float[Array, "2 *k"]
    GJ: Float[Array, "*k"]
    EA: Float[Array, "*k"]
    s: Float[Array, "*k"]
    law: Law | None

    def at(self, k: int) -> "Sections":
        """At the strain point k of every cell."""
        return Sections(self.EI[:, k], self.GJ[k], self.EA[k], self.s[k], self.law)

    def density(
        self, curvature: tuple[Array, Array], twist: Float[Array, "*k"], axial_strain: Float[Array, "*k"]
    ) -> Float[Array, "*k"]:
        """Energy [J/m] by what the strains exceed those of the stress-free shape by."""
        if self.law is not None:
            law = self.law
            for _ in self.s.shape:
                law = jax.vmap(law, in_axes=-1, out_axes=-1)
            return law(jnp.stack(curvature), twist, axial_strain, self.s)
        bending = (self.EI[0] * curvature[0] ** 2 + self.EI[1] * curvature[1] ** 2) / 2
        return bending + self.GJ / 2 * twist**2 + self.EA / 2 * axial_strain**2

    def axial_strain_under(
        self, tension: Float[Array, "*k"], curvature: tuple[Array, Array], twist: Float[Array, "*k"]
    ) -> Float[Array, "*k"]:
        """The axial strain at which the tension dw/d(axial strain) is the given one [N].

        By Newton's method where there is a law; the derivatives of the last step are those of the solution as far as
        they enter derivatives of the energy (to the third).
        """
        if self.law is None:
            return tension / self.EA

        def improved(strain, tension, curvature, twist):
            def pull(strain):
                return jax.grad(lambda strain: jnp.sum(self.density(curvature, twist, strain)))(strain)

            first, stiffness = jax.jvp(pull, (strain,), (jnp.ones_like(strain),))
            return strain + (tension - first) / stiffness

        fixed = jax.lax.stop_gradient((tension, curvature, twist))
        strain = jax.lax.stop_gradient(tension / self.EA)
        for _ in range(AXIAL_STEPS):
            strain = jax.lax.stop_gradient(improved(strain, *fixed))
        return improved(strain, tension, curvature, twist)
