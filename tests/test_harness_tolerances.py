"""Tolerances of harnesses: a taut wire cut in two in closed form, and a cable cut in two beside the whole cable."""

import jax
import numpy as np
import pytest
from scipy import stats
from test_harness import END, GRAVITY, START, cut, plain

import rodjax as rj
from rodjax import Clamp, Harness, Joint, Limits, Newton, Rod, Scene, Sphere, Tolerance, frame
from rodjax.window import opening

LEVEL = frame((1, 0, 0))
EA = 1e4
COVARIANCE = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-8


@pytest.fixture(scope="module")
def wire() -> rj.HarnessEquilibrium:
    """Two halves of 1 m of wire between clamps 1.01 m apart, straight."""
    rod = Rod(0.5, 1.0, 1.0, EA, radius=0.01)
    first = Scene(rod, Clamp((0, 0, 0), LEVEL), Joint("cut"))
    return rj.solve(
        Harness({"a": first, "b": Scene(rod, Joint("cut"), Clamp((1.01, 0, 0), LEVEL))}),
        segments=4,
        solver=Newton(tolerance=1e-11),
    )


def test_a_taut_wire_that_is_cut(wire):
    """F = EA ((d - o)/L - 1), o the offset along the wire: dF/dd = -dF/do = EA/L, dF/dL = -EA d/L^2."""
    given = [
        Tolerance("cables.b.end.position", COVARIANCE),
        Tolerance("cables.a.rod.length", 1e-4),
        Tolerance("cables.b.start.offset.2", 5e-5),
    ]
    assert [one.unit for one in given] == ["m"] * 3
    envelope = rj.tolerances(wire, given, limits=Limits(end_force=104.0, bend_radius=5.0))
    assert envelope.margins is not None
    names = ("bend radius", "force of start", "force of end")
    assert envelope.margins.names == tuple(f"{cable}: {name}" for cable in "ab" for name in names)
    variances = np.array([EA * 2e-4, EA * 1.01 * 1e-4, EA * 5e-5]) ** 2
    deviation = np.sqrt(np.sum(variances))
    first, forces = envelope.first_order, [1, 2, 4, 5]
    # Derivatives are exact: roundings, and the solver's 1e-11 EI/L^2.
    np.testing.assert_allclose(first.deviation[forces], deviation, rtol=1e-9)
    np.testing.assert_allclose([first.start_force[:, 0], first.end_force[:, 0]], deviation, rtol=1e-9)
    np.testing.assert_allclose(envelope.shares[forces], [variances / deviation**2] * 4, rtol=1e-9)
    probability = stats.norm.sf(4.0 / deviation)
    np.testing.assert_allclose(first.probability[forces], probability, rtol=1e-8)
    np.testing.assert_allclose(envelope.any_bound, 4 * probability, rtol=1e-8)
    # The joint moves by half of what the end does across the wire, without bending it.
    across = np.sqrt(COVARIANCE[1, 1])
    np.testing.assert_allclose(envelope["a"].position[[0, 4]], [0.0, across / 2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(envelope["b"].position[[0, 4]], [across / 2, across], rtol=1e-9)
    np.testing.assert_allclose(envelope["b"].s, [0.0, 0.125, 0.25, 0.375, 0.5], rtol=1e-12)
    # The softest motion is t turned by sin(2 pi s/L): EI 4 pi^2/L^2, on 8 elements 1 % more, and EA (x - 1) x of the
    # stretched wire, x = (d - o)/L.
    bending, x = 4 * np.pi**2, 1.01
    assert envelope.stiffness == pytest.approx(bending + EA * (x - 1) * x, abs=0.01 * bending)
    slopes = EA * (2 * x - 1) * np.array([1.0, x, 1.0]) + [0.0, 2 * bending, 0.0]
    # Of the bending 1 % is 1e-4 of the whole.
    assert envelope.stiffness_deviation == pytest.approx(np.linalg.norm(slopes * [2e-4, 1e-4, 5e-5]), rel=1e-4)
    # A bend radius that is infinite has no first order; solves agree with all else.
    assert set(envelope.flags) == {"a: bend radius", "b: bend radius"}
    assert "b: force of end: 100 +- 2.3 N (most 104), broken with probability 0.04" in str(envelope)
    assert "b: centerline: +- 0.00014 m at most, at s = 0.5 m" in str(envelope)


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        ([Tolerance("cables.c.rod.length", 1e-3)], {}, "key must be a number of the harness: cables.a.rod.length, "),
        ([Tolerance("rod.length", 1e-3)], {}, "key must be a number of the harness"),
        (
            [Tolerance("cables.a.rod.length", 1e-3)] * 2,
            {},
            r"tolerances\[1\]: cables.a.rod.length has a tolerance already",
        ),
        (
            [Tolerance("cables.a.rod.length", 1e-3)],
            {"limits": Limits(clip_force=1.0)},
            "limits.clip_force must be None for a scene without clips",
        ),
    ],
)
def test_what_is_no_number_of_a_harness_is_refused(wire, given, options, message):
    with pytest.raises(ValueError, match=message):
        rj.tolerances(wire, given, **options)


