"""Rods of a harness that touch one another: against one rod under a point force, balance, and differences."""

import dataclasses

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from scipy.optimize import brentq

import rodjax
from rodjax import Body, Clamp, Guess, Harness, Joint, Newton, Pin, Plane, PointForce, Rod, Scene, plot
from rodjax.analysis.sensitivity import moved
from rodjax.discretization.first_shape import first_shape
from rodjax.linalg.far_rows import SIGNS
from rodjax.model.scene import nondimensional
from rodjax.solving.first_sides import on_their_sides
from rodjax.solving.rod_contact import Between, pairs_of
from rodjax.solving.rod_contact_results import touching_rods

RADIUS, LENGTH, YOUNGS_MODULUS = 0.01, 1.0, 1e7
TIGHT = Newton(tolerance=1e-11)
ALONG, ACROSS = rodjax.frame((1, 0, 0), d2=(0, 0, 1)), rodjax.frame((0, 1, 0), d2=(0, 0, 1))
EI = YOUNGS_MODULUS * np.pi * RADIUS**4 / 4


def rod(youngs_modulus=YOUNGS_MODULUS, length=LENGTH) -> Rod:
    return Rod.circular(length, RADIUS, youngs_modulus, poisson_ratio=0.5)


def beam(axis, frame, height, rod) -> Scene:
    half = 0.5 * LENGTH * np.asarray(axis, float)
    up = jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.asarray(height, float)])
    return Scene(rod, Clamp(up - half, frame), Clamp(up + half, frame))


def crossing(pressed, youngs_modulus=YOUNGS_MODULUS, contact=True) -> Harness:
    """Two beams between clamps, at right angles in their middles, one on the other, each pressed by half of this."""
    cables = {
        "upper": beam((1, 0, 0), ALONG, RADIUS - pressed / 2, rod(youngs_modulus)),
        "lower": beam((0, 1, 0), ACROSS, pressed / 2 - RADIUS, rod()),
    }
    return Harness(cables, contact=contact)


