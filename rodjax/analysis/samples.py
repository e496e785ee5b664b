"""A rod at rest between its nodes: centerline, frames, and what it is strained and loaded by, at any arclengths."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.analysis.clearance import radius_at
from rodjax.analysis.curvature import curvature_along
from rodjax.checks import namespace
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.section_loads import is_known_along, loads_between, section_loads
from rodjax.discretization.twist import angle_about, transport
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_form import form_and_point, over_leading_axes

# A polyline through the samples is this close to the curve, by the length of the rod; the samples of an element at
# least, and of all elements at most.
CHORD_ERROR = 5e-5
LEAST_PIECES, MOST_PIECES = 4, 20_000


class Samples(NamedTuple):
    """A rod at rest at k arclengths, or several of them along a leading axis `...`; SI units, global axes.

    - `s` [..., k], `is_node` (k,): whether there is a node of the mesh
    - `positions` [..., k, 3]; `frames` [..., k, 3, 3], columns d1, d2, t, of a rod that shears d1, d2, d3
    - `curvature` [..., k] of the centerline, `twist`, `tension`
    - `force`, `moment` [..., k, 3]: what the part beyond s exerts on the part before it; `None` of finite differences
      and of the continuum, which do not keep them
    - `radius` [..., k], `None` of a rod without one; `contact` [..., k, 3]: force of obstacles per length [N/m]
    - At a clip they are those just beyond it
    """

    s: Float[np.ndarray, "... k"]
    is_node: np.ndarray
    positions: Float[np.ndarray, "... k 3"]
    frames: Float[np.ndarray, "... k 3 3"]
    curvature: Float[np.ndarray, "... k"]
    twist: Float[np.ndarray, "... k"]
    tension: Float[np.ndarray, "... k"]
    force: Float[np.ndarray, "... k 3"] | None
    moment: Float[np.ndarray, "... k 3"] | None
    radius: Float[np.ndarray, "... k"] | None
    contact: Float[np.ndarray, "... k 3"] | None


def smooth_samples(equilibrium: Equilibrium) -> Samples:
    """At the nodes, and between them as closely as a smooth picture needs: chords depart from the curve by
    `CHORD_ERROR` of the length at most. The elements of all rods of a stack are divided alike.
    """
    s, curvature = np.asarray(equilibrium.s), np.asarray(equilibrium.curvature)
    length = (s[..., -1] - s[..., 0])[..., None]
    steps = np.diff(s, axis=-1)
    turned = np.maximum(curvature[..., 1:], curvature[..., :-1])
    # The sagitta of a chord of length h on an arc of curvature k is k h^2/8.
    wanted = steps * np.sqrt(turned / (8 * CHORD_ERROR * length))
    wanted = np.max(np.reshape(wanted, (-1, wanted.shape[-1])), axis=0)
    most = max(LEAST_PIECES, MOST_PIECES // wanted.size)
    finite = np.where(np.isfinite(wanted), wanted, 0.0)
    pieces = np.clip(np.ceil(finite), LEAST_PIECES, most).astype(int)
    cell = np.append(np.repeat(np.arange(wanted.size), pieces), wanted.size - 1)
    fraction = np.append(np.concatenate([np.arange(count) / count for count in pieces]), 1.0)
    return _samples(equilibrium, cell, fraction)


def samples_at(equilibrium: Equilibrium, s: Float[np.ndarray, "k"]) -> Samples:
    """Of a single equilibrium at arclengths from 0 to L [m]."""
    nodes = np.asarray(equilibrium.s)
    cell = np.clip(np.searchsorted(nodes, s, side="right") - 1, 0, len(nodes) - 2)
    return _samples(equilibrium, cell, (s - nodes[cell]) / (nodes[cell + 1] - nodes[cell]))


def _samples(equilibrium: Equilibrium, cell: Int[np.ndarray, "k"], fraction: Float[np.ndarray, "k"]) -> Samples:
    nodes = np.asarray(equilibrium.s)
    found = _along(equilibrium, cell, fraction.astype(nodes.dtype))
    s, positions, frames = (np.array(values) for values in found[:3])
    radius, force, moment = (None if values is None else np.asarray(values) for values in found[3:])
    is_node = (fraction == 0) | (fraction == 1)
    number = (cell + (fraction == 1))[is_node]
    # To the last bit.
    s[..., is_node] = nodes[..., number]
    positions[..., is_node, :] = np.asarray(equilibrium.nodes)[..., number, :]

    def between(values, arclengths=nodes) -> np.ndarray:
        return _interpolated(s, arclengths, np.asarray(values))

    arclengths, curvature = (np.asarray(x) for x in curvature_along(equilibrium))
    tension = between(equilibrium.tension) if force is None else np.sum(force * frames[..., 2], axis=-1)
    contact = None
    if equilibrium.scene.obstacles:
        line = np.asarray(equilibrium.contact_forces) / lengths_at_nodes(nodes)[..., None]
        contact = np.stack([between(line[..., k]) for k in range(3)], axis=-1)
    return Samples(
        s,
        is_node,
        positions,
        frames,
        between(curvature, arclengths),
        between(equilibrium.twist),
        tension,
        force,
        moment,
        radius,
        contact,
    )


def lengths_at_nodes(s: Any) -> Any:
    """What of the rod belongs to each node at s [..., n+1]: half of the elements on both sides."""
    xp = namespace(s)
    steps = xp.diff(s, axis=-1)
    none = xp.zeros_like(steps[..., :1])
    return (xp.concatenate([none, steps], axis=-1) + xp.concatenate([steps, none], axis=-1)) / 2


def _interpolated(s: np.ndarray, arclengths: np.ndarray, values: np.ndarray) -> np.ndarray:
    if s.ndim == 1:
        return np.interp(s, arclengths, values)
    return np.stack([np.interp(*row) for row in zip(s, arclengths, values, strict=True)])


@over_leading_axes
def _along(equilibrium: Equilibrium, cell: Int[Array, "k"], fraction: Float[Array, "k"]):
    nodes = equilibrium.s
    s = nodes[cell] + fraction * (nodes[cell + 1] - nodes[cell])
    centerline, tangents, d1 = framed_at(equilibrium, s)
    frames = jnp.stack([d1, jnp.cross(tangents, d1), tangents], axis=-1)
    rod = equilibrium.scene.rod
    radius = None if rod.radius is None else radius_at(rod, s)
    if equilibrium.discretization == "continuum" or isinstance(equilibrium.state.shape, Polyline):
        return s, centerline, frames, radius, None, None
    form, point = form_and_point(equilibrium)
    if not is_known_along(form):
        return s, centerline, frames, radius, None, None
    units = equilibrium.state.units
    slopes = (1 + equilibrium.axial_strain)[:, None] * equilibrium.tangents
    if rod.GA is not None:
        slopes = jax.jvp(equilibrium.position_at, (nodes,), (jnp.ones_like(nodes),))[1]
    positions = (equilibrium.nodes - units.origin[None]) / units.length
    loads = section_loads(form, point)
    force, moment = loads_between(loads, positions, slopes, nodes / units.length, cell, fraction)
    return s, centerline, frames, radius, force * units.force, moment * units.energy


def framed_at(
    equilibrium: Equilibrium, s: Float[Array, "k"]
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"], Float[Array, "k 3"]]:
    """Centerline, section normals d3 (its tangents, unless the rod shears) and d1 of one equilibrium at arclengths."""
    centerline, slopes = jax.jvp(equilibrium.position_at, (s,), (jnp.ones_like(s),))
    tangents = slopes / jnp.linalg.norm(slopes, axis=1, keepdims=True)
    if equilibrium.scene.rod.GA is not None:
        tangents = _section_normals(equilibrium, s, tangents)
    return centerline, tangents, _directors(equilibrium, s, tangents)


def _section_normals(
    equilibrium: Equilibrium, s: Float[Array, "k"], tangents: Float[Array, "k 3"]
) -> Float[Array, "k 3"]:
    """Of a rod that shears, d3 between the nodes: it departs from the centerline's tangent as it does beside it."""
    away = equilibrium.frames[..., 2] - equilibrium.tangents
    normals = tangents + jnp.stack([jnp.interp(s, equilibrium.s, part) for part in away.T], axis=1)
    return normals / jnp.linalg.norm(normals, axis=1, keepdims=True)


