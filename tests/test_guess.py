"""The library's own first shape, and interpolation."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Pin, Scene, frame, problems
from rodjax.discretization.first_shape import first_shape
from rodjax.geometry.interpolation import cubic, resampled
from rodjax.model.scene import nondimensional
from rodjax.solving import equilibrium
from rodjax.solving.guess import other_guess


def shape(scene: Scene, segments: int = 200) -> np.ndarray:
    scaled, _ = nondimensional(scene)
    return np.asarray(first_shape(scaled, segments))


@pytest.mark.parametrize("span", [0.0, 0.2, 0.8, 0.999])
def test_pins_get_an_arc_of_the_right_length(span):
    nodes = shape(Scene(problems.cable(), Pin((0, 0, 0)), Pin((span, 0, 0)), gravity=(0, 0, -9.81)))
    np.testing.assert_allclose(nodes[[0, -1]], [[0, 0, 0], [span, 0, 0]], atol=2e-3)  # 12 bisections of the angle
    np.testing.assert_allclose(np.sum(np.linalg.norm(np.diff(nodes, axis=0), axis=1)), 1.0, atol=2e-3)
    assert np.min(nodes[:, 2]) < -0.01  # it sags


def test_the_first_shape_leaves_along_the_end_tangents():
    nodes = shape(Scene(problems.cable(), Clamp((0, 0, 0), frame((0, 0, 1))), Clamp((0.5, 0, 0), frame((1, 1, 0)))))
    np.testing.assert_allclose(200 * (nodes[1] - nodes[0]), [0, 0, 1], atol=0.05)  # to the curvature of one segment
    np.testing.assert_allclose(200 * (nodes[-1] - nodes[-2]), np.array([1, 1, 0]) / np.sqrt(2), atol=0.05)


def test_a_cold_start_finds_an_equilibrium_between_random_frames():
    rng = np.random.default_rng(0)
    rod = problems.cable(50.0)
    unit = float(rod.EI / rod.mass_per_length)
    for _ in range(40):
        direction = rng.normal(size=3)
        position = rng.uniform(0.05, 0.95) * direction / np.linalg.norm(direction)
        start, end = (Rotation.random(None, rng).as_matrix() for _ in range(2))
        gravity = (0, 0, -unit * 10 ** rng.uniform(-1, 2.5))
        result = rj.solve(
            Scene(rod, Clamp((0, 0, 0), start), Clamp(position, end), gravity),
            strain_limit=None,
            segments=20,
            discretization="finite_difference",
        )
        assert result.converged, rj.describe(result)
        # The tangents have followed their reference: the frame carried with the total twist meets the clamp.
        np.testing.assert_allclose(result.frames[-1], end, atol=1e-12)


def test_resampling_keeps_a_parabola():
    s = np.linspace(0, 1, 11)
    curve = lambda s: np.stack([s, s**2, 0 * s], axis=1)  # noqa: E731
    fine = np.asarray(resampled(jnp.asarray(curve(s)), 40))
    inner = slice(4, -4)  # one-sided slopes at the ends
    np.testing.assert_allclose(fine[inner], curve(np.linspace(0, 1, 41))[inner], atol=1e-14)


def test_cubic_interpolation_is_exact_for_cubics():
    x = jnp.array([0.0, 0.7, 2.0, 3.0])
    points, slopes = jnp.stack([x**3, x, x**2], axis=1), jnp.stack([3 * x**2, 1 + 0 * x, 2 * x], axis=1)
    at = jnp.array([0.0, 0.3, 1.7, 3.0])
    np.testing.assert_allclose(cubic(x, points, slopes, at), jnp.stack([at**3, at, at**2], axis=1), atol=1e-14)


BETWEEN = (rj.Swivel((0, 0, 0), (0.983, 0, 0.182)), rj.Swivel((0.494, 0, 0), (0.84, 0, 0.542)))
PIPE_AND_BOX = [
    rj.Capsule((0.089, -0.958, -0.333), (0.661, 0.958, -0.333), 0.035),
    rj.Box((0.304, 0, -0.241), (0.193, 2, 0.193)),
]


def test_a_start_that_leads_nowhere_beside_obstacles_is_followed_by_an_arc(monkeypatch):
    """The shape without obstacles has box and pipe on its way, between which there is no room."""
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6, mass_per_length=8.4, radius=0.005)
    scene = rj.Scene(rod, *BETWEEN, (0, 0, -1.0), obstacles=PIPE_AND_BOX)
    result = rj.solve(scene, segments=24)
    assert result.converged
    arc = other_guess(scene, planar=False)
    assert arc is not None
    from_arc = rj.solve(scene, segments=24, guess=arc)
    np.testing.assert_array_equal(result.nodes, from_arc.nodes)
    with monkeypatch.context() as without:
        without.setattr(equilibrium, "other_guess", lambda scene, **_: None)
        with pytest.warns(rj.NotConvergedWarning):
            first = rj.solve(scene, segments=24)
    # The work of both searches is told.
    assert result.iterations == first.iterations + from_arc.iterations


def test_an_arc_hangs_between_the_supports_as_long_as_the_rod():
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6, mass_per_length=1.0)
    scene = rj.Scene(rod, *BETWEEN, (0, 0, -1.0))
    arc = other_guess(scene, planar=False)
    assert arc is not None
    points = np.asarray(arc.points)
    np.testing.assert_allclose(points[[0, -1]], [(0, 0, 0), (0.494, 0, 0)], atol=2e-3)
    assert np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)) == pytest.approx(1.0, abs=2e-3)  # as above
    assert np.all(points[1:-1, 2] < 0)
    assert np.all(points[:, 1] == 0)


def test_where_nothing_hangs_an_arc_turns_with_the_scene():
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    turned = [rj.Swivel(turn @ end.position, turn @ end.tangent) for end in BETWEEN]
    arc, other = (other_guess(rj.Scene(rod, *ends), planar=False) for ends in (BETWEEN, turned))
    assert arc is not None
    assert other is not None
    np.testing.assert_allclose(other.points, arc.points @ turn.T, atol=1e-12)


def test_a_rod_curved_at_rest_with_a_free_end_begins_again_straight():
    start = rj.Clamp((0.1, 0, 0), rj.frame((0, 0.6, 0.8)))
    scene = rj.Scene(rj.Rod(2.0, 1.0, 1.0, 1e6, rest_curvature=(1.0, 0.0)), start, rj.Free())
    straight = other_guess(scene, planar=True)
    assert straight is not None
    np.testing.assert_allclose(np.asarray(straight.points)[[0, -1]], [(0.1, 0, 0), (0.1, 1.2, 1.6)], atol=1e-12)


def test_there_is_no_other_shape_through_clips_in_a_plane_or_of_a_straight_rod_with_a_free_end():
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6)
    start, end = BETWEEN
    assert other_guess(rj.Scene(rod, start, rj.Free()), planar=False) is None
    assert other_guess(rj.Scene(rod, start, end), planar=True) is None
    assert other_guess(rj.Scene(rod, start, end, clips=[rj.Clip(0.5, (0.2, 0.1, 0))]), planar=False) is None
