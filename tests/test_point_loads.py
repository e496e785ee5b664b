"""Couples and forces that follow the rod, at points inside it."""

import math
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.io.files import NUMBER_OF

LEVEL = rj.frame((1, 0, 0))  # d1 downwards, d2 along y
CLAMP = rj.Clamp((0, 0, 0), LEVEL)
FAR = rj.Clamp((0.9, 0.1, 0.05), LEVEL)
AT = 0.4
ROD = rj.Rod(1.0, 1.0, 0.8, 1e4, mass_per_length=0.5, radius=0.01)


def scene(end=None, **loads) -> rj.Scene:
    return rj.Scene(ROD, CLAMP, rj.Free() if end is None else end, **loads)


@pytest.mark.parametrize("follower", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_couple_bends_the_rod_before_it_to_an_arc(follower):
    """By an angle of 0.8 rad; beyond it the rod is straight. About d2, which stays."""
    couple = rj.PointCouple(AT, (0, -2.0, 0), follower=follower)
    result = rj.solve(scene(point_couples=[couple]), segments=10)
    angle = 2.0 * AT
    arc = np.array([math.sin(angle), 0, 1 - math.cos(angle)]) / 2.0
    straight = np.array([math.cos(angle), 0, math.sin(angle)])
    # Simpson's rule on an arc of 0.2 rad an element.
    np.testing.assert_allclose(result.position_at(np.array([AT, 1.0])), [arc, arc + 0.6 * straight], atol=3e-7)
    # At the couple what is just beyond it.
    np.testing.assert_allclose(result.curvature, np.where(result.s < AT - 1e-9, 2.0, 0.0), atol=1e-8)
    np.testing.assert_allclose(result.start_moment, [0, -2.0, 0], atol=1e-8)


def test_a_force_inside_is_that_on_the_end_of_a_shorter_rod():
    """A follower; what lies beyond it stays straight."""
    force = (3.0, 0.5, 1.0)  # d1, d2, t
    inside = rj.solve(scene(point_forces=[rj.PointForce(AT, force, follower=True)]), segments=20)
    short = rj.Rod(AT, 1.0, 0.8, 1e4)
    alone = rj.solve(rj.Scene(short, CLAMP, rj.Free(force, None, True)), segments=8)
    node = int(np.argmin(np.abs(inside.s - AT)))
    # Both have elements of a twentieth.
    np.testing.assert_allclose(inside.nodes[: node + 1], alone.nodes, atol=1e-10)
    np.testing.assert_allclose(inside.start_force, alone.start_force, atol=1e-8)
    beyond = alone.nodes[-1] + 0.6 * alone.tangents[-1]
    np.testing.assert_allclose(inside.nodes[-1], beyond, atol=1e-9)


@pytest.mark.slow
def test_supports_carry_a_couple():
    """The moments of the ends about the origin, with the forces there, balance it; a clip takes its part."""
    couple = np.array([0.5, -1.0, 0.7])
    clip = rj.Clip(0.7, (0.62, 0.0, 0.1), frame=LEVEL)
    for clips in ((), (clip,)):
        result = rj.solve(scene(FAR, point_couples=[rj.PointCouple(AT, couple)], clips=clips), segments=20)
        assert result.converged
        moment = result.end_moment - result.start_moment + jnp.cross(jnp.asarray(FAR.position), result.end_force)
        for k, held in enumerate(clips):
            moment += result.clip_moments[k] + jnp.cross(jnp.asarray(held.position), result.clip_forces[k])
        np.testing.assert_allclose(moment, -couple, atol=1e-7)
    # At the clip all of it is the clip's, which holds the section.
    at_clip = [
        rj.solve(scene(FAR, point_couples=couples, clips=[clip]), segments=20)
        for couples in ((rj.PointCouple(0.7, couple),), ())
    ]
    np.testing.assert_allclose(at_clip[0].nodes, at_clip[1].nodes, atol=1e-9)
    np.testing.assert_allclose(at_clip[0].clip_moments - at_clip[1].clip_moments, -couple[None], atol=1e-7)


def test_gradients_by_place_and_load():
    """Against central differences."""

    def tip(at, load):
        loads = {"point_couples": [rj.PointCouple(at, load)], "point_forces": [rj.PointForce(0.7, load, follower=True)]}
        return rj.solve(scene(gravity=(0, 0, -2.0), **loads), segments=10).nodes[-1]

    at, load, h = jnp.array(AT), jnp.array([0.3, -0.8, 0.4]), 1e-5
    found = jax.jacfwd(tip, argnums=(0, 1))(at, load)
    np.testing.assert_allclose(found[0], (tip(at + h, load) - tip(at - h, load)) / (2 * h), rtol=1e-5, atol=1e-7)
    step = jnp.array([0.0, h, 0.0])
    np.testing.assert_allclose(found[1][:, 1], (tip(at, load + step) - tip(at, load - step)) / (2 * h), rtol=1e-6)


@pytest.mark.slow
def test_elements_converge_to_the_continuum():
    """All kinds at once, also in the plane; the estimated error is the true one."""
    both = scene(
        FAR,
        gravity=(0, 0, -3.0),
        point_couples=[rj.PointCouple(AT, (0.5, -3.0, 0.7)), rj.PointCouple(0.7, (1.0, 0.5, 0.2), follower=True)],
        point_forces=[rj.PointForce(0.55, (8.0, 3.0, 1.0), follower=True), rj.PointForce(0.2, (0, 2.0, 1.0))],
    )
    found = {n: rj.solve(both, segments=n) for n in (10, 20, 40)}
    continuum = rj.solve_continuum(both, guess=found[40])
    np.testing.assert_allclose(found[40].position_at(continuum.s), continuum.nodes, atol=1e-6)
    np.testing.assert_allclose(found[40].end_moment, continuum.end_moment, atol=1e-4)
    errors = []
    for n in (10, 20):
        errors.append(np.max(np.linalg.norm(found[n].nodes - continuum.position_at(found[n].s), axis=1)))
        assert 0.5 < errors[-1] / found[n].error_estimate < 2
    assert math.log2(errors[0] / errors[1]) > 3.5


def test_files_keep_point_loads(tmp_path):
    given = scene(
        point_couples=[rj.PointCouple(AT, (0, 1.0, 0)), rj.PointCouple(0.5, (0, 1.0, 0), follower=True)],
        point_forces=[rj.PointForce(0.6, (0, 1.0, 0), follower=True), rj.PointForce(0.7, (0, 1.0, 0))],
    )
    rj.save(rj.solve(given, segments=10), tmp_path / "loads.vtkhdf")
    rj.write_scene(given, tmp_path / "loads.toml")
    reads: Any = rj.load(tmp_path / "loads.vtkhdf").scene, rj.read_scene(tmp_path / "loads.toml")
    for read in reads:
        assert [load.follower for load in (*read.point_couples, *read.point_forces)] == [False, True, True, False]
        for value, expected in zip(jax.tree.leaves(read), jax.tree.leaves(given), strict=True):
            np.testing.assert_array_equal(value, expected)


def test_point_forces_of_older_files_are_dead(tmp_path):
    """Files until format 12 say nothing of it."""
    path = tmp_path / "old.vtkhdf"
    given = scene(point_forces=[rj.PointForce(0.7, (0, 0, 0.1))])
    rj.save(rj.solve(given, segments=10), path)
    with h5py.File(path, "r+") as file:
        file["rodjax"].attrs["format"] = 12
        del file["rodjax/scene/point_forces/0"].attrs["follower"], file["rodjax/scene/point_couples"]
        attributes = file["rodjax/scene"].attrs
        for name in [name for name in attributes if name.startswith(NUMBER_OF)]:  # nor how many entries there are
            del attributes[name]
    (force,) = rj.load(path).scene.point_forces
    assert not force.follower
    assert rj.load(path).scene.point_couples == ()
    np.testing.assert_array_equal(force.force, given.point_forces[0].force)


def test_wrong_point_loads_are_named():
    for loads, message in (
        (
            {"point_couples": [rj.PointCouple(1.0, (0, 0, 1))]},
            r"point_couples\[0\].at must lie inside 0 to 1 m, got 1 m",
        ),
        ({"point_forces": [rj.PointForce(0.0, (0, 0, 1), follower=True)]}, r"point_forces\[0\].at must lie inside"),
    ):
        with pytest.raises(ValueError, match=message):
            scene(**loads)
    with pytest.raises(TypeError, match=r"point_couples\[0\] must be a PointCouple"):
        scene(point_couples=[rj.PointForce(0.5, (0, 0, 1))])
    follower: Any = 1
    with pytest.raises(TypeError, match="follower must be a bool"):
        rj.PointForce(0.5, (0, 0, 1), follower=follower)
    with pytest.raises(ValueError, match="discretization must be 'hermite' under couples"):
        rj.solve(scene(point_couples=[rj.PointCouple(0.5, (0, 0, 1))]), discretization="finite_difference")
