"""Scenes at the edge of what numbers and geometry allow: each ends in the right shape, or in a status that says why."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Free, Guess, Pin, Rod, Scene, frame

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)
BACK = (-1.0, 0.0, 0.0)
SEGMENTS = 16


def rod(EA: float = 4e4, unit: float = 1.0) -> Rod:
    """EI = 1 N m^2 and L = 1 m, where `unit` is 1 m; all lengths in that unit, and forces in N."""
    return Rod(unit, unit**2, unit**2 / 1.3, EA, mass_per_length=1 / unit)


def clamps(end: tuple[float, ...], tangent: tuple[float, ...] = X, d2=Z, **options) -> Scene:
    return Scene(rod(), Clamp(ORIGIN, frame(X, Z)), Clamp(end, frame(tangent, d2)), **options)


def solved(scene: Scene, **options) -> rj.Equilibrium:
    result = rj.solve(scene, **({"segments": SEGMENTS, "strain_limit": None} | options))
    assert result.converged
    assert result.stable
    for leaf in jax.tree.leaves(result):
        assert np.all(np.isfinite(leaf))
    return result


# --- reach -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("span", [1 - 1e-9, 1.0, 1 + 1e-9, 1.1])
@pytest.mark.parametrize("support", ["clamps", "pins"])
def test_a_span_as_long_as_the_rod_or_longer(span, support):
    """Straight, under the tension EA (span - L)/L; 1e-9 L of slack is less than Euler's load takes out of the rod."""
    end = (span, 0.0, 0.0)
    result = solved(clamps(end) if support == "clamps" else Scene(rod(), Pin(ORIGIN), Pin(end)))
    # To a residual of 1e-8 EI/L^2.
    np.testing.assert_allclose(result.end_force, (4e4 * (span - 1), 0, 0), atol=1e-7, rtol=1e-10)
    np.testing.assert_allclose(result.nodes, np.outer(span * result.s, X), atol=1e-11)


def test_twenty_turns_on_a_taut_rod():
    """Straight as long as M^2 < 4 EI T: the couple 40 pi GJ/L = 97 N m, the tension 4000 N."""
    result = solved(clamps((1.1, 0, 0), turns=20))
    assert result.total_twist == pytest.approx(40 * np.pi, abs=1e-9)
    np.testing.assert_allclose(result.end_moment, (40 * np.pi / 1.3, 0, 0), atol=1e-6)
    np.testing.assert_allclose(result.nodes[:, 1:], 0, atol=1e-9)


def test_nothing_acts_and_derivatives_are_finite():
    result = solved(Scene(rod(), Clamp(ORIGIN, frame(X)), Free()))
    assert result.iterations == 0
    assert result.energy == 0

    def tip(force):
        scene = Scene(rod(), Clamp(ORIGIN, frame(X)), Free(force=force))
        return rj.solve(scene, segments=SEGMENTS).nodes[-1]

    compliance = jax.jacfwd(tip)(jnp.zeros(3))
    # L/EA along the rod, L^3/(3 EI) across; elements reproduce the cubic up to Simpson's rule: h^4.
    np.testing.assert_allclose(compliance, np.diag([1 / 4e4, 1 / 3, 1 / 3]), atol=1e-5)


# --- opposite and coincident ends ------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", [(0.5, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_opposite_end_tangents(end):
    """A loop from one clamp to the other, in a plane, balanced."""
    result = solved(clamps(end, BACK))
    sideways = np.linalg.svd(np.asarray(result.nodes))[2][2]
    np.testing.assert_allclose(result.nodes @ sideways, 0, atol=1e-8)
    assert result.total_twist == pytest.approx(0, abs=1e-7)
    # To the residual of 1e-8, over the length of the rod.
    carried = result.end_moment + np.cross(end, result.end_force)
    np.testing.assert_allclose(carried, result.start_moment, atol=1e-6)


def test_end_frames_half_a_turn_apart():
    """The two ways to turn are equally near: one is taken."""
    result = solved(clamps((0.8, 0, 0), d2=(0.0, 0.0, -1.0)))
    turned = abs(float(result.total_twist))
    assert turned > 0.5
    again = solved(clamps((0.8, 0, 0), d2=(0.0, 0.0, -1.0)))
    np.testing.assert_array_equal(result.nodes, again.nodes)


