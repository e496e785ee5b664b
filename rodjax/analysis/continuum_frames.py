"""The continuous rod where the angle of its sections about the tangent matters: the general case of `continuum`.

Anisotropic rods, rods that are not straight at rest, vary along their length or have a law of their own, and loads all
along the rod or that follow it. Between two stations

    phi' = (1 + e) t,  R' = R [kappa]x,  n' = -f,  m' = -phi' x n - c,

and where sections shear phi' = (1 + e) d3 + gamma1 d1 + gamma2 d2; kappa is that at rest and what R^T m adds to it, f
the weight and the forces per length, c the couples. Nothing is taken out of the frame's rotation. There is a station at
each jump of what varies along the rod, so that all is smooth between two of them but for the knots of splines.
"""

import dataclasses
import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rodjax.analysis.shooting import (
    Fields,
    Reached,
    Section,
    Start,
    Stations,
    equilibrium,
    error_growth,
    integrated,
    met,
    misses,
    places_of_sliding_clips,
    rotation_of,
    station_arclengths,
    sum_of_loads,
)
from rodjax.discretization.cells import ElementCells
from rodjax.discretization.frame_point import FramePoint
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.framed_results import through_cells
from rodjax.discretization.nodes import varying
from rodjax.geometry.rotations import columns, continuous, from_frame, product, unit
from rodjax.geometry.vectors import dot, root
from rodjax.mechanics.energy import Sections, dead_load_energy
from rodjax.model.along import Smooth, Spline, Steps, Value
from rodjax.model.loads import DistributedCouple, DistributedForce
from rodjax.model.rest import RestStrain, SpaceCurve, SplinedCurve
from rodjax.model.rod import Law
from rodjax.model.scene import Scene, nondimensional, slid, slides, sliding_arclengths
from rodjax.model.supports import Clamp
from rodjax.programs.compilation import compiled
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_form import form_and_point
from rodjax.units import Units

# --- what varies along the rod ---------------------------------------------------------------------------------------

# A number, or what is at hand of one that varies.
Prepared = Any


class Material(eqx.Module):
    """What a rod is made of and the loads that follow it, splines already made of their values.

    `rest`: curvature along d1 and d2 and twist, or a curve in space; `shear`: stiffnesses along d1 and d2;
    `rest_axial`: the axial strain without stress.
    """

    stiffnesses: tuple[Prepared, Prepared, Prepared, Prepared]
    shear: tuple[Prepared, Prepared] | None
    rest_axial: Prepared | None
    mass: Prepared
    rest: tuple[Prepared, Prepared, Prepared] | SplinedCurve | None
    law: Law | None
    force: Float[Array, "3"] | None
    couple: Float[Array, "3"] | None

    @staticmethod
    def of(scene: Scene) -> "Material":
        rod = scene.rod
        rest = rod.rest_shape
        zero = jnp.zeros_like(rod.length)
        prepared = None
        if isinstance(rest, RestStrain):
            twist = zero if rest.twist is None else rest.twist
            k1, k2, twist = (_prepared(value) for value in (*(rest.curvature or (zero, zero)), twist))
            prepared = (k1, k2, twist)
        elif isinstance(rest, SpaceCurve):
            prepared = rest.splined
        EI1, EI2, GJ, EA = (_prepared(value) for value in rod.stiffnesses)
        pair = rod.shear_pair
        return Material(
            (EI1, EI2, GJ, EA),
            None if pair is None else (_prepared(pair[0]), _prepared(pair[1])),
            None if rod.rest_strain is None else _prepared(rod.rest_strain),
            _prepared(rod.mass_per_length),
            prepared,
            rod.law,
            None,
            None,
        )

    def loaded(self, scene: Scene, s: Float[Array, ""]) -> "Material":
        """With the loads that follow it at an arclength."""
        force, couple = (sum_of_loads(scene, kind, True, s) for kind in (DistributedForce, DistributedCouple))
        return dataclasses.replace(self, force=force, couple=couple)

    def sections(self, s: Float[Array, ""], interval: Float[Array, "2"]) -> Sections:
        EI1, EI2, GJ, EA = (_at(value, s, interval) for value in self.stiffnesses)
        GA = None if self.shear is None else jnp.stack([_at(value, s, interval) for value in self.shear])
        rest_axial = None if self.rest_axial is None else _at(self.rest_axial, s, interval)
        return Sections(jnp.stack([EI1, EI2]), GJ, EA, s, self.law, GA, rest_axial)

    def rest_strains(self, s: Float[Array, ""], interval: Float[Array, "2"]) -> Float[Array, "3"]:
        if self.rest is None:
            return jnp.zeros_like(s, shape=3)
        if isinstance(self.rest, SplinedCurve):
            return self.rest.strains(s)
        return jnp.stack([_at(value, s, interval) for value in self.rest])


