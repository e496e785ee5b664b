"""Supports and scenes: what is accepted, what is refused and why, units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rodjax import Clamp, Clip, Free, Guess, Joint, Pin, PointForce, Rod, Scene, Swivel, frame, problems
from rodjax.model.scene import between, is_kept_from_turning, nondimensional

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
        (PIN, PIN, {}, "all pins and clips are at one place, .*: without gravity or a force the rod can turn freely"),
        (PIN, Free(), dict(clips=[Clip(1.0, PIN.position)]), "all pins and clips are at one place"),
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
        (PIN, Pin((2, 0, 0))),
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


def scene_with_everything() -> Scene:
    rod = Rod.tube(2, 0.01, 0.008, 1e7, poisson_ratio=0.3, density=1000)
    forces = [PointForce(1, (0, 0, 6))]
    return Scene(rod, Clamp((0, 0, 0), frame((1, 2, 3))), Swivel((1, 0, 0), (1, 1, 0)), GRAVITY, forces)


@pytest.mark.parametrize("x64", [True, False])
def test_leaves_are_jax_arrays_of_the_precision_that_is_set(x64):
    with jax.enable_x64(x64):
        guess = Guess(np.eye(3))
        for leaf in jax.tree.leaves((scene_with_everything(), problems.omega(0.6, 1.0), guess)):
            assert isinstance(leaf, jax.Array)
            assert leaf.dtype == (jnp.float64 if x64 else jnp.float32)
            assert not leaf.weak_type


def test_a_given_precision_is_kept():
    assert Pin(np.zeros(3, np.float32)).position.dtype == jnp.float32
    assert frame(jnp.array([1, 0, 0], jnp.float32), jnp.array([0, 1, 0], jnp.float32)).dtype == jnp.float32


def test_jax_arrays_are_stored_as_given_and_others_copied():
    given = jnp.zeros(3)
    assert Pin(given).position is given
    position = np.zeros(3)
    pin = Pin(position)
    position[0] = 1.0
    assert pin.position[0] == 0.0


def test_known_numbers_compile_nothing(caplog):
    # In single precision, of which no other test has left compiled programs.
    with jax.enable_x64(False), jax.log_compiles():
        scene_with_everything()
        problems.hanging_cable()
        Guess(np.eye(3))
        assert not caplog.records
        jnp.ones(7) * 2.0  # the log does tell of a program
        assert caplog.records


def test_supports_of_traced_numbers():
    def end(tangent, position):
        return Clamp(position, frame(tangent, (0, 1, 0.5))), Swivel((position[0], 0.0, 1.0), tangent)

    tangent, position = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.2, 0.3])
    known = end(tangent, position)
    compiled = jax.jit(end)(tangent, position)
    batched = jax.vmap(end)(jnp.stack([tangent, tangent]), jnp.stack([position, position]))
    for k, c, b in zip(*map(jax.tree.leaves, (known, compiled, batched)), strict=True):
        np.testing.assert_allclose(c, k, atol=4e-16)  # rounding of numbers up to 1
        np.testing.assert_allclose(b, np.stack([k, k]), atol=4e-16)
    # One turned about d2 keeps d2, whose derivative by the angle of the tangent is then zero.
    d2 = jax.jacobian(lambda angle: frame((jnp.cos(angle), 0.0, jnp.sin(angle)))[:, 1])(0.3)
    np.testing.assert_allclose(d2, 0.0, atol=1e-16)


def test_traced_numbers_are_checked_by_shape():
    with pytest.raises(ValueError, match=r"position must be numbers of shape \(3,\), got an array of shape \(2,\)"):
        jax.jit(Pin)(jnp.zeros(2))


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


# --- between ---------------------------------------------------------------------------------------------------------


def scenes_apart() -> dict[str, tuple[Scene, Scene]]:
    everything = scene_with_everything()
    rod = Rod.tube(3, 0.02, 0.01, 2e7, poisson_ratio=0.3, density=1100)
    clamp, swivel = Clamp((0.1, 0, 0), frame((0, -1, 1))), Swivel((1, 0.5, 0), (0, 1, 2))
    return {
        "everything": (everything, Scene(rod, clamp, swivel, (1, 0, 5), [PointForce(2, (3, 0, 0))])),
        "turns": (Scene(ROD, CLAMP, CLAMP, turns=0), Scene(ROD, CLAMP, Clamp((1, 0, 0), frame((0, 0, 1))), turns=1)),
        "free": (
            Scene(ROD, CLAMP, Free((0, 0, 1), (0, 2, 0))),
            Scene(ROD, Clamp((1, 0, 0), LEVEL), Free((1, 0, 0), (0, 0, 3))),
        ),
        "pins": (Scene(ROD, PIN, Pin((2, 0, 0))), Scene(ROD, PIN, Pin((1, 0, 0)))),
    }


@pytest.mark.parametrize("name", scenes_apart())
def test_between_meets_both_ends_and_is_a_scene_like_them(name):
    scene, other = scenes_apart()[name]
    for fraction in (0.0, 0.3, 1.0):
        mixed = between(scene, other, jnp.asarray(fraction))
        assert jax.tree.structure(mixed) == jax.tree.structure(scene)
        for leaf, given in zip(jax.tree.leaves(mixed), jax.tree.leaves(scene), strict=True):
            assert leaf.shape == given.shape
            assert leaf.dtype == given.dtype
        if fraction == 0.3:
            continue
        # a + (b - a) has a rounding of the larger of both, a rotation by quaternions a few of numbers up to 1.
        for leaf, given in zip(jax.tree.leaves(mixed), jax.tree.leaves(other if fraction else scene), strict=True):
            np.testing.assert_allclose(leaf, given, rtol=1e-15, atol=2e-15)


def test_between_equal_scenes_is_the_same():
    scene = scene_with_everything()
    for leaf, given in zip(*map(jax.tree.leaves, (between(scene, scene, jnp.asarray(0.3)), scene)), strict=True):
        np.testing.assert_allclose(leaf, given, rtol=1e-15, atol=1e-15)  # roundings of the frame and the tangent


def test_between_is_linear_in_loads_and_positions():
    scene, other = scenes_apart()["everything"]
    mixed = between(scene, other, jnp.asarray(0.25))
    np.testing.assert_allclose(mixed.gravity, [0.25, 0, 0.75 * -9.81 + 0.25 * 5], rtol=1e-15)
    np.testing.assert_allclose(mixed.end.position, [1, 0.125, 0], rtol=1e-15)
    np.testing.assert_allclose(mixed.point_forces[0].force, [0.75, 0, 4.5], rtol=1e-15)
    np.testing.assert_allclose(mixed.rod.length, 2.25, rtol=1e-15)


def test_a_swivel_between_has_a_unit_tangent():
    scene, other = scenes_apart()["everything"]
    mixed = between(scene, other, jnp.asarray(0.4))
    np.testing.assert_allclose(jnp.linalg.norm(mixed.end.tangent), 1.0, rtol=1e-15)
    direction = 0.6 * np.array([1, 1, 0]) / np.sqrt(2) + 0.4 * np.array([0, 1, 2]) / np.sqrt(5)
    np.testing.assert_allclose(mixed.end.tangent, direction / np.linalg.norm(direction), rtol=1e-15)


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (1, -2, 3)])
@pytest.mark.parametrize("angle", [np.pi / 2, -np.pi / 2, 3.1])
def test_a_frame_half_way_is_turned_by_half(axis, angle):
    """Of a quarter turn an eighth; and less than half a turn goes by the smaller rotation."""
    vector = angle * np.array(axis) / np.linalg.norm(axis)
    start = np.asarray(frame((1, 2, 3)))
    scene, other = (
        Scene(ROD, CLAMP, Clamp((1, 0, 0), Rotation.from_rotvec(part * vector).as_matrix() @ start)) for part in (0, 1)
    )
    mixed = between(scene, other, jnp.asarray(0.5)).end.frame
    # Roundings of a few operations on numbers up to 1.
    np.testing.assert_allclose(mixed, Rotation.from_rotvec(vector / 2).as_matrix() @ start, rtol=0, atol=2e-15)
    np.testing.assert_allclose(mixed.T @ mixed, np.eye(3), rtol=0, atol=2e-15)


@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_a_direction_may_have_any_length(size):
    swivel = Swivel((0, 0, 0), (3 * size, 0, 4 * size))
    np.testing.assert_allclose(swivel.tangent, [0.6, 0, 0.8], rtol=1e-15)


APART = Pin((1.5, 0, 0))


@pytest.mark.parametrize(
    ("start", "end", "more", "expected"),
    [
        (Joint("a", LEVEL), Joint("b", LEVEL), {}, True),
        (SWIVEL, Free(), {}, True),
        (PIN, APART, {}, False),
        (PIN, APART, {"gravity": (0, 0, -9.81)}, True),
        (PIN, Free(force=(0, 0, 1.0)), {}, True),
        (PIN, APART, {"clips": [Clip(1.0, (0.8, 0, 0.1))]}, False),
        (PIN, APART, {"clips": [Clip(1.0, (0.8, 0, 0.1), (1, 0, 0))]}, True),
    ],
)
def test_what_keeps_a_rod_from_turning_wherever_it_is_held(start, end, more, expected):
    """A window makes such a scene anew before a move of its ends only where that may be refused."""
    assert is_kept_from_turning(Scene(ROD, start, end, **more)) == expected
