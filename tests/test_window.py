"""The window's session, without a browser."""

import contextlib
import http.client
import importlib.metadata
import inspect
import io
import math
import socket
import sys
import threading
import time
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax.cli import main
from rodjax.io.harness_file import read_scene
from rodjax.window import origins, tube
from rodjax.window.bounds import Asked, asked_of, why_not
from rodjax.window.browser import Window, started
from rodjax.window.controls import Pose, controls_of, handles_of, moved, scene_of, shared_obstacles, sliders_of
from rodjax.window.files import path_file, scene_file
from rodjax.window.mailbox import Mailbox
from rodjax.window.numbers import rows
from rodjax.window.opening import DRAWN, session_of, view
from rodjax.window.session import SNAP_WAY, Session

SEGMENTS = 10
# Between the ends of `hanging`, too large to go around.
WALL = rj.Box((0.4, 0.0, 0.0), (0.02, 20.0, 20.0))
LEVEL = rj.frame((1.0, 0.0, 0.0))


def hanging(**more) -> rj.Scene:
    return rj.Scene(
        rj.problems.cable(),
        rj.Clamp((0.0, 0.0, 0.0), LEVEL),
        rj.Clamp((0.8, 0.0, 0.0), LEVEL),
        gravity=(0.0, 0.0, -9.81),
        **more,
    )


def turned(frame, angle: float) -> np.ndarray:
    """About its own tangent."""
    frame = np.asarray(frame)
    return Rotation.from_rotvec(angle * frame[:, 2]).as_matrix() @ frame


def until(is_so, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.fixture(scope="module")
def begun() -> Session:
    return Session(hanging(), segments=SEGMENTS)


@pytest.fixture
def session(begun: Session) -> Session:
    begun.show(begun.first)
    begun.recorded, begun.is_recording, begun._undone = [], False, []
    return begun


def end(session: Session) -> Pose:
    return session.now.controls.poses["end"]


# --- controls --------------------------------------------------------------------------------------------------------


def test_a_scene_of_its_own_controls_is_the_same():
    box = rj.Box((0.4, 0.0, -0.5), (0.1, 0.1, 0.1), np.eye(3))
    clip = rj.Clip(0.5, (0.4, 0.0, -0.1), tangent=(1, 0, 0))
    loads = {
        "potentials": [rj.Potential(jax.tree_util.Partial(lambda k, position, s: k * position[2] ** 2, 3.0))],
        "point_couples": [rj.PointCouple(0.3, (0.0, 1e-3, 0.0))],
        "distributed": [rj.DistributedForce((0.0, 0.0, 0.1), part=(0.2, 0.6))],
    }
    scene = hanging(clips=[clip], obstacles=[box], self_contact=True, **loads)
    same = scene_of(scene, controls_of(scene))
    assert jax.tree.structure(same) == jax.tree.structure(scene)
    assert jax_leaves(same) == pytest.approx(jax_leaves(scene), abs=1e-15)  # the tangent of a clip by way of a frame


def jax_leaves(scene: rj.Scene | rj.Harness) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(scene)])


def test_handles_and_sliders_are_those_of_what_the_scene_has():
    scene = hanging(clips=[rj.Clip(0.5, (0.4, 0.0, -0.1))], obstacles=[rj.Distance(lambda point: point[2] + 1.0)])
    assert list(handles_of(scene)) == ["start", "end", "clips[0]"]  # what has only a distance cannot be moved
    assert not handles_of(scene)["clips[0]"].turns
    assert list(sliders_of(scene)) == ["rod.length", "rod.EI", "rod.GJ", "gravity", "clips[0].at"]
    cantilever = rj.problems.cantilever()
    assert list(handles_of(cantilever)) == ["start"]
    assert list(sliders_of(cantilever)) == ["rod.length", "rod.EI", "rod.GJ"]


def test_numbers_of_sliders_are_those_of_the_scene():
    scene = hanging(clips=[rj.Clip(0.5, (0.4, 0.0, -0.1))])
    numbers = {"rod.length": 1.2, "rod.EI": 2.0, "rod.GJ": 0.5, "gravity": 0.25, "clips[0].at": 0.45}
    changed = scene_of(scene, controls_of(scene).changed(numbers))
    assert float(changed.rod.length) == 1.2
    assert float(changed.rod.EI) == 2.0 * float(scene.rod.EI)
    assert float(changed.rod.GJ) == 0.5 * float(scene.rod.GJ)
    assert changed.gravity is not None
    np.testing.assert_allclose(changed.gravity, (0, 0, -9.81 / 4))
    assert float(changed.clips[0].at) == 0.45


@pytest.mark.parametrize(
    "obstacle",
    [
        rj.Plane((0.1, 0.2, 0.3), (0.0, 1.0, 1.0)),
        rj.Sphere((0.1, 0.2, 0.3), 0.1),
        rj.Capsule((0.1, 0.2, 0.3), (0.4, 0.2, 0.1), 0.1),
        rj.Cylinder((0.1, 0.2, 0.3), (0.4, 0.2, 0.1), 0.1),
        rj.Box((0.1, 0.2, 0.3), (0.1, 0.2, 0.3), np.eye(3)),
        rj.Pipe([(0.1, 0.2, 0.3), (0.4, 0.2, 0.1), (0.5, 0.5, 0.1)], 0.05),
        rj.Union(rj.Sphere((0.1, 0.2, 0.3), 0.1), rj.Sphere((0.3, 0.2, 0.3), 0.1)),
    ],
    ids=lambda obstacle: type(obstacle).__name__,
)
def test_an_obstacle_moves_as_a_rigid_body(obstacle):
    """The distance of a point is that of the point moved back."""
    pivot, pose = (
        np.array([0.2, 0.1, 0.0]),
        Pose(np.array([-0.1, 0.3, 0.2]), Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix()),
    )
    points = np.random.default_rng(0).normal(size=(20, 3))
    back = pivot + (points - pose.position) @ pose.frame
    np.testing.assert_allclose(moved(obstacle, pivot, pose).distance(points), obstacle.distance(back), atol=1e-12)


