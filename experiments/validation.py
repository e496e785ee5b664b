"""Does rodjax give the published and closed-form results?

Cantilevers, roll-up, heavy and clamped elasticas, the catenary, critical loads, localised helical buckling and Fig. 1
of Linn & Stephan (2008), each beside its reference, with the error and the time of a solve: a table and its picture.
Then four experiments of cosseratbench, scored by its own runner (`pip install 'rodjax[cosseratbench]'`).

    python experiments/validation.py [--segments 64] [--only cantilever ring] [--out docs]

Hermite elements; EI = L = 1, and EA L^2/EI = 1e10 where the reference is inextensible. A critical load is sought by
bisection over solves that begin with the straight rod, or the plane ring, in equilibrium: the largest load at which
this shape is a minimum that the solver keeps. (An unstable equilibrium it leaves by itself.)
"""

import argparse
import functools
import importlib
import importlib.metadata
import importlib.util
import math
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from measuring import Timed, compiled, conditions, machine, set_up
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc, jv

import rodjax
from rodjax import Clamp, Equilibrium, Free, Guess, Pin, Rod, Scene, Swivel, frame, problems
from rodjax.paths.path import stack_scenes

INEXTENSIBLE = 1e10  # EA L^2/EI
HELIX_EA = 1e12
GJ = 0.8  # GJ/EI, where it does not matter or the reference has it as a factor
REPEATS = 15
# What must hold, of critical loads and of all other rows.
CRITICAL_BOUND, BOUND = 1e-5, 1e-4
# Bisection of a critical load, from half of the reference to one and a half, to this part of it.
BISECTED_TO = 1e-8
# A shape further than this from a line, or a plane, has left it [L]. Rounding alone makes less than 1e-10; the first
# buckled shapes beyond the critical load bow by 1e-6 and more.
FLAT = 1e-7

ORIGIN = (0.0, 0.0, 0.0)
LEVEL, UP = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)

# Tip of the cantilever for P L^2/EI = 1 to 10: sideways w/L, inward u/L, slope [rad].
MATTIASSON = (
    (0.30172, 0.05643, 0.46135),
    (0.49346, 0.16064, 0.78175),
    (0.60325, 0.25442, 0.98602),
    (0.66996, 0.32894, 1.12124),
    (0.71379, 0.38763, 1.21537),
    (0.74457, 0.43459, 1.28370),
    (0.76737, 0.47293, 1.33496),
    (0.78498, 0.50483, 1.37443),
    (0.79906, 0.53182, 1.40547),
    (0.81061, 0.55500, 1.43029),
)
HEAVY_WEIGHTS = (1, 5, 10, 20, 50, 100, 500, 1000)
CLAMPED_SPANS = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.65, 0.6, 0.55, 0.5)
# Where a bend at the clamp is short, and where a helix has many turns.
HEAVY_FINER, HELIX_FINER = 4, 8
CATENARY_EA, CATENARY_SPAN, CATENARY_EI = 50.0, 0.8, 1e-7  # in weight w L, L and w L^3
STAGES = {"a": 0, "b": 9, "c": 13, "d": 17, "e": 21, "f": 25}  # in the sequence that begins with the circle


class Row(NamedTuple):
    """A line of the table. Lengths in L, forces in EI/L^2, unless `case` says otherwise; vectors by magnitude."""

    source: str
    quantity: str
    case: str
    reference: float
    ours: float
    error: float  # relative to the reference; where that is zero, as it is
    bound: float
    segments: int
    ms: float  # one warm solve


def row(
    source: str, quantity: str, case: str, reference: Any, ours: Any, segments: int, ms: float, bound: float = BOUND
) -> Row:
    expected, found = np.atleast_1d(reference), np.atleast_1d(ours)
    error, size = float(np.linalg.norm(found - expected)), float(np.linalg.norm(expected))
    relative = error / size if size else error
    return Row(source, quantity, case, shown(expected), shown(found), relative, bound, segments, ms)


def shown(value: np.ndarray) -> float:
    return float(value[0]) if len(value) == 1 else float(np.linalg.norm(value))


# --- solves -----------------------------------------------------------------------------------------------------------


def rod(EI: float = 1.0, EA: float = INEXTENSIBLE) -> Rod:
    return Rod(1.0, EI, GJ * EI, EA, mass_per_length=1.0)


def path(scenes: Sequence[Scene], segments: int, guess: Guess | None = None) -> tuple[list[Equilibrium], float]:
    """The equilibria of the scenes, each from the last, and the time of one warm [ms]."""
    stacked = stack_scenes(scenes)
    solve = functools.partial(rodjax.solve_path, segments=segments, discretization="hermite", guess=guess)
    program, _ = compiled(solve, stacked)
    runs: Timed[Equilibrium] = Timed(lambda: program(stacked))
    ms = runs.round(REPEATS) / len(scenes)
    results = [jax.tree.map(lambda leaf, k=k: leaf[k], runs.result) for k in range(len(scenes))]
    for k, result in enumerate(results):
        if not result.converged:
            raise RuntimeError(f"scene {k} of {len(scenes)}: {rodjax.describe(result)}")
    return results, ms


class Critical(NamedTuple):
    """The last equilibrium that keeps its shape, and the median time of a solve of the bisection [ms]."""

    equilibrium: Equilibrium
    ms: float


