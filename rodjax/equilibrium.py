"""solve(): the equilibrium of a scene."""

import functools
import typing
import warnings
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import instance, is_known, whole_number
from rodjax.discretization.dead_loads import energy_of_origin, load_energy
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.mixed import MixedForm, MixedPoint
from rodjax.discretization.results import resultants
from rodjax.guess import Guess, cubic, first_shape, resampled
from rodjax.plane import check_planar, is_planar, plane
from rodjax.scene import Scene, dead_end_moment, nondimensional
from rodjax.solvers.newton import Newton, find_minimum, is_stable
from rodjax.solvers.nonlinear_cg import NonlinearCG, minimize
from rodjax.status import Outcome, Status, is_converged
from rodjax.units import Units

Solver = Newton | NonlinearCG

# Edges that differ by so many roundings are the same.
SAME_EDGES = 64

DEFAULT_SEGMENTS = 50
DEFAULT_SOLVER = Newton()
# Beyond this a mesh is taken for a mistake: two nodes of a rod 100 m long would be closer than a millimetre.
MAX_SEGMENTS = 100_000


class NotConvergedWarning(UserWarning):
    """A solve ended without an equilibrium; the message says why."""


class SolverState(eqx.Module):
    """What a warm start begins from: the nondimensional unknowns, to the last bit, with their units.

    `end_force`: the force at s = L between held ends, else zero.
    """

    polyline: Polyline
    end_force: Float[Array, "... 3"]
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
    - `stable` [...] bool: converged, and the energy has no negative curvature there; with a dead moment, which has no
      potential, this is not examined and False
    - `iterations` [...] of the solver; `evaluations` [...] of the energy and its gradient; `substeps` [...] solves that
      a step of a path took: 1, or more where it was split
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
    stable: Bool[Array, "..."]
    status: Int[Array, "..."]
    iterations: Int[Array, "..."]
    evaluations: Int[Array, "..."]
    substeps: Int[Array, "..."]
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
    solver: Solver | None = None,
    guess: Guess | Equilibrium | None = None,
    planar: bool = False,
) -> Equilibrium:
    """The equilibrium of a scene.

    Compiled once for each structure of scene, solver and mesh; works inside `jax.jit` and `jax.vmap`.

    **Arguments:**

    - `scene`: `Scene`.
    - `segments`: of the mesh; `None`: those of a guess that is an `Equilibrium`, else 50.
    - `discretization`: `"finite_difference"`, the only one in this version: second order in 1/segments.
    - `solver`: `Newton` or `NonlinearCG`; `None` for `Newton()`.
    - `guess`: an earlier `Equilibrium` (a warm start, which carries turns), a `Guess`, or `None`: a shape made from the
      supports and gravity.
    - `planar`: seek the rod in the plane in which supports and loads lie, with half of the unknowns. `stable` speaks of
      motions out of the plane too.

    Where the solve does not converge the result says so, and outside `jit` a `NotConvergedWarning` gives the reason.
    Raises `ValueError` or `TypeError` for arguments that make no sense.
    """
    instance(scene, "scene", Scene)
    if scene.rod.length.ndim:
        raise ValueError(
            f"scene must be a single scene, got a stack of shape {scene.rod.length.shape}; "
            "solve_path takes scenes one after another, jax.vmap(solve) independent ones"
        )
    segments, solver = checked_options(scene, segments, discretization, solver, guess, planar)
    result = _solve(scene, guess, segments, solver, planar)
    warn_if_not_converged(result)
    return result


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
    scene: Scene,
    segments: int | None,
    discretization: str,
    solver: Solver | None,
    guess: Guess | Equilibrium | None,
    planar: bool,
) -> tuple[int, Solver]:
    """Segments and solver with the library's choice for `None`."""
    if discretization != "finite_difference":
        raise ValueError(f"discretization must be 'finite_difference' in this version, got {discretization!r}")
    if guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
    if segments is None:
        segments = guess.s.shape[-1] - 1 if isinstance(guess, Equilibrium) else DEFAULT_SEGMENTS
    segments = whole_number(segments, "segments", 2, MAX_SEGMENTS)
    if solver is None:
        solver = DEFAULT_SOLVER
    instance(solver, "solver", typing.get_args(Solver))
    if dead_end_moment(scene) is not None and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton for a dead moment on a free end, which no energy is minimal under")
    instance(planar, "planar", bool)
    if planar:
        if isinstance(solver, NonlinearCG):
            raise ValueError("solver must be a Newton where planar is True")
        check_planar(scene, 0.0 if guess is None else guess.total_twist)
    return segments, solver


def first_state(scene: Scene, guess: Guess | Equilibrium | None, segments: int) -> tuple[SolverState, Float[Array, ""]]:
    """Where to begin, and the total twist to stay near to [rad]."""
    scaled, units = nondimensional(scene)
    no_force = jnp.zeros(3, scene.rod.length.dtype)
    if guess is None:
        shape = Polyline.through(first_shape(scaled, segments))
        return SolverState(shape, no_force, units), jnp.zeros_like(scene.rod.length)
    if isinstance(guess, Guess):
        return SolverState(guess.polyline(units, segments), no_force, units), guess.total_twist
    state = guess.state
    if guess.s.shape[-1] - 1 != segments:
        polyline = Polyline.through(resampled(state.polyline.nodes, segments))
        state = SolverState(polyline, state.end_force, state.units)
    return state, guess.total_twist


class Found(eqx.Module):
    """Where a solver stopped, nondimensional."""

    state: SolverState
    point: MixedPoint
    outcome: Outcome
    is_stable: Bool[Array, ""]


