"""The two forms of a rod that touches obstacles: by tangents and by frames.

Both differ from those of rods that touch nothing in the system and in what L is under other forces alone.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cell_derivatives import CellDerivatives
from rodjax.discretization.cells import Cells
from rodjax.discretization.form import Linearization
from rodjax.discretization.framed import FrameForm, FramePoint, Kinematics
from rodjax.discretization.framed_parts import parts_of
from rodjax.discretization.hermite import HermiteElements
from rodjax.discretization.layout import CellForces
from rodjax.discretization.mixed import MixedForm, MixedPoint
from rodjax.discretization.tangent_field import TangentField
from rodjax.discretization.touching import TouchingForm
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.chain import ChainSystem
from rodjax.mechanics.energy import axial_strain_under, density
from rodjax.model.scene import Scene
from rodjax.model.supports import Held


class TouchingTangents(TouchingForm, MixedForm):
    """By tangents."""

    @classmethod
    def of(cls, scene: Scene, field: TangentField) -> "TouchingTangents":
        loads_beyond = field.loads_beyond(scene)
        return cls(
            scene=scene,
            field=field,
            layout=CellForces(len(field.s) - 1),
            loads_beyond=loads_beyond,
            softening=jnp.ones((), loads_beyond.dtype),
        )

    def out_of_plane(self, normal: Float[Array, "3"]) -> "TouchingTangents":
        return dataclasses.replace(self, axes=None, layout=self.layout.in_axes(None))

    def node_slopes(self, point: MixedPoint) -> Float[Array, "n+1 3"]:
        return self.slopes(point)[:, ::2].T

    def largest_force(self, point: MixedPoint) -> Float[Array, ""]:
        return jnp.max(jnp.abs(self.forces(point)))

    def linearized(self, point: MixedPoint) -> Linearization:
        field, tangents = self.field, point.tangents
        assert isinstance(field, HermiteElements)
        bases, energy, blocks, torque_column, softness = self._elastic(point)
        assert blocks.across is not None
        cells = self._by_cells(point, bases, blocks)
        edges = jnp.sum(cells.lengths[None] * cells.along, axis=1).T
        balance, second = self._balance(edges, point.end_force)
        closure = [balance.reshape(-1), self._gaps(edges).reshape(-1)]
        dtype = energy.dtype
        columns = [] if torque_column is None else [torque_column]
        by_point = map(field.of_points, (cells.gradient, cells.diagonal, cells.lengths, *columns))
        gradient, diagonal, lengths, *columns = by_point
        if softness is None:
            border, compliance = jnp.zeros((len(gradient), 0, tangents.shape[1]), dtype), jnp.zeros((0, 0), dtype)
        else:
            border, compliance = columns[0], softness[None, None]
            closure = [jnp.zeros(1, dtype), *closure]
        forces = short_sum(bases * gradient[None], axis=1)
        residual = field.residual(self.scene, forces, lengths)
        system = ChainSystem(
            field.held(self.scene, diagonal),
            blocks.lower,
            blocks.across,
            border,
            compliance,
            cells.by_force,
            self.layout.compliance(cells.compliance),
            second,
            self.is_held,
            is_backward=not isinstance(self.scene.start, Held),
        )
        return Linearization(
            bases=bases,
            gradient=gradient,
            closure=jnp.concatenate(closure),
            system=system,
            energy=energy + self._stretching(tangents, point.end_force)[0],
            residual=_larger(jnp.max(jnp.abs(balance)), residual),
        )

    def _stretching(
        self, tangents: Float[Array, "3 m"], end_force: Float[Array, "3 n"]
    ) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        """The energy of stretch, loads, contacts and of what closes the spans; and the gaps."""
        weights = self.field.side_weights
        _, tension = self.forces_and_tensions(MixedPoint(tangents, end_force, jnp.zeros((), end_force.dtype)))
        strain = axial_strain_under(self.scene.rod, tension)
        ways = (weights * (1 + strain))[None] * self.field.of_sides(tangents)
        edges = jnp.sum(ways, axis=1).T
        gaps = self._gaps(edges)
        energy = jnp.sum(weights * density(self.scene.rod, axial_strain=strain)) - jnp.sum(self.loads_beyond * ways)
        return energy + self._contact_energy(self.positions(edges)) + jnp.sum(end_force * gaps.T), gaps

    def under_force(
        self,
        point: MixedPoint,
        here: Linearization,
        rotation: Float[Array, "b m"],
        change: Float[Array, "3 n"],
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        turning = jnp.sum(here.bases * rotation[None], axis=1)
        (energy, gaps), (rate, gap_rates) = jax.jvp(
            lambda tangents: self._stretching(tangents, point.end_force + change), (point.tangents,), (turning,)
        )
        before, _ = self._stretching(point.tangents, point.end_force)
        # Of the gradient by rotations, which has the forces as they are.
        forces, tension = self.forces_and_tensions(point)
        lengths = self.field.side_weights * (1 + axial_strain_under(self.scene.rod, tension))
        counted = -jnp.sum(lengths * short_sum(forces * self.field.of_sides(turning), axis=0))
        return gaps.reshape(-1), gap_rates.reshape(-1), energy - before, rate - counted


class TouchingFrames(TouchingForm, FrameForm):
    """By frames."""

    @classmethod
    def of(cls, scene: Scene, field: Cells) -> "TouchingFrames":
        parts = parts_of(scene, field)
        layout = CellForces(len(field.s) - 1)
        return cls(**{**parts, "layout": layout}, softening=jnp.ones((), field.s.dtype))

    def node_slopes(self, point: FramePoint) -> Float[Array, "n+1 3"]:
        strain = self.field.assembled(self.field.lengths * self.strained(point).axial) / self.field.weights
        return ((1 + strain)[None] * point.tangents)[:, ::2].T

    def largest_force(self, point: FramePoint) -> Float[Array, ""]:
        return jnp.max(jnp.abs(self.forces(point.quaternions, point.end_force)))

    def linearized(self, point: FramePoint) -> Linearization:
        cells, gradient, (diagonal, lower, across) = self.by_cells(point)
        assert across is not None, "elements, not joints"
        edges = cells.way.T
        balance, second = self._balance(edges, point.end_force)
        dtype = gradient.dtype
        system = ChainSystem(
            diagonal,
            lower,
            across,
            jnp.zeros((3, 0, gradient.shape[1]), dtype),
            jnp.zeros((0, 0), dtype),
            self._by_force(cells),
            self.layout.compliance(cells.compliance),
            second,
            self.is_held,
            is_backward=not isinstance(self.scene.start, Held),
        )
        return Linearization(
            bases=self.bases_at(point),
            gradient=gradient,
            closure=jnp.concatenate([balance.reshape(-1), self._gaps(edges).reshape(-1)]),
            system=system,
            energy=self._with_contacts(jnp.sum(cells.value), edges, point.end_force),
            residual=_larger(jnp.max(jnp.abs(balance)), self._residual(gradient)),
        )

    def _by_force(self, cells: CellDerivatives) -> Float[Array, "3 3 3 n"]:
        by_force = cells.by_force * self.field.of_cells(self.is_free)[:, None]
        if self.across is None:
            return by_force
        return self.across[:, None, None, None] * jnp.tensordot(self.across, by_force, 1)[None]

    def unbalanced(self, point: FramePoint) -> tuple[Float[Array, "3 m"], Float[Array, "k"]]:
        gradient = self.field.assembled(self.by_rotations(point.quaternions, point.end_force))
        edges = self.edges(point)
        balance, _ = self._balance(edges, point.end_force)
        return self.projected(gradient), jnp.concatenate([balance.reshape(-1), self._gaps(edges).reshape(-1)])

    def _with_contacts(
        self, value: Float[Array, ""], edges: Float[Array, "n 3"], end_force: Float[Array, "3 n"]
    ) -> Float[Array, ""]:
        """L, of what the cells add to it under the forces through them."""
        across = jnp.sum(end_force.T * (edges + self._gaps(edges)))
        return value + across + self._contact_energy(self.positions(edges))

    def under_force(
        self, point: FramePoint, here: Linearization, rotation: Float[Array, "3 m"], change: Float[Array, "3 n"]
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        kinematics, rates = self.turning(point, rotation)

        def parts(of_frames: Kinematics, force: Float[Array, "3 n"]) -> tuple[Array, Array]:
            value, ways = self.in_cells(of_frames, force)
            return self._with_contacts(value, ways.T, force), self._gaps(ways.T)

        (energy, gaps), (rate, gap_rates) = jax.jvp(
            lambda of_frames: parts(of_frames, point.end_force + change), (kinematics,), (rates,)
        )
        before, _ = parts(kinematics, point.end_force)
        counted = jnp.sum(rotation * here.gradient)
        return gaps.reshape(-1), gap_rates.reshape(-1), energy - before, rate - counted


def _larger(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    """With the derivative of one of them."""
    return jnp.where(a > b, a, b)
