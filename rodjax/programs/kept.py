"""Compiled programs kept on disk, so that a process neither traces nor compiles what an earlier one has.

JAX's own persistent cache, whose settings belong to the user, saves the compiling alone; here an executable is found by
what it is called with. Its name is a hash of all that it depends on: this package's source, versions, processor,
settings of JAX and XLA, options, and the structure, shapes and types of the arguments. Where these hold classes or
functions from elsewhere, such as a user's own law, whose source is not known here, the program is not kept; nor is one
for an accelerator or several devices.
"""

import enum
import functools
import hashlib
import importlib.metadata
import logging
import os
import pickle
import platform
import sys
import threading
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import platformdirs
from jax.experimental import serialize_executable

from rodjax.atomic_write import replace_file
from rodjax.checks import file_path, shown
from rodjax.programs.blas import by_one_thread
from rodjax.programs.numpy_code import AnswerCode, skeleton
from rodjax.programs.numpy_operations import Callback

# The environment variable: "off", or a folder.
VARIABLE = "RODJAX_CACHE"
# What all files may take [bytes]; beyond, those used longest ago go until this part of it is left. Some 500 programs.
MOST_BYTES = 512 * 2**20
LEFT = 0.75
SUFFIX = ".program"
# Of the same as NumPy code.
CODE_SUFFIX = ".numpy"
# What the first bytes of a file are, before a hash of the rest.
MARK = b"rodjax program 1\n"
# What JAX tells when it finds a program in the persistent cache of its own.
TAKEN = "/jax/compilation_cache/cache_hits"
# Packages whose code may stand in a program.
PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "lineax", "optimistix", "numpy", "scipy")
# Of JAX's settings, those that change no program.
WITHOUT_EFFECT = ("jax_compilation_cache", "jax_persistent_cache", "jax_log", "jax_traceback")
T = TypeVar("T")
_log = logging.getLogger("rodjax")
_folder: Path | None
_is_broken = False


def keep_programs(where: str | os.PathLike[str] | bool = True) -> Path | None:
    """Where compiled programs are kept from here on: in a folder, with `True` the user's cache folder (the default),
    with `False` nowhere. Returns the folder, `None` where there is none.

    The environment variable `RODJAX_CACHE`, a folder, `on` or `off`, says the same from the start. The folder holds
    code that is run: nobody else should be able to write there. Raises `TypeError` or `ValueError` for what is no
    folder's name; a folder that cannot be written to is told of once, where the first program would be kept.
    """
    global _folder, _is_broken
    if not isinstance(where, bool | str | os.PathLike):
        raise TypeError(f"where must be True, False or the name of a folder, got {shown(where)}")
    if where is True:
        path = platformdirs.user_cache_path("rodjax", appauthor=False) / "programs"
        _folder = path if path.is_absolute() else None  # of a user without a home
    elif where is False:
        _folder = None
    else:
        _folder = file_path(where, "where").expanduser().absolute()
    _is_broken = False
    return _folder


def folder() -> Path | None:
    """Where programs are kept now."""
    return _folder


def is_keeping() -> bool:
    """Whether programs are looked for on disk."""
    return _folder is not None and is_single_processor()


def name_of(function: str, options: dict[str, Any], statics: Sequence[Any], tree: Any, leaves: Any) -> str | None:
    """The name of a program; `None` where it depends on what is not known here."""
    structure, fixed = _tree_text(tree), _text(tuple(statics))
    if structure is None or fixed is None or not function.startswith("rodjax."):
        return None
    text = "\n".join([_surroundings(), settings(), function, repr(options), fixed, structure, repr(leaves)])
    return hashlib.sha256(text.encode()).hexdigest()


def load(name: str, tree: Any) -> Any:
    """The program of that name, to be called with arguments of this structure; `None` where there is none."""

    def loaded(executable: bytes, skeleton: Any, calls_blas: bool) -> Any:
        if b"lapack_" in executable:
            _prepare_lapack()
        out_tree = jax.tree.structure(skeleton)
        program = serialize_executable.deserialize_and_load(executable, tree, out_tree, execution_devices=_devices())
        return by_one_thread(program) if calls_blas else program

    return _read(name + SUFFIX, loaded)


def load_code(name: str) -> AnswerCode | None:
    """The same as NumPy code."""
    return _read(name + CODE_SUFFIX, AnswerCode.unpacked)


def _read(name: str, made_of: Callable[..., T]) -> T | None:
    """What is made of the content of a file; `None` where there is none, or a damaged one, which is deleted."""
    if _folder is None:
        return None
    path = _folder / name
    try:
        content = path.read_bytes()
    except OSError:
        return None
    try:
        mark, digest, packed = content[: len(MARK)], content[len(MARK) : len(MARK) + 32], content[len(MARK) + 32 :]
        if mark != MARK or digest != hashlib.sha256(packed).digest():
            raise ValueError("its content is not what was written")
        result = made_of(*pickle.loads(zlib.decompress(packed)))
    except Exception as error:  # whatever a damaged file leads to: the program is compiled again
        _log.info("%s is not used: %s", path, error)
        with suppress(OSError):
            path.unlink()
        return None
    with suppress(OSError):
        os.utime(path)
    return result


class _Compiling(threading.local):
    """Whether JAX has taken a program of this thread from a cache of its own: XLA cannot write it down once more."""

    taken = False


_compiling = _Compiling()


def _listen(event: str, **_: Any) -> None:
    if event == TAKEN:
        _compiling.taken = True


