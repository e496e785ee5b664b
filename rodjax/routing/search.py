"""The search for the best route from one start: scipy's SLSQP, and what brings it back to where limits are kept."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

# What a design that has no equilibrium costs beyond the last, in scales of the objective: SLSQP steps back from it.
PENALTY = 1e3
# An attempt may take so many solves for each of the most iterations it is allowed: where it needs more, line searches
# fail one after another.
SOLVES_PER_ITERATION = 3
# A trial that would leave so much too little rod between two held places, as a part of its length, and more so than
# where the search stands, pulls it taut: it is stepped back from without a solve.
TAUT = 1e-3
# Slacks are by their logarithm where they are violated so much.
MOST_VIOLATION = 1e3
# What SLSQP says, and what is said in its place.
SUCCESS = "Optimization terminated successfully"
SPENT = ("Limit of solves reached", "Iteration limit reached")


class Asked(NamedTuple):
    """A design to evaluate; whether the search stands at the one evaluated before it, the guess for what follows."""

    design: Float[np.ndarray, "n"]
    is_accepted: bool


class Numbers(NamedTuple):
    """What an evaluation gives a search; `is_valid`: an equilibrium with numbers and rates."""

    objective: float
    slacks: Float[np.ndarray, "m"]
    rates: Float[np.ndarray, "1+m n"]
    is_valid: bool


class Settings(NamedTuple):
    """`scale` of the objective; `reserve`: what is asked of the slacks; `tolerance` and most iterations of SLSQP."""

    scale: float
    reserve: float
    tolerance: float
    iterations: int


class Outcome(NamedTuple):
    """How a search went; where it came is with the evaluations."""

    iterations: int
    message: str


class _KeptError(Exception):
    """All limits are kept."""


class _SpentError(Exception):
    """An attempt has had all its solves."""


class Search:
    """One search, from a design that has been evaluated; `ask` gives the `Numbers` of what is `Asked`, `spare` by how
    much the rod of a design is longer than the straight ways between held places.
    """

    def __init__(
        self,
        start: Float[np.ndarray, "n"],
        first: Numbers,
        settings: Settings,
        ask: Callable[[Asked], Numbers],
        spare: Callable[[Float[np.ndarray, "n"]], float],
    ):
        self._settings, self._ask, self._spare = settings, ask, spare
        self._at, self._is_usable = start, first.is_valid
        self._last = self._standing = start.tobytes(), _tempered(first)
        self._least_spare = self._allowed(start)
        self._is_accepted = True
        self._iterations = self._spent = 0

    def run(self) -> Outcome:
        """SLSQP; where it ends outside of the limits, the least violation and SLSQP from there."""
        if not self._is_usable:
            return Outcome(0, "No equilibrium, or none with derivatives, at the start")
        message = self._optimize()
        if not self._keeps():
            self._restore()
            message = self._optimize()
        elif message not in (SUCCESS, *SPENT):
            message = self._optimize()
        return Outcome(self._iterations, message)

    def _keeps(self) -> bool:
        # SLSQP keeps constraints to its tolerance only.
        slacks = self._numbers(self._at).slacks
        return not len(slacks) or float(np.min(slacks)) >= 0.9 * self._settings.reserve

    # --- evaluations, each once ---

    def _numbers(self, design: Float[np.ndarray, "n"]) -> Numbers:
        design = np.clip(design, 0.0, 1.0)
        key = design.tobytes()
        for known, numbers in (self._last, self._standing):
            if known == key:
                return numbers
        if self._spare(design) < self._least_spare:
            return self._refused()
        if self._spent >= SOLVES_PER_ITERATION * self._settings.iterations:
            raise _SpentError
        self._spent += 1
        found = self._ask(Asked(design.copy(), self._is_accepted))
        self._is_accepted = False
        found = _tempered(found) if found.is_valid else self._refused()
        self._last = key, found
        return found

    def _allowed(self, standing: Float[np.ndarray, "n"]) -> float:
        """The least spare length of a trial from there."""
        return min(-TAUT, 2 * self._spare(standing))

    def _refused(self) -> Numbers:
        """Of a trial that has no equilibrium, or is known to have none worth a solve: worse than where it stands."""
        standing = self._standing[1]
        return standing._replace(objective=standing.objective + PENALTY * self._settings.scale, is_valid=False)

    def _stand(self, design: Float[np.ndarray, "n"]) -> Numbers:
        """Evaluated, and from now on what the search comes back to."""
        found = self._numbers(design)
        if found.is_valid:
            self._at = np.clip(design, 0.0, 1.0)
            self._standing = self._at.tobytes(), found
            self._least_spare = self._allowed(self._at)
            self._is_accepted |= self._last[0] == self._standing[0]
        return found

    # --- the two problems ---

    def _optimize(self) -> str:
        scale, reserve = self._settings.scale, self._settings.reserve
        constraint = {
            "type": "ineq",
            "fun": lambda x: self._numbers(x).slacks - reserve,
            "jac": lambda x: self._stand(x).rates[1:],
        }
        self._spent = 0
        try:
            found = minimize(
                lambda x: self._numbers(x).objective / scale,
                self._at,
                jac=lambda x: self._stand(x).rates[0] / scale,
                method="SLSQP",
                bounds=[(0.0, 1.0)] * len(self._at),
                constraints=[constraint] if len(self._numbers(self._at).slacks) else [],
                callback=self._count,
                options={"ftol": self._settings.tolerance, "maxiter": self._settings.iterations},
            )
        except _SpentError:
            return SPENT[0]
        return str(found.message)

    def _count(self, _: Float[np.ndarray, "n"]) -> None:
        self._iterations += 1

    def _restore(self) -> None:
        """Makes the largest violation least, until there is none."""
        n, reserve = len(self._at), self._settings.reserve

        def constraint(x: Float[np.ndarray, "n+1"]) -> Float[np.ndarray, "m"]:
            return self._numbers(x[:n]).slacks - reserve + x[n]

        def rates(x: Float[np.ndarray, "n+1"]) -> Float[np.ndarray, "m n+1"]:
            found = self._stand(x[:n])
            if found.is_valid and np.min(found.slacks) >= reserve:
                raise _KeptError
            return np.append(found.rates[1:], np.ones((len(found.slacks), 1)), axis=1)

        first = max(reserve - float(np.min(self._numbers(self._at).slacks)), 0.0)
        self._spent = 0
        try:
            minimize(
                lambda x: x[n] + PENALTY * (not self._numbers(x[:n]).is_valid),
                np.append(self._at, first),
                jac=lambda x: np.append(np.zeros(n), 1.0),
                method="SLSQP",
                bounds=[(0.0, 1.0)] * n + [(0.0, MOST_VIOLATION)],
                constraints=[{"type": "ineq", "fun": constraint, "jac": rates}],
                callback=self._count,
                options={"ftol": self._settings.tolerance, "maxiter": self._settings.iterations},
            )
        except (_KeptError, _SpentError):
            return


def _tempered(numbers: Numbers) -> Numbers:
    """With slacks below -1 by their logarithm, smoothly: a rod pulled taut violates limits of force by millions."""
    slacks = numbers.slacks
    size = np.maximum(-slacks, 1.0)
    rates = numbers.rates / np.append(1.0, size)[:, None]
    return numbers._replace(slacks=np.where(slacks < -1, -1 - np.log(size), slacks), rates=rates)
