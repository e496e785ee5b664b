"""solve_path(): turns carried, the same as single solves, prediction, steps that are split, what it refuses."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Pin, Scene, Status, frame, problems
from rodjax.model.scene import between
from rodjax.paths.path import MAX_SPLITS

SEGMENTS = 10


def solve(scene: Scene, **options) -> rj.Equilibrium:
    return rj.solve(scene, segments=SEGMENTS, discretization="finite_difference", **options)


def solve_path(scenes: Sequence[Scene] | Scene, segments: int = SEGMENTS, **options) -> rj.Equilibrium:
    """By finite differences, which are quick to compile: prediction and splitting do not look at the mesh."""
    return rj.solve_path(scenes, segments=segments, discretization="finite_difference", **options)


@pytest.fixture(scope="module")
def figure_1() -> rj.Equilibrium:
    return solve_path(problems.figure_1(), guess=problems.figure_1_start())


def test_a_path_is_the_single_solves_one_after_another(figure_1):
    guess: rj.Guess | rj.Equilibrium = problems.figure_1_start()
    for k, scene in enumerate(problems.figure_1()[:3]):
        guess = solve(scene, guess=guess)
        np.testing.assert_allclose(guess.nodes, figure_1.nodes[k], atol=1e-9)
        np.testing.assert_allclose(guess.energy, figure_1.energy[k], rtol=1e-11)


def test_turns_are_carried(figure_1):
    """Five turns of the end frame in steps of pi/2 on a straight rod give a total twist of 10 pi."""
    rod = rj.Rod(1.0, EI=1.0, GJ=0.1, EA=1600.0)  # soft in torsion, so that it stays straight: it buckles at 9 EI/L
    start = Clamp((0, 0, 0), frame((1, 0, 0)))
    scenes = []
    for k in range(1, 21):
        cosine, sine = np.cos(k * np.pi / 2), np.sin(k * np.pi / 2)
        turned = frame((1, 0, 0), (0, cosine, sine))
        scenes.append(Scene(rod, start, Clamp((1.0, 0, 0), turned)))
    path = solve_path(scenes, 4)
    np.testing.assert_allclose(path.total_twist, np.arange(1, 21) * np.pi / 2, atol=1e-9)
    assert np.all(np.diff(figure_1.total_twist[8:]) > 0)


def test_a_stacked_scene_is_a_path(figure_1):
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems.figure_1())
    path = solve_path(stacked, guess=problems.figure_1_start())
    np.testing.assert_array_equal(path.nodes, figure_1.nodes)


def test_an_unchanged_scene_takes_no_iteration(figure_1):
    last = jax.tree.map(lambda leaf: leaf[-1], figure_1)
    again = solve_path([problems.figure_1()[-1]] * 3, guess=last)
    np.testing.assert_array_equal(again.iterations, 0)
    np.testing.assert_array_equal(again.nodes, jnp.broadcast_to(last.nodes, again.nodes.shape))


@pytest.mark.optimized
def test_progress_changes_nothing(figure_1, capsys):
    path = solve_path(problems.figure_1(), guess=problems.figure_1_start(), progress=True)
    np.testing.assert_array_equal(path.nodes, figure_1.nodes)
    assert "100.00%" in capsys.readouterr().err


def test_unconverged_steps_are_counted():
    # Even in parts only some of the steps take so few iterations.
    solver = rj.NonlinearCG(max_iterations=8)
    with pytest.warns(rj.NotConvergedWarning, match="not converged: stopped at the largest number"):
        path = solve_path(problems.figure_1(), guess=problems.figure_1_start(), solver=solver)
    assert 0 < np.sum(path.converged) < 25  # 7 seen


def step(path: rj.Equilibrium, k: int) -> rj.Equilibrium:
    return jax.tree.map(lambda leaf: leaf[k], path)


def test_prediction_saves_iterations(figure_1):
    """Within a series of like steps, from the third scene on; the 10th is the first that turns the end frame."""
    assert np.median(figure_1.iterations) == 2
    assert np.max(figure_1.iterations) <= 3
    for k in (5, 15):
        unpredicted = solve(problems.figure_1()[k], guess=step(figure_1, k - 1))
        assert figure_1.iterations[k] < unpredicted.iterations


@pytest.mark.parametrize("EI", [1.0, (1.0, 1.3)], ids=["tangents", "frames"])
def test_prediction_on_elements_saves_iterations(EI):
    """Either kind of shape is extrapolated by a rule of its own; in like steps 2 iterations instead of 3."""
    rod, start = rj.Rod(1.0, EI, 0.7, 1e4), Clamp((0, 0, 0), frame((1, 0, 0)))
    ends = [Clamp((0.8, 0.01 * k, 0.02 * k), frame((1, 0, 0))) for k in range(6)]
    scenes = [Scene(rod, start, end, (0, 0, -5.0)) for end in ends]
    path = rj.solve_path(scenes, segments=8)
    for k in (3, 4, 5):
        unpredicted = rj.solve(scenes[k], segments=8, guess=step(path, k - 1))
        assert path.iterations[k] < unpredicted.iterations


# --- steps that are split --------------------------------------------------------------------------------------------


def test_steps_that_converge_are_not_split(figure_1):
    np.testing.assert_array_equal(figure_1.substeps, 1)
    single = solve(problems.figure_1()[0], guess=problems.figure_1_start())
    assert single.substeps == 1


def test_a_step_too_large_for_the_solver_is_split(figure_1):
    """The end frame turned by 3 rad at once takes 4 iterations of Newton's method, of which 3 are allowed."""
    level, turned = problems.figure_1()[8], problems.omega(np.pi / 6, 3.0)
    solver = rj.Newton(max_iterations=3)
    with pytest.warns(rj.NotConvergedWarning, match="largest number of iterations"):
        solve(turned, guess=step(figure_1, 8), solver=solver)
    split = solve_path([level, turned], guess=step(figure_1, 8), solver=solver)
    assert np.all(split.converged)
    assert split.substeps[0] == 1
    # One solve that fails at the least; each converged one doubles the share, so that two halves do it at best.
    assert 3 <= split.substeps[1] <= 2 ** (MAX_SPLITS + 1)
    assert split.substeps[1] < split.iterations[1] <= 3 * split.substeps[1]
    fine = [between(level, turned, jnp.asarray(fraction)) for fraction in np.linspace(0.0, 1.0, 25)]
    path = solve_path(fine, guess=problems.figure_1_start())
    # Residuals of 1e-8 EI/L^2 at most, against a stiffness of 1e2 EI/L^3.
    np.testing.assert_allclose(split.nodes[-1], path.nodes[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(split.total_twist[-1], path.total_twist[-1], rtol=0, atol=1e-9)


def test_a_step_that_no_split_helps_is_given_up_and_flagged():
    """One iteration a solve, and no residual is small enough."""
    scenes = [problems.omega(0.6, 0.0), problems.omega(0.6, 3.0)]
    solver = rj.Newton(max_iterations=1, tolerance=0.0)
    with pytest.warns(rj.NotConvergedWarning, match="2 not converged: stopped at the largest number of iterations"):
        path = solve_path(scenes, guess=problems.figure_1_start(), solver=solver)
    np.testing.assert_array_equal(path.status, Status.MAX_ITERATIONS)
    assert not np.any(path.stable)
    # The first scene has nothing to be split from. The second is tried at once, halved so often, and at once again.
    np.testing.assert_array_equal(path.substeps, [1, 1 + MAX_SPLITS + 1])
    np.testing.assert_array_equal(path.iterations, path.substeps)  # those of all solves
    assert np.all(path.evaluations > path.iterations)
    assert np.all(np.isfinite(path.nodes))


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ([], "at least one scene"),
        (problems.cantilever(), "got a single scene"),
        (
            [problems.cantilever(), problems.hanging_cable()],
            r"scenes\[0\] with Clamp-Free.* scenes\[1\] with Clamp-Clamp, gravity",
        ),
        ([problems.cantilever(), 3], r"scenes\[1\] must be a Scene, got 3"),
        ([Scene(problems.cable(), Pin((0, 0, 0)), Pin((1, 0, 0))), problems.figure_1()[0]], "Pin-Pin"),
    ],
)
def test_bad_paths_are_refused(scenes, message):
    with pytest.raises((ValueError, TypeError), match=message):
        rj.solve_path(scenes)