def test_margins_of_a_harness_are_those_of_its_cables(wire):
    obstacle = Sphere((0.25, 0.2, 0.0), 0.05)
    found = rj.margins(wire, Limits(clearance=0.1, strain=0.02), [obstacle], names=["ball"])
    assert found.names == ("a: clearance to ball", "a: strain", "b: clearance to ball", "b: strain")
    # From the axis of the wire, less both radii; of the other half from the joint.
    np.testing.assert_allclose(found.value[0], 0.2 - 0.05 - 0.01, rtol=1e-9)
    np.testing.assert_allclose(found.value[2], np.hypot(0.2, 0.255) - 0.06, rtol=1e-9)
    np.testing.assert_allclose(found.value[1::2], 0.01, rtol=1e-9)
    two = jax.tree.map(lambda leaf: jax.numpy.stack([leaf, leaf]), wire)
    np.testing.assert_allclose(rj.margins(two, Limits(strain=0.02)).value, np.full((2, 2), 0.01), rtol=1e-9)


@pytest.mark.slow
def test_a_cable_that_is_cut_scatters_as_the_cable(monkeypatch):
    """To first order, and by the same 60 samples."""
    tight = Newton(tolerance=1e-11)
    whole = rj.solve(Scene(plain(1.0), START, END, gravity=GRAVITY), segments=8, solver=tight)
    parts = rj.solve(cut(plain), segments=4, solver=tight)
    limits = Limits(end_force=1.0, stability=0.1)
    expected, found = (
        rj.tolerances(
            result,
            [Tolerance(f"{name}end.position", 1e-3), Tolerance(f"{name}end.frame", 0.01)],
            limits=limits,
            samples=60,
        )
        for result, name in ((whole, ""), (parts, "cables.b."))
    )
    for theirs, ours in ((expected.first_order, found.first_order), (expected.sampled, found.sampled)):
        assert theirs is not None
        assert ours is not None
        # The solver's 1e-11 EI/L^2, of samples its 1e-8.
        position = np.concatenate([ours.position[:5], ours.position[6:]])
        np.testing.assert_allclose(position, theirs.position, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(ours.start_force[0], theirs.start_force, rtol=1e-6)
        np.testing.assert_allclose(ours.end_force[1], theirs.end_force, rtol=1e-6)
    assert found.stiffness == pytest.approx(expected.stiffness, rel=1e-8)
    assert found.stiffness_deviation == pytest.approx(expected.stiffness_deviation, rel=1e-6)
    assert found.margins is not None
    assert found.margins.names[-1] == "stability"
    assert found.margins.value[-1] == pytest.approx(expected.stiffness, rel=1e-8)
    assert found.first_order.deviation[-1] == pytest.approx(expected.stiffness_deviation, rel=1e-6)
    # Scenes drawn at random are solved as any are.
    drawn = found.drawn(2, seed=1)
    rods = rj.solve_batch(drawn, segments=4)
    np.testing.assert_allclose(rods["b"].nodes[:, -1], drawn["b"].end.position, atol=1e-12)
    # The window shows such rods.
    monkeypatch.setattr(opening, "DRAWN", 3)
    session = opening.session_of(found, None)
    assert (len(session.recorded), session.segments) == (3, 4)
    with pytest.raises(ValueError, match="scenes must be several harnesses"):
        rj.solve_batch(parts.harness)
