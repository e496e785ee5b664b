"""Saddle-point systems by block cyclic reduction, against dense solves and eigenvalues."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy_programs import by_numpy

import rodjax as rj
from rodjax.linalg.bordered import BorderedFactors, Vectors
from rodjax.linalg.chain import ChainSystem, Elimination
from rodjax.linalg.chain_border import Border
from rodjax.linalg.chain_factors import ChainFactors
from rodjax.linalg.chain_rows import ContactRows, InnerRows, LoadRows
from rodjax.linalg.far_rows import FarRows
from rodjax.linalg.saddle_point import SaddlePointSystem, factor, factor_and_solve
from rodjax.linalg.small_matrices import inverse_matrix, negative_count
from rodjax.linalg.substitution import substituted
from rodjax.solving.result_form import form_and_point


def random_system(n: int, b: int, k: int, *, dominance: float = 8.0, seed: int = 0) -> SaddlePointSystem:
    """Positive definite by diagonal dominance; indefinite, mostly, without."""
    rng = np.random.default_rng(seed)
    diagonal, compliance = rng.normal(size=(b, b, n)), rng.normal(size=(k, k))
    return SaddlePointSystem(
        jnp.asarray(diagonal + diagonal.swapaxes(0, 1) + dominance * np.eye(b)[..., None]),
        jnp.asarray(rng.normal(size=(b, b, n - 1))),
        jnp.asarray(rng.normal(size=(b, k, n))),
        jnp.asarray(compliance @ compliance.T),
    )


def right_side(n: int, b: int, k: int, seed: int = 1) -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.normal(size=(b, n))), jnp.asarray(rng.normal(size=k))


def dense(system: SaddlePointSystem) -> np.ndarray:
    """The whole matrix, unknowns in the order x[:, 0], x[:, 1], ..., y."""
    b, k, n = system.border.shape
    matrix = np.zeros((n, b, n, b))
    for i in range(n):
        matrix[i, :, i] = system.diagonal[..., i]
    for i in range(n - 1):
        matrix[i + 1, :, i] = system.lower[..., i]
        matrix[i, :, i + 1] = np.asarray(system.lower[..., i]).T
    if system.across is not None:
        for i in range(n // 2):
            matrix[2 * i + 2, :, 2 * i] = system.across[..., i]
            matrix[2 * i, :, 2 * i + 2] = np.asarray(system.across[..., i]).T
    border = np.asarray(system.border).transpose(2, 0, 1).reshape(n * b, k)
    return np.block([[matrix.reshape(n * b, n * b), border], [border.T, -np.asarray(system.compliance)]])


factored = by_numpy(factor)
at_once = by_numpy(factor_and_solve)
afterwards = by_numpy(lambda system, f, c: factor(system).solve(f, c))


# All depths of the elimination up to five, odd and even; more columns than unknowns.
SIZES = [(1, 1, 0), (1, 2, 4), (2, 1, 2), (2, 2, 1), (3, 2, 4), (4, 2, 0), (5, 1, 3), (5, 3, 3), (6, 3, 0)]
SIZES += [(16, 2, 4), (17, 3, 3), (33, 2, 3)]


@pytest.mark.parametrize(("n", "b", "k"), SIZES)
def test_solutions_and_signs_agree_with_dense_matrices(n, b, k):
    """Definite, and three indefinite systems."""
    f, c = right_side(n, b, k)
    for seed, dominance in enumerate([8.0, 0.0, 0.0, 0.0]):
        system = random_system(n, b, k, dominance=dominance, seed=seed)
        matrix = dense(system)
        expected = np.linalg.solve(matrix, np.concatenate([f.T.ravel(), c]))
        factors, *solution = at_once(system, f, c)
        # Definite: solutions of order 1, condition numbers below 1e3. Otherwise a small block, as blocks are not
        # exchanged for larger ones, costs some digits.
        atol = 1e-12 if dominance else 1e-10
        for x, y in (solution, afterwards(system, f, c)):
            np.testing.assert_allclose(x, expected[: b * n].reshape(n, b).T, rtol=0, atol=atol)
            np.testing.assert_allclose(y, expected[b * n :], rtol=0, atol=atol)
        negative = np.sum(np.linalg.eigvalsh(matrix) < 0) - k
        assert factors.negative == negative
        assert factors.is_minimum == (negative == 0)


def test_a_minimum_under_the_constraints_may_be_indefinite_without_them():
    system = random_system(7, 2, 1)
    dipped = SaddlePointSystem(
        diagonal=system.diagonal.at[0, 0, 3].add(-40.0),
        lower=system.lower,
        border=jnp.zeros((2, 1, 7)).at[0, 0, 3].set(1.0),  # holds the one unknown with negative curvature
        compliance=jnp.zeros((1, 1)),
    )
    assert np.linalg.eigvalsh(dense(dipped)[:14, :14])[0] < 0
    assert factored(dipped).is_minimum
    alone = SaddlePointSystem(dipped.diagonal, dipped.lower, jnp.zeros((2, 0, 7)), jnp.zeros((0, 0)))
    assert factored(alone).negative == 1


@pytest.mark.parametrize("block", [[[0.0, 0.0], [0.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]])
def test_a_singular_block_does_no_harm(block):
    """It is made stiffer by 2e-7 of the mean diagonal, where it goes first, of which the random matrix makes 1e-3."""
    system = random_system(7, 2, 1)
    f, c = right_side(7, 2, 1)
    for where in (0, 2, 4, 6):
        coupled = dataclasses.replace(system, diagonal=system.diagonal.at[..., where].set(jnp.array(block)))
        matrix = dense(coupled)
        factors, x, y = at_once(coupled, f, c, is_regularized=True)
        assert factors.negative == np.sum(np.linalg.eigvalsh(matrix) < 0) - 1
        truth = np.linalg.solve(matrix, np.concatenate([f.T.ravel(), c]))
        np.testing.assert_allclose(np.concatenate([x.T.ravel(), y]), truth, rtol=0, atol=1e-3 * np.max(np.abs(truth)))


@pytest.mark.parametrize("span", [0.0, 0.3])
def test_a_rod_that_can_turn_as_a_whole_is_solved_to_many_digits(span):
    """Between clamps on one line a bent rod turns freely, and so do both halves of a loop, in the middle of which the
    tangent points along that line, and each half of a ring: these pivots are as soft as the shift, where the others
    are 1e7 times as stiff. Beside the turn the solution is to have its digits, and the inertia is to be that of the
    whole matrix.
    """
    clamps = [rj.Clamp((x, 0.0, 0.0), rj.frame((1.0, 0.0, 0.0))) for x in (0.0, span)]
    loop = rj.Guess(np.zeros((17, 3)))
    result = rj.solve(rj.Scene(rj.Rod(1.0, 1.0, 0.7, 1e4), *clamps), segments=16, guess=loop if span else None)
    assert result.stable
    assert result.neutral

    @by_numpy
    def seen(result, shift):
        form, point = form_and_point(result)
        system = form.linearized(point).system.shifted(shift / 33)
        factors = factor(system, is_regularized=True)
        return system, factors.negative, factors.border_solution

    for shift in (1e-6, 1e-5, -1e-3):  # the last one beyond what soft pivots are made stiffer by
        system, negative, solution = seen(result, jnp.asarray(shift))
        matrix = dense(system)
        k = system.border.shape[1]
        assert negative == np.sum(np.linalg.eigvalsh(matrix) < 0) - k
        size = len(matrix) - k
        truth = np.linalg.solve(matrix[:size, :size], matrix[:size, size:])
        # eps/(shift/33) of the matrix of size 200, and what soft pivots differ by, 1e-6; 0.5 was seen.
        error = np.asarray(solution).transpose(2, 0, 1).reshape(size, k) - truth
        values, motions = np.linalg.eigh(matrix[:size, :size])
        softest = motions[:, np.argmin(np.abs(values))]  # of which there is as much as there happens to be
        np.testing.assert_allclose(error - np.outer(softest, softest @ error), 0.0, atol=1e-5)


def test_a_shift_is_added_to_the_diagonal_only():
    system = random_system(5, 2, 2)
    shift = np.diag([0.7] * 10 + [0.0] * 2)
    np.testing.assert_array_equal(dense(system.shifted(jnp.array(0.7))), dense(system) + shift)


@jax.jit
def solution(system: SaddlePointSystem, f: jax.Array, c: jax.Array) -> jax.Array:
    x, y = factor(system).solve(f, c)
    return jnp.concatenate([x.T.ravel(), y])


@pytest.mark.parametrize(("n", "k"), [(1, 1), (6, 3)])
def test_other_rows_than_columns_give_the_solution_of_the_unsymmetric_matrix(n, k):
    system = random_system(n, 2, k)
    rows = random_system(n, 2, k, seed=5).border
    matrix = dense(system)
    matrix[2 * n :, : 2 * n] = np.asarray(rows).transpose(1, 2, 0).reshape(k, 2 * n)
    f, c = right_side(n, 2, k)
    expected = np.linalg.solve(matrix, np.concatenate([f.T.ravel(), c]))
    system = SaddlePointSystem(system.diagonal, system.lower, system.border, system.compliance, rows)
    # Solutions of order 1, condition numbers below 1e3.
    np.testing.assert_allclose(solution(system, f, c), expected, rtol=0, atol=1e-12)
    factors, x, y = at_once(system, f, c)
    np.testing.assert_allclose(jnp.concatenate([x.T.ravel(), y]), expected, rtol=0, atol=1e-12)
    assert factors.negative == 0  # the sign of a curvature has no meaning without symmetry


def test_vmap_agrees_with_one_after_another():
    systems = [random_system(6, 2, 4, seed=seed) for seed in range(3)]
    sides = [right_side(6, 2, 4, seed=seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *systems)
    f, c = (jnp.stack(side) for side in zip(*sides, strict=True))
    batched = jax.vmap(solution)(stacked, f, c)
    for k in range(3):
        # Other loops, so other roundings; solutions of order 1.
        np.testing.assert_allclose(batched[k], solution(systems[k], *sides[k]), rtol=0, atol=1e-14)


def test_derivatives_of_a_solution():
    system = random_system(5, 2, 2)

    def of_symmetric(diagonal, lower, border, compliance, f, c):
        diagonal, compliance = ((x + jnp.swapaxes(x, 0, 1)) / 2 for x in (diagonal, compliance))
        return solution(SaddlePointSystem(diagonal, lower, border, compliance), f, c)

    arguments = (system.diagonal, system.lower, system.border, system.compliance, *right_side(5, 2, 2))
    # Against central differences, which give about 1e-5 relative.
    check_grads(jax.jit(lambda *given: of_symmetric(*map(jnp.asarray, given))), arguments, order=1, rtol=1e-5)


@pytest.mark.parametrize(
    "shapes",
    [
        [(2, 2, 3), (2, 2, 3), (2, 1, 3), (1, 1)],
        [(2, 2, 4), (2, 2, 2), (2, 1, 3), (1, 1)],
        [(2, 2, 3), (2, 2, 2), (2, 1, 3), (2, 2)],
        [(4, 4, 3), (4, 4, 2), (4, 1, 3), (1, 1)],
    ],
)
def test_wrong_shapes_are_named(shapes):
    message = r"shapes \(b, b, n\), .* with b = 1 to 3, got " + ", ".join(rf"\({str(s)[1:-1]}\)" for s in shapes)
    with pytest.raises(ValueError, match=message):
        SaddlePointSystem(*map(jnp.zeros, shapes))


def random_chain(elements: int, seed: int = 0) -> ChainSystem:
    """Of elements between nodes of which three are held; two obstacles touch some of the others, all are pushed."""
    rng = np.random.default_rng(seed)
    m = 2 * elements + 1
    diagonal = rng.normal(size=(2, 2, m))
    compliance = rng.normal(size=(3, 3, elements))
    held = np.isin(np.arange(elements + 1), (0, elements // 2, elements))
    free = np.where(held, 0.0, 1.0)[:, None]
    stiffness = rng.normal(size=(elements + 1, 3, 3)) * free[..., None]
    is_closed = (np.arange(2 * (elements + 1)).reshape(2, -1) % 3 == 1) & ~held[None]
    normals = rng.normal(size=(2, elements + 1, 3)) * free
    return ChainSystem(
        jnp.asarray(diagonal + diagonal.transpose(1, 0, 2)),
        *(jnp.asarray(rng.normal(size=shape)) for shape in ((2, 2, m - 1), (2, 2, elements), (2, 1, m))),
        jnp.full((1, 1), 0.3),
        jnp.asarray(rng.normal(size=(2, 3, 3, elements))),
        jnp.asarray(np.einsum("ijn,kjn->ikn", compliance, compliance) / 10),
        jnp.asarray(stiffness + stiffness.transpose(0, 2, 1)),
        ContactRows(jnp.asarray(normals), jnp.asarray(1e-5), jnp.asarray(is_closed)),
        jnp.asarray(held),
        turning=jnp.asarray(rng.normal(size=(2, 3, elements + 1)) / 2),
    )


def with_inner_contacts(system: ChainSystem) -> ChainSystem:
    """And with a third obstacle that touches every second element, and what couples both nodes of each element beside
    it.
    """
    rng = np.random.default_rng(3)
    elements = system.across.shape[-1]
    free = np.where(system.held, 0.0, 1.0)
    by_position = rng.normal(size=(1, 3, 2, elements)) * np.stack([free[:-1], free[1:]])
    inner = InnerRows(jnp.asarray(rng.normal(size=(1, 2, 2, elements))), jnp.asarray(by_position), 2)
    contacts = system.contacts
    is_closed = np.append(np.arange(elements) % 2 == 0, False)[None]
    contacts = ContactRows(
        jnp.pad(contacts.normals, ((0, 1), (0, 0), (0, 0))),
        contacts.contact_compliance,
        jnp.concatenate([contacts.is_closed, jnp.asarray(is_closed)]),
        inner=inner,
    )
    blocks = rng.normal(size=(10, 10, elements)) / 10
    moves = np.concatenate([np.ones((2, elements)), np.tile(free[:-1], (3, 1))])
    moves = np.concatenate([moves, np.ones((2, elements)), np.tile(free[1:], (3, 1))])
    blocks = (blocks + blocks.transpose(1, 0, 2)) * moves[:, None] * moves[None]
    return dataclasses.replace(system, contacts=contacts).with_elements(jnp.asarray(blocks))


def with_far_contacts(system: ChainSystem) -> ChainSystem:
    """And with three contacts between elements, two of which touch, whose curvature couples these."""
    rng = np.random.default_rng(4)
    elements = system.across.shape[-1]
    first, second = np.array([0, 1, 1]), np.array([2, 3, elements - 1])
    nodes = np.stack([first, first + 1, second, second + 1])
    by_position = rng.normal(size=(5, 3, 4, 3)) * np.where(system.held, 0.0, 1.0)[nodes]
    scale = np.array([1.0, 0.3, 0.3, 0.3, 0.3])[:, None, None, None]
    far = FarRows(
        jnp.asarray(rng.normal(size=(5, 2, 4, 3)) * scale),
        jnp.asarray(by_position * scale),
        jnp.asarray(nodes),
        jnp.asarray([2, 0, 1]),
        2,
    )
    contacts = system.contacts
    is_closed = np.isin(np.arange(elements + 1), (0, 2))[None]
    contacts = ContactRows(
        jnp.pad(contacts.normals, ((0, 1), (0, 0), (0, 0))),
        contacts.contact_compliance,
        jnp.concatenate([contacts.is_closed, jnp.asarray(is_closed)]),
        far=far,
    )
    return dataclasses.replace(system, contacts=contacts)


def with_open_contacts(system: ChainSystem, count: int) -> ChainSystem:
    """And behind those three so many open ones, without curvature."""
    system = with_far_contacts(system)
    far = system.contacts.far
    assert far is not None
    rng = np.random.default_rng(5)
    nodes = rng.integers(0, len(system.held), (4, count))
    by_rotation, by_position = (np.zeros((5, size, 4, count)) for size in (2, 3))
    by_rotation[0], by_position[0] = rng.normal(size=(2, 4, count)), rng.normal(size=(3, 4, count))
    by_position[0] *= np.where(system.held, 0.0, 1.0)[nodes]
    far = FarRows(
        jnp.concatenate([far.by_rotation, jnp.asarray(by_rotation)], axis=-1),
        jnp.concatenate([far.by_position, jnp.asarray(by_position)], axis=-1),
        jnp.concatenate([far.nodes, jnp.asarray(nodes)], axis=-1),
        jnp.append(far.elements, 3 + jnp.arange(count)),
        far.row,
    )
    return dataclasses.replace(system, contacts=dataclasses.replace(system.contacts, far=far))


def random_loads(elements: int) -> LoadRows:
    rng = np.random.default_rng(7)
    shapes = ((2, 3, 2, 3, elements), (3, 2, 3, elements), (2, 3, 2, 3, elements))
    return LoadRows(*(jnp.asarray(rng.normal(size=shape)) for shape in shapes))


@pytest.mark.parametrize("elements", [4, 7])
@pytest.mark.parametrize("elimination", Elimination, ids=lambda elimination: elimination.name)
@pytest.mark.parametrize("loads", [None, random_loads])
@pytest.mark.parametrize("others", [None, with_inner_contacts, with_far_contacts])
def test_chains_are_solved_and_their_signs_counted(elements, elimination, loads, others):
    """Also with loads that have no potential, without symmetry, and with contacts within and between elements."""
    random = random_chain(elements)
    system = dataclasses.replace(random, loads=loads and loads(elements), elimination=elimination)
    check_chain(system if others is None else others(system))


def test_a_chain_with_two_free_ends_is_solved():
    """Of which nothing holds or touches the first node, that has a pivot with the force of the element beyond it."""
    system = random_chain(7)
    nothing = ContactRows(
        jnp.zeros_like(system.contacts.normals), jnp.asarray(1e-5), jnp.zeros_like(system.contacts.is_closed)
    )
    held, ends = jnp.arange(8) == 3, jnp.array([0, -1])
    stiffness = system.stiffness.at[ends].set(0.0)
    turning = system.turning.at[..., ends].set(0.0)
    changed = {"held": held, "stiffness": stiffness, "turning": turning, "contacts": nothing}
    check_chain(dataclasses.replace(system, elimination=Elimination.WITH_FORCES, **changed))


@pytest.mark.parametrize("is_closed", [False, True])
def test_of_contacts_between_elements_those_that_are_needed_are_solved_for(is_closed):
    """Of twenty three, with the first sixteen, and all where the last one is closed."""
    system = with_open_contacts(random_chain(20), 17)
    closed = system.contacts.is_closed.at[2, 19].set(is_closed)
    check_chain(system.closed_where(closed))


def check_chain(system: ChainSystem):
    """Against its matrix."""
    elements, loads = system.across.shape[-1], system.loads
    pressures = system.contacts.is_closed.size
    m, multipliers = 2 * elements + 1, 1 + pressures + 3 * (elements + 1) + 3 * elements

    def column(unit):
        f, c = system.times(unit[: 2 * m].reshape(2, m), unit[2 * m :])
        return jnp.concatenate([f.reshape(-1), c])

    matrix = np.array(by_numpy(jax.vmap(column))(jnp.eye(2 * m + multipliers))).T
    assert np.allclose(matrix, matrix.T, rtol=1e-13, atol=1e-13) == (loads is None)  # roundings
    right = np.random.default_rng(1).normal(size=len(matrix))
    factors = factored(system)
    assert isinstance(factors, ChainFactors)
    given = jnp.asarray(right[: 2 * m].reshape(2, m)), jnp.asarray(right[2 * m :])
    rows = np.arange(2 * m + 1, 2 * m + 1 + pressures)
    # As soft as 1e-5, and as if they were hard.
    hard = np.array(matrix)
    hard[rows, rows] += np.where(np.ravel(system.contacts.is_closed), 1e-5, 0.0)
    for solve, full in ((factors.solve_softly, matrix), (factors.solve, hard)):
        found, truth = np.concatenate([np.ravel(x) for x in by_numpy(solve)(*given)]), np.linalg.solve(full, right)
        is_pressure = np.isin(np.arange(len(found)), rows)
        # The contacts, of 1e5, cost the dense solve some digits; a pressure is a difference over its compliance.
        np.testing.assert_allclose(found[~is_pressure], truth[~is_pressure], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(found[is_pressure], truth[is_pressure], rtol=1e-6, atol=1e-6)
    if loads is not None:
        assert factors.negative == 0  # the sign of a curvature has no meaning without symmetry
        return
    # A pressure is one negative eigenvalue, whether its contact is closed or open.
    assert int(factors.negative) == np.sum(np.linalg.eigvalsh(matrix) < 0) - 1 - pressures - 3 * elements
    assert int(factors.negative) > 0


@pytest.mark.parametrize("size", [1, 2, 9, 33])
def test_negative_eigenvalues_are_counted(size):
    """Of matrices whose eigenvalues are known, over 16 orders, a singular one and one of zeros among them."""
    generator = np.random.default_rng(size)
    values = generator.choice([-1.0, 1.0], (40, size)) * 10.0 ** generator.uniform(-4, 12, (40, size))
    bases = np.linalg.qr(generator.normal(size=(40, size, size)))[0]
    diagonal = np.eye(size) * values[:, :, None]
    # Roundings are 1e-16 of the largest eigenvalue: smaller ones are kept apart from it by a diagonal matrix.
    mixed = np.where(
        (np.abs(values).min(1) > 1e-12 * np.abs(values).max(1))[:, None, None],
        bases @ diagonal @ bases.swapaxes(1, 2),
        diagonal,
    )
    mixed = np.concatenate([(mixed + mixed.swapaxes(1, 2)) / 2, np.zeros((1, size, size))])
    assert int(jax.jit(negative_count)(jnp.asarray(mixed))) == np.sum(values < 0)
    assert int(negative_count(jnp.asarray(np.diag(np.r_[0.0, -np.ones(size - 1)])[None]))) == size - 1
    # Eigenvalues 2 cos(k pi/(size + 1)): pivots that are exactly zero stand before others.
    path = np.eye(size, k=1) + np.eye(size, k=-1)
    assert int(jax.jit(negative_count)(jnp.asarray(path[None]))) == size // 2
    # Of pivots that are not quite symmetric the lower triangle counts.
    lost = np.triu(generator.normal(size=mixed.shape), 1)
    assert int(jax.jit(negative_count)(jnp.asarray(mixed + lost))) == np.sum(values < 0)


# --- borders that may be full ----------------------------------------------------------------------------------------


def test_inverses_and_their_derivatives():
    """Also where pivots are exchanged, stacked along other axes, and twice differentiated."""
    matrices = jnp.asarray(np.random.default_rng(0).normal(size=(6, 3, 3)))
    matrices = matrices.at[0, 0, 0].set(0.0)
    found = jax.jit(inverse_matrix)(matrices)
    np.testing.assert_allclose(found @ matrices, np.broadcast_to(np.eye(3), (6, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(jax.vmap(inverse_matrix, in_axes=2, out_axes=2)(matrices.transpose(1, 2, 0)).T.mT, found)
    for order in (jax.jacfwd, jax.jacrev, lambda f: jax.jacfwd(jax.jacrev(f))):
        both = [order(inverse)(matrices[0]) for inverse in (inverse_matrix, jnp.linalg.inv)]
        np.testing.assert_allclose(*both, rtol=1e-10, atol=1e-10 * float(jnp.max(jnp.abs(both[1]))))


def test_substitution_from_node_to_node_and_its_derivatives():
    """Beside the matrix that it is the inverse of; stacked, for several right sides, both ways."""
    rng = np.random.default_rng(0)
    couplings, right = jnp.asarray(rng.normal(size=(2, 4, 3, 3))), jnp.asarray(rng.normal(size=(2, 5, 3)))

    def matrix(couplings: jax.Array, backward: bool) -> jax.Array:
        full = jnp.eye(15).reshape(5, 3, 5, 3)
        for k in range(4):
            here, beside = (k, k + 1) if backward else (k + 1, k)
            full = full.at[here, :, beside].add(couplings[k])
        return full.reshape(15, 15)

    for backward in (False, True):

        def by_loop(couplings: jax.Array, right: jax.Array, backward: bool = backward) -> jax.Array:
            return substituted(couplings, right[..., None], backward=backward)[..., 0]

        def by_matrix(couplings: jax.Array, right: jax.Array, backward: bool = backward) -> jax.Array:
            return jnp.linalg.solve(matrix(couplings, backward), right.reshape(-1)).reshape(5, 3)

        stacked = jax.vmap(by_matrix)(couplings, right)
        # Sums of products of five numbers of order 1, which grow to 50 along the nodes: roundings of 1e-14.
        np.testing.assert_allclose(by_loop(couplings, right), stacked, rtol=0, atol=1e-13)
        np.testing.assert_allclose(jax.vmap(by_loop)(couplings, right), stacked, rtol=0, atol=1e-13)
        np.testing.assert_allclose(by_numpy(jax.vmap(by_loop))(couplings, right), stacked, rtol=0, atol=1e-13)
        many = jax.vmap(by_loop, (None, 2), 2)(couplings[0], jnp.moveaxis(right, 0, 2))
        np.testing.assert_allclose(many[..., 0], stacked[0], rtol=0, atol=1e-13)
        shared = jax.vmap(by_loop, (0, None))(couplings, right[0])
        np.testing.assert_allclose(shared[1], by_matrix(couplings[1], right[0]), rtol=0, atol=1e-13)
        for order in (jax.jacfwd, jax.jacrev):
            for k in range(2):
                both = [order(function, k)(couplings[0], right[0]) for function in (by_loop, by_matrix)]
                np.testing.assert_allclose(*both, rtol=0, atol=1e-11)


@pytest.mark.parametrize("size", [1, 2, 9, 16, 17])
def test_inverses_of_all_sizes(size):
    """Also where each row is exchanged, over 8 orders; a singular matrix has none, and one beside it is not changed."""
    rng = np.random.default_rng(size)
    orders = 10.0 ** rng.uniform(-4, 4, (5, size, 1))
    matrices = orders * (np.eye(size)[::-1] + 0.3 * rng.normal(size=(5, size, size)) / size)
    matrices[1], matrices[2] = 0.0, np.eye(size)[rng.permutation(size)]
    found = np.asarray(jax.jit(inverse_matrix)(matrices))
    assert not np.isfinite(found[1]).any()
    assert jax.jit(inverse_matrix)(matrices[:0]).shape == (0, size, size)
    assert jax.jit(inverse_matrix)(matrices[:, :0, :0]).shape == (5, 0, 0)
    for k in (0, 2, 3, 4):
        # Roundings of 1e-16, times the condition of some 1e3 of rows of one order, which a row's order does not change.
        np.testing.assert_allclose(found[k] @ matrices[k], np.eye(size), atol=1e-11)


def complemented(complement: jax.Array) -> BorderedFactors:
    return BorderedFactors(None, Vectors(*2 * [jnp.zeros(0)]), Vectors(*2 * [jnp.zeros(0)]), complement, False)


@pytest.mark.parametrize("j", [1, 2, 4])
def test_pivots_of_a_complement_tell_where_it_is_singular(j):
    """Of symmetric ones they count negative eigenvalues; of others the parity is that of the determinant."""
    rng = np.random.default_rng(j)
    for _ in range(20):
        matrix = rng.normal(size=(j, j))
        symmetric = complemented(jnp.asarray(matrix + matrix.T))
        assert symmetric.below_by_pivots == symmetric.below == np.sum(np.linalg.eigvalsh(matrix + matrix.T) < 0)
        assert (-1) ** int(complemented(jnp.asarray(matrix)).below_by_pivots) == np.sign(np.linalg.det(matrix))


def test_borders_side_by_side_with_other_contacts_in_need():
    """Together they are inverted with the contacts that one of them needs: none, a few, all."""
    rng, p, k = np.random.default_rng(5), 20, 2

    def border(needed: int) -> tuple[Border, np.ndarray]:
        is_needed = np.arange(p) < needed
        vectors = rng.normal(size=(5, 7, 4, p)) * is_needed
        far = FarRows(*map(jnp.asarray, (vectors[:, :4], vectors[:, 4:], np.zeros((4, p), int), np.arange(p))), row=0)
        compliance = jnp.asarray(np.diag([-1.0, -2.0]))
        found = Border(jnp.zeros((4, k, 9)), compliance, far, jnp.asarray(is_needed), jnp.asarray(0.1))
        parts = rng.normal(size=(found.size, found.size)) / found.size
        parts *= np.concatenate([np.ones(k, bool), np.repeat(is_needed, 5)])
        return found, parts.T @ parts * 5 - np.asarray(found.whole_compliance())

    borders, matrices = zip(*(border(needed) for needed in (0, 3, p)), strict=True)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *zip(borders, matrices, strict=True))
    together = by_numpy(jax.vmap(Border.inverse))(*stacked)
    alone = [by_numpy(Border.inverse)(*each) for each in zip(borders, matrices, strict=True)]
    for found in (together, alone):
        np.testing.assert_allclose(found, np.linalg.inv(np.stack(matrices)), atol=1e-11)
