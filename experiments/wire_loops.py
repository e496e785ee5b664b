"""Bending stiffness of three real wires from photographs of hanging loops.

    python experiments/wire_loops.py --data DIR --out DIR

`--data`: the folder with `loops.csv` and `wires.csv`: 3 wires, 5 repeats of a loop of 1.5 m in a vertical plane, 51
nodes each (Chen, Bretl & Pham, arXiv:2310.00911, MIT licence). The wire leaves a holder level and comes back to it
level after a whole turn. Writes `fits.csv`, one row a model and loop:

- `EI`: the stiffness alone, clamps level, the end where the last node was measured.
- `EI+angles`: the turns of both clamps in the plane too, positive downwards.
- `EI+angles+tilt`: and the tilt of the camera, as a level part of gravity.
- `EI+angles, pooled`: one stiffness and one pair of angles for all repeats of a wire.

and `prediction.csv` (each repeat from a pooled fit to the others), `report_*.txt` and pictures.
"""

import argparse
import csv
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from measuring import conditions, save_rows, set_up

import rodjax as rj

GRAVITY = (0.0, 9.81, 0.0)  # as in the data the second axis points down
# Inextensible: the heaviest wire stretches by 4e-7 under its own weight.
EA = 1e6
# Of GJ a planar loop says nothing; this is that of a solid incompressible wire.
GJ_BY_EI = 2 / 3
# Where the search begins, by the weight: m g L^2 divided by this.
FIRST = 1000.0
VIEW = rj.orthographic((1, 0, 0), (0, 1, 0))
ANGLES = ("start.frame.2", "end.frame.2")
TILT = "gravity.0"
# The white wire turns sharply at the clamps: 32 elements change its stiffness by 1.4 %, 64 by 0.1 %.
SEGMENTS = 64


class Row(NamedTuple):
    """A line of fits.csv; of pooled fits `repeat` is `all`, `se` by clusters."""

    wire: str
    repeat: str
    model: str
    EI: str
    se: str
    rms_m: str
    theta0_deg: str
    thetaL_deg: str  # noqa: N815
    converged: str


class Loop(NamedTuple):
    wire: str
    repeat: str
    s: np.ndarray
    points: np.ndarray
    mass_per_length: float


def read_loops(folder: Path) -> list[Loop]:
    with (folder / "wires.csv").open() as file:
        mass = {row["wire"]: float(row["mass_per_length_kg_m"]) for row in csv.DictReader(file)}
    rows: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    with (folder / "loops.csv").open() as file:
        for row in csv.DictReader(file):
            point = float(row["s_m"]), float(row["x_m"]), float(row["y_down_m"])
            rows.setdefault((row["wire"], row["repeat"]), []).append(point)
    loops = []
    for (wire, repeat), points in rows.items():
        array = np.array(points)
        loops.append(Loop(wire, repeat, array[:, 0], array[:, 1:], mass[wire]))
    return loops


def experiment(loop: Loop) -> rj.Experiment:
    length = float(loop.s[-1])
    EI = loop.mass_per_length * GRAVITY[1] * length**3 / FIRST
    rod = rj.Rod(length, EI, GJ_BY_EI * EI, EA, loop.mass_per_length)
    level = rj.frame((1, 0, 0), d2=(0, 0, 1))
    end = (*loop.points[-1], 0.0)
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), level), rj.Clamp(end, level), GRAVITY)
    measured = rj.Centerline(loop.points, loop.s, camera=VIEW)
    # In space the points are a first shape, which has the whole turn that two level clamps do not tell.
    return rj.Experiment(scene, measured, cluster=loop.repeat, name=f"{loop.wire} {loop.repeat}")


def fit_singly(loops: Sequence[Loop]) -> tuple[list[Row], float]:
    """The models of every loop, in one call; and the seconds of a second such call."""
    experiments = [experiment(loop) for loop in loops]
    unknowns = [rj.Unknown(name) for name in ("rod.EI", *ANGLES, TILT)]
    models = {"EI": (True, False, False, False), "EI+angles": (True, True, True, False), "EI+angles+tilt": (True,) * 4}
    free = np.repeat(np.array(list(models.values())), len(loops), axis=0)

    def fits() -> rj.Fits:
        return rj.fit_each(experiments * len(models), unknowns, free=free, segments=SEGMENTS, planar=True)

    fits()
    begin = time.perf_counter()
    found = fits()
    seconds = time.perf_counter() - begin
    rows = []
    for k, (model, loop) in enumerate((model, loop) for model in models for loop in loops):
        EI, *angles, _ = found.estimates[k]
        rows.append(
            Row(
                loop.wire,
                loop.repeat,
                model,
                f"{EI:.6e}",
                f"{found.standard_errors[k, 0]:.2e}",
                f"{found.rms[k, 0]:.6e}",
                f"{math.degrees(angles[0]):.4f}",
                f"{math.degrees(angles[1]):.4f}",
                str(bool(found.converged[k])),
            )
        )
    error = float(np.max(found.equilibria.error_estimate))
    print(f"meshes of {SEGMENTS} elements, error of the shapes about {error:.0e} of the length")
    return rows, seconds


