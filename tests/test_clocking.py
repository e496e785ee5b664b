"""Clamps of scene files: a clocking that is not stated is fitted without torsion or refused, and nothing depends on how
a scene lies in space.
"""

import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scenes import BRANCHES
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax.cli import main
from rodjax.identification.files import read_fit_files
from rodjax.io.harness_file import harness_file
from rodjax.io.scene_file import SceneFileError, SceneReader, read_scene_file
from rodjax.io.scene_keys import SceneVariations
from rodjax.io.scene_writing import write_scene
from rodjax.routing.files import read_route_file
from rodjax.sweeps.cases import CaseReader, SweepError

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

HOSE = dict(length="1 m", EI="4e-3 N m^2", GJ="3e-3 N m^2", EA="800 N", mass_per_length="0.1 kg/m", radius="8 mm")
STRIP = {key: value for key, value in HOSE.items() if key != "EI"} | dict(EI1="1e-3 N m^2", EI2="9e-3 N m^2")
MATERIAL = dict(youngs_modulus="10 MPa", poisson_ratio=0.4, density="1200 kg/m^3", length="1 m")
PAIR = MATERIAL | dict(section="bundle", wires=2, wire_radius="3 mm", stick=0.5)
CURVED = HOSE | dict(rest_curvature_1="1 1/m", rest_curvature_2="0 1/m")
START = dict(support="clamp", position="[0, 0, 0] m", tangent=[1, 0, 0.3])
END = dict(support="clamp", position="[0.7, 0.2, -0.1] m", tangent=[0.3, 1, 0])
LEVEL = dict(d2=[0, 1, 0.1])
FREE, PIN = dict(support="free"), dict(support="pin", position="[0.7, 0.2, -0.1] m")
GRAVITY = dict(gravity="[0, 1, -9.81] m/s^2")


def read(content):
    return SceneReader().read(content)


def scene(rod=HOSE, start=START, end=END, loads=GRAVITY, **others):
    return dict(rod=rod, start=start, end=end, loads=loads, **others)


# --- in any place of space -------------------------------------------------------------------------------------------

PLACES = ("position", "point", "points")
VECTORS = (*PLACES, "tangent", "d2", "force", "moment", "couple", "gravity", "normal", "axis", "directions")


def moved(value, turn, shift, key=""):
    """The tables of a scene, turned and shifted as a whole: vectors as they are written, with their units."""
    if isinstance(value, dict):
        if value.get("support") == "joint":  # in the axes of a body, whose pose is unknown
            return value
        # Loads that follow are along the frames of the rod.
        keep = ("force", "moment", "couple") if value.get("follower") else ()
        return {name: entry if name in keep else moved(entry, turn, shift, name) for name, entry in value.items()}
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [moved(entry, turn, shift, key) for entry in value]
    if key == "frame":
        return (turn @ np.array(value)).tolist()
    if key not in VECTORS:
        return value
    numbers, unit = (value, "") if isinstance(value, list) else value.rsplit("] ", 1)
    vectors = np.array(numbers if isinstance(numbers, list) else eval(f"{numbers}]"))
    vectors = vectors @ turn.T + (shift * {"m": 1, "cm": 100}[unit] if key in PLACES else 0)
    return f"{vectors.tolist()} {unit}" if unit else vectors.tolist()


