"""Searches under loads without a potential: from the rod without them, and by parts of them where all are too much.

No energy leads to such an equilibrium. A search that makes the square of what is out of balance less ends where this
has a minimum, or in another equilibrium, where it begins far away. So a cold search begins with the minimum without
these loads; where it fails from there, it goes on with a half of them, a quarter, and from what that leads to.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import Form, Point
from rodjax.discretization.nonconservative import conservative, scaled
from rodjax.solving.newton import Find, Newton, NewtonEnd, find_equilibrium
from rodjax.solving.status import Outcome, is_converged

# The least part of the loads by which they grow.
LEAST_PART = 1 / 64


class _State(eqx.Module):
    """The part of the loads that the point bears, by how much it is to grow, and the last search under all of them."""

    point: Point
    part: Float[Array, ""]
    step: Float[Array, ""]
    end: NewtonEnd
    outcome: Outcome


def found_under_loads(form: Any, point: Point, solver: Newton, find: Find, is_cold: Bool[Array, ""]) -> NewtonEnd:
    """The equilibrium of a form with node positions or sliding clips, from a point that is one under other loads if it
    is not cold.
    """
    without: Form = dataclasses.replace(form, scene=conservative(form.scene))
    count = jnp.zeros((), int)
    outcome = Outcome(jnp.zeros_like(point.total_twist), count, count, count)
    begin = jax.lax.cond(
        is_cold,
        lambda: find_equilibrium(without, point, solver, find),
        lambda: NewtonEnd(point, outcome, jnp.array(False)),
    )

    def grown(state: _State) -> _State:
        part = jnp.minimum(state.part + state.step, 1.0)
        here = dataclasses.replace(form, scene=scaled(form.scene, part))
        end = find_equilibrium(here, state.point, solver, find)
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

    one = jnp.ones((), point.total_twist.dtype)
    state = _State(begin.point, 0 * one, one, begin, begin.outcome)
    state = jax.lax.while_loop(lambda state: (state.part < 1) & (state.step >= LEAST_PART), grown, state)
    last = state.end.outcome
    outcome = Outcome(last.residual, state.outcome.iterations, state.outcome.evaluations, last.status)
    return NewtonEnd(state.end.point, outcome, state.end.is_stable)


def _sum(one: Outcome, other: Outcome) -> Outcome:
    """With the work of both."""
    return Outcome(other.residual, one.iterations + other.iterations, one.evaluations + other.evaluations, other.status)