def test_half_of_a_move_is_half_of_its_turn():
    scene = hanging()
    controls = controls_of(scene)
    frame = turned(LEVEL, 1.0)
    half = controls.between(controls.changed({"end": ((0.6, 0.0, 0.0), frame), "gravity": 0.5}), 0.5)
    np.testing.assert_allclose(half.poses["end"].position, (0.7, 0, 0), atol=1e-15)
    np.testing.assert_allclose(half.poses["end"].frame, turned(LEVEL, 0.5), atol=1e-12)
    assert half.numbers["gravity"] == 0.75
    assert half.poses["start"] is controls.poses["start"]


# --- moves -----------------------------------------------------------------------------------------------------------


def test_the_rod_follows_a_move(session):
    report = session.move({"end": ((0.75, 0.05, 0.02), None)})
    cold = rj.solve(session.result.scene, segments=SEGMENTS)
    assert report.moved
    assert report.message == ""
    np.testing.assert_allclose(session.result.nodes[-1], (0.75, 0.05, 0.02), atol=1e-12)
    # Both solves end at residuals below 1e-8 EI/L^2.
    np.testing.assert_allclose(session.result.nodes, cold.nodes, atol=1e-7)
    np.testing.assert_allclose(report.reading.forces[1], session.result.end_force)
    np.testing.assert_allclose(report.reading.forces[0], -np.asarray(session.result.start_force))


def test_a_connector_is_wound_up_and_unwound(session):
    """Two turns in one move are made in pieces, so that none is lost; the twist in the rod is that of its ends."""
    before = np.asarray(session.result.nodes)
    for k in range(1, 9):
        report = session.move({"end": ((0.8, 0.0, 0.0), turned(LEVEL, k * math.pi / 2))})
        assert report.moved
    scene = session.result.scene
    shape = rj.solve(scene, segments=SEGMENTS, guess=session.result)
    assert float(session.result.total_twist) == pytest.approx(float(shape.total_twist), abs=1e-8)
    # The ends turned by two turns against one another; what the curve writhes is not twist.
    assert float(session.result.total_twist) > 2 * math.pi
    for k in range(7, -1, -1):
        assert session.move({"end": ((0.8, 0.0, 0.0), turned(LEVEL, k * math.pi / 2))}).moved
    assert float(session.result.total_twist) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(np.abs(np.asarray(session.result.nodes)), np.abs(before), atol=1e-6)


@pytest.mark.parametrize(
    ("move", "told"),
    [
        ({"end": ((5.0, 0.0, 0.0), None)}, "the ends are 5 m apart"),
        ({"end": ((1.2, 0.0, 0.0), None)}, "1 m of rod between them reach at most 1.05 m"),
        ({"end": ((math.nan, 0.0, 0.0), None)}, "end.position must be finite"),
        ({"end": ((0.8, 0.0, 0.0), np.diag([1.0, 1.0, -1.0]))}, "end.frame must be right-handed"),
        ({"rod.length": -1.0}, "length"),
        ({"rod.EI": math.inf}, "rod.EI must be finite"),
        ({"middle": ((0.0, 0.0, 0.0), None)}, "there is nothing to move named 'middle'"),
    ],
)
def test_a_move_that_makes_no_sense_is_told_and_the_session_lives_on(session, move, told):
    report = session.move(move)
    assert not report.moved
    assert told in report.message
    assert bool(session.result.converged)
    assert np.all(np.isfinite(report.reading.centerline))
    assert session.move({"end": ((0.78, 0.0, 0.0), None)}).moved


def test_a_move_beyond_the_reach_is_followed_as_far_as_it_goes(session):
    report = session.move({"end": ((0.8, 0.0, 0.9), None)})
    assert not report.moved
    assert "of the way only" in report.message
    assert 0.2 < end(session).position[2] < 0.7


def test_reach_is_that_of_the_rod_between_two_places():
    scene = hanging(clips=[rj.Clip(0.3, (0.2, 0.0, 0.0)), rj.Clip(0.6, (0.5, 0.0, 0.0), sliding=True)])
    asked = Asked(np.asarray(asked_of(scene).reaches), ())
    np.testing.assert_allclose(asked.reaches, [0.2 / 0.3, 0.3, 0.3])
    assert why_not(scene, asked, Asked(np.array([1.0, 1.0, 1.0]), ())) is None
    told = why_not(scene, asked, Asked(np.array([0.5, 1.0, 1.0]), ()))
    assert told == "clip 0 is 0.2 m from the start, but the 0.3 m of rod between them reach at most 0.15 m"


