"""A program of JAX's as Python code that calls NumPy.

XLA takes seconds to compile a solve, which then runs in a fraction of a millisecond. The same program as NumPy code is
there as soon as it is traced, and takes some ten milliseconds: what a first answer needs. It is written down from the
program itself (a jaxpr), so that the two agree to rounding. It can be kept on disk: another process then need not even
trace the program.

Each equation becomes one line, an inner program one function. What a name holds is given up at its last use, as names
are used again. An array that is only broadcast stays as it is until an operation needs it whole, as NumPy broadcasts.
"""

import marshal
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxprs_in_params

from rodjax.programs import numpy_operations
from rodjax.programs.numpy_rules import ELEMENTWISE, INNER, OTHERS, of_another_package

Values = tuple[Any, ...]
# So many numbers of a result of constants are made when the program is written, and not each time it runs.
LARGEST_CONSTANT = 4096


class NotInNumpyError(Exception):
    """An operation for which there is no NumPy code; the message tells which."""


class AnswerCode:
    """A program as NumPy code: called with the leaves of its arguments it gives what the program gives.

    `kinds`: types of the leaves; `out_tree`: structure of the result; `code` and `constants` are all that it runs;
    `operations`: how many the program has for a compiler, which puts inner ones in line.
    """

    def __init__(
        self, code: bytes, constants: Sequence[Any], kinds: Sequence[np.dtype], out_tree: Any, operations: int
    ):
        self.code, self.constants, self.kinds, self.out_tree = code, constants, kinds, out_tree
        self.operations = operations
        space = {"np": np, "op": numpy_operations, **{f"k{index}": value for index, value in enumerate(constants)}}
        exec(marshal.loads(code), space)
        self._run: Callable[..., Values] = space["main"]

    @staticmethod
    def of(traced: Any) -> "AnswerCode":
        """Of what `jax.jit(...).trace(...)` gives. Raises `NotInNumpyError`."""
        program = traced.jaxpr
        writer = _Writer()
        try:
            writer.function(program, "main")
        except (AttributeError, KeyError) as error:
            raise NotInNumpyError(f"an operation as this version of JAX has it ({error!r})") from error
        code = compile("\n".join(writer.lines), "<rodjax program>", "exec")
        kinds = [np.dtype(kind.dtype) for kind in program.in_avals]
        tree = jax.tree.structure(traced.out_info)
        return AnswerCode(marshal.dumps(code), writer.constants, kinds, tree, operation_count(program))

    def __call__(self, leaves: Sequence[Any], seconds: float) -> Any:
        """Raises `TookTooLong` where loops take more than so many seconds."""
        given = [np.asarray(leaf, kind)[()] for leaf, kind in zip(leaves, self.kinds, strict=True)]
        with np.errstate(all="ignore"), numpy_operations.limited(seconds):
            results = self._run(*given)
        return jax.tree.unflatten(self.out_tree, jax.device_put(list(results)))

    def packed(self) -> tuple[Any, ...]:
        """To be written to a file."""
        return self.code, self.constants, self.kinds, skeleton(self.out_tree), self.operations

    @staticmethod
    def unpacked(
        code: bytes, constants: Sequence[Any], kinds: Sequence[np.dtype], out: Any, operations: int
    ) -> "AnswerCode":
        return AnswerCode(code, constants, kinds, jax.tree.structure(out), operations)


def skeleton(tree: Any) -> Any:
    """What has a structure, which itself cannot be written to a file."""
    return jax.tree.unflatten(tree, range(tree.num_leaves))


def operation_count(program: ClosedJaxpr | Jaxpr, known: dict[int, int] | None = None) -> int:
    """Of a program, those of inner ones as often as they are called; `known`: of programs, by their addresses."""
    known = {} if known is None else known
    if id(program) not in known:
        jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
        known[id(program)] = sum(
            sum(operation_count(inner, known) for inner in jaxprs_in_params(equation.params)) or 1
            for equation in jaxpr.eqns
        )
    return known[id(program)]


