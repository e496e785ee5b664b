"""Fourth-order elements: three tangents an element, joined by a curve of quadratic rotation, under Simpson's rule.

An element of reference length h has unit tangents a, b, c at its start, middle and end; a and c it shares with its
neighbours, so that the tangent is continuous and the curvature may jump. Seen from b, the tangent in between is the
rotation vector v(s), a parabola through v_a, 0 and v_c: circular arcs are exact. Curvature, tension and loads enter at
the three points with the weights of Simpson's rule: the Lobatto variant of the Galerkin method with quadratic
polynomials (Hall & Leok 2015), of fourth order at the nodes. The centerline follows from its tangents by the same rule.

The rotation from b to a by an angle t has the length t in v only as far as t^10, and beyond grows without bound as
t approaches pi: an element has no way through a fold. All strains are rational functions of the three chords.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.dead_loads import forces_beyond_points
from rodjax.discretization.element_bending import SIMPSON, bending_energies, by_chords
from rodjax.discretization.element_pairs import (
    ARC_WEIGHTS,
    added,
    blocks_of_pairs,
    by_points,
    by_rotations,
    flat,
    half_squared_chords,
    of_pairs,
)
from rodjax.discretization.element_points import interleaved, of_elements, parts_before, scatter_add
from rodjax.discretization.form import Form
from rodjax.discretization.joints import Joints, tangent_bases, twist_derivatives, twist_gradient
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.nodes import held_nodes, with_nodes_of
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import Blocks
from rodjax.discretization.twist import angle_about, carried_in_bases, turns_of_bases
from rodjax.geometry.interpolation import cubic
from rodjax.geometry.vectors import cross, dot, root
from rodjax.linalg.blocks import partial_sums
from rodjax.mechanics.energy import axial_strain_under, density
from rodjax.mechanics.strain import swept_angle
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Directed
from rodjax.programs.parts import traced_once


class QuadraticRotationElements(eqx.Module):
    """n elements between nodes at the arclengths `s` in units of L: 0, ..., 1. Points are nodes and middles in turn.

    `clip_nodes`: the numbers of the nodes at which clips hold the rod, where there are clips.
    """

    s: Float[Array, "n+1"]
    clip_nodes: Int[Array, "clips"] | None = None

    @staticmethod
    def of(scene: Scene, s: Float[Array, "n+1"]) -> "QuadraticRotationElements":
        """On these nodes, moved so that one lies at each clip, each point force and each jump of a load."""
        return QuadraticRotationElements(*with_nodes_of(scene, s))

    @property
    def points(self) -> int:
        return 2 * len(self.s) - 1

    @property
    def h(self) -> Float[Array, "n"]:
        return jnp.diff(self.s)

    @property
    def weights(self) -> Float[Array, "m"]:
        return scatter_add(*(weight * self.h for weight in SIMPSON))

    @property
    def arclengths(self) -> Float[Array, "m"]:
        """Arclengths of the points."""
        return interleaved(self.s, (self.s[:-1] + self.s[1:]) / 2)

    @property
    def finest(self) -> Float[Array, ""]:
        """The shortest distance between points."""
        return jnp.min(self.h) / 2

    def append_prescribed(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        return tangents

    def apply_prescribed(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        for is_there, tangent in self._directed(scene):
            tangents = jnp.where(is_there, tangent[:, None], tangents)
        return tangents

    def _directed(self, scene: Scene) -> list[tuple[Bool[Array, "m"], Float[Array, "3"]]]:
        """The points at which supports and clips hold the tangent, each marked along the rod, and what it is there."""
        number = jnp.arange(self.points)
        held = [(number == 2 * held.node, held.tangent) for held in held_nodes(scene, self.clip_nodes)]
        for end, point in ((scene.end, self.points - 1), (scene.start, 0)):
            if isinstance(end, Directed):
                held.insert(0, (number == point, end.tangent))
        return held

    def _is_directed(self, scene: Scene) -> Bool[Array, "m"]:
        none = jnp.zeros(self.points, bool)
        return functools.reduce(jnp.logical_or, (is_there for is_there, _ in self._directed(scene)), none)

    def basis(self, scene: Scene, bases: Float[Array, "3 b m"]) -> Float[Array, "3 b m"]:
        """The directions in which each tangent may turn: none where a support holds it."""
        return jnp.where(self._is_directed(scene), 0.0, bases)

    def held(self, scene: Scene, diagonal: Float[Array, "b b m"]) -> Float[Array, "b b m"]:
        """With a unit block for each tangent that does not turn."""
        identity = np.eye(len(diagonal), dtype=diagonal.dtype)[..., None]
        return jnp.where(self._is_directed(scene), identity, diagonal)

    # --- strains -----------------------------------------------------------------------------------------------------

    def bending_energy(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, ""]:
        return jnp.sum(bending_energies(functools.partial(density, scene.rod), half_squared_chords(tangents), self.h))

    def bending(
        self, scene: Scene, tangents: Float[Array, "3 m"], bases: Float[Array, "3 b m"]
    ) -> tuple[Float[Array, ""], Blocks]:
        """The bending energy and its derivatives by rotations of the tangents."""
        of_section = functools.partial(density, scene.rod)
        energies, first, second = by_chords(of_section, half_squared_chords(tangents), self.h)
        return jnp.sum(energies), by_rotations(first, second, tangents, self.basis(scene, bases))

    def twist(self, scene: Scene, tangents: Float[Array, "3 m"], bases: Float[Array, "3 b m"]) -> Blocks:
        """Derivatives of the total twist by rotations of the tangents."""
        points, point_bases = of_pairs(tangents), of_pairs(self.basis(scene, bases))
        spacing = jnp.broadcast_to(self.h[None], points[0].shape[1:])
        weights = jnp.array(ARC_WEIGHTS, spacing.dtype)[:, None]
        joints, joint_bases = jax.tree.map(flat, (Joints(*points, spacing), point_bases))
        arcs = jax.tree.map(
            lambda leaf: (
                leaf.reshape(*leaf.shape[:-1], *spacing.shape) * jnp.expand_dims(weights, range(leaf.ndim - 1))
            ),
            twist_derivatives(joints, joint_bases),
        )
        return blocks_of_pairs(
            gradient=by_points(arcs.before, arcs.after),
            diagonal=by_points(arcs.before_before, arcs.after_after),
            below=arcs.after_before,
        )

    def swept(self, scene: Scene, old: Float[Array, "3 m"], new: Float[Array, "3 m"]) -> Float[Array, ""]:
        """What the total twist gains as the tangents move while the end frames follow by smallest rotations [rad]."""
        half, _, whole = ARC_WEIGHTS
        halves = swept_angle(new[:, :-1], new[:, 1:], old[:, :-1], old[:, 1:])
        wholes = swept_angle(new[:, :-1:2], new[:, 2::2], old[:, :-1:2], old[:, 2::2])
        return half * jnp.sum(halves) + whole * jnp.sum(wholes)

    @traced_once
    def by_end_tangents(
        self, scene: Scene, tangents: Float[Array, "3 m"], forces: Float[Array, "3 2 n"], torque: Float[Array, ""]
    ) -> tuple[Float[Array, "3 n"], Float[Array, "3 n"]]:
        """The derivatives of what each element adds to the Lagrangian by the tangents of its start and end, where
        `forces` run through the rod.
        """
        _, by_chord, _ = by_chords(functools.partial(density, scene.rod), half_squared_chords(tangents), self.h)
        return self._by_end_tangents(scene, tangents, forces, torque, by_chord)

    def by_end_tangents_linearized(
        self, scene: Scene, tangents: Float[Array, "3 m"], forces: Float[Array, "3 2 n"], torque: Float[Array, ""]
    ) -> tuple[tuple[Array, Array], Callable[[Array, Array, Array], tuple[Array, Array]]]:
        """The same, and how it changes with tangents, forces and torque: of the bending by its second derivatives."""
        of_section = functools.partial(density, scene.rod)
        _, by_chord, second = by_chords(of_section, half_squared_chords(tangents), self.h)
        ends = functools.partial(self._by_end_tangents, scene)
        values, further = jax.linearize(ends, tangents, forces, torque, by_chord)

        def change(turned: Float[Array, "3 m"], forces: Float[Array, "3 2 n"], torque: Float[Array, ""]):
            _, chords = jax.jvp(half_squared_chords, (tangents,), (turned,))
            bent = jnp.stack([added(map(jnp.multiply, row, jnp.unstack(chords))) for row in second])
            return further(turned, forces, torque, bent)

        return values, change

    def _by_end_tangents(
        self,
        scene: Scene,
        tangents: Float[Array, "3 m"],
        forces: Float[Array, "3 2 n"],
        torque: Float[Array, ""],
        by_chord: Float[Array, "3 n"],
    ) -> tuple[Float[Array, "3 n"], Float[Array, "3 n"]]:
        first, last = of_pairs(tangents)
        normals = (torque * jnp.array(ARC_WEIGHTS, torque.dtype))[None, :, None] * twist_gradient(first, last)
        points = jnp.stack([tangents[:, 0:-1:2], tangents[:, 2::2]], axis=1)
        strain = axial_strain_under(scene.rod, dot(forces, points))
        stretching = (-SIMPSON[0] * self.h[None] * (1 + strain))[None] * forces
        by_first, by_last = normals - by_chord[None] * last, normals - by_chord[None] * first
        start = by_first[:, 0] + by_first[:, 2] + stretching[:, 0]
        end = by_last[:, 1] + by_last[:, 2] + stretching[:, 1]
        return start, end

    def carried(self, d1: Float[Array, "3"], tangents: Float[Array, "3 m"]) -> Float[Array, "3 n+1"]:
        """`d1` at the first tangent carried along the curve without twist, to the nodes."""
        bases = tangent_bases(tangents)
        return carried_in_bases(d1, bases[..., ::2], partial_sums(_turns_along(tangents, bases)))

    @traced_once
    def principal_twist(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, ""]:
        """The total twist between two clamps [rad], up to whole turns."""
        assert isinstance(scene.start, Clamp)
        assert isinstance(scene.end, Clamp)
        bases = tangent_bases(tangents)
        turned = jnp.sum(_turns_along(tangents, bases), keepdims=True)
        carried = carried_in_bases(scene.start.frame[:, 0], bases, turned)[:, 0]
        return angle_about(tangents[:, -1], carried, scene.end.frame[:, 0])

    # --- points by elements ------------------------------------------------------------------------------------------

    @property
    def quadrature_weights(self) -> Float[Array, "3 n"]:
        return jnp.array(SIMPSON, self.s.dtype)[:, None] * self.h[None]

    def tangents_in_clips(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, "3 clips"]:
        assert self.clip_nodes is not None
        return tangents[:, 2 * self.clip_nodes]

    def gather(self, by_point: Float[Array, "... m"]) -> Float[Array, "... 3 n"]:
        return jnp.stack(of_elements(by_point), axis=-2)

    def scatter_add(self, by_side: Float[Array, "... 3 n"]) -> Float[Array, "... m"]:
        return scatter_add(by_side[..., 0, :], by_side[..., 1, :], by_side[..., 2, :])

    # --- places and loads --------------------------------------------------------------------------------------------

    def loads_beyond(self, scene: Scene) -> Float[Array, "3 3 n"]:
        loads = [(load.force, 1.0 - parts_before(self.s, load.at), 1.0) for load in scene.point_forces]
        if scene.gravity is not None:
            loads.append((scene.gravity, jnp.stack(of_elements(self.arclengths)), 1.0))
        return forces_beyond_points(scene, self.clip_nodes, loads, jnp.zeros((3, len(self.h)), self.s.dtype))

    def residual(self, scene: Scene, gradient: Float[Array, "3 m"], lengths: Float[Array, "m"]) -> Float[Array, ""]:
        """Largest component of the moment left at a point, per length of rod."""
        return jnp.max(jnp.abs(gradient) / lengths[None])


class Curve(Shape):
    """Nodes at the arclengths `s` in units of L, and the tangents at nodes and middles in turn."""

    nodes: Float[Array, "n+1 3"]
    tangents: Float[Array, "3 m"]
    s: Float[Array, "n+1"]

    def point(self, end_force: Float[Array, "3 parts"], total_twist: Float[Array, ""]) -> MixedPoint:
        return MixedPoint(self.tangents, end_force, total_twist)

    def with_unknowns(self, point: MixedPoint) -> "Curve":
        return Curve(self.nodes, point.tangents, self.s)

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

    def reached(self, form: Form, point: MixedPoint) -> "Curve":
        return Curve(form.nodes_of(point), point.tangents, form.field.s)

    def change_to(self, other: Any) -> Float[Array, ""]:
        return jnp.max(jnp.abs(other.nodes - self.nodes))

    def extrapolated(self, older: Any, ratio: Float[Array, ""]) -> "Curve":
        tangents = self.tangents + ratio * (self.tangents - older.tangents)
        return Curve(self.nodes, tangents / jnp.sqrt(dot(tangents, tangents))[None], self.s)

    def points(self, pieces: int) -> Float[Array, "k 3"]:
        s = jnp.linspace(0.0, 1.0, pieces + 1, dtype=self.s.dtype)
        return cubic(self.s, self.nodes, self.tangents[:, ::2].T, s)

    def on(self, s: Float[Array, "n+1"]) -> "Curve":
        """The same on other nodes, to begin a solve with."""
        arclengths = interleaved(s, (s[:-1] + s[1:]) / 2)
        cell = jnp.clip(jnp.searchsorted(self.s, arclengths, side="right") - 1, 0, len(self.s) - 2)
        x = ((arclengths - self.s[cell]) / (self.s[cell + 1] - self.s[cell]))[None]
        a, b, c = (part[:, cell] for part in of_elements(self.tangents))
        tangents = (1 - x) * (1 - 2 * x) * a + 4 * x * (1 - x) * b + x * (2 * x - 1) * c
        nodes = jax.vmap(lambda coordinate: jnp.interp(s, self.s, coordinate), 1, 1)(self.nodes)
        return Curve(nodes, tangents / jnp.sqrt(dot(tangents, tangents))[None], s)

    def turned_to_ends(self, scene: Scene, arclengths: Float[Array, "m"]) -> Float[Array, "3 m"]:
        """The tangents turned to those that the supports hold, by less and less away from them."""
        tangents = self.tangents
        ends = [(0, scene.start, 1.0 - arclengths), (-1, scene.end, arclengths)]
        for k, end, part in ends:
            if isinstance(end, Directed):
                tangents = _turned(tangents, tangents[:, k], end.tangent, part)
        return _turned_in_clips(scene, tangents, arclengths) if scene.clips else tangents


def _turned_in_clips(scene: Scene, tangents: Float[Array, "3 m"], s: Float[Array, "m"]) -> Float[Array, "3 m"]:
    """The tangents turned to those that clips hold, by less and less towards the supports on both sides of each."""
    arclengths = [jnp.zeros_like(s[0]), *(clip.at for clip in scene.clips), jnp.ones_like(s[0])]
    for k, clip in enumerate(scene.clips):
        if clip.tangent is not None:
            before, at, after = arclengths[k : k + 3]
            near = jnp.minimum((s - before) / (at - before), (after - s) / (after - at))
            held = tangents[:, jnp.argmin(jnp.abs(s - at))]
            tangents = _turned(tangents, held, clip.tangent, jnp.maximum(near, 0.0))
    return tangents


def _turned(
    tangents: Float[Array, "3 m"], old: Float[Array, "3"], new: Float[Array, "3"], part: Float[Array, "m"]
) -> Float[Array, "3 m"]:
    """Turned by parts of the smallest rotation from one unit vector to another; the same bits where these are equal."""
    axis = cross(old, new)
    sine = root(dot(axis, axis))
    turns = (dot(new - old, new - old) > 0) & (sine > 0)
    axis = jnp.broadcast_to((axis / jnp.where(turns, sine, 1.0))[:, None], tangents.shape)
    angle = part * jnp.arctan2(sine, dot(old, new))
    along = axis * dot(axis, tangents)[None]
    turned = along + jnp.cos(angle)[None] * (tangents - along) + jnp.sin(angle)[None] * cross(axis, tangents)
    return jnp.where(turns, turned, tangents)


def _turns_along(tangents: Float[Array, "3 m"], bases: Float[Array, "3 2 m"]) -> Float[Array, "n"]:
    """The angles by which the bases turn about the curve along each element [rad]."""
    point_turns = turns_of_bases(tangents, bases)
    # A polygon lags behind the curve by a third of the area between whole and half elements.
    a, b, c = of_elements(tangents)
    straight = a + c
    straight *= 1 / jnp.sqrt(dot(straight, straight))[None]
    bulge = swept_angle(a, b, a, straight) + swept_angle(b, c, straight, c)
    return point_turns[::2] + point_turns[1::2] + bulge / 3
