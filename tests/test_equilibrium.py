"""solve(): conventions of forces and moments, warm starts, units, transformations, what it refuses."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Free, Pin, PointForce, Rod, Scene, Status, Swivel, frame, problems

SEGMENTS = 12
# Energies are differentiated by finite differences below: solve them as far as rounding allows.
TIGHT = rj.NonlinearCG(tolerance=1e-11)


def solve(scene: Scene, segments: int = SEGMENTS, **options) -> rj.Equilibrium:
    """By finite differences: what is tested here is quick to compile so; test_hermite.py has the like for elements."""
    return rj.solve(scene, segments=segments, discretization="finite_difference", **options)


def twisted_scene(rod: Rod | None = None) -> Scene:
    """Two clamps in general position, gravity, a point force and torsion."""
    rod = rod or problems.cable(20.0)
    end = Clamp((0.55, 0.15, 0.1), frame((1, 0.4, 0.3), (0.2, 1, 0.5)))
    load = PointForce(0.4 * rod.length, 0.5 * rod.EI * jnp.array([0.0, 1.0, 2.0]))
    start = Clamp((0.0, 0.0, 0.0), frame((1, 0, -1)))
    return Scene(rod, start, end, gravity=(0, 0, -9.81), point_forces=[load])


@pytest.fixture(scope="module")
def twisted() -> rj.Equilibrium:
    return solve(twisted_scene(), solver=TIGHT)


def moved_end(scene: Scene, which: str, shift, turn) -> Scene:
    clamp = getattr(scene, which)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    moved = Clamp(clamp.position + jnp.asarray(shift), jnp.asarray(rotation) @ clamp.frame)
    return eqx.tree_at(lambda scene: getattr(scene, which), scene, moved)


@pytest.mark.parametrize(("which", "sign"), [("end", 1), ("start", -1)])
def test_end_loads_are_derivatives_of_the_energy(twisted, which, sign):
    scene = twisted_scene()
    step = 1e-4
    for name, unit in (("force", float(scene.rod.length)), ("moment", 1.0)):
        measured = []
        for axis in np.eye(3):
            values = []
            # Fourth-order differences: truncation 1e-16 times the fifth derivative, rounding 1e-16/1e-4.
            for multiple in (-2, -1, 1, 2):
                small = multiple * step * axis * unit
                shift, turn = (small, np.zeros(3)) if name == "force" else (np.zeros(3), small)
                moved = moved_end(scene, which, shift, turn)
                values.append(float(solve(moved, guess=twisted, solver=TIGHT).energy))
            measured.append((values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step * unit))
        ours = getattr(twisted, f"{which}_{name}")
        np.testing.assert_allclose(sign * np.array(measured), ours, rtol=0, atol=1e-6 * float(jnp.linalg.norm(ours)))


def test_forces_and_moments_balance_over_the_rod(twisted):
    scene = twisted_scene()
    weight = scene.rod.mass_per_length * scene.rod.length * scene.gravity
    load = scene.point_forces[0]
    total = twisted.end_force - twisted.start_force + weight + load.force
    scale = float(jnp.linalg.norm(twisted.end_force))
    np.testing.assert_allclose(total, 0, atol=1e-8 * scale)
    # Gravity acts at the nodes by the trapezoidal rule, the point force between the nodes beside it.
    nodes = np.asarray(twisted.nodes)
    weights = np.full(SEGMENTS + 1, 1 / SEGMENTS)
    weights[[0, -1]] /= 2
    x = float(load.at / scene.rod.length) * SEGMENTS
    position = nodes[int(x)] + (x - int(x)) * (nodes[int(x) + 1] - nodes[int(x)])
    moment = twisted.end_moment - twisted.start_moment
    moment += np.cross(nodes[-1], twisted.end_force) - np.cross(nodes[0], twisted.start_force)
    moment += np.cross(weights @ nodes, weight) + np.cross(position, load.force)
    np.testing.assert_allclose(moment, 0, atol=1e-8 * float(jnp.linalg.norm(twisted.end_moment)))


def test_the_reversed_rod_gives_the_mirror_result(twisted):
    scene = twisted_scene()
    flip = jnp.diag(jnp.array([-1.0, 1.0, -1.0]))  # t and d1 change sign, d2 stays: right-handed
    ends = [Clamp(end.position, end.frame @ flip) for end in (scene.end, scene.start)]
    load = scene.point_forces[0]
    load = PointForce(scene.rod.length - load.at, load.force)
    other = solve(Scene(scene.rod, *ends, scene.gravity, [load]), solver=TIGHT)
    np.testing.assert_allclose(other.nodes[::-1], twisted.nodes, atol=1e-10)
    np.testing.assert_allclose(other.total_twist, twisted.total_twist, atol=1e-9)
    np.testing.assert_allclose(other.start_force, -twisted.end_force, atol=1e-9 * 20)
    np.testing.assert_allclose(other.end_moment, -twisted.start_moment, atol=1e-9 * 20)
    np.testing.assert_allclose(other.energy, twisted.energy, rtol=1e-11)


def test_the_result_moves_and_turns_with_the_scene(twisted):
    turn, shift = Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([5.0, -3.0, 2.0])
    scene = twisted_scene()
    ends = [Clamp(turn @ end.position + shift, turn @ end.frame) for end in (scene.start, scene.end)]
    loads = [PointForce(load.at, turn @ load.force) for load in scene.point_forces]
    moved = solve(Scene(scene.rod, *ends, turn @ scene.gravity, loads), solver=TIGHT)
    np.testing.assert_allclose(moved.nodes, np.asarray(twisted.nodes) @ turn.T + shift, atol=1e-10)
    np.testing.assert_allclose(moved.frames, turn @ twisted.frames, atol=1e-9)
    np.testing.assert_allclose(moved.elastic_energy, twisted.elastic_energy, rtol=1e-10)
    weight = turn @ (scene.rod.mass_per_length * scene.gravity)
    np.testing.assert_allclose(moved.energy, twisted.energy - (weight + loads[0].force) @ shift, rtol=1e-10)


def test_the_energy_of_a_load_along_the_rod_is_zero_at_the_origin():
    """Moved as a whole the rod differs by the work of the load alone: roundings."""
    rod, shift, load = Rod(2.0, 1.0, 0.7, 1e4), np.array([0.3, -1.0, 2.0]), np.array([0.1, 0.2, -1.0])
    here, there = (
        solve(Scene(rod, Clamp(start, frame((1, 0, 0))), Free(), distributed=[rj.DistributedForce(load)]))
        for start in (np.zeros(3), shift)
    )
    np.testing.assert_allclose(there.energy - here.energy, -2.0 * load @ shift, rtol=1e-9)


def test_frames_are_rotations_that_meet_both_clamps(twisted):
    scene = twisted_scene()
    products = np.einsum("nij,nik->njk", twisted.frames, twisted.frames)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-14)
    np.testing.assert_allclose(twisted.frames[0], scene.start.frame, atol=1e-14)
    np.testing.assert_allclose(twisted.frames[-1], scene.end.frame, atol=1e-13)
    np.testing.assert_allclose(twisted.total_twist, twisted.twist[0] * scene.rod.length, rtol=1e-14)


def test_section_values_meet_the_end_loads(twisted):
    """T = t . f and |t x t'| = |m across t|/EI at the ends; Omega = t . m/GJ."""
    rod = twisted_scene().rod
    for k, force, moment in (
        (0, twisted.start_force, twisted.start_moment),
        (-1, twisted.end_force, twisted.end_moment),
    ):
        t = twisted.tangents[k]
        np.testing.assert_allclose(twisted.tension[k], t @ force, rtol=1e-12)
        np.testing.assert_allclose(twisted.twist[k], t @ moment / rod.GJ, rtol=1e-8)
        np.testing.assert_allclose(twisted.curvature[k], jnp.linalg.norm(jnp.cross(moment, t)) / rod.EI, rtol=1e-12)


