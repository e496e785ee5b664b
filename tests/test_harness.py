"""Harnesses: rods that meet in rigid bodies, against the uncut rod, an independent code and finite differences."""

import math
import re
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_frames import PlanarRod, solve_frame

import rodjax
from rodjax import Body, Clamp, Free, Harness, Joint, Newton, Pin, Plane, Rod, Scene, Slider, Spring, plot
from rodjax.paths import harness_path
from rodjax.solving import result_warnings
from rodjax.solving.first_poses import first_poses

GRAVITY = (0.0, 3.0, -9.81)
START = Clamp((0, 0, 0), rodjax.frame((1, 0, -1)))
END = Clamp((0.5, 0.2, 0), rodjax.frame((1, 1, 1)))
# A body whose axes are not those of the rod, beside it.
ASIDE = {"frame": rodjax.frame((0, 1, 0), (0, 0, 1)), "offset": (0.1, 0, 0.02)}


def plain(length: float) -> Rod:
    return Rod.circular(length, 0.005, 1e7, shear_modulus=1e7 / 3, density=1200.0)


def bent(length: float) -> Rod:
    rod = plain(length)
    stiffnesses = (rod.EI, 1.5 * rod.EI), rod.GJ, rod.EA
    shape = {"rest_curvature": (1.0, 0.5), "rest_twist": 0.3}
    return Rod(length, *stiffnesses, rod.mass_per_length, radius=0.005, **shape)


def cut(rod, end=END) -> Harness:
    first = Scene(rod(0.5), START, Joint("cut", **ASIDE), gravity=GRAVITY)
    return Harness({"a": first, "b": Scene(rod(0.5), Joint("cut", **ASIDE), end, gravity=GRAVITY)})


@pytest.fixture(scope="module", params=[plain, bent])
def both(request):
    """A rod, and the same cut in two and joined."""
    tight = Newton(tolerance=1e-11)
    whole = rodjax.solve(Scene(request.param(1.0), START, END, gravity=GRAVITY), segments=8, solver=tight)
    return whole, rodjax.solve(cut(request.param), segments=4, solver=tight)


def test_a_rod_that_is_cut_and_joined_is_the_rod(both):
    whole, parts = both
    assert parts.stable
    assert (parts.index, len(parts)) == (0, 2)
    nodes = jnp.concatenate([parts["a"].nodes, parts["b"].nodes[1:]])
    assert jnp.max(jnp.abs(nodes - whole.nodes)) < 1e-9
    assert jnp.max(jnp.abs(parts["a"].start_force - whole.start_force)) < 1e-9
    assert jnp.max(jnp.abs(parts["b"].end_moment - whole.end_moment)) < 1e-9
    assert abs(parts.energy - whole.energy) < 1e-9 * abs(whole.energy)
    assert abs(parts["a"].total_twist + parts["b"].total_twist - whole.total_twist) < 1e-9
    body = parts.joints["cut"]
    assert jnp.max(jnp.abs(body.position + body.frame @ jnp.array(ASIDE["offset"]) - whole.nodes[4])) < 1e-9


def test_a_harness_is_a_mapping_of_its_rods(both):
    _, parts = both
    assert parts.names == tuple(parts) == parts.keys() == ("a", "b")
    assert [rod.energy for rod in parts.values()] == [rod.energy for _, rod in parts.items()]
    with pytest.raises(KeyError, match="no rod 'c' in this harness: its rods are 'a', 'b'"):
        parts["c"]
    assert rodjax.describe(parts).count("\n") == 2


