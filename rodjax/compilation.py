"""How the library's programs are compiled: in half the time, and once only where they are kept on disk."""

import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from jax.extend.core import get_opaque_trace_state

from rodjax.checks import is_known

# XLA's older generator of code for loops on a processor: half the compile time at the same run time, see
# `docs/design.md`. jaxlib 0.12 has it no more.
QUICK = {"xla_cpu_use_fusion_emitters": False}
_OUTSIDE = get_opaque_trace_state()


def compiled(function: Callable, static_argnames: Sequence[str] = ()) -> Callable:
    """`jax.jit` of a function, compiled with `QUICK` where it is a program of its own and not a part of another."""
    part = jax.jit(function, static_argnames=static_argnames)
    quick = jax.jit(function, static_argnames=static_argnames, compiler_options=QUICK)

    @functools.wraps(function)
    def call(*args, **options):
        return (quick if _is_whole(args, options) and _knows_quick() else part)(*args, **options)

    return call


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
    """Keep compiled programs on disk, in `directory` or `$XDG_CACHE_HOME/rodjax`, and return where.

    A process that calls this before its first solve compiles nothing that an earlier one compiled. It changes JAX's
    configuration for the whole process; rodjax calls it only in its command line and tests.
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
