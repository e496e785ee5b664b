"""Turns carried from scene to scene: frames may turn by less than pi, and no whole turn is lost.

The number of turns of a rod is known up to two from signs alone: lifted to quaternions that follow one another along
the rod, the frames of two supports keep their sign against those lifted along the path.
"""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax import Clamp, Clip, Rod, Scene, frame
from rodjax.model.supports import Support

LEVEL = Rotation.from_matrix(np.asarray(frame((1, 0, 0))))
NO_TURN = Rotation.identity()
AT = 0.5
PLAIN = Rod(1.0, 1.0, 1.0, 1e4, mass_per_length=5 / 9.81)
IN_FRAMES = Rod(1.0, (1.0, 1.0), 1.0, 1e4, mass_per_length=5 / 9.81)


def scene(rod: Rod, start: Rotation = NO_TURN, end: Rotation = NO_TURN, clip: Rotation | None = None, **options):
    clips = [] if clip is None else [Clip(AT, (0.4, 0.0, -0.1), frame=(clip * LEVEL).as_matrix())]
    held = [Clamp((x, 0, 0), (turn * LEVEL).as_matrix()) for x, turn in ((0.0, start), (0.8, end))]
    return Scene(rod, *held, gravity=(0, 0, -9.81), clips=clips, **options)


def random_walk(rng: np.random.Generator, angle: float, steps: int) -> list[Rotation]:
    turns = [NO_TURN]
    for axis in rng.normal(size=(steps, 3)):
        turns.append(Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)) * turns[-1])
    return turns


def lifted(frames: np.ndarray) -> np.ndarray:
    """Quaternions of frames, each the nearer one of two to the last."""
    q = Rotation.from_matrix(frames).as_quat()
    return q * np.cumprod(np.concatenate([[1.0], np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)]))[:, None]


def clamped(end: Support):
    assert isinstance(end, Clamp)
    return end.frame


def signs(path: rj.Equilibrium, scenes: list[Scene], held) -> np.ndarray:
    """Of the frame that `held` gives of a scene, with its arclength, against the start, in each scene of a path."""
    starts = lifted(np.stack([np.asarray(clamped(scene.start)) for scene in scenes]))
    others = lifted(np.stack([np.asarray(held(scene)[0]) for scene in scenes]))
    found = []
    for k, scene in enumerate(scenes):
        along = lifted(np.asarray(path.frames[k]))
        node = np.argmin(np.abs(np.asarray(path.s[k]) - held(scene)[1]))
        products = np.dot(along[0], starts[k]), np.dot(along[node], others[k])
        np.testing.assert_allclose(np.abs(products), 1.0, atol=1e-9)  # the frames that are held, to rounding
        found.append(np.prod(np.sign(products)))
    return np.array(found)


def check_random_paths(rod: Rod, discretization, segments: int, *, has_clip: bool = False, count: int = 16) -> None:
    """Both ends and the clip turned by 3.1 rad a step about axes of their own."""
    rng = np.random.default_rng(0)
    paths = []
    for _ in range(count):
        walks = [random_walk(rng, 3.1, 4) for _ in range(3 if has_clip else 2)]
        paths.append([scene(rod, *turns) for turns in zip(*walks, strict=True)])
    found = rj.solve_batch(paths, segments=segments, discretization=discretization)
    assert np.all(found.converged)
    for k, scenes in enumerate(paths):
        path = jax.tree.map(lambda leaf, k=k: leaf[k], found)
        assert len(set(signs(path, scenes, lambda scene: (clamped(scene.end), 1.0)))) == 1
        if has_clip:
            assert len(set(signs(path, scenes, lambda scene: (scene.clips[0].frame, AT)))) == 1


def test_plain_rods_lose_no_turn_by_differences():
    check_random_paths(PLAIN, "finite_difference", 32)


@pytest.mark.slow
def test_plain_rods_lose_no_turn_by_elements():
    check_random_paths(PLAIN, "hermite", 16)


@pytest.mark.slow
def test_frames_lose_no_turn_by_differences():
    check_random_paths(IN_FRAMES, "finite_difference", 32)


@pytest.mark.slow
def test_frames_lose_no_turn_by_elements_in_clips():
    check_random_paths(PLAIN, "hermite", 16, has_clip=True)


def turned(rod: Rod, angle: float, **options) -> Scene:
    return scene(rod, end=Rotation.from_rotvec(-angle / np.sqrt(3) * np.ones(3)), **options)


