"""Hermite elements: fourth order against the continuous rod, warm starts, point forces, dead moments, coarse meshes.

Compiling a solve takes seconds for each structure and mesh, so that most scenes are slow tests.
"""

import math
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Equilibrium, Free, Pin, PointForce, Rod, Scene, Status, Swivel, frame, problems
from rodjax.discretization.hermite import QuadraticRotationElements
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.nodes import LEAST_ELEMENT
from rodjax.model.scene import nondimensional

LEVEL = frame((1, 0, 0))
ORIGIN = (0.0, 0.0, 0.0)
# Gravity has reached its order from some 30 elements on; 64 leave errors of 1e-8 L, far above those of the truth.
MESHES = (32, 64)
ORDER, ORDER_SPREAD = 4.0, 0.3


def solve(scene: Scene, segments: int, **options) -> Equilibrium:
    return rj.solve(scene, segments=segments, discretization="hermite", **options)


def gravity(rod: Rod, *direction: float) -> np.ndarray:
    """That sags each rod as much as 9.81 m/s^2 the cable: a thin one is as heavy for its stiffness."""
    cable = problems.cable()
    return 9.81 * np.array(direction) * float(rod.EI / rod.mass_per_length * cable.mass_per_length / cable.EI)


def in_space(rod: Rod) -> Scene:
    """Two clamps in general position, gravity and a turn of twist."""
    end = Clamp((0.55, 0.15, 0.1), frame((1, 0.4, 0.3), (0.2, 1, 0.5)))
    return Scene(rod, Clamp(ORIGIN, frame((1, 0, -1))), end, gravity=gravity(rod, 0.0, 0.3, -1.0), turns=1)


def hanging(rod: Rod) -> Scene:
    return problems.hanging_cable(gravity=gravity(rod, 0.0, 0.0, -1.0), rod=rod)


def figure_1(rod: Rod, segments: int, **options) -> Equilibrium:
    """Stage f of Fig. 1, after the whole path."""
    scenes, guess = problems.figure_1(rod), problems.figure_1_start()
    path = rj.solve_path(scenes, segments=segments, discretization="hermite", guess=guess, **options)
    assert np.all(path.converged)
    assert np.all(path.substeps == 1)
    return jax.tree.map(lambda leaf: leaf[-1], path)


def errors(result: Equilibrium, truth: Equilibrium) -> dict[str, float]:
    """Largest errors in units of the rod; the truth is given at nodes that include those of the result."""
    step = (truth.s.shape[0] - 1) // (result.s.shape[0] - 1)
    np.testing.assert_allclose(result.s, truth.s[::step], rtol=1e-14)
    EI = float(result.state.units.energy * result.state.units.length)
    found = {
        name: np.max(np.abs(getattr(result, name) - getattr(truth, name)[::step]))
        for name in ("nodes", "frames", "curvature")
    }
    found |= {
        name: np.max(np.abs(getattr(result, name) - getattr(truth, name))) / EI
        for name in ("energy", "start_force", "start_moment", "end_force", "end_moment")
    }
    found["tension"] = np.max(np.abs(result.tension - truth.tension[::step])) / EI
    found["between"] = np.max(np.abs(result.position_at(truth.s) - truth.nodes))
    found["total_twist"] = np.abs(result.total_twist - truth.total_twist)
    return {name: float(value) for name, value in found.items()}


def assert_fourth_order(coarse: dict[str, float], fine: dict[str, float], least: float = 1e-10) -> None:
    """Over one halving, for all that is not known beforehand: below `least` are roundings and the truth's errors."""
    compared = {name for name, error in coarse.items() if error > least}
    assert {"nodes", "between", "energy", "start_moment", "curvature", "frames"} <= compared
    for name in compared:
        order = math.log2(coarse[name] / fine[name])
        # Errors of 6th order are a few per cent of these, or a quarter where the fourth nearly cancels.
        assert order == pytest.approx(ORDER, abs=ORDER_SPREAD), (name, order, coarse[name], fine[name])


