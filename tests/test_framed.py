"""Rods whose frames are unknown, against closed forms, the elastica and the rods whose tangents suffice."""

import dataclasses
import functools
import math
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import Through, by_numpy
from scipy.integrate import solve_ivp

import rodjax as rj
from rodjax.discretization.nonconservative import conservative
from rodjax.solving.result_form import form_and_point

DISCRETIZATIONS = ("hermite", "finite_difference")
LEVEL = rj.frame((1, 0, 0))
START = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0.3)))
END = rj.Clamp((0.7, 0.1, 0), rj.frame((1, 0.5, -0.3), d2=(0, 1, 1)))
HEAVY = (0, 0, -50)
FORCE, MOMENT = (0.1, 2.0, -1.0), (0.5, 1.0, -1.0)
# Every pair of supports, every load that both kinds of rods know.
SCENES = {
    "clamps": lambda rod: rj.Scene(rod, START, END, HEAVY, point_forces=[rj.PointForce(0.37, (0, 3, -8))]),
    "turns": lambda rod: rj.Scene(rod, START, END, turns=1),
    "swivel": lambda rod: rj.Scene(rod, rj.Swivel((0, 0, 0), (1, 0, 0.3)), END, HEAVY),
    "pins": lambda rod: rj.Scene(rod, rj.Pin((0, 0, 0)), rj.Pin((0.7, 0.1, 0)), HEAVY),
    "pin and clamp": lambda rod: rj.Scene(rod, rj.Pin((0, 0, 0)), END),
    "free": lambda rod: rj.Scene(rod, START, rj.Free(force=FORCE), HEAVY),
    "free start": lambda rod: rj.Scene(rod, rj.Free(force=FORCE), START, HEAVY),
    "moment": lambda rod: rj.Scene(rod, START, rj.Free(moment=MOMENT)),
    "moment at the start": lambda rod: rj.Scene(rod, rj.Free(moment=MOMENT), START, HEAVY),
}
FIELDS = ("nodes", "energy", "elastic_energy", "start_force", "start_moment", "end_force", "end_moment")


def isotropic(pair: bool) -> rj.Rod:
    return rj.Rod(1.0, (1.0, 1.0) if pair else 1.0, 0.7, 1e4, mass_per_length=0.1)


def largest_difference(a: rj.Equilibrium, b: rj.Equilibrium, fields=FIELDS) -> float:
    """Of the fields, relative to the size of each."""
    differences = []
    for field in fields:
        x, y = np.asarray(getattr(a, field)), np.asarray(getattr(b, field))
        differences.append(np.max(np.abs(x - y)) / max(np.max(np.abs(x)), 1.0))
    return max(differences)


def compare(scene, discretization: str, segments: int, tolerance: float, has_estimate: bool = False) -> None:
    plain = rj.solve(scene(isotropic(False)), segments=segments, discretization=discretization)
    framed = rj.solve(scene(isotropic(True)), segments=segments, discretization=discretization)
    assert plain.converged
    assert framed.converged
    assert plain.stable == framed.stable
    assert largest_difference(plain, framed) < tolerance
    if has_estimate:
        # Of the mesh, the same; both estimates are good to some percent.
        assert framed.error_estimate == pytest.approx(float(plain.error_estimate), rel=0.5)


def test_equal_stiffnesses_give_the_rod_of_one():
    # The same finite differences in other unknowns, to the solver's tolerance of 1e-8 EI/L^2.
    compare(SCENES["clamps"], "finite_difference", 12, 1e-8, has_estimate=True)


def cases(names: list[str], in_ci: set[str]) -> list:
    return [pytest.param(name, marks=() if name in in_ci else pytest.mark.exhaustive) for name in names]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", cases([name for name in SCENES if not name.startswith("moment")], {"turns", "pins", "free start"})
)
def test_equal_stiffnesses_give_the_rod_of_one_by_differences(name):
    compare(SCENES[name], "finite_difference", 12, 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", cases([name for name in SCENES if name != "turns"], {"clamps", "swivel", "pins", "free start", "moment"})
)
def test_equal_stiffnesses_give_the_rod_of_one_by_elements(name):
    # Other elements, both of fourth order: 32 of them are off by some 1e-7.
    compare(SCENES[name], "hermite", 32, 2e-6, has_estimate=name == "clamps")


