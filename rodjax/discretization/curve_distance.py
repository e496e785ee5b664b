"""The distance between two places of a rod's centerline, with the well of a cell.

The centerline is the cubic through the positions and tangents of the nodes. What wells are for is told by
`self_contact`, which of them are wide by `nearest_places`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.geometry.vectors import cross, dot
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
    """A place of the curve: position, its first two derivatives by arclength, and the weights in the position and the
    first derivative of both nodes' positions and tangents.
    """

    x: Float[Array, "3 k"]
    slope: Float[Array, "3 k"]
    curvature: Float[Array, "3 k"]
    of_positions: Float[Array, "2 2 k"]  # [derivative, node]
    of_tangents: Float[Array, "2 2 k"]


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
    across = jnp.where(size > CROSSING**2, across, perpendicular(here.slope))
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


def perpendicular(normal: Float[Array, "3 p"]) -> Float[Array, "3 p"]:
    """A unit vector across each."""
    least = jnp.argmin(jnp.abs(jax.lax.stop_gradient(normal)), axis=0)
    axis = (jnp.arange(3)[:, None] == least[None]).astype(normal.dtype)
    side = axis - dot(axis, normal)[None] * normal
    return side / jnp.sqrt(dot(side, side))[None]
