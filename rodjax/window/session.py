"""Rods in the hand, without a browser: a scene, moves that change it, and what is shown of it."""

import functools
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from rodjax.checks import instance, whole_number
from rodjax.model.harness import Harness
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene, has_potential, is_kept_from_turning
from rodjax.paths.harness_path import unstacked
from rodjax.paths.modes import lowest_mode
from rodjax.programs.answers import compiled_only
from rodjax.solving.description import describe
from rodjax.solving.harness_result import solved_in
from rodjax.solving.options import MAX_SEGMENTS
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT
from rodjax.solving.result_warnings import MeshWarning, NotConvergedWarning, OverstretchedWarning
from rodjax.solving.solve import solve
from rodjax.solving.status import Status
from rodjax.window.bounds import Asked, asked_of, why_not
from rodjax.window.controls import (
    Controls,
    controls_of,
    handles_of,
    rods_of,
    scene_of,
    shared_obstacles,
    sliders_of,
    with_frames,
)
from rodjax.window.following import Followed, followed
from rodjax.window.reading import Figures, Reading, Shown, figures_of, readings_of

SEGMENTS = 32
# A move further than this (by the length, or in radians, or of the way of a slider) is made in pieces: frames that turn
# by more than pi from one solve to the next would lose a turn, and a rod that is thrown may land elsewhere.
PIECE = 0.25
# Of a piece without an equilibrium a half is tried, and so on so many times; and of all of a move so many pieces.
HALVINGS, MOST_PIECES = 5, 64
# A rod snapped where a piece took its nodes further than this part of its length, and so many times as far as the hand
# went: near a fold a move changes the shape by any multiple of itself.
SNAP_WAY, SNAP_RATIO = 0.05, 10.0
# In EI/L^2: below this the softest motion of a rod has next to no stiffness left. Of a strut between pins it is pi^2
# without a load, and 0 as it buckles.
SOFT = 0.5
# Frames recorded, and steps of undo: some 100 MB, and 10.
MOST_RECORDED, MOST_UNDONE = 5000, 500


class Moment(NamedTuple):
    """The rods at one moment: the scene that the controls are of, where these are, and the equilibrium."""

    scene: Any
    controls: Controls
    result: Any  # Shown


class Report(NamedTuple):
    """What a move led to. `readings`: what is shown of each rod; `message`: in words what the user must know, or
    nothing; `moved`: whether the rods followed all of the way; `snapped`; `iterations` of all solves; `milliseconds`
    for all of it.
    """

    readings: tuple[Reading, ...]
    message: str
    moved: bool
    snapped: bool
    iterations: int
    milliseconds: float

    @property
    def reading(self) -> Reading:
        """Of the only rod, or the first one."""
        return self.readings[0]


