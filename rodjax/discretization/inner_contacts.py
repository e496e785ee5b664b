"""Contact points within elements, as functions of the positions and tangents of both nodes.

With u = 1 - t and e = a - c the difference of the tangents at start and end of an element of length h, the centerline
at the part t of the element is

    x = (1 + 2 t) u^2 x_start + t^2 (3 - 2 t) x_end + h t u (u a - t c) + h t^2 u^2/24 |e|^2 e

the cubic through both nodes, and on circles of sixth order. Of each element the contact point with an obstacle is the
place where

    g = distance(x) - (1 - THINNER - at_nodes (2 t - 1)^2) radius

is least, so that it follows an edge or a thin pipe along the element; beside a support that holds the rod within the
obstacle it is in the middle. Where such an edge or pipe crosses the element, `at_nodes` is the least. First derivatives
of g are those at a fixed place; the second ones count that the place moves. A force p n there is virtual work on both
nodes: forces and couples.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization.potentials import of_pulls
from rodjax.geometry.vectors import cross, dot
from rodjax.model.along import Along, Value, value_at
from rodjax.model.obstacles import Obstacle

# Within elements the rod counts as thinner by these parts, in their middle and more at their nodes. Where it lies along
# an obstacle, nodes and places between them would say the same, and who bears it would be undetermined: so nodes do;
# and the place is in the middle then. On coarse meshes more, as much as the rod leaves the obstacle between nodes, but
# no more than `MOST_AT_NODES`: else the place would go from one end of an element to the other with what a step
# changes.
THINNER = 1e-5
AT_NODES = 8e-5
MOST_AT_NODES = 0.02
# A heavy beam held level at both ends sags by w h^4/EI times this.
SAG = 1 / 384
# Between nodes on an obstacle, whose curvature differs from that of the rod by c, the two part by c h^2 times this; a
# rod that is pulled tight around a pipe has the curvature of that but for some `SAME_CURVATURE` [1/L].
PARTING = 1 / 8
SAME_CURVATURE = 0.1
# So many times as sharp as that, the rod crosses the obstacle there, as an edge or a thin pipe, and does not lie along
# it: no more than `AT_NODES` then.
CROSSES = 100.0
# Places of an element among which the nearest one is, and steps of the search from there at most; what moves by less
# than `NEAR` has been found, as Newton's steps square their errors.
SAMPLES = (0.0, 0.25, 0.5, 0.75, 1.0)
STEPS = 8
NEAR = 1e-9
# The polynomials above, by the powers of t: of both positions, of both tangents times h, and of h |e|^2 e; then their
# first and second derivatives.
_SHAPES = np.array([[1, 0, -3, 2, 0], [0, 0, 3, -2, 0], [0, 1, -2, 1, 0], [0, 0, -1, 1, 0], [0, 0, 1, -2, 1]])
_SHAPES = _SHAPES / np.array([1, 1, 1, 1, 24])[:, None]
_DERIVATIVE = np.diag([1.0, 2, 3, 4], -1)
SHAPES = np.stack([_SHAPES, _SHAPES @ _DERIVATIVE, _SHAPES @ _DERIVATIVE @ _DERIVATIVE])
# An obstacle of more numbers, as a mesh, is touched in the middle of elements: its distances take too much time.
MOST_NUMBERS = 1000


class Elements(NamedTuple):
    """What the centerline within n elements depends on: position and tangent of the first and the last node of each,
    `axes` about which the tangents turn; `free`: 0 at nodes whose place is given, else 1; `at_nodes`: by which part of
    its radius the rod counts as thinner at the nodes where it lies along an obstacle.
    """

    positions: Float[Array, "3 2 n"]
    tangents: Float[Array, "3 2 n"]
    axes: Float[Array, "3 2 b n"]
    free: Float[Array, "2 n"]
    s: Float[Array, "n+1"]
    at_nodes: Float[Array, "n"]

    @staticmethod
    def of(
        positions: Float[Array, "n+1 3"],
        tangents: Float[Array, "3 n+1"],
        axes: Float[Array, "3 b n+1"],
        free: Float[Array, "n+1"],
        s: Float[Array, "n+1"],
        parting: Float[Array, "n"] | float = 0.0,
    ) -> "Elements":
        """`parting`: how far the rod leaves an obstacle between nodes, as a part of the radius."""

        def at_ends(of_nodes: Float[Array, "*c n+1"], axis: int) -> Float[Array, "*d n"]:
            return jnp.stack([of_nodes[..., :-1], of_nodes[..., 1:]], axis=axis)

        nodes = at_ends(positions.T, 1), at_ends(tangents, 1), at_ends(axes, 1), at_ends(free, 0)
        return Elements(*nodes, s, jnp.clip(jnp.broadcast_to(parting, s[1:].shape), AT_NODES, MOST_AT_NODES))

    @property
    def difference(self) -> Float[Array, "3 n"]:
        return self.tangents[:, 0] - self.tangents[:, 1]

    @property
    def turned(self) -> Float[Array, "3 2 b n"]:
        """The rates of the tangents, by rotations about the axes."""
        return cross(self.axes, jnp.broadcast_to(self.tangents[:, :, None], self.axes.shape))

    @property
    def signed(self) -> Float[Array, "3 2 b n"]:
        """The rates of the difference of the tangents."""
        return self.turned * np.array([1.0, -1.0], self.s.dtype)[None, :, None, None]

    @property
    def parts(self) -> Float[Array, "5 3 n"]:
        """What points are composed of by `SHAPES`."""
        h, e = jnp.diff(self.s), self.difference
        bulge = (h * dot(e, e))[None] * e
        both = jnp.concatenate([self.positions, h[None, None] * self.tangents, bulge[:, None]], axis=1)
        return jnp.swapaxes(both, 0, 1)

    def weights(
        self, t: Float[Array, "n"], derivative: int = 0
    ) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"], Float[Array, "n"]]:
        """Of the positions and tangents of both nodes, and of |e|^2 e, in the point or its derivatives by t."""
        h, found = jnp.diff(self.s), _shapes_at(t, SHAPES[derivative])
        return found[:2], h[None] * found[2:4], h * found[4]

    def at(self, t: Float[Array, "n"]) -> Float[Array, "3 n"]:
        """Points at the parts t of the elements."""
        return jnp.sum(_shapes_at(t, SHAPES[0])[:, None] * self.parts, axis=0)

    def with_derivatives(self, t: Float[Array, "q n"]) -> Float[Array, "3 q 3 n"]:
        """Points at these parts, and their first and second derivatives by t."""
        return jnp.sum(_shapes_at(t, SHAPES)[:, :, :, None] * self.parts[None, :, None], axis=1)

    def by_tangents(self, t: Float[Array, "n"], forces: Float[Array, "3 n"]) -> Float[Array, "3 2 n"]:
        """The derivatives of forces . x by the tangents of both nodes."""
        _, of_tangents, of_bulge = self.weights(t)
        e = self.difference
        along = of_bulge[None] * (dot(e, e)[None] * forces + 2 * dot(forces, e)[None] * e)
        return forces[:, None] * of_tangents[None] + jnp.stack([along, -along], axis=1)

    def motions(self, t: Float[Array, "n"], derivative: int = 0) -> Float[Array, "3 2 b+3 n"]:
        """The derivatives of points, or of their derivatives by t, by what moves the nodes: rotations about the axes,
        then the place.
        """
        of_positions, of_tangents, of_bulge = self.weights(t, derivative)
        e = self.difference
        bulging = dot(e, e)[None, None, None] * self.signed
        bulging += 2 * e[:, None, None] * jnp.sum(e[:, None, None] * self.signed, axis=0)[None]
        by_rotation = of_tangents[None, :, None] * self.turned + of_bulge[None, None, None] * bulging
        axes = jnp.eye(3, dtype=t.dtype)[:, None, :, None]
        return jnp.concatenate([by_rotation, axes * (of_positions * self.free)[None, :, None]], axis=2)

    def second(self, t: Float[Array, "n"], forces: Float[Array, "3 n"]) -> Float[Array, "2 b+3 2 b+3 n"]:
        """The second derivatives of forces . x at fixed places."""
        b, n = self.axes.shape[2:]
        _, _, of_bulge = self.weights(t)
        e = self.difference
        bulge = of_bulge[None] * e
        curving = forces[:, None] * bulge[None] + bulge[:, None] * forces[None]
        curving += dot(forces, bulge)[None, None] * jnp.eye(3, dtype=forces.dtype)[..., None]
        both = 2 * jnp.einsum("cebn,cdn,dfan->ebfan", self.signed, curving, self.signed)
        total = jnp.zeros((2, b + 3, 2, b + 3, n), forces.dtype).at[:, :b, :, :b].set(both)
        by_tangents = self.by_tangents(t, forces)
        for k in range(2):
            pulled = of_pulls(by_tangents[:, k], self.tangents[:, k], self.axes[:, k])
            total = total.at[k, :b, k, :b].add(-pulled.by_rotations)
        return total


class Places(NamedTuple):
    """Where n elements come nearest to each of q obstacles: the part t of the element, point, gap and its gradient by
    the point; of the gap the derivatives by t, and how the first of them changes with the point; `stays`: where t does
    not move with the rod; `at_nodes`: by which part of its radius the rod counts as thinner at the nodes.
    """

    t: Float[Array, "q n"]
    points: Float[Array, "q 3 n"]
    gaps: Float[Array, "q n"]
    normals: Float[Array, "q 3 n"]
    slope: Float[Array, "q n"]
    growth: Float[Array, "q n"]
    of_slope: Float[Array, "q 3 n"]
    stays: Bool[Array, "q n"]
    at_nodes: Float[Array, "q n"]

    @staticmethod
    def of(
        elements: Elements, obstacles: tuple[Obstacle, ...], radius: Value, is_held_within: Bool[Array, "q n+1"]
    ) -> "Places":
        """`is_held_within`: nodes that a support holds within an obstacle."""
        rows = [jnp.full_like(elements.s[1:], 0.5)] * len(obstacles)
        is_followed = [sum(leaf.size for leaf in jax.tree.leaves(one)) <= MOST_NUMBERS for one in obstacles]
        in_middle = is_held_within[:, :-1] | is_held_within[:, 1:] | ~jnp.array(is_followed)[:, None]
        followed = [k for k, is_one in enumerate(is_followed) if is_one]
        if followed:
            found = _nearest(elements, tuple(obstacles[k] for k in followed), radius)
            for k, row in zip(followed, found, strict=True):
                rows[k] = jnp.where(in_middle[k], 0.5, row)
        nearest = jnp.stack(rows)
        there = _seen(elements, obstacles, radius, nearest)
        return there._replace(stays=there.stays | in_middle)

    def rates(self, elements: Elements) -> Float[Array, "q 2 b+3 n"]:
        """The gradient of the gaps."""
        return _along(jax.vmap(elements.motions)(self.t), self.normals)

    def second(
        self, elements: Elements, obstacles: tuple[Obstacle, ...], pressures: Float[Array, "q n"]
    ) -> Float[Array, "2 b+3 2 b+3 n"]:
        """The second derivatives of -sum p g."""
        found = [
            jax.vmap(jax.hessian(obstacle.at), in_axes=-1, out_axes=-1)(points)
            for obstacle, points in zip(obstacles, self.points, strict=True)
        ]
        curving, moving = pressures[:, None, None] * jnp.stack(found), jax.vmap(elements.motions)(self.t)
        total = -jnp.sum(jax.vmap(elements.second)(self.t, pressures[:, None] * self.normals), axis=0)
        total -= jnp.einsum("qcean,qcdn,qdfbn->eafbn", moving, curving, moving)
        slopes = _along(moving, self.of_slope)
        slopes += _along(jax.vmap(lambda t: elements.motions(t, 1))(self.t), self.normals)
        weights = jnp.where(self.stays, 0.0, pressures / jnp.where(self.stays, 1.0, self.growth))
        return total + jnp.einsum("qn,qean,qfbn->eafbn", weights, slopes, slopes)


def _along(motions: Float[Array, "q 3 2 k n"], vectors: Float[Array, "q 3 n"]) -> Float[Array, "q 2 k n"]:
    return jnp.sum(motions * vectors[:, :, None, None], axis=1)


def _shapes_at(t: Float[Array, "*q"], shapes: Float[np.ndarray, "*d k 5"]) -> Array:
    """Polynomials by the coefficients of their powers, (*d, k, *q)."""
    powers = [jnp.ones_like(t), t]
    for _ in range(3):
        powers.append(powers[-1] * t)
    coefficients = shapes.astype(t.dtype)[(..., *[None] * t.ndim)]
    terms = coefficients * jnp.stack(powers)[(None,) * (shapes.ndim - 1)]
    return jnp.sum(terms, axis=shapes.ndim - 1)


def _seen(elements: Elements, obstacles: tuple[Obstacle, ...], radius: Value, t: Float[Array, "q n"]) -> Places:
    """At the parts t of the elements."""
    points, along, curving = elements.with_derivatives(t)
    found = []
    for obstacle, point, rate in zip(obstacles, points, along, strict=True):
        of_points = jax.vmap(jax.value_and_grad(obstacle.at), in_axes=-1, out_axes=(0, -1))
        found.append(jax.jvp(of_points, (point,), (rate,)))
    (distances, normals), (_, of_slope) = jax.tree.map(lambda *parts: jnp.stack(parts), *found)
    slope, growth = jnp.sum(normals * along, axis=1), jnp.sum(of_slope * along + normals * curving, axis=1)
    own = _own_radius(radius, elements, t)
    at_nodes = jnp.broadcast_to(elements.at_nodes[None], t.shape)
    at_nodes = jnp.where(growth - own[2] > CROSSES * 8 * at_nodes * own[0], AT_NODES, at_nodes)
    seen_radius, radius_slope, radius_growth = _seen_radius(own, at_nodes, t)
    slope, growth = slope - radius_slope, growth - radius_growth
    stays = ((t <= 0) & (slope >= 0)) | ((t >= 1) & (slope <= 0)) | (growth <= 0)
    return Places(t, points, distances - seen_radius, normals, slope, growth, of_slope, stays, at_nodes)


@eqx.filter_custom_jvp
def _nearest(elements: Elements, obstacles: tuple[Obstacle, ...], radius: Value) -> Float[Array, "q n"]:
    """The parts of the elements at which gaps are least, from the least of samples, by Newton's method where it stays
    between the samples beside that, else by halves.
    """
    samples, spacing = jnp.asarray(SAMPLES, elements.s.dtype), SAMPLES[1] - SAMPLES[0]
    everywhere = jnp.broadcast_to(samples[:, None], (len(samples), len(elements.s) - 1))
    points, own = jax.vmap(elements.at)(everywhere), _own_radius(radius, elements, everywhere)
    distances = jnp.stack([jax.vmap(jax.vmap(obstacle.at, in_axes=-1))(points) for obstacle in obstacles])
    seen_radius, _, _ = _seen_radius(own, elements.at_nodes[None], everywhere)
    first = samples[jnp.argmin(distances - seen_radius[None], axis=1)]

    def goes_on(state: tuple[Array, ...]) -> Bool[Array, ""]:
        *_, change, steps = state
        return (steps < STEPS) & jnp.any(change > NEAR)

    def nearer(state: tuple[Array, ...]) -> tuple[Array, ...]:
        t, low, high, _, _, _, steps = state
        there = _seen(elements, obstacles, radius, t)
        low, high = jnp.where(there.slope < 0, t, low), jnp.where(there.slope > 0, t, high)
        further = t - there.slope / jnp.where(there.growth > 0, there.growth, 1.0)
        is_between = (there.growth > 0) & (low <= further) & (further <= high)
        t_next = jnp.where(is_between, further, (low + high) / 2)
        return t_next, low, high, there.gaps, there.at_nodes, jnp.abs(t_next - t), steps + 1

    low, high = jnp.maximum(first - spacing, 0.0), jnp.minimum(first + spacing, 1.0)
    begin = first, low, high, distances[:, 0], jnp.zeros_like(first), jnp.ones_like(first), jnp.zeros((), int)
    t, _, _, reached, at_nodes, _, _ = jax.lax.while_loop(goes_on, nearer, begin)
    # Nearest at an end, to which halving comes near only.
    at_start, at_end = (distances[:, k] - own[0][None, k] * (1 - THINNER - at_nodes) for k in (0, -1))
    t = jnp.where(at_start <= reached, 0.0, t)
    return jnp.where(at_end <= jnp.minimum(reached, at_start), 1.0, t)


@_nearest.def_jvp
def _(given: tuple[Any, ...], changes: tuple[Any, ...]) -> tuple[Array, Array]:
    """The slope of the gap by the place stays 0."""
    t = _nearest(*given)
    there, change = eqx.filter_jvp(
        lambda elements, obstacles, radius: _seen(elements, obstacles, radius, t), given, changes
    )
    return t, jnp.where(there.stays, 0.0, -change.slope / jnp.where(there.stays, 1.0, there.growth))


def _own_radius(
    radius: Value, elements: Elements, t: Float[Array, "q n"]
) -> tuple[Float[Array, "q n"], Float[Array, "q n"], Float[Array, "q n"]]:
    """That of the rod at the parts t of the elements, and its first and second derivative by t."""
    if not isinstance(radius, Along):
        nothing = jnp.zeros_like(t)
        return jnp.broadcast_to(radius, t.shape), nothing, nothing
    s = elements.s
    begin, end = (jnp.broadcast_to(side[None], t.shape) for side in (s[:-1], s[1:]))

    def own(t: Float[Array, "q n"]) -> Float[Array, "q n"]:
        return value_at(radius, begin + t * (end - begin), begin, end)

    def with_rate(t: Float[Array, "q n"]) -> tuple[Float[Array, "q n"], Float[Array, "q n"]]:
        return jax.jvp(own, (t,), (jnp.ones_like(t),))

    (value, slope), (_, growth) = jax.jvp(with_rate, (t,), (jnp.ones_like(t),))
    return value, slope, growth


def _seen_radius(
    own: tuple[Float[Array, "q n"], Float[Array, "q n"], Float[Array, "q n"]],
    at_nodes: Float[Array, "q n"],
    t: Float[Array, "q n"],
) -> tuple[Float[Array, "q n"], Float[Array, "q n"], Float[Array, "q n"]]:
    """As which the rod counts at the parts t of the elements, and the first and second derivative of that by t."""
    (value, slope, growth), aside = own, 2 * t - 1
    counts, rate, second = 1 - THINNER - at_nodes * aside**2, -4 * at_nodes * aside, -8 * at_nodes
    return counts * value, rate * value + counts * slope, second * value + 2 * rate * slope + counts * growth
