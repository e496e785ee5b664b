"""What is to be least in a route."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.checks import leaf, not_negative, positive
from rodjax.geometry.vectors import dot, root
from rodjax.solving.harness_result import Solution, results_of
from rodjax.solving.result import Equilibrium

# A clip counts half where it carries this part of the weight of the cable, where nothing else is said.
CLIP_SHARE = 0.05


class Objective(eqx.Module):
    """The cost of a route, a weighted sum of the terms below; `Limits` are its constraints. Of a harness the sum of
    those of its cables.

    **Arguments:** weights, each per unit of its own.

    - `length`: of the cable [m]; `mass` [kg].
    - `energy`: elastic energy, of bending nearly all of it [J].
    - `end_force`: sum of the magnitudes of the forces at both ends [N].
    - `clips`: how many clips carry a force, counted smoothly: the sum of f^2/(f^2 + f0^2) over clips with the force f.
    - `clip_scale`: f0 [N]; `None`: a twentieth of the cable's weight.

    Raises `ValueError` or `TypeError` where a weight is negative, or all are 0.
    """

    length: Float[Array, ""]
    mass: Float[Array, ""]
    energy: Float[Array, ""]
    end_force: Float[Array, ""]
    clips: Float[Array, ""]
    clip_scale: Float[Array, ""] | None

    def __init__(
        self,
        *,
        length: Any = 0.0,
        mass: Any = 0.0,
        energy: Any = 0.0,
        end_force: Any = 0.0,
        clips: Any = 0.0,
        clip_scale: Any = None,
    ):
        self.length = leaf(not_negative(length, "length"))
        self.mass = leaf(not_negative(mass, "mass"))
        self.energy = leaf(not_negative(energy, "energy"))
        self.end_force = leaf(not_negative(end_force, "end_force"))
        self.clips = leaf(not_negative(clips, "clips"))
        self.clip_scale = None if clip_scale is None else leaf(positive(clip_scale, "clip_scale"))
        weights = (self.length, self.mass, self.energy, self.end_force, self.clips)
        if not any(float(weight) > 0 for weight in weights):
            raise ValueError("Objective must have at least one weight above 0, such as length=1")

    def of(self, equilibrium: Solution) -> Float[Array, ""]:
        costs = [self._of_cable(rod) for rod in results_of(equilibrium).values()]
        return sum(costs[1:], costs[0])

    def _of_cable(self, equilibrium: Equilibrium) -> Float[Array, ""]:
        scene = equilibrium.scene
        mass = scene.rod.mean_mass_per_length * scene.rod.length
        ends = (equilibrium.start_force, equilibrium.end_force)
        cost = self.length * scene.rod.length + self.mass * mass + self.energy * equilibrium.elastic_energy
        cost += self.end_force * sum((root(dot(force, force)) for force in ends), jnp.zeros_like(cost))
        if not scene.clips:
            return cost
        forces = equilibrium.clip_forces
        squared = jnp.sum(forces**2, axis=-1)
        scale = self.clip_scale
        if scale is None:
            gravity = jnp.zeros(3, cost.dtype) if scene.gravity is None else scene.gravity
            scale = CLIP_SHARE * mass * root(dot(gravity, gravity))
        counted = jnp.sum(squared / (squared + scale**2 + jnp.finfo(cost.dtype).tiny))
        return cost + self.clips * counted
