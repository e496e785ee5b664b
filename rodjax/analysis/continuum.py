"""solve_continuum(): the equilibrium of the continuous rod, eqs. (1)-(5) of Linn & Stephan (2008), without a mesh.

A boundary value problem in s, by multiple shooting: the unknowns are position, rotation, force and moment at stations
along the rod; between two stations the equations are integrated as an initial value problem, and where the intervals
do not meet, or a support is missed, there is a residual.

In a straight isotropic rod the torque m.t is constant between two stations. So the frame is carried along without
twist (its Darboux vector is the bending part of m/EI) and then spun by the angle (m.t) h/GJ: any number of turns is
as easy as none, and the total twist (m.t) L/GJ is never reduced. Other rods, and loads that follow the rod, are in
`continuum_frames`.
"""

import functools
import math
import operator
import warnings
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from rodjax.analysis.continuum_frames import growth_of_frames, solve_frames
from rodjax.analysis.shooting import (
    Fields,
    Reached,
    Section,
    Start,
    Stations,
    equilibrium,
    error_growth,
    forces_at_nodes,
    from_rodrigues,
    integrated,
    met,
    misses,
    places_of_sliding_clips,
    rotation_of,
    station_arclengths,
    turn_between,
)
from rodjax.checks import instance, is_known, positive, whole_number
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.hermite import Curve, QuadraticRotationElements
from rodjax.discretization.nodes import varying
from rodjax.geometry.vectors import root
from rodjax.mechanics.energy import (
    axial_strain_under,
    curvature_under,
    dead_load_energy,
    density,
    torque_at,
    twist_under,
)
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene, needs_frames, nondimensional, slid, slides, sliding_arclengths
from rodjax.model.supports import Clamp, Directed, Pin
from rodjax.programs.answers import one_answer
from rodjax.programs.compilation import compiled
from rodjax.solving.options import MAX_SEGMENTS
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_warnings import NotConvergedWarning, warn_of_outcome
from rodjax.solving.solve import solve
from rodjax.units import Units

# Of the discrete equilibrium that a solve without a guess begins with.
GUESS_RTOL = 1e-4
# Of the mesh on which a result without a guess is given.
DEFAULT_SEGMENTS = 50
# Errors grow like exp(sqrt(|n|/EI) h) over an interval h: the exponent aimed at.
GROWTH = 5.0
# A few sizes, powers of two, so that few programs are compiled. Newton's matrix is dense: beyond 32 intervals its
# factorisation takes most of the time.
MIN_INTERVALS, MAX_INTERVALS = 4, 128
# Where the numbers that choose it are not known, as inside jit.
DEFAULT_INTERVALS = 16
# Shorter intervals make the search steadier: where it fails, so many times as many are tried, by doubling.
MORE_INTERVALS = 4


