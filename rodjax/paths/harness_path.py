"""Several harnesses of one structure: paths, each solved from the last, and batches, each from its own start."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rodjax.checks import instance, is_known, leaf, namespace, sequence
from rodjax.model.harness import Harness, harness_between
from rodjax.model.scene import has_friction
from rodjax.programs.compilation import compiled
from rodjax.programs.tasks import checked_threads, in_order
from rodjax.solving.harness import solve_harness, warn_of_harness
from rodjax.solving.harness_refinement import finer_meshes
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.options import DEFAULT_RTOL, checked_rtol
from rodjax.solving.refinement import Depth
from rodjax.solving.result_warnings import NotConvergedWarning
from rodjax.warn import warn

# A step is halved at most so often, to a sixty-fourth of it.
MAX_SPLITS = 6


def harness_path(
    harnesses: Sequence[Harness],
    *,
    segments: int | None,
    rtol: float | None,
    guess: HarnessEquilibrium | None,
    **options: Any,
) -> HarnessEquilibrium:
    """See `rodjax.paths.path.solve_path`. All steps are on one mesh, refined until no step needs a finer one."""
    harnesses = _checked(harnesses, "path")

    def steps(first: HarnessEquilibrium, _: Any) -> list[HarnessEquilibrium]:
        found = [first]
        for harness in harnesses[1:]:
            found.append(_step(found[-1], harness, segments=first.segments, **options))
        return found

    first = solve_harness(harnesses[0], segments=segments, rtol=rtol, guess=guess, **options)
    return _on_one_mesh(first, guess, steps, segments, rtol, options)[0]


def harness_batch(
    harnesses: Sequence[Harness],
    *,
    segments: int | list[int] | None,
    rtol: float | None = None,
    guess: HarnessEquilibrium | None,
    threads: int | None = None,
    is_told: bool = True,
    **options: Any,
) -> HarnessEquilibrium:
    """See `rodjax.paths.batch.solve_batch`: by one program, on one mesh, shared by threads; `is_told`: whether
    warnings say what is wrong with the results.
    """
    harnesses, threads = _checked(harnesses, "batch"), checked_threads(threads)
    if guess is not None:
        instance(guess, "guess", HarnessEquilibrium)
        if guess.energy.shape not in ((), (len(harnesses),)):
            raise ValueError(f"guess must be one, or one for each of {len(harnesses)}, got shape {guess.energy.shape}")

    def begin(k: int) -> HarnessEquilibrium | None:
        return guess if guess is None or not guess.energy.ndim else jax.tree.map(lambda leaf: leaf[k], guess)

    def all_of(first: HarnessEquilibrium, coarser: list[HarnessEquilibrium] | None) -> list[HarnessEquilibrium]:
        def solved(k: int) -> HarnessEquilibrium:
            # A step with friction is one from the guess.
            is_free = not any(map(has_friction, harnesses[k].scenes))
            guess = coarser[k] if coarser and is_free and bool(coarser[k].converged) else begin(k)
            return solve_harness(harnesses[k], segments=first.segments, guess=guess, is_told=False, **options)

        others = range(1, len(harnesses))
        if is_known(harnesses, guess):
            parts = [(k,) for k in others]
            return [first, *in_order(solved, parts, threads=threads, unit="harnesses", by_numpy=True)]
        return [first, *map(solved, others)]

    first = solve_harness(harnesses[0], segments=segments, rtol=rtol, guess=begin(0), is_told=False, **options)
    found, all_found = _on_one_mesh(first, begin(0), all_of, segments, rtol, options)
    if is_told and is_known(found.status):
        for result in all_found:
            warn_of_harness(result, options["strain_limit"], is_given=segments is not None)
    return found


def _checked(harnesses: Any, name: str) -> tuple[Harness, ...]:
    harnesses = sequence(harnesses, "scenes", "Harness")
    for k, harness in enumerate(harnesses):
        instance(harness, f"scenes[{k}]", Harness)
        if jax.tree.structure(harness) != jax.tree.structure(harnesses[0]):
            raise ValueError(f"scenes[{k}] must have the structure of scenes[0], to be one of a {name}")
    return harnesses


def are_harnesses(scenes: Any) -> bool:
    """Whether what is given for scenes is a list of harnesses."""
    return isinstance(scenes, (list, tuple)) and len(scenes) > 0 and isinstance(scenes[0], Harness)


def stack_harnesses(harnesses: Sequence[Harness]) -> Harness:
    """Harnesses of one structure as one whose leaves have a leading axis."""
    harnesses = _checked(harnesses, "path")
    xp = namespace(harnesses)
    return jax.tree.map(lambda *leaves: leaf(xp.stack(leaves)), *harnesses)


def unstacked(stack: Any) -> Iterator[Any]:
    """What is stacked along a leading axis, one after another."""
    stack = jax.tree.map(namespace(stack).asarray, stack)
    for k in range(len(jax.tree.leaves(stack)[0])):
        yield jax.tree.map(lambda x, k=k: leaf(x[k]), stack)


def _on_one_mesh(
    first: HarnessEquilibrium,
    begin: HarnessEquilibrium | None,
    solved: Callable[[HarnessEquilibrium, list[HarnessEquilibrium] | None], list[HarnessEquilibrium]],
    segments: int | list[int] | None,
    rtol: float | None,
    options: dict[str, Any],
) -> tuple[HarnessEquilibrium, list[HarnessEquilibrium]]:
    """All equilibria on the mesh of the first, which was sought from `begin`, refined until none needs a finer one,
    unless `segments` are given: stacked, and each.

    `solved`: those on a mesh, of which the first is known, and those on the mesh before.
    """
    tolerance = DEFAULT_RTOL if rtol is None else checked_rtol(rtol)
    depths: dict[tuple[int, ...], Depth] = {}
    each = None
    while True:
        each = solved(first, each)
        found = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
        if segments is not None or not is_known(found.status):
            return found, each
        counts, worst, _ = finer_meshes(found, tolerance, depths)
        if counts == first.segments:
            if worst > tolerance:
                warn(
                    f"the estimated error {worst:.1e} of a rod is above rtol = {tolerance:g} on the finest mesh",
                    NotConvergedWarning,
                )
            return found, each
        guess = begin if any(map(has_friction, first.harness.scenes)) else first
        first = solve_harness(first.harness, segments=counts, guess=guess, **options)


def _step(last: HarnessEquilibrium, harness: Harness, *, strain_limit: Any, **options: Any) -> HarnessEquilibrium:
    """The equilibrium of a harness from the last one, at once or by way of harnesses between the two."""

    def solve(harness: Harness, guess: HarnessEquilibrium) -> HarnessEquilibrium:
        return solve_harness(harness, guess=guess, strain_limit=strain_limit, is_told=False, **options)

    found = solve(harness, last)
    if not is_known(harness, last, found.status):
        return found
    attempts, reached, fraction, share = [found], last, 0.0, 0.5
    while not bool(found.converged) and share >= 0.5**MAX_SPLITS:
        target = min(fraction + share, 1.0)
        here = harness if target == 1 else _between(last.harness, harness, jnp.asarray(target))
        trial = solve(here, reached)
        attempts.append(trial)
        if not bool(trial.converged):
            share /= 2
            continue
        reached, fraction, share = trial, target, 2 * share
        if target == 1:
            found = trial
    if not bool(found.converged) and fraction > 0:
        found = solve(harness, reached)
        attempts.append(found)
    if len(attempts) > 1:
        found = _counted(found, attempts)
    warn_of_harness(found, strain_limit)
    return found


_between = compiled(harness_between)


def _counted(found: HarnessEquilibrium, attempts: list[HarnessEquilibrium]) -> HarnessEquilibrium:
    """With the iterations of all attempts, and how many these were, as `substeps` of the rods."""
    iterations, evaluations = (
        sum(int(getattr(attempt, name)) for attempt in attempts) for name in ("iterations", "evaluations")
    )
    substeps = [jnp.full_like(rod.substeps, len(attempts)) for rod in found.groups]
    return eqx.tree_at(
        lambda result: [result.iterations, result.evaluations, *(rod.substeps for rod in result.groups)],
        found,
        [jnp.asarray(iterations), jnp.asarray(evaluations), *substeps],
    )
