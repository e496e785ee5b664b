"""Rods that touch obstacles, against closed forms, another solver, rods that touch nothing, and finite differences."""

import dataclasses
import functools
import math
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import Through, by_numpy
from scipy.integrate import solve_bvp

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, Rod, Scene, frame
from rodjax.discretization.inner_contacts import Elements, Places
from rodjax.discretization.nodal_point import NodalChange
from rodjax.discretization.node_contacts import contacts_at
from rodjax.geometry.interpolation import resampled
from rodjax.model.scene import nondimensional
from rodjax.model.supports import Support
from rodjax.solving import equilibrium, first_state, options
from rodjax.solving.options import checked_options
from rodjax.solving.result_form import form_and_point
from rodjax.solving.sliding import sliding_at

EI, GJ, RADIUS = 0.02, 0.015, 0.005
DENSITY, GRAVITY = 0.15, (0.0, 0.0, -10.0)
LEVEL = frame((1, 0, 0))
FLOOR = rj.Plane((0, 0, 0), (0, 0, 1))
# The deepest that a rod may be within an obstacle, in parts of its radius.
DEEPEST = 1e-4


def cable(length=1.0, EA=1e6, mass_per_length=DENSITY) -> Rod:
    return Rod(length, EI, GJ, EA, mass_per_length, radius=RADIUS)


def solved(scene: Scene, segments: int = 64, guess: rj.Guess | None = None) -> rj.Equilibrium:
    result = rj.solve(scene, segments=segments, guess=guess)
    assert result.converged
    assert result.stable
    clearances = rj.clearance(result, scene.obstacles, points=0).distance
    assert float(jnp.min(clearances)) > -DEEPEST * RADIUS
    return result


def lift_off(result: rj.Equilibrium, curvature: float) -> float:
    """Where the curvature begins to differ from that along the obstacle, from the nodes beyond the last contact."""
    touching = np.flatnonzero(np.linalg.norm(result.contact_forces, axis=1))
    last = touching[-1]
    beyond = slice(last + 1, last + 5)
    s = np.asarray(result.s)
    parabola = np.polyfit(s[beyond] - s[last], np.asarray(result.curvature)[beyond] - curvature, 2)
    roots = np.roots(parabola)
    return float(s[last] + roots[np.argmin(np.abs(roots))].real)


# --- a heavy cable on a floor ----------------------------------------------------------------------------------------


def lifted(force: float) -> Scene:
    """A cable that lies on the floor, its end lifted by a force."""
    return Scene(cable(), Clamp((0, 0, RADIUS), LEVEL), Free(force=(0, 0, force)), GRAVITY, obstacles=[FLOOR])


def heavy_elastica(force: float, moment: float = 0.0) -> tuple[float, np.ndarray]:
    """The lifted length and its end (angle, curvature, height, way): no slope, no curvature at the floor, and at the
    end that of a moment; the floor pushes where the cable leaves it with what is left of the lifted weight.
    """
    weight = DENSITY * 10.0

    def slopes(x, y, p):
        shear = weight * p[0] - force - weight * p[0] * x
        return p[0] * np.vstack([y[1], shear * np.cos(y[0]) / EI, np.sin(y[0]), np.cos(y[0])])

    def misses(first, last, p):
        return np.array([*first, last[1] - moment / EI])

    x, a = np.linspace(0, 1, 200), 2 * force / weight + math.sqrt(2 * moment / weight)
    pushed = weight * a - force
    angle = (pushed * (a * x) ** 2 / 2 - weight * (a * x) ** 3 / 6) / EI
    begin = np.vstack([angle, np.gradient(angle, a * x), 0 * x, a * x])
    found = solve_bvp(slopes, misses, x, begin, p=[a], tol=1e-10, max_nodes=100_000)
    assert found.success
    return float(found.p[0]), found.sol(1.0)


@pytest.fixture(scope="module")
def lying() -> rj.Equilibrium:
    return solved(lifted(0.3))


def test_a_lifted_cable_is_the_heavy_elastica(lying):
    """Contact length, lift-off and height within 1e-3, as a contact at a node may be half an element off its place."""
    length, end = heavy_elastica(0.3)
    assert 1.0 - lift_off(lying, 0.0) == pytest.approx(length, rel=1e-3)
    assert float(lying.nodes[-1, 2]) - RADIUS == pytest.approx(end[2], rel=1e-3)
    assert float(lying.nodes[-1, 0]) == pytest.approx(1.0 - length + end[3], abs=1e-4)


def test_a_lifted_cable_on_32_elements():
    """Contact length and height within 1e-4: 8.5e-5 of the length, 8.3e-5 L."""
    length, end = heavy_elastica(0.3)
    result = solved(lifted(0.3), segments=32)
    assert 1.0 - lift_off(result, 0.0) == pytest.approx(length, rel=1e-4)
    assert float(result.nodes[-1, 2]) - RADIUS == pytest.approx(end[2], abs=1e-4)


@pytest.mark.parametrize("follower", [False, True])
def test_a_cable_lifted_by_a_moment_is_the_heavy_elastica(follower):
    """A load without a potential beside an obstacle; a cold start, which is the cable that lies on the floor."""
    length, end = heavy_elastica(0.0, 0.03)
    free = Free(moment=(0, -0.03, 0), follower=follower)
    result = rj.solve(Scene(cable(), Clamp((0, 0, RADIUS), LEVEL), free, GRAVITY, obstacles=[FLOOR]), segments=64)
    assert result.converged
    # A contact at a node may be half an element off its place, 4 % of this length.
    assert 1.0 - lift_off(result, 0.0) == pytest.approx(length, rel=1e-3)
    assert float(result.nodes[-1, 2]) - RADIUS == pytest.approx(end[2], rel=0.01)
    np.testing.assert_allclose(jnp.sum(result.contact_forces, axis=0) - result.start_force, [0, 0, 1.5], atol=1e-9)


