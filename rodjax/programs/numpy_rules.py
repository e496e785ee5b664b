"""How each operation of a program is written as NumPy code, for `numpy_code`.

A rule is given the function that is being written, an equation of the program, and the names of what the operation is
given; it gives the expression for the result, or a list of one for each.
"""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

from rodjax.programs import numpy_operations

Rule = Callable[..., Any]


def _call(function: str) -> Rule:
    return lambda body, equation, *given: f"{function}({', '.join(given)})"


def _infix(sign: str) -> Rule:
    return lambda body, equation, a, b: f"{a} {sign} {b}"


def _text(text: str) -> Rule:
    """With the name of what the operation is given in the place of {}."""
    return lambda body, equation, a: text.format(a)


def _operation(name: str, *params: str) -> Rule:
    """A function of `numpy_operations`, of the arrays and of parameters of the equation."""

    def rule(body: Any, equation: Any, *given: str) -> str:
        fixed = [body.writer.constant(equation.params[param]) for param in params]
        return f"op.{name}({', '.join([*given, *fixed])})"

    return rule


def _divide(body: Any, equation: Any, a: str, b: str) -> str:
    if np.issubdtype(equation.outvars[0].aval.dtype, np.floating):
        return f"{a} / {b}"
    return f"np.trunc({a} / {b}).astype({_dtype(body, equation)})"


def _dtype(body: Any, equation: Any) -> str:
    return body.writer.constant(np.dtype(equation.outvars[0].aval.dtype))


def _integer_power(body: Any, equation: Any, x: str) -> str:
    power = equation.params["y"]
    if 1 <= abs(power) <= 4:
        product = " * ".join([x] * abs(power))
        return product if power > 0 else f"1 / ({product})"
    return f"np.power({x}, {float(power)})" if power < 0 else f"np.power({x}, {power})"


def _convert(body: Any, equation: Any, x: str) -> str:
    old, new = equation.invars[0].aval.dtype, equation.params["new_dtype"]
    return x if old == new else f"{x}.astype({body.writer.constant(np.dtype(new))})"


def _select(body: Any, equation: Any, which: str, *cases: str) -> str:
    condition = equation.invars[0].aval
    if condition.dtype == bool and len(cases) == 2:
        if condition.shape:
            return f"np.where({which}, {cases[1]}, {cases[0]})"
        otherwise, case = (body.full(v) for v in equation.invars[1:])
        return f"{case} if {which} else {otherwise}"
    return f"np.choose({which}, ({', '.join(cases)},))"


def _round(body: Any, equation: Any, x: str) -> str:
    is_to_even = int(equation.params["rounding_method"]) == 1
    return f"np.rint({x})" if is_to_even else f"np.trunc({x} + np.copysign(0.5, {x}))"


def _reduce(ufunc: str) -> Rule:
    def rule(body: Any, equation: Any, x: str) -> str:
        if not equation.invars[0].aval.size:
            result = equation.outvars[0].aval
            return body.writer.constant(np.full(result.shape, _of_none(ufunc, np.dtype(result.dtype)), result.dtype))
        axes = body.writer.constant(tuple(equation.params["axes"]))
        # NumPy adds whole numbers up as longer ones.
        is_whole = equation.outvars[0].aval.dtype.kind in "iu"
        return f"{ufunc}.reduce({x}, {axes}, {_dtype(body, equation)})" if is_whole else f"{ufunc}.reduce({x}, {axes})"

    return rule


def _of_none(ufunc: str, kind: np.dtype) -> Any:
    """What a reduction of no numbers gives."""
    if ufunc not in ("np.maximum", "np.minimum"):
        return getattr(np, ufunc.removeprefix("np.")).identity
    if kind.kind == "f":
        return -np.inf if ufunc == "np.maximum" else np.inf
    limits = np.iinfo(kind) if kind.kind in "iu" else None
    least, most = (False, True) if limits is None else (limits.min, limits.max)
    return least if ufunc == "np.maximum" else most


def _extreme(function: str) -> Rule:
    def rule(body: Any, equation: Any, x: str) -> str:
        (axis,) = equation.params["axes"]
        return f"np.{function}({x}, {axis}).astype({_dtype(body, equation)})"

    return rule


