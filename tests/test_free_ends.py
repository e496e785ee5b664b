"""Rods whose ends are both free: held by clips, by friction where they lie, or by a field."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
import rodjax.cli
from rodjax import Clamp, Clip, Free, Guess, Rod, Scene

GRAVITY = (0.0, 0.0, -9.81)
X = (1.0, 0.0, 0.0)
AT = 0.4


def cable(EI=0.05, length=1.0) -> Rod:
    return Rod(length, EI, 0.03, 1e3, mass_per_length=0.1, radius=0.005)


def cantilevers(EI, obstacles: tuple[rj.Plane, ...], segments: int) -> list[rj.Equilibrium]:
    """What a clip at `AT` makes of the rod, each with as long elements."""
    clamp, before = Clamp((0.0, 0.0, 0.0), rj.frame(X)), round(AT * segments)
    scenes = (
        (Scene(cable(EI, AT), Free(), clamp, GRAVITY, obstacles=obstacles), before),
        (Scene(cable(EI, 1 - AT), clamp, Free(), GRAVITY, obstacles=obstacles), segments - before),
    )
    return [rj.solve(scene, segments=count) for scene, count in scenes]


@pytest.mark.parametrize("has_frames", [False, True])
@pytest.mark.parametrize("obstacles", [(), (rj.Plane((0.0, 0.0, -0.1), (0.0, 0.0, 1.0)),)])
def test_a_rod_in_one_clip_is_two_cantilevers(has_frames, obstacles):
    EI = (0.05, 0.08) if has_frames else 0.05
    held = {"frame": rj.frame(X)} if has_frames else {"tangent": X}
    scene = Scene(cable(EI), Free(), Free(), GRAVITY, clips=[Clip(AT, (0.0, 0.0, 0.0), **held)], obstacles=obstacles)
    result = rj.solve(scene, segments=10)
    left, right = cantilevers(EI, obstacles, 10)
    # The tolerance of 1e-8 EI/L^2 moves a tail by some 1e-9 L; a tail on the floor may lie on either side.
    np.testing.assert_allclose(result.nodes[:5], left.nodes, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.nodes[4:], right.nodes, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.clip_forces[0], left.end_force - right.start_force, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.clip_moments[0], left.end_moment - right.start_moment, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.energy, left.energy + right.energy, rtol=1e-9)
    np.testing.assert_array_equal([result.start_force, result.end_force], np.zeros((2, 3)))
    assert result.stable


def test_forces_on_both_ends_are_those_of_the_results():
    ends = Free(force=(0.0, 0.1, 0.0)), Free(force=(0.0, 0.2, 0.3))
    clips = [Clip(AT, (0.0, 0.0, 0.0), X), Clip(0.6, (0.19, 0.0, 0.0))]
    result = rj.solve(Scene(cable(), *ends, GRAVITY, clips=clips), segments=10)
    np.testing.assert_allclose([-result.start_force, result.end_force], [end.force for end in ends], rtol=1e-15)
    loads = 0.1 * np.array(GRAVITY) + ends[0].force + ends[1].force
    np.testing.assert_allclose(np.sum(result.clip_forces, axis=0), -loads, rtol=0, atol=1e-9)


def test_a_moment_on_a_free_end_is_resisted_by_a_clip_with_a_frame():
    """A plain rod without weight: the tail beyond the clip is bent to a circle of EI/M."""
    clip = Clip(AT, (0.0, 0.0, 0.0), frame=rj.frame(X))
    moment = 0.1
    result = rj.solve(Scene(cable(), Free(), Free(moment=(0.0, moment, 0.0)), clips=[clip]), segments=10)
    angle = moment * 0.6 / 0.05
    # Of fourth order in the turn of an element, 0.12 rad.
    tip = 0.6 / angle * np.array([math.sin(angle), 0.0, math.cos(angle) - 1])
    np.testing.assert_allclose(result.nodes[-1], tip, rtol=0, atol=1e-6)
    np.testing.assert_allclose(result.clip_moments[0], [0.0, -moment, 0.0], rtol=0, atol=1e-9)


@dataclasses.dataclass(frozen=True)
class Bedding:
    """Of springs from a line, in all directions."""

    stiffness: float

    def __call__(self, position, s):
        return self.stiffness / 2 * jnp.sum((position - s * jnp.array(X)) ** 2)


def test_a_beam_with_free_ends_on_an_elastic_bedding_sinks_as_hetenyi_has_it():
    """Under a force in its middle, so small that the beam is linear: Beams on Elastic Foundation, 1946, II.7."""
    stiffness, force, EI = 400.0, 1e-3, 0.05
    k = (stiffness / (4 * EI)) ** 0.25
    middle = rj.PointForce(0.5, (0.0, 0.0, -force))
    scene = Scene(cable(), Free(), Free(), point_forces=[middle], potentials=[rj.Potential(Bedding(stiffness))])
    result = rj.solve(scene, segments=32, guess=Guess([[0.0, 0.0, 0.0], X]))
    deflection = force * k / (2 * stiffness) * (math.cosh(k) + math.cos(k) + 2) / (math.sinh(k) + math.sin(k))
    # Of fourth order: 1.3e-5 seen, 2.3e-4 on 16 elements.
    np.testing.assert_allclose(-result.nodes[16, 2], deflection, rtol=2e-5)
    assert result.stable


def lying(force: float, friction: float = 0.4) -> Scene:
    """A straight rod on a floor, drawn along by its end."""
    floor = rj.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), friction=friction)
    return Scene(cable(), Free(), Free(force=(force, 0.0, 0.0)), GRAVITY, obstacles=[floor])


LINE = Guess([[0.0, 0.0, 0.005], [1.0, 0.0, 0.005]])


@pytest.mark.slow
def test_friction_holds_a_rod_that_lies_on_a_floor():
    """It is drawn along as far as the force goes into it: over F/(mu w), by F^2/(2 EA mu w)."""
    bound = 0.4 * 0.1 * 9.81
    force = 0.6 * bound
    result = rj.solve(lying(force), segments=64, guess=LINE)
    np.testing.assert_allclose(np.sum(result.friction_forces[0], axis=0), [-force, 0.0, 0.0], rtol=0, atol=1e-9)
    # A node bears what it is beside: slips end within an element.
    assert np.sum(result.contact_states[0] == 2) == pytest.approx(0.6 * 64, abs=1)
    # Of second order in the length of an element over that which slips, 2.6e-2.
    assert result.nodes[-1, 0] - 1 == pytest.approx(force**2 / (2 * 1e3 * bound), rel=1e-3)
    assert result.stable
    with pytest.warns(rj.NotConvergedWarning):
        assert not rj.solve(lying(1.05 * bound), segments=64, guess=LINE).converged


def test_what_holds_nothing_is_refused(tmp_path, capsys):
    with pytest.raises(ValueError, match="hold the rod by a Clip, by obstacles with friction or by a potential"):
        lying(0.0, friction=0)
    with pytest.raises(ValueError, match="guess must be given where no end or clip is held"):
        rj.solve(lying(0.0), segments=8)
    rj.write_scene(lying(0.0), tmp_path / "lying.toml")
    assert rodjax.cli.main(["solve", str(tmp_path / "lying.toml")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "no end and no clip is held, and a file has no guess" in line


@pytest.mark.slow
def test_derivatives_and_the_continuum():
    """Of a flat rod in a clip that holds its frame, and another one."""

    def scene(stiffness, weight):
        clips = [Clip(AT, (0.0, 0.0, 0.0), frame=rj.frame(X)), Clip(0.6, (0.19, 0.02, 0.0))]
        return Scene(cable((stiffness, 0.08)), Free(), Free(), weight * jnp.array(GRAVITY), clips=clips)

    def seen(numbers):
        result = rj.solve(scene(*numbers), segments=10, solver=rj.Newton(tolerance=1e-11))
        return jnp.concatenate([result.nodes[0], result.nodes[-1], result.clip_forces[0], result.energy[None]])

    numbers = jnp.array([0.05, 1.0])
    found, step = jax.jacfwd(seen)(numbers), 1e-5
    for k in range(2):
        change = jnp.zeros(2).at[k].set(step)
        difference = (seen(numbers + change) - seen(numbers - change)) / (2 * step)
        # The difference's own error of third derivatives times step^2, and of tolerance over step.
        np.testing.assert_allclose(found[:, k], difference, rtol=1e-5, atol=1e-6)
    fine = rj.solve(scene(*numbers), segments=40)
    exact = rj.solve_continuum(scene(*numbers), guess=fine)
    # Of fourth order; seen 4e-6, 2e-5, 7e-5 on 40 elements.
    np.testing.assert_allclose(fine.nodes, exact.position_at(fine.s), rtol=0, atol=2e-5)
    np.testing.assert_allclose(fine.clip_forces, exact.clip_forces, rtol=1e-4, atol=1e-4)
