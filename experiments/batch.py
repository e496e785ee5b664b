"""How many independent scenes a second? `rodjax.solve_batch` beside one solve after another, and scipy's L-BFGS.

Seeded scenes: a cable between two clamps about 0.7 L apart, their directions about 17 degrees off, under its weight.
Then the same with every fiftieth scene replaced by one that takes some ten times as many turns of Newton's method.

    python experiments/batch.py [--count 1024] [--segments 50] [--lbfgs 8]
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from measuring import conditions, set_up
from scipy.spatial.transform import Rotation
from work_precision import Scipy, begun, reached

import rodjax
from rodjax import Clamp, Scene, frame, problems
from rodjax.paths.path import stack_scenes
from rodjax.solving.first_state import first_state
from rodjax.solving.options import Discretization, Options

HARD_SHARE = 50  # one scene in so many
HARD_TURNS = 10.0  # times the median of the others
METHOD = Scipy("L-BFGS-B", {"gtol": 1e-8, "ftol": 0.0, "maxiter": 100_000, "maxfun": 200_000})


class Row(NamedTuple):
    name: str
    ms: float  # a scene
    turns: float  # mean of a scene
    converged: float  # share


def scenes(count: int, rng: np.random.Generator, *, hard: bool = False) -> list[Scene]:
    """Clamps that are nearly level; or hard ones: any frames, any span, a heavy cable."""
    rod = problems.cable()
    x = np.asarray(frame((1, 0, 0)))

    def clamp(position):
        turn = Rotation.from_quat(rng.normal(size=4)) if hard else Rotation.from_rotvec(rng.normal(scale=0.3, size=3))
        return Clamp(position, turn.as_matrix() @ x)

    def far_end():
        return rng.normal(scale=0.3, size=3) if hard else np.array([0.7, 0, 0]) + rng.uniform(-0.1, 0.1, 3)

    weight = 20.0 if hard else 1.0
    return [Scene(rod, clamp((0, 0, 0)), clamp(far_end()), (0, 0, -9.81 * weight)) for _ in range(count)]


def median_ms(run: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """The result, and the median time after a run that compiles."""
    result = jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - begin)
    return result, 1e3 * statistics.median(times)


def rows(count: int, segments: int, discretization: Discretization, repeats: int) -> list[Row]:
    """One after another in a compiled scan, under vmap, in lanes; easy scenes and the mixture."""
    options: dict[str, Any] = {"segments": segments, "discretization": discretization}
    rng = np.random.default_rng(0)
    easy = stack_scenes(scenes(count, rng))
    candidates = stack_scenes(scenes(4 * count, rng, hard=True))
    one_by_one = jax.jit(lambda stack: jax.lax.map(lambda scene: rodjax.solve(scene, **options), stack))
    side_by_side = jax.jit(jax.vmap(lambda scene: rodjax.solve(scene, **options)))

    def lanes(stack):
        return rodjax.solve_batch(stack, **options)

    typical = float(np.median(lanes(easy).evaluations))
    tried = lanes(candidates)
    turns = np.where(np.asarray(tried.converged), np.asarray(tried.evaluations), 0)
    chosen = np.argsort(np.abs(turns - HARD_TURNS * typical))[: count // HARD_SHARE]
    indices = np.arange(len(chosen)) * HARD_SHARE + HARD_SHARE // 2

    def replaced(all, hard):
        all = np.array(all)
        all[indices] = np.asarray(hard)[chosen]
        return jnp.asarray(all)

    mixed = jax.tree.map(replaced, easy, candidates)
    found = []
    for title, stack in (("easy", easy), ("2 % hard", mixed)):
        for name, run in (("one after another", one_by_one), ("vmap", side_by_side), ("solve_batch", lanes)):
            result, ms = median_ms(lambda run=run, stack=stack: run(stack), repeats)
            mean = float(np.mean(result.evaluations))
            found.append(Row(f"{title}, {name}", ms / count, mean, float(np.mean(result.converged))))
    return found


def by_lbfgs(count: int, segments: int, seed: int) -> float:
    """Seconds that scipy takes for so many scenes on the same compiled energy; without compiling."""
    set_up()
    rodjax.enable_compilation_cache()
    some = scenes(count + 1, np.random.default_rng(seed))
    options = Options(segments, "finite_difference", rodjax.Newton(), planar=False)
    begin, finish = jax.jit(begun), jax.jit(reached)
    minimized = None
    start = time.perf_counter()
    for number, scene in enumerate(some):
        state, (twist, _) = first_state(scene, None, options)
        here = begin(scene, state.shape, twist)
        zero = jnp.zeros(here[0].no_displacement(here[1]).size)
        if minimized is None:
            minimized, _ = METHOD.found(here, zero)
        x, _ = minimized(*here, zero)
        jax.block_until_ready(finish(*here, jnp.asarray(x)))
        if number == 0:  # which compiles
            start = time.perf_counter()
    return time.perf_counter() - start


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1024)
    parser.add_argument("--segments", type=int, default=50)
    parser.add_argument("--discretization", choices=["finite_difference", "hermite"], default="finite_difference")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--lbfgs", type=int, default=8, help="scenes for each of two processes of scipy; 0: none")
    arguments = parser.parse_args(argv)
    set_up()
    print(conditions())
    print(f"{arguments.count} scenes, {arguments.segments} segments, {arguments.discretization}")
    found = rows(arguments.count, arguments.segments, arguments.discretization, arguments.repeats)
    if arguments.lbfgs:
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            seconds = pool.map(by_lbfgs, [arguments.lbfgs] * 2, [arguments.segments] * 2, range(2))
            found.append(Row("easy, scipy, 2 processes", 1e3 * max(seconds) / (2 * arguments.lbfgs), np.nan, np.nan))
    print(f"{'':34}{'ms a scene':>12}{'turns':>8}{'converged':>11}{'rate':>8}")
    for row in found:
        rate = found[0].ms / row.ms
        print(f"{row.name:34}{row.ms:12.4f}{row.turns:8.2f}{row.converged:11.3f}{rate:8.2f}")
    return found


if __name__ == "__main__":
    main()
