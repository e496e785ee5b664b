"""Clips on rods by frames, and clips that hold the twist: closed forms, rods by tangents, rods cut at the clips."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import Through, by_numpy
from test_clips import BETWEEN_PINS, GRAVITY, LEVEL, ORIGIN, TIGHT, in_space, supported, three_moments, weight

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, Rod, Scene, Swivel, frame, problems, rotate
from rodjax.model.scene import between

# Thick rods bent within short spans: strains up to 0.2, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::rodjax.OverstretchedWarning")

FIELDS = ("nodes", "clip_forces", "clip_moments", "start_force", "end_force", "start_moment", "end_moment", "energy")


def rotated_about_tangent(angle: float, about=LEVEL):
    """A frame turned about its tangent."""
    return rotate(about, angle * jnp.asarray(about)[:, 2])


def node_at(result: rj.Equilibrium, at: float) -> int:
    return int(np.argmin(np.abs(result.s - at)))


# --- a straight rod that is twisted ----------------------------------------------------------------------------------

GJ = 0.7


def straight(angle: float, end_angle: float, at: float = 0.3) -> Scene:
    clips = [Clip(at, (at, 0.0, 0.0), frame=rotated_about_tangent(angle))]
    return Scene(
        Rod(1.0, 1.0, GJ, 1e4), Clamp(ORIGIN, LEVEL), Clamp((1.0, 0, 0), rotated_about_tangent(end_angle)), clips=clips
    )


@pytest.fixture(scope="module")
def twisted() -> rj.Equilibrium:
    return rj.solve(straight(1.2, 2.5), segments=8, solver=TIGHT)


def test_a_clip_that_holds_the_twist_parts_it(twisted):
    """In each span angle/length; the clip applies the jump of the torque, and nothing else."""
    assert twisted.converged
    assert twisted.stable
    assert twisted.index == 0
    first, second = 1.2 / 0.3, 1.3 / 0.7
    at_clip = node_at(twisted, 0.3)
    expected = np.where(np.arange(9) < at_clip, first, second)  # at the clip that beyond it
    # Elements know an angle t as far as its tenth power, (0.15)^10 of 0.3 rad in half of one: 1e-9.
    np.testing.assert_allclose(twisted.twist, expected, rtol=2e-9)
    np.testing.assert_allclose(twisted.clip_moments, [[GJ * (first - second), 0, 0]], atol=4e-9)
    np.testing.assert_allclose(twisted.start_moment, [GJ * first, 0, 0], atol=4e-9)
    np.testing.assert_allclose(twisted.end_moment, [GJ * second, 0, 0], atol=4e-9)
    np.testing.assert_allclose(twisted.clip_forces, 0.0, atol=1e-9)
    np.testing.assert_allclose(twisted.total_twist, 2.5, rtol=2e-9)
    np.testing.assert_allclose(twisted.elastic_energy, GJ / 2 * (0.3 * first**2 + 0.7 * second**2), rtol=4e-9)


def test_spans_do_not_know_of_one_another(twisted):
    """The twist of one end, of the length of the other span."""
    other = rj.solve(straight(1.2, -1.0), segments=8, solver=TIGHT)
    at_clip = node_at(other, 0.3)
    # The same equations: what the solver leaves.
    np.testing.assert_allclose(other.twist[:at_clip], twisted.twist[:at_clip], rtol=1e-10)
    np.testing.assert_allclose(other.twist[at_clip:], -2.2 / 0.7, rtol=2e-9)  # as above


def test_a_cold_start_takes_the_smallest_twist_of_each_span():
    result = rj.solve(straight(3.0, -3.0), segments=8, solver=TIGHT)
    # From 3 to -3 on by 0.283 beyond pi.
    second = 2 * np.pi - 6.0
    # 0.75 rad in half an element of the first span: 5e-6 by the rule above.
    np.testing.assert_allclose(result.total_twist, 3.0 + second, rtol=1e-4)
    np.testing.assert_allclose(result.twist[-1], second / 0.7, rtol=2e-9)


def test_a_clip_that_turns_carries_whole_turns(twisted):
    """Warm starts: the clip turns on beyond a whole turn, and back."""
    result = rj.solve(straight(0.0, 0.0, 0.5), segments=8, solver=TIGHT)
    angles = np.concatenate([np.linspace(1.0, 7.0, 7), [5.0, 3.0, 1.0]])
    for angle in angles:
        result = rj.solve(straight(angle, 0.0, 0.5), segments=8, solver=TIGHT, guess=result)
        assert result.converged
        # Of 0.9 rad in half an element 1e-4 is missing; of a turn that is lost or gained all.
        np.testing.assert_allclose(result.twist[:4], angle / 0.5, rtol=1e-3)
        np.testing.assert_allclose(result.twist[4:], -angle / 0.5, rtol=1e-3)
        np.testing.assert_allclose(result.total_twist, 0.0, atol=1e-9)


def test_a_warm_start_on_the_same_scene_takes_no_iteration(twisted):
    again = rj.solve(twisted.scene, segments=8, solver=TIGHT, guess=twisted)
    assert again.iterations == 0
    np.testing.assert_array_equal(again.nodes, twisted.nodes)
    np.testing.assert_array_equal(again.clip_forces, twisted.clip_forces)


@pytest.mark.slow
def test_a_path_and_a_batch_with_turning_clips():
    angles = np.linspace(0.0, 7.5, 6)
    scenes = [straight(angle, 0.0, 0.5) for angle in angles]
    path = rj.solve_path(scenes, segments=8, solver=TIGHT)
    assert np.all(path.converged)
    np.testing.assert_allclose(path.twist[:, 0], angles / 0.5, rtol=1e-3, atol=1e-12)  # as above; roundings
    np.testing.assert_allclose(path.total_twist, 0.0, atol=1e-8)
    batch = rj.solve_batch(scenes[:3], segments=8, solver=TIGHT)
    np.testing.assert_allclose(batch.twist[:, 0], angles[:3] / 0.5, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(batch.clip_moments[:, 0, 0], 4 * GJ * angles[:3], rtol=1e-4, atol=1e-12)


@pytest.mark.exhaustive
def test_vmap_over_frames_is_one_solve_after_another(twisted):
    angles = jnp.array([0.4, 1.2, 2.0])
    together = jax.vmap(lambda angle: rj.solve(straight(angle, 2.5), segments=8, solver=TIGHT))(angles)
    np.testing.assert_allclose(together.clip_moments[1], twisted.clip_moments, atol=1e-10)  # roundings
    np.testing.assert_allclose(together.twist[:, 0], angles / 0.3, rtol=1e-6, atol=1e-12)


# --- beside rods by tangents, cut rods, and the theory of beams ------------------------------------------------------


@pytest.mark.slow
def test_a_twisted_span_buckles_by_itself():
    """Clamped at both ends under a torque of 8.98682 EI/l (4.4934 = tan 4.4934, twice), whatever its length l."""
    angles = np.array([0.0, 3.0, 6.0, 9.0, 12.0, 14.0])
    branch = rj.follow([straight(0.5, 0.5 + angle) for angle in angles], segments=24)
    assert branch.ended is rj.BranchEnd.SCENES
    found = branch.critical_points[0]
    angle = np.interp(float(found.parameter), np.arange(len(angles)), angles)
    # Elements of 0.4 rad of twist: 1e-5.
    assert angle == pytest.approx(8.98682 / GJ, rel=1e-4)
    assert np.all(np.asarray(branch.index)[np.asarray(branch.parameter) < float(found.parameter) - 1e-6] == 0)


@pytest.mark.exhaustive
def test_a_route_finds_how_a_clip_should_be_turned():
    """A straight rod costs nothing in a clip that is turned by nothing.

    Its parts are proven by others: frames as variables (`test_frames_of_clips_have_keys_and_names`), derivatives by
    them (`test_derivatives_by_place_position_and_frame`) and the search (`test_route.py`).
    """
    begin = Clip(0.4, (0.4, 0.0, 0.0), frame=rotate(LEVEL, (0.1, 0.2, -0.15)))
    scene = Scene(Rod(1.0, 1.0, GJ, 1e4), Clamp(ORIGIN, LEVEL), Clamp((1.0, 0, 0), LEVEL), clips=[begin])
    found = rj.route(scene, [rj.Turned("clips.0.frame", 0.5)], objective=rj.Objective(energy=1), starts=2, segments=8)
    # A search ends where the energy falls by less than 1e-6 of what it was at the start, and this by the square.
    np.testing.assert_allclose(found.scene.clips[0].frame[:, 2], [1, 0, 0], atol=3e-3)
    assert found.objective < 1e-3 * float(rj.solve(scene, segments=8).elastic_energy)


def by_frames(scene: Scene) -> Scene:
    """The same with a rod of two equal bending stiffnesses, of which the library does not know that they are."""
    rod = scene.rod
    pair = Rod(rod.length, (rod.EI, rod.EI), rod.GJ, rod.EA, mass_per_length=rod.mass_per_length, radius=rod.radius)
    return Scene(pair, scene.start, scene.end, scene.gravity, clips=scene.clips)


@pytest.fixture(scope="module")
def both() -> tuple[rj.Equilibrium, rj.Equilibrium]:
    scene = in_space((1.0, 0.3, 0.4))
    plain = rj.solve(scene, segments=16, solver=TIGHT)
    return plain, rj.solve(by_frames(scene), segments=16, solver=TIGHT)


def test_a_rod_by_frames_is_that_by_tangents(both):
    """No element of the one is like one of the other, so that they differ by what the meshes lack."""
    plain, framed = both
    assert framed.converged
    assert framed.stable
    assert framed.index == 0
    error = float(plain.error_estimate + framed.error_estimate)
    assert 1e-6 < error < 3e-4
    np.testing.assert_allclose(framed.nodes, plain.nodes, rtol=0, atol=error)
    s = np.linspace(0, 1, 9)
    np.testing.assert_allclose(framed.position_at(s), plain.position_at(s), rtol=0, atol=30 * error)
    for field in FIELDS:
        found, expected = (np.asarray(getattr(result, field)) for result in (framed, plain))
        # Forces are derivatives of the shape: some tens of its error.
        np.testing.assert_allclose(found, expected, rtol=0, atol=30 * error * max(np.max(np.abs(expected)), 1e-3))
    np.testing.assert_allclose(framed.total_twist, plain.total_twist, atol=30 * error)
    for clip, moment in zip(framed.scene.clips, framed.clip_moments, strict=True):
        along = 0.0 if clip.tangent is None else float(np.dot(moment, clip.tangent))
        assert abs(along) < 1e-13 * float(np.max(np.abs(framed.clip_moments)))  # roundings
    np.testing.assert_array_equal(framed.clip_moments[1], 0.0)


def test_supports_carry_the_weight(both):
    _, framed = both
    size = float(np.max(np.abs(weight(framed.scene)))) + float(np.max(np.abs(framed.clip_forces)))
    np.testing.assert_allclose(supported(framed), -weight(framed.scene), rtol=0, atol=1e-13 * size)  # roundings
    for clip in framed.scene.clips:
        node = node_at(framed, float(clip.at))
        assert framed.s[node] == clip.at
        np.testing.assert_allclose(framed.nodes[node], clip.position, rtol=0, atol=1e-15)
        if clip.tangent is not None:
            np.testing.assert_allclose(framed.tangents[node], clip.tangent, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "with_tangent"),
    [
        (None, True),
        pytest.param(Free(), False, marks=pytest.mark.exhaustive),
        pytest.param(Pin((0.6, 0.2, 0.0)), True, marks=pytest.mark.exhaustive),
    ],
)
def test_the_difference_to_a_rod_by_tangents_is_of_fourth_order(end, with_tangent):
    scene = in_space((1.0, 0.3, 0.4) if with_tangent else None, end=end)
    plain = rj.solve(scene, segments=128, solver=TIGHT)
    errors = []
    for segments in (32, 64):
        guess = rj.Guess(plain.position_at(np.linspace(0, 1, 33)))
        framed = rj.solve(by_frames(scene), segments=segments, solver=TIGHT, guess=guess)
        differences = [np.asarray(getattr(framed, field) - getattr(plain, field)) for field in FIELDS[1:]]
        sizes = [np.max(np.abs(np.asarray(getattr(plain, field)))) + 1e-3 for field in FIELDS[1:]]
        shape = np.max(np.linalg.norm(framed.nodes - plain.position_at(framed.s), axis=1))
        errors.append(np.array([shape, *(np.max(np.abs(x)) / y for x, y in zip(differences, sizes, strict=True))]))
    # Bent this sharply the next orders are large: 22 per cent with 32 elements, 12 with 64, 8 with 128, in other scenes
    # more; always on the safe side.
    assert 0.9 * shape < framed.error_estimate < 1.5 * shape
    # Those that are no rounding.
    is_counted = errors[1] > 1e-10
    orders = np.log2(errors[0][is_counted] / errors[1][is_counted])
    assert np.min(orders) > 3.5


@pytest.fixture(scope="module")
def cut() -> tuple[rj.Equilibrium, list[rj.Equilibrium]]:
    """A flat rod, held at its middle as by a clamp, and its two halves between clamps."""
    rod = Rod(1.0, (1.0, 1.5), 0.8, 1e4, mass_per_length=1.0)
    middle = Clamp((0.42, 0.1, -0.1), rotated_about_tangent(0.8, frame((1, 0.5, 0.2))))
    ends = [Clamp(ORIGIN, LEVEL), middle, Clamp((0.7, 0.4, 0), LEVEL)]
    clip = Clip(0.5, ends[1].position, frame=ends[1].frame)
    whole = rj.solve(Scene(rod, ends[0], ends[2], (0, 2.0, -9.81), clips=[clip]), segments=16, solver=TIGHT)
    half = Rod(0.5, (1.0, 1.5), 0.8, 1e4, mass_per_length=1.0)
    halves = [
        rj.solve(Scene(half, *ends[k : k + 2], (0, 2.0, -9.81)), segments=8, solver=rj.Newton(tolerance=1e-13))
        for k in range(2)
    ]
    return whole, halves


@pytest.mark.slow
def test_spans_between_held_frames_are_rods_of_their_own(cut):
    whole, (first, second) = cut
    assert whole.converged
    # The same equations on the same mesh: what the solver leaves, 1e-12 EI/L^2, and roundings.
    close = {"rtol": 0, "atol": 1e-9}
    np.testing.assert_allclose(whole.nodes, np.concatenate([first.nodes, second.nodes[1:]]), **close)
    np.testing.assert_allclose(whole.frames, np.concatenate([first.frames[:-1], second.frames]), **close)
    np.testing.assert_allclose(whole.twist, np.concatenate([first.twist[:-1], second.twist]), **close)
    np.testing.assert_allclose(whole.start_force, first.start_force, **close)
    np.testing.assert_allclose(whole.end_moment, second.end_moment, **close)
    np.testing.assert_allclose(whole.clip_forces[0], first.end_force - second.start_force, **close)
    np.testing.assert_allclose(whole.clip_moments[0], first.end_moment - second.start_moment, **close)
    np.testing.assert_allclose(whole.total_twist, first.total_twist + second.total_twist, **close)
    np.testing.assert_allclose(whole.energy, first.energy + second.energy, rtol=1e-9)
    # The estimate is linear in what elements lack.
    displaced = np.max([first.error_estimate, second.error_estimate]) / 2
    np.testing.assert_allclose(whole.error_estimate, displaced, rtol=1e-5)


@pytest.fixture(scope="module")
def beam() -> rj.Equilibrium:
    load = 1e-3
    rod = Rod(1.0, (1.0, 2.5), 1.0, 1e6, mass_per_length=1.0)
    clips = [Clip(at, (at, 0.0, 0.0)) for at in (0.25, 0.625)]
    scene = Scene(rod, Clamp(ORIGIN, LEVEL), Clamp((1.0, 0, 0), LEVEL), (0, -load, -load), clips=clips)
    return rj.solve(scene, segments=32, solver=TIGHT)


@pytest.mark.slow
def test_a_flat_continuous_beam_is_that_of_three_moments(beam):
    """Across d1 and across d2, with the same reactions, and curvatures by the stiffness of each."""
    moments, reactions = three_moments([0.25, 0.375, 0.375], 1e-3, clamped=True)
    for axis in (1, 2):
        found = np.array([-beam.start_force[axis], *beam.clip_forces[:, axis], beam.end_force[axis]])
        np.testing.assert_allclose(found, reactions, rtol=1e-6)  # linear theory: see test_clips
    nodes = np.array([node_at(beam, at) for at in (0.25, 0.625)])
    np.testing.assert_allclose(beam.curvature[nodes], -moments[1:-1] * np.hypot(1.0, 1 / 2.5), rtol=1e-6)
    assert beam.stable
    np.testing.assert_array_equal(beam.clip_moments, 0.0)


# --- a rod that is bent without stress -------------------------------------------------------------------------------

BEND = 2.0


def on_arc(s: float) -> tuple[np.ndarray, np.ndarray]:
    angle = BEND * s
    turned = np.asarray(rotate(LEVEL, (0.0, angle, 0.0)))
    return np.array([np.sin(angle), 0.0, np.cos(angle) - 1]) / BEND, turned


def precurved(gravity, moved=(0.0, 0.0, 0.0)) -> Scene:
    """In three clips: one that holds the place, one the direction, one the frame."""
    rod = Rod(1.0, (1.0, 1.5), 0.7, 1e4, mass_per_length=1.0, rest_curvature=(0.0, BEND))
    poses = {s: on_arc(s) for s in (0.0, 0.25, 0.5, 0.75, 1.0)}
    (a, _), (b, at_b), (c, at_c) = (poses[s] for s in (0.25, 0.5, 0.75))
    clips = [Clip(0.25, a + np.array(moved)), Clip(0.5, b, at_b[:, 2]), Clip(0.75, c, frame=at_c)]
    return Scene(rod, Clamp(*poses[0.0]), Clamp(*poses[1.0]), gravity, clips=clips)


@pytest.fixture(scope="module")
def resting() -> rj.Equilibrium:
    return rj.solve(precurved((0.0, 0.0, 0.0)), segments=8, solver=TIGHT)


def test_clips_on_the_shape_without_stress_do_nothing(resting):
    assert resting.converged
    # Any mesh has the rod at rest exactly: roundings and the solver's 1e-12.
    for field in ("clip_forces", "clip_moments", "start_force", "end_force", "start_moment", "elastic_energy"):
        np.testing.assert_allclose(getattr(resting, field), 0.0, atol=1e-9)
    np.testing.assert_allclose(resting.curvature, BEND, rtol=1e-10)
    np.testing.assert_allclose(resting.twist, 0.0, atol=1e-10)


def test_a_clip_off_that_shape_bends_the_rod():
    result = rj.solve(precurved((0.0, 1.0, -9.81), (0.02, 0.03, 0.05)), segments=8)
    assert result.converged
    assert result.stable
    size = float(np.max(np.abs(result.clip_forces)))
    assert size > 10.0
    np.testing.assert_allclose(supported(result), -weight(result.scene), rtol=0, atol=1e-13 * size)  # roundings
    assert np.linalg.norm(result.clip_moments[2]) > 0.1


# --- derivatives -----------------------------------------------------------------------------------------------------


def with_changes(scene: Scene, frames: list, by) -> Scene:
    """Clips moved along the rod and in space, and turned. `frames`: of those that hold a tangent."""
    clips = []
    for clip, at_rest, change in zip(scene.clips, frames, by, strict=True):
        tangent = None if clip.tangent is None else rotate(at_rest, change[4:])[:, 2]
        held = None if clip.frame is None else rotate(clip.frame, change[4:])
        clips.append(Clip(clip.at + change[0] / 10, clip.position + change[1:4] / 10, tangent, frame=held))
    return Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=clips)


def numbers(result: rj.Equilibrium):
    parts = [getattr(result, name).reshape(-1) for name in (*FIELDS[1:], "total_twist", "twist")]
    return jnp.concatenate(parts)


@pytest.mark.slow
@pytest.mark.parametrize("is_plain", [pytest.param(False, marks=pytest.mark.exhaustive), True])
def test_derivatives_by_place_position_and_frame(is_plain):
    options = {"segments": 8, "solver": rj.Newton(tolerance=1e-13)}
    scene = precurved((0.0, 1.0, -9.81), (0.02, 0.03, 0.05))
    if is_plain:
        first, second = in_space((1.0, 0.3, 0.4)).clips
        held = Clip(second.at, second.position, frame=rotated_about_tangent(0.7, frame((1.0, 0.2, -0.3))))
        ends = in_space()
        scene = Scene(problems.cable(20.0), ends.start, ends.end, GRAVITY, clips=[first, held])
    base = rj.solve(scene, **options)
    assert base.converged
    direction = np.random.default_rng(0).uniform(-1, 1, (len(scene.clips), 7))
    frames = [None if clip.tangent is None else frame(clip.tangent) for clip in scene.clips]

    solve = functools.partial(rj.solve, guess=base, **options)
    found = Through(functools.partial(with_changes, scene, frames), solve, numbers)

    def at(h):
        return found(h * direction)

    nowhere = np.zeros_like(direction)
    change = found.change(nowhere, direction)
    h = 1e-3
    expected = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    # Differences of fourth order: h^4 of the fifth derivative, and roundings by h.
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-7 * float(np.max(np.abs(expected))))
    if not is_plain:  # its transpose: `test_a_reaction_is_the_derivative_of_the_energy` of test_clips
        weights = np.random.default_rng(1).normal(size=change.shape)
        by_weights = found.pulled(nowhere)(weights)
        np.testing.assert_allclose(np.sum(by_weights * direction), np.sum(weights * change), rtol=1e-9)  # roundings


@pytest.mark.slow
def test_a_reaction_is_the_derivative_of_the_energy():
    """By the position and the frame of a clip, to roundings of a difference."""
    scene = precurved((0.0, 1.0, -9.81), (0.02, 0.03, 0.05))
    *others, last = scene.clips

    def energy(by):
        moved = Clip(last.at, last.position + by[:3], frame=rotate(last.frame, by[3:]))
        turned = Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=[*others, moved])
        return rj.solve(turned, segments=8, solver=TIGHT).energy

    result = rj.solve(scene, segments=8, solver=TIGHT)
    expected = np.concatenate([result.clip_forces[2], result.clip_moments[2]])
    slope = jax.grad(energy)(jnp.zeros(6))
    # The energy is stationary otherwise: what the solver left squared, and roundings.
    np.testing.assert_allclose(slope, expected, rtol=1e-8, atol=1e-9 * float(np.max(np.abs(expected))))


# --- other loads, guesses and ends -----------------------------------------------------------------------------------


def test_loads_without_a_potential_are_carried():
    """Follower loads and couples: what supports apply is the reverse of all of them; the mesh has fourth order."""
    first, _, last = precurved(None).clips
    rod = Rod(1.0, (1.0, 1.5), 0.7, 1e4)
    loads = [rj.DistributedForce((0.0, 4.0, 3.0), follower=True), rj.DistributedCouple((0.3, 0.2, 0.5), follower=True)]
    scene = Scene(rod, Pin(ORIGIN), Free((1.0, 0.5, 2.0), follower=True), distributed=loads, clips=[first, last])
    results = [rj.solve(scene, segments=n, solver=TIGHT) for n in (8, 16, 64)]
    moments = []
    for result in results:
        assert result.converged
        frames, weights = result.frames[:, :, :2], np.gradient(np.asarray(result.s))
        weights[[0, -1]] /= 2
        along = np.einsum("k,kij,j->i", weights, frames, np.array([0.0, 4.0]))
        along += 3.0 * weights @ np.asarray(result.tangents)
        at_end = np.asarray(result.frames[-1]) @ np.array([1.0, 0.5, 2.0])
        np.testing.assert_allclose(result.end_force, at_end, rtol=1e-12)
        supports = np.asarray(jnp.sum(result.clip_forces, axis=0) - result.start_force)
        # The integral of the loads by the trapezoidal rule, of second order.
        np.testing.assert_allclose(supports, -at_end - along, atol=20 / len(result.s) ** 2)
        moments.append(np.asarray(result.clip_moments[1]))
    errors = [np.max(np.abs(x - moments[2])) for x in moments[:2]]
    assert np.log2(errors[0] / errors[1]) > 3.3


def test_systems_are_the_derivatives_of_what_is_out_of_balance(resting):
    """Of spans, and of elements under loads without a potential of every kind, at both ends too."""
    from rodjax.solving.result_form import form_and_point

    def both_ways(result, is_pushed):
        form, point = form_and_point(result)
        here = form.linearized(point)
        generator = np.random.default_rng(0)
        x = jnp.asarray(generator.normal(size=form.is_free.shape)) * form.is_free
        y = jnp.asarray(generator.normal(size=here.constraint_residual.shape))
        if is_pushed:
            nodes = slice(-form.layout.size - 3 * len(form.field.s), -form.layout.size)
            y = y.at[nodes].multiply(jnp.repeat(jnp.where(form.is_held, 0.0, 1.0), 3))  # a held node does not move

        def residual_at(part):
            change = form.layout.forces(form.force_components(y))
            others = jax.tree.map(lambda change: part * change, form.others(y))
            return form.residual_vectors(form.retract(point, here.bases, part * x, part * change, others))

        return here.system.times(x, y), jax.jvp(residual_at, (jnp.array(0.0),), (jnp.array(1.0),))[1]

    rod = Rod(1.0, (1.0, 1.5), 0.7, 1e4)
    loads = [
        *(rj.DistributedForce((0.5, 4.0, 3.0), follower=follows) for follows in (False, True)),
        *(rj.DistributedCouple((0.3, 0.2, 0.5), follower=follows) for follows in (False, True)),
    ]
    held = Clip(0.4, (0.35, 0.1, 0.0), frame=LEVEL)
    pushed = [
        rj.solve(Scene(rod, *ends, distributed=loads, clips=[held]), segments=6, solver=TIGHT)
        for ends in (
            (Free((1.0, 0.5, 2.0), (0.3, -0.2, 0.4), follower=True), Clamp((0.8, 0.0, 0.0), LEVEL)),
            (Clamp(ORIGIN, LEVEL), Free((-1.0, 0.5, 2.0), (0.3, 0.6, 0.4))),
        )
    ]
    for result in (resting, *pushed):
        assert result.converged
        found, expected = by_numpy(both_ways)(result, is_pushed=result is not resting)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9 * float(np.max(np.abs(b))))  # the solver's 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    "start", [Swivel(ORIGIN, (1, 0, -1)), Free(), pytest.param(Pin(ORIGIN), marks=pytest.mark.exhaustive)]
)
def test_the_rod_spins_with_a_single_held_frame(start):
    """Nothing twists it then, whatever the frame: the other end follows."""
    rod = Rod(1.0, (1.0, 1.0), 0.7, 1e4, mass_per_length=1.0)
    clip = Clip(0.4, (0.3, 0.1, -0.1), frame=rotated_about_tangent(2.0, frame((1.0, 0.5, 0.2))))
    scene = Scene(rod, start, Pin((0.6, 0.3, 0)), (0, 0, -9.81), clips=[clip])
    result = rj.solve(scene, segments=16)
    assert result.converged
    np.testing.assert_allclose(result.frames[node_at(result, 0.4)], clip.frame, atol=1e-14)
    # Without a torque at the ends there is none along a rod whose stiffnesses are the same.
    np.testing.assert_allclose(result.twist, 0.0, atol=1e-4)


@pytest.mark.slow
def test_routes_with_corners_are_found_without_a_guess():
    """An L in a plane and one around two corners, with every clip holding the frame, spun by up to half a turn."""
    rod = Rod(1.0, 1.0, 0.7, 1e5, mass_per_length=0.1)
    corners = [
        [((0.27, 0.0, 0.0), (1, 0, 0)), ((0.45, 0.16, 0.0), (0.2, 1, 0)), ((0.47, 0.4, 0.0), (0, 1, 0))],
        [((0.27, 0.0, 0.0), (1, 0, 0)), ((0.42, 0.17, 0.0), (0, 1, 0.2)), ((0.42, 0.26, 0.18), (0, 0, 1))],
    ]
    for k, poses in enumerate(corners):
        for angle in (0.0, 1.5, 3.0):
            at = (0.28, 0.55, 0.8)
            clips = [
                Clip(
                    s, position, frame=rotated_about_tangent(angle * (-1) ** j, frame(tangent, (0.3, 0.2, 1.0 - j / 2)))
                )
                for j, (s, (position, tangent)) in enumerate(zip(at, poses, strict=True))
            ]
            last, along = poses[2]
            end = Pin(np.array(last) + 0.19 * np.array(along))
            result = rj.solve(Scene(rod, Clamp(ORIGIN, LEVEL), end, (0, 0, -9.81), clips=clips), segments=16)
            assert result.converged, (k, angle)
            assert result.stable, (k, angle)
            # No span twists by more than half a turn, as far as the frames of a bent rod tell that.
            assert np.max(np.abs(np.diff(result.s) * (result.twist[:-1] + result.twist[1:]) / 2)) < 1.6


# --- results, files --------------------------------------------------------------------------------------------------


def test_describe_margins_and_reactions(twisted):
    assert rj.describe(twisted).startswith("converged")
    found = rj.margins(twisted, rj.Limits(twist=5.0, clip_moment=2.0))
    by_name = dict(zip(found.names, np.asarray(found.value), strict=True))
    # The largest twist is that before the clip; tolerances as above.
    assert by_name["twist"] == pytest.approx(4.0, rel=1e-8)
    assert by_name["moment of clip 0"] == pytest.approx(GJ * (4.0 - 1.3 / 0.7), rel=1e-8)
    from rodjax.analysis.reactions import reactions

    of_clip = reactions(twisted)[1]
    assert (of_clip.name, of_clip.kind, of_clip.s) == ("clip 0", "clip with frame", 0.3)
    np.testing.assert_allclose(of_clip.axes @ of_clip.moment, [GJ * (4.0 - 1.3 / 0.7), 0, 0], atol=1e-8)


def test_results_and_scenes_are_read_back(resting, tmp_path):
    rj.save(resting, tmp_path / "one.vtkhdf")
    again = rj.load(tmp_path / "one.vtkhdf")
    assert jax.tree.structure(again) == jax.tree.structure(resting)
    jax.tree.map(np.testing.assert_array_equal, again, resting)
    np.testing.assert_array_equal(again.clip_moments, resting.clip_moments)
    rj.write_scene(resting.scene, tmp_path / "scene.toml")
    read = rj.read_scene(tmp_path / "scene.toml")
    assert jax.tree.structure(read) == jax.tree.structure(resting.scene)
    jax.tree.map(np.testing.assert_array_equal, read, resting.scene)


SCENE_FILE = (
    BETWEEN_PINS
    + """
