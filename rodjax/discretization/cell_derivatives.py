"""Derivatives of cells of frames: by a few coordinates by autodiff, and of these by rotations by formulas.

What a cell adds to the Lagrangian depends on its coordinates alone: how its frames are seen from the reference frame,
and the tensions n . t of its strain points. By these JAX differentiates. How they change as frames turn by vectors d in
their own axes are short formulas: of the quaternion p = (w, r) of a frame seen from the reference,

    p' = p (0, d/2) - (0, d_ref/2) p,    and the second derivatives by one d: -p/4 times the identity;

of a tension n . R e, with m = R^T n: m . (d x e), and (m e^T + e m^T)/2 - (m . e) I.

Arrays have rows and columns first, then the cells.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import REFERENCE, Cells, Strains
from rodjax.discretization.rest_correction import RestCorrection, part
from rodjax.geometry.rotations import columns, rotated
from rodjax.geometry.vectors import cross, diagonal, dot, skew
from rodjax.linalg.blocks import product, short_sum, transpose_product
from rodjax.mechanics.energy import Sections
from rodjax.programs.parts import traced_once


class CellStates(NamedTuple):
    """Of all cells: frames, the forces through them, and of the rod at rest the strains and the correction."""

    field: Cells
    sections: Sections
    quaternions: Float[Array, "4 p n"]
    forces: Float[Array, "3 p n"]
    rest_strains: Float[Array, "3 p n"] | None
    rest_correction: RestCorrection | None

    @property
    def acting(self) -> slice:
        """The components, in the axes of the frames, of the force on which the energy of strain points depends: the
        tension, and with shear those along d1 and d2.
        """
        return slice(2 if self.sections.GA is None else 0, 3)

    @property
    def is_separable(self) -> bool:
        """Whether each strain and each acting force adds to the density on its own."""
        return self.sections.is_separable and (self.rest_correction is None or self.rest_correction.along is None)

    @property
    def turning(self) -> Float[Array, "3 n"] | None:
        return None if self.rest_correction is None else self.rest_correction.turning


class CellDerivatives(NamedTuple):
    """Of the Lagrangian of each cell, by the rotations of its frames in their own axes and by the force through it.

    `second`: [i, a, j, b] by component a of frame i and b of frame j; `segment_vectors`: minus the
    derivative by the force; `by_force`: [a, c, i] by component a of frame i and c of the force; `compliance`: the
    derivative of the segment vector by the force.
    """

    value: Float[Array, "n"]
    first: Float[Array, "3 p n"]
    second: Float[Array, "p 3 p 3 n"]
    segment_vectors: Float[Array, "3 n"]
    by_force: Float[Array, "3 3 p n"]
    compliance: Float[Array, "3 3 n"]


class Coordinates(NamedTuple):
    """`seen`: quaternions of the other frames from the reference; `directors`: [i, j] component i of director j;
    `own_forces`: in the axes of the frames, the last of them the tensions.
    """

    seen: Float[Array, "4 p-1 n"]
    directors: Float[Array, "3 3 p n"]
    own_forces: Float[Array, "3 p n"]

    def turned_forces(self, acting: slice) -> Float[Array, "f 3 p n"]:
        """The derivatives of the acting forces by the rotations of their frames."""
        return skew(self.own_forces)[acting]

    @staticmethod
    def of(cells: CellStates) -> "Coordinates":
        directors = columns(cells.quaternions)
        own_forces = short_sum(directors * cells.forces[:, None], axis=0)
        return Coordinates(cells.field.seen(cells.quaternions), directors, own_forces)


def density(cells: CellStates, strains: Float[Array, "v p n"]) -> Float[Array, "p n"]:
    """What a strain point adds to the Lagrangian, by the strains there and the acting forces, the last the tension."""
    sections, (k1, k2, twist, *across, tension) = cells.sections, jnp.unstack(strains)
    bent = (k1, k2)
    axial = sections.axial_strain_under(tension, bent, twist)
    if across:
        forces = jnp.stack(across)
        shear = sections.shear_under(forces)
        enthalpy = sections.density(bent, twist, axial, shear) - tension * (1 + sections.stretched(axial))
        enthalpy -= dot(forces, shear)
    else:
        enthalpy = sections.density(bent, twist, axial) - tension * (1 + sections.stretched(axial))
    value = cells.field.lengths * enthalpy
    if cells.rest_correction is not None and cells.rest_correction.along is not None:
        assert cells.rest_strains is not None
        value -= cells.rest_correction.along * part(strains[:2], cells.rest_strains[:2]) * tension
    return value


def _at_points(cells: CellStates, here: Coordinates, strains: Strains) -> Float[Array, "v p n"]:
    values = strains.values
    if cells.rest_strains is not None:
        values -= cells.rest_strains
    return jnp.concatenate([values, here.own_forces[cells.acting]])


class Stiffness(NamedTuple):
    """Second derivatives of the density at the strain points by the strains, by the acting forces, and by both:
    matrices, or their diagonals where these are all; `mixed` is `None` where it is zero.
    """

    strains: Float[Array, "3 3 p n"] | Float[Array, "3 p n"]
    forces: Float[Array, "f f p n"] | Float[Array, "f p n"]
    mixed: Float[Array, "3 f p n"] | None


class Turning(NamedTuple):
    """The derivatives of the coordinates of each other frame by its own rotations, and by those of the reference."""

    own: Float[Array, "q c 3 n"]
    reference: Float[Array, "q c 3 n"]


# Second derivatives by the rotations of two frames of each cell.
Blocks = list[list[Float[Array, "3 3 n"]]]


@traced_once
def first_derivatives(cells: CellStates) -> Float[Array, "3 p n"]:
    """By the rotations alone."""
    here = Coordinates.of(cells)
    strains = cells.field.strains(here.seen[cells.field.coordinates])
    stresses = jax.grad(lambda values: jnp.sum(density(cells, values)))(_at_points(cells, here, strains))
    slopes, turning = _slopes(strains.jacobian, stresses[:3]), _turning(cells.field, here)
    return _by_rotations(cells, here, slopes, stresses[3:], turning)


@traced_once
def derivatives(cells: CellStates) -> CellDerivatives:
    here = Coordinates.of(cells)
    strains = cells.field.strains(here.seen[cells.field.coordinates])
    values, jacobian = _at_points(cells, here, strains), strains.jacobian
    stresses, stiffness = _stresses(cells, values)
    moments, by_forces = stresses[:3], stresses[3:]
    slopes, turning = _slopes(jacobian, moments), _turning(cells.field, here)
    # How the acting forces change as their frames turn, and with the force through the cell: [f, component, point].
    turned, forcing = here.turned_forces(cells.acting), jnp.swapaxes(here.directors[:, cells.acting], 0, 1)
    by_forcing = _times(stiffness.forces, forcing)

    blocks = _curving(cells, here, slopes, by_forces)
    of_turned = transpose_product(turned, _times(stiffness.forces, turned))
    for k in range(len(blocks)):
        blocks[k][k] += of_turned[:, :, k]
    _add_by_coordinates(blocks, _quadratic(jacobian, stiffness.strains) + strains.curving(moments), turning)
    by_force = transpose_product(turned, by_forcing) + _tilting(cells, here, by_forces)
    if stiffness.mixed is not None:
        mixed = _mixed(jacobian, stiffness.mixed, turning)
        _add_mixed(blocks, mixed, turned)
        by_force += jnp.stack([short_sum(product(rows, forcing), axis=2) for rows in mixed], axis=2)

    segment_vectors = -short_sum(dot(by_forces[:, None], forcing), axis=1)
    value = jnp.sum(density(cells, values), axis=0)
    if cells.turning is not None:
        rest = rotated(cells.quaternions[:, REFERENCE], cells.turning)
        segment_vectors += rest
        value -= dot(cells.forces[:, REFERENCE], rest)
    first = _by_rotations(cells, here, slopes, by_forces, turning)
    second = jnp.stack([jnp.stack(row, axis=1) for row in blocks])
    compliance = -short_sum(transpose_product(forcing, by_forcing), axis=2)
    return CellDerivatives(value, first, second, segment_vectors, by_force, compliance)


def _stresses(cells: CellStates, values: Float[Array, "v p n"]) -> tuple[Float[Array, "v p n"], Stiffness]:
    """The derivatives of the density by the strains and the acting forces, and the second ones."""

    def stresses(values: Float[Array, "v p n"]) -> Float[Array, "v p n"]:
        return jax.grad(lambda values: jnp.sum(density(cells, values)))(values)

    if cells.is_separable:
        first, second = jax.jvp(stresses, (values,), (jnp.ones_like(values),))
        return first, Stiffness(second[:3], second[3:], None)
    first, by_all = jax.linearize(stresses, values)
    # Each of them changed at all points at once.
    directions = jnp.eye(len(values), dtype=values.dtype)[:, :, None, None] * jnp.ones_like(values)[None]
    second = jax.vmap(by_all)(directions)
    return first, Stiffness(second[:3, :3], second[3:, 3:], second[:3, 3:])


def _times(matrix: Array, columns: Float[Array, "r j p n"]) -> Float[Array, "r j p n"]:
    """A symmetric matrix at each point, or its diagonal, times columns."""
    return matrix[:, None] * columns if matrix.ndim < columns.ndim else product(matrix, columns)


def _slopes(jacobian: Float[Array, "3 p c q n"], moments: Float[Array, "3 p n"]) -> Float[Array, "c q n"]:
    """The derivatives of the value by the coordinates."""
    products = moments[:, :, None, None] * jacobian
    return short_sum(products.reshape(-1, *products.shape[2:]), axis=0)


def _turning(field: Cells, here: Coordinates) -> Turning:
    w, r = here.seen[0], here.seen[1:]
    straight, across = diagonal(w), skew(r)
    own = jnp.concatenate([-r[None], straight + across]) / 2
    reference = jnp.concatenate([r[None], across - straight]) / 2
    return Turning(*(jnp.moveaxis(rows[field.coordinates], 2, 0) for rows in (own, reference)))


def _by_rotations(
    cells: CellStates,
    here: Coordinates,
    slopes: Float[Array, "c q n"],
    by_forces: Float[Array, "f p n"],
    turning: Turning,
) -> Float[Array, "3 p n"]:
    """The first derivatives by the rotations, from those by the coordinates and the acting forces."""
    by_coordinates = jnp.moveaxis(slopes, 1, 0)[:, :, None]
    rows = list(short_sum(by_coordinates * turning.own, axis=1))
    reference = short_sum(short_sum(by_coordinates * turning.reference, axis=1), axis=0)
    if cells.turning is not None:
        reference -= cross(cells.turning, here.own_forces[:, REFERENCE])
    rows.insert(REFERENCE, reference)
    return jnp.stack(rows, axis=1) + dot(by_forces[:, None], here.turned_forces(cells.acting))


def _quadratic(
    jacobian: Float[Array, "3 p c q n"], stiffness: Float[Array, "3 3 p n"] | Float[Array, "3 p n"]
) -> Float[Array, "q c q c n"]:
    """The second derivatives by the coordinates, of strains that are linear in them."""
    _, p, c, q, n = jacobian.shape
    rows = jnp.swapaxes(jacobian, 2, 3).reshape(3, p, q * c, n)
    changed = jnp.swapaxes(_times(stiffness, jnp.swapaxes(rows, 1, 2)), 1, 2)
    rows, changed = (x.reshape(3 * p, q * c, n) for x in (rows, changed))
    return short_sum(rows[:, :, None] * changed[:, None], axis=0).reshape(q, c, q, c, n)


def _add_by_coordinates(blocks: Blocks, by_coordinates: Float[Array, "q c q c n"], turning: Turning) -> None:
    """The second derivatives by the rotations, from those by the coordinates."""
    q, c, _, _, n = by_coordinates.shape
    own, reference = turning
    rows = by_coordinates.reshape(q * c, q, c, n)
    by_own = short_sum(rows[:, :, :, None] * own[None], axis=2)
    by_reference = short_sum(rows.reshape(q * c, q * c, 1, n) * reference.reshape(1, q * c, 3, n), axis=1)
    by_both = jnp.concatenate([by_own.reshape(q, c, 3 * q, n), by_reference.reshape(q, c, 3, n)], axis=2)
    of_own = short_sum(own[:, :, :, None] * by_both[:, :, None], axis=1)  # of each frame by all, the reference last
    blocks[REFERENCE][REFERENCE] += short_sum(reference.reshape(q * c, 3, 1, n) * by_reference[:, None], axis=0)
    others = [k for k in range(len(blocks)) if k != REFERENCE]
    for rows, first in zip(of_own, others, strict=True):
        for f, second in enumerate(others):
            blocks[first][second] += rows[:, 3 * f : 3 * f + 3]
        blocks[first][REFERENCE] += rows[:, 3 * q :]
        blocks[REFERENCE][first] += jnp.swapaxes(rows[:, 3 * q :], 0, 1)


def _mixed(
    jacobian: Float[Array, "3 p c q n"], stiffness: Float[Array, "3 f p n"], turning: Turning
) -> list[Float[Array, "3 f p n"]]:
    """The second derivatives by the rotations of each frame and the acting forces."""
    by_coordinates = short_sum(jacobian[:, None] * stiffness[:, :, :, None, None], axis=0)
    by_coordinates = jnp.moveaxis(by_coordinates, (3, 2), (0, 1))[:, :, None]  # [e, i, -, f, point]
    own, reference = (short_sum(rows[:, :, :, None, None] * by_coordinates, axis=1) for rows in turning)
    mixed = list(own)
    mixed.insert(REFERENCE, short_sum(reference, axis=0))
    return mixed


def _add_mixed(blocks: Blocks, mixed: list[Float[Array, "3 f p n"]], turned: Float[Array, "f 3 p n"]) -> None:
    """The second derivatives by the rotations, from those by them and the acting forces."""
    for i, rows in enumerate(mixed):
        for k in range(len(mixed)):
            block = product(rows[:, :, k], turned[:, :, k])
            blocks[i][k] += block
            blocks[k][i] += jnp.swapaxes(block, 0, 1)


def _curving(
    cells: CellStates, here: Coordinates, slopes: Float[Array, "c q n"], by_forces: Float[Array, "f p n"]
) -> Blocks:
    """The second derivatives of coordinates and acting forces by the rotations, times those of the value by them."""
    _, p, n = here.own_forces.shape
    blocks = [[jnp.zeros((3, 3, n), slopes.dtype)] * p for _ in range(p)]
    if cells.sections.GA is None:
        tangents = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0], slopes.dtype)[:, None, None], here.own_forces.shape)
        of_forces = by_forces[None] * _of_turned(here.own_forces, tangents)
    else:
        of_forces = _of_turned(here.own_forces, by_forces)
    for k in range(p):
        blocks[k][k] = of_forces[:, :, k]
    if cells.turning is not None:
        blocks[REFERENCE][REFERENCE] -= _of_turned(here.own_forces[:, REFERENCE], cells.turning)
    first, _, _ = cells.field.coordinates.indices(4)
    (w, r), by_r = (here.seen[0], here.seen[1:]), slopes[1 - first :]
    by_w = jnp.zeros_like(w) if first else slopes[0]
    pure = diagonal(-(by_w * w + dot(by_r, r)) / 4)
    both = r[:, None] * by_r[None]
    mixed = both + jnp.swapaxes(both, 0, 1) + diagonal(by_w * w - dot(by_r, r)) + skew(w[None] * by_r + by_w[None] * r)
    mixed /= 4
    for k, other in enumerate(j for j in range(p) if j != REFERENCE):
        blocks[other][other] += pure[:, :, k]
        blocks[REFERENCE][REFERENCE] += pure[:, :, k]
        blocks[REFERENCE][other] = mixed[:, :, k]
        blocks[other][REFERENCE] = jnp.swapaxes(mixed[:, :, k], 0, 1)
    return blocks


def _tilting(cells: CellStates, here: Coordinates, slopes: Float[Array, "f p n"]) -> Float[Array, "3 3 p n"]:
    """Derivatives of the directors, and of the correction at rest, by the rotations, times those of the value by the
    acting forces: [a, c, i] as in `CellDerivatives.by_force`.
    """
    if cells.sections.GA is None:
        by_turns = jnp.stack([-here.directors[:, 1], here.directors[:, 0], jnp.zeros_like(here.directors[:, 0])])
        tilting = slopes[None] * by_turns
    else:
        tilting = _turned_vector(here.directors, slopes)
    if cells.turning is None:
        return tilting
    return tilting.at[:, :, REFERENCE].add(-_turned_vector(here.directors[:, :, REFERENCE], cells.turning))


def _turned_vector(directors: Float[Array, "3 3 *k"], vector: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    """[a, c]: component c of e_a x vector, which is given in the axes of the directors."""
    return jnp.swapaxes(short_sum(directors[:, :, None] * -skew(vector)[None], axis=1), 0, 1)


def _of_turned(force: Float[Array, "3 *k"], vector: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    """Second derivatives of the scalar product of a force with a vector that turns, both in the axes of the frame."""
    both = force[:, None] * vector[None]
    return (both + jnp.swapaxes(both, 0, 1)) / 2 - diagonal(dot(force, vector))
