"""Contact: heavy cables let down on pegs or in a floor, random cold scenes with one to three obstacles, and friction.

    python experiments/contact.py [scenes]

Prints how many converge, iterations, and which of the rest are too short for their side; of the pegs also milliseconds
of a warm step beside those of the same rod far from all pegs (medians of 21, compiled). Branches through the same
scenes as the cables become heavier, beside paths. Cables through a clip, pressed aside by a cylinder. Cables over pipes
that lie on a floor, and harnesses; cables that cross and touch one another, also milliseconds. Cables under loads
without a potential, beside a floor and a wall.
Of friction the pull of a taut cable half around a cylinder beside exp(mu pi), and of one that is drawn a little over a
floor, and back, beside its closed form; of ropes over a cylinder, which nothing else holds, how many are found at rest.
"""

import dataclasses
import importlib
import importlib.util
import itertools
import sys
import time
import warnings
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measuring import set_up

import rodjax as rj
from rodjax.mechanics.taut import drawn_in, taut

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


def needed_length(scene: rj.Scene, points: np.ndarray) -> float:
    """What the rod needs at least on the side to which the search leads it out: of a taut string."""
    assert isinstance(scene.start, rj.Swivel)
    assert isinstance(scene.end, rj.Swivel)
    tangents, radius = jnp.stack([scene.start.tangent, scene.end.tangent]), jnp.asarray(scene.rod.radius)
    begin, _ = drawn_in(jnp.asarray(points), tangents, scene.obstacles, radius, scene.rod.length)
    return float(taut(begin, scene.obstacles, radius)[0])


def cold(count: int, seed: int = 0, segments: int = 48, has_guess: bool = True, **rod: Any) -> None:
    """Some begin within obstacles, with a guess all with a shape that is up to a fifth too long. `rod`: its numbers,
    where they are others.
    """
    rng, found, others = np.random.default_rng(seed), [], []
    for k in range(count):
        scene, points = random_scene(rng)
        plain: dict[str, Any] = dict(
            length=1.0, EI=1.0, GJ=0.8, EA=1e6, mass_per_length=scene.rod.mass_per_length, radius=RADIUS
        )
        scene = dataclasses.replace(scene, rod=rj.Rod(**plain | rod))
        guess = rj.Guess(points) if has_guess else None
        result = rj.solve(scene, segments=segments, guess=guess, strain_limit=None)
        is_short = not bool(result.converged) and needed_length(scene, points) > 1
        found.append((bool(result.converged), is_short, int(result.iterations)))
        if not (result.converged or is_short):
            others.append(k)
    converged, short, iterations = np.array(found).T
    of_those = iterations[converged.astype(bool)]
    print(
        f"cold, seed {seed}, {segments} elements, {'' if has_guess else 'no '}guess, {rod or 'plain'}: "
        f"{converged.sum()} of {count} converged, iterations median {np.median(of_those):g}, 90 % "
        f"{np.percentile(of_those, 90):g}; {short.sum()} too short; others: {others}"
    )


def pressed_scene(rng: np.random.Generator, clip: str, segments: int) -> rj.Scene | None:
    """A cable pressed aside by the end of a cylinder; `None` where a support would lie within that. `clip`: whether it
    slides, and what it holds beside the position: "sliding tangent".
    """

    def turned(angle: float) -> tuple[float, float, float]:
        """The direction of x, turned by up to this angle [rad] to any side."""
        angle, side = rng.uniform(0, angle), rng.uniform(0, 2 * np.pi)
        return np.cos(angle), np.sin(angle) * np.cos(side), np.sin(angle) * np.sin(side)

    EI, span, at = rng.uniform(0.5, 2), rng.uniform(0.75, 0.92), rng.uniform(0.3, 0.6)
    rod = rj.Rod(1.0, EI, rng.uniform(0.4, 1) * EI, 1e4, rng.uniform(0.2, 1.5), radius=2 * RADIUS)
    ends = rj.Clamp((0, 0, 0), rj.frame(turned(0.6))), rj.Clamp((span, 0, 0), rj.frame(turned(0.6)))
    place, along = (at * span + 0.03 * rng.normal(), *(0.08 * rng.normal(size=2))), turned(0.5)
    holds = {"tangent": along} if "tangent" in clip else {"frame": rj.frame(along)} if "frame" in clip else {}
    clips = [rj.Clip(at, place, **holds, sliding="sliding" in clip)]
    free = rj.solve(rj.Scene(rod, *ends, (0, 0, -9.81), clips=clips), segments=segments)
    (point,) = np.asarray(free.position_at(rng.uniform(0.1, 0.9)))
    depth, angle, radius = rng.uniform(0.005, 0.04), rng.uniform(0, 2 * np.pi), rng.uniform(0.01, 0.08)
    aside = np.array([0, np.cos(angle), np.sin(angle)])
    begin = point - aside * (radius + 2 * RADIUS - depth)
    cylinder = rj.Cylinder(begin, begin + np.cross(aside, (1, 0, 0)), radius)
    if np.min(cylinder.distance(jnp.asarray([(0, 0, 0), (span, 0, 0), place]))) < 2.6 * RADIUS:
        return None
    return rj.Scene(rod, *ends, (0, 0, -9.81), clips=clips, obstacles=[cylinder])