@one_answer
def solve_continuum(
    scene: Scene,
    guess: Equilibrium | None = None,
    *,
    rtol: float = 1e-12,
    intervals: int | None = None,
    segments: int | None = None,
) -> Equilibrium:
    """The equilibrium of the continuous rod: what discrete equilibria converge to, to some 10 digits.

    Works inside `jax.jit` and `jax.vmap`; forward and reverse derivatives by every number of the scene, through the
    implicit function theorem.

    **Arguments:**

    - `scene`: `Scene`.
    - `guess`: an `Equilibrium` nearby, on any mesh: the solution keeps its total twist to within half a turn. `None`,
      or a guess for a scene that states its turns: `rodjax.solve` first.
    - `rtol`: tolerance of the integration in s, relative to L, EI/L and EI.
    - `intervals`: of multiple shooting, besides those that point forces add; `None`: as many as keep the growth of
      errors in each modest, or 16 inside `jax.jit`.
    - `segments`: the result is given at `segments` + 1 equally spaced arclengths, or moved so that one lies at each
      point force; `None`: as many as those of the guess, else 50.

    At a point force or clip tension and curvature are those beyond it. `stable` is not examined and False; `residual`
    is the largest mismatch at a support or between two intervals, in L, rad, and in EI/L^2 and EI/L or the largest
    force and moment in the rod. Above 1e-10 the result is marked as not converged, and outside `jit` a
    `NotConvergedWarning` says so.

    Raises `ValueError` or `TypeError` for invalid arguments.
    """
    instance(scene, "scene", Scene)
    if scene.rod.length.ndim:
        raise ValueError(
            f"scene must be a single scene, got a stack of shape {scene.rod.length.shape}; use jax.vmap for several"
        )
    if scene.rod.length.dtype != jnp.float64:
        raise ValueError(
            "scene must be in double precision: jax.config.update('jax_enable_x64', True) before making it"
        )
    rtol = float(positive(rtol, "rtol"))
    if not 1e-14 <= rtol <= 1e-3:
        raise ValueError(f"rtol must lie in 1e-14 to 1e-3, got {rtol:g}")
    if intervals is not None:
        intervals = whole_number(intervals, "intervals", 1, MAX_INTERVALS)
    # A node for each clip.
    least = len(scene.clips) + 1
    if segments is not None:
        segments = whole_number(segments, "segments", least, MAX_SEGMENTS)
    if guess is not None:
        instance(guess, "guess", Equilibrium)
        if guess.s.ndim != 1:
            raise ValueError(f"guess must be a single equilibrium, got several of shape {guess.s.shape[:-1]}")
    if segments is None:
        segments = max(DEFAULT_SEGMENTS if guess is None else guess.s.shape[-1] - 1, least)
    if scene.obstacles:
        raise ValueError("obstacles must be () in the continuum: rodjax.solve takes them")
    if scene.self_contact:
        raise ValueError("self_contact must be False in the continuum: rodjax.solve takes it")
    # The root does not depend on where the search for it begins.
    fixed_scene, guess = jax.lax.stop_gradient((scene, guess))
    guess = _near(fixed_scene, guess)
    solved, growth = (solve_frames, growth_of_frames) if needs_frames(scene) else (_solve, _growth)
    count = _chosen_intervals(growth, fixed_scene, guess) if intervals is None else intervals
    result = solved(scene, guess, rtol, count, segments)
    most = min(MORE_INTERVALS * count, MAX_INTERVALS) if intervals is None else count
    while count < most and is_known(result.converged) and not bool(result.converged):
        count *= 2
        result = solved(scene, guess, rtol, count, segments)
    warn_of_outcome(result)
    return result


def _near(scene: Scene, guess: Equilibrium | None) -> Equilibrium:
    """A guess with the turns and clips that the scene states, with frames where the scene needs them, and on elements,
    which tell the forces at nodes, where fields act.
    """
    has_frames = guess is not None and isinstance(guess.state.shape, FramedCurve)
    tells_forces = guess is not None and not (scene.potentials and guess.discretization == "finite_difference")
    if guess is not None and tells_forces and scene.turns is None and (has_frames or not needs_frames(scene)):
        kinds = ([clip.sliding for clip in of.clips] for of in (scene, guess.scene))
        if operator.eq(*kinds):
            return guess
    with warnings.catch_warnings():
        # Whether the continuum converges from there is what the caller is told.
        warnings.simplefilter("ignore", NotConvergedWarning)
        return solve(scene, rtol=GUESS_RTOL, discretization="hermite", guess=guess, strain_limit=None)


class Piece(eqx.Module):
    """A piece of rod from the arclength `start` on, in the axes of its frame there, under n and m there."""

    start: Float[Array, ""]
    length: Float[Array, ""]
    EA: Float[Array, ""]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]
    gravity: Float[Array, "3"] | None
    fields: Fields | None


class FarEnd(eqx.Module):
    """The other end of a `Piece`, and energies of the piece without that of torsion. `force`: where fields act."""

    position: Float[Array, "3"]
    quaternion: Float[Array, "4"]
    moment: Float[Array, "3"]
    elastic_energy: Float[Array, ""]
    load_energy: Float[Array, ""]
    force: Float[Array, "3"] | None


