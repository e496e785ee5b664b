"""Multiple shooting: what continuous rods have in common, whether tangents suffice or frames are needed.

The unknowns are cross sections at stations along the rod. Between two stations a rod is integrated by its own equations
(`continuum`, `continuum_frames`); where it does not meet the next station, or misses a support, there is a residual.

A clip has a station of its own, just beyond it. There the rod may jump in force, and so meets the position of the clip
instead; where the clip holds the tangent, the moment across it may jump, and the tangent is met. No unknown is added,
but where the rod slides: the arclength of the station.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from rodjax.discretization.forms import form_of
from rodjax.discretization.section_loads import section_loads
from rodjax.discretization.shape import Shape
from rodjax.mechanics.energy import dead_load_energy
from rodjax.model.along import Along
from rodjax.model.loads import DistributedForce, PointCouple, Potential, acting, densities, per_length
from rodjax.model.scene import (
    Scene,
    dead_forces,
    has_free_ends,
    has_node_positions,
    held_at_both_ends,
    loads_at_nodes,
    nondimensional,
    slid,
)
from rodjax.model.supports import Clamp, Free, Held, Support, Swivel
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium
from rodjax.solving.result_form import form_and_point
from rodjax.solving.solver_state import SolverState
from rodjax.solving.status import Status, is_converged, with_strain
from rodjax.units import Units

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


class Section(eqx.Module):
    """Cross sections: position, material frame, n and m on them, global axes."""

    position: Float[Array, "*k 3"]
    frame: Float[Array, "*k 3 3"]
    force: Float[Array, "*k 3"]
    moment: Float[Array, "*k 3"]

    @property
    def tangent(self) -> Float[Array, "*k 3"]:
        return self.frame[..., 2]

    @property
    def torque(self) -> Float[Array, "*k"]:
        return jnp.sum(self.moment * self.tangent, axis=-1)

    @property
    def tension(self) -> Float[Array, "*k"]:
        return jnp.sum(self.force * self.tangent, axis=-1)


class Fields(eqx.Module):
    """Fields of forces in the axes of a cross section, from its position on; `acts`: 1 where they do beyond it."""

    potentials: tuple[Potential, ...]
    acts: Float[Array, "fields"]
    position: Float[Array, "3"]
    frame: Float[Array, "3 3"]

    @staticmethod
    def beyond(scene: Scene, section: Section, middle: Float[Array, ""]) -> "Fields | None":
        """`middle`: of the interval in which nothing jumps; `None` where the scene has none."""
        if not scene.potentials:
            return None
        return Fields(scene.potentials, acting(scene.potentials, middle), section.position, section.frame)

    def energy_and_slope(
        self, position: Float[Array, "3"], s: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, "3"]]:
        """Per length, and its derivatives by the position: the force is the reverse."""

        def energy(position: Float[Array, "3"]) -> Float[Array, ""]:
            there = self.position + self.frame @ position
            return jnp.sum(self.acts * densities(self.potentials, there, s))

        return jax.value_and_grad(energy)(position)


class Stations(eqx.Module):
    """The unknowns, and the residuals between them. Forces and moments in units of the `Start`'s scales.

    `turn`: Rodrigues vector 2 tan(angle/2) axis of the rotation from the guess's material frame, in the axes of that;
    its pole, half a turn, is far from an equilibrium near the guess. `arclengths`: of the sliding clips, and in
    residuals what these apply to the rod along its tangent; `None` where there are none.
    """

    position: Float[Array, "k 3"]
    turn: Float[Array, "k 3"]
    force: Float[Array, "k 3"]
    moment: Float[Array, "k 3"]
    arclengths: Float[Array, "slides"] | None = None


class Start(eqx.Module):
    """Where Newton begins, with what stays fixed while it runs.

    `s`: arclengths of the stations; `force_steps`: dead point forces at each of them; `clips`: the numbers of those at
    clips, where there are clips, and `loaded` of those at other loads at a point.
    """

    stations: Stations
    s: Float[Array, "k"]
    force_steps: Float[Array, "k 3"]
    reference: Float[Array, "k 3 3"]
    force_scale: Float[Array, ""]
    moment_scale: Float[Array, ""]
    clips: Int[Array, "clips"] | None = None
    loaded: Int[Array, "loads"] | None = None

    @staticmethod
    def near(
        guess: Equilibrium,
        units: Units,
        at: "StationPlaces",
        frames: Float[Array, "k 3 3"],
        force: Float[Array, "k 3"],
        moment: Float[Array, "k 3"],
        arclengths: Float[Array, "slides"] | None = None,
    ) -> "Start":
        """On the centerline of a guess, with its frames, forces and moments at the stations, nondimensional."""
        position = (guess.position_at(jax.lax.stop_gradient(at.s) * guess.s[-1]) - units.origin[None]) / units.length
        force_scale, moment_scale = (
            jnp.maximum(1.0, jnp.sqrt(jnp.max(jnp.sum(v**2, axis=1)))) for v in (force, moment)
        )
        turn = jnp.zeros_like(position)
        stations = Stations(position, turn, force / force_scale, moment / moment_scale, arclengths)
        return Start(stations, at.s, at.force_steps, frames, force_scale, moment_scale, at.clips, at.loaded)

    def sections(self, stations: Stations) -> Section:
        """The cross sections at the stations, each just beyond its point force."""
        frames = self.reference @ jax.vmap(from_rodrigues)(stations.turn)
        return Section(
            stations.position, frames, self.force_scale * stations.force, self.moment_scale * stations.moment
        )

    def slid(self, scene: Scene, stations: Stations) -> tuple[Scene, "Start"]:
        """With the sliding clips where the stations have them."""
        if stations.arclengths is None:
            return scene, self
        assert self.clips is not None
        sliding = np.array([k for k, clip in enumerate(scene.clips) if clip.sliding])
        s = self.s.at[self.clips[sliding]].set(stations.arclengths)
        return slid(scene, stations.arclengths), eqx.tree_at(lambda start: start.s, self, s)


def forces_at_nodes(guess: Equilibrium, units: Units) -> Float[Array, "n+1 3"]:
    """On a mesh of elements, through the rod beyond each node, in other units than those of the guess."""
    forces, _ = section_loads(*form_and_point(guess))
    scale = guess.state.units.force / units.force
    return scale * jnp.concatenate([forces[:, 0], forces[:, 1, -1:]], axis=1).T


def places_of_sliding_clips(guess: Equilibrium) -> Float[Array, "slides"]:
    """As parts of the length."""
    return jnp.stack([clip.at for clip in guess.scene.clips if clip.sliding]) / guess.scene.rod.length


def error_growth(
    s: Float[Array, "n+1"], force_size: Float[Array, "n+1"], squared_strain: Float[Array, "n+1"]
) -> Float[Array, "n+1"]:
    """int sqrt(|n| + |strain|^2) ds from the start to s: errors grow by the exponential of it."""
    # At least a turn by 1 rad, so that a rod without loads has its stations equally spaced.
    rate = jnp.sqrt(force_size + squared_strain + 1)
    steps = (rate[1:] + rate[:-1]) / 2 * jnp.diff(s)
    return jnp.concatenate([jnp.zeros_like(s[:1]), jnp.cumsum(steps)])


class StationPlaces(NamedTuple):
    """Names as in `Start`."""

    s: Float[Array, "k"]
    force_steps: Float[Array, "k 3"]
    clips: Int[Array, "clips"] | None
    loaded: Int[Array, "loads"] | None


def station_arclengths(
    scene: Scene,
    s: Float[Array, "n+1"],
    growth: Float[Array, "n+1"],
    intervals: int,
    jumps: Sequence[Float[Array, "j"]] = (),
) -> StationPlaces:
    """Stations between which errors grow equally, at jumps, clips and at the point forces; and these forces."""
    grid = jnp.interp(jnp.linspace(0.0, growth[-1], intervals + 1, dtype=s.dtype), growth, s)
    grid = grid.at[0].set(0.0).at[-1].set(1.0)
    others, forces = loads_at_nodes(scene), dead_forces(scene)
    held = [*scene.clips, *others, *forces]
    unsorted = jnp.concatenate([grid, *jumps, *(each.at[None] for each in held)])
    # A stable sort: a force on an end comes behind s = 0 and s = L, and so is part of what the rod exerts there.
    order = jnp.argsort(unsorted, stable=True)
    without_force = len(unsorted) - len(forces)
    steps = [jnp.zeros((without_force, 3), s.dtype), *(load.force[None] for load in forces)]
    clips, loaded, beyond = None, None, without_force - len(others)
    if scene.clips:
        clips = jnp.argsort(order)[beyond - len(scene.clips) : beyond]
    if others:
        loaded = jnp.argsort(order)[beyond:without_force]
    return StationPlaces(unsorted[order], jnp.concatenate(steps)[order], clips, loaded)


def integrated(
    slope: Callable[[Any, Any, Any], Float[Array, "n"]],
    y0: Float[Array, "n"],
    controller: diffrax.AbstractStepSizeController,
) -> Float[Array, "n"]:
    """y at 1, of y' = slope(u, y, None) from y0 at 0 on; not numbers where the integrator gives up."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),  # pyright: ignore[reportArgumentType]
        diffrax.Dopri8(),
        t0=0.0,
        t1=1.0,
        dt0=FIRST_STEP,
        y0=y0,
        stepsize_controller=controller,
        adjoint=diffrax.ForwardMode(),
        max_steps=MAX_STEPS,
        throw=False,
    )
    is_done = solution.result == diffrax.RESULTS.successful
    assert solution.ys is not None
    return jnp.where(is_done, solution.ys[-1], jnp.nan)


