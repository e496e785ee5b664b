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
import warnings
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rodjax.checks import instance, is_known, positive, whole_number
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.hermite import Curve, HermiteElements
from rodjax.energy import axial_strain_under, dead_load_energy, density
from rodjax.equilibrium import MAX_SEGMENTS, solve
from rodjax.result import Equilibrium, NotConvergedWarning, SolverState, warn_if_not_converged
from rodjax.rod import Rod
from rodjax.scene import Scene, needs_frames, nondimensional
from rodjax.status import Status, is_converged
from rodjax.supports import Clamp, Free, Held, Pin, Support, Swivel
from rodjax.units import Units
from rodjax.vectors import root

# The residual at which stations and supports count as met: positions in L, rotations in rad, forces and moments in
# EI/L^2 and EI/L, or where they are larger than these, relative to the largest in the rod. The rounding floor of
# |force| eps is far below in these units, so that one figure serves slack wires and taut cables.
TOLERANCE = 1e-10
# A full-step Newton from nearby takes 3 to 7 iterations; one that takes more wanders.
MAX_ITERATIONS = 25
# Steps of the integrator in one interval; a dozen is usual.
MAX_STEPS = 1000
# Its first step, as part of an interval.
FIRST_STEP = 0.25
# Singular values below this part of the largest belong to motions that nothing resists.
RANK_TOLERANCE = 1e-9
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

    At a point force the tension is that beyond it. `stable` is not examined and False; `residual` is the largest miss
    of a support or between two intervals, in L, rad, and in EI/L^2 and EI/L or the largest force and moment in the
    rod. Above 1e-10 the result is marked as not converged, and outside `jit` a `NotConvergedWarning` says so.
    Raises `ValueError` or `TypeError` for arguments that make no sense.
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
    if segments is not None:
        segments = whole_number(segments, "segments", 1, MAX_SEGMENTS)
    if guess is not None:
        instance(guess, "guess", Equilibrium)
        if guess.s.ndim != 1:
            raise ValueError(f"guess must be a single equilibrium, got several of shape {guess.s.shape[:-1]}")
    if segments is None:
        segments = DEFAULT_SEGMENTS if guess is None else guess.s.shape[-1] - 1
    if scene.clips:
        raise ValueError("clips must be () in the continuum: rodjax.solve takes them")
    # The root does not depend on where the search for it begins.
    fixed_scene, guess = jax.lax.stop_gradient((scene, guess))
    guess = _near(fixed_scene, guess)
    if needs_frames(scene):
        from rodjax.continuum_frames import growth, solve_frames  # which itself imports from here

        if intervals is None:
            intervals = _chosen_intervals(growth, fixed_scene, guess)
        result = solve_frames(scene, guess, rtol, intervals, segments)
    else:
        if intervals is None:
            intervals = _chosen_intervals(_growth, fixed_scene, guess)
        result = _solve(scene, guess, rtol, intervals, segments)
    warn_if_not_converged(result)
    return result


def _near(scene: Scene, guess: Equilibrium | None) -> Equilibrium:
    """A guess with the turns that the scene states, and with frames where the scene needs them."""
    has_frames = guess is not None and isinstance(guess.state.shape, FramedCurve)
    if guess is not None and scene.turns is None and (has_frames or not needs_frames(scene)):
        return guess
    with warnings.catch_warnings():
        # Whether the continuum converges from there is what the caller is told.
        warnings.simplefilter("ignore", NotConvergedWarning)
        return solve(scene, rtol=GUESS_RTOL, discretization="hermite", guess=guess)


class Section(eqx.Module):
    """A cross section: position, material frame, n and m on it, global axes."""

    position: Float[Array, "3"]
    frame: Float[Array, "3 3"]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]

    @property
    def tangent(self) -> Float[Array, "3"]:
        return self.frame[:, 2]

    @property
    def torque(self) -> Float[Array, ""]:
        return jnp.sum(self.moment * self.tangent)


class Stations(eqx.Module):
    """The unknowns, and the residuals between them. Forces and moments in units of the `Start`'s scales.

    `turn`: Rodrigues vector 2 tan(angle/2) axis of the rotation from the guess's material frame, in the axes of that;
    its pole, half a turn, is far from an equilibrium near the guess.
    """

    position: Float[Array, "k 3"]
    turn: Float[Array, "k 3"]
    force: Float[Array, "k 3"]
    moment: Float[Array, "k 3"]