def pressed(count: int, seed: int = 3, segments: int = 16) -> None:
    for clip in ("tangent", "sliding", "sliding tangent", "sliding frame"):
        rng, found = np.random.default_rng(seed), []
        for _ in range(count):
            scene = pressed_scene(rng, clip, segments)
            if scene is not None:
                result = rj.solve(scene, segments=segments)
                found.append((bool(result.converged), int(result.iterations)))
        converged, iterations = np.array(found).T
        print(
            f"pressed aside, clip: {clip}, seed {seed}, {segments} elements: {converged.sum()} of {len(found)} "
            f"converged, iterations median {np.median(iterations):g}, 90 % {np.percentile(iterations, 90):g}"
        )


def over_pipes_scene(rng: np.random.Generator, clip: str) -> rj.Scene | None:
    """A cable over two pipes that lie on a floor or are let into it; `clip`: as of `pressed_scene`, or "none"; `None`
    where it would not reach.
    """
    uniform, along = rng.uniform, rj.frame((1, 0, 0))
    radius, length = uniform(4e-3, 8e-3), uniform(0.8, 1.2)
    rod = rj.Rod.circular(length, radius, 10 ** uniform(6.5, 8), poisson_ratio=0.5, density=1200)
    span, floor, at = length * uniform(0.6, 0.98), -uniform(0.02, 0.15) - radius, uniform(0.3, 0.7)
    place = at * span * uniform(0.9, 1.1), uniform(-0.03, 0.03), max(floor + 2.5 * radius, uniform(-0.05, 0.05))
    tangent = np.array([1.0, *uniform(-0.2, 0.2, 2)])
    obstacles: list[rj.Obstacle] = [rj.Plane((0, 0, floor), (0, 0, 1))]
    for begin, end in ((0, place[0]), (place[0], span)):
        thick, half = uniform(0.005, 0.03), (end - begin) / 2
        # So that neither an end nor the clip lies within.
        x = begin + half + max(half - thick - 3 * radius, 0) * uniform(-1, 1)
        left, right = ((x, y, floor + thick * uniform(0.5, 1.3)) for y in (-0.5, 0.5))
        obstacles.append(rj.Cylinder(left, right, thick))
    holds = {"tangent": tangent} if "tangent" in clip else {"frame": rj.frame(tangent)} if "frame" in clip else {}
    clips = [] if clip == "none" else [rj.Clip(at, place, **holds, sliding="sliding" in clip)]
    end = rj.Clamp((span, uniform(-0.1, 0.1), uniform(-0.01, 0.1)), along)
    try:
        return rj.Scene(rod, rj.Clamp((0, 0, 0), along), end, (0, 0, -9.81), clips=clips, obstacles=obstacles)
    except ValueError:
        return None


def over_pipes(count: int, seed: int = 1, segments: int = 32) -> None:
    for clip in ("none", "position", "tangent", "sliding tangent"):
        rng = np.random.default_rng(seed)
        scenes = (over_pipes_scene(rng, clip) for _ in range(count))
        _tell(f"over pipes on a floor, clip: {clip}, seed {seed}", filter(None, scenes), segments)


