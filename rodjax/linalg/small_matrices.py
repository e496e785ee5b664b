"""The inverse of small matrices, and how many of their eigenvalues are negative, as operations of their own.

`jnp.linalg.inv` is some ten operations, and six functions more for its derivatives: of elimination from node to node
they are most of what is traced, and of what it takes as NumPy code. Here each is one operation, which is written out
where a program is compiled, and is one call of NumPy's. And solutions for matrices that need not be symmetric.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

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


def _by_elimination(matrices: Float[Array, "*m c c"]) -> Float[Array, "*m c c"]:
    factors, _, order = jax.lax.linalg.lu(matrices)
    exchanges = jax.nn.one_hot(order, matrices.shape[-1], dtype=matrices.dtype)
    half = jax.lax.linalg.triangular_solve(factors, exchanges, left_side=True, lower=True, unit_diagonal=True)
    return jax.lax.linalg.triangular_solve(factors, half, left_side=True, lower=False)


def _by_sturm(matrices: Float[Array, "*m c c"]) -> Int[Array, "*m"]:
    """Sturm's count on tridiagonal matrices similar to them, a sixth of the work of eigenvalues (Golub & Van Loan,
    Matrix Computations, section 8.4).
    """
    if matrices.shape[-1] == 1:
        return (matrices[..., 0, 0] < 0).astype(int)
    _, diagonal, beside, _ = jax.lax.linalg.tridiagonal(matrices, lower=True)
    least = jnp.finfo(matrices.dtype).tiny

    def pivot(value: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Not zero, and counted with the sign that the next one sees."""
        return jnp.where(jnp.abs(value) < least, least, value)

    last = pivot(diagonal[..., 0])
    count = (last < 0).astype(int)
    for k in range(1, matrices.shape[-1]):
        last = pivot(diagonal[..., k] - beside[..., k - 1] ** 2 / last)
        count += (last < 0).astype(int)
    return count


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


_inverse = _operation("inverse", _by_elimination)
# Of what has no derivative.
_negative_counts = _operation("negative_counts", _by_sturm)


def _change_of_inverse(matrices: Sequence[Array], changes: Sequence[Array]) -> tuple[Array, Array]:
    found, highest = _inverse.bind(*matrices), jax.lax.Precision.HIGHEST
    return found, -jnp.matmul(jnp.matmul(found, changes[0], precision=highest), found, precision=highest)


ad.primitive_jvps[_inverse] = _change_of_inverse
