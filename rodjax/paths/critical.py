"""How a critical point moves with the numbers of its scenes: the implicit function theorem on the extended system.

At a fold the residual F vanishes under a change of the scenes where F_p dp + F_lambda d(lambda), the work in the
critical motion, does. At a branch point the critical eigenvalue stays zero: the quadratic form of the critical motion,
which changes with the scenes, the parameter and the equilibrium; this follows by the linearised system, in which
motions without stiffness take no part (Werner & Spence 1984). Where a contact opens or closes its pressure or gap stays
zero. In all cases a number that is a function of scenes and parameter alone stays zero, and its derivatives by both, in
one sweep backwards, say how the parameter follows.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.paths.branch import count_of, problem_of
from rodjax.paths.place import MotionMetric, Place, PlaceFactors, added, left_of, less, nearest_to_zero, work
from rodjax.programs.compilation import compiled
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium

# A second motion with less stiffness than this [EI/L^2] is critical too, as in a rod that buckles in all directions.
DOUBLE = 1e-5


class Changing(eqx.Module):
    """The closed contacts on the side from which a branch comes, and the row and node of one that opens or closes."""

    closed: Any
    contact: Int[Array, "2"]


@eqx.filter_custom_jvp
def differentiable_parameter(
    scenes: Scene | Harness,
    parameter: Float[Array, ""],
    result: Equilibrium | HarnessEquilibrium,
    is_fold: bool,
    changing: Changing | None,
) -> Float[Array, ""]:
    """The parameter of a critical point, with its derivative by the scenes; `changing`: of one that a contact makes."""
    return parameter


@differentiable_parameter.def_jvp
def _(primals, tangents):
    scenes, parameter, result, is_fold, changing = primals
    if changing is None:
        gradient = _gradient(_once(scenes), parameter, result, is_fold)
    else:
        gradient = _gradient_of_change(_once(scenes), parameter, result, changing)
    changes = jax.tree.map(
        lambda by, change: jnp.zeros_like(parameter) if change is None else jnp.sum(by * change),
        gradient,
        tangents[0],
    )
    return parameter, functools.reduce(jnp.add, jax.tree.leaves(changes))


@jax.custom_jvp
def _once(scenes: Any) -> Any:
    return scenes


@_once.defjvp
def _(primals, tangents):
    raise NotImplementedError("critical_point has first derivatives only")


@functools.partial(compiled, static_argnames=("is_fold",))
def _gradient(scenes: Any, parameter: Float[Array, ""], result: Any, is_fold: bool) -> Any:
    """The derivative of the parameter by the scenes."""
    segment = jnp.clip(jnp.floor(parameter), 0, count_of(scenes) - 2).astype(int)
    begin = problem_of(scenes, segment, result)
    point = begin.point
    here = begin.located(parameter, point)
    neutral = here.neutral()
    _, critical = nearest_to_zero(here, neutral)
    left = left_of(here, neutral, critical)

    nothing = jax.tree.map(jnp.zeros_like, critical)

    def residual(scenes: Any, parameter: Float[Array, ""], motion: Any) -> tuple[Any, Float[Array, ""]]:
        """Of a moved point, and its critical eigenvalue."""
        problem = problem_of(scenes, segment, result)
        place = problem.located(parameter, problem.moved(parameter, point, motion))
        return place.residual, work(left, place.times(critical))

    (_, none), derivatives = jax.vjp(residual, scenes, parameter, nothing)
    if is_fold:
        by_scenes, by_parameter, _ = derivatives((left, jnp.zeros_like(none)))
        return jax.tree.map(lambda by: -by / by_parameter, by_scenes)
    stiffness, second = nearest_to_zero(here, neutral, (critical,))
    other = left_of(here, neutral, second, (left,))
    is_double = jnp.abs(stiffness) < DOUBLE
    second, other = jax.tree.map(lambda x: jnp.where(is_double, x, 0.0), (second, other))
    *of_eigenvalue, by_motion = derivatives((nothing, jnp.ones_like(none)))
    place = here.transposed()
    on_right, on_left = (critical, second, neutral), (left, other, neutral)
    followed = _solved(place.regularized(neutral), place, by_motion, here.metric, on_right, on_left)
    # What stays zero: the eigenvalue less the work of the residual in this motion.
    *of_work, _ = derivatives((followed, jnp.zeros_like(none)))
    by_scenes, by_parameter = jax.tree.map(jnp.subtract, of_eigenvalue, of_work)
    return jax.tree.map(lambda by: -by / by_parameter, by_scenes)


@compiled
def _gradient_of_change(scenes: Any, parameter: Float[Array, ""], result: Any, changing: Changing) -> Any:
    """The same where a pressure or a gap becomes zero."""
    segment = jnp.clip(jnp.floor(parameter), 0, count_of(scenes) - 2).astype(int)
    begin = problem_of(scenes, segment, result, changing.closed)
    point = begin.point
    here = begin.located(parameter, point)
    nothing = jax.tree.map(jnp.zeros_like, here.residual)

    def amount(scenes: Any, parameter: Float[Array, ""], motion: Any) -> tuple[Any, Float[Array, ""]]:
        problem = problem_of(scenes, segment, result, changing.closed)
        place = problem.located(parameter, problem.moved(parameter, point, motion))
        return place.residual, problem.amounts(place)[tuple(changing.contact)]

    (_, none), derivatives = jax.vjp(amount, scenes, parameter, nothing)
    *of_amount, by_motion = derivatives((nothing, jnp.ones_like(none)))
    neutral = here.neutral()
    followed = _solved(here.regularized(neutral), here, by_motion, here.metric, (neutral,), (neutral,))
    *of_work, _ = derivatives((followed, jnp.zeros_like(none)))
    by_scenes, by_parameter = jax.tree.map(jnp.subtract, of_amount, of_work)
    return jax.tree.map(lambda by: -by / by_parameter, by_scenes)


def _solved(
    factors: PlaceFactors,
    place: Place,
    right: Any,
    metric: MotionMetric,
    left_without: tuple[Any, ...],
    without: tuple[Any, ...],
) -> Any:
    """The solution of a linearised system at right angles to its null vectors, for a right side without what does work
    in its left ones, of length 1 or none.
    """

    def step(right: Any) -> Any:
        for motion in left_without:
            right = added(right, metric.times(motion), -work(motion, right))
        found = factors.solve(right)
        for motion in without:
            found = less(found, motion, metric)
        return found

    one = jnp.ones((), work(right, right).dtype)
    found = step(right)
    # What the shift, by which the system is regular, has changed.
    return added(found, step(added(right, place.times(found), -one)), one)