def force_alone(deflection: float, segments: int) -> float:
    """That deflects one beam so far in its middle."""

    def missing(force: float) -> float:
        scene = beam((1, 0, 0), ALONG, 0.0, rod())
        scene = Scene(scene.rod, scene.start, scene.end, point_forces=[PointForce(LENGTH / 2, (0, 0, -force))])
        alone = rodjax.solve(scene, segments=segments, solver=TIGHT)
        return -float(alone.nodes[segments // 2, 2]) - deflection

    return float(brentq(missing, 1e-6, 1.0, xtol=1e-13))


def solved(pressed, *given, guess=None) -> rodjax.HarnessEquilibrium:
    return rodjax.solve(crossing(pressed, *given), segments=8, solver=TIGHT, guess=guess)


@pytest.fixture(scope="module")
def pressed() -> rodjax.HarnessEquilibrium:
    # Bits are compared: NumPy code has others than a program.
    with rodjax.numpy_first(False):
        return solved(0.016)


def test_crossing_beams_press_one_another_as_a_point_force_presses_one(pressed):
    """Each is deflected by half of what both are pressed by: 0.8 of its radius, where it is a seventh stiffer than at
    first, as it is stretched.
    """
    assert pressed.converged
    assert pressed.stable
    upper, lower = (pressed[name].contact_forces.sum(0) for name in ("upper", "lower"))
    expected = force_alone(0.008, 8)
    assert expected > 1.1 * 192 * EI * 0.008 / LENGTH**3
    # The gap is seen smaller by at most 3e-6 of the radius: 4e-6 of the deflection.
    np.testing.assert_allclose(float(upper[2]), expected, rtol=1e-5)
    np.testing.assert_allclose(expected, force_alone(0.008, 32), rtol=1e-3)  # the mesh, of fourth order
    np.testing.assert_allclose(upper, -lower, atol=1e-12)
    for name, force in (("upper", upper), ("lower", lower)):
        np.testing.assert_allclose(pressed[name].start_force - pressed[name].end_force, force, atol=1e-9 * expected)
    # Without friction, but for the direction in which a contact point is drawn, 3e-6 pi radii by an element's length.
    assert np.linalg.norm(upper[:2]) < 1e-5 * expected


def test_contacts_are_told(pressed):
    (names, found), *others = pressed.rod_contacts.items()
    assert names == ("upper", "lower")
    assert not others
    touching = np.flatnonzero(np.linalg.norm(found.forces, axis=1) > 0)
    assert len(touching) == 1
    np.testing.assert_allclose(found.forces.sum(0), pressed["upper"].contact_forces.sum(0), atol=1e-12)
    # Where the residual is 1e-11, gaps are zero to 1e-15; elsewhere there is no penetration.
    np.testing.assert_allclose(float(found.gaps[touching[0]]), 0.0, atol=1e-13)
    assert np.min(found.gaps) > -1e-13
    middles = float(found.s[touching[0]]), float(found.other_s[touching[0]])
    np.testing.assert_allclose(middles, LENGTH / 2, atol=1e-5)
    places = [pressed[name].position_at(jnp.array([s]))[0] for name, s in zip(names, middles, strict=True)]
    np.testing.assert_allclose(np.linalg.norm(places[0] - places[1]), 2 * RADIUS, rtol=1e-5)
    assert "upper and lower touch, upper at s = 0.5 m and lower at s = 0.5 m, and push one another with " in str(
        rodjax.describe(pressed)
    )


def test_small_deflections_have_the_force_of_the_closed_form():
    """192 EI w/L^3 of a beam between clamps; stretch adds some 0.55 (w/2 radius)^2 of it, and the mesh nothing."""
    deflection = 0.01 * RADIUS
    found = solved(2 * deflection)
    force = float(found["upper"].contact_forces[:, 2].sum())
    np.testing.assert_allclose(force, 192 * EI * deflection / LENGTH**3, rtol=1e-3)


def test_beams_that_do_not_reach_one_another_do_not_touch():
    apart = solved(-0.001)
    assert apart.converged
    assert jnp.all(apart.rod_pressures == 0)
    assert float(apart.rod_contacts["upper", "lower"].gaps.min()) == pytest.approx(0.001, rel=1e-4)
    assert "no rods touch one another" in rodjax.describe(apart)


# --- rods along one another ------------------------------------------------------------------------------------------


def lying_together(apart, reach, stiffer=0.0) -> tuple[Harness, float]:
    """Two beams side by side, so far apart between the same clamps, pressed together by a load on each that lets them
    touch from `reach` after the clamps on: q = 72 EI w/reach^4, as of a beam that is pressed on a plane at a distance
    w, here of 0.02 radii. And q. `stiffer`: of the lower one.
    """
    load = 72 * EI * 0.02 * RADIUS / reach**4
    density, cables = load / (np.pi * RADIUS**2 * 10.0), {}
    for name, side, modulus in (("upper", 1.0, YOUNGS_MODULUS), ("lower", -1.0, YOUNGS_MODULUS * (1 + stiffer))):
        heavy = Rod.circular(LENGTH, RADIUS, modulus, poisson_ratio=0.5, density=density)
        height = side * (RADIUS + jnp.asarray(apart) / 2)
        ends = [Clamp(jnp.stack([jnp.asarray(x), jnp.zeros(()), height]), ALONG) for x in (0.0, LENGTH)]
        cables[name] = Scene(heavy, *ends, (0, 0, -10.0 * side))
    return Harness(cables, contact=True), load


@pytest.mark.parametrize(("segments", "rtol"), [(16, 2e-3), (64, 1e-4)])
def test_beams_pressed_together_touch_along_a_line(segments, rtol):
    """As one of them on a plane: between the places from which on they touch, where each is pushed by q reach/3, as it
    is loaded. 8.6e-4 and 4.3e-5 of the force; on 64 elements 26 of them touch.
    """
    reach = 0.3
    harness, load = lying_together(0.04 * RADIUS, reach)
    found = rodjax.solve(harness, segments=segments)
    assert found.converged
    assert found.stable
    assert found.iterations <= 5  # 3: the places where they touch are known beforehand
    force = load * (LENGTH - 4 / 3 * reach)
    np.testing.assert_allclose(found["lower"].contact_forces.sum(0), [0, 0, -force], atol=rtol * force)
    contacts = found.rod_contacts["upper", "lower"]
    pushes = np.linalg.norm(contacts.forces, axis=1)
    first, last = contacts.s[np.flatnonzero(pushes)[[0, -1]]]
    # The places are known to an element.
    np.testing.assert_allclose([first, LENGTH - last], reach, atol=LENGTH / segments)
    np.testing.assert_allclose(contacts.gaps[pushes > 0], 0.0, atol=1e-11)
    # Where they lie on one another each element bears its load, to the ripple beside the ends.
    inner = pushes[(contacts.s > 0.42) & (contacts.s < 0.58)] * segments / LENGTH
    np.testing.assert_allclose(inner, load, rtol=0.15 if segments == 16 else 1e-3)


def test_more_contacts_than_are_sought_are_told():
    """52 of 128 elements touch."""
    harness, _ = lying_together(0.04 * RADIUS, 0.3)
    with pytest.warns(rodjax.NotConvergedWarning, match="touch one another on more elements than are sought together"):
        found = rodjax.solve(harness, segments=128, solver=Newton(max_iterations=5))
    assert found.status == rodjax.Status.CROWDED


@pytest.mark.slow
def test_supports_that_hold_cables_within_one_another_are_told():
    low, high = (beam((1, 0, 0), ALONG, height, rod()) for height in (0.0, 0.015))
    with pytest.warns(rodjax.NotConvergedWarning) as warned:
        result = rodjax.solve(Harness({"upper": high, "lower": low}, contact=True), segments=8, solver=TIGHT)
    for told in (str(warned[0].message), rodjax.describe(result)):
        assert "upper (start) and lower (start) are held 0.015 m apart, less than their radii together, 0.02 m" in told
        assert "upper (end) and lower (end)" in told
        assert "upper (start) and lower (end)" not in told


def test_derivatives_of_rods_along_one_another():
    """By how far they are apart, and the stiffness of one, beside differences."""
    begin = jnp.array([0.04 * RADIUS, 0.0])

    def numbers(given, guess=None):
        harness, _ = lying_together(given[0], 0.3, given[1])
        found = rodjax.solve(harness, segments=16, solver=TIGHT, guess=guess)
        forces = found["upper"].end_force[2], found.rod_pressures.sum(), found["lower"].start_moment[1]
        return jnp.stack([*forces, found["lower"].nodes[3, 2], found.energy]), found

    values, found = numbers(begin)
    assert jnp.any(found.wide_wells & (found.rod_pressures > 0))
    rates = jax.jacfwd(lambda given: numbers(given)[0])(begin)
    for k, step in enumerate((1e-3 * RADIUS, 1e-3)):
        after, before = (numbers(begin.at[k].add(way), guess=found)[0] for way in (step, -step))
        np.testing.assert_allclose(
            step * rates[:, k], (after - before) / 2, rtol=1e-5, atol=1e-8 * np.abs(values).max()
        )


@pytest.mark.slow
def test_a_rod_on_a_floor_that_touches_no_other_is_as_alone(pressed):
    """Of another structure than those that touch."""
    heavy = Rod.circular(LENGTH, RADIUS, YOUNGS_MODULUS, poisson_ratio=0.5, density=3000.0)
    ends = Clamp((0, 1, 0), ALONG), Clamp((0.99, 1, 0), ALONG)
    aside = Scene(heavy, *ends, (0, 0, -9.81), obstacles=[Plane((0, 0, -0.03), (0, 0, 1))])
    cables = dict(zip(pressed.names, pressed.harness.scenes, strict=True))
    all_three = Harness({**cables, "aside": aside}, contact=[pressed.names])
    found = rodjax.solve(all_three, segments=8, solver=TIGHT)
    alone = rodjax.solve(aside, segments=8, solver=TIGHT)
    assert found.converged
    assert jnp.max(jnp.linalg.norm(alone.contact_forces, axis=1)) > 0.1
    np.testing.assert_allclose(found["aside"].nodes, alone.nodes, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["upper"].nodes, pressed["upper"].nodes, rtol=0, atol=1e-12)


def test_derivatives_are_those_of_differences(pressed):
    """By the stiffness of one, and by how far both are pressed."""

    def numbers(modulus, down, guess=None):
        found = solved(down, modulus, guess=guess)
        forces = found["upper"].end_force[2], found.rod_pressures.sum(), found["lower"].start_moment[0]
        return jnp.stack([*forces, found["lower"].nodes[3, 2], found.energy])

    given = jnp.array(YOUNGS_MODULUS), jnp.array(0.016)
    derivatives = jax.jacrev(numbers, argnums=(0, 1))(*given)
    for k, step in enumerate((3e4, 1e-6)):
        ahead, behind = ([x + sign * step * (j == k) for j, x in enumerate(given)] for sign in (1, -1))
        difference = (numbers(*ahead, pressed) - numbers(*behind, pressed)) / (2 * step)
        # Steps of 3e-3 and 6e-5 of the numbers: second-order errors of some 1e-6 and 1e-9.
        np.testing.assert_allclose(derivatives[k], difference, rtol=1e-6 if k else 1e-5, atol=1e-12)


def test_derivatives_of_too_many_contacts_are_no_numbers(pressed, monkeypatch):
    monkeypatch.setattr("rodjax.solving.rod_contact_results.MOST_TOUCHING", 4)
    for count, is_known in ((4, True), (5, False)):
        pressures = jnp.where(jnp.arange(8) < count, 1.0, 0.0)
        found = touching_rods(pressed.harness, pressed.groups, pressures, pressed.wide_wells, pressed.members)
        assert found is not None
        assert bool(jnp.all(jnp.isfinite(found.values))) == is_known
        assert bool(jnp.isfinite(found.force)) == is_known


@pytest.mark.slow
def test_a_picture_shows_what_beams_apply_to_each_other(pressed):
    axes = plot.plot_harness(pressed, loads=True)
    (lines,) = (part for part in axes.collections if isinstance(part, Line3DCollection))
    ways = [end - begin for begin, end in map(np.asarray, lines._segments3d)]  # pyright: ignore[reportAttributeAccessIssue]
    # Where they touch, from below on the upper one, from above on the lower one.
    assert sorted(np.sign(way[2]) for way in ways) == [-1.0, 1.0]
    assert "orange: contact" in axes.texts[-1].get_text()


def test_no_beam_is_led_through_the_other():
    """Ends that are led past one another: in steps of a quarter of the radius the upper one stays the upper one."""
    path = rodjax.solve_path([crossing(down) for down in np.linspace(0.0, 6 * RADIUS, 13)], segments=8)
    assert jnp.all(path.converged)
    assert jnp.all(path["upper"].nodes[:, 4, 2] - path["lower"].nodes[:, 4, 2] > 1.99 * RADIUS)
    assert jnp.all(jnp.diff(path.rod_pressures.sum(1)) > 0)


def test_what_touches_comes_back_from_a_file_to_the_last_bit(pressed, tmp_path):
    rodjax.save(pressed, tmp_path / "harness.vtkhdf")
    with h5py.File(tmp_path / "harness.vtkhdf", "r") as file:
        assert file["rodjax"].attrs["format"] == 18
        for place in (
            "rod_pressures",
            "wide_wells",
            *(f"cables/1/scene/contact_loads/on_{name}" for name in ("positions", "tangents")),
        ):
            attributes = file[f"rodjax/{place}"].attrs
            assert attributes["units"]
            assert attributes["description"]
    loaded = rodjax.load(tmp_path / "harness.vtkhdf")
    assert loaded.harness.contact == pressed.harness.contact
    for one, other in zip(jax.tree.leaves(loaded), jax.tree.leaves(pressed), strict=True):
        np.testing.assert_array_equal(one, other)
    with rodjax.numpy_first(False):
        again = rodjax.solve(loaded.harness, segments=8, solver=TIGHT, guess=loaded)
    assert again.iterations == 0
    np.testing.assert_array_equal(again.rod_pressures, pressed.rod_pressures)
    # Of format 17, in which all wells were narrow.
    with h5py.File(tmp_path / "harness.vtkhdf", "r+") as file:
        file["rodjax"].attrs["format"] = 17
        del file["rodjax/wide_wells"]
    np.testing.assert_array_equal(rodjax.load(tmp_path / "harness.vtkhdf").wide_wells, np.zeros(8, bool))


def test_a_scene_file_says_which_cables_touch(tmp_path):
    harness = crossing(0.0, contact=[("lower", "upper")])
    rodjax.write_scene(harness, tmp_path / "harness.toml")
    read = rodjax.read_scene(tmp_path / "harness.toml")
    assert isinstance(read, Harness)
    assert read.contact == harness.contact == ((0, 1),)
    assert 'contact = [["upper", "lower"]]' in (tmp_path / "harness.toml").read_text()


def test_what_does_not_know_of_other_rods_says_so(pressed):
    with pytest.raises(ValueError, match="got that of a rod which touches others: solve its Harness"):
        rodjax.solve(pressed["upper"].scene)
    with pytest.raises(ValueError, match="equilibrium must be of a harness with contact=False"):
        rodjax.lowest_mode(pressed)


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        ([("upper", "middle")], "contact names the cable 'middle', but the cables are 'upper', 'lower'"),
        ([("upper", "upper")], "contact must be of different cables, got 'upper' twice: self_contact=True"),
        (["upper"], "contact must be True, False or pairs of names of cables, got 'upper' among them"),
        ([("upper", "lower", "upper")], "contact must be True, False or pairs of names of cables"),
        (False, "a harness must have an end that is a Joint, or contact between rods"),
    ],
)
def test_contact_between_what_cannot_touch_is_refused(contact, message):
    with pytest.raises(ValueError, match=message):
        crossing(0.0, contact=contact)


