"""The equilibrium of a scene whose ends have known poses."""

import dataclasses
import functools
import math
import typing
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import instance, is_known, leaf, one_of, positive, whole_number
from rodjax.discretization.cells import segments_for_jumps
from rodjax.discretization.contact_gaps import pressure_rows
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.first_shape import first_shape
from rodjax.discretization.first_twist import FirstTwist, last_of
from rodjax.discretization.form import Form, Point
from rodjax.discretization.forms import field_of, form_of
from rodjax.discretization.frame_point import FramePoint
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_curve import FramedCurve, first_frames, framed_through, rest_twist
from rodjax.discretization.hermite import Curve, QuadraticRotationElements
from rodjax.discretization.layout import force_parts, in_parts
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.nodal_point import Friction
from rodjax.discretization.nodes import LEAST_ELEMENT
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.geometry.interpolation import resampled
from rodjax.mechanics.passage import SAMPLES, Before, passage
from rodjax.model.plane import check_planar, is_planar, plane
from rodjax.model.scene import (
    Scene,
    dead_end_moment,
    has_contacts,
    has_friction,
    has_no_place,
    has_node_positions,
    has_potential,
    needs_frames,
    nondimensional,
    slid,
    slides,
    sliding_arclengths,
    with_plain_rod,
)
from rodjax.model.supports import Clamp
from rodjax.notes import note
from rodjax.programs.compilation import compiled
from rodjax.solving.guess import Guess, beside_obstacles, other_guess
from rodjax.solving.implicit import differentiable, not_differentiated
from rodjax.solving.loading import found_under_loads
from rodjax.solving.newton import Find, Newton, NewtonEnd, find_equilibrium, is_stable
from rodjax.solving.nonlinear_cg import NonlinearCG, minimize
from rodjax.solving.penetration import sampled
from rodjax.solving.ranges import check_ranges, with_ranges
from rodjax.solving.refinement import (
    SAFETY,
    SHORTEST_IN_CONTACT,
    SIZES,
    Depth,
    error_by_rtol,
    first_size,
    graded,
    next_size,
    normalized,
)
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium, build_result
from rodjax.solving.result_errors import estimated_errors
from rodjax.solving.result_warnings import (
    NotConvergedWarning,
    warn_if_coarse,
    warn_of_outcome,
    warn_of_single_precision,
    warn_of_unknown_mesh,
)
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.status import Outcome, Status, is_converged
from rodjax.units import Units
from rodjax.warn import warn

Solver = Newton | NonlinearCG
Discretization = Literal["finite_difference", "hermite"]

# Shapes that differ by so many roundings are the same.
SAME_SHAPE = 64

DEFAULT_SOLVER = Newton()
DEFAULT_RTOL = 1e-3
# A smaller error than this drowns in the residual of 1e-8 EI/L^2 at which a solve stops.
LEAST_RTOL = 1e-10
LEAST_SEGMENTS = {"finite_difference": 2, "hermite": 1}
# At least so many in the span between two clips, on average, of the first mesh.
SPAN_SEGMENTS = 10
# The same beside obstacles: on fewer a rod that touches takes many iterations, and then finer meshes.
CONTACT_SEGMENTS = 32
# Of the only mesh inside jit, where no error can be looked at.
TRACED_SEGMENTS = {"finite_difference": 50, "hermite": 32}
# A scene that does not converge on so many meshes in turn would not on others, each of which takes seconds to compile.
MOST_FAILURES = 3
# Where no finer mesh has an equilibrium, that of a coarser one is one if the rod lies no deeper than this part of its
# radius within an obstacle between nodes.
MOST_DEPTH_LEFT = 0.05
# On so many meshes at most a rod slides through its clips.
MOST_MESHES = 12
# Beyond this a mesh is taken for a mistake: two nodes of a rod 100 m long would be closer than a millimetre.
MAX_SEGMENTS = 100_000


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["solver"],
    meta_fields=["segments", "discretization", "planar", "find"],
)
@dataclasses.dataclass(frozen=True)
class Options:
    """How a scene is solved, and on what mesh: all that a compiled program depends on besides the scene's structure,
    but for the numbers of the solver, which it is given.
    """

    segments: int
    discretization: Discretization
    solver: Solver
    planar: bool = False
    find: Find = "minimum"


def solve_scene(
    scene: Scene,
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | None = None,
    planar: bool = False,
    find: Find = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
) -> Equilibrium:
    """The equilibrium of a scene whose ends have known poses: see `rodjax.solving.solve.solve`."""
    instance(scene, "scene", Scene)
    if scene.rod.length.ndim:
        raise ValueError(
            f"scene must be a single scene, got a stack of shape {scene.rod.length.shape}; "
            "solve_path takes scenes one after another, jax.vmap(solve) independent ones"
        )
    fixed_scene, guess = not_differentiated(scene, guess)
    if fixed_scene is not scene:  # it was made of numbers that nobody knew
        check_ranges(fixed_scene)
    check_single(guess)
    options, rtol = checked_options(fixed_scene, segments, rtol, discretization, solver, guess, planar, find)
    strain_limit = checked_strain_limit(strain_limit)
    note(f"solving on {options.segments} segments")
    result = _solve(fixed_scene, *first_state(fixed_scene, guess, options), strain_limit, options)
    if is_known(result.status):
        if guess is None and fixed_scene.obstacles and not result.converged:
            result = _from_another_shape(result, fixed_scene, options, strain_limit)
        result = _looked_at(result) if rtol is None else _refined(result, options, rtol, strain_limit)
    if fixed_scene is not scene:
        result = with_ranges(fixed_scene, result)
    warn_of_outcome(result, strain_limit)
    return result if fixed_scene is scene else differentiable(scene, result)


