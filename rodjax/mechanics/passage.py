"""Whether a rod has come through an obstacle, from where it was to where it is.

Every place of the rod, and with it every obstacle that moves, goes straight from the one to the other. A place comes
through where its way leads deeper into an obstacle than half of the rod's radius, and the surface where it leaves looks
back at that where it enters: their normals are more than 120 degrees apart. Any two shapes on different sides of a long
obstacle have such a place, whatever the true way was. A rod that slides so far around an obstacle in one step counts
too. A rod that begins within an obstacle, as a first shape of the library's own may, is on no side of it: nothing is
said then but whether it ends within.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.model.obstacles import AT_ONCE, Obstacle

# Places along the rod, fewer where an obstacle has so many numbers that each distance takes time.
SAMPLES = 257
FEW_SAMPLES = 65
MANY_NUMBERS = 1000
# Of an obstacle with no more numbers than this all places and times are looked at at once.
FEW_NUMBERS = 20
# Where a way is looked at, as parts of it, and how often between those around the deepest one, in so many parts.
TIMES = 17
ZOOMS = 2
ZOOM_PARTS = 8
# Cosine between the normals on two sides of an obstacle.
OPPOSED = -0.5
# The centerline counts as within an obstacle from here on, in parts of the rod's radius.
WITHIN = 0.05


class Before(eqx.Module):
    """Where a rod last was sound, at places along it (`NodalForm.samples`), and the obstacles then, in SI units."""

    points: Float[Array, "... samples 3"]
    obstacles: tuple[Obstacle, ...]


class Sampled(NamedTuple):
    """Where a rod is now, as `Before` has it, in SI units; its radius there; `held`: beside what a support holds this,
    elsewhere not a number.
    """

    points: Float[Array, "samples 3"]
    radius: Float[Array, "samples"]
    held: Float[Array, "samples 3"]
    obstacles: tuple[Obstacle, ...]

    @property
    def before(self) -> Before:
        """The next place."""
        return Before(self.points, self.obstacles)


class Passage(eqx.Module):
    """The first obstacle, -1 for none, that a rod came through or lies within, which of both, and where, as a part of
    its length; and whether it lies within any.
    """

    obstacle: Int[Array, "..."]
    place: Float[Array, "..."]
    is_within: Bool[Array, "..."]
    lies_within: Bool[Array, "..."]

    @property
    def is_sound(self) -> Bool[Array, "..."]:
        return self.obstacle < 0


def passage(before: Before, now: Sampled) -> Passage:
    """A rod that a support holds within an obstacle may lie as deep beside it."""
    points, radius, held, obstacles = now
    found = [
        _through(old, new, before.points, points, radius, held)
        for old, new in zip(before.obstacles, obstacles, strict=True)
    ]
    passed, within, depths = (jnp.stack(values) for values in zip(*found, strict=True))
    wrong = passed | within
    which = jnp.argmax(jnp.any(wrong, axis=1))
    # Through, if so anywhere: a rod within may be on its way back.
    wrong = jnp.where(jnp.any(passed[which]), passed[which], within[which])
    place = jnp.argmax(jnp.where(wrong, depths[which], -jnp.inf))
    is_any = jnp.any(wrong)
    fraction = place.astype(radius.dtype) / (len(points) - 1)
    is_within = is_any & ~jnp.any(passed[which])
    return Passage(jnp.where(is_any, which, -1), jnp.where(is_any, fraction, jnp.nan), is_within, jnp.any(within))


def _through(
    old: Obstacle,
    new: Obstacle,
    before: Float[Array, "samples 3"],
    after: Float[Array, "samples 3"],
    radius: Float[Array, "samples"],
    held: Float[Array, "samples 3"],
) -> tuple[Bool[Array, "samples"], Bool[Array, "samples"], Float[Array, "samples"]]:
    """Which places came through an obstacle, which lie within it, and how deep they were."""
    numbers = sum(leaf.size for leaf in jax.tree.leaves(new))
    step = (SAMPLES - 1) // (FEW_SAMPLES - 1) if numbers > MANY_NUMBERS else 1
    start, displacements, rim, beside = before[::step], (after - before)[::step], radius[::step], held[::step]

    def mapped(function: Callable, *values: Array) -> Array:
        if numbers <= FEW_NUMBERS:
            return jax.vmap(function)(*values)
        return jax.lax.map(lambda each: function(*each), values, batch_size=max(AT_ONCE // numbers, 1))

    def distance(time: Float[Array, ""], point: Float[Array, "3"]) -> Float[Array, ""]:
        obstacle = jax.tree.map(lambda a, b: a + time * (b - a), old, new)
        return obstacle.at(point)

    def distances(times: Float[Array, "p t"]) -> Float[Array, "p t"]:
        points = start[:, None] + times[..., None] * displacements[:, None]
        return mapped(distance, times.reshape(-1), points.reshape(-1, 3)).reshape(times.shape)

    def normals(times: Float[Array, "2*p"]) -> Float[Array, "2*p 3"]:
        points = jnp.tile(start, (2, 1)) + times[:, None] * jnp.tile(displacements, (2, 1))
        return mapped(jax.grad(distance, argnums=1), times, points)

    begin, end = (mapped(distance, jnp.full_like(rim, time), start + time * displacements) for time in (0.0, 1.0))

    def followed() -> tuple[Bool[Array, "p"], Float[Array, "p"]]:
        """Which places come through, and how near they come."""
        times = jnp.linspace(0.0, 1.0, TIMES, dtype=start.dtype)
        numbered = jnp.arange(TIMES)[None]
        first = distances(jnp.broadcast_to(times[None], (len(start), TIMES)))
        lowest = jnp.argmin(first, axis=1)[:, None]
        is_outside = first >= rim[:, None]
        enters = jnp.max(jnp.where(is_outside & (numbered < lowest), numbered, 0), axis=1)
        leaves = jnp.min(jnp.where(is_outside & (numbered > lowest), numbered, TIMES - 1), axis=1)
        least, middle, width = jnp.min(first, axis=1), times[lowest], 1 / (TIMES - 1)
        for _ in range(ZOOMS):
            near = jnp.clip(middle + width * jnp.linspace(-1.0, 1.0, ZOOM_PARTS + 1, dtype=start.dtype)[None], 0.0, 1.0)
            found = distances(near)
            least = jnp.minimum(least, jnp.min(found, axis=1))
            middle = jnp.take_along_axis(near, jnp.argmin(found, axis=1)[:, None], axis=1)
            width *= 2 / ZOOM_PARTS
        # Both at once, to compile them once.
        both = jnp.concatenate([times[enters], times[leaves]])
        entering, leaving = jnp.split(normals(both), 2)
        is_opposed = jnp.sum(entering * leaving, axis=1) < OPPOSED
        begins_on_a_side = first[:, 0] > jnp.minimum(least / 2, 0.0)
        return is_opposed & begins_on_a_side & (least < rim / 2), least

    # Along its way a place is nowhere nearer than this to an obstacle that stands still.
    nearest = (begin + end - jnp.sqrt(jnp.sum(displacements**2, axis=1))) / 2
    is_same = jax.tree.map(lambda a, b: jnp.all(a == b), old, new)
    stands = jnp.all(jnp.stack([jnp.array(True), *jax.tree.leaves(is_same)]))
    passed, least = jax.lax.cond(
        stands & jnp.all(nearest >= rim / 2),
        lambda: (jnp.zeros(len(start), bool), jnp.minimum(begin, end)),
        followed,
    )
    of_held = mapped(distance, jnp.ones_like(rim), beside)
    is_beside = ~jnp.isnan(beside[:, 0])
    least_distance = jnp.where(is_beside, jnp.minimum(of_held, 0.0), 0.0) - WITHIN * rim
    within = end < least_distance
    passed &= ~jnp.any(begin < least_distance)
    spread = jnp.zeros(len(after), bool)
    depths = jnp.zeros_like(radius).at[::step].set(rim - least)
    return spread.at[::step].set(passed), spread.at[::step].set(within), depths
