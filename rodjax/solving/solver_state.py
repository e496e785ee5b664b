"""Where a solver begins and where it stops: the nondimensional unknowns of a scene."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.nodal_point import Friction, Nodal
from rodjax.discretization.shape import Shape
from rodjax.mechanics.passage import Before
from rodjax.solving.status import Outcome
from rodjax.units import Units


class SolverState(eqx.Module):
    """What a warm start begins from: the nondimensional unknowns, to the last bit, with their units.

    `shape`: a `Polyline` by finite differences, a `Curve` by Hermite elements, a `FramedCurve` by either where frames
    are unknown; `end_force`: the forces of the layout (`discretization.layout`): the force at s = L as each span sees
    it, with the forces of the clips beyond, zero where that ends freely; with obstacles, or loads
    without a potential, as each segment sees it, with those of clips and contacts;
    `arclengths`: those at which the rod passes its sliding clips, as parts of its length, where there are some;
    `clip_moments`: in the continuum, where no mesh gives them; `before`: in scenes with obstacles, where the rod is, or
    was when it last was sound: a solve that begins here is judged by it;
    `pressures`: of each obstacle on each node; `friction`: where obstacles have some, with the memory from which this
    was found: what begins here has that of `as_memory`.
    """

    shape: Shape
    end_force: Float[Array, "... 3 parts"] | Float[Array, "... 3"]  # the second only in files, until format 8
    units: Units
    arclengths: Float[Array, "... slides"] | None = None
    clip_moments: Float[Array, "... clips 3"] | None = None
    before: Before | None = None
    pressures: Float[Array, "... k n+1"] | None = None
    friction: Friction | None = None

    def as_memory(self) -> "SolverState":
        """As what the next step of a path begins from: slips are counted from here."""
        if self.friction is None:
            return self
        nodes = self.units.origin[None] + self.units.length * self.shape.nodes
        return dataclasses.replace(self, friction=dataclasses.replace(self.friction, reference=nodes))

    def point(self, total_twist: Float[Array, ""]) -> Any:
        """The unknowns of the form of one equilibrium."""
        point = self.shape.point(self.end_force, total_twist)
        if self.pressures is None:
            return point
        relaxed = jnp.zeros_like(self.pressures[:, 0])
        return dataclasses.replace(point, nodal=Nodal(self.shape.nodes, self.pressures, relaxed, self.friction))


class Found(eqx.Module):
    """Where a solver stopped, nondimensional."""

    state: SolverState
    point: Any
    outcome: Outcome
    is_stable: Bool[Array, ""]