def _reshape(body: Any, equation: Any, x: str, *_: str) -> str:
    shape = equation.outvars[0].aval.shape
    return x if shape == equation.invars[0].aval.shape else f"{x}.reshape({body.writer.constant(shape)})"


def _slice(body: Any, equation: Any, x: str) -> str:
    params = equation.params
    steps = params["strides"] or [1] * len(params["start_indices"])
    parts = []
    for first, last, step, n in zip(
        params["start_indices"], params["limit_indices"], steps, equation.invars[0].aval.shape, strict=True
    ):
        whole = first == 0 and last == n and step == 1
        parts.append(":" if whole else f"{first}:{last}" + (f":{step}" if step != 1 else ""))
    while parts and parts[-1] == ":":
        parts.pop()
    return f"{x}[{', '.join(parts)}]" if parts else x


def _reverse(body: Any, equation: Any, x: str) -> str:
    dimensions = equation.params["dimensions"]
    return f"{x}[{', '.join('::-1' if k in dimensions else ':' for k in range(max(dimensions) + 1))}]"


def _transpose(body: Any, equation: Any, x: str) -> str:
    return f"{x}.transpose({body.writer.constant(tuple(equation.params['permutation']))})"


def _concatenate(body: Any, equation: Any, *arrays: str) -> str:
    return f"np.concatenate(({', '.join(arrays)},), {equation.params['dimension']})"


def _stack(body: Any, equation: Any, *arrays: str) -> str:
    return f"op.stack(({', '.join(arrays)},), {equation.params['axis']})"


def _iota(body: Any, equation: Any) -> str:
    shape, dtype, axis = (equation.params[name] for name in ("shape", "dtype", "dimension"))
    line = np.arange(shape[axis], dtype=dtype).reshape([-1 if k == axis else 1 for k in range(len(shape))])
    return body.writer.constant(np.broadcast_to(line, shape).copy())


def _pad(body: Any, equation: Any, x: str, value: str) -> str:
    padding = numpy_operations.Padding(equation.invars[0].aval.shape, equation.params["padding_config"])
    return f"{body.writer.constant(padding)}({x}, {value})"


def _dynamic_slice(body: Any, equation: Any, x: str, *starts: str) -> str:
    return f"op.dynamic_slice({x}, ({', '.join(starts)},), {body.writer.constant(equation.params['slice_sizes'])})"


def _dynamic_update_slice(body: Any, equation: Any, x: str, update: str, *starts: str) -> str:
    return f"op.dynamic_update_slice({x}, {update}, ({', '.join(starts)},))"