class Start(eqx.Module):
    """Where Newton begins, with what stays fixed while it runs.

    `s`: arclengths of the stations; `force_steps`: point forces at each of them.
    """

    stations: Stations
    s: Float[Array, "k"]
    force_steps: Float[Array, "k 3"]
    reference: Float[Array, "k 3 3"]
    force_scale: Float[Array, ""]
    moment_scale: Float[Array, ""]

    def sections(self, stations: Stations) -> Section:
        """The cross sections at the stations, each just beyond its point force."""
        frames = self.reference @ jax.vmap(from_rodrigues)(stations.turn)
        return Section(
            stations.position, frames, self.force_scale * stations.force, self.moment_scale * stations.moment
        )


class Piece(eqx.Module):
    """A piece of rod from a cross section on, in the axes of its frame there, under n and m there."""

    length: Float[Array, ""]
    EA: Float[Array, ""]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]
    gravity: Float[Array, "3"] | None


class FarEnd(eqx.Module):
    """The other end of a `Piece`, and energies of the piece without that of torsion."""

    position: Float[Array, "3"]
    quaternion: Float[Array, "4"]
    moment: Float[Array, "3"]
    elastic_energy: Float[Array, ""]
    weight_energy: Float[Array, ""]


@functools.partial(jax.jit, static_argnums=0)
def _integrated(rtol: float, piece: Piece) -> FarEnd:
    """phi' = (1 + e) t, m' = -phi' x n and the frame without twist along a piece, EI = 1, n' = -gravity."""
    rod = Rod(1.0, 1.0, 1.0, piece.EA)
    origin = jnp.zeros(3, piece.length.dtype)
    aligned = jnp.array([1.0, 0.0, 0.0, 0.0], piece.length.dtype)
    zero = jnp.zeros_like(piece.length)
    # One vector: the program of a tree of five arrays is larger and takes longer to compile.
    y0, unravel = ravel_pytree(FarEnd(origin, aligned, piece.moment, zero, zero))

    def slope(u, y, _):
        end = unravel(y)
        force = piece.force if piece.gravity is None else piece.force - u * piece.length * piece.gravity
        t = rotation_of(end.quaternion)[:, 2]
        bending = end.moment - jnp.sum(end.moment * t) * t
        curvature = bending / rod.EI
        axial_strain = axial_strain_under(rod, jnp.sum(force * t))
        dphi = (1 + axial_strain) * t
        weight = zero if piece.gravity is None else dead_load_energy(piece.gravity, end.position)
        by_s = FarEnd(
            position=dphi,
            quaternion=_quaternion_rate(end.quaternion, curvature),
            moment=-jnp.cross(dphi, force),
            elastic_energy=density(rod, squared_curvature=jnp.sum(curvature**2), axial_strain=axial_strain),
            weight_energy=weight,
        )
        return piece.length * ravel_pytree(by_s)[0]

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),  # pyright: ignore[reportArgumentType]
        diffrax.Dopri8(),
        t0=0.0,
        t1=1.0,
        dt0=FIRST_STEP,
        y0=y0,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        adjoint=diffrax.ForwardMode(),
        max_steps=MAX_STEPS,
        throw=False,
    )
    is_done = solution.result == diffrax.RESULTS.successful
    assert solution.ys is not None
    return unravel(jnp.where(is_done, solution.ys[-1], jnp.nan))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def far_end(rtol: float, piece: Piece) -> FarEnd:
    """The other end of a piece, with derivatives in forward and reverse mode."""
    return _integrated(rtol, piece)


@far_end.defjvp
def _far_end_jvp(rtol: float, primals: tuple[Piece], tangents: tuple[Piece]) -> tuple[FarEnd, FarEnd]:
    # The whole Jacobian of a piece, once, in forward mode. What follows it is linear algebra, which also runs backward.
    x, unravel = ravel_pytree(primals[0])
    tangent, _ = ravel_pytree(tangents[0])

    def along(direction):
        return jax.jvp(lambda x: _integrated(rtol, unravel(x)), (x,), (direction,))

    end, jacobian = jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(x), dtype=x.dtype))
    return end, jax.tree.map(lambda columns: columns @ tangent, jacobian)


def _piece(scene: Scene, section: Section, length: Float[Array, ""]) -> Piece:
    """The piece of rod of this length from a cross section on."""
    axes = section.frame.T
    gravity = None if scene.gravity is None else axes @ scene.gravity
    return Piece(length, scene.rod.EA, axes @ section.force, axes @ section.moment, gravity)


