"""The shape that a solve begins with where the user gives none."""

import itertools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.model.loads import DistributedForce
from rodjax.model.scene import Scene, dead_forces, has_no_place, scene_axes
from rodjax.model.supports import Directed, Free, Held, Pin, Support, Swivel


def first_shape(scene: Scene, segments: int) -> Float[Array, "n+1 3"]:
    """Nodes to begin with when there is no guess, in a nondimensional scene.

    Between two held ends: the circular arc of length 1, sagging where gravity and the end tangents point, bent near the
    ends towards their tangents. With a free end: straight, or the helix into which a moment on that end alone bends it.
    With clips: so from each to the next.
    """
    u = jnp.linspace(0.0, 1.0, segments + 1, dtype=scene.rod.length.dtype)[:, None]
    start, end = scene.start, scene.end
    if scene.clips:
        return _through_clips(scene, u)
    if has_no_place(scene):
        raise ValueError("guess must be given where no end or clip is held, as nothing else tells where the rod lies")
    if not isinstance(start, Held):
        assert isinstance(end, Held), "a scene holds at least one position"
        along = end.tangent if isinstance(end, Directed) else -_pull(scene)
        return end.position[None] - _helix(along, start, u)[::-1]
    if not isinstance(end, Held):
        along = start.tangent if isinstance(start, Directed) else _pull(scene)
        return start.position[None] + _helix(along, end, u)
    return _bent_arc(start, end, scene.gravity, scene_axes(scene), u)


def hanging_arc(scene: Scene, segments: int) -> Float[Array, "n+1 3"]:
    """The arc between two held ends that sags as gravity alone has it, in a nondimensional scene."""
    u = jnp.linspace(0.0, 1.0, segments + 1, dtype=scene.rod.length.dtype)[:, None]
    assert isinstance(scene.start, Held)
    assert isinstance(scene.end, Held)
    start, end = Pin(scene.start.position), Pin(scene.end.position)
    return _arc(start, end, scene.gravity, scene_axes(scene), u)[0]


def _through_clips(scene: Scene, s: Float[Array, "k 1"]) -> Float[Array, "k 3"]:
    """Points at arclengths s: in each span an arc of its length, in a clip along the line between its neighbours."""
    clips, ends = scene.clips, (scene.start, scene.end)
    first, last = (end.position if isinstance(end, Held) else None for end in ends)
    positions = [first, *(clip.position for clip in clips), last]
    zero = jnp.zeros((), s.dtype)
    arclengths = [zero, *(clip.at for clip in clips), zero + 1]
    axes = scene_axes(scene)
    held: list[Support] = [scene.start]
    for before, clip, after in zip(positions, clips, positions[2:], strict=False):
        tangent = clip.direction
        if tangent is None:
            line = (clip.position if after is None else after) - (clip.position if before is None else before)
            tangent = _direction(line, axes[:, 2])
        held.append(Swivel(clip.position, tangent))
    held.append(scene.end)
    shape = jnp.zeros((len(s), 3), s.dtype)
    for (start, end), (a, b) in zip(itertools.pairwise(held), itertools.pairwise(arclengths), strict=True):
        length = b - a
        if not isinstance(start, Held):
            assert isinstance(end, Swivel)
            piece = end.position[None] + (s - b) * end.tangent[None]
        elif not isinstance(end, Held):
            assert isinstance(start, Swivel)
            piece = start.position[None] + (s - a) * start.tangent[None]
        else:
            # In units of the span.
            start, end = (
                eqx.tree_at(lambda held: held.position, held, held.position / length) for held in (start, end)
            )
            gravity = None if scene.gravity is None else scene.gravity * length**3
            piece = length * _bent_arc(start, end, gravity, axes, jnp.clip((s - a) / length, 0.0, 1.0))
        shape = jnp.where(s >= a, piece, shape)
    return shape


def _bent_arc(
    start: Held, end: Held, gravity: Float[Array, "3"] | None, axes: Float[Array, "3 3"], u: Float[Array, "k 1"]
) -> Float[Array, "k 3"]:
    """The arc of length 1 between the ends, bent near them towards the tangents that they hold."""
    arc, arc_start, arc_end = _arc(start, end, gravity, axes, u)
    if isinstance(start, Directed):
        arc += u * (1 - u) ** 4 * (start.tangent - arc_start)[None]
    if isinstance(end, Directed):
        arc += u**4 * (u - 1) * (end.tangent - arc_end)[None]
    return arc


