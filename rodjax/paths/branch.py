"""One branch of equilibria through a sequence of scenes, stable or not, and the points on it where a motion goes soft.

The parameter of a sequence of m scenes runs from 0 to m - 1 and names the scene between two of them. Along the branch
the residual (gradient by rotations, constraint residual) of the mixed form stays zero. A step goes along the tangent of
the branch and comes back to it at right angles (Keller 1977), in the metric of `stability.softest` for rotations beside
the parameter: a linearised system with a border, solved for two right sides with the factors of Newton's method, O(n).
At a fold the system itself is singular, with its border it is not.

Keller, "Numerical solution of bifurcation and nonlinear eigenvalue problems" (1977); Seydel, "Practical bifurcation and
stability analysis" (2010).
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.form import Form, Linearization, Point
from rodjax.discretization.joints import generic_field
from rodjax.discretization.motion import Metric, Motion, neutral_turn
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.geometry.vectors import components
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.bordered import BorderedFactors, BorderedSystem, Vectors
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import AnyFactors, AnySystem, SaddlePointSystem, factor, transposed
from rodjax.model.scene import Scene, between, nondimensional, slid
from rodjax.model.supports import Clamp, rotate
from rodjax.paths.modes import Mode, mode_of
from rodjax.programs.compilation import compiled
from rodjax.solving.equilibrium import on_mesh_of
from rodjax.solving.newton import STAGNATION
from rodjax.solving.result import Equilibrium, Found, SolverState, build_result, free_form_and_point
from rodjax.solving.stability import carried_to
from rodjax.solving.status import Outcome, Status

# A point lies on the branch when no force larger than this is left on a node [EI/L^2], or rounding allows no less.
TOLERANCE = 1e-9
MAX_ITERATIONS = 12
# The most by which a correction turns a tangent [rad].
MAX_ROTATION = 1.0
# Stiffness of the spring against a neutral turn [EI/L], that of a softly held rod.
SPRING = 10.0
# Stiffness of the springs that hold a rod while its system is factorised [EI/L], and the parts it is held in.
SPRING_STIFFNESS = 100.0
PARTS = 4
# Inverse iterations for the motion whose stiffness is nearest to zero: where it is near, one gains six digits.
INVERSE_ITERATIONS = 4


class BranchTangent(eqx.Module):
    """A direction in which equilibria change: a motion, and the change of the parameter that goes with it."""

    motion: Motion
    rate: Float[Array, ""]


class Station(eqx.Module):
    """A point of a branch.

    - `along`: the tangent of the branch, of length 1
    - `alignment`: cosine of the angle to the direction in which the step went
    - `stiffness`, `motion`: the eigenvalue [EI/L^2] of the Hessian nearest to zero, neutral turns apart, and its motion
    - `slope`: the work of the residual that a change of the parameter makes in this motion, as a part of the most that
      it could be
    """

    parameter: Float[Array, ""]
    equilibrium: Equilibrium
    along: BranchTangent
    alignment: Float[Array, ""]
    index: Int[Array, ""]
    stiffness: Float[Array, ""]
    motion: Motion
    slope: Float[Array, ""]


def scene_at(scenes: Scene, segment: Int[Array, ""], parameter: Float[Array, ""]) -> Scene:
    """The scene of a parameter between the scenes number `segment` and the next one; beyond them on in a line."""
    scene, other = (jax.tree.map(lambda leaf, k=k: leaf[segment + k], scenes) for k in (0, 1))
    fraction = parameter - segment.astype(parameter.dtype)
    mixed = between(scene, other, fraction)
    # As `between` has them, but smooth where the frames are the same.
    ends = [name for name in ("start", "end") if isinstance(getattr(scene, name), Clamp)]
    clips = [k for k, clip in enumerate(scene.clips) if clip.frame is not None]

    def held(scene: Scene) -> list[Float[Array, "3 3"]]:
        return [getattr(scene, name).frame for name in ends] + [scene.clips[k].frame for k in clips]

    pairs = zip(held(scene), held(other), strict=True)
    frames = [rotate(frame, fraction * rotation_vector(frame, next_frame)) for frame, next_frame in pairs]
    return eqx.tree_at(held, mixed, frames) if frames else mixed


def rotation_vector(frame: Float[Array, "3 3"], other: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The smallest rotation from one frame to another as a vector [rad], by less than pi, global axes."""
    turn = other @ frame.T
    sines = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    squared, cosine = jnp.sum(sines**2), (jnp.trace(turn) - 1) / 2
    # Series of the arcsine near zero, where the derivatives of the length are infinite.
    is_small = (squared < 1e-4) & (cosine > 0)
    sine = jnp.sqrt(jnp.where(is_small, 1.0, squared))
    series = 1 + squared / 6 + squared**2 * (3 / 40) + squared**3 * (5 / 112)
    return jnp.where(is_small, series, jnp.arctan2(sine, cosine) / sine) * sines


