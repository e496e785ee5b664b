"""How the library's programs run: as NumPy code for a first answer, then compiled, as many as there is room for."""

import contextlib
import functools
import gc
import inspect
import itertools
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rodjax.checks import is_known
from rodjax.programs import kept
from rodjax.programs.answers import QUICK, Program, knows_quick
from rodjax.programs.parts import is_outside, is_staged

# A compiled program takes hundreds of memory maps, of which Linux allows a process 65530 or so; beyond, compiling
# crashes it. Where more than this part of them is taken, programs are dropped until half of it is.
SHARE_OF_MAPS = 0.5
# A setting of JAX that changes the types of arguments, and those under which no program is kept.
PRECISION = "jax_enable_x64"
SETTINGS = ("jax_disable_jit", "jax_default_device")
_MAPS, _MOST_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_log = logging.getLogger("rodjax")


class _Programs:
    """All that one function has become, and when it was last called.

    `part`: as a part of another program; `quick`: by itself, as JAX compiles it; `known`: by itself, by the structure
    and types of the arguments.
    """

    def __init__(self, function: Callable, static_argnames: Sequence[str], is_patient: bool):
        self.function = function
        self.name = f"{function.__module__}.{function.__qualname__}"
        self.part: Any = jax.jit(function, static_argnames=static_argnames)
        self.quick: Any = jax.jit(function, static_argnames=static_argnames, compiler_options=QUICK)
        self.known: dict[Any, Program] = {}
        self.static = frozenset(static_argnames)
        names = list(inspect.signature(function).parameters)
        self.static_places = frozenset(names.index(name) for name in static_argnames)
        self.is_patient = is_patient
        self.last_call = 0

    def trace(self, args: tuple, options: dict[str, Any]) -> Any:
        """By a function of its own, with which JAX forgets what it traced.

        Of strong types: a number that a user has put into a scene may be of a weak one, and come back in the result.
        """

        @functools.wraps(self.function)
        def anew(*args, **options):
            return jax.tree.map(_strong, self.function(*args, **options))

        # The same mesh of devices as where JAX transposes, that the two may share what they trace.
        with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()), _without_collector():
            return jax.jit(anew, static_argnames=tuple(self.static)).trace(*args, **options)

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
            with contextlib.suppress(TypeError, ValueError):
                (only,) = self.known.values()  # unless another thread has just added one
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
        try:
            program = self.known[key]
        except KeyError:
            name = None
            if kept.is_keeping():
                name = kept.name_of(self.name, QUICK, statics, tree, kinds)
            # Of threads that ask at once one makes it.
            program = self.known.setdefault(key, Program(self.trace, tree, name, self.is_patient))
        known = program.executable
        result = program(args, options, leaves, given, named)
        if known is None and program.executable is not None:
            _make_room()
        return result

    def _by_jax(self, args: tuple, options: dict[str, Any]) -> Any:
        run = self.quick if knows_quick() else self.part
        known = run._cache_size()
        result = run(*args, **options)
        if run._cache_size() != known:
            _make_room()
        return result


def _strong(value: Any) -> Any:
    kind = jax.typeof(value)
    return jax.lax.convert_element_type(value, kind.dtype) if kind.weak_type else value


@contextlib.contextmanager
def _without_collector() -> Iterator[None]:
    """Python's garbage collector, which looks through what a trace makes again and again, a tenth of its time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _kind(leaf: Any) -> Any:
    """All of an argument that a program depends on; `None` where it may not lie in this process's first device."""
    try:  # an array of JAX's: to ask whether it is one takes longer
        return None if leaf.committed else leaf.aval
    except AttributeError:
        pass
    if isinstance(leaf, np.ndarray | np.generic):
        return _aval(leaf.shape, leaf.dtype, jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]
    return type(leaf).__name__ if type(leaf) in (bool, int, float) else None


@functools.lru_cache(maxsize=4096)
def _aval(shape: tuple[int, ...], dtype: np.dtype, is_double: bool) -> Any:
    """That of an array of JAX's with the same numbers."""
    return jax.typeof(np.broadcast_to(np.zeros((), dtype), shape))


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
    # Beside the derivatives of something too, but not in a program that is being traced.
    return is_outside() or (is_known(args) and not is_staged())


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
