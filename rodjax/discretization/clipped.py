"""A rod in clips: the mixed form with a force of its own in each span.

Clips part the rod into spans. Under dead loads the force in every point of a span is known up to one vector, the end
force that the span sees: the force at s = L and the forces of the clips beyond. Each span between two held places has
one, the multiplier of its closure, so that the system of `mixed` has a wider border and nothing else changes. What a
clip applies to the rod is the difference of the forces on its two sides.

Tension jumps at a clip. So what belongs to stretch is summed over the cells between nodes, with the force on their side
of each point. A clip that holds the tangent takes the rotations of its node, as a clamp does at an end.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.form import FLOOR_SAFETY
from rodjax.discretization.mixed import MixedForm, MixedPoint, Stretched
from rodjax.discretization.tangent_field import TangentField
from rodjax.energy import axial_strain_under, density
from rodjax.scene import Scene, held_position
from rodjax.supports import Free, Held
from rodjax.vectors import dot


class ClippedForm(MixedForm):
    """A nondimensional scene with clips on a field of tangents; the `end_force` of its points is (3, spans).

    `side_forces`: as `forces_beyond`, by cells; `span_of`: 1 where a cell belongs to a span, else 0.
    """

    side_forces: Float[Array, "3 p n"] = eqx.field(kw_only=True)
    span_of: Float[Array, "spans n"] = eqx.field(kw_only=True)

    @classmethod
    def of(cls, scene: Scene, field: TangentField) -> "ClippedForm":
        side_forces = field.side_forces(scene)
        forces_beyond = field.of_points(field.side_weights[None] * side_forces) / field.weights[None]
        assert field.clip_nodes is not None
        cells = jnp.arange(side_forces.shape[-1])
        span = jnp.sum(cells[None] >= field.clip_nodes[:, None], axis=0)
        spans = jnp.arange(len(scene.clips) + 1)
        return cls(
            scene=scene,
            field=field,
            forces_beyond=forces_beyond,
            force_spread=None,
            side_forces=side_forces,
            span_of=(span[None] == spans[:, None]).astype(forces_beyond.dtype),
        )

    # --- spans -------------------------------------------------------------------------------------------------------

    @property
    def _closed(self) -> slice:
        """The spans between two held places."""
        count = len(self.scene.clips) + 1
        first = 0 if isinstance(self.scene.start, Held) else 1
        return slice(first, count if isinstance(self.scene.end, Held) else count - 1)

    @property
    def _closures(self) -> int:
        return 3 * (self._closed.stop - self._closed.start)

    @property
    def _held(self) -> tuple[Float[Array, "3 h"], Int[Array, "h"]]:
        """The positions that are held along the rod, and the numbers of the nodes there."""
        start, end, nodes = self.scene.start, self.scene.end, self.field.clip_nodes
        assert nodes is not None
        positions = [clip.position for clip in self.scene.clips]
        if isinstance(start, Held):
            positions, nodes = [start.position, *positions], jnp.pad(nodes, (1, 0))
        if isinstance(end, Held):
            positions = [*positions, end.position]
            nodes = jnp.pad(nodes, (0, 1), constant_values=len(self.field.s) - 1)
        return jnp.stack(positions, axis=1), nodes

    def of_force(self, vector: Float[Array, "3 spans"]) -> Float[Array, "c"]:
        return vector[:, self._closed].T.reshape(-1)

    def force_turned(self, point: MixedPoint, axis: Float[Array, "3"]) -> Float[Array, "c"]:
        return self.of_force(jnp.cross(axis[:, None], point.end_force, axis=0))

    def force_change(self, closure: Float[Array, "c"]) -> Float[Array, "3 spans"]:
        closed = self._closed
        beyond = len(self.scene.clips) + 1 - closed.stop
        return jnp.pad(closure.reshape(-1, 3).T, ((0, 0), (closed.start, beyond)))

    def with_end_force(self, point: MixedPoint, loads: Float[Array, "3 *c n"]) -> Float[Array, "3 *c n"]:
        of_cells = point.end_force @ self.span_of
        return of_cells.reshape(3, *[1] * (loads.ndim - 2), -1) + loads

    def along_spans(self, ways: Float[Array, "3 n"]) -> Float[Array, "3 spans"]:
        return ways @ self.span_of.T

    def nodes(self, edges: Float[Array, "n 3"]) -> Float[Array, "n+1 3"]:
        """Nodes along the edges, at held places to the last digit."""
        positions, held = self._held
        nodes = jnp.concatenate([jnp.zeros((1, 3), edges.dtype), jnp.cumsum(edges, axis=0)])
        missing = positions.T - nodes[held]
        # Beyond the last held place all of the rod goes with it.
        s = self.field.s
        nodes += jax.vmap(lambda component: jnp.interp(s, s[held], component), 1, 1)(missing)
        return nodes.at[held].set(positions.T)

    def end_forces(self, point: MixedPoint) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The section forces at s = 0 and s = L."""
        start, end = self.scene.start, self.scene.end
        first, last = point.end_force[:, 0], point.end_force[:, -1]
        total = total_force(self.scene)
        if isinstance(end, Free):
            return first + total, jnp.zeros_like(total) if end.force is None else end.force
        if isinstance(start, Free):
            return jnp.zeros_like(total) if start.force is None else -start.force, last - total
        return first + total, last

    def axial_forces(self, point: MixedPoint) -> Float[Array, "slides"]:
        """What the sliding clips apply to the rod along its tangent."""
        forces = point.end_force[:, :-1] - point.end_force[:, 1:]
        along = dot(forces, self.field.tangents_in_clips(self.scene, point.tangents))
        return along[np.array([k for k, clip in enumerate(self.scene.clips) if clip.sliding])]

    # --- stretch, by cells -------------------------------------------------------------------------------------------

    def _by_sides(
        self, tangents: Float[Array, "3 m"], end_force: Float[Array, "3 spans"]
    ) -> tuple[Float[Array, "3 p n"], Float[Array, "p n"]]:
        """The forces, and the tensions under them."""
        forces = (end_force @ self.span_of)[:, None] + self.side_forces
        return forces, dot(forces, self.field.of_sides(tangents))

    def edge_tension(self, point: MixedPoint) -> Float[Array, "m"]:
        _, tension = self._by_sides(point.tangents, point.end_force)
        return self.field.of_points(self.field.side_weights * tension) / self.field.weights

    def edges(self, point: MixedPoint) -> Float[Array, "n 3"]:
        return jnp.sum(self._ways(point), axis=1).T

    def _ways(self, point: MixedPoint) -> Float[Array, "3 p n"]:
        _, tension = self._by_sides(point.tangents, point.end_force)
        lengths = self.field.side_weights * (1 + axial_strain_under(self.scene.rod, tension))
        return lengths[None] * self.field.of_sides(point.tangents)

    def load_energy(self, point: MixedPoint) -> Float[Array, ""]:
        return -jnp.sum(self.side_forces * self._ways(point)) - jnp.sum(
            total_force(self.scene) * held_position(self.scene)
        )

    def elastic_energy(self, point: MixedPoint) -> Float[Array, ""]:
        rod = self.scene.rod
        _, tension = self._by_sides(point.tangents, point.end_force)
        stretching = density(rod, axial_strain=axial_strain_under(rod, tension))
        bending = self.field.bending_energy(self.scene, point.tangents)
        return bending + jnp.sum(self.field.side_weights * stretching) + density(rod, twist=point.total_twist)

    def _stretched(
        self,
        point: MixedPoint,
        bases: Float[Array, "3 b m"],
        weights: Float[Array, "m"],
        energy: Float[Array, ""],
        gradient: Float[Array, "b m"],
        diagonal: Float[Array, "b b m"],
    ) -> Stretched:
        rod, field = self.scene.rod, self.field
        weights = field.side_weights
        forces, tension = self._by_sides(point.tangents, point.end_force)
        strain, softness = jax.jvp(
            lambda tension: axial_strain_under(rod, tension), (tension,), (jnp.ones_like(tension),)
        )
        lengths, softness = weights * (1 + strain), weights * softness
        along, directions = field.of_sides(point.tangents), field.of_sides(bases)
        across = jnp.sum(directions * forces[:, None], axis=0)
        gradient -= field.of_points(lengths[None] * across)
        identity = jnp.eye(bases.shape[1], dtype=energy.dtype)[..., None]
        diagonal += field.of_points(lengths * tension)[None, None] * identity
        diagonal -= field.of_points(softness[None, None] * across[:, None] * across[None])
        energy += jnp.sum(weights * (density(rod, axial_strain=strain) - tension * (1 + strain)))

        span_of = self.span_of[self._closed]
        positions, _ = self._held
        spans = jnp.diff(positions, axis=1)
        energy += jnp.sum(point.end_force[:, self._closed] * spans)
        lacking = spans - jnp.sum(lengths[None] * along, axis=1) @ span_of.T
        # By the rotations of a point, and the components of the force of a span.
        by_force = -lengths[None, None] * jnp.swapaxes(directions, 0, 1)
        by_force -= softness[None, None] * across[:, None] * along[None]
        border = field.of_points(by_force[:, None] * span_of[None, :, None, None])
        b, _, _, m = border.shape
        c = self._closures
        blocks = jnp.einsum("ipn,jpn,sn->sij", softness[None] * along, along, span_of)
        compliance = jax.scipy.linalg.block_diag(*blocks)
        return Stretched(
            energy,
            gradient,
            diagonal,
            field.of_points(lengths),
            border.reshape(b, c, m),
            lacking.T.reshape(-1),
            compliance,
        )

    def under_force(
        self,
        point: MixedPoint,
        bases: Float[Array, "3 b m"],
        rotation: Float[Array, "b m"],
        change: Float[Array, "3 spans"],
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        rod, weights = self.scene.rod, self.field.side_weights
        positions, _ = self._held
        spans = jnp.diff(positions, axis=1)

        def parts(tangents: Float[Array, "3 m"], force: Float[Array, "3 spans"]) -> tuple[Array, Array]:
            _, tension = self._by_sides(tangents, force)
            strain = axial_strain_under(rod, tension)
            stretching = weights * (density(rod, axial_strain=strain) - tension * (1 + strain))
            ways = jnp.sum((weights * (1 + strain))[None] * self.field.of_sides(tangents), axis=1)
            lacking = spans - self.along_spans(ways)[:, self._closed]
            return jnp.sum(stretching) + jnp.sum(force[:, self._closed] * spans), lacking.T.reshape(-1)

        turning = jnp.sum(bases * rotation[None], axis=1)

        def rates(force: Float[Array, "3 spans"]):
            return jax.jvp(lambda tangents: parts(tangents, force), (point.tangents,), (turning,))

        (energy, closure), (rate, closure_rate) = rates(point.end_force + change)
        (before, _), (rate_before, _) = rates(point.end_force)
        return closure, closure_rate, energy - before, rate - rate_before

    def rounding_floor(self, point: MixedPoint) -> Float[Array, ""]:
        forces, _ = self._by_sides(point.tangents, point.end_force)
        largest = jnp.max(jnp.abs(forces))
        eps = jnp.finfo(largest.dtype).eps
        return FLOOR_SAFETY * eps * (4.0 * largest + 4.0 / self.field.finest**2)
