"""Programs as NumPy code: each operation beside JAX's own, and when such code runs in the place of an executable."""

import threading
import time

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax import lax

import rodjax as rj
from rodjax.linalg.small_matrices import inverse_matrix, negative_count
from rodjax.programs import answers, compilation, kept, numpy_operations
from rodjax.programs.answers import ANSWERS, one_answer
from rodjax.programs.compilation import compiled
from rodjax.programs.linear import linear
from rodjax.programs.numpy_code import AnswerCode, NotInNumpyError
from rodjax.programs.numpy_rules import ELEMENTWISE
from rodjax.programs.tasks import in_order

X = np.random.default_rng(0).normal(size=(4, 5))
POSITIVE = X[:, :4] @ X[:, :4].T + np.eye(4)
STACK = np.stack([POSITIVE, 2 * POSITIVE])
PLACES = np.array([3, 0, 7, -9])
SAME_ORDER = dict(num_keys=2, dimension=0)


def at_run_time(places, x):
    """The same places, but no constant of the program."""
    return places + jnp.argmax(x[0] * 0)


def windows(mode, starts_of=lambda starts, x: starts):
    """Gathers of windows, some beyond the array."""
    dims = lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(0,), start_index_map=(0, 1))
    starts = np.array([[0, 1], [3, 4], [5, 0], [1, -2]])
    return lambda x: lax.gather(x, starts_of(starts, x), dims, slice_sizes=(1, 3), mode=mode)


def decayed(rate):
    """y at 1 of y' = -rate y; loops and branches of Equinox."""
    term, controller = diffrax.ODETerm(lambda t, y, args: -rate * y), diffrax.PIDController(rtol=1e-9, atol=1e-9)
    how = {"dt0": 0.1, "y0": jnp.ones(()), "stepsize_controller": controller, "adjoint": diffrax.ForwardMode()}
    return diffrax.diffeqsolve(term, diffrax.Tsit5(), t0=0.0, t1=1.0, throw=False, max_steps=200, **how).ys


