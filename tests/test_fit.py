"""Parameters from measurements: synthetic experiments with a known truth."""

import dataclasses
import functools
import math
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.identification.least_squares import Coordinates, NormalEquations, Residuals, least_squares
from rodjax.identification.measurements import Measurement
from rodjax.identification.result import Fit
from rodjax.programs.tasks import in_order

SEGMENTS = 8
EI, MASS = 5e-3, 0.08
SD = 1e-3
S = np.linspace(0.1, 0.9, 9)
SPANS = (0.6, 0.7, 0.75, 0.8, 0.85, 0.9)
SHIFTS = (1e-3, -2e-3, 0.0, 2e-3, -1e-3, 0.5e-3)
UNKNOWNS = (rj.Unknown("rod.EI"), rj.Unknown("rod.mass_per_length"), rj.Unknown("measured.0.shift", per="experiment"))
SETTINGS = dict(segments=SEGMENTS, planar=True)


def sagging(span: float, EI: float = EI, mass: float = MASS) -> rj.Scene:
    """A cable of 1 m between two level clamps, in the plane of x and z."""
    level = rj.frame((1, 0, 0))
    rod = rj.Rod(1.0, EI, 3e-3, 1e4, mass)
    return rj.Scene(rod, rj.Clamp((0, 0, 0), level), rj.Clamp((span, 0, 0), level), (0, 0, -9.81))


@functools.cache
def true_shapes() -> tuple[rj.Equilibrium, ...]:
    return tuple(rj.solve(sagging(span), **SETTINGS) for span in SPANS)


