"""Can a cable be routed through an engine bay by gradient? From connector to connector, past five parts.

1.2 m of a cable of 10 mm (EI = 0.02 N m^2, 0.15 kg/m) with three clips, each within a box: over the engine block, over
the coolant pipe and near the second connector. Sought: the places and arclengths of the clips and the length, for the
least length [m] and elastic energy [J] together. Kept: an inside bend radius of 6 diameters, 10 mm to every part, a
pull of 5 N at the connectors.

    python experiments/engine_bay.py --out build/engine_bay [--starts 64] [--compare]

It writes the report of the best design (`report.txt`, `.csv`, `.json`, `.png` and `.html`), `starts.csv`, and
`verified.csv`: the margins on a mesh twice as fine as that of the search, and in the continuum.
"""

import argparse
import csv
import sys
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution, minimize

import rodjax as rj
from rodjax.paths.batch import solve_first, solve_stack
from rodjax.routing.problem import Problem, arranged, scenes_at, spare_lengths, valued
from rodjax.routing.route import RESERVE, SEGMENTS, TOLERANCE
from rodjax.routing.variables import checked_variables
from rodjax.solving.options import checked_options
from rodjax.solving.result import Equilibrium

jax.config.update("jax_enable_x64", True)  # before the numbers below are made

OBSTACLES = {
    "engine block": rj.Box((0.35, 0.15, 0.0), (0.3, 0.2, 0.25)),
    "coolant pipe": rj.Capsule((0.6, -0.2, 0.1), (0.6, 0.5, 0.1), 0.03),
    "turbocharger": rj.Sphere((0.5, -0.02, 0.18), 0.07),
    "wing": rj.Plane((0.0, -0.15, 0.0), (0.0, 1.0, 0.0)),
    "reservoir": rj.Cylinder((0.12, 0.25, -0.25), (0.12, 0.25, 0.25), 0.06),
}
LIMITS = rj.Limits(bend_radius=6, clearance=0.01, end_force=5)
OBJECTIVE = rj.Objective(length=1, energy=1)


def scene() -> rj.Scene:
    cable = rj.Rod(1.2, EI=0.02, GJ=0.015, EA=2e4, mass_per_length=0.15, radius=0.005)
    start = rj.Clamp((0.0, 0.0, 0.0), rj.frame((1, 0, 0)))
    end = rj.Clamp((0.8, 0.35, 0.0), rj.frame((0, 1, 0), (1, 0, 0)))
    clips = [
        rj.Clip(0.4, (0.3, 0.12, 0.15)),
        rj.Clip(0.7, (0.58, 0.2, 0.19)),
        rj.Clip(0.95, (0.73, 0.23, 0.12)),
    ]
    return rj.Scene(cable, start, end, gravity=(0, 0, -9.81), clips=clips)


def variables() -> list[Any]:
    return [
        rj.Between("clips.0.position", (0.2, 0.05, 0.145), (0.5, 0.25, 0.18)),
        rj.Between("clips.1.position", (0.5, 0.1, 0.16), (0.68, 0.28, 0.22)),
        rj.Between("clips.2.position", (0.68, 0.15, 0.0), (0.8, 0.28, 0.2)),
        rj.Between("clips.0.at", 0.2, 0.6),
        rj.Between("clips.1.at", 0.45, 0.9),
        rj.Between("clips.2.at", 0.65, 1.2),
        rj.Between("rod.length", 1.1, 1.4),
    ]


def found(starts: int, seed: int = 0, *, progress: bool = False) -> rj.Route:
    return rj.route(
        scene(),
        variables(),
        limits=LIMITS,
        objective=OBJECTIVE,
        obstacles=list(OBSTACLES.values()),
        names=list(OBSTACLES),
        starts=starts,
        seed=seed,
        progress=progress,
    )


def reported(route: rj.Route) -> rj.Report:
    return rj.report(
        route.verified,
        limits=LIMITS,
        obstacles=list(OBSTACLES.values()),
        names=list(OBSTACLES),
        gradients=route,
        title="Engine bay",
    )


def in_the_continuum(route: rj.Route) -> rj.Margins:
    """The margins of the same design without a mesh."""
    assert isinstance(route.scene, rj.Scene)
    assert isinstance(route.verified, rj.Equilibrium)
    exact = rj.solve_continuum(route.scene, guess=route.verified)
    if not exact.converged:
        raise RuntimeError(f"no equilibrium of the continuum: {rj.describe(exact)}")
    return rj.margins(exact, LIMITS, list(OBSTACLES.values()), list(OBSTACLES))


