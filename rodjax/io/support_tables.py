"""The tables `[start]`, `[end]` and `[[clips]]` of a scene file: the keys of each support, and what they make."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rodjax.checks import Numbers, is_known, namespace
from rodjax.io.clocking import is_unclocked
from rodjax.io.obstacle_tables import with_direction
from rodjax.io.part_reader import PartReader
from rodjax.io.quantities import SceneFileError, choice, flag, named, table_list
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

_FRAME = ("frame", "tangent", "d2", "spin")
SPRINGS = ("translation", "rotation")
# The keys that a support must have, may have, and may change along a path.
SUPPORTS = {
    "clamp": (("position",), (*_FRAME, *SPRINGS), ("position", "tangent", "d2", "spin")),
    "swivel": (("position", "tangent"), (), ("position", "tangent")),
    "pin": (("position",), ("translation",), ("position",)),
    "free": ((), ("force", "moment"), ("force", "moment")),
    "hinge": (("position", "axis"), (*_FRAME, *SPRINGS), ()),
    "slider": (("position", "directions"), (*_FRAME, *SPRINGS), ()),
    "joint": ((), (*_FRAME, "offset"), ()),
}
# Keys of a support that are no numbers.
_OTHER = {"free": ("support", "follower"), "joint": ("support", "joint")}
MOVABLE = {"hinge": Hinge, "slider": Slider}
_SPIN_NEEDS_D2 = "{0}.d2 or {0}.frame is needed for {0}.spin, which turns it from there"


def support_kind(table: Any, where: str) -> str:
    kind = choice(table, where, "support", list(SUPPORTS))
    if kind is None:
        raise SceneFileError(f"{where}.support is missing; allowed are {', '.join(SUPPORTS)}")
    return kind


def end_values(reader: PartReader, table: dict[str, Any], where: str, kind: str) -> dict[str, np.ndarray]:
    required, optional, _ = SUPPORTS[kind]
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


def support_of(
    reader: PartReader,
    kind: str,
    values: dict[str, np.ndarray],
    where: str,
    follower: bool = False,
    resists: bool = False,
    joint: str | None = None,
) -> Support:
    springs = {key: values[key] for key in SPRINGS if key in values}
    if springs:
        if kind == "clamp" and is_unclocked(values):
            raise SceneFileError(f"{where}.d2 or {where}.frame is needed for a clamp with springs")
        rigid = {key: value for key, value in values.items() if key not in springs}
        with named(where):
            return Spring(support_of(reader, kind, rigid, where), **springs)
    with named(where):
        if kind in ("hinge", "slider", "joint"):
            numbers = {key: value for key, value in values.items() if key not in _FRAME}
            if "spin" in values:
                numbers["frame"] = _placed(reader, values)
            return Joint(joint or "", **numbers) if kind == "joint" else MOVABLE[kind](**numbers)
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


def body_support(reader: PartReader, table: dict[str, Any], where: str) -> Support:
    """The support of a body of a harness, of the keys that an end has."""
    kind = choice(table, where, "support", ["clamp", "pin", "hinge", "slider"])
    if kind is None:
        raise SceneFileError(f"{where}.support is missing; allowed are clamp, pin, hinge, slider")
    values = end_values(reader, table, where, kind)
    if kind == "clamp" and is_unclocked(values):
        raise SceneFileError(f"{where}.d2 or {where}.frame is needed for the clamp of a joint")
    return support_of(reader, kind, values, where)


def clips_of(reader: PartReader, tables: Any) -> list[Clip]:
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


def _clip_direction(reader: PartReader, values: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
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


def _placed(reader: PartReader, values: dict[str, np.ndarray]) -> Any:
    """The frame that a table states."""
    placed = values["frame"] if "frame" in values else reader.part(_frame, values["tangent"], values["d2"])
    return _spun(placed, values["spin"])


def _frame(reader: PartReader, tangent: np.ndarray, d2: np.ndarray) -> Float[Numbers, "3 3"]:
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
