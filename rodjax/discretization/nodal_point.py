"""What is unknown of a rod whose nodes have positions of their own, beyond what others have."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Nodal(eqx.Module):
    """The positions of the nodes, the pressure of each obstacle at each node, and by how much the gaps of each obstacle
    are seen larger in the next step.
    """

    places: Float[Array, "n+1 3"]
    pressures: Float[Array, "k n+1"]
    relaxed: Float[Array, "k"]

    def flattened(self, axes: Float[Array, "3 2"]) -> "Nodal":
        """With all nodes in the plane of two axes through the first one."""
        first = self.places[:1]
        places = first + (self.places - first) @ axes @ axes.T
        return Nodal(places, self.pressures, self.relaxed)

    def without(self, normal: Float[Array, "3"]) -> "Nodal":
        """The same, of the plane with this normal."""
        ways = self.places - self.places[:1]
        return Nodal(self.places - (ways @ normal)[:, None] * normal[None], self.pressures, self.relaxed)


class NodalChange(NamedTuple):
    """Of a step."""

    displacements: Float[Array, "n+1 3"]
    pressures: Float[Array, "k n+1"]

    @staticmethod
    def nothing(nodal: Nodal) -> "NodalChange":
        return NodalChange(jnp.zeros_like(nodal.places), jnp.zeros_like(nodal.pressures))