# --- stiffness, derivatives and stability, beside the rod of one stiffness -------------------------------------------

# The same finite differences, to what the solver's tolerance leaves in derivatives.
CLOSE = {"segments": 12, "discretization": "finite_difference", "solver": rj.Newton(tolerance=1e-11)}


@pytest.fixture(scope="module")
def stiffnesses() -> tuple[np.ndarray, np.ndarray]:
    """At the end, of the pair and of the plain rod."""
    pair, plain = (np.asarray(rj.end_stiffness(SCENES["clamps"](isotropic(pair)), **CLOSE)) for pair in (True, False))
    return pair, plain


@pytest.mark.slow
def test_the_end_stiffness_is_that_of_the_rod_of_one(stiffnesses):
    pair, plain = stiffnesses
    assert pair.shape == (6, 6)
    largest = np.max(np.abs(plain))
    np.testing.assert_allclose(pair, pair.T, rtol=0, atol=1e-8 * largest)
    np.testing.assert_allclose(pair, plain, rtol=0, atol=1e-7 * largest)


@pytest.mark.slow
def test_the_end_stiffness_is_the_hessian_of_the_energy(stiffnesses):
    scene = SCENES["clamps"](isotropic(True))
    guess = rj.solve(scene, **CLOSE)

    def energy(displacement):
        end = rj.Clamp(scene.end.position + displacement, scene.end.frame)
        return rj.solve(eqx.tree_at(lambda scene: scene.end, scene, end), guess=guess, **CLOSE).energy

    # Column by column: of all at once derivatives and their transposes would be traced once more, batched.
    column = by_numpy(lambda at, one: jax.jvp(jax.grad(energy), (at,), (one,))[1])
    hessian = np.stack([column(np.zeros(3), one) for one in np.eye(3)], axis=1)
    largest = np.max(np.abs(hessian))
    np.testing.assert_allclose(hessian, stiffnesses[0][:3, :3], rtol=0, atol=1e-8 * largest)


@pytest.mark.slow
def test_sensitivities_are_those_of_the_rod_of_one():
    of, wrt = ["nodes", "end_force", "energy"], ["rod.GJ", "rod.EA", "end.frame", "gravity", "point_forces.0.force"]
    pair, plain = (
        rj.sensitivities(SCENES["clamps"](isotropic(pair)), of=of, wrt=wrt, **CLOSE) for pair in (True, False)
    )
    for field in of:
        for number in wrt:
            expected = np.asarray(plain[field][number])
            size = max(float(np.max(np.abs(expected))), 1e-6)
            np.testing.assert_allclose(pair[field][number], expected, rtol=0, atol=1e-6 * size, err_msg=number)


@pytest.mark.slow
def test_a_saddle_is_that_of_the_rod_of_one():
    """A straight strut between a clamp and a free end beyond pi^2/4 EI/L^2, which could bend in both planes."""
    clamp, push = rj.Clamp((0, 0, 0), LEVEL), rj.Free(force=(-5.0, 0, 0))
    straight = rj.Guess(np.linspace((0, 0, 0), (1, 0, 0), 5))
    pair, plain = (
        rj.solve(rj.Scene(isotropic(pair), clamp, push), segments=12, guess=straight, find="equilibrium")
        for pair in (True, False)
    )
    assert pair.converged
    assert not pair.stable
    assert pair.index == plain.index == 2
    modes = rj.lowest_mode(pair), rj.lowest_mode(plain)
    # EA = 1e4: the strut is shorter by 5e-4.
    assert modes[0].stiffness == pytest.approx(math.pi**2 / 4 - 5, abs=5e-3)
    assert modes[0].stiffness == pytest.approx(float(modes[1].stiffness), abs=1e-5)
    sizes = [np.linalg.norm(mode.displacement, axis=1) for mode in modes]
    np.testing.assert_allclose(*sizes, rtol=0, atol=1e-5)