def test_cables_that_end_in_one_joint_and_rods_without_a_radius_are_refused():
    first, second = Scene(rod(), Clamp((0, 0, 0), ALONG), Joint("j")), Scene(rod(), Joint("j"), Pin((1.9, 0, 0)))
    with pytest.raises(ValueError, match="without a common joint, as their ends meet there, got 'a' and 'b'"):
        Harness({"a": first, "b": second}, contact=[("b", "a")])
    with pytest.raises(ValueError, match="no two cables are without a common joint"):
        Harness({"a": first, "b": second}, {"j": Body()}, contact=True)
    thin = beam((0, 1, 0), ACROSS, 0.0, Rod(LENGTH, 1.0, 1.0, 1e4))
    with pytest.raises(ValueError, match=r"cables\['b'\].rod must have a radius, as it may touch another cable"):
        Harness({"a": first, "b": thin, "c": second}, contact=[("a", "b")])


@pytest.mark.slow
def test_a_beam_of_two_parts_is_pressed_by_one_by_frames(pressed):
    """A joint beside the contact changes nothing but the mesh; a section that is stiffer in one direction, by frames,
    presses no less.
    """
    whole, scenes = crossing(0.016), {}
    scenes["left"] = Scene(rod(length=0.6), whole["upper"].start, Joint("j", ALONG))
    scenes["right"] = Scene(rod(length=0.4), Joint("j", ALONG), whole["upper"].end)
    round_one = whole["lower"].rod
    stiffnesses = (2 * round_one.EI, round_one.EI), round_one.GJ, round_one.EA
    flat = Rod(LENGTH, *stiffnesses, radius=RADIUS)
    scenes["lower"] = Scene(flat, whole["lower"].start, whole["lower"].end)
    found = rodjax.solve(Harness(scenes, contact=[("left", "lower")]), segments=8, solver=TIGHT)
    assert found.converged
    assert found.stable
    force = found.rod_contacts["left", "lower"].forces.sum(0)
    assert float(force[2]) > 0.99 * float(pressed.rod_pressures.sum())
    supports = found["right"].end_force - found["left"].start_force
    # Residuals of 1e-11 EI/L^2.
    np.testing.assert_allclose(supports, -force, atol=1e-9)
    np.testing.assert_allclose(found["lower"].end_force - found["lower"].start_force, force, atol=1e-9)