def _beyond(scene: Scene, section: Section, length: Float[Array, ""], end: FarEnd) -> Section:
    """The cross section at the other end of that piece."""
    spin = section.torque / scene.rod.GJ * length
    return Section(
        position=section.position + section.frame @ end.position,
        frame=section.frame @ rotation_of(end.quaternion) @ _about_tangent(spin),
        force=section.force if scene.gravity is None else section.force - length * scene.gravity,
        moment=section.frame @ end.moment,
    )


@functools.partial(jax.jit, static_argnames=("rtol", "intervals", "segments"))
def _solve(scene: Scene, guess: Equilibrium, rtol: float, intervals: int, segments: int) -> Equilibrium:
    scaled, units = nondimensional(scene)
    start = _start(scaled, guess, units, intervals)
    newton = optx.Newton(rtol=TOLERANCE, atol=TOLERANCE, linear_solver=_linear_solver(scene))

    def residual(stations: Stations, args: tuple[Scene, Start]):
        scene, start = args
        sections = start.sections(stations)
        pieces = _intervals(scene, start, sections)
        return _residual(scene, start, stations, jax.vmap(functools.partial(far_end, rtol))(pieces))

    found = optx.root_find(
        residual,
        newton,
        start.stations,
        (scaled, start),
        max_steps=MAX_ITERATIONS,
        adjoint=optx.ImplicitAdjoint(newton.linear_solver),
        throw=False,
    )
    return _equilibrium(scene, start, found.value, found.stats["num_steps"], rtol, segments)


def _linear_solver(scene: Scene) -> lx.AbstractLinearSolver:
    # An unloaded rod between two pins can turn about the line through them: then the smallest step is the one to take.
    is_loaded = scene.gravity is not None or scene.point_forces
    turns_freely = isinstance(scene.start, Pin) and isinstance(scene.end, Pin) and not is_loaded
    return lx.SVD(rcond=RANK_TOLERANCE) if turns_freely else lx.LU()


def _intervals(scene: Scene, start: Start, sections: Section) -> Piece:
    before = jax.tree.map(lambda leaf: leaf[:-1], sections)
    return jax.vmap(functools.partial(_piece, scene))(before, jnp.diff(start.s))


def _residual(
    scene: Scene, start: Start, stations: Stations, ends: FarEnd
) -> tuple[Stations, Float[Array, "6"], Float[Array, "6"]]:
    """What intervals that end in `ends` miss the next stations by, and the ends of the rod their supports."""
    sections = start.sections(stations)
    before = jax.tree.map(lambda leaf: leaf[:-1], sections)
    reached = jax.vmap(functools.partial(_beyond, scene))(before, jnp.diff(start.s), ends)
    gaps, at_start, at_end = misses(scene, start, sections, reached)
    if not any(isinstance(end, Clamp) for end in (scene.start, scene.end)):
        # Both ends ask for no torque, which is constant along the rod, and none fixes the spin: it stays the guess's.
        at_start = at_start.at[5].set(stations.turn[0, 2])
    return gaps, at_start, at_end


def misses(
    scene: Scene, start: Start, sections: Section, reached: Section
) -> tuple[Stations, Float[Array, "6"], Float[Array, "6"]]:
    """What is missed between the sections at the stations and those `reached` from each before, and at the supports."""
    after = jax.tree.map(lambda leaf: leaf[1:], sections)
    gaps = Stations(
        position=after.position - reached.position,
        turn=jax.vmap(turn_between)(reached.frame, after.frame),
        force=(after.force + start.force_steps[1:] - reached.force) / start.force_scale,
        moment=(after.moment - reached.moment) / start.moment_scale,
    )
    first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], sections) for k in (0, -1))
    return gaps, _missed_support(scene.start, start, first, -1.0), _missed_support(scene.end, start, last, 1.0)


def _missed_support(end: Support, start: Start, section: Section, sign: float) -> Float[Array, "6"]:
    """What a support asks of its cross section; `sign`: of a load on a free end in n and m there. Torque comes last."""
    moment = section.moment
    if isinstance(end, Free):
        loads = (end.force, end.moment)
        if end.follower:
            loads = tuple(None if load is None else section.frame @ load for load in loads)
        force = section.force if loads[0] is None else section.force - sign * loads[0]
        moment = moment if loads[1] is None else moment - sign * loads[1]
        position_or_force = force / start.force_scale
    else:
        assert isinstance(end, Held)
        position_or_force = section.position - end.position
    turn_or_moment = section.frame.T @ moment / start.moment_scale
    if isinstance(end, Clamp):
        turn_or_moment = turn_between(end.frame, section.frame)
    elif isinstance(end, Swivel):
        # No part of the support's tangent along d1 and d2.
        turn_or_moment = turn_or_moment.at[:2].set(section.frame[:, :2].T @ end.tangent)
    return jnp.concatenate([position_or_force, turn_or_moment])


