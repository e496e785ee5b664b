"""Derivatives of joints against automatic ones, bases of tangents, rotations, curvature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rodjax import Rod
from rodjax.discretization.joints import (
    JointDerivatives,
    Joints,
    bending_derivatives,
    rotated,
    rotated_together,
    tangent_bases,
    twist_derivatives,
)
from rodjax.mechanics.strain import swept_angle

ROD = Rod(1.0, EI=2.0, GJ=3.0, EA=5.0)
SPACING = 0.1
# Straight joints, slightly and strongly bent ones, and one bent by 170 degrees.
ANGLES = np.radians([0.0, 0.0, 1e-6, 1.0, 30.0, 95.0, 140.0, 170.0])


@pytest.fixture(scope="module")
def bent() -> Joints:
    rng = np.random.default_rng(0)
    before = rng.normal(size=(len(ANGLES), 3))
    before /= np.linalg.norm(before, axis=1)[:, None]
    axis = np.cross(before, rng.normal(size=(len(ANGLES), 3)))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    after = Rotation.from_rotvec(ANGLES[:, None] * axis).apply(before)
    return Joints(jnp.asarray(before.T), jnp.asarray(after.T), jnp.full(len(ANGLES), SPACING))


def beside(joints: Joints) -> tuple[jax.Array, jax.Array]:
    return tangent_bases(joints.before), tangent_bases(joints.after)


def turned(joints: Joints, rotations: jax.Array) -> Joints:
    """By `rotations` (4, k): two numbers for the tangents before, two for those after."""
    before_basis, after_basis = beside(joints)
    before = rotated(joints.before, before_basis, rotations[:2])
    return Joints(before, rotated(joints.after, after_basis, rotations[2:]), joints.spacing)


def automatic(function, joints: Joints) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (k, 4) and Hessian (k, 4, 4) of a function (k,) of the joints, one by one, by the rotations."""

    def of_one(rotations, k):
        one = jax.tree.map(lambda x: x[..., k][..., None], joints)
        return function(turned(one, rotations[:, None]), one)[0]

    both = jax.jit(jax.vmap(lambda k: (jax.grad(of_one)(jnp.zeros(4), k), jax.hessian(of_one)(jnp.zeros(4), k))))
    gradient, hessian = both(jnp.arange(joints.before.shape[1]))
    return np.asarray(gradient), np.asarray(hessian)


def matrices(derivatives: JointDerivatives) -> tuple[np.ndarray, np.ndarray]:
    gradient = np.concatenate([derivatives.before, derivatives.after]).T
    coupling = np.asarray(derivatives.after_before)
    rows = [
        np.concatenate([derivatives.before_before, coupling.swapaxes(0, 1)], axis=1),
        np.concatenate([coupling, derivatives.after_after], axis=1),
    ]
    return gradient, np.concatenate(rows).transpose(2, 0, 1)


def assert_close_joint_by_joint(ours: np.ndarray, expected: np.ndarray, rtol: float) -> None:
    """To `rtol` of the largest entry of each joint."""
    for k, (one, other) in enumerate(zip(ours, expected, strict=True)):
        largest = max(1.0, np.max(np.abs(other)))
        np.testing.assert_allclose(one, other, rtol=0, atol=rtol * largest, err_msg=f"joint {k}")


def bending_energy_of_each(joints: Joints) -> jax.Array:
    """EI/2 (2 tan(a/2)/h)^2 h, by the angle's cosine."""
    cosine = jnp.sum(joints.before * joints.after, axis=0)
    return ROD.EI / 2 * 4 * (1 - cosine) / (1 + cosine) / joints.spacing


def test_bending_derivatives_are_those_of_the_energy(bent):
    ours = matrices(bending_derivatives(ROD, bent, beside(bent)))
    for one, other in zip(ours, automatic(lambda joints, _: bending_energy_of_each(joints), bent), strict=True):
        # 1 + cos of 170 degrees is 0.015: cancellation costs two digits, a second derivative twice as many.
        assert_close_joint_by_joint(one, other, rtol=1e-11)


def test_twist_derivatives_are_those_of_the_swept_angle(bent):
    def twist(joints, reference):
        return swept_angle(joints.before, joints.after, reference.before, reference.after)

    ours = matrices(twist_derivatives(bent, beside(bent)))
    for one, other in zip(ours, automatic(twist, bent), strict=True):
        assert_close_joint_by_joint(one, other, rtol=1e-11)  # as above


