"""Scenes as TOML files.

A complete example: a cable whose end is brought closer, then turned by one and a half turns. Quantities are strings
of a number, or a list of numbers, and any unit of the right dimension; what has no dimension is a plain number or list.

    [rod]
    section = "circular"           # or another one, see below
    length = "1 m"
    radius = "5 mm"
    youngs_modulus = "10 MPa"
    poisson_ratio = 0.5            # or shear_modulus = "3.3 MPa"
    density = "1200 kg/m^3"        # optional

    [start]
    support = "clamp"              # also "swivel": position, tangent; "pin": position; "free": optional force, moment
                                   # and follower = true where these turn with the end; "hinge": position, frame or
                                   # tangent and d2, axis = [0, 1, 0]; "slider": position, directions = [[1, 0, 0]],
                                   # optionally a frame; "joint", of a harness: see `rodjax.io.harness_file`
    position = "[0, 0, 0] m"
    tangent = [1, 0, 0]            # with d2 a 3x3 frame, its columns d1, d2, t; or frame = [[0, 0, 1], [0, 1, 0], ...]
    d2 = [0, 1, 0]                 # optional: the clocking, see below

    [end]
    support = "clamp"
    position = "[80, 0, 0] cm"
    tangent = [1, 0, 0]
    d2 = [0, 1, 0]
    spin = "0 deg"                 # optional: turns the frame of a clamp with a clocking about its own tangent
    # translation = "1e4 N/m"      # optional, of a clamp, pin, hinge or slider: springs about the support
    # rotation = "0.5 N m/rad"     # the same of all but a pin
    # turns = 1                    # optional: whole extra turns of the end frame, for two clamps and no path

    [loads]                        # optional
    gravity = "[0, 0, -9.81] m/s^2"

    [[loads.point_force]]          # any number of these
    at = "0.5 m"
    force = "[0, 0, -0.2] N"
    # follower = true              # optional: where it turns with the rod

    # [[loads.point_couple]]       # any number of these, too
    # at = "0.5 m"
    # couple = "[0, 0.01, 0] N m"
    # follower = true

    # [[loads.distributed_force]]  # any number of these, too: all along the rod
    # force = "[0, 0, -0.02] N/m"
    # part = "[0.2, 0.5] m"        # optional: the arclengths between which it acts
    # follower = true              # optional: where it turns with the rod
    # [[loads.distributed_couple]]
    # couple = "[0, 1e-5, 0] N m/m"

    # [[clips]]                    # any number of these, in the order of their arclengths
    # at = "0.4 m"
    # position = "[0.3, 0, -0.05] m"
    # tangent = [1, 0, 0]          # optional: where the clip holds the direction of the rod, too
    # d2 = [0, 1, 0]               # optional, with tangent: where it holds the twist, too, as a clamp does; or
    # spin = "90 deg"              # frame = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]; with either optionally spin
    # sliding = true               # optional: where the rod slides through; the search for its place begins at `at`

    # [[obstacles]]                # any number of these, see `rodjax.io.obstacle_tables`: they push the rod back
    # kind = "plane"
    # point = "[0, 0, -20] cm"
    # normal = [0, 0, 1]
    # friction = 0.3               # optional: Coulomb's coefficient; it acts along a path

    # self_contact = true          # optional, before the first table: the rod touches itself

    [solve]                        # optional
    rtol = 1e-3                    # error of the shape by the length, for which the mesh is chosen; or segments = 50
    discretization = "hermite"     # or "finite_difference"
    strain_limit = 0.05            # |axial strain| above which the result is remarked on; inf: never

    [[path]]                       # any number of these, one after another
    steps = 10                     # from what came before to these values in equal steps; 1 where it is not given
    end.position = "[50, 0, 0] cm"

    [[path]]
    steps = 18
    end.spin = "540 deg"

The keys of a rod, besides its section (optional ones in brackets; all but those of "centerline" have a length):

- none: EI = "4.9e-3 N m^2", or EI1 and EI2, GJ = "3.3e-3 N m^2", EA = "785 N" [mass_per_length = "0.1 kg/m", radius,
  rest_curvature_1 = "2 1/m" and rest_curvature_2, rest_twist = "0.5 rad/m", rest_strain = 0.002; GA = "260 N", or GA1
  and GA2: sections shear]
- "circular": radius, material; "tube": outer_radius, inner_radius, material [shear = true: GA of the material]
- "rectangular": width, height, material [rest_curvature_1 and rest_curvature_2, rest_twist, shear]
- "bundle": wires = 7, wire_radius, stick = 0.2, material
- "layered": radii = "[0, 2, 3] mm", youngs_moduli = "[1, 50] MPa", poisson_ratios or shear_moduli [densities]
- "centerline": points = "[[0, 0, 0], [1, 0, 0], ...] m", the shape without stress, d2 = [0, 1, 0], EI, or EI1 and EI2,
  GJ, EA [mass_per_length, radius, GA, or GA1 and GA2]

material: youngs_modulus, poisson_ratio or shear_modulus [density]. Stiffnesses, mass_per_length, rest curvatures, twist
and strain, and the radius where the section is none or "centerline", may vary along the rod: constant between jumps,
EI = { jumps = "[0.5] m", values = "[1, 4] N m^2" }, or smooth, { s = "[0, 0.5, 1] m", values = "[1, 3, 4] N m^2" }.

A clamp with a tangent alone says nothing of its clocking, the angle about that tangent. Such an end is fitted without
torsion: its frame follows the rod, which is a swivel in energy. Where one clamp alone resists a moment about the
tangent, of a free end or of couples along the rod, it does so, as any clocking then gives the same. Where the clocking
counts it must be stated, by d2 or frame: of all clamps of a rod whose section or shape without stress is not the same
all around (EI1 and EI2, strips, some bundles, rest curvatures, "centerline"), for `spin` and `turns`, which are of both
ends, for loads that follow the rod, and for couples along a rod between two clamps. So does d2 of "centerline", of the
first of its frames. No result depends on how the scene lies in space, or on what it does not say.

The main tables are the first scene of a path. Along it may change: position, tangent, d2, spin, force, moment of the
two ends, and loads.gravity. Tangents and d2 go along great circles, all else linearly. A step turns an end by less than
half a turn.
"""

