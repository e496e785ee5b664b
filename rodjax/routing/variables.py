"""Design variables of a route: numbers of a scene or harness, each as a function of numbers from 0 to 1."""

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.analysis.sensitivity import named_numbers
from rodjax.checks import Numbers, instance, leaf, number_array, positive, sequence, shown, vector
from rodjax.geometry.vectors import dot
from rodjax.identification.unknowns import unit_of
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.model.supports import rotate

# Of a surface, nominal positions are found to this part of its parameters' range by looking at so many of each.
GRID = 33


class Variable(eqx.Module):
    """A number or vector of a scene that may vary, by its dotted name, such as `"clips.0.at"`, `"end.position.2"`; of a
    harness `"cables.NAME.rod.length"`, of the scene of a cable, and `"joints.NAME.mass"`, of a `Body`.
    """

    key: eqx.AbstractVar[str]

    @abstractmethod
    def number(self, u: Float[Array, "k"], nominal: Float[Array, "..."]) -> Float[Array, "..."]:
        """What the scene gets, from numbers in 0 to 1 and what the nominal scene has."""

    @abstractmethod
    def start(self, nominal: Float[np.ndarray, "..."]) -> Float[np.ndarray, "k"]:
        """The numbers, in 0 to 1, next to what the nominal scene has."""

    @abstractmethod
    def scales(self) -> Float[np.ndarray, "k"]:
        """How much in `units` the range from 0 to 1 is."""

    def offsets(self) -> Float[np.ndarray, "k"]:
        """What is at 0, in `units`."""
        return np.zeros(self.count)

    @abstractmethod
    def labels(self) -> tuple[str, ...]:
        """Names of the numbers."""

    @abstractmethod
    def units(self) -> tuple[str, ...]:
        """SI units of the numbers."""

    @abstractmethod
    def check(self, nominal: Float[Array, "..."]) -> None:
        """Raises `ValueError` where the number of the scene is not of the kind that this varies."""

    @property
    def count(self) -> int:
        return len(self.labels())


class Between(Variable):
    """A number, or each component of a vector, from `lower` to `upper`, in SI units.

    `key`: such as `"rod.length"`, `"clips.1.at"`, `"clips.0.position"`, `"clips.0.position.2"`; not of a direction or
    frame. Raises `ValueError` where `lower` is not below `upper`.
    """

    key: str = eqx.field(static=True)
    lower: Float[Array, "*k"]
    upper: Float[Array, "*k"]

    def __init__(self, key: str, lower: Any, upper: Any):
        self.key = _checked_key(key)
        shape = np.shape(lower)
        if len(shape) > 1 or shape == (0,):
            raise ValueError(f"lower must be a number or a list of them, got {shown(lower)}")
        self.lower = leaf(number_array(lower, "lower", shape))
        self.upper = leaf(number_array(upper, "upper", shape))
        if not np.all(np.asarray(self.lower) < np.asarray(self.upper)):
            raise ValueError(f"lower must be below upper for {self.key}, got {shown(lower)} and {shown(upper)}")

    def number(self, u, nominal):
        u = u.reshape(self.lower.shape)
        return self.lower + u * (self.upper - self.lower)

    def start(self, nominal):
        share = (np.asarray(nominal) - np.asarray(self.lower)) / np.asarray(self.upper - self.lower)
        return np.clip(share.reshape(-1), 0, 1)

    def scales(self):
        return np.asarray(self.upper - self.lower).reshape(-1)

    def offsets(self):
        return np.asarray(self.lower).reshape(-1)

    def labels(self):
        return (self.key,) if self.lower.ndim == 0 else tuple(f"{self.key}.{k}" for k in range(len(self.lower)))

    def units(self):
        return (unit_of(self.key),) * self.lower.size

    def check(self, nominal):
        if _is_turned(self.key):
            raise ValueError(f"{self.key} is a direction or frame: rodjax.Turned varies it, not Between")
        if nominal.shape != self.lower.shape:
            raise ValueError(
                f"lower and upper of {self.key} must be {_kind(nominal.shape)}, got shape {self.lower.shape}"
            )


class OnLine(Variable):
    """A position on the straight line from `start` to `end`, (3,) [m]; `key`: such as `"clips.0.position"`."""

    key: str = eqx.field(static=True)
    first: Float[Array, "3"]
    last: Float[Array, "3"]

    def __init__(self, key: str, start: Any, end: Any):
        self.key = _checked_key(key)
        self.first, self.last = leaf(vector(start, "start")), leaf(vector(end, "end"))
        if np.array_equal(self.first, self.last):
            raise ValueError(f"end must differ from start for {self.key}, got {shown(start)} for both")

    def number(self, u, nominal):
        return self.first + u * (self.last - self.first)

    def start(self, nominal):
        along = np.asarray(self.last - self.first)
        share = (np.asarray(nominal) - np.asarray(self.first)) @ along / (along @ along)
        return np.clip(share.reshape(1), 0, 1)

    def scales(self):
        return np.linalg.norm(np.asarray(self.last - self.first)).reshape(1)

    def labels(self):
        return (f"{self.key} along its line",)

    def units(self):
        return ("m",)

    def check(self, nominal):
        _check_position(self.key, nominal)


