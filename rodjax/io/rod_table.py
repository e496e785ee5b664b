"""The table `[rod]` of a scene file: the keys of each section, and the rod that they make."""

from typing import Any

from rodjax.checks import shown
from rodjax.io.part_reader import PartReader
from rodjax.io.quantities import LISTS, SceneFileError, check_keys, choice, flag, named, quantity, si_value
from rodjax.model.along import Along, Smooth, Steps
from rodjax.model.rod import Rod

_ELASTIC = ("shear_modulus", "poisson_ratio", "density")
_BENDING = ("EI", "EI1", "EI2")
_SHEAR = ("GA", "GA1", "GA2")
_REST = ("rest_curvature_1", "rest_curvature_2", "rest_twist")
# What makes the rod, and the keys it must and may have.
_SECTIONS = {
    "circular": (Rod.circular, ("length", "radius", "youngs_modulus"), _ELASTIC),
    "tube": (Rod.tube, ("length", "outer_radius", "inner_radius", "youngs_modulus"), _ELASTIC),
    "rectangular": (Rod.rectangular, ("length", "width", "height", "youngs_modulus"), (*_ELASTIC, *_REST)),
    "bundle": (Rod.bundle, ("length", "wires", "wire_radius", "youngs_modulus", "stick"), _ELASTIC),
    "layered": (Rod.layered, ("length", "radii", "youngs_moduli"), ("shear_moduli", "poisson_ratios", "densities")),
    "centerline": (
        Rod.from_centerline,
        ("points", "GJ", "EA"),
        (*_BENDING, *_SHEAR, "mass_per_length", "radius", "d2"),
    ),
    None: (Rod, ("length", "GJ", "EA"), (*_BENDING, *_SHEAR, "mass_per_length", "radius", *_REST, "rest_strain")),
}
# Those whose stiffnesses follow from their material.
_SHEARING = ("circular", "tube", "rectangular")
# The keys that may vary along the rod, and those of the pairs that the arguments of a rod are.
_VARYING = (*_BENDING, *_SHEAR, "GJ", "EA", "mass_per_length", "radius", *_REST, "rest_strain")
PAIRS = {"EI": ("EI1", "EI2"), "GA": ("GA1", "GA2"), "rest_curvature": ("rest_curvature_1", "rest_curvature_2")}


def rod_of(reader: PartReader, table: Any) -> Rod:
    section = choice(table, "rod", "section", [name for name in _SECTIONS if name])
    make, required, optional = _SECTIONS[section]
    may_shear = ("shear",) if section in _SHEARING else ()
    check_keys(table, "rod", required, (*optional, *may_shear, "section"))
    if section == "centerline" and "d2" not in table:
        raise SceneFileError(
            "rod.d2 is missing: where d2 of the first frame along the centerline points, for example d2 = [0, 1, 0]"
        )
    # Not the radius from which the stiffnesses of a circular section come.
    may_vary = [key for key in _VARYING if key != "radius" or key in optional]
    varying = {key: value for key, value in table.items() if key in may_vary and isinstance(value, dict)}
    other = ("section", *may_shear, *varying)
    values: dict[str, Any] = reader.si_values(table, "rod", (), (*required, *optional), other=other)
    values |= {key: reader.part(_along, key, value) for key, value in varying.items()}
    if may_shear and flag(table, "rod", "shear"):
        values["shear"] = True
    if "EI" in optional:
        _check_stiffnesses(table)
    for name, keys in PAIRS.items():
        pair = [values.pop(key) for key in keys if key in values]
        if len(pair) == 1:
            raise SceneFileError(f"rod.{keys[0]} and rod.{keys[1]} must be given both or neither, got only one of them")
        if pair:
            values[name] = tuple(pair)
    if "wires" in values:
        wires = float(values["wires"])
        values["wires"] = int(wires) if wires.is_integer() else wires
    if section == "layered" and ("shear_moduli" in values) == ("poisson_ratios" in values):
        raise SceneFileError("rod.shear_moduli or rod.poisson_ratios is needed, exactly one of them")
    with named("rod"):
        try:
            return make(**values)
        except (TypeError, ValueError) as error:
            raise ValueError(_by_keys(str(error))) from None


def _check_stiffnesses(table: dict[str, Any]) -> None:
    if not any(key in table for key in _BENDING):
        raise SceneFileError(f"rod.EI is missing, for example EI = {quantity('EI')[2]}; or rod.EI1 and rod.EI2")
    if "EI" in table and ("EI1" in table or "EI2" in table):
        raise SceneFileError("rod.EI is not allowed together with rod.EI1 and rod.EI2")
    if "GA" in table and ("GA1" in table or "GA2" in table):
        raise SceneFileError("rod.GA is not allowed together with rod.GA1 and rod.GA2")


def _by_keys(message: str) -> str:
    """A message of `Rod` about one of a pair, with the key that a file has for it."""
    for name, keys in PAIRS.items():
        for k, key in enumerate(keys):
            message = message.replace(f"{name}[{k}]", key)
    return message


def _along(reader: PartReader, key: str, table: dict[str, Any]) -> Along:
    """What varies along the rod, of a table of arclengths and values."""
    unit, where = quantity(key)[0], f"rod.{key}"
    kinds = {"jumps": Steps, "s": Smooth}
    places = next((places for places in kinds if set(table) == {places, "values"}), None)
    if places is None:
        raise SceneFileError(
            f"{where} must be a number and a unit, or a table of jumps and values, or of s and values, "
            f'for example {key} = {{ jumps = "[0.5] m", values = "[1, 4] {unit}" }}, got {shown(table)}'
        )
    with named(where):
        s = si_value(table[places], places, *LISTS[places])
        values = si_value(table["values"], "values", unit, (None,), f'"[1, 4] {unit}"')
        return kinds[places](s, values)