OPERATIONS = {
    "arithmetic": lambda x: (x + 2 * x**3 - x / 3) ** -2 + jnp.sign(x) * abs(x) ** 0.5 - (-x),
    "functions": lambda x: [getattr(jnp, f)(x) for f in ("sin", "cos", "tan", "arctan", "exp", "log", "sqrt", "tanh")],
    "other functions": lambda x: [
        *[getattr(jnp, f)(x) for f in ("arcsinh", "sinh", "cosh", "cbrt", "exp2", "expm1", "square")],
        *[getattr(jnp, f)(jnp.tanh(x)) for f in ("arcsin", "arccos", "arctanh", "log1p")],
        jnp.arccosh(1 + x**2),
        lax.rsqrt(1 + x**2),
        jax.nn.sigmoid(x),
        lax.reduce_precision(x, 11, 52),
        (x > 0) ^ (x <= 1),
    ],
    "special functions": lambda x: [
        *[getattr(jax.scipy.special, f)(x) for f in ("erf", "erfc", "i0e", "i1e")],
        jax.scipy.special.erfinv(jnp.tanh(x)),
        *[getattr(jax.scipy.special, f)(1 + x**2) for f in ("gammaln", "digamma")],
        *[getattr(jax.scipy.special, f)(1 + x**2, 2 + x) for f in ("gammainc", "gammaincc")],
        jax.scipy.special.betainc(1 + x**2, 2.0, 0.3),
    ],
    "two arrays": lambda x: [f(x, x[::-1]) for f in (jnp.arctan2, jnp.maximum, jnp.minimum, jnp.fmod, jnp.nextafter)],
    "whole numbers": lambda x: [
        (7 * x).astype(jnp.int32) // 3,
        (7 * x).astype(jnp.int32) % 3,
        jnp.sum((7 * x).astype(jnp.int32), 0),
        lax.div((7 * x).astype(jnp.int32), jnp.int32(2)),
        jnp.cumsum((7 * x).astype(jnp.int32), 1),
    ],
    "truth": lambda x: [x > 0, (x > 0) & ~(x < 1) | (x == 0), jnp.any(x > 1, 0), jnp.all(x > 1), jnp.isfinite(x / 0)],
    "rounding": lambda x: [
        jnp.round(3 * x),
        jnp.floor(x),
        jnp.ceil(x),
        lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO),
    ],
    "choices": lambda x: [
        jnp.where(x > 0, x, 0.0),
        jnp.where(x[0, 0] > 0, x, -x),
        jnp.clip(x, -0.5, 0.5),
        lax.select_n((abs(2 * x)).astype(jnp.int32) % 3, x, 2 * x, 3 * x),
    ],
    "sums": lambda x: [x.sum(), x.sum((0, 1)), x.prod(0), x.max(1), x.min(), jnp.argmax(x, 0), jnp.argmin(x, 1)],
    "sums of none": lambda x: (
        [f(x[:0], 0) for f in (jnp.sum, jnp.prod, jnp.any, jnp.all)]
        + [lax.reduce_max(x[:0], (0,)), lax.reduce_min((7 * x[:0]).astype(jnp.int32), (0,))]
    ),
    "running sums": lambda x: [jnp.cumsum(x, 0), lax.cumsum(x, 1, reverse=True), lax.cummax(x, 0), jnp.cumprod(x, 1)],
    "shapes": lambda x: [x.T, x.reshape(2, 10), x[::-1, 1:4:2], x[None, :, None], jnp.tile(x, (2, 1)), x.ravel()[3]],
    "parts": lambda x: [*jnp.unstack(x), *jnp.unstack(x, axis=1), *jnp.split(x, [1, 3], axis=1)],
    "joined": lambda x: [jnp.concatenate([x, 2 * x], 1), jnp.stack([x, -x], 1), jnp.stack([x[0, 0], x[1, 1]])],
    "padding": lambda x: [
        lax.pad(x, 7.0, [(1, 2, 0), (0, 0, 1)]),
        lax.pad(x, 7.0, [(-1, -2, 0), (2, -1, 2)]),
        lax.pad(x, 7.0, [(-3, 1, 2), (-4, -1, 0)]),
        lax.pad(x, 7.0, [(-2, -2, 0), (0, 0, 0)]),
    ],
    "broadcasts": lambda x: [
        jnp.zeros((2, 3)) + 1.0,
        jnp.broadcast_to(x[0], (3, 5)) * 2.0,
        jnp.ones((5, 4)).sum(0),
        jnp.broadcast_to(x[:, :1], (4, 5)) @ x.T,
        lax.mul(x[:1], x),
    ],
    "places": lambda x: [
        x[PLACES],
        x[PLACES, 2],
        x.at[PLACES].get(mode="fill"),
        jnp.take_along_axis(x, PLACES[:, None], 1),
    ],
    "places at run time": lambda x: [
        jax.lax.cond(x[0, 0] > x[0, 1], lambda: x[:1, :1].at[:1, :1].set(x[1:2, :1]), lambda: x[:1, :1]),
        jax.lax.cond(x[0, 0] > x[0, 1], lambda: x[:1, :1], lambda: x[:1, :1].at[:1, :1].set(x[1:2, :1])),
        x[at_run_time(PLACES, x)],
        x[at_run_time(PLACES, x), 2],
        x.at[at_run_time(PLACES, x)].get(mode="fill"),
        *[windows(mode, at_run_time)(x) for mode in ("clip", "fill")],
        x.at[at_run_time(PLACES, x), 1].add(x[:, 0]),
        x.at[at_run_time(PLACES, x)].multiply(2.0, mode="drop"),
        x.at[at_run_time(np.array([1, 1]), x), 2].max(0.3),
    ],
    "slices at run time": lambda x: [
        lax.dynamic_slice(x, (jnp.argmax(x[:, 0]), 3), (2, 3)),
        lax.dynamic_update_slice(x, x[:2, :2], (jnp.argmax(x[:, 0]), 3)),
        jax.vmap(lambda row, k: row[k])(x, jnp.arange(4)),
        jax.vmap(lambda row, k: lax.dynamic_slice(row, (k,), (3,)))(x, jnp.arange(4)),
    ],
    "windows": lambda x: [windows(mode)(x) for mode in ("clip", "fill")],
    "updates": lambda x: [
        x.at[1].set(0.0),
        x.at[1, 2].add(3.0),
        x.at[1:3, 0].add(x[0, :2]),
        x.at[:, 2:3].set(x[:, :1]),
        x.at[np.array([1, 1, 2]), 0].add(x[:3, 1]),
        x.at[PLACES, 1].add(x[:, 0]),
        x.at[PLACES].multiply(2.0, mode="drop"),
        x.at[jnp.array([1, 1]), 2].max(0.3),
        x.at[1:3, ::2].min(0.0),
        jax.vmap(lambda row, k: row.at[k].set(9.0))(x, jnp.arange(4)),
    ],
    "order": lambda x: [
        jnp.sort(x, 0),
        jnp.argsort(x, 1),
        lax.sort((jnp.round(x), x, 2 * x), **SAME_ORDER),
        jnp.searchsorted(jnp.sort(x[0]), x[1]),
        jnp.searchsorted(jnp.sort(x[0]), x[1], side="right", method="sort"),
    ],
    "products": lambda x: [
        x @ x.T,
        jnp.einsum("ij,kj->ik", x, x),
        jnp.einsum("bij,bjk->bik", STACK, STACK),
        jnp.tensordot(STACK, STACK, ((2,), (1,))),
        jnp.einsum("bij,bkj->kbi", STACK, STACK),
        x[0] @ x[1],
        jnp.zeros((0, 4)) @ POSITIVE,
    ],
    "matrices": lambda x: [
        jnp.linalg.solve(POSITIVE + x[0, 0], x),
        jnp.linalg.inv(STACK),
        jnp.linalg.det(POSITIVE),
        jnp.linalg.cholesky(STACK),
        jnp.linalg.cholesky(-POSITIVE),
        jnp.linalg.eigvalsh(STACK),
        jnp.linalg.svd(x, full_matrices=False)[1],
        jnp.linalg.pinv(jnp.stack([x, x / 0]), rtol=1e-10),
        negative_count(STACK - jnp.mean(STACK)),
        *[inverse_matrix(matrix) for matrix in (POSITIVE + x[0, 0], STACK, STACK[:0])],
        jax.vmap(inverse_matrix, in_axes=2)(jnp.moveaxis(STACK, 0, 2)),
        jax.vmap(negative_count, in_axes=3)((STACK - jnp.mean(STACK))[:, :, :, None]),
        jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(POSITIVE), True), x),
        *[
            lax.linalg.triangular_solve(POSITIVE, x if left else x.T, left_side=left, lower=lower, transpose_a=flip)
            for left in (True, False)
            for lower in (True, False)
            for flip in (True, False)
        ],
        lax.linalg.triangular_solve(POSITIVE, x, left_side=True, lower=True, unit_diagonal=True),
    ],
    "loops": lambda x: [
        lax.while_loop(lambda c: jnp.sum(c) < 50, lambda c: c + abs(x), x),
        lax.fori_loop(0, 5, lambda k, c: c * 0.5 + k, x),
        jax.vmap(lambda row: lax.while_loop(lambda c: c[0] < 3, lambda c: c + 1, row))(x),
        lax.scan(lambda c, row: (c + row, c * row), x[0], x),
        lax.scan(lambda c, row: (c + row, None), x[0], x, reverse=True),
        lax.map(lambda row: row.sum(), x, batch_size=3),
    ],
    "branches": lambda x: [
        lax.cond(x[0, 0] > 0, lambda: x, lambda: 2 * x),
        lax.switch(jnp.argmax(x[0]), [lambda: x, lambda: -x, lambda: x + 1]),
    ],
    "derivatives": lambda x: [
        jax.grad(lambda x: jnp.sum(jnp.linalg.solve(POSITIVE, x) ** 2))(x),
        jax.vjp(lambda x: lax.scan(lambda c, row: (jnp.sin(c) + row, c), x[0], x), x)[1]((x[0], x)),
        jax.jit(lambda x: jax.jvp(jax.nn.relu, (x,), (x,)))(x),
        jax.grad(lambda x: jnp.sum(jax.checkpoint(jax.nn.silu)(x)))(x),
    ],
    "kept apart": lambda x: lax.optimization_barrier((x, 2 * x)),
    "other packages": lambda x: [
        lx.linear_solve(lx.MatrixLinearOperator(jnp.asarray(POSITIVE)), x[:, 0], throw=False).value,
        jax.vmap(decayed)(x[0]),
    ],
    "functions of Python's": lambda x: [
        jax.pure_callback(lambda x: np.sort(x), jax.ShapeDtypeStruct(x.shape, x.dtype), x),
        lx.linear_solve(lx.MatrixLinearOperator(jnp.asarray(POSITIVE)), x[:, 0]).value,
    ],
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning", "ignore:divide by zero:RuntimeWarning")
def test_operations_give_what_jax_gives(name):
    function = OPERATIONS[name]
    expected = jax.jit(function)(X)
    found = AnswerCode.of(jax.jit(function).trace(X))([X], np.inf)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        # Other roundings of the same operations; products of positive matrices of condition 100.
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


