"""Values by key, such as `end.position.2`, beside a scene file, and the scenes that the file makes with them.

Keys are those of the file with dots; one component of a vector goes by its number. Values are as the file has them, or
plain numbers in SI units. Of a harness they begin with `cables.NAME`, before a key of the scene of a cable, or
`joints.NAME`.
"""

import functools
import json
import logging
import pickle
import re
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rodjax.checks import Numbers, line, shown
from rodjax.io.harness_file import HarnessFile, harness_file
from rodjax.io.quantities import (
    NUMBER_AND_UNIT,
    QUANTITIES,
    InSI,
    SceneFileError,
    number_in,
    of_table,
    quantity,
    si_values,
)
from rodjax.io.scene_file import SceneFile, SceneReader, TracedReader
from rodjax.model.scene import Scene
from rodjax.solving.ranges import suspects

Place = tuple[str | int, ...]
# The tables whose numbers may vary.
TABLES = ("rod", "start", "end", "loads", "clips", "obstacles")
# Of a harness, whose tables have names.
OWNERS = ("cables", "joints")
_log = logging.getLogger("rodjax")


class SceneVariations:
    """The scenes of a file with other values in the places of some keys, by the ordinary reading of scene files.

    `content`: the tables of the file; `keys`: those that may get other values. Errors are `SceneFileError`s without the
    name of the file.
    """

    def __init__(self, content: dict[str, Any], keys: Sequence[str]):
        self._places = {key: _target(key) for key in keys}
        self._templates = {place: _template(content, key, place, of) for key, (place, of) in self._places.items()}
        self._content, self._reader = content, SceneReader()

    def in_si(self) -> None:
        """Puts the tables into SI units, in which numbers are read much faster; where there are many scenes."""
        self._content = {name: _in_si(table, name) for name, table in self._content.items()}

    def read(self, values: Mapping[str, Float[np.ndarray, "..."]]) -> SceneFile | HarnessFile:
        """With these values in SI units; keys without one keep what the file has."""
        numbers: dict[Place, np.ndarray] = {}
        for key, value in values.items():
            place, component = self._places[key]
            numbers.setdefault(place, self._templates[place].copy())[component] = value
        content = dict(self._content)
        for place, number in numbers.items():
            _put(content, place, _as_text(number, str(place[-1]), _dotted(place[:-1])))
        return harness_file(content) if "cables" in content else self._reader.read(content)

    def stacked(self, values: Mapping[str, Float[np.ndarray, "k ..."]]) -> tuple[Scene, Bool[np.ndarray, "k"]] | None:
        """The scenes with these values, along a leading axis, all made at once by a compiled program; and which of them
        are to be read by themselves, as they may make no sense. `None` where the scenes differ in more than numbers,
        and of harnesses, whose solves take longer than making them.
        """
        if "cables" in self._content:
            return None
        scenes = _program(pickle.dumps((self._content, self._places, self._templates)))
        try:
            stack = jax.tree.map(np.asarray, scenes(dict(values)))
        except (TypeError, ValueError) as error:  # of traced numbers that decide what there is
            _log.info("scenes are read one by one: %s", line(str(error)))
            return None
        return stack, suspects(stack)


_lock = threading.Lock()


def _program(packed: bytes) -> Callable[[dict[str, np.ndarray]], Scene]:
    """What makes stacked scenes of the values by key; one for all chunks that a process reads."""
    with _lock:
        return _made_program(packed)


@functools.lru_cache(maxsize=4)
def _made_program(packed: bytes) -> Callable[[dict[str, np.ndarray]], Scene]:
    content, places, templates = pickle.loads(packed)
    # On any mesh: none is chosen here.
    solve = {key: value for key, value in content.get("solve", {}).items() if key not in ("rtol", "segments")}
    content = content | {"solve": solve | {"segments": 1000}}

    def scene(values: dict[str, Float[Numbers, "..."]]) -> Scene:
        numbers: dict[Place, Numbers] = {}
        for key, value in values.items():
            place, component = places[key]
            number = jnp.asarray(numbers.get(place, templates[place]))
            numbers[place] = number.at[component].set(value) if component else value
        tables = dict(content)
        for place, number in numbers.items():
            _put(tables, place, InSI(number))
        return TracedReader().read(tables).scenes[0]

    return jax.jit(jax.vmap(scene))


# --- keys and values -------------------------------------------------------------------------------------------------


def check_keys(keys: Sequence[str]) -> None:
    """Raises `SceneFileError` for keys that cannot get values, or contradict each other."""
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


