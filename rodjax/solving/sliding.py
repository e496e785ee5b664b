"""Equilibria of rods that slide through clips: how they change as the axial forces there do."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.form import Point
from rodjax.discretization.form_results import clip_moments_of, resultants_of
from rodjax.discretization.motion import Motion
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.linalg.saddle_point import factor
from rodjax.model.scene import Scene, sliding_arclengths
from rodjax.solving.stability import carried_to


def sliding_at(scene: Scene, shape: Shape, point: Point) -> tuple[SlidingForm, SlidingPoint]:
    """The form and the point of an equilibrium of a nondimensional scene with its clips where the rod passes them."""
    arclengths = sliding_arclengths(scene)
    assert arclengths is not None
    form, begin = carried_to(scene, shape, SlidingPoint.settled_at(point, arclengths))
    assert isinstance(form, SlidingForm)
    assert isinstance(begin, SlidingPoint)
    return form, begin


def change_with_axial_forces(
    scene: Scene, shape: Shape, point: Point, axial: Float[Array, "slides"]
) -> tuple[Float[Array, "n+1 3"], Float[Array, "3 spans"], Float[Array, "3 k"], Float[Array, "n+1"]]:
    """Of the nodes, the forces through the rod, the moments of ends and clips and the curvature at nodes, as the clips
    come to apply more along the rod by so much.
    """
    form, begin = sliding_at(scene, shape, point)
    here = form.linearized(begin)
    right = jnp.concatenate([-axial, jnp.zeros_like(here.constraint_residual[len(axial) :])])
    motion = Motion(*factor(form.regular(here.system)).solve(jnp.zeros_like(here.gradient), right))

    def seen(motion: Motion) -> tuple[Any, ...]:
        reached, there = carried_to(scene, shape, begin, motion)
        assert isinstance(reached, SlidingForm)
        assert isinstance(there, SlidingPoint)
        inner, there = reached.at(there.arclengths), there.inner
        ends = resultants_of(inner, there)
        moments = jnp.stack([ends.start_moment, ends.end_moment, *clip_moments_of(inner, there)], axis=1)
        return inner.nodes_of(there), there.end_force, moments, ends.curvature

    nothing = jax.tree.map(jnp.zeros_like, motion)
    return jax.jvp(seen, (nothing,), (motion,))[1]