def _from_another_shape(
    result: Equilibrium, scene: Scene, options: Options, strain_limit: Float[Array, ""] | float
) -> Equilibrium:
    """Found from another shape, where the search from the scene's own found nothing beside its obstacles; else the
    result as it is.
    """
    shape = other_guess(scene, planar=options.planar) if options.find == "minimum" else None
    if shape is None:
        return result
    note("solving again, from another shape")
    other = _solve(scene, *first_state(scene, shape, options), strain_limit, options)
    return _with_effort_of(other, result) if other.converged else result


def _with_effort_of(last: Equilibrium, before: Equilibrium) -> Equilibrium:
    return eqx.tree_at(
        lambda result: (result.iterations, result.evaluations),
        last,
        (_sum(last.iterations, before.iterations), _sum(last.evaluations, before.evaluations)),
    )


def _looked_at(result: Equilibrium) -> Equilibrium:
    """On a mesh that was given."""
    warn_if_coarse(result)
    return result


def _refined(result: Equilibrium, options: Options, rtol: float, strain_limit: Float[Array, ""] | float) -> Equilibrium:
    """Solved again, each time from the last, on meshes of more segments until the estimated error is below `rtol`, and
    contacts press the rod in between its nodes no deeper than at them.
    """
    failures, depth, last = 0, Depth(), None
    while True:
        failures = 0 if result.converged else failures + 1
        errors = estimated_errors(result)
        error = float(error_by_rtol(errors))
        relative_penetration = depth.lacking(errors, options.segments)
        depths = np.zeros(1) if errors.depths is None else np.asarray(errors.depths)
        if result.converged and np.max(depths) < MOST_DEPTH_LEFT:
            last = result, error, options
        is_fine = bool(result.converged) and max(SAFETY * error / rtol, relative_penetration) <= 1
        if is_fine or _is_finest(options) or failures == MOST_FAILURES:
            break
        defects = errors.defects
        if relative_penetration and defects is not None and errors.depths is not None:
            defects = SAFETY * error / rtol * normalized(defects) + relative_penetration * normalized(errors.depths)
        lacking = max(error, relative_penetration * rtol / SAFETY) if result.converged else np.nan
        options = dataclasses.replace(
            options, segments=next_size(options.segments, lacking, rtol, options.discretization)
        )
        note(f"solving on {options.segments} segments, as the estimated error is {error:.1e} for rtol = {rtol:g}")
        finer = _solve(result.scene, _finer(result, defects, options), last_twist(result), strain_limit, options)
        result = _with_effort_of(finer, result)
    if last is not None:
        # Where no finer mesh had an equilibrium, that of the finest which had one.
        mesh = "the finest mesh" if result is last[0] else "the finest mesh with an equilibrium"
        result, error, options = last
        _warn_if_inaccurate(error, rtol, options, mesh=mesh)
    return result


def _sum(a: Int[Array, ""], b: Int[Array, ""]) -> Int[Array, ""]:
    """Of counts that are known; JAX would compile a program."""
    return leaf(np.asarray(a) + np.asarray(b))


def refined_together(
    solve: Callable[[Options, Equilibrium | None], Equilibrium], options: Options, rtol: float | None
) -> Equilibrium:
    """Many equilibria on one mesh: all solved again until the estimated error of those that converged is below `rtol`,
    and contacts press them in no deeper between nodes than at them.

    `solve` is given the options and what it found with the last ones.
    """
    result, depth = solve(options, None), Depth()
    if rtol is None and is_here(result):
        return _looked_at(result)
    while rtol is not None and is_here(result):
        errors, converged = estimated_errors(result), np.asarray(result.converged)
        sizes = error_by_rtol(errors)
        error = float(np.max(sizes[converged], initial=0.0))
        relative_penetration = depth.lacking(errors, options.segments, converged)
        if max(SAFETY * error / rtol, relative_penetration) <= 1 or _is_finest(options):
            missed = int(np.sum(converged & ~(sizes <= rtol)))
            _warn_if_inaccurate(error, rtol, options, f" in {missed} of {sizes.size} cases")
            break
        lacking = max(error, relative_penetration * rtol / SAFETY)
        options = dataclasses.replace(
            options, segments=next_size(options.segments, lacking, rtol, options.discretization)
        )
        note(f"solving all on {options.segments} segments, as the largest estimated error is {error:.1e}")
        result = solve(options, result)
    return result


def is_here(result: Equilibrium) -> bool:
    """Whether its numbers are known, and this process holds all of them."""
    return is_known(result) and result.s.is_fully_addressable


def _is_finest(options: Options) -> bool:
    return options.segments >= SIZES[options.discretization][-1]


def _warn_if_inaccurate(
    error: float, rtol: float, options: Options, where: str = "", mesh: str = "the finest mesh"
) -> None:
    if not error <= rtol:
        warn(
            f"the estimated error {error:.1e} (of the shape, or a tenth of that of forces, moments or curvature) is "
            f"above rtol = {rtol:g}{where} on {mesh}, of {options.segments} segments",
            NotConvergedWarning,
        )


