"""What is saved from a window: contents of files, each with a remark where there is one. Nothing is written here."""

import equinox as eqx
import numpy as np

from rodjax.checks import leaf
from rodjax.io.files import file_content
from rodjax.io.scene_writing import scene_text
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp
from rodjax.solving.result import Equilibrium
from rodjax.window.session import Session

# By the length: shapes further apart than this are two.
SAME_SHAPE = 1e-3


def scene_file(session: Session) -> tuple[bytes, str]:
    """The present scene as TOML, with the turns of its rod; a remark where a solve of it ends in another shape."""
    result = session.result
    if not isinstance(result, Equilibrium):
        raise ValueError("a harness cannot be written as a scene file yet; 'Save path' keeps where it was moved")
    scene = _with_turns(result.scene, 0.0) if _can_state_turns(session) else result.scene
    cold = session.solved(scene, None)
    if scene.turns is not None:
        turns = np.round((float(result.total_twist) - float(cold.total_twist)) / (2 * np.pi))
        if turns:
            scene = _with_turns(scene, float(turns))
            cold = session.solved(scene, None)
    content = scene_text(scene, session.segments).encode()
    return content, "" if _is_same(cold, result) else "solved by itself this scene ends in another shape than here"


def _can_state_turns(session: Session) -> bool:
    scene = session.scene
    clamps = isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp)
    return clamps and all(clip.frame is None for clip in scene.clips)


def _with_turns(scene: Scene, turns: float) -> Scene:
    number = leaf(np.asarray(turns, scene.rod.length.dtype))
    return eqx.tree_at(lambda scene: scene.turns, scene, number, is_leaf=lambda x: x is None)


def _is_same(result: Equilibrium, other: Equilibrium) -> bool:
    distance = np.max(np.linalg.norm(np.asarray(result.nodes) - np.asarray(other.nodes), axis=-1))
    twist = abs(float(result.total_twist) - float(other.total_twist))
    return bool(result.converged) and distance < SAME_SHAPE * float(result.scene.rod.length) and twist < 0.1


def path_file(session: Session) -> tuple[bytes, str]:
    """What was recorded, as `rodjax.save` writes a path."""
    return file_content(session.recording()), ""
