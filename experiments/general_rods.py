"""Rods as they really are: anisotropic, curved at rest, of two halves, coiled; beside published and closed forms.

    python experiments/general_rods.py [--out docs] [--part bend princeton ...]

Each row names what was computed, the mesh, the value, the reference and the relative difference. `time` compares a rod
of two equal bending stiffnesses (frames) with the same rod of one (tangents): warm solves in turn, medians; `pressure`
those under a follower load on finer and finer meshes; `equal` counts where cold starts of both end.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from measuring import conditions, save_rows, set_up
from scipy.spatial.transform import Rotation

import rodjax as rj


class Row(NamedTuple):
    """`difference`: relative to the reference, of zero the value itself; `nan` where there is none."""

    case: str
    mesh: str
    value: str
    reference: str
    difference: str
    source: str


def row(case: str, mesh: str, value: float, reference: float, source: str) -> Row:
    difference = value / reference - 1 if reference else value
    return Row(case, mesh, f"{value:.9g}", f"{reference:.9g}", f"{difference:.1e}", source)


def load_clamp() -> rj.Clamp:
    """At the origin, level, d2 upward."""
    return rj.Clamp((0, 0, 0), rj.frame((1, 0, 0), d2=(0, 0, 1)))


def bend() -> Iterator[Row]:
    """The 45-degree bend; with the stiffnesses as the reference has them, rounded to five digits."""
    expected = {
        300: (-7.044033, -11.930430, 40.189388),
        450: (-10.780573, -18.470639, 48.500107),
        600: (-13.603966, -23.558528, 53.471763),
    }
    rod = rj.Rod(25 * math.pi, (8.3333e5, 8.3333e5), 8.3333e5, 1e7, rest_curvature=(0, 0.01))
    tip = np.array([100 * math.sin(math.pi / 4), 100 - 100 * math.cos(math.pi / 4), 0])
    for segments in (8, 16, 32, 64):
        for load, displacement in expected.items():
            result = rj.solve(rj.Scene(rod, load_clamp(), rj.Free(force=(0, 0, load))), segments=segments)
            reached = (np.asarray(result.nodes[-1]) - tip)[[1, 0, 2]]
            for name, value, reference in zip(("centre", "tangent", "load"), reached, displacement, strict=True):
                case = f"45-degree bend, P = {load}: {name}"
                yield row(case, f"{segments} elements", value, reference, "Bathe & Bolourchi 1979, Kirchhoff")


def princeton() -> Iterator[Row]:
    rod = rj.Rod(0.508, (2.42887, 36.2855), 3.10401, 2.84e6)
    references = {8.896: (8.884e-3, 109.033e-3), 13.345: (15.334e-3, 156.576e-3)}
    for load, at_45 in references.items():
        for degrees in (0, 15, 30, 45, 60, 75, 90):
            angle = math.radians(degrees)
            frame = rj.frame((1, 0, 0), d2=(0, math.sin(angle), math.cos(angle)))
            result = rj.solve(rj.Scene(rod, rj.Clamp((0, 0, 0), frame), rj.Free(force=(0, 0, -load))), segments=32)
            moved = np.abs(np.asarray(frame).T @ (np.asarray(result.nodes[-1]) - [0.508, 0, 0]))
            for k, axis in enumerate(("stiff", "soft")):
                reference = at_45[k] if degrees == 45 else math.nan
                case = f"Princeton beam, {load} N at {degrees} degrees: {axis} axis [m]"
                yield row(case, "32 elements", float(moved[k]), reference, "Dowell et al. 1977, Kirchhoff")


def buckling() -> Iterator[Row]:
    for ratio in (1e2, 1e3, 1e4):
        rod = rj.Rod(1.0, (ratio, 1.0), 1.0, 1e7, mass_per_length=1.0)

        def tip(load: float, rod: rj.Rod = rod) -> rj.Scene:
            return rj.Scene(rod, load_clamp(), rj.Free(force=(0, 0, -load)))

        def uniform(load: float, rod: rj.Rod = rod) -> rj.Scene:
            return rj.Scene(rod, load_clamp(), rj.Free(), gravity=(0, 0, -load))

        for name, scene, low, high, reference in (
            ("tip", tip, 3.0, 5.0, 4.012599),
            ("uniform", uniform, 11.0, 15.0, 12.853763),
        ):
            point = rj.critical_point([scene(low), scene(high)], segments=32)
            load = low + (high - low) * float(point.parameter)
            case = f"lateral buckling, {name} load, EI1/EI2 = {ratio:g}"
            yield row(case, "32 elements", load, reference, "thin limit, Timoshenko & Gere 1961")


def helix(radius: float, pitch: float, s: float) -> rj.Clamp:
    """A clamp on a helix of this radius and pitch angle, its d1 along the binormal."""
    angle = s * math.cos(pitch) / radius
    position = (radius * math.cos(angle), radius * math.sin(angle), s * math.sin(pitch))
    tangent = np.array([-math.cos(pitch) * math.sin(angle), math.cos(pitch) * math.cos(angle), math.sin(pitch)])
    binormal = np.cross(tangent, [-math.cos(angle), -math.sin(angle), 0])
    return rj.Clamp(position, np.stack([binormal, np.cross(tangent, binormal), tangent], axis=1))


def spring() -> Iterator[Row]:
    radius, pitch, turns, EI, GJ = 1.0, 0.3, 20, 1.0, 0.77
    length = 2 * math.pi * turns * radius / math.cos(pitch)
    curvature, twist = math.cos(pitch) ** 2 / radius, math.sin(pitch) * math.cos(pitch) / radius
    rod = rj.Rod(length, (EI, EI), GJ, 1e9, rest_curvature=(curvature, 0), rest_twist=twist)
    part = np.linspace(0, 1, 21)
    shapes = list(zip(radius * (1 - 0.05 * part), pitch + 0.25 * part, strict=True))
    scenes = [rj.Scene(rod, helix(r, p, 0), helix(r, p, length)) for r, p in shapes]
    r, p = shapes[-1]
    bending = EI * (math.cos(p) ** 2 / r - curvature)
    torque = GJ * (math.sin(p) * math.cos(p) / r - twist)
    for segments in (160, 320, 640, 960):
        path = rj.solve_path(scenes, segments=segments)
        last = jax.tree.map(lambda leaf: leaf[-1], path)
        about_axis = float(last.end_moment[2] + np.cross(last.nodes[-1], last.end_force)[2])
        mesh = f"{segments} elements, {int(path.iterations[0])} iterations at rest"
        source = "Love, secs. 270-271"
        force = (torque * math.cos(p) - bending * math.sin(p)) / r
        yield row("helical spring, 20 turns, pulled: force", mesh, float(last.end_force[2]), force, source)
        couple = torque * math.sin(p) + bending * math.cos(p)
        yield row("helical spring, 20 turns, pulled: couple", mesh, about_axis, couple, source)


def curl() -> Iterator[Row]:
    """A curly rod that hangs from a clamp: EI = weight per length = 1, curvature 2; in a plane, and beyond it."""

    def scene(length: float) -> rj.Scene:
        rod = rj.Rod(length, (1.0, 1.0), 2 / 3, 1e6, mass_per_length=1.0, rest_curvature=(2.0, 0.0))
        return rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((0, 0, -1))), rj.Free(), gravity=(0, 0, -1.0))

    lengths = np.linspace(0.5, 12, 24)
    scenes = [scene(length) for length in lengths]
    path = rj.solve_path(scenes, segments=64)
    for k, length in enumerate(lengths):
        centered = np.asarray(path.nodes[k]) - np.mean(path.nodes[k], axis=0)
        out_of_plane = np.linalg.svd(centered, compute_uv=False)[2] / math.sqrt(len(centered)) / length
        mesh = f"64 elements, {'stable' if path.stable[k] else 'not stable'}"
        yield row(f"curly rod hanging, L = {length:g}: out of plane/L", mesh, float(out_of_plane), 0.0, "")
    point = rj.critical_point(scenes, segments=64)
    length = lengths[0] + (lengths[-1] - lengths[0]) * float(point.parameter) / (len(lengths) - 1)
    case = f"curly rod hanging: first critical length, {point.kind}, index {point.index_before} to {point.index_after}"
    yield row(case, "64 elements", length, math.nan, "")


def halves() -> Iterator[Row]:
    rod = rj.Rod(1.0, rj.Steps([0.5], [1.0, 4.0]), rj.Steps([0.5], [1.0, 2.0]), 1e5)
    end = rj.Clamp((0.7, 0.1, 0.05), rj.frame((1, 0.5, 0.3)))
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), end)
    finest = float(rj.solve(scene, segments=256).end_force[0])
    for segments in (8, 16, 32, 64):
        force = float(rj.solve(scene, segments=segments).end_force[0])
        yield row("two halves of different EI: end force", f"{segments} elements", force, finest, "256 elements")


def follower() -> Iterator[Row]:
    rod = rj.Rod(1.0, 1.0, 0.7, 1e8)
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Free(force=(-5, 0, 0), follower=True))
    for segments in (16, 32, 64):
        tip = float(rj.solve(scene, segments=segments).nodes[-1, 2])
        mesh = f"{segments} elements"
        yield row(
            "cantilever under a follower force of 5 EI/L^2: height", mesh, tip, 0.780690143, "elastica from the end"
        )


def timed() -> Iterator[Row]:
    """Warm solves of a cable whose load changes, by frames and by tangents in turn."""

    def solver(EI: Any, segments: int, discretization: Any) -> Callable[[], None]:
        rod = rj.Rod(1.0, EI, 0.7, 1e5, mass_per_length=0.1)
        ends = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0.3))), rj.Clamp((0.8, 0, 0), rj.frame((1, 0, -0.3)))
        scenes = [rj.Scene(rod, *ends, gravity=(0, 2, -load)) for load in (100.0, 110.0)]
        options: Any = {"segments": segments, "discretization": discretization}
        first = rj.solve(scenes[0], **options)
        return lambda: jax.block_until_ready(rj.solve(scenes[1], guess=first, **options).nodes)

    for discretization in ("hermite", "finite_difference"):
        for segments in (16, 64):
            solvers = [solver(EI, segments, discretization) for EI in ((1.0, 1.0), 1.0)]
            times: list[list[float]] = [[], []]
            for _ in range(60):
                for solve, seconds in zip(solvers, times, strict=True):
                    begin = time.perf_counter()
                    solve()
                    seconds.append(time.perf_counter() - begin)
            frames, tangents = (1e3 * statistics.median(seconds[10:]) for seconds in times)
            mesh = f"{segments} {discretization}"
            yield row("time of a warm solve by frames, reference by tangents [ms]", mesh, frames, tangents, "")


def pressure() -> Iterator[Row]:
    """Warm solves under a pressure that grows by 2 %; the reference is 16 elements' time in proportion."""
    rod, clamp = rj.Rod(1.0, (1.0, 2.0), 0.7, 1e6, mass_per_length=0.1), rj.Clamp((0, 0, 0), rj.frame((1, 0, 0)))
    proportion = math.nan
    for segments in (16, 64, 256, 512):

        def scene(part: float) -> rj.Scene:
            load = rj.DistributedForce((-8.0 * part, 0.0, 1.0), follower=True)
            return rj.Scene(rod, clamp, rj.Free(), (0, 0, -9.81), distributed=[load])

        result, seconds = rj.solve(scene(1.0), segments=segments), []
        for k in range(1, 13):
            begin = time.perf_counter()
            result = jax.block_until_ready(rj.solve(scene(1.0 + 0.02 * k), segments=segments, guess=result))
            seconds.append(time.perf_counter() - begin)
        found = 1e3 * statistics.median(seconds[2:])
        proportion = found / segments if segments == 16 else proportion
        yield row("time of a warm solve under pressure [ms]", f"{segments} elements", found, proportion * segments, "")