@functools.partial(jax.jit, static_argnums=0)
def _far_end(rtol: float, piece: Piece) -> FarEnd:
    """phi' = (1 + e) t, m' = -phi' x n and the frame without twist along a piece, EI = 1, n' = -gravity."""
    rod = Rod(1.0, 1.0, 1.0, piece.EA)
    origin = jnp.zeros(3, piece.length.dtype)
    aligned = jnp.array([1.0, 0.0, 0.0, 0.0], piece.length.dtype)
    zero = jnp.zeros_like(piece.length)
    # One vector: the program of a tree of five arrays is larger and takes longer to compile.
    force_there = None if piece.fields is None else piece.force
    y0, unravel = ravel_pytree(FarEnd(origin, aligned, piece.moment, zero, zero, force_there))

    def slope(u, y, _):
        end = unravel(y)
        force = end.force
        if force is None:
            force = piece.force if piece.gravity is None else piece.force - u * piece.length * piece.gravity
        t = rotation_of(end.quaternion)[:, 2]
        bending = end.moment - jnp.sum(end.moment * t) * t
        curvature = curvature_under(rod, bending)
        axial_strain = axial_strain_under(rod, jnp.sum(force * t))
        dphi = (1 + axial_strain) * t
        energy = zero if piece.gravity is None else dead_load_energy(piece.gravity, end.position)
        by_force = None
        if piece.fields is not None:
            of_fields, by_force = piece.fields.energy_and_slope(end.position, piece.start + u * piece.length)
            energy += of_fields
            by_force = by_force if piece.gravity is None else by_force - piece.gravity
        by_s = FarEnd(
            position=dphi,
            quaternion=_quaternion_rate(end.quaternion, curvature),
            moment=-jnp.cross(dphi, force),
            elastic_energy=density(rod, squared_curvature=jnp.sum(curvature**2), axial_strain=axial_strain),
            load_energy=energy,
            force=by_force,
        )
        return piece.length * ravel_pytree(by_s)[0]

    return unravel(integrated(slope, y0, diffrax.PIDController(rtol=rtol, atol=rtol)))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def far_end(rtol: float, piece: Piece) -> FarEnd:
    """The other end of a piece, with derivatives in forward and reverse mode."""
    return _far_end(rtol, piece)


@far_end.defjvp
def _far_end_jvp(rtol: float, primals: tuple[Piece], tangents: tuple[Piece]) -> tuple[FarEnd, FarEnd]:
    # The whole Jacobian of a piece, once, in forward mode. What follows it is linear algebra, which also runs backward.
    x, unravel = ravel_pytree(primals[0])
    tangent, _ = ravel_pytree(tangents[0])

    def along(direction):
        return jax.jvp(lambda x: _far_end(rtol, unravel(x)), (x,), (direction,))

    end, jacobian = jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(x), dtype=x.dtype))
    return end, jax.tree.map(lambda columns: columns @ tangent, jacobian)


def _piece(
    scene: Scene, section: Section, start: Float[Array, ""], length: Float[Array, ""], middle: Float[Array, ""]
) -> Piece:
    """The piece of rod of this length from a cross section on; `middle`: of the interval in which nothing jumps."""
    axes = section.frame.T
    gravity = None if scene.gravity is None else axes @ scene.gravity
    n, m, fields = axes @ section.force, axes @ section.moment, Fields.beyond(scene, section, middle)
    return Piece(start, length, scene.rod.EA, n, m, gravity, fields)


def _beyond(scene: Scene, section: Section, length: Float[Array, ""], end: FarEnd) -> Section:
    """The cross section at the other end of that piece."""
    spin = twist_under(scene.rod, section.torque) * length
    if end.force is None:
        force = section.force if scene.gravity is None else section.force - length * scene.gravity
    else:
        force = section.frame @ end.force
    return Section(
        position=section.position + section.frame @ end.position,
        frame=section.frame @ rotation_of(end.quaternion) @ _about_tangent(spin),
        force=force,
        moment=section.frame @ end.moment,
    )


