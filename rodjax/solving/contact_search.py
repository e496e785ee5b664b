"""Where a rod lies that touches obstacles: Newton's method, with contacts that become stiffer and stiffer.

A rod that begins within an obstacle, or that its loads drive into one, would be thrown about by full contacts. So the
first ones are soft: all loads together press the rod in by a part of its radius, or as deep as it begins; each
equilibrium is then the start of the next, until the contacts are those of a result. A start that touches already begins
with stiffer ones, and one that is all but in equilibrium with full ones.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import Point
from rodjax.discretization.touching import PENETRATION, TouchingForm
from rodjax.solving.newton import Find, Newton, NewtonEnd, find_equilibrium
from rodjax.solving.status import Outcome, Status

# Into the first contacts all loads together press the rod so deep, in parts of its radius; where the start touches, so
# deep. From there on they become stiffer by STIFFENING at a time.
FIRST_DEPTH = 0.3
TOUCHING_DEPTH = 4e-3
STIFFENING = 30.0
# The residual [EI/L^2] of a start that is all but in equilibrium, and as a part of the largest force through it: light
# rods begin with no more.
NEAR = 1.0
NEAR_PART = 0.1


class _Stage(eqx.Module):
    """What was found with the last contacts, and the softening of the next ones."""

    softening: Float[Array, ""]
    end: NewtonEnd
    is_done: Bool[Array, ""]


def find_touching(form: TouchingForm, point: Point, solver: Newton, find: Find = "minimum") -> NewtonEnd:
    """The equilibrium reached from `point`."""
    depths = form.depths(form.positions(form.edges(point)))
    deepest = depths.reshape(-1)[jnp.argmax(depths)]
    touches = jnp.any(point.end_force[:, 1:] != point.end_force[:, :-1])
    least = jnp.where(touches, TOUCHING_DEPTH, FIRST_DEPTH)
    radius = form.radius
    thinnest = radius[jnp.argmin(radius)]
    depth = jnp.where(deepest > least * thinnest, deepest, least * thinnest)
    soft = PENETRATION * thinnest / depth
    is_near = form.linearized(point).residual <= jnp.minimum(NEAR, NEAR_PART * form.largest_force(point))
    count = jnp.zeros((), int)
    outcome = Outcome(jnp.zeros_like(soft), count, count, jnp.full((), Status.RUNNING, int))
    begin = NewtonEnd(point, outcome, jnp.array(False))

    def solved(stage: _Stage) -> _Stage:
        end = find_equilibrium(form.softened(stage.softening), stage.end.point, solver, find)
        before = stage.end.outcome
        end = eqx.tree_at(
            lambda end: (end.outcome.iterations, end.outcome.evaluations),
            end,
            (end.outcome.iterations + before.iterations, end.outcome.evaluations + before.evaluations),
        )
        stiffer = STIFFENING * stage.softening
        return _Stage(jnp.where(stiffer < 1, stiffer, 1.0), end, stage.softening >= 1)

    stage = _Stage(jnp.where(is_near | (soft > 1), 1.0, soft), begin, jnp.array(False))
    return jax.lax.while_loop(lambda stage: ~stage.is_done, solved, stage).end