SCENES = {"cantilever": lambda rod: problems.cantilever(rod=rod), "hanging": hanging, "in space": in_space}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("cantilever", marks=pytest.mark.exhaustive),
        pytest.param("hanging", marks=pytest.mark.slow),
        "in space",
    ],
)
def test_fourth_order_at_any_slenderness(name):
    found = []
    for slenderness in (200.0, 2e4):
        scene = SCENES[name](problems.cable(slenderness))
        meshes = [solve(scene, n) for n in MESHES]
        truth = rj.solve_continuum(scene, meshes[-1], segments=4 * MESHES[-1])
        coarse, fine = (errors(result, truth) for result in meshes)
        assert_fourth_order(coarse, fine)
        assert all(result.converged and result.stable and result.iterations <= 5 for result in meshes)
        # Seen: 2e-8, 1.1e-6, 1.8e-6 of L.
        assert coarse["nodes"] < 2e-6
        found.append(coarse)
    # No locking: a thousand times thinner in EA L^2/EI, errors differ by what the stretch of the thick one matters.
    for key, error in found[0].items():
        if error > 1e-10:
            assert found[1][key] == pytest.approx(error, rel=0.02), key


def test_figure_1_at_ten_elements():
    """The aim: 1e-4 L at 10 elements."""
    result = figure_1(problems.cable(), 10)
    truth = rj.solve_continuum(problems.figure_1()[-1], result, segments=40)
    found = errors(result, truth)
    # Seen 4.6e-5 at the nodes and, where position_at adds an error of sixth order, between them.
    assert found["nodes"] < 5e-5
    assert found["between"] < 1e-4
    # Seen 2.9e-3 of 20 EI/L, 6e-4 of 5 rad, 2.0e-2 of 40 EI/L^2.
    assert found["energy"] < 3.2e-3
    assert found["total_twist"] < 7e-4
    assert found["end_force"] < 2.2e-2
    assert result.stable


@pytest.mark.slow
@pytest.mark.parametrize("slenderness", [200.0, 2e4])
def test_figure_1_is_of_fourth_order(slenderness):
    rod = problems.cable(slenderness)
    meshes = [figure_1(rod, n) for n in MESHES]
    truth = rj.solve_continuum(problems.figure_1(rod)[-1], meshes[-1], segments=4 * MESHES[-1])
    coarse, fine = (errors(result, truth) for result in meshes)
    assert_fourth_order(coarse, fine)
    # Seen 4.3e-7 at the nodes and between them.
    assert coarse["nodes"] < 5e-7
    assert coarse["between"] < 1e-6
    assert all(result.stable and result.iterations <= 3 for result in meshes)


# --- point forces ----------------------------------------------------------------------------------------------------


def with_point_forces(*arclengths: float, slenderness: float = 200.0) -> Scene:
    rod = problems.cable(slenderness)
    EI = float(rod.EI)
    loads = [PointForce(at, (0, 10 * (-1) ** k * EI, -20 * EI)) for k, at in enumerate(arclengths)]
    end = Clamp((0.7, 0.1, 0.0), frame((1, 0.3, 0), (0.2, 1, 0.5)))
    return Scene(rod, Clamp(ORIGIN, LEVEL), end, point_forces=loads)


@pytest.mark.parametrize(
    ("arclengths", "segments"),
    [((0.43,), 8), ((0.43, 0.8), 8), ((0.05, 0.95), 8), ((0.43,), 2), ((0.0, 1.0), 4), ((0.25,), 4)],
)
def test_a_node_lies_at_every_point_force_away_from_others_and_ends(arclengths, segments):
    scaled, _ = nondimensional(with_point_forces(*arclengths))
    s = np.asarray(QuadraticRotationElements.of(scaled, jnp.linspace(0.0, 1.0, segments + 1)).s)
    assert len(s) == segments + 1
    assert s[0] == 0.0
    assert s[-1] == 1.0
    lengths = np.diff(s) * segments
    assert np.min(lengths) >= LEAST_ELEMENT - 1e-12
    assert np.max(lengths) <= 1.5
    for at in arclengths:
        if LEAST_ELEMENT <= segments * at <= segments - LEAST_ELEMENT:
            assert at in s


