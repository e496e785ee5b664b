"""Where a rod lies that touches obstacles: Newton's method, with contacts that become stiffer and stiffer.

A rod that begins within an obstacle, or that its loads drive into one, would be thrown about by full contacts. So the
first ones are soft; each equilibrium is then the start of the next, until the contacts are those of a result. Where
the start is in contact already, such as an equilibrium of a scene nearby, they are tried at once.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.mixed import MixedPoint
from rodjax.discretization.touching import BENDING, TouchingForm
from rodjax.solvers.newton import Find, Newton, NewtonEnd, find_equilibrium
from rodjax.status import Outcome, Status, is_converged

# Contacts become stiffer by this factor at a time, from such as a force that bends the rod presses in by FIRST_DEPTH.
STIFFENING = 30.0
FIRST_DEPTH = 0.05


class _Stage(eqx.Module):
    """What was found with the last contacts, and the softening of the next ones; whether these are the last."""

    softening: Float[Array, ""]
    end: NewtonEnd
    is_first: Bool[Array, ""]
    is_done: Bool[Array, ""]


def find_touching(form: TouchingForm, point: MixedPoint, solver: Newton, find: Find = "minimum") -> NewtonEnd:
    """The equilibrium reached from `point`."""
    depths = form.depths(form.positions(form.edges(point)))
    deepest = depths.reshape(-1)[jnp.argmax(depths)]
    soft = BENDING / (form.stiffness * jnp.where(deepest > FIRST_DEPTH, deepest, FIRST_DEPTH))
    touches = jnp.any(point.end_force[:, 1:] != point.end_force[:, :-1]) & (form.stiffness * deepest < BENDING)
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
        # Full contacts that were tried at once, in vain, are come to by softer ones.
        again = stage.is_first & (stage.softening >= 1) & ~is_converged(end.outcome.status)
        point = jax.tree.map(lambda begin, reached: jnp.where(again, begin, reached), begin.point, end.point)
        stiffer = STIFFENING * stage.softening
        following = jnp.where(again, soft, jnp.where(stiffer < 1, stiffer, 1.0))
        end = eqx.tree_at(lambda end: end.point, end, point)
        return _Stage(following, end, jnp.array(False), (stage.softening >= 1) & ~again)

    stage = _Stage(jnp.where(touches, 1.0, soft), begin, jnp.array(True), jnp.array(False))
    return jax.lax.while_loop(lambda stage: ~stage.is_done, solved, stage).end
