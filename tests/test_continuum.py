"""The continuous rod: closed forms, every pair of supports, derivatives, and that it says when it fails.

Tracing takes seconds for each pair of supports, so that most pairs are slow tests.
"""

import itertools
import math
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

import rodjax as rj
from rodjax import Clamp, Free, Pin, PointForce, Rod, Scene, Swivel, frame, problems, solve_continuum
from rodjax.analysis import continuum

LEVEL = frame((1, 0, 0))
ORIGIN = (0.0, 0.0, 0.0)
# Stations and supports meet to 1e-10; what is tested here goes on to the last Newton step, far below.
RESIDUAL = 1e-10


def sections_close(result: rj.Equilibrium, expected: rj.Equilibrium, atol: float) -> None:
    """Equal in units of the rod."""
    EI = float(result.state.units.energy * result.state.units.length)
    np.testing.assert_allclose(result.nodes, expected.nodes, atol=atol)
    np.testing.assert_allclose(result.tangents, expected.tangents, atol=atol)
    for name in ("start_force", "start_moment", "end_force", "end_moment", "energy", "elastic_energy", "tension"):
        np.testing.assert_allclose(getattr(result, name) / EI, getattr(expected, name) / EI, atol=atol, err_msg=name)


@pytest.fixture(scope="module")
def figure_1() -> tuple[Scene, rj.Equilibrium]:
    """Stage f of Fig. 1 and a discrete equilibrium there, after a full turn."""
    scenes = problems.figure_1()
    path = rj.solve_path(scenes, segments=50, discretization="finite_difference", guess=problems.figure_1_start())
    return scenes[-1], jax.tree.map(lambda leaf: leaf[-1], path)


def test_figure_1(figure_1):
    scene, guess = figure_1
    EI = float(scene.rod.EI)
    result = solve_continuum(scene, guess)
    assert result.converged
    assert result.residual < RESIDUAL
    assert result.nodes.shape == guess.nodes.shape
    assert np.isnan(result.error_estimate)
    # Five digits from shooting with scipy; the others are those that rtol and intervals do not change.
    np.testing.assert_allclose(result.elastic_energy / EI, 19.969576807, rtol=1e-10)
    np.testing.assert_allclose(result.total_twist, 4.98757, atol=5e-6)
    # The discrete one is second order: at 50 segments 4e-4 off, test_validation.
    np.testing.assert_allclose(result.nodes, guess.nodes, atol=4e-4)
    np.testing.assert_allclose(result.energy, result.elastic_energy, rtol=1e-14)
    # The supports, to the residual.
    for end, k in ((scene.start, 0), (scene.end, -1)):
        np.testing.assert_allclose(result.nodes[k], end.position, atol=RESIDUAL)
        np.testing.assert_allclose(result.frames[k], end.frame, atol=RESIDUAL)
    # n is constant without dead loads, and m changes by the arm of n: statics of the whole rod.
    np.testing.assert_allclose(result.start_force / EI, result.end_force / EI, atol=1e-9)
    arm = np.cross(scene.end.position - scene.start.position, result.end_force)
    np.testing.assert_allclose(result.start_moment / EI, (result.end_moment + arm) / EI, atol=1e-9)
    # The strains are those of the frames and the nodes: curvature and twist by differences, second order.
    turn = Rotation.from_matrix(np.asarray(result.frames[:-1].mT @ result.frames[1:])).as_rotvec() * 50
    np.testing.assert_allclose(turn[:, 2], result.twist[1:], atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rtol", "intervals"),
    [
        (1e-10, 4),
        (1e-13, 16),
        pytest.param(1e-12, 32, marks=pytest.mark.exhaustive),
        pytest.param(1e-12, 3, marks=pytest.mark.exhaustive),
    ],
)
def test_neither_tolerance_nor_intervals_matter(figure_1, rtol, intervals):
    scene, guess = figure_1
    result = solve_continuum(scene, guess, rtol=rtol, intervals=intervals, segments=10)
    assert result.residual < RESIDUAL
    # The integrator's error over the rod is some 30 times its rtol.
    np.testing.assert_allclose(result.elastic_energy / float(scene.rod.EI), 19.969576806771, rtol=30 * rtol)


