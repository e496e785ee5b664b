"""Closed forms and the continuum: second order in the mesh, and the right limit."""

import math

import jax
import numpy as np
import pytest
from continuum import Continuum
from scipy.optimize import brentq

import rodjax as rj
from rodjax import Clamp, Free, Pin, Rod, Scene, frame, problems

LEVEL = frame((1, 0, 0))
ORIGIN = (0.0, 0.0, 0.0)


def last(path: rj.Equilibrium) -> rj.Equilibrium:
    return jax.tree.map(lambda leaf: leaf[-1], path)


def node_error(result: rj.Equilibrium, truth: Continuum) -> float:
    return float(np.max(np.linalg.norm(result.nodes - truth.nodes_at(np.asarray(result.s)), axis=1)))


def test_figure_1_converges_to_the_continuum_with_second_order():
    scenes = problems.figure_1()
    bounds = {10: 1.0e-2, 20: 2.5e-3, 50: 4.0e-4, 100: 1.0e-4}
    ends = {
        n: last(rj.solve_path(scenes, segments=n, discretization="finite_difference", guess=problems.figure_1_start()))
        for n in bounds
    }
    truth = Continuum(scenes[-1], near=ends[100])
    EI = float(scenes[0].rod.EI)
    np.testing.assert_allclose(truth.elastic_energy / EI, 19.9696, atol=5e-5)
    np.testing.assert_allclose(ends[100].elastic_energy / EI, 19.974, atol=5e-4)
    errors = {n: node_error(result, truth) for n, result in ends.items()}
    for n, bound in bounds.items():
        assert errors[n] < bound, (n, errors[n])
    for coarse, fine in ((10, 20), (20, 50), (50, 100)):
        order = math.log(errors[coarse] / errors[fine]) / math.log(fine / coarse)
        assert abs(order - 2) < 0.1, (coarse, fine, order)
    # Forces and moments of order 100 EI/L^2 and 10 EI/L; second order, as seen: 4e-2 and 6e-3.
    np.testing.assert_allclose(ends[100].end_force / EI, truth.end_force / EI, atol=0.1)
    np.testing.assert_allclose(ends[100].end_moment / EI, truth.end_moment / EI, atol=0.02)


def test_cantilever_tip():
    scene = problems.cantilever(4.0)
    result = rj.solve(scene, segments=100, discretization="finite_difference")
    truth = Continuum(scene, near=result)
    tip = truth.nodes_at(np.array([1.0]))[0]
    np.testing.assert_allclose(result.nodes[-1], tip, atol=1e-4)
    # The table is for an inextensible rod: EA L^2/EI = 1.6e5 moves the tip by F/EA = 2.5e-5 at most.
    np.testing.assert_allclose(tip, [1 - 0.32894, 0, -0.66996], atol=5e-5)
    slope = math.atan2(-float(result.tangents[-1, 2]), float(result.tangents[-1, 0]))
    np.testing.assert_allclose(slope, 1.12124, atol=2e-4)


def test_hanging_cable_is_second_order():
    scene = problems.hanging_cable()
    results = [rj.solve(scene, segments=n, discretization="finite_difference") for n in (25, 50, 100)]
    truth = Continuum(scene, near=results[-1])
    errors = [node_error(result, truth) for result in results]
    assert errors[-1] < 1e-4
    assert abs(math.log2(errors[0] / errors[1]) - 2) < 0.1
    assert abs(math.log2(errors[1] / errors[2]) - 2) < 0.1


