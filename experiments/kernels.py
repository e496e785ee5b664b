"""What does each part of an iteration cost, and what does an absent term save?

Microseconds of one evaluation in a compiled loop, on one thread: energy and gradient of scenes with and without
torsion and gravity; the Gauss-Newton Hessian; its factorisation and a solve. Then the block solver against a dense
Cholesky solve, with its compile time.

    python experiments/kernels.py [--segments 10 50 100] [--repeats 7] [--out DIR]
"""

import argparse
import csv
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rodjax import Scene, Swivel, problems
from rodjax.discretization.finite_difference import FiniteDifference
from rodjax.equilibrium import first_state
from rodjax.linalg import SymmetricBlockTridiagonal, factor
from rodjax.scene import nondimensional

LOOPS = 300


def main(argv: Sequence[str] | None = None) -> list[dict[str, float | str]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, nargs="+", default=[10, 50, 100, 500])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    rows: list[dict[str, float | str]] = []
    print(f"microseconds, one thread, median of {options.repeats}; {os.environ['XLA_FLAGS']}")
    print(f"{'what':40}" + "".join(f"{f'N={n}':>10}" for n in options.segments))
    for name, scene in scenes().items():
        add(rows, f"energy and gradient, {name}", options, lambda n, scene=scene: gradient_loop(scene, n))
    twisted = scenes()["torsion"]
    add(rows, "Gauss-Newton Hessian", options, lambda n: hessian_loop(twisted, n))
    add(rows, "Gauss-Newton Hessian, factor, solve", options, lambda n: newton_loop(twisted, n))

    print(f"\n{'blocks':>12}{'factor + solve':>16}{'solve':>8}{'dense':>10}{'compile [s]':>13}")
    for b, n in ((3, 15), (3, 63), (6, 5), (6, 15), (6, 25), (6, 50), (6, 127)):
        both, only, full, compile_time = block_times(b, n, options.repeats)
        print(f"{f'b={b} n={n}':>12}{both:16.1f}{only:8.1f}{full:10.1f}{compile_time:13.2f}")
        rows.append({"what": f"factor + solve b={b}", "N": n, "us": both})
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        with open(options.out / "kernels.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, ["what", "N", "us"])
            writer.writeheader()
            writer.writerows(rows)
    return rows


def scenes() -> dict[str, Scene]:
    twisted = problems.omega(0.6, 1.0)
    swivel = Swivel(twisted.end.position, twisted.end.frame[:, 2])  # pyright: ignore[reportAttributeAccessIssue]
    free = Scene(twisted.rod, twisted.start, swivel)
    return {
        "bending and stretch": free,
        "gravity": Scene(free.rod, free.start, free.end, gravity=(0, 0, -9.81)),
        "torsion": twisted,
        "torsion and gravity": Scene(twisted.rod, twisted.start, twisted.end, gravity=(0, 0, -9.81)),
    }


def add(rows: list, what: str, options: argparse.Namespace, loop: Callable[[int], Callable]) -> None:
    times = [microseconds(loop(n), options.repeats) for n in options.segments]
    rows.extend({"what": what, "N": n, "us": t} for n, t in zip(options.segments, times, strict=True))
    print(f"{what:40}" + "".join(f"{t:10.2f}" for t in times))


def microseconds(run: Callable, repeats: int) -> float:
    """Time of one of `LOOPS` passes of a compiled loop."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - begin)
    return statistics.median(times) / LOOPS * 1e6


def looped(body: Callable, scene: Scene, segments: int) -> Callable:
    """`body(problem, polyline, x)` applied again and again, each time to a result of the last."""

    @jax.jit
    def run(scene):
        state, twist = first_state(scene, problems.figure_1_start(), segments)
        scaled, _ = nondimensional(scene)
        problem, polyline = FiniteDifference.begin(scaled, state.polyline, twist)
        step = lambda _, x: 1e-9 * body(problem, problem.moved(polyline, x), x)  # noqa: E731
        return jax.lax.fori_loop(0, LOOPS, step, problem.no_displacement(polyline))

    return lambda: run(scene)


def gradient_loop(scene: Scene, segments: int) -> Callable:
    return looped(lambda problem, polyline, x: problem.energy_and_gradient(polyline)[1], scene, segments)


def hessian_loop(scene: Scene, segments: int) -> Callable:
    def body(problem, polyline, x):
        hessian = problem.gauss_newton(polyline)
        return x + jnp.sum(hessian.diagonal) + jnp.sum(hessian.lower)  # the sums keep every entry alive

    return looped(body, scene, segments)


def newton_loop(scene: Scene, segments: int) -> Callable:
    def body(problem, polyline, x):
        return problem.precondition(factor(problem.gauss_newton(polyline)), x + 1.0)

    return looped(body, scene, segments)


def block_times(b: int, n: int, repeats: int) -> tuple[float, float, float, float]:
    rng = np.random.default_rng(0)
    diagonal = rng.normal(size=(n, b, b))
    diagonal = jnp.asarray(diagonal + diagonal.transpose(0, 2, 1) + 8 * b * np.eye(b))
    matrix = SymmetricBlockTridiagonal(diagonal, jnp.asarray(rng.normal(size=(n - 1, b, b))))
    full = jnp.asarray(np.eye(n * b) * 8 * b + 0.01)
    f = jnp.asarray(rng.normal(size=(n, b)))

    @jax.jit
    def both(matrix, f):
        def step(_, f):
            shifted = eqx.tree_at(lambda m: m.diagonal, matrix, matrix.diagonal + 1e-9 * f[0, 0])
            return factor(shifted).solve(f) + f

        return jax.lax.fori_loop(0, LOOPS, step, f)

    @jax.jit
    def only(matrix, f):
        factors = factor(matrix)
        return jax.lax.fori_loop(0, LOOPS, lambda _, f: factors.solve(f) + f, f)

    @jax.jit
    def dense(full, f):
        def step(_, f):
            return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(full + 1e-9 * f[0, 0]), f.ravel()).reshape(
                f.shape
            )

        return jax.lax.fori_loop(0, LOOPS, step, f)

    begin = time.perf_counter()
    jax.jit(lambda matrix, f: factor(matrix).solve(f)).lower(matrix, f).compile()
    compile_time = time.perf_counter() - begin
    runs = (lambda: both(matrix, f), lambda: only(matrix, f), lambda: dense(full, f))
    return (*(microseconds(run, repeats) for run in runs), compile_time)  # pyright: ignore[reportReturnType]


if __name__ == "__main__":
    main(sys.argv[1:])