def test_a_warm_start_of_the_same_harness_takes_no_step(both):
    _, parts = both
    again = rodjax.solve(parts.harness, segments=4, guess=parts, solver=Newton(tolerance=1e-10))
    assert again.iterations == 0
    assert jnp.max(jnp.abs(again["b"].nodes - parts["b"].nodes)) < 1e-14


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_cables_and_joints_begin_with_the_shapes_that_are_given(side):
    """A rod between clamps that are nearer to one another than it is long stays on the side of its first shape."""
    across = rodjax.frame((1, 0, 0), (0, 1, 0))
    ends = Clamp((0, 0, 0), across), Clamp((0.8, 0, 0), across)
    x = np.linspace(0, 0.8, 33)
    arc = np.stack([x, np.zeros(33), side * 0.25 * np.sin(np.pi * x / 0.8) ** 2], axis=1)
    whole = rodjax.solve(Scene(plain(1.0), *ends), segments=8, guess=rodjax.Guess(arc))
    joint = Joint("cut", **ASIDE)
    parts = Harness({"a": Scene(plain(0.5), ends[0], joint), "b": Scene(plain(0.5), joint, ends[1])})
    shapes = {"a": rodjax.Guess(arc[:17]), "b": rodjax.Guess(arc[16:])}
    poses = first_poses(parts, (shapes["a"], None))
    np.testing.assert_allclose(poses.positions[0] + poses.frames[0] @ np.array(ASIDE["offset"]), arc[16], atol=1e-15)
    edge = arc[16] - arc[15]
    np.testing.assert_allclose(poses.frames[0] @ ASIDE["frame"][:, 2], edge / np.linalg.norm(edge), atol=1e-3)
    found = rodjax.solve(parts, segments=4, guess=shapes)
    assert found.stable
    assert float(found.energy) == pytest.approx(float(whole.energy), rel=1e-9)
    # About the line between the clamps the rod may be turned at no cost.
    assert side * found["b"].nodes[0, 2] > 0.25
    # The joint begins where the shape ends, turned as the shape: all else follows.
    one = rodjax.solve(parts, segments=4, guess={"a": shapes["a"]})
    assert side * one["b"].nodes[0, 2] > 0.25


@pytest.mark.parametrize("obstacles", [[], [Plane((0, 0, -0.35), (0, 0, 1))]], ids=["in space", "on a floor"])
def test_a_dead_moment_on_a_joint_is_that_on_a_free_end(obstacles):
    """4 EI/L about an axis along nothing."""
    rod, tight = bent(1.0), Newton(tolerance=1e-10)
    moment = 4 * rod.EI[0] / rod.length * np.array([0.2, -0.6, 0.7])
    scenes = [Scene(rod, START, end, GRAVITY, obstacles=obstacles) for end in (Free(moment=moment), Joint("tip"))]
    whole = rodjax.solve(scenes[0], segments=12, solver=tight)
    tip = rodjax.solve(Harness({"a": scenes[1]}, {"tip": Body(moment=moment)}), segments=12, solver=tight)
    assert tip.converged
    assert not tip.stable
    assert jnp.max(jnp.abs(tip["a"].nodes - whole.nodes)) < 1e-8
    # By steps of the symmetric part alone 64 and 34.
    assert tip.iterations < 25
    assert bool(obstacles) == bool(jnp.any(jnp.linalg.norm(whole.contact_forces, axis=-1) > 1e-3))


def test_derivatives_of_a_cut_rod_are_those_of_the_rod():
    solver = Newton(tolerance=1e-11)

    def of_whole(y):
        end = Clamp(jnp.stack([0.5 + 0 * y, y, 0 * y]), END.frame)
        return rodjax.solve(Scene(plain(1.0), START, end, gravity=GRAVITY), segments=8, solver=solver).end_force

    def of_parts(y):
        end = Clamp(jnp.stack([0.5 + 0 * y, y, 0 * y]), END.frame)
        return rodjax.solve(cut(plain, end), segments=4, solver=solver)["b"].end_force

    at = jnp.array(0.2)
    expected, found = jax.jacfwd(of_whole)(at), jax.jacfwd(of_parts)(at)
    assert jnp.max(jnp.abs(found - expected)) < 1e-9 * jnp.max(jnp.abs(expected))


