"""What the window shows of an equilibrium: the shape between the nodes, quantities along it, loads, and its numbers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.analysis.clearance import places, radius_at
from rodjax.analysis.curvature import curvature_along, curvature_within
from rodjax.analysis.samples import framed_at
from rodjax.discretization.hermite import Curve
from rodjax.programs.compilation import compiled
from rodjax.solving.result import Equilibrium

# Places between two nodes, with the first of the two: smooth to the eye on 32 elements.
PLACES = 4

# Quantities by which a rod may be coloured, and how they are called.
QUANTITIES = {
    "curvature": "curvature [1/m]",
    "twist": "twist rate [rad/m]",
    "tension": "tension [N]",
    "pressure": "contact force [N/m]",
}


class Along(NamedTuple):
    """A rod at k arclengths: what one program finds of it."""

    s: Float[np.ndarray, "k"]
    centerline: Float[np.ndarray, "k 3"]
    tangents: Float[np.ndarray, "k 3"]
    d1: Float[np.ndarray, "k 3"]
    curvature: Float[np.ndarray, "k"]
    largest_curvature: Float[np.ndarray, ""]  # on both sides of nodes, too: it jumps at clips
    clearances: Float[np.ndarray, "obstacles"]
    clip_forces: Float[np.ndarray, "clips 3"]
    obstacle_forces: Float[np.ndarray, "obstacles 3"]
    contact: Float[np.ndarray, "n+1"]  # size of the contact force of each node [N]


class Reading(NamedTuple):
    """A rod at rest as it is shown, in SI units and NumPy's arrays.

    `centerline`, `d1`, `d2`: (k, 3), at arclengths `s` (k,); `values`: (k,) of each quantity; `feet`, `forces`,
    `moments`: (m, 3), what each of the m places that hold the rod exerts on it; `clearances`: (obstacles,).
    `bend_radius`: the smallest one of the centerline, infinite where it is straight.
    """

    s: Float[np.ndarray, "k"]
    centerline: Float[np.ndarray, "k 3"]
    d1: Float[np.ndarray, "k 3"]
    d2: Float[np.ndarray, "k 3"]
    values: dict[str, Float[np.ndarray, "k"]]
    feet: Float[np.ndarray, "m 3"]
    forces: Float[np.ndarray, "m 3"]
    moments: Float[np.ndarray, "2 3"]
    clearances: Float[np.ndarray, "obstacles"]
    obstacle_forces: Float[np.ndarray, "obstacles 3"]
    bend_radius: float


@compiled
def _along(equilibrium: Equilibrium) -> tuple[Array, ...]:
    s = places(equilibrium, np.arange(PLACES) / PLACES)
    centerline, tangents, d1 = framed_at(equilibrium, s)
    if isinstance(equilibrium.state.shape, Curve):
        curvature = curvature_within(equilibrium, s)
    else:
        curvature = jnp.interp(s, equilibrium.s, equilibrium.curvature)
    largest = jnp.max(curvature_along(equilibrium)[1])
    scene = equilibrium.scene
    clearances = jnp.zeros(0, s.dtype)
    if scene.obstacles:
        radius = radius_at(scene.rod, s)
        clearances = jnp.stack([jnp.min(jax.vmap(one.at)(centerline) - radius) for one in scene.obstacles])
    forces = equilibrium.obstacle_forces
    contact = jnp.sqrt(jnp.sum(jnp.sum(forces, axis=0) ** 2, axis=-1))
    totals = jnp.sum(forces, axis=1)
    return s, centerline, tangents, d1, curvature, largest, clearances, equilibrium.clip_forces, totals, contact


def reading_of(equilibrium: Equilibrium) -> Reading:
    """Of one equilibrium. `moments` are those at the two ends."""
    along = Along(*(np.asarray(array) for array in _along(equilibrium)))
    nodes = np.asarray(equilibrium.s)

    def between(values: Array | np.ndarray) -> Float[np.ndarray, "k"]:
        return np.interp(along.s, nodes, np.asarray(values))

    values = {name: between(getattr(equilibrium, name)) for name in ("twist", "tension")}
    values["curvature"] = along.curvature
    if equilibrium.scene.obstacles:
        # Of the half elements on both sides of a node.
        shares = (np.append(np.diff(nodes), 0.0) + np.append(0.0, np.diff(nodes))) / 2
        values["pressure"] = between(along.contact / shares)
    largest = float(along.largest_curvature)
    ends = np.asarray(equilibrium.nodes)[[0, -1]]
    clips = [np.asarray(clip.position) for clip in equilibrium.scene.clips]
    # At s = 0 what the support applies is the reverse of the section force.
    forces = [-np.asarray(equilibrium.start_force), np.asarray(equilibrium.end_force)]
    return Reading(
        s=along.s,
        centerline=along.centerline,
        d1=along.d1,
        d2=np.cross(along.tangents, along.d1),
        values=values,
        feet=np.stack([*ends, *clips]),
        forces=np.stack([*forces, *along.clip_forces]),
        moments=np.stack([-np.asarray(equilibrium.start_moment), np.asarray(equilibrium.end_moment)]),
        clearances=along.clearances,
        obstacle_forces=along.obstacle_forces,
        bend_radius=1 / largest if largest > 0 else np.inf,
    )