class Problem(eqx.Module):
    """The scenes about an equilibrium, and what they make of it under other parameters."""

    scenes: Scene
    segment: Int[Array, ""]
    equilibrium: Equilibrium

    @property
    def point(self) -> Point:
        return free_form_and_point(self.equilibrium)[1]

    @property
    def scale(self) -> float:
        """The change of the parameter that counts as much as one radian all along the rod."""
        return float(self.scenes.rod.length.shape[0] - 1)

    def at(self, parameter: Float[Array, ""], point: Point, motion: Motion | None = None) -> tuple[Form, Point]:
        scaled, _ = nondimensional(scene_at(self.scenes, self.segment, parameter))
        state = self.equilibrium.state
        return carried_to(scaled, state.shape, point, motion, made_at=state.arclengths)

    def linearized(self, parameter: Float[Array, ""], point: Point) -> tuple[Form, Point, Linearization, Motion]:
        """The form, the point carried there, its linearisation, and the change of the residual with the parameter."""

        def residual(parameter):
            form, there = self.at(parameter, point)
            here = form.linearized(there)
            return Motion(here.gradient, here.constraint_residual), (form, there, here)

        _, change, found = jax.jvp(residual, (parameter,), (jnp.ones_like(parameter),), has_aux=True)
        return *found, change


def no_motion(result: Equilibrium) -> Motion:
    """A motion of an equilibrium that leaves it where it is."""

    def residual_vectors(result: Equilibrium) -> Motion:
        form, point = free_form_and_point(result)
        here = form.linearized(point)
        return Motion(here.gradient, here.constraint_residual)

    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(residual_vectors, result))


def times(motion: Motion, other: Motion) -> Float[Array, ""]:
    """The work of one in the other."""
    return jnp.sum(motion.rotation * other.rotation) + jnp.sum(motion.multipliers * other.multipliers)


def less(motion: Motion, other: Motion, metric: Metric) -> Motion:
    """The part at right angles to another motion of length 1, or to none."""
    return added(motion, other, -metric.inner(motion, other))


def added(motion: Motion, other: Motion, share: Float[Array, ""]) -> Motion:
    return jax.tree.map(lambda x, y: x + share * y, motion, other)


class Regularized(eqx.Module):
    """The factors of a linearisation that has its springs."""

    factors: AnyFactors
    holds: int = eqx.field(static=True)

    @property
    def negative(self) -> Int[Array, ""]:
        """The number of negative eigenvalues under the constraints: a hold is none of these."""
        factors = self.factors
        if isinstance(factors, BorderedFactors):
            return factors.inner.negative + factors.below_by_pivots + self.holds
        return factors.negative + self.holds

    def solve(self, motion: Motion) -> Motion:
        rotation, multipliers = self.factors.solve(motion.rotation, jnp.pad(motion.multipliers, (0, self.holds)))
        return Motion(rotation, multipliers[: len(motion.multipliers)])


