"""The cases of one chunk of a sweep, solved: what one thread, process or machine does of it."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from rodjax.io.files import FIELDS
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.paths.batch import solve_batch
from rodjax.solving.harness_result import HarnessEquilibrium, Solution, results_of
from rodjax.solving.refinement import ORDERS, SAFETY, SECTION_FACTOR, SIZES
from rodjax.solving.result import Equilibrium, positions_at
from rodjax.solving.result_errors import estimated_errors
from rodjax.solving.result_warnings import MeshWarning, NotConvergedWarning, OverstretchedWarning
from rodjax.sweeps.cases import CaseScenes
from rodjax.sweeps.manifest import OF_CABLE, Manifest
from rodjax.sweeps.quantities import QUANTITIES
from rodjax.warn import silenced

# Of the whole, and of each rod.
RESULTS = ("status", "converged", "stable", "iterations", "residual", "energy")
OF_ROD = ("elastic_energy", "total_twist", "start_force", "start_moment", "end_force", "end_moment", "nodes")
# Estimated errors of the mesh, each relative as in `Equilibrium`.
ERRORS = ("error_estimate", "force_error", "moment_error", "curvature_error")
DESCRIPTIONS = FIELDS | {
    "case": ("1", "number of the case, from 0"),
    "error_estimate": ("1", "of the mesh: largest distance of a node from the continuum, by the length"),
    "force_error": ("1", "of the mesh: largest error of the force, by the largest force in the rod"),
    "moment_error": ("1", "of the mesh: largest error of the moment, by the largest moment in the rod"),
    "curvature_error": ("1", "of the mesh: largest error of the curvature, by the largest curvature"),
    "segments": ("1", "of the mesh on which the case was solved, of a harness that of each cable"),
    "position": ("m", "of the joint"),
    **{name: (quantity.unit, quantity.description) for name, quantity in QUANTITIES.items()},
}

INTEGERS = ("case", "status", "iterations", "segments")
# Arclengths that differ by less than this part of the length are the same.
SAME_PLACE = 1e-9

Arrays = Mapping[str, np.ndarray]


class Chunk(NamedTuple):
    """What a chunk is solved from: `values` by key of its `cases`, in the scenes that `reader` makes with them."""

    reader: CaseScenes
    manifest: Manifest
    strain_limit: float
    cases: Int[np.ndarray, "k"]
    values: dict[str, Float[np.ndarray, "k ..."]]


def solved_chunk(chunk: Chunk) -> dict[str, np.ndarray]:
    """The datasets of its file. The last chunk is filled up with its last case."""
    manifest, cases = chunk.manifest, chunk.cases
    scenes = chunk.reader.stacked(cases, chunk.values, manifest.chunk)
    settings: Any = dict(segments=manifest.segments, discretization=manifest.discretization)
    settings |= {"strain_limit": chunk.strain_limit}
    # What did not converge or is strained too much is said in the end, for all together; each case has its errors.
    with silenced(NotConvergedWarning, OverstretchedWarning, MeshWarning):
        result = solve_batch(scenes, **settings)
        arrays = {name: values[: len(cases)] for name, values in _values(result, manifest).items()}
        arrays["segments"] = np.full(len(cases), manifest.segments)
        if manifest.rtol:
            arrays = _refined(arrays, scenes, result, manifest, settings)
    return {"case": cases} | arrays | {f"parameters/{key}": values for key, values in chunk.values.items()}


def _values(result: Solution, manifest: Manifest) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(getattr(result, name)) for name in RESULTS}
    rods = results_of(result, OF_CABLE)
    for prefix, rod in rods.items():
        arrays |= {f"{prefix}{name}": np.asarray(getattr(rod, name)) for name in OF_ROD}
        arrays |= {f"{prefix}{name}": np.asarray(QUANTITIES[name].of(rod)) for name in manifest.quantities}
    if isinstance(result, HarnessEquilibrium):
        arrays |= {f"joints/{name}/position": np.asarray(body.position) for name, body in result.joints.items()}
    # Of a harness those of the rod whose are largest.
    each = [_errors(rod) for rod in rods.values()]
    return arrays | {name: functools.reduce(np.maximum, [errors[name] for errors in each]) for name in ERRORS}


def _errors(rod: Equilibrium) -> dict[str, np.ndarray]:
    """All estimated errors at once: each property of a result would compute the estimate anew."""
    errors = estimated_errors(rod)
    shape = np.max(np.linalg.norm(errors.nodes, axis=-1), axis=-1)
    sections = (np.asarray(error) for error in (errors.force, errors.moment, errors.curvature))
    return dict(zip(ERRORS, (shape, *sections), strict=True))


def error_by_rtol(arrays: Arrays) -> Float[np.ndarray, "k"]:
    """What `rtol` is to be kept by, as in `solve`."""
    shape, *sections = (arrays[name] for name in ERRORS)
    return np.maximum(shape, np.max(sections, axis=0) / SECTION_FACTOR)


def _refined(
    arrays: Arrays, scenes: Scene | Harness, result: Solution, manifest: Manifest, settings: dict[str, Any]
) -> dict[str, np.ndarray]:
    """With the cases whose estimated error is above `rtol` solved again, on finer meshes, each from the last one."""
    arrays = {name: values.copy() for name, values in arrays.items()}
    segments, rtol, finest = manifest.segments, manifest.rtol, SIZES[manifest.discretization][-1]
    s = {prefix: np.asarray(rod.s) for prefix, rod in results_of(result, OF_CABLE).items()}
    cases = np.arange(len(arrays["segments"]))
    while True:
        error = error_by_rtol(arrays)[cases]
        which = np.flatnonzero(arrays["converged"][cases] & ~(error <= rtol))
        factor = _growth(error[which], manifest, finest // segments) if len(which) else 1
        if factor < 2:
            return arrays
        segments, cases = factor * segments, cases[which]
        scenes, result = _rows((scenes, result), which)
        settings = settings | {"segments": segments}
        result = solve_batch(scenes, guess=result, **settings)
        found = _values(result, manifest) | {
            f"{prefix}nodes": _nodes_at(rod, s[prefix][cases]) for prefix, rod in results_of(result, OF_CABLE).items()
        }
        found["segments"] = np.full(len(cases), segments)
        # What does not converge on a finer mesh stays as it was, above `rtol`.
        better = np.flatnonzero(found["converged"])
        for name, values in found.items():
            arrays[name][cases[better]] = values[better]
        cases, (scenes, result) = cases[better], _rows((scenes, result), better)


def _rows(stacks: tuple[Any, Any], which: Int[np.ndarray, "k"]) -> tuple[Any, Any]:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[which], stacks)


def _growth(errors: Float[np.ndarray, "k"], manifest: Manifest, most: int) -> int:
    """How many times as fine the next mesh is, 4, 2, or 1 where none may be."""
    lacking = SAFETY * float(np.max(errors)) / manifest.rtol
    wanted = 4 if lacking > 2 ** ORDERS[manifest.discretization] else 2
    return max(factor for factor in (1, 2, 4) if factor <= min(wanted, most))


def _nodes_at(result: Equilibrium, s: Float[np.ndarray, "k n+1"]) -> Float[np.ndarray, "k n+1 3"]:
    """The centerlines at other arclengths, of each case its own: at nodes, unless clips have moved these."""
    every = (result.s.shape[-1] - 1) // (s.shape[-1] - 1)
    if np.allclose(result.s[:, ::every], s, rtol=0, atol=SAME_PLACE * np.max(s)):
        return np.asarray(result.nodes[:, ::every])
    return np.asarray(jax.vmap(positions_at)(result, jnp.asarray(s)))
