"""Harnesses as TOML files: a table `[cables.NAME]` for each rod, and `[joints.NAME]` for bodies with loads or supports.

A complete example: a trunk that branches into two, one of them on a pin.

    contact = [["trunk", "left"]]  # optional: which cables touch one another; or true, for all that share no joint

    [cables.trunk.rod]             # the tables of a cable are those of `rodjax.io.scene_file`: rod, start, end, loads,
    section = "circular"           # clips, obstacles; and self_contact = true in [cables.trunk]
    length = "40 cm"
    radius = "5 mm"
    youngs_modulus = "10 MPa"
    poisson_ratio = 0.5
    density = "1200 kg/m^3"

    [cables.trunk.start]
    support = "clamp"
    position = "[0, 0, 0] m"
    tangent = [1, 0, 0]
    d2 = [0, 1, 0]

    [cables.trunk.end]
    support = "joint"
    joint = "y"                    # the end is fixed in the body of this name
    tangent = [1, 0, 0]            # optional: how, in its axes; with d2, or frame; else along the third
    d2 = [0, 1, 0]
    offset = "[0, 0, 0] mm"        # optional: where, in its axes

    [cables.left]
    rod = { section = "circular", length = "30 cm", radius = "3 mm", youngs_modulus = "10 MPa", poisson_ratio = 0.5 }
    start = { support = "joint", joint = "y", tangent = [1, 0.5, 0], d2 = [0, 0, 1] }
    end = { support = "clamp", position = "[60, 15, 0] cm", tangent = [1, 0, 0], d2 = [0, 0, 1] }

    [cables.right]
    rod = { section = "circular", length = "30 cm", radius = "3 mm", youngs_modulus = "10 MPa", poisson_ratio = 0.5 }
    start = { support = "joint", joint = "y", tangent = [1, -0.5, 0], d2 = [0, 0, 1] }
    end = { support = "pin", position = "[60, -15, 0] cm" }

    [joints.y]                     # optional
    mass = "20 g"                  # all of these are optional: also force, moment, and support = "pin", "clamp",
    force = "[0, 0, -0.1] N"       # "hinge" or "slider" with its keys

    [loads]                        # optional, of all cables that have none of their own
    gravity = "[0, 0, -9.81] m/s^2"

    [[obstacles]]                  # optional, of all cables that have none of their own: keys as in scene files
    kind = "plane"
    point = "[0, 0, -20] cm"
    normal = [0, 0, 1]

    [solve]                        # optional: rtol, segments of each cable, strain_limit
    rtol = 1e-3
"""

import os
from typing import Any, NamedTuple

from rodjax.checks import file_path, shown, whole_number
from rodjax.io import scene_file
from rodjax.io.quantities import SceneFileError, check_keys, in_file, named, si_values
from rodjax.io.scene_file import SceneReader, read_text, toml_tables
from rodjax.io.support_tables import body_support
from rodjax.model.harness import Body, Harness
from rodjax.model.scene import Scene
from rodjax.solving.options import MAX_SEGMENTS, checked_rtol, checked_strain_limit
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT

HARNESS_TABLES = ("cables", "contact", "joints", "loads", "obstacles", "solve")
CABLE_TABLES = ("rod", "start", "end"), ("loads", "clips", "obstacles", "self_contact")


class HarnessFile(NamedTuple):
    """What a file holds: a harness, and settings of its solve or `None`."""

    harness: Harness
    segments: int | None
    rtol: float | None
    strain_limit: float = DEFAULT_STRAIN_LIMIT

    @property
    def scenes(self) -> list[Harness]:
        """The only one, as of a scene file."""
        return [self.harness]

    @property
    def discretization(self) -> None:
        """None is stated: harnesses are solved on elements."""
        return None

    @property
    def settings(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("segments", "rtol", "strain_limit")}


def read_scene(path: str | os.PathLike[str]) -> Scene | list[Scene] | Harness:
    """The scene in a TOML file, the list of scenes where the file has a `[[path]]`, or the harness where it has cables.

    Raises `SceneFileError` where the file cannot be read or holds invalid values. See `rodjax.io.scene_file` and this
    module for the formats.
    """
    if is_harness_file(path):
        return read_harness_file(path).harness
    return scene_file.read_scene(path)


def is_harness_file(path: str | os.PathLike[str]) -> bool:
    """Whether a file is that of a harness; raises `SceneFileError` where it cannot be read."""
    path = file_path(path, "path")
    with in_file(path):
        return "cables" in toml_tables(read_text(path))


def read_harness_file(path: str | os.PathLike[str]) -> HarnessFile:
    """Raises `SceneFileError` where the file cannot be read or holds invalid values."""
    path = file_path(path, "path")
    with in_file(path):
        return harness_file(toml_tables(read_text(path)))


def harness_file(content: dict[str, Any]) -> HarnessFile:
    check_keys(content, "", HARNESS_TABLES[:1], HARNESS_TABLES[1:])
    for name in ("cables", "joints"):
        table = content.get(name, {})
        if not isinstance(table, dict) or not all(isinstance(one, dict) for one in table.values()):
            raise SceneFileError(f"{name} must hold a table for each, [{name}.NAME], got {shown(table)}")
    shared = check_keys(content.get("loads", {}), "loads", (), ("gravity",))
    around = content.get("obstacles", [])
    if not isinstance(around, list):
        raise SceneFileError(f"obstacles must be tables [[obstacles]], got {shown(around)}")
    solve = check_keys(content.get("solve", {}), "solve", (), ("segments", "rtol", "strain_limit"))
    with named("solve"):
        segments = whole_number(solve["segments"], "segments", 2, MAX_SEGMENTS) if "segments" in solve else None
        rtol = checked_rtol(solve["rtol"]) if "rtol" in solve else None
        strain_limit = float(checked_strain_limit(solve.get("strain_limit", DEFAULT_STRAIN_LIMIT)))
    if segments is not None and rtol is not None:
        raise SceneFileError("solve.rtol is not allowed together with solve.segments: it chooses the segments")
    reader, cables = SceneReader(), {}
    for name, table in content["cables"].items():
        where = f"cables.{name}"
        check_keys(table, where, *CABLE_TABLES)
        loads = shared | table.get("loads", {}) if isinstance(table.get("loads", {}), dict) else table["loads"]
        try:
            near = table.get("obstacles", around)
            cables[name] = reader.read(table | {"loads": loads} | ({"obstacles": near} if near else {})).scenes[0]
        except SceneFileError as error:
            # What all cables have in common is named as it stands in the file.
            is_common = str(error).startswith(tuple({"loads", "obstacles"} - table.keys()))
            raise SceneFileError(str(error) if is_common else f"{where}.{error}") from None
    joints = {name: _body(reader, table, f"joints.{name}") for name, table in content.get("joints", {}).items()}
    try:
        return HarnessFile(Harness(cables, joints, content.get("contact", False)), segments, rtol, strain_limit)
    except (ValueError, TypeError) as error:
        raise SceneFileError(str(error)) from None


def _body(reader: SceneReader, table: dict[str, Any], where: str) -> Body:
    own = {key: value for key, value in table.items() if key in ("force", "moment", "mass")}
    rest = {key: value for key, value in table.items() if key not in own}
    numbers = si_values(own, where, (), ("force", "moment", "mass"))
    support = body_support(reader, rest, where) if rest else None
    with named(where):
        return Body(**numbers, support=support)