def test_couples_turn_a_cable_beside_walls_in_few_steps():
    """Steps by the square of what is out of balance alone were shortened to a thirtieth and took 27, 26 and 81. The
    same cable comes from a guess, its couple grown by quarters.
    """
    rng = np.random.default_rng(0)
    rod = Rod(1.0, 1.0, 0.7, 1e4, mass_per_length=0.3, radius=0.01)
    found = []
    for _ in range(10):
        couple = rng.normal(size=3)
        couple *= rng.uniform(0.5, 1.5) / np.linalg.norm(couple)
        start = Clamp((0, 0, 0), frame((1.0, *rng.normal(0, 0.5, 2))))
        places = (0, 0, -rng.uniform(0.05, 0.15)), (0, -rng.uniform(0.03, 0.1), 0)
        walls = [rj.Plane(place, normal) for place, normal in zip(places, ((0, 0, 1), (0, 1, 0)), strict=True)]
        load = rj.DistributedCouple(couple)
        scene = Scene(rod, start, Free(), GRAVITY, obstacles=walls, distributed=[load])
        found.append(rj.solve(scene, segments=16))
        assert found[-1].converged
        assert found[-1].iterations <= 15  # seen: 11

    def loaded(part: float, guess: rj.Equilibrium | None) -> rj.Equilibrium:
        load = rj.DistributedCouple(part * found[8].scene.distributed[0].couple)
        return rj.solve(dataclasses.replace(found[8].scene, distributed=[load]), segments=16, guess=guess)

    grown = functools.reduce(lambda before, part: loaded(part, before), (0.5, 0.75, 1.0), loaded(0.25, None))
    # The residual of 1e-8 EI/L^2, by the softest motion of a cantilever.
    np.testing.assert_allclose(found[8].nodes, grown.nodes, rtol=0, atol=1e-8)


def test_floor_and_supports_carry_the_weight(lying):
    floor = jnp.sum(lying.contact_forces, axis=0)
    carried = floor + lying.end_force - lying.start_force
    # Each to 64 roundings of a contact as stiff as 1e9 EI/L^3.
    np.testing.assert_allclose(carried, [0, 0, DENSITY * 10.0], rtol=0, atol=1e-9)
    assert np.all(np.asarray(lying.contact_forces)[:, 2] >= 0)
    # The floor pushes on what lies as that weighs: 0.1 m in the middle of it, to the ripple of nodes beside the ends.
    middle = slice(13, 26)
    weight = DENSITY * 10.0 * 13 / 64
    assert float(jnp.sum(lying.contact_forces[middle, 2])) == pytest.approx(weight, rel=1e-3)


def test_the_estimate_knows_how_coarse_contacts_are(lying):
    """Lift-offs at several places between two contact points: at one of them the error all but vanishes."""
    errors, estimates = [], []
    for force in (0.3, 0.28, 0.26):
        result = rj.solve(lifted(force), segments=64, guess=lying)
        _, end = heavy_elastica(force)
        errors.append(abs(float(result.nodes[-1, 2]) - RADIUS - end[2]))
        estimates.append(float(result.error_estimate))
    np.testing.assert_array_less(errors, estimates)
    assert max(estimates) < 10 * max(errors)


def test_meshes_are_chosen_with_contacts():
    result = rj.solve(lifted(0.3), rtol=1e-4)
    _, end = heavy_elastica(0.3)
    assert float(result.error_estimate) < 1e-4
    assert float(result.nodes[-1, 2]) - RADIUS == pytest.approx(end[2], abs=1e-4)
    assert deepest(result) < DEEPEST


@pytest.mark.slow
def test_meshes_are_chosen_over_a_pipe():
    """A heavy cable over a pipe, started above it: where it touches elements are short, but none so short that contacts
    on both sides of it, which press on each other by its stiffness, cost all digits. The error of the shape is 1.4e-4
    beside 384 elements, and estimated as 1.7e-4, so that no more are needed.
    """
    s = np.linspace(0, 1, 65)
    above = np.stack([0.7 * s, 0.02 * np.sin(np.pi * s), 1.6 * s * (1 - s)], axis=1)
    ends = rj.Swivel((0, 0, 0), (0.9, 0, 0.4)), rj.Swivel((0.7, 0, 0), (1, 0, 0))
    pipe = rj.Capsule((0.3, -1, -0.1), (0.4, 1, -0.1), 0.03)
    scene = Scene(Rod(1.0, 1.0, 0.8, 1e6, 300.0, radius=RADIUS), *ends, (0, 0, -1.0), obstacles=[pipe])
    result = rj.solve(scene, guess=rj.Guess(above))
    assert result.converged
    assert deepest(result) < DEEPEST
    assert len(result.s) - 1 <= 64
    assert float(result.contact_forces[:, 2].sum()) > 100.0


def deepest(result: rj.Equilibrium) -> float:
    """Of all places, at nodes and between them, by the radius."""
    return -float(jnp.min(rj.clearance(result, result.scene.obstacles, points=9).distance)) / RADIUS


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(
            Scene(cable(1.2), Clamp((0, 0, 0.2), LEVEL), Clamp((0.8, 0, 0.2), LEVEL), GRAVITY, obstacles=[FLOOR]),
            marks=pytest.mark.exhaustive,
        ),
        Scene(
            cable(mass_per_length=0.0),
            Clamp((0, 0, 0.1), LEVEL),
            Free(force=(0, 0, -4.0)),
            obstacles=[rj.Cylinder((0, -1, 0), (0, 1, 0), 0.1 - RADIUS)],
        ),
    ],
    ids=["sagging to a floor", "over a cylinder"],
)
def test_meshes_are_as_fine_as_contacts_between_nodes_need(scene):
    result = rj.solve(scene)
    assert deepest(result) < DEEPEST
    assert "pressed into" not in rj.describe(result)


def test_the_first_mesh_beside_obstacles_is_finer():
    scene = lifted(0.3)
    assert checked_options(scene)[0].segments == 32
    assert checked_options(dataclasses.replace(scene, obstacles=()))[0].segments == 8


def across_a_box(**more) -> Scene:
    """The library's first shape of so much slack crosses the box, and its distance pushes it out on both sides."""
    box, ends = rj.Box((0.4, 0, -0.25), (0.1, 1, 0.6)), (Clamp((x, 0, 0.1), LEVEL) for x in (0.0, 0.8))
    return Scene(cable(1.2), *ends, GRAVITY, obstacles=[box], **more)


