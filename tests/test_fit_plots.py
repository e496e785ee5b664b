"""Pictures of fits: what is drawn is what was measured and computed."""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

import rodjax as rj
from rodjax.identification.plots import (
    MOST_PANELS,
    has_centerlines,
    plot_correlation,
    plot_profiles,
    plot_residuals,
    plot_shapes,
)
from rodjax.identification.refits import Profile
from rodjax.identification.result import Fit
from rodjax.identification.setup import Setup

S = np.linspace(0.05, 0.95, 10)
GAPS = (0.6, 0.7, 0.8)
OFFSET = np.array((0.02, 0.0, -0.01))
NOISE = 1e-3
LOOK = rj.orthographic((1, 0, 0), (0, 0, 1))


@pytest.fixture(scope="module")
def hanging(cable):
    """Three equilibria of a hanging cable, stacked, in the plane of x and z."""

    def scene(gap):
        start, end = (rj.Clamp((x, 0, 0), rj.frame((1, 0, 0))) for x in (0, gap))
        return rj.Scene(cable, start, end, (0, 0, -9.81))

    return rj.solve_batch([scene(gap) for gap in GAPS], segments=8)


def rows_of(tree, rows):
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def measured_in(kind, positions, noise):
    """The measurement of a kind that was made of these positions (m, 3), and its deviations."""
    noisy = positions + noise
    if kind == "in space, moved":
        return rj.Centerline(noisy + OFFSET, S, NOISE), noise
    if kind == "without arclengths":
        return rj.Centerline(noisy, sd=NOISE), noise
    if kind == "seen along y":
        return rj.Centerline(noisy[:, [0, 2]], S, NOISE, camera=LOOK), noise[:, [0, 2]]
    camera = rj.pinhole((0.4, -3, -0.2), (0, 1, 0), (0, 0, -1), 1000.0)
    pixels = rj.Centerline(np.zeros((len(S), 2)), S, 1.0, camera=camera).seen(jnp.asarray(positions))
    return rj.Centerline(np.asarray(pixels) + 1e3 * noise[:, :2], S, 1.0, camera=camera), 1e3 * noise[:, :2]


class MadeFit(Fit):
    """A fit that was not searched: its equilibria, stacked, are in the place of what was found."""

    def equilibrium(self, k):
        return rows_of(self.found, k)


def made_fit(hanging, kinds, repeats=1):
    """A fit as if it had been found: the computed shapes are those of `hanging`."""
    random = np.random.default_rng(1)
    experiments, residuals = [], []
    count = len(kinds) * repeats
    for k in range(count):
        positions = np.asarray(hanging.position_at(S))[k % len(GAPS)]
        noise = NOISE * (1 + k) / count * random.standard_normal((len(S), 3))
        measured, deviations = measured_in(kinds[k % len(kinds)], positions, noise)
        scene = rows_of(hanging.scene, k % len(GAPS))
        experiments.append(rj.Experiment(scene, measured, name=f"{kinds[k % len(kinds)]} {k}"))
        residuals.append([deviations])
    shared = tuple(map(rj.Unknown, ("rod.EI", "rod.mass_per_length", "measured.0.offset.0", "measured.0.offset.2")))
    estimate = {"rod.EI": 5e-3, "rod.mass_per_length": 0.1, "measured.0.offset.0": 0.02, "measured.0.offset.2": -0.01}
    if kinds[0] != "in space, moved":
        shared = shared[:2]
    p = len(shared)
    given = {
        "setup": Setup(tuple(experiments), (), shared, (), tuple(range(count)), True),
        "found": rows_of(hanging, np.arange(count) % len(GAPS)),
        "statuses": [rj.Status.CONVERGED] * count,
        "estimate": {unknown.label: estimate[unknown.label] for unknown in shared},
        "covariance": 0.7 * np.eye(p) + 0.3,
        "sigma": 1.0,
        "residuals": residuals,
    }
    return MadeFit(**(dict.fromkeys(field.name for field in dataclasses.fields(rj.Fit)) | given))


