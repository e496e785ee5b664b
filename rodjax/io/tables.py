"""A rod at rest as a table along its centerline, for spreadsheets and other programs."""

import csv
import io
import os
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Shaped

from rodjax.analysis.samples import Samples, samples_at, smooth_samples
from rodjax.atomic_write import replace_file
from rodjax.checks import file_path, instance, is_known, number_list, shown
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium

SUFFIX = ".csv"
AXES = ("x", "y", "z")


def centerline_table(
    equilibrium: Equilibrium | HarnessEquilibrium, s: Any = None
) -> dict[str, Shaped[np.ndarray, "k"]]:
    """The centerline of one equilibrium and what there is along it, by columns whose names end with their SI units.

    **Arguments:**

    - `equilibrium`: a single one; of a path, take one with `jax.tree.map(lambda leaf: leaf[k], path)`. Of a harness all
      cables, by a leading column `cable`.
    - `s`: arclengths (k,) [m] from 0 to L; or how many equally spaced ones, at least 2; `None`: the nodes, and as many
      between them as a smooth curve needs: its chords depart from it by 5e-5 of the length at most.

    The columns are `s [m]`, the position `x [m]`, `y [m]`, `z [m]`, the frame `d1_x [1]` to `t_z [1]`,
    `curvature [1/m]`, `bend_radius [m]` of the centerline (infinite where it is straight), `twist [rad/m]`,
    `tension [N]`, the section force `force_x [N]`, ... and the section moment `moment_x [N m]`, ..., both what the part
    beyond s exerts on the part before it, in global axes. Forces and moments are left out for finite differences and
    the continuum, which do not keep them. At a clip the values are those just beyond it.

    `pandas.DataFrame(rj.centerline_table(result))` makes a data frame of it; `rj.write_table` and `rodjax solve --csv`
    write it to a file. Raises `ValueError` or `TypeError` for other arguments.
    """
    instance(equilibrium, "equilibrium", (Equilibrium, HarnessEquilibrium))
    if isinstance(equilibrium, HarnessEquilibrium):
        return _by_cable({name: centerline_table(rod, s) for name, rod in equilibrium.items()})
    if not is_known(equilibrium):
        raise ValueError("equilibrium must hold numbers, got a traced one: call this outside jax.jit, vmap and grad")
    if equilibrium.s.ndim != 1:
        raise ValueError(
            f"equilibrium must be a single one, got a stack of shape {equilibrium.s.shape[:-1]}; "
            "jax.tree.map(lambda leaf: leaf[-1], path) takes the last one"
        )
    return _columns(smooth_samples(equilibrium) if s is None else samples_at(equilibrium, _arclengths(equilibrium, s)))


def _arclengths(equilibrium: Equilibrium, s: Any) -> Float[np.ndarray, "k"]:
    nodes = np.asarray(equilibrium.s)
    length = float(nodes[-1])
    if isinstance(s, int) and not isinstance(s, bool):
        if s < 2:
            raise ValueError(f"s must be at least 2 equally spaced arclengths, got {shown(s)}")
        return np.linspace(0.0, length, s, dtype=nodes.dtype)
    numbers = np.asarray(number_list(s, "s"), nodes.dtype)
    if np.any(numbers < 0) or np.any(numbers > length):
        raise ValueError(f"s must lie in 0 to {length:g} m, got {np.min(numbers):g} to {np.max(numbers):g} m")
    return numbers


def _columns(samples: Samples) -> dict[str, Float[np.ndarray, "k"]]:
    with np.errstate(divide="ignore"):
        bend_radius = 1 / samples.curvature
    columns = {"s [m]": samples.s} | _by_axis("", "m", samples.positions)
    for k, name in enumerate(("d1", "d2", "t")):
        columns |= _by_axis(f"{name}_", "1", samples.frames[..., k])
    columns |= {
        "curvature [1/m]": samples.curvature,
        "bend_radius [m]": bend_radius,
        "twist [rad/m]": samples.twist,
        "tension [N]": samples.tension,
    }
    if samples.force is not None and samples.moment is not None:
        columns |= _by_axis("force_", "N", samples.force) | _by_axis("moment_", "N m", samples.moment)
    return columns


def _by_axis(name: str, unit: str, values: Float[np.ndarray, "k 3"]) -> dict[str, Float[np.ndarray, "k"]]:
    return {f"{name}{axis} [{unit}]": values[..., k] for k, axis in enumerate(AXES)}


def write_table(equilibrium: Equilibrium | HarnessEquilibrium, path: str | os.PathLike[str], s: Any = None) -> None:
    """Writes `centerline_table` as comma-separated values, all digits of them; of a path, with a leading column `step`,
    of a harness of one `cable`, by their names.

    The file is replaced as a whole. Raises as `centerline_table`, and `OSError` where the file cannot be written.
    """
    instance(equilibrium, "equilibrium", (Equilibrium, HarnessEquilibrium))
    path = file_path(path, "path", SUFFIX)
    if isinstance(equilibrium, HarnessEquilibrium):
        columns = _by_cable({name: _table(rod, s) for name, rod in equilibrium.items()})
    else:
        columns = _table(equilibrium, s)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    replace_file(path, text.getvalue().encode())


def _by_cable(tables: dict[str, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One table, of the columns that all have."""
    shared = [name for name in next(iter(tables.values())) if all(name in table for table in tables.values())]
    cables = np.concatenate([np.full(len(table["s [m]"]), name) for name, table in tables.items()])
    return {"cable": cables} | {name: np.concatenate([table[name] for table in tables.values()]) for name in shared}


def _table(equilibrium: Equilibrium, s: Any) -> dict[str, np.ndarray]:
    """`centerline_table`, of a path with the number of the step before it."""
    if equilibrium.s.ndim == 2 and is_known(equilibrium):
        equilibrium = jax.tree.map(np.asarray, equilibrium)
        steps = [jax.tree.map(lambda leaf, k=k: leaf[k], equilibrium) for k in range(len(equilibrium.s))]
        tables = [centerline_table(step, s) for step in steps]
        numbers = np.concatenate([np.full(len(table["s [m]"]), k) for k, table in enumerate(tables)])
        return {"step": numbers} | {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}
    return centerline_table(equilibrium, s)
