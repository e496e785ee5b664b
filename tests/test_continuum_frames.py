"""The continuous rod where frames matter: references, the plain rod, what elements converge to, and derivatives."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy

import rodjax as rj
from rodjax import Clamp, Free, Pin, PointForce, Rod, Scene, Smooth, Steps, Swivel, frame, solve_continuum

LEVEL = frame((1, 0, 0))
ORIGIN = (0.0, 0.0, 0.0)
# Stations and supports meet to 1e-10.
RESIDUAL = 1e-10
RESULTANTS = ("start_force", "start_moment", "end_force", "end_moment", "energy", "elastic_energy", "total_twist")


def assert_close(result: rj.Equilibrium, expected: rj.Equilibrium, atol: float, rtol: float | None = None) -> None:
    """Equal in units of the rod."""
    assert result.converged
    assert result.residual < RESIDUAL
    units = result.state.units
    scales = {"nodes": units.length, "energy": units.energy, "elastic_energy": units.energy}
    for name in ("nodes", "frames", *RESULTANTS):
        of_kind = units.force if name.endswith("_force") else units.energy if name.endswith("_moment") else 1.0
        scale = float(scales.get(name, of_kind))
        values = (np.asarray(getattr(equilibrium, name)) / scale for equilibrium in (result, expected))
        np.testing.assert_allclose(*values, atol=atol, rtol=atol if rtol is None else rtol, err_msg=name)


def test_the_bend_of_45_degrees():
    """The cantilever of Bathe & Bolourchi (1979), loaded across its plane."""
    E, R = 1e7, 100.0
    L = R * math.pi / 4
    rod = Rod(L, (E / 12, E / 12), E / 12, E, rest_curvature=(0, 1 / R))
    scene = Scene(rod, Clamp(ORIGIN, frame((1, 0, 0), d2=(0, 0, 1))), Free(force=(0, 0, 600)))
    discrete = rj.solve(scene, segments=64)
    result = solve_continuum(scene, discrete)
    np.testing.assert_allclose(result.nodes[-1, 2], 53.471763, rtol=1e-8)
    assert_close(result, discrete, atol=1e-7)
    np.testing.assert_allclose(result.curvature, discrete.curvature, rtol=1e-7)
    np.testing.assert_allclose(result.tension, discrete.tension, atol=1e-5)
    # A result is a guess, of the continuum and of a discrete solve.
    assert_close(solve_continuum(scene, result), result, atol=1e-11)
    assert rj.solve(scene, segments=64, guess=result).iterations <= 2


@pytest.mark.exhaustive
def test_a_plain_rod_is_the_same():
    supports = (Clamp(ORIGIN, LEVEL), Clamp((0.8, 0.1, 0.05), frame((1, 0.3, 0.2))))
    scenes = [
        Scene(Rod(1.0, EI, 0.7, 1e4, mass_per_length=1.0), *supports, gravity=(0, 0, -9.81)) for EI in (1.0, (1.0, 1.0))
    ]
    plain = solve_continuum(scenes[0], segments=20)
    assert_close(solve_continuum(scenes[1], plain), plain, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("end", [Clamp((0.7, 0.1, 0), frame((1, 0.2, 0.3))), Free(force=(0.0, 1.0, -2.0))])
def test_a_stiffness_that_jumps(end):
    rod = Rod(1.0, Steps([0.5], [1.0, 4.0]), 0.7, 1e4, mass_per_length=Steps([0.3], [1.0, 2.0]))
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), end, (0, 0, -9.81), [PointForce(0.3, (0.3, 1.0, 0.0))])
    discrete = rj.solve(scene, segments=128)
    # Of fourth order in 1/128.
    assert_close(solve_continuum(scene, discrete), discrete, atol=3e-7)


def spring() -> Rod:
    """One turn and a half of a helix as points, of a section that varies."""
    angle = np.linspace(0, 3 * math.pi, 41)
    points = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.05 * angle], axis=1)
    x = np.linspace(0, 1, 9)
    length = float(Rod.from_centerline(points, 1.0, 1.0, 1e4).length)
    EI = (Smooth(length * x, 1 + 0.5 * np.sin(3 * x)), 2.0)
    return Rod.from_centerline(points, EI, 0.8, 1e4, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param(Pin, marks=pytest.mark.exhaustive), Swivel])
def test_a_curve_in_space_between_supports_that_let_it_spin(kind):
    """No clamp fixes the spin: the shape at rest and the loads do."""
    rod = spring()
    (start, first), (end, last) = rod.rest_ends()
    end = end + np.array([0.02, -0.01, 0.1])
    supports = (Pin(start), Pin(end)) if kind is Pin else (Swivel(start, first[:, 2]), Swivel(end, last[:, 2]))
    load = rj.DistributedForce((0.2, 0.1, 0.0))
    scene = Scene(rod, *supports, gravity=(0, 0, -1.0), distributed=[load])
    discrete = rj.solve(scene, segments=64)
    assert_close(solve_continuum(scene, discrete), discrete, atol=1e-4)


@pytest.mark.slow
def test_a_force_that_follows_the_end():
    """A cantilever under a follower thrust of 5 EI/L^2."""
    scene = Scene(Rod(1.0, 1.0, 0.7, 1e6), Clamp(ORIGIN, LEVEL), Free(force=(-5.0, 0, 0), follower=True))
    discrete = rj.solve(scene, segments=64)
    result = solve_continuum(scene, discrete)
    np.testing.assert_allclose(result.nodes[-1], [0.17227788, 0, 0.78069], atol=1e-5)  # of an inextensible rod
    assert_close(result, discrete, atol=1e-6)
    np.testing.assert_allclose(result.end_force, result.frames[-1] @ np.array([-5.0, 0, 0]), rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_derivatives():
    """By EI1 and where the rest curvature jumps, in forward and reverse mode, against central differences."""
    rod = Rod(1.0, (1.0, 2.0), 0.7, 1e3, rest_curvature=(Steps([0.4], [1.0, -1.0]), 0.5))
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), Clamp((0.7, 0.1, 0), frame((1, 0.2, 0.3))))
    guess = solve_continuum(scene, rj.solve(scene, segments=8), intervals=4)

    def changed(x):
        def parts(scene):
            return scene.rod.EI[0], scene.rod.rest_curvature[0].jumps

        return eqx.tree_at(
            parts, scene, tuple(part + rate * x for part, rate in zip(parts(scene), (1, 0.1), strict=True))
        )

    def outputs(x):
        result = solve_continuum(changed(x), guess, intervals=4)
        return jnp.concatenate([result.end_force, result.end_moment, result.energy[None], result.nodes[4]])

    values, h = by_numpy(outputs), 1e-4
    central = (values(jnp.array(h)) - values(jnp.array(-h))) / (2 * h)
    weights = jnp.linspace(0.5, 1.5, len(central))
    both = by_numpy(lambda x: (jax.jacfwd(outputs)(x), jax.grad(lambda x: weights @ outputs(x))(x)))
    forward, reverse = both(jnp.zeros(()))
    np.testing.assert_allclose(forward, central, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-9)