class OnPatch(Variable):
    """A position on a flat patch, `corner` + u `edge1` + v `edge2`, (3,) [m]; `key`: such as `"clips.0.position"`."""

    key: str = eqx.field(static=True)
    corner: Float[Array, "3"]
    edge1: Float[Array, "3"]
    edge2: Float[Array, "3"]

    def __init__(self, key: str, corner: Any, edge1: Any, edge2: Any):
        self.key = _checked_key(key)
        self.corner, self.edge1, self.edge2 = (
            leaf(vector(x, name)) for x, name in ((corner, "corner"), (edge1, "edge1"), (edge2, "edge2"))
        )
        if not np.linalg.norm(np.cross(self.edge1, self.edge2)) > 0:
            raise ValueError(f"edge1 and edge2 must span a patch for {self.key}, got {shown(edge1)} and {shown(edge2)}")

    def number(self, u, nominal):
        return self.corner + u[0] * self.edge1 + u[1] * self.edge2

    def start(self, nominal):
        edges = np.stack([self.edge1, self.edge2], axis=1)
        return np.clip(np.linalg.lstsq(edges, np.asarray(nominal) - np.asarray(self.corner))[0], 0, 1)

    def scales(self):
        return np.array([np.linalg.norm(self.edge1), np.linalg.norm(self.edge2)])

    def labels(self):
        return (f"{self.key} along edge1", f"{self.key} along edge2")

    def units(self):
        return ("m", "m")

    def check(self, nominal):
        _check_position(self.key, nominal)


class OnSurface(Variable):
    """A position on a user-defined surface; `key`: such as `"clips.0.position"`.

    `function`: of u and v, both in 0 to 1, the point (3,) [m], in JAX. Programs are compiled for the function itself:
    make it once, not for each call.
    """

    key: str = eqx.field(static=True)
    function: Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, "3"]] = eqx.field(static=True)

    def __init__(self, key: str, function: Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, "3"]]):
        self.key = _checked_key(key)
        if not callable(function):
            raise TypeError(f"function must be a function of u and v, got {shown(function)}")
        number = jax.ShapeDtypeStruct((), jnp.zeros(()).dtype)
        found = jax.eval_shape(function, number, number)
        if getattr(found, "shape", None) != (3,):
            raise ValueError(f"function must give a point (3,) for u and v, got {shown(found)}")
        self.function = function

    def number(self, u, nominal):
        return self.function(u[0], u[1])

    def start(self, nominal):
        grid = jnp.linspace(0.0, 1.0, GRID)
        points = jax.vmap(lambda u: jax.vmap(lambda v: self.function(u, v))(grid))(grid)
        squared = np.sum((np.asarray(points) - np.asarray(nominal)) ** 2, axis=-1)
        return np.array(np.unravel_index(np.argmin(squared), squared.shape)) / (GRID - 1)

    def scales(self):
        return np.ones(2)

    def labels(self):
        return (f"{self.key} by u", f"{self.key} by v")

    def units(self):
        return ("", "")

    def check(self, nominal):
        _check_position(self.key, nominal)


class Turned(Variable):
    """A direction or frame that turns away from that of the scene by at most `angle` [rad].

    `key`: `"clips.0.tangent"`, `"end.tangent"` of a `Swivel`: two numbers, turns about axes across the direction; or
    `"end.frame"` of a `Clamp`, `"clips.0.frame"`: three, a rotation vector along the frame's d1, d2, t.
    """

    key: str = eqx.field(static=True)
    angle: Float[Array, ""]

    def __init__(self, key: str, angle: Any):
        self.key = _checked_key(key)
        self.angle = leaf(positive(angle, "angle"))
        if not float(self.angle) <= math.pi:
            raise ValueError(f"angle of {self.key} must be at most pi rad, got {float(self.angle):g}")

    @property
    def _is_frame(self) -> bool:
        return self.key.endswith(".frame")

    def number(self, u, nominal):
        x = 2 * u - 1
        if self._is_frame:
            turn = self.angle * nominal @ in_ball(x)
            return rotate(nominal, turn)
        across = _across(nominal)
        x, y = x
        disc = jnp.stack([x * jnp.sqrt(1 - y**2 / 2), y * jnp.sqrt(1 - x**2 / 2)])
        turn = self.angle * (across @ disc)
        return rotate(jnp.eye(3, dtype=nominal.dtype), turn) @ nominal

    def start(self, nominal):
        return np.full(3 if self._is_frame else 2, 0.5)

    def scales(self):
        return np.full(3 if self._is_frame else 2, 2 * float(self.angle))

    def offsets(self):
        return -self.scales() / 2

    def labels(self):
        return tuple(f"{self.key} turn {k}" for k in range(3 if self._is_frame else 2))

    def units(self):
        return ("rad",) * (3 if self._is_frame else 2)

    def check(self, nominal):
        if not _is_turned(self.key):
            raise ValueError(f"{self.key} is no direction or frame: rodjax.Between varies it, not Turned")