def critical(problem: Callable[[Any], tuple[Scene, Guess | None]], near: float, segments: int, axes: int) -> Critical:
    """`problem`: scene and first shape, which spans so many `axes`, of a load; `near`: what the load is compared to."""

    def solve(load):
        scene, guess = problem(load)
        shape = rodjax.solve(scene, segments=segments, discretization="hermite", guess=guess, find="equilibrium")
        return rodjax.solve(scene, segments=segments, discretization="hermite", guess=shape), guess

    program, _ = compiled(solve, jnp.asarray(near))
    times = []

    def kept(load: float) -> Equilibrium | None:
        begin = time.perf_counter()
        result, guess = jax.block_until_ready(program(jnp.asarray(load)))
        times.append((time.perf_counter() - begin) * 1e3)
        nodes = np.asarray(result.nodes)
        sizes = np.linalg.svd(nodes - np.mean(nodes, axis=0), compute_uv=False) / math.sqrt(len(nodes))
        # A ring that snaps through itself is plane again, with two turns less.
        unwound = 0.0 if guess is None else abs(float(result.total_twist - guess.total_twist))
        is_kept = bool(result.converged & result.stable) and sizes[axes] < FLAT and unwound < math.pi
        return result if is_kept else None

    low, high = 0.5 * near, 1.5 * near
    last = kept(low)
    if last is None or kept(high) is not None:
        raise RuntimeError(f"no load between {low:g} and {high:g} is critical")
    times.clear()
    while high - low > BISECTED_TO * near:
        middle = (low + high) / 2
        found = kept(middle)
        if found is None:
            high = middle
        else:
            low, last = middle, found
    return Critical(last, statistics.median(times))


def root(function: Callable[[float], Any], low: float, high: float) -> float:
    return float(brentq(function, low, high, xtol=1e-15))  # pyright: ignore[reportArgumentType]


def straight(span: Any, total_twist: Any = 0.0) -> Guess:
    return Guess(jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]) * span, total_twist)


def turned(angle: Any) -> Any:
    """The level frame turned about its tangent."""
    d1, d2, t = jnp.asarray(frame(LEVEL)).T
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cosine * d1 + sine * d2, cosine * d2 - sine * d1, t], axis=-1)


# --- benchmarks -------------------------------------------------------------------------------------------------------


def cantilever(segments: int) -> list[Row]:
    source = "Mattiasson 1981"
    loads = range(1, 11)
    scenes = [Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Free(force=(0.0, 0.0, -float(load)))) for load in loads]
    results, ms = path(scenes, segments)
    rows = []
    for load, published, result in zip(loads, MATTIASSON, results, strict=True):
        exact = cantilever_tip(load)
        # Half a unit of the last printed digit.
        np.testing.assert_allclose(exact, published, rtol=0, atol=0.5e-5)
        x, _, z = np.asarray(result.nodes[-1])
        t = np.asarray(result.tangents[-1])
        ours = (-z, 1 - x, math.atan2(-t[2], t[0]))
        for quantity, reference, value in zip(("tip, sideways", "tip, inward", "tip slope"), exact, ours, strict=True):
            rows.append(row(source, quantity, f"P L²/EI = {load}", reference, value, segments, ms))
    return sorted(rows, key=lambda row: row.quantity)


def cantilever_tip(load: float) -> tuple[float, float, float]:
    """Sideways, inward, slope, by elliptic integrals (Bisshopp & Drucker 1945)."""

    def amplitude(m):
        return math.asin(1 / math.sqrt(2 * m))

    m = root(lambda m: ellipk(m) - ellipkinc(amplitude(m), m) - math.sqrt(load), 0.5 + 1e-12, 1 - 1e-12)
    slope = math.asin(2 * m - 1)
    sideways = 1 - 2 * (ellipe(m) - ellipeinc(amplitude(m), m)) / math.sqrt(load)
    return float(sideways), 1 - math.sqrt(2 * math.sin(slope) / load), slope


def roll_up(segments: int) -> list[Row]:
    """M = 2 pi EI/L rolls the rod up once: the tip at the clamp, half of the arc a diameter above it."""
    source = "roll-up by an end moment"
    moments = 2 * math.pi * np.linspace(0.2, 2.0, 10)
    scenes = [Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Free(moment=(0.0, -moment, 0.0))) for moment in moments]
    results, ms = path(scenes, segments)
    rows = []
    for turns, result in ((1, results[4]), (2, results[9])):
        nodes, case = np.asarray(result.nodes), f"{turns} turn{'s' * (turns > 1)}"
        rows.append(row(source, "tip from the clamp", case, 0.0, np.linalg.norm(nodes[-1]), segments, ms))
        height = nodes[segments // (2 * turns), 2]
        rows.append(row(source, "diameter", case, 1 / (math.pi * turns), height, segments, ms))
    return rows


def heavy(segments: int) -> list[Row]:
    source = "heavy elastica"
    scenes = [Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Free(), gravity=(0.0, 0.0, -float(w))) for w in HEAVY_WEIGHTS]
    finer = HEAVY_FINER * segments
    results, ms = path(scenes, finer)
    rows = []
    for w, result in zip(HEAVY_WEIGHTS, results, strict=True):
        exact, tip = heavy_tip(w), np.asarray(result.nodes[-1])
        for quantity, reference, ours in zip(("tip, along", "tip, down"), exact, (tip[0], -tip[2]), strict=True):
            rows.append(row(source, quantity, f"w L³/EI = {w}", reference, ours, finer, ms))
    return sorted(rows, key=lambda row: row.quantity)


