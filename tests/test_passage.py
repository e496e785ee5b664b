"""A rod that comes through an obstacle is not called converged, and which obstacle it was is said."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import box_mesh

import rodjax as rj
from rodjax import Pin, Rod, Scene
from rodjax.mechanics.passage import SAMPLES, Before, Sampled, passage
from rodjax.model.obstacles import InUnits
from rodjax.solving.status import Status

RADIUS, SPAN = 0.01, 0.8
PIPE = rj.Capsule((0.4, -2, -0.05), (0.4, 2, -0.05), 0.1)  # its top is 0.05 above the pins


def arch(height: float, count: int = SAMPLES) -> np.ndarray:
    """A parabola between the pins, so far above them in its middle."""
    x = np.linspace(0, 1, count)
    return np.stack([SPAN * x, 0 * x, 4 * height * x * (1 - x)], axis=1)


def heavy(length: float, weight: float, obstacles) -> Scene:
    rod = Rod(length, 1.0, 1.0, 100 * weight, weight / 10, radius=RADIUS)
    return Scene(rod, Pin((0, 0, 0)), Pin((SPAN, 0, 0)), (0, 0, -10), obstacles=obstacles)


# --- what counts as having come through ------------------------------------------------------------------------------


judged = jax.jit(passage)


def found(before, after, obstacle, raised=0.0):
    """`raised`: by how much the obstacle goes up meanwhile."""
    radius, nowhere = jnp.full(SAMPLES, RADIUS), jnp.full((SAMPLES, 3), jnp.nan)
    here, there = (InUnits(obstacle, jnp.array([0, 0, -up]), jnp.ones(())) for up in (0.0, raised))
    now = Sampled(jnp.asarray(after), radius, nowhere, (there,))
    return judged(Before(jnp.asarray(before), (here,)), now)


SOLID = {
    "capsule": PIPE,
    "box": rj.Box((0.4, 0, -0.05), (0.2, 4, 0.2)),
    "ball": rj.Sphere((0.4, 0, -0.05), 0.1),
    "plate": rj.Box((0.4, 0, 0.0), (0.3, 4, 0.002)),
    "wire": rj.Capsule((0.4, -2, 0), (0.4, 2, 0), 0.0005),
    "mesh": box_mesh((0.3, -1, -0.15), (0.5, 1, 0.05)),
}


@pytest.mark.parametrize("obstacle", SOLID.values(), ids=SOLID)
def test_through_is_found_and_beside_is_not(obstacle):
    through = found(arch(0.2), arch(-0.3), obstacle)
    assert int(through.obstacle) == 0
    assert not through.is_within
    # Where in it the deepest place is depends on its shape; in the middle, where it is half a length wide.
    assert float(through.place) == pytest.approx(0.5, abs=0.25)
    assert found(arch(0.2), arch(0.11), obstacle).is_sound
    # Sideways, past where it ends.
    aside = np.array([[0, 2.5, 0]])
    assert found(arch(0.2) + aside, arch(-0.3) + aside, obstacle).is_sound
    # An obstacle that itself goes to the other side.
    assert not found(arch(0.2), arch(0.2), obstacle, raised=0.5).is_sound


def test_within_is_found():
    inside = found(arch(0.2), arch(0.03), PIPE)
    assert int(inside.obstacle) == 0
    assert inside.is_within
    below = found(arch(0.2), arch(-0.3), rj.Plane((0, 0, -0.1), (0, 0, 1)))
    assert below.is_within
    # A start that crosses the obstacle is on no side of it.
    assert found(arch(-0.05), arch(0.2), PIPE).is_sound
    assert found(arch(-0.05), arch(-0.4), PIPE).is_sound


def test_a_place_is_through_where_it_was_deeper_than_half_of_the_radius():
    """Straight down beside a wire along the rod; the wire adds its own radius, 1e-4."""
    up = np.array([[0, 0, 1]])
    for depth, is_sound in ((0.25, True), (0.75, False)):
        y = (1 - depth) * RADIUS + 1e-4
        wire = rj.Capsule((-1, y, 0), (2, y, 0), 1e-4)
        assert found(arch(0.0) + up, arch(0.0) - up, wire).is_sound == is_sound


# --- solves ----------------------------------------------------------------------------------------------------------


def random_scenes(count: int) -> tuple[list[Scene], list[np.ndarray]]:
    """Heavy cables laid over a pipe, a box and a floor, each of them somewhere below."""
    rng, scenes, guesses = np.random.default_rng(3), [], []
    for k in range(count):
        height = rng.uniform(0.12, 0.25)
        points = arch(height, 65)
        length = np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1))
        weight = 10 ** rng.uniform(1, 4) / length**3
        size, x = rng.uniform(0.03, 0.1), rng.uniform(0.25, 0.55)
        top = np.interp(x, points[:, 0], points[:, 2]) - rng.uniform(1.5, 4) * size
        far = np.where(np.arange(2) == k % 2, 0.0, 5.0)  # one of the two, the other one out of reach
        obstacles = [
            rj.Capsule((x, -2, top - size - far[0]), (x, 2, top - size - far[0]), size),
            rj.Box((x, 0, top - size - far[1]), (2 * size, 4, 2 * size)),
            rj.Plane((0, 0, -rng.uniform(0.03, 0.3)), (0, 0, 1)),
        ]
        scenes.append(heavy(length, weight, obstacles))
        guesses.append(points)
    return scenes, guesses


def turn_about(points: np.ndarray, centre: np.ndarray) -> float:
    """The angle by which a curve in the plane of x and z goes round a point."""
    angle = np.arctan2(*(points - centre)[:, [2, 0]].T)
    return float(np.unwrap(angle)[-1] - angle[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::rodjax.NotConvergedWarning")
def test_random_heavy_cables_never_come_through_without_a_word():
    scenes, guesses = random_scenes(24)
    right = 0
    for scene, begin in zip(scenes, guesses, strict=True):
        result = rj.solve(scene, segments=32, guess=rj.Guess(begin))
        if not result.converged:
            continue
        pipe, box, _ = scene.obstacles
        assert isinstance(pipe, rj.Capsule)
        assert isinstance(box, rj.Box)
        for centre in (np.asarray(pipe.start), np.asarray(box.center)):
            assert turn_about(np.asarray(result.nodes), centre) == pytest.approx(turn_about(begin, centre), abs=0.1)
        # By a part of the radius over a corner of the box on a mesh that is given, nowhere to the centerline.
        assert float(jnp.min(rj.clearance(result, scene.obstacles, points=7).distance)) > -1.1 * RADIUS
        right += 1
    assert right >= 0.95 * len(scenes)


def above_or_not_converged(result: rj.Equilibrium, axis: rj.Obstacle) -> None:
    """From left to right a rod goes clockwise round what is below it."""
    assert isinstance(axis, rj.Capsule)
    assert not result.converged or turn_about(np.asarray(result.nodes), np.asarray(axis.start)) < 0


@pytest.mark.filterwarnings("ignore::rodjax.NotConvergedWarning")
def test_a_slack_heavy_cable_does_not_fall_through_a_pipe():
    """It came back 0.2 below the pipe, and was called converged."""
    result = rj.solve(heavy(0.92, 1000.0, [PIPE]), segments=32, guess=rj.Guess(arch(0.19)))
    above_or_not_converged(result, PIPE)


@pytest.mark.parametrize("weight", [1.5, 60.0])
def test_no_rod_creeps_through_a_thin_pipe(weight):
    """A quarter as thick as the rod, between two nodes: by short steps rods came through, and were called converged."""
    rod = Rod(1.0, 0.02, 0.015, 1e5, weight / 10, radius=0.008)
    pipe = rj.Capsule((0.45, -0.3, 0.05), (0.45, 0.3, 0.05), 0.002)
    scene = Scene(rod, Pin((0, 0, 0)), Pin((0.9, 0, 0)), (0, 0, -10), obstacles=[pipe])
    x = np.linspace(0, 1, 101)
    above = rj.Guess(np.stack([0.9 * x, 0 * x, 0.15 * np.sin(np.pi * x)], axis=1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rj.NotConvergedWarning)
        given = rj.solve(scene, segments=32, guess=above)
    # It hangs over the pipe, to one side or both, or lies on it: on 32 elements the search may not end.
    nearest = np.argmin(np.abs(np.asarray(given.nodes)[:, 0] - 0.45))
    assert given.nodes[nearest, 2] > 0.05 or not given.converged


def test_a_cable_is_let_down_on_pegs():
    """It came through, or stopped at the largest number of iterations, on 14 of 60 steps to a fifth of this weight."""
    pegs = [rj.Capsule((x, -1, z), (x, 1, z), r) for x, z, r in ((0.3, -0.1, 0.06), (0.6, -0.2, 0.05))]
    result = rj.Guess([(0, 0, 0), (0.5, 0, 0), (1, 0, 0)])
    ends = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Free()
    for weight in np.geomspace(1.0, 1e5, 12):
        rod = rj.Rod(1.0, 1.0, 0.8, 1e6, weight, radius=RADIUS)
        scene = Scene(rod, *ends, (0, 0, -1.0), obstacles=pegs)
        result = rj.solve(scene, segments=32, guess=result, strain_limit=None)
        assert result.converged
        assert result.stable
        # Contacts are exact at the nodes: a gap of 1e-4 of the residual's 1e-8 EI/L^2.
        assert float(jnp.min(rj.clearance(result, pegs, points=0).distance)) > -2e-12
    assert isinstance(result, rj.Equilibrium)
    assert float(jnp.sum(result.contact_forces[:, 2])) > 0.5e5  # most of the weight


def over_a_pipe(raised: float = 0.0) -> Scene:
    """The slack to its left, so that it cannot slide off."""
    return heavy(0.94, 170.0, [rj.Capsule((0.59, -2, raised - 0.083), (0.59, 2, raised - 0.083), 0.12)])


@pytest.fixture(scope="module")
def resting() -> rj.Equilibrium:
    result = rj.solve(over_a_pipe(), segments=32, guess=rj.Guess(arch(0.2)))
    assert result.converged, rj.describe(result)
    return result


def test_a_heavy_cable_rests_on_a_pipe(resting):
    above_or_not_converged(resting, resting.scene.obstacles[0])
    distance = rj.clearance(resting, resting.scene.obstacles, points=7).distance[0]
    assert abs(float(distance)) < 0.05 * RADIUS  # between the nodes of a mesh that is given
    assert float(jnp.sum(resting.contact_forces[:, 2])) > 0.3 * 0.94 * 170.0


def test_a_pipe_that_is_suddenly_above_is_named(resting, tmp_path):
    """Raised by more than its diameter it leaves the rod below: from the last equilibrium it came through."""
    scene = over_a_pipe(0.6)
    with pytest.warns(rj.NotConvergedWarning, match=r"through obstacles\[0\] \(Capsule\) at s = 0\.\d+ m"):
        result = rj.solve(scene, segments=32, guess=resting)
    assert int(result.status) == Status.PASSED_THROUGH
    assert not result.converged
    said = rj.describe(result)
    rj.save(result, tmp_path / "through.vtkhdf")
    assert rj.describe(rj.load(tmp_path / "through.vtkhdf")) == said
    # What begins there came through too, until a guess says that this is where the rod shall be.
    with pytest.warns(rj.NotConvergedWarning, match="through obstacles"):
        again = rj.solve(scene, segments=32, guess=result)
    assert int(again.status) == Status.PASSED_THROUGH
    assert rj.solve(scene, segments=32, guess=rj.Guess(result.nodes)).converged


@pytest.mark.slow
def test_a_step_of_a_path_that_would_come_through_is_parted(resting):
    scenes = [over_a_pipe(raised) for raised in (0.0, 0.2)]
    path = rj.solve_path(scenes, segments=32, guess=resting)
    assert int(path.substeps[1]) > 1
    for k, scene in enumerate(scenes):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], path)
        above_or_not_converged(one, scene.obstacles[0])