def met(
    residual: Callable[[Stations, tuple[Scene, Start]], Any], scene: Scene, start: Start, *, is_resisted: bool
) -> tuple[Stations, Any]:
    """The stations at which nothing is missed, and the iterations of Newton's method.

    `is_resisted`: whether no motion of the rod is without resistance; else the smallest step is the one to take.
    """
    linear_solver = lx.LU() if is_resisted else lx.SVD(rcond=RANK_TOLERANCE)
    found = optx.root_find(
        residual,
        optx.Newton(rtol=TOLERANCE, atol=TOLERANCE, linear_solver=linear_solver),
        start.stations,
        (scene, start),
        max_steps=MAX_ITERATIONS,
        adjoint=optx.ImplicitAdjoint(linear_solver),
        throw=False,
    )
    return found.value, found.stats["num_steps"]


def misses(
    scene: Scene, start: Start, sections: Section, reached: Section
) -> tuple[Stations, Float[Array, "6"], Float[Array, "6"]]:
    """What is missed between the sections at the stations and those `reached` from each before, and at the supports.

    Of a clip the missed position takes the place of a force, the missed tangent that of the moments across it.
    """
    after = jax.tree.map(lambda leaf: leaf[1:], sections)
    gaps = Stations(
        position=after.position - reached.position,
        turn=jax.vmap(turn_between)(reached.frame, after.frame),
        force=(after.force + start.force_steps[1:] - reached.force) / start.force_scale,
        moment=(after.moment - reached.moment) / start.moment_scale,
    )
    if start.loaded is not None:
        gaps = _with_loads(scene, start, gaps, after)
    if scene.clips:
        gaps = _with_clips(scene, start, gaps, after, reached)
    first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], sections) for k in (0, -1))
    return gaps, _missed_support(scene.start, start, first, -1.0), _missed_support(scene.end, start, last, 1.0)