FLOOR = dict(kind="plane", point="[0, 0, -0.2] m", normal=[0, 0.05, 1])
PIPE = dict(kind="pipe", points="[[0.4, -0.5, -0.15], [0.4, 0.1, -0.15], [0.5, 0.5, -0.15]] m", radius="0.03 m")
CLIPS = [
    dict(at="0.3 m", position="[0.25, 0.02, 0.03] m", tangent=[1, 0.1, 0]),
    dict(at="0.7 m", position="[0.5, 0.15, -0.05] m"),
]
HELD = [dict(at="0.5 m", position="[0.4, 0.05, 0] m", tangent=[1, 0.2, 0], d2=[0, 1, 0], spin="20 deg")]
POINTS = np.stack([np.sin(x := np.linspace(0, 1.2, 6)), 0.2 * x, 1 - np.cos(x)], axis=1).tolist()
CENTERLINE = dict(
    section="centerline", points=f"{POINTS} m", d2=[0, 1, 0], GJ="3e-3 N m^2", EA="800 N", EI="4e-3 N m^2"
)
FORCE = [dict(at="0.4 m", force="[0, 0.1, 0.2] N")]
SCENES = {
    "two clamps": scene(loads=GRAVITY | dict(point_force=FORCE)),
    "obstacles": scene(start=START | dict(tangent=[1, 0.2, 0]), obstacles=[FLOOR, PIPE]),
    "clips": scene(clips=CLIPS),
    "a clip with a frame": scene(clips=HELD),
    "one stated": scene(start=START | LEVEL),
    "moment on a free end": scene(
        end=FREE | dict(moment="[1e-3, 2e-3, 1e-3] N m", force="[0, 4e-3, 2e-3] N"), loads={}
    ),
    "couples on one clamp": scene(end=PIN, loads=GRAVITY | dict(distributed_couple=[dict(couple="[1e-3, 0, 1e-3] N")])),
    "loads within": scene(
        HOSE | dict(GA="300 N", rest_strain=0.01),
        START | LEVEL,
        END | dict(d2=[0, 0.2, 1]),
        loads=dict(
            point_force=[dict(at="0.4 m", force="[0, 0.1, 0.02] N", follower=True)],
            distributed_force=[dict(force="[0.1, 0, 0.3] N/m", part="[0.4, 0.7] m")],
            distributed_couple=[dict(couple="[1e-3, 0, 1e-3] N", part="[0.2, 0.7] m", follower=True)],
            point_couple=[dict(at="0.7 m", couple="[1e-3, 2e-3, 0] N m")],
        ),
    ),
    "followers on a free end": scene(
        start=START | LEVEL,
        end=FREE | dict(moment="[1e-3, 2e-3, 1e-3] N m", force="[0, 4e-3, 2e-3] N", follower=True),
    ),
    "sliding clips": scene(clips=[clip | dict(sliding=True) for clip in CLIPS]),
    "strip": scene(STRIP, START | LEVEL, END | dict(d2=[0, 0.2, 1])),
    "curved": scene(CENTERLINE, START | LEVEL, END | dict(d2=[0, 0.2, 1])),
}
# Those that share a program with no other are solved in the long run.
SLOW = (
    *("clips", "sliding clips", "a clip with a frame", "couples on one clamp", "moment on a free end"),
    *("followers on a free end", "curved", "one stated"),
)


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in SCENES])
def test_a_scene_turned_and_shifted_gives_the_same(name):
    """Energies, total twist and tension are the same numbers, forces and moments the same vectors turned back.

    To 1e-6 of their scale: solves end where the scaled gradient is below 1e-9, which curvatures of the energy along its
    softest motions, of some 1e-3, make of forces.
    """
    rng = np.random.default_rng(3)
    turns = [np.eye(3), *Rotation.random(3, rng).as_matrix(), Rotation.from_euler("z", 80, degrees=True).as_matrix()]
    shifts = [np.zeros(3), *rng.uniform(-1, 1, (4, 3))]
    scenes = [read(moved(SCENES[name], turn, shift)).scenes[0] for turn, shift in zip(turns, shifts, strict=True)]
    found = rj.solve_batch(scenes, segments=8)
    assert np.all(found.converged)
    # The height is that above the origin.
    np.testing.assert_allclose(found.elastic_energy, found.elastic_energy[:1].repeat(5), rtol=1e-6)
    np.testing.assert_allclose(found.total_twist, found.total_twist[:1].repeat(5), atol=1e-6)
    scale = np.max(np.abs(found.tension[0]))
    np.testing.assert_allclose(found.tension, found.tension[:1].repeat(5, axis=0), atol=1e-6 * scale)
    for key, size in (("start_force", scale), ("end_force", scale), ("start_moment", scale), ("end_moment", scale)):
        vectors = np.asarray(getattr(found, key))
        back = np.einsum("kji,kj->ki", np.stack(turns), vectors)
        np.testing.assert_allclose(back, vectors[:1].repeat(5, axis=0), atol=1e-6 * size, err_msg=key)


