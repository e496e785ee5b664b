"""A rod in the hand, without a browser: a scene, moves that change it, and what is shown of it."""

import math
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from rodjax.checks import instance, whole_number
from rodjax.model.scene import Scene, has_potential, slides
from rodjax.paths.modes import lowest_mode
from rodjax.programs.answers import numpy_first
from rodjax.solving.equilibrium import MAX_SEGMENTS
from rodjax.solving.result import (
    DEFAULT_STRAIN_LIMIT,
    Equilibrium,
    MeshWarning,
    NotConvergedWarning,
    OverstretchedWarning,
    describe,
)
from rodjax.solving.solve import solve
from rodjax.solving.status import Status
from rodjax.window.bounds import depths, out_of_reach, reaches, within_obstacle
from rodjax.window.controls import Controls, SceneMaker, controls_of, handles_of, sliders_of, with_frames
from rodjax.window.reading import Reading, reading_of

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
    """The rod at one moment: the scene that its controls are of, where these are, and its equilibrium."""

    scene: Scene
    controls: Controls
    result: Equilibrium


class Report(NamedTuple):
    """What a move led to. `reading`: what is shown; `message`: in words what the user must know, or nothing; `moved`:
    whether the rod followed all of the way; `snapped`; `iterations` of all solves; `milliseconds` for all of it.
    """

    reading: Reading
    message: str
    moved: bool
    snapped: bool
    iterations: int
    milliseconds: float