def test_a_sudden_change_of_shape_is_told_as_a_snap():
    """A strut bowed up by its clamps, which turn down: it jumps where the bow has no equilibrium left."""
    rod = rj.Rod(1.0, EI=1.0, GJ=1.0, EA=1e4)
    tilted = rj.frame((math.cos(0.5), 0.0, -math.sin(0.5)), (0, 1, 0))
    up = rj.frame((math.cos(0.5), 0.0, math.sin(0.5)), (0, 1, 0))
    begin = rj.Scene(rod, rj.Clamp((0, 0, 0), up), rj.Clamp((0.95, 0, 0), tilted))
    session = Session(begin, segments=SEGMENTS)
    assert float(session.result.nodes[SEGMENTS // 2, 2]) > 0.1
    snaps, softest = [], []
    for k in range(41):
        angle = 0.5 - k / 40
        start = rj.frame((math.cos(angle), 0.0, math.sin(angle)), (0, 1, 0))
        stop = rj.frame((math.cos(angle), 0.0, -math.sin(angle)), (0, 1, 0))
        report = session.move({"start": ((0, 0, 0), start), "end": ((0.95, 0, 0), stop)})
        assert report.moved
        if report.snapped:
            assert report.message == "the rod snapped into another shape"
        snaps.append(report.snapped)
        softest.append(session.settle())
    assert sum(snaps) == 1
    before = snaps.index(True) - 1
    assert float(session.result.nodes[SEGMENTS // 2, 2]) < -SNAP_WAY
    # The softest stiffness falls towards the snap.
    assert softest[before] < 0.2 * softest[0]


def test_a_support_may_not_enter_an_obstacle_nor_the_other_way_round():
    ball = rj.Sphere((0.4, 0.0, 0.5), 0.1)
    session = Session(hanging(obstacles=[ball]), segments=SEGMENTS)
    report = session.move({"end": ((0.42, 0.0, 0.5), None)})
    assert "the end is 0.08 m inside of obstacle 0 (sphere)" in report.message
    there = session.now.controls.poses["obstacles[0]"].position
    report = session.move({"obstacles[0]": ((0.0, 0.0, 0.05), None)})
    assert "the start is 0.05 m inside of obstacle 0 (sphere)" in report.message
    assert not report.moved
    assert session.move({"obstacles[0]": (there, None)}).moved


def test_an_obstacle_pushes_the_rod_and_lets_it_go():
    session = Session(hanging(obstacles=[rj.Capsule((0.4, -1.0, -0.5), (0.4, 1.0, -0.5), 0.05)]), segments=SEGMENTS)
    free = np.asarray(session.result.nodes)
    assert session.figures[0].clearances[0] == pytest.approx(-0.055 - (-0.5 - free[:, 2].min()), abs=2e-3)
    report = session.move({"obstacles[0]": ((0.4, 0.0, -0.3), None)})
    assert report.moved
    weight = float(session.scene.rod.mass_per_length) * 9.81
    assert 0.1 * weight < session.figures[0].obstacle_forces[0][2] < 2 * weight
    # All forces on the rod are in balance with its weight.
    total = report.reading.forces.sum(0) + session.figures[0].obstacle_forces.sum(0)
    np.testing.assert_allclose(total, (0, 0, weight), atol=1e-6)
    assert np.max(report.reading.values["pressure"]) > 0
    session.move({"obstacles[0]": ((0.4, 0.0, -0.5), None)})
    np.testing.assert_allclose(session.result.nodes, free, atol=1e-7)
    assert np.all(session.figures[0].obstacle_forces == 0)


KINDS = {
    "a pin, a swivel and a clip that holds a direction": lambda: rj.Scene(
        rj.problems.cable(),
        rj.Pin((0, 0, 0)),
        rj.Swivel((0.8, 0, 0), (1, 0, 0)),
        (0, 0, -9.81),
        clips=[rj.Clip(0.5, (0.4, 0, -0.1), tangent=(1, 0, 0))],
    ),
    "a strip": lambda: rj.Scene(
        rj.Rod(1.0, (5e-3, 2e-2), 5e-3, 800.0, mass_per_length=0.1),
        rj.Clamp((0, 0, 0), LEVEL),
        rj.Clamp((0.8, 0, 0), LEVEL),
        (0, 0, -9.81),
    ),
    "a stiffness that jumps": lambda: rj.Scene(
        rj.Rod(
            1.0, rj.Steps([0.5], [5e-3, 2e-2]), 5e-3, 800.0, mass_per_length=0.1, radius=rj.Smooth([0, 1], [5e-3, 8e-3])
        ),
        rj.Clamp((0, 0, 0), LEVEL),
        rj.Clamp((0.8, 0, 0), LEVEL),
        (0, 0, -9.81),
    ),
    "a moment on a free end, which has no potential": lambda: rj.Scene(
        rj.problems.cable(), rj.Clamp((0, 0, 0), LEVEL), rj.Free(moment=(0, 5e-3, 2e-3)), (0, 0, -9.81)
    ),
    "a clip through which the rod slides": lambda: hanging(clips=[rj.Clip(0.5, (0.4, 0.0, -0.1), sliding=True)]),
}


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] if "slides" in kind else []) for kind in KINDS]
)
def test_every_kind_of_scene_can_be_taken_in_the_hand(kind):
    """Its first handle moves all of it, to where a solve of the scene there finds it."""
    session = Session(KINDS[kind](), segments=SEGMENTS)
    place = session.now.controls.poses["start"].position + np.array([0.01, 0.02, 0.0])
    report = session.move({"start": (place, None), "rod.EI": 1.1})
    assert report.moved, report.message
    again = rj.solve(session.result.scene, segments=SEGMENTS, guess=session.result)
    np.testing.assert_allclose(session.result.nodes, again.nodes, atol=1e-7)  # residuals below 1e-8 EI/L^2
    np.testing.assert_allclose(session.result.nodes[0], place, atol=1e-15)
    assert all(np.all(np.isfinite(values)) for values in report.reading.values.values())
    assert np.isfinite(session.figures[0].bend_radius)
    assert (session.settle() is None) == ("potential" in kind)
    labels = [row.label for row in rows(session, report)]
    assert len(set(labels)) == len(labels)


