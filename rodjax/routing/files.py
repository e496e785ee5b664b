"""Routes as files: a scene, obstacles and limits for `rodjax report`; and what may vary for `rodjax route`.

A complete example; quantities are as in scene files, a number and any unit of the right dimension:

    scene = "scene.toml"           # in a folder as seen from this file, without [[path]]; or the tables of a scene,
                                   # [rod], [start], [end] and others, in this file; or of several cables, for a report:
                                   # cables = { "brake line" = "brake.toml", "sensor" = "sensor.toml" }; for a report
                                   # or a route also the file of a harness, or its tables [cables.NAME] and others
    title = "Brake line"           # optional
    starts = 8                     # optional, for `rodjax route`: from how many designs the search begins

    [[obstacles]]                  # any number of these
    kind = "plane"
    name = "floor"                 # optional
    point = "[0, 0, -20] mm"
    normal = [0, 0, 1]

    [[obstacles]]
    kind = "capsule"
    name = "pipe"
    start = "[100, -100, 20] mm"
    end = "[160, 200, 0] mm"
    radius = "20 mm"

    [limits]                       # optional for a report, as all in it
    bend_radius = 6                # least inside bend radius, by the outer diameter
    clearance = "10 mm"            # least; or one for each obstacle, "[10, 5] mm"
    clip_force = "20 N"            # most, as the others but the last
    clip_moment = "0.5 N m"
    end_force = "20 N"
    end_moment = "0.5 N m"
    twist = "90 deg/m"
    strain = 0.01
    length = "1.2 m"
    mass = "0.2 kg"
    energy = "1 J"
    stability = "0.1 N"            # least stiffness of the softest motion

Obstacles are as in `rodjax.io.obstacle_tables`, with a name. Here they push nothing; those of a scene file do, and a
file that has nothing but the tables of a scene or a harness, its obstacles without names and none a mesh, is one:
`rodjax report` has it as `rodjax solve` does.

What `rodjax route` varies, and a report of the scene as it is leaves aside:

    [[variables]]                  # one or more of these; names as in `rodjax.route`
    kind = "between"               # a number, or each component of a vector
    key = "clips.0.at"             # of a harness "cables.NAME.clips.0.at" and so on
    lower = "200 mm"
    upper = "300 mm"

    [[variables]]
    kind = "line"                  # a position on a straight line
    key = "clips.0.position"
    start = "[100, 0, 0] mm"
    end = "[300, 0, 0] mm"

    [[variables]]
    kind = "patch"                 # a position corner + u edge1 + v edge2, u and v from 0 to 1
    key = "clips.1.position"
    corner = "[300, 0, 0] mm"
    edge1 = "[100, 0, 0] mm"
    edge2 = "[0, 50, 0] mm"

    [[variables]]
    kind = "turned"                # a tangent, or the frame of a clamp
    key = "end.frame"
    angle = "30 deg"               # at most, away from that of the scene

    [objective]                    # weights of what shall be little, of length [m], mass [kg], energy [J],
    length = 1                     # end_force [N] and clips, how many of them carry a force above about clip_scale
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.checks import file_path, shown, whole_number
from rodjax.identification.unknowns import unit_of
from rodjax.io.clocking import check_clocked
from rodjax.io.harness_file import HARNESS_TABLES, HarnessFile, harness_file, is_harness_file, read_harness_file
from rodjax.io.obstacle_tables import kind_of, obstacle
from rodjax.io.quantities import (
    OF_TABLES,
    SceneFileError,
    check_keys,
    in_file,
    named,
    si_value,
    si_values,
    table_list,
)
from rodjax.io.scene_file import SCENE_TABLES, SceneFile, SceneReader, read_scene_file, read_text, toml_tables
from rodjax.model.obstacles import Obstacle
from rodjax.routing.limits import Limits
from rodjax.routing.objective import Objective
from rodjax.routing.variables import Between, OnLine, OnPatch, Turned, Variable, checked_variables
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT

# What makes a variable, and the keys that it must have.
VARIABLES: dict[str, tuple[Callable[..., Variable], tuple[str, ...]]] = {
    "between": (Between, ("lower", "upper")),
    "line": (OnLine, ("start", "end")),
    "patch": (OnPatch, ("corner", "edge1", "edge2")),
    "turned": (Turned, ("angle",)),
}
LIMITS = (*OF_TABLES["limits"], "length")
OF_A_ROUTE = ("title", "obstacles", "limits", "variables", "objective", "starts")
MOST_STARTS = 10_000


class RouteFile(NamedTuple):
    """What a file holds: a scene file for each cable by its name, or a harness; what it shall keep to, and what may
    vary.
    """

    cables: dict[str, SceneFile]
    harness: HarnessFile | None
    title: str | None
    obstacles: tuple[Obstacle, ...]
    names: tuple[str, ...]
    limits: Limits | None
    variables: tuple[Variable, ...]
    objective: Objective | None
    starts: int | None

    @property
    def of_route(self) -> SceneFile | HarnessFile:
        """The file of the one scene or harness of which a route is sought."""
        if self.harness is not None:
            return self.harness
        (scene,) = self.cables.values()
        return scene


def read_route_file(path: str | os.PathLike[str], *, with_scene: bool = True, for_route: bool = False) -> RouteFile:
    """What the TOML file says; see this module for the format. Without its scene where that is not needed.

    `for_route`: it must have one scene, or a harness, and variables.

    Raises `SceneFileError` with one line that names the file and the key.
    """
    path = file_path(path, "path")
    with in_file(path):
        content = toml_tables(read_text(path))
        required, optional = SCENE_TABLES
        check_keys(content, "", (), (*required, *optional, "scene", "cables", "joints", *OF_A_ROUTE))
        is_scene = _is_scene(content)
        names, obstacles = ((), ()) if is_scene else _obstacles(content.get("obstacles", []), path.parent)
        limits = _limits(content["limits"], obstacles) if "limits" in content else None
        objective = _objective(content["objective"]) if "objective" in content else None
        title, starts = _title(content), _starts(content)
    of_scene = {key: table for key, table in content.items() if is_scene or key not in OF_A_ROUTE}
    harness = _harness(of_scene, path) if with_scene else None
    cables = _cables(of_scene, path) if with_scene and harness is None else {}
    with in_file(path):
        variables = _variables(content.get("variables", []))
        file = RouteFile(cables, harness, title, obstacles, names, limits, variables, objective, starts)
        if for_route:
            _check_for_route(content, file)
        if variables and (harness is not None or len(cables) == 1):
            _check_variables(variables, file.of_route)
    return file


def _is_scene(content: dict[str, Any]) -> bool:
    """Whether it says nothing that only a route has, so that its obstacles are those that push."""
    tables = content.get("obstacles", [])
    tables = [table for table in tables if isinstance(table, dict)] if isinstance(tables, list) else []
    has_own = any("name" in table or table.get("kind") == "mesh" for table in tables)
    of_route = ("scene", *(key for key in OF_A_ROUTE if key != "obstacles"))
    is_of_files = isinstance(content.get("cables"), dict) and not any(
        isinstance(cable, dict) for cable in content["cables"].values()
    )
    return not (has_own or is_of_files or any(key in content for key in of_route))


def _title(content: dict[str, Any]) -> str | None:
    if not isinstance(content.get("title", ""), str):
        raise SceneFileError(f"title must be a text, got {shown(content['title'])}")
    return content.get("title")


def _starts(content: dict[str, Any]) -> int | None:
    if "starts" not in content:
        return None
    try:
        return whole_number(content["starts"], "starts", 1, MOST_STARTS)
    except (TypeError, ValueError) as error:
        raise SceneFileError(str(error)) from None


# --- scenes ----------------------------------------------------------------------------------------------------------


def _harness(content: dict[str, Any], path: Path) -> HarnessFile | None:
    """`None` where the file is of single cables."""
    cables, scene = content.get("cables"), content.get("scene")
    if isinstance(cables, dict) and any(isinstance(one, dict) for one in cables.values()):
        with in_file(path):
            if scene is not None:
                raise SceneFileError("scene is not allowed together with the tables of a harness")
            return harness_file({key: content[key] for key in HARNESS_TABLES if key in content})
    if "joints" in content:
        with in_file(path):
            raise SceneFileError("joints is not allowed without the tables [cables.NAME] of a harness")
    if not isinstance(scene, str) or "\0" in scene:
        return None
    file = path.parent / scene
    return read_harness_file(file) if file.is_file() and is_harness_file(file) else None


def _cables(content: dict[str, Any], path: Path) -> dict[str, SceneFile]:
    tables = {key: content[key] for keys in SCENE_TABLES for key in keys if key in content}
    with in_file(path):
        given = [key for key in ("scene", "cables") if key in content] + [", ".join(tables)] * bool(tables)
        if len(given) != 1:
            raise SceneFileError(
                'scene is needed, for example scene = "scene.toml", or cables, or the tables rod, start and end, one '
                f"of the three, got {' and '.join(given) or 'none'}"
            )
        files = content.get("cables", {"cable": content.get("scene")})
        if not isinstance(files, dict) or not files:
            raise SceneFileError(f'cables must be a table such as {{ "brake line" = "a.toml" }}, got {shown(files)}')
        if tables:
            return {"cable": _single(SceneReader().read(tables))}
        for name, file in files.items():
            key = "scene" if "scene" in content else f"cables.{name}"
            if not isinstance(file, str) or not file or "\0" in file:
                raise SceneFileError(f'{key} must be the name of a scene file, such as "scene.toml", got {shown(file)}')
    found = {name: read_scene_file(path.parent / file) for name, file in files.items()}
    for name, file in files.items():
        with in_file(path.parent / file):
            _single(found[name])
    return found


def _single(file: SceneFile) -> SceneFile:
    if file.is_path:
        raise SceneFileError("path is not allowed in a route, which is of one scene; leave [[path]] out")
    return file


# --- what a route keeps to -------------------------------------------------------------------------------------------


def _obstacles(tables: Any, folder: Path) -> tuple[tuple[str, ...], tuple[Obstacle, ...]]:
    names, obstacles = [], []
    for k, table in enumerate(table_list(tables, "obstacles")):
        where = f"obstacles[{k}]"
        obstacles.append(obstacle(table, where, folder, ("name",)))
        if obstacles[-1].friction is not None:
            raise SceneFileError(f"{where}.friction must be 0: a route keeps away from its obstacles")
        name = table.get("name", f"obstacle {k}")
        if not isinstance(name, str) or not name:
            raise SceneFileError(f"{where}.name must be a text, got {shown(name)}")
        if name in names:
            raise SceneFileError(f"{where}.name must differ from those of other obstacles, got {shown(name)} again")
        names.append(name)
    return tuple(names), tuple(obstacles)


def _limits(table: Any, obstacles: tuple[Obstacle, ...]) -> Limits:
    values: dict[str, Any] = si_values(table, "limits", (), LIMITS, other=("clearance",))
    if "clearance" in table:
        values["clearance"] = _number_or_list(table["clearance"], "clearance", "limits", "m", '"10 mm"')
        if not obstacles:
            raise SceneFileError("limits.clearance is not allowed without [[obstacles]]")
        if values["clearance"].shape not in ((), (len(obstacles),)):
            count = len(values["clearance"])
            raise SceneFileError(
                f"limits.clearance must be one number, or one for each of {len(obstacles)} obstacles, got {count}"
            )
    if not values:
        raise SceneFileError(f"limits must hold at least one of {', '.join((*LIMITS, 'clearance'))}")
    return _made(Limits, values, "limits")


def _objective(table: Any) -> Objective:
    keys = tuple(OF_TABLES["objective"])
    return _made(Objective, si_values(table, "objective", (), keys), "objective")


def _made(make: Callable[..., Any], values: Mapping[str, Any], where: str) -> Any:
    try:
        return make(**values)
    except (TypeError, ValueError) as error:
        is_key = str(error).split(maxsplit=1)[0] in values
        raise SceneFileError(f"{where}{'.' if is_key else ': '}{error}") from None


# --- what may vary ---------------------------------------------------------------------------------------------------


def _variables(tables: Any) -> tuple[Variable, ...]:
    return tuple(_variable(table, f"variables[{k}]") for k, table in enumerate(table_list(tables, "variables")))


def _variable(table: Any, where: str) -> Variable:
    kind = kind_of(table, where, list(VARIABLES))
    make, required = VARIABLES[kind]
    for key in ("key", *required):
        if isinstance(table, dict) and key not in table:
            raise SceneFileError(f"{where}.{key} is missing")
    if not isinstance(table["key"], str):
        raise SceneFileError(
            f'{where}.key must be the name of a number, such as "clips.0.at", got {shown(table["key"])}'
        )
    if kind == "between":
        check_keys(table, where, (), ("kind", "key", *required))
        unit = unit_of(table["key"])
        example = f'"0.1 {unit}"' if unit else "0.1"
        values = {key: _number_or_list(table[key], key, where, unit, example) for key in required}
    else:
        values = si_values(table, where, required, (), other=("kind", "key"))
    return _made(make, {"key": table["key"], **values}, where)


def _number_or_list(value: Any, key: str, where: str, unit: str, example: str) -> Float[np.ndarray, "..."]:
    is_list = value.lstrip().startswith("[") if isinstance(value, str) else isinstance(value, list)
    with named(where):
        try:
            return si_value(value, key, unit, (None,) if is_list else (), example)
        except ValueError as error:
            raise SceneFileError(f"{where}.{error}") from None


def _check_for_route(content: dict[str, Any], file: RouteFile) -> None:
    if "cables" in content and file.harness is None:
        raise SceneFileError('cables is not allowed where a route is sought, which is of one: scene = "scene.toml"')
    if not file.variables:
        raise SceneFileError("variables is missing: one or more tables [[variables]], which say what may vary")
    scene = file.of_route
    if scene.rtol is not None or scene.discretization == "finite_difference":
        raise SceneFileError(
            "solve.rtol and finite differences are not allowed where a route is sought, which is on one mesh of "
            "elements: solve.segments"
        )
    if scene.strain_limit != DEFAULT_STRAIN_LIMIT:
        raise SceneFileError(
            "solve.strain_limit is not allowed where a route is sought: limits.strain is what it keeps"
        )


def _check_variables(variables: tuple[Variable, ...], file: SceneFile | HarnessFile) -> None:
    for k, variable in enumerate(variables):
        if isinstance(file, SceneFile):
            check_clocked(variable.key, file.unclocked, f"variables[{k}]")
    try:
        checked_variables(variables, file.scenes[0])
    except (TypeError, ValueError) as error:
        told = str(error)
        raise SceneFileError(told if told.startswith("variables") else f"variables: {told}") from None