@compiled
def _finer(coarse: Equilibrium, defects: Float[Array, "n"] | None, options: Options) -> SolverState:
    """On a mesh of more segments; elements where the coarse solution, if it is one, shows defects."""
    state = coarse.state
    shape, shortest = state.shape, SHORTEST_IN_CONTACT if coarse.scene.obstacles else 0.0
    if isinstance(shape, FramedCurve):
        s = jnp.linspace(0.0, 1.0, options.segments + 1, dtype=shape.s.dtype)
        if defects is not None:
            is_usable = coarse.converged & jnp.all(jnp.isfinite(defects))
            s = graded(shape.s, jnp.where(is_usable, defects, 1.0), options.segments, shortest)
        shape = shape.on(s, shape.is_of_joints)
    elif isinstance(shape, Curve) and defects is not None:
        is_usable = coarse.converged & jnp.all(jnp.isfinite(defects))
        shape = shape.on(graded(shape.s, jnp.where(is_usable, defects, 1.0), options.segments, shortest))
    else:
        shape = Polyline.through(shape.points(options.segments))
    end_force = state.end_force
    if has_node_positions(coarse.scene):
        assert isinstance(state.shape, Curve | FramedCurve)
        assert isinstance(shape, Curve | FramedCurve)
        end_force = _of_elements(end_force, state.shape.s, shape.s)
    shape, end_force = _on_its_side(coarse.scene, coarse, shape, end_force)
    pressures = _pressures(coarse.scene, options)
    friction = _friction_on(state.friction, state.shape, shape, state.units)
    return SolverState(
        shape, end_force, state.units, state.arclengths, before=state.before, pressures=pressures, friction=friction
    )


def _on_its_side(
    scene: Scene, last: Equilibrium, shape: Shape, end_force: Float[Array, "3 parts"]
) -> tuple[Shape, Float[Array, "3 parts"]]:
    """What a solve on another mesh begins from: where the last one came through an obstacle, what that began from."""
    state = last.state
    if state.before is None or not isinstance(shape, Curve | FramedCurve):
        return shape, end_force
    points = (state.before.points - state.units.origin[None]) / state.units.length
    points = resampled(points, 2 * (len(shape.s) - 1))
    if isinstance(shape, Curve):
        begin = Curve.through(points).on(shape.s)
    else:
        begin = framed_through(nondimensional(scene)[0], points, of_joints=False).on(shape.s, of_joints=False)
    is_lost = last.status == Status.PASSED_THROUGH
    return (
        jax.tree.map(lambda old, new: jnp.where(is_lost, old, new), begin, shape),
        jnp.where(is_lost, 0.0, end_force),
    )


def _before(scene: Scene, guess: Guess | Equilibrium | None) -> Before | None:
    """Where the rod was when it last was sound; not a number where that is to be the first shape of the search."""
    if not scene.obstacles:
        return None
    last = guess.state.before if isinstance(guess, Equilibrium) else None
    if last is None:
        return Before(jnp.full((SAMPLES, 3), jnp.nan, scene.rod.length.dtype), scene.obstacles)
    shapes = [jax.tree.map(jnp.shape, obstacles) for obstacles in (last.obstacles, scene.obstacles)]
    return last if eqx.tree_equal(*shapes) else Before(last.points, scene.obstacles)


def _pressures(scene: Scene, options: Options, state: SolverState | None = None) -> Float[Array, "k n+1"] | None:
    """Those of a state, on its mesh, or no numbers where they are not known."""
    if not has_contacts(scene):
        return None
    shape = (pressure_rows(scene), options.segments + 1)
    if state is not None and state.pressures is not None and state.pressures.shape == shape:
        return state.pressures
    return jnp.full(shape, jnp.nan, scene.rod.length.dtype)


def _lying(scene: Scene, units: Units, nodes: Float[Array, "n+1 3"], friction: Friction | None) -> Friction | None:
    """That of a rod which nothing else holds: it lies where its guess is."""
    if not has_no_place(scene):
        return friction
    return _friction(scene, units.origin[None] + units.length * nodes)


def _from_rest(scene: Scene, options: Options) -> Friction | None:
    nodes = jnp.zeros((options.segments + 1, 3), scene.rod.length.dtype)
    friction = _friction(scene, nodes)
    return None if friction is None else Friction.from_rest(len(friction.forces), nodes)


def _friction(scene: Scene, nodes: Float[Array, "n+1 3"], state: SolverState | None = None) -> Friction | None:
    """Of a step from an equilibrium with these nodes [m], of a state on the same mesh if there is one."""
    if not has_friction(scene):
        return None
    count = sum(obstacle.friction is not None for obstacle in scene.obstacles)
    if state is not None and state.friction is not None and len(state.friction.forces) == count:
        return Friction(state.friction.forces, nodes)
    return Friction(jnp.zeros((count, *nodes.shape), nodes.dtype), nodes)


def _friction_on(friction: Friction | None, coarse: Shape, fine: Shape, units: Units) -> Friction | None:
    """On another mesh: each place has gone as far since the last equilibrium; forces are sought anew."""
    if friction is None:
        return None
    assert isinstance(coarse, Curve | FramedCurve)
    assert isinstance(fine, Curve | FramedCurve)
    gone = units.origin[None] + units.length * coarse.nodes - friction.reference
    gone = jnp.stack([jnp.interp(fine.s, coarse.s, component) for component in gone.T], axis=1)
    reference = units.origin[None] + units.length * fine.nodes - gone
    return Friction(jnp.zeros((len(friction.forces), *reference.shape), reference.dtype), reference)


def _of_elements(
    forces: Float[Array, "3 k"], s: Float[Array, "k+1"], others: Float[Array, "n+1"]
) -> Float[Array, "3 n"]:
    """The forces in elements, in other elements: as in the middle of each."""
    middles = (others[:-1] + others[1:]) / 2
    return forces[:, jnp.clip(jnp.searchsorted(s, middles, side="right") - 1, 0, forces.shape[1] - 1)]


