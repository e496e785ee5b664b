"""Tables of measurements: what they say of each experiment, in SI units. `identification.files` has their format."""

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.checks import line, shown
from rodjax.io.quantities import SceneFileError, number_in, si_value
from rodjax.io.scene_keys import cell, check_keys, si_number

AXES = "xyz"
LOADS = {
    f"{end}_{kind}_{axis}": unit
    for end in ("start", "end")
    for kind, unit in (("force", "N"), ("moment", "N m"))
    for axis in AXES
}
# SI units of what is measured.
UNITS = {"s": "m", **dict.fromkeys(AXES, "m"), **LOADS}
TITLE = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?", re.S)


# Of which experiment a row is, of which repeat, and of which rod of a harness.
LABELS = ("experiment", "cluster", "cable")


class MeasuredRod(NamedTuple):
    """What was measured of a rod: `points` (m, d) [m], d = 2 or 3, m = 0 where there are none; `s` (m,) [m] or `None`;
    `loads`: by the names of their columns [N, N m].
    """

    points: Float[np.ndarray, "m d"]
    s: Float[np.ndarray, "m"] | None
    loads: dict[str, float]


class MeasuredRows(NamedTuple):
    """What a table says of one experiment. `rods`: by the names of the cables of a harness, `None` for the only rod;
    `values`: of keys of the scene, in SI units.
    """

    name: str
    cluster: str | None
    rods: dict[str | None, MeasuredRod]
    values: dict[str, Float[np.ndarray, "..."]]


class MeasuredTable(NamedTuple):
    """The experiments of a table; `axes`: of the coordinates of points; `keys`: of the scene, that vary."""

    experiments: list[MeasuredRows]
    axes: str
    keys: list[str]

    @property
    def rods(self) -> list[MeasuredRod]:
        return [rod for one in self.experiments for rod in one.rods.values()]


class _Column(NamedTuple):
    """`title` is as the table has it; `factor` makes SI units of numbers of what is measured."""

    place: int
    title: str
    name: str
    unit: str
    factor: float


class _Row(NamedTuple):
    line: int
    cells: list[str]


def read_table(text: str, names: Mapping[str, str]) -> MeasuredTable:
    """The content of a table. `names`: keys of the scene, by the names that their columns have instead.

    Raises `SceneFileError`, without the name of the file.
    """
    header, rows = _header_and_rows(text)
    columns = _columns(header, names)
    axes = "".join(axis for axis in AXES if axis in columns)
    keys = [name for name in columns if name not in (*LABELS, *UNITS)]
    groups: dict[str, list[_Row]] = {}
    for row in rows:
        name = row.cells[columns["experiment"].place]
        if not name:
            raise SceneFileError(f"line {row.line}, column {columns['experiment'].title}: is empty; it must be a name")
        groups.setdefault(name, []).append(row)
    return MeasuredTable([_experiment(name, group, columns, axes, keys) for name, group in groups.items()], axes, keys)


