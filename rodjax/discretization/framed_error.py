"""The error of an equilibrium by frames: what its mesh lacks of the continuum, as `error` has it for tangents."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import ElementCells
from rodjax.discretization.error import (
    COUPLE_REACH,
    STEPS,
    TURN_REACH,
    Errors,
    Sizes,
    correction,
    longest,
    of_sections,
)
from rodjax.discretization.frame_point import FramePoint
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_results import (
    ThroughCells,
    resultants_of_frames,
    section_arrays,
    shear_under,
    strains_at_ends,
    through_cells,
)
from rodjax.discretization.layout import from_held
from rodjax.discretization.rest_correction import RestCorrection
from rodjax.geometry.rotations import columns, inverse, product, rotated, tangent, unit
from rodjax.geometry.vectors import cross, dot
from rodjax.linalg.blocks import short_sum
from rodjax.model.scene import slides


class Pose(eqx.Module):
    """What is integrated along each element: way from its first node, frame, and section moment, global axes."""

    way: Float[Array, "3 n"]
    quaternion: Float[Array, "4 n"]
    moment: Float[Array, "3 n"]


def errors_of_frames(form: FrameForm, point: FramePoint, axis: Float[Array, "3"]) -> Errors:
    """As `error.errors_of_elements`: what the elements lack enters as strains, couples and segment vectors at rest."""
    field, q = form.field, point.quaternions
    if not isinstance(field, ElementCells):
        return _errors_of_joints(form, point, axis)
    through = through_cells(form, point)
    ends = through.end_moments
    moments = ends[:, 0]
    if not (form.scene.clips or form.scene.point_couples):
        moments = jnp.concatenate([moments[:, :1], ends[:, 1, :-1]], axis=1)
    nodes = field.at_nodes(q)
    first = Pose(jnp.zeros_like(moments), nodes[:, :-1], moments)
    last = _integrated(form, field, point, through, first)

    turn = product(last.quaternion, inverse(nodes[:, 1:]))
    turn = 2 * jnp.where(turn[0] < 0, -1.0, 1.0).astype(q.dtype)[None] * turn[1:]  # small
    edges = form.edges(point).T
    middles = q[:, 1::2]
    force = through.forces[:, 1]
    gap = last.way - edges - field.h[None] / 2 * cross(turn, tangent(middles))
    couple = last.moment - ends[:, 1] + cross(last.way - edges, force)

    strains = jnp.broadcast_to((rotated(inverse(middles), turn) / field.h[None])[:, None], form.loads.shape)
    corrections = rotated(inverse(middles), gap)
    rest_strains = jnp.zeros_like(strains) if form.rest_strains is None else form.rest_strains
    rest_correction = (
        RestCorrection(jnp.zeros_like(corrections), None) if form.rest_correction is None else form.rest_correction
    )

    def lacking(amount: Float[Array, ""] | float) -> FrameForm:
        more = rest_correction._replace(turning=rest_correction.turning + amount * corrections)
        values = rest_strains + amount * strains, more
        return eqx.tree_at(
            lambda form: (form.rest_strains, form.rest_correction), form, values, is_leaf=lambda x: x is None
        )

    zero, one = jnp.zeros((), q.dtype), jnp.ones((), q.dtype)
    _, (gradient, constraint_residual) = jax.jvp(
        lambda amount: lacking(amount).residual_vectors(point), (zero,), (one,)
    )
    gradient += jnp.zeros_like(gradient).at[:, 2::2].set(rotated(inverse(nodes[:, 1:]), couple)) * form.is_free
    here = form.linearized(point)
    motion, is_soft = correction(form, point, here, gradient, constraint_residual, axis)
    change = form.layout.forces(form.force_components(motion.multipliers))

    def reached(amount: Float[Array, ""]) -> Float[Array, "3 n"]:
        there = form.retract(point, here.bases, amount * motion.rotation, amount * change)
        return lacking(amount).edges(there).T

    _, way_changes = jax.jvp(reached, (zero,), (one,))
    sums = jnp.concatenate([jnp.zeros_like(way_changes[:, :1]), jnp.cumsum(way_changes, axis=1)], axis=1)
    displacements = from_held(form.scene, form.clip_nodes, sums)
    sizes = [jnp.sqrt(dot(defect, defect)) for defect in (gap, turn, couple)]

    # A difference, as a derivative of these would be a third one of the energy.
    there = form.retract(point, here.bases, motion.rotation, change)
    before = through.forces, ends, strains_at_ends(form, point, through.forces, ends)[0][:2]
    forces, moments = through_cells(form, there).forces, through_cells(lacking(1.0), there).end_moments
    moments = moments.at[:, 1].add(couple)
    after = forces, moments, strains_at_ends(form, there, forces, moments)[0][:2]
    changes = jax.tree.map(jnp.subtract, after, before)
    relative, scale = of_sections(*before, changes, has_clips=bool(form.scene.clips))
    defects = sizes[0] + sizes[1] / TURN_REACH + sizes[2] / COUPLE_REACH
    axial = form.axial_forces(there) - form.axial_forces(point) if slides(form.scene) else None
    return Errors(displacements.T, *relative, scale, is_soft, defects, axial)


def _integrated(form: FrameForm, field: ElementCells, point: FramePoint, through: ThroughCells, first: Pose) -> Pose:
    """The sections at the ends of the elements, by the rule of Runge and Kutta."""
    h = field.h
    # Between the three points of an element, all along the rod that varies is a parabola; so are forces, but for those
    # at one place.
    forces, point_forces = through.forces, None if through.fields is None else through.fields.points
    sections = form.sections
    rest = form.scene.rod.rest_shape
    couples = form.couples_along(point.quaternions)
    if couples is not None:
        couples = rotated(field.gather(point.quaternions), couples) / field.lengths[None]

    def parabola(x: Float[Array, ""], by_point: Float[Array, "... 3 n"]) -> Float[Array, "... n"]:
        weights = ((1 - x) * (1 - 2 * x), 4 * x * (1 - x), x * (2 * x - 1))
        return sum(
            (weight * by_point[..., k, :] for k, weight in enumerate(weights)), jnp.zeros_like(by_point[..., 0, :])
        )

    def slope(pose: Pose, k: Float[Array, ""], part: float) -> Pose:
        q, x = unit(pose.quaternion), (k + part) / STEPS
        t = tangent(q)
        force = parabola(x, forces)
        if point_forces is not None:
            force += point_forces.beyond_parabola(x, k / STEPS, STEPS)
        here = jax.tree.map(lambda leaf: parabola(x, leaf), section_arrays(sections))
        here = eqx.combine(here, sections)
        strains, axial = here.strains_under(rotated(inverse(q), pose.moment), dot(force, t))
        shear = shear_under(here, q, force)
        if rest is not None:
            strains += rest.at(field.s[:-1] + x * h, field.s[:-1], field.s[1:])
        rate = product(q, jnp.concatenate([jnp.zeros_like(t[:1]), strains])) / 2
        way = (1 + here.stretched(axial))[None] * t
        if shear is not None:
            way += short_sum(columns(q)[:, :2] * shear[None], axis=1)
        moment = -cross(way, force)
        if couples is not None:
            moment -= parabola(x, couples)
        return Pose(way, rate, moment)

    def ahead(pose: Pose, slope: Pose, part: float) -> Pose:
        return jax.tree.map(lambda value, change: value + (part * h / STEPS)[None] * change, pose, slope)

    def advanced(pose: Pose, k: Float[Array, ""]) -> tuple[Pose, None]:
        a = slope(pose, k, 0.0)
        b = slope(ahead(pose, a, 0.5), k, 0.5)
        c = slope(ahead(pose, b, 0.5), k, 0.5)
        d = slope(ahead(pose, c, 1.0), k, 1.0)
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, a, b, c, d)
        return ahead(pose, mean, 1.0), None

    last, _ = jax.lax.scan(advanced, first, jnp.arange(STEPS, dtype=h.dtype))
    return last


def framed_on_elements(form: FrameForm, point: FramePoint) -> tuple[FrameForm, FramePoint]:
    """A rod by finite differences on elements between the same nodes."""
    if isinstance(form.field, ElementCells):
        return form, point
    nodes = form.field.at_nodes(point.quaternions)
    q = jnp.stack([nodes[:, :-1], point.quaternions[:, 1:-1]], axis=2).reshape(4, -1)
    begin = FramePoint(jnp.concatenate([q, nodes[:, -1:]], axis=1), point.end_force, point.total_twist)
    return FrameForm.of(form.scene, ElementCells(form.field.s)), begin


def _errors_of_joints(form: FrameForm, point: FramePoint, axis: Float[Array, "3"]) -> Errors:
    """The way to the elements between the same nodes by one step of Newton's method."""
    elements, begin = framed_on_elements(form, point)
    here = elements.linearized(begin)
    motion, is_soft = correction(elements, begin, here, here.gradient, here.constraint_residual, axis)
    change = elements.layout.forces(elements.force_components(motion.multipliers))
    end = elements.retract(begin, here.bases, motion.rotation, change)
    found, better = resultants_of_frames(form, point), resultants_of_frames(elements, end)
    moments = [better.start_moment - found.start_moment, better.end_moment - found.end_moment]
    curvature = jnp.max(jnp.abs(better.curvature - found.curvature))
    forces = elements.forces(end.quaternions, end.end_force)
    end_changes = [
        after - before
        for after, before in zip(elements.end_forces(end, None), form.end_forces(point, None), strict=True)
    ]
    error = Sizes(longest(jnp.stack(end_changes, axis=1)), longest(jnp.stack(moments, axis=1)), curvature)
    scale = Sizes(
        longest(forces), longest(through_cells(elements, end).end_moments), jnp.max(better.curvature)
    ).as_scale()
    return Errors(
        elements.nodes(elements.edges(end)) - form.nodes(form.edges(point)),
        *error.relative_to(scale),
        scale,
        is_soft,
        None,
    )