def test_a_dead_moment_winds_a_helix():
    """n = 0 and m = M: the tangent turns about M at |M|/EI, the frame about it by (M.t)(1/GJ - 1/EI) more."""
    rod = problems.cable()
    EI, GJ = float(rod.EI), float(rod.GJ)
    moment = np.array([4.0, -6.0, 3.0]) * EI
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), Free(moment=moment))
    result = solve_continuum(scene, segments=20)
    assert result.converged
    assert result.residual < RESIDUAL
    torque = moment[0]
    s = np.linspace(0, 1, 21)
    precession = Rotation.from_rotvec(s[:, None] * moment / EI).as_matrix()
    spin = Rotation.from_rotvec(s[:, None] * np.array([0, 0, torque * (1 / GJ - 1 / EI)])).as_matrix()
    rate = np.linalg.norm(moment) / EI
    axis = moment / np.linalg.norm(moment)
    t = np.array([1.0, 0, 0])
    along = (axis @ t) * axis
    across = t - along
    nodes = (
        s[:, None] * along
        + (np.sin(rate * s)[:, None] * across + (1 - np.cos(rate * s))[:, None] * np.cross(axis, across)) / rate
    )
    # Ten digits: rtol of 1e-12 over one turn of the helix.
    np.testing.assert_allclose(result.nodes, nodes, atol=1e-10)
    np.testing.assert_allclose(result.frames, precession @ np.asarray(LEVEL) @ spin, atol=1e-10)
    np.testing.assert_allclose(result.total_twist, torque / GJ, rtol=1e-10)
    np.testing.assert_allclose(result.curvature, math.hypot(*moment[1:]) / EI, rtol=1e-10)
    density = (moment[1:] @ moment[1:] / EI + torque**2 / GJ) / 2
    np.testing.assert_allclose(result.elastic_energy, density, rtol=1e-10)
    np.testing.assert_allclose(result.start_moment, moment, rtol=1e-10)


