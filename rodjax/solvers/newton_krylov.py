"""Newton's method on the residual, for loads without a potential.

Under a dead moment the tangent is not symmetric, and conjugate gradients may circle around an equilibrium for ever.
Newton steps by GMRES, preconditioned by the Gauss-Newton Hessian, close in on it. Where they fail from the first shape,
conjugate gradients bring the rod nearer, for a bounded number of iterations, and Newton tries once more.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float, Int, PyTree

from rodjax.linalg import factor
from rodjax.solvers.nonlinear_cg import Minimum, NonlinearCG, minimize, progress
from rodjax.status import Status, is_converged

MAX_STEPS = 100
MAX_HALVINGS = 12
# Before the second try, conjugate gradients stop at this gradient [EI/L^2], or after so many iterations.
NEAR = 1e-2
NEAR_ITERATIONS = 300
# A linear solve this exact loses nothing of Newton's quadratic convergence that the tolerance would show.
LINEAR_TOLERANCE = 1e-6
KRYLOV_DIMENSION = 30


class _State(eqx.Module):
    point: PyTree
    energy: Float[Array, ""]
    gradient: Float[Array, "m 3"]
    steps: Int[Array, ""]
    evaluations: Int[Array, ""]
    status: Int[Array, ""]


def find_equilibrium(problem, point: PyTree, solver: NonlinearCG) -> Minimum:
    """The equilibrium of a discretized scene whose loads have no potential; `problem` as for `minimize`."""
    near = NonlinearCG(
        preconditioner=solver.preconditioner,
        tolerance=max(NEAR, solver.tolerance),
        max_iterations=min(NEAR_ITERATIONS, solver.max_iterations),
        refresh=solver.refresh,
        line_search=solver.line_search,
    )
    zero = jnp.zeros((), int)

    def nearer() -> tuple[PyTree, Int[Array, ""], Int[Array, ""]]:
        found = minimize(problem, point, near)
        return found.point, found.iterations, found.evaluations

    def attempt(state: tuple[_State, Int[Array, ""]]) -> tuple[_State, Int[Array, ""]]:
        last, attempts = state
        start, iterations, evaluations = jax.lax.cond(attempts == 0, lambda: (point, zero, zero), nearer)
        found = _newton(problem, start, solver)
        spent = (last.steps + iterations + found.steps, last.evaluations + evaluations + found.evaluations)
        return eqx.tree_at(lambda state: (state.steps, state.evaluations), found, spent), attempts + 1

    def unfinished(state: tuple[_State, Int[Array, ""]]):
        found, attempts = state
        return (attempts < 2) & ~is_converged(found.status)

    nothing = problem.no_displacement(point)
    begin = _State(point, jnp.zeros((), nothing.dtype), nothing, zero, zero, jnp.full((), Status.RUNNING, int))
    found, _ = jax.lax.while_loop(unfinished, attempt, (begin, zero))
    return Minimum(
        problem=problem,
        point=found.point,
        energy=found.energy,
        residual=jnp.max(jnp.abs(found.gradient)),
        iterations=found.steps,
        evaluations=found.evaluations,
        status=found.status,
    )


def _newton(problem, point: PyTree, solver: NonlinearCG) -> _State:
    """Newton steps, each halved until the gradient falls, in the norm that weighs stretch as bending."""

    def step(state: _State) -> _State:
        factors = factor(problem.gauss_newton(state.point))
        rest = problem.no_displacement(state.point)

        def gradient_after(displacement):
            return problem.energy_and_gradient(problem.moved(state.point, displacement))[1]

        def tangent(v):
            return problem.precondition(factors, jax.jvp(gradient_after, (rest,), (v.reshape(rest.shape),))[1]).ravel()

        right_side = -problem.precondition(factors, state.gradient)
        before = -jnp.sum(state.gradient * right_side)
        direction = gmres(tangent, right_side.ravel(), LINEAR_TOLERANCE, KRYLOV_DIMENSION).reshape(rest.shape)
        largest = jnp.minimum(1.0, problem.largest_step(direction))

        def halve(trial: tuple[_State, Float[Array, ""]]) -> tuple[_State, Float[Array, ""]]:
            last, _ = trial
            point = problem.moved(state.point, largest * jnp.exp2(-last.steps.astype(before.dtype)) * direction)
            energy, gradient = problem.energy_and_gradient(point)
            size = jnp.sum(gradient * problem.precondition(factors, gradient))
            return _State(point, energy, gradient, last.steps + 1, last.evaluations + 1, last.status), size

        def is_no_better(trial: tuple[_State, Float[Array, ""]]):
            last, size = trial
            return ~(size < before) & (last.steps <= MAX_HALVINGS)

        trial = eqx.tree_at(lambda state: state.steps, state, jnp.zeros((), int))
        trial, size = jax.lax.while_loop(is_no_better, halve, (trial, jnp.full_like(before, jnp.inf)))
        steps = state.steps + 1
        status = progress(problem, solver, trial.point, trial.energy, trial.gradient, steps)
        status = jnp.where((status == Status.RUNNING) & (steps >= MAX_STEPS), Status.MAX_ITERATIONS, status)
        status = jnp.where((status == Status.RUNNING) & ~(size < before), Status.LINE_SEARCH_FAILED, status)
        return _State(trial.point, trial.energy, trial.gradient, steps, trial.evaluations, status)

    energy, gradient = problem.energy_and_gradient(point)
    zero = jnp.zeros((), int)
    status = progress(problem, solver, point, energy, gradient, zero)
    state = _State(point, energy, gradient, zero, zero + 1, status)
    return jax.lax.while_loop(lambda state: state.status == Status.RUNNING, step, state)


def gmres(
    apply: Callable[[Array], Array], right_side: Float[Array, "n"], tolerance: float, dimension: int
) -> Float[Array, "n"]:
    """Solve A x = b by GMRES without restarts (Saad & Schultz 1986), `apply(x)` being A x.

    Stops at a relative residual below `tolerance`, or at `dimension` Krylov vectors. jax.scipy has one, which traces A
    several times over: seven seconds of compiling more for a rod.
    """
    n = len(right_side)
    dtype = right_side.dtype
    size = jnp.linalg.norm(right_side)
    nonzero = jnp.where(size > 0, size, 1.0)
    basis = jnp.zeros((dimension + 1, n), dtype).at[0].set(right_side / nonzero)
    # Until a column is filled its identity keeps the triangular solve regular and its part of the solution zero.
    triangle = jnp.eye(dimension, dtype=dtype)
    rotations = jnp.zeros((dimension, 2), dtype)
    target = jnp.zeros(dimension + 1, dtype).at[0].set(size)

    def unfinished(state):
        k, _, _, _, target = state
        return (k < dimension) & (jnp.abs(target[k]) > tolerance * size)

    def extend(state):
        k, basis, triangle, rotations, target = state
        v = apply(basis[k])
        column = jnp.zeros(dimension + 1, dtype)
        for _ in range(2):  # Gram-Schmidt, twice for orthogonality to rounding; vectors not yet made are zero
            part = basis @ v
            v -= part @ basis
            column += part
        rest = jnp.linalg.norm(v)
        basis = basis.at[k + 1].set(v / jnp.where(rest > 0, rest, 1.0))

        def rotate(i, column):
            c, s = rotations[i]
            return column.at[i].set(c * column[i] + s * column[i + 1]).at[i + 1].set(c * column[i + 1] - s * column[i])

        column = jax.lax.fori_loop(0, k, rotate, column.at[k + 1].set(rest))
        length = jnp.hypot(column[k], column[k + 1])
        length = jnp.where(length > 0, length, 1.0)
        c, s = column[k] / length, column[k + 1] / length
        column = column.at[k].set(length).at[k + 1].set(0.0)
        target = target.at[k + 1].set(-s * target[k]).at[k].multiply(c)
        return k + 1, basis, triangle.at[:, k].set(column[:-1]), rotations.at[k].set(jnp.stack([c, s])), target

    k, basis, triangle, _, target = jax.lax.while_loop(unfinished, extend, (0, basis, triangle, rotations, target))
    used = jnp.where(jnp.arange(dimension) < k, target[:-1], 0.0)
    return jax.scipy.linalg.solve_triangular(triangle, used) @ basis[:-1]