@functools.cache
def experiments(noise: float = 0.0, seed: int = 0, outliers: int = 0) -> tuple[rj.Experiment, ...]:
    """Points and end forces of the true shapes, with noise in standard deviations; begun from other numbers."""
    draw = np.random.default_rng(seed)
    found = []
    for k, (span, shift, shape) in enumerate(zip(SPANS, SHIFTS, true_shapes(), strict=True)):
        points = np.asarray(shape.position_at(S + shift)) + noise * SD * draw.standard_normal((len(S), 3))
        force = np.asarray(shape.end_force) + noise * 1e-2 * draw.standard_normal(3)
        for row in draw.choice(len(S), outliers, replace=False):
            points[row] += 50 * SD * draw.standard_normal(3)
        measured = rj.Centerline(points, S, SD), rj.EndForce(force, 1e-2)
        found.append(rj.Experiment(sagging(span, 1.3 * EI, 0.8 * MASS), measured, name=f"span {span}", cluster=k // 2))
    return tuple(found)


@functools.cache
def noisy_fit() -> Fit:
    return rj.fit(experiments(1.0), UNKNOWNS, **SETTINGS)


@pytest.mark.slow
def test_finds_the_truth_that_made_the_measurements():
    """To the rounding of derivatives, as the measurements are exact: the last step is Gauss's."""
    fit = rj.fit(experiments(), UNKNOWNS, **SETTINGS)
    assert fit.converged
    assert fit.estimate["rod.EI"] == pytest.approx(EI, rel=1e-7)
    assert fit.estimate["rod.mass_per_length"] == pytest.approx(MASS, rel=1e-7)
    np.testing.assert_allclose(fit.estimate["measured.0.shift"], SHIFTS, atol=1e-8)
    assert fit.sigma < 1e-5
    assert str(fit) == fit.report()
    assert fit.degrees_of_freedom == 6 * (3 * 9 + 3) - 2 - 6


def test_a_search_ends_where_nothing_better_is_to_be_found():
    """Of measurements without scatter the squares are rounding in the end, here 1e-8 at random: five steps of Gauss's
    and one in vain, where 13 more would be tried with more and more damping.
    """

    def evaluated(at, beside, is_first):
        residuals = jnp.stack([1e2 * jnp.expm1(at.shared), 1e-8 * jnp.cos(1e14 * at.shared)], axis=1)
        slopes = jnp.stack([1e2 * jnp.exp(at.shared), jnp.zeros(1)], axis=1)[None]
        of_one = Residuals(residuals, jnp.zeros(0))
        normal = NormalEquations.of(Residuals(slopes, jnp.zeros((1, 0))), of_one, 1)
        return normal, jnp.sum(residuals**2), beside

    start = Coordinates(jnp.array([0.3]), jnp.zeros((1, 0)))
    is_free = Coordinates(jnp.array([True]), jnp.zeros((1, 0), bool))
    found = least_squares(evaluated, start, jnp.zeros(()), is_free, jnp.array(2.0), 60)
    assert found.converged
    assert abs(found.at.shared[0]) < 1e-12
    assert found.steps <= 7


@functools.cache
def _shape(span: float, EI: float, mass: float) -> rj.Equilibrium:
    """Solved once for all shifts."""
    return rj.solve(sagging(span, EI, mass), **SETTINGS)


def _residuals(x: np.ndarray) -> np.ndarray:
    """Of all experiments, by their standard deviations, at logarithms of EI and mass and at shifts."""
    rows = []
    for span, shift, experiment in zip(SPANS, x[2:], experiments(1.0), strict=True):
        shape = _shape(span, float(np.exp(x[0])), float(np.exp(x[1])))
        points, force = experiment.measured
        rows += [
            (np.asarray(points.values) - np.asarray(shape.position_at(S + shift))).ravel() / SD,
            (np.asarray(force.values) - np.asarray(shape.end_force)) / 1e-2,
        ]
    return np.concatenate(rows)


@pytest.mark.slow
def test_covariance_is_that_of_the_linearised_problem():
    """Beside differences of the residuals, all unknowns at once; the estimate has no gradient. Differences of fourth
    order have 1e-8 of the derivatives.
    """
    fit = noisy_fit()
    at = np.array([math.log(fit.estimate["rod.EI"]), math.log(fit.estimate["rod.mass_per_length"])])
    at = np.concatenate([at, fit.estimate["measured.0.shift"]])
    columns = []
    for k, h in enumerate([1e-3, 1e-3, *[1e-4] * 6]):
        way = np.zeros(8)
        way[k] = h
        near, far = _residuals(at + way) - _residuals(at - way), _residuals(at + 2 * way) - _residuals(at - 2 * way)
        columns.append((8 * near - far) / (12 * h))
    jacobian, residuals = np.stack(columns, axis=1), _residuals(at)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * (residuals @ residuals) / fit.degrees_of_freedom
    errors = np.sqrt(np.diag(covariance))
    # Where the search ends a step would be below a thousandth of a standard error.
    gradient = jacobian.T @ residuals * errors / fit.sigma**2
    assert np.max(np.abs(gradient)) < 1e-2
    relative = [fit.standard_error[name] / fit.estimate[name] for name in fit.labels]
    np.testing.assert_allclose(relative, errors[:2], rtol=1e-4)
    np.testing.assert_allclose(fit.standard_error["measured.0.shift"], errors[2:], rtol=1e-4)
    assert fit.correlation[0, 1] == pytest.approx(covariance[0, 1] / (errors[0] * errors[1]), rel=1e-4)
    assert fit.sigma == pytest.approx(math.sqrt(residuals @ residuals / fit.degrees_of_freedom), rel=1e-6)


@pytest.mark.slow
def test_the_rest_follows_from_the_same_fit(monkeypatch):
    """Leaving out a cluster, profiles, made-up measurements, what to measure next; and what the report says."""
    # Sixteen fits side by side, so few calls that NumPy code does them sooner than a compiler.
    monkeypatch.setattr("rodjax.identification.refits.LANES", 16 * len(SPANS))
    fit = noisy_fit()
    low, high = fit.interval("rod.EI")
    assert low < EI < high
    assert low * high == pytest.approx(fit.estimate["rod.EI"] ** 2)  # symmetric on the scale of logarithms

    without = fit.leave_one_out()
    assert list(without) == ["0", "1", "2"]
    # A cluster whose standard deviations are a hundred times as large has 1e-4 of the information: by that the estimate
    # is off by 1e-6, as the cluster itself moves it by 1 %. Such a fit has the program of the first one.
    first = [
        rj.Experiment(one.scene, (rj.Centerline(points.values, S, 100 * SD), rj.EndForce(force.values, 1.0)))
        for one in experiments(1.0)[:2]
        for points, force in [one.measured]
    ]
    by_hand = rj.fit([*first, *experiments(1.0)[2:]], UNKNOWNS, **SETTINGS)
    assert without["0"]["rod.EI"] == pytest.approx(by_hand.estimate["rod.EI"], rel=1e-4)

    profile = fit.profile("rod.EI")
    assert np.nanmin(profile.deviance) == pytest.approx(0, abs=1e-6)
    # Nearly linear within its errors, so that the likelihood is nearly normal.
    np.testing.assert_allclose(profile.interval(0.95), fit.interval("rod.EI"), rtol=2e-3)
    assert profile.deviance[-1] == pytest.approx(9, rel=0.05)  # at three standard errors

    made_up = fit.bootstrap(112, seed=3)
    # The standard deviation of 112 numbers is known to 1/sqrt(224) = 7 %; three of these.
    assert np.std(made_up["rod.EI"]) == pytest.approx(fit.standard_error["rod.EI"], rel=0.2)
    assert abs(np.mean(made_up["rod.EI"]) / fit.estimate["rod.EI"] - 1) < 0.3 * fit.standard_error["rod.EI"] / EI

    known, unseen = experiments(1.0)[0], sagging(0.7)
    vague = rj.Experiment(unseen, (rj.Centerline(np.zeros((9, 3)), S, 100 * SD), rj.EndForce((0, 0, 0), 10.0)))
    ranking = fit.next_experiment([vague, known])
    assert ranking.order == [1, 0]
    assert ranking.gain[1] > 0.05 > ranking.gain[0] > 0
    assert ranking.standard_errors["rod.EI"][1] < ranking.standard_errors["rod.EI"][0]
    assert ranking.standard_errors["rod.EI"][0] <= fit.standard_error["rod.EI"]

    report = fit.report()
    assert "rod.EI [N m^2]" in report
    assert "6 experiments in 3 clusters, 180 numbers measured, 3 unknowns: converged" in report
    assert "rod.GJ cannot be found from these measurements: they do not depend on it" in report
    data = fit.as_dict()
    assert data["estimate"]["rod.EI"] == fit.estimate["rod.EI"]
    assert len(data["experiments"]) == 6
    assert np.asarray(fit.equilibrium(3).nodes[-1, 0]) == pytest.approx(SPANS[3])


@pytest.mark.slow
def test_bounds_and_priors():
    """A bound beside the estimate holds it and is named; a strong prior wins, a weak one is one more measurement."""
    free = noisy_fit()
    shift = UNKNOWNS[2]
    bounded = rj.Unknown("rod.EI", bounds=(1.05 * free.estimate["rod.EI"], 2 * EI))
    fit = rj.fit(experiments(1.0), (bounded, UNKNOWNS[1], shift), **SETTINGS)
    assert fit.estimate["rod.EI"] == pytest.approx(1.05 * free.estimate["rod.EI"], rel=1e-2)
    assert fit.at_bounds == ["rod.EI"]
    strong = rj.Unknown("rod.EI", prior=(1.1 * EI, 1e-6))
    assert rj.fit(experiments(1.0), (strong, UNKNOWNS[1], shift), **SETTINGS).estimate["rod.EI"] == pytest.approx(
        1.1 * EI, rel=1e-5
    )
    error = free.standard_error["rod.EI"] / free.estimate["rod.EI"]
    weak = rj.Unknown("rod.EI", prior=(EI, error / free.sigma))
    fit = rj.fit(experiments(1.0), (weak, UNKNOWNS[1], shift), **SETTINGS)
    # The prior is one more deviation in the scatter.
    rows = [x / sd for of_one in fit.residuals for x, sd in zip(of_one, (SD, 1e-2), strict=True)]
    squares = sum(float(np.sum(x**2)) for x in rows) + (math.log(fit.estimate["rod.EI"] / EI) * free.sigma / error) ** 2
    assert fit.degrees_of_freedom == free.degrees_of_freedom + 1
    assert fit.sigma == pytest.approx(math.sqrt(squares / fit.degrees_of_freedom), rel=1e-9)
    middle = math.sqrt(EI * free.estimate["rod.EI"])
    # As certain as the data: half way, on the scale of logarithms, to second order in the error of 1 %.
    assert fit.estimate["rod.EI"] == pytest.approx(middle, rel=0.05 * error)


@pytest.mark.slow
def test_an_experiment_left_out_takes_its_own_unknown_along():
    """As where it had no equilibrium to begin with: the data say nothing of it, which is no fault of the others."""
    fit = noisy_fit()

    found = eqx.tree_at(
        lambda found: [found.evaluation.is_used, *(getattr(found.information, name) for name in BLOCKS)],
        fit.found,
        replace_fn=lambda x: x.at[0].set(False) if x.dtype == bool else x.at[0].set(0.0),
    )
    less = Fit.of(fit.setup, fit.structure, fit.problem, found, [], math.nan)
    assert less.undetermined == []
    assert less.degrees_of_freedom == fit.degrees_of_freedom - 30 + 1
    assert np.isnan(less.standard_error["measured.0.shift"][0])
    assert np.all(np.isfinite(less.standard_error["measured.0.shift"][1:]))


BLOCKS = ("each", "so", "oo", "scores")


@pytest.mark.slow
def test_outliers_hardly_move_a_robust_fit():
    clean = noisy_fit()
    spoilt = experiments(1.0, outliers=2)  # of 9 points each
    plain = rj.fit(spoilt, UNKNOWNS, **SETTINGS)
    robust = rj.fit(spoilt, UNKNOWNS, loss="welsch", **SETTINGS)
    moved = abs(robust.estimate["rod.EI"] - clean.estimate["rod.EI"]) / clean.standard_error["rod.EI"]
    assert moved < 1
    assert robust.sigma < 2 < plain.sigma


@pytest.mark.slow
def test_what_cannot_be_told_apart_is_refused_by_name():
    """A shape under gravity tells EI over weight alone; a planar one nothing of GJ."""
    shapes = [rj.Experiment(one.scene, one.measured[:1]) for one in experiments(1.0)]
    with pytest.raises(rj.NotIdentifiableError, match=r"rod\.EI x 2\.72 with rod\.mass_per_length x 2\.72") as refused:
        rj.fit(shapes, ["rod.EI", "rod.mass_per_length", "rod.GJ"], **SETTINGS)
    assert "rod.GJ x 2.72" in str(refused.value)
    assert "all signs" not in str(refused.value)
    parts = [set(combination.parts) for combination in refused.value.fit.undetermined]
    assert sorted(parts, key=len) == [{"rod.GJ"}, {"rod.EI", "rod.mass_per_length"}]
    # As where the sign of a force is wrong, and all stiffnesses go to nothing.
    far = dataclasses.replace(noisy_fit(), sigma=165.0, undetermined=refused.value.fit.undetermined)
    told = str(rj.NotIdentifiableError(far))
    assert f"at rod.EI = {far.estimate['rod.EI']:.3g} N m^2, rod.mass_per_length = " in told
    assert "165 times as much as the standard deviations say: are all signs and units right?" in told


@pytest.mark.slow
def test_pictures_of_unknown_arclength_and_critical_values():
    """Points of a photograph at unknown arclength, with the unknown scale of the picture, and a buckling load."""
    camera = rj.pinhole((0.4, -2.0, -0.2), (0, 1, 0), (0, 0, -1), 1500.0, (640, 480))
    pictures = []
    for span, shape in zip(SPANS, true_shapes(), strict=True):
        straight = rj.Centerline(np.zeros((9, 2)), camera=camera, scale=1.02)
        points = np.asarray(straight.seen(shape.position_at(S + 0.01 * np.sin(9 * S))))
        pictures.append(rj.Experiment(sagging(span, 1.3 * EI), rj.Centerline(points, sd=0.5, camera=camera)))

    def column(load: float) -> rj.Scene:
        rod = rj.Rod(1.0, 1.3 * EI, 3e-3, 1e6)
        return rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((0, 0, 1))), rj.Free(force=(0, 0, -load)))

    largest = 0.05
    euler = math.pi**2 / 4 * EI / largest
    buckling = rj.CriticalValue([column(0.0), column(largest)], euler, 0.01 * euler, segments=16)
    fit = rj.fit([*pictures, buckling], ["rod.EI", "measured.0.scale"], **SETTINGS)
    # The picture is exact; the buckling load has the extension of 1e-8 and the mesh's error of some 1e-5.
    assert fit.estimate["rod.EI"] == pytest.approx(EI, rel=1e-5)
    assert fit.estimate["measured.0.scale"] == pytest.approx(1.02, rel=1e-6)
    assert fit.numbers == 6 * 9 + 1
    assert fit.standard_error["rod.EI"] < 0.01 * EI


