"""Functions of each entry of stacks."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
from jax import lax

F = TypeVar("F", bound=Callable)


def of_each(function: F, in_axes: tuple[int | None, ...] | None = None) -> F:
    """`jax.vmap(function)` along first axes; `in_axes`: 0 or `None` for each argument.

    A stack of one is no stack: JAX traces nothing a second time, and what a branch does not need is not computed.
    """

    def call(*stacks: Any) -> Any:
        axes = in_axes or (0,) * len(stacks)
        leaves = [jax.tree.leaves(stack) for stack, axis in zip(stacks, axes, strict=True) if axis == 0]
        counts = {leaf.shape[0] for each in leaves for leaf in each}
        if counts != {1}:
            return jax.vmap(function, axes)(*stacks)
        single = (
            jax.tree.map(lambda x: lax.squeeze(x, (0,)), stack) if axis == 0 else stack
            for stack, axis in zip(stacks, axes, strict=True)
        )
        return jax.tree.map(lambda x: lax.expand_dims(jnp.asarray(x), (0,)), function(*single))

    return cast(F, call)
