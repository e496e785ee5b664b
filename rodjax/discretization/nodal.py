"""Rods whose nodes have positions of their own, and a force in each element: beside obstacles, or under loads without a
potential, where what acts on the rod depends on where it is or how it turns.

The force F through an element is the multiplier of its vector from node to node, and the positions of the nodes are
unknowns of their own: so what acts on an element depends on what is local, the system is a chain, and a step of
Newton's method moves nodes along straight lines. `nodal_forms.NodalFrames` has loads without a potential.

No node is nearer to an obstacle than the rod is thick: gap g >= 0, and no middle of an element (`inner_contacts`) to
an obstacle without friction. The pressure p >= 0 [a force, for each obstacle and node or middle] is the multiplier of
that:

    L = L of the elements + sum F . (x_after - x_before - segment vector of the element) - sum p g

With friction the multiplier of the slip s, what a node has gone along the obstacle since the last equilibrium, is the
tangential force q, |q| <= mu p. In the model of a step the bound has the pressure as it is, so that the model has a
minimum and is symmetric; both agree in the end. `friction` has it as a function of positions and pressures.

A step is the minimum of a model, L to second order with each gap to first: every node stays on its side of the
tangent plane of each obstacle, which of a convex one separates, so that no step, nor a part of it, leads through. Which
contacts are closed in the model is sought to its end before a step is taken (`linalg.unilateral`). Elements only.

A rod that lies within an obstacle has its gaps seen larger by half of its depth: each step leads it half of the way
out.
"""

import dataclasses
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization import potentials
from rodjax.discretization.form import FLOOR_SAFETY, Form, Linearization
from rodjax.discretization.friction import LEAST_SLIP, directions, lengths, pulled, tangential, within
from rodjax.discretization.inner_contacts import Middles
from rodjax.discretization.layout import CellForces, SpanForces
from rodjax.discretization.nodal_point import Friction, Nodal, NodalChange
from rodjax.discretization.potentials import NodeEnergy, OnElements
from rodjax.discretization.self_contact import (
    Curve,
    Exerted,
    SelfContacts,
    comes_through,
    exerted,
    on_elements,
    self_contacts,
)
from rodjax.geometry.interpolation import cubic
from rodjax.geometry.vectors import dot
from rodjax.linalg.chain import ChainSystem, ContactRows, InnerRows
from rodjax.linalg.saddle_point import AnySystem
from rodjax.linalg.unilateral import Unilateral, minimized
from rodjax.mechanics.passage import SAMPLES
from rodjax.model.along import Value, largest_beside, value_at
from rodjax.model.obstacles import InUnits, Obstacle, least
from rodjax.model.scene import Scene, has_contacts
from rodjax.model.supports import Clamp, Held

# Of a contact in the model of a step, as a part of an element's own, h^3/EI. So much of a pressure's change, times some
# 200, is asked for again in the next step; the smaller, the more digits the elimination loses.
CONTACT_COMPLIANCE = 1e-5
# And at least this times the rounding unit [L^3/EI] where elements are touched in their middles: elimination goes from
# one node of such an element to the other, and rounds the stiffness of the rest of the rod by that of the contact.
LEAST_COMPLIANCE = 5e4
# Of contacts between elements [L^3/EI], whose gaps are far from linear where the rod slides along itself: a small one
# would refuse all but short steps. Pressures are multipliers, so that it does not stay in the result.
FAR_COMPLIANCE = 1e-6
# In the middle of elements the rod counts as thinner by this part. Where it lies along an obstacle, nodes and middles
# would say the same, and who bears it would be undetermined: so nodes do.
THINNER = 1e-5
# A gap counts as so much of a force in EI/L^2 when it is asked whether a search has ended.
GAP_WEIGHT = 1e4
# A rod less deep within an obstacle than this [L] is led out in one step.
LEAST_RELAXED = 1e-3
# A step takes no place deeper than this, in parts of the radius, into an obstacle; one that is there already so much
# deeper. Into one that is less thick than the rod none nearer than a part of the radius, else short steps would lead
# through in turn. Looked at are the nodes and these parts of elements; their way at most so often, further on each time
# by the distance, or so much at least.
DEEPEST = 0.5
DEEPER = 0.125
NEAREST = 0.25
THIN = 0.5
LOOKED_AT = tuple(k / 8 for k in range(1, 8))
LEAST_WAY = 0.05
MOST_LOOKS = 24
# Where it is looked whether a rod has come through: beside nodes and middles of most meshes, by this part of a step.
BESIDE = 0.3
# What a contact does.
OPEN, STICKS, SLIPS = 0, 1, 2
# A node lies on an obstacle where its gap is below this [L].
LIES_ON = 1e-9
# A start touches where its gap is below this part of the radius, as nodes do beside a middle of a coarser mesh.
TOUCHES = 1e-2


class Contacts(NamedTuple):
    """At a point: gaps at nodes, below them those within elements; their gradients with those of slips below, and the
    second derivatives of what L has of gaps by the positions of nodes; with friction the displacements of nodes since
    the last equilibrium. Of contacts within and between elements, `None` without such: the moments of their pressures,
    out of balance at the points; of the former the second derivatives by the rotation and the place of the first node
    of each element, then of the last one; of the latter those by the rotations of each node.
    """

    gaps: Float[Array, "k n+1"]
    rows: ContactRows
    stiffness: Float[Array, "n+1 3 3"]
    reference_displacements: Float[Array, "n+1 3"] | None
    gradient: Float[Array, "b m"] | None
    inner: Float[Array, "2b+6 2b+6 n"] | None
    by_rotations: Float[Array, "b b n+1"] | None

    def added_to(self, gradient: Float[Array, "b m"]) -> Float[Array, "b m"]:
        return gradient if self.gradient is None else gradient + self.gradient

    def stiffened(self, system: ChainSystem) -> ChainSystem:
        """With the second derivatives that the system of the elements leaves out."""
        if self.by_rotations is not None:
            diagonal = system.diagonal.at[..., ::2].add(self.by_rotations)
            system = dataclasses.replace(system, diagonal=diagonal)
        return system if self.inner is None else system.with_elements(self.inner)


