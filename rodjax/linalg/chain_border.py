"""What all of a chain has in common: the border of its system, then the columns of contacts between elements.

Of these most are numbers by themselves, as they are open: a column is solved for where it is needed (`by_need`).
"""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.far_rows import FarRows, compliances_of
from rodjax.linalg.small_matrices import inverse_matrix
from rodjax.programs.parts import traced_once

# A border is solved with the first so many contacts, or with all.
FEW = (0, 8)
T = TypeVar("T")
# Columns by rotations, by positions, and what is solved for them.
Columns = tuple[Float[Array, "b k m"], Float[Array, "k n+1 3"], Float[Array, "k n 3"]]


class Border(eqx.Module):
    """`by_rotation`, `compliance`: of the border of the system. `far`: contacts between elements, first those that are
    needed, `None` without such; `is_closed`, `contact_compliance`: of these.
    """

    by_rotation: Float[Array, "b k m"]
    compliance: Float[Array, "k k"]
    far: FarRows | None = None
    is_closed: Bool[Array, "p"] | None = None
    contact_compliance: Float[Array, ""] | None = None

    @property
    def size(self) -> int:
        return len(self.compliance) + (0 if self.far is None else 5 * len(self.far.elements))

    @property
    def positive(self) -> int:
        """The number of the columns whose compliance is positive."""
        return len(self.compliance) + (0 if self.far is None else self.far.positive)

    @traced_once
    def times(self, x: Float[Array, "b r m"], u: Float[Array, "r n+1 3"]) -> Float[Array, "k r"]:
        """Transposed, times columns."""
        product = jnp.einsum("ikm,irm->kr", self.by_rotation, x)
        if self.far is None:
            return product
        return jnp.concatenate([product, self.far.times(self._factors, x, u)])

    def whole_compliance(self) -> Float[Array, "k k"]:
        if self.far is None:
            return self.compliance
        assert self.is_closed is not None
        assert self.contact_compliance is not None
        k = len(self.compliance)
        # An open contact is a number by itself.
        compliances = compliances_of(jnp.where(self.is_closed, self.contact_compliance, 1.0))
        whole = jnp.zeros((self.size, self.size), compliances.dtype)
        return whole.at[:k, :k].set(self.compliance).at[k:, k:].set(jnp.diag(compliances))

    def columns(self) -> Columns:
        """All, each as a right side."""
        points = self.by_rotation.shape[-1]
        nodes, dtype = (points + 1) // 2, self.by_rotation.dtype
        by_rotation, by_position = self.by_rotation, jnp.zeros((len(self.compliance), nodes, 3), dtype)
        if self.far is not None:
            of_far = self.far.columns(self._factors, points)
            by_rotation = jnp.concatenate([by_rotation, of_far[0]], axis=1)
            by_position = jnp.concatenate([by_position, of_far[1]])
        return by_rotation, by_position, jnp.zeros((len(by_position), nodes - 1, 3), dtype)

    def by_need(
        self, solved: Callable[["Border"], tuple[Columns, Float[Array, "k k"], Int[Array, ""]]]
    ) -> tuple[Columns, Float[Array, "k k"], Int[Array, ""]]:
        """Solutions, matrix of the border and a count, of the border with the contacts that are needed."""

        def spread(part: "Border") -> tuple[Columns, Float[Array, "k k"], Int[Array, ""]]:
            (x, u, force), matrix, count = solved(part)
            others = self.size - part.size
            x = jnp.pad(x, ((0, 0), (0, others), (0, 0)))
            u, force = (jnp.pad(columns, ((0, others), (0, 0), (0, 0))) for columns in (u, force))
            matrix = (-self.whole_compliance()).at[: part.size, : part.size].set(matrix)
            return (x, u, force), matrix, count

        return self._by_need(solved, spread)

    def inverse(self, matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
        """Of a matrix as `by_need` has it."""

        def spread(part: "Border") -> Float[Array, "k k"]:
            alone, first = jnp.diag(1 / jnp.diagonal(matrix)), slice(part.size)
            return alone.at[first, first].set(inverse_matrix(matrix[first, first]))

        return self._by_need(lambda part: inverse_matrix(matrix), spread)

    def _by_need(self, whole: Callable[["Border"], T], spread: Callable[["Border"], T]) -> T:
        if self.far is None:
            return whole(self)
        few = [count for count in FEW if count < len(self.far.elements)]
        branches: list[Callable] = [lambda count=count: spread(self._with_first(count)) for count in few]
        assert self.is_closed is not None
        needed = jnp.sum(self.far.are_needed(self.is_closed))
        level = _largest_of_all(jnp.sum(needed > np.array(few))) if few else 0
        return jax.lax.switch(level, [*branches, lambda: whole(self)])

    def _with_first(self, count: int) -> "Border":
        assert self.far is not None
        assert self.is_closed is not None
        return dataclasses.replace(self, far=self.far.first(count), is_closed=self.is_closed[:count])

    @property
    def _factors(self) -> Float[Array, "5 p"]:
        """Of each column, 0 where there is none, as the contact is open."""
        assert self.is_closed is not None
        closed = self.is_closed.astype(self.by_rotation.dtype)
        return jnp.concatenate([closed[None], jnp.ones((4, len(closed)), closed.dtype)])


@jax.custom_batching.custom_vmap
def _largest_of_all(level: Int[Array, ""]) -> Int[Array, ""]:
    """Under `vmap` that of all rods together: JAX would compute every branch for each of several levels."""
    return level


@_largest_of_all.def_vmap
def _(size: int, is_batched: list[bool], level: Int[Array, "size"]) -> tuple[Int[Array, ""], bool]:
    return _largest_of_all(jnp.max(level)), False