def test_gauss_newton_is_semidefinite_everywhere_and_exact_where_straight(bent):
    gradient, hessian = matrices(bending_derivatives(ROD, bent, beside(bent)))
    same, ours = matrices(bending_derivatives(ROD, bent, beside(bent), gauss_newton=True))
    np.testing.assert_array_equal(same, gradient)
    for k in range(len(ANGLES)):
        eigenvalues = np.linalg.eigvalsh(ours[k])
        assert eigenvalues[0] >= -1e-13 * eigenvalues[-1]  # zero up to rounding: rigid rotations strain nothing
        assert np.sum(eigenvalues > 1e-6 * eigenvalues[-1]) == 2
    straight = ANGLES == 0.0
    np.testing.assert_allclose(ours[straight], hessian[straight], rtol=0, atol=1e-12 * 1 / SPACING)
    assert np.linalg.eigvalsh(hessian[-2])[0] < 0  # what there is to mend


def test_energy_and_curvature_of_an_angle(bent):
    curvature = 2 * np.tan(ANGLES / 2) / SPACING
    # Squared differences of unit vectors: 1e-16 absolute, over h^2; near a fold over 4 - d.d = 0.03 as well.
    np.testing.assert_allclose(bent.squared_curvature, curvature**2, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(bent.bending_energy(ROD), 2.0 / 2 * SPACING * np.sum(curvature**2), rtol=1e-13)


POLES = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0.6, 0.8, -0.0], [6e-9, 8e-9, -1]])


@pytest.mark.parametrize("tangents", [POLES, np.random.default_rng(1).normal(size=(50, 3))], ids=["poles", "random"])
def test_bases_are_orthonormal_and_right_handed(tangents):
    tangents = tangents / np.linalg.norm(tangents, axis=1)[:, None]
    bases = np.asarray(tangent_bases(jnp.asarray(tangents.T)))
    frames = np.concatenate([bases, tangents.T[:, None]], axis=1).transpose(2, 0, 1)
    # A few roundings; division by 1 + |z| amplifies none.
    np.testing.assert_allclose(frames.swapaxes(1, 2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, rtol=1e-14)


def test_rotations_turn_by_their_angle_and_keep_the_length(bent):
    bases = tangent_bases(bent.before)
    rotation = jnp.asarray(np.random.default_rng(2).normal(size=(2, len(ANGLES))))
    moved = np.asarray(rotated(bent.before, bases, rotation))
    np.testing.assert_allclose(np.linalg.norm(moved, axis=0), 1.0, rtol=1e-14)
    axis = np.cross(bent.before.T, np.sum(bases * rotation[None], axis=1).T)
    np.testing.assert_allclose(moved.T, Rotation.from_rotvec(axis).apply(np.array(bent.before.T)), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(rotated(bent.before, bases, jnp.zeros_like(rotation)), bent.before)


def test_derivatives_at_no_rotation(bent):
    """t + b.r - t r.r/2 to second order: not NaN, and that of a great circle."""
    one = Joints(bent.before[:, :1], bent.after[:, :1], bent.spacing[:1])
    basis = tangent_bases(one.before)

    def moved(rotation):
        return rotated(one.before, basis, rotation[:, None])[:, 0]

    first, second = jax.jit(lambda r: (jax.jacfwd(moved)(r), jax.hessian(moved)(r)))(jnp.zeros(2))
    np.testing.assert_allclose(first, basis[..., 0], rtol=0, atol=1e-15)
    expected = -np.asarray(one.before)[:, 0, None, None] * np.eye(2)
    np.testing.assert_allclose(second, expected, rtol=0, atol=1e-15)


def test_a_rod_that_turns_as_a_whole_keeps_its_shape(bent):
    tangents = bent.before
    bases = tangent_bases(tangents)
    turn = np.array([0.3, -0.5, 0.6])
    rotation = jnp.einsum("cbn,cn->bn", bases, np.cross(turn, tangents.T).T)
    moved = rotated_together(tangents, bases, rotation)
    # `LEAST_SEEN` of the turn is taken off, of which tangents in all directions show two thirds; great circles miss by
    # its square.
    np.testing.assert_allclose(moved.T, Rotation.from_rotvec(turn).apply(np.array(tangents.T)), rtol=0, atol=2e-3)
    assert np.max(np.abs(moved - rotated(tangents, bases, rotation))) > 0.1
    np.testing.assert_allclose(np.linalg.norm(moved, axis=0), 1.0, rtol=1e-14)
    # To first order the same: a step of 1e-6 differs by its square.
    small = rotated_together(tangents, bases, 1e-6 * rotation)
    np.testing.assert_allclose(small, rotated(tangents, bases, 1e-6 * rotation), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rotated_together(tangents, bases, 0 * rotation), tangents)

    def along(part):
        return rotated_together(tangents, bases, part * rotation)

    step = 1e-4
    second = jax.jvp(lambda part: jax.jvp(along, (part,), (1.0,))[1], (0.0,), (1.0,))[1]
    difference = (along(step) - 2 * along(0.0) + along(-step)) / step**2
    np.testing.assert_allclose(second, difference, rtol=0, atol=1e-6)  # rounding by the square of the step: 2e-8
