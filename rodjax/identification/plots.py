"""Pictures of fits, as matplotlib figures without pyplot: save them with `figure.savefig("shapes.png")`."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy import stats

from rodjax.checks import instance, line, sequence
from rodjax.identification.measurements import Centerline
from rodjax.identification.refits import Profile
from rodjax.identification.result import Fit
from rodjax.identification.setup import name_of
from rodjax.identification.unknowns import with_values
from rodjax.solving.status import CONVERGED

# Panels of shapes, and lines in a panel of residuals; of more centerlines those with the largest deviations.
MOST_PANELS, MOST_LINES = 12, 60
COLUMNS = 4
# Points of a fitted shape, among which the one nearest to a measured point is sought where its arclength is not known.
POINTS = 401
# Centerlines with a line in the legend.
MOST_NAMED = 10
# Of the legend that fit beside each other, where each name has the place of 8 for its line.
CHARACTERS = 100
COLOR_MAP = "viridis"
# Height of a panel by its width, where a straight rod would be seen in a slit, or a hanging one fill the page.
LEAST_HEIGHT, LARGEST_HEIGHT = 0.35, 1.2


class _Seen(NamedTuple):
    """A centerline as its rig sees it: `points` measured, `curve` computed, `axes` the names of the d coordinates.

    `s`: arclengths of the points [m]; `band`: two standard deviations of a coordinate, or not a number.
    """

    name: str
    points: Float[np.ndarray, "m d"]
    s: Float[np.ndarray, "m"]
    residuals: Float[np.ndarray, "m d"]
    curve: Float[np.ndarray, "k d"]
    band: float
    axes: tuple[str, ...]
    unit: str


def plot_shapes(fit: Fit) -> Figure:
    """Measured points on the fitted shapes, a panel for each centerline, of many those with the largest deviations.

    Points in space are projected on the two axes along which the shape is largest, those of a camera are shown as in
    its image. Raises `ValueError` where there is no centerline.
    """
    seen, note = _worst(fit, MOST_PANELS)
    columns = min(COLUMNS, math.ceil(math.sqrt(len(seen))))
    rows = math.ceil(len(seen) / columns)
    planes = [_plane(one) for one in seen]
    height = max(_height(one, plane) for one, plane in zip(seen, planes, strict=True))
    figure = Figure(figsize=(3.4 * columns + 0.4, (3.0 * height + 0.8) * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, one, (i, j) in zip(panels, seen, planes, strict=False):
        axes.plot(one.curve[:, i], one.curve[:, j], color="C0", label="fitted")
        axes.plot(one.points[:, i], one.points[:, j], "o", ms=4, mfc="none", color="C3", label="measured")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(one.name, fontsize=10)
        axes.set(xlabel=f"{one.axes[i]} [{one.unit}]", ylabel=f"{one.axes[j]} [{one.unit}]")
        axes.locator_params(nbins=5)
        axes.grid(color="0.9")
        if one.axes == ("u", "v"):  # as in an image
            axes.invert_yaxis()
    for axes in panels[len(seen) :]:
        axes.set_visible(False)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    if note:
        figure.suptitle(note, fontsize=11)
    return figure


def plot_residuals(fit: Fit) -> Figure:
    """Measured minus computed coordinates along the rod, a panel for each coordinate.

    The band is two standard deviations, as large as the fit has found them. A point of unknown arclength stands at that
    of the place nearest to it. Raises `ValueError` where there is no centerline.
    """
    seen, note = _worst(fit, MOST_LINES)
    names = sorted({(axis, one.unit) for one in seen for axis in one.axes})
    figure = Figure(figsize=(7, 1.6 + 1.9 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    colors = ScalarMappable(Normalize(0, len(seen)), COLOR_MAP).to_rgba(np.arange(len(seen)))
    if len(seen) <= MOST_NAMED:
        colors = [f"C{k}" for k in range(len(seen))]
    for axes, name in zip(panels, names, strict=True):
        here = [k for k, one in enumerate(seen) if name in [(axis, one.unit) for axis in one.axes]]
        for k in here:
            order = np.argsort(seen[k].s)
            values = seen[k].residuals[order, seen[k].axes.index(name[0])]
            axes.plot(seen[k].s[order], values, ".-", lw=0.8, color=colors[k], label=seen[k].name)
        band = max(seen[k].band for k in here)
        if math.isfinite(band):
            axes.axhspan(-band, band, color="0.92", zorder=0)
        axes.axhline(0.0, color="0.6", lw=0.8, zorder=1)
        axes.set_ylabel(f"{name[0]} [{name[1]}]")
        axes.ticklabel_format(axis="y", scilimits=(-2, 3))
        axes.margins(x=0.02)
    panels[-1].set_xlabel("arclength s [m]")
    figure.align_ylabels()
    said = ["measured - computed; grey: two standard deviations", *([note] if note else [])]
    figure.suptitle("\n".join(said), fontsize=11)
    if len(seen) <= MOST_NAMED:
        handles = {label: x for axes in panels for x, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        columns = max(1, min(len(handles), CHARACTERS // (8 + max(map(len, handles)))))
        figure.legend(
            list(handles.values()),
            [line(name) for name in handles],
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=9,
        )
    return figure


def plot_correlation(fit: Fit) -> Figure:
    """The correlations of the unknowns in common. Raises `ValueError` where there is none."""
    instance(fit, "fit", Fit)
    labels = fit.labels
    if not labels:
        raise ValueError("fit must have unknowns in common to be correlated, got only those of experiments")
    size, longest = 0.8 + 0.7 * len(labels), max(map(len, labels))
    figure = Figure(figsize=(size + 1.4 + 0.09 * longest, size + 0.4 + 0.07 * longest), layout="compressed")
    axes = figure.add_subplot()
    image = axes.imshow(fit.correlation, vmin=-1, vmax=1, cmap="RdBu_r")
    axes.set_xticks(range(len(labels)), labels, rotation=40, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(labels)), labels)
    for (j, k), value in np.ndenumerate(fit.correlation):
        color = "white" if abs(value) > 0.6 else "black"
        axes.text(k, j, f"{value:.2f}", ha="center", va="center", color=color, fontsize=9)
    figure.colorbar(image, label="correlation", shrink=0.8)
    return figure


def plot_profiles(profiles: Sequence[Profile]) -> Figure:
    """The deviance of each profile, a panel each, with the limits of 68 % and 95 % confidence.

    A parabola is what standard errors take for granted; where a curve is flat the data do not determine the unknown.
    Raises `ValueError` where there is no profile.
    """
    profiles = sequence(profiles, "profiles", "Profile")
    for k, profile in enumerate(profiles):
        instance(profile, f"profiles[{k}]", Profile)
    if not profiles:
        raise ValueError("profiles must hold at least one Profile, got none")
    columns = min(3, len(profiles))
    rows = math.ceil(len(profiles) / columns)
    figure = Figure(figsize=(3.6 * columns + 0.4, 3.1 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes, profile in zip(panels.ravel(), profiles, strict=False):
        _draw_profile(axes, profile)
    for axes in panels.ravel()[len(profiles) :]:
        axes.set_visible(False)
    for axes in panels[:, 0]:
        axes.set_ylabel("deviance")
    figure.suptitle("how much worse the fit is with each unknown held; red: 95 % interval", fontsize=11)
    return figure


def _draw_profile(axes: Axes, profile: Profile) -> None:
    axes.plot(profile.values, profile.deviance, ".-")
    for level in (0.68, 0.95):
        limit = float(stats.chi2.ppf(level, 1))
        axes.axhline(limit, color="0.6", lw=0.8, ls="--")
        place = axes.get_yaxis_transform()
        axes.text(0.99, limit, f"{level:.0%}", transform=place, fontsize=8, color="0.4", ha="right", va="bottom")
    for end in profile.interval():
        if math.isfinite(end):
            axes.axvline(end, color="C3", lw=0.8)
    axes.set_ylim(bottom=-0.03 * axes.get_ylim()[1])
    axes.set_xlabel(f"{profile.label} [{profile.unit}]" if profile.unit else profile.label)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.ticklabel_format(axis="x", scilimits=(-2, 3), useOffset=False)


# --- what is drawn ---------------------------------------------------------------------------------------------------

# A measured centerline: the numbers of the experiment and of the measurement in it.
Place = tuple[int, int]


def has_centerlines(fit: Fit) -> bool:
    """Whether there is a measured centerline, and a solved shape to draw beside it."""
    instance(fit, "fit", Fit)
    return bool(_drawn(fit))


def _worst(fit: Fit, most: int) -> tuple[list[_Seen], str]:
    """So many centerlines, those with the largest deviations, and a note where there are more."""
    instance(fit, "fit", Fit)
    drawn = _drawn(fit)
    if not drawn:
        raise ValueError("fit must have an experiment with a Centerline that was solved, got none")
    worst = sorted(sorted(drawn, key=lambda place: -_rms(fit, place))[:most])
    note = f"the {most} of {len(drawn)} centerlines with the largest deviations" if len(drawn) > most else ""
    return [_seen(fit, place) for place in worst], note


def _drawn(fit: Fit) -> list[Place]:
    return [
        (k, j)
        for k, (experiment, status) in enumerate(zip(fit.setup.experiments, fit.statuses, strict=True))
        for j, measured in enumerate(experiment.measured)
        if isinstance(measured, Centerline) and status in CONVERGED
    ]


def _rms(fit: Fit, place: Place) -> float:
    k, j = place
    return float(np.nan_to_num(fit.rms[k][j], nan=np.inf))


def _seen(fit: Fit, place: Place) -> _Seen:
    k, j = place
    sought = (*fit.setup.shared, *fit.setup.own)
    found = [fit.estimate[unknown.label] for unknown in sought]
    found = [jnp.asarray(value if np.ndim(value) == 0 else value[k]) for value in found]
    experiment = with_values(
        fit.setup.experiments[k], [unknown.names for unknown in sought], [unknown.scale for unknown in sought], found
    )
    measured = experiment.measured[j]
    assert isinstance(measured, Centerline)
    equilibrium = measured.of_rod(fit.equilibrium(k))
    along = jnp.linspace(equilibrium.s[0], equilibrium.s[-1], POINTS)
    curve = np.asarray(measured.seen(equilibrium.position_at(along)))
    points = np.asarray(measured.points)
    if measured.s is not None:
        s = np.asarray(measured.s + measured.shift)
    else:
        nearest = [np.argmin(np.sum((curve - point) ** 2, axis=1)) for point in points]
        s = np.asarray(along)[np.array(nearest)]
    band = 2 * fit.sigma / float(np.min(np.asarray(measured.weights)))
    return _Seen(
        name_of(fit.setup, k), points, s, fit.residuals[k][j], curve, band, _axis_names(measured), measured.unit
    )


def _axis_names(measured: Centerline) -> tuple[str, ...]:
    """Those of the scene where a camera looks along one of its axes."""
    if measured.camera is None:
        return ("x", "y", "z")
    is_axis = np.all(np.asarray(measured.camera)[:2, None, :3] == np.eye(3)[None], axis=2)
    if measured.is_affine and np.all(np.any(is_axis, axis=1)):
        return tuple("xyz"[int(np.argmax(row))] for row in is_axis)
    return ("u", "v")


def _plane(one: _Seen) -> tuple[int, int]:
    """The two coordinates along which it is largest."""
    first, second = sorted(np.argsort(-_extent(one))[:2].tolist())
    return first, second


def _extent(one: _Seen) -> Float[np.ndarray, "d"]:
    return np.ptp(np.concatenate([one.curve, one.points]), axis=0)


def _height(one: _Seen, plane: tuple[int, int]) -> float:
    width, height = _extent(one)[list(plane)]
    return float(np.clip(height / max(width, 1e-9 * height), LEAST_HEIGHT, LARGEST_HEIGHT))
