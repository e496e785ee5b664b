"""How the library's programs run: as NumPy code for a first answer, then compiled, as many as there is room for."""

import contextlib
import functools
import gc
import inspect
import itertools
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax.extend.core import get_opaque_trace_state

from rodjax.checks import is_known, shown
from rodjax.programs import kept
from rodjax.programs.numpy_code import AnswerCode, NotInNumpyError
from rodjax.programs.numpy_operations import TookTooLongError

# XLA's older generator of code for loops on a processor: half the compile time at the same run time, see
# `docs/design.md`. jaxlib 0.12 has it no more.
QUICK = {"xla_cpu_use_fusion_emitters": False}
_OUTSIDE = get_opaque_trace_state()

# A compiled program takes hundreds of memory maps, of which Linux allows a process 65530 or so; beyond, compiling
# crashes it. Where more than this part of them is taken, programs are dropped until half of it is.
SHARE_OF_MAPS = 0.5
# So many answers get a program as NumPy code: a script that solves twice ends sooner without a compiler.
ANSWERS_BY_NUMPY = 2
# Compiling takes about so many seconds for a byte of the program's NumPy code; and NumPy may take this part of them.
COMPILE_SECONDS = 2.5e-5
PATIENCE = 0.5
# The environment variable: "off" for no NumPy code.
VARIABLE = "RODJAX_NUMPY_FIRST"
# A setting of JAX that changes the types of arguments, and those under which no program is kept.
PRECISION = "jax_enable_x64"
SETTINGS = ("jax_disable_jit", "jax_default_device")
# Around what may take seconds; the command line says so there.
waiting: Callable[[], contextlib.AbstractContextManager] = contextlib.nullcontext
# So many programs keep what JAX traced, and so many their NumPy code (some 10 MB and 1 MB each).
MOST_TRACED, MOST_CODES = 16, 300
_slots = threading.BoundedSemaphore(os.cpu_count() or 1)
_MAPS, _MOST_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
F = TypeVar("F", bound=Callable)
_log = logging.getLogger("rodjax")


class _Program:
    """What a function becomes for arguments of one structure and types: NumPy code, an executable, or one after the
    other.

    `name`: on disk, `None` where it is not kept; `answer`: the number of the one for which it was made; `asked`: the
    last one that asked for it, and how many did.
    """

    def __init__(self, run: Any, tree: Any, name: str | None, is_patient: bool):
        self.run, self.tree, self.name, self.is_patient = run, tree, name, is_patient
        self.executable: Any = None
        self.code: AnswerCode | None = None
        self.traced: Any = None
        self.answer = ANSWERS.number
        self.asked = ANSWERS.number, 1
        self.seconds_left = math.inf
        self.lock = threading.Lock()

    def __call__(self, args: tuple, options: dict[str, Any], leaves: list[Any], given: tuple, named: Any) -> Any:
        if self.executable is None and self._is_by_numpy(args, options):
            assert self.code is not None
            begin = time.perf_counter()
            try:
                return self.code(leaves, self.seconds_left)
            except TookTooLongError:
                pass
            finally:
                self.seconds_left -= time.perf_counter() - begin
        if self.executable is None:
            ANSWERS.compile_others(self)
            with waiting():
                self.compile(lambda: self.run.trace(*args, **options))
            _make_room()
        return self.executable(*given, **named)

    def _is_by_numpy(self, args: tuple, options: dict[str, Any]) -> bool:
        """For the first answers that ask for it, as long as compiling would take longer."""
        last, count = self.asked
        self.asked = ANSWERS.number, count + (last != ANSWERS.number)
        is_early = self.is_patient or ANSWERS.is_patient or self.asked[1] <= ANSWERS_BY_NUMPY
        if not ANSWERS.by_numpy or not is_early or self.seconds_left <= 0:
            return False
        if self.code is None:
            with waiting():
                self._find_or_write_code(args, options)
        return self.code is not None

    def _find_or_write_code(self, args: tuple, options: dict[str, Any]) -> None:
        if self.name is not None:
            self.code = kept.load_code(self.name)
            if self.code is None:
                self.executable = kept.load(self.name, self.tree)
        if self.code is None and self.executable is None:
            self.traced = self.run.trace(*args, **options)
            try:
                self.code = AnswerCode.of(self.traced)
            except NotInNumpyError as missing:
                _log.info("compiled at once, as NumPy code lacks %s", missing)
                self.seconds_left = 0.0
                return
            if self.name is not None:
                kept.store_code(self.name, self.code)
        if self.code is not None:
            self.seconds_left = PATIENCE * COMPILE_SECONDS * len(self.code.code)
            ANSWERS.remember(self)

    def compile(self, trace: Callable[[], Any]) -> None:
        """In any thread."""
        with self.lock:
            if self.executable is not None:
                return
            if self.name is not None:
                self.executable = kept.load(self.name, self.tree)
            if self.executable is None:
                lowered = (self.traced or trace()).lower()
                self.executable, is_new = kept.compile_lowered(lowered, QUICK if _knows_quick() else None)
                if is_new and self.name is not None:
                    kept.store(self.name, self.executable)
            self.code = self.traced = None


