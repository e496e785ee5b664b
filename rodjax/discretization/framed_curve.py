"""What a solve by frames starts from and ends in."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import Cells, ElementCells, JointCells
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.form import Form
from rodjax.discretization.framed import FrameForm, FramePoint, of_cells, stacked
from rodjax.discretization.hermite import Curve
from rodjax.discretization.shape import Shape
from rodjax.discretization.twist import nearest_twist
from rodjax.guess import cubic, first_shape
from rodjax.rest import RestStrain
from rodjax.rotations import carried, from_frame, inverse, nearer, product, rotated, spun, swung, tangent, unit
from rodjax.scene import Scene, held_at_both_ends
from rodjax.supports import Clamp, Directed, Held, Swivel
from rodjax.vectors import dot


class FramedCurve(Shape):
    """Nodes at the arclengths `s` in units of L, and the frames of the cells."""

    nodes: Float[Array, "n+1 3"]
    quaternions: Float[Array, "4 m"]
    s: Float[Array, "n+1"]

    @property
    def is_of_joints(self) -> bool:
        return self.quaternions.shape[-1] == self.nodes.shape[-2] + 1

    def point(self, end_force: Float[Array, "3"], total_twist: Float[Array, ""]) -> FramePoint:
        return FramePoint(self.quaternions, end_force, total_twist)

    def in_units(self, scale: Float[Array, ""], shift: Float[Array, "3"]) -> "FramedCurve":
        return FramedCurve(self.nodes * scale + shift[None], self.quaternions, self.s)

    def reached(self, form: Form, point: FramePoint) -> "FramedCurve":
        return FramedCurve(form.nodes(form.edges(point)), point.quaternions, form.field.s)

    def change_to(self, other: Any) -> Float[Array, ""]:
        return jnp.max(jnp.abs(other.nodes - self.nodes))

    def extrapolated(self, older: Any, ratio: Float[Array, ""]) -> "FramedCurve":
        before = nearer(older.quaternions, self.quaternions)
        quaternions = self.quaternions + ratio * (self.quaternions - before)
        return FramedCurve(self.nodes, unit(quaternions), self.s)

    def points(self, pieces: int) -> Float[Array, "k 3"]:
        s = jnp.linspace(0.0, 1.0, pieces + 1, dtype=self.s.dtype)
        return cubic(self.s, self.nodes, tangent(self.cells.at_nodes(self.quaternions)).T, s)

    def on(self, s: Float[Array, "n+1"], of_joints: bool) -> "FramedCurve":
        """The same on other nodes, to begin a solve with."""
        old, new = self.cells.places, _cells(s, of_joints).places
        quaternions = jax.vmap(lambda component: jnp.interp(new, old, component))(self.quaternions)
        nodes = jax.vmap(lambda coordinate: jnp.interp(s, self.s, coordinate), 1, 1)(self.nodes)
        return FramedCurve(nodes, unit(quaternions), s)

    @property
    def cells(self) -> Cells:
        return _cells(self.s, self.is_of_joints)

    def turned_to_ends(self, scene: Scene, cells: Cells, twist: Float[Array, ""]) -> Float[Array, "4 m"]:
        """The frames turned to those that the supports hold, by less and less away from them; and between two clamps
        spun by whole turns to the total twist nearest to `twist`, or to the turns of the scene.
        """
        q, places = self.quaternions, cells.places
        for end, k, part in ((scene.start, 0, 1.0 - places), (scene.end, -1, places)):
            if isinstance(end, Directed):
                first = q[:, k]
                held = swung(first, end.tangent)
                if isinstance(end, Clamp):
                    held = nearer(from_frame(end.frame), first)
                change = product(held, inverse(first))
                # Half of the angle, and the same bits where there is none.
                size = jnp.sqrt(jnp.sum(change[1:] ** 2))
                is_turned = size > jnp.finfo(size.dtype).eps * 8
                half = part * jnp.arctan2(size, change[0])
                axis = change[1:] / jnp.where(is_turned, size, 1.0)
                turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half)[None] * axis[:, None]])
                q = jnp.where(is_turned, product(turn, q), q)
        if isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp):
            here = jnp.sum(cells.lengths * stacked(cells.strains(of_cells(cells, q)))[2])
            principal = here - 2 * jnp.pi * jnp.round(here / (2 * jnp.pi))
            turns = jnp.round((nearest_twist(principal, twist, scene.turns) - here) / (2 * jnp.pi))
            q = jnp.where(turns != 0, spun(q, 2 * jnp.pi * turns * places), q)
        return q


def _cells(s: Float[Array, "n+1"], of_joints: bool) -> Cells:
    return JointCells(s) if of_joints else ElementCells(s)


def form_of_frames(scene: Scene, shape: FramedCurve) -> FrameForm:
    return FrameForm.of(scene, shape.cells if shape.is_of_joints else ElementCells.of(scene, shape.s))


def framed_through(scene: Scene, points: Float[Array, "k 3"], of_joints: bool) -> FramedCurve:
    """Through points, as many as a mesh has nodes, or nodes and middles of elements; twisted as the rod at rest."""
    shape = (Polyline if of_joints else Curve).through(points)
    nodes, tangents = shape.nodes, shape.tangents
    if of_joints:
        tangents = jnp.concatenate([tangents[:, :1], tangents, tangents[:, -1:]], axis=1)
    s = jnp.linspace(0.0, 1.0, len(nodes), dtype=points.dtype)
    first = from_frame(scene.start.frame) if isinstance(scene.start, Clamp) else jnp.eye(1, 4, dtype=s.dtype)[0]
    # Not opposite to the first tangent.
    opposite = jnp.sum(tangent(first) * tangents[:, 0]) < -0.9
    first = jnp.where(opposite, product(first, jnp.array([0.0, 1.0, 0.0, 0.0], s.dtype)), first)
    twist = _twist_at_rest(scene, _cells(s, of_joints).places)
    return FramedCurve(nodes, spun(carried(first, tangents), twist), s)


def rest_twist(scene: Scene) -> Float[Array, ""]:
    """The total twist of the rod at rest."""
    return _twist_at_rest(scene, jnp.linspace(0.0, 1.0, 65, dtype=scene.rod.length.dtype))[-1]


def _twist_at_rest(scene: Scene, places: Float[Array, "m"]) -> Float[Array, "m"]:
    """By how much the rod at rest is twisted from its start to these places."""
    rest = scene.rod.rest_shape
    if rest is None:
        return jnp.zeros_like(places)
    twist = rest.at(places, *_neighbours(places))[2]
    steps = (twist[1:] + twist[:-1]) / 2 * jnp.diff(places)
    return jnp.concatenate([jnp.zeros_like(places[:1]), jnp.cumsum(steps)])


def _neighbours(places: Float[Array, "m"]) -> tuple[Float[Array, "m"], Float[Array, "m"]]:
    return jnp.concatenate([places[:1], places[:-1]]), jnp.concatenate([places[1:], places[-1:]])


def at_rest(scene: Scene, s: Float[Array, "n+1"], of_joints: bool) -> FramedCurve:
    """The rod at rest in the place to which one of its ends is held; in any place between two pins."""
    start, end = scene.start, scene.end
    rest = scene.rod.rest_shape
    poses = (RestStrain(None, None) if rest is None else rest).poses(ElementCells(s).places)
    q, positions = poses.quaternions, poses.positions[:, ::2]
    if of_joints:
        q = jnp.concatenate([q[:, :1], q[:, 1::2], q[:, -1:]], axis=1)
    # By the end that holds more.
    from_end = not isinstance(start, Held) or (isinstance(end, Clamp) and not isinstance(start, Directed))
    k, support = (-1, end) if from_end else (0, start)
    assert isinstance(support, Held)
    held = q[:, k]
    if isinstance(support, Clamp):
        held = from_frame(support.frame)
    elif isinstance(support, Swivel):
        held = swung(held, support.tangent)
    turn = product(held, inverse(q[:, k]))
    nodes = support.position[:, None] + rotated(
        jnp.broadcast_to(turn[:, None], (4, len(s))), positions - positions[:, k, None]
    )
    return FramedCurve(nodes.T, product(jnp.broadcast_to(turn[:, None], q.shape), q), s)


# A rod is first sought at rest where its ends are then missed by less than this part of its length, or where it turns
# by more than this angle [rad] on the way from one end to the other.
NEAR_REST = 0.3
COILED = 6.0


def first_frames(scene: Scene, s: Float[Array, "n+1"], of_joints: bool) -> FramedCurve:
    """Frames to begin with when there is no guess: the rod at rest, or the shape of a straight one under the scene."""
    pieces = len(s) - 1 if of_joints else 2 * (len(s) - 1)
    rest = scene.rod.rest_shape
    if rest is None:
        return framed_through(scene, first_shape(scene, pieces), of_joints)
    resting = at_rest(scene, s, of_joints)
    if not held_at_both_ends(scene):
        return resting
    bent = framed_through(scene, first_shape(scene, pieces), of_joints)
    start, end = scene.start, scene.end
    assert isinstance(start, Held)
    assert isinstance(end, Held)
    missed = resting.nodes[-1] - end.position + resting.nodes[0] - start.position
    places = jnp.linspace(0.0, 1.0, 65, dtype=s.dtype)
    curvature = rest.at(places, *_neighbours(places))[:2]
    angle = jnp.mean(jnp.sqrt(dot(curvature, curvature)))
    is_near = (jnp.sqrt(jnp.sum(missed**2)) < NEAR_REST) | (angle > COILED)
    return jax.tree.map(lambda a, b: jnp.where(is_near, a, b), resting, bent)
