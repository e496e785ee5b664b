"""Scenes as TOML: the same numbers come back, paths are what they say, and each mistake is named in one line."""

import inspect
import math
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_scenes

import rodjax
from rodjax import (
    Box,
    Capsule,
    Clamp,
    Cylinder,
    DistributedCouple,
    DistributedForce,
    Free,
    Law,
    Pin,
    Pipe,
    Plane,
    PointForce,
    Rod,
    Scene,
    Smooth,
    Sphere,
    Steps,
    Swivel,
    Union,
    problems,
)
from rodjax.io import scene_file
from rodjax.io.harness_file import read_scene
from rodjax.io.scene_file import SceneFileError, read_scene_file
from rodjax.io.scene_writing import write_scene

SCENES = Path(__file__).parents[1] / "experiments" / "scenes"

ROD = """
[rod]
length = "1 m"
EI = "4.9e-3 N m^2"
GJ = "3.3e-3 N m^2"
EA = "785 N"
"""
START = """
[start]
support = "clamp"
position = "[0, 0, 0] m"
tangent = [1, 0, 0]
d2 = [0, 1, 0]
"""
D2 = "d2 = [0, 1, 0]\n"
TANGENT = "tangent = [1, 0, 0]\nd2 = [0, 1, 0]"
END = """
[end]
support = "clamp"
position = "[0.8, 0, 0] m"
tangent = [1, 0, 0]
d2 = [0, 1, 0]
"""
FREE = """
[end]
support = "free"
"""


@pytest.fixture
def read(tmp_path):
    """Reads a scene from the text of a file."""

    def read(text):
        path = tmp_path / "scene.toml"
        path.write_text(text, encoding="utf-8")
        return read_scene_file(path)

    return read


def assert_same(scene, expected, atol=0.0):
    assert jax.tree.structure(scene) == jax.tree.structure(expected)
    for value, other in zip(jax.tree.leaves(scene), jax.tree.leaves(expected), strict=True):
        assert value.dtype == other.dtype
        np.testing.assert_allclose(value, other, rtol=0, atol=atol)


def awkward(size, seed=0):
    """Numbers that use all their digits."""
    return np.random.default_rng(seed).normal(size=size)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("ends", ["clamps", "swivels", "pins", "free end", "free start"])
def test_write_and_read_give_the_same_numbers_to_the_last_bit(ends, seed, tmp_path):
    rod = Rod(1 / 3, *np.abs(awkward(3, seed)) * [1e-3, 1e-5, 1e6], mass_per_length=0.1, radius=1 / 300)
    x, y, t, v = awkward((4, 3), seed) / 10
    clamp = Clamp(x / 10, rodjax.frame(t, v))
    start, end = {
        "clamps": (clamp, Clamp(y / 10, rodjax.frame(v, t))),
        "swivels": (Swivel(x / 10, t), Swivel(y / 10, v)),
        "pins": (Pin(x / 10), Pin(y / 10)),
        "free end": (clamp, Free(v, t)),
        "free start": (Free(), clamp),
    }[ends]
    turns = -2 if ends == "clamps" else None
    forces = [PointForce(0.1, v), PointForce(0.2, t)]
    path = tmp_path / "scene.toml"
    for scene in (Scene(rod, start, end, 9.81 * t, forces, turns), Scene(rod, start, end)):
        write_scene(scene, path, segments=30)
        assert_same(read_scene(path), scene)
        assert read_scene_file(path).segments == 30
    assert [file.name for file in tmp_path.iterdir()] == ["scene.toml"]


def general_rods(seed):
    """Rods of every kind of stiffness and rest shape, of numbers that use all their digits."""
    a, b, c, d = np.abs(awkward((4, 3), seed)) + 0.1
    steps, other = Steps((0.1, 1 / 7), a / 100), Steps([0.2], b[:2])
    smooth, rest = Smooth((0, 0.1, 1 / 3), c / 100), Smooth((0, 1 / 3), awkward(2, seed))
    return {
        "pair": Rod(1 / 3, (a[0], b[0]), c[0], d[0], radius=0.01),
        "rest shape": Rod(1 / 3, a[0], b[0], c[0], rest_curvature=awkward(2, seed), rest_twist=-d[0]),
        "steps": Rod(1 / 3, steps, other, other, steps, steps),
        "smooth": Rod(1 / 3, smooth, 0.3 * b[0], smooth, smooth, smooth, rest_curvature=(rest, 0.0), rest_twist=rest),
        "both": Rod(1 / 3, (steps, smooth), other, c[0], rest_curvature=(other, rest), rest_twist=other),
        "one of a pair": Rod(1 / 3, (a[0], steps), b[0], c[0]),
    }


def test_obstacles_come_back_to_the_last_bit(tmp_path):
    path, rod = tmp_path / "scene.toml", problems.cable()
    x, y, z = np.abs(awkward((3, 3))) / 10
    bodies = [
        Plane(-x, z),
        Sphere(-y, z[0]),
        Capsule(-x, -y, z[1]),
        Pipe([-x, -y, -z], z[2]),
        Cylinder(-y, -z, x[0]),
        Box(-x, y),
        Box(-z, x, rodjax.frame(x, y)),
    ]
    clamp = Clamp((0, 0, 0), np.eye(3))
    scene = Scene(rod, clamp, Free(), (0, 0, -9.81), obstacles=[*bodies, Union(bodies[0], Union(*bodies[1:]))])
    write_scene(scene, path)
    assert_same(read_scene(path), scene)


