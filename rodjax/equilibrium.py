"""solve(): the equilibrium of a scene."""

import functools
import math
import typing
import warnings
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import instance, is_known, positive, whole_number
from rodjax.discretization.dead_loads import energy_of_origin
from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.error import estimated_errors
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.hermite import Curve, HermiteElements
from rodjax.discretization.mixed import MixedForm, MixedPoint
from rodjax.discretization.results import resultants
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import TangentField
from rodjax.discretization.twist import nearest_twist, twist_under_moment
from rodjax.energy import axial_strain_under
from rodjax.guess import Guess, cubic, first_shape, resampled
from rodjax.plane import check_planar, is_planar, plane
from rodjax.refinement import SAFETY, SIZES, graded, next_size
from rodjax.scene import Scene, dead_end_moment, held_at_both_ends, nondimensional
from rodjax.solvers.newton import Newton, find_minimum, is_stable
from rodjax.solvers.nonlinear_cg import NonlinearCG, minimize
from rodjax.status import Outcome, Status, is_converged
from rodjax.supports import Clamp
from rodjax.units import Units

Solver = Newton | NonlinearCG
Discretization = Literal["finite_difference", "hermite"]

# Shapes that differ by so many roundings are the same.
SAME_SHAPE = 64

DEFAULT_SEGMENTS = 50
# Elements of the first mesh on the way to a tolerance, and of the only one inside jit.
FIRST_SIZE = 6
TRACED_SEGMENTS = 32
# A smaller error than this drowns in the residual of 1e-8 EI/L^2 at which a solve stops.
LEAST_RTOL = 1e-10
DEFAULT_SOLVER = Newton()
# Beyond this a mesh is taken for a mistake: two nodes of a rod 100 m long would be closer than a millimetre.
MAX_SEGMENTS = 100_000


class NotConvergedWarning(UserWarning):
    """A solve ended without an equilibrium; the message says why."""


class SolverState(eqx.Module):
    """What a warm start begins from: the nondimensional unknowns, to the last bit, with their units.

    `shape`: a `Polyline` by finite differences, a `Curve` by Hermite elements; `end_force`: the force at s = L between
    held ends, else zero.
    """

    shape: Shape
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
    - `tension` [..., n+1] N; `axial_strain` [..., n+1] |phi'| - 1
    - `energy` [...] elastic energy minus the work of dead forces, J, zero of height at the origin; the work of a dead
      moment depends on the way and is left out; `elastic_energy` [...] J
    - `start_force`, `start_moment`, `end_force`, `end_moment` [..., 3] N, N m
    - `converged` [...] bool; `status` [...] code, in words by `rodjax.describe`
    - `stable` [...] bool: converged, and the energy has no negative curvature there; with a dead moment, which has no
      potential, this is not examined and False
    - `iterations` [...] of the solver; `evaluations` [...] of the energy and its gradient; `substeps` [...] solves that
      a step of a path took: 1, or more where it was split
    - `residual` [...] largest component of the gradient, in EI/L^2
    - `error_estimate` [...] of the mesh: largest distance of a node from the continuum, relative to L; Hermite elements
      only, else NaN
    - `radius` [...] of the rod, m, or `None`: for pictures
    """

    s: Float[Array, "... n+1"]
    nodes: Float[Array, "... n+1 3"]
    frames: Float[Array, "... n+1 3 3"]
    curvature: Float[Array, "... n+1"]
    twist: Float[Array, "... n+1"]
    total_twist: Float[Array, "..."]
    tension: Float[Array, "... n+1"]
    axial_strain: Float[Array, "... n+1"]
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
    error_estimate: Float[Array, "..."]
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

        slopes = (1 + self.axial_strain)[..., None] * self.tangents

        def on_one(places, nodes, slopes):
            return cubic(places, nodes, slopes, s)

        return jnp.vectorize(on_one, signature="(n),(n,3),(n,3)->(k,3)")(self.s, self.nodes, slopes)


def solve(
    scene: Scene,
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | None = None,
    planar: bool = False,
) -> Equilibrium:
    """The equilibrium of a scene.

    Compiled once for each structure of scene, solver and mesh; works inside `jax.jit` and `jax.vmap`.

    **Arguments:**

    - `scene`: `Scene`.
    - `segments`: of the mesh; `None`: those of a guess that is an `Equilibrium`, else 50.
    - `rtol`: the relative error of the shape that is wanted, instead of `segments`: Hermite elements are added, where
      they are needed, until the estimated error is below it. Where the numbers of the scene are not known, as inside
      `jit`, the mesh has 32 equal elements whatever `rtol`, and `error_estimate` says what that gives.
    - `discretization`: `"finite_difference"`, of second order in 1/segments, or `"hermite"`, of fourth order. `None`:
      `"hermite"` where `rtol` is given, that of the guess where its mesh is kept, else `"finite_difference"`.
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
    if discretization is None:
        discretization = "hermite" if rtol is not None else mesh_of(guess, segments, solver)
    if rtol is not None:
        _check_rtol(rtol, segments, discretization)
        segments = _first_size(guess) if is_known(scene, guess) else TRACED_SEGMENTS
    segments, solver = checked_options(scene, segments, discretization, solver, guess, planar)
    result = _solve(scene, guess, segments, discretization, solver, planar)
    if rtol is not None and is_known(result):
        result = _refined(scene, result, float(rtol), solver, planar)
    warn_if_not_converged(result)
    return result


