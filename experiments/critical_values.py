"""Where do rods buckle and jump, and what do they do beyond?

Critical values beside theory, each located on the branch that `rodjax.follow` traces: Euler's loads of four pairs of
supports, the column under its own weight, the twist of a straight rod without and with pull, and that of a ring. Then
the loop of Fig. 1 of Linn & Stephan (2008) with its end tangents bent inward past the chord, and four branches through
folds: a clamped arch under a point load, two rods whose end is turned, and one of two turns whose ends come together.

    python experiments/critical_values.py [--segments 64] [--only euler ring] [--out docs]

Hermite elements; EI = L = 1, EA L^2/EI = 1e8, so that the theory of thin rods applies to 4e-7.
"""

import argparse
import cmath
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure
from measuring import conditions, save_rows, set_up
from scipy.optimize import brentq
from scipy.special import jv

import rodjax
from rodjax import (
    Branch,
    Clamp,
    CriticalPoint,
    Equilibrium,
    Free,
    Guess,
    Pin,
    PointForce,
    Rod,
    Scene,
    Swivel,
    frame,
    problems,
)

EA, GJ = 1e8, 0.8  # in EI/L^2, EI
PULL = math.pi**2  # of the rod that is twisted under tension
BEYOND = 1.5  # parameters run to so many times the theory
BOUND = 1e-4
ORIGIN, LEVEL, UP = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
STEP = 2.0  # most turn of an end frame from scene to scene [rad]


class Row(NamedTuple):
    """A critical value: in EI/L^2, EI/L or rad as `quantity` says."""

    case: str
    quantity: str
    theory: float
    found: float
    error: float
    kind: str
    indices: str
    ms: float


def rod() -> Rod:
    return Rod(1.0, 1.0, GJ, EA, mass_per_length=1.0)


def root(function: Callable[[float], float], low: float, high: float) -> float:
    return float(brentq(function, low, high, xtol=1e-15))  # pyright: ignore[reportArgumentType]


def straight(span: float, total_twist: float = 0.0) -> Guess:
    return Guess(np.array([[0.0, 0.0, 0.0], [span, 0.0, 0.0]]), total_twist)


def turned(angle: float) -> np.ndarray:
    """The level frame turned about its tangent."""
    d1, d2, t = np.asarray(frame(LEVEL)).T
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.stack([cosine * d1 + sine * d2, cosine * d2 - sine * d1, t], axis=-1)


def located(
    case: str,
    quantity: str,
    theory: float,
    scenes: list[Scene],
    value: Callable[[CriticalPoint], float],
    segments: int,
    guess: Guess | None = None,
) -> Row:
    """The first critical point on the branch of the first scene."""
    options = {"segments": segments, "discretization": "hermite", "guess": guess}
    rodjax.critical_point(scenes, **options)  # compiles
    begin = time.perf_counter()
    point = jax.block_until_ready(rodjax.critical_point(scenes, **options))
    ms = (time.perf_counter() - begin) * 1e3
    found = value(point)
    index = f"{point.index_before} to {point.index_after}"
    return Row(case, quantity, theory, found, abs(found - theory) / theory, point.kind, index, ms)


# --- critical values --------------------------------------------------------------------------------------------------


def euler(segments: int) -> list[Row]:
    tangent_is_arc = root(lambda x: math.tan(x) - x, 4.4, 4.6)

    def clamp(position):
        return Swivel(position, LEVEL)

    def pressed(name: str, start: Callable, end: Callable, theory: float) -> Row:
        # The span at which a straight rod is under this load; what counts is the force it then has.
        spans = [1.0, 1.0 - BEYOND * theory / EA]
        scenes = [Scene(rod(), start(ORIGIN), end((span, 0.0, 0.0))) for span in spans]

        def load(point: CriticalPoint) -> float:
            return -float(point.equilibrium.end_force[0])

        return located(f"Euler, {name}", "P L²/EI", theory, scenes, load, segments, straight(1.0))

    free = (math.pi / 2) ** 2
    loaded = [Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Free(force=(-P, 0.0, 0.0))) for P in (0.0, BEYOND * free)]
    return [
        located("Euler, clamped-free", "P L²/EI", free, loaded, lambda p: float(p.parameter) * BEYOND * free, segments),
        pressed("pinned-pinned", Pin, Pin, math.pi**2),
        pressed("clamped-pinned", clamp, Pin, tangent_is_arc**2),
        pressed("clamped-clamped", clamp, clamp, (2 * math.pi) ** 2),
    ]


