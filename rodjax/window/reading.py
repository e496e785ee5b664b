"""What the window shows of rods at rest: shapes between the nodes, quantities along them, loads, and their numbers."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.analysis.clearance import arclengths_between, radius_at
from rodjax.analysis.curvature import curvature_along, curvature_within
from rodjax.analysis.samples import framed_at, lengths_at_nodes
from rodjax.checks import Numbers
from rodjax.discretization.hermite import Curve
from rodjax.geometry.rotations import from_frame
from rodjax.model.obstacles import Obstacle
from rodjax.programs.compilation import compiled
from rodjax.solving.harness_result import HarnessEquilibrium
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


class Pieces(NamedTuple):
    """A rod as cylinders from each of k + 1 places to the next: middles, turns (w, x, y, z) of axes of which the third
    is along the rod and the first along d1, scales along them: radius, 1 m without one, and length.
    """

    positions: Float[Numbers, "k 3"]
    wxyzs: Float[Numbers, "k 4"]
    scales: Float[Numbers, "k 3"]


class Reading(NamedTuple):
    """A rod at rest as it is shown, in SI units.

    `centerline`, `d1`, `d2`: (k, 3), at arclengths `s` (k,); `values`: (k,) of each quantity; `feet`, `forces`,
    `moments`: (m, 3), what each of the m places that hold the rod exerts on it, moments at its two ends.
    """

    s: Float[Numbers, "k"]
    centerline: Float[Numbers, "k 3"]
    d1: Float[Numbers, "k 3"]
    d2: Float[Numbers, "k 3"]
    values: dict[str, Any]
    feet: Float[Numbers, "m 3"]
    forces: Float[Numbers, "m 3"]
    moments: Float[Numbers, "2 3"]
    pieces: Pieces


class Figures(NamedTuple):
    """What takes a look at all of the rod: `bend_radius`, the smallest one of the centerline [m], infinite where it is
    straight; `clearances` from the obstacles of the scene, then from those beside it [m], and the forces [N] with which
    those of the scene push.
    """

    bend_radius: Float[Numbers, ""]
    clearances: Float[Numbers, "obstacles"]
    obstacle_forces: Float[Numbers, "touching 3"]


def _reading(equilibrium: Equilibrium) -> Reading:
    s = arclengths_between(equilibrium, np.arange(PLACES) / PLACES)
    centerline, tangents, d1 = framed_at(equilibrium, s)
    nodes, scene = equilibrium.s, equilibrium.scene
    values = {name: jnp.interp(s, nodes, getattr(equilibrium, name)) for name in ("curvature", "twist", "tension")}
    if isinstance(equilibrium.state.shape, Curve):
        values["curvature"] = curvature_within(equilibrium, s)
    if scene.obstacles:
        contact = jnp.sqrt(jnp.sum(equilibrium.contact_forces**2, axis=-1))
        values["pressure"] = jnp.interp(s, nodes, contact / lengths_at_nodes(nodes))
    ends = equilibrium.nodes[jnp.array([0, -1])]
    clips = [clip.position[None] for clip in scene.clips]
    # At s = 0 what the support applies is the reverse of the section force.
    forces = [-equilibrium.start_force[None], equilibrium.end_force[None], equilibrium.clip_forces]
    return Reading(
        s=s,
        centerline=centerline,
        d1=d1,
        d2=jnp.cross(tangents, d1),
        values=values,
        feet=jnp.concatenate([ends, *clips]),
        forces=jnp.concatenate(forces),
        moments=jnp.stack([-equilibrium.start_moment, equilibrium.end_moment]),
        pieces=_pieces(centerline, d1, jnp.ones_like(s) if scene.rod.radius is None else radius_at(scene.rod, s)),
    )


def _pieces(centerline: Float[Array, "k 3"], d1: Float[Array, "k 3"], radius: Float[Array, "k"]) -> Pieces:
    """A little longer where the rod bends, so that nothing gapes on the outside."""
    chords = jnp.diff(centerline, axis=0)
    lengths = jnp.sqrt(jnp.sum(chords**2, axis=1))
    along = chords / lengths[:, None]
    across = d1[:-1] + d1[1:]
    across = across - jnp.sum(across * along, axis=1, keepdims=True) * along
    across = across / jnp.linalg.norm(across, axis=1, keepdims=True)
    frames = jnp.stack([across, jnp.cross(along, across), along], axis=-1)
    radii = (radius[:-1] + radius[1:]) / 2
    turns = jnp.pad(jnp.linalg.norm(jnp.diff(along, axis=0), axis=1), 1)
    longer = lengths + radii * jnp.maximum(turns[:-1], turns[1:])  # by half of it at both ends
    pieces = (centerline[:-1] + centerline[1:]) / 2, jax.vmap(from_frame)(frames), jnp.stack([radii, radii, longer], 1)
    return Pieces(*(numbers.astype(jnp.float32) for numbers in pieces))


Shown = Equilibrium | HarnessEquilibrium
# What is shown of rods that are stacked.
Groups = tuple[Any, ...]


def over_groups(function: Callable[[Equilibrium], Any], shown: Shown) -> Groups:
    """A function of an equilibrium, of that of each rod; those of one structure and mesh are stacked."""
    if isinstance(shown, Equilibrium):
        return (jax.tree.map(lambda leaf: leaf[None], function(shown)),)
    return tuple(jax.vmap(function)(group) for group in shown.groups)


def of_rods(groups: Groups, shown: Shown) -> tuple[Any, ...]:
    """What was found of stacked rods, of each rod in turn, in NumPy's arrays."""
    groups = jax.tree.map(np.asarray, groups)
    members = ((0,),) if isinstance(shown, Equilibrium) else shown.members
    found = {
        number: jax.tree.map(lambda leaf, place=place: leaf[place], group)
        for numbers, group in zip(members, groups, strict=True)
        for place, number in enumerate(numbers)
    }
    return tuple(found[number] for number in range(len(found)))


def readings_in_program(shown: Shown) -> Groups:
    """As a part of a program: stacked, of JAX's arrays."""
    return over_groups(_reading, shown)


def readings_of(shown: Shown) -> tuple[Reading, ...]:
    """Of each rod, in NumPy's arrays."""
    return of_rods(_readings(shown), shown)


_readings = compiled(readings_in_program)


@compiled
def _figures(shown: Shown, beside: tuple[Obstacle, ...]) -> Groups:
    return over_groups(lambda equilibrium: _figures_of_rod(equilibrium, beside), shown)


def _figures_of_rod(equilibrium: Equilibrium, beside: tuple[Obstacle, ...]) -> Figures:
    # On both sides of nodes, too: at clips curvature jumps.
    largest = jnp.max(curvature_along(equilibrium)[1])
    scene, clearances = equilibrium.scene, jnp.zeros(0, equilibrium.s.dtype)
    obstacles = scene.obstacles + beside
    if obstacles:
        s = arclengths_between(equilibrium, np.arange(PLACES) / PLACES)
        centerline, radius = equilibrium.position_at(s), radius_at(scene.rod, s)
        clearances = jnp.stack([jnp.min(jax.vmap(one.at)(centerline) - radius) for one in obstacles])
    return Figures(1 / largest, clearances, jnp.sum(equilibrium.obstacle_forces, axis=1))


def figures_of(shown: Shown, beside: tuple[Obstacle, ...] = ()) -> tuple[Figures, ...]:
    """Of each rod; `beside`: obstacles that do not touch it."""
    return of_rods(_figures(shown, beside), shown)
