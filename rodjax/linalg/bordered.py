"""A system along the rod with a few unknowns more, each with a row and a column that may be full.

    [ M    P ] [v]   [b]
    [ Q^T  D ] [z] = [g]

M is a `SaddlePointSystem` or a `ChainSystem`, v = (x, y) its unknowns. By the Schur complement S = D - Q^T M^-1 P the
matrix has the negative eigenvalues of M and those of S, where P = Q (Haynsworth 1968). P and Q may differ; counted are
then those of the symmetric part of S. All unknowns but x come as one vector, z before y.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Where solutions go down, a larger unknown of the border leads away from a maximum.
LEAST_DESCENT = 1e-7


class Vectors(NamedTuple):
    """j vectors of the unknowns (x, y), or of the right sides, of M."""

    x: Float[Array, "j b m"]
    y: Float[Array, "j k"]

    def times(self, z: Float[Array, "j"]) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        return jnp.tensordot(z, self.x, 1), jnp.tensordot(z, self.y, 1)

    def dots(self, x: Float[Array, "b m"], y: Float[Array, "k"]) -> Float[Array, "j"]:
        return jnp.sum(self.x * x[None], axis=(1, 2)) + jnp.sum(self.y * y[None], axis=1)


class BorderedSystem(eqx.Module):
    """The matrix above: `inner` is M, `columns` and `rows` are P and Q, `corner[i, l]` is row i, column l of D.

    `descends`: solutions go down where S is not positive, as if the eigenvalues of its symmetric part were.
    """

    inner: Any
    columns: Vectors
    rows: Vectors
    corner: Float[Array, "j j"]
    descends: bool = eqx.field(static=True, default=False)

    @property
    def diagonal(self) -> Float[Array, "b b m"]:
        return self.inner.diagonal

    @property
    def transposed(self) -> "BorderedSystem":
        """M is symmetric."""
        return dataclasses.replace(self, columns=self.rows, rows=self.columns, corner=self.corner.T)

    def split(self, y: Float[Array, "j+k"]) -> tuple[Float[Array, "j"], Float[Array, "k"]]:
        return y[: len(self.corner)], y[len(self.corner) :]

    def times(self, x: Float[Array, "b m"], y: Float[Array, "j+k"]) -> tuple[Float[Array, "b m"], Float[Array, "j+k"]]:
        z, y = self.split(y)
        f, c = self.inner.times(x, y)
        of_x, of_y = self.columns.times(z)
        return f + of_x, jnp.concatenate([self.rows.dots(x, y) + self.corner @ z, c + of_y])

    def shifted(self, shift: Float[Array, ""] | Float[Array, "m"]) -> "BorderedSystem":
        """With the inertia of all of the rod, if that is the shift, for each unknown of the border."""
        total = jnp.sum(jnp.broadcast_to(shift, self.diagonal.shape[-1:]))
        corner = self.corner + total * jnp.eye(len(self.corner), dtype=total.dtype)
        return dataclasses.replace(self, inner=self.inner.shifted(shift), corner=corner)

    def held_unless(self, is_free: Bool[Array, ""]) -> "BorderedSystem":
        """With the unknowns of the border kept as they are, unless they are free."""
        rows = Vectors(*(jnp.where(is_free, part, 0.0) for part in self.rows))
        identity = jnp.eye(len(self.corner), dtype=self.corner.dtype)
        return dataclasses.replace(self, rows=rows, corner=jnp.where(is_free, self.corner, identity))

    def factored(self, inner: Any, by_columns: Vectors) -> "BorderedFactors":
        """From the factors of M, and M^-1 P."""
        j = len(self.corner)
        reached = jnp.stack([self.rows.dots(by_columns.x[column], by_columns.y[column]) for column in range(j)], axis=1)
        return BorderedFactors(inner, self.rows, by_columns, self.corner - reached, self.descends)


class BorderedFactors(eqx.Module):
    """The factorisation: of M, M^-1 P and S."""

    inner: Any
    rows: Vectors
    by_columns: Vectors
    complement: Float[Array, "j j"]
    descends: bool = eqx.field(static=True)

    @property
    def below(self) -> Int[Array, ""]:
        """The negative eigenvalues of S."""
        values = self.symmetric[0] if len(self.complement) == 1 else jnp.linalg.eigvalsh(self.symmetric)
        return jnp.sum(values < 0)

    @property
    def below_by_pivots(self) -> Int[Array, ""]:
        """The same from the signs of the pivots of S: this changes where S is singular, also without symmetry."""
        matrix, below = self.complement, jnp.zeros((), int)
        for k in range(len(matrix)):
            pivot = matrix[k, k]
            below += (pivot < 0).astype(int)
            matrix = matrix - matrix[:, k, None] * matrix[None, k] / pivot
        return below

    @property
    def symmetric(self) -> Float[Array, "j j"]:
        """The symmetric part of S."""
        return (self.complement + self.complement.T) / 2

    @property
    def negative(self) -> Int[Array, ""]:
        return self.inner.negative + self.below

    @property
    def is_minimum(self) -> Bool[Array, ""]:
        return self.inner.is_minimum & self.is_steady

    @property
    def is_steady(self) -> Bool[Array, ""]:
        """Whether S is positive."""
        return (self.below == 0) & jnp.all(jnp.isfinite(self.complement))

    def goes_down(self, z: Float[Array, "j"]) -> Bool[Array, ""]:
        """Whether a step with these unknowns of the border goes down: S is positive, or the step leads away from a
        maximum, for which no shift is needed.
        """
        return self.is_steady | (jnp.max(jnp.abs(z)) > LEAST_DESCENT) if self.descends else self.is_steady

    def solve(self, f: Float[Array, "b m"], c: Float[Array, "j+k"]) -> tuple[Float[Array, "b m"], Float[Array, "j+k"]]:
        j = len(self.complement)
        x, y = self.inner.solve(f, c[j:])
        return self.joined(x, y, c[:j])

    def joined(
        self, x: Float[Array, "b m"], y: Float[Array, "k"], g: Float[Array, "j"]
    ) -> tuple[Float[Array, "b m"], Float[Array, "j+k"]]:
        """The solution, from that of M alone."""
        missing, complement = g - self.rows.dots(x, y), self.complement
        if self.descends and len(missing) == 1:
            complement = jnp.abs(complement)
        elif self.descends:
            values, vectors = jnp.linalg.eigh(self.symmetric)
            complement = jnp.where(jnp.min(values) < 0, (vectors * jnp.abs(values)[None]) @ vectors.T, complement)
        z = missing / complement[0] if len(missing) == 1 else jnp.linalg.solve(complement, missing)
        of_x, of_y = self.by_columns.times(z)
        return x - of_x, jnp.concatenate([z, y - of_y])
