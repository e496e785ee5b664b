"""Sweeps: the cases are what grid and table say, and one done in pieces is the same to the last bit as in a whole."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import equinox as eqx
import h5py
import jax
import numpy as np
import pyarrow.parquet
import pytest
from test_tasks import Unreliable

import rodjax
from rodjax.analysis.curvature import curvature_along
from rodjax.cli import main
from rodjax.io.harness_file import read_scene
from rodjax.solving.refinement import SIZES
from rodjax.sweeps.cases import CaseReader, SweepError, read_cases
from rodjax.sweeps.quantities import QUANTITIES
from rodjax.sweeps.result import merge, summary
from rodjax.sweeps.sweep import sweep

SCENE = """
[rod]
length = "100 cm"
EI = "4.9e-3 N m^2"
GJ = "3.3e-3 N m^2"
EA = "785 N"
mass_per_length = "0.1 kg/m"

[start]
support = "clamp"
position = "[0, 0, 0] m"
tangent = [1, 0, 0]
d2 = [0, 1, 0]

[end]
support = "clamp"
position = "[80, 0, 0] cm"
tangent = [1, 0, 0]
d2 = [0, 1, 0]

[loads]
gravity = "[0, 0, -9.81] m/s^2"

[[loads.point_force]]
at = "0.5 m"
force = "[0, 0, -0.1] N"

[solve]
segments = 4
discretization = "finite_difference"
"""
# Ten cases: in chunks of four the last one is filled up.
GRID = """
"rod.EI" = [0.004, "5000 N mm^2"]
"end.position.0" = { from = "70 cm", to = 0.9, count = 5 }
"""
CHUNK = 4


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A scene and a grid in the working folder."""
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    Path("grid.toml").write_text(GRID)
    return tmp_path


