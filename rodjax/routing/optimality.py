"""Conditions of optimality to first order: what a design could still gain near by, and what each constraint costs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog

# Within this part of the range of each variable.
WITHIN = 1e-3


class Optimality(NamedTuple):
    """Of a design: by how much the objective falls at most, to first order, where no variable moves by more than a
    thousandth of its range and the linearized constraints are kept; and the multipliers of the constraints, the
    derivatives of the objective by what is asked of them, and of the ends of the ranges, lower and upper. 0 of a design
    that keeps to its constraints is the condition of Karush, Kuhn & Tucker.
    """

    gain: float
    multipliers: Float[np.ndarray, "m"]
    lower: Float[np.ndarray, "n"]
    upper: Float[np.ndarray, "n"]


def optimality(
    gradient: Float[np.ndarray, "n"],
    slacks: Float[np.ndarray, "m"],
    rates: Float[np.ndarray, "m n"],
    design: Float[np.ndarray, "n"],
) -> Optimality:
    """Of a design in 0 to 1, by derivatives of its objective and slacks; a linear program."""
    bounds = np.stack([np.maximum(-WITHIN, -design), np.minimum(WITHIN, 1 - design)], axis=1)
    is_near = slacks + np.where(rates > 0, rates * bounds[:, 0], rates * bounds[:, 1]).sum(axis=1) < 0
    # Steps in thousandths and rows of size 1, so that tolerances of the program are none of the result.
    sizes = np.maximum(np.linalg.norm(rates[is_near], axis=1), np.finfo(float).tiny)
    size = max(float(np.linalg.norm(gradient)), np.finfo(float).tiny)
    found = linprog(
        gradient / size,
        A_ub=-rates[is_near] / sizes[:, None] if np.any(is_near) else None,
        b_ub=np.maximum(slacks[is_near], 0.0) / sizes / WITHIN if np.any(is_near) else None,
        bounds=bounds / WITHIN,
        method="highs",
    )
    multipliers, n = np.zeros(len(slacks)), len(gradient)
    if found.status != 0:
        return Optimality(np.inf, multipliers, np.zeros(n), np.zeros(n))
    if np.any(is_near):
        multipliers[is_near] = -found.ineqlin.marginals * size / sizes
    lower = np.where(design + bounds[:, 0] <= 0, found.lower.marginals, 0.0) * size
    upper = np.where(design + bounds[:, 1] >= 1, -found.upper.marginals, 0.0) * size
    return Optimality(max(-found.fun * size * WITHIN, 0.0), multipliers, lower, upper)
