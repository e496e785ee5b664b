"""Argument checks: each error names the argument, what was given and what is allowed.

Values are checked where they are known. Inside `jax.jit`, `vmap` or `grad` they are not, so that only shapes are.

Plain numbers are NumPy's until a module stores them: JAX would compile a program for each operation on them.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

Numbers = Array | np.ndarray

# Characters of a value in a message; more of it would hide what the message says.
MOST_SHOWN = 200
# Loose enough for frames typed in with 6 digits or held in float32, tight enough to catch a left-handed one.
ROTATION_TOLERANCE = 1e-5


def is_known(*values: Any) -> bool:
    """Whether every array in `values` has numbers that Python can read, that is: none is traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def namespace(*values: Any) -> ModuleType:
    """The module whose functions compute with `values`: NumPy where they are known, else JAX's."""
    return np if is_known(*values) else jnp


def leaf(numbers: Float[Numbers, "*shape"]) -> Float[Array, "*shape"]:
    """Checked numbers as a module stores them."""
    # Not jnp.asarray: that compiles a program for each shape.
    return numbers if isinstance(numbers, Array) else jax.device_put(numbers)


def shown(value: Any) -> str:
    """`value` as a message shows it."""
    try:
        return line(repr(value))
    except Exception:  # Python shows no whole number of more than 4300 digits
        return f"a {type(value).__name__}"


def line(text: str) -> str:
    """`text` on one line, and cut where it is long."""
    text = " ".join(text.split())
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


def number_array(value: Any, name: str, shape: tuple[int, ...] = ()) -> Float[Numbers, "..."]:
    """`value` as floating-point numbers of the given shape, of JAX's precision, finite where they are known."""
    kind = "a number" if shape == () else f"numbers of shape {shape}"
    try:
        array = value if isinstance(value, Array) else namespace(value).asarray(value)
        if not any(jnp.issubdtype(array.dtype, numbers) for numbers in (jnp.integer, jnp.floating)):
            raise TypeError
        dtype = array.dtype if array.dtype in (np.float32, np.float64) else float
        # Strong type: a weakly typed leaf would compile a second program for the same scene.
        with np.errstate(over="ignore"):  # said below
            array = array.astype(jax.dtypes.canonicalize_dtype(dtype))
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be {kind}, got {shown(value)}") from None
    if array.shape != shape:
        raise ValueError(f"{name} must be {kind}, got an array of shape {array.shape}")
    if is_known(array) and not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be finite, got {shown(value)}")
    return array


def number_list(value: Any, name: str) -> Float[Numbers, "k"]:
    """`value` as one or more numbers."""
    try:
        value = value if is_known(value) else jnp.asarray(value)  # a list of traced ones has no shape
        shape = np.shape(value)
    except ValueError:  # rows of several lengths
        raise TypeError(f"{name} must be a number or a list of them, got {shown(value)}") from None
    if len(shape) > 1 or shape == (0,):
        raise ValueError(f"{name} must be a number or a list of them, got an array of shape {shape}")
    return number_array(value, name, shape).reshape(-1)


def plain_number(name: str) -> Callable[[Any], float]:
    """Converts an option of a solver to a Python number, which takes the precision of the scene in a program."""

    def number(value: Any) -> float:
        number_array(value, name)
        return float(value)  # of Python's precision, whatever that of JAX is when it is made

    return number


def positive(value: Any, name: str) -> Float[Numbers, ""]:
    array = number_array(value, name)
    if is_known(array) and not float(array) > 0:
        raise ValueError(f"{name} must be positive, got {float(array):g}")
    return array


def not_negative(value: Any, name: str) -> Float[Numbers, ""]:
    array = number_array(value, name)
    if is_known(array) and not float(array) >= 0:
        raise ValueError(f"{name} must not be negative, got {float(array):g}")
    return array


def vector(value: Any, name: str) -> Float[Numbers, "3"]:
    return number_array(value, name, (3,))


# Where a second axis is not given: told by identity from one that is.
DEFAULT_D2 = (0.0, 1.0, 0.0)


def direction(value: Any, name: str) -> Float[Numbers, "3"]:
    """`value` as a unit vector."""
    array = vector(value, name)
    if is_known(array) and not np.any(array):
        raise ValueError(f"{name} must be a direction, got the zero vector")
    xp = namespace(array)
    array = xp.asarray(array)
    array = array / xp.max(xp.abs(array))  # squares of very small or large numbers would leave the range
    return array / xp.linalg.norm(array)


def rotation(value: Any, name: str) -> Float[Numbers, "3 3"]:
    """`value` as a right-handed orthonormal matrix."""
    array = number_array(value, name, (3, 3))
    if is_known(array):
        matrix = np.asarray(array)
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.max(np.abs(matrix.T @ matrix - np.eye(3)))
        if not error <= ROTATION_TOLERANCE:
            raise ValueError(
                f"{name} must be a rotation (columns d1, d2, t of unit length at right angles), "
                f"got one that is off by {error:.1e}; tangent and d2 make one, in Python by rodjax.frame(tangent, d2)"
            )
        if np.linalg.det(matrix) < 0:
            raise ValueError(f"{name} must be right-handed (d1 x d2 = t), got a left-handed frame")
    return array


def whole_number(value: Any, name: str, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be a whole number from {least} to {most}, got {shown(value)}")
    if not least <= value <= most:
        raise ValueError(f"{name} must be a whole number from {least} to {most}, got {shown(int(value))}")
    return int(value)


def one_of(value: Any, name: str, allowed: Sequence[str]) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{name} must be {' or '.join(map(repr, allowed))}, got {shown(value)}")


def instance(value: Any, name: str, kinds: type | Sequence[type]) -> None:
    kinds = (kinds,) if isinstance(kinds, type) else tuple(kinds)
    if not isinstance(value, kinds):
        allowed = " or ".join(kind.__name__ for kind in kinds)
        article = "an" if allowed[0] in "AEIOU" else "a"
        # Of what stands for several: how to take one of them.
        instead = getattr(type(value), "instead", None)
        given = shown(value) if instead is None else f"a {type(value).__name__}: {instead}"
        raise TypeError(f"{name} must be {article} {allowed}, got {given}")


def sequence(value: Any, name: str, kind: str) -> tuple[Any, ...]:
    if not isinstance(value, Iterable):
        raise TypeError(f"{name} must be a list of {kind}, got {shown(value)}")
    return tuple(value)


def file_path(value: Any, name: str, suffix: str = "") -> Path:
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name} must be the name of a file, got {shown(value)}")
    path = Path(value)
    if "\0" in str(path):
        raise ValueError(f"{name} must be the name of a file, without null characters, got {shown(str(path))}")
    if suffix and path.suffix != suffix:
        raise ValueError(f"{name} must end in {suffix}, got {str(path)!r}")
    return path
