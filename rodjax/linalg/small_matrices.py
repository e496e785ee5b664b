"""The inverse of small matrices, and how many of their eigenvalues are negative, as operations of their own.

`jnp.linalg.inv` is some ten operations, and six functions more for its derivatives: of elimination from node to node
they are most of what is traced, and of what it takes as NumPy code. Here each is one operation, which is written out
where a program is compiled, and is one call of NumPy's. And solutions for matrices that need not be symmetric.

Matrices of few rows are not given to LAPACK: that of SciPy takes a lock of the whole process in each call, and threads
that work on matrices of 8 x 8 would wait for one another most of the time.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

from rodjax.programs.blas import FEW_ROWS
from rodjax.programs.numpy_rules import OTHERS


def inverse_matrix(matrices: Float[Array, "*m c c"]) -> Float[Array, "*m c c"]:
    """Not a number, or infinite, where a matrix is singular."""
    return _inverse.bind(matrices)


def negative_count(matrices: Float[Array, "m c c"]) -> Int[Array, ""]:
    """How many negative eigenvalues symmetric matrices of any small size have together."""
    return jnp.sum(_negative_counts.bind(matrices))


def solved_where_regular(
    matrix: Float[Array, "k k"],
    right: Float[Array, "k"],
    values: Float[Array, "k"],
    least: float,
    otherwise: Float[Array, "k"],
) -> Float[Array, "k"]:
    """The solution for a matrix without symmetry where all of `values` are above `least`: eigenvalues of its symmetric
    part, or their sizes.
    """
    if not len(right):  # LAPACK complains of matrices without rows
        return right
    return jnp.where(jnp.min(values, initial=1.0) > least, jnp.linalg.solve(matrix, right), otherwise)


def _inverses(matrices: Float[Array, "*m c c"]) -> Float[Array, "*m c c"]:
    c = matrices.shape[-1]
    if c == 1:
        return 1 / matrices
    if c <= FEW_ROWS:
        return _each(_by_exchanges, matrices)
    factors, _, order = jax.lax.linalg.lu(matrices)
    rows = jax.nn.one_hot(order, c, dtype=matrices.dtype)
    half = jax.lax.linalg.triangular_solve(factors, rows, left_side=True, lower=True, unit_diagonal=True)
    return jax.lax.linalg.triangular_solve(factors, half, left_side=True, lower=False)


def _by_exchanges(matrix: Float[Array, "c c"]) -> Float[Array, "c c"]:
    """By Gauss and Jordan in place: column by column, each with the largest entry of the rows that have none yet."""
    c = len(matrix)
    place = np.arange(c)

    def exchanged(k: Int[Array, ""], carry: tuple[Array, Array]) -> tuple[Array, Array]:
        matrix, column_of = carry
        column = matrix[:, k]
        row = jnp.argmax(jnp.where(column_of < 0, jnp.abs(column), -1.0))
        is_row, is_column = place == row, place == k
        scaled = jnp.where(is_column, 1.0, matrix[row]) / column[row]
        others = jnp.where(is_column[None], 0.0, matrix) - column[:, None] * scaled[None]
        return jnp.where(is_row[:, None], scaled[None], others), jnp.where(is_row, k, column_of)

    start = matrix, jnp.full(c, -1)
    matrix, column_of = jax.lax.fori_loop(0, c, exchanged, start)
    row_of = jnp.zeros_like(column_of).at[column_of].set(place)
    return matrix[row_of[:, None], column_of[None]]


def _negatives(matrices: Float[Array, "*m c c"]) -> Int[Array, "*m"]:
    """Sturm's count on tridiagonal matrices similar to them, a sixth of the work of eigenvalues (Golub & Van Loan,
    Matrix Computations, section 8.4).
    """
    c = matrices.shape[-1]
    if c == 1:
        return (matrices[..., 0, 0] < 0).astype(int)
    if c <= FEW_ROWS:
        matrices = _each(_tridiagonal, matrices)
        diagonal, beside = (jnp.diagonal(matrices, offset, -2, -1) for offset in (0, -1))
    else:
        _, diagonal, beside, _ = jax.lax.linalg.tridiagonal(matrices, lower=True)
    least = jnp.finfo(matrices.dtype).tiny

    def pivot(value: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Not zero, and counted with the sign that the next one sees."""
        return jnp.where(jnp.abs(value) < least, least, value)

    last = pivot(diagonal[..., 0])
    count = (last < 0).astype(int)
    if c > FEW_ROWS:  # written out they take half a second to compile

        def counted(carry: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
            last, count = carry
            value, beside = row
            last = pivot(value - beside**2 / last)
            return (last, count + (last < 0).astype(int)), None

        rows = jnp.moveaxis(diagonal[..., 1:], -1, 0), jnp.moveaxis(beside, -1, 0)
        return jax.lax.scan(counted, (last, count), rows, unroll=10)[0][1]
    for k in range(1, c):
        last = pivot(diagonal[..., k] - beside[..., k - 1] ** 2 / last)
        count += (last < 0).astype(int)
    return count


def _tridiagonal(matrix: Float[Array, "c c"]) -> Float[Array, "c c"]:
    """By Householder's reflections, of the lower triangle, as pivots are symmetric but for what elimination has lost.
    Beyond its three diagonals is what these would make zero.
    """
    place = np.arange(len(matrix))
    matrix = jnp.where(place[:, None] >= place[None], matrix, matrix.T)

    def reflected(k: Int[Array, ""], matrix: Float[Array, "c c"]) -> Float[Array, "c c"]:
        is_next, column = place == k + 1, matrix[:, k]
        below = jnp.where(place > k, column, 0.0)
        first, squares = column[k + 1], jnp.sum(below**2)
        normal = below + jnp.where(is_next, jnp.copysign(jnp.sqrt(squares), first), 0.0)
        half = squares + jnp.abs(first) * jnp.sqrt(squares)
        along = jnp.where(half > 0, jnp.sum(matrix * normal[None], 1) / half, 0.0)
        change = along - jnp.where(half > 0, jnp.sum(normal * along) / (2 * half), 0.0) * normal
        return matrix - normal[:, None] * change[None] - change[:, None] * normal[None]

    return jax.lax.fori_loop(0, len(matrix) - 2, reflected, matrix)


def _each(function: Callable[[Array], Array], matrices: Float[Array, "*m c c"]) -> Array:
    if not matrices.size:
        return matrices
    if matrices.ndim == 2:
        return function(matrices)
    return jax.vmap(function)(matrices.reshape(-1, *matrices.shape[-2:])).reshape(matrices.shape)


def _operation(name: str, function: Callable[[Array], Array]) -> Primitive:
    """Of matrices in the last two axes, any others before them."""
    primitive = Primitive(name)
    primitive.def_impl(jax.jit(function))

    def abstract(matrices: Any) -> ShapedArray:
        found = jax.eval_shape(function, jax.ShapeDtypeStruct(matrices.shape, matrices.dtype))
        return ShapedArray(found.shape, found.dtype)

    def batched(arrays: Sequence[Array], axes: Sequence[int]) -> tuple[Array, int]:
        return primitive.bind(jnp.moveaxis(arrays[0], axes[0], 0)), 0

    primitive.def_abstract_eval(abstract)
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=False))
    OTHERS[name] = lambda body, equation, given: f"op.{name}({given})"
    return primitive


_inverse = _operation("inverse", _inverses)
# Of what has no derivative.
_negative_counts = _operation("negative_counts", _negatives)


def _change_of_inverse(matrices: Sequence[Array], changes: Sequence[Array]) -> tuple[Array, Array]:
    found, highest = _inverse.bind(*matrices), jax.lax.Precision.HIGHEST
    return found, -jnp.matmul(jnp.matmul(found, changes[0], precision=highest), found, precision=highest)


ad.primitive_jvps[_inverse] = _change_of_inverse
