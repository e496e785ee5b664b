"""What contacts at a few places add to the error of a mesh, and how deep the rod lies within obstacles between them."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.contact_gaps import depths_at, rough_obstacles
from rodjax.discretization.error import Errors
from rodjax.discretization.form_results import positions_between_nodes
from rodjax.discretization.node_positions import PositionForm
from rodjax.geometry.vectors import dot, root

# A force F that acts aside of its place by half of the distance h to the next one where contacts act bends the rod as a
# moment of F h/8 on an element does, and displaces it by about half of that.
CONTACT_REACH = 16.0
CONTACT_MOMENT = 8.0
# Where it is looked at how deep a rod lies within obstacles, as parts of elements.
DEPTH_PLACES = (0.25, 0.5, 0.75)


def with_contacts(errors: Errors, form: PositionForm, point: Any) -> Errors:
    """With what it adds that contacts act at nodes and at one place of each element, with friction at nodes alone:
    where one lies by itself, it may be anywhere beside these; and that moments have a kink where one lies within an
    element.

    And how deep the rod lies between the nodes.
    """
    h = jnp.diff(form.field.s)
    forces = jnp.where(form.is_held[None], 0.0, form.applied(point))
    beside = jnp.pad(forces, ((0, 0), (1, 1)))
    alone = forces - (beside[:, :-2] + beside[:, 2:]) / 2  # not the pressure of an obstacle along which the rod lies
    spacing = (jnp.append(h, h[-1]) + jnp.append(h[0], h)) / (2 if rough_obstacles(form.scene) else 4)
    misplaced = alone * (spacing**2 / CONTACT_REACH)[None]
    sizes = root(dot(misplaced, misplaced))
    defects = errors.defects
    if defects is not None:
        defects = defects + (sizes[:-1] + sizes[1:]) / 2
    nodes = errors.nodes + misplaced[:, jnp.argmax(sizes)][None]
    moment = jnp.max(root(dot(alone, alone)) * spacing) / CONTACT_MOMENT
    fields = form.fields_on_elements(point)
    if fields is not None and fields.points is not None:
        within = fields.points
        sizes = jnp.sqrt(jnp.sum(within.forces**2, axis=1))
        beside = jnp.pad(sizes, ((0, 0), (1, 1)))
        sizes = sizes - (beside[:, :-2] + beside[:, 2:]) / 2
        moment = jnp.maximum(moment, jnp.max(sizes * h[None] * within.t * (1 - within.t)))
    moment /= errors.scale.moment
    return errors._replace(nodes=nodes, defects=defects, depths=depths_of_elements(form, point), misplaced=moment)


def depths_of_elements(form: PositionForm, point: Any) -> Float[Array, "n"]:
    """How deep the rod lies within obstacles at the ends of each element and between them, by the radius; of an element
    beside a held place so much more than it is held there.
    """
    s, nodes = form.field.s, point.nodal.positions
    at_nodes = depths_at(form.scene, nodes, form.radius)
    held = jnp.where(form.is_held, at_nodes, 0.0)
    parts = jnp.array(DEPTH_PLACES, s.dtype)
    arclengths = s[:-1, None] + parts[None] * jnp.diff(s)[:, None]
    positions = positions_between_nodes(form, point, nodes, arclengths.reshape(-1))
    between = depths_at(form.scene, positions, form.radius_in_elements(parts).reshape(-1)).reshape(arclengths.shape)
    at_ends = jnp.where(form.is_held, 0.0, at_nodes)
    depths = jnp.concatenate(
        [at_ends[:-1, None], at_ends[1:, None], between - held[:-1, None] - held[1:, None]], axis=1
    )
    return jnp.maximum(jnp.max(depths, axis=1), 0.0)
