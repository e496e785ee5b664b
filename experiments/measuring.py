"""How an experiment measures: a compiled program and its times on one thread, the C++ program's, the machine's name."""

import csv
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
# A slow program is repeated for about so long [s] in a round, once at least.
ROUND_SECONDS = 6.0
# What the C++ program prints of a run.
REPORT = re.compile(
    r"min (?P<min>\S+) med (?P<median>\S+) +iters tot (?P<iterations>\d+) max/step (?P<most>\d+) +evals (?P<evals>\d+)"
    r".*notconv (?P<failures>\d+) +\|g\|/fs (?P<residual>\S+) E/\(EI/L\) (?P<energy>\S+)"
)

Result = TypeVar("Result")


def set_up() -> None:
    """Double precision, and one thread of XLA unless XLA_FLAGS says otherwise; before JAX makes its first array."""
    os.environ.setdefault("XLA_FLAGS", ONE_THREAD)
    jax.config.update("jax_enable_x64", True)


def conditions() -> str:
    """The machine, its load and the threads, for the head of a table."""
    threads = f"XLA_FLAGS={os.environ['XLA_FLAGS']} OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', '')}"
    return f"{machine()}, load {os.getloadavg()[0]:.1f}; {threads}"


def machine() -> str:
    """CPU model and cores."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        found = re.search(r"model name\s*: (.*)", information.read_text())
        model = found[1] if found else model
    return f"{model}, {os.cpu_count()} cores"


def compiled(function: Callable, *arguments: Any) -> tuple[jax.stages.Compiled, float]:
    """The program of a function for such arguments, and the seconds that it took to trace and compile."""
    begin = time.perf_counter()
    anew = jax.jit(lambda *arguments: function(*arguments))  # of the same function JAX would keep the last program
    program = anew.lower(*arguments).compile()
    return program, time.perf_counter() - begin


class Timed(Generic[Result]):
    """A program, the result of its first run, which warms up, and the times of the runs after it [ms]."""

    def __init__(self, run: Callable[[], Result]):
        self.run = run
        self.times: list[float] = []
        self.result, self._guess = self._timed()

    def _timed(self) -> tuple[Result, float]:
        begin = time.perf_counter()
        result = jax.block_until_ready(self.run())
        return result, (time.perf_counter() - begin) * 1e3

    def round(self, repeats: int) -> float:
        """Median of some more runs [ms]."""
        count = max(1, min(repeats, int(ROUND_SECONDS * 1e3 / self._guess)))
        times = [self._timed()[1] for _ in range(count)]
        self.times += times
        return statistics.median(times)


def cpp_report(program: Path, problem: str, method: str, tolerance: str, segments: int, folder: Path) -> dict[str, str]:
    """What the C++ program prints of one mesh: it repeats the problem for two seconds and gives the median.

    Where `folder` has a folder `out`, it leaves the last nodes there.
    """
    command = [str(program.resolve()), problem, method, tolerance, str(segments)]
    output = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder).stdout
    report = REPORT.search(output)
    if report is None:
        raise ValueError(f"{' '.join(command)} printed no line of numbers that this script knows: {output!r}")
    return report.groupdict()


def number(value: float, format_spec: str, width: int) -> str:
    """A cell of a table; a dash for what is not known."""
    return f"{'-' if value != value else format(value, format_spec):>{width}}"


def save_rows(rows: Sequence[NamedTuple], file: Path) -> None:
    """Rows of one type as CSV, in a folder made if need be."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with open(file, "w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(rows[0]._fields)
        writer.writerows(rows)
