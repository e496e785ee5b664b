"""Coulomb friction of obstacles, against closed forms and finite differences."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Free, Pin, Rod, Scene, Swivel, frame
from rodjax.discretization.nodal_point import NodalChange
from rodjax.discretization.node_contacts import exerted_by_obstacles
from rodjax.solving.result_form import form_and_point

EI, GJ, RADIUS = 0.01, 0.008, 0.005
WEIGHT, MU = 1.0, 0.3  # N/m; with the length of 1 m N
ELEMENTS, STEPS = 32, 9
H = 1 / ELEMENTS
LYING = rj.Guess([(0, 0, 0), (1, 0, 0)])
# Of forces: the residual of 1e-8 EI/L^2, summed over the nodes.
ROUGHLY = 1e-7


def cable(EA=100.0) -> Rod:
    return Rod(1.0, EI, GJ, EA, WEIGHT / 10, radius=RADIUS)


def on_floor(x=0.0, y=0.0, gravity=(0.0, 0.0, -10.0), EA=100.0, friction=MU) -> Scene:
    """A cable that lies on a floor, its end drawn."""
    floor = rj.Plane((0, 0, -RADIUS), (0, 0, 1), friction=friction)
    return Scene(cable(EA), Swivel((x, y, 0), (1, 0, 0)), Free(), gravity, obstacles=[floor])


def drawn(scenes: list[Scene]) -> rj.Equilibrium:
    """All of one length and mesh, so that there is one program."""
    assert len(scenes) == STEPS
    path = rj.solve_path(scenes, segments=ELEMENTS, guess=LYING)
    assert np.all(path.converged)
    check_cone(path)
    return path


def check_cone(result: rj.Equilibrium, friction: float = MU) -> None:
    """No force beyond the cone, on it where a node slips, and the forces of all obstacles as the balance has them."""
    drags, forces = np.asarray(result.friction_forces), np.asarray(result.obstacle_forces)
    pressures = np.linalg.norm(forces - drags, axis=-1)
    sizes, states = np.linalg.norm(drags, axis=-1), np.asarray(result.contact_states)
    assert np.all(sizes <= friction * pressures * (1 + 1e-12) + 1e-15)  # to rounding
    memory = np.isfinite(np.asarray(result.state.friction.reference)[..., 0])[..., None, :]
    slips = (states == 2) & memory
    np.testing.assert_allclose(sizes[slips], friction * pressures[slips], rtol=1e-12)
    np.testing.assert_array_equal(pressures > 0, states > 0)
    np.testing.assert_allclose(forces.sum(-3), result.contact_forces, rtol=0, atol=ROUGHLY)


# --- on a floor ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def there_and_back() -> tuple[np.ndarray, rj.Equilibrium]:
    displacements = np.concatenate([np.linspace(0, 2e-4, 5), np.linspace(2e-4, 0, 5)[1:]])
    return displacements, drawn([on_floor(-way) for way in displacements])


def test_the_end_of_a_cable_that_is_drawn_a_little_slips_and_the_rest_sticks(there_and_back):
    """Friction carries off the pull F after F/(mu w), and the end moves by F^2/(2 EA mu w); drawn back, twice the
    change of F in half of the change of the way. The support carries the weight of the first half of an element.
    """
    displacements, path = there_and_back
    stiffness, first = 100.0 * MU * WEIGHT, MU * WEIGHT * H / 2
    out = np.sqrt(2 * stiffness * displacements[:5])
    back = out[-1] - 2 * np.sqrt(stiffness * (displacements[4] - displacements[5:]))
    pull = np.asarray(path.start_force)[:, 0]
    # As each node holds what is at most mu p, the pull is off by a part of a node's mu w h.
    np.testing.assert_allclose(pull[1:5], out[1:] - first, rtol=0, atol=0.1 * MU * WEIGHT * H)
    np.testing.assert_allclose(pull[5:], back + first, rtol=0, atol=0.2 * MU * WEIGHT * H)
    slipping = np.sum(np.asarray(path.contact_states)[:, 0] == 2, axis=1)
    np.testing.assert_array_equal(slipping[1:5], np.ceil(pull[1:5] / (MU * WEIGHT * H)) - 1)
    np.testing.assert_allclose(path.nodes[1:5, -1], path.nodes[:4, -1], rtol=0, atol=1e-11)
    # To there and back again belongs another force: where slips were is a part of the state.
    assert pull[-1] < -0.3 * pull[4]
    np.testing.assert_allclose(path.nodes[-1, 0], path.nodes[0, 0], atol=1e-12)


def test_a_step_from_an_equilibrium_is_that_of_the_path(there_and_back):
    displacements, path = there_and_back
    fourth, fifth = (jax.tree.map(lambda leaf, k=k: leaf[k], path) for k in (4, 5))
    step = rj.solve(on_floor(-displacements[5]), segments=ELEMENTS, guess=fourth)
    np.testing.assert_allclose(step.friction_forces, fifth.friction_forces, rtol=0, atol=ROUGHLY)
    np.testing.assert_array_equal(step.contact_states, fifth.contact_states)
    again = rj.solve(on_floor(-displacements[5]), segments=ELEMENTS, guess=fifth)
    np.testing.assert_allclose(again.friction_forces, fifth.friction_forces, rtol=0, atol=ROUGHLY)
    told = rj.describe(fifth)
    drag = np.linalg.norm(fifth.friction_forces[0].sum(0))
    sticks, slips = (int(np.sum(fifth.contact_states == k)) for k in (1, 2))
    assert f", drags with {drag:.4g} N, sticks at {sticks} nodes and slips at {slips}" in told
    # Without a memory friction does not act.
    rest = rj.solve(on_floor(-displacements[5]), segments=ELEMENTS, guess=LYING)
    np.testing.assert_array_equal(rest.friction_forces, 0.0)
    assert "without friction as from rest" in rj.describe(rest)


def test_a_cable_dragged_over_a_floor_is_held_by_its_weight_times_friction():
    path = drawn([on_floor(x) for x in (0, -0.05, -0.1, -0.2, -0.3, -0.2, 0, 0.1, 0.2)])
    # Of all that the support does not carry: about half of an element.
    forces = np.asarray(path.start_force)[1:]
    held = MU * (WEIGHT + forces[:, 2])
    np.testing.assert_allclose(held, MU * WEIGHT * (1 - H / 2), rtol=1e-6)
    np.testing.assert_allclose(forces[:4, 0], held[:4], rtol=0, atol=ROUGHLY)
    np.testing.assert_allclose(forces[4:, 0], -held[4:], rtol=0, atol=ROUGHLY)
    states = np.asarray(path.contact_states)[:, 0]
    np.testing.assert_array_equal(states[1:, 1:], 2)
    np.testing.assert_array_equal(states[:, 0], 0)


def test_a_cable_dragged_aside_is_held_against_its_way():
    path = drawn([on_floor(-0.1 * k, 0.02 * k * k, EA=1e4) for k in range(STEPS)])
    displacements = np.diff(np.asarray(path.nodes), axis=0)[:, 1:]
    drags = np.asarray(path.friction_forces)[1:, 0, 1:]
    along = (
        np.sum(drags * displacements, axis=-1) / np.linalg.norm(drags, axis=-1) / np.linalg.norm(displacements, axis=-1)
    )
    np.testing.assert_allclose(along, -1.0, atol=1e-9)
    assert np.max(np.abs(drags[..., 1])) > 0.3 * np.max(np.abs(drags[..., 0]))


def test_a_cable_on_a_floor_that_tilts_begins_to_slip_at_the_angle_of_friction():
    """And going back it stays where it is, held by as much as it was drawn."""
    angles = np.radians([0, 5, 10, 16, 17, 20, 25, 30, 20])
    tilted = [(10 * math.sin(angle), 0.0, -10 * math.cos(angle)) for angle in angles]
    path = drawn([on_floor(gravity=gravity, EA=1e4) for gravity in tilted])
    lying = 1 - H / 2
    expected = np.maximum(np.sin(angles) - MU * np.cos(angles), 0) * lying + np.sin(angles) * H / 2
    np.testing.assert_allclose(np.asarray(path.start_force)[3:8, 0], expected[3:8], rtol=0, atol=3e-3 * WEIGHT)
    np.testing.assert_allclose(np.asarray(path.start_force)[5:8, 0], expected[5:8], rtol=1e-6)
    sticks = np.sum(np.asarray(path.contact_states)[:, 0] == 1, axis=1)
    assert np.all(sticks[1:4] >= ELEMENTS - 2)  # the angle of friction is 16.7 degrees
    np.testing.assert_array_equal(sticks[5:8], 0)
    assert float(path.start_force[8, 0]) > 2 * expected[8]


# --- over a cylinder -------------------------------------------------------------------------------------------------

AROUND = 0.1
STRAIGHT = (1 - math.pi * AROUND) / 2


def over_cylinder(down: float, stiffness: float) -> Scene:
    """A cable of no weight half around a cylinder, drawn down on one side, with 1 N on the other."""
    rod = Rod(1.0, stiffness, stiffness, 1e4, radius=0.002)
    cylinder = rj.Cylinder((AROUND, -1, 0), (AROUND, 1, 0), AROUND - 0.002, friction=MU)
    return Scene(rod, Pin((0, 0, -STRAIGHT - down)), Free(force=(0, 0, -1.0)), obstacles=[cylinder])


def half_around() -> rj.Guess:
    s = np.linspace(0, 1, 401)
    angle = np.pi - np.clip(s - STRAIGHT, 0, np.pi * AROUND) / AROUND
    x = np.stack([AROUND + AROUND * np.cos(angle), 0 * s, AROUND * np.sin(angle)], axis=1)
    x[:, 2] += np.minimum(s - STRAIGHT, 0) - np.maximum(s - STRAIGHT - np.pi * AROUND, 0)
    return rj.Guess(x)


def pulled(displacements: tuple[float, ...], stiffness: float, segments: int) -> list[float]:
    result, pulls = half_around(), []
    for way in displacements:
        result = rj.solve(over_cylinder(way, stiffness), segments=segments, guess=result, strain_limit=None)
        assert result.converged
        if pulls:
            check_cone(result)
        pulls.append(float(np.linalg.norm(result.start_force)))
    return pulls


def capstan_with_bending(stiffness: float) -> float:
    """The pull over a weight of 1: along the free parts tension and EI curvature^2/2 are the force there; where the
    cable leaves the cylinder its shear pushes on that, with friction of its own.
    """
    bent = stiffness / (2 * AROUND**2)

    def leaving(force: float) -> tuple[float, float]:
        """Shear, and the angle by which the cable is less around."""
        shear = math.sqrt(force**2 - (force - bent) ** 2)
        return shear, math.asin(shear / force)

    pull, (shear, angle) = math.exp(MU * math.pi), leaving(1.0)
    for _ in range(50):
        pulling, less = leaving(pull)
        along = (1 - bent + MU * shear) * math.exp(MU * (math.pi - angle - less))
        pull = along + MU * pulling + bent
    return pull


@pytest.mark.slow
def test_capstan():
    """In both directions; it slips by more than a node's way, and not at all, which leaves the pull as it is."""
    pulls = pulled((0, 0.002, 0.004, 0.0, -0.002), stiffness=1e-6, segments=160)
    np.testing.assert_allclose(pulls[0], 1.0, rtol=1e-6)
    np.testing.assert_allclose(pulls[1:3], math.exp(MU * math.pi), rtol=2e-4)
    np.testing.assert_allclose(pulls[3:], math.exp(-MU * math.pi), rtol=2e-4)


