"""Rates of a route's numbers beside differences of solves, of a scene or a harness."""

import numpy as np

from rodjax.programs.tasks import Workers
from rodjax.routing.group import Group, Targets
from rodjax.routing.problem import Problem
from rodjax.routing.route import _Fleet
from rodjax.routing.search import Asked


def assert_rates_are_those_of_solves(problem: Problem, starts: int, design: np.ndarray) -> None:
    """With a solver that leaves 1e-12 EI/L^2."""
    fleet = _Fleet(problem, starts, np.random.default_rng(0), Workers(None, 1))
    group = Group(problem, fleet._starts, fleet._guesses, fleet.reserves, Targets(1.0, 1e-6, 10, 1.0))

    def found(design: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        numbers = group.evaluate({1: Asked(design, False)})[1]
        assert numbers.is_valid
        return np.append(numbers.objective, numbers.slacks), numbers.rates

    _, rates = found(design)
    h = 1e-5
    for k, unit in enumerate(np.eye(len(design))):
        ahead, behind = found(design + h * unit)[0], found(design - h * unit)[0]
        # Central differences.
        np.testing.assert_allclose(rates[:, k], (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-6)
