"""The cases of a sweep: grids and tables of values of a scene file, and the scenes that they make.

`rodjax.sweeps` says what the files look like.
"""

import csv
import dataclasses
import io
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from rodjax.checks import line, shown
from rodjax.io.harness_file import HarnessFile
from rodjax.io.quantities import SceneFileError
from rodjax.io.scene_file import SceneFile, read_text, toml_tables
from rodjax.io.scene_keys import SceneVariations, cell, check_keys, si_number
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.programs.tasks import rows_of

# More than a grid of ten keys has; to read them takes a second.
MAX_CORNERS = 1024
# More cases than this are taken for a mistake: their results would fill 100 GB.
MAX_CASES = 100_000_000
# Of as many cases in a chunk the scenes are made at once: 2 ms for 1024, and 0.2 s to compile; one by one 2 ms each.
LEAST_ROWS = 128


class SweepError(ValueError):
    """What the user can mend; the message is one line."""


# --- the values ------------------------------------------------------------------------------------------------------


class Parameter(NamedTuple):
    """A key that varies, and its `values` (rows, ...) in SI units."""

    key: str
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
    check_keys(list(values))
    return [_parameter(key, _grid_values(value, key)) for key, value in values.items()]


def _flat(table: dict[str, Any], prefix: str) -> dict[str, Any]:
    """TOML makes tables of dotted keys without quotes: these are put together again."""
    values: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        is_table = isinstance(value, dict) and not {"from", "to", "count"} & set(value)
        if is_table and not value:
            raise SceneFileError(f"{line(name)} is an empty table; give it values, or leave it out")
        for found, given in (_flat(value, f"{name}.") if is_table else {name: value}).items():
            # "rod.EI" in quotes and the EI of a table rod are two keys of TOML, but one here.
            if found in values:
                raise SceneFileError(f"{line(found)} is given twice, in quotes and as a table")
            values[found] = given
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
    first, last = (si_number(table[name], key) for name in ("from", "to"))
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
    check_keys(header)
    for case, row in enumerate(rows):
        if len(row) != len(header):
            raise SceneFileError(f"case {case} has {len(row)} cells, the header has {len(header)}")
    return [_parameter(key, [cell(row[column]) for row in rows]) for column, key in enumerate(header)]


def _parameter(key: str, values: list[Any] | np.ndarray) -> Parameter:
    if isinstance(values, np.ndarray):
        return Parameter(key, values)
    numbers = []
    for k, value in enumerate(values):
        try:
            numbers.append(si_number(value, key))
        except SceneFileError as mistake:
            raise SceneFileError(f"value {k}: {mistake}") from None
    return Parameter(key, np.stack(numbers))


# --- the scenes ------------------------------------------------------------------------------------------------------


class CaseScenes:
    """Makes scenes by the ordinary reading of the scene file `scene`, with the values of a case of `over` in their
    places. Goes to other processes as what it is made of.
    """

    def __init__(self, scene: Path, over: Path, variations: SceneVariations):
        self._scene, self._over, self._variations = scene, over, variations

    def read(self, case: int, values: Mapping[str, np.ndarray], row: int) -> SceneFile | HarnessFile:
        """Of one case, whose values are in a row."""
        try:
            return self._variations.read({key: numbers[row] for key, numbers in values.items()})
        except SceneFileError as mistake:
            raise SweepError(f"{self._over}: case {case}: {mistake} (in {self._scene} with these values)") from None

    def scenes(self, cases: Int[np.ndarray, "k"], values: Mapping[str, np.ndarray]) -> list[Any]:
        return [self.read(int(case), values, row).scenes[0] for row, case in enumerate(cases)]

    def stacked(self, cases: Int[np.ndarray, "k"], values: Mapping[str, np.ndarray], size: int) -> Scene | Harness:
        """Of all cases, along a leading axis; so many, of which those that lack are the last case.

        Of many they are made column by column, and read one by one only where they may make no sense.
        """
        if size >= LEAST_ROWS:
            filled = {key: numbers[rows_of(0, size, len(cases))] for key, numbers in values.items()}
            found = self._variations.stacked(filled)
            if found is not None:
                stack, is_suspect = found
                for row in np.flatnonzero(is_suspect[: len(cases)]):
                    self.read(int(cases[row]), values, int(row))
                return stack
        scenes = self.scenes(cases, values)
        return _stacked(scenes + scenes[-1:] * (size - len(cases)))


class CaseReader:
    """All that the two files of a sweep hold: its `cases`, the two texts, and the scenes of the cases."""

    def __init__(self, scene: Path, over: Path):
        self.cases, self.over_text = read_cases(over)
        try:
            self.scene_text = read_text(scene)
            content = toml_tables(self.scene_text)
            if "path" in content:
                raise SceneFileError("path is not allowed in a sweep, which is over single scenes; leave [[path]] out")
            variations = SceneVariations(content, [parameter.key for parameter in self.cases.parameters])
        except SceneFileError as mistake:
            raise SweepError(f"{scene}: {mistake}") from None
        self.of_cases = CaseScenes(scene, over, variations)
        self.first = self.of_cases.read(0, self.cases.of(np.array([0])), 0)
        variations.in_si()

    def scenes(self, cases: Int[np.ndarray, "k"]) -> list[Any]:
        return self.of_cases.scenes(cases, self.cases.of(cases))


def _stacked(scenes: list[Any]) -> Any:
    """One scene with a leading axis on every leaf. What many scenes share is one array, which is looked at once."""
    known: dict[int, np.ndarray] = {}

    def stacked(*leaves: jax.Array) -> jax.Array:
        for leaf in leaves:
            if id(leaf) not in known:
                known[id(leaf)] = np.asarray(leaf)
        return jax.device_put(np.stack([known[id(leaf)] for leaf in leaves]))

    return jax.tree.map(stacked, *scenes)
