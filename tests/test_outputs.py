"""What other programs get of a result: a picture in VTK's own reader and tube filter, tables, a spline for CAD."""

import csv
import sys

import jax
import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkTubeFilter
from vtkmodules.vtkIOHDF import vtkHDFReader

import rodjax as rj
from rodjax import problems
from rodjax.cli import main
from rodjax.io.scene_writing import write_scene

START = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0)))


def touching_scene(turn: float = 0.3) -> rj.Scene:
    """A cable of 1 m that a clip holds and a floor carries; the end frame turned by `turn`."""
    end = rj.Clamp((0.7, 0.1, 0.0), rj.frame((1, 0, 0), (0, np.cos(turn), np.sin(turn))))
    return rj.Scene(
        problems.cable(),
        START,
        end,
        (0.0, 0.0, -9.81),
        clips=[rj.Clip(0.3, (0.25, 0.0, -0.02))],
        obstacles=[rj.Plane((0, 0, -0.12), (0, 0, 1)), rj.Cylinder((0.3, -0.2, 0.1), (0.3, 0.2, 0.1), 0.03)],
    )


@pytest.fixture(scope="module")
def touching() -> rj.Equilibrium:
    found = rj.solve(touching_scene(), segments=16)
    assert bool(found.converged)
    assert float(np.linalg.norm(found.contact_forces)) > 0.01
    return found


@pytest.fixture(scope="module")
def two_planes() -> rj.Equilibrium:
    """Of a rod with a shape of its own, whose frames are the unknowns."""
    rod = rj.Rod(1.0, (4e-3, 6e-3), 3e-3, 500.0, radius=4e-3, rest_curvature=(0.5, 1.0), rest_twist=0.4)
    end = rj.Clamp((0.6, 0.2, 0.1), rj.frame((1, 0.3, 0)))
    found = rj.solve(rj.Scene(rod, START, end), segments=16)
    assert bool(found.converged)
    return found


@pytest.fixture(scope="module")
def sheared() -> rj.Equilibrium:
    """Of a short thick rod, whose sections lean by up to some degrees."""
    rod = rj.Rod(1.0, 4e-3, 3e-3, 500.0, radius=4e-3, GA=0.5)
    found = rj.solve(rj.Scene(rod, START, rj.Clamp((0.7, 0.2, 0.1), rj.frame((1, 0.3, 0)))), segments=16)
    assert bool(found.converged)
    return found


def parts_at(path, step: int = 0) -> dict:
    """What VTK reads of a step, `vtkPolyData` by the names of the parts."""
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.SetStep(step)
    reader.Update()
    whole = reader.GetOutputDataObject(0)
    names = [whole.GetMetaData(k).Get(whole.NAME()) for k in range(whole.GetNumberOfPartitionedDataSets())]
    copies = {}
    for k, name in enumerate(names):
        copies[name] = whole.GetPartition(k, 0).NewInstance()
        copies[name].DeepCopy(whole.GetPartition(k, 0))
    return copies


def points_of(part) -> np.ndarray:
    return vtk_to_numpy(part.GetPoints().GetData())


def data_of(part, name: str) -> np.ndarray:
    return vtk_to_numpy(part.GetPointData().GetArray(name))


def distances(points: np.ndarray, equilibrium: rj.Equilibrium) -> np.ndarray:
    """From the centerline, by chords of 1/4000 of the length: their sagitta is below 1e-7 of it."""
    s = np.linspace(0.0, float(equilibrium.s[-1]), 4001)
    line = np.asarray(equilibrium.position_at(s))
    found = []
    for point in points:
        k = np.clip(np.argmin(np.sum((line - point) ** 2, axis=1)), 1, len(line) - 2)
        way = line[k + 1] - line[k - 1]
        part = np.clip((point - line[k - 1]) @ way / (way @ way), 0, 1)
        found.append(np.linalg.norm(point - line[k - 1] - part * way))
    return np.array(found)


# --- VTK ------------------------------------------------------------------------------------------------------------


