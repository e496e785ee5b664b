"""Argument checks: each error names the argument, what was given and what is allowed.

Values are checked where they are known. Inside `jax.jit`, `vmap` or `grad` they are not, so that only shapes are.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float


def is_known(*values: Any) -> bool:
    """Whether every array in `values` has numbers that Python can read, that is: none is traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def number_array(value: Any, name: str, shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
    """`value` as a floating-point array of the given shape, finite where its numbers are known."""
    kind = "a number" if shape == () else f"numbers of shape {shape}"
    try:
        array = jnp.asarray(value)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            if not jnp.issubdtype(array.dtype, jnp.integer):
                raise TypeError
            array = array.astype(float)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be {kind}, got {value!r}") from None
    if array.shape != shape:
        raise ValueError(f"{name} must be {kind}, got an array of shape {array.shape}")
    if is_known(array) and not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be finite, got {value!r}")
    # Strong type: a weakly typed leaf would compile a second program for the same scene.
    return jax.lax.convert_element_type(array, array.dtype)


def positive(value: Any, name: str) -> Float[Array, ""]:
    array = number_array(value, name)
    if is_known(array) and not array > 0:
        raise ValueError(f"{name} must be positive, got {float(array):g}")
    return array


def not_negative(value: Any, name: str) -> Float[Array, ""]:
    array = number_array(value, name)
    if is_known(array) and not array >= 0:
        raise ValueError(f"{name} must not be negative, got {float(array):g}")
    return array


def vector(value: Any, name: str) -> Float[Array, "3"]:
    return number_array(value, name, (3,))


def direction(value: Any, name: str) -> Float[Array, "3"]:
    """`value` as a unit vector."""
    array = vector(value, name)
    if is_known(array) and not np.any(array):
        raise ValueError(f"{name} must be a direction, got the zero vector")
    return array / jnp.linalg.norm(array)


def rotation(value: Any, name: str) -> Float[Array, "3 3"]:
    """`value` as a right-handed orthonormal matrix."""
    array = number_array(value, name, (3, 3))
    if is_known(array):
        # Loose enough for frames typed in with 6 digits or held in float32, tight enough to catch a left-handed one.
        tolerance = 1e-5
        matrix = np.asarray(array)
        error = np.max(np.abs(matrix.T @ matrix - np.eye(3)))
        if error > tolerance:
            raise ValueError(
                f"{name} must be a rotation (columns d1, d2, t of unit length at right angles), "
                f"got one that is off by {error:.1e}; tangent and d2 make one, in Python by rodjax.frame(tangent, d2)"
            )
        if np.linalg.det(matrix) < 0:
            raise ValueError(f"{name} must be right-handed (d1 x d2 = t), got a left-handed frame")
    return array


def whole_number(value: Any, name: str, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be a whole number from {least} to {most}, got {value!r}")
    if not least <= value <= most:
        raise ValueError(f"{name} must be a whole number from {least} to {most}, got {value}")
    return int(value)


def instance(value: Any, name: str, kinds: type | Sequence[type]) -> None:
    kinds = (kinds,) if isinstance(kinds, type) else tuple(kinds)
    if not isinstance(value, kinds):
        allowed = " or ".join(kind.__name__ for kind in kinds)
        article = "an" if allowed[0] in "AEIOU" else "a"
        raise TypeError(f"{name} must be {article} {allowed}, got {value!r}")
