"""What an equilibrium says at its nodes and ends, from its tangents, the forces on its ends and its total twist."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.hermite import QuadraticRotationElements
from rodjax.discretization.joints import Joints, bending_derivatives, tangent_bases, twist_derivatives
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.nodes import held_nodes
from rodjax.discretization.potentials import OnElements
from rodjax.discretization.twist import angle_about, transport, transport_along
from rodjax.geometry.vectors import cross, dot, root
from rodjax.mechanics.energy import axial_strain_under, curvature_under, torque_at
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Directed, Free, Support
from rodjax.programs.parts import traced_once


class Resultants(eqx.Module):
    """Names and signs as in `rodjax.Equilibrium`, nondimensional."""

    frames: Float[Array, "n+1 3 3"]
    curvature: Float[Array, "n+1"]
    twist: Float[Array, "n+1"]
    tension: Float[Array, "n+1"]
    axial_strain: Float[Array, "n+1"]
    start_force: Float[Array, "3"]
    start_moment: Float[Array, "3"]
    end_force: Float[Array, "3"]
    end_moment: Float[Array, "3"]
    shear_strain: Float[Array, "n+1 2"] | None = None


def resultants(form: MixedForm, point: MixedPoint) -> Resultants:
    """Of an equilibrium."""
    if isinstance(form.field, QuadraticRotationElements):
        return _on_elements(form, form.field, point)
    assert isinstance(form.field, EdgeTangents)
    tension, forces = form.edge_tension(point), form.end_forces(point, None)
    return _on_edges(form.scene, form.field, point.tangents, tension, forces, point.total_twist)


@traced_once
def _on_elements(form: MixedForm, field: QuadraticRotationElements, point: MixedPoint) -> Resultants:
    """Moments are the derivatives of the energy of the element beside by the tangent of a node: of fourth order too."""
    scene, rod, tangents = form.scene, form.scene.rod, point.tangents
    nodes = tangents[:, ::2]
    torque = torque_at(rod, point.total_twist)
    fields = form.fields_on_elements(point)
    by_start, by_end = _by_ends(form, field, point, torque, fields)
    moments = cross(nodes, jnp.concatenate([-by_start[:, :1], by_end], axis=1))
    curvatures = curvature_under(rod, moments)
    curvature = root(dot(curvatures, curvatures))
    moments += torque * nodes
    forces = form.end_forces(point, fields)
    tension = form.edge_tension(point)[::2]
    if fields is not None:
        sections = form.with_fields(form.forces(point), fields)[:, ::2] * field.h[None, None]
        beside = jnp.pad(sections[:, 0], ((0, 0), (0, 1))) + jnp.pad(sections[:, 1], ((0, 0), (1, 0)))
        tension = dot(beside, nodes) / (jnp.pad(field.h, (0, 1)) + jnp.pad(field.h, (1, 0)))
    number = jnp.arange(len(tension))
    for k, force in zip((0, len(tension) - 1), forces, strict=True):
        tension = jnp.where(number == k, dot(force[:, None], nodes), tension)
    start_d1 = scene.start.frame[:, 0] if isinstance(scene.start, Clamp) else _any_normal(nodes[:, 0])
    return Resultants(
        frames=_turning_frames(scene, nodes, field.carried(start_d1, tangents), point.total_twist * field.s),
        curvature=curvature,
        twist=jnp.full_like(field.s, point.total_twist),
        tension=tension,
        axial_strain=axial_strain_under(rod, tension),
        start_force=forces[0],
        start_moment=_given_moment(scene.start, moments[:, 0], sign=-1),
        end_force=forces[1],
        end_moment=_given_moment(scene.end, moments[:, -1], sign=1),
    )


def _by_ends(
    form: MixedForm,
    field: QuadraticRotationElements,
    point: MixedPoint,
    torque: Float[Array, ""],
    fields: OnElements | None,
) -> tuple[Float[Array, "3 n"], Float[Array, "3 n"]]:
    """The derivatives of L of each element by the tangents of its nodes."""
    by_ends = field.by_end_tangents(form.scene, point.tangents, form.forces(point)[:, ::2], torque)
    return with_fields_by_tangent(fields, by_ends)


def element_end_moments(form: MixedForm, point: MixedPoint, fields: OnElements | None) -> Float[Array, "3 2 n"]:
    """The section moments at both ends of each element, on its side of the node."""
    tangents, torque = point.tangents, torque_at(form.scene.rod, point.total_twist)
    assert isinstance(form.field, QuadraticRotationElements)
    by_start, by_end = _by_ends(form, form.field, point, torque, fields)
    start, end = tangents[:, 0:-1:2], tangents[:, 2::2]
    return jnp.stack([torque * start - cross(start, by_start), torque * end + cross(end, by_end)], axis=1)


def with_fields_by_tangent(
    fields: OnElements | None, by_ends: tuple[Float[Array, "3 n"], Float[Array, "3 n"]]
) -> tuple[Float[Array, "3 n"], Float[Array, "3 n"]]:
    """With what fields add to these."""
    if fields is None:
        return by_ends
    return by_ends[0] + fields.by_tangent[:, 0], by_ends[1] + fields.by_tangent[:, 1]


def positions_between(
    form: MixedForm, point: MixedPoint, nodes: Float[Array, "n+1 3"], s: Float[Array, "k"]
) -> Float[Array, "k 3"]:
    """The centerline at arclengths between the nodes of elements: polynomials of fifth degree by position, slope and
    second derivative, which force and moment give on each side of a node.
    """
    field, scene = form.field, form.scene
    assert isinstance(field, QuadraticRotationElements)
    rod, tangents = scene.rod, point.tangents
    torque = torque_at(rod, point.total_twist)
    fields = form.fields_on_elements(point)
    by_start, by_end = _by_ends(form, field, point, torque, fields)
    forces = form.with_fields(form.forces(point), fields)
    weight = jnp.zeros(3, forces.dtype) if scene.gravity is None else scene.gravity
    weights = [weight[:, None], weight[:, None]]
    cell = jnp.clip(jnp.searchsorted(field.s, s, side="right") - 1, 0, len(field.h) - 1)

    if fields is not None:
        weights = [weight[:, None] + fields.density[:, k, cell] for k in range(2)]

    def derivatives(tangent, force, moment, weight) -> tuple[Float[Array, "3 k"], Float[Array, "3 k"]]:
        turn = cross(curvature_under(rod, moment), tangent)
        strain, softening = jax.jvp(
            lambda tension: axial_strain_under(rod, tension),
            (dot(force, tangent),),
            (dot(force, turn) - dot(jnp.broadcast_to(weight, tangent.shape), tangent),),
        )
        return (1 + strain)[None] * tangent, (1 + strain)[None] * turn + softening[None] * tangent

    start, end = tangents[:, 0:-1:2][:, cell], tangents[:, 2::2][:, cell]
    slope, bend = derivatives(start, forces[:, 0, cell], -cross(start, by_start[:, cell]), weights[0])
    end_slope, end_bend = derivatives(end, forces[:, 2, cell], cross(end, by_end[:, cell]), weights[1])
    h = field.h[cell]
    x = (s - field.s[cell]) / h
    # From the first node: what the way, the slopes and the second derivatives add.
    y = 1 - x
    weights = (
        x**3 * (10 - 15 * x + 6 * x**2),
        h * x * y**3 * (1 + 3 * x),
        h**2 * x**2 * y**3 / 2,
        -h * x**3 * y * (1 + 3 * y),
        h**2 * x**3 * y**2 / 2,
    )
    values = ((nodes[cell + 1] - nodes[cell]).T, slope, bend, end_slope, end_bend)
    return nodes[cell] + sum(weight[:, None] * value.T for weight, value in zip(weights, values, strict=True))


def clip_moments(form: MixedForm, point: MixedPoint) -> Float[Array, "clips 3"]:
    """What the clips apply to the rod, nondimensional: the derivatives of the energy by rotations of their tangents."""
    scene, field, tangents = form.scene, form.field, point.tangents
    moments = [jnp.zeros(3, tangents.dtype)] * len(scene.clips)
    directed = held_nodes(scene, field.clip_nodes)
    if isinstance(field, QuadraticRotationElements):
        torque = torque_at(scene.rod, point.total_twist)
        by_ends = _by_ends(form, field, point, torque, form.fields_on_elements(point))
        for k, node, _ in directed:
            moments[k] = jnp.cross(tangents[:, 2 * node], by_ends[1][:, node - 1] + by_ends[0][:, node])
    else:
        assert isinstance(field, EdgeTangents)
        for (k, _, _), (_, halves) in zip(directed, field.halves(scene, tangents), strict=True):
            held = halves.after[:, :1]
            basis = tangent_bases(jnp.concatenate([held, held], axis=1))
            by_rotation = bending_derivatives(scene.rod, halves, (basis, basis))
            along = basis[..., 0] @ (by_rotation.after[:, 0] + by_rotation.before[:, 1])
            moments[k] = jnp.cross(held[:, 0], along)
    return jnp.stack(moments)


def _given_moment(end: Support, held: Float[Array, "3"], *, sign: int) -> Float[Array, "3"]:
    """The section moment at an end: that which holds it, or the given one."""
    if isinstance(end, Directed):
        return held
    return sign * end.moment if isinstance(end, Free) and end.moment is not None else jnp.zeros_like(held)


def _on_edges(
    scene: Scene,
    field: EdgeTangents,
    tangents: Float[Array, "3 n"],
    edge_tension: Float[Array, "n"],
    end_forces: tuple[Float[Array, "3"], Float[Array, "3"]],
    twist: Float[Array, ""],
) -> Resultants:
    """Of a polyline with these unit tangents and tensions, under the forces at s = 0 and s = L."""
    rod = scene.rod
    n = tangents.shape[1]
    is_equal = field.arclengths is None
    h, last_h = (1 / n, 1 / n) if is_equal else (field.weights[0], field.weights[-1])
    start_moment = _end_moment(scene.start, rod, tangents[:, 0], h, torque_at(rod, twist), at_start=True)
    end_moment = _end_moment(scene.end, rod, tangents[:, -1], last_h, torque_at(rod, twist), at_start=False)
    start_tangent = _end_tangent(scene.start, rod, tangents[:, 0], h)
    end_tangent = _end_tangent(scene.end, rod, tangents[:, -1], last_h)
    inner = field.tangents_at_nodes(scene, tangents)
    spacing = jnp.full(n - 1, h, tangents.dtype) if is_equal else (field.weights[:-1] + field.weights[1:]) / 2
    inner_joints = Joints(tangents[:, :-1], tangents[:, 1:], spacing)
    inner_curvatures = inner_joints.squared_curvature
    for edge, halves in field.halves(scene, tangents):
        inner_curvatures = inner_curvatures.at[edge - 1].set(halves.squared_curvature[0])
    at_nodes = jnp.concatenate([start_tangent[:, None], inner, end_tangent[:, None]], axis=1)
    squared_curvatures = [
        _squared(curvature_under(rod, _across(start_moment, start_tangent)))[None],
        inner_curvatures,
        _squared(curvature_under(rod, _across(end_moment, end_tangent)))[None],
    ]
    end_tensions = [jnp.sum(force * t)[None] for force, t in zip(end_forces, (start_tangent, end_tangent), strict=True)]
    tension = jnp.concatenate([end_tensions[0], (edge_tension[:-1] + edge_tension[1:]) / 2, end_tensions[1]])
    return Resultants(
        frames=_frames(scene, tangents, at_nodes, twist, field.arclengths),
        curvature=root(jnp.concatenate(squared_curvatures)),
        twist=jnp.full(n + 1, twist),
        tension=tension,
        axial_strain=axial_strain_under(rod, tension),
        start_force=end_forces[0],
        start_moment=start_moment,
        end_force=end_forces[1],
        end_moment=end_moment,
    )


def _end_moment(
    end: Support,
    rod: Rod,
    edge_tangent: Float[Array, "3"],
    h: float | Float[Array, ""],
    torque: Float[Array, ""],
    *,
    at_start: bool,
) -> Float[Array, "3"]:
    """The section moment at an end: the derivative of the energy by a rotation of the support, or the given moment."""
    sign = -1 if at_start else 1
    if not isinstance(end, Directed):
        return _given_moment(end, jnp.zeros(3, edge_tangent.dtype), sign=sign)

    order = (end.tangent, edge_tangent) if at_start else (edge_tangent, end.tangent)
    before, after = (tangent[:, None] for tangent in order)
    half_cell = Joints(before, after, jnp.full(1, h / 2, before.dtype))
    bases = tangent_bases(before), tangent_bases(after)
    side = "before" if at_start else "after"
    by_rotation = getattr(bending_derivatives(rod, half_cell, bases), side)
    spin = jnp.zeros_like(torque)
    if isinstance(end, Clamp):
        by_rotation += torque * getattr(twist_derivatives(half_cell, bases), side)
        spin = torque
    along = jnp.sum(bases[not at_start] * by_rotation[None], axis=1)
    return sign * cross(end.tangent[:, None], along)[:, 0] + spin * end.tangent


def _end_tangent(
    end: Support, rod: Rod, edge_tangent: Float[Array, "3"], h: float | Float[Array, ""]
) -> Float[Array, "3"]:
    """The tangent at an end: prescribed, or that of the edge, turned by what a dead moment bends half an edge."""
    if isinstance(end, Directed):
        return end.tangent
    if isinstance(end, Free) and end.moment is not None:
        turned = edge_tangent + h / 2 * jnp.cross(curvature_under(rod, end.moment), edge_tangent)
        return turned / jnp.sqrt(_squared(turned))
    return edge_tangent


def _frames(
    scene: Scene,
    edges: Float[Array, "3 n"],
    nodes: Float[Array, "3 n+1"],
    twist: Float[Array, ""],
    s: Float[Array, "n+1"] | None,
) -> Float[Array, "n+1 3 3"]:
    """Material frames at the nodes, from the end that holds the twist (or a choice where none does).

    `edges`, `nodes`: the tangents there. A node's tangent lies on the arc between those of its edges. `s`: arclengths,
    `None` where the nodes are equally spaced.
    """
    start_d1 = scene.start.frame[:, 0] if isinstance(scene.start, Clamp) else _any_normal(nodes[:, 0])
    along_edges = transport_along(start_d1, jnp.concatenate([nodes[:, :1], edges], axis=1))
    d1 = transport(along_edges[:, 1:], edges, nodes[:, 1:])
    d1 = jnp.concatenate([start_d1[:, None], d1], axis=1)
    if s is None:
        s = jnp.linspace(0.0, 1.0, nodes.shape[1], dtype=twist.dtype)
    return _turning_frames(scene, nodes, d1, twist * s)


def _turning_frames(
    scene: Scene, nodes: Float[Array, "3 n+1"], d1: Float[Array, "3 n+1"], angle: Float[Array, "n+1"]
) -> Float[Array, "n+1 3 3"]:
    """Frames about these tangents, from directors carried without twist and the angles by which to turn them."""
    if isinstance(scene.end, Clamp) and not isinstance(scene.start, Clamp):
        angle += angle_about(nodes[:, -1], d1[:, -1], scene.end.frame[:, 0]) - angle[-1]
    d2 = cross(nodes, d1)
    turned = jnp.cos(angle)[None] * d1 + jnp.sin(angle)[None] * d2
    return jnp.stack([turned, cross(nodes, turned), nodes]).transpose(2, 1, 0)


def _any_normal(tangent: Float[Array, "3"]) -> Float[Array, "3"]:
    axis = jnp.eye(3, dtype=tangent.dtype)[jnp.argmin(jnp.abs(tangent))]
    normal = jnp.cross(tangent, axis)
    return normal / jnp.sqrt(_squared(normal))


def _across(vector: Float[Array, "3"], axis: Float[Array, "3"]) -> Float[Array, "3"]:
    """The part of `vector` at right angles to the unit `axis`."""
    return vector - jnp.sum(vector * axis) * axis


def _squared(vector: Float[Array, "3"]) -> Float[Array, ""]:
    return jnp.sum(vector**2)