@pytest.mark.slow
def test_a_rod_that_begins_across_a_box_and_stays_there_is_told(monkeypatch):
    """Where it is not led out, as beside a `Mesh`, and a search ends so, it is not converged, and not sought up to the
    finest mesh. No other test has a rod in a clip across a box: its first shape is part of what is traced once.
    """
    monkeypatch.setattr(first_state, "beside_obstacles", lambda scene, points, segments: resampled(points, segments))
    monkeypatch.setattr(options, "CONTACT_SEGMENTS", 8)
    monkeypatch.setattr(options, "SPAN_SEGMENTS", 4)
    monkeypatch.setattr(equilibrium, "MOST_FAILURES", 2)
    with pytest.warns(rj.NotConvergedWarning, match=r"within obstacles\[0\] \(Box\) at s = "):
        result = rj.solve(across_a_box(clips=[rj.Clip(1.15, (0.76, 0, 0.095))]))
    assert not result.converged
    assert len(result.s) - 1 < 512


def test_a_rod_that_begins_across_a_box_is_led_over_it():
    result = rj.solve(across_a_box(), segments=48)
    assert result.converged
    x, _, z = np.asarray(result.position_at(np.linspace(0, 1.2, 400))).T
    # The centerline lies above the top of the box.
    assert np.min(z[(x > 0.35) & (x < 0.45)]) > 0.05


@pytest.mark.slow
def test_a_thin_pipe_between_nodes_carries_a_heavy_cable():
    """Of 2 mm, below nodes 31 mm apart at first, by a mesh that the contact does not make finer."""
    s = np.linspace(0, 1, 65)
    above = np.stack([0.9 * s, 0 * s, 0.2 * s * (1 - s)], axis=1)
    pipe = rj.Capsule((0.45625, -1, -0.05), (0.45625, 1, -0.05), 0.001)
    ends = rj.Swivel((0, 0, 0), (0.9, 0, 0.2)), rj.Swivel((0.9, 0, 0), (0.9, 0, -0.2))
    scene = Scene(Rod(1.0, 1.0, 0.8, 1e6, 300.0, radius=RADIUS), *ends, (0, 0, -1.0), obstacles=[pipe])
    result = rj.solve(scene, guess=rj.Guess(above))
    assert result.converged
    pushed = result.obstacle_forces[0].sum(0)
    assert float(pushed[2]) > 100.0
    carried = pushed + result.end_force - result.start_force
    np.testing.assert_allclose(carried, [0, 0, 300.0], rtol=0, atol=1e-9 * 300.0)
    assert deepest(result) < DEEPEST
    assert len(result.s) - 1 <= 64


def test_an_edge_beside_a_node_does_not_press_the_rod_in():
    """A cable that hangs over the edge of a table, 16 elements of 0.0625: along an obstacle the rod counts as thinner
    near nodes by up to 1e-2 of its radius, and where one crosses it by 9e-5.
    """
    for edge in (0.309, 0.315, 0.36):
        table = rj.Box((edge - 0.3, 0, -0.3), (0.6, 1, 0.6))
        scene = Scene(cable(), Clamp((0, 0, RADIUS), LEVEL), Free(), GRAVITY, obstacles=[table])
        result = rj.solve(scene, segments=16)
        assert result.converged
        # Contacts are within elements, 0.04 to 0.14 of them beside a node.
        beyond = result.position_at(np.linspace(0.2, 0.5, 3001))
        assert -float(jnp.min(table.distance(beyond) - RADIUS)) < DEEPEST * RADIUS


def test_the_estimate_knows_the_kink_of_moments_between_nodes():
    """A pipe that lifts a clamped beam between two nodes: what its moment there has beyond that at both nodes."""
    pipe = rj.Capsule((0.5, -1, -0.022), (0.5, 1, -0.022), 0.02)  # lifts by 0.003
    ends = (Clamp((x, 0, 0), LEVEL) for x in (0.0, 1.0))
    above = rj.Guess([(0, 0, 0), (0.5, 0, 0.01), (1, 0, 0)])
    rod = Rod(1.0, 1.0, 0.8, 1e4, 0.0, radius=RADIUS)
    result = rj.solve(Scene(rod, *ends, obstacles=[pipe]), segments=33, guess=above)
    assert result.converged
    # 192 EI w/L^3, but for the tension of so small a deflection.
    assert float(jnp.sum(result.obstacle_forces, axis=(0, 1))[2]) == pytest.approx(192 * 0.003, rel=0.01)
    curvature = np.asarray(result.curvature)
    # In a straight line from both nodes before the pipe; in units of the least moment that counts, 0.1 EI/L. To 2 %, by
    # which tension bends that line.
    kink = (curvature[16] - curvature[15]) / 2
    assert float(result.moment_error) == pytest.approx(kink / 0.1, rel=0.02)