# --- a star of three cables ------------------------------------------------------------------------------------------

# Places and angles of the tangents at the clamps, and angles in the body, in which all cables end.
ANCHORS = ((-0.4, 0.3, -1.14), (0.5, 0.2, math.pi + 0.78), (0.05, -0.45, 1.38))
ANGLES = (-0.24, math.pi + 0.38, 1.88)
LENGTHS = (0.505, 0.544, 0.457)  # a little taut, so that they stay in their plane
LOAD = (0.02, -0.05, 0.001)


def planar(angle):
    """The frame of this tangent in the plane of x and z, d2 along -y, about which angles from x to z are positive."""
    return rodjax.frame((math.cos(angle), 0.0, math.sin(angle)), (0.0, -1.0, 0.0))


def star(load=LOAD, mass=0.0, offset=(0.0, 0.0, 0.0), stiffer=1.0, gravity=None) -> Harness:
    cables = {}
    for k, ((x, z, angle), own, length) in enumerate(zip(ANCHORS, ANGLES, LENGTHS, strict=True)):
        rod = plain(length)
        rod = Rod(length, (1.0 + 0.2 * k) * stiffer * rod.EI, rod.GJ, rod.EA, rod.mass_per_length)
        end = Joint("hub", planar(own), offset if k == 1 else (0.0, 0.0, 0.0))
        cables[f"cable {k}"] = Scene(rod, Clamp((x, 0.0, z), planar(angle)), end, gravity=gravity)
    # The axis of a positive moment from x to z is -y.
    return Harness(cables, {"hub": Body((load[0], 0.0, load[1]), (0.0, -load[2], 0.0), mass)})


@pytest.fixture(scope="module")
def solved():
    return rodjax.solve(star(), segments=32)


def test_a_star_is_in_balance(solved):
    force = sum(-cable.end_force for cable in solved.values())
    moment = sum(-cable.end_moment for cable in solved.values())
    assert jnp.max(jnp.abs(force + jnp.array([LOAD[0], 0.0, LOAD[1]]))) < 1e-9
    assert jnp.max(jnp.abs(moment - jnp.array([0.0, LOAD[2], 0.0]))) < 1e-9


def test_a_star_is_that_of_an_independent_code(solved):
    rods = []
    for anchor, own, cable in zip(ANCHORS, ANGLES, solved.values(), strict=True):
        rod = cable.scene.rod
        rods.append(PlanarRod(float(rod.length), float(rod.EI), float(rod.EA), anchor, ("hub", own)))
    assert max(jnp.max(jnp.abs(cable.nodes[:, 1])) for cable in solved.values()) < 1e-9
    body = solved.joints["hub"]
    angle = math.atan2(body.frame[2, 0], body.frame[0, 0])
    forces = [(c.start_force[0], c.start_force[2], -c.start_moment[1]) for c in solved.values()]
    # From a guess that differs in the third digit.
    poses = {"hub": np.array([body.position[0], body.position[2], angle]) + 1e-3}
    joints, begins = solve_frame(rods, {"hub": LOAD}, np.array(forces) * 1.001, poses)
    # The error of 32 elements, of fourth order.
    assert abs(joints["hub"][:2] - body.position[jnp.array([0, 2])]).max() < 1e-7
    assert abs(joints["hub"][2] - angle) < 1e-6
    for cable, begin in zip(solved.values(), begins, strict=True):
        largest = np.max(np.abs(begin[3:5]))
        # Near their ends taut cables bend within a few elements: estimated are 1e-5 of the largest force.
        assert abs(begin[3] - cable.start_force[0]) < 3e-5 * largest
        assert abs(begin[4] - cable.start_force[2]) < 3e-5 * largest


