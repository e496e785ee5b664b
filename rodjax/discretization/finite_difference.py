"""The report's discretization: central differences and the trapezoidal rule on nodes equally spaced in arclength.

Bending lives at the nodes, stretch on the edges between them. Where an end holds the tangent, the half cell between
the end node, whose tangent is prescribed, and the middle of the first edge has a bending energy of its own: second
order in the spacing, as measured in `docs/design.md`.

Here the unknowns are the nodes, as in the paper; `mixed.MixedForm` is the same discretization in other unknowns.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.dead_loads import forces_beyond_edges, forces_on_nodes, load_energy
from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.first_twist import FirstTwist, twist_on
from rodjax.discretization.form import FLOOR_SAFETY, Form
from rodjax.discretization.joints import (
    bending_derivatives,
    joints,
    of_edges,
    scatter_add,
    tangent_bases,
    with_held_tangents,
)
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.shape import Shape
from rodjax.discretization.twist import (
    FramedTangents,
    TwistReference,
    total_twist,
    twist_under_moment,
)
from rodjax.geometry.interpolation import resampled
from rodjax.geometry.vectors import components, dot
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.saddle_point import AnyFactors, Factors, SaddlePointSystem, factor
from rodjax.mechanics.energy import axial_strain_under, density
from rodjax.mechanics.strain import axial_strain
from rodjax.model.scene import Scene, dead_end_moment, held_at_both_ends
from rodjax.model.supports import Clamp, Directed, Held


class Polyline(Shape):
    """Nodes and the edges between them.

    The edges are kept, not recomputed: as differences of nodes they would be off by the rounding of the positions,
    which a fine mesh turns into forces of eps N^3 EI/L^2. Kept edges leave eps N^2.
    """

    nodes: Float[Array, "n+1 3"]
    edges: Float[Array, "n 3"]

    @staticmethod
    def through(points: Float[Array, "n+1 3"]) -> "Polyline":
        return Polyline(points, jnp.diff(points, axis=0))

    @property
    def lengths(self) -> Float[Array, "n"]:
        return jnp.sqrt(jnp.sum(self.edges**2, axis=1))

    @property
    def tangents(self) -> Float[Array, "3 n"]:
        return self.edges.T / self.lengths[None]

    def point(self, end_force: Float[Array, "3 parts"], total_twist: Float[Array, ""]) -> MixedPoint:
        return MixedPoint(self.tangents, end_force, total_twist)

    def with_unknowns(self, point: MixedPoint) -> "Polyline":
        return self  # whose edges have these tangents already

    def points(self, pieces: int) -> Float[Array, "k 3"]:
        return resampled(self.nodes, pieces)

    def in_units(self, scale: Float[Array, ""], shift: Float[Array, "3"]) -> "Polyline":
        return Polyline(self.nodes * scale + shift[None], self.edges * scale)

    def reached(self, form: Form, point: MixedPoint) -> "Polyline":
        edges = form.edges(point)
        return Polyline(form.nodes(edges), edges)

    def change_to(self, other: Any) -> Float[Array, ""]:
        return jnp.max(jnp.abs(other.edges - self.edges)) * len(self.edges)

    def extrapolated(self, older: Any, ratio: Float[Array, ""]) -> "Polyline":
        tangents = self.tangents + ratio * (self.tangents - older.tangents)
        edges = (tangents * (self.lengths / jnp.sqrt(dot(tangents, tangents)))[None]).T
        offsets = jnp.concatenate([jnp.zeros((1, 3), edges.dtype), jnp.cumsum(edges, axis=0)])
        return Polyline(self.nodes[:1] + offsets, edges)

    def displaced(self, displacement: Float[Array, "n+1 3"]) -> "Polyline":
        return Polyline(self.nodes + displacement, self.edges + jnp.diff(displacement, axis=0))


class Energies(eqx.Module):
    """The parts of the potential energy; absent ones are `None`."""

    bending: Float[Array, ""]
    stretching: Float[Array, ""]
    torsion: Float[Array, ""] | None
    loads: Float[Array, ""] | None

    @property
    def elastic(self) -> Float[Array, ""]:
        return self.bending + self.stretching + (0 if self.torsion is None else self.torsion)

    @property
    def total(self) -> Float[Array, ""]:
        return self.elastic + (0 if self.loads is None else self.loads)


class FiniteDifference(eqx.Module):
    """A nondimensional scene on a polyline: energy, gradient, preconditioner and results as functions of a `Polyline`.

    Displacements in the arguments and results of the public methods are those of the nodes that are free to move,
    (m, 3): the rows for held ends are left out. `reference` is the state from which the total twist is carried;
    `None` in scenes without torsion.
    """

    scene: Scene
    reference: TwistReference | None

    @staticmethod
    def begin(scene: Scene, guess: Polyline, first: FirstTwist) -> tuple["FiniteDifference", Polyline]:
        """The discretized scene, and the polyline from which to seek its solution: the guess moved to the held ends.

        The total twist is, of those which the end frames allow on that polyline, the one carried from the last
        equilibrium or nearest to that of `first`, or that of `scene.turns`.
        """
        polyline = _moved_to_ends(guess, scene)
        return FiniteDifference(scene, twist_reference(scene, guess, polyline, first)), polyline

    # --- unknowns: the one place that knows which nodes move -------------------------------------------------------

    def _all_nodes(self, displacement: Float[Array, "m 3"]) -> Float[Array, "n+1 3"]:
        held = (isinstance(self.scene.start, Held), isinstance(self.scene.end, Held))
        return jnp.pad(displacement, ((int(held[0]), int(held[1])), (0, 0)))

    def _free_nodes(self, rows: Float[Array, "n+1 ..."]) -> Float[Array, "m ..."]:
        first = int(isinstance(self.scene.start, Held))
        return rows[first : len(rows) - int(isinstance(self.scene.end, Held))]

    def displaced(self, polyline: Polyline, displacement: Float[Array, "m 3"]) -> Polyline:
        return polyline.displaced(self._all_nodes(displacement))

    def reference_at(self, polyline: Polyline) -> TwistReference | None:
        """This polyline as the reference of the total twist: no tangent may turn by pi from it."""
        if self.reference is None:
            return None
        return TwistReference(_framed_tangents(self.scene, polyline), self.total_twist(polyline))

    def with_reference(self, reference: TwistReference | None) -> "FiniteDifference":
        return FiniteDifference(self.scene, reference)

    # --- energy ----------------------------------------------------------------------------------------------------

    def energies(self, polyline: Polyline) -> Energies:
        rod = self.scene.rod
        n = len(polyline.edges)
        stretching = jnp.mean(density(rod, axial_strain=axial_strain(n * polyline.edges)))
        torsion = None
        if self.reference is not None:
            torsion = density(rod, twist=self.total_twist(polyline))
        bending = joints(self.scene, polyline.tangents).bending_energy(rod)
        return Energies(bending, stretching, torsion, load_energy(self.scene, polyline.nodes))

    def total_twist(self, polyline: Polyline) -> Float[Array, ""]:
        """Total twist [rad]: fixed by two clamps, or in equilibrium with a dead moment; zero where an end can spin."""
        if dead_end_moment(self.scene) is not None:
            return twist_under_moment(self.scene, polyline.tangents)
        if self.reference is None:
            return jnp.zeros((), polyline.nodes.dtype)
        return total_twist(self.reference, _framed_tangents(self.scene, polyline))

    # --- gradient --------------------------------------------------------------------------------------------------

    def energy_and_gradient(self, polyline: Polyline) -> tuple[Float[Array, ""], Float[Array, "m 3"]]:
        """Potential energy, and its gradient by the displacements."""
        energy = lambda displacement: self.energies(self.displaced(polyline, displacement)).total  # noqa: E731
        return jax.value_and_grad(energy)(self.no_displacement(polyline))

    def rounding_floor(self, polyline: Polyline) -> Float[Array, ""]:
        """Gradient [EI/L^2] that rounding alone leaves at an equilibrium of this mesh, see `docs/design.md`."""
        n = len(polyline.edges)
        eps = jnp.finfo(polyline.edges.dtype).eps
        return FLOOR_SAFETY * eps * (self.scene.rod.EA + 4.0 * n**2)

    def no_displacement(self, polyline: Polyline) -> Float[Array, "m 3"]:
        return jnp.zeros_like(self._free_nodes(polyline.nodes))

    def largest_step(self, displacement: Float[Array, "m 3"]) -> Float[Array, ""]:
        """The multiple of a displacement that changes no edge by more than half of its length."""
        changes = jnp.diff(self._all_nodes(displacement), axis=0)
        largest = jnp.sqrt(jnp.max(jnp.sum(changes**2, axis=1)))
        return 0.5 / len(changes) / jnp.maximum(largest, jnp.finfo(largest.dtype).tiny)

    # --- preconditioner --------------------------------------------------------------------------------------------

    def gauss_newton(self, polyline: Polyline) -> "Preconditioner":
        """The Gauss-Newton Hessian of bending and stretch, factorised: positive definite.

        Torsion is left out: it would add a full matrix of rank one.
        """
        scene, rod = self.scene, self.scene.rod
        n = len(polyline.edges)
        tangents, lengths = polyline.tangents, polyline.lengths
        all_bases = tangent_bases(with_held_tangents(scene, tangents))
        bases = of_edges(scene, all_bases, n)
        beside = (all_bases[..., :-1], all_bases[..., 1:])
        derivatives = bending_derivatives(rod, joints(scene, tangents), beside, gauss_newton=True)
        _, diagonal, lower = scatter_add(scene, derivatives, n)
        per_tension = axial_strain_under(rod, jnp.ones_like(lengths)) / n
        if held_at_both_ends(scene):
            border = -lengths[None, None] * jnp.swapaxes(bases, 0, 1)
            compliance = (per_tension[None] * tangents) @ tangents.T
        else:
            border, compliance = jnp.zeros((2, 0, n), lengths.dtype), jnp.zeros((0, 0), lengths.dtype)
        system = SaddlePointSystem(diagonal, lower, border, compliance)
        if not (isinstance(scene.start, Directed) or isinstance(scene.end, Directed)):
            system = system.shifted(jnp.asarray(PIN_STIFFNESS / n, lengths.dtype))
        return Preconditioner(factor(system), tangents, bases, lengths, per_tension)

    def precondition(self, gauss_newton: "Preconditioner", gradient: Float[Array, "m 3"]) -> Float[Array, "m 3"]:
        """The displacement that the Gauss-Newton Hessian gives for a gradient.

        By the edges that Hessian couples neighbours only. The forces on the nodes add up to forces in the edges, up to
        one force in all of them, which follows from the closure where both ends are held.
        """
        forces = forces_beyond_edges(self.scene, self._all_nodes(gradient).T)
        changes = gauss_newton.changes_under(forces).T
        none = jnp.zeros((1, 3), changes.dtype)
        if isinstance(self.scene.start, Held):
            return self._free_nodes(jnp.concatenate([none, jnp.cumsum(changes, axis=0)]))
        return self._free_nodes(jnp.concatenate([-jnp.cumsum(changes[::-1], axis=0)[::-1], none]))

    # --- the same state in the unknowns of the mixed form ------------------------------------------------------------

    def mixed_point(self, polyline: Polyline) -> MixedPoint:
        tangents = polyline.tangents
        end_force = jnp.zeros(3, tangents.dtype)
        if held_at_both_ends(self.scene):
            on_end = forces_on_nodes(self.scene, len(polyline.edges))[-1]
            elastic = lambda edges: self.energies(Polyline(polyline.nodes, edges)).elastic  # noqa: E731
            end_force = jax.grad(elastic)(polyline.edges)[-1] - on_end
        return MixedPoint(tangents, end_force[:, None], self.total_twist(polyline))


class Preconditioner(eqx.Module):
    """A factorised Gauss-Newton Hessian by the rotations of the edges, and how each edge lengthens under tension."""

    factors: AnyFactors
    tangents: Float[Array, "3 n"]
    bases: Float[Array, "3 2 n"]
    lengths: Float[Array, "n"]
    per_tension: Float[Array, "n"]

    @property
    def is_positive_definite(self) -> Bool[Array, ""]:
        return self.factors.is_minimum

    def changes_under(self, forces: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        """The changes of the edges under these forces in them and the one in all that keeps the ends in place."""
        stretched = self.per_tension * dot(self.tangents, forces)
        assert isinstance(self.factors, Factors)
        constraints = self.factors.rows.shape[1]
        constraint_residual = (self.tangents @ stretched)[:constraints]
        rotation, common = self.factors.solve(self.lengths[None] * components(self.bases, forces), constraint_residual)
        if constraints:
            stretched += self.per_tension * (common @ self.tangents)
        return self.lengths[None] * short_sum(self.bases * rotation[None], axis=1) + stretched[None] * self.tangents


# Stiffness against rigid motion, in units of EI/L^3 per length, that the preconditioner adds where no end holds a
# tangent: a rod between pins can turn without bending. A hundredth of the softest bending mode, pi^4.
PIN_STIFFNESS = 1.0


def _moved_to_ends(guess: Polyline, scene: Scene) -> Polyline:
    """The guess moved to the held ends, by a displacement linear in s; unchanged to the last bit where it fits."""
    start, end = scene.start, scene.end
    offsets = [
        end.position - node for end, node in ((start, guess.nodes[0]), (end, guess.nodes[-1])) if isinstance(end, Held)
    ]
    at_start, at_end = offsets[0], offsets[-1]  # the same where only one end is held
    s = jnp.linspace(0.0, 1.0, len(guess.nodes), dtype=guess.nodes.dtype)[:, None]
    polyline = guess.displaced((1 - s) * at_start[None] + s * at_end[None])
    nodes = polyline.nodes
    if isinstance(start, Held):
        nodes = nodes.at[0].set(start.position)
    if isinstance(end, Held):
        nodes = nodes.at[-1].set(end.position)
    return Polyline(nodes, polyline.edges)


# --- torsion ---------------------------------------------------------------------------------------------------------


def _framed_tangents(scene: Scene, polyline: Polyline) -> FramedTangents:
    tangents = polyline.tangents
    start_d1, end_d1 = (end.frame[:, 0] if isinstance(end, Clamp) else None for end in (scene.start, scene.end))
    return FramedTangents(with_held_tangents(scene, tangents), start_d1, end_d1)


def twist_reference(scene: Scene, guess: Polyline, polyline: Polyline, first: FirstTwist) -> TwistReference | None:
    if not (isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp)):
        return None
    field = EdgeTangents.of(scene, len(polyline.edges))
    twist = twist_on(scene, field, guess, polyline.tangents, first)
    return TwistReference(_framed_tangents(scene, polyline), twist)