@pytest.mark.slow
def test_a_harness_is_taken_in_the_hand(tmp_path, monkeypatch):
    """An end and the support of a joint are dragged; both rods follow to where a solve of the harness finds them."""
    cable = rj.problems.cable()
    joints = {"y": rj.Body(support=rj.Spring(rj.Pin((0.8, 0.0, -0.1)), translation=50.0), mass=0.05)}
    rods = {
        "left": rj.Scene(cable, rj.Clamp((0, 0, 0), LEVEL), rj.Joint("y", LEVEL), (0, 0, -9.81)),
        "right": rj.Scene(cable, rj.Joint("y", LEVEL), rj.Clamp((1.6, 0, 0), LEVEL), (0, 0, -9.81)),
    }
    session = Session(rj.Harness(rods, joints), segments=6)
    assert list(session.handles) == ["left/start", "right/end", "joints/y"]
    assert list(session.sliders) == ["left/rod.length", "rod.EI", "rod.GJ", "gravity", "right/rod.length"]
    session.record(True)
    report = session.move(
        {"right/end": ((1.55, 0.05, 0.0), None), "joints/y": ((0.8, 0.05, -0.1), None), "gravity": 0.9}
    )
    assert report.moved, report.message
    result = session.result
    assert isinstance(result, rj.HarnessEquilibrium)
    again = rj.solve(result.harness, segments=6, guess=result)
    np.testing.assert_allclose(result["right"].nodes[-1], (1.55, 0.05, 0), atol=1e-12)
    for name, reading in zip(result, report.readings, strict=True):
        np.testing.assert_allclose(result[name].nodes, again[name].nodes, atol=1e-7)  # residuals below 1e-8 EI/L^2
        np.testing.assert_allclose(reading.centerline[0], result[name].nodes[0], atol=1e-12)
    gravity = result.harness["left"].gravity
    assert gravity is not None
    assert gravity[2] == pytest.approx(-0.9 * 9.81)
    refused = session.move({"right/end": ((math.nan, 0.0, 0.0), None)})
    assert "right/end.position must be finite" in refused.message
    assert session.can_settle
    unit = float(cable.bending_scale)  # EI/L^2, as L = 1 m
    session.softest = 0.4 * unit
    assert session.is_soft
    found = {row.label: row for row in rows(session, refused)}
    assert found["softest motion"].text.endswith("about to snap")
    assert found["softest motion"].is_bad
    session.softest = 0.6 * unit
    assert not session.is_soft
    labels = [row.label for row in rows(session, refused)]
    assert "left: bend radius" in labels
    assert len(set(labels)) == len(labels)
    assert "left: end moment" not in labels
    limited = {row.label: row for row in rows(session, refused, rj.Limits(end_moment=1e-6, end_force=1e3))}
    assert limited["left: end moment"].is_bad
    (force,) = (row for label, row in limited.items() if label.startswith("left: force, "))
    assert force.text.endswith(" of at most 1000 N")
    assert not force.is_bad
    content, _ = path_file(session)
    (tmp_path / "path.vtkhdf").write_bytes(content)
    replayed = session_of(rj.load(tmp_path / "path.vtkhdf"), None)
    assert len(replayed.recorded) == len(session.recorded)
    content, remark = scene_file(session)
    assert remark == ""
    (tmp_path / "harness.toml").write_bytes(content)
    harness = read_scene(tmp_path / "harness.toml")
    assert isinstance(harness, rj.Harness)
    assert jax.tree.structure(harness) == jax.tree.structure(session.result.harness)
    np.testing.assert_array_equal(jax_leaves(harness), jax_leaves(session.result.harness))
    pytest.importorskip("viser", reason="the window needs viser: pip install 'rodjax[view]'")
    prepared = threading.Event()
    monkeypatch.setattr(session, "warm_up", lambda is_wanted: None)
    monkeypatch.setattr(session, "prepare_stability", lambda: prepared.wait(60))
    monkeypatch.setattr(session, "settle", lambda: setattr(session, "softest", 1.0))
    session.show(session.now)
    window = Window(session, port=0)
    try:
        # Moves do not wait for what the softest motion needs; once that is there, it is looked at.
        until(lambda: window.is_ready)
        assert session.softest is None
        prepared.set()
        until(lambda: session.softest == 1.0)
    finally:
        prepared.set()
        window.close()


def beside_a_floor() -> rj.Harness:
    cable, floor = rj.problems.cable(), rj.Plane((0, 0, -0.25), (0, 0, 1))
    ball, box = rj.Sphere((0.4, 0.0, 0.4), 0.1), rj.Box((1.2, 0.0, 0.4), (0.1, 0.1, 0.1))
    rods = {
        "left": rj.Scene(
            cable, rj.Clamp((0, 0, 0), LEVEL), rj.Joint("y", LEVEL), (0, 0, -9.81), obstacles=[floor, ball]
        ),
        "right": rj.Scene(
            cable, rj.Joint("y", LEVEL), rj.Clamp((1.6, 0, 0), LEVEL), (0, 0, -9.81), obstacles=[box, floor]
        ),
    }
    return rj.Harness(rods, {"y": rj.Body(support=rj.Pin((0.8, 0.0, 0.0)))})