def test_contact_points_within_elements_have_exact_derivatives():
    """Second ones too, beside those that JAX finds of the same gaps as their places move. Of two elements the first
    touches a capsule within, the second is nearest to it at their common node.
    """
    rng = np.random.default_rng(0)
    angles, s, axes_of_nodes = np.array([0.0, 0.5, 1.1]), np.array([0.0, 0.06, 0.16]), rng.normal(size=(3, 2, 3))
    positions = 0.6 * np.stack([np.sin(angles), 0 * angles, 1 - np.cos(angles)], axis=1)
    positions += 0.01 * rng.normal(size=(3, 3))
    tangents = np.stack([np.cos(angles), 0 * angles, np.sin(angles)]) + 0.02 * rng.normal(size=(3, 3))
    tangents /= np.linalg.norm(tangents, axis=0)
    capsule, pressures = rj.Capsule((0.2, -1, -0.05), (0.25, 1, -0.12), 0.08), np.array([3.0, 2.0])

    def found(change: jax.Array) -> tuple[Elements, Places]:
        """By rotation and place of each node."""
        turn = jnp.einsum("cbn,nb->cn", axes_of_nodes, change[:, :2])
        across = jnp.cross(turn, tangents, axis=0)
        turned = tangents + across + jnp.cross(turn, across, axis=0) / 2
        axes, arclengths = jnp.asarray(axes_of_nodes), jnp.asarray(s)
        elements = Elements.of(positions + change[:, 2:], turned, axes, jnp.ones(3), arclengths)
        return elements, Places.of(elements, (capsule,), jnp.asarray(0.05), jnp.zeros((1, 3), bool))

    def pushed(change: jax.Array) -> jax.Array:
        return -jnp.sum(found(change)[1].gaps[0] * pressures)

    everywhere = np.linspace(0, 1, 2001)

    def derivatives(change: jax.Array) -> tuple[jax.Array, jax.Array, Places, jax.Array]:
        elements, place = found(change)
        second = place.second(elements, (capsule,), jnp.asarray(pressures)[None])
        points = jax.vmap(lambda t: elements.at(jnp.full(2, t)))(jnp.asarray(everywhere))
        thinner = 1e-5 + 8e-5 * (2 * everywhere[:, None] - 1) ** 2
        return place.rates(elements)[0], second, place, capsule.distance(jnp.moveaxis(points, 1, -1)) + 0.05 * thinner

    nothing = np.zeros((3, 5))
    rates, blocks, place, distances = (jax.tree.map(np.asarray, part) for part in by_numpy(derivatives)(nothing))
    assert 0.5 < place.t[0, 0] < 0.75
    assert place.t[0, 1] == 0
    first, second = np.zeros((3, 5)), np.zeros((3, 5, 3, 5))
    for k in range(2):
        first[k : k + 2] -= pressures[k] * rates[..., k]
        second[k : k + 2, :, k : k + 2, :] += blocks[..., k]
    np.testing.assert_allclose(first, by_numpy(jax.grad(pushed))(nothing), rtol=0, atol=1e-14)
    expected = by_numpy(jax.hessian(pushed))(nothing)
    np.testing.assert_allclose(second, expected, rtol=0, atol=1e-14 * np.max(np.abs(expected)))
    # No place of 2001 is nearer; the second derivative of the gap by the place is 23 radii an element's length.
    np.testing.assert_allclose(place.gaps[0], np.min(distances - 0.05, axis=0), rtol=0, atol=0.9 * 2.5e-4**2)
    # On a circle of an element's length/8 points are where the circle is, to the sixth order.
    angle, turn = np.array([0.0, 0.125]), np.zeros((3, 2, 2))
    circle = np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1)
    along = np.stack([np.cos(angle), 0 * angle, np.sin(angle)])
    of_circle = circle, along, turn, np.ones(2), angle
    point_at = by_numpy(lambda part, *nodes: Elements.of(*nodes).at(part[None])[:, 0])
    for part in (0.25, 0.5):
        point = np.asarray(point_at(np.float64(part), *of_circle))
        assert abs(np.hypot(point[0], 1 - point[2]) - 1) < 0.125**6
    np.testing.assert_allclose(point, [np.sin(0.0625), 0, 1 - np.cos(0.0625)], rtol=0, atol=0.125**6)


@pytest.mark.slow
def test_without_gravity_there_are_derivatives_by_it():
    """Its size, of which places within elements know, has none at zero."""
    floor = rj.Plane((0, 0, -0.05), (0, 0, 1))

    def height(gravity: float | jax.Array) -> jax.Array:
        rod, end = Rod(1.0, 1.0, 0.8, 1e4, 0.5, radius=0.01), Free(force=(0, 0, -3.0))
        down = jnp.array([0.0, 0.0, -1.0]) * gravity
        scene = Scene(rod, Clamp((0, 0, 0.05), LEVEL), end, down, obstacles=[floor])
        return rj.solve(scene, segments=32, solver=rj.Newton(tolerance=1e-11)).nodes[16, 2]

    step = 1e-4
    difference = (float(height(step)) - float(height(-step))) / (2 * step)
    assert abs(difference) > 1e-4
    assert float(jax.grad(height)(0.0)) == pytest.approx(difference, rel=1e-5)


def test_a_rod_too_short_for_its_side_is_told_by_how_much():
    """A cable of 0.5 m between pins 0.5 m apart, below a cylinder between them: two tangents and an arc. Chords of 1/32
    of the string ask for up to 4e-4 too little.
    """
    around = 0.1 + RADIUS
    angle = np.arccos(around / 0.25)
    needed = 2 * np.sqrt(0.25**2 - around**2) + around * (np.pi - 2 * angle)
    cylinder = rj.Cylinder((0.25, -1, 0), (0.25, 1, 0), 0.1)
    s = np.linspace(0, 1, 65)
    below = rj.Guess(np.stack([0.5 * s, 0 * s, -1.2 * s * (1 - s)], axis=1))
    scene = Scene(cable(0.5), Pin((0, 0, 0)), Pin((0.5, 0, 0)), GRAVITY, obstacles=[cylinder])
    lacking = f"{needed - 0.5:.2g}"
    message = rf"at least {lacking} m too short to pass obstacles\[0\] \(Cylinder\) on the side where it was"
    with pytest.warns((rj.NotConvergedWarning, rj.OverstretchedWarning), match=message):
        rj.solve(scene, segments=32, guess=below, solver=rj.Newton(max_iterations=20))


# --- over a cylinder -------------------------------------------------------------------------------------------------


