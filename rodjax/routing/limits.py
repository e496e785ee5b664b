"""What a route shall keep to."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from rodjax.checks import leaf, not_negative, number_list, positive, shown


class Limits(eqx.Module):
    """Limits on the shape and the forces of a route; a limit that is not given is not checked.

    **Arguments:**

    - `bend_radius`: least inside bend radius, that of the centerline less the rod's own, as a multiple of the outer
        diameter; the rod needs a radius.
    - `clearance` [m]: least distance from the surface of the rod to that of an obstacle; a number for all obstacles, or
        one for each.
    - `clip_force` [N], `clip_moment` [N m]: largest of each clip.
    - `end_force` [N], `end_moment` [N m]: largest at each end.
    - `twist` [rad/m]: largest magnitude.
    - `strain`: largest magnitude of the axial strain.
    - `stability` [N]: least stiffness of the softest motion, as by `rodjax.lowest_mode`.
    - `length` [m], `mass` [kg], `energy` [J]: largest; of the energy, the elastic one.

    Raises `ValueError` or `TypeError` where one is not positive (clearance, stability: is negative), or none is given.
    """

    bend_radius: Float[Array, ""] | None
    clearance: Float[Array, ""] | Float[Array, "m"] | None
    clip_force: Float[Array, ""] | None
    clip_moment: Float[Array, ""] | None
    end_force: Float[Array, ""] | None
    end_moment: Float[Array, ""] | None
    twist: Float[Array, ""] | None
    strain: Float[Array, ""] | None
    stability: Float[Array, ""] | None
    length: Float[Array, ""] | None
    mass: Float[Array, ""] | None
    energy: Float[Array, ""] | None

    def __init__(
        self,
        *,
        bend_radius: Any = None,
        clearance: Any = None,
        clip_force: Any = None,
        clip_moment: Any = None,
        end_force: Any = None,
        end_moment: Any = None,
        twist: Any = None,
        strain: Any = None,
        stability: Any = None,
        length: Any = None,
        mass: Any = None,
        energy: Any = None,
    ):
        def most(value: Any, name: str) -> Float[Array, ""] | None:
            return None if value is None else leaf(positive(value, name))

        self.bend_radius = most(bend_radius, "bend_radius")
        self.clearance = None if clearance is None else _clearances(clearance)
        self.clip_force = most(clip_force, "clip_force")
        self.clip_moment = most(clip_moment, "clip_moment")
        self.end_force = most(end_force, "end_force")
        self.end_moment = most(end_moment, "end_moment")
        self.twist = most(twist, "twist")
        self.strain = most(strain, "strain")
        self.stability = None if stability is None else leaf(not_negative(stability, "stability"))
        self.length = most(length, "length")
        self.mass = most(mass, "mass")
        self.energy = most(energy, "energy")
        given = (getattr(self, name) for name in self.__dataclass_fields__)
        if all(value is None for value in given):
            raise ValueError("Limits must hold at least one limit, such as bend_radius=6, got none")

    def without_clips(self) -> "Limits | None":
        """Those of a cable without clips; `None` where there are no others."""
        names = [name for name in self.__dataclass_fields__ if not name.startswith("clip_")]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return Limits(**given) if given else None


def _clearances(value: Any) -> Float[Array, ""] | Float[Array, "m"]:
    numbers = number_list(value, "clearance")
    for number in numbers:
        try:
            not_negative(number, "clearance")
        except ValueError:
            raise ValueError(f"clearance must not be negative, got {shown(value)}") from None
    return leaf(numbers[0] if getattr(value, "ndim", None) == 0 or isinstance(value, int | float) else numbers)
