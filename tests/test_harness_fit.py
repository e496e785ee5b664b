"""Fits of harnesses: a cable cut in two beside the whole cable, numbers of cables and joints that are known, errors."""

import numpy as np
import pytest
from test_harness import END, GRAVITY, START, cut, plain

import rodjax as rj
from rodjax import Body, Harness, Joint, Rod, Scene
from rodjax.identification.plots import plot_residuals

S = np.array([0.1, 0.3, 0.45])


def rod(length: float, stiffer: float = 1.0, heavier: float = 1.0) -> Rod:
    one = plain(length)
    return Rod(length, stiffer * one.EI, one.GJ, one.EA, heavier * one.mass_per_length)


@pytest.mark.exhaustive
def test_a_fit_of_a_cable_that_is_cut_is_that_of_the_cable():
    true = rj.solve(Scene(rod(1.0), START, END, gravity=GRAVITY), segments=8)
    draw = np.random.default_rng(0)
    first, second = (np.asarray(true.position_at(s)) + 1e-4 * draw.standard_normal((3, 3)) for s in (S, S + 0.5))
    force = np.asarray(true.end_force) + 1e-3 * draw.standard_normal(3)
    whole = rj.Experiment(
        Scene(rod(1.0, 1.3), START, END, gravity=GRAVITY),
        [rj.Centerline(first, S, 1e-4), rj.Centerline(second, S + 0.5, 1e-4), rj.EndForce(force, 1e-3)],
    )
    parts = rj.Experiment(
        cut(lambda length: rod(length, 1.3)),
        [
            rj.Centerline(first, S, 1e-4, cable="a"),
            rj.Centerline(second, S, 1e-4, cable="b"),
            rj.EndForce(force, 1e-3, cable="b"),
        ],
    )
    names = ("rod.EI", "rod.mass_per_length")
    expected = rj.fit([whole], names, segments=8)
    of_both = [rj.Unknown([f"cables.{cable}.{name}" for cable in "ab"], label=name) for name in names]
    found = rj.fit([parts], of_both, segments=4)
    assert found.converged
    assert found.steps == expected.steps
    assert found.units == expected.units
    for name in names:
        # What solves leave: of the rod 1e-8 EI/L^2 and less.
        assert found.estimate[name] == pytest.approx(expected.estimate[name], rel=1e-7)
        assert found.standard_error[name] == pytest.approx(expected.standard_error[name], rel=1e-6)
    assert found.sigma == pytest.approx(expected.sigma, rel=1e-6)
    for ours, theirs in zip(found.residuals[0], expected.residuals[0], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    assert found.equilibrium(0).names == ("a", "b")
    assert "cables.a.rod.GJ could be found too" in found.report()
    # Alone it is the same.
    alone = rj.fit_each([parts], of_both, segments=4)
    np.testing.assert_allclose(alone.estimates[0], [found.estimate[name] for name in names], rtol=1e-9)
    figure = plot_residuals(found)
    assert len(figure.axes) == 3


@pytest.mark.slow
def test_numbers_of_a_cable_and_a_joint_are_found():
    """Those that made the measurements, which are exact: EI of each cable, and what hangs on the joint."""

    def harness(stiffer: tuple[float, float], mass: float) -> Harness:
        first, second = (
            Scene(rod(0.5, stiffer[0]), START, Joint("cut"), gravity=GRAVITY),
            Scene(rod(0.5, stiffer[1]), Joint("cut"), END, gravity=GRAVITY),
        )
        return Harness({"a": first, "b": second}, {"cut": Body(mass=mass)})

    def joint(result: rj.HarnessEquilibrium):
        return result.joints["cut"].position

    EI = float(plain(1.0).EI)
    true = rj.solve(harness((1.0, 1.5), 0.02), segments=4, solver=rj.Newton(tolerance=1e-11))
    measured = [
        rj.Reading(joint, np.asarray(joint(true)), 1e-4, unit="m"),
        rj.Centerline(np.asarray(true["b"].position_at(S)), S, 1e-4, cable="b"),
        rj.EndMoment(-np.asarray(true["a"].start_moment), 1e-4, end="start", cable="a"),
    ]
    begin = rj.Experiment(harness((1.2, 1.2), 0.025), measured)
    unknowns = ("cables.a.rod.EI", "cables.b.rod.EI", "joints.cut.mass")
    fit = rj.fit([begin], unknowns, segments=4)
    assert fit.converged
    assert fit.units["joints.cut.mass"] == "kg"
    # To the rounding of derivatives, as the last step is Gauss's.
    np.testing.assert_allclose([fit.estimate[name] for name in unknowns], [EI, 1.5 * EI, 0.02], rtol=1e-7)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: rj.Experiment(cut(rod), rj.EndForce((0, 0, 1.0))),
            r"measured\[0\].cable must be one of 'a', 'b', got None",
        ),
        (lambda: rj.Experiment(cut(rod), rj.EndForce((0, 0, 1.0), cable="c")), "must be one of 'a', 'b', got 'c'"),
        (
            lambda: rj.Experiment(cut(rod)["a"], rj.EndForce((0, 0, 1.0), cable="a")),
            r"measured\[0\].cable must be None for a Scene, which has one, got 'a'",
        ),
        (
            lambda: rj.Experiment(cut(rod), rj.Centerline([(0, 0, 0)], [0.6], cable="a")),
            r"measured\[0\].s must lie in 0 to 0.5 m, got 0.6 m",
        ),
        (
            lambda: rj.Experiment(
                cut(rod), rj.EndForce((0, 0, 1.0), cable="a"), guess=rj.Guess([(0, 0, 0), (0.5, 0, 0)])
            ),
            "guess must be None for a harness",
        ),
        (lambda: rj.EndForce((0, 0, 1.0), cable=3), "cable must be a str, got 3"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_what_is_measured_names_its_cable(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["cables.c.rod.EI"], {}, "unknowns must be numbers of the experiments, got 'cables.c.rod.EI'; the first has "),
        (["cables.a.rod.EI"], {"planar": True}, "planar must be False for a harness"),
        (
            ["cables.a.rod.EI"],
            {"discretization": "finite_difference"},
            "discretization must be 'hermite' for a harness",
        ),
    ],
)
def test_options_of_fits_of_harnesses_are_checked(names, options, message):
    given = [rj.Experiment(cut(rod), rj.EndForce((0, 0, 1.0), 0.1, cable="a"))]
    with pytest.raises(ValueError, match=message):
        rj.fit(given, names, **options)


def test_points_in_millimetres_are_told_in_a_harness_too():
    points = 1e3 * np.array([(0.0, 0, 0), (0.1, 0, 0.02), (0.2, 0, 0.1), (0.3, 0.1, 0.1), (0.4, 0.1, 0.1)])
    given = [rj.Experiment(cut(rod), rj.Centerline(points, sd=1.0, cable="b"))]
    with pytest.raises(ValueError, match=r"measured\[0\].points must lie along a rod that is 0.5 m long"):
        rj.fit(given, ["cables.a.rod.EI"])
