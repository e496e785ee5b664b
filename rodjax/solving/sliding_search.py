"""Where a rod lies in clips that it slides through: Newton's method on the arclengths, around that on the shape.

At given arclengths of the clips the rod has an equilibrium, in which each of them applies some axial force. By as much
the energy falls as more of the rod passes; a step goes where the linearised axial forces vanish, or on the way to a
minimum of the energy along its negative gradient, where that curves the other way. A clip that also holds the tangent
has no such energy: the rod's moments jump there, and what slides would take their work (Bigoni et al. 2015,
"Eshelby-like forces acting on elastic structures"). There, and under loads without potential, steps are judged by the
axial forces alone.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import NEUTRAL
from rodjax.discretization.forms import form_of
from rodjax.model.scene import Scene, slid
from rodjax.solving.newton import ENERGY_ROUNDING, MAX_HALVINGS, STAGNATION, SUFFICIENT_DECREASE, Find
from rodjax.solving.result import Found
from rodjax.solving.sliding import Slide, slide
from rodjax.solving.status import Status, is_converged

# An axial force is none below this part of the residual that is tolerated, and the equilibria at given arclengths are
# found to a tenth of that.
AXIAL_TOLERANCE = 0.1
INNER_TOLERANCE = 0.01
# Nor is it below what this way [L] through the clip makes of it, to which equilibria at given arclengths close: it is
# steep where the rod is nearly taut.
PLACE_TOLERANCE = 1e-12
# The most of the way to the next support that a step takes a clip along the rod.
LARGEST_STEP = 0.3
MAX_STEPS = 60
# A step that leaves no more than this of the axial forces needs no lower energy.
GOOD_FALL = 0.5


class _Slid(eqx.Module):
    """What a turn leaves to the next one: the last accepted equilibrium, its energy, and the step from it."""

    found: Found
    places: Float[Array, "slides"]
    axial: Float[Array, "slides"]
    energy: Float[Array, ""]
    step: Float[Array, "slides"]
    slope: Float[Array, ""]
    part: Float[Array, ""]
    halvings: Int[Array, ""]
    turns: Int[Array, ""]
    status: Int[Array, ""]
    is_steady: Bool[Array, ""]


def solve_sliding(
    scene: Scene, find_at: Callable[[Scene, Found], Found], begin: Found, tolerance: float, find: Find
) -> Found:
    """The equilibrium in which no sliding clip pulls along the rod, with its arclengths in its state.

    `find_at`: the equilibrium of a nondimensional scene with its clips at given arclengths, from another one.
    """

    def turn(last: _Slid) -> _Slid:
        places = last.places + last.part * last.step
        here = slid(scene, places)
        found = find_at(here, last.found)
        form = form_of(here, found.state.shape)
        energy = form.elastic_energy(found.point) + form.load_energy(found.point)
        now = slide(here, found.state.shape, found.point)
        is_first = last.turns == 0
        bound = last.energy + SUFFICIENT_DECREASE * last.part * last.slope
        largest, before = jnp.max(jnp.abs(now.axial)), jnp.max(jnp.abs(last.axial))
        is_lower = energy <= bound + ENERGY_ROUNDING * (1 + jnp.abs(bound))
        if not form.has_potential or any(clip.sliding and clip.tangent is not None for clip in scene.clips):
            is_lower = (largest < before) | ~last.is_steady
        is_good = is_converged(found.outcome.status) & (is_lower | (largest <= GOOD_FALL * before))
        is_accepted = is_first | is_good
        step = _step(here, now, find)
        floor = form.rounding_floor(found.point)
        least = jnp.maximum(AXIAL_TOLERANCE * tolerance, floor)
        least = jnp.maximum(least, PLACE_TOLERANCE * jnp.max(jnp.abs(now.rates)))
        reached = jnp.where(found.outcome.residual <= tolerance, Status.CONVERGED, found.outcome.status)
        status = jnp.where(is_accepted & (largest <= least), reached, Status.RUNNING)
        status = jnp.where(is_first & ~is_converged(found.outcome.status), found.outcome.status, status)
        halvings = jnp.where(is_accepted, 0, last.halvings + 1)
        failed = jnp.where(halvings > MAX_HALVINGS, Status.LINE_SEARCH_FAILED, Status.RUNNING)
        failed = jnp.where(last.turns + 1 >= MAX_STEPS, Status.MAX_ITERATIONS, failed)
        failed = jnp.where((failed != Status.RUNNING) & (before <= STAGNATION * floor), Status.ROUNDING_FLOOR, failed)
        status = jnp.where(status == Status.RUNNING, failed, status)
        is_steady = jnp.all(jnp.linalg.eigvalsh(now.stiffness) > -NEUTRAL)
        accepted = _Slid(
            found=eqx.tree_at(
                lambda found: (found.state.places, found.is_stable), found, (places, found.is_stable & is_steady)
            ),
            places=places,
            axial=now.axial,
            energy=energy,
            step=step,
            slope=-jnp.sum(now.axial * step),
            part=jnp.ones_like(last.part),
            halvings=halvings,
            turns=last.turns,
            status=last.status,
            is_steady=is_steady,
        )
        kept = eqx.tree_at(lambda last: (last.part, last.halvings), last, (last.part / 2, halvings))
        chosen = jax.tree.map(lambda new, old: jnp.where(is_accepted, new, old), accepted, kept)
        counts = [
            counted(found.outcome) + counted(last.found.outcome)
            for counted in (lambda outcome: outcome.iterations, lambda outcome: outcome.evaluations)
        ]
        return eqx.tree_at(
            lambda chosen: (
                chosen.found.outcome.iterations,
                chosen.found.outcome.evaluations,
                chosen.turns,
                chosen.status,
            ),
            chosen,
            (*counts, last.turns + 1, status.astype(int)),
        )

    def is_running(last: _Slid) -> Bool[Array, ""]:
        return last.status == Status.RUNNING

    places = begin.state.places
    assert places is not None
    zero, count = jnp.zeros_like(places[0]), jnp.zeros((), int)
    first = _Slid(
        found=begin,
        places=places,
        axial=places,
        energy=zero,
        step=0 * places,
        slope=zero,
        part=zero + 1,
        halvings=count,
        turns=count,
        status=jnp.full((), Status.RUNNING, int),
        is_steady=jnp.array(False),
    )
    last = jax.lax.while_loop(is_running, turn, first)
    return eqx.tree_at(lambda found: found.outcome.status, last.found, last.status)


def _step(scene: Scene, now: Slide, find: Find) -> Float[Array, "slides"]:
    """By how much to change the arclengths of the sliding clips."""
    newton = jnp.linalg.solve(-now.rates, now.axial)
    if find == "minimum":
        values, vectors = jnp.linalg.eigh(now.stiffness)
        downwards = vectors @ ((vectors.T @ now.axial) / jnp.maximum(jnp.abs(values), NEUTRAL))
        newton = jnp.where(jnp.all(values > NEUTRAL), newton, downwards)
    zero = jnp.zeros_like(now.axial[0])
    places = jnp.stack([zero, *(clip.at for clip in scene.clips), zero + 1])
    gaps = jnp.minimum(places[1:-1] - places[:-2], places[2:] - places[1:-1])
    gaps = jnp.stack([gap for gap, clip in zip(gaps, scene.clips, strict=True) if clip.sliding])
    return newton * jnp.minimum(1.0, jnp.min(LARGEST_STEP * gaps / jnp.maximum(jnp.abs(newton), 1e-300)))
