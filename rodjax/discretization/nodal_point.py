"""The additional unknowns of a rod whose nodes have positions of their own."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Friction(eqx.Module):
    """Tangential forces of f obstacles with friction on each node, and the memory of friction: the positions of the
    nodes in the last equilibrium [m], from which slips along the surface are counted. NaN from rest, where nothing has
    slipped and friction does not act.
    """

    forces: Float[Array, "... f n+1 3"]
    reference: Float[Array, "... n+1 3"]

    @staticmethod
    def from_rest(count: int, nodes: Float[Array, "n+1 3"]) -> "Friction":
        """Of `count` obstacles, at rest."""
        return Friction(jnp.zeros((count, *nodes.shape), nodes.dtype), jnp.full_like(nodes, jnp.nan))


class Nodal(eqx.Module):
    """The positions of the nodes, and the pressure of each obstacle at each node; `relaxed`: added to the gaps of each
    obstacle in the next step; `friction`: `None` where no obstacle has any; `is_wide`: of a search with self-contact,
    which elements have wide wells in it, otherwise `None`.
    """

    positions: Float[Array, "n+1 3"]
    pressures: Float[Array, "k n+1"]
    relaxed: Float[Array, "k"]
    friction: Friction | None = None
    is_wide: Bool[Array, "n"] | None = None

    @property
    def contact_forces(self) -> Float[Array, "r n+1"]:
        """The multipliers of the rows of contacts: pressures, then three components of each tangential force."""
        if self.friction is None:
            return self.pressures
        components = jnp.swapaxes(self.friction.forces, 1, 2).reshape(-1, len(self.positions))
        return jnp.concatenate([self.pressures, components])

    def with_contact_forces(self, positions: Float[Array, "n+1 3"], forces: Float[Array, "r n+1"]) -> "Nodal":
        """With other positions, and multipliers as of `contact_forces`."""
        if self.friction is None:
            return dataclasses.replace(self, positions=positions, pressures=forces)
        k, nodes = self.pressures.shape
        friction = jnp.swapaxes(forces[k:].reshape(-1, 3, nodes), 1, 2)
        friction = dataclasses.replace(self.friction, forces=friction)
        return dataclasses.replace(self, positions=positions, pressures=forces[:k], friction=friction)

    def flattened(self, axes: Float[Array, "3 2"]) -> "Nodal":
        """With all nodes in the plane of two axes through the first one."""
        first = self.positions[:1]
        positions = first + (self.positions - first) @ axes @ axes.T
        return dataclasses.replace(self, positions=positions)

    def without(self, normal: Float[Array, "3"]) -> "Nodal":
        """The same, of the plane with this normal."""
        offsets = self.positions - self.positions[:1]
        return dataclasses.replace(self, positions=self.positions - (offsets @ normal)[:, None] * normal[None])


class NodalChange(NamedTuple):
    """Of a step; `pressures`: of all rows of contacts, as of `Nodal.contact_forces`."""

    displacements: Float[Array, "n+1 3"]
    pressures: Float[Array, "r n+1"]

    @staticmethod
    def nothing(nodal: Nodal) -> "NodalChange":
        return NodalChange(jnp.zeros_like(nodal.positions), jnp.zeros_like(nodal.contact_forces))
