"""Functions that a test evaluates a few times, without a compiler."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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


class Through:
    """told(solve(made(x))) and its derivatives: the solve by the library's own programs, the others as NumPy code.

    Eagerly each operation of them would be compiled by itself, for values, derivatives and transposes.
    """

    def __init__(self, made: Callable, solve: Callable, told: Callable):
        self.solve = solve
        self.made, self.told = by_numpy(made), by_numpy(told)
        self.made_change = by_numpy(lambda x, change: _moving(jax.jvp(made, (x,), (change,))[1]))
        self.told_change = by_numpy(lambda result, change: jax.jvp(told, (result,), (_whole(change, result),))[1])
        self.to_result = by_numpy(lambda result, weights: _moving(jax.vjp(told, result)[1](weights)[0]))
        self.to_x = by_numpy(lambda x, weights: jax.vjp(made, x)[1](_whole(weights, jax.eval_shape(made, x)))[0])

    def __call__(self, x: Any) -> np.ndarray:
        return np.asarray(self.told(self.solve(self.made(x))))

    def change(self, x: Any, change: Any) -> np.ndarray:
        """The derivative in a direction."""
        scene = self.made(x)
        scene_change = _whole(self.made_change(x, change), scene)
        result, result_change = jax.jvp(self.solve, (scene,), (scene_change,))
        return np.asarray(self.told_change(result, _moving(result_change)))

    def pulled(self, x: Any) -> Callable[[Any], np.ndarray]:
        """The transpose of the derivative."""
        scene = self.made(x)
        result, pulled = jax.vjp(self.solve, scene)

        def pull(weights: Any) -> np.ndarray:
            (of_scene,) = pulled(_whole(self.to_result(result, weights), result))
            return np.asarray(self.to_x(x, _moving(of_scene)))

        return pull


def _moving(change: Any) -> Any:
    """Without the changes of whole numbers, which have a type that no program takes."""
    return jax.tree.map(lambda leaf: None if leaf.dtype == jax.dtypes.float0 else leaf, change)


def _whole(change: Any, value: Any) -> Any:
    return jax.tree.map(
        lambda change, leaf: np.zeros(leaf.shape, jax.dtypes.float0) if change is None and leaf is not None else change,
        change,
        value,
        is_leaf=lambda change: change is None,
    )
