"""Fields of forces along the rod: against gravity, closed forms, an integrated elastica and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from numpy_programs import by_numpy
from scipy.integrate import solve_ivp

import rodjax as rj
from rodjax import Clamp, Free, Pin, Potential, Rod, Scene
from rodjax.discretization.nodal_point import NodalChange
from rodjax.solving.result_form import form_and_point

X = (1.0, 0.0, 0.0)
START = Clamp((0, 0, 0), rj.frame(X))
FAR = Clamp((0.8, 0.1, 0.1), rj.frame((1, 0, 0.3)))


class Uniform(eqx.Module):
    force: Float[Array, "3"]

    def __call__(self, position: Float[Array, "3"], s: Float[Array, ""]) -> Float[Array, ""]:
        return -self.force @ position


class Bedding(eqx.Module):
    """Springs from the plane z = 0, per length, stiffer along the rod by a part."""

    stiffness: Float[Array, ""]
    growth: float = 0.0

    def __call__(self, position: Float[Array, "3"], s: Float[Array, ""]) -> Float[Array, ""]:
        return self.stiffness * (1 + self.growth * s) / 2 * position[2] ** 2


BED = Bedding(jnp.asarray(400.0), 1.0)


def bedding(stiffness, growth=0.0) -> Potential:
    return Potential(Bedding(jnp.asarray(stiffness), growth))


def rod(EI=1.0, EA=1e6, **more) -> Rod:
    return Rod(1.0, EI, 0.7, EA, mass_per_length=1.0, **more)


ENDS = {"clamps": (START, FAR), "free start": (Free((0, 0, 1.0)), START), "pins": (Pin((0, 0, 0)), Pin((0.7, 0, 0.2)))}
FIELDS = ("nodes", "tension", "curvature", "start_force", "start_moment", "end_force", "end_moment", "energy")


@pytest.mark.parametrize(
    ("EI", "ends"),
    [(1.0, "clamps"), (1.0, "free start"), ((1.0, 2.0), "pins")],
)
def test_a_uniform_field_is_gravity(EI, ends):
    """Whose forces stand elsewhere in the equations: of fourth order apart, on elements of unequal lengths too."""
    force = np.array([0.3, 0.2, -9.0])
    field = [Potential(Uniform(jnp.asarray(force)))]
    clips = [rj.Clip(0.37, (0.3, 0.0, 0.1))] if ends == "clamps" else []
    apart = []
    for segments in (16, 32):
        known = rj.solve(Scene(rod(EI), *ENDS[ends], force, clips=clips), segments=segments)
        result = rj.solve(Scene(rod(EI), *ENDS[ends], clips=clips, potentials=field), segments=segments)
        assert result.converged
        assert result.stable
        sizes = [max(1.0, float(np.max(np.abs(getattr(known, name))))) for name in FIELDS]
        changes = [np.max(np.abs(getattr(result, name) - getattr(known, name))) for name in FIELDS]
        apart.append(np.array(changes) / sizes)
    # Seen are 2e-4 at most on 16 elements.
    assert np.max(apart[0]) < 5e-4
    # Halved, a sixteenth; down to what the residual of 1e-8 EI/L^2, and stretch in the rule for the field, leave.
    assert np.all((apart[1] < apart[0] / 10) | (apart[1] < 1e-7))


@pytest.mark.parametrize("EI", [1.0, (1.0, 1.0)])
def test_a_cantilever_on_an_elastic_bedding(EI):
    """Hetenyi, Beams on Elastic Foundation (1946): the deflection of its end under a force there, small."""
    stiffness, force = 400.0, 1e-4
    scene = Scene(rod(EI, EA=1e9), START, Free((0, 0, force)), potentials=[bedding(stiffness)])
    result = rj.solve(scene, segments=32)
    c = (stiffness / 4) ** 0.25
    ratio = (np.sinh(c) * np.cosh(c) - np.sin(c) * np.cos(c)) / (np.cosh(c) ** 2 + np.cos(c) ** 2)
    # Of fourth order: 1e-5 on 16 elements, 7e-7 on 32.
    assert float(result.nodes[-1, 2]) == pytest.approx(2 * force * c / stiffness * ratio, rel=1e-6)


def test_a_rod_in_a_field_is_the_integrated_elastica():
    """From its start, with the force and moment there, to its end, in a field that varies along space and rod."""

    def wave(position, s):
        return (20.0 + 10.0 * s) * jnp.sin(3.0 * position[0]) * position[2]

    scene = Scene(rod(EA=1e4), START, Free(), potentials=[Potential(wave)])
    result = rj.solve(scene, segments=64)
    assert result.converged
    assert float(jnp.max(result.curvature)) > 1.0

    def slope(s, y):
        x, z, angle, nx, nz, moment = y
        t = np.array([np.cos(angle), np.sin(angle)])
        way = (1 + t @ [nx, nz] / 1e4) * t
        push = (20 + 10 * s) * np.array([3 * np.cos(3 * x) * z, np.sin(3 * x)])
        return [*way, moment, *push, way[1] * nx - way[0] * nz]

    # Positive about -y, as angles are from x to z.
    begin = [0, 0, 0, result.start_force[0], result.start_force[2], -result.start_moment[1]]
    end = solve_ivp(slope, (0, 1), begin, rtol=1e-11, atol=1e-12).y[:, -1]
    # Forces of 30 and moments of 5, to a few parts in 1e7: on 32 elements sixteen times as much.
    np.testing.assert_allclose(end[:2], result.nodes[-1, [0, 2]], rtol=0, atol=5e-7)
    np.testing.assert_allclose(end[3:], 0.0, atol=2e-5)
    assert float(result.error_estimate) < 5e-7


PART = (0.31, 0.72)


@pytest.mark.parametrize("EI", [1.0, (1.0, 2.0)])
def test_a_uniform_field_along_a_part_is_a_force_along_it(EI):
    """The part ends where the mesh had no nodes; of fourth order apart, as above."""
    force = jnp.array([0.0, 3.0, -40.0])
    field = Potential(Uniform(force), part=PART)
    of_field, of_force = (
        rj.solve(Scene(rod(EI), START, FAR, **loads), segments=32)
        for loads in ({"potentials": [field]}, {"distributed": [rj.DistributedForce(force, part=PART)]})
    )
    for result in (of_field, of_force):
        assert result.converged
        assert set(PART) <= set(np.asarray(result.s))
    for name in FIELDS:
        size = max(1.0, float(np.max(np.abs(getattr(of_force, name)))))
        # Seen are 1.1e-7.
        np.testing.assert_allclose(getattr(of_field, name), getattr(of_force, name), rtol=0, atol=5e-7 * size)


def test_derivatives_by_the_ends_of_a_part():
    def seen(end):
        part = jnp.stack([jnp.asarray(0.31), end])
        result = rj.solve(Scene(rod(), START, FAR, potentials=[Potential(BED, part)]), segments=12)
        return result.end_force[2] + result.end_moment[1] + result.energy

    values = [float(seen(jnp.asarray(0.72 + k * 1e-3))) for k in (-2, -1, 1, 2)]
    difference = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 12e-3
    # Of fourth order in steps of a thousandth of the length, and of solves to 1e-8 by that.
    assert float(jax.grad(seen)(jnp.asarray(0.72))) == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("part", [(0.3, 1.2), (0.5, 0.4), (-0.1, 0.5)])
def test_parts_that_are_none(part):
    with pytest.raises(ValueError, match=r"part must (be two arclengths|lie in 0 to 1 m)"):
        Scene(rod(), START, FAR, potentials=[Potential(BED, part)])


@pytest.mark.slow
def test_the_continuum_is_what_meshes_in_fields_converge_to():
    """Along a part and along all of the rod, beside gravity and a clip; by frames as by tangents."""
    fields = [Potential(BED, PART), Potential(Uniform(jnp.array([0.0, 0.6, -8.0])))]
    clip = rj.Clip(0.4, (0.33, 0.05, 0.12))
    plain, framed = (
        Scene(rod(EI), START, FAR, (0, 0, -9.0), clips=[clip], potentials=fields) for EI in (1.0, (1.0, 1.0))
    )
    meshes = [rj.solve(plain, segments=segments) for segments in (16, 32)]
    truth, other = rj.solve_continuum(plain, meshes[1]), rj.solve_continuum(framed)
    for result in (truth, other):
        assert result.converged
    for name in ("start_force", "clip_forces", "end_force", "end_moment", "energy"):
        exact = getattr(truth, name)
        size = float(np.max(np.abs(exact)))
        np.testing.assert_allclose(getattr(other, name), exact, rtol=0, atol=1e-9 * size)
        coarse, fine = (float(np.max(np.abs(getattr(mesh, name) - exact))) / size for mesh in meshes)
        # Of fourth order: a sixteenth, or eight times less where errors of both orders cancel.
        assert fine < coarse / 8, name
    again = rj.solve(plain, guess=truth, segments=32)
    np.testing.assert_allclose(again.nodes, meshes[1].nodes, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_the_continuum_by_a_field_and_its_part():
    def scene(stiffness, end) -> Scene:
        part = jnp.stack([jnp.asarray(0.31), end])
        return Scene(rod(), START, FAR, (0, 0, -9.0), potentials=[Potential(Bedding(stiffness, 1.0), part)])

    stiffness, end = jnp.asarray(400.0), jnp.asarray(0.72)
    begin = rj.solve(scene(stiffness, end), segments=16)

    def seen(stiffness, end):
        return rj.solve_continuum(scene(stiffness, end), begin).end_force[2]

    by_stiffness, by_end = jax.grad(seen, argnums=(0, 1))(stiffness, end)
    # Of second order in 2.5e-4 of the stiffness and 1e-4 of the length.
    difference = (seen(stiffness + 0.1, end) - seen(stiffness - 0.1, end)) / 0.2
    assert float(by_stiffness) == pytest.approx(float(difference), rel=1e-5)
    difference = (seen(stiffness, end + 1e-4) - seen(stiffness, end - 1e-4)) / 2e-4
    assert float(by_end) == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.parametrize("EI", [1.0, (1.0, 2.0)])
def test_derivatives_by_the_numbers_of_a_field(EI):
    def seen(stiffness):
        result = rj.solve(Scene(rod(EI), START, FAR, potentials=[bedding(stiffness, 0.5)]), segments=12)
        return result.end_force[2] + result.end_moment[1] + result.energy + result.curvature[3]

    values = [float(seen(jnp.asarray(50.0 + k))) for k in (-2, -1, 1, 2)]
    difference = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 12
    # Of fourth order in steps of 2 %.
    assert float(jax.grad(seen)(jnp.asarray(50.0))) == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("EI", [1.0, (1.0, 2.0)])
def test_the_system_is_the_derivative_of_what_is_out_of_balance(EI):
    """In space, with a free end, which the field turns too."""
    scene = Scene(rod(EI, EA=1e3), START, Free((0.0, 3.0, 5.0)), potentials=[bedding(300.0, 0.5)])
    form, point = form_and_point(rj.solve(scene, segments=4, strain_limit=None))
    generator = np.random.default_rng(0)
    displacements = jnp.asarray(generator.normal(size=point.nodal.positions.shape))
    displacements = jnp.where(form.is_held[:, None], 0.0, displacements)
    change = jnp.asarray(generator.normal(size=point.end_force.shape))

    @by_numpy
    def both(point, rotation):
        here = form.linearized(point)
        rotation = jnp.where(jnp.sum(here.bases**2, axis=0) > 0, rotation, 0.0)

        def residual_at(part):
            others = NodalChange(part * displacements, point.nodal.pressures)
            return form.residual_vectors(form.retract(point, here.bases, part * rotation, part * change, others))

        _, expected = jax.jvp(residual_at, (jnp.array(0.0),), (jnp.array(1.0),))
        multipliers = jnp.concatenate([displacements.ravel(), form.layout.components(change)])
        return expected, here.system.times(rotation, multipliers), jnp.max(jnp.abs(here.system.turning))

    expected, found, turning = both(point, jnp.asarray(generator.normal(size=form.bases_at(point).shape[1:])))
    for given, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(given, wanted, rtol=0, atol=1e-9 * float(jnp.max(jnp.abs(wanted))))
    assert float(turning) > 0.01


def test_a_magnet_presses_a_cable_on_the_floor():
    pull = Potential(Uniform(jnp.array([0.0, 0.0, -20.0])))
    floor = rj.Plane((0, 0, -0.1), (0, 0, 1))
    ends = START, Clamp((0.9, 0, 0), rj.frame(X))
    result = rj.solve(Scene(rod(radius=0.01), *ends, potentials=[pull], obstacles=[floor]), segments=32)
    assert result.converged
    pushes = np.asarray(result.contact_forces).sum(0)
    assert pushes[2] > 1.0
    # To the residual of 1e-8 EI/L^2 at each of 33 nodes.
    np.testing.assert_allclose(pushes + result.end_force - result.start_force, [0, 0, 20.0], rtol=0, atol=1e-6)


# --- branches --------------------------------------------------------------------------------------------------------

FIELD, PRESS, STIFF = 5 * np.pi**4, 80.0, 1e8


def around(k, position, s):
    return k / 2 * (position[1] ** 2 + position[2] ** 2)


def column(load, k=FIELD, EI=1.0) -> Scene:
    """Between pins that come together, on a bedding all around it."""
    field = Potential(jax.tree_util.Partial(around, jnp.asarray(k)))
    return Scene(Rod(1.0, EI, 0.7, STIFF), Pin((0, 0, 0)), Pin((1 - load / STIFF, 0, 0)), potentials=[field])


STRAIGHT = rj.Guess(np.linspace((0.0, 0.0, 0.0), X, 5))


def winkler(m: int, k=FIELD, EI=1.0) -> float:
    """The load under which a column between pins buckles in m half waves."""
    return np.pi**2 * m**2 * EI + k / (np.pi**2 * m**2)


@pytest.mark.slow
def test_a_column_on_a_bedding_buckles_in_two_half_waves():
    branch = rj.follow([column(0.0), column(PRESS)], segments=48, guess=STRAIGHT)
    assert branch.ended == rj.BranchEnd.SCENES
    first, second = branch.critical_points
    assert [(point.index_before, point.index_after) for point in (first, second)] == [(0, 2), (2, 4)]
    np.testing.assert_array_equal(branch.index, branch.equilibria.index)
    # The mesh error of 48 elements; as much of the load is the change of length.
    for point, m in ((first, 2), (second, 1)):
        np.testing.assert_allclose(PRESS * point.parameter, winkler(m), rtol=1e-6)
        np.testing.assert_allclose(rj.lowest_mode(second.equilibrium).stiffness, winkler(2) - winkler(1), rtol=1e-5)
        size = np.linalg.norm(point.mode.displacement, axis=1)
        np.testing.assert_allclose(size, np.abs(np.sin(m * np.pi * point.equilibrium.s)), rtol=0, atol=1e-5)
    stopped = rj.solve_path(
        [column(load) for load in (40.0, 50.0, 55.0)], segments=48, guess=STRAIGHT, at_critical="stop"
    )
    assert stopped.energy.shape == (2,)


@pytest.mark.slow
@pytest.mark.parametrize("EI", [1.0, pytest.param((1.0, 2.0), marks=pytest.mark.exhaustive)])
def test_the_derivatives_of_a_critical_load_on_a_bedding(EI):
    """By k L^2/(4 pi^2) and 4 pi^2 EI/L^2."""

    def critical(k, part):
        scenes = [column(load, k, jnp.asarray(EI) * part if EI == 1.0 else (part, 2.0)) for load in (0.0, PRESS)]
        point = rj.critical_point(scenes, segments=48, guess=STRAIGHT)
        assert (point.kind, point.index_after) == ("branch", 2 if EI == 1.0 else 1)
        return PRESS * point.parameter

    load, (by_k, by_EI) = jax.value_and_grad(critical, argnums=(0, 1))(FIELD, 1.0)
    np.testing.assert_allclose(load, winkler(2), rtol=1e-6)
    np.testing.assert_allclose(by_k, 1 / (4 * np.pi**2), rtol=2e-6)
    np.testing.assert_allclose(by_EI, 4 * np.pi**2, rtol=2e-6)
    difference = (critical(FIELD + 1.0, 1.0) - critical(FIELD - 1.0, 1.0)) / 2
    np.testing.assert_allclose(by_k, difference, rtol=1e-6)


@pytest.mark.slow
def test_a_branch_in_a_uniform_field_is_one_in_gravity():
    """An arch that snaps through under its weight, and under a field as heavy."""
    half = 0.5
    cosine, sine, span = np.cos(half), np.sin(half), np.sin(half) / half
    ends = Clamp((0, 0, 0), rj.frame((cosine, 0, sine))), Clamp((span, 0, 0), rj.frame((cosine, 0, -sine)))
    angle = np.linspace(-half, half, 101)
    rise = (np.cos(angle) - cosine) / (2 * half)
    circle = rj.Guess(np.stack([span / 2 + np.sin(angle) / (2 * half), 0 * angle, rise], axis=1))

    def scene(weight: float, of_field: bool) -> Scene:
        force = jnp.array([0.0, 0.0, -weight])
        if of_field:
            return Scene(rod(), *ends, potentials=[Potential(Uniform(force))])
        return Scene(rod(), *ends, force)

    found = [
        rj.follow([scene(weight, of_field) for weight in (0.0, 100.0)], segments=24, guess=circle, max_points=30)
        for of_field in (True, False)
    ]
    field, gravity = ([(p.kind, p.index_before, p.index_after) for p in branch.critical_points] for branch in found)
    assert field == gravity
    assert len(field) == 3
    loads = [[float(point.parameter) for point in branch.critical_points] for branch in found]
    # Of fourth order apart, as their forces stand elsewhere in the equations.
    np.testing.assert_allclose(*loads, rtol=1e-4)


def test_what_pushes_out_of_a_plane_is_told():
    ends = START, Clamp((0.8, 0, 0.1), rj.frame((1, 0, 0.3)))
    aside = Potential(Uniform(jnp.array([0.0, 3.0, 0.0])))
    with pytest.warns(rj.NotConvergedWarning, match="leave the plane"):
        result = rj.solve(Scene(rod(), *ends, potentials=[aside]), segments=16, planar=True)
    assert not result.converged
    within = Scene(rod(), *ends, potentials=[bedding(30.0)])
    planar, space = (rj.solve(within, segments=16, planar=planar) for planar in (True, False))
    np.testing.assert_allclose(planar.nodes, space.nodes, rtol=0, atol=1e-9)


def test_numbers_in_functions_and_paths():
    """Functions and partial ones are potentials too; a path's numbers vary."""
    of_function = Potential(lambda position, s: 15.0 * position[2] ** 2)
    partial = Potential(jax.tree_util.Partial(lambda k, position, s: k / 2 * position[2] ** 2, 30.0))
    assert [leaf.shape for leaf in jax.tree.leaves(partial)] == [()]
    scenes = [Scene(rod(), START, FAR, potentials=[field]) for field in (bedding(30.0), of_function, partial)]
    first, *others = (rj.solve(scene, segments=8) for scene in scenes)
    for other in others:
        np.testing.assert_allclose(other.nodes, first.nodes, rtol=0, atol=1e-13)
    path = rj.solve_path([Scene(rod(), START, FAR, potentials=[bedding(k)]) for k in (10.0, 30.0)], segments=8)
    # Both to a residual of 1e-8 EI/L^2.
    np.testing.assert_allclose(path.nodes[1], first.nodes, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("density", "error", "message"),
    [
        (3.0, TypeError, "density must be a function of a position"),
        (lambda position: position[0], TypeError, r"potentials\[0\] must be a function of a position"),
        (lambda position, s: position, ValueError, r"potentials\[0\] must give one real number"),
        (lambda position, s: position[0] > 0, ValueError, r"potentials\[0\] must give one real number"),
    ],
)
def test_densities_that_are_none(density, error, message):
    with pytest.raises(error, match=message):
        Scene(rod(), START, FAR, potentials=[Potential(density)])


def test_what_takes_no_fields_says_so(tmp_path):
    scene = Scene(rod(), START, FAR, potentials=[bedding(30.0)])
    result = rj.solve(scene, segments=8)
    for refused, message in (
        (lambda: rj.solve(scene, discretization="finite_difference"), "discretization must be 'hermite'"),
        (lambda: rj.save(result, tmp_path / "result.vtkhdf"), r"potentials must be \(\): a potential is code"),
        (lambda: rj.write_scene(scene, tmp_path / "scene.toml"), r"potentials must be \(\) to be written"),
    ):
        with pytest.raises(ValueError, match=message):
            refused()
    with pytest.raises(TypeError, match=r"potentials\[0\] must be a Potential"):
        Scene(rod(), START, FAR, potentials=[lambda position, s: s])  # pyright: ignore
