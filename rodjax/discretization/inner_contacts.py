"""Contact points in the middle of elements, as functions of the positions and tangents of both nodes.

With e = a - c the difference of the tangents at start and end of an element of length h, the point is

    x = (x_start + x_end)/2 + h/8 (1 + |e|^2/48) e

that of the cubic through both nodes, and on circles of sixth order. A force p n there is virtual work on both nodes:
half of it on each, and couples.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.geometry.vectors import cross, dot

# Of the cubic's part of x that depends on e, e^2 of this more; and twice of it in its derivative.
ON_CIRCLES = 1 / 48


class Middles(NamedTuple):
    """The points in the middle of n elements, their first derivatives by what moves the nodes: b rotations about `axes`
    and the place of the first, then of the second node; and what second derivatives are made of.
    """

    points: Float[Array, "n 3"]
    rates: Float[Array, "3 2 b+3 n"]
    bulge: Float[Array, "3 n"]  # h/8 e
    turned: Float[Array, "3 2 b n"]  # by which e changes
    by_difference: Float[Array, "3 3 n"]  # dx/de
    ends: Float[Array, "3 2 n"]
    axes: Float[Array, "3 2 b n"]

    @staticmethod
    def of(
        positions: Float[Array, "n+1 3"],
        tangents: Float[Array, "3 n+1"],
        axes: Float[Array, "3 b n+1"],
        held: Float[Array, "n+1"],
        h: Float[Array, "n"],
    ) -> "Middles":
        """`held`: 0 at nodes whose place is given, else 1."""
        ends = jnp.stack([tangents[:, :-1], tangents[:, 1:]], axis=1)
        about = jnp.stack([axes[..., :-1], axes[..., 1:]], axis=1)
        difference = ends[:, 0] - ends[:, 1]
        squared = dot(difference, difference)
        bulge = h[None] / 8 * difference
        identity = jnp.eye(3, dtype=h.dtype)[..., None]
        factor = 1 + ON_CIRCLES * squared
        by_difference = (h / 8 * factor)[None, None] * identity
        by_difference += 2 * ON_CIRCLES * bulge[:, None] * difference[None]
        turned = cross(about, jnp.broadcast_to(ends[:, :, None], about.shape))
        turned = turned * jnp.array([1.0, -1.0], h.dtype)[None, :, None, None]
        by_rotation = jnp.einsum("cdn,debn->cebn", by_difference, turned)
        by_position = jnp.stack([held[:-1], held[1:]])[None, :, None] * identity[:, None] / 2
        points = (positions[:-1] + positions[1:]) / 2 + (factor[None] * bulge).T
        rates = jnp.concatenate([by_rotation, by_position], axis=2)
        return Middles(points, rates, bulge, turned, by_difference, ends, about)

    def second(self, forces: Float[Array, "3 n"]) -> Float[Array, "2b+6 2b+6 n"]:
        """The second derivatives of forces . x."""
        b, n = self.turned.shape[2:]
        along = dot(forces, self.bulge)[None, None] * jnp.eye(3, dtype=forces.dtype)[..., None]
        curving = forces[:, None] * self.bulge[None] + self.bulge[:, None] * forces[None] + along
        both = 2 * ON_CIRCLES * jnp.einsum("cebn,cdn,dfan->ebfan", self.turned, curving, self.turned)
        on_tangents = jnp.einsum("cn,cdn->dn", forces, self.by_difference)
        total = jnp.zeros((2, b + 3, 2, b + 3, n), forces.dtype).at[:, :b, :, :b].set(both)
        for k, sign in ((0, 1), (1, -1)):
            # Half of both orders in which a tangent t turns: w (v.t) + v (w.t) less 2 t (w.v).
            axes, tangent = self.axes[:, k], self.ends[:, k]
            pulled = jnp.einsum("cbn,cn->bn", axes, on_tangents)
            leaned = jnp.einsum("cbn,cn->bn", axes, tangent)
            mixed = (pulled[:, None] * leaned[None] + leaned[:, None] * pulled[None]) / 2
            turn = mixed - dot(on_tangents, tangent)[None, None] * jnp.einsum("cbn,can->ban", axes, axes)
            total = total.at[k, :b, k, :b].add(sign * turn)
        return total.reshape(2 * (b + 3), 2 * (b + 3), n)
