"""A fit in words and tables, verdict first, and as plain data."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from rodjax.identification.setup import name_of
from rodjax.model.summaries import counted
from rodjax.model.supports import Clamp
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT
from rodjax.solving.status import CONVERGED, Status

if TYPE_CHECKING:
    from rodjax.identification.result import Fit

# Clusters that scatter by so much more than single deviations say are told in words.
UNDERSTATED = 1.5
# Correlations beyond this are told in words.
CORRELATED = 0.95
# GJ/EI beyond these is told in words, with what other whole numbers of turns would make it, of so many experiments.
USUAL_RATIO = 0.1, 2.0
OTHER_TURNS = (-1, 1, -2, 2, -3, 3)
MOST_UNUSUAL = 3
# Stiffnesses that experiments imply are the same within so many standard errors.
TOLD_APART = 4.0
# Rows of the table of experiments; of more the worst.
MOST_ROWS = 30
LEVEL = 0.95


def text(fit: "Fit") -> str:
    parts = [_headline(fit), _shared_table(fit), _scatter(fit), *_remarks(fit), _experiments(fit)]
    return "\n".join(part for part in parts if part)


def _headline(fit: "Fit") -> str:
    count = len(fit.setup.experiments) + len(fit.setup.critical)
    outcome = f"converged in {fit.steps} steps" if fit.converged else f"NOT converged in {fit.steps} steps"
    unknowns = len(fit.setup.shared) + len(fit.setup.own)
    return (
        f"{counted(count, 'experiment')} in {counted(fit.clusters, 'cluster')}, {fit.numbers} numbers measured, "
        f"{counted(unknowns, 'unknown')}: {outcome}"
    )


def _shared_table(fit: "Fit") -> str:
    if not fit.labels:
        return ""
    width = max(len(_title(fit, label)) for label in fit.labels)
    rows = [
        f"{'':{width}}  {'estimate':>12}  {'formal error':>12}  {'95 % interval':>25}  "
        f"{'by clusters':>12}  {'95 % interval':>25}"
    ]
    for label in fit.labels:
        rows.append(
            f"{_title(fit, label):{width}}  {fit.estimate[label]:12.6g}  {fit.standard_error[label]:12.3g}  "
            f"{_interval(fit, label, False):>25}  {_number(fit.clustered_error[label]):>12}  "
            f"{_interval(fit, label, True):>25}"
        )
    return "\n".join(rows)


def _title(fit: "Fit", label: str) -> str:
    unit = fit.units[label]
    return f"{label} [{unit}]" if unit else label


def _interval(fit: "Fit", label: str, clustered: bool) -> str:
    low, high = fit.interval(label, LEVEL, clustered=clustered)
    return "-" if math.isnan(low) else f"{low:.5g} to {high:.5g}"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def _scatter(fit: "Fit") -> str:
    if fit.setup.has_sd:
        told = f"scatter {fit.sigma:.3g} times the given standard deviations"
    else:
        unit = fit.setup.experiments[0].measured[0].unit
        told = f"scatter {fit.sigma:.3g} {unit} in each number"
    mesh = "" if math.isnan(fit.error_estimate) else f"; meshes within {fit.error_estimate:.0e} of the length"
    return f"{told}, {fit.degrees_of_freedom} degrees of freedom{mesh}"


def _remarks(fit: "Fit") -> list[str]:
    told = [f"not determined: {combination.words}" for combination in fit.undetermined]
    told += [f"{label} is at its bound, where its standard error means nothing" for label in fit.at_bounds]
    if fit.setup.has_sd and fit.degrees_of_freedom > 0 and not 0.5 < fit.sigma < 2:
        told.append("the scatter is far from the given standard deviations: these are wrong, or the model is")
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = {label: np.divide(fit.clustered_error[label], fit.standard_error[label]) for label in fit.labels}
    understated = [f"{label} {ratio:.1f} times" for label, ratio in ratios.items() if ratio > UNDERSTATED]
    if understated:
        told.append(
            "formal errors understate the scatter between repeats, as deviations of one experiment go together: by "
            f"clusters the error is larger, of {', of '.join(understated)}; believe the intervals by clusters"
        )
    if fit.clusters < 2:
        told.append("one cluster only: how repeats scatter is not known, and the formal errors may be too small")
    correlation = fit.correlation if fit.labels else np.zeros((0, 0))
    for j in range(len(fit.labels)):
        for k in range(j):
            if abs(correlation[j, k]) > CORRELATED:
                told.append(
                    f"{fit.labels[k]} and {fit.labels[j]} are hardly told apart: correlation {correlation[j, k]:+.3f}"
                )
    told += fit.held
    told += _of_turns(fit) + _of_taken_turns(fit) + _of_frames(fit)
    lost = [name for name, status in zip(_names(fit), fit.statuses, strict=True) if status not in CONVERGED]
    if lost:
        told.append(f"not solved: {', '.join(lost[:10])}{', ...' if len(lost) > 10 else ''}")
    taut = [name for name, status in zip(_names(fit), fit.statuses, strict=True) if status == Status.OVERSTRETCHED]
    if taut:
        shown = f"{', '.join(taut[:10])}{', ...' if len(taut) > 10 else ''}"
        told.append(f"strained by more than {100 * DEFAULT_STRAIN_LIMIT:g} %: {shown}")
    return [f"- {remark}" for remark in told]


def _of_turns(fit: "Fit") -> list[str]:
    """What is odd about a torsional stiffness, which shapes tell by the torque alone: GJ times the twist."""
    names = {name for unknown in (*fit.setup.shared, *fit.setup.own) for name in unknown.names}
    results = [
        result
        for result in fit.found.evaluation.results
        if not isinstance(result, HarnessEquilibrium) and result.scene.rod.is_plain
    ]
    if not names & {"rod.EI", "rod.GJ"} or len(results) < len(fit.found.evaluation.results):
        return []
    ratios = np.concatenate([np.asarray(result.scene.rod.GJ / result.scene.rod.EI) for result in results])
    twists = np.concatenate([np.asarray(result.total_twist) for result in results])
    are_clamps = [
        isinstance(result.scene.start, Clamp) and isinstance(result.scene.end, Clamp)
        for result in results
        for _ in np.asarray(result.total_twist)
    ]
    is_unusual = ~_is_usual(ratios)
    unusual = [row for row in np.flatnonzero(is_unusual) if fit.statuses[fit.setup.order[row]] in CONVERGED]
    return [
        _of_ratio(name_of(fit.setup, fit.setup.order[row]), float(ratios[row]), float(twists[row]), are_clamps[row])
        for row in unusual[:MOST_UNUSUAL]
    ]


def _is_usual(ratios: Float[np.ndarray, "e"]) -> Bool[np.ndarray, "e"]:
    return (ratios >= USUAL_RATIO[0]) & (ratios <= USUAL_RATIO[1])


def _of_taken_turns(fit: "Fit") -> list[str]:
    """Which other torsional stiffness fits as well with another whole turn between clamps, where none was stated."""
    labels = [unknown.label for unknown in fit.setup.shared if unknown.names == ("rod.GJ",)]
    results = [result for result in fit.found.evaluation.results if not isinstance(result, HarnessEquilibrium)]
    scenes = [result.scene for result in results]
    if not labels or len(results) < len(fit.found.evaluation.results):
        return []
    if not all(
        scene.rod.is_plain and isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp) and scene.turns is None
        for scene in scenes
    ):
        return []
    ratios = np.concatenate([np.asarray(scene.rod.GJ) / np.asarray(scene.rod.EI) for scene in scenes])
    twists = np.concatenate([np.asarray(result.total_twist) for result in results])
    if not np.all(_is_usual(ratios)) or not np.all(twists):
        return []
    value, error = (numbers[labels[0]] for numbers in (fit.estimate, fit.standard_error))
    possible = []
    for turns, words in ((1, "more"), (-1, "less")):
        # Of each experiment the stiffness that has the same torque.
        implied = value * twists / (twists + 2 * math.pi * turns * np.sign(twists))
        if np.all(implied > 0) and np.ptp(implied) / np.mean(implied) <= TOLD_APART * error / value:
            possible.append(f"one turn {words} would make it {np.mean(implied):.3g}")
    if not possible:
        return []
    turn = np.max(np.abs(twists)) / (2 * math.pi) * error / value
    return [
        f"whole turns between the clamps were taken from the guess, as no scene states turns: shapes tell the torque, "
        f"which is known to {turn:.2g} of a turn at {labels[0]} = {value:.3g}; {', '.join(possible)} and fit as well"
    ]


def _of_ratio(name: str, ratio: float, twist: float, is_between_clamps: bool) -> str:
    told = (
        f"GJ/EI = {ratio:.3g} of {name} is unusual: round sections of one material have 0.67 to 1, cables seldom less "
        f"than {USUAL_RATIO[0]:g} or more than {USUAL_RATIO[1]:g}"
    )
    others = {turns: ratio * twist / (twist + 2 * math.pi * turns) for turns in OTHER_TURNS}
    usual = [
        f"{turns:+d} turn{'s' if abs(turns) > 1 else ''} would make it {other:.3g}"
        for turns, other in others.items()
        if USUAL_RATIO[0] <= other <= USUAL_RATIO[1]
    ]
    if not (is_between_clamps and usual):
        return told
    return (
        f"{told}; shapes tell the torque, GJ times the twist, which is {math.degrees(twist):.4g} deg here: at the same "
        f"torque {', '.join(usual)}; look at turns, end.frame and guess"
    )


def _of_frames(fit: "Fit") -> list[str]:
    labels = [
        unknown.label
        for unknown in (*fit.setup.shared, *fit.setup.own)
        if any(f".{part}." in name for name in unknown.names for part in ("frame", "tangent"))
    ]
    if not labels:
        return []
    turns = "is a turn" if len(labels) == 1 else "are turns"
    return [f"{', '.join(labels)} {turns} about a global axis from the nominal direction, which is 0"]


def _names(fit: "Fit") -> list[str]:
    return [name_of(fit.setup, k) for k in range(len(fit.setup.experiments))]


def _experiments(fit: "Fit") -> str:
    names, rms = _names(fit), fit.rms
    own = [unknown.label for unknown in fit.setup.own]
    order = list(range(len(names)))
    title = "experiments"
    if len(order) > MOST_ROWS:
        order = sorted(order, key=lambda k: -float(np.nanmax(rms[k])))[:MOST_ROWS]
        title = f"the {MOST_ROWS} experiments with the largest deviations"
    width = max(len(title), *(len(names[k]) for k in order))
    heads = [*(_title(fit, label) for label in own), "rms deviation of each measurement"]
    rows = [f"{title:{width}}" + "".join(f"  {head:>24}" for head in heads[:-1]) + f"  {heads[-1]}"]
    for k in order:
        values = "".join(f"  {_value(fit, label, k):>24}" for label in own)
        units = [measured.unit for measured in fit.setup.experiments[k].measured]
        deviations = ", ".join(f"{x:.3g} {unit}".strip() for x, unit in zip(rms[k], units, strict=True))
        rows.append(f"{names[k]:{width}}{values}  {deviations}")
    return "\n".join(rows)


def _value(fit: "Fit", label: str, k: int) -> str:
    value, error = fit.estimate[label][k], fit.standard_error[label][k]
    return "-" if math.isnan(value) else f"{value:.5g} +- {error:.2g}"


def plain(fit: "Fit") -> dict[str, Any]:
    def intervals(clustered: bool) -> dict[str, list[float | None]]:
        return {label: _plain(fit.interval(label, LEVEL, clustered=clustered)) for label in fit.labels}

    return {
        "converged": fit.converged,
        "steps": fit.steps,
        "unknowns": {label: {"unit": unit} for label, unit in fit.units.items()},
        "estimate": {label: _plain(value) for label, value in fit.estimate.items()},
        "standard_error": {label: _plain(value) for label, value in fit.standard_error.items()},
        "interval_95": intervals(False),
        "clustered_error": {label: _plain(value) for label, value in fit.clustered_error.items()},
        "clustered_interval_95": intervals(True),
        "covariance": _plain(fit.covariance),
        "clustered_covariance": _plain(fit.clustered_covariance),
        "correlation": _plain(fit.correlation) if fit.labels else [],
        "sigma": _plain(fit.sigma),
        "degrees_of_freedom": fit.degrees_of_freedom,
        "clusters": fit.clusters,
        "error_estimate": _plain(fit.error_estimate),
        "remarks": [remark.removeprefix("- ") for remark in _remarks(fit)],
        "experiments": [
            {
                "name": name,
                "cluster": experiment.cluster,
                "status": status.name.lower(),
                "rms": _plain(rms),
                "units": [measured.unit for measured in experiment.measured],
                "residuals": [_plain(rows) for rows in residuals],
            }
            for name, experiment, status, rms, residuals in zip(
                _names(fit), fit.setup.experiments, fit.statuses, fit.rms, fit.residuals, strict=True
            )
        ],
    }


def _plain(value: Any) -> Any:
    """Numbers as JSON knows them, which has none that is no number."""
    if isinstance(value, np.ndarray | Sequence):
        return [_plain(x) for x in value]
    number = float(value)
    return number if math.isfinite(number) else None
