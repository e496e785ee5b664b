"""JAX's persistent compilation cache: a new process then loads the programs that an earlier one compiled."""

import os
from pathlib import Path

import jax


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
