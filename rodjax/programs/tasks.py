"""Work in parts: by threads of this process, or by any engine with the interface of `concurrent.futures.Executor`.

Compiled programs release the interpreter's lock, so that threads use as many cores as there are. How work is parted
depends on the work alone, never on who does it, and results do not depend on that either, to the last bit on processors
of one type.
"""

import contextlib
import functools
import importlib.metadata
import os
import pickle
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from rodjax.checks import line, shown, whole_number
from rodjax.notes import bar
from rodjax.programs import kept
from rodjax.programs.answers import compiled_only, is_compiled_only, part_of_work
from rodjax.version import __version__

# The environment variable: the most threads.
VARIABLE = "RODJAX_THREADS"
MOST_THREADS = 4096
# A part that fails, as its worker dies or loses its connection, is given away again so often.
RETRIES = 3
# Parts that an engine holds at a time. Results of a sweep's chunks, the largest there are, take 1.5 MB each.
UNDER_WAY = 256
# A thread that is done finds another part ready.
UNDER_WAY_A_THREAD = 2
# What would fail again wherever it runs.
FINAL = (ValueError, TypeError, AttributeError, ImportError, pickle.PicklingError)


class TaskError(RuntimeError):
    """An engine could not do its part; the message is one line."""


class Workers(NamedTuple):
    """What does the parts of some work: an executor, or so many threads."""

    executor: Executor | None
    threads: int


class _Here(threading.local):
    """How many threads what this thread is at may use, `None` for as many as there are cores: a single one where that
    is a part of some work.
    """

    threads: int | None = None


_here = _Here()


def checked_threads(threads: Any) -> int:
    """How many threads share some work: the argument, else `RODJAX_THREADS`, else one for each core of this process.

    Raises `TypeError` or `ValueError` where it is no whole number from 1.
    """
    if threads is not None:
        return whole_number(threads, "threads", 1, MOST_THREADS)
    if _here.threads is not None:
        return _here.threads
    text = os.environ.get(VARIABLE, "").strip()
    if not text:
        return _cores()
    if not (text.isascii() and text.isdigit() and 1 <= int(text[:9]) <= MOST_THREADS):
        raise ValueError(f"{VARIABLE} must be a whole number from 1 to {MOST_THREADS}, got {shown(text)}")
    return int(text)


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def rows_of(first: int, size: int, count: int) -> Int[np.ndarray, "size"]:
    """The rows of a part of so many in all; the last again where it has less than `size`."""
    return np.minimum(np.arange(first, first + size), count - 1)


def checked_executor(executor: Any) -> Executor | None:
    """`None`, or what has the method `submit` of `concurrent.futures.Executor`."""
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise TypeError(
            "executor must be a concurrent.futures.Executor or have its interface, such as client.get_executor() of "
            f"Dask, got {shown(executor)}"
        )
    return executor


def in_order(
    function: Callable[..., Any],
    parts: Sequence[tuple],
    *,
    executor: Executor | None = None,
    threads: int | None = None,
    unit: str = "parts",
    by_numpy: bool = False,
) -> list[Any]:
    """What `function` gives for each of the parts, in their order: see `as_completed`; a bar counts them by `unit`. A
    single part is done here as if it were no part, by NumPy code too, and uses the threads itself, unless there is an
    executor.
    """
    if executor is None and len(parts) == 1:
        with _limited_to(checked_threads(threads)):
            return [function(*parts[0])]
    found = {}
    with bar(len(parts), unit) as drawn:
        workers: dict[str, Any] = {"executor": executor, "threads": threads, "by_numpy": by_numpy}
        for number, one in as_completed(function, parts, **workers, count=len(parts)):
            found[number] = one
            drawn.update()
    return [found[number] for number in range(len(found))]


