"""A rod whose frames are unknown: anisotropic, not straight at rest, varying along its length, or with its own law.

The mixed form of `mixed`, with a frame R in the place of each tangent. An equilibrium is a saddle point of

    L(R, F) = sum h w(strains(R), e) - n . t [h (1 + e) + g rest] - sum n . R rest + sum F . span,

a minimum over the frames and a maximum over the force F of each span; the axial strain e is where dw/de = n . t, and
both `rest` correct the segment vectors at rest (`rest_correction`). Where sections shear, t is their normal d3, and
each strain point adds h (gamma1 d1 + gamma2 d2) to its segment vector too, GA gamma = n . d: shear is a compliance, not
an unknown. A frame turns by a vector in its own axes, so that L and its derivatives are sums over the cells between
neighbouring frames (`cells`, `cell_derivatives`). A clip holds a node, where it holds the direction of the rod two of
the three rotations of the frame there, and where it holds the twist all three, as a clamp does at an end; clips need
elements.

Loads without a potential are those of `nodal_forms.NodalFrames`.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.cell_derivatives import CellDerivatives, CellStates, derivatives, first_derivatives
from rodjax.discretization.cells import REFERENCE, Cells, strains_between
from rodjax.discretization.form import FLOOR_SAFETY, NEUTRAL, Form, Linearization
from rodjax.discretization.frame_point import FramePoint, HeldFrame, Kinematics, Strained, turned_correction
from rodjax.discretization.framed_parts import parts_of
from rodjax.discretization.joints import turn_of_all
from rodjax.discretization.layout import ForceLayout, SpanForces
from rodjax.discretization.nodes import held_nodes
from rodjax.discretization.rest_correction import RestCorrection
from rodjax.geometry.rotations import (
    align_tangent,
    columns,
    from_frame,
    inverse,
    nearer,
    rotated,
    turned,
    unit,
)
from rodjax.geometry.vectors import components, dot
from rodjax.linalg.blocks import product as block_product
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.saddle_point import AnySystem, SaddlePointSystem
from rodjax.mechanics.energy import Sections
from rodjax.model.scene import Scene, has_node_positions, has_potential, with_pins
from rodjax.model.supports import Clamp, Directed
from rodjax.programs.parts import traced_once

# The moment out of its plane, per length, that a rod in a plane may be left with, as a part of the forces through it
# and of EI/L^2: directions count as lying in the plane up to as much.
OUT_OF_PLANE = 1e-5


class FrameForm(Form):
    """A nondimensional scene on cells, as a function of a `FramePoint`.

    `rest_strains`: of the rod at rest, by the formula of the cells; `rest_correction`: of its segment vectors; `loads`:
    what the dead loads beyond each strain point exert on it; `across`: the normal of the plane in which the rod stays,
    in the axes of every frame, `None` where it may leave its place in all of space.
    """

    scene: Scene
    field: Cells
    sections: Sections
    rest_strains: Float[Array, "3 k n"] | None
    rest_correction: RestCorrection | None
    loads: Float[Array, "3 k n"]
    layout: ForceLayout
    across: Float[Array, "3"] | None = eqx.field(kw_only=True, default=None)

    @classmethod
    def of(cls, scene: Scene, field: Cells) -> "FrameForm":
        return cls(**parts_of(scene, field))

    @property
    def has_potential(self) -> bool:
        return has_potential(self.scene)

    @property
    def is_free(self) -> Float[Array, "3 m"]:
        """1 for the rotations in the axes of each frame that no support holds, else 0."""
        free = jnp.ones((3, len(self.field.arclengths)), self.loads.dtype)
        for held in self.held_frames:
            free = free.at[: 2 if held.frame is None else 3, held.number].set(0.0)
        return free

    def in_plane(
        self, point: FramePoint, normal: Float[Array, "3"], axes: Float[Array, "3 2"]
    ) -> tuple["FrameForm", FramePoint]:
        """The same for a rod that stays in a plane: with the normal of this where a held frame has it, else along the
        axis d1 or d2 that is nearest to it at the first frame of a point.
        """
        held = [held.frame for held in self.held_frames if held.frame is not None]
        if held:
            across = normal @ held[0]
        else:
            first = rotated(inverse(point.quaternions[:, 0]), normal)
            nearest = jnp.argmax(jnp.abs(first[:2]))
            across = jnp.where(jnp.arange(3) == nearest, jnp.where(first < 0, -1.0, 1.0), 0.0).astype(first.dtype)
        form = dataclasses.replace(self, across=across, layout=self.layout.in_axes(axes))
        return form, point.flattened(normal, across)

    def in_plane_of(self, other: Form) -> "FrameForm":
        assert isinstance(other, FrameForm)
        return dataclasses.replace(self, across=other.across, layout=other.layout)

    def out_of_plane(self, normal: Float[Array, "3"]) -> "FrameForm":
        return dataclasses.replace(self, across=None, layout=self.layout.in_axes(None))

    def stays_in_plane(self, point: FramePoint) -> Bool[Array, ""]:
        gradient, _ = dataclasses.replace(self, across=None).residual_vectors(point)
        largest = jnp.max(jnp.abs(self.forces(point.quaternions, point.end_force)))
        return self._residual(gradient - self.projected(gradient)) <= OUT_OF_PLANE * (1 + largest)

    def projected(self, by_frame: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        """Rotations or moments of the frames without the components that supports hold or that leave the plane."""
        by_frame = by_frame * self.is_free
        return by_frame if self.across is None else self.across[:, None] * (self.across @ by_frame)[None]

    def _projected_columns(self, border: Float[Array, "3 k m"]) -> Float[Array, "3 k m"]:
        return border * self.is_free[:, None] if self.across is None else block_product(self._projection, border)

    @property
    def _projection(self) -> Float[Array, "3 3 m"]:
        """This projection in a plane, as matrices."""
        assert self.across is not None
        return self.across[:, None, None] * (self.across[:, None] * self.is_free)[None]

    @property
    def held_frames(self) -> list[HeldFrame]:
        ends = ((self.scene.start, 0), (self.scene.end, -1))
        of_ends = [
            HeldFrame(k, end.tangent, end.frame if isinstance(end, Clamp) else None)
            for end, k in ends
            if isinstance(end, Directed)
        ]
        clips = self.scene.clips
        return of_ends + [
            HeldFrame(2 * held.node, held.tangent, clips[held.clip].frame)
            for held in held_nodes(self.scene, self.clip_nodes)
        ]

    def bases_at(self, point: FramePoint) -> Float[Array, "3 3 m"]:
        bases = columns(point.quaternions)
        return bases * self.is_free[None] if self.across is None else block_product(bases, self._projection)

    def turn(self, point: FramePoint, bases: Float[Array, "3 3 m"], axis: Float[Array, "3"]) -> Float[Array, "3 m"]:
        return components(bases, jnp.broadcast_to(axis[:, None], point.tangents.shape))

    def spin(self, bases: Float[Array, "3 3 m"]) -> Float[Array, "3 m"]:
        return jnp.zeros_like(bases[0]).at[2].set(1.0) * self.is_free

    def holding(self, point: FramePoint) -> FramePoint:
        """The point with the frames and tangents that supports hold."""
        q = point.quaternions
        for k, direction, frame in self.held_frames:
            held = align_tangent(q[:, k], direction) if frame is None else nearer(from_frame(frame), q[:, k])
            q = q.at[:, k].set(held)
        return FramePoint(q, point.end_force, point.total_twist, self.nodal_held(point.nodal))

    def settled(self, point: FramePoint) -> FramePoint:
        twist = self.total_twist(point.quaternions)
        return FramePoint(point.quaternions, point.end_force, twist, point.nodal)

    def total_twist(self, quaternions: Float[Array, "4 m"]) -> Float[Array, ""]:
        return jnp.sum(self.field.lengths * strains_between(self.field, quaternions)[2])

    def retract(
        self,
        point: FramePoint,
        bases: Float[Array, "3 3 m"],
        rotation: Float[Array, "3 m"],
        force_change: Float[Array, "3 parts"],
        others: Any = None,
    ) -> FramePoint:
        # Rounding would grow with every step.
        quaternions = unit(self._turned(point, bases, rotation))
        nodal = self.retracted_nodal(point, others)
        return FramePoint(quaternions, point.end_force + force_change, point.total_twist, nodal)

    def _turned(
        self, point: FramePoint, bases: Float[Array, "3 3 m"], rotation: Float[Array, "3 m"]
    ) -> Float[Array, "4 m"]:
        """Tangents turn as those of a rod without frames do (`rotated_together`); the rest of a frame's spin is about
        its tangent where that has come.
        """
        if has_node_positions(self.scene):
            return turned(point.quaternions, rotation)
        across = short_sum(bases[:, :2] * rotation[None, :2], axis=1)
        spin = dot(turn_of_all(point.tangents, across)[:, None], point.tangents)
        nothing = jnp.zeros_like(spin)
        there = turned(point.quaternions, jnp.stack([rotation[0], rotation[1], spin]))
        return turned(there, jnp.stack([nothing, nothing, rotation[2] - spin]))

    # --- forces, and what the spans lack -----------------------------------------------------------------------------

    @property
    def spans(self) -> Float[Array, "3 parts"]:
        """The vectors between held positions."""
        assert isinstance(self.layout, SpanForces)
        return self.layout.spans(self.held_positions[0])

    def tangents_in_clips(self, point: FramePoint) -> Float[Array, "3 clips"]:
        nodes = self.clip_nodes
        assert nodes is not None
        if self.sections.GA is None:
            return point.tangents[:, 2 * nodes]
        # The centerline has a kink where the force jumps: the work of this force is that on the mean of both sides.
        slopes = self.strained(point).slopes
        mean = slopes[:, -1, nodes - 1] + slopes[:, 0, nodes]
        return mean / jnp.sqrt(dot(mean, mean))[None]

    def through(self, end_force: Float[Array, "3 parts"]) -> Float[Array, "3 1 1"] | Float[Array, "3 1 n"]:
        """The section force in the cells without the loads beyond them."""
        return self.layout.gather(end_force)[:, None]

    def forces(self, quaternions: Float[Array, "4 m"], end_force: Float[Array, "3 parts"]) -> Float[Array, "3 k n"]:
        """The force through the rod at the strain points."""
        forces = self.through(end_force) + self.loads
        following = self.following(quaternions)
        return forces if following is None else forces + following

    def following(self, quaternions: Float[Array, "4 m"]) -> Float[Array, "3 k n"] | None:
        """The forces of follower loads at the strain points; `None` without such loads."""
        return None

    def couples_along(self, quaternions: Float[Array, "4 m"]) -> Float[Array, "3 k n"] | None:
        """The couples along the rod on the strain points, in their axes; `None` where there are none."""
        return None

    def strained(self, point: FramePoint) -> Strained:
        forces = self.forces(point.quaternions, point.end_force)
        return self.strained_under(self.kinematics(self.field.gather(point.quaternions)), forces)

    def kinematics(self, quaternions: Float[Array, "4 p n"]) -> Kinematics:
        has_shear = self.sections.GA is not None
        return Kinematics.of(self.field, self.rest_strains, self.rest_correction, has_shear, quaternions)

    def strained_under(self, here: Kinematics, forces: Float[Array, "3 p n"]) -> Strained:
        return Strained.of(self.field, self.sections, here, forces)

    def _cells(self, quaternions: Float[Array, "4 m"], end_force: Float[Array, "3 parts"]) -> CellStates:
        forces = self.forces(quaternions, end_force)
        gather = self.field.gather(quaternions)
        return CellStates(self.field, self.sections, gather, forces, self.rest_strains, self.rest_correction)

    def edges(self, point: Any) -> Float[Array, "segments 3"]:
        """From node to node."""
        gather = self.field.gather(point.quaternions)
        weighted_slopes = self.strained(point).weighted_slopes
        return self.field.segment_vectors(
            weighted_slopes, turned_correction(self.rest_correction, gather, jnp.zeros_like(weighted_slopes[:, 0]))
        ).T

    # --- energies ----------------------------------------------------------------------------------------------------

    def elastic_energy(self, point: FramePoint) -> Float[Array, ""]:
        return jnp.sum(self.field.lengths * self._densities(self.strained(point)))

    def _densities(self, here: Strained) -> Float[Array, "p n"]:
        return self.sections.density((here.curvature[0], here.curvature[1]), here.twist, here.axial, here.shear)

    def load_energy(self, point: FramePoint) -> Float[Array, ""]:
        """The potential of dead forces, zero at the origin, where the rod is held; other loads have none."""
        here = self.strained(point)
        work = jnp.sum(here.work(self.loads))
        rest = turned_correction(
            self.rest_correction, self.field.gather(point.quaternions), jnp.zeros_like(self.loads[:, 0])
        )
        work += jnp.sum(dot(self.loads[:, REFERENCE], rest))
        return -work

    # --- derivatives -------------------------------------------------------------------------------------------------

    def by_rotations(
        self, quaternions: Float[Array, "4 m"], end_force: Float[Array, "3 parts"]
    ) -> Float[Array, "3 p n"]:
        """The derivatives of L in each cell by the rotations of its frames, under forces that stay."""
        return first_derivatives(self._cells(quaternions, end_force))

    def residual_vectors(self, point: FramePoint) -> tuple[Float[Array, "3 m"], Float[Array, "c"]]:
        """The gradient at the frames, in their axes, and the residual of the closure constraints."""
        gradient = self.field.scatter_add(self.by_rotations(point.quaternions, point.end_force))
        constraint_residual = jnp.zeros(0, gradient.dtype)
        if self.layout.size:
            constraint_residual = self.layout.components(self.spans - self.layout.sums(self.edges(point).T))
        return self.projected(gradient), constraint_residual

    def by_cells(
        self, point: FramePoint
    ) -> tuple[CellDerivatives, Float[Array, "3 m"], tuple[Array, Array, Array | None]]:
        """The derivatives of each cell, and by the rotations that are free: first ones, and blocks of second ones on
        the diagonal, between neighbours and between ends of elements.
        """
        field = self.field
        cells = derivatives(self._cells(point.quaternions, point.end_force))
        diagonal, lower, across = field.couplings(cells.second)
        if self.across is None:
            free = self.is_free
            held = jnp.eye(3, dtype=free.dtype)[..., None] * (1 - free)[:, None]
            diagonal = diagonal * free[:, None] * free[None] + held
            lower = lower * free[:, None, 1:] * free[None, :, :-1]
            if across is not None:
                across = across * free[:, None, 2::2] * free[None, :, 0:-1:2]
        else:
            projection = self._projection
            held = jnp.eye(3, dtype=projection.dtype)[..., None] - projection
            diagonal = block_product(block_product(projection, diagonal), projection) + held
            lower = block_product(block_product(projection[..., 1:], lower), projection[..., :-1])
            if across is not None:
                across = block_product(block_product(projection[..., 2::2], across), projection[..., 0:-1:2])
        return cells, self.projected(field.scatter_add(cells.first)), (diagonal, lower, across)

    @traced_once
    def linearized(self, point: FramePoint) -> Linearization:
        layout = self.layout
        assert isinstance(layout, SpanForces)
        cells, gradient, (diagonal, lower, across) = self.by_cells(point)
        value, dtype = jnp.sum(cells.value), gradient.dtype
        constraint_residual, border = jnp.zeros(0, dtype), jnp.zeros((3, 0, gradient.shape[1]), dtype)
        compliance = jnp.zeros((0, 0), dtype)
        if layout.size:
            value += jnp.sum(point.end_force * self.spans)
            constraint_residual = layout.components(self.spans - layout.sums(cells.segment_vectors))
            border = self._projected_columns(self.field.scatter_add(layout.columns(cells.by_force)))
            compliance = layout.compliance(cells.compliance)
        return Linearization(
            bases=self.bases_at(point),
            gradient=gradient,
            constraint_residual=constraint_residual,
            system=SaddlePointSystem(diagonal, lower, border, compliance, across=across),
            energy=value,
            residual=self._residual(gradient),
        )

    def released(self, point: FramePoint) -> Linearization:
        here = dataclasses.replace(self, scene=with_pins(self.scene)).linearized(point)
        return dataclasses.replace(here, residual=self._residual(self.projected(here.gradient)))

    def lagrangian(self, point: FramePoint) -> tuple[Float[Array, ""], Float[Array, "c"]]:
        layout = self.layout
        assert isinstance(layout, SpanForces)
        value, segment_vectors = self.in_cells(self.kinematics(self.field.gather(point.quaternions)), point.end_force)
        if not layout.size:
            return value, jnp.zeros(0, value.dtype)
        constraint_residual = layout.components(self.spans - layout.sums(segment_vectors))
        return value + jnp.sum(point.end_force * self.spans), constraint_residual

    def _residual(self, gradient: Float[Array, "3 m"]) -> Float[Array, ""]:
        """Largest component of the moment left at a frame, per length of rod."""
        return jnp.max(jnp.abs(gradient) / self.field.weights[None])

    def regular(self, system: AnySystem) -> AnySystem:
        """The system of a linearisation, neutral modes held."""
        m = len(self.field.arclengths)
        return system.shifted(jnp.asarray(NEUTRAL / m, self.loads.dtype))

    def under_force(
        self,
        point: FramePoint,
        here: Linearization,
        rotation: Float[Array, "3 m"],
        change: Float[Array, "3 parts"],
        others: Any,
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        zero = jnp.zeros((), change.dtype)
        if not self.layout.size:
            nothing = jnp.zeros(0, change.dtype)
            return nothing, nothing, zero, zero
        layout, spans = self.layout, self.spans
        kinematics, turning = self.turning(point, rotation)

        def parts(of_frames: Kinematics, force: Float[Array, "3 parts"]) -> tuple[Array, Array]:
            value, segment_vectors = self.in_cells(of_frames, force)
            return value + jnp.sum(force * spans), layout.components(spans - layout.sums(segment_vectors))

        def rates(force: Float[Array, "3 parts"]):
            return jax.jvp(lambda of_frames: parts(of_frames, force), (kinematics,), (turning,))

        both = jnp.stack([point.end_force + change, point.end_force])
        (energy, constraint_residual), (rate, constraint_rate) = jax.vmap(rates)(both)
        return constraint_residual[0], constraint_rate[0], energy[0] - energy[1], rate[0] - rate[1]

    def turning(self, point: FramePoint, rotation: Float[Array, "3 m"]) -> tuple[Kinematics, Kinematics]:
        """The kinematics of the cells, and its rates along rotations."""
        frames, turns = self.field.gather(point.quaternions), self.field.gather(rotation)
        zero = jnp.zeros((), rotation.dtype)
        return jax.jvp(lambda part: self.kinematics(turned(frames, part * turns)), (zero,), (jnp.ones_like(zero),))

    def in_cells(
        self, of_frames: Kinematics, end_force: Float[Array, "3 parts"]
    ) -> tuple[Float[Array, ""], Float[Array, "3 n"]]:
        """The terms of L from the cells under forces, and the segment vectors."""
        forces = self.through(end_force) + self.loads
        here = self.strained_under(of_frames, forces)
        value = jnp.sum(self.field.lengths * self._densities(here) - here.tension * here.lengths)
        if here.sideways is not None:
            value -= jnp.sum(here.weights * dot(forces, here.sideways))
        value -= jnp.sum(forces[:, REFERENCE] * of_frames.rests)
        return value, short_sum(here.weighted_slopes, axis=1) + of_frames.rests

    def rounding_floor(self, point: FramePoint) -> Float[Array, ""]:
        """Residual [EI/L^2] that rounding alone leaves at an equilibrium of this mesh, see `docs/design.md`."""
        largest = jnp.max(jnp.abs(self.forces(point.quaternions, point.end_force)))
        eps = jnp.finfo(largest.dtype).eps
        stiffest = jnp.maximum(self.sections.stiffest, 1.0)
        return FLOOR_SAFETY * eps * 4.0 * (largest + stiffest / self.field.finest**2)
