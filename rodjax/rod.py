"""The rod: reference length, stiffnesses and mass of an isotropic, naturally straight rod."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import Numbers, is_known, leaf, not_negative, number_array, positive
from rodjax.units import Units


class Rod(eqx.Module):
    """An extensible Kirchhoff rod, isotropic and straight when free of stress.

    **Arguments:**

    - `length`: reference length L [m].
    - `EI`: bending stiffness [N m^2].
    - `GJ`: torsional stiffness [N m^2].
    - `EA`: stretching stiffness [N].
    - `mass_per_length` [kg/m]: gives the weight in a scene with gravity.
    - `radius` [m]: for pictures only; `None` where unknown.

    Raises `ValueError` or `TypeError` where a stiffness or the length is not a positive finite number.
    """

    length: Float[Array, ""]
    EI: Float[Array, ""]
    GJ: Float[Array, ""]
    EA: Float[Array, ""]
    mass_per_length: Float[Array, ""]
    radius: Float[Array, ""] | None

    def __init__(self, length: Any, EI: Any, GJ: Any, EA: Any, mass_per_length: Any = 0.0, radius: Any = None):
        self.length = leaf(positive(length, "length"))
        self.EI = leaf(positive(EI, "EI"))
        self.GJ = leaf(positive(GJ, "GJ"))
        self.EA = leaf(positive(EA, "EA"))
        self.mass_per_length = leaf(not_negative(mass_per_length, "mass_per_length"))
        self.radius = None if radius is None else leaf(positive(radius, "radius"))

    def in_units(self, units: Units) -> "Rod":
        """The same rod with L = 1, EI = 1 and mass per length 1: see `rodjax.scene.nondimensional`."""
        one = jnp.ones_like(self.length)
        radius = None if self.radius is None else self.radius / units.length
        return Rod(one, one, self.GJ / self.EI, self.EA / units.force, one, radius)

    @staticmethod
    def circular(
        length: Any,
        radius: Any,
        youngs_modulus: Any,
        shear_modulus: Any = None,
        poisson_ratio: Any = None,
        density: Any = 0.0,
    ) -> "Rod":
        """A rod of solid circular section: EI = E pi R^4/4, GJ = G pi R^4/2, EA = E pi R^2.

        `length` and `radius` [m], `youngs_modulus` [Pa], `density` [kg/m^3], and exactly one of `shear_modulus` [Pa]
        and `poisson_ratio`.
        """
        radius = positive(radius, "radius")
        return _round_section(length, radius, 0.0 * radius, youngs_modulus, shear_modulus, poisson_ratio, density)

    @staticmethod
    def tube(
        length: Any,
        outer_radius: Any,
        inner_radius: Any,
        youngs_modulus: Any,
        shear_modulus: Any = None,
        poisson_ratio: Any = None,
        density: Any = 0.0,
    ) -> "Rod":
        """A rod of annular section, a hose or pipe; arguments as for `Rod.circular`, radii [m]."""
        outer = positive(outer_radius, "outer_radius")
        inner = positive(inner_radius, "inner_radius")
        return _round_section(length, outer, inner, youngs_modulus, shear_modulus, poisson_ratio, density)


def _round_section(
    length: Any,
    outer: Float[Numbers, ""],
    inner: Float[Numbers, ""],
    youngs_modulus: Any,
    shear_modulus: Any,
    poisson_ratio: Any,
    density: Any,
) -> Rod:
    E = positive(youngs_modulus, "youngs_modulus")
    G = _shear_modulus(E, shear_modulus, poisson_ratio)
    density = not_negative(density, "density")
    # The differences of powers are factored so that a thin wall keeps its digits.
    wall = positive(outer - inner, "outer_radius - inner_radius")
    with np.errstate(over="ignore", invalid="ignore"):  # of what is too large, Rod says so
        area = math.pi * wall * (outer + inner)
        second_moment = area * (outer**2 + inner**2) / 4
        stiffnesses = E * second_moment, 2 * G * second_moment, E * area
        return Rod(length, *stiffnesses, mass_per_length=density * area, radius=outer)


def _shear_modulus(E: Float[Numbers, ""], shear_modulus: Any, poisson_ratio: Any) -> Float[Numbers, ""]:
    if (shear_modulus is None) == (poisson_ratio is None):
        raise ValueError(
            f"exactly one of shear_modulus and poisson_ratio must be given, got {shear_modulus!r} and {poisson_ratio!r}"
        )
    if shear_modulus is not None:
        return positive(shear_modulus, "shear_modulus")
    ratio = number_array(poisson_ratio, "poisson_ratio")
    if is_known(ratio) and not -1 < float(ratio) <= 0.5:
        raise ValueError(f"poisson_ratio must be above -1 and at most 0.5, got {float(ratio):g}")
    return E / (2 * (1 + ratio))
