"""Contacts of a rod with obstacles and with itself, in L and in the model of a step.

The pressure p >= 0 [a force, for each obstacle and node or middle] is the multiplier of the gap g >= 0. A contact of
the model is closed where it presses; the search for those is `linalg.unilateral`. A rod that lies within an obstacle
has its gaps seen larger by half of its depth (`relaxation`): each step leads it half of the way out.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.discretization.contact_gaps import (
    curvature_terms,
    curve,
    distances_and_normals,
    far_unit,
    gaps_and_normals,
    inner_rows,
    model_compliance,
    pressure_rows,
    rough_obstacles,
    smooth_obstacles,
    touched_within,
    within_elements,
)
from rodjax.discretization.friction import pulled, tangential, within
from rodjax.discretization.node_friction import friction_at, friction_bounds, slip_rows, sticking, travelled
from rodjax.discretization.node_positions import PositionForm
from rodjax.discretization.potentials import OnElements, PointForces, at_both
from rodjax.discretization.self_contact import Exerted, SelfContacts, exerted, on_elements, self_contacts
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.chain_rows import ContactRows, InnerRows
from rodjax.linalg.unilateral import Unilateral
from rodjax.programs.parts import traced_once

# A gap counts as so much of a force in EI/L^2 when it is asked whether a search has ended.
GAP_WEIGHT = 1e4
# A rod less deep within an obstacle than this [L] is led out in one step.
LEAST_RELAXED = 1e-3
# A node lies on an obstacle where its gap is below this [L].
LIES_ON = 1e-9
# What a contact does.
OPEN, STICKS, SLIPS = 0, 1, 2


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


def contacts_at(form: PositionForm, point: Any) -> Contacts:
    """Gaps, their derivatives, and which contacts press or stick at a point."""
    nodal = point.nodal
    gaps, normals = gaps_and_normals(form, nodal.positions)
    is_free = jnp.where(form.is_at_support, 0.0, 1.0).astype(normals.dtype)[:, None]
    normals *= is_free[None]
    curving = is_free[..., None] * curvature_terms(form.scene, nodal.positions, nodal.pressures[: len(gaps)])
    inner, rows_within, across = None, None, slip_rows(form, normals) if nodal.friction is not None else None
    by_rotations, far_rows = None, None
    if smooth_obstacles(form.scene):
        inner_gaps, rows_within, inner = _inner(form, point, nodal.pressures[inner_rows(form.scene), :-1])
        gaps = jnp.concatenate([gaps, inner_gaps])
    if form.scene.self_contact:
        found = contacts_with_itself(form, point, nodal.pressures[-1])
        far_rows, by_rotations = found.rows, found.by_rotations
        gaps = jnp.concatenate([gaps, found.gaps[None]])
    normals = jnp.pad(normals, ((0, len(gaps) - len(normals)), (0, 0), (0, 0)))
    displacements, is_closed = None, form.closed
    if is_closed is None:
        is_closed = nodal.pressures > GAP_WEIGHT * (gaps + relaxation(form, gaps)[:, None])
    if nodal.friction is not None and across is not None:
        displacements = travelled(form, nodal.positions, nodal.friction)
        sticks = sticking(form, nodal, normals, displacements)
        is_closed = jnp.concatenate([is_closed, jnp.repeat(sticks, 3, axis=0)])
        normals = jnp.concatenate([normals, across])
    rows = ContactRows(normals, model_compliance(form), is_closed, inner=rows_within, far=far_rows)
    gradient = None
    if inner is not None or far_rows is not None:
        # What pressures do to the rotations.
        nothing = jnp.zeros((form.node_axes(point).shape[1], 2 * len(form.field.s) - 1), gaps.dtype)
        gradient = -rows.turned(nodal.contact_forces, nothing)
    return Contacts(gaps, rows, curving, displacements, gradient, inner, by_rotations)


def contacts_with_itself(form: PositionForm, point: Any, pressures: Float[Array, "n+1"]) -> SelfContacts:
    """Self-contact of the rod with these pressures between its elements."""
    return self_contacts(curve(form, point), pressures, far_unit(form), pressure_rows(form.scene) - 1)


def exerted_by_itself(form: PositionForm, point: Any) -> Exerted:
    """The nearest points of elements and of the rod beyond them, and the forces there."""
    return exerted(curve(form, point), far_unit(form) * point.nodal.pressures[-1])


def _inner(
    form: PositionForm, point: Any, pressures: Float[Array, "q n"]
) -> tuple[Float[Array, "q n+1"], InnerRows, Float[Array, "2b+6 2b+6 n"]]:
    """Gaps within the elements, their gradients, and the second derivatives of -sum p g."""
    elements, places, gaps = within_elements(form, point)
    assert places is not None
    rates, (b, n) = places.rates(elements), elements.axes.shape[2:]
    by_rotation, by_position = (jnp.swapaxes(part, 1, 2) for part in jnp.split(rates, [b], axis=2))
    rows = InnerRows(by_rotation, by_position, first=len(form.scene.obstacles))
    # Where the rod touches nothing of this kind, curvatures are not computed.
    blocks = jax.lax.cond(
        jnp.any(pressures != 0),
        lambda: places.second(elements, touched_within(form.scene), pressures),
        lambda: jnp.zeros((2, b + 3, 2, b + 3, n), gaps.dtype),
    )
    return gaps, rows, blocks.reshape(2 * (b + 3), 2 * (b + 3), n)


def relaxation(form: PositionForm, gaps: Float[Array, "k n+1"]) -> Float[Array, "k"]:
    """Half of the penetration into each obstacle, added to its gaps in the next step; 0 below `LEAST_RELAXED`."""
    depths = -jnp.min(gaps, axis=1, initial=jnp.inf)
    if smooth_obstacles(form.scene):
        smooth, inner = np.array(smooth_obstacles(form.scene)), inner_rows(form.scene)
        deepest = jnp.maximum(depths[smooth], depths[inner])
        depths = depths.at[smooth].set(deepest).at[inner].set(deepest)
    least = jnp.full(len(depths), LEAST_RELAXED, depths.dtype)
    if form.scene.self_contact:
        least = least.at[-1].multiply(far_unit(form))
    return jnp.where(depths > least, depths / 2, 0.0)


def contact_model(
    form: PositionForm, point: Any, gaps: Float[Array, "k n+1"], displacements: Float[Array, "n+1 3"] | None
) -> Unilateral:
    """The contacts of the quadratic model of a step, with these gaps and displacements since the last equilibrium."""
    nodal = point.nodal
    gaps = gaps + nodal.relaxed[:, None]
    if nodal.friction is None or displacements is None:
        return Unilateral(gaps, nodal.pressures)
    _, normals = gaps_and_normals(form, nodal.positions)
    slips = jnp.einsum("knc,nc->kn", slip_rows(form, normals), displacements)
    bounds = friction_bounds(form, nodal.pressures, nodal.friction)
    return Unilateral(jnp.concatenate([gaps, slips]), nodal.contact_forces, bounds)


def contact_residuals(form: PositionForm, point: Any, contacts: Contacts) -> tuple[Array, Array, Array]:
    """The residuals of contacts and of the balance of nodes, and the largest component of both."""
    nodal, gaps = point.nodal, contacts.gaps
    pressures, forces = nodal.pressures, nodal.contact_forces
    balance = form.applied(point).T - contacts.rows.pushed(forces)
    balance = jnp.where(form.is_held[:, None], 0.0, balance)
    off_balance = jnp.where(form.is_at_support[:, None], 0.0, balance) if form.ends_move else balance
    # Of a gap and a pressure one is zero, and none is negative where the closed contacts are those that press.
    weighted = GAP_WEIGHT * gaps
    is_open = pressures < weighted if form.closed is None else ~form.closed
    amiss = jnp.max(jnp.abs(jnp.where(is_open, pressures, weighted)), initial=0.0)
    if nodal.friction is not None and contacts.reference_displacements is not None:
        normals = contacts.rows.normals[np.array(rough_obstacles(form.scene))]
        exerted, slips = pulled(nodal.friction.forces, contacts.reference_displacements, normals)
        off = tangential(nodal.friction.forces, normals)
        off -= within(exerted, friction_bounds(form, pressures, nodal.friction))
        off = jnp.max(jnp.abs(off))
        amiss = jnp.where(off > amiss, off, amiss)
        gaps = jnp.concatenate([gaps, jnp.swapaxes(slips, 1, 2).reshape(-1, gaps.shape[1])])
    rows = -jnp.where(contacts.rows.is_closed, gaps, forces)
    return rows.reshape(-1), balance, larger(jnp.max(jnp.abs(off_balance)), amiss)


def exerted_by_obstacles(
    form: PositionForm, point: Any
) -> tuple[Float[Array, "k n+1 3"], Float[Array, "k n+1 3"], Int[Array, "k n+1"]]:
    """Normal and friction forces of each obstacle on each node, and whether the contact is open, sticks or slips. A
    force within an element counts at both of its nodes, by the lever.
    """
    nodal = point.nodal
    _, normals = distances_and_normals(form.scene, nodal.positions)
    k = len(normals)
    pushes = nodal.pressures[:k, :, None] * normals
    pressures = nodal.pressures[:k]
    if smooth_obstacles(form.scene):
        elements, places, _ = within_elements(form, point)
        assert places is not None
        shares = jax.vmap(lambda t: elements.weights(t)[0])(places.t) * nodal.pressures[k:, None, :-1][: len(places.t)]
        smooth = np.array(smooth_obstacles(form.scene))
        pressures = pressures.at[smooth].add(jax.vmap(at_both)(shares[:, None])[:, 0])
        on_nodes = jax.vmap(at_both)(places.normals[:, :, None] * shares[:, None])
        pushes = pushes.at[smooth].add(jnp.swapaxes(on_nodes, 1, 2))
    states = jnp.where(pressures > 0, SLIPS, OPEN)
    if nodal.friction is None:
        return pushes, jnp.zeros_like(pushes), states
    rough = np.array(rough_obstacles(form.scene))
    drags, _ = friction_at(form, nodal)
    # What sticks may be beyond its bound by what the search has left.
    drags = within(drags, friction_bounds(form, nodal.pressures, nodal.friction))
    sticks = sticking(form, nodal, normals, travelled(form, nodal.positions, nodal.friction))
    states = states.at[rough].set(jnp.where(sticks, STICKS, states[rough]))
    return pushes, jnp.zeros_like(pushes).at[rough].set(drags), states


def contacts_on_elements(form: PositionForm, point: Any) -> OnElements | None:
    """The forces of contacts within and between elements, and with other rods, as those of a field along them; `None`
    without such.
    """
    exerted, found = [], None
    if form.scene.self_contact:
        exerted.append(on_elements(curve(form, point), far_unit(form) * point.nodal.pressures[-1]))
    if form.scene.contact_loads is not None:
        exerted.append((form.scene.contact_loads.on_positions, form.scene.contact_loads.on_tangents))
    for on_positions, on_tangents in exerted:
        found = OnElements(-on_positions, -on_tangents, jnp.zeros_like(on_positions)).added_to(found)
    return _within_on_elements(form, point).added_to(found) if smooth_obstacles(form.scene) else found


@traced_once
def _within_on_elements(form: PositionForm, point: Any) -> OnElements:
    elements, places, _ = within_elements(form, point)
    assert places is not None
    forces = point.nodal.pressures[inner_rows(form.scene), None, :-1] * places.normals
    of_positions = jax.vmap(lambda t: elements.weights(t)[0])(places.t)
    by_position = -jnp.einsum("qcn,qen->cen", forces, of_positions)
    by_tangent = -jnp.sum(jax.vmap(elements.by_tangents)(places.t, forces), axis=0)
    at_places = PointForces(places.t, forces, of_positions[:, 0])
    return OnElements(by_position, by_tangent, jnp.zeros_like(by_position), at_places)


def shares(form: PositionForm, point: Any) -> Float[Array, "n+1 3"]:
    """Forces of contacts within elements on the rod, distributed to both nodes."""
    contacts = contacts_on_elements(form, point)
    return jnp.zeros_like(point.nodal.positions) if contacts is None else at_both(-contacts.by_position).T


def larger(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    """The maximum, with the derivative of one of the two where they are equal."""
    return jnp.where(a > b, a, b)
