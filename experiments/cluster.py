"""What does an engine cost a sweep, and what do more workers and threads bring?

A cable of 50 elements between two clamps, as in `sweep_stress.py`, in chunks of 1024 cases: cases a second of one
process with one thread and with two, of one Dask worker and of two on this machine, each after a sweep that compiles.
The kinds take turns, and the median of the rounds counts, as other programs may use the machine. All results must be
the same to the last bit.

    python experiments/cluster.py [--chunks 8] [--rounds 5]
"""

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from measuring import machine
from sweep_stress import check_same, write_table

import rodjax as rj
from rodjax.io.scene_writing import write_scene

ONE = "one process, one thread"


class Row(NamedTuple):
    name: str
    rate: float  # cases a second, median
    ratio: float  # to that of one process with one thread


def rows(folder: Path, kinds: dict[str, dict[str, Any]], cases: int, chunk: int, rounds: int) -> list[Row]:
    """Sweeps of each kind, by turns; those of the first round compile and are not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in range(rounds + 1):
        for name, options in kinds.items():
            output = folder / "out.h5"
            begin = time.perf_counter()
            rj.sweep(folder / "scene.toml", folder / "table.csv", output, chunk=chunk, **options)
            seconds[name].append(time.perf_counter() - begin)
            if not (folder / "first.h5").exists():
                output.rename(folder / "first.h5")
            else:
                check_same(folder / "first.h5", output)
                output.unlink()
    rates = {name: cases / statistics.median(times[1:]) for name, times in seconds.items()}
    return [Row(name, rate, rate / rates[ONE]) for name, rate in rates.items()]


def dask_executor(stack: ExitStack, workers: int) -> Executor:
    from distributed import Client, LocalCluster

    options: dict[str, Any] = dict(threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0")
    cluster = stack.enter_context(LocalCluster(n_workers=workers, **options))
    client = stack.enter_context(Client(cluster, set_as_default=False))
    return client.get_executor(pure=False)


def main(
    argv: Sequence[str] | None = None, executor: Callable[[ExitStack, int], Executor] = dask_executor
) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=int, default=8)
    parser.add_argument("--chunk", type=int, default=1024)
    parser.add_argument("--segments", type=int, default=50)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(argv)
    cases = options.chunks * options.chunk
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        write_scene(rj.problems.hanging_cable(), folder / "scene.toml", options.segments)
        write_table(folder / "table.csv", cases, seed=0)
        kinds: dict[str, dict[str, Any]] = {ONE: {"threads": 1}, "one process, two threads": {"threads": 2}}
        kinds |= {f"{count} of Dask's workers": {"executor": executor(stack, count)} for count in (1, 2)}
        found = rows(folder, kinds, cases, options.chunk, options.rounds)
    print(f"{machine()}, load {os.getloadavg()[0]:.1f}; {options.chunks} chunks of {options.chunk}")
    for row in found:
        print(f"{row.name:26} {row.rate:7.0f} cases/s, {row.ratio:.2f} times")
    return found


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    main()
