"""solve(): the equilibrium of a scene or a harness."""

from collections.abc import Mapping
from typing import Any, overload

from rodjax.checks import instance
from rodjax.model.harness import Harness, has_movable_ends
from rodjax.model.scene import Scene
from rodjax.programs.answers import one_answer
from rodjax.solving.equilibrium import solve_scene
from rodjax.solving.guess import Guess
from rodjax.solving.harness import solve_harness, solve_movable
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.newton import Find
from rodjax.solving.options import Discretization, Solver
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium


@overload
def solve(
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
    progress: bool | None = None,
) -> Equilibrium: ...


@overload
def solve(
    scene: Harness,
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: HarnessEquilibrium | Mapping[str, Guess] | None = None,
    planar: bool = False,
    find: Find = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
    progress: bool | None = None,
) -> HarnessEquilibrium: ...


@one_answer
def solve(
    scene: Scene | Harness,
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | HarnessEquilibrium | Mapping[str, Guess] | None = None,
    planar: bool = False,
    find: Find = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
    progress: bool | None = None,
) -> Equilibrium | HarnessEquilibrium:
    """The equilibrium of a scene, or of a harness.

    Compiled once for each structure of scene, solver and mesh; works inside `jax.jit` and `jax.vmap`.

    **Arguments:**

    - `scene`: `Scene`; or `Harness`, on elements, by `Newton` and not `planar`: `segments` are those of each rod, and
        for `rtol` rods of one structure get as many as their estimated errors need, with their ends held.
    - `segments`: of a mesh of equal ones (that of a guess with as many is kept). `None`: as many as `rtol` needs. The
        errors on a given mesh are not estimated unless asked for (`error_estimate`, `describe`); outside `jit` a
        `MeshWarning` is given where a segment turns by so much that it is far too long. Refused (in `jit`:
        `OUT_OF_RANGE`) are meshes too coarse to tell how often a coiled or twisted rod turns at rest, or by `turns`.
    - `rtol`: the relative error of the shape that is wanted; `None` for 1e-3. Segments are added, elements where they
        are needed, until the estimated `error_estimate` is below it and `force_error`, `moment_error` and
        `curvature_error` below ten times it: by default 0.1 % of the length, and 1 % of the largest force, moment and
        curvature. The mesh of a guess that is an `Equilibrium` comes first. Where the numbers of the scene are not
        known, as inside `jit`, `vmap` and `grad`, it is that of the guess or one of 32 elements whatever `rtol`, of
        which a `MeshWarning` tells once; `error_estimate` says what that gives.
    - `discretization`: `"hermite"`, elements of fourth order in 1/segments, or `"finite_difference"`, of second order,
        not beside obstacles, and not with clips or under loads without a potential where frames are needed. `None`:
        that of a guess whose mesh is kept, `"finite_difference"` for `NonlinearCG`, else `"hermite"`.
    - `solver`: `Newton` or `NonlinearCG`; `None` for `Newton()`.
    - `guess`: an earlier `Equilibrium` (a warm start, which carries turns), a `Guess`, or `None`: a shape made from the
        supports and gravity. Where no minimum is found from that beside obstacles, one is sought from another shape: an
        arc that hangs between the supports (not if `planar`), a straight line where an end is free and the rod curved
        at rest. Not in `jit`, `vmap`, paths and batches. Of a harness an earlier equilibrium, or `{name: Guess}` for
        some of its cables: joints begin where these end.
    - `planar`: seek the rod in the plane in which supports and loads lie, with half of the unknowns. `stable` speaks of
        motions out of the plane too.
    - `find`: `"minimum"`: an equilibrium where the energy has negative curvature, such as a planar shape that is
        unstable out of its plane, is left along that motion, always to the same side. `"equilibrium"`: what the steps
        of Newton's method lead to is kept, whatever its stability; `Equilibrium.index` counts the motions that lower
        the energy. Where poses are unknown only `max_rotation` shortens these steps.
    - `strain_limit`: largest |axial strain|, of either sign, without a warning; `None`: no limit. An equilibrium beyond
        it has the status `OVERSTRETCHED`, and outside `jit` an `OverstretchedWarning` says where.
    - `progress`: whether a call that takes longer than 2 s says on stderr what it does; `None`: in a terminal or
        notebook.

    A scene with an end that is a `Hinge`, `Slider` or `Spring` is solved as a harness of one rod, whose result is that
    of the rod: an `Equilibrium` with clamps at the poses that were found.

    Friction of obstacles has a memory (`rodjax.solve_path`): where the guess is an `Equilibrium`, the solve is one step
    from there, and slips are counted from its nodes, in global axes, on another mesh from the same places of the rod.
    Else it is from rest, as if all obstacles were without friction; but a rod with two free ends and no clip lies where
    its guess is, and slips from there. `stable` and `index` speak of motions with the
    pressures that bound friction held.

    Where the solve does not converge the result says so, and outside `jit` a `NotConvergedWarning` gives the reason.
    Raises `ValueError` or `TypeError` for invalid arguments.
    """
    instance(scene, "scene", (Scene, Harness))
    options: dict[str, Any] = {
        "segments": segments,
        "rtol": rtol,
        "discretization": discretization,
        "solver": solver,
        "guess": guess,
        "planar": planar,
        "find": find,
        "strain_limit": strain_limit,
    }
    if isinstance(scene, Harness):
        return solve_harness(scene, **options)
    if has_movable_ends(scene):
        return solve_movable(scene, **options)
    return solve_scene(scene, **options)