def _prepared(value: Value) -> Prepared:
    return Spline.through(value.s, value.values[:, None]) if isinstance(value, Smooth) else value


def _at(value: Prepared, s: Float[Array, ""], interval: Float[Array, "2"]) -> Float[Array, ""]:
    """At an arclength in an interval in which nothing jumps."""
    if isinstance(value, Spline):
        return value.at(s)[0]
    if isinstance(value, Steps):
        return value.values[jnp.searchsorted(value.jumps, jnp.mean(interval), side="right")]
    return value


def _splines(material: Material) -> list[Spline]:
    def is_spline(value):
        return isinstance(value, Spline)

    return [value for value in jax.tree.leaves(material, is_leaf=is_spline) if is_spline(value)]


# --- between two stations --------------------------------------------------------------------------------------------


class Piece(eqx.Module):
    """A piece of rod from the arclength `start` on, in the axes of its frame there, under n, m and dead loads there.

    `interval`: the arclengths between which it lies and nothing jumps.
    """

    start: Float[Array, ""]
    length: Float[Array, ""]
    interval: Float[Array, "2"]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]
    gravity: Float[Array, "3"] | None
    dead_force: Float[Array, "3"] | None
    dead_couple: Float[Array, "3"] | None
    fields: Fields | None
    material: Material


class FarEnd(eqx.Module):
    """The other end of a `Piece`, and of the piece its energies and the integral of its twist."""

    position: Float[Array, "3"]
    quaternion: Float[Array, "4"]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]
    elastic_energy: Float[Array, ""]
    load_energy: Float[Array, ""]
    twist: Float[Array, ""]


class Strained(eqx.Module):
    """Of a cross section: its sections, strains beyond those at rest, all of the strains, the axial one beyond that at
    rest and all of it, and with shear its strains.
    """

    sections: Sections
    beyond_rest: Float[Array, "3"]
    strains: Float[Array, "3"]
    axial: Float[Array, ""]
    stretched: Float[Array, ""]
    shear: Float[Array, "2"] | None

    def slope(self, frame: Float[Array, "3 3"]) -> Float[Array, "3"]:
        """phi'."""
        along = (1 + self.stretched) * frame[:, 2]
        return along if self.shear is None else along + frame[:, :2] @ self.shear


def _strained(
    material: Material,
    s: Float[Array, ""],
    interval: Float[Array, "2"],
    frame: Float[Array, "3 3"],
    force: Float[Array, "3"],
    moment: Float[Array, "3"],
) -> Strained:
    sections = material.sections(s, interval)
    beyond_rest, axial = sections.strains_under(frame.T @ moment, jnp.sum(force * frame[:, 2]))
    shear = None if sections.GA is None else sections.shear_under((frame.T @ force)[:2])
    strains = beyond_rest + material.rest_strains(s, interval)
    return Strained(sections, beyond_rest, strains, axial, sections.stretched(axial), shear)


