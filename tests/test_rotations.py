"""Quaternions against the rotations of SciPy."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from rodjax.geometry.rotations import (
    align_tangent,
    carried,
    columns,
    continuous,
    from_frame,
    inverse,
    nearer,
    product,
    rotate_about_tangent,
    rotated,
    screw,
    tangent,
    turned,
)


def random(count: int, seed: int = 0) -> tuple[jnp.ndarray, Rotation]:
    rotations = Rotation.random(count, random_state=seed)
    x, y, z, w = rotations.as_quat().T
    return jnp.asarray(np.stack([w, x, y, z])), rotations


def matrices(q) -> np.ndarray:
    return np.moveaxis(np.asarray(columns(q)), 2, 0)


def test_products_inverses_and_directors():
    (a, of_a), (b, of_b) = random(20), random(20, 1)
    np.testing.assert_allclose(matrices(product(a, b)), (of_a * of_b).as_matrix(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(matrices(inverse(a)), of_a.inv().as_matrix(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(tangent(a).T, of_a.as_matrix()[..., 2], rtol=0, atol=1e-14)
    vector = np.random.default_rng(2).normal(size=(3, 20))
    np.testing.assert_allclose(rotated(a, jnp.asarray(vector)).T, of_a.apply(vector.T), rtol=0, atol=1e-14)


def test_frames_and_back():
    """Also of half turns, where one component of the quaternion is zero."""
    q, rotations = random(50)
    half_turns = [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)]
    for rotation in [*rotations, *half_turns, Rotation.identity()]:
        matrix = rotation.as_matrix()
        np.testing.assert_allclose(columns(from_frame(jnp.asarray(matrix))), matrix, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(nearer(-q, q), q)


def test_turns_spins_and_swings():
    q, rotations = random(20)
    vector = np.random.default_rng(2).normal(size=(3, 20))
    size = np.linalg.norm(vector, axis=0)
    angle = 2 * np.arctan(size / 2)
    expected = rotations * Rotation.from_rotvec((angle / size * vector).T)
    np.testing.assert_allclose(matrices(turned(q, jnp.asarray(vector))), expected.as_matrix(), rtol=0, atol=1e-14)
    spin = rotations * Rotation.from_rotvec(angle[:, None] * np.array([0, 0, 1]))
    np.testing.assert_allclose(
        matrices(rotate_about_tangent(q, jnp.asarray(angle))), spin.as_matrix(), rtol=0, atol=1e-14
    )
    # The smallest rotation to a new tangent has its axis at right angles to both.
    new = vector / size
    swing = align_tangent(q, jnp.asarray(new))
    np.testing.assert_allclose(tangent(swing), new, rtol=0, atol=1e-14)
    axis = np.asarray(product(swing, inverse(q)))[1:]
    np.testing.assert_allclose(np.sum(axis * np.asarray(tangent(q)), axis=0), np.zeros(20), rtol=0, atol=1e-14)


def test_a_frame_is_carried_without_twist():
    """Along a circle it turns about the axis of the circle; and of either sign of quaternions one is kept."""
    angles = np.linspace(0, 6, 25)
    tangents = jnp.asarray(np.stack([np.sin(angles), 0 * angles, np.cos(angles)]))
    q = carried(jnp.array([1.0, 0.0, 0.0, 0.0]), tangents)
    expected = Rotation.from_rotvec(angles[:, None] * np.array([0, 1, 0])).as_matrix()
    np.testing.assert_allclose(matrices(q), expected, rtol=0, atol=1e-14)
    signs = np.where(np.arange(25) % 3 == 1, -1.0, 1.0)
    np.testing.assert_array_equal(continuous(q * signs[None]), q)


def test_screws_of_large_and_small_angles():
    """Beside many small steps of the same motion; the series joins on at the angle 0.01."""
    for size in (1e-9, 1e-5, 0.00999, 0.01001, 1.0, 5.0):
        rate, velocity = size * np.array([0.6, 0.0, 0.8]), np.array([0.3, -0.2, 1.0])
        q, way = screw(jnp.asarray(rate), jnp.asarray(velocity))
        np.testing.assert_allclose(columns(q), Rotation.from_rotvec(rate).as_matrix(), rtol=0, atol=1e-14)
        middles = (np.arange(2000) + 0.5) / 2000
        expected = np.mean(Rotation.from_rotvec(middles[:, None] * rate[None]).apply(velocity), axis=0)
        # The rule of the middle point leaves (size/2000)^2/24.
        np.testing.assert_allclose(way, expected, rtol=0, atol=1e-14 + size**2 * 1e-7)
