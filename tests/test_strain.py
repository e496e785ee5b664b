"""Strain measures against closed forms, and their smoothness in the rest state."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.strain import axial_strain, curvature, stretch, swept_angle


def test_strains_of_a_stretched_helix():
    radius, pitch, s = 0.3, 0.2, 0.7

    def phi(s):
        return jnp.stack([radius * jnp.cos(s), radius * jnp.sin(s), pitch * s])

    dphi, ddphi = jax.jacfwd(phi)(s), jax.jacfwd(jax.jacfwd(phi))(s)
    speed = math.hypot(radius, pitch)
    np.testing.assert_allclose(stretch(dphi), speed, rtol=1e-15)
    np.testing.assert_allclose(axial_strain(dphi), speed - 1, rtol=1e-15)
    # |t x t'| by parameter s: the geometric curvature R/(R^2 + p^2) times the speed.
    np.testing.assert_allclose(jnp.linalg.norm(curvature(dphi, ddphi)), radius / speed, rtol=1e-14)


def test_curvature_points_along_the_axis_of_a_counterclockwise_circle():
    np.testing.assert_allclose(curvature(jnp.array([1.0, 0, 0]), jnp.array([0.0, 2, 0])), [0, 0, 2])


def test_swept_angle_of_an_octant():
    x, y, z = jnp.eye(3)
    # From the arc x -> y to the same arc seen from z: the triangle x, y, z has the area pi/2.
    np.testing.assert_allclose(swept_angle(z, z, x, y), math.pi / 2, rtol=1e-15)
    np.testing.assert_allclose(swept_angle(z, z, y, x), -math.pi / 2, rtol=1e-15)


@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_at_the_straight_unstretched_rod_are_finite(order):
    t, zero = jnp.array([0.0, 0, 1]), jnp.zeros(3)

    def everything(delta):
        strains = (axial_strain(t + delta), *curvature(t + delta, delta), swept_angle(t + delta, t - delta, t, t))
        return jnp.stack(strains)

    derivative = everything
    for _ in range(order):
        derivative = jax.jacfwd(derivative)
    assert jnp.all(jnp.isfinite(derivative(zero)))
