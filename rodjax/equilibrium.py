"""solve(): the equilibrium of a scene."""

import warnings
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import instance, is_known, whole_number
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.guess import Guess, cubic, first_shape, resampled
from rodjax.scene import Scene, nondimensional
from rodjax.solvers.newton_krylov import find_equilibrium
from rodjax.solvers.nonlinear_cg import Minimum, NonlinearCG, minimize
from rodjax.status import Status, is_converged
from rodjax.units import Units

DEFAULT_SEGMENTS = 50
# Beyond this a mesh is taken for a mistake: two nodes of a rod 100 m long would be closer than a millimetre.
MAX_SEGMENTS = 100_000


class NotConvergedWarning(UserWarning):
    """A solve ended without an equilibrium; the message says why."""


class SolverState(eqx.Module):
    """What a warm start begins from: the nondimensional unknowns, to the last bit, with their units."""

    polyline: Polyline
    units: Units


class Equilibrium(eqx.Module):
    """The equilibrium of a scene, or several of them along a leading axis `...` of every field.

    Forces and moments are what the part of the rod beyond s exerts on the part before it, global axes, moments about
    the centerline: at s = L what the support applies to the rod, at s = 0 the reverse of it.

    - `s` [..., n+1] arclength of the nodes, m
    - `nodes` [..., n+1, 3] centerline, m
    - `frames` [..., n+1, 3, 3] material frames, columns d1, d2, t; `tangents` [..., n+1, 3] their last column
    - `curvature` [..., n+1] |t x t'|, 1/m
    - `twist` [..., n+1] Omega, rad/m; `total_twist` [...] its integral, rad, not reduced
    - `tension` [..., n+1] N
    - `energy` [...] elastic energy minus the work of dead forces, J, zero of height at the origin; the work of a dead
      moment depends on the way and is left out; `elastic_energy` [...] J
    - `start_force`, `start_moment`, `end_force`, `end_moment` [..., 3] N, N m
    - `converged` [...] bool; `status` [...] code, in words by `rodjax.describe`
    - `iterations` [...] of the solver; `evaluations` [...] of the energy and its gradient
    - `residual` [...] largest component of the gradient, in EI/L^2
    - `radius` [...] of the rod, m, or `None`: for pictures
    """

    s: Float[Array, "... n+1"]
    nodes: Float[Array, "... n+1 3"]
    frames: Float[Array, "... n+1 3 3"]
    curvature: Float[Array, "... n+1"]
    twist: Float[Array, "... n+1"]
    total_twist: Float[Array, "..."]
    tension: Float[Array, "... n+1"]
    energy: Float[Array, "..."]
    elastic_energy: Float[Array, "..."]
    start_force: Float[Array, "... 3"]
    start_moment: Float[Array, "... 3"]
    end_force: Float[Array, "... 3"]
    end_moment: Float[Array, "... 3"]
    converged: Bool[Array, "..."]
    status: Int[Array, "..."]
    iterations: Int[Array, "..."]
    evaluations: Int[Array, "..."]
    residual: Float[Array, "..."]
    radius: Float[Array, "..."] | None
    state: SolverState

    @property
    def tangents(self) -> Float[Array, "... n+1 3"]:
        return self.frames[..., 2]

    def position_at(self, s: Any) -> Float[Array, "... k 3"]:
        """Centerline at arclengths `s` (k,) [m] from 0 to L: cubic between the nodes, [..., k, 3].

        Raises `ValueError` where an arclength lies beyond the rod.
        """
        s = jnp.atleast_1d(jnp.asarray(s, self.s.dtype))
        if is_known(s, self.s):
            length = float(np.min(self.s[..., -1]))
            if np.any(s < 0) or np.any(s > length):
                raise ValueError(f"s must lie in 0 to {length:g} m, got {np.min(s):g} to {np.max(s):g} m")

        def on_one(nodes, tangents, length):
            return cubic(nodes, _slopes(nodes, tangents), s / length * (len(nodes) - 1))

        return jnp.vectorize(on_one, signature="(n,3),(n,3),()->(k,3)")(self.nodes, self.tangents, self.s[..., -1])


def solve(
    scene: Scene,
    *,
    segments: int | None = None,
    discretization: Literal["finite_difference"] = "finite_difference",
    solver: NonlinearCG | None = None,
    guess: Guess | Equilibrium | None = None,
) -> Equilibrium:
    """The equilibrium of a scene.

    Compiled once for each structure of scene, solver and mesh; works inside `jax.jit` and `jax.vmap`.

    **Arguments:**

    - `scene`: `Scene`.
    - `segments`: of the mesh; `None`: those of a guess that is an `Equilibrium`, else 50.
    - `discretization`: `"finite_difference"`, the only one in this version: second order in 1/segments.
    - `solver`: `NonlinearCG`; `None` for its defaults.
    - `guess`: an earlier `Equilibrium` (a warm start, which carries turns), a `Guess`, or `None`: a shape made from the
      supports and gravity.

    Where the solve does not converge the result says so, and outside `jit` a `NotConvergedWarning` gives the reason.
    Raises `ValueError` or `TypeError` for arguments that make no sense.
    """
    instance(scene, "scene", Scene)
    if scene.rod.length.ndim:
        raise ValueError(
            f"scene must be a single scene, got a stack of shape {scene.rod.length.shape}; "
            "solve_path takes scenes one after another, jax.vmap(solve) independent ones"
        )
    segments, solver = checked_options(segments, discretization, solver, guess)
    equilibrium = _solve(scene, guess, segments, solver)
    warn_if_not_converged(equilibrium)
    return equilibrium


