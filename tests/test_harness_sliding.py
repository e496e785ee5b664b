"""Rods of harnesses that slide through clips, against the rod that is not cut."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_harness import ASIDE, END, GRAVITY, START, bent, plain

import rodjax
from rodjax import (
    Body,
    Clamp,
    Clip,
    DistributedForce,
    Free,
    Harness,
    Joint,
    Newton,
    Plane,
    PointForce,
    Scene,
    Sphere,
    Spring,
)

JOINT = Joint("cut", **ASIDE)
PLACE = (0.12, 0.02, -0.25)
BALL = Sphere((0.182, 0.056, -0.37), 0.03)
TIGHT = Newton(tolerance=1e-11)


def cut(rod, clip, length=0.5, gravity=GRAVITY, **loads) -> Harness:
    first = Scene(rod(length), START, JOINT, gravity=gravity, clips=[clip], **loads)
    return Harness({"a": first, "b": Scene(rod(1.0 - length), JOINT, END, gravity=gravity)})


# A clip by frames turns the rod that slides through it, one by tangents holds its direction.
@pytest.mark.parametrize(
    ("rod", "direction"),
    [
        pytest.param(plain, None, id="plain"),
        pytest.param(bent, (0.6, 0.1, -0.8), id="bent", marks=pytest.mark.slow),
    ],
)
def test_a_cut_rod_slides_as_the_rod(rod, direction):
    def scene(at: float) -> Scene:
        return Scene(rod(1.0), START, END, GRAVITY, clips=[Clip(at, PLACE, direction, sliding=True)])

    # Cut at a node, on meshes made where the clip is found in the end: the same nodes.
    at = 0.25
    for _ in range(3):
        whole = rodjax.solve(scene(at), segments=16, solver=TIGHT)
        at = float(whole.scene.clips[0].at)
    clip = Clip(at, PLACE, direction, sliding=True)
    shapes = {"a": rodjax.Guess(whole.nodes[:9]), "b": rodjax.Guess(whole.nodes[8:])}
    parts = rodjax.solve(cut(rod, clip, length=whole.s[8]), segments=8, solver=TIGHT, guess=shapes)
    assert parts.converged
    assert parts.stable
    assert abs(parts["a"].scene.clips[0].at - at) < 1e-9
    nodes = jnp.concatenate([parts["a"].nodes, parts["b"].nodes[1:]])
    np.testing.assert_allclose(nodes, whole.nodes, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts["b"].end_moment, whole.end_moment, rtol=0, atol=1e-9)
    # Nothing pulls along the rod in the clip.
    along = parts["a"].clip_forces[0] @ parts["a"].tangents[jnp.argmin(jnp.abs(parts["a"].s - at))]
    assert abs(along) < 1e-8 * jnp.linalg.norm(parts["a"].clip_forces[0])


def test_meshes_are_made_anew_as_a_rod_slides():
    """From a clip that begins far from where it is found, past a point force whose node it may not share."""
    load = PointForce(0.35, (0.0, 0.0, -0.02))

    def found(at: float):
        clip = Clip(at, PLACE, sliding=True)
        return rodjax.solve(cut(plain, clip, point_forces=[load]), segments=16)

    far, near = found(0.4), found(0.28)
    assert far.converged
    assert near.converged
    places = [float(each["a"].scene.clips[0].at) for each in (far, near)]
    assert abs(places[0] - places[1]) < 1e-4
    lengths = np.diff(np.asarray(far["a"].s))
    # Made anew where elements beside the clip are stretched by a quarter.
    assert np.max(lengths) < 1.6 * np.min(lengths[lengths > 0.01])


def test_derivatives_are_those_of_the_rod_that_slides():
    clip = Clip(0.25, PLACE, sliding=True)

    def place(scale):
        parts = rodjax.solve(cut(plain, clip, gravity=scale * jnp.array(GRAVITY)), segments=8, solver=TIGHT)
        return jnp.stack([parts["a"].scene.clips[0].at, parts.positions[0, 2], parts.energy])

    one, step = jnp.array(1.0), 1e-4
    _, change = jax.jvp(place, (one,), (one,))
    differences = (place(one + step) - place(one - step)) / (2 * step)
    # Differences have errors of step^2 and of roundings by step.
    np.testing.assert_allclose(change, differences, rtol=1e-6, atol=1e-9)


def test_an_end_on_a_spring_slides():
    spring = Spring(END, translation=20.0, rotation=0.05)
    found = rodjax.solve(Scene(plain(1.0), START, spring, GRAVITY, clips=[Clip(0.5, PLACE, sliding=True)]), segments=16)
    assert found.converged
    pulled = found.nodes[-1] - END.position
    np.testing.assert_allclose(found.end_force, -20.0 * pulled, rtol=0, atol=1e-8)


def test_paths_batches_and_files_have_where_the_rod_passes_its_clips(tmp_path):
    clip = Clip(0.25, PLACE, sliding=True)
    harnesses = [cut(plain, clip, gravity=(0.0, 3.0 * scale, -9.81 * scale)) for scale in (1.0, 1.2)]
    path = rodjax.solve_path(harnesses, segments=8)
    assert np.all(path.converged)
    alone = rodjax.solve(harnesses[1], segments=8)
    # Meshes differ by where the clips were when they were made.
    at = float(alone["a"].scene.clips[0].at)
    assert abs(path["a"].scene.clips[0].at[1] - at) < 1e-6
    assert path.iterations[1] < alone.iterations
    batch = rodjax.solve_batch(harnesses, segments=8)
    assert abs(batch["a"].scene.clips[0].at[1] - at) < 1e-9
    rodjax.save(alone, tmp_path / "sliding.vtkhdf")
    assert rodjax.solve(harnesses[1], segments=8, guess=rodjax.load(tmp_path / "sliding.vtkhdf")).iterations == 0
    # Not only minima: as the last step of the path.
    before = rodjax.solve(harnesses[0], segments=8)
    any_kind = rodjax.solve(harnesses[1], segments=8, guess=before, find="equilibrium")
    assert any_kind.converged
    assert any_kind.iterations <= 6
    assert abs(any_kind["a"].scene.clips[0].at - at) < 1e-6


@pytest.mark.parametrize(
    "loads",
    [
        {"obstacles": [BALL]},
        pytest.param({"distributed": [DistributedForce((0.0, 0.3, 0.0), follower=True)]}, marks=pytest.mark.slow),
    ],
    ids=["over a ball", "under a follower force"],
)
def test_a_rod_of_a_harness_slides_as_between_clamps(loads):
    """Where the joint was found, from another start; and the joint is in balance."""
    parts = rodjax.solve(cut(plain, Clip(0.25, PLACE, sliding=True), **loads), segments=8, solver=TIGHT)
    assert parts.converged
    assert parts.stable or "distributed" in loads
    alone = rodjax.solve(parts["a"].scene, segments=8, solver=TIGHT)
    assert alone.converged
    # Residuals of 1e-11 EI/L^2.
    assert abs(alone.scene.clips[0].at - parts["a"].scene.clips[0].at) < 1e-9
    np.testing.assert_allclose(alone.nodes, parts["a"].nodes, rtol=0, atol=1e-9)
    np.testing.assert_allclose(alone.contact_forces, parts["a"].contact_forces, rtol=0, atol=1e-8)
    np.testing.assert_allclose(parts["a"].end_force, parts["b"].start_force, rtol=0, atol=1e-9)
    if "obstacles" in loads:
        assert jnp.linalg.norm(parts["a"].contact_forces.sum(0)) > 0.1
    along = parts["a"].clip_forces[0] @ parts["a"].tangents[jnp.argmin(jnp.abs(parts["a"].s - alone.scene.clips[0].at))]
    assert abs(along) < 1e-8 * jnp.linalg.norm(parts["a"].clip_forces[0])


@pytest.mark.slow
@pytest.mark.exhaustive
def test_derivatives_of_what_slides_over_a_floor():
    """As those of rods that slide, and of rods that touch something, by programs that take minutes to compile."""
    floor = [Plane((0, 0, -0.28), (0, 0, 1))]

    def place(scale):
        gravity = scale * jnp.array(GRAVITY)
        clips = [Clip(0.29, PLACE, sliding=True)]
        first = Scene(plain(0.42), START, JOINT, gravity=gravity, clips=clips, obstacles=floor)
        second = Scene(plain(0.58), JOINT, END, gravity=gravity, obstacles=floor)
        parts = rodjax.solve(Harness({"a": first, "b": second}), segments=8, solver=TIGHT)
        return jnp.stack([parts["a"].scene.clips[0].at, parts.positions[0, 2], parts.energy])

    one, step = jnp.array(1.0), 1e-4
    _, change = jax.jvp(place, (one,), (one,))
    differences = (place(one + step) - place(one - step)) / (2 * step)
    # Differences have errors of step^2 and of roundings by step.
    np.testing.assert_allclose(change, differences, rtol=1e-6, atol=1e-8)


def test_what_does_not_slide_in_a_harness_is_told():
    clip = Clip(0.25, PLACE, sliding=True)
    other = Scene(plain(1.0), Clamp((0, 0.5, 0), rodjax.frame((1, 0, 0))), Free())
    scenes = cut(plain, clip)
    with pytest.raises(ValueError, match=r"cables\['a'\]\.clips must not slide, as it may touch another cable"):
        Harness(dict(zip("abc", [*scenes.scenes, other], strict=True)), {"cut": Body()}, contact=True)
    found = rodjax.solve(scenes, segments=8)
    with pytest.raises(ValueError, match="without sliding clips"):
        rodjax.lowest_mode(found)
    with pytest.raises(ValueError, match="without sliding clips"):
        rodjax.follow([scenes, scenes])