def test_each_operation_on_numbers_is_among_them():
    """A rule that no test runs may be written wrong, as that of the logistic function was."""
    seen: set[str] = set()

    def look(program):
        for equation in program.eqns:
            seen.add(equation.primitive.name)
            for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda value: hasattr(value, "eqns")):
                look(inner) if hasattr(inner, "eqns") else None

    for function in OPERATIONS.values():
        look(jax.jit(function).trace(X).jaxpr)
    # What other versions of JAX call "copy" and compare in a sort with.
    assert set(ELEMENTWISE) - seen <= {"copy_p", "lt_to", "le_to"}


def test_a_singular_triangle_spoils_no_other():
    singular = np.stack([POSITIVE, np.triu(np.ones((4, 4)), 1)])
    x = numpy_operations.triangular_solve(singular, STACK, True, True, False, False)
    assert np.isfinite(x[0]).all()
    assert np.isnan(x[1]).all()
    singular[0] = np.nan
    inverses = numpy_operations.inverse(np.concatenate([singular, STACK, np.ones((1, 4, 4))]))
    np.testing.assert_allclose(inverses[2:4] @ STACK, np.broadcast_to(np.eye(4), (2, 4, 4)), atol=1e-12)
    assert np.isnan(inverses[[0, 1, 4]]).all()
    np.testing.assert_array_equal(numpy_operations.negative_counts(np.concatenate([singular[:1], -STACK])), [0, 4, 4])


