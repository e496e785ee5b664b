"""What couples the rods of a harness to its bodies, against automatic derivatives of the Lagrangian."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy

from rodjax import Clamp, Clip, Cylinder, Free, PointForce, Potential, Rod, Scene, frame
from rodjax.discretization.contact_gaps import gaps_and_normals, within_elements
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.nodal_point import NodalChange
from rodjax.linalg.chain import ChainSystem
from rodjax.solving.assembly_step import RodStep
from rodjax.solving.coupling import RodInBodies, linearized_with_ends
from rodjax.solving.first_state import first_state
from rodjax.solving.options import checked_options
from rodjax.solving.search import Search, in_units_of, sliding_search

START = Clamp((0.1, 0, 0.2), frame((1, 0, -1)))
END = Clamp((0.7, 0.2, 0.1), frame((1, 1, 1)))
LOADS = {"gravity": (0.0, 3.0, -9.81), "point_forces": [PointForce(0.5, (0.0, 0.3, 0.1))]}
PLAIN = (1.0, 1.0, 0.7, 100.0, 0.1)
STRIP = (1.0, (1.0, 2.0), 0.7, 100.0, 0.1)
SCENES = {
    "tangents": Scene(Rod(*PLAIN), START, END, **LOADS),
    "a free start": Scene(Rod(*PLAIN), Free(force=(1, 2, 3)), END, **LOADS),
    "frames in a clip": Scene(Rod(*STRIP), START, END, clips=[Clip(0.25, (0.3, 0, 0.1))], gravity=LOADS["gravity"]),
    "shear": Scene(Rod(*STRIP, GA=50.0, rest_curvature=(1.0, 0.5)), START, END, **LOADS),
}


# The others are the same code with shear, and without a torque.
CASES = [
    pytest.param(kind, marks=[] if kind in ("tangents", "frames in a clip") else pytest.mark.exhaustive)
    for kind in SCENES
]


def in_bodies(form, units, ends, frames, offsets) -> RodInBodies:
    """With bodies under which the clamps are where they are."""
    of_body = jnp.stack([end.frame @ own.T for end, own in zip(ends, frames, strict=True)])
    positions = [end.position - turn @ off for end, turn, off in zip(ends, of_body, offsets, strict=True)]
    poses, joints = (frames, offsets, jnp.stack(positions), of_body, jnp.asarray(0.8)), jnp.ones(2, bool)
    return RodInBodies(form, units, joints, *poses, joints)


@pytest.mark.parametrize("kind", CASES)
def test_coupling_is_that_of_automatic_derivatives(kind):
    """Along one motion of both bodies that has all components, away from equilibrium."""
    scene, random = SCENES[kind], np.random.default_rng(0)
    options, _ = checked_options(scene, 2, None, "hermite", None)
    state, first = first_state(scene, None, options)
    direction = jnp.asarray(random.normal(size=12))

    @by_numpy
    def found_and_expected(scene, state, first, frames, offsets, shift):
        search = Search.of(*in_units_of(scene, state), first, options)
        form, units = search.form, search.units
        ends = [end if isinstance(end, Clamp) else END for end in (scene.start, scene.end)]
        rod = in_bodies(form, units, ends, frames, offsets)
        bases = form.bases_at(search.point)
        rotation, force = shift[: bases[0].size].reshape(bases.shape[1:]), form.layout.forces(shift[: form.layout.size])
        point = form.holding(form.retract(search.point, bases, 0.3 * rotation, 3.0 * force))
        here, coupling = linearized_with_ends(rod, form, point)
        expected = form.linearized(point)
        more = len(here.constraint_residual) - form.layout.size

        def value(rotation, forces, motions):
            step = RodStep(point, here.bases, rotation, form.layout.forces(forces))
            return step.value(rod, motions.reshape(2, 6), jnp.ones(()))[0]

        nowhere = jnp.zeros_like(here.gradient), jnp.zeros(form.layout.size)
        slopes = jax.grad(value, argnums=(0, 1, 2))
        (_, _, by_motions), changes = jax.jvp(lambda motions: slopes(*nowhere, motions), (jnp.zeros(12),), (direction,))
        # The torque is an unknown of its own in the linearisation: eliminated here.
        rows, system = coupling.of_constraints[:more], here.system
        torque = jnp.linalg.solve(system.compliance[:more, :more], rows @ direction)
        of_gradient = coupling.of_gradient @ direction + jnp.einsum("bkm,k->bm", system.border[:, :more], torque)
        second = coupling.second @ direction + rows.T @ torque
        found = coupling.first, of_gradient, coupling.of_constraints[more:] @ direction, second
        return (here, found), (expected, (by_motions, *changes))

    axes = jnp.stack([frame((0.2, -1, 0.4)), frame((0.5, 1, 0.3))])
    offsets = jnp.asarray(random.normal(size=(2, 3))) / 10
    (here, found), (linearized, expected) = found_and_expected(
        scene, state, first, axes, offsets, jnp.asarray(random.normal(size=100))
    )
    # Roundings of second derivatives up to 1e3.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-10), here, linearized)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)
        assert not other.size or np.any(np.abs(other) > 0.1)


def bedding(position, s):
    return 10.0 * position[2] ** 2 + jnp.sin(3 * position[0]) * s


# A rod that touches nothing, but is pressed within its elements by the pressures that are given.
NEAR = {"potentials": [Potential(bedding)], "obstacles": [Cylinder((0.65, -1, -0.4), (0.65, 1, -0.4), 0.2)]}
NODAL = {
    "tangents": Scene(Rod(*PLAIN, radius=0.01), START, END, **LOADS, **NEAR),
    "shear": Scene(Rod(*STRIP, GA=50.0, rest_curvature=(1.0, 0.5), radius=0.01), START, END, **LOADS, **NEAR),
}


@pytest.mark.parametrize("kind", ["tangents", pytest.param("shear", marks=pytest.mark.exhaustive)])
def test_coupling_of_rods_with_places_of_nodes(kind):
    """Of the elements, fields and pressures; of contacts their gaps too."""
    scene, random = NODAL[kind], np.random.default_rng(0)
    options, _ = checked_options(scene, 2, None, "hermite", None)
    state, first = first_state(scene, None, options)
    direction = jnp.asarray(random.normal(size=12))

    @by_numpy
    def found_and_expected(scene, state, first, frames, offsets, shift, pressures):
        search = Search.of(*in_units_of(scene, state), first, options)
        form, units = search.form, search.units
        rod = in_bodies(form, units, (START, END), frames, offsets)
        bases = form.bases_at(search.point)
        rotation, force = shift[: bases[0].size].reshape(bases.shape[1:]), form.layout.forces(shift[: form.layout.size])
        point = form.holding(form.retract(search.point, bases, 0.3 * rotation, 3.0 * force))
        displacements = 0.02 * shift[:9].reshape(3, 3)
        nodal = dataclasses.replace(point.nodal, positions=point.nodal.positions + displacements, pressures=pressures)
        point = form.holding(dataclasses.replace(point, nodal=nodal))
        here, coupling = linearized_with_ends(rod, form, point)
        expected = form.linearized(point)
        assert isinstance(here.system, ChainSystem)
        assert coupling.of_gaps is not None

        def there(rotation, displacements, forces, motions):
            change = NodalChange(displacements, jnp.zeros_like(pressures))
            step = RodStep(point, here.bases, rotation, form.layout.forces(forces), change)
            value, _, there = step.value(rod, motions.reshape(2, 6), jnp.ones(()))
            near = rod.form_at(motions.reshape(2, 6))
            assert isinstance(near, NodalForm)
            gaps = jnp.concatenate([gaps_and_normals(near, there.nodal.positions)[0], within_elements(near, there)[2]])
            return value - jnp.sum(pressures * gaps), gaps

        nowhere = jnp.zeros_like(here.gradient), jnp.zeros((3, 3)), jnp.zeros(form.layout.size)
        slopes = jax.grad(lambda *unknowns: there(*unknowns)[0], argnums=(0, 1, 2, 3))

        def along(motions):
            return slopes(*nowhere, motions), there(*nowhere, motions)[1]

        (by_all, _), (changes, of_gaps) = jax.jvp(along, (jnp.zeros(12),), (direction,))
        # The torque is an unknown of its own in the linearisation: eliminated here.
        system = here.system
        more = len(system.compliance)
        rows = coupling.of_constraints[:more]
        torque = jnp.linalg.solve(system.compliance, rows @ direction)
        of_gradient = coupling.of_gradient @ direction + jnp.einsum("bkm,k->bm", system.border, torque)
        second = coupling.second @ direction + rows.T @ torque
        _, _, of_positions, of_forces = system.split(coupling.of_constraints @ direction)
        found = coupling.first, of_gradient, of_positions, of_forces.reshape(-1), second, coupling.of_gaps @ direction
        x, y = jnp.ones_like(here.gradient), jnp.cos(jnp.arange(1.0, 1.0 + len(here.constraint_residual)))
        same = (system.times(x, y), here.gradient, here.constraint_residual, here.energy, here.residual)
        other = (
            expected.system.times(x, y),
            expected.gradient,
            expected.constraint_residual,
            expected.energy,
            expected.residual,
        )
        return (same, other), (found, (by_all[3], *changes, of_gaps))

    axes = jnp.stack([frame((0.2, -1, 0.4)), frame((0.5, 1, 0.3))])
    offsets = jnp.asarray(random.normal(size=(2, 3))) / 10
    shift = jnp.asarray(random.normal(size=100))
    pressures = jnp.array([[0.0, 3.0, 0.0], [2.0, 5.0, 0.0]])
    (held, direct), (found, expected) = found_and_expected(scene, state, first, axes, offsets, shift, pressures)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-9), held, direct)
    for one, other in zip(found, expected, strict=True):
        # Roundings of second derivatives up to 1e3.
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
        assert np.any(np.abs(other) > 0.1)


def test_bodies_feel_the_mesh_that_goes_along_with_a_clip():
    """The derivatives of what a rod gives its ends by the arclength where it passes a clip, against differences."""
    random = np.random.default_rng(0)
    scene = Scene(Rod(*STRIP), START, END, clips=[Clip(0.4, (0.3, 0, 0.1), sliding=True)], gravity=LOADS["gravity"])
    options, _ = checked_options(scene, 4, None, "hermite", None)
    state, first = first_state(scene, None, options)
    axes = jnp.stack([frame((0.2, -1, 0.4)), frame((0.5, 1, 0.3))])
    step = 1e-4

    @by_numpy
    def at(scene, state, first, frames, offsets, shift, change):
        search = sliding_search(*in_units_of(scene, state), first, options)
        form, bases = search.form, search.form.bases_at(search.point)
        rod = in_bodies(form, search.units, (START, END), frames, offsets)
        rotation, force = shift[: bases[0].size].reshape(bases.shape[1:]), form.layout.forces(shift[: form.layout.size])
        others = form.no_others(search.point)._replace(arclengths=jnp.full(1, change))
        point = form.holding(form.retract(search.point, bases, 0.3 * rotation, 3.0 * force, others))
        _, coupling = linearized_with_ends(rod, form, point)
        return coupling.first, coupling.of_multipliers[0]

    given = (
        scene,
        state,
        first,
        axes,
        jnp.asarray(random.normal(size=(2, 3))) / 10,
        jnp.asarray(random.normal(size=100)),
    )
    _, found = at(*given, jnp.asarray(0.0))
    expected = (at(*given, jnp.asarray(step))[0] - at(*given, jnp.asarray(-step))[0]) / (2 * step)
    assert jnp.max(jnp.abs(expected)) > 1
    # Differences have errors of step^2.
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
