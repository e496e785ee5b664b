"""Fits as files: what `rodjax fit` finds, writes and refuses."""

import csv
import json
import re
import shutil
import textwrap
import warnings
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

import rodjax as rj
from rodjax.cli import main
from rodjax.identification import files as identification_files
from rodjax.identification.files import read_fit_files
from rodjax.identification.measured_table import read_table
from rodjax.identification.refits import Profile

FITS = Path(__file__).parents[1] / "experiments" / "fits"
# What the example was made with.
EI, MASS, SD, FORCE_SD = 5e-3, 0.09, 1e-3, 5e-3
GAPS = {"near": 0.7, "far": 0.85}
DAYS = ("Monday", "Tuesday")


def made_up_rows():
    """The measurements of the example: the header, then strings in its units."""
    random = np.random.default_rng(2024)
    rows = [["experiment", "cluster", "gap [mm]", "s [mm]", "x [mm]", "z [mm]", "end_force_x [N]", "end_force_z [N]"]]
    scene = rj.read_scene(FITS / "scene.toml")
    for name, gap in GAPS.items():
        rod = rj.Rod(1.0, EI, scene.rod.GJ, scene.rod.EA, MASS)
        end = rj.Clamp((gap, 0, 0), scene.end.frame)
        equilibrium = rj.solve(rj.Scene(rod, scene.start, end, scene.gravity), segments=8, planar=True)
        s = np.linspace(0, 1, 11)
        for day in DAYS:
            points = np.asarray(equilibrium.position_at(s))[:, [0, 2]] + SD * random.standard_normal((11, 2))
            force = np.asarray(equilibrium.end_force)[[0, 2]] + FORCE_SD * random.standard_normal(2)
            for k, (x, z) in enumerate(1e3 * points):
                loads = [f"{component:.4f}" for component in force] if k == 0 else ["", ""]
                row = [f"{name} {day}", day, f"{1e3 * gap:g}", f"{1e3 * s[k]:g}", f"{x:.2f}", f"{z:.2f}", *loads]
                rows.append(row)
    return rows


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A copy of the example in the working folder, in which nothing is solved."""
    for name in ("fit.toml", "scene.toml", "data.csv"):
        shutil.copy(FITS / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rj, "fit", lambda *args, **options: pytest.fail("solved"))
    return tmp_path


def changed(name, old, new):
    text = Path(name).read_text()
    assert old in text
    Path(name).write_text(text.replace(old, new, 1))


def refused(capsys, *options):
    """The one line on stderr."""
    assert main(["fit", "fit.toml", "data.csv", *options]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("rodjax: ")
    assert err.count("\n") == 1
    assert not Path("rodjax-fit").exists()
    return err


# --- what the files say ----------------------------------------------------------------------------------------------


def test_the_example_is_read(files):
    read = read_fit_files("fit.toml", "data.csv")
    assert [one.name for one in read.experiments] == ["near Monday", "near Tuesday", "far Monday", "far Tuesday"]
    assert [one.cluster for one in read.experiments] == ["Monday", "Tuesday"] * 2
    np.testing.assert_allclose([one.scene.end.position[0] for one in read.experiments], [0.7, 0.7, 0.85, 0.85])
    points, along_x, along_z = read.experiments[1].measured
    np.testing.assert_allclose(points.points[1], [0.08558, -0.04462])
    np.testing.assert_allclose(points.s, np.linspace(0, 1, 11))
    # Seen along y, of which the table has no column.
    np.testing.assert_array_equal(points.camera, [[1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(points.weights, 1 / SD)
    assert [float(one.value[0]) for one in (along_x, along_z)] == [-0.0495, 0.4409]
    np.testing.assert_array_equal([one.direction for one in (along_x, along_z)], [[1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(along_x.weights, 1 / FORCE_SD)
    stiffness, mass = read.unknowns
    assert (stiffness.names, stiffness.scale, stiffness.bounds) == (("rod.EI",), "log", (1e-4, 0.1))
    assert (mass.names, mass.prior) == (("rod.mass_per_length",), (0.1, 0.2))
    assert read.options == {"segments": 8, "planar": True, "discretization": None}


def test_the_example_of_the_documentation_can_be_read(files):
    blocks = re.findall(r"(?:^    .*\n|^\n)+", identification_files.__doc__, re.M)
    fit, data = (textwrap.dedent(block) for block in blocks if block.strip())
    Path("fit.toml").write_text(fit)
    Path("data.csv").write_text(data.replace("...\n", ""))
    read = read_fit_files("fit.toml", "data.csv")
    assert [len(one.measured) for one in read.experiments] == [3, 1]
    assert read.unknowns[0].label == "bending stiffness"
    assert read.options["threshold"] == 1.5


def test_unknowns_have_units_or_none(files):
    Path("fit.toml").write_text(
        'scene = "scene.toml"\n[[unknown]]\nnames = ["rod.EI", "rod.GJ"]\nstart = "5000 N mm^2"\nlabel = "stiff"\n'
        '[[unknown]]\nname = "start.frame.1"\nper = "experiment"\nbounds = ["-5 deg", "none"]\n'
        'prior = { value = "0 deg", sd = "1 deg" }\n'
        '[[unknown]]\nname = "measured.0.scale"\nscale = "linear"\nprior = { value = 1.0, sd = 0.01 }\n'
        '[experiments]\ngap = "end.position.0"\n[measured]\nsd = "1 mm"\nforce_sd = "1 N"\n'
        '[fit]\nloss = "huber"\nthreshold = 2\nrtol = 1e-3\ndiscretization = "finite_difference"\n'
    )
    stiffness, turn, scale = read_fit_files("fit.toml", "data.csv").unknowns
    assert stiffness.start == pytest.approx(5e-3)
    assert (stiffness.names, stiffness.label) == (("rod.EI", "rod.GJ"), "stiff")
    assert turn.bounds == (pytest.approx(-np.pi / 36), None)
    assert turn.prior == (0.0, pytest.approx(np.pi / 180))
    assert (turn.per, scale.prior, scale.scale) == ("experiment", (1.0, 0.01), "linear")
    options = read_fit_files("fit.toml", "data.csv").options
    assert options == {"loss": "huber", "threshold": 2.0, "rtol": 1e-3, "discretization": "finite_difference"}


def test_the_scene_says_what_the_fit_does_not(files):
    changed("fit.toml", "segments = 8\n", "")
    changed("scene.toml", "[loads]", '[solve]\nsegments = 12\ndiscretization = "finite_difference"\n[loads]')
    options = read_fit_files("fit.toml", "data.csv").options
    assert options == {"segments": 12, "rtol": None, "planar": True, "discretization": "finite_difference"}


def test_a_table_in_space_without_arclengths_and_with_keys():
    table = read_table(
        "experiment,x [mm],y,z [cm],end_moment_x [N mm],end_moment_y,end_moment_z,rod.length [cm],end.position\n"
        'a,100,0.2,30,1,2,3,110,"[0.8, 0, 0]"\nb,,,,,,4,,\n\na,200,0.2,30,,,,1.1e2,"[80, 0, 0] cm"\n',
        {},
    )
    a, b = table.experiments
    assert (table.axes, table.keys) == ("xyz", ["rod.length", "end.position"])
    (rod,) = a.rods.values()
    np.testing.assert_allclose(rod.points, [[0.1, 0.2, 0.3], [0.2, 0.2, 0.3]])
    assert rod.s is None
    assert a.cluster is None
    assert rod.loads == {"end_moment_x": pytest.approx(1e-3), "end_moment_y": 2.0, "end_moment_z": 3.0}
    assert a.values["rod.length"] == pytest.approx(1.1)
    np.testing.assert_allclose(a.values["end.position"], [0.8, 0, 0])
    (rod,) = b.rods.values()
    assert rod.points.shape == (0, 3)
    assert (rod.loads, b.values) == ({"end_moment_z": 4.0}, {})


HARNESS = """
[cables.trunk]
rod = { length = "0.5 m", EI = "5e-3 N m^2", GJ = "4e-3 N m^2", EA = "800 N", mass_per_length = "0.1 kg/m" }
start = { support = "clamp", position = "[0, 0, 0] m", tangent = [1, 0, 0], d2 = [0, 1, 0] }
end = { support = "joint", joint = "y", tangent = [1, 0, 0], d2 = [0, 1, 0] }