MOVES = (jax.lax.GatherScatterMode.CLIP, jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def _gather(body: Any, equation: Any, x: str, starts: str) -> str:
    params, dims = equation.params, equation.params["dimension_numbers"]
    operand, where = (v.aval.shape for v in equation.invars)
    result = equation.outvars[0].aval
    moves = params["mode"] in MOVES
    missing = params["fill_value"]
    if missing is None:
        kind = np.dtype(result.dtype)
        missing = np.nan if kind.kind == "f" else True if kind.kind == "b" else _unlikely(kind)
    windows = numpy_operations.Windows(
        operand,
        params["slice_sizes"],
        where[:-1],
        dims.start_index_map,
        dims.collapsed_slice_dims,
        dims.operand_batching_dims,
        dims.start_indices_batching_dims,
        moves,
    )
    # Axes of the result, as they stand in what was picked: those of the starts, then those of a window.
    others = [axis for axis in range(result.ndim) if axis not in dims.offset_dims]
    order = tuple(int(k) for k in np.argsort([*others, *dims.offset_dims]))
    region = _region(body, windows, starts)
    if region is not None:
        fixed = ", ".join(map(body.writer.constant, (region, windows.shape, order)))
        return f"op.gather_at({x}, {fixed})"
    fixed = [windows, order, np.asarray(missing, result.dtype)]
    return f"op.gather({', '.join([x, starts, *map(body.writer.constant, fixed)])})"


def _region(body: Any, windows: numpy_operations.Windows, starts: str) -> numpy_operations.Region | None:
    """Where windows lie whose starts are constants of the program."""
    known = body.writer.space.get(starts)
    return None if known is None else windows.region(known)


def _unlikely(dtype: np.dtype) -> int:
    """The whole number that JAX takes where there is none."""
    limits = np.iinfo(dtype)
    return limits.max if dtype.kind == "u" else limits.min


def _scatter(combine: str) -> Rule:
    def rule(body: Any, equation: Any, x: str, starts: str, updates: str) -> str:
        dims = equation.params["dimension_numbers"]
        operand, where, new = (v.aval.shape for v in equation.invars)
        others = [axis for axis in range(len(new)) if axis not in dims.update_window_dims]
        left_out = {*dims.inserted_window_dims, *dims.operand_batching_dims}
        sizes = iter(new[axis] for axis in dims.update_window_dims)
        windows = numpy_operations.Windows(
            operand,
            [1 if axis in left_out else next(sizes) for axis in range(len(operand))],
            where[:-1],
            dims.scatter_dims_to_operand_dims,
            dims.inserted_window_dims,
            dims.operand_batching_dims,
            dims.scatter_indices_batching_dims,
            equation.params["mode"] in MOVES,
        )
        order = (*others, *dims.update_window_dims)
        region = _region(body, windows, starts)
        if region is not None:
            fixed = ", ".join(map(body.writer.constant, (region, order)))
            return f"op.scatter_at({x}, {updates}, {combine}, {fixed})"
        fixed = [windows, order]
        return f"op.scatter({', '.join([x, starts, updates, combine, *map(body.writer.constant, fixed)])})"

    return rule


def _dot_general(body: Any, equation: Any, a: str, b: str) -> str:
    shapes = tuple(v.aval.shape for v in equation.invars)
    plan = numpy_operations.Product(shapes, *equation.params["dimension_numbers"])
    product = f"{body.writer.constant(plan)}({a}, {b})"
    new = equation.params["preferred_element_type"]
    if new is None or new == equation.invars[0].aval.dtype:
        return product
    return f"{product}.astype({_dtype(body, equation)})"


def _accumulate(ufunc: str) -> Rule:
    def rule(body: Any, equation: Any, x: str) -> str:
        sums = f"op.accumulate({x}, {ufunc}, {equation.params['axis']}, {equation.params['reverse']})"
        return f"{sums}.astype({_dtype(body, equation)})" if equation.outvars[0].aval.dtype.kind in "iu" else sums

    return rule


def _sort(body: Any, equation: Any, *arrays: str) -> str:
    return f"op.sort(({', '.join(arrays)},), {equation.params['dimension']}, {equation.params['num_keys']})"


def _triangular_solve(body: Any, equation: Any, a: str, b: str) -> str:
    names = ("left_side", "lower", "transpose_a", "unit_diagonal")
    return f"op.triangular_solve({', '.join([a, b, *(repr(bool(equation.params[name])) for name in names)])})"


def _tile(body: Any, equation: Any, x: str) -> str:
    return f"np.tile({x}, {body.writer.constant(tuple(equation.params['reps']))})"


# --- inner programs --------------------------------------------------------------------------------------------------


def _inner(param: str) -> Rule:
    def rule(body: Any, equation: Any, *given: str) -> str:
        return f"{body.writer.function(equation.params[param])}({', '.join(given)})"

    return rule


def _bound(function: str, constants: Iterable[str]) -> str:
    """The function with its first arguments given."""
    constants = list(constants)
    return f"lambda *c: {function}({', '.join([*constants, '*c'])})" if constants else function


def _tuple(names: Iterable[str]) -> str:
    return "(" + "".join(f"{name}, " for name in names) + ")"


def _high_level(body: Any, equation: Any, *given: str) -> str:
    """An operation of JAX 0.12 that consists of others, such as `searchsorted`."""
    operation = equation.params["_prim"]

    def expanded(*leaves: Any) -> Any:
        return operation.expand(*jax.tree.unflatten(operation.in_tree, leaves))

    program = jax.make_jaxpr(expanded)(*(v.aval for v in equation.invars))
    return f"{body.writer.function(program)}({', '.join(given)})"


def _thin_svd(body: Any, equation: Any, x: str) -> str | None:
    """The one with vectors, and of these no more than singular values."""
    params = equation.params
    is_thin = params["compute_uv"] and not params["full_matrices"] and params.get("subset_by_index") is None
    return f"op.svd({x})" if is_thin else None


def of_another_package(body: Any, equation: Any, *given: str) -> str | None:
    """An operation of Equinox or Lineax, by those of JAX that it consists of; `None` for any other."""
    primitive = equation.primitive
    implementation = primitive.__dict__.get("impl")
    if getattr(implementation, "__module__", "").split(".")[0] not in ("equinox", "lineax"):
        return None

    def expanded(*leaves: Any) -> Any:
        return implementation(*leaves, **equation.params)

    program = jax.make_jaxpr(expanded)(*(v.aval for v in equation.invars))
    called = f"{body.writer.function(program)}({', '.join(given)})"
    return called if primitive.multiple_results else f"{called}[0]"


def _while(body: Any, equation: Any, *given: str) -> str:
    params = equation.params
    of_condition, of_body = params["cond_nconsts"], params["body_nconsts"]
    condition, step = body.writer.function(params["cond_jaxpr"]), body.writer.function(params["body_jaxpr"])
    condition = _bound(condition, given[:of_condition])
    step = _bound(step, given[of_condition : of_condition + of_body])
    return f"op.loop({condition}, {step}, {_tuple(given[of_condition + of_body :])})"


def _scan(body: Any, equation: Any, *given: str) -> str:
    params = equation.params
    if "ft_in" in params:  # from JAX 0.12 on
        constants, carry, _ = (len(list(part)) for part in params["ft_in"].unpack())
    else:
        constants, carry = params["num_consts"], params["num_carry"]
    step = params["jaxpr"]
    kinds = tuple((v.shape, np.dtype(v.dtype)) for v in step.out_avals[carry:])
    return "op.scan({}, {}, {}, {}, {}, {}, {})".format(
        body.writer.function(step),
        _tuple(given[:constants]),
        _tuple(given[constants : constants + carry]),
        _tuple(given[constants + carry :]),
        params["length"],
        params["reverse"],
        body.writer.constant(kinds),
    )


def _cond(body: Any, equation: Any, index: str, *given: str) -> str:
    branches = [body.writer.function(branch) for branch in equation.params["branches"]]
    most = len(branches) - 1
    return f"({', '.join(branches)},)[min(max(int({index}), 0), {most})]({', '.join(given)})"


def _platform_index(body: Any, equation: Any) -> str:
    """Which branch of `jax.lax.platform_dependent` is for a processor."""
    platforms = equation.params["platforms"]
    return str(next(k for k, names in enumerate(platforms) if names is None or "cpu" in names))


def _linear_solve(body: Any, equation: Any, *given: str) -> str:
    lengths, programs = equation.params["const_lengths"], equation.params["jaxprs"]
    before = lengths.matvec + lengths.vecmat
    constants = given[before : before + lengths.solve]
    right = given[before + lengths.solve + lengths.transpose_solve :]
    return f"{body.writer.function(programs.solve)}({', '.join([*constants, *right])})"


def _callback(body: Any, equation: Any, *given: str) -> str:
    """What runs outside of the program, such as the error that Equinox raises where a matrix is singular."""
    return f"{body.writer.constant(numpy_operations.Callback(equation.params['callback']))}({', '.join(given)})"


def _same(body: Any, equation: Any, *given: str) -> Any:
    return list(given) if equation.primitive.multiple_results else given[0]


# Special functions, and what SciPy calls them.
SPECIAL = {
    "erf": "erf",
    "erfc": "erfc",
    "erf_inv": "erfinv",
    "lgamma": "gammaln",
    "digamma": "psi",
    "igamma": "gammainc",
    "igammac": "gammaincc",
    "regularized_incomplete_beta": "betainc",
    "bessel_i0e": "i0e",
    "bessel_i1e": "i1e",
}

ELEMENTWISE: dict[str, Rule] = {
    **{name: _infix(sign) for name, sign in (("add", "+"), ("add_any", "+"), ("sub", "-"), ("mul", "*"))},
    **{name: _infix(sign) for name, sign in (("and", "&"), ("or", "|"), ("xor", "^"))},
    **{
        name: _infix(sign)
        for name, sign in (("eq", "=="), ("ne", "!="), ("lt", "<"), ("le", "<="), ("gt", ">"), ("ge", ">="))
    },
    **{
        name: _call(f"np.{name}")
        for name in ("sqrt", "cbrt", "square", "exp", "exp2", "log", "log1p", "expm1", "floor", "ceil", "sign")
    },
    **{name: _call(f"np.{name}") for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "nextafter")},
    **{f"a{name}": _call(f"np.arc{name}") for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "atan2": _call("np.arctan2"),
    "abs": _call("np.abs"),
    "max": _call("np.maximum"),
    "min": _call("np.minimum"),
    "rem": _call("np.fmod"),
    "pow": _call("np.power"),
    "is_finite": _call("np.isfinite"),
    "div": _divide,
    "neg": _text("-{}"),
    "not": _text("~{}"),
    "rsqrt": _text("1 / np.sqrt({})"),
    "logistic": _text("1 / (1 + np.exp(-{}))"),
    **{name: _call(f"op.special({of_scipy!r})") for name, of_scipy in SPECIAL.items()},
    "integer_pow": _integer_power,
    "convert_element_type": _convert,
    "select_n": _select,
    "clamp": lambda body, equation, low, x, high: f"np.minimum(np.maximum({x}, {low}), {high})",
    "round": _round,
    "lt_to": lambda body, equation, a, b: f"op.before_in_order({a}, {b}, False)",
    "le_to": lambda body, equation, a, b: f"op.before_in_order({a}, {b}, True)",
    "stop_gradient": lambda body, equation, x: x,
    "copy": lambda body, equation, x: x,
    "copy_p": lambda body, equation, x: x,
    "reduce_precision": lambda body, equation, x: x,
}

# Those whose code calls other functions of the program.
INNER: dict[str, Rule] = {
    "jit": _inner("jaxpr"),
    "pjit": _inner("jaxpr"),
    "closed_call": _inner("call_jaxpr"),
    "core_call": _inner("call_jaxpr"),
    "custom_jvp_call": _inner("call_jaxpr"),
    "custom_vjp_call": _inner("call_jaxpr"),
    "custom_vmap_call": _inner("call"),
    "checkpoint": _inner("jaxpr"),
    "remat2": _inner("jaxpr"),
    "call_hi_primitive": _high_level,
    "while": _while,
    "scan": _scan,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
    "pure_callback": _callback,
}

OTHERS: dict[str, Rule] = {
    "reduce_sum": _reduce("np.add"),
    "reduce_prod": _reduce("np.multiply"),
    "reduce_max": _reduce("np.maximum"),
    "reduce_min": _reduce("np.minimum"),
    "reduce_and": _reduce("np.logical_and"),
    "reduce_or": _reduce("np.logical_or"),
    "argmax": _extreme("argmax"),
    "argmin": _extreme("argmin"),
    "cumsum": _accumulate("np.add"),
    "cumprod": _accumulate("np.multiply"),
    "cummax": _accumulate("np.maximum"),
    "cummin": _accumulate("np.minimum"),
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "slice": _slice,
    "rev": _reverse,
    "transpose": _transpose,
    "concatenate": _concatenate,
    "stack": _stack,
    "unstack": _operation("unstack", "axis"),
    "split": _operation("split", "sizes", "axis"),
    "tile": _tile,
    "pad": _pad,
    "iota": _iota,
    "empty2": lambda body, equation: (
        f"np.empty({body.writer.constant(equation.outvars[0].aval.shape)}, {_dtype(body, equation)})"
    ),
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter": _scatter("None"),
    "scatter-add": _scatter("np.add"),
    "scatter-mul": _scatter("np.multiply"),
    "scatter-min": _scatter("np.minimum"),
    "scatter-max": _scatter("np.maximum"),
    "sort": _sort,
    "dot_general": _dot_general,
    "cholesky": lambda body, equation, x: f"op.cholesky({x})",
    "lu": lambda body, equation, x: f"op.lu({x})",
    "lu_pivots_to_permutation": _operation("permutation", "permutation_size"),
    "triangular_solve": _triangular_solve,
    "eigh": lambda body, equation, x: f"op.eigh({x}, {equation.params['lower']})",
    "svd": _thin_svd,
    "tridiagonal": lambda body, equation, x: f"op.tridiagonal({x})",
    "platform_index": _platform_index,
    "optimization_barrier": _same,
    "device_put": _same,
}
