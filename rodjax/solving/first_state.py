"""Where searches begin: as a scene, a guess, or an equilibrium on the same or a coarser mesh has it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.contact_gaps import pressure_rows
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.first_shape import first_shape
from rodjax.discretization.first_twist import FirstTwist, last_of
from rodjax.discretization.forms import form_of
from rodjax.discretization.framed_curve import FramedCurve, first_frames, framed_through, rest_twist
from rodjax.discretization.hermite import Curve
from rodjax.discretization.layout import force_parts, in_parts
from rodjax.discretization.nodal_point import Friction
from rodjax.discretization.shape import Shape
from rodjax.geometry.interpolation import resampled
from rodjax.mechanics.passage import SAMPLES, Before
from rodjax.model.scene import (
    Scene,
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
from rodjax.programs.compilation import compiled
from rodjax.solving.guess import Guess, beside_obstacles
from rodjax.solving.options import Options
from rodjax.solving.refinement import SHORTEST_IN_CONTACT, graded
from rodjax.solving.result import Equilibrium
from rodjax.solving.search import first_point, in_units, in_units_of, solve_from
from rodjax.solving.solver_state import SolverState
from rodjax.solving.status import Status
from rodjax.units import Units


def first_state(scene: Scene, guess: Guess | Equilibrium | None, options: Options) -> tuple[SolverState, FirstTwist]:
    """Where to begin, and with which total twist: as the guess has it, where its mesh is kept."""
    if isinstance(guess, Equilibrium) and guess.s.shape[-1] - 1 == options.segments and fits(scene, guess, options):
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
    begin, point = first_point(form, scaled_state, first)
    shape = begin.with_unknowns(point)
    total_twist = form.settled(point).total_twist
    return dataclasses.replace(scaled_state, shape=shape), total_twist


def _sliding(scene: Scene) -> tuple[bool, ...]:
    return tuple(clip.sliding for clip in scene.clips)


def _kind(options: Options) -> type[Polyline] | type[Curve]:
    return Polyline if options.discretization == "finite_difference" else Curve


def fits(scene: Scene, guess: Equilibrium, options: Options) -> bool:
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
    last = in_units(guess.state, units)
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
    begin = in_units(found.state, units)
    points = begin.shape.points(options.segments if of_joints else 2 * options.segments)
    twist = found.point.total_twist
    assert isinstance(scene.start, Clamp)
    shape = framed_through(scaled, points, of_joints, (scene.start.frame, twist))
    return shape, begin.end_force, FirstTwist(twist, last_of(scene))


@compiled
def finer_state(coarse: Equilibrium, defects: Float[Array, "n"] | None, options: Options) -> SolverState:
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