def test_rtol_chooses_the_mesh_of_each_cable(solved):
    """The error that is estimated for each cable by itself bounds that of the star."""
    coarse = rodjax.solve(star(), rtol=1e-4)
    assert coarse.converged
    fine = solved.joints["hub"].position
    assert jnp.max(jnp.abs(coarse.joints["hub"].position - fine)) < 1e-4 * max(LENGTHS)


@pytest.mark.slow
def test_derivatives_of_a_star_are_those_of_finite_differences():
    names = ("load", "mass", "offset", "stiffer")
    numbers = (jnp.array(LOAD), jnp.array(0.01), jnp.array([0.01, 0.0, 0.02]), jnp.array(1.1))

    def height(numbers):
        harness = star(**dict(zip(names, numbers, strict=True)), gravity=(0.0, 0.0, -9.81))
        found = rodjax.solve(harness, segments=8, solver=Newton(tolerance=1e-11))
        return found.joints["hub"].position[2] + found["cable 1"].start_force[0] + found["cable 0"].nodes[4, 0]

    gradient = jax.grad(height)(numbers)
    generic = jax.tree.map(lambda x: np.cos(1.0 + np.arange(x.size)).reshape(x.shape) * (0.1 + jnp.abs(x)), numbers)
    step = 1e-5
    ahead, behind = (
        height(jax.tree.map(lambda x, d, sign=sign: x + sign * step * d, numbers, generic)) for sign in (1, -1)
    )
    slope = sum(jnp.sum(g * d) for g, d in zip(gradient, generic, strict=True))
    # Of central differences: the third derivative times 1e-10 / 6, and rounding.
    assert abs(slope - (ahead - behind) / (2 * step)) < 1e-6 * abs(slope)


def test_a_path_carries_turns_and_leaves_no_step_coarse():
    """The end of a joined rod turned by 1.5 turns in steps of 54 degrees: the twist of both parts follows."""

    def turned(angle: float) -> Harness:
        end = Clamp((0.9, 0, 0), rodjax.rotate(rodjax.frame((1, 0, 0)), (angle, 0, 0)))
        straight = Joint("cut", rodjax.frame((1, 0, 0)))
        first = Scene(plain(0.5), Clamp((0, 0, 0), rodjax.frame((1, 0, 0))), straight, gravity=GRAVITY)
        return Harness({"a": first, "b": Scene(plain(0.5), straight, end, gravity=GRAVITY)})

    path = rodjax.solve_path([turned(0.3 * k * math.pi) for k in range(11)], rtol=1e-3)
    assert path.energy.shape == (11,)
    assert jnp.all(path.converged)
    twist = path["a"].total_twist + path["b"].total_twist
    # The curved rod writhes a little too.
    assert jnp.all(jnp.diff(twist) > 0.5)
    assert abs(twist[-1] - 3 * math.pi) < 1.5
    assert max(jnp.max(rod.error_estimate) for rod in path.values()) < 1e-3
    assert path.joints["cut"].position.shape == (11, 3)


RODS = "got a HarnessEquilibrium: take one of its rods, result[name], or all of them, result.items()"


def pulled(load: float) -> Harness:
    """A rod in two parts, the end of the second on a spring."""
    straight = rodjax.frame((1, 0, 0))
    first = Scene(plain(0.5), Clamp((0, 0, 0), straight), Joint("cut", straight), gravity=GRAVITY)
    second = Scene(plain(0.5), Joint("cut", straight), Joint("end", straight), gravity=GRAVITY)
    soft = Spring(Clamp((0.9, 0.1 * load, 0), np.eye(3)), 40.0, 1.0)
    return Harness({"a": first, "b": second}, {"end": Body((0, load, 0), support=soft)})