def test_a_cable_without_bending_stiffness_is_an_elastic_catenary():
    """A cable on pins, w L^3/EI = 1e5; sag and horizontal pull of the elastic catenary (Irvine 1981)."""
    length, span, weight, EA = 1.0, 0.8, 1.0, 50.0
    rod = Rod(length, EI=1e-5, GJ=1e-5, EA=EA, mass_per_length=weight / 9.81)
    result = rj.solve(
        Scene(rod, Pin(ORIGIN), Pin((span, 0, 0)), gravity=(0, 0, -9.81)),
        segments=100,
        discretization="finite_difference",
    )
    assert result.converged

    def reach(pull):
        return pull * length / EA + 2 * pull / weight * math.asinh(weight * length / (2 * pull))

    pull = brentq(lambda pull: reach(pull) - span, 1e-3, 10.0)
    vertical = weight * length / 2
    sag = weight * length**2 / (8 * EA) + pull / weight * (math.hypot(1, vertical / pull) - 1)
    # The bending stiffness matters within sqrt(EI/H) = 6e-3 of the ends and where kappa = w/H: EI kappa^2/H = 2e-4.
    np.testing.assert_allclose(result.end_force, [pull, 0, vertical], atol=5e-4)
    np.testing.assert_allclose(-result.nodes[50, 2], sag, atol=5e-4)


def rolled_up(turns: int, segments: int, guess: rj.Equilibrium | None = None) -> rj.Equilibrium:
    rod = problems.cable()
    moment = 2 * math.pi * turns * float(rod.EI)
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), Free(moment=(0, -moment, 0)))
    result = rj.solve(scene, segments=segments, discretization="finite_difference", guess=guess)
    assert result.converged
    np.testing.assert_allclose(result.start_moment, [0, -moment, 0], atol=1e-6 * moment)
    return result


def test_an_end_moment_rolls_a_cantilever_up():
    """M = 2 pi EI/L bends an inextensible rod into a full circle of radius L/(2 pi); twice that into two turns."""
    for turns, meshes in ((1, (20, 40)), (2, (40, 80))):
        results = [rolled_up(turns, n, guess=None if turns == 1 else rolled_up(1, n)) for n in meshes]
        errors = [float(np.linalg.norm(result.nodes[-1])) for result in results]
        # A joint of energy 2 EI tan^2(phi/2)/h under M = EI a/h turns by phi = a - a^3/3: all turn by a^2/3 too little,
        # and the tip misses the circle by that much of the length; a = pi/20 on the fine meshes.
        np.testing.assert_allclose(errors[1], (math.pi / 20) ** 2 / 3, rtol=0.05)
        assert abs(math.log2(errors[0] / errors[1]) - 2) < 0.1
        np.testing.assert_allclose(results[1].curvature, 2 * math.pi * turns, rtol=(math.pi / 20) ** 2)
        height = float(np.max(results[1].nodes[:, 2]) - np.min(results[1].nodes[:, 2]))
        np.testing.assert_allclose(height, 1 / (math.pi * turns), rtol=(math.pi / 20) ** 2)


@pytest.mark.parametrize(("load", "buckles"), [(0.98, False), (1.02, True)])
def test_an_euler_column_below_and_above_its_load(load, buckles):
    """A cantilever under an axial end load of 0.98 and 1.02 times pi^2 EI/(4 L^2), pushed aside a little."""
    rod = problems.cable()
    critical = math.pi**2 * float(rod.EI) / 4
    aside = 1e-6 * critical
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), Free(force=(-load * critical, 0, aside)))
    # A first shape with a visible bow: from the straight one the way out of the saddle is long.
    s = np.linspace(0, 1, 41)
    bow = rj.Guess(np.stack([s, 0 * s, 0.1 * (1 - np.cos(math.pi / 2 * s))], axis=1))
    # Turning about the load takes 1e-6 of the stiffness of bending: some 170 of Newton's steps go round the axis.
    solver = rj.Newton(max_iterations=200)
    result = rj.solve(scene, segments=40, discretization="finite_difference", guess=bow, solver=solver)
    assert result.converged
    tip = float(result.nodes[-1, 2])
    if buckles:
        np.testing.assert_allclose(tip, elastica_tip(load), rtol=0.02)
    else:
        # Linear theory: the small side load times its stiffness, magnified by 1/(1 - P/Pcr).
        assert 0 < tip < 1e-4


def elastica_tip(load: float) -> float:
    """Deflection of the tip of a buckled inextensible cantilever: 2 sin(a/2)/(K(sin(a/2))), load = (2 K/pi)^2."""
    from scipy.special import ellipk

    k = brentq(lambda k: (2 * ellipk(k**2) / math.pi) ** 2 - load, 1e-6, 0.99)
    return 2 * k / float(ellipk(k**2))