def _helix(tangent: Float[Array, "3"], free: Support, u: Float[Array, "k 1"]) -> Float[Array, "k 3"]:
    """The way from a held end to a free one. A moment M there turns the tangent about itself at the rate M L/EI.

    (From either end: the section moment at s = 0 is the reverse of a moment on a free start, and so is the way.)
    """
    moment = free.moment if isinstance(free, Free) else None
    if moment is None:
        return u * tangent[None]
    size = jnp.sqrt(jnp.sum(moment**2))
    axis = _direction(moment, tangent)
    angle = (u[:-1] + u[1:]) / 2 * size
    along = jnp.sum(axis * tangent) * axis
    turned = along[None] + jnp.cos(angle) * (tangent - along)[None] + jnp.sin(angle) * jnp.cross(axis, tangent)[None]
    return jnp.concatenate([jnp.zeros((1, 3), u.dtype), jnp.cumsum(turned, axis=0) / (len(u) - 1)])


def _pull(scene: Scene) -> Float[Array, "3"]:
    """The direction of all dead loads together, in which a rod on a pin hangs."""
    loads = [load.force * load.at for load in dead_forces(scene)]
    loads += [end.force for end in (scene.start, scene.end) if isinstance(end, Free) and end.force is not None]
    if scene.gravity is not None:
        loads.append(scene.gravity / 2)
    if not loads:
        dead = [load for load in scene.distributed if isinstance(load, DistributedForce) and not load.follower]
        loads = [load.force for load in dead] or [jnp.zeros(3, scene.rod.length.dtype)]
    pull = sum(loads[1:], loads[0])
    size = jnp.sqrt(jnp.sum(pull**2))
    fallback = jnp.array([0.0, 0.0, -1.0], pull.dtype)
    return jnp.where(size > 0, pull / jnp.where(size > 0, size, 1.0), fallback)


def _arc(
    start: Held, end: Held, gravity: Float[Array, "3"] | None, axes: Float[Array, "3 3"], u: Float[Array, "k 1"]
) -> tuple[Float[Array, "k 3"], Float[Array, "3"], Float[Array, "3"]]:
    """The circular arc of length 1 between the ends (a straight line where they are too far), and its end tangents.

    `axes`: of the scene, by which it sags where nothing else tells a direction.
    """
    chord = end.position - start.position
    span = jnp.sqrt(jnp.sum(chord**2))
    tangents = [end.tangent if isinstance(end, Directed) else jnp.zeros_like(chord) for end in (start, end)]
    # Coincident ends have no chord: then the arc is a circle that leaves and arrives along the tangents.
    coincident = span < 1e-6
    along = _direction(jnp.where(coincident, -(tangents[0] + tangents[1]), chord), axes[:, 2])
    sag = (tangents[0] - tangents[1]) / 2
    if gravity is not None:
        # A load of w L^3/EI = 100 sags a rod as much as its ends can bend it.
        sag += gravity / 100
    sag -= jnp.sum(sag * along) * along
    across = jnp.where(jnp.abs(jnp.sum(axes[:, 0] * along)) < 0.9, axes[:, 0], axes[:, 1])
    sag = _direction(sag, _direction(jnp.cross(along, across), along))
    half = _half_angle(jnp.minimum(span, 1.0))
    angle = half * (2 * u - 1)
    radius = 0.5 / half
    reach = jnp.maximum(span, 1.0)  # stretched along the chord where the ends are further apart than the rod is long
    x = reach * (radius * jnp.sin(angle) + jnp.minimum(span, 1.0) / 2)
    y = radius * (jnp.cos(angle) - jnp.cos(half))
    arc = start.position[None] + x * along[None] + y * sag[None]
    cosine, sine = jnp.cos(half) * along, jnp.sin(half) * sag
    return arc, cosine + sine, cosine - sine


def _half_angle(span: Float[Array, ""]) -> Float[Array, ""]:
    """The half angle a of an arc of length 1 over a chord: sin(a)/a = span, in 1e-3 to pi, by bisection."""
    low, high = jnp.full_like(span, 1e-3), jnp.full_like(span, jnp.pi)
    for _ in range(12):
        middle = (low + high) / 2
        is_low = jnp.sin(middle) > span * middle
        low, high = jnp.where(is_low, middle, low), jnp.where(is_low, high, middle)
    return (low + high) / 2


def _direction(vector: Float[Array, "3"], fallback: Float[Array, "3"]) -> Float[Array, "3"]:
    size = jnp.sqrt(jnp.sum(vector**2))
    is_zero = size < 1e-6
    return jnp.where(is_zero, fallback.astype(vector.dtype), vector / jnp.where(is_zero, 1.0, size))