def test_an_error_of_another_package_is_raised_and_no_code_of_it_kept(tmp_path):
    def solved(x):
        return lx.linear_solve(lx.MatrixLinearOperator(x), x[0]).value

    code = AnswerCode.of(jax.jit(solved).trace(POSITIVE))
    np.testing.assert_allclose(code([POSITIVE], np.inf), np.linalg.solve(POSITIVE, POSITIVE[0]), rtol=1e-12)
    with pytest.raises(RuntimeError, match="linear solver"):
        code([np.zeros((4, 4))], np.inf)
    rj.keep_programs(tmp_path)
    try:
        kept.store_code("with an error", code)
        kept.store_code("without one", AnswerCode.of(jax.jit(lambda x: 2 * x).trace(X)))
    finally:
        rj.keep_programs(False)
    assert [path.stem for path in tmp_path.iterdir()] == ["without one"]


def test_single_precision_stays_single():
    with jax.enable_x64(False):
        x = np.float32(X)
        traced = jax.jit(lambda x: (jnp.sin(x) * 2 + jnp.arange(5, dtype=x.dtype)[None]).sum(0)).trace(x)
        (found,) = jax.tree.leaves(AnswerCode.of(traced)([x], np.inf))
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, (np.sin(x) * 2 + np.arange(5)).sum(0), rtol=1e-5)


def test_what_numpy_lacks_is_told():
    with pytest.raises(NotInNumpyError, match="conv_general_dilated"):
        AnswerCode.of(jax.jit(lambda x: jnp.convolve(x[0], x[1])).trace(X))


