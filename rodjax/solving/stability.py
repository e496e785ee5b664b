"""How firmly an equilibrium stands: whether its softest motion has any stiffness left."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import Form, Linearization, Point
from rodjax.discretization.forms import form_of
from rodjax.discretization.joints import generic_field
from rodjax.discretization.motion import Metric, Motion, Neutral, neutral_motions
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.geometry.vectors import components
from rodjax.linalg.saddle_point import AnyFactors, AnySystem, factor, factor_and_solve, transposed
from rodjax.model.scene import Scene, slid

# Shift of the Hessian, in roundings of its largest entries, by which neutral turns leave it regular.
SHIFT_ROUNDINGS = 100.0
# The most of it, in single precision: a thousandth of the softest bending mode's pi^2.
MOST_SHIFT = 0.01
# At a fold the residual is the square of the softest stiffness, over twice its change along that motion: up to this
# multiple of the residual the square may be nothing but what was left unsolved.
CRITICAL = 100.0
# A solution that leaves more than this part of the right side is none.
MOST_LEFT = 1e-3
# The lowest eigenvalue is bracketed by powers of this factor, by so many at most, halved so often, and then found by
# so many inverse iterations.
BRACKET_GROWTH = 4.0
MAX_BRACKETS = 30
HALVINGS = 16
INVERSE_ITERATIONS = 4


def carried_to(
    scene: Scene,
    shape: Shape,
    point: Point,
    motion: Motion | None = None,
    made_at: Float[Array, "slides"] | None = None,
) -> tuple[Form, Point]:
    """The form of a nondimensional scene on the mesh of a shape, and a point under it, moved.

    The tangents that supports hold and the total twist are those of the scene; `motion` is by the bases at the point so
    carried there. Of a `SlidingPoint` the arclengths are its own, and no change of the scene's; `made_at`: those to
    which the mesh of the shape belongs, if not the same.
    """
    if isinstance(point, SlidingPoint):
        form: Any = SlidingForm.of(slid(scene, point.arclengths if made_at is None else made_at), shape)
    else:
        form = form_of(scene, shape)
    begin = form.holding(point)
    if motion is None:
        return form, begin
    force_change = form.layout.forces(form.force_components(motion.multipliers))
    others = form.others(motion.multipliers)
    return form, form.retract(begin, form.bases_at(begin), motion.rotation, force_change, others)


def examined(
    form: Form, point: Point, here: Linearization, residual: Float[Array, ""]
) -> tuple[AnyFactors, Bool[Array, ""], Neutral]:
    """The factors at an equilibrium, whether it is critical, and its neutral motions.

    Critical: a motion other than the neutral ones has no stiffness left, as far as the residual allows to tell.
    """
    here = eqx.tree_at(lambda here: here.system, here, form.coupled(point, here.system))
    points = point.tangents.shape[1]
    # So little that derivatives do not show it, and more than the rounding of pivots of 4 N.
    shift = min(SHIFT_ROUNDINGS * float(jnp.finfo(residual.dtype).eps) * 4 * points**2, MOST_SHIFT)
    shift = jnp.asarray(shift, residual.dtype)
    generic = components(here.bases, generic_field(point.tangents))
    nothing = Motion(jnp.zeros_like(here.gradient), jnp.zeros_like(here.constraint_residual))
    # The first step of the inverse iteration in one sweep with the factorisation.
    system = here.system.shifted(shift / points)
    factors, softer, multipliers = factor_and_solve(system, generic / points, nothing.multipliers)
    # Which motions are soft is a matter of the point alone; only the factors are differentiated.
    form, point, here, residual, generic = jax.lax.stop_gradient((form, point, here, residual, generic))
    system, softer, multipliers = jax.lax.stop_gradient((system, softer, multipliers))
    stiffness = _stiffness(generic, softer)
    # By symmetry a part of a rod that can turn may be as neutral as all of it, which leaves no digit of the solution.
    left = jnp.max(jnp.abs(system.times(softer, multipliers)[0] - generic / points))
    is_lost = jnp.isfinite(left) & (left > MOST_LEFT * jnp.max(jnp.abs(generic)) / points)
    least = CRITICAL * jnp.maximum(residual, form.rounding_floor(point))

    def is_soft(stiffness: Float[Array, ""]) -> Bool[Array, ""]:
        return (stiffness**2 <= least) | ~jnp.isfinite(stiffness)

    def closer(fixed: tuple[Form, Point, Linearization, AnyFactors]) -> tuple[Bool[Array, ""], Neutral]:
        form, point, here, factors = fixed
        neutral = neutral_motions(form, point, here)
        other = neutral.taken_from(Motion(generic, nothing.multipliers)).rotation
        softest = neutral.taken_from(Motion(*factors.solve(other / points, nothing.multipliers)))
        return is_soft(_stiffness(other, softest.rotation)) & ~is_lost, neutral

    fixed = (form, point, here, jax.lax.stop_gradient(factors))
    none = Neutral(nothing, None if form.spin(here.bases) is None else nothing)
    critical, neutral = jax.lax.cond(is_soft(stiffness) | is_lost, closer, lambda _: (jnp.array(False), none), fixed)
    return factors, critical, neutral


def _stiffness(generic: Float[Array, "b m"], softer: Float[Array, "b m"]) -> Float[Array, ""]:
    """Rayleigh's quotient [EI/L^2 per rad and length] of what a generic motion becomes by a step of inverse iteration.

    That of the softest motion, where this is much softer than all others; never less.
    """
    return jnp.sum(generic * softer) / jnp.sum(softer**2)


def softest(form: Form, point: Point, here: Linearization) -> tuple[Float[Array, ""], Motion]:
    """The lowest eigenvalue [EI/L^2] of the Hessian under the constraints, by the length of rod, and its motion.

    The derivative of the eigenvalue is that of Rayleigh's quotient of its motion, which is stationary at it; of two
    equal eigenvalues that of one motion; of a system without symmetry, that of the quotient with its left eigenvector.
    The motion has none.
    """
    stiffness, motion, left = _softest(*jax.lax.stop_gradient((form, point, here)))
    moments, gaps = here.system.times(motion.rotation, motion.multipliers)
    work = jnp.sum(left.rotation * moments) + jnp.sum(left.multipliers * gaps)
    quotient = work / Metric.of(form, here).inner(left, motion)
    return stiffness + quotient - jax.lax.stop_gradient(quotient), motion


def _softest(form: Form, point: Point, here: Linearization) -> tuple[Float[Array, ""], Motion, Motion]:
    """The number of negative eigenvalues under a shift brackets it; inverse iteration from below finds the motion, and
    the left eigenvector, the same where the system is symmetric.
    """
    metric = Metric.of(form, here)

    def shifted(system: AnySystem, value: Float[Array, ""]) -> AnySystem:
        return system.shifted(-value * metric.mass)

    def lies_below(value: Float[Array, ""]) -> Bool[Array, ""]:
        return factor(shifted(here.system, value)).negative > 0

    low = below_lowest(lies_below, jnp.ones((), metric.mass.dtype))
    generic = components(here.bases, generic_field(point.tangents))
    first = Motion(generic, jnp.zeros_like(here.constraint_residual)), low

    def nearest_to(low: Float[Array, ""], system: AnySystem) -> tuple[Motion, Float[Array, ""]]:
        factors = factor(shifted(system, low))

        def closer(_, found: tuple[Motion, Float[Array, ""]]) -> tuple[Motion, Float[Array, ""]]:
            right = metric.times(found[0])
            motion = Motion(*factors.solve(right.rotation, right.multipliers))
            size = jnp.sqrt(metric.inner(motion, motion))
            share = metric.inner(motion, found[0])
            return Motion(motion.rotation / size, motion.multipliers / size), low + share / size**2

        return jax.lax.fori_loop(0, INVERSE_ITERATIONS, closer, first)

    motion, stiffness = nearest_to(low, here.system)
    if not form.sliding_count:
        return stiffness, motion, motion
    return stiffness, motion, nearest_to(low, transposed(here.system))[0]


def below_lowest(lies_below: Callable[[Float[Array, ""]], Bool[Array, ""]], unit: Float[Array, ""]) -> Float[Array, ""]:
    """A number a little below the lowest eigenvalue, of which is known whether it lies below others."""
    # Outwards from zero until the sign changes, then by halves.
    sign = jnp.where(lies_below(0 * unit), -1.0, 1.0).astype(unit.dtype)
    width = jax.lax.while_loop(
        lambda width: (lies_below(sign * width) == (sign < 0)) & (width < BRACKET_GROWTH**MAX_BRACKETS * unit),
        lambda width: BRACKET_GROWTH * width,
        unit,
    )
    inner = jnp.where(width > unit, width / BRACKET_GROWTH, 0.0)
    bounds = jnp.minimum(sign * inner, sign * width), jnp.maximum(sign * inner, sign * width)

    def halved(_, bounds: tuple[Float[Array, ""], Float[Array, ""]]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        low, high = bounds
        middle = (low + high) / 2
        is_below = lies_below(middle)
        return jnp.where(is_below, low, middle), jnp.where(is_below, middle, high)

    low, high = jax.lax.fori_loop(0, HALVINGS, halved, bounds)
    return 2 * low - high