def equal(count: int = 350) -> Iterator[Row]:
    """Cold starts with up to four turns: how many of rods (EI, EI) end in another minimum than EI."""

    def scene(seed: int, EI: Any) -> rj.Scene:
        generator = np.random.default_rng(seed)
        frames = Rotation.from_quat(generator.normal(size=(2, 4))).as_matrix()
        way = generator.normal(size=3)
        way *= generator.uniform(0.2, 0.95) / np.linalg.norm(way)
        rod = rj.Rod(1.0, EI, generator.uniform(0.5, 1.5), 1e6, generator.uniform(0, 3))
        ends = rj.Clamp((0, 0, 0), frames[0]), rj.Clamp(way, frames[1])
        return rj.Scene(rod, *ends, (0, 0, -9.81), turns=int(generator.integers(-4, 5)))

    one, two = (
        rj.solve_batch([scene(seed, EI) for seed in range(count)], segments=24, strain_limit=None)
        for EI in (1.0, (1.0, 1.0))
    )
    # Beyond the errors of the mesh, and the energy of an almost straight rod.
    differ = np.abs(np.asarray(two.energy) - one.energy) > 0.01 * (1 + np.abs(np.asarray(one.energy)))
    case = f"(EI, EI) beside EI, {count} random starts with turns: in another minimum"
    yield row(case, "24 elements", float(np.sum(differ)), 0.0, "")
    frames, tangents = (float(np.mean(result.iterations)) for result in (two, one))
    yield row("the same: iterations, reference of EI", "24 elements", frames, tangents, "")


PARTS = {
    "bend": bend,
    "princeton": princeton,
    "buckling": buckling,
    "spring": spring,
    "curl": curl,
    "halves": halves,
    "follower": follower,
    "time": timed,
    "pressure": pressure,
    "equal": equal,
}


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for general_rods.csv")
    parser.add_argument("--part", nargs="+", choices=list(PARTS), default=list(PARTS), help="only these")
    arguments = parser.parse_args(argv)
    set_up()
    rj.enable_compilation_cache()
    print(conditions())
    rows = []
    for name in arguments.part:
        for entry in PARTS[name]():
            print("  ".join(entry), flush=True)
            rows.append(entry)
        jax.clear_caches()
    if arguments.out:
        save_rows(rows, arguments.out / "general_rods.csv")
    return rows


if __name__ == "__main__":
    main()
