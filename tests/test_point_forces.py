"""Dead forces along the rod on elements: nodes where they act, and fourth order although the tension jumps there."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Free, PointForce, Rod, Scene, frame, problems
from rodjax.discretization.nodes import LEAST_ELEMENT, with_nodes_at


@pytest.mark.parametrize("arclengths", [[0.43], [0.43, 0.45], [0.01, 0.99], [0.1, 0.11, 0.12, 0.13], [0.9, 0.95, 0.97]])
def test_every_place_gets_a_node_and_no_two_fall_together(arclengths):
    s = np.asarray(with_nodes_at(jnp.linspace(0.0, 1.0, 9), jnp.array(arclengths)))
    for place in arclengths:
        assert place in s
    assert s[0] == 0.0
    assert s[-1] == 1.0
    assert np.min(np.diff(s)) >= LEAST_ELEMENT / 8
    # Found again, the mesh stays, to the last bit.
    np.testing.assert_array_equal(with_nodes_at(jnp.asarray(s), jnp.array(arclengths)), s)


@pytest.mark.parametrize(("arclengths", "got"), [([0.43, 0.43], [0.43]), ([0.0, 1.0], []), ([0.001], [])])
def test_places_that_fall_together_or_on_an_end_share_a_node(arclengths, got):
    s = np.asarray(with_nodes_at(jnp.linspace(0.0, 1.0, 9), jnp.array(arclengths)))
    assert all(place in s for place in got)
    assert np.min(np.diff(s)) > 0.05


def test_more_forces_than_nodes_between_the_ends():
    s = np.asarray(with_nodes_at(jnp.linspace(0.0, 1.0, 3), jnp.array([0.2, 0.5, 0.9])))
    assert np.all(np.diff(s) > 0)


@pytest.mark.slow
def test_fourth_order_where_the_tension_jumps():
    """A thick rod, L/R = 20, pulled along and across: the axial strain jumps by 0.1."""
    rod = problems.cable(20.0)
    EI = float(rod.EI)
    load = PointForce(0.43, (40 * EI, 0.0, 80 * EI))
    ends = Clamp((0, 0, 0), frame((1, 0, -1))), Clamp((0.5, 0.2, 0.0), frame((1, 1, 1)))
    scene = Scene(rod, *ends, (0.0, 3.0, -9.81), [load])
    results = [rj.solve(scene, segments=n, strain_limit=0.2) for n in (16, 32)]
    truth = rj.solve_continuum(scene, results[-1], segments=64)
    errors = [float(np.max(np.linalg.norm(r.nodes - truth.position_at(r.s), axis=1))) for r in results]
    energies = [abs(float(r.energy - truth.energy)) for r in results]
    # Errors of sixth order are a few per cent of these.
    assert math.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)
    assert math.log2(energies[0] / energies[1]) == pytest.approx(4, abs=0.3)
    # To leading order in the mesh: 3 % seen.
    np.testing.assert_allclose([float(r.error_estimate) for r in results], errors, rtol=0.06)
    # Of the energy J: the work of a force is that at the place where it acts.
    moved = Scene(rod, *ends, (0.0, 3.0, -9.81), [PointForce(0.43, 1.0001 * np.asarray(load.force))])
    work = (rj.solve(moved, segments=32, guess=results[1], strain_limit=0.2).energy - results[1].energy) / 1e-4
    position = results[1].position_at(0.43)[0]
    # The energy is quadratic about the equilibrium: 1e-4 of it, by the difference.
    assert float(work) == pytest.approx(-float(np.dot(load.force, position)), rel=1e-3)


def test_a_hanging_string_of_weights():
    """Taut and straight: each part has the strain of what hangs below it."""
    rod = problems.cable(20.0)
    EA = float(rod.EA)
    forces = [PointForce(at, (0.0, 0.0, -0.02 * EA)) for at in (0.3, 0.55, 0.8)]
    scene = Scene(rod, Clamp((0, 0, 0), frame((0, 0, -1))), Free(), point_forces=forces)
    result = rj.solve(scene, segments=4, strain_limit=0.1)
    expected = -np.cumsum([0.0, 0.3 * 1.06, 0.25 * 1.04, 0.25 * 1.02, 0.2])
    # Roundings: the strain is constant between the loads.
    np.testing.assert_allclose(result.nodes[:, 2], expected, atol=1e-13)
    np.testing.assert_allclose(result.position_at([0.4])[0, 2], -0.3 * 1.06 - 0.1 * 1.04, atol=1e-13)
    energy = EA / 2 * (0.3 * 0.06**2 + 0.25 * 0.04**2 + 0.25 * 0.02**2)
    assert float(result.elastic_energy) == pytest.approx(energy, rel=1e-12)
    work = 0.02 * EA * -(expected[1] + expected[2] + expected[3])
    assert float(result.energy) == pytest.approx(energy - work, rel=1e-12)


def test_a_rod_by_frames_whose_start_is_free_bends_as_one_by_tangents():
    """In a plane, where both kinds of elements are the same: to the solver's tolerance of 1e-8 EI/L^2."""
    ends = Free(), Clamp((0, 0, 0), frame((1, 0, 0)))
    by_tangents, by_frames = (
        rj.solve(Scene(Rod(1.0, EI, 0.7, 1e4), *ends, point_forces=[PointForce(0.3, (0.0, 1.0, -2.0))]), segments=8)
        for EI in (1.0, (1.0, 1.0))
    )
    np.testing.assert_allclose(by_frames.nodes, by_tangents.nodes, rtol=0, atol=1e-8)