def checked_options(
    scene: Scene,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | None = None,
    planar: bool = False,
    find: Find = "minimum",
) -> tuple[Options, float | None]:
    """The options with the library's choice for `None`, and the tolerance to refine for: `None` where there is none."""
    if scene.contact_loads is not None:
        raise ValueError("scene must be one that was given, got that of a rod which touches others: solve its Harness")
    if scene.rod.length.dtype == np.float32:
        warn_of_single_precision()
    if guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
    if solver is None:
        solver = DEFAULT_SOLVER
    instance(solver, "solver", typing.get_args(Solver))
    if discretization is None:
        discretization = _discretization(scene, guess, segments, solver)
    one_of(discretization, "discretization", typing.get_args(Discretization))
    if discretization == "hermite" and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton where discretization is 'hermite'")
    of_frames = needs_frames(scene)
    if of_frames and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton for a rod, loads or clips that need frames along the rod")
    if scene.clips:
        if of_frames and discretization == "finite_difference":
            raise ValueError(
                "discretization must be 'hermite' for clips on a rod, or with loads or clips, that need frames along "
                "the rod"
            )
        if isinstance(solver, NonlinearCG):
            raise ValueError("solver must be a Newton for a scene with clips")
    if of_frames and not has_potential(scene) and discretization == "finite_difference":
        raise ValueError(
            "discretization must be 'hermite' under couples along the rod, forces that follow it, and moments on a rod "
            "that needs frames"
        )
    if scene.obstacles and discretization == "finite_difference":
        raise ValueError("discretization must be 'hermite' for a scene with obstacles")
    if scene.self_contact and discretization == "finite_difference":
        raise ValueError("discretization must be 'hermite' for a scene with self_contact")
    if scene.potentials and discretization == "finite_difference":
        raise ValueError("discretization must be 'hermite' for a scene with potentials")
    if dead_end_moment(scene) is not None and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton for a dead moment on a free end, which no energy is minimal under")
    if rtol is not None:
        if segments is not None:
            raise ValueError(f"segments must be None where rtol is given, got segments={segments!r} and rtol={rtol!r}")
        rtol = checked_rtol(rtol)
    elif segments is None:
        rtol = DEFAULT_RTOL
    # A node for each clip, and where the mesh is chosen a few of them in each span.
    least = max(LEAST_SEGMENTS[discretization], len(scene.clips) + 1)
    if of_frames and discretization == "hermite":
        least = _least_for_jumps(scene, segments, least)
    if segments is not None:
        segments = whole_number(segments, "segments", least, MAX_SEGMENTS)
    elif isinstance(guess, Equilibrium):
        segments = max(guess.s.shape[-1] - 1, least)
    elif rtol is not None and is_known(scene, guess):
        wanted = SPAN_SEGMENTS * (len(scene.clips) + 1) if scene.clips else 0
        if has_contacts(scene):
            wanted = max(wanted, CONTACT_SEGMENTS)
        segments = first_size(rtol, discretization, max(wanted, least))
    else:
        segments = TRACED_SEGMENTS[discretization]
        warn_of_unknown_mesh(segments)
    one_of(find, "find", typing.get_args(Find))
    if find == "equilibrium" and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton where find is 'equilibrium': NonlinearCG only goes down")
    instance(planar, "planar", bool)
    if planar:
        if isinstance(solver, NonlinearCG):
            raise ValueError("solver must be a Newton where planar is True")
        check_planar(scene, 0.0 if guess is None else guess.total_twist)
    return Options(segments, discretization, solver, planar, find), rtol


def _least_for_jumps(scene: Scene, segments: int | None, least: int) -> int:
    """The fewest elements, or more where a rod whose numbers are known has `Steps` near to one another."""
    needed = segments_for_jumps(scene) if is_known(scene) else None
    if needed is None:
        return least
    count, gap = int(np.max(needed[0])), float(np.min(needed[1]))
    if count <= (SIZES["hermite"][-1] if segments is None else segments):
        return max(least, count)
    where = f"jumps of Steps and of loads must have an element each, at least {LEAST_ELEMENT:g} of a segment long"
    given = f"segments = {segments}" if segments is not None else f"the finest mesh of {SIZES['hermite'][-1]} segments"
    raise ValueError(
        f"{where}: got jumps as near as {gap:.3g} of the length to one another or to an end, a load or a clip, which "
        f"needs segments = {count} or more, and {given}"
    )


def check_single(guess: Guess | Equilibrium | None) -> None:
    if isinstance(guess, Equilibrium) and guess.s.ndim > 1:
        raise ValueError(
            f"guess must be a single equilibrium, got a stack of shape {guess.s.shape[:-1]}; take one of it, such as "
            "jax.tree.map(lambda leaf: leaf[-1], guess)"
        )


def checked_rtol(rtol: Any) -> float:
    value = float(positive(rtol, "rtol"))
    if not LEAST_RTOL <= value <= 1.0:
        raise ValueError(f"rtol must lie in {LEAST_RTOL:g} to 1, got {rtol!r}")
    return value


def checked_strain_limit(strain_limit: Any) -> Float[Array, ""] | float:
    """The largest |axial strain| that is allowed: infinite for `None`."""
    if strain_limit is None:
        return math.inf
    if isinstance(strain_limit, float) and strain_limit > 0:
        return float(strain_limit)
    value = positive(strain_limit, "strain_limit")
    return float(value) if is_known(value) else jax.lax.stop_gradient(leaf(value))