@pytest.fixture(scope="module")
def whole(tmp_path_factory, for_processes):
    """The result of an uninterrupted sweep, by compiled programs."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "scene.toml").write_text(SCENE)
    (folder / "grid.toml").write_text(GRID)
    with for_processes():
        sweep(folder / "scene.toml", folder / "grid.toml", folder / "whole.h5", chunk=CHUNK)
    return folder / "whole.h5"


def contents(path):
    """All datasets and attributes of a file."""
    found = {}
    with h5py.File(path) as file:
        found |= {f"attribute {name}": value for name, value in file.attrs.items()}
        file.visititems(lambda name, entry: found.update({name: entry[()]} if isinstance(entry, h5py.Dataset) else {}))
    return found


def assert_same(path, expected):
    one, other = contents(path), contents(expected)
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert np.asarray(value).dtype == np.asarray(other[name]).dtype
        assert np.array_equal(value, other[name]), name


def cases(text, suffix=".toml"):
    path = Path(f"cases{suffix}")
    path.write_text(text)
    return read_cases(path)[0]


def values(text, suffix=".toml"):
    read = cases(text, suffix)
    return read.of(np.arange(read.count))


# --- the values ------------------------------------------------------------------------------------------------------


def test_a_grid_is_the_product_with_the_last_key_fastest(files):
    given = values(GRID)
    np.testing.assert_array_equal(given["rod.EI"], np.repeat([0.004, 0.005], 5))
    np.testing.assert_allclose(given["end.position.0"], 2 * [0.7, 0.75, 0.8, 0.85, 0.9], rtol=1e-15)


def test_values_have_units_as_in_the_scene_file_or_are_si(files):
    given = values(
        '"end.position" = ["[70, 0, 1] cm", [0.8, 0, 0]]\n'
        'rod.EA = { from = "80 N", to = "8 kN", count = 3, spacing = "log" }\n'
        '"end.tangent" = [[0, 0, 2]]\n"end.spin" = ["90 deg"]\n"loads.point_force.0.at" = [0.25]\n'
    )
    np.testing.assert_allclose(given["end.position"][[0, 3]], [[0.7, 0, 0.01], [0.8, 0, 0]], rtol=1e-15)
    np.testing.assert_allclose(given["rod.EA"][:3], [80, 800, 8000], rtol=1e-14)
    np.testing.assert_array_equal(given["end.tangent"][0], [0, 0, 2])
    assert given["end.spin"][0] == pytest.approx(np.pi / 2)


def test_a_table_is_one_case_a_row(files):
    given = values(
        'rod.EI,end.position.2, end.tangent,loads.gravity\n0.004,1 cm,"[1, 0, 1]","[0, 0, -9.81] m/s^2"\n\n'
        '"4e-3 N m^2",-0.02,"[1, 0, 0]","[0, 0, 0]"\n',
        ".csv",
    )
    np.testing.assert_array_equal(given["rod.EI"], [0.004, 0.004])
    np.testing.assert_array_equal(given["end.position.2"], [0.01, -0.02])
    np.testing.assert_array_equal(given["end.tangent"], [[1, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(given["loads.gravity"], [[0, 0, -9.81], [0, 0, 0]])


def test_a_case_is_the_scene_of_a_file_with_its_values(files):
    Path("table.csv").write_text(
        "rod.length,end.position.0,end.d2,end.tangent.2,loads.point_force.0.force.1,loads.gravity\n"
        '"110 cm",0.7,"[0, 1, 1]",0.5,0.2,"[0, 0, -1]"\n1.2,80 cm,"[0, 2, 0]",0,0.3,"[0, 0, -2]"\n'
    )
    scenes = CaseReader(Path("scene.toml"), Path("table.csv")).scenes(np.arange(2))
    text = (
        SCENE.replace('"100 cm"', '"110 cm"')
        .replace(
            '"[80, 0, 0] cm"\ntangent = [1, 0, 0]\nd2 = [0, 1, 0]',
            '"[0.7, 0, 0] m"\ntangent = [1, 0, 0.5]\nd2 = [0, 1, 1]',
        )
        .replace("[0, 0, -0.1] N", "[0, 0.2, -0.1] N")
        .replace("-9.81", "-1")
    )
    Path("expected.toml").write_text(text)
    expected = read_scene("expected.toml")
    assert jax.tree.structure(scenes[0]) == jax.tree.structure(expected)
    for leaf, other in zip(jax.tree.leaves(scenes[0]), jax.tree.leaves(expected), strict=True):
        # A number in SI units after one in other units may differ by a rounding.
        np.testing.assert_allclose(leaf, other, rtol=1e-15, atol=1e-16)
    assert float(scenes[1].rod.length) == 1.2
    assert float(scenes[1].gravity[2]) == -2


BY_COLUMNS = {
    "plain": (
        SCENE,
        {
            "rod.EI": ("0.004", "0.005"),
            "end.position.2": ("1 cm", "0.02"),
            "loads.gravity": ('"[0, 0, -9] m/s^2"', '"[0, 1, -8]"'),
        },
    ),
    "clamps that turn": (
        SCENE,
        {
            "end.tangent": ('"[1, 0, 0.3]"', '"[1, 0, 0]"'),
            "start.d2": ('"[0, 2, 0.1]"', '"[0, 1, 0]"'),
            "end.spin": ("100 deg", "0"),
        },
    ),
    "a section": (
        SCENE.replace(
            'EI = "4.9e-3 N m^2"\nGJ = "3.3e-3 N m^2"\nEA = "785 N"\nmass_per_length = "0.1 kg/m"',
            'section = "tube"\nouter_radius = "5 mm"\ninner_radius = "4 mm"\nyoungs_modulus = "10 MPa"\n'
            'poisson_ratio = 0.5\ndensity = "1200 kg/m^3"',
        ),
        {
            "rod.length": ("1.1", "1.2"),
            "rod.outer_radius": ("6 mm", "7e-3"),
            "rod.poisson_ratio": ("0.4", "0.3"),
            "loads.point_force.0.at": ("0.3", "50 cm"),
        },
    ),
    "clips and obstacles": (
        SCENE.replace('"finite_difference"', '"hermite"').replace('EA = "785 N"', 'EA = "785 N"\nradius = "5 mm"')
        + '[[clips]]\nat = "0.4 m"\nposition = "[0.3, 0, 0.05] m"\ntangent = [1, 0, 0]\nd2 = [0, 1, 0]\n'
        + 'spin = "0 deg"\n'
        + '[[obstacles]]\nkind = "box"\ncenter = "[0, 0, -1] m"\nsize = "[10, 10, 10] cm"\n'
        + "frame = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
        + '[[obstacles]]\nkind = "union"\n[[obstacles.parts]]\nkind = "capsule"\nstart = "[0, 0, -1] m"\n'
        + 'end = "[1, 0, -1] m"\nradius = "5 cm"\n',
        {
            "clips.0.at": ("45 cm", "0.42"),
            "clips.0.spin": ("10 deg", "0"),
            "obstacles.0.center.2": ("-1.1", "-120 cm"),
            "obstacles.0.size": ('"[20, 10, 10] cm"', '"[0.1, 0.1, 0.1]"'),
            "obstacles.1.parts.0.end.1": ("2 cm", "0.1"),
            "obstacles.1.parts.0.radius": ("6 cm", "0.07"),
        },
    ),
}


@pytest.mark.parametrize("name", BY_COLUMNS)
def test_scenes_made_by_columns_are_those_read_one_by_one(name, files, monkeypatch):
    scene, cells = BY_COLUMNS[name]
    Path("scene.toml").write_text(scene)
    first, second = (",".join(row) for row in zip(*cells.values(), strict=True))
    Path("table.csv").write_text("\n".join([",".join(cells), first, second, first]) + "\n")
    reader = CaseReader(Path("scene.toml"), Path("table.csv"))
    given = np.arange(3), reader.cases.of(np.arange(3)), 4
    one_by_one = reader.of_cases.stacked(*given)
    monkeypatch.setattr("rodjax.sweeps.cases.LEAST_ROWS", 1)
    monkeypatch.setattr("rodjax.sweeps.cases._stacked", lambda scenes: pytest.fail("read one by one"))
    at_once = reader.of_cases.stacked(*given)
    assert jax.tree.structure(at_once) == jax.tree.structure(one_by_one)
    for leaf, expected in zip(jax.tree.leaves(at_once), jax.tree.leaves(one_by_one), strict=True):
        assert leaf.dtype == expected.dtype
        # A program may round a sum of products once where NumPy does so twice.
        np.testing.assert_allclose(leaf, expected, rtol=4e-16, atol=4e-16)
        assert leaf.shape[0] == 4


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        ('end.d2\n"[0, 1, 0]"\n"[1, 0, 0]"\n"[0, 0, 1]"\n', "d2 must not be parallel to the tangent"),
        ("end.tangent.0\n1\n0\n2\n", "tangent must be a direction"),
        ("rod.length,end.position.0\n1.0,0.8\n0.9,1.75\n1.0,0.8\n", "the ends are 1.75 m apart"),
        ("rod.length,loads.point_force.0.at\n2.0,0.5\n1.0,1.5\n2.0,1.9\n", "at"),
    ],
)
def test_what_makes_no_sense_is_named_also_by_columns(cells, said, files, monkeypatch):
    monkeypatch.setattr("rodjax.sweeps.cases.LEAST_ROWS", 1)
    Path("table.csv").write_text(cells)
    reader = CaseReader(Path("scene.toml"), Path("table.csv"))
    with pytest.raises(SweepError, match=r"^table\.csv: case 1: .*" + said):
        reader.of_cases.stacked(np.arange(3), reader.cases.of(np.arange(3)), 3)


def test_scenes_that_differ_in_more_than_numbers_are_read_one_by_one(files, monkeypatch):
    """How many wires a bundle has decides what is summed."""
    wires = 'section = "bundle"\nwires = 7\nwire_radius = "1 mm"\nyoungs_modulus = "1 GPa"\nstick = 0.2\n'
    wires += "poisson_ratio = 0.3"
    plain = 'EI = "4.9e-3 N m^2"\nGJ = "3.3e-3 N m^2"\nEA = "785 N"\nmass_per_length = "0.1 kg/m"'
    scene = SCENE.replace(plain, wires).split("[loads]")[0]
    Path("scene.toml").write_text(scene)
    Path("table.csv").write_text("rod.wires,rod.length\n7,1\n19,1.1\n")
    reader = CaseReader(Path("scene.toml"), Path("table.csv"))
    given = np.arange(2), reader.cases.of(np.arange(2)), 2
    monkeypatch.setattr("rodjax.sweeps.cases.LEAST_ROWS", 1)
    stacked = reader.of_cases.stacked(*given)
    expected = [scene.rod.EA for scene in reader.scenes(np.arange(2))]
    np.testing.assert_array_equal(stacked.rod.EA, expected)
    assert expected[1] == pytest.approx(19 / 7 * expected[0])


MISTAKES = [
    ("[]", "is not valid TOML", ""),
    ("", "holds no keys", "rod.EI"),
    ("rod.EI = 5", "rod.EI must be a list of values", "from = 1"),
    ("rod.EI = []", "rod.EI must be a list of values", "from = 1"),
    ('"solve.segments" = [4, 5]', "solve.segments cannot vary", "rod, start, end, loads, clips and obstacles"),
    ('"end.support" = ["pin", "clamp"]', "end.support cannot vary", "that hold numbers"),
    ('"rod.color" = [1]', "rod.color cannot vary", "that hold numbers"),
    ('"1" = [1]', "1 cannot vary", "that hold numbers"),
    ('"rod.EI.0" = [1]', "rod.EI.0 is no component", "a single number"),
    ('"end.position.3" = [1]', "end.position.3 is no component", "3 numbers"),
    ('"end.position" = [[0.8, 0, 0]]\n"end.position.1" = [0.1]', "end.position.1 is given twice", "component"),
    ('"rod.EI" = ["5 m"]', "value 0: rod.EI must be in N m^2", "'m'"),
    ('"rod.EI" = [0.1, true]', "value 1: rod.EI must be a number and a unit", "EI ="),
    ('"end.position" = [[0.8, 0]]', "value 0: end.position must be 3 numbers", "[0.8, 0, 0] m"),
    ('"end.position.1" = ["a lot"]', "a component of end.position must be a number", "a unit"),
    ('"end.tangent.1" = ["1 m"]', "a component of end.tangent must be a number", "1 m"),
    ('"rod.EI" = { from = 1, to = 2 }', "rod.EI must have from, to, count", "spacing"),
    ('"rod.EI" = { from = 1, to = 2, count = 1 }', "rod.EI.count must be a whole number from 2", "1"),
    ('"rod.EI" = { from = 0, to = 2, count = 3, spacing = "log" }', "rod.EI.from and rod.EI.to must be positive", ""),
    ('"rod.EI" = { from = 0, to = 2, count = 3, spacing = "cubic" }', "rod.EI.spacing must be one of", "log"),
    # found as the scenes are read
    ('"rod.EI" = [1, -1]', "case 1: rod.EI must be positive", "-1"),
    ('"end.position.0" = [0.8, 0.9, 1.9]', "case 2: start.position, end.position: the ends are", "1.5 m"),
    ('"rod.position" = [[1, 0, 0]]', "case 0: rod.position is not allowed here", "length"),
    ('"end.spin" = [0, 4]', "case 1: end.spin must lie in -180 deg", "180 deg"),
]
IN_THE_SCENE = [
    ('"end.force.1" = [1]', "end.force is not there, so that", "end.force.1"),
    ('"loads.point_force.1.at" = [1]', "loads.point_force.1 is not there", "loads.point_force.1.at"),
]
IN_A_TABLE = [
    ("rod.EI\n", "must have a header", "row"),
    ("rod.EI,rod.EI\n1,2\n", "rod.EI is given twice", ""),
    ("rod.EI,rod.GJ\n1,2\n3\n", "case 1 has 1 cells", "2"),
    ('rod.EI\n1\n"2 m"\n', "value 1: rod.EI must be in N m^2", "'m'"),
    ("rod.EI\n1\nnan\n", "value 1: rod.EI must be finite", "nan"),
    ("rod.EI,rod.GJ\n1,\n", "value 0: rod.GJ must be a number and a unit", "''"),
]


@pytest.mark.parametrize(
    ("name", "text", "said", "allowed"),
    [("cases.toml", *mistake) for mistake in MISTAKES]
    + [("scene.toml", *mistake) for mistake in IN_THE_SCENE]
    + [("cases.csv", *mistake) for mistake in IN_A_TABLE],
)
def test_a_mistake_is_named_in_one_line_and_nothing_is_solved(name, text, said, allowed, files, capsys, monkeypatch):
    monkeypatch.setattr("rodjax.sweeps.chunk.solve_batch", lambda *args, **options: pytest.fail("solved"))
    over = "cases.csv" if name.endswith("csv") else "cases.toml"
    Path(over).write_text(text)
    assert main(["sweep", "scene.toml", "--over", over, "-o", "out.h5"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert f"rodjax: {name}: " in err
    assert said in err
    assert allowed in err
    assert err.count("\n") == 1
    assert not Path("out.h5.parts").exists()


def test_other_mistakes_on_the_command_line(files, capsys):
    Path("path.toml").write_text(SCENE + '[[path]]\nend.spin = "90 deg"\n')
    Path("grid.txt").write_text(GRID)
    Path("other.h5").write_bytes(b"no HDF5")
    for arguments, said in [
        (["sweep", "path.toml", "--over", "grid.toml", "-o", "a.h5"], "path.toml: path is not allowed in a sweep"),
        (["sweep", "missing.toml", "--over", "grid.toml", "-o", "a.h5"], "missing.toml: cannot be read"),
        (
            ["sweep", "scene.toml", "--over", "grid.txt", "-o", "a.h5"],
            "grid.txt: a grid ends in .toml, a table in .csv",
        ),
        (["sweep", "scene.toml", "--over", "missing.csv", "-o", "a.h5"], "missing.csv: cannot be read"),
        (["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.csv"], "-o must end in .h5"),
        (["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.h5", "--shard", "3/2"], "--shard: must be i/n"),
        (
            ["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.h5", "--chunk", "0"],
            "--chunk: must be a whole number",
        ),
        (["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.h5", "--shard", "2/2"], "shard 2/2 would be empty"),
        (["sweep", "scene.toml", "--over", "grid.toml", "-o", "other.h5"], "other.h5 is there already"),
        (["merge", "missing.h5", "-o", "a.h5"], "missing.h5 is not there"),
        (["merge", "other.h5", "-o", "a.h5"], "other.h5 is not a readable HDF5 file"),
        (["merge", "missing.h5", "-o", "other.h5"], "other.h5 is there already"),
    ]:
        assert main(arguments) == 2
        assert said in capsys.readouterr().err
    assert not Path("a.h5").exists()


# --- the result ------------------------------------------------------------------------------------------------------


def test_the_result_is_that_of_single_solves(files, whole):
    found = contents(whole)
    scenes = CaseReader(Path("scene.toml"), Path("grid.toml")).scenes(np.arange(10))
    np.testing.assert_array_equal(found["case"], np.arange(10))
    np.testing.assert_array_equal(found["parameters/rod.EI"], np.repeat([0.004, 0.005], 5))
    assert found["nodes"].shape == (10, 5, 3)
    for case in (0, 9):
        alone = rodjax.solve(scenes[case], segments=4, discretization="finite_difference")
        for name in ("nodes", "energy", "elastic_energy", "start_force", "end_moment", "error_estimate"):
            np.testing.assert_allclose(found[name][case], getattr(alone, name), atol=1e-7)
        assert found["status"][case] == alone.status
    with h5py.File(whole) as file:
        assert file["end_moment"].attrs["units"] == "N m"
        assert file["parameters/end.position.0"].attrs["units"] == "m"
        assert all({"units", "description"} <= set(entry.attrs) for name, entry in file.items() if name != "parameters")
        assert (file.attrs["scene"], file.attrs["over"]) == (SCENE, GRID)
        assert (file.attrs["segments"], file.attrs["chunk"]) == (4, CHUNK)


def test_the_command_says_what_it_did_and_resumes_a_complete_sweep(files, whole, capsys):
    arguments = ["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5"]
    assert main([*arguments, "--chunk", "4"]) == 0
    out, err = capsys.readouterr()
    assert "10 cases in 3 chunks of 4, 4 segments (finite_difference)" in out
    assert "10 of 10 cases converged" in out
    assert err == ""
    assert sorted(os.listdir()) == ["grid.toml", "out.h5", "scene.toml"]
    assert_same("out.h5", whole)
    # As after a kill between the two last things that it does.
    Path("out.h5.parts").mkdir()
    assert main([*arguments, "--resume"]) == 0
    assert "out.h5 is complete, nothing is left to do" in capsys.readouterr().out
    assert not Path("out.h5.parts").exists()
    assert main(arguments) == 2
    assert "out.h5 is there already" in capsys.readouterr().err


def stopped_after(count, monkeypatch):
    """Makes a sweep stop, as by Ctrl-C, when it has solved so many chunks; returns the numbers of cases it solves."""
    solved, solve = [], rodjax.sweeps.chunk.solve_batch

    def counted(scenes, **options):
        if len(solved) == count:
            raise KeyboardInterrupt
        solved.append(scenes.rod.length.shape[0])
        return solve(scenes, **options)

    monkeypatch.setattr("rodjax.sweeps.chunk.solve_batch", counted)
    return solved


def stopped(count, **options):
    with pytest.MonkeyPatch.context() as patch:
        stopped_after(count, patch)
        with pytest.raises(KeyboardInterrupt):
            sweep("scene.toml", "grid.toml", "out.h5", chunk=CHUNK, **options)


def test_a_stopped_sweep_goes_on_where_it_was(files, whole, capsys, monkeypatch):
    stopped(2)
    assert sorted(os.listdir("out.h5.parts")) == ["chunk-000000.h5", "chunk-000001.h5", "manifest.json"]
    assert main(["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5"]) == 2
    assert "go on with --resume, or remove the folder" in capsys.readouterr().err
    os.remove("out.h5.parts/chunk-000000.h5")
    Path("out.h5.parts/assembled.tmp").write_bytes(b"half a file")
    solved = stopped_after(-1, monkeypatch)
    assert main(["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--resume"]) == 0
    # The first chunk and the last, which is filled up.
    assert solved == [CHUNK, CHUNK]
    assert "resumed: 1 of 3 chunks are there" in capsys.readouterr().out
    assert_same("out.h5", whole)


def test_a_resumed_sweep_must_be_the_same(files, capsys):
    stopped(1)
    arguments = ["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--resume"]
    Path("scene.toml").write_text(SCENE.replace("785", "786"))
    Path("grid.toml").write_text(GRID.replace("0.004", "0.0041"))
    assert main([*arguments, "--chunk", "5", "--shard", "1/2"]) == 2
    err = capsys.readouterr().err
    said = "different in the scene file, the grid or table, chunk (4, not 5), shard (1/1, not 1/2)"
    assert f"out.h5.parts is of another sweep, {said}" in err
    manifest = json.loads(Path("out.h5.parts/manifest.json").read_text())
    Path("scene.toml").write_text(SCENE)
    Path("grid.toml").write_text(GRID)
    Path("out.h5.parts/manifest.json").write_text(json.dumps(manifest | {"version": "0.0.1"}))
    assert main(arguments) == 2
    assert f"different in the version of rodjax (0.0.1, not {rodjax.__version__})" in capsys.readouterr().err
    Path("out.h5.parts/manifest.json").write_text("{}")
    assert main(arguments) == 2
    assert "manifest.json is not of rodjax sweep" in capsys.readouterr().err


def test_merged_shards_are_the_whole(files, whole, capsys):
    command = ["sweep", "scene.toml", "--over", "grid.toml", "--chunk", "4"]
    for k in (1, 2):
        assert main([*command, "-o", f"{k}.h5", "--shard", f"{k}/2"]) == 0
    np.testing.assert_array_equal(contents("1.h5")["case"], [0, 1, 2, 3, 8, 9])
    assert main(["merge", "2.h5", "1.h5", "-o", "out.h5"]) == 0
    assert "10 of 10 cases converged" in capsys.readouterr().out
    assert_same("out.h5", whole)
    shutil.copy("1.h5", "copy.h5")
    for shards, said in [
        (["1.h5"], "all 2 shards are needed, missing: 2/2"),
        (["1.h5", "2.h5", "copy.h5"], "shard 1/2 is there twice: 1.h5 and copy.h5"),
        (["1.h5", str(whole)], "whole.h5 is shard 1/1, but 1.h5 is shard 1/2"),
    ]:
        with pytest.raises(SweepError, match=said):
            merge(shards, "bad.h5")
    with h5py.File("copy.h5", "a") as file:
        file.attrs["over_sha256"] = "0"
    with pytest.raises(SweepError, match=r"copy\.h5 does not belong to 2\.h5: different in the grid or table"):
        merge(["2.h5", "copy.h5"], "bad.h5")


@pytest.mark.parametrize("options", [{"threads": 2}, {"executor": "that fails once"}])
def test_whoever_solves_the_chunks_the_result_is_the_same(options, files, whole, capsys):
    if "executor" in options:
        options = {"executor": Unreliable(lambda number: number == 1)}
    sweep("scene.toml", "grid.toml", "out.h5", chunk=CHUNK, progress=True, **options)
    assert_same("out.h5", whole)
    assert "10/10" in capsys.readouterr().err
    assert sorted(os.listdir()) == ["grid.toml", "out.h5", "scene.toml"]


def test_an_executor_that_fails_leaves_finished_chunks(files, whole):
    with Unreliable(lambda number: number > 0) as engine, pytest.raises(SweepError) as caught:
        sweep("scene.toml", "grid.toml", "out.h5", chunk=CHUNK, executor=engine)
    said = (
        r"task \d failed 4 times: ConnectionError: the worker is lost; the finished chunks are in out\.h5\.parts: go on"
    )
    assert re.match(said, str(caught.value))
    left = set(os.listdir("out.h5.parts"))
    assert left <= {"chunk-000000.h5", "manifest.json"}
    sweep("scene.toml", "grid.toml", "out.h5", resume=True)
    assert_same("out.h5", whole)


HOLD = """
import sys, time
from pathlib import Path
from rodjax.file_lock import locked
with locked(Path("out.h5")):
    print("locked", flush=True)
    time.sleep(600)