jax.monitoring.register_event_listener(_listen)


def compile_lowered(lowered: Any, options: dict[str, Any]) -> tuple[Any, bool]:
    """The program, and whether it can be kept."""
    _compiling.taken = False
    program = lowered.compile(options)
    return program, not _compiling.taken


def store(name: str, program: Any, calls_blas: bool) -> None:
    """Keeps a program, if that is possible; a folder that cannot be written to is told of once."""
    if _folder is None or _is_broken:
        return
    try:
        executable, _, out_tree = serialize_executable.serialize(program)
    except Exception as error:  # there are programs that XLA cannot write down
        _log.info("a program is not kept: %s", error)
        return
    # Beside functions of this process that are called by their address, and classes that others may lack.
    if b"python_cpu_callback" in executable or _tree_text(out_tree) is None:
        return
    _write(name + SUFFIX, (executable, skeleton(out_tree), calls_blas))


def store_code(name: str, code: AnswerCode) -> None:
    """Keeps NumPy code, if that is possible."""
    if any(isinstance(value, Callback) for value in code.constants):
        return
    if _folder is not None and not _is_broken and _tree_text(code.out_tree) is not None:
        _write(name + CODE_SUFFIX, code.packed())


def _write(name: str, content: tuple[Any, ...]) -> None:
    global _is_broken
    assert _folder is not None
    packed = zlib.compress(pickle.dumps(content), 1)
    try:
        _folder.mkdir(parents=True, exist_ok=True)
        replace_file(_folder / name, MARK + hashlib.sha256(packed).digest() + packed)
        _make_room(_folder)
    except OSError as error:
        _is_broken = True
        _log.warning(
            "rodjax cannot keep compiled programs in %s (%s), so that each process compiles its own; %s=off or a "
            "folder says where else",
            _folder,
            error.strerror or error,
            VARIABLE,
        )


def _make_room(folder: Path) -> None:
    """Files used longest ago go where all take too much. Another process may take them away at the same time."""
    files = []
    for path in folder.iterdir():
        with suppress(OSError):
            stat = path.stat()
            files.append((stat.st_mtime, stat.st_size, path))
    files = [file for file in files if file[2].suffix in (SUFFIX, CODE_SUFFIX)]
    total = sum(size for _, size, _ in files)
    if total <= MOST_BYTES:
        return
    for _, size, path in sorted(files):
        with suppress(OSError):
            path.unlink()
        total -= size
        if total <= LEFT * MOST_BYTES:
            return


# --- what a program depends on ---------------------------------------------------------------------------------------


def _tree_text(tree: Any) -> str | None:
    """A structure of arguments in words; `None` where it has classes or values from elsewhere."""
    data = tree.node_data()
    if data is None:
        return "*" if tree.num_leaves else "-"
    kind, fixed = data
    parts = [_text(kind), _text(fixed), *map(_tree_text, tree.children())]
    return None if None in parts else f"({' '.join(map(str, parts))})"


def _text(value: Any) -> str | None:
    """A fixed value in words, the same in each process; `None` where it is no plain one."""
    if value is None or isinstance(value, bool | int | float | str | bytes | np.dtype):
        return repr(value)
    if isinstance(value, tuple | list | dict):
        items = value.items() if isinstance(value, dict) else value
        parts = [_text(item) for item in items]
        return None if None in parts else f"{_text(type(value))}[{', '.join(map(str, parts))}]"
    if isinstance(value, type):
        is_ours = value.__module__.split(".")[0] in ("rodjax", "builtins", "equinox")
        return f"{value.__module__}.{value.__qualname__}" if is_ours else None
    if isinstance(value, enum.Enum):
        kind = _text(type(value))
        return kind and f"{kind}.{value.name}"
    # What equinox puts in the place of a field that an object lacks.
    return "missing" if type(value).__module__.startswith("equinox.") and repr(value) == "Missing" else None


def settings() -> str:
    """Of JAX, as they are here and now."""
    names = [name for name in sorted(jax.config.values) if not name.startswith(WITHOUT_EFFECT)]
    return repr([(name, getattr(jax.config, name, None)) for name in names])


@functools.cache
def _surroundings() -> str:
    """All that stays the same in a process: source, versions, processor, flags."""
    versions = [f"{package} {importlib.metadata.version(package)}" for package in PACKAGES]
    versions += [sys.version, _devices()[0].client.platform_version]
    processor = [platform.machine(), platform.processor()]
    with suppress(OSError):
        described = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        processor += [line for line in described if line.startswith(("model name", "flags", "Features"))]
    flags = [os.environ.get("XLA_FLAGS", "")]
    return "\n".join([source(), *versions, *processor, *flags])


@functools.cache
def source() -> str:
    """A hash of this package's source."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _devices() -> tuple[Any, ...]:
    return (jax.devices()[0],)


@functools.cache
def is_single_processor() -> bool:
    """Whether this is one process without an accelerator."""
    return jax.default_backend() == "cpu" and jax.process_count() == 1


@functools.cache
def _prepare_lapack() -> None:
    """What JAX does before it compiles a call of LAPACK, which a program that is loaded has not had."""
    jax.jit(jax.lax.linalg.cholesky).lower(np.eye(1))


def said(value: str) -> str | bool:
    """What the environment variable asks for."""
    word = value.strip().lower()
    if word in ("off", "0", "false"):
        return False
    return word in ("", "on", "1", "true") or value


keep_programs(said(os.environ.get(VARIABLE, "")))