def _discretization(
    scene: Scene, guess: Guess | Equilibrium | None, segments: int | None, solver: Solver
) -> Discretization:
    """The one to take where none is asked for."""
    if isinstance(solver, NonlinearCG):
        return "finite_difference"
    if has_node_positions(scene) or (scene.clips and needs_frames(scene)):
        return "hermite"
    if segments is None and isinstance(guess, Equilibrium) and _is_by_differences(guess.state.shape):
        return "finite_difference"
    return "hermite"


def _is_by_differences(shape: Shape) -> bool:
    return isinstance(shape, Polyline) or (isinstance(shape, FramedCurve) and shape.is_of_joints)


def first_state(scene: Scene, guess: Guess | Equilibrium | None, options: Options) -> tuple[SolverState, FirstTwist]:
    """Where to begin, and with which total twist: as the guess has it, where its mesh is kept."""
    if isinstance(guess, Equilibrium) and guess.s.shape[-1] - 1 == options.segments and _fits(scene, guess, options):
        state = guess.state
        first = last_twist(guess)
        if jax.tree.structure(first.last) == jax.tree.structure(last_of(scene)):
            if not has_contacts(scene) and state.clip_moments is None:
                return state, first
            before = _before(scene, guess)
            pressures = _pressures(scene, options, state)
            friction = _friction(scene, guess.nodes, state)
            state = dataclasses.replace(state, clip_moments=None, before=before, pressures=pressures, friction=friction)
            return state, first
    return _first_state(scene, guess, options)


def last_twist(result: Equilibrium) -> FirstTwist:
    """The total twist of an equilibrium, to be carried to the next one."""
    return FirstTwist(result.total_twist, last_of(result.scene))


def settled_state(scene: Scene, state: SolverState, first: FirstTwist) -> tuple[SolverState, Float[Array, ""]]:
    """The same beginning with the tangents and frames that the scene holds, and the total twist there [rad]."""
    if not needs_frames(scene) and not (isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp)):
        return state, first.total_twist
    scaled, scaled_state = in_units_of(scene, state)
    if slides(scene):
        assert state.arclengths is not None
        scaled = slid(scaled, state.arclengths)
    form = form_of(scaled, scaled_state.shape)
    begin, point = _first_point(form, scaled_state, first)
    shape = begin.with_unknowns(point)
    total_twist = form.settled(point).total_twist
    return dataclasses.replace(scaled_state, shape=shape), total_twist


def _sliding(scene: Scene) -> tuple[bool, ...]:
    return tuple(clip.sliding for clip in scene.clips)


def _kind(options: Options) -> type[Polyline] | type[Curve]:
    return Polyline if options.discretization == "finite_difference" else Curve


def _fits(scene: Scene, guess: Equilibrium, options: Options) -> bool:
    """Whether a guess has the unknowns of a scene on a mesh of as many segments."""
    shape = guess.state.shape
    parts = force_parts(scene, options.segments)
    if guess.state.end_force.shape[1] != parts or _sliding(guess.scene) != _sliding(scene):
        return False
    if needs_frames(scene):
        return isinstance(shape, FramedCurve) and shape.is_of_joints == (options.discretization == "finite_difference")
    return isinstance(shape, _kind(options))


@compiled
def _first_state(scene: Scene, guess: Guess | Equilibrium | None, options: Options) -> tuple[SolverState, FirstTwist]:
    """Cold starts look like warm ones, so that both have one program."""
    state, first = _unsettled_state(scene, guess, options)
    here = last_of(scene)
    if first.last is not None and jax.tree.structure(first.last) == jax.tree.structure(here):
        return state, first
    if options.planar:
        return state, FirstTwist(first.total_twist, here)
    state, total_twist = settled_state(scene, state, first)
    return state, FirstTwist(total_twist, here)


def _unsettled_state(
    scene: Scene, guess: Guess | Equilibrium | None, options: Options
) -> tuple[SolverState, FirstTwist]:
    if needs_frames(scene):
        return _first_frames(scene, guess, options)
    scaled, units = nondimensional(scene)
    kind = _kind(options)
    pieces = options.segments if kind is Polyline else 2 * options.segments
    parts = force_parts(scene, options.segments)
    no_force = jnp.zeros((3, parts), scene.rod.length.dtype)
    before, pressures, friction = _before(scene, guess), _pressures(scene, options), _from_rest(scene, options)
    if guess is None:
        no_twist = jnp.zeros((), no_force.dtype)
        shape = kind.through(beside_obstacles(scaled, first_shape(scaled, pieces), pieces))
        arclengths = sliding_arclengths(scaled)
        state = SolverState(shape, no_force, units, arclengths, before=before, pressures=pressures, friction=friction)
        return state, FirstTwist(no_twist)
    if isinstance(guess, Guess):
        shape = kind.through(guess.nodes(scaled, units, pieces))
        friction = _lying(scene, units, shape.nodes, friction)
        twist = FirstTwist(guess.total_twist)
        arclengths = sliding_arclengths(scaled)
        state = SolverState(shape, no_force, units, arclengths, before=before, pressures=pressures, friction=friction)
        return state, twist
    state = guess.state
    if isinstance(state.shape, FramedCurve):
        shape = kind.through(state.shape.points(pieces))
    elif isinstance(state.shape, Curve) and kind is Curve:
        shape = state.shape.on(jnp.linspace(0.0, 1.0, options.segments + 1, dtype=no_force.dtype))
    else:
        shape = kind.through(state.shape.points(pieces))
    end_force = in_parts(state.end_force, parts)
    arclengths = sliding_arclengths(scaled)
    if _sliding(guess.scene) == _sliding(scene):
        arclengths = state.arclengths
    friction = _friction(scene, state.units.origin[None] + state.units.length * shape.nodes)
    if scene.obstacles:
        shape, end_force = _on_its_side(scene, guess, shape, end_force)
    units = state.units
    state = SolverState(shape, end_force, units, arclengths, before=before, pressures=pressures, friction=friction)
    return state, last_twist(guess)


