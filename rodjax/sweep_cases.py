"""The cases of a sweep: grids and tables of values of a scene file, and the scenes that they make.

`rodjax.sweep` says what the files look like.
"""

import csv
import dataclasses
import io
import itertools
import json
import math
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rodjax.checks import line, shown
from rodjax.quantities import NUMBER_AND_UNIT, QUANTITIES, SceneFileError, quantity, si_values
from rodjax.scene import Scene
from rodjax.scene_file import SceneFile, SceneReader, read_text, toml_tables

# More than a grid of ten keys has; to read them takes a second.
MAX_CORNERS = 1024
# More cases than this are taken for a mistake: their results would fill 100 GB.
MAX_CASES = 100_000_000

Place = tuple[str | int, ...]


class SweepError(ValueError):
    """What the user can mend; the message is one line."""


# --- the values ------------------------------------------------------------------------------------------------------


class Parameter(NamedTuple):
    """A key that varies: `values` (rows, ...) in SI units, put into the tables at `place`, there at `component`."""

    key: str
    place: Place
    component: tuple[int, ...]
    values: Float[np.ndarray, "rows ..."]


@dataclasses.dataclass(frozen=True)
class Cases:
    """All cases of a grid (`is_product`) or table; nothing is written out case by case."""

    parameters: list[Parameter]
    is_product: bool

    @property
    def count(self) -> int:
        sizes = [len(parameter.values) for parameter in self.parameters]
        return math.prod(sizes) if self.is_product else sizes[0]

    def of(self, cases: Int[np.ndarray, "k"]) -> dict[str, Float[np.ndarray, "k ..."]]:
        """The values of some cases, by key."""
        rows = [cases] * len(self.parameters)
        if self.is_product:
            rows = np.unravel_index(cases, [len(parameter.values) for parameter in self.parameters])
        return {p.key: p.values[row] for p, row in zip(self.parameters, rows, strict=True)}

    def extremes(self) -> list[int]:
        """The cases with the least and largest numbers, of a grid its corners, in which mistakes show first."""
        rows = [_extreme_rows(parameter.values) for parameter in self.parameters]
        if not self.is_product:
            return sorted(set().union(*rows))
        sizes = [len(parameter.values) for parameter in self.parameters]
        corners = itertools.islice(itertools.product(*rows), MAX_CORNERS)
        return sorted(int(np.ravel_multi_index(corner, sizes)) for corner in corners)


def _extreme_rows(values: Float[np.ndarray, "rows ..."]) -> set[int]:
    flat = values.reshape(len(values), -1)
    return set(np.argmin(flat, axis=0).tolist() + np.argmax(flat, axis=0).tolist())


def read_cases(path: Path) -> tuple[Cases, str]:
    """The cases in a grid or table, and its text."""
    try:
        text = read_text(path)
        if path.suffix == ".csv":
            return Cases(_table(text), False), text
        if path.suffix == ".toml":
            cases = Cases(_grid(toml_tables(text)), True)
            if cases.count > MAX_CASES:
                raise SceneFileError(f"must have at most {MAX_CASES} cases, got {cases.count:.1e}")
            return cases, text
        raise SceneFileError("a grid ends in .toml, a table in .csv")
    except SceneFileError as mistake:
        raise SweepError(f"{path}: {mistake}") from None


def _grid(content: dict[str, Any]) -> list[Parameter]:
    values = _flat(content, "")
    _check_keys(list(values))
    return [_parameter(key, _grid_values(value, key)) for key, value in values.items()]


def _flat(table: dict[str, Any], prefix: str) -> dict[str, Any]:
    """TOML makes tables of dotted keys without quotes: these are put together again."""
    values = {}
    for key, value in table.items():
        if isinstance(value, dict) and not {"from", "to", "count"} & set(value):
            values |= _flat(value, f"{prefix}{key}.")
        else:
            values[f"{prefix}{key}"] = value
    return values


def _grid_values(value: Any, key: str) -> list[Any] | np.ndarray:
    if isinstance(value, dict):
        return _range(value, key)
    if not isinstance(value, list) or not value:
        raise SceneFileError(
            f"{key} must be a list of values or {{ from = 1, to = 2, count = 11 }}, got {shown(value)}"
        )
    return value