def test_bad_input_for_frames_is_refused():
    scene = SCENES["clamps"](isotropic(True))
    with pytest.raises(ValueError, match="solver must be a Newton for a rod"):
        rj.solve(scene, segments=8, solver=rj.NonlinearCG())


# --- closed forms and references -------------------------------------------------------------------------------------


def bend(load: float) -> rj.Scene:
    """The 45-degree bend of Bathe & Bolourchi (1979): an eighth of a circle of radius 100, a unit square, E = 1e7."""
    E = 1e7
    rod = rj.Rod(25 * math.pi, (E / 12, E / 12), E / 12, E, rest_curvature=(0, 0.01))
    return rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0), d2=(0, 0, 1))), rj.Free(force=(0, 0, load)))


@pytest.mark.slow
def test_the_45_degree_bend():
    """Displacements of the tip, Kirchhoff's limit of unshearable rods; fourth order."""
    tip = 100 * np.array([math.sin(math.pi / 4), 1 - math.cos(math.pi / 4), 0])
    expected = {
        300: (-11.930430, -7.044033, 40.189388),
        450: (-18.470639, -10.780573, 48.500107),
        600: (-23.558528, -13.603966, 53.471763),
    }
    for load, displacement in expected.items():
        result = rj.solve(bend(load), segments=32)
        # The reference has GJ = EI = 8.3333e5 in the place of E/12.
        np.testing.assert_allclose(result.nodes[-1] - tip, displacement, rtol=1e-5)
        assert result.stable
    tips = [np.asarray(rj.solve(bend(600), segments=n).nodes[-1]) for n in (8, 16, 32)]
    errors = [np.linalg.norm(reached - tips[2]) for reached in tips[:2]]
    assert 3.5 < math.log2(errors[0] / errors[1]) < 4.5


@pytest.mark.slow
def test_the_princeton_beam():
    """Dowell, Traybar & Hodges (1977): a strip, its load at 45 degrees to its axes; Kirchhoff's limit."""
    rod = rj.Rod(0.508, (2.42887, 36.2855), 3.10401, 2.84e6)
    angle = math.pi / 4
    frame = rj.frame((1, 0, 0), d2=(0, math.sin(angle), math.cos(angle)))
    for load, expected in ((8.896, (8.884e-3, 109.033e-3)), (13.345, (15.334e-3, 156.576e-3))):
        result = rj.solve(rj.Scene(rod, rj.Clamp((0, 0, 0), frame), rj.Free(force=(0, 0, -load))), segments=32)
        displacement = np.abs(np.asarray(frame).T @ np.asarray(result.nodes[-1] - np.array([0.508, 0, 0])))[:2]
        np.testing.assert_allclose(displacement, expected, rtol=1e-4)


@pytest.mark.slow
def test_lateral_torsional_buckling_of_a_narrow_cantilever():
    """P L^2/sqrt(EI GJ) = 4.012599 at the tip, Timoshenko & Gere sec. 6.3, in the limit of an infinite EI1."""
    rod = rj.Rod(1.0, (1e4, 1.0), 1.0, 1e7)
    clamp = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0), d2=(0, 0, 1)))
    scenes = [rj.Scene(rod, clamp, rj.Free(force=(0, 0, -load))) for load in (3.0, 5.0)]
    point = rj.critical_point(scenes, segments=32)
    assert point.kind == "branch"
    assert 3 + 2 * float(point.parameter) == pytest.approx(4.012599, rel=1e-3)


def helix(radius: float, pitch: float, s: float) -> rj.Clamp:
    """Position and frame (binormal, minus normal, tangent) of a helix of this radius and pitch angle."""
    angle = s * math.cos(pitch) / radius
    position = (radius * math.cos(angle), radius * math.sin(angle), s * math.sin(pitch))
    tangent = np.array([-math.cos(pitch) * math.sin(angle), math.cos(pitch) * math.cos(angle), math.sin(pitch)])
    normal = np.array([-math.cos(angle), -math.sin(angle), 0])
    binormal = np.cross(tangent, normal)
    return rj.Clamp(position, np.stack([binormal, np.cross(tangent, binormal), tangent], axis=1))


