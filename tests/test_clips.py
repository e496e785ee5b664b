"""Clips: supports between the ends, beside the theory of continuous beams, differences, and rods without them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import Through, by_numpy

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, Rod, Scene, frame, problems, rotate
from rodjax.linalg.saddle_point import factor
from rodjax.model.scene import between, nondimensional
from rodjax.solving.result_form import form_and_point
from rodjax.solving.sliding import sliding_at

# Thick rods bent within short spans: strains up to 0.2, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::rodjax.OverstretchedWarning")

TIGHT = rj.Newton(tolerance=1e-12)
ORIGIN = (0.0, 0.0, 0.0)
GRAVITY = (0.0, 3.0, -9.81)
LEVEL = frame((1, 0, 0))


def in_space(tangent=None, start=None, end=None, sliding=(False, False), slenderness=20.0) -> Scene:
    """A thick rod under its weight through two clips, the first of which may hold the tangent."""
    clips = [Clip(0.25, (0.18, 0.05, -0.04), tangent, sliding[0]), Clip(0.625, (0.4, 0.12, 0.05), None, sliding[1])]
    start, end = start or Clamp(ORIGIN, frame((1, 0, -1))), end or Clamp((0.6, 0.2, 0.0), frame((1, 1, 0)))
    return Scene(problems.cable(slenderness), start, end, GRAVITY, clips=clips)


def weight(scene: Scene) -> np.ndarray:
    return np.asarray(scene.rod.mass_per_length * scene.rod.length * scene.gravity)


def supported(result: rj.Equilibrium) -> np.ndarray:
    """What all supports apply to the rod."""
    return np.asarray(result.end_force - result.start_force + jnp.sum(result.clip_forces, axis=-2))


# --- closed forms ----------------------------------------------------------------------------------------------------


def three_moments(spans: list[float], load: float, *, clamped: bool) -> tuple[np.ndarray, np.ndarray]:
    """Clapeyron's equations of a continuous beam: support moments (sagging positive) and upward reactions."""
    n = len(spans)
    matrix, right = np.zeros((n + 1, n + 1)), np.zeros(n + 1)
    for k in range(1, n):
        before, after = spans[k - 1 : k + 1]
        matrix[k, k - 1 : k + 2] = before, 2 * (before + after), after
        right[k] = -load * (before**3 + after**3) / 4
    for k, beside, span in ((0, 1, spans[0]), (n, n - 1, spans[-1])):
        matrix[k, k] = 2.0 if clamped else 1.0
        matrix[k, beside] = 1.0 if clamped else 0.0
        right[k] = -load * span**2 / 4 if clamped else 0.0
    moments = np.linalg.solve(matrix, right)
    reactions = np.zeros(n + 1)
    for k, span in enumerate(spans):
        shear = (moments[k + 1] - moments[k]) / span
        reactions[k] += load * span / 2 + shear
        reactions[k + 1] += load * span / 2 - shear
    return moments, reactions


@pytest.mark.parametrize(
    ("clamped", "discretization"),
    [
        (True, "hermite"),
        pytest.param(False, "finite_difference", marks=pytest.mark.slow),
        pytest.param(False, "hermite", marks=pytest.mark.exhaustive),
        pytest.param(True, "finite_difference", marks=pytest.mark.exhaustive),
    ],
)
def test_a_continuous_beam_is_that_of_three_moments(clamped, discretization):
    load, spans = 1e-3, [0.25, 0.375, 0.375]
    rod = Rod(1.0, 1.0, 1.0, 1e6, mass_per_length=1.0)
    start, end = ((Clamp(at, LEVEL) if clamped else Pin(at)) for at in (ORIGIN, (1.0, 0, 0)))
    clips = [Clip(at, (at, 0.0, 0.0)) for at in np.cumsum(spans)[:-1]]
    scene = Scene(rod, start, end, (0, 0, -load), clips=clips)
    segments = 32 if discretization == "hermite" else 128
    result = rj.solve(scene, segments=segments, discretization=discretization, solver=TIGHT)
    moments, reactions = three_moments(spans, load, clamped=clamped)
    found = np.array([-result.start_force[2], *result.clip_forces[:, 2], result.end_force[2]])
    # By linear theory the sag is 2e-7, of which the lengthening under EA = 1e6 stiffens the rod by 1e-8. The mesh:
    # finite differences are of second order, 7e-4.
    tolerance = 1e-6 if discretization == "hermite" else 1e-3
    np.testing.assert_allclose(found, reactions, rtol=tolerance)
    nodes = [int(np.argmin(np.abs(result.s - clip.at))) for clip in clips]
    np.testing.assert_allclose(result.curvature[np.array(nodes)], -moments[1:-1], rtol=tolerance)
    assert result.stable
    np.testing.assert_array_equal(result.clip_moments, 0.0)


