"""Tables and numbers with units from a scene file: keys, shapes, SI values, and errors that say what is allowed.

Quantities are strings such as "[50, 0, 0] cm"; what has no dimension is a plain number or list.
"""

import functools
import json
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rodjax.checks import line, namespace, shown

# SI unit (none: a plain number), shape and an example of every key that holds numbers, as many as its shape says.
QUANTITIES: dict[str, tuple[str, tuple[int, ...], str]] = {
    "length": ("m", (), '"1 m"'),
    "radius": ("m", (), '"5 mm"'),
    "outer_radius": ("m", (), '"5 mm"'),
    "inner_radius": ("m", (), '"4 mm"'),
    "youngs_modulus": ("Pa", (), '"10 MPa"'),
    "shear_modulus": ("Pa", (), '"3.3 MPa"'),
    "poisson_ratio": ("", (), "0.5"),
    "density": ("kg/m^3", (), '"1200 kg/m^3"'),
    "EI": ("N m^2", (), '"4.9e-3 N m^2"'),
    "EI1": ("N m^2", (), '"4.9e-3 N m^2"'),
    "EI2": ("N m^2", (), '"2.5e-3 N m^2"'),
    "GJ": ("N m^2", (), '"3.3e-3 N m^2"'),
    "EA": ("N", (), '"785 N"'),
    "GA": ("N", (), '"260 N"'),
    "GA1": ("N", (), '"260 N"'),
    "GA2": ("N", (), '"260 N"'),
    "mass_per_length": ("kg/m", (), '"0.1 kg/m"'),
    "rest_curvature_1": ("1/m", (), '"2 1/m"'),
    "rest_curvature_2": ("1/m", (), '"0 1/m"'),
    "rest_twist": ("rad/m", (), '"0.5 rad/m"'),
    "rest_strain": ("", (), "0.002"),
    "width": ("m", (), '"10 mm"'),
    "height": ("m", (), '"1 mm"'),
    "wires": ("", (), "7"),
    "wire_radius": ("m", (), '"0.5 mm"'),
    "stick": ("", (), "0.2"),
    "position": ("m", (3,), '"[0.8, 0, 0] m"'),
    "tangent": ("", (3,), "[1, 0, 0]"),
    "d2": ("", (3,), "[0, 1, 0]"),
    "frame": ("", (3, 3), "[[0, 0, 1], [0, 1, 0], [-1, 0, 0]]"),
    "spin": ("rad", (), '"90 deg"'),
    "turns": ("", (), "1"),
    "force": ("N", (3,), '"[0, 0, -0.2] N"'),
    "moment": ("N m", (3,), '"[0, 0.01, 0] N m"'),
    "couple": ("N m/m", (3,), '"[0, 0, 0.01] N m/m"'),
    "axis": ("", (3,), "[0, 1, 0]"),
    "offset": ("m", (3,), '"[0, 5, 0] mm"'),
    "mass": ("kg", (), '"0.05 kg"'),
    "translation": ("N/m", (), '"1e4 N/m"'),
    "rotation": ("N m/rad", (), '"0.5 N m/rad"'),
    "gravity": ("m/s^2", (3,), '"[0, 0, -9.81] m/s^2"'),
    "at": ("m", (), '"0.5 m"'),
    "segments": ("", (), "50"),
    "rtol": ("", (), "1e-3"),
    "steps": ("", (), "10"),
}
# The same of keys that mean something else in one table, by the name of that table.
OF_TABLES: dict[str, dict[str, tuple[str, tuple[int, ...], str]]] = {
    "distributed_force": {"force": ("N/m", (3,), '"[0, 0, -0.2] N/m"'), "part": ("m", (2,), '"[0.2, 0.5] m"')},
    "point_couple": {"couple": ("N m", (3,), '"[0, 0, 0.01] N m"')},
    "distributed_couple": {"part": ("m", (2,), '"[0.2, 0.5] m"')},
    "obstacles": {
        "point": ("m", (3,), '"[0, 0, -0.1] m"'),
        "normal": ("", (3,), "[0, 0, 1]"),
        "center": ("m", (3,), '"[0.2, 0, 0] m"'),
        "start": ("m", (3,), '"[0, 0, 0] m"'),
        "end": ("m", (3,), '"[0.3, 0, 0] m"'),
        "size": ("m", (3,), '"[100, 50, 20] mm"'),
        "unit": ("m", (), '"1 mm"'),
        "friction": ("", (), "0.3"),
    },
    "limits": {
        "bend_radius": ("", (), "6"),
        "clip_force": ("N", (), '"20 N"'),
        "clip_moment": ("N m", (), '"0.5 N m"'),
        "end_force": ("N", (), '"20 N"'),
        "end_moment": ("N m", (), '"0.5 N m"'),
        "twist": ("rad/m", (), '"90 deg/m"'),
        "strain": ("", (), "0.01"),
        "stability": ("N", (), '"0.1 N"'),
        "mass": ("kg", (), '"0.2 kg"'),
        "energy": ("J", (), '"1 J"'),
    },
    "objective": {
        "length": ("", (), "1"),
        "mass": ("", (), "1"),
        "energy": ("", (), "1"),
        "end_force": ("", (), "0.1"),
        "clips": ("", (), "0.5"),
        "clip_scale": ("N", (), '"0.1 N"'),
    },
    "variables": {
        "start": ("m", (3,), '"[0, 0, 0] m"'),
        "end": ("m", (3,), '"[0.3, 0, 0] m"'),
        "corner": ("m", (3,), '"[0, 0, 0] m"'),
        "edge1": ("m", (3,), '"[100, 0, 0] mm"'),
        "edge2": ("m", (3,), '"[0, 100, 0] mm"'),
        "angle": ("rad", (), '"30 deg"'),
    },
}
# The same of keys that hold lists, of any length where the shape has `None`.
LISTS: dict[str, tuple[str, tuple[int | None, ...], str]] = {
    "radii": ("m", (None,), '"[0, 2, 3] mm"'),
    "youngs_moduli": ("Pa", (None,), '"[1, 50] MPa"'),
    "shear_moduli": ("Pa", (None,), '"[0.3, 17] MPa"'),
    "poisson_ratios": ("", (None,), "[0.5, 0.4]"),
    "densities": ("kg/m^3", (None,), '"[1100, 1200] kg/m^3"'),
    "points": ("m", (None, 3), '"[[0, 0, 0], [1, 0, 0], [2, 0.5, 0], [3, 1, 0]] cm"'),
    "directions": ("", (None, 3), "[[1, 0, 0]]"),
    "jumps": ("m", (None,), '"[0.5] m"'),
    "s": ("m", (None,), '"[0, 0.5, 1] m"'),
}
# Keys whose vectors get the length 1.
DIRECTIONS = ("tangent", "d2", "normal", "axis")
NUMBER = r"[-+]?(?:nan|inf|(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[-+]?[0-9]+)?)"
NUMBER_AND_UNIT = re.compile(rf"\s*(\[.*\]|{NUMBER})\s*(.*?)\s*", re.I | re.S)
# A unit has names, exponents of them, signs of products and quotients, and the 1 of "1/m". Other numbers, signs and
# commas are of a second number, or of one with a decimal comma.
_EXPONENT = re.compile(r"(?:\^|\*\*)\s*(?:[-+]?[0-9]+|\(\s*[-+]?[0-9]+(?:\s*/\s*[0-9]+)?\s*\))")
_NAME = re.compile(r"[^\W\d]\w*|[°%]")
_NAMES = re.compile(r"(?:1\s*/)?[\s()*/·⋅×u]*u[\s()*/·⋅×u]*")
# No unit is longer.
MOST_OF_A_UNIT = 100
# A power of a number is no unit, and one such as 9**9**9 would take forever.
NUMBER_TO_A_POWER = re.compile(r"[\d⁰¹²³⁴-⁹]\s*(\*\*|\^|[⁰¹²³⁴-⁹])")


