"""Which unknown forces run through a rod: one in each span between places that are held, or one in each cell.

Under given loads the force through a rod is known up to one vector for each span, the force at s = L and those of the
clips beyond: the multipliers by which the spans reach from one held place to the next. A rod without clips is a rod of
one span. What a clip applies to the rod is the difference of the forces on its two sides. Where something pushes along
the rod, each cell has a force of its own.

A cell lies between two neighbouring nodes; forces are (3, parts), one column for each span or cell.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.linalg.blocks import partial_sums
from rodjax.model.scene import Scene, has_node_positions
from rodjax.model.supports import Held

# Of a cell of a rod in a plane, along the normal of that [L^3/EI]. Where contacts are as stiff as 1e10 EI/L^3, one of 1
# leaves the signs of pivots to rounding.
COMPLIANCE_OUT_OF_PLANE = 1e-6


class SpanForces(eqx.Module):
    """One force in each span. Unknown are those of spans between two held places; a span with a free end has none.

    `members`: 1 where a cell belongs to a span, else 0; `None` where there is one span. `axes`: unit vectors along
    which the forces lie, `None` for all of space.
    """

    members: Float[Array, "parts n"] | None
    axes: Float[Array, "3 a"] | None
    parts: int = eqx.field(static=True)
    first: int = eqx.field(static=True)
    stop: int = eqx.field(static=True)

    @staticmethod
    def of(scene: Scene, clip_nodes: Int[Array, "clips"] | None, cells: int) -> "SpanForces":
        parts = len(scene.clips) + 1
        members = None
        if scene.clips:
            assert clip_nodes is not None
            span = jnp.sum(jnp.arange(cells)[None] >= clip_nodes[:, None], axis=0)
            members = (span[None] == jnp.arange(parts)[:, None]).astype(scene.rod.length.dtype)
        first = 0 if isinstance(scene.start, Held) else 1
        stop = parts if isinstance(scene.end, Held) else parts - 1
        return SpanForces(members, None, parts, first, max(first, stop))

    def in_axes(self, axes: Float[Array, "3 a"] | None) -> "SpanForces":
        return dataclasses.replace(self, axes=axes)

    @property
    def closed(self) -> slice:
        """The spans between two held places."""
        return slice(self.first, self.stop)

    @property
    def size(self) -> int:
        """The number of unknown components."""
        return (3 if self.axes is None else self.axes.shape[1]) * (self.stop - self.first)

    def gather(self, forces: Float[Array, "3 parts"]) -> Float[Array, "3 n"] | Float[Array, "3 1"]:
        """The force through each cell; one column where all have the same."""
        return forces if self.members is None else forces @ self.members

    def sums(self, by_cell: Float[Array, "c n"]) -> Float[Array, "c parts"]:
        """Over the cells of each span."""
        return jnp.sum(by_cell, axis=1, keepdims=True) if self.members is None else by_cell @ self.members.T

    def components(self, forces: Float[Array, "3 parts"]) -> Float[Array, "size"]:
        """Those that are unknown."""
        closed = forces[:, self.closed]
        return (closed if self.axes is None else self.axes.T @ closed).T.reshape(-1)

    def forces(self, components: Float[Array, "size"]) -> Float[Array, "3 parts"]:
        """The forces with these components, and zeros elsewhere."""
        count = self.stop - self.first
        if not count:
            return jnp.zeros((3, self.parts), components.dtype)
        closed = components.reshape(count, -1).T
        closed = closed if self.axes is None else self.axes @ closed
        return closed if count == self.parts else jnp.pad(closed, ((0, 0), (self.first, self.parts - self.stop)))

    def columns(self, by_cell: Float[Array, "b 3 p n"]) -> Float[Array, "b size p n"]:
        """Derivatives by the unknown components, of those by the force through each cell."""
        if self.axes is not None:
            by_cell = jnp.sum(by_cell[:, :, None] * self.axes[None, :, :, None, None], axis=1)
        if self.members is None:
            return by_cell[:, : self.size]
        spans = by_cell[:, None] * self.members[self.closed][None, :, None, None]
        return spans.reshape(by_cell.shape[0], self.size, *by_cell.shape[2:])

    def spans(self, positions: Float[Array, "3 h"]) -> Float[Array, "3 parts"]:
        """The vectors from each held place to the next; zero for a span with a free end."""
        return jnp.pad(jnp.diff(positions, axis=1), ((0, 0), (self.first, self.parts - self.stop)))

    def compliance(self, by_cell: Float[Array, "3 3 n"]) -> Float[Array, "size size"]:
        """By the unknown components: sums over the cells of each span, which know of no force but their own."""
        if not self.size:
            return jnp.zeros((0, 0), by_cell.dtype)
        if self.members is None:
            total = jnp.sum(by_cell, axis=2)
            return total if self.axes is None else self.axes.T @ total @ self.axes
        blocks = jnp.einsum("ijn,sn->sij", by_cell, self.members[self.closed])
        blocks = blocks if self.axes is None else self.axes.T[None] @ blocks @ self.axes[None]
        return jax.scipy.linalg.block_diag(*blocks)


class CellForces(eqx.Module):
    """One force in each cell, all of them unknown; methods as of `SpanForces`.

    `normal`: of the plane of a rod that stays in one: no force has a component along it.
    """

    parts: int = eqx.field(static=True)
    normal: Float[Array, "3"] | None = None

    def in_axes(self, axes: Float[Array, "3 2"] | None) -> "CellForces":
        return CellForces(self.parts, None if axes is None else jnp.cross(axes[:, 0], axes[:, 1]))

    def compliance(self, by_cell: Float[Array, "3 3 n"]) -> Float[Array, "3 3 n"]:
        """Of each cell; along the normal a small one, which leaves the force there zero."""
        if self.normal is None:
            return by_cell
        return by_cell + COMPLIANCE_OUT_OF_PLANE * (self.normal[:, None] * self.normal[None])[..., None]

    @property
    def size(self) -> int:
        return 3 * self.parts

    def gather(self, forces: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        return forces

    def sums(self, by_cell: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        return by_cell

    def components(self, forces: Float[Array, "3 n"]) -> Float[Array, "3n"]:
        return forces.T.reshape(-1)

    def forces(self, components: Float[Array, "3n"]) -> Float[Array, "3 n"]:
        return components.reshape(-1, 3).T


ForceLayout = SpanForces | CellForces


def held_positions(
    scene: Scene, s: Float[Array, "n+1"], clip_nodes: Int[Array, "clips"] | None
) -> tuple[Float[Array, "3 h"], Int[Array, "h"]]:
    """The positions that are held along the rod, and the numbers of the nodes there."""
    start, end = scene.start, scene.end
    nodes = [] if clip_nodes is None else [*clip_nodes]
    positions = [clip.position for clip in scene.clips]
    if isinstance(start, Held):
        positions, nodes = [start.position, *positions], [0, *nodes]
    if isinstance(end, Held):
        positions, nodes = [*positions, end.position], [*nodes, len(s) - 1]
    if not positions:
        return jnp.zeros((3, 0), s.dtype), jnp.zeros(0, int)
    return jnp.stack(positions, axis=1), jnp.array(nodes)


def nodes_along(
    scene: Scene, s: Float[Array, "n+1"], clip_nodes: Int[Array, "clips"] | None, edges: Float[Array, "n 3"]
) -> Float[Array, "n+1 3"]:
    """Nodes at the arclengths `s` along the edges, at held places to the last digit."""
    positions, held = held_positions(scene, s, clip_nodes)
    nodes = partial_sums(edges.T)
    if not len(held):
        return nodes.T
    missing = positions - jnp.stack([nodes[:, held[k]] for k in range(len(held))], axis=1)
    if len(held) == 1:
        nodes += missing
    elif clip_nodes is None:
        nodes += missing[:, :1] + s[None] * (missing[:, 1:] - missing[:, :1])
    else:
        # Beyond the last held place all of the rod goes with it.
        nodes += jax.vmap(lambda component: jnp.interp(s, s[held], component))(missing)
    number = jnp.arange(len(s))
    for k in range(len(held)):
        nodes = jnp.where(number == held[k], positions[:, k, None], nodes)
    return nodes.T


def from_held(
    scene: Scene, clip_nodes: Int[Array, "clips"] | None, displacements: Float[Array, "3 n+1"]
) -> Float[Array, "3 n+1"]:
    """Displacements that are zero at the start, less that of an end that is held instead, or of the first clip."""
    if isinstance(scene.start, Held):
        return displacements
    if isinstance(scene.end, Held):
        return displacements - displacements[:, -1:]
    return displacements if clip_nodes is None else displacements - displacements[:, clip_nodes[0], None]


def force_parts(scene: Scene, segments: int) -> int:
    """How many forces the layout of a scene has on a mesh."""
    return segments if has_node_positions(scene) else len(scene.clips) + 1


def in_parts(forces: Float[Array, "3 parts"], parts: int) -> Float[Array, "3 others"]:
    """What is known of the forces in another layout: the one at the end in all parts."""
    same = forces.shape[1] == parts
    return forces if same else jnp.broadcast_to(forces[:, -1:], (3, parts))
