"""The finite differences in other unknowns: unit tangents of the edges, and the force that runs through the rod.

Under dead loads the force in every edge is known up to one vector, the force at s = L, and that follows from the
closure of the polyline between two held ends. So an equilibrium is a saddle point of

    L(t, F) = bending(t) + torsion(t) + sum h [w(e) - n . t (1 + e)] + F . span,    n_i = F + loads beyond edge i,

a minimum over tangents t that close the polyline and a maximum over F (Lagrange's multiplier); the axial strain e of an
edge is the one at which dw/de = n . t. Tension is in n and not in a difference of lengths, so that neither the
iterations nor the rounding depend on EA: the mixed treatment of stretch (Magisano, Leonetti & Garcea 2017) carried
through. Steps are rotations, in which bending is nearly quadratic even where new end tangents kink the rod.

A dead moment M on a free end has no potential. There the virtual work M . (rotation of the end) enters the gradient:
the tangent t turns by t x dt, and the section spins about it by as much as keeps the torque M . t along the rod.

The second derivatives couple neighbouring edges only, two numbers each; the closure and the torsion, which all edges
share, are a border of four columns (`linalg.SaddlePointSystem`). Arrays along the rod have the components first.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.chain import ChainSystem
from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.first_twist import FirstTwist, twist_on
from rodjax.discretization.form import FLOOR_SAFETY, NEUTRAL, Form, Linearization
from rodjax.discretization.joints import outer, rotated, tangent_bases
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import Blocks, TangentField
from rodjax.discretization.twist import nearest_twist, twist_under_moment
from rodjax.energy import axial_strain_under, density
from rodjax.linalg import AnySystem, SaddlePointSystem, short_sum
from rodjax.scene import Scene, dead_end_moment, held_position
from rodjax.supports import Clamp, Free, Held
from rodjax.vectors import components, dot


class MixedPoint(eqx.Module):
    """Unit tangents of the edges; the force at s = L between held ends, else zero; the total twist [rad], else zero."""

    tangents: Float[Array, "3 n"]
    end_force: Float[Array, "3"]
    total_twist: Float[Array, ""]

    def flattened(self, axes: Float[Array, "3 2"]) -> "MixedPoint":
        """The point without what leaves the plane of these two axes, and without twist."""
        in_plane = axes.T @ self.tangents
        sizes = jnp.sqrt(dot(in_plane, in_plane))[None]
        in_plane = jnp.where(sizes > 0, in_plane / jnp.where(sizes > 0, sizes, 1.0), jnp.eye(2, 1, dtype=sizes.dtype))
        return MixedPoint(axes @ in_plane, axes @ (axes.T @ self.end_force), jnp.zeros_like(self.total_twist))


class Elastic(NamedTuple):
    """Bending and torsion of a `Linearization`.

    `torque_column`: by the torque; `softness`: of the rod against it where the total twist is given; else `None`.
    """

    bases: Float[Array, "3 b m"]
    energy: Float[Array, ""]
    blocks: Blocks
    torque_column: Float[Array, "b 1 m"] | None
    softness: Float[Array, ""] | None


class Stretched(NamedTuple):
    """Parts of a `Linearization` and the lengths of the points; the last three are `None` without closure."""

    energy: Float[Array, ""]
    gradient: Float[Array, "b m"]
    diagonal: Float[Array, "b b m"]
    lengths: Float[Array, "m"]
    border: Float[Array, "b c m"] | None
    closure: Float[Array, "c"] | None
    compliance: Float[Array, "c c"] | None


class MixedForm(Form):
    """A nondimensional scene on a field of tangents, as a function of a `MixedPoint`.

    `forces_beyond`: what the loads exert on what lies beyond each point; `force_spread`: as in `TangentField`, as the
    energy of stretch is the mean of that on both sides of a point force; `axes`: unit vectors along which the rod may
    leave its place, `None` for all of space: two for a rod in a plane, its normal for motions out of it. In a symmetric
    scene the two kinds do not couple.
    """

    scene: Scene
    field: TangentField
    forces_beyond: Float[Array, "3 m"]
    force_spread: Float[Array, "3 3 m"] | None
    axes: Float[Array, "3 a"] | None = None

    @classmethod
    def of(cls, scene: Scene, field: TangentField) -> "MixedForm":
        return cls(
            scene=scene, field=field, forces_beyond=field.forces_beyond(scene), force_spread=field.force_spread(scene)
        )

    def along(self, axes: Float[Array, "3 a"]) -> "MixedForm":
        return MixedForm(
            scene=self.scene,
            field=self.field,
            forces_beyond=self.forces_beyond,
            force_spread=self.force_spread,
            axes=axes,
        )

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
        return self.field.basis(self.scene, self.bases(self.field.with_held(self.scene, point.tangents)))

    def turn(self, point: MixedPoint, bases: Float[Array, "3 b n"], axis: Float[Array, "3"]) -> Float[Array, "b n"]:
        """The rotations that turn the whole rod about an axis."""
        return components(bases, jnp.cross(axis[:, None], point.tangents, axis=0))

    def holding(self, point: MixedPoint) -> MixedPoint:
        """The point with the tangents that supports hold, and the total twist of the scene."""
        tangents = self.field.as_held(self.scene, point.tangents)
        return MixedPoint(tangents, point.end_force, self.twist_near(tangents, point.total_twist))

    def settled(self, point: MixedPoint) -> MixedPoint:
        """The point where a solver stopped, with all that is known of it."""
        return point

    @property
    def has_torsion(self) -> bool:
        """Whether two clamps prescribe the total twist, and the rod may leave a plane."""
        is_planar = self.axes is not None and self.axes.shape[1] == 2
        return isinstance(self.scene.start, Clamp) and isinstance(self.scene.end, Clamp) and not is_planar

    @property
    def has_potential(self) -> bool:
        return dead_end_moment(self.scene) is None

    def with_end_force(self, point: MixedPoint, loads: Float[Array, "3 *c n"]) -> Float[Array, "3 *c n"]:
        """The force through the rod, from what the loads beyond exert; `n`: elements or edges."""
        return point.end_force[(slice(None), *[None] * (loads.ndim - 1))] + loads

    def along_spans(self, ways: Float[Array, "3 n"]) -> Float[Array, "3"]:
        """What elements or edges add up to between held ends."""
        return jnp.sum(ways, axis=1)

    def edge_tension(self, point: MixedPoint) -> Float[Array, "n"]:
        return dot(point.end_force[:, None] + self.forces_beyond, point.tangents)

    def slopes(self, point: MixedPoint) -> Float[Array, "3 m"]:
        """The derivative of the centerline by arclength."""
        strain = axial_strain_under(self.scene.rod, self.edge_tension(point))
        return (1 + strain)[None] * point.tangents

    def edges(self, point: MixedPoint) -> Float[Array, "n 3"]:
        """From node to node."""
        ways = self.field.ways(self.slopes(point))
        if self.force_spread is not None:
            _, softness = self._strain(point)
            ways += self.field.ways_of_spread(self.scene, point.tangents, softness)
        return ways

    def load_energy(self, point: MixedPoint) -> Float[Array, ""]:
        """The potential of gravity and dead forces, zero at the origin."""
        work = jnp.sum(self.field.weights * dot(self.forces_beyond, self.slopes(point)))
        work += 2 * self.stretching_of_spread(point)
        return -work - jnp.sum(total_force(self.scene) * held_position(self.scene))

    def elastic_energy(self, point: MixedPoint) -> Float[Array, ""]:
        rod = self.scene.rod
        strain = axial_strain_under(rod, self.edge_tension(point))
        stretching = jnp.sum(self.field.weights * density(rod, axial_strain=strain)) + self.stretching_of_spread(point)
        bending = self.field.bending_energy(self.scene, point.tangents)
        return bending + stretching + density(rod, twist=point.total_twist)

    def stretching_of_spread(self, point: MixedPoint) -> Float[Array, ""]:
        """What the energy of stretch on both sides of the points is above that of their mean tension."""
        if self.force_spread is None:
            return jnp.zeros((), point.tangents.dtype)
        _, softness = self._strain(point)
        return jnp.sum(softness * dot(_times(self.force_spread, point.tangents), point.tangents)) / 2

    def _strain(self, point: MixedPoint) -> tuple[Float[Array, "m"], Float[Array, "m"]]:
        """The axial strain, and its derivative by tension."""
        tension = self.edge_tension(point)
        return jax.jvp(
            lambda tension: axial_strain_under(self.scene.rod, tension), (tension,), (jnp.ones_like(tension),)
        )

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

    def moved(
        self,
        point: MixedPoint,
        bases: Float[Array, "3 b n"],
        rotation: Float[Array, "b n"],
        force_change: Float[Array, "3"],
    ) -> MixedPoint:
        tangents = rotated(point.tangents, bases, rotation)
        twist = point.total_twist
        if self.has_torsion:
            twist += self.field.swept(self.scene, point.tangents, tangents)
        elif not self.has_potential:
            twist = twist_under_moment(self.scene, tangents)
        return MixedPoint(tangents, point.end_force + force_change, twist)

    def linearized(self, point: MixedPoint) -> Linearization:
        scene, tangents = self.scene, point.tangents
        bases, energy, blocks, torque_column, softness = self._elastic(point)
        columns, closure, compliance = [], [], []
        if softness is not None:
            columns.append(torque_column)
            closure.append(jnp.zeros(1, energy.dtype))
            compliance.append(softness[None, None])
        stretched = self._stretched(point, bases, self.field.weights, energy, blocks.gradient, blocks.diagonal)
        energy, gradient, diagonal, lengths = (
            stretched.energy,
            stretched.gradient,
            stretched.diagonal,
            stretched.lengths,
        )
        if stretched.border is not None:
            columns.append(stretched.border)
            closure.append(stretched.closure)
            compliance.append(stretched.compliance)
        rows = None
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
            columns = [torque_column, at_edge.set(spin)]
            torque_row = jnp.zeros((2, 1, n), energy.dtype).at[:, 0, edge].set(sign * moment @ basis)
            rows = jnp.concatenate([torque_row, at_edge.set(jnp.array([[0.0, 1.0], [1.0, 0.0]], energy.dtype))], axis=1)
            closure, compliance = [jnp.zeros(3, energy.dtype)], [jnp.eye(3, dtype=energy.dtype)]
        return Linearization(
            bases=bases,
            gradient=gradient,
            closure=jnp.concatenate(closure) if closure else jnp.zeros(0, energy.dtype),
            system=SaddlePointSystem(
                self.field.held(scene, diagonal),
                blocks.lower,
                jnp.concatenate(columns, axis=1) if columns else jnp.zeros((*gradient.shape[:1], 0, gradient.shape[1])),
                jax.scipy.linalg.block_diag(*compliance) if compliance else jnp.zeros((0, 0), energy.dtype),
                rows,
                blocks.across,
            ),
            energy=energy,
            residual=self.field.residual(scene, short_sum(bases * gradient[None], axis=1), lengths),
        )

    def _elastic(self, point: MixedPoint) -> Elastic:
        scene, rod, field, tangents = self.scene, self.scene.rod, self.field, point.tangents
        all_bases = self.bases(field.with_held(scene, tangents))
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

    def _stretched(
        self,
        point: MixedPoint,
        bases: Float[Array, "3 b m"],
        weights: Float[Array, "m"],
        energy: Float[Array, ""],
        gradient: Float[Array, "b m"],
        diagonal: Float[Array, "b b m"],
    ) -> Stretched:
        """With what stretch, loads and closure add to the derivatives of bending and torsion."""
        scene, rod, tangents = self.scene, self.scene.rod, point.tangents
        forces = point.end_force[:, None] + self.forces_beyond
        tension = dot(forces, tangents)
        strain, softness = self._strain(point)
        lengths = weights * (1 + strain)
        across = components(bases, forces)
        gradient -= lengths[None] * across
        identity = jnp.eye(bases.shape[1], dtype=energy.dtype)[..., None]
        diagonal += (lengths * tension)[None, None] * identity
        diagonal -= (weights * softness)[None, None] * outer(across, across)
        energy += jnp.sum(weights * (density(rod, axial_strain=strain) - tension * (1 + strain)))
        if self.force_spread is not None:
            spread = _times(self.force_spread, tangents)
            along = softness * dot(spread, tangents)
            of_bases = short_sum(self.force_spread[:, :, None] * bases[None], axis=1)
            energy -= jnp.sum(along) / 2
            gradient -= softness[None] * components(bases, spread)
            diagonal += along[None, None] * identity
            diagonal -= softness[None, None] * short_sum(bases[:, :, None] * of_bases[:, None], axis=0)
        if isinstance(scene.start, Held) and isinstance(scene.end, Held):
            span = scene.end.position - scene.start.position
            energy += jnp.sum(point.end_force * span)
            lacking = span - tangents @ lengths
            directions, along = jnp.swapaxes(bases, 0, 1), tangents
            if self.axes is not None:
                lacking = lacking @ self.axes
                directions = short_sum(directions[:, None] * self.axes.T[None, :, :, None], axis=2)
                along = self.axes.T @ tangents
            border = -lengths[None, None] * directions - (weights * softness)[None, None] * outer(across, along)
            compliance = ((weights * softness)[None] * along) @ along.T
            return Stretched(energy, gradient, diagonal, lengths, border, lacking, compliance)
        return Stretched(energy, gradient, diagonal, lengths, None, None, None)

    def regular(self, system: AnySystem) -> AnySystem:
        """The system of a linearisation, neutral modes held."""
        assert isinstance(system, SaddlePointSystem | ChainSystem)
        return system.shifted(jnp.asarray(NEUTRAL / system.diagonal.shape[-1], system.diagonal.dtype))

    def under_force(
        self, point: MixedPoint, bases: Float[Array, "3 b n"], rotation: Float[Array, "b n"], change: Float[Array, "3"]
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        """With another end force: what the rod lacks of its span and the rate of that as the tangents begin to turn;
        by how much L differs, and by how much the rate of L does.
        """
        start, end = self.scene.start, self.scene.end
        if not (isinstance(start, Held) and isinstance(end, Held)):
            nothing = jnp.zeros(0, change.dtype)
            return nothing, nothing, jnp.zeros_like(change[0]), jnp.zeros_like(change[0])
        span = end.position - start.position
        weights = self.field.weights

        def parts(tangents: Float[Array, "3 n"], force: Float[Array, "3"]) -> tuple[Array, Array]:
            tension = dot(force[:, None] + self.forces_beyond, tangents)
            strain = axial_strain_under(self.scene.rod, tension)
            stretching = weights * (density(self.scene.rod, axial_strain=strain) - tension * (1 + strain))
            return jnp.sum(stretching) + force @ span, span - tangents @ (weights * (1 + strain))

        turning = short_sum(bases * rotation[None], axis=1)

        def rates(force: Float[Array, "3"]):
            return jax.jvp(lambda tangents: parts(tangents, force), (point.tangents,), (turning,))

        (energy, closure), (rate, closure_rate) = rates(point.end_force + change)
        (before, _), (rate_before, _) = rates(point.end_force)
        return self.of_force(closure), self.of_force(closure_rate), energy - before, rate - rate_before

    def rounding_floor(self, point: MixedPoint) -> Float[Array, ""]:
        """Residual [EI/L^2] that rounding alone leaves at an equilibrium of this mesh, see `docs/design.md`."""
        largest = jnp.max(jnp.abs(point.end_force[:, None] + self.forces_beyond))
        eps = jnp.finfo(largest.dtype).eps
        return FLOOR_SAFETY * eps * (4.0 * largest + 4.0 / self.field.finest**2)


def _times(matrices: Float[Array, "3 3 m"], vectors: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
    return short_sum(matrices * vectors[None], axis=1)


def _with_derivatives(
    function: Callable[[Float[Array, ""]], Float[Array, ""]], x: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """A function of one number, its first and second derivative."""
    (value, first), (_, second) = jax.jvp(jax.value_and_grad(function), (x,), (jnp.ones_like(x),))
    return value, first, second