def test_numbers_of_a_harness_without_joints_change():
    changed = moved(crossing(0.016), {"cables.upper.rod.length": jnp.asarray(0.1)})
    assert float(changed["upper"].rod.length) == pytest.approx(LENGTH + 0.1, rel=1e-15)
    assert float(changed["lower"].rod.length) == LENGTH


# --- rods of several structures --------------------------------------------------------------------------------------


def test_pairs_on_one_mesh_are_of_one_kind():
    """In the order in which their contacts stand in a result: by the groups of both rods, then as in the harness."""
    contact = ((0, 1), (0, 2), (0, 3), (1, 3), (2, 3))
    members, counts = ((0, 2), (1,), (3,)), (8, 8, 16)
    kinds = pairs_of(contact, members, counts)
    found = []
    for kind in kinds:
        stacks = [[number for group in groups for number in members[group]] for groups in kind.groups]
        assert [[counts[group] for group in groups] for groups in kind.groups] in ([[8, 8], [8, 8]], [[8, 8], [16]])
        found += [(stacks[0][first], stacks[1][second]) for first, second in kind.places]
    assert found == [(0, 1), (0, 2), (0, 3), (2, 3), (1, 3)]
    assert len(kinds) == 2


@pytest.mark.slow
def test_what_a_structure_is_changes_nothing_for_contacts():
    """Two beams below a third one, one of them with a force of 0 N, which makes it another structure."""

    def below(at: float, **more) -> Scene:
        scene = beam((0, 1, 0), ACROSS, 0.008 - RADIUS, rod())
        start, end = (Clamp(support.position + jnp.array([at, 0, 0]), ACROSS) for support in (scene.start, scene.end))
        return Scene(scene.rod, start, end, **more)

    upper = beam((1, 0, 0), ALONG, RADIUS - 0.008, rod())
    alike = Harness({"upper": upper, "left": below(-0.2), "right": below(0.25)}, contact=True)
    nothing = [PointForce(LENGTH / 2, (0, 0, 0))]
    apart = Harness({"upper": upper, "left": below(-0.2), "right": below(0.25, point_forces=nothing)}, contact=True)
    expected, found = (rodjax.solve(harness, segments=8, solver=TIGHT) for harness in (alike, apart))
    assert expected.converged
    assert found.converged
    assert (len(expected.groups), len(found.groups)) == (1, 2)
    for name in alike.names:
        # Where the residual is 1e-11, by the stiffness of a beam.
        np.testing.assert_allclose(found[name].nodes, expected[name].nodes, atol=1e-11)
    for pair, contacts in expected.rod_contacts.items():
        np.testing.assert_allclose(found.rod_contacts[pair].forces, contacts.forces, atol=1e-9)
    for name in ("left", "right"):
        assert float(found.rod_contacts["upper", name].forces[:, 2].sum()) > 0.1
    assert not np.any(found.rod_contacts["left", "right"].forces)