def test_what_rods_of_a_harness_have_in_common_is_one_obstacle():
    assert shared_obstacles(beside_a_floor()) == {
        "left/obstacles[0]": ["left/obstacles[0]", "right/obstacles[1]"],
        "left/obstacles[1]": ["left/obstacles[1]"],
        "right/obstacles[0]": ["right/obstacles[0]"],
    }
    twice = hanging(obstacles=[rj.Sphere((0, 0, -1), 0.1), rj.Sphere((0, 0, -1), 0.1)])
    assert list(shared_obstacles(twice)) == ["obstacles[0]", "obstacles[1]"]  # both can be told apart by a hand


@pytest.mark.slow
def test_a_floor_under_a_harness_lifts_all_its_rods():
    session = Session(beside_a_floor(), segments=6)
    assert [name for name in session.handles if "obstacles" in name] == list(session.obstacles)
    low = [float(np.min(session.result[name].nodes[:, 2])) for name in session.result]
    radius = float(session.result["left"].scene.rod.radius)
    place = session.now.controls.poses["left/obstacles[0]"].position
    report = session.move({"left/obstacles[0]": (place + np.array([0, 0, 0.1]), None)})
    assert report.moved, report.message
    for name, before in zip(session.result, low, strict=True):
        found = session.result[name]
        assert before < -0.2
        assert float(np.min(found.nodes[:, 2])) == pytest.approx(-0.15 + radius, abs=1e-3)
        assert float(np.sum(found.contact_forces[:, 2])) > 0
    shown = {row.label: row for row in rows(session, report, rj.Limits(clearance=0.01))}
    for name in session.result:
        # Of ball, box and floor the floor is nearest, as it is touched.
        (row,) = (row for label, row in shown.items() if label.startswith(f"{name}: clearance, "))
        assert "pushed by" in row.text
        assert row.is_bad
    assert shown["stability"].text == "stable"  # by the index, until the softest motion is known
    assert session.settle() == pytest.approx(float(rj.lowest_mode(session.result).stiffness))
    session.undo()


@pytest.mark.slow
def test_a_saved_harness_has_the_turns_of_its_rods(tmp_path):
    """Two cables one above the other, which may touch: the end of one is wound up by one turn and a half."""
    cable = rj.Rod.circular(1.0, 5e-3, 1e7, poisson_ratio=0.5, density=1200.0)
    rods = {
        name: rj.Scene(cable, rj.Clamp((0, 0, z), LEVEL), rj.Clamp((0.95, 0, z), LEVEL), (0, 0, -9.81))
        for name, z in {"above": 0.3, "below": 0.0}.items()
    }
    session = Session(rj.Harness(rods, contact=True), segments=6)
    for k in range(1, 5):
        report = session.move({"above/end": ((0.95, 0.0, 0.3), turned(LEVEL, k * 3 * math.pi / 4))})
        assert report.moved, report.message
    content, remark = scene_file(session)
    assert remark == ""
    (tmp_path / "harness.toml").write_bytes(content)
    harness = read_scene(tmp_path / "harness.toml")
    assert isinstance(harness, rj.Harness)
    assert harness.contact_names == [("above", "below")]
    again = rj.solve(harness, segments=6)
    for name in harness:
        twist = float(session.result[name].total_twist)
        assert float(again[name].total_twist) == pytest.approx(twist, abs=1e-6)
    # The end has turned by 3 pi; what the curve writhes is not twist.
    assert float(again["above"].total_twist) == pytest.approx(3 * math.pi, abs=1.5)
    assert float(again["below"].total_twist) == pytest.approx(0.0, abs=1e-6)


# --- routes and tolerances -------------------------------------------------------------------------------------------


def test_rods_drawn_within_tolerances_are_steps():
    """A taut wire: each is pulled by EA (d/L - 1), with its own d and L."""
    rod = rj.Rod(1.0, 1.0, 1.0, 1e4, radius=0.01)
    wire = rj.solve(rj.Scene(rod, rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((1.01, 0, 0), LEVEL)), segments=8)
    given = [rj.Tolerance("end.position.0", 1e-3), rj.Tolerance("rod.length", 1e-3)]
    ball = rj.Sphere((0.5, 0.0, 0.1), 0.05)
    limits = rj.Limits(clearance=0.03, end_force=200.0)
    envelope = rj.tolerances(wire, given, limits=limits, obstacles=[ball], names=["the ball"], samples=0)
    session = session_of(envelope, None)
    assert session.segments == 8
    assert len(session.recorded) == DRAWN
    np.testing.assert_array_equal(session.result.nodes, wire.nodes)  # in the beginning it is as it should be
    scenes = [moment.result.scene for moment in session.recorded]
    stretches = np.array([float(scene.end.position[0] / scene.rod.length) for scene in scenes])
    np.testing.assert_array_equal([float(scene.rod.length) for scene in scenes], envelope.drawn(DRAWN).rod.length)
    forces = [moment.result.end_force[0] for moment in session.recorded]
    np.testing.assert_allclose(forces, 1e4 * (stretches - 1), rtol=1e-7)
    assert np.std(forces) > 10
    # Where the ball is 0.1 from the middle, with its radius and that of the wire taken off.
    assert session.figures[0].clearances[0] == pytest.approx(0.1 - 0.05 - 0.01, abs=1e-3)
    (row,) = [row for row in rows(session, session.move({}), limits) if row.label.startswith("clearance")]
    assert (row.label, row.is_bad) == ("clearance, the ball", False)
    session.show(session.recorded[3])
    assert session.move({"end": ((1.0, 0.0, 0.0), None)}).moved


