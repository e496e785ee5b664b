"""Levenberg and Marquardt's method for many experiments with unknowns in common and of their own.

optimistix has the trust region, what is accepted and when it ends. Here is what it cannot know: the Jacobian is one of
blocks, as the own unknowns of an experiment change nothing in others, so that a step costs as much as there are
experiments, and each solve starts from the shape of the last accepted step.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as linalg
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

# Inverse of the first damping, of unknowns that are large at 1, and of that at which nothing is found any more.
FIRST_STEP = 1e3
LEAST_STEP = 1e-12


class Coordinates(NamedTuple):
    """Of the unknowns in common (p,), and of those of each experiment (e, q)."""

    shared: Float[Array, "p"]
    own: Float[Array, "e q"]


class Residuals(NamedTuple):
    """Of each experiment (e, m), and those that depend on the unknowns in common alone (k,)."""

    own: Float[Array, "e m"]
    shared: Float[Array, "k"]


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
    def of(jacobian: Callable[[Coordinates], Residuals], residuals: Residuals, at: Coordinates) -> "NormalEquations":
        """`jacobian`: changes of the unknowns to those of the residuals."""
        p, q = at.shared.shape[0], at.own.shape[1]
        dtype = at.shared.dtype

        def by_shared(way: Float[Array, "p"]) -> Residuals:
            return jacobian(Coordinates(way, jnp.zeros_like(at.own)))

        def by_own(way: Float[Array, "q"]) -> Residuals:
            return jacobian(Coordinates(jnp.zeros_like(at.shared), jnp.broadcast_to(way[None], at.own.shape)))

        shared = jax.vmap(by_shared)(jnp.eye(p, dtype=dtype))
        own = jax.vmap(by_own)(jnp.eye(q, dtype=dtype)).own
        scores = jnp.einsum("pem,em->ep", shared.own, residuals.own)
        return NormalEquations(
            each=jnp.einsum("pem,rem->epr", shared.own, shared.own),
            alone=shared.shared @ shared.shared.T,
            so=jnp.einsum("pem,qem->epq", shared.own, own),
            oo=jnp.einsum("qem,rem->eqr", own, own),
            gradient=Coordinates(
                jnp.sum(scores, axis=0) + shared.shared @ residuals.shared,
                jnp.einsum("qem,em->eq", own, residuals.own),
            ),
            scores=scores,
        )

    @property
    def ss(self) -> Float[Array, "p p"]:
        return jnp.sum(self.each, axis=0) + self.alone

    def damped(self, damping: Float[Array, ""], is_free: Coordinates) -> "NormalEquations":
        """With a number added to the diagonal, and 1 there of what is not free."""
        added = jax.tree.map(lambda free: damping + jnp.where(free, 0.0, 1.0), is_free)
        return eqx.tree_at(
            lambda normal: (normal.alone, normal.oo),
            self,
            (self.alone + jnp.diag(added.shared), self.oo + jax.vmap(jnp.diag)(added.own)),
        )

    def eliminated(self) -> tuple[Float[Array, "p p"], Float[Array, "e q p"]]:
        """What is left for the unknowns in common, and how those of experiments follow: o = -W s."""
        following = jax.vmap(_solved)(self.oo, jnp.swapaxes(self.so, 1, 2))
        return self.ss - jnp.einsum("epq,eqr->pr", self.so, following), following

    def solution(self) -> Coordinates:
        """The unknowns that take the gradient."""
        left, following = self.eliminated()
        alone = jax.vmap(_solved)(self.oo, self.gradient.own[..., None])[..., 0]
        right = self.gradient.shared - jnp.einsum("epq,eq->p", self.so, alone)
        shared = _solved(left, right[:, None])[:, 0]
        return Coordinates(shared, alone - jnp.einsum("eqp,p->eq", following, shared))


def _solved(matrix: Float[Array, "n n"], right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    if matrix.shape[0] == 0:
        return right
    return linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right)


class _State(eqx.Module):
    normal: NormalEquations


class _DampedDescent(optx.AbstractDescent):
    is_free: Coordinates

    def init(self, y: Coordinates, f_info_struct: Any) -> _State:
        def nothing(*shape: int) -> Array:
            return jnp.zeros(shape, y.shared.dtype)

        (p,), (e, q) = y.shared.shape, y.own.shape
        gradient = Coordinates(nothing(p), nothing(e, q))
        blocks = nothing(e, p, p), nothing(p, p), nothing(e, p, q), nothing(e, q, q)
        return _State(NormalEquations(*blocks, gradient, nothing(e, p)))

    def query(self, y: Coordinates, f_info: Any, state: _State) -> _State:
        return _State(NormalEquations.of(f_info.jac.mv, f_info.residual, y))

    def step(self, step_size: Float[Array, ""], state: _State) -> tuple[Coordinates, optx.RESULTS]:
        found = state.normal.damped(1 / step_size, self.is_free).solution()
        return jax.tree.map(jnp.negative, found), optx.RESULTS.successful


class _LevenbergMarquardt(optx.AbstractGaussNewton):
    rtol: float
    atol: float
    norm: Callable[[Any], Array] = eqx.field(static=True)
    descent: Any
    search: Any
    verbose: Callable[..., None] = eqx.field(static=True)


class LeastSquares(eqx.Module):
    """Where the search ended: the unknowns, what the residuals gave beside, their sum of squares, whether converged."""

    at: Coordinates
    beside: Any
    squares: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


def least_squares(
    residuals: Callable[[Coordinates, Any], tuple[Residuals, Any]],
    start: Coordinates,
    beside: Any,
    is_free: Coordinates,
    tolerance: float,
    max_steps: int,
) -> LeastSquares:
    """The unknowns at which the sum of squares is least.

    `residuals`: of the unknowns, and of what the last accepted evaluation gave beside the residuals, at first `beside`;
    `tolerance`: of the unknowns, and of the residuals by the largest of them.
    """
    solver = _LevenbergMarquardt(
        rtol=tolerance,
        atol=tolerance,
        norm=optx.max_norm,
        descent=_DampedDescent(is_free),
        search=optx.ClassicalTrustRegion(),
        verbose=_silent,
    )
    no_tags: frozenset[object] = frozenset()
    shapes, beside_shapes = jax.eval_shape(residuals, start, beside)
    begin = solver.init(residuals, start, beside, {}, shapes, beside_shapes, no_tags)
    # At first the trust region is wide: near the solution the method is Newton's.
    wide = eqx.tree_at(lambda state: state.search_state.step_size, begin, jnp.asarray(FIRST_STEP, start.shared.dtype))
    numbers, rest = eqx.partition(wide, eqx.is_array)

    def is_running(carry: Any) -> Bool[Array, ""]:
        _, numbers, _ = carry
        state = eqx.combine(numbers, rest)
        is_stuck = state.search_state.step_size < LEAST_STEP
        return ~state.terminate & (state.num_steps < max_steps) & ~is_stuck

    def step(carry: Any) -> Any:
        y, numbers, beside = carry
        y, state, _ = solver.step(residuals, y, beside, {}, eqx.combine(numbers, rest), no_tags)
        return y, eqx.filter(state, eqx.is_array), state.aux

    at, numbers, beside = jax.lax.while_loop(is_running, step, (start, numbers, beside))
    state = eqx.combine(numbers, rest)
    squares = sum(jnp.sum(x**2) for x in state.f_info.residual)
    return LeastSquares(at, beside, jnp.asarray(squares), state.terminate, state.num_steps)


def _silent(**kwargs: Any) -> None: ...
