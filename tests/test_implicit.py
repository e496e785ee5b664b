"""Derivatives of a solve: against differences, both ways, again, under vmap; and where there is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scenes import loaded_scenes

import rodjax as rj
from rodjax import Clamp, Free, PointForce, Scene, Swivel, frame, problems, rotate

SEGMENTS = 8
TIGHT = rj.Newton(tolerance=1e-12)
SCENES = loaded_scenes()


def moved(scene: Scene, by: dict[str, jax.Array]) -> Scene:
    """The scene with all of its numbers changed."""
    rod = jax.tree.map(
        lambda leaf, change: leaf * (1 + change),
        scene.rod,
        jax.tree.unflatten(jax.tree.structure(scene.rod), list(by["rod"][: len(jax.tree.leaves(scene.rod))])),
    )

    def support(end, by):
        if isinstance(end, Free):
            force = None if end.force is None else end.force * (1 + by[0])
            return Free(force, None if end.moment is None else end.moment * (1 + by[1]))
        position = end.position + by[2:5]
        if isinstance(end, Clamp):
            return Clamp(position, rotate(end.frame, by[5:8]))
        return Swivel(position, end.tangent + by[5:8]) if isinstance(end, Swivel) else rj.Pin(position)

    gravity = None if scene.gravity is None else scene.gravity + by["gravity"]
    forces = [PointForce(load.at * (1 + by["at"][0]), load.force * (1 + by["at"][1])) for load in scene.point_forces]
    return Scene(rod, support(scene.start, by["start"]), support(scene.end, by["end"]), gravity, forces)


def changes(seed: int) -> dict[str, jax.Array]:
    rng = np.random.default_rng(seed)
    sizes = {"rod": 6, "start": 8, "end": 8, "gravity": 3, "at": 2}
    return {name: jnp.asarray(rng.uniform(-0.1, 0.1, size)) for name, size in sizes.items()}


def fields(result: rj.Equilibrium, EI: float) -> jax.Array:
    """In units of L = 1 m and EI/L."""
    parts = [result.nodes, result.frames, result.curvature, result.twist, result.total_twist, result.axial_strain]
    in_newton = [result.tension, result.start_force, result.start_moment, result.end_force, result.end_moment]
    in_newton += [result.energy, result.elastic_energy, result.position_at([0.3, 0.7])[0] * EI]
    return jnp.concatenate([jnp.ravel(part) for part in parts] + [jnp.ravel(part) / EI for part in in_newton])


@pytest.mark.parametrize(
    ("name", "discretization"),
    [
        ("cantilever", "finite_difference"),
        pytest.param("clamps", "finite_difference", marks=pytest.mark.slow),
        pytest.param("clamps", "hermite", marks=pytest.mark.exhaustive),
        pytest.param("pins", "hermite", marks=pytest.mark.exhaustive),
        pytest.param("start moment", "hermite", marks=pytest.mark.slow),
    ],
)
def test_all_fields_by_all_numbers_of_a_scene(name, discretization):
    scene = SCENES[name]
    EI = float(scene.rod.EI)
    options = {"segments": SEGMENTS, "discretization": discretization, "solver": TIGHT}
    base = rj.solve(scene, **options)
    direction = changes(0)

    def along(by):
        return fields(rj.solve(moved(scene, by), guess=base, **options), EI)

    @by_numpy
    def both(direction, weights):
        nowhere = jax.tree.map(jnp.zeros_like, direction)
        values, change = jax.jvp(along, (nowhere,), (direction,))
        return values, change, jax.vjp(along, nowhere)[1](weights)[0]

    at = by_numpy(lambda h: along(jax.tree.map(lambda change: h * change, direction)))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=fields(base, EI).shape))
    values, change, by_weights = both(direction, weights)
    h = 2e-3
    expected = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    # Differences of fourth order: h^4 of the fifth derivative, and 1e-12/h of the residual. Seen: 1e-8.
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-6 * float(np.max(np.abs(expected))))
    np.testing.assert_allclose(values, fields(base, EI), rtol=0, atol=1e-11 * float(np.max(np.abs(values))))
    backwards = sum(jnp.sum(by_weights[key] * direction[key]) for key in direction)
    np.testing.assert_allclose(backwards, jnp.sum(weights * change), rtol=1e-10)  # roundings


def height(load: jax.Array) -> jax.Array:
    """Of the tip of a cantilever under a transverse load in EI/L^2."""
    rod = problems.cable()
    force = load * rod.EI * jnp.array([0.0, 0.0, -1.0])
    scene = Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), Free(force=force))
    return rj.solve(scene, segments=SEGMENTS, discretization="finite_difference", solver=TIGHT).nodes[-1, 2]


def test_second_derivatives_and_batches():
    loads = jnp.array([1.0, 2.0, 4.0])
    # Compiled, as inside a user's program: forward over reverse.
    slopes, bends = jax.jit(jax.vmap(lambda load: jax.jvp(jax.grad(height), (load,), (1.0,))))(loads)
    h = 1e-2
    for load, slope, bend in zip(loads, slopes, bends, strict=True):
        low, middle, high = (height(load + shift) for shift in (-h, 0.0, h))
        # Second order in h: 1e-4 of a third and fourth derivative below 0.1.
        assert float(slope) == pytest.approx(float(high - low) / (2 * h), abs=1e-5)
        assert float(bend) == pytest.approx(float(high - 2 * middle + low) / h**2, abs=1e-5)
    # Reverse over reverse, roundings.
    assert float(by_numpy(jax.grad(jax.grad(height)))(loads[0])) == pytest.approx(float(bends[0]), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in ("clamps", "end moment") else pytest.mark.exhaustive) for name in SCENES],
)
def test_second_derivatives_forward_and_reverse(name):
    """Of a nonlinear function of a result, on a scene of each kind, along two changes of its numbers."""
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), changes(6), changes(7))
    EI = float(SCENES[name].rod.EI)
    x, v, w = jnp.array([0.3, -0.2]), jnp.array([1.0, 0.5]), jnp.array([-0.4, 1.0])

    def one_number(x):
        scene = moved(SCENES[name], jax.tree.map(lambda leaf: x @ leaf, both))
        result = rj.solve(scene, segments=SEGMENTS, solver=TIGHT, discretization="finite_difference")
        found = jnp.concatenate([jnp.ravel(result.nodes), result.start_force / EI, result.start_moment / EI])
        return jnp.sum(jnp.cos(jnp.arange(found.size)) * found**2)

    def along(x):
        return jax.jvp(one_number, (x,), (v,))[1]

    derivatives = by_numpy(lambda x: (*jax.jvp(along, (x,), (w,)), jax.grad(along)(x) @ w))
    h = 1e-4
    _, forward, reverse = derivatives(x)
    expected = float(derivatives(x + h * w)[0] - derivatives(x - h * w)[0]) / (2 * h)
    # The difference is good to h^2 times the fourth derivative.
    assert float(forward) == pytest.approx(expected, rel=1e-5)
    assert float(reverse) == pytest.approx(expected, rel=1e-5)


def test_paths_both_ways():
    rod = problems.cable()

    def tip(load):
        forces = [Free(force=part * load * rod.EI * jnp.array([0.0, 0.0, -1.0])) for part in (0.5, 1.0)]
        scenes = [Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), force) for force in forces]
        path = rj.solve_path(scenes, segments=SEGMENTS, discretization="finite_difference", solver=TIGHT)
        return path.nodes[-1, -1, 2]

    forward, backward = jax.jvp(tip, (1.0,), (1.0,))[1], jax.grad(tip)(1.0)
    np.testing.assert_allclose([forward, backward], jax.grad(height)(1.0), rtol=1e-10)  # roundings and residuals


def test_no_derivative_where_nothing_converged():
    def tip(load):
        rod = problems.cable()
        scene = Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), Free(force=load * rod.EI * jnp.array([0.0, 0.0, -1.0])))
        few = rj.Newton(max_iterations=1)
        result = rj.solve(scene, segments=SEGMENTS, discretization="finite_difference", solver=few)
        return result.nodes[-1, 2], result.converged

    with pytest.warns(rj.NotConvergedWarning):
        derivative, converged = jax.grad(tip, has_aux=True)(10.0)
    assert not converged
    assert np.isnan(derivative)


def between_clamps(x: jax.Array) -> Scene:
    """A cable between clamps, the end moved and turned by multiples of x."""
    turned = rotate(frame((1, 0, 0)), x * jnp.array([1.0, 0.3, 0.2]))
    end = Clamp(jnp.array([0.8, 0.0, 0.0]) + x * jnp.array([0.0, 0.1, 0.05]), turned)
    return Scene(problems.cable(), Clamp((0, 0, 0), frame((1, 0, 0))), end, gravity=(0, 0, -9.81))


@pytest.mark.optimized
@pytest.mark.slow
@pytest.mark.parametrize("discretization", [pytest.param("finite_difference", marks=pytest.mark.exhaustive), "hermite"])
def test_the_value_beside_a_derivative_is_the_plain_one_bit_by_bit(discretization):
    def loss(x):
        result = rj.solve(between_clamps(x), segments=SEGMENTS, discretization=discretization)
        return jnp.sum(result.nodes**2) + result.end_moment[1], result

    both = jax.value_and_grad(loss, has_aux=True)
    x = jnp.asarray(0.7)
    for plain, beside in ((loss, both), (jax.jit(loss), jax.jit(both))):
        value = plain(x)
        jax.tree.map(np.testing.assert_array_equal, value, beside(x)[0])
        assert value[1].converged


def test_meshes_are_chosen_beside_derivatives_too():
    def tip(load):
        result = rj.solve(problems.cantilever(load), rtol=1e-2)
        return result.nodes[-1, 2], result

    plain = tip(2.0)[1]
    (_, result), slope = jax.value_and_grad(tip, has_aux=True)(2.0)
    assert result.s.shape == plain.s.shape
    assert result.error_estimate <= 1e-2
    # Of the mesh of this tolerance, and differences of second order.
    assert slope == pytest.approx(float(tip(2.01)[0] - tip(1.99)[0]) / 0.02, rel=1e-3)


def test_no_derivative_where_a_column_buckles():
    # The critical load of 64 elements is that of the continuum to 1e-8 of it: the stiffness left is below 1e-6.
    def end(load):
        result = rj.solve(
            Scene(problems.cable(), Clamp((0, 0, 0), frame((1, 0, 0))), Free(force=load * jnp.array([-1.0, 0.0, 0.0]))),
            segments=64,
        )
        return result.nodes[-1, 0], result

    rod = problems.cable()
    buckling = float(np.pi**2 / 4 * rod.EI)
    derivative, result = jax.grad(end, has_aux=True)(buckling)
    assert result.converged
    assert result.critical
    assert "derivatives are not numbers" in rj.describe(result)
    assert np.isnan(derivative)
    derivative, result = jax.grad(end, has_aux=True)(0.99 * buckling)
    assert not result.critical
    assert derivative == pytest.approx(-1 / float(rod.EA), rel=1e-9)  # shortened as a bar


@pytest.mark.slow
def test_no_derivative_at_the_load_that_an_arch_bears():
    rod = problems.cable()
    options = {"segments": 16, "discretization": "hermite"}

    def arch(load):
        ends = Clamp((0, 0, 0), frame((1, 0, 0.5))), Clamp((0.95, 0, 0), frame((1, 0, -0.5)))
        return Scene(rod, *ends, point_forces=[PointForce(0.5, load * rod.EI * jnp.array([0.0, 0.0, -1.0]))])

    def height(load, guess):
        return rj.solve(arch(load), guess=guess, **options).nodes[8, 2]

    standing, low, high = rj.solve(arch(0.0), **options), 0.0, 60.0
    for _ in range(45):
        load = (low + high) / 2
        result = rj.solve(arch(load), guess=standing, **options)
        if result.converged and result.nodes[8, 2] > 0.05 and abs(result.nodes[8, 1]) < 1e-6:
            low, standing = load, result
        else:
            high = load
    assert standing.critical
    assert np.isnan(jax.grad(height)(low, standing))
    before = rj.solve(arch(0.9 * low), guess=standing, **options)
    assert not before.critical
    h = 1e-3 * low
    slope = (height(0.9 * low + h, before) - height(0.9 * low - h, before)) / (2 * h)
    assert jax.grad(height)(0.9 * low, before) == pytest.approx(float(slope), rel=1e-4)  # of second order in h


@pytest.mark.slow
def test_a_rod_that_may_spin_has_derivatives():
    # Buckled between coaxial clamps it turns about their line without resistance.
    rod = problems.cable()

    def push(end):
        scene = Scene(
            rod, Clamp((0, 0, 0), frame((1, 0, 0))), Clamp(end * jnp.array([1.0, 0.0, 0.0]), jnp.eye(3)[:, [1, 2, 0]])
        )
        result = rj.solve(scene, segments=16, solver=TIGHT)
        return result.end_force[0], result

    stiffness, result = jax.grad(push, has_aux=True)(0.8)
    assert result.converged
    assert not result.critical
    low, high = (
        (8 * (push(0.8 + h)[0] - push(0.8 - h)[0]) - (push(0.8 + 2 * h)[0] - push(0.8 - 2 * h)[0])) / (12 * h)
        for h in (1e-3, 2e-3)
    )
    assert low == pytest.approx(float(high), rel=1e-8)
    assert stiffness == pytest.approx(float(low), rel=1e-8)


def test_rotate():
    turned = rotate(frame((1, 0, 0)), (0.0, 0.0, np.pi / 2))
    np.testing.assert_allclose(turned[:, 2], (0, 1, 0), atol=1e-15)
    tiny = rotate(jnp.eye(3), (0.0, 0.00999, 0.0)), rotate(jnp.eye(3), (0.0, 0.01001, 0.0))
    # On both sides of where the series takes over.
    for matrix, angle in zip(tiny, (0.00999, 0.01001), strict=True):
        np.testing.assert_allclose(matrix[0], (np.cos(angle), 0, np.sin(angle)), rtol=1e-14)
    generator = jax.jacobian(lambda vector: rotate(jnp.eye(3), vector))(jnp.zeros(3))
    np.testing.assert_array_equal(generator[..., 2], [[0, -1, 0], [1, 0, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match="rotation_vector must be numbers of shape"):
        rotate(np.eye(3), (1, 2))