@pytest.mark.slow
def test_a_clip_steadies_a_strut():
    """Euler: between pins it bears pi^2, with a clip in the middle 4 pi^2, and 80.76 where that holds the tangent."""
    EA = 1e4

    def index(thrust: float, clips: list) -> int:
        length = 1 - thrust / EA
        rod = Rod(1.0, 1.0, 1.0, EA)
        placed = [Clip(0.5, (length / 2, 0, 0), *tangent) for tangent in clips]
        scene = Scene(rod, Pin(ORIGIN), Pin((length, 0, 0)), clips=placed)
        line = rj.Guess(np.linspace((0, 0, 0), (length, 0, 0), 17))
        result = rj.solve(scene, segments=16, guess=line, find="equilibrium", solver=TIGHT)
        np.testing.assert_allclose(result.tension, -thrust, rtol=1e-10)
        return int(result.index)

    assert index(1.01 * np.pi**2, []) == 2
    assert [index(factor * 4 * np.pi**2, [()]) for factor in (0.99, 1.01)] == [0, 2]
    # Halves clamped at one end: 2.0457 (pi/l)^2 = 20.1907/l^2; two planes and two halves.
    assert [index(factor * 4 * 20.1907, [((1, 0, 0),)]) for factor in (0.99, 1.01)] == [0, 4]


# --- beside rods without clips ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("with_tangent", "discretization"),
    [
        (True, "hermite"),
        (False, "finite_difference"),
        pytest.param(False, "hermite", marks=pytest.mark.exhaustive),
        pytest.param(True, "finite_difference", marks=pytest.mark.exhaustive),
    ],
)
def test_a_clip_where_the_rod_lies_does_nothing(with_tangent, discretization):
    scene = in_space()
    options = {"segments": 16, "discretization": discretization, "solver": TIGHT}
    free = rj.solve(Scene(scene.rod, scene.start, scene.end, scene.gravity), **options)
    node = 6
    clip = Clip(free.s[node], free.nodes[node], free.tangents[node] if with_tangent else None)
    held = rj.solve(Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=[clip]), guess=free, **options)
    force = float(np.max(np.abs(weight(scene))))
    # Finite differences put the tangent of a node between those of its edges, which is right to second order.
    tolerance = 1e-9 if discretization == "hermite" or not with_tangent else 0.02
    np.testing.assert_allclose(held.nodes, free.nodes, rtol=0, atol=tolerance)
    np.testing.assert_allclose(held.clip_forces[0], 0.0, atol=30 * tolerance * force)
    np.testing.assert_allclose(held.clip_moments[0], 0.0, atol=30 * tolerance * force)
    np.testing.assert_allclose(held.energy, free.energy, rtol=10 * tolerance)
    assert held.converged
    assert held.index == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("discretization", "start", "end", "tangent"),
    [
        pytest.param("hermite", None, None, None, marks=pytest.mark.exhaustive),
        ("hermite", Pin(ORIGIN), None, (1.0, 0.3, 0.4)),
        ("hermite", None, Free(), None),
        ("hermite", Free(), None, (1.0, 0.3, 0.4)),
        pytest.param("finite_difference", None, None, (1.0, 0.3, 0.4), marks=pytest.mark.exhaustive),
        pytest.param("finite_difference", Pin(ORIGIN), None, None, marks=pytest.mark.exhaustive),
        ("finite_difference", None, Free(), (1.0, 0.3, 0.4)),
        pytest.param("finite_difference", Free(), None, None, marks=pytest.mark.exhaustive),
    ],
)
def test_supports_carry_the_weight_and_hold_what_they_say(discretization, start, end, tangent):
    scene = in_space(tangent, start, end)
    result = rj.solve(scene, segments=16, discretization=discretization)
    assert result.converged
    assert result.stable
    # What is summed are the same numbers: roundings.
    size = float(np.max(np.abs(weight(scene)))) + float(np.max(np.abs(result.clip_forces)))
    np.testing.assert_allclose(supported(result), -weight(scene), rtol=0, atol=1e-13 * size)
    for clip in scene.clips:
        node = int(np.argmin(np.abs(result.s - clip.at)))
        assert result.s[node] == clip.at
        np.testing.assert_allclose(result.nodes[node], clip.position, rtol=0, atol=1e-15)
        if clip.tangent is not None:
            np.testing.assert_allclose(result.tangents[node], clip.tangent, atol=1e-15)
    # About the origin the moments of all that acts on the rod sum to nothing: that of the weight by the shape.
    moments = np.cross(result.nodes[-1], result.end_force) + np.asarray(result.end_moment)
    moments -= np.cross(result.nodes[0], result.start_force) + np.asarray(result.start_moment)
    for clip, force, moment in zip(scene.clips, result.clip_forces, result.clip_moments, strict=True):
        moments += np.cross(clip.position, force) + np.asarray(moment)
        along = 0.0 if clip.tangent is None else float(np.dot(moment, clip.tangent))
        assert abs(along) < 1e-13 * float(np.max(np.abs(result.clip_moments)) + 1)
    s = np.linspace(0, 1, 2001)
    centers = result.position_at(s)
    mean = np.sum((centers[1:] + centers[:-1]) / 2, axis=0) / 2000
    moments += np.cross(mean, weight(scene))
    # The mesh of 16: fourth and second order.
    tolerance = 2e-4 if discretization == "hermite" else 3e-2
    np.testing.assert_allclose(moments, 0.0, atol=tolerance * size)


