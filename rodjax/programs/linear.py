"""Functions that are linear in their last argument, of which derivatives and their transposes are made.

Beside `jax.grad` of a solve, called eagerly, JAX would compile what such a function becomes. As a primitive of its own
it runs like all programs of this package instead: as NumPy code at first, kept on disk, compiled where it is asked for
again.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rodjax.checks import is_known
from rodjax.programs.compilation import compiled
from rodjax.programs.numpy_rules import INNER
from rodjax.programs.parts import zeros

# What has been done to a function: ("map", the mapped axis of each leaf) or ("transpose", shapes and types of the
# leaves of the linear argument).
Steps = tuple[tuple[str, tuple], ...]
Kinds = tuple[tuple[tuple[int, ...], str], ...]

_linear = Primitive("rodjax_linear")
_linear.multiple_results = True


class _Linear:
    """A function as it stands in equations: of flat leaves, `count` of them fixed and the others linear."""

    def __init__(self, function: Callable, name: str):
        def apply(fixed: tuple, linear: tuple, steps: Steps) -> list[Any]:
            leaves, tree = jax.tree.flatten(fixed)
            of_linear = jax.tree.structure(fixed[0])
            count = len(leaves)

            def flat(*leaves: Any) -> list[Any]:
                fixed = jax.tree.unflatten(tree, leaves[:count])
                return jax.tree.leaves(function(*fixed, jax.tree.unflatten(of_linear, leaves[count:])))

            for what, how in steps:
                flat = jax.vmap(flat, in_axes=how) if what == "map" else _transposed(flat, count, how)
            return flat(*leaves, *linear)

        apply.__module__, apply.__qualname__ = function.__module__, name
        self.part = jax.jit(apply, static_argnames="steps")
        self.whole = compiled(apply, static_argnames=("steps",))


def _transposed(flat: Callable, count: int, kinds: Kinds) -> Callable:
    def transpose(*leaves: Any) -> list[Any]:
        linear = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in kinds]
        return list(jax.linear_transpose(lambda *linear: flat(*leaves[:count], *linear), *linear)(list(leaves[count:])))

    return transpose


def linear(function: Callable) -> Callable:
    """A function (first, ..., last) that is linear in `last`, of the structure of `first`, and gives the change of the
    argument before it: the same structure, with `None` for what has no derivative.
    """
    program = _Linear(function, function.__qualname__)
    inside = jax.jit(function)

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        *fixed, last = args
        if not is_known(fixed):  # in a program that is being traced, or beside derivatives of derivatives
            return inside(*args)
        leaves, tree = jax.tree.flatten(tuple(fixed))
        like = jax.tree.map(lambda leaf: leaf if jnp.issubdtype(leaf.dtype, jnp.inexact) else None, fixed[-1])
        kinds = tuple((leaf.shape, leaf.dtype.name) for leaf in jax.tree.leaves(like))
        results = _linear.bind(*leaves, *jax.tree.leaves(last), program=program, tree=tree, steps=(), kinds=kinds)
        return jax.tree.unflatten(jax.tree.structure(like), results)

    return call


def _arguments(leaves: Sequence[Any], tree: Any) -> tuple[Any, tuple]:
    count = tree.num_leaves
    return jax.tree.unflatten(tree, leaves[:count]), tuple(leaves[count:])


@_linear.def_impl
def _(*leaves: Any, program: _Linear, tree: Any, steps: Steps, kinds: Kinds) -> list[Any]:
    return program.whole(*_arguments(leaves, tree), steps=steps)


@_linear.def_abstract_eval
def _(*leaves: Any, program: _Linear, tree: Any, steps: Steps, kinds: Kinds) -> list[Any]:
    return [ShapedArray(shape, np.dtype(dtype)) for shape, dtype in kinds]


def _inside(*leaves: Any, program: _Linear, tree: Any, steps: Steps, kinds: Kinds) -> list[Any]:
    """As a part of another program."""
    return program.part(*_arguments(leaves, tree), steps=steps)


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, tree: Any, **params: Any) -> tuple[list[Any], list[Any]]:
    count = tree.num_leaves
    if all(type(tangent) is ad.Zero for tangent in tangents[:count]):
        changes = map(ad.instantiate_zeros, tangents[count:])
        return (
            _linear.bind(*primals, tree=tree, **params),
            _linear.bind(*primals[:count], *changes, tree=tree, **params),
        )
    inside = functools.partial(_inside, tree=tree, **params)
    return jax.jvp(inside, tuple(primals), tuple(map(ad.instantiate_zeros, tangents)))


def _transpose(
    cotangents: Sequence[Any], *leaves: Any, program: _Linear, tree: Any, steps: Steps, kinds: Kinds
) -> list[Any]:
    count = tree.num_leaves
    given = tuple((leaf.aval.shape, leaf.aval.dtype.name) for leaf in leaves[count:])
    cotangents = [zeros(found.aval) if type(found) is ad.Zero else found for found in cotangents]
    steps = (*steps, ("transpose", given))
    changes = _linear.bind(*leaves[:count], *cotangents, program=program, tree=tree, steps=steps, kinds=given)
    return [None] * count + changes


def _batch(
    leaves: Sequence[Any], axes: Sequence[Any], *, program: _Linear, tree: Any, steps: Steps, kinds: Kinds
) -> tuple[list[Any], list[int]]:
    axes = tuple(axis for axis in axes)
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    kinds = tuple(((size, *shape), dtype) for shape, dtype in kinds)
    steps = (*steps, ("map", axes))
    results = _linear.bind(*leaves, program=program, tree=tree, steps=steps, kinds=kinds)
    return results, [0] * len(results)


ad.primitive_jvps[_linear] = _jvp
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batch
mlir.register_lowering(_linear, mlir.lower_fun(_inside, multiple_results=True))


def _in_numpy(body: Any, equation: Any, *given: str) -> str:
    kinds = [variable.aval for variable in equation.invars]
    program = jax.make_jaxpr(functools.partial(_inside, **equation.params))(*kinds)
    return f"{body.writer.function(program)}({', '.join(given)})"


INNER[_linear.name] = _in_numpy
