"""Contact of one rod with another: where each element of the first comes nearest to the second.

Both centerlines are one curve (`joined`), in units that both have in common: the nodes of the first rod, then those of
the second, with an element between them that stands for nothing. So the contact points, their gaps and the derivatives
of these are those of a rod with itself (`self_contact`), where elements of the first rod alone have some, with the
second one alone.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.curve_distance import Curve, with_wells
from rodjax.discretization.nearest_places import Nearest, growth, nearest
from rodjax.discretization.self_contact import NOTHING_BEYOND, gap_vectors, moving_gaps, on_elements

# As `curve_distance.NARROW`: of rods that cross, four times that times the radius by the length of an element is the
# force along them by that of the contact, at most.
NARROW_OF_PAIRS = 3e-6
# As `nearest_places.GROWS`, of all contacts. A wide well lets rods lie deeper beside its place by this times an eighth
# of the squared length of an element by the radius [radii], at most.
GROWS_OF_PAIRS = 0.01
# Of the elements of a rod, those nearest to another one may touch it: at most so many.
MOST_OF_PAIR = 32


def joined(first: Curve, second: Curve) -> Curve:
    """The curve of both."""
    # The element between is no longer than others: by the longest one it is known how far apart places are seen.
    offset = first.s[-1] + second.s[1] - second.s[0]
    begin, nothing = offset + second.s[0], jnp.full_like(second.s, jnp.inf)
    least = jnp.concatenate([jnp.full_like(first.s[1:], begin), nothing])
    return Curve(
        jnp.concatenate([first.s, offset + second.s]),
        jnp.concatenate([first.positions, second.positions]),
        jnp.concatenate([first.tangents, second.tangents], axis=1),
        jnp.concatenate([first.axes, second.axes], axis=2),
        jnp.concatenate([first.free, second.free]),
        jnp.concatenate([first.radius, first.radius[:1], second.radius]),
        reach=(least, jnp.full_like(least, offset + second.s[-1]), first.s[-1]),
    )


def with_pair_wells(curve: Curve, is_wide: Bool[Array, "n"]) -> Curve:
    """With wide wells in these cells of the first rod."""
    return with_wells(curve, jnp.pad(is_wide, (0, len(curve.radius) - len(is_wide))), NARROW_OF_PAIRS)


def growth_of_pair(curve: Curve, elements: int) -> Float[Array, "n"]:
    """Of the cells of the first rod, as many as that: they have wide wells below `GROWS_OF_PAIRS` in an equilibrium,
    below `GROWS` as a search begins.
    """
    return growth(curve)[:elements]


class PairContacts(NamedTuple):
    """Of a pair of rods: the gaps of the n elements of the first one; of those p that may touch the second one their
    numbers, the gradients of their gaps with the vectors of their curvature (`linalg.far_rows`), by rotations and
    positions of four nodes, and these, two of each rod.
    """

    gaps: Float[Array, "n"]
    chosen: Int[Array, "p"]
    vectors: Float[Array, "5 b+3 4 p"]
    nodes: Int[Array, "4 p"]


def found_between(curve: Curve, elements: int) -> Nearest:
    """Of the elements of the first rod, as many as that."""
    return Nearest(*(leaf[..., :elements] for leaf in nearest(curve)))


def gaps_between(curve: Curve, found: Nearest) -> Float[Array, "n"]:
    return jnp.where(found.exists, moving_gaps(curve, found)[0], NOTHING_BEYOND)


def pair_contacts(curve: Curve, found: Nearest, pressures: Float[Array, "n"]) -> PairContacts:
    elements = len(pressures)
    gaps = gaps_between(curve, found)
    # Those that push go on doing so.
    chosen = jnp.argsort(jnp.where(pressures > 0, -1.0, gaps))[: min(elements, MOST_OF_PAIR)]
    vectors, nodes, _ = gap_vectors(curve, Nearest(*(leaf[..., chosen] for leaf in found)), pressures[chosen])
    nodes -= jnp.array([0, 0, elements + 1, elements + 1])[:, None]
    return PairContacts(gaps, chosen, vectors, nodes)


def loads_between(
    curve: Curve, found: Nearest, pressures: Float[Array, "n"]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """What pressures apply to each of both rods, as `self_contact.on_elements`."""
    elements = len(pressures)
    on_positions, on_tangents = on_elements(curve, jnp.pad(pressures, (0, 1)), found)
    first, second = slice(0, elements), slice(elements + 1, None)
    return (on_positions[..., first], on_tangents[..., first]), (on_positions[..., second], on_tangents[..., second])