@pytest.mark.parametrize("closed", [3, 12], ids=["few", "more than a few"])
def test_contacts_are_solved_with_those_that_are_needed_first(closed):
    """As all together, and the multipliers stand where the contacts do; to rounding, of numbers of order 1."""
    rng, count = np.random.default_rng(closed), 20
    is_closed = np.isin(np.arange(count), rng.permutation(count)[:closed])
    pressures = np.where(is_closed, 0.0, rng.random(count) * (rng.random(count) < 0.1))  # open ones that still curve
    begin = Between(*map(jnp.asarray, (rng.normal(size=count), pressures, is_closed)), ())
    contacts = begin.first_needed(jnp.asarray(is_closed), jnp.full(count, 0.1))
    assert int(contacts.total) == np.sum(is_closed | (pressures > 0)) == closed + np.sum(pressures > 0)
    by_columns = rng.normal(size=(7, count, 5)) / 4
    by_columns[:, ~is_closed, 0], by_columns[:, ~is_closed & (pressures == 0)] = 0.0, 0.0
    compliances = np.stack([np.where(is_closed, 0.1, 1.0), *(np.full(count, sign) for sign in SIGNS)], axis=1)
    given = np.zeros((count, 5))
    given[:, 0] = np.where(is_closed, 0.1 * pressures - begin.gaps, 0.0)

    def matrix(order) -> np.ndarray:
        columns = by_columns[:, order].reshape(7, -1)
        return -np.diag(compliances[order].reshape(-1)) - columns.T @ columns

    inverse, excess = contacts.inverse(jnp.asarray(matrix(contacts.order)))
    found = contacts.of_model(inverse @ contacts.right)
    whole = matrix(np.arange(count))
    np.testing.assert_allclose(found, np.linalg.solve(whole, given.reshape(-1)), atol=1e-12)
    assert excess == np.sum(np.linalg.eigvalsh(whole) < 0) - np.sum(compliances > 0)


