"""One branch of equilibria through a sequence of scenes or harnesses, stable or not, and the points on it where a
motion goes soft.

The parameter of a sequence of m scenes runs from 0 to m - 1 and names the scene between two of them. Along the branch
the residual (gradient by rotations, constraint residual) of the mixed form stays zero. A step goes along the tangent of
the branch and comes back to it at right angles (Keller 1977), in the metric of `stability.softest` for rotations beside
the parameter: a linearised system with a border, solved for two right sides with the factors of Newton's method, O(n).
At a fold the system itself is singular, with its border it is not.

Keller, "Numerical solution of bifurcation and nonlinear eigenvalue problems" (1977); Seydel, "Practical bifurcation and
stability analysis" (2010).
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.form import Form
from rodjax.discretization.motion import Motion
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm
from rodjax.geometry.vectors import components
from rodjax.linalg.blocks import short_sum
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene, nondimensional, slid
from rodjax.paths import harness_place, rod_place
from rodjax.paths.harness_modes import HarnessMode, mode_of_motion
from rodjax.paths.harness_place import HarnessProblem
from rodjax.paths.modes import Mode, mode_of
from rodjax.paths.place import added, left_of, less, nearest_to_zero, scaled
from rodjax.paths.rod_place import BranchContacts, RodProblem, pressing
from rodjax.programs.compilation import compiled
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_form import free_form_and_point
from rodjax.solving.search import on_mesh_of
from rodjax.solving.status import Outcome, Status

MAX_ITERATIONS = 12


class BranchTangent(eqx.Module):
    """A direction in which equilibria change: a motion, and the change of the parameter that goes with it."""

    motion: Any
    rate: Float[Array, ""]


class Station(eqx.Module):
    """A point of a branch.

    - `along`: the tangent of the branch, of length 1
    - `alignment`: cosine of the angle to the direction in which the step went
    - `stiffness`, `motion`: the eigenvalue [EI/L^2] of the Hessian nearest to zero, neutral turns apart, and its motion
    - `slope`: the work of the residual that a change of the parameter makes in this motion, as a part of the most that
      it could be
    - `contacts`: with obstacles; `None` without such, and of harnesses
    """

    parameter: Float[Array, ""]
    equilibrium: Equilibrium | HarnessEquilibrium
    along: BranchTangent
    alignment: Float[Array, ""]
    index: Int[Array, ""]
    stiffness: Float[Array, ""]
    motion: Any
    slope: Float[Array, ""]
    contacts: BranchContacts | None

    @property
    def closed(self) -> Bool[Array, "k n+1"] | None:
        """The contacts that count as closed."""
        return None if self.contacts is None else self.contacts.closed

    def reversed(self) -> "Station":
        """The same on the way back."""
        contacts = self.contacts
        if contacts is not None:
            contacts = dataclasses.replace(contacts, rates=-contacts.rates)
        along = jax.tree.map(jnp.negative, self.along)
        return dataclasses.replace(self, along=along, contacts=contacts)


def problem_of(
    scenes: Scene | Harness, segment: Int[Array, ""], result: Any, closed: Bool[Array, "k n+1"] | None = None
) -> Any:
    """The scenes or harnesses about an equilibrium, of a rod with these contacts closed; `None`: those that press."""
    if isinstance(scenes, Harness):
        return HarnessProblem(scenes, segment, result)
    return RodProblem(scenes, segment, result, closed)


def count_of(scenes: Scene | Harness) -> int:
    """How many scenes or harnesses are stacked."""
    return (scenes.scenes[0] if isinstance(scenes, Harness) else scenes).rod.length.shape[0]


def no_motion(result: Equilibrium | HarnessEquilibrium) -> Any:
    """A motion of an equilibrium that leaves it where it is."""
    if isinstance(result, HarnessEquilibrium):
        return harness_place.no_motion(result)
    return rod_place.no_motion(result)


class _Correction(eqx.Module):
    """Where a correction is: what was found at the point, and the point to look at next."""

    parameter: Float[Array, ""]
    point: Any
    kept: Any  # of the place
    magnitude: Float[Array, ""]
    follows: Any  # how the equilibrium follows the parameter
    index: Int[Array, ""]
    is_converged: Bool[Array, ""]
    iterations: Int[Array, ""]


@compiled
def stepped(
    scenes: Scene | Harness,
    segment: Int[Array, ""],
    parameter: Float[Array, ""],
    result: Equilibrium | HarnessEquilibrium,
    along: BranchTangent,
    distance: Float[Array, ""],
    target: Float[Array, ""],
    closed: Bool[Array, "k n+1"] | None,
) -> Station:
    """The equilibrium at a distance along a direction, at right angles to it; or under the parameter `target`.

    `target`: not a number where the parameter is free; `closed`: the contacts that stay closed, as others stay open.
    """
    problem = problem_of(scenes, segment, result, closed)
    is_given = ~jnp.isnan(target)
    first = jnp.where(is_given, target, parameter + distance * along.rate)
    direction, reach = problem.departure(parameter, along.motion, distance)
    predicted = problem.moved(first, problem.point, scaled(along.motion, distance))
    per_square = 1 / problem.scale**2

    def corrected(state: _Correction) -> _Correction:
        place = problem.linearized(state.parameter, state.point)
        metric, neutral = place.metric, place.neutral()
        factors = place.regularized(neutral)
        back, follows = (
            less(factors.solve(jax.tree.map(jnp.negative, right)), neutral, metric)
            for right in (place.residual, place.change)
        )
        across = place.components(direction)
        squared = jnp.where(is_given, 1.0, metric.inner(across, follows) + per_square * along.rate)
        share = jnp.where(is_given, 0.0, -metric.inner(across, back)) / squared
        part, retracted = problem.retracted(place, added(back, follows, share))
        is_there = place.is_balanced
        return _Correction(
            parameter=jnp.where(is_there, state.parameter, state.parameter + part * share),
            point=jax.tree.map(lambda here, there: jnp.where(is_there, here, there), place.point, retracted),
            kept=place.kept,
            magnitude=place.magnitude,
            follows=follows,
            index=factors.negative,
            is_converged=is_there,
            iterations=state.iterations + 1,
        )

    def is_running(state: _Correction) -> Bool[Array, ""]:
        return ~state.is_converged & (state.iterations < MAX_ITERATIONS) & jnp.isfinite(state.parameter)

    count = jnp.zeros((), int)
    kept = jax.eval_shape(lambda: problem.linearized(first, predicted).kept)
    kept = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), kept)
    still = jax.tree.map(jnp.zeros_like, along.motion)
    # A step that takes a clip beyond its neighbours is none.
    begins = count if reach is None else jnp.where(reach < 1, MAX_ITERATIONS, count)
    state = _Correction(first, predicted, kept, jnp.zeros_like(first), still, count, jnp.array(False), begins)
    state = jax.lax.while_loop(is_running, corrected, state)

    place = problem.again(state.parameter, state.point, state.kept)
    metric = place.metric
    # The tangent, on in the direction in which the step went.
    size = jnp.sqrt(metric.inner(state.follows, state.follows) + per_square)
    cosine = (metric.inner(place.components(direction), state.follows) + per_square * along.rate) / size
    sign = jnp.where(cosine < 0, -1.0, 1.0).astype(size.dtype) / size
    neutral = place.neutral()
    stiffness, motion = nearest_to_zero(place, neutral)
    left = left_of(place, neutral, motion)
    status = jnp.where(state.is_converged, Status.CONVERGED, Status.MAX_ITERATIONS)
    outcome = Outcome(state.magnitude, state.iterations, state.iterations, status.astype(int))
    along = BranchTangent(scaled(state.follows, sign), sign)
    contacts = None
    if closed is not None:
        contacts = problem.contacts(state.parameter, place, along.motion, along.rate)
    return Station(
        parameter=state.parameter,
        equilibrium=problem.result(state.parameter, place, outcome, state.index),
        along=along,
        alignment=jnp.abs(cosine),
        index=state.index,
        stiffness=stiffness,
        motion=motion,
        slope=place.work_share(left),
        contacts=contacts,
    )


@compiled
def closed_contacts(result: Equilibrium) -> Bool[Array, "k n+1"] | None:
    """Those that press; `None` without obstacles."""
    return pressing(result)


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


def mode_at(result: Equilibrium | HarnessEquilibrium, stiffness: Float[Array, ""], motion: Any) -> Mode | HarnessMode:
    """A motion of an equilibrium in SI units."""
    if isinstance(result, HarnessEquilibrium):
        return mode_of_motion(result, stiffness, motion)
    return _mode_at(result, stiffness, motion)


@compiled
def _mode_at(result: Equilibrium, stiffness: Float[Array, ""], motion: Motion) -> Mode:
    form, point = free_form_and_point(result)
    return mode_of(form, point, form.linearized(point), stiffness, motion, result)
