"""What a solve by frames starts from and ends in."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import Cells, ElementCells, JointCells, strains_between
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.first_shape import first_shape
from rodjax.discretization.first_twist import FirstTwist, more_turns
from rodjax.discretization.form import Form
from rodjax.discretization.frame_point import FramePoint
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.hermite import Curve
from rodjax.discretization.shape import Shape
from rodjax.discretization.twist import nearest_twist
from rodjax.geometry.interpolation import cubic
from rodjax.geometry.rotations import (
    align_tangent,
    carried,
    from_frame,
    inverse,
    nearer,
    product,
    rotate_about_tangent,
    rotated,
    tangent,
    unit,
)
from rodjax.geometry.vectors import dot
from rodjax.model.scene import Scene, held_at_both_ends, scene_axes
from rodjax.model.supports import Clamp, Clip, Directed, Held, Swivel


class FramedCurve(Shape):
    """Nodes at the arclengths `s` in units of L, and the frames of the cells."""

    nodes: Float[Array, "n+1 3"]
    quaternions: Float[Array, "4 m"]
    s: Float[Array, "n+1"]

    @property
    def is_of_joints(self) -> bool:
        return self.quaternions.shape[-1] == self.nodes.shape[-2] + 1

    def point(self, end_force: Float[Array, "3 *spans"], total_twist: Float[Array, ""]) -> FramePoint:
        return FramePoint(self.quaternions, end_force, total_twist)

    def with_unknowns(self, point: FramePoint) -> "FramedCurve":
        return FramedCurve(self.nodes, point.quaternions, self.s)

    def in_units(self, scale: Float[Array, ""], shift: Float[Array, "3"]) -> "FramedCurve":
        return FramedCurve(self.nodes * scale + shift[None], self.quaternions, self.s)

    def reached(self, form: Form, point: FramePoint) -> "FramedCurve":
        return FramedCurve(form.nodes_of(point), point.quaternions, form.field.s)

    def change_to(self, other: Any) -> Float[Array, ""]:
        # A straight rod may twist in its place.
        of_frames = jnp.max(jnp.abs(nearer(other.quaternions, self.quaternions) - self.quaternions))
        of_nodes = jnp.max(jnp.abs(other.nodes - self.nodes))
        return jnp.where(of_nodes > of_frames, of_nodes, of_frames)

    def extrapolated(self, older: Any, ratio: Float[Array, ""]) -> "FramedCurve":
        before = nearer(older.quaternions, self.quaternions)
        quaternions = self.quaternions + ratio * (self.quaternions - before)
        return FramedCurve(self.nodes, unit(quaternions), self.s)

    def points(self, pieces: int) -> Float[Array, "k 3"]:
        s = jnp.linspace(0.0, 1.0, pieces + 1, dtype=self.s.dtype)
        return cubic(self.s, self.nodes, tangent(self.cells.at_nodes(self.quaternions)).T, s)

    def on(self, s: Float[Array, "n+1"], of_joints: bool) -> "FramedCurve":
        """The same on other nodes, to begin a solve with."""
        old, new = self.cells.arclengths, _cells(s, of_joints).arclengths
        quaternions = jax.vmap(lambda component: jnp.interp(new, old, component))(self.quaternions)
        nodes = jax.vmap(lambda coordinate: jnp.interp(s, self.s, coordinate), 1, 1)(self.nodes)
        return FramedCurve(nodes, unit(quaternions), s)

    @property
    def cells(self) -> Cells:
        return _cells(self.s, self.is_of_joints)

    def turned_to_ends(self, form: FrameForm, first: FirstTwist) -> Float[Array, "4 m"]:
        """The frames turned to those that the supports hold, by less and less away from them.

        From an earlier equilibrium each held frame turns by its smallest rotation, so that the turns of each span
        between two of them stay. Other first shapes are spun by whole turns: between two clamps to the total twist
        nearest to `first`, or to the turns of the scene; with clips in each span to the twist nearest to the one that
        it had, with its part of what all of the rod shall have beyond that.
        """
        scene, cells, last = form.scene, form.field, first.last
        reference = self.quaternions
        if last is not None and last.shape is not None:
            assert isinstance(last.shape, FramedCurve)
            reference = last.shape.quaternions
        if scene.clips:
            q = _turned_to_supports(form, self.quaternions, first, reference)
            return q if scene.turns is None else _with_turns(scene, cells, q, first)
        q, arclengths = self.quaternions, cells.arclengths
        for end, k, part in ((scene.start, 0, 1.0 - arclengths), (scene.end, -1, arclengths)):
            if isinstance(end, Directed):
                here = q[:, k]
                held = align_tangent(here, end.tangent)
                if isinstance(end, Clamp):
                    held = nearer(from_frame(end.frame), reference[:, k])
                change = product(held, inverse(here))
                # Half of the angle, and the same bits where there is none.
                size = jnp.sqrt(jnp.sum(change[1:] ** 2))
                is_turned = size > jnp.finfo(size.dtype).eps * 8
                half = part * jnp.arctan2(size, change[0])
                axis = change[1:] / jnp.where(is_turned, size, 1.0)
                turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half)[None] * axis[:, None]])
                q = jnp.where(is_turned, product(turn, q), q)
        if isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp):
            q = _with_turns(scene, cells, q, first)
        return q


def _cells(s: Float[Array, "n+1"], of_joints: bool) -> Cells:
    return JointCells(s) if of_joints else ElementCells(s)


def _with_turns(scene: Scene, cells: Cells, q: Float[Array, "4 m"], first: FirstTwist) -> Float[Array, "4 m"]:
    """Frames between two clamps, spun by whole turns: those by which the scene has more than the last one; without a
    last one to the total twist nearest to that of `first`, or to the turns of the scene.
    """
    turns = more_turns(scene, first.last)
    if turns is None:
        if first.last is not None and scene.turns is None:
            return q
        here = jnp.sum(cells.lengths * strains_between(cells, q)[2])
        principal = here - 2 * jnp.pi * jnp.round(here / (2 * jnp.pi))
        turns = jnp.round((nearest_twist(principal, first.total_twist, scene.turns) - here) / (2 * jnp.pi))
    return jnp.where(turns != 0, rotate_about_tangent(q, 2 * jnp.pi * turns * cells.arclengths), q)


def _turned_to_supports(
    form: FrameForm, q: Float[Array, "4 m"], first: FirstTwist, reference: Float[Array, "4 m"]
) -> Float[Array, "4 m"]:
    """Frames swung to the tangents that ends and clips hold, by less and less towards the supports beside each, then
    spun about their tangents to the frames that are held, linearly between these.

    `reference`: those of the last equilibrium.
    """
    cells, arclengths = form.field, form.field.arclengths
    had = cells.lengths * strains_between(cells, q)[2]
    is_carried = first.last is not None
    zero, last = jnp.zeros((), int), jnp.asarray(len(arclengths) - 1)
    assert form.clip_nodes is not None
    supports = jnp.stack([zero, *(2 * form.clip_nodes), last])
    numbered = [(held, jnp.asarray(held.number) % len(arclengths)) for held in form.held_frames]
    for held, number in numbered:
        beside = jnp.searchsorted(supports, number)
        at = arclengths[number]
        before = arclengths[supports[jnp.maximum(beside - 1, 0)]]
        after = arclengths[supports[jnp.minimum(beside + 1, len(supports) - 1)]]
        # Of an end there is nothing on one side.
        rise = jnp.where(at > before, (arclengths - before) / jnp.where(at > before, at - before, 1.0), 1.0)
        fall = jnp.where(after > at, (after - arclengths) / jnp.where(after > at, after - at, 1.0), 1.0)
        q = _swung_partly(q, tangent(q[:, number]), held.tangent, jnp.clip(jnp.minimum(rise, fall), 0.0, 1.0))
    spinning = [(held.frame, number) for held, number in numbered if held.frame is not None]
    if not spinning:
        return q
    numbers = jnp.stack([number for _, number in spinning])
    order = jnp.argsort(numbers)
    at = arclengths[numbers[order]]
    nearby = reference if is_carried else q
    held = [nearer(from_frame(frame), nearby[:, number]) for frame, number in spinning]
    spins = jnp.stack([_spin_between(q[:, number], q_held) for q_held, (_, number) in zip(held, spinning, strict=True)])
    spins = spins[order]
    q = jnp.where(jnp.any(spins != 0), rotate_about_tangent(q, jnp.interp(arclengths, at, spins)), q)
    if is_carried or len(spinning) == 1:
        return q
    # Between two of them: the cells from the one to the other, and by how much they are twisted.
    nodes = numbers[order] // 2
    cell = jnp.arange(had.shape[1])
    is_between = (cell[None] >= nodes[:-1, None]) & (cell[None] < nodes[1:, None])
    here = strains_between(cells, q)[2] * cells.lengths
    more = (first.total_twist - jnp.sum(had)) * jnp.sum(cells.lengths, axis=0)
    wanted = jnp.sum(jnp.where(is_between, (jnp.sum(had - here, axis=0) + more)[None], 0.0), axis=1)
    turns = jnp.concatenate([jnp.zeros_like(spins[:1]), jnp.cumsum(jnp.round(wanted / (2 * jnp.pi)))])
    return jnp.where(jnp.any(turns != 0), rotate_about_tangent(q, 2 * jnp.pi * jnp.interp(arclengths, at, turns)), q)


def _swung_partly(
    q: Float[Array, "4 m"], old: Float[Array, "3"], new: Float[Array, "3"], part: Float[Array, "m"]
) -> Float[Array, "4 m"]:
    """Turned by parts of the smallest rotation from one unit vector to another; the same bits where these are equal."""
    across = jnp.cross(old, new)
    sine, cosine = jnp.sqrt(jnp.sum(across**2)), jnp.sum(old * new)
    # Of opposite ones about any axis across them.
    any_axis = jnp.cross(old, jnp.eye(3, dtype=old.dtype)[jnp.argmin(jnp.abs(old))])
    is_opposite = (cosine < 0) & (sine < jnp.finfo(sine.dtype).eps ** 0.5)
    axis = jnp.where(is_opposite, any_axis, across)
    size = jnp.sqrt(jnp.sum(axis**2))
    is_turned = is_opposite | (sine > jnp.finfo(sine.dtype).eps * 8)
    half = part * jnp.arctan2(sine, cosine) / 2
    unit_axis = axis / jnp.where(is_turned, size, 1.0)
    turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half)[None] * unit_axis[:, None]])
    return jnp.where(is_turned, product(turn, q), q)


def _spin_between(q: Float[Array, "4"], other: Float[Array, "4"]) -> Float[Array, ""]:
    """The angle [rad] about its tangent from a frame to another one of the same tangent, from -2 pi to 2 pi as the
    signs of the quaternions have it; 0 where it is rounding.
    """
    w, _, _, z = product(inverse(q), other)
    angle = 2 * jnp.arctan2(z, w)
    return jnp.where(jnp.abs(angle) > 16 * jnp.finfo(angle.dtype).eps, angle, 0.0)


def cells_of(scene: Scene, shape: FramedCurve) -> Cells:
    return shape.cells if shape.is_of_joints else ElementCells.of(scene, shape.s)


def framed_through(
    scene: Scene,
    points: Float[Array, "k 3"],
    of_joints: bool,
    last: tuple[Float[Array, "3 3"], Float[Array, ""]] | None = None,
) -> FramedCurve:
    """Through points, as many as a mesh has nodes, or nodes and middles of elements, with the tangents that ends hold;
    twisted as the rod at rest, and evenly beside that towards the frames that they hold. Where `last` gives the first
    frame and the total twist [rad], twisted evenly by that.
    """
    shape = (Polyline if of_joints else Curve).through(points)
    nodes, tangents = shape.nodes, shape.tangents
    if of_joints:
        tangents = jnp.concatenate([tangents[:, :1], tangents, tangents[:, -1:]], axis=1)
    s = jnp.linspace(0.0, 1.0, len(nodes), dtype=points.dtype)
    arclengths = _cells(s, of_joints).arclengths
    if last is not None:
        frame, total_twist = last
        return FramedCurve(
            nodes, rotate_about_tangent(carried(from_frame(frame), tangents), total_twist * arclengths), s
        )
    start, end = scene.start, scene.end
    if isinstance(shape, Curve):
        # As a rod without frames begins.
        tangents = shape.turned_to_ends(scene, arclengths)
    if isinstance(start, Directed):
        tangents = tangents.at[:, 0].set(start.tangent)
    if isinstance(end, Directed):
        tangents = tangents.at[:, -1].set(end.tangent)
    first = from_frame(start.frame if isinstance(start, Clamp) else scene_axes(scene))
    # Not opposite to the first tangent.
    opposite = jnp.sum(tangent(first) * tangents[:, 0]) < -0.9
    first = jnp.where(opposite, product(first, jnp.array([0.0, 1.0, 0.0, 0.0], s.dtype)), first)
    q = rotate_about_tangent(carried(first, tangents), _twist_at_rest(scene, arclengths))
    if isinstance(end, Clamp):
        spin = _spin_between(q[:, -1], nearer(from_frame(end.frame), q[:, -1]))
        q = rotate_about_tangent(
            q, spin * arclengths if isinstance(start, Clamp) else jnp.broadcast_to(spin, arclengths.shape)
        )
    return FramedCurve(nodes, q, s)


def rest_twist(scene: Scene) -> Float[Array, ""]:
    """The total twist of the rod at rest."""
    return _twist_at_rest(scene, jnp.linspace(0.0, 1.0, 65, dtype=scene.rod.length.dtype))[-1]


def _twist_at_rest(scene: Scene, arclengths: Float[Array, "m"]) -> Float[Array, "m"]:
    """By how much the rod at rest is twisted from its start to these places."""
    rest = scene.rod.rest_shape
    if rest is None:
        return jnp.zeros_like(arclengths)
    twist = rest.at(arclengths, *_neighbours(arclengths))[2]
    steps = (twist[1:] + twist[:-1]) / 2 * jnp.diff(arclengths)
    return jnp.concatenate([jnp.zeros_like(arclengths[:1]), jnp.cumsum(steps)])


def _neighbours(arclengths: Float[Array, "m"]) -> tuple[Float[Array, "m"], Float[Array, "m"]]:
    return jnp.concatenate([arclengths[:1], arclengths[:-1]]), jnp.concatenate([arclengths[1:], arclengths[-1:]])


def at_rest(scene: Scene, s: Float[Array, "n+1"], of_joints: bool) -> FramedCurve:
    """The rod at rest in the place to which one of its ends, else the first clip, is held; in any between two pins."""
    start, end = scene.start, scene.end
    poses = scene.rod.stress_free.poses(ElementCells(s).arclengths)
    q, positions = poses.quaternions, poses.positions[:, ::2]
    if of_joints:
        q = jnp.concatenate([q[:, :1], q[:, 1::2], q[:, -1:]], axis=1)
    # By the end that holds more.
    from_end = not isinstance(start, Held) or (isinstance(end, Clamp) and not isinstance(start, Directed))
    k, support = (-1, end) if from_end else (0, start)
    at_node = k
    if not isinstance(support, Held):
        support = scene.clips[0]
        at_node = jnp.argmin(jnp.abs(s - support.at))
        k = 2 * at_node
    held = product(from_frame(scene_axes(scene)), q[:, k])
    if isinstance(support, Clamp | Clip) and support.frame is not None:
        held = from_frame(support.frame)
    elif isinstance(support, Swivel | Clip) and support.tangent is not None:
        held = align_tangent(held, support.tangent)
    turn = product(held, inverse(q[:, k]))
    nodes = support.position[:, None] + rotated(
        jnp.broadcast_to(turn[:, None], (4, len(s))), positions - positions[:, at_node, None]
    )
    return FramedCurve(nodes.T, product(jnp.broadcast_to(turn[:, None], q.shape), q), s)


# A rod is first sought at rest where its ends are then missed by less than this part of its length (times its turn at
# rest, if that is less than 1 rad, as a straight one bends by the root of what it misses), or where it turns by more
# than COILED [rad] on the way from one end to the other.
NEAR_REST = 0.3
COILED = 6.0


def first_frames(scene: Scene, s: Float[Array, "n+1"], of_joints: bool) -> FramedCurve:
    """Frames to begin with when there is no guess: the rod at rest, or the shape of a straight one under the scene."""
    pieces = len(s) - 1 if of_joints else 2 * (len(s) - 1)
    rest = scene.rod.rest_shape
    if rest is None:
        return framed_through(scene, first_shape(scene, pieces), of_joints)
    resting = at_rest(scene, s, of_joints)
    if not held_at_both_ends(scene) and not scene.clips:
        return resting
    bent = framed_through(scene, first_shape(scene, pieces), of_joints)
    arclengths = jnp.linspace(0.0, 1.0, 65, dtype=s.dtype)
    curvature = rest.at(arclengths, *_neighbours(arclengths))[:2]
    angle = jnp.mean(jnp.sqrt(dot(curvature, curvature)))
    near = NEAR_REST * jnp.minimum(angle, 1.0)
    if scene.clips:
        is_near = _misses_clips(scene, resting) < near
        return jax.tree.map(lambda a, b: jnp.where(is_near, a, b), resting, bent)
    start, end = scene.start, scene.end
    assert isinstance(start, Held)
    assert isinstance(end, Held)
    missed = resting.nodes[-1] - end.position + resting.nodes[0] - start.position
    is_near = (jnp.sqrt(jnp.sum(missed**2)) < near) | (angle > COILED)
    return jax.tree.map(lambda a, b: jnp.where(is_near, a, b), resting, bent)


def _misses_clips(scene: Scene, curve: FramedCurve) -> Float[Array, ""]:
    """By how much a curve misses clips and ends that are held, at most, in parts of the shorter span beside each."""
    ends = (scene.start.position if isinstance(scene.start, Held) else None, *(clip.position for clip in scene.clips))
    positions = [*ends, scene.end.position if isinstance(scene.end, Held) else None]
    zero = jnp.zeros((), curve.s.dtype)
    at = jnp.stack([zero, *(clip.at for clip in scene.clips), zero + 1])
    spans = jnp.diff(at)
    shorter = jnp.minimum(jnp.append(spans, spans[-1]), jnp.append(spans[:1], spans))
    nodes = jax.vmap(lambda coordinate: jnp.interp(at, curve.s, coordinate), 1, 1)(curve.nodes)
    missed = [jnp.sum((nodes[k] - x) ** 2) / shorter[k] ** 2 for k, x in enumerate(positions) if x is not None]
    return jnp.sqrt(jnp.max(jnp.stack(missed)))
