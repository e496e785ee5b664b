"""One move as one program: from where the controls are to the equilibrium there, and to what is shown of it."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import Numbers
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.programs.compilation import compiled
from rodjax.solving.newton import Newton
from rodjax.solving.result import Equilibrium
from rodjax.solving.solve import solve
from rodjax.window.bounds import Asked, asked_of, makes_sense
from rodjax.window.controls import Controls, scene_of
from rodjax.window.reading import Groups, Reading, Shown, of_rods, readings_in_program


class Outcome(NamedTuple):
    """`makes_sense`: whether the scene asks what rods can do; else nothing was solved. `way` [m]: the largest
    displacement of a node.
    """

    asked: Asked
    makes_sense: Bool[Numbers, ""]
    converged: Bool[Numbers, ""]
    status: Int[Numbers, ""]
    iterations: Int[Numbers, ""]
    way: Float[Numbers, ""]


class Followed(NamedTuple):
    """Where the rods followed to, what is shown of each, and how that came about."""

    result: Shown
    readings: tuple[Reading, ...]
    outcome: Outcome


def followed(
    scene: Scene | Harness, controls: Controls, guess: Any, limits: Asked, strain_limit: float, segments: int
) -> Followed:
    """The rods of a scene at controls, from where they were."""
    result, groups, outcome = _followed(scene, controls, guess, limits, strain_limit, segments=segments)
    return Followed(result, of_rods(groups, result), jax.tree.map(np.asarray, outcome))


@functools.partial(compiled, static_argnames=("segments",))
def _followed(
    scene: Any, controls: Controls, guess: Any, limits: Asked, strain_limit: Any, segments: int
) -> tuple[Shown, Groups, Outcome]:
    scene = scene_of(scene, controls)
    asked = asked_of(scene)
    is_possible = makes_sense(asked, limits)
    # What no rod can do is not tried.
    most = jnp.where(is_possible, Newton().max_iterations, 0)
    solver = eqx.tree_at(lambda solver: solver.max_iterations, Newton(), most)
    result = solve(scene, segments=segments, guess=guess, strain_limit=strain_limit, solver=solver)
    way = jnp.max(jnp.array([jnp.max(_distances(*both)) for both in zip(_nodes(result), _nodes(guess), strict=True)]))
    outcome = Outcome(asked, is_possible, result.converged, result.status, result.iterations, way)
    return result, readings_in_program(result), outcome


def _nodes(shown: Shown) -> list[Float[Array, "... n+1 3"]]:
    return [group.nodes for group in ((shown,) if isinstance(shown, Equilibrium) else shown.groups)]


def _distances(nodes: Float[Array, "... n+1 3"], before: Float[Array, "... n+1 3"]) -> Float[Array, "... n+1"]:
    return jnp.sqrt(jnp.sum((nodes - before) ** 2, axis=-1))
