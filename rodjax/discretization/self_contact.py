"""Contact of a rod with itself: where each element comes nearest to the rod beyond it (`nearest_places`).

The centerline is the cubic through the positions and tangents of the nodes. Each element has a cell, from its first
node to the middle of the next element. Its contact point is that place s in the cell, and that place s' further along
the rod, where

    g = |x(s) - x(s')| + k (s - s_3/4)^2/2 - r(s) - r(s')

is least; the gap g is a function of the four nodes beside these places. The second term, the well of the cell, keeps
the place at three quarters of the element where two parts of the rod lie along one another, as without it the place
would be undetermined. Where the place leaves a cell the next one has it already, with a smaller gap: there, at one
quarter of an element, where the rod counts as thinnest, two cells may share one contact. At a node, where the curvature
jumps, none does.

First derivatives of g are those at fixed places; the second ones count that the places move.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.discretization.curve_distance import Curve, direction, perpendicular, seen_distance, sides_at
from rodjax.discretization.nearest_places import Nearest, nearest
from rodjax.geometry.vectors import cross, dot
from rodjax.linalg.far_rows import FarRows
from rodjax.programs.parts import traced_once

# Of the elements, those nearest to the rod beyond them may touch it: at most so many.
MOST_CONTACTS = 48
# Gap of an element with nothing beyond it [L].
NOTHING_BEYOND = 1.0


class SelfContacts(NamedTuple):
    """Gaps of the elements, a last number that stands for nothing; their rows; second derivatives of what L has of them
    by the rotations of each node alone.
    """

    gaps: Float[Array, "n+1"]
    rows: FarRows
    by_rotations: Float[Array, "b b n+1"]


class Exerted(NamedTuple):
    """Of each element: the places s and s' where it is nearest to the rod beyond it, the gap, infinite where there is
    nothing beyond, and the force there on the rod at s.
    """

    s: Float[Array, "n"]
    beyond: Float[Array, "n"]
    gaps: Float[Array, "n"]
    forces: Float[Array, "3 n"]


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


def exerted(curve: Curve, pressures: Float[Array, "n+1"]) -> Exerted:
    return exerted_at(curve, pressures, nearest(curve))


def exerted_at(curve: Curve, pressures: Float[Array, "n+1"], found: Nearest) -> Exerted:
    gaps, a, b = moving_gaps(curve, found)
    _, normal = direction(sides_at(curve, found.element, found.other, a, b))
    forces = jnp.where(found.exists, pressures[:-1], 0.0)[None] * normal
    return Exerted(a, b, jnp.where(found.exists, gaps, jnp.inf), forces)


def on_elements(curve: Curve, pressures: Float[Array, "n+1"], found: Nearest | None = None) -> tuple[Array, Array]:
    """What pressures apply to the nodes at start and end of each element, and to their tangents, (3, 2, n) both.
    `found`: the nearest places, if they are known.
    """
    found = nearest(curve) if found is None else found
    a, b, _, forces = exerted_at(curve, pressures, found)
    sides, elements = sides_at(curve, found.element, found.other, a, b), jnp.stack([found.element, found.other])
    forces = (forces[:, None] * np.array([1.0, -1.0], forces.dtype)[None, :, None])[:, None]  # [3, 1, side, k]
    nothing = jnp.zeros((3, 2, len(curve.s) - 1), forces.dtype)
    on_positions, on_tangents = (
        nothing.at[..., elements].add(forces * weights[0][None]) for weights in (sides.of_positions, sides.of_tangents)
    )
    return on_positions, on_tangents


@traced_once
def moving_gaps(curve: Curve, found: Nearest) -> tuple[Float[Array, "k"], Float[Array, "k"], Float[Array, "k"]]:
    """And the places, as they move with the curve: by two steps of Newton's method, which have the first three
    derivatives.
    """
    a_stays, b_stays = found.stays

    def stepped(places: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        a, b = places
        distance, (of_a, of_b), (aa, ab, bb) = seen_distance(curve, found.cell, found.element, found.other, a, b)
        of_a, of_b = jnp.where(a_stays, 0.0, of_a), jnp.where(b_stays, 0.0, of_b)
        aa, bb = jnp.where(a_stays, 1.0, aa), jnp.where(b_stays, 1.0, bb)
        ab = jnp.where(a_stays | b_stays, 0.0, ab)
        determinant = aa * bb - ab**2
        there = a - (bb * of_a - ab * of_b) / determinant, b - (aa * of_b - ab * of_a) / determinant
        return there, (distance, a, b)

    # A loop, which is a third of what is written out: the last turn is for the distance.
    _, each = jax.lax.scan(stepped, (found.s, found.beyond), length=3)
    distance, a, b = (leaf[-1] for leaf in each)
    return distance - curve.radius[found.cell] - curve.radius[found.other], a, b


@traced_once
def gap_vectors(
    curve: Curve, found: Nearest, pressures: Float[Array, "p"]
) -> tuple[Float[Array, "5 b+3 4 p"], Int[Array, "4 p"], Float[Array, "b b n+1"]]:
    """The gradient of each gap and the vectors of its curvature, by the rotations and positions of its nodes; these;
    and what of the curvature is by the rotations of one node.
    """
    _, a, b = moving_gaps(curve, found)
    sides = sides_at(curve, found.element, found.other, a, b)
    slope, other_slope = jnp.unstack(sides.slope, axis=1)
    nodes = jnp.stack([found.element, found.element + 1, found.other, found.other + 1])
    d, normal = direction(sides)
    tangents, axes = curve.tangents[:, nodes], curve.axes[:, :, nodes]  # [3, 4, p], [3, b, 4, p]
    turned = cross(axes, jnp.broadcast_to(tangents[:, None], axes.shape))
    signs = jnp.array([1.0, 1.0, -1.0, -1.0], d.dtype)[:, None]
    is_free = signs * curve.free[nodes]
    # [derivative, node, p], the nodes of one side after those of the other.
    on_positions, on_tangents = (
        jnp.swapaxes(of_sides, 1, 2).reshape(2, 4, -1) for of_sides in (sides.of_positions, sides.of_tangents)
    )
    on_positions, on_tangents = on_positions * is_free[None], on_tangents * signs[None]

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
    by_a = along(across(slope)) + slopes * is_own
    by_b = -along(across(other_slope)) + slopes * (1 - is_own)
    # The curvature: of the distance at fixed places, across the normal, less what the places do as they move.
    pushing = jnp.sqrt(jnp.maximum(pressures, 0.0))
    side = perpendicular(normal)
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
