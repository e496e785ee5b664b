"""The mixed form: derivatives of its energy and of its residual forces, the same states as by nodes, absent terms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scenes import GRAVITY, ORIGIN, loaded_scenes
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Free, PointForce, Scene, Swivel, frame, problems
from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.first_twist import FirstTwist
from rodjax.discretization.hermite import QuadraticRotationElements
from rodjax.discretization.mixed import Linearization, MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.tangent_field import TangentField
from rodjax.discretization.twist import transport_along, twist_under_moment
from rodjax.linalg.saddle_point import SaddlePointSystem
from rodjax.model.scene import nondimensional

N = 4


POTENTIAL = ["clamps", "clamp-swivel", "pins", "cantilever", "free start"]
MOMENT = ["end moment", "start moment"]
KINDS = ["edges", "elements"]


def field(scene: Scene, kind: str = "edges") -> TangentField:
    """Four edges, or three elements of different lengths."""
    return (
        EdgeTangents.of(scene, N) if kind == "edges" else QuadraticRotationElements(jnp.array([0.0, 0.25, 0.65, 1.0]))
    )


def begin(name: str, kind: str = "edges") -> tuple[MixedForm, MixedPoint]:
    """A rough helix under some force; the total twist about 4 rad where the scene has torsion."""
    scene, _ = nondimensional(loaded_scenes()[name])
    form = MixedForm.of(scene, field(scene, kind))
    points = len(form.field.weights)
    s = (np.arange(points) + 0.5) / points
    rough = 0.3 * np.random.default_rng(0).normal(size=(3, points))
    tangents = np.stack([np.cos(2 * s), np.sin(4 * s), 1 - s]) + rough
    tangents = jnp.asarray(tangents / np.linalg.norm(tangents, axis=0))
    force = [0.0, 0.0, 0.0] if isinstance(scene.start, Free) or isinstance(scene.end, Free) else [3.0, -20.0, 5.0]
    twist = 4.0 if form.has_torsion else 0.0
    if not form.has_potential:
        twist = float(twist_under_moment(scene, tangents))
    return form, MixedPoint(tangents, jnp.array(force)[:, None], jnp.array(twist))


linearized = by_numpy(MixedForm.linearized)


def by_all(system: SaddlePointSystem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Second derivatives by the rotations, mixed ones (rotations, F), and by F, without the columns of the torque."""
    b, k, n = system.border.shape
    hessian = np.zeros((n, b, n, b))
    for i in range(n):
        hessian[i, :, i] = system.diagonal[..., i]
    for i in range(n - 1):
        hessian[i + 1, :, i] = system.lower[..., i]
        hessian[i, :, i + 1] = np.asarray(system.lower[..., i]).T
    if system.across is not None:
        for i in range(n // 2):
            hessian[2 * i + 2, :, 2 * i] = system.across[..., i]
            hessian[2 * i, :, 2 * i + 2] = np.asarray(system.across[..., i]).T
    hessian = hessian.reshape(n * b, n * b)
    columns = np.asarray(system.border).transpose(2, 0, 1).reshape(n * b, k)
    rows = columns if system.rows is None else np.asarray(system.rows).transpose(2, 0, 1).reshape(n * b, k)
    compliance = np.asarray(system.compliance)
    shared = k if system.rows is not None else k % 3
    hessian += columns[:, :shared] @ np.linalg.solve(compliance[:shared, :shared], rows[:, :shared].T)
    return hessian, columns[:, shared:], -compliance[shared:, shared:]


def derivatives(form: MixedForm, point: MixedPoint, function):
    """The linearization at the point, and `function`s of that at a moved point by the rotations and the force."""

    def at(rotation, force_change):
        return function(form.linearized(form.retract(point, here.bases, rotation, force_change[:, None])))

    here = linearized(form, point)
    return here, at, (jnp.zeros_like(here.gradient), jnp.zeros(3))


def vector_and_constraint_residual(here: Linearization) -> tuple[jax.Array, jax.Array]:
    """What does not depend on the choice of bases."""
    return jnp.sum(here.bases * here.gradient[None], axis=1), here.constraint_residual[-3:]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", POTENTIAL)
def test_gradient_is_the_derivative_of_the_energy(name, kind):
    form, point = begin(name, kind)
    here, energy, nowhere = derivatives(form, point, lambda here: here.energy)
    by_rotation, by_force = by_numpy(jax.grad(energy, argnums=(0, 1)))(*nowhere)
    # Derivatives up to 1e3, and a few hundred roundings.
    np.testing.assert_allclose(here.gradient, by_rotation, rtol=0, atol=1e-11)
    if here.constraint_residual.size:
        np.testing.assert_allclose(here.constraint_residual[-3:], by_force, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", POTENTIAL + MOMENT)
def test_the_system_is_the_derivative_of_gradient_and_closure(name, kind):
    form, point = begin(name, kind)
    here, both, nowhere = derivatives(form, point, vector_and_constraint_residual)
    (vectors, vectors_by_force), (constraint_residual, residual_by_force) = by_numpy(jax.jacfwd(both, argnums=(0, 1)))(
        *nowhere
    )
    size = here.gradient.size
    by_rotation = np.einsum("cin,cnjm->nimj", here.bases, vectors).reshape(size, size)
    by_rotation += np.diag(np.einsum("cin->ni", here.bases**2).ravel() == 0)  # the unit block of a held tangent
    hessian, mixed, by_force = by_all(here.system)
    # Entries up to 1e4 in joints bent by a radian over a quarter of the rod.
    np.testing.assert_allclose(hessian, by_rotation, rtol=0, atol=1e-10)
    if mixed.shape[1]:
        columns = np.einsum("cin,cnf->nif", here.bases, vectors_by_force).reshape(size, 3)
        np.testing.assert_allclose(mixed, columns, rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            mixed, np.asarray(constraint_residual).transpose(2, 1, 0).reshape(size, 3), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(by_force, residual_by_force, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", MOMENT)
def test_gradient_with_a_dead_moment_is_that_of_the_work_on_the_end_frame(name):
    """Elastic energy without torsion, less the work of the force and that of the moment on a frame without twist."""
    form, point = begin(name)
    here = linearized(form, point)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=(2, N)))
    step = 1e-5
    energies, frames = [], []
    scene = form.scene
    free, clamp = (scene.start, scene.end) if isinstance(scene.start, Free) else (scene.end, scene.start)
    without = eqx.tree_at(lambda free: free.moment, free, None)
    ends = (without, clamp) if isinstance(scene.start, Free) else (clamp, without)
    bare = Scene(scene.rod, *ends, scene.gravity)
    only_force = MixedForm.of(bare, field(bare))
    for sign in (1, -1):
        retracted = form.retract(point, here.bases, sign * step * direction, jnp.zeros((3, 1)))
        energies.append(float(linearized(only_force, retracted).energy))
        tangents = retracted.tangents if free is scene.end else retracted.tangents[:, ::-1]
        frames.append(last_frame_without_twist(clamp.frame, tangents))
    spin = Rotation.from_matrix(frames[0] @ frames[1].T).as_rotvec()
    work = np.asarray(free.moment) @ spin
    # Central differences: truncation step^2, rounding eps/step, both about 1e-10 of derivatives of order 10.
    expected = (energies[0] - energies[1] - work) / (2 * step)
    np.testing.assert_allclose(jnp.sum(here.gradient * direction), expected, rtol=0, atol=1e-7)


def last_frame_without_twist(frame, tangents) -> np.ndarray:
    """A frame carried along unit tangents (3, k) by smallest rotations."""
    carried = np.asarray(frame)
    for tangent in np.asarray(tangents).T:
        axis = np.cross(carried[:, 2], tangent)
        angle = np.arctan2(np.linalg.norm(axis), carried[:, 2] @ tangent)
        carried = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix() @ carried
    return carried


def test_transport_along_is_that_by_rotations():
    _, point = begin("clamps")
    start = np.asarray(frame(np.asarray(point.tangents[:, 0])))
    carried = transport_along(jnp.asarray(start[:, 0]), point.tangents)
    for k in range(1, N):
        expected = last_frame_without_twist(start, point.tangents[:, 1 : k + 1])[:, 0]
        np.testing.assert_allclose(carried[:, k], expected, rtol=0, atol=1e-14)  # a few roundings


# --- the same as by nodes --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=POTENTIAL)
def solved(request) -> tuple[MixedForm, FiniteDifference, Polyline, MixedPoint]:
    """A scene solved to its rounding floor, in both unknowns."""
    scene = loaded_scenes()[request.param]
    result = rj.solve(scene, segments=N, discretization="finite_difference", solver=rj.Newton(tolerance=0.0))
    assert result.converged
    scaled, _ = nondimensional(scene)
    problem, polyline = FiniteDifference.begin(scaled, result.state.shape, FirstTwist(result.total_twist))
    point = MixedPoint(problem.mixed_point(polyline).tangents, result.state.end_force, result.total_twist)
    return MixedForm.of(scaled, field(scaled)), problem, polyline, point


def test_unknowns_change_back_and_forth(solved):
    form, problem, polyline, point = solved
    # Nodes of a rod of length 1; the force is EA = 1600 times a rounding of the lengths, or the floor of the residual.
    edges = form.edges(point)
    np.testing.assert_allclose(edges, polyline.edges, rtol=0, atol=1e-13)
    np.testing.assert_allclose(form.nodes(edges), polyline.nodes, rtol=0, atol=1e-13)
    again = eqx.filter_jit(problem.mixed_point)(polyline)
    np.testing.assert_allclose(again.end_force, point.end_force, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.total_twist, point.total_twist, rtol=0, atol=1e-12)


def test_energies_agree(solved):
    form, problem, polyline, point = solved
    energies = problem.energies(polyline)
    here = linearized(form, point)
    # The Lagrangian of the origin: the loads' potential is zero there. Energies of order 10 to 1e3.
    np.testing.assert_allclose(here.energy, energies.total, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(form.elastic_energy(point), energies.elastic, rtol=1e-12)
    assert here.residual < 1e-9
    assert np.all(np.abs(here.constraint_residual) < 1e-13)


def test_residual_is_the_largest_component_of_the_gradient_by_nodes(solved):
    """Away from equilibrium, on edges as long as the force makes them."""
    form, problem, _, point = solved
    here = linearized(form, point)
    rotation = 0.1 * jnp.asarray(np.random.default_rng(2).normal(size=(2, N)))
    retracted = form.retract(point, here.bases, rotation, jnp.zeros((3, 1)))
    edges = form.edges(retracted)
    _, gradient = eqx.filter_jit(problem.energy_and_gradient)(Polyline(form.nodes(edges), edges))
    residual = linearized(form, retracted).residual
    assert residual > 1.0  # far above the floor
    # The strains by edges, times EA = 1600, have the roundings of the lengths: 1e-12 of 10.
    np.testing.assert_allclose(residual, jnp.max(jnp.abs(gradient)), rtol=1e-11)


# --- absent terms ----------------------------------------------------------------------------------------------------


def jaxpr_text(scene: Scene) -> str:
    scaled, _ = nondimensional(scene)

    def moved_and_linearized(scaled, point, rotation):
        form = MixedForm.of(scaled, field(scaled))
        here = form.linearized(point)
        return form.linearized(form.retract(point, here.bases, rotation, jnp.zeros((3, 1)))).gradient

    point = MixedPoint(jnp.ones((3, N)), jnp.zeros((3, 1)), jnp.array(0.0))
    return str(jax.make_jaxpr(moved_and_linearized)(scaled, point, jnp.zeros((2, N))))


def test_absent_terms_are_not_traced():
    rod = problems.cable()
    clamp, far = Clamp(ORIGIN, frame((1, 0, 0))), Clamp((0.8, 0.0, 0.0), frame((1, 0, 0)))
    bare = jaxpr_text(Scene(rod, clamp, Swivel((0.8, 0.0, 0.0), (1, 0, 0))))
    twisted = jaxpr_text(Scene(rod, clamp, far))
    # The swept angle of the torsion is the only arctangent, the cell of a point force the only rounding down.
    assert "atan2" not in bare
    assert "atan2" in twisted
    assert "floor" not in twisted
    assert "floor" in jaxpr_text(Scene(rod, clamp, far, point_forces=[PointForce(0.4, (0, 0, 1))]))
    assert len(bare.splitlines()) < len(twisted.splitlines())
    assert len(twisted.splitlines()) < len(jaxpr_text(Scene(rod, clamp, far, GRAVITY)).splitlines())