def in_ball(x: Float[Array, "3"]) -> Float[Array, "3"]:
    """Of the cube from -1 to 1, a smooth map onto the ball of radius 1."""
    squared = x**2
    y, z = squared[jnp.array([1, 2, 0])], squared[jnp.array([2, 0, 1])]
    return x * jnp.sqrt(1 - y / 2 - z / 2 + y * z / 3)


def _across(direction: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Two unit vectors at right angles to a direction and to one another."""
    other = jnp.eye(3, dtype=direction.dtype)[jnp.argmin(jnp.abs(direction))]
    first = jnp.cross(direction, other)
    first = first / jnp.sqrt(dot(first, first))
    return jnp.stack([first, jnp.cross(direction, first)], axis=1)


# --- several of them -------------------------------------------------------------------------------------------------


def checked_variables(variables: Any, scene: Scene | Harness) -> tuple[Variable, ...]:
    """Where each has a number of the scene to vary, and none the same as another."""
    variables = sequence(variables, "variables", "variables such as rodjax.Between")
    if not variables:
        raise ValueError("variables must hold at least one, such as rodjax.Between('rod.length', 1.0, 1.2), got none")
    places: list[tuple[str, int | None]] = []
    for k, variable in enumerate(variables):
        instance(variable, f"variables[{k}]", Variable)
        name, component = place = _place(variable.key, scene)
        number = named_numbers(scene)[name]
        variable.check(number if component is None else number[component])
        for other in places:
            if name == other[0] and (component == other[1] or component is None or other[1] is None):
                raise ValueError(f"variables[{k}]: {variable.key} varies already")
        places.append(place)
    return variables


def with_numbers(scene: Scene | Harness, variables: Sequence[Variable], u: Float[Array, "n"]) -> Any:
    """The scene with the numbers that the variables give it."""
    numbers = named_numbers(scene)
    changed: dict[str, Array] = {}
    first = 0
    for variable in variables:
        name, component = _place(variable.key, scene)
        nominal = numbers[name]
        of_variable = u[first : first + variable.count]
        first += variable.count
        if component is None:
            changed[name] = variable.number(of_variable, nominal).astype(nominal.dtype)
        else:
            found = variable.number(of_variable, nominal[component])
            changed[name] = changed.get(name, nominal).at[component].set(found.astype(nominal.dtype))
    changed = {name: x.reshape(numbers[name].shape) for name, x in changed.items()}
    return eqx.tree_at(lambda scene: [named_numbers(scene)[name] for name in changed], scene, list(changed.values()))


def first_numbers(scene: Scene | Harness, variables: Sequence[Variable]) -> Float[np.ndarray, "n"]:
    """Those next to the scene."""
    return np.concatenate([variable.start(np.asarray(number_of(scene, variable))) for variable in variables])


def number_of(scene: Scene | Harness, variable: Variable) -> Float[Numbers, "..."]:
    name, component = _place(variable.key, scene)
    number = named_numbers(scene)[name]
    return number if component is None else number[component]


def leaf_names(scene: Scene | Harness, variables: Sequence[Variable]) -> set[str]:
    return {_place(variable.key, scene)[0] for variable in variables}


def _place(key: str, scene: Scene | Harness) -> tuple[str, int | None]:
    numbers = named_numbers(scene)
    if key in numbers:
        return key, None
    name, _, component = key.rpartition(".")
    is_component = name in numbers and numbers[name].ndim == 1 and not _is_turned(name)
    if is_component and re.fullmatch("[0-9]+", component) and int(component) < len(numbers[name]):
        return name, int(component)
    kind = "scene" if isinstance(scene, Scene) else "harness"
    raise ValueError(f"{shown(key)} is no number of this {kind}; there are {', '.join(numbers)}")


def _checked_key(key: Any) -> str:
    if not isinstance(key, str) or not key:
        raise TypeError(f"key must be the dotted name of a number such as 'clips.0.at', got {shown(key)}")
    return key


def _check_position(key: str, nominal: Float[Array, "..."]) -> None:
    if nominal.shape != (3,) or not key.endswith(".position"):
        raise ValueError(f"{key} is no position: only one such as clips.0.position can lie on a line or surface")


def _is_turned(key: str) -> bool:
    return key.endswith((".tangent", ".frame"))


def _kind(shape: tuple[int, ...]) -> str:
    return "a number" if shape == () else f"numbers of shape {shape}"
