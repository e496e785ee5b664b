"""Tangents of the edges of a polyline: the finite differences of the report, of second order."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.dead_loads import forces_beyond_edges, forces_on_nodes
from rodjax.discretization.joints import (
    assembled,
    bending_derivatives,
    joints,
    of_edges,
    twist_derivatives,
    with_held_tangents,
)
from rodjax.discretization.tangent_field import Blocks
from rodjax.discretization.twist import angle_about, swept_twist, transport_along
from rodjax.energy import density
from rodjax.scene import Scene
from rodjax.supports import Clamp, Free, Held


class EdgeTangents(eqx.Module):
    """n equal edges, of which each is a point; bending and torsion live in the joints between them."""

    weights: Float[Array, "n"]

    @staticmethod
    def of(scene: Scene, segments: int) -> "EdgeTangents":
        return EdgeTangents(jnp.full(segments, 1 / segments, scene.rod.length.dtype))

    @property
    def segments(self) -> int:
        return len(self.weights)

    @property
    def s(self) -> Float[Array, "n+1"]:
        return jnp.linspace(0.0, 1.0, self.segments + 1, dtype=self.weights.dtype)

    @property
    def finest(self) -> Float[Array, ""]:
        return self.weights[0]

    def with_held(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, "3 k"]:
        return with_held_tangents(scene, tangents)

    def as_held(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        return tangents

    def basis(self, scene: Scene, bases: Float[Array, "3 b k"]) -> Float[Array, "3 b n"]:
        return of_edges(scene, bases, self.segments)

    def held(self, scene: Scene, diagonal: Float[Array, "b b n"]) -> Float[Array, "b b n"]:
        return diagonal

    def bending_energy(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, ""]:
        energy = joints(scene, tangents).bending_energy(scene.rod)
        for end, edge in ((scene.start, 0), (scene.end, -1)):
            if isinstance(end, Free) and end.moment is not None:  # bends the half edge there
                curvature = jnp.cross(end.moment, tangents[:, edge]) / scene.rod.EI
                energy += self.finest / 2 * density(scene.rod, squared_curvature=jnp.sum(curvature**2))
        return energy

    def bending(
        self, scene: Scene, tangents: Float[Array, "3 n"], bases: Float[Array, "3 b k"]
    ) -> tuple[Float[Array, ""], Blocks]:
        between = joints(scene, tangents)
        derivatives = bending_derivatives(scene.rod, between, (bases[..., :-1], bases[..., 1:]))
        return between.bending_energy(scene.rod), Blocks(*assembled(scene, derivatives, self.segments))

    def twist(self, scene: Scene, tangents: Float[Array, "3 n"], bases: Float[Array, "3 b k"]) -> Blocks:
        derivatives = twist_derivatives(joints(scene, tangents), (bases[..., :-1], bases[..., 1:]))
        return Blocks(*assembled(scene, derivatives, self.segments))

    def swept(self, scene: Scene, old: Float[Array, "3 n"], new: Float[Array, "3 n"]) -> Float[Array, ""]:
        return swept_twist(with_held_tangents(scene, old), with_held_tangents(scene, new))

    def principal_twist(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, ""]:
        assert isinstance(scene.start, Clamp)
        assert isinstance(scene.end, Clamp)
        held = with_held_tangents(scene, tangents)
        return angle_about(held[:, -1], transport_along(scene.start.frame[:, 0], held)[:, -1], scene.end.frame[:, 0])

    def ways(self, slopes: Float[Array, "3 n"]) -> Float[Array, "n 3"]:
        return slopes.T / self.segments

    def forces_beyond(self, scene: Scene) -> Float[Array, "3 n"]:
        return forces_beyond_edges(scene, forces_on_nodes(scene, self.segments).T)

    def force_spread(self, scene: Scene) -> None:
        return None

    def ways_of_spread(
        self, scene: Scene, tangents: Float[Array, "3 n"], softness: Float[Array, "n"]
    ) -> Float[Array, "n 3"]:
        return jnp.zeros_like(tangents.T)

    def residual(self, scene: Scene, gradient: Float[Array, "3 n"], lengths: Float[Array, "n"]) -> Float[Array, ""]:
        """Largest component of the force on a free node."""
        edge_forces = gradient / lengths[None]
        beyond = jnp.zeros_like(edge_forces[:, :1])
        if not isinstance(scene.start, Held):
            edge_forces = jnp.concatenate([beyond, edge_forces], axis=1)
        if not isinstance(scene.end, Held):
            edge_forces = jnp.concatenate([edge_forces, beyond], axis=1)
        return jnp.max(jnp.abs(jnp.diff(edge_forces, axis=1)))