@pytest.mark.slow
def test_the_designs_of_a_search_are_steps():
    """The last is the route, and the others are at rest where they were told to be."""
    rod = rj.Rod(0.3, 0.02, 0.015, 2e4, 0.15, 0.005)
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((0.2, 0, 0.2), rj.frame((0, 0, 1))))
    route = rj.route(
        scene,
        [
            rj.Between("end.position.0", 0.05, 0.25),
            rj.Between("end.position.2", 0.05, 0.25),
            rj.Between("rod.length", 0.1, 0.45),
        ],
        limits=rj.Limits(bend_radius=9.0, clearance=0.01),
        obstacles=[rj.Sphere((0.0, 1.0, 0.0), 0.05)],
        names=["the ball"],
        starts=2,
        segments=12,
    )
    session = session_of(route, None)
    assert 2 < len(session.recorded) <= len(route.designs.rod.length)
    ends = [moment.result.nodes[-1] for moment in session.recorded]
    np.testing.assert_allclose(ends, [moment.result.scene.end.position for moment in session.recorded], atol=1e-12)
    lengths = [float(moment.result.scene.rod.length) for moment in session.recorded]
    assert set(lengths) <= set(np.asarray(route.designs.rod.length).tolist())
    assert lengths[-1] == float(route.scene.rod.length)
    np.testing.assert_array_equal(session.result.nodes, route.equilibrium.nodes)
    assert list(session.beside) == ["the ball"]


# --- undo, record, save ----------------------------------------------------------------------------------------------


def test_undo_goes_back_to_where_the_hand_took_hold(session):
    session.mark()
    session.move({"end": ((0.75, 0.0, 0.0), None)})
    session.move({"end": ((0.7, 0.0, 0.0), None)})
    session.mark()
    session.move({"gravity": 0.5})
    session.undo()
    assert session.now.controls.numbers["gravity"] == 1.0
    np.testing.assert_allclose(session.result.nodes[-1], (0.7, 0, 0), atol=1e-12)
    session.undo()
    assert session.now is session.first
    assert session.undo().message == "there is nothing to undo"


def test_a_recording_is_a_path(session, tmp_path):
    with pytest.raises(ValueError, match="nothing is recorded yet"):
        session.recording()
    session.record(True)
    for x in (0.78, 0.76, 0.74):
        session.move({"end": ((x, 0.0, 0.0), None)})
    session.record(False)
    session.move({"end": ((0.72, 0.0, 0.0), None)})
    content, _ = path_file(session)
    (tmp_path / "path.vtkhdf").write_bytes(content)
    path = rj.load(tmp_path / "path.vtkhdf")
    assert isinstance(path, rj.Equilibrium)
    np.testing.assert_allclose(path.nodes[:, -1, 0], (0.8, 0.78, 0.76, 0.74), atol=1e-12)
    again = session_of(path, None)
    assert again.segments == SEGMENTS
    np.testing.assert_allclose(again.result.nodes[-1], (0.74, 0, 0), atol=1e-12)
    again.show(again.recorded[1])
    report = again.move({"end": ((0.77, 0.0, 0.0), None)})
    assert report.moved
    np.testing.assert_allclose(again.result.nodes[-1], (0.77, 0, 0), atol=1e-12)


def test_a_saved_scene_has_the_turns_of_the_rod(session, tmp_path):
    for k in range(1, 7):
        session.move({"end": ((0.8, 0.0, 0.1), turned(LEVEL, k * math.pi / 2))})
    content, remark = scene_file(session)
    assert remark == ""
    (tmp_path / "scene.toml").write_bytes(content)
    assert tomllib.loads(content.decode())["end"]["turns"] != 0
    scene = read_scene(tmp_path / "scene.toml")
    assert isinstance(scene, rj.Scene)
    again = rj.solve(scene, segments=SEGMENTS)
    assert float(again.total_twist) == pytest.approx(float(session.result.total_twist), abs=1e-6)


def test_the_file_of_a_shape_that_no_cold_solve_finds_says_so():
    """A strut bowed down by where it came from: from its supports alone a solve bows it up."""
    rod = rj.Rod(1.0, EI=1.0, GJ=1.0, EA=1e4)
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((0.8, 0, 0), LEVEL))
    nodes = np.asarray(rj.solve(scene, segments=SEGMENTS).nodes)
    other = rj.solve(scene, segments=SEGMENTS, guess=rj.Guess(nodes * [1, -1, -1]))
    _, remark = scene_file(session_of(other, None))
    assert remark == "solved by itself this scene ends in another shape than here"
    _, remark = scene_file(Session(scene, segments=SEGMENTS))
    assert remark == ""


# --- what is shown ---------------------------------------------------------------------------------------------------


def area_and_volume(faces: tube.Faces) -> tuple[np.ndarray, float]:
    """The sum of the directed areas, and the volume within by Gauss' theorem."""
    corners = faces.vertices.astype(float)[faces.faces]
    directed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(0)
    return directed, float(np.sum(np.linalg.det(corners)) / 6)


def test_meshes_are_closed_and_face_outwards():
    directed, volume = area_and_volume(tube.cylinder())
    around = tube.AROUND
    np.testing.assert_allclose(directed, 0, atol=1e-6)  # single precision
    assert volume == pytest.approx(around / 2 * math.sin(2 * math.pi / around), rel=1e-6)
    directed, volume = area_and_volume(tube.ball())
    np.testing.assert_allclose(directed, 0, atol=1e-6)
    assert 0.97 * 4 * math.pi / 3 < volume < 4 * math.pi / 3  # of 512 faces
    directed, _ = area_and_volume(tube.strip())
    assert directed[0] > 0
    np.testing.assert_allclose(directed[1:], 0, atol=1e-6)