class NodalForm(Form):
    """A nondimensional scene; the `end_force` of its points is (3, n): that through each element, and their `nodal` is
    there. `ends_move`: of a linearisation in which clamped ends have no given place (`released`).
    """

    ends_move: bool = eqx.field(kw_only=True, static=True, default=False)

    def released(self, point: Any) -> Linearization:
        """The ends that clamps hold may turn and move; `residual` without these."""
        return dataclasses.replace(self, ends_move=True).linearized(point)

    @abstractmethod
    def node_slopes(self, point: Any) -> Float[Array, "n+1 3"]:
        """The derivative of the centerline by arclength at the nodes."""

    @abstractmethod
    def node_axes(self, point: Any) -> Float[Array, "3 b n+1"]:
        """About which the tangents of the nodes turn, by rotations that are unknown."""

    @abstractmethod
    def in_elements(self, point: Any, elements: Any, change: Float[Array, "3 n"]) -> tuple[Array, Array]:
        """What stretch and forces add to L under other forces, and the segment vectors; `elements`: as of
        `turning_elements`.
        """

    @abstractmethod
    def in_cells_at(self, point: Any) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        """What the cells add to L, all of it, and their segment vectors."""

    @abstractmethod
    def turning_elements(self, point: Any, rotation: Float[Array, "b m"], bases: Float[Array, "3 b m"]) -> Any:
        """What `in_elements` needs, and its rate as the rod begins to turn."""

    # --- what is unknown ---------------------------------------------------------------------------------------------

    def multipliers_turned(
        self, point: Any, axis: Float[Array, "3"], multipliers: Float[Array, "k"]
    ) -> Float[Array, "k"]:
        positions, _ = self.held_positions
        arms = jnp.where(self.is_held[:, None], 0.0, point.nodal.positions - positions[:, 0][None])
        by_node = jnp.cross(axis[None], arms).reshape(-1)
        of_force = self.force_turned(point, axis)
        return multipliers.at[-len(by_node) - len(of_force) :].set(jnp.concatenate([by_node, of_force]))

    def axial_forces(self, point: Any) -> Float[Array, "slides"]:
        nodes = self.clip_nodes
        assert nodes is not None
        along = dot(self.applied(point)[:, nodes], self.tangents_in_clips(point))
        return along[np.array([k for k, clip in enumerate(self.scene.clips) if clip.sliding])]

    def is_closed(self, constraint_residual: Float[Array, "k"], tolerance: float) -> Bool[Array, ""]:
        return super().is_closed(self.force_components(constraint_residual), tolerance)

    def others(self, multipliers: Float[Array, "k"]) -> NodalChange:
        nodes, rows = len(self.field.s), pressure_rows(self.scene) + 3 * len(self.rough)
        pressures, displacements = jnp.split(
            multipliers[-3 * (2 * nodes - 1) - rows * nodes : -3 * (nodes - 1)], [rows * nodes]
        )
        return NodalChange(displacements.reshape(nodes, 3), pressures.reshape(rows, nodes))

    def retracted_nodal(self, point: Any, others: NodalChange | None) -> Nodal:
        nodal = point.nodal
        if others is None:
            return nodal
        retracted = nodal.with_contact_forces(
            nodal.positions + others.displacements, nodal.contact_forces + others.pressures
        )
        return retracted if nodal.friction is None else self._on_surfaces(nodal, others, retracted)

    def _on_surfaces(self, nodal: Nodal, others: NodalChange, retracted: Nodal) -> Nodal:
        """With nodes that press on obstacles as far from them as their tangent planes have it: these go along them.

        A taut cable slides over a cylinder in whole steps so; along straight lines it would gain length.
        """
        gaps, normals = self.gaps_and_normals(nodal.positions)
        beyond, there = self.gaps_and_normals(retracted.positions)
        beyond -= gaps + jnp.einsum("knc,nc->kn", normals, others.displacements)
        pushes = (retracted.pressures[: len(gaps)] > 0) & ~self.is_held[None]
        positions = retracted.positions - jnp.einsum("kn,knc->nc", jnp.where(pushes, beyond, 0.0), there)
        return dataclasses.replace(retracted, positions=positions)

    def led_out(self, gaps: Float[Array, "k n+1"]) -> Float[Array, "k"]:
        """How much larger the gaps of each obstacle are seen in the next step, where the rod lies within it."""
        depths = -jnp.min(gaps, axis=1, initial=jnp.inf)
        if self.smooth:
            smooth, inner = np.array(self.smooth), self.inner_rows
            deepest = jnp.maximum(depths[smooth], depths[inner])
            depths = depths.at[smooth].set(deepest).at[inner].set(deepest)
        least = jnp.full(len(depths), LEAST_RELAXED, depths.dtype)
        if self.scene.self_contact:
            least = least.at[-1].multiply(self.far_unit)
        return jnp.where(depths > least, depths / 2, 0.0)

    def accepted(self, point: Any, here: Linearization) -> Any:
        assert here.gaps is not None
        nodal = dataclasses.replace(point.nodal, relaxed=self.led_out(here.gaps))
        if nodal.friction is not None:
            assert isinstance(here.system, ChainSystem)
            forces = tangential(nodal.friction.forces, here.system.contacts.normals[np.array(self.rough)])
            nodal = dataclasses.replace(nodal, friction=dataclasses.replace(nodal.friction, forces=forces))
        return dataclasses.replace(point, nodal=nodal)

    def nodal_held(self, nodal: Nodal | None) -> Nodal | None:
        if nodal is None:
            return None
        positions, held = self.held_positions
        return dataclasses.replace(nodal, positions=nodal.positions.at[held].set(positions.T))

    def begun(
        self,
        point: Any,
        nodes: Float[Array, "n+1 3"],
        pressures: Float[Array, "k n+1"] | None,
        friction: Friction | None,
    ) -> Any:
        """Pressures that are not known, not numbers, are those of the forces through the elements."""
        nothing = jnp.zeros((pressure_rows(self.scene), len(nodes)), nodes.dtype)
        if self.rough and friction is None:
            friction = Friction.from_rest(len(self.rough), nodes)
        nodal = self.nodal_held(Nodal(nodes, nothing, nothing[:, 0], friction if self.rough else None))
        assert nodal is not None
        point = dataclasses.replace(point, nodal=nodal)
        if point.end_force.shape[1] != len(nodes) - 1:
            point = dataclasses.replace(point, end_force=self._in_elements(point))
        if not has_contacts(self.scene):
            return point
        gaps, normals = self.gaps_and_normals(nodal.positions)
        pushing = jnp.einsum("cn,knc->kn", self.applied(point), normals)
        pushing = jnp.where((pushing > 0) & (gaps < TOUCHES * self.radius[None]), pushing, 0.0)
        pushing = jnp.concatenate([pushing, nothing[len(pushing) :]])
        known = nothing + jnp.nan if pressures is None else pressures
        # Files until format 12 have those at nodes only.
        known = jnp.concatenate([known, nothing[len(known) :] + jnp.nan])
        pressures = jnp.where(jnp.isnan(known), pushing, known)
        _, inner_gaps, _ = self.within_elements(point)
        gaps = jnp.concatenate([gaps, inner_gaps])
        if self.scene.self_contact:
            far = self.self_contacts(point, pressures[-1])
            gaps = jnp.concatenate([gaps, far.gaps[None]])
        nodal = dataclasses.replace(nodal, pressures=pressures, relaxed=self.led_out(gaps))
        return dataclasses.replace(point, nodal=nodal)

    def _in_elements(self, point: Any) -> Float[Array, "3 n"]:
        """The forces through the elements, of those in the spans, as files until format 10 have them."""
        members = SpanForces.of(self.scene, self.clip_nodes, len(self.field.s) - 1)
        forces = jnp.broadcast_to(members.gather(point.end_force), (3, len(self.field.s) - 1))
        loads = self.loads_on_nodes(point)
        if loads is None:
            return forces
        if isinstance(self.scene.start, Held):
            return forces + jnp.cumsum(loads[:, :0:-1], axis=1)[:, ::-1]
        return forces - jnp.cumsum(loads[:, :-1], axis=1)

    # --- contacts ----------------------------------------------------------------------------------------------------

    def loads_on_nodes(self, point: Any) -> Float[Array, "3 n+1"] | None:
        """By which the forces of two elements differ, beside what is applied to the node between; `None` for none."""
        if not self.scene.potentials:
            return None
        return -potentials.by_position(self.scene, self.field.s, *self._node_lines(point)).T

    def _node_lines(self, point: Any) -> tuple[Float[Array, "n+1 3"], Float[Array, "3 n+1"]]:
        return point.nodal.positions, point.tangents[:, ::2]

    def at_nodes(self, point: Any) -> NodeEnergy | None:
        """What fields are at the nodes, by the rotations that are unknown; `None` without fields."""
        if not self.scene.potentials:
            return None
        return potentials.at_nodes(self.scene, self.field.s, *self._node_lines(point), self.node_axes(point))

    def fields_on_elements(self, point: Any) -> OnElements | None:
        """With the contacts within them, whose forces count as if spread along them."""
        fields = None
        if self.scene.potentials:
            fields = potentials.on_elements(self.scene, self.field.s, *self._node_lines(point))
        if not self.has_inner_contacts:
            return fields
        contacts = self.contacts_on_elements(point)
        return contacts if fields is None else OnElements(*map(jnp.add, fields, contacts))

    def shares(self, point: Any) -> Float[Array, "n+1 3"]:
        """What contacts within elements apply to the rod, by parts at both nodes."""
        if not self.has_inner_contacts:
            return jnp.zeros_like(point.nodal.positions)
        halves = -self.contacts_on_elements(point).by_position
        return (jnp.pad(halves[:, 0], ((0, 0), (0, 1))) + jnp.pad(halves[:, 1], ((0, 0), (1, 0)))).T

    @property
    def has_inner_contacts(self) -> bool:
        """Whether the rod may touch something between its nodes."""
        return bool(self.smooth) or self.scene.self_contact

    def contacts_on_elements(self, point: Any) -> OnElements:
        if not self.scene.self_contact:
            return self._middles_on_elements(point)
        on_positions, on_tangents = on_elements(self.curve(point), self.far_unit * point.nodal.pressures[-1])
        contacts = OnElements(-on_positions, -on_tangents, jnp.zeros_like(on_positions))
        return OnElements(*map(jnp.add, contacts, self._middles_on_elements(point))) if self.smooth else contacts

    def _middles_on_elements(self, point: Any) -> OnElements:
        middles, _, normals = self.within_elements(point)
        forces = jnp.einsum("qn,qnc->cn", point.nodal.pressures[self.inner_rows, :-1], normals)
        halves = -jnp.stack([forces, forces], axis=1) / 2
        by_tangent = jnp.einsum("cn,cdn->dn", forces, middles.by_difference)
        by_tangent = jnp.stack([-by_tangent, by_tangent], axis=1)
        return OnElements(halves, by_tangent, jnp.zeros_like(halves))

    def with_fields(self, point: Any, forces: Float[Array, "3 3 n"]) -> Float[Array, "3 3 n"]:
        fields = self.fields_on_elements(point)
        return forces if fields is None else potentials.section_forces(forces, fields, jnp.diff(self.field.s))

    def load_energy(self, point: Any) -> Float[Array, ""]:
        energy = super().load_energy(point)  # pyright: ignore
        if not self.scene.potentials:
            return energy
        return energy + jnp.sum(potentials.node_energies(self.scene, self.field.s, *self._node_lines(point)))

    def end_forces(self, point: Any) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        start, end = super().end_forces(point)
        if not self.scene.potentials and not self.has_inner_contacts:
            return start, end
        loads = self.shares(point)
        if self.scene.potentials:
            loads = loads - potentials.by_position(self.scene, self.field.s, *self._node_lines(point))
        # Of those that are held; a given force is one.
        start = start + loads[0] if isinstance(self.scene.start, Held) else start
        return start, end - loads[-1] if isinstance(self.scene.end, Held) else end

    def applied(self, point: Any) -> Float[Array, "3 n+1"]:
        """What clips, contacts and supports apply at the nodes."""
        around = jnp.pad(point.end_force, ((0, 0), (1, 1)))
        applied, loads = around[:, :-1] - around[:, 1:], self.loads_on_nodes(point)
        return applied if loads is None else applied - loads

    @property
    def is_held(self) -> Bool[Array, "n+1"]:
        """Whether the place of a node is given."""
        return self.is_at_support & ~self._is_at_joint if self.ends_move else self.is_at_support

    @property
    def is_at_support(self) -> Bool[Array, "n+1"]:
        _, nodes = self.held_positions
        return jnp.zeros(len(self.field.s), bool).at[nodes].set(True)

    @property
    def _is_at_joint(self) -> Bool[np.ndarray, "n+1"]:
        """At ends that clamps hold, whose poses bodies of a harness may have."""
        is_at_joint = np.zeros(len(self.field.s), bool)
        is_at_joint[[0, -1]] = [isinstance(end, Clamp) for end in (self.scene.start, self.scene.end)]
        return is_at_joint

    @property
    def radius(self) -> Float[Array, "n+1"]:
        """At the nodes; of a radius that jumps, the larger one beside the node."""
        return largest_beside(self._radius, self.field.s)

    def radius_in_elements(self, parts: Float[Array, "k"]) -> Float[Array, "n k"]:
        """At places in each element, as parts of it."""
        s = self.field.s
        begin, end = (jnp.broadcast_to(side[:, None], (len(s) - 1, len(parts))) for side in (s[:-1], s[1:]))
        return value_at(self._radius, begin + parts[None] * (end - begin), begin, end)

    @property
    def _radius(self) -> Value:
        radius = self.scene.rod.radius
        assert radius is not None, "a scene with obstacles has a radius"
        return radius

    @property
    def contact_compliance(self) -> Float[Array, ""]:
        """Of the contacts in the model of a step [L^3/EI]."""
        h = jnp.diff(self.field.s)
        contact_compliance = CONTACT_COMPLIANCE * h[jnp.argmin(h)] ** 3
        return (
            jnp.maximum(contact_compliance, LEAST_COMPLIANCE * jnp.finfo(h.dtype).eps)
            if self.smooth
            else contact_compliance
        )

    def distances_and_normals(
        self, positions: Float[Array, "n+1 3"]
    ) -> tuple[Float[Array, "k n+1"], Float[Array, "k n+1 3"]]:
        """From the obstacles to the nodes."""
        found = [jax.vmap(jax.value_and_grad(obstacle.at))(positions) for obstacle in self.scene.obstacles]
        return jnp.stack([distance for distance, _ in found]), jnp.stack([normals for _, normals in found])

    def curvatures(self, positions: Float[Array, "p 3"]) -> Float[Array, "k p 3 3"]:
        """The second derivatives of the distances from the obstacles."""
        return jnp.stack([jax.vmap(jax.hessian(obstacle.at))(positions) for obstacle in self.scene.obstacles])

    def gaps_and_normals(
        self, positions: Float[Array, "n+1 3"]
    ) -> tuple[Float[Array, "k n+1"], Float[Array, "k n+1 3"]]:
        """Gaps of L at nodes that are held, whose place is given."""
        if not self.scene.obstacles:
            return jnp.zeros((0, len(positions)), positions.dtype), jnp.zeros((0, *positions.shape), positions.dtype)
        distances, normals = self.distances_and_normals(positions)
        return jnp.where(self.is_at_support[None], 1.0, distances - self.radius[None]), normals

    @property
    def smooth(self) -> tuple[int, ...]:
        """The numbers of the obstacles without friction: those that elements touch in their middles too."""
        return tuple(k for k, obstacle in enumerate(self.scene.obstacles) if _friction(obstacle) is None)

    def within_elements(self, point: Any) -> tuple[Middles, Float[Array, "q n+1"], Float[Array, "q n 3"]]:
        """The middles of the elements, their gaps, and the directions in which these grow."""
        s = self.field.s
        free = jnp.where(self.is_held, 0.0, 1.0).astype(s.dtype)
        middles = Middles.of(point.nodal.positions, point.tangents[:, ::2], self.node_axes(point), free, jnp.diff(s))
        if not self.smooth:
            return middles, jnp.zeros((0, len(s)), s.dtype), jnp.zeros((0, len(s) - 1, 3), s.dtype)
        distances, normals = self.distances_and_normals(middles.points)
        smooth = np.array(self.smooth)
        radius = (1 - THINNER) * self.radius_in_elements(jnp.full(1, 0.5, s.dtype))[:, 0]
        gaps = distances[smooth] - radius[None]
        return middles, jnp.pad(gaps, ((0, 0), (0, 1)), constant_values=1.0), normals[smooth]

    @property
    def inner_rows(self) -> slice:
        """Of all rows of pressures, those within elements."""
        return slice(len(self.scene.obstacles), len(self.scene.obstacles) + len(self.smooth))

    @property
    def rough(self) -> tuple[int, ...]:
        """The numbers of the obstacles with friction."""
        return tuple(k for k, obstacle in enumerate(self.scene.obstacles) if _friction(obstacle) is not None)

    def travelled(self, positions: Float[Array, "n+1 3"], friction: Friction) -> Float[Array, "n+1 3"]:
        """Of the nodes since the last equilibrium; none from rest, and of nodes that are held."""
        (obstacle, *_) = self.scene.obstacles
        assert isinstance(obstacle, InUnits)
        is_still = jnp.isnan(friction.reference) | self.is_held[:, None]
        before = (jnp.where(is_still, 0.0, friction.reference) - obstacle.origin[None]) / obstacle.length
        return jnp.where(is_still, 0.0, positions - before)

    def bounds(self, pressures: Float[Array, "k n+1"], friction: Friction) -> Float[Array, "f n+1"]:
        """Of the tangential forces; 0 from rest."""
        coefficients = jnp.stack([_friction(self.scene.obstacles[k]) for k in self.rough])
        is_still = jnp.isnan(friction.reference[:, 0]) | self.is_held
        pressures = pressures[np.array(self.rough)]
        return jnp.where(is_still[None] | (pressures < 0), 0.0, coefficients[:, None] * pressures)

    def contacts(self, point: Any) -> Contacts:
        nodal = point.nodal
        gaps, normals = self.gaps_and_normals(nodal.positions)
        is_free = jnp.where(self.is_at_support, 0.0, 1.0).astype(normals.dtype)[:, None]
        normals *= is_free[None]
        curving = is_free[..., None] * self._curving(nodal.positions, nodal.pressures[: len(gaps)])
        inner, inner_rows, across = None, None, self._across(normals) if nodal.friction is not None else None
        by_rotations, far_rows = None, None
        if self.smooth:
            inner_gaps, inner_rows, inner = self._inner(point, nodal.pressures[self.inner_rows, :-1])
            gaps = jnp.concatenate([gaps, inner_gaps])
        if self.scene.self_contact:
            found = self.self_contacts(point, nodal.pressures[-1])
            far_rows, by_rotations = found.rows, found.by_rotations
            gaps = jnp.concatenate([gaps, found.gaps[None]])
        normals = jnp.pad(normals, ((0, len(gaps) - len(normals)), (0, 0), (0, 0)))
        is_closed, displacements = nodal.pressures > GAP_WEIGHT * (gaps + self.led_out(gaps)[:, None]), None
        if nodal.friction is not None and across is not None:
            displacements = self.travelled(nodal.positions, nodal.friction)
            sticks = self.sticks(nodal, normals, displacements)
            is_closed = jnp.concatenate([is_closed, jnp.repeat(sticks, 3, axis=0)])
            normals = jnp.concatenate([normals, across])
        rows = ContactRows(normals, self.contact_compliance, is_closed, inner=inner_rows, far=far_rows)
        gradient = None
        if inner is not None or far_rows is not None:
            # What pressures do to the rotations.
            nothing = jnp.zeros((self.node_axes(point).shape[1], 2 * len(self.field.s) - 1), gaps.dtype)
            gradient = -rows.turned(nodal.contact_forces, nothing)
        return Contacts(gaps, rows, curving, displacements, gradient, inner, by_rotations)

    def self_contacts(self, point: Any, pressures: Float[Array, "n+1"]) -> SelfContacts:
        """Of a rod with these forces between its elements."""
        return self_contacts(self.curve(point), pressures, self.far_unit, pressure_rows(self.scene) - 1)

    def self_exerted(self, point: Any) -> Exerted:
        """Where elements are nearest to the rod beyond them, and the forces there."""
        return exerted(self.curve(point), self.far_unit * point.nodal.pressures[-1])

    @property
    def far_unit(self) -> Float[Array, ""]:
        """In which pressures between elements count, so that all contacts have the same compliance in numbers."""
        return jnp.sqrt(self.contact_compliance / FAR_COMPLIANCE)

    def curve(self, point: Any) -> Curve:
        s = self.field.s
        free = jnp.where(self.is_at_support, 0.0, 1.0).astype(s.dtype)
        radius = self.radius_in_elements(jnp.full(1, 0.5, s.dtype))[:, 0]
        assert isinstance(self.layout, CellForces)
        normal = self.layout.normal  # of the plane of the rod
        return Curve(s, point.nodal.positions, point.tangents[:, ::2], self.node_axes(point), free, radius, normal)

    def _inner(
        self, point: Any, pressures: Float[Array, "q n"]
    ) -> tuple[Float[Array, "q n+1"], InnerRows, Float[Array, "2b+6 2b+6 n"]]:
        """Gaps in the middles of the elements, their gradients, and what pressures there add to L."""
        middles, gaps, normals = self.within_elements(point)
        rates = jnp.einsum("qnc,cekn->qken", normals, middles.rates)
        b = rates.shape[1] - 3
        rows = InnerRows(rates[:, :b], rates[:, b:], first=len(self.scene.obstacles))
        curved = self._curving(middles.points, pressures, self.smooth)
        by_moves = middles.rates.reshape(3, 2 * (b + 3), -1)
        blocks = jnp.einsum("cin,ncd,djn->ijn", by_moves, curved, by_moves)
        blocks -= middles.second(jnp.einsum("qn,qnc->cn", pressures, normals))
        return gaps, rows, blocks

    def _across(self, normals: Float[Array, "k n+1 3"]) -> Float[Array, "3f n+1 3"]:
        """The gradients of slips, the rows of projections on tangent planes."""
        normals = normals[np.array(self.rough)]
        identity = jnp.eye(3, dtype=normals.dtype)[None, None]
        projections = identity - normals[..., :, None] * normals[..., None, :]
        projections = jnp.where(self.is_held[None, :, None, None], 0.0, projections)
        return jnp.swapaxes(projections, 1, 2).reshape(-1, *normals.shape[1:])

    def sticks(
        self, nodal: Nodal, normals: Float[Array, "k n+1 3"], displacements: Float[Array, "n+1 3"]
    ) -> Bool[Array, "f n+1"]:
        """Whether contacts with friction stick: nodes that have not slipped, and where less than the bound holds."""
        assert nodal.friction is not None
        exerted, slips = pulled(nodal.friction.forces, displacements, normals[np.array(self.rough)])
        bounds = self.bounds(nodal.pressures, nodal.friction)
        has_slipped = lengths(slips)[..., 0] > LEAST_SLIP
        return (bounds > 0) & ((lengths(exerted)[..., 0] < bounds) | ~has_slipped)

    def model(self, point: Any, gaps: Float[Array, "k n+1"], displacements: Float[Array, "n+1 3"] | None) -> Unilateral:
        """The contacts of the model of a step from a point, with these gaps and displacements."""
        nodal = point.nodal
        gaps = gaps + nodal.relaxed[:, None]
        if nodal.friction is None or displacements is None:
            return Unilateral(gaps, nodal.pressures)
        _, normals = self.gaps_and_normals(nodal.positions)
        slips = jnp.einsum("knc,nc->kn", self._across(normals), displacements)
        bounds = self.bounds(nodal.pressures, nodal.friction)
        return Unilateral(jnp.concatenate([gaps, slips]), nodal.contact_forces, bounds)

    def _curving(
        self, positions: Float[Array, "p 3"], pressures: Float[Array, "k p"], which: tuple[int, ...] | None = None
    ) -> Float[Array, "p 3 3"]:
        """Second derivatives of what L has of the contacts, by the positions of nodes or middles; `which`: obstacles,
        if not all.
        """
        total = jnp.zeros((len(positions), 3, 3), positions.dtype)
        obstacles = self.scene.obstacles if which is None else [self.scene.obstacles[k] for k in which]
        for obstacle, pressure in zip(obstacles, pressures, strict=True):
            # Where the rod touches nothing of an obstacle, its curvature is not computed.
            total = jax.lax.cond(
                jnp.any(pressure != 0),
                lambda total, obstacle=obstacle, pressure=pressure: (
                    total - pressure[:, None, None] * jax.vmap(jax.hessian(obstacle.at))(positions)
                ),
                lambda total: total,
                total,
            )
        return total

    def contact_residuals(self, point: Any, contacts: Contacts) -> tuple[Array, Array, Array]:
        """The residuals of contacts and of the balance of nodes, and the largest component of both."""
        nodal, gaps = point.nodal, contacts.gaps
        pressures, forces = nodal.pressures, nodal.contact_forces
        balance = self.applied(point).T - contacts.rows.pushed(forces)
        balance = jnp.where(self.is_held[:, None], 0.0, balance)
        off_balance = jnp.where(self.is_at_support[:, None], 0.0, balance) if self.ends_move else balance
        # Of a gap and a pressure one is zero, none is negative.
        weighted = GAP_WEIGHT * gaps
        amiss = jnp.max(jnp.abs(jnp.where(pressures < weighted, pressures, weighted)), initial=0.0)
        if nodal.friction is not None and contacts.reference_displacements is not None:
            normals = contacts.rows.normals[np.array(self.rough)]
            exerted, slips = pulled(nodal.friction.forces, contacts.reference_displacements, normals)
            off = tangential(nodal.friction.forces, normals)
            off -= within(exerted, self.bounds(pressures, nodal.friction))
            off = jnp.max(jnp.abs(off))
            amiss = jnp.where(off > amiss, off, amiss)
            gaps = jnp.concatenate([gaps, jnp.swapaxes(slips, 1, 2).reshape(-1, gaps.shape[1])])
        rows = -jnp.where(contacts.rows.is_closed, gaps, forces)
        return rows.reshape(-1), balance, larger(jnp.max(jnp.abs(off_balance)), amiss)

    def lagrangian(self, point: Any) -> tuple[Float[Array, ""], Float[Array, "c"]]:
        """Without contacts."""
        energy, segment_vectors = self.in_cells_at(point)
        energy += jnp.sum(point.end_force.T * jnp.diff(point.nodal.positions, axis=0))
        if self.scene.potentials:
            energy += jnp.sum(potentials.node_energies(self.scene, self.field.s, *self._node_lines(point)))
        return energy, self.gap_of_elements(point, segment_vectors).reshape(-1)

    def gap_of_elements(self, point: Any, segment_vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """The vectors between nodes minus the segment vectors of the elements."""
        return jnp.diff(point.nodal.positions, axis=0) - segment_vectors

    # --- friction ----------------------------------------------------------------------------------------------------

    def exerted(self, point: Any) -> tuple[Float[Array, "k n+1 3"], Float[Array, "k n+1 3"], Int[Array, "k n+1"]]:
        """What each obstacle does at each node: push, drag, and whether it is not touched, sticks or slips. Of a push
        within an element each of its nodes has half.
        """
        nodal = point.nodal
        _, normals = self.distances_and_normals(nodal.positions)
        k = len(normals)
        pushes = nodal.pressures[:k, :, None] * normals
        pressures = nodal.pressures[:k]
        if self.smooth:
            _, _, normals_within = self.within_elements(point)
            in_middles = nodal.pressures[k:, :-1, None]
            smooth = np.array(self.smooth)
            pushes = pushes.at[smooth].add(_shared(in_middles * normals_within))
            pressures = pressures.at[smooth].add(_shared(in_middles)[..., 0])
        states = jnp.where(pressures > 0, SLIPS, OPEN)
        if nodal.friction is None:
            return pushes, jnp.zeros_like(pushes), states
        rough = np.array(self.rough)
        drags, _ = self._friction_at(nodal)
        # What sticks may be beyond its bound by what the search has left.
        drags = within(drags, self.bounds(nodal.pressures, nodal.friction))
        sticks = self.sticks(nodal, normals, self.travelled(nodal.positions, nodal.friction))
        states = states.at[rough].set(jnp.where(sticks, STICKS, states[rough]))
        return pushes, jnp.zeros_like(pushes).at[rough].set(drags), states

    def by_law(self, point: Any) -> Any:
        """The point with the tangential forces of what slips as pressures, positions and scene make them."""
        if point.nodal is None or point.nodal.friction is None:
            return point
        forces, _ = self._friction_at(point.nodal)
        friction = dataclasses.replace(point.nodal.friction, forces=forces)
        return dataclasses.replace(point, nodal=dataclasses.replace(point.nodal, friction=friction))

    def _friction_at(self, nodal: Nodal) -> tuple[Float[Array, "f n+1 3"], Float[Array, "f n+1 3"]]:
        """Tangential forces, and slips. What slips and what sticks, and the forces of the latter, are those given."""
        friction = nodal.friction
        assert friction is not None
        _, normals = self.gaps_and_normals(nodal.positions)
        normals, bounds = normals[np.array(self.rough)], self.bounds(nodal.pressures, friction)
        displacements = self.travelled(nodal.positions, friction)
        held, slips = tangential(friction.forces, normals), tangential(displacements[None], normals)
        exerted, _ = jax.lax.stop_gradient(pulled(friction.forces, displacements, normals))
        sticks = jax.lax.stop_gradient(self.sticks(nodal, self.gaps_and_normals(nodal.positions)[1], displacements))
        return jnp.where(sticks[..., None], held, bounds[..., None] * directions(exerted, slips)), slips

    def coupled(self, point: Any, system: AnySystem) -> AnySystem:
        """With friction as it depends on pressures and positions, without symmetry."""
        nodal = point.nodal
        if nodal is None or nodal.friction is None:
            return system
        assert isinstance(system, ChainSystem)
        rough, contacts = np.array(self.rough), system.contacts
        k = len(nodal.pressures)

        def friction_at(positions: Array, pressures: Array) -> tuple[Array, Array]:
            return self._friction_at(dataclasses.replace(nodal, positions=positions, pressures=pressures))

        def by_positions(axis: Float[Array, "3"]) -> tuple[Array, Array]:
            turned = jnp.broadcast_to(axis[None], nodal.positions.shape)
            return jax.jvp(lambda positions: friction_at(positions, nodal.pressures), (nodal.positions,), (turned,))[1]

        def by_pressures(pressures: Array) -> Array:
            return friction_at(nodal.positions, pressures)[0]

        forces, slips = jax.vmap(by_positions)(
            jnp.eye(3, dtype=nodal.positions.dtype)
        )  # [direction, f, node, component]
        _, dragging = jax.jvp(by_pressures, (nodal.pressures,), (jnp.ones_like(nodal.pressures),))
        free = jnp.where(self.is_held, 0.0, 1.0).astype(forces.dtype)[:, None]
        pushes = contacts.normals.at[rough].add(dragging * free[None])
        rows = slips.transpose(1, 3, 2, 0).reshape(-1, *nodal.positions.shape) * free[None]
        normals = jnp.concatenate([contacts.normals[:k], rows])
        rows = dataclasses.replace(contacts, normals=normals, pushes=pushes)
        stiffness = system.stiffness - free[..., None] * jnp.einsum("dfnc->ncd", forces)
        return dataclasses.replace(system, contacts=rows, stiffness=stiffness)

    # --- the search --------------------------------------------------------------------------------------------------

    def objective(self, here: Linearization, point: Any) -> Float[Array, ""]:
        """L with the contacts as of the model, with the pressures of a point."""
        assert here.gaps is not None
        assert isinstance(here.system, ChainSystem)
        contact_compliance, model = (
            here.system.contacts.contact_compliance,
            self.model(point, here.gaps, here.reference_displacements),
        )
        return here.energy + model.energy(model.pressures - model.gaps / contact_compliance, contact_compliance)

    def contact_energy(self, there: Any, point: Any) -> Float[Array, ""]:
        """That of `objective`, on the way of a step from a point."""
        gaps, _ = self.gaps_and_normals(there.nodal.positions)
        if self.smooth:
            gaps = jnp.concatenate([gaps, self.within_elements(there)[1]])
        contact_compliance, model = self.contact_compliance, self.model(point, gaps, None)
        return model.energy(model.pressures - model.gaps / contact_compliance, contact_compliance)

    def half_square(self, here: Linearization) -> Float[Array, ""]:
        assert isinstance(here.system, ChainSystem)
        _, _, balance, _ = here.system.split(here.constraint_residual)
        return super().half_square(here) + jnp.sum(balance**2 / self.field.weights[::2, None]) / 2

    def sought(
        self, here: Linearization, point: Any, system: AnySystem, push: Float[Array, "b m"]
    ) -> tuple[Bool[Array, ""], Float[Array, "b m"], Float[Array, "k"]]:
        assert isinstance(system, ChainSystem)
        assert here.gaps is not None
        nodal = point.nodal
        if not has_contacts(self.scene):
            return super().sought(here, point, system, push)
        moments, c = self.without_contacts(here, nodal.contact_forces)
        contacts = self.model(point, here.gaps, here.reference_displacements)
        is_closed = system.contacts.is_closed
        if nodal.friction is None:
            is_closed = self.first_closed(is_closed, contacts)
        else:
            k = len(here.gaps)
            # What slips, and by how much, is a matter of the model.
            trial = contacts.pressures - contacts.gaps / system.contacts.contact_compliance
            sticks = contacts.is_closed(trial)[k:]
            is_closed = jnp.concatenate([is_closed[:k] | (contacts.gaps[:k] < LIES_ON), sticks])
        system = system.closed_where(is_closed)
        found = minimized(system, push + moments, c, contacts)
        return found.is_minimum, found.x, found.y

    def first_closed(self, is_closed: Bool[Array, "k n+1"], contacts: Unilateral) -> Bool[Array, "k n+1"]:
        """What lies on an obstacle without pressure is more likely to press on it than to leave it."""
        return is_closed | (contacts.gaps < LIES_ON)

    def without_contacts(
        self, here: Linearization, forces: Float[Array, "r n+1"]
    ) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        """What is out of balance without the forces of contacts, as right sides."""
        system = here.system
        assert isinstance(system, ChainSystem)
        first, _, balance, gaps = system.split(-here.constraint_residual)
        balance -= system.contacts.pushed(forces)
        moments = -system.contacts.turned(forces, here.gradient)
        parts = (first, jnp.zeros_like(forces), balance, gaps)
        return moments, jnp.concatenate([part.reshape(-1) for part in parts])

    def under_force(
        self,
        point: Any,
        here: Linearization,
        rotation: Float[Array, "b m"],
        change: Float[Array, "3 n"],
        others: NodalChange,
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        elements, rates = self.turning_elements(point, rotation, here.bases)

        def parts(elements: Any, positions: Float[Array, "n+1 3"], change: Float[Array, "3 n"]) -> tuple[Array, Array]:
            value, segment_vectors = self.in_elements(point, elements, change)
            gap = jnp.diff(positions, axis=0) - segment_vectors
            # Of L the elements have the sum of -F . segment vector.
            force = point.end_force + change
            return value + jnp.sum(force.T * jnp.diff(positions, axis=0)), gap

        positions = point.nodal.positions
        (energy, gaps), (rate, gap_rates) = jax.jvp(
            lambda elements, positions: parts(elements, positions, change),
            (elements, positions),
            (rates, others.displacements),
        )
        # The gradient by rotations has the forces as they are.
        (before, _), (counted, _) = jax.jvp(
            lambda elements: parts(elements, positions, jnp.zeros_like(change)), (elements,), (rates,)
        )
        assert here.gaps is not None
        assert isinstance(here.system, ChainSystem)
        model = self.model(point, here.gaps, here.reference_displacements)
        pushing = model.allowed(model.pressures - model.gaps / here.system.contacts.contact_compliance)
        rows = here.system.contacts
        rate -= jnp.sum(pushing * rows.rates(rotation, others.displacements))
        if rows.inner is not None or rows.far is not None:
            # The gradient by rotations has the pressures as they are.
            at_rest = rows.rates(rotation, jnp.zeros_like(others.displacements))
            rate += jnp.sum(point.nodal.contact_forces * at_rest)
        if self.scene.potentials:
            by_position = potentials.by_position(self.scene, self.field.s, *self._node_lines(point))
            rate += jnp.sum(by_position * others.displacements)
        return gaps.reshape(-1), gap_rates.reshape(-1), energy - before, rate - counted

    def accepts(self, point: Any, trial: Any, is_better: Bool[Array, ""]) -> Bool[Array, ""]:
        """Only where nodes, and places between them, go straight from one to the other without getting too deep into an
        obstacle: one that is not convex, or thinner than nodes are apart, no tangent plane keeps out.
        """
        if self.scene.self_contact:
            is_better &= ~comes_through(self.curve(point), self.curve(trial))
        if not self.scene.obstacles:
            return is_better
        before, after = self._looked_at(point), self._looked_at(trial)
        displacements = after - before
        distance = jnp.sqrt(jnp.sum(displacements**2, axis=1))
        radius = self.radius
        rim = jnp.concatenate([radius, *[least(radius[:-1], radius[1:])] * len(LOOKED_AT)])

        def distances(positions: Float[Array, "k 3"]) -> Float[Array, "k"]:
            return least(*(jax.vmap(obstacle.at)(positions) for obstacle in self.scene.obstacles))

        first = distances(before)
        bound = least(DEEPEST * rim, first - DEEPER * rim)

        def pierces() -> Bool[Array, ""]:
            """Whether a place ends too near to something thin."""
            is_near = (distances(after) < NEAREST * rim) & (first >= NEAREST * rim)

            def is_thin(place: Float[Array, "3"], rim: Float[Array, ""]) -> Bool[Array, ""]:
                def nearest(place: Float[Array, "3"]) -> Float[Array, ""]:
                    return least(*(obstacle.at(place) for obstacle in self.scene.obstacles))

                depth, normal = jax.value_and_grad(nearest)(place)
                return nearest(place - (depth + rim) * normal) > -THIN * rim

            return jax.lax.cond(
                jnp.any(is_near), lambda: jnp.any(is_near & jax.vmap(is_thin)(after, rim)), lambda: jnp.array(False)
            )

        # No place is nearer than its distance: so far each may go, and is looked at again.
        def ahead(gone: Float[Array, "k"], gaps: Float[Array, "k"]) -> Float[Array, "k"]:
            return gone + jnp.maximum(gaps, LEAST_WAY * rim)

        def looked(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            gone, _, count = state
            parts = jnp.minimum(gone / jnp.where(distance > 0, distance, 1.0), 1.0)
            gaps = distances(before + parts[:, None] * displacements) - bound
            return ahead(gone, gaps), jnp.any(gaps < 0), count + 1

        def goes_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
            gone, is_blocked, count = state
            return is_better & jnp.any(gone < distance) & ~is_blocked & (count < MOST_LOOKS)

        begin = ahead(jnp.zeros_like(distance), first - bound), pierces(), jnp.zeros((), int)
        gone, is_blocked, _ = jax.lax.while_loop(goes_on, looked, begin)
        return is_better & ~is_blocked & jnp.all(gone >= distance)

    def _looked_at(self, point: Any) -> Float[Array, "k 3"]:
        nodes, slopes = point.nodal.positions, point.tangents[:, ::2].T
        s = self.field.s
        between = s[None, :-1] + jnp.asarray(LOOKED_AT, s.dtype)[:, None] * jnp.diff(s)[None]
        return jnp.concatenate([nodes, cubic(s, nodes, slopes, between.reshape(-1))])

    def depths_at(self, positions: Float[Array, "k 3"], radius: Float[Array, "k"]) -> Float[Array, "k"]:
        """How far the rod is within the nearest obstacle at places, by its radius there; 0 outside."""
        distances = jnp.stack([jax.vmap(obstacle.at)(positions) for obstacle in self.scene.obstacles])
        return jnp.maximum(1 - jnp.min(distances, axis=0) / radius, 0.0)

    def samples(self, nodes: Float[Array, "n+1 3"], point: Any) -> tuple[Array, Array, Array]:
        """At steps of arclength, as many as `passage` looks at: the centerline, the radius, and in an element
        beside a held node this, elsewhere not a number.
        """
        s = self.field.s
        x = jnp.linspace(0.0, 1.0, SAMPLES, dtype=s.dtype)
        x = x.at[1:-1].add(BESIDE * x[1])
        points = cubic(s, nodes, self.node_slopes(point), x)
        cell = jnp.clip(jnp.searchsorted(s, x, side="right") - 1, 0, len(s) - 2)
        radius = value_at(self._radius, x, s[cell], s[cell + 1])
        beside = jnp.where(self.is_held[cell + 1][:, None], nodes[cell + 1], jnp.nan)
        return points, radius, jnp.where(self.is_held[cell][:, None], nodes[cell], beside)

    def rounding_floor(self, point: Any) -> Float[Array, ""]:
        floor = super().rounding_floor(point)  # pyright: ignore
        if not has_contacts(self.scene):
            return floor
        return floor + FLOOR_SAFETY * jnp.finfo(floor.dtype).eps * GAP_WEIGHT


def larger(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    """With the derivative of one of them."""
    return jnp.where(a > b, a, b)


def pressure_rows(scene: Scene) -> int:
    """Of all obstacles at nodes, of those without friction within elements, and one between elements."""
    smooth = sum(_friction(obstacle) is None for obstacle in scene.obstacles)
    return len(scene.obstacles) + smooth + scene.self_contact


def _friction(obstacle: Obstacle) -> Any:
    """The coefficient of friction of an obstacle of a nondimensional scene."""
    return obstacle.obstacle.friction if isinstance(obstacle, InUnits) else obstacle.friction


def _shared(of_elements: Float[Array, "q n c"]) -> Float[Array, "q n+1 c"]:
    """What belongs to elements at their nodes, half at each."""
    halves = of_elements / 2
    return jnp.pad(halves, ((0, 0), (0, 1), (0, 0))) + jnp.pad(halves, ((0, 0), (1, 0), (0, 0)))
