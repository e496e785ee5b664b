"""Index, softest motion, neutral turns, and saddles that are kept or left."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scenes import loaded_scenes

import rodjax as rj
from rodjax import Clamp, Free, Guess, Pin, Rod, Scene, frame
from rodjax.solving.result_form import form_and_point, over_leading_axes

EI = 2.0
X, Z = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
STRAIGHT = Guess(np.linspace((0.0, 0.0, 0.0), X, 5))


def rod(EA: float = 2e8) -> Rod:
    return Rod(1.0, EI, 1.5, EA, mass_per_length=1.0)


def strut(load: float) -> rj.Equilibrium:
    """Straight between pins under a thrust [N], whether that is stable or not."""
    short = load / 2e8
    scene = Scene(rod(), Pin((0.0, 0.0, 0.0)), Pin((1 - short, 0.0, 0.0)))
    return rj.solve(scene, segments=24, guess=STRAIGHT, find="equilibrium")


@pytest.mark.parametrize(("load", "index"), [(10.0, 0), (19.0, 0), (25.0, 2), (90.0, 4)])
def test_a_strut_loses_the_stiffness_by_which_it_is_pressed(load, index):
    """Euler: bending in n half waves becomes unstable at n^2 pi^2 EI/L^2, 19.7 and 79 N, in both planes at once."""
    straight = strut(load)
    assert straight.converged
    assert straight.index == index
    assert bool(straight.stable) == (index == 0)
    mode = rj.lowest_mode(straight)
    # The mesh error of 24 elements, 4e-7 of the load and of pi^2 EI/L^2.
    assert mode.stiffness == pytest.approx(np.pi**2 * EI - load, abs=1e-6 * (load + 20))
    sizes = np.linalg.norm(mode.displacement, axis=1)
    np.testing.assert_allclose(sizes, np.sin(np.pi * straight.s), atol=2e-6)


def test_a_motion_out_of_the_plane_counts():
    """The planar shape of a pressed strut in gravity, held in its plane, may be soft sideways."""
    scene = Scene(rod(), Clamp((0, 0, 0), frame(X)), Clamp((0.8, 0, 0), frame(X)), gravity=(0, 0, -9.81))
    result = rj.solve(scene, segments=24, planar=True, find="equilibrium")
    mode = rj.lowest_mode(result)
    assert np.max(np.abs(mode.displacement[:, 1])) == pytest.approx(1.0, abs=1e-6)
    assert np.max(np.abs(mode.displacement[:, [0, 2]])) < 1e-6


def dense(result: rj.Equilibrium) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The bordered Hessian as one dense matrix, zeros for its multipliers, and the length of rod of each other row."""
    form, point = form_and_point(result)
    here = form.linearized(point)
    b, k, m = here.system.border.shape
    f, c = jax.vmap(lambda x: here.system.times(x[: b * m].reshape(b, m), x[b * m :]))(jnp.eye(b * m + k))
    lengths = form.field.weights * jnp.sum(here.bases**2, axis=(0, 1)) / b
    return jnp.concatenate([f.reshape(b * m + k, -1), c], axis=1), jnp.zeros(k), jnp.tile(lengths, b)


# Each kind of support with one of the two; the other five repeat them.
OF_EACH = [
    ("clamps", "hermite"),
    ("pins", "hermite"),
    ("clamp-swivel", "finite_difference"),
    ("cantilever", "finite_difference"),
    ("free start", "hermite"),
]
OTHERS = [(name, "hermite" if other == "finite_difference" else "finite_difference") for name, other in OF_EACH]


@pytest.mark.parametrize(
    ("name", "discretization"), [*OF_EACH, *(pytest.param(*of, marks=pytest.mark.exhaustive) for of in OTHERS)]
)
def test_the_lowest_eigenvalue_is_that_of_the_dense_matrix(name, discretization):
    result = rj.solve(loaded_scenes()[name], segments=10, discretization=discretization)
    matrix, multipliers, lengths = (np.asarray(x) for x in by_numpy(dense)(result))
    free = lengths > 0
    scale = 1 / np.sqrt(lengths[free])
    n = len(lengths)
    border, compliance = matrix[:n, n:][free] * scale[:, None], -matrix[n:, n:]
    # A stretched rod is soft in all multipliers but the one across its plane, if it has one; that one is a constraint.
    values, vectors = np.linalg.eigh(compliance) if len(multipliers) else (np.zeros(0), np.zeros((0, 0)))
    border = border @ vectors
    hessian = matrix[:n, :n][np.ix_(free, free)] * np.outer(scale, scale)
    held = border[:, values < 1e-14]
    for value, column in zip(values[values >= 1e-14], border[:, values >= 1e-14].T, strict=True):
        hessian += np.outer(column, column) / value
    if held.size:
        rest = np.linalg.qr(held, mode="complete")[0][:, held.shape[1] :]
        hessian = rest.T @ hessian @ rest
    lowest = np.linalg.eigvalsh(hessian)[0]
    unit = float(result.scene.rod.EI / result.scene.rod.length**2)
    # Rounding of the largest eigenvalues, EA/h^2 and 1e5 to 1e7 here.
    assert rj.lowest_mode(result).stiffness / unit == pytest.approx(lowest, rel=1e-7, abs=1e-8)
    assert result.index == 0


