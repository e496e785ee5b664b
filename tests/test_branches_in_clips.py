"""Softest motions, critical points and branches of rods that slide through clips, beside closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve, minimize_scalar

import rodjax as rj
from rodjax import BranchEnd, Clamp, Clip, Free, Pin, PointForce, Potential, Rod, Scene, frame, problems
from rodjax.discretization.motion import Metric
from rodjax.solving.result_form import free_form_and_point

ORIGIN, X = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)
# EA L^2/EI of 1e8 shifts loads of 10 EI/L^2 by 1e-7.
EA = 1e8
GJ = 0.8


# --- columns ---------------------------------------------------------------------------------------------------------


def buckling_load(a: float, b: float) -> float:
    """Of a beam from a clamp over a span a to a support that holds it aside, and b beyond that, under a dead load at
    its free end, EI = 1: k^2 of deflections A (sin kx - kx) + B (cos kx - 1) and, beyond, F sin k (x - a - b).
    """

    def determinant(k: float) -> float:
        s, c = np.sin, np.cos
        deflection = [s(k * a) - k * a, c(k * a) - 1, 0]
        slope = [c(k * a) - 1, -s(k * a), -c(k * b)]
        curvature = [-s(k * a), -c(k * a), -s(k * b)]
        return float(np.linalg.det(np.array([deflection, slope, curvature])))

    k = np.linspace(0.1, 20.0, 4000)
    first = np.flatnonzero(np.diff(np.sign([determinant(each) for each in k])))[0]
    return brentq(determinant, k[first], k[first + 1], xtol=1e-14) ** 2


def column(load, clips: list[Clip], EI=1.0) -> Scene:
    end = Free(force=jnp.array([-1.0, 0.0, 0.0]) * load)
    return Scene(Rod(1.0, EI, GJ, EA), Clamp(ORIGIN, frame(X)), end, clips=clips)


def at(place, tangent=None) -> Clip:
    """Where the straight rod passes it, but for its strain."""
    return Clip(0.6, jnp.array([1.0, 0.0, 0.0]) * place, tangent, sliding=True)


def of_clips(place: float, tangent: tuple[float, ...] | None) -> float:
    """What is beyond a clip that holds the direction, 0.4 long, is a cantilever, and softer than what is before it."""
    return buckling_load(place, 1 - place) if tangent is None else np.pi**2 / 4 / (1 - place) ** 2


@pytest.mark.parametrize("tangent", [None, X])
def test_a_column_loses_the_stiffness_by_which_it_is_pressed(tangent):
    """Its tangents are what turns: EI theta'' + (P + stiffness) theta is constant along each span."""
    most = of_clips(0.6, tangent)
    straight = rj.solve(column(0.0, [at(0.6, tangent)]), segments=24)
    for part, index in ((0.5, 0), (1.1, 2)):
        scene = column(part * most, [at(0.6, tangent)])
        straight = rj.solve(scene, segments=24, guess=straight, find="equilibrium")
        assert straight.index == index
        mode = rj.lowest_mode(straight)
        # The mesh error of 24 elements, 1e-6 of the load.
        assert mode.stiffness == pytest.approx((1 - part) * most, abs=3e-6 * most)
        beside = np.argmin(np.abs(straight.s - straight.scene.clips[0].at))
        np.testing.assert_allclose(mode.displacement[beside], 0.0, rtol=0, atol=1e-6)


def critical(place, EI, tangent, segments=32, most=None):
    """The load of the first critical point."""
    most = 2 * of_clips(0.6, tangent) if most is None else most
    scenes = [column(load, [at(place, tangent)], EI) for load in (0.0, most)]
    return most * rj.critical_point(scenes, segments=segments).parameter


@pytest.mark.slow
@pytest.mark.parametrize("tangent", [None, pytest.param(X, marks=pytest.mark.exhaustive)])
def test_critical_loads_of_columns_and_their_derivatives(tangent):
    """By the clip's place those of the closed form, by EI the load itself."""
    load, (by_position, by_EI) = jax.value_and_grad(critical, argnums=(0, 1))(0.6, 1.0, tangent)
    # The mesh error of 32 elements.
    np.testing.assert_allclose(load, of_clips(0.6, tangent), rtol=1e-6)
    np.testing.assert_allclose(by_EI, load, rtol=2e-6)
    closed = (of_clips(0.6 + 1e-4, tangent) - of_clips(0.6 - 1e-4, tangent)) / 2e-4
    np.testing.assert_allclose(by_position, closed, rtol=3e-6)
    # Differences of fourth order.
    wide, narrow = ((critical(0.6 + h, 1.0, tangent) - critical(0.6 - h, 1.0, tangent)) / (2 * h) for h in (2e-3, 1e-3))
    np.testing.assert_allclose(by_position, (4 * narrow - wide) / 3, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("discretization", ["hermite", pytest.param("finite_difference", marks=pytest.mark.exhaustive)])
def test_a_column_in_two_clips(discretization):
    """The first holds the direction: what is beyond is a column of its own."""
    load = buckling_load(0.3, 0.2)
    clips = [Clip(0.5, (0.5, 0.0, 0.0), X, sliding=True), Clip(0.8, (0.8, 0.0, 0.0), sliding=True)]
    scenes = [column(0.0, clips), column(2 * load, clips)]
    segments, error = (40, 3e-6) if discretization == "hermite" else (120, 1e-2)
    point = rj.critical_point(scenes, segments=segments, discretization=discretization)
    assert (point.kind, point.index_before, point.index_after) == ("branch", 0, 2)
    np.testing.assert_allclose(2 * load * point.parameter, load, rtol=error)
    assert abs(point.mode.stiffness) < 1e-7
    np.testing.assert_allclose(rj.lowest_mode(point.equilibrium).stiffness, point.mode.stiffness, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_flat_column_buckles_to_one_side():
    """By frames; the index grows by one at the load of each stiffness, where the softest motion loses its own."""
    clips = [at(0.6)]
    scenes = [column(load, clips, EI=(2.0, 1.0)) for load in (0.0, 3 * of_clips(0.6, None))]
    branch = rj.follow(scenes, segments=24)
    assert branch.ended == BranchEnd.SCENES
    assert [(point.index_before, point.index_after) for point in branch.critical_points] == [(0, 1), (1, 2)]
    loads = 3 * np.array([float(point.parameter) for point in branch.critical_points])
    np.testing.assert_allclose(loads, [1.0, 2.0], rtol=5e-6)
    np.testing.assert_array_equal(branch.index, branch.equilibria.index)
    stiffness = rj.lowest_mode(branch.equilibria).stiffness
    np.testing.assert_array_equal(np.asarray(stiffness) < 0, np.asarray(branch.index) > 0)


@pytest.mark.slow
def test_a_path_stops_before_its_column_buckles():
    clips, load = [at(0.6)], of_clips(0.6, None)
    scenes = [column(part * load, clips) for part in (0.5, 0.8, 1.1, 1.4)]
    stopped = rj.solve_path(scenes, segments=16, at_critical="stop")
    assert stopped.energy.shape == (2,)
    assert np.all(stopped.stable)


def bedding(position):
    return 100.0 * (position[1] ** 2 + position[2] ** 2) / 2


@pytest.mark.slow
def test_a_column_in_a_clip_on_a_bedding():
    """Between pins, in a clip half way, it buckles in two half waves, which a bedding k makes stiffer."""
    field, most = Potential(lambda position, s: bedding(position)), 60.0

    def scene(load: float) -> Scene:
        far = Pin((1 - load / EA, 0.0, 0.0))
        return Scene(Rod(1.0, 1.0, GJ, EA), Pin(ORIGIN), far, potentials=[field], clips=[at(0.5)])

    straight = rj.Guess(np.linspace(ORIGIN, X, 5))
    point = rj.critical_point([scene(0.0), scene(most)], segments=32, guess=straight)
    expected = 4 * np.pi**2 + 100.0 / (4 * np.pi**2)
    assert (point.index_before, point.index_after) == (0, 2)
    np.testing.assert_allclose(-point.equilibrium.end_force[0], expected, rtol=1e-6)


# --- the softest motion of a bent rod --------------------------------------------------------------------------------


def bent(tangent, weight=1.0) -> Scene:
    clip = Clip(0.5, (0.35, 0.05, 0.1), tangent, sliding=True)
    ends = Clamp(ORIGIN, frame((1, 0, -1))), Clamp((0.6, 0.2, 0.0), frame((1, 1, 0)))
    return Scene(problems.cable(100.0), *ends, jnp.array([0.0, 3.0, -9.81]) * weight, clips=[clip])


def jacobian(result: rj.Equilibrium) -> tuple[jax.Array, jax.Array]:
    """Of the residual by rotations and multipliers, by automatic derivatives; and the metric, zero for forces."""
    form, point = free_form_and_point(result)
    here = form.linearized(point)
    b, m = here.gradient.shape

    def residual_vectors(change: jax.Array) -> jax.Array:
        turned, multipliers = change[: b * m].reshape(b, m), change[b * m :]
        force = form.layout.forces(form.force_components(multipliers))
        gradient, constraint_residual = form.residual_vectors(
            form.retract(point, here.bases, turned, force, form.others(multipliers))
        )
        return jnp.concatenate([gradient.reshape(-1), constraint_residual])

    metric = Metric.of(form, here)
    slides = jnp.full(form.sliding_count, jnp.sum(metric.mass))
    forces = jnp.zeros(len(here.constraint_residual) - form.sliding_count)
    mass = jnp.concatenate([jnp.tile(metric.mass, b), slides, forces])
    return jax.jacfwd(residual_vectors)(jnp.zeros(len(mass))), mass


@pytest.mark.slow
@pytest.mark.parametrize("tangent", [None, (1.0, 0.3, 0.4)])
def test_the_lowest_eigenvalue_is_that_of_the_dense_jacobian(tangent):
    result = rj.solve(bent(tangent), segments=10, rtol=None, solver=rj.Newton(tolerance=1e-12))
    matrix, mass = (np.asarray(x) for x in by_numpy(jacobian)(result))
    used = np.any(matrix != 0, axis=0)
    matrix, mass = matrix[np.ix_(used, used)], mass[used]
    has_mass = mass > 0
    # The forces follow from what has mass.
    inner = np.linalg.solve(matrix[np.ix_(~has_mass, ~has_mass)], matrix[np.ix_(~has_mass, has_mass)])
    condensed = matrix[np.ix_(has_mass, has_mass)] - matrix[np.ix_(has_mass, ~has_mass)] @ inner
    values = np.linalg.eigvals(condensed / mass[has_mass][:, None])
    lowest = values[np.argmin(values.real)]
    assert abs(lowest.imag) < 1e-9 * abs(lowest.real)
    unit = float(result.scene.rod.bending_scale) / float(result.scene.rod.length) ** 2
    # Inverse iterations gain seven digits; multiples of the residual are left.
    np.testing.assert_allclose(rj.lowest_mode(result).stiffness / unit, lowest.real, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("tangent", [None, pytest.param((1.0, 0.3, 0.4), marks=pytest.mark.exhaustive)])
def test_the_derivative_of_the_softest_stiffness(tangent):
    options = {"segments": 12, "solver": rj.Newton(tolerance=1e-12)}
    base = rj.solve(bent(tangent), **options)

    def stiffness(weight):
        return rj.lowest_mode(rj.solve(bent(tangent, weight), guess=base, **options)).stiffness

    slope = jax.grad(stiffness)(1.0)
    wide, narrow = ((stiffness(1 + h) - stiffness(1 - h)) / (2 * h) for h in (0.02, 0.01))
    np.testing.assert_allclose(slope, (4 * narrow - wide) / 3, rtol=1e-6)


def test_half_way_the_rod_slides_away():
    """By symmetry the energy of a cable lifted in its middle is largest there: the softest motion slides."""
    ends = Clamp(ORIGIN, frame(X)), Clamp((0.8, 0.0, 0.0), frame(X))
    held, scene = (
        Scene(problems.cable(100.0), *ends, (0.0, 0.0, -9.81), clips=[Clip(0.5, (0.4, 0.0, 0.1), sliding=sliding)])
        for sliding in (False, True)
    )
    result = rj.solve(scene, segments=32, guess=rj.solve(held, segments=32), find="equilibrium")
    assert result.index == 1
    mode = rj.lowest_mode(result)
    assert mode.stiffness < 0
    # Places of the rod move, that in the clip along it.
    moves = np.asarray(mode.displacement)
    middle = len(moves) // 2
    assert np.linalg.norm(moves[middle]) > 0.1
    np.testing.assert_allclose(np.cross(moves[middle], result.tangents[middle]), 0.0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(moves[:, 2], -moves[::-1, 2], rtol=0, atol=1e-6)
    away = rj.solve(scene, segments=32, guess=result)
    assert away.index == 0
    assert rj.lowest_mode(away).stiffness > 0


# --- a rod that is pressed through its clip --------------------------------------------------------------------------

KNIFE, LOADED = 0.5, 0.35
LOADS = 20.0, 60.0


def pressed(load, place=KNIFE, EI=1.0, stiffness=EA) -> Scene:
    """From a clamp over a knife edge that it slides on, under a dead load on one of its places."""
    clip = Clip(0.505, jnp.array([1.0, 0.0, 0.0]) * place, sliding=True)
    loads = [PointForce(LOADED, jnp.array([0.0, 0.0, -1.0]) * load)]
    return Scene(Rod(1.0, EI, GJ, stiffness), Clamp(ORIGIN, frame(X)), Free(), point_forces=loads, clips=[clip])


def elastica(s: float, guess: np.ndarray) -> np.ndarray:
    """Moment and force at the clamp, and the load, here upwards, of the elastica that passes the edge at s: no moment
    there and no force along it; by shooting, EI = 1.
    """

    def at_edge(unknown: np.ndarray) -> list[float]:
        moment, along, up, load = unknown

        def rates(_, y, up):
            return [np.cos(y[2]), np.sin(y[2]), y[3], np.sin(y[2]) * along - np.cos(y[2]) * up]

        tight = {"rtol": 1e-12, "atol": 1e-13}
        loaded = solve_ivp(rates, (0, LOADED), [0, 0, 0, moment], args=(up,), **tight).y[:, -1]
        x, z, angle, left = solve_ivp(rates, (LOADED, s), loaded, args=(up - load,), **tight).y[:, -1]
        return [x - KNIFE, z, left, along * np.cos(angle) + (up - load) * np.sin(angle)]

    return fsolve(at_edge, guess, xtol=1e-13)


@functools.cache
def largest_load() -> tuple[float, float]:
    """And the arclength that passes the edge there."""
    guess = np.array([0.5, -0.5, 5.0, 10.0])
    for s in np.linspace(0.502, 0.575, 15):
        guess = elastica(s, guess)
    found = minimize_scalar(
        lambda s: -elastica(s, guess)[3], bounds=(0.565, 0.58), method="bounded", options={"xatol": 1e-8}
    )
    return -found.fun, found.x


@pytest.fixture(scope="module")
def through() -> rj.Branch:
    return rj.follow([pressed(load) for load in LOADS], segments=48, max_points=18)


def load_of(parameter):
    return LOADS[0] + (LOADS[1] - LOADS[0]) * parameter


@pytest.mark.slow
def test_a_rod_is_pressed_through_its_clip(through):
    """It gives way at the largest load of the elastica."""
    load, place = largest_load()
    (fold,) = through.critical_points
    assert (fold.kind, fold.index_before, fold.index_after) == ("fold", 0, 1)
    # The mesh error of 48 elements; the place has half of the digits.
    np.testing.assert_allclose(load_of(fold.parameter), load, rtol=3e-6)
    np.testing.assert_allclose(fold.equilibrium.scene.clips[0].at, place, rtol=0, atol=1e-4)
    assert abs(fold.mode.stiffness) < 1e-7
    np.testing.assert_array_equal(through.index, through.equilibria.index)
    # It goes on with ever more rod between the supports.
    places = np.asarray(through.equilibria.scene.clips[0].at)
    assert np.all(np.diff(places) > 0)
    assert places[-1] > place + 0.1
    assert np.all(through.equilibria.converged)


@pytest.mark.slow
@pytest.mark.exhaustive
def test_by_finite_differences_it_gives_way_too():
    """Of second order: twice as many edges leave a quarter of the error."""
    load, _ = largest_load()
    errors = []
    for segments in (48, 96):
        branch = rj.follow(
            [pressed(load) for load in LOADS], segments=segments, max_points=16, discretization="finite_difference"
        )
        (fold,) = branch.critical_points
        assert (fold.kind, fold.index_before, fold.index_after) == ("fold", 0, 1)
        assert float(branch.equilibria.scene.clips[0].at[-1]) > 0.63  # on another mesh
        errors.append(float(load_of(fold.parameter)) - load)
    assert abs(errors[1]) < 0.02 * load
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=1.0)


@pytest.mark.slow
def test_its_mesh_goes_along(through):
    """A mesh is made anew where a span between supports has grown by a quarter, 0.125 at first; all of that lies beyond
    the load, where 0.15 was: elements there have become 1.8 times as long. Without new meshes they were 2.7 times.
    """
    lengths = np.diff(np.asarray(through.equilibria.s), axis=1)
    assert np.max(lengths) < 1.8 / 48
    assert np.min(lengths) > 0.6 / 48
    places = np.asarray(through.equilibria.scene.clips[0].at)
    assert (places[-1] - LOADED) / (places[0] - LOADED) > 1.8


@pytest.mark.slow
def test_its_energy_follows_the_load(through):
    """dW/dF is the height of the loaded place: by the trapezoidal rule, also where the mesh was made anew."""
    results, loads = through.equilibria, load_of(np.asarray(through.parameter))
    nodes = np.argmin(np.abs(np.asarray(results.s) - LOADED), axis=1)
    height = np.asarray(results.nodes)[np.arange(len(nodes)), nodes, 2]
    gained = np.cumsum(np.diff(loads) * (height[1:] + height[:-1]) / 2)
    energy = np.asarray(results.energy)
    assert np.max(np.abs(energy[1:] - energy[0] - gained)) < 0.01 * np.ptp(energy)


@pytest.mark.slow
def test_the_derivative_of_the_largest_load(through):
    """Loads grow with all stiffnesses: EI dF/dEI + EA dF/dEA = F; and by the place of the edge."""
    numbers = [k for k, index in enumerate(np.asarray(through.index)) if index == 0]
    start, first = (
        float(through.parameter[numbers[-2]]),
        jax.tree.map(lambda leaf: leaf[numbers[-2]], through.equilibria),
    )

    def fold(place, EI=1.0, stiffness=EA):
        scenes = [pressed(load, place, EI, stiffness) for load in LOADS]
        return load_of(rj.critical_point(scenes, guess=first, start=start).parameter)

    load, (by_position, by_EI, by_EA) = jax.value_and_grad(fold, argnums=(0, 1, 2))(KNIFE, 1.0, EA)
    np.testing.assert_allclose(by_EI + EA * by_EA, load, rtol=1e-6)
    wide, narrow = ((fold(KNIFE + h) - fold(KNIFE - h)) / (2 * h) for h in (2e-4, 1e-4))
    np.testing.assert_allclose(by_position, (4 * narrow - wide) / 3, rtol=1e-6)