@pytest.mark.slow
@pytest.mark.exhaustive
def test_capstan_of_a_stiff_cable():
    pulls = pulled((0, 0.002, 0.004), stiffness=1e-4, segments=96)
    # A node of 96 may lie half an element off where the cable leaves the cylinder.
    np.testing.assert_allclose(pulls[1:], capstan_with_bending(1e-4), rtol=1e-3)
    assert capstan_with_bending(1e-4) < 0.998 * math.exp(MU * math.pi)


# --- derivatives -----------------------------------------------------------------------------------------------------


def among(p: jax.Array, x=-0.01, y=0.006) -> Scene:
    """A cable that slips and sticks on a cylinder, and slips on a slanting floor."""
    nothing = 0 * p[0]
    rod = Rod(1.0 + p[0], EI * (1 + p[1]), GJ, 1e3 * (1 + p[2]), 0.1 * (1 + p[3]), radius=RADIUS)
    cylinder = rj.Cylinder(
        jnp.stack([nothing + 0.6, nothing - 1, p[4] - 0.1]), (0.6, 1, -0.1), 0.1, friction=0.2 * (1 + p[5])
    )
    floor = rj.Plane((0, 0, -RADIUS - 0.1), (0, 0.02, 1), friction=MU + p[6])
    start = Pin(jnp.stack([nothing + x, y + p[7], nothing + 0.05]))
    return Scene(rod, start, Free(), (0, 0, -10.0), obstacles=[cylinder, floor])


