"""Routes as files: what `rodjax report` reads, writes and refuses."""

import json
import re
import shutil
import textwrap
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh

import rodjax as rj
from rodjax.cli import main
from rodjax.io.scene_keys import SceneVariations
from rodjax.routing import files as routing_files
from rodjax.routing.files import read_route_file
from rodjax.routing.report import FILES
from rodjax.routing.route import Starts
from rodjax.routing.variables import Between, OnLine, OnPatch, Turned
from rodjax.solving.solve import solve

ROUTES = Path(__file__).parents[1] / "experiments" / "routes"


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A copy of the example in the working folder, in which nothing is solved."""
    for name in ("brake_line.toml", "scene.toml"):
        shutil.copy(ROUTES / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rj, "solve", lambda *args, **options: pytest.fail("solved"))
    return tmp_path


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The folder that `rodjax report` made of the example, with a result of its scene."""
    folder = tmp_path_factory.mktemp("report")
    assert main(["solve", str(ROUTES / "scene.toml"), "-o", str(folder / "result.vtkhdf")]) == 0
    # Before it is routed the line does not keep to all limits.
    assert main(["report", str(ROUTES / "brake_line.toml"), "--out", str(folder / "out")]) == 3
    return folder


def changed(name, old, new):
    text = Path(name).read_text()
    assert old in text
    Path(name).write_text(text.replace(old, new, 1))


