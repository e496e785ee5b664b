"""Sweeps on a real Dask scheduler with worker processes, on this machine: the bits of one process, whoever dies."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
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
# 400 cases in 100 chunks, so that there is time to kill somebody.
MANY = GRID.replace("count = 5", "count = 200")
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
    sweep("scene.toml", "grid.toml", "whole.h5", chunk=CHUNK)
    return tmp_path


def command(cluster: Cluster, *more: str) -> list[str]:
    arguments = ["sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--chunk", str(CHUNK)]
    return [*arguments, "--scheduler", cluster.address, *more]


def started(cluster: Cluster) -> subprocess.Popen:
    arguments = [sys.executable, "-W", "error", "-m", "rodjax", *command(cluster)]
    # How long a scheduler that is lost is looked for.
    environment = {**os.environ, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s"}
    options: dict[str, Any] = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    process = subprocess.Popen(arguments, **options)
    wait_until(lambda: len(list(Path("out.h5.parts").glob("chunk-*.h5"))) > 5 or process.poll() is not None)
    assert process.poll() is None, process.communicate()
    return process


@pytest.mark.slow
@pytest.mark.skipif(not PAGE.exists(), reason="the tests run without the repository")
def test_the_block_of_the_documentation_runs(cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    Path("table.csv").write_text("rod.EI\n0.004\n0.005\n")
    scene = read_scene("scene.toml")
    points = rj.solve(scene, segments=4).nodes[1:-1]
    experiments = [rj.Experiment(scene, [rj.Centerline(points, sd=1e-3)])] * 2
    cluster.scheduler()
    cluster.worker()
    block = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)[0]
    assert "tcp://10.0.0.1:8786" in block
    variables = {"__name__": "__main__", "experiments": experiments}
    exec(block.replace("tcp://10.0.0.1:8786", cluster.address), variables)
    assert summary(Path("sweep.h5")).cases == 2


@pytest.mark.slow
def test_a_worker_is_killed(cluster, files):
    cluster.scheduler()
    first, _ = cluster.worker(), cluster.worker()
    process = started(cluster)
    first.send_signal(signal.SIGKILL)
    out, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 0, err
    assert "400 of 400 cases converged" in out
    assert err in ("", f"rodjax: the scheduler at {cluster.address} has no workers yet: waiting for them\n")
    assert_same("out.h5", "whole.h5")
    assert sorted(path.name for path in files.glob("out*")) == ["out.h5"]


@pytest.mark.slow
def test_the_scheduler_is_killed_and_the_sweep_resumed(cluster, files, capsys):
    scheduler = cluster.scheduler()
    workers = cluster.worker(), cluster.worker()
    process = started(cluster)
    scheduler.send_signal(signal.SIGKILL)
    _, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 2, err
    said = err.splitlines()[-1]
    assert len(err.splitlines()) <= 2
    assert said.startswith("rodjax: ")
    assert "go on with --resume" in said
    done = len(list(Path("out.h5.parts").glob("chunk-*.h5")))
    assert 5 < done < 100
    for worker in workers:
        worker.kill()
    cluster.scheduler()
    cluster.worker()
    assert main(command(cluster, "--resume")) == 0
    out, _ = capsys.readouterr()
    assert f"resumed: {done} of 100 chunks are there" in out
    assert_same("out.h5", "whole.h5")


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
