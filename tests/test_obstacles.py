"""Obstacles: signed distances and their gradients, meshes from files, and the clearance of rods."""

import functools
import itertools
import sys
from typing import Any

import equinox as eqx
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings

import rodjax as rj
from rodjax.model.obstacles import checked_obstacles

FRAME = np.asarray(rj.frame((1, 2, 3), (0, 1, 1)))
CENTER, SIZE = np.array([0.3, -0.2, 0.1]), np.array([0.8, 0.5, 0.3])
# Corners of the unit cube in binary order, and its faces, anticlockwise as seen from outside.
CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
SQUARES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = [triangle for a, b, c, d in SQUARES for triangle in ((a, b, c), (a, c, d))]
OBSTACLES = {
    "plane": rj.Plane(CENTER, (1, 2, 2)),
    "sphere": rj.Sphere(CENTER, 0.4),
    "capsule": rj.Capsule((0, 0, 0), (1, 0, 0), 0.2),
    "pipe": rj.Pipe([(0, 0, 0), (1, 0, 0), (1, 0.5, 0.2)], 0.2),
    "cylinder": rj.Cylinder((0, 0, 0), (0, 0.6, 0.8), 0.3),
    "box": rj.Box(CENTER, SIZE, FRAME),
    "level box": rj.Box(CENTER, SIZE),
    "union": rj.Union(rj.Sphere((0, 0, 0), 0.4), rj.Box((1, 0, 0), (0.5, 0.5, 0.5))),
    "mesh": rj.Mesh(CENTER + (SIZE * (CORNERS - 0.5)) @ FRAME.T, TRIANGLES),
    "function": rj.Distance(lambda point: point[2] - 0.25),
}
SPHERE = rj.Sphere((0, 0, 0), 1)


class Torus(rj.Obstacle):
    """About the z axis; with plain Python numbers for fields."""

    radius: float
    thickness: float

    def at(self, point):
        across = jnp.sqrt(point[0] ** 2 + point[1] ** 2) - self.radius
        return jnp.sqrt(across**2 + point[2] ** 2) - self.thickness


POINTS = np.random.default_rng(5).normal(size=(200, 3))


def gradients(obstacle: rj.Obstacle, points: np.ndarray) -> np.ndarray:
    return np.asarray(_gradients(obstacle, jnp.asarray(points)))


@jax.jit
def _gradients(obstacle, points):
    return jax.vmap(jax.grad(lambda point: obstacle.distance(point)))(points)


