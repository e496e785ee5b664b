"""Fits as files: what is sought in TOML, what was measured in CSV. `rodjax fit fit.toml data.csv` runs them.

A complete example of the first; quantities are as in scene files, a number and any unit of the right dimension:

    scene = "scene.toml"           # the nominal scene, in a folder as seen from this file; without [[path]]

    [[unknown]]                    # one or more of these
    name = "rod.EI"                # or names = ["rod.EI", "rod.GJ"], which keep their ratio
    scale = "log"                  # optional, as all below; or "linear"
    per = "all"                    # the same in all experiments, or "experiment": one in each
    start = "4e-3 N m^2"           # where the search begins; without it the number of the scene
    bounds = ["1e-4 N m^2", "1 N m^2"]             # "none" for none on a side
    prior = { value = "5e-3 N m^2", sd = 0.1 }     # sd: on a log scale relative, else a quantity as the value
    label = "bending stiffness"    # for the report

    [measured]                     # optional: standard deviations
    sd = "0.5 mm"                  # of each coordinate of a point
    force_sd = "2 mN"              # of each component
    moment_sd = "1e-4 N m"

    [fit]                          # optional
    loss = "huber"                 # or "cauchy", "welsch", "linear"; this where nothing is said
    threshold = 1.5                # of all but the last, in standard deviations
    rtol = 1e-4                    # error of the shapes by the length, for which the mesh is chosen; or segments = 20
    discretization = "hermite"     # or "finite_difference"
    planar = true                  # whether all lies in a plane

    [experiments]                  # optional: columns of the table under names of their own, and the keys they hold
    gap = "end.position.0"

The scene may be a harness (`rodjax.io.harness_file`): names and keys begin with "cables.NAME" or "joints.NAME" then,
"cables.trunk.rod.EI", "joints.y.mass", and the table has a column `cable`.

Names of unknowns are those of `rodjax.Unknown`: "rod.EI.0" of a pair, "end.position.2", "gravity.1",
"point_forces.0.at", a clamp's turn from the nominal frame "start.frame.1", a rig's scale "measured.0.scale"; there and
in `rodjax.fit` is what scales, priors and losses mean. Without standard deviations all measurements must be of one
kind; with any, those of all kinds that are measured must be given. What `[fit]` does not say of mesh and
discretization, `[solve]` of the scene does.

The table has a header and one row for each measured point. Columns are, with a unit in brackets or in SI units:

- `experiment`: name of the experiment that a row belongs to. `cluster`: that of the repeat, day or specimen, whose
  measurements go astray together; optional, without it each experiment is a cluster of its own.
- `cable`: of a harness the name of the rod on which the point, or the force of the row, was measured.
- `x [m]`, `y [m]`, `z [m]`: the point. One of the three may be missing: the rod is then seen along that axis, and
  nothing is known of where it is along it.
- `s [m]`: its arclength; without it, or with all cells of an experiment empty, what counts is its distance from the
  rod.
- `end_force_x [N]`, `end_moment_z [N m]`, `start_force_y [N]`, ...: what the support applies to the rod, one component
  or more.
- keys of the scene file, `end.position.0 [mm]`, `rod.length`, or their names in `[experiments]`: replace what the scene
  has, in that experiment. Cells as in the tables of `rodjax.sweeps`; where they are empty the scene's value stays.

All but points and arclengths have one value in an experiment, forces and moments one for each cable: in one of its
rows, or the same in several. Rows without a point have empty cells there. Beside the example above:

    experiment, cluster, gap [mm], s [mm], x [mm], z [mm], end_force_x [N], end_force_z [N]
    near 1,     Monday,  700,      0,      0.3,    -0.2,   -0.213,          0.441
    near 1,     Monday,  700,      500,    350.1,  -301.7, ,
    far 1,      Monday,  850,      250,    220.4,  -96.1,  ,
    ...
"""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from rodjax.checks import file_path, shown, whole_number
from rodjax.identification.loss import Loss
from rodjax.identification.measured_table import AXES, LABELS, MeasuredRod, MeasuredRows, MeasuredTable, read_table
from rodjax.identification.measured_table import UNITS as MEASURED
from rodjax.identification.measurements import Centerline, EndForce, EndMoment, Experiment, Measurement, orthographic
from rodjax.identification.unknowns import Per, Scale, Unknown, known_names, target
from rodjax.io.clocking import check_clocked
from rodjax.io.harness_file import HarnessFile
from rodjax.io.quantities import SceneFileError, check_keys, choice, flag, in_file, si_value, table_list
from rodjax.io.scene_file import SceneFile, read_text, toml_tables
from rodjax.io.scene_keys import SceneVariations
from rodjax.io.scene_keys import check_keys as check_scene_keys
from rodjax.solving.options import MAX_SEGMENTS, Discretization, checked_rtol

