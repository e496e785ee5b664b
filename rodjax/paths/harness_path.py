"""Paths of harnesses: each solved from the last."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rodjax.checks import instance, is_known
from rodjax.model.harness import Harness
from rodjax.solving.equilibrium import DEFAULT_RTOL, checked_rtol
from rodjax.solving.harness import finer_meshes, solve_harness
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import NotConvergedWarning
from rodjax.warn import warn


def harness_path(
    harnesses: Sequence[Harness],
    *,
    segments: int | None,
    rtol: float | None,
    guess: HarnessEquilibrium | None,
    **options: Any,
) -> HarnessEquilibrium:
    """See `rodjax.paths.path.solve_path`. All steps are on one mesh, refined until no step needs a finer one."""
    for k, harness in enumerate(harnesses):
        instance(harness, f"scenes[{k}]", Harness)
        if jax.tree.structure(harness) != jax.tree.structure(harnesses[0]):
            raise ValueError(f"scenes[{k}] must have the structure of scenes[0], to be a step of one path")
    tolerance = DEFAULT_RTOL if rtol is None else checked_rtol(rtol)
    first = solve_harness(harnesses[0], segments=segments, rtol=rtol, guess=guess, **options)
    while True:
        steps = [first]
        for harness in harnesses[1:]:
            steps.append(solve_harness(harness, segments=first.segments, guess=steps[-1], **options))
        path = jax.tree.map(lambda *leaves: jnp.stack(leaves), *steps)
        if segments is not None or not is_known(path.status):
            return path
        counts, worst, _ = finer_meshes(path, tolerance)
        if counts == first.segments:
            if worst > tolerance:
                warn(
                    f"the estimated error {worst:.1e} of a rod is above rtol = {tolerance:g} on the finest mesh",
                    NotConvergedWarning,
                )
            return path
        first = solve_harness(harnesses[0], segments=counts, guess=first, **options)
