"""The search for the best route from one start: sequential quadratic programming within a trust region."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.routing.optimality import optimality
from rodjax.routing.quadratic import Step, quadratic_step

# A search may take so many solves for each of the most iterations it is allowed: where it needs more, trials fail one
# after another.
SOLVES_PER_ITERATION = 3
# A trial that would leave so much too little rod between two held places, as a part of its length, and more so than
# where the search stands, pulls it taut: it is stepped back from without a solve.
TAUT = 1e-3
# Limits are kept where no slack lacks more than this of what is asked.
KEPT = 1e-6
# A quadratic program whose linear constraints contradict one another keeps to the least violation it can reach and this
# part of what it takes away.
RELAXED = 0.1
# Second derivatives of the program of the least violation, beside its derivative of 1.
REGULARIZED = 1e-3
# A step is taken where the merit falls by the first part of what is predicted; by less than the second the region
# becomes smaller, by more than the third larger.
TAKEN, POOR, GOOD = 1e-4, 0.25, 0.75
# A search ends where its steps promise this part of the tolerance, and stalls where its region is so small.
NEGLIGIBLE = 1e-2
SMALLEST = 1e-9
# Where conditions of optimality do not hold at the end, second derivatives are learned anew, so often, from this size
# of the region.
ANEW = 3
REGION = 1e-2
# A step that breaks limits is brought back to them by so many more at most.
CORRECTIONS = 3
# Steps that bring a search back to its limits at its end.
RESTORED = 8
# Violations count by so many times the multipliers.
WEIGHED = 1.5
# Damping of the update of second derivatives: Powell 1978.
DAMPED = 0.2

OPTIMAL = "optimal to first order"
STALLED = "stalled"
VIOLATED = "least violation near here"
SPENT = "limit of iterations reached"


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
    """`scale` of the objective; `reserve`: what is asked of each slack; `tolerance` of the objective, as a part of
    `scale`, and most iterations; `groups`: the first slack of each of what is limited, `None` of each slack by
    itself; `region`: by how much of its range a variable moves in the first step.
    """

    scale: float
    reserve: Float[np.ndarray, "m"]
    tolerance: float
    iterations: int
    groups: tuple[int, ...] | None = None
    region: float = 1.0


class Outcome(NamedTuple):
    """How a search went, and the designs at which it stood, one after another."""

    iterations: int
    message: str
    designs: tuple[Float[np.ndarray, "n"], ...] = ()


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
        self._at, self._here = start, _tempered(first)
        self._stood = [start]
        self._least_spare = self._allowed(start)
        self._is_accepted = True
        self._iterations = self._solves = 0
        self._hessian = np.eye(len(start))
        self._region = settings.region
        groups = range(len(first.slacks)) if settings.groups is None else settings.groups
        self._groups = np.array(groups, int)
        self._weights = np.zeros(len(self._groups))

    def run(self) -> Outcome:
        """Descends until conditions of optimality hold; where they do not at the end, again from there."""
        if not self._here.is_valid:
            return Outcome(0, "no equilibrium, or none with derivatives, at the start")
        message = STALLED
        for _ in range(ANEW):
            message = self._descend()
            self._restore()
            if message == SPENT or self._is_optimal():
                break
            self._hessian, self._region = np.eye(len(self._at)), REGION
        if self._is_optimal():
            message = OPTIMAL
        elif message == OPTIMAL:
            message = STALLED
        return Outcome(self._iterations, message, tuple(self._stood))

    def _is_optimal(self) -> bool:
        if self._violation(self._here) > KEPT:
            return False
        return optimality(*self._model(), self._at).gain <= self._settings.tolerance

    def _model(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "m"], Float[np.ndarray, "m n"]]:
        """Derivatives of the objective, the slacks beyond the reserve and their derivatives."""
        here = self._here
        return here.rates[0] / self._settings.scale, here.slacks - self._settings.reserve, here.rates[1:]

    def _violation(self, numbers: Numbers) -> float:
        return float(np.max(self._settings.reserve - numbers.slacks, initial=0.0))

    def _merit(self, numbers: Numbers) -> float:
        violations = self._violations(numbers.slacks - self._settings.reserve)
        return numbers.objective / self._settings.scale + float(self._weights @ violations)

    def _violations(self, slacks: Float[np.ndarray, "m"]) -> Float[np.ndarray, "g"]:
        """The largest of each group."""
        return np.maximum(np.maximum.reduceat(-slacks, self._groups), 0.0) if len(slacks) else np.zeros(0)

    def _weigh(self, multipliers: Float[np.ndarray, "m"], change: float, taken: Float[np.ndarray, "g"]) -> None:
        """Weights violations by a little more than their multipliers, and so that a step promises something."""
        if not len(self._groups):
            return
        sums = WEIGHED * np.add.reduceat(multipliers, self._groups)
        self._weights = np.maximum(sums, (self._weights + sums) / 2)
        lacking, gain = 2 * change - float(self._weights @ taken), np.maximum(taken, 0.0)
        if lacking > 0 and np.any(gain > 0):
            self._weights = self._weights + np.where(gain > 0, lacking / float(np.sum(gain)), 0.0)

    def _descend(self) -> str:
        """Steps until they promise nothing more."""
        negligible = NEGLIGIBLE * self._settings.tolerance
        for _ in range(self._settings.iterations):
            gradient, slacks, rates = self._model()
            lower = np.maximum(-self._region, -self._at)
            upper = np.minimum(self._region, 1 - self._at)
            step = self._step(gradient, rates, slacks, lower, upper)
            change = float(gradient @ step.step + step.step @ self._hessian @ step.step / 2)
            taken = self._violations(slacks) - self._violations(slacks + rates @ step.step)
            self._weigh(step.multipliers, change, taken)
            promised = float(self._weights @ taken) - change
            violation = self._violation(self._here)
            is_left = violation <= KEPT or np.max(-slacks - rates @ step.step) > (1 - RELAXED) * violation
            if (promised <= negligible and is_left) or np.max(np.abs(step.step)) <= SMALLEST:
                return VIOLATED if violation > KEPT else OPTIMAL
            self._iterations += 1
            if not self._try(step, gradient, promised):
                if self._solves >= SOLVES_PER_ITERATION * self._settings.iterations:
                    return SPENT
                if self._region <= SMALLEST:
                    return STALLED
        return SPENT

    def _step(
        self,
        gradient: Float[np.ndarray, "n"],
        rates: Float[np.ndarray, "m n"],
        slacks: Float[np.ndarray, "m"],
        lower: Float[np.ndarray, "n"],
        upper: Float[np.ndarray, "n"],
    ) -> Step:
        """The step of the quadratic program, as far as its constraints allow one."""
        step = quadratic_step(self._hessian, gradient, rates, slacks, lower, upper)
        if step is not None:
            return step
        n = len(gradient)
        violation = float(np.max(-slacks))
        eased = quadratic_step(
            REGULARIZED * np.eye(n + 1),
            np.append(np.zeros(n), 1.0),
            np.append(rates, np.ones((len(rates), 1)), axis=1),
            slacks,
            np.append(lower, 0.0),
            np.append(upper, 2 * violation),
        )
        if eased is None:
            return Step(np.zeros(n), np.zeros(len(slacks)))
        least = float(np.max(-slacks - rates @ eased.step[:n], initial=0.0))
        left = least + RELAXED * max(violation - least, 0.0)
        step = quadratic_step(self._hessian, gradient, rates, slacks + left, lower, upper)
        return eased._replace(step=eased.step[:n]) if step is None else step

    def _try(self, step: Step, gradient: Float[np.ndarray, "n"], promised: float) -> bool:
        """Whether a step is taken, by itself or brought back to the limits; the size of the region follows."""
        size = float(np.max(np.abs(step.step)))
        found = self._numbers(self._at + step.step)
        if not found.is_valid:
            self._region = POOR * size
            return False
        merit, moved, best = self._merit(self._here), step.step, step.step
        self._learn(step, found)
        gained, reached = (merit - self._merit(found)) / promised, found
        for _ in range(CORRECTIONS):
            violation = self._violation(reached)
            if gained >= POOR or violation == 0:
                break
            # The same program, with the constraints of where the step led.
            corrected = quadratic_step(
                self._hessian,
                gradient + self._hessian @ moved,
                reached.rates[1:],
                reached.slacks - self._settings.reserve,
                np.maximum(-size, -self._at) - moved,
                np.minimum(size, 1 - self._at) - moved,
            )
            if corrected is None:
                break
            moved = moved + corrected.step
            reached = self._numbers(self._at + moved)
            if not reached.is_valid or self._violation(reached) > violation / 2:
                break
            if (merit - self._merit(reached)) / promised > gained:
                gained, found, best = (merit - self._merit(reached)) / promised, reached, moved
        if gained < POOR:
            self._region = (0.5 if gained > TAKEN else POOR) * size
        elif gained > GOOD and size > 0.9 * self._region:
            self._region = min(2 * self._region, 1.0)
        if gained < TAKEN:
            return False
        self._stand(self._at + best, found)
        return True

    def _restore(self) -> None:
        """The shortest steps to where all limits are kept."""
        n = len(self._at)
        for _ in range(RESTORED):
            violation = self._violation(self._here)
            if violation <= KEPT:
                return
            _, slacks, rates = self._model()
            step = quadratic_step(np.eye(n), np.zeros(n), rates, slacks, -self._at, 1 - self._at)
            if step is None:
                return
            found = self._numbers(self._at + step.step)
            if not found.is_valid or self._violation(found) > violation / 2:
                return
            self._stand(self._at + step.step, found)

    def _learn(self, step: Step, found: Numbers) -> None:
        """Second derivatives of the Lagrangian, by its derivatives at both ends of a step."""
        weights = np.append(1 / self._settings.scale, -step.multipliers)
        change = weights @ (found.rates - self._here.rates)
        s, bent = step.step, self._hessian @ step.step
        curvature = float(s @ bent)
        if curvature <= 0:
            return
        along = float(s @ change)
        part = 1.0 if along >= DAMPED * curvature else (1 - DAMPED) * curvature / (curvature - along)
        damped = part * change + (1 - part) * bent
        hessian = self._hessian - np.outer(bent, bent) / curvature + np.outer(damped, damped) / float(s @ damped)
        if np.all(np.isfinite(hessian)) and np.linalg.eigvalsh(hessian)[0] > 1e-8 * np.max(np.abs(hessian)):
            self._hessian = hessian

    def _numbers(self, design: Float[np.ndarray, "n"]) -> Numbers:
        design = np.clip(design, 0.0, 1.0)
        if self._spare(design) < self._least_spare:
            return self._here._replace(is_valid=False)
        self._solves += 1
        found = self._ask(Asked(design, self._is_accepted))
        self._is_accepted = False
        return _tempered(found) if found.is_valid else self._here._replace(is_valid=False)

    def _allowed(self, standing: Float[np.ndarray, "n"]) -> float:
        """The least spare length of a trial from there."""
        return min(-TAUT, 2 * self._spare(standing))

    def _stand(self, design: Float[np.ndarray, "n"], found: Numbers) -> None:
        """What the search comes back to from now on."""
        self._at, self._here = np.clip(design, 0.0, 1.0), found
        self._stood.append(self._at)
        self._least_spare = self._allowed(self._at)
        self._is_accepted = True


def _tempered(numbers: Numbers) -> Numbers:
    """With slacks below -1 by their logarithm, smoothly: a rod pulled taut violates limits of force by millions."""
    slacks = numbers.slacks
    size = np.maximum(-slacks, 1.0)
    rates = numbers.rates / np.append(1.0, size)[:, None]
    return numbers._replace(slacks=np.where(slacks < -1, -1 - np.log(size), slacks), rates=rates)