@pytest.fixture(scope="module")
def on_128() -> rj.Equilibrium:
    return rj.solve(in_space((1.0, 0.3, 0.4)), segments=128, solver=TIGHT)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("discretization", "order", "sizes"), [("hermite", 4, (16, 32)), ("finite_difference", 2, (64, 128))]
)
def test_order_of_the_mesh(discretization, order, sizes, on_128):
    scene, truth = in_space((1.0, 0.3, 0.4)), on_128
    errors, forces, estimates = [], [], []
    for segments in sizes:
        result = rj.solve(scene, segments=segments, discretization=discretization, solver=TIGHT)
        errors.append(float(np.max(np.linalg.norm(result.nodes - truth.position_at(result.s), axis=1))))
        forces.append(float(np.max(np.abs(result.clip_forces - truth.clip_forces))))
        estimates.append(float(result.error_estimate))
    # Errors of the next order are some per cent of these.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)
    assert np.log2(forces[0] / forces[1]) == pytest.approx(order, abs=0.3)
    np.testing.assert_allclose(estimates, errors, rtol=0.1)


# --- sliding ---------------------------------------------------------------------------------------------------------


def axial_forces(result: rj.Equilibrium) -> list[float]:
    """What the sliding clips apply along the rod [N]."""
    nodes = [int(np.argmin(np.abs(result.s - clip.at))) for clip in result.scene.clips]
    along = [float(jnp.sum(f * result.tangents[node])) for f, node in zip(result.clip_forces, nodes, strict=True)]
    return [force for force, clip in zip(along, result.scene.clips, strict=True) if clip.sliding]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("discretization", "tangent", "sliding"),
    [
        pytest.param("hermite", None, (True, True), marks=pytest.mark.exhaustive),
        ("hermite", (1.0, 0.3, 0.4), (False, True)),
        pytest.param("finite_difference", None, (False, True), marks=pytest.mark.exhaustive),
        ("finite_difference", (1.0, 0.3, 0.4), (True, True)),
    ],
)
def test_no_axial_force_acts_where_the_rod_slides(sliding, tangent, discretization):
    scene = in_space(tangent, sliding=sliding, slenderness=100.0)
    result = rj.solve(scene, segments=16, discretization=discretization)
    assert result.converged
    assert result.stable
    assert result.index == 0
    size = float(np.linalg.norm(weight(scene)))
    np.testing.assert_allclose(axial_forces(result), 0.0, atol=1e-9 * size)
    np.testing.assert_allclose(supported(result), -weight(scene), rtol=0, atol=1e-9 * size)
    again = rj.solve(scene, segments=16, discretization=discretization, guess=result)
    assert again.iterations == 0
    np.testing.assert_array_equal(again.nodes, result.nodes)


