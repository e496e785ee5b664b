"""follow() and its critical points: located, told apart, passed, left by another branch, and differentiated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import BranchEnd, Clamp, Free, Guess, PointForce, Rod, Scene, frame
from rodjax.discretization.form import NEUTRAL
from rodjax.geometry.rotations import rotation_vector

SEGMENTS = 16
ORIGIN, LEVEL = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)
EULER = np.pi**2 / 4
LOAD = 4.0
# EA L^2/EI of 1e8 shifts Euler's loads by 3e-8; 16 elements, of fourth order, by less than 1e-6.
EA = 1e8


def pressed(load, EI=1.0) -> Scene:
    return Scene(Rod(1.0, EI, 0.8, EA), Clamp(ORIGIN, frame(LEVEL)), Free(force=jnp.array([-load, 0.0, 0.0])))


def strut(EI=1.0) -> list[Scene]:
    return [pressed(0.0, EI), pressed(LOAD, EI)]


@pytest.fixture(scope="module")
def straight() -> rj.Branch:
    return rj.follow(strut(), segments=SEGMENTS)


HALF = 0.5  # half angle of the arch
SPAN = np.sin(HALF) / HALF
ARCH_LOAD = 40.0


def arch(rod: Rod, loads=(-ARCH_LOAD, ARCH_LOAD)) -> list[Scene]:
    cosine, sine = np.cos(HALF), np.sin(HALF)
    start = Clamp(ORIGIN, frame((cosine, 0.0, sine)))
    end = Clamp((SPAN, 0.0, 0.0), frame((cosine, 0.0, -sine)))
    return [Scene(rod, start, end, point_forces=[PointForce(0.5, (0.0, 0.0, -load))]) for load in loads]


ROD = Rod(1.0, 1.0, 0.8, 1e6)


def circle() -> Guess:
    angle = np.linspace(-HALF, HALF, 101)
    rise = (np.cos(angle) - np.cos(HALF)) / (2 * HALF)
    return Guess(np.stack([SPAN / 2 + np.sin(angle) / (2 * HALF), 0 * angle, rise], axis=1))


@pytest.fixture(scope="module")
def snapping() -> rj.Branch:
    return rj.follow(arch(ROD), segments=SEGMENTS, guess=circle(), start=0.5)


def arch_load(parameter) -> np.ndarray:
    return (2 * np.asarray(parameter) - 1) * ARCH_LOAD


def height(results: rj.Equilibrium) -> np.ndarray:
    return np.asarray(results.nodes)[..., SEGMENTS // 2, 2]


# --- one branch ------------------------------------------------------------------------------------------------------


def test_the_straight_strut_buckles_at_eulers_load(straight):
    (point,) = straight.critical_points
    assert point.kind == "branch"
    assert (point.index_before, point.index_after) == (0, 2)  # to all sides at once
    np.testing.assert_allclose(point.parameter * LOAD, EULER, rtol=1e-6)
    np.testing.assert_allclose(point.equilibrium.scene.end.force, [-point.parameter * LOAD, 0.0, 0.0], rtol=1e-12)
    # A straight strut loses as much stiffness as it is pressed.
    assert abs(point.mode.stiffness) < 1e-8
    s = np.asarray(point.equilibrium.s)
    sideways = np.linalg.norm(point.mode.displacement, axis=1)
    np.testing.assert_allclose(sideways, 1 - np.cos(np.pi * s / 2), atol=1e-5)


def test_a_branch_runs_from_the_first_to_the_last_scene(straight):
    assert straight.ended == BranchEnd.SCENES
    assert straight.parameter[0] == 0.0
    assert straight.parameter[-1] == 1.0
    assert np.all(straight.equilibria.converged)
    np.testing.assert_array_equal(straight.index, np.where(straight.parameter * LOAD < EULER, 0, 2))
    np.testing.assert_array_equal(straight.index, straight.equilibria.index)
    np.testing.assert_allclose(straight.equilibria.nodes[:, :, 1:], 0.0, atol=1e-12)


def test_it_ends_after_so_many_points():
    branch = rj.follow(strut(), segments=SEGMENTS, max_points=3)
    assert branch.ended == BranchEnd.MAX_POINTS
    assert branch.parameter.shape == branch.equilibria.energy.shape == (3,)


def test_scenes_between_change_nothing_but_the_parameter(straight):
    """The parameter counts scenes, and the branch stops at each of them."""
    branch = rj.follow([pressed(load) for load in (0.0, 1.0, 3.0, LOAD)], segments=SEGMENTS)
    assert {0.0, 1.0, 2.0, 3.0} <= set(np.asarray(branch.parameter).tolist())
    # 1 + 2 x is the load between the second and the third scene; both are as accurate as the residual of 1e-9.
    load = 1 + 2 * (float(branch.critical_points[0].parameter) - 1)
    np.testing.assert_allclose(load, straight.critical_points[0].parameter * LOAD, rtol=1e-8)


def test_it_may_begin_anywhere_and_go_back(straight):
    begin = jax.tree.map(lambda leaf: leaf[-1], straight.equilibria)
    back = rj.follow(strut(), guess=begin, start=1.0, direction=-1)
    assert back.parameter[-1] == 0.0
    (point,) = back.critical_points
    assert (point.index_before, point.index_after) == (2, 0)
    np.testing.assert_allclose(point.parameter, straight.critical_points[0].parameter, rtol=1e-8)


@pytest.mark.parametrize("side", [1, -1])
def test_the_buckled_branch(straight, side):
    """The elastica of a strut just beyond its load: P/P_E = 1 + a^2/8 for the end angle a, to fourth order."""
    (point,) = straight.critical_points
    start, buckled = rj.switch_branch(strut(), point, side=side)
    assert buckled.converged
    assert buckled.stable
    angle = float(np.arccos(buckled.tangents[-1, 0]))
    np.testing.assert_allclose(start * LOAD / EULER, 1 + angle**2 / 8, atol=0.02 * angle**4)
    branch = rj.follow(strut(), guess=buckled, start=float(start))
    assert branch.ended == BranchEnd.SCENES
    assert branch.critical_points == ()
    assert np.all(branch.equilibria.stable)
    # Both sides are mirror images: the same deflection, reversed.
    other = rj.switch_branch(strut(), point, side=-side)[1]
    np.testing.assert_allclose(other.nodes[:, 1:], -buckled.nodes[:, 1:], atol=1e-7)


# --- folds -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_arch_is_followed_through_both_folds(snapping):
    folds = [point for point in snapping.critical_points if point.kind == "fold"]
    assert snapping.ended == BranchEnd.SCENES
    assert len(folds) == 2
    # Where the load turns round: beyond no point of the branch has more, or less again.
    loads, index = arch_load(snapping.parameter), np.asarray(snapping.index)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(loads))))
    np.testing.assert_array_less(np.abs([arch_load(fold.parameter) for fold in folds] - loads[turns + 1]), 0.5)
    between = slice(turns[0] + 2, turns[1] + 1)
    assert np.all(index[between] > 0)
    assert index[0] == index[-1] == 0
    # By symmetry it stays in its plane, also where it would rather not.
    assert np.max(np.abs(snapping.equilibria.nodes[..., 1])) < 1e-9
    for fold in folds:
        assert abs(fold.index_after - fold.index_before) == 1
        assert abs(fold.mode.stiffness) < 1e-7


@pytest.mark.slow
def test_the_energy_follows_the_load(snapping):
    """dW/dF is the height of the loaded point: by the trapezoidal rule, on 20 points."""
    energy, loads, heights = (
        np.asarray(snapping.equilibria.energy),
        arch_load(snapping.parameter),
        height(snapping.equilibria),
    )
    gained = np.cumsum(np.diff(loads) * (heights[1:] + heights[:-1]) / 2)
    assert np.max(np.abs(energy[1:] - energy[0] - gained)) < 0.02 * np.ptp(energy)


@pytest.mark.slow
def test_a_fold_is_the_largest_load(snapping):
    """Near it the load falls with the square of the way: points 1e-3 to both sides have less, by little."""
    fold = next(point for point in snapping.critical_points if point.kind == "fold")
    start, beside = rj.switch_branch(arch(ROD), fold, distance=1e-2)
    other, _ = rj.switch_branch(arch(ROD), fold, distance=1e-2, side=-1)
    top = arch_load(fold.parameter)
    assert beside.converged
    assert top - 0.1 < arch_load(start) < top
    assert top - 0.1 < arch_load(other) < top


@pytest.mark.slow
def test_the_critical_points_of_a_path():
    """A path jumps where the symmetric arch loses its stability, and stays stable afterwards."""
    scenes = arch(ROD, np.linspace(0.0, ARCH_LOAD, 9))
    path = rj.solve_path(scenes, segments=SEGMENTS, guess=circle())
    points = rj.critical_points(scenes, path)
    assert points[0].kind == "branch"
    assert (points[0].index_before, points[0].index_after) == (0, 1)
    stopped = rj.solve_path(scenes, segments=SEGMENTS, guess=circle(), at_critical="stop")
    last = int(points[0].parameter)
    assert stopped.energy.shape == (last + 1,)
    np.testing.assert_array_equal(stopped.nodes, path.nodes[: last + 1])
    assert 0 < last < 8


@pytest.mark.slow
def test_a_path_without_critical_point_does_not_stop():
    scenes = [pressed(load) for load in (0.0, 0.5, 1.0)]
    assert rj.solve_path(scenes, segments=SEGMENTS, at_critical="stop").energy.shape == (3,)


def test_a_path_cannot_stop_inside_jit():
    with pytest.raises(ValueError, match=r"at_critical must be 'jump' inside jax\.jit"):
        jax.jit(lambda load: rj.solve_path([pressed(0.0), pressed(load)], segments=4, at_critical="stop").energy)(1.0)


def twisted(rod: Rod, span: float, angles: np.ndarray) -> list[Scene]:
    start = Clamp(ORIGIN, frame(LEVEL))
    ends = [frame(LEVEL, (0.0, np.cos(angle), np.sin(angle))) for angle in angles]
    return [Scene(rod, start, Clamp((span, 0.0, 0.0), end)) for end in ends]


def bow(span: float, height: float = 0.2) -> Guess:
    x = np.linspace(0.0, 1.0, 101)
    return Guess(np.stack([span * x, 0 * x, height * (1 - np.cos(2 * np.pi * x))], axis=1))


@pytest.mark.slow
def test_writhe():
    """A rod between clamps at half its length, twisted: it snaps into a loop and back.

    In its plane the loop bears no twist at one turn of the end, and its mirror image continues the branch: the angles
    of the two folds add up to 4 pi. Between clamps on one line the rod can turn, and is neutral all along.
    """
    angles = np.linspace(0.0, 4 * np.pi, 7)
    branch = rj.follow(twisted(Rod(1.0, 1.0, 2.0, 1e6), 0.5, angles), segments=32, guess=bow(0.5))
    assert branch.ended == BranchEnd.SCENES
    assert np.all(branch.equilibria.neutral)
    assert [point.kind for point in branch.critical_points] == ["fold", "fold"]
    assert [(point.index_before, point.index_after) for point in branch.critical_points] == [(0, 1), (1, 0)]
    folds = np.array([point.parameter for point in branch.critical_points]) * angles[1]
    np.testing.assert_allclose(np.sum(folds), 4 * np.pi, rtol=1e-8)
    assert folds[0] > 2 * np.pi > folds[1]


def assert_back_through_one_fold(branch: rj.Branch) -> None:
    (fold,) = branch.critical_points
    assert (fold.kind, fold.index_before, fold.index_after) == ("fold", 0, 1)
    assert branch.index[0] == 0
    assert branch.index[-1] == 1
    # Corrections with all their digits: Newton's method as quick as elsewhere.
    assert np.max(branch.equilibria.iterations) <= 7
    assert np.all(branch.equilibria.neutral)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("GJ", "turns", "fold"), [(0.8, 7, 28.1577), pytest.param(2.0, 3, 13.3206, marks=pytest.mark.exhaustive)]
)
def test_a_loop_that_slides(GJ, turns, fold):
    """With little slack the loop is localised: free of its closure it would slide along its rod, at no cost."""
    angles = np.linspace(0.0, 2 * np.pi * turns, 4 * turns)
    branch = rj.follow(twisted(Rod(1.0, 1.0, GJ, 1e6), 0.8, angles), segments=32, guess=bow(0.8))
    assert branch.ended == BranchEnd.SCENES
    assert branch.parameter[-1] == 0.0
    assert_back_through_one_fold(branch)
    np.testing.assert_allclose(branch.critical_points[0].parameter * angles[1], fold, rtol=1e-4)


@pytest.mark.slow
def test_ends_of_a_twisted_rod_come_together():
    """The energy follows the pull of the end through the fold: dW/dD, by the trapezoidal rule."""
    ends = np.array([0.95, 0.1])
    clamp = Clamp(ORIGIN, frame(LEVEL))
    rod = Rod(1.0, 1.0, 0.8, 1e6)
    scenes = [Scene(rod, clamp, Clamp((x, 0.0, 0.0), frame(LEVEL)), turns=2) for x in ends]
    branch = rj.follow(scenes, segments=32, guess=bow(0.95, 0.1), max_points=20)
    assert branch.ended == BranchEnd.MAX_POINTS
    assert_back_through_one_fold(branch)
    np.testing.assert_allclose(branch.critical_points[0].parameter, 0.474592, rtol=1e-4)
    distance = np.interp(np.asarray(branch.parameter), [0.0, 1.0], ends)
    pull, energy = np.asarray(branch.equilibria.end_force)[:, 0], np.asarray(branch.equilibria.energy)
    gained = np.cumsum(np.diff(distance) * (pull[1:] + pull[:-1]) / 2)
    assert np.max(np.abs(energy[1:] - energy[0] - gained)) < 0.02 * np.ptp(energy)


# --- the loop of Fig. 1 past the chord -------------------------------------------------------------------------------

PAST_CHORD = np.radians(-15.0)


@pytest.fixture(scope="module")
def planar_loop() -> rj.Equilibrium:
    begin = rj.solve(rj.problems.omega(np.pi / 6, 0.0), segments=SEGMENTS, guess=rj.problems.figure_1_start())
    scene = rj.problems.omega(PAST_CHORD, 0.0)
    return rj.solve(scene, segments=SEGMENTS, guess=begin, find="equilibrium", planar=True)


def test_the_planar_loop_past_the_chord_is_a_saddle(planar_loop):
    assert planar_loop.converged
    assert not planar_loop.stable
    assert planar_loop.index >= 1
    np.testing.assert_allclose(planar_loop.nodes[:, 1], 0.0, atol=1e-12)
    assert np.min(planar_loop.nodes[:, 2]) < -0.3  # it still hangs


def test_a_path_past_the_chord_leaves_the_plane(planar_loop):
    """Its minimum at no turn is another planar shape, reached through space."""
    turns = np.linspace(0.0, 2 * np.pi, 9)
    scenes = [rj.problems.omega(PAST_CHORD, turn) for turn in turns]
    path = rj.solve_path(scenes, segments=SEGMENTS, guess=planar_loop)
    assert np.all(path.converged)
    assert np.all(path.stable)
    assert np.all(np.max(np.abs(path.nodes[1:-1, :, 1]), axis=1) > 0.01)
    assert path.energy[0] < 0.7 * planar_loop.energy


# --- derivatives -----------------------------------------------------------------------------------------------------


def critical_load(EI) -> jax.Array:
    return LOAD * rj.critical_point(strut(EI), segments=SEGMENTS).parameter


def test_the_derivative_of_eulers_load():
    """d P / d EI = pi^2/4 L^2, at every stiffness; eager reverse mode, first derivatives only."""
    value, by_EI = jax.value_and_grad(critical_load)(1.1)
    np.testing.assert_allclose(value, 1.1 * EULER, rtol=1e-6)
    np.testing.assert_allclose(by_EI, EULER, rtol=1e-6)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.grad(jax.grad(critical_load))(1.1)


@pytest.mark.slow
def test_the_derivative_of_a_fold():
    """Loads grow with all stiffnesses: EI dF/dEI + EA dF/dEA + GJ dF/dGJ = F (Euler). In its plane GJ does nothing."""
    near = rj.follow(arch(ROD), segments=SEGMENTS, guess=circle(), start=0.5, max_points=6)
    first = jax.tree.map(lambda leaf: leaf[-1], near.equilibria)
    start = float(near.parameter[-1])

    def fold(rod: Rod) -> jax.Array:
        point = rj.critical_point(arch(rod), guess=first, start=start)
        assert point.kind == "fold"
        return (2 * point.parameter - 1) * ARCH_LOAD

    value, by = jax.value_and_grad(fold)(ROD)
    np.testing.assert_allclose(by.EI * ROD.EI + by.EA * ROD.EA, value, rtol=1e-6)
    assert abs(by.GJ) < 1e-6
    shifted = [Rod(1.0, EI, 0.8, 1e6) for EI in (1.001, 0.999)]
    difference = (fold(shifted[0]) - fold(shifted[1])) / 0.002
    np.testing.assert_allclose(by.EI, difference, rtol=1e-5)


def test_small_turns_are_rotation_vectors():
    begin = frame((1.0, 2.0, 3.0), (0.0, 1.0, 1.0))
    for vector in ([0.0, 0.0, 0.0], [1e-3, -2e-3, 5e-4], [0.3, 1.0, -0.4], [2.5, 1.0, 1.0]):
        np.testing.assert_allclose(rotation_vector(begin, rj.rotate(begin, vector)), vector, atol=1e-12)
    jacobian = jax.jacfwd(lambda vector: rotation_vector(begin, rj.rotate(begin, vector)))(jnp.zeros(3))
    np.testing.assert_allclose(jacobian, np.eye(3), atol=1e-12)


# --- what is refused -------------------------------------------------------------------------------------------------


def moment_loaded(moment: float) -> Scene:
    return Scene(Rod(1.0, 1.0, 1.0, 1e4), Clamp(ORIGIN, frame(LEVEL)), Free(moment=(0.0, moment, 0.0)))


@pytest.mark.parametrize(
    ("scenes", "options", "message"),
    [
        ([pressed(0.0)], {}, "at least two"),
        (
            [moment_loaded(0.0), moment_loaded(1.0)],
            {},
            "dead moments on a free end, couples along the rod and follower loads have none",
        ),
        (strut(), {"start": 1.5}, "start must lie in 0 to 1"),
        (strut(), {"direction": 2}, "direction must be 1 or -1"),
        (strut(), {"step": 0.2}, "step must be at most max_step"),
        (strut(), {"max_step": -1.0}, "max_step must be positive"),
        (strut(), {"max_points": 0}, "max_points"),
    ],
)
def test_arguments_are_checked(scenes, options, message):
    with pytest.raises(ValueError, match=message):
        rj.follow(scenes, **options)


def test_a_branch_without_critical_point_says_so():
    with pytest.raises(ValueError, match=r"no critical point .* it reached the end of the scenes"):
        rj.critical_point([pressed(0.0), pressed(1.0)], segments=SEGMENTS)


def test_critical_point_needs_known_numbers():
    with pytest.raises(ValueError, match=r"outside jax\.jit"):
        jax.jit(critical_load)(1.0)


def test_switching_is_checked(straight):
    (point,) = straight.critical_points
    with pytest.raises(ValueError, match="side must be 1 or -1"):
        rj.switch_branch(strut(), point, side=0)
    with pytest.raises(TypeError, match="point must be a CriticalPoint"):
        rj.switch_branch(strut(), 0.5)  # pyright: ignore[reportArgumentType]


def test_a_path_has_as_many_equilibria_as_scenes(straight):
    with pytest.raises(ValueError, match="one equilibrium a scene, 2"):
        rj.critical_points(strut(), straight.equilibria)


def test_the_least_stiffness_counts_as_none():
    """An index counts eigenvalues below -NEUTRAL: as a part of Euler's load it is far below the tolerances here."""
    assert NEUTRAL / EULER < 1e-6