NOMINAL = jnp.zeros(8)


@pytest.fixture(scope="module")
def last() -> rj.Equilibrium:
    rest = rj.solve(among(NOMINAL, 0, 0), segments=32, guess=rj.Guess([(0, 0, 0.05), (0.6, 0, 0.02), (1, 0, 0.02)]))
    return rj.solve(among(NOMINAL, -0.01, 0.004), segments=32, guess=rest)


def step_from(last: rj.Equilibrium, p: jax.Array) -> rj.Equilibrium:
    return rj.solve(among(p), segments=32, guess=last)


@pytest.mark.slow
@pytest.mark.exhaustive
def test_the_coupled_system_is_the_derivative_of_what_is_out_of_balance(last):
    """By the places of nodes that stick and slip on a cylinder and a floor, and by pressures that bound friction."""
    form, point = form_and_point(step_from(last, NOMINAL))
    _, _, states = exerted_by_obstacles(form, point)
    assert {*np.asarray(states[0])} == {0, 1, 2}
    here = form.linearized(point)
    system = form.coupled(point, here.system)
    generator = np.random.default_rng(0)
    rotation = jnp.asarray(generator.normal(size=here.gradient.shape))
    change = jnp.asarray(generator.normal(size=point.end_force.shape))
    displacements = jnp.asarray(generator.normal(size=point.nodal.positions.shape))
    displacements = jnp.where(form.is_held[:, None], 0.0, displacements)
    rows = np.array(NodalChange.nothing(point.nodal).pressures)
    rows[:2] = generator.normal(size=rows[:2].shape) * (np.asarray(states) > 0)
    step = NodalChange(displacements, jnp.asarray(rows))

    def residual_at(part):
        others = jax.tree.map(lambda change: part * change, step)
        return form.residual_vectors(form.retract(point, here.bases, part * rotation, part * change, others))

    _, (_, expected) = jax.jvp(residual_at, (jnp.array(0.0),), (jnp.array(1.0),))
    before = len(expected) - form.layout.size - displacements.size - rows.size
    multipliers = jnp.concatenate(
        [jnp.zeros(before), rows.ravel(), displacements.ravel(), form.layout.components(change)]
    )
    _, found = system.times(rotation, multipliers)
    nodes = slice(-form.layout.size - displacements.size, -form.layout.size)
    np.testing.assert_allclose(found[nodes], expected[nodes], atol=1e-9 * float(jnp.max(jnp.abs(expected[nodes]))))
    # Slips of what sticks, but for the compliance of the contacts in the system.
    sticking = np.repeat(np.asarray(states) == 1, 3, axis=0).ravel()
    sticking = np.concatenate([np.zeros(2 * len(form.field.s), bool), sticking])
    slips = [np.asarray(values)[before : before + rows.size][sticking] for values in (found, expected)]
    assert len(slips[0]) > 0
    np.testing.assert_allclose(*slips, atol=1e-9)


