"""How an equilibrium changes with its scene, by the implicit function theorem on the mixed form.

The point of an equilibrium makes the residual (gradient by rotations, closure) vanish. A change of the scene at the
same point leaves a residual, and the linearised system that Newton's method factorises, block tridiagonal with a
border, says which rotations and forces take it away: O(n). All of it is made of differentiable operations, so that the
derivative has derivatives itself, and a transpose.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.checks import is_known
from rodjax.discretization.form import Point
from rodjax.discretization.forms import form_of
from rodjax.discretization.motion import Motion
from rodjax.discretization.shape import Shape
from rodjax.model.scene import Scene, has_contacts, nondimensional, slid, sliding_places
from rodjax.programs.linear import linear
from rodjax.solving.result import Equilibrium, Found, SolverState, build_result, form_and_point
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
        lambda change, leaf: jnp.zeros_like(leaf) if change is None and leaf is not None else change,
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
    # It stays what the search found, whatever XLA makes of the same numbers beside the derivatives.
    return value, _change_of_result(*jax.lax.optimization_barrier((scene, value)), scene_change)


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

    def same(scene: Scene, shape: Shape, point: Point, places: Float[Array, "slides"] | None) -> Equilibrium:
        units = nondimensional(scene)[1]
        nodal = point.nodal if has_contacts(scene) else None
        pressures, friction = (None, None) if nodal is None else (nodal.pressures, nodal.friction)
        state = SolverState(
            shape, point.end_force, units, places, before=before, pressures=pressures, friction=friction
        )
        found = Found(state, point, outcome, result.stable)
        return build_result(scene, found, result.substeps)

    (scaled, _), (scaled_change, _) = jax.jvp(nondimensional, (scene,), (scene_change,))
    _, point = form_and_point(result)
    places, of_places = result.state.places, None
    if places is None:
        changes = _response(scaled, shape, point, result)(scaled_change)
    else:
        changes, of_places = _slid_change(slid(scaled, places), scaled_change, shape, point, result)
    _, change = jax.jvp(same, (scene, shape, point, places), (scene_change, *changes, of_places))
    return jax.tree.map(lambda change: None if change.dtype == jax.dtypes.float0 else change, change)


def _slid_change(
    scene: Scene, scene_change: Scene, shape: Shape, point: Point, result: Equilibrium
) -> tuple[tuple[Shape, Point], Float[Array, "slides"]]:
    """The change of shape and point of an equilibrium with that of its nondimensional scene and of the arclengths of
    its sliding clips, and the latter: by as much as leaves them without axial force.
    """
    respond = _response(scene, shape, point, result)

    def with_axial(change: Scene) -> tuple[tuple[Shape, Point], Float[Array, "slides"]]:
        """And what the axial forces gain."""
        changes = respond(change)

        def axial(scene: Scene, shape: Shape, point: Point) -> Float[Array, "slides"]:
            return form_of(scene, shape).axial_forces(point)

        return changes, jax.jvp(axial, (scene, shape, point), (change, *changes))[1]

    places = sliding_places(scene)
    assert places is not None
    alone = jax.tree.map(jnp.zeros_like, scene)
    each = jnp.eye(len(places), dtype=places.dtype)
    by_places, rates = jax.vmap(lambda change: with_axial(slid(alone, change)))(each)
    fixed, gained = with_axial(slid(scene_change, jnp.zeros_like(places)))
    of_places = -jnp.linalg.solve(rates.T, gained)
    return jax.tree.map(lambda one, rate: one + jnp.tensordot(of_places, rate, 1), fixed, by_places), of_places


def _response(scene: Scene, shape: Shape, point: Point, result: Equilibrium) -> Callable[[Scene], tuple[Shape, Point]]:
    """How shape and point of an equilibrium change with its scene, nondimensional.

    Not a number where the point is no equilibrium, or critical. A turn that leaves it in equilibrium does not happen.
    """
    form, begin = carried_to(scene, shape, point)
    here = form.linearized(begin)
    factors, is_critical, neutral = examined(form, begin, here, result.residual)

    def gradient(scene: Scene) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        form, here = carried_to(scene, shape, point)
        return form.unbalanced(here)

    def reached(scene: Scene, motion: Motion) -> tuple[Shape, Point]:
        form, there = carried_to(scene, shape, point, motion)
        return shape.reached(form, there), form.settled(there)

    def respond(scene_change: Scene) -> tuple[Shape, Point]:
        _, (f, c) = jax.jvp(gradient, (scene,), (scene_change,))
        # A factor, as a choice between numbers would leave the transpose without the one that is none.
        sign = jnp.where(result.converged & ~is_critical, -1.0, jnp.nan).astype(f.dtype)
        f, c = sign * f, sign * c
        motion = neutral.taken_from(Motion(*factors.solve(f, c)))
        nothing = jax.tree.map(jnp.zeros_like, motion)
        _, changes = jax.jvp(reached, (scene, nothing), (scene_change, motion))
        return changes

    return respond