def test_vtk_makes_the_tube_of_the_rod(touching, tmp_path):
    """Its tube filter of 60 sides, whose points are at the radius of the rod from `position_at`, to 1e-4 L."""
    rj.save(touching, tmp_path / "rod.vtkhdf")
    cable = parts_at(tmp_path / "rod.vtkhdf")["cable"]
    assert cable.GetNumberOfLines() == cable.GetNumberOfCells() == 1
    assert cable.GetNumberOfPoints() < 400
    cable.GetPointData().SetActiveScalars("radius [m]")
    tube = vtkTubeFilter()
    tube.SetInputData(cable)
    tube.SetVaryRadiusToVaryRadiusByAbsoluteScalar()
    tube.SetNumberOfSides(60)
    tube.Update()
    around = points_of(tube.GetOutput())
    reach = distances(around[:: max(1, len(around) // 900)], touching)
    np.testing.assert_allclose(reach, 5e-3, atol=1e-4)
    # And the middles of its chords, where they are furthest from the curve.
    points = points_of(cable)
    assert np.max(distances((points[1:] + points[:-1]) / 2, touching)) < 1e-4


def test_the_nodes_are_marked_and_what_is_along_the_rod_is_there(touching, tmp_path):
    rj.save(touching, tmp_path / "rod.vtkhdf")
    cable = parts_at(tmp_path / "rod.vtkhdf")["cable"]
    is_node = data_of(cable, "node").astype(bool)
    np.testing.assert_array_equal(points_of(cable)[is_node], touching.nodes)
    np.testing.assert_array_equal(data_of(cable, "arclength [m]")[is_node], touching.s)
    for name, field in (("twist [rad m^-1]", "twist"), ("tangent", "tangents")):
        np.testing.assert_allclose(data_of(cable, name)[is_node], getattr(touching, field), atol=1e-9)
    # Straight but for its bend: radius and curvature are inverse to one another where neither is capped.
    radius, curvature = data_of(cable, "bend radius [m]"), data_of(cable, "curvature [m^-1]")
    np.testing.assert_allclose(np.minimum(1 / curvature, 1e3), radius, rtol=1e-12)
    np.testing.assert_allclose(data_of(cable, "moment [N m]")[-1], touching.end_moment, atol=1e-12)
    # By the trapezoidal rule over the nodes the contact force is that of the nodes.
    line = data_of(cable, "contact force [N m^-1]")[is_node]
    np.testing.assert_allclose(
        np.trapezoid(line, touching.s, axis=0), np.sum(touching.contact_forces, axis=0), atol=1e-9
    )


def test_supports_clips_and_obstacles_are_parts(touching, tmp_path):
    rj.save(touching, tmp_path / "rod.vtkhdf")
    parts = parts_at(tmp_path / "rod.vtkhdf")
    assert list(parts) == ["cable", "supports", "clips", "obstacle_0", "obstacle_1"]
    supports = parts["supports"]
    np.testing.assert_allclose(points_of(supports), [(0, 0, 0), (0.25, 0, -0.02), (0.7, 0.1, 0)], atol=1e-9)
    forces = data_of(supports, "force on the rod [N]")
    weight = 9.81 * float(touching.scene.rod.mean_mass_per_length)
    pushed = np.sum(touching.contact_forces, axis=0)
    # Together with the floor they carry the weight, to the residual.
    np.testing.assert_allclose(np.sum(forces, axis=0) + pushed, [0, 0, weight], atol=1e-6)
    # The collar lies around the clip, the floor at its height, the bar on its radius.
    assert np.max(np.linalg.norm(points_of(parts["clips"]) - [0.25, 0, -0.02], axis=1)) < 0.02
    np.testing.assert_allclose(points_of(parts["obstacle_0"])[:, 2], -0.12, atol=1e-12)
    bar = np.linalg.norm(points_of(parts["obstacle_1"])[:, [0, 2]] - [0.3, 0.1], axis=1)
    assert np.max(bar) == pytest.approx(0.03)
    assert parts["obstacle_0"].GetNumberOfPolys() > 10


@pytest.mark.slow
def test_a_path_has_its_parts_at_every_step(touching, tmp_path):
    path = rj.solve_path([touching_scene(turn) for turn in (0.3, 0.5)], segments=16, guess=touching)
    rj.save(path, tmp_path / "rod.vtkhdf")
    for k in range(2):
        step = jax.tree.map(lambda leaf, k=k: leaf[k], path)
        parts = parts_at(tmp_path / "rod.vtkhdf", k)
        assert len(parts) == 5
        is_node = data_of(parts["cable"], "node").astype(bool)
        np.testing.assert_array_equal(points_of(parts["cable"])[is_node], step.nodes)
        assert np.max(distances(points_of(parts["cable"])[::7], step)) < 1e-4
        held = data_of(parts["supports"], "force on the rod [N]")
        np.testing.assert_allclose(held[-1], step.end_force, atol=1e-12)
        assert parts["obstacle_1"].GetNumberOfPolys() > 10


# --- tables ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["touching", "two_planes", pytest.param("sheared", marks=pytest.mark.slow)])
def test_force_and_moment_along_the_rod_balance(name, request):
    """Between a place and the end, where nothing but the support acts on the rod: M = M_end + (r_end - r) x F_end and
    F = F_end, less the weight. Sixteen elements of fourth order leave 1e-3 of the largest moment.
    """
    result = request.getfixturevalue(name)
    s = np.linspace(0.85, 1.0, 40) if name == "touching" else np.linspace(0.0, 1.0, 90)
    table = rj.centerline_table(result, s)
    points, forces, moments = (
        np.stack([table[f"{kind}{axis} [{unit}]"] for axis in "xyz"], axis=1)
        for kind, unit in (("", "m"), ("force_", "N"), ("moment_", "N m"))
    )
    density = float(result.scene.rod.mean_mass_per_length)
    weight = density * np.array([0, 0, -9.81]) if result.scene.gravity is not None else np.zeros(3)
    beyond = (1.0 - s)[:, None] * weight
    np.testing.assert_allclose(forces, np.asarray(result.end_force) + beyond, atol=1e-9)
    # The weight beyond acts at its middle, by the trapezoidal rule over the rest of the rod.
    expected = np.asarray(result.end_moment) + np.cross(points[-1] - points, np.asarray(result.end_force))
    for k in range(len(s)):
        arms = np.cross(points[k:] - points[k], weight)
        expected[k] += np.trapezoid(arms, s[k:], axis=0)
    largest = np.max(np.linalg.norm(moments, axis=1))
    np.testing.assert_allclose(moments, expected, atol=2e-3 * largest)


@pytest.mark.slow
def test_the_moment_between_nodes_is_that_of_the_curvature():
    """EI kappa of a cable that hangs without twist; on 8 elements as near to 32 as fourth order comes."""
    coarse, fine = (rj.solve(problems.hanging_cable(), segments=n) for n in (8, 32))
    s = np.linspace(0.0, 1.0, 101)
    tables = [rj.centerline_table(result, s) for result in (coarse, fine)]
    EI = float(fine.scene.rod.EI)
    sizes = [np.linalg.norm([t[f"moment_{axis} [N m]"] for axis in "xyz"], axis=0) for t in tables]
    np.testing.assert_allclose(sizes[1], EI * tables[1]["curvature [1/m]"], atol=1e-3 * np.max(sizes[1]))
    np.testing.assert_allclose(sizes[0], sizes[1], atol=1e-2 * np.max(sizes[1]))
    np.testing.assert_allclose(tables[1]["bend_radius [m]"] * tables[1]["curvature [1/m]"], 1.0, rtol=1e-12)


@pytest.mark.parametrize("name", ["two_planes", pytest.param("sheared", marks=pytest.mark.slow)])
def test_a_table_has_the_nodes_and_orthonormal_frames_between_them(name, request):
    result = request.getfixturevalue(name)
    table = rj.centerline_table(result)
    assert set(np.asarray(result.s)) <= set(table["s [m]"])
    frames = np.stack([[table[f"{d}_{axis} [1]"] for axis in "xyz"] for d in ("d1", "d2", "t")], axis=-1)
    frames = np.moveaxis(frames, 1, 0)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-9)
    at = np.isin(table["s [m]"], np.asarray(result.s))
    np.testing.assert_allclose(frames[at], result.frames, atol=2e-4)
    assert len(rj.centerline_table(result, 7)["s [m]"]) == 7


def test_tables_of_finite_differences_have_no_forces():
    result = rj.solve(problems.hanging_cable(), segments=8, discretization="finite_difference")
    table = rj.centerline_table(result)
    assert "tension [N]" in table
    assert not any(name.startswith(("force", "moment")) for name in table)


def test_what_makes_no_table_is_refused(two_planes, tmp_path):
    with pytest.raises(ValueError, match=r"s must lie in 0 to 1 m, got 0 to 2 m"):
        rj.centerline_table(two_planes, [0.0, 2.0])
    with pytest.raises(ValueError, match=r"s must be at least 2 equally spaced arclengths, got 1"):
        rj.centerline_table(two_planes, 1)
    stack = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), two_planes)
    with pytest.raises(ValueError, match=r"must be a single one, got a stack of shape \(2,\)"):
        rj.centerline_table(stack)
    with pytest.raises(ValueError, match=r"must end in \.csv"):
        rj.write_table(two_planes, tmp_path / "a.txt")


