"""Tolerances: a taut wire in closed form, a cable in two clips beside a Monte Carlo, and a column that is flagged."""

import math
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy import stats

import rodjax as rj
from rodjax import Clamp, Clip, Limits, PointForce, Rod, Scene, Sphere, Tolerance, frame, problems
from rodjax.paths.batch import solve_batch
from rodjax.routing import scatter

ORIGIN = (0.0, 0.0, 0.0)
LEVEL = frame((1, 0, 0))
EA = 1e4


def wire() -> rj.Equilibrium:
    """1 m of wire between clamps 1.01 m apart, straight."""
    rod = Rod(1.0, 1.0, 1.0, EA, radius=0.01)
    return rj.solve(Scene(rod, Clamp(ORIGIN, LEVEL), Clamp((1.01, 0, 0), LEVEL)), segments=8)


COVARIANCE = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-8
OF_WIRE = [Tolerance("end.position", COVARIANCE), Tolerance("rod.length", 1e-4)]
LIMITS = Limits(end_force=104.0, bend_radius=5.0)
# Of `CHUNKS`: samples sixteen at a time, in the program of the few solves.
SIXTEEN = ((16, math.inf),)


def test_a_taut_wire():
    """F = EA (d/L - 1): dF/dd = EA/L, dF/dL = -EA d/L^2."""
    envelope = rj.tolerances(wire(), OF_WIRE, limits=LIMITS)
    assert envelope.margins is not None
    assert envelope.margins.names == ("bend radius", "force of start", "force of end")
    variances = (EA * 2e-4) ** 2, (EA * 1.01 * 1e-4) ** 2
    deviation = np.sqrt(sum(variances))
    first = envelope.first_order
    # Derivatives are exact: roundings, and the solver's 1e-8 EI/L^2.
    np.testing.assert_allclose(first.deviation[1:], deviation, rtol=1e-9)
    np.testing.assert_allclose([first.start_force[0], first.end_force[0]], deviation, rtol=1e-9)
    np.testing.assert_allclose(envelope.shares[1:], [np.array(variances) / deviation**2] * 2, rtol=1e-9)
    probability = stats.norm.sf(4.0 / deviation)
    np.testing.assert_allclose(first.probability[1:], probability, rtol=1e-8)
    np.testing.assert_allclose(envelope.any_bound, 2 * probability, rtol=1e-8)
    # Both ends bear the same force: they break the limit together. Of 100000 draws, four standard errors.
    np.testing.assert_allclose(first.any_broken, probability, atol=4 * np.sqrt(probability / 1e5))
    # The end moves as it is held, along the wire without bending it; the middle by half of that across.
    across = np.sqrt(COVARIANCE[1, 1])
    np.testing.assert_allclose(first.position[[0, 4, 8]], [0.0, across / 2, across], rtol=1e-9, atol=1e-12)
    # A bend radius that is infinite has no first order; forces across the wire are of second order, and small.
    assert set(envelope.flags) == {"bend radius"}
    assert envelope.sampled is None
    assert "force of end: 100 +- 2.2 N (most 104), broken with probability 0.037" in str(envelope)
    assert "not of first order: bend radius" in str(envelope)


def test_rods_are_drawn_within_tolerances():
    """Of 4000: means and covariances of what scatters, each within four of its standard errors."""
    envelope = rj.tolerances(wire(), OF_WIRE, samples=0)
    drawn = envelope.drawn(4000, seed=1)
    assert isinstance(drawn.end, Clamp)
    ends = np.asarray(drawn.end.position) - [1.01, 0, 0]
    sigma = np.sqrt(np.diag(COVARIANCE))
    assert np.all(np.abs(ends.mean(0)) < 4 * sigma / np.sqrt(4000))
    found = np.cov(ends.T)
    errors = np.sqrt((COVARIANCE**2 + np.outer(sigma, sigma) ** 2) / 4000)
    assert np.all(np.abs(found - COVARIANCE) < 4 * errors)
    assert np.std(drawn.rod.length) == pytest.approx(1e-4, rel=4 / np.sqrt(8000))
    assert eqx.tree_equal(envelope.drawn(5, seed=2), envelope.drawn(5, seed=2))
    assert not eqx.tree_equal(envelope.drawn(5, seed=2), envelope.drawn(5))
    with pytest.raises(ValueError, match="count must be a whole number from 1"):
        envelope.drawn(0)