def _directors(equilibrium: Equilibrium, s: Float[Array, "k"], tangents: Float[Array, "k 3"]) -> Float[Array, "k 3"]:
    """d1 between the nodes: carried from both neighbours without twist, the angle between the two shared evenly."""
    nodes = equilibrium.s
    cell = jnp.clip(jnp.sum(nodes[None] <= s[:, None], axis=1) - 1, 0, len(nodes) - 2)
    length = nodes[cell + 1] - nodes[cell]
    d1, normals = equilibrium.frames[:, :, 0], equilibrium.frames[:, :, 2]
    from_before = jax.vmap(transport)(d1[cell], normals[cell], tangents)
    from_after = jax.vmap(transport)(d1[cell + 1], normals[cell + 1], tangents)
    # Frames give the angle up to turns: take the one nearest to the twist rate.
    expected = length * (equilibrium.twist[cell] + equilibrium.twist[cell + 1]) / 2
    angle = jax.vmap(angle_about)(tangents, from_before, from_after)
    angle += 2 * jnp.pi * jnp.round((expected - angle) / (2 * jnp.pi))
    angle = ((s - nodes[cell]) / length * angle)[:, None]
    return jnp.cos(angle) * from_before + jnp.sin(angle) * jnp.cross(tangents, from_before)