@pytest.mark.parametrize(
    ("obstacle", "point", "expected"),
    [
        (rj.Plane((0, 0, 1), (0, 0, 3)), (5, 6, 3), 2),
        (rj.Plane((0, 0, 1), (0, 0, 3)), (5, 6, 0), -1),
        (rj.Sphere((1, 0, 0), 0.5), (1, 3, 4), 4.5),
        (rj.Sphere((1, 0, 0), 0.5), (1, 0, 0), -0.5),
        (rj.Capsule((0, 0, 0), (2, 0, 0), 0.5), (1, 3, 4), 4.5),
        (rj.Capsule((0, 0, 0), (2, 0, 0), 0.5), (5, 4, 0), 4.5),
        (rj.Capsule((0, 0, 0), (2, 0, 0), 0.5), (-3, 0, 4), 4.5),
        (rj.Capsule((0, 0, 0), (2, 0, 0), 0.5), (2.3, 0, 0), -0.2),
        (rj.Pipe([(0, 0, 0), (2, 0, 0), (2, 2, 0)], 0.5), (1, -3, 4), 4.5),
        (rj.Pipe([(0, 0, 0), (2, 0, 0), (2, 2, 0)], 0.5), (5, 1, 4), 4.5),
        (rj.Pipe([(0, 0, 0), (2, 0, 0), (2, 2, 0)], 0.5), (2.3, 1.0, 0.0), -0.2),
        (rj.Cylinder((0, 0, 0), (2, 0, 0), 0.5), (1, 3, 4), 4.5),
        (rj.Cylinder((0, 0, 0), (2, 0, 0), 0.5), (5, 0, 0.4), 3),
        (rj.Cylinder((0, 0, 0), (2, 0, 0), 0.5), (5, 0, 4.5), 5),
        (rj.Cylinder((0, 0, 0), (2, 0, 0), 0.5), (1, 0.2, 0), -0.3),
        (rj.Cylinder((0, 0, 0), (2, 0, 0), 0.5), (1.9, 0.2, 0), -0.1),
        (rj.Box((1, 1, 1), (2, 2, 2)), (1, 1, 5), 3),
        (rj.Box((1, 1, 1), (2, 2, 2)), (1, 5, 6), 5),
        (rj.Box((1, 1, 1), (2, 2, 2)), (-1, -2, 4), 3),
        (rj.Box((1, 1, 1), (2, 2, 2)), (0.7, 1, 1.9), -0.1),
        (rj.Box((0, 0, 0), (2, 4, 6), rj.frame((1, 0, 0), (0, 1, 0))), (5, 0, 0), 2),
        (rj.Union(rj.Sphere((0, 0, 0), 1), rj.Sphere((5, 0, 0), 2)), (2, 0, 0), 1),
        (rj.Union(rj.Sphere((0, 0, 0), 1), rj.Sphere((5, 0, 0), 2)), (2.5, 0, 0), 0.5),
        (rj.Distance(lambda point: point[2]), (5, 6, 3), 3),
        (rj.Mesh(CORNERS, TRIANGLES), (0.5, 0.3, 3), 2),
        (rj.Mesh(CORNERS, TRIANGLES), (0.5, 4, 5), 5),
        (rj.Mesh(CORNERS, TRIANGLES), (-1, 3, -2), 3),
        (rj.Mesh(CORNERS, TRIANGLES), (0.9, 0.5, 0.4), -0.1),
    ],
)
def test_distances_in_closed_form(obstacle, point, expected):
    assert float(obstacle.distance(point)) == pytest.approx(expected, rel=1e-14, abs=1e-15)


@pytest.mark.parametrize("name", ["mesh", "box"])
def test_a_box_is_as_far_as_its_surface(name):
    """Its six faces sampled 1/200 of an edge apart: no sample is nearer, and one almost as near."""
    grid = np.linspace(-0.5, 0.5, 201)
    u, v = (x.reshape(-1) for x in np.meshgrid(grid, grid))
    faces = [np.insert(np.stack([u, v], axis=1), axis, side, axis=1) for axis in range(3) for side in (-0.5, 0.5)]
    surface = CENTER + (SIZE * np.concatenate(faces)) @ FRAME.T
    is_inside = np.all(np.abs((POINTS - CENTER) @ FRAME) < SIZE / 2, axis=1)
    nearest = np.array([np.min(np.linalg.norm(surface - point, axis=1)) for point in POINTS])
    distance = np.asarray(OBSTACLES[name].distance(POINTS))
    np.testing.assert_array_equal(distance < 0, is_inside)
    assert np.all(np.abs(distance) <= nearest * (1 + 1e-12))
    np.testing.assert_allclose(np.abs(distance), nearest, rtol=0, atol=4e-3)


def test_the_mesh_of_a_box_is_the_box():
    box, mesh = OBSTACLES["box"], OBSTACLES["mesh"]
    np.testing.assert_allclose(mesh.distance(POINTS), box.distance(POINTS), rtol=0, atol=1e-14)
    np.testing.assert_allclose(gradients(mesh, POINTS), gradients(box, POINTS), rtol=0, atol=1e-11)


