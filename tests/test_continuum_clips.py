"""Clips in the continuum: beside meshes, continuous beams, rods of one span, statics and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from test_clips import LEVEL, ORIGIN, TIGHT, axial_forces, in_space, supported, three_moments, weight

import rodjax as rj
from rodjax import Clamp, Clip, Free, Pin, Rod, Scene, Swivel, frame, problems, rotate

# Thick rods bent within short spans: strains up to 0.2, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::rodjax.OverstretchedWarning")

# Stations, supports and clips are met to 1e-10; what is tested here goes on to the last Newton step, far below.
RESIDUAL = 1e-10
FIELDS = ("clip_forces", "clip_moments", "start_force", "start_moment", "end_force", "end_moment", "energy")


@pytest.fixture(scope="module")
def held() -> tuple[Scene, rj.Equilibrium, rj.Equilibrium]:
    """A rod in space through a clip that holds its direction and one that does not: on a mesh and without one."""
    scene = in_space((1.0, 0.3, 0.4))
    on_mesh = rj.solve(scene, segments=32, solver=TIGHT)
    return scene, on_mesh, rj.solve_continuum(scene, on_mesh)


def test_the_mesh_converges_to_it(held):
    scene, on_mesh, truth = held
    assert truth.converged
    assert truth.residual < RESIDUAL
    coarse = rj.solve(scene, segments=16, solver=TIGHT)
    for name in (*FIELDS, "elastic_energy", "total_twist"):
        exact = getattr(truth, name)
        errors = [float(np.max(np.abs(getattr(result, name) - exact))) for result in (coarse, on_mesh)]
        # Of fourth order; errors of the next are some per cent of these.
        assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3), name
    error = float(np.max(np.linalg.norm(on_mesh.nodes - truth.nodes, axis=1)))
    np.testing.assert_allclose(on_mesh.error_estimate, error, rtol=0.1)


def test_clips_hold_what_they_say_and_carry_the_rod(held):
    scene, _, truth = held
    force = float(np.max(np.abs(truth.clip_forces)))
    np.testing.assert_allclose(supported(truth), -weight(scene), rtol=0, atol=1e-9 * np.linalg.norm(weight(scene)))
    for clip, moment in zip(scene.clips, truth.clip_moments, strict=True):
        node = int(np.argmin(np.abs(truth.s - clip.at)))
        assert truth.s[node] == clip.at
        np.testing.assert_allclose(truth.nodes[node], clip.position, atol=RESIDUAL)
        if clip.tangent is None:
            np.testing.assert_array_equal(moment, 0.0)
        else:
            np.testing.assert_allclose(truth.tangents[node], clip.tangent, atol=RESIDUAL)
            np.testing.assert_allclose(jnp.sum(moment * clip.tangent), 0.0, atol=RESIDUAL * force)
    # About the origin the moments of all that acts on the rod sum to nothing. The mean height of the nodes, by
    # Simpson's rule on pairs of the 8 + 12 + 12 segments between clips, is what is not exact: of fourth order.
    moments = np.cross(truth.nodes[-1], truth.end_force) + np.asarray(truth.end_moment)
    moments -= np.cross(truth.nodes[0], truth.start_force) + np.asarray(truth.start_moment)
    for clip, by_clip, moment in zip(scene.clips, truth.clip_forces, truth.clip_moments, strict=True):
        moments += np.cross(clip.position, by_clip) + np.asarray(moment)
    h, y = np.diff(truth.s)[::2], np.asarray(truth.nodes)
    mean = np.sum(h[:, None] / 3 * (y[:-2:2] + 4 * y[1:-1:2] + y[2::2]), axis=0)
    np.testing.assert_allclose(moments + np.cross(mean, weight(scene)), 0.0, atol=1e-5 * np.linalg.norm(weight(scene)))


def test_what_begins_from_it(held, tmp_path):
    scene, on_mesh, truth = held
    rj.save(truth, tmp_path / "truth.vtkhdf")
    again = rj.load(tmp_path / "truth.vtkhdf")
    assert jax.tree.structure(again) == jax.tree.structure(truth)
    np.testing.assert_array_equal(again.clip_moments, truth.clip_moments)
    found = rj.solve(scene, segments=32, solver=TIGHT, guess=truth)
    # Each to the solver's tolerance.
    np.testing.assert_allclose(found.nodes, on_mesh.nodes, atol=1e-10)
    np.testing.assert_allclose(found.clip_moments, on_mesh.clip_moments, rtol=1e-8, atol=1e-6)
    # Where the rod passes a clip its centerline is that of the nodes.
    np.testing.assert_allclose(truth.position_at([0.25, 0.625]), [clip.position for clip in scene.clips], atol=1e-10)
    with pytest.raises(ValueError, match="segments must be a whole number from 3"):
        rj.solve_continuum(scene, truth, segments=2)


def test_reactions_are_the_derivatives_of_the_energy(held):
    """In reverse mode by every number of the scene at once."""
    scene, _, truth = held
    by = by_numpy(jax.grad(lambda scene: rj.solve_continuum(scene, truth, intervals=4).energy))(scene)
    scale = float(np.max(np.abs(truth.clip_forces)))
    for clip, force in zip(by.clips, truth.clip_forces, strict=True):
        np.testing.assert_allclose(clip.position, force, atol=1e-8 * scale)
    turning = np.cross(scene.clips[0].tangent, by.clips[0].tangent)
    np.testing.assert_allclose(turning, truth.clip_moments[0], atol=1e-8 * scale)
    np.testing.assert_allclose(by.end.position, truth.end_force, atol=1e-8 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("clamped", [True, pytest.param(False, marks=pytest.mark.exhaustive)])
def test_a_continuous_beam_is_that_of_three_moments(clamped):
    load, spans = 1e-3, [0.25, 0.375, 0.375]
    rod = Rod(1.0, 1.0, 1.0, 1e6, mass_per_length=1.0)
    start, end = ((Clamp(at, LEVEL) if clamped else Pin(at)) for at in (ORIGIN, (1.0, 0, 0)))
    clips = [Clip(at, (at, 0.0, 0.0)) for at in np.cumsum(spans)[:-1]]
    result = rj.solve_continuum(Scene(rod, start, end, (0, 0, -load), clips=clips))
    assert result.converged
    moments, reactions = three_moments(spans, load, clamped=clamped)
    found = np.array([-result.start_force[2], *result.clip_forces[:, 2], result.end_force[2]])
    # By linear theory the sag is 2e-7, of which the lengthening under EA = 1e6 stiffens the rod by 1e-8; forces of the
    # size of the unit are right to 1e-13, these are 1e-4.
    np.testing.assert_allclose(found, reactions, rtol=1e-7)
    nodes = [int(np.argmin(np.abs(result.s - clip.at))) for clip in clips]
    np.testing.assert_allclose(result.curvature[np.array(nodes)], -moments[1:-1], rtol=1e-7)


@pytest.mark.slow
def test_a_clip_that_holds_the_direction_parts_the_rod():
    """Where neither end holds the twist there is no torque either: two rods, each between two swivels."""
    rod = problems.cable(20.0)
    at, position, tangent = 0.4, (0.3, 0.1, -0.05), (1.0, 0.3, 0.4)
    gravity = (0.0, 3.0, -9.81)
    ends = Swivel(ORIGIN, (1, 0, -1)), Swivel((0.7, 0.2, 0.0), (1, 1, 0))
    whole = rj.solve_continuum(Scene(rod, *ends, gravity, clips=[Clip(at, position, tangent)]))
    middle = Swivel(position, tangent)
    parts = []
    for length, start, end in ((at, ends[0], middle), (1 - at, middle, ends[1])):
        part = Rod(length, rod.EI, rod.GJ, rod.EA, rod.mass_per_length)
        parts.append(rj.solve_continuum(Scene(part, start, end, gravity)))
    first, second = parts
    # Ten digits of each.
    close = {"rtol": 1e-9, "atol": 1e-9 * float(np.max(np.abs(whole.clip_forces)))}
    for name in ("start_force", "start_moment"):
        np.testing.assert_allclose(getattr(whole, name), getattr(first, name), **close)
    for name in ("end_force", "end_moment"):
        np.testing.assert_allclose(getattr(whole, name), getattr(second, name), **close)
    np.testing.assert_allclose(whole.clip_forces[0], first.end_force - second.start_force, **close)
    np.testing.assert_allclose(whole.clip_moments[0], first.end_moment - second.start_moment, **close)
    np.testing.assert_allclose(whole.energy, first.energy + second.energy, rtol=1e-9)


def test_clips_by_frames():
    """A rod of two stiffnesses in clips that hold all, the direction, and the position of a rod that slides."""
    first = frame((1.0, 0.2, 0.1))
    clips = [
        Clip(0.3, (0.25, 0.03, 0.1), frame=first),
        Clip(0.55, (0.45, 0.05, 0.1), (1.0, 0.0, 0.2)),
        Clip(0.8, (0.65, 0.1, 0.12), sliding=True),
    ]
    ends = Clamp(ORIGIN, LEVEL), Clamp((0.8, 0.1, 0.1), frame((1.0, 0.0, 0.3)))

    def scene(clips) -> Scene:
        return Scene(Rod(1.0, (1.0, 2.0), 0.7, 1e4, mass_per_length=1.0), *ends, (0, 0, -9.0), clips=clips)

    coarse, fine = (rj.solve(scene(clips), segments=segments, solver=TIGHT) for segments in (16, 32))
    truth = rj.solve_continuum(scene(clips), fine)
    assert truth.converged
    assert truth.residual < RESIDUAL
    force = float(np.max(np.abs(truth.clip_forces)))
    for name in (*FIELDS, "elastic_energy", "total_twist"):
        exact = getattr(truth, name)
        errors = [float(np.max(np.abs(getattr(result, name) - exact))) for result in (coarse, fine)]
        # Of fourth order, and of the next.
        assert errors[1] < errors[0] / 8, name
    np.testing.assert_allclose(axial_forces(truth), 0.0, atol=1e-9 * force)
    node = int(np.argmin(np.abs(truth.s - 0.3)))
    np.testing.assert_allclose(truth.frames[node], first, atol=RESIDUAL)
    np.testing.assert_array_equal(truth.clip_moments[2], 0.0)
    # Virtual work: a move and a turn of the first clip, by differences of second order in 1e-3.
    turn, move, h = jnp.array([0.3, -0.2, 0.5]), jnp.array([0.2, 0.4, -0.3]), 1e-3

    def energy(part: float) -> float:
        moved = Clip(0.3, clips[0].position + part * move, frame=rotate(first, part * turn))
        return float(rj.solve_continuum(scene([moved, *clips[1:]]), truth).energy)

    work = float(move @ truth.clip_forces[0] + turn @ truth.clip_moments[0])
    assert (energy(h) - energy(-h)) / (2 * h) == pytest.approx(work, rel=1e-4)


@pytest.mark.slow
def test_a_rod_that_slides_while_its_twist_is_held():
    """Wound up by an end: nothing pulls along it in the clip; its derivative by the place of the clip."""
    held = frame((1.0, 0.2, 0.1))
    end = Clamp((0.8, 0.1, 0.1), frame((1.0, 0.0, 0.3), (1.0, 1.0, 0.0)))

    def scene(x) -> Scene:
        clip = Clip(0.4, jnp.stack([x, jnp.array(0.05), jnp.array(0.12)]), frame=held, sliding=True)
        rod = Rod(1.0, (1.0, 2.0), 0.7, 1e4, mass_per_length=1.0)
        return Scene(rod, Clamp(ORIGIN, LEVEL), end, (0, 0, -9.0), clips=[clip])

    x = jnp.array(0.33)
    coarse, fine = (rj.solve(scene(x), segments=segments, solver=TIGHT, strain_limit=None) for segments in (16, 32))
    truth = rj.solve_continuum(scene(x), fine)
    assert truth.converged
    for name in (*FIELDS, "total_twist"):
        exact = getattr(truth, name)
        errors = [float(np.max(np.abs(getattr(result, name) - exact))) for result in (coarse, fine)]
        # Of fourth order, and of the next.
        assert errors[1] < errors[0] / 8, name
    np.testing.assert_allclose(coarse.scene.clips[0].at, truth.scene.clips[0].at, rtol=0, atol=1e-4)
    for result in (fine, truth):
        node = int(np.argmin(np.abs(result.s - result.scene.clips[0].at)))
        np.testing.assert_allclose(result.frames[node], held, rtol=0, atol=RESIDUAL)
        # Of forces of 100.
        assert abs(float(result.clip_forces[0] @ held[:, 2])) < 1e-9
        # The two spans are wound up by different torques.
        assert float(np.ptp(result.twist)) > 0.5

    def pull(x):
        return rj.solve(scene(x), segments=16, solver=TIGHT, guess=coarse, strain_limit=None).end_force[2]

    difference = float(pull(x + 1e-4) - pull(x - 1e-4)) / 2e-4
    # Of second order in 3e-4 of the place.
    assert float(jax.grad(pull)(x)) == pytest.approx(difference, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "end", "tangent"),
    [
        pytest.param(Pin(ORIGIN), None, None, marks=pytest.mark.exhaustive),
        (None, Free(force=(0.0, 200.0, 100.0)), (1.0, 0.3, 0.4)),
        (Free(), Pin((0.6, 0.2, 0.0)), None),
    ],
)
def test_every_kind_of_end(start, end, tangent):
    scene = in_space(tangent, start, end)
    scene = Scene(
        scene.rod, scene.start, scene.end, scene.gravity, [rj.PointForce(0.4, (0, 500.0, 0))], clips=scene.clips
    )
    on_mesh = rj.solve(scene, segments=64, solver=TIGHT)
    truth = rj.solve_continuum(scene, on_mesh)
    assert truth.converged
    for name in FIELDS:
        expected = np.asarray(getattr(on_mesh, name))
        # The mesh of 64: of fourth order, where 32 have some 1e-4.
        np.testing.assert_allclose(
            getattr(truth, name), expected, rtol=0, atol=2e-5 * float(np.max(np.abs(on_mesh.clip_forces))), err_msg=name
        )
    size = float(np.max(np.abs(on_mesh.state.end_force)))
    np.testing.assert_allclose(truth.state.end_force, on_mesh.state.end_force, atol=2e-5 * size)
    np.testing.assert_allclose(truth.nodes, on_mesh.nodes, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("tangent", [pytest.param(None, marks=pytest.mark.exhaustive), (1.0, 0.3, 0.4)])
def test_no_axial_force_acts_where_the_rod_slides(tangent):
    scene = in_space(tangent, sliding=(True, True), slenderness=100.0)
    on_mesh = rj.solve(scene, segments=32, solver=TIGHT)
    truth = rj.solve_continuum(scene, on_mesh, segments=32)
    assert truth.converged
    size = float(np.linalg.norm(weight(scene)))
    np.testing.assert_allclose(axial_forces(truth), 0.0, atol=1e-9 * size)
    np.testing.assert_allclose(supported(truth), -weight(scene), rtol=0, atol=1e-9 * size)
    # To the error of the mesh, 1e-5 in its shape.
    for clip, other in zip(truth.scene.clips, on_mesh.scene.clips, strict=True):
        np.testing.assert_allclose(clip.at, other.at, atol=1e-4)
    np.testing.assert_allclose(truth.clip_forces, on_mesh.clip_forces, atol=2e-3 * size)


@pytest.mark.slow
def test_derivatives_by_the_clips():
    """Forward and reverse mode against differences, by arclength, position and direction of the clips together."""
    scene = in_space((1.0, 0.3, 0.4), sliding=(False, True))
    base = rj.solve_continuum(scene)
    at_rest = frame(scene.clips[0].tangent)
    change = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, 10))

    def found(step):
        first, second = scene.clips
        d = step * change
        clips = [
            Clip(first.at + d[0], first.position + d[1:4], rotate(at_rest, d[4:7])[:, 2]),
            Clip(second.at, second.position + d[7:], None, sliding=True),
        ]
        moved = Scene(scene.rod, scene.start, scene.end, scene.gravity, clips=clips)
        result = rj.solve_continuum(moved, base, intervals=8)
        forces = (result.start_force, result.end_moment, result.clip_forces.reshape(-1), result.clip_moments[0])
        return jnp.concatenate([*forces, result.scene.clips[1].at[None], result.energy[None]])

    values, h = by_numpy(found), 1e-3
    ahead, behind, far_ahead, far_behind = (values(jnp.asarray(step)) for step in (h, -h, 2 * h, -2 * h))
    central = (8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * h)
    weights = jnp.linspace(0.5, 1.5, len(central))
    both = by_numpy(lambda step: (jax.jacfwd(found)(step), jax.grad(lambda step: weights @ found(step))(step)))
    forward, reverse = both(jnp.zeros(()))
    # Of h^4, and of rounding and rtol, 1e-12, by h.
    np.testing.assert_allclose(forward, central, rtol=1e-6, atol=1e-8 * float(np.max(np.abs(central))))
    np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-9)