def lifted(at: float, *, sliding: bool) -> Scene:
    """A slack cable in a clip above the middle between its clamps."""
    ends = Clamp(ORIGIN, LEVEL), Clamp((0.8, 0, 0), LEVEL)
    return Scene(problems.cable(100.0), *ends, (0, 0, -9.81), clips=[Clip(at, (0.4, 0, 0.1), None, sliding)])


@pytest.mark.parametrize("end", [Free(), rj.Joint("tip")], ids=["free", "joint"])
def test_a_rod_that_slides_out_of_a_clip_is_told(end):
    """A clip above the clamp, near to the end of a cable that hangs to the clamp's side: it is drawn down."""
    scene = Scene(Rod(1.0, 0.1, 0.08, 1e3, 0.5), Clamp(ORIGIN, LEVEL), end, (0, 0, -9.81))
    scene = eqx.tree_at(lambda scene: scene.clips, scene, (Clip(0.9, (0.5, 0, 0.3), sliding=True),))
    place = r"clips\[0\], which has come to 0\.9999 of 1 m"
    with pytest.warns(rj.NotConvergedWarning, match=f"a rod slides out of a clip.*{place}"):
        result = rj.solve(rj.Harness({"a": scene}) if isinstance(end, rj.Joint) else scene, segments=8)
    assert result.status == rj.Status.SLID_OUT
    assert not result.converged
    # Each step goes at most 0.3 of the way that is left to the end, of 1e-4.
    assert result.iterations < 50
    assert "clips[0], which has come to 0.9999 of 1 m" in rj.describe(result)


def test_clips_that_hold_the_rod_may_be_near_to_one_another():
    """No rod slides out of one beside them, also where a search is given up."""
    places = (0.3, (0.25, 0, 0.05), False), (0.305, (0.255, 0, 0.05), False), (0.7, (0.6, 0, 0.1), True)
    clips = [Clip(at, place, None, sliding) for at, place, sliding in places]
    scene = Scene(Rod(1.0, 0.1, 0.08, 1e3, 0.5), Clamp(ORIGIN, LEVEL), Free(), (0, 0, -9.81), clips=clips)
    with pytest.warns(rj.NotConvergedWarning):
        result = rj.solve(scene, segments=32, solver=rj.Newton(max_iterations=1))
    assert result.status == rj.Status.MAX_ITERATIONS


