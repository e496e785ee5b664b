"""What every form of a scene promises to a search: a change of the force, and the turn of a whole rod."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, Rod, Scene, frame
from rodjax.discretization.nodal_point import NodalChange
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.model.scene import sliding_arclengths
from rodjax.solving.result_form import form_and_point

AXIS = jnp.array([1.0, 0.0, 0.0])
CLIP = Clip(0.4, (0.3, 0.0, 0.0))
# Pressed together between pins on one line, about which all of the rod can turn. In a clip on the line the force has
# another direction on each side.
KINDS = {
    "tangents": Scene(Rod(1.0, 1.0, 0.7, 1e4), Pin((0, 0, 0)), Pin((0.8, 0, 0))),
    "tangents in a clip": Scene(Rod(1.0, 1.0, 0.7, 1e4), Pin((0, 0, 0)), Pin((0.8, 0, 0)), clips=[CLIP]),
    "frames": Scene(Rod(1.0, (1.0, 2.0), 0.7, 1e4), Pin((0, 0, 0)), Pin((0.8, 0, 0))),
    "frames in a clip": Scene(Rod(1.0, (1.0, 2.0), 0.7, 1e4), Pin((0, 0, 0)), Pin((0.8, 0, 0)), clips=[CLIP]),
}


# A rod without clips is one of a single span: the same code with one force.
CASES = [kind if "clip" in kind else pytest.param(kind, marks=pytest.mark.exhaustive) for kind in KINDS]


@functools.cache
def solved(kind: str) -> rj.Equilibrium:
    result = rj.solve(KINDS[kind], segments=8, solver=rj.Newton(tolerance=1e-10))
    assert result.converged
    return result


@pytest.mark.parametrize("kind", CASES)
def test_a_rod_that_turns_as_a_whole_stays_in_equilibrium(kind):
    """Rotations and forces turned with it are a motion that the linearised equilibrium does not resist."""

    @by_numpy
    def resisted(result):
        form, point = form_and_point(result)
        here = form.linearized(point)
        rotation = form.turn(point, here.bases, AXIS)
        multipliers = form.multipliers_turned(point, AXIS, jnp.zeros_like(here.constraint_residual))
        of_rotation, of_multipliers = here.system.times(rotation, multipliers)
        forces = jnp.linalg.norm(jnp.cross(AXIS[:, None], point.end_force, axis=0), axis=0)
        return jnp.abs(of_rotation), jnp.abs(of_multipliers), forces

    rotation, multipliers, forces = resisted(solved(kind))
    # The residual of the solve, 1e-10; without the turned forces the rotations are resisted by these times h.
    assert np.max(rotation) < 1e-8
    assert np.max(multipliers) < 1e-8
    if "clip" in kind:
        assert np.min(forces) > 1


@pytest.mark.parametrize("kind", CASES)
def test_what_another_force_changes_is_that_of_the_lagrangian(kind):
    random = np.random.default_rng(0)

    @by_numpy
    def changes(result, numbers, change):
        form, point = form_and_point(result)
        bases = form.bases_at(point)
        rotation = numbers[: bases.shape[1] * bases.shape[2]].reshape(bases.shape[1:])
        here = form.under_force(point, form.linearized(point), rotation, change, None)
        trial = dataclasses.replace(point, end_force=point.end_force + change)
        energy = form.linearized(trial).energy - form.linearized(point).energy
        constraint_residual = form.force_components(form.linearized(trial).constraint_residual)

        def at(step):
            retracted = form.retract(point, bases, step * rotation, jnp.zeros_like(change))
            still = jnp.zeros_like(rotation)
            lacking, _, more, _ = form.under_force(retracted, form.linearized(retracted), still, change, None)
            return lacking, more

        step = 1e-5
        rates = jax.tree.map(lambda a, b: (a - b) / (2 * step), at(step), at(-step))
        return here, (constraint_residual, rates[0], energy, rates[1])

    result = solved(kind)
    numbers = jnp.asarray(random.normal(size=100))
    change = jnp.asarray(random.normal(size=result.state.end_force.shape))
    found, expected = changes(result, numbers, change)
    for value, truth in zip(found, expected, strict=True):
        # Of differences over 2e-5: roundings of 1e-15/1e-5, and (1e-5)^2 of the third derivative.
        np.testing.assert_allclose(value, truth, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("EI", [1.0, (1.0, 1.3)], ids=["tangents", "frames"])
def test_the_slope_of_a_step_in_contact_is_that_of_its_objective(EI):
    """Under the new forces and pressures, in every motion of the rod; the objective is what steps are judged by."""
    rod = Rod(1.0, EI, 0.7, 1e4, 100.0, radius=0.01)
    ends = Clamp((0, 0, 0.01), frame((1, 0, 0))), Free(force=(0, 0.3, 20.0))
    result = rj.solve(Scene(rod, *ends, (0, 0, -1.0), obstacles=[rj.Plane((0, 0, 0), (0, 0, 1))]), segments=8)
    random = np.random.default_rng(0)

    @by_numpy
    def slopes(result, numbers, displacements, pressures, change):
        form, point = form_and_point(result)
        bases, here = form.bases_at(point), form.linearized(point)
        is_free = jnp.sum(bases**2, axis=0)  # by rotations that no support holds
        rotation = is_free * numbers[: is_free.size].reshape(is_free.shape)
        step = NodalChange(displacements, pressures)
        _, _, _, more = form.under_force(point, here, rotation, change, step)

        def objective(part):
            there = form.retract(point, bases, part * rotation, change, form.scaled(step, part, 1.0))
            return form.objective(form.linearized(there), point, step)

        return more + jnp.sum(rotation * here.gradient), (objective(1e-9) - objective(-1e-9)) / 2e-9

    assert float(jnp.max(result.contact_forces)) > 1.0
    displacements = jnp.asarray(random.normal(size=result.nodes.shape)).at[0].set(0.0)  # the clamped node
    change = jnp.asarray(random.normal(size=result.state.end_force.shape))
    pressures = jnp.asarray(random.normal(size=result.state.pressures.shape))
    found, expected = slopes(result, jnp.asarray(random.normal(size=100)), displacements, pressures, change)
    assert abs(expected) > 1.0
    # Roundings of 1e-14 of the energy over 1e-9: by more, middles of elements that lie on the floor would touch it.
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("kind", CASES)
def test_the_rounding_floor_is_near_to_what_rounding_leaves(kind):
    """A search that may go on as long as it finds less ends within a thirtieth of it: a tenth was seen, and a third."""

    @by_numpy
    def floor(result):
        form, point = form_and_point(result)
        return form.rounding_floor(point)

    lowest = rj.solve(KINDS[kind], segments=8, solver=rj.Newton(tolerance=0.0))
    assert lowest.status == rj.Status.ROUNDING_FLOOR
    assert 1 / 30 < lowest.residual / floor(lowest) < 1


@pytest.mark.parametrize("height", [-0.05, -1.0])
def test_it_is_known_whether_contact_forces_act(height):
    """Also where the rod slides: a search shifts by less where nothing touches."""
    floor = rj.Plane((0, 0, height), (0, 0, 1))
    rod = Rod(1.0, 1.0, 0.7, 1e4, mass_per_length=5.0, radius=0.01)
    clips = [Clip(0.4, (0.35, 0.0, 0.1), sliding=True)]
    scene = Scene(rod, Pin((0, 0, 0)), Pin((0.8, 0, 0)), (0.0, 0.0, -9.81), clips=clips, obstacles=[floor])
    result = rj.solve(scene, segments=8)
    assert result.converged
    form, point = form_and_point(result)
    arclengths = sliding_arclengths(form.scene)
    sliding = SlidingForm.of(form.scene, result.state.shape)
    inner = SlidingPoint(point, arclengths, jnp.array(True), jnp.zeros_like(arclengths))
    is_lying = height > -0.5
    assert (jnp.sum(result.contact_forces[:, 2]) > 0) == is_lying
    assert form.touches(point) == is_lying
    assert sliding.touches(inner) == is_lying
