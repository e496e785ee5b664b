"""Obstacles as tables of files, of scenes and of routes:

    [[obstacles]]
    kind = "plane"
    point = "[0, 0, -20] mm"
    normal = [0, 0, 1]

The keys besides the kind (optional ones in brackets):

- "plane": point, normal; "sphere": center, radius; "capsule" and "cylinder": start, end, radius
- "pipe", with bends, or another cable: points = "[[0, 0, 0], [100, 0, 0], [100, 80, 0]] mm", radius
- "box": center, size [frame = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], its columns along the edges]
- "mesh", not in scene files: file = "engine.stl", in a folder as seen from this file [unit = "1 mm", that of the file;
  without it metres]
- "union": parts, a list of obstacles

and each, but for the parts of a union and obstacles of routes, [friction = 0.3]: Coulomb's coefficient.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rodjax.checks import shown
from rodjax.io.quantities import SceneFileError, assignment, choice, named, quantity, si_values, table_list
from rodjax.model.obstacles import Box, Capsule, Cylinder, Obstacle, Pipe, Plane, Sphere, Union
from rodjax.model.triangle_mesh import Mesh

# What makes an obstacle, and the keys that it must and may have.
OBSTACLES: dict[str, tuple[Callable[..., Obstacle], tuple[str, ...], tuple[str, ...]]] = {
    "plane": (Plane, ("point", "normal"), ("friction",)),
    "sphere": (Sphere, ("center", "radius"), ("friction",)),
    "capsule": (Capsule, ("start", "end", "radius"), ("friction",)),
    "pipe": (Pipe, ("points", "radius"), ("friction",)),
    "cylinder": (Cylinder, ("start", "end", "radius"), ("friction",)),
    "box": (Box, ("center", "size"), ("frame", "friction")),
}
KINDS = [*OBSTACLES, "mesh", "union"]
M = TypeVar("M", bound=eqx.Module)


def obstacle(table: Any, where: str, folder: Path | None, other: tuple[str, ...] = ()) -> Obstacle:
    """Of a table, which may have `other` keys too. `folder`: of the files of meshes, `None` where there are none."""
    kind = kind_of(table, where, KINDS if folder is not None else [*OBSTACLES, "union"])
    if kind == "mesh" and folder is not None:
        return _mesh(table, where, folder, other)
    if kind == "union":
        values = si_values(table, where, (), ("friction",), other=("kind", "parts", *other))
        parts = table_list(table.get("parts", []), f"{where}.parts")
        if not parts:
            raise SceneFileError(f'{where}.parts must be a list of obstacles, such as {{ kind = "sphere", ... }}')
        bodies = [obstacle(part, f"{where}.parts[{k}]", folder) for k, part in enumerate(parts)]
        with named(where):
            return Union(*bodies, **values)
    make, required, optional = OBSTACLES[kind]
    values = si_values(table, where, required, optional, other=("kind", *other))
    with named(where):
        return with_direction(make(**values), "normal", values)


def with_direction(module: M, key: str, values: Mapping[str, np.ndarray]) -> M:
    """A module with its direction as the file has it, where it has one there.

    Constructors divide by the length once more, which may change the last bit of what `write_scene` wrote.
    """
    if key not in values:
        return module
    return eqx.tree_at(lambda module: getattr(module, key), module, jnp.asarray(values[key]))


def kind_of(table: Any, where: str, allowed: list[str]) -> str:
    kind = choice(table, where, "kind", allowed)
    if kind is None:
        raise SceneFileError(f"{where}.kind is missing; allowed are {', '.join(allowed)}")
    return kind


def _mesh(table: dict[str, Any], where: str, folder: Path, other: tuple[str, ...]) -> Obstacle:
    values = si_values(table, where, (), ("unit", "friction"), other=("kind", "file", *other))
    file = table.get("file")
    if not isinstance(file, str) or not file or "\0" in file:
        got = shown(file) if "file" in table else "none"
        raise SceneFileError(f'{where}.file must be the name of an STL file, such as "engine.stl", got {got}')
    unit = float(values.get("unit", np.ones(())))
    if not unit > 0:
        raise SceneFileError(f"{where}.unit must be positive, got {shown(table['unit'])}")
    try:
        return Mesh.from_stl(folder / file, unit, values.get("friction", 0.0))
    except OSError as error:
        raise SceneFileError(f"{where}.file: {shown(str(folder / file))} cannot be read: {error.strerror}") from None
    except (ValueError, ImportError) as error:
        raise SceneFileError(f"{where}.file: {str(error).removeprefix('path ')}") from None


def written_obstacle(obstacle: Obstacle, name: str) -> list[str]:
    """Lines of TOML, of which `obstacle` makes the same; raises `ValueError` for what is none of a scene file."""
    if isinstance(obstacle, Union):
        parts = [
            ", ".join(written_obstacle(part, f"{name}.obstacles[{k}]")) for k, part in enumerate(obstacle.obstacles)
        ]
        friction = [] if obstacle.friction is None else [assignment("friction", obstacle.friction, "")]
        return ['kind = "union"', f"parts = [{', '.join(f'{{ {part} }}' for part in parts)}]", *friction]
    kind = next((kind for kind, (make, _, _) in OBSTACLES.items() if make is type(obstacle)), None)
    if kind is None:
        raise ValueError(
            f"{name} must be of the kinds {', '.join(OBSTACLES)} or union to be written, got a "
            f"{type(obstacle).__name__}; save writes meshes with a result"
        )
    _, required, optional = OBSTACLES[kind]
    values = {key: getattr(obstacle, key) for key in (*required, *optional)}
    written = [
        assignment(key, value, quantity(key, "obstacles")[0]) for key, value in values.items() if value is not None
    ]
    return [f'kind = "{kind}"', *written]