@pytest.mark.slow
def test_fourth_order_with_two_point_forces():
    """At thirds of the rod: nodes move to them by a third of an element on a mesh of 16 and on one of 64, so that the
    one is the other refined. On other meshes the error's factor changes with the parts by which nodes move."""
    # Slender: the axial strain jumps by F/EA, which a node does not show, an error of first order in it.
    scene = with_point_forces(1 / 3, 2 / 3, slenderness=2e4)
    meshes = [solve(scene, n) for n in (16, 64)]
    # Nodes of the truth lie at the forces too: position_at is smooth in between, to 1e-11.
    truth = rj.solve_continuum(scene, meshes[-1], segments=768)
    EI = float(scene.rod.EI)
    found = []
    for result in meshes:
        assert result.converged
        assert result.stable
        error = {
            name: float(np.max(np.abs(getattr(result, name) - getattr(truth, name)))) / EI
            for name in ("energy", "start_force", "end_force", "start_moment", "end_moment")
        }
        error["nodes"] = float(np.max(np.abs(result.nodes - truth.position_at(result.s))))
        found.append(error)
    orders = {name: math.log(error / found[1][name], 4) for name, error in found[0].items()}
    # Seen 3.83 to 4.05: the sixth order, as above.
    assert all(order == pytest.approx(ORDER, abs=ORDER_SPREAD) for order in orders.values()), orders


# --- no way through a fold -------------------------------------------------------------------------------------------


def test_an_element_stiffens_without_bound_towards_a_fold():
    """Along the circle the energy is that of an arc to the tenth power of half the angle, and grows on to infinity."""
    elements = QuadraticRotationElements(jnp.array([0.0, 1.0]))
    scene, _ = nondimensional(problems.cantilever())

    def energy(angle: float, bend: float) -> float:
        angles = jnp.array([0.0, angle / 2 + bend, angle])
        tangents = jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros(3)])
        return float(elements.bending_energy(scene, tangents))

    # t^2/4 by x = sin(t/2)^2 is a series cut off behind x^5: half an element, of t = angle/2, has 1.9e-5 t^10 more of
    # its energy than an arc. Seen 1.87e-8, 1.85e-8 and 1.78e-8 of the angle to the tenth power.
    for angle in (0.4, 0.8, 1.6):
        excess = energy(angle, 0.0) / (angle**2 / 2) - 1
        assert 1.7e-8 < excess / angle**10 < 2.0e-8
    values = [energy(angle, 0.0) for angle in (2.0, 4.0, 5.0, 6.0, 6.2, 6.28)]
    assert np.all(np.diff(values) > 0)
    # At 6.28 rad half an element is folded but for 0.0016 rad; seen 1e6, of 2.
    assert values[-1] > 1e5 * values[0]
    # Nor by folding one half alone: here to 3.1 rad, seen 884 of 4.5.
    bent = [energy(3.0, bend) for bend in (0.0, 0.5, 1.0, 1.4, 1.6)]
    assert np.all(np.diff(bent) > 0)
    assert bent[-1] > 100 * bent[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "segments", [2, pytest.param(3, marks=pytest.mark.exhaustive), 4, pytest.param(5, marks=pytest.mark.exhaustive)]
)
def test_coarse_meshes_stay_sensible(segments):
    """No fold and no spurious minimum at the end of Fig. 1's path, whose exact energy is 19.970 EI/L."""
    result = figure_1(problems.cable(), segments)
    assert result.stable
    # Seen 19.73, 19.85, 19.87, 19.93 at 2 to 5 elements; 5.43, 4.91, 4.98, 4.98 rad of 4.99.
    assert 19.6 < float(result.elastic_energy / problems.cable().EI) < 20.0
    assert float(result.total_twist) == pytest.approx(4.99, abs=0.5 if segments == 2 else 0.1)


# --- the same answer by other ways -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spatial() -> Equilibrium:
    return solve(in_space(problems.cable()), 16)


def test_an_unchanged_scene_takes_no_iteration(spatial, tmp_path):
    scene = in_space(problems.cable())
    rj.save(spatial, tmp_path / "result.vtkhdf")
    for guess in (spatial, rj.load(tmp_path / "result.vtkhdf")):
        again = solve(scene, 16, guess=guess)
        assert again.iterations == 0
        np.testing.assert_array_equal(again.nodes, spatial.nodes)
        np.testing.assert_array_equal(again.state.shape.tangents, spatial.state.shape.tangents)
        np.testing.assert_array_equal(again.end_force, spatial.end_force)


