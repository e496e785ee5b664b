"""Moves that make no sense: what a scene asks of its rod that no rod can do."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene
from rodjax.model.supports import Held
from rodjax.programs.compilation import compiled


def held_places(scene: Scene) -> list[tuple[str, float, np.ndarray]]:
    """Names, arclengths [m] and positions [m] of the places that a scene holds, one after another along the rod."""
    held = [(f"clip {k}", float(clip.at), np.asarray(clip.position)) for k, clip in enumerate(scene.clips)]
    if isinstance(scene.start, Held):
        held = [("the start", 0.0, np.asarray(scene.start.position)), *held]
    if isinstance(scene.end, Held):
        held = [*held, ("the end", float(scene.rod.length), np.asarray(scene.end.position))]
    return held


def reaches(scene: Scene) -> list[float]:
    """Distances of neighbouring places by the length of the rod between them; where it slides, of all of it."""
    return [reach for _, _, _, reach in _spans(scene)]


def out_of_reach(scene: Scene, limits: list[float]) -> str | None:
    """What is further apart than these multiples of the length of the rod between, in words."""
    for (name, other, length, reach), limit in zip(_spans(scene), limits, strict=True):
        if not reach <= limit:
            return (
                f"{other} is {reach * length:.4g} m from {name}, but the {length:.4g} m of rod between them reach at "
                f"most {limit * length:.4g} m"
            )
    return None


def _spans(scene: Scene) -> list[tuple[str, str, float, float]]:
    fixed = [True] + [not clip.sliding for clip in scene.clips] + [True]
    held = held_places(scene)
    if not isinstance(scene.start, Held):
        fixed = fixed[1:]
    spans = []
    for ((name, s, position), is_fixed), ((other, other_s, other_position), other_is_fixed) in itertools.pairwise(
        zip(held, fixed, strict=False)
    ):
        length = other_s - s if is_fixed and other_is_fixed else float(scene.rod.length)
        spans.append((name, other, length, float(np.linalg.norm(other_position - position)) / length))
    return spans


def depths(scene: Scene) -> Float[np.ndarray, "k m"]:
    """Distances [m] of the m held places from each of the k obstacles, negative within."""
    held = held_places(scene)
    if not scene.obstacles or not held:
        return np.zeros((len(scene.obstacles), len(held)))
    return np.asarray(_distances(scene.obstacles, np.stack([position for _, _, position in held])))


@compiled
def _distances(obstacles: tuple[Obstacle, ...], points: Float[Array, "m 3"]) -> Float[Array, "k m"]:
    return jnp.stack([jax.vmap(obstacle.at)(points) for obstacle in obstacles])


def within_obstacle(scene: Scene, before: Float[np.ndarray, "k m"], now: Float[np.ndarray, "k m"]) -> str | None:
    """Which held place has come into which obstacle, in words."""
    entered = np.argwhere(~(now >= 0) & (before >= 0))
    if not entered.size:
        return None
    k, m = map(int, entered[0])
    name, kind = held_places(scene)[m][0], type(scene.obstacles[k]).__name__.lower()
    return f"{name} is {-now[k, m]:.4g} m inside of obstacle {k} ({kind})"
