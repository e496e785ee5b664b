"""Rods and scenes in a few lines, with values and units: what `print` shows of them."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from rodjax.checks import is_known, line
from rodjax.model.along import Along

if TYPE_CHECKING:
    from rodjax.model.harness import Harness
    from rodjax.model.rod import Rod
    from rodjax.model.scene import Scene

# Units of numbers by the names of the fields.
UNITS = {
    "length": "m",
    "radius": "m",
    "EI": "N m^2",
    "GJ": "N m^2",
    "EA": "N",
    "GA": "N",
    "mass_per_length": "kg/m",
    "rest_curvature": "1/m",
    "rest_twist": "rad/m",
    "gravity": "m/s^2",
    "position": "m",
    "at": "m",
    "force": "N",
    "moment": "N m",
    "force_per_length": "N/m",
    "couple": "N m/m",
    "point": "m",
    "start": "m",
    "end": "m",
    "center": "m",
    "size": "m",
    "offset": "m",
    "mass": "kg",
}
# Values of an array that are shown; of more its shape.
MOST_VALUES = 4


def value_text(value: Any, unit: str = "") -> str:
    """A number, a short vector or what varies along the rod, with its unit."""
    tail = f" {unit}" if unit else ""
    if isinstance(value, Along):
        samples = value.values
        if not is_known(samples) or np.ndim(samples) != 1:
            return f"{type(value).__name__}{tail}"
        return f"{np.min(samples):.4g} to {np.max(samples):.4g}{tail} ({type(value).__name__})"
    if isinstance(value, tuple):
        return f"({', '.join(value_text(part) for part in value)}){tail}"
    if not is_known(value):
        return f"traced{tail}"
    array = np.asarray(value)
    if array.ndim == 0:
        return f"{array[()]:.4g}{tail}" if array.dtype.kind in "fiu" else str(array[()])
    if array.ndim > 1 or array.size > MOST_VALUES:
        return f"array of shape {array.shape}{tail}"
    return f"({', '.join(f'{x + 0.0:.4g}' for x in array.tolist())}){tail}"


def range_text(values: Any, unit: str = "") -> str:
    """The least and the largest of numbers with their unit, or the only one."""
    tail = f" {unit}" if unit else ""
    if not is_known(values):
        return f"traced{tail}"
    values = np.asarray(values)
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low + 0.0:.4g}{tail}" if low == high else f"{low + 0.0:.4g} to {high + 0.0:.4g}{tail}"


def counted(count: int, name: str) -> str:
    return f"{count} {name}{'' if count == 1 else 's'}"


def part_text(part: Any, skipped: tuple[str, ...] = ()) -> str:
    """A support, a clip, a load or an obstacle in one line: its class, and the fields that are given."""
    if not isinstance(part, eqx.Module):
        return type(part).__name__
    told = []
    for name in part.__dataclass_fields__:
        value = getattr(part, name)
        if value is None or value is False or name in skipped:
            continue
        if name == "frame":  # its third column; of a support that says how the rod runs
            axis = "tangent" if hasattr(part, "position") else "third axis"
            told.append(f"{axis} {value_text(value[:, 2]) if getattr(value, 'ndim', 0) == 2 else 'stacked'}")
        elif value is True:
            told.append(name)
        elif isinstance(value, str):
            told.append(f"{name} {value}")
        elif isinstance(value, eqx.Module) and not isinstance(value, Along):
            told.append(part_text(value))
        elif isinstance(value, tuple) and any(isinstance(entry, eqx.Module) for entry in value):
            told.append(f"{len(value)} {name}")
        elif hasattr(value, "dtype") or isinstance(value, Along | tuple | float | int):
            told.append(f"{name} {value_text(value, UNITS.get(name, ''))}")
    return line(f"{type(part).__name__}: {', '.join(told)}") if told else type(part).__name__


def rod_text(rod: "Rod") -> str:
    """One line."""
    return part_text(rod, () if rod.rest_centerline is not None else ("rest_centerline",))


def harness_text(harness: "Harness") -> str:
    """A line for each cable, below it lines for what holds and loads it, then a line for each joint."""
    cables, joints = counted(len(harness.names), "cable"), counted(len(harness.joint_names), "joint")
    lines = [f"Harness: {cables}, {joints}"]
    for name, scene in zip(harness.names, harness.scenes, strict=True):
        rod, *others = scene_text(scene).split("\n  ")[1:]
        lines += [f"{name}: {rod}", *(f"  {other}" for other in others)]
    lines += [
        f"joint {name}: {part_text(body)}" for name, body in zip(harness.joint_names, harness.bodies, strict=True)
    ]
    pairs = [f"{first} and {second}" for first, second in harness.contact_names]
    lines += [f"may touch: {'; '.join(pairs)}"] if pairs else []
    return "\n  ".join(lines)


def scene_text(scene: "Scene") -> str:
    """A line for the rod, each support, each load, clip and obstacle."""
    count = (
        f", {scene.rod.length.shape[0]} of them along a leading axis" if getattr(scene.rod.length, "ndim", 0) else ""
    )
    lines = [f"Scene{count}", rod_text(scene.rod), f"start: {part_text(scene.start)}", f"end: {part_text(scene.end)}"]
    for name in scene.__dataclass_fields__:
        value = getattr(scene, name)
        if name in ("rod", "start", "end") or value is None or value is False:
            continue
        if value is True:
            lines.append(name)
        elif isinstance(value, tuple):
            lines += [f"{name}[{k}]: {part_text(entry)}" for k, entry in enumerate(value)]
        else:
            lines.append(f"{name}: {value_text(value, UNITS.get(name, ''))}")
    return "\n  ".join(lines)


def obstacle_name(obstacle: Any, number: int) -> str:
    """By its place among those of a scene: "obstacles[0] (Plane)"."""
    return f"obstacles[{number}] ({type(obstacle).__name__})"
