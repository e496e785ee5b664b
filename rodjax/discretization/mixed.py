"""The finite differences in other unknowns: unit tangents of the edges, and the force that runs through the rod.

Under dead loads the force through the rod is known up to one vector F in each span between held places, which follows
from the closure constraint of the span (`layout`). So an equilibrium is a saddle point of

    L(t, F) = bending(t) + torsion(t) + sum h [w(e) - n . t (1 + e)] + sum F . span,    n_i = F + loads beyond edge i,

a minimum over tangents t that close the spans and a maximum over the forces F (Lagrange's multipliers); the axial
strain e is the one at which dw/de = n . t. Tension is in n and not in a difference of lengths, so that neither the
iterations nor the rounding depend on EA: the mixed treatment of stretch (Magisano, Leonetti & Garcea 2017) carried
through. Steps are rotations, in which bending is nearly quadratic even where new end tangents kink the rod. Where a
clip or a point force acts between two cells the force jumps, and with it the tension: so each point counts with the
force on its side of a node, in each cell that it belongs to.

A dead moment M on a free end has no potential. There the virtual work M . (rotation of the end) enters the gradient:
the tangent t turns by t x dt, and the section spins about it by as much as keeps the torque M . t along the rod.

The second derivatives couple neighbouring edges only, two numbers each; the closures and the torsion, which many edges
share, are a border of a few columns (`saddle_point.SaddlePointSystem`). Arrays along the rod have the components first.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.first_twist import FirstTwist, twist_on
from rodjax.discretization.form import FLOOR_SAFETY, NEUTRAL, EndTurn, Form, Linearization
from rodjax.discretization.joints import rotated, rotated_together, tangent_bases
from rodjax.discretization.layout import ForceLayout, SpanForces
from rodjax.discretization.mixed_point import ByCells, Elastic, MixedPoint
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import Blocks, TangentField
from rodjax.discretization.twist import nearest_twist, twist_under_moment
from rodjax.geometry.vectors import components, dot
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import AnySystem, SaddlePointSystem
from rodjax.mechanics.energy import axial_strain_under, density
from rodjax.model.scene import Scene, dead_end_moment, has_node_positions, with_pins
from rodjax.model.supports import Clamp, Free
from rodjax.programs.parts import traced_once

# A total twist further than this [rad] from those that the end frames allow has lost a part of a turn: others are off
# by roundings.
SLIP = 1.0


class MixedForm(Form):
    """A nondimensional scene on a field of tangents, as a function of a `MixedPoint`.

    `loads_beyond`: what the loads exert on what lies beyond each point, on the side of a cell; `axes`: those along
    which the rod may leave its place, as the layout has them: two for a rod in a plane, its normal for motions out of
    it, `None` for all of space. In a symmetric scene the two kinds do not couple.
    """

    scene: Scene
    field: TangentField
    layout: ForceLayout
    loads_beyond: Float[Array, "3 p n"]
    axes: Float[Array, "3 a"] | None = eqx.field(kw_only=True, default=None)

    @classmethod
    def of(cls, scene: Scene, field: TangentField) -> "MixedForm":
        layout = SpanForces.of(scene, field.clip_nodes, len(field.s) - 1)
        return cls(scene=scene, field=field, layout=layout, loads_beyond=field.loads_beyond(scene))

    def in_axes(self, axes: Float[Array, "3 a"]) -> "MixedForm":
        return dataclasses.replace(self, axes=axes, layout=self.layout.in_axes(axes))

    def in_plane(
        self, point: MixedPoint, normal: Float[Array, "3"], axes: Float[Array, "3 2"]
    ) -> tuple["MixedForm", MixedPoint]:
        return self.in_axes(axes), point.flattened(axes)

    def in_plane_of(self, other: Form) -> "MixedForm":
        assert isinstance(other, MixedForm)
        return dataclasses.replace(self, axes=other.axes, layout=other.layout)

    def out_of_plane(self, normal: Float[Array, "3"]) -> "MixedForm":
        return self.in_axes(normal[:, None])

    def bases(self, tangents: Float[Array, "3 n"]) -> Float[Array, "3 b n"]:
        """Directions at right angles to each tangent, along the axes."""
        if self.axes is None:
            return tangent_bases(tangents)
        if self.axes.shape[1] == 1:
            return jnp.broadcast_to(self.axes[..., None], (3, 1, tangents.shape[1]))
        normal = jnp.cross(self.axes[:, 0], self.axes[:, 1])
        return jnp.cross(jnp.broadcast_to(normal[:, None], tangents.shape), tangents, axis=0)[:, None]

    def bases_at(self, point: MixedPoint) -> Float[Array, "3 b n"]:
        """Those along which the tangents of a point may turn: none where a support holds one."""
        return self.field.basis(self.scene, self.bases(self.field.append_prescribed(self.scene, point.tangents)))

    def turn(self, point: MixedPoint, bases: Float[Array, "3 b n"], axis: Float[Array, "3"]) -> Float[Array, "b n"]:
        """The rotations that turn the whole rod about an axis."""
        return components(bases, jnp.cross(axis[:, None], point.tangents, axis=0))

    def holding(self, point: MixedPoint) -> MixedPoint:
        """The point with the tangents that supports hold, and the total twist of the scene."""
        tangents = self.field.apply_prescribed(self.scene, point.tangents)
        twist = self.twist_near(tangents, point.total_twist)
        return MixedPoint(tangents, point.end_force, twist, self.nodal_held(point.nodal))

    def settled(self, point: MixedPoint) -> MixedPoint:
        """The point where a solver stopped, with all that is known of it."""
        return point

    @property
    def carries_twist(self) -> bool:
        return self.has_torsion

    def allowed_twist(self, point: MixedPoint) -> Float[Array, ""]:
        """The areas that an element sweeps are carried with weights that are no whole numbers: where it once turned by
        more than pi, a third of a sphere, twice 2 pi/3, may stay in the total twist. Where one still does, areas do not
        tell: the mesh is then told to be too coarse.
        """
        is_resolved = jnp.all(dot(point.tangents[:, 1:], point.tangents[:, :-1]) > 0)
        principal = self.field.principal_twist(self.scene, point.tangents)
        off = point.total_twist - nearest_twist(principal, point.total_twist, None)
        # By 4 pi/3 beyond whole turns it seems to be 2 pi/3 short of them.
        twist = nearest_twist(principal, point.total_twist + 2 * off, None)
        return jnp.where(is_resolved & (jnp.abs(off) > SLIP), twist, point.total_twist)

    @property
    def has_torsion(self) -> bool:
        """Whether two clamps prescribe the total twist, and the rod may leave a plane."""
        is_planar = self.axes is not None and self.axes.shape[1] == 2
        return isinstance(self.scene.start, Clamp) and isinstance(self.scene.end, Clamp) and not is_planar

    @property
    def has_potential(self) -> bool:
        return dead_end_moment(self.scene) is None

    # --- forces and stretch ------------------------------------------------------------------------------------------

    def forces(self, point: MixedPoint) -> Float[Array, "3 p n"]:
        """The force through the rod at the points of each cell."""
        return self.layout.gather(point.end_force)[:, None] + self.loads_beyond

    def forces_and_tensions(self, point: MixedPoint) -> tuple[Float[Array, "3 p n"], Float[Array, "p n"]]:
        forces = self.forces(point)
        return forces, dot(forces, self.field.gather(point.tangents))

    def edge_tension(self, point: MixedPoint) -> Float[Array, "m"]:
        """At the points, of a force that jumps there the mean."""
        _, tension = self.forces_and_tensions(point)
        return self.field.scatter_add(self.field.quadrature_weights * tension) / self.field.weights

    def slopes(self, point: MixedPoint) -> Float[Array, "3 m"]:
        """The derivative of the centerline by arclength."""
        strain = axial_strain_under(self.scene.rod, self.edge_tension(point))
        return (1 + strain)[None] * point.tangents

    def weighted_slopes(self, point: MixedPoint) -> Float[Array, "3 p n"]:
        """What the points of each cell add to its segment vector."""
        _, tension = self.forces_and_tensions(point)
        lengths = self.field.quadrature_weights * (1 + axial_strain_under(self.scene.rod, tension))
        return lengths[None] * self.field.gather(point.tangents)

    def edges(self, point: MixedPoint) -> Float[Array, "n 3"]:
        """From node to node."""
        return short_sum(self.weighted_slopes(point), axis=1).T

    @property
    def spans(self) -> Float[Array, "3 parts"]:
        """The vectors between held positions."""
        assert isinstance(self.layout, SpanForces)
        return self.layout.spans(self.held_positions[0])

    def tangents_in_clips(self, point: MixedPoint) -> Float[Array, "3 clips"]:
        return self.field.tangents_in_clips(self.scene, point.tangents)

    # --- energies ----------------------------------------------------------------------------------------------------

    def load_energy(self, point: MixedPoint) -> Float[Array, ""]:
        """The potential of gravity and dead forces, zero at the origin, where the rod is held."""
        return -jnp.sum(self.loads_beyond * self.weighted_slopes(point))

    def elastic_energy(self, point: MixedPoint) -> Float[Array, ""]:
        rod = self.scene.rod
        _, tension = self.forces_and_tensions(point)
        stretching = density(rod, axial_strain=axial_strain_under(rod, tension))
        bending = self.field.bending_energy(self.scene, point.tangents)
        return bending + jnp.sum(self.field.quadrature_weights * stretching) + density(rod, twist=point.total_twist)

    # --- twist -------------------------------------------------------------------------------------------------------

    def twist_near(self, tangents: Float[Array, "3 m"], twist: Float[Array, ""]) -> Float[Array, ""]:
        """The total twist [rad]: between two clamps the nearest to `twist`; or under a moment."""
        if not self.has_potential:
            return twist_under_moment(self.scene, tangents)
        if isinstance(self.scene.start, Clamp) and isinstance(self.scene.end, Clamp):
            return nearest_twist(self.field.principal_twist(self.scene, tangents), twist, None)
        return jnp.zeros_like(twist)

    def first_twist(self, begin: Shape, tangents: Float[Array, "3 m"], first: FirstTwist) -> Float[Array, ""]:
        """The same where a solve begins, on tangents made of those of a shape."""
        if self.has_potential and isinstance(self.scene.start, Clamp) and isinstance(self.scene.end, Clamp):
            return twist_on(self.scene, self.field, begin, tangents, first)
        return self.twist_near(tangents, first.total_twist)

    def retract(
        self,
        point: MixedPoint,
        bases: Float[Array, "3 b n"],
        rotation: Float[Array, "b n"],
        force_change: Float[Array, "3 parts"],
        others: Any = None,
    ) -> MixedPoint:
        # Nodes with places of their own move straight, and do not go along in a turn of all.
        turned = rotated if has_node_positions(self.scene) else rotated_together
        tangents = turned(point.tangents, bases, rotation)
        twist = point.total_twist
        if self.has_torsion:
            twist += self.field.swept(self.scene, point.tangents, tangents)
        elif not self.has_potential:
            twist = twist_under_moment(self.scene, tangents)
        return MixedPoint(tangents, point.end_force + force_change, twist, self.retracted_nodal(point, others))

    # --- derivatives -------------------------------------------------------------------------------------------------

    @traced_once
    def linearized(self, point: MixedPoint) -> Linearization:
        return self._linearized(point, self.scene)

    @traced_once
    def released(self, point: MixedPoint) -> Linearization:
        return self._linearized(point, with_pins(self.scene))

    def end_turn(self, point: MixedPoint, released: Linearization, end: int) -> EndTurn:
        """A frame turned by a vector is that turned by the smallest rotation to the new tangent, and by the component
        along the tangent about it. The first turns the tangent along a great circle, to second order by what is across
        of the vector, r, and half of its product with the component along, (r + (r . t) t x r / 2).
        """
        tangent, basis = point.tangents[:, end], released.bases[..., end]
        turn = super().end_turn(point, released, end)
        across = basis @ released.gradient[:, end]
        second = (tangent[:, None] * across[None] + across[:, None] * tangent[None]) / 2
        if not self.has_torsion:
            return turn._replace(second=second)
        torque = jax.grad(lambda twist: density(self.scene.rod, twist=twist))(point.total_twist)
        spin = tangent if end else -tangent
        return EndTurn(turn.rotation, spin, torque * spin, second)

    def _linearized(self, point: MixedPoint, holding: Scene) -> Linearization:
        """With the tangents held that supports and clips of a scene hold."""
        scene, tangents = self.scene, point.tangents
        assert isinstance(self.layout, SpanForces)
        bases, energy, blocks, torque_column, torsional_compliance = self._elastic(point, holding)
        cells = self.by_cells(point, bases, blocks)
        border = [self.layout.columns(cells.by_force)] if self.layout.size else []
        if torque_column is not None:
            border = [torque_column, *border]
        by_point = map(self.field.scatter_add, (cells.gradient, cells.diagonal, cells.lengths, *border))
        gradient, diagonal, lengths, *border = by_point
        energy += cells.energy
        columns, constraint_residual, compliance, rows = border, [], [], None
        if torsional_compliance is not None:
            constraint_residual, compliance = [jnp.zeros(1, energy.dtype)], [torsional_compliance[None, None]]
        moment = dead_end_moment(scene)
        if moment is not None:
            n = tangents.shape[1]
            edge = 0 if isinstance(scene.start, Free) else n - 1
            tangent, basis = tangents[:, edge], bases[..., edge]
            gradient = gradient.at[:, edge].add(-jnp.cross(moment, tangent) @ basis)
            # The rotation of the last edge changes the torque, and turns the tangent away from the moment: an
            # antisymmetric block M . t. Half of it goes, as the section spins by the area that a tangent runs round.
            sign = -1 if edge == 0 else 1
            spin = jnp.sum(moment * tangent) / 2 * jnp.array([[1.0, 0.0], [0.0, -1.0]], energy.dtype)
            at_edge = jnp.zeros((2, 2, n), energy.dtype).at[:, :, edge]
            columns = [border[0], at_edge.set(spin), *border[1:]]
            torque_row = jnp.zeros((2, 1, n), energy.dtype).at[:, 0, edge].set(sign * moment @ basis)
            rows = [torque_row, at_edge.set(jnp.array([[0.0, 1.0], [1.0, 0.0]], energy.dtype))]
            constraint_residual, compliance = [jnp.zeros(3, energy.dtype)], [jnp.eye(3, dtype=energy.dtype)]
        if self.layout.size:
            energy += jnp.sum(point.end_force * self.spans)
            segment_vectors = short_sum(cells.lengths[None] * cells.along, axis=1)
            lacking = self.layout.components(self.spans - self.layout.sums(segment_vectors))
            constraint_residual = [*constraint_residual, lacking]
            compliance.append(self.layout.compliance(cells.compliance))
            rows = None if rows is None else [*rows, border[-1]]
        nothing = jnp.zeros((*gradient.shape[:1], 0, gradient.shape[1]), energy.dtype)
        free = bases if holding is scene else self.field.basis(scene, bases)
        return Linearization(
            bases=bases,
            gradient=gradient,
            constraint_residual=jnp.concatenate(constraint_residual)
            if constraint_residual
            else jnp.zeros(0, energy.dtype),
            system=SaddlePointSystem(
                self.field.held(holding, diagonal),
                blocks.lower,
                jnp.concatenate(columns, axis=1) if columns else nothing,
                jax.scipy.linalg.block_diag(*compliance) if compliance else jnp.zeros((0, 0), energy.dtype),
                None if rows is None else jnp.concatenate(rows, axis=1),
                blocks.across,
            ),
            energy=energy,
            residual=self.field.residual(scene, short_sum(free * gradient[None], axis=1), lengths),
        )

    def _elastic(self, point: MixedPoint, holding: Scene | None = None) -> Elastic:
        """`holding`: the scene whose supports hold tangents, else that of the form."""
        scene, rod, field, tangents = holding or self.scene, self.scene.rod, self.field, point.tangents
        all_bases = self.bases(field.append_prescribed(scene, tangents))
        bases = field.basis(scene, all_bases)
        energy, blocks = field.bending(scene, tangents, all_bases)
        if not self.has_torsion and self.has_potential:
            return Elastic(bases, energy, blocks, None, None)
        twist = field.twist(scene, tangents, all_bases)
        torsion, torque, stiffness = _with_derivatives(lambda twist: density(rod, twist=twist), point.total_twist)
        blocks = jax.tree.map(lambda bent, twisted: bent + torque * twisted, blocks, twist)
        torque_column = twist.gradient[:, None]
        if not self.has_torsion:
            return Elastic(bases, energy, blocks, torque_column, None)
        return Elastic(bases, energy + torsion, blocks, torque_column, 1 / stiffness)

    def by_cells(self, point: MixedPoint, bases: Float[Array, "3 b m"], blocks: Blocks) -> ByCells:
        """With what stretch and the forces through the cells add to the derivatives of bending and torsion."""
        return ByCells.of(self.scene.rod, self.field, point, bases, blocks, *self.forces_and_tensions(point))

    def lagrangian(self, point: MixedPoint) -> tuple[Float[Array, ""], Float[Array, "c"]]:
        rod, layout = self.scene.rod, self.layout
        assert isinstance(layout, SpanForces)
        _, tension = self.forces_and_tensions(point)
        strain = axial_strain_under(rod, tension)
        stretching = density(rod, axial_strain=strain) - tension * (1 + strain)
        energy = self.field.bending_energy(self.scene, point.tangents) + jnp.sum(
            self.field.quadrature_weights * stretching
        )
        if self.has_torsion:
            energy += density(rod, twist=point.total_twist)
        if not layout.size:
            return energy, jnp.zeros(0, energy.dtype)
        constraint_residual = layout.components(self.spans - layout.sums(self.edges(point).T))
        return energy + jnp.sum(point.end_force * self.spans), constraint_residual

    def regular(self, system: AnySystem) -> AnySystem:
        """The system of a linearisation, neutral modes held."""
        assert isinstance(system, SaddlePointSystem | ChainSystem)
        return system.shifted(jnp.asarray(NEUTRAL / system.diagonal.shape[-1], system.diagonal.dtype))

    def under_force(
        self,
        point: MixedPoint,
        here: Linearization,
        rotation: Float[Array, "b m"],
        change: Float[Array, "3 parts"],
        others: Any,
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        rod, weights, layout = self.scene.rod, self.field.quadrature_weights, self.layout
        assert isinstance(layout, SpanForces)
        zero = jnp.zeros((), change.dtype)
        if not layout.size:
            return zero[None][:0], zero[None][:0], zero, zero
        spans = self.spans
        along = self.field.gather(point.tangents)
        turning = self.field.gather(short_sum(here.bases * rotation[None], axis=1))

        def stretched(force: Float[Array, "3 parts"]):
            """Strains with their rates as the rod begins to turn, and by points what they add to L and to its rate,
            which knows nothing of the strains' own, as L is stationary by them.
            """
            forces = self.layout.gather(force)[:, None] + self.loads_beyond
            tension, rate = dot(forces, along), dot(forces, turning)
            strain, strain_rate = jax.jvp(lambda tension: axial_strain_under(rod, tension), (tension,), (rate,))
            added = density(rod, axial_strain=strain) - tension * (1 + strain)
            return strain, strain_rate, added, -(1 + strain) * rate

        strain, strain_rate, added, rate = stretched(point.end_force + change)
        _, _, added_before, rate_before = stretched(point.end_force)
        segment_vectors = short_sum((weights * (1 + strain))[None] * along, axis=1)
        segment_rates = short_sum(
            (weights * (1 + strain))[None] * turning + (weights * strain_rate)[None] * along, axis=1
        )
        return (
            layout.components(spans - layout.sums(segment_vectors)),
            -layout.components(layout.sums(segment_rates)),
            jnp.sum(weights * (added - added_before)) + jnp.sum(change * spans),
            jnp.sum(weights * (rate - rate_before)),
        )

    def rounding_floor(self, point: MixedPoint) -> Float[Array, ""]:
        largest = jnp.max(jnp.abs(self.forces(point)))
        eps = jnp.finfo(largest.dtype).eps
        return FLOOR_SAFETY * eps * (4.0 * largest + 4.0 / self.field.finest**2)


def _with_derivatives(
    function: Callable[[Float[Array, ""]], Float[Array, ""]], x: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """A function of one number, its first and second derivative."""
    (value, first), (_, second) = jax.jvp(jax.value_and_grad(function), (x,), (jnp.ones_like(x),))
    return value, first, second