def mesh_of(guess: Guess | Equilibrium | None, segments: int | None, solver: Solver | None) -> Discretization:
    """The discretization where none is asked for: that of a guess whose mesh is kept, if the solver knows it."""
    has_elements = isinstance(guess, Equilibrium) and isinstance(guess.state.shape, Curve)
    keeps_mesh = segments is None and not isinstance(solver, NonlinearCG)
    return "hermite" if has_elements and keeps_mesh else "finite_difference"


def _check_rtol(rtol: float, segments: int | None, discretization: Discretization) -> None:
    if segments is not None:
        raise ValueError(f"segments must be None where rtol is given, got segments={segments!r} and rtol={rtol!r}")
    if discretization != "hermite":
        raise ValueError(f"discretization must be 'hermite' where rtol is given, got {discretization!r}")
    if not LEAST_RTOL <= float(positive(rtol, "rtol")) <= 1.0:
        raise ValueError(f"rtol must lie in {LEAST_RTOL:g} to 1, got {rtol!r}")


def _first_size(guess: Guess | Equilibrium | None) -> int:
    if isinstance(guess, Equilibrium) and isinstance(guess.state.shape, Curve):
        return guess.s.shape[-1] - 1
    return FIRST_SIZE


def _refined(scene: Scene, result: Equilibrium, rtol: float, solver: Solver, planar: bool) -> Equilibrium:
    """Solved again, each time from the last, on meshes of more elements until the estimated error is below `rtol`."""
    while True:
        segments, error = result.s.shape[-1] - 1, float(result.error_estimate)
        if (bool(result.converged) and SAFETY * error <= rtol) or segments >= SIZES[-1]:
            break
        if not result.converged:
            error = math.nan
        iterations, evaluations = result.iterations, result.evaluations
        result = _solve_finer(scene, result, next_size(segments, error, rtol), solver, planar)
        result = eqx.tree_at(
            lambda result: (result.iterations, result.evaluations),
            result,
            (result.iterations + iterations, result.evaluations + evaluations),
        )
    if result.converged and not error <= rtol:
        warnings.warn(
            f"the estimated error {error:.1e} is above rtol = {rtol:g} on the finest mesh of {segments} elements",
            NotConvergedWarning,
            stacklevel=3,
        )
    return result