def test_a_sliding_clip_is_where_the_energy_is_least():
    """Clips that hold the rod beside that place cost more; half way, by symmetry, most: the rod slides away."""
    options = {"segments": 32, "solver": TIGHT}
    result = rj.solve(lifted(0.44, sliding=True), **options)
    at = float(result.scene.clips[0].at)
    assert 0.4 < at < 0.499
    assert result.stable
    held = [rj.solve(lifted(at + shift, sliding=False), guess=result, **options) for shift in (-0.001, 0.0, 0.001)]
    energies = [float(each.energy) for each in held]
    assert energies[1] < min(energies[0], energies[2])
    # Of the same place on another mesh.
    assert float(result.energy) == pytest.approx(energies[1], rel=1e-5)
    # By a difference of second order: twice as far apart it is off by 1 %.

    def complement(result):
        scaled, units = nondimensional(result.scene)
        form, there = sliding_at(scaled, result.state.shape, form_and_point(result)[1])
        return factor(form.regular(form.linearized(there).system)).complement * units.energy

    stiffness = by_numpy(complement)(result)
    np.testing.assert_allclose(stiffness, [[np.diff(energies, 2)[0] / 0.001**2]], rtol=0.02)
    middle = rj.solve(lifted(0.5, sliding=False), guess=result, **options)
    assert middle.index == 0
    half = rj.solve(lifted(0.5, sliding=True), guess=middle, find="equilibrium", **options)
    np.testing.assert_allclose(half.scene.clips[0].at, 0.5, rtol=0, atol=1e-11)
    assert half.index == 1
    assert not half.stable
    # Beside the largest energy, where it curves the other way, a step of Newton's method would go up to it.
    away = rj.solve(lifted(0.498, sliding=True), guess=middle, **options)
    assert away.stable
    # On another mesh: 7e-5 was seen.
    np.testing.assert_allclose(away.scene.clips[0].at, at, rtol=0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("discretization", "sizes", "order"),
    [("hermite", (16, 32), 4), pytest.param("finite_difference", (64, 128), 2, marks=pytest.mark.exhaustive)],
)
def test_the_error_of_a_rod_that_slides(discretization, sizes, order):
    """The clip slides to a place of its own on each mesh, which the estimate knows."""
    scene = in_space((1.0, 0.3, 0.4), sliding=(False, True))
    truth = rj.solve(scene, segments=96, solver=TIGHT)
    results = [rj.solve(scene, segments=n, discretization=discretization, solver=TIGHT) for n in sizes]
    errors = [float(np.max(np.linalg.norm(r.nodes - truth.position_at(r.s), axis=1))) for r in results]
    deviations = [abs(float(r.scene.clips[1].at - truth.scene.clips[1].at)) for r in results]
    # 16 elements are few for a rod that is thick and bent in three spans.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.7)
    assert np.log2(deviations[0] / deviations[1]) == pytest.approx(order, abs=0.7)
    np.testing.assert_allclose([float(r.error_estimate) for r in results], errors, rtol=0.15)


# --- derivatives -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("discretization", "end", "sliding"),
    [
        pytest.param("hermite", None, (False, False), marks=pytest.mark.exhaustive),
        pytest.param("hermite", Free(), (False, False), marks=pytest.mark.exhaustive),
        ("hermite", None, (False, True)),
        ("finite_difference", None, (False, False)),
    ],
)
def test_derivatives_by_place_position_and_direction(discretization, end, sliding):
    scene = in_space((1.0, 0.3, 0.4), end=end, sliding=sliding)
    # Where a rod slides, on the mesh of other tests, which have the same programs.
    segments = 16 if any(sliding) else 8
    options = {"segments": segments, "discretization": discretization, "solver": rj.Newton(tolerance=1e-13)}
    base = rj.solve(scene, **options)
    direction = np.random.default_rng(0).uniform(-1, 1, (2, 7))
    frames = [None if clip.tangent is None else frame(clip.tangent) for clip in scene.clips]

    def moved(by):
        clips = []
        for clip, at_rest, change in zip(scene.clips, frames, by, strict=True):
            tangent = None if at_rest is None else rotate(at_rest, change[4:])[:, 2]
            at = clip.at if clip.sliding else clip.at + change[0] / 10
            clips.append(Clip(at, clip.position + change[1:4] / 10, tangent, clip.sliding))
        return Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=clips)

    def numbers(result):
        arclengths = jnp.stack([clip.at for clip in result.scene.clips])
        moments = (result.start_moment, result.end_moment, result.clip_moments.reshape(-1), arclengths)
        return jnp.concatenate([result.start_force, result.end_force, result.clip_forces.reshape(-1), *moments])

    found = Through(moved, lambda scene: rj.solve(scene, guess=base, **options), numbers)

    def at(h):
        return found(h * direction)

    nowhere = np.zeros_like(direction)
    change = found.change(nowhere, direction)
    h = 1e-3 if end is None and not any(sliding) else 1e-4
    expected = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    # Differences of fourth order: h^4 of the fifth derivative (large where a free end hangs from the soft part of the
    # rod), and roundings by h.
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-7 * float(np.max(np.abs(expected))))
    if any(sliding):  # other transposes: `test_a_reaction_is_the_derivative_of_the_energy`
        weights = np.random.default_rng(1).normal(size=change.shape)
        by_weights = found.pulled(nowhere)(weights)
        np.testing.assert_allclose(np.sum(by_weights * direction), np.sum(weights * change), rtol=1e-9)  # roundings


