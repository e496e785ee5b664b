"""What a search for a route came to, beside the report of the route itself."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from rodjax.atomic_write import replace_file
from rodjax.io.files import save
from rodjax.io.scene_writing import write_scene
from rodjax.routing.records import plain
from rodjax.routing.report_text import TOLD, table
from rodjax.routing.route import Route
from rodjax.solving.harness_result import results_of, solved_in

# Starts with a row in the table; of more the best.
MOST_ROWS = 20


def starts_table(route: Route) -> str:
    """What varied, and how the starts ended, the best first."""
    numbers = [("found", "")]
    for name, unit, value in zip(route.names, route.units, np.asarray(route.numbers), strict=True):
        told, factor = TOLD[unit] if unit in ("m", "rad") else (unit, 1.0)
        numbers.append((name, f"{factor * float(value) + 0.0:.5g} {told}".rstrip()))
    starts = route.starts
    order = np.lexsort((starts.objective, starts.violation, ~starts.feasible))[:MOST_ROWS]
    rows: list[tuple[str, ...]] = [("start", "objective", "iterations", "solves", "ended")]
    for k in order:
        ended = "keeps to all limits" if starts.feasible[k] else f"fails in {starts.violated[k]}"
        cost, *counts = f"{starts.objective[k]:.6g}", str(starts.iterations[k]), str(starts.solves[k])
        rows.append((str(k), cost, *counts, f"{ended}; {starts.message[k]}"))
    return f"{table(numbers, '<>')}\n\n{table(rows, '>>>><')}"


def as_dict(route: Route) -> dict[str, Any]:
    """What was found, as JSON knows it, in SI units."""
    starts = route.starts
    return {
        "feasible": route.feasible,
        "objective": plain(route.objective),
        "optimal": route.optimal,
        "gain_within_a_thousandth": plain(route.gain),
        "multipliers": {name: plain(value) for name, value in route.multipliers.items()},
        "numbers": {
            name: {"value": plain(value), "unit": unit, "lower": plain(lower), "upper": plain(upper)}
            for name, unit, value, lower, upper in zip(
                route.names, route.units, route.numbers, route.lower, route.upper, strict=True
            )
        },
        "values": {key: plain(value) for key, value in route.values.items()},
        "margins": dict(zip(route.margins.names, plain(np.asarray(route.margins.margin)), strict=True)),
        "gradients": {name: plain(row) for name, row in route.gradients.items()},
        "solves": route.solves,
        "solves_with_gradients": route.with_gradients,
        "solves_failed": route.failed,
        "starts": [
            {
                "feasible": bool(starts.feasible[k]),
                "optimal": bool(starts.optimal[k]),
                "gain_within_a_thousandth": plain(starts.gain[k]),
                "objective": plain(starts.objective[k]),
                "violation": plain(starts.violation[k]),
                "violated": starts.violated[k],
                "iterations": int(starts.iterations[k]),
                "solves": int(starts.solves[k]),
                "message": starts.message[k],
                "design": plain(starts.designs[k]),
            }
            for k in range(len(starts.feasible))
        ],
    }


def written_route(route: Route, folder: Path) -> list[Path]:
    """Writes route.json, result.vtkhdf and, where a scene file can hold it, scene.toml; returns their names."""
    written = [folder / "route.json", folder / "result.vtkhdf"]
    replace_file(written[0], f"{json.dumps(as_dict(route), indent=1, allow_nan=False)}\n".encode())
    save(route.verified, written[1])
    rods = results_of(route.verified).values()
    if all(rod.scene.rod.rest_centerline is None for rod in rods):
        written.append(folder / "scene.toml")
        write_scene(solved_in(route.verified), written[-1], route.segments)
    return written
