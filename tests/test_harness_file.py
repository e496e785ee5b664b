"""Scene files of harnesses, and of ends that hinge, slide or give way."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BRANCHES, ROD

import rodjax
from rodjax import (
    Body,
    Box,
    Capsule,
    Clamp,
    Clip,
    Cylinder,
    DistributedForce,
    Free,
    Harness,
    Hinge,
    Joint,
    Pin,
    Pipe,
    Plane,
    PointForce,
    Rod,
    Scene,
    SceneFileError,
    Slider,
    Smooth,
    Sphere,
    Spring,
    Steps,
    Swivel,
    Union,
    cli,
)
from rodjax.io.harness_file import read_harness_file

ONE = f"""
rod = {ROD}
start = {{ support = "clamp", position = "[0, 0, 0] m", tangent = [1, 0, 0], d2 = [0, 1, 0] }}
end = {{ END }}
"""


@pytest.fixture
def written(tmp_path):
    def write(text: str):
        path = tmp_path / "harness.toml"
        path.write_text(text)
        return path

    return write


def test_a_file_of_cables_is_a_harness(written):
    harness = rodjax.read_scene(written(BRANCHES))
    assert isinstance(harness, rodjax.Harness)
    assert tuple(harness) == ("trunk", "left", "right")
    assert harness.joint_names == ("y",)
    assert harness.bodies[0].force is not None
    assert jnp.allclose(harness.bodies[0].force, jnp.array([0, 0, -0.1]))
    end = harness["trunk"].end
    assert isinstance(end, Joint)
    assert jnp.allclose(end.offset, jnp.array([-0.005, 0, 0]))
    assert jnp.allclose(end.frame[:, 2], jnp.array([1.0, 0, 0]))
    assert [scene.gravity is not None and float(scene.gravity[2]) for scene in harness.scenes] == [-9.81] * 3


def test_obstacles_of_a_file_are_those_of_all_cables_without_their_own(written):
    floor = '[[obstacles]]\nkind = "plane"\npoint = "[0, 0, -20] cm"\nnormal = [0, 0, 1]\n'
    own = '[[cables.left.obstacles]]\nkind = "sphere"\ncenter = "[0, 0, -1] m"\nradius = "10 cm"\n'
    harness = rodjax.read_scene(written(BRANCHES + floor + own))
    assert isinstance(harness, rodjax.Harness)
    kinds = {name: [type(one).__name__ for one in harness[name].obstacles] for name in harness}
    assert kinds == {"trunk": ["Plane"], "left": ["Sphere"], "right": ["Plane"]}


def test_a_harness_is_written_and_read_to_the_last_bit(tmp_path):
    rod = Rod.circular(0.5, 0.005, 1e7, poisson_ratio=0.5, density=1200.0)
    joint, along = Joint('a "b"', rodjax.frame((1, 0, 0)), (0.01, 0, 1 / 3)), rodjax.frame((1, 0, 0))
    supports = [Hinge((0, 0, 0), along, (0, 1, 0)), Slider((0, 0, 0), [(1, 0, 0), (0, 1, 0)])]
    for support in (*supports, Spring(Clamp((0.95, 0, 0), along), 50.0, 1 / 3), None):
        cables = {
            "the trunk": Scene(
                rod, Clamp((0, 0, 0), along), joint, (0, 0, -9.81), obstacles=[Plane((0, 0, -1), (0, 0, 1))]
            ),
            "x.y": Scene(rod, joint, Joint("far"), (0, 0, -9.81), clips=[Clip(0.2, (0.3, 0, 0))]),
        }
        harness = Harness(cables, {'a "b"': Body((1 / 3, 0, 0), None, 0.1), "far": Body(support=support)})
        rodjax.write_scene(harness, tmp_path / "harness.toml", segments=7)
        file = read_harness_file(tmp_path / "harness.toml")
        assert file.segments == 7
        assert jax.tree.structure(file.harness) == jax.tree.structure(harness)
        for one, other in zip(jax.tree.leaves(file.harness), jax.tree.leaves(harness), strict=True):
            assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


LEVEL = rodjax.frame((1, 0, 0))
PLAIN = Rod.circular(0.5, 0.005, 1e7, poisson_ratio=0.5, density=1200.0)
STRIP = Rod(
    0.4, (2e-3, 5e-3), 1e-3, 500.0, GA=(80.0, 90.0), mass_per_length=0.1, radius=0.004, rest_curvature=(1 / 3, 0)
)
VARYING = Rod(
    0.3, Steps([0.1], [1e-3, 1 / 3]), 1e-3, 500.0, 0.1, Smooth([0, 0.3], [4e-3, 6e-3]), rest_twist=0.2, rest_strain=0.01
)


def _in_the_middle(**body) -> Harness:
    """Rods of both kinds that end at places and in directions of their own in a body with these loads."""
    loads = {
        "point_forces": [PointForce(0.2, (0, 0, -1 / 3))],
        "distributed": [DistributedForce((0, 0.1, 0), part=(0.1, 0.3))],
    }
    cables = {
        "plain": Scene(PLAIN, Clamp((0, 0, 0), LEVEL), Joint("y", LEVEL, (-0.01, 0, 1 / 3)), (0, 0, -9.81), **loads),
        "strip": Scene(STRIP, Joint("y", rodjax.frame((1, 1, 0)), (0.01, 0, 0)), Pin((1, 0.2, 0)), (0, 0, -9.81)),
        "varying": Scene(VARYING, Joint("y", LEVEL), Free((0, 0, 1 / 3)), (0, 0, -9.81)),
    }
    return Harness(cables, {"y": Body(**body)})


def _side_by_side(contact) -> Harness:
    """Three rods between supports, the first with turns."""
    clips = [Clip(0.2, (0.2, 0, 0), tangent=(1, 0, 1)), Clip(0.3, (0.3, 0, 0), frame=LEVEL)]
    obstacles = [
        Sphere((0, 0, -1), 0.1),
        Box((0, 0, -2), (0.1, 0.2, 1 / 3), LEVEL),
        Union(Capsule((0, 0, -3), (0, 1, -3), 0.1), Cylinder((0, 0, -4), (0, 1, -4), 0.1)),
        Pipe([(0, 0, -5), (1, 0, -5), (1, 1, -5)], 0.1),
    ]
    cables = {
        "turned": Scene(PLAIN, Clamp((0, 0, 0), LEVEL), Clamp((0.4, 0, 0), LEVEL), turns=2),
        "clipped": Scene(PLAIN, Swivel((0, 0.1, 0), (1, 0, 1 / 3)), Joint("far", LEVEL), clips=clips),
        "above": Scene(STRIP, Pin((0, 0.2, 0)), Clamp((0.4, 0.2, 0), LEVEL), obstacles=obstacles),
    }
    return Harness(cables, {"far": Body((0, 0, 0.1))}, contact)


HARNESSES = {
    "a mass": lambda: _in_the_middle(mass=1 / 3),
    "a force and a moment": lambda: _in_the_middle(force=(1 / 3, 0, 0), moment=(0, 1e-3, 1 / 3)),
    "all, on a hinge": lambda: _in_the_middle(
        force=(1 / 3, 0, 0), moment=(0, 1e-3, 0), mass=0.1, support=Hinge((0.5, 0, 0), LEVEL, (0, 1, 1))
    ),
    "on a clamp": lambda: _in_the_middle(support=Clamp((0.5, 0, 0), LEVEL)),
    "on a pin with springs": lambda: _in_the_middle(support=Spring(Pin((0.5, 0, 0)), 1 / 3)),
    "on a slider": lambda: _in_the_middle(support=Slider((0.5, 0, 0), [(1, 1, 0)], LEVEL)),
    "no contact": lambda: _side_by_side(False),
    "contact of all": lambda: _side_by_side(True),
    "contact of some": lambda: _side_by_side([("turned", "above"), ("clipped", "turned")]),
}


@pytest.mark.parametrize("kind", HARNESSES)
def test_every_kind_of_harness_is_written_and_read_to_the_last_bit(kind, tmp_path):
    harness = HARNESSES[kind]()
    rodjax.write_scene(harness, tmp_path / "harness.toml")
    read = rodjax.read_scene(tmp_path / "harness.toml")
    assert jax.tree.structure(read) == jax.tree.structure(harness)  # with names, and pairs in contact
    for (where, one), other in zip(jax.tree.leaves_with_path(harness), jax.tree.leaves(read), strict=True):
        assert np.asarray(other).tobytes() == np.asarray(one).tobytes(), jax.tree_util.keystr(where)
    assert isinstance(read, Harness)
    rodjax.write_scene(read, tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_bytes() == (tmp_path / "harness.toml").read_bytes()


@pytest.mark.parametrize(
    ("end", "kind"),
    [
        ('support = "hinge", position = "[1, 0, 0] m", tangent = [1, 0, 0], d2 = [0, 1, 0], axis = [0, 2, 0]', Hinge),
        ('support = "slider", position = "[20, 0, 0] cm", directions = [[1, 0, 0], [0, 1, 0]]', Slider),
        (
            'support = "clamp", position = "[20, 0, 0] cm", tangent = [1, 0, 0], d2 = [0, 1, 0], '
            'rotation = "0.5 N m/rad"',
            Spring,
        ),
    ],
)
def test_a_file_has_ends_that_move(written, end, kind):
    if kind is Hinge:
        end = end.replace("[1, 0, 0] m", "[0.2, 0, 0] m")
    scene = rodjax.read_scene(written(ONE.replace("END", end)))
    assert isinstance(scene, Scene)
    found = scene.end
    assert isinstance(found, kind)
    if isinstance(found, Spring):
        assert isinstance(found.support, Clamp)
        assert (found.rotation, found.translation) == (0.5, None)
    if isinstance(found, Hinge):
        assert np.array_equal(found.axis, [0, 1, 0])
    if isinstance(found, Slider):
        assert found.frame is None
        assert found.directions.shape == (2, 3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('joint = "y", tangent = [1, 0, 0]', "tangent = [1, 0, 0]", "cables.trunk.end.joint is missing: the name"),
        ("[joints.y]", "[joints.z]", "joints['z'] has no rod: the ends of the cables name 'y'"),
        ('force = "[0, 0, -0.1] N"', 'mass = "-1 g"', "joints.y.mass must not be negative"),
        ("tangent = [1, 1, 0], d2 = [0, 0, 1]", "tangent = [1, 1, 0]", "cables.left.start.d2 or start.frame is needed"),
        ("[loads]", "[load]", "load is not allowed here; allowed are cables, contact, joints, loads, obstacles, solve"),
        ('-9.81] m/s^2"', '-9.81] N"', ".toml: loads.gravity must be in m/s^2"),
        ("[loads]", '[[obstacles]]\nkind = "plan"\n[loads]', ".toml: obstacles[0].kind must be one of plane, sphere"),
        ("[loads]", '[[cables.left.obstacles]]\nkind = "plan"\n[loads]', ".toml: cables.left.obstacles[0].kind must"),
    ],
)
def test_mistakes_in_a_file_are_told_in_one_line(written, old, new, message):
    assert old in BRANCHES
    with pytest.raises(SceneFileError, match=re.escape(message)):
        rodjax.read_scene(written(BRANCHES.replace(old, new)))


@pytest.mark.slow
def test_the_command_solves_and_draws_a_harness(written, tmp_path, capsys):
    picture = tmp_path / "harness.png"
    assert cli.main(["solve", str(written(BRANCHES)), "--plot", str(picture)]) == 0
    told = capsys.readouterr().out
    assert "3 cables, 1 joint\n" in told
    assert "trunk: converged" in told
    assert picture.stat().st_size > 10_000
    again = [str(written(BRANCHES)), "-o", str(tmp_path / "out.vtkhdf"), "--csv", str(tmp_path / "out.csv")]
    assert cli.main(["solve", *again]) == 0
    result = rodjax.load(tmp_path / "out.vtkhdf")
    assert isinstance(result, rodjax.HarnessEquilibrium)
    assert result.names == ("trunk", "left", "right")
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[0].startswith("cable,s [m],x [m],")
    assert [line.split(",")[0] for line in lines[1:]] == sorted(
        (line.split(",")[0] for line in lines[1:]), key=result.names.index
    )
    last = [float(number) for number in lines[-1].split(",")[1:5]]
    # To roundings of positions in units of the rod, which begins at the joint.
    np.testing.assert_allclose(last, [0.3, 0.5, -0.15, 0.0], rtol=0, atol=1e-15)
    capsys.readouterr()
    assert cli.main(["solve", str(written(BRANCHES)), "--dxf", str(tmp_path / "out.dxf")]) == 2
    assert "--dxf is for one cable" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_reports_on_a_harness(written, tmp_path, capsys):
    """In the file of a harness itself, or by its name, and of a saved result: the same table of all cables."""
    limits = '[limits]\nend_force = "100 N"\n'
    (tmp_path / "apart.toml").write_text('scene = "harness.toml"\n' + limits)
    assert cli.main(["solve", str(written(BRANCHES)), "-o", str(tmp_path / "out.vtkhdf")]) == 0
    (tmp_path / "both.toml").write_text(BRANCHES + limits)
    (tmp_path / "limits.toml").write_text(limits)
    capsys.readouterr()
    told = []
    for arguments in (["both.toml"], ["apart.toml"], ["limits.toml", "--result", str(tmp_path / "out.vtkhdf")]):
        folder = tmp_path / "report"
        assert cli.main(["report", str(tmp_path / arguments[0]), *arguments[1:], "--out", str(folder)]) == 0
        assert (folder / "report.png").stat().st_size > 10_000
        told.append((folder / "report.csv").read_text())
    for name in ("trunk", "left", "right"):
        assert f"\n{name}," in told[0]
    assert told[1] == told[0]
    assert told[2] == told[0]
    assert cli.main(["route", str(tmp_path / "both.toml"), "--out", str(tmp_path / "route")]) == 2
    assert "variables is missing" in capsys.readouterr().err