import math
import os
import pickle
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import Numbers, file_path, is_known, leaf, namespace, shown, whole_number
from rodjax.io.clocking import Clocking, Values, is_unclocked
from rodjax.io.obstacle_tables import obstacle, with_direction
from rodjax.io.quantities import (
    LISTS,
    SceneFileError,
    check_keys,
    choice,
    flag,
    in_file,
    named,
    quantity,
    si_value,
    si_values,
    table_list,
)
from rodjax.model.along import Along, Smooth, Steps
from rodjax.model.loads import DistributedCouple, DistributedForce, PointCouple, PointForce
from rodjax.model.obstacles import Obstacle
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import (
    LEAST_ACROSS,
    Clamp,
    Clip,
    Free,
    Hinge,
    Joint,
    Pin,
    Slider,
    Spring,
    Support,
    Swivel,
    frame,
)
from rodjax.solving.options import MAX_SEGMENTS, Discretization, checked_options, checked_rtol, checked_strain_limit
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT

# More steps than this in one table are taken for a mistake: a full turn would go in steps of 0.04 degrees.
MAX_STEPS = 10_000

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
DISTRIBUTED = {"distributed_force": (DistributedForce, "force"), "distributed_couple": (DistributedCouple, "couple")}
_FRAME = ("frame", "tangent", "d2", "spin")
_SPRINGS = ("translation", "rotation")
# The keys that a support must have, may have, and may change along a path.
_SUPPORTS = {
    "clamp": (("position",), (*_FRAME, *_SPRINGS), ("position", "tangent", "d2", "spin")),
    "swivel": (("position", "tangent"), (), ("position", "tangent")),
    "pin": (("position",), ("translation",), ("position",)),
    "free": ((), ("force", "moment"), ("force", "moment")),
    "hinge": (("position", "axis"), (*_FRAME, *_SPRINGS), ()),
    "slider": (("position", "directions"), (*_FRAME, *_SPRINGS), ()),
    "joint": ((), (*_FRAME, "offset"), ()),
}
# Keys of a support that are no numbers.
_OTHER = {"free": ("support", "follower"), "joint": ("support", "joint")}
# How the scene's own error messages begin, and the keys that they are about.
_SCENE_KEYS = {
    "turns": "end.turns",
    "point_forces": "loads.point_force",
    "point_couples": "loads.point_couple",
    "distributed": "loads: distributed",
    "clips": "clips",
    "obstacles": "obstacles",
    "self_contact": "self_contact",
    "rod": "rod",
    "the start and clips": "clips: the start and clips",
    "the ends": "start.position, end.position: the ends",
    "": "start.support, end.support: ",
}

