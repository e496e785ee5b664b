"""The energy of a rod: its density and the work of dead loads. Every force and derivative comes from these."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.model.rod import Law, Rod
from rodjax.programs.parts import traced_once

# Steps of Newton's method under a law for the axial strain, and for the other strains under a moment: a law that is
# quadratic in them takes one.
AXIAL_STEPS = 4
LAW_STEPS = 6


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


def torque_at(rod: Rod, twist: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """dw/d(twist) [N m]."""
    return jax.grad(lambda twist: jnp.sum(density(rod, twist=twist)))(twist)


def bending_moment_at(rod: Rod, curvature: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """dw/d(t x t') [N m], of vectors by component."""
    return jax.grad(lambda curvature: jnp.sum(density(rod, squared_curvature=curvature**2)))(curvature)


def axial_strain_under(rod: Rod, tension: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The axial strain [1] at which the tension dw/d(axial strain) is the given one [N]."""
    return _strain_under(lambda strain: density(rod, axial_strain=strain), tension)


def twist_under(rod: Rod, torque: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The twist [rad/m] at which the torque is the given one [N m]."""
    return _strain_under(lambda twist: density(rod, twist=twist), torque)


def curvature_under(rod: Rod, moment: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The curvature t x t' [1/m] at which the bending moment is the given one [N m], of vectors by component."""
    return _strain_under(lambda curvature: density(rod, squared_curvature=curvature**2), moment)


def _strain_under(energy: Callable[[Array], Array], stress: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """One step of Newton's method from zero strain, exact for a density quadratic in it."""

    def stress_at(strain):
        return jax.grad(lambda strain: jnp.sum(energy(strain)))(strain)

    at_rest = jnp.zeros_like(stress)
    first, stiffness = jax.jvp(stress_at, (at_rest,), (jnp.ones_like(stress),))
    return (stress - first) / stiffness


def dead_load_energy(force: Float[Array, "3"], position: Float[Array, "3"]) -> Float[Array, ""]:
    """- F . phi [J], the potential of a dead force; zero at the origin. eq. (6) of Linn & Stephan (2008)."""
    return -jnp.sum(force * position)


class Sections(eqx.Module):
    """What resists at k places along a rod that is not the same everywhere, or has a law of its own.

    `EI`: of the components of t x t' along d1 and d2; `s`: arclengths; `GA`: of the shear strains along d1 and d2,
    `None` where sections do not shear; `rest_axial`: the axial strains without stress, `None` where these are none.
    """

    EI: Float[Array, "2 *k"]
    GJ: Float[Array, "*k"]
    EA: Float[Array, "*k"]
    s: Float[Array, "*k"]
    law: Law | None
    GA: Float[Array, "2 *k"] | None = None
    rest_axial: Float[Array, "*k"] | None = None

    def at(self, k: int) -> "Sections":
        """At the strain point k of every cell."""
        GA = None if self.GA is None else self.GA[:, k]
        rest_axial = None if self.rest_axial is None else self.rest_axial[k]
        return Sections(self.EI[:, k], self.GJ[k], self.EA[k], self.s[k], self.law, GA, rest_axial)

    def density(
        self,
        curvature: tuple[Array, Array],
        twist: Float[Array, "*k"],
        axial_strain: Float[Array, "*k"],
        shear: Float[Array, "2 *k"] | None = None,
    ) -> Float[Array, "*k"]:
        """Energy [J/m] by what the strains exceed those of the stress-free shape by.

        `shear`: the components of phi' along d1 and d2, which add GA1/2 gamma1^2 + GA2/2 gamma2^2; `None` for none.
        """
        if shear is not None:
            assert self.GA is not None
            of_shear = (self.GA[0] * shear[0] ** 2 + self.GA[1] * shear[1] ** 2) / 2
            return self.density(curvature, twist, axial_strain) + of_shear
        if self.law is not None:
            law = self.law
            for _ in self.s.shape:
                law = jax.vmap(law, in_axes=-1, out_axes=-1)
            return law(jnp.stack(curvature), twist, axial_strain, self.s)
        bending = (self.EI[0] * curvature[0] ** 2 + self.EI[1] * curvature[1] ** 2) / 2
        return bending + self.GJ / 2 * twist**2 + self.EA / 2 * axial_strain**2

    @property
    def is_separable(self) -> bool:
        """Whether `density` is a sum of functions of one strain each: its second derivatives are then a diagonal."""
        return self.law is None

    def stretched(self, axial_strain: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """All of the axial strain, of what it exceeds that without stress by."""
        return axial_strain if self.rest_axial is None else axial_strain + self.rest_axial

    def shear_under(self, force: Float[Array, "2 *k"]) -> Float[Array, "2 *k"]:
        """The shear strains at which their forces dw/d(gamma) along d1 and d2 are the given ones [N]."""
        assert self.GA is not None
        return force / self.GA

    def axial_strain_under(
        self, tension: Float[Array, "*k"], curvature: tuple[Array, Array], twist: Float[Array, "*k"]
    ) -> Float[Array, "*k"]:
        """What the axial strain exceeds that at rest by where the tension dw/d(axial strain) is the given one [N].

        By Newton's method where there is a law; the derivatives of the last step are those of the solution as far as
        they enter derivatives of the energy (to the third).
        """
        if self.law is None:
            return tension / self.EA

        fixed = jax.lax.stop_gradient((tension, curvature, twist))
        strain = jax.lax.stop_gradient(tension / self.EA)
        for _ in range(AXIAL_STEPS):
            strain = jax.lax.stop_gradient(_better_axial_strain(self, strain, *fixed))
        return _better_axial_strain(self, strain, tension, curvature, twist)

    def strains_under(
        self, moment: Float[Array, "3 *k"], tension: Float[Array, "*k"]
    ) -> tuple[Float[Array, "3 *k"], Float[Array, "*k"]]:
        """What the strains exceed those at rest by, under a moment in material axes, and the axial strain likewise."""
        strains = moment / jnp.concatenate([self.EI, self.GJ[None]])
        if self.law is None:
            return strains, self.axial_strain_under(tension, (strains[0], strains[1]), strains[2])

        for _ in range(LAW_STEPS):
            strains = _better_strains(self, strains, moment, tension)
        return strains, self.axial_strain_under(tension, (strains[0], strains[1]), strains[2])

    @property
    def stiffest(self) -> Float[Array, ""]:
        """The largest stiffness against bending or torsion."""
        return jnp.maximum(jnp.max(self.EI), jnp.max(self.GJ))


@traced_once
def _better_axial_strain(
    sections: Sections,
    strain: Float[Array, "*k"],
    tension: Float[Array, "*k"],
    curvature: tuple[Array, Array],
    twist: Float[Array, "*k"],
) -> Float[Array, "*k"]:
    """A step of `Sections.axial_strain_under`."""

    def pull(strain: Float[Array, "*k"]) -> Float[Array, "*k"]:
        return jax.grad(lambda strain: jnp.sum(sections.density(curvature, twist, strain)))(strain)

    first, stiffness = jax.jvp(pull, (strain,), (jnp.ones_like(strain),))
    return strain + (tension - first) / stiffness


@traced_once
def _better_strains(
    sections: Sections, strains: Float[Array, "3 *k"], moment: Float[Array, "3 *k"], tension: Float[Array, "*k"]
) -> Float[Array, "3 *k"]:
    """A step of `Sections.strains_under`."""

    def enthalpy(strains: Float[Array, "3 *k"]) -> Float[Array, ""]:
        bending, twist = (strains[0], strains[1]), strains[2]
        axial = sections.axial_strain_under(tension, bending, twist)
        return jnp.sum(sections.density(bending, twist, axial) - tension * (1 + axial))

    first, by_all = jax.linearize(jax.grad(enthalpy), strains)
    directions = jnp.eye(3, dtype=strains.dtype).reshape(3, 3, *[1] * tension.ndim)
    directions *= jnp.ones_like(strains)[None]
    second = jax.vmap(by_all)(directions)
    lacking = jnp.moveaxis(moment - first, 0, -1)[..., None]
    moved = jnp.linalg.solve(jnp.moveaxis(second, (0, 1), (-1, -2)), lacking)
    return strains + jnp.moveaxis(moved[..., 0], -1, 0)