def _range(table: dict[str, Any], key: str) -> Float[np.ndarray, "rows ..."]:
    allowed = ("from", "to", "count", "spacing")
    if not set(allowed[:3]) <= set(table) <= set(allowed):
        raise SceneFileError(f"{key} must have from, to, count and optionally spacing, got {', '.join(table)}")
    count, spacing = table["count"], table.get("spacing", "linear")
    if isinstance(count, bool) or not isinstance(count, int) or not 2 <= count <= MAX_CASES:
        raise SceneFileError(f"{key}.count must be a whole number from 2 to {MAX_CASES}, got {shown(count)}")
    first, last = (_si_number(table[name], *_target(key)) for name in ("from", "to"))
    with np.errstate(over="ignore"):
        if not np.all(np.isfinite(last - first)):
            raise SceneFileError(f"{key}.from and {key}.to must not be further apart than numbers reach")
    if spacing == "linear":
        return np.linspace(first, last, count)
    if spacing != "log":
        raise SceneFileError(f"{key}.spacing must be one of linear, log, got {shown(spacing)}")
    if np.any(first <= 0) or np.any(last <= 0):
        raise SceneFileError(f"{key}.from and {key}.to must be positive for a spacing of log")
    return np.geomspace(first, last, count)


def _table(text: str) -> list[Parameter]:
    try:
        rows = [row for row in csv.reader(io.StringIO(text), skipinitialspace=True) if row]
    except csv.Error as error:
        raise SceneFileError(f"is not valid CSV: {error}") from None
    if len(rows) < 2:
        raise SceneFileError("must have a header of keys and a row for each case")
    header = [key.strip() for key in rows.pop(0)]
    _check_keys(header)
    for case, row in enumerate(rows):
        if len(row) != len(header):
            raise SceneFileError(f"case {case} has {len(row)} cells, the header has {len(header)}")
    return [_parameter(key, [_cell(row[column]) for row in rows]) for column, key in enumerate(header)]