def test_a_cable_is_bent_round_a_cylinder():
    """Half of a cable that hangs over a cylinder, without weight, pulled down at its end by F.

    On the way down EI kappa^2/2 + F sin(slope) stays the same, from kappa = 1/R where the slope is that of the
    lift-off to none where the cable hangs straight (to exp(-L sqrt(F/EI)) = 1e-6). Along the cylinder the tension is
    that at its end, and pushes with tension/R.
    """
    around, force = 0.1, 4.0
    cylinder = rj.Cylinder((0, -1, 0), (0, 1, 0), around - RADIUS)
    rod = cable(mass_per_length=0.0)
    result = solved(
        Scene(rod, Clamp((0, 0, around), LEVEL), Free(force=(0, 0, -force)), obstacles=[cylinder]), segments=128
    )
    slope = np.arcsin(1 - EI / (2 * force * around**2))
    assert lift_off(result, 1 / around) == pytest.approx(around * slope, rel=2e-3)
    np.testing.assert_allclose(result.curvature[:8], 1 / around, rtol=1e-3)
    assert float(jnp.max(result.curvature)) == pytest.approx(1 / around, rel=1e-2)  # between the last two contacts
    tension = force * np.sin(slope)
    pressures = np.linalg.norm(result.contact_forces, axis=1)[2:6] * 128
    np.testing.assert_allclose(pressures, tension / around, rtol=5e-3)  # ripple of nodes beside the lift-off


# --- other obstacles, other supports ---------------------------------------------------------------------------------


def among_obstacles(p: jax.Array) -> Scene:
    """A cable through a clip, which touches a slanting cylinder and the floor, and stays clear of a box."""
    rod = Rod(1.0 + p[0], EI * (1 + p[1]), GJ, 1e5, DENSITY * (1 + p[2]), radius=RADIUS * (1 + p[3]))
    obstacles = [
        rj.Cylinder(jnp.stack([0.25 + 0 * p[4], -0.3 + 0 * p[4], 0.1 + p[4]]), (0.3, 0.3, 0.1), 0.07),
        rj.Plane((0, 0, 0.02), (0, 0.1, 1)),
        rj.Box((0.2, 0.1, 0.4), (0.1, 0.1, 0.2)),
    ]
    end = Clamp(jnp.stack([0.8 + 0 * p[5], p[5] + 0.03, 0.1 + 0 * p[5]]), LEVEL)
    clips = [Clip(0.85, (0.68, 0.02, 0.09))]
    return Scene(rod, Clamp((0, 0, 0.2), LEVEL), end, GRAVITY, clips=clips, obstacles=obstacles)


NOMINAL = jnp.zeros(6)
SEGMENTS = 24


@pytest.fixture(scope="module")
def touching() -> rj.Equilibrium:
    over = np.stack(
        [np.linspace(0, 0.8, 9), np.linspace(0, 0.03, 9), [0.2, 0.21, 0.22, 0.22, 0.2, 0.15, 0.1, 0.05, 0.1]]
    )
    return solved(among_obstacles(NOMINAL), segments=SEGMENTS, guess=rj.Guess(over.T))


def test_clips_and_obstacles_share_the_weight(touching):
    forces = np.asarray(touching.contact_forces)
    touched = np.any(np.asarray(touching.obstacle_forces) != 0, axis=(1, 2))
    np.testing.assert_array_equal(touched, [True, True, False])
    carried = forces.sum(0) + np.asarray(touching.end_force - touching.start_force + touching.clip_forces[0])
    np.testing.assert_allclose(carried, [0, 0, DENSITY * 10.0], rtol=0, atol=1e-9)
    clip = touching.position_at([0.85])[0]
    np.testing.assert_allclose(clip, [0.68, 0.02, 0.09], rtol=0, atol=1e-14)


def test_no_step_along_a_cylinder_is_shortened(touching):
    """Before, with contacts as stiff in the merit as in the model, this one did not converge in 100 iterations."""
    there = rj.solve(among_obstacles(NOMINAL.at[5].set(-0.02)), segments=SEGMENTS, guess=touching)
    assert there.converged
    assert int(there.evaluations) == int(there.iterations) + 1
    assert int(there.iterations) <= 6  # 5 seen


def pressed_aside() -> Iterator[Scene]:
    """Cables through a clip that slides and holds the tangent, beside the end of a cylinder."""
    # EI, mass, tangent at the start; x and tangent of the end.
    ends = [
        (1.1, 0.8, (0.92, -0.33, 0.22), 0.86, (0.98, 0.18, 0.05)),
        (1.5, 1.5, (0.96, 0.09, 0.26), 0.83, (0.92, 0.13, 0.37)),
        (1.0, 0.5, (0.98, -0.1, -0.14), 0.86, (0.87, -0.21, 0.44)),
    ]
    clips = [
        Clip(0.56, (0.48, -0.09, 0.12), tangent=(0.88, -0.21, 0.42), sliding=True),
        Clip(0.46, (0.39, 0.14, -0.11), tangent=(0.97, -0.25, -0.04), sliding=True),
        Clip(0.6, (0.5, -0.04, 0.0), tangent=(0.99, 0.09, 0.08), sliding=True),
    ]
    cylinders = [
        rj.Cylinder((0.696, -0.114, 0.164), (0.0, -1.0, 0.1), 0.064),
        rj.Cylinder((0.329, 0.209, -0.071), (0.0, -0.5, 0.87), 0.076),
        rj.Cylinder((0.642, -0.039, 0.01), (0.0, -0.72, -0.7), 0.071),
    ]
    for (EI, mass, first, x, last), clip, cylinder in zip(ends, clips, cylinders, strict=True):
        bent = Rod(1.0, EI, 0.7 * EI, 1e4, mass_per_length=mass, radius=0.01)
        start, end = Clamp((0, 0, 0), frame(first)), Clamp((x, 0, 0), frame(last))
        yield Scene(bent, start, end, (0, 0, -9.81), clips=[clip], obstacles=[cylinder])


def test_clips_that_hold_tangents_slide_beside_cylinders():
    """Which contacts are closed is sought together with the arclengths of clips. From contacts sought at given ones
    these searches took steps of a thousandth, up to the limit of 100.
    """
    for scene in pressed_aside():
        result = rj.solve(scene, segments=16)
        assert result.converged
        assert result.stable
        assert float(jnp.sum(result.contact_forces**2)) > 1.0
        # Seen: 7, 14, 13.
        assert int(result.iterations) <= 20
        # No contact lies in an element beside the clip of the first and the last one.
        EI, (clip,), (force,) = float(scene.rod.EI), scene.clips, result.clip_forces
        if EI < 1.5:
            assert clip.tangent is not None
            along = force @ clip.tangent
            # The tolerance, in units of EI/L^2, and as much again to spare.
            assert abs(float(along)) < 2e-8 * EI