def supports(rod: Rod) -> dict[str, Scene]:
    level, origin, far = frame((1, 0, 0)), (0.0, 0.0, 0.0), (0.7, 0.0, 0.0)
    gravity = (0.0, 0.0, -9.81)
    EI = float(rod.EI)
    return {
        "clamp-clamp": Scene(rod, Clamp(origin, level), Clamp(far, level), gravity),
        "clamp-swivel": Scene(rod, Clamp(origin, level), Swivel(far, (0, 0, 1))),
        "swivel-swivel": Scene(rod, Swivel(origin, (1, 0, 0)), Swivel(far, (1, 0, 1)), gravity),
        "clamp-pin": Scene(rod, Clamp(origin, level), Pin(far), gravity),
        "pin-swivel": Scene(rod, Pin(origin), Swivel(far, (1, 0, 0))),
        "pin-pin": Scene(rod, Pin(origin), Pin(far), gravity),
        "clamp-free": Scene(rod, Clamp(origin, level), Free(), gravity),
        "free-clamp": Scene(rod, Free(force=(0, EI, EI)), Clamp(origin, level)),
        "swivel-free": Scene(rod, Swivel(origin, (1, 0, 0)), Free(force=(0, EI, EI))),
        "pin-free": Scene(rod, Pin(origin), Free(force=(EI, 0, EI)), gravity),
        "clamp-free-moment": Scene(rod, Clamp(origin, level), Free(moment=(EI, 2 * EI, EI))),
    }


