"""The units in which a scene is solved."""

import equinox as eqx
from jaxtyping import Array, Float


class Units(eqx.Module):
    """Lengths in L, counted from `origin`; moments and energies in EI/L, forces in EI/L^2."""

    origin: Float[Array, "3"]
    length: Float[Array, ""]
    energy: Float[Array, ""]

    @property
    def force(self) -> Float[Array, ""]:
        return self.energy / self.length