def hammocks() -> Harness:
    """Two cables that cross at right angles, of which the upper one is so long that it would sag through the other."""
    scenes = {}
    for name, frame, height, length in (("upper", ALONG, 0.05, 1.2), ("lower", ACROSS, 0.0, 1.02)):
        half, up = 0.5 * LENGTH * np.asarray(frame)[:, 2], np.array([0, 0, height])
        cable = Rod.circular(length, RADIUS, YOUNGS_MODULUS, poisson_ratio=0.5, density=1200)
        scenes[name] = Scene(cable, Clamp(up - half, frame), Clamp(up + half, frame), gravity=(0, 0, -9.81))
    return Harness(scenes, contact=True)


def test_cables_begin_on_the_side_of_the_line_between_their_ends():
    """The upper one hangs over the lower one, also where its own first shape would have begun below."""
    found = rodjax.solve(hammocks(), segments=8)
    assert found.converged
    assert found.stable
    upper, lower = (np.asarray(found[name].nodes) for name in ("upper", "lower"))
    assert upper[4, 2] - lower[4, 2] > 2 * RADIUS  # in the middle, where they cross
    weight = 1200 * np.pi * RADIUS**2 * 9.81 * 1.2
    pressed = float(np.sum(np.asarray(found.rod_contacts["upper", "lower"].forces)[:, 2]))
    assert 0.1 * weight < abs(pressed) < weight


def test_shapes_are_drawn_to_their_sides_where_they_must_be_and_can_be():
    """By their heights where they cross; what passes as it is, and what a shape is given for, stays as it is."""
    harness = hammocks()
    upper, lower = on_their_sides(harness.scenes, harness.contact, (None, None))
    assert lower is None
    assert upper is not None
    begin = np.asarray(first_shape(nondimensional(harness["lower"])[0], 64))
    lowest = begin[32, 2] * float(harness["lower"].rod.length)
    middle = np.asarray(upper.points)[32, 2]
    assert 2 * RADIUS < middle - lowest < 0.05 + 0.2  # outside, and no higher than its own line
    given = Guess(np.asarray(upper.points) - 1.0)
    assert on_their_sides(harness.scenes, harness.contact, (given, None)) == (given, None)
    apart = jax.tree.map(lambda leaf: leaf, harness["upper"])
    apart = dataclasses.replace(apart, start=Pin((2, 0, 0.05)), end=Pin((3, 0, 0.05)))
    assert on_their_sides([apart, harness["lower"]], harness.contact, (None, None)) == (None, None)