def regularized(form: Form, system: AnySystem, neutral: Motion) -> Regularized:
    """The factors of a linearisation with a spring against its neutral turn, where this turns a tangent most.

    What is at right angles to the turn has the same solution but for a share of the turn, with all digits.

    A loop that slides along its rod, or a rod that is free but for its closure constraint, makes the part without
    border nearly singular where the whole is not, and pivots are not exchanged. So springs hold the rod at a few places
    that are eliminated last, and as many multipliers, columns of the border, take their moments away again: exactly. A
    chain from node to node has the forces that close it between them.
    """
    place = jnp.argmax(jnp.sum(neutral.rotation**2, axis=0))
    turn = neutral.rotation[:, place]
    squared = jnp.sum(turn**2)
    spring = SPRING * turn[:, None] * turn[None] / jnp.where(squared > 0, squared, 1.0)
    system = form.regular(system)
    if isinstance(system, BorderedSystem):
        inner, holds = _held(system.inner, place, spring)
        columns, rows = (
            Vectors(part.x, jnp.pad(part.y, ((0, 0), (0, holds)))) for part in (system.columns, system.rows)
        )
        system = dataclasses.replace(system, inner=inner, columns=columns, rows=rows)
        return Regularized(factor(system), holds)
    system, holds = _held(system, place, spring)
    return Regularized(factor(system), holds)


def _held(
    system: SaddlePointSystem | ChainSystem, place: Int[Array, ""], spring: Float[Array, "b b"]
) -> tuple[SaddlePointSystem | ChainSystem, int]:
    """With a spring at one point, and the multipliers that take away what holds the rod at others: so many."""
    diagonal = system.diagonal.at[:, :, place].add(spring)
    if isinstance(system, ChainSystem):
        return dataclasses.replace(system, diagonal=diagonal), 0
    b, m = diagonal.shape[1:]
    stride = 2 ** math.ceil(math.log2(max(m - 1, 1) / PARTS)) if m > PARTS else 1
    held_points = np.arange(stride, m - 1, stride)
    holds = b * len(held_points)
    border = np.zeros((b, b, len(held_points), m))
    for component in range(b):
        border[component, component, np.arange(len(held_points)), held_points] = 1.0
    border = jnp.asarray(border.reshape(b, holds, m), system.border.dtype)
    held = jnp.sum(border, axis=1)
    identity = jnp.eye(b, dtype=held.dtype)[..., None]
    diagonal += SPRING_STIFFNESS * identity * held[None]
    k = len(system.compliance)
    compliance = jnp.zeros((k + holds, k + holds), held.dtype).at[:k, :k].set(system.compliance)
    compliance = compliance.at[k:, k:].set(-jnp.eye(holds, dtype=held.dtype) / SPRING_STIFFNESS)
    system = SaddlePointSystem(
        diagonal, system.lower, jnp.concatenate([system.border, border], axis=1), compliance, across=system.across
    )
    return system, holds


def nearest_to_zero(
    form: Form, point: Point, here: Linearization, neutral: Motion, others: tuple[Motion, ...] = ()
) -> tuple[Float[Array, ""], Motion]:
    """The eigenvalue [EI/L^2] nearest to zero and its motion, of length 1, at right angles to the others."""
    metric = Metric.of(form, here)
    nothing = jnp.zeros_like(here.constraint_residual)
    factors = regularized(form, here.system, neutral)

    def unit(motion: Motion) -> Motion:
        for other in (neutral, *others):
            motion = less(motion, other, metric)
        size = jnp.sqrt(metric.inner(motion, motion))
        return jax.tree.map(lambda x: x / size, motion)

    def closer(_, motion: Motion) -> Motion:
        return unit(factors.solve(metric.times(motion)))

    first = unit(Motion(components(here.bases, generic_field(point.tangents)), nothing))
    motion = jax.lax.fori_loop(0, INVERSE_ITERATIONS, closer, first)
    return times(motion, Motion(*here.system.times(motion.rotation, motion.multipliers))), motion


def left_of(
    form: Form, point: Point, here: Linearization, neutral: Motion, motion: Motion, others: tuple[Motion, ...] = ()
) -> Motion:
    """The left eigenvector to the eigenvalue nearest to zero, whose motion is given: the same where the system has
    symmetry, else on its side.
    """
    if not form.sliding_count:
        return motion
    there = eqx.tree_at(lambda here: here.system, here, transposed(here.system))
    left = nearest_to_zero(form, point, there, neutral, others)[1]
    sign = jnp.sign(Metric.of(form, here).inner(left, motion))
    return jax.tree.map(lambda x: sign * x, left)


