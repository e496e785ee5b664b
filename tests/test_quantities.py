"""Numbers with units in files of every kind: one number and a unit, or a refusal; no input counts for nothing.

Whatever has a second number, a comma for the decimal point or a unit of another kind is refused at every key.
"""

import itertools
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scenes import BRANCHES

import rodjax
from rodjax.identification.files import read_fit_files
from rodjax.io.quantities import LISTS, OF_TABLES, QUANTITIES, SceneFileError, is_unit, number_in, si_value, si_values
from rodjax.io.scene_file import read_scene_file
from rodjax.routing.files import read_route_file
from rodjax.routing.variables import Between
from rodjax.sweeps.cases import SweepError, read_cases

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
# By table, key, SI unit, shape and example, of all that files have.
KEYS = [
    (table, key, *of_key)
    for table, keys in {"": QUANTITIES | LISTS, **OF_TABLES}.items()
    for key, of_key in keys.items()
]
# What is not one number and a unit U, though a careless reader finds a number in it.
NOT_ONE = (
    *(
        "1,1 U",
        "0,1 U",
        "1 ,1 U",
        "0,1U",
        "1,000 U",
        "1,0 U",
        "1;1 U",
        "1 1 U",
        "1 1.0 U",
        "1 0 U",
        "1_000 U",
        "1'000 U",
    ),
    *("1.1.1 U", "1..1 U", "1.1. U", ".U", "1 1U", "1 (1) U", "1 U 1", "1 U 1 U", "1 U, 1 U", "1 U,", "1 ,U", "1*1 U"),
    *("1 - 1 U", "1+1 U", "1 +U", "1 ± 0.1 U", "1/2 U", "1 1/2 U", "1 e0 1 U", "1e0,5 U", "1e 1 U", "0x1 U", "1 U^1,1"),
    *(
        "~1 U",
        "<1 U",
        "1...2 U",
        "1 to 2 U",
        "1 or 2 U",
        "1U1",
        "1 U/1,1",
        "1 % U",
        "1 U %",
        "1 dB U",
        "1 U bit",
        "U 1",
    ),
)
NOT_A_LIST = ("1,1 U", "1, 1, 1 U", "[1,1,1 U", "1,1,1] U", "[1 1 1] U", "[1; 1; 1] U", "[1, 1, 1,] U", "[1, 1, 1], U")
NOT_A_LIST += ("[1, 1, 1] ,1 U", "[1, 1, 1] 1 U", "[1, 1, 1] U [1, 1, 1] U", "[1, 1, '1'] U", "[1, 1, 0x1] U", "[] U")
# No angle, though without a dimension too.
NOT_AN_ANGLE = ("1 %", "1 percent", "1 ppm", "1 dB", "1 Np", "1 bit", "1 count", "1 sr", "1 mm/m", "1 dimensionless")


@pytest.mark.parametrize(("table", "key", "si", "shape", "example"), KEYS, ids=[f"{x[0]}.{x[1]}" for x in KEYS])
def test_a_text_that_is_not_one_number_and_a_unit_is_refused_at_every_key(table, key, si, shape, example):
    where = f"{table}[0]" if table else "rod"
    unit = si or "m"  # plain numbers have none, and take no text at all
    wrong = [text for text in NOT_ONE if not (text == "1 1/2 U" and unit == "1")]
    wrong += [text for text in NOT_A_LIST if shape or not text.startswith("[")]
    wrong += ["[1,1, 0, 0] U"] * (shape == (3,)) + list(NOT_AN_ANGLE)
    for text in dict.fromkeys(text.replace("U", unit) for text in wrong):
        with pytest.raises(SceneFileError) as caught:
            si_values({key: text}, where, (), (key,))
        assert str(caught.value).startswith(f"{where}.{key} must "), text
        assert "\n" not in str(caught.value)
    # What is shown as right is right.
    value = example.strip('"') if si else np.full(tuple(size or 2 for size in shape), 0.5).tolist()
    assert si_values({key: value}, where, (), (key,))[key].ndim == len(shape)


