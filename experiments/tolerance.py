"""Is the error what was asked for? Random scenes solved to a tolerance, against the continuum.

Seeded. Two clamps with frames uniform on SO(3), span 0.2 to 0.9 L in any direction, weight w L^3/EI = 0.1 to 100,
L/R = 20 to 2e4 (both log-uniform). The truth is the continuum reached from the finest result, or, as a coarser mesh may
lead to another equilibrium, that reached from the result itself, whichever is nearer.

    python experiments/tolerance.py [--count 200] [--rtol 1e-2 1e-3 1e-4 1e-6]
"""

import argparse
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import rodjax
from rodjax import Clamp, Equilibrium, Scene, problems


class Row(NamedTuple):
    """For one tolerance: how many solves and truths converged, and of those the ratios and sizes."""

    rtol: float
    converged: int
    judged: int
    below: float
    below_thrice: float
    median: float
    worst: float
    estimate: tuple[float, float]
    segments: tuple[int, int]


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--rtol", type=float, nargs="+", default=[1e-2, 1e-3, 1e-4, 1e-6])
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rodjax.enable_compilation_cache()
    rtols = sorted(options.rtol, reverse=True)
    cases = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rodjax.NotConvergedWarning)  # counted
        for number, scene in enumerate(scenes(np.random.default_rng(0), options.count)):
            results = [rodjax.solve(scene, rtol=rtol, strain_limit=None) for rtol in rtols]
            cases.append((results, errors(scene, results, rtols)))
            if (number + 1) % 20 == 0:
                print(f"{number + 1} scenes", file=sys.stderr, flush=True)
    print(
        f"{'rtol':>6}{'converged':>12}{'judged':>8}{'below rtol':>12}{'below 3 rtol':>14}{'median/rtol':>13}"
        f"{'worst/rtol':>12}{'estimate/true: 5 %, 95 %':>27}{'segments: median, most':>25}"
    )
    return [row(rtol, [(results[k], error[k]) for results, error in cases]) for k, rtol in enumerate(rtols)]


def errors(scene: Scene, results: list[Equilibrium], rtols: list[float]) -> list[float]:
    """Largest distance of a node from the continuum, in L; NaN where there is no truth."""
    truth = rodjax.solve_continuum(scene, results[-1], segments=64) if results[-1].converged else None
    found = []
    for result, rtol in zip(results, rtols, strict=True):
        error = distance(result, truth)
        if result.converged and not error <= rtol:
            error = np.fmin(error, distance(result, rodjax.solve_continuum(scene, result, segments=64)))
        found.append(float(error))
    return found


def distance(result: Equilibrium, truth: Equilibrium | None) -> float:
    if truth is None or not (result.converged and truth.converged):
        return np.nan
    apart = np.linalg.norm(result.nodes - truth.position_at(result.s), axis=1)
    return float(np.max(apart) / result.scene.rod.length)


def row(rtol: float, cases: list[tuple[Equilibrium, float]]) -> Row:
    judged = [(result, error) for result, error in cases if np.isfinite(error)]
    found = np.array([error for _, error in judged])
    estimates = np.array([float(result.error_estimate) for result, _ in judged])
    segments = [result.s.shape[0] - 1 for result, _ in judged]
    low, high = np.percentile(estimates / found, [5, 95])
    this = Row(
        rtol=rtol,
        converged=sum(bool(result.converged) for result, _ in cases),
        judged=len(judged),
        below=float(np.mean(found <= rtol)),
        below_thrice=float(np.mean(found <= 3 * rtol)),
        median=float(np.median(found) / rtol),
        worst=float(np.max(found) / rtol),
        estimate=(float(low), float(high)),
        segments=(int(np.median(segments)), max(segments)),
    )
    print(
        f"{rtol:6.0e}{f'{this.converged} of {len(cases)}':>12}{this.judged:8}{100 * this.below:10.1f} %"
        f"{100 * this.below_thrice:12.1f} %{this.median:13.3f}{this.worst:12.2f}"
        f"{f'{low:.2f}, {high:.2f}':>27}{f'{this.segments[0]}, {this.segments[1]}':>25}"
    )
    return this


def scenes(rng: np.random.Generator, count: int) -> Iterator[Scene]:
    for _ in range(count):
        rod = problems.cable(20.0 * 1000.0 ** rng.uniform())
        away = rng.normal(size=3)
        position = rng.uniform(0.2, 0.9) * away / np.linalg.norm(away)
        start, end = (Rotation.random(None, rng).as_matrix() for _ in range(2))
        unit = float(rod.EI / rod.mass_per_length / rod.length**3)
        gravity = (0.0, 0.0, -unit * 10 ** rng.uniform(-1, 2))
        yield Scene(rod, Clamp((0, 0, 0), start), Clamp(position, end), gravity)


if __name__ == "__main__":
    main(sys.argv[1:])