def neutral_motion(form: Form, point: Point, here: Linearization) -> Motion:
    """The turn of the whole rod that leaves it in equilibrium, of length 1, or no motion."""
    turn = neutral_turn(form, point, here)
    squared = Metric.of(form, here).inner(turn, turn)
    return jax.tree.map(lambda x: x / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), turn)


class _Correction(eqx.Module):
    """Where a correction is: what was found at the point, and the point to look at next."""

    parameter: Float[Array, ""]
    point: Point
    here: Linearization
    change: Motion  # of the residual with the parameter
    follows: Motion  # how the equilibrium follows the parameter
    index: Int[Array, ""]
    is_converged: Bool[Array, ""]
    iterations: Int[Array, ""]


@compiled
def stepped(
    scenes: Scene,
    segment: Int[Array, ""],
    parameter: Float[Array, ""],
    result: Equilibrium,
    along: BranchTangent,
    distance: Float[Array, ""],
    target: Float[Array, ""],
) -> Station:
    """The equilibrium at a distance along a direction, at right angles to it; or under the parameter `target`.

    `target`: not a number where the parameter is free.
    """
    problem = Problem(scenes, segment, result)
    is_given = ~jnp.isnan(target)
    far = jax.tree.map(lambda x: distance * x, along)
    first = jnp.where(is_given, target, parameter + far.rate)
    form, begin = problem.at(parameter, problem.point)
    reach = form.longest_step(begin, form.others(far.motion.multipliers))
    normal = short_sum(form.bases_at(begin) * along.motion.rotation[None], axis=1)
    _, predicted = problem.at(first, problem.point, far.motion)

    def corrected(state: _Correction) -> _Correction:
        form, point, here, change = problem.linearized(state.parameter, state.point)
        metric = Metric.of(form, here)
        neutral = neutral_motion(form, point, here)
        factors = regularized(form, here.system, neutral)
        back = less(factors.solve(Motion(-here.gradient, -here.constraint_residual)), neutral, metric)
        follows = less(factors.solve(jax.tree.map(jnp.negative, change)), neutral, metric)
        across = Motion(components(here.bases, normal), along.motion.multipliers)
        squared = jnp.where(is_given, 1.0, metric.inner(across, follows) + along.rate / problem.scale**2)
        share = jnp.where(is_given, 0.0, -metric.inner(across, back)) / squared
        motion = added(back, follows, share)
        part = jnp.minimum(1.0, MAX_ROTATION / jnp.max(jnp.abs(motion.rotation)))
        longest = form.longest_step(point, form.others(motion.multipliers))
        part = part if longest is None else jnp.minimum(part, longest)
        force_change = form.layout.forces(form.force_components(part * motion.multipliers))
        others = form.others(part * motion.multipliers)
        retracted = form.retract(point, here.bases, part * motion.rotation, force_change, others)
        least = jnp.maximum(TOLERANCE, STAGNATION * form.rounding_floor(point))
        is_there = (here.residual <= least) & form.is_closed(here.constraint_residual, 0.0)
        return _Correction(
            parameter=jnp.where(is_there, state.parameter, state.parameter + part * share),
            point=jax.tree.map(lambda here, there: jnp.where(is_there, here, there), point, retracted),
            here=here,
            change=change,
            follows=follows,
            index=factors.negative,
            is_converged=is_there,
            iterations=state.iterations + 1,
        )

    def is_running(state: _Correction) -> Bool[Array, ""]:
        return ~state.is_converged & (state.iterations < MAX_ITERATIONS) & jnp.isfinite(state.parameter)

    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(lambda: problem.linearized(first, predicted)[2:]),
    )
    here, change = nothing
    count = jnp.zeros((), int)
    # A step that takes a clip beyond its neighbours is none.
    begins = count if reach is None else jnp.where(reach < 1, MAX_ITERATIONS, count)
    state = _Correction(first, predicted, here, change, change, count, jnp.array(False), begins)
    state = jax.lax.while_loop(is_running, corrected, state)

    here, point, change = state.here, state.point, state.change
    form, point = problem.at(state.parameter, point)
    metric = Metric.of(form, here)
    # The tangent, on in the direction in which the step went.
    before = Motion(components(here.bases, normal), along.motion.multipliers)
    size = jnp.sqrt(metric.inner(state.follows, state.follows) + 1 / problem.scale**2)
    cosine = (metric.inner(before, state.follows) + along.rate / problem.scale**2) / size
    sign = jnp.where(cosine < 0, -1.0, 1.0).astype(size.dtype) / size
    tangent = BranchTangent(jax.tree.map(lambda x: sign * x, state.follows), sign)
    neutral = neutral_motion(form, point, here)
    stiffness, motion = nearest_to_zero(form, point, here, neutral)
    left = left_of(form, point, here, neutral, motion)

    scene = scene_at(scenes, segment, state.parameter)
    units = nondimensional(scene)[1]
    status = jnp.where(state.is_converged, Status.CONVERGED, Status.MAX_ITERATIONS)
    outcome = Outcome(here.residual, state.iterations, state.iterations, status.astype(int))
    arclengths = None
    if isinstance(form, SlidingForm):
        assert isinstance(point, SlidingPoint)
        form, point, arclengths = form.at(point.arclengths), point.inner, point.arclengths
    shape = result.state.shape.reached(form, point)
    found = Found(SolverState(shape, point.end_force, units, arclengths), point, outcome, state.index == 0)
    return Station(
        parameter=state.parameter,
        equilibrium=build_result(scene, found, jnp.ones((), int)),
        along=tangent,
        alignment=jnp.abs(cosine),
        index=state.index,
        stiffness=stiffness,
        motion=motion,
        slope=work(left, change, metric),
    )