HINGE = dict(support="hinge", position="[0.7, 0.2, -0.1] m", tangent=[0.3, 1, 0], d2=[0, 0.2, 1], axis=[0, 0.2, 1])
SLIDER = dict(support="slider", position="[0.7, 0.2, -0.1] m", directions=[[0, 1, 0.2], [0, 0, 1]])
SOFT = END | dict(d2=[0, 0.2, 1], translation="2 N/m", rotation="1e-2 N m/rad")
MOVABLE = {
    "hinge": scene(start=START | LEVEL, end=HINGE),
    "slider": scene(start=START | LEVEL, end=SLIDER),
    "springs": scene(start=START | LEVEL, end=SOFT),
    "harness": tomllib.loads(BRANCHES),
}


@pytest.mark.parametrize("name", MOVABLE)
def test_ends_and_joints_of_unknown_pose_turn_with_the_scene(name):
    """To 1e-6 of their scale, as above."""
    rng = np.random.default_rng(4)
    turns, shifts = [np.eye(3), *Rotation.random(2, rng).as_matrix()], [np.zeros(3), *rng.uniform(-1, 1, (2, 3))]
    found = []
    for turn, shift in zip(turns, shifts, strict=True):
        content = moved(MOVABLE[name], turn, shift)
        assert isinstance(content, dict)
        if "cables" in content:
            result = rj.solve(harness_file(content).harness, segments=8)
            rods = [result[one] for one in result.names]
        else:
            result = rj.solve(read(content).scenes[0], segments=8)
            rods = [result]
        assert np.all(result.converged)
        nodes = np.concatenate([rod.nodes for rod in rods])
        forces = np.concatenate([[rod.start_force, rod.end_force] for rod in rods])
        found.append(((nodes - shift) @ turn, forces @ turn, sum(float(rod.elastic_energy) for rod in rods)))
    for nodes, forces, energy in found[1:]:
        np.testing.assert_allclose(nodes, found[0][0], atol=1e-6)
        np.testing.assert_allclose(forces, found[0][1], atol=1e-6 * np.max(np.abs(forces)))
        assert energy == pytest.approx(found[0][2], rel=1e-6)


def test_an_unstated_clocking_is_fitted_without_torsion():
    """The hose of the issue: it carried -38 to -115 degrees of twist, by how it lay about the vertical."""
    angles = np.radians([0, 30, 60, 80])
    scenes = [
        read(moved(SCENES["two clamps"], Rotation.from_euler("z", angle).as_matrix(), np.zeros(3))).scenes[0]
        for angle in [*angles, 0.5]
    ]
    assert all(isinstance(end, rj.Swivel) for scene in scenes for end in (scene.start, scene.end))
    found = rj.solve_batch(scenes, segments=8)
    assert np.all(found.converged)
    np.testing.assert_array_equal(np.asarray(found.twist), 0)
    along = np.sum(np.asarray(found.end_moment) * np.asarray(found.tangents[:, -1]), axis=1)
    np.testing.assert_allclose(along, 0, atol=1e-9)  # of bending moments of 0.01 N m, to the residual of a solve


# --- what it is read as ----------------------------------------------------------------------------------------------


def test_a_clamp_with_a_tangent_alone_is_a_swivel_in_energy():
    file = read(scene())
    start, end = file.scenes[0].start, file.scenes[0].end
    assert file.unclocked == ("start", "end")
    assert isinstance(start, rj.Swivel)
    assert isinstance(end, rj.Swivel)
    np.testing.assert_allclose(end.tangent, np.array([0.3, 1, 0]) / 1.09**0.5, rtol=1e-15)
    file = read(scene(start=START | LEVEL))
    assert file.unclocked == ("end",)
    assert isinstance(file.scenes[0].start, rj.Clamp)
    for tangent in ([0, 1, 0], [0, -2, 0], [1, 0, 0]):  # along whatever axis
        assert isinstance(read(scene(end=END | dict(tangent=tangent))).scenes[0].end, rj.Swivel)


@pytest.mark.parametrize("tangent", [[1, 0, 0.3], [0, 1, 0], [0, 0, -1]])
@pytest.mark.parametrize(
    "change",
    [
        dict(end=FREE | dict(moment="[1, 0, 0] N m")),
        dict(end=FREE | dict(force="[0, 0, -1] N", follower=True)),
        dict(end=PIN, loads=dict(distributed_couple=[dict(couple="[1, 0, 0] N")])),
        dict(end=FREE, loads=dict(distributed_force=[dict(force="[0, 0, 1] N/m", follower=True)])),
    ],
)
def test_a_single_clamp_resists_moments_about_its_tangent(tangent, change):
    held = read(scene(start=START | dict(tangent=tangent), **change)).scenes[0].start
    assert isinstance(held, rj.Clamp)
    np.testing.assert_allclose(held.tangent, np.array(tangent) / np.linalg.norm(tangent), rtol=1e-14)