def test_a_cantilever_is_the_elastica():
    """An inextensible cantilever under a dead side force of 4 EI/L^2 (Bisshopp & Drucker 1945)."""
    load = 4.0
    EI = 2.0
    # EA L^2/EI = 1e12 lengthens it by 4e-12.
    rod = Rod(1.0, EI, 1.5, 1e12 * EI)
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), Free(force=(0, 0, -load * EI)))
    result = solve_continuum(scene, segments=10)
    assert result.residual < RESIDUAL

    def amplitude(m):
        return math.asin(1 / math.sqrt(2 * m))

    m = brentq(lambda m: ellipk(m) - ellipkinc(amplitude(m), m) - math.sqrt(load), 0.5 + 1e-12, 1 - 1e-12, xtol=1e-15)
    drop = 1 - 2 * (ellipe(m) - ellipeinc(amplitude(m), m)) / math.sqrt(load)
    slope = math.asin(2 * m - 1)
    reach = math.sqrt(2 * math.sin(slope) / load)
    # 1e-8 relative is asked for; what is left is mostly EA.
    np.testing.assert_allclose(result.nodes[-1], [reach, 0, -drop], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(-result.tangents[-1, 2], math.sin(slope), rtol=1e-10)
    np.testing.assert_allclose(result.start_moment, [0, load * EI * reach, 0], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(result.energy, result.elastic_energy - load * EI * drop, rtol=1e-10)


@pytest.mark.slow
def test_a_column_between_pins_is_the_elastica():
    """A pinned strut shortened until its ends slope by 1 rad: P = (2 K(sin 1/2))^2 EI/L^2, and any plane will do."""
    rod = Rod(1.0, 1.0, 0.7, 1e12)
    m = math.sin(0.5) ** 2
    span = 2 * ellipe(m) / ellipk(m) - 1
    scene = Scene(rod, Pin(ORIGIN), Pin((span, 0, 0)))
    x = np.linspace(0, 1, 51)
    bow = rj.Guess(np.stack([span * x, 0.2 * np.sin(math.pi * x), 0.1 * np.sin(math.pi * x)], axis=1))
    guess = rj.solve(scene, segments=50, discretization="finite_difference", guess=bow)
    result = solve_continuum(scene, guess)
    assert result.converged
    assert result.residual < RESIDUAL
    np.testing.assert_allclose(result.end_force, [-((2 * ellipk(m)) ** 2), 0, 0], rtol=1e-9, atol=1e-9)
    height = np.max(np.linalg.norm(result.nodes[:, 1:], axis=1))
    np.testing.assert_allclose(height, math.sqrt(m) / ellipk(m), rtol=1e-9)


def all_pairs() -> list:
    """Pairs of kinds of support; two of them in the quick run, each kind at each end beside another in CI."""
    quick = {("Swivel", "Pin"), ("Free", "Swivel")}
    in_ci = {("Clamp", "Clamp"), ("Swivel", "Swivel"), ("Pin", "Clamp"), ("Clamp", "Free"), ("Free", "Clamp")}
    kinds = ("Clamp", "Swivel", "Pin", "Free")
    pairs = [pair for pair in itertools.product(kinds, kinds) if pair != ("Free", "Free")]
    marks = {pair: pytest.mark.slow if pair in in_ci else pytest.mark.exhaustive for pair in pairs}
    return [pytest.param(*pair, marks=() if pair in quick else marks[pair]) for pair in pairs]


@pytest.fixture(scope="module")
def between_pins() -> tuple[Scene, rj.Equilibrium, rj.Equilibrium]:
    """A cable with a point force hung between pins in no plane, discrete and continuous."""
    rod = problems.cable()
    EI = float(rod.EI)
    force = PointForce(0.3, np.array([0.3, 3.0, -1.0]) * EI)
    scene = Scene(rod, Pin(ORIGIN), Pin((0.7, 0.1, 0.05)), gravity=(0, 0, -9.81), point_forces=[force])
    guess = rj.solve(scene, segments=50, discretization="finite_difference")
    return scene, guess, solve_continuum(scene, guess)


@pytest.mark.parametrize(("start", "end"), all_pairs())
def test_every_pair_of_supports_holds_the_same_rod(between_pins, start, end):
    """Between pins the ends carry no moment: clamps, swivels and forces that fit the solution hold the same one."""
    scene, guess, expected = between_pins
    assert expected.residual < RESIDUAL

    def support(kind, k):
        if kind == "Clamp":
            return Clamp(expected.nodes[k], expected.frames[k])
        if kind == "Swivel":
            return Swivel(expected.nodes[k], expected.tangents[k])
        if kind == "Pin":
            return Pin(expected.nodes[k])
        return Free(force=expected.end_force if k else -expected.start_force)

    other = Scene(scene.rod, support(start, 0), support(end, -1), scene.gravity, scene.point_forces)
    result = solve_continuum(other, guess)
    assert result.converged
    assert result.residual < RESIDUAL
    # The energy of a scene counts the work of the force on a free end.
    for loaded, force, k in ((other.start, -expected.start_force, 0), (other.end, expected.end_force, -1)):
        if isinstance(loaded, Free):
            result = eqx.tree_at(lambda result: result.energy, result, result.energy + force @ result.nodes[k])
    # A cable held at one end only is soft: rounding and rtol, 1e-12, times its compliance.
    sections_close(result, expected, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("end", [Clamp((0.7, 0.1, 0.05), frame((1, 0.3, 0.5), d2=(0, 1, 0.8))), None])
def test_the_discrete_rod_converges_to_it(cable, end):
    EI = float(cable.EI)
    end = end or Free(force=np.array([0.5, 1.0, 2.0]) * EI, moment=np.array([1.0, 2.0, -1.0]) * EI)
    force = PointForce(0.3, np.array([0.3, 3.0, -1.0]) * EI)
    scene = Scene(cable, Clamp(ORIGIN, frame((1, 0.2, -0.6))), end, gravity=(0, 0, -9.81), point_forces=[force])
    results = [rj.solve(scene, segments=n, discretization="finite_difference") for n in (100, 200, 400)]
    truth = solve_continuum(scene, results[-1], segments=100)
    assert truth.residual < RESIDUAL

    def limit(name):
        """Errors of orders h^2 and h^3 taken out: the half cells at the clamps leave one of third order."""
        coarse, middle, fine = (getattr(result, name) for result in results)
        if name == "nodes":
            middle, fine = middle[::2], fine[::4]
        once = (4 * middle - coarse) / 3, (4 * fine - middle) / 3
        return (8 * once[1] - once[0]) / 7

    # As seen: what is left at fourth order in 1/400.
    np.testing.assert_allclose(truth.nodes, limit("nodes"), atol=1e-7)
    # The discrete energy leaves out half a cell of h m^2/(4 EI) where a dead moment bends the end: first order.
    energies = ("energy", "elastic_energy") if isinstance(end, Clamp) else ()
    for name in ("start_force", "start_moment", "end_force", "end_moment", *energies):
        np.testing.assert_allclose(getattr(truth, name) / EI, limit(name) / EI, atol=5e-6, err_msg=name)
    np.testing.assert_allclose(truth.total_twist, limit("total_twist"), atol=1e-6)


@pytest.mark.slow
def test_a_heavy_cable_converges():
    """w L^3/EI = 1e4, L/R = 2e4: boundary layers of sqrt(EI/T) = 1/70 at the clamps."""
    rod = problems.cable(2e4)
    EI = float(rod.EI)
    rod = Rod(1.0, EI, rod.GJ, rod.EA, mass_per_length=1e4 * EI / 9.81)
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), Clamp((0.8, 0, 0), LEVEL), gravity=(0, 0, -9.81))
    guess = rj.solve(scene, segments=100, discretization="finite_difference")
    results = [solve_continuum(scene, guess, intervals=k) for k in (None, 64)]
    for result in results:
        assert result.converged
        assert result.residual < RESIDUAL
        # Half of the weight, in forces of 6e3 EI/L^2.
        np.testing.assert_allclose(result.end_force[2] / EI, 5e3, rtol=1e-11)
    for name in ("end_force", "end_moment", "energy"):
        first, second = (getattr(result, name) / EI for result in results)
        np.testing.assert_allclose(first, second, rtol=1e-10, atol=1e-8, err_msg=name)


@pytest.mark.parametrize("enough", [2, 8])
def test_where_a_search_fails_more_intervals_are_tried(figure_1, monkeypatch, enough):
    """As happens from a guess that is far off: from 4 intervals on under thirty times its weight."""
    tried, solved = [], continuum._solve

    def failing(scene, guess, rtol, intervals, segments):
        tried.append(intervals)
        result = solved(scene, guess, rtol, tried[0], segments)
        found = intervals >= enough * tried[0]
        outcome = jnp.array(found), jnp.array(rj.Status.CONVERGED if found else rj.Status.NOT_FINITE)
        return eqx.tree_at(lambda result: (result.converged, result.status), result, outcome)

    monkeypatch.setattr(continuum, "_solve", failing)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = solve_continuum(*figure_1)
    # Four times as many are the most.
    assert [count // tried[0] for count in tried] == ([1, 2] if enough == 2 else [1, 2, 4])
    assert bool(result.converged) == (enough == 2)
    assert [warning.category for warning in caught] == ([] if enough == 2 else [rj.NotConvergedWarning])
    tried.clear()
    with pytest.warns(rj.NotConvergedWarning):
        solve_continuum(*figure_1, intervals=8)
    assert tried == [8]


def outputs(scene: Scene, guess: rj.Equilibrium) -> jax.Array:
    result = solve_continuum(scene, guess)
    return jnp.concatenate([result.end_force, result.end_moment, result.energy[None], result.nodes[25]])


@pytest.mark.slow
def test_derivatives_by_the_rod(figure_1):
    """Forward and reverse mode against central differences, along one direction in EI, GJ, EA and L together."""
    scene, guess = figure_1
    rates = {"EI": 0.3, "GJ": -0.2, "EA": 0.4, "length": 0.05}

    def along(step):
        rod = eqx.tree_at(
            lambda rod: [getattr(rod, name) for name in rates],
            scene.rod,
            [getattr(scene.rod, name) * (1 + rate * step) for name, rate in rates.items()],
        )
        return outputs(eqx.tree_at(lambda scene: scene.rod, scene, rod), guess)

    h = 1e-4
    central = (along(jnp.array(h)) - along(jnp.array(-h))) / (2 * h)
    weights = jnp.linspace(0.5, 1.5, len(central))
    both = by_numpy(lambda step: (jax.jacfwd(along)(step), jax.grad(lambda step: weights @ along(step))(step)))
    forward, reverse = both(jnp.zeros(()))
    # Of h^2 and of 1e-12/h.
    np.testing.assert_allclose(forward, central, rtol=1e-6, atol=1e-8 * float(jnp.max(jnp.abs(central))))
    np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-9)


def test_derivative_of_the_energy_by_a_support_is_its_force(figure_1):
    """dW/d(end position) = end_force, in reverse mode by every number of the scene at once."""
    scene, guess = figure_1
    gradient = by_numpy(jax.grad(lambda scene: solve_continuum(scene, guess, intervals=8).energy))(scene)
    result = solve_continuum(scene, guess)
    scale = float(jnp.max(jnp.abs(result.end_force)))
    np.testing.assert_allclose(gradient.end.position, result.end_force, atol=1e-8 * scale)
    np.testing.assert_allclose(gradient.start.position, -result.start_force, atol=1e-8 * scale)
    # Energy is of the form EI f(GJ/EI, EA L^2/EI)/L: no force of any kind is left out of the derivatives.
    by_stiffness = sum(getattr(gradient.rod, name) * getattr(scene.rod, name) for name in ("EI", "GJ", "EA"))
    np.testing.assert_allclose(by_stiffness, result.energy, rtol=1e-9)


@pytest.mark.slow
def test_without_a_guess_it_begins_with_the_discrete_one(cable):
    """A guess is found for a scene that is being differentiated, too; the scene's turns are kept."""
    scene = Scene(cable, Clamp(ORIGIN, LEVEL), Clamp((0.8, 0.1, 0), LEVEL), turns=1)

    def twist(GJ):
        rod = eqx.tree_at(lambda rod: rod.GJ, scene.rod, GJ)
        return solve_continuum(eqx.tree_at(lambda scene: scene.rod, scene, rod), segments=20).total_twist

    value, derivative = by_numpy(jax.value_and_grad(twist))(scene.rod.GJ)
    np.testing.assert_allclose(
        value, rj.solve(scene, segments=200, discretization="finite_difference").total_twist, atol=1e-3
    )
    assert abs(float(derivative)) > 0


def test_says_that_it_did_not_converge(figure_1):
    scene, guess = figure_1
    broken = eqx.tree_at(lambda guess: guess.frames, guess, jnp.full_like(guess.frames, jnp.nan))
    with pytest.warns(rj.NotConvergedWarning, match="not a finite number"):
        result = solve_continuum(scene, broken, intervals=8)
    assert not result.converged
    # A guess for another rod: half as long, the frames reversed.
    wild = eqx.tree_at(lambda guess: guess.frames, guess, guess.frames[::-1])
    wild = eqx.tree_at(lambda guess: guess.nodes, wild, -5 * wild.nodes)
    with pytest.warns(rj.NotConvergedWarning):
        result = solve_continuum(scene, wild, intervals=8)
    assert not result.converged


def test_bad_arguments(figure_1):
    scene, guess = figure_1
    for arguments, message in (
        ({"rtol": 0.0}, "rtol must be positive"),
        ({"rtol": 0.1}, "rtol must lie in 1e-14 to 1e-3"),
        ({"intervals": 0}, "intervals must be a whole number from 1"),
        ({"segments": 0}, "segments must be a whole number from 1"),
        ({"guess": jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), guess)}, "guess must be a single equilibrium"),
    ):
        with pytest.raises(ValueError, match=message):
            solve_continuum(scene, **{"guess": guess, **arguments})
    with pytest.raises(TypeError, match="guess must be an Equilibrium"):
        solve_continuum(scene, problems.figure_1_start())
    with pytest.raises(TypeError, match="scene must be a Scene"):
        solve_continuum(scene.rod)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), scene)
    with pytest.raises(ValueError, match="double precision"):
        solve_continuum(single, guess)
