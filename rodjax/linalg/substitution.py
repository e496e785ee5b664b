"""Substitution from node to node, as an operation of its own: in a program one loop, as NumPy code one call.

    x_0 = right_0,    x_k+1 = right_k+1 - coupling_k x_k

or, backward, from the last node to the first one: x_n = right_n, x_k = right_k - coupling_k x_k+1.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from rodjax.programs.numpy_rules import OTHERS


def substituted(
    couplings: Float[Array, "*m n c c"], right: Float[Array, "*m n+1 c r"], *, backward: bool = False
) -> Float[Array, "*m n+1 c r"]:
    """r solutions of each system, which stand along the first axes."""
    return _substitution.bind(couplings, right, backward=backward)


def _by_loop(
    couplings: Float[Array, "*m n c c"], right: Float[Array, "*m n+1 c r"], *, backward: bool
) -> Float[Array, "*m n+1 c r"]:
    couplings, right = jnp.moveaxis(couplings, -3, 0), jnp.moveaxis(right, -3, 0)

    def step(beside: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        coupling, here = given
        # One loop with the difference, where a product of matrices is a call.
        here -= jnp.sum(coupling[..., None] * beside[..., None, :, :], axis=-2)
        return here, here

    if backward:
        first, others = right[-1:], right[:-1]
    else:
        first, others = right[:1], right[1:]
    _, found = jax.lax.scan(step, first[0], (couplings, others), reverse=backward)
    return jnp.moveaxis(jnp.concatenate([found, first] if backward else [first, found]), 0, -3)


def _kind(couplings: Any, right: Any, *, backward: bool) -> ShapedArray:
    return ShapedArray(right.shape, right.dtype)


def _batched(arrays: Sequence[Array], axes: Sequence[Any], *, backward: bool) -> tuple[Array, int]:
    couplings, right = arrays
    of_couplings, of_right = axes
    if of_couplings is None:
        # More right sides of the same system.
        right = jnp.moveaxis(right, of_right, -1)
        found = substituted(couplings, right.reshape(*right.shape[:-2], -1), backward=backward)
        return found.reshape(right.shape), right.ndim - 1
    couplings = jnp.moveaxis(couplings, of_couplings, 0)
    if of_right is None:
        right = jnp.broadcast_to(right[None], (len(couplings), *right.shape))
    else:
        right = jnp.moveaxis(right, of_right, 0)
    return substituted(couplings, right, backward=backward), 0


def _change(given: Sequence[Array], changes: Sequence[Any], *, backward: bool) -> tuple[Array, Array]:
    (couplings, right), (of_couplings, of_right) = given, changes
    found = substituted(couplings, right, backward=backward)
    change = jnp.zeros_like(right) if isinstance(of_right, ad.Zero) else of_right
    if not isinstance(of_couplings, ad.Zero):
        beside = found[..., 1:, :, :] if backward else found[..., :-1, :, :]
        lost = jnp.matmul(of_couplings, beside, precision=jax.lax.Precision.HIGHEST)
        none = jnp.zeros_like(right[..., :1, :, :])
        lost = jnp.concatenate([lost, none] if backward else [none, lost], axis=-3)
        change -= lost
    return found, substituted(couplings, change, backward=backward)


def _transposed(change: Any, couplings: Any, right: Any, *, backward: bool) -> tuple[None, Any]:
    assert ad.is_undefined_primal(right), "linear in the right side alone"
    if isinstance(change, ad.Zero):
        return None, ad.Zero(right.aval)
    return None, substituted(jnp.swapaxes(couplings, -1, -2), change, backward=not backward)


_substitution = Primitive("substitution")
_substitution.def_impl(jax.jit(_by_loop, static_argnames="backward"))
_substitution.def_abstract_eval(_kind)
batching.primitive_batchers[_substitution] = _batched
ad.primitive_jvps[_substitution] = _change
ad.primitive_transposes[_substitution] = _transposed
mlir.register_lowering(_substitution, mlir.lower_fun(_by_loop, multiple_results=False))
OTHERS["substitution"] = lambda body, equation, couplings, right: (
    f"op.substitution({couplings}, {right}, {equation.params['backward']})"
)