def refused(capsys, *options):
    """The one line on stderr."""
    assert main(["report", "brake_line.toml", *options]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("rodjax: ")
    assert err.count("\n") == 1
    assert not Path("rodjax-report").exists()
    return err


# --- what the files say ----------------------------------------------------------------------------------------------


def test_the_example_is_read(files):
    read = read_route_file("brake_line.toml")
    assert list(read.cables) == ["cable"]
    assert read.cables["cable"].scenes[0].clips[1].at == 0.42
    assert (read.title, read.names, read.starts) == ("Brake line", ("floor", "pipe", "bracket"), 4)
    floor, pipe, bracket = read.obstacles
    np.testing.assert_allclose(floor.point, [0, 0, -0.02])
    assert isinstance(pipe, rj.Capsule)
    assert pipe.radius == 0.02
    np.testing.assert_allclose(bracket.size, [0.1, 0.08, 0.06])
    np.testing.assert_allclose(bracket.frame[:, 0], [0.8, 0.6, 0])
    assert read.limits.bend_radius == 5
    assert read.limits.twist == pytest.approx(np.pi)
    assert read.limits.clearance == 0.008
    assert read.limits.mass is None
    assert [type(variable) for variable in read.variables] == [Between, Between, Between, Turned, Between]
    np.testing.assert_allclose(read.variables[1].upper, [0.2, 0.04, 0.11])
    assert float(read.objective.length) == 1


def test_the_example_of_the_documentation_is_read(files):
    blocks = routing_files.__doc__.split("\n\n")
    toml = "\n".join(textwrap.dedent(block) for block in blocks if block.startswith("    "))
    content = tomllib.loads(toml)
    assert {"scene", "title", "starts", "obstacles", "limits", "variables", "objective"} == set(content)
    Path("documented.toml").write_text(toml)
    read = read_route_file("documented.toml")
    assert [type(variable) for variable in read.variables[:3]] == [Between, OnLine, OnPatch]
    # All limits that there are.
    assert all(getattr(read.limits, name) is not None for name in read.limits.__dataclass_fields__)


def test_a_scene_may_be_in_the_file_and_cables_several(files):
    tables = Path("scene.toml").read_text()
    changed("brake_line.toml", 'scene = "scene.toml"\n', "")
    Path("brake_line.toml").write_text(Path("brake_line.toml").read_text() + tables)
    assert len(read_route_file("brake_line.toml").cables["cable"].scenes[0].clips) == 2
    Path("two.toml").write_text('cables = { "a b" = "scene.toml", c = "scene.toml" }')
    assert list(read_route_file("two.toml").cables) == ["a b", "c"]
    assert read_route_file("two.toml", with_scene=False).cables == {}


def test_obstacles_of_a_file_that_is_a_scene_are_those_of_the_scene(files):
    floor = """

[[obstacles]]
kind = "plane"
point = "[0, 0, -1] m"
normal = [0, 0, 1]
"""
    scene, harness = Path("scene.toml").read_text(), (ROUTES / "harness.toml").read_text()
    harness = harness[harness.index("[cables") : harness.index("[limits]")]
    Path("scene.toml").write_text(scene + floor)
    read = read_route_file("scene.toml")
    assert read.obstacles == read.names == ()
    assert read.cables["cable"].scenes[0].obstacles == rj.read_scene("scene.toml").obstacles
    Path("harness.toml").write_text(harness + floor)
    read = read_route_file("harness.toml")
    assert read.obstacles == ()
    assert read.harness is not None
    assert all(len(one.obstacles) == 1 for one in read.harness.harness.scenes)
    # What only a route has makes it one; so do a name and a mesh.
    with_mesh = f'{scene}\n[[obstacles]]\nkind = "mesh"\nfile = "step.stl"\nunit = "1 m"\n'
    trimesh.creation.box((0.1, 0.1, 0.1)).export("step.stl")
    Path("route.toml").write_text(with_mesh)
    assert len(read_route_file("route.toml").obstacles) == 1
    for more in ("[limits]\nstrain = 0.1\n", ""):
        Path("route.toml").write_text(scene + floor + ('name = "floor"\n' if not more else "") + more)
        read = read_route_file("route.toml")
        assert len(read.obstacles) == 1
        assert read.cables["cable"].scenes[0].obstacles == ()


def test_a_mesh_and_a_union(files):
    trimesh.creation.box((100, 50, 20)).export("box.stl")
    Path("a.toml").write_text(
        'scene = "scene.toml"\n[[obstacles]]\nkind = "mesh"\nfile = "box.stl"\nunit = "1 mm"\n'
        '[[obstacles]]\nkind = "union"\nparts = [{ kind = "sphere", center = "[1, 0, 0] m", radius = "1 dm" }, '
        '{ kind = "plane", point = "[0, 0, -1] m", normal = [0, 0, 2] }]\n'
        '[[obstacles]]\nkind = "pipe"\npoints = "[[0, 0, 0], [40, 0, 0], [40, 30, 0]] mm"\nradius = "5 mm"\n'
    )
    read = read_route_file("a.toml")
    assert read.names == ("obstacle 0", "obstacle 1", "obstacle 2")
    assert read.limits is None
    np.testing.assert_allclose(read.obstacles[0].distance([[0.06, 0, 0]]), 0.01, rtol=1e-6)
    np.testing.assert_allclose(read.obstacles[1].distance([[1, 0, 0.3], [0, 0, 0]]), [0.2, 0.9])
    np.testing.assert_allclose(read.obstacles[2].distance([[0.02, 0.01, 0], [0.05, 0.02, 0]]), [0.005, 0.005])


def test_clips_may_vary_by_their_keys(files):
    content = tomllib.loads(Path("scene.toml").read_text())
    variations = SceneVariations(content, ["clips.0.at", "clips.1.position.2", "clips.0.tangent"])
    values = {"clips.0.at": 0.21, "clips.1.position.2": 0.05, "clips.0.tangent": np.array([1.0, 0.0, 0.0])}
    scene = variations.read({key: np.asarray(value) for key, value in values.items()}).scenes[0]
    assert scene.clips[0].at == 0.21
    np.testing.assert_allclose(scene.clips[0].tangent, [1, 0, 0])
    np.testing.assert_allclose(scene.clips[1].position, [0.37, -0.03, 0.05])


# --- the command -----------------------------------------------------------------------------------------------------


def test_report_tells_and_writes(reported, capsys):
    out = reported / "out"
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    told = json.loads((out / "report.json").read_text())
    text = (out / "report.txt").read_text()
    assert text.startswith(f"Brake line\n{told['verdict']}\n")
    scene = rj.read_scene(ROUTES / "scene.toml")
    read = read_route_file(ROUTES / "brake_line.toml")
    expected = rj.margins(rj.solve(scene), read.limits, read.obstacles, read.names)
    assert list(told["margins"]) == list(expected.names)
    np.testing.assert_allclose(list(told["margins"].values()), expected.margin, rtol=1e-6, atol=1e-9)


def test_report_takes_a_result(reported, files, capsys):
    assert main(["report", "brake_line.toml", "--result", str(reported / "result.vtkhdf"), "--out", "mine"]) == 3
    out, err = capsys.readouterr()
    assert err.startswith("rodjax: brake_line.toml: limits: NOT kept: ")
    assert out.endswith(f"written: {', '.join(f'mine/{name}' for name in FILES)}\n")
    told = json.loads((files / "mine" / "report.json").read_text())
    before = json.loads((reported / "out" / "report.json").read_text())
    assert told["margins"] == pytest.approx(before["margins"], rel=1e-9)


def test_a_limit_that_is_not_kept_exits_with_3_and_is_told(reported, files, capsys):
    for strain, code in ((1e-9, 3), (0.5, 0)):
        Path("limits.toml").write_text(f'title = "Line"\n[limits]\nstrain = {strain}\n')
        assert main(["report", "limits.toml", "--result", str(reported / "result.vtkhdf"), "--out", "mine"]) == code
        out, err = capsys.readouterr()
        told = json.loads((files / "mine" / "report.json").read_text())
        assert told["verdict"].startswith("NOT kept: 1 of 1 limit: " if code else "kept: the one limit")
        assert told["verdict"] in out
        assert err == (f"rodjax: limits.toml: limits: {told['verdict']}\n" if code else "")


@pytest.mark.slow
def test_what_does_not_converge_exits_with_3_and_is_told(files, capsys, monkeypatch):
    few = rj.Newton(max_iterations=1)
    monkeypatch.undo()
    solve = rj.solve
    monkeypatch.setattr(rj, "solve", lambda *args, **options: solve(*args, **options, solver=few))
    out = files / "out"
    assert main(["report", str(files / "brake_line.toml"), "--out", str(out)]) == 3
    said, err = capsys.readouterr()
    assert "NOT converged: the numbers below are not those of an equilibrium" in said
    assert err.startswith(f"rodjax: {files / 'brake_line.toml'}: cable: not converged: stopped at the largest number")
    assert err.count("\n") == 1
    assert json.loads((out / "report.json").read_text())["converged"] is False


# --- mistakes --------------------------------------------------------------------------------------------------------

MISTAKES = [
    ('scene = "scene.toml"', "scene = 3", "brake_line.toml: scene must be the name of a scene file", "scene.toml"),
    ('scene = "scene.toml"', "", "scene is needed", "got none"),
    ('scene = "scene.toml"', 'scene = "scene.toml"\ncables = { a = "b" }', "one of the three", "scene and cables"),
    ('scene = "scene.toml"', "cables = {}", "cables must be a table", "{}"),
    ('scene = "scene.toml"', 'scene = "none.toml"', "none.toml: cannot be read", ""),
    ('scene = "scene.toml"', 'scene = "scene.toml"\nobstacle = 1', "obstacle is not allowed here", "obstacles"),
    ('title = "Brake line"', "title = 3", "title must be a text", "3"),
    ("starts = 4", "starts = 0", "starts must be a whole number from 1", "0"),
    ('kind = "plane"', 'kind = "floor"', "obstacles[0].kind must be one of plane, sphere", "'floor'"),
    ('kind = "plane"', "", "obstacles[0].kind is missing", "union"),
    ("normal = [0, 0, 1]", "", "obstacles[0].normal is missing, for example normal = [0, 0, 1]", ""),
    ("normal = [0, 0, 1]", "normal = [0, 0, 0]", "obstacles[0].normal must be a direction", "zero"),
    ('radius = "20 mm"', 'radius = "-20 mm"', "obstacles[1].radius must be positive", "-0.02"),
    ('radius = "20 mm"', 'radius = "20 kg"', "obstacles[1].radius must be in m", "'kg'"),
    ('radius = "20 mm"', 'diameter = "20 mm"', "obstacles[1].diameter is not allowed here", "radius"),
    ('end = "[160, 200, 0] mm"', 'end = "[100, -100, 20] mm"', "obstacles[1].end must differ from start", ""),
    ('size = "[100, 80, 60] mm"', 'size = "[100, 80] mm"', "obstacles[2].size must be 3 numbers", "mm"),
    ("frame = [[0.8,", "frame = [[0.9,", "obstacles[2].frame must be a rotation", "off by"),
    ('name = "pipe"', 'name = "floor"', "obstacles[1].name must differ", "'floor'"),
    ('name = "pipe"', "name = 3", "obstacles[1].name must be a text", "3"),
    ("bend_radius = 5", 'bend_radius = "5 mm"', "limits.bend_radius must be a number without quotes or unit", "6"),
    ("bend_radius = 5", "bend_radius = -5", "limits.bend_radius must be positive", "-5"),
    ("bend_radius = 5", "bending = 5", "limits.bending is not allowed here", "bend_radius"),
    ('clearance = "8 mm"', 'clearance = "[8, 3] mm"', "limits.clearance must be one number, or one for each of 3", "2"),
    ('clearance = "8 mm"', 'clearance = "-8 mm"', "limits.clearance must not be negative", "-0.008"),
    ('clip_force = "10 N"', 'clip_force = "10 kg"', "limits.clip_force must be in N", "'kg'"),
    ('kind = "between"', 'kind = "box"', "variables[0].kind must be one of between, line", "'box'"),
    ('key = "clips.0.at"', "", "variables[0].key is missing", ""),
    ('key = "clips.0.at"', "key = 3", "variables[0].key must be the name of a number", "3"),
    ('key = "clips.0.at"', 'key = "clips.7.at"', "variables: 'clips.7.at' is no number of this scene", "clips.0.at"),
    ('lower = "180 mm"', 'lower = "180 N"', "variables[0].lower must be in m", "'N'"),
    ('lower = "180 mm"', 'lower = "280 mm"', "variables[0].lower must be below upper", ""),
    ('angle = "30 deg"', 'angle = "30 mm"', "variables[3].angle must be in rad", "'mm'"),
    ("length = 1\n", "length = -1\n", "objective.length must not be negative", "-1"),
    ("length = 1\n", "height = 1\n", "objective.height is not allowed here", "length"),
    ("length = 1\n", "", "objective: Objective must have at least one weight", ""),
]


@pytest.mark.parametrize(("old", "new", "said", "too"), MISTAKES)
def test_mistakes_are_one_line_with_file_and_key(files, capsys, old, new, said, too):
    changed("brake_line.toml", old, new)
    err = refused(capsys)
    assert said in err
    assert too in err
    assert ".toml" in err


def test_mistakes_beside_the_file(files, capsys):
    assert "nowhere.vtkhdf" in refused(capsys, "--result", "nowhere.vtkhdf")
    Path("wrong.vtkhdf").write_text("no")
    assert "--result: wrong.vtkhdf is not a readable HDF5 file" in refused(capsys, "--result", "wrong.vtkhdf")
    assert "--out must be a folder" in refused(capsys, "--out", "scene.toml")
    Path("hole.stl").write_text("solid a\nendsolid a\n")
    Path("brake_line.toml").write_text('scene = "scene.toml"\n[[obstacles]]\nkind = "mesh"\nfile = "hole.stl"\n')
    assert "obstacles[0].file: must name an STL file" in refused(capsys)
    changed("brake_line.toml", "hole.stl", "none.stl")
    assert "obstacles[0].file: 'none.stl' cannot be read" in refused(capsys)
    changed("scene.toml", "[rod]", '[[path]]\nend.spin = "10 deg"\n[rod]')
    Path("brake_line.toml").write_text('scene = "scene.toml"\n')
    assert "scene.toml: path is not allowed in a route" in refused(capsys)


def test_a_limit_that_the_scene_has_no_use_for_is_told(reported, files, capsys):
    text = Path("brake_line.toml").read_text()
    Path("brake_line.toml").write_text(text.split("[[obstacles]]")[0] + '[limits]\nclearance = "1 mm"\n')
    assert "limits.clearance is not allowed without [[obstacles]]" in refused(capsys)
    Path("brake_line.toml").write_text('[limits]\nclip_force = "1 N"\n')
    rj.save(solve(rj.problems.hanging_cable(), segments=8), "without.vtkhdf")
    assert "limits.clip_force is not allowed for a scene without clips" in refused(capsys, "--result", "without.vtkhdf")


# --- rodjax route ----------------------------------------------------------------------------------------------------


@pytest.fixture
def found(reported, files, monkeypatch):
    """A made-up outcome of a search in the place of one, and the arguments that it was asked with."""
    asked = {}

    def route(scene, variables, **options):
        asked.update(options, scene=scene, variables=variables)
        result = rj.load(reported / "result.vtkhdf")
        margins = rj.margins(result, options["limits"], options["obstacles"], options["names"])
        names = tuple(label for variable in variables for label in variable.labels())
        rates = {name: np.arange(len(names), dtype=float) for name in ("objective", *margins.names)}
        count = 2
        return rj.Route(
            feasible=asked.get("feasible", True),
            limits=options["limits"],
            obstacles=tuple(options["obstacles"]),
            obstacle_names=tuple(options["names"]),
            scene=result.scene,
            equilibrium=result,
            verified=result,
            margins=margins,
            objective=0.62,
            optimal=asked.get("feasible", True),
            gain=1e-8,
            multipliers={"bend radius": 0.05, "clips.0.at at its lower bound": 0.01},
            names=names,
            units=tuple(unit for variable in variables for unit in variable.units()),
            numbers=np.linspace(0.1, 0.2, len(names)),
            lower=np.full(len(names), 0.1),
            upper=np.full(len(names), 0.3),
            values={"clips.0.at": np.asarray(0.2), "clips.0.position": np.zeros(3)},
            gradients=rates,
            starts=Starts(
                designs=np.zeros((count, len(names))),
                objective=np.array([0.7, np.inf]),
                violation=np.array([0.0, 0.25]),
                feasible=np.array([True, False]),
                gain=np.array([1e-8, np.inf]),
                optimal=np.array([True, False]),
                iterations=np.array([3, 4]),
                solves=np.array([5, 6]),
                violated=("", "bend radius by 25 %"),
                message=("optimal to first order", "limit of iterations reached"),
            ),
            designs=jax.tree.map(lambda leaf: leaf[None], result.scene),
            solves=11,
            with_gradients=9,
            failed=1,
            redrawn=0,
        )

    monkeypatch.setattr(rj, "route", route)
    return asked


def test_route_tells_and_writes_what_was_found(found, files, capsys):
    assert main(["route", "brake_line.toml", "--out", "out", "--starts", "3"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert found["starts"] == 3
    assert found["names"] == ("floor", "pipe", "bracket")
    assert found["segments"] is None
    assert out.startswith(
        "A route that keeps to all limits, with the objective 0.62: 1 of 2 starts led to a feasible route."
    )
    assert "It is optimal to first order: " in out
    assert "active limits: bend radius (0.0005 for 1 %)" in out
    assert re.search(r"clips\.0\.at +100 mm\n", out)
    assert re.search(r"1 +inf +4 +6  fails in bend radius by 25 %; limit of iterations reached\n", out)
    assert re.search(r"clips\.0\.at +100 mm +100 mm +300 mm  at its lower bound\n", out)
    assert "Change of each margin by the design variables:" in out
    names = [*FILES, "route.json", "result.vtkhdf", "scene.toml"]
    assert out.endswith(f"written: {', '.join(f'out/{name}' for name in names)}\n")

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    told = json.loads((files / "out" / "route.json").read_text(), parse_constant=refuse)
    assert told["feasible"] is True
    assert told["optimal"] is True
    assert told["multipliers"] == {"bend radius": 0.05, "clips.0.at at its lower bound": 0.01}
    assert [start["optimal"] for start in told["starts"]] == [True, False]
    assert told["values"] == {"clips.0.at": 0.2, "clips.0.position": [0, 0, 0]}
    assert told["starts"][1]["objective"] is None
    assert told["numbers"]["clips.0.at"] == {"value": 0.1, "unit": "m", "lower": 0.1, "upper": 0.3}
    report = json.loads((files / "out" / "report.json").read_text())
    assert report["margins"] == pytest.approx(told["margins"], rel=1e-9)
    # The second variable's derivatives are all 1.
    assert set(report["cables"][0]["gradients"]["clips.0.position.0"]["margins"].values()) == {1.0}
    written = rj.read_scene(files / "out" / "scene.toml")
    assert written.clips[0].at == 0.2
    assert "Change of each margin" in (files / "out" / "report.html").read_text()


def test_a_report_of_a_route_knows_what_was_asked(found, files):
    file = read_route_file("brake_line.toml", for_route=True)
    asked = {"limits": file.limits, "obstacles": file.obstacles, "names": file.names}
    (scene,) = file.cables.values()
    route = rj.route(scene.scenes[0], file.variables, **asked)
    assert str(rj.report(route)) == str(rj.report(route.verified, **asked, gradients=route))
    # What is given goes first.
    wider = rj.report(route, limits=rj.Limits(bend_radius=1.0))
    assert set(wider.margins) == {"bend radius"}


def test_a_route_that_is_not_found_exits_with_3(found, files, capsys, monkeypatch):
    """With --view it is shown all the same."""
    monkeypatch.setattr("rodjax.commands.route.find_spec", lambda name: None)
    assert main(["route", "brake_line.toml", "--view"]) == 2
    assert "--view needs viser, got none: pip install 'rodjax[view]'" in capsys.readouterr().err
    assert not found  # nothing was sought
    shown = []
    monkeypatch.setattr("rodjax.commands.route.find_spec", lambda name: name)
    monkeypatch.setattr("rodjax.window.opening.session_of", lambda route, segments: route)
    monkeypatch.setattr("rodjax.window.opening.show", lambda *args, **options: shown.append((args, options)))
    found["feasible"] = False
    assert main(["route", "brake_line.toml", "--view", "--port", "0", "--no-browser"]) == 3
    (((route, port, host, is_opened), options),) = shown
    assert isinstance(route, rj.Route)
    assert (port, host, is_opened) == (0, "127.0.0.1", False)
    assert options["limits"] is route.limits
    out, err = capsys.readouterr()
    assert out.startswith("No route was found that keeps to all limits")
    assert err.startswith("rodjax: brake_line.toml: no route was found that keeps to all limits; ")
    assert found["starts"] == 4  # of the file
    assert (files / "rodjax-route" / "report.html").exists()


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("brake_line.toml", 'scene = "scene.toml"', 'cables = { a = "scene.toml" }', "cables is not allowed where"),
        ("scene.toml", "[rod]", "[solve]\nrtol = 1e-3\n[rod]", "solve.rtol and finite differences are not allowed"),
        (
            "scene.toml",
            "[rod]",
            "[solve]\nstrain_limit = 0.1\n[rod]",
            "solve.strain_limit is not allowed where",
        ),
        ("brake_line.toml", 'key = "clips.0.at"', 'key = "clips.7.at"', "'clips.7.at' is no number of this scene"),
    ],
)
def test_mistakes_of_a_route(files, capsys, name, old, new, said):
    changed(name, old, new)
    assert main(["route", "brake_line.toml"]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.startswith("rodjax: brake_line.toml: ")


def test_a_route_needs_variables(files, capsys):
    Path("a.toml").write_text('scene = "scene.toml"\n')
    assert main(["route", "a.toml"]) == 2
    assert "a.toml: variables is missing" in capsys.readouterr().err
    changed("brake_line.toml", "[limits]", "[other]")
    assert main(["route", "brake_line.toml"]) == 2
    assert "other is not allowed here" in capsys.readouterr().err


@pytest.mark.slow
def test_a_route_is_found(files, monkeypatch, capsys):
    monkeypatch.undo()
    monkeypatch.chdir(files)
    changed("scene.toml", "[rod]", "[solve]\nsegments = 8\n[rod]")
    Path("brake_line.toml").write_text(
        'scene = "scene.toml"\nstarts = 1\n[limits]\nbend_radius = 4\n[[variables]]\nkind = "between"\n'
        'key = "rod.length"\nlower = "600 mm"\nupper = "680 mm"\n'
    )
    assert main(["route", "brake_line.toml", "--out", "out"]) == 0
    told = json.loads(Path("out/route.json").read_text())
    assert told["margins"]["bend radius"] >= 0
    assert 0.6 <= told["numbers"]["rod.length"]["value"] < 0.62
