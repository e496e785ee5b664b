"""Paths through critical points: a branch of equilibria followed through folds, and the points where it turns or parts.

A sequence of m scenes is a path: its parameter runs from 0 to m - 1, and a fraction names the scene on the way from one
to the next (numbers linear, frames by the smallest rotation).
"""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.checks import instance, is_known, number_array, positive, whole_number
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.model.summaries import counted, range_text, value_text
from rodjax.paths.branch import BranchTangent, count_of, mode_at
from rodjax.paths.corners import changes_contacts
from rodjax.paths.critical import Changing, differentiable_parameter
from rodjax.paths.harness_modes import HarnessMode
from rodjax.paths.harness_path import are_harnesses, stack_harnesses
from rodjax.paths.harness_place import harness_at
from rodjax.paths.modes import Mode
from rodjax.paths.path import not_followed, stack_scenes
from rodjax.paths.rod_place import scene_at
from rodjax.paths.tracing import DEFAULT_STEPS, BranchEnd, Crossing, StepControl, begun, towards, trace
from rodjax.programs.answers import one_answer
from rodjax.programs.compilation import compiled
from rodjax.solving.guess import Guess
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.implicit import not_differentiated
from rodjax.solving.options import Discretization, Solver
from rodjax.solving.result import Equilibrium
from rodjax.solving.solve import solve

# Where the parameter turns round at a fold, a change of the scene does work in the critical motion: more than this part
# of what it could do. Where another branch crosses it does none.
FOLD = 1e-5
# How far from a critical point a new branch is entered: root mean square of the turn of the tangents [rad].
SWITCH = 0.1

Kind = Literal["fold", "branch", "contact"]
KINDS: dict[Kind, str] = {
    "fold": "The branch turns back",
    "branch": "Another branch crosses",
    "contact": "A contact opens or closes",
}


class CriticalPoint(eqx.Module):
    """An equilibrium at which the stiffness of a motion vanishes, or a contact opens or closes.

    - `parameter`: where in the sequence of scenes, from 0 to m - 1
    - `kind`: `"fold"`, where the branch turns back in the parameter, so that a path beyond it jumps; `"branch"`,
      where another branch of equilibria crosses, as where a straight strut buckles; or `"contact"`, where a contact
      opens or closes, and with that the branch turns back or the index changes
    - `equilibrium`: there, of harnesses a `HarnessEquilibrium`; its scene is that of the parameter
    - `mode`: the critical motion, whose stiffness [N] is what is left of zero, of a harness a `HarnessMode`. Where a
      rod may buckle in all directions at once, one of them; where a contact opens or closes, the one nearest to that
    - `index_before`, `index_after`: the number of motions along which the energy falls, on both sides along the branch
    """

    parameter: Float[Array, ""]
    equilibrium: Any
    mode: Mode | HarnessMode
    kind: Kind = eqx.field(static=True)
    index_before: int = eqx.field(static=True)
    index_after: int = eqx.field(static=True)

    def __str__(self) -> str:
        where = f"{KINDS[self.kind]} at parameter {value_text(self.parameter)}"
        return f"{where}, index {self.index_before} before and {self.index_after} after; {self.mode}"


class Branch(eqx.Module):
    """A sequence of k equilibria on one branch.

    - `parameter` [k]: where in the sequence of scenes, from 0 to m - 1; `equilibria`: with a leading axis of k, of
      harnesses a `HarnessEquilibrium`
    - `index` [k]: the number of motions along which the energy falls; 0 where stable
    - `critical_points`: those between the equilibria, in their order
    - `ended`: why it was followed no further
    """

    parameter: Float[Array, "k"]
    equilibria: Any
    index: Int[Array, "k"]
    critical_points: tuple[CriticalPoint, ...]
    ended: BranchEnd = eqx.field(static=True)

    def __str__(self) -> str:
        """What was followed and why no further, and a line for each critical point."""
        told = f"parameter {range_text(self.parameter)}, index {range_text(self.index)}"
        lines = [f"Branch of {counted(len(self.parameter), 'point')}, {told}: {self.ended.value}"]
        return "\n  ".join(lines + [str(point) for point in self.critical_points])


