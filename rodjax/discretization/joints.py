"""Joints: where neighbouring edges of a polyline meet, or an edge and the tangent that a support holds.

Bending and torsion of an isotropic rod live there, as functions of the unit tangents on both sides. Arrays have the
components first and the place along the rod last, so that loops run along the rod.

The derivatives of a joint by rotations of its tangents are written out: those by `jax.hessian` take ten times as long
and more (`docs/design.md`); the tests compare the two. The energy itself is differentiated by JAX, as a function of the
one number on which it depends, the squared difference of the tangents.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.geometry.vectors import components, cross, dot
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.small_matrices import inverse_matrix
from rodjax.mechanics.energy import density
from rodjax.mechanics.strain import squared_curvature_between
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Directed

# In a Gauss-Newton Hessian a joint bent further than this counts as one bent so far: it stays definite.
LEAST_COSINE = 0.1
# Of the turn of a rod as a whole: the least share of a turn about the rod itself that its tangents show, and the most
# that a step follows [rad].
LEAST_SEEN, MOST_OF_ALL = 1e-3, 1.0


class Joints(eqx.Module):
    """Unit tangents before and after each joint, and the distance between the two along the rod."""

    before: Float[Array, "3 k"]
    after: Float[Array, "3 k"]
    spacing: Float[Array, "k"]

    @property
    def squared_curvature(self) -> Float[Array, "k"]:
        difference = self.after - self.before
        return squared_curvature_between(dot(difference, difference), self.spacing)

    def bending_energy(self, rod: Rod) -> Float[Array, ""]:
        return jnp.sum(self.spacing * density(rod, squared_curvature=self.squared_curvature))


class JointDerivatives(eqx.Module):
    """First and second derivatives by the rotations of the tangents before and after, each in its basis."""

    before: Float[Array, "2 k"]
    after: Float[Array, "2 k"]
    before_before: Float[Array, "2 2 k"]
    after_after: Float[Array, "2 2 k"]
    after_before: Float[Array, "2 2 k"]


def joints(scene: Scene, tangents: Float[Array, "3 n"], lengths: Float[Array, "n"] | None = None) -> Joints:
    """The joints of a polyline of n edges; a support that holds the tangent makes one half an edge away.

    `lengths`: those of the edges, `None` where they are equal.
    """
    points = with_held_tangents(scene, tangents)
    if lengths is not None:
        halves = lengths / 2
        spacing = [halves[:-1] + halves[1:]]
        if isinstance(scene.start, Directed):
            spacing = [halves[:1], *spacing]
        if isinstance(scene.end, Directed):
            spacing = [*spacing, halves[-1:]]
        return Joints(points[:, :-1], points[:, 1:], jnp.concatenate(spacing))
    h = 1 / tangents.shape[1]
    half = jnp.full(1, h / 2, tangents.dtype)
    spacing = [jnp.full(tangents.shape[1] - 1, h, tangents.dtype)]
    if isinstance(scene.start, Directed):
        spacing = [half, *spacing]
    if isinstance(scene.end, Directed):
        spacing = [*spacing, half]
    return Joints(points[:, :-1], points[:, 1:], jnp.concatenate(spacing))


def with_held_tangents(scene: Scene, tangents: Float[Array, "3 n"]) -> Float[Array, "3 m"]:
    """The tangents of the edges, with those that the supports hold before and after them."""
    points = [tangents]
    if isinstance(scene.start, Directed):
        points = [scene.start.tangent[:, None], *points]
    if isinstance(scene.end, Directed):
        points = [*points, scene.end.tangent[:, None]]
    return jnp.concatenate(points, axis=1)


def tangent_bases(tangents: Float[Array, "3 n"]) -> Float[Array, "3 2 n"]:
    """Two unit vectors at right angles to each tangent and to each other, right-handed with it.

    Duff et al., "Building an orthonormal basis, revisited" (2017).
    """
    x, y, z = tangents
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    rows = [1 + sign * x * x * a, b, sign * b, sign + y * y * a, -sign * x, -y]
    return jnp.stack(rows).reshape(3, 2, *z.shape)


def rotated(
    tangents: Float[Array, "3 n"], bases: Float[Array, "3 2 n"], rotation: Float[Array, "2 n"]
) -> Float[Array, "3 n"]:
    """Each tangent turned along a great circle, by an angle and in a direction given in its basis [rad]."""
    across = short_sum(bases * rotation[None], axis=1)
    cosine, sine_by_angle, _ = _by_angle(dot(rotation, rotation))
    return cosine[None] * tangents + sine_by_angle[None] * across


def rotated_together(
    tangents: Float[Array, "3 n"], bases: Float[Array, "3 b n"], rotation: Float[Array, "b n"]
) -> Float[Array, "3 n"]:
    """The same to first order, of the tangents of one rod: each spins about itself as `turn_of_all` does.

    So a rod that turns as a whole keeps its shape; along great circles half the square of the angle bends it.
    """
    if bases.shape[1] == 1:  # in a plane these are great circles
        return rotated(tangents, bases, rotation)
    across = short_sum(bases * rotation[None], axis=1)
    about = cross(tangents, across)
    spin = dot(turn_of_all(tangents, about)[:, None], tangents)
    cosine, sine_by_angle, versine_by_square = _by_angle(dot(rotation, rotation) + spin**2)
    along = cosine + versine_by_square * spin**2
    return along[None] * tangents + sine_by_angle[None] * across + (versine_by_square * spin)[None] * about


def _by_angle(squared: Float[Array, "n"]) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "n"]]:
    """Cosine, sine by the angle, and one less the cosine by its square, of angles with these squares."""
    is_zero = squared == 0
    angle = jnp.sqrt(jnp.where(is_zero, 1.0, squared))
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    # Series at zero, where the derivatives of the square root are infinite.
    return (
        jnp.where(is_zero, 1 - squared / 2, cosine),
        jnp.where(is_zero, 1 - squared / 6, sine / angle),
        jnp.where(is_zero, 0.5 - squared / 24, (1 - cosine) / angle**2),
    )


def turn_of_all(tangents: Float[Array, "3 n"], turns: Float[Array, "3 n"]) -> Float[Array, "3"]:
    """The one turn nearest to those of all tangents, each at right angles to its own; at most MOST_OF_ALL [rad]."""
    n = tangents.shape[1]
    # A turn about a straight rod itself shows in no tangent.
    seen = (1 + LEAST_SEEN) * n * jnp.eye(3, dtype=tangents.dtype)
    matrix = seen - jnp.sum(tangents[:, None] * tangents[None], axis=-1)
    turn = inverse_matrix(matrix) @ jnp.sum(turns, axis=1)
    return turn * MOST_OF_ALL / jnp.sqrt(jnp.maximum(jnp.sum(turn**2), MOST_OF_ALL**2))


def bending_derivatives(
    rod: Rod, joints: Joints, bases: tuple[Float[Array, "3 2 k"], Float[Array, "3 2 k"]], *, gauss_newton: bool = False
) -> JointDerivatives:
    """Derivatives of the bending energy. With `gauss_newton` the second ones are positive semidefinite.

    With d the difference of the two tangents, d.d changes by -2 a.b; the energy is a function of d.d. Gauss-Newton
    takes the rotation of the second tangent less that of the first, carried over by parallel transport, for the strain.
    """

    def energy(squared_difference):
        curvature = squared_curvature_between(squared_difference, joints.spacing)
        return joints.spacing * density(rod, squared_curvature=curvature)

    difference = joints.after - joints.before
    squared_difference = dot(difference, difference)
    first, second = _two_derivatives(energy, squared_difference)
    before_basis, after_basis = bases
    toward_after, toward_before = components(before_basis, joints.after), components(after_basis, joints.before)
    cosine = dot(joints.before, joints.after)
    between = short_sum(outer(after_basis, before_basis), axis=0)
    if gauss_newton:
        transported = between - outer(toward_before, toward_after) / (1 + cosine)[None, None]
        cosine = jnp.maximum(cosine, LEAST_COSINE)
        between = cosine[None, None] * transported
    across = (2 * first * cosine)[None, None] * jnp.eye(before_basis.shape[1], dtype=first.dtype)[..., None]
    return JointDerivatives(
        before=-2 * first[None] * toward_after,
        after=-2 * first[None] * toward_before,
        before_before=4 * second[None, None] * outer(toward_after, toward_after) + across,
        after_after=4 * second[None, None] * outer(toward_before, toward_before) + across,
        after_before=4 * second[None, None] * outer(toward_before, toward_after) - 2 * first[None, None] * between,
    )


def twist_derivatives(joints: Joints, bases: tuple[Float[Array, "3 2 k"], Float[Array, "3 2 k"]]) -> JointDerivatives:
    """Derivatives of the total twist, `strain.swept_angle` of each joint (Bergou et al. 2010 give the first ones)."""
    a, b = joints.before, joints.after
    before_basis, after_basis = bases
    scale = 1 / (1 + dot(a, b))
    normal = twist_gradient(a, b)
    normal_before, normal_after = components(before_basis, normal), components(after_basis, normal)
    toward_after, toward_before = scale[None] * components(before_basis, b), scale[None] * components(after_basis, a)
    a_cross = jnp.stack([cross(a, after_basis[:, i]) for i in range(after_basis.shape[1])], axis=1)
    between = scale[None, None] * short_sum(outer(a_cross, before_basis), axis=0)
    return JointDerivatives(
        before=normal_before,
        after=normal_after,
        before_before=-_symmetric_outer(normal_before, toward_after),
        after_after=-_symmetric_outer(normal_after, toward_before),
        after_before=between - outer(toward_before, normal_before),
    )


def twist_gradient(before: Float[Array, "3 *k"], after: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """The derivative of the total twist by either tangent of a joint."""
    return cross(before, after) / (1 + dot(before, after))[None]


def of_edges(scene: Scene, by_point: Float[Array, "... m"], segments: int) -> Float[Array, "... n"]:
    """What belongs to the edges, out of something given for them and the tangents held before and after."""
    first = int(isinstance(scene.start, Directed))
    return by_point[..., first : first + segments]


def by_edges(
    scene: Scene, before: Float[Array, "... k"], after: Float[Array, "... k"], segments: int
) -> Float[Array, "... n"]:
    """Sums over the joints of each edge of what they give to the edges before and after them."""
    none = jnp.zeros_like(before[..., :1])
    by_point = jnp.concatenate([before, none], axis=-1) + jnp.concatenate([none, after], axis=-1)
    return of_edges(scene, by_point, segments)


def scatter_add(
    scene: Scene, derivatives: JointDerivatives, segments: int
) -> tuple[Float[Array, "b n"], Float[Array, "b b n"], Float[Array, "b b n-1"]]:
    """Gradient, and the blocks on and below the diagonal of the second derivatives, by the rotations of the edges."""
    gradient = by_edges(scene, derivatives.before, derivatives.after, segments)
    diagonal = by_edges(scene, derivatives.before_before, derivatives.after_after, segments)
    return gradient, diagonal, of_edges(scene, derivatives.after_before, segments - 1)


def _two_derivatives(function, x: Float[Array, "k"]) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
    """First and second derivative of a function that acts on each number by itself."""
    ones = jnp.ones_like(x)
    return jax.jvp(lambda x: jax.jvp(function, (x,), (ones,))[1], (x,), (ones,))


def outer(a: Float[Array, "*c 2 k"], b: Float[Array, "*c 2 k"]) -> Float[Array, "*c 2 2 k"]:
    return a[..., :, None, :] * b[..., None, :, :]


def _symmetric_outer(a: Float[Array, "2 k"], b: Float[Array, "2 k"]) -> Float[Array, "2 2 k"]:
    return (outer(a, b) + outer(b, a)) / 2


def generic_field(tangents: Float[Array, "3 n"], axes: Float[Array, "3 3"] | None = None) -> Float[Array, "3 n"]:
    """Directions along the rod that no symmetry of a scene shares, in these axes: the columns, `None` for the global
    ones, where it does not matter which.
    """
    s = jnp.linspace(0.0, 1.0, tangents.shape[1], dtype=tangents.dtype)
    x, y, z = jnp.cos(1.0 + 2.0 * s), jnp.sin(2.0 + 3.0 * s), jnp.cos(3.0 + s)
    if axes is None:
        return jnp.stack([x, y, z])
    return axes[:, :1] * x[None] + axes[:, 1:2] * y[None] + axes[:, 2:] * z[None]