def test_guesses_cross_between_the_discretizations(spatial):
    scene = eqx.tree_at(lambda scene: scene.turns, in_space(problems.cable()), None, is_leaf=lambda x: x is None)
    differences = rj.solve(scene, segments=24, discretization="finite_difference", guess=spatial)
    # The turn is carried; second order in 1/24, seen 1.9e-2.
    np.testing.assert_allclose(differences.total_twist, spatial.total_twist, rtol=0, atol=4e-2)
    back = solve(scene, 16, guess=differences)
    assert back.converged
    # Both at rounding: the tolerance of 1e-8 EI/L^2 is met quadratically.
    np.testing.assert_allclose(back.nodes, spatial.nodes, rtol=0, atol=1e-10)
    np.testing.assert_allclose(back.total_twist, spatial.total_twist, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_plane_takes_half_the_unknowns_to_the_same_shape():
    scene = problems.hanging_cable()
    flat, free = solve(scene, 16, planar=True), solve(scene, 16)
    assert flat.iterations <= 5
    assert free.iterations <= 5
    assert flat.stable
    assert free.stable
    # Both within the tolerance, which the last quadratic step leaves far behind.
    np.testing.assert_allclose(flat.nodes, free.nodes, rtol=0, atol=1e-12)
    np.testing.assert_allclose(flat.frames, free.frames, rtol=0, atol=1e-12)
    np.testing.assert_allclose(flat.end_moment, free.end_moment, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_end_frames_may_turn_by_a_radian_at_once(spatial):
    """Both, about axes of their own: the same as in many steps."""
    scene = eqx.tree_at(lambda scene: scene.turns, in_space(problems.cable()), None, is_leaf=lambda x: x is None)

    def turned(part: float) -> Scene:
        turns = [Rotation.from_rotvec(part * np.array(axis)).as_matrix() for axis in ((0, 0.6, 0.8), (0.8, 0, -0.6))]
        ends = [
            Clamp(end.position, turn @ end.frame) for end, turn in zip((scene.start, scene.end), turns, strict=True)
        ]
        return Scene(scene.rod, *ends, scene.gravity)

    at_once = solve(turned(1.0), 16, guess=spatial)
    assert at_once.converged
    assert at_once.stable
    assert at_once.iterations <= 10
    state = spatial
    for part in np.linspace(0, 1, 11)[1:]:
        state = solve(turned(part), 16, guess=state)
    np.testing.assert_allclose(at_once.nodes, state.nodes, rtol=0, atol=1e-10)
    np.testing.assert_allclose(at_once.total_twist, state.total_twist, rtol=0, atol=1e-9)
    np.testing.assert_allclose(at_once.frames[0], turned(1.0).start.frame, rtol=0, atol=1e-14)
    np.testing.assert_allclose(at_once.frames[-1], turned(1.0).end.frame, rtol=0, atol=1e-13)


# --- statics ---------------------------------------------------------------------------------------------------------


def test_end_loads_are_derivatives_of_the_energy(spatial):
    scene = in_space(problems.cable())
    step = 1e-3
    EI = float(scene.rod.EI)
    for which, sign in (("start", -1), ("end", 1)):
        end = getattr(scene, which)
        for name in ("force", "moment"):
            measured = []
            for axis in np.eye(3):
                values = []
                for multiple in (-2, -1, 1, 2):
                    small = multiple * step * axis
                    turn = np.eye(3) if name == "force" else Rotation.from_rotvec(small).as_matrix()
                    moved = Clamp(end.position + small if name == "force" else end.position, turn @ end.frame)
                    other = eqx.tree_at(lambda scene, which=which: getattr(scene, which), scene, moved)
                    values.append(float(solve(other, 16, guess=spatial).energy))
                measured.append((values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step))
            # Fourth-order differences: truncation 1e-12 times the fifth derivative, some 1e5; rounding 1e-13 of 60.
            ours = getattr(spatial, f"{which}_{name}") / EI
            np.testing.assert_allclose(
                sign * np.array(measured) / EI, ours, rtol=0, atol=2e-6, err_msg=f"{which} {name}"
            )


def supports() -> dict[str, Scene]:
    """Every pair of supports under gravity or a force, of a thick rod, so that stretch matters."""
    rod = problems.cable(20.0)
    EI = float(rod.EI)
    far, up, weight = (0.7, 0.0, 0.0), (1, 0, 1), (0.0, 3.0, -9.81)
    force, moment = (0.0, EI, EI), (EI, 2 * EI, EI)
    clamp = Clamp(ORIGIN, LEVEL)
    return {
        "clamp-swivel": Scene(rod, clamp, Swivel(far, up)),
        "clamp-pin": Scene(rod, clamp, Pin(far), weight),
        "clamp-free": Scene(rod, clamp, Free(), weight),
        "swivel-swivel": Scene(rod, Swivel(ORIGIN, (1, 0, 0)), Swivel(far, up), weight),
        "pin-swivel": Scene(rod, Pin(ORIGIN), Swivel(far, up)),
        "pin-pin": Scene(rod, Pin(ORIGIN), Pin(far), weight),
        "pin-free": Scene(rod, Pin(ORIGIN), Free(force=(EI, 0, EI)), weight),
        "free-clamp": Scene(rod, Free(force=force), Clamp(far, LEVEL), weight),
        "free-swivel": Scene(rod, Free(force=force), Swivel(far, up), weight),
        "clamp-moment": Scene(rod, clamp, Free(force=force, moment=moment), weight),
        "moment-clamp": Scene(rod, Free(force=force, moment=moment), clamp, weight),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.exhaustive if name in {"clamp-free", "pin-swivel", "free-swivel"} else ())
        for name in supports()
    ],
)
def test_every_pair_of_supports(name, tmp_path):
    """The signs of forces, moments and frames are those of the finite differences; a restart is at rest."""
    scene = supports()[name]
    EI = float(scene.rod.EI)
    result = solve(scene, 8)
    assert result.converged
    assert result.stable == (name not in ("clamp-moment", "moment-clamp"))
    expected = rj.solve(scene, segments=48, discretization="finite_difference")
    for key in ("nodes", "frames", "axial_strain"):
        ours, theirs = getattr(result, key), getattr(expected, key)[::6]
        # Both discretizations' errors: (1/48)^2 and (1/8)^4 times a few powers of curvature and load.
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=5e-3, err_msg=key)
    for key in ("start_force", "start_moment", "end_force", "end_moment", "energy", "elastic_energy"):
        ours, theirs = getattr(result, key) / EI, getattr(expected, key) / EI
        # As above, of forces up to 40 EI/L^2.
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-2 * (1 + float(jnp.max(jnp.abs(theirs)))), err_msg=key)
    rj.save(result, tmp_path / "result.vtkhdf")
    for guess in (result, rj.load(tmp_path / "result.vtkhdf")):
        again = solve(scene, 8, guess=guess)
        assert again.iterations == 0
        np.testing.assert_array_equal(again.nodes, result.nodes)