def drawn(figure: Figure) -> np.ndarray:
    """The picture, which must not be empty."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=60)
    file.seek(0)
    pixels = imread(file)[..., :3]
    assert pixels.std() > 0.01
    return pixels


def panels(figure: Figure):
    return [axes for axes in figure.axes if axes.get_visible()]


def lines(axes):
    """The lines of a panel by their labels."""
    return {str(line.get_label()): np.transpose(line.get_data()) for line in axes.lines}


ALL_KINDS = ("in space, moved", "without arclengths", "seen along y", "by a camera")


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_shapes_are_drawn_through_the_points_as_the_rig_sees_them(hanging, kind):
    fit = made_fit(hanging, (kind,), 3)
    figure = plot_shapes(fit)
    assert [axes.get_title() for axes in panels(figure)] == [f"{kind} {k}" for k in range(3)]
    for k, axes in enumerate(panels(figure)):
        points, curve = lines(axes)["measured"], lines(axes)["fitted"]
        measured = np.asarray(fit.setup.experiments[k].measured[0].points)
        # The plane of the cable is that of x and z.
        np.testing.assert_array_equal(points, measured if measured.shape[1] == 2 else measured[:, [0, 2]])
        distances = np.min(np.linalg.norm(points[:, None] - curve[None], axis=-1), axis=1)
        scale = 1e3 if kind == "by a camera" else 1.0
        assert np.max(distances) < 4 * NOISE * scale
        unit = "px" if kind == "by a camera" else "m"
        names = ("u", "v") if kind == "by a camera" else ("x", "z")
        assert (axes.get_xlabel(), axes.get_ylabel()) == tuple(f"{name} [{unit}]" for name in names)
        assert axes.yaxis_inverted() == (kind == "by a camera")
    drawn(figure)


def test_of_many_experiments_those_with_the_largest_deviations_are_drawn(hanging):
    fit = made_fit(hanging, ("seen along y",), 14)
    figure = plot_shapes(fit)
    shown = [int(axes.get_title().split()[-1]) for axes in panels(figure)]
    worst = np.argsort([-rms[0] for rms in fit.rms])[:MOST_PANELS]
    assert shown == sorted(worst)
    assert f"the {MOST_PANELS} of 14 centerlines" in figure.get_suptitle()
    assert len(lines(panels(plot_residuals(fit))[0])) == 14 + 1
    drawn(figure)


def test_residuals_stand_at_their_arclengths(hanging):
    fit = made_fit(hanging, ("seen along y", "without arclengths"))
    figure = plot_residuals(fit)
    assert [axes.get_ylabel() for axes in panels(figure)] == ["x [m]", "y [m]", "z [m]"]
    x, y, z = map(lines, panels(figure))
    assert "seen along y 0" not in y
    np.testing.assert_allclose(x["seen along y 0"], np.stack([S, fit.residuals[0][0][:, 0]], axis=1))
    np.testing.assert_allclose(z["without arclengths 1"][:, 1], fit.residuals[1][0][:, 2])
    # The place nearest to a point is not far from where it was measured.
    np.testing.assert_allclose(z["without arclengths 1"][:, 0], S, atol=0.01)
    drawn(figure)


def test_correlations_are_told_beside_their_color(hanging):
    fit = made_fit(hanging, ("in space, moved",))
    figure = plot_correlation(fit)
    assert [text.get_text() for text in panels(figure)[0].texts][:2] == ["1.00", "0.30"]
    assert [tick.get_text() for tick in panels(figure)[0].get_yticklabels()] == fit.labels
    drawn(figure)


def test_profiles_show_their_interval():
    values = np.linspace(4e-3, 6e-3, 13)
    deviance = ((values - 5e-3) / 3.3e-4) ** 2
    steep = Profile("rod.EI", "N m^2", values, deviance, np.zeros((13, 2)))
    flat = Profile("measured.0.scale", "", values, 0.1 * deviance, np.zeros((13, 2)))
    figure = plot_profiles([steep, flat])
    left, right = panels(figure)
    assert [axes.get_xlabel() for axes in (left, right)] == ["rod.EI [N m^2]", "measured.0.scale"]
    # The curve and two levels, and where the interval ends within the values its two ends.
    assert [len(axes.lines) for axes in (left, right)] == [5, 3]
    np.testing.assert_allclose(left.lines[3].get_xdata()[0], steep.interval()[0])
    drawn(figure)


def test_what_cannot_be_drawn_is_told(hanging):
    fit = made_fit(hanging, ("seen along y",))
    lost = dataclasses.replace(fit, statuses=[rj.Status.NOT_FINITE])
    assert has_centerlines(fit)
    assert not has_centerlines(lost)
    with pytest.raises(ValueError, match="fit must have an experiment with a Centerline that was solved"):
        plot_shapes(lost)
    with pytest.raises(ValueError, match="fit must have unknowns in common"):
        plot_correlation(dataclasses.replace(fit, setup=fit.setup._replace(shared=())))
    with pytest.raises(ValueError, match="profiles must hold at least one Profile"):
        plot_profiles([])
    with pytest.raises(TypeError, match="fit must be a Fit, got 3"):
        plot_residuals(3)
