"""BLAS by one thread while a program runs.

XLA calls LAPACK of SciPy's OpenBLAS, NumPy code that of NumPy's. Both share matrices of a hundred rows among as many
threads as there are cores, which wait for one another in loops: a solve takes longer by that, and many times as long
where other threads or processes do the same beside it.
"""

import functools
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxprs_in_params
from threadpoolctl import LibController, OpenBLASController, ThreadpoolController

# Operations that call LAPACK, those of this package (`small_matrices`) for matrices of more than so many rows. Smaller
# ones are not shared among threads.
LAPACK = {"cholesky", "eig", "eigh", "inverse", "lu", "negative_counts", "qr", "svd", "triangular_solve", "tridiagonal"}
FEW_ROWS = 16


class _OneThread:
    """BLAS has one thread as long as one of those that have entered has not left, and then as many as before."""

    def __init__(self) -> None:
        self.lock, self.depth = threading.Lock(), 0
        self.libraries: list[LibController] = []
        self.before: list[int | None] = []

    def __enter__(self) -> None:
        with self.lock:
            if not self.depth:
                self.libraries = _libraries("scipy.linalg" in sys.modules)
                self.before = [library.num_threads for library in self.libraries]
                self._set([1 for _ in self.libraries])
            self.depth += 1

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self.depth -= 1
            if not self.depth:
                self._set(self.before)

    def _set(self, threads: list[int | None]) -> None:
        for library, count in zip(self.libraries, threads, strict=True):
            library.set_num_threads(count)
        # Another thread may be the last to leave, which could not set anything else.
        OpenBLASController.clear_controlling_thread()


one_thread = _OneThread()


@functools.cache
def _libraries(_: bool) -> list[LibController]:
    """Those of BLAS that are loaded, looked for once without SciPy's and once with it."""
    return ThreadpoolController().select(user_api="blas").lib_controllers


def by_one_thread(program: Callable[..., Any]) -> Callable[..., Any]:
    """A program that has ended when it returns."""
    return functools.partial(_run, program)


def _run(program: Callable[..., Any], *args: Any, **options: Any) -> Any:
    with one_thread:
        return jax.block_until_ready(program(*args, **options))


def calls_blas(program: ClosedJaxpr | Jaxpr) -> bool:
    """Whether a program has a matrix of many rows."""
    return any(
        equation.primitive.name in LAPACK and max(equation.invars[0].aval.shape[-2:]) > FEW_ROWS
        for equation in _equations(program, set())
    )


def _equations(program: ClosedJaxpr | Jaxpr, known: set[int]) -> Iterator[Any]:
    """Of a program and its inner ones, each once."""
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    if id(jaxpr) not in known:
        known.add(id(jaxpr))
        for equation in jaxpr.eqns:
            yield equation
            for inner in jaxprs_in_params(equation.params):
                yield from _equations(inner, known)