@pytest.mark.slow
def test_a_helical_spring_pulled_and_twisted():
    """Love, "Mathematical theory of elasticity", secs. 270-271: from one helix to another of the same length."""
    radius, pitch, turns, EI, GJ = 1.0, 0.3, 5, 1.0, 0.77
    length = 2 * math.pi * turns * radius / math.cos(pitch)

    def strains(radius, pitch):
        return math.cos(pitch) ** 2 / radius, math.sin(pitch) * math.cos(pitch) / radius

    curvature, twist = strains(radius, pitch)
    rod = rj.Rod(length, (EI, EI), GJ, 1e9, rest_curvature=(curvature, 0), rest_twist=twist)
    rest = rj.solve(rj.Scene(rod, helix(radius, pitch, 0), helix(radius, pitch, length)), segments=160)
    assert rest.iterations == 0
    part = np.linspace(0, 1, 6)
    radii, pitches = radius * (1 - 0.05 * part), pitch + 0.25 * part
    scenes = [rj.Scene(rod, helix(r, p, 0), helix(r, p, length)) for r, p in zip(radii, pitches, strict=True)]
    path = rj.solve_path(scenes, segments=160, guess=rest)
    assert np.all(path.converged)
    last = jax.tree.map(lambda leaf: leaf[-1], path)
    r, p = radii[-1], pitches[-1]
    bending, torque = (k * (a - b) for k, a, b in zip((EI, GJ), strains(r, p), (curvature, twist), strict=True))
    force = (torque * math.cos(p) - bending * math.sin(p)) / r
    couple = torque * math.sin(p) + bending * math.cos(p)
    about_axis = last.end_moment[2] + np.cross(last.nodes[-1], last.end_force)[2]
    # 32 elements a turn, of fourth order.
    assert last.end_force[2] == pytest.approx(force, rel=2e-6)
    assert about_axis == pytest.approx(couple, rel=2e-6)


@pytest.mark.slow
def test_a_jump_of_stiffness_keeps_fourth_order():
    rod = rj.Rod(1.0, rj.Steps([0.5], [1.0, 4.0]), rj.Steps([0.5], [1.0, 2.0]), 1e5)
    scene = rj.Scene(rod, rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((0.7, 0.1, 0.05), rj.frame((1, 0.5, 0.3))))
    results = {n: rj.solve(scene, segments=n) for n in (16, 32, 128)}
    errors = [float(np.linalg.norm(results[n].end_force - results[128].end_force)) for n in (16, 32)]
    assert 3.5 < math.log2(errors[0] / errors[1]) < 4.6


def test_a_jump_off_the_nodes_keeps_second_order_by_differences():
    """A cantilever of two halves under so small a load that beam theory is exact, w'' = q (1 - s)^2/(2 EI)."""
    rod = rj.Rod(1.0, rj.Steps([0.5], [1.0, 4.0]), 1.0, 1e8)
    clamp = rj.Clamp((0, 0, 0), LEVEL)
    scene = rj.Scene(rod, clamp, rj.Free(), distributed=[rj.DistributedForce((0, 0, -1e-3))])
    s = np.linspace(0, 1, 100_001)
    # The tip sinks by the moments of the curvatures about it.
    expected = float(np.trapezoid(np.where(s < 0.5, 1.0, 0.25) * 1e-3 * (1 - s) ** 3 / 2, s))
    errors = [
        abs(float(rj.solve(scene, segments=n, discretization="finite_difference").nodes[-1, 2]) / -expected - 1)
        for n in (9, 19)
    ]
    assert errors[1] < errors[0] / 3.4
    assert errors[1] < 5e-3