UNKNOWN_KEYS = ("name", "names", "scale", "per", "start", "bounds", "prior", "label")
SETTINGS = ("loss", "threshold", "rtol", "segments", "discretization", "planar")
# Standard deviations: their units, and what they are of.
DEVIATIONS = {"sd": ("m", "points"), "force_sd": ("N", "forces"), "moment_sd": ("N m", "moments")}


class FitFiles(NamedTuple):
    """The arguments of `rodjax.fit` that two files make; `options`: all but the first two, by name."""

    experiments: list[Experiment]
    unknowns: list[Unknown]
    options: dict[str, Any]


def read_fit_files(fit: str | os.PathLike[str], data: str | os.PathLike[str]) -> FitFiles:
    """What the TOML file `fit` and the table `data` say. See this module for their formats.

    Raises `SceneFileError` with one line that names the file and the key, column or row.
    """
    fit, data = file_path(fit, "fit"), file_path(data, "data")
    with in_file(fit):
        content = check_keys(
            toml_tables(read_text(fit)), "", (), ("scene", "unknown", "measured", "fit", "experiments")
        )
        scene = fit.parent / _scene_name(content)
        deviations = _deviations(content.get("measured", {}))
        names = _column_names(content.get("experiments", {}))
        settings = _settings(content.get("fit", {}))
        tables = _unknown_tables(content.get("unknown", []))
    with in_file(data):
        table = read_table(read_text(data), names)
    with in_file(fit):
        _check_deviations(deviations, table)
    experiments, file = _experiments(table, scene, data, deviations)
    with in_file(fit):
        _check_names(tables, experiments, file.unclocked if isinstance(file, SceneFile) else ())
        unknowns = [_unknown(one, where) for where, one in tables.items()]
    if "rtol" not in settings and "segments" not in settings:
        settings |= {"rtol": file.rtol, "segments": file.segments}
    return FitFiles(experiments, unknowns, {"discretization": file.discretization} | settings)


# --- what is sought --------------------------------------------------------------------------------------------------


def _scene_name(content: dict[str, Any]) -> str:
    if not isinstance(content.get("scene"), str) or "\0" in content["scene"]:
        got = shown(content["scene"]) if "scene" in content else "none"
        raise SceneFileError(f'scene must be the name of a scene file, for example scene = "scene.toml", got {got}')
    return content["scene"]


def _unknown_tables(tables: Any) -> dict[str, dict[str, Any]]:
    """By where they are in the file."""
    if not table_list(tables, "unknown"):
        raise SceneFileError('unknown is missing: one or more tables [[unknown]], each with a name such as "rod.EI"')
    return {f"unknown[{k}]": check_keys(table, f"unknown[{k}]", (), UNKNOWN_KEYS) for k, table in enumerate(tables)}


def _unknown(table: dict[str, Any], where: str) -> Unknown:
    names = _names(table, where)
    options: dict[str, Any] = {
        "scale": choice(table, where, "scale", list(get_args(Scale))),
        "per": choice(table, where, "per", list(get_args(Per))) or "all",
    }
    plain = Unknown(names, **options)  # which tells the unit and the scale
    if "start" in table:
        options["start"] = _number(table["start"], f"{where}.start", plain.unit)
    if "bounds" in table:
        options["bounds"] = _bounds(table["bounds"], f"{where}.bounds", plain.unit)
    if "prior" in table:
        options["prior"] = _prior(table["prior"], f"{where}.prior", plain)
    if not isinstance(table.get("label", ""), str):
        raise SceneFileError(f"{where}.label must be a text, got {shown(table['label'])}")
    try:
        return Unknown(names, **options, label=table.get("label"))
    except ValueError as error:
        raise SceneFileError(f"{where}.{error}") from None


