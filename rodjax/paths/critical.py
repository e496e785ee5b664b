"""How a critical point moves with the numbers of its scenes: the implicit function theorem on the extended system.

At a fold the residual F vanishes under a change of the scenes where F_p dp + F_lambda d(lambda), the work in the
critical motion, does. At a branch point the critical eigenvalue stays zero: the quadratic form of the critical motion,
which changes with the scenes, the parameter and the equilibrium; this follows by the linearised system, in which
motions without stiffness take no part (Werner & Spence 1984). In both cases a number that is a function of scenes and
parameter alone stays zero, and its derivatives by both, in one sweep backwards, say how the parameter follows.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.form import Linearization
from rodjax.discretization.motion import Motion
from rodjax.model.scene import Scene
from rodjax.paths.branch import (
    Problem,
    Regularized,
    added,
    less,
    mass,
    nearest_to_zero,
    neutral_motion,
    regularized,
    times,
)
from rodjax.programs.compilation import compiled
from rodjax.solving.result import Equilibrium, form_and_point

# A second motion with less stiffness than this [EI/L^2] is critical too, as in a rod that buckles in all directions.
DOUBLE = 1e-5


@eqx.filter_custom_jvp
def differentiable_parameter(
    scenes: Scene, parameter: Float[Array, ""], result: Equilibrium, is_fold: bool
) -> Float[Array, ""]:
    """The parameter of a critical point, with its derivative by the scenes."""
    return parameter


@differentiable_parameter.def_jvp
def _(primals, tangents):
    scenes, parameter, result, is_fold = primals
    gradient = _gradient(_once(scenes), parameter, result, is_fold)
    changes = jax.tree.map(
        lambda by, change: jnp.zeros_like(parameter) if change is None else jnp.sum(by * change),
        gradient,
        tangents[0],
    )
    return parameter, functools.reduce(jnp.add, jax.tree.leaves(changes))


@jax.custom_jvp
def _once(scenes: Scene) -> Scene:
    return scenes


@_once.defjvp
def _(primals, tangents):
    raise NotImplementedError("critical_point has first derivatives only")


@functools.partial(compiled, static_argnames=("is_fold",))
def _gradient(scenes: Scene, parameter: Float[Array, ""], result: Equilibrium, is_fold: bool) -> Scene:
    """The derivative of the parameter by the scenes."""
    form, point = form_and_point(result)
    here = form.linearized(point)
    weights = mass(form, here)
    neutral = neutral_motion(form, point, here)
    _, critical = nearest_to_zero(form, point, here, neutral)
    segment = jnp.clip(jnp.floor(parameter), 0, scenes.rod.length.shape[0] - 2).astype(int)

    def linearized(scenes: Scene, parameter: Float[Array, ""], motion: Motion | None = None) -> Linearization:
        form, there = Problem(scenes, segment, result).at(parameter, point, motion)
        return form.linearized(there)

    def eigenvalue(there: Linearization) -> Float[Array, ""]:
        return times(critical, Motion(*there.system.times(critical.rotation, critical.multipliers)))

    if is_fold:
        weight = critical
    else:
        stiffness, second = nearest_to_zero(form, point, here, neutral, (critical,))
        second = jax.tree.map(lambda x: jnp.where(jnp.abs(stiffness) < DOUBLE, x, 0.0), second)
        nothing = jax.tree.map(jnp.zeros_like, critical)
        by_motion = jax.grad(lambda motion: eigenvalue(linearized(scenes, parameter, motion)))(nothing)
        followed = _solved(regularized(form, here, neutral), here, by_motion, weights, (critical, second, neutral))
        weight = jax.tree.map(jnp.negative, followed)

    def stays_zero(scenes: Scene, parameter: Float[Array, ""]) -> Float[Array, ""]:
        there = linearized(scenes, parameter)
        work = times(weight, Motion(there.gradient, there.closure))
        return work if is_fold else work + eigenvalue(there)

    by_scenes, by_parameter = jax.grad(stays_zero, argnums=(0, 1))(scenes, parameter)
    return jax.tree.map(lambda by: -by / by_parameter, by_scenes)


def _solved(
    factors: Regularized, here: Linearization, right: Motion, mass: Float[Array, "m"], without: tuple[Motion, ...]
) -> Motion:
    """The solution of the linearised system at right angles to motions that have no stiffness, of length 1 or none."""

    def step(right: Motion) -> Motion:
        for motion in without:
            share = times(motion, right)
            right = Motion(right.rotation - share * mass[None] * motion.rotation, right.multipliers)
        found = factors.solve(right)
        for motion in without:
            found = less(found, motion, mass)
        return found

    one = jnp.ones((), mass.dtype)
    found = step(right)
    # What the shift, by which the system is regular, has changed.
    left = added(right, Motion(*here.system.times(found.rotation, found.multipliers)), -one)
    return added(found, step(left), one)