@functools.partial(jax.jit, static_argnums=0)
def _far_end(rtol: float, piece: Piece) -> FarEnd:
    zero = jnp.zeros_like(piece.length)
    origin = jnp.zeros_like(piece.force)
    aligned = jnp.array([1.0, 0.0, 0.0, 0.0], zero.dtype)
    y0, unravel = ravel_pytree(FarEnd(origin, aligned, piece.force, piece.moment, zero, zero, zero))
    material = piece.material

    def slope(u, y, _):
        end = unravel(y)
        s = piece.start + u * piece.length
        frame = rotation_of(end.quaternion)
        here = _strained(material, s, piece.interval, frame, end.force, end.moment)
        dphi = here.slope(frame)
        dead = origin
        if piece.gravity is not None:
            dead += _at(material.mass, s, piece.interval) * piece.gravity
        if piece.dead_force is not None:
            dead += piece.dead_force
        load = dead if material.force is None else dead + frame @ material.force
        load_energy = dead_load_energy(dead, end.position)
        if piece.fields is not None:
            energy, by_position = piece.fields.energy_and_slope(end.position, s)
            load, load_energy = load - by_position, load_energy + energy
        dmoment = -jnp.cross(dphi, end.force)
        if piece.dead_couple is not None:
            dmoment -= piece.dead_couple
        if material.couple is not None:
            dmoment -= frame @ material.couple
        k1, k2, twist = here.beyond_rest
        by_s = FarEnd(
            position=dphi,
            quaternion=product(end.quaternion, jnp.concatenate([zero[None], here.strains])) / 2,
            force=-load,
            moment=dmoment,
            elastic_energy=here.sections.density((k1, k2), twist, here.axial, here.shear),
            load_energy=load_energy,
            twist=here.strains[2],
        )
        return piece.length * ravel_pytree(by_s)[0]

    controller = diffrax.PIDController(rtol=rtol, atol=rtol)
    knots = [jax.lax.stop_gradient(value.knots) for value in _splines(material)]
    if knots:
        # A step ends at each knot: across one, where higher derivatives jump, its error is not what it is taken for.
        start, length = jax.lax.stop_gradient((piece.start, piece.length))
        inside = (jnp.concatenate(knots) - start) / jnp.where(length > 0, length, 1.0)
        inside = jnp.where((inside > 0) & (inside < 1) & (length > 0), inside, 2.0)
        controller = diffrax.ClipStepSizeController(controller, step_ts=jnp.sort(inside))

    return unravel(integrated(slope, y0, controller))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def far_end(rtol: float, piece: Piece) -> FarEnd:
    """The other end of a piece, with derivatives in forward and reverse mode."""
    return _far_end(rtol, piece)


def _far_end_jvp(rtol: float, primals: tuple[Piece], tangents: tuple[Piece]) -> tuple[FarEnd, FarEnd]:
    # As in `continuum`, but only by the numbers that change: Newton's method leaves those of the rod as they are.
    values, structure = jax.tree.flatten(primals[0])
    changes = structure.flatten_up_to(tangents[0])
    changing = [k for k, change in enumerate(changes) if not isinstance(change, SymbolicZero)]
    x, unravel = ravel_pytree([values[k] for k in changing])
    tangent, _ = ravel_pytree([changes[k] for k in changing])

    def end_of(x):
        moved = list(values)
        for k, value in zip(changing, unravel(x), strict=True):
            moved[k] = value
        return _far_end(rtol, jax.tree.unflatten(structure, moved))

    def along(direction):
        return jax.jvp(end_of, (x,), (direction,))

    end, jacobian = jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(x), dtype=x.dtype))
    return end, jax.tree.map(lambda columns: columns @ tangent, jacobian)


far_end.defjvp(_far_end_jvp, symbolic_zeros=True)


