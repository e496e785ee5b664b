"""Harnesses beside obstacles and in fields: against the uncut rod, balance, and differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax
from rodjax import Clamp, Free, Harness, Joint, Newton, Plane, Potential, Rod, Scene
from rodjax.solving import assembly_step

GRAVITY = (0.0, 0.0, -9.81)
ALONG = rodjax.frame((1, 0, 0))
START, END = Clamp((0, 0, 0), ALONG), Clamp((0.85, 0.02, 0), ALONG)
# A body whose axes are not those of the rod, beside it.
ASIDE = {"frame": rodjax.frame((0, 1, 0), (0, 0, 1)), "offset": (0.1, 0, 0.02)}
FLOOR = Plane((0, 0, -0.05), (0, 0, 1))
TIGHT = Newton(tolerance=1e-11)


def bedding(position, s):
    return 5.0 * position[2] ** 2 + 0.3 * jnp.sin(5 * position[0])


def plain(length: float) -> Rod:
    return Rod.circular(length, 0.005, 1e7, poisson_ratio=0.5, density=1200.0)


def bent(length: float) -> Rod:
    rod = plain(length)
    stiffnesses = (rod.EI, 1.5 * rod.EI), rod.GJ, rod.EA
    return Rod(length, *stiffnesses, rod.mass_per_length, radius=0.005, rest_curvature=(0.5, 0.3), rest_twist=0.3)


def cut(rod, end=END, **around) -> Harness:
    first = Scene(rod(0.5), START, Joint("cut", **ASIDE), GRAVITY, **around)
    return Harness({"a": first, "b": Scene(rod(0.5), Joint("cut", **ASIDE), end, GRAVITY, **around)})


def assert_same(parts, whole):
    """Two parts of the same elements, and the rod."""
    assert parts.converged
    assert parts.stable
    nodes = jnp.concatenate([parts["a"].nodes, parts["b"].nodes[1:]])
    # Residuals of 1e-11 EI/L^2, and of contacts of some 200 EI/L^3 of stiffness less.
    assert jnp.max(jnp.abs(nodes - whole.nodes)) < 1e-9
    largest = jnp.max(jnp.abs(whole.start_force))
    assert jnp.max(jnp.abs(parts["a"].start_force - whole.start_force)) < 1e-9 * largest
    assert jnp.max(jnp.abs(parts["b"].end_moment - whole.end_moment)) < 1e-9
    assert abs(parts.energy - whole.energy) < 1e-9 * abs(whole.energy)
    contacts = jnp.concatenate([parts["a"].contact_forces, parts["b"].contact_forces[1:]])
    n = len(parts["a"].s) - 1
    contacts = contacts.at[n].add(parts["b"].contact_forces[0] + parts.joints["cut"].contact_force)
    assert jnp.max(jnp.abs(contacts - whole.contact_forces)) < 1e-8 * largest


@pytest.mark.parametrize("rod", [plain, pytest.param(bent, marks=pytest.mark.slow)])
def test_a_cut_rod_in_a_field_is_the_rod(rod):
    field = [Potential(bedding)]
    parts = rodjax.solve(cut(rod, potentials=field), segments=4, solver=TIGHT)
    scene = Scene(rod(1.0), START, END, GRAVITY, potentials=field)
    assert_same(parts, rodjax.solve(scene, segments=8, solver=TIGHT, guess=shape_of(parts)))


def shape_of(parts: rodjax.HarnessEquilibrium) -> rodjax.Guess:
    """A rod may lie to either side."""
    nodes = jnp.concatenate([parts["a"].nodes, parts["b"].nodes[1:]])
    return rodjax.Guess(nodes, parts["a"].total_twist + parts["b"].total_twist)


@pytest.fixture(scope="module")
def lying() -> rodjax.HarnessEquilibrium:
    return rodjax.solve(cut(plain, obstacles=[FLOOR]), segments=4, solver=TIGHT)


def test_a_cut_rod_on_a_floor_is_the_rod(lying):
    """The joint lies on the floor as the node does."""
    whole = rodjax.solve(Scene(plain(1.0), START, END, GRAVITY, obstacles=[FLOOR]), segments=8, solver=TIGHT)
    assert lying.joints["cut"].contact_force[2] > 1e-3
    assert_same(lying, whole)


@pytest.mark.slow
def test_a_cut_rod_by_frames_on_a_floor_is_the_rod():
    parts = rodjax.solve(cut(bent, obstacles=[FLOOR]), segments=4, solver=TIGHT)
    scene = Scene(bent(1.0), START, END, GRAVITY, obstacles=[FLOOR])
    whole = rodjax.solve(scene, segments=8, solver=TIGHT, guess=shape_of(parts))
    assert jnp.sum(whole.contact_forces[:, 2]) > 0.01
    assert_same(parts, whole)


def test_what_lies_on_a_floor_comes_back_from_a_file(lying, tmp_path):
    rodjax.save(lying, tmp_path / "lying.vtkhdf")
    loaded = rodjax.load(tmp_path / "lying.vtkhdf")
    assert isinstance(loaded, rodjax.HarnessEquilibrium)
    assert jnp.array_equal(loaded.end_pressures, lying.end_pressures)
    assert rodjax.solve(loaded.harness, segments=4, guess=loaded, solver=Newton(tolerance=1e-10)).iterations == 0


@pytest.mark.slow
def test_derivatives_of_a_cut_rod_on_a_floor_are_those_of_the_rod(lying):
    whole = rodjax.solve(Scene(plain(1.0), START, END, GRAVITY, obstacles=[FLOOR]), segments=8, solver=TIGHT)

    def changed(numbers):
        floor = Plane(jnp.stack([0 * numbers[0], 0 * numbers[0], -0.05 + numbers[0]]), (0, 0, 1))
        return floor, Clamp(jnp.stack([0.85 + 0 * numbers[0], 0.02 + numbers[1], 0 * numbers[0]]), END.frame)

    def of_whole(numbers):
        floor, end = changed(numbers)
        scene = Scene(plain(1.0), START, end, GRAVITY, obstacles=[floor])
        found = rodjax.solve(scene, segments=8, solver=TIGHT, guess=whole)
        return jnp.concatenate([found.end_force, found.nodes[4]])

    def of_parts(numbers):
        floor, end = changed(numbers)
        found = rodjax.solve(cut(plain, end, obstacles=[floor]), segments=4, solver=TIGHT, guess=lying)
        return jnp.concatenate([found["b"].end_force, found["b"].nodes[0]])

    direction = jnp.array([1.0, 0.5])
    expected, found = (jax.jvp(of, (jnp.zeros(2),), (direction,))[1] for of in (of_whole, of_parts))
    # Contacts of a linearised system are rigid to about 1e-10.
    assert jnp.max(jnp.abs(found - expected)) < 1e-7 * jnp.max(jnp.abs(expected))
    assert abs(expected[5] - 1.0) < 1e-6  # the middle goes with the floor


def star(floor: Plane) -> Harness:
    """Three branches of 40 cm from a hub of 20 g; one of them hangs down to a floor."""
    cables = {}
    for k, (x, y, z, length) in enumerate([(0.3, 0.05, 0.1, 0.4), (-0.1, 0.3, 0.1, 0.4), (-0.15, -0.3, -0.1, 0.55)]):
        outwards = rodjax.frame((x, y, 0), (0, 0, 1))
        end = Clamp((x, y, z), outwards)
        near = [floor] if k == 2 else []
        cables[f"branch {k}"] = Scene(plain(length), Joint("hub", outwards), end, GRAVITY, obstacles=near)
    return Harness(cables, {"hub": rodjax.Body(mass=0.02)})


@pytest.mark.slow
def test_a_star_with_a_branch_on_a_floor_is_in_balance():
    result = rodjax.solve(star(Plane((0, 0, -0.15), (0, 0, 1))), segments=12, solver=Newton(tolerance=1e-10))
    assert result.stable
    assert result["branch 2"].contact_forces[:, 2].sum() > 1e-3
    total = sum(cable.end_force for cable in result.values()) + jnp.sum(result["branch 2"].contact_forces, axis=0)
    rods = [cable.scene.rod for cable in result.values()]
    weight = sum(rod.length * rod.mean_mass_per_length for rod in rods) + 0.02
    assert jnp.max(jnp.abs(total + weight * jnp.array(GRAVITY))) < 1e-9
    force = sum(cable.start_force for cable in result.values()) + 0.02 * jnp.array(GRAVITY)
    moment = sum(cable.start_moment for cable in result.values())
    assert jnp.max(jnp.abs(force)) < 1e-9
    assert jnp.max(jnp.abs(moment)) < 1e-9
    # No node is deeper than the rod is thick, and what lies above the floor is not pushed.
    gaps = result["branch 2"].nodes[:, 2] + 0.15 - 0.005
    assert jnp.min(gaps) > -1e-9
    assert jnp.max(jnp.where(gaps > 1e-3, jnp.abs(result["branch 2"].contact_forces[:, 2]), 0.0)) < 1e-9


@pytest.mark.slow
def test_a_cut_rod_slides_through_a_clip_over_a_pipe_on_a_floor():
    """The stiffness is not symmetric, and contacts are sought along a line even so. In whole steps alone they came in
    turn, were never found, and pushed out of all proportion, until no better point was found.
    """
    floor, pipe = Plane((0, 0, -0.056), (0, 0, 1)), rodjax.Cylinder((0.645, 0, -0.056), (0, 1, 0), 0.025)
    clip, end = rodjax.Clip(0.171, (0.154, -0.003, 0.025), sliding=True), Clamp((0.858, 0.02, 0), ALONG)
    around = {"obstacles": [floor, pipe]}
    first = Scene(plain(0.5), START, Joint("cut"), GRAVITY, clips=[clip], **around)
    second = Scene(plain(0.5), Joint("cut"), end, GRAVITY, **around)
    parts = rodjax.solve(Harness({"a": first, "b": second}), segments=16)
    assert parts.converged
    assert parts.stable
    assert int(parts.iterations) <= 27  # 18 seen
    # To the tolerance, in units of forces of 2 N at most.
    carried = sum(jnp.sum(rod.contact_forces, axis=0) for rod in parts.values()) + parts.joints["cut"].contact_force
    carried += parts["a"].clip_forces[0] + parts["b"].end_force - parts["a"].start_force
    weight = 9.81 * sum(float(scene.rod.mass_per_length * scene.rod.length) for scene in (first, second))
    np.testing.assert_allclose(carried, [0, 0, weight], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_joint_that_is_held_may_lie_within_an_obstacle():
    """As an end of a scene may: a connector on a wall."""
    body = rodjax.Body(support=rodjax.Pin((0.4, 0.0, -0.052)))
    joint = Joint("cut", ALONG)
    cables = {
        "a": Scene(plain(0.5), START, joint, GRAVITY, obstacles=[FLOOR]),
        "b": Scene(plain(0.5), joint, END, GRAVITY, obstacles=[FLOOR]),
    }
    result = rodjax.solve(Harness(cables, {"cut": body}), segments=4)
    assert result.converged
    assert jnp.all(result.joints["cut"].contact_force == 0)


@pytest.mark.slow
def test_sensitivities_of_a_harness_are_its_derivatives(lying):
    names = {"of": ["cables.b.end_force", "joints.cut.position", "energy"], "wrt": ["cables.a.rod.EI"]}
    table = rodjax.sensitivities(lying.harness, **names, segments=4, solver=TIGHT, guess=lying)
    assert {name: list(row) for name, row in table.items()} == dict.fromkeys(names["of"], names["wrt"])

    def height(EI):
        harness = eqx.tree_at(lambda harness: harness.scenes[0].rod.EI, lying.harness, EI)
        return rodjax.solve(harness, segments=4, solver=TIGHT, guess=lying)["b"].end_force

    at = lying.harness["a"].rod.EI
    expected = jax.jacfwd(height)(at)
    np.testing.assert_allclose(table["cables.b.end_force"]["cables.a.rod.EI"], expected, rtol=1e-9)


def test_the_slope_of_a_step_is_the_rate_of_the_energy(monkeypatch):
    """Of rods with positions of nodes, whose ends move with a body, under the new forces of the step. A slope that is
    another one is no number here, with which no step is taken.
    """
    known = assembly_step._slopes

    def checked(whole, all_here, steps, gradient):
        def energy(part):
            found = jnp.zeros_like(part)
            for group, here, step, of_ends in zip(whole.groups, all_here, steps.rods, steps.ends, strict=True):
                value = jax.vmap(lambda step, rod, of_ends: step.value(rod, part * of_ends, part)[0])
                found += jnp.sum(whole.shares(group) * value(step, here.rods, of_ends))
            return found

        slope, rate = known(whole, all_here, steps, gradient)
        # The body has no weight and no spring, so that all energy is that of the rods; the same terms summed in
        # another order, of a slope of 20 at first.
        expected = jax.grad(energy)(jnp.zeros_like(slope))
        is_same = jnp.abs(slope - expected) <= 1e-9 * jnp.abs(expected) + 2e-11
        return jnp.where(is_same, slope, jnp.nan), rate

    monkeypatch.setattr(assembly_step, "_slopes", checked)
    result = rodjax.solve(cut(plain, obstacles=[FLOOR]), segments=5, solver=TIGHT)
    assert result.converged
    assert result.iterations > 3


# --- friction --------------------------------------------------------------------------------------------------------

ROUGH = Plane((0, 0, -0.005), (0, 0, 1), friction=0.3)
DRAWN = [(0.0, 0.0), (-0.02, 0.0), (-0.03, 0.05), (0.0, 0.06)]  # where the upper end is


def lowered(x, y) -> tuple[Scene, Harness]:
    """A cable that hangs down to a rough floor, and the same with a joint above that."""

    def rod(length: float) -> Rod:
        return Rod(length, 0.01, 0.008, 100.0, 0.1, radius=0.005)

    start, joint, gravity = Clamp((x, y, 0.42), rodjax.frame((1, 0, -2))), Joint("cut", **ASIDE), (0, 0, -10.0)
    hanging = Scene(rod(0.5), start, joint, gravity)
    lying = Scene(rod(0.5), joint, Free(), gravity, obstacles=[ROUGH])
    return Scene(rod(1.0), start, Free(), gravity, obstacles=[ROUGH]), Harness({"a": hanging, "b": lying})


@pytest.fixture(scope="module")
def drawn() -> rodjax.HarnessEquilibrium:
    return rodjax.solve_path([lowered(*place)[1] for place in DRAWN], segments=8, solver=TIGHT)


def test_a_cut_rod_sticks_and_slips_as_the_rod(drawn):
    whole = rodjax.solve_path([lowered(*place)[0] for place in DRAWN], segments=16, solver=TIGHT)
    assert np.all(drawn.converged)
    nodes = jnp.concatenate([drawn["a"].nodes, drawn["b"].nodes[:, 1:]], axis=1)
    # Residuals of 1e-11 EI/L^2.
    np.testing.assert_allclose(nodes, whole.nodes, rtol=0, atol=1e-11)
    np.testing.assert_allclose(drawn["b"].friction_forces, whole.friction_forces[:, :, 8:], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(drawn["b"].contact_states, whole.contact_states[:, :, 8:])
    # From rest without friction; then some stick and others slip.
    assert not np.any(drawn["b"].friction_forces[0])
    assert {0, 1, 2} <= set(np.ravel(drawn["b"].contact_states[1:]).tolist())


def test_slips_are_counted_from_the_guess_and_come_back_from_a_file(drawn, tmp_path):
    last = jax.tree.map(lambda leaf: leaf[2], drawn)
    rodjax.save(last, tmp_path / "drawn.vtkhdf")
    harness = lowered(*DRAWN[3])[1]
    for guess in (last, rodjax.load(tmp_path / "drawn.vtkhdf")):
        found = rodjax.solve(harness, segments=8, solver=TIGHT, guess=guess)
        np.testing.assert_allclose(found["b"].friction_forces, drawn["b"].friction_forces[3], rtol=0, atol=1e-10)
    batch = rodjax.solve_batch([harness, harness], segments=8, solver=TIGHT, guess=last)
    np.testing.assert_allclose(batch["b"].friction_forces[1], drawn["b"].friction_forces[3], rtol=0, atol=1e-10)


def test_obstacles_with_friction_stay_along_paths():
    harness = lowered(0.0, 0.0)[1]
    raised = eqx.tree_at(lambda harness: harness.scenes[1].obstacles[0].point, harness, jnp.array([0.0, 0.0, 0.01]))
    with pytest.raises(ValueError, match=r"cables\['b'\]\.obstacles\[0\] must stay the same along a path"):
        rodjax.solve_path([harness, raised])


@pytest.mark.parametrize(
    "take",
    [
        lambda result: rodjax.route(result.harness, []),
        lambda result: rodjax.tolerances(result, []),
        lambda result: rodjax.Experiment(result.harness, []),
    ],
)
def test_what_is_no_path_refuses_friction(drawn, take):
    with pytest.raises(ValueError, match=r"cables\['b'\]\.obstacles\[0\]\.friction must be 0 in .* along a path only"):
        take(jax.tree.map(lambda leaf: leaf[2], drawn))


@pytest.mark.slow
def test_a_finer_mesh_has_the_memory_of_the_step(drawn):
    """Slips are counted from the guess, not from the equilibrium on the coarse mesh, where nothing would be drawn."""
    last = jax.tree.map(lambda leaf: leaf[2], drawn)
    finer = rodjax.solve(lowered(*DRAWN[3])[1], rtol=1e-3, guess=last)
    assert finer.segments != [8, 8]
    found, coarse = (result.sum(1)[0] for result in (finer["b"].friction_forces, drawn["b"].friction_forces[3]))
    # A node sticks or slips as a whole: of nine that lie, one more or less.
    np.testing.assert_allclose(found, coarse, rtol=0, atol=0.15 * float(jnp.linalg.norm(coarse)))


@pytest.mark.slow
def test_derivatives_with_friction_are_those_of_a_step(drawn):
    last = jax.tree.map(lambda leaf: leaf[1], drawn)

    def pulled(x):
        found = rodjax.solve(lowered(x, jnp.array(0.05))[1], segments=8, solver=TIGHT, guess=last)
        return jnp.stack(
            [found["a"].start_force[0], found["b"].nodes[-1, 1], found["b"].friction_forces[0, :, 1].sum()]
        )

    x, step = jnp.array(-0.03), 1e-6
    _, change = jax.jvp(pulled, (x,), (jnp.array(1.0),))
    differences = (pulled(x + step) - pulled(x - step)) / (2 * step)
    # Differences of results that are off by 1e-11, over a step of 1e-6.
    np.testing.assert_allclose(change, differences, rtol=1e-5, atol=1e-5)
