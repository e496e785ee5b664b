"""What a fit says of data in a wrong unit or order, and of numbers that are not those of a rod."""

import dataclasses
import math
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.identification import report
from rodjax.identification.plausible import check_points
from rodjax.identification.setup import Setup

LEVEL = np.asarray(rj.frame((1, 0, 0)))
S = np.linspace(0.0, 1.0, 11)
HALF = 1.1311  # half of its angle: sin(HALF)/HALF = 0.8
SPAN = math.sin(HALF) / HALF


def scene(GJ=3e-3):
    return rj.Scene(rj.Rod(1.0, 4.9e-3, GJ, 1e4, 0.1), rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((SPAN, 0, 0), LEVEL))


def points(s=S):
    """An arc 1 m long below its ends, which are 0.8 m apart."""
    x, z = (np.sin(HALF * (2 * s - 1)), np.cos(HALF * (2 * s - 1)))
    return np.stack([SPAN / 2 + x / (2 * HALF), np.zeros(len(s)), (math.cos(HALF) - z) / (2 * HALF)], axis=1)


def refused(measured, unknowns=("rod.EI",), monkeypatch=None):
    with pytest.raises(ValueError, match="measured") as caught:
        rj.fit([rj.Experiment(scene(), measured, name="near 1")], unknowns)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("near 1: measured[0].points must ")
    return message


SEEN = rj.orthographic((1, 0, 0), (0, 0, -1))


@pytest.fixture(autouse=True)
def _nothing_is_solved(monkeypatch):
    monkeypatch.setattr("rodjax.identification.fit.beginnings", lambda *_: pytest.fail("solved"))


def test_millimetres_given_as_metres_are_named():
    assert "they look like millimetres" in refused(rj.Centerline(1000 * points(), S))
    assert "they look like millimetres" in refused(rj.Centerline(1000 * points(), sd=1.0))
    picture = 1000 * np.asarray(rj.Centerline(np.zeros((11, 2)), camera=SEEN).seen(jnp.asarray(points())))
    assert "they look like millimetres" in refused(rj.Centerline(picture, S, camera=SEEN))
    assert "look at their unit" in refused(rj.Centerline(2.5 * points(), S))
    assert "look at the units of points, s and rod.length" in refused(rj.Centerline(1e-3 * points(), S))
    with pytest.raises(ValueError, match=r"measured\[0\]\.s must lie in 0 to 1 m, got 1000 m"):
        rj.Experiment(scene(), rj.Centerline(points(), 1000 * S))


def test_points_listed_from_the_other_end_are_named():
    assert "take s = 1 m - s" in refused(rj.Centerline(points()[::-1], S))
    part = S[2:7]
    assert "take s = 1 m - s" in refused(rj.Centerline(points(1 - part), part))


def test_good_points_and_what_a_fit_may_find_are_taken():
    random = np.random.default_rng(0)

    def taken(measured, *sought):
        check_points([rj.Experiment(scene(), measured)], ["one"], sought)

    for _ in range(50):
        s = np.sort(random.uniform(0, 1, 7))
        taken(rj.Centerline(points(s) + 5e-3 * random.standard_normal((7, 3)), s), "rod.EI")
        taken(rj.Centerline(points(s)[::-1]), "rod.EI")  # without arclengths the order does not matter
    taken(rj.Centerline(1000 * points(), S), "measured.0.scale")
    taken(rj.Centerline(points()[::-1], S), "measured.0.turn.2")
    with pytest.raises(ValueError, match="millimetres"):
        taken(rj.Centerline(1000 * points(), S), "measured.1.scale")


def remarks(GJ, twist, unknown="rod.GJ"):
    """Of a fit that found this GJ at this twist."""
    stack = jax.tree.map(lambda leaf: leaf[None], scene(GJ))
    result = types.SimpleNamespace(scene=stack, total_twist=np.array([twist]))
    experiment = rj.Experiment(scene(GJ), rj.Centerline(points(), S), name="near 1")
    fields = dict.fromkeys(field.name for field in dataclasses.fields(rj.Fit))
    fields |= {
        "setup": Setup((experiment,), (), (rj.Unknown(unknown),), (), (0,), True),
        "found": types.SimpleNamespace(evaluation=types.SimpleNamespace(results=(result,))),
        "statuses": [rj.Status.CONVERGED],
    }
    fit = rj.Fit(**fields)
    return report._of_turns(fit) + report._of_frames(fit)


def test_a_torsional_stiffness_of_a_wrong_whole_turn_is_told():
    """A rod of GJ/EI = 0.8 turned by 380 degrees, fitted as if by 20: the same torque, 19 times the stiffness."""
    right, twist = 0.8 * 4.9e-3, math.radians(380)
    (told,) = remarks(right * 19, twist - 2 * math.pi)
    assert "GJ/EI = 15.2 of near 1 is unusual" in told
    assert "the twist, which is 20 deg here" in told
    assert "+1 turn would make it 0.8" in told
    assert remarks(right, twist) == []
    assert remarks(right * 19, twist - 2 * math.pi, "rod.mass_per_length") == []


def taken_turns(GJ, twists, error, **options):
    """What a fit that found this GJ, with this standard error, at these twists tells of turns that nobody stated."""
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(twists)), scene(GJ))
    stack = eqx.tree_at(lambda scene: scene.turns, stack, options.get("turns"), is_leaf=lambda x: x is None)
    fields = dict.fromkeys(field.name for field in dataclasses.fields(rj.Fit))
    fields |= {
        "setup": Setup((), (), (rj.Unknown("rod.GJ"),), (), (), True),
        "found": types.SimpleNamespace(
            evaluation=types.SimpleNamespace(
                results=(types.SimpleNamespace(scene=stack, total_twist=np.array(twists)),)
            )
        ),
        "estimate": {"rod.GJ": GJ},
        "standard_error": {"rod.GJ": error},
    }
    return report._of_taken_turns(rj.Fit(**fields))


def test_another_whole_turn_that_fits_as_well_is_told():
    GJ = 0.8 * 4.9e-3
    (told,) = taken_turns(GJ, [3 * math.pi], 0.02 * GJ)
    assert "known to 0.03 of a turn" in told
    assert f"one turn more would make it {0.6 * GJ:.3g}, one turn less would make it {3 * GJ:.3g} and fit" in told
    # Two twists tell the turns, where their torques are known better than these differ.
    assert taken_turns(GJ, [3 * math.pi, -1.5 * math.pi], 0.02 * GJ) == []
    assert len(taken_turns(GJ, [3 * math.pi, -1.5 * math.pi], 0.2 * GJ)) == 1
    assert taken_turns(GJ, [3 * math.pi], 0.02 * GJ, turns=jnp.ones(1)) == []


def test_a_frame_is_told_from_the_nominal():
    (told,) = remarks(3e-3, 0.1, "end.frame.0")
    assert told == "end.frame.0 is a turn about a global axis from the nominal direction, which is 0"
