"""Strings around obstacles: pulled taut, which is what a rod needs at least to pass them on its side; drawn in until
they are as long as a rod that is to begin there.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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
# part: then it is taut; at least so often, for kinks; with a free end, so often in all. Its places are then so often
# spread evenly along it.
DRAWN_PIECES = 64
DRAWN_ROUNDS = 3000
LEAST_CHANGE = 1e-7
LEAST_ROUNDS = 5
ROUNDS_OUT = 60
SPREADS = 3
# It is drawn in where it is longer than the rod by this part, or nearer to an obstacle than the radius by this one, and
# kept away by this part more than the radius.
LONGER = 0.02
NEARER = 0.01
BESIDE = 0.1
# Across the middle of an obstacle its normals have another side: a cosine below this, and not that of a corner. In so
# many directions about the way across an obstacle it is looked at how far it is to get out, in so many steps, each
# as long as the distance.
OPPOSITE = -0.1
DIRECTIONS = 8
MOST_STEPS = 24
# Depth of edges within obstacles, at these parts of them, counts so often: a way out leads nowhere where a string must
# pass through the obstacle to get there.
BETWEEN = (0.25, 0.5, 0.75)
DEPTH_WEIGHT = 10.0
ALIKE = 1e-6
# Where a string drawn in after that lies within obstacles still, as between two that leave it no room, it is led out in
# other directions, so many at most.
MOST_DIRECTIONS = 4
# A place within an obstacle is pushed out so often, where that leads into another one: pushed once more, it is caught.
MOST_PUSHES = 4


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


def _nearest(string: Float[Array, "q 3"], obstacles: tuple[Obstacle, ...]) -> Float[Array, ""]:
    """The distance of its inner places from obstacles."""
    return jnp.min(jax.vmap(_distance(obstacles))(string[1:-1]))


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
    tangents: Float[Array, "2 3"],
    obstacles: tuple[Obstacle, ...],
    radius: Float[Array, ""],
    length: Float[Array, ""],
) -> tuple[Float[Array, "q 3"], Bool[Array, ""]]:
    """A string that begins as `points` and is led out of the obstacles and drawn in until it is taut or no longer than
    `length`; and whether that was needed. It stays on its side of what is thicker than its steps, and has the tangents
    that supports hold, where these are not zero. Of the directions in which it may be led out the first is taken after
    which it lies outside, or else the one that leaves it least deep within.

    A rod that begins far too long, within an obstacle, or with kinks, its axial stiffness alone pulls, to any side.
    """
    begin = resampled(points, DRAWN_PIECES)
    nearest, enough = _nearest(begin, obstacles), (1 - NEARER) * radius
    is_needed = (_length(begin) > (1 + LONGER) * length) | (nearest < enough)
    radius = (1 + BESIDE) * radius

    def turned(string: Float[Array, "q 3"]) -> Float[Array, "q 3"]:
        first, last = length / DRAWN_PIECES * tangents
        is_first, is_last = jnp.any(tangents != 0, axis=1)
        string = string.at[1].set(jnp.where(is_first, string[0] + first, string[1]))
        return string.at[-2].set(jnp.where(is_last, string[-1] - last, string[-2]))

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        _, size, before, count = state
        changes = jnp.abs(before - size) > LEAST_CHANGE * size
        return is_needed & (count < DRAWN_ROUNDS) & ((count <= LEAST_ROUNDS) | ((size > length) & changes))

    def closer(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        string, size, _, count = state
        pulled = _pulled(string, obstacles, radius, turned)
        pulled = jnp.where((size > length) | (count < LEAST_ROUNDS), pulled, _outside(string, obstacles, radius))
        return pulled, _length(pulled), size, count + 1

    def in_direction(rank: Array) -> tuple[Array, Array]:
        led, is_led = _led_to_one_side(begin, obstacles, radius, rank)
        start = led, _length(led), _length(led), jnp.zeros((), int)
        string = jax.lax.while_loop(goes_on, closer, start)[0]
        for _ in range(SPREADS):
            string = _outside(_spread(string), obstacles, radius)
        return string, is_led

    def is_inside(state: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        _, distance, is_led, rank = state
        return (rank == 0) | (is_led & (distance < enough) & (rank < MOST_DIRECTIONS))

    def further_out(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        string, distance, _, rank = state
        new, is_led = in_direction(rank)
        there = _nearest(new, obstacles)
        is_better = there > distance
        return jnp.where(is_better, new, string), jnp.where(is_better, there, distance), is_led, rank + 1

    none = begin, jnp.asarray(-jnp.inf, begin.dtype), jnp.zeros((), bool), jnp.zeros((), int)
    return jax.lax.while_loop(is_inside, further_out, none)[0], is_needed


def led_out(
    points: Float[Array, "m 3"],
    tangent: Float[Array, "3"],
    first_side: Float[Array, "3"],
    obstacles: tuple[Obstacle, ...],
    radius: Float[Array, ""],
    length: Float[Array, ""],
) -> tuple[Float[Array, "q 3"], Bool[Array, ""]]:
    """A string held at its first place alone, led out of the obstacles from `points` and cut at `length`; and whether
    that was needed. It goes straight on beyond what it lies on, and has the tangent that the support holds, where that
    is not zero. `first_side`: the direction in which it is led out where others are as near.
    """
    begin = resampled(points, DRAWN_PIECES)
    nearest = jnp.min(jax.vmap(_distance(obstacles))(begin[1:]))
    is_needed = nearest < (1 - NEARER) * radius
    radius, step = (1 + BESIDE) * radius, length / DRAWN_PIECES

    def straight_on(string: Float[Array, "q 3"]) -> Float[Array, "q 3"]:
        string = string.at[1].set(jnp.where(jnp.any(tangent != 0), string[0] + step * tangent, string[1]))
        return string.at[-1].set(2 * string[-2] - string[-3])

    # With a place beyond its end, which need not be outside.
    string = jnp.concatenate([begin, 2 * begin[-1:] - begin[-2:-1]])
    string, _ = _led_to_one_side(string, obstacles, radius, jnp.zeros((), int), first_side)
    rounds = jnp.where(is_needed, ROUNDS_OUT, 0)
    string = jax.lax.fori_loop(0, rounds, lambda _, last: _pulled(last, obstacles, radius, straight_on), string)
    for _ in range(SPREADS):
        beyond = string[-1:] + 2 * length * _unit(string[-1:] - string[-3:-2])
        string = _spread(jnp.concatenate([string, beyond]), length + 2 * step)[:-1]
        string = _outside(string, obstacles, radius)
    return string[:-1], is_needed


def _led_to_one_side(
    string: Float[Array, "q 3"],
    obstacles: tuple[Obstacle, ...],
    radius: Float[Array, ""],
    rank: Int[Array, ""],
    first_side: Float[Array, "3"] | None = None,
) -> tuple[Float[Array, "q 3"], Bool[Array, ""]]:
    """Out of obstacles: also of those that it crosses in their middle, whose distance would lead one half of it
    forwards and the other backwards, and of several that would lead it from one into the other, in the direction
    across, of several, in which all of it is out soonest and no edge leads through an obstacle to get there, or in that
    of a higher `rank`; and whether any is led in such a direction. Directions are counted from where the string sags,
    or from `first_side` of a string that is free at its end: that leads it out also where it ends within.
    """
    places, distance = string[1:-1], _distance(obstacles)
    is_within = jax.vmap(distance)(places) < radius
    outside, normals, is_caught = _ways_out(places, distance, radius)
    # The places of each way through obstacles have a number of their own, those outside of all 0.
    begins = is_within & ~jnp.concatenate([jnp.zeros(1, bool), is_within[:-1]])
    number, count, k = jnp.where(is_within, jnp.cumsum(begins), 0), len(places), jnp.arange(len(places))
    # In the middle itself there may be no normal: of places on both sides of another.
    is_opposite = jnp.sum(normals[2:] * normals[:-2], axis=1) < OPPOSITE
    parts = jnp.pad(is_within[2:] & is_within[1:-1] & is_within[:-2] & is_opposite, 1) | is_caught
    if first_side is not None:
        parts = parts.at[-1].set(is_within[-1])
    is_parted = jax.ops.segment_max(parts.astype(int), number, count)[number] > 0
    first = jax.ops.segment_min(k, number, count)[number]
    last = jax.ops.segment_max(k, number, count)[number]
    along = _unit(string[jnp.clip(last + 2, 0, count + 1)] - string[jnp.clip(first, 0, count + 1)])
    side = jnp.mean(string, axis=0) - (string[0] + string[-1]) / 2 if first_side is None else first_side
    sag = jnp.broadcast_to(side, along.shape)
    aside = _unit(sag - jnp.sum(sag * along, axis=1, keepdims=True) * along)
    angles = jnp.arange(DIRECTIONS, dtype=string.dtype)[:, None, None] * (2 * jnp.pi / DIRECTIONS)
    across = jnp.cos(angles) * aside[None] + jnp.sin(angles) * jnp.cross(along, aside)[None]

    def further(_: int, ways: Float[Array, "d p"]) -> Float[Array, "d p"]:
        there = jax.vmap(jax.vmap(distance))(places[None] + ways[..., None] * across)
        return ways + jnp.maximum(radius - there, 0.0)

    is_led = is_parted & is_within

    def led(ways: Float[Array, "p"], across: Float[Array, "p 3"]) -> Float[Array, "q 3"]:
        return string.at[1:-1].set(jnp.where(is_led[:, None], places + ways[:, None] * across, outside))

    def depths(_: int, ways: Float[Array, "d p"]) -> Float[Array, "d p"]:
        """Ways, and how deep the edges to and from each place then lie within obstacles between their ends."""

        def deepest(ways: Float[Array, "p"], across: Float[Array, "p 3"]) -> Float[Array, "p"]:
            there = led(ways, across)
            parts = jnp.array(BETWEEN, string.dtype)[None, :, None]
            between = there[:-1, None] + parts * jnp.diff(there, axis=0)[:, None]
            depth = radius - jnp.min(jax.vmap(jax.vmap(distance))(between), axis=1)
            return jnp.maximum(jnp.maximum(depth[:-1], depth[1:]), 0.0)

        return ways + DEPTH_WEIGHT * jax.vmap(deepest)(ways, across)

    is_any = jnp.any(is_parted)
    steps = jnp.where(is_any, MOST_STEPS, 0)
    ways = jax.lax.fori_loop(0, steps, further, jnp.zeros(across.shape[:2], string.dtype))
    prices = jax.lax.fori_loop(0, jnp.where(is_any, 1, 0), depths, ways)
    dearest = jax.vmap(lambda prices: jax.ops.segment_max(prices, number, count))(prices)[:, number]
    # Of those that are alike the first.
    dearest *= 1 + ALIKE * jnp.arange(DIRECTIONS, dtype=string.dtype)[:, None]
    chosen = jnp.argmax(jnp.sum(dearest[None] < dearest[:, None], axis=1) == rank, axis=0)
    return led(ways[chosen, k], across[chosen, k]), is_any


def _ways_out(
    places: Float[Array, "p 3"], distance: Callable[[Array], Array], radius: Float[Array, ""]
) -> tuple[Float[Array, "p 3"], Float[Array, "p 3"], Bool[Array, "p"]]:
    """Where and in which directions distances lead places out of obstacles at last, and whether they do not."""

    def further(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        places, last = state[:2]
        distances, normals = jax.vmap(jax.value_and_grad(distance))(places)
        out = jnp.where(distances < radius, radius - distances, 0.0)[:, None]
        return places + out * normals, jnp.where(out > 0, normals, last), out[:, 0] > NEARER * radius

    begin = places, jnp.zeros_like(places), jnp.zeros(len(places), bool)
    return jax.lax.fori_loop(0, MOST_PUSHES, further, begin)


def _unit(vectors: Float[Array, "p 3"]) -> Float[Array, "p 3"]:
    sizes = jnp.sqrt(jnp.sum(vectors**2, axis=1, keepdims=True))
    return jnp.where(sizes > 0, vectors / jnp.where(sizes > 0, sizes, 1.0), 0.0)


def _spread(string: Float[Array, "q 3"], length: Float[Array, ""] | None = None) -> Float[Array, "q 3"]:
    """The same string with places at equal distances along it, as far as `length`."""
    steps = jnp.sqrt(jnp.sum(jnp.diff(string, axis=0) ** 2, axis=1))
    along = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    at = jnp.linspace(0.0, 1.0, len(string), dtype=steps.dtype) * (along[-1] if length is None else length)
    return jnp.stack([jnp.interp(at, along, component) for component in string.T], axis=1)