def test_a_batch_of_harnesses_is_each_of_them(monkeypatch):
    loads, names, solve = [0.0, 0.5, 0.25, 0.75, 1.0], set(), harness_path.solve_harness

    def watched(*arguments, **options):
        names.add(threading.current_thread().name)
        time.sleep(0.05)  # so that no thread does all
        return solve(*arguments, **options)

    monkeypatch.setattr(harness_path, "solve_harness", watched)
    batch = rodjax.solve_batch([pulled(load) for load in loads], segments=4, threads=2)
    assert len(names) == 3  # the first begins
    assert jnp.all(batch.converged)
    for k, load in enumerate(loads):
        one = rodjax.solve(pulled(load), segments=4)
        # Bit by bit: the same program from the same start.
        assert np.array_equal(batch["b"].nodes[k], one["b"].nodes)
        assert batch.joints["cut"].position[k, 1] == one.joints["cut"].position[1]


def test_of_a_batch_each_harness_that_did_not_converge_is_told():
    first = rodjax.solve(pulled(0.0), segments=4)
    harnesses = [pulled(load) for load in (0.0, 3.0, 4.0)]
    with pytest.warns(rodjax.NotConvergedWarning) as told:
        batch = rodjax.solve_batch(harnesses, segments=4, guess=first, solver=Newton(max_iterations=4), threads=2)
    assert batch.converged.tolist() == [True, False, False]
    assert len(told) == 2


def test_the_cable_whose_mesh_is_too_coarse_is_named(monkeypatch):
    """The one that bends most along an element, beside the other where the bound lies between both."""
    found = rodjax.solve(pulled(3.0), segments=4)
    turns = {name: float(jnp.max(found[name].curvature)) * 0.125 for name in found}
    assert turns["a"] != turns["b"]
    most = max(turns, key=lambda name: turns[name])
    monkeypatch.setitem(result_warnings.MOST_TURN, "hermite", sum(turns.values()) / 2)
    with pytest.warns(rodjax.MeshWarning) as told:
        rodjax.solve(pulled(3.0), segments=4)
    assert len(told) == 1
    assert str(told[0].message).startswith(f"the mesh of 4 segments is too coarse for cable {most!r}: the rod turns by")


def test_steps_of_a_path_that_fail_are_halved():
    """With few iterations a large step fails at once, and not by way of harnesses between."""
    impatient = Newton(max_iterations=4)
    first = rodjax.solve(pulled(0.0), segments=4)
    with pytest.warns(rodjax.NotConvergedWarning):
        assert not rodjax.solve(pulled(3.0), segments=4, guess=first, solver=impatient).converged
    path = rodjax.solve_path([pulled(0.0), pulled(3.0)], segments=4, guess=first, solver=impatient)
    assert jnp.all(path.converged)
    assert path["a"].substeps[0] == 1
    assert path["a"].substeps[1] > 2
    expected = rodjax.solve(pulled(3.0), segments=4, guess=first)
    # Both to the tolerance of 1e-8 EI/L^2.
    assert jnp.max(jnp.abs(path["b"].nodes[1] - expected["b"].nodes)) < 1e-7


def test_the_support_of_a_cut_rod_feels_the_stiffness_of_the_rod():
    tight = Newton(tolerance=1e-11)
    expected = rodjax.end_stiffness(Scene(plain(1.0), START, END, gravity=GRAVITY), segments=8, solver=tight)
    found = rodjax.end_stiffness(cut(plain), "b", segments=4, solver=tight)
    # Derivatives of equilibria with residuals of 1e-11.
    assert jnp.max(jnp.abs(found - expected)) < 1e-8 * jnp.max(jnp.abs(expected))
    assert jnp.max(jnp.abs(found - found.T)) < 1e-8 * jnp.max(jnp.abs(expected))


def test_the_softest_motion_of_a_cut_rod_is_that_of_the_rod(both):
    whole, parts = both
    expected, found = rodjax.lowest_mode(whole), rodjax.lowest_mode(parts)
    # Inverse iteration from 1e-4 below gains some eight digits of the eigenvalue.
    assert found.stiffness == pytest.approx(float(expected.stiffness), rel=1e-8)
    moved = jnp.concatenate([found.displacements["a"], found.displacements["b"][1:]])
    sign = jnp.sign(jnp.sum(moved * expected.displacement))
    assert jnp.max(jnp.abs(sign * moved - expected.displacement)) < 1e-4