class Session:
    """One scene whose handles and sliders are moved; its rod follows, each time from where it was.

    **Arguments:**

    - `scene`: `Scene`, with numbers.
    - `segments`: of the mesh, which stays. Errors are those of that mesh: `rodjax.describe(session.result)` tells.
    - `guess`: an earlier `Equilibrium`, whose turns are carried, or `None`.
    - `strain_limit`: a move that would strain the rod by more than this is refused, as far as places that are held
      show; what is above at the start may stay so.

    Raises `ValueError` where the scene has no equilibrium to begin with.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        segments: int = SEGMENTS,
        guess: Equilibrium | None = None,
        strain_limit: float = DEFAULT_STRAIN_LIMIT,
    ):
        instance(scene, "scene", Scene)
        self.segments = whole_number(segments, "segments", 2, MAX_SEGMENTS)
        self.strain_limit = strain_limit
        # The turns that a scene states are made once, and carried from then on.
        first = self.solved(_movable(scene), guess)
        if not bool(first.converged):
            told = " ".join(describe(first).split())
            raise ValueError(f"scene must have an equilibrium to begin with, got none: {told}")
        self._begin_with(_without_turns(_movable(scene)))
        self.now = self.first = Moment(self.scene, controls_of(self.scene), first)
        self.reading = reading_of(first)
        self.depths = depths(self.scene)
        self.softest: float | None = None
        self.recorded: list[Moment] = []
        self.is_recording = False
        self._undone: list[Moment] = []

    def _begin_with(self, scene: Scene) -> None:
        self.scene, self.scene_at = scene, SceneMaker(scene)
        self.handles, self.sliders = handles_of(scene), sliders_of(scene)
        self.reach_limits = [max(1 + self.strain_limit, reach) for reach in reaches(scene)]

    @property
    def result(self) -> Equilibrium:
        return self.now.result

    def warm_up(self, is_wanted: Callable[[], bool] = lambda: True) -> None:
        """Compiles what moves need, so that none of them waits for it, as long as it is wanted."""
        # Two answers of each kind come from NumPy code; for the third all are compiled side by side.
        for _ in range(3):
            if not is_wanted():
                return
            scene = self.scene_at(self.now.controls)
            reading_of(self.solved(scene, self.result))
            self._check(scene)
        with numpy_first(False):  # later, it would be compiled in the middle of a move
            self.settle()

    # --- moves ---

    def move(self, changes: Mapping[str, Any]) -> Report:
        """Moves handles, (position (3,) [m], frame (3, 3) or `None` where it is not turned) by name, and sliders to
        numbers; the rod follows as far as it can. What makes no sense is told in the report, and nothing moves.
        """
        begin = time.perf_counter()
        try:
            target = self.now.controls.changed(changes)
        except (TypeError, ValueError) as error:
            return self._report(begin, f"not moved: {error}", moved=False)
        return self._moved_to(target, begin)

    def _moved_to(self, target: Controls, begin: float) -> Report:
        start = self.now.controls
        length = float(self.scene.rod.length)
        distance = start.distance(target, self.sliders, length)
        share = 1 / max(1, math.ceil(distance / PIECE))
        least = share / 2**HALVINGS
        reached, message, snapped, iterations = 0.0, "", False, 0
        for _ in range(MOST_PIECES):
            aim = min(reached + share, 1.0)
            controls = start.between(target, aim)
            try:
                scene = self.scene_at(controls)
                found_depths = self._check(scene)
            except ValueError as error:
                message = self._why_not(target) or str(error)
                break
            result = self.solved(scene, self.result)
            iterations += int(result.iterations)
            if not bool(result.converged):
                message = " ".join(describe(result).split())
                share /= 2
                if share < least:
                    break
                continue
            message = ""
            snapped |= self._has_snapped(result, distance * (aim - reached))
            self.now, self.depths, reached = Moment(self.scene, controls, result), found_depths, aim
            if reached >= 1.0:
                break
        if self.is_recording and reached > 0.0:
            self.recorded.append(self.now)
            self.is_recording = len(self.recorded) < MOST_RECORDED
        if reached > 0.0:
            self.softest = None
            self.reading = reading_of(self.result)
        is_there = reached >= 1.0
        if not is_there:
            how = "not moved" if reached == 0.0 else f"moved by {100 * reached:.0f} % of the way only"
            message = f"{how}: {message or 'the way is too long'}"
        elif snapped:
            message = "the rod snapped into another shape"
        elif int(self.result.status) == Status.OVERSTRETCHED:
            message = f"the rod is strained by more than {100 * self.strain_limit:g} %"
        return self._report(begin, message, is_there, snapped, iterations)

    def _why_not(self, target: Controls) -> str | None:
        """What makes no sense about where the hand went: it says more than what does on the way there."""
        try:
            self._check(self.scene_at(target))
        except ValueError as error:
            return str(error)
        return None

    def _check(self, scene: Scene) -> np.ndarray:
        """Raises `ValueError` where a scene asks of its rod what no rod can do; returns the depths of its supports."""
        found = out_of_reach(scene, self.reach_limits)
        now = depths(scene)
        found = found or within_obstacle(scene, self.depths, now)
        if found:
            raise ValueError(found)
        return now

    def solved(self, scene: Scene, guess: Equilibrium | None) -> Equilibrium:
        """As every move of this session is solved."""
        with warnings.catch_warnings():
            # The window tells these.
            for category in (NotConvergedWarning, OverstretchedWarning, MeshWarning):
                warnings.simplefilter("ignore", category)
            return solve(scene, segments=self.segments, guess=guess, strain_limit=self.strain_limit)

    def _has_snapped(self, result: Equilibrium, distance: float) -> bool:
        way = np.asarray(result.nodes) - np.asarray(self.result.nodes)
        way = float(np.max(np.linalg.norm(way, axis=-1))) / float(self.scene.rod.length)
        return way > max(SNAP_WAY, SNAP_RATIO * distance)

    def _report(self, begin: float, message: str, moved: bool, snapped: bool = False, iterations: int = 0) -> Report:
        milliseconds = 1e3 * (time.perf_counter() - begin)
        return Report(self.reading, message, moved, snapped, iterations, milliseconds)

    # --- stability ---

    @property
    def can_settle(self) -> bool:
        """Whether the stiffness of the softest motion can be told."""
        return has_potential(self.scene) and not slides(self.scene)

    def settle(self) -> float | None:
        """The stiffness of the softest motion [N], as by `rodjax.lowest_mode`; `None` where it cannot be told."""
        if self.can_settle:
            self.softest = float(lowest_mode(self.result).stiffness)
        return self.softest

    @property
    def is_soft(self) -> bool:
        """Whether the rod is about to snap: its softest motion, where that is known, has next to no stiffness left."""
        if self.softest is None:
            return False
        rod = self.result.scene.rod
        return self.softest * float(rod.length) ** 2 < SOFT * float(rod.bending_scale)

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

    def show(self, moment: Moment) -> Reading:
        """Makes an earlier moment the present one."""
        if moment.scene is not self.scene:
            self._begin_with(moment.scene)
        self.now, self.softest = moment, None
        self.depths = depths(self.scene_at(moment.controls))
        self.reading = reading_of(moment.result)
        return self.reading

    def record(self, on: bool) -> None:
        """Begins a new recording, with the present moment first, or ends it."""
        if on:
            self.recorded = [self.now]
        self.is_recording = on

    def add_recorded(self, path: Equilibrium) -> None:
        """Takes a path, or a batch, of equilibria of the structure of this scene for what was recorded."""
        self.recorded = []
        for k in range(min(path.s.shape[0], MOST_RECORDED)):
            one = jax.tree.map(lambda leaf, k=k: leaf[k], path)
            scene = _without_turns(_movable(one.scene))
            self.recorded.append(Moment(scene, controls_of(scene), one))

    def recording(self) -> Equilibrium:
        """All recorded equilibria along a leading axis. Raises `ValueError` where there are none."""
        if not self.recorded:
            raise ValueError("nothing is recorded yet")
        return jax.tree.map(lambda *leaves: np.stack(leaves), *(moment.result for moment in self.recorded))


def _movable(scene: Scene) -> Scene:
    obstacles = tuple(map(with_frames, scene.obstacles))
    return eqx.tree_at(lambda scene: scene.obstacles, scene, obstacles) if obstacles else scene


def _without_turns(scene: Scene) -> Scene:
    return eqx.tree_at(lambda scene: scene.turns, scene, None, is_leaf=lambda x: x is None)
