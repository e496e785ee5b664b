"""Where a rod lies that touches obstacles: Newton's method, with contacts that become stiffer and stiffer.

A rod that begins deep within an obstacle would be thrown out of it by full contacts. So the first ones are as soft as
the deepest place asks for; each equilibrium is then the start of the next, until the contacts are those of a result.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.mixed import MixedPoint
from rodjax.discretization.touching import BENDING, TouchingForm
from rodjax.solvers.newton import Find, Newton, NewtonEnd, find_equilibrium
from rodjax.status import Outcome, Status

# Contacts become stiffer by this factor at a time.
STIFFENING = 30.0


class _Stage(eqx.Module):
    """The softening of the last contacts, and what was found with them."""

    softening: Float[Array, ""]
    end: NewtonEnd
    is_last: Bool[Array, ""]


def find_touching(form: TouchingForm, point: MixedPoint, solver: Newton, find: Find = "minimum") -> NewtonEnd:
    """The equilibrium reached from `point`."""
    depths = form.depths(form.positions(form.edges(point)))
    deepest = jnp.sort(depths.reshape(-1))[-1]
    # So that the deepest place is pushed out by a force such as bends the rod.
    first = BENDING / jnp.where(deepest > 0, form.stiffness * deepest, BENDING)
    count = jnp.zeros((), int)
    nothing = NewtonEnd(
        point, Outcome(jnp.zeros_like(first), count, count, jnp.full((), Status.RUNNING, int)), first > 0
    )

    def solved(stage: _Stage) -> _Stage:
        softening = jnp.where(STIFFENING * stage.softening < 1, STIFFENING * stage.softening, 1.0)
        end = find_equilibrium(form.softened(softening), stage.end.point, solver, find)
        before = stage.end.outcome
        end = eqx.tree_at(
            lambda end: (end.outcome.iterations, end.outcome.evaluations),
            end,
            (end.outcome.iterations + before.iterations, end.outcome.evaluations + before.evaluations),
        )
        return _Stage(softening, end, softening >= 1)

    stage = _Stage(first / STIFFENING, nothing, jnp.array(False))
    return jax.lax.while_loop(lambda stage: ~stage.is_last, solved, stage).end
