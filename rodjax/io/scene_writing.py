"""Scenes written as files that `scene_file` reads."""

import os
from collections.abc import Sequence

import equinox as eqx
from jaxtyping import Array

from rodjax.atomic_write import replace_file
from rodjax.checks import file_path, instance, is_known, whole_number
from rodjax.io.obstacle_tables import written_obstacle
from rodjax.io.quantities import assignment, quantity
from rodjax.io.scene_file import DISTRIBUTED, PAIRS
from rodjax.model.along import Along, Steps
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Movable
from rodjax.solving.equilibrium import MAX_SEGMENTS


def write_scene(scene: Scene, path: str | os.PathLike[str], segments: int | None = None) -> None:
    """Writes one scene to a TOML file, from which `read_scene` makes the same numbers to the last bit.

    The file is replaced as a whole. Raises `ValueError` or `TypeError` for what is not one scene, for a rod of
    `Rod.from_centerline` or with a law, and for potentials, meshes and obstacles of one's own, which a file cannot
    hold; `OSError` where it cannot be written.

    Of the loads along the rod the file keeps the order among the forces and among the couples.
    """
    text = scene_text(scene, segments)
    replace_file(file_path(path, "path"), text.encode())


def scene_text(scene: Scene, segments: int | None = None) -> str:
    """What `write_scene` writes, with the same errors."""
    instance(scene, "scene", Scene)
    if not is_known(scene):
        raise ValueError("scene must hold numbers, got a traced one: call write_scene outside jax.jit, vmap and grad")
    if scene.rod.length.ndim:
        raise ValueError(f"scene must be a single scene, got a stack of shape {scene.rod.length.shape}")
    if scene.rod.law is not None:
        raise ValueError("scene.rod.law must be None to be written: a law is code, which a scene file cannot hold")
    if scene.potentials:
        raise ValueError(
            "scene.potentials must be () to be written: a potential is code, which a scene file cannot hold"
        )
    if scene.rod.rest_centerline is not None:
        raise ValueError(
            "scene.rod must not be one of Rod.from_centerline to be written: a scene file cannot hold the frames of "
            "its rest_centerline; save writes them with a result"
        )
    for name in ("start", "end"):
        if isinstance(getattr(scene, name), Movable):
            kind = type(getattr(scene, name)).__name__
            raise ValueError(f"scene.{name} must be a Clamp, Swivel, Pin or Free to be written, got a {kind}")
    lines = ["self_contact = true", ""] if scene.self_contact else []
    lines += ["[rod]", *_written_rod(scene.rod)]
    for name, end in (("start", scene.start), ("end", scene.end)):
        lines += ["", f"[{name}]", f'support = "{type(end).__name__.lower()}"']
        lines += _written(end, ("position", "force", "moment", "frame" if isinstance(end, Clamp) else "tangent"))
        lines += _written_follower(end)
    lines += _written(scene, ("turns",))
    if scene.gravity is not None:
        lines += ["", "[loads]", *_written(scene, ("gravity",))]
    for force in scene.point_forces:
        lines += ["", "[[loads.point_force]]", *_written(force, ("at", "force")), *_written_follower(force)]
    for couple in scene.point_couples:
        where = "point_couple"
        lines += ["", f"[[loads.{where}]]", *_written(couple, ("at", "couple"), where), *_written_follower(couple)]
    for kind in dict.fromkeys(type(load) for load in scene.distributed):
        name, key = next((name, key) for name, (of_name, key) in DISTRIBUTED.items() if of_name is kind)
        for load in scene.distributed:
            if isinstance(load, kind):
                lines += ["", f"[[loads.{name}]]", *_written(load, (key, "part"), name), *_written_follower(load)]
    for clip in scene.clips:
        lines += ["", "[[clips]]", *_written(clip, ("at", "position", "tangent", "frame"))]
        lines += ["sliding = true"] if clip.sliding else []
    for k, one in enumerate(scene.obstacles):
        lines += ["", "[[obstacles]]", *written_obstacle(one, f"scene.obstacles[{k}]")]
    if segments is not None:
        lines += ["", "[solve]", f"segments = {whole_number(segments, 'segments', 2, MAX_SEGMENTS)}"]
    return "\n".join([*lines, ""])


def _written(module: eqx.Module, keys: Sequence[str], where: str = "") -> list[str]:
    """Lines of TOML for those of the keys that the module has."""
    values = {key: getattr(module, key, None) for key in keys}
    return [assignment(key, value, quantity(key, where)[0]) for key, value in values.items() if value is not None]


def _written_rod(rod: Rod) -> list[str]:
    lines = _written(rod, ("length",))
    for name in ("radius", "EI", "GJ", "EA", "GA", "mass_per_length", "rest_curvature", "rest_twist", "rest_strain"):
        value = getattr(rod, name)
        values = zip(PAIRS[name], value, strict=True) if isinstance(value, tuple) else [(name, value)]
        lines += [_written_value(key, value) for key, value in values if value is not None]
    return lines


def _written_value(key: str, value: Array | Along) -> str:
    unit = quantity(key)[0]
    if not isinstance(value, Along):
        return assignment(key, value, unit)
    places = "jumps" if isinstance(value, Steps) else "s"
    entries = assignment(places, getattr(value, places), "m"), assignment("values", value.values, unit)
    return f"{key} = {{ {', '.join(entries)} }}"


def _written_follower(module: eqx.Module) -> list[str]:
    return ["follower = true"] if getattr(module, "follower", False) else []
