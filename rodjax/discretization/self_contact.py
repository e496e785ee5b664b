"""Contact of a rod with itself: where each element comes nearest to the rod beyond it.

The centerline is the cubic through the positions and tangents of the nodes. Each element has a cell, from its first
node to the middle of the next element. Its contact point is that place s in the cell, and that place s' further along
the rod, where

    g = |x(s) - x(s')| + k (s - s_3/4)^2/2 - r(s) - r(s')

is least; the gap g is a function of the four nodes beside these places. The second term, the well of the cell, keeps
the place at three quarters of the element where two parts of the rod lie along one another, as without it the place
would be undetermined. Where the place leaves a cell the next one has it already, with a smaller gap: there, at one
quarter of an element, where the rod counts as thinnest, two cells may share one contact. At a node, where the curvature
jumps, none does.

A well is narrow where the distance alone tells the place, as where parts cross, and bends force and place by next to
nothing. It is wide where the distance hardly grows along the rod: parts that wind around each other bend so that it
even falls between the places where they press. In a search all are wide, from a start that is not balanced with those
that it should have (`wide_cells`); at its end each becomes what it should be, and the search goes on from there.

First derivatives of g are those at fixed places; the second ones count that the places move. Neighbours along the rod
are no contact: less than half a turn around the rod's own radius away, or of the next element.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import Numbers
from rodjax.geometry.vectors import cross, dot
from rodjax.linalg.far_rows import FarRows
from rodjax.programs.parts import traced_once

# NARROW: by how much the gap of a narrow well grows half of an element from its middle [radii]. WIDE: stiffness k of a
# wide well [1/radius], whose gap grows there by DEEPEST_WELL at most [radii]. A well is narrow where the second
# derivative of the distance along the rod [1/radius] is larger than GROWS_ALONE, if there is one contact, or than
# GROWS, if there are several, which may slide together.
NARROW = 3e-4
WIDE = 0.2
DEEPEST_WELL = 0.1
GROWS_ALONE = 0.1
GROWS = 0.25
# The middle of a well, as part of its element.
MIDDLE = 0.75
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
# Of the elements, those nearest to the rod beyond them may touch it: at most so many.
MOST_CONTACTS = 48
# A step leads no element nearer to what it is nearest to than this part of the distance at which they touch.
DEEPEST = 0.5
# Where two parts of the rod cross within this distance [L], they part at right angles to both.
CROSSING = 1e-9
# Gap of an element with nothing beyond it [L].
NOTHING_BEYOND = 1.0


class Curve(NamedTuple):
    """A rod's centerline on a mesh, and what moves it: axes about which the tangents of the nodes turn, 0 in `free` at
    nodes whose place is given; its radius in the middle of elements. `normal`: of the plane in which it stays, `None`
    in space; `reach`: from where to where of each element the rod beyond it begins and ends, `None` where that is all
    but neighbours, and where cells end; `wells`: stiffness of the well of each element, `None` where all are narrow.
    """

    s: Float[Array, "n+1"]
    positions: Float[Array, "n+1 3"]
    tangents: Float[Array, "3 n+1"]
    axes: Float[Array, "3 b n+1"]
    free: Float[Array, "n+1"]
    radius: Float[Array, "n"]
    normal: Float[Array, "3"] | None = None
    reach: tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, ""]] | None = None
    wells: Float[Array, "n"] | None = None


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


class Side(NamedTuple):
    """A place of the curve: position, its first two derivatives by arclength, and the weights in the position and the
    first derivative of both nodes' positions and tangents.
    """

    x: Float[Array, "3 k"]
    slope: Float[Array, "3 k"]
    curvature: Float[Array, "3 k"]
    of_positions: Float[Array, "2 2 k"]  # [derivative, node]
    of_tangents: Float[Array, "2 2 k"]


class SelfContacts(NamedTuple):
    """Gaps of the elements, a last number that stands for nothing; their rows; second derivatives of what L has of them
    by the rotations of each node alone.
    """

    gaps: Float[Array, "n+1"]
    rows: FarRows
    by_rotations: Float[Array, "b b n+1"]


def nearest(curve: Curve) -> Nearest:
    """Of each element; without derivatives."""
    return _nearest(jax.lax.stop_gradient(curve))


@traced_once
def _nearest(curve: Curve) -> Nearest:
    s, n = curve.s, len(curve.s) - 1
    cell = jnp.arange(n)
    begin, end, least, most = _range(curve)
    samples, of_element = _samples(s)
    x = jnp.stack(side_at(curve, of_element, samples).x)  # [3, k]
    allowed = (samples[None] >= least[:, None]) & (samples[None] <= most[:, None])

    def squares(rows: Int[Numbers, "n r"]) -> Float[Array, "n r k"]:
        """Of the distances of these samples from all that their cells may touch."""
        parts = (x[c][rows][..., None] - x[c][None, None] for c in range(3))
        return jnp.where(allowed[:, None], functools.reduce(jnp.add, map(jnp.square, parts)), jnp.inf)

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

    def nearer(k: Array, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        a, b = pair
        element, other = jnp.where(a > s[1:], cell + 1, cell), _element_at(s, b)
        _, (of_a, of_b), (aa, ab, bb) = seen_distance(curve, cell, element, other, a, b, k < FAR_STEPS)
        bb = jnp.where(bb > 0, bb, 1.0)
        slope, growth = of_a - ab * of_b / bb, aa - ab**2 / bb
        step = jnp.where(growth > 0, -slope / jnp.where(growth > 0, growth, 1.0), -jnp.sign(slope) * h)
        step = jnp.clip(a + jnp.clip(step, -h / 4, h / 4), begin, end) - a
        along = jnp.clip(-(of_b + ab * step) / bb, -h[other] / 2, h[other] / 2)
        return a + step, jnp.clip(b + along, least, most)

    def stepped(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        k, a, b, _ = state
        nearer_a, nearer_b = nearer(k, (a, b))
        way = jnp.where(exists, jnp.abs(nearer_a - a) + jnp.abs(nearer_b - b), 0.0)
        return k + 1, nearer_a, nearer_b, jnp.max(way)

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        k, _, _, way = state
        return (k < FAR_STEPS + STEPS) & ((k <= FAR_STEPS) | (way > STANDS))

    _, a, b, _ = jax.lax.while_loop(goes_on, stepped, (jnp.zeros((), int), *first, jnp.zeros((), s.dtype)))
    element, other = jnp.where(a > s[1:], cell + 1, cell), _element_at(s, b)
    _, _, (aa, ab, bb) = seen_distance(curve, cell, element, other, a, b)
    is_flat = aa * bb <= ab**2
    stays = jnp.stack([(a <= begin) | (a >= end) | is_flat, (b <= least) | (b >= most) | (bb <= 0)])
    return Nearest(cell, a, element, b, other, stays, exists)


def self_contacts(curve: Curve, pressures: Float[Array, "n+1"], unit: Float[Array, ""], row: int) -> SelfContacts:
    """At a point with these pressures, which are forces in the `unit` given, as gaps are lengths in its inverse; `row`:
    as of `FarRows`.
    """
    found = nearest(curve)
    n = len(found.s)
    gaps = jnp.where(found.exists, moving_gaps(curve, found)[0], NOTHING_BEYOND) * unit
    # Those that push go on doing so.
    order = jnp.argsort(jnp.where(pressures[:-1] > 0, -1.0, jax.lax.stop_gradient(gaps)))
    chosen = order[: min(n, MOST_CONTACTS)]
    found = Nearest(*(leaf[..., chosen] for leaf in found))
    vectors, nodes, by_rotations = gap_vectors(curve, found, unit * pressures[chosen])
    vectors = vectors.at[0].multiply(unit)
    count = curve.axes.shape[1]
    rows = FarRows(vectors[:, :count], vectors[:, count:], nodes, chosen, row)
    is_chosen = jnp.zeros(n, bool).at[chosen].set(True)
    nothing = NOTHING_BEYOND * unit
    return SelfContacts(jnp.append(jnp.where(is_chosen, gaps, nothing), nothing), rows, by_rotations)


def comes_through(before: Curve, after: Curve) -> Bool[Array, ""]:
    """Whether a step may lead one part of the rod through another: all places go straight from one curve to the other.

    The places of two elements that are nearest to one another keep half of the distance at which they touch, along the
    line between them. All other parts are seen as places that represent the rod as far as halfway to the next ones:
    along the line between two of these the distance stays larger than what they represent.
    """
    found = nearest(before)
    here, there = side_at(before, found.element, found.s), side_at(before, found.other, found.beyond)
    distance, normal = direction(here, there)
    way = side_at(after, found.element, found.s).x - side_at(after, found.other, found.beyond).x
    along = dot(normal, way)
    contact_distance = before.radius[found.cell] + before.radius[found.other]
    is_pierced = jnp.any(found.exists & (along < DEEPEST * jnp.minimum(distance, contact_distance)))
    begin, of_element = _samples(before.s)
    _, _, least, most = _range(before)
    allowed = (begin[None] >= least[of_element][:, None]) & (begin[None] <= most[of_element][:, None])
    reach = jnp.max(jnp.diff(before.s)) / len(SAMPLES)
    old, new = ([c[:, None] - c[None] for c in side_at(curve, of_element, begin).x] for curve in (before, after))
    squares, products = (functools.reduce(jnp.add, map(jnp.multiply, old, way)) for way in (old, new))
    is_far = allowed & (squares > 4 * reach**2)
    return is_pierced | jnp.any(is_far & ((products < 0) | (products**2 < reach**2 * squares)))


class Exerted(NamedTuple):
    """Of each element: the places s and s' where it is nearest to the rod beyond it, the gap, infinite where there is
    nothing beyond, and the force there on the rod at s.
    """

    s: Float[Array, "n"]
    beyond: Float[Array, "n"]
    gaps: Float[Array, "n"]
    forces: Float[Array, "3 n"]


def exerted(curve: Curve, pressures: Float[Array, "n+1"]) -> Exerted:
    return exerted_at(curve, pressures, nearest(curve))


def exerted_at(curve: Curve, pressures: Float[Array, "n+1"], found: Nearest) -> Exerted:
    gaps, a, b = moving_gaps(curve, found)
    _, normal = direction(side_at(curve, found.element, a), side_at(curve, found.other, b))
    forces = jnp.where(found.exists, pressures[:-1], 0.0)[None] * normal
    return Exerted(a, b, jnp.where(found.exists, gaps, jnp.inf), forces)


def on_elements(curve: Curve, pressures: Float[Array, "n+1"], found: Nearest | None = None) -> tuple[Array, Array]:
    """What pressures apply to the nodes at start and end of each element, and to their tangents, (3, 2, n) both.
    `found`: the nearest places, if they are known.
    """
    found = nearest(curve) if found is None else found
    a, b, _, forces = exerted_at(curve, pressures, found)
    on_positions = on_tangents = jnp.zeros((3, 2, len(curve.s) - 1), forces.dtype)
    for s, element, sign in ((a, found.element, 1), (b, found.other, -1)):
        side = side_at(curve, element, s)
        on_positions = on_positions.at[..., element].add(sign * forces[:, None] * side.of_positions[0][None])
        on_tangents = on_tangents.at[..., element].add(sign * forces[:, None] * side.of_tangents[0][None])
    return on_positions, on_tangents


@traced_once
def moving_gaps(curve: Curve, found: Nearest) -> tuple[Float[Array, "k"], Float[Array, "k"], Float[Array, "k"]]:
    """And the places, as they move with the curve: by two steps of Newton's method, which have the first three
    derivatives.
    """
    a, b = found.s, found.beyond
    a_stays, b_stays = found.stays
    for _ in range(2):
        _, (of_a, of_b), (aa, ab, bb) = seen_distance(curve, found.cell, found.element, found.other, a, b)
        of_a, of_b = jnp.where(a_stays, 0.0, of_a), jnp.where(b_stays, 0.0, of_b)
        aa, bb = jnp.where(a_stays, 1.0, aa), jnp.where(b_stays, 1.0, bb)
        ab = jnp.where(a_stays | b_stays, 0.0, ab)
        determinant = aa * bb - ab**2
        a, b = a - (bb * of_a - ab * of_b) / determinant, b - (aa * of_b - ab * of_a) / determinant
    distance, _, _ = seen_distance(curve, found.cell, found.element, found.other, a, b)
    return distance - curve.radius[found.cell] - curve.radius[found.other], a, b


@traced_once
def gap_vectors(
    curve: Curve, found: Nearest, pressures: Float[Array, "p"]
) -> tuple[Float[Array, "5 b+3 4 p"], Int[Array, "4 p"], Float[Array, "b b n+1"]]:
    """The gradient of each gap and the vectors of its curvature, by the rotations and positions of its nodes; these;
    and what of the curvature is by the rotations of one node.
    """
    _, a, b = moving_gaps(curve, found)
    here, there = side_at(curve, found.element, a), side_at(curve, found.other, b)
    nodes = jnp.stack([found.element, found.element + 1, found.other, found.other + 1])
    d, normal = direction(here, there)
    tangents, axes = curve.tangents[:, nodes], curve.axes[:, :, nodes]  # [3, 4, p], [3, b, 4, p]
    turned = cross(axes, jnp.broadcast_to(tangents[:, None], axes.shape))
    signs = jnp.array([1.0, 1.0, -1.0, -1.0], d.dtype)[:, None]
    is_free = signs * curve.free[nodes]
    on_positions = (
        jnp.concatenate([here.of_positions, there.of_positions], axis=1) * is_free[None]
    )  # [derivative, node, p]
    on_tangents = jnp.concatenate([here.of_tangents, there.of_tangents], axis=1) * signs[None]

    def along(v: Float[Array, "3 p"], derivative: int = 0) -> Array:
        """The rate of v . way, or of v . the slopes on both sides, by rotations and positions of the nodes."""
        if curve.normal is not None:
            v = v - curve.normal[:, None] * (curve.normal @ v)[None]
        by_rotation = jnp.einsum("cp,cbkp->bkp", v, turned) * on_tangents[derivative][None]
        return jnp.concatenate([by_rotation, v[:, None] * on_positions[derivative][None]])

    _, _, (aa, ab, bb) = seen_distance(curve, found.cell, found.element, found.other, a, b)
    is_own = jnp.array([1.0, 1.0, 0.0, 0.0], d.dtype)[None, :, None]

    def across(v: Float[Array, "3 p"]) -> Float[Array, "3 p"]:
        return (v - dot(v, normal)[None] * normal) / d[None]

    gap, slopes = along(normal), along(normal, 1)
    by_a = along(across(here.slope)) + slopes * is_own
    by_b = -along(across(there.slope)) + slopes * (1 - is_own)
    # The curvature: of the distance at fixed places, across the normal, less what the places do as they move.
    pushing = jnp.sqrt(jnp.maximum(pressures, 0.0))
    side = _perpendicular(normal)
    weight = (pushing / jnp.sqrt(d))[None, None]
    a_stays, b_stays = found.stays
    # Where the distance is flat along the other part, its place may be the nearest one no longer after its last steps.
    b_stays |= bb <= 0
    safe_bb = jnp.where(b_stays, 1.0, bb)
    coupling = jnp.where(b_stays, 0.0, ab / safe_bb)
    growth = aa - coupling * ab
    a_stays |= growth <= 0
    of_b = jnp.where(b_stays, 0.0, pushing / jnp.sqrt(safe_bb))
    of_a = jnp.where(a_stays, 0.0, pushing / jnp.sqrt(jnp.where(a_stays, 1.0, growth)))
    vectors = jnp.stack(
        [
            gap,
            weight * along(side),
            weight * along(cross(normal, side)),
            of_b[None, None] * by_b,
            of_a[None, None] * (by_a - coupling[None, None] * by_b),
        ]
    )
    vectors = jnp.where(found.exists, vectors, 0.0)
    # Half of both orders in which a tangent t turns under the force v: w (v.t) + v (w.t) less 2 t (w.v).
    force = pressures[None, None] * normal[:, None] * on_tangents[0][None]  # [3, 4, p]
    pulled, leaned = (jnp.einsum("cbkp,ckp->bkp", axes, v) for v in (force, tangents))
    mixed = (pulled[:, None] * leaned[None] + leaned[:, None] * pulled[None]) / 2
    turn = mixed - dot(force, tangents)[None, None] * jnp.einsum("cbkp,cakp->bakp", axes, axes)
    nothing = jnp.zeros((*turn.shape[:2], len(curve.s)), d.dtype)
    return vectors, nodes, nothing.at[:, :, nodes].add(-turn)


@traced_once
def side_at(curve: Curve, element: Int[Array, "k"], s: Float[Array, "k"]) -> Side:
    begin, end = curve.s[element], curve.s[element + 1]
    h = end - begin
    t = (s - begin) / h
    u = 1 - t
    zero = jnp.zeros_like(t)
    of_positions = jnp.stack(
        [jnp.stack([(1 + 2 * t) * u**2, t**2 * (3 - 2 * t)]), jnp.stack([-6 * t * u / h, 6 * t * u / h])]
    )
    of_tangents = jnp.stack(
        [jnp.stack([h * t * u**2, -h * t**2 * u]), jnp.stack([u * (1 - 3 * t), t * (3 * t - 2)]) + zero[None]]
    )
    second_of_positions = jnp.stack([(12 * t - 6) / h**2, (6 - 12 * t) / h**2])
    second_of_tangents = jnp.stack([(6 * t - 4) / h, (6 * t - 2) / h])
    nodes = jnp.stack([element, element + 1])
    positions, tangents = curve.positions.T[:, nodes], curve.tangents[:, nodes]

    def weighted(of_positions: Float[Array, "2 k"], of_tangents: Float[Array, "2 k"]) -> Float[Array, "3 k"]:
        return jnp.sum(positions * of_positions[None] + tangents * of_tangents[None], axis=1)

    return Side(
        weighted(of_positions[0], of_tangents[0]),
        weighted(of_positions[1], of_tangents[1]),
        weighted(second_of_positions, second_of_tangents),
        of_positions,
        of_tangents,
    )


@traced_once
def direction(here: Side, there: Side) -> tuple[Float[Array, "k"], Float[Array, "3 k"]]:
    """The distance of two places, and the direction in which it grows."""
    way = here.x - there.x
    across = cross(here.slope, there.slope)
    size = dot(across, across)
    across = jnp.where(size > CROSSING**2, across, _perpendicular(here.slope))
    across /= jnp.sqrt(dot(across, across))[None]
    is_crossing = dot(way, way) <= CROSSING**2
    way = jnp.where(is_crossing, CROSSING * jax.lax.stop_gradient(across), way)
    distance = jnp.sqrt(dot(way, way))
    return distance, way / distance[None]


@traced_once
def seen_distance(
    curve: Curve,
    cell: Int[Array, "k"],
    element: Int[Array, "k"],
    other: Int[Array, "k"],
    a: Float[Array, "k"],
    b: Float[Array, "k"],
    is_far: Array | None = None,
) -> tuple[Array, tuple[Array, Array], tuple[Array, Array, Array]]:
    """The distance and the well of the cell, and its derivatives by both places; `is_far`: the second ones as of half
    of the squared distance, by the distance.
    """
    here, there = side_at(curve, element, a), side_at(curve, other, b)
    d, normal = direction(here, there)
    h = curve.s[cell + 1] - curve.s[cell]
    aside = a - curve.s[cell] - MIDDLE * h
    well = (narrow_wells(curve) if curve.wells is None else curve.wells)[cell]
    on_here, on_there = dot(normal, here.slope), dot(normal, there.slope)
    across = 1.0 if is_far is None else 1.0 - is_far.astype(d.dtype)
    aa = (dot(here.slope, here.slope) - across * on_here**2) / d + dot(normal, here.curvature) + well
    bb = (dot(there.slope, there.slope) - across * on_there**2) / d - dot(normal, there.curvature)
    ab = -(dot(here.slope, there.slope) - across * on_here * on_there) / d
    return d + well * aside**2 / 2, (on_here + well * aside, -on_there), (aa, ab, bb)


def narrow_wells(curve: Curve, depth: float = NARROW) -> Float[Array, "n"]:
    """Stiffnesses of wells of this depth [radii], half of an element from their middles."""
    return 8 * depth * curve.radius / jnp.diff(curve.s) ** 2


def with_wells(curve: Curve, is_wide: Bool[Array, "*n"], depth: float = NARROW) -> Curve:
    """With wide wells in these cells and narrow ones, of this depth, in the others."""
    wide = jnp.minimum(WIDE / curve.radius, narrow_wells(curve, DEEPEST_WELL))
    return curve._replace(wells=jnp.where(is_wide, wide, narrow_wells(curve, depth)))


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


def _perpendicular(normal: Float[Array, "3 p"]) -> Float[Array, "3 p"]:
    """A unit vector across each."""
    least = jnp.argmin(jnp.abs(jax.lax.stop_gradient(normal)), axis=0)
    axis = (jnp.arange(3)[:, None] == least[None]).astype(normal.dtype)
    side = axis - dot(axis, normal)[None] * normal
    return side / jnp.sqrt(dot(side, side))[None]