def heavy_tip(w: float) -> tuple[float, float]:
    """Along and down, by shooting from the free end: u'' = w s sin u for the angle u to the vertical, u(1) = pi/2."""

    def shot(angle: float) -> np.ndarray:
        def slope(s, y):
            return y[1], w * s * math.sin(y[0]), math.sin(y[0]), math.cos(y[0])

        # The angle at the end falls to 1e-9 for the heaviest: relative to it.
        atol = [1e-14 * angle, 1e-14 * angle, 1e-14, 1e-14]
        return solve_ivp(slope, (0.0, 1.0), [angle, 0.0, 0.0, 0.0], "DOP853", rtol=1e-12, atol=atol).y[:, -1]

    def miss(logarithm: float) -> float:
        return shot(math.exp(logarithm))[0] - math.pi / 2

    # Of several solutions the one that is not coiled has the smallest angle.
    low = high = math.log(1e-12)
    while miss(high) < 0:
        low, high = high, high + 0.3
    _, _, along, down = shot(math.exp(root(miss, low, high)))
    return float(along), float(down)


def clamped(segments: int) -> list[Row]:
    source = "clamped elastica"
    start, ends = Clamp(ORIGIN, frame(LEVEL)), [Clamp((D, 0.0, 0.0), frame(LEVEL)) for D in CLAMPED_SPANS]
    scenes = [Scene(rod(), start, end) for end in ends]
    x = np.linspace(0.0, 1.0, 101)
    bow = np.stack([CLAMPED_SPANS[0] * x, 0 * x, 0.07 * (1 - np.cos(2 * math.pi * x))], axis=1)
    results, ms = path(scenes, segments, Guess(bow))
    rows = []
    for D, result in zip(CLAMPED_SPANS, results, strict=True):
        m = root(lambda m, D=D: 2 * ellipe(m) / ellipk(m) - 1 - D, 1e-9, 0.8)
        thrust, rise = 16 * float(ellipk(m)) ** 2, math.sqrt(m) / float(ellipk(m))
        rows.append(row(source, "thrust", f"D/L = {D}", thrust, -result.end_force[0], segments, ms))
        height = math.hypot(*np.asarray(result.nodes[segments // 2, 1:]))
        rows.append(row(source, "rise", f"D/L = {D}", rise, height, segments, ms))
    return sorted(rows, key=lambda row: row.quantity)


def catenary(segments: int) -> list[Row]:
    """Forces in the weight w L."""
    source = "elastic catenary, Irvine 1981"
    span, EA = CATENARY_SPAN, CATENARY_EA
    ends = Pin(ORIGIN), Pin((span, 0.0, 0.0))
    # Doubling EI shows what EI itself changes: that is linear in it.
    scenes = [Scene(rod(EI, EA), *ends, gravity=(0.0, 0.0, -1.0)) for EI in (2 * CATENARY_EI, CATENARY_EI)]
    results, ms = path(scenes, segments)

    def reach(pull):
        return pull / EA + 2 * pull * math.asinh(1 / (2 * pull))

    pull = root(lambda pull: reach(pull) - span, 1e-3, 10.0)
    sag = 1 / (8 * EA) + pull * (math.hypot(1, 1 / (2 * pull)) - 1)
    exact = {"horizontal pull": pull, "sag": sag, "pull at the pins": math.hypot(pull, 0.5)}

    def measured(result: Equilibrium) -> tuple[float, ...]:
        force = np.asarray(result.end_force)
        return float(force[0]), -float(result.nodes[segments // 2, 2]), float(np.linalg.norm(force))

    double, single = map(measured, results)
    rows = []
    for (quantity, reference), twice, ours in zip(exact.items(), double, single, strict=True):
        case = f"EI = {CATENARY_EI:.0e} w L³, its part {abs(twice - ours) / reference:.1e}"
        rows.append(row(source, quantity, case, reference, ours, segments, ms))
    return rows


def euler(segments: int) -> list[Row]:
    source = "Euler load"
    tangent_is_arc = root(lambda x: math.tan(x) - x, 4.4, 4.6)
    loads = {
        "clamped-free": (math.pi / 2) ** 2,
        "pinned-pinned": math.pi**2,
        "clamped-pinned": tangent_is_arc**2,
        "clamped-clamped": (2 * math.pi) ** 2,
    }

    def free(load):
        return Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Free(force=jnp.array([-load, 0.0, 0.0]))), None

    def held(start, end):
        # The span at which a straight rod is under this load; what counts is the force it then has.
        def problem(load):
            span = 1 - load / INEXTENSIBLE
            return Scene(rod(), start(jnp.zeros(3)), end(span * jnp.array(LEVEL))), straight(span)

        return problem

    def clamp(position):
        return Swivel(position, LEVEL)

    columns = {
        "clamped-free": free,
        "pinned-pinned": held(Pin, Pin),
        "clamped-pinned": held(clamp, Pin),
        "clamped-clamped": held(clamp, clamp),
    }
    rows = []
    for name, problem in columns.items():
        found = critical(problem, loads[name], segments, axes=1)
        load = float(found.equilibrium.end_force[0])
        rows.append(row(source, name, "P L²/EI", loads[name], -load, segments, found.ms, CRITICAL_BOUND))
    return rows


def column(segments: int) -> list[Row]:
    """The self-weight that a column bears: 9/4 j^2, j the first zero of the Bessel function of order -1/3."""

    def problem(weight):
        return Scene(rod(), Clamp(ORIGIN, frame(UP)), Free(), gravity=-weight * jnp.array(UP)), None

    reference = 9 / 4 * root(lambda x: jv(-1 / 3, x), 1.5, 2.2) ** 2
    found = critical(problem, reference, segments, axes=1)
    weight = abs(float(found.equilibrium.start_force[2]))
    return [row("Greenhill 1881", "self-weight", "w L³/EI", reference, weight, segments, found.ms, CRITICAL_BOUND)]


def twist(segments: int) -> list[Row]:
    """The end moment under which a straight rod between clamps buckles: tan x = x, x = M L/(2 EI)."""

    def problem(moment):
        angle = moment / GJ
        return Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Clamp(LEVEL, turned(angle))), straight(1.0, angle)

    reference = 2 * root(lambda x: math.tan(x) - x, 4.4, 4.6)
    found = critical(problem, reference, segments, axes=1)
    moment = float(found.equilibrium.end_moment[0])
    return [row("Greenhill 1883", "end moment", "M L/EI", reference, moment, segments, found.ms, CRITICAL_BOUND)]


def ring(segments: int) -> list[Row]:
    """The total twist at which a ring of straight rod buckles out of its plane."""
    angle = np.linspace(0.0, 2 * math.pi, 401)
    circle = np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1) / (2 * math.pi)

    def problem(torque):
        angle = torque / GJ
        return Scene(rod(), Clamp(ORIGIN, frame(LEVEL)), Clamp(ORIGIN, turned(angle))), Guess(circle, angle)

    reference = 2 * math.pi * math.sqrt(3)
    found = critical(problem, reference, segments, axes=2)
    torque = GJ * float(found.equilibrium.total_twist)
    return [row("Zajac 1962", "twist of a ring", "Θ GJ/EI", reference, torque, segments, found.ms, CRITICAL_BOUND)]


def helix(segments: int) -> list[Row]:
    """A long rod, buckled into a helix that fades towards the ends: the infinite rod's closed form."""
    source = "van der Heijden & Thompson 2000"
    B, C, L, turns, slack = 1.345, 0.789, 100.0, 27, 0.03

    def pull(z):
        return 16 * B * (1 - z**2) / (slack * L) ** 2

    def torque(z):
        return 2 * z * math.sqrt(B * pull(z))

    # Of two solutions that with the larger moment for its pull, z = m/(2 sqrt(B T)).
    z = root(lambda z: torque(z) * L / C + 4 * math.acos(z) - 2 * math.pi * turns, 0.75, 1 - 1e-9)
    T, m = pull(z), torque(z)
    finer = HELIX_FINER * segments
    rate = math.sqrt(T / B - (m / (2 * B)) ** 2)

    def slope(s, y):
        cone = 2 * math.asin(math.sqrt(1 - z**2) / math.cosh(rate * (s - L / 2)))
        turned = m / (B * (1 + math.cos(cone)))
        return turned, math.cos(cone), math.sin(cone) * math.cos(y[0]), math.sin(cone) * math.sin(y[0])

    s = np.linspace(0.0, L, 1001)
    shape = solve_ivp(slope, (0.0, L), np.zeros(4), t_eval=s, rtol=1e-9, atol=1e-9).y[1:].T
    # An extension by T/EA adds to the slack: by 1e-5 of it if EA were 1e10 B/L^2.
    rod = Rod(L, B, C, HELIX_EA * B / L**2)
    scene = Scene(rod, Clamp(ORIGIN, frame(LEVEL)), Clamp(((1 - slack) * L, 0.0, 0.0), frame(LEVEL)))
    (result,), ms = path([scene], finer, Guess(shape, m * L / C))
    moment, force = float(result.end_moment[0]), float(result.end_force[0])
    return [
        row(source, "end moment", "m L/B", m * L / B, moment * L / B, finer, ms),
        row(source, "end pull", "T L²/B", T * L**2 / B, force * L**2 / B, finer, ms),
    ]


def figure_1(segments: int) -> list[Row]:
    """Extensible, EA L^2/EI = 1.6e5, and so is the reference."""
    source = "Linn & Stephan 2008, Fig. 1"
    scenes = [problems.omega(problems.ARC_HALF_ANGLE, 0.0), *problems.figure_1()]
    results, ms = path(scenes, segments, problems.figure_1_start())
    EI = float(scenes[0].rod.EI)
    rows = []
    for stage, k in STAGES.items():
        exact = rodjax.solve_continuum(scenes[k], results[k], intervals=8)
        if not exact.converged:
            raise RuntimeError(f"the continuum at stage {stage}: {rodjax.describe(exact)}")
        case = f"stage {stage}"
        energies = float(exact.elastic_energy) / EI, float(results[k].elastic_energy) / EI
        rows.append(row(source, "elastic energy", case, *energies, segments, ms))
        forces = np.asarray(exact.end_force) / EI, np.asarray(results[k].end_force) / EI
        if stage == "a":  # the circle, which bears a moment alone
            forces = np.zeros(3), forces[1]
        rows.append(row(source, "end force", case, *forces, segments, ms))
    return sorted(rows, key=lambda row: row.quantity)


BENCHMARKS = {
    "cantilever": cantilever,
    "roll_up": roll_up,
    "heavy": heavy,
    "clamped": clamped,
    "catenary": catenary,
    "euler": euler,
    "column": column,
    "twist": twist,
    "ring": ring,
    "helix": helix,
    "figure_1": figure_1,
}

# --- cosseratbench ----------------------------------------------------------------------------------------------------

OUTSIDE = "cosseratbench"
# Experiment, its metric, and the errors stored in its repository (results-0.2); PyElastica 1.0.0 and MuJoCo 3.3.7 give
# the same with version 0.3.0.
STORED = {
    ("cantilever", "tip_deflection_error"): {"PyElastica": 0.07312799512904854, "MuJoCo": 0.07405950060375971},
    ("catenary", "shape_error"): {"PyElastica": 0.0004517862135954216, "MuJoCo": 0.0032933953034652084},
    ("catenary", "sag_error"): {"PyElastica": 0.0001371069508865984, "MuJoCo": 0.012257527995285285},
}
# Of the crossing ropes by the same two with version 0.3.0, run once; and of the twisted rods by PyElastica, on 50
# elements: MuJoCo cannot hold their clamps.
STORED_CROSSING = {
    "shape_error": {"PyElastica": 0.0007816844604773857, "MuJoCo": 0.01063570188855733},
    "lift_error": {"PyElastica": 0.0028000939358821175, "MuJoCo": 0.00046668514019612234},
}
STORED_TWIST = 0.01098224620923094
# By how much the upper rope is lifted, down to where it belongs [m].
LIFTED = (0.12, 0.08, 0.04, 0.0)
# For the twist at which a rod buckles; and how much stiffer against extension, which its reference lacks.
TWIST_ELEMENTS, STIFFER = 32, 1e4
# The longer side of the rope over a cylinder, as a part of the longest that holds.
OVERHANGS = (0.5, 0.8)
# The reference of the catenary has no bending stiffness: divided by these numbers, it fades from ours.
DIVISORS = (10, 100, 1000)


class Score(NamedTuple):
    """A line of the second table: a metric of cosseratbench, relative to its reference, of a shape to the length."""

    experiment: str
    metric: str
    solver: str
    segments: int
    error: float
    bound: float = math.inf


def scores() -> list[Score]:
    """Of what `STORED` names, on its own meshes."""
    bench, registry = importlib.import_module(OUTSIDE), importlib.import_module(f"{OUTSIDE}.registry")
    adapter: Any = importlib.import_module("rodjax.cosseratbench")

    class Softer(adapter.RodjaxSolver):
        def __init__(self, divisor: int):
            super().__init__()
            self.divisor = divisor

        def scene(self, scenario: Any, segments: int) -> Scene:
            scene = super().scene(scenario, segments)
            return eqx.tree_at(lambda scene: scene.rod.EI, scene, scene.rod.EI / self.divisor)

    experiments = {name: registry.load_experiment(name) for name, _ in STORED}
    runs = {name: bench.run(experiment, adapter.RodjaxSolver()) for name, experiment in experiments.items()}
    softer = {divisor: bench.run(experiments["catenary"], Softer(divisor)) for divisor in DIVISORS}

    rod = experiments["cantilever"].scenario.rods[0]
    load = -rod.loads[0].force[2] * rod.length**2 / (rod.material.youngs_modulus * rod.second_moment_of_area)
    linear, exact = load / 3, cantilever_tip(load)[0]
    tip = -float(runs["cantilever"].trajectory.positions[0][-1, -1, 2])

    found = []
    for (name, metric), stored in STORED.items():
        errors = stored | {"rodjax": runs[name].metrics[metric]}
        if name == "cantilever":
            last = "rodjax, against the exact elastica"
            errors |= {"the exact elastica": abs(exact - linear) / linear, last: abs(tip - exact) / exact}
        else:
            errors |= {f"rodjax, EI/{divisor}": run.metrics[metric] for divisor, run in softer.items()}
            last = f"rodjax, EI/{DIVISORS[-1]}"
        n = experiments[name].n_elements
        found += [
            Score(name, metric, solver, n, error, BOUND if solver == last else math.inf)
            for solver, error in errors.items()
        ]
    return found + crossing_scores() + capstan_scores() + twist_scores()


def crossing_scores() -> list[Score]:
    """Two ropes that cross: the stable equilibrium, and that of the reference, which the upper rope comes to as it is
    let down without a push aside.
    """
    bench, registry = importlib.import_module(OUTSIDE), importlib.import_module(f"{OUTSIDE}.registry")
    adapter: Any = importlib.import_module("rodjax.cosseratbench")

    class LetDown(adapter.RodjaxSolver):
        def equilibrium(self, scenario: Any, segments: int) -> rodjax.HarnessEquilibrium:
            resting = self.scene(scenario, segments)
            ends = [lambda harness, name=name: getattr(harness.scenes[1], name).position for name in ("start", "end")]

            def lifted(height: float) -> rodjax.Harness:
                return eqx.tree_at(
                    lambda harness: [end(harness) for end in ends],
                    resting,
                    [end(resting) + height * np.array(UP) for end in ends],
                )

            above = rodjax.solve(lifted(LIFTED[0]), segments=segments, strain_limit=None)
            path = list(map(lifted, LIFTED))
            found = rodjax.solve_path(path, segments=segments, guess=above, strain_limit=None, find="equilibrium")
            return jax.tree.map(lambda leaf: leaf[-1], found)

    experiment = registry.load_experiment("crossing")
    n = experiment.n_elements
    runs = {
        ("rodjax, stable", n): bench.run(experiment, adapter.RodjaxSolver()),
        ("rodjax, the reference's equilibrium", n): bench.run(experiment, LetDown()),
        ("rodjax, the reference's equilibrium", n - 1): bench.run(experiment, LetDown(), n_elements=n - 1),
    }
    found = []
    for metric, stored in STORED_CROSSING.items():
        found += [Score("crossing", metric, solver, n, error) for solver, error in stored.items()]
        found += [
            Score("crossing", metric, solver, segments, run.metrics[metric], BOUND if segments != n else math.inf)
            for (solver, segments), run in runs.items()
        ]
    return found


def capstan_scores() -> list[Score]:
    """A rope that friction alone holds over a cylinder."""
    bench, registry = importlib.import_module(OUTSIDE), importlib.import_module(f"{OUTSIDE}.registry")
    adapter: Any = importlib.import_module("rodjax.cosseratbench")
    experiment = registry.load_experiment("capstan")
    found = []
    for overhang in OVERHANGS:
        run = bench.run(experiment, adapter.RodjaxSolver(), values={"overhang": overhang})
        error = run.metrics["slide"] if run.outcome == "completed" else math.nan
        found.append(
            Score("capstan", "slide", f"rodjax, {overhang:g} of the longest", experiment.n_elements, error, BOUND)
        )
    return found


def twist_scores() -> list[Score]:
    """The twist at which a rod under tension, whose end slides, begins to buckle."""
    twist = importlib.import_module(f"{OUTSIDE}.experiments.twist")
    (load,) = twist.twist.parameters
    given = twist.build(load.default).rods[0]
    expected = twist.critical_twist(given, load.default)
    material = given.material

    def error(times: float) -> float:
        rod = Rod.circular(twist.LENGTH, given.radius, material.youngs_modulus, shear_modulus=material.shear_modulus)
        rod = eqx.tree_at(lambda rod: rod.EA, rod, times * rod.EA)
        start = Clamp(ORIGIN, frame(LEVEL, d2=(0.0, 1.0, 0.0)))

        def turned(angle: float) -> rodjax.Harness:
            axes = frame(LEVEL, d2=(0.0, math.cos(angle), math.sin(angle)))
            end = rodjax.Slider((twist.LENGTH, 0.0, 0.0), [LEVEL], frame=axes)
            body = rodjax.Body(force=given.loads[0].force, support=end)
            return rodjax.Harness({"rod": Scene(rod, start, rodjax.Joint("end"))}, {"end": body})

        angles = np.linspace(0.0, 1.1 * expected, 9)  # each turn less than pi
        found = rodjax.critical_point(list(map(turned, angles)), segments=TWIST_ELEMENTS)
        return abs(float(found.parameter) * angles[1] / expected - 1)

    metric = "critical_twist_error"
    return [Score("twist", metric, "PyElastica", twist.twist.n_elements, STORED_TWIST)] + [
        Score("twist", metric, solver, TWIST_ELEMENTS, error(times), bound)
        for solver, times, bound in (("rodjax", 1.0, math.inf), (f"rodjax, EA x {STIFFER:.0e}", STIFFER, BOUND))
    ]


# --- table and picture ------------------------------------------------------------------------------------------------

HEADINGS = ("source", "quantity", "case", "reference", "ours", "error", "N", "ms")
WIDTHS = (32, 21, 34, 15, 15, 13, 5, 8)
SCORE_WIDTHS = (12, 24, 39, 5, 12)

INTRODUCTION = """\
# Validation

Published and closed-form results beside those of rodjax, printed by `experiments/validation.py`:

- {rows} rows; beyond their bound, marked (!): {beyond}
- largest error of the {criticals} critical loads {critical:.1e}, bound {critical_bound:.0e}
- largest error of the others {other:.1e}, bound {bound:.0e}
- on {conditions}

![Relative errors of all rows](validation.png)

**Conditions.** Hermite elements of equal length, N of them; Newton with its default tolerance; double precision.
Straight isotropic rods with EI = L = 1 and, where the reference is inextensible, EA L²/EI = 1e10, for the
helix 1e12. Lengths in L, forces in EI/L², angles in rad, unless the case says otherwise; vectors by magnitude. The
error is relative to the reference, of vectors the norm of the difference; where the reference is zero it is absolute.
`ms` is one warm solve, without compiling: where a row is one of a sequence, the mean of the sequence; of a critical
load, the median of the solves of its bisection.

**References.** None is adjusted, and all have more digits than the published tables.

- *Mattiasson 1981*: cantilever under a dead tip force, by elliptic integrals; the script checks that all 30 agree with
  the five published digits.
- *Roll-up by an end moment*: an end moment of 2 pi EI/L bends the rod into a circle, twice that into a double one.
- *Heavy elastica*: clamped level at one end, free at the other, under its own weight; by shooting from the free end
  (scipy, DOP853 at 1e-12). The bend at the clamp is sqrt(EI/(w L)) long, 0.03 L for the heaviest: hence the finer mesh.
- *Clamped elastica*: level clamps at the distance D; P L²/EI = 16 K², D/L = 2E/K - 1, rise k/K.
- *Elastic catenary*: pins 0.8 L apart, EA = 50 w L, no bending stiffness. Ours has some, and the part of a row that
  this changes, found by doubling it, is named with it: it is the difference that is left.
- *Euler loads*, *Greenhill 1881* (column under its own weight, clamped at its foot), *Greenhill 1883* (end moment about
  the axis of a rod between clamps), *Zajac 1962* (a straight rod closed to a ring, both clamps at one point, then
  twisted): the largest load at which the straight rod, or the plane ring, is a minimum that the solver keeps, by
  bisection to 1e-8. Each solve begins with the equilibrium to which Newton's method leads from there, whatever its
  stability (`find="equilibrium"`): a search for a minimum that begins without the force through the ring may leave it
  3.6e-4 before it buckles. A mode softer than 1e-6 EI/L² counts as neutral: that is 4e-7 of the lowest Euler load.
- *van der Heijden & Thompson 2000*: B = 1.345, C = 0.789, L = 100, 27 turns, slack 0.03; the closed form is of an
  infinite rod (T L²/B = 16 (1 - z²)/0.03², m = 2 z sqrt(B T), 27 turns = m L/C + 4 arccos z), which at the ends of
  ours is inclined by 3e-5: this enters squared. The solve begins with its shape, and finds its own equilibrium on the
  finer mesh that a helix of 49 rad asks for. With EA L²/B = 1e10 the extension T/EA, 3e-7, would add 1e-5 to the slack
  and 5e-6 to the pull.
- *Linn & Stephan 2008, Fig. 1*: stages a to f of the cable with L/R = 200 (`rodjax.problems.figure_1`), extensible;
  the reference is `rodjax.solve_continuum`, multiple shooting to 1e-10.

"""

SCORES_HEADING = "## cosseratbench\n"
SCORES = (
    SCORES_HEADING
    + """
Five experiments of [cosseratbench](https://github.com/jakeryderv/cosseratbench) {version}, an outside benchmark of rod
solvers, by its own runner, meshes and metrics; rodjax takes part by `rodjax.cosseratbench`. Of its other experiments
*pendulum* is dynamic, and in *pile* a rope is dropped into a heap.

- what must hold, of the last line of each metric: {bound:.0e}; beyond it, marked (!): {beyond}
- *Cantilever*: the reference, F L³/(3 EI), is linear. The exact elastica (elliptic integrals, as above) differs from it
  by as much as rodjax does, on any mesh. What is left beside it is the extension, which it lacks: with EA ten thousand
  times as large, 3e-10. PyElastica and MuJoCo hold the first element rigid.
- *Catenary*: the reference has no bending stiffness. What bending changes falls with EI, and with it the error. With an
  odd number of elements no node is at the lowest point, which adds to `sag_error`.
- *Crossing*: two ropes, the upper one resting in the middle of the lower one; the reference is two planar elasticas.
  rodjax finds this equilibrium unstable, of index 1: the ropes slide along each other until the lower one hangs 32 mm
  aside, with an energy of -0.315580 J where the reference has -0.315207 J (50 elements). From the given shapes rodjax
  goes there. It meets the reference where the upper rope is let down with `find="equilibrium"`. Solvers in time stay at
  the reference if they keep the symmetry to the last bit (PyElastica with 51 elements), else they slide (with 50
  elements 6 mm in 8 s). The kink at the contact is resolved by a node there (50 elements), not within an element (51).
- *Capstan*: friction alone holds a rope over a cylinder, its longer side a part of the longest that holds (capstan
  equation with the rope's weight); `slide` [m] is by how far its light end rises. Those that hold stay where they are
  given, but for what bending and contact change of the given shape. Beyond the longest there is no equilibrium, and
  rodjax finds none; at 0.95 of it, where nearly all of the rope slips, it does with coefficients of 0.1 and 0.6, and
  not with 0.3.
- *Twist*: the experiment measures, by how fast six rods buckle in time, the twist at which the straight rod becomes
  unstable: here `rodjax.critical_point` finds it, for the same reference (Greenhill's problem under tension). What is
  left of the difference is the extension, which the reference lacks.

"""
)


def cells(row: Row) -> tuple[str, ...]:
    mark = "" if row.error <= row.bound else " (!)"
    numbers = f"{row.reference:.9g}", f"{row.ours:.9g}", f"{row.error:.1e}{mark}", str(row.segments), f"{row.ms:.2f}"
    return row.source, row.quantity, row.case, *numbers


def line(cells: Sequence[str]) -> str:
    return "".join(
        f"{cell:{'<' if k < 3 else '>'}{width}}" for k, (cell, width) in enumerate(zip(cells, WIDTHS, strict=True))
    )


def score_cells(score: Score) -> tuple[str, ...]:
    mark = "" if score.error <= score.bound else " (!)"
    return score.experiment, f"`{score.metric}`", score.solver, str(score.segments), f"{score.error:.1e}{mark}"


def scores_markdown(scores: Sequence[Score]) -> str:
    beyond = [f"{score.experiment}, {score.metric}" for score in scores if not score.error <= score.bound]
    version = importlib.metadata.version(OUTSIDE)
    text = SCORES.format(version=version, bound=BOUND, beyond="; ".join(beyond) or "none")
    headings = ("experiment", "metric", "solver", "N", "error")
    return text + table([headings, ("---", "---", "---", "---:", "---:"), *map(score_cells, scores)])


def stored_scores(file: Path) -> str:
    """The section of scores as the file has it."""
    text = file.read_text() if file.exists() else ""
    return text[text.index(SCORES_HEADING) :] if SCORES_HEADING in text else ""


def table(rows: Iterable[Sequence[str]]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def markdown(rows: Sequence[Row]) -> str:
    errors = {bound: [row.error for row in rows if row.bound == bound] for bound in (CRITICAL_BOUND, BOUND)}
    beyond = [f"{row.source}, {row.quantity}, {row.case}" for row in rows if not row.error <= row.bound]
    introduction = INTRODUCTION.format(
        rows=len(rows),
        criticals=len(errors[CRITICAL_BOUND]),
        critical=max(errors[CRITICAL_BOUND], default=math.nan),
        critical_bound=CRITICAL_BOUND,
        other=max(errors[BOUND], default=math.nan),
        bound=BOUND,
        beyond="; ".join(beyond) or "none",
        conditions=conditions(),
    )
    return introduction + table([HEADINGS, ("---", "---", "---", *["---:"] * 5), *map(cells, rows)])


def picture(rows: Sequence[Row]) -> Figure:
    """A line for each quantity of each source, a dot for each row on it, a cross where it is beyond its bound."""
    lines = list(dict.fromkeys((row.source, row.quantity) for row in rows))
    sources = list(dict.fromkeys(row.source for row in rows))
    figure = Figure(figsize=(11, 1.8 + 0.29 * len(lines)), layout="constrained")
    axes = figure.subplots()
    for k, of_line in enumerate(lines):
        here = [row for row in rows if (row.source, row.quantity) == of_line]
        color = f"C{sources.index(of_line[0]) % 10}"
        axes.axhline(k, color="0.92", zorder=0)
        for row in here:
            marker = "o" if row.error <= row.bound else "X"
            axes.plot(max(row.error, 1e-16), k, marker, color=color, alpha=0.7, markeredgecolor="black")
        axes.plot([here[0].bound] * 2, [k - 0.5, k + 0.5], color="tab:red", linewidth=2)
        axes.text(1.8e-3, k, f"{len(here)}", va="center", ha="left", fontsize=8, color="0.3")
    labels = [
        f"{source}:  {quantity}" if k == 0 or lines[k - 1][0] != source else quantity
        for k, (source, quantity) in enumerate(lines)
    ]
    axes.set_yticks(range(len(lines)), labels, fontsize=9)
    axes.set_ylim(len(lines) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlim(3e-17, 4e-3)
    axes.set_xticks([10.0**k for k in range(-16, -2)])
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)
    axes.set_xlabel("relative error of a row (roll-up: tip, and stage a: end force, absolute); red: what must hold")
    meshes = sorted({row.segments for row in rows})
    axes.set_title(
        f"rodjax beside published and closed-form results: {len(rows)} rows (right: how many on a line)\n"
        f"Hermite elements, N = {', '.join(map(str, meshes))}; {machine()}",
        fontsize=10,
    )
    return figure


def outside_scores() -> list[Score] | None:
    """Printed; `None` where cosseratbench is not installed, so that the stored ones are kept."""
    if importlib.util.find_spec(OUTSIDE) is None:
        print(f"skipped, not installed: {OUTSIDE}")
        return None
    found = scores()
    for score in found:
        print("".join(f"{cell:<{width}}" for cell, width in zip(score_cells(score), SCORE_WIDTHS, strict=True)))
    return found


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    mesh = f"a multiple of 4; {HEAVY_FINER} times as many for the heavy elastica, {HELIX_FINER} for the long helix"
    parser.add_argument("--segments", type=int, default=64, help=mesh)
    everything = [*BENCHMARKS, OUTSIDE]
    parser.add_argument("--only", nargs="+", choices=everything, default=everything)
    parser.add_argument("--out", type=Path, help="folder for validation.md and validation.png")
    options = parser.parse_args(argv)
    if options.segments < 8 or options.segments % 4:
        parser.error(f"--segments must be a multiple of 4 and at least 8, got {options.segments}")
    set_up()
    print(conditions())
    print(line(HEADINGS))
    rows: list[Row] = []
    for name in options.only:
        if name == OUTSIDE:
            continue
        found = BENCHMARKS[name](options.segments)
        print("\n".join(line(cells(row)) for row in found), flush=True)
        rows += found
        jax.clear_caches()  # programs that are not needed again: they take memory maps, of which there are 65530
    outside = outside_scores() if OUTSIDE in options.only else None
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        file = options.out / "validation.md"
        section = stored_scores(file) if outside is None else scores_markdown(outside)
        file.write_text(markdown(rows) + ("\n" + section if section else ""))
        picture(rows).savefig(options.out / "validation.png", dpi=110)
    return rows


if __name__ == "__main__":
    main()
