"""The density against its formula."""

import jax
import jax.numpy as jnp
import numpy as np

from rodjax import Rod
from rodjax.energy import axial_strain_under, dead_load_energy, density

ROD = Rod(1.0, EI=2.0, GJ=3.0, EA=5.0)


def test_density_is_half_stiffness_times_strain_squared():
    np.testing.assert_allclose(density(ROD, squared_curvature=jnp.array(5.0)), 2 / 2 * 5)
    np.testing.assert_allclose(density(ROD, twist=jnp.array(4.0)), 3 / 2 * 16)
    np.testing.assert_allclose(density(ROD, axial_strain=jnp.array(0.1)), 5 / 2 * 0.01)
    together = density(ROD, squared_curvature=jnp.array(5.0), twist=jnp.array(4.0), axial_strain=jnp.array(0.1))
    np.testing.assert_allclose(together, 5 + 24 + 0.025)


def test_section_forces_are_derivatives_of_the_density():
    bending = lambda kappa: density(ROD, squared_curvature=jnp.sum(kappa**2))  # noqa: E731
    np.testing.assert_allclose(jax.grad(bending)(jnp.array([0.0, 3, 0])), [0, 6, 0])
    np.testing.assert_allclose(jax.grad(lambda twist: density(ROD, twist=twist))(jnp.array(2.0)), 6)


def test_axial_strain_under_a_tension():
    tension = jnp.array([0.0, 1.0, -2.0])
    # The density is quadratic, so that its one Newton step is exact.
    np.testing.assert_allclose(axial_strain_under(ROD, tension), tension / 5, rtol=1e-15)
    np.testing.assert_allclose(jax.grad(lambda n: axial_strain_under(ROD, n))(jnp.array(3.0)), 1 / 5, rtol=1e-15)


def test_a_dead_force_is_minus_the_gradient_of_its_energy():
    force = jnp.array([1.0, -2, 3])
    np.testing.assert_allclose(jax.grad(dead_load_energy, argnums=1)(force, jnp.ones(3)), -force)