[[clips]]
at = "30 cm"
position = "[20, 0, 1] cm"
tangent = [2, 0, 0]
d2 = [0, 0, 3]
[[clips]]
at = "0.5 m"
position = "[0.3, 0, 0] m"
tangent = [1, 0, 0]
d2 = [0, 1, 0]
spin = "90 deg"
[[clips]]
at = "0.7 m"
position = "[0.4, 0, 0] m"
frame = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
"""
)


def test_frames_of_clips_in_a_scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE_FILE)
    first, second, third = rj.read_scene(path).clips
    np.testing.assert_allclose(first.frame, frame((1, 0, 0), (0, 0, 1)), atol=1e-15)
    np.testing.assert_allclose(second.frame, rotated_about_tangent(np.pi / 2), atol=1e-15)
    np.testing.assert_array_equal(third.frame, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    assert first.tangent is second.tangent is third.tangent is None
    for old, new, message in (
        (
            "frame = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]",
            "frame = [[0, 0, 1], [0, 1, 0], [1, 0, 0]]",
            r"clips\[2\].frame must",
        ),
        (
            "frame = [[0, 0, 1]",
            "d2 = [0, 1, 0]\nframe = [[0, 0, 1]",
            r"clips\[2\].d2 is not allowed together with clips",
        ),
        (
            "frame = [[0, 0, 1]",
            "tangent = [0, 1, 0]\nframe = [[0, 0, 1]",
            r"clips\[2\].tangent is not allowed together",
        ),
        ('spin = "90 deg"', 'spin = "190 deg"', r"clips\[1\].spin must lie in -180 deg to 180 deg, got 190 deg"),
        ("d2 = [0, 1, 0]\n", "", r"clips\[1\].d2 or clips\[1\].frame is needed for clips\[1\].spin"),
        ("d2 = [0, 0, 3]", "d2 = [1, 0, 0]", r"clips\[0\].d2 must not be parallel"),
        ("tangent = [2, 0, 0]\n", "", r"clips\[0\].tangent or clips\[0\].frame is needed where"),
    ):
        path.write_text(SCENE_FILE.replace(old, new))
        with pytest.raises(rj.SceneFileError, match=message):
            rj.read_scene(path)


def test_frames_of_clips_have_keys_and_names(tmp_path):
    from rodjax.io.scene_keys import SceneVariations

    path = tmp_path / "scene.toml"
    path.write_text(SCENE_FILE)
    import tomllib

    varied = SceneVariations(tomllib.loads(SCENE_FILE), ["clips.1.spin", "clips.2.frame"])
    scene = varied.read({"clips.1.spin": np.array(0.5), "clips.2.frame": np.asarray(LEVEL)}).scenes[0]
    np.testing.assert_allclose(scene.clips[1].frame, rotated_about_tangent(0.5), atol=1e-15)
    np.testing.assert_array_equal(scene.clips[2].frame, LEVEL)
    turned = rj.Turned("clips.2.frame", 0.3)
    from rodjax.routing.variables import with_numbers

    same = with_numbers(scene, [turned], jnp.full(3, 0.5))
    np.testing.assert_allclose(same.clips[2].frame, LEVEL, atol=1e-15)
    moved = with_numbers(scene, [turned], jnp.array([0.5, 0.5, 1.0]))
    np.testing.assert_allclose(moved.clips[2].frame, rotated_about_tangent(0.3), atol=1e-15)


def test_a_scene_half_way_turns_the_frames_of_clips():
    half = between(straight(0.4, 0.0), straight(1.0, 0.0), jnp.asarray(0.5))
    np.testing.assert_allclose(half.clips[0].frame, rotated_about_tangent(0.7), atol=1e-15)


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tangent": (1, 0, 0), "frame": LEVEL}, "tangent must be None where frame is given"),
        ({"frame": np.zeros((3, 3))}, "frame must be"),
        ({"frame": (1, 0, 0)}, r"frame must be numbers of shape \(3, 3\)"),
    ],
)
def test_frames_of_a_clip_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        Clip(0.5, ORIGIN, **arguments)


def test_what_frames_in_clips_do_not_go_with_is_said():
    scene, general = straight(0.0, 0.0), precurved(None)
    parts = (scene.rod, scene.start, scene.end)
    with pytest.raises(ValueError, match="turns must be None where a clip has a frame"):
        Scene(*parts, turns=1, clips=scene.clips)
    for held in (scene, general):
        for options, message in (
            ({"solver": rj.NonlinearCG()}, "solver must be a Newton for a rod, loads or clips that need frames"),
            ({"discretization": "finite_difference"}, "discretization must be 'hermite' for clips on a rod"),
            ({"segments": 1}, "segments must be a whole number from"),
        ):
            with pytest.raises(ValueError, match=message):
                rj.solve(held, **options)


@pytest.mark.slow
@pytest.mark.parametrize("moment", [(0.0, 0.0, 0.0), (0.2, 0.5, 0.1)], ids=["no moment", "moment"])
def test_a_rod_that_slides_by_frames_is_that_by_tangents(moment):
    """The same equations in other unknowns, on the same mesh; with its derivative. Both cases share programs."""
    has_moment = any(moment)
    clip = Clip(0.4, (0.35, 0.0, 0.05), tangent=(1.0, 0.0, 0.2), sliding=True)
    end = Free(moment=moment)
    found = []
    for EI in (1.0, (1.0, 1.0)):

        def solved(weight, EI=EI):
            rod = Rod(1.0, EI, 0.7, 1e4, mass_per_length=0.5)
            scene = Scene(
                rod, Clamp(ORIGIN, frame((1, 0, 0))), end, weight * jnp.array([0.0, 0.0, -9.81]), clips=[clip]
            )
            return rj.solve(scene, segments=12)

        result, change = jax.jvp(solved, (jnp.array(1.0),), (jnp.array(1.0),))
        assert result.converged
        force = result.clip_forces[0]
        tangent = np.asarray(result.tangents)[np.argmin(np.abs(np.asarray(result.s) - float(result.scene.clips[0].at)))]
        assert abs(force @ tangent) < 1e-6  # nothing pulls along the rod
        found.append((result, change))
    (one, by_weight), (other, other_by_weight) = found
    # Twist is unknown by frames alone, so that the meshes differ by their errors where a moment twists the rod.
    atol = 1e-8 if not has_moment else 3 * float(one.error_estimate + other.error_estimate)
    np.testing.assert_allclose(one.scene.clips[0].at, other.scene.clips[0].at, rtol=0, atol=atol)
    np.testing.assert_allclose(one.nodes, other.nodes, rtol=0, atol=atol)
    np.testing.assert_allclose(by_weight.nodes, other_by_weight.nodes, rtol=0, atol=100 * atol)
