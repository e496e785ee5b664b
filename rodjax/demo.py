"""`rodjax demo`: Fig. 1 of Linn & Stephan (2008), solved, drawn and written."""

import csv
import statistics
import sys
import time
import warnings
from pathlib import Path

import jax
import numpy as np

from rodjax import problems
from rodjax.io.files import save
from rodjax.paths.path import solve_path
from rodjax.plot import figure_of, plot_figure_1
from rodjax.solving.description import describe
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_warnings import NotConvergedWarning

REPORT_MILLISECONDS = 6.0  # a step, with 10 segments, on a 2.2 GHz AMD of 2008
REPEATS = 9
# The scenes that are the pictures (a) to (f).
STAGES = (0, 9, 13, 17, 21, 25)


def run(out: Path, segments: int) -> int:
    """Writes `figure_1.png`, `.vtkhdf` and `.csv` to `out` and prints a table; 0 if all converged, else 3."""
    out.mkdir(parents=True, exist_ok=True)
    scenes = [problems.omega(problems.ARC_HALF_ANGLE, 0.0), *problems.figure_1()]

    def solve(progress: bool) -> tuple[Equilibrium, float]:
        begin = time.perf_counter()
        path = solve_path(
            scenes,
            segments=segments,
            discretization="finite_difference",
            guess=problems.figure_1_start(),
            progress=progress,
        )
        return jax.block_until_ready(path), time.perf_counter() - begin

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConvergedWarning)  # said below
        if sys.stderr.isatty():
            solve(progress=True)
        path, first = solve(progress=False)
        again = statistics.median(solve(progress=False)[1] for _ in range(REPEATS))
    files = [out / f"figure_1{suffix}" for suffix in (".png", ".vtkhdf", ".csv")]
    panels = plot_figure_1([jax.tree.map(lambda leaf, k=k: leaf[k], path) for k in STAGES])
    figure_of(panels[0]).savefig(files[0], dpi=150)
    save(path, files[1])
    _write_csv(path, files[2])

    print(f"Fig. 1 of Linn & Stephan (2008): {len(scenes)} scenes of a cable in {segments} segments")
    print(_table(path))
    print(
        f"{1e3 * again / len(scenes):.2f} ms a step; the paper, with 10 segments in 2008: {REPORT_MILLISECONDS:g} ms. "
        f"First run, with compiling: {first:.1f} s"
    )
    print(f"written: {', '.join(map(str, files))}")
    if np.all(np.asarray(path.converged)):
        return 0
    print(f"rodjax: {describe(path)}", file=sys.stderr)
    return 3


def _table(path: Equilibrium) -> str:
    rows = ["stage  energy [mJ]  twist [deg]  |force| [N]  |moment| [N m]  iterations"]
    for letter, k in zip("abcdef", STAGES, strict=True):
        force, moment = (float(np.linalg.norm(vector[k])) for vector in (path.end_force, path.end_moment))
        rows.append(
            f" ({letter})   {1e3 * float(path.energy[k]):11.4f}  {np.degrees(float(path.total_twist[k])):11.2f}"
            f"  {force:11.5f}  {moment:14.6f}  {int(path.iterations[k]):10d}"
        )
    return "\n".join(rows)


def _write_csv(path: Equilibrium, file: Path) -> None:
    header = ["scene", "energy_J", "total_twist_rad"]
    header += [f"end_{kind}_{axis}_{unit}" for kind, unit in (("force", "N"), ("moment", "Nm")) for axis in "xyz"]
    columns = [path.energy, path.total_twist, *np.asarray(path.end_force).T, *np.asarray(path.end_moment).T]
    with open(file, "w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow([*header, "iterations", "converged"])
        for k in range(len(path.energy)):
            numbers = [repr(float(column[k])) for column in columns]
            writer.writerow([k, *numbers, int(path.iterations[k]), bool(path.converged[k])])
