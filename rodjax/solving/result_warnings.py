"""Warnings of solves: of what did not converge, of strains, of meshes and of single precision."""

import functools
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import is_known
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.solving.description import largest_strain, outcome_told, too_short
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium
from rodjax.solving.status import Status
from rodjax.warn import warn

# An element, or an edge of finite differences, along which the rod turns by more than this [rad] is too coarse for any
# figure: in 64 random scenes the shape was then off by 0.2 to 40 % of the length on elements, by 2 to 8 % on edges.
MOST_TURN = {"hermite": 3.0, "finite_difference": math.pi / 2}


class NotConvergedWarning(UserWarning):
    """A solve ended without an equilibrium; the message says why."""


class OverstretchedWarning(UserWarning):
    """An equilibrium is strained by more than `strain_limit`; the message says by how much, and where."""


class MeshWarning(UserWarning):
    """A mesh whose errors were not estimated: one that is far too coarse, or of the default size inside `jit`."""


class PrecisionWarning(UserWarning):
    """Numbers of single precision, and what they cost."""


def warn_if_coarse(equilibrium: Equilibrium, names: Sequence[str] | None = None) -> None:
    """Where the numbers alone show that a given mesh is far too coarse: no program is needed for that.

    `names`: of each of stacked equilibria, as those of the cables of a harness.
    """
    curvature, s = np.asarray(equilibrium.curvature), np.asarray(equilibrium.s)
    if equilibrium.discretization == "hermite" and isinstance(equilibrium.state.shape, FramedCurve):
        curvature = np.hypot(curvature, np.asarray(equilibrium.twist))
    turn = np.maximum(curvature[..., 1:], curvature[..., :-1]) * (s[..., 1:] - s[..., :-1])
    by_tangent = equilibrium.discretization == "finite_difference"  # their curvature is 2 tan(turn/2)/h
    limit = MOST_TURN[equilibrium.discretization]
    is_coarse = (turn > (2 * math.tan(limit / 2) if by_tangent else limit)).any(-1)
    if not is_coarse.any():
        return
    is_coarse &= np.asarray(equilibrium.converged)
    if is_coarse.any():
        many = f" in {np.sum(is_coarse)} of {is_coarse.size} scenes" if is_coarse.ndim else ""
        if names is not None:
            many = f" for {' and '.join(names[int(k)] for k in np.flatnonzero(is_coarse))}"
        most = np.max(turn[is_coarse])
        most = 2 * np.arctan(most / 2) if by_tangent else most
        most = f"{most:.1f} rad" if most < 2 * math.pi else "more than a whole turn"  # no figure on such a mesh
        warn(
            f"the mesh of {s.shape[-1] - 1} segments is too coarse{many}: the rod turns by {most} along one of them; "
            "more segments, or rtol in the place of segments, may help; rodjax.describe tells the errors",
            MeshWarning,
        )


@functools.cache
def warn_of_unknown_mesh(segments: int) -> None:
    """Once in a process: where numbers are not known, no error can be looked at and no mesh chosen."""
    warn(
        f"the mesh is one of {segments} segments, whatever its errors, as numbers are not known inside jax.jit, vmap "
        "or grad: values and derivatives differ by those errors from what the same solve gives outside, on a mesh "
        "chosen for rtol; segments= states a mesh (this is said once)",
        MeshWarning,
    )


@functools.cache
def warn_of_single_precision() -> None:
    """Once in a process; the errors are those of `experiments/float32.py`."""
    warn(
        "the numbers are float32, JAX's default: beside double precision the shape is off by 3e-8 to 2e-4 of the "
        "length and the forces by 4e-6 to 5e-4, more on finer meshes; obstacles need float64. For more call "
        'jax.config.update("jax_enable_x64", True) before anything else (this is said once)',
        PrecisionWarning,
    )


def warn_of_outcome(
    equilibrium: Equilibrium, strain_limit: Float[Array, ""] | float = DEFAULT_STRAIN_LIMIT, rod: str = "the rod"
) -> None:
    """Where statuses are known, of those that are not converged and of those above a strain."""
    if not is_known(equilibrium.status):
        return
    status = np.asarray(equilibrium.status)
    if not status.any():  # all CONVERGED
        return
    if not np.all(np.asarray(equilibrium.converged)):
        warn(outcome_told(equilibrium), NotConvergedWarning)
    is_overstretched = status == Status.OVERSTRETCHED
    # In the continuum strains may be traced where the status is not.
    if not is_overstretched.any() or not is_known(equilibrium.axial_strain, strain_limit):
        return
    count = int(np.sum(is_overstretched))
    rods = f"{rod} is" if not status.ndim else "1 rod is" if count == 1 else f"{count} rods are"
    warn(
        f"{rods} strained by more than strain_limit = {100 * float(strain_limit):g} %: {largest_strain(equilibrium)}"
        + "".join(f"; {part}" for part in ([] if status.ndim else too_short(equilibrium))),
        OverstretchedWarning,
    )