@pytest.mark.slow
def test_the_softest_motion_of_a_rod_that_slides(monkeypatch):
    """Its deviation beside the difference of two solves; without the few solves, which tell nothing of it."""
    monkeypatch.setattr("rodjax.routing.tolerances.by_few", lambda *_: (0,))

    def scene(EI: float) -> Scene:
        ends = Clamp(ORIGIN, frame((1, 0, -1))), Clamp((0.6, 0.2, 0.0), frame((1, 1, 0)))
        return Scene(Rod(1.0, EI, 1.0, EA), *ends, clips=[Clip(0.5, (0.35, 0.05, 0.1), sliding=True)])

    def solved(EI: float) -> rj.Equilibrium:
        return rj.solve(scene(EI), segments=12, solver=rj.Newton(tolerance=1e-12))

    result = solved(1.0)
    envelope = rj.tolerances(result, [Tolerance("rod.EI", 0.001)])
    assert envelope.stiffness == float(rj.lowest_mode(result).stiffness)
    most, least = (rj.lowest_mode(solved(EI)).stiffness for EI in (1.001, 0.999))
    # Differences of second order.
    assert envelope.stiffness_deviation == pytest.approx(abs(float(most - least)) / 2, rel=1e-4)


@pytest.mark.exhaustive
def test_a_taut_wire_beside_a_monte_carlo():
    envelope = rj.tolerances(wire(), OF_WIRE, limits=LIMITS, samples=2000, seed=1)
    first, sampled = envelope.first_order, envelope.sampled
    assert sampled is not None
    assert envelope.samples == 2000
    assert set(envelope.flags) == {"bend radius"}
    # Four standard errors of 2000 samples.
    np.testing.assert_allclose(sampled.deviation[1:], first.deviation[1:], rtol=4 / np.sqrt(4000))
    np.testing.assert_allclose(sampled.any_broken, first.any_broken, atol=4 * np.sqrt(first.any_broken / 2000))
    np.testing.assert_allclose(sampled.position[8], np.sqrt(COVARIANCE[1, 1]), rtol=4 / np.sqrt(4000))


@pytest.mark.slow
def test_rods_that_do_not_come_to_rest_are_left_out(monkeypatch):
    def solved(*scenes, **options):
        rods = solve_batch(*scenes, **options)
        parts = rods.converged.at[0].set(False), rods.nodes.at[0].set(np.nan), rods.start_force.at[0].set(np.nan)
        return eqx.tree_at(lambda rods: (rods.converged, rods.nodes, rods.start_force), rods, parts)

    monkeypatch.setattr(scatter, "solve_stack", solved)
    monkeypatch.setattr("rodjax.paths.batch.CHUNKS", SIXTEEN)
    few = rj.tolerances(wire(), OF_WIRE, limits=LIMITS, samples=0)
    many = rj.tolerances(wire(), OF_WIRE, limits=LIMITS, samples=640)
    # The first of each call, which takes 16 rods at most.
    assert few.flags["rod"].startswith("1 of the rods with other numbers did not come to rest")
    assert many.flags["rod"].startswith("40 of the rods")
    assert many.samples == 600
    assert set(few.flags) == set(many.flags) == {"rod", "bend radius"}
    assert many.sampled is not None
    assert np.all(np.isfinite(many.sampled.position))


def held_by_clips() -> tuple[rj.Equilibrium, list[Tolerance], Limits, list]:
    """A cable under its weight through two clips, one of which holds its direction; limits within a few deviations."""
    rod = problems.cable(40.0)
    clips = [Clip(0.3, (0.25, 0.08, -0.05), (1, 0.2, -0.1)), Clip(0.65, (0.5, 0.15, 0.05))]
    ends = Clamp(ORIGIN, frame((1, 0, -1))), Clamp((0.75, 0.2, 0.0), frame((1, 1, 0)))
    result = rj.solve(Scene(rod, *ends, (0, 0, -9.81), clips=clips), segments=12)
    given = [
        *(Tolerance(f"clips.{k}.position", 5e-4) for k in range(2)),
        Tolerance("clips.0.tangent", 0.005),
        Tolerance("rod.length", 5e-4),
        Tolerance("clips.1.at", 5e-4),
    ]
    nominal = rj.margins(
        result,
        Limits(bend_radius=1, clearance=0.01, clip_force=1, clip_moment=1, end_force=1),
        [Sphere((0.4, 0.3, 0.1), 0.05)],
    )
    value = dict(zip(nominal.names, np.asarray(nominal.value).tolist(), strict=True))
    diameter = 2 * float(rod.radius)
    limits = Limits(
        bend_radius=0.98 * value["bend radius"] / diameter,
        clearance=0.98 * value["clearance to obstacle 0"],
        clip_force=1.01 * value["force of clip 0"],
        clip_moment=1.01 * value["moment of clip 0"],
        end_force=1.01 * max(value["force of start"], value["force of end"]),
    )
    return result, given, limits, [Sphere((0.4, 0.3, 0.1), 0.05)]


