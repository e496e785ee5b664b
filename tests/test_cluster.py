"""Sweeps on a real Dask scheduler with worker processes, on this machine: the bits of one process, whoever dies."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_sweep import GRID, SCENE, assert_same

import rodjax as rj
from rodjax.cli import main
from rodjax.io.harness_file import read_scene
from rodjax.sweeps.result import summary
from rodjax.sweeps.sweep import sweep

pytest.importorskip("distributed", reason="Dask is not installed: pip install 'rodjax[cluster]'")
PAGE = Path(__file__).parents[1] / "docs" / "cluster.md"
CHUNK = 4
# In 60 chunks, so that there is time to kill somebody.
CASES = 240
MANY = GRID.replace("count = 5", f"count = {CASES // 2}")
# Of which programs are small.
CANTILEVER = """
[rod]
length = "1 m"
EI = "4.9e-3 N m^2"
GJ = "3.3e-3 N m^2"
EA = "785 N"
[start]
support = "clamp"
position = "[0, 0, 0] m"
tangent = [1, 0, 0]
d2 = [0, 1, 0]
[end]
support = "free"
force = "[0, 0, -0.01] N"
[solve]
segments = 4
discretization = "finite_difference"
"""
SECONDS = 120.0


class Cluster:
    """A scheduler and workers, each a process that hears on 127.0.0.1 alone."""

    def __init__(self, folder: Path):
        self._folder = folder
        self.processes: list[subprocess.Popen] = []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"

    def start(self, *arguments: str) -> subprocess.Popen:
        # A program that hears on no other address and has no page of its own.
        command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:], "--host", "127.0.0.1"]
        environment = {**os.environ, "PYTHONPATH": str(Path(rj.__file__).parents[1])}
        options: dict[str, Any] = dict(env=environment, cwd=self._folder)
        with open(self._folder / f"{len(self.processes)}.log", "w") as log:
            process = subprocess.Popen([*command, "--no-dashboard"], stdout=log, stderr=log, **options)
        self.processes.append(process)
        return process

    def scheduler(self) -> subprocess.Popen:
        process = self.start("dask_scheduler", "--port", str(self.port))

        def answers() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.port)) == 0

        wait_until(answers)
        return process

    def worker(self) -> subprocess.Popen:
        return self.start("dask_worker", self.address, "--nthreads", "1", "--no-nanny")

    def close(self) -> None:
        for process in reversed(self.processes):
            process.kill()
            process.wait()


def wait_until(holds: Callable[[], Any]) -> None:
    deadline = time.monotonic() + SECONDS
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@contextmanager
def threads_as_cluster() -> Iterator[str]:
    """The address of a scheduler with a worker, which are threads of this process that hear on 127.0.0.1."""
    from distributed import LocalCluster

    settings: dict[str, Any] = dict(processes=False, protocol="tcp", host="127.0.0.1", dashboard_address=None)
    with LocalCluster(n_workers=1, threads_per_worker=1, **settings) as cluster:
        assert cluster.scheduler_address.startswith("tcp://127.0.0.1:")
        yield cluster.scheduler_address


@pytest.fixture
def cluster(tmp_path) -> Iterator[Cluster]:
    folder = tmp_path / "cluster"
    folder.mkdir()
    cluster = Cluster(folder)
    try:
        yield cluster
    finally:
        cluster.close()


@pytest.fixture
def files(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    Path("grid.toml").write_text(MANY)
    return tmp_path


def command(address: str, output: str, *more: str) -> list[str]:
    arguments = ["sweep", "scene.toml", "--over", "grid.toml", "-o", output, "--chunk", str(CHUNK)]
    return [*arguments, "--scheduler", address, *more]


def started(cluster: Cluster, output: str) -> subprocess.Popen:
    """The command, of which some chunks are done and more are not."""
    arguments = [sys.executable, "-W", "error", "-m", "rodjax", *command(cluster.address, output)]
    # How long a scheduler that is lost is looked for.
    environment = {**os.environ, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s"}
    options: dict[str, Any] = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    process = subprocess.Popen(arguments, **options)
    wait_until(lambda: done(output) > 5 or process.poll() is not None)
    assert process.poll() is None, process.communicate()
    return process


def done(output: str) -> int:
    return len(list(Path(f"{output}.parts").glob("chunk-*.h5")))


@pytest.mark.slow
@pytest.mark.skipif(not PAGE.exists(), reason="the tests run without the repository")
def test_the_block_of_the_documentation_runs(tmp_path, monkeypatch, by_numpy_code):
    """On a worker in this process, which no compiler is needed for."""
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(CANTILEVER)
    Path("table.csv").write_text("rod.EI\n0.004\n0.005\n")
    scene = read_scene("scene.toml")
    points = rj.solve(scene, segments=4).nodes[1:-1]
    experiments = [rj.Experiment(scene, [rj.Centerline(points, sd=1e-3)])] * 2
    block = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)[0]
    assert "tcp://10.0.0.1:8786" in block
    variables = {"__name__": "__main__", "experiments": experiments}
    with threads_as_cluster() as address:
        exec(block.replace("tcp://10.0.0.1:8786", address), variables)
    assert summary(Path("sweep.h5")).cases == 2


@pytest.mark.slow
def test_a_worker_and_the_scheduler_are_killed(cluster, files, capsys, for_processes):
    """And the sweep is finished, or resumed on another cluster; its bits are those of a sweep without one."""
    with for_processes():
        sweep("scene.toml", "grid.toml", "whole.h5", chunk=CHUNK)
    scheduler = cluster.scheduler()
    first, second = cluster.worker(), cluster.worker()
    process = started(cluster, "one.h5")
    first.send_signal(signal.SIGKILL)
    out, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 0, err
    assert f"{CASES} of {CASES} cases converged" in out
    assert err in ("", f"rodjax: the scheduler at {cluster.address} has no workers yet: waiting for them\n")
    assert_same("one.h5", "whole.h5")
    assert sorted(path.name for path in files.glob("one*")) == ["one.h5"]

    process = started(cluster, "two.h5")
    scheduler.send_signal(signal.SIGKILL)
    _, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 2, err
    said = err.splitlines()[-1]
    assert len(err.splitlines()) <= 2
    assert said.startswith("rodjax: ")
    assert "go on with --resume" in said
    chunks, count = CASES // CHUNK, done("two.h5")
    assert 5 < count < chunks
    second.kill()
    with threads_as_cluster() as address:
        assert main(command(address, "two.h5", "--resume")) == 0
    out, _ = capsys.readouterr()
    assert f"resumed: {count} of {chunks} chunks are there" in out
    assert_same("two.h5", "whole.h5")


def test_a_scheduler_that_does_not_answer_is_told_in_one_line(files, capsys, monkeypatch):
    monkeypatch.setattr("rodjax.cluster.TIMEOUT", 0.5)
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
        for given in (address, "no address"):
            options = ["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--scheduler", given]
            assert main(options) == 2
            err = capsys.readouterr().err
            assert err.startswith(
                "rodjax: --scheduler must be the address of a Dask scheduler, such as tcp://host:8786"
            )
            assert err.count("\n") == 1
    assert not list(files.glob("out*"))


@pytest.mark.slow
@pytest.mark.exhaustive
def test_tolerances_by_workers(cluster):
    """Numbers come back in the precision of who asked, as the workers have single precision."""
    from distributed import Client

    cluster.scheduler()
    cluster.worker(), cluster.worker()
    equilibrium = rj.solve(rj.problems.hanging_cable(), segments=8)
    tolerances = [rj.Tolerance("rod.length", 2e-3)]
    with rj.numpy_first(False):
        here = rj.tolerances(equilibrium, tolerances, samples=200, threads=1)
    with Client(cluster.address, set_as_default=False) as client:
        there = rj.tolerances(equilibrium, tolerances, samples=200, executor=client.get_executor(pure=False))
    assert here.sampled is not None
    assert there.sampled is not None
    np.testing.assert_array_equal(there.sampled.position, here.sampled.position)
    np.testing.assert_array_equal(there.sampled.end_force, here.sampled.end_force)