def _growth_along(scene: Scene, guess: Equilibrium, units: Units) -> tuple[Float[Array, "n+1 3"], Float[Array, "n+1"]]:
    """Forces at the nodes of a guess, and int sqrt(|n| + curvature^2) ds from the start to there."""
    s = guess.s / guess.s[-1]
    force = jnp.broadcast_to(guess.start_force / units.force, guess.nodes.shape)
    if scene.gravity is not None:
        force -= s[:, None] * scene.gravity[None]
    for load in scene.point_forces:
        force -= jnp.where(s > load.at, 1.0, 0.0)[:, None] * load.force[None]
    # At least a turn by 1 rad, so that a rod without loads has its stations equally spaced.
    rate = jnp.sqrt(jnp.sqrt(jnp.sum(force**2, axis=1)) + (guess.curvature * units.length) ** 2 + 1)
    steps = (rate[1:] + rate[:-1]) / 2 * jnp.diff(s)
    return force, jnp.concatenate([jnp.zeros_like(s[:1]), jnp.cumsum(steps)])


@jax.jit
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
    """Stations where errors grow equally from each to the next and at the point forces, their values from a guess."""
    fixed, fixed_units = jax.lax.stop_gradient((scene, units))
    x = guess.s / guess.s[-1]
    node_force, growth = _growth_along(fixed, guess, fixed_units)
    grid = jnp.interp(jnp.linspace(0.0, growth[-1], intervals + 1, dtype=x.dtype), growth, x)
    grid = grid.at[0].set(0.0).at[-1].set(1.0)
    unsorted = jnp.concatenate([grid, *(load.at[None] for load in scene.point_forces)])
    # A stable sort: a force on an end comes behind s = 0 and s = L, and so is part of what the rod exerts there.
    order = jnp.argsort(unsorted, stable=True)
    s = unsorted[order]
    steps = [jnp.zeros((len(grid), 3), x.dtype), *(load.force[None] for load in scene.point_forces)]
    force_steps = jnp.concatenate(steps)[order]

    fixed_s = jax.lax.stop_gradient(s)
    reference = _frames_between(x, guess.frames, guess.total_twist, fixed_s)
    tangents = guess.tangents
    moments = jnp.cross(tangents, _differences(tangents) / _differences(x)[:, None])
    ends = (guess.start_moment / fixed_units.energy, guess.end_moment / fixed_units.energy)
    moments = moments.at[0].set(ends[0]).at[-1].set(ends[1])
    across = moments - jnp.sum(moments * tangents, axis=1)[:, None] * tangents
    moments = across + fixed.rod.GJ * guess.total_twist * tangents
    force = jnp.stack([jnp.interp(fixed_s, x, component) for component in node_force.T], axis=1)
    moment = jnp.stack([jnp.interp(fixed_s, x, component) for component in moments.T], axis=1)
    position = (guess.position_at(fixed_s * guess.s[-1]) - fixed_units.origin[None]) / fixed_units.length
    force_scale, moment_scale = (jnp.maximum(1.0, jnp.sqrt(jnp.max(jnp.sum(v**2, axis=1)))) for v in (force, moment))
    stations = Stations(position, jnp.zeros_like(position), force / force_scale, moment / moment_scale)
    return Start(stations, s, force_steps, reference, force_scale, moment_scale)


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
    """The result in SI units, integrated from each station to the nodes behind it."""
    scaled, units = nondimensional(scene)
    rod = scaled.rod
    sections = start.sections(stations)
    # Nodes, and the middles between them for what a discrete solve begins with.
    equal = jnp.linspace(0.0, 1.0, segments + 1, dtype=start.s.dtype)
    s = HermiteElements.of(scaled, equal).places
    station = jnp.searchsorted(start.s, s, side="right") - 1
    before = jax.tree.map(lambda leaf: leaf[station], sections)
    length = s - start.s[station]
    intervals = _intervals(scaled, start, sections)
    to_nodes = jax.vmap(functools.partial(_piece, scaled))(before, length)
    pieces = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), intervals, to_nodes)
    reached = jax.vmap(functools.partial(far_end, rtol))(pieces)
    ends, node_ends = (
        jax.tree.map(lambda leaf, cut=cut: leaf[cut], reached)
        for cut in (slice(len(start.s) - 1), slice(len(start.s) - 1, None))
    )
    points = jax.vmap(functools.partial(_beyond, scaled))(before, length, node_ends)
    s, nodes = s[::2], jax.tree.map(lambda leaf: leaf[::2], points)
    first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], sections) for k in (0, -1))

    residual = jnp.max(jnp.abs(ravel_pytree(_residual(scaled, start, stations, ends))[0]))
    status = jnp.where(residual < TOLERANCE, Status.CONVERGED, Status.MAX_ITERATIONS)
    status = jnp.where(jnp.isfinite(residual), status, Status.NOT_FINITE)

    twist = first.torque / rod.GJ
    elastic_energy = jnp.sum(ends.elastic_energy) + density(rod, twist=twist)
    # Potentials are zero at the global origin, not at that of the units.
    shift = units.origin / units.length
    energy = elastic_energy
    if scaled.gravity is not None:
        heights = sections.position[:-1] + shift[None]
        by_station = jax.vmap(functools.partial(dead_load_energy, scaled.gravity))(heights)
        energy += jnp.sum(ends.weight_energy + jnp.diff(start.s) * by_station)
    if scaled.point_forces:
        energy += jnp.sum(jax.vmap(dead_load_energy)(start.force_steps, sections.position + shift[None]))
    for end, section in ((scaled.start, first), (scaled.end, last)):
        if isinstance(end, Free) and end.force is not None:
            energy += dead_load_energy(end.force, section.position + shift)

    moments = jax.vmap(lambda node: node.moment - node.torque * node.tangent)(nodes)
    tension = jax.vmap(lambda node: jnp.sum(node.force * node.tangent))(nodes)
    none = jnp.zeros((), int)
    return Equilibrium(
        s=s * scene.rod.length,
        nodes=units.origin[None] + units.length * nodes.position,
        frames=nodes.frame,
        curvature=jax.vmap(_norm)(moments) / rod.EI / units.length,
        twist=jnp.full_like(s, twist / units.length),
        total_twist=twist,
        tension=tension * units.force,
        axial_strain=axial_strain_under(rod, tension),
        energy=energy * units.energy,
        elastic_energy=elastic_energy * units.energy,
        start_force=first.force * units.force,
        start_moment=first.moment * units.energy,
        end_force=last.force * units.force,
        end_moment=last.moment * units.energy,
        converged=is_converged(status),
        stable=jnp.zeros((), bool),
        status=status,
        iterations=jnp.asarray(iterations),
        evaluations=jnp.asarray(iterations) + 1,
        substeps=none + 1,
        residual=residual,
        scene=scene,
        state=_warm_start(scaled, s, points, last, units),
        discretization="continuum",
    )


