"""The three pairs of points of an element, whose chords shape it: derivatives by the rotations of the points."""

import functools
from collections.abc import Iterable

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.element_points import of_elements
from rodjax.discretization.joints import outer
from rodjax.discretization.tangent_field import Blocks
from rodjax.geometry.vectors import components, dot
from rodjax.linalg.blocks import short_sum

# The pairs of points whose chords shape an element, and the weights of their arcs in its twist: of the areas that
# polygons of half and whole elements enclose, Richardson's extrapolation.
PAIRS = ((0, 1), (1, 2), (0, 2))
ARC_WEIGHTS = (4 / 3, 4 / 3, -1 / 3)


def of_pairs(by_point: Float[Array, "... m"]) -> tuple[Float[Array, "... 3 n"], Float[Array, "... 3 n"]]:
    """What belongs to the first and to the last point of each pair."""
    parts = of_elements(by_point)
    first, last = zip(*PAIRS, strict=True)
    return jnp.stack([parts[i] for i in first], axis=-2), jnp.stack([parts[j] for j in last], axis=-2)


def flat(by_pair: Float[Array, "... 3 n"]) -> Float[Array, "... 3n"]:
    return by_pair.reshape(*by_pair.shape[:-2], -1)


def by_points(
    first: Float[Array, "... 3 n"], last: Float[Array, "... 3 n"]
) -> tuple[Float[Array, "... n"], Float[Array, "... n"], Float[Array, "... n"]]:
    """At start, middle and end of the elements, sums of what the pairs give to their first and last points."""
    ab, bc, ac = range(3)
    return (
        first[..., ab, :] + first[..., ac, :],
        last[..., ab, :] + first[..., bc, :],
        last[..., bc, :] + last[..., ac, :],
    )


def added(terms: Iterable[Array]) -> Array:
    return functools.reduce(jnp.add, terms)


def blocks_of_pairs(gradient: tuple[Array, Array, Array], diagonal: tuple[Array, Array, Array], below: Array) -> Blocks:
    """Of start, middle and end of the elements. `below`: by the last point of each pair, then by its first."""
    return Blocks(
        gradient=jnp.stack(gradient, axis=-2),
        diagonal=jnp.stack(diagonal, axis=-2),
        lower=jnp.stack([below[..., 0, :], below[..., 1, :]], axis=-1).reshape(*below.shape[:2], -1),
        across=below[..., 2, :],
    )


def half_squared_chords(tangents: Float[Array, "3 m"]) -> Float[Array, "3 n"]:
    """1 - cos of the angles between the points of each pair, without cancellation."""
    first, last = of_pairs(tangents)
    return dot(last - first, last - first) / 2


def by_rotations(
    first: Float[Array, "3 n"], second: list[list[Float[Array, "n"]]], tangents: Float[Array, "3 m"], bases: Array
) -> Blocks:
    """Derivatives by rotations from those by the three chords of each element."""
    points, point_bases = of_pairs(tangents), of_pairs(bases)
    # 1 - a.b falls by e.b as a turns along e, and grows again by a.b. e.b = e.(b - a) without cancellation, as e.a = 0.
    chords = points[1] - points[0]
    toward_last = components(point_bases[0], chords)
    toward_first = components(point_bases[1], -chords)
    falls: list[dict[int, Array]] = [{}, {}, {}]
    for p, (i, j) in enumerate(PAIRS):
        falls[i][p], falls[j][p] = toward_last[:, p], toward_first[:, p]
    bent = [[added(second[p][q][None] * fall for p, fall in falls[i].items()) for q in range(3)] for i in range(3)]

    def block(i: int, j: int) -> Float[Array, "b b n"]:
        return added(outer(bent[i][q], fall) for q, fall in falls[j].items())

    cosines = first * dot(*points)
    at_points = by_points(cosines, cosines)
    between = first[None, None] * short_sum(point_bases[1][:, :, None] * point_bases[0][:, None], axis=0)
    identity = jnp.eye(bases.shape[1], dtype=bases.dtype)[..., None]

    def on_diagonal(i: int) -> Float[Array, "b b n"]:
        return block(i, i) + at_points[i][None, None] * identity

    return blocks_of_pairs(
        gradient=by_points(-first[None] * toward_last, -first[None] * toward_first),
        diagonal=(on_diagonal(0), on_diagonal(1), on_diagonal(2)),
        below=jnp.stack([block(j, i) for i, j in PAIRS], axis=2) - between,
    )