@pytest.mark.parametrize(
    ("text", "si", "factor"),
    [
        ("1 mm", "m", 1e-3),
        ("1mm", "m", 1e-3),
        (" 1\tmm ", "m", 1e-3),
        ("1 inch", "m", 0.0254),
        ("1 1/cm", "1/m", 100),
        ("1 1 / cm", "1/m", 100),
        ("1 1/(cm)", "1/m", 100),
        ("1 cm^-1", "1/m", 100),
        ("1 cm**-1", "1/m", 100),
        ("1 N mm²", "N m^2", 1e-6),
        ("1 N·mm^2", "N m^2", 1e-6),
        ("1 N*mm**2", "N m^2", 1e-6),
        ("1 N mm ^ 2", "N m^2", 1e-6),
        ("1 (g)/(m)", "kg/m", 1e-3),
        ("1 m/s/s", "m/s^2", 1),
        ("1 m/(s s)", "m/s^2", 1),
        ("1 N/mm^2", "Pa", 1e6),
        ("180 °", "rad", np.pi),
        ("1 turn", "rad", 2 * np.pi),
        ("180 deg/m", "1/m", np.pi),  # a curvature
        ("1 1/m", "rad/m", 1),
        ("1 N cm/cm", "N m/m", 1),
        ("1 lbf", "N", 4.4482216152605),
    ],
)
def test_units_as_people_write_them_are_read(text, si, factor):
    np.testing.assert_allclose(si_value(text, "key", si, (), ""), factor, rtol=1e-14)


def test_long_nonsense_is_refused_at_once():
    for text in ("m " * 5000, "(m)" * 5000, "m" * 5000, " " * 5000 + "!", "m^" * 5000, "m^(1/" * 5000, "°" * 5000):
        assert not is_unit(text)
    assert number_in("1" * 5000 + ",") is None


def test_plain_numbers_of_tables_are_numbers():
    assert [number_in(text) for text in ("1", " -.5e-3 ", "+2.", "1E3")] == [1.0, -0.0005, 2.0, 1000.0]
    for text in ("1_000", "1,5", "1 000", "٣", "", "1e", "infinity", "0x1", "1.5.2", "1 m"):
        assert number_in(text) is None, text


# --- files of every kind ---------------------------------------------------------------------------------------------

QUOTED = re.compile(r'"(\[?[-+0-9.e, \]]*[0-9.\]]) ([^"]+)"')
WAYS = {"decimal comma": "1,1 {unit}", "zero": "0,1 {unit}", "two numbers": "1 1 {unit}", "no angle": "1 %"}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "name",
    [
        *("scenes/figure_1.toml", "scenes/hanging_cable.toml", "fits/fit.toml", "fits/scene.toml"),
        *("routes/brake_line.toml", "routes/scene.toml", "harness/harness.toml"),
    ],
)
def test_a_decimal_comma_in_a_file_is_refused_in_one_line(name, way, tmp_path):
    folder = tmp_path / "files"
    if name.startswith("harness"):
        folder.mkdir()
        (folder / "harness.toml").write_text(BRANCHES)
    else:
        shutil.copytree((EXPERIMENTS / name).parent, folder)
    path = folder / Path(name).name
    read = {
        "scenes": lambda: read_scene_file(path),
        "harness": lambda: rodjax.read_scene(path),
        "fits": lambda: read_fit_files(folder / "fit.toml", folder / "data.csv"),
        "routes": lambda: read_route_file(folder / "brake_line.toml", for_route=True),
    }[name.partition("/")[0]]
    text = path.read_text()
    found = list(QUOTED.finditer(text))
    assert len(found) >= 4
    for match in found:
        path.write_text(f'{text[: match.start()]}"{WAYS[way].format(unit=match[2])}"{text[match.end() :]}')
        with pytest.raises(SceneFileError) as caught:
            read()
        line = str(caught.value)
        assert "\n" not in line
        assert str(path) in line
        assert " must be " in line


SWEPT = {
    "rod.EI": "N m^2", "rod.mass_per_length": "kg/m", "rod.rest_twist": "rad/m", "end.spin": "rad",
    "end.position.0": "m", "start.tangent.1": "", "loads.gravity.2": "m/s^2", "loads.point_force.0.at": "m",
    "loads.distributed_force.0.force.0": "N/m", "clips.0.at": "m", "rod.poisson_ratio": "",
}  # fmt: skip


@pytest.mark.parametrize("key", SWEPT)
def test_a_decimal_comma_in_a_grid_or_table_is_refused_in_one_line(key, tmp_path):
    texts = [way.format(unit=SWEPT[key]).strip() for way in WAYS.values()] + ["1,1", "1_000", "1 1", "1;1"]
    for text, kind in itertools.product(texts, ("list", "from", "to", "csv")):
        value = f'"{text}"'
        path = tmp_path / ("table.csv" if kind == "csv" else "grid.toml")
        path.write_text(
            f"{key}\n1\n{value}\n"
            if kind == "csv"
            else f'"{key}" = [{value}]'
            if kind == "list"
            else f'"{key}" = {{ from = 1, to = 2, count = 2, {kind} = {value} }}'.replace(f"{kind} = 1, ", "").replace(
                f"{kind} = 2, ", ""
            )
        )
        with pytest.raises(SweepError) as caught:
            read_cases(path)
        assert "\n" not in str(caught.value)
        assert " must be " in str(caught.value) or " must have a unit" in str(caught.value)


