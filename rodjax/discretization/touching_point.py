"""What is unknown of a rod beside obstacles beyond what others have."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

# Contact points within an element, as parts of it; the others are its nodes. None for now: with (0.5,) the rod lies 5
# to 16 times less deep within obstacles between its nodes, but a pressure that is eliminated by itself costs the square
# of its stiffness in digits where it pushes on two nodes (`docs/design.md`, "Contact").
PARTS: tuple[float, ...] = ()


def contact_points(segments: int) -> int:
    """The nodes, then those in elements."""
    return segments + 1 + len(PARTS) * segments


class Touching(eqx.Module):
    """What a point has in a scene with obstacles beside that of others: the positions of the nodes, the pressure of
    each obstacle at each contact point, and by how much the gaps of each obstacle are seen larger in the next step.
    """

    places: Float[Array, "n+1 3"]
    pressures: Float[Array, "k p"]
    relaxed: Float[Array, "k"]

    def flattened(self, axes: Float[Array, "3 2"]) -> "Touching":
        """With all nodes in the plane of two axes through the first one."""
        first = self.places[:1]
        places = first + (self.places - first) @ axes @ axes.T
        return Touching(places, self.pressures, self.relaxed)

    def without(self, normal: Float[Array, "3"]) -> "Touching":
        """The same, of the plane with this normal."""
        ways = self.places - self.places[:1]
        return Touching(self.places - (ways @ normal)[:, None] * normal[None], self.pressures, self.relaxed)


class TouchingChange(NamedTuple):
    """Of a step."""

    displacements: Float[Array, "n+1 3"]
    pressures: Float[Array, "k p"]

    @staticmethod
    def nothing(touching: Touching) -> "TouchingChange":
        return TouchingChange(jnp.zeros_like(touching.places), jnp.zeros_like(touching.pressures))