@functools.partial(compiled, static_argnames=("rtol", "intervals", "segments"))
def _solve(scene: Scene, guess: Equilibrium, rtol: float, intervals: int, segments: int) -> Equilibrium:
    scaled, units = nondimensional(scene)
    if slides(scene):
        scaled = slid(scaled, places_of_sliding_clips(guess))
    start = _start(scaled, guess, units, intervals)

    def residual(stations: Stations, args: tuple[Scene, Start]):
        scene, start = args
        scene, start = start.slid(scene, stations)
        sections = start.sections(stations)
        pieces = _intervals(scene, start, sections)
        return _residual(scene, start, stations, _reached(scene, start, sections, _far_ends(rtol, pieces)))

    # An unloaded rod between two pins can turn about the line through them, and one in clips where all lie on one line.
    is_loaded = scene.gravity is not None or scene.point_forces or scene.potentials
    turns_freely = isinstance(scene.start, Pin) and isinstance(scene.end, Pin) and not is_loaded
    if scene.clips:
        directed = any(isinstance(end, Directed) for end in (scene.start, scene.end))
        directed |= any(clip.tangent is not None for clip in scene.clips)
        turns_freely = not is_loaded and not directed
    stations, iterations = met(residual, scaled, start, is_resisted=not turns_freely)
    return _equilibrium(scene, start, stations, iterations, rtol, segments)


def _pieces(
    scene: Scene, start: Start, sections: Section, stations: Int[Array, "m"], length: Float[Array, "m"]
) -> Piece:
    """From these stations on."""
    begin = jax.tree.map(lambda leaf: leaf[stations], sections)
    middles = (start.s[1:] + start.s[:-1]) / 2
    middle = middles[jnp.minimum(stations, len(middles) - 1)]
    return jax.vmap(functools.partial(_piece, scene))(begin, start.s[stations], length, middle)


def _intervals(scene: Scene, start: Start, sections: Section) -> Piece:
    return _pieces(scene, start, sections, jnp.arange(len(start.s) - 1), jnp.diff(start.s))


def _far_ends(rtol: float, pieces: Piece) -> FarEnd:
    return jax.vmap(functools.partial(far_end, rtol))(pieces)


def _residual(
    scene: Scene, start: Start, stations: Stations, reached: Section
) -> tuple[Stations, Float[Array, "6"], Float[Array, "6"]]:
    """What intervals that reach these sections miss the next stations by, and the ends of the rod their supports."""
    sections = start.sections(stations)
    gaps, at_start, at_end = misses(scene, start, sections, reached)
    if not any(isinstance(end, Clamp) for end in (scene.start, scene.end)):
        # Both ends ask for no torque, which is constant along the rod, and none fixes the spin: it stays the guess's.
        at_start = at_start.at[5].set(stations.turn[0, 2])
    return gaps, at_start, at_end


def _reached(scene: Scene, start: Start, sections: Section, ends: FarEnd) -> Section:
    """The cross sections at the ends of the intervals."""
    before = jax.tree.map(lambda leaf: leaf[:-1], sections)
    return jax.vmap(functools.partial(_beyond, scene))(before, jnp.diff(start.s), ends)


def _forces_along(scene: Scene, guess: Equilibrium, units: Units, s: Float[Array, "k"]) -> Float[Array, "k 3"]:
    """Of a guess, before a point force and beyond a clip."""
    force = jnp.broadcast_to(guess.start_force / units.force, (len(s), 3))
    if scene.gravity is not None:
        force -= s[:, None] * scene.gravity[None]
    for load in scene.point_forces:
        force -= jnp.where(s > load.at, 1.0, 0.0)[:, None] * load.force[None]
    for clip, reaction in zip(scene.clips, guess.clip_forces, strict=True) if scene.clips else ():
        force -= jnp.where(s >= clip.at, 1.0, 0.0)[:, None] * (reaction / units.force)[None]
    return force


