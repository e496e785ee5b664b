"""Section stiffnesses against their formulas, and what a rod refuses."""

import math

import jax
import numpy as np
import pytest

from rodjax import Rod


def test_circular_section():
    rod = Rod.circular(2.0, 0.005, 1e7, shear_modulus=4e6, density=1200)
    np.testing.assert_allclose(rod.EI, 1e7 * math.pi * 0.005**4 / 4, rtol=1e-15)
    np.testing.assert_allclose(rod.GJ, 4e6 * math.pi * 0.005**4 / 2, rtol=1e-15)
    np.testing.assert_allclose(rod.EA, 1e7 * math.pi * 0.005**2, rtol=1e-15)
    np.testing.assert_allclose(rod.mass_per_length, 1200 * math.pi * 0.005**2, rtol=1e-15)


def test_poisson_ratio_gives_the_shear_modulus():
    rod = Rod.circular(1.0, 0.005, 1e7, poisson_ratio=0.5)
    np.testing.assert_allclose(rod.GJ / rod.EI, 2 / 3, rtol=1e-15)


def test_tube_is_the_difference_of_two_rods():
    tube = Rod.tube(1.0, 0.01, 0.008, 1e7, poisson_ratio=0.3, density=1000)
    outer, inner = (Rod.circular(1.0, r, 1e7, poisson_ratio=0.3, density=1000) for r in (0.01, 0.008))
    for name in ("EI", "GJ", "EA", "mass_per_length"):
        np.testing.assert_allclose(getattr(tube, name), getattr(outer, name) - getattr(inner, name), rtol=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(length=-1.0), "length must be positive, got -1"),
        (dict(EI=0.0), "EI must be positive, got 0"),
        (dict(GJ=math.nan), "GJ must be finite, got nan"),
        (dict(EA=math.inf), "EA must be finite, got inf"),
        (dict(mass_per_length=-0.1), "mass_per_length must not be negative"),
        (dict(radius=0.0), "radius must be positive"),
        (dict(EI=(1.0, 2.0, 3.0)), "EI must be one or a pair, got 3 values"),
        (dict(GJ=(1.0, 2.0)), r"GJ must be a number, got an array of shape \(2,\)"),
        (dict(EI="stiff"), "EI must be a number, got 'stiff'"),
        (dict(EI=None), "EI must be a number, got None"),
    ],
)
def test_bad_rods_are_refused(arguments, message):
    good = dict(length=1.0, EI=1.0, GJ=1.0, EA=1.0)
    with pytest.raises((ValueError, TypeError), match=message):
        Rod(**(good | arguments))


@pytest.mark.parametrize("moduli", [{}, dict(shear_modulus=1.0, poisson_ratio=0.3)])
def test_exactly_one_of_shear_modulus_and_poisson_ratio(moduli):
    with pytest.raises(ValueError, match="exactly one of shear_modulus and poisson_ratio"):
        Rod.circular(1.0, 0.01, 1e7, **moduli)


@pytest.mark.parametrize("ratio", [-1.0, 0.6])
def test_poisson_ratio_out_of_range(ratio):
    with pytest.raises(ValueError, match="poisson_ratio"):
        Rod.circular(1.0, 0.01, 1e7, poisson_ratio=ratio)


def test_tube_without_a_wall():
    with pytest.raises(ValueError, match="outer_radius - inner_radius must be positive"):
        Rod.tube(1.0, 0.01, 0.01, 1e7, poisson_ratio=0.3)


def test_a_section_of_traced_numbers():
    def stiffness(radius, modulus):
        return Rod.tube(1.0, radius, 0.004, modulus, poisson_ratio=0.3).EI

    known = stiffness(0.005, 1e7)
    traced = jax.jit(stiffness)(0.005, 1e7)
    np.testing.assert_allclose(traced, known, rtol=1e-15)  # one formula; the compiler may reorder it
    slopes = jax.grad(stiffness, argnums=(0, 1))(0.005, 1e7)
    # EI = E pi/4 (R^4 - r^4)
    np.testing.assert_allclose(slopes, [1e7 * math.pi * 0.005**3, known / 1e7], rtol=1e-14)
    np.testing.assert_allclose(
        jax.vmap(stiffness, (None, 0))(0.005, np.array([1e7, 2e7])), [known, 2 * known], rtol=1e-15
    )