_SPIN_NEEDS_D2 = "{0}.d2 or {0}.frame is needed for {0}.spin, which turns it from there"
# Those that a file must have, and may have.
SCENE_TABLES = ("rod", "start", "end"), ("loads", "clips", "obstacles", "self_contact", "solve", "path")
# What is read of so many tables a reader keeps at most, about 10 MB.
MAX_KEPT = 10_000

Part = TypeVar("Part")


class SceneFile(NamedTuple):
    """What a file holds: `scenes`, one or those of a path; whether it `is_path`; settings of the solve or `None`;
    `unclocked`: "start" and "end" where they are clamps that do not say where their d2 points.
    """

    scenes: list[Scene]
    is_path: bool
    segments: int | None
    rtol: float | None
    discretization: Discretization | None
    strain_limit: float = DEFAULT_STRAIN_LIMIT
    unclocked: tuple[str, ...] = ()

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of the solve, of one scene or a path."""
        names = ("segments", "rtol", "discretization", "strain_limit")
        return {name: getattr(self, name) for name in names}


def read_scene(path: str | os.PathLike[str]) -> Scene | list[Scene]:
    """As `rodjax.read_scene`, of a file that is not one of a harness."""
    file = read_scene_file(path)
    return file.scenes if file.is_path else file.scenes[0]


def read_scene_file(path: str | os.PathLike[str]) -> SceneFile:
    """The scenes of a TOML file that is not one of a harness, with the settings of the solve."""
    path = file_path(path, "path")
    with in_file(path):
        return SceneReader().read(toml_tables(read_text(path)))


# --- tables ----------------------------------------------------------------------------------------------------------


def read_text(path: Path) -> str:
    """The text of a file; raises `SceneFileError`, without the name of the file."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise SceneFileError(f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise SceneFileError(f"is not text in UTF-8: {error}") from None


def toml_tables(text: str) -> dict[str, Any]:
    try:
        tables = tomllib.loads(text)
        pickle.dumps(tables)  # what is nested too deeply for this is so for all that follows
        return tables
    except (ValueError, RecursionError) as error:
        raise SceneFileError(f"is not valid TOML: {error}") from None


class SceneReader:
    """Makes scenes of the tables of files; what is alike in many of them, such as the cases of a sweep, is read once.

    Errors are `SceneFileError`s without the name of the file.
    """

    def __init__(self):
        self._parts: dict[tuple[Callable, bytes], Any] = {}

    def read(self, content: dict[str, Any]) -> SceneFile:
        return _scene_file(self, content)

    def part(self, make: Callable[..., Part], *arguments: Any) -> Part:
        """`make(self, *arguments)`, of this or an earlier call with the same arguments. Nobody may change it."""
        key = make, pickle.dumps(arguments)
        known = self._parts
        if key in known:
            return known[key]
        made = make(self, *arguments)
        if len(known) >= MAX_KEPT:  # not cleared: another thread may be about to take a part out
            known = self._parts = {}
        known[key] = made
        return made

    def __reduce__(self):
        """Other processes read anew."""
        return SceneReader, ()

    def si_values(
        self, table: Any, where: str, required: Sequence[str], optional: Sequence[str], other: Sequence[str] = ()
    ) -> dict[str, Float[np.ndarray, "..."]]:
        """As `quantities.si_values`."""
        check_keys(table, where, required, (*optional, *other))
        return {key: self.part(_si_value, where, key, value) for key, value in table.items() if key not in other}


class TracedReader(SceneReader):
    """The same of tables with traced numbers (`quantities.InSI`), of which nothing is kept.

    What can be checked of known numbers alone is not: `rodjax.solving.ranges` tells which scenes are to be read anew.
    """

    def part(self, make: Callable[..., Part], *arguments: Any) -> Part:
        return make(self, *arguments)


def _si_value(reader: SceneReader, where: str, key: str, value: Any) -> Float[np.ndarray, "..."]:
    return si_values({key: value}, where, (), (key,))[key]