def test_large_steps_end_where_small_ones_do():
    """The end turned twice by 2.5 rad: the twist was off by a whole turn, 0.728 instead of -4.484."""
    options = {"segments": 16, "discretization": "hermite"}
    large, small = (
        rj.solve_path([turned(PLAIN, angle) for angle in angles], **options)
        for angles in ((0.0, 2.5, 5.0, 5.0, 5.0), (0.0, 1.25, 2.5, 3.75, 5.0))
    )
    # Residuals of 1e-8 EI/L^2 against a stiffness of the softest motion of more than 1 EI/L^3.
    np.testing.assert_allclose(large.total_twist[1::3], small.total_twist[2::2], atol=1e-7)
    np.testing.assert_allclose(large.energy[1::3], small.energy[2::2], rtol=1e-9)
    np.testing.assert_allclose(large.total_twist[-1], -4.484, atol=1e-3)  # to the digits given
    # One by one, from an earlier equilibrium.
    result = jax.tree.map(lambda leaf: leaf[1], large)
    result = rj.solve(turned(PLAIN, 5.0), guess=result, **options)
    np.testing.assert_allclose(result.total_twist, large.total_twist[-1], atol=1e-7)


def test_stated_turns_count_from_the_last_scene():
    """Those of an earlier equilibrium with stated turns are carried, and more are added; also on another mesh, where
    the total twist was taken into -pi to pi anew.
    """
    options = {"segments": 32, "discretization": "finite_difference"}
    last = rj.solve(turned(PLAIN, 0.0, turns=0), **options)
    for angle in (2.0, 4.0):
        last = rj.solve(turned(PLAIN, angle, turns=0), guess=last, **options)
    assert last.total_twist < -np.pi  # -3.8
    again = rj.solve(turned(PLAIN, 4.0, turns=0), guess=last, segments=16, discretization="finite_difference")
    np.testing.assert_allclose(again.total_twist, last.total_twist, atol=0.1)  # of second order in 1/16
    one_more = rj.solve(turned(PLAIN, 4.0, turns=1), guess=last, **options)
    assert one_more.converged
    assert np.dot(*ends_along(one_more)) == pytest.approx(-np.dot(*ends_along(last)), abs=1e-9)


def ends_along(result: rj.Equilibrium) -> np.ndarray:
    """The first and the last of the quaternions along a rod."""
    return lifted(np.asarray(result.frames))[[0, -1]]


def many_turns(seed: int, EI) -> Scene:
    """Between random clamps, with up to four turns."""
    generator = np.random.default_rng(seed)
    frames = Rotation.from_quat(generator.normal(size=(2, 4))).as_matrix()
    way = generator.normal(size=3)
    way *= generator.uniform(0.2, 0.95) / np.linalg.norm(way)
    rod = Rod(1.0, EI, generator.uniform(0.5, 1.5), 1e6, generator.uniform(0, 3))
    turns = int(generator.integers(-4, 5))
    return Scene(rod, Clamp((0, 0, 0), frames[0]), Clamp(way, frames[1]), (0, 0, -9.81), turns=turns)


@pytest.mark.parametrize(("seed", "segments"), [(28, 12), (680, 12), (89, 24)])
def test_no_part_of_a_turn_is_lost_in_a_search(seed, segments):
    """On the way an element turns by more than pi; two thirds of a turn stayed in the total twist, and the end frame
    was off by as much.
    """
    found = rj.solve(many_turns(seed, 1.0), segments=segments)
    assert found.converged
    np.testing.assert_allclose(found.frames[-1], clamped(found.scene.end), atol=1e-9)


def test_equal_stiffnesses_and_one_come_to_the_same_shape():
    """A rod between clamps with stated turns may have several minima: a cold start by frames begins in the
    plain rod's, with its force. Random scenes in which both once came to different ones.
    """
    for seed in (5, 34, 43, 89, 283):
        scenes = [many_turns(seed, EI) for EI in (1.0, (1.0, 1.0))]
        one, two = (rj.solve(scene, segments=24) for scene in scenes)
        assert one.converged
        assert two.converged
        # The meshes' errors, with up to four turns on 24 elements.
        assert float(two.energy) == pytest.approx(float(one.energy), rel=1e-3)
    # Without the force that it has there, the last one left its minimum from an equilibrium as a guess too.
    again = rj.solve(many_turns(283, (1.0, 1.0)), segments=24, guess=one)
    assert float(again.energy) == pytest.approx(float(two.energy), rel=1e-9)
    assert int(again.iterations) <= 4  # 3
