"""How long is it until the first answer, and the next ones, and in another process? Each job in processes of its own.

Columns: seconds until the first answer in a fresh process with an empty cache, import included; programs that XLA
compiled for it; seconds of the same in a second process, with what the first one kept; milliseconds of an answer as
NumPy code (the second) and compiled (median of the last ten); seconds of compiling between.

    python experiments/first_answers.py [JOB ...] [--compiled-first] [--answers 14] [--out DIR]
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from measuring import machine, save_rows

SETTING = """
import time; begin = time.perf_counter()
import sys, json, jax; jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np, rodjax as rj
from jax import monitoring
programs = [0]
def listen(name, *_, **more): programs[0] += name.endswith("backend_compile_duration")
monitoring.register_event_duration_secs_listener(listen)
x, z, g = rj.frame(tangent=(1, 0, 0)), np.zeros(3), (0, 0, -9.81)
cable = rj.Rod.circular(length=1.0, radius=5e-3, youngs_modulus=1e7, poisson_ratio=0.5, density=1200)
flat = rj.Rod(length=1.0, EI=(4e-3, 8e-3), GJ=4e-3, EA=800.0, mass_per_length=0.1, radius=5e-3)
curved = rj.Rod(1.0, (4e-3, 8e-3), 4e-3, 800.0, 0.1, radius=5e-3, rest_curvature=(1.0, 0.0))
floor = rj.Plane((0, 0, -0.1), (0, 0, 1))
def scene(d=0.8, rod=cable, **more):
    return rj.Scene(rod, rj.Clamp(z, x), rj.Clamp(np.array([d, 0.0, 0.0]), x), gravity=g, **more)
def traced(d, rod=cable, **more):
    return rj.Scene(rod, rj.Clamp(z, x), rj.Clamp(jnp.array([d, 0.0, 0.0]), x), gravity=g, **more)
def follower(d): return rj.Scene(flat, rj.Clamp(z, x), rj.Free(force=(0.0, 0.0, 0.02 * d), follower=True))
clip = rj.Clip(0.5, (0.4, 0.05, -0.1))
places = np.linspace(0.05, 0.95, 20)
def measured(d):
    points = rj.Centerline(np.asarray(truth.position_at(places)) + 1e-4 * d, places, sd=1e-3)
    return rj.Experiment(scene(0.8), [points, rj.EndForce(np.asarray(truth.end_force), sd=5e-3)])
ranges = [
    rj.Between("clips.0.position", (0.3, 0, -0.15), (0.5, 0.1, -0.05)),
    rj.Between("clips.0.at", 0.45, 0.6),
    rj.Between("rod.length", 0.95, 1.1),
]
scatter = [rj.Tolerance("rod.length", 2e-3), rj.Tolerance("rod.EI", 1e-4)]
short = rj.Objective(length=1, energy=1)
def limits(d): return rj.Limits(bend_radius=4.0 + d)
part, joint, more = rj.Rod.circular(0.5, 5e-3, 1e7, poisson_ratio=0.5, density=1200), rj.Joint("y", x), dict(gravity=g)
def harness(d, obstacles=(), clips=()):
    trunk = rj.Scene(part, rj.Clamp(z, x), joint, clips=clips, obstacles=obstacles, **more)
    left = rj.Scene(part, joint, rj.Clamp(np.array([d, 0.2, 0]), x), obstacles=obstacles, **more)
    right = rj.Scene(part, joint, rj.Pin(np.array([d, -0.2, 0])), obstacles=obstacles, **more)
    return rj.Harness(dict(trunk=trunk, left=left, right=right))