def describe(equilibrium: Equilibrium) -> str:
    """How a solve ended, in words; for several, each outcome with its count."""
    codes, counts = np.unique(np.asarray(equilibrium.status), return_counts=True)
    if equilibrium.status.ndim == 0:
        return (
            f"{Status(codes[0]).message}; residual {float(equilibrium.residual):.1e} EI/L^2 "
            f"after {int(equilibrium.iterations)} iterations"
        )
    return "\n".join(f"{count} {Status(code).message}" for code, count in zip(codes, counts, strict=True))


def checked_options(
    segments: int | None, discretization: str, solver: NonlinearCG | None, guess: Guess | Equilibrium | None
) -> tuple[int, NonlinearCG]:
    """Segments and solver with the library's choice for `None`."""
    if discretization != "finite_difference":
        raise ValueError(f"discretization must be 'finite_difference' in this version, got {discretization!r}")
    if guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
    if segments is None:
        segments = guess.s.shape[-1] - 1 if isinstance(guess, Equilibrium) else DEFAULT_SEGMENTS
    segments = whole_number(segments, "segments", 2, MAX_SEGMENTS)
    if solver is None:
        solver = NonlinearCG()
    instance(solver, "solver", NonlinearCG)
    return segments, solver


def first_state(scene: Scene, guess: Guess | Equilibrium | None, segments: int) -> tuple[SolverState, Float[Array, ""]]:
    """Where to begin, and the total twist to stay near to [rad]."""
    scaled, units = nondimensional(scene)
    if guess is None:
        shape = Polyline.through(first_shape(scaled, segments))
        return SolverState(shape, units), jnp.zeros_like(scene.rod.length)
    if isinstance(guess, Guess):
        return SolverState(guess.polyline(units, segments), units), guess.total_twist
    if guess.s.shape[-1] - 1 == segments:
        return guess.state, guess.total_twist
    nodes = guess.state.polyline.nodes
    return SolverState(Polyline.through(resampled(nodes, segments)), guess.state.units), guess.total_twist


def solve_from(scene: Scene, state: SolverState, twist: Float[Array, ""], solver: NonlinearCG) -> Equilibrium:
    """The one code path of every solve: from a state to an equilibrium."""
    scaled, units = nondimensional(scene)
    polyline = _in_units(state, units)
    minimum = _found(scaled, polyline, twist, solver=solver)
    problem, point = minimum.problem, minimum.point
    resultants = problem.resultants(point)
    n = len(point.edges)
    fraction = jnp.linspace(0.0, 1.0, n + 1, dtype=point.nodes.dtype)
    return Equilibrium(
        s=fraction * scene.rod.length,
        nodes=units.origin[None] + units.length * point.nodes,
        frames=resultants.frames,
        curvature=resultants.curvature / units.length,
        twist=resultants.twist / units.length,
        total_twist=resultants.total_twist,
        tension=resultants.tension * units.force,
        energy=units.energy * minimum.energy + problem.energy_of_origin(units),
        elastic_energy=units.energy * problem.elastic_energy(point),
        start_force=resultants.start_force * units.force,
        start_moment=resultants.start_moment * units.energy,
        end_force=resultants.end_force * units.force,
        end_moment=resultants.end_moment * units.energy,
        converged=is_converged(minimum.status),
        status=minimum.status,
        iterations=minimum.iterations,
        evaluations=minimum.evaluations,
        residual=minimum.residual,
        radius=scene.rod.radius,
        state=SolverState(point, units),
    )


@eqx.filter_custom_jvp
def _found(scene: Scene, polyline: Polyline, twist: Float[Array, ""], *, solver: NonlinearCG) -> Minimum:
    problem, start = FiniteDifference.begin(scene, polyline, twist)
    return (minimize if problem.has_potential else find_equilibrium)(problem, start, solver)


@_found.def_jvp
def _no_derivative(primals, tangents, *, solver: NonlinearCG):
    # Differentiating the iterations would give numbers that look right and are not.
    raise NotImplementedError(
        "the derivative of a solve is not part of this version; "
        "take central differences of solves with a tight tolerance"
    )


@eqx.filter_jit
def _solve(scene: Scene, guess: Guess | Equilibrium | None, segments: int, solver: NonlinearCG) -> Equilibrium:
    state, twist = first_state(scene, guess, segments)
    return solve_from(scene, state, twist, solver)


def _in_units(state: SolverState, units: Units) -> Polyline:
    """The unknowns in other units; unchanged to the last bit where the units are the same."""
    ratio = state.units.length / units.length
    shift = (state.units.origin - units.origin) / units.length
    return Polyline(state.polyline.nodes * ratio + shift[None], state.polyline.edges * ratio)


def _slopes(nodes: Float[Array, "n+1 3"], tangents: Float[Array, "n+1 3"]) -> Float[Array, "n+1 3"]:
    """Derivatives by the node number: tangents as long as the edges beside them."""
    lengths = jnp.sqrt(jnp.sum(jnp.diff(nodes, axis=0) ** 2, axis=1))
    beside = jnp.concatenate([lengths[:1], lengths]) + jnp.concatenate([lengths, lengths[-1:]])
    return beside[:, None] / 2 * tangents


def warn_if_not_converged(equilibrium: Equilibrium) -> None:
    if is_known(equilibrium.converged) and not np.all(equilibrium.converged):
        warnings.warn(describe(equilibrium), NotConvergedWarning, stacklevel=3)
