"""Many fits in one program, a few of them side by side."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from rodjax.programs.stacks import of_each

T = TypeVar("T")

# Rods side by side, as many as fit into a processor's cache.
LANES = 16


def in_lanes(function: Callable[..., T], each: tuple[Any, ...], rods: int = 1) -> T:
    """`function` of each entry of the stacks in `each`, of so many `rods`; some again where they do not come out even.

    (`jax.lax.map` would compile a second program for what is left over.)
    """
    count = jax.tree.leaves(each)[0].shape[0]
    lanes = min(max(1, LANES // rods), count)
    turns = -(-count // lanes)
    if turns == 1:
        return of_each(function)(*each)
    which = np.minimum(np.arange(turns * lanes), count - 1).reshape(turns, lanes)
    found = jax.lax.map(lambda x: of_each(function)(*x), jax.tree.map(lambda x: x[which], each))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], found)