def save(route: rj.Route, exact: rj.Margins, folder: Path) -> None:
    """`exact`: the margins in the continuum."""
    reported(route).save(folder)
    with (folder / "verified.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["name", "unit", "kind", "limit", "value", "margin", "value_continuum", "margin_continuum"])
        found = route.margins
        columns = (found.limit, found.value, found.margin, exact.value, exact.margin)
        for row in zip(
            found.names, found.units, found.kinds, *(np.asarray(column).tolist() for column in columns), strict=True
        ):
            table.writerow(row)
    with (folder / "starts.csv").open("w", newline="") as file:
        table = csv.writer(file)
        starts = route.starts
        table.writerow(
            ["start", "feasible", "objective", "violation", "violated", "iterations", "solves", "message", *route.names]
        )
        for k, row in enumerate(
            zip(
                starts.feasible,
                starts.objective,
                starts.violation,
                starts.violated,
                starts.iterations,
                starts.solves,
                starts.message,
                strict=True,
            )
        ):
            table.writerow([k, *row, *starts.designs[k]])


# --- the same without gradients --------------------------------------------------------------------------------------


class Values(NamedTuple):
    """Objective and slacks of a design; of one without an equilibrium what a search steps back from."""

    objective: float
    slacks: np.ndarray


class Model:
    """The problem of `route`, a batch of designs at a time, by values alone."""

    def __init__(self, size: int):
        start = scene()
        self.problem = Problem(
            start,
            checked_variables(variables(), start),
            LIMITS,
            tuple(OBSTACLES.values()),
            OBJECTIVE,
            SEGMENTS,
            rj.Newton(),
        )
        self.size, self.solves = size, 0
        self.count = sum(variable.count for variable in self.problem.variables)
        self.options = checked_options(start, SEGMENTS, None, "hermite", rj.Newton(), None, False)[0]

    def cold(self, designs: np.ndarray) -> tuple[list[Values], Equilibrium]:
        """Each from the library's own start."""
        padded = jnp.asarray(np.pad(designs, ((0, self.size - len(designs)), (0, 0)), mode="edge"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rj.NotConvergedWarning)  # counted as not valid
            results = solve_stack(scenes_at(self.problem, padded), segments=SEGMENTS, strain_limit=None)
        return self._values(padded, results, len(designs)), results

    def warm(self, design: np.ndarray, guess: Equilibrium) -> tuple[Values, Equilibrium]:
        """From a stack of guesses, of which the first is taken."""
        designs = jnp.asarray(np.repeat(design[None], self.size, axis=0))
        _, scenes, guesses = arranged(self.problem, designs, guess, jnp.zeros(self.size, int))
        results = solve_first(scenes, guesses, 1, self.options)
        results = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], self.size, axis=0), results)
        return self._values(designs, results, 1)[0], results

    def _values(self, designs: jax.Array, results: Equilibrium, count: int) -> list[Values]:
        self.solves += count
        objective, slacks, is_valid = (np.asarray(x)[:count] for x in valued(self.problem, designs, results))
        return [
            Values(float(f), s) if valid else Values(1e3, np.full(slacks.shape[1], -1e3))
            for f, s, valid in zip(objective, slacks, is_valid, strict=True)
        ]


def kept_beyond(route: rj.Route, model: Model) -> tuple[int, int, int]:
    """Of how many starts the designs, solved from the library's own start, come to the same equilibrium, and keep to
    the limits on a mesh twice as fine, and in the continuum.
    """
    variables = model.problem.variables
    offsets = np.concatenate([variable.offsets() for variable in variables])
    scales = np.concatenate([variable.scales() for variable in variables])
    scenes = scenes_at(model.problem, jnp.asarray((route.starts.designs - offsets) / scales))
    coarse = rj.solve_batch(scenes, segments=SEGMENTS)
    objective = coarse.elastic_energy + coarse.scene.rod.length
    same = np.abs(objective - route.starts.objective) < 1e-6 * route.starts.objective
    fine = rj.solve_batch(scenes, segments=2 * SEGMENTS, guess=coarse)
    obstacles = list(OBSTACLES.values())
    on_mesh = np.all(np.asarray(rj.margins(fine, LIMITS, obstacles).margin) >= 0, axis=1)
    in_continuum = 0
    for k in range(len(on_mesh)):
        here = jax.tree.map(lambda leaf, k=k: leaf[k], fine)
        exact = rj.solve_continuum(here.scene, guess=here)
        in_continuum += bool(exact.converged) and bool(np.all(rj.margins(exact, LIMITS, obstacles).margin >= 0))
    return int(np.sum(same)), int(np.sum(on_mesh)), in_continuum


def drawn(count: int, model: Model) -> np.ndarray:
    """Random designs as `route` draws them: with rod enough between held places."""
    designs = np.random.default_rng(0).random((64 * count, model.count))
    return designs[np.asarray(spare_lengths(model.problem, jnp.asarray(designs))) > 0][:count]