"""


def test_two_processes_at_one_sweep_are_told_so(files, whole, capsys):
    process = subprocess.Popen([sys.executable, "-c", HOLD], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process, process.stdout:
        assert process.stdout.readline() == "locked\n"
        command = ["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--chunk", "4", "--resume"]
        assert main(command) == 2
        err = capsys.readouterr().err
        assert re.fullmatch(rf"rodjax: out\.h5 is being written by process {process.pid} on \S+; wait .*\n", err)
        # The lock ends with its process, however that ends.
        process.kill()
        process.wait()
        assert main(command) == 0
    assert_same("out.h5", whole)
    assert not Path("out.h5.lock").exists()


def test_cases_that_do_not_converge_are_counted(files, capsys, monkeypatch):
    solve = rodjax.sweeps.chunk.solve_batch

    def seldom(scenes, **options):
        result = solve(scenes, **options)
        return eqx.tree_at(lambda result: result.converged, result, scenes.rod.EI > 4.5e-3)

    monkeypatch.setattr("rodjax.sweeps.chunk.solve_batch", seldom)
    assert main(["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--chunk", "4"]) == 3
    out, err = capsys.readouterr()
    assert "5 of 10 cases converged" in out
    assert err == "rodjax: out.h5: 5 of 10 cases not converged: 0, 1, 2, 3, 4\n"
    assert summary(Path("out.h5")).failed == [0, 1, 2, 3, 4]


def test_cases_that_are_strained_too_much_are_told(files, capsys):
    Path("scene.toml").write_text(SCENE + "strain_limit = 1e-5\n")
    assert main(["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--chunk", "4"]) == 0
    out, err = capsys.readouterr()
    assert "10 of 10 cases converged" in out
    # The weight of 1 N on EA = 785 N strains all of them by 1e-4 and more.
    assert (
        err == f"rodjax: out.h5: 10 of 10 cases strained by more than strain_limit: {', '.join(map(str, range(10)))}\n"
    )
    np.testing.assert_array_equal(contents("out.h5")["status"], 10 * [rodjax.Status.OVERSTRETCHED])


def test_without_segments_the_first_case_decides_on_the_mesh(files, whole, capsys, monkeypatch):
    Path("scene.toml").write_text(SCENE.replace("segments = 4", "rtol = 0.1"))
    asked = []

    def solve(scene, **options):
        asked.append((float(scene.rod.EI), float(scene.end.position[0]), options))
        return types.SimpleNamespace(s=np.zeros(5), discretization="finite_difference")

    monkeypatch.setattr("rodjax.sweeps.sweep.solve", solve)
    sweep("scene.toml", "grid.toml", "out.h5", chunk=CHUNK, say=print)
    assert asked == [(0.004, pytest.approx(0.7), {"rtol": 0.1, "discretization": "finite_difference"})]
    assert "4 segments (finite_difference), as case 0 needs for rtol = 0.1" in capsys.readouterr().out
    np.testing.assert_array_equal(contents("out.h5")["nodes"], contents(whole)["nodes"])


@pytest.mark.slow
def test_the_mesh_of_the_first_case_serves_cases_like_it(files, by_numpy_code):
    Path("scene.toml").write_text(SCENE.replace('segments = 4\ndiscretization = "finite_difference"', ""))
    sweep("scene.toml", "grid.toml", "out.h5", chunk=CHUNK)
    found = contents("out.h5")
    assert found["attribute discretization"] == "hermite"
    assert found["nodes"].shape == (10, found["attribute segments"] + 1, 3)
    assert np.all(found["error_estimate"] < 2e-3)


# At 4 segments the last two of five cases have estimated errors of 0.012 and 0.34, the others at most 0.009.
ROUGH = SCENE.replace('segments = 4\ndiscretization = "finite_difference"', "rtol = 0.01")
SHARP = '"end.position.0" = [0.9, 0.8, 0.6, 0.4, 0.2]\n'


@pytest.mark.slow
def test_every_case_is_within_rtol_or_counted(files, capsys, monkeypatch, by_numpy_code):
    Path("scene.toml").write_text(ROUGH)
    Path("grid.toml").write_text(SHARP)
    command = ["sweep", "scene.toml", "--over", "grid.toml", "-o"]
    assert main([*command, "out.h5"]) == 0
    out, err = capsys.readouterr()
    assert "5 of 5 cases converged, error of the shape" in out
    assert err == ""
    found = contents("out.h5")
    assert np.all(found["error_estimate"] <= 0.01)
    np.testing.assert_array_equal(found["segments"], [4, 4, 4, 16, 16])
    assert found["nodes"].shape == (5, 5, 3)
    # What is written of the finer meshes is theirs: the last case as solved on 16 segments, to the solver's tolerance.
    scenes = CaseReader(Path("scene.toml"), Path("grid.toml")).scenes(np.arange(5))
    fine = rodjax.solve_batch(scenes, segments=16, guess=rodjax.solve_batch(scenes, segments=4))
    np.testing.assert_allclose(found["nodes"][4], fine.nodes[4, ::4], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found["energy"][4], fine.energy[4], rtol=1e-6)
    # In chunks, which are the same whatever the shard, and without a finer mesh.
    for k in (1, 2):
        assert main([*command, f"{k}.h5", "--chunk", "3", "--shard", f"{k}/2"]) == 0
    assert main(["merge", "1.h5", "2.h5", "-o", "merged.h5"]) == 0
    np.testing.assert_array_equal(contents("merged.h5")["segments"], found["segments"])
    capsys.readouterr()
    monkeypatch.setitem(SIZES, "hermite", (4,))
    assert main([*command, "rough.h5"]) == 3
    out, err = capsys.readouterr()
    assert "5 of 5 cases converged, 2 of them not to rtol = 0.01, error of the shape up to about 3e-01" in out
    assert err == "rodjax: rough.h5: 2 of 5 cases above rtol = 0.01 on the finest mesh: 3, 4\n"
    assert summary(Path("rough.h5")).missed == [3, 4]
    # A batch is solved on one mesh, and says how many cases miss the tolerance there.
    with pytest.warns(rodjax.NotConvergedWarning, match=r"3.7e-01 .* above rtol = 0.01 in 2 of 5 cases on the"):
        rodjax.solve_batch(scenes, rtol=0.01)


@pytest.mark.slow
def test_quantities_are_chosen_by_name(files, capsys, by_numpy_code):
    """Those of single solves on the same mesh, to the solver's tolerance; and as a table."""
    scene = SCENE.replace('segments = 4\ndiscretization = "finite_difference"', "segments = 16")
    scene = scene.replace("[rod]", '[rod]\nradius = "4 mm"')
    clip, floor = '\n[[clips]]\nat = "0.3 m"\nposition = "[0.25, 0, -0.02] m"\n', '\n[[obstacles]]\nkind = "plane"\n'
    Path("scene.toml").write_text(scene + clip + floor + 'point = "[0, 0, -0.15] m"\nnormal = [0, 0, 1]\n')
    Path("grid.toml").write_text('"rod.EI" = [0.004, 0.005]\n')
    command = [
        "sweep",
        "scene.toml",
        "--over",
        "grid.toml",
        "-o",
        "out.h5",
        "--csv",
        "out.csv",
        "--parquet",
        "out.parquet",
    ]
    assert main([*command, "--also", ",".join(QUANTITIES)]) == 0
    found = contents("out.h5")
    scenes = CaseReader(Path("scene.toml"), Path("grid.toml")).scenes(np.arange(2))
    alone = rodjax.solve(scenes[1], segments=16)
    assert found["clip_forces"].shape == (2, 1, 3)
    np.testing.assert_allclose(found["clip_forces"][1], alone.clip_forces, atol=1e-6)
    np.testing.assert_allclose(found["obstacle_forces"][1], np.sum(alone.obstacle_forces, axis=1), atol=1e-6)
    np.testing.assert_allclose(
        found["clearance"][1], rodjax.clearance(alone, alone.scene.obstacles).distance, atol=1e-6
    )
    np.testing.assert_allclose(found["bend_radius"][1], 1 / np.max(curvature_along(alone)[1]), rtol=1e-5)
    np.testing.assert_allclose(found["largest_tension"][1], np.max(alone.tension), atol=1e-6)
    table = np.genfromtxt("out.csv", delimiter=",", names=True, deletechars="", replace_space=" ")
    np.testing.assert_array_equal(table["clip_forces.0.2 [N]"], found["clip_forces"][:, 0, 2])
    np.testing.assert_array_equal(table["rod.EI [N m^2]"], [0.004, 0.005])
    assert table.dtype.names[0] == "case [1]"
    typed = pyarrow.parquet.read_table("out.parquet")
    assert typed.column_names == list(table.dtype.names)
    np.testing.assert_array_equal(typed["clip_forces.0.2 [N]"], found["clip_forces"][:, 0, 2])
    assert typed.schema.field("converged [1]").type == pyarrow.bool_()
    # Another choice is another sweep.
    capsys.readouterr()
    assert main([*command, "--resume", "--also", "clip_forces"]) == 2
    assert "different in also" in capsys.readouterr().err