@pytest.mark.slow
def test_a_reaction_is_the_derivative_of_the_energy():
    """By the position and direction of a clip, to roundings of a difference."""
    scene = in_space((1.0, 0.3, 0.4))
    first, *others = scene.clips
    at_rest = frame(first.tangent)

    def energy(by):
        moved = Clip(first.at, first.position + by[:3], rotate(at_rest, by[3:])[:, 2])
        clips = [moved, *others]
        return rj.solve(Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=clips), **options).energy

    for discretization in ("hermite", "finite_difference"):
        options = {"segments": 8, "discretization": discretization, "solver": TIGHT}
        result = rj.solve(scene, **options)
        slope = jax.grad(energy)(jnp.zeros(6))
        expected = np.concatenate([result.clip_forces[0], result.clip_moments[0]])
        # The energy is stationary otherwise: what the solver left squared, and roundings.
        np.testing.assert_allclose(slope, expected, rtol=1e-8, atol=1e-9 * float(np.max(np.abs(expected))))


# --- paths, batches, guesses -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_paths_and_batches():
    scenes = []
    for k in range(4):
        scene = in_space(tuple(np.array([1.0, 0.3, 0.4]) + 0.05 * k))
        first, second = scene.clips
        clips = [Clip(first.at + 0.01 * k, first.position + 0.01 * k, first.tangent), second]
        scenes.append(Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=clips))
    path = rj.solve_path(scenes, segments=8)
    batch = rj.solve_batch(scenes, segments=8)
    assert path.clip_forces.shape == batch.clip_moments.shape == (4, 2, 3)
    size = float(np.max(np.abs(path.clip_forces)))
    for k, scene in enumerate(scenes):
        alone = rj.solve(scene, segments=8)
        for found in (path, batch):
            assert found.converged[k]
            # Each from another start, to the solver's tolerance.
            np.testing.assert_allclose(found.clip_forces[k], alone.clip_forces, rtol=0, atol=1e-7 * size)
            np.testing.assert_allclose(found.nodes[k], alone.nodes, rtol=0, atol=1e-8)
    half = between(scenes[0], scenes[1], jnp.asarray(0.5))
    np.testing.assert_allclose(half.clips[0].at, 0.255, rtol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(half.clips[0].tangent), 1.0, rtol=1e-15)


@pytest.mark.slow
def test_a_warm_start_on_the_same_scene_takes_no_iteration():
    scene = in_space((1.0, 0.3, 0.4))
    first = rj.solve(scene, segments=8)
    again = rj.solve(scene, segments=8, guess=first)
    assert again.iterations == 0
    np.testing.assert_array_equal(again.nodes, first.nodes)
    np.testing.assert_array_equal(again.clip_forces, first.clip_forces)
    # Of a scene with another number of clips.
    other = Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=scene.clips[1:])
    assert rj.solve(other, segments=8, guess=first).converged


@pytest.mark.slow
def test_a_tolerance_is_met():
    result = rj.solve(in_space((1.0, 0.3, 0.4)), rtol=1e-5)
    assert result.error_estimate < 1e-5
    assert result.converged


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("sliding", [pytest.param((False, False), marks=pytest.mark.exhaustive), (False, True)])
def test_results_and_scenes_are_read_back(sliding, tmp_path):
    scene = in_space((1.0, 0.3, 0.4), sliding=sliding)
    result = rj.solve(scene, segments=16)
    several = rj.solve_path([scene] * 2, segments=16)
    for found, path in ((result, tmp_path / "one.vtkhdf"), (several, tmp_path / "path.vtkhdf")):
        rj.save(found, path)
        again = rj.load(path)
        assert jax.tree.structure(again) == jax.tree.structure(found)
        jax.tree.map(np.testing.assert_array_equal, again, found)
        np.testing.assert_array_equal(again.clip_forces, found.clip_forces)
    rj.write_scene(result.scene, tmp_path / "scene.toml")
    read = rj.read_scene(tmp_path / "scene.toml")
    assert jax.tree.structure(read) == jax.tree.structure(result.scene)
    jax.tree.map(np.testing.assert_array_equal, read, result.scene)