def test_between_coaxial_clamps_a_bent_rod_is_neutral():
    coaxial = Scene(rod(), Clamp((0, 0, 0), frame(X)), Clamp((0.6, 0, 0), frame(X)))
    result = rj.solve(coaxial, segments=16)
    assert result.converged
    assert result.stable
    assert result.neutral
    assert not result.critical
    assert "neutral: the whole rod can turn" in rj.describe(result)
    assert abs(rj.lowest_mode(result).stiffness) < 1e-6 * EI
    tilted = rj.solve(Scene(rod(), Clamp((0, 0, 0), frame(X)), Clamp((0.6, 0, 0), frame((1, 0, 0.1)))), segments=16)
    assert not tilted.neutral
    assert rj.lowest_mode(tilted).stiffness > 1e-3 * EI


def test_a_saddle_is_left_or_kept():
    """A strut beyond Euler's load, begun straight: by default it buckles, with less energy; or it stays."""
    scene = Scene(rod(), Pin((0, 0, 0)), Pin((0.9, 0, 0)))
    # The straight strut is pressed by a tenth.
    options = dict(segments=24, guess=STRAIGHT, strain_limit=None)
    down, kept = (rj.solve(scene, find=find, **options) for find in ("minimum", "equilibrium"))
    assert down.stable
    assert down.index == 0
    assert kept.converged
    assert not kept.stable
    assert kept.index > 0
    assert "a saddle" in rj.describe(kept)
    assert down.energy < kept.energy
    again = rj.solve(scene, segments=24, guess=STRAIGHT)
    np.testing.assert_array_equal(again.nodes, down.nodes)


def test_find_equilibrium_agrees_where_there_is_a_minimum():
    scene = loaded_scenes()["clamps"]
    minimum = rj.solve(scene, segments=10)
    changed = rj.Scene(scene.rod, scene.start, scene.end, (0.0, 4.0, -9.81), scene.point_forces)
    kept, sought = (rj.solve(changed, segments=10, guess=minimum, find=find) for find in ("equilibrium", "minimum"))
    assert kept.stable
    # Both to a residual of 1e-8 EI/L^2.
    np.testing.assert_allclose(kept.nodes, sought.nodes, atol=1e-9)


def test_paths_and_batches_keep_saddles_too():
    scenes = [Scene(rod(), Pin((0, 0, 0)), Pin((1 - load / 2e8, 0, 0))) for load in (18.0, 22.0, 26.0)]
    path = rj.solve_path(scenes, segments=24, guess=STRAIGHT, find="equilibrium")
    batch = rj.solve_batch(scenes, segments=24, guess=STRAIGHT, find="equilibrium")
    for results in (path, batch):
        assert results.index.tolist() == [0, 2, 2]
        assert results.stable.tolist() == [True, False, False]
    assert rj.lowest_mode(path).stiffness.shape == (3,)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda scene: rj.solve(scene, find="saddle"), "find must be 'minimum' or 'equilibrium', got 'saddle'"),
        (
            lambda scene: rj.solve(scene, solver=rj.NonlinearCG(), find="equilibrium"),
            "solver must be a Newton where find is 'equilibrium'",
        ),
    ],
)
def test_find_is_checked(call, message):
    with pytest.raises(ValueError, match=message):
        call(Scene(rod(), Clamp((0, 0, 0), frame(X)), Free()))


def test_lowest_mode_is_checked():
    with pytest.raises(TypeError, match="equilibrium must be an Equilibrium"):
        rj.lowest_mode(5)  # pyright: ignore[reportArgumentType]
    twisted = rj.solve(loaded_scenes()["end moment"], segments=10)
    assert twisted.index == -1
    with pytest.raises(
        ValueError, match="dead moments on a free end, couples along the rod and follower loads have none"
    ):
        rj.lowest_mode(twisted)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::rodjax.NotConvergedWarning")
def test_the_index_is_that_of_dense_eigenvalues():
    """In 1000 random scenes, at saddles too: where no eigenvalue is near zero, without exception."""
    generator = np.random.default_rng(5)
    spans = generator.uniform(0.1, 0.99, 1000)
    tilts = generator.uniform(-0.5, 0.5, (1000, 3))

    def scene(span, tilt):
        return Scene(rod(), Clamp(jnp.zeros(3), rj.rotate(frame(X), tilt)), Clamp(span * jnp.array(X), frame(X)))

    scenes = jax.vmap(scene)(jnp.asarray(spans), jnp.asarray(tilts))
    results = rj.solve_batch(scenes, segments=8, guess=STRAIGHT, find="equilibrium")
    matrices, multipliers, _ = over_leading_axes(dense)(results)
    looked_at = 0
    for matrix, index, converged in zip(np.asarray(matrices), results.index, results.converged, strict=True):
        if not converged:
            continue
        values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
        # The shift of the factorisation by 1e-6, and rounding of the largest eigenvalue.
        if np.min(np.abs(values)) < max(1e-5 / len(values), 1e-14 * np.max(np.abs(values))):
            continue
        looked_at += 1
        assert index == np.sum(values < 0) - multipliers.shape[1]
    assert looked_at > 500
    assert set(np.unique(results.index)) >= {0, 1}
