"""The segment vectors of a rod that is curved at rest, minus the quadrature of its frames' tangents.

The quadrature misses a part of the segment vector of a curved cell, and nothing of that of a straight one. At rest the
correction has to be exact, so that there is no stress on any mesh. Where supports hold the rod straight it has to
vanish, so that the tension is exact however stiff the rod is. What is missing along the tangent is therefore weighted
by

    g = |k|^2/(|k|^2 + |k - k0|^2)

of the curvature k and that at rest k0 at each strain point, which is 1 at rest, 0 where the rod is straight, level at
both, and lies between otherwise, so that the order of the quadrature stays. It lengthens the segment along the tangent
of the point, so that all of it is a function of strains and tension there. What is missing across the tangent turns
with the cell: it is of higher order, and without a share in the tension.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import Cells
from rodjax.geometry.rotations import inverse, rotated, tangent
from rodjax.geometry.vectors import dot

# Squared curvature [1/L^2] far below any that bends a rod, so that g is a number where there is none.
LEAST = 1e-20


class RestCorrection(NamedTuple):
    """`turning`: what turns with the reference frames of the cells, in their axes; `along`: what counts by g along the
    tangents at the strain points, `None` where there is no such.
    """

    turning: Float[Array, "3 n"]
    along: Float[Array, "p n"] | None

    @staticmethod
    def of(
        cells: Cells,
        frames: Float[Array, "4 m"],
        strains: Float[Array, "3 p n"],
        edges: Float[Array, "3 segments"],
        middles: Float[Array, "4 segments"],
        rest_axial: Float[Array, "p n"] | None,
    ) -> "RestCorrection":
        """Of a rod at rest with these frames and strains; `edges`: from node to node; `middles`: frames half way."""
        own_lengths = cells.lengths if rest_axial is None else cells.lengths * (1 + rest_axial)
        tangents, axes = tangent(cells.gather(frames)), tangent(middles)

        def segment_vectors(lengths: Float[Array, "p n"]) -> Float[Array, "3 segments"]:
            by_point = lengths[None] * tangents
            return cells.segment_vectors(by_point, jnp.zeros_like(by_point[:, 0]))

        missing = edges - segment_vectors(own_lengths)
        lacking = dot(missing, axes)
        # Divided by the squared curvatures, each by as much of its tangent as lies along that of the middle.
        squares = cells.lengths * dot(strains[:2], strains[:2])
        reach = dot(segment_vectors(squares), axes)
        # Where the curvature has a kink, a segment may lack more than the curvature at its points explains.
        is_bent = jnp.abs(lacking) < reach * jnp.diff(cells.s) ** 2
        along = squares * cells.of_segments(jnp.where(is_bent, lacking / jnp.where(is_bent, reach, 1.0), 0.0))
        return RestCorrection(cells.rest_of(rotated(inverse(middles), missing - segment_vectors(along))), along)


def part(beyond: Float[Array, "2 p n"], at_rest: Float[Array, "2 p n"]) -> Float[Array, "p n"]:
    """g, of curvatures by what they exceed those at rest by."""
    bent = beyond + at_rest
    square = dot(bent, bent) + LEAST
    return square / (square + dot(beyond, beyond))