def test_a_closed_ring():
    result = solved(clamps(ORIGIN))
    # A circle: curvature 2 pi/L and energy 2 pi^2 EI/L, as 16 elements make it.
    np.testing.assert_allclose(result.curvature, 2 * np.pi, rtol=1e-4)
    assert result.energy == pytest.approx(2 * np.pi**2, rel=1e-5)
    assert result.neutral


@pytest.mark.parametrize("turns", [1, 2])
def test_a_twisted_ring(turns):
    """Beyond Zajac's 2 pi sqrt(3) EI/GJ of twist, 2.25 turns here, a ring is a circle no more."""
    result = solved(clamps(ORIGIN, turns=turns), segments=32)
    # To the residual; the circle as 32 elements make it.
    assert result.total_twist == pytest.approx(2 * np.pi * turns, abs=1e-6)
    np.testing.assert_allclose(result.curvature, 2 * np.pi, rtol=1e-4)


def test_a_ring_buckles_at_zajacs_twist():
    """2 pi sqrt(3) EI/GJ (Zajac 1962): a thousandth below it the plane ring is a minimum that the solver keeps, a
    thousandth above a saddle that it leaves."""
    angle = np.linspace(0, 2 * np.pi, 129)
    circle = np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1) / (2 * np.pi)
    critical = 2 * np.pi * np.sqrt(3) * 1.3
    flatness = []
    for part, index in ((0.999, 0), (1.001, 2)):  # a mode and the same a quarter of the ring further
        twist = part * critical
        scene = clamps(ORIGIN, d2=(0.0, -np.sin(twist), np.cos(twist)))
        plane = rj.solve(scene, segments=32, guess=Guess(circle, twist), find="equilibrium", strain_limit=None)
        assert plane.converged
        assert plane.index == index
        kept = solved(scene, segments=32, guess=plane)
        flatness.append(np.linalg.svd(np.asarray(kept.nodes) - np.mean(kept.nodes, axis=0, keepdims=True))[1][2])
    # Rounding alone; beyond, the ring snaps through itself or bows by far more.
    assert flatness[0] < 1e-7
    assert kept.total_twist < twist - np.pi or flatness[1] > 1e-3


# --- meshes and guesses ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("segments", "discretization"), [(1, "hermite"), (2, "hermite"), (2, "finite_difference")])
@pytest.mark.parametrize("end", ["clamp", "free", "pin"])
def test_the_coarsest_meshes(segments, discretization, end):
    ends = {"clamp": Clamp((0.8, 0.1, 0), frame(X)), "free": Free(), "pin": Pin((0.8, 0.1, 0))}
    scene = Scene(rod(), Clamp(ORIGIN, frame(X)), ends[end], gravity=(0, 0, -5))
    result = solved(scene, segments=segments, discretization=discretization)
    assert result.nodes.shape == (segments + 1, 3)
    # The whole weight is held, on any mesh.
    np.testing.assert_allclose(result.start_force - result.end_force, (0, 0, -5), atol=1e-7)


def test_the_least_number_of_segments_is_said():
    scene = clamps((0.8, 0, 0))
    with pytest.raises(ValueError, match="segments must be a whole number from 1 to 100000, got 0"):
        rj.solve(scene, segments=0)
    with pytest.raises(ValueError, match="segments must be a whole number from 2 to 100000, got 1"):
        rj.solve(scene, segments=1, discretization="finite_difference")


THERE = np.linspace(ORIGIN, (0.5, 0, 0), 9)


@pytest.mark.parametrize(
    "points",
    [np.concatenate([THERE, THERE[-2::-1]]), np.array([ORIGIN, (0.1, 0, 0)] * 8 + [ORIGIN]), np.zeros((17, 3))],
    ids=["hairpin", "zigzag", "point"],
)
@pytest.mark.parametrize("discretization", ["hermite", "finite_difference"])
def test_antiparallel_neighbours_in_a_guess(points, discretization):
    result = solved(clamps((0.3, 0, 0)), guess=Guess(points), discretization=discretization)
    assert np.max(result.curvature) < 50


