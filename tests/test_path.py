"""solve_path(): turns carried, the same as single solves, what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Pin, Scene, frame, problems

SEGMENTS = 10


@pytest.fixture(scope="module")
def figure_1() -> rj.Equilibrium:
    return rj.solve_path(problems.figure_1(), segments=SEGMENTS, guess=problems.figure_1_start())


def test_a_path_is_the_single_solves_one_after_another(figure_1):
    guess: rj.Guess | rj.Equilibrium = problems.figure_1_start()
    for k, scene in enumerate(problems.figure_1()[:3]):
        guess = rj.solve(scene, segments=SEGMENTS, guess=guess)
        np.testing.assert_allclose(guess.nodes, figure_1.nodes[k], atol=1e-9)
        np.testing.assert_allclose(guess.energy, figure_1.energy[k], rtol=1e-11)


def test_turns_are_carried(figure_1):
    """Five turns of the end frame in steps of pi/2 on a straight rod give a total twist of 10 pi."""
    rod = problems.cable(20.0)
    start = Clamp((0, 0, 0), frame((1, 0, 0)))
    scenes = []
    for k in range(1, 21):
        cosine, sine = np.cos(k * np.pi / 2), np.sin(k * np.pi / 2)
        turned = frame((1, 0, 0), (0, cosine, sine))
        scenes.append(Scene(rod, start, Clamp((1.0, 0, 0), turned)))
    path = rj.solve_path(scenes, segments=4)
    np.testing.assert_allclose(path.total_twist, np.arange(1, 21) * np.pi / 2, atol=1e-9)
    assert np.all(np.diff(figure_1.total_twist[8:]) > 0)


def test_a_stacked_scene_is_a_path(figure_1):
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems.figure_1())
    path = rj.solve_path(stacked, segments=SEGMENTS, guess=problems.figure_1_start())
    np.testing.assert_array_equal(path.nodes, figure_1.nodes)


def test_an_unchanged_scene_takes_no_iteration(figure_1):
    last = jax.tree.map(lambda leaf: leaf[-1], figure_1)
    again = rj.solve_path([problems.figure_1()[-1]] * 3, guess=last)
    np.testing.assert_array_equal(again.iterations, 0)
    np.testing.assert_array_equal(again.nodes, jnp.broadcast_to(last.nodes, again.nodes.shape))


def test_progress_changes_nothing(figure_1, capsys):
    path = rj.solve_path(problems.figure_1(), segments=SEGMENTS, guess=problems.figure_1_start(), progress=True)
    np.testing.assert_array_equal(path.nodes, figure_1.nodes)
    assert "100.00%" in capsys.readouterr().err


def test_unconverged_steps_are_counted():
    solver = rj.NonlinearCG(max_iterations=16)
    with pytest.warns(rj.NotConvergedWarning, match="not converged: stopped at the largest number"):
        path = rj.solve_path(problems.figure_1(), segments=SEGMENTS, guess=problems.figure_1_start(), solver=solver)
    assert 0 < np.sum(path.converged) < 25


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