@pytest.mark.parametrize("bad", ["1,1", "0,1", "1 1", "1_000", "1 m", "1 mm mm", "1 %"])
def test_a_decimal_comma_in_measurements_is_refused_in_one_line(bad, tmp_path):
    folder = shutil.copytree(EXPERIMENTS / "fits", tmp_path / "files")
    path = folder / "data.csv"
    header, first, *others = path.read_text().splitlines()
    for column in range(2, len(header.split(","))):
        cells = first.split(",")
        cells[column] = f'"{bad}"'
        path.write_text("\n".join([header, ",".join(cells), *others]))
        with pytest.raises(SceneFileError, match=r"data\.csv: line 2, column .* must be "):
            read_fit_files(folder / "fit.toml", path)
    for unit in (",1 mm", "1 mm", "0,1 mm", "%"):
        path.write_text("\n".join([header.replace("x [mm]", f'"x [{unit}]"'), first, *others]))
        with pytest.raises(SceneFileError, match=r"column x \[.*\]: the unit must be m or a like one"):
            read_fit_files(folder / "fit.toml", path)


# --- what would be read as nothing -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('"rod.EI" = [1]\nrod.EI = [2]', "rod.EI is given twice"),
        ('"rod.EI" = [1]\n[rod]\nEI = [2]', "rod.EI is given twice"),
        ('end."position.0" = [1]\n"end.position.0" = [2]', "end.position.0 is given twice"),
        ('"end.position.0" = [1]\n"end.position.00" = [2]', "end.position.00 is given twice"),
        ('"end.position.0" = [1]\n"end.position" = [[1, 0, 0]]', "end.position is given twice, or beside a component"),
        ('"rod.EI" = [1]\n"rod.GJ" = {}', "rod.GJ is an empty table"),
        ('"rod.EI" = [1]\n[rod]', "rod is an empty table"),
        ('"rod.EI" = [1]\n[end.position]', "end.position is an empty table"),
        ('"rod.EI" = []', "rod.EI must be a list of values"),
        ('"rod.ei" = [1]', "rod.ei cannot vary"),
    ],
)
def test_a_key_of_a_grid_counts_or_is_refused(text, said, tmp_path):
    (tmp_path / "grid.toml").write_text(text)
    with pytest.raises(SweepError, match=re.escape(said)):
        read_cases(tmp_path / "grid.toml")


def test_a_column_of_a_table_counts_or_is_refused(tmp_path):
    for header in ("rod.EI,rod.EI", "rod.EI, rod.EI ", "end.position.0,end.position.00", "rod.EI,", "rod.EI,note"):
        (tmp_path / "table.csv").write_text(f"{header}\n1,2\n")
        with pytest.raises(SweepError, match=r"is given twice|cannot vary"):
            read_cases(tmp_path / "table.csv")


def test_a_column_of_measurements_is_not_renamed_to_a_key(tmp_path):
    folder = shutil.copytree(EXPERIMENTS / "fits", tmp_path / "files")
    fit = folder / "fit.toml"
    fit.write_text(fit.read_text() + 'x = "end.position.2"\n')
    with pytest.raises(SceneFileError, match=r"experiments\.x must have another name"):
        read_fit_files(fit, folder / "data.csv")


def test_variables_of_loads_along_the_rod_are_forces_per_length(tmp_path):
    folder = shutil.copytree(EXPERIMENTS / "routes", tmp_path / "files")
    path, scene = folder / "brake_line.toml", folder / "scene.toml"
    scene.write_text(scene.read_text() + '[[loads.distributed_force]]\nforce = "[0, 0, 1] N/m"\n')
    variable = '\n[[variables]]\nkind = "between"\nkey = "distributed.0.force.2"\nlower = "0 N{0}"\nupper = "1 N{0}"\n'
    text = path.read_text()
    path.write_text(text + variable.format("/m"))
    varied = read_route_file(path).variables[-1]
    assert isinstance(varied, Between)
    assert float(varied.upper) == 1.0
    path.write_text(text + variable.format(""))
    with pytest.raises(SceneFileError, match=r"variables\[5\]\.lower must be in N/m"):
        read_route_file(path)
