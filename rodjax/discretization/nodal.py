"""Rods whose nodes have positions of their own beside obstacles, and beside themselves.

No node is nearer to an obstacle than the rod is thick: gap g >= 0, and no place of an element (`inner_contacts`) to
an obstacle without friction. The pressure p >= 0 is the multiplier of the gap, -sum p g in L (`contact_gaps`,
`node_contacts`); with friction the tangential force q, |q| <= mu p, that of the slip (`node_friction`). Self-contact
adds gaps between elements (`self_contact`).

A step is the minimum of a model, L to second order with each gap to first: every node stays on its side of the
tangent plane of each obstacle, which of a convex one separates, so that no step, nor a part of it, leads through. Which
contacts are closed in the model is sought to its end before a step is taken (`linalg.unilateral`). Obstacles that are
not convex, or thin, limit the step (`step_passage`). Elements only; `nodal_forms` has the two forms, by tangents and by
frames, the latter with loads that have no potential.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization import potentials
from rodjax.discretization.contact_gaps import (
    curve,
    gaps_and_normals,
    has_wells,
    pressure_rows,
    rough_obstacles,
    within_elements,
)
from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.form import FLOOR_SAFETY, NEUTRAL, Linearization
from rodjax.discretization.friction import tangential
from rodjax.discretization.nearest_places import comes_through, nearest, wide_cells
from rodjax.discretization.nodal_point import Friction, Nodal, NodalChange
from rodjax.discretization.node_contacts import (
    GAP_WEIGHT,
    LIES_ON,
    contact_model,
    contacts_on_elements,
    contacts_with_itself,
    relaxation,
)
from rodjax.discretization.node_friction import travelled, with_friction
from rodjax.discretization.node_positions import PositionForm
from rodjax.discretization.potentials import OnElements
from rodjax.discretization.self_contact import exerted
from rodjax.discretization.step_passage import stays_outside
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import AnySystem
from rodjax.linalg.unilateral import Unilateral, minimized
from rodjax.model.scene import has_contacts, has_free_ends, has_friction, has_no_place
from rodjax.programs.parts import traced_once

# A start touches where its gap is below this part of the radius, as nodes do beside a middle of a coarser mesh.
TOUCHES = 1e-2
# Compliance of contacts in the merit of a step [L^3/EI], of those between elements in their own unit. A step goes along
# tangent planes, and a node that slides on a surface leaves it by the square of its way: with contacts as stiff as
# those of the model, the merit would refuse all but short steps.
MERIT_COMPLIANCE = 1e-4
# The longest way of a node in a step of a rod that friction alone holds [L].
LONGEST_WAY = 0.02


class NodalForm(PositionForm):
    """A `PositionForm` beside obstacles, whose friction has a memory, and beside itself."""

    def others(self, multipliers: Float[Array, "k"]) -> NodalChange:
        nodes, rows = len(self.field.s), pressure_rows(self.scene) + 3 * len(rough_obstacles(self.scene))
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
        """Nodes that press on obstacles, moved along the normal so that the gap is that of the linearisation.

        So a taut cable slides over a cylinder in whole steps; along straight lines it would gain length.
        """
        gaps, normals = gaps_and_normals(self, nodal.positions)
        beyond, there = gaps_and_normals(self, retracted.positions)
        beyond -= gaps + jnp.einsum("knc,nc->kn", normals, others.displacements)
        pushes = (retracted.pressures[: len(gaps)] > 0) & ~self.is_held[None]
        positions = retracted.positions - jnp.einsum("kn,knc->nc", jnp.where(pushes, beyond, 0.0), there)
        return dataclasses.replace(retracted, positions=positions)

    def longest_step(self, point: Any, others: NodalChange) -> Float[Array, ""] | None:
        """Where friction alone holds the rod, its model may have it fly off: the part of a step that leaves it near."""
        if not has_no_place(self.scene) or not has_friction(self.scene):
            return None
        way = jnp.sqrt(jnp.max(jnp.sum(others.displacements**2, axis=1)))
        return LONGEST_WAY / jnp.maximum(way, LONGEST_WAY)

    def accepted(self, point: Any, here: Linearization) -> Any:
        assert here.gaps is not None
        nodal = dataclasses.replace(point.nodal, relaxed=relaxation(self, here.gaps))
        if nodal.friction is not None:
            assert isinstance(here.system, ChainSystem)
            rough = np.array(rough_obstacles(self.scene))
            forces = tangential(nodal.friction.forces, here.system.contacts.normals[rough])
            nodal = dataclasses.replace(nodal, friction=dataclasses.replace(nodal.friction, forces=forces))
        return dataclasses.replace(point, nodal=nodal)

    def searching(self, point: Any) -> Any:
        """With the wells of an equilibrium, as which it may be balanced; of a start without contacts, all wide."""
        if not has_wells(self.scene):
            return point
        point, pressures = _with_wells(point, jnp.ones(len(self.field.s) - 1, bool)), point.nodal.pressures[-1]
        return _with_wells(point, wide_cells(curve(self, point), pressures) | ~jnp.any(pressures > 0))

    def touches(self, point: Any) -> Bool[Array, ""]:
        return jnp.any(point.nodal.contact_forces != 0)

    @property
    def refines(self) -> bool:
        return has_wells(self.scene)

    def refined(self, point: Any, is_balanced: Bool[Array, ""]) -> tuple[Any, Bool[Array, ""]]:
        """A balanced point with narrow wells where they do; once wide again, none becomes narrow a second time. Another
        one with wide wells in all cells.
        """
        before, pressures = point.nodal.is_wide, point.nodal.pressures[-1]
        is_wide = wide_cells(curve(self, point), pressures)
        is_wide = jnp.where(jnp.all(before), is_wide, before | is_wide) | ~is_balanced
        point = _with_wells(point, is_wide)
        touches = (pressures[:-1] > 0) | (exerted(curve(self, point), pressures).gaps < 0)
        return point, jnp.any((is_wide != before) & touches)

    def ended(self, point: Any) -> Any:
        return _with_wells(point, None) if has_wells(self.scene) else point

    @traced_once
    def begun(
        self,
        point: Any,
        nodes: Float[Array, "n+1 3"],
        pressures: Float[Array, "k n+1"] | None,
        friction: Friction | None,
    ) -> Any:
        """NaN pressures, which are unknown, follow from the forces through the elements; of a rod with two free ends,
        whose friction has no bound without them, they are at least those of its weight where it rests.
        """
        nothing = jnp.zeros((pressure_rows(self.scene), len(nodes)), nodes.dtype)
        rough = rough_obstacles(self.scene)
        if rough and friction is None:
            friction = Friction.from_rest(len(rough), nodes)
        nodal = self.nodal_held(Nodal(nodes, nothing, nothing[:, 0], friction if rough else None))
        assert nodal is not None
        point = dataclasses.replace(point, nodal=nodal)
        if point.end_force.shape[1] != len(nodes) - 1:
            point = dataclasses.replace(point, end_force=self.forces_in_elements(point))
        if not has_contacts(self.scene):
            return point
        gaps, normals = gaps_and_normals(self, nodal.positions)
        pushing = jnp.einsum("cn,knc->kn", self.applied(point), normals)
        if has_free_ends(self.scene):
            h = jnp.diff(self.field.s) / 2
            resting = -jnp.einsum("c,knc->kn", total_force(self.scene), normals)
            pushing = jnp.maximum(pushing, resting * (jnp.pad(h, (0, 1)) + jnp.pad(h, (1, 0)))[None])
        pushing = jnp.where((pushing > 0) & (gaps < TOUCHES * self.radius[None]), pushing, 0.0)
        pushing = jnp.concatenate([pushing, nothing[len(pushing) :]])
        known = nothing + jnp.nan if pressures is None else pressures
        # Files until format 12 have those at nodes only.
        known = jnp.concatenate([known, nothing[len(known) :] + jnp.nan])
        pressures = jnp.where(jnp.isnan(known), pushing, known)
        nodal = dataclasses.replace(nodal, pressures=pressures)
        point = dataclasses.replace(point, nodal=nodal)
        nodal = dataclasses.replace(nodal, relaxed=relaxation(self, self.gaps(point)))
        return dataclasses.replace(point, nodal=nodal)

    # --- fields along the elements -----------------------------------------------------------------------------------

    def fields_on_elements(self, point: Any) -> OnElements | None:
        """With the contacts within the elements, whose forces count as distributed along them."""
        fields = None
        if self.scene.potentials:
            fields = potentials.on_elements(self.scene, self.field.s, *self.node_lines(point))
        contacts = contacts_on_elements(self, point)
        return fields if contacts is None else contacts.added_to(fields)

    # --- the search --------------------------------------------------------------------------------------------------

    def shifted(self, system: Any, shift: Float[Array, ""]) -> ChainSystem:
        return held_back(system, shift)

    def scaled(self, others: NodalChange, motion: Any, multipliers: Any) -> NodalChange:
        return NodalChange(motion * others.displacements, multipliers * others.pressures)

    def objective(self, here: Linearization, point: Any, others: NodalChange) -> Float[Array, ""]:
        """L with the energy of contacts as soft as `MERIT_COMPLIANCE`, with the pressures after the step."""
        assert here.gaps is not None
        model = contact_model(self, point, here.gaps, here.reference_displacements)
        return here.energy + _merit_of_contacts(model, others)

    def contact_energy(self, there: Any, point: Any, others: NodalChange) -> Float[Array, ""]:
        """That in `objective`, at a trial of a step from `point`."""
        nodal, displacements = there.nodal, None
        if nodal.friction is not None:
            displacements = travelled(self, nodal.positions, nodal.friction)
        return _merit_of_contacts(contact_model(self, point, self.gaps(there), displacements), others)

    def contact_rate(
        self, here: Linearization, point: Any, others: NodalChange, rates: Float[Array, "r n+1"]
    ) -> Float[Array, ""]:
        """How fast that changes as a step begins, in which gaps change at these rates."""
        assert here.gaps is not None
        model = contact_model(self, point, here.gaps, here.reference_displacements)
        pushing = model.allowed(model.pressures + others.pressures - model.gaps / MERIT_COMPLIANCE)
        return -jnp.sum(pushing * rates)

    def gaps(self, point: Any) -> Float[Array, "k n+1"]:
        """In the rows of pressures."""
        gaps, _ = gaps_and_normals(self, point.nodal.positions)
        _, _, inner_gaps = within_elements(self, point)
        gaps = jnp.concatenate([gaps, inner_gaps])
        if not self.scene.self_contact:
            return gaps
        far = contacts_with_itself(self, point, point.nodal.pressures[-1])
        return jnp.concatenate([gaps, far.gaps[None]])

    def half_square(self, here: Linearization) -> Float[Array, ""]:
        assert isinstance(here.system, ChainSystem)
        _, _, balance, _ = here.system.split(here.constraint_residual)
        return super().half_square(here) + jnp.sum(balance**2 / self.field.weights[::2, None]) / 2

    def sought(
        self, here: Linearization, point: Any, system: AnySystem, push: Float[Array, "b m"]
    ) -> tuple[Bool[Array, ""], Float[Array, "b m"], Float[Array, "k"]]:
        if not has_contacts(self.scene):
            return super().sought(here, point, system, push)
        found = minimized(*self.model_of_step(here, point, system, push))
        return found.is_minimum, found.x, found.y

    def model_of_step(
        self, here: Linearization, point: Any, system: AnySystem, push: Float[Array, "b m"]
    ) -> tuple[ChainSystem, Float[Array, "b m"], Float[Array, "k"], Unilateral]:
        """As `minimized` takes it."""
        assert isinstance(system, ChainSystem)
        assert here.gaps is not None
        moments, c = self.without_contacts(here, point.nodal.contact_forces)
        contacts = contact_model(self, point, here.gaps, here.reference_displacements)
        return first_closed(system, contacts), push + moments, c, contacts

    def without_contacts(
        self, here: Linearization, forces: Float[Array, "r n+1"]
    ) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        """The right sides of a step without the forces of contacts."""
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
        assert isinstance(here.system, ChainSystem)
        rows = here.system.contacts
        # With the new pressures in place of the old ones.
        rate += self.contact_rate(here, point, others, rows.rates(rotation, others.displacements))
        if rows.inner is not None or rows.far is not None:
            # The gradient by rotations has the pressures as they are.
            at_rest = rows.rates(rotation, jnp.zeros_like(others.displacements))
            rate += jnp.sum(point.nodal.contact_forces * at_rest)
        of_energies = self.of_energies_at_nodes(point)
        if of_energies is not None:
            rate -= jnp.sum(of_energies * others.displacements.T)
        return gaps.reshape(-1), gap_rates.reshape(-1), energy - before, rate - counted

    def accepts(self, point: Any, trial: Any, is_better: Bool[Array, ""]) -> Bool[Array, ""]:
        """Only where no part of the rod goes through an obstacle, or through another part."""
        if self.scene.self_contact:
            before = curve(self, point)
            is_better &= ~comes_through(before, nearest(before), curve(self, trial))
        return stays_outside(self, point, trial, is_better)

    def coupled(self, point: Any, system: AnySystem) -> AnySystem:
        return with_friction(self, point, system)

    def rounding_floor(self, point: Any) -> Float[Array, ""]:
        floor = super().rounding_floor(point)  # pyright: ignore
        if not has_contacts(self.scene):
            return floor
        return floor + FLOOR_SAFETY * jnp.finfo(floor.dtype).eps * GAP_WEIGHT


def first_closed(system: ChainSystem, contacts: Unilateral) -> ChainSystem:
    """With the first guess of the closed contacts; a node that lies on an obstacle without pressure counts as closed.

    What slips, and by how much, is a matter of the model of a step.
    """
    is_closed, rough = system.contacts.is_closed, 0 if contacts.bounds is None else 3 * len(contacts.bounds)
    k = len(is_closed) - rough
    is_closed = is_closed.at[:k].set(is_closed[:k] | (contacts.gaps[:k] < LIES_ON))
    if rough:
        trial = contacts.pressures - contacts.gaps / system.contacts.contact_compliance
        is_closed = is_closed.at[k:].set(contacts.is_closed(trial)[k:])
    return system.closed_where(is_closed)


def _merit_of_contacts(model: Unilateral, others: NodalChange) -> Float[Array, ""]:
    pushing = model.pressures + others.pressures - model.gaps / MERIT_COMPLIANCE
    return model.energy(pushing, jnp.asarray(MERIT_COMPLIANCE, pushing.dtype))


def held_back(system: ChainSystem, shift: Float[Array, ""]) -> ChainSystem:
    """Shifted, with its nodes: pushed hard against what is round, they are unstable, however stiff rotations."""
    system = system.shifted(shift)
    # What only makes neutral turns regular leaves the balance of nodes as it is.
    held = jnp.where(shift > NEUTRAL, shift, 0.0) * jnp.eye(3, dtype=shift.dtype)
    return dataclasses.replace(system, stiffness=system.stiffness + held[None])


def _with_wells(point: Any, is_wide: Bool[Array, "n"] | None) -> Any:
    return dataclasses.replace(point, nodal=dataclasses.replace(point.nodal, is_wide=is_wide))
