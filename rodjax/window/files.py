"""What is saved from a window: contents of files, each with a remark where there is one. Nothing is written here."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from rodjax.checks import leaf
from rodjax.io.files import file_content
from rodjax.io.scene_writing import scene_text
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp
from rodjax.solving.harness_result import solved_in
from rodjax.solving.result import Equilibrium
from rodjax.window.controls import rods_of
from rodjax.window.reading import Shown
from rodjax.window.session import Session

# By the length: shapes further apart than this are two.
SAME_SHAPE = 1e-3


def scene_file(session: Session) -> tuple[bytes, str]:
    """The present scene or harness as TOML, with the turns of its rods; a remark where a solve of it ends in another
    shape.
    """
    found = _rods(session.result)
    turns = np.zeros(len(found))
    scene = _with_turns(solved_in(session.result), turns)
    cold = session.solved(scene, None)
    twists = [float(rod.total_twist) - float(other.total_twist) for rod, other in zip(found, _rods(cold), strict=True)]
    states = [rod.turns is not None for rod in rods_of(scene).values()]
    turns = np.where(states, np.round(np.array(twists) / (2 * np.pi)), 0.0)
    if np.any(turns):
        scene = _with_turns(scene, turns)
        cold = session.solved(scene, None)
    content = scene_text(scene, session.segments).encode()
    is_same = bool(cold.converged) and all(map(_is_same, _rods(cold), found))
    return content, "" if is_same else "solved by itself this scene ends in another shape than here"


def _rods(result: Shown) -> list[Equilibrium]:
    return [result] if isinstance(result, Equilibrium) else list(result.values())


def _with_turns(scene: Scene | Harness, turns: Float[np.ndarray, "rods"]) -> Any:
    """With these of the rods that can state some."""
    if isinstance(scene, Harness):
        rods = tuple(_with_turns(rod, turns[k : k + 1]) for k, rod in enumerate(scene.scenes))
        return eqx.tree_at(lambda harness: harness.scenes, scene, rods)
    clamps = isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp)
    if not clamps or any(clip.frame is not None for clip in scene.clips):
        return scene
    number = leaf(np.asarray(turns[0], scene.rod.length.dtype))
    return eqx.tree_at(lambda scene: scene.turns, scene, number, is_leaf=lambda x: x is None)


def _is_same(result: Equilibrium, other: Equilibrium) -> bool:
    distance = np.max(np.linalg.norm(np.asarray(result.nodes) - np.asarray(other.nodes), axis=-1))
    twist = abs(float(result.total_twist) - float(other.total_twist))
    return distance < SAME_SHAPE * float(result.scene.rod.length) and twist < 0.1


def path_file(session: Session) -> tuple[bytes, str]:
    """What was recorded, as `rodjax.save` writes a path."""
    return file_content(session.recording()), ""