def _tell(kind: str, scenes: Iterable[rj.Scene | rj.Harness], segments: int) -> None:
    """How many converge, in how many iterations."""
    results = (rj.solve(scene, segments=segments, strain_limit=None) for scene in scenes)
    converged, iterations = np.array([(bool(result.converged), int(result.iterations)) for result in results]).T
    print(
        f"{kind}, {segments} elements: {converged.sum()} of {len(converged)} converged, iterations median "
        f"{np.median(iterations):g}, 90 % {np.percentile(iterations, 90):g}",
        flush=True,
    )


def branched_harness(rng: np.random.Generator, sliding: bool) -> rj.Harness:
    """A trunk through a clip and its two branches, much longer than their ways, over a floor and a slanting pipe."""
    uniform, along, joint = rng.uniform, rj.frame((1, 0, 0)), rj.Joint("y", rj.frame((1, 0, 0)))
    radius, E = uniform(4e-3, 8e-3), 10 ** uniform(6.5, 8)
    trunk, branch = (
        rj.Rod.circular(uniform(*lengths), part * radius, E, poisson_ratio=0.5, density=1200)
        for lengths, part in (((0.5, 0.8), 1.0), ((0.45, 0.7), 0.8))
    )
    floor, x, at = uniform(-0.12, -0.03), uniform(0.25, 0.45), uniform(0.1, 0.4)
    begin, end, thick = (x, -0.5, uniform(-0.08, -0.03)), (x, 0.5, uniform(-0.08, -0.03)), uniform(0.01, 0.025)
    place = float(trunk.length) * at * uniform(0.75, 0.98), uniform(-0.02, 0.02), uniform(-0.01, 0.03)
    around = {
        "gravity": (0, 0, -9.81),
        "obstacles": [rj.Plane((0, 0, floor), (0, 0, 1)), rj.Cylinder(begin, end, thick)],
    }
    span = uniform(0.75, 1.0)
    left, right = ((span, side * uniform(0.1, 0.25), uniform(-0.02, 0.05)) for side in (1, -1))
    scenes = {
        "trunk": rj.Scene(
            trunk, rj.Clamp((0, 0, 0), along), joint, clips=[rj.Clip(at, place, sliding=sliding)], **around
        ),
        "left": rj.Scene(branch, joint, rj.Clamp(left, along), **around),
        "right": rj.Scene(branch, joint, rj.Pin(right), **around),
    }
    return rj.Harness(scenes)


def branched(count: int, seed: int = 2, segments: int = 40) -> None:
    for sliding in (False, True):
        rng, clip = np.random.default_rng(seed), "sliding clip" if sliding else "clip"
        harnesses = (branched_harness(rng, sliding) for _ in range(count))
        _tell(f"harnesses over a pipe on a floor, {clip}, seed {seed}", harnesses, segments)


def crossing_harness(rng: np.random.Generator, gap: float) -> rj.Harness:
    """On a floor, two branches over a pipe that they cross obliquely; one of their ends is scattered by 1 cm. The pipe
    is up to `gap` above the floor.
    """

    def rod(length: float, radius: float) -> rj.Rod:
        return rj.Rod.circular(length, radius, 1e7, poisson_ratio=0.5, density=1500)

    joint = rj.Joint("y", rj.frame((1, 0, 0), (0, 1, 0)))
    pipe = rj.Capsule((0.5, -0.3, 0.02), (0.5, 0.3, 0.02), 0.02)
    floor = rj.Plane((0, 0, -rng.uniform(0, gap) if gap else 0.0), (0, 0, 1))
    around = {"gravity": (0, 0, -9.81), "obstacles": [floor, pipe]}
    start, clips = rj.Clamp((0, 0, 0.06), rj.frame((1, 0, 0), (0, 1, 0))), [rj.Clip(0.2, (0.19, 0, 0.05), (1, 0, 0))]
    scenes = {"trunk": rj.Scene(rod(0.4, 0.006), start, joint, clips=clips, **around)}
    end = np.array([0.62, 0.15, 0.04]) + rng.normal(0, 0.01, 3)
    for name, length, place, side in (("left", 0.3, end, 1), ("right", 0.32, (0.6, -0.18, 0.05), -1)):
        towards = rj.frame((2, side, 0), (0, 0, 1))
        scenes[name] = rj.Scene(rod(length, 0.004), rj.Joint("y", towards), rj.Clamp(place, towards), **around)
    return rj.Harness(scenes, joints={"y": rj.Body(mass=0.01)})