@compiled
def is_misplaced(result: Equilibrium, made: Equilibrium) -> Bool[Array, ""]:
    """Whether a rod has slid so far that its mesh, that of `made` stretched, is to be made anew."""
    scaled, _ = nondimensional(result.scene)
    assert made.state.arclengths is not None
    form = SlidingForm.of(slid(scaled, made.state.arclengths), made.state.shape)
    point = free_form_and_point(result)[1]
    is_blocked = form.is_blocked(point)
    is_off = form.is_misplaced(point)
    return is_off if is_blocked is None else is_off | is_blocked


@compiled
def on_new_mesh(result: Equilibrium, along: BranchTangent, mesh: Shape) -> tuple[Equilibrium, BranchTangent]:
    """An equilibrium of a rod that slides on a mesh like that of a shape, to begin with, and the tangent of its branch.

    Of the tangent's multipliers those for the arclengths alone are of use there.
    """
    form, point = free_form_and_point(result)
    normal = short_sum(form.bases_at(point) * along.motion.rotation[None], axis=1)
    shape = on_mesh_of(nondimensional(result.scene)[0], result.state.shape, mesh)
    anew = eqx.tree_at(lambda result: result.state.shape, result, shape)
    there, begin = free_form_and_point(anew)
    before, after = _points(form), _points(there)
    normal = jax.vmap(lambda component: jnp.interp(after, before, component))(normal)
    motion = Motion(components(there.bases_at(begin), normal), along.motion.multipliers)
    return anew, BranchTangent(motion, along.rate)


def _points(form: Form) -> Float[Array, "m"]:
    """Arclengths of the tangents or frames."""
    field = form.field
    return (field.s[:-1] + field.s[1:]) / 2 if isinstance(field, EdgeTangents) else field.arclengths


def work(motion: Motion, change: Motion, metric: Metric) -> Float[Array, ""]:
    """What a change of the residual does in a motion of length 1, as a part of the most that one of its size could."""
    is_free = metric.mass > 0
    forces = jnp.where(is_free, 1 / jnp.where(is_free, metric.mass, 1.0), 0.0)[None] * change.rotation**2
    gaps, pulls = (jnp.sqrt(jnp.sum(x**2)) for x in (change.multipliers, motion.multipliers))
    most = jnp.sqrt(jnp.sum(forces)) + gaps * (1 + pulls)
    return times(motion, change) / jnp.where(most > 0, most, 1.0)


@compiled
def mode_at(result: Equilibrium, stiffness: Float[Array, ""], motion: Motion) -> Mode:
    """A motion of an equilibrium in SI units."""
    form, point = free_form_and_point(result)
    return mode_of(form, point, form.linearized(point), stiffness, motion, result)
