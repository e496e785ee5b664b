"""Saddle-point systems along a rod: a symmetric block-tridiagonal matrix with a border, by block cyclic reduction.

    [ H    A ] [x]   [f]
    [ A^T -C ] [y] = [c]

H couples neighbours, n blocks of b x b; the k columns of A are few and full: what all of the rod has in common. H may
be indefinite, and the number of negative eigenvalues of the whole follows from the factorisation (Haynsworth 1968).
Loads without a potential have other rows than columns in the border.

Every level eliminates every second block, all at once: log2(n) levels of a few loops each, where block Thomas
elimination would take n steps one after another. The inverses of blocks are explicit, and arrays have the place along
the rod as their last axis, (b, b, n): all loops are then vector loops along the rod, on a processor or an accelerator.
Reference: Heller, "Some aspects of the cyclic reduction algorithm for block tridiagonal linear systems" (1976).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.blocks import inverse_of_blocks, product, short_sum, transpose_product
from rodjax.linalg.bordered import BorderedFactors, BorderedSystem, Vectors
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.chain_factors import ChainFactors, factor_chain
from rodjax.linalg.small_matrices import inverse_matrix
from rodjax.programs.parts import traced_once
from rodjax.programs.stacks import of_each

# Of the mean diagonal, the least eigenvalue of a block that others wait for: what they lose is about 1e-16 over the
# square of this, and what they differ by is about 10 times this.
LEAST_PIVOT = 1e-7
# So few blocks are eliminated one after another in a loop: a level is as many kernels to compile, however short it is.
IN_TURN = 4


class SaddlePointSystem(eqx.Module):
    """The matrix above: `diagonal[..., i]` is block (i, i) of H, `lower[..., i]` block (i + 1, i).

    `border` holds A, `compliance` C, symmetric; `rows` stand in the place of A^T where they are given. Every second
    block of H may also be coupled with the next but one: `across[..., i]` is block (2 i + 2, 2 i). Blocks of size 1
    to 3.
    """

    diagonal: Float[Array, "b b n"]
    lower: Float[Array, "b b n-1"]
    border: Float[Array, "b k n"]
    compliance: Float[Array, "k k"]
    rows: Float[Array, "b k n"] | None = None
    across: Float[Array, "b b (n-1)/2"] | None = None

    def __check_init__(self):
        b, k, n = self.border.shape
        rows = self.border if self.rows is None else self.rows
        given = [x.shape for x in (self.diagonal, self.lower, self.border, self.compliance, rows)]
        if self.across is not None and (n % 2 == 0 or self.across.shape != (b, b, n // 2)):
            raise ValueError(f"across must have the shape {(b, b, n // 2)} for odd n, got {self.across.shape}, n = {n}")
        if b not in (1, 2, 3) or given != [(b, b, n), (b, b, n - 1), (b, k, n), (k, k), (b, k, n)]:
            raise ValueError(
                "a saddle-point system needs arrays of shapes (b, b, n), (b, b, n - 1), (b, k, n), (k, k), (b, k, n) "
                f"with b = 1 to 3, got {', '.join(map(str, given))}"
            )

    def times(self, x: Float[Array, "b n"], y: Float[Array, "k"]) -> tuple[Float[Array, "b n"], Float[Array, "k"]]:
        """The matrix times (x, y): the right sides f and c."""
        columns = x[:, None]
        below = product(self.lower, columns[..., :-1])[:, 0]
        above = transpose_product(self.lower, columns[..., 1:])[:, 0]
        f = product(self.diagonal, columns)[:, 0] + jnp.sum(self.border * y[None, :, None], axis=1)
        f += _spread(below, 1, 0) + _spread(above, 0, 1)
        if self.across is not None:
            f += _spread(product(self.across, columns[..., 0:-1:2])[:, 0], 2, 0, between=1)
            f += _spread(transpose_product(self.across, columns[..., 2::2])[:, 0], 0, 2, between=1)
        rows = self.border if self.rows is None else self.rows
        return f, jnp.sum(rows * x[:, None], axis=(0, 2)) - self.compliance @ y

    def shifted(self, shift: Float[Array, ""] | Float[Array, "n"]) -> "SaddlePointSystem":
        """H + shift I in the place of H, with one shift or one for each block."""
        identity = jnp.eye(self.diagonal.shape[0], dtype=shift.dtype)[..., None]
        shift = jnp.broadcast_to(shift, self.diagonal.shape[-1:])
        return eqx.tree_at(lambda system: system.diagonal, self, self.diagonal + shift[None, None] * identity)


class Factors(eqx.Module):
    """The factorisation of a `SaddlePointSystem`.

    `negative`: the number of its negative eigenvalues beyond the k of the border. Where that is 0, H is positive
    definite on the x with A^T x = 0, and a solution is the minimum under the constraints. 0 without symmetry.
    """

    elimination: "_Elimination"
    rows: Float[Array, "b k n"]
    border_solution: Float[Array, "b k n"]
    complement: Float[Array, "k k"]
    negative: Int[Array, ""]

    @property
    def is_minimum(self) -> Bool[Array, ""]:
        """Whether H is positive definite under the constraints; not where the last block was singular."""
        is_finite = jnp.isfinite(jnp.sum(self.elimination.last_inverse) + jnp.sum(self.complement))
        return (self.negative == 0) & is_finite

    def solve(self, f: Float[Array, "b n"], c: Float[Array, "k"]) -> tuple[Float[Array, "b n"], Float[Array, "k"]]:
        return self._bordered(self.elimination.solve(f[:, None])[:, 0], c)

    def _bordered(self, x: Float[Array, "b n"], c: Float[Array, "k"]) -> tuple[Float[Array, "b n"], Float[Array, "k"]]:
        """The solution, from that without border."""
        y = short_sum(self.complement * (c - _dots(self.rows, x))[None], axis=1)
        return x - short_sum(self.border_solution * y[None, :, None], axis=1), y


AnyFactors = Factors | ChainFactors | BorderedFactors
AnySystem = SaddlePointSystem | ChainSystem | BorderedSystem


def transposed(system: AnySystem) -> AnySystem:
    """Of rods whose loads have a potential, which only a border leaves without symmetry."""
    return system.transposed if isinstance(system, BorderedSystem) else system


def factor(system: AnySystem, *, is_regularized: bool = False) -> "AnyFactors":
    """Factorisation, O(n): by cyclic reduction, of a chain from node to node.

    `is_regularized`: soft pivots of a `SaddlePointSystem` are made stiffer (see `blocks.inverse_of_blocks`), so that
    the inertia is right where the rod may turn as a whole; a critical motion would be lost with that. Other systems
    stay as they are.

    Where the last block is singular there are infinities or NaN.
    """
    if isinstance(system, ChainSystem):
        return factor_chain(system)
    if isinstance(system, BorderedSystem):
        columns = system.columns
        return system.factored(*_factor_and_solve_all(system.inner, columns.x, columns.y, is_regularized))
    return _factor(system, system.border, is_regularized)[0]


def factor_and_solve(
    system: AnySystem, f: Float[Array, "b n"], c: Float[Array, "k"], *, is_regularized: bool = False
) -> tuple["AnyFactors", Float[Array, "b n"], Float[Array, "k"]]:
    """Factorisation and the solution for one right side, in one sweep."""
    if isinstance(system, ChainSystem):
        factors = factor(system)
        return factors, *factors.solve(f, c)
    if isinstance(system, BorderedSystem):
        g, c = system.split(c)
        all_f, all_c = (jnp.concatenate([part, last[None]]) for part, last in zip(system.columns, (f, c), strict=True))
        inner, found = _factor_and_solve_all(system.inner, all_f, all_c, is_regularized)
        factors = system.factored(inner, Vectors(found.x[:-1], found.y[:-1]))
        return factors, *factors.joined(found.x[-1], found.y[-1], g)
    factors, x = _factor(system, jnp.concatenate([system.border, f[:, None]], axis=1), is_regularized)
    return factors, *factors._bordered(x[:, -1], c)


def _factor_and_solve_all(
    system: SaddlePointSystem | ChainSystem, f: Float[Array, "r b n"], c: Float[Array, "r k"], is_regularized: bool
) -> tuple[Factors | ChainFactors, Vectors]:
    """The same for r right sides."""
    if isinstance(system, ChainSystem):
        chain = factor_chain(system)
        return chain, Vectors(*of_each(chain.solve)(f, c))
    k = system.border.shape[1]
    factors, x = _factor(system, jnp.concatenate([system.border, jnp.swapaxes(f, 0, 1)], axis=1), is_regularized)
    return factors, Vectors(*jax.vmap(factors._bordered, in_axes=(1, 0))(x[:, k:], c))


def _factor(
    system: SaddlePointSystem, right_sides: Float[Array, "b j n"], is_regularized: bool
) -> tuple[Factors, Float[Array, "b j n"]]:
    b = len(system.diagonal)
    least = LEAST_PIVOT / b * jnp.mean(jnp.abs(jnp.trace(system.diagonal))) if is_regularized else None
    elimination, negative, x = _eliminate(system.diagonal, system.lower, system.across, right_sides, least)
    k = system.border.shape[1]
    solution = x[:, :k]
    if system.rows is None:
        rows = system.border
        complement, below = _inverse_in_turn(-system.compliance - _dots(rows[:, :, None], solution), 1)
        negative += below - k
    else:
        rows = system.rows
        complement = inverse_matrix(-system.compliance - _dots(rows[:, :, None], solution))
        negative = jnp.zeros_like(negative)
    return Factors(elimination, rows, solution, complement, negative), x


class _Level(eqx.Module):
    """One level: the inverses of the blocks D that go, every second one from the number `first` on, and D^-1 times the
    blocks that couple them to their neighbours before and after.
    """

    inverse: Float[Array, "b b m"]
    before: Float[Array, "b b m"]
    after: Float[Array, "b b m"]
    first: int = eqx.field(static=True)

    def split(self, x: Float[Array, "*c n"]) -> tuple[Float[Array, "*c m"], Float[Array, "*c k"]]:
        """What goes, and what stays."""
        return x[..., self.first :: 2], x[..., 1 - self.first :: 2]

    def joined(self, goes: Float[Array, "*c m"], stays: Float[Array, "*c k"]) -> Float[Array, "*c n"]:
        n = goes.shape[-1] + stays.shape[-1]
        half = (n + 1) // 2
        both = _padded(stays, half), _padded(goes, half)
        pairs = jnp.stack(both if self.first else both[::-1], axis=-1)
        return pairs.reshape(*goes.shape[:-1], 2 * half)[..., :n]

    def around(self, stays: Float[Array, "*c k"]) -> tuple[Float[Array, "*c m"], Float[Array, "*c m"]]:
        """What stays before and after each that goes, zero where nothing does."""
        m = self.inverse.shape[-1]
        return _padded(_shifted(stays, 1 - self.first), m), _padded(_shifted(stays, -self.first), m)

    def added(self, before: Float[Array, "*c m"], after: Float[Array, "*c m"], k: int) -> Float[Array, "*c k"]:
        """Sums over those that go beside each of the k that stay: contributions to the one before and the one after."""
        return _padded(_shifted(before, self.first - 1), k) + _padded(_shifted(after, self.first), k)


class _Elimination(eqx.Module):
    """`last_inverse`: of the matrix that the levels leave, of few blocks."""

    levels: tuple[_Level, ...]
    last_inverse: Float[Array, "bk bk"]

    def solve(self, f: Float[Array, "b j n"]) -> Float[Array, "b j n"]:
        """H^-1 f for j right sides."""
        eliminated = []
        for level in self.levels:
            goes, f = level.split(f)
            eliminated.append(product(level.inverse, goes))
            beside = transpose_product(level.before, goes), transpose_product(level.after, goes)
            f -= level.added(*beside, f.shape[-1])
        return self.back_substituted(f, eliminated)

    def back_substituted(self, f: Float[Array, "b j k"], eliminated: list[Array]) -> Float[Array, "b j n"]:
        b, j, k = f.shape
        columns = jnp.moveaxis(f, -1, 0).reshape(k * b, j)
        last = jnp.matmul(self.last_inverse, columns, precision=jax.lax.Precision.HIGHEST)
        x = jnp.moveaxis(last.reshape(k, b, j), 0, -1)
        for level, goes in zip(reversed(self.levels), reversed(eliminated), strict=True):
            before, after = level.around(x)
            x = level.joined(goes - product(level.before, before) - product(level.after, after), x)
        return x


@traced_once
def _eliminate(
    diagonal: Float[Array, "b b n"],
    lower: Float[Array, "b b n-1"],
    across: Float[Array, "b b (n-1)/2"] | None,
    right_sides: Float[Array, "b j n"],
    least: Float[Array, ""] | None,
) -> tuple[_Elimination, Int[Array, ""], Float[Array, "b j n"]]:
    """The factorisation of H, how many negative eigenvalues it has, and H^-1 right_sides, in one sweep.

    Diagonal and right sides stand side by side in `rows`, so that a level is few and large loops. After the middles of
    elements the first, third, ... go: were it the others, the middle of the rod would be one of the last, and of a
    symmetric rod that can turn as a whole both halves be singular.
    """
    b = len(diagonal)
    rows = jnp.concatenate([diagonal, right_sides], axis=1)
    levels, eliminated = [], []
    negative = jnp.zeros((), int)
    while rows.shape[-1] > (IN_TURN if across is None else 1):
        first = 0 if across is None else 1
        goes, stays = rows[..., first::2], rows[..., 1 - first :: 2]
        m, k = goes.shape[-1], stays.shape[-1]
        # Blocks (goes, the one before) and (goes, the one after), none beyond the ends.
        before = _padded(_shifted(lower[..., 1 - first :: 2], 1 - first), m)
        after = _padded(jnp.swapaxes(lower[..., first::2], 0, 1), m)
        inverse, below = inverse_of_blocks(goes[:, :b], least)
        scaled = product(inverse, jnp.concatenate([before, after, goes[:, b:]], axis=1))
        level = _Level(inverse, scaled[:, :b], scaled[:, b : 2 * b], first)
        levels.append(level)
        eliminated.append(scaled[:, 2 * b :])
        negative += below
        to_before = transpose_product(before, jnp.concatenate([level.before, eliminated[-1]], axis=1))
        to_after = transpose_product(after, scaled[:, b:])
        rows = stays - level.added(to_before, to_after, k)
        lower = -_shifted(transpose_product(after, level.before), first - 1)[..., : k - 1]
        if across is not None:
            lower, across = lower + across, None
    last_inverse, below = _inverse_in_turn(_whole(rows[:, :b], lower), b, least)
    elimination = _Elimination(tuple(levels), last_inverse)
    return elimination, negative + below, elimination.back_substituted(rows[:, b:], eliminated)


def _whole(diagonal: Float[Array, "b b k"], lower: Float[Array, "b b k-1"]) -> Float[Array, "kb kb"]:
    """The matrix of these blocks."""
    b, _, k = diagonal.shape
    row, column = np.arange(k)[:, None, None, None], np.arange(k)[None, None, :, None]
    matrix = jnp.zeros((), diagonal.dtype)
    before, after = _spread(lower, 1, 0), _spread(jnp.swapaxes(lower, 0, 1), 0, 1)
    for offset, blocks in ((0, diagonal), (1, before), (-1, after)):
        matrix = jnp.where(row - column == offset, jnp.moveaxis(blocks, -1, 0)[:, :, None], matrix)
    return matrix.reshape(k * b, k * b)


def _inverse_in_turn(
    matrix: Float[Array, "kb kb"], b: int, least: Float[Array, ""] | None = None
) -> tuple[Float[Array, "kb kb"], Int[Array, ""]]:
    """Inverse of a small symmetric matrix by sweeps over its k blocks on the diagonal, and the number of its negative
    eigenvalues. `least`: as of `blocks.inverse_of_blocks`, but for the last block, for which no other waits.
    """
    k = len(matrix) // b
    if not k:
        return matrix, jnp.zeros((), int)

    def swept(matrix: Float[Array, "kb kb"], j: Int[Array, ""]) -> tuple[Float[Array, "kb kb"], Int[Array, ""]]:
        row = jax.lax.dynamic_slice_in_dim(matrix, j * b, b)
        pivot = jax.lax.dynamic_slice_in_dim(row, j * b, b, axis=1)
        inverse, below = inverse_of_blocks(pivot[..., None], None if least is None else jnp.where(j < k - 1, least, 0))
        scaled = product(inverse[..., 0], row)
        is_there = np.arange(k * b) // b == j
        others = jnp.where(is_there[None], jnp.tile(scaled.T, (1, k)), matrix - transpose_product(row, scaled))
        corner = jnp.where(is_there[None], jnp.tile(-inverse[..., 0], (k, k)), jnp.tile(scaled, (k, 1)))
        return jnp.where(is_there[:, None], corner, others), below

    matrix, below = jax.lax.scan(swept, matrix, jnp.arange(k))
    return -matrix, jnp.sum(below)


def _dots(border: Float[Array, "b k *j n"], x: Float[Array, "b *j n"]) -> Array:
    """A^T x."""
    return jnp.sum(border * x[:, None], axis=(0, -1))


def _shifted(x: Array, by: int) -> Array:
    """One place later with a zero before, or one earlier, or as it is."""
    if by < 0:
        return x[..., 1:]
    return jnp.concatenate([jnp.zeros_like(x[..., :1]), x], axis=-1) if by else x


def _padded(x: Array, length: int) -> Array:
    """Of this length, with zeros at the end where it is shorter."""
    missing = length - x.shape[-1]
    return (
        x[..., :length] if missing <= 0 else jnp.concatenate([x, jnp.zeros((*x.shape[:-1], missing), x.dtype)], axis=-1)
    )


def _spread(x: Float[Array, "*c m"], before: int, after: int, between: int = 0) -> Float[Array, "*c n"]:
    """With so many zeros before, between and after the entries."""
    others = [(0, 0, 0)] * (x.ndim - 1)
    return jax.lax.pad(x, jnp.zeros((), x.dtype), [*others, (before, after, between)])
