"""Numbers of nodes, middles and elements along a chain, each put where the others are."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def at_points(nodes: Float[Array, "*c n+1"], middles: Float[Array, "*c n"]) -> Float[Array, "*c m"]:
    """Nodes and middles in turn."""
    pairs = jnp.stack([nodes[..., :-1], middles], axis=-1).reshape(*middles.shape[:-1], -1)
    return jnp.concatenate([pairs, nodes[..., -1:]], axis=-1)


def on_nodes(before: Float[Array, "n *c"], after: Float[Array, "n *c"]) -> Float[Array, "n+1 *c"]:
    """What elements have for the nodes at their start and their end."""
    none = jnp.zeros_like(before[:1])
    return jnp.concatenate([before, none]) + jnp.concatenate([none, after])


def at_ends(of_nodes: Float[Array, "c n+1"]) -> Float[Array, "c 2 n"]:
    """At the start and the end of each element."""
    return jnp.stack([of_nodes[:, :-1], of_nodes[:, 1:]], axis=1)