def test_a_step_is_the_minimum_of_its_model_with_the_arclengths_of_clips():
    """Forces and moments in balance, no contact that is closed opens, and no other closes, to first order."""
    scene = next(pressed_aside())
    result = rj.solve(scene, segments=16)
    pressed = eqx.tree_at(lambda scene: scene.gravity, scene, -20 * scene.gravity)

    def step_from(result):
        slid = dataclasses.replace(pressed, clips=result.scene.clips)
        form, point = sliding_at(nondimensional(slid)[0], result.state.shape, form_and_point(result)[1])
        here = form.linearized(point)
        system = form.regular(here.system)
        is_minimum, rotation, multipliers = form.sought(here, point, system, jnp.zeros_like(here.gradient))
        change = form.layout.forces(form.force_components(multipliers))
        others = form.others(multipliers)

        def at(part):
            parts = jax.tree.map(lambda change: part * change, others)
            there = form.retract(point, here.bases, part * rotation, part * change, parts)
            return form.residual_vectors(there), form.at(there.arclengths).gaps(there.inner)

        before, rates = jax.jvp(at, (jnp.array(0.0),), (jnp.array(1.0),))
        (_, rows), gaps = jax.tree.map(jnp.add, before, rates)
        pressures = point.inner.nodal.pressures + others.others.pressures
        # Bases at another point are others: moments are those of the system, with all contacts that push or did.
        pushing = (pressures > 0) | (point.inner.nodal.pressures > 0)
        system = dataclasses.replace(here.system, inner=here.system.inner.closed_where(pushing))
        moments = here.gradient + system.times(rotation, multipliers)[0]
        return is_minimum, here.gradient, moments, rows, gaps, pressures, others.arclengths

    is_minimum, before, moments, rows, gaps, pressures, slide = by_numpy(step_from)(result)
    size = np.max(np.abs(before))
    assert is_minimum
    # Of twenty times the weight, upwards.
    assert abs(float(slide[0])) > 1e-3
    # First the axial force, then what contacts lack, which is below.
    others = np.concatenate([rows[:1], rows[1 + pressures.size :]])
    # Neutral motions are made regular by 1e-6 of what they are.
    np.testing.assert_allclose(others, 0.0, atol=1e-6 * size)
    np.testing.assert_allclose(moments, 0.0, atol=1e-6 * size)
    closed = pressures > 0
    assert np.any(closed)
    # The compliance of contacts in the model times forces of some 100 EI/L^2.
    np.testing.assert_allclose(gaps[closed], 0.0, atol=1e-6)
    assert np.min(gaps) > -1e-6
    assert np.min(pressures) >= 0


def test_forces_and_gaps_of_each_obstacle_are_told(touching, lying):
    """A gap or a pressure is zero at each node that no support holds; the box is not touched. Of what pushes in the
    middle of an element both of its nodes have half.
    """
    of_each, gaps = np.asarray(touching.obstacle_forces), np.asarray(touching.gaps)
    # The residual of 1e-8 EI/L^2.
    np.testing.assert_allclose(of_each.sum(0), touching.contact_forces, rtol=0, atol=1e-9)
    pushes = np.linalg.norm(of_each, axis=-1) > 0
    np.testing.assert_array_equal(pushes.any(1), [True, True, False])
    pressures = np.asarray(touching.state.pressures)
    np.testing.assert_allclose(gaps[pressures[:3] > 0], 0.0, atol=1e-12)  # roundings
    within = np.pad(pressures[3:, :-1], ((0, 0), (1, 1)))
    shared = pressures[:3] + (within[:, :-1] + within[:, 1:]) / 2
    force = touching.state.units.force
    sums, alone = np.linalg.norm(of_each.sum(1), axis=-1), shared.sum(1) * force
    # Along each contact the normal turns by less than 0.1 rad, so that the forces add up to 0.1^2/8.
    np.testing.assert_allclose(sums, alone, rtol=1e-3)
    nearest = np.asarray(rj.clearance(touching, touching.scene.obstacles, points=0).distance)
    np.testing.assert_allclose(np.min(gaps, axis=1), nearest, rtol=0, atol=1e-12)
    sizes, s, told = np.linalg.norm(of_each.sum(1), axis=-1), np.asarray(touching.s), rj.describe(touching)
    for k, kind in enumerate(("Cylinder", "Plane")):
        first, *_, last = s[pushes[k]][[0, -1]]
        where = f"at s = {first:.4g} m" if first == last else f"between s = {first:.4g} and {last:.4g} m"
        assert f"obstacles[{k}] ({kind}) pushes with {sizes[k]:.4g} N {where}" in told
    assert "(Box)" not in told
    forces = np.linalg.norm(lying.contact_forces, axis=-1)
    first, *_, last = np.asarray(lying.s)[forces > 0]
    size = np.linalg.norm(np.sum(lying.contact_forces, axis=0))
    assert f"(Plane) pushes with {size:.4g} N between s = {first:.4g} and {last:.4g} m" in rj.describe(lying)


@pytest.mark.slow
def test_derivatives_are_those_of_differences(touching):
    def numbers(result):
        contacts = jnp.sum(result.contact_forces, axis=0)
        ends = result.start_force, result.end_moment
        return jnp.concatenate([*ends, result.nodes[8], contacts, result.clip_forces[0], result.energy[None]])

    def solve(scene, tolerance=1e-8):
        return rj.solve(scene, segments=SEGMENTS, guess=touching, solver=rj.Newton(tolerance=tolerance))

    seen = Through(among_obstacles, solve, numbers)
    tight = Through(among_obstacles, functools.partial(solve, tolerance=1e-11), numbers)
    nominal, step = np.zeros(6), 1e-6
    there, back = (np.stack([tight(nominal + change * one) for one in np.eye(6)], axis=1) for change in (step, -step))
    differences = (there - back) / (2 * step)
    # A row at a time, by the transpose; columns are those of `test_derivatives_of_a_curved_cable_in_a_clip_on_a_floor`.
    pulled = seen.pulled(nominal)
    backward = np.stack([pulled(one) for one in np.eye(len(differences))])
    # A difference loses 1e-11 EI/L^2 of residual over 1e-6; the largest derivatives are some 100.
    sizes = np.max(np.abs(differences), axis=1, keepdims=True)
    np.testing.assert_allclose(backward / sizes, differences / sizes, rtol=0, atol=1e-5)


