"""Are estimates right, are their intervals, and what do they cost? Synthetic experiments with a known truth.

    python experiments/identify_synthetic.py [--out docs] [--count 1000] [--joint 1 10 100 1000 10000] [--peers 10]
        [--joint-peer 100]

A cable of 1 m between two clamps under its own weight, the end rolled by a quarter turn, so that it is bent in space
and twisted. Measured are 21 points (1 mm), force and moment of the end (10 mN, 1 mN m). Unknown are EI, GJ and
weight; and of each rig the pitch of the start clamp and a shift of the arclength.

`recovery`: `count` such experiments, each with a truth of its own, fitted each by itself: bias in standard errors of
the mean, and how often the 95 % intervals hold the truth. `joint`: all have the same cable, in one fit with two
nuisance parameters each. `peer`: the first fits again by scipy's `least_squares` with differences, of `rodjax.solve` as
a user would call it, and of the same residuals compiled and warm-started; `joint peer`: a joint fit again.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from measuring import conditions, save_rows, set_up
from scipy.optimize import least_squares

import rodjax as rj

SEGMENTS = 32
EI, GJ, MASS = 4.9e-3, 3.3e-3, 0.08
SD_POINT, SD_FORCE, SD_MOMENT = 1e-3, 1e-2, 1e-3
S = np.linspace(0.05, 0.95, 21)
GRAVITY = (0.0, 0.0, -9.81)
# Of the truth about the nominal values; of the pitch [rad] and of the shift [m].
SPREAD, PITCH, SHIFT = 0.1, 0.02, 2e-3
MATERIAL = ("rod.EI", "rod.GJ", "rod.mass_per_length")
NUISANCE = ("start.frame.1", "measured.0.shift")


class Row(NamedTuple):
    case: str
    experiments: str
    value: str
    meaning: str


def stacked(material: np.ndarray, pitch: np.ndarray, ends: np.ndarray) -> rj.Scene:
    """A stack: `material` (e, 3), `pitch` (e,), positions of the end (e, 3)."""

    def one(material: jax.Array, pitch: jax.Array, end: jax.Array) -> rj.Scene:
        rod = rj.Rod(1.0, material[0], material[1], 1e3, material[2])
        level = rj.frame((1, 0, 0), d2=(0, 1, 0))
        pitched = rj.rotate(level, jnp.stack([0 * pitch, pitch, 0 * pitch]))
        rolled = rj.frame((1, 0, 0), d2=(0, 0, 1))
        return rj.Scene(rod, rj.Clamp((0, 0, 0), pitched), rj.Clamp(end, rolled), GRAVITY)

    return jax.vmap(one)(*(jnp.asarray(x) for x in (material, pitch, ends)))


def made_up(count: int, seed: int, spread: float) -> tuple[list[rj.Experiment], np.ndarray]:
    """Experiments with noise, and the truth (count, 5)."""
    draw = np.random.default_rng(seed)
    material = np.array([EI, GJ, MASS]) * np.exp(spread * draw.standard_normal((count, 3)))
    pitch, shift = PITCH * draw.standard_normal(count), SHIFT * draw.standard_normal(count)
    ends = np.array([0.7, 0.1, 0.0]) + draw.uniform(-0.05, 0.05, (count, 3))
    results = rj.solve_batch(stacked(material, pitch, ends), segments=64)
    points = np.asarray(jax.vmap(lambda result, shift: result.position_at(S + shift))(results, jnp.asarray(shift)))
    nominal = stacked(np.tile([EI, GJ, MASS], (count, 1)), np.zeros(count), ends)
    experiments = []
    for k in range(count):
        measured = (
            rj.Centerline(points[k] + SD_POINT * draw.standard_normal(points[k].shape), S, SD_POINT),
            rj.EndForce(np.asarray(results.end_force[k]) + SD_FORCE * draw.standard_normal(3), SD_FORCE),
            rj.EndMoment(np.asarray(results.end_moment[k]) + SD_MOMENT * draw.standard_normal(3), SD_MOMENT),
        )
        scene = jax.tree.map(lambda leaf, k=k: jax.device_put(np.asarray(leaf)[k]), nominal)
        experiments.append(rj.Experiment(scene, measured))
    return experiments, np.concatenate([material, pitch[:, None], shift[:, None]], axis=1)


def timed(function: Any) -> tuple[Any, float]:
    """What a second call gives, compiled, and its seconds."""
    function()
    begin = time.perf_counter()
    found = function()
    return found, time.perf_counter() - begin


def recovery(count: int, peers: int) -> list[Row]:
    experiments, truth = made_up(count, seed=5, spread=SPREAD)
    unknowns = [rj.Unknown(name) for name in (*MATERIAL, *NUISANCE)]
    fits, seconds = timed(lambda: rj.fit_each(experiments, unknowns, segments=SEGMENTS))
    rows = [
        Row("recovery: converged", str(count), f"{np.mean(fits.converged):.4f}", "share"),
        Row("recovery: time", str(count), f"{seconds:.3f}", "s, all fits"),
        Row("recovery: time a fit", str(count), f"{1e3 * seconds / count:.3f}", "ms"),
        Row("recovery: steps", str(count), f"{np.median(fits.steps):.0f}", "median"),
    ]
    low, high = fits.intervals(0.95)
    for k, name in enumerate(fits.labels):
        is_log = bool(fits.is_log[k])
        errors = np.log(fits.estimates[:, k] / truth[:, k]) if is_log else fits.estimates[:, k] - truth[:, k]
        mean = np.mean(errors) / (np.std(errors, ddof=1) / np.sqrt(count))
        covered = np.mean((low[:, k] <= truth[:, k]) & (truth[:, k] <= high[:, k]))
        rows.append(Row(f"recovery: bias of {name}", str(count), f"{mean:+.2f}", "standard errors of the mean"))
        rows.append(Row(f"recovery: scatter of {name}", str(count), f"{np.std(errors):.2e}", "relative, m or rad"))
        rows.append(Row(f"recovery: coverage of {name}", str(count), f"{covered:.4f}", "by 95 % intervals"))
    if peers:
        for how in ("rodjax.solve", "compiled"):
            rows += peer(experiments[:peers], fits, seconds / count, how)
    return rows


def scene_of(x: Any, nominal: rj.Scene) -> rj.Scene:
    start = nominal.start
    assert isinstance(start, rj.Clamp)
    xp = np if isinstance(x, np.ndarray) else jnp
    rod = rj.Rod(1.0, xp.exp(x[0]), xp.exp(x[1]), 1e3, xp.exp(x[2]))
    pitched = rj.Clamp(start.position, rj.rotate(start.frame, xp.stack([0 * x[3], x[3], 0 * x[3]])))
    return rj.Scene(rod, pitched, nominal.end, nominal.gravity)


def residuals(x: Any, result: rj.Equilibrium, points: Any, force: Any, moment: Any) -> jax.Array:
    parts = (
        (points - result.position_at(jnp.asarray(S) + x[4])) / SD_POINT,
        (force - result.end_force) / SD_FORCE,
        (moment - result.end_moment) / SD_MOMENT,
    )
    return jnp.concatenate([part.reshape(-1) for part in parts])


def peer(experiments: Sequence[rj.Experiment], fits: rj.Fits, seconds: float, how: str) -> list[Row]:
    """scipy's method with its differences."""

    @jax.jit
    def compiled(x: jax.Array, nominal: rj.Scene, guess: rj.Equilibrium, data: Any) -> jax.Array:
        return residuals(x, rj.solve(scene_of(x, nominal), segments=SEGMENTS, guess=guess), *data)

    start = np.array([np.log(EI), np.log(GJ), np.log(MASS), 0.0, 0.0])
    times, evaluations, differences = [], [], []
    for k, experiment in enumerate(experiments):
        guess = rj.solve(experiment.scene, segments=SEGMENTS)
        data = [m.values for m in experiment.measured]

        def of(x: np.ndarray, nominal: rj.Scene = experiment.scene, guess: Any = guess, data: Any = data):
            nonlocal calls
            calls += 1
            if how == "compiled":
                return np.asarray(compiled(jnp.asarray(x), nominal, guess, data))
            return np.asarray(residuals(x, rj.solve(scene_of(x, nominal), segments=SEGMENTS), *data))

        calls = 0
        of(start)
        calls = 0
        begin = time.perf_counter()
        found = least_squares(of, start, method="lm")
        times.append(time.perf_counter() - begin)
        evaluations.append(calls)
        value = np.exp(found.x[:3])
        differences.append(float(np.max(np.abs(value / fits.estimates[k, :3] - 1))))
    median = float(np.median(times))
    count = str(len(experiments))
    return [
        Row(f"peer, {how}: scipy least_squares, a fit", count, f"{1e3 * median:.1f}", "ms, median"),
        Row(f"peer, {how}: evaluations a fit", count, f"{np.median(evaluations):.0f}", "solves, median"),
        Row(
            f"peer, {how}: its estimates beside ours",
            count,
            f"{np.max(differences):.1e}",
            "largest relative difference",
        ),
        Row(f"peer, {how}: its time by ours", count, f"{median / seconds:.1f}", "times"),
    ]