BETWEEN_PINS = """
[rod]
length = "1 m"
EI = "1 N m^2"
GJ = "1 N m^2"
EA = "1e4 N"
[start]
support = "pin"
position = "[0, 0, 0] m"
[end]
support = "pin"
position = "[60, 0, 0] cm"
"""


def test_clips_in_a_scene_file(tmp_path):
    text = (
        BETWEEN_PINS
        + """
    [[clips]]
    at = "30 cm"
    position = "[20, 0, 1] cm"
    tangent = [2, 0, 0]
    sliding = true
    [[clips]]
    at = "0.7 m"
    position = "[0.4, 0, 0] m"
    """
    )
    path = tmp_path / "scene.toml"
    path.write_text(text)
    first, second = rj.read_scene(path).clips
    assert (first.sliding, second.sliding, second.tangent) == (True, False, None)
    np.testing.assert_allclose(first.position, (0.2, 0, 0.01), rtol=1e-15)
    np.testing.assert_array_equal(first.tangent, (1, 0, 0))
    for old, new, message in (
        ('"0.7 m"', '"0.2 m"', r"clips\[1\].at must be larger than clips\[0\].at = 0.3 m"),
        ('"0.7 m"', '"7 kg"', r"clips\[1\].at must be"),
        ('"30 cm"', '"3 cm"', r"clips: the start and clips\[0\] are 0.2"),
        ("sliding = true", 'sliding = "yes"', r"clips\[0\].sliding must be true or false"),
        ("tangent = [2, 0, 0]", "direction = [2, 0, 0]", r"clips\[0\].direction"),
        ("tangent = [2, 0, 0]", "tangent = [0, 0, 0]", r"clips\[0\].tangent must be a direction"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(rj.SceneFileError, match=message):
            rj.read_scene(path)


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("clips", "message"),
    [
        ([Clip(1.0, (0.5, 0, 0))], r"clips\[0\].at must lie between 0 and 1 m, got 1 m"),
        ([Clip(0.5, (0.4, 0, 0)), Clip(0.5, (0.4, 0, 0))], r"clips\[1\].at must be larger than clips\[0\].at = 0.5 m"),
        (
            [Clip(0.1, (0.3, 0, 0))],
            r"the start and clips\[0\] are 0.3 m apart, but the 0.1 m of rod between them reach",
        ),
        ([Clip(0.5, (0.3, 0, 0)), Clip(0.6, (0.5, 0, 0))], r"clips\[0\] and clips\[1\] are 0.2 m apart"),
        ([Clip(0.95, (0.5, 0, 0))], r"clips\[0\] and the end are 0.1 m apart, but the 0.05 m"),
        ([(0.5, (0.4, 0, 0))], r"clips\[0\] must be a Clip, got"),
        (Clip(0.5, (0.4, 0, 0)), "clips must be a list of Clip, got"),
    ],
)
def test_clips_that_no_rod_can_pass_are_refused(clips, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Scene(problems.cable(), Pin(ORIGIN), Pin((0.6, 0, 0)), clips=clips)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, ORIGIN), "at must be positive"),
        (("x", ORIGIN), "at must be a number"),
        ((0.5, (0, 0)), r"position must be numbers of shape \(3,\)"),
        ((0.5, ORIGIN, ORIGIN), "tangent must be a direction"),
    ],
)
def test_numbers_of_a_clip_are_checked(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Clip(*arguments)


def test_what_clips_do_not_go_with_is_said():
    scene = in_space()
    for options, message in (
        ({"solver": rj.NonlinearCG()}, "solver must be a Newton for a scene with clips"),
        ({"planar": True}, "planar must be False for this scene: supports and loads must lie in one plane"),
        ({"segments": 2}, "segments must be a whole number from 3"),
    ):
        with pytest.raises(ValueError, match=message):
            rj.solve(scene, **options)


def test_a_result_without_clips_has_none():
    assert rj.solve(problems.omega(0.6, 1.0), segments=4).clip_forces.shape == (0, 3)