def by_differences(start: np.ndarray, model: Model) -> tuple[float, float, int]:
    """Objective, least slack and solves of SLSQP with scipy's differences, each solve from the last."""
    known: dict[bytes, Values] = {}
    _, state = model.cold(start[None])
    model.solves = 0

    def values(design: np.ndarray) -> Values:
        nonlocal state
        key = design.tobytes()
        if key not in known:
            known[key], result = model.warm(design, state)
            if bool(result.converged[0]):
                state = result
        return known[key]

    result = minimize(
        lambda x: values(x).objective,
        start,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(start),
        constraints=[{"type": "ineq", "fun": lambda x: values(x).slacks - RESERVE}],
        # Steps beside which what a solve leaves is small.
        options={"ftol": TOLERANCE, "maxiter": 100, "eps": 1e-5},
    )
    last = values(result.x)
    return last.objective, float(np.min(last.slacks)), model.solves


def by_evolution(seconds: float, model: Model) -> tuple[float, int]:
    """The best objective that keeps to the limits by differential evolution within a time, and its solves."""
    begin, best, model.solves = time.perf_counter(), np.inf, 0

    def costs(designs: np.ndarray) -> np.ndarray:
        nonlocal best
        found = []
        for first in range(0, designs.shape[1], model.size):
            found += model.cold(designs.T[first : first + model.size])[0]
        for value in found:
            if np.min(value.slacks) >= 0:
                best = min(best, value.objective)
        violation = [float(np.sum(np.log1p(np.maximum(-value.slacks, 0.0)))) for value in found]
        return np.array([value.objective for value in found]) + 10 * np.array(violation)

    same: dict[str, Any] = {"seed": 0}
    differential_evolution(
        costs,
        [(0.0, 1.0)] * model.count,
        vectorized=True,
        updating="deferred",
        polish=False,
        **same,
        maxiter=1_000_000,
        tol=0.0,
        callback=lambda *_: time.perf_counter() - begin > seconds,
    )
    return best, model.solves


def compared(route: rj.Route, seconds: float, *, most: float, differences: int = 8) -> list[tuple[str, str]]:
    """Rows of a table: what was found, and at what cost."""
    starts = route.starts
    rows = [
        ("starts that keep to the limits", f"{np.sum(starts.feasible)} of {len(starts.feasible)}"),
        ("best objective by gradients", f"{route.objective:.5f}"),
        ("seconds by gradients, compiled", f"{seconds:.1f}"),
        ("solves by gradients, all starts", f"{route.solves}"),
        ("solves by gradients, a start", f"{np.mean(starts.solves):.1f}"),
        ("iterations by gradients, a start", f"{np.mean(starts.iterations):.1f}"),
    ]
    model = Model(64)
    same, on_mesh, in_continuum = kept_beyond(route, model)
    rows.append(("the same equilibrium from a cold start", f"{same}"))
    rows.append(("limits kept on a mesh twice as fine", f"{on_mesh}"))
    rows.append(("limits kept in the continuum", f"{in_continuum}"))
    with_differences = np.sum(starts.solves) + model.count * np.sum(starts.iterations)
    rows.append(("the same with differences", f"{with_differences / np.sum(starts.solves):.1f} times as many"))
    each = [by_differences(start, model) for start in drawn(differences, model)]
    for k, (objective, slack, solves) in enumerate(each):
        rows.append((f"SLSQP by differences {k}", f"{objective:.5f}, least slack {slack:.1e}, {solves} solves"))
    budget = min(50 * seconds, most)
    best, solves = by_evolution(budget, model)
    rows.append(("seconds of differential evolution", f"{budget:.0f} ({budget / seconds:.0f} times)"))
    rows.append(("best objective of differential evolution", f"{best:.5f} after {solves} solves"))
    rows.append(("best by gradients beside it", f"{100 * (route.objective / best - 1):+.2f} %"))
    return rows


def main(arguments: list[str] | None = None) -> rj.Route:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the report")
    parser.add_argument("--starts", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compare", action="store_true", help="beside SLSQP by differences and differential evolution")
    parser.add_argument("--most", type=float, default=600.0, help="most seconds of differential evolution")
    options = parser.parse_args(arguments)
    rj.enable_compilation_cache()
    route = found(options.starts, options.seed, progress=sys.stderr.isatty())
    print(route)
    print(route.margins)
    exact = in_the_continuum(route)
    save(route, exact, options.out)
    print(f"least margin in the continuum: {float(np.min(exact.margin)):.2e}")
    if options.compare:
        begin = time.perf_counter()
        found(options.starts, options.seed)  # compiled by now
        rows = compared(route, time.perf_counter() - begin, most=options.most)
        print("\n".join(f"{name:45} {value}" for name, value in rows))
        (options.out / "compared.csv").write_text("".join(f"{name},{value!r}\n" for name, value in rows))
    return route


if __name__ == "__main__":
    main()