@pytest.mark.parametrize("seed", range(2))
def test_general_rods_come_back_to_the_last_bit(seed, tmp_path):
    path = tmp_path / "scene.toml"
    for rod in general_rods(seed).values():
        scene = Scene(rod, Clamp((0, 0, 0), np.eye(3)), Free())
        write_scene(scene, path)
        assert_same(read_scene(path), scene)


def test_loads_that_follow_come_back_to_the_last_bit(tmp_path):
    rod, path = problems.cable(), tmp_path / "scene.toml"
    x, y, z = awkward((3, 3))
    clamp = Clamp((0, 0, 0), np.eye(3))
    for follower in (True, False):
        loads = [DistributedCouple(x), DistributedCouple(y, follower), DistributedForce(z, follower)]
        scene = Scene(rod, clamp, Free(x, y, follower), distributed=loads)
        write_scene(scene, path)
        assert_same(read_scene(path), scene)
        scene = Scene(rod, Free(None, y, follower), clamp, distributed=loads[::-1])
        write_scene(scene, path)
        assert_same(read_scene(path), scene)


def test_random_scenes_of_every_class_come_back_to_the_last_bit(tmp_path):
    path, rng = tmp_path / "scene.toml", np.random.default_rng(2)
    for _ in range(40):
        scene = random_scenes.scene(rng, for_text=True)
        write_scene(scene, path)
        assert_same(read_scene(path), scene)


class Cubic(Law):
    """A law without numbers."""

    def __call__(self, curvature, twist, axial_strain, s):
        return jnp.sum(jnp.abs(curvature) ** 3)


def test_write_refuses_rods_that_a_file_cannot_hold(tmp_path):
    points = [(0, 0, 0), (0.1, 0, 0), (0.2, 0.1, 0), (0.3, 0.1, 0)]
    for rod, message in (
        (Rod(1.0, 1e-3, 1e-3, 1.0, law=Cubic()), r"scene\.rod\.law must be None .* a law is code"),
        (Rod.from_centerline(points, 1e-3, 1e-3, 1.0), r"scene\.rod must not be one of Rod\.from_centerline"),
    ):
        with pytest.raises(ValueError, match=message):
            write_scene(Scene(rod, Clamp((0, 0, 0), np.eye(3)), Free()), tmp_path / "scene.toml")
    assert not list(tmp_path.iterdir())


def test_write_refuses_what_is_not_one_scene(tmp_path):
    scene = problems.hanging_cable()
    stack = jax.tree.map(lambda leaf: leaf[None], scene)
    path = tmp_path / "scene.toml"
    with pytest.raises(ValueError, match="single scene"):
        write_scene(stack, path)
    with pytest.raises(TypeError, match="must be a Scene"):
        write_scene([scene], path)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="segments must be a whole number from 2"):
        write_scene(scene, path, segments=1)
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda scene: write_scene(scene, path))(scene)
    with pytest.raises(OSError, match="missing"):
        write_scene(scene, tmp_path / "missing" / "scene.toml")
    assert not path.exists()


def test_the_example_in_the_documentation_is_a_path_with_all_it_names(read):
    text = inspect.getdoc(scene_file)
    assert text
    example = "\n".join(line[4:] for line in text.splitlines() if line.startswith("    "))
    assert {"rod", "start", "end", "loads", "solve", "path"} == set(tomllib.loads(example))
    file = read(example)
    assert len(file.scenes) == 29
    assert (file.segments, file.rtol, file.discretization) == (None, 1e-3, "hermite")
    np.testing.assert_allclose(file.scenes[10].end.position, [0.5, 0, 0], atol=1e-15)


def test_hanging_cable_is_the_benchmark_problem():
    scene = read_scene(SCENES / "hanging_cable.toml")
    assert isinstance(scene, Scene)
    assert_same(scene, problems.hanging_cable(), atol=1e-9)
    np.testing.assert_allclose(scene.rod.GJ, problems.cable().GJ, rtol=1e-14)


def test_figure_1_is_the_benchmark_problem_after_the_circle_segment():
    scenes = read_scene(SCENES / "figure_1.toml")
    assert isinstance(scenes, list)
    expected = [problems.omega(problems.ARC_HALF_ANGLE, 0.0), *problems.figure_1()]
    assert len(scenes) == len(expected) == 26
    for scene, other in zip(scenes, expected, strict=True):
        assert_same(scene, other, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('length = "100 cm"', 1.0),
        ('length = "1e3mm"', 1.0),
        ('length = " .5  m "', 0.5),
        ('length = "+2 inch"', 0.0508),
        ("length = '1000000 µm'", 1.0),
    ],
)
def test_units(line, expected, read):
    file = read(ROD.replace('length = "1 m"', line) + START + FREE)
    np.testing.assert_allclose(file.scenes[0].rod.length, expected, rtol=1e-15)


def test_sections_are_those_of_rod(read):
    ends = START + FREE
    tube = read(
        '[rod]\nsection = "tube"\nlength = "1 m"\nouter_radius = "6 mm"\ninner_radius = "4 mm"\n'
        'youngs_modulus = "10 N/mm^2"\npoisson_ratio = 0.5\n' + ends
    ).scenes[0]
    expected = Rod.tube(1.0, 0.006, 0.004, 1e7, poisson_ratio=0.5)
    assert_same(tube.rod, expected)