[cables.left]
rod = { length = "0.5 m", EI = "3e-3 N m^2", GJ = "2e-3 N m^2", EA = "800 N", mass_per_length = "0.1 kg/m" }
start = { support = "joint", joint = "y", tangent = [1, 0, 0], d2 = [0, 1, 0] }
end = { support = "clamp", position = "[0.8, 0, 0] m", tangent = [1, 0, 0], d2 = [0, 1, 0] }

[joints.y]
mass = "20 g"

[loads]
gravity = "[0, 0, -9.81] m/s^2"
"""
OF_HARNESS = """
scene = "harness.toml"
[[unknown]]
name = "cables.trunk.rod.EI"
[[unknown]]
name = "joints.y.mass"
[measured]
sd = "0.1 mm"
force_sd = "1 mN"
[fit]
segments = 4
[experiments]
gap = "cables.left.end.position.0"
"""
TABLE = """experiment,cable,gap [mm],s [mm],x [mm],y [mm],z [mm],end_force_z [N],start_force_z [N]
near,trunk,750,250,200,0,-80,,0.5
near,left,,250,500,0,-90,0.45,
far,left,800,250,520,0,-70,0.46,
"""


def write_harness(table=TABLE):
    for name, text in (("harness.toml", HARNESS), ("fit.toml", OF_HARNESS), ("data.csv", table)):
        Path(name).write_text(text)


def test_rows_of_a_harness_name_their_cables(files):
    write_harness()
    near, far = read_fit_files("fit.toml", "data.csv").experiments
    assert [float(one.scene["left"].end.position[0]) for one in (near, far)] == [0.75, 0.8]
    assert [(type(one).__name__, one.cable) for one in near.measured] == [
        ("Centerline", "trunk"),
        ("EndForce", "trunk"),
        ("Centerline", "left"),
        ("EndForce", "left"),
    ]
    np.testing.assert_allclose(near.measured[2].points, [[0.5, 0, -0.09]])
    assert [(one.end, float(one.value[0])) for one in near.measured[1::2]] == [("start", 0.5), ("end", 0.45)]
    assert [one.cable for one in far.measured] == ["left", "left"]


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("data.csv", "far,left", "far,right", "experiment 'far': cable must be one of trunk, left of harness.toml"),
        ("data.csv", "far,left", "far,", "line 4, column cable: is empty; it must be a name"),
        ("data.csv", "far,left,800,250", "far,left,800,750", "experiment 'far': s must lie in 0 to 0.5 m"),
        ("data.csv", "near,left,,", "near,left,760,", "line 3, column gap [mm]: must be the same in all rows of exp"),
        ("fit.toml", '"cables.trunk.rod.EI"', '"rod.EI"', "unknown[0]: there is no number 'rod.EI'"),
        ("fit.toml", "left.end", "right.end", "cables.right"),
        ("fit.toml", "segments = 4", "segments = 4\nplanar = true", "planar must be False for a harness, in space"),
    ],
)
def test_a_mistake_about_cables_is_one_line(name, old, new, said, files, capsys, monkeypatch):
    write_harness()
    changed(name, old, new)
    monkeypatch.undo()
    monkeypatch.chdir(files)
    line = refused(capsys)
    assert said in line, line


def test_rows_are_of_cables_where_the_scene_has_these(files, capsys):
    changed("data.csv", "experiment,cluster", "experiment,cable")
    assert "data.csv: column cable is not allowed: scene.toml has one rod, and no cables" in refused(capsys)
    write_harness("experiment,gap [mm],end_force_z [N]\nnear,750,0.45\n")
    said = "data.csv: column cable is missing, the cable that a row is of: harness.toml has the cables trunk, left"
    assert said in refused(capsys)


@pytest.mark.slow
def test_the_command_fits_a_harness(tmp_path, monkeypatch, capsys):
    """What the measurements were made with, which are exact but for the digits of the table."""
    monkeypatch.chdir(tmp_path)
    write_harness()
    harness = rj.read_scene("harness.toml")
    true = rj.solve(harness, segments=4)
    rows = ["experiment,cable,s,x,y,z,start_force_x,start_force_z"]
    for cable in harness:
        for k, s in enumerate((0.1, 0.3, 0.4)):
            x, y, z = (float(number) for number in true[cable].position_at([s])[0])
            force = -np.asarray(true[cable].start_force) if k == 0 and cable == "trunk" else ("", "", "")
            rows.append(f"only,{cable},{s},{x:.9f},{y:.9f},{z:.9f},{force[0]},{force[2]}")
    Path("data.csv").write_text("\n".join(rows))
    changed("fit.toml", '[experiments]\ngap = "cables.left.end.position.0"\n', "")
    changed("harness.toml", '"5e-3 N m^2"', '"6e-3 N m^2"')
    changed("harness.toml", '"20 g"', '"25 g"')
    assert main(["fit", "fit.toml", "data.csv"]) == 0
    found = json.loads(Path("rodjax-fit/report.json").read_text())["estimate"]
    # Places to 1e-9 m of 0.1 m and tight enough solves.
    assert found["cables.trunk.rod.EI"] == pytest.approx(5e-3, rel=1e-5)
    assert found["joints.y.mass"] == pytest.approx(0.02, rel=1e-5)
    assert imread("rodjax-fit/shapes.png").ndim == 3
    assert "cables.trunk.rod.EI [N m^2]" in capsys.readouterr().out


def test_a_vector_is_one_measurement_and_the_nominal_scene_stays_where_nothing_is_said(files):
    Path("data.csv").write_text(
        "experiment,end_force_x,end_force_y,end_force_z,start_moment_y,end.position.0\na,1,2,3,,0.7\nb,,,,5,\n"
    )
    changed("fit.toml", 'gap = "end.position.0"', "")
    changed("fit.toml", "force_sd", 'moment_sd = "1 N mm"\nforce_sd')
    a, b = read_fit_files("fit.toml", "data.csv").experiments
    np.testing.assert_array_equal(a.measured[0].value, [1, 2, 3])
    assert isinstance(b.measured[0], rj.EndMoment)
    assert b.measured[0].end == "start"
    np.testing.assert_allclose(b.measured[0].weights, 1e3)
    assert (float(a.scene.end.position[0]), float(b.scene.end.position[0])) == (0.7, 0.8)


# --- mistakes --------------------------------------------------------------------------------------------------------

IN_THE_FIT = [
    ("scene = ", "scenes = ", "scenes is not allowed here", "scene, unknown, measured"),
    ('scene = "scene.toml"', "", "scene must be the name of a scene file", "got none"),
    ('scene = "scene.toml"', "scene = 3", "scene must be the name of a scene file", "got 3"),
    ("[[unknown]]", "[unknown]", "is not valid TOML", ""),
    ('name = "rod.EI"', "", "unknown[0].name or unknown[0].names is needed", "rod.EI"),
    ('name = "rod.EI"', 'names = "rod.EI"', "unknown[0].names must be a list of names", "got 'rod.EI'"),
    ('name = "rod.EI"', 'name = "rod.EJ"', "unknown[0]: there is no number 'rod.EJ'", "rod.length, rod.EI"),
    ('name = "rod.EI"', 'name = "rod.EI.1"', "unknown[0]: there is no number 'rod.EI.1'", "rod.EI"),
    ('"rod.mass_per_length"', '"rod.EI"', "unknown[1]: 'rod.EI' is sought already", "unknown[0]"),
    ('name = "rod.EI"', 'name = "rod.EI"\nname = "rod.GJ"', "is not valid TOML", "line 9"),
    ('name = "rod.EI"', 'name = "rod.EI"\nscale = "cubic"', "unknown[0].scale must be one of log, linear", "'cubic'"),
    ('name = "rod.EI"', 'name = "rod.EI"\nper = "day"', "unknown[0].per must be one of all, experiment", "'day'"),
    ('name = "rod.EI"', 'name = "rod.EI"\nstart = 5e-3', "unknown[0].start must have a unit", "N m^2"),
    ('name = "rod.EI"', 'name = "rod.EI"\nstart = "5 N"', "unknown[0].start must be in N m^2", "'N'"),
    ('name = "rod.EI"', 'name = "rod.EI"\nstart = "-5 N m^2"', "unknown[0].start must be positive", "-5"),
    ('name = "rod.EI"', 'name = "rod.EI"\nlabel = 3', "unknown[0].label must be a text", "got 3"),
    ('"0.1 N m^2"]', '"0.1 m"]', "unknown[0].bounds must be in N m^2", "'m'"),
    (', "0.1 N m^2"]', "]", "unknown[0].bounds must be a list of two quantities", "largest"),
    ('"0.1 N m^2"]', '"1e-5 N m^2"]', "unknown[0].bounds must increase", "1e-05"),
    (", sd = 0.2 }", " }", "unknown[1].prior must be a table of value and sd", "0.1 kg/m"),
    ("sd = 0.2 }", 'sd = "0.2 kg/m" }', "unknown[1].prior.sd must be a number without quotes or unit", "kg/m"),
    ("sd = 0.2 }", "sd = -0.2 }", "unknown[1].prior must be positive", "-0.2"),
    ('\nsd = "1 mm"', '\nsd = "1 N"', "measured.sd must be in m", "'N'"),
    ('\nsd = "1 mm"', '\nsd = "0 mm"', "measured.sd must be positive", "0 mm"),
    ('\nsd = "1 mm"', "\nsd = 1", "measured.sd must have a unit", "1 m"),
    ('force_sd = "5 mN"', "", "measured.force_sd is missing, the standard deviation of forces", "0.01 N"),
    ("segments = 8", "segments = 1", "fit.segments must be a whole number from 2", "got 1"),
    ("segments = 8", "segments = 8\nrtol = 1e-3", "fit.rtol is not allowed together with fit.segments", ""),
    ("segments = 8", "rtol = 2", "fit.rtol must", "2"),
    ("segments = 8", 'loss = "quartic"', "fit.loss must be one of linear, huber, cauchy, welsch", "'quartic'"),
    ("segments = 8", "threshold = 2.0", "fit.threshold is not allowed for the loss", "linear"),
    ("segments = 8", 'threshold = "2"\nloss = "huber"', "fit.threshold must be a number", "'2'"),
    ("segments = 8", 'discretization = "spectral"', "fit.discretization must be one of", "hermite"),
    ("planar = true", "planar = 1", "fit.planar must be true or false", "got 1"),
    ("planar = true", "steps = 1", "fit.steps is not allowed here", "loss, threshold"),
    ('gap = "end.position.0"', "gap = 0", "experiments must be a table", "end.position.0"),
    ('gap = "end.position.0"', 'gap = "end.place"', "experiments: end.place cannot vary", "end.position.2"),
]
IN_THE_TABLE = [
    ("experiment,", "test,", "column test is not allowed", "experiment, cluster, cable, s, x, y, z"),
    ("experiment,cluster", "cluster,rod.GJ", "column experiment is missing", "name"),
    ("z [mm]", "cluster", "column cluster is given twice", ""),
    ("x [mm],z [mm]", "x [mm],x [m]", "column x [m] is given twice, first as x [mm]", ""),
    ("cluster,gap [mm]", "end.position,gap [mm]", "end.position.0 is given twice, or beside a component of it", ""),
    ("gap [mm]", "rod.GJ", "column gap is missing", "[experiments]"),
    ("x [mm],z [mm]", "x [mm],rod.EA", "of the columns y [m], z [m] at least 1 must be there", ""),
    ("x [mm]", "x [s]", "column x [s]: the unit must be m or a like one", "'s'"),
    ("end_force_x [N]", "end_force_x [m]", "column end_force_x [m]: the unit must be N", "'m'"),
    ("near Monday,Monday,700,100,86.95", "near Monday,Monday,700,100,8,6.95", "line 3: has 9 cells", "8"),
    ("86.95", "many", "line 3, column x [mm]: must be a number", "'many'"),
    ("86.95", "nan", "line 3, column x [mm]: must be finite", "'nan'"),
    ("86.95", "", "line 3, column x [mm]: is empty", "x, z"),
    ("700,100,86.95", "700,,86.95", "line 3, column s [mm]: is empty", "all or none"),
    ("-0.0614", "weak", "line 2, column end_force_x [N]: must be a number", "'weak'"),
    ("700,100,86.95", "710,100,86.95", "line 3, column gap [mm]: must be the same in all rows", "'710' after '700'"),
    ("Monday,700,100,", "Sunday,700,100,", "line 3, column cluster: must be the same in all rows", "'Sunday'"),
    ("700,100,86.95", "a lot,100,86.95", "line 3, column gap [mm]: a component of end.position must be", "a lot mm"),
    ("near Monday,Monday,700,0,1.03,1.64,-0.0614,0.4423", "a,,,,,,,", "line 2: experiment 'a' has no measured", ""),
    ("near Monday,", ",", "line 2, column experiment: is empty", "name"),
    ("700,100,86.95", "700,-1,86.95", "experiment 'near Monday': s must not be negative", "-0.001 m"),
    ("700,100,86.95", "700,1100,86.95", "experiment 'near Monday': s must lie in 0 to 1 m", "1.1 m"),
    ("-0.0614", '"-0.0614', "line 45: has 7 cells", ""),
]


@pytest.mark.parametrize(
    ("name", "old", "new", "said", "allowed"),
    [("fit.toml", *mistake) for mistake in IN_THE_FIT] + [("data.csv", *mistake) for mistake in IN_THE_TABLE],
)
def test_a_mistake_is_named_in_one_line_and_nothing_is_solved(name, old, new, said, allowed, files, capsys):
    changed(name, old, new)
    line = refused(capsys)
    assert line.startswith(f"rodjax: {name}: ")
    assert said in line
    assert allowed in line


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds nothing; it must have a header and one row for each measured point"),
        ("experiment,x,z\n", "holds only a header"),
        ("experiment;x;z\na;1;2\n", "columns must be separated by commas, got semicolons"),
        ("experiment,gap\na,700\n", "columns of what was measured are missing, such as s [m]"),
        ("experiment,gap,s\na,700,1\n", "of the columns x [m], y [m], z [m] at least 2 must be there"),
    ],
)
def test_a_table_without_measurements(text, said, files, capsys):
    Path("data.csv").write_text(text)
    assert refused(capsys).startswith(f"rodjax: data.csv: {said}")


def test_mistakes_of_the_scene_name_its_file(files, capsys):
    changed("fit.toml", '"scene.toml"', '"missing.toml"')
    assert refused(capsys).startswith("rodjax: missing.toml: cannot be read: No such file")
    changed("fit.toml", '"missing.toml"', '"scene.toml"')
    Path("scene.toml").write_text((FITS / "scene.toml").read_text() + '[[path]]\nend.spin = "90 deg"\n')
    assert refused(capsys).startswith("rodjax: scene.toml: path is not allowed in a fit")
    shutil.copy(FITS / "scene.toml", "scene.toml")
    changed("scene.toml", '"800 N"', '"800 m"')
    assert "rodjax: data.csv: experiment 'near Monday': rod.EA must be in N" in (line := refused(capsys))
    assert "(in scene.toml with these values)" in line
    changed("scene.toml", '"800 m"', '"800 N"')
    changed("scene.toml", 'position = "[0.8, 0, 0] m"', "")
    assert refused(capsys).startswith("rodjax: scene.toml: end.position is not there, so that end.position.0 cannot")


def test_other_mistakes_on_the_command_line(files, capsys):
    Path("data.csv").write_bytes(b"\x89PNG")
    assert refused(capsys).startswith("rodjax: data.csv: is not text in UTF-8")
    Path("data.csv").unlink()
    assert refused(capsys).startswith("rodjax: data.csv: cannot be read: No such file")
    assert refused(capsys, "--out", "fit.toml").startswith("rodjax: --out must be a folder that can be written")
    assert refused(capsys, "--fast").startswith("rodjax: unrecognized arguments: --fast")


def test_what_the_data_do_not_determine_is_one_line(files, capsys, monkeypatch):
    def undetermined(experiments, unknowns, **options):
        raise ValueError(
            "unknowns cannot be told from these measurements: rod.EI x 2.72 leaves all of them as they are"
        )

    monkeypatch.setattr(rj, "fit", undetermined)
    assert refused(capsys).startswith("rodjax: fit.toml: unknowns cannot be told from these measurements: rod.EI x")


# --- a whole run -----------------------------------------------------------------------------------------------------


def parabola(fit, label):
    values = fit.estimate[label] + fit.standard_error[label] * np.linspace(-3, 3, 13)
    return Profile(label, fit.units[label], values, np.linspace(-3, 3, 13) ** 2, np.zeros((13, 2)))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The example fitted by the command: its exit code, the folder it wrote, and what `rodjax.fit` returned."""
    folder = tmp_path_factory.mktemp("run") / "deep" / "out"
    found = []
    with pytest.MonkeyPatch.context() as patch:
        fit = rj.fit
        patch.setattr(rj, "fit", lambda *args, **options: found.append(fit(*args, **options)) or found[0])
        patch.setattr(rj.Fit, "profile", parabola)  # the true one compiles as long again
        code = main(["fit", str(FITS / "fit.toml"), str(FITS / "data.csv"), "--out", str(folder), "--profiles"])
    return code, folder, found[0]