@one_answer
def follow(
    scenes: Sequence[Scene] | Scene | Sequence[Harness],
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | HarnessEquilibrium | None = None,
    start: float = 0.0,
    direction: int = 1,
    step: float = DEFAULT_STEPS.first,
    max_step: float = DEFAULT_STEPS.longest,
    max_points: int = DEFAULT_STEPS.most,
    progress: bool | None = None,
) -> Branch:
    """One branch of equilibria through a sequence of scenes, stable or not, and through folds: pseudo-arclength.

    A scene may be passed several times, as the branch turns back at folds. It ends where it reaches the first or the
    last scene. Of sliding clips the arclengths are unknowns, and the mesh goes along with them; a branch also ends,
    in ever shorter steps, where the rod slips out of one.

    **Arguments:**

    - `scenes`: at least two `Scene`s of one structure, or one `Scene` whose leaves have a leading axis; or at least two
        `Harness`es of one structure. The end frames may turn by less than pi from one to the next.
    - `segments`, `rtol`, `discretization`, `solver`, `guess`: as for `rodjax.solve`, which finds the first equilibrium,
        a minimum, and its mesh. A guess that is an `Equilibrium` (of harnesses a `HarnessEquilibrium`) is taken for
        that itself, whatever its stability.
    - `start`: the parameter to begin with, from 0 to m - 1; `direction`: 1 where it is to grow from there, -1 to fall.
    - `step`, `max_step`: the first and the longest step along the branch: root mean square of the turn of the tangents
        [rad], of all rods of a harness, and of the change of the parameter as a part of m - 1. Two critical points
        within a step are found where they change the index, or the direction of the parameter.
    - `max_points`: the most equilibria.
    - `progress`: whether a call that takes longer than 2 s says on stderr what it does; `None`: in a terminal or
        notebook.

    Beside obstacles each point at which a contact opens or closes is one of its equilibria: there the branch has a
    corner, and may turn back.

    Eager only. Raises `ValueError` or `TypeError` for arguments that make no sense, for loads without a potential,
    friction and `self_contact`, and for harnesses with obstacles, contact or sliding clips. Keller, "Numerical
    solution of bifurcation and nonlinear eigenvalue problems" (1977).
    """
    stacked = _checked(scenes, "follow")
    steps = _checked_steps(step, max_step, max_points)
    start, way = _checked_start(stacked, start, direction)
    first = _first(stacked, start, segments, rtol, discretization, solver, guess)
    found = trace(stacked, start, first, way, steps)
    return Branch(
        parameter=jnp.stack([station.parameter for station in found.stations]),
        equilibria=_stacked([station.equilibrium for station in found.stations]),
        index=jnp.stack([station.index for station in found.stations]),
        critical_points=tuple(map(_critical_point, found.crossings)),
        ended=found.ended,
    )


@one_answer
def critical_points(
    scenes: Sequence[Scene] | Scene | Sequence[Harness],
    path: Equilibrium | HarnessEquilibrium,
    *,
    step: float = DEFAULT_STEPS.first,
    max_step: float = DEFAULT_STEPS.longest,
) -> tuple[CriticalPoint, ...]:
    """The critical points that a path of `rodjax.solve_path` passed, at each of which it may have jumped.

    The branch of the first equilibrium is followed to its first critical point, and then the one on which the path
    went on at the next scene, to the last of them.

    **Arguments:** `scenes`: those of the path; `path`: what `solve_path` found; `step`, `max_step`: as for `follow`.

    Raises as `follow` does.
    """
    stacked = _checked(scenes, "critical_points")
    instance(path, "path", _result_of(stacked))
    if path.energy.shape != (count_of(stacked),):
        raise ValueError(f"path must have one equilibrium a scene, {count_of(stacked)}, got {path.energy.shape}")
    steps = _checked_steps(step, max_step, DEFAULT_STEPS.most)
    last = count_of(stacked) - 1
    found: list[Crossing] = []
    k = 0
    while k < last:
        here = trace(stacked, float(k), jax.tree.map(lambda leaf, k=k: leaf[k], path), 1.0, steps, only_first=True)
        if not here.crossings:
            break
        found += here.crossings
        k = max(k, int(np.floor(here.crossings[0].station.parameter))) + 1
    return tuple(map(_critical_point, found))