def test_the_system_is_the_derivative_of_what_is_out_of_balance(touching):
    """With what the curvature of the cylinder changes as nodes slide on it."""
    generator = np.random.default_rng(0)

    def both_ways(result):
        form, point = form_and_point(result)
        # The equilibrium is touched within an element: at nodes, too.
        count = len(result.scene.obstacles)
        at_nodes = jnp.asarray(generator.uniform(1.0, 2.0, (count, point.nodal.pressures.shape[1])))
        nodal = dataclasses.replace(point.nodal, pressures=point.nodal.pressures.at[:count].set(at_nodes))
        point = dataclasses.replace(point, nodal=nodal)
        here = form.linearized(point)
        rotation = jnp.asarray(generator.normal(size=here.gradient.shape))
        change = jnp.asarray(generator.normal(size=point.end_force.shape))
        displacements = jnp.asarray(generator.normal(size=point.nodal.positions.shape))
        displacements = jnp.where(form.is_held[:, None], 0.0, displacements)
        # Pressures stay, as their contacts are soft in the system.
        step = NodalChange(displacements, jnp.zeros_like(point.nodal.pressures))

        def residual_at(part):
            others = jax.tree.map(lambda change: part * change, step)
            return form.residual_vectors(form.retract(point, here.bases, part * rotation, part * change, others))

        (_, rows), (_, expected) = jax.jvp(residual_at, (jnp.array(0.0),), (jnp.array(1.0),))
        before = len(rows) - form.layout.size - displacements.size - step.pressures.size
        multipliers = jnp.concatenate(
            [jnp.zeros(before), step.pressures.ravel(), displacements.ravel(), form.layout.components(change)]
        )
        _, found = here.system.times(rotation, multipliers)
        nodes = slice(-form.layout.size - displacements.size, -form.layout.size)
        curved = contacts_at(form, point).inner
        assert curved is not None
        return found[nodes], expected[nodes], curved

    found, expected, curved = map(np.asarray, by_numpy(both_ways)(touching))
    # Where a node is held the system holds its displacement, which is none.
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.max(np.abs(expected)))
    # The cylinder curves where it is touched.
    assert np.max(np.abs(curved)) > 1.0


def test_what_is_far_away_changes_nothing():
    ends = Clamp((0, 0, 0), LEVEL), Pin((0.7, 0.1, 0.05))
    far = rj.Sphere((0, 0, 5), 1.0)
    plain = rj.solve(Scene(cable(), *ends, GRAVITY), segments=32)
    beside = rj.solve(Scene(cable(), *ends, GRAVITY, obstacles=[far]), segments=32)
    np.testing.assert_array_equal(beside.contact_forces, 0.0)
    # Both to a residual of 1e-8 EI/L^2.
    np.testing.assert_allclose(beside.nodes, plain.nodes, rtol=0, atol=1e-9)
    for name in ("start_force", "end_force", "start_moment", "energy", "elastic_energy", "tension"):
        np.testing.assert_allclose(getattr(beside, name), getattr(plain, name), rtol=0, atol=1e-8, err_msg=name)
    assert int(beside.index) == 0
    assert not beside.critical
    assert float(rj.lowest_mode(beside).stiffness) == pytest.approx(float(rj.lowest_mode(plain).stiffness), rel=1e-6)


@pytest.mark.slow
def test_batches_and_paths_touch_too():
    scenes = [lifted(force) for force in (0.3, 0.34)]
    each = [rj.solve(scene, segments=32) for scene in scenes]
    batch, path = rj.solve_batch(scenes, segments=32), rj.solve_path(scenes, segments=32)
    for k, one in enumerate(each):
        for many in (batch, path):
            assert many.converged[k]
            np.testing.assert_allclose(many.nodes[k], one.nodes, rtol=0, atol=1e-8)
            np.testing.assert_allclose(many.contact_forces[k], one.contact_forces, rtol=0, atol=1e-6)
    # A mesh for all of them is as fine as the deepest one needs.
    clearances = rj.clearance(rj.solve_batch(scenes), [FLOOR], points=9)
    assert float(jnp.min(clearances.distance)) > -DEEPEST * RADIUS


def test_files_keep_obstacles(touching, tmp_path):
    path = tmp_path / "touching.vtkhdf"
    rj.save(touching, path)
    again = rj.load(path)
    assert jax.tree.structure(again) == jax.tree.structure(touching)
    jax.tree.map(np.testing.assert_array_equal, again, touching)
    np.testing.assert_array_equal(again.contact_forces, touching.contact_forces)


def test_files_keep_no_code(touching, tmp_path):
    distance = rj.Distance(lambda point: point[2])
    scene = Scene(cable(), Clamp((0, 0, 0), LEVEL), Free(), GRAVITY, obstacles=[rj.Union(distance)])
    with pytest.raises(ValueError, match=r"scene\.obstacles\[0\]\.obstacles\[0\] is a Distance: code of one's own"):
        rj.save(rj.solve(scene, segments=4), tmp_path / "x.vtkhdf")


# --- rods by frames --------------------------------------------------------------------------------------------------


def flat(stiffness: float | jax.Array, other: float | jax.Array, **more) -> Rod:
    """Stiffness in the plane in which gravity bends it, and out of it: LEVEL has d2 across that plane."""
    return Rod(1.0, (other, stiffness), GJ, 1e6, DENSITY, radius=RADIUS, **more)


