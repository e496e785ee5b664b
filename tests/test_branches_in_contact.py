"""Branches and critical points of rods that press on obstacles, beside closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import rodjax as rj
from rodjax import BranchEnd, Clamp, Clip, Cylinder, Free, Plane, Rod, Scene, Swivel, frame

X = (1.0, 0.0, 0.0)
RADIUS, BODY = 0.01, 0.1
# EA L^2/EI of 1e8 shifts loads of 10 EI/L^2 by 1e-7.
EA = 1e8
CLAMPED_PINNED = 20.190728556427

# --- a column whose tip leans on a body -----------------------------------------------------------------------------


def column(load, aside, EI=1.0, away=0.0, clips=()) -> Scene:
    """Clamped at the bottom, pressed by a dead load, and at the tip aside on a cylinder, in the soft plane of a flat
    rod; `away`: the gap there.
    """
    x = jnp.array([1.0, 0.0, 0.0])
    aside = jnp.array([0.0, -1.0, 0.0]) * aside
    place = jnp.array([1.0, -RADIUS - BODY, 0.0]) - away * jnp.array([0.0, 1.0, 0.0])
    axis = jnp.array([0.0, 0.0, 1.0])
    rod = Rod(1.0, (EI, 100.0), 0.8, EA, radius=RADIUS)
    body = Cylinder(place - axis, place + axis, BODY)
    return Scene(rod, Clamp((0, 0, 0), frame(X)), Free(force=aside - load * x), clips=clips, obstacles=[body])


SEGMENTS = 16


def buckling_load(EI=1.0, aside=0.5):
    """Of the column that is pressed harder and harder."""
    scenes = [column(0.0, aside, EI), column(25.0, aside, EI)]
    return 25.0 * rj.critical_point(scenes, segments=SEGMENTS).parameter


def test_a_column_that_leans_buckles_as_between_a_clamp_and_a_pin():
    """Whatever presses it aside: straight, it stays so. Of the free column it would be 2.47 EI/L^2."""
    load, by_EI = jax.value_and_grad(buckling_load)(1.0)
    # The mesh error of 16 elements, 4e-8 on 64 and of fourth order.
    np.testing.assert_allclose(load, CLAMPED_PINNED, rtol=2e-5)
    np.testing.assert_allclose(by_EI, load, rtol=1e-5)


def test_a_branch_is_entered_only_as_far_as_its_contacts_stay():
    """Bent to one side the column presses harder on the body; to the other less, until it leaves it."""
    scenes = [column(0.0, 0.5), column(25.0, 0.5)]
    point = rj.critical_point(scenes, segments=SEGMENTS)
    center, pushes = np.array([1.0, -RADIUS - BODY]), {}
    for side in (1, -1):
        _, bent = rj.switch_branch(scenes, point, side=side, distance=0.01)
        assert bent.converged
        np.testing.assert_allclose(np.linalg.norm(bent.nodes[-1, :2] - center), RADIUS + BODY, atol=1e-12)
        pushes[side] = float(bent.obstacle_forces[0].sum(0)[1])
    harder = max(pushes, key=lambda side: pushes[side])
    assert pushes[-harder] < 0.5 < pushes[harder]
    _, bent = rj.switch_branch(scenes, point, side=harder, distance=0.2)
    assert bent.converged
    with pytest.raises(ValueError, match=r"distance must be less than 0\.2: so far from the point a contact opens"):
        rj.switch_branch(scenes, point, side=-harder, distance=0.2)


def test_beside_a_body_that_it_does_not_touch_a_column_buckles_as_without():
    scenes = [column(0.0, 0.0, away=0.05), column(3.0, 0.0, away=0.05)]
    point = rj.critical_point(scenes, segments=SEGMENTS)
    np.testing.assert_allclose(3.0 * point.parameter, np.pi**2 / 4, rtol=1e-6)
    assert (point.kind, point.index_before, point.index_after) == ("branch", 0, 1)


# The force aside [EI/L^2] with which these begin, and with which, the other way, they end.
ASIDE = 0.01


def load_of_two_spans(a: float) -> float:
    """From a clamp over a support at a to a pin: k^2 of deflections A (sin kx - kx) + B (cos kx - 1) and, beyond,
    F sin k(x - 1) + G k (x - 1).
    """

    def determinant(k: float) -> float:
        s, c, b = np.sin(k * a), np.cos(k * a), 1 - a
        deflections = [[s - k * a, c - 1, 0, 0], [0, 0, np.sin(k * b), k * b]]
        slopes = [c - 1, -s, -np.cos(k * b), -1]
        curvatures = [-s, -c, -np.sin(k * b), 0]
        return float(np.linalg.det(np.array([*deflections, slopes, curvatures])))

    k = np.linspace(1.0, 12.0, 2000)
    first = np.flatnonzero(np.diff(np.sign([determinant(each) for each in k])))[0]
    return brentq(determinant, k[first], k[first + 1], xtol=1e-14) ** 2


@pytest.mark.slow
def test_a_column_that_slides_through_a_clip_and_leans():
    clip = Clip(0.5, (0.5, 0.0, 0.0), sliding=True)
    scenes = [column(0.0, 0.5, clips=[clip]), column(100.0, 0.5, clips=[clip])]
    point = rj.critical_point(scenes, segments=32)
    assert point.kind == "branch"
    np.testing.assert_allclose(100.0 * point.parameter, load_of_two_spans(0.5), rtol=2e-5)


def tip(branch: rj.Branch) -> np.ndarray:
    return np.asarray(branch.equilibria.nodes)[:, -1, 1]


@pytest.mark.parametrize("load", [2.0, 10.0])
def test_a_column_that_is_drawn_from_what_it_leans_on(load):
    """It leaves it where nothing presses it aside. A stable one goes on by tan(kL)/(k P) - L/P for each newton; one
    that stood by leaning alone turns back there, as that is negative.
    """
    scenes = [column(load, ASIDE), column(load, -ASIDE)]
    branch = rj.follow(scenes, segments=SEGMENTS)
    assert branch.ended is BranchEnd.SCENES
    corner = int(np.argmin(np.abs(branch.parameter - 0.5)))
    np.testing.assert_allclose(branch.parameter[corner], 0.5, rtol=0, atol=1e-6)
    np.testing.assert_allclose(tip(branch)[: corner + 1], 0.0, atol=1e-12)  # what a gap may be
    pushes = np.asarray(branch.equilibria.obstacle_forces)[:, 0].sum(-2)[:, 1]
    aside = ASIDE * (1 - 2 * np.asarray(branch.parameter))
    np.testing.assert_allclose(pushes[:corner], aside[:corner], atol=1e-8)
    np.testing.assert_allclose(pushes[corner:], 0.0, atol=1e-7)
    k = np.sqrt(load)
    compliance = np.tan(k) / (k * load) - 1 / load
    # The elastica stiffens by the square of its slope, 0.02.
    np.testing.assert_allclose(tip(branch)[corner + 1 :], -compliance * aside[corner + 1 :], rtol=1e-3)
    if load < np.pi**2 / 4:
        assert not branch.critical_points
        assert np.all(branch.index == 0)
        return
    (point,) = branch.critical_points
    assert (point.kind, point.index_before, point.index_after) == ("contact", 0, 1)
    assert np.all(branch.index[corner:] == 1)
    np.testing.assert_allclose(point.parameter, 0.5, atol=1e-7)


def test_where_a_contact_opens_follows_the_scenes():
    def opening(aside):
        scenes = [column(10.0, 0.5 + aside), column(10.0, -0.5 + aside)]
        return rj.critical_point(scenes, segments=SEGMENTS).parameter

    value, slope = jax.value_and_grad(opening)(0.1)
    np.testing.assert_allclose(value, 0.6, atol=1e-7)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-7)


@pytest.mark.slow
def test_a_path_stops_before_the_column_falls():
    scenes = [column(10.0, aside) for aside in (0.01, 0.004, -0.002, -0.008)]
    path = rj.solve_path(scenes, segments=SEGMENTS, at_critical="stop")
    assert path.energy.shape == (2,)
    np.testing.assert_allclose(path.nodes[..., 1], 0.0, atol=1e-12)
    fallen = rj.solve_path(scenes, segments=SEGMENTS)
    assert np.all(fallen.converged)
    assert np.max(np.abs(fallen.nodes[-1, :, 1])) > 0.3
    (point,) = rj.critical_points(scenes, fallen)
    assert point.kind == "contact"
    np.testing.assert_allclose(point.parameter, 5 / 3, atol=1e-6)


# --- cables on a floor ------------------------------------------------------------------------------------------------

FLOOR = Plane((0.0, 0.0, -RADIUS), (0.0, 0.0, 1.0))
ROUND, FLAT = (Rod(1.0, EI, 0.8, 1e4, 5.0, radius=RADIUS) for EI in (1.0, (100.0, 1.0)))


def hanging(height) -> Scene:
    ends = [Clamp(jnp.array([x, 0.0, 0.0]) + height * jnp.array([0.0, 0.0, 1.0]), frame(X)) for x in (0.0, 0.99)]
    return Scene(FLAT, *ends, (0, 0, -10.0), obstacles=[FLOOR])


def test_contacts_of_a_symmetric_rod_open_and_close_together():
    """A cable that does not bend aside, let down on a floor, is where solves find it."""
    scenes = [hanging(0.1), hanging(0.03)]
    branch = rj.follow(scenes, segments=SEGMENTS)
    assert branch.ended is BranchEnd.SCENES
    assert not branch.critical_points
    assert np.all(branch.index == 0)
    pressures = np.asarray(branch.equilibria.obstacle_forces)[:, 0, :, 2]
    assert np.all(pressures >= -1e-6)
    np.testing.assert_allclose(pressures, pressures[:, ::-1], atol=1e-6)
    assert np.min(np.asarray(branch.equilibria.nodes)[..., 2]) > -1e-10
    assert np.max(pressures[0]) == 0.0
    assert np.sum(pressures[-1] > 0) > SEGMENTS // 4
    first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], branch.equilibria) for k in (0, -1))
    found = rj.solve(scenes[-1], segments=SEGMENTS, guess=first)
    np.testing.assert_allclose(last.nodes, found.nodes, atol=1e-9)


def lifted(height) -> Scene:
    end = Swivel(jnp.array([0.97, 0.0, 0.0]) + height * jnp.array([0.0, 0.0, 1.0]), X)
    return Scene(ROUND, Clamp((0, 0, 0), frame(X)), end, (0, 0, -10.0), obstacles=[FLOOR])


@pytest.mark.slow
def test_a_cable_that_lies_bowed_is_lifted_through_its_symmetric_shape():
    """The higher the end, the less is it bowed; where it is not the branch turns back to the mirrored shape."""
    heights = np.linspace(0.0, 0.14, 8)
    path = rj.solve_path([lifted(height) for height in heights], segments=SEGMENTS)
    begin, path = (jax.tree.map(lambda leaf, k=k: leaf[k], path) for k in (-2, slice(None)))
    branch = rj.follow([lifted(height) for height in (0.12, 0.14, 0.16)], guess=begin)
    assert branch.ended is BranchEnd.SCENES
    np.testing.assert_allclose(branch.equilibria.nodes[-1], np.asarray(begin.nodes) * [1, -1, 1], atol=1e-8)
    assert np.max(np.abs(begin.nodes[:, 1])) > 0.02
    at_second = np.flatnonzero(np.asarray(branch.parameter) == 1.0)
    np.testing.assert_allclose(branch.equilibria.nodes[at_second[0]], path.nodes[-1], atol=1e-8)
    crossing, turn = branch.critical_points
    assert (crossing.kind, turn.kind) == ("branch", "fold")
    # Of the same point, by its stiffness and by the way of the parameter.
    np.testing.assert_allclose(crossing.parameter, turn.parameter, atol=1e-3)
    assert np.max(np.abs(crossing.equilibrium.nodes[:, 1])) < 0.02