def _scene_file(reader: SceneReader, content: dict[str, Any]) -> SceneFile:
    check_keys(content, "", *SCENE_TABLES)
    part = reader.part
    rod = part(_rod, content["rod"])
    kinds = {name: _support_kind(content[name], name) for name in ("start", "end")}
    values = {name: dict(part(_end_values, content[name], name, kind)) for name, kind in kinds.items()}
    followers = {name: kind == "free" and flag(content[name], name, "follower") for name, kind in kinds.items()}
    loads, point_forces, distributed, point_couples = part(_loads, content.get("loads", {}))
    clips = part(_clips, content.get("clips", []))
    obstacles = part(_obstacles, content.get("obstacles", []))
    self_contact = flag(content, "", "self_contact")
    values["loads"] = dict(loads)
    solve = check_keys(content.get("solve", {}), "solve", (), ("segments", "rtol", "discretization", "strain_limit"))
    discretization = cast(
        Discretization | None, choice(solve, "solve", "discretization", list(get_args(Discretization)))
    )
    with named("solve"):
        segments = whole_number(solve["segments"], "segments", 2, MAX_SEGMENTS) if "segments" in solve else None
        rtol = checked_rtol(solve["rtol"]) if "rtol" in solve else None
        strain_limit = float(checked_strain_limit(solve.get("strain_limit", DEFAULT_STRAIN_LIMIT)))
    if segments is not None and rtol is not None:
        raise SceneFileError("solve.rtol is not allowed together with solve.segments: it chooses the segments")
    turns = values["end"].pop("turns", None)
    unclocked = tuple(name for name, kind in kinds.items() if kind == "clamp" and is_unclocked(values[name]))
    movable = next((name for name, kind in kinds.items() if kind in (*_MOVABLE, "joint")), None)
    movable = next((name for name in kinds if any(key in values[name] for key in _SPRINGS)), movable)
    if movable and "path" in content:
        raise SceneFileError(f"path is not allowed where the pose of an end is unknown, as that of the {movable} is")
    changes = _changes(content["path"], kinds, values, unclocked) if "path" in content else []
    if changes and turns is not None:
        raise SceneFileError("end.turns is not allowed together with path: turn the end along the path by end.spin")

    resists = False
    if unclocked:
        spun = {name for name in kinds if "spin" in content[name]}
        along = [target for _, _, target in changes]
        loads_on_rod = [*point_forces, *point_couples, *distributed]
        resists = Clocking(kinds, unclocked, rod, clips, loads_on_rod, values, along, followers, spun, turns).check()

    def scene(values: Values, where: str = "") -> Scene:
        gravity = None if "gravity" not in values["loads"] else part(_leaf, values["loads"]["gravity"])
        start, end = (
            part(_support, kind, values[name], f"{where}{name}", followers[name], resists, content[name].get("joint"))
            for name, kind in kinds.items()
        )
        try:
            others = distributed, clips, obstacles, (), point_couples, self_contact
            return Scene(rod, start, end, gravity, point_forces, turns, *others)
        except (TypeError, ValueError) as error:
            begin = next(begin for begin in _SCENE_KEYS if str(error).startswith(begin))
            raise SceneFileError(f"{where}{_SCENE_KEYS[begin]}{str(error).removeprefix(begin)}") from None

    scenes = [scene(values)]
    try:
        checked_options(scenes[0], segments, rtol, discretization, None, None, False)
    except ValueError as error:
        raise SceneFileError(f"solve.{error}") from None
    for where, steps, target in changes:
        _check_spin(values, target, steps, where)
        for step in range(1, steps + 1):
            scenes.append(scene(_between(values, target, step / steps, where), where))
            _check_frames(scenes[-2], scenes[-1], f"{where}steps: step {step} of {steps}")
        values = _between(values, target, 1.0, where)
    return SceneFile(scenes, bool(changes), segments, rtol, discretization, strain_limit, unclocked)


def _leaf(reader: SceneReader, number: np.ndarray) -> Float[Array, "..."]:
    return leaf(number)


def _rod(reader: SceneReader, table: Any) -> Rod:
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


def _along(reader: SceneReader, key: str, table: dict[str, Any]) -> Along:
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


