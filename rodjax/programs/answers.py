"""Answers and the programs that they ask for: as NumPy code at first, compiled where they are asked for again."""

import contextlib
import functools
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

import jax

from rodjax.checks import shown
from rodjax.notes import noted, told
from rodjax.programs import blas, kept
from rodjax.programs.numpy_code import AnswerCode, NotInNumpyError, operation_count
from rodjax.programs.numpy_operations import TookTooLongError

# XLA's older generator of code for loops on a processor: half the compile time at the same run time, see
# `docs/design.md`. jaxlib 0.12 has it no more.
QUICK = {"xla_cpu_use_fusion_emitters": False}
# What does not change is not moved out of the loops of a program of so many operations: to look for it takes a fifth of
# the compile time there, and saves 6 % of the run time.
HUGE = 25_000
OF_HUGE = {"xla_disable_hlo_passes": "while-loop-invariant-code-motion"}
# So many answers get a program as NumPy code: a script that solves twice ends sooner without a compiler.
ANSWERS_BY_NUMPY = 2
# Compiling takes about so many seconds for an operation of a small program, and for one of a program of LARGE and more
# operations; and NumPy may take this part of them.
COMPILE_SECONDS, COMPILE_SECONDS_OF_LARGE, LARGE = 8e-4, 2e-3, 10_000
LEAST_SECONDS = 1.0  # for the smallest program, on a busy machine
PATIENCE = 0.5
# The environment variable: "off" for no NumPy code.
VARIABLE = "RODJAX_NUMPY_FIRST"
# What takes seconds, as a call says that lasts.
PREPARING = "preparing, once for this kind of scene and mesh"
COMPILING = "compiling, once for this kind of scene and mesh"
# So many programs keep what JAX traced, and so many their NumPy code, of some 4 MB.
MOST_TRACED, MOST_CODES = 16, 64
_slots = threading.BoundedSemaphore(os.cpu_count() or 1)
F = TypeVar("F", bound=Callable)
_log = logging.getLogger("rodjax")


class Program:
    """What a function becomes for arguments of one structure and types: NumPy code, an executable, or one after the
    other.

    `name`: on disk, `None` where it is not kept; `answer`: the number of the one for which it was made; `asked`: the
    last one that asked for it, and how many did.
    """

    def __init__(self, trace: Callable[[tuple, dict[str, Any]], Any], tree: Any, name: str | None, is_patient: bool):
        self.trace, self.tree, self.name, self.is_patient = trace, tree, name, is_patient
        self.executable: Any = None
        self.code: AnswerCode | None = None
        self.traced: Any = None
        self.answer = ANSWERS.number
        self.asked = ANSWERS.number, 1
        self.seconds_left, self.longest = math.inf, 0.0  # of NumPy code
        self.lock, self.writing = threading.Lock(), threading.Lock()

    def __call__(self, args: tuple, options: dict[str, Any], leaves: list[Any], given: tuple, named: Any) -> Any:
        code = self._code(args, options) if self.executable is None else None
        if code is not None:
            ANSWERS.remember(self)
            begin = time.thread_time()
            try:
                with blas.one_thread:
                    return code(leaves, self.seconds_left)
            except TookTooLongError:
                pass
            finally:
                seconds = time.thread_time() - begin
                self.seconds_left, self.longest = self.seconds_left - seconds, max(self.longest, seconds)
        executable = self.executable
        if executable is None:
            if not (_here.is_compiled_only or _here.is_part):
                ANSWERS.compile_others(self)
            with noted(COMPILING):
                executable = self.compile(lambda: self.trace(args, options))
        return executable(*given, **named)

    def _code(self, args: tuple, options: dict[str, Any]) -> AnswerCode | None:
        """For the first answers that ask for it, as long as compiling would take longer."""
        last, count = self.asked
        self.asked = ANSWERS.number, count + (last != ANSWERS.number)
        is_early = self.is_patient or ANSWERS.is_patient or self.asked[1] <= ANSWERS_BY_NUMPY
        if not ANSWERS.by_numpy or _here.is_compiled_only or not is_early:
            return None
        if self.seconds_left <= self.longest * _here.parts_to_come:
            return None
        with self.writing:
            if self.code is None and self.executable is None:
                with noted(PREPARING):
                    self._find_or_write_code(args, options)
            return self.code

    def _find_or_write_code(self, args: tuple, options: dict[str, Any]) -> None:
        if self.name is not None:
            self.code = kept.load_code(self.name)
            if self.code is None:
                self.executable = kept.load(self.name, self.tree)
        if self.code is None and self.executable is None:
            self.traced = self.trace(args, options)
            try:
                self.code = AnswerCode.of(self.traced)
            except NotInNumpyError as missing:
                _log.info("compiled at once, as NumPy code lacks %s", missing)
                self.seconds_left = 0.0
                return
            if self.name is not None:
                kept.store_code(self.name, self.code)
        if self.code is not None:
            self.seconds_left = PATIENCE * max(compile_seconds(self.code.operations), LEAST_SECONDS)

    def compile(self, trace: Callable[[], Any]) -> Any:
        """The executable, made in any thread."""
        with self.lock:
            if self.executable is not None:
                return self.executable
            if self.name is not None:
                self.executable = kept.load(self.name, self.tree)
            if self.executable is None:
                traced = self.traced or trace()
                self.executable, is_new = kept.compile_lowered(traced.lower(), _options(traced))
                calls_blas = blas.calls_blas(traced.jaxpr)
                if is_new and self.name is not None:
                    kept.store(self.name, self.executable, calls_blas)
                if calls_blas:
                    self.executable = blas.by_one_thread(self.executable)
            self.code = self.traced = None
            ANSWERS.forget(self)
            return self.executable


