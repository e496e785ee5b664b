"""A harness: a trunk that branches three times to five connectors, under its weight, held by clips, on a tray and over
the edge of a bracket; its cost, and where the clips of the trunk should be.

    python experiments/harness.py --out DIR [--repeats N] [--starts 1] [--random 40]

Draws all cables, prints one row for each with what obstacles do to it, writes a report, and times stars of cables of 32
elements against one such cable, in turn: processor time of the first answer with all compiling, and the time of a solve
from the last equilibrium as the ends of the cables move to and fro by 1 mm. Writes `harness.png`, `harness.csv` and the
report as a page and a picture. With `--starts` a route is sought from so many: clips and three branches such that all
cables bend as little as possible, within the limits of the report; with `--random` so many heavy harnesses, drawn at
random over pipes, are solved cold.
"""

import argparse
import functools
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from measuring import conditions, save_rows, set_up

import rodjax as rj
from rodjax.plot import figure_of, plot_harness
from rodjax.programs import kept
from rodjax.warn import silenced

GRAVITY = (0.0, 0.0, -9.81)
ALONG = rj.frame((1, 0, 0))
# A tray below all cables, and the rounded edge of a bracket below three of the branches.
TRAY = rj.Plane((0.0, 0.0, -0.06), (0.0, 0.0, 1.0))
EDGE = rj.Capsule((0.3, 0.12, -0.02), (1.2, 0.12, -0.02), 0.01)
# What the report checks.
LIMITS = rj.Limits(bend_radius=3.0, end_force=5.0)
# Of the cables of the star.
ELEMENTS = 32


class Timed(NamedTuple):
    """A line of harness.csv; ratios are those to one cable."""

    cables: int
    first_cpu_s: float
    first_ratio: float
    warm_ms: float
    warm_ratio: float
    iterations: int


def cable(length: float, radius: float) -> rj.Rod:
    return rj.Rod.circular(length, radius, 1e7, poisson_ratio=0.5, density=1500.0)


def branching() -> rj.Harness:
    """Fan-outs of 10 g, whose branches leave at 30 degrees to both sides."""
    around = {"gravity": GRAVITY, "obstacles": [TRAY, EDGE]}

    def leaving(side: float) -> Any:
        return rj.frame((np.cos(np.pi / 6), side * np.sin(np.pi / 6), 0.0), (0, 0, 1))

    def branch(joint: str, side: float, length: float, position: Sequence[float], tangent: Sequence[float]) -> rj.Scene:
        end = rj.Clamp(position, rj.frame(tangent, (0, 0, 1)))
        return rj.Scene(cable(length, 3e-3), rj.Joint(joint, leaving(side)), end, **around)

    trunk_clips = [rj.Clip(0.15, (0.15, 0.0, -0.005), (1, 0, 0)), rj.Clip(0.3, (0.29, 0.0, -0.01), (1, 0, 0))]
    straight = [rj.Joint(name, ALONG) for name in ("first", "second", "third")]
    cables = {
        "trunk": rj.Scene(cable(0.42, 8e-3), rj.Clamp((0, 0, 0), ALONG), straight[0], clips=trunk_clips, **around),
        "middle": rj.Scene(cable(0.25, 6e-3), straight[0], straight[1], **around),
        "tail": rj.Scene(cable(0.25, 5e-3), straight[1], straight[2], **around),
        "A": branch("first", 1, 0.3, (0.6, 0.2, 0.02), (0.3, 1, 0)),
        "B": branch("first", -1, 0.34, (0.62, -0.22, -0.02), (0.5, -1, 0)),
        "C": branch("second", 1, 0.3, (0.86, 0.2, 0.05), (0.2, 1, 0.3)),
        "D": branch("third", 1, 0.26, (1.08, 0.12, 0.0), (1, 0.6, 0)),
        "E": branch("third", -1, 0.28, (1.08, -0.14, -0.05), (1, -0.6, -0.3)),
    }
    bodies = {name: rj.Body(mass=0.01) for name in ("first", "second", "third")}
    return rj.Harness(cables, bodies)


def routed(starts: int) -> rj.Route:
    """The best places of the clips on the trunk and lengths of three branches."""
    variables = [
        rj.Between(
            f"cables.trunk.clips.{k}.position", *([x + sign * 0.03, sign * 0.03, sign * 0.03] for sign in (-1, 1))
        )
        for k, x in enumerate((0.15, 0.28))
    ]
    branches = {"A": (0.28, 0.36), "B": (0.31, 0.4), "C": (0.28, 0.36)}
    variables += [rj.Between(f"cables.{name}.rod.length", *ends) for name, ends in branches.items()]
    return rj.route(branching(), variables, limits=LIMITS, objective=rj.Objective(energy=1.0), starts=starts)


def over_pipes(seed: int) -> rj.Harness:
    """A heavy harness of three cables, longer than the straight ways, drawn at random over two pipes and a floor."""
    random = np.random.default_rng(seed)
    height = (-0.1, -0.03)
    pipes = [
        rj.Capsule(*[(random.uniform(*x), y, random.uniform(*height)) for y in (-0.3, 0.3)], radius=radius)
        for x, radius in (((0.1, 0.4), 0.02), ((0.4, 0.7), 0.015))
    ]
    around = {"gravity": GRAVITY, "obstacles": [rj.Plane((0, 0, -0.12), (0, 0, 1)), *pipes]}
    middle, longer = np.array([0.4, 0.0, 0.0]), random.uniform(1.02, 1.25, 3)
    soft = functools.partial(rj.Rod.circular, radius=6e-3, youngs_modulus=2e6, poisson_ratio=0.5, density=1500.0)
    trunk = rj.Scene(soft(0.4 * longer[0]), rj.Clamp((0, 0, 0), ALONG), rj.Joint("y", ALONG), **around)
    cables = {"trunk": trunk}
    for name, side, more in (("A", 1, longer[1]), ("B", -1, longer[2])):
        end = np.array([0.75, 0.2 * side, random.uniform(-0.05, 0.05)])
        leaving = rj.frame((np.cos(0.5), side * np.sin(0.5), 0.0), (0, 0, 1))
        clamp = rj.Clamp(end, rj.frame((1, 0.5 * side, 0), (0, 0, 1)))
        cables[name] = rj.Scene(soft(more * np.linalg.norm(end - middle)), rj.Joint("y", leaving), clamp, **around)
    return rj.Harness(cables, {"y": rj.Body(mass=0.01)})


