"""What obstacles apply to a rod, stretch by stretch."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.model.summaries import obstacle_name
from rodjax.solving import applied_forces
from rodjax.solving.result import Equilibrium


class Push(NamedTuple):
    """What one obstacle applies to the rod along one stretch on which the two touch.

    - `name`: that of the obstacle, "obstacles[0] (Plane)"
    - `first`, `last` [m]: arclengths of the nodes between which the stretch lies
    - `position` (3,) [m]: the mean of the nodes' centerline there, by the forces on them
    - `force` (3,) [N]: the sum, friction included, in axes of the scene
    """

    name: str
    first: float
    last: float
    position: Float[np.ndarray, "3"]
    force: Float[np.ndarray, "3"]


def pushes(equilibrium: Equilibrium) -> list[Push]:
    """Those of one equilibrium, obstacle by obstacle, each along the rod; none of what has not converged."""
    obstacles = equilibrium.scene.obstacles
    if not obstacles or not bool(equilibrium.converged):
        return []
    s, nodes = np.asarray(equilibrium.s), np.asarray(equilibrium.nodes)
    found = []
    for k, forces in enumerate(np.asarray(applied_forces.contacts(equilibrium).forces)):
        sizes = np.linalg.norm(forces, axis=-1)
        touched = np.flatnonzero(sizes > 0)
        for stretch in np.split(touched, 1 + np.flatnonzero(np.diff(touched) > 1)):
            if stretch.size:
                position = np.average(nodes[stretch], axis=0, weights=sizes[stretch])
                first, last = float(s[stretch[0]]), float(s[stretch[-1]])
                name = obstacle_name(obstacles[k], k)
                found.append(Push(name, first, last, position, forces[stretch].sum(axis=0)))
    return found