PATH = dict(steps=4)
STATED = END | LEVEL
REFUSED = {
    "start.d2 or start.frame is needed for a clamp of a rod whose section or rest shape is not the same": [
        scene(STRIP), scene(CURVED), scene(STRIP, end=STATED), scene(CURVED, end=FREE), scene(STRIP, end=PIN),
        scene(PAIR), scene(CENTERLINE, end=STATED), scene(STRIP, clips=HELD),
    ],
    "end.d2 or end.frame is needed for a clamp of a rod whose": [
        scene(STRIP, start=FREE), scene(STRIP, start=START | LEVEL),
    ],
    "start.d2 or start.frame is needed for start.spin": [scene(start=START | dict(spin="0 deg"))],
    "end.d2 or end.frame is needed for end.spin": [scene(end=END | dict(spin="9 deg"))],
    "path[0].end.spin needs end.d2 or end.frame": [
        scene(path=[PATH | dict(end=dict(spin="9 deg"))]),
        scene(clips=HELD, path=[PATH | dict(end=dict(spin="9 deg"))]),
    ],
    "path[1].start.d2 needs start.d2 or start.frame": [
        scene(path=[PATH | dict(end=dict(tangent=[1, 0, 0])), PATH | dict(start=LEVEL)])
    ],
    "needed for a clamp where end.turns is given": [
        scene(end=END | dict(turns=1)), scene(end=STATED | dict(turns=1)),
        scene(start=START | LEVEL, end=END | dict(turns=0)),
    ],
    "needed for a clamp opposite to end.spin": [
        scene(end=STATED | dict(spin="9 deg")), scene(end=STATED, path=[PATH | dict(end=dict(spin="9 deg"))]),
    ],
    "needed for a clamp opposite to end.d2": [scene(end=STATED, path=[PATH | dict(end=dict(d2=[0, 1, 1]))])],
    "start.d2 or start.frame is needed for a clamp where loads follow the rod": [
        scene(end=FREE | dict(force="[1, 0, 0] N", follower=True)),
        scene(end=FREE | dict(moment="[0, 1, 0] N m", follower=True)),
        scene(loads=dict(distributed_force=[dict(force="[0, 1, 0] N/m", follower=True)])),
        scene(end=PIN, loads=dict(distributed_couple=[dict(couple="[0, 1, 0] N", follower=True)])),
        scene(end=FREE | dict(force="[0, 0, 1] N", follower=True), path=[PATH | dict(end=dict(force="[1, 0, 0] N"))]),
    ],
    "needed for a clamp where couples along the rod twist it": [
        scene(loads=dict(distributed_couple=[dict(couple="[1, 0, 0] N")])),
        scene(end=STATED, loads=dict(distributed_couple=[dict(couple="[1, 0, 0] N")])),
        scene(end=PIN, clips=HELD, loads=dict(distributed_couple=[dict(couple="[1, 0, 0] N")])),
    ],
    "needed for a clamp that resists a moment about its tangent and turns along the path": [
        scene(end=FREE | dict(moment="[1, 0, 0] N m"), path=[PATH | dict(start=dict(tangent=[1, 0, 0]))]),
    ],
    "clips[0].d2 or clips[0].frame is needed for clips[0].spin": [
        scene(clips=[CLIPS[0] | dict(spin="9 deg")]),
    ],
    "rod.d2 is missing": [
        scene({key: value for key, value in CENTERLINE.items() if key != "d2"}, START | LEVEL, STATED),
    ],
}  # fmt: skip


@pytest.mark.parametrize("said", REFUSED)
def test_a_clocking_that_counts_must_be_stated(said):
    for content in REFUSED[said]:
        with pytest.raises(SceneFileError, match=re.escape(said)) as caught:
            read(content)
        assert "\n" not in str(caught.value)


