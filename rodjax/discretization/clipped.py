"""A rod in clips: the mixed form with a force of its own in each span.

Clips part the rod into spans (`spans`), so that the system of `mixed` has a wider border and nothing else changes. A
clip that holds the tangent takes the rotations of its node, as a clamp does at an end.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.discretization.mixed import MixedPoint, Stretched
from rodjax.discretization.parted import PartedForm
from rodjax.discretization.spans import SpannedForm, span_of_cells
from rodjax.discretization.tangent_field import TangentField
from rodjax.energy import axial_strain_under, density
from rodjax.scene import Scene
from rodjax.vectors import dot


class ClippedForm(SpannedForm, PartedForm):
    """A nondimensional scene with clips on a field of tangents."""

    @classmethod
    def of(cls, scene: Scene, field: TangentField) -> "ClippedForm":
        side_forces = field.side_forces(scene)
        forces_beyond = field.of_points(field.side_weights[None] * side_forces) / field.weights[None]
        assert field.clip_nodes is not None
        return cls(
            scene=scene,
            field=field,
            forces_beyond=forces_beyond,
            force_spread=None,
            side_forces=side_forces,
            span_of=span_of_cells(scene, field.clip_nodes, side_forces.shape[-1], forces_beyond.dtype),
        )

    def along_spans(self, ways: Float[Array, "3 n"]) -> Float[Array, "3 spans"]:
        return ways @ self.span_of.T

    def axial_forces(self, point: MixedPoint) -> Float[Array, "slides"]:
        """What the sliding clips apply to the rod along its tangent."""
        forces = point.end_force[:, :-1] - point.end_force[:, 1:]
        along = dot(forces, self.field.tangents_in_clips(self.scene, point.tangents))
        return along[np.array([k for k, clip in enumerate(self.scene.clips) if clip.sliding])]

    def _stretched(
        self,
        point: MixedPoint,
        bases: Float[Array, "3 b m"],
        weights: Float[Array, "m"],
        energy: Float[Array, ""],
        gradient: Float[Array, "b m"],
        diagonal: Float[Array, "b b m"],
    ) -> Stretched:
        field = self.field
        cells = self._by_cells(point, bases, gradient, diagonal)
        energy += cells.energy
        span_of = self.span_of[self._closed]
        positions, _ = self.held_places
        spans = jnp.diff(positions, axis=1)
        energy += jnp.sum(point.end_force[:, self._closed] * spans)
        lacking = spans - jnp.sum(cells.lengths[None] * cells.along, axis=1) @ span_of.T
        # By the rotations of a point, and the components of the force of a span.
        border = field.of_points(cells.by_force[:, None] * span_of[None, :, None, None])
        b, _, _, m = border.shape
        c = self._closures
        blocks = jnp.einsum("ipn,jpn,sn->sij", cells.softness[None] * cells.along, cells.along, span_of)
        compliance = jax.scipy.linalg.block_diag(*blocks)
        return Stretched(
            energy,
            cells.gradient,
            cells.diagonal,
            field.of_points(cells.lengths),
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
        positions, _ = self.held_places
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