@pytest.mark.parametrize("name", list(supports(problems.cable(20.0))))
def test_every_pair_of_supports_balances_and_restarts_at_rest(name):
    scene = supports(problems.cable(20.0))[name]
    first = solve(scene)
    assert first.converged
    weight = 0.0 if scene.gravity is None else scene.rod.mass_per_length * scene.rod.length * scene.gravity
    unit = float(scene.rod.EI / scene.rod.length**2)
    # The tolerance 1e-8 EI/L^2 is one node's; N of them add up.
    np.testing.assert_allclose(first.end_force - first.start_force + weight, 0, atol=1e-8 * SEGMENTS * unit)
    again = solve(scene, guess=first)
    assert again.iterations == 0
    np.testing.assert_array_equal(again.nodes, first.nodes)


def test_a_dead_moment_in_space_is_carried_to_the_clamp():
    scene = supports(problems.cable(20.0))["clamp-free-moment"]
    result = solve(scene)
    unit = float(scene.rod.EI)
    np.testing.assert_allclose(result.start_moment / unit, [1, 2, 1], atol=1e-7)
    np.testing.assert_allclose(result.start_force / unit, 0, atol=1e-7)
    # The torque is that of the last edge, half an edge from the end: second order in 1/12.
    np.testing.assert_allclose(result.twist[0] * scene.rod.GJ, result.tangents[-1] @ result.end_moment, rtol=1e-2)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_do_not_matter(scale):
    """A scene 1e6 times larger or smaller, of the same material, takes the same way to the same shape."""
    rod = problems.cable()
    same = solve(problems.hanging_cable())
    scaled_rod = Rod.circular(scale, 0.005 * scale, 1e7, shear_modulus=1e7 / 3, density=1200.0)
    gravity = np.array([0, 0, -9.81]) / scale
    scaled = solve(problems.hanging_cable(0.8 * scale, gravity, scaled_rod))
    assert scaled.iterations == same.iterations
    np.testing.assert_allclose(scaled.nodes / scale, same.nodes, atol=1e-12)
    np.testing.assert_allclose(scaled.end_force / scale**2, same.end_force, rtol=1e-9, atol=1e-10)
    assert float(rod.length) == 1.0


def test_a_scene_far_from_the_origin_loses_nothing():
    near = problems.hanging_cable()
    shift = np.array([1000.0, -2000.0, 500.0])
    ends = [Clamp(end.position + shift, end.frame) for end in (near.start, near.end)]
    far = solve(Scene(near.rod, *ends, near.gravity))
    np.testing.assert_allclose(np.asarray(far.nodes) - shift, solve(near).nodes, atol=1e-12 * 2000)


def test_position_at_interpolates_the_centerline(twisted):
    np.testing.assert_allclose(twisted.position_at(twisted.s), twisted.nodes, atol=1e-15)
    fine = solve(twisted_scene(), 8 * SEGMENTS)
    between = (fine.s[:-1] + fine.s[1:]) / 2
    at_nodes = np.max(np.abs(fine.position_at(twisted.s) - twisted.nodes))
    assert np.max(np.abs(fine.position_at(between) - twisted.position_at(between))) < 1.2 * at_nodes
    with pytest.raises(ValueError, match=r"s must lie in 0 to 1 m, got 0\.5 to 1\.5 m"):
        twisted.position_at([0.5, 1.5])


