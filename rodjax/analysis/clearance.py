"""How far a rod at rest is from what it shall not touch."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import Numbers, instance, whole_number
from rodjax.model.along import largest_beside
from rodjax.model.obstacles import Obstacle, checked_obstacles
from rodjax.model.rod import Rod
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_form import over_leading_axes

# Places between two nodes, where none are asked for, and at most.
POINTS = 4
MOST_POINTS = 10_000


class Clearance(eqx.Module):
    """Where a rod is nearest to each of m obstacles, or several rods along a leading axis `...`.

    - `distance` [..., m] m, from the surface of the rod to that of the obstacle, negative where they overlap
    - `s` [..., m] m, arclength of that place
    - `point` [..., m, 3] m, the centerline there
    """

    distance: Float[Array, "... m"]
    s: Float[Array, "... m"]
    point: Float[Array, "... m 3"]


def clearance(equilibrium: Equilibrium, obstacles: Any, points: Any = None) -> Clearance:
    """The least distance between the surface of a rod and each of several obstacles; no force acts between them.

    **Arguments:**

    - `equilibrium`: of one scene or of many; its rod has a radius.
    - `obstacles`: a list of `Obstacle`.
    - `points`: how many places between two nodes are looked at, besides the nodes; `None`: 4.

    At each place the distance is that of the centerline less the radius; of a radius that jumps, the larger one beside
    the place. Between places a distance h apart it is smaller than there by h/2 at most, and by h^2/8 times the
    curvature of the distance along s.

    Derivatives are those of the least distance, by numbers of the scene and of the obstacles, at a place that stays at
    the same part of the mesh. Where two places are as near as one another, they are those of the first.

    Raises `ValueError` or `TypeError` for a rod without a radius, or arguments that are not these.
    """
    instance(equilibrium, "equilibrium", Equilibrium)
    obstacles = checked_obstacles(obstacles)
    count = POINTS if points is None else whole_number(points, "points", 0, MOST_POINTS)
    if equilibrium.scene.rod.radius is None:
        raise ValueError("equilibrium.scene.rod must have a radius, got None; rodjax.Rod takes one")
    return _clearance(equilibrium, obstacles, np.arange(count + 1) / (count + 1))


@over_leading_axes
def _clearance(equilibrium: Equilibrium, obstacles: tuple[Obstacle, ...], fractions: Float[Array, "p"]) -> Clearance:
    s = arclengths_between(equilibrium, fractions)
    positions = equilibrium.position_at(s)
    radius = radius_at(equilibrium.scene.rod, s)
    each = [_nearest(obstacle, s, positions, radius) for obstacle in obstacles]
    return jax.tree.map(lambda *values: jnp.stack(values), *each)


def arclengths_between(equilibrium: Equilibrium, fractions: Float[Numbers, "p"]) -> Float[Array, "k"]:
    """The arclengths of the nodes, and of places at these fractions of the way between them, 0 the first."""
    nodes = equilibrium.s
    between = nodes[:-1, None] + jnp.asarray(fractions, nodes.dtype)[None] * jnp.diff(nodes)[:, None]
    return jnp.append(between.reshape(-1), nodes[-1])


def radius_at(rod: Rod, s: Float[Array, "k"]) -> Float[Array, "k"]:
    """The radius at arclengths one after another; of one that jumps, the larger one beside the place."""
    return largest_beside(rod.radius, s)


def _nearest(
    obstacle: Obstacle, s: Float[Array, "k"], positions: Float[Array, "k 3"], radius: Float[Array, "k"]
) -> Clearance:
    # The search needs no derivatives; those of the place found cost as much as one place.
    fixed, *points = jax.lax.stop_gradient((obstacle, positions, radius))
    nearest = jnp.argmin(fixed.distance(points[0]) - points[1])
    distance = obstacle.at(positions[nearest]) - radius[nearest]
    return Clearance(distance, s[nearest], positions[nearest])