def _support_kind(table: Any, where: str) -> str:
    kind = choice(table, where, "support", list(_SUPPORTS))
    if kind is None:
        raise SceneFileError(f"{where}.support is missing; allowed are {', '.join(_SUPPORTS)}")
    return kind


def _end_values(reader: SceneReader, table: dict[str, Any], where: str, kind: str) -> dict[str, np.ndarray]:
    required, optional, _ = _SUPPORTS[kind]
    if kind == "clamp" and where == "end":
        optional = (*optional, "turns")
    values = reader.si_values(table, where, required, optional, other=_OTHER.get(kind, ("support",)))
    if kind in ("hinge", "slider", "joint"):
        return _framed_values(values, table, where, kind)
    if kind == "clamp":
        if ("frame" in values) == ("tangent" in values):
            raise SceneFileError(f"{where}.tangent or {where}.frame is needed for a clamp, exactly one of them")
        if is_unclocked(values):
            if "spin" in values:
                raise SceneFileError(
                    f"{where}.d2 or {where}.frame is needed for {where}.spin, which turns it from there"
                )
            return values
        values = _frame_values(values, where)
        if is_known(values["spin"]) and abs(values["spin"]) > math.pi:
            raise SceneFileError(
                f"{where}.spin must lie in -180 deg to 180 deg in the first scene, got {table['spin']!r}; "
                "turn further along a [[path]], or by whole turns with end.turns"
            )
    return values


def _framed_values(
    values: dict[str, np.ndarray], table: dict[str, Any], where: str, kind: str
) -> dict[str, np.ndarray]:
    """Of a support that holds a frame, or may hold one."""
    if kind == "hinge" or any(key in values for key in _FRAME):
        if ("frame" in values) == ("tangent" in values):
            raise SceneFileError(f"{where}.tangent or {where}.frame is needed for a {kind}, exactly one of them")
        if is_unclocked(values):
            raise SceneFileError(f"{where}.d2 or {where}.frame is needed for a {kind}, whose clocking counts")
        values = _frame_values(values, where)
    if kind == "joint" and not (isinstance(table.get("joint"), str) and table["joint"]):
        raise SceneFileError(f'{where}.joint is missing: the name of a joint, such as joint = "y"')
    return values