def test_a_guess_may_be_points_or_another_mesh(twisted):
    scene = twisted_scene()
    shape = rj.Guess(twisted.position_at(jnp.linspace(0, 1, 30)), total_twist=twisted.total_twist)
    for guess in (shape, solve(scene, 30)):
        result = solve(scene, solver=TIGHT, guess=guess)
        np.testing.assert_allclose(result.nodes, twisted.nodes, atol=1e-9)


def test_turns_choose_the_total_twist():
    rod = problems.cable(20.0)
    straight = [Clamp((x, 0, 0), frame((1, 0, 0))) for x in (0, 1)]
    for turns in (-2, 0, 1):
        result = solve(Scene(rod, *straight, turns=turns))
        np.testing.assert_allclose(result.total_twist, 2 * np.pi * turns, atol=1e-9)
        np.testing.assert_allclose(result.end_moment[0], 2 * np.pi * turns * rod.GJ, atol=1e-9 * float(rod.GJ))
    guess = rj.Guess([[0, 0, 0], [1, 0, 0]], total_twist=11.0)
    np.testing.assert_allclose(solve(Scene(rod, *straight), guess=guess).total_twist, 4 * np.pi)


def test_solve_under_jit_and_vmap():
    def tip(load):
        return solve(problems_cantilever(load)).nodes[-1]

    def problems_cantilever(load):
        rod = problems.cable()
        return Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), Free(force=load * rod.EI * jnp.array([0.0, 0, -1])))

    loads = jnp.array([0.5, 1.0, 2.0])
    single = jnp.stack([tip(load) for load in loads])
    np.testing.assert_allclose(jax.jit(tip)(loads[1]), single[1], atol=1e-13)
    np.testing.assert_allclose(jax.vmap(tip)(loads), single, atol=1e-9)


def test_an_unconverged_result_says_so():
    solver = rj.NonlinearCG(max_iterations=2)
    with pytest.warns(rj.NotConvergedWarning, match="stopped at the largest number of iterations"):
        result = solve(problems.hanging_cable(), solver=solver)
    assert not result.converged
    assert result.status == Status.MAX_ITERATIONS
    assert "residual" in rj.describe(result)


def test_the_rounding_floor_is_stated_and_not_chased():
    solver = rj.NonlinearCG(tolerance=0.0)
    result = solve(problems.hanging_cable(), solver=solver)
    assert result.converged
    assert result.status == Status.ROUNDING_FLOOR
    assert "rounding floor" in rj.describe(result)
    assert result.residual < 4 * np.finfo(float).eps * (1.6e5 + 4 * SEGMENTS**2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(segments=0), "segments must be a whole number from 1 to 100000, got 0"),
        (dict(segments=10.0), "segments must be a whole number"),
        (dict(segments=10**6), "segments must be a whole number from 1 to 100000"),
        (dict(discretization="spectral"), "discretization must be 'finite_difference' or 'hermite', got 'spectral'"),
        (dict(solver="cg"), "solver must be a Newton or NonlinearCG, got 'cg'"),
        (dict(guess=np.zeros((5, 3))), "guess must be a Guess or Equilibrium"),
    ],
)
def test_bad_options_are_refused(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        rj.solve(problems.hanging_cable(), **arguments)


def test_a_stack_of_scenes_is_refused():
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), problems.hanging_cable())
    with pytest.raises(ValueError, match="scene must be a single scene, got a stack"):
        rj.solve(stack)


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((4, 2)), np.zeros(3), [[0, 0, np.nan], [1, 0, 0]]])
def test_bad_guesses_are_refused(points):
    with pytest.raises(ValueError, match="points must"):
        rj.Guess(points)


def test_float32_works_and_says_how_far():
    code = """
import warnings; warnings.simplefilter("error")
import numpy as np, rodjax as rj
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always", rj.PrecisionWarning)
    result = rj.solve(rj.problems.hanging_cable(), segments=20, discretization="finite_difference")
assert [warning.category for warning in caught] == [rj.PrecisionWarning], caught
assert result.nodes.dtype == np.float32 and result.converged, rj.describe(result)
print(float(result.nodes[10, 2]))
"""
    import subprocess
    import sys

    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    with warnings.catch_warnings():
        truth = float(solve(problems.hanging_cable(), 20).nodes[10, 2])
    # Rounding of EA (1 + strain) in float32: strains of 1e-7 times EA L^2/EI = 1.6e5 is 1e-2 EI/L^2 of 188.
    np.testing.assert_allclose(float(output), truth, atol=1e-4)