def test_what_does_not_count_need_not_be_stated():
    for content in (
        scene(end=STATED),
        scene(end=STATED | dict(spin="9 deg"), clips=HELD),  # which twists the part between the clip and the end
        scene(end=STATED, clips=HELD, path=[PATH | dict(end=dict(spin="9 deg"))]),
        scene(end=FREE | dict(force="[0, 0, -1] N")),
        scene(HOSE | dict(rest_twist="1 rad/m")),
        scene(HOSE | dict(EI=dict(jumps="[0.5] m", values="[1, 2] N mm^2"))),
        scene(PAIR | dict(wires=7), path=[PATH | dict(start=dict(tangent=[0, 1, 0]))]),
        scene(end=STATED, loads=dict(distributed_force=[dict(force="[0, 1, 0] N/m", follower=True)])),
        scene(loads=dict(distributed_force=[dict(force="[0, 1, 0] N/m")])),
    ):
        read(content)


# --- other files and the command -------------------------------------------------------------------------------------


def without_d2(path: Path) -> None:
    path.write_text(path.read_text().replace("d2 = [0, 1, 0]\n", ""))


def test_fits_and_routes_name_the_clamp_whose_frame_is_not_stated(tmp_path):
    fits, routes = (shutil.copytree(EXPERIMENTS / name, tmp_path / name) for name in ("fits", "routes"))
    fit, route = fits / "fit.toml", routes / "brake_line.toml"
    fit.write_text(
        fit.read_text().replace('"rod.EI"', '"start.frame.1"').replace('bounds = ["1e-4 N m^2", "0.1 N m^2"]', "")
    )
    route.write_text(route.read_text().replace('"clips.0.tangent"', '"end.frame"'))
    read_fit_files(fit, fits / "data.csv")
    read_route_file(route, for_route=True)
    without_d2(fits / "scene.toml")
    without_d2(routes / "scene.toml")
    with pytest.raises(SceneFileError, match=r"unknown\[0\]: start\.frame\.1 needs start\.d2 or start\.frame"):
        read_fit_files(fit, fits / "data.csv")
    with pytest.raises(SceneFileError, match=r"variables\[3\]: end\.frame needs end\.d2 or end\.frame"):
        read_route_file(route, for_route=True)


@pytest.mark.parametrize("key", ["end.spin", "end.turns", "end.d2.1", "end.frame.0.0"])
def test_sweeps_of_a_clocking_need_one(key, tmp_path):
    path = shutil.copy(EXPERIMENTS / "scenes" / "hanging_cable.toml", tmp_path)
    without_d2(Path(path))
    (tmp_path / "grid.toml").write_text(f'"{key}" = [0]')
    with pytest.raises(SweepError, match=r"needed for|is not there"):
        CaseReader(Path(path), tmp_path / "grid.toml")
    scenes = SceneVariations(scene(), ["end.d2"]).read({"end.d2": np.array([0.0, 0.0, 1.0])}).scenes
    assert isinstance(scenes[0].end, rj.Clamp)


def test_what_is_written_is_read_as_the_same(tmp_path):
    for content in SCENES.values():
        if content["rod"].get("section") == "centerline":
            continue
        written = read(content).scenes[0]
        write_scene(written, tmp_path / "scene.toml")
        again = read_scene_file(tmp_path / "scene.toml")
        assert again.unclocked == ()
        assert rj.Scene is type(again.scenes[0])
        assert (type(again.scenes[0].start), type(again.scenes[0].end)) == (type(written.start), type(written.end))


def test_the_command_says_what_was_fitted(tmp_path, capsys):
    path = Path(shutil.copy(EXPERIMENTS / "scenes" / "hanging_cable.toml", tmp_path))
    path.write_text(path.read_text().replace("segments = 50", "segments = 8"))
    without_d2(path)
    assert main(["solve", str(path)]) == 0
    assert "clamp fitted without torsion to clamp fitted without torsion, 1 m" in capsys.readouterr().out


def test_a_default_d2_is_not_spoken_of_as_given():
    with pytest.raises(
        ValueError, match=r"parallel to the tangent, as its default \(0, 1, 0\) is: give d2, got tangent"
    ):
        rj.frame((0, 1, 0))
    with pytest.raises(ValueError, match="d2 must not be parallel to the tangent, got d2 = "):
        rj.frame((0, 1, 0), (0.0, 2.0, 0.0))
    points = [(0, 0, 0), (0, 1, 0), (0, 2, 0), (0, 3, 0)]
    with pytest.raises(ValueError, match=r"parallel to the first tangent, as its default \(0, 1, 0\) is: give d2"):
        rj.Rod.from_centerline(points, 1.0, 1.0, 1.0)