@pytest.mark.slow
def test_the_example_is_what_it_says_it_is():
    with open(FITS / "data.csv", newline="") as file:
        there = list(csv.reader(file))
    made = made_up_rows()
    assert there[0] == made[0]
    for row, other in zip(there[1:], made[1:], strict=True):
        assert row[:4] == other[:4]
        for cell, other_cell in zip(row[4:], other[4:], strict=True):
            # The last digit may be another on another machine.
            assert cell == other_cell or abs(float(cell) - float(other_cell)) < 0.02


@pytest.mark.slow
def test_the_command_finds_what_the_measurements_were_made_with(run):
    code, folder, fit = run
    assert code == 0
    written = {"report.txt", "report.json", "shapes.png", "residuals.png", "correlation.png", "profiles.png"}
    assert {path.name for path in folder.iterdir()} == written
    report = json.loads((folder / "report.json").read_text())
    assert report == fit.as_dict()
    for label, truth in (("rod.EI", EI), ("rod.mass_per_length", MASS)):
        assert abs(report["estimate"][label] - truth) < 3 * report["standard_error"][label] < 0.05 * truth
    assert 0.8 < report["sigma"] < 1.2
    assert (folder / "report.txt").read_text() == fit.report() + "\n"
    for name in ("shapes", "residuals", "correlation", "profiles"):
        assert imread(folder / f"{name}.png")[..., :3].std() > 0.01


@pytest.mark.slow
def test_what_has_not_converged_is_written_and_exits_with_3(run, files, capsys, monkeypatch):
    def stopped(*args, **options):
        warnings.warn("the fit has not converged in 2 steps: better values", rj.NotConvergedWarning, stacklevel=2)
        return run[2]

    def beyond(fit, label):
        raise ValueError(f"at must lie within the bounds of {label}")

    monkeypatch.setattr(rj, "fit", stopped)
    monkeypatch.setattr(rj.Fit, "profile", beyond)
    assert main(["fit", "fit.toml", "data.csv", "--profiles"]) == 3
    out, err = capsys.readouterr()
    assert err.splitlines() == [
        "rodjax: the profile of rod.EI is not drawn: at must lie within the bounds of rod.EI",
        "rodjax: the profile of rod.mass_per_length is not drawn: at must lie within the bounds of rod.mass_per_length",
        "rodjax: fit.toml: the fit has not converged in 2 steps: better values",
    ]
    assert out.startswith(run[2].report())
    assert out.splitlines()[-1].startswith("written: rodjax-fit/report.txt, rodjax-fit/report.json, rodjax-fit/shapes")
    assert not Path("rodjax-fit/profiles.png").exists()
