"""Levenberg and Marquardt's method for many experiments with unknowns in common and of their own.

The own unknowns of an experiment change nothing in others, so that a step costs as much as there are experiments. The
trust region is optimistix's.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as linalg
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

# Inverse of the first damping, of unknowns that are large at 1: near the solution the method is Gauss's.
FIRST_STEP = 1e3
# Inverse of the damping at which nothing is found any more.
LEAST_STEP = 1e-12
# A step that moves no estimate by more than this part of its standard error, or of its size, is the last.
LAST_STEP = 1e-3
LEAST_CHANGE = 1e-10
# So is one that finds nothing better, moves unknowns by no more than this, and is not shortened by damping: of data
# without scatter the squares are all rounding there.
LEAST_TRIED = 1e-7
# A reduction of the sum of squares by this part of it is lost in rounding.
ROUNDING = 1e-11


class Coordinates(NamedTuple):
    """Of the unknowns in common (p,), and of those of each experiment (e, q)."""

    shared: Float[Array, "p"]
    own: Float[Array, "e q"]


class Residuals(NamedTuple):
    """Of each experiment (e, m), and those that depend on the unknowns in common alone (k,).

    Or their derivatives, by the unknowns in common and then by those of each experiment, along a leading axis p + q.
    """

    own: Float[Array, "... e m"]
    shared: Float[Array, "... k"]


class NormalEquations(eqx.Module):
    """J^T J and J^T r by blocks, for unknowns in common (s) and of each experiment (o).

    `each`: what each experiment says of those in common, `alone`: what else does; `scores`: the gradient by those in
    common from each experiment.
    """

    each: Float[Array, "e p p"]
    alone: Float[Array, "p p"]
    so: Float[Array, "e p q"]
    oo: Float[Array, "e q q"]
    gradient: Coordinates
    scores: Float[Array, "e p"]

    @staticmethod
    def of(jacobian: Residuals, residuals: Residuals, p: int) -> "NormalEquations":
        by_shared, by_own = jacobian.own[:p], jacobian.own[p:]
        alone = jacobian.shared[:p]
        scores = jnp.einsum("pem,em->ep", by_shared, residuals.own)
        return NormalEquations(
            each=jnp.einsum("pem,rem->epr", by_shared, by_shared),
            alone=alone @ alone.T,
            so=jnp.einsum("pem,qem->epq", by_shared, by_own),
            oo=jnp.einsum("qem,rem->eqr", by_own, by_own),
            gradient=Coordinates(
                jnp.sum(scores, axis=0) + alone @ residuals.shared, jnp.einsum("qem,em->eq", by_own, residuals.own)
            ),
            scores=scores,
        )

    @property
    def ss(self) -> Float[Array, "p p"]:
        return jnp.sum(self.each, axis=0) + self.alone

    def times(self, change: Coordinates) -> Coordinates:
        return Coordinates(
            self.ss @ change.shared + jnp.einsum("epq,eq->p", self.so, change.own),
            jnp.einsum("epq,p->eq", self.so, change.shared) + jnp.einsum("eqr,er->eq", self.oo, change.own),
        )

    def damped(self, damping: Float[Array, ""], is_free: Coordinates) -> "NormalEquations":
        """With a number added to the diagonal, and 1 there of what is not free."""
        added = jax.tree.map(lambda free: damping + jnp.where(free, 0.0, 1.0), is_free)
        return eqx.tree_at(
            lambda normal: (normal.alone, normal.oo),
            self,
            (self.alone + jnp.diag(added.shared), self.oo + jax.vmap(jnp.diag)(added.own)),
        )

    def solution(self) -> Coordinates:
        """The unknowns that take the gradient: those of the experiments are eliminated."""
        following = jax.vmap(_solved)(self.oo, jnp.swapaxes(self.so, 1, 2))
        alone = jax.vmap(_solved)(self.oo, self.gradient.own[..., None])[..., 0]
        left = self.ss - jnp.einsum("epq,eqr->pr", self.so, following)
        right = self.gradient.shared - jnp.einsum("epq,eq->p", self.so, alone)
        shared = _solved(left, right[:, None])[:, 0]
        return Coordinates(shared, alone - jnp.einsum("eqp,p->eq", following, shared))


def _solved(matrix: Float[Array, "n n"], right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    if matrix.shape[0] == 0:
        return right
    return linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right)


class LeastSquares(eqx.Module):
    """Where the search ended: the unknowns, what was evaluated there, the sum of squares, whether it has converged."""

    at: Coordinates
    beside: Any
    squares: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


class _Point(NamedTuple):
    at: Coordinates
    beside: Any
    normal: NormalEquations
    squares: Float[Array, ""]


class _State(NamedTuple):
    here: _Point
    following: Coordinates
    region: Any
    steps: Int[Array, ""]
    is_done: Bool[Array, ""]


def least_squares(
    evaluated: Callable[[Coordinates, Any, Bool[Array, ""]], tuple[NormalEquations, Float[Array, ""], Any]],
    start: Coordinates,
    beside: Any,
    is_free: Coordinates,
    numbers: Float[Array, ""],
    max_steps: int,
) -> LeastSquares:
    """The unknowns at which a sum of squares is least.

    `evaluated(at, beside, is_first)`: the normal equations and the sum of squares, not a number where there is none;
    and what the next evaluation begins from, at first `beside`. `numbers`: how many residuals there are.
    """
    search = optx.ClassicalTrustRegion()

    def before(here: _Point) -> Any:
        unknowns = jax.eval_shape(lambda: here.at)
        hessian = lx.FunctionLinearOperator(here.normal.times, unknowns, lx.positive_semidefinite_tag)
        return optx.FunctionInfo.EvalGradHessian(here.squares / 2, here.normal.gradient, hessian)

    def step(state: _State) -> _State:
        is_first = state.steps == 0
        here = state.here
        there = _point(evaluated, state.following, here.beside, is_first)
        change = jax.tree.map(jnp.subtract, there.at, here.at)
        size, is_better, _, region = search.step(
            is_first, here.at, there.at, before(here), optx.FunctionInfo.Eval(there.squares / 2), state.region
        )
        predicted = -search.predict_reduction(change, before(here))
        squared = _dot(change, here.normal.times(change))
        largest = jnp.max(jnp.abs(jnp.concatenate([change.shared, change.own.reshape(-1)])), initial=0.0)
        free = jnp.sum(is_free.shared) + jnp.sum(is_free.own)
        freedom = jnp.maximum(numbers - free.astype(numbers.dtype), 1.0)
        is_last = (squared <= LAST_STEP**2 * there.squares / freedom) | (largest < LEAST_CHANGE)
        is_lost = ~is_better & (predicted <= ROUNDING * here.squares)
        is_undamped = _dot(change, change) <= squared * state.region.step_size
        is_still = ~is_better & is_undamped & (largest < LEAST_TRIED)
        kept = jax.tree.map(lambda new, old: jnp.where(is_better, new, old), there, here)
        found = kept.normal.damped(1 / size, is_free).solution()
        following = jax.tree.map(jnp.subtract, kept.at, found)
        is_done = ~is_first & ((is_better & is_last) | is_lost | is_still)
        return _State(kept, following, region, state.steps + 1, is_done)

    def is_running(state: _State) -> Bool[Array, ""]:
        is_stuck = state.region.step_size < LEAST_STEP
        return ~state.is_done & (state.steps < max_steps) & ~is_stuck

    shapes = jax.eval_shape(lambda: _point(evaluated, start, beside, jnp.array(True)))
    nothing = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    begin = _Point(start, beside, nothing.normal, nothing.squares)
    region = eqx.tree_at(
        lambda region: region.step_size,
        search.init(start, before(begin)),
        jnp.asarray(FIRST_STEP, start.shared.dtype),
    )
    end = jax.lax.while_loop(is_running, step, _State(begin, start, region, jnp.zeros((), int), jnp.array(False)))
    return LeastSquares(end.here.at, end.here.beside, end.here.squares, end.is_done, end.steps)


def _point(evaluated: Callable[..., Any], at: Coordinates, beside: Any, is_first: Bool[Array, ""]) -> _Point:
    normal, squares, beside = evaluated(at, beside, is_first)
    return _Point(at, beside, normal, squares)


def _dot(a: Coordinates, b: Coordinates) -> Float[Array, ""]:
    return jnp.sum(a.shared * b.shared) + jnp.sum(a.own * b.own)
