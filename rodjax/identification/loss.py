"""How much a deviation counts: least squares, or less where it is large, so that outliers do not pull the fit away."""

import math
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Loss = Literal["linear", "huber", "cauchy", "welsch"]

# In standard deviations, where a loss begins to differ: estimates from data without outliers then have 95 % of the
# efficiency of least squares (Holland & Welsch 1977).
THRESHOLDS: dict[Loss, float] = {"linear": math.inf, "huber": 1.345, "cauchy": 2.385, "welsch": 2.985}


def _rho(loss: Loss, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The loss of a squared deviation by the squared threshold, x >= 0; near zero x."""
    if loss == "huber":
        is_small = x <= 1
        return jnp.where(is_small, x, 2 * jnp.sqrt(jnp.where(is_small, 1.0, x)) - 1)
    if loss == "cauchy":
        return jnp.log1p(x)
    if loss == "welsch":
        return -jnp.expm1(-x)
    return x


def robust(rows: Float[Array, "k d"], loss: Loss, threshold: Float[Array, ""]) -> Float[Array, "k d"]:
    """Rows whose squares add up to the loss of each."""
    if loss == "linear":
        return rows
    x = jnp.sum(rows**2, axis=1) / threshold**2
    is_zero = x < 1e-12
    safe = jnp.where(is_zero, 1.0, x)
    factor = jnp.where(is_zero, 1.0, jnp.sqrt(_rho(loss, safe) / safe))
    return rows * factor[:, None]


def influence(
    rows: Float[Array, "k d"], loss: Loss, threshold: Float[Array, ""]
) -> tuple[Float[Array, "k d"], Float[Array, "k"]]:
    """Half the gradient of the loss of each row, and the mean of its derivative over the d directions."""
    if loss == "linear":
        return rows, jnp.ones(rows.shape[0], rows.dtype)

    def half_gradient(row: Float[Array, "d"]) -> Float[Array, "d"]:
        x = jnp.sum(row**2) / threshold**2
        return row * jax.grad(lambda x: _rho(loss, x))(x)

    slopes = jax.vmap(jax.jacfwd(half_gradient))(rows)
    return jax.vmap(half_gradient)(rows), jnp.trace(slopes, axis1=1, axis2=2) / rows.shape[1]
