"""First shapes beside obstacles: strings that are led out of them and drawn in to the length of the rod."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scenes import box_mesh
from scipy.spatial.transform import Rotation

import rodjax as rj
from rodjax.discretization.first_shape import first_shape
from rodjax.mechanics.taut import DRAWN_PIECES, drawn_in, taut
from rodjax.model.scene import nondimensional
from rodjax.solving import guess
from rodjax.solving.guess import beside_obstacles

RADIUS = 0.005
PIPE = rj.Capsule((0.3, -1, 0), (0.3, 1, 0), 0.1)
NO_TANGENTS = np.zeros((2, 3))


def parabola(span: float, height: float, count: int = 65) -> np.ndarray:
    u = np.linspace(0, 1, count)
    return np.stack([span * u, 0 * u, 4 * height * u * (1 - u)], axis=1)


def length_of(points) -> float:
    return float(np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def drawn(points: np.ndarray, length: float, obstacles=(PIPE,), tangents=NO_TANGENTS):
    begin, held, radius, size = map(jnp.asarray, (points, tangents, RADIUS, length))
    string, is_needed = drawn_in(begin, held, obstacles, radius, size)
    return np.asarray(string), bool(is_needed)


def around_the_pipe(distance: float) -> float:
    """The least length from one pin to the other over the pipe: two tangents and an arc of 0.3 beside its axis."""
    tangent = np.sqrt(0.3**2 - distance**2)
    return 2 * tangent + distance * (np.pi - 2 * np.arccos(distance / 0.3))


def test_a_string_is_drawn_in_to_the_length_of_the_rod():
    begin = parabola(0.6, 0.4)
    string, is_needed = drawn(begin, 0.8)
    assert is_needed
    # The last round makes it shorter by less than a thousandth; places are spread along its chords.
    assert 0.798 < length_of(string) <= 0.8
    assert np.max(string[:, 2]) > 0.1  # on its side of the pipe
    np.testing.assert_allclose(string[[0, -1]], begin[[0, -1]], atol=1e-15)
    steps = np.linalg.norm(np.diff(string, axis=0), axis=1)
    np.testing.assert_allclose(steps, np.mean(steps), rtol=1e-3)


def test_a_string_too_short_for_its_side_is_taut_there():
    string, is_needed = drawn(parabola(0.6, 0.4), 0.61)
    assert is_needed
    # Kept away by a tenth more than the radius; chords of 1/64 lack 1e-5, rounds end at 1e-7 of a length each.
    assert length_of(string) == pytest.approx(around_the_pipe(0.1 + 1.1 * RADIUS), abs=1e-3)
    needed, touched = taut(jnp.asarray(string), (PIPE,), jnp.asarray(RADIUS))
    assert float(needed) == pytest.approx(around_the_pipe(0.1 + RADIUS), abs=2e-4)
    assert bool(touched[0])


def test_a_string_across_the_middle_of_a_box_is_led_to_one_side():
    """The distance leads one half of it forwards, the other backwards; out of its top it is nearest, however all of it
    is turned in space.
    """
    size, center = np.array([0.2, 0.4, 0.6]), np.array([0.3, 0.0, -0.25])
    begin = parabola(0.6, -0.05)
    strings = []
    for turn in (np.eye(3), Rotation.from_rotvec([0.5, -1.1, 2.3]).as_matrix()):
        box = rj.Box(turn @ center, size, turn)
        string, is_needed = drawn(begin @ turn.T, 1.0, (box,))
        assert is_needed
        np.testing.assert_array_less(RADIUS, np.asarray(box.distance(string[1:-1])))
        strings.append(string @ turn)
    over = strings[0][(strings[0][:, 0] > 0.2) & (strings[0][:, 0] < 0.4)]
    assert len(over) > 5
    assert np.min(over[:, 2]) > 0.05
    np.testing.assert_allclose(strings[1], strings[0], atol=1e-9)


def test_a_string_under_a_pipe_on_a_floor_is_led_over_both():
    """The floor alone leads it up into the pipe, whose lower half leads it down again."""
    floor, pipe = rj.Plane((0, 0, -0.1), (0, 0, 1)), rj.Cylinder((0.3, -1, -0.08), (0.3, 1, -0.08), 0.03)
    string, is_needed = drawn(parabola(0.6, -0.2), 0.8, (floor, pipe))
    assert is_needed
    for obstacle in (floor, pipe):
        np.testing.assert_array_less(RADIUS, np.asarray(obstacle.distance(string[1:-1])))
    # Over the pipe, whose highest place is at -0.05.
    assert np.min(np.interp(0.3, string[:, 0], string[:, 2])) > -0.05 + RADIUS


ACROSS = {
    # The string is out of the pipe sooner along the floor, at a place from which edges lead back through the pipe.
    "pipe": (rj.Capsule((0.5, -0.3, 0.02), (0.5, 0.3, 0.02), 0.02), (0.431, -0.003, 0.045), (0.87, -0.5, 0)),
    # Between pipe and floor is 5 mm, and the rod 8 mm thick: out of both, the string lies half before and half behind.
    "raised pipe": (rj.Capsule((0.5, -0.3, 0.025), (0.5, 0.3, 0.025), 0.02), (0.427, -0.006, 0.052), (0.88, -0.475, 0)),
    # The nearer face of the step is below the floor, which leads back up into the step.
    "step": (rj.Box((0.56, 0, 0), (0.2, 0.8, 0.035)), (0.4253, -0.006, 0.0472), (0.875, -0.484, 0.001)),
}


@pytest.mark.parametrize("obstacle", ACROSS)
def test_a_string_obliquely_under_an_obstacle_on_a_floor_is_led_over_it(obstacle):
    above, begin, tangent = ACROSS[obstacle]
    scene = rj.Scene(
        rj.Rod(0.32, 1.0, 0.7, 1e5, mass_per_length=37.5, radius=0.004),
        rj.Clamp(begin, rj.frame(tangent)),
        rj.Clamp((0.6, -0.18, 0.05), rj.frame((2, -1, 0))),
        (0, 0, -9.81),
        obstacles=[rj.Plane((0, 0, 0), (0, 0, 1)), above],
    )
    scaled, units = nondimensional(scene)
    nodes = np.asarray(beside_obstacles(scaled, first_shape(scaled, 64), 32)) * float(units.length)
    nodes += np.asarray(units.origin)
    between = (nodes[1:] + nodes[:-1]) / 2
    for one in scene.obstacles:
        # Nodes lie on chords of the string, which is a tenth of the radius farther out; an edge may cut a corner.
        np.testing.assert_array_less(0.9 * 0.004, np.asarray(one.distance(nodes)))
        np.testing.assert_array_less(0.3 * 0.004, np.asarray(one.distance(between)))


def test_what_lies_within_is_led_out_with_the_tangents_of_supports():
    first, last = np.array([[0.6, 0.0, 0.8], [1.0, 0.0, 0.0]])
    string, is_needed = drawn(parabola(0.6, 0.02), 0.9, tangents=np.stack([first, last]))
    assert is_needed
    distances = np.asarray(PIPE.distance(string[1:-1]))
    np.testing.assert_array_less(RADIUS, distances)
    # Chords of the first and last piece, before places are spread evenly: within 5 degrees.
    for chord, tangent in ((string[1] - string[0], first), (string[-1] - string[-2], last)):
        assert np.dot(chord, tangent) / np.linalg.norm(chord) > np.cos(np.deg2rad(5))


def test_a_shape_that_fits_is_left_as_it_is():
    """As long as the rod to 2 %, and nowhere nearer to the pipe than by a hundredth of the radius."""
    begin = parabola(0.6, 0.15, DRAWN_PIECES + 1)
    string, is_needed = drawn(begin, length_of(begin) / 1.01)
    assert not is_needed
    assert not np.array_equal(string, begin)  # spread, and not asked for
    scene = rj.Scene(rj.Rod(1.0, 1.0, 1.0, 1e6, 1.0, radius=RADIUS), rj.Pin((0, 0, 0)), rj.Pin((0.6, 0, 0)))
    # The guess of a rod without obstacles does not know of any of this, and a rod far from them has the same bits.
    far = rj.Capsule((0.3, -1, -9), (0.3, 1, -9), 0.1)
    long = rj.Guess(parabola(0.6, 0.4))
    results = [
        rj.solve(
            rj.Scene(scene.rod, scene.start, scene.end, (0, 0, -9.81), obstacles=obstacles), segments=8, guess=long
        )
        for obstacles in ((), (far,))
    ]
    np.testing.assert_allclose(results[0].nodes, results[1].nodes, atol=1e-9)


@pytest.mark.parametrize("clips", [(), [rj.Clip(0.5, (0.39, 0, -0.05))]], ids=["free", "in a clip"])
def test_a_cable_comes_to_rest_over_pipes_on_a_floor(clips):
    """Its first shape sags below both. Led out of one and of the other by turns, it was pressed to nothing between; in
    a clip it was not led out at all.
    """
    floor = rj.Plane((0, 0, -0.1), (0, 0, 1))
    pipes = [rj.Cylinder((x, -1, -0.09), (x + 0.1, 1, -0.09), radius) for x, radius in ((0.22, 0.03), (0.58, 0.02))]
    start, end = (rj.Clamp((x, 0, z), rj.frame((1, 0, 0))) for x, z in ((0.0, 0.0), (0.78, 0.05)))
    rod = rj.Rod.circular(1.0, RADIUS, 1e7, poisson_ratio=0.5, density=1200.0)
    scene = rj.Scene(rod, start, end, (0, 0, -9.81), obstacles=[floor, *pipes], clips=clips)
    result = rj.solve(scene, segments=32)
    assert result.converged
    assert int(result.iterations) <= 30  # 20 and 16 seen, more than 100 before
    for obstacle in (floor, *pipes):
        assert np.min(obstacle.distance(result.nodes)) > RADIUS - 1e-9


def test_a_thin_rod_comes_out_of_a_floor_in_whole_steps():
    """Half spaces shorten no steps that lead deeper into them between nodes than the rod is thick: 100 did not do."""
    floor = rj.Plane((0, 0, -0.2), (0, 0, 1))
    ends = (rj.Clamp((x, 0, 0), rj.frame((1, 0, 0))) for x in (0.0, 0.6))
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6, 300.0, radius=3e-4)
    result = rj.solve(rj.Scene(rod, *ends, (0, 0, -1.0), obstacles=[floor]), segments=64)
    assert result.converged
    assert int(result.iterations) <= 30
    # To rounding.
    assert np.min(floor.distance(result.nodes)) > 3e-4 - 1e-12


# Of `random_scene` of `experiments/contact.py`: the first begins a fifth too long below a pipe and beside a box, the
# next two within boxes. The rods of two more are tight around pipes, whose curvature they have, so that the nearest
# place of an element is anywhere: four sets of contacts came in turn. The first shape of the last is pushed against a
# pipe with 1e6 EI/L^2, for which no shift of rotations was enough. Ends, tangents in the plane, weight, capsule (start,
# end, radius), box (center, size), cylinder.
SCENES = {
    "too long": (
        (0.60637743, (0.85658923, -0.51599892), (0.89873231, -0.4384977), 1.09834266),
        ((0.6052, -0.9602, -0.193), (0.0463, 0.9602, -0.193), 0.0745),
        ((0.4611, 0.0, -0.2229), 0.0978),
        ((0.3292, -0.4863, -10.341), (0.5614, 0.4863, -10.341), 0.044),
    ),
    "within a box": (
        (0.46291043, (0.86279475, -0.50555437), (0.99661428, 0.08221905), 111.57006897),
        ((0.2736, -0.9996, 0.0353), (0.3321, 0.9996, 0.0353), 0.0462),
        ((0.3506, 0.0, -0.4169), 0.1728),
        ((0.3404, -0.4998, -0.2069), (0.3676, 0.4998, -0.2069), 0.0564),
    ),
    "heavy": (
        (0.65716401, (0.92948503, 0.36885984), (0.99949781, 0.03168811), 6420.22206826),
        ((0.3101, -0.9816, -0.1179), (-0.0714, 0.9816, -0.1179), 0.0789),
        ((0.4934, 0.0, -0.4263), 0.1694),
        ((0.2546, -0.4984, -0.2627), (0.3352, 0.4984, -0.2627), 0.0658),
    ),
    "tight around a capsule": (
        (0.41363542, (0.99749019, -0.0708048), (0.86453938, -0.50256508), 25.28689465),
        ((0.267, -0.9877, -0.3666), (-0.0463, 0.9877, -0.3666), 0.0387),
        ((0.1421, 0.0, -10.3126), 0.1482),
        ((0.2108, -0.496, -10.4225), (0.3364, 0.496, -10.4225), 0.0821),
    ),
    "tight around a cylinder": (
        (0.57370977, (0.99839223, -0.05668301), (0.87819615, -0.47830066), 3.64277486),
        ((0.2588, -0.9913, -0.0735), (0.5213, 0.9913, -0.0735), 0.0695),
        ((0.3936, 0.0, -0.0067), 0.1838),
        ((0.3274, -0.4964, -0.2957), (0.4471, 0.4964, -0.2957), 0.0355),
    ),
    "pushed hard": (
        (0.62709998, (0.83574484, 0.54911798), (0.99943664, -0.03356195), 52.8620741),
        ((0.0398, -0.9684, 0.0107), (0.5389, 0.9684, 0.0107), 0.079),
        ((0.1386, 0.0, -0.3259), 0.1072),
        ((0.352, -0.4861, -0.4748), (0.5858, 0.4861, -0.4748), 0.0344),
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_starts_that_are_too_long_or_within_obstacles_come_to_rest(name):
    (span, first, last, weight), capsule, (center, size), cylinder = SCENES[name]
    obstacles = [rj.Capsule(*capsule), rj.Box(center, (size, 2.0, size)), rj.Cylinder(*cylinder)]
    start, end = (rj.Swivel((x, 0, 0), (tangent[0], 0, tangent[1])) for x, tangent in ((0.0, first), (span, last)))
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6, weight, radius=RADIUS)
    scene = rj.Scene(rod, start, end, (0, 0, -1), obstacles=obstacles)
    begin = parabola(span, -0.6 * np.sqrt(1 - span**2))
    begin[:, 1] = 0.02 * np.sin(np.pi * np.linspace(0, 1, len(begin)))
    result = rj.solve(scene, segments=48, guess=rj.Guess(begin), strain_limit=None)
    assert bool(result.converged)
    assert bool(result.stable)
    # At contact points to rounding; the supports are no nearer.
    distances = np.min([np.asarray(obstacle.distance(result.nodes)) for obstacle in obstacles], axis=0)
    assert np.min(distances) > RADIUS - 1e-9


def test_a_shape_is_led_out_of_small_meshes(monkeypatch):
    """As out of the same box; a mesh of many triangles leaves it as it is."""
    low, high = np.array([0.2, -1.0, -0.4]), np.array([0.4, 1.0, 0.05])
    box, mesh = rj.Box((low + high) / 2, high - low), box_mesh(low, high)
    rod, ends = rj.Rod(1.0, 1.0, 0.8, 1e6, 1.0, radius=RADIUS), (rj.Pin((x, 0, 0)) for x in (0.0, 0.6))
    scene, begin = rj.Scene(rod, *ends), jnp.asarray(parabola(0.6, -0.2))

    def led(obstacle: rj.Obstacle) -> np.ndarray:
        scaled, _ = nondimensional(dataclasses.replace(scene, obstacles=[obstacle]))
        return np.asarray(by_numpy(lambda points: beside_obstacles(scaled, points, 64))(begin))

    found = led(mesh)
    np.testing.assert_allclose(found, led(box), atol=1e-9)
    np.testing.assert_array_less(RADIUS, np.asarray(box.distance(found[1:-1])))
    monkeypatch.setattr(guess, "MOST_TRIANGLES", len(mesh.triangles) - 1)
    np.testing.assert_array_equal(led(mesh), begin)


def cantilever(weight: float, obstacles: list[rj.Obstacle], turn=None, *, is_reversed: bool = False) -> rj.Scene:
    """A cable that points along x, straight at first."""
    turn = np.eye(3) if turn is None else turn
    rod = rj.Rod(1.0, 1.0, 0.8, 1e6, weight, radius=RADIUS)
    start = rj.Clamp((0.0, 0.0, 0.0), turn @ np.asarray(rj.frame((-1.0 if is_reversed else 1.0, 0.0, 0.0))))
    ends = (rj.Free(), start) if is_reversed else (start, rj.Free())
    return rj.Scene(rod, *ends, turn @ np.array([0.0, 0.0, -1.0]), obstacles=obstacles)


# The first within which a straight cable ends, the second that it goes through in the middle.
BOXES = {"it ends within": ((0.9, 0.0, 0.0), 0.24), "through the middle": ((0.4, 0.0, 0.0), 0.2)}


@pytest.mark.parametrize("name", BOXES)
def test_a_free_end_is_led_out_on_top(name):
    """However all of it is turned, and whichever end is free."""
    center, size = np.array(BOXES[name][0]), BOXES[name][1]
    straight = np.linspace(0, 1, 65)[:, None] * np.array([1.0, 0.0, 0.0])
    found = []
    for turn, is_reversed in (
        (np.eye(3), False),
        (np.eye(3), True),
        (Rotation.from_rotvec([0.5, -1.1, 2.3]).as_matrix(), False),
    ):
        scene, units = nondimensional(
            cantilever(1.0, [rj.Box(turn @ center, (size, 2.0, size), turn)], turn, is_reversed=is_reversed)
        )
        assert float(units.length) == 1.0
        points = straight @ turn.T
        nodes = np.asarray(beside_obstacles(scene, jnp.asarray(points[::-1] if is_reversed else points), 64))
        found.append((nodes[::-1] if is_reversed else nodes) @ turn)
    over, reversed_, turned = found
    np.testing.assert_allclose(reversed_, over, atol=1e-5)  # the axes of the scene, with another clamp, by 3e-6
    np.testing.assert_allclose(turned, over, atol=1e-9)
    box = rj.Box(center, (size, 2.0, size))
    np.testing.assert_array_less(RADIUS, np.asarray(box.distance(over)))
    inside = np.abs(over[:, 0] - center[0]) < size / 2
    assert np.sum(inside) > 5
    assert np.min(over[inside, 2]) > size / 2
    np.testing.assert_allclose(over[0], 0.0, atol=1e-15)
    # Cut by chords of the string before it is led out once more.
    assert length_of(over) == pytest.approx(1.0, abs=1e-2)
    chord = over[1] - over[0]
    assert chord[0] / np.linalg.norm(chord) > np.cos(np.deg2rad(5))  # along the clamp, as above


# Weight, capsule, box, sphere: a straight cable goes through one or two of them, and the others are far away. None of
# these came to rest from there: the search came through, was pressed to nothing, or found no better point.
FAR = 9.0
FREE_SCENES = {
    "capsule and sphere": (
        1063.632,
        ((0.693, -0.469, -0.029), (0.961, 0.531, -0.029), 0.026),
        ((0.0, 0.0, FAR), 0.1),
        ((0.792, -0.042, -0.007), 0.085),
    ),
    "box": (
        1808.897,
        ((0.0, -1.0, FAR), (0.0, 1.0, FAR), 0.1),
        ((0.672, 0.043, -0.007), 0.18),
        ((0.0, 0.0, FAR), 0.1),
    ),
    "capsule and box": (
        377.605,
        ((0.918, -0.55, -0.038), (0.978, 0.45, -0.038), 0.063),
        ((0.427, -0.021, 0.004), 0.164),
        ((0.0, 0.0, FAR), 0.1),
    ),
}


@pytest.mark.parametrize("is_reversed", [False, True])
def test_a_free_end_beyond_a_clip_is_led_out(is_reversed):
    """Straight on from the clip it goes through the middle of a box; before the clip the shape stays."""
    box, along = rj.Box((0.6, 0.0, 0.0), (0.2, 2.0, 0.2)), rj.frame((-1.0 if is_reversed else 1.0, 0.0, 0.0))
    clamp, at = rj.Clamp((0.0, 0.0, 0.0), along), 0.7 if is_reversed else 0.3
    ends = (rj.Free(), clamp) if is_reversed else (clamp, rj.Free())
    rod, clip = rj.Rod(1.0, 1.0, 0.8, 1e6, 1.0, radius=RADIUS), rj.Clip(at, (0.3, 0.0, 0.0), tangent=along[:, 2])
    scene, _ = nondimensional(rj.Scene(rod, *ends, (0, 0, -1.0), clips=[clip], obstacles=[box]))
    straight = np.linspace(0, 1, 65)[:, None] * np.array([1.0, 0.0, 0.0])
    begin = jnp.asarray(straight[::-1] if is_reversed else straight)
    nodes = np.asarray(by_numpy(lambda points: beside_obstacles(scene, points, 64))(begin))
    nodes = nodes[::-1] if is_reversed else nodes
    np.testing.assert_array_equal(nodes[:20], straight[:20])  # the clip is between nodes 19 and 20
    # Kept away by a tenth more than the radius; nodes between places of the string are within the edge's arc of that
    # radius by the height of a chord.
    away, chord = 1.1 * RADIUS, 0.7 / DRAWN_PIECES
    np.testing.assert_array_less(away - chord**2 / (8 * away), np.asarray(box.distance(nodes)))
    # On top, against gravity.
    assert np.min(np.interp(0.6, nodes[:, 0], nodes[:, 2])) > 0.1 + RADIUS


@pytest.mark.parametrize("name", FREE_SCENES)
def test_a_cable_with_a_free_end_whose_first_shape_is_through_obstacles_comes_to_rest(name):
    weight, capsule, (center, size), sphere = FREE_SCENES[name]
    obstacles = [rj.Capsule(*capsule), rj.Box(center, (size, 1.0, size)), rj.Sphere(*sphere)]
    result = rj.solve(cantilever(weight, obstacles), segments=32)
    assert bool(result.converged)
    assert bool(result.stable)
    distances = np.min([np.asarray(obstacle.distance(result.nodes)) for obstacle in obstacles], axis=0)
    assert np.min(distances) > RADIUS - 1e-9  # as above