def _with_loads(scene: Scene, start: Start, gaps: Stations, after: Section) -> Stations:
    """With couples and forces that follow the rod at stations."""
    assert start.loaded is not None
    force, moment = gaps.force, gaps.moment
    for load, number in zip(loads_at_nodes(scene), start.loaded, strict=True):
        value = load.couple if isinstance(load, PointCouple) else load.force
        value = after.frame[number - 1] @ value if load.follower else value
        if isinstance(load, PointCouple):
            moment = moment.at[number - 1].add(value / start.moment_scale)
        else:
            force = force.at[number - 1].add(value / start.force_scale)
    return Stations(gaps.position, gaps.turn, force, moment, gaps.arclengths)


def _with_clips(scene: Scene, start: Start, gaps: Stations, after: Section, reached: Section) -> Stations:
    assert start.clips is not None
    force, moment, axial_forces = gaps.force, gaps.moment, []
    for k, clip in enumerate(scene.clips):
        gap = start.clips[k] - 1
        here, before = (jax.tree.map(lambda leaf, gap=gap: leaf[gap], sections) for sections in (after, reached))
        force = force.at[gap].set(here.position - clip.position)
        if clip.frame is not None:
            moment = moment.at[gap].set(turn_between(clip.frame, here.frame))
        elif clip.tangent is not None:
            torque = (here.torque - before.torque) / start.moment_scale
            moment = moment.at[gap].set(jnp.append(here.frame[:, :2].T @ clip.tangent, torque))
        if clip.sliding:
            axial_forces.append(jnp.sum((before.force - here.force) * here.tangent) / start.force_scale)
    return Stations(gaps.position, gaps.turn, force, moment, jnp.stack(axial_forces) if axial_forces else None)


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