sliding = rj.Clip(0.2, (0.19, 0.0, 0.01), sliding=True)
"""
JOBS = {
    "solve": "rj.solve(scene(d)).nodes",
    "segments_50": "rj.solve(scene(d), segments=50).nodes",
    "differences_50": "rj.solve(scene(d), segments=50, discretization='finite_difference').nodes",
    "describe": "rj.describe(rj.solve(scene(d)))",
    "path_25": "rj.solve_path([scene(d + 0.001 * k) for k in range(25)], segments=16).nodes",
    "batch_64": "rj.solve_batch(jax.vmap(traced)(d + 0.001 * jnp.arange(64)), segments=16).nodes",
    "gradient": "jax.grad(lambda d: rj.solve(traced(d), segments=16).end_force[0])(d)",
    "end_stiffness": "rj.end_stiffness(scene(d), segments=16)",
    "clip": "rj.solve(scene(d, clips=[clip])).nodes",
    "flat": "rj.solve(scene(d, rod=flat)).nodes",
    "curved": "rj.solve(scene(d, rod=curved)).nodes",
    "follower": "rj.solve(follower(d), segments=32).nodes",
    "contact": "rj.solve(scene(d, obstacles=[floor])).nodes",
    "contact_gradient": "jax.grad(lambda d: rj.solve(traced(d, obstacles=[floor]), segments=32).end_force[0])(d)",
    "harness": "rj.solve(harness(d), segments=16).energy",
    "harness_contact": "rj.solve(harness(d, [floor], [sliding]), segments=16).energy",
    "fit": "rj.fit([measured(d)], ['rod.EI', 'rod.length', 'rod.mass_per_length']).report()",
    "route": "str(rj.route(scene(0.8, clips=[clip]), ranges, limits=limits(d), objective=short, starts=4))",
    "tolerances": "rj.tolerances(rj.solve(scene(d, clips=[clip])), scatter, limits=limits(0))",
}
# What a job takes as given, which does not count.
GIVEN = {"fit": "truth = rj.solve(scene(0.8), segments=24)"}
END = """
def job(d): return jax.block_until_ready({job})
begin += time.perf_counter() - pause
job(0.8); first, compiled = time.perf_counter() - begin, programs[0]
times = []
for k in range(1, {answers}):
    start = time.perf_counter(); job(0.8 + 1e-4 * k); times.append(time.perf_counter() - start)
print("RESULT", json.dumps(dict(first=first, programs=compiled, times=times)))
"""


class Row(NamedTuple):
    job: str
    first_s: float
    programs: int
    second_s: float
    numpy_ms: float
    compiled_ms: float
    compiling_s: float


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jobs", nargs="*", metavar="JOB", help=", ".join(JOBS))
    parser.add_argument("--compiled-first", action="store_true", help="no NumPy code: RODJAX_NUMPY_FIRST=off")
    parser.add_argument("--answers", type=int, default=14, help="of each job in its first process")
    parser.add_argument("--out", type=Path, help="a folder for first_answers.csv")
    options = parser.parse_args(argv)
    print(f"{machine()}, load {os.getloadavg()[0]:.1f}")
    print(
        f"{'job':18}{'first s':>9}{'programs':>9}{'second s':>9}{'NumPy ms':>9}{'compiled ms':>12}{'compiling s':>12}"
    )
    rows = []
    for job in options.jobs or JOBS:
        rows.append(row(job, options.answers, not options.compiled_first))
        cells = rows[-1]
        print(
            f"{job:18}{cells.first_s:9.2f}{cells.programs:9d}{cells.second_s:9.2f}{cells.numpy_ms:9.1f}"
            f"{cells.compiled_ms:12.2f}{cells.compiling_s:12.1f}",
            flush=True,
        )
    if options.out:
        save_rows(rows, options.out / "first_answers.csv")
    return rows


def row(job: str, answers: int, numpy_first: bool) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        first = process(job, answers, numpy_first, folder)
        second = process(job, 1, numpy_first, folder)
    times = first["times"] or [float("nan")]
    compiled = 1e3 * statistics.median(times[-10:])
    return Row(job, first["first"], first["programs"], second["first"], 1e3 * times[0], compiled, max(times))


def process(job: str, answers: int, numpy_first: bool, folder: str) -> dict[str, Any]:
    """A fresh one that keeps its programs in a folder."""
    given = f"pause = time.perf_counter()\n{GIVEN.get(job, '')}"
    code = SETTING + given + END.replace("{job}", JOBS[job]).replace("{answers}", str(answers))
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    environment |= {"RODJAX_CACHE": folder, "MPLBACKEND": "agg", "RODJAX_NUMPY_FIRST": "on" if numpy_first else "off"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=folder)
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if not lines:
        raise RuntimeError(f"{job}: {done.stderr[-2000:]}")
    return json.loads(lines[-1].removeprefix("RESULT "))


if __name__ == "__main__":
    main()
