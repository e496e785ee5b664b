"""What a rod shall not touch, as signed distances [m], negative inside.

The formulas of the primitives are those of I. Quilez, "Distance functions". A gradient has the length 1, but where a
distance has a kink (a centre, an axis, an edge, a place as far from one part as from another): there it is finite, and
no longer than 1.
"""

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import (
    Numbers,
    direction,
    instance,
    is_known,
    leaf,
    not_negative,
    number_array,
    positive,
    rotation,
    sequence,
    shown,
    vector,
)
from rodjax.geometry.vectors import dot, root
from rodjax.programs.compilation import compiled

# Points times numbers of an obstacle that are looked at together, the others after them: half a megabyte, which stays
# in the cache of a processor, so that meshes need no memory for all points, and other obstacles no loop.
AT_ONCE = 2**16


def coefficient(friction: Any) -> Float[Array, ""] | None:
    """A coefficient of friction as an obstacle stores it: `None` for the plain number 0."""
    is_plain = isinstance(friction, int | float | np.ndarray | np.generic) and not isinstance(friction, bool)
    if friction is None or (is_plain and np.ndim(friction) == 0 and friction == 0):
        return None
    return leaf(not_negative(friction, "friction"))


class Obstacle(eqx.Module):
    """A body, or several. Its numbers are differentiable; subclass it, with numbers as fields, to define another kind.

    `friction`: Coulomb's coefficient mu >= 0 between it and a rod, by keyword, of every obstacle: the tangential force
    at a contact is at most mu times its pressure. The plain number 0, the default, is stored as `None`: no term at all.
    It acts at the centerline, without a couple; `rodjax.solve_path` says how. Where only distances are looked at, as in
    clearances, it has no meaning.
    """

    friction: Float[Array, ""] | None = eqx.field(default=None, kw_only=True, converter=coefficient)

    @abstractmethod
    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Signed distance of one point [m], negative inside."""

    def distance(self, points: Any) -> Float[Array, "..."]:
        """Signed distances [m] of points (..., 3) [m], negative inside; one compiled program a shape of `points`."""
        return _distances(self, leaf(rows(points, "points", least=0, shape="(..., 3)")))


@compiled
def _distances(obstacle: Obstacle, points: Float[Array, "... 3"]) -> Float[Array, "..."]:
    flat = points.reshape(-1, 3)
    numbers = max(sum(leaf.size for leaf in jax.tree.leaves(obstacle)), 1)
    count = -(-len(flat) // max(AT_ONCE // numbers, 1)) or 1
    block = -(-len(flat) // count)
    blocks = jnp.pad(flat, ((0, count * block - len(flat)), (0, 0)), mode="edge").reshape(count, block, 3)
    return jax.lax.map(jax.vmap(obstacle.at), blocks).reshape(-1)[: len(flat)].reshape(points.shape[:-1])


class Plane(Obstacle):
    """The half space on one side of a plane, such as a floor.

    `point`: (3,) [m], of the plane; `normal`: (3,), any nonzero vector, pointing out of the solid.
    """

    point: Float[Array, "3"]
    normal: Float[Array, "3"]

    def __init__(self, point: Any, normal: Any, friction: Any = 0.0):
        self.friction = coefficient(friction)
        self.point = leaf(vector(point, "point"))
        self.normal = leaf(direction(normal, "normal"))

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        return dot(point - self.point, self.normal)


class Sphere(Obstacle):
    """A ball. `center`: (3,) [m]; `radius` [m]."""

    center: Float[Array, "3"]
    radius: Float[Array, ""]

    def __init__(self, center: Any, radius: Any, friction: Any = 0.0):
        self.friction = coefficient(friction)
        self.center = leaf(vector(center, "center"))
        self.radius = leaf(positive(radius, "radius"))

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        offset = point - self.center
        return root(dot(offset, offset)) - self.radius


class Capsule(Obstacle):
    """A solid cylinder with half balls for ends: all points within a distance of a segment.

    `start`, `end`: (3,) [m], of the segment; `radius` [m].
    """

    start: Float[Array, "3"]
    end: Float[Array, "3"]
    radius: Float[Array, ""]

    def __init__(self, start: Any, end: Any, radius: Any, friction: Any = 0.0):
        self.friction = coefficient(friction)
        self.start, self.end = _segment(start, end)
        self.radius = leaf(positive(radius, "radius"))

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        return root(squared_distance_to_segment(point, self.start, self.end)) - self.radius


class Pipe(Obstacle):
    """A pipe with bends, or another cable: all points within a distance of a line through points.

    `points`: (n, 3) [m], n >= 2, one after another; `radius` [m]. Of a rod at rest: `Pipe(result.nodes, radius)`.
    """

    points: Float[Array, "n 3"]
    radius: Float[Array, ""]

    def __init__(self, points: Any, radius: Any, friction: Any = 0.0):
        self.friction = coefficient(friction)
        self.points = leaf(rows(points, "points", least=2, shape="(n, 3), n >= 2"))
        if self.points.ndim != 2:
            raise ValueError(f"points must be numbers of shape (n, 3), got an array of shape {self.points.shape}")
        self.radius = leaf(positive(radius, "radius"))

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        squared = squared_distance_to_segment(point[:, None], self.points[:-1].T, self.points[1:].T)
        return root(squared[jnp.argmin(jax.lax.stop_gradient(squared))]) - self.radius


class Cylinder(Obstacle):
    """A solid cylinder with flat ends. `start`, `end`: (3,) [m], of its axis; `radius` [m]."""

    start: Float[Array, "3"]
    end: Float[Array, "3"]
    radius: Float[Array, ""]

    def __init__(self, start: Any, end: Any, radius: Any, friction: Any = 0.0):
        self.friction = coefficient(friction)
        self.start, self.end = _segment(start, end)
        self.radius = leaf(positive(radius, "radius"))

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        axis = self.end - self.start
        length = root(dot(axis, axis))
        offset = point - 0.5 * (self.start + self.end)
        along = dot(offset, axis) / length
        across = offset - along * (axis / length)
        return _beyond_walls(root(dot(across, across)) - self.radius, jnp.abs(along) - 0.5 * length)


class Box(Obstacle):
    """A cuboid.

    `center`: (3,) [m]; `size`: (3,) [m], its whole edges along the columns of `frame`; `frame`: (3, 3), a rotation,
    `None` for the global axes.
    """

    center: Float[Array, "3"]
    size: Float[Array, "3"]
    frame: Float[Array, "3 3"] | None

    def __init__(self, center: Any, size: Any, frame: Any = None, friction: Any = 0.0):
        self.friction = coefficient(friction)
        self.center = leaf(vector(center, "center"))
        self.size = leaf(vector(size, "size"))
        if is_known(self.size) and not np.all(np.asarray(self.size) > 0):
            raise ValueError(f"size must be positive numbers, got {shown(size)}")
        self.frame = None if frame is None else leaf(rotation(frame, "frame"))

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        offset = point - self.center
        along = offset if self.frame is None else dot(offset[:, None], self.frame)
        return _beyond_walls(*(jnp.abs(along) - 0.5 * self.size))


class Union(Obstacle):
    """Several obstacles as one: the distance from the nearest; inside of several, the true depth is at least as large.

    `obstacles`: one `Obstacle` or more, each an argument of its own.
    """

    obstacles: tuple[Obstacle, ...]

    def __init__(self, *obstacles: Obstacle, friction: Any = 0.0):
        self.friction = coefficient(friction)
        self.obstacles = checked_obstacles(obstacles)
        for k, obstacle in enumerate(self.obstacles):
            if obstacle.friction is not None:
                raise ValueError(f"obstacles[{k}].friction must be 0 within a Union, which has a friction of its own")

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        return least(*(obstacle.at(point) for obstacle in self.obstacles))


class Distance(Obstacle):
    """A user-defined distance.

    `function`: from a point (3,) [m] to its signed distance () [m], in JAX; results are only as exact as this function,
    and its gradient must be finite everywhere. Programs are compiled for the function itself: make it once, not for
    each call, and put numbers that change into a subclass of `Obstacle` instead.
    """

    function: Callable[[Float[Array, "3"]], Float[Array, ""]] = eqx.field(static=True)

    def __init__(self, function: Callable[[Float[Array, "3"]], Float[Array, ""]], friction: Any = 0.0):
        self.friction = coefficient(friction)
        if not callable(function):
            raise TypeError(f"function must be a function of a point (3,), got {shown(function)}")
        found = jax.eval_shape(function, jax.ShapeDtypeStruct((3,), jnp.zeros(()).dtype))
        if getattr(found, "shape", None) != ():
            raise ValueError(f"function must give one number for a point (3,), got {shown(found)}")
        self.function = function

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        return self.function(point)


class InUnits(Obstacle):
    """An obstacle in other units: seen from `origin` (3,) [m], in parts of `length` [m]."""

    obstacle: Obstacle
    origin: Float[Array, "3"]
    length: Float[Array, ""]

    def at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        return self.obstacle.at(self.origin + self.length * point) / self.length


def friction_coefficient(obstacle: Obstacle) -> Any:
    """Of an obstacle in any units; `None` without friction."""
    return obstacle.obstacle.friction if isinstance(obstacle, InUnits) else obstacle.friction


def has_other_side(obstacle: Obstacle) -> bool:
    """Whether a rod could come through it: not through half of all space."""
    return not isinstance(obstacle.obstacle if isinstance(obstacle, InUnits) else obstacle, Plane)


def rows(value: Any, name: str, least: int, shape: str) -> Float[Numbers, "... 3"]:
    """`value` as points, at least so many along its first axis; `shape` says in messages what is allowed."""
    try:
        value = value if is_known(value) else jnp.asarray(value)  # a list of traced ones has no shape
        given = np.shape(value)
    except ValueError:  # rows of several lengths
        raise TypeError(f"{name} must be numbers of shape {shape}, got {shown(value)}") from None
    if given[-1:] != (3,) or given[0] < least:
        raise ValueError(f"{name} must be numbers of shape {shape}, got an array of shape {given}")
    return number_array(value, name, given)


def checked_obstacles(obstacles: Any, least: int = 1) -> tuple[Obstacle, ...]:
    obstacles = sequence(obstacles, "obstacles", "Obstacle")
    if len(obstacles) < least:
        raise ValueError("obstacles must hold at least one Obstacle, got none")
    for k, obstacle in enumerate(obstacles):
        instance(obstacle, f"obstacles[{k}]", Obstacle)
        leaves, structure = jax.tree.flatten(obstacle)
        found = _shape_of_distance(
            structure, tuple((leaf.shape, leaf.dtype) if hasattr(leaf, "dtype") else leaf for leaf in leaves)
        )
        if found != ():
            raise ValueError(
                f"obstacles[{k}] must give one number for a point, got numbers of shape {found}, as from a stack of "
                "obstacles: of stacked scenes take one, such as jax.tree.map(lambda leaf: leaf[0], obstacle)"
            )
    return obstacles


@functools.lru_cache
def _shape_of_distance(structure: Any, leaves: tuple[Any, ...]) -> tuple[int, ...]:
    """Of one point from an obstacle of these leaves, plain numbers or shapes and types of arrays."""
    arrays = [jax.ShapeDtypeStruct(*leaf) if isinstance(leaf, tuple) else leaf for leaf in leaves]
    dtypes = [leaf[1] for leaf in leaves if isinstance(leaf, tuple)]
    point = jax.ShapeDtypeStruct((3,), dtypes[0] if dtypes else jnp.zeros(()).dtype)
    return jnp.shape(
        jax.eval_shape(lambda obstacle, point: obstacle.at(point), jax.tree.unflatten(structure, arrays), point)
    )


def squared_distance_to_segment(
    point: Float[Array, "3 *k"], start: Float[Array, "3 *k"], end: Float[Array, "3 *k"]
) -> Float[Array, "*k"]:
    """[m^2]; a segment without length is a point."""
    along, offset = end - start, point - start
    squared_length = dot(along, along)
    fraction = jnp.clip(dot(offset, along) / jnp.where(squared_length == 0, 1.0, squared_length), 0.0, 1.0)
    across = offset - fraction[None] * along
    return dot(across, across)


def _segment(start: Any, end: Any) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    start, end = leaf(vector(start, "start")), leaf(vector(end, "end"))
    if is_known(start, end) and np.array_equal(start, end):
        raise ValueError(f"end must differ from start, got {np.asarray(end).tolist()} for both")
    return start, end


def _beyond_walls(*heights: Float[Array, ""]) -> Float[Array, ""]:
    """Signed distance of a point from a convex body with walls at right angles, by its heights above them."""
    highest = -least(*(-height for height in heights))
    above = jnp.stack([jnp.where(height > 0, height, 0.0) for height in heights])
    # A choice, not a sum: on a wall both would have half of its gradient.
    return jnp.where(highest > 0, root(dot(above, above)), highest)


def least(*values: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """The least of several numbers, with the derivative of one of them.

    That of `jnp.minimum` is found by asking which number is equal to the least, and where XLA computes them twice, not
    to the same last bit, none is: the derivative would be 0.
    """
    return functools.reduce(lambda a, b: jnp.where(b < a, b, a), values)
