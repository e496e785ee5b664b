"""Block cyclic reduction against dense solves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from rodjax.linalg import SymmetricBlockTridiagonal, factor, pair_blocks


def random_matrix(n: int, b: int, seed: int = 0) -> SymmetricBlockTridiagonal:
    """Positive definite by diagonal dominance."""
    rng = np.random.default_rng(seed)
    diagonal = rng.normal(size=(n, b, b))
    diagonal = diagonal + diagonal.transpose(0, 2, 1) + 8 * b * np.eye(b)
    return SymmetricBlockTridiagonal(jnp.asarray(diagonal), jnp.asarray(rng.normal(size=(n - 1, b, b))))


def dense(matrix: SymmetricBlockTridiagonal) -> np.ndarray:
    n, b, _ = matrix.diagonal.shape
    full = np.zeros((n * b, n * b))
    for i in range(n):
        full[i * b : (i + 1) * b, i * b : (i + 1) * b] = matrix.diagonal[i]
        if i + 1 < n:
            full[(i + 1) * b : (i + 2) * b, i * b : (i + 1) * b] = matrix.lower[i]
            full[i * b : (i + 1) * b, (i + 1) * b : (i + 2) * b] = np.asarray(matrix.lower[i]).T
    return full


def check_solve(n: int, b: int) -> None:
    matrix = random_matrix(n, b)
    right_side = np.random.default_rng(1).normal(size=(n, b))
    factors = jax.jit(factor)(matrix)
    assert factors.is_positive_definite
    expected = np.linalg.solve(dense(matrix), right_side.ravel()).reshape(n, b)
    # The condition number is below 10, so that only a few roundings add up.
    np.testing.assert_allclose(factors.solve(jnp.asarray(right_side)), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(matrix @ expected, right_side, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("n", "b"), [(1, 1), (2, 3), (3, 8), (5, 2), (6, 6), (7, 5), (16, 4), (33, 7)])
def test_solve_agrees_with_a_dense_solve(n, b):
    check_solve(n, b)


@pytest.mark.slow
@pytest.mark.parametrize("b", range(1, 9))
def test_solve_agrees_with_a_dense_solve_for_every_size(b):
    for n in (4, 9, 12, 31, 32, 65, 127, 300):
        check_solve(n, b)


def test_badly_scaled_blocks_keep_a_small_residual():
    matrix = random_matrix(20, 6)
    scale = jnp.asarray(10.0 ** np.random.default_rng(2).uniform(-4, 4, size=(20, 6)))
    matrix = SymmetricBlockTridiagonal(
        matrix.diagonal * scale[:, :, None] * scale[:, None, :],
        matrix.lower * scale[1:, :, None] * scale[:-1, None, :],
    )
    x = np.random.default_rng(3).normal(size=(20, 6)) / scale
    solved = factor(matrix).solve(matrix @ x)
    # Cholesky does not suffer from scaling by a diagonal: condition 1e16, error that of the unscaled matrix.
    np.testing.assert_allclose(solved * scale, x * scale, rtol=0, atol=1e-13)


@pytest.mark.parametrize("where", [0, 3, 6])
def test_an_indefinite_matrix_is_recognised(where):
    matrix = random_matrix(7, 3)
    matrix = SymmetricBlockTridiagonal(matrix.diagonal.at[where, 1, 1].add(-200.0), matrix.lower)
    assert not factor(matrix).is_positive_definite


def test_gradient_through_a_solve():
    matrix, right_side = random_matrix(6, 3), jnp.ones((6, 3))

    def total(diagonal, lower, right_side):
        diagonal = jnp.asarray(diagonal)
        symmetric = (diagonal + jnp.swapaxes(diagonal, 1, 2)) / 2
        matrix = SymmetricBlockTridiagonal(symmetric, jnp.asarray(lower))
        return jnp.sum(factor(matrix).solve(jnp.asarray(right_side)) ** 2)

    # Against finite differences of step 1e-5 or so: 1e-5 relative is what these give.
    check_grads(jax.jit(total), (matrix.diagonal, matrix.lower, right_side), order=2, rtol=1e-5)


def test_vmap_agrees_with_one_after_another():
    matrices = [random_matrix(9, 4, seed) for seed in range(3)]
    right_sides = jnp.asarray(np.random.default_rng(4).normal(size=(3, 9, 4)))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *matrices)
    batched = jax.vmap(lambda matrix, f: factor(matrix).solve(f))(stacked, right_sides)
    for k, matrix in enumerate(matrices):
        np.testing.assert_allclose(batched[k], factor(matrix).solve(right_sides[k]), rtol=0, atol=1e-15)


@pytest.mark.parametrize("n", [1, 2, 5, 8])
def test_pairing_a_pentadiagonal_matrix_keeps_its_entries(n):
    rng = np.random.default_rng(5)
    diagonal = rng.normal(size=(n, 3, 3))
    diagonal += diagonal.transpose(0, 2, 1)
    lower, second = rng.normal(size=(max(n - 1, 0), 3, 3)), rng.normal(size=(max(n - 2, 0), 3, 3))
    full = np.zeros((n + n % 2, 3, n + n % 2, 3))
    for blocks, offset in ((diagonal, 0), (lower, 1), (second, 2)):
        for i, block in enumerate(blocks):
            full[i + offset, :, i, :] = block
            full[i, :, i + offset, :] = block.T
    if n % 2:
        full[n, :, n, :] = np.eye(3)
    paired = pair_blocks(jnp.asarray(diagonal), jnp.asarray(lower), jnp.asarray(second))
    np.testing.assert_array_equal(dense(paired), full.reshape(3 * (n + n % 2), -1))


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"\(n, b, b\) and \(n - 1, b, b\)"):
        SymmetricBlockTridiagonal(jnp.zeros((3, 2, 2)), jnp.zeros((3, 2, 2)))