def _options(traced: Any) -> dict[str, Any]:
    """With which XLA compiles a program."""
    quick = QUICK if knows_quick() else {}
    return {**quick, **OF_HUGE} if operation_count(traced.jaxpr) >= HUGE else quick


def compile_seconds(operations: int) -> float:
    """About as long as compiling a program takes, at the lowest level of optimisation."""
    part = min(operations / LARGE, 1.0)
    return operations * (COMPILE_SECONDS + part * (COMPILE_SECONDS_OF_LARGE - COMPILE_SECONDS))


class _Answers:
    """The answers that are asked for, by which programs run as NumPy code or compiled.

    `number`: of the one that is being worked on; `is_patient`: whether NumPy code may serve any number of answers.
    """

    def __init__(self) -> None:
        self.by_numpy, self.is_patient = True, False
        self.number = self.depth = 0
        self.lock = threading.Lock()
        self.written: dict[Program, None] = {}  # those with NumPy code, the one called last at the end

    @contextlib.contextmanager
    def one(self) -> Iterator[None]:
        """All that is called in here is one answer, also where that is part of another. What is read off its result
        afterwards still belongs to it.
        """
        with self.lock:
            self.number += not self.depth
            self.depth += 1
        try:
            yield
        finally:
            with self.lock:
                self.depth -= 1
            if not self.depth and hasattr(sys, "ps1"):
                self.compile_others(None)

    def remember(self, program: Program) -> None:
        """A program is called as NumPy code: those called longest ago give up what takes room."""
        with self.lock:
            self.written.pop(program, None)
            self.written[program] = None
            if len(self.written) > MOST_TRACED:
                list(self.written)[-MOST_TRACED - 1].traced = None
            if len(self.written) > MOST_CODES:
                oldest = next(iter(self.written))
                oldest.code = None
                del self.written[oldest]

    def forget(self, program: Program) -> None:
        """A program has been compiled."""
        with self.lock:
            self.written.pop(program, None)

    def compile_others(self, program: Program | None) -> None:
        """Side by side with a program that another answer asks for, in other threads: those that were made for the same
        answer, as all will be asked for by another of its kind. In a session with a person at the keyboard (`None`):
        those of the last answer.
        """
        number = self.number if program is None else program.answer
        settings = kept.settings()
        for other in list(self.written):
            is_due = other.answer == number and other is not program and not other.is_patient and not self.is_patient
            if is_due and other.executable is None and other.traced is not None:
                threading.Thread(target=_compile_beside, args=(other, settings)).start()


def _compile_beside(program: Program, settings: str) -> None:
    # What a block of the user's has changed, such as the precision, other threads do not know of.
    with contextlib.suppress(Exception), _slots:
        if threading.main_thread().is_alive() and kept.settings() == settings:
            program.compile(lambda: program.traced)


ANSWERS = _Answers()


class numpy_first:  # noqa: N801 - called as a function
    """Whether first answers come from NumPy code, as they do unless told otherwise: `rj.numpy_first(False)` from here
    on, `with rj.numpy_first(False): ...` in a block.

    A program that XLA compiles in seconds runs as NumPy code for the first two answers that ask for it, some fifty
    times as slowly, and is compiled for the third. The two agree to rounding. Without NumPy code the first answer waits
    for the compiler, and all answers of a process are the same to the last bit: ask for that before you measure run
    times, or compare bits. The environment variable `RODJAX_NUMPY_FIRST=off` says so from the start.
    """

    def __init__(self, enabled: bool = True):
        if not isinstance(enabled, bool):
            raise TypeError(f"enabled must be True or False, got {shown(enabled)}")
        self._before, ANSWERS.by_numpy = ANSWERS.by_numpy, enabled

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        ANSWERS.by_numpy = self._before


class _Here(threading.local):
    """What holds in this thread alone: whether it is at a part of larger work, and how many parts come after that."""

    is_compiled_only, is_part, parts_to_come = False, False, 0


_here = _Here()


def is_compiled_only() -> bool:
    """Whether this thread is within `compiled_only`."""
    return _here.is_compiled_only


@contextlib.contextmanager
def compiled_only(is_so: bool = True) -> Iterator[None]:
    """No NumPy code in this thread, as `numpy_first(False)` says for all of them."""
    before, _here.is_compiled_only = _here.is_compiled_only, is_so
    try:
        yield
    finally:
        _here.is_compiled_only = before


@contextlib.contextmanager
def part_of_work(to_come: int) -> Iterator[None]:
    """For a part of larger work, as a case of a sweep, after which so many like it are to come. A program that it asks
    for is compiled alone, as others need not what else an answer does; at once, where NumPy code would take longer for
    all that are to come.
    """
    before = _here.is_part, _here.parts_to_come
    _here.is_part, _here.parts_to_come = True, to_come
    try:
        yield
    finally:
        _here.is_part, _here.parts_to_come = before


def one_answer(function: F) -> F:
    """A function that calls the same programs many times for one answer, such as a fit. What it does is told where it
    takes long: by its argument `progress`, where it has one.
    """

    @functools.wraps(function)
    def answer(*args, **options):
        with ANSWERS.one(), told(options.get("progress")):
            return function(*args, **options)

    return cast(F, answer)


@functools.cache
def knows_quick() -> bool:
    """Whether XLA has the options `QUICK`."""
    try:
        jax.jit(lambda: 0, compiler_options=QUICK)()
    except jax.errors.JaxRuntimeError:
        return False
    return True


numpy_first(kept.said(os.environ.get(VARIABLE, "")) is not False)