def _growth_along(scene: Scene, guess: Equilibrium, units: Units) -> tuple[Float[Array, "n+1 3"], Float[Array, "n+1"]]:
    """Forces at the nodes of a guess, and int sqrt(|n| + curvature^2) ds from the start to there."""
    s = guess.s / guess.s[-1]
    force = forces_at_nodes(guess, units) if scene.potentials else _forces_along(scene, guess, units, s)
    return force, error_growth(s, jnp.sqrt(jnp.sum(force**2, axis=1)), (guess.curvature * units.length) ** 2)


@compiled
def _growth(scene: Scene, guess: Equilibrium) -> Float[Array, ""]:
    scaled, units = nondimensional(scene)
    return _growth_along(scaled, guess, units)[1][-1]


def _chosen_intervals(
    growth: Callable[[Scene, Equilibrium], Float[Array, ""]], scene: Scene, guess: Equilibrium
) -> int:
    if not is_known(scene, guess):
        return DEFAULT_INTERVALS
    needed = float(growth(scene, guess)) / GROWTH
    if not math.isfinite(needed):
        return DEFAULT_INTERVALS
    return min(max(2 ** math.ceil(math.log2(needed)), MIN_INTERVALS), MAX_INTERVALS)


def _start(scene: Scene, guess: Equilibrium, units: Units, intervals: int) -> Start:
    """Stations where errors grow equally from each to the next, at clips and at the point forces, their values from a
    guess.
    """
    fixed, fixed_units = jax.lax.stop_gradient((scene, units))
    x = guess.s / guess.s[-1]
    node_force, growth = _growth_along(fixed, guess, fixed_units)
    at = station_arclengths(scene, x, growth, intervals, varying(scene))

    fixed_s = jax.lax.stop_gradient(at.s)
    reference = _frames_between(x, guess.frames, guess.total_twist, fixed_s)
    tangents = guess.tangents
    moments = jnp.cross(tangents, _differences(tangents) / _differences(x)[:, None])
    ends = (guess.start_moment / fixed_units.energy, guess.end_moment / fixed_units.energy)
    moments = moments.at[0].set(ends[0]).at[-1].set(ends[1])
    across = moments - jnp.sum(moments * tangents, axis=1)[:, None] * tangents
    moments = across + torque_at(fixed.rod, guess.total_twist) * tangents
    force = jnp.stack([jnp.interp(fixed_s, x, component) for component in node_force.T], axis=1)
    moment = jnp.stack([jnp.interp(fixed_s, x, component) for component in moments.T], axis=1)
    if scene.clips and scene.potentials:
        nodes = jnp.argmin(jnp.abs(x[:, None] - fixed_s[at.clips][None]), axis=0)
        force = force.at[at.clips].set(node_force[nodes])
    elif scene.clips:
        force = _forces_along(fixed, guess, fixed_units, fixed_s)
    if scene.clips:
        moment = moment.at[at.clips].set(_moments_beyond_clips(fixed, x, tangents, moments))
    arclengths = sliding_arclengths(fixed)
    return Start.near(guess, fixed_units, at, reference, force, moment, arclengths)


def _moments_beyond_clips(
    scene: Scene, x: Float[Array, "n+1"], tangents: Float[Array, "n+1 3"], moments: Float[Array, "n+1 3"]
) -> Float[Array, "clips 3"]:
    """Beyond each clip, where moments may jump, the bending of the two cells between the nodes there extrapolated."""
    middles = jnp.cross(tangents[:-1], tangents[1:]) / jnp.diff(x)[:, None]
    found = []
    for clip in scene.clips:
        cell = jnp.clip(jnp.searchsorted(x, clip.at, side="right") - 1, 0, len(x) - 3)
        part = (x[cell + 1] - x[cell]) / (x[cell + 2] - x[cell])
        across = middles[cell] + part * (middles[cell] - middles[cell + 1])
        t = tangents[cell]
        found.append(across + jnp.sum((moments[cell] - across) * t) * t)
    return jnp.stack(found)


