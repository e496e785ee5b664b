"""The solver on the report's Fig. 1: iterations with and without preconditioner; the line search in rounding."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import problems
from rodjax.solving.line_search import Bracket, LineSearch


def figure_1(segments: int, solver: rj.NonlinearCG) -> rj.Equilibrium:
    return rj.solve_path(problems.figure_1(), segments=segments, guess=problems.figure_1_start(), solver=solver)


@pytest.mark.parametrize(
    "segments", [10, 50, pytest.param(200, marks=pytest.mark.slow), pytest.param(500, marks=pytest.mark.exhaustive)]
)
def test_preconditioned_iterations_do_not_depend_on_the_mesh(segments):
    path = figure_1(segments, rj.NonlinearCG())
    assert np.all(path.status == rj.Status.CONVERGED)  # 1e-8 lies above the rounding floor of these meshes
    assert np.max(path.iterations) <= 40
    assert np.max(path.residual) <= 1e-8


def test_plain_iterations_are_of_the_reports_cost_class():
    plain = figure_1(10, rj.NonlinearCG(preconditioner=None, tolerance=1e-6))
    assert np.all(plain.converged)
    assert 100 < np.median(plain.iterations) < 3000
    np.testing.assert_allclose(plain.nodes, figure_1(10, rj.NonlinearCG()).nodes, atol=1e-7)


def test_the_line_search_finds_the_minimum_of_a_line():
    """On a quartic, from trial steps far too short and far too long."""
    search = LineSearch(curvature=0.01)

    def energy(a):
        return (a - 3.0) ** 4 + (a - 3.0) ** 2

    def slope(a):
        return 4 * (a - 3.0) ** 3 + 2 * (a - 3.0)

    for step in (1e-4, 1.0, 100.0):
        bracket = Bracket.open(slope(jnp.array(0.0)))
        step = jnp.array(step)
        while not search.accepts(slope(step), slope(0.0), energy(step) <= search.energy_bound(energy(0.0))):
            is_low = energy(step) <= search.energy_bound(energy(0.0))
            bracket, step = search.narrowed(bracket, step, slope(step), is_low)
            assert bracket.trials < search.max_trials
        assert abs(step - 3.0) < 0.5


def test_a_step_into_an_infinite_energy_is_taken_back():
    search = LineSearch()
    bracket, step = search.narrowed(Bracket.open(jnp.array(-1.0)), jnp.array(1.0), jnp.array(jnp.nan), jnp.array(False))
    assert bracket.high == 1.0
    assert step == 0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(preconditioner="ilu"), "preconditioner must be 'gauss_newton' or None, got 'ilu'"),
        (dict(tolerance=-1.0), "tolerance must not be negative"),
        (dict(max_iterations=0), "max_iterations must be a whole number from 1"),
        (dict(refresh=0.5), "refresh must be a whole number"),
        (dict(line_search=0.1), "line_search must be a LineSearch, got 0.1"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        rj.NonlinearCG(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(curvature=1.0), "curvature must lie between 0 and 1, got 1.0"),
        (dict(expansion=1.0), "expansion must lie between 1.1 and inf"),
        (dict(max_trials=1), "max_trials must be a whole number from 2 to 1000"),
    ],
)
def test_bad_line_searches_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        LineSearch(**options)


def test_an_extreme_rod_is_solved_or_flagged_but_never_nan():
    """EA L^2/EI = 1e17: the Gauss-Newton Hessian is indefinite by rounding."""
    rod = rj.Rod(1.0, EI=1.0, GJ=1.0, EA=1e17)
    clamps = [rj.Clamp((x, 0, 0), rj.frame((1, 0, z))) for x, z in ((0, 1), (0.8, -1))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rj.NotConvergedWarning)
        result = rj.solve(rj.Scene(rod, *clamps), segments=10, solver=rj.NonlinearCG(max_iterations=50))
    assert np.all(np.isfinite(result.nodes))
    assert np.all(np.isfinite(result.end_force))
    assert result.converged == (result.residual <= 1e-8) or result.status == rj.Status.ROUNDING_FLOOR


def test_a_guess_without_length_is_as_good_as_another():
    """The first shape is unfolded; the solution has no memory of it: both are the minimum to the solver's tolerance."""
    guess = rj.Guess([[0, 0, 0], [0, 0, 0]])
    result = rj.solve(problems.cantilever(), segments=4, discretization="finite_difference", guess=guess)
    expected = rj.solve(problems.cantilever(), segments=4, discretization="finite_difference")
    assert result.converged
    np.testing.assert_allclose(result.nodes, expected.nodes, rtol=0, atol=1e-8)