@one_answer
def critical_point(
    scenes: Sequence[Scene] | Scene | Sequence[Harness],
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Guess | Equilibrium | HarnessEquilibrium | None = None,
    start: float = 0.0,
    direction: int = 1,
    step: float = DEFAULT_STEPS.first,
    max_step: float = DEFAULT_STEPS.longest,
) -> CriticalPoint:
    """The first critical point of a branch through a sequence of scenes; its parameter has derivatives by the scenes.

    `jax.grad`, `jacfwd` and `jacrev` of `.parameter` work for every number of the scenes, by the implicit function
    theorem, first derivatives only: at a fold by the change of the residual in the critical motion, at a branch point
    by that of the critical eigenvalue along the branch, where a contact opens or closes by that of its pressure or gap.
    What is left of symmetry is taken for kept: an imperfection, which makes two branches of those that cross, adds
    nothing. Other fields have no derivatives.

    **Arguments:** as for `follow`.

    Eager only, but for derivatives. Raises as `follow` does, and `ValueError` where there is no critical point.
    Werner & Spence, "The computation of symmetry-breaking bifurcation points" (1984); Seydel, "Practical bifurcation
    and stability analysis" (2010).
    """
    stacked = _all_of(scenes)
    (fixed,) = not_differentiated(stacked)
    fixed = _checked(fixed, "critical_point")
    (guess,) = not_differentiated(guess)
    steps = _checked_steps(step, max_step, DEFAULT_STEPS.most)
    start, way = _checked_start(fixed, start, direction)
    first = _first(fixed, start, segments, rtol, discretization, solver, guess)
    found = trace(fixed, start, first, way, steps, only_first=True)
    if not found.crossings:
        parameter = float(found.stations[-1].parameter)
        raise ValueError(
            f"scenes have no critical point on this branch, followed from parameter {start:g} to {parameter:g}: "
            f"{found.ended.value}"
        )
    point = _critical_point(found.crossings[0])
    station, contact = found.crossings[0].station, found.crossings[0].contact
    closes = None if contact is None else Changing(station.closed, jnp.asarray(contact))
    parameter = differentiable_parameter(stacked, point.parameter, point.equilibrium, point.kind == "fold", closes)
    return eqx.tree_at(lambda point: point.parameter, point, parameter)


@one_answer
def switch_branch(
    scenes: Sequence[Scene] | Scene | Sequence[Harness],
    point: CriticalPoint,
    *,
    side: int = 1,
    distance: float = SWITCH,
) -> tuple[Float[Array, ""], Equilibrium | HarnessEquilibrium]:
    """The parameter and the equilibrium beside a critical point on the branch that crosses there, to `follow` it.

    **Arguments:**

    - `scenes`: those in which the point was found.
    - `point`: of kind `"branch"`; at a fold, the two sides of the same branch.
    - `side`: 1 or -1, along the critical motion or against it.
    - `distance`: root mean square of the turn of the tangents from there [rad].

    The parameter is larger than that of the point where the new branch goes forward, else smaller: to follow it away
    from the point give `follow` this `direction`. Where the equilibrium is not found it is flagged as not converged.
    Raises as `follow` does, and `ValueError` where a contact opens or closes on the way.
    """
    stacked = _checked(scenes, "switch_branch")
    instance(point, "point", CriticalPoint)
    distance = float(positive(distance, "distance"))
    if side not in (1, -1):
        raise ValueError(f"side must be 1 or -1, got {side!r}")
    segment, station = begun(stacked, float(point.parameter), point.equilibrium, 1.0)
    along = BranchTangent(station.motion, jnp.zeros_like(station.parameter))
    here = station.parameter, station.equilibrium
    there = towards(stacked, segment, *here, along, side * distance, closed=station.closed)
    if changes_contacts(there):
        raise ValueError(f"distance must be less than {distance:g}: so far from the point a contact opens or closes")
    return there.parameter, there.equilibrium