def _warm_start(scene: Scene, s: Float[Array, "n+1"], points: Section, last: Section, units: Units) -> SolverState:
    """What a discrete solve from here begins with."""
    is_held = isinstance(scene.start, Held) and isinstance(scene.end, Held)
    end_force = last.force if is_held else jnp.zeros_like(last.force)
    return SolverState(Curve(points.position[::2], points.frame[..., 2].T, s), end_force, units)


def _norm(vector: Float[Array, "3"]) -> Float[Array, ""]:
    return root(jnp.sum(vector**2))


def rotation_of(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The rotation of a quaternion (w, x, y, z) of any length."""
    w, x, y, z = quaternion
    matrix = jnp.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    return matrix / jnp.sum(quaternion**2)


def _quaternion_rate(quaternion: Float[Array, "4"], rate: Float[Array, "3"]) -> Float[Array, "4"]:
    """Derivative of a quaternion whose axes turn at `rate`, in fixed axes."""
    w, v = quaternion[0], quaternion[1:]
    return jnp.concatenate([-jnp.sum(rate * v)[None], w * rate + jnp.cross(rate, v)]) / 2


def from_rodrigues(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation of a Rodrigues vector 2 tan(angle/2) axis."""
    return rotation_of(jnp.concatenate([jnp.full_like(turn[:1], 2.0), turn]))


def turn_between(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Rodrigues vector of the rotation from frame a to frame b, in the axes of a."""
    R = a.T @ b
    return 2 * jnp.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (1 + jnp.trace(R))


def _about_tangent(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """What turns a frame about its t, from the right."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.array([[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]])