def test_a_fine_mesh_of_a_sphere_is_one_within_its_error():
    """Triangles that touch a sphere from inside, in several blocks of points."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    mesh = rj.Mesh(sphere.vertices, sphere.faces)
    error = mesh.distance(POINTS) - SPHERE.distance(POINTS)
    assert np.all(error >= -1e-12)
    assert np.all(error < 0.007)


@pytest.mark.parametrize("name", OBSTACLES)
def test_gradients_outside_have_unit_length(name):
    obstacle = OBSTACLES[name]
    outside = np.asarray(obstacle.distance(POINTS)) > 1e-3
    assert np.sum(outside) > 50
    lengths = np.linalg.norm(gradients(obstacle, POINTS), axis=1)
    np.testing.assert_allclose(lengths[outside], 1, rtol=0, atol=1e-12)


# Centres, corners, edges, faces, axes and ends of all of them.
PLACES = st.sampled_from(
    [
        *(CENTER + (SIZE * (corner - 0.5)) @ FRAME.T for corner in CORNERS),
        *(CENTER + SIZE * np.array(corner) for corner in itertools.product((-0.5, 0.0, 0.5), repeat=3)),
        *np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, 0], [-0.2, 0, 0], [0.5, 0.2, 0], [0, 0.6, 0.8], [0, 0.3, 0.4]]),
        *np.array([[0.3, 0, 0], [0.75, 0.25, 0.25], [1, 0, 0.25], [0.3, 0.6, 0.8], [0, 1.2, 1.6], [2, 0, 0]]),
    ]
)
ANYWHERE = hnp.arrays(float, (3,), elements=st.floats(-2, 2))
FEW = settings(max_examples=60, deadline=None, derandomize=True, database=None)


@pytest.mark.parametrize("name", OBSTACLES)
def test_gradients_are_finite_everywhere(name):
    @FEW
    @given(PLACES | ANYWHERE)
    def check(point):
        gradient = gradients(OBSTACLES[name], point[None])[0]
        assert np.all(np.isfinite(gradient))
        assert np.linalg.norm(gradient) <= 1 + 1e-12

    check()


@pytest.mark.parametrize("name", OBSTACLES)
def test_distances_change_by_no_more_than_the_way(name):
    @FEW
    @given(PLACES | ANYWHERE, PLACES | ANYWHERE)
    def check(a, b):
        there, here = np.asarray(OBSTACLES[name].distance(np.stack([a, b])))
        assert abs(there - here) <= np.linalg.norm(a - b) + 1e-14

    check()


def test_points_of_any_shape_have_distances(compiled_at_once):
    box = OBSTACLES["box"]
    several = POINTS[:24].reshape(2, 3, 4, 3)
    np.testing.assert_array_equal(box.distance(several).reshape(-1), box.distance(POINTS[:24]))
    assert box.distance(np.zeros((0, 3))).shape == (0,)
    np.testing.assert_array_equal(jax.vmap(box.distance)(several), box.distance(several))


def test_an_obstacle_of_ones_own():
    assert float(Torus(3, 1.0).distance((0, 5, 0))) == pytest.approx(1, abs=1e-15)
    assert float(rj.Union(Torus(3, 1.0), SPHERE).distance((0, 0, 4))) == pytest.approx(3, abs=1e-15)
    ring = rj.clearance(solved(), [Torus(3.0, 1.0), Torus(2, 0.5)])
    np.testing.assert_allclose(ring.distance, [0.995, 0.495], rtol=0, atol=1e-12)


def test_distances_have_derivatives_by_the_obstacle():
    """A point on the long side of a box is nearer by half of what the box is wider."""
    size = jax.grad(lambda size: rj.Box((0, 0, 0), size).distance((0.1, 0.2, 3)))(jnp.ones(3))
    np.testing.assert_allclose(size, [0, 0, -0.5], rtol=0, atol=1e-15)
    lifted = jax.grad(lambda lift: rj.Mesh(CORNERS + lift, TRIANGLES).distance((0.4, 0.3, 3)))(0.0)
    assert float(lifted) == pytest.approx(-1, abs=1e-14)


def test_bodies_of_a_mesh_may_overlap_or_be_hollow():
    other = np.array(TRIANGLES) + 8
    overlapping = rj.Mesh(np.concatenate([CORNERS, CORNERS + 0.5]), np.concatenate([TRIANGLES, other]))
    assert float(overlapping.distance((0.75, 0.7, 0.75))) == pytest.approx(-0.2)
    hollow = rj.Mesh(np.concatenate([4 * CORNERS, CORNERS + 1]), np.concatenate([TRIANGLES, other[:, ::-1]]))
    np.testing.assert_allclose(hollow.distance([(1.5, 1.5, 1.6), (0.5, 2, 2)]), [0.4, -0.5], rtol=1e-14)


def test_triangles_without_area_change_nothing():
    mesh = rj.Mesh(CORNERS, [*TRIANGLES, (0, 0, 7), (3, 3, 3)])
    expected = rj.Mesh(CORNERS, TRIANGLES).distance(POINTS)
    np.testing.assert_allclose(mesh.distance(POINTS), expected, rtol=0, atol=1e-14)


def stl(vertices: np.ndarray, faces: list) -> str:
    """An STL as text, from the definition of the format."""
    lines = ["solid body"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex {:.9e} {:.9e} {:.9e}".format(*vertices[vertex]) for vertex in face]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid body", ""])


def test_an_stl_is_read(tmp_path):
    """As text and binary; in mm, of numbers that single precision holds."""
    path, binary = tmp_path / "text.stl", tmp_path / "binary.stl"
    path.write_text(stl(250 * CORNERS, TRIANGLES))
    binary.write_bytes(trimesh.Trimesh(250 * CORNERS, TRIANGLES).export(file_type="stl"))
    expected = rj.Box((0.125, 0.125, 0.125), (0.25, 0.25, 0.25)).distance(POINTS)
    for name in (path, str(binary)):
        mesh = rj.Mesh.from_stl(name, scale=1e-3)
        np.testing.assert_allclose(mesh.distance(POINTS), expected, rtol=0, atol=1e-14)


def test_what_is_no_stl_of_a_body_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "body.stl"
    for text, message in (
        (stl(CORNERS, TRIANGLES[1:]), "an STL file of a closed surface, got .*body.stl': faces must close"),
        ("[rod]\nlength = 1\n", "path must name an STL file"),
        ("solid a\nfacet\nvertex 1 2\nendsolid a\n", "path must name an STL file"),
        ("", "path must name an STL file"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            rj.Mesh.from_stl(path)
    path.write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match="path must name an STL file"):
        rj.Mesh.from_stl(path)
    with pytest.raises(FileNotFoundError):
        rj.Mesh.from_stl(tmp_path / "missing.stl")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"pip install 'rodjax\[meshes\]'"):
        rj.Mesh.from_stl(path)


ROD = rj.problems.cable()
STRAIGHT = rj.Scene(ROD, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Free(), gravity=(0, 0, 0))


@functools.cache
def solved(weight: float = 0.0, EI: float | None = None) -> rj.Equilibrium:
    """A clamped cable, straight without weight: scenes of one program."""
    rod = rj.Rod(1.0, ROD.EI if EI is None else EI, ROD.GJ, ROD.EA, ROD.mass_per_length, ROD.radius)
    return rj.solve(rj.Scene(rod, STRAIGHT.start, STRAIGHT.end, (0, 0, -weight)), segments=4)


def test_clearance_of_a_straight_rod_in_closed_form():
    sphere, floor = rj.Sphere((0.55, 0.3, 0.4), 0.1), rj.Plane((0, 0, -0.2), (0, 0, 1))
    found = rj.clearance(solved(), [sphere, floor])
    np.testing.assert_allclose(found.distance, [0.5 - 0.1 - 0.005, 0.2 - 0.005], rtol=0, atol=1e-12)
    assert float(found.s[0]) == pytest.approx(0.55)
    np.testing.assert_allclose(found.point[0], [0.55, 0, 0], rtol=0, atol=1e-12)
    # Among the nodes alone the nearest is 0.05 m off.
    nodes = rj.clearance(solved(), [sphere], points=0)
    assert float(nodes.distance[0]) == pytest.approx(np.hypot(0.5, 0.05) - 0.105, abs=1e-12)


def test_clearance_has_derivatives_by_the_obstacle():
    def distance(radius, center):
        return rj.clearance(solved(), [rj.Sphere(center, radius)]).distance[0]

    by_radius, by_center = jax.grad(distance, argnums=(0, 1))(0.1, jnp.array([0.55, 0.3, 0.4]))
    assert float(by_radius) == pytest.approx(-1, abs=1e-14)
    np.testing.assert_allclose(by_center, [0, 0.6, 0.8], rtol=0, atol=1e-12)


def test_clearance_has_derivatives_by_the_scene():
    """By the bending stiffness of a cable that hangs beside a box, against central differences."""
    box = rj.Box((0.6, 0, -1), (0.4, 0.4, 0.4))

    def distance(EI, weight):
        scene = rj.Scene(
            rj.Rod(1.0, EI, ROD.GJ, ROD.EA, ROD.mass_per_length, ROD.radius),
            STRAIGHT.start,
            STRAIGHT.end,
            jnp.array([0.0, 0.0, -1.0]) * weight,
        )
        return rj.clearance(rj.solve(scene, segments=4), [box]).distance[0]

    EI, h = float(ROD.EI), 1e-4
    found = jax.grad(distance)(EI, 0.4)
    above, below = (rj.clearance(solved(0.4, EI * (1 + step)), [box]).distance[0] for step in (h, -h))
    assert float(found) == pytest.approx(float((above - below) / (2 * h * EI)), rel=1e-6)


def test_clearances_of_stacks():
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), solved(), solved(0.4))
    obstacles = [rj.Sphere((0.55, 0.3, 0.4), 0.1), OBSTACLES["mesh"], OBSTACLES["union"]]
    found = rj.clearance(stack, obstacles)
    assert found.distance.shape == found.s.shape == (2, 3)
    assert found.point.shape == (2, 3, 3)
    mapped = jax.jit(jax.vmap(lambda equilibrium: rj.clearance(equilibrium, obstacles)))(stack)
    each = [rj.clearance(equilibrium, obstacles) for equilibrium in (solved(), solved(0.4))]
    for k in range(2):
        for one in (jax.tree.map(lambda leaf: leaf[k], found), jax.tree.map(lambda leaf: leaf[k], mapped)):  # noqa: B023
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-13), one, each[k])


def with_radius(radius: Any) -> rj.Equilibrium:
    """The straight rod, thinner or thicker, which changes nothing else."""
    rod = rj.Rod(1.0, ROD.EI, ROD.GJ, ROD.EA, radius=radius)
    return eqx.tree_at(lambda equilibrium: equilibrium.scene.rod.radius, solved(), rod.radius)


@pytest.mark.parametrize(
    ("radius", "thickest", "s"),
    [
        (rj.Steps([0.5], [0.01, 0.03]), 0.03, 0.5),
        (rj.Steps([0.25, 0.5], [0.01, 0.03, 0.02]), 0.03, 0.25),
        (rj.Smooth([0, 0.5, 1], [0.01, 0.02, 0.04]), 0.04, 1),
    ],
)
def test_clearance_of_a_rod_whose_radius_varies(radius, thickest, s):
    """Above a floor that falls a little along the rod it is least at the first thickest place; a jump is thick."""
    slope = 1e-3
    found = rj.clearance(with_radius(radius), [rj.Plane((0, 0, -0.2), (slope, 0, 1))])
    distance = (0.2 + slope * s) / np.hypot(1, slope) - thickest
    assert float(found.distance[0]) == pytest.approx(distance, abs=1e-12)
    assert float(found.s[0]) == pytest.approx(s)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rj.Plane((0, 0, 0), (0, 0, 0)), "normal must be a direction"),
        (lambda: rj.Sphere((0, 0), 1), r"center must be numbers of shape \(3,\)"),
        (lambda: rj.Sphere((0, 0, 0), 0), "radius must be positive, got 0"),
        (lambda: rj.Capsule((0, 1, 0), (0, 1, 0), 1), r"end must differ from start, got \[0.0, 1.0, 0.0\] for both"),
        (lambda: rj.Cylinder((0, 1, 0), (0, 1, 0), 1), "end must differ from start"),
        (lambda: rj.Box((0, 0, 0), (1, 0, 1)), r"size must be positive numbers, got \(1, 0, 1\)"),
        (lambda: rj.Box((0, 0, 0), (1, 1, 1), 2 * np.eye(3)), "frame must be a rotation"),
        (lambda: rj.Union(), "obstacles must hold at least one Obstacle, got none"),
        (lambda: rj.Union([SPHERE]), r"obstacles\[0\] must be an Obstacle, got \[Sphere"),
        (lambda: rj.Distance(1.0), r"function must be a function of a point \(3,\), got 1.0"),
        (lambda: rj.Distance(lambda point: point), r"function must give one number for a point \(3,\), got .*3"),
        (lambda: rj.Distance(lambda point: (point[0], 1)), r"function must give one number for a point"),
        (
            lambda: SPHERE.distance((0, 0)),
            r"points must be numbers of shape \(\.\.\., 3\), got an array of shape \(2,\)",
        ),
        (lambda: SPHERE.distance(1.0), r"points must be numbers of shape .* got an array of shape \(\)"),
        (lambda: SPHERE.distance([(0, 0, 0), (1, 2)]), "points must be numbers of shape"),
        (lambda: SPHERE.distance("here"), "points must be numbers of shape"),
        (lambda: SPHERE.distance((0, 0, np.nan)), "points must be finite"),
        (
            lambda: rj.Mesh(CORNERS[:3], TRIANGLES),
            r"vertices must be numbers of shape \(v, 3\), v >= 4, got .* \(3, 3\)",
        ),
        (lambda: rj.Mesh(CORNERS[None], TRIANGLES), r"vertices must be numbers of shape \(v, 3\), v >= 4"),
        (lambda: rj.Mesh(CORNERS, TRIANGLES[:3]), r"faces must be whole numbers of shape \(f, 3\), f >= 4, got"),
        (lambda: rj.Mesh(CORNERS, np.array(TRIANGLES) + 0.5), "faces must be whole numbers"),
        (lambda: rj.Mesh(CORNERS, np.array(TRIANGLES) + 1), "faces must be from 0 to 7, got 1 to 8"),
        (
            lambda: rj.Mesh(CORNERS, TRIANGLES[1:]),
            r"faces must close .* got 3 edges that are not, such as \[\[0, 1\], ",
        ),
        (lambda: rj.Mesh(CORNERS, [(0, 3, 1), *TRIANGLES[1:]]), "faces must close a surface"),
        (lambda: rj.Mesh.from_stl(5), "path must be the name of a file, got 5"),
        (lambda: rj.Mesh.from_stl("body.stl", scale=0), "scale must be positive"),
        (lambda: rj.clearance(STRAIGHT, [SPHERE]), "equilibrium must be an Equilibrium, got Scene"),
        (lambda: rj.clearance(solved(), SPHERE), "obstacles must be a list of Obstacle, got Sphere"),
        (lambda: rj.clearance(solved(), []), "obstacles must hold at least one Obstacle, got none"),
        (lambda: rj.clearance(solved(), [SPHERE, ROD]), r"obstacles\[1\] must be an Obstacle, got Rod"),
        (lambda: rj.clearance(solved(), [SPHERE], points=-1), "points must be a whole number from 0 to 10000, got -1"),
        (lambda: rj.clearance(with_radius(None), [SPHERE]), "equilibrium.scene.rod must have a radius, got None"),
    ],
)
def test_bad_obstacles_are_refused(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()


def test_a_stack_of_obstacles_is_told_from_one():
    """As users have JAX, which would broadcast it."""
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf, leaf]), SPHERE)
    with (
        jax.numpy_rank_promotion("allow"),
        pytest.raises(
            ValueError, match=r"obstacles\[0\] must give one number for a point, got numbers of shape \(3,\)"
        ),
    ):
        checked_obstacles([stack])
