"""Scenes written as files that `scene_file` reads."""

import json
import os
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from rodjax.atomic_write import replace_file
from rodjax.checks import file_path, instance, is_known, whole_number
from rodjax.io.load_tables import DISTRIBUTED
from rodjax.io.obstacle_tables import written_obstacle
from rodjax.io.quantities import assignment, quantity
from rodjax.io.rod_table import PAIRS
from rodjax.model.along import Along, Steps
from rodjax.model.harness import Harness
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Joint, Spring, Support
from rodjax.solving.options import MAX_SEGMENTS


def write_scene(scene: Scene | Harness, path: str | os.PathLike[str], segments: int | None = None) -> None:
    """Writes one scene, or a harness, to a TOML file, from which `read_scene` makes the same numbers to the last bit.

    The file is replaced as a whole. Raises `ValueError` or `TypeError` for what is not one scene, for a rod of
    `Rod.from_centerline` or with a law, and for potentials, meshes and user-defined obstacles, which a file cannot
    hold; `OSError` where it cannot be written.

    Of the loads along the rod the file keeps the order among the forces and among the couples.
    """
    text = scene_text(scene, segments)
    replace_file(file_path(path, "path"), text.encode())


def scene_text(scene: Scene | Harness, segments: int | None = None) -> str:
    """What `write_scene` writes, with the same errors."""
    instance(scene, "scene", (Scene, Harness))
    if not is_known(scene):
        raise ValueError("scene must hold numbers, got a traced one: call write_scene outside jax.jit, vmap and grad")
    if isinstance(scene, Harness):
        pairs = ", ".join(f"[{json.dumps(first)}, {json.dumps(second)}]" for first, second in scene.contact_names)
        lines = [f"contact = [{pairs}]", ""] if pairs else []
        for name, one in zip(scene.names, scene.scenes, strict=True):
            lines += _written_scene(one, f"scene[{name!r}]", f"cables.{json.dumps(name)}.")
        for name, body in zip(scene.joint_names, scene.bodies, strict=True):
            if jax.tree.leaves(body):
                lines += [f"[joints.{json.dumps(name)}]", *_written(body, ("force", "moment", "mass"))]
                lines += [] if body.support is None else _written_support(body.support)
                lines += [""]
    else:
        for name in ("start", "end"):
            if isinstance(getattr(scene, name), Joint):
                raise ValueError(f"scene.{name} is a Joint: make a Harness of the scene and write that")
        lines = _written_scene(scene, "scene", "")
    if segments is not None:
        lines += ["[solve]", f"segments = {whole_number(segments, 'segments', 2, MAX_SEGMENTS)}", ""]
    return "\n".join(lines)


def _written_scene(scene: Scene, where: str, before: str) -> list[str]:
    """Its tables, whose names begin with `before`, each followed by an empty line."""
    if scene.rod.length.ndim:
        raise ValueError(f"{where} must be a single scene, got a stack of shape {scene.rod.length.shape}")
    if scene.rod.law is not None:
        raise ValueError(f"{where}.rod.law must be None to be written: a law is code, which a scene file cannot hold")
    if scene.potentials:
        raise ValueError(
            f"{where}.potentials must be () to be written: a potential is code, which a scene file cannot hold"
        )
    if scene.rod.rest_centerline is not None:
        raise ValueError(
            f"{where}.rod must not be one of Rod.from_centerline to be written: a scene file cannot hold the frames of "
            "its rest_centerline; save writes them with a result"
        )
    if scene.contact_loads is not None:
        raise ValueError(f"{where} must be one that was given, got that of a rod touching others: write its Harness")
    table = [f"[{before[:-1]}]"] if before else []  # of its cable in a harness
    lines = [*table, "self_contact = true", ""] if scene.self_contact else []
    lines += [f"[{before}rod]", *_written_rod(scene.rod)]
    for name, end in (("start", scene.start), ("end", scene.end)):
        lines += ["", f"[{before}{name}]", *_written_support(end)]
    lines += _written(scene, ("turns",))
    if scene.gravity is not None:
        lines += ["", f"[{before}loads]", *_written(scene, ("gravity",))]
    for force in scene.point_forces:
        lines += ["", f"[[{before}loads.point_force]]", *_written(force, ("at", "force")), *_written_follower(force)]
    for couple in scene.point_couples:
        kind = "point_couple"
        lines += [
            "",
            f"[[{before}loads.{kind}]]",
            *_written(couple, ("at", "couple"), kind),
            *_written_follower(couple),
        ]
    for kind in dict.fromkeys(type(load) for load in scene.distributed):
        name, key = next((name, key) for name, (of_name, key) in DISTRIBUTED.items() if of_name is kind)
        for load in scene.distributed:
            if isinstance(load, kind):
                lines += [
                    "",
                    f"[[{before}loads.{name}]]",
                    *_written(load, (key, "part"), name),
                    *_written_follower(load),
                ]
    for clip in scene.clips:
        lines += ["", f"[[{before}clips]]", *_written(clip, ("at", "position", "tangent", "frame"))]
        lines += ["sliding = true"] if clip.sliding else []
    for k, one in enumerate(scene.obstacles):
        lines += ["", f"[[{before}obstacles]]", *written_obstacle(one, f"{where}.obstacles[{k}]")]
    return [*lines, ""]


def _written_support(support: Support) -> list[str]:
    springs = []
    if isinstance(support, Spring):
        for name in ("translation", "rotation"):
            if np.ndim(getattr(support, name)):
                raise ValueError(f"{name} of a Spring must be a number to be written: a scene file holds no matrix")
        support, springs = support.support, _written(support, ("translation", "rotation"))
    lines = [f'support = "{type(support).__name__.lower()}"']
    if isinstance(support, Joint):
        return [*lines, f"joint = {json.dumps(support.name)}", *_written(support, ("frame", "offset"))]
    lines += _written(support, ("position", "axis", "directions", "force", "moment"))
    lines += _written(support, ("frame",)) or _written(support, ("tangent",))
    return [*lines, *springs, *_written_follower(support)]


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
