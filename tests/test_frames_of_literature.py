"""Rigid-jointed frames of the literature: planar ones against shooting with SciPy, the right-angle frame in space."""

import itertools
import math

import jax
import numpy as np
import pytest
from planar_frames import PlanarRod, load_that_holds, solve_frame
from scipy.optimize import brentq

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


def by_shooting(corners: dict, members: list, EI: float, EA: float, held: dict, found) -> tuple[list, np.ndarray, dict]:
    """The rods of the independent code, and its guess at the forces and the poses of an equilibrium of rodjax."""
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
    poses = {}
    for name in corners:
        if name not in held:
            body = found.joints[name]
            angle = math.atan2(body.frame[2, 0], body.frame[0, 0])
            poses[name] = (float(body.position[0]), float(body.position[2]), angle)
    return rods, np.array(forces), poses


def agree(corners: dict, members: list, EI: float, EA: float, held: dict, loads: dict, found) -> None:
    """Displacements of rodjax against those of the independent code, to 1e-6 of the largest."""
    rods, forces, poses = by_shooting(corners, members, EI, EA, held, found)
    joints, _ = solve_frame(
        rods, {name: (*loads.get(name, (0.0, 0.0)), 0.0) for name in poses}, forces * (1 + 1e-4), poses
    )
    largest = max(np.linalg.norm(np.subtract(joints[name][:2], corners[name])) for name in poses)
    for name in poses:
        assert np.max(np.abs(np.subtract(joints[name][:2], poses[name][:2]))) < 1e-6 * largest
        assert abs(joints[name][2] - poses[name][2]) < 1e-6


TIGHT = Newton(tolerance=1e-10)


def follow_load(
    corners: dict, members: list, EI: float, EA: float, held: dict, joint: str, loads: tuple, segments: int
):
    """The branch as a downward load on a joint goes from one to another, from where there is none; and the loads on
    its equilibria and at its critical points.
    """
    first, last = loads
    ends = [frame_of(corners, members, EI, EA, held, {joint: (0.0, -load)}) for load in loads]
    branch = rodjax.follow(ends, segments=segments, start=-first / (last - first))
    assert branch.ended == rodjax.BranchEnd.SCENES
    at = [first + (last - first) * float(parameter) for parameter in branch.parameter]
    return branch, at, [first + (last - first) * float(point.parameter) for point in branch.critical_points]


def load_of(corners: dict, members: list, EI: float, EA: float, held: dict, joint: str, load: float, found, lower=0.0):
    """The load, by the independent code, under which a joint is as high as in an equilibrium, or lower."""
    rods, forces, poses = by_shooting(corners, members, EI, EA, held, found)
    loads = dict.fromkeys(poses, (0.0, 0.0, 0.0)) | {joint: (0.0, -load, 0.0)}
    height = poses[joint][1] - lower
    return -load_that_holds(rods, loads, forces * (1 + 1e-4), poses, (joint, 1, height))


# Lee, Manuel & Rossow (1968): A = 6, I = 2, members of 120, the load at a fifth of the beam; E as in the sources, 720.
LEE = (
    {"a": (0.0, 0.0), "corner": (0.0, 120.0), "load": (24.0, 120.0), "b": (120.0, 120.0)},
    [("a", "corner"), ("corner", "load"), ("load", "b")],
    1440.0,
    4320.0,
    {"a": "hinge", "b": "hinge"},
)


def test_lees_frame_through_its_limit_points():
    """It snaps at 18.557 EI/L^2 (18.55 in the sources) and, let back, at -9.414 EI/L^2 (-9.4)."""
    branch, loads, limits = follow_load(*LEE, "load", (-30.0, 30.0), segments=32)
    assert [point.kind for point in branch.critical_points] == ["fold", "fold"]
    np.testing.assert_allclose(np.array(limits) / 0.1, [18.557, -9.414], atol=5e-4)
    assert [index for index, _ in itertools.groupby(map(int, branch.index))] == [0, 1, 0]
    # Before it snaps; on its way back, where the load goes up again too; and beyond.
    for k in (4, 16, 20, 33):
        found = jax.tree.map(lambda leaf, k=k: leaf[k], branch.equilibria)
        agree(*LEE, {"load": (0.0, -loads[k])}, found)
    for point, load, sign in zip(branch.critical_points, limits, (1, -1), strict=True):
        assert abs(load_of(*LEE, "load", load, point.equilibrium) - load) < 1e-6 * abs(load)
        # The largest, and the least, that the frame bears about there.
        for lower in (-0.5, 0.5):
            assert sign * load_of(*LEE, "load", load, point.equilibrium, lower) < sign * load - 1e-6


@pytest.mark.exhaustive
def test_a_toggle_snaps_through():
    """Williams' (1964) toggle with a rise of 0.7 in: at its own of 0.386 in the load grows all the way."""
    corners = {"a": (0.0, 0.0), "apex": (12.943, 0.7), "b": (25.886, 0.0)}
    toggle = corners, [("a", "apex"), ("apex", "b")], 9270.0, 1.885e6, {"a": "clamp", "b": "clamp"}
    branch, loads, limits = follow_load(*toggle, "apex", (0.0, 150.0), segments=32)
    # It tilts before it snaps, and rights itself beyond.
    assert [point.kind for point in branch.critical_points] == ["branch", "fold", "fold", "branch"]
    assert [point.index_after for point in branch.critical_points] == [1, 2, 1, 0]
    for k in range(3, len(loads), 8):
        if loads[k] < max(limits):
            found = jax.tree.map(lambda leaf, k=k: leaf[k], branch.equilibria)
            # 16 elements leave 7e-6 of the largest load, an order of 4 a sixteenth of that.
            assert abs(load_of(*toggle, "apex", loads[k], found) - loads[k]) < 1e-6 * max(limits)
    for point, load in zip(branch.critical_points, limits, strict=True):
        assert abs(load_of(*toggle, "apex", load, point.equilibrium) - load) < 1e-6 * max(limits)


def test_a_portal_frame_buckles_to_a_side():
    """Two clamped columns of length h under P each, with a beam of width b: tan(kh) = -kh b/(6 h), k^2 = P/EI."""
    corners = {"a": (0.0, 0.0), "left": (0.0, 1.0), "right": (1.2, 1.0), "b": (1.2, 0.0)}
    members = [("a", "left"), ("left", "right"), ("right", "b")]
    loads = 1.0, 10.0
    ends = [
        # EA h^2/EI of 1e8 shifts the load by less than 1e-7 of it.
        frame_of(corners, members, 1.0, 1e8, dict.fromkeys("ab", "clamp"), dict.fromkeys(("left", "right"), (0.0, -P)))
        for P in loads
    ]
    point = rodjax.critical_point(ends, segments=16)
    kh = brentq(lambda kh: np.sin(kh) + 0.2 * kh * np.cos(kh), 1.6, 3.1)
    assert (point.kind, point.index_before, point.index_after) == ("branch", 0, 1)
    # 16 elements leave 8e-7 of it.
    assert loads[0] + (loads[1] - loads[0]) * point.parameter == pytest.approx(kh**2, rel=2e-6)


def test_lees_frame_beyond_its_limit_point():
    corners, members, _, _, held = LEE
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
