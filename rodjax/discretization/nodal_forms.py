"""The two forms with positions of nodes: by tangents and by frames, the latter with loads that have no potential.

Both differ from those with a force a span in the system and in what L is under other forces alone.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization import nonconservative
from rodjax.discretization.cell_derivatives import CellDerivatives, first_derivatives
from rodjax.discretization.cells import Cells, ElementCells
from rodjax.discretization.form import HeldLoads, Linearization
from rodjax.discretization.frame_point import FramePoint, HeldFrame, Kinematics
from rodjax.discretization.framed import OUT_OF_PLANE, FrameForm
from rodjax.discretization.framed_parts import parts_of
from rodjax.discretization.hermite import QuadraticRotationElements
from rodjax.discretization.layout import CellForces
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.node_contacts import contact_residuals, contacts_at, larger
from rodjax.discretization.node_friction import by_law
from rodjax.discretization.potentials import OnElements
from rodjax.discretization.tangent_field import TangentField
from rodjax.geometry.rotations import columns, rotated, turned
from rodjax.geometry.vectors import cross
from rodjax.linalg.blocks import product, short_sum
from rodjax.linalg.chain import ChainSystem, Elimination
from rodjax.linalg.chain_rows import LoadRows
from rodjax.mechanics.energy import axial_strain_under, density
from rodjax.model.scene import Scene, has_contacts, has_free_ends, with_pins
from rodjax.model.supports import Free, Held
from rodjax.programs.parts import traced_once


class NodalTangents(NodalForm, MixedForm):
    """By tangents."""

    @classmethod
    def of(cls, scene: Scene, field: TangentField) -> "NodalTangents":
        layout = CellForces(len(field.s) - 1)
        return cls(scene=scene, field=field, layout=layout, loads_beyond=field.loads_beyond(scene))

    def out_of_plane(self, normal: Float[Array, "3"]) -> "NodalTangents":
        return dataclasses.replace(self, axes=None, layout=self.layout.in_axes(None))

    def stays_in_plane(self, point: MixedPoint) -> Bool[Array, ""]:
        residual = dataclasses.replace(self, axes=None).linearized(point).residual
        return residual <= OUT_OF_PLANE * (1 + jnp.max(jnp.abs(self.forces(point))))

    def node_slopes(self, point: MixedPoint) -> Float[Array, "n+1 3"]:
        return self.slopes(point)[:, ::2].T

    @property
    def _held_by(self) -> Scene:
        """Whose supports hold tangents."""
        return with_pins(self.scene) if self.ends_move else self.scene

    def bases_at(self, point: MixedPoint) -> Float[Array, "3 b m"]:
        holding = self._held_by
        return self.field.basis(holding, self.bases(self.field.append_prescribed(holding, point.tangents)))

    def node_axes(self, point: MixedPoint) -> Float[Array, "3 b n+1"]:
        return cross(point.tangents[:, None, ::2], self.bases_at(point)[..., ::2])

    @traced_once
    def linearized(self, point: MixedPoint) -> Linearization:
        field, tangents = self.field, point.tangents
        assert isinstance(field, QuadraticRotationElements)
        holding = self._held_by
        bases, energy, blocks, torque_column, torsional_compliance = self._elastic(point, holding)
        assert blocks.across is not None
        cells = self.by_cells(point, bases, blocks)
        edges = jnp.sum(cells.lengths[None] * cells.along, axis=1).T
        contacts = contacts_at(self, point)
        assert point.nodal is not None
        rows, balance, amiss = contact_residuals(self, point, contacts)
        constraint_residual = [rows, balance.reshape(-1), self.gap_of_elements(point, edges).reshape(-1)]
        dtype = energy.dtype
        columns = [] if torque_column is None else [torque_column]
        by_point = map(field.scatter_add, (cells.gradient, cells.diagonal, cells.lengths, *columns))
        gradient, diagonal, lengths, *columns = by_point
        fields, stiffness = self.at_nodes(point), contacts.stiffness
        if fields is not None:
            gradient = gradient.at[:, ::2].add(fields.by_rotation)
            diagonal = diagonal.at[..., ::2].add(fields.by_rotations)
            stiffness += fields.by_positions
            energy += jnp.sum(fields.energy)
        gradient = contacts.added_to(gradient)
        if torsional_compliance is None:
            border, compliance = jnp.zeros((len(gradient), 0, tangents.shape[1]), dtype), jnp.zeros((0, 0), dtype)
        else:
            border, compliance = columns[0], torsional_compliance[None, None]
            constraint_residual = [jnp.zeros(1, dtype), *constraint_residual]
        free = field.basis(self.scene, bases) if self.ends_move else bases
        forces = short_sum(free * gradient[None], axis=1)
        residual = field.residual(self.scene, forces, lengths)
        system = ChainSystem(
            field.held(holding, diagonal),
            blocks.lower,
            blocks.across,
            border,
            compliance,
            cells.by_force,
            self.layout.compliance(cells.compliance),
            stiffness,
            contacts.rows,
            self.is_held,
            turning=None if fields is None else fields.turning,
            elimination=_elimination(self.scene),
        )
        return Linearization(
            bases=bases,
            gradient=gradient,
            constraint_residual=jnp.concatenate(constraint_residual),
            system=contacts.stiffened(system).in_plane(self.normal),
            energy=energy + cells.energy + jnp.sum(point.end_force.T * jnp.diff(point.nodal.positions, axis=0)),
            residual=larger(amiss, residual),
            gaps=contacts.gaps,
            reference_displacements=contacts.reference_displacements,
        )

    def residual_vectors(self, point: MixedPoint) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        return super().residual_vectors(by_law(self, point))

    def in_cells_at(self, point: MixedPoint) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        energy, segment_vectors = self.in_elements(point, point.tangents, jnp.zeros_like(point.end_force))
        energy += self.field.bending_energy(self.scene, point.tangents)
        if self.has_torsion:
            energy += density(self.scene.rod, twist=point.total_twist)
        return energy, segment_vectors

    def turning_elements(
        self, point: MixedPoint, rotation: Float[Array, "b m"], bases: Float[Array, "3 b m"]
    ) -> tuple[Array, Array]:
        return point.tangents, jnp.sum(bases * rotation[None], axis=1)

    def in_elements(
        self, point: MixedPoint, elements: Float[Array, "3 m"], change: Float[Array, "3 n"]
    ) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        there = MixedPoint(elements, point.end_force + change, point.total_twist)
        _, tension = self.forces_and_tensions(there)
        strain = axial_strain_under(self.scene.rod, tension)
        lengths = self.field.quadrature_weights * (1 + strain)
        energy = jnp.sum(
            self.field.quadrature_weights * density(self.scene.rod, axial_strain=strain) - lengths * tension
        )
        return energy, short_sum(lengths[None] * self.field.gather(elements), axis=1).T


class NodalFrames(NodalForm, FrameForm):
    """By frames."""

    @classmethod
    def of(cls, scene: Scene, field: Cells) -> "NodalFrames":
        parts = parts_of(scene, field)
        return cls(**{**parts, "layout": CellForces(len(field.s) - 1)})

    def node_slopes(self, point: FramePoint) -> Float[Array, "n+1 3"]:
        here = self.strained(point)
        strain = self.field.scatter_add(self.field.lengths * here.stretched) / self.field.weights
        slopes = (1 + strain)[None] * point.tangents
        if here.sideways is not None:
            slopes += self.field.scatter_add(self.field.lengths[None] * here.sideways) / self.field.weights[None]
        return slopes[:, ::2].T

    def node_axes(self, point: FramePoint) -> Float[Array, "3 3 n+1"]:
        return product(columns(point.quaternions[:, ::2]), self._projections[..., ::2])

    @property
    def held_frames(self) -> list[HeldFrame]:
        """All but those of ends that are no longer held."""
        held = super().held_frames
        is_end = [isinstance(one.number, int) and one.frame is not None for one in held]
        return [one for one, end in zip(held, is_end, strict=True) if not (end and self.ends_move)]

    # --- loads without a potential -----------------------------------------------------------------------------------

    def following(self, quaternions: Float[Array, "4 m"]) -> Float[Array, "3 3 n"] | None:
        return nonconservative.following(self.scene, self._elements, self.field.gather(quaternions))

    def couples_along(self, quaternions: Float[Array, "4 m"]) -> Float[Array, "3 3 n"] | None:
        return nonconservative.couples_along(self.scene, self._elements, self.field.gather(quaternions))

    def loads_on_nodes(self, point: FramePoint) -> Float[Array, "3 n+1"] | None:
        of_fields = super().loads_on_nodes(point)
        if self.has_potential:
            return of_fields
        loads = self._following_at_nodes(point)
        return loads if of_fields is None else loads + of_fields

    def _following_at_nodes(self, point: FramePoint) -> Float[Array, "3 n+1"]:
        loads = nonconservative.on_nodes(self.scene, self._elements, self.field.gather(point.quaternions))
        return jnp.pad(loads[0], ((0, 0), (0, 1))) + jnp.pad(loads[1], ((0, 0), (1, 0)))

    @property
    def holds_loads(self) -> bool:
        return not self.has_potential and has_contacts(self.scene)

    def held_loads(self, point: FramePoint) -> HeldLoads:
        moments = nonconservative.couples(self.scene, self._elements, self.field.gather(point.quaternions))
        if self.following(point.quaternions) is not None:
            without = dataclasses.replace(self, scene=nonconservative.conservative(self.scene))
            moments += without.by_rotations(point.quaternions, point.end_force)
            moments -= self.by_rotations(point.quaternions, point.end_force)
        return HeldLoads(self.projected(self.field.scatter_add(moments)), self._following_at_nodes(point))

    def end_forces(self, point: FramePoint, fields: OnElements | None) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        if self.has_potential:
            return super().end_forces(point, fields)
        q = point.quaternions
        forces = self.with_fields(self.forces(q, point.end_force), fields)
        found = [forces[:, 0, 0], forces[:, -1, -1]]
        for end, k, sign in ((self.scene.start, 0, -1), (self.scene.end, -1, 1)):
            if isinstance(end, Free):
                given = jnp.zeros_like(found[k]) if end.force is None else end.force
                found[k] = sign * (rotated(q[:, k], given) if end.follower else given)
        return found[0], found[1]

    @property
    def _elements(self) -> ElementCells:
        assert isinstance(self.field, ElementCells)
        return self.field

    def _moments(self, point: FramePoint) -> Float[Array, "3 m"]:
        """The derivative of L by the rotations, less couples."""
        gradient = self.by_rotations(point.quaternions, point.end_force)
        if not self.has_potential:
            gradient -= nonconservative.couples(self.scene, self._elements, self.field.gather(point.quaternions))
        return self.projected(self.field.scatter_add(gradient))

    def _load_rows(self, point: FramePoint) -> LoadRows:
        field, scene = self._elements, self.scene
        q = field.gather(point.quaternions)
        cells, base = self._cells(point.quaternions, point.end_force), self.through(point.end_force) + self.loads
        kinematics, couples = self.kinematics(q), nonconservative.couples(scene, field, q)

        def rows(turn: Float[Array, "3 3 n"]) -> tuple[Array, Array, Array]:
            """Of what the loads change alone: moments, gaps and the balance of nodes."""
            there = turned(q, turn)
            following = nonconservative.following(scene, field, there)
            forces = base if following is None else base + following
            # By the virtual work in what turns the frames, of which only half is a turn of the couple beside its frame.
            moments = first_derivatives(cells._replace(forces=forces)) - cross(turn, couples) / 2
            moments -= nonconservative.couples(scene, field, there)
            segment_vectors = short_sum(self.strained_under(kinematics, forces).weighted_slopes, axis=1)
            return moments, -segment_vectors, -nonconservative.on_nodes(scene, field, there)

        along = field.gather(self._projections.reshape(9, -1)).reshape(3, 3, *q.shape[1:])  # [a, b, point, n]
        alone = jnp.eye(q.shape[1], dtype=q.dtype)[None, :, None, :, None]
        zero, turns = jnp.zeros_like(q[1:]), (along[:, None] * alone).reshape(-1, *q[1:].shape)
        derivatives = jax.vmap(lambda turn: jax.jvp(rows, (zero,), (turn,))[1])(turns)
        moments, segment_vectors, balance = (rows.reshape(3, 3, *rows.shape[1:]) for rows in derivatives)
        moments = jnp.einsum("xain,bjain->xibjn", along, moments)
        return LoadRows(moments, jnp.einsum("bjan->abjn", segment_vectors), jnp.einsum("bjkan->kabjn", balance))

    @property
    def _projections(self) -> Float[Array, "3 3 m"]:
        if self.across is not None:
            return self._projection
        return jnp.eye(3, dtype=self.loads.dtype)[..., None] * self.is_free[None]

    # --- derivatives -------------------------------------------------------------------------------------------------

    @traced_once
    def linearized(self, point: FramePoint) -> Linearization:
        cells, gradient, (diagonal, lower, across) = self.by_cells(point)
        if not self.has_potential:
            gradient = self._moments(point)
        fields = self.at_nodes(point)
        if fields is not None:
            gradient = gradient.at[:, ::2].add(fields.by_rotation)
            diagonal = diagonal.at[..., ::2].add(fields.by_rotations)
        assert across is not None, "elements, not joints"
        contacts = contacts_at(self, point)
        gradient = contacts.added_to(gradient)
        assert point.nodal is not None
        rows, balance, amiss = contact_residuals(self, point, contacts)
        dtype = gradient.dtype
        system = ChainSystem(
            diagonal,
            lower,
            across,
            jnp.zeros((3, 0, gradient.shape[1]), dtype),
            jnp.zeros((0, 0), dtype),
            self._by_force(cells),
            self.layout.compliance(cells.compliance),
            contacts.stiffness if fields is None else contacts.stiffness + fields.by_positions,
            contacts.rows,
            self.is_held,
            None if self.has_potential else self._load_rows(point),
            None if fields is None else fields.turning,
            elimination=_elimination(self.scene),
        )
        gaps = self.gap_of_elements(point, cells.segment_vectors.T)
        held = dataclasses.replace(self, ends_move=False)
        energy = jnp.sum(cells.value) + jnp.sum(point.end_force.T * jnp.diff(point.nodal.positions, axis=0))
        return Linearization(
            bases=self.bases_at(point),
            gradient=gradient,
            constraint_residual=jnp.concatenate([rows, balance.reshape(-1), gaps.reshape(-1)]),
            system=contacts.stiffened(system).in_plane(self.normal),
            energy=energy if fields is None else energy + jnp.sum(fields.energy),
            residual=larger(amiss, self._residual(held.projected(gradient) if self.ends_move else gradient)),
            gaps=contacts.gaps,
            reference_displacements=contacts.reference_displacements,
        )

    def _by_force(self, cells: CellDerivatives) -> Float[Array, "3 3 3 n"]:
        by_force = cells.by_force * self.field.gather(self.is_free)[:, None]
        if self.across is None:
            return by_force
        return self.across[:, None, None, None] * jnp.tensordot(self.across, by_force, 1)[None]

    def residual_vectors(self, point: FramePoint) -> tuple[Float[Array, "3 m"], Float[Array, "k"]]:
        point = by_law(self, point)
        gradient, fields = self._moments(point), self.at_nodes(point)
        if fields is not None:
            gradient = gradient.at[:, ::2].add(fields.by_rotation)
        contacts = contacts_at(self, point)
        gradient = contacts.added_to(gradient)
        rows, balance, _ = contact_residuals(self, point, contacts)
        gaps = self.gap_of_elements(point, self.edges(point))
        return gradient, jnp.concatenate([rows, balance.reshape(-1), gaps.reshape(-1)])

    def in_cells_at(self, point: FramePoint) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        kinematics = self.kinematics(self.field.gather(point.quaternions))
        return self.in_elements(point, kinematics, jnp.zeros_like(point.end_force))

    def turning_elements(
        self, point: FramePoint, rotation: Float[Array, "3 m"], bases: Float[Array, "3 3 m"]
    ) -> tuple[Kinematics, Kinematics]:
        return self.turning(point, rotation)

    def in_elements(
        self, point: FramePoint, elements: Kinematics, change: Float[Array, "3 n"]
    ) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        value, segment_vectors = self.in_cells(elements, point.end_force + change)
        return value, segment_vectors.T


def _elimination(scene: Scene) -> Elimination:
    if has_free_ends(scene):
        return Elimination.WITH_FORCES
    is_from_end = isinstance(scene.end, Held) and not isinstance(scene.start, Held)
    return Elimination.FROM_END if is_from_end else Elimination.FROM_START