def test_a_table_of_a_path_says_the_step(two_planes, tmp_path):
    rj.write_table(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), two_planes), tmp_path / "a.csv", 5)
    rows = list(csv.reader((tmp_path / "a.csv").read_text().splitlines()))
    assert rows[0][:2] == ["step", "s [m]"]
    assert [row[0] for row in rows[1:]] == ["0"] * 5 + ["1"] * 5


# --- CAD, and the command line --------------------------------------------------------------------------------------


def test_the_spline_is_the_centerline(touching, tmp_path):
    ezdxf = pytest.importorskip("ezdxf")
    rj.write_dxf(touching, tmp_path / "rod.dxf")
    drawing = ezdxf.readfile(tmp_path / "rod.dxf")
    assert not drawing.audit().errors
    assert drawing.units == 4  # millimetres
    (spline,) = drawing.modelspace().query("SPLINE")
    curve = spline.construction_tool()
    points = np.array([tuple(point) for point in curve.points(np.linspace(0, curve.max_t, 500))]) / 1e3
    assert np.max(distances(points, touching)) < 1e-5
    np.testing.assert_allclose(points[[0, -1]], np.asarray(touching.nodes)[[0, -1]], atol=1e-9)
    (clip,) = drawing.modelspace().query("POINT")
    np.testing.assert_allclose(tuple(clip.dxf.location), (250, 0, -20), atol=1e-9)


