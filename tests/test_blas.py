"""BLAS by one thread while programs run, and by as many as before in between."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import OpenBLASController, ThreadpoolController

import rodjax as rj
from rodjax.programs import blas
from rodjax.programs.compilation import compiled

LARGE, SMALL = (np.eye(rows) + 1.0 for rows in (blas.FEW_ROWS + 1, blas.FEW_ROWS))


def threads() -> list[int]:
    return [each.num_threads for each in ThreadpoolController().select(user_api="blas").lib_controllers]


@pytest.fixture
def several():
    """Two threads: tests have one."""
    np.linalg.inv(LARGE), jnp.linalg.inv(LARGE)  # SciPy's library is there
    blas._libraries.cache_clear()
    libraries = ThreadpoolController().select(user_api="blas").lib_controllers
    before = threads()
    try:
        for library in libraries:
            library.set_num_threads(2)
        OpenBLASController.clear_controlling_thread()
        if set(threads()) != {2}:
            pytest.skip("BLAS has one thread here")
        yield
    finally:
        for library, count in zip(libraries, before, strict=True):
            library.set_num_threads(count)
        OpenBLASController.clear_controlling_thread()


def test_blas_has_one_thread_until_the_last_one_has_left(several):
    inside, outside = threading.Event(), threading.Event()

    def stay() -> None:
        with blas.one_thread:
            inside.set()
            outside.wait(60)

    other = threading.Thread(target=stay)
    with blas.one_thread:
        other.start()
        assert inside.wait(60)
        assert set(threads()) == {1}
    assert set(threads()) == {1}
    outside.set()
    other.join()
    assert set(threads()) == {2}
    with pytest.raises(ZeroDivisionError), blas.one_thread:
        raise ZeroDivisionError
    assert set(threads()) == {2}


def test_programs_of_large_matrices_have_it(several, compiled_at_once):
    """Compiled, and as NumPy code whatever the matrices."""
    seen = []

    def look(x: np.ndarray) -> np.ndarray:
        seen.append(set(threads()))
        return x

    def looked_at(x):
        return jax.pure_callback(look, jax.ShapeDtypeStruct(x.shape, x.dtype), jnp.linalg.inv(x))

    for matrix, expected in ((LARGE, {1}), (SMALL, {2})):
        np.testing.assert_allclose(compiled(looked_at)(matrix), np.linalg.inv(matrix))
        assert seen.pop() == expected
        assert set(threads()) == {2}
    with rj.numpy_first():
        compiled(looked_at)(SMALL)
    assert seen.pop() == {1}


def test_inner_programs_are_looked_through():
    def within(x):
        return jax.lax.fori_loop(0, 3, lambda _, x: jax.jit(lambda x: jnp.linalg.eigh(x)[1])(x), x)

    assert blas.calls_blas(jax.make_jaxpr(within)(LARGE))
    assert not blas.calls_blas(jax.make_jaxpr(within)(SMALL))
    assert not blas.calls_blas(jax.make_jaxpr(lambda x: x @ x)(LARGE))