def test_loops_end_in_time():
    endless = AnswerCode.of(jax.jit(lambda x: lax.while_loop(lambda x: x[0, 0] < jnp.inf, lambda x: x + 1, x)).trace(X))
    with pytest.raises(numpy_operations.TookTooLongError):
        endless([X], 0.01)


def test_only_time_of_its_own_counts():
    with numpy_operations.limited(0.01):
        time.sleep(0.02)  # as where the machine has other work
        assert numpy_operations.loop(lambda k: (k < 3,), lambda k: (k + 1,), (0,)) == (3,)


@pytest.fixture
def impatient(monkeypatch):
    """As users have it: tests are patient."""
    monkeypatch.setattr(ANSWERS, "is_patient", False)
    with rj.numpy_first():
        yield


def executables(function) -> int:
    (programs,) = [programs for programs in compilation._compiled if programs.name.endswith(function.__qualname__)]
    return sum(program.executable is not None for program in programs.known.values())


def test_the_third_answer_is_compiled(impatient):
    @one_answer
    def often():
        return [tripled(X) for _ in range(3)]

    @compiled
    def tripled(x):
        return 3 * x

    for expected in (0, 0, 1):
        np.testing.assert_array_equal(often()[-1], 3 * X)
        # What is asked for outside belongs to the last answer.
        tripled(X)
        assert executables(tripled) == expected
    with rj.numpy_first(False):
        tripled(X[0])
    assert executables(tripled) == 2


def test_programs_of_the_same_answer_are_compiled_with_it(impatient):
    """Unless a part of larger work, as a case of a sweep, asks for it: that needs no other of them."""

    @compiled
    def of_a_part(x):
        return 2 * x

    @compiled
    def asked_again(x):
        return 3 * x

    @compiled
    def asked_once(x):
        return 4 * x

    def ask(function) -> None:
        before = threading.enumerate()
        with ANSWERS.one():
            function(X)
        for thread in set(threading.enumerate()) - set(before):
            thread.join()

    with ANSWERS.one():
        for function in (of_a_part, asked_again, asked_once):
            function(X)
    with answers.compiled_only():
        ask(of_a_part)
    assert list(map(executables, (of_a_part, asked_again, asked_once))) == [1, 0, 0]
    for _ in range(answers.ANSWERS_BY_NUMPY):
        ask(asked_again)
    assert list(map(executables, (of_a_part, asked_again, asked_once))) == [1, 1, 1]


def test_what_many_parts_ask_for_is_compiled_where_that_is_quicker_for_all(impatient):
    @compiled
    def of_each_part(x):
        return 2 * x

    def asked(to_come: int) -> int:
        with answers.part_of_work(to_come):
            of_each_part(X)
        return executables(of_each_part)

    with ANSWERS.one():
        # How long it takes is known after the first time.
        assert asked(10**9) == 0
        assert asked(1) == 0
        assert asked(10**9) == 1


def test_parts_know_how_many_are_to_come():
    with rj.numpy_first():
        for threads in (1, 2):
            found = in_order(lambda k: (k, answers._here.parts_to_come), [(k,) for k in range(3)], threads=threads)
            assert found == [(0, 2), (1, 1), (2, 0)]


def test_what_takes_longer_than_compiling_is_compiled(impatient, monkeypatch):
    monkeypatch.setattr(answers, "PATIENCE", 0.0)

    @compiled
    def counted(x):
        return lax.while_loop(lambda x: x[0, 0] < 1e4, lambda x: x + 1, x)

    assert counted(X)[0, 0] >= 1e4
    assert executables(counted) == 1


def test_numbers_of_a_weak_type_are_no_reason_to_compile(impatient):
    """As `eqx.tree_at(lambda scene: scene.rod.GJ, scene, 0.3)` puts them into a scene, which the result has."""

    @compiled
    def handed_on(x):
        return {"same": x, "twice": 2 * x, "none": None}

    for number in (1.5, jnp.array(1.5), np.float64(1.5)):
        result = handed_on(number)
        assert result["same"] == 1.5
        assert result["twice"] == 3.0
        assert not any(jax.typeof(leaf).weak_type for leaf in jax.tree.leaves(result))
    assert executables(handed_on) == 0


