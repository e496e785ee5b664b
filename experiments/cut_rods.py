"""Does a rod that is cut in two and joined find what the rod finds, under loads without a potential?

Random rods of 1 m, EI = (1, 1.5) N m^2, from a clamp to a free end or a clamp, under 1 to 3 kinds of follower forces,
couples and moments. Prints a line a rod: whether the rod, and the same cut in the middle, converge, in how many
iterations, and the largest distance of their nodes.
"""

import argparse
import time
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

import rodjax as rj

KINDS = ("tip", "force along", "couple along", "dead couple along", "force at a point", "couple at a point")
START, GRAVITY = rj.Clamp((0, 0, 0), np.eye(3)), (0.0, 0.0, -9.81)
CUT, AT = 0.5, 0.75


class Row(NamedTuple):
    """`seconds`: of the processor, for both, with all tracing and compiling."""

    seed: int
    name: str
    converged: tuple[bool, bool]
    iterations: tuple[int, int]
    distance: float
    seconds: float


def rod(length: float) -> rj.Rod:
    return rj.Rod(length, EI=(1.0, 1.5), GJ=0.8, EA=1e4, mass_per_length=0.1)


def drawn(seed: int, size: float) -> tuple[str, rj.Scene, rj.Harness]:
    """A rod, and the same cut; loads are up to 3 times `size` [N, N m] at an end, 4 and 3 at a point, 5 and 3 along."""
    random = np.random.default_rng(seed)
    kinds = [str(kind) for kind in random.choice(KINDS, size=random.integers(1, 4), replace=False)]

    def vector(largest: float) -> np.ndarray:
        found = random.normal(size=3)
        return size * random.uniform(0, largest) * found / np.linalg.norm(found)

    end: Any = rj.Clamp((0.7, 0.1, 0.2), np.eye(3)) if random.random() < 0.5 else rj.Free()
    if "tip" in kinds:
        end = rj.Free(vector(3), vector(2) if random.random() < 0.5 else None, follower=True)
    along: list[Any] = []
    if "force along" in kinds:
        along.append(rj.DistributedForce(vector(5), follower=True))
    if "couple along" in kinds:
        along.append(rj.DistributedCouple(vector(3), follower=True))
    if "dead couple along" in kinds:
        along.append(rj.DistributedCouple(vector(3)))
    force = vector(4) if "force at a point" in kinds else None
    couple = vector(3) if "couple at a point" in kinds else None

    def loads(at: float) -> dict[str, Any]:
        return {
            "distributed": along,
            "point_forces": [] if force is None else [rj.PointForce(at, force, follower=True)],
            "point_couples": [] if couple is None else [rj.PointCouple(at, couple)],
        }

    whole = rj.Scene(rod(1.0), START, end, GRAVITY, **loads(AT))
    joint = rj.Joint("cut")
    first = rj.Scene(rod(CUT), START, joint, GRAVITY, distributed=along)
    second = rj.Scene(rod(1.0 - CUT), joint, end, GRAVITY, **loads(AT - CUT))
    name = f"to a {type(end).__name__} end, {', '.join(kinds)}"
    return name, whole, rj.Harness({"first": first, "second": second})


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0, help="of the first")
    parser.add_argument("--size", type=float, default=1.0, help="of the loads")
    arguments = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows = []
    for seed in range(arguments.seed, arguments.seed + arguments.count):
        name, scene, harness = drawn(seed, arguments.size)
        begin = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            whole, parts = rj.solve(scene, segments=16), rj.solve(harness, segments=8)
        seconds = time.process_time() - begin
        distance = float(np.max(np.linalg.norm(np.asarray(whole.nodes[8:] - parts["second"].nodes), axis=1)))
        converged = bool(whole.converged), bool(parts.converged)
        rows.append(Row(seed, name, converged, (int(whole.iterations), int(parts.iterations)), distance, seconds))
        print(f"{seed}: {converged}, {rows[-1].iterations} iterations, {distance:.0e} m, {seconds:.1f} s: {name}")
    both = [row for row in rows if all(row.converged)]
    alike = len(both) + len([row for row in rows if not any(row.converged)])
    furthest = max((row.distance for row in both), default=0.0)
    print(f"{len(both)} of {len(rows)} converge both ways, {alike} alike; nodes are at most {furthest:.0e} m apart")
    return rows


if __name__ == "__main__":
    main()