@pytest.mark.slow
def test_a_cable_in_clips_beside_a_monte_carlo():
    result, given, limits, obstacles = held_by_clips()
    envelope = rj.tolerances(result, given, limits=limits, obstacles=obstacles, samples=5_000)
    first, sampled = envelope.first_order, envelope.sampled
    assert sampled is not None
    assert envelope.samples == 5_000
    assert envelope.flags == {}
    # The moment of a clip that holds no direction is none.
    moved = first.deviation > 0
    assert int(np.sum(~moved)) == 1
    np.testing.assert_allclose(sampled.deviation[moved], first.deviation[moved], rtol=0.05)
    np.testing.assert_allclose(sampled.deviation[~moved], 0.0)
    largest = float(np.max(first.position))
    np.testing.assert_allclose(sampled.position, first.position, atol=0.05 * largest)
    for end in ("start_force", "end_force"):
        np.testing.assert_allclose(getattr(sampled, end), getattr(first, end), rtol=0.05)
    # Four standard errors of 5000 samples, 0.028, beside what second order shifts the mean by.
    np.testing.assert_allclose(sampled.probability, first.probability, atol=0.03)
    np.testing.assert_allclose(sampled.any_broken, first.any_broken, atol=0.03)
    assert max(first.probability) <= first.any_broken <= envelope.any_bound
    np.testing.assert_allclose(np.sum(envelope.shares[moved], axis=1), 1.0, rtol=1e-12)