# --- the result ------------------------------------------------------------------------------------------------------


class Reached(eqx.Module):
    """What the integration from the stations on gives, nondimensional: cross sections at the ends of the intervals and
    at the nodes, strains there, and energies. `load_energy`: of the loads along the rod, of dead ones as if each
    interval began at the origin; `missed`: between stations and at supports; `shape`: what a discrete solve begins
    with.
    """

    s: Float[Array, "n+1"]
    nodes: Section
    curvature: Float[Array, "n+1"]
    twist: Float[Array, "n+1"]
    axial_strain: Float[Array, "n+1"]
    total_twist: Float[Array, ""]
    elastic_energy: Float[Array, ""]
    load_energy: Float[Array, ""]
    missed: Any
    shape: Shape
    intervals: Section
    shear_strain: Float[Array, "n+1 2"] | None = None


def equilibrium(scene: Scene, start: Start, stations: Stations, iterations: Any, reached: Reached) -> Equilibrium:
    """The result in SI units."""
    if stations.arclengths is not None:
        scene = slid(scene, stations.arclengths * scene.rod.length)
    scaled, units = nondimensional(scene)
    sections = start.sections(stations)
    first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], sections) for k in (0, -1))
    residual = jnp.max(jnp.abs(ravel_pytree(reached.missed)[0]))
    status = jnp.where(residual < TOLERANCE, Status.CONVERGED, Status.MAX_ITERATIONS)
    status = jnp.where(jnp.isfinite(residual), status, Status.NOT_FINITE)
    status = with_strain(status, reached.axial_strain, DEFAULT_STRAIN_LIMIT)
    # Of types that do not yield to others, as NumPy code needs them.
    status, iterations = (jnp.asarray(number, int) for number in (status, iterations))
    # Potentials are zero at the global origin, not at that of the units.
    from_origin = sections.position + (units.origin / units.length)[None]
    energy = reached.elastic_energy + reached.load_energy + _energy_at(scaled, start, from_origin)
    nodes = reached.nodes
    end_force = (last.force if held_at_both_ends(scene) else jnp.zeros_like(last.force))[:, None]
    clip_moments = None
    if scene.clips:
        assert start.clips is not None
        before, beyond = reached.intervals, sections
        forces, moments = (
            each[start.clips - 1] - other[start.clips]
            for each, other in ((before.force, beyond.force), (before.moment, beyond.moment))
        )
        end_force = _seen_by_spans(scene, end_force, forces.T)
        is_directed = np.array([clip.direction is not None for clip in scene.clips])
        clip_moments = jnp.where(is_directed[:, None], moments, 0.0)
    if has_node_positions(scene):
        point = reached.shape.point(end_force, reached.total_twist)
        end_force = form_of(scaled, reached.shape).begun(point, nodes.position, None, None).end_force
    return Equilibrium(
        s=reached.s * scene.rod.length,
        nodes=units.origin[None] + units.length * nodes.position,
        frames=nodes.frame,
        curvature=reached.curvature / units.length,
        twist=reached.twist / units.length,
        total_twist=reached.total_twist,
        tension=nodes.tension * units.force,
        axial_strain=reached.axial_strain,
        energy=energy * units.energy,
        elastic_energy=reached.elastic_energy * units.energy,
        start_force=first.force * units.force,
        start_moment=first.moment * units.energy,
        end_force=last.force * units.force,
        end_moment=last.moment * units.energy,
        converged=is_converged(status),
        stable=jnp.zeros((), bool),
        status=status,
        iterations=iterations,
        evaluations=iterations + 1,
        substeps=jnp.ones((), int),
        residual=residual,
        scene=scene,
        state=SolverState(reached.shape, end_force, units, stations.arclengths, clip_moments),
        discretization="continuum",
        shear_strain=reached.shear_strain,
    )


