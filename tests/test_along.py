"""What varies along a rod, and rods made of it."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.discretization.cells import ElementCells
from rodjax.model.along import Spline
from rodjax.model.rod import torsion_constant
from rodjax.model.scene import nondimensional
from rodjax.solving.options import checked_options

LINE = np.stack([np.arange(5.0), np.zeros(5), np.zeros(5)], axis=1)
FRAMES = np.stack([np.eye(3)] * 5)


class Stiff(rj.Law):
    """Plain Python numbers for fields."""

    stiffness: Any

    def __call__(self, curvature, twist, axial_strain, s):
        return self.stiffness * (jnp.sum(curvature**2) + twist**2 + axial_strain**2)


def test_a_law_may_hold_plain_numbers():
    rod = rj.Rod(1.0, 1, 1, 1, law=Stiff(2))
    assert rod.law.stiffness.dtype == jnp.float64
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Free())
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(scene))


def test_a_spline_reproduces_cubics():
    """Values, and integrals of fourth degree: to rounding."""
    knots = np.array([0.0, 0.3, 0.5, 1.1, 2.0])
    values = np.stack([knots**3 - knots, 2 + knots**2], axis=1)
    spline = Spline.through(jnp.asarray(knots), jnp.asarray(values))
    x = np.linspace(0, 2, 21)
    np.testing.assert_allclose(spline.at(jnp.asarray(x)), [x**3 - x, 2 + x**2], rtol=0, atol=1e-13)
    expected = [x**4 / 4 - x**2 / 2, 2 * x + x**3 / 3]
    np.testing.assert_allclose(spline.integral(jnp.asarray(x)), expected, rtol=0, atol=1e-13)


def test_steps_have_the_mean_of_a_stretch():
    steps = rj.Steps([0.4, 0.5], [1.0, 3.0, 2.0])
    a, b = jnp.array([0.0, 0.3, 0.4, 0.6]), jnp.array([0.2, 0.5, 0.5, 1.0])
    np.testing.assert_allclose(steps.mean(a, b), [1, 2, 3, 2], rtol=1e-14)


@pytest.mark.parametrize("knots", [(0, 1), (0, 0.4, 1), (0, 0.2, 0.5, 1), (0, 0.2, 0.5, 0.6, 1)])
def test_samples_are_of_the_spline(knots):
    """By SciPy where its numbers are known; to roundings."""
    spline = rj.Smooth(knots, np.cos(3 * np.array(knots)))
    fine = jnp.linspace(0, 1, 8 * len(knots))
    expected = np.concatenate([spline.values, spline.at(fine, fine, fine)])
    np.testing.assert_allclose(spline.samples, expected, rtol=0, atol=1e-14)


def test_samples_tell_the_largest_value():
    """Also of a spline that overshoots: a cubic through 0, 1, 1, 0 has its largest value in the middle."""
    assert float(jnp.max(rj.Steps([0.4, 0.5], [1.0, 3.0, 2.0]).samples)) == 3
    # 9/2 x (1 - x), of 32 places the nearest to the middle 1/62 off it.
    largest = float(jnp.max(rj.Smooth([0, 1 / 3, 2 / 3, 1], [0, 1, 1, 0]).samples))
    assert largest == pytest.approx(9 / 8 - 4.5 / 62**2, rel=1e-12)


def test_a_radius_that_varies_leaves_the_rod_plain():
    """No angle about the tangent is needed for it, and it is scaled with the rod."""
    rod = rj.Rod(2.0, 3.0, 1.0, 1e4, radius=rj.Steps([0.5], [0.01, 0.02]))
    assert rod.is_plain
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Free(force=(0, 0, 1)))
    scaled, _ = nondimensional(scene)
    assert scaled.rod.is_plain
    np.testing.assert_allclose(scaled.rod.radius.jumps, [0.25], rtol=1e-15)
    np.testing.assert_allclose(scaled.rod.radius.values, [0.005, 0.01], rtol=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rj.Steps([0.5, 0.4], [1, 2, 3]), "jumps must increase"),
        (lambda: rj.Steps([0.5], [1, 2, 3]), "values must be one more than jumps"),
        (lambda: rj.Smooth([0, 1], [1, 2, 3]), "values must be as many as s"),
        (lambda: rj.Rod(1.0, rj.Steps([1.5], [1, 2]), 1, 1), r"EI.jumps must lie inside 0 to 1 m"),
        (lambda: rj.Rod(1.0, 1, rj.Smooth([0, 0.5], [1, 2]), 1), r"GJ.s must run from 0 to 1 m"),
        (lambda: rj.Rod(1.0, rj.Steps([0.5], [1, -2]), 1, 1), "EI must be positive"),
        (lambda: rj.Rod(1.0, rj.Smooth([0, 0.4, 0.5, 1], [1, 0.001, 1, 1]), 1, 1), "EI must be positive"),
        (lambda: rj.Rod(1.0, 1, 1, 1, radius=rj.Steps([1.5], [1, 2])), r"radius.jumps must lie inside 0 to 1 m"),
        (lambda: rj.Rod(1.0, 1, 1, 1, radius=rj.Smooth([0, 0.4, 0.5, 1], [1, 0.001, 1, 1])), "radius must be positive"),
        (lambda: rj.Rod(1.0, (1, 2, 3), 1, 1), "EI must be one or a pair"),
        (lambda: rj.Rod(1.0, 1, 1, 1, rest_curvature=3.0), "rest_curvature must be a pair"),
        (lambda: rj.Rod(1.0, 1, 1, 1, law=3), "law must be a Law"),
        (lambda: rj.Rod(1.0, 1, 1, 1, law=Stiff("soft")), r"law must have numbers in its fields, got 'soft'"),
        (lambda: rj.Rod(1.0, 1, 1, 1, law=Stiff(np.ones(2))), "law must give one floating-point number"),
        (lambda: rj.Rod(1.0, 1, 1, 1, law=Stiff(math.nan)), "law must be finite"),
        (lambda: rj.Free(follower=True), "follower must be False without a force or a moment"),
        (lambda: rj.Rod.layered(1.0, [2e-3, 1e-3], [1e9], poisson_ratios=[0.3]), "radii must increase"),
        (lambda: rj.Rod.from_centerline(LINE, 1, 1, 1, frames=2 * FRAMES), r"frames\[0\] must be a rotation"),
        (lambda: rj.Rod.from_centerline(LINE, 1, 1, 1, frames=FRAMES[:, :, ::-1]), r"frames\[0\] must be right-handed"),
        (lambda: rj.Rod.from_centerline(LINE, 1, 1, 1, frames=FRAMES), "frames must have the tangents of the curve"),
        (lambda: rj.Rod.from_centerline(LINE, 1, 1, 1, d2=(1, 0, 0)), "d2 must not be parallel"),
        (lambda: rj.Rod.from_centerline([[0, 0, 0], [1, 0, 0]], 1, 1, 1), "points must have the shape"),
        (lambda: rj.Rod.from_centerline([[0, 0, 0]] * 5, 1, 1, 1), "points must not repeat"),
        (lambda: rj.Rod.bundle(1.0, 7, 1e-3, 1e9, poisson_ratio=0.3, stick=2), "stick must lie in 0"),
        (lambda: rj.Rod.layered(1.0, [0, 1e-3], [1e9, 1e9], poisson_ratios=[0.3]), "radii must be one more"),
        (lambda: rj.Rod.rectangular(1.0, 0, 1e-3, 1e9, poisson_ratio=0.3), "width must be positive"),
        (lambda: rj.DistributedForce((0, 0, 1), follower=1), "follower must be a bool"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()


def test_the_torsion_constant_of_rectangles():
    """Timoshenko & Goodier, table of sec. 109: of a square 0.1406, of 2 to 1 0.229; J/(long short^3)."""
    assert float(torsion_constant(1.0, 1.0)) == pytest.approx(0.1405770, abs=1e-7)
    assert float(torsion_constant(1.0, 2.0)) / 2 == pytest.approx(0.2286817, abs=1e-7)
    strip = rj.Rod.rectangular(1.0, width=3.0, height=1.0, youngs_modulus=12.0, shear_modulus=1.0)
    np.testing.assert_allclose(strip.EI, [3.0, 27.0], rtol=1e-14)


def test_a_bundle_between_slip_and_stick():
    """Seven wires: six at the distance of two radii, E A (2 r)^2 6/2 = 48 E I on top of 7 E I."""
    slip, stick = (rj.Rod.bundle(1.0, 7, 1e-3, 1e9, poisson_ratio=0.3, stick=x) for x in (0, 1))
    wire = rj.Rod.circular(1.0, 1e-3, 1e9, poisson_ratio=0.3)
    np.testing.assert_allclose([slip.EI, slip.GJ, slip.EA], 7 * np.array([wire.EI, wire.GJ, wire.EA]), rtol=1e-14)
    assert float(stick.EI / wire.EI) == pytest.approx(55, rel=1e-12)
    assert float(stick.GJ / wire.GJ) == pytest.approx(55, rel=1e-12)
    assert float(stick.radius) == pytest.approx(3e-3, rel=1e-12)


def test_two_and_three_wires_that_stick_bend_about_their_centroid():
    """Parallel axes: each wire adds E A d^2 = 4 E I (d/r)^2 to EI about an axis at the distance d, and to GJ G A d^2 =
    2 G J (d/r)^2, r the radius of a wire. Two wires: d = r about d2, 0 about d1. Three in a triangle: d = 2 r/sqrt(3)
    from the centroid. Four in a rhombus: halves of its diagonals r and sqrt(3) r.
    """
    root = 3**0.5
    wire = rj.Rod.circular(1.0, 1e-3, 1e9, poisson_ratio=0.3)
    for wires, bending, torsion, radius in (
        (1, 1, 1, 1),
        (2, (2, 2 + 2 * 4), 2 + 2 * 2, 2),
        (3, 3 + 4 * 3 * (4 / 3) / 2, 3 + 2 * 3 * (4 / 3), 1 + 2 / root),
        (4, (4 + 4 * 2, 4 + 4 * 2 * 3), 4 + 2 * 8, 1 + root),
        (7, 7 + 4 * 24 / 2, 7 + 2 * 24, 3),
        (19, 19 + 4 * 192 / 2, 19 + 2 * 192, 5),
    ):
        for stick in (0.0, 0.25, 1.0):
            rod = rj.Rod.bundle(1.0, wires, 1e-3, 1e9, poisson_ratio=0.3, stick=stick)
            mixed = wires + stick * (np.array(bending) - wires)
            assert rod.is_plain == (np.ndim(bending) == 0)
            # Sums of a few rounded products.
            np.testing.assert_allclose(np.array(rod.EI) / wire.EI, mixed, rtol=1e-13)
            np.testing.assert_allclose(rod.GJ / wire.GJ, wires + stick * (torsion - wires), rtol=1e-13)
            np.testing.assert_allclose(rod.radius, 1e-3 * radius, rtol=1e-13)
    for wires in range(1, 40):  # those around one or more of others are within them
        rod = rj.Rod.bundle(1.0, wires, 1e-3, 1e9, poisson_ratio=0.3, stick=1.0)
        EI1, EI2 = rod.bending_pair
        assert wires * wire.EI * (1 - 1e-13) <= EI1 <= EI2
        np.testing.assert_allclose(rod.GJ / wire.GJ, wires + (EI1 + EI2 - 2 * wires * wire.EI) / (2 * wire.EI))


def test_equal_layers_are_one_rod():
    layers = rj.Rod.layered(1.0, [0, 1e-3, 2e-3], [1e9, 1e9], poisson_ratios=[0.3, 0.3], densities=[1e3, 1e3])
    rod = rj.Rod.circular(1.0, 2e-3, 1e9, poisson_ratio=0.3, density=1e3)
    for name in ("EI", "GJ", "EA", "mass_per_length", "radius"):
        assert float(getattr(layers, name)) == pytest.approx(float(getattr(rod, name)), rel=1e-13)


def test_the_ends_of_a_helix_at_rest():
    """Of constant curvature and twist, the pose at the end is that of a helix: to rounding."""
    curvature, twist, length = 3.0, 2.0, 1.7
    rate = math.hypot(curvature, twist)
    rod = rj.Rod(length, 1, 1, 1, rest_curvature=(curvature, 0), rest_twist=twist)
    _, (position, frame) = rod.rest_ends()
    axis = np.array([curvature, 0, twist]) / rate
    np.testing.assert_allclose(frame, rj.rotate(np.eye(3), rate * length * axis), rtol=0, atol=1e-13)
    along = axis[2] * axis
    across = np.array([0, 0, 1]) - along
    turned = math.sin(rate * length) * across + (1 - math.cos(rate * length)) * np.cross(axis, [0, 0, 1])
    np.testing.assert_allclose(position, along * length + turned / rate, rtol=0, atol=1e-13)


def test_a_curve_through_points_has_their_curvature():
    """A circle of radius 2: a cubic spline through 60 points has its curvature to 1e-3 but near its ends."""
    angle = np.linspace(0, 1.5, 61)
    points = np.stack([2 * np.cos(angle), 2 * np.sin(angle), 0 * angle], axis=1)
    rod = rj.Rod.from_centerline(points, 1, 1, 1, d2=(0, 0, 1))
    assert float(rod.length) == pytest.approx(3.0, abs=1e-6)
    s = jnp.linspace(0.2, 0.8, 9)
    strains = rod.rest_shape.at(s, s, s) / float(rod.length)
    np.testing.assert_allclose(strains[1], np.full(9, 0.5), rtol=1e-3)
    np.testing.assert_allclose(strains[::2], np.zeros((2, 9)), rtol=0, atol=1e-10)


def layered(jumps, **options) -> rj.Scene:
    values = np.arange(1.0, len(jumps) + 2)
    rod = rj.Rod(2.0, (rj.Steps(jumps, values), 1.0), 1.0, 1e4)
    return rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Free(force=(0, 0, 1)), **options)


@pytest.mark.parametrize("jumps", [[1.0, 1.002], [0.002], [0.4, 1.998], [1.402]])
def test_every_jump_has_a_node_or_is_refused(jumps):
    """Jumps 0.001 L from one another, an end or a load were merged where elements are 20 times as long or more."""
    scene = layered(jumps, point_forces=[rj.PointForce(1.4, (0, 0, 1))])
    with pytest.raises(ValueError, match=r"jumps of Steps .*0.001 of the length.* needs segments = 51 or more"):
        rj.solve(scene, segments=16)
    options, _ = checked_options(scene, None, 1e-2, None, None, None, False)
    assert options.segments == 64  # of the library's sizes
    scaled, _ = nondimensional(scene)
    nodes = ElementCells.of(scaled, jnp.linspace(0.0, 1.0, options.segments + 1)).s
    for jump in jumps:
        assert np.min(np.abs(nodes - jump / 2)) < 1e-15


def test_jumps_too_near_for_any_mesh_are_refused():
    with pytest.raises(ValueError, match=r"segments = 5001 or more, and the finest mesh of 512 segments"):
        rj.solve(layered([1.0, 1.00002]))
    with pytest.raises(ValueError, match=r"segments = 4 or more, and segments = 3"):
        rj.solve(layered([0.5, 1.0, 1.5]), segments=3)
