"""Strain measures against closed forms, and their smoothness in the rest state."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.mechanics.strain import axial_strain, squared_curvature_between, swept_angle


def test_axial_strain_of_a_stretched_helix():
    radius, pitch, s = 0.3, 0.2, 0.7

    def phi(s):
        return jnp.stack([radius * jnp.cos(s), radius * jnp.sin(s), pitch * s])

    np.testing.assert_allclose(axial_strain(jax.jacfwd(phi)(s)), math.hypot(radius, pitch) - 1, rtol=1e-15)


@pytest.mark.parametrize("angle", [1e-3, 0.5, 3.0])
def test_curvature_between_tangents_at_an_angle(angle):
    squared_difference = jnp.array(2 - 2 * math.cos(angle))
    curvature = 2 * math.tan(angle / 2) / 0.1
    # The cosine of 1e-3 has lost six digits.
    tolerance = 1e-9 if angle < 0.1 else 1e-13
    np.testing.assert_allclose(squared_curvature_between(squared_difference, jnp.array(0.1)), curvature**2, tolerance)


def test_swept_angle_of_an_octant():
    x, y, z = jnp.eye(3)
    # From the arc x -> y to the same arc seen from z: the triangle x, y, z has the area pi/2.
    np.testing.assert_allclose(swept_angle(z, z, x, y), math.pi / 2, rtol=1e-15)
    np.testing.assert_allclose(swept_angle(z, z, y, x), -math.pi / 2, rtol=1e-15)


@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_at_the_straight_unstretched_rod_are_finite(order):
    t, zero = jnp.array([0.0, 0, 1]), jnp.zeros(3)

    def everything(delta):
        strains = (
            axial_strain(t + delta),
            squared_curvature_between(jnp.sum(delta**2), jnp.ones(())),
            swept_angle(t + delta, t - delta, t, t),
        )
        return jnp.stack(strains)

    derivative = everything
    for _ in range(order):
        derivative = jax.jacfwd(derivative)
    assert jnp.all(jnp.isfinite(derivative(zero)))
