"""Does a harness come to rest, whatever it is made of, as a user would solve it: without mesh, guess or options?

Random harnesses: stars, trees, loops, rods with a branch that hangs freely, single rods to a supported body. Rods are
round, flat, curved at rest or twisted at rest, 2 to some 50 % longer than their chords, w L^3/EI 1 to 300; joints have
offsets, masses, forces, dead moments, and supports of every kind; some rods have a clip; a quarter of the harnesses
lie over a floor, half of these over a pipe too; in some all rods may touch. With `--sliding` more rods have clips,
through which they slide, and do not touch one another; with `--follower` half of the rods bear forces that follow them
or couples. Prints a line a harness, and how many converge.

With `--bundle` cables of 16 elements lie along one another instead: "twisted", two or three between connectors of which
one is turned about its axis; "flat", two to four side by side between connectors in different directions. Prints how
deep they lie in one another, too.
"""

import argparse
import time
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial import KDTree

import rodjax as rj

UP, ACROSS, LEVEL = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
GRAVITY = -9.81 * UP
KINDS = ("round", "flat", "curved", "twisted")
SUPPORTS = ("hinge", "line", "plane", "spring", "pin", "pin on a spring")


class Outcome(NamedTuple):
    """`seconds`: of the processor, with all tracing and compiling; `depth`: of cables in one another, in radii."""

    seed: int
    name: str
    converged: bool
    iterations: int
    segments: list[int]
    seconds: float
    depth: float | None = None


