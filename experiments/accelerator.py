"""How many independent scenes a second on an accelerator? `rodjax.solve_batch` there and on one core of the processor.

Seeded scenes: a cable between two clamps about 0.7 L apart, their directions about 17 degrees off, under its weight;
the same with two bending stiffnesses, over a floor, and cut into two rods of a harness. Then a scene by itself, and a
number made of all end forces with its derivatives by all bending stiffnesses, in one program. Where JAX has no
accelerator the same runs on the processor.

    python experiments/accelerator.py [--count 100000] [--of-core 256]
                                      [--kinds differences elements frames floor harness] [--profile]
"""

import argparse
import collections
import gzip
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import set_up
from scipy.spatial.transform import Rotation

import rodjax
from rodjax import Clamp, Harness, Joint, Plane, Rod, Scene, frame, problems

KINDS: dict[str, tuple[Any, int, float]] = {  # discretization, segments, part of the scenes
    "differences": ("finite_difference", 50, 1.0),
    "elements": ("hermite", 16, 1.0),
    "frames": ("hermite", 16, 0.25),
    "floor": ("hermite", 16, 0.01),
    "harness": ("hermite", 8, 0.01),
}
REPEATS = 5


class Row(NamedTuple):
    name: str
    scenes: int
    first: float  # s, of the first call
    there: float  # us a scene on the accelerator
    core: float  # us a scene on one core
    memory: float  # GB, the most there so far
    difference: float  # of nodes, in lengths
    converged: float  # share
    iterations: float  # mean


def processor() -> Any:
    return jax.devices("cpu")[0]


def stacked(kind: str, count: int) -> Any:
    """The scenes of a kind, made on the processor."""
    rng = np.random.default_rng(0)
    cable = problems.cable()
    if kind == "frames":
        cable = Rod(cable.length, (cable.EI, 2 * cable.EI), cable.GJ, cable.EA, cable.mass_per_length, cable.radius)
    obstacles = (Plane((0, 0, -0.15), (0, 0, 1)),) if kind == "floor" else ()
    turns = Rotation.from_rotvec(rng.normal(scale=0.3, size=(2 * count, 3))).as_matrix() @ np.asarray(frame((1, 0, 0)))
    ends = np.array([0.7, 0, 0]) + rng.uniform(-0.1, 0.1, (count, 3))

    def scene(first, last, end):
        if kind == "harness":
            half = eqx.tree_at(lambda rod: rod.length, cable, cable.length / 2)
            cut = Joint("cut", np.eye(3))
            begin = Scene(half, Clamp((0, 0, 0), first), cut, (0, 0, -9.81))
            return Harness({"begin": begin, "end": Scene(half, cut, Clamp(end, last), (0, 0, -9.81))})
        return Scene(cable, Clamp((0, 0, 0), first), Clamp(end, last), (0, 0, -9.81), obstacles=obstacles)

    with jax.default_device(processor()):
        made = jax.jit(jax.vmap(scene))(turns[:count], turns[count:], ends)
    return jax.tree.map(np.asarray, made)


def least_seconds(run: Callable[[], Any]) -> tuple[Any, float, float]:
    """The result, the seconds of the first call and the least of the following."""
    result, times = None, []
    for _ in range(REPEATS + 1):
        begin = time.perf_counter()
        result = jax.block_until_ready(run())
        times.append(time.perf_counter() - begin)
    return result, times[0], min(times[1:])


def peak_gigabytes() -> float:
    found = jax.devices()[0].memory_stats() or {}
    return found.get("peak_bytes_in_use", np.nan) / 1e9


def measured(kind: str, count: int, of_core: int) -> Row:
    discretization, segments, part = KINDS[kind]
    options: dict[str, Any] = {"discretization": discretization, "segments": segments}
    count = max(int(part * count), 16)
    scenes = stacked(kind, count)
    there = jax.device_put(scenes)
    result, first, seconds = least_seconds(lambda: rodjax.solve_batch(there, **options))
    some = min(of_core, count)
    few = jax.tree.map(lambda leaf: leaf[:some], scenes)
    with jax.default_device(processor()):
        alone, _, core = least_seconds(lambda: rodjax.solve_batch(few, threads=1, **options))
    theirs, ours = (found["begin"].nodes if kind == "harness" else found.nodes for found in (result, alone))
    difference = float(np.max(np.abs(np.asarray(theirs[:some]) - ours)))
    numbers = float(np.mean(result.converged)), float(np.mean(result.iterations))
    return Row(kind, count, first, 1e6 * seconds / count, 1e6 * core / some, peak_gigabytes(), difference, *numbers)