@pytest.mark.slow
def test_derivatives_are_those_of_differences(last):
    """With the places of the last equilibrium held, of what sticks and what slips."""

    solver = rj.Newton(tolerance=1e-10)

    def seen(p):
        result = rj.solve(among(p), segments=32, guess=last, solver=solver)
        drags = jnp.sum(result.friction_forces, axis=1)
        return jnp.concatenate(
            [result.start_force, result.nodes[10], result.nodes[-1], drags.reshape(-1), result.energy[None]]
        )

    forward = np.asarray(jax.jacfwd(seen)(NOMINAL))
    step = 2e-7
    columns = [(seen(NOMINAL.at[k].add(step)) - seen(NOMINAL.at[k].add(-step))) / (2 * step) for k in range(8)]
    differences = np.stack(columns, axis=1)
    sizes = np.max(np.abs(differences), axis=1, keepdims=True)
    # The square of the step, where a slip turns: 4e-4 at steps of 1e-5, 4e-6 at 1e-6.
    np.testing.assert_allclose(forward / sizes, differences / sizes, rtol=0, atol=1e-6)
    weights = jnp.linspace(1.0, 2.0, len(forward))
    backward = jax.grad(lambda p: weights @ seen(p))(NOMINAL)
    # A node that slips by 1e-4 across is as stiff as 1e4 mu p, one that sticks much more.
    np.testing.assert_allclose(backward, weights @ forward, rtol=1e-6, atol=1e-6 * np.max(sizes))


