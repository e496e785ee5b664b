"""How a scene is solved and on what mesh: the options of a solve, checked, with the library's choice for the rest."""

import dataclasses
import functools
import math
import typing
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import instance, is_known, leaf, one_of, positive, whole_number
from rodjax.discretization.cells import segments_for_jumps
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.nodes import LEAST_ELEMENT
from rodjax.discretization.shape import Shape
from rodjax.discretization.turning import HALF_TURN, turn_between_points
from rodjax.model.plane import check_planar
from rodjax.model.scene import Scene, dead_end_moment, has_contacts, has_node_positions, has_potential, needs_frames
from rodjax.solving.guess import Guess
from rodjax.solving.newton import Find, Newton
from rodjax.solving.nonlinear_cg import NonlinearCG
from rodjax.solving.refinement import SIZES, first_size
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_warnings import warn_of_single_precision, warn_of_unknown_mesh

Solver = Newton | NonlinearCG
Discretization = Literal["finite_difference", "hermite"]

DEFAULT_SOLVER = Newton()
DEFAULT_RTOL = 1e-3
# A smaller error than this drowns in the residual of 1e-8 EI/L^2 at which a solve stops.
LEAST_RTOL = 1e-10
LEAST_SEGMENTS = {"finite_difference": 2, "hermite": 1}
# At least so many in the span between two clips, on average, of the first mesh.
SPAN_SEGMENTS = 10
# The same beside obstacles: on fewer a rod that touches takes many iterations, and then finer meshes.
CONTACT_SEGMENTS = 32
# The first mesh leaves so much of a turn [rad] of the rod at rest, or of `turns`, between two of its points.
MOST_FIRST_TURN = math.pi / 4
# Of the only mesh inside jit, where no error can be looked at.
TRACED_SEGMENTS = {"finite_difference": 50, "hermite": 32}
# Beyond this a mesh is taken for a mistake: two nodes of a rod 100 m long would be closer than a millimetre.
MAX_SEGMENTS = 100_000


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["solver"],
    meta_fields=["segments", "discretization", "planar", "find"],
)
@dataclasses.dataclass(frozen=True)
class Options:
    """How a scene is solved, and on what mesh: all that a compiled program depends on besides the scene's structure,
    but for the numbers of the solver, which it is given.
    """

    segments: int
    discretization: Discretization
    solver: Solver
    planar: bool = False
    find: Find = "minimum"


def checked_options(
    scene: Scene,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | None = None,
    planar: bool = False,
    find: Find = "minimum",
) -> tuple[Options, float | None]:
    """The options with the library's choice for `None`, and the tolerance to refine for: `None` where there is none."""
    if scene.contact_loads is not None:
        raise ValueError("scene must be one that was given, got that of a rod which touches others: solve its Harness")
    if scene.rod.length.dtype == np.float32:
        warn_of_single_precision()
    if guess is not None:
        instance(guess, "guess", (Guess, Equilibrium))
    if solver is None:
        solver = DEFAULT_SOLVER
    instance(solver, "solver", typing.get_args(Solver))
    if discretization is None:
        discretization = _discretization(scene, guess, segments, solver)
    one_of(discretization, "discretization", typing.get_args(Discretization))
    if discretization == "hermite" and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton where discretization is 'hermite'")
    of_frames = needs_frames(scene)
    if of_frames and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton for a rod, loads or clips that need frames along the rod")
    if scene.clips:
        if of_frames and discretization == "finite_difference":
            raise ValueError(
                "discretization must be 'hermite' for clips on a rod, or with loads or clips, that need frames along "
                "the rod"
            )
        if isinstance(solver, NonlinearCG):
            raise ValueError("solver must be a Newton for a scene with clips")
    if of_frames and not has_potential(scene) and discretization == "finite_difference":
        raise ValueError(
            "discretization must be 'hermite' under couples along the rod, forces that follow it, and moments on a rod "
            "that needs frames"
        )
    if scene.obstacles and discretization == "finite_difference":
        raise ValueError("discretization must be 'hermite' for a scene with obstacles")
    if scene.self_contact and discretization == "finite_difference":
        raise ValueError("discretization must be 'hermite' for a scene with self_contact")
    if scene.potentials and discretization == "finite_difference":
        raise ValueError("discretization must be 'hermite' for a scene with potentials")
    if dead_end_moment(scene) is not None and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton for a dead moment on a free end, which no energy is minimal under")
    if rtol is not None:
        if segments is not None:
            raise ValueError(f"segments must be None where rtol is given, got segments={segments!r} and rtol={rtol!r}")
        rtol = checked_rtol(rtol)
    elif segments is None:
        rtol = DEFAULT_RTOL
    # A node for each clip, and where the mesh is chosen a few of them in each span.
    least = max(LEAST_SEGMENTS[discretization], len(scene.clips) + 1)
    if of_frames and discretization == "hermite":
        least = _least_for_jumps(scene, segments, least)
    may_turn = of_frames and is_known(scene)
    if segments is not None:
        segments = whole_number(segments, "segments", least, MAX_SEGMENTS)
        if may_turn:
            _check_turning(scene, segments, discretization)
    elif isinstance(guess, Equilibrium):
        segments = max(guess.s.shape[-1] - 1, least)
        if may_turn and _turn(scene, segments, discretization) >= HALF_TURN:
            segments = _size_for_turning(scene, discretization)
    elif rtol is not None and is_known(scene, guess):
        wanted = SPAN_SEGMENTS * (len(scene.clips) + 1) if scene.clips else 0
        if has_contacts(scene):
            wanted = max(wanted, CONTACT_SEGMENTS)
        if may_turn:
            wanted = max(wanted, _size_for_turning(scene, discretization))
        segments = first_size(rtol, discretization, max(wanted, least))
    else:
        segments = TRACED_SEGMENTS[discretization]
        warn_of_unknown_mesh(segments)
    one_of(find, "find", typing.get_args(Find))
    if find == "equilibrium" and isinstance(solver, NonlinearCG):
        raise ValueError("solver must be a Newton where find is 'equilibrium': NonlinearCG only goes down")
    instance(planar, "planar", bool)
    if planar:
        if isinstance(solver, NonlinearCG):
            raise ValueError("solver must be a Newton where planar is True")
        check_planar(scene, 0.0 if guess is None else guess.total_twist)
    return Options(segments, discretization, solver, planar, find), rtol