def test_pieces_of_a_rod_join_and_carry_its_directors(session):
    """Their ends are the places of the reading, but for what they are longer so that nothing gapes: by the largest
    turn and the radius. Single precision keeps 1e-7.
    """
    reading, radius = session.reading, float(session.scene.rod.radius)
    pieces = reading.pieces
    x, y, z, w = np.moveaxis(pieces.wxyzs[:, [1, 2, 3, 0]].astype(float), 1, 0)
    frames = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    lengths = np.linalg.norm(np.diff(reading.centerline, axis=0), axis=1)
    low = pieces.positions - frames[:, :, 2] * lengths[:, None] / 2
    np.testing.assert_allclose(low, reading.centerline[:-1], atol=1e-6)
    assert np.all(pieces.scales[:, 2] >= lengths - 1e-7)
    turns = np.linalg.norm(np.diff(frames[:, :, 2], axis=0), axis=1)
    assert np.all(pieces.scales[:, 2] - lengths <= radius * turns.max() + 1e-6)
    np.testing.assert_allclose(pieces.scales[:, :2], radius, rtol=1e-6)
    middle = reading.d1[:-1] + reading.d1[1:]
    cosines = np.sum(frames[:, :, 0] * middle, axis=1) / np.linalg.norm(middle, axis=1)
    assert np.min(cosines) > 1 - 1e-4  # at right angles to the chord, not to the tangent
    opposite = Rotation.from_quat(np.roll(tube.half_turned(pieces.wxyzs), -1, axis=1)).as_matrix()
    np.testing.assert_allclose(opposite[:, :, 0], -frames[:, :, 0], atol=1e-6)
    np.testing.assert_allclose(opposite[:, :, 2], frames[:, :, 2], atol=1e-6)


def test_colors_are_those_of_the_bands_of_values(session):
    values = session.reading.values["curvature"]
    scale = tube.scale_over(float(values.min()), float(values.max()))
    assert tube.covers(scale, values)
    assert 4 <= len(scale.colors) <= tube.MOST_BANDS
    middles, colors = (values[1:] + values[:-1]) / 2, tube.colors_of(values, scale)
    for k, color in enumerate(scale.colors):
        inside = (scale.edges[k] <= middles) & (middles < scale.edges[k + 1])
        assert np.all(colors[inside] == color)


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.0), (3.0, 3.0), (-1e-12, 1e-12), (-5.0, 2e6)])
def test_a_scale_covers_its_range(low, high):
    scale = tube.scale_over(low, high)
    assert tube.covers(scale, np.array([low, high]))
    assert np.all(np.diff(scale.edges) > 0)


def test_numbers_stand_against_their_limits(session):
    limits = rj.Limits(bend_radius=20, end_force=0.1, twist=100)
    report = session.move({"end": ((0.6, 0.0, 0.0), None)})
    session.settle()
    found = {row.label: row for row in rows(session, report, limits)}
    radius = float(session.figures[0].bend_radius)
    assert radius == pytest.approx(1 / np.max(report.reading.values["curvature"]), rel=1e-2)  # at clamps, on one side
    assert found["smallest bend radius"].text == f"{1e3 * radius:.4g} mm of at least 205 mm"
    assert found["smallest bend radius"].is_bad  # less than 20 diameters inside: 41 radii of 5 mm
    assert found["force, end"].is_bad
    assert not found["twist rate"].is_bad
    assert found["state"].text == "at rest"
    stiffness = float(rj.lowest_mode(session.result).stiffness)
    assert found["softest motion"].text == f"{stiffness:.3g} N"


def test_a_rod_without_twist_is_told_so_without_roundings(session):
    found = {row.label: row.text for row in rows(session, session.move({}))}
    assert abs(float(session.result.total_twist)) < 1e-9
    assert found["total twist"] == "0.0°, 0.00 turns"
    assert found["twist rate"] == "0 rad/m"
    session.move({"end": ((0.8, 0.0, 0.0), turned(LEVEL, 0.5))})
    found = {row.label: row.text for row in rows(session, session.move({}))}
    twist = float(session.result.total_twist)
    assert found["total twist"] == f"{math.degrees(twist):.1f}°, {twist / (2 * math.pi):.2f} turns"


# --- the browser's side ----------------------------------------------------------------------------------------------


def test_of_moves_that_nobody_took_the_newest_counts():
    box, done = Mailbox(), []
    box.move("end", 1)
    box.move("start", 2)
    box.move("end", 3)
    box.command(lambda: done.append("undo"))
    box.move("end", 4)
    assert box.take(0.0) == {"end": 3, "start": 2}
    command = box.take(0.0)
    assert callable(command)
    command()
    assert done == ["undo"]
    assert box.take(0.0) == {"end": 4}
    assert box.is_empty
    assert box.take(0.0) is None
    taken = []
    waiting = threading.Thread(target=lambda: taken.append(box.take(None)))
    waiting.start()
    box.close()
    waiting.join(5.0)
    assert taken == [None]


def test_arguments_that_make_no_sense_are_refused():
    with pytest.raises(
        TypeError,
        match="shown must be a Scene or Harness or Equilibrium or HarnessEquilibrium or Route or Envelope, got 3",
    ):
        view(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="segments must be a whole number from 2"):
        Session(hanging(), segments=1)
    with pytest.raises(ValueError, match="scene must have an equilibrium to begin with, got none: not converged"):
        Session(hanging(obstacles=[WALL]), segments=SEGMENTS)