def _header_and_rows(text: str) -> tuple[list[str], list[_Row]]:
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    try:
        rows = [_Row(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if any(cells)]
    except csv.Error as error:
        raise SceneFileError(f"line {reader.line_num}: is not valid CSV: {error}") from None
    if len(rows) < 2:
        there = "only a header" if rows else "nothing"
        raise SceneFileError(f"holds {there}; it must have a header and one row for each measured point")
    header = rows.pop(0).cells
    if len(header) == 1 and ";" in header[0]:
        raise SceneFileError("columns must be separated by commas, got semicolons")
    for row in rows:
        if len(row.cells) != len(header):
            raise SceneFileError(f"line {row.line}: has {len(row.cells)} cells, the header has {len(header)}")
    return header, rows


# --- columns ---------------------------------------------------------------------------------------------------------


def _columns(header: Sequence[str], names: Mapping[str, str]) -> dict[str, _Column]:
    """By their names, those of the scene by their keys."""
    columns: dict[str, _Column] = {}
    for place, title in enumerate(header):
        column = _column(place, title, names)
        if column.name in columns:
            first = columns[column.name].title
            raise SceneFileError(f"column {line(title)} is given twice, first as {line(first)}")
        columns[column.name] = column
    keys = [name for name in columns if name not in (*LABELS, *UNITS)]
    if keys:
        check_keys(keys)
    for name, key in names.items():
        if key not in columns:
            raise SceneFileError(f"column {line(name)} is missing, which the fit file names in [experiments]")
    if "experiment" not in columns:
        raise SceneFileError("column experiment is missing, the name of the experiment that a row belongs to")
    axes = [axis for axis in AXES if axis in columns]
    if len(axes) < 2 and (axes or "s" in columns):
        missing = ", ".join(f"{axis} [m]" for axis in AXES if axis not in columns)
        raise SceneFileError(
            f"of the columns {missing} at least {2 - len(axes)} must be there: a point has two or three"
        )
    if not axes and not any(name in columns for name in LOADS):
        raise SceneFileError(
            "columns of what was measured are missing, such as s [m], x [m], y [m], z [m], end_force_x [N]"
        )
    return columns


def _column(place: int, title: str, names: Mapping[str, str]) -> _Column:
    match = TITLE.fullmatch(title)
    name, unit = (match["name"], match["unit"] or "") if match else (title, "")
    name = names.get(name, name)
    if name in LABELS:
        return _Column(place, title, name, "", 1.0)
    if name in UNITS:
        return _Column(place, title, name, unit, _factor(title, unit, UNITS[name]))
    try:
        check_keys([name])
    except SceneFileError:
        raise SceneFileError(
            f"column {line(title) or shown(title)} is not allowed; allowed are {', '.join(LABELS)}, "
            f"{', '.join(UNITS)}, keys of the scene such as end.position.0, and names in [experiments] of the fit file"
        ) from None
    return _Column(place, title, name, unit, 1.0)


def _factor(title: str, unit: str, si: str) -> float:
    try:
        return float(si_value(f"1 {unit or si}", "unit", si, (), f'"1 {si}"'))
    except ValueError:
        raise SceneFileError(f"column {line(title)}: the unit must be {si} or a like one, got {shown(unit)}") from None


# --- one experiment --------------------------------------------------------------------------------------------------


def _experiment(
    name: str, rows: Sequence[_Row], columns: Mapping[str, _Column], axes: str, keys: Sequence[str]
) -> MeasuredRows:
    def constant(column: str, read: Callable[[_Column, _Row], Any]) -> Any:
        return _constant(f"experiment {shown(name)}", columns[column], rows, read) if column in columns else None

    by_cable: dict[str | None, list[_Row]] = {}
    for row in rows:
        cable = _text(columns["cable"], row) if "cable" in columns else None
        if cable == "":
            raise SceneFileError(f"line {row.line}, column {columns['cable'].title}: is empty; it must be a name")
        by_cable.setdefault(cable, []).append(row)
    rods = {cable: _rod(name, cable, of_cable, columns, axes) for cable, of_cable in by_cable.items()}
    values = {key: constant(key, _scene_value) for key in keys}
    if not any(len(rod.points) or rod.loads for rod in rods.values()):
        raise SceneFileError(f"line {rows[0].line}: experiment {shown(name)} has no measured point or force")
    given = {key: value for key, value in values.items() if value is not None}
    return MeasuredRows(name, constant("cluster", _text), rods, given)


def _rod(name: str, cable: str | None, rows: Sequence[_Row], columns: Mapping[str, _Column], axes: str) -> MeasuredRod:
    of = f"experiment {shown(name)}" + ("" if cable is None else f", cable {shown(cable)}")
    points, s = _points(of, rows, columns, axes)
    loads = {load: _constant(of, columns[load], rows, _number) for load in LOADS if load in columns}
    return MeasuredRod(points, s, {load: number for load, number in loads.items() if number is not None})


def _text(column: _Column, row: _Row) -> str:
    return row.cells[column.place]


def _constant(of: str, column: _Column, rows: Sequence[_Row], read: Callable[[_Column, _Row], Any]) -> Any:
    """The one value of a column in rows of an experiment, or of a cable in it; `None` where its cells are empty."""
    given = [row for row in rows if row.cells[column.place]]
    values = [read(column, row) for row in given]
    for row, value in zip(given, values, strict=True):
        if not np.array_equal(value, values[0]):
            raise SceneFileError(
                f"line {row.line}, column {column.title}: must be the same in all rows of {of}, "
                f"got {shown(row.cells[column.place])} after {shown(given[0].cells[column.place])}"
            )
    return values[0] if values else None


def _points(
    of: str, rows: Sequence[_Row], columns: Mapping[str, _Column], axes: str
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "m"] | None]:
    coordinates = [columns[axis] for axis in axes]
    of_point = [*coordinates, *([columns["s"]] if "s" in columns else [])]
    used = [row for row in rows if any(row.cells[column.place] for column in of_point)]
    for row in used:
        for column in coordinates:
            if not row.cells[column.place]:
                raise SceneFileError(f"line {row.line}, column {column.title}: is empty; a point has {', '.join(axes)}")
    numbers = [_number(column, row) for row in used for column in coordinates]
    points = np.array(numbers).reshape(len(used), len(axes))
    if "s" not in columns or not any(row.cells[columns["s"].place] for row in used):
        return points, None
    for row in used:
        if not row.cells[columns["s"].place]:
            raise SceneFileError(
                f"line {row.line}, column {columns['s'].title}: is empty; other points of {of} "
                "have an arclength, all or none must"
            )
    return points, np.array([_number(columns["s"], row) for row in used])


def _number(column: _Column, row: _Row) -> float:
    text = row.cells[column.place]
    number = number_in(text)
    if number is None:
        raise SceneFileError(f"line {row.line}, column {column.title}: must be a number, got {shown(text)}")
    if not math.isfinite(number):
        raise SceneFileError(f"line {row.line}, column {column.title}: must be finite, got {shown(text)}")
    return number * column.factor


def _scene_value(column: _Column, row: _Row) -> Float[np.ndarray, "..."]:
    """In SI units, of a key of the scene."""
    text = row.cells[column.place]
    try:
        return si_number(f"{text} {column.unit}" if column.unit else cell(text), column.name)
    except SceneFileError as mistake:
        raise SceneFileError(f"line {row.line}, column {column.title}: {mistake}") from None