def _frame_values(values: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """With the spin of a frame, or of the tangent and d2 that make one."""
    if "frame" in values and "d2" in values:
        raise SceneFileError(
            f"{where}.d2 is not allowed together with {where}.frame, which has d2 as its second column"
        )
    return {"spin": np.zeros(())} | values


def _loads(
    reader: SceneReader, table: Any
) -> tuple[dict[str, np.ndarray], list[PointForce], list[DistributedForce | DistributedCouple], list[PointCouple]]:
    values = reader.si_values(table, "loads", (), ("gravity",), other=("point_force", "point_couple", *DISTRIBUTED))

    def at_points(make: Callable[..., Any], name: str, key: str) -> list[Any]:
        found = []
        for k, load in enumerate(table_list(table.get(name, []), f"loads.{name}")):
            where = f"loads.{name}[{k}]"
            with named(where):
                numbers = reader.si_values(load, where, ("at", key), (), other=("follower",))
                found.append(make(**numbers, follower=flag(load, where, "follower")))
        return found

    forces = at_points(PointForce, "point_force", "force")
    distributed = []
    for name in (name for name in table if name in DISTRIBUTED):
        make, key = DISTRIBUTED[name]
        for k, load in enumerate(table_list(table[name], f"loads.{name}")):
            where = f"loads.{name}[{k}]"
            numbers = reader.si_values(load, where, (key,), ("part",), other=("follower",))
            with named(where):
                distributed.append(make(numbers[key], flag(load, where, "follower"), numbers.get("part")))
    return values, forces, distributed, at_points(PointCouple, "point_couple", "couple")


def _clips(reader: SceneReader, tables: Any) -> list[Clip]:
    clips = []
    for k, table in enumerate(table_list(tables, "clips")):
        where = f"clips[{k}]"
        optional = ("tangent", "frame", "d2", "spin")
        values = reader.si_values(table, where, ("at", "position"), optional, other=("sliding",))
        sliding = flag(table, where, "sliding")
        if "frame" in values and "tangent" in values:
            raise SceneFileError(
                f"{where}.tangent is not allowed together with {where}.frame, whose third column it is"
            )
        with named(where):
            clip = Clip(values["at"], values["position"], sliding=sliding, **_clip_direction(reader, values, where))
            clips.append(clip if clip.tangent is None else with_direction(clip, "tangent", values))
    return clips


def _obstacles(reader: SceneReader, tables: Any) -> list[Obstacle]:
    return [obstacle(table, f"obstacles[{k}]", folder=None) for k, table in enumerate(table_list(tables, "obstacles"))]


def _clip_direction(reader: SceneReader, values: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """The tangent that a clip holds, or the frame, made as that of a clamp is; nothing where it holds neither."""
    if not any(key in values for key in ("frame", "d2", "spin")):
        return {"tangent": values["tangent"]} if "tangent" in values else {}
    if "frame" not in values and "tangent" not in values:
        raise SceneFileError(f"{where}.tangent or {where}.frame is needed where {where} has d2 or spin")
    if is_unclocked(values):
        raise SceneFileError(_SPIN_NEEDS_D2.format(where))
    values = _frame_values(values, where)
    if is_known(values["spin"]) and abs(values["spin"]) > math.pi:
        raise SceneFileError(
            f"{where}.spin must lie in -180 deg to 180 deg, got {math.degrees(float(values['spin'])):g} deg"
        )
    return {"frame": _placed(reader, values)}


def _changes(
    tables: Any, kinds: dict[str, str], values: Values, unclocked: tuple[str, ...]
) -> list[tuple[str, int, Values]]:
    """Where each table of the path is, its steps and new values; adds to `values` the zero loads that it changes."""
    changes = []
    for k, table in enumerate(table_list(tables, "path")):
        where = f"path[{k}]."
        check_keys(table, where[:-1], (), ("steps", "start", "end", "loads"))
        with named(where[:-1]):
            steps = whole_number(table.get("steps", 1), "steps", 1, MAX_STEPS)
        target: Values = {}
        for name in values:
            keys = _SUPPORTS[kinds[name]][2] if name in kinds else ("gravity",)
            if "frame" in values[name]:
                keys = ("position", "spin")
            if name in unclocked:
                for key in {"spin", "d2"} & set(table.get(name, ())):
                    raise SceneFileError(
                        f"{where}{name}.{key} needs {name}.d2 or {name}.frame, from which the clamp turns"
                    )
            target[name] = si_values(table.get(name, {}), f"{where}{name}", (), keys)
            values[name] = {key: np.zeros(3) for key in target[name] if key not in values[name]} | values[name]
        if not any(target.values()):
            raise SceneFileError(f'{where[:-1]} changes nothing; give new values, such as end.spin = "90 deg"')
        changes.append((where, steps, target))
    return changes


# --- supports and paths ----------------------------------------------------------------------------------------------


def _support(
    reader: SceneReader,
    kind: str,
    values: dict[str, np.ndarray],
    where: str,
    follower: bool = False,
    resists: bool = False,
    joint: str | None = None,
) -> Support:
    springs = {key: values[key] for key in _SPRINGS if key in values}
    if springs:
        if kind == "clamp" and is_unclocked(values):
            raise SceneFileError(f"{where}.d2 or {where}.frame is needed for a clamp with springs")
        rigid = {key: value for key, value in values.items() if key not in springs}
        with named(where):
            return Spring(_support(reader, kind, rigid, where), **springs)
    with named(where):
        if kind in ("hinge", "slider", "joint"):
            numbers = {key: value for key, value in values.items() if key not in _FRAME}
            if "spin" in values:
                numbers["frame"] = _placed(reader, values)
            return Joint(joint or "", **numbers) if kind == "joint" else _MOVABLE[kind](**numbers)
        if kind == "clamp" and is_unclocked(values):
            if resists:  # any clocking gives the same
                across = np.eye(3)[np.argmin(np.abs(values["tangent"]))]
                return Clamp(values["position"], reader.part(_frame, values["tangent"], across))
            return with_direction(Swivel(values["position"], values["tangent"]), "tangent", values)
        if kind == "clamp":
            return Clamp(values["position"], _placed(reader, values))
        if kind == "swivel":
            return with_direction(Swivel(**values), "tangent", values)
        return Pin(**values) if kind == "pin" else Free(**values, follower=follower)


def body_support(reader: SceneReader, table: dict[str, Any], where: str) -> Support:
    """The support of a body of a harness, of the keys that an end has."""
    kind = choice(table, where, "support", ["clamp", "pin", "hinge", "slider"])
    if kind is None:
        raise SceneFileError(f"{where}.support is missing; allowed are clamp, pin, hinge, slider")
    values = _end_values(reader, table, where, kind)
    if kind == "clamp" and is_unclocked(values):
        raise SceneFileError(f"{where}.d2 or {where}.frame is needed for the clamp of a joint")
    return _support(reader, kind, values, where)


_MOVABLE = {"hinge": Hinge, "slider": Slider}


def _placed(reader: SceneReader, values: dict[str, np.ndarray]) -> Any:
    """The frame that a table states."""
    placed = values["frame"] if "frame" in values else reader.part(_frame, values["tangent"], values["d2"])
    return _spun(placed, values["spin"])


def _frame(reader: SceneReader, tangent: np.ndarray, d2: np.ndarray) -> Float[Numbers, "3 3"]:
    placed = frame(tangent, d2)
    if is_known(tangent, d2):
        return np.asarray(placed) if is_known(placed) else placed
    # Of two that are parallel, which are refused where they are known, no frame.
    across = jnp.linalg.norm(jnp.cross(tangent, d2))
    return jnp.where(across > LEAST_ACROSS * jnp.linalg.norm(d2), placed, jnp.nan)


def _spun(placed: Any, spin: Any) -> Any:
    """A frame turned about its own tangent."""
    if is_known(placed, spin) and spin == 0:
        return placed
    xp = namespace(placed, spin)
    d1, d2, tangent = xp.asarray(placed).T
    turned = xp.cos(spin) * d1 + xp.sin(spin) * d2, xp.cos(spin) * d2 - xp.sin(spin) * d1
    return xp.stack([*turned, tangent], axis=-1)


def _between(before: Values, after: Values, fraction: float, where: str) -> Values:
    def value(name: str, key: str, old: np.ndarray) -> np.ndarray:
        new = after[name].get(key, old)
        if key in ("tangent", "d2"):
            return _on_great_circle(old, new, fraction, f"{where}{name}.{key}")
        return (1 - fraction) * old + fraction * new

    return {name: {key: value(name, key, old) for key, old in table.items()} for name, table in before.items()}


def _on_great_circle(old: np.ndarray, new: np.ndarray, fraction: float, where: str) -> np.ndarray:
    angle = math.atan2(float(np.linalg.norm(np.cross(old, new))), float(np.dot(old, new)))
    # Nearer to opposite the plane of the turn would be mostly rounding of the input.
    if angle > math.pi - 1e-6:
        raise SceneFileError(
            f"{where} must not be opposite to the one before: the way between is not unique, go by a third"
        )
    if angle < 1e-12 or fraction == 1:
        return new
    return (math.sin((1 - fraction) * angle) * old + math.sin(fraction * angle) * new) / math.sin(angle)


def _check_spin(before: Values, after: Values, steps: int, where: str) -> None:
    """Each end, and the two against each other, must turn by less than half a turn a step."""
    spins = {
        f"{name}.spin": float(after[name].get("spin", table["spin"]) - table["spin"])
        for name, table in before.items()
        if "spin" in table
    }
    if len(spins) == 2:
        spins["end.spin - start.spin"] = spins["end.spin"] - spins["start.spin"]
    for key, spin in spins.items():
        least = math.floor(abs(spin) / math.pi * (1 + 1e-9)) + 1
        if steps < least:
            raise SceneFileError(
                f"{where}{key} must turn by less than 180 deg a step, got {math.degrees(spin) / steps:g} deg; "
                f"{where}steps must be at least {least}"
            )


def _check_frames(before: Scene, after: Scene, where: str) -> None:
    """A frame jumps by half a turn where the tangent passes through d2, which defines it."""
    for name in ("start", "end"):
        old, new = getattr(before, name), getattr(after, name)
        # The trace of a rotation is 1 + 2 cos(angle).
        if isinstance(new, Clamp) and np.sum(np.asarray(old.frame) * np.asarray(new.frame)) < -1 + 1e-6:
            raise SceneFileError(f"{where} turns the {name} by 180 deg, less is allowed; is its tangent along d2?")