OF_EACH = ["rod.EI", rj.Unknown("rod.mass_per_length"), "measured.0.shift"]
FREE = np.array([[True] * 3] * 6 + [[True, False, False]] * 3)


@pytest.mark.slow
def test_many_fits_by_themselves_are_the_single_ones(monkeypatch):
    """In parts of five by one thread and by two, the same to the last bit; and as in another part, to the tolerance of
    the search. By NumPy code, which takes as long as compiling does for a few parts.
    """
    monkeypatch.setattr("rodjax.identification.each.LANES", 5)
    monkeypatch.setattr("rodjax.identification.each.in_order", functools.partial(in_order, by_numpy=True))
    noisy = experiments(1.0)
    fits, other = (
        rj.fit_each([*noisy, *noisy[:3]], OF_EACH, free=FREE, threads=threads, **SETTINGS) for threads in (1, 2)
    )
    assert_same_bits(other, fits)
    # A single part, which begins within the first of the others and ends in the second.
    np.testing.assert_allclose(rj.fit_each(noisy[1:], OF_EACH, **SETTINGS).estimates, fits.estimates[1:6], rtol=1e-5)
    assert np.all(fits.converged)
    assert np.all(fits.determined)
    alone = rj.fit(noisy[2:3], OF_EACH, **SETTINGS)
    for k, label in enumerate(fits.labels):
        assert fits.estimates[2, k] == pytest.approx(alone.estimate[label], rel=1e-4)
        assert fits.standard_errors[2, k] == pytest.approx(alone.standard_error[label], rel=1e-3)
    assert fits.sigma[2] == pytest.approx(alone.sigma, rel=1e-5)
    np.testing.assert_allclose(fits.rms[2], alone.rms[0], rtol=1e-4)
    np.testing.assert_allclose(fits.estimates[6:, 1], 0.8 * MASS, rtol=1e-15)  # by its logarithm
    assert np.all(np.isnan(fits.standard_errors[6:, 1:]))
    np.testing.assert_array_equal(fits.degrees_of_freedom, [27] * 6 + [29] * 3)
    low, high = fits.intervals()
    assert np.all((low[:6, 0] < EI) & (high[:6, 0] > EI))


