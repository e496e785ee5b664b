"""Fourth-order elements: three tangents an element, joined by a curve of quadratic rotation, under Simpson's rule.

An element of reference length h has unit tangents a, b, c at its start, middle and end; a and c it shares with its
neighbours, so that the tangent is continuous and the curvature may jump. Seen from b, the tangent in between is the
rotation vector v(s), a parabola through v_a, 0 and v_c: circular arcs are exact. Curvature, tension and loads enter at
the three points with the weights of Simpson's rule: the Lobatto variant of the Galerkin method with quadratic
polynomials (Hall & Leok 2015), of fourth order at the nodes. The centerline follows from its tangents by the same rule.

The rotation from b to a by an angle t has the length t in v only as far as t^10, and beyond grows without bound as
t approaches pi: an element has no way through a fold. All strains are rational functions of the three chords.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.joints import Joints, components, cross, dot, outer, twist_derivatives
from rodjax.discretization.mixed import MixedForm, MixedPoint
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import Blocks
from rodjax.discretization.twist import angle_about, transport_along
from rodjax.energy import axial_strain_under, density
from rodjax.rod import Rod
from rodjax.scene import Scene
from rodjax.strain import swept_angle
from rodjax.supports import Directed, Free, Held

# Simpson's weights of the three points of an element.
SIMPSON = (1 / 6, 4 / 6, 1 / 6)
# The pairs of points whose chords shape an element, and the weights of their arcs in its twist: of the areas that
# polygons of half and whole elements enclose, Richardson's extrapolation.
PAIRS = ((0, 1), (1, 2), (0, 2))
ARC_WEIGHTS = (4 / 3, 4 / 3, -1 / 3)


class HermiteElements(eqx.Module):
    """n elements between nodes at the arclengths `s` in units of L: 0, ..., 1. Points are nodes and middles in turn."""

    s: Float[Array, "n+1"]

    @staticmethod
    def of(scene: Scene, s: Float[Array, "n+1"]) -> "HermiteElements":
        """On these nodes, of which the nearest is moved to each point force: the moment has a kink there."""
        places = [load.at for load in scene.point_forces]
        return HermiteElements(_with_nodes_at(s, jnp.sort(jnp.stack(places))) if places else s)

    @property
    def points(self) -> int:
        return 2 * len(self.s) - 1

    @property
    def h(self) -> Float[Array, "n"]:
        return jnp.diff(self.s)

    @property
    def weights(self) -> Float[Array, "m"]:
        return _assembled(*(weight * self.h for weight in SIMPSON))

    @property
    def places(self) -> Float[Array, "m"]:
        """Arclengths of the points."""
        return _interleaved(self.s, (self.s[:-1] + self.s[1:]) / 2)

    @property
    def finest(self) -> Float[Array, ""]:
        """The shortest distance between points."""
        return jnp.min(self.h) / 2

    def with_held(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        return tangents

    def basis(self, scene: Scene, bases: Float[Array, "3 b m"]) -> Float[Array, "3 b m"]:
        """The directions in which each tangent may turn: none where a support holds it."""
        if isinstance(scene.start, Directed):
            bases = bases.at[..., 0].set(0.0)
        if isinstance(scene.end, Directed):
            bases = bases.at[..., -1].set(0.0)
        return bases

    def held(self, scene: Scene, diagonal: Float[Array, "b b m"]) -> Float[Array, "b b m"]:
        """With a unit block for each tangent that does not turn."""
        identity = jnp.eye(len(diagonal), dtype=diagonal.dtype)
        if isinstance(scene.start, Directed):
            diagonal = diagonal.at[..., 0].set(identity)
        if isinstance(scene.end, Directed):
            diagonal = diagonal.at[..., -1].set(identity)
        return diagonal

    # --- strains -----------------------------------------------------------------------------------------------------

    def bending_energy(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, ""]:
        return jnp.sum(_bending_energies(scene.rod, _half_squared_chords(tangents), self.h))

    def bending(
        self, scene: Scene, tangents: Float[Array, "3 m"], bases: Float[Array, "3 b m"]
    ) -> tuple[Float[Array, ""], Blocks]:
        """The bending energy and its derivatives by rotations of the tangents."""
        chords = _half_squared_chords(tangents)

        def gradient(chords):
            return jax.grad(lambda chords: jnp.sum(_bending_energies(scene.rod, chords, self.h)))(chords)

        first, by_all = jax.linearize(gradient, chords)
        along = jnp.eye(3, dtype=chords.dtype)[..., None] * jnp.ones_like(chords)[None]
        second = jax.vmap(by_all)(along)  # each chord changed in all elements at once
        return jnp.sum(_bending_energies(scene.rod, chords, self.h)), _by_chords(
            first, second, tangents, self.basis(scene, bases)
        )

    def twist(self, scene: Scene, tangents: Float[Array, "3 m"], bases: Float[Array, "3 b m"]) -> Blocks:
        """Derivatives of the total twist by rotations of the tangents."""
        points, point_bases = _of_elements(tangents), _of_elements(self.basis(scene, bases))
        gradient, blocks = [0.0] * 3, {}
        for (i, j), weight in zip(PAIRS, ARC_WEIGHTS, strict=True):
            arc = twist_derivatives(Joints(points[i], points[j], self.h), (point_bases[i], point_bases[j]))
            arc = jax.tree.map(lambda leaf, weight=weight: weight * leaf, arc)
            gradient[i] += arc.before
            gradient[j] += arc.after
            blocks[i, i] = blocks.get((i, i), 0.0) + arc.before_before
            blocks[j, j] = blocks.get((j, j), 0.0) + arc.after_after
            blocks[j, i] = arc.after_before
        return _blocks(gradient, blocks)

    def swept(self, scene: Scene, old: Float[Array, "3 m"], new: Float[Array, "3 m"]) -> Float[Array, ""]:
        """What the total twist gains as the tangents move while the end frames follow by smallest rotations [rad]."""
        return jnp.sum(_arcs(_of_elements(new), _of_elements(old)))

    def by_end_tangents(
        self, scene: Scene, tangents: Float[Array, "3 m"], end_force: Float[Array, "3"], torque: Float[Array, ""]
    ) -> tuple[Float[Array, "3 n"], Float[Array, "3 n"]]:
        """The derivatives of what each element adds to the Lagrangian by the tangents of its start and end."""
        rod = scene.rod
        forces = end_force[:, None, None] + self.forces_in_elements(scene)

        def lagrangian(start, end):
            points = jnp.stack([start, tangents[:, 1::2], end], axis=1)
            a, b, c = points[:, 0], points[:, 1], points[:, 2]
            bending = _bending_energies(rod, _half_squared_chords_of((a, b, c)), self.h)
            tension = jnp.sum(forces * points, axis=0)
            strain = axial_strain_under(rod, tension)
            weights = jnp.array(SIMPSON, tension.dtype)[:, None] * self.h[None]
            stretching = jnp.sum(weights * (density(rod, axial_strain=strain) - tension * (1 + strain)))
            twist = jnp.sum(_arcs((a, b, c), _of_elements(tangents)))
            return jnp.sum(bending) + stretching + torque * twist

        start, end = tangents[:, 0:-1:2], tangents[:, 2::2]
        return jax.grad(lagrangian, argnums=(0, 1))(start, end)

    def carried(self, d1: Float[Array, "3"], tangents: Float[Array, "3 m"]) -> Float[Array, "3 n+1"]:
        """`d1` at the first tangent carried along the curve without twist, to the nodes."""
        along = transport_along(d1, tangents)[:, ::2]
        nodes = tangents[:, ::2]
        straight = nodes[:, :-1] + nodes[:, 1:]
        straight /= jnp.sqrt(dot(straight, straight))[None]
        # A polygon lags behind the curve by a third of the area between whole and half elements, summed.
        a, b, c = _of_elements(tangents)
        swept = jax.vmap(swept_angle, in_axes=1)
        bulge = swept(a, b, a, straight) + swept(b, c, straight, c)
        angle = -jnp.concatenate([jnp.zeros_like(bulge[:1]), jnp.cumsum(bulge)]) / 3
        return jnp.cos(angle)[None] * along + jnp.sin(angle)[None] * cross(nodes, along)

    def total_twist(
        self, tangents: Float[Array, "3 m"], start_d1: Float[Array, "3"], end_d1: Float[Array, "3"]
    ) -> Float[Array, ""]:
        """Total twist between end frames with these directors [rad], up to whole turns."""
        return angle_about(tangents[:, -1], self.carried(start_d1, tangents)[:, -1], end_d1)

    # --- places and loads --------------------------------------------------------------------------------------------

    def ways(self, slopes: Float[Array, "3 m"]) -> Float[Array, "n 3"]:
        """From node to node, of a curve with these derivatives by arclength at the points."""
        parts = _of_elements(slopes)
        return (self.h[None] * sum(weight * part for weight, part in zip(SIMPSON, parts, strict=True))).T

    def forces_beyond(self, scene: Scene) -> Float[Array, "3 m"]:
        """What the loads beyond each point exert on it; where the start is free, less all of them."""
        of_elements = self.forces_in_elements(scene)
        parts = (weight * self.h[None] * of_elements[:, k] for k, weight in enumerate(SIMPSON))
        return _assembled(*parts) / self.weights[None]

    def forces_in_elements(self, scene: Scene) -> Float[Array, "3 3 n"]:
        """The same at start, middle and end of each element, on its side of a point force at a node."""
        starts_held = isinstance(scene.start, Held)
        forces = jnp.zeros((3, 3, len(self.h)), self.s.dtype)
        if scene.gravity is not None:
            places = jnp.stack(_of_elements(self.places))
            forces += scene.gravity[:, None, None] * (1.0 - places if starts_held else -places)[None]
        for load in scene.point_forces:
            before = self._part_before(load.at)
            forces += load.force[:, None, None] * (before if starts_held else before - 1.0)[None]
        if isinstance(scene.start, Free) and scene.start.force is not None:
            forces -= scene.start.force[:, None, None]
        if isinstance(scene.end, Free) and scene.end.force is not None:
            forces += scene.end.force[:, None, None]
        return forces

    def _part_before(self, at: Float[Array, ""]) -> Float[Array, "3 n"]:
        """How much of the weight of each point of an element lies before an arclength: parabolas, integrated so far."""
        x = jnp.clip((at - self.s[:-1]) / self.h, 0.0, 1.0)
        parts = (x - 3 * x**2 / 2 + 2 * x**3 / 3, 2 * x**2 - 4 * x**3 / 3, 2 * x**3 / 3 - x**2 / 2)
        return jnp.stack([part / weight for part, weight in zip(parts, SIMPSON, strict=True)])

    def residual(self, scene: Scene, gradient: Float[Array, "3 m"], lengths: Float[Array, "m"]) -> Float[Array, ""]:
        """Largest component of the moment left at a point, per length of rod."""
        return jnp.max(jnp.abs(gradient) / lengths[None])


class Curve(Shape):
    """Nodes at the arclengths `s` in units of L, and the tangents at nodes and middles in turn."""

    nodes: Float[Array, "n+1 3"]
    tangents: Float[Array, "3 m"]
    s: Float[Array, "n+1"]

    @property
    def unknown_tangents(self) -> Float[Array, "3 m"]:
        return self.tangents

    @staticmethod
    def through(points: Float[Array, "m 3"]) -> "Curve":
        # Every second point becomes a node.
        ends = (-3 * points[0] + 4 * points[1] - points[2], points[-3] - 4 * points[-2] + 3 * points[-1])
        slopes = jnp.concatenate([ends[0][None], points[2:] - points[:-2], ends[1][None]]).T
        nodes = points[::2]
        s = jnp.linspace(0.0, 1.0, len(nodes), dtype=nodes.dtype)
        return Curve(nodes, slopes / jnp.sqrt(dot(slopes, slopes))[None], s)

    def in_units(self, scale: Float[Array, ""], shift: Float[Array, "3"]) -> "Curve":
        return Curve(self.nodes * scale + shift[None], self.tangents, self.s)

    def reached(self, form: MixedForm, point: MixedPoint) -> "Curve":
        return Curve(form.nodes(form.edges(point)), point.tangents, form.field.s)

    def change_to(self, other: Any) -> Float[Array, ""]:
        return jnp.max(jnp.abs(other.nodes - self.nodes))

    def extrapolated(self, older: Any, ratio: Float[Array, ""]) -> "Curve":
        tangents = self.tangents + ratio * (self.tangents - older.tangents)
        return Curve(self.nodes, tangents / jnp.sqrt(dot(tangents, tangents))[None], self.s)

    def on(self, s: Float[Array, "n+1"]) -> "Curve":
        """The same on other nodes, to begin a solve with."""
        places = _interleaved(s, (s[:-1] + s[1:]) / 2)
        cell = jnp.clip(jnp.searchsorted(self.s, places, side="right") - 1, 0, len(self.s) - 2)
        x = ((places - self.s[cell]) / (self.s[cell + 1] - self.s[cell]))[None]
        a, b, c = (part[:, cell] for part in _of_elements(self.tangents))
        tangents = (1 - x) * (1 - 2 * x) * a + 4 * x * (1 - x) * b + x * (2 * x - 1) * c
        nodes = jax.vmap(lambda coordinate: jnp.interp(s, self.s, coordinate), 1, 1)(self.nodes)
        return Curve(nodes, tangents / jnp.sqrt(dot(tangents, tangents))[None], s)

    def turned_to_ends(self, scene: Scene, places: Float[Array, "m"]) -> Float[Array, "3 m"]:
        """The tangents turned to those that the supports hold, by less and less away from them."""
        tangents = self.tangents
        if isinstance(scene.start, Directed):
            tangents = _turned(tangents, tangents[:, 0], scene.start.tangent, 1.0 - places)
            tangents = tangents.at[:, 0].set(scene.start.tangent)
        if isinstance(scene.end, Directed):
            tangents = _turned(tangents, tangents[:, -1], scene.end.tangent, places)
            tangents = tangents.at[:, -1].set(scene.end.tangent)
        return tangents


def _turned(
    tangents: Float[Array, "3 m"], old: Float[Array, "3"], new: Float[Array, "3"], part: Float[Array, "m"]
) -> Float[Array, "3 m"]:
    """Turned by parts of the smallest rotation from one unit vector to another; the same bits where these are equal."""
    axis = jnp.cross(old, new)
    sine = jnp.sqrt(jnp.sum(axis**2))
    turns = jnp.any(old != new) & (sine > 0)
    axis /= jnp.where(turns, sine, 1.0)
    angle = part * jnp.arctan2(sine, jnp.sum(old * new))
    along = axis[:, None] * (axis @ tangents)[None]
    across = cross(jnp.broadcast_to(axis[:, None], tangents.shape), tangents)
    turned = along + jnp.cos(angle)[None] * (tangents - along) + jnp.sin(angle)[None] * across
    return jnp.where(turns, turned, tangents)


def _with_nodes_at(s: Float[Array, "n+1"], places: Float[Array, "k"]) -> Float[Array, "n+1"]:
    """The nodes, of which the nearest to each of the sorted places is moved there, but for the ends.

    Of places that are nearer to one another than an element some may get none.
    """
    n = len(s) - 1
    index = jnp.arange(n + 1)
    for k in range(len(places)):
        nearest = jnp.argmin(jnp.abs(s - places[k]))
        taken = (nearest == 0) | (nearest == n)
        s = jnp.where((index == nearest) & ~taken, places[k], s)
    return s


def _of_elements(by_point: Float[Array, "... m"]) -> tuple[Array, Array, Array]:
    """What belongs to start, middle and end of the elements."""
    return by_point[..., 0:-1:2], by_point[..., 1::2], by_point[..., 2::2]


def _arcs(new: tuple[Array, Array, Array], old: tuple[Array, Array, Array]) -> Float[Array, "n"]:
    """What the total twist gains in each element as its tangents move and the frames follow by smallest rotations."""
    swept = jax.vmap(swept_angle, in_axes=1)
    arcs = [w * swept(new[i], new[j], old[i], old[j]) for (i, j), w in zip(PAIRS, ARC_WEIGHTS, strict=True)]
    return arcs[0] + arcs[1] + arcs[2]


def _interleaved(nodes: Float[Array, "... n+1"], middles: Float[Array, "... n"]) -> Float[Array, "... m"]:
    pairs = jnp.stack([nodes[..., :-1], middles], axis=-1)
    return jnp.concatenate([pairs.reshape(*nodes.shape[:-1], -1), nodes[..., -1:]], axis=-1)


def _assembled(start: Float[Array, "... n"], middle: Float[Array, "... n"], end: Float[Array, "... n"]) -> Array:
    """Sums over the elements at each point."""
    none = jnp.zeros_like(start[..., :1])
    nodes = jnp.concatenate([start, none], axis=-1) + jnp.concatenate([none, end], axis=-1)
    return _interleaved(nodes, middle)


def _blocks(gradient: list, blocks: dict) -> Blocks:
    """Element by element -> point by point. `blocks[i, j]`: derivative by point i, then j <= i."""
    return Blocks(
        gradient=_assembled(*gradient),
        diagonal=_assembled(*(blocks[i, i] for i in range(3))),
        lower=jnp.stack([blocks[1, 0], blocks[2, 1]], axis=-1).reshape(*blocks[1, 0].shape[:2], -1),
        across=blocks[2, 0],
    )


def _half_squared_chords(tangents: Float[Array, "3 m"]) -> Float[Array, "3 n"]:
    """1 - cos of the angles between the points of each pair, without cancellation."""
    return _half_squared_chords_of(_of_elements(tangents))


def _half_squared_chords_of(points: tuple[Array, Array, Array]) -> Float[Array, "3 n"]:
    differences = [points[j] - points[i] for i, j in PAIRS]
    return jnp.stack([dot(difference, difference) / 2 for difference in differences])


def _by_chords(
    first: Float[Array, "3 n"], second: Float[Array, "3 3 n"], tangents: Float[Array, "3 m"], bases: Array
) -> Blocks:
    """Derivatives by rotations from those by the three chords of each element."""
    points, point_bases = _of_elements(tangents), _of_elements(bases)
    # 1 - a.b changes by -e.b as a turns along e, and as fast again by a.b.
    by_point: list[dict[int, Array]] = [{}, {}, {}]
    for p, (i, j) in enumerate(PAIRS):
        by_point[i][p] = -components(point_bases[i], points[j])
        by_point[j][p] = -components(point_bases[j], points[i])
    identity = jnp.eye(bases.shape[1], dtype=bases.dtype)[..., None]
    gradient = [sum(first[p][None] * change for p, change in by_point[i].items()) for i in range(3)]
    blocks = {}
    for i, j in ((0, 0), (1, 1), (2, 2), (1, 0), (2, 1), (2, 0)):
        terms = [
            second[p][q][None, None] * outer(by_p, by_q)
            for p, by_p in by_point[i].items()
            for q, by_q in by_point[j].items()
        ]
        if i == j:
            terms += [(first[p] * dot(*(points[k] for k in PAIRS[p])))[None, None] * identity for p in by_point[i]]
        else:
            between = jnp.sum(point_bases[i][:, :, None] * point_bases[j][:, None, :], axis=0)
            terms.append(-first[PAIRS.index((j, i))][None, None] * between)
        blocks[i, j] = sum(terms[1:], terms[0])
    return _blocks(gradient, blocks)


def _bending_energies(rod: Rod, chords: Float[Array, "3 n"], h: Float[Array, "n"]) -> Float[Array, "n"]:
    squared = [curvature / h**2 for curvature in _squared_curvatures(chords)]
    parts = [weight * density(rod, squared_curvature=k) for weight, k in zip(SIMPSON, squared, strict=True)]
    return h * sum(parts[1:], parts[0])


def _squared_curvatures(chords: Float[Array, "3 n"]) -> list[Float[Array, "n"]]:
    """|dt/dx|^2, x = s/h, at start, middle and end of an element, from `_half_squared_chords`."""
    ab, bc, ac = chords
    u, w = ab / 2, bc / 2  # squared sines of half the angles
    ratio_u, rest_u = _series(u)
    ratio_w, rest_w = _series(w)
    squared_a, squared_c = 4 * u * ratio_u, 4 * w * ratio_w  # |v_a|^2, |v_c|^2
    product = jnp.sqrt(ratio_u * ratio_w / ((1 - u) * (1 - w))) * (ab + bc - ac - ab * bc)  # v_a . v_c

    def at_end(squared, other, x, ratio, rest):
        # v changes by 3 v_a + v_c; across v_a that moves the tangent only by sin(t)/t as much.
        whole = 9 * squared + other + 6 * product
        return whole - (x * rest / ratio) * other + rest / (4 * ratio**2) * product**2

    return [
        at_end(squared_a, squared_c, u, ratio_u, rest_u),
        squared_a + squared_c - 2 * product,
        at_end(squared_c, squared_a, w, ratio_w, rest_w),
    ]


def _series(x: Float[Array, "n"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """t^2/(4 x) for x = sin(t/2)^2 as far as x^4, then growing to infinity at x = 1; and what it is above 1 - x, by x.

    t^2/4 = x + x^2/3 + 8 x^3/45 + 4 x^4/35 + 128 x^5/1575 + ...
    """
    tail = x**3 * (128 / 1575) / (1 - x)
    above = 1 / 3 + x * (8 / 45) + x**2 * (4 / 35) + tail
    return 1 + x * above, 1 + above
