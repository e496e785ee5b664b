"""Rods that slide through clips: how the axial forces there change as more or less of the rod has passed."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.form import Point
from rodjax.discretization.form_results import clip_moments_of, resultants_of
from rodjax.discretization.motion import Motion
from rodjax.discretization.shape import Shape
from rodjax.linalg.saddle_point import factor
from rodjax.model.scene import Scene, slid, sliding_places
from rodjax.solving.stability import carried_to


class Slide(NamedTuple):
    """Of an equilibrium under clips at given arclengths, nondimensional.

    `axial`: what the sliding clips apply along the rod; `rates`: the derivatives by the arclengths of these clips, one
    column for each; `nodes`, `forces`, `moments`, `curvature`: those of the nodes, the forces through the spans, the
    moments of ends and clips and the curvature at nodes. By as much as a clip pulls along the rod the energy falls as
    its arclength grows, so that the reverse of `rates` is the energy's second derivative.
    """

    axial: Float[Array, "slides"]
    rates: Float[Array, "slides slides"]
    nodes: Float[Array, "slides n+1 3"]
    forces: Float[Array, "slides 3 spans"]
    moments: Float[Array, "slides 3 k"]
    curvature: Float[Array, "slides n+1"]

    @property
    def stiffness(self) -> Float[Array, "slides slides"]:
        """Against sliding, [EI/L^3]."""
        return -(self.rates + self.rates.T) / 2


def slide(scene: Scene, shape: Shape, point: Point) -> Slide:
    """Of an equilibrium of a nondimensional scene."""
    places = sliding_places(scene)
    assert places is not None
    form, begin = carried_to(scene, shape, point)
    here = form.linearized(begin)
    factors = factor(form.regular(here.system))
    nothing = Motion(jnp.zeros_like(here.gradient), jnp.zeros_like(here.closure))

    def unbalanced(places: Float[Array, "slides"]) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        form, there = carried_to(slid(scene, places), shape, point)
        return form.unbalanced(there)

    def seen(places: Float[Array, "slides"], motion: Motion) -> tuple[Array, ...]:
        form, there = carried_to(slid(scene, places), shape, point, motion)
        ends = resultants_of(form, there)
        moments = jnp.stack([ends.start_moment, ends.end_moment, *clip_moments_of(form, there)], axis=1)
        return form.axial_forces(there), form.nodes(form.edges(there)), there.end_force, moments, ends.curvature

    def rate(direction: Float[Array, "slides"]) -> tuple[Array, ...]:
        _, (f, c) = jax.jvp(unbalanced, (places,), (direction,))
        return jax.jvp(seen, (places, nothing), (direction, Motion(*factors.solve(-f, -c))))[1]

    rates, *others = jax.vmap(rate)(jnp.eye(len(places), dtype=places.dtype))
    return Slide(form.axial_forces(begin), rates.T, *others)