class _Programs:
    """All that one function has become, and when it was last called.

    `part`: as a part of another program; `quick`: by itself, as JAX compiles it; `known`: by itself, by the structure
    and types of the arguments.
    """

    def __init__(self, function: Callable, static_argnames: Sequence[str], is_patient: bool):
        self.name = f"{function.__module__}.{function.__qualname__}"
        self.part: Any = jax.jit(function, static_argnames=static_argnames)
        self.quick: Any = jax.jit(function, static_argnames=static_argnames, compiler_options=QUICK)
        self.known: dict[Any, _Program] = {}
        self.static = frozenset(static_argnames)
        names = list(inspect.signature(function).parameters)
        self.static_places = frozenset(names.index(name) for name in static_argnames)
        self.is_patient = is_patient
        self.last_call = 0

    @property
    def count(self) -> int:
        return self.part._cache_size() + self.quick._cache_size() + len(self.known)

    def clear(self) -> None:
        self.part.clear_cache()
        self.quick.clear_cache()
        self.known.clear()

    def whole(self, args: tuple, options: dict[str, Any]) -> Any:
        """Called as a program of its own."""
        self.last_call = next(_calls)
        if any(getattr(jax.config, name) for name in SETTINGS) or not kept.is_single_processor():
            return self._by_jax(args, options)
        if len(self.known) == 1 and not self.static:
            # Mostly it is the same again: the program itself tells that sooner than a key does.
            (only,) = self.known.values()
            with contextlib.suppress(TypeError, ValueError):
                if only.executable is not None:
                    return only.executable(*args, **options)
        statics: tuple = ()
        given, named = args, options
        if self.static:
            statics = tuple(args[k] for k in self.static_places if k < len(args))
            statics += tuple((name, options[name]) for name in sorted(self.static & options.keys()))
            given = tuple(value for k, value in enumerate(args) if k not in self.static_places)
            named = {name: value for name, value in options.items() if name not in self.static}
        leaves, tree = jax.tree.flatten((given, named))
        kinds = tuple(map(_kind, leaves))
        if None in kinds:
            return self._by_jax(args, options)
        key = tree, kinds, statics, getattr(jax.config, PRECISION)
        with ANSWERS.one():
            try:
                program = self.known[key]
            except KeyError:
                name = None
                if kept.is_keeping():
                    name = kept.name_of(self.name, QUICK, statics, tree, kinds)
                program = self.known[key] = _Program(self.part, tree, name, self.is_patient)
            return program(args, options, leaves, given, named)

    def _by_jax(self, args: tuple, options: dict[str, Any]) -> Any:
        run = self.quick if _knows_quick() else self.part
        known = run._cache_size()
        result = run(*args, **options)
        if run._cache_size() != known:
            _make_room()
        return result


class _Answers:
    """The answers that are asked for, by which programs run as NumPy code or compiled.

    `number`: of the one that is being worked on; `is_patient`: whether NumPy code may serve any number of answers.
    """

    def __init__(self) -> None:
        self.by_numpy, self.is_patient = True, False
        self.number = self.depth = 0
        self.lock = threading.Lock()
        self.written: list[_Program] = []  # those with NumPy code, the latest last

    @contextlib.contextmanager
    def one(self) -> Iterator[None]:
        """All that is called in here is one answer, also where that is part of another."""
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

    def remember(self, program: _Program) -> None:
        """Those written longest ago give up what takes room."""
        with self.lock:
            self.written = [*(one for one in self.written if one.code is not None and one is not program), program]
            for old in self.written[:-MOST_TRACED]:
                old.traced = None
            for old in self.written[:-MOST_CODES]:
                old.code = None

    def compile_others(self, program: _Program | None) -> None:
        """Side by side with a program that another answer asks for, in other threads: those that were made for the same
        answer, as all will be asked for. In a session with a person at the keyboard (`None`): those of the last answer.
        """
        number = self.number if program is None else program.answer
        settings = kept.settings()
        for other in self.written:
            is_due = other.answer == number and other is not program and not other.is_patient and not self.is_patient
            if is_due and other.executable is None and other.traced is not None:
                threading.Thread(target=_compile_beside, args=(other, settings)).start()