def crossing(count: int, gap: float = 0.0, seed: int = 0, segments: int = 32) -> None:
    rng = np.random.default_rng(seed)
    harnesses = (crossing_harness(rng, gap) for _ in range(count))
    _tell(f"harnesses across a pipe up to {1000 * gap:g} mm above a floor, seed {seed}", harnesses, segments)


def touching_harness(rng: np.random.Generator, cables: int) -> rj.Harness:
    """Cables that cross one another, one above the other, over a pipe on a floor, and may touch one another."""
    around = {
        "gravity": (0, 0, -9.81),
        "obstacles": [rj.Plane((0, 0, 0), (0, 0, 1)), rj.Cylinder((0.3, -0.5, 0.03), (0.3, 0.5, 0.03), 0.02)],
    }
    scenes = {}
    for k, side in enumerate(np.linspace(-1, 1, cables)):
        begin, end, height = 0.06 * side, rng.uniform(0, 0.02) - 0.06 * side, 0.08 + 0.02 * k
        along = rj.frame((0.6, end - begin, 0))
        rod = rj.Rod.circular(np.hypot(0.6, end - begin) * rng.uniform(1.02, 1.12), 4e-3, 1e7, 0.5, density=1200)
        supports = rj.Clamp((0, begin, height), along), rj.Clamp((0.6, end, height), along)
        scenes[f"cable {k + 1}"] = rj.Scene(rod, *supports, **around)
    return rj.Harness(scenes, contact=True)


def touching(count: int, segments: int = 24) -> None:
    """Also milliseconds of each, compiled."""
    for cables in (2, 3):
        rng = np.random.default_rng(cables)
        harnesses = [touching_harness(rng, cables) for _ in range(count)]
        _tell(f"{cables} cables that cross and touch", harnesses, segments)
        seconds = []
        for harness in harnesses:
            begin = time.perf_counter()
            rj.solve(harness, segments=segments, strain_limit=None)
            seconds.append(time.perf_counter() - begin)
        print(f"  milliseconds median {1000 * np.median(seconds):.0f}, 90 % {1000 * np.percentile(seconds, 90):.0f}")


def turned_scene(rng: np.random.Generator, kind: str, end: str, size: float) -> rj.Scene:
    """A cable under a load without a potential, of a part of `size`, beside a floor and a wall."""

    def about_level(scatter: float) -> np.ndarray:
        return np.array([1.0, *rng.normal(0, scatter, 2)])

    place = np.array([rng.uniform(0.5, 0.95), *rng.normal(0, 0.1, 2)])
    first, last = about_level(0.5), about_level(0.5)
    load = rng.normal(size=3)
    load *= size * rng.uniform(0.3, 1.0) / np.linalg.norm(load)
    loads: dict[str, Any] = {
        "follower force along": {"distributed": [rj.DistributedForce(4 * load, follower=True)]},
        "couple along": {"distributed": [rj.DistributedCouple(load)]},
        "follower point force": {"point_forces": [rj.PointForce(0.5, 4 * load, follower=True)]},
        "point couple": {"point_couples": [rj.PointCouple(0.5, load)]},
    }[kind]
    ends = {"clamp": rj.Clamp(place, rj.frame(last)), "swivel": rj.Swivel(place, last), "free": rj.Free()}
    floor, wall = min(0, place[2]) - rng.uniform(0.05, 0.15), min(0, place[1]) - rng.uniform(0.03, 0.1)
    walls = [rj.Plane((0, 0, floor), (0, 0, 1)), rj.Plane((0, wall, 0), (0, 1, 0))]
    rod = rj.Rod(1.0, 1.0, 0.7, 1e4, mass_per_length=0.3, radius=0.01)
    start = rj.Clamp((0, 0, 0), rj.frame(first))
    return rj.Scene(rod, start, ends[end], (0, 0, -9.81), obstacles=walls, **loads)


def turned(count: int, seed: int = 0, segments: int = 32, size: float = 1.0) -> None:
    rng, found = np.random.default_rng(seed), []
    kinds = "follower force along", "couple along", "follower point force", "point couple"
    cases = itertools.product(("clamp", "swivel", "free"), kinds)
    for end, kind in itertools.islice(itertools.cycle(cases), count):
        result = rj.solve(turned_scene(rng, kind, end, size), segments=segments, strain_limit=None)
        found.append((bool(result.converged), int(result.iterations)))
    converged, iterations = np.array(found).T
    print(
        f"under loads without a potential of {size:g}, seed {seed}, {segments} elements: {converged.sum()} of {count} "
        f"converged; iterations median {np.median(iterations):g}, 90 % {np.percentile(iterations, 90):g}, most "
        f"{iterations.max()}"
    )


