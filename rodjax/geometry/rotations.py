"""Rotations as unit quaternions (w, x, y, z), components first: (4, *k) for a row of them.

A frame with columns (d1, d2, t) is the rotation that takes the global axes to these.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.geometry.vectors import cross, dot
from rodjax.programs.parts import traced_once

# Angles below this have series for functions of them.
SMALL = 1e-2

# Components one by one, each an array along the rod. Derivatives of slices and stacks make large programs; where these
# are taken, functions that stay with components make small ones.
Vector = tuple[Array, Array, Array]
Quaternion = tuple[Array, Array, Array, Array]


def by_components(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function of tuples of components also as one of arrays with the components first."""

    @traced_once
    def of_arrays(*values: Any) -> Any:
        return jnp.stack(function(*map(jnp.unstack, values)))

    @functools.wraps(function)
    def either(*values: Any) -> Any:
        if isinstance(values[0], tuple):
            return function(*values)
        return of_arrays(*values)

    return either


def inner(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def outer(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@by_components
def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """First b, then a; or a, then b in the axes of a."""
    (p, *u), (q, *v) = a, b
    x, y, z = outer((u[0], u[1], u[2]), (v[0], v[1], v[2]))
    w = p * q - u[0] * v[0] - u[1] * v[1] - u[2] * v[2]
    return w, p * v[0] + q * u[0] + x, p * v[1] + q * u[1] + y, p * v[2] + q * u[2] + z


@by_components
def inverse(q: Quaternion) -> Quaternion:
    return q[0], -q[1], -q[2], -q[3]


@by_components
def tangent(q: Quaternion) -> Vector:
    """The third column."""
    w, x, y, z = q
    return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)


@by_components
def rotated(q: Quaternion, vector: Vector) -> Vector:
    w, *u = q
    axis = (u[0], u[1], u[2])
    a, b, c = outer(axis, vector)
    a, b, c = 2 * a, 2 * b, 2 * c
    x, y, z = outer(axis, (a, b, c))
    return vector[0] + w * a + x, vector[1] + w * b + y, vector[2] + w * c + z


@by_components
def turned(q: Quaternion, rotation: Vector) -> Quaternion:
    """Turned on by a vector in its own axes, 2 tan(angle/2) about the axis: to second order the rotation vector."""
    size = 1 / jnp.sqrt(1 + inner(rotation, rotation) / 4)
    half = size / 2
    small = (size, half * rotation[0], half * rotation[1], half * rotation[2])
    return product(q, small)


def columns(q: Float[Array, "4 *k"]) -> Float[Array, "3 3 *k"]:
    """The rotation matrices: [i, j] is component i of director j."""
    w, x, y, z = jnp.unstack(q)
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def rotate_about_tangent(q: Float[Array, "4 *k"], angle: Float[Array, "*k"]) -> Float[Array, "4 *k"]:
    """Turned about its tangent."""
    cosine, sine = jnp.cos(angle / 2), jnp.sin(angle / 2)
    w, x, y, z = jnp.unstack(q)
    return jnp.stack([w * cosine - z * sine, x * cosine + y * sine, y * cosine - x * sine, z * cosine + w * sine])


def align_tangent(q: Float[Array, "4 *k"], new: Float[Array, "3 *k"]) -> Float[Array, "4 *k"]:
    """Turned by the smallest rotation that takes the tangent to a new one, not opposite to it."""
    old = tangent(q)
    swing = jnp.concatenate([1 + dot(old, new)[None], cross(old, new)])
    return unit(product(unit(swing), q))


def carried(q: Float[Array, "4"], tangents: Float[Array, "3 k"]) -> Float[Array, "4 k"]:
    """A frame carried from one tangent to the next without twist, each not opposite to the last."""

    def onward(q, tangent):
        q = align_tangent(q, tangent)
        return q, q

    return jax.lax.scan(onward, q, tangents.T)[1].T


def unit(q: Float[Array, "4 *k"]) -> Float[Array, "4 *k"]:
    """The same direction at the length 1."""
    return q / jnp.sqrt(dot(q, q))[None]


def _products_by_frame() -> np.ndarray:
    """[i, j, k, l]: 4 q_i q_j, less the identity, by the entry (k, l) of the rotation matrix of q."""
    table = np.zeros((4, 4, 3, 3))
    table[0, 0] = np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[k + 1, k + 1] = -np.eye(3)
        table[k + 1, k + 1, k, k] = 1
        for a, b in ((0, k + 1), (k + 1, 0)):
            table[a, b, j, i], table[a, b, i, j] = 1, -1
        for a, b in ((i + 1, j + 1), (j + 1, i + 1)):
            table[a, b, i, j] = table[a, b, j, i] = 1
    return table


_PRODUCTS = _products_by_frame()


def from_frame(frame: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Of the two quaternions of a rotation matrix either."""
    products = jnp.eye(4, dtype=frame.dtype) + jnp.tensordot(
        _PRODUCTS.astype(frame.dtype), frame, 2, precision="highest"
    )
    # The row of the largest component loses no digits.
    row = products[jnp.argmax(jnp.diagonal(products))]
    return row / jnp.sqrt(jnp.sum(row**2))


def rotation_vector(frame: Float[Array, "3 3"], other: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The smallest rotation from one frame to another as a vector [rad], no longer than pi, global axes."""
    q = from_frame(other @ frame.T)
    q = jnp.where(q[0] < 0, -q, q)
    squared = jnp.sum(q[1:] ** 2)
    # Series near zero, where the derivative of the length is infinite.
    is_small = squared < 1e-4
    length = jnp.sqrt(jnp.where(is_small, 1.0, squared))
    series = 1 + squared / 6 + 3 * squared**2 / 40 + 5 * squared**3 / 112
    return 2 * jnp.where(is_small, series, jnp.arctan2(length, q[0]) / length) * q[1:]


def nearer(q: Float[Array, "4 *k"], other: Float[Array, "4 *k"]) -> Float[Array, "4 *k"]:
    """The one of the two quaternions of a rotation that is nearer to another."""
    return jnp.where(dot(q, other)[None] < 0, -q, q)


def continuous(q: Float[Array, "4 k"]) -> Float[Array, "4 k"]:
    """Of the two quaternions of each frame the one that is nearer to that of the last."""
    products = dot(q[:, 1:], q[:, :-1])
    signs = jnp.concatenate([jnp.ones_like(products[:1]), jnp.cumprod(jnp.where(products < 0, -1.0, 1.0))])
    return signs.astype(q.dtype)[None] * q


def screw(
    rotation: Float[Array, "3 *k"], translation: Float[Array, "3 *k"]
) -> tuple[Float[Array, "4 *k"], Float[Array, "3 *k"]]:
    """What a unit of time makes of a motion with this constant rate of turn and velocity, both in its own axes."""
    squared, is_small, angle, half, quaternion = _by_vector(rotation)
    first = 2 * half**2  # (1 - cos)/angle^2
    series = 1 / 6 - squared / 120 + squared**2 / 5040
    second = jnp.where(is_small, series, (angle - jnp.sin(angle)) / angle**3)
    across = cross(rotation, translation)
    way = translation + first[None] * across + second[None] * cross(rotation, across)
    return quaternion, way


def by_rotation_vector(rotation: Float[Array, "3 *k"]) -> Float[Array, "4 *k"]:
    """The quaternion of a rotation vector [rad]."""
    return _by_vector(rotation)[-1]


def _by_vector(rotation: Float[Array, "3 *k"]) -> tuple[Array, Array, Array, Array, Float[Array, "4 *k"]]:
    """Square and length of a rotation vector (1 where it is small), whether it is, sin(angle/2)/angle, quaternion."""
    squared = dot(rotation, rotation)
    is_small = squared < SMALL**2
    angle = jnp.sqrt(jnp.where(is_small, 1.0, squared))
    half = jnp.where(is_small, 0.5 - squared / 48 + squared**2 / 3840, jnp.sin(angle / 2) / angle)
    cosine = jnp.where(is_small, 1 - squared / 8 + squared**2 / 384, jnp.cos(angle / 2))
    return squared, is_small, angle, half, jnp.concatenate([cosine[None], half[None] * rotation])