def column(segments: int) -> list[Row]:
    """The self-weight that a column bears: 9/4 j^2, j the first zero of the Bessel function of order -1/3."""
    theory = 9 / 4 * root(lambda x: float(jv(-1 / 3, x)), 1.5, 2.2) ** 2
    weights = [0.0, BEYOND * theory]
    scenes = [Scene(rod(), Clamp(ORIGIN, frame(UP)), Free(), gravity=(0.0, 0.0, -w)) for w in weights]
    quantity = "w L³/EI"
    return [
        located(
            "Greenhill 1881, self-weight",
            quantity,
            theory,
            scenes,
            lambda point: float(point.parameter) * BEYOND * theory,
            segments,
        )
    ]


def angles(last: float) -> np.ndarray:
    return np.linspace(0.0, last, math.ceil(last / STEP) + 1)


def moment(point: CriticalPoint) -> float:
    return GJ * float(point.equilibrium.total_twist)


def twist(segments: int) -> list[Row]:
    """The end moment under which a straight rod between clamps buckles, without and with a pull T.

    w = y + iz: EI w'''' - i M w''' - T w'' = 0, so that w = exp(i k x), k = (M +- sqrt(M^2 - 4 EI T))/(2 EI).
    Without pull tan x = x, x = M L/(2 EI).
    """

    def determinant(M: float, T: float) -> float:
        half = cmath.sqrt(M * M - 4 * T)
        a, b = ((M + half) / 4, (M - half) / 4)
        return ((b - a) * cmath.sin(a) * cmath.sin(b) - a * b * cmath.sin(b - a)).real

    rows = []
    free = 2 * root(lambda x: math.tan(x) - x, 4.4, 4.6)
    under_pull = root(lambda M: determinant(M, PULL), free, 1.4 * free)
    for name, pull, theory in (("without pull", 0.0, free), ("under T L²/EI = π²", PULL, under_pull)):
        span = 1.0 + pull / EA
        scenes = [
            Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Clamp((span, 0.0, 0.0), turned(angle)))
            for angle in angles(BEYOND * theory / GJ)
        ]
        rows.append(located(f"Greenhill 1883, {name}", "M L/EI", theory, scenes, moment, segments, straight(span)))
    return rows


def ring(segments: int) -> list[Row]:
    """The total twist at which a ring of straight rod buckles out of its plane."""
    angle = np.linspace(0.0, 2 * math.pi, 401)
    circle = np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1) / (2 * math.pi)
    theory = 2 * math.pi * math.sqrt(3)
    scenes = [
        Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Clamp(ORIGIN, turned(angle)))
        for angle in angles(BEYOND * theory / GJ)
    ]
    return [located("Zajac 1962, ring", "Θ GJ/EI", theory, scenes, moment, segments, Guess(circle))]


CRITICAL = {"euler": euler, "column": column, "twist": twist, "ring": ring}


# --- the loop of Fig. 1 past the chord --------------------------------------------------------------------------------


class Loop(NamedTuple):
    """An equilibrium of Fig. 1 of Linn & Stephan with its end tangents at the angle psi to the chord."""

    psi: float  # degrees
    start: str
    negative: int
    neutral: bool
    energy: float  # in EI/L
    middle: tuple[float, float]  # of the rod, out of the plane and upwards, in L


