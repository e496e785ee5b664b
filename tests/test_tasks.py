"""Work in parts: the same results in threads and by any executor, where a part fails too; and nothing runs ahead."""

import re
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax.programs import tasks
from rodjax.programs.tasks import TaskError, as_completed, checked_executor, checked_threads, in_order


class Unreliable(ThreadPoolExecutor):
    """An engine some of whose calls fail as where a worker is lost: those of which `fails(number)`, from 0, is true."""

    def __init__(self, fails, error=ConnectionError("the worker is lost")):
        super().__init__(2)
        self.fails, self.error, self.calls = fails, error, 0

    def submit(self, function, *args, **options):
        number, self.calls = self.calls, self.calls + 1

        def call():
            if self.fails(number):
                raise self.error
            return function(*args, **options)

        return super().submit(call)


def squared(x):
    return x**2


def refused(x):
    if x == 2:
        raise ValueError("x must not be 2")
    return x


PARTS = [(k,) for k in range(20)]
SQUARES = [k**2 for k in range(20)]


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_results_are_in_the_order_of_the_parts(threads):
    assert in_order(squared, PARTS, threads=threads) == SQUARES
    assert dict(as_completed(squared, iter(PARTS), threads=threads)) == dict(enumerate(SQUARES))
    assert in_order(squared, [], threads=threads) == []


def test_threads_that_wait_for_one_another_run_at_once():
    barrier = threading.Barrier(3, timeout=60)
    assert len(in_order(lambda k: barrier.wait(), [(k,) for k in range(6)], threads=3)) == 6


def test_fewer_parts_than_threads_share_them():
    """Else a part is not parted again; what is no part keeps to the threads that it was given."""

    def threads(_):
        return checked_threads(None)

    assert in_order(threads, [(0,)], threads=3) == [3]
    assert in_order(threads, [(0,), (1,)], threads=3) == [1, 1]
    assert in_order(threads, [(0,), (1,)], threads=5) == [2, 2]
    assert in_order(threads, PARTS, threads=5) == [1] * len(PARTS)
    assert dict(as_completed(threads, iter([(0,)]), threads=3, count=1)) == {0: 3}
    assert dict(as_completed(threads, iter([(0,)]), threads=3)) == {0: 1}
    assert in_order(lambda k: in_order(threads, [(k,)]), [(0,)], threads=2) == [[2]]
    assert checked_threads(5) == 5


def test_a_part_that_fails_is_given_away_again():
    with Unreliable(lambda number: number in (0, 3, 4)) as engine:
        assert in_order(squared, PARTS, executor=engine) == SQUARES
        assert engine.calls == 23


def test_a_part_that_fails_always_is_told():
    with Unreliable(lambda number: number == 1 or number >= 20) as engine:
        # The second part fails at first, and each time that it is tried again.
        with pytest.raises(TaskError, match=r"^task 1 failed 4 times: ConnectionError: the worker is lost$"):
            in_order(squared, PARTS, executor=engine)
        assert engine.calls == 23


def test_mistakes_are_not_tried_again():
    with ThreadPoolExecutor(2) as engine:
        for options in ({"executor": engine}, {"threads": 1}, {"threads": 2}):
            with pytest.raises(ValueError, match=r"^x must not be 2$"):
                in_order(refused, PARTS, **options)


def test_an_executor_that_takes_no_more_is_told():
    engine = ThreadPoolExecutor(1)
    engine.shutdown()
    with pytest.raises(
        TaskError, match=r"^the executor takes no more tasks: RuntimeError: cannot schedule new futures"
    ):
        in_order(squared, PARTS, executor=engine)


def test_a_bounded_number_of_parts_is_under_way(monkeypatch):
    monkeypatch.setattr(tasks, "UNDER_WAY", 3)
    made, received = [], []

    def parts():
        for part in PARTS:
            made.append(part)
            assert len(made) - len(received) <= 3
            yield part

    with ThreadPoolExecutor(2) as engine:
        for number, _ in as_completed(squared, parts(), executor=engine):
            received.append(number)
    assert sorted(received) == list(range(20))


def test_what_ends_early_cancels_what_waits():
    gate, begun = threading.Event(), []

    def wait(k):
        begun.append(k)
        if k:
            assert gate.wait(60)

    with ThreadPoolExecutor(1) as engine:
        results = as_completed(wait, PARTS, executor=engine)
        next(results)
        results.close()
        gate.set()
    assert len(begun) <= 2


def doubled(x, y):
    """Of arrays that are what they are here."""
    assert isinstance(x, jax.Array)
    assert isinstance(y, np.ndarray)
    return x + jnp.asarray(y)


def test_an_executor_works_in_the_precision_of_who_asks():
    x = jnp.full(3, 0.1)
    assert x.dtype == np.float64
    with ThreadPoolExecutor(1) as engine:
        (wide,) = in_order(doubled, [(x, np.asarray(x))], executor=engine)
        with jax.enable_x64(False):
            (narrow,) = in_order(doubled, [(x, np.asarray(x))], executor=engine)
            # A block of the user's holds for threads of our own too.
            assert {leaf.dtype for leaf in in_order(lambda k: jnp.zeros(()), PARTS, threads=2)} == {np.dtype("float32")}
    assert (wide.dtype, narrow.dtype) == (np.float64, np.float32)
    assert isinstance(wide, np.ndarray)
    np.testing.assert_array_equal(wide, 0.2)


def test_threads_work_on_the_device_of_who_asks():
    """Side by side: one after another they would never meet."""
    meeting = threading.Barrier(2)

    def device(_):
        meeting.wait(30.0)
        return jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    (processor, *_) = jax.devices("cpu")
    with jax.default_device(processor):
        assert in_order(device, [(0,), (1,)], threads=2) == [processor] * 2


def test_a_worker_with_other_code_is_told():
    other = tasks._Surroundings.here()._replace(source="f" * 64)
    with pytest.raises(TaskError, match=r"^the worker on \S+ is not like the process that asks, different in source "):
        tasks._done_elsewhere(other, squared, (1,), (False,), "")


def test_how_many_threads(monkeypatch):
    assert checked_threads(3) == 3
    monkeypatch.setenv(tasks.VARIABLE, "5")
    assert checked_threads(None) == 5
    # Parts of parts are done in the thread that has the part.
    assert in_order(lambda k: checked_threads(None), PARTS[:4], threads=2) == [1, 1, 1, 1]
    monkeypatch.delenv(tasks.VARIABLE)
    assert checked_threads(None) == tasks._cores()
    for text in ("0", "two", "-1", "1e3", "99999999999"):
        monkeypatch.setenv(tasks.VARIABLE, text)
        with pytest.raises(
            ValueError, match=re.escape(f"RODJAX_THREADS must be a whole number from 1 to 4096, got '{text}'")
        ):
            checked_threads(None)
    with pytest.raises(TypeError, match=r"executor must be a concurrent\.futures\.Executor .* got 3"):
        checked_executor(3)
