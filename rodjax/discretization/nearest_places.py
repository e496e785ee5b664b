"""Where each element of a rod comes nearest to the rod beyond it: the contact points of `self_contact`.

A well is narrow where the distance alone tells the place, as where parts cross, and bends force and place by next to
nothing. It is wide where the distance hardly grows along the rod: parts that wind around each other bend so that it
even falls between the places where they press. In a search all are wide, from a start that is not balanced with those
that it should have (`wide_cells`); at its end each becomes what it should be, and the search goes on from there.

Neighbours along the rod are no contact: less than half a turn around the rod's own radius away, or of the next element.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import Numbers
from rodjax.discretization.curve_distance import Curve, direction, seen_distance, side_at, sides_at, with_wells
from rodjax.geometry.vectors import dot
from rodjax.programs.parts import traced_once

# A well is narrow where the second derivative of the distance along the rod [1/radius] is larger than GROWS_ALONE, if
# there is one contact, or than GROWS, if there are several, which may slide together.
GROWS_ALONE = 0.1
GROWS = 0.25
# Places in each element from which the nearest ones are sought, and steps of that search.
SAMPLES = (1 / 8, 3 / 8, 5 / 8, 7 / 8)
SAMPLES_AHEAD = 2  # of the next element, those in the cell
STEPS = 12
# Steps of a search by the squared distance, before these: by the distance itself Newton's steps lead beyond the nearest
# place where that is further along the rod than the other part is away.
FAR_STEPS = 6
STANDS = 1e-14  # no place moves by more [L]: the search ends
# Squares of distances are the same to rounding.
ALIKE = 1 + 1e-12
# A step leads no element nearer to what it is nearest to than this part of the distance at which they touch.
DEEPEST = 0.5


class Nearest(NamedTuple):
    """Of k cells, numbered as their elements: places s in them and s' beyond that are nearest to one another, the
    elements there; where s or s' stays, at the end of what is allowed; and whether there is such a place.
    """

    cell: Int[Array, "k"]
    s: Float[Array, "k"]
    element: Int[Array, "k"]
    beyond: Float[Array, "k"]
    other: Int[Array, "k"]
    stays: Bool[Array, "2 k"]
    exists: Bool[Array, "k"]


def nearest(curve: Curve) -> Nearest:
    """Of each element; without derivatives."""
    return _nearest(jax.lax.stop_gradient(curve))


@traced_once
def _nearest(curve: Curve) -> Nearest:
    s, n = curve.s, len(curve.s) - 1
    cell = jnp.arange(n)
    begin, end, least, most = _range(curve)
    samples, of_element = _samples(s)
    x = side_at(curve, of_element, samples).x
    allowed = (samples[None] >= least[:, None]) & (samples[None] <= most[:, None])

    def squares(rows: Int[Numbers, "n r"]) -> Float[Array, "n r k"]:
        """Of the distances of these samples from all that their cells may touch."""
        way = x[:, rows][..., None] - x[:, None, None]
        return jnp.where(allowed[:, None], dot(way, way), jnp.inf)

    # Of a cell those of its element, and those of the next one within it.
    own = np.arange(len(samples)).reshape(n, -1)
    ahead = own[np.minimum(np.arange(n) + 1, n - 1), :SAMPLES_AHEAD]
    of_ahead = jnp.where(samples[ahead] <= end[:, None], jnp.min(squares(ahead), axis=2), jnp.inf)
    of_rows = jnp.concatenate([jnp.min(squares(own), axis=2), of_ahead], axis=1)
    row = jnp.concatenate([own, ahead], axis=1)[cell, jnp.argmin(of_rows, axis=1)]
    least_square = jnp.min(of_rows, axis=1)
    exists = jnp.isfinite(least_square)
    # The first that is as near, to rounding: `argmin` of many numbers takes several times as long as `min`.
    is_nearest = squares(row[:, None])[:, 0] <= ALIKE * least_square[:, None]
    column = jnp.min(jnp.where(is_nearest, np.arange(len(samples))[None], len(samples) - 1), axis=1)
    first = samples[row], samples[column]
    h = jnp.diff(s)

    def stepped(state: tuple[Array, ...]) -> tuple[Array, ...]:
        k, a, b = state[:3]
        element, other = jnp.where(a > s[1:], cell + 1, cell), _element_at(s, b)
        _, (of_a, of_b), (aa, ab, bb) = seen_distance(curve, cell, element, other, a, b, k < FAR_STEPS)
        is_flat, is_flat_beyond = aa * bb <= ab**2, bb <= 0
        bb = jnp.where(is_flat_beyond, 1.0, bb)
        slope, growth = of_a - ab * of_b / bb, aa - ab**2 / bb
        step = jnp.where(growth > 0, -slope / jnp.where(growth > 0, growth, 1.0), -jnp.sign(slope) * h)
        step = jnp.clip(a + jnp.clip(step, -h / 4, h / 4), begin, end) - a
        along = jnp.clip(-(of_b + ab * step) / bb, -h[other] / 2, h[other] / 2)
        nearer = jnp.clip(b + along, least, most)
        way = jnp.where(exists, jnp.abs(step) + jnp.abs(nearer - b), 0.0)
        return k + 1, a + step, nearer, jnp.max(way), is_flat, is_flat_beyond

    def goes_on(state: tuple[Array, ...]) -> Bool[Array, ""]:
        k, way = state[0], state[3]
        return (k < FAR_STEPS + STEPS) & ((k <= FAR_STEPS) | (way > STANDS))

    nowhere = jnp.zeros(n, bool)
    start = jnp.zeros((), int), *first, jnp.zeros((), s.dtype), nowhere, nowhere
    _, a, b, _, is_flat, is_flat_beyond = jax.lax.while_loop(goes_on, stepped, start)
    element, other = jnp.where(a > s[1:], cell + 1, cell), _element_at(s, b)
    stays = jnp.stack([(a <= begin) | (a >= end) | is_flat, (b <= least) | (b >= most) | is_flat_beyond])
    return Nearest(cell, a, element, b, other, stays, exists)


def comes_through(before: Curve, found: Nearest, after: Curve) -> Bool[Array, ""]:
    """Whether a step may lead one part of the rod through another: all places go straight from one curve to the other.
    `found`: the nearest ones before.

    The places of two elements that are nearest to one another keep half of the distance at which they touch, along the
    line between them. All other parts are seen as places that represent the rod as far as halfway to the next ones:
    along the line between two of these the distance stays larger than what they represent.
    """
    places = found.element, found.other, found.s, found.beyond
    distance, normal = direction(sides_at(before, *places))
    here, there = jnp.unstack(sides_at(after, *places).x, axis=1)
    along = dot(normal, here - there)
    contact_distance = before.radius[found.cell] + before.radius[found.other]
    is_pierced = jnp.any(found.exists & (along < DEEPEST * jnp.minimum(distance, contact_distance)))
    begin, of_element = _samples(before.s)
    _, _, least, most = _range(before)
    allowed = (begin[None] >= least[of_element][:, None]) & (begin[None] <= most[of_element][:, None])
    reach = jnp.max(jnp.diff(before.s)) / len(SAMPLES)
    each = (side_at(curve, of_element, begin).x for curve in (before, after))
    old, new = (x[:, :, None] - x[:, None] for x in each)
    squares, products = dot(old, old), dot(old, new)
    is_far = allowed & (squares > 4 * reach**2)
    return is_pierced | jnp.any(is_far & ((products < 0) | (products**2 < reach**2 * squares)))


@traced_once
def wide_cells(curve: Curve, pressures: Float[Array, "n+1"]) -> Bool[Array, "n"]:
    """Which cells are to have wide wells, at these pressures."""
    pushes = pressures[:-1] > 0
    first, last = jnp.argmax(pushes), len(pushes) - 1 - jnp.argmax(pushes[::-1])
    return growth(curve) < jnp.where(last - first <= 1, GROWS_ALONE, GROWS)


def growth(curve: Curve) -> Float[Array, "n"]:
    """The second derivative of the distance along the rod, without the well, where cells with wide wells have their
    places [1/radius]; of those apart by the half of their distance in the place of the radius.
    """
    curve = jax.lax.stop_gradient(with_wells(curve, jnp.ones_like(curve.radius, bool)))
    found = nearest(curve)
    distance, _, (aa, ab, bb) = seen_distance(curve, found.cell, found.element, found.other, found.s, found.beyond)
    assert curve.wells is not None
    alone = aa - curve.wells - jnp.where(found.stays[1], 0.0, ab**2 / jnp.where(bb > 0, bb, 1.0))
    return alone * jnp.maximum(curve.radius, distance / 2)


def _samples(s: Float[Array, "n+1"]) -> tuple[Float[Array, "k"], Int[Array, "k"]]:
    """Places in each element, and the elements."""
    parts = jnp.asarray(SAMPLES, s.dtype)
    begin = s[:-1, None] + parts[None] * jnp.diff(s)[:, None]
    return begin.reshape(-1), jnp.repeat(jnp.arange(len(s) - 1), len(SAMPLES))


def _range(curve: Curve) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "n"], Float[Array, "n"]]:
    """From where to where each cell lies, and the rod beyond it that is no neighbour of it.

    What is nearer bends around its own radius at most; of a closed ring through its ends too.
    """
    s, h = curve.s, jnp.diff(curve.s)
    begin, end = s[:-1], s[1:] + h / 2
    if curve.reach is not None:
        least, most, last = curve.reach
        return begin, jnp.minimum(end, last), least, most
    end = jnp.minimum(end, s[-1])
    apart = jnp.pi * jnp.max(curve.radius)
    ends = curve.positions[0] - curve.positions[-1]
    is_ring = jnp.sum(ends**2) < 4 * jnp.max(curve.radius) ** 2
    least = end + jnp.maximum(apart, h / 2)
    most = jnp.minimum(1 + begin - jnp.maximum(apart, h), 1.0)
    return begin, end, least, jnp.where(is_ring, most, 1.0)


def _element_at(s: Float[Array, "n+1"], arclengths: Float[Array, "k"]) -> Int[Array, "k"]:
    return jnp.clip(jnp.searchsorted(s, arclengths, side="right") - 1, 0, len(s) - 2).astype(int)