# --- stiffness and units ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("EA", [1e2, 1e4, 1e6, 1e8, 1e10, 1e12])
def test_stretch_from_soft_to_stiff(EA):
    """The shape tends to that of the inextensible rod as 1/EA does; Newton's iterations do not depend on it."""

    def scene(EA):
        return Scene(rod(EA), Clamp(ORIGIN, frame(X)), Clamp((0.8, 0.1, 0), frame(Y, Z)), gravity=(0, 0, -50))

    result, stiff = solved(scene(EA)), solved(scene(1e13))
    assert result.iterations <= 6
    # Strains are 50 N/EA.
    np.testing.assert_allclose(result.nodes, stiff.nodes, atol=max(50 / EA, 1e-10))


@pytest.mark.parametrize("discretization", ["hermite", "finite_difference"])
@pytest.mark.parametrize("unit", [1e-6, 1e3, 1e6])
def test_units_do_not_matter(unit, discretization):
    """In metres, in um (a rod of 1 um) and in km, with the same forces: same iterations, same shape to rounding."""

    def scene(unit):
        start = Clamp(ORIGIN, frame(X))
        end = Clamp((0.6 * unit, 0.2 * unit, 0), frame((1, 1, 0.5)))
        return Scene(rod(unit=unit), start, end, gravity=(0, 0, -30))

    given, scaled = (solved(scene(unit), discretization=discretization) for unit in (1.0, unit))
    assert given.iterations == scaled.iterations
    assert given.evaluations == scaled.evaluations
    np.testing.assert_allclose(scaled.nodes / unit, given.nodes, atol=1e-10)
    np.testing.assert_allclose(scaled.end_force, given.end_force, rtol=1e-10)
    np.testing.assert_allclose(scaled.end_moment / unit, given.end_moment, atol=1e-10)
    assert scaled.energy / unit == pytest.approx(float(given.energy), rel=1e-10)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_units_of_force_do_not_matter(unit):
    def scene(unit):
        stiff = Rod(1.0, unit, unit / 1.3, 4e4 * unit, mass_per_length=unit)
        return Scene(stiff, Clamp(ORIGIN, frame(X)), Clamp((0.6, 0.2, 0), frame((1, 1, 0.5))), gravity=(0, 0, -30))

    given, scaled = solved(scene(1.0)), solved(scene(unit))
    assert given.iterations == scaled.iterations
    np.testing.assert_allclose(scaled.nodes, given.nodes, atol=1e-10)
    np.testing.assert_allclose(scaled.end_force / unit, given.end_force, rtol=1e-10)


# --- what cannot be solved says why ----------------------------------------------------------------------------------


def test_a_rod_that_its_load_presses_to_nothing():
    """Standing on end under 30 times the load that EA bears: no equilibrium of a rod, whatever the numbers say."""
    weak = Rod(1.0, 1.0, 1 / 1.3, 1e2, mass_per_length=1.0)
    scene = Scene(weak, Clamp(ORIGIN, frame(Z, X)), Free(), gravity=(0, 0, -3000))
    result = rj.solve(scene, segments=SEGMENTS, find="equilibrium", strain_limit=None)
    assert "EA is too small" in rj.describe(result)


@pytest.mark.parametrize("slenderness", [10.0, 1e3, 1e6])
def test_single_precision(slenderness):
    """Shape and force to 1e-4 at any slenderness; the status says that the tolerance of 1e-8 was out of reach."""
    cable = Rod(1.0, 1.0, 2 / 3, 4 * slenderness**2, mass_per_length=60 / 9.81)
    scene = rj.problems.hanging_cable(rod=cable)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), scene)
    exact, rounded = (solved(scene, segments=SEGMENTS) for scene in (scene, single))
    assert rounded.nodes.dtype == jnp.float32
    assert rounded.status == rj.Status.ROUNDING_FLOOR
    np.testing.assert_allclose(rounded.nodes, exact.nodes, atol=1e-4)
    np.testing.assert_allclose(rounded.end_force, exact.end_force, atol=1e-4 * float(jnp.max(jnp.abs(exact.end_force))))