def as_completed(
    function: Callable[..., Any],
    parts: Iterable[tuple],
    *,
    executor: Executor | None = None,
    threads: int | None = None,
    by_numpy: bool = False,
    count: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """The number of each part and `function(*part)`, as they are done.

    **Arguments:**

    - `function`: of a module, so that others find it; it may not warn, but inside `rodjax.warn.silenced`.
    - `parts`: tuples of arguments; each is made when it is needed. A bounded number of them is under way.
    - `executor`: the engine, which gets arrays as NumPy's and gives such back; `None`: `threads` of this process.

    - `count`: how many parts there are, where that is known: of more threads each part uses its share.
    - `by_numpy`: whether threads may run programs as NumPy code for a first answer, which suits few short parts.

    Otherwise programs run compiled. Raises what `function` raises where that would happen everywhere
    (`FINAL`); `TaskError` where an engine fails a part more than `RETRIES` times, or takes no more of them.
    """
    if executor is not None:
        return _by_engine(function, parts, executor)
    at_once = checked_threads(threads)
    of_part = max(at_once // count, 1) if count else 1
    done = functools.partial(_part_done, function, threads=of_part, by_numpy=by_numpy)
    parts = ((count - k - 1 if count else 0, *part) for k, part in enumerate(parts))
    return _by_threads(done, parts, at_once) if at_once > 1 else _one_by_one(done, parts)


def _one_by_one(function: Callable[..., Any], parts: Iterable[tuple]) -> Iterator[tuple[int, Any]]:
    for number, part in enumerate(parts):
        yield number, function(*part)


def inherited() -> Callable[[], contextlib.AbstractContextManager]:
    """What holds in this thread, for threads that it starts to enter: its share of the work, precision and device."""
    threads, is_compiled = _here.threads, is_compiled_only()
    is_double = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    @contextlib.contextmanager
    def entered() -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            stack.enter_context(_limited_to(threads))
            stack.enter_context(compiled_only(is_compiled))
            if is_double != jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
                stack.enter_context(jax.enable_x64(is_double))
            if device != jax.config.jax_default_device:  # pyright: ignore[reportAttributeAccessIssue]
                stack.enter_context(jax.default_device(device))
            yield

    return entered


@contextlib.contextmanager
def _limited_to(threads: int | None) -> Iterator[None]:
    before, _here.threads = _here.threads, threads
    try:
        yield
    finally:
        _here.threads = before


def _part_done(function: Callable[..., Any], to_come: int, *part: Any, threads: int = 1, by_numpy: bool = False) -> Any:
    with _limited_to(threads), compiled_only(is_compiled_only() or not by_numpy), part_of_work(to_come):
        return function(*part)


def _by_threads(function: Callable[..., Any], parts: Iterable[tuple], count: int) -> Iterator[tuple[int, Any]]:
    entered = inherited()

    def within(function: Callable[..., Any], *arguments: Any) -> Any:
        with entered():
            return function(*arguments)

    with ThreadPoolExecutor(count, "rodjax") as pool:
        # What else a block of the user's has set other threads do not know of.
        if pool.submit(within, kept.settings).result() != kept.settings():
            yield from _one_by_one(function, parts)
            return
        yield from _collected(
            lambda part: pool.submit(within, function, *part), parts, UNDER_WAY_A_THREAD * count, retries=0
        )


def _by_engine(function: Callable[..., Any], parts: Iterable[tuple], executor: Executor) -> Iterator[tuple[int, Any]]:
    surroundings = _Surroundings.here()

    def submit(part: tuple) -> Future:
        # A number of its own: an engine may take equal calls for one, whose failure would be that of all.
        own = os.urandom(8).hex()
        are_jax = tuple(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(part))
        return executor.submit(_done_elsewhere, surroundings, function, _as_numpy(part), are_jax, own)

    return _collected(submit, parts, UNDER_WAY, RETRIES)


class _Given(NamedTuple):
    number: int
    part: tuple
    failures: int


def _collected(
    submit: Callable[[tuple], Future], parts: Iterable[tuple], most: int, retries: int
) -> Iterator[tuple[int, Any]]:
    """Results as they come; where this ends early, what waits for its turn is cancelled."""
    following = (_Given(number, part, 0) for number, part in enumerate(parts))
    again: deque[_Given] = deque()
    under_way: dict[Future, _Given] = {}
    try:
        while True:
            while len(under_way) < most:
                given = again.popleft() if again else next(following, None)
                if given is None:
                    break
                try:
                    under_way[submit(given.part)] = given
                except FINAL:
                    raise
                except Exception as error:  # as of a pool whose process has died, or a client without its scheduler
                    under_way.clear()  # nothing is left that could be cancelled
                    raise TaskError(f"the executor takes no more tasks: {_told(error)}") from error
            if not under_way:
                return
            done, _ = wait(under_way, return_when=FIRST_COMPLETED)
            for future in done:
                given = under_way.pop(future)
                error = _error(future)
                if error is None:
                    yield given.number, future.result()
                elif given.failures < retries and _may_pass(error):
                    again.append(given._replace(failures=given.failures + 1))
                elif retries and not isinstance(error, (*FINAL, TaskError)) and isinstance(error, Exception):
                    times = "once" if not given.failures else f"{given.failures + 1} times"
                    raise TaskError(f"task {given.number} failed {times}: {_told(error)}") from error
                else:
                    raise error
    finally:
        for future in under_way:
            future.cancel()


def _error(future: Future) -> BaseException | None:
    try:
        return future.exception()
    except CancelledError as error:
        return error


def _may_pass(error: BaseException) -> bool:
    # Dask has given a part of which it says so away several times itself, and each time lost the worker.
    is_deadly = type(error).__name__ == "KilledWorker"
    return isinstance(error, Exception) and not isinstance(error, (*FINAL, TaskError)) and not is_deadly


def _told(error: BaseException) -> str:
    return line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)


# --- elsewhere -------------------------------------------------------------------------------------------------------


class _Surroundings(NamedTuple):
    """What a result depends on besides its arguments."""

    version: str
    source: str
    jaxlib: str
    platform: str
    is_double: bool

    @classmethod
    def here(cls) -> "_Surroundings":
        platform, is_double = jax.default_backend(), jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        return cls(__version__, kept.source(), importlib.metadata.version("jaxlib"), platform, bool(is_double))

    def check(self) -> None:
        here = _Surroundings.here()
        pairs = [(name, str(getattr(here, name)), str(getattr(self, name))) for name in self._fields[:4]]
        differing = [f"{name} ({ours[:12]}, not {asked[:12]})" for name, ours, asked in pairs if ours != asked]
        if differing:
            raise TaskError(
                f"the worker on {socket.gethostname()} is not like the process that asks, different in "
                f"{', '.join(differing)}; install the same rodjax and jax there"
            )


def _done_elsewhere(
    surroundings: _Surroundings, function: Callable[..., Any], part: tuple, are_jax: tuple[bool, ...], own: str
) -> Any:
    """What an engine runs, in any thread of any process. `are_jax`: which leaves of the part are arrays of JAX's."""
    surroundings.check()
    with contextlib.ExitStack() as stack:
        if surroundings.is_double != jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
            stack.enter_context(jax.enable_x64(surroundings.is_double))
        leaves, tree = jax.tree.flatten(part)
        leaves = [jax.device_put(leaf) if is_jax else leaf for leaf, is_jax in zip(leaves, are_jax, strict=True)]
        return _as_numpy(_part_done(function, 0, *jax.tree.unflatten(tree, leaves)))


def _as_numpy(values: Any) -> Any:
    """JAX's arrays would lose digits where they are read in another precision."""
    return jax.tree.map(lambda leaf: np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf, values)
