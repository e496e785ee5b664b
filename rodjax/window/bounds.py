"""Moves that make no sense: what a scene asks of its rod that no rod can do."""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import Numbers, namespace
from rodjax.geometry.vectors import root
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.model.supports import Held
from rodjax.programs.compilation import compiled
from rodjax.window.controls import rods_of


def held_places(scene: Scene) -> list[tuple[str, Any, Any]]:
    """Names, arclengths [m] and positions [m] of the places that a scene holds, one after another along the rod."""
    held = [(f"clip {k}", clip.at, clip.position) for k, clip in enumerate(scene.clips)]
    if isinstance(scene.start, Held):
        held = [("the start", 0.0, scene.start.position), *held]
    if isinstance(scene.end, Held):
        held = [*held, ("the end", scene.rod.length, scene.end.position)]
    return held


def _spans(scene: Scene) -> list[tuple[str, str, Any, Any]]:
    """Of neighbouring places that a scene holds both names, the length of the rod between them, where it slides all of
    it, and the way from one to the other.
    """
    fixed = [True] + [not clip.sliding for clip in scene.clips] + [True]
    held, xp = held_places(scene), namespace(scene)
    if not isinstance(scene.start, Held):
        fixed = fixed[1:]
    found = []
    for ((name, s, position), is_fixed), ((other, other_s, other_position), other_is_fixed) in itertools.pairwise(
        zip(held, fixed, strict=False)
    ):
        length = xp.subtract(other_s, s) if is_fixed and other_is_fixed else scene.rod.length
        found.append((name, other, length, xp.subtract(other_position, position)))
    return found


class Asked(NamedTuple):
    """What a scene asks of its rods. `reaches`: distances of neighbouring places that it holds by the length of the rod
    between them; where it slides, of all of it. `depths`: of the m places of a rod from each of its k obstacles [m],
    negative within.
    """

    reaches: Float[Numbers, "spans"]
    depths: tuple[Float[Numbers, "k m"], ...]


@compiled
def asked_of(scene: Scene | Harness) -> Asked:
    rods = rods_of(scene).values()
    reaches = [root(jnp.sum(way**2)) / length for rod in rods for _, _, length, way in _spans(rod)]
    dtype = next(iter(rods)).rod.length.dtype
    return Asked(jnp.stack(reaches) if reaches else jnp.zeros(0, dtype), tuple(map(_depths, rods)))


def _depths(scene: Scene) -> Float[Array, "k m"]:
    held = held_places(scene)
    if not scene.obstacles or not held:
        return jnp.zeros((len(scene.obstacles), len(held)), scene.rod.length.dtype)
    points = jnp.stack([position for _, _, position in held])
    return jnp.stack([jax.vmap(obstacle.at)(points) for obstacle in scene.obstacles])


def makes_sense(asked: Asked, limits: Asked) -> Bool[Array, ""]:
    """Whether places are no further apart than limits, and in no obstacle in which they were not before: these depths
    are the limits.
    """
    sound = jnp.all(asked.reaches <= limits.reaches)
    for now, before in zip(asked.depths, limits.depths, strict=True):
        sound &= ~jnp.any(~(now >= 0) & (before >= 0))
    return sound


def why_not(scene: Scene | Harness, asked: Asked, limits: Asked) -> str | None:
    """What makes no sense, in words."""
    rods = rods_of(scene)
    spans = [(prefix, *span) for prefix, rod in rods.items() for span in _spans(rod)]
    return _out_of_reach(spans, asked.reaches, limits.reaches) or next(
        filter(None, map(_within_obstacle, rods.values(), limits.depths, asked.depths)), None
    )


def _out_of_reach(spans: list[Any], found: Float[Numbers, "spans"], limits: Float[Numbers, "spans"]) -> str | None:
    """What is further apart than these multiples of the length of the rod between."""
    for (prefix, name, other, length, _), reach, limit in zip(spans, found, limits, strict=True):
        if not reach <= limit:
            where, length = f"{prefix[:-1]}: " if prefix else "", float(length)
            return (
                f"{where}{other} is {reach * length:.4g} m from {name}, but the {length:.4g} m of rod between them "
                f"reach at most {limit * length:.4g} m"
            )
    return None


def _within_obstacle(scene: Scene, before: Float[Numbers, "k m"], now: Float[Numbers, "k m"]) -> str | None:
    """Which held place has come into which obstacle."""
    entered = np.argwhere(~(now >= 0) & (before >= 0))
    if not entered.size:
        return None
    k, m = map(int, entered[0])
    name, kind = held_places(scene)[m][0], type(scene.obstacles[k]).__name__.lower()
    return f"{name} is {-now[k, m]:.4g} m inside of obstacle {k} ({kind})"