def capstan(friction: float = 0.3, segments: int = 160, stiffness: float = 1e-6) -> None:
    """A cable half around a cylinder, 1 N on one end, the other drawn out and back."""
    around, half = 0.1, (1 - np.pi * 0.1) / 2
    cylinder = rj.Cylinder((around, -1, 0), (around, 1, 0), around - 0.002, friction=friction)
    rod = rj.Rod(1.0, stiffness, stiffness, 1e4, radius=0.002)
    s = np.linspace(0, 1, 401)
    angle = np.pi - np.clip(s - half, 0, np.pi * around) / around
    x = np.stack([around + around * np.cos(angle), 0 * s, around * np.sin(angle)], axis=1)
    x[:, 2] += np.minimum(s - half, 0) - np.maximum(s - half - np.pi * around, 0)
    result, pulls, iterations = rj.Guess(x), [], []
    for drawn in (0, *np.arange(1, 8), 6, 5):
        ends = rj.Pin((0, 0, -half - 0.002 * drawn)), rj.Free(force=(0, 0, -1.0))
        scene = rj.Scene(rod, *ends, obstacles=[cylinder])
        result = rj.solve(scene, segments=segments, guess=result, strain_limit=None)
        pulls.append(float(np.linalg.norm(result.start_force)) if result.converged else np.nan)
        iterations.append(int(result.iterations))
    out, back = np.array(pulls[1:8]) * np.exp(-friction * np.pi), np.array(pulls[8:]) * np.exp(friction * np.pi)
    print(
        f"capstan, mu = {friction}, {segments} elements: pull over exp(mu pi) - 1: {np.min(out) - 1:.1e} to "
        f"{np.max(out) - 1:.1e}, back over exp(-mu pi) - 1: {np.min(back) - 1:.1e} to {np.max(back) - 1:.1e}; "
        f"iterations median {np.median(iterations[1:]):g}, most {max(iterations[1:])}"
    )


def hung_over(segments: tuple[int, ...] = (50, 80, 100, 120)) -> None:
    """Ropes that friction alone holds over a cylinder: cosseratbench's capstan, where that is installed."""
    if importlib.util.find_spec("cosseratbench") is None:
        print("hung over a cylinder: skipped, cosseratbench is not installed")
        return
    capstan = importlib.import_module("cosseratbench.experiments.capstan").capstan
    solver = importlib.import_module("rodjax.cosseratbench").RodjaxSolver()
    for part in (0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.02, 1.1):
        cases = itertools.product(segments, (0.1, 0.3, 0.6))
        found = [solver.equilibrium(capstan.build(part, friction), count) for count, friction in cases]
        iterations = [int(result.iterations) for result in found if result.converged]
        print(
            f"hung over a cylinder, {part:g} of the longest side that holds: {len(iterations)} of {len(found)} at rest"
            f"{f', iterations median {np.median(iterations):g}, most {max(iterations)}' if iterations else ''}"
        )


def out_of_a_floor(segments: int = 64) -> None:
    """A heavy cable whose first shape lies in a floor, also a thin one."""
    for radius in (RADIUS, 3e-4):
        found = []
        for depth in (0.05, 0.1, 0.2):
            start, end = (rj.Clamp((x, 0, 0), rj.frame((1, 0, 0))) for x in (0.0, 0.6))
            floor, rod = rj.Plane((0, 0, -depth), (0, 0, 1)), rj.Rod(1.0, 1.0, 0.8, 1e6, 300.0, radius=radius)
            scene = rj.Scene(rod, start, end, (0, 0, -1.0), obstacles=[floor])
            result = rj.solve(scene, segments=segments, strain_limit=None)
            found.append((bool(result.converged), int(result.iterations), int(result.evaluations)))
        print(f"out of a floor, radius {radius:g}: converged, iterations, evaluations {found}")


