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
from rodjax.discretization.rest_ways import RestWays, part
from rodjax.geometry.rotations import columns, rotated
from rodjax.geometry.vectors import cross, diagonal, dot, skew
from rodjax.linalg.blocks import short_sum
from rodjax.mechanics.energy import Sections
from rodjax.programs.staging import staged


class CellStates(NamedTuple):
    """Of all cells: frames, the forces through them, and of the rod at rest strains and ways."""

    field: Cells
    sections: Sections
    quaternions: Float[Array, "4 p n"]
    forces: Float[Array, "3 p n"]
    rest_strains: Float[Array, "3 p n"] | None
    rest_ways: RestWays | None

    @property
    def acting(self) -> slice:
        """The components, in the axes of the frames, of the force on which the energy of strain points depends: the
        tension, and with shear those along d1 and d2.
        """
        return slice(2 if self.sections.GA is None else 0, 3)

    @property
    def turning(self) -> Float[Array, "3 n"] | None:
        return None if self.rest_ways is None else self.rest_ways.turning


class CellDerivatives(NamedTuple):
    """Of the Lagrangian of each cell, by the rotations of its frames in their own axes and by the force through it.

    `second`: [i, a, j, b] by component a of frame i and b of frame j; `way`: the reverse of the derivative by the
    force; `by_force`: [a, c, i] by component a of frame i and c of the force; `compliance`: of the way.
    """

    value: Float[Array, "n"]
    first: Float[Array, "3 p n"]
    second: Float[Array, "p 3 p 3 n"]
    way: Float[Array, "3 n"]
    by_force: Float[Array, "3 3 p n"]
    compliance: Float[Array, "3 3 n"]


class Coordinates(NamedTuple):
    """`seen`: quaternions of the other frames from the reference; `directors`: [i, j] component i of director j;
    `own_forces`: in the axes of the frames, the last of them the tensions.
    """

    seen: Float[Array, "4 p-1 n"]
    directors: Float[Array, "3 3 p n"]
    own_forces: Float[Array, "3 p n"]

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
    if cells.rest_ways is not None and cells.rest_ways.along is not None:
        assert cells.rest_strains is not None
        value -= cells.rest_ways.along * part(strains[:2], cells.rest_strains[:2]) * tension
    return value


def _at_points(cells: CellStates, here: Coordinates, strains: Strains) -> Float[Array, "v p n"]:
    values = strains.values
    if cells.rest_strains is not None:
        values -= cells.rest_strains
    return jnp.concatenate([values, here.own_forces[cells.acting]])


def first_derivatives(cells: CellStates) -> Float[Array, "3 p n"]:
    """By the rotations alone."""
    here = Coordinates.of(cells)
    strains = cells.field.strains(here.seen[cells.field.coordinates])
    stresses = jax.grad(lambda values: jnp.sum(density(cells, values)))(_at_points(cells, here, strains))
    return _by_rotations(
        cells, here, stresses, _strain_rows(cells, here, strains.jacobian, _coordinate_rows(cells.field, here))
    )


def derivatives(cells: CellStates) -> CellDerivatives:
    here = Coordinates.of(cells)
    strains = cells.field.strains(here.seen[cells.field.coordinates])
    values = _at_points(cells, here, strains)
    stresses, by_all = jax.linearize(jax.grad(lambda values: jnp.sum(density(cells, values))), values)
    # Each of them changed at all points at once.
    directions = jnp.eye(len(values), dtype=values.dtype)[:, :, None, None] * jnp.ones_like(values)[None]
    stiffness = jax.vmap(by_all)(directions)

    p, n = values.shape[1:]
    turning = _coordinate_rows(cells.field, here)
    jacobian = strains.jacobian
    of_strains = _strain_rows(cells, here, jacobian, turning)
    # Rows: strains and acting forces at the points; columns: rotations of the frames, then the force.
    size = len(values)
    acting = jnp.moveaxis(here.directors[:, cells.acting], 0, 2)
    forcing = jnp.concatenate([jnp.zeros((3, p, 3, n), values.dtype), acting])
    rows = jnp.concatenate([of_strains, forcing], axis=2)
    changed = short_sum(stiffness[:, :, :, None] * rows[:, None], axis=0)
    quadratic = _products(rows.reshape(size * p, -1, n), changed.reshape(size * p, -1, n))
    curving = strains.curving(stresses[:3]).reshape(len(turning), len(turning), n)
    changed = short_sum(curving[:, :, None] * turning[None], axis=1)
    second = quadratic[: 3 * p, : 3 * p] + _products(turning, changed)
    slopes = short_sum((stresses[:3, :, None, None] * jacobian).reshape(3 * p, -1, p - 1, n), axis=0)
    second = second.reshape(p, 3, p, 3, n) + _curving(cells, here, slopes, stresses[3:])
    by_force = jnp.moveaxis(quadratic[: 3 * p, 3 * p :].reshape(p, 3, 3, n), 0, 2) + _tilting(cells, here, stresses[3:])
    way = -short_sum((stresses[3:, :, None] * acting).reshape(-1, 3, n), axis=0)
    value = jnp.sum(density(cells, values), axis=0)
    if cells.turning is not None:
        rest = rotated(cells.quaternions[:, REFERENCE], cells.turning)
        way += rest
        value -= dot(cells.forces[:, REFERENCE], rest)
    first = _by_rotations(cells, here, stresses, of_strains)
    return CellDerivatives(value, first, second, way, by_force, -quadratic[3 * p :, 3 * p :])


