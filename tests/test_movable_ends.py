"""Ends that hinge, slide or give way against springs, against closed forms."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import rodjax
from rodjax import Clamp, Hinge, Newton, Pin, PointForce, Rod, Scene, Slider, Spring

# Of unit bending stiffness; stretch moves no figure below by more than 1e-8.
ROD = Rod(1.0, 1.0, 1.0, 1e9, mass_per_length=1.0)
ALONG = rodjax.frame((1, 0, 0))
BASE = Clamp((0, 0, 0), ALONG)
# So small that squares of slopes are rounding.
SMALL = 1e-6
TIGHT = Newton(tolerance=1e-13)


def buckling_load(stiffness: float) -> float:
    """Of a column on a rotational spring [EI/L], its top pinned: u cot u - 1 = u^2/c, P = u^2."""
    u = brentq(lambda u: u / math.tan(u) - 1 - u**2 / stiffness, math.pi + 1e-9, 4.4934094579, xtol=1e-15)
    return u**2


@pytest.mark.parametrize("stiffness", [1e-6, 5.0, 1e9])
def test_a_column_on_a_rotational_spring_buckles_at_the_load_of_its_closed_form(stiffness):
    """1e-6 and 1e9 EI/L are the limits of a pin and a clamp."""
    expected = buckling_load(stiffness)
    for side in (-1, 1):
        load = PointForce(1.0, (-expected * (1 + side * 1e-6), 0, 0))
        base = Spring(Clamp((0, 0, 0), ALONG), rotation=jnp.diag(jnp.array([1e9, stiffness, 1e9])))
        # In its plane, as buckling out of it would come first or with it.
        top = Slider((1, 0, 0), [(1, 0, 0)])
        column = rodjax.solve(Scene(ROD, base, top, point_forces=[load]), segments=32, find="equilibrium")
        assert column.converged
        assert column.free_index == (side > 0) + (0 if stiffness < 1e8 else side > 0)
        assert column.stable == (side < 0)


def test_a_cantilever_pulls_at_a_spring_of_nine_stiffnesses():
    """Forces of springs in series: the tip gives way by 3 EI/L^3 across; along the rod it is rigid."""
    stiffness = np.array([[4.0, 0.0, 0.0], [0.0, 3.0, 1.0], [0.0, 1.0, 2.0]])
    away = SMALL * np.array([0.0, 0.7, -0.4])
    end = Spring(Pin(np.array([1.0, 0.0, 0.0]) + away), translation=stiffness)
    found = rodjax.solve(Scene(ROD, BASE, end), segments=8, solver=TIGHT)
    across = stiffness[1:, 1:]
    moved = np.linalg.solve(across + 3.0 * np.eye(2), across @ away[1:])
    assert jnp.max(jnp.abs(found.end_force[1:] - 3.0 * moved)) < 1e-6 * SMALL
    assert jnp.max(jnp.abs(found.nodes[-1, 1:] - moved)) < 1e-6 * SMALL
    assert jnp.max(jnp.abs(found.end_moment)) < 1e-6 * SMALL
    assert found.stable


@pytest.mark.slow
def test_a_hinge_turns_about_its_axis_alone():
    """Under its weight a beam is a propped cantilever in the plane across the axis, and clamped in the other."""
    end = Hinge((1, 0, 0), ALONG, (0, 1, 0))
    scene = Scene(ROD, BASE, end, gravity=(0, 2 * SMALL, -SMALL))
    found = rodjax.solve(scene, segments=8, solver=TIGHT)
    # About y: w L^2/8 and zero; about z: w L^2/12 at both ends.
    assert jnp.allclose(jnp.abs(found.start_moment[1:]), SMALL * jnp.array([1 / 8, 2 / 12]), rtol=1e-6, atol=0)
    assert jnp.abs(found.end_moment[1]) < 1e-9 * SMALL
    assert jnp.isclose(jnp.abs(found.end_moment[2]), SMALL * 2 / 12, rtol=1e-6)
    assert jnp.isclose(found.end_force[2], SMALL * 3 / 8, rtol=1e-6)


@pytest.mark.slow
def test_a_slider_guides_an_end():
    """Clamped, and guided across the beam: w L^4/24 EI, w L^2/3 at the clamp, w L^2/6 at the guide."""
    end = Slider((1, 0, 0), [(0, 0, 1)], ALONG)
    found = rodjax.solve(Scene(ROD, BASE, end, gravity=(0, 0, -SMALL)), segments=8, solver=TIGHT)
    assert jnp.isclose(found.nodes[-1, 2], -SMALL / 24, rtol=1e-6)
    assert jnp.isclose(jnp.abs(found.start_moment[1]), SMALL / 3, rtol=1e-6)
    assert jnp.isclose(jnp.abs(found.end_moment[1]), SMALL / 6, rtol=1e-6)
    assert jnp.abs(found.end_force[2]) < 1e-9 * SMALL
