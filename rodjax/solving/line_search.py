"""Line search on slopes, with the approximate Wolfe conditions of Hager & Zhang (2005).

Near a minimum differences of the energy drown in rounding long before its slope does: a step is accepted by its slope,
and the energy only has to stay within its rounding of where it was.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import plain_number, whole_number


class Bracket(eqx.Module):
    """An interval of steps: the slope falls at `low`; at `high` it rises or the energy is too large.

    `high` is infinite while nothing bounds the minimum from above. `high_slope` is not positive where the energy, not
    the slope, closed the bracket: then its place says nothing about where the slope vanishes.
    """

    low: Float[Array, ""]
    low_slope: Float[Array, ""]
    high: Float[Array, ""]
    high_slope: Float[Array, ""]
    trials: Int[Array, ""]

    @staticmethod
    def open(slope: Float[Array, ""]) -> "Bracket":
        return Bracket(
            jnp.zeros_like(slope), slope, jnp.full_like(slope, jnp.inf), jnp.zeros_like(slope), jnp.zeros((), int)
        )


class LineSearch(eqx.Module):
    """**Arguments:**

    - `curvature`: a step is accepted once its slope is this fraction of the first slope, or less.
    - `energy_tolerance`: the energy may rise by this much times (|W| + EI/L): what rounding does to it.
    - `expansion`: largest factor by which a step grows while the minimum is not bracketed.
    - `max_trials`: energy evaluations before a direction is given up.
    """

    curvature: float = eqx.field(default=0.1, converter=plain_number("curvature"))
    energy_tolerance: float = eqx.field(default=1e-9, converter=plain_number("energy_tolerance"))
    expansion: float = eqx.field(default=8.0, converter=plain_number("expansion"))
    max_trials: int = 25

    def __check_init__(self):
        for name, low, high in (("curvature", 0.0, 1.0), ("energy_tolerance", 0.0, 1.0), ("expansion", 1.1, math.inf)):
            if not low < getattr(self, name) < high:
                raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {getattr(self, name)!r}")
        whole_number(self.max_trials, "max_trials", 2, 1000)

    def energy_bound(self, energy: Float[Array, ""]) -> Float[Array, ""]:
        return energy + self.energy_tolerance * (1 + jnp.abs(energy))

    def accepts(
        self, slope: Float[Array, ""], first_slope: Float[Array, ""], energy_is_low: Bool[Array, ""]
    ) -> Bool[Array, ""]:
        return energy_is_low & (jnp.abs(slope) <= self.curvature * jnp.abs(first_slope))

    def narrowed(
        self, bracket: Bracket, step: Float[Array, ""], slope: Float[Array, ""], energy_is_low: Bool[Array, ""]
    ) -> tuple[Bracket, Float[Array, ""]]:
        """The bracket after a rejected trial, and the next step to try: secant where safe, else bisection."""
        is_low = energy_is_low & (slope < 0)
        high_slope = jnp.where(energy_is_low & (slope >= 0), slope, 0.0)
        after = Bracket(
            low=jnp.where(is_low, step, bracket.low),
            low_slope=jnp.where(is_low, slope, bracket.low_slope),
            high=jnp.where(is_low, bracket.high, step),
            high_slope=jnp.where(is_low, bracket.high_slope, high_slope),
            trials=bracket.trials + 1,
        )
        return after, jnp.where(jnp.isfinite(after.high), _inside(after), self._beyond(bracket, step, slope))

    def _beyond(self, bracket: Bracket, step: Float[Array, ""], slope: Float[Array, ""]) -> Float[Array, ""]:
        """Where the line through the last two slopes vanishes, within reach."""
        gain = slope - bracket.low_slope
        ratio = jnp.where(gain > 0, -slope / jnp.where(gain > 0, gain, 1.0), jnp.inf)
        secant = step + (step - bracket.low) * ratio
        return jnp.clip(secant, 1.1 * step, self.expansion * step)


def _inside(bracket: Bracket) -> Float[Array, ""]:
    width = bracket.high - bracket.low
    rise = bracket.high_slope - bracket.low_slope
    has_secant = bracket.high_slope > 0
    fraction = jnp.where(has_secant, -bracket.low_slope / jnp.where(has_secant, rise, 1.0), 0.5)
    # Every third trial halves the bracket: a secant alone can creep along one side.
    fraction = jnp.where(bracket.trials % 3 == 2, 0.5, jnp.clip(fraction, 0.05, 0.95))
    return bracket.low + fraction * width