MATERIAL = 'youngs_modulus = "10 MPa"\npoisson_ratio = 0.4\ndensity = "1200 kg/m^3"\n'
POINTS = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.01), (0.2, 0.02, 0.0), (0.3, 0.1, 0.0), (0.4, 0.2, 0.0)]
STIFF = 'GJ = "3 N mm^2"\nEA = "785 N"\n'


@pytest.mark.parametrize(
    ("table", "make"),
    [
        (
            f'section = "rectangular"\nlength = "1 m"\nwidth = "10 mm"\nheight = "1 mm"\n{MATERIAL}'
            'rest_curvature_1 = "2 1/m"\nrest_curvature_2 = "1e-2 1/cm"\n'
            'rest_twist = { jumps = "[50] cm", values = "[0, 90] deg/m" }',
            lambda: Rod.rectangular(
                1.0, 0.01, 0.001, 1e7, None, 0.4, 1200, (2.0, 1.0), Steps([0.5], [0.0, math.pi / 2])
            ),
        ),
        (
            f'section = "bundle"\nlength = "1 m"\nwires = 7\nwire_radius = "0.5 mm"\nstick = 0.2\n{MATERIAL}',
            lambda: Rod.bundle(1.0, 7, 5e-4, 1e7, None, 0.4, 1200, stick=0.2),
        ),
        (
            'section = "layered"\nlength = "1 m"\nradii = "[0, 2, 3] mm"\nyoungs_moduli = "[1, 50] MPa"\n'
            'shear_moduli = "[0.4, 20] MPa"\ndensities = "[1100, 1200] kg/m^3"',
            lambda: Rod.layered(1.0, [0, 0.002, 0.003], [1e6, 5e7], [4e5, 2e7], None, [1100, 1200]),
        ),
        (
            'section = "layered"\nlength = "1 m"\nradii = "[1, 3] mm"\nyoungs_moduli = "[1] MPa"\n'
            "poisson_ratios = [0.4]",
            lambda: Rod.layered(1.0, [0.001, 0.003], [1e6], poisson_ratios=[0.4]),
        ),
        (
            f'section = "centerline"\npoints = "{[list(point) for point in POINTS]} m"\nEI1 = "4 N mm^2"\n'
            f'EI2 = {{ jumps = "[0.1] m", values = "[2, 3] N mm^2" }}\n{STIFF}'
            'mass_per_length = "10 g/m"\nradius = { jumps = "[10] cm", values = "[2, 3] mm" }\nd2 = [0, 1, 1]',
            lambda: Rod.from_centerline(
                POINTS,
                (4e-6, Steps([0.1], [2e-6, 3e-6])),
                *(3e-6, 785, 0.01),
                Steps([0.1], [0.002, 0.003]),
                d2=(0, 1, 1),
            ),
        ),
        (
            'length = "1 m"\nEI = { s = "[0, 0.5, 1] m", values = "[1, 3, 4] N mm^2" }\n'
            'mass_per_length = { s = "[0, 100] cm", values = "[0.1, 0.2] kg/m" }\n' + STIFF,
            lambda: Rod(1.0, Smooth([0, 0.5, 1], [1e-6, 3e-6, 4e-6]), 3e-6, 785, Smooth([0, 1], [0.1, 0.2])),
        ),
        (
            f'length = "1 m"\nEI1 = "1 N mm^2"\nEI2 = "2 N mm^2"\nrest_twist = "1 rad/m"\n{STIFF}',
            lambda: Rod(1.0, (1e-6, 2e-6), 3e-6, 785, rest_twist=1.0),
        ),
    ],
    ids=["rectangular", "bundle", "layered", "one layer", "centerline", "smooth", "pair"],
)
def test_general_rods_are_read(table, make, read):
    rod, expected = read(f"[rod]\n{table}\n{START}{FREE}").scenes[0].rod, make()
    assert jax.tree.structure(rod) == jax.tree.structure(expected)
    for value, other in zip(jax.tree.leaves(rod), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(value, other, rtol=1e-13, atol=1e-13)


def test_loads_along_the_rod_and_followers_are_read(read):
    scene = read(
        ROD + START + FREE + 'force = "[0, 0, 1] N"\nfollower = true\n'
        '[[loads.distributed_couple]]\ncouple = "[0, 1, 0] N cm/cm"\n'
        '[[loads.distributed_force]]\nforce = "[0, 0, 2] mN/mm"\nfollower = true\n'
        '[[loads.distributed_force]]\nforce = "[1, 0, 0] N/m"\nfollower = false\n'
    ).scenes[0]
    assert scene.end.follower
    couple, force, dead = scene.distributed
    assert isinstance(couple, DistributedCouple)
    assert isinstance(force, DistributedForce)
    assert [load.follower for load in scene.distributed] == [False, True, False]
    np.testing.assert_allclose(couple.couple, [0, 1, 0], rtol=1e-14)
    np.testing.assert_allclose(force.force, [0, 0, 2], rtol=1e-14)
    np.testing.assert_array_equal(dead.force, [1, 0, 0])


def test_a_follower_stays_one_along_a_path(read):
    path = '\n[[path]]\nsteps = 2\nend.force = "[0, 0, 1] N"\n'
    scenes = read(ROD + START + FREE + "follower = true\n" + path).scenes
    assert [scene.end.follower for scene in scenes] == [True] * 3
    np.testing.assert_array_equal([scene.end.force[2] for scene in scenes], [0, 0.5, 1])


def test_spin_turns_the_frame_about_its_tangent(read):
    scene = read(ROD + START + END.replace("[1, 0, 0]", '[0, 0, 2]\nspin = "90 deg"')).scenes[0]
    np.testing.assert_allclose(scene.end.frame, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


def test_a_path_goes_linearly_and_tangents_along_great_circles(read):
    path = """
[[path]]
steps = 3
start.tangent = [0, 0, 5]
end.moment = "[0, 3, 0] N mm"
loads.gravity = "[0, 0, -9] m/s^2"
[[path]]
end.force = "[0, 0, -2] N"
start.spin = "10 deg"
start.position = "[0, 0, 1] m"
"""
    scenes = read(ROD + START + FREE + path).scenes
    assert len(scenes) == 5
    # What is absent at first and then grows is zero at first, so that the scenes have one structure.
    assert len({str(jax.tree.structure(scene)) for scene in scenes}) == 1
    np.testing.assert_array_equal([scene.gravity[2] for scene in scenes], [0, -3, -6, -9, -9])
    np.testing.assert_allclose([scene.end.moment[1] for scene in scenes], np.array([0, 1, 2, 3, 3]) / 1e3, atol=1e-18)
    np.testing.assert_array_equal([scene.end.force[2] for scene in scenes], [0, 0, 0, 0, -2])
    np.testing.assert_array_equal([scene.start.position[2] for scene in scenes], [0, 0, 0, 0, 1])
    angle = np.radians([0, 30, 60, 90, 90])
    tangents = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    np.testing.assert_allclose([scene.start.tangent for scene in scenes], tangents, atol=1e-15)
    d2 = [[0, 1, 0]] * 4 + [[-math.sin(math.radians(10)), math.cos(math.radians(10)), 0]]
    # At tangent e_z: d1 = d2 x t = e_x, and d2 turns from e_y towards -d1.
    np.testing.assert_allclose([scene.start.frame[:, 1] for scene in scenes], d2, atol=1e-15)


def test_d2_is_made_orthogonal_again_along_a_path(read):
    tilted = START.replace("d2 = [0, 1, 0]", "d2 = [1, 1, 0]")
    path = "\n[[path]]\nsteps = 4\nstart.tangent = [0, 0, 1]\nstart.d2 = [0, 1, 1]\n"
    for scene in read(ROD + tilted + FREE + path).scenes:
        np.testing.assert_allclose(scene.start.frame.T @ scene.start.frame, np.eye(3), atol=1e-14)


def test_a_clamp_with_a_frame_may_move_and_spin(read):
    framed = START.replace("tangent = [1, 0, 0]\nd2 = [0, 1, 0]", "frame = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]")
    path = '\n[[path]]\nsteps = 2\nstart.spin = "180 deg"\n'
    scenes = read(ROD + framed + FREE + path).scenes
    np.testing.assert_allclose(scenes[2].start.frame, [[0, 0, 1], [0, -1, 0], [1, 0, 0]], atol=1e-15)


FLOOR = """
[[obstacles]]
kind = "plane"
point = "[0, 0, -1] m"
normal = [0, 0, 1]
"""
CLIP = """
[[clips]]
at = "0.5 m"
position = "[0.4, 0, 0] m"
tangent = [1, 0, 0]
"""
FINITE = '[solve]\ndiscretization = "finite_difference"\n'
THICK = ROD + 'radius = "5 mm"\n'
MISTAKES = [
    # syntax and tables
    ("[rod\n", "is not valid TOML", "line 1"),
    (START + END, "rod is missing", "[rod]"),
    ("rod = 5\n" + START + END, "rod must be a table", "[rod]"),
    (
        ROD + "color = 1\n" + START + END,
        "rod.color is not allowed",
        "length, GJ, EA, EI, EI1, EI2, GA, GA1, GA2, mass_per_length, radius, rest_curvature_1",
    ),
    (
        ROD + START + END + "[cable]\n",
        "cable is not allowed",
        "rod, start, end, loads, clips, obstacles, self_contact, solve, path",
    ),
    (ROD + START + END + "path = 1\n", "end.path is not allowed", "position, frame, tangent, d2, spin"),
    ("path = 1\n" + ROD + START + END, "path must be a list of tables", "[[path]]"),
    ("path = [1]\n" + ROD + START + END, "path[0] must be a table", "got 1"),
    # the rod
    (ROD.replace('"1 m"', "5") + START + END, "rod.length must have a unit", 'length = "1 m"'),
    (ROD.replace('"1 m"', '"5"') + START + END, "rod.length must have a unit", 'length = "1 m"'),
    (ROD.replace('"1 m"', '"5 kg"') + START + END, "rod.length must be in m", "'kg'"),
    (ROD.replace('"1 m"', '"5 (m"') + START + END, "rod.length must be in m", "'(m'"),
    (ROD.replace('"1 m"', '"5 yards of it"') + START + END, "rod.length must be in m", 'length = "1 m"'),
    (ROD.replace('"1 m"', '"long"') + START + END, "rod.length must be a number and a unit", 'length = "1 m"'),
    (ROD.replace('"1 m"', '"[1, 2] m"') + START + END, "rod.length must be a number and a unit", 'length = "1 m"'),
    (ROD.replace('"1 m"', "true") + START + END, "rod.length must have a unit", 'length = "1 m"'),
    (ROD.replace('"1 m"', '"-5 mm"') + START + END, "rod.length must be positive", "-0.005"),
    (ROD.replace('"1 m"', '"nan m"') + START + END, "rod.length must be finite", "nan m"),
    (ROD.replace('"785 N"', '"inf N"') + START + END, "rod.EA must be finite", "inf N"),
    (ROD.replace('"785 N"', '"1e999 N"') + START + END, "rod.EA must be finite", "1e999"),
    (ROD.replace('EA = "785 N"', "") + START + END, "rod.EA is missing", 'EA = "785 N"'),
    ('[rod]\nsection = "square"\n' + START + END, "rod.section must be one of", "circular, tube"),
    ('[rod]\nsection = ["tube"]\n' + START + END, "rod.section must be one of", "circular, tube"),
    (
        '[rod]\nsection = "circular"\nlength = "1 m"\nradius = "5 mm"\nyoungs_modulus = "1 MPa"\n' + START + END,
        "rod: exactly one of",
        "shear_modulus and poisson_ratio",
    ),
    (
        '[rod]\nsection = "circular"\nlength = "1 m"\nradius = "5 mm"\nyoungs_modulus = "1 MPa"\n'
        'poisson_ratio = "0.5"\n' + START + END,
        "rod.poisson_ratio must be a number without quotes",
        "poisson_ratio = 0.5",
    ),
    (
        '[rod]\nsection = "tube"\nlength = "1 m"\nouter_radius = "4 mm"\ninner_radius = "5 mm"\n'
        'youngs_modulus = "1 MPa"\npoisson_ratio = 0.5\n' + START + END,
        "rod.outer_radius - inner_radius must be positive",
        "got -0.001",
    ),
    (
        '[rod]\nsection = "circular"\nlength = "1 m"\nradius = { jumps = "[0.5] m", values = "[1, 2] mm" }\n'
        'youngs_modulus = "1 MPa"\npoisson_ratio = 0.5\n' + START + END,
        "rod.radius must have a unit",
        'radius = "5 mm"',
    ),
    # rods that vary, of two stiffnesses, with a rest shape
    (ROD.replace('EI = "4.9e-3 N m^2"', "") + START + END, "rod.EI is missing", "rod.EI1 and rod.EI2"),
    (ROD + 'EI1 = "1 N m^2"\n' + START + END, "rod.EI is not allowed together with", "rod.EI1 and rod.EI2"),
    (ROD.replace("EI", "EI1") + START + END, "rod.EI1 and rod.EI2 must be given both or neither", "only one"),
    (ROD + 'rest_curvature_2 = "1 1/m"\n' + START + END, "rod.rest_curvature_2 must be given both", "rest_curvature_1"),
    (ROD + "rest_twist = 1\n" + START + END, "rod.rest_twist must have a unit", '"0.5 rad/m"'),
    (ROD + 'rest_twist = "1 m"\n' + START + END, "rod.rest_twist must be in rad/m", "'m'"),
    (
        ROD.replace("EI", "EI1") + 'EI2 = "-1 N m^2"\n' + START + END,
        "rod.EI2 must be positive",
        "got -1",
    ),
    (
        ROD.replace('"4.9e-3 N m^2"', '{ jumps = "[0.5] m" }') + START + END,
        "rod.EI must be a number and a unit, or a table of jumps and values, or of s and values",
        "[1, 4] N m^2",
    ),
    (ROD.replace('"785 N"', "{ EA = 1 }") + START + END, "rod.EA must be a number and a unit, or a table", "{'EA': 1}"),
    (ROD.replace('"1 m"', '{ s = "[0] m" }') + START + END, "rod.length must have a unit", 'length = "1 m"'),
    (
        ROD.replace('"785 N"', '{ jumps = "0.5 m", values = "[1, 4] N" }') + START + END,
        "rod.EA.jumps must be a list of numbers and a unit",
        'jumps = "[0.5] m"',
    ),
    (
        ROD.replace('"785 N"', '{ jumps = "[0.5] m", values = "[1, 4] m" }') + START + END,
        "rod.EA.values must be in N",
        'values = "[1, 4] N"',
    ),
    (
        ROD.replace('"785 N"', '{ jumps = "[0.5] m", values = "[1] N" }') + START + END,
        "rod.EA.values must be one more than jumps",
        "1 values and 1 jumps",
    ),
    (
        ROD.replace('"785 N"', '{ jumps = "[1.5] m", values = "[1, 4] N" }') + START + END,
        "rod.EA.jumps must lie inside 0 to 1 m",
        "1.5",
    ),
    (
        ROD.replace('"785 N"', '{ s = "[0, 0.5] m", values = "[1, 4] N" }') + START + END,
        "rod.EA.s must run from 0 to 1 m",
        "0 to 0.5",
    ),
    (
        ROD.replace('"785 N"', '{ jumps = "[0.5] m", values = "[1, -4] N" }') + START + END,
        "rod.EA must be positive",
        "got -4",
    ),
    (
        ROD.replace('"785 N"', '{ s = "[0, 0.5, 1] m", values = "[1, 4] N" }') + START + END,
        "rod.EA.values must be as many as s",
        "2 values at 3 arclengths",
    ),
    (
        ROD.replace('"785 N"', '{ jumps = "[0.5, 0.4] m", values = "[1, 4, 2] N" }') + START + END,
        "rod.EA.jumps must increase",
        "[0.5, 0.4]",
    ),
    (
        ROD.replace('"785 N"', '{ jumps = "[0.5] m", s = "[0, 1] m", values = "[1, 4] N" }') + START + END,
        "rod.EA must be a number and a unit, or a table of jumps and values, or of s and values",
        "'s': '[0, 1] m'",
    ),
    (
        ROD + 'radius = { jumps = "[0.5] m", values = "[1, 2, 3] mm" }\n' + START + END,
        "rod.radius.values must be one more than jumps",
        "3 values and 1 jumps",
    ),
    (
        ROD + 'radius = { s = "[0, 0.5, 1] m", values = "[1, -1, 1] mm" }\n' + START + END,
        "rod.radius must be positive",
        "got -0.001",
    ),
    (
        ROD
        + 'rest_curvature_1 = { jumps = "[2] m", values = "[1, 2] 1/m" }\nrest_curvature_2 = "0 1/m"\n'
        + START
        + END,
        "rod.rest_curvature_1.jumps must lie inside 0 to 1 m",
        "[2.0]",
    ),
    # sections
    (
        '[rod]\nsection = "rectangular"\nlength = "1 m"\nwidth = "10 mm"\n' + MATERIAL + START + END,
        "rod.height is missing",
        'height = "1 mm"',
    ),
    (
        '[rod]\nsection = "rectangular"\nlength = "1 m"\nradius = "5 mm"\n' + MATERIAL + START + END,
        "rod.radius is not allowed",
        "length, width, height, youngs_modulus",
    ),
    (
        '[rod]\nsection = "circular"\nlength = "1 m"\nradius = "5 mm"\nrest_twist = "1 rad/m"\n'
        + MATERIAL
        + START
        + END,
        "rod.rest_twist is not allowed",
        "length, radius, youngs_modulus",
    ),
    (
        '[rod]\nsection = "centerline"\npoints = "[0, 1, 2, 3] m"\nEI = "1 N m^2"\nd2 = [0, 1, 0]\n'
        + STIFF
        + START
        + END,
        "rod.points must be a list of lists of 3 numbers and a unit",
        "[0, 0, 0]",
    ),
    (
        '[rod]\nsection = "bundle"\nlength = "1 m"\nwires = 7.5\nwire_radius = "1 mm"\nstick = 0\n'
        + MATERIAL
        + START
        + END,
        "rod.wires must be a whole number",
        "got 7.5",
    ),
    (
        '[rod]\nsection = "bundle"\nlength = "1 m"\nwires = 7\nwire_radius = "1 mm"\n' + MATERIAL + START + END,
        "rod.stick is missing",
        "stick = 0.2",
    ),
    (
        '[rod]\nsection = "layered"\nlength = "1 m"\nradii = "[0, 1] mm"\nyoungs_moduli = "[1] MPa"\n' + START + END,
        "rod.shear_moduli or rod.poisson_ratios is needed",
        "exactly one",
    ),
    (
        '[rod]\nsection = "layered"\nlength = "1 m"\nradii = "[] mm"\nyoungs_moduli = "[1] MPa"\n' + START + END,
        "rod.radii must be a list of numbers and a unit",
        "[0, 2, 3] mm",
    ),
    (
        '[rod]\nsection = "layered"\nlength = "1 m"\nradii = "[0, 1] mm"\nyoungs_moduli = "[1, 2] MPa"\n'
        "poisson_ratios = [0.5]\n" + START + END,
        "rod.radii must be one more than youngs_moduli",
        "2 radii and 2 moduli",
    ),
    (
        '[rod]\nsection = "centerline"\npoints = "[[0, 0, 0], [1, 0]] m"\nEI = "1 N m^2"\nd2 = [0, 1, 0]\n'
        + STIFF
        + START
        + END,
        "rod.points must be a list of lists of 3 numbers and a unit",
        "[1, 0, 0]",
    ),
    (
        '[rod]\nsection = "centerline"\npoints = "[[0, 0, 0], [1, 0, 0]] m"\nEI = "1 N m^2"\nd2 = [0, 1, 0]\n'
        + STIFF
        + START
        + END,
        "rod.points must have the shape (m, 3) with m >= 4",
        "(2, 3)",
    ),
    (
        '[rod]\nsection = "centerline"\nlength = "1 m"\n' + START + END,
        "rod.length is not allowed",
        "points, GJ, EA, EI, EI1, EI2",
    ),
    # the ends
    (ROD + START.replace('support = "clamp"', "") + END, "start.support is missing", "clamp, swivel, pin, free"),
    (ROD + START.replace("clamp", "glue") + END, "start.support must be one of", "clamp, swivel, pin, free"),
    (ROD + START.replace("clamp", "pin") + END, "start.tangent is not allowed", "position"),
    (ROD + START.replace("[1, 0, 0]", "[0, 0, 0]") + END, "start.tangent must be a direction", "zero vector"),
    (ROD + START.replace("[1, 0, 0]", "[1, 0]") + END, "start.tangent must be 3 numbers", "[1, 0, 0]"),
    (ROD + START.replace("[1, 0, 0]", '"[1, 0, 0]"') + END, "start.tangent must be 3 numbers", "without quotes"),
    (ROD + START.replace("[1, 0, 0]", "[1, 0, nan]") + END, "start.tangent must be finite", "nan"),
    (ROD + START.replace("[1, 0, 0]", f"[1{400 * '0'}, 0, 0]") + END, "start.tangent must be finite", "1000"),
    (ROD + START.replace("[1, 0, 0]", "[0, 1, 0]") + END, "start.d2 must not be parallel", "tangent"),
    (ROD + START.replace("tangent = [1, 0, 0]", "") + END, "start.tangent or start.frame", "exactly one"),
    (ROD + START + "frame = [[1,0,0],[0,1,0],[0,0,1]]\n" + END, "start.tangent or start.frame", "exactly one"),
    (
        ROD + START.replace(TANGENT, "d2 = [0, 1, 0]\nframe = [[1,0,0],[0,1,0],[0,0,1]]") + END,
        "start.d2 is not allowed",
        "second column",
    ),
    (
        ROD + START.replace(TANGENT, "frame = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]") + END,
        "start.frame must be a rotation (columns d1, d2, t of unit length",
        "tangent and d2 make one",
    ),
    (
        ROD + START.replace(TANGENT, "frame = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]") + END,
        "start.frame must be right-handed",
        "d1 x d2 = t",
    ),
    (ROD + START + END.replace('"[0.8, 0, 0] m"', "[0.8, 0, 0]"), "end.position must have a unit", "[0.8, 0, 0] m"),
    (ROD + START + END.replace('"[0.8, 0, 0] m"', '"0.8 m"'), "end.position must be 3 numbers", "[0.8, 0, 0] m"),
    (ROD + START + END.replace("[0.8, 0, 0]", "[0.8, 0, x]"), "end.position must be 3 numbers", "[0.8, 0, 0] m"),
    (ROD + START + END.replace("[0.8, 0, 0]", "[0.8, 0, true]"), "end.position must be 3 numbers", "[0.8, 0, 0] m"),
    (ROD + START + END.replace("0.8", "3.8"), "end.position: the ends are 3.8 m apart", "at most 1.5 m"),
    (ROD + START + END + "turns = 0.5\n", "end.turns must be a whole number", "0.5"),
    (ROD + START + "turns = 1\n" + END, "start.turns is not allowed", "position, frame, tangent, d2, spin"),
    (ROD + START + END + 'spin = "270 deg"\n', "end.spin must lie in -180 deg to 180 deg", "end.turns"),
    (ROD + START + END + "spin = 1.5\n", "end.spin must have a unit", 'spin = "90 deg"'),
    (
        ROD + '[start]\nsupport = "pin"\nposition = "[0, 0, 0] m"\n' + FREE,
        "start.support, end.support: Pin at the start and Free",
        "without gravity or a force",
    ),
    (ROD + '[start]\nsupport = "free"\n' + FREE, "start.support, end.support: Free", "Clamp, Swivel or Pin"),
    (
        ROD + '[start]\nsupport = "pin"\nposition = "[0, 0, 0] m"\n' + END + "turns = 1\n",
        "end.turns need a Clamp at both ends",
        "Pin",
    ),
    # loads, solve
    (ROD + START + END + "[loads]\ngravity = 9.81\n", "loads.gravity must have a unit", "[0, 0, -9.81] m/s^2"),
    (ROD + START + END + '[loads]\ngravity = "[0, 0, -1] m"\n', "loads.gravity must be in m/s^2", "'m'"),
    (ROD + START + END + "[loads]\npoint_force = 1\n", "loads.point_force must be a list", "[[loads.point_force]]"),
    (
        ROD + START + END + '[[loads.point_force]]\nat = "2 m"\nforce = "[0, 0, 1] N"\n',
        "loads.point_force[0].at must lie in 0 to 1 m",
        "2 m",
    ),
    (
        ROD + START + END + '[[loads.point_force]]\nat = "-2 m"\nforce = "[0, 0, 1] N"\n',
        "loads.point_force[0].at must not be negative",
        "-2",
    ),
    (ROD + START + END + '[[loads.point_force]]\nat = "2 m"\n', "loads.point_force[0].force is missing", "N"),
    (ROD + START + FREE + "follower = 1\n", "end.follower must be true or false", "got 1"),
    (ROD + START + FREE + 'follower = "true"\n', "end.follower must be true or false", "'true'"),
    (ROD + START + END + "follower = true\n", "end.follower is not allowed", "position, frame, tangent"),
    (ROD + START + FREE + "[[path]]\nend.follower = true\n", "path[0].end.follower is not allowed", "force, moment"),
    (
        ROD + START + END + '[[loads.distributed_force]]\nforce = "[0, 0, 1] N"\n',
        "loads.distributed_force[0].force must be in N/m",
        'force = "[0, 0, -0.2] N/m"',
    ),
    (
        ROD + START + END + '[[loads.distributed_force]]\nforce = "[0, 0, 1] N/m"\nfollower = "no"\n',
        "loads.distributed_force[0].follower must be true or false",
        "'no'",
    ),
    (ROD + START + END + "[[loads.distributed_force]]\n", "loads.distributed_force[0].force is missing", "N/m"),
    (ROD + START + END + "[[loads.distributed_couple]]\n", "loads.distributed_couple[0].couple is missing", "N m/m"),
    (ROD + START + END + "[loads]\ndistributed_force = 1\n", "loads.distributed_force must be a list", "got 1"),
    (ROD + START + END + "[solve]\nsegments = 1\n", "solve.segments must be a whole number", "2 to 100000"),
    (ROD + START + END + "[solve]\nsegments = 2.5\n", "solve.segments must be a whole number", "2 to 100000"),
    (ROD + START + END + "[solve]\nsteps = 2\n", "solve.steps is not allowed", "segments"),
    (ROD + START + END + "[solve]\nrtol = 0\n", "solve.rtol must be positive", "got 0"),
    (ROD + START + END + "[solve]\nrtol = 2\n", "solve.rtol must lie in 1e-10 to 1", "got 2"),
    (ROD + START + END + "[solve]\nrtol = 1e-3\nsegments = 9\n", "solve.rtol is not allowed", "solve.segments"),
    (ROD + START + END + '[solve]\ndiscretization = "fine"\n', "solve.discretization must be one of", "hermite"),
    # paths
    (ROD + START + END + "[[path]]\nsteps = 3\n", "path[0] changes nothing", "end.spin"),
    (ROD + START + END + "[[path]]\nsteps = 0\n", "path[0].steps must be a whole number", "1 to 10000"),
    (ROD + START + END + "[[path]]\nend.turns = 1\n", "path[0].end.turns is not allowed", "spin"),
    (ROD + START + END + '[[path]]\nrod.length = "2 m"\n', "path[0].rod is not allowed", "start, end, loads"),
    (ROD + START + END + "[[path]]\nend.tangent = [-1, 0, 0]\n", "path[0].end.tangent must not be opposite", "third"),
    (ROD + START + END + "[[path]]\nend.tangent = [0, 0, 0]\n", "path[0].end.tangent must be a direction", "zero"),
    (
        ROD + START + END + '[[path]]\nsteps = 2\nend.spin = "360 deg"\n',
        "path[0].end.spin must turn by less than 180 deg a step",
        "path[0].steps must be at least 3",
    ),
    (
        ROD + START + END + '[[path]]\nend.spin = "100 deg"\nstart.spin = "-100 deg"\n',
        "path[0].end.spin - start.spin must turn by less than 180 deg a step",
        "path[0].steps must be at least 2",
    ),
    (
        ROD + START + END + '[[path]]\nsteps = 2\nend.position = "[0.9, 0, 0] m"\n'
        '[[path]]\nsteps = 9\nend.position = "[9, 0, 0] m"\n',
        "path[1].start.position, end.position: the ends are",
        "at most 1.5 m",
    ),
    (
        ROD + START + END + "[[path]]\nsteps = 7\nend.tangent = [0, 1, 0.00]\n",
        "path[0].end.d2 must not be parallel",
        "tangent",
    ),
    (
        ROD + START + END + "[[path]]\nsteps = 3\nend.tangent = [-0.5, 0.8660254037844386, 0]\n",
        "path[0].steps: step 3 of 3 turns the end by 180 deg",
        "d2",
    ),
    (
        ROD + START + END + "turns = 1\n" + '[[path]]\nend.spin = "90 deg"\n',
        "end.turns is not allowed together with path",
        "end.spin",
    ),
    # what is solved, and how
    (THICK + START + END + FLOOR + FINITE, "solve.discretization must be 'hermite'", "a scene with obstacles"),
    (ROD + START + END + CLIP + "spin = 0.1\n" + FINITE, "clips[0].spin must have a unit", "90 deg"),
    (
        ROD + START + END + CLIP + 'd2 = [0, 1, 0]\nspin = "9 deg"\n' + FINITE,
        "solve.discretization must be 'hermite' for clips",
        "that need frames",
    ),
    (ROD + START + END + CLIP * 2 + "[solve]\nsegments = 2\n", "clips[1].at must be larger", "0.5 m"),
    (
        ROD + START + END + CLIP + CLIP.replace("0.5 m", "0.7 m") + "[solve]\nsegments = 2\n",
        "solve.segments must be a whole number from 3",
        "got 2",
    ),
    # obstacles
    (
        ROD + START + END + FLOOR,
        "rod must have a radius where there are obstacles",
        "got None",
    ),
    (
        THICK + START + END + FLOOR.replace("plane", "floor"),
        "obstacles[0].kind must be",
        "plane, sphere, capsule, pipe, cylinder, box, union",
    ),
    (THICK + START + END + '[[obstacles]]\nkind = "mesh"\nfile = "a.stl"\n', "obstacles[0].kind must be", "union"),
    (THICK + START + END + FLOOR.replace("normal", "up"), "obstacles[0].up is not allowed", "point, normal"),
    (THICK + START + END + FLOOR.replace("0, 1]", "0, 0]"), "obstacles[0].normal must be a direction", "zero vector"),
]


@pytest.mark.parametrize(("text", "key", "allowed"), MISTAKES, ids=[key for _, key, _ in MISTAKES])
def test_a_mistake_is_named_in_one_line(text, key, allowed, read, tmp_path):
    with pytest.raises(SceneFileError) as caught:
        read(text)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{tmp_path / 'scene.toml'}: ")
    assert key in message
    assert allowed in message


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(SceneFileError, match=r"missing\.toml: cannot be read: No such file"):
        read_scene(tmp_path / "missing.toml")
    with pytest.raises(SceneFileError, match="cannot be read: Is a directory"):
        read_scene(tmp_path)
    (tmp_path / "picture.toml").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(SceneFileError, match=r"picture\.toml: is not text in UTF-8"):
        read_scene(tmp_path / "picture.toml")
    (tmp_path / "deep.toml").write_text("a = " + 100_000 * "[")
    with pytest.raises(SceneFileError, match=r"deep\.toml: is not valid TOML"):
        read_scene(tmp_path / "deep.toml")
