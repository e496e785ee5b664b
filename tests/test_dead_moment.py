"""Dead moments on a free end: bending into a helix and a roll, balance, any size of moment, what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Clip, Free, Rod, Scene, frame, problems

CLAMP = Clamp((0, 0, 0), frame((1, 0, 0)))


@pytest.mark.parametrize("size", [1.0, 6.0])
def test_a_dead_moment_bends_a_cantilever_into_a_helix(size):
    """Without forces the moment is the same everywhere: the tangent turns about it at M L/EI, the twist is M . t/GJ."""
    rod = problems.cable(20.0)
    moment = size * np.array([1.0, 2.0, -0.5]) / np.sqrt(5.25)
    scene = Scene(rod, CLAMP, Free(moment=moment * rod.EI))
    errors = []
    for segments in (20, 40):
        result = rj.solve(scene, segments=segments, discretization="finite_difference")
        assert result.converged
        np.testing.assert_allclose(result.start_moment / rod.EI, moment, atol=1e-6)  # the residual, summed over the rod
        # The torque is that about the last edge: half an edge before the end, where the tangent has turned by size/40.
        np.testing.assert_allclose(result.total_twist, moment[0] * rod.EI / rod.GJ, rtol=0.05)
        s = np.linspace(0, 1, 2001)
        tangents = Rotation.from_rotvec(s[:, None] * moment).apply([1.0, 0, 0])
        tip = np.trapezoid(tangents, s, axis=0)
        errors.append(float(np.linalg.norm(result.nodes[-1] - tip)))
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.15  # second order, up to the next term
    assert errors[1] < 1e-3 * size**2  # size h turns a tangent from edge to edge


def test_a_moment_and_a_force_together_balance():
    rod = problems.cable(20.0)
    force, moment = rod.EI * jnp.array([0.0, 2.0, -3.0]), rod.EI * jnp.array([2.0, 1.0, -2.0])
    scene = Scene(rod, CLAMP, Free(force, moment), gravity=(0, 0, -1.0))
    result = rj.solve(scene, segments=20, discretization="finite_difference")
    assert result.converged
    # The tolerance of the residual, 1e-8 EI/L^2, on ten of the 20 nodes.
    atol = 1e-7 * float(rod.EI)
    weight = rod.mass_per_length * scene.gravity
    np.testing.assert_allclose(result.start_force, force + weight, atol=atol)
    at_start = moment + np.cross(result.nodes[-1], force)
    weights = np.full(21, 1 / 20)
    weights[[0, -1]] /= 2
    at_start += np.cross(weights @ result.nodes, weight)
    np.testing.assert_allclose(result.start_moment, at_start, atol=atol)
    assert rj.solve(scene, segments=20, discretization="finite_difference", guess=result).iterations == 0


def test_a_moment_rolls_a_cantilever_up():
    """M L/EI = 8 pi bends it into a circle four times over, from a straight guess."""
    rod = problems.cable()
    segments, angle = 80, 8 * np.pi
    result = rj.solve(
        Scene(rod, CLAMP, Free(moment=(0, angle * rod.EI, 0))), segments=segments, discretization="finite_difference"
    )
    assert result.converged
    assert result.iterations <= 5  # bending is nearly quadratic in the rotations: 3 seen
    # The energy 2 tan(a/2)^2/h of a joint of the angle a gives M h/2 = t (1 + t^2) with t = tan(a/2); the joint at the
    # clamp is half as long.
    joint, first = (2 * np.arctan(_root(angle / segments / k)) for k in (2, 4))
    directions = first + joint * np.arange(segments)
    tip = np.array([np.mean(np.cos(directions)), 0.0, -np.mean(np.sin(directions))])
    np.testing.assert_allclose(result.nodes[-1], tip, rtol=0, atol=1e-9)  # a residual of 1e-8 EI/L^2 at most
    np.testing.assert_allclose(result.curvature[1:-1], 2 * np.tan(joint / 2) * segments, rtol=1e-9)


def _root(c: float) -> float:
    """t with t (1 + t^2) = c."""
    roots = np.roots([1.0, 0.0, 1.0, -c])
    return float(roots[np.argmin(np.abs(roots.imag))].real)


def random_moments() -> list[tuple[np.ndarray, np.ndarray]]:
    """Ten forces of about 2 EI/L^2 and moments of 20 EI/L, in units of EI."""
    rng = np.random.default_rng(0)
    moments = rng.normal(size=(10, 3))
    return list(zip(2 * rng.normal(size=(10, 3)), 20 * moments / np.linalg.norm(moments, axis=1)[:, None], strict=True))


def test_large_moments_with_forces_converge():
    rod = problems.cable()
    for force, moment in random_moments():
        result = rj.solve(
            Scene(rod, CLAMP, Free(force * rod.EI, moment * rod.EI)), segments=30, discretization="finite_difference"
        )
        assert result.converged
        assert result.iterations <= 12  # 9 seen
        assert not result.stable  # without a potential it is not examined


@pytest.mark.slow
def test_a_moment_on_the_start_is_that_on_the_end_of_the_reversed_rod():
    rod = problems.cable(20.0)
    force, moment = random_moments()[0]
    free = Free(force * rod.EI, moment / 4 * rod.EI)
    forward = rj.solve(Scene(rod, CLAMP, free), segments=30, discretization="finite_difference")
    flip = jnp.diag(jnp.array([-1.0, 1.0, -1.0]))  # t and d1 change sign, d2 stays: right-handed
    backward = rj.solve(
        Scene(rod, free, Clamp((0, 0, 0), CLAMP.frame @ flip)), segments=30, discretization="finite_difference"
    )
    assert forward.converged
    assert backward.converged
    # Residuals of 1e-8 EI/L^2 at most, in a rod that turns by 5 rad.
    np.testing.assert_allclose(backward.nodes[::-1], forward.nodes, rtol=0, atol=1e-9)
    np.testing.assert_allclose(backward.total_twist, forward.total_twist, rtol=0, atol=1e-8)
    np.testing.assert_allclose(backward.start_force, -forward.end_force, rtol=1e-12)
    np.testing.assert_allclose(backward.end_moment, -forward.start_moment, rtol=0, atol=1e-7 * float(rod.EI))


def test_nonlinear_cg_is_refused():
    scene = Scene(problems.cable(), CLAMP, Free(moment=(0, 1e-3, 0)))
    message = "solver must be a Newton for a dead moment on a free end, which no energy is minimal under"
    with pytest.raises(ValueError, match=message):
        rj.solve(scene, solver=rj.NonlinearCG())
    with pytest.raises(ValueError, match=message):
        rj.solve_path([scene, scene], solver=rj.NonlinearCG())


def test_documentation_says_that_stability_is_not_examined():
    assert "dead moment" in rj.Equilibrium.__doc__.split("`stable`")[1].split("`iterations`")[0]


def test_clips_and_a_clamp_bear_a_moment_on_the_end():
    """In balance as a whole, and the same by tangents and by frames."""
    moment = np.array([0.4, 1.0, 0.5])
    clips = [Clip(0.3, (0.28, 0.0, 0.02)), Clip(0.6, (0.55, 0.1, 0.05), tangent=(1.0, 0.2, 0.0))]
    found = []
    for EI in (1.0, (1.0, 1.0)):
        scene = Scene(Rod(1.0, EI, 0.7, 1e4), CLAMP, Free(force=(0.0, 2.0, -3.0), moment=moment), clips=clips)
        result = rj.solve(scene, segments=10)
        assert result.converged
        forces, moments = np.asarray(result.clip_forces), np.asarray(result.clip_moments)
        # The residual of 1e-8, summed over the rod.
        np.testing.assert_allclose(-result.start_force + np.sum(forces, axis=0) + scene.end.force, 0.0, atol=1e-7)
        about_start = moment + np.cross(result.nodes[-1], scene.end.force) + np.sum(moments, axis=0)
        about_start += np.sum(np.cross([clip.position for clip in clips], forces), axis=0)
        np.testing.assert_allclose(about_start, result.start_moment, atol=1e-6)
        found.append(result)
    # Each as far from the continuum as its estimate says.
    np.testing.assert_allclose(found[0].nodes, found[1].nodes, atol=1.5 * sum(float(r.error_estimate) for r in found))
