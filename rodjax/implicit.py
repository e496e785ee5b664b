"""How an equilibrium changes with its scene, by the implicit function theorem on the mixed form.

The point of an equilibrium makes the residual (gradient by rotations, closure) vanish. A change of the scene at the
same point leaves a residual, and the linearised system that Newton's method factorises, block tridiagonal with a
border, says which rotations and forces take it away: O(n). All of it is made of differentiable operations, so that the
derivative has derivatives itself, and a transpose.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.mixed import MixedForm, MixedPoint
from rodjax.discretization.shape import Shape
from rodjax.linalg import factor
from rodjax.result import field_of
from rodjax.scene import Scene


class Unknowns(eqx.Module):
    """Rotations of the tangents away from a point, and the change of the force at s = L."""

    rotation: Float[Array, "b m"]
    force: Float[Array, "3"]


def change(
    scene: Scene, scene_change: Scene, shape: Shape, point: MixedPoint, is_equilibrium: Bool[Array, ""]
) -> tuple[Shape, MixedPoint]:
    """The change of shape and point of an equilibrium with that of its scene, nondimensional.

    Not a number where the point is no equilibrium.
    """

    def form_and_point(scene: Scene, unknowns: Unknowns | None = None) -> tuple[MixedForm, MixedPoint]:
        """The point under other numbers of the scene, the tangents that supports hold with it."""
        form = MixedForm.of(scene, field_of(scene, shape))
        tangents = form.field.as_held(scene, point.tangents)
        begin = MixedPoint(tangents, point.end_force, form.twist_near(tangents, point.total_twist))
        if unknowns is None:
            return form, begin
        bases = form.field.basis(scene, form.bases(form.field.with_held(scene, tangents)))
        return form, form.moved(begin, bases, unknowns.rotation, unknowns.force)

    def residual(scene: Scene) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        form, here = form_and_point(scene)
        linearization = form.linearized(here)
        return linearization.gradient, linearization.closure

    def reached(scene: Scene, unknowns: Unknowns) -> tuple[Shape, MixedPoint]:
        form, there = form_and_point(scene, unknowns)
        return shape.reached(form, there), there

    form, here = form_and_point(scene)
    system = form.linearized(here).system
    _, (f, c) = jax.jvp(residual, (scene,), (scene_change,))
    # A factor, as a choice between numbers would leave the transpose without the one that is none.
    sign = jnp.where(is_equilibrium, -1.0, jnp.nan).astype(f.dtype)
    f, c = sign * f, sign * c
    factors = factor(form.regular(system))
    rotation, multipliers = factors.solve(f, c)
    # The factors are those of a matrix shifted by what neutral modes need: once more, without.
    left = system.times(rotation, multipliers)
    correction = factors.solve(f - left[0], c - left[1])
    rotation, multipliers = rotation + correction[0], multipliers + correction[1]
    unknowns = Unknowns(rotation, form.force_change(form.closure(multipliers)))
    nothing = jax.tree.map(jnp.zeros_like, unknowns)
    _, changes = jax.jvp(reached, (scene, nothing), (scene_change, unknowns))
    return changes