def _first_frames(given: Scene, guess: Guess | Equilibrium | None, options: Options) -> tuple[SolverState, FirstTwist]:
    """The same for a scene that needs frames."""
    scene, units = nondimensional(given)
    of_joints = options.discretization == "finite_difference"
    pieces = options.segments if of_joints else 2 * options.segments
    s = jnp.linspace(0.0, 1.0, options.segments + 1, dtype=scene.rod.length.dtype)
    parts = force_parts(scene, options.segments)
    no_force, arclengths = jnp.zeros((3, parts), s.dtype), sliding_arclengths(scene)
    before, pressures, friction = _before(given, guess), _pressures(given, options), _from_rest(given, options)

    def state(shape: FramedCurve, end_force: Float[Array, "3 parts"] = no_force) -> SolverState:
        return SolverState(shape, end_force, units, arclengths, before=before, pressures=pressures, friction=friction)

    if guess is None:
        if _begins_plain(given, options):
            shape, force, first = _as_plain(given, options)
            # Loads without a potential are put on by `loading` where a search begins without a force.
            return state(shape, in_parts(force, parts) if has_potential(scene) else no_force), first
        shape = first_frames(scene, s, of_joints)
        if scene.obstacles:
            points = first_shape(scene, pieces) if scene.rod.rest_shape is None else shape.points(pieces)
            aside = beside_obstacles(scene, points, pieces)
            is_aside = jnp.any(aside != points)
            framed = framed_through(scene, aside, of_joints)
            shape = jax.tree.map(lambda there, here: jnp.where(is_aside, there, here), framed, shape)
        return state(shape), FirstTwist(rest_twist(scene))
    if isinstance(guess, Guess):
        shape = framed_through(scene, guess.nodes(scene, units, pieces), of_joints)
        friction = _lying(given, units, shape.nodes, friction)
        return state(shape), FirstTwist(guess.total_twist)
    shape, first = guess.state.shape, last_twist(guess)
    if _sliding(guess.scene) == _sliding(scene):
        arclengths = guess.state.arclengths
    if isinstance(shape, FramedCurve):
        end_force = in_parts(guess.state.end_force, parts)
        shape = shape.on(s, of_joints)
        units = guess.state.units
        friction = _friction(given, units.origin[None] + units.length * shape.nodes)
        if scene.obstacles:
            shape, end_force = _on_its_side(given, guess, shape, end_force)
        begin = SolverState(shape, end_force, units, arclengths, before=before, pressures=pressures, friction=friction)
        return begin, first
    if has_friction(given):
        friction = _friction(given, guess.position_at(s * guess.scene.rod.length))
    last = _in_units(guess.state, units)
    points, end_force = last.shape.points(pieces), in_parts(last.end_force, parts)
    start = guess.scene.start
    if isinstance(start, Clamp):
        return state(framed_through(scene, points, of_joints, (start.frame, guess.total_twist)), end_force), first
    return state(framed_through(scene, points, of_joints), end_force), FirstTwist(guess.total_twist)


def _begins_plain(scene: Scene, options: Options) -> bool:
    """Whether a rod by frames begins in the equilibrium of the plain one: where turns are stated, with which a rod may
    take one of several shapes, so that EI and (EI, EI) take the same.
    """
    others = scene.distributed or scene.clips or has_contacts(scene)
    return scene.turns is not None and scene.rod.rest_shape is None and not others and not options.planar


def _as_plain(scene: Scene, options: Options) -> tuple[FramedCurve, Float[Array, "3 parts"], FirstTwist]:
    """The frames of the plain rod, the force through it, without which they are no minimum, and its total twist."""
    plain = with_plain_rod(scene)
    state, twist = _unsettled_state(plain, None, options)
    state, total_twist = settled_state(plain, state, twist)
    found = solve_from(plain, state, FirstTwist(total_twist, last_of(plain)), options)
    of_joints = options.discretization == "finite_difference"
    scaled, units = nondimensional(scene)
    begin = _in_units(found.state, units)
    points = begin.shape.points(options.segments if of_joints else 2 * options.segments)
    twist = found.point.total_twist
    assert isinstance(scene.start, Clamp)
    shape = framed_through(scaled, points, of_joints, (scene.start.frame, twist))
    return shape, begin.end_force, FirstTwist(twist, last_of(scene))


def solve_from(scene: Scene, state: SolverState, first: FirstTwist, options: Options) -> Found:
    """The one code path of every solve: from a state to where the solver stops."""
    # To the same bits, whatever is made of it in the same program.
    find = _slid if slides(scene) else _found
    return jax.lax.optimization_barrier(find(*in_units_of(scene, state), first, options))


def in_units_of(scene: Scene, state: SolverState) -> tuple[Scene, SolverState]:
    """The scene, nondimensional, and a state in its units."""
    scaled, units = nondimensional(scene)
    return scaled, _in_units(state, units)


