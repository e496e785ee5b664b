"""Nonlinear conjugate gradients, plain as in Linn & Stephan (2008) or preconditioned by the Gauss-Newton Hessian."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from rodjax.checks import instance, not_negative, plain_number, whole_number
from rodjax.solving.line_search import Bracket, LineSearch
from rodjax.solving.status import Outcome, Status


class NonlinearCG(eqx.Module):
    """Polak-Ribiere+ conjugate gradients.

    **Arguments:**

    - `preconditioner`: `"gauss_newton"`, factorised at the start and every `refresh` iterations, or `None`, the
        report's method: hundreds of iterations a step at 10 segments, tens of thousands at 50.
    - `tolerance`: largest component of the gradient, in units of EI/L^2, at which a solve has converged. Where the
        rounding of the mesh does not let it fall so far, that floor is the tolerance, and the status says so.
    - `max_iterations`: iterations after which a solve is given up.
    - `refresh`: iterations after which the preconditioner is factorised anew, at the point reached.
    - `line_search`: its options.
    """

    preconditioner: Literal["gauss_newton"] | None = eqx.field(static=True, default="gauss_newton")
    tolerance: float = eqx.field(default=1e-8, converter=plain_number("tolerance"))
    max_iterations: int = 20000
    refresh: int = 7
    line_search: LineSearch = LineSearch()

    def __check_init__(self):
        if self.preconditioner not in ("gauss_newton", None):
            raise ValueError(f"preconditioner must be 'gauss_newton' or None, got {self.preconditioner!r}")
        not_negative(self.tolerance, "tolerance")
        whole_number(self.max_iterations, "max_iterations", 1, 10**9)
        whole_number(self.refresh, "refresh", 1, 10**9)
        instance(self.line_search, "line_search", LineSearch)


# A plain search starts with a step this small against the largest that keeps the edges from turning over.
FIRST_STEP = 1e-3
# A search that fails within this factor of the estimated rounding floor has met that floor.
STAGNATION = 10.0


class Minimum(eqx.Module):
    """Where a minimiser stopped: the point, and the problem seen from there."""

    problem: Any
    point: PyTree
    outcome: Outcome


class _State(eqx.Module):
    # The last accepted point and what is known there; the search from it.
    reference: PyTree  # what the problem measures from, renewed with the preconditioner
    point: PyTree
    energy: Float[Array, ""]
    gradient: Float[Array, "m 3"]
    preconditioned: Float[Array, "m 3"]
    factors: PyTree | None
    direction: Float[Array, "m 3"]
    slope: Float[Array, ""]
    step: Float[Array, ""]
    bracket: Bracket
    restart: Bool[Array, ""]  # the next trial is the point itself: accept it and start afresh
    is_fresh: Bool[Array, ""]  # this search is the first after a restart
    iterations: Int[Array, ""]
    evaluations: Int[Array, ""]
    status: Int[Array, ""]


def progress(
    problem: Any,
    solver: Any,
    point: PyTree,
    energy: Float[Array, ""],
    gradient: Float[Array, "m 3"],
    iterations: Int[Array, ""],
) -> Int[Array, ""]:
    """The `Status` at a point: done, to go on, or given up."""
    residual = jnp.max(jnp.abs(gradient))
    status = jnp.where(iterations >= solver.max_iterations, Status.MAX_ITERATIONS, Status.RUNNING)
    status = jnp.where(residual <= problem.rounding_floor(point), Status.ROUNDING_FLOOR, status)
    status = jnp.where(residual <= solver.tolerance, Status.CONVERGED, status)
    return jnp.where(jnp.isfinite(energy + residual), status, Status.NOT_FINITE)


def minimize(problem: Any, point: PyTree, solver: NonlinearCG) -> Minimum:
    """Minimise the energy of a discretized scene, from `point`.

    One loop, one energy evaluation a turn: the trial step is accepted, and gives the next direction, or it narrows the
    line search. `FiniteDifference` is such a problem.
    """
    search = solver.line_search

    def turn(state: _State) -> _State:
        here = problem.with_reference(state.reference)
        trial = here.displaced(state.point, state.step * state.direction)
        energy, gradient = here.energy_and_gradient(trial)
        slope = jnp.sum(gradient * state.direction)
        energy_is_low = jnp.isfinite(slope) & (energy <= search.energy_bound(state.energy))
        state = eqx.tree_at(lambda state: state.evaluations, state, state.evaluations + 1)
        return jax.lax.cond(
            state.restart | search.accepts(slope, state.slope, energy_is_low),
            lambda: advanced(here, state, trial, energy, gradient),
            lambda: narrowed(state, slope, energy_is_low),
        )

    def prepared(here: Any, point: PyTree) -> tuple[PyTree, PyTree | None]:
        preconditioned = solver.preconditioner is not None
        return here.reference_at(point), here.gauss_newton(point) if preconditioned else None

    def advanced(
        here: Any, state: _State, point: PyTree, energy: Float[Array, ""], gradient: Float[Array, "m 3"]
    ) -> _State:
        iterations = state.iterations + jnp.where(state.restart, 0, 1)
        status = progress(problem, solver, point, energy, gradient, iterations)
        renew = state.restart
        reference, factors = jax.lax.cond(
            (renew | (iterations % solver.refresh == 0)) & (status == Status.RUNNING),
            lambda: prepared(here, point),
            lambda: (state.reference, state.factors),
        )
        preconditioned = gradient
        if factors is not None:  # in an extreme scene rounding can make even J^T J indefinite
            solved = problem.precondition(factors, gradient)
            preconditioned = jnp.where(factors.is_positive_definite, solved, gradient)
        change = jnp.sum(preconditioned * (gradient - state.gradient))
        beta = jnp.maximum(0.0, change / jnp.sum(state.gradient * state.preconditioned))
        direction = jnp.where(renew, 0.0, beta) * state.direction - preconditioned
        slope = jnp.sum(gradient * direction)
        renew |= ~(slope < 0)
        direction = jnp.where(renew, -preconditioned, direction)
        slope = jnp.where(renew, -jnp.sum(gradient * preconditioned), slope)
        reach = problem.largest_step(direction)
        if factors is None:
            step = jnp.where(renew, FIRST_STEP * reach, state.step * state.slope / slope)
        else:  # Newton-like: the right step stays near one while the slopes fall by orders of magnitude
            step = jnp.where(renew, 1.0, state.step)
        return _State(
            reference=reference,
            point=point,
            energy=energy,
            gradient=gradient,
            preconditioned=preconditioned,
            factors=factors,
            direction=direction,
            slope=slope,
            step=jnp.minimum(step, reach),
            bracket=Bracket.open(slope),
            restart=jnp.array(False),
            is_fresh=state.restart,
            iterations=iterations,
            evaluations=state.evaluations,
            status=status,
        )

    def narrowed(state: _State, slope: Float[Array, ""], energy_is_low: Bool[Array, ""]) -> _State:
        bracket, step = search.narrowed(state.bracket, state.step, slope, energy_is_low)
        exhausted = bracket.trials >= search.max_trials
        # A direction that failed is given up for the preconditioned gradient; if that failed too, so has the search.
        failed = exhausted & state.is_fresh
        stagnated = jnp.max(jnp.abs(state.gradient)) <= STAGNATION * problem.rounding_floor(state.point)
        reason = jnp.where(stagnated, Status.ROUNDING_FLOOR, Status.LINE_SEARCH_FAILED)
        return eqx.tree_at(
            lambda state: (state.bracket, state.step, state.restart, state.status),
            state,
            (
                bracket,
                jnp.where(exhausted, 0.0, step),
                exhausted,
                jnp.where(failed, reason, state.status).astype(state.status.dtype),
            ),
        )

    zero = problem.no_displacement(point)
    scalar = jnp.zeros((), zero.dtype)
    count = jnp.zeros((), int)
    shapes = eqx.filter_eval_shape(prepared, problem, point)
    _, factors = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    state = _State(
        reference=problem.reference,
        point=point,
        energy=scalar,
        gradient=zero,
        preconditioned=zero,
        factors=factors,
        direction=zero,
        slope=scalar,
        step=scalar,
        bracket=Bracket.open(scalar),
        restart=jnp.array(True),
        is_fresh=jnp.array(False),
        iterations=count,
        evaluations=count,
        status=jnp.full((), Status.RUNNING, int),
    )
    state = jax.lax.while_loop(lambda state: state.status == Status.RUNNING, turn, state)
    return Minimum(
        problem=problem.with_reference(state.reference),
        point=state.point,
        outcome=Outcome(jnp.max(jnp.abs(state.gradient)), state.iterations, state.evaluations, state.status),
    )
