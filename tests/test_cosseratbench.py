"""rodjax in cosseratbench, an outside benchmark of rod solvers: by its entry points, its runner and its metrics."""

import dataclasses
import math

import jax
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

import rodjax as rj

bench = pytest.importorskip("cosseratbench")
registry = pytest.importorskip("cosseratbench.registry")


def adapter():
    return registry.load_solver("rodjax")


def elastica_tip(load: float) -> float:
    """Deflection over length of an inextensible cantilever, `load` = P L^2/EI (Bisshopp & Drucker 1945)."""

    def amplitude(m):
        return math.asin(1 / math.sqrt(2 * m))

    m = brentq(lambda m: ellipk(m) - ellipkinc(amplitude(m), m) - math.sqrt(load), 0.5 + 1e-12, 1 - 1e-12, xtol=1e-15)
    return 1 - 2 * (ellipe(m) - ellipeinc(amplitude(m), m)) / math.sqrt(load)


def test_it_finds_rodjax():
    assert "rodjax" in registry.names(registry.SOLVERS)
    # Sweeps of the time step give this to every solver.
    assert isinstance(registry.load_solver("rodjax", time_step_scale=2.0), bench.Solver)


def test_the_tip_of_the_cantilever_is_that_of_the_elastica():
    experiment = registry.load_experiment("cantilever")
    result = bench.run(experiment, adapter())
    assert result.outcome == "completed"
    assert result.n_elements == 20
    assert result.metrics["settling_residual"] == 0
    # The reference is linear theory, which the elastica differs from by 4e-4.
    load = 7.5e-3 / (1e6 * math.pi * 0.02**4 / 4)
    linear, exact = load / 3, elastica_tip(load)
    assert result.metrics["tip_deflection_error"] == pytest.approx((linear - exact) / linear, abs=1e-6)
    # Extension by a pull of 6e-6 EA is left.
    assert -result.trajectory.positions[0][-1, -1, 2] == pytest.approx(exact, rel=1e-6)


def test_the_catenary_is_off_by_its_bending_stiffness():
    experiment = registry.load_experiment("catenary")
    result = bench.run(experiment, adapter())
    assert result.outcome == "completed"
    # Converged: 4.7e-4 and 3.8e-4 on any mesh, less in proportion to EI (experiments/validation.py).
    assert result.metrics["shape_error"] == pytest.approx(4.73e-4, rel=0.01)
    assert result.metrics["sag_error"] == pytest.approx(3.83e-4, rel=0.01)
    start = experiment.scenario.rods[0]
    np.testing.assert_allclose(result.trajectory.positions[0][0], start.nodes(50))
    np.testing.assert_allclose(result.trajectory.directors[0][-1], [[0.0, 1.0, 0.0]] * 50, atol=1e-9)


@pytest.mark.slow
def test_a_rope_rests_on_another_one():
    """The pins of the upper one 0.05 m below those of the lower one, where its middle rests on the other's in stable
    equilibrium. Bending rounds the kinks over 3 cm, so elements are 2 cm long, with a node where the ropes touch; seen:
    1.5e-6 and 2.6e-5, of which up to 1e-6 is between the samples of the reference.
    """
    experiment = registry.load_experiment("crossing")
    # That each may touch itself, too, which it does not, changes nothing.
    build = lambda **values: dataclasses.replace(experiment.build(**values), self_contact=True)  # noqa: E731
    result = bench.run(dataclasses.replace(experiment, build=build), adapter(), values={"drop": 0.05}, n_elements=50)
    assert result.outcome == "completed"
    assert result.metrics["shape_error"] < 3e-6
    assert result.metrics["lift_error"] < 5e-5