class Search(eqx.Module):
    """Where Newton's method begins: the form it makes stationary, the first point, and the shape that belongs to it.

    `normal`: of the plane in which it stays, if it does.
    """

    form: Form
    point: Point
    shape: Shape
    units: Units
    is_within_plane: Bool[Array, ""] | None
    normal: Float[Array, "3"] | None

    @staticmethod
    def of(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> "Search":
        form = form_of(scene, guess.shape)
        shape, point = _first_point(form, guess, first)
        if not options.planar:
            return Search(form, point, shape, guess.units, None, None)
        normal, axes = plane(scene, point.tangents)
        within = is_planar(scene, first.total_twist)
        return Search(*form.in_plane(point, normal, axes), shape, guess.units, within, normal)

    def found(self, end: NewtonEnd) -> Found:
        point, outcome, stable = self.form.settled(end.point), end.outcome, end.is_stable
        start, reached = self.shape, self.shape.reached(self.form, point)
        # An unchanged scene gives back the same bits. (A straight rod under another pull takes no iteration either.)
        is_same = start.change_to(reached) <= SAME_SHAPE * jnp.finfo(reached.nodes.dtype).eps
        is_start = (outcome.iterations == 0) & is_same
        shape = jax.tree.map(lambda old, new: jnp.where(is_start, old, new), start, reached)
        if self.normal is not None and self.is_within_plane is not None:
            stable &= is_stable(self.form.out_of_plane(self.normal), point)
            # Inside a user's own jit the scene could not be checked before.
            within = self.is_within_plane & (self.form.stays_in_plane(point) | ~is_converged(outcome.status))
            status = jnp.where(within, outcome.status, Status.NOT_PLANAR)
            outcome = eqx.tree_at(lambda outcome: outcome.status, outcome, status)
        arclengths = sliding_arclengths(self.form.scene)
        pressures, friction = (
            (point.nodal.pressures, point.nodal.friction) if has_contacts(self.form.scene) else (None, None)
        )
        state = SolverState(shape, point.end_force, self.units, arclengths, pressures=pressures, friction=friction)
        return Found(state, point, outcome, stable)


def _found(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> Found:
    solver = options.solver
    if isinstance(solver, Newton):
        search = Search.of(scene, guess, first, options)
        found = search.found(_sought(search.form, search.point, guess, solver, options.find))
        return on_one_side(search, search.form, found, guess.before) if scene.obstacles else found
    assert isinstance(guess.shape, Polyline)
    problem, start = FiniteDifference.begin(scene, guess.shape, first)
    minimum = minimize(problem, start, solver)
    point = minimum.problem.mixed_point(minimum.point)
    stable = is_stable(MixedForm.of(scene, field_of(scene, guess.shape)), point)
    return Found(SolverState(minimum.point, point.end_force, guess.units), point, minimum.outcome, stable)


def _sought(form: Form, point: Point, guess: SolverState, solver: Newton, find: Find) -> NewtonEnd:
    """Where the search ends that begins at a point."""
    if not has_potential(form.scene) and (has_node_positions(form.scene) or slides(form.scene)):
        return found_under_loads(form, point, solver, find, jnp.all(guess.end_force == 0))
    return find_equilibrium(form, point, solver, find)


def on_one_side(search: Search, form: Form, found: Found, before: Before | None) -> Found:
    """Not converged where the rod came through an obstacle on the way, or lies within one; `form`: of what was found.

    No step of the search leads through. So a rod that begins on the side of all obstacles where it last was sound has
    stayed there, however far it slid around one; of others the shape in the end is compared with the last sound one.
    """
    begun = search.form
    assert isinstance(begun, NodalForm)
    assert isinstance(form, NodalForm)
    assert before is not None
    assert search.point.nodal is not None
    positions = search.point.nodal.positions
    begin = sampled(begun, search.point, positions, search.units)
    now = sampled(form, found.point, found.state.shape.nodes, found.state.units)
    before = dataclasses.replace(before, points=jnp.where(jnp.isnan(before.points), begin.points, before.points))
    passed = passage(before, now)

    def stayed() -> Bool[Array, ""]:
        return passage(before, begin).is_sound & ~passed.lies_within

    is_sound = jax.lax.cond(passed.is_sound, lambda: jnp.array(True), stayed)
    converged = is_converged(found.outcome.status)
    status = jnp.where(converged & ~is_sound, Status.PASSED_THROUGH, found.outcome.status)
    kept = jax.tree.map(lambda new, old: jnp.where(converged & is_sound, new, old), now.before, before)
    return eqx.tree_at(
        lambda found: (found.outcome.status, found.state.before),
        found,
        (status, kept),
        is_leaf=lambda value: value is None,
    )


def _slid(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> Found:
    """The same where the rod slides through clips: their arclengths are unknowns.

    The mesh goes along with them. Where it was stretched by that, or another one belongs to where they have come, the
    search goes on from there on a mesh that is made anew.
    """
    scene, guess, point = _with_first_turns(scene, guess, first)

    def search(last: _Sliding) -> _Sliding:
        state = last.found.state
        assert state.arclengths is not None
        here = slid(scene, state.arclengths)
        anew = on_mesh_of(here, state.shape, guess.shape)
        shape = jax.tree.map(lambda old, new: jnp.where(last.count == 0, old, new), state.shape, anew)
        state = dataclasses.replace(state, shape=shape)
        found, goes_on = _slid_once(here, state, FirstTwist(last.found.point.total_twist), options)
        before, after = last.found.outcome, found.outcome
        count = last.count + 1
        outcome = Outcome(
            after.residual,
            before.iterations + after.iterations,
            before.evaluations + after.evaluations,
            jnp.where(goes_on & (count == MOST_MESHES), Status.MAX_ITERATIONS, after.status),
        )
        return _Sliding(dataclasses.replace(found, outcome=outcome), count, goes_on)

    count = jnp.zeros((), int)
    nothing = Outcome(jnp.zeros_like(point.total_twist), count, count, count)
    begin = _Sliding(Found(guess, point, nothing, jnp.array(False)), count, jnp.array(True))
    return jax.lax.while_loop(lambda last: last.goes_on & (last.count < MOST_MESHES), search, begin).found


def _with_first_turns(scene: Scene, guess: SolverState, first: FirstTwist) -> tuple[Scene, SolverState, Point]:
    """A scene without turns, which are those of the first shape, that shape, and the point there."""
    assert guess.arclengths is not None
    shape, point = _first_point(form_of(slid(scene, guess.arclengths), guess.shape), guess, first)
    if scene.turns is not None:
        guess = dataclasses.replace(guess, shape=shape.with_unknowns(point))
        scene = eqx.tree_at(lambda scene: scene.turns, scene, None)
    return scene, guess, point


class _Sliding(eqx.Module):
    """What has been found on so many meshes, and whether another one is needed."""

    found: Found
    count: Int[Array, ""]
    goes_on: Bool[Array, ""]


def _slid_once(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> tuple[Found, Bool[Array, ""]]:
    """What a search finds on one mesh, and whether it is to go on on another one."""
    assert isinstance(options.solver, Newton)
    search = Search.of(scene, guess, first, options)
    form, point = _with_arclengths(search, scene, guess, options)
    end = _sought(form, point, guess, options.solver, options.find)
    assert isinstance(end.point, SlidingPoint)
    reached = dataclasses.replace(search, form=form.at(end.point.arclengths))
    found = reached.found(dataclasses.replace(end, point=end.point.inner))
    if scene.obstacles:
        found = on_one_side(search, reached.form, found, guess.before)
    goes_on = is_converged(end.outcome.status) & form.is_misplaced(end.point)
    is_blocked = form.is_blocked(end.point)
    return found, goes_on if is_blocked is None else goes_on | is_blocked


def sliding_search(scene: Scene, guess: SolverState, first: FirstTwist, options: Options) -> Search:
    """Where a search begins whose unknowns are the arclengths of sliding clips too."""
    scene, guess, point = _with_first_turns(scene, guess, first)
    assert guess.arclengths is not None
    scene = slid(scene, guess.arclengths)
    search = Search.of(scene, guess, FirstTwist(point.total_twist), options)
    form, point = _with_arclengths(search, scene, guess, options)
    return dataclasses.replace(search, form=form, point=point)


def _with_arclengths(
    search: Search, scene: Scene, guess: SolverState, options: Options
) -> tuple[SlidingForm, SlidingPoint]:
    """The form and point of a search with the arclengths of sliding clips, from a scene with its clips at those."""
    assert guess.arclengths is not None
    descends = options.find == "minimum"
    form = SlidingForm(scene=scene, made=scene, shape=search.shape, first=search.form, descends=descends)  # pyright: ignore
    is_warm = jnp.any(guess.end_force != 0)
    return form, SlidingPoint(search.point, guess.arclengths, is_warm, jnp.zeros_like(guess.arclengths))


def on_mesh_of(scene: Scene, shape: Shape, other: Shape) -> Shape:
    """A shape on the mesh of another one, as a scene has it."""
    if isinstance(shape, Curve) and isinstance(other, Curve):
        return shape.on(form_of(scene, shape.on(other.s)).field.s)
    if isinstance(shape, FramedCurve) and isinstance(other, FramedCurve):
        nodes = form_of(scene, shape.on(other.s, of_joints=False)).field.s
        return shape.on(nodes, of_joints=False)
    return shape


def _first_point(form: Form, guess: SolverState, first: FirstTwist) -> tuple[Shape, Point]:
    """The shape from which to seek the solution, and the same as the unknowns of its form."""
    scene, shape, field = form.scene, guess.shape, form.field
    end_force = form.layout.forces(form.layout.components(guess.end_force))
    if isinstance(form, FrameForm):
        assert isinstance(shape, FramedCurve)
        point = form.holding(FramePoint(shape.turned_to_ends(form, first), end_force, first.total_twist))
        return shape, form.begun(point, shape.nodes, guess.pressures, guess.friction)
    assert isinstance(form, MixedForm)
    if isinstance(shape, Curve):
        assert isinstance(field, QuadraticRotationElements)
        tangents = field.apply_prescribed(scene, shape.turned_to_ends(scene, field.arclengths))
    else:
        assert isinstance(shape, Polyline)
        if not scene.clips:
            problem, start = FiniteDifference.begin(scene, shape, first)
            return start, eqx.tree_at(lambda point: point.end_force, problem.mixed_point(start), end_force)
        tangents = shape.tangents
    point = MixedPoint(tangents, end_force, form.first_twist(shape, tangents, first))
    return shape, form.begun(point, shape.nodes, guess.pressures, guess.friction)


# Not eqx.filter_jit: it parts arrays from the rest in Python at each call, 0.08 ms of a warm solve of 0.3 ms.
@compiled
def _solve(
    scene: Scene,
    state: SolverState,
    first: FirstTwist,
    strain_limit: Float[Array, ""] | float,
    options: Options,
) -> Equilibrium:
    return build_result(scene, solve_from(scene, state, first, options), jnp.ones((), int), strain_limit)


def _in_units(state: SolverState, units: Units) -> SolverState:
    """The unknowns in other units; unchanged to the last bit where the units are the same."""
    shape = state.shape.in_units(state.units.length / units.length, (state.units.origin - units.origin) / units.length)
    force = state.end_force * (state.units.force / units.force)
    pressures = None if state.pressures is None else state.pressures * (state.units.force / units.force)
    friction = state.friction
    if friction is not None:
        forces = friction.forces * (state.units.force / units.force)
        friction = dataclasses.replace(friction, forces=forces)
    return SolverState(
        shape, force, units, state.arclengths, before=state.before, pressures=pressures, friction=friction
    )
