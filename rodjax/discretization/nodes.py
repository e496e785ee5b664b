"""Where the nodes of a mesh lie along the rod: moved so that there is one wherever the moment has a kink or a jump."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.model.along import Steps
from rodjax.model.scene import Scene, loaded_parts, loads_at_nodes

# Point forces nearer to one another, to a clip or to an end, in parts of an element, share it: shorter ones would cost
# digits.
LEAST_ELEMENT = 0.05


def varying(scene: Scene) -> list[Float[Array, "k"]]:
    """The arclengths of the jumps of a rod and of loads along it, and of loads that all belong to one node."""
    rod = scene.rod
    rest = (*(rod.rest_curvature or ()), rod.rest_twist, rod.rest_strain)
    values = (*rod.stiffnesses, *(rod.shear_pair or ()), rod.mass_per_length, *rest)
    jumps = [value.jumps for value in values if isinstance(value, Steps)]
    jumps += loaded_parts(scene)
    # Of such a load all is on one node, and what it does jumps there.
    return jumps + [load.at[..., None] for load in loads_at_nodes(scene)]


def with_nodes_of(scene: Scene, s: Float[Array, "n+1"]) -> tuple[Float[Array, "n+1"], Int[Array, "clips"] | None]:
    """The nodes moved so that one lies at each clip, each point force, where the moment has a kink, and each jump; the
    numbers of those at the clips.
    """
    arclengths = [load.at for load in scene.point_forces] + [jump for jumps in varying(scene) for jump in jumps]
    if scene.clips:
        return with_nodes_at_clips(scene, s, arclengths)
    return (with_nodes_at(s, jnp.sort(jnp.stack(arclengths))) if arclengths else s), None


def with_nodes_at(s: Float[Array, "n+1"], arclengths: Float[Array, "k"]) -> Float[Array, "n+1"]:
    """The nodes moved, with all between them and the next one fixed, so that one lies at each of the sorted places.

    Places nearer than `LEAST_ELEMENT` of an element to an end or to the last place get none.
    """
    n = len(s) - 1
    differ = jnp.concatenate([jnp.diff(arclengths) * n >= LEAST_ELEMENT, jnp.array([True])])
    wanted = jnp.minimum(jnp.cumsum(differ[::-1])[::-1], n - 1)
    index = jnp.arange(n + 1)
    fixed, fixed_place = jnp.zeros((), index.dtype), jnp.zeros((), s.dtype)
    for nodes_left, place in zip(wanted, arclengths, strict=True):
        nearest = jnp.clip(jnp.argmin(jnp.abs(s - place)), fixed + 1, n - nodes_left)
        moved = node_moved(s, index, (fixed, fixed_place), (nearest, place))
        is_apart = ((place - fixed_place) * n >= LEAST_ELEMENT) & ((1 - place) * n >= LEAST_ELEMENT)
        is_apart &= nearest > fixed
        s = jnp.where(is_apart, moved, s)
        fixed, fixed_place = jnp.where(is_apart, nearest, fixed), jnp.where(is_apart, place, fixed_place)
    return s


def with_nodes_at_clips(
    scene: Scene, s: Float[Array, "n+1"], loads: list[Float[Array, ""]]
) -> tuple[Float[Array, "n+1"], Int[Array, "clips"]]:
    """The nodes moved so that one lies at each clip, and where there are enough at each of the loads; the numbers of
    those at the clips.

    Loads nearer than `LEAST_ELEMENT` of an element to a clip, an end or another load get none.
    """
    n = len(s) - 1
    clips = jnp.stack([clip.at for clip in scene.clips])
    arclengths = clips
    if loads:
        at = jnp.stack(loads)
        beside = clips[jnp.argmin(jnp.abs(at[:, None] - clips[None]), axis=1)]
        arclengths = jnp.concatenate([clips, jnp.where(jnp.abs(at - beside) * n < LEAST_ELEMENT, beside, at)])
    order = jnp.argsort(arclengths, stable=True)
    arclengths, is_clip = arclengths[order], order < len(clips)
    # So many nodes are wanted from each place on, and so many clips lie beyond it.
    differ = jnp.concatenate([(jnp.diff(arclengths) * n >= LEAST_ELEMENT) | is_clip[1:], jnp.array([True])])
    wanted = jnp.minimum(jnp.cumsum(differ[::-1])[::-1], n - 1)
    beyond = jnp.sum(is_clip) - jnp.cumsum(is_clip)
    index = jnp.arange(n + 1)
    fixed, fixed_place = jnp.zeros((), index.dtype), jnp.zeros((), s.dtype)
    numbers = jnp.zeros(len(clips), index.dtype)
    for k in range(len(arclengths)):
        place = arclengths[k]
        last = jnp.minimum(
            jnp.where(is_clip[k], jnp.maximum(n - wanted[k], fixed + 1), n - wanted[k]), n - 1 - beyond[k]
        )
        nearest = jnp.clip(jnp.argmin(jnp.abs(s - place)), fixed + 1, last)
        moved = node_moved(s, index, (fixed, fixed_place), (nearest, place))
        is_apart = ((place - fixed_place) * n >= LEAST_ELEMENT) & ((1 - place) * n >= LEAST_ELEMENT)
        is_taken = is_clip[k] | (is_apart & (nearest > fixed))
        s = jnp.where(is_taken, moved, s)
        numbers = jnp.where((jnp.arange(len(clips)) == order[k]) & is_clip[k], nearest, numbers)
        fixed, fixed_place = jnp.where(is_taken, nearest, fixed), jnp.where(is_taken, place, fixed_place)
    return s, numbers


class HeldNode(NamedTuple):
    """The node at which a clip, the number `clip` of a scene, holds the tangent, alone or with the twist."""

    clip: int
    node: Int[Array, ""]
    tangent: Float[Array, "3"]


def held_nodes(scene: Scene, clip_nodes: Int[Array, "clips"] | None) -> list[HeldNode]:
    """All of those, where `clip_nodes` are the numbers of the nodes at the clips."""
    if clip_nodes is None:
        return []
    directions = [(k, clip.direction) for k, clip in enumerate(scene.clips)]
    return [HeldNode(k, clip_nodes[k], direction) for k, direction in directions if direction is not None]


def node_moved(
    s: Float[Array, "n+1"],
    index: Int[Array, "n+1"],
    fixed: tuple[Int[Array, ""], Float[Array, ""]],
    node: tuple[Int[Array, ""], Float[Array, ""]],
) -> Float[Array, "n+1"]:
    """The nodes with one, given by its number, at a place, and all beyond the last fixed one moved with it."""
    (fixed_node, fixed_place), (nearest, place) = fixed, node
    here = s[nearest]
    # Written so that the same bits come out where the node is there already.
    before = s + (s - fixed_place) * ((place - fixed_place) / (here - fixed_place) - 1)
    beyond = s + (1 - s) * (1 - (1 - place) / (1 - here))
    moved = jnp.where(index <= fixed_node, s, jnp.where(index < nearest, before, beyond))
    return jnp.where(index == nearest, place, moved)