def solve_from(scene: Scene, state: SolverState, twist: Float[Array, ""], solver: Solver, planar: bool) -> Found:
    """The one code path of every solve: from a state to where the solver stops."""
    scaled, units = nondimensional(scene)
    return _found(scaled, _in_units(state, units), twist, solver=solver, planar=planar)


def equilibrium(scene: Scene, found: Found, substeps: Int[Array, ""]) -> Equilibrium:
    """What a solver found, in SI units."""
    scaled, _ = nondimensional(scene)
    point, outcome, units = found.point, found.outcome, found.state.units
    polyline = found.state.polyline
    n = len(polyline.edges)
    form = MixedForm.of(scaled, n)
    results = resultants(scaled, point.tangents, form.edge_tension(point), form.end_forces(point), point.total_twist)
    elastic_energy = form.elastic_energy(point)
    loads = load_energy(scaled, polyline.nodes)
    potential = elastic_energy if loads is None else elastic_energy + loads
    fraction = jnp.linspace(0.0, 1.0, n + 1, dtype=elastic_energy.dtype)
    converged = is_converged(outcome.status)
    return Equilibrium(
        s=fraction * scene.rod.length,
        nodes=units.origin[None] + units.length * polyline.nodes,
        frames=results.frames,
        curvature=results.curvature / units.length,
        twist=results.twist / units.length,
        total_twist=point.total_twist,
        tension=results.tension * units.force,
        energy=units.energy * potential + energy_of_origin(scaled, units),
        elastic_energy=units.energy * elastic_energy,
        start_force=results.start_force * units.force,
        start_moment=results.start_moment * units.energy,
        end_force=results.end_force * units.force,
        end_moment=results.end_moment * units.energy,
        converged=converged,
        stable=converged & found.is_stable,
        status=outcome.status,
        iterations=outcome.iterations,
        evaluations=outcome.evaluations,
        substeps=substeps,
        residual=outcome.residual,
        radius=scene.rod.radius,
        state=found.state,
    )


@eqx.filter_custom_jvp
def _found(scene: Scene, guess: SolverState, twist: Float[Array, ""], *, solver: Solver, planar: bool) -> Found:
    problem, start = FiniteDifference.begin(scene, guess.polyline, twist)
    form = MixedForm.of(scene, len(start.edges))
    if isinstance(solver, NonlinearCG):
        minimum = minimize(problem, start, solver)
        point = minimum.problem.mixed_point(minimum.point)
        polyline, stable, outcome = minimum.point, is_stable(form, point), minimum.outcome
    else:
        begin = eqx.tree_at(lambda point: point.end_force, problem.mixed_point(start), guess.end_force)
        normal = None
        if planar:
            normal, axes = plane(scene, begin.tangents)
            begin = begin.flattened(axes)
            form = form.along(axes)
        minimum = find_minimum(form, begin, solver)
        point, outcome, stable = minimum.point, minimum.outcome, minimum.is_stable
        edges = form.edges(point)
        # An unchanged scene gives back the same bits. (A straight rod under another pull takes no iteration either.)
        change = jnp.max(jnp.abs(edges - start.edges)) * len(edges)
        is_start = (outcome.iterations == 0) & (change <= SAME_EDGES * jnp.finfo(edges.dtype).eps)
        reached = Polyline(form.nodes(edges), edges)
        polyline = jax.tree.map(lambda old, new: jnp.where(is_start, old, new), start, reached)
        if normal is not None:
            stable &= is_stable(form.along(normal[:, None]), point)
            # Inside a user's own jit the scene could not be checked before.
            status = jnp.where(is_planar(scene, twist), outcome.status, Status.NOT_PLANAR)
            outcome = eqx.tree_at(lambda outcome: outcome.status, outcome, status)
    return Found(SolverState(polyline, point.end_force, guess.units), point, outcome, stable)


@_found.def_jvp
def _no_derivative(primals, tangents, *, solver: Solver, planar: bool):
    # Differentiating the iterations would give numbers that look right and are not.
    raise NotImplementedError(
        "the derivative of a solve is not part of this version; "
        "take central differences of solves with a tight tolerance"
    )


# Not eqx.filter_jit: it parts arrays from the rest in Python at each call, 0.08 ms of a warm solve of 0.3 ms.
@functools.partial(jax.jit, static_argnames=("segments", "solver", "planar"))
def _solve(scene: Scene, guess: Guess | Equilibrium | None, segments: int, solver: Solver, planar: bool) -> Equilibrium:
    state, twist = first_state(scene, guess, segments)
    return equilibrium(scene, solve_from(scene, state, twist, solver, planar), jnp.ones((), int))


def _in_units(state: SolverState, units: Units) -> SolverState:
    """The unknowns in other units; unchanged to the last bit where the units are the same."""
    ratio = state.units.length / units.length
    shift = (state.units.origin - units.origin) / units.length
    polyline = Polyline(state.polyline.nodes * ratio + shift[None], state.polyline.edges * ratio)
    return SolverState(polyline, state.end_force * (state.units.force / units.force), units)


def _slopes(nodes: Float[Array, "n+1 3"], tangents: Float[Array, "n+1 3"]) -> Float[Array, "n+1 3"]:
    """Derivatives by the node number: tangents as long as the edges beside them."""
    lengths = jnp.sqrt(jnp.sum(jnp.diff(nodes, axis=0) ** 2, axis=1))
    beside = jnp.concatenate([lengths[:1], lengths]) + jnp.concatenate([lengths, lengths[-1:]])
    return beside[:, None] / 2 * tangents


def warn_if_not_converged(equilibrium: Equilibrium) -> None:
    if is_known(equilibrium.converged) and not np.all(equilibrium.converged):
        warnings.warn(describe(equilibrium), NotConvergedWarning, stacklevel=3)
