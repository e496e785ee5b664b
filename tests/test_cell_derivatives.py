"""Cells of frames: the formulas for their derivatives against autodiff of what they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy

import rodjax as rj
from rodjax.discretization.cells import ElementCells, JointCells
from rodjax.discretization.element_strains import ElementStrains
from rodjax.discretization.frame_point import FramePoint
from rodjax.discretization.framed import FrameForm
from rodjax.geometry.rotations import turned
from rodjax.model.scene import nondimensional

CELLS = 3


def by_each(function, x):
    """Derivatives by each component in turn, changed in all cells at once."""
    directions = jnp.eye(x[..., 0].size).reshape(-1, *x.shape[:-1], 1) * jnp.ones_like(x)[None]
    rows = jax.vmap(lambda direction: jax.jvp(function, (x,), (direction,))[1])(directions)
    return rows.reshape(*x.shape[:-1], *rows.shape[1:])


def test_strains_of_elements_have_their_derivatives():
    generator = np.random.default_rng(0)
    h = jnp.asarray(generator.uniform(0.5, 2.0, size=CELLS))
    parts = jnp.asarray(0.3 * generator.normal(size=(3, 2, CELLS)))
    moments = jnp.asarray(generator.normal(size=(3, 3, CELLS)))

    def values(parts):
        return ElementStrains(parts, h).values

    @by_numpy
    def found_and_expected(parts):
        here = ElementStrains(parts, h)
        slopes = jax.grad(lambda parts: jnp.sum(moments * values(parts)))
        return (here.jacobian, here.curving(moments)), (by_each(values, parts), by_each(slopes, parts))

    (jacobian, curving), (by_parts, second) = found_and_expected(parts)
    # Roundings of numbers up to 100.
    np.testing.assert_allclose(jacobian, by_parts.transpose(2, 3, 0, 1, 4), rtol=0, atol=1e-12)
    np.testing.assert_allclose(curving, second.transpose(1, 0, 3, 2, 4), rtol=0, atol=1e-12)


def test_a_helix_is_strained_everywhere_alike():
    """Against what a constant rotation vector is, and its length as an angle."""
    vector = np.array([0.3, -0.2, 0.4])
    half = np.sin(np.linalg.norm(vector) / 2) * vector / np.linalg.norm(vector)
    parts = jnp.asarray(np.stack([-half, half], axis=1)[..., None])
    h = jnp.array([0.1])
    # The series is exact to the tenth power of the angle, 0.54 here.
    for strain in np.moveaxis(np.asarray(ElementStrains(parts, h).values)[..., 0], 1, 0):
        np.testing.assert_allclose(strain, vector / 0.05, rtol=1e-6)


class Stiffening(rj.Law):
    def __call__(self, curvature, twist, axial_strain, s):
        quadratic = curvature[0] ** 2 / 2 + curvature[1] ** 2 + 0.35 * twist**2 + 50 * axial_strain**2
        return quadratic + 0.1 * curvature[0] ** 4 + 0.3 * curvature[0] * twist * axial_strain


RODS = {
    "flat": lambda: rj.Rod(1.0, (1.0, 2.0), 0.7, 100.0),
    "curved": lambda: rj.Rod(1.0, (1.0, 2.0), 0.7, 100.0, rest_curvature=(1.0, 0.5), rest_twist=0.7),
    "law": lambda: rj.Rod(1.0, (1.0, 2.0), 0.7, 100.0, law=Stiffening()),
    "shearing": lambda: rj.Rod(1.0, (1.0, 2.0), 0.7, 100.0, GA=(20.0, 30.0), rest_curvature=(1.0, 0.5)),
}


@pytest.mark.parametrize("kind", [ElementCells, JointCells])
@pytest.mark.parametrize("rod", RODS)
def test_the_linearization_is_that_of_the_lagrangian(rod, kind):
    """By rotations of the frames and by the force."""
    scene, _ = nondimensional(
        rj.Scene(RODS[rod](), rj.Pin((0, 0, 0)), rj.Pin((0.8, 0, 0)), point_forces=[rj.PointForce(0.4, (1, 2, 3))])
    )
    nodes = jnp.array([0.0, 0.4, 0.7, 1.0]) if kind is ElementCells else jnp.linspace(0.0, 1.0, CELLS + 1)
    form = FrameForm.of(scene, kind(nodes))
    generator = np.random.default_rng(1)
    q = np.array([1.0, 0.5, 0.3, 0.2])[:, None] + 0.2 * generator.normal(size=(4, len(form.field.arclengths)))
    point = FramePoint(jnp.asarray(q / np.linalg.norm(q, axis=0)), jnp.array([[3.0], [-5.0], [2.0]]), jnp.zeros(()))
    bases = form.bases_at(point)
    shape = bases.shape[1:]

    @by_numpy
    def found_and_expected(form, point):
        def at(unknowns):
            rotation, force_change = unknowns[:-3].reshape(shape), unknowns[-3:, None]
            force = point.end_force + force_change
            return form.linearized(FramePoint(turned(point.quaternions, rotation), force, point.total_twist))

        def matrix(here):
            unit = jnp.eye(shape[0] * shape[1] + 3)
            return jax.vmap(lambda x: flat(*here.system.times(x[:-3].reshape(shape), x[-3:])))(unit)

        def flat(gradient, constraint_residual):
            return jnp.concatenate([gradient.reshape(-1), constraint_residual])

        nowhere = jnp.zeros(shape[0] * shape[1] + 3)
        here = form.linearized(point)
        expected = jax.grad(lambda x: at(x).energy)(nowhere), jax.jacfwd(jax.grad(lambda x: at(x).energy))(nowhere)
        return (flat(here.gradient, here.constraint_residual), matrix(here)), expected

    (gradient, matrix), (slopes, second) = found_and_expected(form, point)
    # Roundings of second derivatives up to 1e3.
    np.testing.assert_allclose(gradient, slopes, rtol=0, atol=1e-11)
    np.testing.assert_allclose(matrix, second, rtol=0, atol=1e-10)
