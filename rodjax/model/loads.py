"""Loads along the rod. Gravity is a vector of the scene; loads on a free end belong to `Free`."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from rodjax.checks import instance, leaf, not_negative, vector
from rodjax.units import Units


class PointForce(eqx.Module):
    """A dead force at an arclength. `at`: arclength s [m]; `force`: (3,) [N], global axes."""

    at: Float[Array, ""]
    force: Float[Array, "3"]

    def __init__(self, at: Any, force: Any):
        self.at = leaf(not_negative(at, "at"))
        self.force = leaf(vector(force, "force"))

    def in_units(self, units: Units) -> "PointForce":
        """The same force in the units of the rod: see `rodjax.model.scene.nondimensional`."""
        return PointForce(self.at / units.length, self.force / units.force)


class DistributedForce(eqx.Module):
    """A force per length all along the rod: (3,) [N/m].

    `force`: along global axes; or, where `follower` is True, along the material frame (d1, d2, t) of each section, as
    of a pressure or a flow, which has no potential.
    """

    force: Float[Array, "3"]
    follower: bool = eqx.field(static=True)

    def __init__(self, force: Any, follower: bool = False):
        self.force = leaf(vector(force, "force"))
        instance(follower, "follower", bool)
        self.follower = follower

    def in_units(self, units: Units) -> "DistributedForce":
        return DistributedForce(self.force * (units.length / units.force), self.follower)


class DistributedCouple(eqx.Module):
    """A couple per length all along the rod: (3,) [N m/m]; it has no potential.

    `couple`: along global axes, or, where `follower` is True, along the material frame (d1, d2, t) of each section.
    """

    couple: Float[Array, "3"]
    follower: bool = eqx.field(static=True)

    def __init__(self, couple: Any, follower: bool = False):
        self.couple = leaf(vector(couple, "couple"))
        instance(follower, "follower", bool)
        self.follower = follower

    def in_units(self, units: Units) -> "DistributedCouple":
        return DistributedCouple(self.couple * (units.length / units.energy), self.follower)