def test_a_missing_library_is_named(two_planes, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(ImportError, match=r"write_dxf needs ezdxf: pip install 'rodjax\[cad\]'"):
        rj.write_dxf(two_planes, tmp_path / "rod.dxf")


def test_solve_writes_tables_splines_and_pictures_with_surroundings(tmp_path, capsys, touching):
    scene = tmp_path / "scene.toml"
    write_scene(touching_scene(), scene, segments=16)
    files = [tmp_path / f"rod.{suffix}" for suffix in ("csv", "dxf", "png")]
    options = ["--csv", str(files[0]), "--dxf", str(files[1]), "--plot", str(files[2])]
    assert main(["solve", str(scene), *options]) == 0
    assert capsys.readouterr().err == ""
    table = np.genfromtxt(files[0], delimiter=",", names=True, deletechars="")
    expected = rj.centerline_table(touching)
    np.testing.assert_allclose(table["moment_y_[N_m]"], expected["moment_y [N m]"], atol=1e-9)
    assert b"SPLINE" in files[1].read_bytes()
    assert files[2].stat().st_size > 10_000
    assert main(["solve", str(scene), "--csv", "a.txt"]) == 2
    assert "--csv must end in .csv" in capsys.readouterr().err


def test_pictures_show_clips_and_obstacles(touching, monkeypatch):
    drawn = []
    monkeypatch.setattr("rodjax.drawing.draw_faces", lambda axes, faces, colors, *rest: drawn.append((faces, colors)))
    from rodjax.drawing import CLIP_COLOR, OPACITY, to_rgba
    from rodjax.plot import plot_rod

    plot_rod(touching)
    ((faces, colors),) = drawn
    assert np.any(np.all(colors == to_rgba(CLIP_COLOR), axis=1))
    floor = faces[np.isclose(colors[:, 3], OPACITY)]
    assert np.any(np.all(np.isclose(floor[..., 2], -0.12), axis=1))
