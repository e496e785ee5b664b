"""A group of starts of a route, searched together: what one thread, process or machine does of it."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from rodjax.notes import bar
from rodjax.paths.batch import solve_first
from rodjax.routing.problem import (
    Evaluation,
    Problem,
    arranged,
    chosen,
    evaluated,
    group_starts,
    nothing_evaluated,
    spare_lengths,
)
from rodjax.routing.rounds import Rounds
from rodjax.routing.search import KEPT, Asked, Numbers, Outcome, Search, Settings
from rodjax.solving.harness_result import Solution
from rodjax.solving.options import Options

# Starts of a group: as many as are computed side by side. Searches of several groups do not wait for one another.
GROUP = 8


class Targets(NamedTuple):
    """What all searches are told: `scale` of the objective, `tolerance` as a part of it, most `iterations`, and the
    `region` of the first step.
    """

    scale: float
    tolerance: float
    iterations: int
    region: float


class Found(NamedTuple):
    """Of each of k searches: its best, by how much that lacks of its slacks and its objective, both infinite where none
    of its designs is valid, how it went, and its solves; `failed`: solves of all without an equilibrium.
    """

    best: Evaluation
    lacking: Float[np.ndarray, "k"]
    objective: Float[np.ndarray, "k"]
    outcomes: list[Outcome]
    solves: Int[np.ndarray, "k"]
    failed: int


def searched(
    problem: Problem,
    starts: Float[np.ndarray, "k n"],
    guesses: Solution,
    reserves: Float[np.ndarray, "k m"],
    count: int,
    targets: Targets,
) -> Found:
    """What the searches from the first `count` of the starts find, each with its reserve of the slacks."""
    return Group(problem, starts, guesses, reserves, targets).found(count)


class Group:
    """Searches from starts with equilibria: where they stand, the best of each, and what evaluates them."""

    def __init__(
        self,
        problem: Problem,
        starts: Float[np.ndarray, "k n"],
        guesses: Solution,
        reserves: Float[np.ndarray, "k m"],
        targets: Targets,
    ):
        self.problem, self._reserves, self._targets = problem, reserves, targets
        self._options = Options(problem.segments, "hermite", problem.solver)
        self._starts, self._guesses = starts, jax.tree.map(jnp.asarray, guesses)
        self.last = self._best = nothing_evaluated(problem, jnp.asarray(starts), self._guesses)
        self._lacking, self._objective = np.full(len(starts), np.inf), np.full(len(starts), np.inf)
        self._solves, self._failed = np.zeros(len(starts), int), 0

    def found(self, count: int) -> Found:
        """What the searches from the first `count` of the starts find."""
        first = self.evaluate({k: Asked(self._starts[k], False) for k in range(count)})
        groups, targets = group_starts(self.problem, self._guesses), self._targets

        def search(k: int) -> Callable[[Callable[[Asked], Numbers]], Outcome]:
            settings = Settings(
                targets.scale, self._reserves[k], targets.tolerance, targets.iterations, groups, targets.region
            )
            return lambda ask: Search(self._starts[k], first[k], settings, ask, self._spare).run()

        with bar(None, "rounds") as drawn:

            def evaluate(asked: dict[int, Asked]) -> dict[int, Numbers]:
                drawn.update()
                return self.evaluate(asked)

            outcomes = Rounds([search(k) for k in range(count)], evaluate).run()
        best = jax.tree.map(np.asarray, self._best)
        return Found(best, self._lacking, self._objective, outcomes, self._solves, self._failed)

    def _spare(self, design: Float[np.ndarray, "n"]) -> float:
        return float(spare_lengths(self.problem, jnp.asarray(design)[None])[0])

    def evaluate(self, asked: dict[int, Asked]) -> dict[int, Numbers]:
        """One design of each search that asked."""
        count, order = len(asked), np.fromiter(asked, int)
        accepted = np.zeros(len(self._starts), bool)
        designs = self._starts.copy()
        for k, (design, is_accepted) in asked.items():
            accepted[k], designs[k] = is_accepted, design
        if np.any(accepted):
            self._guesses = chosen(jnp.asarray(accepted), self.last.result, self._guesses)
        order = jnp.asarray(np.pad(order, (0, len(designs) - count), mode="edge"))
        placed, scenes, guesses = arranged(self.problem, jnp.asarray(designs), self._guesses, order)
        results = solve_first(scenes, guesses, count, self._options)
        self.last = evaluated(self.problem, placed, results, self.last, order, jnp.asarray(count))
        objective, slacks, rates, is_valid = (
            np.asarray(x) for x in (self.last.objective, self.last.slacks, self.last.rates, self.last.is_valid)
        )
        self._solves[list(asked)] += 1
        self._failed += sum(not is_valid[k] for k in asked)
        self._keep_best(list(asked), objective, slacks, is_valid)
        m = slacks.shape[1]
        return {k: Numbers(float(objective[k]), slacks[k], rates[k, : m + 1], bool(is_valid[k])) for k in asked}

    def _keep_best(
        self,
        asked: list[int],
        objective: Float[np.ndarray, "k"],
        slacks: Float[np.ndarray, "k m"],
        is_valid: Bool[np.ndarray, "k"],
    ) -> None:
        lacking = np.maximum(np.max(self._reserves - slacks, axis=1, initial=0.0) - KEPT, 0.0)
        is_better = (lacking < self._lacking) | ((lacking == self._lacking) & (objective < self._objective))
        is_better &= is_valid & np.isin(np.arange(len(is_valid)), asked)
        self._lacking = np.where(is_better, lacking, self._lacking)
        self._objective = np.where(is_better, objective, self._objective)
        if np.any(is_better):
            self._best = chosen(jnp.asarray(is_better), self.last, self._best)
