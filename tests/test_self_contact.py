"""Rods that touch themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import rodjax
from rodjax.discretization import nearest_places, self_contact
from rodjax.discretization.curve_distance import Curve
from rodjax.solving.harness import solve_harness

LENGTH, RADIUS = 1.0, 0.02
# The ends of a hairpin: this far from its axis, with tangents that lean so much towards it [rad].
ASIDE, LEAN = 0.06, 1.2


def coil(elements: int) -> tuple[Curve, jax.Array]:
    """A helix of one and a half turns, not quite a smooth one, and random rotation axes."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0.0, 3.2 * np.pi, elements + 1)
    positions = np.stack([0.1 * np.cos(angles), 0.1 * np.sin(angles), 0.005 * angles], axis=1)
    positions /= np.sum(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    tangents = np.gradient(positions, axis=0) + 0.02 / elements * rng.normal(size=positions.shape)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    axes, _ = np.linalg.qr(rng.normal(size=(elements + 1, 3, 3)))
    s, free, radius = np.linspace(0.0, 1.0, elements + 1), np.ones(elements + 1), np.full(elements, 0.01)
    axes = jnp.asarray(np.moveaxis(axes, 0, -1))
    return Curve(
        jnp.asarray(s), jnp.asarray(positions), jnp.asarray(tangents.T), axes, *map(jnp.asarray, (free, radius))
    ), axes


def test_first_and_second_derivatives_of_gaps_are_those_of_jax():
    """That the places move along the rod as the nodes do is part of the second ones."""
    elements = 12
    curve, axes = coil(elements)
    found = nearest_places.nearest(curve)
    rng = np.random.default_rng(1)
    pressures = jnp.asarray(np.where(found.exists, rng.uniform(0.5, 2.0, elements), 0.0))
    unit = jnp.asarray(0.3)
    moves = jnp.asarray(rng.normal(size=(elements + 1, 3)))
    turns = jnp.asarray(rng.normal(size=(3, elements + 1)))

    def gaps(displacements, rotation):
        turn = jnp.einsum("cbn,bn->cn", axes, rotation)
        across = jnp.cross(turn, curve.tangents, axis=0)
        tangents = curve.tangents + across + jnp.cross(turn, across, axis=0) / 2
        moved = curve._replace(positions=curve.positions + displacements, tangents=tangents)
        return jnp.where(found.exists, self_contact.moving_gaps(moved, found)[0], 0.0)

    def by_jax(moves, turns):
        nothing = jnp.zeros_like(moves), jnp.zeros_like(turns)
        rates = jax.jvp(gaps, nothing, (moves, turns))[1]
        gradient = jax.grad(lambda *given: -jnp.sum(pressures * gaps(*given)), argnums=(0, 1))
        return rates, *jax.jvp(gradient, nothing, (moves, turns))[1]

    def by_rows(moves, turns):
        contacts = self_contact.self_contacts(curve, jnp.append(pressures / unit, 0.0), unit, 0)
        x = jnp.zeros((3, 2 * elements + 1)).at[:, ::2].set(turns)
        moments, forces = contacts.rows.curved(x, moves)
        alone = jnp.einsum("ban,an->bn", contacts.by_rotations, turns)
        return contacts.rows.rates(x, moves)[:-1] / unit, forces, moments[:, ::2] + alone

    expected, got = by_numpy(by_jax)(moves, turns), by_numpy(by_rows)(moves, turns)
    assert np.sum(found.exists) > 8
    for ours, truth in zip(got, expected, strict=True):
        # Roundings of numbers of the order 1e3.
        np.testing.assert_allclose(np.where(np.isfinite(truth), ours, 0.0), truth, rtol=1e-9, atol=1e-9)


# --- a hairpin whose legs are pressed together -----------------------------------------------------------------------


def hairpin(EI=1.0, radius=RADIUS, aside=ASIDE, rod=None, **options) -> rodjax.Scene:
    """Inextensible but for 1e-6 of a force, where no rod is given."""
    into, out = (np.array([sign * np.cos(LEAN), -np.sin(LEAN), 0.0]) for sign in (1, -1))
    ends = [
        rodjax.Clamp(jnp.stack([jnp.zeros(()), jnp.asarray(y), jnp.zeros(())]), rodjax.frame(tangent, d2=(0, 0, 1)))
        for y, tangent in ((aside, into), (-aside, out))
    ]
    rod = rodjax.Rod(LENGTH, EI, 1.0, 1e6, radius=radius) if rod is None else rod
    return rodjax.Scene(rod, *ends, **{"self_contact": True} | options)


def guess() -> rodjax.Guess:
    s = np.linspace(0.0, 1.0, 6)
    half = np.array([[0.0, ASIDE], [0.1, 0.03], [0.2, 0.05], [0.3, 0.12], [0.4, 0.08], [0.44, 0.0]])
    fine = np.stack([np.interp(np.linspace(0.0, 1.0, 41), s, x) for x in half.T], axis=1)
    points = np.concatenate([fine, fine[-2::-1] * [1, -1]])
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    points = np.stack([np.interp(np.linspace(0.0, along[-1], 81), along, x) for x in points.T], axis=1)
    return rodjax.Guess(np.pad(points, ((0, 0), (0, 1))))


def elastica() -> tuple[float, float, float]:
    """Force and place of the contact and the bending energy of half of the hairpin, by shooting: its leg touches the
    axis at a distance of the radius, beyond that no force acts along the hairpin.
    """

    def rates(s, state, force):
        _, _, angle, curvature, _ = state
        return [np.cos(angle), np.sin(angle), curvature, -np.cos(angle) * force, curvature**2 / 2]

    def along(state, force, length):
        return solve_ivp(rates, [0.0, length], state, args=(force,), rtol=1e-11, atol=1e-12).y[:, -1]

    def missed(unknown):
        curvature, before, beyond, place = unknown
        touching = along([0.0, ASIDE, -LEAN, curvature, 0.0], before, place)
        middle = along(touching, beyond, LENGTH / 2 - place)
        missed.energy = middle[4]
        return [touching[1] - RADIUS, touching[2], middle[1], middle[2] + np.pi / 2]

    found = fsolve(missed, [19.0, 171.0, 54.0, 0.088], xtol=1e-12)
    assert np.max(np.abs(missed(found))) < 1e-9
    return found[1] - found[2], found[3], 2 * missed.energy


@pytest.fixture(scope="module")
def pressed() -> rodjax.Equilibrium:
    """In its plane; in space the legs slide past one another."""
    return rodjax.solve(hairpin(), segments=32, guess=guess(), planar=True)


def test_legs_of_a_hairpin_press_on_one_another_as_an_elastica_has_it(pressed):
    force, place, energy = elastica()
    assert pressed.converged
    # The last step is quadratic: 1e-12; with contacts as soft as those of the first steps 1e-9.
    assert pressed.residual < 1e-10
    assert not pressed.stable  # out of its plane
    found = pressed.self_contacts
    touching = np.flatnonzero(np.linalg.norm(found.forces, axis=1) > 0)
    # Errors of 32 elements, of fourth order, of a leg on three of these.
    np.testing.assert_allclose(np.sum(np.linalg.norm(found.forces, axis=1)), force, rtol=2e-3)
    np.testing.assert_allclose(found.s[touching], place, atol=2e-3)
    # The radius seems to vary by 3e-4 of itself within elements, which draws the place along by 3e-6.
    np.testing.assert_allclose(found.beyond[touching], LENGTH - found.s[touching], atol=1e-5)
    np.testing.assert_allclose(pressed.elastic_energy, energy, rtol=1e-3)
    np.testing.assert_allclose(found.gaps[touching], 0.0, atol=1e-9)  # 1e-8 EI/L^2 of a force left, over 60
    # Along the rod the forces that it applies to itself are in balance, with its supports too.
    np.testing.assert_allclose(np.sum(pressed.contact_forces, axis=0), 0.0, atol=1e-9 * force)
    np.testing.assert_allclose(pressed.start_force, pressed.end_force, atol=1e-7)


def test_a_rod_that_stays_away_from_itself_is_the_rod_without_contact():
    scenes = [hairpin(aside=0.2, self_contact=touches) for touches in (True, False)]
    with_contact, without = (rodjax.solve(scene, segments=32, guess=guess()) for scene in scenes)
    # Both at a residual of 1e-8.
    np.testing.assert_allclose(with_contact.nodes, without.nodes, atol=1e-8)
    assert not np.any(with_contact.self_contacts.forces)
    assert "does not touch itself" in rodjax.describe(with_contact)
    assert without.self_contacts.forces.shape == (0, 3)


def test_a_contact_that_passes_from_element_to_element_is_one_contact():
    """In space, where the legs slide past one another: two elements would share it, and part in some 100 iterations."""
    first = rodjax.solve(hairpin(aside=0.064), segments=32, guess=guess())
    results = [first]
    # At 2.26 elements along the rod, at 2.23 of the cell before, and at the node there.
    for aside in (0.0634, 0.0584):
        results.append(rodjax.solve(hairpin(aside=aside), segments=32, guess=results[-1]))
    touching = [np.linalg.norm(result.self_contacts.forces, axis=1) > 0 for result in results]
    assert [list(np.flatnonzero(one)) for one in touching] == [[2], [1], [1]]
    for result in results[1:]:
        assert result.converged
        assert result.stable
        assert result.iterations <= 10
    # Of the last one nothing is left to do.
    assert rodjax.solve(results[-1].scene, segments=32, guess=results[-1]).iterations == 0


def test_parts_that_cross_at_first_are_led_apart():
    """In one plane and through one another: the distance is zero, and has no direction of its own."""
    angles = np.linspace(0.0, 2 * np.pi, 61)
    loop = np.stack([0.1 * np.sin(angles), 0 * angles, 0.1 - 0.1 * np.cos(angles)], axis=1)
    straight = np.linspace(0.18, 0.0, 20)[:-1, None] * np.array([[1.0, 0.0, 0.0]])
    points = np.concatenate([loop[0] - straight, loop, loop[-1] + straight[::-1]])
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    points = np.stack([np.interp(np.linspace(0.0, along[-1], 101), along, x) for x in points.T], axis=1) / along[-1]
    frame = rodjax.frame((1, 0, 0), d2=(0, 1, 0))
    ends = rodjax.Clamp((-0.25, 0.02, 0), frame), rodjax.Clamp((0.25, -0.02, 0), frame)
    scene = rodjax.Scene(rodjax.Rod(LENGTH, 1.0, 1.0, 1e4, radius=RADIUS), *ends, self_contact=True)
    result = rodjax.solve(scene, segments=24, guess=rodjax.Guess(points))
    assert result.converged
    assert np.min(result.self_contacts.gaps) > -1e-9


FEATURES = {
    "flat": {"rod": rodjax.Rod(LENGTH, (1.0, 1.5), 1.0, 1e4, radius=RADIUS)},
    "curved": {"rod": rodjax.Rod(LENGTH, 1.0, 1.0, 1e4, radius=RADIUS, rest_curvature=(0.0, 2.0))},
    "steps": {"rod": rodjax.Rod(LENGTH, 1.0, 1.0, 1e4, radius=rodjax.Steps([0.3], [0.02, 0.015]))},
    "sliding": {"clips": [rodjax.Clip(0.5, (0.42, 0.0, 0.0), sliding=True)]},
    "floor": {"obstacles": [rodjax.Plane((0.0, 0.0, -0.025), (0.0, 0.0, 1.0))]},
    "field": {"potentials": [rodjax.Potential(lambda place, s: 5 * place[2] ** 2)]},
    "follower": {"distributed": [rodjax.DistributedForce((0.0, 0.5, 0.0), follower=True)]},
}


@pytest.mark.parametrize(
    "names",
    [
        # Each feature once, in company.
        pytest.param(names, marks=pytest.mark.slow if len(names) > 1 else pytest.mark.exhaustive, id="-".join(names))
        for names in [("flat", "sliding", "floor"), ("steps", "field"), ("curved", "follower"), *zip(FEATURES)]
    ],
)
def test_every_rod_and_load_composes_with_it(names):
    others = {key: value for name in names for key, value in FEATURES[name].items()}
    result = rodjax.solve(hairpin(**others), segments=32, guess=guess())
    assert result.converged
    found = result.self_contacts
    assert np.max(np.linalg.norm(found.forces, axis=1)) > 50.0
    np.testing.assert_allclose(np.min(found.gaps), 0.0, atol=1e-9)  # 1e-8 EI/L^2 of a force left, over 60
    applied = result.end_force - result.start_force + np.sum(result.contact_forces, axis=0)
    applied = applied + np.sum(result.clip_forces, axis=0)
    if "distributed" in others or "potentials" in others:
        return  # whose forces are no field of a result
    np.testing.assert_allclose(applied, 0.0, atol=1e-6)  # 1e-8 on each of 33 nodes


def test_derivatives_are_those_of_tight_solves(pressed):
    """By stiffness, radius and the place of the ends."""

    def quantity(numbers, start=pressed):
        scene = hairpin(EI=numbers[0], radius=numbers[1], aside=numbers[2])
        solver = rodjax.Newton(tolerance=1e-11)
        result = rodjax.solve(scene, segments=32, guess=start, planar=True, solver=solver)
        return result.end_moment[2] + result.end_force[1] + result.nodes[10, 0]

    numbers = jnp.array([1.0, RADIUS, ASIDE])
    gradient = np.asarray(jax.grad(quantity)(numbers))
    for k, step in enumerate((1e-4, 1e-6, 1e-6)):
        change = jnp.zeros(3).at[k].set(step)
        difference = float(quantity(numbers + change) - quantity(numbers - change)) / (2 * step)
        # The error of differences: 1e-11 over the step, and its square.
        np.testing.assert_allclose(gradient[k], difference, rtol=1e-5)


@pytest.mark.slow
def test_a_hairpin_cut_beside_its_contact_is_the_hairpin():
    """In a body beside it: one leg touches within the last element before the joint."""
    elements, beyond = 32, 2
    tight = rodjax.Newton(tolerance=1e-11)
    joint = rodjax.Joint("cut", frame=rodjax.frame((0, 1, 0), (0, 0, 1)), offset=(0.1, 0, 0.02))
    scene = hairpin()

    def cut(EI):
        lengths = LENGTH * (elements - beyond) / elements, LENGTH * beyond / elements
        long, short = (rodjax.Rod(length, EI, 1.0, 1e6, radius=RADIUS) for length in lengths)
        first = rodjax.Scene(long, scene.start, joint, self_contact=True)
        return rodjax.Harness({"long": first, "short": rodjax.Scene(short, joint, scene.end)})

    whole = rodjax.solve(scene, segments=elements, guess=guess(), solver=tight)
    parts = (whole.nodes[: elements - beyond + 1], whole.nodes[elements - beyond :])
    shapes = [rodjax.Guess(nodes, whole.total_twist * (len(nodes) - 1) / elements) for nodes in parts]
    options = {"segments": [elements - beyond, beyond], "solver": tight}
    found = solve_harness(cut(1.0), guess=dict(zip(("long", "short"), shapes, strict=True)), **options)
    assert found.stable
    assert found.iterations < 15
    nodes = jnp.concatenate([found["long"].nodes, found["short"].nodes[1:]])
    # Residuals of 1e-11 EI/L^2.
    assert jnp.max(jnp.abs(nodes - whole.nodes)) < 1e-9
    forces = found["long"].self_contacts.forces
    np.testing.assert_allclose(forces, whole.self_contacts.forces[: len(forces)], atol=1e-9 * jnp.max(forces))
    assert jnp.max(jnp.abs(forces)) > 10

    def of_whole(EI):
        result = rodjax.solve(hairpin(EI=EI), segments=elements, guess=whole, solver=tight)
        return jnp.concatenate([result.end_moment, result.nodes[elements - beyond]])

    def of_parts(EI):
        result = solve_harness(cut(EI), guess=found, **options)
        return jnp.concatenate([result["short"].end_moment, result["long"].nodes[-1]])

    one = jnp.asarray(1.0)
    expected, rates = (by_numpy(lambda EI, of=of: jax.jvp(of, (EI,), (one,))[1])(one) for of in (of_whole, of_parts))
    # Contacts of a linearised system are rigid to about 1e-9.
    np.testing.assert_allclose(rates, expected, atol=1e-7 * np.max(np.abs(expected)))


def test_a_search_of_a_harness_without_numbers_ends():
    """Wells are made wide once, whatever the point is."""
    along = rodjax.frame((1, 0, 0))

    def status(gravity):
        down = jnp.stack([0 * gravity, 0 * gravity, gravity])
        rod = rodjax.Rod(LENGTH, 1.0, 1.0, 1e4, 0.1, radius=RADIUS)
        scene = rodjax.Scene(rod, rodjax.Clamp((0, 0, 0), along), rodjax.Joint("j"), down, self_contact=True)
        return rodjax.solve(rodjax.Harness({"a": scene}, {"j": rodjax.Body(mass=0.1)}), segments=4).status

    found = by_numpy(status)
    assert found(-9.81) == rodjax.Status.CONVERGED
    assert found(np.nan) == rodjax.Status.NOT_FINITE


def test_results_are_saved_and_told(pressed, tmp_path):
    rodjax.save(pressed, tmp_path / "pressed.vtkhdf")
    again = rodjax.load(tmp_path / "pressed.vtkhdf")
    assert again.scene.self_contact
    for ours, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(pressed), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert "touches itself at" in rodjax.describe(pressed)
    assert "self_contact" in str(pressed.scene).splitlines()[-1]
    rodjax.write_scene(pressed.scene, tmp_path / "scene.toml")
    assert rodjax.read_scene(tmp_path / "scene.toml").self_contact
    joint = rodjax.Joint("j")
    first = rodjax.Scene(pressed.scene.rod, pressed.scene.start, joint, self_contact=True)
    harness = rodjax.Harness({"a": first, "b": rodjax.Scene(pressed.scene.rod, joint, pressed.scene.end)})
    rodjax.write_scene(harness, tmp_path / "harness.toml")
    assert [scene.self_contact for scene in rodjax.read_scene(tmp_path / "harness.toml").scenes] == [True, False]


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match="rod must have a radius where it may touch itself, got None"):
        hairpin(radius=None)
    with pytest.raises(TypeError, match="self_contact must be"):
        hairpin(self_contact=1)
    with pytest.raises(ValueError, match="discretization must be 'hermite' for a scene with self_contact"):
        rodjax.solve(hairpin(), segments=8, discretization="finite_difference")
    with pytest.raises(ValueError, match="self_contact must be False in the continuum"):
        rodjax.solve_continuum(hairpin())
    with pytest.raises(ValueError, match="follow needs scenes without self_contact"):
        rodjax.follow([hairpin(), hairpin(aside=0.05)])
    with pytest.raises(ValueError, match="at_critical must be 'jump' for scenes with self_contact"):
        rodjax.solve_path([hairpin(), hairpin(aside=0.05)], segments=8, at_critical="stop")