def test_without_pyarrow_a_parquet_file_is_refused_before_the_sweep(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    command = ["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--parquet", "out.parquet"]
    assert main(command) == 2
    assert capsys.readouterr().err == "rodjax: Parquet files need pyarrow: pip install 'rodjax[parquet]'\n"
    assert not Path("out.h5").exists()


def test_quantities_that_a_scene_lacks_are_named(files):
    with pytest.raises(SweepError, match=r"also: clip_forces needs a scene with clips, got one without"):
        sweep("scene.toml", "grid.toml", "out.h5", also=["clip_forces"])
    with pytest.raises(SweepError, match=r"also must be some of bend_radius, clearance, .*, got 'bending'"):
        sweep("scene.toml", "grid.toml", "out.h5", also=["bending"])


@pytest.mark.slow
def test_a_killed_sweep_loses_nothing(files, whole):
    command = [sys.executable, "-W", "error", "-m", "rodjax", "sweep", "scene.toml", "--over", "grid.toml"]
    command += ["-o", "out.h5", "--chunk", "4"]
    process = subprocess.Popen(command)
    deadline = time.monotonic() + 300
    while not Path("out.h5.parts/chunk-000000.h5").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(1e-3)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not Path("out.h5").exists()
    resumed = subprocess.run([*command, "--resume"], capture_output=True, text=True, check=True)
    assert "resumed: " in resumed.stdout
    assert_same("out.h5", whole)


def test_friction_is_refused(files):
    """It acts along a path, and cases of a sweep are none."""
    floor = '[[obstacles]]\nkind = "plane"\npoint = "[0, 0, -20] cm"\nnormal = [0, 0, 1]\nfriction = 0.3\n'
    scene = SCENE.replace("[rod]", '[rod]\nradius = "5 mm"').replace("finite_difference", "hermite")
    Path("scene.toml").write_text(scene + floor)
    with pytest.raises(SweepError, match=r"scene.toml: obstacles\[0\].friction must be 0 in a sweep"):
        sweep("scene.toml", "grid.toml", "sweep.h5", chunk=CHUNK)
