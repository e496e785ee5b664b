"""Changes of an equilibrium, and the motions of a rod that need no force."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.form import NEUTRAL, Form, Linearization, Point


class Motion(eqx.Module):
    """A change of an equilibrium: rotations of its tangents, and multipliers."""

    rotation: Float[Array, "b m"]
    multipliers: Float[Array, "k"]

    def without(self, other: "Motion") -> "Motion":
        """The part at right angles to another motion, whose rotations are no larger than 1; all of it beside none."""
        squared = jnp.sum(other.rotation**2)
        share = jnp.sum(other.rotation * self.rotation) / jnp.where(squared > 0, squared, 1.0)
        return Motion(self.rotation - share * other.rotation, self.multipliers - share * other.multipliers)


class Metric(eqx.Module):
    """The square of a motion: that of its rotations by the length of rod, none where a support holds the tangent. A
    clip through which the rod slides by its length counts as a turn of all of it by 1 rad.
    """

    mass: Float[Array, "m"]
    arclengths: int = eqx.field(static=True)

    @staticmethod
    def of(form: Form, here: Linearization) -> "Metric":
        mass = form.field.weights * jnp.sum(here.bases**2, axis=(0, 1)) / here.bases.shape[1]
        return Metric(mass, form.sliding_count)

    def inner(self, motion: Motion, other: Motion) -> Float[Array, ""]:
        of_rotations = jnp.sum(self.mass[None] * motion.rotation * other.rotation)
        if not self.arclengths:
            return of_rotations
        first = slice(self.arclengths)
        return of_rotations + jnp.sum(self.mass) * jnp.sum(motion.multipliers[first] * other.multipliers[first])

    def times(self, motion: Motion) -> Motion:
        """The forces whose work in any other motion is the inner product with it."""
        multipliers, first = jnp.zeros_like(motion.multipliers), slice(self.arclengths)
        if self.arclengths:
            multipliers = multipliers.at[first].set(jnp.sum(self.mass) * motion.multipliers[first])
        return Motion(self.mass[None] * motion.rotation, multipliers)


class Neutral(eqx.Module):
    """The motions that leave an equilibrium one: the turn of the whole rod about an axis, and the spin of all sections
    about their tangents, at right angles to it; no motion, where there is none. `spin`: `None` where it is no unknown.
    """

    turn: Motion
    spin: Motion | None

    def taken_from(self, motion: Motion) -> Motion:
        motion = motion.without(self.turn)
        return motion if self.spin is None else motion.without(self.spin)


def neutral_motions(form: Form, point: Point, here: Linearization) -> Neutral:
    """Without a potential no turn is looked for: the system has no symmetry, and its transpose another one."""
    nothing = Motion(jnp.zeros_like(here.gradient), jnp.zeros_like(here.constraint_residual))
    turn = neutral_turn(form, point, here) if form.has_potential else nothing
    rotation = form.spin(here.bases)
    if rotation is None:
        return Neutral(turn, None)
    # A section that is round spins between pins and swivels without a force.
    moments, gaps = here.system.times(rotation, nothing.multipliers)
    least = NEUTRAL / point.tangents.shape[1]
    is_neutral = (jnp.max(jnp.abs(moments)) <= least) & jnp.all(jnp.abs(gaps) <= least)
    spin = Motion(jnp.where(is_neutral, rotation, 0.0), nothing.multipliers)
    return Neutral(turn, spin.without(turn))


def neutral_turn(form: Form, point: Point, here: Linearization) -> Motion:
    """The turn of the whole rod about an axis that leaves it in equilibrium, or no motion where there is none.

    So turns a rod between coaxial clamps, or between pins without weight, about the line through its ends.
    """
    return turn_about(form, point, here, neutral_axis(form, point, here))


def turn_about(form: Form, point: Point, here: Linearization, axis: Float[Array, "3"]) -> Motion:
    """The turn of the whole rod about an axis, none where that is zero."""
    rotation = form.turn(point, here.bases, axis)
    return Motion(rotation, form.multipliers_turned(point, axis, jnp.zeros_like(here.constraint_residual)))


def neutral_axis(form: Form, point: Point, here: Linearization) -> Float[Array, "3"]:
    """The axis of the `neutral_turn`, zero where there is none."""

    def turn(axis: Float[Array, "3"]) -> tuple[Float[Array, "b m"], Float[Array, "b m"], Float[Array, "k"]]:
        motion = turn_about(form, point, here, axis)
        return motion.rotation, *here.system.times(motion.rotation, motion.multipliers)

    # One after another: XLA would otherwise compute the system again for each number made of it.
    turns = jax.lax.map(turn, jnp.eye(3, dtype=point.tangents.dtype))
    _, moments, gaps = turns
    missing = jnp.concatenate([moments.reshape(3, -1), gaps], axis=1)
    axis = jnp.linalg.eigh(missing @ missing.T)[1][:, 0]
    rotation, moments, gaps = (jnp.tensordot(axis, x, 1) for x in turns)
    size = jnp.max(jnp.abs(rotation))
    least = NEUTRAL * size / point.tangents.shape[1]
    is_neutral = (size > jnp.sqrt(NEUTRAL)) & (jnp.max(jnp.abs(moments)) <= least) & jnp.all(jnp.abs(gaps) <= least)
    return jnp.where(is_neutral, axis, 0.0)
