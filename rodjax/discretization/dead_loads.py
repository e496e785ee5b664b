"""Gravity and dead forces: on the nodes of a polyline, and through a rod.

Their potential is linear in the nodes, so that the forces do not vary.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.mechanics.energy import dead_load_energy
from rodjax.model.loads import DistributedForce, loaded_length
from rodjax.model.scene import Scene, dead_forces, has_free_ends
from rodjax.model.supports import Free, Held
from rodjax.units import Units


def load_energy(
    scene: Scene, nodes: Float[Array, "n+1 3"], s: Float[Array, "n+1"] | None = None
) -> Float[Array, ""] | None:
    """The potential of gravity, by the trapezoidal rule, and of dead forces; `None` in a scene without any.

    `s`: arclengths of the nodes, `None` where these are equally spaced.
    """
    terms = []
    if scene.gravity is not None:
        weights = _trapezoidal_weights(len(nodes), nodes.dtype) if s is None else _weights_at(s)
        terms.append(dead_load_energy(scene.gravity, weights @ nodes))
    for load in scene.point_forces:
        position = _position_on(nodes, load.at) if s is None else _position_between(s, nodes, load.at)
        terms.append(dead_load_energy(load.force, position))
    for end, node in ((scene.start, nodes[0]), (scene.end, nodes[-1])):
        if isinstance(end, Free) and end.force is not None:
            terms.append(dead_load_energy(end.force, node))
    return sum(terms[1:], terms[0]) if terms else None


def forces_on_nodes(scene: Scene, segments: int, s: Float[Array, "n+1"] | None = None) -> Float[Array, "n+1 3"]:
    """What the loads exert on each node."""
    nodes = jnp.zeros((segments + 1, 3), scene.rod.length.dtype)
    energy = load_energy(scene, nodes, s)
    if energy is None:
        return nodes
    return -jax.grad(lambda nodes: load_energy(scene, nodes, s))(nodes)


def total_force(scene: Scene) -> Float[Array, "3"]:
    """All dead forces together."""
    forces = [load.force for load in dead_forces(scene)]
    ends = [end for end in (scene.start, scene.end) if isinstance(end, Free) and not end.follower]
    forces += [end.force for end in ends if end.force is not None]
    if scene.gravity is not None:
        forces.append(scene.gravity)
    for load in scene.distributed:
        if isinstance(load, DistributedForce) and not load.follower:
            forces.append(load.force if load.part is None else load.force * loaded_length(load, scene.rod.length))
    return sum(forces, jnp.zeros(3, scene.rod.length.dtype))


def counted_from(
    scene: Scene, clip_nodes: Int[Array, "clips"] | None, before: Float[Array, "... n"], total: Any
) -> Float[Array, "... n"]:
    """What of a load counts in the force through each cell, by what lies `before` it and by the `total`: what is
    beyond. Where the start is free that less all of it; where both ends are, so in the first span alone. The rest of
    the force is that of a span between held places; a span with a free end has none.
    """
    if not has_free_ends(scene):
        return total - before if isinstance(scene.start, Held) else -before
    if clip_nodes is None:
        return total - before
    return jnp.where(jnp.arange(before.shape[-1]) < clip_nodes[0], -before, total - before)


def forces_beyond_points(
    scene: Scene,
    clip_nodes: Int[Array, "clips"] | None,
    loads: list[tuple[Float[Array, "3"], Float[Array, "p n"], Any]],
    nothing: Float[Array, "p n"],
) -> Float[Array, "3 p n"]:
    """The dead forces at the points of cells: of loads, each with what of it lies before the points and with all of it,
    and on free ends.
    """
    for end, before in ((scene.start, nothing + 1.0), (scene.end, nothing)):
        if isinstance(end, Free) and end.force is not None and not end.follower:
            loads = [*loads, (end.force, before, 1.0)]
    forces = [force[:, None, None] * counted_from(scene, clip_nodes, *of_load)[None] for force, *of_load in loads]
    return sum(forces, jnp.zeros((3, *nothing.shape), nothing.dtype))


def forces_beyond_edges(
    scene: Scene, node_forces: Float[Array, "3 n+1"], clip_nodes: Int[Array, "clips"] | None = None
) -> Float[Array, "3 n"]:
    """The sum of the forces on the nodes beyond each edge, or less those before it: see `counted_from`."""
    if isinstance(scene.start, Held):
        return jnp.cumsum(node_forces[:, :0:-1], axis=1)[:, ::-1]
    total = jnp.sum(node_forces, axis=1, keepdims=True)
    return counted_from(scene, clip_nodes, jnp.cumsum(node_forces[:, :-1], axis=1), total)


def _trapezoidal_weights(count: int, dtype) -> Float[Array, "n+1"]:
    weights = jnp.full(count, 1 / (count - 1), dtype)
    return weights.at[jnp.array([0, -1])].multiply(0.5)


def _position_on(nodes: Float[Array, "n+1 3"], s: Float[Array, ""]) -> Float[Array, "3"]:
    """Position at an arclength, linear between the nodes."""
    n = len(nodes) - 1
    cell = jnp.clip(jnp.floor(s * n).astype(int), 0, n - 1)
    t = s * n - cell.astype(s.dtype)
    return (1 - t) * nodes[cell] + t * nodes[cell + 1]


def _weights_at(s: Float[Array, "n+1"]) -> Float[Array, "n+1"]:
    halves = jnp.diff(s) / 2
    none = jnp.zeros_like(halves[:1])
    return jnp.concatenate([halves, none]) + jnp.concatenate([none, halves])


def _position_between(s: Float[Array, "n+1"], nodes: Float[Array, "n+1 3"], at: Float[Array, ""]) -> Float[Array, "3"]:
    cell = jnp.clip(jnp.searchsorted(s, at, side="right") - 1, 0, len(s) - 2)
    t = (at - s[cell]) / (s[cell + 1] - s[cell])
    return (1 - t) * nodes[cell] + t * nodes[cell + 1]


def energy_of_origin(scene: Scene, units: Units) -> Float[Array, ""]:
    """Potential energy [J] of all dead forces of a nondimensional scene at its origin."""
    return dead_load_energy(total_force(scene), units.origin) * units.force