class SceneFileError(ValueError):
    """A mistake in a scene file. The message is one line with the file, the key and what is allowed."""


@contextmanager
def named(where: str) -> Iterator[None]:
    """Makes errors of the file of those of a constructor: puts the table before the key with which they begin."""
    try:
        yield
    except SceneFileError:
        raise
    except (TypeError, ValueError) as error:
        is_key = re.split(r"\W", str(error), maxsplit=1)[0] in (*QUANTITIES, *LISTS, *of_table(where), "values")
        raise SceneFileError(f"{where}{'.' if is_key else ': '}{error}") from None


@contextmanager
def in_file(path: Path) -> Iterator[None]:
    """Puts the name of the file before mistakes in it."""
    try:
        yield
    except SceneFileError as mistake:
        raise SceneFileError(f"{path}: {' '.join(str(mistake).split())}") from None


def check_keys(table: Any, where: str, required: Sequence[str], optional: Sequence[str]) -> dict[str, Any]:
    """The table, where it is one with all the required keys and no others than these and the optional ones."""
    _check_table(table, where)
    prefix = f"{where}." if where else ""
    allowed = (*required, *optional)
    for key in table:
        if key not in allowed:
            raise SceneFileError(
                f"{prefix}{line(key) or shown(key)} is not allowed here; allowed are {', '.join(allowed)}"
            )
    for key in required:
        if key not in table:
            is_table = not any(key in keys for keys in (of_table(where), QUANTITIES, LISTS))
            example = f"a table [{key}]" if is_table else f"{key} = {quantity(key, where)[2]}"
            raise SceneFileError(f"{prefix}{key} is missing, for example {example}")
    return table