def loops(segments: int) -> list[Loop]:
    """With the tangents along the chord, and bent inward past it."""
    found = []
    plane = problems.omega(math.pi / 6, 0.0)
    options = {"segments": segments, "discretization": "hermite"}
    begin = rodjax.solve(plane, guess=problems.figure_1_start(), **options)
    for degrees in (0.0, -15.0):
        scene = problems.omega(math.radians(degrees), 0.0)
        planar = rodjax.solve(scene, guess=begin, find="equilibrium", **options)
        for start, result in (("planar", planar), ("minimum", rodjax.solve(scene, guess=planar, **options))):
            found.append(
                Loop(
                    degrees,
                    start,
                    int(result.index),
                    bool(result.neutral),
                    float(result.energy * scene.rod.length / scene.rod.EI),
                    tuple(np.round(np.asarray(result.nodes[segments // 2, 1:] / scene.rod.length), 6).tolist()),
                )
            )
    return found


# --- branches through folds -------------------------------------------------------------------------------------------

ARCH_HALF_ANGLE, ARCH_LOAD = 0.5, 40.0
WRITHE_SPAN, WRITHE_GJ, WRITHE_ANGLE = 0.5, 2.0, 4 * math.pi
LOOP_SPAN, LOOP_ANGLE = 0.8, 10 * math.pi
SLACK_TURNS, SLACK_LEAST, SLACK_POINTS = 2, 0.2, 24


class Traced(NamedTuple):
    """A branch with what its picture shows: the load, its conjugate and the numbers at its critical points."""

    branch: Branch
    load: np.ndarray
    response: np.ndarray
    critical: np.ndarray
    gap: float  # largest difference of the energy from the integral of the response over the load, of its range


def arch(segments: int) -> Traced:
    """A clamped circular arch under a dead load in its middle, kept in its plane by symmetry."""
    half = ARCH_HALF_ANGLE
    span, radius = math.sin(half) / half, 0.5 / half
    ends = [
        Clamp((x, 0.0, 0.0), frame((math.cos(half), 0.0, sign * math.sin(half)))) for x, sign in ((0, 1), (span, -1))
    ]
    loads = [-ARCH_LOAD, ARCH_LOAD]
    scenes = [Scene(rod(), *ends, point_forces=[PointForce(0.5, (0.0, 0.0, -F))]) for F in loads]
    angle = np.linspace(-half, half, 201)
    rise = radius * (np.cos(angle) - math.cos(half))
    shape = np.stack([span / 2 + radius * np.sin(angle), 0 * angle, rise], axis=1)
    branch = rodjax.follow(scenes, segments=segments, discretization="hermite", guess=Guess(shape), start=0.5)

    def middle(results: Equilibrium) -> np.ndarray:
        return np.asarray(results.nodes)[..., segments // 2, 2]

    def force(parameter) -> np.ndarray:
        return (2 * np.asarray(parameter) - 1) * ARCH_LOAD

    return traced(branch, force, middle)


def writhe(segments: int) -> Traced:
    """A rod between clamps on one line at half its length, twisted: it snaps into a loop, and back.

    The loop may lie in the plane without any twist at one turn of the end, in whose mirror it passes through itself:
    the branch is symmetric to 2 pi, and the angles of its two folds add up to 4 pi.
    """
    return twisted(Rod(1.0, 1.0, WRITHE_GJ, EA), WRITHE_SPAN, WRITHE_ANGLE, segments)


def loop(segments: int) -> Traced:
    """The same with little slack: the loop is localised and slides along the rod almost freely."""
    return twisted(rod(), LOOP_SPAN, LOOP_ANGLE, segments)


def twisted(rod: Rod, span: float, last: float, segments: int) -> Traced:
    x = np.linspace(0.0, 1.0, 201)
    bow = np.stack([span * x, 0 * x, 0.2 * (1 - np.cos(2 * math.pi * x))], axis=1)
    ends = angles(last)
    start = Clamp(ORIGIN, frame(LEVEL))
    scenes = [Scene(rod, start, Clamp((span, 0.0, 0.0), turned(angle))) for angle in ends]
    branch = rodjax.follow(scenes, segments=segments, discretization="hermite", guess=Guess(bow))

    def moment(results: Equilibrium) -> np.ndarray:
        return np.asarray(results.end_moment)[..., 0]

    def angle(parameter) -> np.ndarray:
        return np.interp(np.asarray(parameter), np.arange(len(ends)), ends)

    return traced(branch, angle, moment)


def slack(segments: int) -> Traced:
    """A rod of two turns between clamps whose ends are brought together from its own length: the twist-slack plane.

    The twist goes into the writhe of one localised loop, until that would pass through itself. The branch goes back
    beyond that fold, the loop pulled tight: it ends before the mesh does not resolve it.
    """
    line = np.linspace(0.0, 1.0, 201)
    bow = np.stack([line, 0 * line, 0.05 * (1 - np.cos(2 * math.pi * line))], axis=1)
    ends = np.array([1.0, SLACK_LEAST])
    scenes = [
        Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Clamp((x, 0.0, 0.0), frame(LEVEL)), turns=SLACK_TURNS) for x in ends
    ]
    branch = rodjax.follow(
        scenes, segments=segments, discretization="hermite", guess=Guess(bow), max_points=SLACK_POINTS
    )

    def pull(results: Equilibrium) -> np.ndarray:
        return np.asarray(results.end_force)[..., 0]

    def distance(parameter) -> np.ndarray:
        return np.interp(np.asarray(parameter), [0.0, 1.0], ends)

    return traced(branch, distance, pull)


def traced(branch: Branch, load: Callable[..., np.ndarray], response: Callable[[Equilibrium], np.ndarray]) -> Traced:
    loads, responses = load(branch.parameter), response(branch.equilibria)
    energy = np.asarray(branch.equilibria.energy)
    gained = np.concatenate([[0.0], np.cumsum(np.diff(loads) * (responses[1:] + responses[:-1]) / 2)])
    gap = float(np.max(np.abs(energy - energy[0] - gained)) / np.ptp(energy))
    points = branch.critical_points
    critical = np.array([[load(p.parameter), response(p.equilibrium)] for p in points]).reshape(len(points), 2)
    return Traced(branch, loads, responses, critical, gap)


BRANCHES = {"arch": arch, "writhe": writhe, "loop": loop, "slack": slack}
LABELS = {
    "arch": ("deflection of a clamped arch", "load in its middle F L²/EI", "height of its middle, L"),
    "writhe": ("twisted rod, clamps at D = 0.5 L, GJ = 2 EI", "turn of the end, rad", "end moment M L/EI"),
    "loop": ("twisted rod, clamps at D = 0.8 L, GJ = 0.8 EI", "turn of the end, rad", "end moment M L/EI"),
    "slack": (
        "rod with two turns, GJ = 0.8 EI, ends brought together",
        "distance of the ends D/L",
        "end force F L²/EI",
    ),
}


def picture(branches: dict[str, Traced]) -> Figure:
    columns = min(2, len(branches))
    rows = math.ceil(len(branches) / columns)
    figure = Figure(figsize=(6.2 * columns, 4.6 * rows), layout="constrained")
    for axes, (name, found) in zip(figure.subplots(rows, columns, squeeze=False).flat, branches.items(), strict=False):
        index = np.asarray(found.branch.index)
        is_stable = (index[1:] == 0) & (index[:-1] == 0)
        for color, style, label, segments in (
            ("tab:blue", "-", "stable", np.flatnonzero(is_stable)),
            ("tab:orange", "--", "unstable", np.flatnonzero(~is_stable)),
        ):
            for k in segments:
                axes.plot(found.load[k : k + 2], found.response[k : k + 2], style, color=color, zorder=1)
            axes.plot([], [], style, color=color, label=label)
        axes.plot(found.load, found.response, ".", color="0.35", markersize=3, zorder=2)
        for kind, marker in (("fold", "s"), ("branch", "o")):
            of_kind = [k for k, point in enumerate(found.branch.critical_points) if point.kind == kind]
            if of_kind:
                label = {"fold": "fold", "branch": "branch point"}[kind]
                axes.plot(*found.critical[of_kind].T, marker, color="black", fillstyle="none", label=label, zorder=3)
        title, x, y = LABELS[name]
        axes.set(title=title, xlabel=x, ylabel=y)
        axes.grid(color="0.92")
        axes.legend()
    return figure


# --- table ------------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> tuple[list[Row], list[Loop], dict[str, Traced]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    everything = [*CRITICAL, "loops", *BRANCHES]
    parser.add_argument("--segments", type=int, default=64)
    parser.add_argument("--only", nargs="+", choices=everything, default=everything)
    parser.add_argument("--out", type=Path, help="folder for critical_values.csv and critical_values.png")
    options = parser.parse_args(argv)
    if options.segments < 8 or options.segments % 2:
        parser.error(f"--segments must be even and at least 8, got {options.segments}")
    set_up()
    rodjax.enable_compilation_cache()
    print(conditions())
    print(f"{'':<36}{'':<10}{'theory':>14}{'found':>14}{'error':>10}{'kind':>8}{'index':>10}{'ms':>8}")
    rows: list[Row] = []
    for name in options.only:
        if name in CRITICAL:
            for row in CRITICAL[name](options.segments):
                mark = "" if row.error <= BOUND else " (!)"
                print(
                    f"{row.case:<36}{row.quantity:<10}{row.theory:>14.8f}{row.found:>14.8f}{row.error:>10.1e}"
                    f"{row.kind:>8}{row.indices:>10}{row.ms:>8.0f}{mark}",
                    flush=True,
                )
                rows.append(row)
            jax.clear_caches()  # programs that are not needed again
    found = loops(options.segments) if "loops" in options.only else []
    for loop in found:
        print(
            f"Fig. 1 with psi = {loop.psi:g} degrees, {loop.start}: index {loop.negative}, neutral {loop.neutral}, "
            f"energy {loop.energy:.6f} EI/L, middle at {loop.middle} L"
        )
    branches: dict[str, Traced] = {}
    for name in options.only:
        if name not in BRANCHES:
            continue
        one = branches[name] = BRANCHES[name](options.segments)
        print(
            f"{LABELS[name][0]}: {len(one.load)} points, {one.branch.ended.value}; energy within {one.gap:.1e}",
            flush=True,
        )
        for (load, response), point in zip(one.critical, one.branch.critical_points, strict=True):
            index = f"index {point.index_before} to {point.index_after}"
            print(f"  {point.kind:>6} at {load:.8f}, {response:.6f}; {index}", flush=True)
    if options.out is not None:
        if rows:
            save_rows(rows, options.out / "critical_values.csv")
        if branches:
            options.out.mkdir(parents=True, exist_ok=True)
            picture(branches).savefig(options.out / "critical_values.png", dpi=110)
    return rows, found, branches


if __name__ == "__main__":
    main()
