"""The equilibrium of a scene whose ends have known poses."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.checks import instance, is_known, leaf
from rodjax.discretization.first_twist import FirstTwist
from rodjax.model.scene import Scene
from rodjax.notes import note
from rodjax.programs.compilation import compiled
from rodjax.solving.first_state import finer_state, first_state, last_twist
from rodjax.solving.guess import Guess, other_guess
from rodjax.solving.implicit import differentiable, not_differentiated
from rodjax.solving.newton import Find
from rodjax.solving.options import Discretization, Options, Solver, check_single, checked_options, checked_strain_limit
from rodjax.solving.ranges import check_ranges, with_ranges
from rodjax.solving.refinement import SAFETY, SIZES, Depth, error_by_rtol, next_size, normalized
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium, build_result
from rodjax.solving.result_errors import estimated_errors
from rodjax.solving.result_warnings import NotConvergedWarning, warn_if_coarse, warn_of_outcome
from rodjax.solving.search import solve_from
from rodjax.solving.solver_state import SolverState
from rodjax.warn import warn

# A scene that does not converge on so many meshes in turn would not on others, each of which takes seconds to compile.
MOST_FAILURES = 3
# Where no finer mesh has an equilibrium, that of a coarser one is one if the rod lies no deeper than this part of its
# radius within an obstacle between nodes.
MOST_DEPTH_LEFT = 0.05


def solve_scene(
    scene: Scene,
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | None = None,
    planar: bool = False,
    find: Find = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
) -> Equilibrium:
    """The equilibrium of a scene whose ends have known poses: see `rodjax.solving.solve.solve`."""
    instance(scene, "scene", Scene)
    if scene.rod.length.ndim:
        raise ValueError(
            f"scene must be a single scene, got a stack of shape {scene.rod.length.shape}; "
            "solve_path takes scenes one after another, jax.vmap(solve) independent ones"
        )
    fixed_scene, guess = not_differentiated(scene, guess)
    if fixed_scene is not scene:  # it was made of numbers that nobody knew
        check_ranges(fixed_scene)
    check_single(guess)
    options, rtol = checked_options(fixed_scene, segments, rtol, discretization, solver, guess, planar, find)
    strain_limit = checked_strain_limit(strain_limit)
    note(f"solving on {options.segments} segments")
    result = _solve(fixed_scene, *first_state(fixed_scene, guess, options), strain_limit, options)
    if is_known(result.status):
        if guess is None and fixed_scene.obstacles and not result.converged:
            result = _from_another_shape(result, fixed_scene, options, strain_limit)
        result = _looked_at(result) if rtol is None else _refined(result, options, rtol, strain_limit)
    if fixed_scene is not scene:
        result = with_ranges(fixed_scene, result)
    warn_of_outcome(result, strain_limit)
    return result if fixed_scene is scene else differentiable(scene, result)


def _from_another_shape(
    result: Equilibrium, scene: Scene, options: Options, strain_limit: Float[Array, ""] | float
) -> Equilibrium:
    """Found from another shape, where the search from the scene's own found nothing beside its obstacles; else the
    result as it is.
    """
    shape = other_guess(scene, planar=options.planar) if options.find == "minimum" else None
    if shape is None:
        return result
    note("solving again, from another shape")
    other = _solve(scene, *first_state(scene, shape, options), strain_limit, options)
    return _with_effort_of(other, result) if other.converged else result


def _with_effort_of(last: Equilibrium, before: Equilibrium) -> Equilibrium:
    return eqx.tree_at(
        lambda result: (result.iterations, result.evaluations),
        last,
        (_sum(last.iterations, before.iterations), _sum(last.evaluations, before.evaluations)),
    )


def _looked_at(result: Equilibrium) -> Equilibrium:
    """On a mesh that was given."""
    warn_if_coarse(result)
    return result


def _refined(result: Equilibrium, options: Options, rtol: float, strain_limit: Float[Array, ""] | float) -> Equilibrium:
    """Solved again, each time from the last, on meshes of more segments until the estimated error is below `rtol`, and
    contacts press the rod in between its nodes no deeper than at them.
    """
    failures, depth, last = 0, Depth(), None
    while True:
        failures = 0 if result.converged else failures + 1
        errors = estimated_errors(result)
        error = float(error_by_rtol(errors))
        relative_penetration = depth.lacking(errors, options.segments)
        depths = np.zeros(1) if errors.depths is None else np.asarray(errors.depths)
        if result.converged and np.max(depths) < MOST_DEPTH_LEFT:
            last = result, error, options
        is_fine = bool(result.converged) and max(SAFETY * error / rtol, relative_penetration) <= 1
        if is_fine or _is_finest(options) or failures == MOST_FAILURES:
            break
        defects = errors.defects
        if relative_penetration and defects is not None and errors.depths is not None:
            defects = SAFETY * error / rtol * normalized(defects) + relative_penetration * normalized(errors.depths)
        lacking = max(error, relative_penetration * rtol / SAFETY) if result.converged else np.nan
        options = dataclasses.replace(
            options, segments=next_size(options.segments, lacking, rtol, options.discretization)
        )
        note(f"solving on {options.segments} segments, as the estimated error is {error:.1e} for rtol = {rtol:g}")
        finer = _solve(result.scene, finer_state(result, defects, options), last_twist(result), strain_limit, options)
        result = _with_effort_of(finer, result)
    if last is not None:
        # Where no finer mesh had an equilibrium, that of the finest which had one.
        mesh = "the finest mesh" if result is last[0] else "the finest mesh with an equilibrium"
        result, error, options = last
        _warn_if_inaccurate(error, rtol, options, mesh=mesh)
    return result


def _sum(a: Int[Array, ""], b: Int[Array, ""]) -> Int[Array, ""]:
    """Of counts that are known; JAX would compile a program."""
    return leaf(np.asarray(a) + np.asarray(b))


def refined_together(
    solve: Callable[[Options, Equilibrium | None], Equilibrium], options: Options, rtol: float | None
) -> Equilibrium:
    """Many equilibria on one mesh: all solved again until the estimated error of those that converged is below `rtol`,
    and contacts press them in no deeper between nodes than at them.

    `solve` is given the options and what it found with the last ones.
    """
    result, depth = solve(options, None), Depth()
    if rtol is None and is_here(result):
        return _looked_at(result)
    while rtol is not None and is_here(result):
        errors, converged = estimated_errors(result), np.asarray(result.converged)
        sizes = error_by_rtol(errors)
        error = float(np.max(sizes[converged], initial=0.0))
        relative_penetration = depth.lacking(errors, options.segments, converged)
        if max(SAFETY * error / rtol, relative_penetration) <= 1 or _is_finest(options):
            missed = int(np.sum(converged & ~(sizes <= rtol)))
            _warn_if_inaccurate(error, rtol, options, f" in {missed} of {sizes.size} cases")
            break
        lacking = max(error, relative_penetration * rtol / SAFETY)
        options = dataclasses.replace(
            options, segments=next_size(options.segments, lacking, rtol, options.discretization)
        )
        note(f"solving all on {options.segments} segments, as the largest estimated error is {error:.1e}")
        result = solve(options, result)
    return result


def is_here(result: Equilibrium) -> bool:
    """Whether its numbers are known, and this process holds all of them."""
    return is_known(result) and result.s.is_fully_addressable


def _is_finest(options: Options) -> bool:
    return options.segments >= SIZES[options.discretization][-1]


def _warn_if_inaccurate(
    error: float, rtol: float, options: Options, where: str = "", mesh: str = "the finest mesh"
) -> None:
    if not error <= rtol:
        warn(
            f"the estimated error {error:.1e} (of the shape, or a tenth of that of forces, moments or curvature) is "
            f"above rtol = {rtol:g}{where} on {mesh}, of {options.segments} segments",
            NotConvergedWarning,
        )


# Not eqx.filter_jit: it parts arrays from the rest in Python at each call, 0.08 ms of a warm solve of 0.3 ms.
@compiled
def _solve(
    scene: Scene,
    state: SolverState,
    first: FirstTwist,
    strain_limit: Float[Array, ""] | float,
    options: Options,
) -> Equilibrium:
    return build_result(scene, solve_from(scene, state, first, options), jnp.ones((), int), strain_limit)
