"""Small dense quadratic programs with many constraints: the steps of the search for a route."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

# Rows are kept to this part of their size.
ROUNDING = 1e-9


class Step(NamedTuple):
    """The solution of a quadratic program, and the multipliers of its rows."""

    step: Float[np.ndarray, "n"]
    multipliers: Float[np.ndarray, "m"]


def quadratic_step(
    hessian: Float[np.ndarray, "n n"],
    gradient: Float[np.ndarray, "n"],
    rows: Float[np.ndarray, "m n"],
    slacks: Float[np.ndarray, "m"],
    lower: Float[np.ndarray, "n"],
    upper: Float[np.ndarray, "n"],
) -> Step | None:
    """The least of gradient . d + d . hessian d/2 with rows d + slacks not negative and lower <= d <= upper.

    `None` where nothing does so. The hessian is positive definite. By the dual, a least-squares problem of numbers that
    are not negative: Lawson & Hanson, "Solving least squares problems", chapter 23.
    """
    n = len(gradient)
    # Rows that no step within the bounds can reach are none.
    reach = np.where(rows > 0, rows * lower, rows * upper).sum(axis=1)
    kept = np.flatnonzero(slacks + reach < 0)
    eye = np.eye(n)
    a = np.concatenate([rows[kept], eye, -eye])
    b = np.concatenate([-slacks[kept], lower, -upper])
    factor = np.linalg.cholesky(hessian).T
    # With z = factor d + factor^-T gradient: the point nearest to 0.
    shift = solve_triangular(factor, gradient, trans=1)
    g = solve_triangular(factor, a.T, trans=1).T
    h = b + g @ shift
    norms = np.linalg.norm(g, axis=1)
    scale = np.where(norms > 0, norms, 1.0)
    g, h = g / scale[:, None], h / scale
    size = max(float(np.max(np.abs(h))), np.finfo(float).tiny)
    table = np.concatenate([g.T, h[None] / size])
    dual, _ = nnls(table, np.append(np.zeros(n), 1.0), maxiter=50 * table.shape[1])
    residual = table @ dual - np.append(np.zeros(n), 1.0)
    if -residual[-1] <= ROUNDING:
        return None
    z = size * residual[:-1] / -residual[-1]
    multipliers = size * dual / -residual[-1] / scale
    step = np.clip(solve_triangular(factor, z - shift), lower, upper)
    if np.min(rows @ step + slacks, initial=0.0) < -1e-6 * (1 + np.max(np.abs(slacks[kept]), initial=0.0)):
        return None
    found = np.zeros(len(slacks))
    found[kept] = multipliers[: len(kept)]
    return Step(step, found)