def _seen_by_spans(
    scene: Scene, end_force: Float[Array, "3 1"], clip_forces: Float[Array, "3 clips"]
) -> Float[Array, "3 spans"]:
    """The force at s = L as each span sees it, with those of the clips beyond; where the start is free, zero in the
    first, and with those before where the end is held.
    """
    if isinstance(scene.start, Free) and not has_free_ends(scene):
        return jnp.pad(-jnp.cumsum(clip_forces, axis=1), ((0, 0), (1, 0)))
    seen = end_force + jnp.pad(jnp.cumsum(clip_forces[:, ::-1], axis=1)[:, ::-1], ((0, 0), (0, 1)))
    return seen.at[:, 0].set(0.0) if has_free_ends(scene) else seen


def _energy_at(scene: Scene, start: Start, positions: Float[Array, "k 3"]) -> Float[Array, ""]:
    """The potential of the dead loads on each interval as if all of it were at its beginning, and of those on points
    and ends.
    """
    energy = jnp.zeros_like(positions[0, 0])
    by_interval = []
    if scene.gravity is not None:
        mass = scene.rod.mass_per_length
        before = mass.integral(start.s) if isinstance(mass, Along) else start.s
        by_interval.append(jnp.diff(before)[:, None] * scene.gravity[None])
    dead_force = sum_of_loads(scene, DistributedForce, False, (start.s[:-1] + start.s[1:]) / 2)
    if dead_force is not None:
        by_interval.append(jnp.diff(start.s)[:, None] * dead_force.T)
    for forces in by_interval:
        energy += jnp.sum(jax.vmap(dead_load_energy)(forces, positions[:-1]))
    if scene.point_forces:
        energy += jnp.sum(jax.vmap(dead_load_energy)(start.force_steps, positions))
    for end, position in ((scene.start, positions[0]), (scene.end, positions[-1])):
        if isinstance(end, Free) and end.force is not None and not end.follower:
            energy += dead_load_energy(end.force, position)
    return energy


def sum_of_loads(scene: Scene, kind: type, follower: bool, s: Float[Array, "*k"]) -> Float[Array, "3 *k"] | None:
    """Of the loads of one kind along the rod, per length, at arclengths that are none of those where a part ends."""
    loads = [load for load in scene.distributed if isinstance(load, kind) and load.follower == follower]
    values = [per_length(load, s) for load in loads]
    return sum(values[1:], values[0]) if values else None


# --- rotations as matrices -------------------------------------------------------------------------------------------


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


def from_rodrigues(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation of a Rodrigues vector 2 tan(angle/2) axis."""
    return rotation_of(jnp.concatenate([jnp.full_like(turn[:1], 2.0), turn]))


def turn_between(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Rodrigues vector of the rotation from frame a to frame b, in the axes of a."""
    R = a.T @ b
    return 2 * jnp.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (1 + jnp.trace(R))