@functools.partial(jax.jit, static_argnames=("segments", "solver", "planar"))
def _solve_finer(scene: Scene, coarse: Equilibrium, segments: int, solver: Solver, planar: bool) -> Equilibrium:
    """On elements where the coarse solution, if it is one, shows defects."""
    scaled, _ = nondimensional(scene)
    state = coarse.state
    shape = state.shape
    assert isinstance(shape, Curve)
    form = MixedForm.of(scaled, _field(scaled, shape))
    errors = estimated_errors(form, MixedPoint(shape.tangents, state.end_force, coarse.total_twist))
    is_usable = coarse.converged & jnp.all(jnp.isfinite(errors.defects))
    s = graded(shape.s, jnp.where(is_usable, errors.defects, 1.0), segments)
    state = SolverState(shape.on(s), state.end_force, state.units)
    return equilibrium(scene, solve_from(scene, state, coarse.total_twist, solver, planar), jnp.ones((), int))


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
    discretization: Discretization,
    solver: Solver | None,
    guess: Guess | Equilibrium | None,
    planar: bool,
) -> tuple[int, Solver]:
    """Segments and solver with the library's choice for `None`."""
    if discretization not in typing.get_args(Discretization):
        allowed = " or ".join(map(repr, typing.get_args(Discretization)))
        raise ValueError(f"discretization must be {allowed}, got {discretization!r}")
    if guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
    if segments is None:
        segments = guess.s.shape[-1] - 1 if isinstance(guess, Equilibrium) else DEFAULT_SEGMENTS
    segments = whole_number(segments, "segments", 2, MAX_SEGMENTS)
    if solver is None:
        solver = DEFAULT_SOLVER
    instance(solver, "solver", typing.get_args(Solver))
    if discretization == "hermite" and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton where discretization is 'hermite'")
    if dead_end_moment(scene) is not None and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton for a dead moment on a free end, which no energy is minimal under")
    instance(planar, "planar", bool)
    if planar:
        if isinstance(solver, NonlinearCG):
            raise ValueError("solver must be a Newton where planar is True")
        check_planar(scene, 0.0 if guess is None else guess.total_twist)
    return segments, solver


def first_state(
    scene: Scene, guess: Guess | Equilibrium | None, segments: int, discretization: Discretization
) -> tuple[SolverState, Float[Array, ""]]:
    """Where to begin, and the total twist to stay near to [rad]."""
    scaled, units = nondimensional(scene)
    kind, pieces = (Polyline, segments) if discretization == "finite_difference" else (Curve, 2 * segments)
    no_force = jnp.zeros(3, scene.rod.length.dtype)
    if guess is None:
        return SolverState(kind.through(first_shape(scaled, pieces)), no_force, units), jnp.zeros_like(no_force[0])
    if isinstance(guess, Guess):
        return SolverState(kind.through(guess.nodes(units, pieces)), no_force, units), guess.total_twist
    state = guess.state
    if not isinstance(state.shape, kind) or guess.s.shape[-1] - 1 != segments:
        shape = kind.through(resampled(state.shape.nodes, pieces))
        state = SolverState(shape, state.end_force, state.units)
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
    nodes = found.state.shape.nodes
    form = MixedForm.of(scaled, _field(scaled, found.state.shape))
    results = resultants(form, point)
    elastic_energy = form.elastic_energy(point)
    potential = elastic_energy + form.load_energy(point)
    converged = is_converged(outcome.status)
    return Equilibrium(
        s=form.field.s * scene.rod.length,
        nodes=units.origin[None] + units.length * nodes,
        frames=results.frames,
        curvature=results.curvature / units.length,
        twist=results.twist / units.length,
        total_twist=point.total_twist,
        tension=results.tension * units.force,
        axial_strain=axial_strain_under(scaled.rod, results.tension),
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
        error_estimate=_error_estimate(form, point),
        radius=scene.rod.radius,
        state=found.state,
    )


def _error_estimate(form: MixedForm, point: MixedPoint) -> Float[Array, ""]:
    if not isinstance(form.field, HermiteElements):
        return jnp.full((), jnp.nan, point.tangents.dtype)
    return jnp.sqrt(jnp.max(jnp.sum(estimated_errors(form, point).nodes ** 2, axis=1)))


