"""Does a sweep that is killed at random lose anything, and how much memory does it take?

A cable of 50 elements between two clamps, its length, stiffness, span and turn drawn at random for each of 100000 cases
(`--cases`): `rodjax sweep` once without a stop, then again with two kills (SIGKILL) at random moments, resumed each
time. All datasets and attributes of the two results must be the same to the last bit; no finished chunk may get lost.
"""

import argparse
import itertools
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

import rodjax
from rodjax.io.scene_writing import write_scene

HEADER = "rod.length,rod.EI,end.position.0,end.spin,loads.gravity.1"


class Run(NamedTuple):
    """One call of the command: `done` chunks when it ended, of these `before` when it began; peak of its memory."""

    seconds: float
    before: int
    done: int
    peak_mib: float
    was_killed: bool


class Kill(NamedTuple):
    """When to kill: so many seconds after there are so many chunks."""

    chunks: int
    delay: float


def main(argv: Sequence[str] | None = None) -> list[Run]:
    options = _options(argv)
    with tempfile.TemporaryDirectory(dir=options.out) as name:
        folder = Path(name)
        write_scene(rodjax.problems.hanging_cable(), folder / "scene.toml", options.segments)
        write_table(folder / "table.csv", options.chunk, options.seed)
        _run(folder, "compiled.h5", options.chunk)  # the cache has the programs after this
        write_table(folder / "table.csv", options.cases, options.seed)
        whole = _run(folder, "whole.h5", options.chunk)
        _print("without a stop", whole, options.cases)
        runs = [whole, *_killed_runs(folder, options, whole.seconds)]
        check_same(folder / "whole.h5", folder / "killed.h5")
    print(f"the same to the last bit; largest memory {max(run.peak_mib for run in runs):.0f} MiB")
    return runs


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--segments", type=int, default=50)
    parser.add_argument("--chunk", type=int, default=1024)
    parser.add_argument("--kills", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None, help="folder for the files, which are removed; else /tmp")
    return parser.parse_args(argv)


def write_table(path: Path, cases: int, seed: int) -> None:
    draw = np.random.default_rng(seed).uniform
    length, span = draw(0.9, 1.2, cases), draw(0.5, 0.85, cases)
    columns = [length, draw(3e-3, 8e-3, cases), span, draw(-1.5, 1.5, cases), draw(-2.0, 2.0, cases)]
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=HEADER, comments="", fmt="%.17g")


def _killed_runs(folder: Path, options: argparse.Namespace, seconds: float) -> list[Run]:
    """Killed at random moments, each in its share of the chunks, and at last run to the end."""
    draw = random.Random(options.seed).uniform
    chunks = -(-options.cases // options.chunk)
    runs = []
    for k in range(options.kills):
        kill = Kill(int(chunks * (k + draw(0.0, 0.8)) / options.kills), draw(0.0, seconds / chunks))
        runs.append(_run(folder, "killed.h5", options.chunk, kill, resume=k > 0))
        _print(f"kill {k + 1}", runs[-1], options.cases)
    runs.append(_run(folder, "killed.h5", options.chunk, resume=True))
    _print("to the end", runs[-1], options.cases)
    if any(run.done != after.before for run, after in itertools.pairwise(runs) if run.was_killed):
        raise SystemExit("finished chunks got lost")
    return runs


def _run(folder: Path, output: str, chunk: int, kill: Kill | None = None, resume: bool = False) -> Run:
    command = [sys.executable, "-m", "rodjax", "sweep", "scene.toml", "--over", "table.csv", "-o", output]
    command += ["--chunk", str(chunk), *(["--resume"] if resume else [])]
    parts = folder / f"{output}.parts"
    begin = time.perf_counter()
    with open(folder / "said.txt", "w+") as said:
        process = subprocess.Popen(command, cwd=folder, stdout=said)
        status, peak = _ended(process.pid, parts, kill)
        process.returncode = status  # it has been waited for
        said.seek(0)
        resumed = re.search(r"resumed: (\d+) of", said.read())
    if status not in (0, 3, -signal.SIGKILL):
        raise SystemExit(f"{' '.join(command)} ended with {status}")
    before = int(resumed[1]) if resumed else 0
    return Run(time.perf_counter() - begin, before, _chunks(parts), peak, status == -signal.SIGKILL)


def _ended(process: int, parts: Path, kill: Kill | None) -> tuple[int, float]:
    """Waits for a process, and kills it when it is time; its exit status and the peak of its memory [MiB]."""
    while True:
        ended, status, usage = os.wait4(process, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), usage.ru_maxrss / 1024
        if kill is not None and _chunks(parts) >= kill.chunks:
            time.sleep(kill.delay)
            os.kill(process, signal.SIGKILL)
            kill = None
        time.sleep(0.01)


def _chunks(parts: Path) -> int:
    return len(list(parts.glob("chunk-*.h5")))


def _print(name: str, run: Run, cases: int) -> None:
    end = f"killed with {run.done} chunks done" if run.was_killed else "complete"
    rate = "" if run.was_killed or run.before else f", {cases / run.seconds:.0f} cases/s with the start"
    print(
        f"{name:15} {run.seconds:7.1f} s, {run.before} chunks before, {end}, {run.peak_mib:.0f} MiB{rate}", flush=True
    )


def check_same(one: Path, other: Path) -> None:
    with h5py.File(one) as first, h5py.File(other) as second:
        names = _datasets(first)
        differing = [name for name in names if not np.array_equal(_bits(first, name), _bits(second, name))]
        if names != _datasets(second) or dict(first.attrs.items()) != dict(second.attrs.items()) or differing:
            raise SystemExit(f"the results differ: {', '.join(differing) or 'other datasets or attributes'}")


def _datasets(file: h5py.File) -> list[str]:
    names = []
    file.visititems(lambda name, entry: names.append(name) if isinstance(entry, h5py.Dataset) else None)
    return names


def _bits(file: h5py.File, name: str) -> np.ndarray:
    dataset = file[name]
    assert isinstance(dataset, h5py.Dataset)
    return np.frombuffer(dataset[()].tobytes(), np.uint8)


if __name__ == "__main__":
    main()