def test_numpy_first_is_yes_or_no():
    with pytest.raises(TypeError, match="enabled must be True or False, got 'off'"):
        rj.numpy_first("off")


def test_both_codes_of_a_solve_agree(compiled_at_once):
    """Contact has every kind of loop and factorisation; the residual alone is all rounding."""
    scene = rj.problems.hanging_cable()
    floor = rj.Plane((0.0, 0.0, -0.15), (0.0, 0.0, 1.0))
    scene = rj.Scene(scene.rod, scene.start, scene.end, scene.gravity, obstacles=[floor])
    one = rj.solve(scene, segments=8)
    with rj.numpy_first():
        other = rj.solve(scene, segments=8, guess=rj.Guess(np.asarray(one.nodes)))
    assert other.converged
    # Both stop where the residual is below 1e-8 EI/L^2.
    np.testing.assert_allclose(other.nodes, one.nodes, atol=1e-9)
    np.testing.assert_allclose(other.contact_forces, one.contact_forces, atol=1e-9)


@linear
def sum_and_table(factors, value, change):
    """Of value = (sum of factors, a table of 7 x 13 such sums)."""
    return {"sum": jnp.sum(change["x"]), "table": jnp.full((7, 13), jnp.sum(change["x"]))}


def test_zeros_beside_derivatives_are_no_programs(caplog):
    """What has no cotangent has zeros of its shape, 7 x 13 as nothing else here."""
    value, x = {"sum": jnp.array(3.0), "table": jax.device_put(np.full((7, 13), 3.0))}, jnp.ones(3)
    with jax.log_compiles():
        slope = jax.grad(lambda change: sum_and_table({"x": x}, value, {"x": change})["sum"])(x)
    np.testing.assert_array_equal(slope, np.ones(3))
    said = [record.getMessage() for record in caplog.records]
    assert any("tracing" in line for line in said)
    assert not [line for line in said if "broadcast_in_dim" in line]


@linear
def scaled_change(factors, value, change):
    """Of value = sin(factors) summed, squared: a function that is linear in `change`."""
    return {"sum": 2 * value["sum"] * jnp.sum(jnp.cos(factors["x"]) * change["x"]), "count": None}


def test_linear_programs_have_all_derivatives():
    factors, value = {"x": jnp.array([0.1, 0.2, 0.3])}, {"sum": jnp.array(2.0), "count": jnp.array(3)}

    def change(dx):
        return scaled_change(factors, value, {"x": dx})["sum"]

    weights = 4.0 * np.cos([0.1, 0.2, 0.3])
    eye = jnp.eye(3)
    np.testing.assert_allclose(change(eye[0]), weights[0], rtol=1e-14)
    np.testing.assert_allclose(jax.grad(change)(eye[0]), weights, rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(change)(eye), weights, rtol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(change)(eye[0]), weights, rtol=1e-14)
    np.testing.assert_allclose(jax.jacrev(lambda x: jnp.stack([change(x), change(2 * x)]))(eye[0])[1], 2 * weights)
    np.testing.assert_allclose(jax.jit(jax.grad(change))(eye[0]), weights, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(jax.vmap(change))(eye), weights, rtol=1e-14)
    # Known to JAX as a constant of a program.
    np.testing.assert_allclose(compiled(lambda s: s * jax.grad(change)(eye[0]))(2.0), 2 * weights, rtol=1e-14)

    def of_factors(x):
        return scaled_change({"x": x}, value, {"x": eye[0]})["sum"]

    np.testing.assert_allclose(jax.grad(of_factors)(factors["x"])[0], -4.0 * np.sin(0.1), rtol=1e-14)


def test_operations_of_inner_programs_count_where_they_are_called():
    """As a compiler has them, by which it is told how long NumPy code may run."""
    inner = jax.jit(lambda x: jnp.sin(x) * x)  # 2 operations
    code = AnswerCode.of(jax.jit(lambda x: inner(inner(x)) + 1.0).trace(jnp.ones(3)))
    assert code.operations == 5
    assert AnswerCode.unpacked(*code.packed()).operations == 5
    assert answers.compile_seconds(20_000) == pytest.approx(40.0, rel=1e-12)  # 2 ms for each, of a large program