def space_curve() -> tuple[np.ndarray, rj.Rod]:
    t = np.linspace(0, 1, 41)
    points = np.stack([np.cos(5 * t), np.sin(4 * t), 0.5 * t + 0.2 * np.sin(7 * t)], axis=1)
    return points, rj.Rod.from_centerline(points, (1.0, 2.0), 0.7, 1e5)


@pytest.mark.slow
@pytest.mark.parametrize("discretization", DISCRETIZATIONS)
def test_a_curve_without_stress_stays_where_it_is_and_comes_back(discretization):
    points, rod = space_curve()
    (begin, first), (end, last) = by_numpy(rj.Rod.rest_ends)(rod)
    np.testing.assert_allclose(end, points[-1], rtol=0, atol=1e-14)
    rotated = by_numpy(rj.rotate)
    scenes = [
        rj.Scene(
            rod,
            rj.Clamp(begin, first),
            rj.Clamp(end + part * np.array([0.1, 0.2, -0.3]), rotated(last, part * np.array([0.5, 0.2, 0.1]))),
        )
        for part in (0.0, 0.5, 1.0, 0.5, 0.0)
    ]
    path = rj.solve_path(scenes, segments=20, discretization=discretization)
    assert np.all(path.converged)
    assert path.iterations[0] == 0
    assert path.residual[0] < 1e-9
    assert path.elastic_energy[0] < 1e-20
    assert path.elastic_energy[2] > 1e-2
    np.testing.assert_allclose(path.nodes[-1], path.nodes[0], rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("discretization", "curvature", "most"),
    [
        ("hermite", (2.0, 0.0), 1e-8),  # 1.36 before the ways at rest counted by the curvature there is
        ("hermite", (1.0, 1.5), 1e-8),  # 0.90
        ("hermite", (rj.Smooth((0, 0.5, 1.0), (-1.0, 1.0, 3.0)), 0.0), 1e-4),  # 3.04
        ("finite_difference", (2.0, 0.0), 0.1),  # 2600
    ],
)
def test_a_curved_rod_held_straight_has_the_tension_of_a_straight_one(discretization, curvature, most):
    """EA (d - 1), constant along the rod: its way is that of its straight tangents, for which no quadrature errs."""
    rod = rj.Rod(1.0, (1.0, 1.3), 0.7, 1e6, rest_curvature=curvature)
    for span in (1.0, 1.001):
        ends = [rj.Clamp((x, 0, 0), rj.frame((1, 0, 0))) for x in (0.0, span)]
        found = rj.solve(rj.Scene(rod, *ends), segments=8, discretization=discretization)
        assert found.converged
        np.testing.assert_allclose(found.tension, 1e6 * (span - 1), rtol=0, atol=most)


@pytest.mark.slow
@pytest.mark.parametrize("discretization", ["hermite", pytest.param("finite_difference", marks=pytest.mark.exhaustive)])
def test_derivatives_by_rest_shape_stiffnesses_and_jumps(discretization):
    """Beside fourth-order finite differences of the same mesh."""

    def scene_of(x):
        k1, k2, twist, EI1, EI2, jump, other_jump = x
        rod = rj.Rod(
            1.0,
            (rj.Steps([jump], [EI1, 3.0]), EI2),
            rj.Steps([other_jump], [1.0, 0.5]),
            1e4,
            mass_per_length=0.3,
            rest_curvature=(k1, k2),
            rest_twist=twist,
        )
        end = rj.Clamp((0.7, 0.1, 0.05), rj.frame((1, 0.5, 0.3)))
        return rj.Scene(rod, rj.Clamp((0, 0, 0), LEVEL), end, gravity=(0, 0, -9.8))

    def solve(scene):
        # What the usual tolerance of 1e-8 leaves would be seen in the differences.
        solver = rj.Newton(tolerance=1e-12)
        return rj.solve(scene, segments=8, discretization=discretization, solver=solver, guess=base)

    base = None
    force = Through(scene_of, solve, lambda result: result.end_force)
    at = np.array([2.0, -1.0, 1.0, 1.0, 2.0, 0.4, 0.6])
    base = solve(force.made(at))
    # By the transpose of the derivative, row by row: of all at once a program of its own would be traced, batched.
    pulled = force.pulled(at)
    reverse = np.stack([pulled(one) for one in np.eye(3)])
    for k in range(len(at)):
        h = 5e-4 * np.eye(len(at))[k]
        near, far = force(at + h) - force(at - h), force(at + 2 * h) - force(at - 2 * h)
        differences = (8 * near - far) / (12 * 5e-4)
        np.testing.assert_allclose(reverse[:, k], differences, rtol=0, atol=1e-7 * float(np.max(np.abs(differences))))