class Session:
    """A scene or harness whose handles and sliders are moved; its rods follow, each time from where they were.

    **Arguments:**

    - `scene`: `Scene` or `Harness`, with numbers.
    - `segments`: of the mesh of each rod, which stays. Errors are those of that mesh: `rodjax.describe(session.result)`
      tells.
    - `guess`: an earlier equilibrium, whose turns are carried, or `None`.
    - `strain_limit`: a move that would strain a rod by more than this is refused, as far as places that are held
      show; what is above at the start may stay so.
    - `beside`: obstacles that are shown, with the clearances from them, and do not touch the rods, by their names.

    Raises `ValueError` where the scene has no equilibrium to begin with.
    """

    def __init__(
        self,
        scene: Scene | Harness,
        *,
        segments: int = SEGMENTS,
        guess: Shown | None = None,
        strain_limit: float = DEFAULT_STRAIN_LIMIT,
        beside: Mapping[str, Obstacle] | None = None,
    ):
        instance(scene, "scene", (Scene, Harness))
        self.beside = {} if beside is None else dict(beside)
        self.segments = whole_number(segments, "segments", 2, MAX_SEGMENTS)
        self.strain_limit = strain_limit
        # The turns that a scene states are made once, and carried from then on.
        first = self.solved(movable(scene), guess)
        if not bool(first.converged):
            told = " ".join(describe(first).split())
            raise ValueError(f"scene must have an equilibrium to begin with, got none: {told}")
        self._begin_with(without_turns(movable(scene)))
        self.now = self.first = Moment(self.scene, controls_of(self.scene), first)
        self.readings = readings_of(first)
        self.softest: float | None = None
        self.recorded: list[Moment] = []
        self.is_recording = False
        self._undone: list[Moment] = []

    def _begin_with(self, scene: Any) -> None:
        self.scene, self.sliders = scene, sliders_of(scene)
        # What several rods of a harness lie beside is taken in the hand once.
        self.obstacles = shared_obstacles(scene)
        others = {name for names in self.obstacles.values() for name in names[1:]}
        self.handles = {name: handle for name, handle in handles_of(scene).items() if name not in others}
        asked = asked_of(scene)
        self.limits = Asked(
            np.maximum(1 + self.strain_limit, np.asarray(asked.reaches)), tuple(map(np.asarray, asked.depths))
        )
        rods = rods_of(scene).values()
        self.length = max(float(rod.rod.length) for rod in rods)
        # Else a scene may be refused for where its supports are, and is made anew before each move to see that.
        self._is_steady = all(map(is_kept_from_turning, rods))

    @property
    def result(self) -> Any:
        """An `Equilibrium`, or that of a harness."""
        return self.now.result

    @property
    def reading(self) -> Reading:
        """Of the only rod, or the first one."""
        return self.readings[0]

    @functools.cached_property
    def figures(self) -> tuple[Figures, ...]:
        """Of each rod, when they are asked for."""
        return figures_of(self.result, tuple(self.beside.values()))

    def _reached(self, moment: Moment, readings: tuple[Reading, ...], depths: tuple[Any, ...]) -> None:
        self.now, self.readings, self.softest = moment, readings, None
        self.limits = self.limits._replace(depths=depths)
        self.__dict__.pop("figures", None)

    def warm_up(self, is_wanted: Callable[[], bool] = lambda: True) -> None:
        """Compiles what moves need, so that none of them waits for it, as long as it is wanted; of a harness not its
        softest motion, which takes long (`prepare_stability`).
        """
        with compiled_only():
            for prepare in (lambda: self._followed(self.now.controls), lambda: self.figures):
                if is_wanted():
                    prepare()
            if is_wanted() and isinstance(self.scene, Scene):
                self.settle()

    def prepare_stability(self) -> None:
        """Compiles what `settle` needs; moves may be made meanwhile."""
        with compiled_only():
            lowest_mode(self.result)

    # --- moves ---

    def move(self, changes: Mapping[str, Any]) -> Report:
        """Moves handles, (position (3,) [m], frame (3, 3) or `None` where it is not turned) by name, and sliders to
        numbers; the rods follow as far as they can. What makes no sense is told in the report, and nothing moves.
        """
        begin = time.perf_counter()
        changes = {each: value for name, value in changes.items() for each in self.obstacles.get(name, [name])}
        try:
            target = self.now.controls.changed(changes)
        except (TypeError, ValueError) as error:
            return self._report(begin, f"not moved: {error}", moved=False)
        return self._moved_to(target, begin)

    def _followed(self, controls: Controls) -> Followed:
        return followed(self.scene, controls, self.result, self.limits, self.strain_limit, self.segments)

    def _moved_to(self, target: Controls, begin: float) -> Report:
        start = self.now.controls
        distance = start.distance(target, self.sliders, self.length)
        share = 1 / max(1, math.ceil(distance / PIECE))
        least = share / 2**HALVINGS
        reached, message, snapped, iterations, status = 0.0, "", False, 0, Status.CONVERGED
        for _ in range(MOST_PIECES):
            aim = min(reached + share, 1.0)
            controls = start.between(target, aim)
            if not self._is_steady or target.numbers != start.numbers:
                # Numbers of which a scene makes no sense; a program would not say so.
                message = self._refusal(controls)
                if message:
                    message = self._refusal(target) or message
                    break
            found = self._followed(controls)
            outcome = found.outcome
            if not outcome.makes_sense:
                message = self._refusal(target) or self._refusal(controls)
                break
            iterations += int(outcome.iterations)
            if not outcome.converged:
                message = " ".join(describe(found.result).split())
                share /= 2
                if share < least:
                    break
                continue
            message, status = "", int(outcome.status)
            snapped |= self._has_snapped(float(outcome.way), distance * (aim - reached))
            self._reached(Moment(self.scene, controls, found.result), found.readings, outcome.asked.depths)
            reached = aim
            if reached >= 1.0:
                break
        if self.is_recording and reached > 0.0:
            self.recorded.append(self.now)
            self.is_recording = len(self.recorded) < MOST_RECORDED
        is_there = reached >= 1.0
        if not is_there:
            how = "not moved" if reached == 0.0 else f"moved by {100 * reached:.0f} % of the way only"
            message = f"{how}: {message or 'the way is too long'}"
        elif snapped:
            message = "the rod snapped into another shape"
        elif status == Status.OVERSTRETCHED:
            message = f"the rod is strained by more than {100 * self.strain_limit:g} %"
        return self._report(begin, message, is_there, snapped, iterations)

    def _refusal(self, controls: Controls) -> str:
        """What makes no sense about a scene, in words, or nothing."""
        try:
            scene = scene_of(self.scene, controls)
        except ValueError as error:
            return str(error)
        return why_not(scene, jax.tree.map(np.asarray, asked_of(scene)), self.limits) or ""

    def solved(self, scene: Scene | Harness, guess: Any) -> Any:
        """On the mesh of this session; the window tells what warnings would."""
        with warnings.catch_warnings():
            for category in (NotConvergedWarning, OverstretchedWarning, MeshWarning):
                warnings.simplefilter("ignore", category)
            return solve(scene, segments=self.segments, guess=guess, strain_limit=self.strain_limit)

    def _has_snapped(self, way: float, distance: float) -> bool:
        return way / self.length > max(SNAP_WAY, SNAP_RATIO * distance)

    def _report(self, begin: float, message: str, moved: bool, snapped: bool = False, iterations: int = 0) -> Report:
        milliseconds = 1e3 * (time.perf_counter() - begin)
        return Report(self.readings, message, moved, snapped, iterations, milliseconds)

    # --- stability ---

    @property
    def can_settle(self) -> bool:
        """Whether the stiffness of the softest motion can be told."""
        if isinstance(self.scene, Harness):
            return self.scene.has_potential and not self.scene.contact
        return has_potential(self.scene)

    def settle(self) -> float | None:
        """The stiffness of the softest motion [N], as by `rodjax.lowest_mode`; `None` where it cannot be told."""
        if self.can_settle:
            self.softest = float(lowest_mode(self.result).stiffness)
        return self.softest

    @property
    def is_soft(self) -> bool:
        """Whether the rods are about to snap: their softest motion, where that is known, has next to no stiffness left;
        by the rod with the least EI/L^2.
        """
        if self.softest is None:
            return False
        rods = [scene.rod for scene in rods_of(solved_in(self.result)).values()]
        return self.softest < SOFT * min(float(rod.bending_scale) / float(rod.length) ** 2 for rod in rods)

    # --- undo, record ---

    def mark(self) -> None:
        """`undo` comes back to here."""
        if not self._undone or self._undone[-1] is not self.now:
            self._undone = [*self._undone[-MOST_UNDONE + 1 :], self.now]

    def undo(self) -> Report:
        """Back to where the rod was when the hand last took something."""
        begin = time.perf_counter()
        while self._undone and self._undone[-1] is self.now:
            self._undone.pop()
        if not self._undone:
            return self._report(begin, "there is nothing to undo", moved=False)
        self.show(self._undone.pop())
        return self._report(begin, "", moved=True)

    def show(self, moment: Moment) -> tuple[Reading, ...]:
        """Makes an earlier moment the present one."""
        if moment.scene is not self.scene:
            self._begin_with(moment.scene)
        depths = tuple(map(np.asarray, asked_of(scene_of(self.scene, moment.controls)).depths))
        self._reached(moment, readings_of(moment.result), depths)
        return self.readings

    def record(self, on: bool) -> None:
        """Begins a new recording, with the present moment first, or ends it."""
        if on:
            self.recorded = [self.now]
        self.is_recording = on

    def add_recorded(self, steps: Iterable[Any]) -> None:
        """Takes equilibria of the structure of this scene for what was recorded."""
        self.recorded = []
        for one in itertools.islice(steps, MOST_RECORDED):
            scene = without_turns(movable(solved_in(one)))
            self.recorded.append(Moment(scene, controls_of(scene), one))

    def solved_in_turn(self, scenes: Scene | Harness, guess: Any, *, is_path: bool) -> Iterator[Any]:
        """The equilibria of stacked scenes, each from the last one of a path, else all from the guess; without those
        that have none.
        """
        for scene in unstacked(scenes):
            found = self.solved(movable(scene), guess)
            if bool(found.converged):
                guess = found if is_path else guess
                yield found

    def recording(self) -> Any:
        """All recorded equilibria along a leading axis. Raises `ValueError` where there are none."""
        if not self.recorded:
            raise ValueError("nothing is recorded yet")
        return jax.tree.map(lambda *leaves: np.stack(leaves), *(moment.result for moment in self.recorded))


def movable(scene: Any) -> Any:
    """With a frame for each box, which may be turned."""
    if isinstance(scene, Harness):
        return eqx.tree_at(lambda harness: harness.scenes, scene, tuple(map(movable, scene.scenes)))
    if not scene.obstacles:
        return scene
    return eqx.tree_at(lambda scene: scene.obstacles, scene, tuple(map(with_frames, scene.obstacles)))


def without_turns(scene: Any) -> Any:
    if isinstance(scene, Harness):
        return eqx.tree_at(lambda harness: harness.scenes, scene, tuple(map(without_turns, scene.scenes)))
    return eqx.tree_at(lambda scene: scene.turns, scene, None, is_leaf=lambda x: x is None)
