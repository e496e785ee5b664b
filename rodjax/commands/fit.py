"""`rodjax fit`: the report and the pictures of a fit."""

import argparse
import json
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import rodjax
from rodjax.atomic_write import replace_file
from rodjax.commands.errors import CommandError
from rodjax.commands.outputs import check_folder, save_figure
from rodjax.solving.result_warnings import NotConvergedWarning

if TYPE_CHECKING:
    from rodjax.identification.refits import Profile


def run_fit(arguments: argparse.Namespace) -> int:
    # With what it imports it takes a second, which the other commands need not wait for.
    from rodjax.identification.files import read_fit_files

    check_folder(arguments.out, "--out")
    files = read_fit_files(arguments.fit, arguments.data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NotConvergedWarning)
        try:
            fit = rodjax.fit(files.experiments, files.unknowns, **files.options)
        except ValueError as error:
            raise CommandError(f"{arguments.fit}: {error}") from None
    report = fit.report()
    print(report, flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    written = [arguments.out / "report.txt", arguments.out / "report.json"]
    replace_file(written[0], f"{report}\n".encode())
    replace_file(written[1], f"{json.dumps(fit.as_dict(), indent=1, allow_nan=False)}\n".encode())
    written += _draw_fit(fit, arguments.out, arguments.profiles)
    print(f"written: {', '.join(map(str, written))}")
    told = "; ".join(str(w.message) for w in caught if issubclass(w.category, NotConvergedWarning))
    if fit.converged and not told:
        return 0
    print(f"rodjax: {arguments.fit}: {' '.join(told.split())}", file=sys.stderr)
    return 3


def _draw_fit(fit: "rodjax.Fit", folder: Path, profiles: bool) -> list[Path]:
    """Draws what there is to draw; returns the names of the files."""
    from rodjax.identification import plots

    figures = {}
    if plots.has_centerlines(fit):
        figures |= {"shapes": plots.plot_shapes(fit), "residuals": plots.plot_residuals(fit)}
    if len(fit.labels) > 1:
        figures["correlation"] = plots.plot_correlation(fit)
    found = _profiles(fit) if profiles else []
    if found:
        figures["profiles"] = plots.plot_profiles(found)
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png", dpi=150)
    return [folder / f"{name}.png" for name in figures]


def _profiles(fit: "rodjax.Fit") -> "list[Profile]":
    found = []
    for label in fit.labels:
        try:
            found.append(fit.profile(label))
        except ValueError as error:  # three standard errors reach beyond the bounds
            print(f"rodjax: the profile of {label} is not drawn: {error}", file=sys.stderr)
    return found
