"""What is sought: numbers of scenes and measurements by their names, on the scale on which they are sought."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.analysis.sensitivity import named_numbers
from rodjax.checks import Numbers, leaf, namespace, number_array, one_of, positive, sequence, shown
from rodjax.identification.measurements import Experiment
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.model.supports import rotate

Scale = Literal["log", "linear"]
Per = Literal["all", "experiment"]

# Numbers that are positive by their nature, and so sought by their logarithm where nothing else is said.
POSITIVE = ("rod.EI", "rod.GJ", "rod.EA", "rod.GA", "rod.mass_per_length", "rod.length", "rod.radius", "mass", "scale")
UNITS = {
    "jumps": "m",
    "rod.EI": "N m^2",
    "rod.GJ": "N m^2",
    "rod.EA": "N",
    "rod.GA": "N",
    "rod.mass_per_length": "kg/m",
    "rod.length": "m",
    "rod.radius": "m",
    "rod.rest_curvature": "1/m",
    "rod.rest_twist": "rad/m",
    "rod.rest_strain": "",
    "position": "m",
    "tangent": "",
    "frame": "rad",
    "force": "N",
    "moment": "N m",
    "couple": "N m/m",
    "at": "m",
    "gravity": "m/s^2",
    "scale": "",
    "turn": "rad",
    "mass": "kg",
    "translation": "N/m",
    "rotation": "N m",
    "offset": "m",
    "shift": "m",
}


class Unknown:
    """A number to be found.

    **Arguments:**

    - `names`: the dotted name of a number, or several that go together: `"rod.EI"`, `"rod.EI.0"` of a pair,
        `"end.position.2"`, `"gravity.1"`, `"rod.rest_curvature.0"`, `"measured.0.scale"`. `"start.frame.1"` is the turn
        of a clamp about the second global axis [rad], 0 as nominal. Of several names the first is sought; the others
        keep their ratio to it as in the scene, on a linear scale their difference.
    - `scale`: `"log"` for what is positive, or `"linear"`; `None`: `"log"` for stiffnesses, masses, lengths and scales.
    - `per`: `"all"`, the same in all experiments that have such a number; or `"experiment"`, one in each.
    - `start`: where the search begins; `None`: the number of the scene, shared ones that of the first.
    - `prior`: (value, standard deviation) known beforehand; on a log scale the deviation is relative.
    - `bounds`: (least, largest), `None` for none on that side.
    - `size`: change that counts as large, by which unknowns are compared; `None`: a factor e on a log scale, else the
        rod's length, a radian, or what else belongs to the unit.
    - `label`: for the report; `None`: the first name.

    Raises `ValueError` or `TypeError` for what makes no sense; whether experiments have such numbers `fit` finds out.
    """

    def __init__(
        self,
        names: str | Sequence[str],
        *,
        scale: Scale | None = None,
        per: Per = "all",
        start: Any = None,
        prior: Any = None,
        bounds: Any = None,
        size: Any = None,
        label: str | None = None,
    ):
        self.names = (names,) if isinstance(names, str) else sequence(names, "names", "dotted names")
        for name in self.names:
            if not isinstance(name, str) or not name:
                raise TypeError(f"names must be dotted names of numbers such as 'rod.EI', got {shown(name)}")
        if not self.names:
            raise ValueError("names must hold at least one name, got none")
        first = self.names[0]
        if scale is None:
            scale = "log" if _matches(first, POSITIVE) and not _matches(first, ("jumps",)) else "linear"
        one_of(scale, "scale", get_args(Scale))
        one_of(per, "per", get_args(Per))
        self.scale: Scale = scale
        self.per: Per = per
        check = positive if scale == "log" else number_array
        self.start = None if start is None else float(check(start, "start"))
        self.prior = None if prior is None else _pair(prior, "prior", check, positive)
        self.bounds = (None, None) if bounds is None else _bounds(bounds, check)
        self.size = None if size is None else float(positive(size, "size"))
        self.label = first if label is None else str(label)
        self.unit = unit_of(first)

    def natural_size(self, length: float) -> float:
        """The change that counts as large, for a rod of that length [m]."""
        if self.size is not None:
            return self.size
        return 1.0 if self.scale == "log" else {"m": length, "1/m": 1 / length, "rad/m": 1 / length}.get(self.unit, 1.0)


def unit_of(name: str) -> str:
    """SI unit of a number by its dotted name; none of a number without one."""
    if _matches(name, ("distributed",)) and _matches(name, ("force",)):
        return "N/m"
    if _matches(name, ("point_couples",)) and _matches(name, ("couple",)):
        return "N m"
    if _matches(name, ("obstacles",)):
        return "rad" if _matches(name, ("frame",)) else "" if _matches(name, ("normal", "friction")) else "m"
    return next((unit for part, unit in UNITS.items() if _matches(name, (part,))), "")


class Target(NamedTuple):
    """A number of an experiment, a scene or a harness: a leaf, by its name, and the component of it, if it is one."""

    leaf: str
    component: int | None

    @property
    def is_turn(self) -> bool:
        return _is_turned(self.leaf)


Subject = Experiment | Scene | Harness


def _is_turned(leaf: str) -> bool:
    """Whether a leaf is a direction or a frame, which changes by a rotation vector."""
    return leaf.endswith((".frame", ".tangent", ".axis"))


def _numbers(subject: Subject) -> dict[str, Float[Array, "..."]]:
    """The numbers that can be unknown, by name."""
    if not isinstance(subject, Experiment):
        return named_numbers(subject)
    numbers = dict(named_numbers(subject.scene))
    for k, measurement in enumerate(subject.measured):
        for field in ("scale", "turn", "offset", "shift"):
            if getattr(measurement, field, None) is not None:
                numbers[f"measured.{k}.{field}"] = getattr(measurement, field)
    return numbers


def target(name: str, subject: Subject) -> Target | None:
    """The number of that name, or `None` where there is none."""
    numbers = _numbers(subject)
    if name in numbers and numbers[name].ndim == 0:
        return Target(name, None)
    leaf, _, component = name.rpartition(".")
    if leaf not in numbers or not component.isdigit():
        return None
    is_component = _is_turned(leaf) or numbers[leaf].ndim == 1
    size = numbers[leaf].shape[0] if numbers[leaf].ndim else 0
    return Target(leaf, int(component)) if is_component and int(component) < size else None


def known_names(subject: Subject) -> list[str]:
    """What an unknown can be called."""
    numbers = _numbers(subject)
    return [
        name if number.ndim == 0 else f"{name}.0 to {name}.{number.shape[0] - 1}" for name, number in numbers.items()
    ]


def nominal(names: Sequence[str], subject: Subject) -> Float[Array, ""] | None:
    """The number of the first name that there is one of; that of a turn is zero."""
    numbers = _numbers(subject)
    for name in names:
        at = target(name, subject)
        if at is not None:
            return _component(numbers, at)
    return None


def _component(numbers: dict[str, Float[Array, "..."]], at: Target) -> Float[Array, ""]:
    number = numbers[at.leaf]
    if at.is_turn:
        return jnp.zeros_like(number.reshape(-1)[0])
    return number if at.component is None else number[at.component]


S = TypeVar("S", Experiment, Scene, Harness)


def with_values(subject: S, names: Sequence[Sequence[str]], scales: Sequence[str], values: Sequence[Array]) -> S:
    """The experiment, scene or harness with these numbers for its unknowns, each of one or more names."""
    numbers = _numbers(subject)
    changed: dict[str, Any] = {}
    for tied, scale, value in zip(names, scales, values, strict=True):
        first = nominal(tied, subject)
        is_first = True
        for name in tied:
            at = target(name, subject)
            if at is None or first is None:
                continue
            here = _component(numbers, at)
            new = value if is_first else value * here / first if scale == "log" else value + here - first
            is_first = False
            leaf = changed.get(at.leaf)
            if leaf is None:
                leaf = jnp.zeros(3, value.dtype) if at.is_turn else numbers[at.leaf]
            changed[at.leaf] = new if at.component is None else leaf.at[at.component].set(new)
    leaves = [_turned(numbers[name], x) if _is_turned(name) else x for name, x in changed.items()]
    return eqx.tree_at(lambda subject: [_numbers(subject)[name] for name in changed], subject, leaves)


def _turned(leaf: Float[Array, "3 ..."], turn: Float[Array, "3"]) -> Float[Array, "3 ..."]:
    return rotate(jnp.eye(3, dtype=leaf.dtype), turn) @ leaf


def _matches(name: str, parts: Sequence[str]) -> bool:
    """Whether a dotted name has one of these dotted parts."""
    return any(f".{part}." in f".{name}." for part in parts)


def _pair(value: Any, name: str, *checks: Any) -> tuple[float, float]:
    pair = sequence(value, name, "two numbers")
    if len(pair) != 2:
        raise ValueError(f"{name} must be two numbers, a value and its standard deviation, got {shown(value)}")
    return float(checks[0](pair[0], name)), float(checks[1](pair[1], name))


def _bounds(value: Any, check: Any) -> tuple[float | None, float | None]:
    pair = sequence(value, "bounds", "two numbers")
    if len(pair) != 2:
        raise ValueError(f"bounds must be two numbers, (least, largest), or None for none, got {shown(value)}")
    low, high = (None if x is None else float(check(x, "bounds")) for x in pair)
    if low is not None and high is not None and not low < high:
        raise ValueError(f"bounds must increase, got {low:g} and {high:g}")
    return low, high


def inside(x: Float[Array, "*n"], low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Numbers between bounds, some of which may be infinite, from any numbers, smooth and increasing.

    With one bound the distance from it is that of a hyperbola from its asymptote; with two a sigmoid between them.
    """
    xp = namespace(x, low, high)
    x, low, high = xp.asarray(x), xp.asarray(low), xp.asarray(high)
    has_low, has_high = xp.isfinite(low), xp.isfinite(high)
    low, high = xp.where(has_low, low, -1.0), xp.where(has_high, high, 1.0)
    middle, half = (low + high) / 2, (high - low) / 2
    between = middle + half * xp.tanh((x - middle) / half)
    above, below = low + _positive_part(x - low), high - _positive_part(high - x)
    return leaf(xp.where(has_low & has_high, between, xp.where(has_low, above, xp.where(has_high, below, x))))


def outside(x: Float[np.ndarray, "*n"], low: Float[np.ndarray, "*n"], high: Float[np.ndarray, "*n"]) -> np.ndarray:
    """The inverse of `inside`."""
    has_low, has_high = np.isfinite(low), np.isfinite(high)
    low, high = np.where(has_low, low, -1.0), np.where(has_high, high, 1.0)
    middle, half = (low + high) / 2, (high - low) / 2
    with np.errstate(all="ignore"):  # where there are no such bounds
        between = middle + half * np.arctanh((x - middle) / half)
        above, below = x - 1 / (4 * (x - low)), x + 1 / (4 * (high - x))
    return np.where(has_low & has_high, between, np.where(has_low, above, np.where(has_high, below, x)))


def _positive_part(x: Float[Numbers, "*n"]) -> Float[Numbers, "*n"]:
    return (x + namespace(x).sqrt(x * x + 1)) / 2
