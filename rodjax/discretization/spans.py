"""What clips make of a form: spans, in each of which a force of its own runs through the rod.

Under given loads the force in every point of a span is known up to one vector, the end force that the span sees: the
force at s = L and the forces of the clips beyond. Each span between two held places has one, the multiplier of its
closure. What a clip applies to the rod is the difference of the forces on its two sides.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.discretization.form import Form
from rodjax.scene import Scene
from rodjax.supports import Held


class SpannedForm(Form):
    """A nondimensional scene with clips; the `end_force` of its points is (3, spans).

    `span_of`: 1 where a cell between two nodes belongs to a span, else 0.
    """

    span_of: Float[Array, "spans n"] = eqx.field(kw_only=True)

    def of_cells(self, end_force: Float[Array, "3 spans"]) -> Float[Array, "3 n"]:
        """The force through each cell besides that of the loads."""
        return end_force @ self.span_of

    @property
    def _closed(self) -> slice:
        """The spans between two held places."""
        count = len(self.scene.clips) + 1
        first = 0 if isinstance(self.scene.start, Held) else 1
        return slice(first, count if isinstance(self.scene.end, Held) else count - 1)

    @property
    def _closures(self) -> int:
        return 3 * (self._closed.stop - self._closed.start)

    def of_force(self, vector: Float[Array, "3 spans"]) -> Float[Array, "c"]:
        return vector[:, self._closed].T.reshape(-1)

    def force_turned(self, point: Any, axis: Float[Array, "3"]) -> Float[Array, "c"]:
        return self.of_force(jnp.cross(axis[:, None], point.end_force, axis=0))

    def force_change(self, closure: Float[Array, "c"]) -> Float[Array, "3 spans"]:
        closed = self._closed
        beyond = len(self.scene.clips) + 1 - closed.stop
        return jnp.pad(closure.reshape(-1, 3).T, ((0, 0), (closed.start, beyond)))


def span_of_cells(scene: Scene, clip_nodes: Int[Array, "clips"], n: int, dtype: Any) -> Float[Array, "spans n"]:
    """1 where one of n cells belongs to a span, else 0."""
    span = jnp.sum(jnp.arange(n)[None] >= clip_nodes[:, None], axis=0)
    spans = jnp.arange(len(scene.clips) + 1)
    return (span[None] == spans[:, None]).astype(dtype)


def held_places(
    scene: Scene, s: Float[Array, "n+1"], clip_nodes: Int[Array, "clips"] | None
) -> tuple[Float[Array, "3 h"], Int[Array, "h"]]:
    """The positions that are held along the rod, and the numbers of the nodes there."""
    start, end = scene.start, scene.end
    nodes = jnp.zeros(0, int) if clip_nodes is None else clip_nodes
    positions = [clip.position for clip in scene.clips]
    if isinstance(start, Held):
        positions, nodes = [start.position, *positions], jnp.pad(nodes, (1, 0))
    if isinstance(end, Held):
        positions = [*positions, end.position]
        nodes = jnp.pad(nodes, (0, 1), constant_values=len(s) - 1)
    return jnp.stack(positions, axis=1), nodes


def nodes_along(
    edges: Float[Array, "n 3"], s: Float[Array, "n+1"], positions: Float[Array, "3 h"], held: Int[Array, "h"]
) -> Float[Array, "n+1 3"]:
    """Nodes at the arclengths `s` along the edges, at held places to the last digit."""
    nodes = jnp.concatenate([jnp.zeros((1, 3), edges.dtype), jnp.cumsum(edges, axis=0)])
    missing = positions.T - nodes[held]
    # Beyond the last held place all of the rod goes with it.
    nodes += jax.vmap(lambda component: jnp.interp(s, s[held], component), 1, 1)(missing)
    return nodes.at[held].set(positions.T)