def _critical_point(crossing: Crossing) -> CriticalPoint:
    station = crossing.station
    return CriticalPoint(
        parameter=station.parameter,
        equilibrium=station.equilibrium,
        mode=mode_at(station.equilibrium, station.stiffness, station.motion),
        kind=_kind(crossing),
        index_before=crossing.index_before,
        index_after=crossing.index_after,
    )


def _kind(crossing: Crossing) -> Kind:
    if crossing.contact is not None:
        return "contact"
    return "fold" if crossing.turns and abs(float(crossing.station.slope)) > FOLD else "branch"


@compiled
def _stacked(results: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *results)


_scene_at = compiled(scene_at)
_harness_at = compiled(harness_at)


def _result_of(scenes: Scene | Harness) -> type:
    return HarnessEquilibrium if isinstance(scenes, Harness) else Equilibrium


def _first(
    scenes: Scene | Harness,
    start: float,
    segments: int | None,
    rtol: float | None,
    discretization: Discretization | None,
    solver: Solver | None,
    guess: Any,
) -> Any:
    """The equilibrium to begin with."""
    is_harness = isinstance(scenes, Harness)
    if guess is not None and is_harness:
        instance(guess, "guess", HarnessEquilibrium)
    is_known_one = isinstance(guess, _result_of(scenes))
    if is_known_one and segments is None and rtol is None and discretization is None:
        return guess
    dtype = (scenes.scenes[0] if is_harness else scenes).rod.length.dtype
    place = jnp.asarray(min(int(start), count_of(scenes) - 2), int), jnp.asarray(start, dtype)
    scene: Any = _harness_at(scenes, *place) if is_harness else _scene_at(scenes, *place)
    return solve(
        scene,
        segments=segments,
        rtol=rtol,
        discretization=discretization,
        solver=solver,
        guess=guess,
        find="equilibrium" if is_known_one else "minimum",
    )


# --- checks ----------------------------------------------------------------------------------------------------------


def _checked(scenes: Any, name: str) -> Any:
    stacked = scenes if isinstance(scenes, Harness) else _all_of(scenes)
    if not is_known(stacked):
        raise ValueError(f"{name} needs scenes of known numbers: call it outside jax.jit and jax.vmap")
    count = count_of(stacked)
    if count < 2:
        raise ValueError(f"scenes must be at least two, between which the parameter runs, got {count}")
    lacking = not_followed(stacked)
    if lacking == "potential":
        raise ValueError(
            "scenes must have a potential: dead moments on a free end, couples along the rod and follower loads "
            "have none"
        )
    if lacking is not None:
        raise ValueError(f"{name} needs scenes without {lacking}")
    return stacked


def _all_of(scenes: Any) -> Any:
    """Stacked, with a leading axis on every leaf; of harnesses or of scenes."""
    return stack_harnesses(scenes) if are_harnesses(scenes) else stack_scenes(scenes)


def _checked_steps(step: Any, max_step: Any, max_points: Any) -> StepControl:
    step, max_step = float(positive(step, "step")), float(positive(max_step, "max_step"))
    if step > max_step:
        raise ValueError(f"step must be at most max_step = {max_step:g}, got {step:g}")
    return StepControl(step, max_step, whole_number(max_points, "max_points", 1, 10**6))


def _checked_start(scenes: Scene | Harness, start: Any, direction: Any) -> tuple[float, float]:
    last = count_of(scenes) - 1
    start = float(number_array(start, "start"))
    if not 0 <= start <= last:
        raise ValueError(f"start must lie in 0 to {last}, the parameters of these scenes, got {start:g}")
    if direction not in (1, -1):
        raise ValueError(f"direction must be 1 or -1, got {direction!r}")
    return start, float(direction)