@eqx.filter_custom_jvp
def _found(scene: Scene, guess: SolverState, twist: Float[Array, ""], *, solver: Solver, planar: bool) -> Found:
    form = MixedForm.of(scene, _field(scene, guess.shape))
    if isinstance(solver, NonlinearCG):
        assert isinstance(guess.shape, Polyline)
        problem, start = FiniteDifference.begin(scene, guess.shape, twist)
        minimum = minimize(problem, start, solver)
        point = minimum.problem.mixed_point(minimum.point)
        state = SolverState(minimum.point, point.end_force, guess.units)
        return Found(state, point, minimum.outcome, is_stable(form, point))
    start, begin = _first_point(form, guess, twist)
    normal = None
    if planar:
        normal, axes = plane(scene, begin.tangents)
        begin = begin.flattened(axes)
        form = form.along(axes)
    minimum = find_minimum(form, begin, solver)
    point, outcome, stable = minimum.point, minimum.outcome, minimum.is_stable
    reached = start.reached(form, point)
    # An unchanged scene gives back the same bits. (A straight rod under another pull takes no iteration either.)
    is_start = (outcome.iterations == 0) & (start.change_to(reached) <= SAME_SHAPE * jnp.finfo(reached.nodes.dtype).eps)
    shape = jax.tree.map(lambda old, new: jnp.where(is_start, old, new), start, reached)
    if normal is not None:
        stable &= is_stable(form.along(normal[:, None]), point)
        # Inside a user's own jit the scene could not be checked before.
        status = jnp.where(is_planar(scene, twist), outcome.status, Status.NOT_PLANAR)
        outcome = eqx.tree_at(lambda outcome: outcome.status, outcome, status)
    return Found(SolverState(shape, point.end_force, guess.units), point, outcome, stable)


def _field(scene: Scene, shape: Shape) -> TangentField:
    if isinstance(shape, Curve):
        return HermiteElements.of(scene, shape.s)
    return EdgeTangents.of(scene, len(shape.nodes) - 1)


def _first_point(form: MixedForm, guess: SolverState, twist: Float[Array, ""]) -> tuple[Shape, MixedPoint]:
    """The shape from which to seek the solution, and the same as the unknowns of the mixed form."""
    scene, shape, field = form.scene, guess.shape, form.field
    if isinstance(shape, Polyline):
        problem, start = FiniteDifference.begin(scene, shape, twist)
        return start, eqx.tree_at(lambda point: point.end_force, problem.mixed_point(start), guess.end_force)
    assert isinstance(field, HermiteElements)
    assert isinstance(shape, Curve)
    tangents = shape.turned_to_ends(scene, field.places)
    total_twist = jnp.zeros_like(twist)
    if dead_end_moment(scene) is not None:
        total_twist = twist_under_moment(scene, tangents)
    elif isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp):
        principal = field.total_twist(tangents, scene.start.frame[:, 0], scene.end.frame[:, 0])
        total_twist = nearest_twist(principal, twist, scene.turns)
    end_force = guess.end_force if held_at_both_ends(scene) else jnp.zeros_like(guess.end_force)
    return shape, MixedPoint(tangents, end_force, total_twist)


@_found.def_jvp
def _no_derivative(primals, tangents, *, solver: Solver, planar: bool):
    # Differentiating the iterations would give numbers that look right and are not.
    raise NotImplementedError(
        "the derivative of a solve is not part of this version; "
        "take central differences of solves with a tight tolerance"
    )


# Not eqx.filter_jit: it parts arrays from the rest in Python at each call, 0.08 ms of a warm solve of 0.3 ms.
@functools.partial(jax.jit, static_argnames=("segments", "discretization", "solver", "planar"))
def _solve(
    scene: Scene,
    guess: Guess | Equilibrium | None,
    segments: int,
    discretization: Discretization,
    solver: Solver,
    planar: bool,
) -> Equilibrium:
    state, twist = first_state(scene, guess, segments, discretization)
    return equilibrium(scene, solve_from(scene, state, twist, solver, planar), jnp.ones((), int))


def _in_units(state: SolverState, units: Units) -> SolverState:
    """The unknowns in other units; unchanged to the last bit where the units are the same."""
    shape = state.shape.in_units(state.units.length / units.length, (state.units.origin - units.origin) / units.length)
    return SolverState(shape, state.end_force * (state.units.force / units.force), units)


def warn_if_not_converged(equilibrium: Equilibrium) -> None:
    if is_known(equilibrium.converged) and not np.all(equilibrium.converged):
        warnings.warn(describe(equilibrium), NotConvergedWarning, stacklevel=3)
