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

import os
import pickle
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import file_path, leaf, whole_number
from rodjax.io.clocking import Clocking, Values, is_unclocked
from rodjax.io.load_tables import loads_of
from rodjax.io.obstacle_tables import obstacle
from rodjax.io.part_reader import Part, PartReader
from rodjax.io.path_tables import between, changes_of, check_frames, check_spin
from rodjax.io.quantities import SceneFileError, check_keys, choice, flag, in_file, named, table_list
from rodjax.io.rod_table import rod_of
from rodjax.io.support_tables import MOVABLE, SPRINGS, clips_of, end_values, support_kind, support_of
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene
from rodjax.solving.options import MAX_SEGMENTS, Discretization, checked_options, checked_rtol, checked_strain_limit
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT

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
# Those that a file must have, and may have.
SCENE_TABLES = ("rod", "start", "end"), ("loads", "clips", "obstacles", "self_contact", "solve", "path")


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


class SceneReader(PartReader):
    """Makes scenes of the tables of files, of parts that are read once.

    Errors are `SceneFileError`s without the name of the file.
    """

    def read(self, content: dict[str, Any]) -> SceneFile:
        return _scene_file(self, content)

    def __reduce__(self):
        """Other processes read anew."""
        return SceneReader, ()


class TracedReader(SceneReader):
    """The same of tables with traced numbers (`quantities.InSI`), of which nothing is kept.

    What can be checked of known numbers alone is not: `rodjax.solving.ranges` tells which scenes are to be read anew.
    """

    def part(self, make: Callable[..., Part], *arguments: Any) -> Part:
        return make(self, *arguments)


def _scene_file(reader: SceneReader, content: dict[str, Any]) -> SceneFile:
    check_keys(content, "", *SCENE_TABLES)
    part = reader.part
    rod = part(rod_of, content["rod"])
    kinds = {name: support_kind(content[name], name) for name in ("start", "end")}
    values = {name: dict(part(end_values, content[name], name, kind)) for name, kind in kinds.items()}
    followers = {name: kind == "free" and flag(content[name], name, "follower") for name, kind in kinds.items()}
    loads, point_forces, distributed, point_couples = part(loads_of, content.get("loads", {}))
    clips = part(clips_of, content.get("clips", []))
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
    movable = next((name for name, kind in kinds.items() if kind in (*MOVABLE, "joint")), None)
    movable = next((name for name in kinds if any(key in values[name] for key in SPRINGS)), movable)
    if movable and "path" in content:
        raise SceneFileError(f"path is not allowed where the pose of an end is unknown, as that of the {movable} is")
    changes = changes_of(content["path"], kinds, values, unclocked) if "path" in content else []
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
            part(support_of, kind, values[name], f"{where}{name}", followers[name], resists, content[name].get("joint"))
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
        check_spin(values, target, steps, where)
        for step in range(1, steps + 1):
            scenes.append(scene(between(values, target, step / steps, where), where))
            check_frames(scenes[-2], scenes[-1], f"{where}steps: step {step} of {steps}")
        values = between(values, target, 1.0, where)
    return SceneFile(scenes, bool(changes), segments, rtol, discretization, strain_limit, unclocked)


def _leaf(reader: PartReader, number: np.ndarray) -> Float[Array, "..."]:
    return leaf(number)


def _obstacles(reader: PartReader, tables: Any) -> list[Obstacle]:
    return [obstacle(table, f"obstacles[{k}]", folder=None) for k, table in enumerate(table_list(tables, "obstacles"))]
