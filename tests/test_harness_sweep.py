"""Sweeps of harness files, beside single solves."""

import csv

import h5py
import numpy as np
import pytest

import rodjax as rj
from rodjax.sweeps.cases import SweepError
from rodjax.sweeps.result import merge, write_csv

ROD = 'section = "circular"\nlength = "50 cm"\nradius = "5 mm"\nyoungs_modulus = "10 MPa"\npoisson_ratio = 0.5\n'
HARNESS = f"""
[cables.a.rod]
{ROD}density = "1200 kg/m^3"
[cables.a.start]
support = "clamp"
position = "[0, 0, 0] m"
tangent = [1, 0, -1]
d2 = [0, 1, 0]
[cables.a.end]
support = "joint"
joint = "cut"
[cables.2.rod]
{ROD}density = "1200 kg/m^3"
[cables.2.start]
support = "joint"
joint = "cut"
[cables.2.end]
support = "clamp"
position = "[50, 20, 0] cm"
tangent = [1, 1, 1]
d2 = [1, -1, 0]
[joints.cut]
mass = "20 g"
[loads]
gravity = "[0, 0, -9.81] m/s^2"
[solve]
segments = 4
"""
GRID = '"cables.2.end.position.2" = [0.0, "-0.1 m"]\n"joints.cut.mass" = ["10 g", 0.03]\n'


def files(folder, harness=HARNESS, grid=GRID):
    scene, over = folder / "harness.toml", folder / "grid.toml"
    scene.write_text(harness)
    over.write_text(grid)
    return scene, over, folder / "sweep.h5"


def single(folder, z: float, mass: str) -> rj.HarnessEquilibrium:
    path = folder / "single.toml"
    path.write_text(HARNESS.replace("[50, 20, 0] cm", f"[0.5, 0.2, {z}] m").replace("20 g", mass))
    harness = rj.read_scene(path)
    assert isinstance(harness, rj.Harness)
    return rj.solve(harness, segments=4)


def test_cases_of_a_sweep_are_those_of_single_solves(tmp_path):
    """By chunks of 3, of which the last is filled up, and as two shards put together."""
    scene, over, output = files(tmp_path)
    summary = rj.sweep(scene, over, output, chunk=3, also=["bend_radius"])
    assert (summary.cases, summary.failed) == (4, [])
    singles = [single(tmp_path, z, mass) for z in (0.0, -0.1) for mass in ("10 g", "30 g")]
    with h5py.File(output) as file:
        names = ("energy", "cables/2/nodes", "joints/cut/position", "error_estimate")
        found = {name: np.asarray(file[name]) for name in names}
        assert file["cables/a/end_force"].attrs["units"] == "N"
        assert file["parameters/joints.cut.mass"].attrs["units"] == "kg"
        assert "cables/a/bend_radius" in file
    # By the same program, from the same start.
    for k, one in enumerate(singles):
        np.testing.assert_allclose(found["energy"][k], one.energy, rtol=1e-12)
        np.testing.assert_allclose(found["cables/2/nodes"][k], one["2"].nodes, atol=1e-12)
        np.testing.assert_allclose(found["joints/cut/position"][k], one.joints["cut"].position, atol=1e-12)
    errors = [max(float(rod.error_estimate) for rod in one.values()) for one in singles]
    np.testing.assert_allclose(found["error_estimate"], errors, rtol=1e-9)
    write_csv(output, tmp_path / "sweep.csv")
    rows = list(csv.DictReader((tmp_path / "sweep.csv").read_text().splitlines()))
    assert float(rows[3]["cables.2.end_force.2 [N]"]) == pytest.approx(float(singles[3]["2"].end_force[2]), rel=1e-9)
    assert float(rows[2]["cables.2.end.position.2 [m]"]) == -0.1
    shards = [tmp_path / f"shard {k}.h5" for k in (1, 2)]
    for k, shard in enumerate(shards, 1):
        rj.sweep(scene, over, shard, chunk=3, shard=(k, 2), also=["bend_radius"])
    merge(shards, tmp_path / "merged.h5")
    with h5py.File(tmp_path / "merged.h5") as merged:
        np.testing.assert_array_equal(np.asarray(merged["cables/2/nodes"]), found["cables/2/nodes"])


@pytest.mark.slow
def test_cases_that_need_finer_meshes_get_them(tmp_path):
    """On the mesh of a loose tolerance for the first case, and then for all."""
    grid = '"cables.2.rod.youngs_modulus" = ["10 MPa", "0.3 MPa"]\n'
    scene, over, output = files(tmp_path, HARNESS.replace("segments = 4", "rtol = 1e-4"), grid)
    summary = rj.sweep(scene, over, output)
    assert (summary.failed, summary.missed) == ([], [])
    with h5py.File(output) as file:
        names = ("segments", "error_estimate", "cables/2/nodes")
        segments, errors, nodes = (np.asarray(file[name]) for name in names)
    assert segments[1] > segments[0]
    assert np.max(errors) <= 1e-4
    assert nodes.shape[1] == segments[0] + 1


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ('"cables.3.rod.length" = [0.5]', "cables.3 is not there, so that cables.3.rod.length cannot vary"),
        ('"cables.a.end.joint" = [0.5]', "cables.a.end.joint cannot vary; allowed are the keys of rod"),
        ('"joints.y.mass" = [0.5]', "joints.y is not there"),
        ('"rod.length" = [0.5]', "rod is not there, so that rod.length cannot vary"),
        ('"cables.a.rod.length" = [-1]', "case 0: cables.a.rod.length must be positive"),
    ],
)
def test_keys_of_a_harness_are_checked(tmp_path, grid, message):
    with pytest.raises(SweepError, match=message):
        rj.sweep(*files(tmp_path, grid=grid))


def test_quantities_that_a_cable_lacks_are_refused(tmp_path):
    with pytest.raises(SweepError, match="also: clip_forces needs a scene with clips, got one without: the cable 'a'"):
        rj.sweep(*files(tmp_path), also=["clip_forces"])
