"""Searches under loads without a potential: from the rod without them, and by parts of them where all are too much.

No energy leads to such an equilibrium. A search by the square of what is out of balance, or by the energy with these
loads held as they are, may end in another equilibrium, or in none, where it begins far away. So a cold search begins
with the minimum without these loads; where it fails from there, it goes on with a half of them, a quarter, and from
what that leads to.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import Form, Point
from rodjax.discretization.nonconservative import conservative, scaled
from rodjax.model.scene import Scene
from rodjax.solving.newton import Find, Newton, NewtonEnd, find_equilibrium
from rodjax.solving.status import Outcome, is_converged

# The least part of the loads by which they grow.
LEAST_PART = 1 / 64


class _State(eqx.Module):
    """The part of the loads that the point bears, by how much it is to grow, and the last search under all of them."""

    point: Any
    part: Float[Array, ""]
    step: Float[Array, ""]
    end: NewtonEnd
    outcome: Outcome


def found_under_loads(form: Any, point: Point, solver: Newton, find: Find, is_cold: Bool[Array, ""]) -> NewtonEnd:
    """The equilibrium of a form with node positions or sliding clips, from a point that is one under other loads if it
    is not cold.
    """

    def search(part: Float[Array, ""] | None, point: Point) -> NewtonEnd:
        here: Form = dataclasses.replace(form, scene=bearing(form.scene, part))
        return find_equilibrium(here, point, solver, find)

    return put_on(search, point, is_cold, point.total_twist.dtype)


def bearing(scene: Scene, part: Float[Array, ""] | None) -> Scene:
    """A scene with a part of its loads without a potential, or without them."""
    return conservative(scene) if part is None else scaled(scene, part)


def put_on(
    search: Callable[[Float[Array, ""] | None, Any], NewtonEnd], point: Any, is_cold: Bool[Array, ""], dtype: Any
) -> NewtonEnd:
    """The same by a search under a part of these loads, or without them, from a point."""
    count, zero = jnp.zeros((), int), jnp.zeros((), dtype)
    outcome = Outcome(zero, count, count, count)
    begin = jax.lax.cond(is_cold, lambda: search(None, point), lambda: NewtonEnd(point, outcome, jnp.array(False)))

    def grown(state: _State) -> _State:
        part = jnp.minimum(state.part + state.step, 1.0)
        end = search(part, state.point)
        bears = is_converged(end.outcome.status)
        of_all = part == 1.0
        outcome = _sum(state.outcome, end.outcome)
        return _State(
            jax.tree.map(lambda new, old: jnp.where(bears, new, old), end.point, state.point),
            jnp.where(bears, part, state.part),
            jnp.where(bears, 2, 0.5) * state.step,
            jax.tree.map(lambda new, old: jnp.where(of_all, new, old), end, state.end),
            outcome,
        )

    state = _State(begin.point, zero, zero + 1, begin, begin.outcome)
    state = jax.lax.while_loop(lambda state: (state.part < 1) & (state.step >= LEAST_PART), grown, state)
    last = state.end.outcome
    outcome = Outcome(last.residual, state.outcome.iterations, state.outcome.evaluations, last.status)
    return NewtonEnd(state.end.point, outcome, state.end.is_stable)


def _sum(one: Outcome, other: Outcome) -> Outcome:
    """With the work of both."""
    return Outcome(other.residual, one.iterations + other.iterations, one.evaluations + other.evaluations, other.status)
