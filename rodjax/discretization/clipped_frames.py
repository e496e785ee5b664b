"""A rod in clips whose frames are unknown: the form of `framed` with a force of its own in each span (`spans`).

A clip holds a node, where it holds the direction of the rod two of the three rotations of the frame there, and where it
holds the twist all three, as a clamp does at an end. Elements only.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.discretization.cells import Cells, ElementCells
from rodjax.discretization.framed import FrameForm, FramePoint, HeldFrame
from rodjax.discretization.framed_parts import parts_of
from rodjax.discretization.nodes import held_nodes
from rodjax.discretization.spans import SpannedForm, held_places, nodes_along, span_of_cells
from rodjax.scene import Scene
from rodjax.supports import Free


class ClippedFrameForm(SpannedForm, FrameForm):
    """A nondimensional scene with clips on elements, as a function of a `FramePoint`."""

    @classmethod
    def of(cls, scene: Scene, field: Cells) -> "ClippedFrameForm":
        parts = parts_of(scene, field)
        loads = parts["loads"]
        assert isinstance(field, ElementCells)
        assert field.clip_nodes is not None
        return cls(**parts, span_of=span_of_cells(scene, field.clip_nodes, loads.shape[-1], loads.dtype))

    @property
    def clip_nodes(self) -> Int[Array, "clips"]:
        assert isinstance(self.field, ElementCells)
        assert self.field.clip_nodes is not None
        return self.field.clip_nodes

    @property
    def held_frames(self) -> list[HeldFrame]:
        clips = self.scene.clips
        of_clips = [
            HeldFrame(2 * held.node, held.tangent, clips[held.clip].frame)
            for held in held_nodes(self.scene, self.clip_nodes)
        ]
        return super().held_frames + of_clips

    @property
    def held_places(self) -> tuple[Float[Array, "3 h"], Int[Array, "h"]]:
        """The positions that are held along the rod, and the numbers of the nodes there."""
        return held_places(self.scene, self.field.s, self.clip_nodes)

    def nodes(self, edges: Float[Array, "n 3"]) -> Float[Array, "n+1 3"]:
        """Nodes along the edges, at held places to the last digit."""
        return nodes_along(edges, self.field.s, *self.held_places)

    def end_forces(self, point: FramePoint) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The section forces at s = 0 and s = L."""
        total, given = self._loads_on_all(point.quaternions)
        first, last = point.end_force[:, 0], point.end_force[:, -1]
        if isinstance(self.scene.start, Free):
            return -given, last - total
        return first + total, given if isinstance(self.scene.end, Free) else last

    # --- spans -------------------------------------------------------------------------------------------------------

    def through(self, end_force: Float[Array, "3 spans"]) -> Float[Array, "3 1 n"]:
        return self.of_cells(end_force)[:, None]

    @property
    def spans(self) -> Float[Array, "3 spans"]:
        """Those that are not between held places have none."""
        positions, _ = self.held_places
        closed = self._closed
        return jnp.pad(jnp.diff(positions, axis=1), ((0, 0), (closed.start, len(self.span_of) - closed.stop)))

    def along_spans(self, ways: Float[Array, "3 n"]) -> Float[Array, "3 spans"]:
        return ways @ self.span_of.T

    def by_spans(self, by_cell: Float[Array, "3 3 p n"]) -> Float[Array, "3 c p n"]:
        spans = by_cell[:, None] * self.span_of[self._closed][None, :, None, None]
        return spans.reshape(3, self._closures, *by_cell.shape[2:])

    def compliance(self, by_cell: Float[Array, "3 3 n"]) -> Float[Array, "c c"]:
        blocks = jnp.einsum("ijn,sn->sij", by_cell, self.span_of[self._closed])
        return jax.scipy.linalg.block_diag(*blocks)
