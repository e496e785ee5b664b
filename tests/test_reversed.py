"""Every scene, start and end exchanged, has the reversed equilibrium."""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, Rod, Scene, Swivel, frame
from rodjax.model.rest import SpaceCurve

# Arclength s becomes L - s, the tangent turns round, and d2 with it, so that the frame stays right-handed.
TURNED = jnp.array([1.0, -1.0, -1.0])
SEGMENTS = 16
GRAVITY = (0.0, 1.0, -9.81)


def reversed_along(value, length):
    if isinstance(value, rj.Steps):
        return rj.Steps(length - value.jumps[::-1], value.values[::-1])
    if isinstance(value, rj.Smooth):
        return rj.Smooth(length - value.s[::-1], value.values[::-1])
    return value


def negative(value, length):
    value = reversed_along(value, length)
    if isinstance(value, rj.Steps):
        return rj.Steps(value.jumps, -value.values)
    if isinstance(value, rj.Smooth):
        return rj.Smooth(value.s, -value.values)
    return -value


def reversed_rod(rod: Rod) -> Rod:
    """Of t x t' the component along d1 changes its sign, as t and s do both; so does that along d2, as d2 does too."""
    length = rod.length
    EI = rod.EI
    pair = tuple(reversed_along(value, length) for value in EI) if isinstance(EI, tuple) else reversed_along(EI, length)
    GJ, EA, mass = (reversed_along(value, length) for value in (rod.GJ, rod.EA, rod.mass_per_length))
    radius = None if rod.radius is None else reversed_along(rod.radius, length)
    curvature = rod.rest_curvature
    if curvature is not None:
        curvature = negative(curvature[0], length), reversed_along(curvature[1], length)
    twist, strain, GA = (
        None if value is None else reversed_along(value, length) for value in (rod.rest_twist, rod.rest_strain, rod.GA)
    )
    found = Rod(length, pair, GJ, EA, mass, radius, curvature, twist, GA=GA, rest_strain=strain)
    curve = rod.rest_centerline
    if curve is None:
        return found
    curve = SpaceCurve(curve.points[::-1], 1 - curve.s[::-1], curve.d1[::-1])
    return eqx.tree_at(lambda rod: rod.rest_centerline, found, curve, is_leaf=lambda value: value is None)


def reversed_support(end):
    if isinstance(end, Clamp):
        return Clamp(end.position, end.frame * TURNED[None])
    if isinstance(end, Swivel):
        return Swivel(end.position, -end.tangent)
    if isinstance(end, rj.Hinge):
        return rj.Hinge(end.position, end.frame * TURNED[None], end.axis)
    if isinstance(end, rj.Slider):
        return rj.Slider(end.position, end.directions, None if end.frame is None else end.frame * TURNED[None])
    if isinstance(end, rj.Spring):
        return rj.Spring(reversed_support(end.support), end.translation, end.rotation)
    if isinstance(end, Free) and end.follower:
        force, moment = (None if load is None else load * TURNED for load in (end.force, end.moment))
        return Free(force, moment, follower=True)
    return end


def reversed_clip(clip: Clip, length) -> Clip:
    if clip.frame is not None:
        return Clip(length - clip.at, clip.position, frame=clip.frame * TURNED[None])
    tangent = None if clip.tangent is None else -clip.tangent
    return Clip(length - clip.at, clip.position, tangent, sliding=clip.sliding)


Load = TypeVar("Load", bound=rj.PointForce | rj.PointCouple | rj.DistributedForce | rj.DistributedCouple)


def reversed_load(load: Load, length) -> Load:
    """What follows the rod is along frames that are turned."""
    name = "couple" if isinstance(load, rj.PointCouple | rj.DistributedCouple) else "force"
    turn = TURNED if load.follower else jnp.ones(3)
    changed = {name: getattr(load, name) * turn}
    if isinstance(load, rj.PointForce | rj.PointCouple):
        return dataclasses.replace(load, at=length - load.at, **changed)
    return dataclasses.replace(load, part=None if load.part is None else length - load.part[::-1], **changed)


