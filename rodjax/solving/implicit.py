"""How an equilibrium changes with its scene, by the implicit function theorem on the mixed form.

The point of an equilibrium makes the residual (gradient by rotations, constraint residual) vanish. A change of the
scene at the same point leaves a residual, and the linearised system that Newton's method factorises, block tridiagonal
with a border, says which rotations and forces take it away: O(n). All of it is made of differentiable operations, so
that the derivative has derivatives itself, and a transpose.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.checks import is_known
from rodjax.discretization.form import Point
from rodjax.discretization.motion import Motion
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.model.scene import Scene, has_contacts, nondimensional
from rodjax.programs.linear import linear
from rodjax.programs.parts import zeros
from rodjax.solving.result import Equilibrium, build_result
from rodjax.solving.result_form import form_and_point
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.stability import carried_to, examined
from rodjax.solving.status import Outcome


def not_differentiated(*values: Any) -> tuple[Any, ...]:
    """For a search: the derivatives of its iterations would be numbers that look right and are not."""
    return values if is_known(values) else jax.lax.stop_gradient(values)


def differentiable(scene: Scene, result: Equilibrium) -> Equilibrium:
    """What a search found, with the derivatives by the scene that the search for it has not. Both may be stacks."""
    return result if is_known(scene) else _differentiable(scene, result)


def with_zeros(change: Any, value: Any) -> Any:
    """The tangent of a value, zero where `filter_custom_jvp` has `None` for a number that does not change."""
    return jax.tree.map(
        lambda change, leaf: zeros(leaf) if change is None and leaf is not None else change,
        change,
        value,
        is_leaf=lambda change: change is None,
    )


@eqx.filter_custom_jvp
def _differentiable(scene: Scene, result: Equilibrium) -> Equilibrium:
    return result


@_differentiable.def_jvp
def _(primals, tangents):
    scene, result = primals
    scene_change = with_zeros(tangents[0], scene)
    # With derivatives of its own, for second ones of what is made of it.
    value = _differentiable(scene, result)
    if not is_known(scene, value):
        # It stays what the search found, whatever XLA makes of the same numbers beside the derivatives.
        scene, kept = jax.lax.optimization_barrier((scene, value))
        return value, _change_of_result(scene, kept, scene_change)
    return value, _change_of_result(scene, value, scene_change)


@linear
def _change_of_result(scene: Scene, result: Equilibrium, scene_change: Scene) -> Equilibrium:
    mapped = _change_of_one
    for _ in range(result.s.ndim - 1):
        mapped = jax.vmap(mapped)
    return mapped(scene, result, scene_change)


def _change_of_one(scene: Scene, result: Equilibrium, scene_change: Scene) -> Equilibrium:
    shape = result.state.shape
    outcome = Outcome(result.residual, result.iterations, result.evaluations, result.status)
    before = result.state.before

    def same(scene: Scene, shape: Shape, point: Point, arclengths: Float[Array, "slides"] | None) -> Equilibrium:
        units = nondimensional(scene)[1]
        nodal = point.nodal if has_contacts(scene) else None
        pressures, friction = (None, None) if nodal is None else (nodal.pressures, nodal.friction)
        state = SolverState(
            shape, point.end_force, units, arclengths, before=before, pressures=pressures, friction=friction
        )
        found = Found(state, point, outcome, result.stable)
        return build_result(scene, found, result.substeps)

    (scaled, _), (scaled_change, _) = jax.jvp(nondimensional, (scene,), (scene_change,))
    _, point = form_and_point(result)
    arclengths = result.state.arclengths
    changes = _change(scaled, scaled_change, shape, point, arclengths, result)
    _, change = jax.jvp(same, (scene, shape, point, arclengths), (scene_change, *changes))
    return jax.tree.map(lambda change: None if change.dtype == jax.dtypes.float0 else change, change)


def _change(
    scene: Scene,
    scene_change: Scene,
    shape: Shape,
    point: Point,
    arclengths: Float[Array, "slides"] | None,
    result: Equilibrium,
) -> tuple[Shape, Point, Float[Array, "slides"] | None]:
    """How shape and point of an equilibrium change with its scene, nondimensional, and the arclengths at which it
    slides through clips.

    Not a number where the point is no equilibrium, or critical. A turn that leaves it in equilibrium does not happen.
    """
    unknown = point if arclengths is None else SlidingPoint.settled_at(point, arclengths)
    form, begin = carried_to(scene, shape, unknown)
    here = form.linearized(begin)
    factors, is_critical, neutral = examined(form, begin, here, result.residual)

    def residual_vectors(scene: Scene) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        form, here = carried_to(scene, shape, unknown)
        return form.residual_vectors(here)

    def reached(scene: Scene, motion: Motion) -> tuple[Shape, Point, Float[Array, "slides"] | None]:
        form, there = carried_to(scene, shape, unknown, motion)
        arclengths = None
        if isinstance(form, SlidingForm):
            assert isinstance(there, SlidingPoint)
            form, there, arclengths = form.at(there.arclengths), there.inner, there.arclengths
        return shape.reached(form, there), form.settled(there), arclengths

    _, (f, c) = jax.jvp(residual_vectors, (scene,), (scene_change,))
    # A factor, as a choice between numbers would leave the transpose without the one that is none.
    sign = jnp.where(result.converged & ~is_critical, -1.0, jnp.nan).astype(f.dtype)
    f, c = sign * f, sign * c
    motion = neutral.taken_from(Motion(*factors.solve(f, c)))
    nothing = jax.tree.map(jnp.zeros_like, motion)
    return jax.jvp(reached, (scene, nothing), (scene_change, motion))[1]