def test_a_flat_cable_lies_as_a_plain_one(tmp_path):
    """It bends in one plane, where the stiffness is the same."""

    def scene(rod: Rod) -> Scene:
        return dataclasses.replace(lifted(0.3), rod=rod)

    plain = rj.solve(scene(cable()), segments=32)
    by_frames = solved(scene(flat(EI, 3 * EI)), segments=32)
    # Two discretizations of fourth order; a contact that is off by 1e-6 N bends the rod by 1e-6/(3 EI).
    np.testing.assert_allclose(by_frames.nodes, plain.nodes, rtol=0, atol=1e-6)
    np.testing.assert_allclose(by_frames.contact_forces, plain.contact_forces, rtol=0, atol=1e-4)
    assert by_frames.iterations <= plain.iterations + 1
    np.testing.assert_allclose(by_frames.error_estimate, plain.error_estimate, rtol=0, atol=1e-3)

    def solve(scene, tolerance=1e-8):
        return rj.solve(scene, segments=32, guess=by_frames, solver=rj.Newton(tolerance=tolerance))

    def made(stiffnesses):
        return scene(flat(*stiffnesses))

    def height(result):
        return result.nodes[-1, 2]

    at, seen = np.array([EI, 3 * EI]), Through(made, solve, height)
    in_plane, across = (seen.change(at, one) for one in np.eye(2))
    of_plain = Through(
        lambda stiffness: scene(Rod(1.0, stiffness, GJ, 1e6, DENSITY, radius=RADIUS)),
        functools.partial(rj.solve, segments=32),
        height,
    ).pulled(np.array(EI))(np.array(1.0))
    step, tight = 1e-5 * EI, Through(made, functools.partial(solve, tolerance=1e-11), height)
    there, back = (tight(at + change) for change in (np.array([step, 0.0]), np.array([-step, 0.0])))
    np.testing.assert_allclose(in_plane, (there - back) / (2 * step), rtol=1e-6)  # seen: 1e-9
    np.testing.assert_allclose(in_plane, of_plain, rtol=1e-5)
    assert abs(across) < 1e-5 * abs(of_plain)

    path = tmp_path / "flat.vtkhdf"
    rj.save(by_frames, path)
    again = rj.load(path)
    np.testing.assert_array_equal(again.contact_forces, by_frames.contact_forces)
    assert rj.solve(again.scene, segments=32, guess=again).iterations == 0


def test_derivatives_of_a_curved_cable_in_a_clip_on_a_floor():
    """A clip that holds the frame, a rod curved out of the plane of gravity: nothing is symmetric."""
    frame_of_clip = frame((1.0, 0.1, 0.0))

    def scene_of(p):
        rod = flat(EI, 2 * EI, rest_curvature=(0.8, 0.5 * p[0]))
        floor = rj.Plane((0, 0, -0.06 + 0.1 * p[1]), (0, 0.1, 1))
        ends = Clamp((0, 0, 0), LEVEL), Free(force=(0, 0.02, 0))
        clips = [Clip(0.3, (0.29, 0.0, 0.02 + 0.1 * p[2]), frame=frame_of_clip)]
        return Scene(rod, *ends, GRAVITY, clips=clips, obstacles=[floor])

    def numbers(result):
        contacts = jnp.sum(result.contact_forces, axis=0)
        return jnp.concatenate([contacts, result.clip_moments[0], result.nodes[-1], result.energy[None]])

    def solve(scene, tolerance=1e-8):
        return rj.solve(scene, segments=16, guess=guess, solver=rj.Newton(tolerance=tolerance))

    guess = None
    seen = Through(scene_of, solve, numbers)
    tight = Through(scene_of, functools.partial(solve, tolerance=1e-11), numbers)
    nominal, step = np.array([1.0, 0.0, 0.0]), 1e-5
    guess = solve(seen.made(nominal))
    assert guess.converged
    assert np.sum(guess.contact_forces, axis=0)[2] > 0.2  # N: it lies on the floor
    # A column at a time: of all at once a program of its own would be traced, batched.
    forward = np.stack([seen.change(nominal, one) for one in np.eye(3)], axis=1)
    there, back = (np.stack([tight(nominal + change * one) for one in np.eye(3)], axis=1) for change in (step, -step))
    differences = (there - back) / (2 * step)
    # Of the residual of 1e-11 EI/L^2 over 1e-5.
    np.testing.assert_allclose(forward, differences, rtol=0, atol=1e-6 * np.max(np.abs(differences)))


# --- bad input -------------------------------------------------------------------------------------------------------


def with_floor(rod: Rod | None = None, end: Support | None = None, **others) -> Scene:
    return Scene(rod or cable(), Clamp((0, 0, 1), LEVEL), end or Free(), GRAVITY, obstacles=[FLOOR], **others)


OWN = rj.Union(FLOOR, rj.Distance(lambda x: x[2]))


def single(parts):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), parts)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: with_floor(Rod(1.0, EI, GJ, 1e5, DENSITY)), "rod must have a radius where there are obstacles"),
        (
            lambda: Scene(cable(), Clamp((0, 0, 1), LEVEL), Free(), obstacles=FLOOR),
            "obstacles must be a list of Obstacle",
        ),
        (lambda: Scene(cable(), Clamp((0, 0, 1), LEVEL), Free(), obstacles=[1]), r"obstacles[0] must be an Obstacle"),
        (lambda: rj.solve(with_floor(), discretization="finite_difference"), "discretization must be 'hermite'"),
        (lambda: rj.solve(with_floor(), solver=rj.NonlinearCG()), "discretization must be 'hermite' for a scene"),
        (lambda: rj.solve_continuum(with_floor()), "obstacles must be () in the continuum"),
        (
            lambda: Scene(*single((cable(), Clamp((0, 0, 1), LEVEL), Free())), obstacles=single([FLOOR])),
            "obstacles must be () in single precision",
        ),
        (
            lambda: rj.write_scene(dataclasses.replace(with_floor(), obstacles=(OWN,)), "floor.toml"),
            "scene.obstacles[0].obstacles[1] must be of the kinds plane, sphere, capsule, pipe, cylinder, box or union",
        ),
    ],
)
def test_what_obstacles_do_not_go_with_is_said(make, message):
    with pytest.raises((ValueError, TypeError)) as caught:
        make()
    assert message in str(caught.value)
