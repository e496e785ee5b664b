"""The distance between two places of a rod's centerline, with the well of a cell.

The centerline is the cubic through the positions and tangents of the nodes. What wells are for is told by
`self_contact`, which of them are wide by `nearest_places`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.geometry.vectors import cross, dot
from rodjax.linalg.blocks import short_sum
from rodjax.programs.parts import traced_once

# NARROW: by how much the gap of a narrow well grows half of an element from its middle [radii]. WIDE: stiffness k of a
# wide well [1/radius], whose gap grows there by DEEPEST_WELL at most [radii].
NARROW = 3e-4
WIDE = 0.2
DEEPEST_WELL = 0.1
# The middle of a well, as part of its element.
MIDDLE = 0.75
# Where two parts of the rod cross within this distance [L], they part at right angles to both.
CROSSING = 1e-9
# The cubic of an element from its first node, and its first two derivatives, by the powers 0 to 3 of the part of the
# element: the weights of the way to the second node, and of both tangents times the length.
CUBIC = np.array(
    [
        [[0, 0, 3, -2], [0, 1, -2, 1], [0, 0, -1, 1]],
        [[0, 6, -6, 0], [1, -4, 3, 0], [0, -2, 3, 0]],
        [[6, -12, 0, 0], [-4, 6, 0, 0], [-2, 6, 0, 0]],
    ]
)


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


class Side(NamedTuple):
    """Places of the curve: position, its first two derivatives by arclength, and the weights in the position and the
    first derivative of both nodes' positions and tangents.
    """

    x: Float[Array, "3 *k"]
    slope: Float[Array, "3 *k"]
    curvature: Float[Array, "3 *k"]
    of_positions: Float[Array, "2 2 *k"]  # [derivative, node]
    of_tangents: Float[Array, "2 2 *k"]


@traced_once
def side_at(curve: Curve, element: Int[Array, "*k"], s: Float[Array, "*k"]) -> Side:
    begin, first = curve.s[element], curve.positions.T[:, element]
    h = curve.s[element + 1] - begin
    t = (s - begin) / h
    weights = jnp.tensordot(CUBIC.astype(t.dtype), jnp.stack([jnp.ones_like(t), t, t**2, t**3]), 1, precision="highest")
    # By arclength; the tangents are derivatives by it.
    inverse = 1 / h[None]
    weights = jnp.stack([weights[0], weights[1] * inverse, weights[2] * inverse**2])
    of_second, of_tangents = weights[:, 0], weights[:, 1:] * h[None, None]
    way = curve.positions.T[:, element + 1] - first
    tangents = curve.tangents[:, jnp.stack([element, element + 1])]
    points = way[:, None] * of_second[None] + short_sum(tangents[:, None] * of_tangents[None], axis=2)
    x, slope, curvature = jnp.unstack(points, axis=1)
    from_first = jnp.stack([1 - of_second[0], -of_second[1]])
    return Side(x + first, slope, curvature, jnp.stack([from_first, of_second[:2]], axis=1), of_tangents[:2])


def sides_at(
    curve: Curve, element: Int[Array, "k"], other: Int[Array, "k"], a: Float[Array, "k"], b: Float[Array, "k"]
) -> Side:
    """Both places, in an element and in another one, along the last axis but one."""
    return side_at(curve, jnp.stack([element, other]), jnp.stack([a, b]))


@traced_once
def direction(sides: Side) -> tuple[Float[Array, "k"], Float[Array, "3 k"]]:
    """The distance of two places, and the direction in which it grows."""
    here, there = jnp.unstack(sides.x, axis=1)
    way = here - there
    slope, other_slope = jnp.unstack(jax.lax.stop_gradient(sides.slope), axis=1)
    across = cross(slope, other_slope)
    size = dot(across, across)
    across = jnp.where(size > CROSSING**2, across, perpendicular(slope))
    across /= jnp.sqrt(dot(across, across))[None]
    way = jnp.where(dot(way, way) <= CROSSING**2, CROSSING * across, way)
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
    sides = sides_at(curve, element, other, a, b)
    d, normal = direction(sides)
    h = curve.s[cell + 1] - curve.s[cell]
    aside = a - curve.s[cell] - MIDDLE * h
    well = (narrow_wells(curve) if curve.wells is None else curve.wells)[cell]
    along = dot(jnp.broadcast_to(normal[:, None], sides.slope.shape), sides.slope)
    bent = dot(jnp.broadcast_to(normal[:, None], sides.slope.shape), sides.curvature)
    across = 1.0 if is_far is None else 1.0 - is_far.astype(d.dtype)
    squares = (dot(sides.slope, sides.slope) - across * along**2) / d[None]
    on_here, on_there = jnp.unstack(along)
    slope, other_slope = jnp.unstack(sides.slope, axis=1)
    aa, bb = squares[0] + bent[0] + well, squares[1] - bent[1]
    ab = -(dot(slope, other_slope) - across * on_here * on_there) / d
    return d + well * aside**2 / 2, (on_here + well * aside, -on_there), (aa, ab, bb)


def narrow_wells(curve: Curve, depth: float = NARROW) -> Float[Array, "n"]:
    """Stiffnesses of wells of this depth [radii], half of an element from their middles."""
    return 8 * depth * curve.radius / jnp.diff(curve.s) ** 2


def with_wells(curve: Curve, is_wide: Bool[Array, "*n"], depth: float = NARROW) -> Curve:
    """With wide wells in these cells and narrow ones, of this depth, in the others."""
    wide = jnp.minimum(WIDE / curve.radius, narrow_wells(curve, DEEPEST_WELL))
    return curve._replace(wells=jnp.where(is_wide, wide, narrow_wells(curve, depth)))


def perpendicular(normal: Float[Array, "3 p"]) -> Float[Array, "3 p"]:
    """A unit vector across each."""
    least = jnp.argmin(jnp.abs(jax.lax.stop_gradient(normal)), axis=0)
    axis = (jnp.arange(3)[:, None] == least[None]).astype(normal.dtype)
    side = axis - dot(axis, normal)[None] * normal
    return side / jnp.sqrt(dot(side, side))[None]
