"""Parts of programs that JAX traces once.

Tracing takes the most time of a first answer, and a solve, its result, the estimate of its error and its derivatives
share most of what they do. JAX traces a part once, also its derivatives and what `vmap` makes of it, and writes a call
of it where it stands in a program; XLA puts it back in line.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
from jax.extend.core import get_opaque_trace_state

# So many traces are kept: a described solve has 7 (plain) to 27 (curved) of one structure and mesh.
MOST = 500
F = TypeVar("F", bound=Callable)
_OUTSIDE = get_opaque_trace_state()


def is_outside() -> bool:
    """Whether nothing is being traced or differentiated."""
    return get_opaque_trace_state() == _OUTSIDE


class _Part:
    """A function as it stands in programs; `count`: of the traces of all parts."""

    count = 0

    def __init__(self, function: Callable):
        self.function = function
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

        return jax.jit(traced)


_parts: list[_Part] = []


def traced_once(function: F) -> F:
    """A function of arrays and structures of arrays as a part of programs; by itself it is called as it is."""
    part = _Part(function)
    _parts.append(part)

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        return function(*args) if is_outside() else part(*args)

    return cast(F, call)