class Drawn:
    """Random numbers of one harness, in units of a metre and of the bending stiffness `EI`."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.EI = 10 ** self.random.uniform(-2.5, 0.0)

    def chance(self, probability: float) -> bool:
        return self.random.random() < probability

    def near(self, direction: Any, spread: float) -> np.ndarray:
        """A unit vector."""
        found = direction / np.linalg.norm(direction) + spread * self.random.normal(size=3)
        return found / np.linalg.norm(found)

    def place(self) -> np.ndarray:
        return self.random.uniform(size=3) * (1.0, 1.0, 0.6)

    def frame(self, tangent: np.ndarray) -> Any:
        return rj.frame(tangent, np.cross(tangent, self.near(np.cross(tangent, UP + 0.1 * LEVEL), 0.3)))

    def rod(self, length: float) -> tuple[str, rj.Rod]:
        radius, EI = self.random.uniform(0.002, 0.01), self.EI * 10 ** self.random.uniform(-0.5, 0.5)
        kind, shape = str(self.random.choice(KINDS, p=[0.55, 0.15, 0.2, 0.1])), {}
        both = (EI, EI * self.random.uniform(1, 5)) if kind in ("flat", "twisted") else EI
        if kind == "curved":
            shape["rest_curvature"] = tuple(self.random.uniform(-3, 3, 2) / length)
        if kind == "twisted":
            shape["rest_twist"] = self.random.uniform(-6, 6) / length
        weight = EI / length**3 * 10 ** self.random.uniform(0, 2.5)
        return kind, rj.Rod(length, both, 0.8 * EI, 4 * EI / radius**2, weight / 9.81, radius=radius, **shape)

    def support(self, kind: str, position: np.ndarray) -> Any:
        level = np.eye(3)
        if kind == "hinge":
            return rj.Hinge(position, level, self.near(ACROSS, 0.5))
        if kind == "line":
            return rj.Slider(position, [self.near(LEVEL, 0.3)], level)
        if kind == "plane":
            return rj.Slider(position, [self.near(LEVEL, 0.3), self.near(ACROSS, 0.3)])
        if kind == "pin":
            return rj.Pin(position)
        stiffness = self.EI * 10 ** self.random.uniform(0, 4)
        if kind == "pin on a spring":
            return rj.Spring(rj.Pin(position), translation=stiffness)
        rotation = self.EI * 10 ** self.random.uniform(-1, 2)
        return rj.Spring(rj.Clamp(position, level), translation=stiffness, rotation=rotation)

    def loads(self, length: float) -> list[Any]:
        """Without a potential, along a rod: up to some 8 EI/L^2 and EI/L in all."""
        size = self.EI / length * 10 ** self.random.uniform(-0.5, 0.7) * self.near(UP, 1.0)
        if self.chance(0.5):
            return [rj.DistributedForce(size / length**2, follower=True)]
        return [rj.DistributedCouple(size / length, follower=self.chance(0.5))]

    def body(self, position: np.ndarray, support: str | None) -> rj.Body:
        loads: dict[str, Any] = {}
        if self.chance(0.4):
            loads["mass"] = self.EI / 9.81 * 10 ** self.random.uniform(-1, 1.5)
        if self.chance(0.3):
            loads["force"] = self.EI * self.random.normal(size=3) * 10 ** self.random.uniform(-0.5, 0.7)
        if self.chance(0.2):
            loads["moment"] = self.EI * self.random.normal(size=3)
        return rj.Body(**loads, support=None if support is None else self.support(support, position))


def places(drawn: Drawn, shape: str) -> tuple[dict[str, np.ndarray], list[tuple[str, str]]]:
    """Joints "y", "z", "w", supports "s0", ... and a free end "f", and the rods between them."""
    near, random = drawn.near, drawn.random
    if shape == "star":
        ends = {f"s{k}": drawn.place() for k in range(random.integers(2, 5))}
        return {"y": drawn.place(), **ends}, [(name, "y") for name in ends]
    if shape == "tree":
        at = {"y": np.array([0.4, 0.5, 0.4]), "z": np.array([0.8, 0.5, 0.3]) + 0.1 * random.normal(size=3)}
        at |= {"s0": np.array([0.0, 0.5, 0.4]), "s1": drawn.place() + 0.6 * LEVEL, "s2": drawn.place() + 0.6 * LEVEL}
        return at, [("y", "z"), ("s0", "y"), ("s1", "z"), ("s2", "z")]
    if shape == "loop":
        middle = np.array([0.5, 0.5, 0.3])
        turns = [np.array([np.cos(2.1 * k), np.sin(2.1 * k), 0.0]) for k in range(3)]
        at = {n: middle + 0.3 * t + 0.05 * random.normal(size=3) for n, t in zip("yzw", turns, strict=True)}
        held = list("yzw")[: random.integers(1, 4)]
        ends = {f"s{k}": at[name] + 0.5 * near(at[name] - middle, 0.4) for k, name in enumerate(held)}
        return {**at, **ends}, [("y", "z"), ("z", "w"), ("w", "y"), *zip(ends, held, strict=True)]
    if shape == "branch":
        middle = np.array([0.5, 0.5, 0.4])
        at = {"y": middle, "s0": middle - 0.5 * LEVEL, "s1": middle + 0.5 * LEVEL + 0.2 * random.normal(size=3)}
        return {**at, "f": middle + 0.4 * near(-UP, 0.5)}, [("s0", "y"), ("y", "s1"), ("y", "f")]
    return {"s0": np.zeros(3), "y": 0.8 * near(LEVEL, 0.3)}, [("s0", "y")]


def harness_of(seed: int, *, slides: bool, follower: bool = False) -> tuple[str, rj.Harness]:
    drawn = Drawn(seed)
    random = drawn.random
    shape = str(random.choice(["star", "tree", "loop", "branch", "single"], p=[0.3, 0.2, 0.2, 0.15, 0.15]))
    at, edges = places(drawn, shape)
    joints, told = {}, [shape]
    for name in filter(lambda name: name in "yzw", at):
        support = str(random.choice(SUPPORTS)) if shape == "single" or drawn.chance(0.15) else None
        joints[name] = drawn.body(at[name], support)
        told += [] if support is None else [support]
    obstacles: list[Any] = []
    if drawn.chance(0.25):
        obstacles = [rj.Plane((min(place[2] for place in at.values()) - 0.02 - random.uniform(0, 0.1)) * UP, UP)]
        middle, half = np.array([0.5, 0.5, 0.0]) + 0.1 * random.normal(size=3), 0.6 * drawn.near(ACROSS, 0.3)
        pipe = rj.Capsule(middle - half, middle + half, random.uniform(0.01, 0.05))
        if drawn.chance(0.5) and min(float(pipe.distance(place)) for place in at.values()) > 0.03:
            obstacles.append(pipe)
        told += [type(obstacle).__name__ for obstacle in obstacles]
    cables, spread = {}, random.choice([0.15, 0.6])
    for first, last in edges:
        chord = at[last] - at[first]
        length = float(np.linalg.norm(chord) * (1.02 + random.exponential(0.2)))
        kind, rod = drawn.rod(length)
        ends = [_end(drawn, name, at[name], drawn.near(chord, spread)) for name in (first, last)]
        clips = []
        if last != "f" and drawn.chance(0.4 if slides else 0.15):
            part, aside = random.uniform(0.3, 0.7), np.sqrt(1 - np.linalg.norm(chord) / length)
            place = at[first] + part * chord + 0.1 * length * aside * random.normal(size=3)
            # Not below the floor, as no joint is.
            place += max(0.0, float(obstacles[0].point[2]) + 0.02 - place[2]) * UP if obstacles else 0.0
            tangent = {} if drawn.chance(0.6) else {"tangent": drawn.near(chord, 0.3)}
            clips = [rj.Clip(part * length, place, sliding=slides, **tangent)]
            kind += " in a clip"
        loads = drawn.loads(length) if follower and drawn.chance(0.5) else []
        kind += "".join(f" under a {type(load).__name__}" for load in loads)
        others = {"distributed": loads, "obstacles": obstacles, "clips": clips}
        cables[f"{first}{last}"] = rj.Scene(rod, ends[0], ends[1], GRAVITY, **others)
        told.append(kind)
    share_none = any(not set(one) & set(other) & set("yzw") for one in edges for other in edges)
    contact = not slides and drawn.chance(0.1) and share_none
    return ", ".join(told + ["contact"] * contact), rj.Harness(cables, joints, contact=contact)


def _end(drawn: Drawn, name: str, position: np.ndarray, tangent: np.ndarray) -> Any:
    if name == "f":
        return rj.Free()
    frame = drawn.frame(tangent)
    if name in "yzw":
        return rj.Joint(name, frame, 0.02 * drawn.random.normal(size=3) * drawn.chance(0.5))
    kind = drawn.random.choice(["clamp", "swivel", "pin"], p=[0.7, 0.15, 0.15])
    if kind == "pin":
        return rj.Pin(position)
    return rj.Clamp(position, frame) if kind == "clamp" else rj.Swivel(position, tangent)


def bundle_of(seed: int, kind: str) -> tuple[str, rj.Harness]:
    """Cables of one radius that lie along one another; "twisted" or "flat"."""
    random = np.random.default_rng(seed)
    radius, gravity = 10 ** random.uniform(-2.3, -1.7), random.choice([0, 1, 1]) * GRAVITY

    def rod(length: float) -> rj.Rod:
        return rj.Rod.circular(length, radius, 10 ** random.uniform(6.5, 8.5), poisson_ratio=0.5, density=1200.0)

    cables = {}
    if kind == "twisted":
        count = int(random.integers(2, 4))
        pitch, turn = 2 * radius * random.uniform(1.02, 2), random.uniform(-np.pi, np.pi)
        length, around = random.uniform(1.0, 1.08), pitch / (2 if count == 2 else np.sqrt(3))
        for k in range(count):
            angle, frame = 2 * np.pi * k / count, rj.frame(LEVEL)
            first, last = (around * np.array([0, np.cos(a), np.sin(a)]) for a in (angle, angle + turn))
            ends = rj.Clamp(first, frame), rj.Clamp(LEVEL + last, frame)
            cables[f"c{k}"] = rj.Scene(rod(length * random.uniform(0.995, 1.005)), *ends, gravity)
        return f"{count} twisted by {turn:.2f} rad", rj.Harness(cables, contact=True)
    count = int(random.integers(2, 5))
    pitch = 2 * radius * random.uniform(1.01, 1.3)
    last = np.array([random.uniform(0.7, 0.95), random.uniform(-0.2, 0.2), random.uniform(-0.2, 0.2)])
    tangent = np.array([1.0, random.normal(0, 0.4), random.normal(0, 0.4)])
    frames = rj.frame(LEVEL, d2=UP), rj.frame(tangent, d2=UP)
    for k in range(count):
        aside = (k - (count - 1) / 2) * pitch
        places = (place + aside * np.asarray(frame)[:, 0] for place, frame in zip((0.0, last), frames, strict=True))
        start, end = (rj.Clamp(place, frame) for place, frame in zip(places, frames, strict=True))
        cables[f"c{k}"] = rj.Scene(rod(1.1 * random.uniform(1.0, 1.01)), start, end, gravity)
    return f"{count} side by side", rj.Harness(cables, contact=True)


def deepest(result: rj.HarnessEquilibrium) -> float:
    """By how much cables lie in one another, in radii; by places a thousandth of them apart."""
    parts, depth = np.linspace(0, 1, 1001), 0.0
    for first, second in result.rod_contacts:
        one, other = (np.asarray(result[name].position_at(parts * result[name].s[-1])) for name in (first, second))
        radius = float(np.asarray(result[first].scene.rod.radius))
        depth = max(depth, 2 - float(KDTree(one).query(other)[0].min()) / radius)
    return depth


def main(argv: Sequence[str] | None = None) -> list[Outcome]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="of the first")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--sliding", action="store_true")
    kind.add_argument("--follower", action="store_true")
    kind.add_argument("--bundle", choices=["twisted", "flat"])
    arguments = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    found = []
    for seed in range(arguments.seed, arguments.seed + arguments.count):
        if arguments.bundle:
            name, harness = bundle_of(seed, arguments.bundle)
        else:
            name, harness = harness_of(seed, slides=arguments.sliding, follower=arguments.follower)
        begin = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = rj.solve(harness, segments=16) if arguments.bundle else rj.solve(harness)
        seconds = time.process_time() - begin
        depth = deepest(result) if arguments.bundle else None
        outcome = Outcome(seed, name, bool(result.converged), int(result.iterations), result.segments, seconds, depth)
        found.append(outcome)
        why = rj.Status(int(result.status)).message.partition(":")[2]
        told = "converges" if outcome.converged else f"does not converge:{why}, residual {float(result.residual):.1e}"
        print(
            f"{seed}: {told}, {outcome.iterations} iterations, {outcome.segments}, {seconds:.1f} s: {name}", flush=True
        )
    iterations = [outcome.iterations for outcome in found if outcome.converged]
    if not iterations:
        print(f"none of {len(found)} converges")
        return found
    print(
        f"{len(iterations)} of {len(found)} converge, in {np.median(iterations):.0f} iterations in the median, "
        f"{np.quantile(iterations, 0.9):.0f} in 90 %, {max(iterations)} at most"
    )
    if arguments.bundle:
        depths = [outcome.depth for outcome in found if outcome.converged]
        print(f"deep by {np.median(depths):.1e} radii in the median, {np.max(depths):.1e} at most")
    return found


if __name__ == "__main__":
    main()
