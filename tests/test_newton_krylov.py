"""Newton with GMRES, for dead moments in space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Free, Scene, frame, problems
from rodjax.solvers.newton_krylov import gmres


@pytest.mark.parametrize("n", [1, 5, 20])
def test_gmres_solves_a_system_that_is_not_symmetric(n):
    rng = np.random.default_rng(n)
    matrix = np.eye(n) + 0.5 * rng.normal(size=(n, n)) / np.sqrt(n)
    right_side = rng.normal(size=n)
    solve = jax.jit(lambda b: gmres(lambda x: jnp.asarray(matrix) @ x, b, 1e-12, 25))
    np.testing.assert_allclose(matrix @ solve(jnp.asarray(right_side)), right_side, atol=1e-11)
    np.testing.assert_array_equal(solve(jnp.zeros(n)), np.zeros(n))


@pytest.mark.parametrize("size", [1.0, 6.0])
def test_a_dead_moment_bends_a_cantilever_into_a_helix(size):
    """Without forces the moment is the same everywhere: the tangent turns about it at M L/EI, the twist is M . t/GJ."""
    rod = problems.cable(20.0)
    moment = size * np.array([1.0, 2.0, -0.5]) / np.sqrt(5.25)
    scene = Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), Free(moment=moment * rod.EI))
    errors = []
    for segments in (20, 40):
        result = rj.solve(scene, segments=segments)
        assert result.converged
        np.testing.assert_allclose(result.start_moment / rod.EI, moment, atol=1e-6)
        np.testing.assert_allclose(result.total_twist, moment[0] * rod.EI / rod.GJ, rtol=0.05)
        s = np.linspace(0, 1, 2001)
        tangents = Rotation.from_rotvec(s[:, None] * moment).apply([1.0, 0, 0])
        tip = np.trapezoid(tangents, s, axis=0)
        errors.append(float(np.linalg.norm(result.nodes[-1] - tip)))
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.15
    assert errors[1] < 1e-3 * size**2


def test_a_moment_and_a_force_together_balance():
    rod = problems.cable(20.0)
    force, moment = rod.EI * jnp.array([0.0, 2.0, -3.0]), rod.EI * jnp.array([2.0, 1.0, -2.0])
    scene = Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), Free(force, moment), gravity=(0, 0, -1.0))
    result = rj.solve(scene, segments=20)
    assert result.converged
    weight = rod.mass_per_length * scene.gravity
    np.testing.assert_allclose(result.start_force, force + weight, atol=1e-7 * float(rod.EI))
    at_start = moment + np.cross(result.nodes[-1], force)
    weights = np.full(21, 1 / 20)
    weights[[0, -1]] /= 2
    at_start += np.cross(weights @ result.nodes, weight)
    np.testing.assert_allclose(result.start_moment, at_start, atol=1e-7 * float(rod.EI))
    assert rj.solve(scene, guess=result).iterations == 0