@pytest.mark.parametrize(("in_notebook", "expected"), [(False, (True, True)), (True, (False, False))])
def test_a_notebook_shows_the_window_below_the_cell(in_notebook, expected, monkeypatch):
    """It neither waits there nor opens another tab, unless it is told to."""
    asked = []
    monkeypatch.setattr("rodjax.window.opening.session_of", lambda shown, segments: None)
    monkeypatch.setattr("rodjax.window.opening.in_notebook", lambda: in_notebook)
    monkeypatch.setattr("rodjax.window.opening.show", lambda *arguments, **more: asked.append(arguments))
    view(hanging())
    view(hanging(), open_browser=True, block=False)
    assert [arguments[3:5] for arguments in asked] == [expected, (True, False)]


@pytest.fixture
def scene_toml(tmp_path):
    rj.write_scene(hanging(), tmp_path / "scene.toml", segments=SEGMENTS)
    return str(tmp_path / "scene.toml")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--port", "70000"], "argument --port: must be a whole number from 0 to 65535, got '70000'"),
        (["--port", "x"], "argument --port: must be a whole number from 0 to 65535, got 'x'"),
        (["--host", "no.such.host.invalid"], "port 8080 of no.such.host.invalid cannot be opened: "),
    ],
)
def test_the_command_says_what_is_wrong_in_one_line(options, said, scene_toml, capsys):
    pytest.importorskip("viser", reason="the window needs viser: pip install 'rodjax[view]'")
    assert main(["view", scene_toml, "--no-browser", *options]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"rodjax: {said}")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('support = "clamp"', 'support = "clam"', "start.support must be "),
        ("[rod]", "[rod", "is not valid TOML: "),
        ("[rod]", "[rob]", "rob is not allowed here"),
    ],
)
def test_a_malformed_scene_is_refused_in_one_line(old, new, said, scene_toml, capsys):
    content = Path(scene_toml).read_text()
    assert old in content
    Path(scene_toml).write_text(content.replace(old, new))
    assert main(["view", scene_toml, "--no-browser", "--port", "0"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"rodjax: {scene_toml}: ")
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have one address of their own only")
def test_only_this_machine_can_connect():
    """The server listens on 127.0.0.1 and on no other address, of which 127.0.0.2 stands for those of the network."""
    pytest.importorskip("viser", reason="the window needs viser: pip install 'rodjax[view]'")
    with contextlib.closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = started(port, inspect.signature(view).parameters["host"].default)
    try:
        socket.create_connection(("127.0.0.1", port), 10.0).close()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", port), 10.0)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


# Another page's origin; a name that somebody made lead to this machine; and what the window's own page sends.
@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("127.0.0.1:{}", None, 200),
        ("localhost:{}", "http://localhost:{}", 200),
        ("localhost:9000", "http://localhost:9000", 200),  # through a tunnel of ssh's
        ("127.0.0.1:{}", "http://127.0.0.1:1", 403),
        ("127.0.0.1:{}", "https://example.org", 403),
        ("127.0.0.1:{}", "null", 403),
        ("example.org:{}", None, 403),
        ("example.org:{}", "http://example.org:{}", 403),
    ],
)
def test_only_its_own_page_may_talk_to_the_window(host, origin, status, window_server):
    port = window_server.get_port()
    headers = {"Host": host.format(port)} | ({} if origin is None else {"Origin": origin.format(port)})
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Protocol": f"viser-v{importlib.metadata.version('viser')}",
    }
    for more, expected in (({}, status), (upgrade, 101 if status == 200 else status)):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", "/", headers=headers | more)
        assert connection.getresponse().status == expected
        connection.close()


@pytest.fixture(scope="module")
def window_server():
    pytest.importorskip("viser", reason="the window needs viser: pip install 'rodjax[view]'")
    server = started(0, "127.0.0.1")
    yield server
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@pytest.mark.parametrize(
    ("name", "host", "is_own"),
    [
        ("workstation:80", "0.0.0.0", True),
        ("workstation", "workstation", True),
        ("[::1]:8080", "::1", True),
        ("[::1", "::1", False),
        ("", "127.0.0.1", False),
        ("10.0.0.1", "localhost", False),
    ],
)
def test_names_of_a_window(name, host, is_own):
    assert origins.is_own({"Host": name}, host) is is_own


def test_a_port_that_is_taken_is_not_changed_for_another(scene_toml, capsys):
    pytest.importorskip("viser", reason="the window needs viser: pip install 'rodjax[view]'")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert main(["view", scene_toml, "--no-browser", "--port", str(port)]) == 2
    said = capsys.readouterr().err
    assert said == f"rodjax: port {port} of 127.0.0.1 cannot be opened: Address already in use\n"


def test_a_file_that_is_no_result_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "path.vtkhdf").write_text("nothing")
    assert main(["view", str(tmp_path / "path.vtkhdf")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("rodjax: ")
    assert "path.vtkhdf" in said
    assert said.count("\n") == 1


def test_without_viser_the_command_says_what_to_install(scene_toml, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", scene_toml]) == 2
    assert capsys.readouterr().err == "rodjax: view needs viser, got none: pip install 'rodjax[view]'\n"


def test_a_scene_without_an_equilibrium_exits_with_3(tmp_path, capsys):
    rj.write_scene(hanging(obstacles=[WALL]), tmp_path / "scene.toml", segments=SEGMENTS)
    assert main(["view", str(tmp_path / "scene.toml")]) == 3
    assert "scene must have an equilibrium to begin with, got none: not converged" in capsys.readouterr().err