@pytest.mark.slow
def test_a_column_near_buckling_is_flagged_and_sampled(monkeypatch):
    """Between clamps it buckles at 4 pi^2 EI/L^2; a small side force keeps the bow to one side."""
    monkeypatch.setattr("rodjax.paths.batch.CHUNKS", SIXTEEN)
    rod = Rod(1.0, 1.0, 1.0, EA)
    sigma = 4e-5

    def column(part: float, moment: float, **options) -> rj.Envelope:
        end = Clamp((1 - part * 4 * np.pi**2 / EA, 0, 0), LEVEL)
        scene = Scene(rod, Clamp(ORIGIN, LEVEL), end, point_forces=[PointForce(0.5, (0, 0, 0.005))])
        result = rj.solve(scene, segments=8)
        return rj.tolerances(result, [Tolerance("end.position.0", sigma)], limits=Limits(end_moment=moment), **options)

    half, sampled = column(0.5, 1.0), column(0.5, 1.0, samples=1000)
    assert half.flags == sampled.flags == {}
    assert half.sampled is None
    assert half.scatter is half.first_order
    # The stiffness of the bow would vanish within 2.5 standard deviations of the thrust, and its height, as of any bow
    # near the load that buckles, grows by more than in proportion.
    few = column(0.98, 1.0, samples=0)
    assert few.margins is not None
    assert "near instability" in few.flags["rod"]
    assert "standard deviation by solves" in few.flags["centerline"]
    assert few.sampled is None
    assert not few.is_certain
    assert str(few).startswith("To first order, which does NOT hold for rod")
    # A limit that by the first order is broken once in 160: at 2.5 deviations.
    limit = float(few.margins.value[0] + 2.5 * few.first_order.deviation[0])
    found = column(0.98, limit)
    assert found.sampled is not None
    assert found.samples == 2000
    assert found.scatter is found.sampled
    np.testing.assert_allclose(found.first_order.probability, stats.norm.sf(2.5), rtol=1e-6)
    # The moment grows with the thrust alone: the thrust at which it is at the limit tells the probability.
    z = np.linspace(-3, 3, 16)
    end = 1 - 0.98 * 4 * np.pi**2 / EA + sigma * z
    nominal = Scene(
        rod, Clamp(ORIGIN, LEVEL), Clamp((end[8], 0, 0), LEVEL), point_forces=[PointForce(0.5, (0, 0, 0.005))]
    )
    scenes = [eqx.tree_at(lambda s: s.end.position, nominal, jax.numpy.array([x, 0.0, 0.0])) for x in end]
    # Warm, in the program of the samples.
    options = dict(segments=8, discretization=few.scattering.equilibrium.discretization, strain_limit=None)
    rods = solve_batch(scenes, guess=few.scattering.equilibrium, **options)
    moments = np.linalg.norm(rods.start_moment, axis=1)
    assert np.all(np.diff(moments) < 0)
    expected = stats.norm.cdf(np.interp(limit, moments[::-1], z[::-1]))
    assert expected > 5 * stats.norm.sf(2.5)
    # Four standard errors of 2000 samples.
    error = 4 * np.sqrt(expected * (1 - expected) / 2000)
    np.testing.assert_allclose(found.scatter.probability, expected, atol=error)
    np.testing.assert_allclose(found.scatter.any_broken, expected, atol=error)
    first, line = str(found).splitlines()[:2]
    assert first.startswith("By 2000 samples, as the first order does not hold for ")
    assert f"broken with probability {found.sampled.probability[0]:.2g}; to first order, which does not hold," in line
    assert "standard deviation by solves" in column(0.98, limit, samples=1000).flags["centerline"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("", 1.0), "key must be the dotted name of a number"),
        ((3, 1.0), "key must be the dotted name of a number"),
        (("rod.length", 0.0), "sigma must be positive"),
        (("rod.length", "1 mm"), "sigma must be a number"),
        (("end.position", (1.0, 1.0, 1.0)), "sigma must be a number"),
        (("end.position", -np.eye(3)), "sigma must be a covariance matrix, symmetric and not negative"),
        (("end.position", np.triu(np.ones((3, 3)))), "sigma must be a covariance matrix"),
    ],
)
def test_numbers_of_a_tolerance_are_checked(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Tolerance(*arguments)


def test_bad_arguments():
    result = wire()
    good = [Tolerance("rod.length", 1e-4)]
    for given, options, message in (
        ([], {}, "tolerances must hold at least one Tolerance"),
        (
            [Tolerance("clips.0.at", 1e-3)],
            {},
            r"tolerances\[0\]: key must be a number of the scene: rod.length, ",
        ),
        ([Tolerance("end.position.3", 1e-3)], {}, "key must be a number of the scene"),
        ([*good, *good], {}, r"tolerances\[1\]: rod.length has a tolerance already"),
        (
            [Tolerance("end.position.2", 1e-3), Tolerance("end.position", 1e-3)],
            {},
            r"tolerances\[1\]: end.position.2 has a tolerance already",
        ),
        ([Tolerance("end.position", np.eye(2))], {}, r"sigma must be a number or of shape \(3, 3\) for end.position"),
        (["rod.length"], {}, r"tolerances\[0\] must be a Tolerance"),
        (good, {"samples": -1}, "samples must be a whole number from 0"),
        (good, {"seed": 0.5}, "seed must be a whole number from 0"),
        (good, {"obstacles": [Sphere(ORIGIN, 1.0)]}, "limits must be given where there are obstacles"),
        (good, {"limits": Limits(clip_force=1.0)}, "limits.clip_force must be None for a scene without clips"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            rj.tolerances(result, given, **options)
    with pytest.raises(TypeError, match="equilibrium must be an Equilibrium"):
        rj.tolerances(result.scene, good)
    stack = jax.tree.map(lambda leaf: leaf[None], result)
    with pytest.raises(ValueError, match="equilibrium must be a single one"):
        rj.tolerances(stack, good)


def test_samples_by_threads_and_an_executor_are_the_same(monkeypatch):
    monkeypatch.setattr("rodjax.paths.batch.CHUNKS", SIXTEEN)
    with ThreadPoolExecutor(2) as engine:
        kinds: list[dict] = [{"threads": 1}, {"threads": 2}, {"executor": engine}]
        first, *others = (rj.tolerances(wire(), OF_WIRE, limits=LIMITS, samples=40, **kind) for kind in kinds)
    assert first.samples == 40
    for other in others:
        for ours, theirs in zip(vars(other.sampled).values(), vars(first.sampled).values(), strict=True):
            np.testing.assert_array_equal(ours, theirs)