def _cell(text: str) -> Any:
    """A plain number or list as such, anything else as text with a unit."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return json.loads(text, parse_int=float) if text.startswith("[") else text
    except (ValueError, RecursionError):
        return text


def _check_keys(keys: list[str]) -> None:
    if not keys:
        raise SceneFileError('holds no keys; give values to vary, such as "rod.EI" = [0.004, 0.005]')
    components: dict[Place, list[tuple[int, ...]]] = {}
    for key in keys:
        place, component = _target(key)
        before = components.setdefault(place, [])
        # A component beside the whole is as contradictory as the same twice.
        if before and (component in before or not component or () in before):
            raise SceneFileError(f"{key} is given twice, or beside a component of it")
        before.append(component)


def _target(key: str) -> tuple[Place, tuple[int, ...]]:
    """Where a key is in the tables, and which component of its numbers is meant."""
    names = key.split(".")
    numbers = [int(name) if re.fullmatch("[0-9]{1,9}", name) else None for name in names]
    end = max((k + 1 for k, number in enumerate(numbers) if number is None), default=0)
    if names[0] not in ("rod", "start", "end", "loads") or names[end - 1] not in QUANTITIES:
        raise SceneFileError(
            f"{line(key)} cannot be swept; allowed are the keys of rod, start, end and loads that hold numbers, "
            "such as rod.EI, end.position.2, loads.point_force.0.at"
        )
    place = tuple(name if number is None else number for name, number in zip(names[:end], numbers, strict=False))
    component = tuple(number for number in numbers[end:] if number is not None)
    shape = QUANTITIES[names[end - 1]][1]
    is_within = len(component) == len(shape) and all(k < size for k, size in zip(component, shape, strict=True))
    if component and not is_within:
        kind = f"{' x '.join(map(str, shape))} numbers, which count from 0" if shape else "a single number"
        raise SceneFileError(f"{key} is no component: {'.'.join(names[:end])} is {kind}")
    return place, component


def _parameter(key: str, values: list[Any] | np.ndarray) -> Parameter:
    place, component = _target(key)
    if isinstance(values, np.ndarray):
        return Parameter(key, place, component, values)
    numbers = []
    for k, value in enumerate(values):
        try:
            numbers.append(_si_number(value, place, component))
        except SceneFileError as mistake:
            raise SceneFileError(f"value {k}: {mistake}") from None
    return Parameter(key, place, component, np.stack(numbers))


def _si_number(value: Any, place: Place, component: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """A value as the scene file has it, or a plain number in SI units."""
    where, name = _dotted(place[:-1]), str(place[-1])
    unit, shape = quantity(name, where)[0], QUANTITIES[name][1]
    is_scalar = not shape or bool(component)
    # The bulk of a large table, which must not wait for the parsing of text.
    if is_scalar and type(value) in (int, float) and abs(value) <= sys.float_info.max:
        return np.asarray(value, float)
    if unit and not isinstance(value, str):
        value = f"{value} {unit}"
    if not component:
        number = si_values({name: value}, where, (), (name,))[name]
        # A direction is kept as it was given; scenes make its length 1.
        return number if unit else np.asarray(value, float)
    match = NUMBER_AND_UNIT.fullmatch(value) if unit else None
    if match is None or match[1].startswith("["):
        raise SceneFileError(
            f"a component of {_dotted(place)} must be a number{' and a unit' if unit else ''}, got {shown(value)}"
        )
    same = np.full(shape, float(match[1])).tolist()
    return si_values({name: f"{same} {match[2]}"}, where, (), (name,))[name][component]


# --- the scenes ------------------------------------------------------------------------------------------------------


class CaseReader:
    """Makes scenes by the ordinary reading of the scene file, with the values of a case in their places."""

    def __init__(self, scene: Path, over: Path):
        self.cases, self.over_text = read_cases(over)
        self._scene, self._over, self._reader = scene, over, SceneReader()
        try:
            self.scene_text = read_text(scene)
            self._content = toml_tables(self.scene_text)
            if "path" in self._content:
                raise SceneFileError("path is not allowed in a sweep, which is over single scenes; leave [[path]] out")
            self._templates = {p.place: _template(self._content, p) for p in self.cases.parameters}
        except SceneFileError as mistake:
            raise SweepError(f"{scene}: {mistake}") from None
        self.first = self._read(0, self.cases.of(np.array([0])), 0)
        # Numbers in SI units are read much faster than others.
        self._content = {name: _in_si(table) for name, table in self._content.items()}

    def scenes(self, cases: Int[np.ndarray, "k"]) -> list[Scene]:
        values = self.cases.of(cases)
        return [self._read(int(case), values, row).scenes[0] for row, case in enumerate(cases)]

    def _read(self, case: int, values: Mapping[str, np.ndarray], row: int) -> SceneFile:
        numbers = {place: template.copy() for place, template in self._templates.items()}
        for parameter in self.cases.parameters:
            numbers[parameter.place][parameter.component] = values[parameter.key][row]
        content = dict(self._content)
        for place, number in numbers.items():
            _put(content, place, _as_text(number, str(place[-1]), _dotted(place[:-1])))
        try:
            return self._reader.read(content)
        except SceneFileError as mistake:
            raise SweepError(f"{self._over}: case {case}: {mistake} (in {self._scene} with these values)") from None


def _template(content: dict[str, Any], parameter: Parameter) -> Float[np.ndarray, "..."]:
    """The numbers in SI units into which the values of a parameter are put."""
    place, key = parameter.place, parameter.key
    if place[0] == "loads":
        content.setdefault("loads", {})
    table: Any = content
    for depth in range(1, len(place)):
        table = _entry(table, place[:depth], key)
    if not isinstance(table, dict):
        raise SceneFileError(f"{_dotted(place[:-1])} must be a table, got {shown(table)}")
    name = str(place[-1])
    if not parameter.component:
        return np.zeros(QUANTITIES[name][1])
    value = _entry(table, place, key)
    numbers = si_values({name: value}, _dotted(place[:-1]), (), (name,))[name]
    # A direction is kept as it was given; scenes make its length 1.
    return numbers if QUANTITIES[name][0] else np.asarray(value, float)


def _entry(table: Any, place: Place, key: str) -> Any:
    """What a table, or list of tables, has at the end of a place."""
    last: Any = place[-1]
    is_there = last in table if isinstance(table, dict) else isinstance(table, list) and last in range(len(table))
    if not is_there:
        raise SceneFileError(f"{_dotted(place)} is not there, so that {key} cannot be swept")
    return table[last]


def _dotted(place: Place) -> str:
    return ".".join(map(str, place))


def _put(content: dict[str, Any], place: Place, value: Any) -> None:
    """Puts a value where it belongs; the tables on the way are copied, so that those of the file stay as they are."""
    table: Any = content
    for part in place[:-1]:
        table[part] = table[part].copy()
        table = table[part]
    table[place[-1]] = value


def _as_text(number: Float[np.ndarray, "..."], name: str, where: str) -> Any:
    unit = quantity(name, where)[0]
    return f"{number.tolist()} {unit}" if unit else number.tolist()


def _in_si(table: Any, where: str = "") -> Any:
    """A table with all quantities in SI units."""
    if isinstance(table, list):
        return [_in_si(entry, where) for entry in table]
    if not isinstance(table, dict):
        return table

    def value(key: str, value: Any) -> Any:
        if isinstance(value, str) and key in QUANTITIES:
            with suppress(SceneFileError):  # each case has another value in its place
                return _as_text(si_values({key: value}, where, (), (key,))[key], key, where)
        return _in_si(value, f"{where}.{key}")

    return {key: value(key, entry) for key, entry in table.items()}


def unit_of(key: str) -> str:
    """SI unit of the numbers of a key; 1 where they have no dimension."""
    place, _ = _target(key)
    return quantity(str(place[-1]), _dotted(place[:-1]))[0] or "1"
