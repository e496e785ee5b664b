"""Margins: closed forms, derivatives beside differences of solves, and words for what makes no sense."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy

import rodjax as rj
from rodjax.analysis.sensitivity import moved
from rodjax.routing.margins import measured

TIGHT = rj.Newton(tolerance=1e-12)
RADIUS = 0.005


def rod(length: float, **options) -> rj.Rod:
    return rj.Rod(length, 0.02, 0.015, 1e4, 0.15, RADIUS, **options)


def by_name(found: rj.Margins) -> dict[str, dict[str, np.ndarray]]:
    fields = ("value", "limit", "margin", "s")
    return {name: {f: np.asarray(getattr(found, f)[..., k]) for f in fields} for k, name in enumerate(found.names)}


def test_an_arc():
    """A quarter of a circle, bent by moments alone, 10 mm above the floor that it begins at."""
    R = 0.3
    scene = rj.Scene(
        rod(R * np.pi / 2), rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Clamp((R, 0, R), rj.frame((0, 0, 1)))
    )
    result = rj.solve(scene, segments=16, solver=TIGHT)
    floor = rj.Plane((0, 0, -RADIUS - 0.01), (0, 0, 1))
    limits = rj.Limits(
        bend_radius=10, clearance=0.004, end_moment=0.1, end_force=1, twist=1, energy=1, length=1, mass=2
    )
    found = rj.margins(result, limits, [floor], names=["the floor"])
    assert found.names == (
        "bend radius",
        "clearance to the floor",
        "force of start",
        "force of end",
        "moment of start",
        "moment of end",
        "twist",
        "length",
        "mass",
        "energy",
    )
    assert found.units == ("m", "m", "N", "N", "N m", "N m", "rad/m", "m", "kg", "J")
    assert found.kinds == ("least", "least", *["most"] * 8)
    L = R * np.pi / 2
    expected = {
        "bend radius": (R - RADIUS, 0.1),
        "clearance to the floor": (0.01, 0.004),
        "force of start": (0.0, 1.0),
        "moment of start": (0.02 / R, 0.1),
        "moment of end": (0.02 / R, 0.1),
        "twist": (0.0, 1.0),
        "length": (L, 1.0),
        "mass": (0.15 * L, 2.0),
        "energy": (0.5 * 0.02 / R**2 * L, 1.0),
    }
    named = by_name(found)
    for name, (value, limit) in expected.items():
        # Elements of fourth order with 16 on a quarter of a circle: 1e-6 for the curvature.
        assert named[name]["value"] == pytest.approx(value, rel=2e-6, abs=2e-6)
        assert named[name]["limit"] == pytest.approx(limit, rel=1e-12)
        sign = 1 if found.kinds[found.names.index(name)] == "least" else -1
        assert named[name]["margin"] == pytest.approx(sign * (value - limit) / limit, rel=1e-5, abs=1e-6)
    assert named["clearance to the floor"]["s"] == 0
    assert named["moment of end"]["s"] == pytest.approx(L, rel=1e-12)
    assert np.isnan(named["length"]["s"])
    assert "clearance to the floor: 0.01 m (least 0.004), margin 150.0 % at s = 0 m" in str(found)


def straight(length, pull, limits: rj.Limits) -> rj.Margins:
    """Of a rod 0.8 m long, or a little longer or pulled, between clamps 0.8 m apart."""
    one = rod(0.8)
    one = rj.Rod(length, one.EI, one.GJ, one.EA, one.mass_per_length, one.radius)
    level = rj.frame((1, 0, 0))
    end = jnp.stack([0.8 + pull, 0 * pull, 0 * pull])
    scene = rj.Scene(one, rj.Clamp((0.0, 0.0, 0.0), level), rj.Clamp(end, level))
    return rj.margins(rj.solve(scene, segments=16, solver=TIGHT), limits)


def test_a_straight_rod():
    """An infinite bend radius, without NaN in derivatives."""

    def found(pull):
        margins = straight(0.8, pull, rj.Limits(bend_radius=6))
        return (margins.value, margins.margin), (margins.value, margins.margin)

    rates, values = by_numpy(jax.jacfwd(found, has_aux=True))(jnp.array(0.0))
    assert np.isinf(values).all()
    np.testing.assert_array_equal(rates, 0)


def test_slacks_are_continuous_as_an_obstacle_moves_along():
    """By no more than it moves, each: 0.1 mm a step, past the ends of pieces of the rod and of the rod itself."""
    scene = rj.Scene(rod(0.8), rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Clamp((0.8, 0, 0), rj.frame((1, 0, 0))))
    result = rj.solve(scene, segments=16, solver=TIGHT)
    limits = rj.Limits(clearance=0.01)

    @by_numpy
    @jax.vmap
    def values(x):
        sphere = rj.Sphere(jnp.stack([x, 0.0 * x, 0.0 * x + 0.06]), 0.02)
        return measured(result, limits, (sphere,), everywhere=True)[0].value

    for begin in (-0.01, 0.09, 0.79):
        found = np.asarray(values(begin + 1e-4 * jnp.arange(201.0)))
        # Nothing jumps where the nearest place of a piece leaves it by an end.
        assert np.max(np.abs(np.diff(found, axis=0))) < 1e-4 + 1e-9
        # Nor does the least have kinks where it goes on to the next piece: second differences are those of a distance
        # of 0.06 m, 1e-8/0.06, and as much for what the places found lack.
        least = np.min(found, axis=1)
        assert np.max(np.abs(np.diff(least, 2))) < 2e-8 / 0.06


@pytest.mark.slow
def test_the_softest_motion_of_a_straight_rod():
    """Of 4 pi^2 EI/L^2 and the tension beside."""
    L, EI = 0.8, 0.02

    def found(length, pull):
        margins = straight(length, pull, rj.Limits(stability=0.1))
        return margins.value[0], (margins.value[0], margins.margin[0])

    point = (jnp.array(L), jnp.array(0.0))
    (by_length, by_pull), (value, margin) = by_numpy(jax.jacfwd(found, (0, 1), has_aux=True))(*point)
    stiffness = 4 * np.pi**2 * EI / L**2
    # Elements of fourth order, 16 of them along a whole wave: 2e-5.
    assert value == pytest.approx(stiffness, rel=4e-5)
    assert margin == pytest.approx((stiffness - 0.1) / 0.1, rel=5e-5)
    # A rod longer by dL between the same clamps is pressed by EA dL/L; one pulled by u has the tension EA u/L.
    tension = 1e4 / L
    assert by_pull == pytest.approx(tension, rel=1e-3)  # of which the stiffness of bending is 1e-4
    assert by_length == pytest.approx(-tension - 2 * stiffness / L, rel=1e-3)


def test_a_hanging_rod():
    """Straight down from a pin over a floor: weight, strain and clearance in closed form."""
    L, mass, EA = 1.0, 0.15, 1e4
    scene = rj.Scene(rod(L), rj.Pin((0, 0, 0)), rj.Free(), (0, 0, -9.81))
    result = rj.solve(scene, segments=16, solver=TIGHT)
    limits = rj.Limits(clearance=[0.1, 0.0], end_force=1, strain=1e-3)
    found = by_name(rj.margins(result, limits, [rj.Plane((0, 0, -1.2), (0, 0, 1)), rj.Sphere((1, 0, 0), 0.5)]))
    weight = mass * 9.81 * L
    sag = L * (1 + weight / (2 * EA))
    # A straight rod under its weight alone is exact on any mesh, up to the tolerance of the solve.
    assert found["clearance to obstacle 0"]["value"] == pytest.approx(1.2 - sag - RADIUS, rel=1e-9)
    assert found["clearance to obstacle 0"]["margin"] == pytest.approx((1.2 - sag - RADIUS - 0.1) / 0.1, rel=1e-9)
    assert found["clearance to obstacle 0"]["s"] == pytest.approx(L)
    # Beside a limit of 0 the margin is the distance itself.
    assert found["clearance to obstacle 1"]["margin"] == pytest.approx(0.5 - RADIUS, rel=1e-9)
    assert found["clearance to obstacle 1"]["s"] == 0
    assert found["force of start"]["value"] == pytest.approx(weight, rel=1e-9)
    assert found["force of end"]["value"] == pytest.approx(0, abs=1e-9)
    assert found["strain"]["value"] == pytest.approx(weight / EA, rel=1e-3)  # the first node, not the top itself
    assert found["strain"]["s"] == 0


def clipped() -> rj.Scene:
    clips = [rj.Clip(0.3, (0.22, 0.03, -0.04), (1, 0.3, 0)), rj.Clip(0.62, (0.45, 0.1, 0.02))]
    ends = rj.Clamp((0, 0, 0), rj.frame((1, 0, -1))), rj.Clamp((0.6, 0.2, 0), rj.frame((1, 1, 0.4)))
    return rj.Scene(rod(0.95), *ends, (0, 1, -9.81), clips=clips)


LIMITS = rj.Limits(
    bend_radius=6,
    clearance=0.01,
    clip_force=5,
    clip_moment=0.1,
    end_force=4,
    end_moment=0.2,
    twist=2,
    strain=1e-3,
    stability=0.1,
    length=1.0,
    mass=0.2,
    energy=0.5,
)
OBSTACLES = [rj.Plane((0, 0, -0.25), (0.1, 0, 1)), rj.Box((0.3, 0.3, 0), (0.1, 0.1, 0.1))]


@pytest.mark.slow
def test_derivatives_are_those_of_solves():
    scene = clipped()
    at = rj.solve(scene, segments=24, solver=TIGHT)

    def found(changes):
        result = rj.solve(moved(scene, changes), segments=24, guess=at, solver=TIGHT)
        return rj.margins(result, LIMITS, OBSTACLES).margin

    nowhere = {
        "rod.length": jnp.zeros(()),
        "rod.EI": jnp.zeros(()),
        "clips.0.at": jnp.zeros(()),
        "clips.0.position": jnp.zeros(3),
        "clips.0.tangent": jnp.zeros(3),
        "end.frame": jnp.zeros(3),
    }
    rates = by_numpy(jax.jacfwd(found))(nowhere)
    rng = np.random.default_rng(1)
    h = 1e-6
    for _ in range(3):
        way = {name: jnp.asarray(rng.normal(size=zero.shape)) for name, zero in nowhere.items()}
        way["rod.EI"] = 0.02 * way["rod.EI"]
        along = sum(jnp.tensordot(rates[name], way[name], way[name].ndim) for name in way)
        ends = [found(jax.tree.map(lambda d, sign=sign: sign * h * d, way)) for sign in (1, -1)]
        # Central differences of solves to 1e-12 EI/L^2: 1e-6 by their rounding, beside the largest.
        np.testing.assert_allclose(along, (ends[0] - ends[1]) / (2 * h), rtol=2e-6, atol=2e-6)


@pytest.mark.slow
def test_of_several_rods_each_is_its_own():
    scene = clipped()
    both = rj.solve_batch([scene, moved(scene, {"end.position": jnp.array([0.0, 0.02, 0.0])})], segments=24)
    found = rj.margins(both, LIMITS, OBSTACLES)
    assert found.value.shape == (2, len(found.names))
    one = rj.margins(jax.tree.map(lambda leaf: leaf[1], both), LIMITS, OBSTACLES)
    # The same operations in another program: to rounding, of the softest motion by its inverse iteration.
    np.testing.assert_allclose(found.margin[1], one.margin, rtol=1e-8, atol=1e-10)
    assert "for 2 rods" in str(found)


def test_a_bend_at_a_clip_is_seen_on_both_sides():
    """A clip that turns the rod makes its curvature jump; the sharper side is beyond the clip."""
    clip = rj.Clip(0.45, (0.45, 0, 0), (1, 0, 0))
    level = rj.frame((1, 0, 0))
    scene = rj.Scene(rod(0.675), rj.Clamp((0, 0, 0), level), rj.Pin((0.65, 0, 0.1)), clips=[clip])
    limits = rj.Limits(bend_radius=6)
    result, finer = rj.solve(scene, segments=32), rj.solve(scene, segments=128)
    found, exact = (by_name(rj.margins(each, limits))["bend radius"] for each in (result, finer))
    assert found["s"] == pytest.approx(0.45, abs=1e-6)
    # By 32 elements.
    assert found["value"] == pytest.approx(exact["value"], rel=2e-3)
    # Before the clip the rod is straight but for its stretch.
    assert np.max(result.curvature[result.s < 0.4]) < 0.1 / float(found["value"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "Limits must hold at least one limit"),
        ({"bend_radius": 0}, "bend_radius must be positive, got 0"),
        ({"clearance": [0.1, -1]}, r"clearance must not be negative, got \[0.1, -1\]"),
        ({"stability": -1.0}, "stability must not be negative, got -1"),
    ],
)
def test_limits_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        rj.Limits(**options)


def test_margins_are_checked():
    level = rj.frame((1, 0, 0))
    bare = rj.Rod(1.0, 0.02, 0.015, 1e4)
    scene = rj.Scene(bare, rj.Clamp((0, 0, 0), level), rj.Clamp((0.9, 0, 0), level))
    result = rj.solve(scene, segments=8)
    floor = rj.Plane((0, 0, -1), (0, 0, 1))
    with pytest.raises(TypeError, match="equilibrium must be an Equilibrium or HarnessEquilibrium, got 5"):
        rj.margins(5, rj.Limits(twist=1))  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="limits must be a Limits, got 3"):
        rj.margins(result, 3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"limits.bend_radius must be None for a rod without a radius"):
        rj.margins(result, rj.Limits(bend_radius=6))
    with pytest.raises(ValueError, match=r"limits.clip_force must be None for a scene without clips"):
        rj.margins(result, rj.Limits(clip_force=6))
    with pytest.raises(ValueError, match=r"limits.clearance must be given where there are obstacles"):
        rj.margins(result, rj.Limits(twist=1), [floor])
    with pytest.raises(ValueError, match=r"limits.clearance must be given where there are obstacles"):
        rj.margins(result, rj.Limits(clearance=1))
    with pytest.raises(ValueError, match=r"limits.clearance must be one number, or one for each of 1 obstacles, got 2"):
        rj.margins(result, rj.Limits(clearance=[1, 2]), [floor])
    with pytest.raises(ValueError, match=r"names must be 1 different ones"):
        rj.margins(result, rj.Limits(clearance=1), [floor], names=["a", "b"])