class _Writer:
    """Collects the functions of a program and its constants."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.constants: list[Any] = []
        self.space: dict[str, Any] = {"np": np, "op": numpy_operations}
        self._names_of_constants: dict[Any, str] = {}
        self._functions: dict[int, tuple[str, Any]] = {}

    def constant(self, value: Any) -> str:
        """The name of a value that is fixed when the program is written."""
        if isinstance(value, bool | int | str | type(None)):
            return repr(value)
        key: Any = value
        if isinstance(value, np.ndarray | np.generic):
            value = np.asarray(value)
            if not value.ndim:
                value = value[()]
            key = value.dtype.str, value.shape, value.tobytes()
        if key not in self._names_of_constants:
            name = self._names_of_constants[key] = f"k{len(self.constants)}"
            self.constants.append(value)
            self.space[name] = value
        return self._names_of_constants[key]

    def function(self, program: ClosedJaxpr | Jaxpr, name: str | None = None) -> str:
        """The name of the function that an inner program becomes."""
        key = id(program)
        if key not in self._functions:
            name = name or f"f{len(self._functions)}"
            self._functions[key] = name, program  # kept alive, as the key is its address
            self.lines += _Body(self, program, name).lines
        return self._functions[key][0]


class _Body:
    """One function: a program without inner ones."""

    def __init__(self, writer: _Writer, program: ClosedJaxpr | Jaxpr, name: str):
        self.writer = writer
        self.names: dict[Any, str] = {}
        self.partial: set[Any] = set()  # variables whose array only broadcasts to their shape
        self.free: list[str] = []
        self.count = 0
        jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
        constants = program.consts if isinstance(program, ClosedJaxpr) else []
        self.lines = [f"def {name}({', '.join(self.new(v) for v in jaxpr.invars)}):"]
        for variable, value in zip(jaxpr.constvars, constants, strict=True):
            self.names[variable] = writer.constant(np.asarray(value))
        last_use = {v: k for k, e in enumerate(jaxpr.eqns) for v in e.invars if not isinstance(v, Literal)}
        kept = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
        for k, equation in enumerate(jaxpr.eqns):
            self.equation(equation)
            done = {v for v in equation.invars if not isinstance(v, Literal) and last_use[v] == k and v not in kept}
            unused = {v for v in equation.outvars if v not in last_use and v not in kept}
            for variable in done | unused:
                self.release(variable)
        results = "".join(f"{self.full(v)}, " for v in jaxpr.outvars)
        self.lines.append(f" return ({results})")

    def new(self, variable: Any) -> str:
        if self.free:
            name = self.free.pop()
        else:
            name, self.count = f"v{self.count}", self.count + 1
        self.names[variable] = name
        return name

    def release(self, variable: Any) -> None:
        name = self.names.pop(variable)
        if name.startswith("v"):  # not a constant
            self.free.append(name)

    def any(self, variable: Any) -> str:
        """An array that broadcasts to the variable's shape."""
        if isinstance(variable, Literal):  # a number
            return self.writer.constant(np.asarray(variable.val, _kind(variable).dtype))
        return self.names[variable]

    def full(self, variable: Any) -> str:
        """An array of the variable's shape."""
        name = self.any(variable)
        if self.is_partial(variable):
            self.partial.discard(variable)
            self.lines.append(f" {name} = op.filled({name}, {self.writer.constant(_kind(variable).shape)})")
        return name

    def is_partial(self, variable: Any) -> bool:
        return not isinstance(variable, Literal) and variable in self.partial

    def equation(self, equation: Any) -> None:
        primitive = equation.primitive.name
        results = equation.outvars
        if primitive in ELEMENTWISE:
            given = [self.any(v) for v in equation.invars]
            expression = ELEMENTWISE[primitive](self, equation, *given)
            if all(map(_is_constant, given)) and self.fold(equation, expression):
                return
            shape = results[0].aval.shape
            if shape and not any(v.aval.shape == shape and not self.is_partial(v) for v in equation.invars):
                self.partial.add(results[0])
            self.lines.append(f" {self.new(results[0])} = {expression}")
            return
        if primitive == "broadcast_in_dim":
            return self.broadcast(equation)
        rule = OTHERS.get(primitive) or INNER.get(primitive) or of_another_package
        given = [self.full(v) for v in equation.invars]
        expression = rule(self, equation, *given)
        if expression is None:
            raise NotInNumpyError(primitive)
        if primitive in OTHERS and all(map(_is_constant, given)) and self.fold(equation, expression):
            return
        targets = ", ".join(self.new(v) for v in results)
        if isinstance(expression, str):
            if equation.primitive.multiple_results:
                targets += ","
            self.lines.append(f" {targets} = {expression}" if results else f" {expression}")
        else:  # one expression for each result
            self.lines.append(f" {targets}, = {', '.join(expression)}," if results else " pass")

    def fold(self, equation: Any, expression: Any) -> bool:
        """Whether a result is a constant itself: one of constants that does not take much room."""
        if equation.primitive.multiple_results or equation.outvars[0].aval.size > LARGEST_CONSTANT:
            return False
        with np.errstate(all="ignore"):
            value = eval(expression, self.writer.space)
        (result,) = equation.outvars
        self.names[result] = self.writer.constant(np.broadcast_to(value, result.aval.shape))
        return True

    def broadcast(self, equation: Any) -> None:
        (given, *_), (result,) = equation.invars, equation.outvars
        shape = equation.params["shape"]
        axes = [1] * len(shape)
        for axis, size in zip(equation.params["broadcast_dimensions"], given.aval.shape, strict=True):
            axes[axis] = size
        # A number broadcasts to any shape.
        name = self.full(given) if given.aval.shape else self.any(given)
        is_same = tuple(axes) == given.aval.shape or not given.aval.shape
        expression = name if is_same else f"{name}.reshape({self.writer.constant(tuple(axes))})"
        if _is_constant(name) and self.fold(equation, expression):
            return
        if tuple(axes) != tuple(shape) or (shape and not given.aval.shape):
            self.partial.add(result)
        self.lines.append(f" {self.new(result)} = {expression}")


def _kind(variable: Any) -> Any:
    """Shape and type."""
    return variable.aval


def _is_constant(name: str) -> bool:
    return name.startswith("k")
