"""Rods whose axis has another length without stress, as of a heated or shrunk part."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj

LEVEL = rj.frame((1, 0, 0))
CLAMP = rj.Clamp((0, 0, 0), LEVEL)
EA = 500.0
PART = rj.Steps([0.4], [0.0, 0.02])
SMOOTH = rj.Smooth([0.0, 0.5, 1.0], [0.0, 0.02, 0.05])


def rod(strain, **more) -> rj.Rod:
    return rj.Rod(1.0, (1.0, 2.0), 0.8, EA, rest_strain=strain, mass_per_length=1.0, radius=0.01, **more)


@pytest.mark.parametrize("discretization", ["hermite", "finite_difference"])
def test_a_free_rod_is_longer_and_a_held_one_pressed(discretization):
    """By the mean of the strain; the force is that of EA."""
    free = rj.solve(rj.Scene(rod(PART), CLAMP, rj.Free()), segments=10, discretization=discretization)
    np.testing.assert_allclose(free.nodes[-1], [1.012, 0, 0], atol=1e-14)
    np.testing.assert_allclose(free.axial_strain[jnp.array([0, -1])], [0, 0.02], atol=1e-14)
    np.testing.assert_allclose(free.elastic_energy, 0, atol=1e-20)
    held = rj.solve(rj.Scene(rod(PART), CLAMP, rj.Clamp((1, 0, 0), LEVEL)), segments=10, discretization=discretization)
    np.testing.assert_allclose(held.tension, np.full(11, -EA * 0.012), rtol=1e-10)
    np.testing.assert_allclose(held.elastic_energy, EA / 2 * 0.012**2, rtol=1e-10)


@pytest.mark.parametrize("strain", [0.03, SMOOTH, PART], ids=["constant", "smooth", "part"])
def test_a_curved_rod_is_free_of_stress_at_its_rest_ends(strain):
    """On any mesh, to rounding."""
    curved = rod(strain, rest_curvature=(1.0, 0.5), rest_twist=0.7)
    _, (position, frame) = curved.rest_ends((0, 0, 0), LEVEL)
    for discretization in ("hermite", "finite_difference"):
        scene = rj.Scene(curved, CLAMP, rj.Clamp(position, frame))
        result = rj.solve(scene, segments=8 if strain is not PART else 10, discretization=discretization)
        np.testing.assert_allclose(result.elastic_energy, 0, atol=1e-20)
        np.testing.assert_allclose(result.tension, 0, atol=1e-9)


def test_a_heated_column_buckles():
    """Between clamps at EA strain = 4 pi^2 EI/L^2, as its length stays; 16 elements are off by 1e-5 of it."""
    critical = 4 * math.pi**2 / EA
    for part, buckles in ((0.999, False), (1.001, True)):
        column = rj.Rod(1.0, 1.0, 0.8, EA, rest_strain=part * critical)
        scene = rj.Scene(column, CLAMP, rj.Clamp((1, 0, 0), LEVEL))
        result = rj.solve(scene, segments=16, planar=True, strain_limit=np.inf)
        assert result.converged
        assert (np.max(np.abs(result.nodes[:, 1:])) > 1e-3) == buckles


@pytest.mark.slow
def test_elements_converge_to_the_continuum():
    """With shear and curvature at rest; the estimated error is the true one."""
    curved = rod(0.03, rest_curvature=(1.0, 0.5), GA=(40.0, 60.0))
    scene = rj.Scene(curved, CLAMP, rj.Clamp((0.9, 0.1, 0), rj.frame((1, 0.2, 0))), gravity=(0, 0, -9.0))
    found = {n: rj.solve(scene, segments=n, strain_limit=np.inf) for n in (8, 16, 32)}
    continuum = rj.solve_continuum(scene, guess=found[32])
    np.testing.assert_allclose(found[32].nodes, continuum.nodes, atol=2e-7)
    np.testing.assert_allclose(found[32].axial_strain, continuum.axial_strain, atol=2e-7)
    np.testing.assert_allclose(found[32].energy, continuum.energy, rtol=1e-6)
    errors = [np.max(np.linalg.norm(found[n].nodes - continuum.nodes[:: 32 // n], axis=1)) for n in (8, 16)]
    assert 3.7 < math.log2(errors[0] / errors[1]) < 4.5
    for n, error in zip((8, 16), errors, strict=True):
        assert 0.7 < error / found[n].error_estimate < 1.4


def test_gradients_by_the_strain():
    """Against the closed form of a held rod, and differences of a hanging one."""

    def tension(strain):
        return rj.solve(rj.Scene(rod(strain), CLAMP, rj.Clamp((1, 0, 0), LEVEL)), segments=4).tension[0]

    np.testing.assert_allclose(jax.grad(tension)(jnp.array(0.01)), -EA, rtol=1e-10)

    def middle(strain):
        end = rj.Clamp((0.8, 0.1, 0.05), LEVEL)
        return rj.solve(rj.Scene(rod(strain), CLAMP, end, gravity=(0, 0, -5.0)), segments=8).nodes[4]

    h = 1e-5
    expected = (middle(jnp.array(0.01 + h)) - middle(jnp.array(0.01 - h))) / (2 * h)
    np.testing.assert_allclose(jax.jacfwd(middle)(jnp.array(0.01)), expected, rtol=1e-6, atol=1e-9)


def test_files_keep_the_strain(tmp_path):
    result = rj.solve(rj.Scene(rod(PART), CLAMP, rj.Free()), segments=10)
    rj.save(result, tmp_path / "heated.vtkhdf")
    np.testing.assert_array_equal(rj.load(tmp_path / "heated.vtkhdf").scene.rod.rest_strain.values, PART.values)
    for strain in (0.002, SMOOTH, PART):
        scene = rj.Scene(rod(strain), CLAMP, rj.Free())
        rj.write_scene(scene, tmp_path / "heated.toml")
        read = rj.read_scene(tmp_path / "heated.toml")
        for value, expected in zip(jax.tree.leaves(read), jax.tree.leaves(scene), strict=True):
            np.testing.assert_array_equal(value, expected)


@pytest.mark.parametrize(
    ("strain", "message"),
    [
        (-1.0, "rest_strain must be above -1"),
        (rj.Steps([0.5], [0.0, -2.0]), "rest_strain must be above -1"),
        (rj.Steps([2.0], [0.0, 0.1]), "rest_strain.jumps must lie inside 0 to 1 m"),
    ],
)
def test_a_wrong_strain_is_named(strain, message):
    with pytest.raises(ValueError, match=message):
        rod(strain)
