"""Supports and scenes: what is accepted, what is refused and why, units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax import Clamp, Free, Pin, PointForce, Rod, Scene, Swivel, frame
from rodjax.scene import nondimensional

ROD = Rod(2.0, EI=3.0, GJ=2.0, EA=500.0, mass_per_length=0.5)
LEVEL = frame((1, 0, 0))
CLAMP, SWIVEL, PIN = Clamp((0, 0, 0), LEVEL), Swivel((0, 0, 0), (1, 0, 0)), Pin((0, 0, 0))


def test_frame_is_a_rotation_with_the_given_tangent():
    matrix = frame((1, 2, 3), (0, 1, 0))
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(jnp.linalg.det(matrix), 1.0)
    np.testing.assert_allclose(matrix[:, 2], np.array([1, 2, 3]) / np.sqrt(14))
    assert matrix[1, 1] > 0
    assert abs(matrix[:, 1] @ np.array([3.0, 0, -1])) < 1e-15  # d2 stays in the plane of t and the given d2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: frame((0, 1, 0)), "d2 must not be parallel to the tangent"),
        (lambda: frame((0, 0, 0)), "tangent must be a direction, got the zero vector"),
        (lambda: Clamp((0, 0, 0), 2 * np.eye(3)), "frame must be a rotation"),
        (lambda: Clamp((0, 0, 0), np.diag([1.0, 1, -1])), "frame must be right-handed"),
        (lambda: Clamp((0, 0, 0), np.full((3, 3), np.nan)), "frame must be finite"),
        (lambda: Clamp((0, 0), np.eye(3)), r"position must be numbers of shape \(3,\), got an array of shape \(2,\)"),
        (lambda: Clamp((0, 0, np.inf), np.eye(3)), "position must be finite"),
        (lambda: Clamp(None, np.eye(3)), "position must be numbers"),
        (lambda: Swivel((0, 0, 0), (0, 0, 0)), "tangent must be a direction"),
        (lambda: Free(force=(1, 2)), r"force must be numbers of shape \(3,\)"),
        (lambda: PointForce(-1.0, (0, 0, 1)), "at must not be negative"),
    ],
)
def test_bad_supports_and_loads_are_refused(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()


GRAVITY = (0, 0, -9.81)


@pytest.mark.parametrize(
    ("start", "end", "options", "message"),
    [
        (Free(), Free(), dict(gravity=GRAVITY), "hold no position"),
        (PIN, Free(), {}, "the rod can turn freely about the pin"),
        (Free(moment=(0, 0, 1)), SWIVEL, {}, "a moment on a free end needs a Clamp"),
        (PIN, Free(moment=(0, 0, 1)), dict(gravity=GRAVITY), "a moment on a free end needs a Clamp"),
        (CLAMP, SWIVEL, dict(turns=1), "turns need a Clamp at both ends"),
        (CLAMP, CLAMP, dict(turns=0.5), "turns must be a whole number, got 0.5"),
        (CLAMP, Clamp((3.1, 0, 0), LEVEL), {}, "the ends are 3.1 m apart, .* 2 m reaches at most 3 m"),
        (CLAMP, Free(), dict(point_forces=[PointForce(2.5, (0, 0, 1))]), r"point_forces\[0\].at must lie in 0 to 2 m"),
        (CLAMP, Free(), dict(point_forces=[(1, 2, 3)]), r"point_forces\[0\] must be a PointForce"),
        (CLAMP, "free", {}, "end must be a Support"),
        (CLAMP, Free(), dict(gravity=9.81), r"gravity must be numbers of shape \(3,\)"),
    ],
)
def test_scenes_without_an_equilibrium_are_refused(start, end, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Scene(ROD, start, end, **options)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (CLAMP, CLAMP),
        (CLAMP, SWIVEL),
        (SWIVEL, SWIVEL),
        (PIN, CLAMP),
        (PIN, SWIVEL),
        (PIN, PIN),
        (Free(), CLAMP),
        (SWIVEL, Free()),
    ],
)
def test_determinate_supports_are_accepted(start, end):
    Scene(ROD, start, end)


def test_structure_is_static_and_numbers_are_leaves():
    scene = Scene(ROD, CLAMP, Free(force=(0, 0, -1)))
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(scene)]
    assert names == [f".rod.{n}" for n in ("length", "EI", "GJ", "EA", "mass_per_length")] + [
        ".start.position",
        ".start.frame",
        ".end.force",
    ]
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(scene))


def test_nondimensional_scene():
    scene = Scene(ROD, Clamp((1, 1, 0), LEVEL), Clamp((2, 1, 0), LEVEL), GRAVITY, [PointForce(0.5, (0, 0, 6.0))])
    scaled, units = nondimensional(scene)
    np.testing.assert_allclose([scaled.rod.length, scaled.rod.EI, scaled.rod.mass_per_length], 1.0)
    np.testing.assert_allclose([units.energy, units.force], [1.5, 0.75])
    np.testing.assert_allclose(scaled.rod.GJ, 2 / 3)
    np.testing.assert_allclose(scaled.rod.EA, 500 * 2**2 / 3)  # EA L^2/EI
    np.testing.assert_allclose(scaled.end.position, [0.5, 0, 0])
    np.testing.assert_allclose(scaled.gravity[2], -0.5 * 9.81 * 2**3 / 3)  # w L^3/EI
    np.testing.assert_allclose(scaled.point_forces[0].force[2], 6 * 2**2 / 3)  # F L^2/EI
    np.testing.assert_allclose(scaled.point_forces[0].at, 0.25)