def test_a_report_of_a_harness_is_of_all_its_cables(both, tmp_path):
    _, parts = both
    report = rodjax.report(parts, limits=rodjax.Limits(end_force=1e3), title="Two parts")
    assert report.kept
    assert [cable.name for cable in report.cables] == ["a", "b"]
    assert {name.split(":")[0] for name in report.margins} == {"a", "b"}
    assert {"report.png", "report.html"} <= {path.name for path in report.save(tmp_path)}


@pytest.mark.parametrize(
    ("take", "message"),
    [
        (lambda parts: plot.plot_rod(parts), RODS),
        (
            lambda parts: rodjax.sensitivities(parts.harness, of=["nodes"], wrt=["gravity"]),
            "real fields of this harness",
        ),
        (lambda parts: rodjax.solve_batch([[parts.harness]]), "is a Harness: rodjax.solve_path and solve_batch take"),
        (lambda parts: rodjax.end_stiffness(parts.harness), "cable must be one of 'a', 'b', got None"),
        (lambda parts: rodjax.end_stiffness(parts.harness, "a"), "scene['a'].end must be a Clamp"),
    ],
)
def test_what_takes_no_harness_says_what_to_do(both, take, message):
    _, parts = both
    with pytest.raises((TypeError, ValueError), match=re.escape(message)) as error:
        take(parts)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Harness({"a": PART}, {"other": Body()}), "joints['other'] has no rod: the ends of the cables name"),
        (lambda: Harness({"a": PART}, contact=True), "contact must be False"),
        (lambda: Harness({"a": Scene(plain(1.0), START, END)}), "a harness must have an end that is a Joint"),
        (lambda: Harness({"a": HANGING}), "nothing holds the rods at the joint 'j'"),
        (lambda: Harness({"a": PART}, {"cut": Body(mass=1.0)}), "joints['cut'].mass needs a rod with gravity"),
        (lambda: rodjax.solve(PART), "scene.end is a Joint: make a Harness of the scene"),
        (lambda: rodjax.solve(Harness({"a": PART}), planar=True), "planar must be False"),
        (lambda: rodjax.solve(Harness({"a": PART}), guess={"b": SHAPE}), "guess names the cable 'b', allowed are 'a'"),
        (lambda: rodjax.solve(Harness({"a": PART}), discretization="finite_difference"), "must be 'hermite'"),
        (lambda: rodjax.solve_path([SOFT, SOFT]), "an end that is a Spring has an unknown pose"),
        (lambda: rodjax.solve_batch([SOFT, SOFT]), "an end that is a Spring has an unknown pose"),
        (lambda: rodjax.write_scene(PART, "part.toml"), "scene.end is a Joint: make a Harness of the scene and write"),
        (lambda: rodjax.write_scene(STIFF, "soft.toml"), "rotation of a Spring must be a number to be written"),
        (lambda: Spring(Pin((0, 0, 0)), rotation=1.0), "rotation must be None on a Pin without a frame"),
        (lambda: Slider((0, 0, 0), [(1, 0, 0), (2, 0, 0)]), "directions must not be parallel"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(make, message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        make()
    assert "\n" not in str(error.value)


SHAPE = rodjax.Guess([(0, 0, 0), (0.5, 0, 0)])
PART = Scene(plain(0.5), START, Joint("cut"))
HANGING = Scene(plain(0.5), Free(), Joint("j"), gravity=GRAVITY)
SOFT = Scene(plain(1.0), START, Spring(END, rotation=1.0), gravity=GRAVITY)
STIFF = Scene(plain(1.0), START, Spring(END, rotation=np.eye(3)), gravity=GRAVITY)
