"""How firmly an equilibrium stands: whether its softest motion has any stiffness left, and motions that need none."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.joints import components, generic_field
from rodjax.discretization.mixed import NEUTRAL, Linearization, MixedForm, MixedPoint
from rodjax.linalg import Factors, factor_and_solve

# Shift of the Hessian, in roundings of its largest entries, by which neutral turns leave it regular.
SHIFT_ROUNDINGS = 100.0
# At a fold the residual is the square of the softest stiffness, over twice its change along that motion: up to this
# multiple of the residual the square may be nothing but what was left unsolved.
CRITICAL = 100.0


class Motion(eqx.Module):
    """A change of an equilibrium: rotations of its tangents, and multipliers."""

    rotation: Float[Array, "b m"]
    multipliers: Float[Array, "k"]

    def without(self, other: "Motion") -> "Motion":
        """The part at right angles to another motion, whose rotations are no larger than 1; all of it beside none."""
        squared = jnp.sum(other.rotation**2)
        share = jnp.sum(other.rotation * self.rotation) / jnp.where(squared > 0, squared, 1.0)
        return Motion(self.rotation - share * other.rotation, self.multipliers - share * other.multipliers)


def examined(
    form: MixedForm, point: MixedPoint, here: Linearization, residual: Float[Array, ""]
) -> tuple[Factors, Bool[Array, ""], Motion]:
    """The factors at an equilibrium, whether it is critical, and its neutral turn, or no motion where it has none.

    Critical: a motion other than the neutral one has no stiffness left, as far as the residual allows to tell.
    """
    places = point.tangents.shape[1]
    # So little that derivatives do not show it, and more than the rounding of pivots of 4 N.
    shift = jnp.asarray(SHIFT_ROUNDINGS * jnp.finfo(residual.dtype).eps * 4 * places**2, residual.dtype)
    generic = components(here.bases, generic_field(point.tangents))
    nothing = Motion(jnp.zeros_like(here.gradient), jnp.zeros_like(here.closure))
    # The first step of the inverse iteration in one sweep with the factorisation.
    factors, *softer = factor_and_solve(here.system.shifted(shift / places), generic / places, nothing.multipliers)
    stiffness, softer = jax.lax.stop_gradient((_stiffness(generic, softer[0]), Motion(*softer)))
    least = CRITICAL * jnp.maximum(residual, form.rounding_floor(point))

    def is_soft(stiffness: Float[Array, ""]) -> Bool[Array, ""]:
        return (stiffness**2 <= least) | ~jnp.isfinite(stiffness)

    def closer(fixed: tuple[MixedForm, MixedPoint, Linearization, Factors]) -> tuple[Bool[Array, ""], Motion]:
        form, point, here, factors = fixed
        # Under a dead moment, without symmetry of the system, no turn is looked for.
        neutral = neutral_turn(form, point, here) if form.has_potential else nothing
        other = Motion(generic, nothing.multipliers).without(neutral).rotation
        softest = Motion(*factors.solve(other / places, nothing.multipliers)).without(neutral)
        return is_soft(_stiffness(other, softest.rotation)), neutral

    fixed = jax.lax.stop_gradient((form, point, here, factors))
    critical, neutral = jax.lax.cond(is_soft(stiffness), closer, lambda _: (jnp.array(False), nothing), fixed)
    return factors, critical, neutral


def _stiffness(generic: Float[Array, "b m"], softer: Float[Array, "b m"]) -> Float[Array, ""]:
    """Rayleigh's quotient [EI/L^2 per rad and length] of what a generic motion becomes by a step of inverse iteration.

    That of the softest motion, where this is much softer than all others; never less.
    """
    return jnp.sum(generic * softer) / jnp.sum(softer**2)


def neutral_turn(form: MixedForm, point: MixedPoint, here: Linearization) -> Motion:
    """The turn of the whole rod about an axis that leaves it in equilibrium, or no motion where there is none.

    So turns a rod between coaxial clamps, or between pins without weight, about the line through its ends.
    """

    def turn(axis: Float[Array, "3"]) -> tuple[Motion, Float[Array, "b m"], Float[Array, "k"]]:
        rotation = components(here.bases, jnp.cross(axis[:, None], point.tangents, axis=0))
        of_force = form.of_force(jnp.cross(axis, point.end_force))
        multipliers = jnp.zeros_like(here.closure)
        motion = Motion(rotation, multipliers.at[len(multipliers) - len(of_force) :].set(of_force))
        return motion, *here.system.times(motion.rotation, motion.multipliers)

    axes = jnp.eye(3, dtype=point.tangents.dtype)
    _, moments, gaps = jax.vmap(turn)(axes)
    missing = jnp.concatenate([moments.reshape(3, -1), gaps], axis=1)
    motion, moments, gaps = turn(jnp.linalg.eigh(missing @ missing.T)[1][:, 0])
    size = jnp.max(jnp.abs(motion.rotation))
    least = NEUTRAL * size / point.tangents.shape[1]
    is_neutral = (size > jnp.sqrt(NEUTRAL)) & (jnp.max(jnp.abs(moments)) <= least) & jnp.all(jnp.abs(gaps) <= least)
    return jax.tree.map(lambda x: jnp.where(is_neutral, x, jnp.zeros_like(x)), motion)
