"""Rods within obstacles: how deep they lie, and whether they came through one."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.discretization.contact_error import depths_of_elements
from rodjax.discretization.form import Point
from rodjax.discretization.nodal import NodalForm
from rodjax.mechanics.passage import Passage, Sampled, passage
from rodjax.model.obstacles import InUnits
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_form import form_and_point, over_leading_axes
from rodjax.units import Units

# A rod deeper within an obstacle than this part of its radius is so by forces beyond all loads on it, as in a jam.
MOST_PENETRATION = 1e-4


def penetration(equilibrium: Equilibrium) -> Float[np.ndarray, "..."]:
    """How deep the rod lies within obstacles, at nodes and between them, as a part of the radius."""
    if not equilibrium.scene.obstacles:
        return np.zeros(equilibrium.s.shape[:-1])
    return np.asarray(_deepest(equilibrium))


@over_leading_axes
def _deepest(equilibrium: Equilibrium) -> Float[Array, ""]:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    return jnp.max(depths_of_elements(form, point))


@over_leading_axes
def passage_of(equilibrium: Equilibrium) -> Passage:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    state = equilibrium.state
    if state.before is None:  # of a file of an earlier version
        return Passage(
            jnp.full((), -1), jnp.full_like(equilibrium.residual, jnp.nan), jnp.array(False), jnp.array(False)
        )
    found = passage(state.before, sampled(form, point, state.shape.nodes, state.units))
    return found


def sampled(form: NodalForm, point: Point, nodes: Float[Array, "n+1 3"], units: Units) -> Sampled:
    """Where a rod is, at a point of a form with these nodes."""
    points, radius, held = form.samples(nodes, point)
    points, held = (units.origin[None] + units.length * place for place in (points, held))
    obstacles = tuple(obstacle.obstacle for obstacle in form.scene.obstacles if isinstance(obstacle, InUnits))
    return Sampled(points, units.length * radius, held, obstacles)
