"""What the supports of a rod apply to it, in the axes of the scene and in their own."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.model.scene import Scene
from rodjax.solving.result import Equilibrium

# Of a tangent that rises more steeply than this (sine of the angle to the vertical) the level normal is rounding.
STEEP = 1e-6


class Reaction(NamedTuple):
    """What one support applies to the rod.

    - `name`: "start", "clip 0", ..., "end"; `kind`: "clamp", "clip", "sliding clip", "clip with frame", ...
    - `s` [m]: where it holds the rod, `position` (3,) [m]: the centerline there
    - `force` (3,) [N], `moment` (3,) [N m] about `position`, axes of the scene
    - `axes` (3, 3), rows: the tangent of the rod, the level normal to the left of it, and the normal upwards. Where the
      rod is upright, any two normals
    """

    name: str
    kind: str
    s: float
    position: Float[np.ndarray, "3"]
    force: Float[np.ndarray, "3"]
    moment: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]


def reactions(equilibrium: Equilibrium) -> list[Reaction]:
    """Those of both ends and of the clips of one equilibrium, by their arclengths."""
    scene = equilibrium.scene
    s, nodes, tangents = (np.asarray(x) for x in (equilibrium.s, equilibrium.nodes, equilibrium.tangents))
    up = upwards(scene)

    def reaction(name: str, kind: str, node: int, force, moment) -> Reaction:
        axes = np.stack(axes_of(tangents[node], up))
        return Reaction(name, kind, float(s[node]), nodes[node], np.asarray(force), np.asarray(moment), axes)

    # At s = 0 what the support applies is the reverse of the section force.
    kinds = [type(end).__name__.lower() for end in (scene.start, scene.end)]
    found = [reaction("start", kinds[0], 0, -equilibrium.start_force, -equilibrium.start_moment)]
    forces, moments = equilibrium.clip_forces, equilibrium.clip_moments
    for k, clip in enumerate(scene.clips):
        node = int(np.argmin(np.abs(s - float(clip.at))))
        kind = "sliding clip" if clip.sliding else "clip" if clip.frame is None else "clip with frame"
        found.append(reaction(f"clip {k}", kind, node, forces[k], moments[k]))
    return [*found, reaction("end", kinds[1], len(s) - 1, equilibrium.end_force, equilibrium.end_moment)]


def upwards(scene: Scene) -> Float[np.ndarray, "3"]:
    """The direction against gravity; without it that of z."""
    gravity = np.zeros(3) if scene.gravity is None else np.asarray(scene.gravity)
    size = np.linalg.norm(gravity)
    return -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])


def axes_of(
    tangent: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The tangent, the level normal to the left of it, and the normal upwards."""
    level = np.cross(up, tangent)
    size = np.linalg.norm(level)
    if size < STEEP:
        level = np.cross(np.eye(3)[np.argmin(np.abs(tangent))], tangent)
        size = np.linalg.norm(level)
    return tangent, level / size, np.cross(tangent, level / size)
