"""Quasistatic paths: a sequence of scenes, each solved from the last, in one compiled scan."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from rodjax.checks import instance
from rodjax.equilibrium import (
    Equilibrium,
    checked_options,
    first_state,
    solve_from,
    warn_if_not_converged,
)
from rodjax.guess import Guess
from rodjax.scene import Scene
from rodjax.solvers.nonlinear_cg import NonlinearCG


def solve_path(
    scenes: Sequence[Scene] | Scene,
    *,
    segments: int | None = None,
    discretization: Literal["finite_difference"] = "finite_difference",
    solver: NonlinearCG | None = None,
    guess: Guess | Equilibrium | None = None,
    progress: bool = False,
) -> Equilibrium:
    """The equilibria of a sequence of scenes, each solved from the last; turns are carried along.

    **Arguments:**

    - `scenes`: `Scene`s of one structure, or one `Scene` whose leaves have a leading axis. The end frames may turn by
      less than pi from one to the next.
    - `progress`: show a progress bar.
    - `segments`, `discretization`, `solver`, `guess`: as for `rodjax.solve`; the guess is for the first scene.

    Returns an `Equilibrium` with a leading axis, one entry a scene.
    """
    stacked = stack_scenes(scenes)
    segments, solver = checked_options(segments, discretization, solver, guess)
    path = _solve_path(stacked, guess, segments, solver, progress)
    warn_if_not_converged(path)
    return path


def stack_scenes(scenes: Sequence[Scene] | Scene) -> Scene:
    """Scenes of one structure as one `Scene` whose leaves have a leading axis."""
    if isinstance(scenes, Scene):
        if scenes.rod.length.ndim != 1:
            raise ValueError(
                "scenes must be a list, or one Scene with a leading axis on every leaf; got a single scene"
            )
        return scenes
    scenes = list(scenes)
    if not scenes:
        raise ValueError("scenes must hold at least one scene, got none")
    for k, scene in enumerate(scenes):
        instance(scene, f"scenes[{k}]", Scene)
        if jax.tree.structure(scene) != jax.tree.structure(scenes[0]):
            raise ValueError(
                f"scenes must all have the same supports and the same kinds of loads, "
                f"got scenes[0] with {_structure(scenes[0])} and scenes[{k}] with {_structure(scene)}"
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)


def _structure(scene: Scene) -> str:
    parts = [f"{type(scene.start).__name__}-{type(scene.end).__name__}"]
    parts += [name for name in ("gravity", "turns") if getattr(scene, name) is not None]
    parts.append(f"{len(scene.point_forces)} point forces")
    return ", ".join(parts)


@eqx.filter_jit
def _solve_path(
    scenes: Scene, guess: Guess | Equilibrium | None, segments: int, solver: NonlinearCG, progress: bool
) -> Equilibrium:
    count = scenes.rod.length.shape[0]
    meter = _progress_meter() if progress else None

    def step(carry, numbered):
        state, twist, bar = carry
        number, scene = numbered
        equilibrium = solve_from(scene, state, twist, solver)
        if meter is not None:
            bar = meter.step(bar, (number + 1) / count)
        return (equilibrium.state, equilibrium.total_twist, bar), equilibrium

    state, twist = first_state(jax.tree.map(lambda leaf: leaf[0], scenes), guess, segments)
    bar = None if meter is None else meter.init()
    (_, _, bar), path = jax.lax.scan(step, (state, twist, bar), (jnp.arange(count), scenes))
    if meter is not None and bar is not None:
        meter.close(bar)
    return path


def _progress_meter():
    # diffrax's meters work under jit; its import takes a second that a solve without one need not wait for.
    from diffrax import TqdmProgressMeter

    return TqdmProgressMeter(refresh_steps=1)