def table_list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise SceneFileError(f"{where} must be a list of tables, each [[{where}]], got {shown(value)}")
    return value


def choice(table: Any, where: str, key: str, allowed: list[str]) -> str | None:
    """The one of the allowed names that the table has under the key; `None` where it has no such key."""
    _check_table(table, where)
    if key in table and table[key] not in allowed:
        raise SceneFileError(f"{where}.{key} must be one of {', '.join(allowed)}, got {shown(table[key])}")
    return table.get(key)


def quantity(key: str, where: str = "") -> tuple[str, tuple[int | None, ...], str]:
    """SI unit, shape and an example of a key in the table at that place."""
    return of_table(where).get(key) or QUANTITIES.get(key) or LISTS[key]


def of_table(where: str) -> dict[str, tuple[str, tuple[int, ...], str]]:
    """The keys that mean something of their own in the table at that place."""
    return next((keys for table, keys in OF_TABLES.items() if table in where), {})


def si_values(
    table: Any, where: str, required: Sequence[str], optional: Sequence[str], other: Sequence[str] = ()
) -> dict[str, Float[np.ndarray, "..."]]:
    """The numbers of a table in SI units. Keys in `other` may be there too and are left out."""
    check_keys(table, where, required, (*optional, *other))
    with named(where):
        return {key: si_value(value, key, *quantity(key, where)) for key, value in table.items() if key not in other}


def flag(table: dict[str, Any], where: str, key: str) -> bool:
    """Whether the key of a table is true; it is false where it is not given."""
    value = table.get(key, False)
    if not isinstance(value, bool):
        raise SceneFileError(f"{f'{where}.{key}' if where else key} must be true or false, got {shown(value)}")
    return value


def assignment(key: str, value: Any, unit: str) -> str:
    """The TOML from which `si_value` makes the same numbers to the last bit; `unit`: none of plain numbers."""
    numbers = np.asarray(value, float).tolist()
    return f'{key} = "{numbers} {unit}"' if unit else f"{key} = {numbers}"


def _check_table(table: Any, where: str) -> None:
    if not isinstance(table, dict):
        raise SceneFileError(f"{where} must be a table, [{where}], got {shown(table)}")


class InSI(NamedTuple):
    """In the place of what a file has: numbers in SI units of the right shape, which may be traced."""

    numbers: Any


def si_value(value: Any, key: str, si: str, shape: tuple[int | None, ...], example: str) -> Float[np.ndarray, "..."]:
    """A quantity or plain numbers of that shape, in units `si`; of a direction, the unit vector."""
    if isinstance(value, InSI):
        return _unit_vector(value.numbers) if key in DIRECTIONS else value.numbers

    def mistake(allowed: str, got: str = shown(value)) -> ValueError:
        return ValueError(f"{key} must {allowed}, for example {key} = {example}, got {got}")

    numbers, unit = value, ""
    if si:
        if not isinstance(value, str):
            raise mistake("have a unit")
        match = NUMBER_AND_UNIT.fullmatch(value)
        if match is None:
            raise mistake("be a number and a unit")
        numbers, unit = _parsed(match[1]), match[2]
    if not _has_shape(numbers, shape) or (unit and not is_unit(unit)):
        kind = _described(shape)
        point = ", with a decimal point" if isinstance(value, str) and "," in unit else ""
        raise mistake(f"be {kind} {'and a unit' if si else 'without quotes or unit'}{point}")
    if si and not unit:
        raise mistake("have a unit")
    factor = _factor(unit, si)
    if factor is None:
        raise mistake(f"be in {si} or a like unit", f"the unit {shown(unit)}")
    try:
        with np.errstate(over="ignore"):  # said below
            array = np.array(numbers, float) * factor
    except OverflowError:
        array = np.array(math.inf)
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{key} must be finite, got {shown(value)}")
    if key not in DIRECTIONS:
        return array
    if not np.any(array):
        raise ValueError(f"{key} must be a direction, got the zero vector")
    return _unit_vector(array)


