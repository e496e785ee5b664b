"""Every scene, start and end exchanged, has the reversed equilibrium."""

import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, Rod, Scene, Swivel, frame

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
    twist = None if rod.rest_twist is None else reversed_along(rod.rest_twist, length)
    return Rod(length, pair, GJ, EA, mass, radius, curvature, twist)


def reversed_support(end):
    if isinstance(end, Clamp):
        return Clamp(end.position, end.frame * TURNED[None])
    if isinstance(end, Swivel):
        return Swivel(end.position, -end.tangent)
    return end


def reversed_clip(clip: Clip, length) -> Clip:
    if clip.frame is not None:
        return Clip(length - clip.at, clip.position, frame=clip.frame * TURNED[None])
    tangent = None if clip.tangent is None else -clip.tangent
    return Clip(length - clip.at, clip.position, tangent, sliding=clip.sliding)


def reversed_scene(scene: Scene) -> Scene:
    length = scene.rod.length
    return Scene(
        reversed_rod(scene.rod),
        reversed_support(scene.end),
        reversed_support(scene.start),
        scene.gravity,
        [rj.PointForce(length - force.at, force.force) for force in scene.point_forces[::-1]],
        scene.turns,
        scene.distributed,
        [reversed_clip(clip, length) for clip in scene.clips[::-1]],
        scene.obstacles,
    )


ROD = Rod(1.0, 0.02, 0.015, 1e4, 0.15, radius=0.005)
CURVED = Rod(1.0, (0.02, 0.03), 0.015, 1e4, 0.15, rest_curvature=(0.5, 1.0), rest_twist=0.7)
STEPPED = Rod(1.0, rj.Steps([0.25, 0.5], [0.02, 0.03, 0.01]), 0.015, 1e4, rj.Steps([0.5], [0.1, 0.2]))
SMOOTH = Rod(1.0, rj.Smooth([0, 0.4, 1], [0.02, 0.03, 0.01]), 0.015, 1e4, 0.15)
RADII = Rod(1.0, 0.02, 0.015, 1e4, 0.15, radius=rj.Steps([0.5], [0.005, 0.01]))
HERE, THERE = Clamp((0, 0, 0.1), frame((1, 0, 0))), Clamp((0.7, 0.2, 0.15), frame((1, 0.4, 0.2)))
FORCES = [rj.PointForce(0.31, (0.1, 0.2, 0.3)), rj.PointForce(0.75, (0.0, -0.1, 0.1))]
FLOOR = rj.Plane((0, 0, 0), (0, 0, 1))
PIPE = rj.Capsule((0.3, -0.5, 0.0), (0.3, 0.5, 0.02), 0.05)

# Their programs differ: the slow ones are there once more for their structure.
QUICK = {
    "a free end, floor": Scene(ROD, HERE, Free(), GRAVITY, obstacles=[FLOOR]),
    "clips": Scene(ROD, Pin((0, 0, 0.1)), Pin((0.7, 0.2, 0.15)), GRAVITY, clips=[Clip(0.4, (0.3, 0.1, 0.2))]),
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
    "clip, floor, pipe": Scene(ROD, HERE, THERE, GRAVITY, clips=[Clip(0.5, (0.4, 0.1, 0.1))], obstacles=[FLOOR, PIPE]),
}


def close(found, expected, size, name, rtol):
    np.testing.assert_allclose(found, expected, rtol=0, atol=rtol * size, err_msg=name)


def check_reversed(scene: Scene) -> None:
    """Both to a residual of 1e-8 EI/L^2, or to the rounding floor of contacts; so is what they differ by."""
    forward = rj.solve(scene, segments=SEGMENTS)
    # From the same shape: from one of its own a scene may come to another minimum.
    guess = rj.Guess(forward.position_at(np.linspace(0, 1, 2 * SEGMENTS + 1))[::-1], forward.total_twist)
    back = rj.solve(reversed_scene(scene), segments=SEGMENTS, guess=guess)
    assert forward.converged, rj.describe(forward)
    assert back.converged, rj.describe(back)
    rtol = 1e-6
    force = float(scene.rod.bending_scale)
    close(back.nodes[::-1], forward.nodes, 1.0, "nodes", rtol)
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