def _reached(
    scene: Scene,
    rtol: float,
    section: Section,
    start: Float[Array, "k"],
    length: Float[Array, "k"],
    interval: Float[Array, "k 2"],
) -> tuple[Section, FarEnd]:
    """The cross sections at the other ends of pieces of rod from cross sections on, and those ends."""
    material = Material.of(scene)

    def reached(section, start, length, interval):
        axes, middle = section.frame.T, jnp.mean(interval)
        along = (sum_of_loads(scene, kind, False, middle) for kind in (DistributedForce, DistributedCouple))
        gravity, force, couple = (None if load is None else axes @ load for load in (scene.gravity, *along))
        n, m = axes @ section.force, axes @ section.moment
        fields = Fields.beyond(scene, section, middle)
        piece = Piece(start, length, interval, n, m, gravity, force, couple, fields, material.loaded(scene, middle))
        end = far_end(rtol, piece)
        beyond = Section(
            position=section.position + section.frame @ end.position,
            frame=section.frame @ rotation_of(end.quaternion),
            force=section.frame @ end.force,
            moment=section.frame @ end.moment,
        )
        return beyond, end

    return jax.vmap(reached)(section, start, length, interval)


def _intervals(start: Start) -> Float[Array, "k-1 2"]:
    return jnp.stack([start.s[:-1], start.s[1:]], axis=1)


def _over_intervals(scene: Scene, rtol: float, start: Start, sections: Section) -> tuple[Section, FarEnd]:
    before = jax.tree.map(lambda leaf: leaf[:-1], sections)
    return _reached(scene, rtol, before, start.s[:-1], jnp.diff(start.s), _intervals(start))


# --- the solve -------------------------------------------------------------------------------------------------------


@functools.partial(compiled, static_argnames=("rtol", "intervals", "segments"))
def solve_frames(scene: Scene, guess: Equilibrium, rtol: float, intervals: int, segments: int) -> Equilibrium:
    """As `solve_continuum`, from a guess with frames."""
    scaled, units = nondimensional(scene)
    if slides(scene):
        scaled = slid(scaled, places_of_sliding_clips(guess))
    start = _start(scaled, guess, units, intervals)

    def residual(stations: Stations, args: tuple[Scene, Start]):
        scene, start = args
        scene, start = start.slid(scene, stations)
        sections = start.sections(stations)
        return misses(scene, start, sections, _over_intervals(scene, rtol, start, sections)[0])

    # Without a clamp some rods can spin without resistance, others cannot.
    is_clamped = isinstance(scene.start, Clamp) or isinstance(scene.end, Clamp)
    is_clamped |= any(clip.frame is not None for clip in scene.clips)
    stations, iterations = met(residual, scaled, start, is_resisted=is_clamped)
    return _equilibrium(scene, start, stations, iterations, rtol, segments)


class _Along(eqx.Module):
    """Of a guess, nondimensional: forces, moments and quaternions of the frames at increasing arclengths, the growth of
    errors to the nodes, and forces and moments just beyond the clips.
    """

    arclengths: Float[Array, "m"]
    forces: Float[Array, "3 m"]
    moments: Float[Array, "3 m"]
    frame_arclengths: Float[Array, "k"]
    quaternions: Float[Array, "4 k"]
    s: Float[Array, "n+1"]
    growth: Float[Array, "n+1"]
    beyond_clips: tuple[Float[Array, "3 clips"], Float[Array, "3 clips"]] | None


def _along(guess: Equilibrium, units: Units) -> _Along:
    """In the units of the guess, which are nearly those of the scene, but for `growth`."""
    form, point = form_and_point(guess)
    assert isinstance(form, FrameForm)
    assert isinstance(point, FramePoint)
    scales = guess.state.units.force / units.force, guess.state.units.energy / units.energy
    through = through_cells(form, point)
    by_cells, own = scales[0] * through.forces, scales[1] * through.moments
    beyond_clips = None
    if form.clip_nodes is not None:
        beyond_clips = by_cells[:, 0, form.clip_nodes], -own[:, 0, form.clip_nodes]
    at = form.field.strain_arclengths
    arclengths = jnp.concatenate([at[0], at[-1, -1:]])
    forces = jnp.concatenate([by_cells[:, 0], by_cells[:, -1, -1:]], axis=1)
    moments = jnp.concatenate([-own[:, 0, :1], own[:, -1]], axis=1)

    s = guess.s / guess.s[-1]
    size = jnp.interp(s, arclengths, jnp.sqrt(dot(forces, forces)))
    squared = (guess.curvature**2 + guess.twist**2) * units.length**2
    growth = error_growth(s, size, squared)
    return _Along(arclengths, forces, moments, form.field.arclengths, point.quaternions, s, growth, beyond_clips)


