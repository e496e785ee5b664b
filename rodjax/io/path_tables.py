"""The tables `[[path]]` of a scene file: what changes along a path, and the values at each of its steps."""

import math
from typing import Any

import numpy as np

from rodjax.checks import whole_number
from rodjax.io.clocking import Values
from rodjax.io.quantities import SceneFileError, check_keys, named, si_values, table_list
from rodjax.io.support_tables import SUPPORTS
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp

# More steps than this in one table are taken for a mistake: a full turn would go in steps of 0.04 degrees.
MAX_STEPS = 10_000


def changes_of(
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
            keys = SUPPORTS[kinds[name]][2] if name in kinds else ("gravity",)
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


def between(before: Values, after: Values, fraction: float, where: str) -> Values:
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


def check_spin(before: Values, after: Values, steps: int, where: str) -> None:
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


def check_frames(before: Scene, after: Scene, where: str) -> None:
    """A frame jumps by half a turn where the tangent passes through d2, which defines it."""
    for name in ("start", "end"):
        old, new = getattr(before, name), getattr(after, name)
        # The trace of a rotation is 1 + 2 cos(angle).
        if isinstance(new, Clamp) and np.sum(np.asarray(old.frame) * np.asarray(new.frame)) < -1 + 1e-6:
            raise SceneFileError(f"{where} turns the {name} by 180 deg, less is allowed; is its tangent along d2?")
