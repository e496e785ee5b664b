"""Meshes of the rods of a harness, made finer until estimated errors are small."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rodjax.solving.assembly import Poses
from rodjax.solving.first_state import finer_state
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.harness_start import solved_on_meshes
from rodjax.solving.options import Options
from rodjax.solving.refinement import SAFETY, SIZES, Depth, error_by_rtol, next_size, normalized
from rodjax.solving.result_errors import estimated_errors
from rodjax.solving.result_warnings import NotConvergedWarning
from rodjax.warn import warn


def refined(
    result: HarnessEquilibrium, all_options: tuple[Options, ...], rtol: float, strain_limit: Any
) -> HarnessEquilibrium:
    """Solved again with more elements in rods of a structure of which one's estimated error is too large, until none
    is.
    """
    iterations, evaluations = int(result.iterations), int(result.evaluations)
    depths: dict[tuple[int, ...], Depth] = {}
    while bool(result.converged):
        counts, worst, all_defects = finer_meshes(result, rtol, depths)
        options = [dataclasses.replace(old, segments=count) for old, count in zip(all_options, counts, strict=True)]
        finer = {
            number: finer_state(result.rod(number), all_defects[number], new)
            for number, (new, old) in enumerate(zip(options, all_options, strict=True))
            if new.segments != old.segments
        }
        if not finer:
            if worst > rtol:
                warn(
                    f"the estimated error {worst:.1e} (of the shape, or a tenth of that of forces, moments or "
                    f"curvature) of a rod is above rtol = {rtol:g} on the finest mesh",
                    NotConvergedWarning,
                )
            break
        all_options = tuple(options)
        poses = Poses(result.positions, result.frames)
        result = solved_on_meshes(result.harness, poses, all_options, result, strain_limit, finer)
        iterations, evaluations = iterations + int(result.iterations), evaluations + int(result.evaluations)
    counts = jnp.asarray(iterations), jnp.asarray(evaluations)
    return eqx.tree_at(lambda result: (result.iterations, result.evaluations), result, counts)


def finer_meshes(
    result: HarnessEquilibrium, rtol: float, depths: dict[tuple[int, ...], Depth]
) -> tuple[list[int], float, dict[int, Any]]:
    """How many elements rods of one structure need, at least as many as they have; the largest estimated error, of
    several equilibria of those that converged; the defects of each rod. `depths`: how deep contacts press the rods of
    each group in, from mesh to mesh.
    """
    counts, worst, all_defects = result.segments, 0.0, {}
    axis = result.energy.ndim
    for numbers, group in zip(result.members, result.groups, strict=True):
        errors = estimated_errors(group)
        sizes = np.moveaxis(np.asarray(error_by_rtol(errors)), axis, 0)
        converged = np.moveaxis(np.asarray(group.converged), axis, 0)
        error = float(np.max(sizes[converged], initial=0.0))
        worst = max(worst, error)
        depth = depths.setdefault(numbers, Depth())
        penetration = depth.lacking(errors, counts[numbers[0]], np.asarray(group.converged))
        for place, number in enumerate(numbers):
            defects = None if errors.defects is None or axis else errors.defects[place]
            if penetration and defects is not None and errors.depths is not None:
                defects = SAFETY * error / rtol * normalized(defects) + penetration * normalized(errors.depths[place])
            all_defects[number] = defects
            # As many as the neediest: each size of mesh would be a larger program.
            if max(SAFETY * error / rtol, penetration) > 1 and counts[number] < SIZES["hermite"][-1]:
                counts[number] = next_size(counts[number], max(error, penetration * rtol / SAFETY), rtol, "hermite")
    return counts, worst, all_defects
