"""How a solve ended, in numbers that survive `jit` and `vmap`, and in words."""

import enum
import functools
import operator

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Status(enum.IntEnum):
    """The code in `Equilibrium.status`."""

    CONVERGED = 0
    ROUNDING_FLOOR = 1
    MAX_ITERATIONS = 2
    LINE_SEARCH_FAILED = 3
    NOT_FINITE = 4
    RUNNING = 5
    SADDLE = 6
    NOT_PLANAR = 7
    COLLAPSED = 8
    OVERSTRETCHED = 9
    PASSED_THROUGH = 10
    OUT_OF_RANGE = 12
    SLID_OUT = 13
    CROWDED = 14

    @property
    def message(self) -> str:
        return {
            Status.CONVERGED: "converged: the gradient fell below the tolerance",
            Status.ROUNDING_FLOOR: "converged to the rounding floor of this mesh, which lies above the tolerance",
            Status.MAX_ITERATIONS: "not converged: stopped at the largest number of iterations",
            Status.LINE_SEARCH_FAILED: "not converged: the line search found no better point",
            Status.NOT_FINITE: "not converged: the energy or its gradient is not a finite number",
            Status.RUNNING: "not finished",
            Status.SADDLE: "not converged: an equilibrium was found that is not a minimum, and no way down from it",
            Status.NOT_PLANAR: "not converged: planar is True, but supports, loads or twist leave the plane",
            Status.COLLAPSED: "not converged: loads press the rod to nothing (axial strain below -1): EA is too small",
            Status.OVERSTRETCHED: "converged, but the rod is strained by more than `strain_limit`",
            Status.OUT_OF_RANGE: "not converged: a number of the scene makes no sense, such as a stiffness that is not "
            "positive, an arclength beyond the rod, or too coarse a mesh for jumps of `Steps` near to one another or "
            "for a rod that turns often at rest",
            Status.CROWDED: "not converged: rods of a harness touch one another on more elements than are sought "
            "together, 32 of a pair of cables: fewer `segments` may do",
            Status.SLID_OUT: "not converged: a rod slides out of a clip",
            Status.PASSED_THROUGH: "not converged: from its start the rod came through an obstacle, or lies within one",
        }[self]


# The codes of an equilibrium.
CONVERGED = (Status.CONVERGED, Status.ROUNDING_FLOOR, Status.OVERSTRETCHED)


class Outcome(eqx.Module):
    """How a solver ended: the largest force left, iterations, evaluations of energy and gradient, and a `Status`."""

    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    evaluations: Int[Array, ""]
    status: Int[Array, ""]


def is_converged(status: Int[Array, "..."]) -> Bool[Array, "..."]:
    """Whether a code, or each of an array of them, stands for an equilibrium."""
    first, *others = (status == code for code in CONVERGED)
    return functools.reduce(operator.or_, others, first)


def with_strain(
    status: Int[Array, ""], axial_strain: Float[Array, "n"], strain_limit: Float[Array, ""] | float
) -> Int[Array, ""]:
    """The code of an equilibrium, `OVERSTRETCHED` where its largest |axial strain| is above `strain_limit`."""
    limit = jnp.asarray(strain_limit, axial_strain.dtype)
    is_over = is_converged(status) & (jnp.max(jnp.abs(axial_strain)) > limit)
    return jnp.where(is_over, Status.OVERSTRETCHED, status)