def star(count: int, moved: float) -> rj.Harness:
    """Cables from a hub, their far ends on a circle that moves."""
    cables = {}
    for k in range(count):
        x, y = np.cos(2 * np.pi * k / count), np.sin(2 * np.pi * k / count)
        outwards = rj.frame((x, y, 0), (0, 0, 1))
        hub = rj.Joint("hub", outwards, (0.05 * x, 0.05 * y, 0))
        end = rj.Clamp((0.45 * x + moved, 0.45 * y, 0), outwards)
        cables[f"cable {k}"] = rj.Scene(cable(0.5, 5e-3), hub, end, gravity=GRAVITY)
    return rj.Harness(cables)


def one(moved: float) -> rj.Scene:
    return rj.Scene(cable(0.5, 5e-3), rj.Clamp((0.05, 0, 0), ALONG), rj.Clamp((0.45 + moved, 0, 0), ALONG), GRAVITY)


def timed(counts: Sequence[int], repeats: int) -> list[Timed]:
    """One cable and stars of these numbers of cables, one after another, so that all meet the same load."""
    makes = [one, *(functools.partial(star, count) for count in counts)]
    found, firsts, seconds = [], [], [[] for _ in makes]
    for make in makes:
        begin = sum(os.times()[:2])
        found.append(rj.solve(make(0.0), segments=ELEMENTS))
        firsts.append(sum(os.times()[:2]) - begin)
    scenes = [(make(0.001), make(0.0)) for make in makes]
    for k in range(repeats + 4):
        for number, both in enumerate(scenes):
            begin = time.perf_counter()
            found[number] = rj.solve(both[k % 2], segments=ELEMENTS, guess=found[number])
            jax.block_until_ready(found[number].energy)
            seconds[number].append(time.perf_counter() - begin)
    assert all(bool(result.converged) for result in found)
    warm = [1e3 * float(np.median(each[4:])) for each in seconds]
    return [
        Timed(cables, first, first / firsts[0], ms, ms / warm[0], int(result.iterations))
        for cables, first, ms, result in zip((1, *counts), firsts, warm, found, strict=True)
    ]


def main(argv: Sequence[str] | None = None) -> tuple[rj.HarnessEquilibrium, list[Timed]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("harness"))
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--cables", type=int, nargs="*", default=[20])
    parser.add_argument("--rtol", type=float, default=1e-3)
    parser.add_argument("--starts", type=int, default=0)
    parser.add_argument("--random", type=int, default=0)
    arguments = parser.parse_args(argv)
    set_up()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(conditions())
    folder = kept.folder()
    rj.keep_programs(False)  # first answers are to be compiled, while nothing else is
    rows = timed(arguments.cables, arguments.repeats) if arguments.cables else []
    rj.keep_programs(folder or False)
    for row in rows:
        print(
            f"{row.cables:3} cables: first {row.first_cpu_s:5.1f} s of processor time ({row.first_ratio:.1f} x one), "
            f"then {row.warm_ms:.2f} ms ({row.warm_ratio:.1f} x one), {row.iterations} iterations"
        )
    with rj.numpy_first(True):
        result = rj.solve(branching(), rtol=arguments.rtol)
    print(rj.describe(result))
    for name, rod in result.items():
        force, moment = (np.linalg.norm(values) for values in (rod.end_force, rod.end_moment))
        bend = 1 / float(np.max(rod.curvature))
        print(
            f"{name:7} {rod.s.shape[-1] - 1:4} elements, {force:.3f} N, {moment:.4f} N m at its end, bend {bend:.3f} m"
            f", {np.linalg.norm(np.sum(rod.contact_forces, axis=0)):.3f} N of obstacles"
        )
    for name, body in result.joints.items():
        print(f"{name:7} {np.linalg.norm(body.contact_force):.3f} N of obstacles")
    figure_of(plot_harness(result)).savefig(arguments.out / "harness.png", dpi=150)
    rj.report(result, limits=LIMITS, title="A harness on a tray").save(arguments.out)
    if rows:
        save_rows(rows, arguments.out / "harness.csv")
    if arguments.random:
        with silenced(rj.NotConvergedWarning):
            found = [rj.solve(over_pipes(seed), segments=ELEMENTS) for seed in range(arguments.random)]
        effort = [[int(each.iterations), int(each.evaluations)] for each in found]
        print(
            f"{sum(bool(each.converged) for each in found)} of {len(found)} heavy harnesses over pipes converge, "
            "iterations and evaluations {:.0f} and {:.0f} in the median, {} and {} at most".format(
                *np.median(effort, axis=0), *np.max(effort, axis=0)
            )
        )
    if arguments.starts:
        route = routed(arguments.starts)
        print(route)
        for name, unit, found in zip(route.names, route.units, route.numbers, strict=True):
            print(f"{name} = {found:.5g} {unit}")
    return result, rows


if __name__ == "__main__":
    main()
