"""How firmly an equilibrium stands: whether its softest motion has any stiffness left, and motions that need none."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.joints import components, generic_field
from rodjax.discretization.mixed import NEUTRAL, Linearization, MixedForm, MixedPoint
from rodjax.linalg import Factors

# Steps of the inverse iteration for the softest motion: each brings it out by the ratio of the next stiffness to its.
INVERSE_ITERATIONS = 2
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
    form: MixedForm, point: MixedPoint, here: Linearization, factors: Factors, residual: Float[Array, ""]
) -> tuple[Bool[Array, ""], Motion]:
    """Whether an equilibrium is critical, and its neutral turn, or no motion where it has none.

    Critical: a motion other than the neutral one has no stiffness left, as far as the residual allows to tell.
    `factors` are those of the system of the linearisation, made regular.
    """
    nothing = Motion(jnp.zeros_like(here.gradient), jnp.zeros_like(here.closure))

    def is_soft(neutral: Motion) -> Bool[Array, ""]:
        stiffness = _softest(point, here, factors, neutral)
        least = CRITICAL * jnp.maximum(residual, form.rounding_floor(point))
        return (stiffness**2 <= least) | ~jnp.isfinite(stiffness)

    def closer() -> tuple[Bool[Array, ""], Motion]:
        # Under a dead moment, without symmetry of the system, no turn is looked for.
        neutral = neutral_turn(form, point, here) if form.has_potential else nothing
        return is_soft(neutral), neutral

    return jax.lax.cond(is_soft(nothing), closer, lambda: (jnp.array(False), nothing))


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


def _softest(point: MixedPoint, here: Linearization, factors: Factors, neutral: Motion) -> Float[Array, ""]:
    """The least stiffness [EI/L^2 per rad and length] of a motion other than the neutral one, by inverse iteration."""
    no_gap = jnp.zeros_like(here.closure)
    motion = Motion(components(here.bases, generic_field(point.tangents)), no_gap).without(neutral)
    h = 1 / point.tangents.shape[1]
    stiffness = jnp.zeros_like(h * point.total_twist)
    for _ in range(INVERSE_ITERATIONS):
        softer = Motion(*factors.solve(h * motion.rotation, no_gap)).without(neutral)
        stiffness = jnp.sum(motion.rotation**2) / jnp.sum(motion.rotation * softer.rotation)
        motion = jax.tree.map(lambda x, size=jnp.max(jnp.abs(softer.rotation)): x / size, softer)
    return stiffness
