"""How an experiment measures: a compiled program and its times on one thread, the C++ program's, the machine's name."""

import csv
import os
import platform
import re
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import numpy as np

import rodjax

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
    """Double precision, one thread of XLA unless XLA_FLAGS says otherwise, and compiled programs from the first call;
    before JAX makes its first array.
    """
    os.environ.setdefault("XLA_FLAGS", ONE_THREAD)
    jax.config.update("jax_enable_x64", True)
    rodjax.numpy_first(False)


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

    def round(self, repeats: int, seconds: float = ROUND_SECONDS) -> float:
        """Median of some more runs [ms]."""
        count = max(1, min(repeats, int(seconds * 1e3 / self._guess)))
        times = [self._timed()[1] for _ in range(count)]
        self.times += times
        return statistics.median(times)


class CppRuns:
    """The C++ program on one mesh; a run repeats the problem for two seconds and leaves the nodes of the last scene."""

    def __init__(self, program: Path, problem: str, method: str, tolerance: str, segments: int):
        self._command = [str(program.resolve()), problem, method, tolerance, str(segments)]
        self._nodes_file = f"cpp_{problem}_{method}_{segments}.txt"
        self.reports: list[dict[str, float]] = []  # the names of `REPORT`; times in ms, of one step in a path

    def round(self) -> float:
        """Median of a run [ms]."""
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder, "out")
            out.mkdir()
            output = subprocess.run(self._command, capture_output=True, text=True, check=True, cwd=folder).stdout
            report = REPORT.search(output)
            if report is None:
                command = " ".join(self._command)
                raise ValueError(f"{command} printed no line of numbers that this script knows: {output!r}")
            self.nodes = np.loadtxt(out / self._nodes_file)
        self.reports.append({name: float(value) for name, value in report.groupdict().items()})
        return self.reports[-1]["median"]


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
