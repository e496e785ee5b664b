"""Tangents of the edges of a polyline: the finite differences of Linn & Stephan (2008), of second order."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.dead_loads import forces_beyond_edges, forces_on_nodes
from rodjax.discretization.joints import (
    Joints,
    bending_derivatives,
    joints,
    of_edges,
    scatter_add,
    tangent_bases,
    twist_derivatives,
    with_held_tangents,
)
from rodjax.discretization.nodes import held_nodes, with_nodes_at_clips
from rodjax.discretization.tangent_field import Blocks
from rodjax.discretization.twist import angle_about, carried_in_bases, swept_twist, turns_of_bases
from rodjax.geometry.vectors import dot
from rodjax.mechanics.energy import curvature_under, density
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Directed, Free, Held


class EdgeTangents(eqx.Module):
    """n edges, of which each is a point; bending and torsion live in the joints between them.

    The edges are equal but for clips, each of which has a node: then `arclengths` are those of the nodes, and
    `clip_nodes` the numbers of those at the clips. Where a clip holds the tangent it parts its joint into two halves.
    """

    weights: Float[Array, "n"]
    arclengths: Float[Array, "n+1"] | None = None
    clip_nodes: Int[Array, "clips"] | None = None

    @staticmethod
    def of(scene: Scene, segments: int) -> "EdgeTangents":
        dtype = scene.rod.length.dtype
        if not scene.clips:
            return EdgeTangents(jnp.full(segments, 1 / segments, dtype))
        s, clip_nodes = with_nodes_at_clips(scene, jnp.linspace(0.0, 1.0, segments + 1, dtype=dtype), [])
        return EdgeTangents(jnp.diff(s), s, clip_nodes)

    @property
    def segments(self) -> int:
        return len(self.weights)

    @property
    def s(self) -> Float[Array, "n+1"]:
        if self.arclengths is not None:
            return self.arclengths
        return jnp.linspace(0.0, 1.0, self.segments + 1, dtype=self.weights.dtype)

    @property
    def finest(self) -> Float[Array, ""]:
        return self.weights[0] if self.arclengths is None else jnp.min(self.weights)

    def append_prescribed(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, "3 k"]:
        return with_held_tangents(scene, tangents)

    def apply_prescribed(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        return tangents

    def basis(self, scene: Scene, bases: Float[Array, "3 b k"]) -> Float[Array, "3 b n"]:
        return of_edges(scene, bases, self.segments)

    def held(self, scene: Scene, diagonal: Float[Array, "b b n"]) -> Float[Array, "b b n"]:
        return diagonal

    def bending_energy(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, ""]:
        energy = self._bending_energy(scene, tangents)
        for end, edge in ((scene.start, 0), (scene.end, -1)):
            if isinstance(end, Free) and end.moment is not None:  # bends the half edge there
                curvature = curvature_under(scene.rod, jnp.cross(end.moment, tangents[:, edge]))
                energy += self.finest / 2 * density(scene.rod, squared_curvature=jnp.sum(curvature**2))
        return energy

    def _bending_energy(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, ""]:
        between = self.joints(scene, tangents)
        if self.clip_nodes is None:
            return between.bending_energy(scene.rod)
        whole = between.spacing * density(scene.rod, squared_curvature=between.squared_curvature)
        energy = jnp.sum(jnp.where(self._is_interrupted(scene), 0.0, whole))
        for _, halves in self.halves(scene, tangents):
            energy += halves.bending_energy(scene.rod)
        return energy

    def joints(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Joints:
        return joints(scene, tangents, None if self.arclengths is None else self.weights)

    def _is_interrupted(self, scene: Scene) -> Bool[Array, "k"]:
        """Which joints a clip parts that holds the tangent."""
        first = int(not isinstance(scene.start, Directed))  # the number of the node of the first joint
        count = self.segments - 1 + int(isinstance(scene.start, Directed)) + int(isinstance(scene.end, Directed))
        nodes = jnp.arange(count) + first
        is_interrupted = jnp.zeros(count, bool)
        for held in held_nodes(scene, self.clip_nodes):
            is_interrupted |= nodes == held.node
        return is_interrupted

    def halves(self, scene: Scene, tangents: Float[Array, "3 n"]) -> list[tuple[Int[Array, ""], Joints]]:
        """Of each clip that holds the tangent the edge behind it, and the joints of the edges beside with the clip."""
        found = []
        for _, edge, tangent in held_nodes(scene, self.clip_nodes):
            before = jnp.stack([tangents[:, edge - 1], tangent], axis=1)
            after = jnp.stack([tangent, tangents[:, edge]], axis=1)
            spacing = jnp.stack([self.weights[edge - 1], self.weights[edge]]) / 2
            found.append((edge, Joints(before, after, spacing)))
        return found

    def bending(
        self, scene: Scene, tangents: Float[Array, "3 n"], bases: Float[Array, "3 b k"]
    ) -> tuple[Float[Array, ""], Blocks]:
        between = self.joints(scene, tangents)
        derivatives = bending_derivatives(scene.rod, between, (bases[..., :-1], bases[..., 1:]))
        if self.clip_nodes is None:
            return between.bending_energy(scene.rod), self._blocks(*scatter_add(scene, derivatives, self.segments))
        is_interrupted = self._is_interrupted(scene)
        derivatives = jax.tree.map(lambda derivative: jnp.where(is_interrupted, 0.0, derivative), derivatives)
        gradient, diagonal, lower = scatter_add(scene, derivatives, self.segments)
        of_edges = self.basis(scene, bases)
        for edge, halves in self.halves(scene, tangents):
            # The tangent of the clip does not turn.
            beside = jnp.stack([of_edges[..., edge - 1], of_edges[..., edge]], axis=-1)
            half = bending_derivatives(scene.rod, halves, (beside, beside))
            gradient = gradient.at[:, edge - 1].add(half.before[:, 0]).at[:, edge].add(half.after[:, 1])
            diagonal = diagonal.at[..., edge - 1].add(half.before_before[..., 0])
            diagonal = diagonal.at[..., edge].add(half.after_after[..., 1])
        return self._bending_energy(scene, tangents), self._blocks(gradient, diagonal, lower)

    def twist(self, scene: Scene, tangents: Float[Array, "3 n"], bases: Float[Array, "3 b k"]) -> Blocks:
        derivatives = twist_derivatives(self.joints(scene, tangents), (bases[..., :-1], bases[..., 1:]))
        return self._blocks(*scatter_add(scene, derivatives, self.segments))

    def _blocks(
        self, gradient: Float[Array, "b n"], diagonal: Float[Array, "b b n"], lower: Float[Array, "b b n-1"]
    ) -> Blocks:
        return Blocks(self.gather(gradient), self.gather(diagonal), lower)

    def swept(self, scene: Scene, old: Float[Array, "3 n"], new: Float[Array, "3 n"]) -> Float[Array, ""]:
        return swept_twist(with_held_tangents(scene, old), with_held_tangents(scene, new))

    def principal_twist(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, ""]:
        assert isinstance(scene.start, Clamp)
        assert isinstance(scene.end, Clamp)
        held = with_held_tangents(scene, tangents)
        bases = tangent_bases(held)
        turned = jnp.sum(turns_of_bases(held, bases), keepdims=True)
        carried = carried_in_bases(scene.start.frame[:, 0], bases, turned)[:, 0]
        return angle_about(held[:, -1], carried, scene.end.frame[:, 0])

    @property
    def quadrature_weights(self) -> Float[Array, "1 n"]:
        return self.weights[None]

    def tangents_at_nodes(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, "3 n-1"]:
        """At the nodes between the ends: on the arc between those of the edges beside, or as a clip holds it."""
        if self.arclengths is None:
            inner = tangents[:, :-1] + tangents[:, 1:]
        else:
            inner = self.weights[None, 1:] * tangents[:, :-1] + self.weights[None, :-1] * tangents[:, 1:]
        inner /= jnp.sqrt(dot(inner, inner))[None]
        for _, node, tangent in held_nodes(scene, self.clip_nodes):
            inner = inner.at[:, node - 1].set(tangent)
        return inner

    def tangents_in_clips(self, scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, "3 clips"]:
        assert self.clip_nodes is not None
        return self.tangents_at_nodes(scene, tangents)[:, self.clip_nodes - 1]

    def gather(self, by_point: Float[Array, "... n"]) -> Float[Array, "... 1 n"]:
        return by_point[..., None, :]

    def scatter_add(self, by_side: Float[Array, "... 1 n"]) -> Float[Array, "... n"]:
        return by_side[..., 0, :]

    def loads_beyond(self, scene: Scene) -> Float[Array, "3 1 n"]:
        on_nodes = forces_on_nodes(scene, self.segments, self.arclengths).T
        return forces_beyond_edges(scene, on_nodes, self.clip_nodes)[:, None]

    def residual(self, scene: Scene, gradient: Float[Array, "3 n"], lengths: Float[Array, "n"]) -> Float[Array, ""]:
        """Largest component of the force on a free node."""
        edge_forces = gradient / lengths[None]
        beyond = jnp.zeros_like(edge_forces[:, :1])
        if not isinstance(scene.start, Held):
            edge_forces = jnp.concatenate([beyond, edge_forces], axis=1)
        if not isinstance(scene.end, Held):
            edge_forces = jnp.concatenate([edge_forces, beyond], axis=1)
        return jnp.max(jnp.abs(jnp.diff(edge_forces, axis=1)))
