"""How far an equilibrium is from the continuum.

On Hermite elements: an estimate from their own defects. Between two nodes the rod's differential equations are
integrated from what the nodes say (tangent, moment, force). What they miss the next node by is the defect of the
element, of fifth order. Put into the linearised discrete equations as rotations, couples and gaps that the elements
lack, the defects give the error of the nodes to leading order: one more solution of the system of a Newton step. No
second mesh is needed, and no neighbours, so that jumps of curvature or mesh do no harm.

By finite differences: the way to the elements between the same nodes, whose error is of fourth order, by one step of
Newton's method.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.clipped import ClippedForm
from rodjax.discretization.hermite import HermiteElements, interleaved
from rodjax.discretization.mixed import MixedForm, MixedPoint
from rodjax.discretization.results import positions_between
from rodjax.discretization.touching import TouchingForm
from rodjax.discretization.twist import transport
from rodjax.energy import axial_strain_under
from rodjax.linalg import factor_and_solve, short_sum
from rodjax.scene import slides
from rodjax.strain import swept_angle
from rodjax.supports import Held
from rodjax.vectors import components, cross, dot, root

# Steps of the integration of an element: an even number.
STEPS = 4
# A rotation that an element lacks displaces the rod by about a fourth of itself, times L; a couple bends it a third of
# that.
TURN_REACH = 4.0
COUPLE_REACH = 12.0
# A force F that acts half an element aside of its place bends the rod as a moment of F h/8 on an element does, and
# displaces it by about half of that.
CONTACT_REACH = 16.0
# Where it is looked at how deep a rod lies within obstacles, as parts of elements.
DEPTH_PLACES = (0.25, 0.5, 0.75)


class Section(NamedTuple):
    """What is integrated along each element: way from its first node, tangent, and moment without torque."""

    way: Float[Array, "3 n"]
    tangent: Float[Array, "3 n"]
    moment: Float[Array, "3 n"]


class Errors(NamedTuple):
    """`nodes`: from those of an equilibrium to where the continuum has them, in units of L; `defects` of the elements,
    as the displacement that each alone might make, `None` where there are none; `axial`: of the forces by which clips
    pull along a rod that slides through them, `None` without such; `depths`: how deep each element lies within
    obstacles, by the radius, `None` without such.
    """

    nodes: Float[Array, "n+1 3"]
    defects: Float[Array, "n"] | None
    axial: Float[Array, "slides"] | None = None
    depths: Float[Array, "n"] | None = None


def errors_of_differences(
    form: MixedForm, point: MixedPoint, nodes: Float[Array, "n+1 3"], at_nodes: Float[Array, "3 n+1"]
) -> Errors:
    """Of a polyline with these nodes, and tangents there; those of its edges, of the `point`, are the middle ones."""
    scene, field = form.scene, HermiteElements(form.field.s, form.field.clip_nodes)
    elements = type(form).of(scene, field)
    tangents = interleaved(at_nodes, point.tangents)
    begin = MixedPoint(tangents, point.end_force, elements.twist_near(tangents, point.total_twist))
    here = elements.linearized(begin)
    _, rotation, multipliers = factor_and_solve(elements.regular(here.system), -here.gradient, -here.closure)
    end = elements.moved(begin, here.bases, rotation, elements.force_change(elements.closure(multipliers)))
    return Errors(elements.nodes(elements.edges(end)) - nodes, None, _axial_error(elements, form, end, point))


def errors_of_elements(form: MixedForm, point: MixedPoint) -> Errors:
    field, scene, tangents = form.field, form.scene, point.tangents
    assert isinstance(field, HermiteElements)
    rod, h = scene.rod, field.h
    torque = rod.GJ * point.total_twist
    nodes, middles = tangents[:, ::2], tangents[:, 1::2]
    section_forces = form.with_end_force(point, field.forces_in_elements(scene)[:, ::2])
    by_start, by_end = field.by_end_tangents(scene, tangents, section_forces, torque)
    moments = jnp.concatenate([-cross(nodes[:, :1], by_start[:, :1]), cross(nodes[:, 1:], by_end)], axis=1)
    # In a clip that holds the tangent the moment jumps.
    before = -cross(nodes[:, :-1], by_start) if scene.clips else moments[:, :-1]
    first = Section(jnp.zeros_like(middles), nodes[:, :-1], before)
    last, passed = _integrated(form, field, point, torque, first)

    # What the elements lack: a rotation, and on the way that is turned back by it to the next node a couple, a gap and
    # a twist.
    turn = cross(nodes[:, 1:], last.tangent)
    back = -cross(turn, middles)
    passed = [tangent + k / STEPS * -cross(turn, tangent) for k, tangent in enumerate(passed)]
    force = form.with_end_force(point, field.forces_in_elements(scene)[:, 1])
    couple = last.moment - moments[:, 1:]
    gap = last.way + h[None] / 2 * back - form.edges(point).T

    here = form.linearized(point)
    # To turn it back takes moments at both ends, which differ as force and torque go with the tangent.
    bending, shear = (rod.EI / h)[None], h[None] / 6 * cross(back, force)
    at_start = bending * transport(turn, nodes[:, 1:], nodes[:, :-1]) - torque / 2 * back - shear
    at_end = couple - bending * turn - torque / 2 * back - 2 * shear
    none = jnp.zeros_like(couple[:, :1])
    couples = jnp.concatenate([none, at_end], axis=1) + jnp.concatenate([at_start, none], axis=1)
    by_rotation = -cross(nodes, couples)  # a displacement of the tangent along e turns it about t x e
    gradient = jnp.zeros_like(here.gradient).at[:, ::2].set(components(here.bases[..., ::2], by_rotation))
    closure = -form.of_force(form.along_spans(gap))
    if form.has_torsion:
        missing = jnp.sum(_bulge(passed) - _bulge([nodes[:, :-1], middles, nodes[:, 1:]]))
        between = jnp.zeros(len(here.closure) - len(closure) - 1, closure.dtype)  # what pushes at the nodes
        closure = jnp.concatenate([missing[None], *([between] if len(between) else []), closure])
    elif len(here.closure) > len(closure):
        closure = jnp.concatenate([jnp.zeros(len(here.closure) - len(closure), closure.dtype), closure])
    _, rotation, multipliers = factor_and_solve(form.regular(here.system), -gradient, -closure)

    force_change = form.force_change(form.closure(multipliers))
    turned = short_sum(here.bases * rotation[None], axis=1)
    end_force = point.end_force + force_change
    ways, change = jax.jvp(
        lambda tangents: form.edges(MixedPoint(tangents, end_force, point.total_twist)), (tangents,), (turned,)
    )
    ways = (ways + change - form.edges(point)).T + gap
    sums = jnp.concatenate([jnp.zeros_like(ways[:, :1]), jnp.cumsum(ways, axis=1)], axis=1)
    displacements = sums if isinstance(scene.start, Held) else sums - sums[:, -1:]
    sizes = [jnp.sqrt(dot(defect, defect)) for defect in (gap, turn, couple)]
    moved = form.moved(point, here.bases, rotation, force_change)
    axial = _axial_error(form, form, moved, point)
    return Errors(displacements.T, sizes[0] + sizes[1] / TURN_REACH + sizes[2] / COUPLE_REACH, axial)


def with_contacts(errors: Errors, form: TouchingForm, point: MixedPoint) -> Errors:
    """With what it adds that contacts act at nodes: where one lies by itself, it may be anywhere beside its node.

    And how deep the rod lies between the nodes.
    """
    h = jnp.diff(form.field.s)
    forces = jnp.where(form.is_held[None], 0.0, form.at_nodes(point.end_force))
    beside = jnp.pad(forces, ((0, 0), (1, 1)))
    alone = forces - (beside[:, :-2] + beside[:, 2:]) / 2  # not the pressure of an obstacle along which the rod lies
    spacing = (jnp.append(h, h[-1]) + jnp.append(h[0], h)) / 2
    misplaced = alone * (spacing**2 / CONTACT_REACH)[None]
    sizes = root(dot(misplaced, misplaced))
    defects = errors.defects
    if defects is not None:
        defects = defects + (sizes[:-1] + sizes[1:]) / 2
    nodes = errors.nodes + misplaced[:, jnp.argmax(sizes)][None]
    return errors._replace(nodes=nodes, defects=defects, depths=depths_of_elements(form, point))


def depths_of_elements(form: TouchingForm, point: MixedPoint) -> Float[Array, "n"]:
    """How deep the rod lies within obstacles at the ends of each element and between them, by the radius; of an element
    beside a held place so much more than it is held there.
    """
    s, nodes = form.field.s, form.positions(form.edges(point))
    at_nodes = form.depths_at(nodes, form.radius)
    held = jnp.where(form.is_held, at_nodes, 0.0)
    parts = jnp.array(DEPTH_PLACES, s.dtype)
    places = s[:-1, None] + parts[None] * jnp.diff(s)[:, None]
    positions = positions_between(form, point, nodes, places.reshape(-1))
    between = form.depths_at(positions, form.radius_in_elements(parts).reshape(-1)).reshape(places.shape)
    at_ends = jnp.where(form.is_held, 0.0, at_nodes)
    depths = jnp.concatenate(
        [at_ends[:-1, None], at_ends[1:, None], between - held[:-1, None] - held[1:, None]], axis=1
    )
    return jnp.maximum(jnp.max(depths, axis=1), 0.0)


def _axial_error(
    form: MixedForm, other: MixedForm, point: MixedPoint, other_point: MixedPoint
) -> Float[Array, "slides"] | None:
    if not slides(form.scene):
        return None
    assert isinstance(form, ClippedForm)
    assert isinstance(other, ClippedForm)
    return form.axial_forces(point) - other.axial_forces(other_point)


def _integrated(
    form: MixedForm, field: HermiteElements, point: MixedPoint, torque: Float[Array, ""], first: Section
) -> tuple[Section, list[Float[Array, "3 n"]]]:
    """The sections at the ends of the elements, and the tangents passed on the way; by the rule of Runge and Kutta."""
    scene, rod = form.scene, form.scene.rod
    force = form.with_end_force(point, field.forces_in_elements(scene)[:, 0])
    weight = jnp.zeros(3, force.dtype) if scene.gravity is None else scene.gravity
    step = field.h / STEPS

    def slope(section: Section, s: Float[Array, "n"]) -> Section:
        """Derivatives by arclength, at s from the first node."""
        n = force - weight[:, None] * s[None]
        tangent = section.tangent / jnp.sqrt(dot(section.tangent, section.tangent))[None]
        way = (1 + axial_strain_under(rod, dot(n, tangent)))[None] * tangent
        turn = cross(section.moment, tangent) / rod.EI
        return Section(way, turn, -cross(way, n) - torque * turn)

    def ahead(section: Section, slope: Section, distance: Float[Array, "n"]) -> Section:
        return jax.tree.map(lambda value, change: value + distance[None] * change, section, slope)

    def advanced(section: Section, k: Float[Array, ""]) -> tuple[Section, Float[Array, "3 n"]]:
        s = k * step
        a = slope(section, s)
        b = slope(ahead(section, a, step / 2), s + step / 2)
        c = slope(ahead(section, b, step / 2), s + step / 2)
        d = slope(ahead(section, c, step), s + step)
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, a, b, c, d)
        section = ahead(section, mean, step)
        return section, section.tangent / jnp.sqrt(dot(section.tangent, section.tangent))[None]

    last, passed = jax.lax.scan(advanced, first, jnp.arange(STEPS, dtype=step.dtype))
    return last, [first.tangent, *passed]


def _bulge(tangents: list[Float[Array, "3 n"]]) -> Float[Array, "n"]:
    """By how much the twist of a curve through these tangents exceeds that of the arc from the first to the last."""
    whole, half = _fan(tangents), _fan(tangents[::2])
    return (4 * whole - half) / 3


def _fan(tangents: list[Float[Array, "3 n"]]) -> Float[Array, "n"]:
    swept = jax.vmap(swept_angle, in_axes=1)
    first = tangents[0]
    parts = [swept(b, c, first, c) for b, c in itertools.pairwise(tangents[1:])]
    return sum(parts, jnp.zeros_like(first[0]))