# --- other rods, meshes, files ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rods_by_frames_are_dragged_too():
    """A flat one as a plain one in the plane; a curved one with clamped end, where forces of all supports balance."""

    def scene(x: float, rod: Rod) -> Scene:
        return dataclasses.replace(on_floor(x), rod=rod, start=Clamp((x, 0, 0), frame((1, 0, 0))))

    def steps(rod: Rod) -> rj.Equilibrium:
        result = LYING
        for x in (0, -1e-4, -2e-4, -1.5e-4):
            result = rj.solve(scene(x, rod), segments=ELEMENTS, guess=result)
            assert result.converged
        check_cone(result)
        return result

    plain, flat = steps(cable()), steps(Rod(1.0, (2 * EI, EI), GJ, 100.0, WEIGHT / 10, radius=RADIUS))
    np.testing.assert_allclose(flat.friction_forces, plain.friction_forces, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(flat.contact_states, plain.contact_states)
    curved = steps(Rod(1.0, (EI, 2 * EI), GJ, 100.0, WEIGHT / 10, radius=RADIUS, rest_curvature=(0.3, 0.2)))
    total = np.asarray(curved.contact_forces).sum(0) - np.asarray(curved.start_force)
    np.testing.assert_allclose(total, [0, 0, WEIGHT], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_finer_mesh_has_the_same_memory():
    """A guess on another mesh, and meshes that are chosen: slips are counted from the same places."""
    rest = rj.solve(on_floor(), segments=ELEMENTS, guess=LYING)
    there = rj.solve(on_floor(-2e-4), segments=ELEMENTS, guess=rest)
    step = rj.solve(on_floor(-1e-4), segments=2 * ELEMENTS, guess=there)
    same = rj.solve(on_floor(-1e-4), segments=ELEMENTS, guess=there)
    chosen = rj.solve(on_floor(-1e-4), rtol=1e-5, guess=there)
    for result in (step, chosen):
        assert result.converged
        check_cone(result)
        np.testing.assert_allclose(result.start_force[0], same.start_force[0], rtol=0, atol=MU * WEIGHT * H)
    assert len(chosen.s) > len(there.s)


def test_files_keep_friction(there_and_back, tmp_path):
    _, path = there_and_back
    rj.save(path, tmp_path / "drawn.vtkhdf")
    again = rj.load(tmp_path / "drawn.vtkhdf")
    assert jax.tree.structure(again) == jax.tree.structure(path)
    jax.tree.map(np.testing.assert_array_equal, again, path)
    scene = on_floor()
    box = rj.Union(rj.Box((0, 0, 1), (0.1, 0.1, 0.1)), rj.Sphere((0, 0, 1), 0.1), friction=0.1)
    scene = dataclasses.replace(scene, obstacles=(*scene.obstacles, box))
    rj.write_scene(scene, tmp_path / "drawn.toml")
    text = (tmp_path / "drawn.toml").read_text()
    assert "friction = 0.3" in text
    read = rj.read_scene(tmp_path / "drawn.toml")
    assert jax.tree.structure(read) == jax.tree.structure(scene)
    for obstacle, friction in zip(read.obstacles, (0.3, 0.1), strict=True):
        np.testing.assert_array_equal(obstacle.friction, friction)


# --- what a scene lacks, and bad input -------------------------------------------------------------------------------


SCENE_FILE = """
rod = {{ length = "1 m", EI = "0.01 N m^2", GJ = "0.008 N m^2", EA = "100 N", radius = "5 mm" }}
start = {{ support = "clamp", position = "[0, 0, 0] m", tangent = [1, 0, 0] }}
end = {{ support = "free" }}
obstacles = [{{ kind = "plane", point = "[0, 0, -5] mm", normal = [0, 0, 1], friction = {friction} }}]
"""


@pytest.mark.parametrize(
    ("friction", "message"),
    [("-0.1", "obstacles[0].friction must not be negative"), ('"0.3 m"', "obstacles[0].friction")],
)
def test_scene_files_say_what_friction_may_be(friction, message, tmp_path):
    path = tmp_path / "floor.toml"
    path.write_text(SCENE_FILE.format(friction=0.3))
    assert float(rj.read_scene(path).obstacles[0].friction) == 0.3
    path.write_text(SCENE_FILE.format(friction=0))
    assert rj.read_scene(path).obstacles[0].friction is None
    path.write_text(SCENE_FILE.format(friction=friction))
    with pytest.raises(ValueError, match="floor") as caught:
        rj.read_scene(path)
    assert message in str(caught.value)


class Own(rj.Obstacle):
    height: jax.Array

    def at(self, point):
        return point[2] - self.height


def test_no_friction_is_no_term():
    for floor in (rj.Plane((0, 0, 0), (0, 0, 1)), rj.Plane((0, 0, 0), (0, 0, 1), friction=0), Own(jnp.array(0.0))):
        assert floor.friction is None
    assert float(Own(jnp.array(0.0), friction=0.2).friction) == 0.2
    assert rj.Sphere((0, 0, 0), 1.0, friction=jnp.array(0.0)).friction is not None  # a number to vary
    smooth = rj.solve(on_floor(friction=0.0), segments=ELEMENTS, guess=LYING)
    assert smooth.state.friction is None
    np.testing.assert_array_equal(smooth.friction_forces, 0.0)
    np.testing.assert_array_equal(np.asarray(smooth.contact_states)[0, 1:], 2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rj.Plane((0, 0, 0), (0, 0, 1), friction=-0.1), "friction must not be negative, got -0.1"),
        (lambda: rj.Sphere((0, 0, 0), 1.0, friction="much"), "friction must be a number, got 'much'"),
        (lambda: Own(jnp.array(0.0), friction=(0.1, 0.2)), "friction must be a number, got an array of shape (2,)"),
        (
            lambda: rj.Union(rj.Plane((0, 0, 0), (0, 0, 1), friction=0.1)),
            "obstacles[0].friction must be 0 within a Union",
        ),
        (lambda: rj.follow([on_floor(), on_floor(-0.1)]), "needs scenes without friction"),
        (
            lambda: rj.solve_path(
                [
                    on_floor(),
                    dataclasses.replace(on_floor(), obstacles=[rj.Plane((0, 0, -0.1), (0, 0, 1), friction=MU)]),
                ]
            ),
            "obstacles[0] must stay the same along a path, as it has friction",
        ),
        (
            lambda: rj.route(on_floor(), []),
            "obstacles[0].friction must be 0 in a route",
        ),
        (
            lambda: rj.Experiment(on_floor(), [rj.Centerline([(0, 0, 0), (1, 0, 0)])]),
            "obstacles[0].friction must be 0 in an Experiment",
        ),
        (
            lambda: rj.tolerances(rj.solve(on_floor(), segments=ELEMENTS, guess=LYING), []),
            "obstacles[0].friction must be 0 in tolerances",
        ),
    ],
)
def test_what_friction_does_not_go_with_is_said(make, message):
    with pytest.raises((ValueError, TypeError)) as caught:
        make()
    assert message in str(caught.value)