def dragged(friction: float = 0.3, segments: int = 64) -> None:
    """A cable of 1 N on a floor, its end drawn by 0.2 mm and back: where EA = 100 N most of it sticks."""
    floor, rod = (
        rj.Plane((0, 0, -RADIUS), (0, 0, 1), friction=friction),
        rj.Rod(1.0, 0.01, 0.008, 100.0, 0.1, radius=RADIUS),
    )
    way, stiffness, first = 2e-4, 100.0 * friction, friction / segments / 2
    displacements = np.concatenate([np.linspace(0, way, 5), np.linspace(way, 0, 5)[1:]])
    scenes = [
        rj.Scene(rod, rj.Swivel((-x, 0, 0), (1, 0, 0)), rj.Free(), (0, 0, -10.0), obstacles=[floor])
        for x in displacements
    ]
    path = rj.solve_path(scenes, segments=segments, guess=rj.Guess([(0, 0, 0), (1, 0, 0)]))
    pull, most = np.asarray(path.start_force)[:, 0], np.sqrt(2 * stiffness * way)
    expected = (
        np.sqrt(2 * stiffness * displacements[:5]) - first,
        most - 2 * np.sqrt(stiffness * (way - displacements[5:])) + first,
    )
    off = np.max(np.abs(pull - np.concatenate(expected))[1:])
    states = np.asarray(path.contact_states)[:, 0]
    print(
        f"drawn over a floor and back, {segments} elements: {np.sum(path.converged)} of {len(scenes)} converged, "
        f"iterations most {np.max(path.iterations)}; pull at most {off:.1e} N off, {off * segments / friction:.2f} of "
        f"what a node holds; nodes that slip {[int(np.sum(state == 2)) for state in states[1:]]}"
    )


def branches(count: int, seed: int = 0, segments: int = 24, heavier: float = 30.0) -> None:
    """`rj.follow` as gravity grows: how many come to its end, at the equilibrium that paths of forty steps find."""
    rng = np.random.default_rng(seed)
    points, corners, critical, seconds, same, others = [], [], [], [], 0, []
    for k in range(count):
        scene, shape = random_scene(rng)
        last = rj.solve(scene, segments=segments, guess=rj.Guess(shape), strain_limit=None)
        if not last.converged:
            continue
        scenes = [dataclasses.replace(scene, gravity=g * scene.gravity) for g in np.linspace(1, heavier, 41)]
        begin = time.perf_counter()
        branch = rj.follow([scenes[0], scenes[-1]], guess=last)
        seconds.append(time.perf_counter() - begin)
        points.append(len(branch.parameter))
        critical.append(len(branch.critical_points))
        changed = np.any(np.diff(np.linalg.norm(branch.equilibria.obstacle_forces, axis=-1) > 0, axis=0), axis=(1, 2))
        corners.append(int(np.sum(changed)))
        for each in scenes[1:]:
            last = rj.solve(each, segments=segments, guess=last, strain_limit=None)
        is_there = branch.ended is rj.BranchEnd.SCENES and float(branch.parameter[-1]) == 1.0
        if is_there and bool(last.converged) and np.max(np.abs(branch.equilibria.nodes[-1] - last.nodes)) < 1e-8:
            same += 1
        else:
            how = branch.ended.name if not is_there else "OTHER"
            others.append((k, how, critical[-1], bool(last.converged)))
    print(
        f"branches as gravity grows to {heavier:g} times, seed {seed}, {segments} elements: {same} of {len(points)} "
        f"end where a path does; equilibria median {np.median(points):g}, most {max(points)}, between which contacts "
        f"change {sum(corners)} times; {sum(critical)} critical points; seconds median {np.median(seconds):.2g}; "
        f"others (scene, why, critical points, whether the path converged): {others}"
    )


if __name__ == "__main__":
    set_up()
    warnings.simplefilter("ignore")
    capstan()
    capstan(friction=0.8)
    hung_over()
    dragged()
    let_down()
    warm()
    out_of_a_floor()
    scenes = int(sys.argv[1]) if len(sys.argv) > 1 else 150
    cold(scenes)
    cold(scenes, has_guess=False)
    cold(scenes, radius=3e-4)
    cold(scenes, EI=(1.0, 2.0))
    cold(scenes, EI=(1.0, 2.0), rest_curvature=(1.0, 0.0))
    pressed(scenes)
    over_pipes(scenes)
    branched(scenes // 4)
    crossing(scenes)
    crossing(scenes, gap=0.012)
    touching(scenes // 8)
    turned(scenes)
    turned(scenes, size=4.0)
    branches(scenes)
