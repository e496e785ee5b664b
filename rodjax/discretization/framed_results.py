"""Resultants and strains of an equilibrium by frames, at its nodes and ends, and its centerline between them."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.discretization.cells import ElementCells, JointCells, strains_between
from rodjax.discretization.frame_point import FramePoint
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.nonconservative import point_couples
from rodjax.discretization.potentials import OnElements
from rodjax.discretization.results import Resultants
from rodjax.geometry.interpolation import cubic
from rodjax.geometry.rotations import by_rotation_vector, columns, inverse, product, rotated, tangent
from rodjax.geometry.vectors import cross, dot, root
from rodjax.linalg.blocks import short_sum
from rodjax.mechanics.energy import Sections
from rodjax.model.supports import Directed, Free
from rodjax.programs.parts import traced_once


class NodeStrains(eqx.Module):
    """At the nodes: section moment (global axes), curvature along d1 and d2, twist, axial strain and tension; with
    shear its strains.
    """

    moments: Float[Array, "3 n+1"]
    strains: Float[Array, "3 n+1"]
    axial: Float[Array, "n+1"]
    tension: Float[Array, "n+1"]
    shear: Float[Array, "2 n+1"] | None


def resultants_of_frames(form: FrameForm, point: FramePoint) -> Resultants:
    scene = form.scene
    is_joints = isinstance(form.field, JointCells)
    through = through_cells(form, point)
    at_nodes = _on_joints(form, point, through) if is_joints else _on_elements(form, point, through)
    frames = columns(form.field.at_nodes(point.quaternions))
    forces = form.end_forces(point, through.fields)
    moments = [
        _end_moment(end, frames[..., k], at_nodes.moments[:, k], sign)
        for end, k, sign in ((scene.start, 0, -1), (scene.end, -1, 1))
    ]
    return Resultants(
        frames=jnp.moveaxis(frames, 2, 0),
        curvature=root(dot(at_nodes.strains[:2], at_nodes.strains[:2])),
        twist=at_nodes.strains[2],
        tension=at_nodes.tension,
        axial_strain=at_nodes.axial,
        start_force=forces[0],
        start_moment=moments[0],
        end_force=forces[1],
        end_moment=moments[1],
        shear_strain=None if at_nodes.shear is None else at_nodes.shear.T,
    )


def _end_moment(end, frame: Float[Array, "3 3"], held: Float[Array, "3"], sign: int) -> Float[Array, "3"]:
    """The section moment at an end: that which holds it, or the given one."""
    if isinstance(end, Free):
        given = jnp.zeros_like(held) if end.moment is None else end.moment
        return sign * (frame @ given if end.follower else given)
    if isinstance(end, Directed):
        return held
    return jnp.zeros_like(held)


class ThroughCells(NamedTuple):
    """At the strain points of cells, global axes: forces through the rod; moments by frames, at the last one the
    section moment, at the first the reverse; the fields that these are with.
    """

    forces: Float[Array, "3 p n"]
    moments: Float[Array, "3 p n"]
    fields: OnElements | None

    @property
    def end_moments(self) -> Float[Array, "3 2 n"]:
        """The section moments at both ends of each element, on its side of the node."""
        return jnp.stack([-self.moments[:, 0], self.moments[:, 2]], axis=1)


@traced_once
def through_cells(form: FrameForm, point: FramePoint) -> ThroughCells:
    q = point.quaternions
    by_cells = form.by_rotations(q, point.end_force)
    couples = form.couples_along(q)
    if couples is not None:
        by_cells -= couples
    moments, fields = rotated(form.field.gather(q), by_cells), form.fields_on_elements(point)
    if fields is not None:
        ends = tangent(form.field.gather(q)[:, ::2])
        moments = moments.at[:, ::2].add(cross(ends, fields.by_tangent))
    return ThroughCells(form.with_fields(form.forces(q, point.end_force), fields), moments, fields)


def _on_elements(form: FrameForm, point: FramePoint, through: ThroughCells) -> NodeStrains:
    """Moments are the derivatives of the element beside by the frame of a node: of fourth order too. At a clip or a
    couple they may jump, and are those beyond it.
    """
    field, own = form.field, through.moments
    if form.scene.point_couples:
        moments = jnp.concatenate([-own[:, 0], own[:, 2, -1:]], axis=1)
    else:
        moments = jnp.concatenate([-own[:, 0, :1], own[:, 2]], axis=1)
    if form.clip_nodes is not None:
        moments = moments.at[:, form.clip_nodes].set(-own[:, 0, form.clip_nodes])
    q = field.at_nodes(point.quaternions)
    first, last = through.forces[:, 0], through.forces[:, 2]
    # On the side of the element beyond, at the end of the one before.
    beyond = jnp.concatenate([first, last[:, -1:]], axis=1)
    tension = dot(beyond, tangent(q))
    a, b = field.s[:-1], field.s[1:]
    sections = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf[..., 0, :], leaf[..., 2, -1:]], axis=-1), section_arrays(form.sections)
    )
    sections = eqx.combine(sections, form.sections)
    strains, axial = sections.strains_under(rotated(inverse(q), moments), tension)
    rest = form.scene.rod.rest_shape
    if rest is not None:
        last_cell = jnp.concatenate([a, a[-1:]]), jnp.concatenate([b, b[-1:]])
        strains += rest.at(field.s, *last_cell)
    mean = jnp.concatenate([first[:, :1], (first[:, 1:] + last[:, :-1]) / 2, last[:, -1:]], axis=1)
    shear = shear_under(sections, q, beyond)
    return NodeStrains(moments, strains, sections.stretched(axial), dot(mean, tangent(q)), shear)


def shear_under(
    sections: Sections, quaternions: Float[Array, "4 *k"], forces: Float[Array, "3 *k"]
) -> Float[Array, "2 *k"] | None:
    """Shear strains under forces in global axes; `None` where sections do not shear."""
    return None if sections.GA is None else sections.shear_under(rotated(inverse(quaternions), forces)[:2])


def strains_beside_nodes(
    form: FrameForm, point: FramePoint
) -> tuple[Float[Array, "2n"], Float[Array, "3 2n"], Float[Array, "2n"]]:
    """Arclengths of both ends of each element in turn, curvature along d1 and d2 and twist there, and axial strain."""
    through = through_cells(form, point)
    strains, axial = strains_at_ends(form, point, through.forces, through.end_moments)
    s = form.field.strain_arclengths[::2]
    return s.T.reshape(-1), jnp.moveaxis(strains, 1, 2).reshape(3, -1), axial.T.reshape(-1)


def strains_at_ends(
    form: FrameForm, point: FramePoint, forces: Float[Array, "3 3 n"], moments: Float[Array, "3 2 n"]
) -> tuple[Float[Array, "3 2 n"], Float[Array, "2 n"]]:
    """Curvature along d1 and d2 and twist at both ends of each element under these loads, and axial strain."""
    field = form.field
    q = field.gather(point.quaternions)[:, ::2]
    tension = dot(forces[:, ::2], tangent(q))
    sections = jax.tree.map(lambda leaf: leaf[..., ::2, :], section_arrays(form.sections))
    sections = eqx.combine(sections, form.sections)
    strains, axial = sections.strains_under(rotated(inverse(q), moments), tension)
    rest = form.scene.rod.rest_shape
    if rest is not None:
        s = field.strain_arclengths[::2]
        strains += rest.at(s, *(jnp.broadcast_to(end[None], s.shape) for end in (field.s[:-1], field.s[1:])))
    return strains, sections.stretched(axial)


def clip_moments_of_frames(form: FrameForm, point: FramePoint) -> Float[Array, "clips 3"]:
    """What the clips apply to the rod, nondimensional: the jumps of the section moment."""
    own, nodes = through_cells(form, point).moments, form.clip_nodes
    assert nodes is not None
    jumps = own[:, 2, nodes - 1] + own[:, 0, nodes]
    if form.scene.point_couples and isinstance(form.field, ElementCells):
        q = form.field.gather(point.quaternions)
        couples = point_couples(form.scene, form.field, q)
        assert couples is not None
        jumps -= rotated(q[:, 0], couples)[:, nodes]
    moments = []
    for k, clip in enumerate(form.scene.clips):
        moment = jnp.zeros_like(jumps[:, k])
        if clip.frame is not None:
            moment = jumps[:, k]
        elif clip.tangent is not None:
            moment = jumps[:, k] - jnp.sum(jumps[:, k] * clip.tangent) * clip.tangent
        moments.append(moment)
    return jnp.stack(moments)


def section_arrays(sections: Sections) -> Sections:
    """Without the law, whose numbers do not vary along the rod."""
    return eqx.tree_at(lambda sections: sections.law, sections, None, is_leaf=lambda x: x is None)


def _on_joints(form: FrameForm, point: FramePoint, through: ThroughCells) -> NodeStrains:
    """Of the joints at the inner nodes; at the ends by moment and force."""
    q, own = point.quaternions, through.moments
    moments = jnp.concatenate([-own[:, 0, :1], own[:, 1]], axis=1)
    ends = [
        _strains_at_end(form, point, moments[:, k], force, k)
        for k, force in zip((0, -1), form.end_forces(point, None), strict=True)
    ]
    here, strains = form.strained(point), strains_between(form.field, q)

    def between(start: Float[Array, "*c 1"], inner: Float[Array, "*c 2 n-1"], end: Float[Array, "*c 1"]) -> Array:
        return jnp.concatenate([start, (inner[..., 0, :] + inner[..., 1, :]) / 2, end], axis=-1)

    first, last = ends
    shear = None
    if here.shear is not None and first[3] is not None and last[3] is not None:
        shear = between(first[3], here.shear[..., 1:-1], last[3])
    return NodeStrains(
        moments,
        between(first[0], strains[..., 1:-1], last[0]),
        between(first[1], here.stretched[:, 1:-1], last[1]),
        between(first[2], here.tension[:, 1:-1], last[2]),
        shear,
    )


def _strains_at_end(
    form: FrameForm, point: FramePoint, moment: Float[Array, "3"], force: Float[Array, "3"], k: int
) -> tuple[Float[Array, "3 1"], Float[Array, "1"], Float[Array, "1"], Float[Array, "2 1"] | None]:
    """Strains, axial strain, tension and shear strains at the first or last node."""
    q = point.quaternions[:, k, None]
    sections = eqx.combine(
        jax.tree.map(lambda leaf: leaf[..., k, k, None], section_arrays(form.sections)), form.sections
    )
    tension = dot(force[:, None], tangent(q))
    strains, axial = sections.strains_under(rotated(inverse(q), moment[:, None]), tension)
    rest = form.scene.rod.rest_shape
    if rest is not None:
        s = form.field.s
        strains += rest.at(s[k, None], s[[0, -2][k], None], s[[1, -1][k], None])
    return strains, sections.stretched(axial), tension, shear_under(sections, q, force[:, None])


# Ways from the first node of an element, by its length and the slopes at its quarters: integrals of the polynomial
# through these, by the powers of the part of the element from 1 on.
QUARTERS = np.arange(5) / 4
WAYS = np.linalg.inv(np.vander(QUARTERS, increasing=True)).T / np.arange(1, 6)


def positions_between_frames(
    form: FrameForm, point: FramePoint, nodes: Float[Array, "n+1 3"], s: Float[Array, "k"]
) -> Float[Array, "k 3"]:
    """The centerline at arclengths between the nodes: of elements a polynomial of fifth degree by the slopes at their
    quarters, where the frames turn as their strains say; of joints cubics through positions and slopes.
    """
    field, q = form.field, point.quaternions
    slopes = form.strained(point).slopes
    if not isinstance(field, ElementCells):
        frames = field.at_nodes(q)
        t = tangent(frames)
        if form.sections.GA is not None:
            at_nodes = _on_joints(form, point, through_cells(form, point))
            assert at_nodes.shear is not None
            t = (1 + at_nodes.axial)[None] * t + short_sum(columns(frames)[:, :2] * at_nodes.shear[None], axis=1)
        return cubic(field.s, nodes, t.T, s)
    early, late = jnp.unstack(_slopes_at_quarters(field, field.gather(q), slopes), axis=1)
    start, middle, end = jnp.unstack(slopes, axis=1)
    at_quarters = jnp.stack([start, early, middle, late, end])
    # The node beyond is where the elements' own quadrature and rest shape say.
    missing = jnp.diff(nodes, axis=0).T - field.h[None] * jnp.tensordot(WAYS.sum(1).astype(s.dtype), at_quarters, 1)
    cell = jnp.clip(jnp.searchsorted(field.s, s, side="right") - 1, 0, len(field.h) - 1)
    h = field.h[cell]
    x = (s - field.s[cell]) / h
    powers = jnp.stack([x**k for k in range(1, 6)])
    weights = h[None] * jnp.tensordot(WAYS.astype(s.dtype), powers, 1)
    ways = jnp.sum(weights[:, None] * at_quarters[:, :, cell], axis=0) + (x**2 * (3 - 2 * x))[None] * missing[:, cell]
    return nodes[cell] + ways.T


def _slopes_at_quarters(
    field: ElementCells, frames: Float[Array, "4 3 n"], slopes: Float[Array, "3 3 n"]
) -> Float[Array, "3 2 n"]:
    """Of elements a quarter before and beyond the middle: parabolas in the axes of the frames, which turn from the
    middle by rotation vectors that are parabolas too.
    """
    own = rotated(inverse(frames), slopes)
    start, middle, end = own[:, :1], own[:, 1:2], own[:, 2:]
    own = jnp.concatenate([3 * start - end, 3 * end - start], axis=1) / 8 + 3 * middle / 4
    vectors = field.strains(field.seen(frames)[field.coordinates]).vectors
    turns = (3 * vectors - vectors[:, ::-1]) / 8
    return rotated(product(jnp.broadcast_to(frames[:, 1:2], (4, *turns.shape[1:])), by_rotation_vector(turns)), own)