def joint(counts: Sequence[int]) -> list[Row]:
    rows = []
    unknowns = [rj.Unknown(name) for name in MATERIAL] + [rj.Unknown(name, per="experiment") for name in NUISANCE]
    experiments, _ = made_up(max(counts), seed=2, spread=0.0)
    for count in counts:
        fit, seconds = timed(lambda count=count: rj.fit(experiments[:count], unknowns, segments=SEGMENTS))
        errors = [np.log(fit.estimate[name] / true) for name, true in zip(MATERIAL, (EI, GJ, MASS), strict=True)]
        by_error = [x * fit.estimate[name] / fit.standard_error[name] for x, name in zip(errors, MATERIAL, strict=True)]
        told = ", ".join(f"{x:+.2f}" for x in by_error)
        rows.append(Row("joint: errors of EI, GJ, weight", str(count), told, "standard errors"))
        rows.append(Row("joint: time", str(count), f"{seconds:.3f}", f"s, {fit.steps} steps"))
        rows.append(Row("joint: time an experiment", str(count), f"{1e3 * seconds / count:.3f}", "ms"))
    return rows


def joint_peer(count: int) -> list[Row]:
    """One fit of all in scipy, its Jacobian by differences of all unknowns; residuals compiled, one batch, warm."""
    experiments, _ = made_up(count, seed=2, spread=0.0)
    unknowns = [rj.Unknown(name) for name in MATERIAL] + [rj.Unknown(name, per="experiment") for name in NUISANCE]
    fit, ours = timed(lambda: rj.fit(experiments, unknowns, segments=SEGMENTS))
    nominal = rj.solve_batch([experiment.scene for experiment in experiments], segments=SEGMENTS)
    data = [np.stack([np.asarray(e.measured[k].values) for e in experiments]) for k in range(3)]

    @jax.jit
    def compiled(x: jax.Array) -> jax.Array:
        def one(own: jax.Array, guess: rj.Equilibrium, data: Any) -> jax.Array:
            x_one = jnp.concatenate([x[:3], own])
            return residuals(x_one, rj.solve(scene_of(x_one, guess.scene), segments=SEGMENTS, guess=guess), *data)

        return jax.vmap(one)(x[3:].reshape(count, 2), nominal, data).reshape(-1)

    start = np.concatenate([np.log([EI, GJ, MASS]), np.zeros(2 * count)])
    compiled(start)
    begin = time.perf_counter()
    found = least_squares(lambda x: np.asarray(compiled(x)), start)
    seconds = time.perf_counter() - begin
    difference = np.max(np.abs(np.exp(found.x[:3]) / [fit.estimate[name] for name in MATERIAL] - 1))
    return [
        Row("joint peer: scipy least_squares", str(count), f"{seconds:.2f}", f"s, {len(start)} unknowns"),
        Row("joint peer: its estimates beside ours", str(count), f"{difference:.1e}", "largest relative difference"),
        Row("joint peer: its time by ours", str(count), f"{seconds / ours:.1f}", "times"),
    ]


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description="Recovery, coverage and time of fits to synthetic experiments.")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--count", type=int, default=1000, help="experiments fitted each by itself")
    parser.add_argument("--joint", type=int, nargs="*", default=[1, 10, 100, 1000, 10000], help="of one fit")
    parser.add_argument("--peers", type=int, default=10, help="fits done again by scipy")
    parser.add_argument("--joint-peer", type=int, default=100, help="experiments of one fit done again by scipy")
    arguments = parser.parse_args(argv)
    print(conditions())
    rows = recovery(arguments.count, arguments.peers) if arguments.count else []
    if arguments.joint:
        rows += joint(arguments.joint)
    if arguments.joint_peer:
        rows += joint_peer(arguments.joint_peer)
    save_rows(rows, arguments.out / "identify_synthetic.csv")
    for row in rows:
        print(f"{row.case:45} {row.experiments:>6} {row.value:>24} {row.meaning}")
    return rows


if __name__ == "__main__":
    set_up()
    main()
