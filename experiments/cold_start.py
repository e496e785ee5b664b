"""Does a solve find an equilibrium from the library's own first shape? Random clamps, slack cables, dead end moments.

Seeded. Clamps: frames uniform on SO(3), span 0.05 to 0.95 L in any direction, weight w L^3/EI = 0.1 to 316. Moments on
a free end: in any direction, of a given size, every other one with a force of about 3 EI/L^2. Slack cables: clamps
along one line and some 0.02 L beside it, so that the bow of a cable can turn about that line at nearly no cost; by
tangents, by frames, and nearly straight at rest.

    python experiments/cold_start.py [--count 150] [--moments 12] [--slack 60] [--segments 30]
"""

import argparse
import itertools
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import rodjax
from rodjax import Clamp, Free, Rod, Scene, frame, problems

SLACK_CABLES = {
    "by tangents": {"EI": 1.0},
    "by frames": {"EI": (1.0, 1.0)},
    "nearly straight at rest": {"EI": (1.0, 1.0), "rest_curvature": (0.0, 0.01)},
}
SLACK = ("beside one line", "light", "end frame turned", "end behind the start")


def main(argv: Sequence[str] | None = None) -> dict[str, float]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=150, help="pairs of clamps for each slenderness")
    parser.add_argument("--moments", type=int, default=12, help="moments of each size for each slenderness")
    parser.add_argument("--slack", type=int, default=60, help="slack cables of each kind")
    parser.add_argument("--segments", type=int, default=30)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)
    columns = f"{'converged':>12}{'iterations: median':>20}{'90 %':>7}{'max':>7}{'evaluations: mean':>19}"
    print(f"{'scenes':52}{columns}")
    shares = {}
    for slenderness in (20.0, 200.0, 2000.0):
        scenes = clamps(problems.cable(slenderness), rng, options.count)
        shares[f"clamps, L/R = {slenderness:g}"] = row(f"clamps, L/R = {slenderness:g}", scenes, options.segments)
    for slenderness in (20.0, 200.0):
        for size in (1.0, 3.0, 6.0, 12.0):
            name = f"moments of {size:g} EI/L, L/R = {slenderness:g}"
            scenes = moments(problems.cable(slenderness), rng, options.moments, size)
            shares[name] = row(name, scenes, options.segments)
    for cable, kind in itertools.product(SLACK_CABLES, SLACK):
        name = f"slack, {cable}, {kind}"
        shares[name] = row(name, slack(cable, kind, options.slack), options.segments)
    return shares


def row(name: str, scenes: Iterable[Scene], segments: int) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rodjax.NotConvergedWarning)  # counted
        warnings.simplefilter("ignore", rodjax.OverstretchedWarning)  # the loads go up to 300 EI/L^3
        results = [rodjax.solve(scene, segments=segments, discretization="finite_difference") for scene in scenes]
    converged = [bool(result.converged) for result in results]
    iterations = [int(result.iterations) for result in results]
    low, high = np.percentile(iterations, [50, 90])
    found = f"{name:52}{f'{sum(converged)} of {len(results)}':>12}"
    evaluations = np.mean([int(result.evaluations) for result in results])
    print(f"{found}{low:20.0f}{high:7.0f}{max(iterations):7}{evaluations:19.1f}", flush=True)
    return float(np.mean(converged))


def clamps(rod: Rod, rng: np.random.Generator, count: int) -> Iterator[Scene]:
    unit = float(rod.EI / rod.mass_per_length / rod.length**3)
    for _ in range(count):
        away = rng.normal(size=3)
        position = rng.uniform(0.05, 0.95) * away / np.linalg.norm(away)
        start, end = (Rotation.random(None, rng).as_matrix() for _ in range(2))
        gravity = (0.0, 0.0, -unit * 10 ** rng.uniform(-1, 2.5))
        yield Scene(rod, Clamp((0, 0, 0), start), Clamp(position, end), gravity)


def moments(rod: Rod, rng: np.random.Generator, count: int, size: float) -> Iterator[Scene]:
    stiffness = float(rod.EI)
    for k in range(count):
        moment = rng.normal(size=3)
        moment *= size / np.linalg.norm(moment)
        force = (k % 2) * 2 * rng.normal(size=3)
        yield Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), Free(force * stiffness, moment * stiffness))


def slack(cable: str, kind: str, count: int) -> Iterator[Scene]:
    rng = np.random.default_rng(5)
    level = frame((1.0, 0.0, 0.0))
    for _ in range(count):
        span = -rng.uniform(0.0, 0.5) if kind == "end behind the start" else rng.uniform(0.6, 0.97)
        end = np.array([span, *(0.02 * rng.normal(size=2))])
        weight = 10 ** rng.uniform(-3, 0) if kind == "light" else 0.0
        turn = rng.uniform(-3, 3) if kind == "end frame turned" else 0.0
        rod = Rod(1.0, GJ=rng.uniform(0.5, 1.0), EA=1e5, mass_per_length=weight, **SLACK_CABLES[cable])
        turned = Rotation.from_rotvec([turn, 0.0, 0.0]).as_matrix() @ level
        yield Scene(rod, Clamp((0, 0, 0), level), Clamp(end, turned), (0.0, 0.0, -1.0))


if __name__ == "__main__":
    main(sys.argv[1:])