def _names(table: dict[str, Any], where: str) -> list[str]:
    if ("name" in table) == ("names" in table):
        raise SceneFileError(f'{where}.name or {where}.names is needed, exactly one of them, such as name = "rod.EI"')
    key = "name" if "name" in table else "names"
    names = [table[key]] if key == "name" else table[key]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        allowed = 'a name such as "rod.EI"' if key == "name" else 'a list of names such as ["rod.EI", "rod.GJ"]'
        raise SceneFileError(f"{where}.{key} must be {allowed}, got {shown(table[key])}")
    return names


def _number(value: Any, key: str, unit: str) -> float:
    """A quantity in SI units; a plain number where there is no unit."""
    try:
        return float(si_value(value, key, unit, (), f'"1 {unit}"' if unit else "1"))
    except ValueError as error:
        raise SceneFileError(str(error)) from None


def _bounds(value: Any, key: str, unit: str) -> list[float | None]:
    if not isinstance(value, list) or len(value) != 2:
        raise SceneFileError(f"{key} must be a list of two quantities, the least and the largest, got {shown(value)}")
    return [None if one == "none" else _number(one, key, unit) for one in value]


def _prior(value: Any, key: str, unknown: Unknown) -> tuple[float, float]:
    if not isinstance(value, dict) or set(value) != {"value", "sd"}:
        raise SceneFileError(f"{key} must be a table of value and sd, got {shown(value)}")
    unit = "" if unknown.scale == "log" else unknown.unit
    return _number(value["value"], f"{key}.value", unknown.unit), _number(value["sd"], f"{key}.sd", unit)


def _check_names(
    tables: Mapping[str, dict[str, Any]], experiments: Sequence[Experiment], unclocked: Sequence[str]
) -> None:
    # Before anything else, as the name tells which units are right.
    sought: dict[str, str] = {}
    for where, table in tables.items():
        for name in _names(table, where):
            check_clocked(name, unclocked, where)
            if all(target(name, experiment) is None for experiment in experiments):
                allowed = ", ".join(known_names(experiments[0]))
                raise SceneFileError(f"{where}: there is no number {shown(name)}; allowed are {allowed}")
            if name in sought:
                raise SceneFileError(f"{where}: {shown(name)} is sought already, by {sought[name]}")
            sought[name] = where


# --- how -------------------------------------------------------------------------------------------------------------


def _settings(table: Any) -> dict[str, Any]:
    check_keys(table, "fit", (), SETTINGS)
    if "rtol" in table and "segments" in table:
        raise SceneFileError("fit.rtol is not allowed together with fit.segments: it chooses the segments")
    settings = {key: table[key] for key in SETTINGS if key in table}
    choice(table, "fit", "loss", list(get_args(Loss)))
    choice(table, "fit", "discretization", list(get_args(Discretization)))
    flag(table, "fit", "planar")
    if "threshold" in table:
        settings["threshold"] = _positive(table["threshold"], "fit.threshold", "")
        if table.get("loss", "linear") == "linear":
            raise SceneFileError('fit.threshold is not allowed for the loss "linear", which has none')
    try:
        if "rtol" in table:
            settings["rtol"] = checked_rtol(table["rtol"])
        if "segments" in table:
            whole_number(table["segments"], "segments", 2, MAX_SEGMENTS)
    except (TypeError, ValueError) as error:
        raise SceneFileError(f"fit.{error}") from None
    return settings


def _deviations(table: Any) -> dict[str, float]:
    """Standard deviations in SI units."""
    check_keys(table, "measured", (), tuple(DEVIATIONS))
    return {key: _positive(value, f"measured.{key}", DEVIATIONS[key][0]) for key, value in table.items()}


def _positive(value: Any, key: str, unit: str) -> float:
    number = _number(value, key, unit)
    if not number > 0:
        raise SceneFileError(f"{key} must be positive, got {shown(value)}")
    return number


def _check_deviations(deviations: Mapping[str, float], table: MeasuredTable) -> None:
    """What is compared with each other needs a scale, unless it is all of one kind."""
    is_measured = {
        "sd": any(len(rod.points) for rod in table.rods),
        "force_sd": any("force" in name for rod in table.rods for name in rod.loads),
        "moment_sd": any("moment" in name for rod in table.rods for name in rod.loads),
    }
    needed = [key for key, is_in in is_measured.items() if is_in]
    if len(needed) == 1 and needed[0] not in deviations:
        return
    for key in needed:
        if key not in deviations:
            unit, what = DEVIATIONS[key]
            kinds = " and ".join(DEVIATIONS[other][1] for other in needed)
            raise SceneFileError(
                f'measured.{key} is missing, the standard deviation of {what}, for example {key} = "0.01 {unit}": '
                f"the table has {kinds}, which only standard deviations make comparable"
            )


