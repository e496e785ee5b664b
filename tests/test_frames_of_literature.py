"""Rigid-jointed frames of the literature: planar ones against shooting with SciPy, the right-angle frame in space."""

import math

import numpy as np
import pytest
from planar_frames import PlanarRod, solve_frame

import rodjax
from rodjax import Body, Clamp, Free, Harness, Hinge, Joint, Newton, Rod, Scene

pytestmark = pytest.mark.slow


def planar(angle: float):
    """The frame of this tangent in the plane of x and z, in which angles from x to z are positive."""
    return rodjax.frame((math.cos(angle), 0.0, math.sin(angle)), (0.0, -1.0, 0.0))


# Out of their plane, into which some of these frames would buckle first.
STIFF = 1000.0


def frame_of(corners: dict, members: list, EI: float, EA: float, held: dict, loads: dict) -> Harness:
    """Straight members between corners (x, z); `held`: "clamp" or "hinge"; `loads`: (Fx, Fz) at corners."""
    cables = {}
    for first, last in members:
        way = np.subtract(corners[last], corners[first])
        own = planar(math.atan2(way[1], way[0]))
        rod = Rod(float(np.linalg.norm(way)), (STIFF * EI, EI), STIFF * EI, EA)
        cables[f"{first}-{last}"] = Scene(rod, Joint(first, own), Joint(last, own))
    joints = {}
    for name, (x, z) in corners.items():
        place = (x, 0.0, z)
        supports = {"clamp": Clamp(place, np.eye(3)), "hinge": Hinge(place, np.eye(3), (0, 1, 0))}
        force = loads.get(name)
        dead = None if force is None else (force[0], 0.0, force[1])
        joints[name] = Body(dead, support=supports.get(held.get(name, "")))
    return Harness(cables, joints)


def agree(corners: dict, members: list, EI: float, EA: float, held: dict, loads: dict, found) -> None:
    """Displacements of rodjax against those of the independent code, to 1e-6 of the largest."""
    rods, forces = [], []
    for first, last in members:
        way = np.subtract(corners[last], corners[first])
        angle = math.atan2(way[1], way[0])
        ends = []
        for name in (first, last):
            fixed = (*corners[name], None if held.get(name) == "hinge" else angle)
            ends.append(fixed if name in held else (name, angle))
        rods.append(PlanarRod(float(np.linalg.norm(way)), EI, EA, *ends))
        rod = found[f"{first}-{last}"]
        third = -rod.start_moment[1]
        if held.get(first) == "hinge":
            third = math.atan2(rod.tangents[0, 2], rod.tangents[0, 0])
        forces.append([float(rod.start_force[0]), float(rod.start_force[2]), float(third)])
    free = [name for name in corners if name not in held]
    poses = {}
    for name in free:
        body = found.joints[name]
        poses[name] = (body.position[0], body.position[2], math.atan2(body.frame[2, 0], body.frame[0, 0]))
    joints, _ = solve_frame(
        rods, {name: (*loads.get(name, (0.0, 0.0)), 0.0) for name in free}, np.array(forces) * (1 + 1e-4), poses
    )
    largest = max(np.linalg.norm(np.subtract(joints[name][:2], corners[name])) for name in free)
    for name in free:
        assert np.max(np.abs(np.subtract(joints[name][:2], poses[name][:2]))) < 1e-6 * largest
        assert abs(joints[name][2] - poses[name][2]) < 1e-6


TIGHT = Newton(tolerance=1e-10)


def test_lees_frame_before_its_limit_point():
    """Lee, Manuel & Rossow (1968): E = 720, A = 6, I = 2, members of 120, the load at a fifth of the beam."""
    corners = {"a": (0.0, 0.0), "corner": (0.0, 120.0), "load": (24.0, 120.0), "b": (120.0, 120.0)}
    members = [("a", "corner"), ("corner", "load"), ("load", "b")]
    held = {"a": "hinge", "b": "hinge"}
    found = None
    for load in (5.0, 10.0, 15.0, 18.0):
        loads = {"load": (0.0, -load)}
        harness = frame_of(corners, members, 1440.0, 4320.0, held, loads)
        found = rodjax.solve(harness, segments=64, guess=found, solver=TIGHT)
        assert found.stable
        agree(corners, members, 1440.0, 4320.0, held, loads, found)


def test_williams_toggle_before_it_snaps():
    """Williams (1964): EI = 9270 lb in^2, EA = 1.885e6 lb, half span 12.943 in, rise 0.386 in."""
    corners = {"a": (0.0, 0.0), "apex": (12.943, 0.386), "b": (25.886, 0.0)}
    members, held, found = [("a", "apex"), ("apex", "b")], {"a": "clamp", "b": "clamp"}, None
    for load in (10.0, 20.0, 30.0):
        loads = {"apex": (0.0, -load)}
        harness = frame_of(corners, members, 9270.0, 1.885e6, held, loads)
        found = rodjax.solve(harness, segments=32, guess=found, solver=TIGHT)
        assert found.stable
        agree(corners, members, 9270.0, 1.885e6, held, loads, found)


def test_a_portal_frame_sways():
    corners = {"a": (0.0, 0.0), "left": (0.0, 1.0), "right": (1.2, 1.0), "b": (1.2, 0.0)}
    members = [("a", "left"), ("left", "right"), ("right", "b")]
    held = {"a": "clamp", "b": "clamp"}
    loads = {"left": (4.0, -3.0), "right": (0.0, -2.0)}
    found = rodjax.solve(frame_of(corners, members, 1.0, 1000.0, held, loads), segments=32, solver=TIGHT)
    assert found.stable
    agree(corners, members, 1.0, 1000.0, held, loads, found)


def test_the_right_angle_frame_buckles_out_of_its_plane():
    """Argyris et al. (1979), Simo & Vu-Quoc (1986): legs of 240 mm, strip of 30 x 0.6 mm, E = 71240 N/mm^2, nu = 0.31,
    under an end load in its plane: 1.09 N.
    """
    width, height, E = 30.0, 0.6, 71240.0
    G = E / (2 * 1.31)
    # d1 out of the plane: the moment about it bends the strip in its plane.
    in_plane, across = E * height * width**3 / 12, E * width * height**3 / 12
    strip = Rod(240.0, (in_plane, across), G * width * height**3 / 3, E * width * height)
    first, second = (rodjax.frame(t, d2) for t, d2 in (((1, 0, 0), (0, 0, 1)), ((0, 0, -1), (1, 0, 0))))

    def index(load: float) -> int:
        legs = {
            "first": Scene(strip, Clamp((0, 0, 0), first), Joint("corner", first)),
            "second": Scene(strip, Joint("corner", second), Free(force=(load, 0, 0))),
        }
        found = rodjax.solve(Harness(legs), segments=16, find="equilibrium")
        assert found.converged
        return int(found.index)

    low, high = 0.5, 1.5
    assert (index(low), index(high)) == (0, 1)
    for _ in range(14):
        middle = (low + high) / 2
        low, high = (middle, high) if index(middle) == 0 else (low, middle)
    # The sources give 1.09 and 1.088.
    assert abs(low - 1.088) < 5e-4