def number_in(text: str) -> float | None:
    """The number that a text is, without a unit; `None` where it is not one."""
    return float(text) if re.fullmatch(rf"\s*{NUMBER}\s*", text, re.I) else None


def is_unit(text: str) -> bool:
    """Whether a text is written as a unit, known or not: not as a second number, or the rest of a decimal comma."""
    return len(text) <= MOST_OF_A_UNIT and _NAMES.fullmatch(_NAME.sub("u", _EXPONENT.sub(" ", text))) is not None


def _parsed(numbers: str) -> Any:
    if not numbers.startswith("["):
        return float(numbers)
    try:
        return json.loads(numbers, parse_int=float)
    except (ValueError, RecursionError):
        return None


def _has_shape(numbers: Any, shape: tuple[int | None, ...]) -> bool:
    """Whether numbers are in lists of these lengths; `None`: of any length but 0."""
    if shape == ():
        return isinstance(numbers, (int, float)) and not isinstance(numbers, bool)
    if not isinstance(numbers, list) or not numbers or len(numbers) != (shape[0] or len(numbers)):
        return False
    return all(_has_shape(x, shape[1:]) for x in numbers)


def _described(shape: tuple[int | None, ...]) -> str:
    if shape == ():
        return "a number"
    if shape[0] is None:
        return "a list of numbers" if len(shape) == 1 else f"a list of lists of {shape[1]} numbers"
    return f"{' x '.join(map(str, shape))} numbers"


def _unit_vector(vector: Any) -> Float[np.ndarray, "3"]:
    """The direction of a nonzero vector; itself to the last bit where it has the length 1."""
    xp = namespace(vector)
    unit = vector / xp.max(xp.abs(vector))
    unit = unit / xp.linalg.norm(unit)
    rounding = 4 * float(jnp.finfo(jnp.zeros(()).dtype).eps)
    return xp.where(xp.all(xp.abs(vector - unit) <= rounding), vector, unit)


@functools.lru_cache(maxsize=1024)
def _factor(unit: str, si: str) -> float | None:
    """How many SI units a unit is; `None` where it is no unit of this dimension."""
    if unit == si:
        return 1.0
    if NUMBER_TO_A_POWER.search(unit):
        return None
    units = _unit_registry()
    try:
        given, wanted = units.Unit(unit), units.Unit(si)
        return float(units.Quantity(1.0, given).to(wanted).magnitude) if _is_like(units, given, wanted) else None
    except Exception:  # pint raises anything, down to AssertionError, for what it cannot parse.
        return None


def _is_like(units: Any, given: Any, wanted: Any) -> bool:
    """Whether units of one dimension measure the same: of those without a dimension only angles do, as angles.

    A percent, a decibel or a count is no angle and no factor of a length. Of what is per length the radian may be left
    out or added: curvatures and twists go by either.
    """
    for name in given._units:
        one = units.Unit(name)
        if one.dimensionless and set(units.get_root_units(one)[1]._units) != {"radian"}:
            return False
    ratio = dict((units.get_root_units(given)[1] / units.get_root_units(wanted)[1])._units)
    radians = ratio.pop("radian", 0)
    per_length = wanted.dimensionality == units.Unit("1/m").dimensionality
    return not ratio and (radians == 0 or (per_length and abs(radians) == 1))


@functools.cache
def _unit_registry() -> Any:
    # Imported here: it takes half a second that plain SI units need not wait for.
    import pint

    return pint.UnitRegistry()
