"""Dead loads along the rod. Gravity is a vector of the scene; loads on a free end belong to `Free`."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from rodjax.checks import leaf, not_negative, vector
from rodjax.units import Units


class PointForce(eqx.Module):
    """A dead force at an arclength. `at`: arclength s [m]; `force`: (3,) [N], global axes."""

    at: Float[Array, ""]
    force: Float[Array, "3"]

    def __init__(self, at: Any, force: Any):
        self.at = leaf(not_negative(at, "at"))
        self.force = leaf(vector(force, "force"))

    def in_units(self, units: Units) -> "PointForce":
        """The same force in the units of the rod: see `rodjax.scene.nondimensional`."""
        return PointForce(self.at / units.length, self.force / units.force)
