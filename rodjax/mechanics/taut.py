"""Strings around obstacles: pulled taut, which is what a rod needs at least to pass them on its side; drawn in until
they are as long as a rod that is to begin there.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.geometry.interpolation import resampled
from rodjax.model.obstacles import Obstacle, least
from rodjax.programs.compilation import compiled

# Pieces of the taut string, at its chords: too short by their angle squared over 24, so that too little is asked for.
# Each place goes so often to the mean of itself and its neighbours, and then out of the obstacles.
PIECES = 32
ROUNDS = 2250
# The string touches an obstacle from which it is less than this part of the radius away.
TOUCHES = 0.05
# A string is drawn in by this many pieces, at most so many times, until a round changes its length by no more than this
# part: then it is taut; at least so often, for kinks. Its places are then so often spread evenly along it.
DRAWN_PIECES = 64
DRAWN_ROUNDS = 3000
LEAST_CHANGE = 1e-7
LEAST_ROUNDS = 5
SPREADS = 3
# It is drawn in where it is longer than the rod by this part, or nearer to an obstacle than the radius by this one, and
# kept away by this part more than the radius.
LONGER = 0.02
NEARER = 0.01
BESIDE = 0.1


def _distance(obstacles: tuple[Obstacle, ...]) -> Callable[[Float[Array, "3"]], Float[Array, ""]]:
    """From the nearest obstacle."""
    return lambda point: least(*(obstacle.at(point) for obstacle in obstacles))


def _pulled(
    string: Float[Array, "q 3"],
    obstacles: tuple[Obstacle, ...],
    radius: Array,
    turned: Callable[[Array], Array] = lambda string: string,
) -> Float[Array, "q 3"]:
    """Each inner place at the mean of itself and its neighbours, and then outside of the obstacles."""
    pulled = string.at[1:-1].set((string[:-2] + string[1:-1] + string[2:]) / 3)
    return _outside(turned(pulled), obstacles, radius)


def _outside(string: Float[Array, "q 3"], obstacles: tuple[Obstacle, ...], radius: Array) -> Float[Array, "q 3"]:
    distances, normals = jax.vmap(jax.value_and_grad(_distance(obstacles)))(string[1:-1])
    out = jnp.where(distances < radius, radius - distances, 0.0)
    return string.at[1:-1].add(out[:, None] * normals)


def _length(string: Float[Array, "q 3"]) -> Float[Array, ""]:
    return jnp.sum(jnp.sqrt(jnp.sum(jnp.diff(string, axis=0) ** 2, axis=1)))


@compiled
def taut(
    points: Float[Array, "p 3"], obstacles: tuple[Obstacle, ...], radius: Float[Array, ""]
) -> tuple[Float[Array, ""], Bool[Array, "k"]]:
    """The length of a string that begins as `points` and is pulled taut between its ends, nowhere nearer to an obstacle
    than `radius`, and which obstacles it touches. It stays on its side of what is thicker than its steps.
    """
    steps = (len(points) - 1) // PIECES
    string = jax.lax.fori_loop(0, ROUNDS, lambda _, string: _pulled(string, obstacles, radius), points[::steps])
    touched = jnp.stack(
        [jnp.min(jax.vmap(obstacle.at)(string[1:-1])) < (1 + TOUCHES) * radius for obstacle in obstacles]
    )
    return _length(string), touched


def drawn_in(
    points: Float[Array, "m 3"],
    tangents: tuple[Float[Array, "3"] | None, Float[Array, "3"] | None],
    obstacles: tuple[Obstacle, ...],
    radius: Float[Array, ""],
    length: Float[Array, ""],
) -> tuple[Float[Array, "q 3"], Bool[Array, ""]]:
    """A string that begins as `points` and is led out of the obstacles and drawn in until it is taut or no longer than
    `length`; and whether that was needed. It stays on its side of what is thicker than its steps, and has the tangents
    that supports hold.

    A rod that begins far too long, within an obstacle, or with kinks, its axial stiffness alone pulls, to any side.
    """
    begin = resampled(points, DRAWN_PIECES)
    nearest = jnp.min(jax.vmap(_distance(obstacles))(begin[1:-1]))
    is_needed = (_length(begin) > (1 + LONGER) * length) | (nearest < (1 - NEARER) * radius)
    radius = (1 + BESIDE) * radius

    def turned(string: Float[Array, "q 3"]) -> Float[Array, "q 3"]:
        first, last = tangents
        if first is not None:
            string = string.at[1].set(string[0] + length / DRAWN_PIECES * first)
        if last is not None:
            string = string.at[-2].set(string[-1] - length / DRAWN_PIECES * last)
        return string

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        _, size, before, count = state
        changes = jnp.abs(before - size) > LEAST_CHANGE * size
        return is_needed & (count < DRAWN_ROUNDS) & ((count <= LEAST_ROUNDS) | ((size > length) & changes))

    def closer(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        string, size, _, count = state
        pulled = _pulled(string, obstacles, radius, turned)
        pulled = jnp.where((size > length) | (count < LEAST_ROUNDS), pulled, _outside(string, obstacles, radius))
        return pulled, _length(pulled), size, count + 1

    start = begin, _length(begin), _length(begin), jnp.zeros((), int)
    string = jax.lax.while_loop(goes_on, closer, start)[0]
    for _ in range(SPREADS):
        string = _outside(_spread(string), obstacles, radius)
    return string, is_needed


def _spread(string: Float[Array, "q 3"]) -> Float[Array, "q 3"]:
    """The same string with places at equal distances along it."""
    steps = jnp.sqrt(jnp.sum(jnp.diff(string, axis=0) ** 2, axis=1))
    along = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    at = jnp.linspace(0.0, 1.0, len(string), dtype=steps.dtype) * along[-1]
    return jnp.stack([jnp.interp(at, along, component) for component in string.T], axis=1)
