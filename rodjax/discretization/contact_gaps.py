"""Gaps between a rod whose nodes have positions of their own and the obstacles of its scene, at nodes and in elements.

Obstacles without friction (`smooth_obstacles`) touch elements too, where these come nearest to them. A node that a
support holds has no gaps: they count as 1. Rows of pressures are, in this order, those of all obstacles at nodes, those
of obstacles without friction within elements, and one between elements (`self_contact`).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.discretization.curve_distance import Curve, with_wells
from rodjax.discretization.inner_contacts import PARTING, SAG, SAME_CURVATURE, THINNER, Elements, Places
from rodjax.discretization.nearest_places import wide_cells
from rodjax.discretization.node_positions import PositionForm
from rodjax.geometry.vectors import root
from rodjax.model.obstacles import Obstacle, friction_coefficient
from rodjax.model.scene import Scene, slides
from rodjax.programs.parts import traced_once

# Compliance of a contact in the model of a step, as a part of an element's own, h^3/EI. So much of a pressure's change,
# times some 200, is asked for again in the next step; the smaller, the more digits the elimination loses.
CONTACT_COMPLIANCE = 1e-5
# And at least this times the rounding unit [L^3/EI] where elements are touched: elimination goes from one node
# of such an element to the other, and rounds the stiffness of the rest of the rod by that of the contact.
LEAST_COMPLIANCE = 5e4
# Of contacts between elements [L^3/EI]: two contacts a tenth of an element apart, as in plectonemes, share their force
# by the compliance of the piece between them, which is larger than this. With 1e-10 too many digits are lost. Pressures
# are multipliers, so that it does not stay in the result.
FAR_COMPLIANCE = 1e-9


def smooth_obstacles(scene: Scene) -> tuple[int, ...]:
    """The numbers of the obstacles without friction: those that are touched within elements too."""
    return tuple(k for k, obstacle in enumerate(scene.obstacles) if friction_coefficient(obstacle) is None)


def touched_within(scene: Scene) -> tuple[Obstacle, ...]:
    """The obstacles without friction."""
    return tuple(scene.obstacles[k] for k in smooth_obstacles(scene))


def rough_obstacles(scene: Scene) -> tuple[int, ...]:
    """The numbers of the obstacles with friction."""
    return tuple(k for k, obstacle in enumerate(scene.obstacles) if friction_coefficient(obstacle) is not None)


def inner_rows(scene: Scene) -> slice:
    """Of all rows of pressures, those within elements."""
    return slice(len(scene.obstacles), len(scene.obstacles) + len(smooth_obstacles(scene)))


def pressure_rows(scene: Scene) -> int:
    """Of all obstacles at nodes, of those without friction within elements, and one between elements."""
    return len(scene.obstacles) + len(smooth_obstacles(scene)) + scene.self_contact


def distances_and_normals(
    scene: Scene, positions: Float[Array, "n+1 3"]
) -> tuple[Float[Array, "k n+1"], Float[Array, "k n+1 3"]]:
    """Distances from the obstacles to positions, and their gradients."""
    found = [jax.vmap(jax.value_and_grad(obstacle.at))(positions) for obstacle in scene.obstacles]
    return jnp.stack([distance for distance, _ in found]), jnp.stack([normals for _, normals in found])


def curvatures(scene: Scene, positions: Float[Array, "p 3"]) -> Float[Array, "k p 3 3"]:
    """The second derivatives of the distances from the obstacles."""
    return jnp.stack([jax.vmap(jax.hessian(obstacle.at))(positions) for obstacle in scene.obstacles])


def curvature_terms(
    scene: Scene, positions: Float[Array, "p 3"], pressures: Float[Array, "k p"]
) -> Float[Array, "p 3 3"]:
    """Second derivatives of -sum p g by the positions of nodes."""
    total = jnp.zeros((len(positions), 3, 3), positions.dtype)
    for obstacle, pressure in zip(scene.obstacles, pressures, strict=True):
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


def depths_at(scene: Scene, positions: Float[Array, "k 3"], radius: Float[Array, "k"]) -> Float[Array, "k"]:
    """Penetration into the nearest obstacle at these positions, relative to the radius there; 0 outside."""
    distances = jnp.stack([jax.vmap(obstacle.at)(positions) for obstacle in scene.obstacles])
    return jnp.maximum(1 - jnp.min(distances, axis=0) / radius, 0.0)


def gaps_and_normals(
    form: PositionForm, positions: Float[Array, "n+1 3"]
) -> tuple[Float[Array, "k n+1"], Float[Array, "k n+1 3"]]:
    """Gaps at the nodes, 1 at those that are held, and the directions in which they grow."""
    if not form.scene.obstacles:
        return jnp.zeros((0, len(positions)), positions.dtype), jnp.zeros((0, *positions.shape), positions.dtype)
    distances, normals = distances_and_normals(form.scene, positions)
    return jnp.where(form.is_at_support[None], 1.0, distances - form.radius[None]), normals


@traced_once
def within_elements(form: PositionForm, point: Any) -> tuple[Elements, Places | None, Float[Array, "q n+1"]]:
    """The elements, where they come nearest to the obstacles without friction, `None` if there are none, and the gaps
    there.
    """
    s, obstacles = form.field.s, touched_within(form.scene)
    free = jnp.where(form.is_held, 0.0, 1.0).astype(s.dtype)
    positions, gravity = point.nodal.positions, form.scene.gravity
    h, radius = jnp.diff(s), form.radius_in_elements(jnp.full(1, 0.5, s.dtype))[:, 0]
    parting = PARTING * SAME_CURVATURE * h**2
    if gravity is not None:
        parting += SAG * root(jnp.sum(gravity**2)) * h**4
    elements = Elements.of(positions, point.tangents[:, ::2], form.node_axes(point), free, s, parting / radius)
    if not obstacles:
        return elements, None, jnp.zeros((0, len(s)), s.dtype)
    distances = jnp.stack([jax.vmap(obstacle.at)(positions) for obstacle in obstacles])
    is_held = form.is_at_support
    if form.pushed is not None:
        is_held &= ~jnp.zeros_like(is_held).at[np.array([0, -1])].set(form.pushed)
    is_held_within = is_held[None] & (distances < (1 - THINNER) * form.radius[None])
    places = Places.of(elements, obstacles, form.radius_along, is_held_within)
    return elements, places, jnp.pad(places.gaps, ((0, 0), (0, 1)), constant_values=1.0)


def has_wells(scene: Scene) -> bool:
    """Whether self-contact has wide wells. They belong to the mesh, which goes along with sliding clips: then the
    energy would change as it does.
    """
    return scene.self_contact and not slides(scene)


def curve(form: PositionForm, point: Any) -> Curve:
    """What self-contact needs of the rod at a point."""
    s = form.field.s
    free = jnp.where(form.is_held, 0.0, 1.0).astype(s.dtype)
    radius = form.radius_in_elements(jnp.full(1, 0.5, s.dtype))[:, 0]
    found = Curve(s, point.nodal.positions, point.tangents[:, ::2], form.node_axes(point), free, radius, form.normal)
    if not has_wells(form.scene):
        return found
    is_wide = point.nodal.is_wide
    return with_wells(found, wide_cells(found, point.nodal.pressures[-1]) if is_wide is None else is_wide)


def model_compliance(form: PositionForm) -> Float[Array, ""]:
    """Compliance of the contacts in the model of a step [L^3/EI]."""
    h = jnp.diff(form.field.s)
    compliance = CONTACT_COMPLIANCE * h[jnp.argmin(h)] ** 3
    if not smooth_obstacles(form.scene):
        return compliance
    return jnp.maximum(compliance, LEAST_COMPLIANCE * jnp.finfo(h.dtype).eps)


def far_unit(form: PositionForm) -> Float[Array, ""]:
    """The unit of pressures between elements in which all contacts have the same compliance."""
    return jnp.sqrt(model_compliance(form) / FAR_COMPLIANCE)