class TwoSlopes(rj.Law):
    """Bending stiffness that falls from `EI` to `softer` beyond the curvature `at`."""

    EI: jax.Array
    softer: jax.Array
    at: jax.Array

    def __call__(self, curvature, twist, axial_strain, s):
        squared = jnp.sum(curvature**2)
        bending = self.softer / 2 * squared
        bending += (self.EI - self.softer) * self.at * (jnp.sqrt(squared + self.at**2) - self.at)
        return bending + 0.7 / 2 * twist**2 + 1e5 / 2 * axial_strain**2


def test_places_between_nodes_are_as_accurate_as_the_nodes():
    rod = rj.Rod(1.0, (1.0, 2.0), 0.7, 1e4, mass_per_length=0.1)
    fine, coarse = (rj.solve(rj.Scene(rod, START, END, HEAVY), segments=segments) for segments in (96, 24))
    between = np.linspace(0, 1, 481)
    off = [np.linalg.norm(coarse.position_at(s) - fine.position_at(s), axis=1).max() for s in (coarse.s, between)]
    # 1.35 times as far off were seen, 2.4 times by cubics.
    assert off[1] < 1.5 * off[0]


@pytest.mark.slow
def test_a_law_of_two_slopes():
    law = TwoSlopes(jnp.array(1.0), jnp.array(0.2), jnp.array(2.0))
    rod = rj.Rod(1.0, 1.0, 0.7, 1e5, law=law)
    clamp = rj.Clamp((0, 0, 0), LEVEL)
    result = rj.solve(rj.Scene(rod, clamp, rj.Free(force=(0, 0, 2.0))), segments=16)
    assert result.converged
    assert result.stable
    # The moment is that of the law at the curvature.
    curvature = float(result.curvature[0])
    moment = 0.2 * curvature + 0.8 * 2.0 * curvature / math.sqrt(curvature**2 + 4)
    assert float(np.linalg.norm(result.start_moment)) == pytest.approx(moment, rel=1e-9)

    # Against the elastica of that law, inextensible as far as 1e5 goes.
    def slope(s, y):
        _, _, angle, curvature = y
        change = -2.0 * math.cos(angle) / (0.2 + 0.8 * 8.0 / (curvature**2 + 4) ** 1.5)
        return [math.cos(angle), math.sin(angle), curvature, change]

    reached = solve_ivp(slope, (0, 1), (0, 0, 0, curvature), rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(result.nodes[-1, [0, 2]], reached[:2], rtol=0, atol=3e-5)
    assert abs(reached[3]) < 3e-5

    def made(at):
        law = TwoSlopes(jnp.array(1.0), jnp.array(0.2), at)
        return rj.Scene(rj.Rod(1.0, 1.0, 0.7, 1e5, law=law), clamp, rj.Free(force=(0, 0, 2.0)))

    tip = Through(made, functools.partial(rj.solve, segments=16), lambda result: result.nodes[-1, 2])
    at = np.array(2.0)
    differences = (tip(at + 1e-4) - tip(at - 1e-4)) / 2e-4
    assert float(tip.change(at, np.array(1.0))) == pytest.approx(float(differences), rel=1e-6)


# --- loads without a potential ---------------------------------------------------------------------------------------


def elastica_from_the_end(end_force: float, pressure: float) -> np.ndarray:
    """17 points of a cantilever under a force and a pressure at right angles to it, from the end on in its axes."""

    def slope(_, y):
        _, _, angle, curvature, force_x, force_z = y
        pushed = pressure * -math.sin(angle), pressure * math.cos(angle)
        change = math.cos(angle) * force_z - math.sin(angle) * force_x
        return [-math.cos(angle), -math.sin(angle), -curvature, change, *pushed]

    begin, places = (0, 0, 0, 0, 0, end_force), np.linspace(0, 1, 17)
    x, z, angle = solve_ivp(slope, (0, 1), begin, t_eval=places, rtol=1e-12, atol=1e-13).y[:3, ::-1]
    x, z, cosine, sine = x - x[0], z - z[0], math.cos(-angle[0]), math.sin(-angle[0])
    return np.stack([cosine * x - sine * z, 0 * x, sine * x + cosine * z], axis=1)


@pytest.mark.parametrize(
    "load", [{"end": rj.Free((0, 0, 1), follower=True)}, {"distributed": [rj.DistributedCouple((0, 1, 0))]}]
)
def test_finite_differences_are_refused_under_loads_without_a_potential(load):
    scene = rj.Scene(isotropic(True), START, **({"end": rj.Free()} | load))
    with pytest.raises(ValueError, match="discretization must be 'hermite' under couples along the rod"):
        rj.solve(scene, segments=8, discretization="finite_difference")


def test_follower_loads_and_couples():
    """Inextensible references, of which EA = 1e6 is off by some 1e-6, and from which searches begin."""
    rod, clamp, tolerance = rj.Rod(1.0, 1.0, 0.7, 1e6), rj.Clamp((0, 0, 0), LEVEL), 3e-6

    def tip(end, distributed=(), near=None):
        guess = None if near is None else rj.Guess(near)
        result = rj.solve(rj.Scene(rod, clamp, end, distributed=distributed), segments=24, guess=guess)
        assert result.converged
        # No energy that could be minimal; its index, one code for all of them, of one: a program of some seconds.
        assert not result.stable
        assert distributed or result.index == -1
        return np.asarray(result.nodes[-1])

    # d1 points along -z.
    follower = rj.Free(force=(-5, 0, 0), follower=True)
    expected = elastica_from_the_end(5, 0)
    np.testing.assert_allclose(tip(follower, near=expected), expected[-1], rtol=0, atol=tolerance)
    pressure, expected = rj.DistributedForce((-8, 0, 0), follower=True), elastica_from_the_end(0, 8)
    np.testing.assert_allclose(tip(rj.Free(), [pressure], expected), expected[-1], rtol=0, atol=tolerance)
    # In a plane a couple of 2 a length bends to the angle 2 (s - s^2/2).
    s = np.linspace(0, 1, 20_001)
    angle = 2 * (s - s**2 / 2)
    expected = np.trapezoid(np.cos(angle), s), 0, np.trapezoid(np.sin(angle), s)
    couple = rj.DistributedCouple((0, -2, 0))
    np.testing.assert_allclose(tip(rj.Free(), [couple]), expected, rtol=0, atol=tolerance)


def test_loads_that_a_step_holds_are_those_of_its_gradient():
    """Of all kinds at once, at a bent point, beside a floor: the gradients with these loads and without."""
    tilted = np.array([0.3, -0.5, 0.7])
    loads = {
        "distributed": [rj.DistributedForce(tilted, follower=True), rj.DistributedCouple(tilted[::-1])],
        "point_forces": [rj.PointForce(0.5, 2 * tilted, follower=True)],
        "point_couples": [rj.PointCouple(0.25, tilted**2)],
    }
    end, floor = rj.Free(force=tilted, moment=-tilted, follower=True), rj.Plane((0, 0, -5), (0, 0, 1))
    rod = rj.Rod(1.0, (1.0, 2.0), 0.7, 1e4, radius=0.01)
    form, point = form_and_point(
        rj.solve(rj.Scene(rod, rj.Clamp((0, 0, 0), LEVEL), end, obstacles=[floor], **loads), segments=4)
    )
    without = dataclasses.replace(form, scene=conservative(form.scene))

    def at(point):
        moments = without.residual_vectors(point)[0] - form.residual_vectors(point)[0]
        return form.held_loads(point), moments, without.applied(point) - form.applied(point)

    held, moments, forces = by_numpy(at)(point)
    # Roundings of moments of about 1.
    np.testing.assert_allclose(held.moments, moments, rtol=0, atol=1e-12)
    np.testing.assert_allclose(held.forces, forces, rtol=0, atol=1e-12)
    assert np.max(np.abs(held.moments)) > 0.1
    assert np.max(np.abs(held.forces)) > 0.1


@pytest.mark.slow
def test_batches_of_general_rods():
    rods = [rj.Rod(1.0, (1.0, k), 0.7, 1e4, rest_curvature=(1.0, 0.0)) for k in (0.5, 1.0, 2.0)]
    scenes = [rj.Scene(rod, START, END) for rod in rods]
    batch = rj.solve_batch(scenes, segments=8)
    assert np.all(batch.converged)
    for k, scene in enumerate(scenes):
        alone = rj.solve(scene, segments=8)
        np.testing.assert_allclose(batch.nodes[k], alone.nodes, rtol=0, atol=1e-9)


def test_an_equilibrium_in_equilibrium_takes_no_iterations():
    """A warm start from itself gives back the same bits."""
    scene = SCENES["clamps"](isotropic(True))
    first = rj.solve(scene, segments=12, discretization="finite_difference")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = rj.solve(scene, segments=12, discretization="finite_difference", guess=first)
    assert again.iterations == 0
    np.testing.assert_array_equal(again.nodes, first.nodes)


@pytest.mark.slow
def test_a_column_under_a_tangential_force_flutters():
    """Beck's column: its two lowest frequencies meet at P = 20.05 EI/L^2, and there is no load at which it buckles."""
    rod, clamp = rj.Rod(2.0, 3.0, 2.0, 1e8, mass_per_length=0.5), rj.Clamp((0, 0, 0), LEVEL)
    unit = 3.0 / (0.5 * 2.0**4)

    def squares(load):
        end = rj.Free(force=(0, 0, -load * 3.0 / 4), follower=True)
        return rj.squared_frequencies(rj.solve(rj.Scene(rod, clamp, end), segments=32), 4) / unit

    # The cantilever's lowest is 3.51602, twice, in both planes; masses at 33 nodes leave 1e-3.
    np.testing.assert_allclose(squares(0.0)[:2], 2 * [3.51602**2], rtol=3e-3)
    # By finite differences too, without a follower load: of second order.
    clamped = rj.Rod(2.0, (3.0, 3.0), 2.0, 1e8, mass_per_length=0.5)
    by_edges = rj.solve(rj.Scene(clamped, clamp, rj.Free()), segments=32, discretization="finite_difference")
    np.testing.assert_allclose(rj.squared_frequencies(by_edges, 2) / unit, 2 * [3.51602**2], rtol=3e-3)
    below, above = squares(19.8), squares(20.3)
    assert np.max(np.abs(below.imag)) < 1e-6 * np.max(np.abs(below))
    assert np.min(below.real) > 0
    assert np.min(np.abs(above.imag)) > 1.0


@pytest.mark.slow
def test_frequencies_are_those_of_an_equilibrium():
    scene = SCENES["clamps"](isotropic(True))
    with pytest.warns(rj.NotConvergedWarning, match="largest number of iterations"):
        result = rj.solve(scene, segments=12, discretization="finite_difference", solver=rj.Newton(max_iterations=1))
    with pytest.raises(ValueError, match="equilibrium must be one: not converged: stopped at the largest number"):
        rj.squared_frequencies(result)


def test_frequencies_are_refused_where_the_tangents_suffice():
    result = rj.solve(SCENES["clamps"](isotropic(False)), segments=12, discretization="finite_difference")
    with pytest.raises(ValueError, match="equilibrium must be of a rod or loads that need frames"):
        rj.squared_frequencies(result)
