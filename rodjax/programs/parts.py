"""Parts of programs that JAX traces once.

Tracing takes the most time of a first answer, and a solve, its result, the estimate of its error and its derivatives
share most of what they do. JAX traces a part once, also its derivatives and what `vmap` makes of it, and writes a call
of it where it stands in a program; XLA puts it back in line.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state

from rodjax.checks import is_known

# So many traces are kept: a described solve has 7 (plain) to 27 (curved) of one structure and mesh.
MOST = 500
F = TypeVar("F", bound=Callable)
_OUTSIDE = get_opaque_trace_state()


def is_outside() -> bool:
    """Whether nothing is being traced or differentiated."""
    return get_opaque_trace_state() == _OUTSIDE


def is_staged() -> bool:
    """Whether what is called becomes a part of a program, and not only of derivatives."""
    return not is_outside() and not is_known(jax.device_put(np.zeros(())))


def zeros(like: Any) -> jax.Array:
    """As `jnp.zeros_like`, for which JAX compiles a program for each shape where it is part of none."""
    shape, dtype = like.shape, like.dtype
    return jnp.zeros(shape, dtype) if is_staged() else jax.device_put(np.zeros(shape, dtype))


class _Part:
    """A function as it stands in programs; `count`: of the traces of all parts."""

    count = 0

    def __init__(self, function: Callable, static: str | tuple[str, ...]):
        self.function, self.static = function, static
        self.inside: Any = None

    def __call__(self, *args: Any) -> Any:
        if _Part.count >= MOST:
            _Part.count = 0
            for part in _parts:
                part.inside = None
        inside = self.inside  # which another thread may drop
        if inside is None:
            inside = self.inside = self._anew()
        return inside(*args)

    def _anew(self) -> Any:
        """By a function of its own, with which JAX forgets what it traced."""

        @functools.wraps(self.function)
        def traced(*args: Any) -> Any:
            _Part.count += 1
            return self.function(*args)

        return jax.jit(traced, static_argnames=self.static)


_parts: list[_Part] = []


def traced_once(function: F, static: str | tuple[str, ...] = ()) -> F:
    """A function of arrays and structures of arrays as a part of programs; by itself it is called as it is.

    `static`: names of arguments that are none, and may be compared.
    """
    part = _Part(function, static)
    _parts.append(part)

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        return function(*args) if is_outside() else part(*args)

    return cast(F, call)
