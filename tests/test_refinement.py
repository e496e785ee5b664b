"""Estimated errors against true ones, meshes for a tolerance, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import rodjax as rj
from rodjax import Clamp, Scene, frame, problems
from rodjax.programs.compilation import program_count
from rodjax.solving import equilibrium
from rodjax.solving.options import TRACED_SEGMENTS, Discretization
from rodjax.solving.refinement import GRADING, LONGEST, SIZES, first_size, graded, next_size

TWISTED = Scene(
    problems.cable(),
    Clamp((0, 0, 0), frame((1, 0.3, -0.5))),
    Clamp((0.5, 0.2, 0.1), frame((1, 1, 1))),
    (0.0, 1.0, -9.81),
)
SCENES = {"hanging cable": problems.hanging_cable(), "twisted": TWISTED}


@pytest.fixture(scope="module", params=SCENES)
def scene_and_truth(request) -> tuple[Scene, CubicSpline]:
    """An error of 2e-8 L or less, of fourth order from the meshes below."""
    fine = rj.solve(SCENES[request.param], segments=96, discretization="hermite")
    assert fine.error_estimate < 3e-8
    return SCENES[request.param], CubicSpline(fine.s, fine.nodes)


def true_error(result: rj.Equilibrium, truth: CubicSpline) -> float:
    return float(np.max(np.linalg.norm(truth(np.asarray(result.s)) - result.nodes, axis=1)))


@pytest.mark.parametrize(
    ("discretization", "segments", "margin"),
    # To leading order in the mesh: 1 to 4 % seen. That of the elements, of fourth order: 0.03 and 0.2 % seen.
    [("hermite", 16, 0.08), ("finite_difference", 32, 0.01)],
)
def test_the_estimate_is_the_error(scene_and_truth, discretization, segments, margin):
    scene, truth = scene_and_truth
    result = rj.solve(scene, segments=segments, discretization=discretization)
    np.testing.assert_allclose(result.error_estimate, true_error(result, truth), rtol=margin)


@pytest.mark.slow
def test_a_tolerance_is_met_and_not_by_far(scene_and_truth):
    scene, truth = scene_and_truth
    for rtol in (1e-3, 1e-5):
        result = rj.solve(scene, rtol=rtol)
        assert result.converged
        assert result.error_estimate <= rtol
        assert rtol / 30 <= true_error(result, truth) <= rtol
        # From the result on: nothing to do.
        again = rj.solve(scene, rtol=rtol, guess=result)
        assert again.iterations == 0
        np.testing.assert_array_equal(again.nodes, result.nodes)


@pytest.mark.parametrize(
    ("discretization", "asked"), [("hermite", {}), ("finite_difference", dict(discretization="finite_difference"))]
)
def test_without_segments_the_error_is_below_a_thousandth(scene_and_truth, discretization, asked):
    scene, truth = scene_and_truth
    result = rj.solve(scene, **asked)
    assert result.converged
    assert result.discretization == discretization
    assert result.error_estimate < 1e-3
    # Seen 2.7e-4 and 3.1e-4 with 8 elements, 2.0e-4 and 2.2e-4 with 64 edges.
    assert true_error(result, truth) < 1e-3
    programs = program_count()
    again = rj.solve(scene, guess=result)
    # Before the comparison below, which JAX compiles.
    assert program_count() == programs
    assert again.discretization == discretization
    assert again.iterations == 0


@pytest.mark.slow
def test_a_path_is_refined_as_a_whole():
    scenes, guess = problems.figure_1()[::8], problems.figure_1_start()
    path = rj.solve_path(scenes, rtol=1e-4, guess=guess)
    assert np.all(path.converged)
    assert path.error_estimate.shape == (4,)
    assert np.all(path.error_estimate <= 1e-4)
    again = rj.solve_path(scenes, segments=path.s.shape[-1] - 1, guess=guess)
    np.testing.assert_array_equal(again.nodes, path.nodes)


def test_a_guess_whose_mesh_is_kept_brings_its_elements(scene_and_truth):
    scene, _ = scene_and_truth
    first = rj.solve(scene, segments=16, discretization="hermite")
    for again in (
        rj.solve(scene, guess=first),
        jax.tree.map(lambda leaf: leaf[0], rj.solve_path([scene], guess=first)),
    ):
        assert again.iterations == 0
        np.testing.assert_array_equal(again.nodes, first.nodes)


def test_every_entry_of_a_stack_has_its_estimate():
    result = rj.solve(TWISTED, segments=16, discretization="hermite")
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), result)
    assert stack.error_estimate.shape == (2,)
    # The same operations, vectorised.
    np.testing.assert_allclose(stack.error_estimate, result.error_estimate, rtol=1e-9)


@pytest.mark.parametrize("discretization", TRACED_SEGMENTS)
def test_inside_jit_the_mesh_has_one_size(discretization: Discretization):
    traced = jax.eval_shape(lambda scene: rj.solve(scene, discretization=discretization), problems.hanging_cable())
    assert traced.s.shape == (TRACED_SEGMENTS[discretization] + 1,)
    assert traced.discretization == discretization


@pytest.mark.slow
def test_inside_jit_the_mesh_is_given():
    result = jax.jit(lambda scene: rj.solve(scene, rtol=1e-8))(problems.hanging_cable())
    assert result.s.shape == (33,)
    assert result.error_estimate > 1e-8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(rtol=1e-3, segments=10), "segments must be None where rtol is given, got segments=10"),
        (dict(rtol=0.0), "rtol must be positive, got 0"),
        (dict(rtol=1e-12), "rtol must lie in 1e-10 to 1"),
        (dict(rtol="small"), "rtol must be a number, got 'small'"),
        (dict(discretization="spectral"), "discretization must be 'finite_difference' or 'hermite', got 'spectral'"),
        (dict(discretization="hermite", solver=rj.NonlinearCG()), "solver must be a Newton where discretization is"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        rj.solve(problems.hanging_cable(), **options)


# --- meshes ----------------------------------------------------------------------------------------------------------


def test_equal_defects_give_equal_elements():
    s = graded(jnp.linspace(0, 1, 9), jnp.full(8, 1e-5), 12)
    np.testing.assert_allclose(s, np.linspace(0, 1, 13), rtol=0, atol=1e-15)  # a few roundings


def test_elements_gather_where_the_defects_are():
    defects = jnp.array([1e-2, 1e-4, 1e-6, 1e-8, 1e-8, 0.0, 0.0, 0.0])
    s = np.asarray(graded(jnp.linspace(0, 1, 9), defects, 32))
    lengths = np.diff(s)
    assert s[0] == 0.0
    assert s[-1] == 1.0
    assert np.all(lengths > 0)
    np.testing.assert_allclose(lengths[0], np.min(lengths), rtol=1e-12)
    assert np.max(lengths) <= LONGEST / 32 * 1.5  # where others need more, the longest ones may too
    assert np.max(lengths[1:] / lengths[:-1]) <= GRADING * 1.01
    # Never shorter than a part of equal ones, to what longest elements take of the others.
    bounded = np.diff(graded(jnp.linspace(0, 1, 9), defects, 32, shortest=1 / 2))
    assert np.min(lengths) < 1 / 64
    assert np.min(bounded) * 1.5 >= 1 / 64


@pytest.mark.parametrize(
    ("segments", "error", "rtol", "discretization", "expected"),
    [
        (6, 1e-3, 1e-3, "hermite", 8),  # just missed
        (8, 1e-3, 1e-5, "hermite", 32),  # (120)^(1/4) = 3.3 times as many
        (8, 1.0, 1e-8, "hermite", 32),  # no more than four times
        (8, float("nan"), 1e-3, "hermite", 16),  # no estimate: twice
        (512, 1.0, 1e-8, "hermite", 512),
        (12, 1e-3, 1e-3, "finite_difference", 16),
        (12, 1e-2, 1e-3, "finite_difference", 48),  # (12)^(1/2) = 3.5 times as many
        (8, float("nan"), 1e-3, "finite_difference", 16),
        (4096, 1.0, 1e-8, "finite_difference", 4096),
    ],
)
def test_next_size(segments, error, rtol, discretization, expected):
    assert expected in SIZES[discretization]
    assert next_size(segments, error, rtol, discretization) == expected


def test_a_scene_that_does_not_converge_is_given_up():
    few = rj.Newton(max_iterations=1)
    with pytest.warns(rj.NotConvergedWarning, match="largest number of iterations"):
        result = rj.solve(problems.hanging_cable(), rtol=1e-2, discretization="finite_difference", solver=few)
    # Three meshes: 16 segments, twice as many each time.
    assert not result.converged
    assert result.s.shape == (65,)


@pytest.mark.parametrize(
    ("rtol", "discretization", "expected"),
    [
        (1.0, "hermite", 4),  # no mesh is coarser than the first
        (1e-2, "hermite", 4),  # (200)^(1/4) = 3.8
        (1e-3, "hermite", 8),  # (2000)^(1/4) = 6.7
        (1e-6, "hermite", 48),  # (2e6)^(1/4) = 37.6
        (1e-3, "finite_difference", 48),  # (2000)^(1/2) = 45
        (1e-9, "finite_difference", 4096),  # and none finer than the last
    ],
)
def test_first_size(rtol, discretization, expected):
    assert first_size(rtol, discretization) == expected


def test_the_finest_mesh_that_has_an_equilibrium_is_taken(monkeypatch):
    """Where finer meshes fail it stays, with what it lacks told."""
    coarse = rj.solve(rj.problems.hanging_cable(), segments=8)
    solve, sizes = equilibrium._solve, []

    def failing(scene, state, first, strain_limit, options):
        result = solve(scene, state, first, strain_limit, options)
        sizes.append(options.segments)
        if len(sizes) == 1:
            return result
        broken = (rj.Status.LINE_SEARCH_FAILED + 0 * result.status, result.converged & False)
        return eqx.tree_at(lambda result: (result.status, result.converged), result, broken)

    monkeypatch.setattr(equilibrium, "_solve", failing)
    with pytest.warns(rj.NotConvergedWarning, match="above rtol = 1e-06 on the finest mesh with an equilibrium"):
        result = rj.solve(rj.problems.hanging_cable(), rtol=1e-6, guess=coarse)
    assert len(sizes) > 1
    assert result.s.shape == (9,)
    assert result.converged