def reversed_scene(scene: Scene) -> Scene:
    length = scene.rod.length
    return Scene(
        reversed_rod(scene.rod),
        reversed_support(scene.end),
        reversed_support(scene.start),
        scene.gravity,
        [reversed_load(force, length) for force in scene.point_forces[::-1]],
        scene.turns,
        [reversed_load(load, length) for load in scene.distributed],
        [reversed_clip(clip, length) for clip in scene.clips[::-1]],
        scene.obstacles,
        point_couples=[reversed_load(couple, length) for couple in scene.point_couples[::-1]],
    )


ROD = Rod(1.0, 0.02, 0.015, 1e4, 0.15, radius=0.005)
CURVED = Rod(1.0, (0.02, 0.03), 0.015, 1e4, 0.15, rest_curvature=(0.5, 1.0), rest_twist=0.7)
STEPPED = Rod(1.0, rj.Steps([0.25, 0.5], [0.02, 0.03, 0.01]), 0.015, 1e4, rj.Steps([0.5], [0.1, 0.2]))
SMOOTH = Rod(1.0, rj.Smooth([0, 0.4, 1], [0.02, 0.03, 0.01]), 0.015, 1e4, 0.15)
RADII = Rod(1.0, 0.02, 0.015, 1e4, 0.15, radius=rj.Steps([0.5], [0.005, 0.01]))
ARC = np.linspace(0, 1.2, 6)
OF_A_CURVE = Rod.from_centerline(
    np.stack([np.sin(ARC), 0.2 * ARC, 1 - np.cos(ARC)], axis=1), (0.02, 0.03), 0.015, 1e4, 0.1
)
SHEARED = Rod(1.0, 0.02, 0.015, 1e3, 0.15, GA=(20.0, 40.0), rest_strain=rj.Steps([0.25], [0.02, -0.01]))
HERE, THERE = Clamp((0, 0, 0.1), frame((1, 0, 0))), Clamp((0.7, 0.2, 0.15), frame((1, 0.4, 0.2)))
FORCES = [rj.PointForce(0.31, (0.1, 0.2, 0.3)), rj.PointForce(0.75, (0.0, -0.1, 0.1))]
FLOOR = rj.Plane((0, 0, 0), (0, 0, 1))
PIPE = rj.Capsule((0.3, -0.5, 0.0), (0.3, 0.5, 0.02), 0.05)

# Their programs differ: the slow ones are there once more for their structure.
QUICK = {
    "a free end, floor": Scene(ROD, HERE, Free(), GRAVITY, obstacles=[FLOOR]),
    "clips": Scene(ROD, Pin((0, 0, 0.1)), Pin((0.7, 0.2, 0.15)), GRAVITY, clips=[Clip(0.4, (0.3, 0.1, 0.2))]),
    "sheared, heated, loads within": Scene(
        SHEARED,
        HERE,
        THERE,
        point_forces=[rj.PointForce(0.31, (0.1, 0.2, 0.3), follower=True)],
        distributed=[rj.DistributedForce((0.3, 0.5, -1.0), part=(0.25, 0.5)), rj.DistributedCouple((0.0, 0.01, 0.02))],
        point_couples=[rj.PointCouple(0.75, (0.0, 0.02, 0.01), follower=True), rj.PointCouple(0.75, (0.01, 0, 0))],
    ),
    "sliding clip": Scene(ROD, HERE, THERE, GRAVITY, clips=[Clip(0.5, (0.4, 0.1, 0.05), (1, 0.2, 0), sliding=True)]),
}
SLOW = {
    "clamp and swivel, forces": Scene(ROD, HERE, Swivel((0.7, 0.2, 0.15), (1, 0.4, 0.2)), GRAVITY, FORCES),
    "clamps and turns": Scene(ROD, HERE, THERE, GRAVITY, FORCES, turns=1),
    "a force at the free end": Scene(ROD, HERE, Free(force=(0.1, 0.2, 0.0)), GRAVITY),
    "a moment at the free end": Scene(ROD, HERE, Free(moment=(0.01, 0.01, 0.02)), GRAVITY),
    "curved": Scene(CURVED, HERE, THERE, GRAVITY, FORCES),
    "curved, free": Scene(CURVED, HERE, Free(), GRAVITY),
    "stepped": Scene(STEPPED, HERE, THERE, GRAVITY),
    "smooth": Scene(SMOOTH, Pin((0, 0, 0.1)), Pin((0.7, 0.2, 0.15)), GRAVITY),
    "distributed": Scene(ROD, HERE, THERE, distributed=[rj.DistributedForce((0.3, 0.5, -1.0))]),
    "directed clip": Scene(ROD, HERE, THERE, GRAVITY, clips=[Clip(0.4, (0.3, 0.1, 0.2), (1, 0.2, 0))]),
    "clip with a frame": Scene(ROD, HERE, THERE, GRAVITY, clips=[Clip(0.4, (0.3, 0.1, 0.2), frame=frame((1, 0.2, 0)))]),
    "radius of steps, floor": Scene(RADII, HERE, Free(), GRAVITY, obstacles=[FLOOR]),
    "of a curve": Scene(OF_A_CURVE, HERE, THERE, GRAVITY),
    "followers on a free end": Scene(
        ROD,
        HERE,
        Free((0.1, 0.05, 0.0), (0.0, 0.01, 0.02), follower=True),
        GRAVITY,
        distributed=[rj.DistributedForce((0.1, 0.2, 0.0), follower=True, part=(0.25, 1.0))],
    ),
    "hinge and spring": Scene(
        ROD,
        rj.Hinge((0, 0, 0.1), frame((1, 0, 0)), (0, 1, 0)),
        rj.Spring(Clamp((0.7, 0.2, 0.15), frame((1, 0.4, 0.2))), 3.0, 0.05),
        GRAVITY,
    ),
    "clip, floor, pipe": Scene(ROD, HERE, THERE, GRAVITY, clips=[Clip(0.5, (0.4, 0.1, 0.1))], obstacles=[FLOOR, PIPE]),
}


