"""The discretized energy: derivatives, invariance, absent terms, total twist."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import GRAVITY, ORIGIN, loaded_scenes
from scipy.spatial.transform import Rotation

from rodjax import Clamp, Free, Pin, PointForce, Scene, Swivel, frame, problems
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.first_twist import FirstTwist
from rodjax.model.scene import nondimensional

N = 8


def begin(scene: Scene, seed: int = 0) -> tuple[FiniteDifference, Polyline]:
    """The scene on a rough helix-like shape, with a twist of about 4 rad where it has torsion."""
    scaled, _ = nondimensional(scene)
    s = np.linspace(0, 1, N + 1)
    rough = 0.01 * np.random.default_rng(seed).normal(size=(N + 1, 3))
    nodes = np.stack([0.5 * s, 0.2 * np.sin(4 * s), 0.3 * np.cos(3 * s)], axis=1) + rough
    return FiniteDifference.begin(scaled, Polyline.through(jnp.asarray(nodes)), FirstTwist(jnp.array(4.0)))


@pytest.mark.parametrize("name", ["clamps", "clamp-swivel", "pins", "cantilever"])
def test_gradient_is_the_derivative_of_the_energy(name):
    problem, polyline = begin(loaded_scenes()[name])
    _, gradient = jax.jit(lambda polyline: problem.energy_and_gradient(polyline))(polyline)
    energy = jax.jit(lambda displacement: problem.energies(problem.displaced(polyline, displacement)).total)
    step = 1e-6
    for k in np.ndindex(gradient.shape):
        energies = [energy(jnp.zeros_like(gradient).at[k].set(sign * step)) for sign in (1, -1)]
        # Central differences with step h: truncation h^2 EA N^2, rounding eps EA/h; EA is 1600 here.
        np.testing.assert_allclose(gradient[k], (energies[0] - energies[1]) / (2 * step), rtol=1e-7, atol=1e-6)


def last_frame_without_twist(frame, polyline: Polyline) -> np.ndarray:
    """The frame of a clamp at the start, carried to the last edge by smallest rotations."""
    tangents = np.asarray(polyline.edges) / np.linalg.norm(polyline.edges, axis=1)[:, None]
    carried = np.asarray(frame)
    for tangent in tangents:
        axis = np.cross(carried[:, 2], tangent)
        angle = np.arctan2(np.linalg.norm(axis), carried[:, 2] @ tangent)
        carried = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix() @ carried
    return carried


def test_total_twist_is_that_of_carried_frames():
    problem, polyline = begin(loaded_scenes()["clamps"])
    for seed in range(3):
        noise = 0.003 * np.random.default_rng(seed).normal(size=(N - 1, 3))
        displaced = problem.displaced(polyline, jnp.asarray(noise))
        carried = last_frame_without_twist(problem.scene.start.frame, displaced)
        end = np.asarray(problem.scene.end.frame)
        axis = np.cross(carried[:, 2], end[:, 2])
        smallest = Rotation.from_rotvec(
            axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), carried[:, 2] @ end[:, 2])
        )
        d1 = smallest.as_matrix() @ carried[:, 0]
        angle = np.arctan2(end[:, 2] @ np.cross(d1, end[:, 0]), d1 @ end[:, 0])
        twist = float(problem.total_twist(displaced))
        assert abs(twist - problem.total_twist(polyline)) < 1.0
        np.testing.assert_allclose(np.exp(1j * twist), np.exp(1j * angle), atol=1e-13)


def test_energy_is_invariant_under_rigid_motions():
    scene = loaded_scenes()["clamps"]
    scene = Scene(scene.rod, scene.start, scene.end, turns=1)
    turn = Rotation.from_rotvec([0.3, -1.2, 0.8]).as_matrix()
    shift = np.array([3.0, -2.0, 1.0])

    def moved(clamp):
        return Clamp(turn @ np.asarray(clamp.position) + shift, turn @ np.asarray(clamp.frame))

    problem, polyline = begin(scene)
    turned_scene, _ = nondimensional(Scene(scene.rod, moved(scene.start), moved(scene.end), turns=1))
    turned = Polyline.through(polyline.nodes @ turn.T)
    turned_problem, turned = FiniteDifference.begin(turned_scene, turned, FirstTwist(jnp.array(4.0)))
    energy = problem.energies(polyline).total
    # Energies of order 1e3; rounding of the edges, a few eps each, times EA.
    np.testing.assert_allclose(turned_problem.energies(turned).total, energy, rtol=1e-12)


STRAIGHT = frame((1, 0, 0))


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (Clamp(ORIGIN, STRAIGHT), Clamp((1, 0, 0), STRAIGHT)),
        (Clamp(ORIGIN, STRAIGHT), Pin((1, 0, 0))),
        (Swivel(ORIGIN, (1, 0, 0)), Free()),
        (Free(), Clamp((1, 0, 0), STRAIGHT)),
    ],
)
@pytest.mark.parametrize("segments", [2, 7, 8])
def test_gauss_newton_is_the_hessian_where_nothing_is_strained(start, end, segments):
    """In a straight unstressed rod the second derivatives of the strains play no part; torsion is finite and flat."""
    scaled, _ = nondimensional(Scene(problems.cable(20.0), start, end))
    nodes = jnp.linspace(jnp.zeros(3), jnp.array([1.0, 0, 0]), segments + 1)
    problem, polyline = FiniteDifference.begin(scaled, Polyline.through(nodes), FirstTwist(jnp.array(0.0)))
    zero = problem.no_displacement(polyline)
    bending_and_stretch = lambda d: problem.energies(problem.displaced(polyline, d)).elastic  # noqa: E731
    hessian = jax.jit(jax.hessian(bending_and_stretch))(zero)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=zero.shape))
    forces = jnp.einsum("iajb,jb->ia", hessian, direction)
    preconditioned = jax.jit(lambda forces: problem.precondition(problem.gauss_newton(polyline), forces))(forces)
    # Condition numbers of the Hessians up to EA N^2/EI = 1e5.
    np.testing.assert_allclose(preconditioned, direction, rtol=0, atol=1e-11)


def jaxpr_text(scene: Scene) -> str:
    problem, polyline = begin(scene)
    return str(jax.make_jaxpr(problem.energy_and_gradient)(polyline))


def test_absent_terms_are_not_traced():
    rod = problems.cable()
    clamp = Clamp(ORIGIN, frame((1, 0, 0)))
    far = Clamp((0.8, 0.0, 0.0), frame((1, 0, 0)))
    bare = jaxpr_text(Scene(rod, clamp, Swivel((0.8, 0.0, 0.0), (1, 0, 0))))
    twisted = jaxpr_text(Scene(rod, clamp, far))
    # The angle of the torsion is the only arctangent, the trapezoidal weights of gravity the only dot product.
    assert "atan2" not in bare
    assert "atan2" in twisted
    assert "dot_general" not in bare
    assert "dot_general" in jaxpr_text(Scene(rod, clamp, far, GRAVITY))
    assert "floor" not in twisted
    assert "floor" in jaxpr_text(Scene(rod, clamp, far, point_forces=[PointForce(0.4, (0, 0, 1))]))
    assert (
        len(bare.splitlines())
        < len(twisted.splitlines())
        < len(jaxpr_text(Scene(rod, clamp, far, GRAVITY)).splitlines())
    )