@compiled
def growth_of_frames(scene: Scene, guess: Equilibrium) -> Float[Array, ""]:
    """The exponent of the growth of errors from one end of the rod to the other."""
    return _along(guess, nondimensional(scene)[1]).growth[-1]


def _start(scene: Scene, guess: Equilibrium, units: Units, intervals: int) -> Start:
    """Stations where errors grow equally, at the point forces and at jumps; their values from a guess."""
    fixed_units = jax.lax.stop_gradient(units)
    along = _along(guess, fixed_units)
    at = station_arclengths(scene, along.s, along.growth, intervals, varying(scene))

    fixed_s = jax.lax.stop_gradient(at.s)

    def between(arclengths: Float[Array, "m"], values: Float[Array, "c m"]) -> Float[Array, "c k"]:
        return jnp.stack([jnp.interp(fixed_s, arclengths, component) for component in values])

    quaternions = unit(between(along.frame_arclengths, along.quaternions))
    reference = jnp.moveaxis(columns(quaternions), 2, 0)
    force, moment = between(along.arclengths, along.forces).T, between(along.arclengths, along.moments).T
    if scene.clips:
        assert along.beyond_clips is not None
        beyond = along.beyond_clips
        force, moment = (each.at[at.clips].set(beyond[k].T) for k, each in enumerate((force, moment)))
    arclengths = sliding_arclengths(jax.lax.stop_gradient(scene))
    return Start.near(guess, fixed_units, at, reference, force, moment, arclengths)


def _equilibrium(
    scene: Scene, start: Start, stations: Stations, iterations: Any, rtol: float, segments: int
) -> Equilibrium:
    """The result, integrated from each station to the nodes behind it."""
    scaled, _ = nondimensional(scene)
    scaled, start = start.slid(scaled, stations)
    sections = start.sections(stations)
    # Nodes, and the middles between them for what a discrete solve begins with.
    s = ElementCells.of(scaled, jnp.linspace(0.0, 1.0, segments + 1, dtype=start.s.dtype)).arclengths
    station = jnp.searchsorted(start.s, s, side="right") - 1
    count = len(start.s) - 1
    intervals = _intervals(start)
    to_points = intervals[jnp.minimum(station, count - 1)]
    # One program for the intervals and from the stations to the points.
    both = jnp.concatenate([jnp.arange(count, dtype=station.dtype), station])
    lengths = jnp.concatenate([jnp.diff(start.s), s - start.s[station]])
    before = jax.tree.map(lambda leaf: leaf[both], sections)
    reached, ends = _reached(scaled, rtol, before, start.s[both], lengths, jnp.concatenate([intervals, to_points]))
    points = jax.tree.map(lambda leaf: leaf[count:], reached)
    reached, ends = jax.tree.map(lambda leaf: leaf[:count], (reached, ends))

    s, nodes = s[::2], jax.tree.map(lambda leaf: leaf[::2], points)
    strained = jax.vmap(functools.partial(_strained, Material.of(scaled)))(
        s, to_points[::2], nodes.frame, nodes.force, nodes.moment
    )
    strains = strained.strains.T
    quaternions = continuous(jax.vmap(from_frame, out_axes=1)(points.frame))
    result = Reached(
        s=s,
        nodes=nodes,
        curvature=root(dot(strains[:2], strains[:2])),
        twist=strains[2],
        axial_strain=strained.stretched,
        total_twist=jnp.sum(ends.twist),
        elastic_energy=jnp.sum(ends.elastic_energy),
        load_energy=jnp.sum(ends.load_energy),
        missed=misses(scaled, start, sections, reached),
        shape=FramedCurve(nodes.position, quaternions, s),
        intervals=reached,
        shear_strain=strained.shear,
    )
    return equilibrium(scene, start, stations, iterations, result)