def _compile_beside(program: _Program, settings: str) -> None:
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


def one_answer(function: F) -> F:
    """A function that calls the same programs many times for one answer, such as a fit."""

    @functools.wraps(function)
    def answer(*args, **options):
        with ANSWERS.one():
            return function(*args, **options)

    return cast(F, answer)


def _kind(leaf: Any) -> Any:
    """All of an argument that a program depends on; `None` where it may not lie in this process's first device."""
    try:  # an array of JAX's: to ask whether it is one takes longer
        return None if leaf.committed else leaf.aval
    except AttributeError:
        pass
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.shape, leaf.dtype
    return type(leaf).__name__ if type(leaf) in (bool, int, float) else None


_compiled: list[_Programs] = []
_calls = itertools.count(1)


def compiled(function: Callable, static_argnames: Sequence[str] = (), *, is_patient: bool = False) -> Callable:
    """`jax.jit` of a function, which runs as NumPy code at first (`numpy_first`) and is then compiled with `QUICK`,
    where it is a program of its own and not a part of another.

    `is_patient`: as NumPy code beyond the first answer too, as long as compiling would take longer. Programs are kept
    as long as the process has room for them, see `SHARE_OF_MAPS`.
    """
    programs = _Programs(function, static_argnames, is_patient)
    _compiled.append(programs)

    @functools.wraps(function)
    def call(*args, **options):
        if not _is_whole(args, options):
            return programs.part(*args, **options)
        return programs.whole(args, options)

    return call


def program_count() -> int:
    """How many programs the library's own functions have been compiled to and keep in memory."""
    return sum(programs.count for programs in _compiled)


def _make_room() -> None:
    """Drops programs, those of the functions called longest ago first, where the process has nearly too many maps."""
    most = _most_maps()
    if most is None or _maps() <= SHARE_OF_MAPS * most:
        return
    _say_once()
    by_age = sorted((programs for programs in _compiled if programs.count), key=lambda programs: programs.last_call)
    # Half of the functions at a time: a collection takes seconds in a process that holds millions of objects.
    half = (len(by_age) + 1) // 2
    for oldest in (by_age[:half], by_age[half:]):
        for programs in oldest:
            programs.clear()
        gc.collect()
        if _maps() <= SHARE_OF_MAPS * most / 2:
            return
    if _maps() > SHARE_OF_MAPS * most:
        # Programs that others have compiled.
        jax.clear_caches()


def _maps() -> int:
    return _MAPS.read_bytes().count(b"\n")


@functools.cache
def _most_maps() -> int | None:
    """As many memory maps as a process may have; `None` where none is known to be the most."""
    try:
        return int(_MOST_MAPS.read_text()) if _MAPS.exists() else None
    except (OSError, ValueError):
        return None


@functools.cache
def _say_once() -> None:
    # Not a warning, which may have been made an exception: the result of the call would be lost.
    _log.warning(
        "rodjax drops compiled programs, those used longest ago first: more would crash the process, which Linux "
        "allows %s memory maps (vm.max_map_count). Scenes of one structure and mesh share programs.",
        _most_maps(),
    )


def _is_whole(*args: Any) -> bool:
    """Whether a function of these arguments is called as a program of its own."""
    if get_opaque_trace_state() == _OUTSIDE:
        return True
    # Beside the derivatives of something, but not in a program that is being traced.
    return is_known(args) and is_known(jax.lax.full((), 0.0))


@functools.cache
def _knows_quick() -> bool:
    try:
        jax.jit(lambda: 0, compiler_options=QUICK)()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def enable_compilation_cache(directory: str | os.PathLike[str] | None = None) -> Path:
    """Turn JAX's persistent compilation cache on, in `directory` or `$XDG_CACHE_HOME/rodjax`, and return where.

    It is for programs of one's own in which solves are parts, such as a `jax.jit` or `jax.grad` around them: a process
    that calls this before compiles none that an earlier one compiled, but traces them again. Solves that are programs
    by themselves are kept anyway (`rodjax.keep_programs`). It changes JAX's configuration for the whole process.
    """
    if directory is None:
        directory = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rodjax"
    path = Path(directory)
    path.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(path))
    # By default programs that compile in less than a second are not kept: rodjax has dozens of those.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return path


numpy_first(kept.said(os.environ.get(VARIABLE, "")) is not False)