def derivatives(count: int) -> tuple[float, float, float]:
    """Us a scene of a value of all results in one program, and of that with its gradient; relative error of one of its
    entries.
    """
    scenes = jax.device_put(stacked("elements", count))

    def total(stiffness: jax.Array) -> jax.Array:
        changed = eqx.tree_at(lambda scenes: scenes.rod.EI, scenes, stiffness)
        forces = rodjax.solve_batch(changed, discretization="hermite", segments=16).end_force
        return jnp.sum(jnp.sum(forces**2, axis=-1))

    stiffness = scenes.rod.EI
    value, both = jax.jit(total), jax.jit(jax.value_and_grad(total))
    _, _, alone = least_seconds(lambda: value(stiffness))
    (_, slopes), _, seconds = least_seconds(lambda: both(stiffness))
    h = 1e-5 * float(stiffness[0])
    by_difference = (both(stiffness.at[0].add(h))[0] - both(stiffness.at[0].add(-h))[0]) / (2 * h)
    return 1e6 * alone / count, 1e6 * seconds / count, float(abs(slopes[0] / by_difference - 1))


def alone_seconds() -> tuple[float, float]:
    """A scene by itself, from its initial shape, on the accelerator and on the processor."""
    scene = jax.tree.map(lambda leaf: leaf[0], stacked("elements", 1))

    def solve():
        return rodjax.solve(scene, discretization="hermite", segments=16)

    there = least_seconds(solve)[2]
    with jax.default_device(processor()):
        return there, least_seconds(solve)[2]


def profile(kind: str, count: int) -> list[tuple[str, int, float]]:
    """The kernels of one batch: name, how often, seconds together; the longest first."""
    discretization, segments, _ = KINDS[kind]
    scenes = jax.device_put(stacked(kind, count))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(rodjax.solve_batch(scenes, discretization=discretization, segments=segments))
        (file,) = Path(folder).glob("**/*.trace.json.gz")
        events = json.loads(gzip.decompress(file.read_bytes()))["traceEvents"]
    devices = {event["pid"] for event in events if "/device:" in str(event.get("args", {}).get("name"))}
    count_of, seconds = collections.Counter(), collections.Counter()
    for event in events:
        if event.get("ph") == "X" and event["pid"] in devices:
            count_of[event["name"]] += 1
            seconds[event["name"]] += 1e-6 * event["dur"]
    return [(name, count_of[name], total) for name, total in seconds.most_common()]


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--of-core", type=int, default=256, help="scenes that the processor's core solves")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--profile", action="store_true", help="print which kernels take how long")
    arguments = parser.parse_args(argv)
    set_up()
    device = jax.devices()[0]
    print(f"{device.device_kind} ({device.platform}), JAX {jax.__version__}, float64")
    head = f"{'':14}{'scenes':>8}{'first s':>9}{'us a scene':>12}{'core us':>10}{'ratio':>8}{'GB':>7}"
    print(f"{head}{'difference':>12}{'converged':>11}{'turns':>7}", flush=True)
    found = []
    for kind in arguments.kinds:
        row = measured(kind, arguments.count, arguments.of_core)
        found.append(row)
        print(
            f"{row.name:14}{row.scenes:8}{row.first:9.1f}{row.there:12.2f}{row.core:10.1f}{row.core / row.there:8.1f}"
            f"{row.memory:7.2f}{row.difference:12.1e}{row.converged:11.4f}{row.iterations:7.2f}",
            flush=True,
        )
    there, core = alone_seconds()
    print(f"a scene by itself: {1e3 * there:.2f} ms, on the processor {1e3 * core:.2f} ms", flush=True)
    value, both, error = derivatives(arguments.count)
    print(
        f"value {value:.2f} us a scene, with its gradient {both:.2f} ({both / value:.2f}); error {error:.0e}",
        flush=True,
    )
    if arguments.profile:
        rows = profile(arguments.kinds[0], arguments.count)
        print(f"{sum(count for _, count, _ in rows)} kernels, {sum(row[2] for row in rows):.3f} s")
        for name, count, seconds in rows[:20]:
            print(f"{1e3 * seconds:10.2f} ms {count:7} x {name[:80]}")
    return found


if __name__ == "__main__":
    main()