def _coordinate_rows(field: Cells, here: Coordinates) -> Float[Array, "v 3p n"]:
    """The derivatives of the coordinates, of one other frame after the other, by the rotations, frame by frame."""
    _, p, n = here.own_forces.shape
    nothing = jnp.zeros((4, 3, n), here.seen.dtype)
    rows = []
    for k, other in enumerate(j for j in range(p) if j != REFERENCE):
        w, r = here.seen[0, k], here.seen[1:, k]
        straight, across = diagonal(w), skew(r)
        blocks = [nothing] * p
        blocks[other] = jnp.concatenate([-r[None], straight + across]) / 2
        blocks[REFERENCE] = jnp.concatenate([r[None], across - straight]) / 2
        rows.append(jnp.concatenate(blocks, axis=1)[field.coordinates])
    return jnp.concatenate(rows)


def _strain_rows(
    cells: CellStates, here: Coordinates, jacobian: Float[Array, "3 p c q n"], turning: Float[Array, "v 3p n"]
) -> Float[Array, "v p 3p n"]:
    """The derivatives of strains and acting forces at the points by the rotations, from those of the coordinates."""
    _, p, n = here.own_forces.shape
    by_coordinates = jnp.swapaxes(jacobian, 2, 3).reshape(3, p, len(turning), n)
    of_strains = short_sum(by_coordinates[:, :, :, None] * turning[None, None], axis=2)
    forces = here.own_forces
    if cells.sections.GA is None:
        by_own = jnp.stack([-forces[1], forces[0], jnp.zeros_like(forces[0])], axis=1)[None]  # [c, k, a]: t x m
    else:
        by_own = jnp.swapaxes(skew(forces), 1, 2)
    own = jnp.eye(p, dtype=forces.dtype)[None, :, :, None, None] * by_own[:, :, None]
    return jnp.concatenate([of_strains, own.reshape(-1, p, 3 * p, n)])


def _by_rotations(
    cells: CellStates, here: Coordinates, stresses: Float[Array, "v p n"], rows: Float[Array, "v p 3p n"]
) -> Float[Array, "3 p n"]:
    _, p, n = stresses.shape
    first = short_sum((stresses[:, :, None] * rows).reshape(-1, 3 * p, n), axis=0)
    first = jnp.moveaxis(first.reshape(p, 3, n), 0, 1)
    if cells.turning is None:
        return first
    return first.at[:, REFERENCE].add(-cross(cells.turning, here.own_forces[:, REFERENCE]))


def _curving(
    cells: CellStates, here: Coordinates, slopes: Float[Array, "c q n"], by_forces: Float[Array, "f p n"]
) -> Float[Array, "p 3 p 3 n"]:
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
    return jnp.stack([jnp.stack(row, axis=1) for row in blocks])


def _tilting(cells: CellStates, here: Coordinates, slopes: Float[Array, "f p n"]) -> Float[Array, "3 3 p n"]:
    """Derivatives of the directors, and of the ways at rest, by the rotations, times those of the value by the acting
    forces: [a, c, i] as in `CellDerivatives.by_force`.
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


def _products(rows: Float[Array, "r c n"], changed: Float[Array, "r c n"]) -> Float[Array, "c c n"]:
    """Sums over the rows of products of columns."""
    rows, changed = staged(rows, changed)
    return short_sum(rows[:, :, None] * changed[:, None], axis=0)


def _of_turned(force: Float[Array, "3 *k"], vector: Float[Array, "3 *k"]) -> Float[Array, "3 3 *k"]:
    """Second derivatives of the scalar product of a force with a vector that turns, both in the axes of the frame."""
    both = force[:, None] * vector[None]
    return (both + jnp.swapaxes(both, 0, 1)) / 2 - diagonal(dot(force, vector))