def fit_pooled(loops: Sequence[Loop], model: str, out: Path) -> tuple[Row, rj.Fit]:
    unknowns = [rj.Unknown("rod.EI"), *(rj.Unknown(name) for name in ANGLES)]
    fit = rj.fit([experiment(loop) for loop in loops], unknowns, segments=SEGMENTS, planar=True)
    wire = loops[0].wire
    rms = math.sqrt(float(np.mean(np.concatenate(fit.rms) ** 2)))
    row = Row(
        wire,
        "all",
        model,
        f"{fit.estimate['rod.EI']:.6e}",
        f"{fit.clustered_error['rod.EI']:.2e}",
        f"{rms:.6e}",
        f"{math.degrees(fit.estimate[ANGLES[0]]):.4f}",
        f"{math.degrees(fit.estimate[ANGLES[1]]):.4f}",
        str(fit.converged),
    )
    (out / f"report_{wire}.txt").write_text(fit.report() + "\n")
    return row, fit


def predictions(loops: Sequence[Loop], fit: rj.Fit) -> list[dict[str, str]]:
    """Each repeat with the numbers of a pooled fit to the others."""
    rows = []
    low, high = fit.interval("rod.EI", clustered=True)
    for left_out, estimate in fit.leave_one_out().items():
        loop = next(loop for loop in loops if loop.repeat == left_out)
        predicted = rj.solve(with_estimate(experiment(loop).scene, estimate), segments=SEGMENTS, guess=first(loop))
        distances = np.linalg.norm(np.asarray(predicted.position_at(loop.s))[:, :2] - loop.points, axis=1)
        rows.append(
            {
                "wire": loop.wire,
                "left_out": left_out,
                "EI": f"{estimate['rod.EI']:.6e}",
                "rms_m": f"{math.sqrt(float(np.mean(distances**2))):.6e}",
                "in_interval_by_clusters": str(low <= estimate["rod.EI"] <= high),
            }
        )
    return rows


def first(loop: Loop) -> rj.Guess:
    return rj.Guess(np.concatenate([loop.points, np.zeros((len(loop.s), 1))], axis=1))


def with_estimate(scene: rj.Scene, estimate: dict[str, float]) -> rj.Scene:
    rod, start, end = scene.rod, scene.start, scene.end
    assert isinstance(start, rj.Clamp)
    assert isinstance(end, rj.Clamp)
    bent = rj.Rod(rod.length, estimate["rod.EI"], rod.GJ, rod.EA, rod.mass_per_length)
    turned_start = rj.Clamp(start.position, rj.rotate(start.frame, (0, 0, estimate[ANGLES[0]])))
    turned_end = rj.Clamp(end.position, rj.rotate(end.frame, (0, 0, estimate[ANGLES[1]])))
    return rj.Scene(bent, turned_start, turned_end, scene.gravity)


def draw(loops: Sequence[Loop], rows: Sequence[Row], out: Path) -> None:
    wires = list(dict.fromkeys(loop.wire for loop in loops))
    figure, axes = plt.subplots(1, len(wires), figsize=(4 * len(wires), 5), layout="constrained", squeeze=False)
    for axis, wire in zip(axes[0], wires, strict=True):
        for k, loop in enumerate(loop for loop in loops if loop.wire == wire):
            color = f"C{k}"
            axis.plot(*loop.points.T, ".", color=color, markersize=3)
            for model, style in (("EI", ":"), ("EI+angles", "-")):
                row = next(r for r in rows if (r.wire, r.repeat, r.model) == (wire, loop.repeat, model))
                angles = (math.radians(float(row.theta0_deg)), math.radians(float(row.thetaL_deg)))
                estimate = {"rod.EI": float(row.EI), **dict(zip(ANGLES, angles, strict=True))}
                scene = with_estimate(experiment(loop).scene, estimate)
                shape = rj.solve(scene, segments=SEGMENTS, guess=first(loop))
                at = np.linspace(0, float(loop.s[-1]), 201)
                axis.plot(*np.asarray(shape.position_at(at))[:, :2].T, style, color=color, linewidth=1)
        axis.set(title=f"{wire}: measured (dots), EI (dotted), EI and angles", xlabel="x [m]", ylabel="y down [m]")
        axis.title.set_fontsize(9)
        axis.set_aspect("equal")
        axis.invert_yaxis()
    figure.savefig(out / "wire_loops.png", dpi=150)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Stiffness of real wires from photographs of hanging loops.")
    parser.add_argument("--data", type=Path, required=True, help="folder with loops.csv and wires.csv")
    parser.add_argument("--out", type=Path, default=Path("wire_loops"), help="folder for tables, reports and pictures")
    arguments = parser.parse_args(argv)
    for name in ("loops.csv", "wires.csv"):
        if not (arguments.data / name).is_file():
            parser.error(f"--data must be the folder with {name}, got {str(arguments.data)!r}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    loops = read_loops(arguments.data)
    print(conditions())
    rows, seconds = fit_singly(loops)
    print(f"{len(rows)} fits in one call: {seconds:.3f} s")
    predicted: list[dict[str, str]] = []
    for wire in dict.fromkeys(loop.wire for loop in loops):
        of_wire = [loop for loop in loops if loop.wire == wire]
        row, fit = fit_pooled(of_wire, "EI+angles, pooled", arguments.out)
        rows.append(row)
        predicted += predictions(of_wire, fit)
        print(f"\n{wire}, pooled\n{fit.report()}")
    save_rows(rows, arguments.out / "fits.csv")
    with (arguments.out / "prediction.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, predicted[0].keys())
        writer.writeheader()
        writer.writerows(predicted)
    draw(loops, rows, arguments.out)
    for row in rows:
        print(*row, sep="  ")
    for line in predicted:
        print(*line.values(), sep="  ")


if __name__ == "__main__":
    set_up()
    main()