@functools.lru_cache  # of the bulk of a large table, whose keys are few
def _target(key: str) -> tuple[Place, tuple[int, ...]]:
    """Where a key is in the tables, and which component of its numbers is meant."""
    names = key.split(".")
    of_owner = 2 if names[0] in OWNERS and len(names) > 2 else 0
    numbers = [
        int(name) if k >= of_owner and re.fullmatch("[0-9]{1,9}", name) else None for k, name in enumerate(names)
    ]
    end = max((k + 1 for k, number in enumerate(numbers) if number is None), default=0)
    known = QUANTITIES | of_table(".".join(names[: max(end - 1, 0)]))
    is_in_table = (bool(of_owner) and names[0] == "joints") or names[of_owner] in TABLES
    if not is_in_table or names[end - 1] not in known:
        raise SceneFileError(
            f"{line(key)} cannot vary; allowed are the keys of {', '.join(TABLES[:-1])} and {TABLES[-1]} that hold "
            "numbers, such as rod.EI, end.position.2, loads.point_force.0.at, clips.0.position, obstacles.0.radius; of "
            "a harness cables.NAME.rod.EI, joints.NAME.mass"
        )
    place = tuple(name if number is None else number for name, number in zip(names[:end], numbers, strict=False))
    component = tuple(number for number in numbers[end:] if number is not None)
    shape = known[names[end - 1]][1]
    is_within = len(component) == len(shape) and all(k < size for k, size in zip(component, shape, strict=True))
    if component and not is_within:
        kind = f"{' x '.join(map(str, shape))} numbers, which count from 0" if shape else "a single number"
        raise SceneFileError(f"{key} is no component: {'.'.join(names[:end])} is {kind}")
    return place, component


def unit_of(key: str) -> str:
    """SI unit of the numbers of a key; 1 where they have no dimension."""
    place, _ = _target(key)
    return quantity(str(place[-1]), _dotted(place[:-1]))[0] or "1"


def si_number(value: Any, key: str) -> Float[np.ndarray, "..."]:
    """In SI units, of a value as the scene file has it, or plain numbers in SI units."""
    place, component = _target(key)
    where, name = _dotted(place[:-1]), str(place[-1])
    unit, shape, _ = _quantity(name, where)
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


def cell(text: str) -> Any:
    """A plain number or list as such, anything else as text with a unit."""
    number = number_in(text)
    if number is not None:
        return number
    try:
        return json.loads(text, parse_int=float) if text.startswith("[") else text
    except (ValueError, RecursionError):
        return text


# --- places ----------------------------------------------------------------------------------------------------------


def _template(content: dict[str, Any], key: str, place: Place, component: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """The numbers in SI units into which the values of a key are put."""
    if place[0] == "loads":
        content.setdefault("loads", {})
    table: Any = content
    for depth in range(1, len(place)):
        table = _entry(table, place[:depth], key)
    if not isinstance(table, dict):
        raise SceneFileError(f"{_dotted(place[:-1])} must be a table, got {shown(table)}")
    name = str(place[-1])
    if not component:
        return np.zeros(_quantity(name, _dotted(place[:-1]))[1])
    value = _entry(table, place, key)
    numbers = si_values({name: value}, _dotted(place[:-1]), (), (name,))[name]
    # A direction is kept as it was given; scenes make its length 1.
    return numbers if _quantity(name, _dotted(place[:-1]))[0] else np.asarray(value, float)


def _quantity(name: str, where: str) -> tuple[str, tuple[int, ...], str]:
    """As `quantity`, of a key that may vary."""
    return of_table(where).get(name) or QUANTITIES[name]


def _entry(table: Any, place: Place, key: str) -> Any:
    """What a table, or list of tables, has at the end of a place."""
    last: Any = place[-1]
    is_there = last in table if isinstance(table, dict) else isinstance(table, list) and last in range(len(table))
    if not is_there:
        raise SceneFileError(f"{_dotted(place)} is not there, so that {key} cannot vary")
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


def _in_si(table: Any, where: str) -> Any:
    """A table with all quantities in SI units."""
    if isinstance(table, list):
        return [_in_si(entry, where) for entry in table]
    if not isinstance(table, dict):
        return table

    def value(key: str, value: Any) -> Any:
        if isinstance(value, str) and key in QUANTITIES | of_table(where):
            with suppress(SceneFileError):  # each scene may have another value in its place
                return _as_text(si_values({key: value}, where, (), (key,))[key], key, where)
        return _in_si(value, f"{where}.{key}")

    return {key: value(key, entry) for key, entry in table.items()}
