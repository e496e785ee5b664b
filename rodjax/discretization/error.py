"""How far an equilibrium is from the continuum.

On Hermite elements: an estimate from their own defects. Between two nodes the rod's differential equations are
integrated from what the nodes say (tangent, moment, force). What they miss the next node by is the defect of the
element, of fifth order. Put into the linearised discrete equations as rotations, couples and gaps that the elements
lack, the defects give the error of the nodes to leading order: one more solution of the system of a Newton step. No
second mesh is needed, and no neighbours, so that jumps of curvature or mesh do no harm.

By finite differences: the way to the elements between the same nodes, whose error is of fourth order, by one step of
Newton's method.

The same solution changes forces, moments and curvatures: so much are these off.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.element_points import interleaved
from rodjax.discretization.form import Form, Linearization, Point
from rodjax.discretization.hermite import QuadraticRotationElements
from rodjax.discretization.layout import from_held
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.motion import Motion, turn_about
from rodjax.discretization.potentials import OnElements
from rodjax.discretization.results import clip_moments, resultants, with_fields_by_tangent
from rodjax.discretization.twist import transport
from rodjax.geometry.vectors import components, cross, dot, root
from rodjax.linalg.blocks import partial_sums, short_sum
from rodjax.linalg.saddle_point import factor_and_solve
from rodjax.mechanics.energy import axial_strain_under, bending_moment_at, curvature_under, torque_at
from rodjax.mechanics.strain import swept_angle
from rodjax.model.scene import slides

# Steps of the integration of an element: an even number.
STEPS = 4
# A rotation that an element lacks displaces the rod by about a fourth of itself, times L; a couple bends it a third of
# that.
TURN_REACH = 4.0
COUPLE_REACH = 12.0
# Errors of forces and moments are relative to the largest one in the rod, at least to these [EI/L^2], [EI/L]: of what
# vanishes no part can be told. Of curvatures [1/L] as of moments.
LEAST_FORCE = 1.0
LEAST_MOMENT = 0.1
# A correction of less stiffness [EI/L^2 per rad and length] than this may be mostly a turn that nothing resists; the
# softest motion of a clamped rod has pi^2.
SOFT = 1.0


class Section(NamedTuple):
    """What is integrated along each element: way from its first node, tangent, and moment without torque."""

    way: Float[Array, "3 n"]
    tangent: Float[Array, "3 n"]
    moment: Float[Array, "3 n"]


class Errors(NamedTuple):
    """`nodes`: from those of an equilibrium to where the continuum has them, in units of L; `force`, `moment` and
    `curvature`: the largest errors of these, relative to `scale`, the largest of each in the rod; `is_soft`: as of
    `correction`; `defects` of the elements, as the displacement that each alone might make, `None` where there are
    none; `axial`: of the forces by which clips pull along a rod that slides through them, `None` without such;
    `depths`: how deep each element lies within obstacles, by the radius, and `misplaced`: the error of moments, also
    relative, that contacts make by lying beside their nodes, `None` without such.
    """

    nodes: Float[Array, "n+1 3"]
    force: Float[Array, ""]
    moment: Float[Array, ""]
    curvature: Float[Array, ""]
    scale: "Sizes"
    is_soft: Bool[Array, ""]
    defects: Float[Array, "n"] | None
    axial: Float[Array, "slides"] | None = None
    depths: Float[Array, "n"] | None = None
    misplaced: Float[Array, ""] | None = None


class Sizes(NamedTuple):
    """The largest force, moment and curvature along a rod, or the largest errors of them; nondimensional."""

    force: Float[Array, ""]
    moment: Float[Array, ""]
    curvature: Float[Array, ""]

    def as_scale(self) -> "Sizes":
        """The same, and no less than what errors are relative to where all of a rod has less."""
        least = (LEAST_FORCE, LEAST_MOMENT, LEAST_MOMENT)
        return Sizes(*(jnp.maximum(size, low) for size, low in zip(self, least, strict=True)))

    def relative_to(self, scale: "Sizes") -> "Sizes":
        return Sizes(*(error / size for error, size in zip(self, scale, strict=True)))


def longest(vectors: Float[Array, "3 *k"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.max(dot(vectors, vectors), initial=0.0))


def of_sections(
    forces: Float[Array, "3 k n"],
    moments: Float[Array, "3 2 n"],
    curvatures: Float[Array, "c 2 n"],
    changes: tuple[Float[Array, "3 k n"], Float[Array, "3 2 n"], Float[Array, "c 2 n"]],
    *,
    has_clips: bool,
) -> tuple[Sizes, Sizes]:
    """The relative errors, and their scale: of the forces in elements, and of moments and curvatures (components across
    the rod) at both ends of each, from what they change by; with clips also of what these apply, the jumps of forces
    and moments.
    """
    force_change, moment_change, curvature_change = changes
    bends = root(dot(curvatures, curvatures))
    better = curvatures + curvature_change
    error = Sizes(longest(force_change), longest(moment_change), jnp.max(jnp.abs(root(dot(better, better)) - bends)))
    if has_clips:
        force = longest(force_change[:, -1, :-1] - force_change[:, 0, 1:])
        moment = longest(moment_change[:, 1, :-1] - moment_change[:, 0, 1:])
        error = Sizes(jnp.maximum(error.force, force), jnp.maximum(error.moment, moment), error.curvature)
    scale = Sizes(longest(forces), longest(moments), jnp.max(bends)).as_scale()
    return error.relative_to(scale), scale


def correction(
    form: Form,
    point: Point,
    here: Linearization,
    gradient: Float[Array, "b m"],
    constraint_residual: Float[Array, "k"],
    axis: Float[Array, "3"],
) -> tuple[Motion, Bool[Array, ""]]:
    """The motion that cancels a gradient and a constraint residual to leading order, and whether it is so
    soft that it may be a turn of the whole rod which nothing resists: however small the moment about its axis, the
    regular system lets it turn the rod far. The turn about the given axis, zero for none, is taken out.
    """
    motion = Motion(*factor_and_solve(form.regular(here.system), -gradient, -constraint_residual)[1:])
    if not form.has_potential:
        return motion, jnp.array(False)
    points = motion.rotation.shape[1]
    work = jnp.abs(jnp.sum(motion.rotation * gradient)) * points
    is_soft = work < SOFT * jnp.sum(motion.rotation**2)
    return motion.without(turn_about(form, point, here, axis)), is_soft


def on_elements(form: MixedForm, point: MixedPoint, at_nodes: Float[Array, "3 n+1"]) -> tuple[MixedForm, MixedPoint]:
    """A polyline with these tangents at its nodes on elements, whose middles have those of its edges."""
    elements = MixedForm.of(form.scene, QuadraticRotationElements(form.field.s, form.field.clip_nodes))
    tangents = interleaved(at_nodes, point.tangents)
    return elements, MixedPoint(tangents, point.end_force, elements.twist_near(tangents, point.total_twist))


def errors_of_differences(
    form: MixedForm,
    point: MixedPoint,
    nodes: Float[Array, "n+1 3"],
    at_nodes: Float[Array, "3 n+1"],
    axis: Float[Array, "3"],
) -> Errors:
    """Of a polyline with these nodes, and tangents there; without what turns it about an axis (see `correction`)."""
    scene = form.scene
    elements, begin = on_elements(form, point, at_nodes)
    here = elements.linearized(begin)
    motion, is_soft = correction(elements, begin, here, here.gradient, here.constraint_residual, axis)
    change = elements.layout.forces(elements.force_components(motion.multipliers))
    end = elements.retract(begin, here.bases, motion.rotation, change)
    found, better = resultants(form, point), resultants(elements, end)
    curvature = jnp.max(jnp.abs(better.curvature - found.curvature))
    moments = [better.start_moment - found.start_moment, better.end_moment - found.end_moment]
    if scene.clips:
        moments += list(clip_moments(elements, end) - clip_moments(form, point))
    error = Sizes(longest(_with_jumps(change)), longest(jnp.stack(moments, axis=1)), curvature)
    forces = elements.forces(end)
    curvature = jnp.max(better.curvature)
    moment = bending_moment_at(scene.rod, curvature), torque_at(scene.rod, end.total_twist)
    scale = Sizes(longest(forces), jnp.sqrt(moment[0] ** 2 + moment[1] ** 2), curvature).as_scale()
    shift = elements.nodes(elements.edges(end)) - nodes
    return Errors(shift, *error.relative_to(scale), scale, is_soft, None, _axial_error(elements, form, end, point))


def errors_of_elements(form: MixedForm, point: MixedPoint, axis: Float[Array, "3"]) -> Errors:
    field, scene, tangents = form.field, form.scene, point.tangents
    assert isinstance(field, QuadraticRotationElements)
    rod, h = scene.rod, field.h
    torque = torque_at(rod, point.total_twist)
    nodes, middles = tangents[:, ::2], tangents[:, 1::2]

    def forces_of(end_force: Float[Array, "3 parts"]) -> Float[Array, "3 3 n"]:
        return form.forces(MixedPoint(tangents, end_force, torque))

    def turned_about(ends: Float[Array, "3 2 n"], by_ends: tuple[Array, Array]) -> Float[Array, "3 2 n"]:
        """The moments of what turns the tangents at both ends of the elements."""
        return cross(ends, jnp.stack([-by_ends[0], by_ends[1]], axis=1))

    def at_ends(by_point: Float[Array, "3 m"]) -> Float[Array, "3 2 n"]:
        return jnp.stack([by_point[:, 0:-1:2], by_point[:, 2::2]], axis=1)

    ends = at_ends(tangents)
    through = forces_of(point.end_force)
    by_ends, further = field.by_end_tangents_linearized(scene, tangents, through[:, ::2], torque)
    fields = form.fields_on_elements(point)
    by_ends = with_fields_by_tangent(fields, by_ends)
    forces = form.with_fields(through, fields)
    bending_moments = turned_about(ends, by_ends)
    moments = jnp.concatenate([bending_moments[:, 0, :1], bending_moments[:, 1]], axis=1)
    # In a clip that holds the tangent the moment jumps.
    before = bending_moments[:, 0] if scene.clips else moments[:, :-1]
    first = Section(jnp.zeros_like(middles), nodes[:, :-1], before)
    last, passed = _integrated(form, field, forces, torque, first, fields)

    # What the elements lack: a rotation, and on the way that is turned back by it to the next node a couple, a gap and
    # a twist.
    turn = cross(nodes[:, 1:], last.tangent)
    back = -cross(turn, middles)
    passed = [tangent + k / STEPS * -cross(turn, tangent) for k, tangent in enumerate(passed)]
    force = forces[:, 1]
    couple = last.moment - moments[:, 1:]
    gap = last.way + h[None] / 2 * back - form.edges(point).T

    here = form.linearized(point)
    # To turn it back takes moments at both ends, which differ as force and torque go with the tangent.
    shear = h[None] / 6 * cross(back, force)
    turned_back = transport(turn, nodes[:, 1:], nodes[:, :-1])
    at_start = bending_moment_at(rod, turned_back / h[None]) - torque / 2 * back - shear
    at_end = couple - bending_moment_at(rod, turn / h[None]) - torque / 2 * back - 2 * shear
    none = jnp.zeros_like(couple[:, :1])
    couples = jnp.concatenate([none, at_end], axis=1) + jnp.concatenate([at_start, none], axis=1)
    by_rotation = -cross(nodes, couples)  # a displacement of the tangent along e turns it about t x e
    gradient = jnp.zeros_like(here.gradient).at[:, ::2].set(components(here.bases[..., ::2], by_rotation))
    constraint_residual = -form.layout.components(form.layout.sums(gap))
    if form.has_torsion:
        missing = jnp.sum(bulge(passed) - bulge([nodes[:, :-1], middles, nodes[:, 1:]]))
        # What pushes at the nodes has no residual.
        between = jnp.zeros(len(here.constraint_residual) - len(constraint_residual) - 1, constraint_residual.dtype)
        constraint_residual = jnp.concatenate(
            [missing[None], *([between] if len(between) else []), constraint_residual]
        )
    elif len(here.constraint_residual) > len(constraint_residual):
        constraint_residual = jnp.concatenate(
            [
                jnp.zeros(len(here.constraint_residual) - len(constraint_residual), constraint_residual.dtype),
                constraint_residual,
            ]
        )
    motion, is_soft = correction(form, point, here, gradient, constraint_residual, axis)

    force_change = form.layout.forces(form.force_components(motion.multipliers))
    turned = short_sum(here.bases * motion.rotation[None], axis=1)
    end_force = point.end_force + force_change
    segment_vectors, change = jax.jvp(
        lambda tangents: form.edges(MixedPoint(tangents, end_force, point.total_twist)), (tangents,), (turned,)
    )
    segment_vectors = (segment_vectors + change - form.edges(point)).T + gap
    sums = partial_sums(segment_vectors)
    displacements = from_held(scene, form.clip_nodes, sums)
    sizes = [jnp.sqrt(dot(defect, defect)) for defect in (gap, turn, couple)]
    retracted = form.retract(point, here.bases, motion.rotation, force_change)
    axial = _axial_error(form, form, retracted, point)

    # The first multiplier is the torque, where there is one.
    torque_change = motion.multipliers[0] if form.has_torsion or not form.has_potential else jnp.zeros_like(torque)
    section_change = jnp.broadcast_to(forces_of(end_force) - through, forces.shape)
    turned_ends = at_ends(turned)
    bending_change = turned_about(turned_ends, by_ends) + jnp.stack([-at_start, at_end], axis=1)
    bending_change += turned_about(ends, further(turned, section_change[:, ::2], torque_change))
    relative, scale = of_sections(
        forces,
        bending_moments + torque * ends,
        curvature_under(rod, bending_moments),
        (
            section_change,
            bending_change + torque_change * ends + torque * turned_ends,
            curvature_under(rod, bending_change),
        ),
        has_clips=bool(scene.clips),
    )
    defects = sizes[0] + sizes[1] / TURN_REACH + sizes[2] / COUPLE_REACH
    return Errors(displacements.T, *relative, scale, is_soft, defects, axial)


def _with_jumps(spans: Float[Array, "3 parts"]) -> Float[Array, "3 k"]:
    """The forces in the spans, and those of the clips between them."""
    return jnp.concatenate([spans, spans[:, 1:] - spans[:, :-1]], axis=1)


def _axial_error(
    form: MixedForm, other: MixedForm, point: MixedPoint, other_point: MixedPoint
) -> Float[Array, "slides"] | None:
    if not slides(form.scene):
        return None
    return form.axial_forces(point) - other.axial_forces(other_point)


def _integrated(
    form: MixedForm,
    field: QuadraticRotationElements,
    forces: Float[Array, "3 3 n"],
    torque: Float[Array, ""],
    first: Section,
    fields: OnElements | None,
) -> tuple[Section, list[Float[Array, "3 n"]]]:
    """The sections at the ends of the elements, and the tangents passed on the way; by the rule of Runge and Kutta.
    `forces`: with fields parabolas, but for those at one place, else those at the start less the weight.
    """
    scene, rod = form.scene, form.scene.rod
    start, middle, end = (forces[:, k] for k in range(3))
    weight = jnp.zeros(3, start.dtype) if scene.gravity is None else scene.gravity
    step = field.h / STEPS

    def slope(section: Section, k: Float[Array, ""], part: float) -> Section:
        """Derivatives by arclength, at so much of step k."""
        n = start - weight[:, None] * ((k + part) * step)[None]
        if fields is not None:
            x = (k + part) / STEPS
            n = start + x * (4 * middle - 3 * start - end + x * (2 * (start + end) - 4 * middle))
            if fields.points is not None:
                n += fields.points.beyond_parabola(x, k / STEPS, STEPS)
        tangent = section.tangent / jnp.sqrt(dot(section.tangent, section.tangent))[None]
        way = (1 + axial_strain_under(rod, dot(n, tangent)))[None] * tangent
        turn = cross(curvature_under(rod, section.moment), tangent)
        return Section(way, turn, -cross(way, n) - torque * turn)

    def ahead(section: Section, slope: Section, distance: Float[Array, "n"]) -> Section:
        return jax.tree.map(lambda value, change: value + distance[None] * change, section, slope)

    def advanced(section: Section, k: Float[Array, ""]) -> tuple[Section, Float[Array, "3 n"]]:
        a = slope(section, k, 0.0)
        b = slope(ahead(section, a, step / 2), k, 0.5)
        c = slope(ahead(section, b, step / 2), k, 0.5)
        d = slope(ahead(section, c, step), k, 1.0)
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, a, b, c, d)
        section = ahead(section, mean, step)
        return section, section.tangent / jnp.sqrt(dot(section.tangent, section.tangent))[None]

    last, passed = jax.lax.scan(advanced, first, jnp.arange(STEPS, dtype=step.dtype))
    return last, [first.tangent, *passed]


def bulge(tangents: list[Float[Array, "3 n"]]) -> Float[Array, "n"]:
    """By how much the twist of a curve through these tangents exceeds that of the arc from the first to the last."""
    whole, half = _fan(tangents), _fan(tangents[::2])
    return (4 * whole - half) / 3


def _fan(tangents: list[Float[Array, "3 n"]]) -> Float[Array, "n"]:
    first = tangents[0]
    parts = [swept_angle(b, c, first, c) for b, c in itertools.pairwise(tangents[1:])]
    return sum(parts, jnp.zeros_like(first[0]))
