"""Contact: heavy cables let down on pegs, and random cold scenes with one to three obstacles.

    python experiments/contact.py [scenes]

Prints how many converge, iterations, and what becomes of the rest; of the pegs also milliseconds of a warm step beside
those of the same rod far from all pegs (medians of 21, compiled).
"""

import sys
import time
import warnings

import jax
import numpy as np
from measuring import set_up

import rodjax as rj

RADIUS = 0.005


def pegs(weight: float, lowered: float = 0.0) -> rj.Scene:
    """A cantilevered cable of L = EI = 1 over three pegs."""
    obstacles = [
        rj.Capsule((x, -1, z - lowered), (x, 1, z - lowered), r)
        for x, z, r in ((0.3, -0.1, 0.06), (0.6, -0.2, 0.05), (0.85, -0.25, 0.06))
    ]
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6, weight, radius=RADIUS)
    return rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Free(), (0, 0, -1.0), obstacles=obstacles)


def let_down(segments: int = 64, heaviest: float = 1e5, steps: int = 60) -> None:
    result, found = rj.Guess([(0, 0, 0), (0.5, 0, 0), (1, 0, 0)]), []
    for weight in np.geomspace(0.5, heaviest, steps):
        result = rj.solve(pegs(float(weight)), segments=segments, guess=result, strain_limit=None)
        found.append((bool(result.converged), int(result.iterations)))
    converged, iterations = np.array(found).T
    print(
        f"pegs, w L^3/EI from 0.5 to {heaviest:g} in {steps} steps, {segments} elements: {converged.sum()} converged; "
        f"iterations median {np.median(iterations):g}, 90 % {np.percentile(iterations, 90):g}, most {iterations.max()}"
    )


def warm(segments: int = 64) -> None:
    for name, lowered in (("on pegs", 0.0), ("far from them", 10.0)):
        result = rj.solve(pegs(2000.0, lowered), segments=segments, strain_limit=None)
        times, iterations = [], []
        for k in range(21):
            scene = jax.block_until_ready(pegs(2000.0 * (1.03 if k % 2 else 1.0), lowered))
            begin = time.perf_counter()
            result = jax.block_until_ready(rj.solve(scene, segments=segments, guess=result, strain_limit=None))
            times.append(1e3 * (time.perf_counter() - begin))
            iterations.append(int(result.iterations))
        print(f"warm step {name}: {np.median(times):.1f} ms, {np.median(iterations):g} iterations")


def random_scene(rng: np.random.Generator) -> tuple[rj.Scene, np.ndarray]:
    """A pipe, a box, a cylinder, one to three of them near; a cable that hangs or stands, w L^3/EI 1 to 1e4."""
    span, weight = rng.uniform(0.4, 0.9), 10 ** rng.uniform(0, 4)
    placed = []
    for _ in range(3):
        while True:
            center, radius = np.array([rng.uniform(0.1, span - 0.1), 0, rng.uniform(-0.5, 0.1)]), rng.uniform(0.02, 0.1)
            if min(np.linalg.norm(center), np.linalg.norm(center - [span, 0, 0])) > radius + 0.03 + RADIUS:
                break
        placed.append((center, radius, rng.uniform(-0.3, 0.3)))
    near, obstacles = rng.integers(1, 4), []
    for k, (center, radius, tilt) in enumerate(placed):
        axis = np.array([np.sin(tilt), np.cos(tilt), 0])
        center = center - [0, 0, 0.0 if k < near else 10.0]
        obstacles.append(
            [
                lambda c=center, r=radius, a=axis: rj.Capsule(c - a, c + a, r),
                lambda c=center, r=radius: rj.Box(c, (2 * r, 2, 2 * r)),
                lambda c=center, r=radius, a=axis: rj.Cylinder(c - 0.5 * a, c + 0.5 * a, r),
            ][k]()
        )
    side, angles = rng.choice([1, -1]), rng.uniform(-0.6, 0.6, 2)
    u, sag = np.linspace(0, 1, 65), 0.6 * np.sqrt(1 - span**2) * side
    points = np.stack([span * u, 0.02 * np.sin(np.pi * u), -4 * sag * u * (1 - u)], axis=1)
    start, end = (
        rj.Swivel((x, 0, 0), (np.cos(angle), 0, np.sin(angle))) for x, angle in zip((0, span), angles, strict=True)
    )
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6, weight, radius=RADIUS)
    return rj.Scene(rod, start, end, (0, 0, -1.0), obstacles=obstacles), points


def cold(count: int, segments: int = 48) -> None:
    rng, found = np.random.default_rng(0), []
    for _ in range(count):
        scene, points = random_scene(rng)
        result = rj.solve(scene, segments=segments, guess=rj.Guess(points), strain_limit=None)
        found.append((int(result.status), bool(result.converged), int(result.iterations)))
    statuses, converged, iterations = np.array(found).T
    of_those = iterations[converged.astype(bool)]
    rest = {int(status): int(np.sum(statuses == status)) for status in np.unique(statuses[converged == 0])}
    print(
        f"cold, {segments} elements: {converged.sum()} of {count} converged; iterations median "
        f"{np.median(of_those):g}, 90 % {np.percentile(of_those, 90):g}; of the rest by status: {rest}"
    )


if __name__ == "__main__":
    set_up()
    warnings.simplefilter("ignore")
    let_down()
    warm()
    cold(int(sys.argv[1]) if len(sys.argv) > 1 else 150)