@pytest.mark.exhaustive
def test_many_fits_by_executables_are_the_same_whoever_computes_them(monkeypatch):
    monkeypatch.setattr("rodjax.identification.each.LANES", 5)
    noisy = experiments(1.0)
    with ThreadPoolExecutor(2) as engine:
        kinds: list[dict] = [{"threads": 1}, {"threads": 2}, {"executor": engine}]
        first, *others = (rj.fit_each([*noisy, *noisy[:3]], OF_EACH, free=FREE, **kind, **SETTINGS) for kind in kinds)
    for other in others:
        assert_same_bits(other, first)


def assert_same_bits(one: rj.Fits, other: rj.Fits) -> None:
    for ours, theirs in zip(jax.tree.leaves(vars(one)), jax.tree.leaves(vars(other)), strict=True):
        np.testing.assert_array_equal(ours, theirs)


# --- without a fit ----------------------------------------------------------------------------------------------------


def test_cameras():
    view = rj.orthographic((1, 0, 0), (0, 0, -1), origin=(0.1, 0, 0))
    seen = rj.Centerline(np.zeros((1, 2)), camera=view).seen(jnp.array([[0.4, 5.0, -0.2]]))
    np.testing.assert_allclose(seen, [[0.3, 0.2]], atol=1e-15)
    # At 2 m a length of 0.1 m fills 0.1/2 of the focal length.
    camera = rj.pinhole((0, -2, 0), (0, 1, 0), (0, 0, -1), 1000.0, (320, 240))
    seen = rj.Centerline(np.zeros((1, 2)), camera=camera).seen(jnp.array([[0.1, 0.0, -0.2]]))
    np.testing.assert_allclose(seen, [[320 + 50, 240 + 100]], rtol=1e-14)


