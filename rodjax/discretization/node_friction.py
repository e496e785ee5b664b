"""Coulomb friction between obstacles and the nodes of a rod: what sticks, what slips, and the derivatives of both.

The slip s of a node is its displacement along the surface since the last equilibrium (`Friction.reference`), the
tangential force q is its multiplier, |q| <= mu p. In the model of a step the bound has the pressure of the last
iterate, so that the model has a minimum and is symmetric; both agree in the end.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization.contact_gaps import gaps_and_normals, rough_obstacles
from rodjax.discretization.friction import LEAST_SLIP, directions, lengths, pulled, tangential
from rodjax.discretization.nodal_point import Friction, Nodal
from rodjax.discretization.node_positions import PositionForm
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import AnySystem
from rodjax.model.obstacles import InUnits, friction_coefficient


def travelled(form: PositionForm, positions: Float[Array, "n+1 3"], friction: Friction) -> Float[Array, "n+1 3"]:
    """Displacements of the nodes since the last equilibrium; zero from rest, and of nodes that are held."""
    (obstacle, *_) = form.scene.obstacles
    assert isinstance(obstacle, InUnits)
    is_still = jnp.isnan(friction.reference) | form.is_held[:, None]
    before = (jnp.where(is_still, 0.0, friction.reference) - obstacle.origin[None]) / obstacle.length
    return jnp.where(is_still, 0.0, positions - before)


def friction_bounds(form: PositionForm, pressures: Float[Array, "k n+1"], friction: Friction) -> Float[Array, "f n+1"]:
    """Bounds mu p of the tangential forces; 0 from rest."""
    coefficients = jnp.stack([friction_coefficient(form.scene.obstacles[k]) for k in rough_obstacles(form.scene)])
    is_still = jnp.isnan(friction.reference[:, 0]) | form.is_held
    pressures = pressures[np.array(rough_obstacles(form.scene))]
    return jnp.where(is_still[None] | (pressures < 0), 0.0, coefficients[:, None] * pressures)


def slip_rows(form: PositionForm, normals: Float[Array, "k n+1 3"]) -> Float[Array, "3f n+1 3"]:
    """The gradients of slips, the rows of projections on tangent planes."""
    normals = normals[np.array(rough_obstacles(form.scene))]
    identity = jnp.eye(3, dtype=normals.dtype)[None, None]
    projections = identity - normals[..., :, None] * normals[..., None, :]
    projections = jnp.where(form.is_held[None, :, None, None], 0.0, projections)
    return jnp.swapaxes(projections, 1, 2).reshape(-1, *normals.shape[1:])


def sticking(
    form: PositionForm, nodal: Nodal, normals: Float[Array, "k n+1 3"], displacements: Float[Array, "n+1 3"]
) -> Bool[Array, "f n+1"]:
    """Whether contacts with friction stick: nodes that have not slipped, and where less than the bound holds."""
    assert nodal.friction is not None
    exerted, slips = pulled(nodal.friction.forces, displacements, normals[np.array(rough_obstacles(form.scene))])
    bounds = friction_bounds(form, nodal.pressures, nodal.friction)
    has_slipped = lengths(slips)[..., 0] > LEAST_SLIP
    return (bounds > 0) & ((lengths(exerted)[..., 0] < bounds) | ~has_slipped)


def friction_at(form: PositionForm, nodal: Nodal) -> tuple[Float[Array, "f n+1 3"], Float[Array, "f n+1 3"]]:
    """Tangential forces, and slips. What slips and what sticks, and the forces of the latter, are those given."""
    friction = nodal.friction
    assert friction is not None
    _, normals = gaps_and_normals(form, nodal.positions)
    normals, bounds = normals[np.array(rough_obstacles(form.scene))], friction_bounds(form, nodal.pressures, friction)
    displacements = travelled(form, nodal.positions, friction)
    held, slips = tangential(friction.forces, normals), tangential(displacements[None], normals)
    exerted, _ = jax.lax.stop_gradient(pulled(friction.forces, displacements, normals))
    sticks = jax.lax.stop_gradient(sticking(form, nodal, gaps_and_normals(form, nodal.positions)[1], displacements))
    return jnp.where(sticks[..., None], held, bounds[..., None] * directions(exerted, slips)), slips


def by_law(form: PositionForm, point: Any) -> Any:
    """The point with the tangential forces of what slips as pressures, positions and scene make them."""
    if point.nodal is None or point.nodal.friction is None:
        return point
    forces, _ = friction_at(form, point.nodal)
    friction = dataclasses.replace(point.nodal.friction, forces=forces)
    return dataclasses.replace(point, nodal=dataclasses.replace(point.nodal, friction=friction))


def with_friction(form: PositionForm, point: Any, system: AnySystem) -> AnySystem:
    """The system with the derivatives of friction by pressures and positions, which are not symmetric."""
    nodal = point.nodal
    if nodal is None or nodal.friction is None:
        return system
    assert isinstance(system, ChainSystem)
    rough, contacts = np.array(rough_obstacles(form.scene)), system.contacts
    k = len(nodal.pressures)

    def changed(positions: Array, pressures: Array) -> tuple[Array, Array]:
        return friction_at(form, dataclasses.replace(nodal, positions=positions, pressures=pressures))

    def by_positions(axis: Float[Array, "3"]) -> tuple[Array, Array]:
        turned = jnp.broadcast_to(axis[None], nodal.positions.shape)
        return jax.jvp(lambda positions: changed(positions, nodal.pressures), (nodal.positions,), (turned,))[1]

    def by_pressures(pressures: Array) -> Array:
        return changed(nodal.positions, pressures)[0]

    forces, slips = jax.vmap(by_positions)(jnp.eye(3, dtype=nodal.positions.dtype))  # [direction, f, node, component]
    _, dragging = jax.jvp(by_pressures, (nodal.pressures,), (jnp.ones_like(nodal.pressures),))
    free = jnp.where(form.is_held, 0.0, 1.0).astype(forces.dtype)[:, None]
    pushes = contacts.normals.at[rough].add(dragging * free[None])
    rows = slips.transpose(1, 3, 2, 0).reshape(-1, *nodal.positions.shape) * free[None]
    normals = jnp.concatenate([contacts.normals[:k], rows])
    rows = dataclasses.replace(contacts, normals=normals, pushes=pushes)
    stiffness = system.stiffness - free[..., None] * jnp.einsum("dfnc->ncd", forces)
    return dataclasses.replace(system, contacts=rows, stiffness=stiffness)
