"""Loads along a part of the rod."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj

LEVEL = rj.frame((1, 0, 0))
CLAMP = rj.Clamp((0, 0, 0), LEVEL)
A, B = 0.25, 0.6
ROD = rj.Rod(1.0, 1.0, 0.8, 1e4)


def loaded(*loads, end=None) -> rj.Scene:
    return rj.Scene(ROD, CLAMP, rj.Free() if end is None else end, distributed=loads)


def test_a_cantilever_under_a_load_on_a_part():
    """w(L) = int_A^B q s^2 (3 L - s)/(6 EI) ds, the derivative by q at none; 16 elements."""

    def tip(force, part):
        return rj.solve(loaded(rj.DistributedForce(force, part=part)), segments=16).nodes[-1, 2]

    def integral(s):
        return (s**3 - s**4 / 4) / 6

    part = jnp.array([A, B])
    np.testing.assert_allclose(jax.jacfwd(tip)(jnp.zeros(3), part)[2], integral(B) - integral(A), rtol=1e-6)
    # By the ends of the part: -q s^2 (3 L - s)/(6 EI) and its reverse, to what large deflections change.
    force, h = jnp.array([0.0, 0.0, 1e-3]), 1e-4
    found = jax.jacfwd(tip, argnums=1)(force, part)
    expected = [1e-3 * sign * s**2 * (3 - s) / 6 for s, sign in ((A, -1), (B, 1))]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    differences = [(tip(force, part + h * step) - tip(force, part - h * step)) / (2 * h) for step in jnp.eye(2)]
    np.testing.assert_allclose(found, differences, rtol=1e-5)


def test_couples_on_a_part_bend_it_to_arcs():
    """Beyond the part nothing bends, before it all of the couple does."""
    couple = 0.7
    result = rj.solve(loaded(rj.DistributedCouple((0, -couple, 0), part=(A, B))), segments=16)
    angle = couple * (A * (B - A) + (B - A) ** 2 / 2)
    np.testing.assert_allclose(result.tangents[-1], [math.cos(angle), 0, math.sin(angle)], atol=1e-9)
    at = np.asarray(result.s)
    np.testing.assert_allclose(result.curvature, couple * np.clip(B - at, 0, B - A), atol=1e-8)


@pytest.mark.parametrize("discretization", ["hermite", "finite_difference"])
def test_parts_add_up(discretization):
    """Three parts with one force are the whole, and the supports carry what there is."""
    force = (1.0, -2.0, 3.0)
    ends = rj.Clamp((0.9, 0.1, 0), LEVEL)
    parts = [rj.DistributedForce(force, part=part) for part in ((0, A), (A, B), (B, 1.0))]
    options = {"segments": 20, "discretization": discretization}  # with nodes at A and B anyhow
    whole, split = (rj.solve(loaded(*loads, end=ends), **options) for loads in ((rj.DistributedForce(force),), parts))
    np.testing.assert_allclose(split.nodes, whole.nodes, atol=1e-10)
    np.testing.assert_allclose(split.energy, whole.energy, rtol=1e-10)
    alone = rj.solve(loaded(parts[1], end=ends), **options)
    np.testing.assert_allclose(alone.start_force - alone.end_force, (B - A) * np.array(force), atol=1e-8)


@pytest.mark.slow
def test_elements_converge_to_the_continuum():
    """Dead and follower forces and couples on parts; the estimated error is the true one."""
    scene = loaded(
        rj.DistributedForce((0, 0, 4.0), follower=True, part=(A, 1.0)),
        rj.DistributedForce((0, 3.0, -1.0), part=(0.0, B)),
        rj.DistributedCouple((0.3, 0.2, 0.1), part=(A, B)),
    )
    found = {n: rj.solve(scene, segments=n) for n in (8, 16, 32)}
    continuum = rj.solve_continuum(scene, guess=found[32])
    np.testing.assert_allclose(found[32].nodes, continuum.nodes, atol=2e-7)
    np.testing.assert_allclose(found[32].start_moment, continuum.start_moment, atol=1e-5)
    np.testing.assert_allclose(found[32].energy, continuum.energy, rtol=1e-5)
    for n in (8, 16):
        # The meshes have nodes at A and B, each at other places besides.
        error = np.max(np.linalg.norm(found[n].nodes - continuum.position_at(found[n].s), axis=1))
        assert 0.5 < error / found[n].error_estimate < 2


def test_files_keep_parts(tmp_path):
    scene = loaded(
        rj.DistributedForce((0, 0, 1.0), follower=True, part=(A, 1.0)), rj.DistributedCouple((0, 1.0, 0), part=(A, B))
    )
    result = rj.solve(scene, segments=8)
    rj.save(result, tmp_path / "part.vtkhdf")
    rj.write_scene(scene, tmp_path / "part.toml")
    for read in (rj.load(tmp_path / "part.vtkhdf").scene, rj.read_scene(tmp_path / "part.toml")):
        for value, expected in zip(jax.tree.leaves(read), jax.tree.leaves(scene), strict=True):
            np.testing.assert_array_equal(value, expected)


@pytest.mark.parametrize("part", [(0.5, 0.5), (0.6, 0.5), (-0.1, 0.5), (0.5, 1.5), (0.5,), (0.1, np.nan)])
def test_a_wrong_part_is_named(part):
    with pytest.raises(ValueError, match="part must"):
        loaded(rj.DistributedForce((0, 0, 1.0), part=part))
