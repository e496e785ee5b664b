"""Loads without a potential on rods of harnesses: against the rod that is not cut, and the free end of a rod."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_harness import END, GRAVITY, START, bent, plain

import rodjax
from rodjax import (
    Body,
    Clamp,
    Clip,
    DistributedCouple,
    DistributedForce,
    Free,
    Harness,
    Hinge,
    Joint,
    Newton,
    Plane,
    PointCouple,
    PointForce,
    Scene,
)
from rodjax.solving.assembly_newton import MOST_UNJUDGED

TIGHT = Newton(tolerance=1e-11)
# Of the bent rod of 1 m: EI/L and EI/L^2 are 0.05.
EI = float(bent(1.0).EI[0])
ALONG = [DistributedForce((1.5 * EI, -2 * EI, 0.5 * EI), follower=True), DistributedCouple((0.4 * EI, 0, -0.8 * EI))]


def whole_and_cut(end, scale=1.0, at_points=False, along=()):
    """A rod, and the same cut in the middle, under loads at the end or within the second half."""
    force, couple = scale * EI * np.array([0.5, -2.0, 1.0]), scale * EI * np.array([1.0, -0.5, 0.3])

    def loads(at):
        if not at_points:
            return {}
        couples = [PointCouple(at, couple), PointCouple(at, -0.5 * couple, follower=True)]
        return {"point_forces": [PointForce(at, force, follower=True)], "point_couples": couples}

    joint, along = Joint("cut"), list(along)
    first = Scene(bent(0.5), START, joint, GRAVITY, distributed=along)
    second = Scene(bent(0.5), joint, end, GRAVITY, distributed=along, **loads(0.25))
    whole = Scene(bent(1.0), START, end, GRAVITY, distributed=along, **loads(0.75))
    return whole, Harness({"a": first, "b": second})


@pytest.mark.parametrize(
    ("end", "at_points", "along"),
    [
        (Free((0.5 * EI, -3 * EI, EI), (0.3 * EI, 0, EI), follower=True), False, ALONG),
        (END, True, ALONG),
        (Free(moment=(0.5 * EI, EI, -2 * EI)), False, ()),
    ],
    ids=["follower tip", "points between clamps", "dead moment"],
)
def test_a_cut_rod_is_the_rod(end, at_points, along):
    scene, harness = whole_and_cut(end, 1.0, at_points, along)
    whole = rodjax.solve(scene, segments=16, solver=TIGHT)
    parts = rodjax.solve(harness, segments=8, solver=TIGHT)
    assert parts.converged
    nodes = jnp.concatenate([parts["a"].nodes, parts["b"].nodes[1:]])
    np.testing.assert_allclose(nodes, whole.nodes, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts["a"].start_moment, whole.start_moment, rtol=0, atol=1e-9)
    # Newton's steps are exact: of a symmetric part of the system they would be several times as many.
    assert parts.iterations < whole.iterations + 10
    assert (bool(parts.stable), int(parts.index)) == (False, -1)
    assert "no energy tells whether it is stable" in rodjax.describe(parts).splitlines()[0]


def test_derivatives_are_those_of_the_rod():
    def tips(scale):
        scene, harness = whole_and_cut(END, scale, True)
        whole = rodjax.solve(scene, segments=16, solver=TIGHT)
        return whole.nodes[12], rodjax.solve(harness, segments=8, solver=TIGHT)["b"].nodes[4]

    (whole, part), (of_whole, of_part) = jax.jvp(tips, (jnp.array(1.0),), (jnp.array(1.0),))
    np.testing.assert_allclose(part, whole, rtol=0, atol=1e-9)
    np.testing.assert_allclose(of_part, of_whole, rtol=1e-7, atol=1e-9)


def test_loads_that_are_too_much_at_once_are_put_on_by_parts():
    """A follower force that winds the rod up: 100 EI/L^2 across."""
    end = Free((0.0, 100 * EI, 0.0), follower=True)
    scene, harness = whole_and_cut(end)
    whole = rodjax.solve(scene, segments=32, solver=TIGHT)
    parts = rodjax.solve(harness, segments=16, solver=TIGHT)
    assert whole.converged
    assert parts.converged
    assert parts.iterations > MOST_UNJUDGED
    np.testing.assert_allclose(parts["b"].nodes[-1], whole.nodes[-1], rtol=0, atol=1e-9)


def test_beside_an_obstacle():
    """A joint at the end of a rod that follower forces press on a floor, under a dead force, is its free end."""
    floor, force = Plane((0, 0, -0.35), (0, 0, 1)), np.array([0.0, 0.5 * EI, EI])
    scenes = [
        Scene(bent(1.0), START, end, GRAVITY, distributed=ALONG, obstacles=[floor])
        for end in (Free(force=force), Joint("tip"))
    ]
    whole = rodjax.solve(scenes[0], segments=12, solver=TIGHT)
    tip = rodjax.solve(Harness({"a": scenes[1]}, {"tip": Body(force=force)}), segments=12, solver=TIGHT)
    assert tip.converged
    assert jnp.sum(whole.contact_forces[..., 2]) > EI
    np.testing.assert_allclose(tip["a"].nodes, whole.nodes, rtol=0, atol=1e-8)
    assert tip.iterations < 25


@pytest.mark.slow
def test_beside_rods_in_contact():
    """One of two crossing rods is pressed on the other by forces that follow it."""
    frames = rodjax.frame((1, 0, 0), d2=(0, 0, 1)), rodjax.frame((0, 1, 0), d2=(0, 0, 1))
    ends = [[Clamp((-0.25, 0, 0.006), frames[0]), Clamp((0.25, 0, 0.006), frames[0])]]
    ends += [[Clamp((0, -0.25, -0.006), frames[1]), Clamp((0, 0.25, -0.006), frames[1])]]

    def solved(scale):
        pressing = DistributedForce(scale * 20 * EI * jnp.array([0.0, -1.0, 0.3]), follower=True)
        cables = {
            "upper": Scene(plain(0.5), *ends[0], distributed=[pressing]),
            "lower": Scene(plain(0.5), *ends[1]),
        }
        return rodjax.solve(Harness(cables, contact=True), segments=8, solver=TIGHT)

    def pushed(scale):
        return solved(scale)["lower"].end_force

    one, step = jnp.array(1.0), 1e-4
    found, change = jax.jvp(pushed, (one,), (one,))
    np.testing.assert_allclose(change, (pushed(one + step) - pushed(one - step)) / (2 * step), rtol=1e-6, atol=1e-8)
    rods = solved(one)
    assert rods.converged
    np.testing.assert_array_equal(rods["lower"].end_force, found)
    np.testing.assert_allclose(rods["upper"].contact_forces.sum(0), -rods["lower"].contact_forces.sum(0), atol=1e-12)
    assert rods["upper"].contact_forces.sum(0)[2] > 0.5 * EI


@pytest.mark.slow
def test_beside_a_rod_that_slides():
    clip = Clip(0.25, (0.13, 0.02, -0.13), sliding=True)
    scene, harness = whole_and_cut(Free((0.5 * EI, -2 * EI, EI), follower=True))
    whole = rodjax.solve(eqx.tree_at(lambda scene: scene.clips, scene, (clip,)), segments=16, solver=TIGHT)
    harness = eqx.tree_at(lambda harness: harness.scenes[0].clips, harness, (clip,))
    parts = rodjax.solve(harness, segments=8, solver=TIGHT)
    assert parts.converged
    at = float(parts["a"].scene.clips[0].at)
    assert at == pytest.approx(float(whole.scene.clips[0].at), abs=1e-6)
    np.testing.assert_allclose(parts["b"].nodes[-1], whole.nodes[-1], rtol=0, atol=1e-5)


def test_an_end_on_a_hinge_under_follower_forces():
    """No moment about its axis, and a mesh by `rtol`."""
    hinge = Hinge((0, 0, 0), START.frame, (0, 1, 0))
    result = rodjax.solve(Scene(bent(1.0), hinge, END, GRAVITY, distributed=ALONG), rtol=1e-4)
    assert result.converged
    assert abs(result.start_moment[1]) < 1e-8
    assert jnp.linalg.norm(result.start_moment) > 0.1 * EI


def test_what_a_plain_rod_does_not_tell_is_refused():
    end = Free(moment=(0.0, EI, 0.0))
    with pytest.raises(ValueError, match="make that end a Joint of a Harness, and give its Body the moment"):
        Harness({"a": Scene(plain(1.0), START, Joint("j")), "b": Scene(plain(1.0), Joint("j"), end)})
    # A rod by frames tells.
    Harness({"a": Scene(plain(1.0), START, Joint("j")), "b": Scene(bent(1.0), Joint("j"), end)})
