"""planar=True: the solution in space, stability against leaving the plane, what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, PointForce, Rod, Scene, frame, problems
from rodjax.model.plane import check_planar, plane
from rodjax.paths.path import stack_scenes

SEGMENTS = 12
SCENES = {
    "cantilever": problems.cantilever(),
    "hanging cable": problems.hanging_cable(),
    "omega": problems.omega(0.6, 0.0),
}
# The planes of the problems are y = 0: turned into a general one, and so that the chord is vertical.
TURNS = {"tilted": Rotation.from_rotvec([0.4, -0.9, 1.3]), "vertical chord": Rotation.from_rotvec([0, np.pi / 2, 0])}


def turned(scene: Scene, rotation: Rotation) -> Scene:
    matrix = rotation.as_matrix()
    start = Clamp(matrix @ scene.start.position, matrix @ scene.start.frame)
    if isinstance(scene.end, Free):
        return Scene(scene.rod, start, Free(force=matrix @ scene.end.force))
    end = Clamp(matrix @ scene.end.position, matrix @ scene.end.frame)
    return Scene(scene.rod, start, end, None if scene.gravity is None else matrix @ scene.gravity)


@pytest.fixture(scope="module")
def in_space() -> dict[str, rj.Equilibrium]:
    return {
        name: rj.solve(scene, segments=SEGMENTS, discretization="finite_difference") for name, scene in SCENES.items()
    }


def flat(**more) -> Rod:
    return Rod(1.0, (1.0, 2.0), 0.7, 1e4, mass_per_length=0.1, radius=0.01, **more)


@pytest.mark.parametrize("name", SCENES)
def test_a_planar_solve_is_the_one_in_space(name, in_space):
    planar = rj.solve(SCENES[name], segments=SEGMENTS, discretization="finite_difference", planar=True)
    space = in_space[name]
    assert planar.stable
    # The same iterates up to rounding: 1e-15, times 1e2 of stiffness for forces and moments in EI/L^2 and EI/L.
    np.testing.assert_allclose(planar.nodes, space.nodes, rtol=0, atol=1e-12)
    np.testing.assert_allclose(planar.frames, space.frames, rtol=0, atol=1e-12)
    scale = float(SCENES[name].rod.EI)
    for field in ("start_force", "start_moment", "end_force", "end_moment", "energy"):
        np.testing.assert_allclose(getattr(planar, field), getattr(space, field), rtol=0, atol=1e-11 * scale)
    assert planar.total_twist == 0.0
    assert planar.iterations == space.iterations


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("name", SCENES)
def test_the_plane_may_stand_anywhere(name, turn, in_space):
    matrix = TURNS[turn].as_matrix()
    scene = turned(SCENES[name], TURNS[turn])
    planar = rj.solve(scene, segments=SEGMENTS, discretization="finite_difference", planar=True)
    assert planar.stable
    # Other roundings, which the converged residual of 1e-8 EI/L^2 at most turns into less than 1e-10 of length.
    np.testing.assert_allclose(planar.nodes, in_space[name].nodes @ matrix.T, rtol=0, atol=1e-10)
    normal, axes = plane(scene)
    np.testing.assert_allclose(abs(normal @ matrix[:, 1]), 1.0, rtol=1e-14)  # a few roundings
    np.testing.assert_allclose(
        jnp.column_stack([axes, normal]).T @ jnp.column_stack([axes, normal]), np.eye(3), atol=1e-15
    )
    np.testing.assert_allclose(planar.nodes @ normal, 0.0, atol=1e-14)


def test_a_rod_in_clips_may_be_sought_in_its_plane():
    clamp, clip = Clamp((0, 0, 0), frame((1, 0, 0))), Clip(0.4, (0.35, 0.0, 0.05), tangent=(1.0, 0.0, 0.2))
    scene = Scene(Rod(1.0, 1.0, 0.7, 1e4, mass_per_length=0.5), clamp, Free(), (0, 0, -9.81), clips=[clip])
    planar, space = (rj.solve(scene, segments=8, planar=planar) for planar in (True, False))
    assert planar.stable
    # The residual of 1e-8 of both.
    np.testing.assert_allclose(planar.nodes, space.nodes, rtol=0, atol=1e-9)
    np.testing.assert_allclose(planar.clip_forces, space.clip_forces, rtol=0, atol=1e-5)
    np.testing.assert_allclose(planar.nodes[:, 1], 0.0, atol=1e-14)
    aside = dataclasses.replace(clip, position=jnp.array([0.35, 0.1, 0.05]))
    with pytest.raises(ValueError, match="one of them leaves it by"):
        rj.solve(Scene(scene.rod, scene.start, Free(), clips=[aside]), segments=8, planar=True)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 0, 1), (0, -1, 0), (1, 2, 3)])
def test_a_straight_scene_lies_in_any_plane_through_it(direction, planar):
    rod = problems.cable(20.0)
    unit = np.asarray(direction) / np.linalg.norm(direction)
    tension = 5.0 * float(rod.EI)
    d2 = (0, 1, 0) if direction[1] == 0 else (0, 0, 1)
    scene = Scene(rod, Clamp((0, 0, 0), frame(unit, d2)), Free(force=tension * unit))
    result = rj.solve(scene, segments=SEGMENTS, discretization="finite_difference", planar=planar)
    assert result.stable
    strain = tension / float(rod.EA)
    np.testing.assert_allclose(result.nodes[-1], (1 + strain) * unit, rtol=0, atol=1e-14)  # exact, a few roundings
    np.testing.assert_allclose(result.tension, tension, rtol=1e-14)
    # Work of the force tension (1 + strain) L, of which tension strain L/2 is stored.
    np.testing.assert_allclose(result.energy, -tension * (1 + strain / 2), rtol=1e-14)


@pytest.mark.parametrize("angle", [1.0, np.pi / 2])
def test_the_guess_chooses_the_plane_of_a_scene_along_one_line(angle):
    """Both clamps point along the chord, about which the arch of the guess is turned."""
    turn = Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()
    guess = rj.Guess(problems.figure_1_start().points @ turn.T)
    arch = rj.solve(
        problems.omega(0.0, 0.0), segments=SEGMENTS, discretization="finite_difference", guess=guess, planar=True
    )
    assert arch.converged
    np.testing.assert_allclose(arch.nodes @ turn[:, 1], 0.0, atol=1e-14)  # the roundings of sums over the rod
    assert np.max(np.abs(arch.nodes @ turn[:, 2])) > 0.3


@pytest.mark.parametrize("loads", [[], [PointForce(0.4, (1, 0, 0))]])
def test_ends_pinned_at_one_point_have_a_plane(loads):
    scene = Scene(problems.cable(), Pin((0, 0, 0)), Pin((0, 0, 0)), (0, 0, -9.81), loads)
    normal, axes = plane(scene)
    matrix = jnp.column_stack([axes, normal])
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), rtol=0, atol=1e-15)  # a few roundings
    np.testing.assert_allclose(normal[2], 0.0, atol=1e-15)


TILTS = np.linspace(problems.ARC_HALF_ANGLE, -0.6, 12)  # the last three are negative


@pytest.fixture(scope="module")
def closing() -> rj.Equilibrium:
    """An arch whose ends turn down until, with tilt 0, it would rather fall over."""
    scenes = [problems.omega(tilt, 0.0) for tilt in TILTS]
    return rj.solve_path(
        scenes, segments=SEGMENTS, discretization="finite_difference", guess=problems.figure_1_start(), planar=True
    )


def test_stable_speaks_of_motions_out_of_the_plane(closing):
    """With tilt 0 both clamps point along the chord, about which the arch may then turn: there it loses stability."""
    assert np.all(closing.converged)
    np.testing.assert_array_equal(closing.stable, TILTS > 0)
    np.testing.assert_allclose(closing.nodes[..., 1], 0.0, atol=1e-14)  # the roundings of sums over the rod


@pytest.mark.slow
def test_in_space_the_arch_falls_over(closing):
    scenes = [problems.omega(tilt, 0.0) for tilt in TILTS]
    space = rj.solve_path(
        scenes, segments=SEGMENTS, discretization="finite_difference", guess=problems.figure_1_start()
    )
    assert np.all(space.converged & space.stable)
    # The same until then, from guesses that differ by the rounding; beyond, turned over to the other side of the chord.
    is_stable = TILTS > 0
    np.testing.assert_allclose(space.nodes[is_stable], closing.nodes[is_stable], rtol=0, atol=1e-9)
    height, before = (np.mean(path.nodes[..., 2], axis=1) for path in (space, closing))
    assert np.all(before * before[0] > 0)
    assert np.all(height[~is_stable] * before[0] < 0)
    assert np.all(space.energy[~is_stable] < closing.energy[~is_stable])


def test_a_planar_path_takes_a_stack_of_scenes(closing):
    stacked = stack_scenes([problems.omega(tilt, 0.0) for tilt in TILTS])
    path = rj.solve_path(
        stacked, segments=SEGMENTS, discretization="finite_difference", guess=problems.figure_1_start(), planar=True
    )
    np.testing.assert_array_equal(path.nodes, closing.nodes)


@pytest.mark.slow
def test_a_planar_solve_under_jit_and_vmap(closing):
    scenes = stack_scenes([problems.omega(tilt, 0.0) for tilt in TILTS[[3, 6]]])
    guess = problems.figure_1_start()
    batch = jax.jit(
        jax.vmap(
            lambda scene: rj.solve(
                scene, segments=SEGMENTS, discretization="finite_difference", guess=guess, planar=True
            )
        )
    )(scenes)
    assert np.all(batch.stable)
    # Both converged to residuals of 1e-8 EI/L^2, against a stiffness of 1e2 EI/L^3.
    np.testing.assert_allclose(batch.nodes, closing.nodes[jnp.array([3, 6])], rtol=0, atol=1e-9)


ROD = problems.cable()
START = Clamp((0, 0, 0), frame((1, 0, 0)))
END = Clamp((0.8, 0, 0), frame((1, 0, 0)))
DOWN = (0.0, 0.0, -9.81)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (problems.omega(0.6, 0.3), "its end frames twist the rod, which then leaves the plane"),
        (Scene(ROD, START, Clamp((0.8, 0, 0), frame((1, 0, 0), (0, 1, 1e-3)))), "its end frames twist the rod"),
        (
            Scene(ROD, START, Clamp((0.8, 0, 0), frame((1, 0, 1))), (0.0, 9.81, 0.0)),
            "but one of them leaves it by 0.7 of its length",
        ),
        (Scene(ROD, START, Clamp((0.8, 0.1, 0), frame((1, 0, 0))), DOWN), "must lie in one plane"),
        (Scene(ROD, START, END, DOWN, [PointForce(0.5, (0, 1, 0))]), "must lie in one plane"),
        (Scene(ROD, START, Free((0, 0.1, -1)), DOWN), "must lie in one plane"),
        (Scene(ROD, Pin((0, 0, 0)), Clamp((0.5, 0.1, 0), frame((1, 0, 0))), DOWN), "must lie in one plane"),
        (Scene(ROD, START, Free(moment=(0, 1e-3, 0))), "planar must be False for a moment on a free end"),
        (Scene(ROD, START, END, turns=0), "planar must be False for a scene with turns"),
        (Scene(flat(rest_twist=1.0), START, END), "planar must be False for a rod that is twisted at rest"),
    ],
)
def test_scenes_that_leave_a_plane_are_refused(scene, message):
    with pytest.raises(ValueError, match=message):
        rj.solve(scene, planar=True)


def test_one_scene_of_a_path_that_leaves_the_plane_is_refused():
    with pytest.raises(ValueError, match="its end frames twist the rod"):
        rj.solve_path([problems.omega(0.6, 0.0), problems.omega(0.6, 0.1)], planar=True)


def test_directions_typed_to_six_digits_lie_in_the_plane():
    tangent = (0.707107, 0.000001, 0.707107)
    scene = Scene(ROD, START, Clamp((0.8, 0, 0), frame(tangent)), DOWN)
    np.testing.assert_allclose(abs(plane(scene)[0]), [0, 1, 0], atol=1e-5)  # the last digit of the tangent
    check_planar(scene, 0.0)


def test_a_guess_with_turns_is_refused():
    guess = rj.Guess(problems.figure_1_start().points, total_twist=2 * np.pi)
    with pytest.raises(ValueError, match="planar must be False for a guess with turns"):
        rj.solve(SCENES["omega"], guess=guess, planar=True)


def test_planar_must_be_true_or_false():
    with pytest.raises(TypeError, match="planar must be a bool, got 'yes'"):
        rj.solve(SCENES["omega"], planar="yes")  # type: ignore[arg-type]


def along_x(spin: float) -> np.ndarray:
    """The frame of a clamp along x, its sections turned about it."""
    return frame((1, 0, 0)) @ Rotation.from_rotvec([0, 0, spin]).as_matrix()


def test_rods_by_frames_in_a_plane():
    """A flat rod, curved in the plane, between clamps: in equilibrium in space too, where it would fall over."""

    def scene(spin):
        rod, held = flat(rest_curvature=(0.0, 0.5)), along_x(spin)
        return Scene(rod, Clamp((0, 0, 0), held), Clamp((0.8, 0, 0), held), (0, 0, -9.81))

    planar = rj.solve(scene(0.0), segments=SEGMENTS, planar=True)
    assert planar.converged
    assert not planar.stable
    np.testing.assert_allclose(planar.nodes[:, 1], 0.0, rtol=0, atol=1e-14)
    # The sections keep d2 across the plane, by which the stiffness in it is the second one.
    np.testing.assert_allclose(planar.frames[:, :, 1], np.broadcast_to([0, 1, 0], (SEGMENTS + 1, 3)), atol=1e-12)
    in_space = rj.solve(scene(0.0), segments=SEGMENTS, guess=planar, find="equilibrium")
    assert in_space.iterations == 0
    assert in_space.index >= 1
    # A twist at rest of zero is none.
    check_planar(dataclasses.replace(scene(0.0), rod=flat(rest_twist=0.0)), 0.0)
    # Of sections that stand askew the moment has a part out of the plane.
    with pytest.warns(rj.NotConvergedWarning, match="planar is True, but supports, loads or twist leave the plane"):
        rj.solve(scene(0.5), segments=SEGMENTS, planar=True)


def test_a_rod_on_an_obstacle_in_a_plane():
    """By tangents; what it does is known from the solve in space, where here it does not fall over."""
    rod = Rod(1.0, 0.02, 0.015, 1e6, 0.15, radius=0.005)
    floor = rj.Plane((0, 0, 0), (0, 0, 1))
    scene = Scene(rod, Clamp((0, 0, 0.005), frame((1, 0, 0))), Free(force=(0, 0, 0.3)), (0, 0, -10), obstacles=[floor])
    planar, in_space = (rj.solve(scene, segments=16, planar=is_planar) for is_planar in (True, False))
    assert planar.stable
    # Contacts are stiffer than the rod by 1e9.
    np.testing.assert_allclose(planar.nodes, in_space.nodes, rtol=0, atol=1e-7)
    np.testing.assert_allclose(planar.contact_forces, in_space.contact_forces, rtol=0, atol=1e-5)


def test_inside_jit_a_scene_that_leaves_the_plane_is_flagged():
    """Where no error can be raised. One program: the first scene lies in the plane, the second does not."""
    solve = jax.jit(lambda scene: rj.solve(scene, segments=SEGMENTS, discretization="finite_difference", planar=True))
    assert solve(problems.omega(0.6, 0.0)).converged
    result = solve(problems.omega(0.6, 0.3))
    assert result.status == rj.Status.NOT_PLANAR
    assert not result.converged
    assert not result.stable


def test_nonlinear_cg_is_refused():
    with pytest.raises(ValueError, match="solver must be a Newton where planar is True"):
        rj.solve(SCENES["omega"], solver=rj.NonlinearCG(), planar=True)
