"""Quadratic programs and conditions of optimality, beside what defines them."""

import numpy as np

from rodjax.routing.optimality import WITHIN, optimality
from rodjax.routing.quadratic import quadratic_step


def test_steps_keep_the_conditions_of_karush_kuhn_and_tucker():
    rng = np.random.default_rng(0)
    solved = 0
    for _ in range(200):
        n, m = rng.integers(2, 13), rng.integers(1, 60)
        factor = rng.normal(size=(n, n))
        hessian = factor @ factor.T + 10.0 ** rng.uniform(-2, 1) * np.eye(n)
        gradient = rng.normal(size=n) * 10.0 ** rng.uniform(-3, 3)
        rows = rng.normal(size=(m, n)) * 10.0 ** rng.uniform(-3, 3, size=(m, 1))
        slacks = rng.uniform(-0.05, 1, size=m) * np.linalg.norm(rows, axis=1)
        lower, upper = -rng.random(n), rng.random(n)
        found = quadratic_step(hessian, gradient, rows, slacks, lower, upper)
        if found is None:
            # Where the slacks are positive, no step at all keeps to them.
            assert np.min(slacks) < 0
            continue
        solved += 1
        left = rows @ found.step + slacks
        size = np.linalg.norm(rows, axis=1)
        # A convex program: conditions are sufficient. To roundings of least squares.
        assert np.min(left / size) > -1e-8
        assert np.min(found.multipliers) >= 0
        scale = np.linalg.norm(gradient) + np.linalg.norm(hessian @ found.step)
        np.testing.assert_allclose(found.multipliers * left, 0.0, atol=1e-7 * scale)
        force = hessian @ found.step + gradient - rows.T @ found.multipliers
        at_lower, at_upper = found.step <= lower + 1e-9, found.step >= upper - 1e-9
        assert np.all(np.abs(force[~at_lower & ~at_upper]) < 1e-7 * scale)
        assert np.all(force[at_lower] > -1e-7 * scale)
        assert np.all(force[at_upper] < 1e-7 * scale)
    assert solved > 150


def test_what_a_design_could_gain():
    """To the left is better by 2 a range, up by 1; a constraint across holds both."""
    gradient, at = np.array([-2.0, 1.0]), np.array([0.5, 0.0])
    free = optimality(gradient, np.zeros(0), np.zeros((0, 2)), at)
    # Roundings of a linear program of numbers of size 1.
    np.testing.assert_allclose(free.gain, 2 * WITHIN, rtol=1e-9)
    np.testing.assert_allclose(free.lower, [0, 1], atol=1e-9)
    held = optimality(gradient, np.array([0.0, 5.0]), np.array([[-4.0, 0.0], [1.0, 1.0]]), at)
    np.testing.assert_allclose(held.gain, 0.0, atol=1e-12)
    np.testing.assert_allclose(held.multipliers, [0.5, 0.0], atol=1e-9)
    near = optimality(gradient, np.array([4e-4]), np.array([[-4.0, 0.0]]), at)
    np.testing.assert_allclose(near.gain, 2e-4, rtol=1e-9)
