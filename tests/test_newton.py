"""Newton's method: iterations independent of mesh and slenderness, minima and not saddles, options, flags, vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Scene, frame, problems
from rodjax.programs.compilation import program_count
from rodjax.solving import newton

# The twisting moment M L/EI up to which a rod between two clamps stays straight: smallest root of tan(M/2) = M/2.
GREENHILL = 8.986819


@pytest.mark.parametrize("slenderness", [20.0, 200.0, 2e5])
@pytest.mark.parametrize("segments", [10, pytest.param(50, marks=pytest.mark.slow)])
def test_steps_of_figure_1_take_few_iterations(segments, slenderness):
    """Thick, as in the report, or thin: EA L^2/EI from 1.6e3 to 1.6e11."""
    rod = problems.cable(slenderness)
    path = rj.solve_path(
        problems.figure_1(rod), segments=segments, discretization="finite_difference", guess=problems.figure_1_start()
    )
    assert np.all(path.converged)
    assert np.all(path.stable)
    assert np.all(path.substeps == 1)
    assert np.max(path.iterations) <= 5
    assert np.median(path.iterations) <= 4
    if slenderness == 2e5:
        return  # beyond conjugate gradients, whose rounding floor grows with EA
    last = jax.tree.map(lambda leaf: leaf[-1], path)
    again = rj.solve(problems.figure_1(rod)[-1], segments=segments, guess=last, solver=rj.NonlinearCG())
    # Both stop at a residual of 1e-8, in which energies are quadratic; what is left is rounding.
    np.testing.assert_allclose(again.energy, last.energy, rtol=1e-9)


@pytest.mark.parametrize("slenderness", [20.0, 2e5])
def test_a_radian_at_once_ends_where_ten_small_steps_do(slenderness):
    rod = problems.cable(slenderness)
    start = solved_omega(problems.ARC_HALF_ANGLE, rod, problems.figure_1_start())
    tilts = problems.ARC_HALF_ANGLE - np.linspace(0.1, 1.0, 10)
    at_once = solved_omega(tilts[-1], rod, start)
    assert at_once.stable
    assert at_once.iterations <= 10
    step_by_step = start
    for tilt in tilts:
        step_by_step = solved_omega(tilt, rod, step_by_step)
    # Both to a residual of 1e-8 or much better; the softest mode has some 10 EI/L^3.
    np.testing.assert_allclose(at_once.nodes, step_by_step.nodes, rtol=0, atol=1e-8)


def solved_omega(tilt: float, rod: rj.Rod, guess: rj.Guess | rj.Equilibrium) -> rj.Equilibrium:
    return rj.solve(problems.omega(tilt, 0.0, rod), segments=10, discretization="finite_difference", guess=guess)


# --- minima ----------------------------------------------------------------------------------------------------------


def solved_from_straight(span: float, rod: rj.Rod, turns: int = 0) -> rj.Equilibrium:
    """Between two clamps along one line, from the straight shape."""
    ends = [Clamp((x, 0, 0), frame((1, 0, 0))) for x in (0.0, span)]
    guess = rj.Guess([[0, 0, 0], [span, 0, 0]])
    return rj.solve(Scene(rod, *ends, turns=turns), segments=20, discretization="finite_difference", guess=guess)


def sideways(result: rj.Equilibrium) -> float:
    return float(jnp.max(jnp.linalg.norm(result.nodes[:, 1:], axis=1)))


@pytest.mark.parametrize("span", [0.6, 0.95])
def test_a_straight_column_buckles_out_of_its_saddle(span):
    """Into an arc that can spin about the line through both clamps: a neutral mode, which stops no iteration."""
    rod = problems.cable()
    result = solved_from_straight(span, rod)
    assert result.converged
    assert result.stable
    assert result.iterations <= 40
    assert sideways(result) > 0.1
    force = float(jnp.linalg.norm(result.end_force) * rod.length**2 / rod.EI)
    # Fixed ends buckle under 4 pi^2, less 1.6 % for 20 segments; the force then grows with the depth of the arc.
    assert 38.8 < force < 60


@pytest.mark.parametrize(("fraction", "buckles"), [(0.95, False), (1.1, True)])
def test_a_twisted_rod_buckles_beyond_greenhills_moment(fraction, buckles):
    """A whole turn, under less or more than the moment that a straight rod bears; 20 segments bear about as much."""
    twist = 2 * np.pi
    rod = rj.Rod(1.0, EI=1.0, GJ=fraction * GREENHILL / twist, EA=1e4)
    result = solved_from_straight(1.0, rod, turns=1)
    assert result.converged
    assert result.stable
    assert (sideways(result) > 1e-2) == buckles
    if not buckles:
        np.testing.assert_allclose(result.total_twist, twist, rtol=1e-12)
        assert sideways(result) < 1e-12  # straight up to the rounding of the guess
    else:
        assert result.total_twist < twist  # part of the twist has become writhe


@pytest.mark.parametrize("slenderness", [1e5, 1e6])
@pytest.mark.parametrize("direction", [(1, 0, 0), (1, 2, 3), (-3, 1, -5)])
def test_a_thin_rod_pulled_by_a_tenth_converges_to_its_rounding_floor(slenderness, direction):
    rod = problems.cable(slenderness)
    end = 1.1 * np.array(direction) / np.linalg.norm(direction)
    result = rj.solve(
        Scene(rod, *(Clamp(x, frame(direction)) for x in (np.zeros(3), end))),
        segments=20,
        discretization="finite_difference",
        strain_limit=0.2,
    )
    assert result.status == rj.Status.ROUNDING_FLOOR
    assert result.stable
    assert result.iterations <= 10
    # The tension is as good as the closure, which the last steps square.
    np.testing.assert_allclose(result.tension, 0.1 * float(rod.EA), rtol=1e-9)


@pytest.mark.parametrize("stiffness", [1.0, (1.0, 1.0)], ids=["tangents", "frames"])
def test_a_slack_cable_between_clamps_nearly_on_one_line_turns_about_it(stiffness):
    """Its bow costs nearly the same in all directions: the search goes along a valley, for a radian or more, whose
    curvature is some 1e-2 EI/L^2. The scene is the same after half a turn about the axis at right angles to the line
    and the offset: there the middle is.
    """
    rng = np.random.default_rng(5)
    level = frame((1.0, 0.0, 0.0))
    for _ in range(12):
        rod = rj.Rod(1.0, stiffness, rng.uniform(0.5, 1.0), 1e5)
        offset = np.array([0.0, *rng.uniform(-0.03, 0.03, 2)])
        end = np.array([rng.uniform(0.6, 0.97), 0.0, 0.0]) + offset
        found = rj.solve(Scene(rod, Clamp((0, 0, 0), level), Clamp(end, level)), segments=8)
        assert found.converged
        assert found.stable
        assert found.iterations <= 20  # seen: 12; with shifts of 1 EI/L^2 and more one in ten took more than 100
        away = found.nodes[4] - end / 2
        # Forces are balanced to 1e-8, the flattest of these valleys has some 1e-4.
        assert abs(away @ offset) < 1e-4 * np.linalg.norm(away) * np.linalg.norm(offset)


def test_a_saddle_that_is_not_left_is_flagged(monkeypatch):
    """Without the pushes off a saddle; a mesh that no other test compiles, since they are part of the program."""
    monkeypatch.setattr(newton, "MAX_PUSHES", 0)
    ends = [Clamp((x, 0, 0), frame((1, 0, 0))) for x in (0.0, 0.9)]
    with pytest.warns(rj.NotConvergedWarning, match="an equilibrium was found that is not a minimum"):
        result = rj.solve(
            Scene(problems.cable(), *ends),
            segments=13,
            discretization="finite_difference",
            guess=rj.Guess([[0, 0, 0], [0.9, 0, 0]]),
        )
    assert result.status == rj.Status.SADDLE
    assert not result.converged
    assert not result.stable


# --- options and flags -----------------------------------------------------------------------------------------------


def test_too_few_iterations_are_flagged():
    solver = rj.Newton(max_iterations=1)
    with pytest.warns(rj.NotConvergedWarning, match="stopped at the largest number of iterations"):
        result = rj.solve(
            problems.omega(0.5, 0.0),
            segments=10,
            discretization="finite_difference",
            solver=solver,
            guess=problems.figure_1_start(),
        )
    assert result.status == rj.Status.MAX_ITERATIONS
    assert not result.converged
    assert not result.stable
    assert result.iterations == 1


def test_all_numbers_of_a_solver_have_one_program():
    """And are obeyed: residuals below each tolerance, more iterations for smaller ones and for smaller steps."""
    options = dict(segments=10, discretization="finite_difference", guess=problems.figure_1_start())
    solvers = [rj.Newton(tolerance=1e-4), rj.Newton(tolerance=1e-9), rj.Newton(tolerance=1e-9, max_rotation=0.1)]
    first = rj.solve(problems.omega(0.5, 0.0), **options)
    programs = program_count()
    results = [rj.solve(problems.omega(0.5, 0.0), solver=solver, **options) for solver in solvers]
    assert program_count() == programs
    assert all(result.residual <= solver.tolerance for result, solver in zip(results, solvers, strict=True))
    assert results[0].iterations < results[1].iterations < results[2].iterations
    np.testing.assert_allclose(results[2].energy, first.energy, rtol=1e-10)  # EA L^2/EI = 1.6e5 roundings


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(tolerance=-1.0), "tolerance must not be negative, got -1"),
        (dict(tolerance="small"), "tolerance must"),
        (dict(max_iterations=0), "max_iterations must be a whole number from 1"),
        (dict(max_iterations=2.5), "max_iterations must be a whole number from 1"),
        (dict(max_rotation=0.0), "max_rotation must lie between 0 and 3 rad, got 0.0"),
        (dict(max_rotation=3.2), "max_rotation must lie between 0 and 3 rad, got 3.2"),
        (dict(max_rotation=float("nan")), "max_rotation must be finite, got nan"),
        (dict(max_rotation="one"), "max_rotation must"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        rj.Newton(**options)


@pytest.mark.slow
def test_vmap_agrees_with_one_after_another():
    rod, guess = problems.cable(), problems.figure_1_start()
    tilts = problems.ARC_HALF_ANGLE - np.array([0.0, 0.3, 1.0])
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(problems.omega(tilt, 0.0, rod) for tilt in tilts))
    results = jax.jit(
        jax.vmap(lambda scene: rj.solve(scene, segments=10, discretization="finite_difference", guess=guess))
    )(stacked)
    assert np.all(results.stable)
    for k, tilt in enumerate(tilts):
        alone = solved_omega(tilt, rod, guess)
        assert results.iterations[k] == alone.iterations
        # The same iterations in other loops: roundings over the softest stiffness.
        np.testing.assert_allclose(results.nodes[k], alone.nodes, rtol=0, atol=1e-11)
