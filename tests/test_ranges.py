"""Scenes that are stacked, or made of traced numbers, are checked as those that are made one by one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.solving.ranges import check_ranges

LEVEL = np.asarray(rj.frame((1, 0, 0)))
MESH = {"segments": 8}


def scene(end=0.8, EI=1.0, at=0.3, clip=0.5, turn=0.0, turns=0.0, radius=0.01):
    """One of every kind of number that has a range."""
    frame = LEVEL * (1 + turn)
    return rj.Scene(
        rj.Rod(1.0, EI, 0.7, 1e4, mass_per_length=rj.Steps([0.5], jnp.ones(2) * EI)),
        rj.Clamp((0, 0, 0), LEVEL),
        rj.Clamp(jnp.array([1.0, 0, 0]) * end, frame),
        point_forces=[rj.PointForce(at, (0, 0, 0.1))],
        turns=turns,
        clips=[rj.Clip(clip, (0.4, 0, 0.05), tangent=(1, 0, 0))],
    )


WRONG = {
    "end": (1.6, r"scenes\[1\]: the ends are 1\.6 m apart"),
    "EI": (-1.0, r"scenes\[1\]\.rod: EI must be positive, got -1"),
    "at": (1.2, r"scenes\[1\]: point_forces\[0\]\.at must lie in 0 to 1 m, got 1\.2 m"),
    "clip": (1.1, r"scenes\[1\]: clips\[0\]\.at must lie between 0 and 1 m"),
    "turn": (0.01, r"scenes\[1\]\.end: frame must be a rotation"),
    "turns": (0.5, r"scenes\[1\]: turns must be a whole number, got 0\.5"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_stack_is_refused_by_the_name_of_its_case(name, monkeypatch):
    """Made by vmap, inside of which no number is known."""
    for module in ("paths.batch._solve_many", "paths.path._solve_path"):
        monkeypatch.setattr(f"rodjax.{module}", lambda *_: pytest.fail("solved"))
    wrong, message = WRONG[name]
    default = {"end": 0.8, "EI": 1.0, "at": 0.3, "clip": 0.5}.get(name, 0.0)
    make = jax.vmap(lambda value: scene(**{name: value}))
    stack = make(jnp.array([default, wrong, default]))
    for solve in (rj.solve_batch, rj.solve_path):
        with pytest.raises(ValueError, match=message):
            solve(stack, **MESH)
    check_ranges(make(jnp.full(3, default)))
    with pytest.raises(ValueError, match=message.replace(r"\[1\]", r"\[1\]\[2\]", 1)):
        check_ranges(jax.vmap(make)(jnp.full((2, 3), default).at[1, 2].set(wrong)))


def test_every_case_of_a_stack_is_looked_at():
    """As making them one by one says, for random scenes near the bounds of what is allowed."""
    random = np.random.default_rng(0)
    count = 200
    ends, ats, clips = (
        random.uniform(1.2, 1.6, count),
        random.uniform(0.95, 1.01, count),
        random.uniform(0.2, 0.6, count),
    )

    def refused(*numbers):
        try:
            scene(*numbers)
        except ValueError:
            return True
        return False

    expected = [refused(end, 1.0, at, clip) for end, at, clip in zip(ends, ats, clips, strict=True)]
    assert 20 < sum(expected) < count - 20
    stack = jax.vmap(lambda end, at, clip: scene(end, 1.0, at, clip))(*map(jnp.asarray, (ends, ats, clips)))
    first = int(np.argmax(expected))
    with pytest.raises(ValueError, match=rf"scenes\[{first}\]"):
        check_ranges(stack)
    check_ranges(jax.tree.map(lambda leaf: leaf[~np.array(expected)], stack))


def test_obstacles_that_differ_are_looked_at_one_by_one():
    def above(radius):
        rod = rj.Rod(1.0, 1.0, 0.7, 1e4, 1.0, radius=0.01)
        ends = rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((0.8, 0, 0), LEVEL)
        return rj.Scene(rod, *ends, obstacles=[rj.Sphere((0.4, 0, -0.3), radius)])

    stack = jax.vmap(above)(jnp.array([0.1, 0.2, -0.1]))
    with pytest.raises(ValueError, match=r"scenes\[2\]\.obstacles\[0\]: radius must be positive"):
        check_ranges(stack)
    check_ranges(jax.tree.map(lambda leaf: leaf[:2], stack))


def hanging(end, length, at):
    ends = rj.Clamp((0, 0, 0), LEVEL), rj.Clamp(jnp.array([1.0, 0, 0]) * end, LEVEL)
    return rj.Scene(rj.Rod(length, 1.0, 0.7, 1e4), *ends, point_forces=[rj.PointForce(at, (0, 0, 0.1))])


@pytest.mark.slow
def test_traced_numbers_are_told_by_the_status_of_the_case():
    cases = jnp.array([[0.8, 1.0, 0.3], [1.6, 1.0, 0.3], [0.8, -1.0, 0.3], [0.8, 1.0, 1.2]])
    result = jax.vmap(lambda case: rj.solve(hanging(*case), **MESH))(cases)
    # An end 1.6 m away from a rod of 1 m is an equilibrium that is strained by 60 %.
    wrong = rj.Status.OUT_OF_RANGE
    np.testing.assert_array_equal(result.status, [rj.Status.CONVERGED, rj.Status.OVERSTRETCHED, wrong, wrong])
    np.testing.assert_array_equal(result.converged, [True, True, False, False])
    assert "2 not converged: a number of the scene makes no sense" in rj.describe(result)


def test_jumps_too_near_for_the_mesh_are_told_by_the_status_of_the_case():
    """Outside `jit` they are refused; inside two of them shared a node without a word."""

    def layered(jump, at):
        rod = rj.Rod(1.0, (rj.Steps(jnp.array([0.5, 1.0]) * jnp.array([1.0, jump]), (1.0, 2.0, 3.0)), 1.0), 0.7, 1e4)
        ends = rj.Clamp((0, 0, 0), LEVEL), rj.Free(force=(0, 0, 0.1))
        return rj.Scene(rod, *ends, point_forces=[rj.PointForce(at, (0, 0, 0.1))])

    # 0.05 of one of 8 elements is 0.00625; what coincides is one place.
    cases = jnp.array([[0.51, 0.3], [0.505, 0.3], [0.7, 0.703], [0.7, 0.7], [0.999, 0.3]])
    result = jax.vmap(lambda case: rj.solve(layered(*case), **MESH))(cases)
    np.testing.assert_array_equal(result.status == rj.Status.OUT_OF_RANGE, [False, True, True, False, True])
    np.testing.assert_array_equal(result.converged, [True, False, False, True, False])


def test_what_a_derivative_is_taken_by_is_checked(monkeypatch):
    """There the numbers become known where the solve begins."""
    monkeypatch.setattr("rodjax.solving.equilibrium._solve", lambda *_: pytest.fail("solved"))
    with pytest.raises(ValueError, match=r"scene: the ends are 1\.6 m apart"):
        jax.grad(lambda end: rj.solve(hanging(end, 1.0, 0.3), **MESH).energy)(1.6)


def test_pins_at_one_place_are_refused_in_any_of_a_stack():
    scene = rj.Scene(rj.Rod(1.0, 1.0, 1.0, 1e4), rj.Pin((0, 0, 0)), rj.Pin((0.5, 0, 0)))
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), scene)
    ends = jnp.array([[0.5, 0, 0], [0, 0, 0], [0.5, 0, 0]])
    stack = eqx.tree_at(lambda scene: scene.end.position, stack, ends)
    with pytest.raises(ValueError, match=r"scenes\[1\]: all pins and clips are at one place"):
        rj.solve_batch(stack, segments=8)
