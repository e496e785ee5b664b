"""Parts of a program that XLA keeps apart."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def staged(tree: Any) -> Any:
    """Arrays of one shape, as they are; what is made of them and what they are made of become programs of their own.

    On a processor XLA fuses all elementwise work, and computes again for each result what several results share: second
    derivatives of a chain of rotations then took 16 times as long to compute, and 4 times as long to compile. It does
    not look through a product of matrices, here with the identity, which is exact. (`optimization_barrier` is gone
    before XLA fuses.)
    """
    leaves, structure = jax.tree.flatten(tree)
    even = leaves if len(leaves) % 2 == 0 else [*leaves, leaves[0]]
    pairs = jnp.stack(even).reshape(2, -1)
    same = jax.lax.dot(np.eye(2, dtype=pairs.dtype), pairs, precision=jax.lax.Precision.HIGHEST)
    apart = jnp.unstack(same.reshape(len(even), *leaves[0].shape))
    return jax.tree.unflatten(structure, apart[: len(leaves)])