# --- a dead end moment -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turns", [1, 2])
def test_roll_up(turns):
    """M = 2 pi k EI/L bends the rod to k full circles, of which only the strain under no force is zero: no gap."""
    rod = problems.cable()
    EI = float(rod.EI)
    moment = np.array([0.0, -2 * np.pi * turns * EI, 0.0])
    result = solve(Scene(rod, Clamp(ORIGIN, LEVEL), Free(moment=moment)), 8)
    assert result.converged
    np.testing.assert_allclose(result.start_moment / EI, moment / EI, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.tension, 0.0, atol=1e-12)
    # The elements, each of angle a, are by 1.87e-8 a^10 of their energy stiffer than arcs (see above): under a moment
    # they turn by 6 times as much less, and the curve lacks that part of its length. Seen 9.92e-9 and 9.75e-6.
    part = 6 * 1.87e-8 * (2 * np.pi * turns / 8) ** 10
    np.testing.assert_allclose(np.linalg.norm(result.nodes[-1]), part, rtol=0.06)
    np.testing.assert_allclose(result.elastic_energy / EI / (2 * (np.pi * turns) ** 2) - 1, -11 / 6 * part, rtol=0.06)
    np.testing.assert_allclose(result.curvature, 2 * np.pi * turns, rtol=1e-11)


