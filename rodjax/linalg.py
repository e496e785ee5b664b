"""Symmetric positive definite block-tridiagonal systems by block cyclic reduction.

Every level eliminates the blocks of odd number, all at once, by Cholesky factorisation: log2(n) levels of a few batched
operations each, where block Thomas elimination would take n steps one after another. Any number of blocks is allowed.
Reference: Heller, "Some aspects of the cyclic reduction algorithm for block tridiagonal linear systems" (1976).
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class SymmetricBlockTridiagonal(eqx.Module):
    """A symmetric matrix of n x n blocks: `diagonal[i]` is block (i, i), `lower[i]` is block (i + 1, i)."""

    diagonal: Float[Array, "n b b"]
    lower: Float[Array, "n-1 b b"]

    def __check_init__(self):
        n, b, _ = self.diagonal.shape
        if self.diagonal.shape != (n, b, b) or self.lower.shape != (n - 1, b, b):
            raise ValueError(
                "a block-tridiagonal matrix needs blocks of shapes (n, b, b) and (n - 1, b, b), "
                f"got {self.diagonal.shape} and {self.lower.shape}"
            )

    def __matmul__(self, x: Float[Array, "n b"]) -> Float[Array, "n b"]:
        product = _apply(self.diagonal, x)
        product = product.at[1:].add(_apply(self.lower, x[:-1]))
        return product.at[:-1].add(_apply_transpose(self.lower, x[1:]))


class _Level(eqx.Module):
    """One level: with D = L L^T the odd blocks on the diagonal, inverse L, L^-1 left and L^-1 right."""

    inverse: Float[Array, "m b b"]
    left: Float[Array, "m b b"]
    right: Float[Array, "m b b"]


class BlockCholesky(eqx.Module):
    """The factorisation of a `SymmetricBlockTridiagonal`; NaN where that is not positive definite."""

    levels: tuple[_Level, ...]
    last_inverse: Float[Array, "1 b b"]

    @property
    def is_positive_definite(self) -> Bool[Array, ""]:
        # A failed block is NaN, and what it is eliminated into becomes NaN with it, down to the last block.
        return jnp.all(jnp.isfinite(self.last_inverse))

    def solve(self, right_side: Float[Array, "n b"]) -> Float[Array, "n b"]:
        f = right_side
        eliminated = []
        for level in self.levels:
            w = _apply(level.inverse, f[1::2])
            eliminated.append(w)
            f = _subtract_neighbours(f[0::2], _apply_transpose(level.left, w), _apply_transpose(level.right, w))
        x = _apply_transpose(self.last_inverse, _apply(self.last_inverse, f))
        for level, w in zip(reversed(self.levels), reversed(eliminated), strict=True):
            n_odd, n_even = len(w), len(x)
            w = w - _apply(level.left, x[:n_odd]) - _apply(level.right, _padded(x[1:], n_odd))
            odd = _apply_transpose(level.inverse, w)
            x = jnp.stack([x, _padded(odd, n_even)], axis=1).reshape(2 * n_even, -1)[: n_odd + n_even]
        return x


def factor(matrix: SymmetricBlockTridiagonal) -> BlockCholesky:
    """Cholesky factorisation by cyclic reduction, O(n b^3)."""
    diagonal, lower = matrix.diagonal, matrix.lower
    levels = []
    while len(diagonal) > 1:
        odd = diagonal[1::2]
        left = lower[0::2][: len(odd)]  # blocks (odd, odd - 1)
        right = _padded(jnp.swapaxes(lower[1::2], 1, 2), len(odd))  # blocks (odd, odd + 1), none beyond the last
        level = _factor_level(odd, left, right)
        levels.append(level)
        diagonal = _subtract_neighbours(diagonal[0::2], _gram(level.left, level.left), _gram(level.right, level.right))
        lower = -_gram(level.right, level.left)[: len(diagonal) - 1]
    return BlockCholesky(tuple(levels), _inverse_cholesky(diagonal))


def pair_blocks(
    diagonal: Float[Array, "n b b"], lower: Float[Array, "n-1 b b"], second_lower: Float[Array, "n-2 b b"]
) -> SymmetricBlockTridiagonal:
    """A block-pentadiagonal matrix as a block-tridiagonal one of twice the block size.

    `lower[i]` is block (i + 1, i), `second_lower[i]` block (i + 2, i). An odd number of blocks is filled up by the
    identity.
    """
    n, b, _ = diagonal.shape
    pairs = (n + 1) // 2
    filled = _padded(diagonal, 2 * pairs)
    if n % 2:
        filled = filled.at[-1].set(jnp.eye(b, dtype=diagonal.dtype))
    first = _padded(lower, 2 * pairs)
    second = _padded(second_lower, 2 * pairs)
    inside = first[0::2]
    diagonal_pairs = _blocks([[filled[0::2], jnp.swapaxes(inside, 1, 2)], [inside, filled[1::2]]])
    between = [[second[0::2], first[1::2]], [jnp.zeros_like(inside), second[1::2]]]
    return SymmetricBlockTridiagonal(diagonal_pairs, _blocks(between)[: pairs - 1])


def _factor_level(odd: Float[Array, "m b b"], left: Float[Array, "m b b"], right: Float[Array, "m b b"]) -> _Level:
    b = odd.shape[-1]
    cholesky = jnp.linalg.cholesky(odd, symmetrize_input=False)
    identity = jnp.broadcast_to(jnp.eye(b, dtype=odd.dtype), odd.shape)
    sides = jnp.concatenate([identity, left, right], axis=-1)
    solved = jax.lax.linalg.triangular_solve(cholesky, sides, left_side=True, lower=True)
    return _Level(solved[..., :b], solved[..., b : 2 * b], solved[..., 2 * b :])


def _inverse_cholesky(block: Float[Array, "1 b b"]) -> Float[Array, "1 b b"]:
    cholesky = jnp.linalg.cholesky(block, symmetrize_input=False)
    identity = jnp.broadcast_to(jnp.eye(block.shape[-1], dtype=block.dtype), block.shape)
    return jax.lax.linalg.triangular_solve(cholesky, identity, left_side=True, lower=True)


def _subtract_neighbours(even: Array, from_left: Array, from_right: Array) -> Array:
    """The even entries less what the odd one to the right (its left side) and the one to the left contribute."""
    return even.at[: len(from_left)].add(-from_left).at[1:].add(-from_right[: len(even) - 1])


def _gram(a: Float[Array, "m b b"], b: Float[Array, "m b b"]) -> Float[Array, "m b b"]:
    """a^T b block by block, as a sum of outer products: XLA fuses these, where a batched dot takes twice the time."""
    return functools.reduce(jnp.add, (a[:, k, :, None] * b[:, k, None, :] for k in range(a.shape[1])))


def _apply(a: Float[Array, "m b b"], x: Float[Array, "m b"]) -> Float[Array, "m b"]:
    return jnp.sum(a * x[:, None, :], axis=2)


def _apply_transpose(a: Float[Array, "m b b"], x: Float[Array, "m b"]) -> Float[Array, "m b"]:
    return jnp.sum(a * x[:, :, None], axis=1)


def _padded(x: Array, length: int) -> Array:
    missing = length - len(x)
    return x if missing == 0 else jnp.concatenate([x, jnp.zeros((missing, *x.shape[1:]), x.dtype)])


def _blocks(rows: list[list[Float[Array, "m b b"]]]) -> Float[Array, "m 2b 2b"]:
    return jnp.concatenate([jnp.concatenate(row, axis=2) for row in rows], axis=1)