@pytest.mark.slow
def test_ropes_that_slide_along_each_other_come_to_rest():
    """The middle of an element of the lower one, where it touches, is where the cell of the element before ends: of two
    contacts at one place one pushes, to rounding. Farther down, as the reference has it, the ropes are not stable.
    """
    scenario = registry.load_experiment("crossing").scenario
    with jax.enable_x64(True):
        result = adapter().equilibrium(scenario, 51)
    assert result.stable
    assert result.iterations <= 20
    forces = result.rod_contacts["rod0", "rod1"].forces
    assert np.sum(np.linalg.norm(forces, axis=1) > 0) == 1
    # On 50, 64 and 100 elements: 31.66, 31.59 and 31.58 mm.
    assert abs(float(result["rod0"].position_at([0.5])[0, 1])) == pytest.approx(0.0316, abs=3e-4)


def test_directors_of_a_clamped_rod_turn_with_its_section():
    experiment = registry.load_experiment("cantilever")
    frames = bench.run(experiment, adapter(), n_elements=6, n_frames=3).trajectory
    nodes, directors = frames.positions[0][-1], frames.directors[0][-1]
    np.testing.assert_allclose(frames.directors[0][0], [[0.0, 0.0, 1.0]] * 6, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(directors, axis=1), 1.0)
    np.testing.assert_allclose(np.sum(directors * np.diff(nodes, axis=0), axis=1), 0.0, atol=1e-15)
    np.testing.assert_allclose(directors[:, 1], 0.0, atol=1e-12)


def test_rods_rest_on_planes_and_cylinders():
    """The tip of the cantilever on a floor, its middle on a cylinder: both places of the centerline are then known."""
    plane, cylinder = bench.scenario.Plane, bench.scenario.Cylinder
    given = registry.load_experiment("cantilever").scenario
    radius = given.rods[0].radius
    floor = plane((0.0, 0.0, -0.005 - radius), (0.0, 0.0, 2.0))
    peg = cylinder((0.5, 0.0, -0.001 - radius - 0.05), (0.0, 3.0, 0.0), radius=0.05, length=0.2)
    with jax.enable_x64(True):
        result = adapter().equilibrium(dataclasses.replace(given, obstacles=(floor, peg)), 8)
    assert result.converged
    # The cylinder is touched a little beside its top: 1e-3^2 of slope times its radius.
    np.testing.assert_allclose(result.nodes[[4, 8], 2], [-0.001, -0.005], rtol=0, atol=1e-5)
    assert np.all(np.asarray(result.contact_forces)[[4, 8], 2] > 0)


@pytest.mark.slow
def test_friction_holds_a_rope_over_a_cylinder_up_to_the_capstan_equation():
    """Its longer side at most as long as the heavy rope's capstan equation allows. What holds sticks, or slips where
    bending and the given shape differ: seen: 2.2e-5 m, on twice as many elements 9e-6 m. What does not slides off.
    """
    experiment = registry.load_experiment("capstan")
    for overhang in (0.5, 0.9):
        result = bench.run(experiment, adapter(), values={"overhang": overhang}, n_elements=50)
        assert result.outcome == "completed"
        assert 0 <= result.metrics["slide"] < 3e-5
    with pytest.warns(rj.NotConvergedWarning):
        assert bench.run(experiment, adapter(), values={"overhang": 1.1}, n_elements=50).outcome == "diverged"


def test_it_says_what_it_cannot_do():
    experiment = registry.load_experiment("cantilever")

    def missing(**changes):
        scenario = dataclasses.replace(experiment.scenario, **changes)
        return bench.run(dataclasses.replace(experiment, build=lambda: scenario), adapter()).missing

    assert missing(quasi_static=False) == ("dynamics",)
    rope = registry.load_experiment("capstan").scenario.rods[0]
    held = dataclasses.replace(rope, start=bench.EndCondition.PINNED)
    peg = registry.load_experiment("capstan").scenario.obstacles
    assert missing(rods=(held,), obstacles=peg) == ("friction",)
    assert missing(rods=(rope,)) == ("a rod that nothing holds",)
    assert bench.run(registry.load_experiment("twist"), adapter()).missing == ("driven ends",)
