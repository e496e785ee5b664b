"""Derivatives of an element's bending by its chords, written out, beside those by JAX."""

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.discretization.element_bending import bending_energies, by_chords


def test_derivatives_by_chords_are_those_by_jax():
    """Of elements bent in space by up to 1.5 rad, with a density that is not linear in the squared curvature."""
    rng = np.random.default_rng(0)
    tangents = np.array([1.0, 0, 0])[None, :, None] + 0.4 * rng.normal(size=(3, 3, 20))
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    chords = jnp.array([1 - np.sum(tangents[i] * tangents[j], axis=0) for i, j in ((0, 1), (1, 2), (0, 2))])
    h = jnp.array(rng.uniform(0.1, 0.3, 20))

    def density(squared_curvature):
        return 0.7 * squared_curvature + 0.02 * squared_curvature**2

    def energy(chords):
        return jnp.sum(bending_energies(density, chords, h))

    energies, gradient, hessian = by_chords(density, chords, h)
    np.testing.assert_allclose(energies, bending_energies(density, chords, h), rtol=1e-13)
    expected = jax.grad(energy)(chords)
    # Roundings, by the largest of the elements.
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-13 * float(np.max(np.abs(expected))))
    expected = np.einsum("pnqn->pqn", np.asarray(jax.hessian(energy)(chords)))
    found = np.stack([np.stack(row) for row in hessian])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * float(np.max(np.abs(expected))))
