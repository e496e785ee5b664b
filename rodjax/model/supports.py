"""What holds the two ends of a rod, and places between them."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import (
    DEFAULT_D2,
    ROTATION_TOLERANCE,
    direction,
    instance,
    is_known,
    leaf,
    namespace,
    not_negative,
    number_array,
    positive,
    rotation,
    shown,
    vector,
)
from rodjax.units import Units


class Support(eqx.Module):
    """What is held at an end. Its type is static, so that whatever is not held never enters a compiled program."""

    @abstractmethod
    def in_units(self, units: Units) -> "Support":
        """The same support in the units of the rod: see `rodjax.model.scene.nondimensional`."""


class Clamp(Support):
    """Position and frame are held.

    `position`: (3,) [m]; `frame`: (3, 3), columns d1, d2, t, a rotation: `rodjax.frame` makes one from a tangent.
    """

    position: Float[Array, "3"]
    frame: Float[Array, "3 3"]

    def __init__(self, position: Any, frame: Any):
        self.position = leaf(vector(position, "position"))
        self.frame = leaf(rotation(frame, "frame"))

    def in_units(self, units: Units) -> "Clamp":
        return Clamp((self.position - units.origin) / units.length, self.frame)

    @property
    def tangent(self) -> Float[Array, "3"]:
        return self.frame[:, 2]


class Swivel(Support):
    """Position and tangent are held; the rod is free to spin, and so carries no torsion.

    `position`: (3,) [m]; `tangent`: (3,), any nonzero vector along the rod.
    """

    position: Float[Array, "3"]
    tangent: Float[Array, "3"]

    def __init__(self, position: Any, tangent: Any):
        self.position = leaf(vector(position, "position"))
        self.tangent = leaf(direction(tangent, "tangent"))

    def in_units(self, units: Units) -> "Swivel":
        return Swivel((self.position - units.origin) / units.length, self.tangent)


class Pin(Support):
    """Position is held; the rod is free to turn. `position`: (3,) [m]."""

    position: Float[Array, "3"]

    def __init__(self, position: Any):
        self.position = leaf(vector(position, "position"))

    def in_units(self, units: Units) -> "Pin":
        return Pin((self.position - units.origin) / units.length)


class Free(Support):
    """Nothing is held; dead loads act on the end, along fixed global axes.

    `force`: (3,) [N]; `moment`: (3,) [N m]; an omitted one is zero and not computed. A dead moment has no potential in
    three dimensions: its virtual work enters the equilibrium, but no work of it the `energy` of a result. `follower`:
    both are given along the material frame (d1, d2, t) of the end instead, and turn with it: no potential either. A
    rod may be free at both ends where a `Clip`, an obstacle with friction or a `Potential` holds it.
    """

    force: Float[Array, "3"] | None
    moment: Float[Array, "3"] | None
    follower: bool = eqx.field(static=True)

    def __init__(self, force: Any = None, moment: Any = None, follower: bool = False):
        instance(follower, "follower", bool)
        self.follower = follower
        self.force = None if force is None else leaf(vector(force, "force"))
        self.moment = None if moment is None else leaf(vector(moment, "moment"))
        if follower and force is None and moment is None:
            raise ValueError("follower must be False without a force or a moment that could follow the end")

    def in_units(self, units: Units) -> "Free":
        return Free(
            None if self.force is None else self.force / units.force,
            None if self.moment is None else self.moment / units.energy,
            self.follower,
        )


class Clip(eqx.Module):
    """A support between the ends of a rod: it holds a position; with `tangent` the direction too; with `frame`
    direction and twist.

    `at`: arclength s [m], between 0 and L; `position`: (3,) [m]; `tangent`: (3,), any nonzero vector along the rod,
    which is free to spin in the clip; `frame`: (3, 3), columns d1, d2, t, a rotation, as that of a `Clamp`: then
    `tangent` is `None`. Without either, the rod is free to turn there. `sliding`: the rod slides through without
    friction, so that the clip exerts no axial force; the arclength at the clip is then unknown, and the search for it
    begins at `at`.

    A rod in a clip that holds its twist is solved by frames along it, as one whose section is not round is: by elements
    of a `Newton`.

    Raises `ValueError` where both `tangent` and `frame` are given.
    """

    at: Float[Array, ""]
    position: Float[Array, "3"]
    tangent: Float[Array, "3"] | None
    frame: Float[Array, "3 3"] | None
    sliding: bool = eqx.field(static=True)

    def __init__(self, at: Any, position: Any, tangent: Any = None, sliding: bool = False, frame: Any = None):
        instance(sliding, "sliding", bool)
        if tangent is not None and frame is not None:
            raise ValueError("tangent must be None where frame is given, which has it as its third column")
        self.sliding = sliding
        self.at = leaf(positive(at, "at"))
        self.position = leaf(vector(position, "position"))
        self.tangent = None if tangent is None else leaf(direction(tangent, "tangent"))
        self.frame = None if frame is None else leaf(rotation(frame, "frame"))

    def in_units(self, units: Units) -> "Clip":
        """The same clip in the units of the rod: see `rodjax.model.scene.nondimensional`."""
        position = (self.position - units.origin) / units.length
        return Clip(self.at / units.length, position, self.tangent, self.sliding, self.frame)

    @property
    def direction(self) -> Float[Array, "3"] | None:
        """The direction along the rod that it holds; `None` where it holds none."""
        return self.tangent if self.frame is None else self.frame[:, 2]


class Movable(Support):
    """An end whose pose is unknown: it belongs to a rigid body, which other rods, a support or springs hold."""

    def in_units(self, units: Units) -> "Support":
        raise ValueError(
            f"an end that is a {type(self).__name__} has an unknown pose, which rodjax.solve finds (a Joint: of a "
            "Harness), and this operation does not: give it a Clamp at the pose that was found"
        )


class Joint(Movable):
    """In the place of a support: this end of a rod is fixed in the rigid body `name` of a `Harness`.

    `frame`: (3, 3), columns d1, d2, t, of the end in the axes of the body; `offset`: (3,) [m], from the position of the
    body to the end, in its axes.
    """

    name: str = eqx.field(static=True)
    frame: Float[Array, "3 3"]
    offset: Float[Array, "3"]

    def __init__(self, name: str, frame: Any = None, offset: Any = (0.0, 0.0, 0.0)):
        instance(name, "name", str)
        if not name:
            raise ValueError("name must not be empty")
        self.name = name
        self.frame = leaf(rotation(np.eye(3) if frame is None else frame, "frame"))
        self.offset = leaf(vector(offset, "offset"))


class Hinge(Movable):
    """Position is held, and the frame but for a turn about one axis.

    `position`: (3,) [m]; `frame`: (3, 3), columns d1, d2, t, of the end before it turns; `axis`: (3,), any nonzero
    vector, global axes.
    """

    position: Float[Array, "3"]
    frame: Float[Array, "3 3"]
    axis: Float[Array, "3"]

    def __init__(self, position: Any, frame: Any, axis: Any):
        self.position = leaf(vector(position, "position"))
        self.frame = leaf(rotation(frame, "frame"))
        self.axis = leaf(direction(axis, "axis"))


# Of two directions of a `Slider`: the sine of the angle between them below which they count as one.
LEAST_SINE = 1e-6


class Slider(Movable):
    """Free to move along a line, or in a plane.

    `position`: (3,) [m], a point of the line or plane; `directions`: (1, 3) or (2, 3), along which it moves, any
    length; `frame`: (3, 3), columns d1, d2, t, held if given, else the end is free to turn.
    """

    position: Float[Array, "3"]
    directions: Float[Array, "k 3"]
    frame: Float[Array, "3 3"] | None

    def __init__(self, position: Any, directions: Any, frame: Any = None):
        self.position = leaf(vector(position, "position"))
        shape = np.shape(directions)
        if shape not in ((1, 3), (2, 3)):
            raise ValueError(f"directions must have the shape (1, 3) or (2, 3), got {shape}")
        rows = [direction(directions[k], f"directions[{k}]") for k in range(shape[0])]
        xp = namespace(*rows)
        if len(rows) == 2:
            across = rows[1] - xp.dot(rows[0], rows[1]) * rows[0]
            size = xp.linalg.norm(across)
            if is_known(size) and not size > LEAST_SINE:
                raise ValueError(f"directions must not be parallel, got {shown(directions)}")
            rows[1] = across / size
        self.directions = leaf(xp.stack(rows))
        self.frame = None if frame is None else leaf(rotation(frame, "frame"))


class Spring(Movable):
    """A support held by springs, against which the end may move.

    `support`: `Clamp`, `Pin`, `Hinge` or `Slider`; `translation` [N/m] and `rotation` [N m/rad]: scalars or symmetric
    (3, 3), global axes. The energy is d . translation d/2 + r . rotation r/2, with the displacement d from the position
    of the support and the rotation vector r, shorter than pi, from its frame. What has no spring stays as the support
    has it. A spring frees all translations or all rotations of a support that holds them all; where a `Slider` moves
    along a line, or a `Hinge` turns, it acts on this motion alone.
    """

    support: Support
    translation: Float[Array, ""] | Float[Array, "3 3"] | None
    rotation: Float[Array, ""] | Float[Array, "3 3"] | None

    def __init__(self, support: Support, translation: Any = None, rotation: Any = None):
        instance(support, "support", (Clamp, Pin, Hinge, Slider))
        if translation is None and rotation is None:
            raise ValueError("a Spring needs translation or rotation, got None for both")
        if rotation is not None and getattr(support, "frame", None) is None:
            raise ValueError(f"rotation must be None on a {type(support).__name__} without a frame to turn from")
        self.support = support
        self.translation = None if translation is None else leaf(_stiffness(translation, "translation"))
        self.rotation = None if rotation is None else leaf(_stiffness(rotation, "rotation"))


def _stiffness(value: Any, name: str) -> Any:
    """A scalar or a symmetric matrix without a negative eigenvalue."""
    if np.ndim(value) == 0:
        return not_negative(value, name)
    array = number_array(value, name, (3, 3))
    if is_known(array):
        matrix = np.asarray(array)
        size = np.max(np.abs(matrix))
        if np.max(np.abs(matrix - matrix.T)) > ROTATION_TOLERANCE * size:
            raise ValueError(f"{name} must be symmetric, got {shown(value)}")
        if np.min(np.linalg.eigvalsh(matrix)) < -ROTATION_TOLERANCE * size:
            raise ValueError(f"{name} must have no negative eigenvalue, got {shown(value)}")
    return array


# The supports that hold the position, and those that also hold the tangent; a `Clamp` alone holds the twist.
Held = Clamp | Swivel | Pin
Directed = Clamp | Swivel

# Of a rotation vector [rad], a number of turns beyond which single precision does not tell the angle.
LARGEST_TURN = 1e6


def rotate(frame: Any, rotation_vector: Any) -> Float[Array, "3 3"]:
    """A frame (3, 3) turned about the axis of a rotation vector (3,) by its length [rad], global axes.

    The derivative of a solve by a frame is meant for rotations: take it by this vector, at zero.
    """
    turned, checked = rotation(frame, "frame"), vector(rotation_vector, "rotation_vector")
    if is_known(checked) and not np.max(np.abs(checked)) < LARGEST_TURN:
        raise ValueError(f"rotation_vector must be shorter than {LARGEST_TURN:g} rad, got {shown(rotation_vector)}")
    xp = namespace(turned, checked)
    turned, (x, y, z) = xp.asarray(turned), xp.asarray(checked)
    squared = x * x + y * y + z * z
    # Series near zero, where the derivatives of the length are infinite.
    is_small = squared < 1e-4
    angle = xp.sqrt(xp.where(is_small, 1.0, squared))
    a = xp.where(is_small, 1 - squared / 6 + squared**2 / 120 - squared**3 / 5040, xp.sin(angle) / angle)
    b = xp.where(is_small, 0.5 - squared / 24 + squared**2 / 720 - squared**3 / 40320, (1 - xp.cos(angle)) / angle**2)
    zero = xp.zeros_like(squared)
    cross = xp.stack([xp.stack([zero, -z, y]), xp.stack([z, zero, -x]), xp.stack([-y, x, zero])])
    return leaf(turned + a * (cross @ turned) + b * (cross @ (cross @ turned)))


# Of a d2 of which a smaller part is at right angles to the tangent the direction is mostly rounding of the input.
LEAST_ACROSS = 1e-6


def frame(tangent: Any, d2: Any = DEFAULT_D2) -> Float[Array, "3 3"]:
    """The frame with columns (d1, d2, t): t along `tangent`, d2 the part of `d2` at right angles to it.

    `tangent`, `d2`: (3,), any length. Without d2, along global y, frames of several tangents are turned about these
    against one another. Raises `ValueError` where the two are parallel.
    """
    t = direction(tangent, "tangent")
    is_default = d2 is DEFAULT_D2
    d2 = direction(d2, "d2")
    xp = namespace(t, d2)
    across = d2 - xp.dot(d2, t) * t
    length = xp.linalg.norm(across)
    if is_known(length) and not length > LEAST_ACROSS:
        if is_default:
            raise ValueError(
                f"d2 must not be parallel to the tangent, as its default (0, 1, 0) is: give d2, got tangent = {t}"
            )
        raise ValueError(f"d2 must not be parallel to the tangent, got d2 = {d2} and tangent = {t}")
    d2 = across / length
    return leaf(xp.stack([xp.cross(d2, t), d2, t], axis=-1))