POINTS = np.zeros((3, 3))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rj.Centerline(np.zeros((3, 2))), r"points must have the shape \(m, 3\)"),
        (lambda: rj.Centerline(POINTS, camera=np.eye(3, 4)), r"points must have the shape \(m, 2\)"),
        (lambda: rj.Centerline(POINTS, s=[0, 1]), "s must hold 3 numbers"),
        (lambda: rj.Centerline(POINTS, s=[-1, 0, 1]), "s must not be negative"),
        (lambda: rj.Centerline(POINTS, sd=0.0), "sd must be positive"),
        (lambda: rj.Centerline(POINTS, sd=[1, 2]), "sd must be a number or 3 of them"),
        (lambda: rj.Centerline(POINTS, scale=-1), "scale must be positive"),
        (lambda: rj.EndForce((1, 2)), "value must be numbers of shape"),
        (lambda: rj.EndForce((1, 2, 3), direction=(1, 0, 0)), "value must be a number"),
        (lambda: rj.EndForce((1, 2, 3), end="middle"), "end must be 'start' or 'end'"),
        (lambda: rj.Reading(3, 1.0), "of must be a function"),
        (lambda: rj.Experiment(sagging(0.7), ()), "measured must hold at least one"),
        (lambda: rj.Experiment(sagging(0.7), [3]), r"measured\[0\] must be a Measurement"),
        (lambda: rj.Experiment(sagging(0.7), rj.Centerline(POINTS, [0, 1, 2])), r"measured\[0\]\.s must lie in 0 to 1"),
        (lambda: rj.Unknown(""), "names must be dotted names"),
        (lambda: rj.Unknown("rod.EI", scale="square"), "scale must be"),
        (lambda: rj.Unknown("rod.EI", start=-1), "start must be positive"),
        (lambda: rj.Unknown("rod.EI", bounds=(2, 1)), "bounds must increase"),
        (lambda: rj.Unknown("rod.EI", prior=3), "prior must be a list of two numbers"),
        (lambda: rj.Unknown("rod.EI", per="day"), "per must be"),
        (lambda: rj.fit([], ["rod.EI"]), "experiments must hold at least one Experiment"),
        (lambda: rj.fit([3], ["rod.EI"]), r"experiments\[0\] must be"),
        (lambda: rj.fit(experiment(), []), "unknowns must hold at least one"),
        (lambda: rj.fit(experiment(), ["rod.weight"]), "unknowns must be numbers of the experiments, got 'rod.weight'"),
        (lambda: rj.fit(experiment(), ["rod.EI", "rod.EI"]), "unknowns must have different labels"),
        (lambda: rj.fit(experiment(), ["rod.EI"], loss="square"), "loss must be"),
        (lambda: rj.fit(experiment(), ["rod.EI"], threshold=2), "threshold must be None where loss is 'linear'"),
        (lambda: rj.fit(experiment(), ["rod.EI"], max_steps=0), "max_steps must be a whole number"),
        (lambda: rj.fit(experiment(), [rj.Unknown("rod.EI", bounds=(1, 2))]), "bounds of rod.EI must hold the start"),
        (lambda: rj.fit(experiment(rj.EndForce((0, 0, 1))), ["rod.EI"]), "sd must be given for every measurement"),
        (lambda: rj.fit_each(experiment(), ["rod.EI"], loss="huber"), "sd must be given for a loss"),
        (lambda: rj.fit_each(experiment(), ["rod.EI"], threshold=2), "threshold must be None where loss is 'linear'"),
        (lambda: rj.fit_each(experiment(), ["rod.EI"], free=[[1]]), "free must be of bool"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def experiment(*more: Measurement) -> list[rj.Experiment]:
    return [rj.Experiment(sagging(0.7), (rj.Centerline(POINTS, [0.2, 0.5, 0.8]), *more))]