def close(found, expected, size, name, rtol):
    np.testing.assert_allclose(found, expected, rtol=0, atol=rtol * size, err_msg=name)


def check_reversed(scene: Scene) -> None:
    """Both to a residual of 1e-10 EI/L^2, or to the rounding floor of contacts; so is what they differ by, but for
    forces of contacts, whose places along the rod are soft: these differ by up to 200 times as much.
    """
    solver = rj.Newton(tolerance=1e-10)
    forward = rj.solve(scene, segments=SEGMENTS, solver=solver)
    # From the same shape: from one of its own a scene may come to another minimum.
    guess = rj.Guess(forward.position_at(np.linspace(0, 1, 2 * SEGMENTS + 1))[::-1], forward.total_twist)
    back = rj.solve(reversed_scene(scene), segments=SEGMENTS, solver=solver, guess=guess)
    assert forward.converged, rj.describe(forward)
    assert back.converged, rj.describe(back)
    rtol = 1e-6
    force = float(scene.rod.bending_scale)
    close(back.nodes[::-1], forward.nodes, 1.0, "nodes", rtol)
    close(back.frames[::-1, :, 2], -forward.frames[:, :, 2], 1.0, "frames", rtol)
    if scene.rod.GA is None:  # else phi' has another direction on the other side of a jump of force or strain
        close(back.tangents[::-1], -forward.tangents, 1.0, "tangents", rtol)
    close(back.tension[::-1], forward.tension, force, "tension", rtol)
    close(back.energy, forward.energy, force, "energy", rtol)
    close(back.elastic_energy, forward.elastic_energy, force, "elastic_energy", rtol)
    # What lies beyond the one end lies before the other.
    for one, other in (("start", "end"), ("end", "start")):
        for kind in ("force", "moment"):
            found, expected = getattr(back, f"{one}_{kind}"), getattr(forward, f"{other}_{kind}")
            close(found, -expected, force, f"{one}_{kind}", rtol)
    close(back.contact_forces[::-1], forward.contact_forces, force, "contact_forces", rtol)
    close(back.clip_forces[::-1], forward.clip_forces, force, "clip_forces", rtol)
    close(back.total_twist, forward.total_twist, 1.0, "total_twist", rtol)
    assert bool(back.stable) == bool(forward.stable)


@pytest.mark.parametrize("scene", QUICK.values(), ids=QUICK)
def test_a_scene_reversed_has_the_reversed_equilibrium(scene):
    check_reversed(scene)


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        # "curved, free" repeats it.
        pytest.param(scene, id=name, marks=[pytest.mark.exhaustive] if name == "curved" else [])
        for name, scene in SLOW.items()
    ],
)
def test_more_scenes_reversed_have_the_reversed_equilibrium(scene):
    check_reversed(scene)