@pytest.mark.slow
def test_a_solve_within_vmap():
    rod = problems.cable()

    def tip(load):
        scene = Scene(rod, Clamp(ORIGIN, LEVEL), Free(force=load * rod.EI * jnp.array([0.0, 0, -1])))
        return solve(scene, 8).nodes[-1]

    loads = jnp.array([0.0, 1.0, 4.0])
    tips = jax.vmap(tip)(loads)
    # A straight rod at rest is exact, and finite. At 4 EI/L^2 the tip sinks by 0.67 L (Bisshopp & Drucker 1945).
    np.testing.assert_array_equal(tips[0], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(tips[2, 2], -0.67, rtol=0, atol=5e-3)  # a digit of the tables, and EA
    np.testing.assert_allclose(tips[2], jax.jit(tip)(loads[2]), rtol=0, atol=1e-13)


@pytest.mark.slow
def test_single_precision():
    code = """
import warnings; warnings.simplefilter("error")
import numpy as np, rodjax as rj
from rodjax import problems
warnings.simplefilter("ignore", rj.PrecisionWarning)
result = rj.solve(problems.hanging_cable(), segments=16, discretization="hermite")
assert result.nodes.dtype == np.float32 and result.converged, rj.describe(result)
assert rj.solve(problems.hanging_cable(), segments=16, guess=result).iterations == 0
print(float(result.nodes[8, 2]))
"""
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    expected = float(solve(problems.hanging_cable(), 16).nodes[8, 2])
    # A rounding of 6e-8 in each of 33 tangents, over the bending stiffness of the mesh.
    np.testing.assert_allclose(float(output), expected, rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("segments", [8, pytest.param(100, marks=pytest.mark.exhaustive), 1000])
def test_the_rounding_floor_is_stated_only_where_it_is_above_the_tolerance(segments):
    scene = problems.hanging_cable()
    result = solve(scene, segments)
    assert result.converged
    assert result.stable
    # The floor by rounding of tangents at a distance h/2: 4 eps (4 |n| + 16 n^2).
    floor = 4 * np.finfo(float).eps * (4 * 188 + 16 * segments**2)
    if floor < 1e-8:
        assert result.status == Status.CONVERGED
    lowest = solve(scene, segments, solver=rj.Newton(tolerance=0.0))
    assert lowest.status == Status.ROUNDING_FLOOR
    assert lowest.residual < 10 * floor  # STAGNATION
    assert (floor < 1e-8) == (segments < 1000)


# --- what is refused, and what is not traced -------------------------------------------------------------------------


def test_other_solvers_and_discretizations_are_refused():
    scene = problems.hanging_cable()
    with pytest.raises(ValueError, match="solver must be a Newton where discretization is 'hermite'"):
        solve(scene, 8, solver=rj.NonlinearCG())
    with pytest.raises(ValueError, match="discretization must be 'finite_difference' or 'hermite', got 'spline'"):
        rj.solve(scene, discretization="spline")
    with pytest.raises(ValueError, match="solver must be a Newton"):
        rj.solve_path([scene], segments=8, discretization="hermite", solver=rj.NonlinearCG())


def test_without_torsion_no_angle_is_traced():
    rod = problems.cable()
    clamp = Clamp(ORIGIN, LEVEL)

    def text(scene: Scene) -> str:
        scaled, _ = nondimensional(scene)

        def moved_and_linearized(scaled, point, rotation):
            form = MixedForm.of(scaled, QuadraticRotationElements.of(scaled, jnp.linspace(0.0, 1.0, 5)))
            here = form.linearized(point)
            return form.linearized(form.retract(point, here.bases, rotation, jnp.zeros((3, 1)))).gradient

        point = MixedPoint(jnp.ones((3, 9)), jnp.zeros((3, 1)), jnp.array(0.0))
        return str(jax.make_jaxpr(moved_and_linearized)(scaled, point, jnp.zeros((2, 9))))

    bare = text(Scene(rod, clamp, Swivel((0.8, 0, 0), (1, 0, 0))))
    assert "atan2" not in bare
    assert "argmin" not in bare  # which places the nodes at point forces
    assert "atan2" in text(Scene(rod, clamp, Clamp((0.8, 0, 0), LEVEL)))
    assert "argmin" in text(
        Scene(rod, clamp, Swivel((0.8, 0, 0), (1, 0, 0)), point_forces=[PointForce(0.4, (0, 0, 1))])
    )
