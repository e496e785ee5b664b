"""Functions that a test evaluates a few times, without a compiler."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rodjax.checks import is_known
from rodjax.programs.answers import ANSWERS
from rodjax.programs.numpy_code import AnswerCode


def by_numpy(function: Callable) -> Callable:
    """`jax.jit(function)`, run as NumPy code as the library's own programs are at first; options are static.

    Compiling takes seconds for what runs once, and of a function that is called eagerly each operation is compiled by
    itself. With `RODJAX_TESTS_OPTIMIZED=1`, in `numpy_first(False)` and as a part of something else it is compiled.
    """
    codes: dict[Any, AnswerCode] = {}

    @functools.wraps(function)
    def call(*args: Any, **static: Any) -> Any:
        # A function of its own, with which JAX forgets what it traced; and methods of modules have no hash.
        program = jax.jit(lambda *args: jax.tree.map(_strong, function(*args, **static)))
        if not ANSWERS.by_numpy or not is_known(args):
            return program(*args)
        leaves, tree = jax.tree.flatten(args)
        key = tree, *map(jax.typeof, leaves), *static.items()
        if key not in codes:
            codes[key] = AnswerCode.of(program.trace(*args))
        return codes[key](leaves, math.inf)

    return call


def _strong(leaf: Any) -> jax.Array:
    """Of a type that does not yield to others, as NumPy code gives it."""
    return jnp.asarray(leaf, jnp.result_type(leaf))