def _least_for_jumps(scene: Scene, segments: int | None, least: int) -> int:
    """The fewest elements, or more where a rod whose numbers are known has `Steps` near to one another."""
    needed = segments_for_jumps(scene) if is_known(scene) else None
    if needed is None:
        return least
    count, gap = int(np.max(needed[0])), float(np.min(needed[1]))
    if count <= (SIZES["hermite"][-1] if segments is None else segments):
        return max(least, count)
    where = f"jumps of Steps and of loads must have an element each, at least {LEAST_ELEMENT:g} of a segment long"
    given = f"segments = {segments}" if segments is not None else f"the finest mesh of {SIZES['hermite'][-1]} segments"
    raise ValueError(
        f"{where}: got jumps as near as {gap:.3g} of the length to one another or to an end, a load or a clip, which "
        f"needs segments = {count} or more, and {given}"
    )


def _turn(scene: Scene, segments: int, discretization: Discretization) -> float:
    turn = turn_between_points(scene, segments, discretization)
    return 0.0 if turn is None else float(np.max(turn))


def _check_turning(scene: Scene, segments: int, discretization: Discretization) -> None:
    """Raises where the frames on a mesh of so many segments could not tell how far the rod turns."""
    turn = _turn(scene, segments, discretization)
    if turn >= HALF_TURN:
        raise ValueError(
            f"segments must be some {math.ceil(1.1 * segments * turn / HALF_TURN)} or more, as the rod at rest, or by "
            f"its turns, turns by {turn / (2 * math.pi):.2g} of a whole turn between neighbouring frames (two for each "
            f"element), which tell less than half of one: got a mesh of {segments}"
        )


def _size_for_turning(scene: Scene, discretization: Discretization) -> int:
    """The first mesh of a rod that turns: see `MOST_FIRST_TURN`."""
    sizes = SIZES[discretization]
    size = next((size for size in sizes if _turn(scene, size, discretization) < MOST_FIRST_TURN), sizes[-1])
    _check_turning(scene, size, discretization)
    return size


def check_single(guess: Guess | Equilibrium | None) -> None:
    if isinstance(guess, Equilibrium) and guess.s.ndim > 1:
        raise ValueError(
            f"guess must be a single equilibrium, got a stack of shape {guess.s.shape[:-1]}; take one of it, such as "
            "jax.tree.map(lambda leaf: leaf[-1], guess)"
        )


def checked_rtol(rtol: Any) -> float:
    value = float(positive(rtol, "rtol"))
    if not LEAST_RTOL <= value <= 1.0:
        raise ValueError(f"rtol must lie in {LEAST_RTOL:g} to 1, got {rtol!r}")
    return value


def checked_strain_limit(strain_limit: Any) -> Float[Array, ""] | float:
    """The largest |axial strain| that is allowed: infinite for `None`."""
    if strain_limit is None:
        return math.inf
    if isinstance(strain_limit, float) and strain_limit > 0:
        return float(strain_limit)
    value = positive(strain_limit, "strain_limit")
    return float(value) if is_known(value) else jax.lax.stop_gradient(leaf(value))


def _discretization(
    scene: Scene, guess: Guess | Equilibrium | None, segments: int | None, solver: Solver
) -> Discretization:
    """The one to take where none is asked for."""
    if isinstance(solver, NonlinearCG):
        return "finite_difference"
    if has_node_positions(scene) or (scene.clips and needs_frames(scene)):
        return "hermite"
    if segments is None and isinstance(guess, Equilibrium) and _is_by_differences(guess.state.shape):
        return "finite_difference"
    return "hermite"


def _is_by_differences(shape: Shape) -> bool:
    return isinstance(shape, Polyline) or (isinstance(shape, FramedCurve) and shape.is_of_joints)