def _column_names(table: Any) -> dict[str, str]:
    """The keys of the scene by the names of the columns that hold them."""
    if not isinstance(table, dict) or not all(isinstance(key, str) for key in table.values()):
        raise SceneFileError(f'experiments must be a table such as gap = "end.position.0", got {shown(table)}')
    for name in table:
        if name in (*LABELS, *MEASURED):
            raise SceneFileError(f"experiments.{name} must have another name: columns {name} are of what was measured")
    if table:
        try:
            check_scene_keys(list(table.values()))
        except SceneFileError as mistake:
            raise SceneFileError(f"experiments: {mistake}") from None
    return table


# --- the experiments -------------------------------------------------------------------------------------------------


def _experiments(
    table: MeasuredTable, path: Path, data: Path, deviations: Mapping[str, float]
) -> tuple[list[Experiment], SceneFile | HarnessFile]:
    """The experiments, and the scene file of the first."""
    with in_file(path):
        content = toml_tables(read_text(path))
        if "path" in content:
            raise SceneFileError("path is not allowed in a fit, which is of single scenes; leave [[path]] out")
        variations = SceneVariations(content, table.keys)
    first = _scene(variations, table.experiments[0], path, data)
    with in_file(data):
        _check_cables(table, first, path)
    variations.in_si()
    experiments = []
    for one in table.experiments:
        scene = _scene(variations, one, path, data).scenes[0]
        try:
            measured = [
                each for cable, rod in one.rods.items() for each in _measured(rod, cable, table.axes, deviations)
            ]
            experiments.append(Experiment(scene, measured, cluster=one.cluster, name=one.name))
        except ValueError as error:
            said = re.sub(r"^measured\[\d+\]\.", "", str(error))
            raise SceneFileError(f"{data}: experiment {shown(one.name)}: {said}") from None
    return experiments, first


def _check_cables(table: MeasuredTable, file: SceneFile | HarnessFile, path: Path) -> None:
    """Rows are of cables where the scene file has these."""
    names = {cable for one in table.experiments for cable in one.rods}
    if isinstance(file, SceneFile):
        if names != {None}:
            raise SceneFileError(f"column cable is not allowed: {path} has one rod, and no cables")
        return
    cables = tuple(file.harness)
    allowed = ", ".join(cables)
    if None in names:
        raise SceneFileError(f"column cable is missing, the cable that a row is of: {path} has the cables {allowed}")
    for one in table.experiments:
        for cable in one.rods:
            if cable not in cables:
                of = f"experiment {shown(one.name)}"
                raise SceneFileError(f"{of}: cable must be one of {allowed} of {path}, got {shown(cable)}")


def _scene(variations: SceneVariations, one: MeasuredRows, path: Path, data: Path) -> SceneFile | HarnessFile:
    try:
        return variations.read(one.values)
    except SceneFileError as mistake:
        if not one.values:
            raise SceneFileError(f"{path}: {mistake}") from None
        name = shown(one.name)
        raise SceneFileError(f"{data}: experiment {name}: {mistake} (in {path} with these values)") from None


def _measured(rod: MeasuredRod, cable: str | None, axes: str, deviations: Mapping[str, float]) -> list[Measurement]:
    found: list[Measurement] = []
    if len(rod.points):
        camera = None if len(axes) == 3 else orthographic(*(_along(axis) for axis in axes))
        found.append(Centerline(rod.points, rod.s, deviations.get("sd"), camera=camera, cable=cable))
    kinds: dict[str, Callable[..., Measurement]] = {"force": EndForce, "moment": EndMoment}
    for end in ("start", "end"):
        for kind, measurement in kinds.items():
            sd = deviations.get(f"{kind}_sd")
            known = {axis: value for axis in AXES if (value := rod.loads.get(f"{end}_{kind}_{axis}")) is not None}
            if len(known) == 3:
                found.append(measurement(list(known.values()), sd, end=end, cable=cable))
            else:
                found += [
                    measurement(value, sd, end=end, direction=_along(axis), cable=cable)
                    for axis, value in known.items()
                ]
    return found


def _along(axis: str) -> Float[np.ndarray, "3"]:
    return np.eye(3)[AXES.index(axis)]