def _differences(values: Float[Array, "n *m"]) -> Float[Array, "n *m"]:
    """Between the neighbours of each, one of them itself at the ends."""
    return jnp.concatenate([values[1:], values[-1:]]) - jnp.concatenate([values[:1], values[:-1]])


def _frames_between(
    x: Float[Array, "n+1"], frames: Float[Array, "n+1 3 3"], twist: Float[Array, ""], s: Float[Array, "k"]
) -> Float[Array, "k 3 3"]:
    """Frames at s, between those at x: along the smallest rotation after the twist is taken out."""
    cell = jnp.clip(jnp.searchsorted(x, s, side="right") - 1, 0, len(x) - 2)

    def between(cell, s):
        before = frames[cell] @ _about_tangent(-twist * x[cell])
        after = frames[cell + 1] @ _about_tangent(-twist * x[cell + 1])
        fraction = (s - x[cell]) / (x[cell + 1] - x[cell])
        return before @ from_rodrigues(fraction * turn_between(before, after)) @ _about_tangent(twist * s)

    return jax.vmap(between)(cell, s)


def _equilibrium(
    scene: Scene, start: Start, stations: Stations, iterations: Any, rtol: float, segments: int
) -> Equilibrium:
    """The result, integrated from each station to the nodes behind it."""
    scaled, _ = nondimensional(scene)
    scaled, start = start.slid(scaled, stations)
    rod = scaled.rod
    sections = start.sections(stations)
    # Nodes, and the middles between them for what a discrete solve begins with.
    equal = jnp.linspace(0.0, 1.0, segments + 1, dtype=start.s.dtype)
    s = QuadraticRotationElements.of(scaled, equal).arclengths
    station = jnp.searchsorted(start.s, s, side="right") - 1
    before = jax.tree.map(lambda leaf: leaf[station], sections)
    length, count = s - start.s[station], len(start.s) - 1
    # One program for the intervals and from the stations to the points.
    both = jnp.concatenate([jnp.arange(count, dtype=station.dtype), station])
    lengths = jnp.concatenate([jnp.diff(start.s), length])
    far_ends = _far_ends(rtol, _pieces(scaled, start, sections, both, lengths))
    ends, point_ends = (
        jax.tree.map(lambda leaf, cut=cut: leaf[cut], far_ends) for cut in (slice(count), slice(count, None))
    )
    points = jax.vmap(functools.partial(_beyond, scaled))(before, length, point_ends)
    reached = _reached(scaled, start, sections, ends)
    s, nodes = s[::2], jax.tree.map(lambda leaf: leaf[::2], points)
    twist = twist_under(rod, sections.torque[0])
    moments = nodes.moment - nodes.torque[:, None] * nodes.tangent
    result = Reached(
        s=s,
        nodes=nodes,
        curvature=root(jnp.sum(curvature_under(rod, moments) ** 2, axis=1)),
        twist=jnp.full_like(s, twist),
        axial_strain=axial_strain_under(rod, nodes.tension),
        total_twist=twist,
        elastic_energy=jnp.sum(ends.elastic_energy) + density(rod, twist=twist),
        load_energy=jnp.sum(ends.load_energy),
        missed=_residual(scaled, start, stations, reached),
        shape=Curve(nodes.position, points.tangent.T, s),
        intervals=reached,
    )
    return equilibrium(scene, start, stations, iterations, result)


def _quaternion_rate(quaternion: Float[Array, "4"], rate: Float[Array, "3"]) -> Float[Array, "4"]:
    """Derivative of a quaternion whose axes turn at `rate`, in fixed axes."""
    w, v = quaternion[0], quaternion[1:]
    return jnp.concatenate([-jnp.sum(rate * v)[None], w * rate + jnp.cross(rate, v)]) / 2


def _about_tangent(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """What turns a frame about its t, from the right."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.array([[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]])
