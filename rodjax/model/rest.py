"""The shape of a rod without stress: by its curvature and twist along the arclength, or as a curve in space."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import DEFAULT_D2, direction, is_known, number_array, rotation, vector
from rodjax.geometry.rotations import carried, columns, continuous, from_frame, inverse, product, rotated, screw, unit
from rodjax.geometry.vectors import cross, dot
from rodjax.model.along import Pair, Spline, Steps, Value, scaled, value_at
from rodjax.programs.compilation import compiled

# Steps in which a varying curvature is integrated between two neighbouring points of a mesh.
STEPS = 4
# Of the mesh on which the ends of a rest shape are found.
ENDS_POINTS = 256
# Gauss-Legendre points of an interval, as parts of it.
GAUSS = (0.5 - 3**0.5 / 6, 0.5 + 3**0.5 / 6)
LENGTH_POINTS = tuple(np.polynomial.legendre.leggauss(8)[0] / 2 + 0.5)
LENGTH_WEIGHTS = tuple(np.polynomial.legendre.leggauss(8)[1] / 2)


class Poses(eqx.Module):
    """Cross sections in the axes of the first one: `positions`, and `quaternions` of the frames."""

    positions: Float[Array, "3 k"]
    quaternions: Float[Array, "4 k"]


class RestStrain(eqx.Module):
    """Components k1, k2 of t x t' along d1, d2 [1/m], twist [rad/m] and axial strain, each a number or `Along`; `None`
    for none.
    """

    curvature: Pair | None
    twist: Value | None
    axial: Value | None

    def scaled(self, length: Float[Array, ""]) -> "RestStrain":
        curvature = self.curvature
        if curvature is not None:
            curvature = (scaled(curvature[0], length, 1 / length), scaled(curvature[1], length, 1 / length))
        twist = None if self.twist is None else scaled(self.twist, length, 1 / length)
        return RestStrain(curvature, twist, None if self.axial is None else scaled(self.axial, length, length / length))

    def at(self, s: Float[Array, "*k"], a: Float[Array, "*k"], b: Float[Array, "*k"]) -> Float[Array, "3 *k"]:
        """At arclengths that each lie from a to b."""
        zero = jnp.zeros((), s.dtype)
        values = (*(self.curvature or (zero, zero)), zero if self.twist is None else self.twist)
        return jnp.stack([value_at(value, s, a, b) for value in values])

    def poses(self, s: Float[Array, "k"]) -> Poses:
        """At increasing arclengths from 0 on, between two of which nothing jumps: Magnus' series to fourth order."""
        steps = jnp.broadcast_to(jnp.diff(s)[:, None] / STEPS, (len(s) - 1, STEPS))
        begins = s[:-1, None] + steps * jnp.arange(STEPS, dtype=s.dtype)[None]
        a, b = (jnp.broadcast_to(end[:, None], begins.shape) for end in (s[:-1], s[1:]))
        first, second = (self.at(begins + part * steps, a, b) for part in GAUSS)
        # The commutator of two screws along t with these rates of turn.
        by_turn = 3**0.5 / 12 * steps**2
        along = jnp.array([0.0, 0.0, 1.0], s.dtype)[:, None, None]
        turn = steps[None] * (first + second) / 2 + by_turn[None] * cross(first, second)
        along = jnp.broadcast_to(along, first.shape)
        if self.axial is None:
            way = steps[None] * along + by_turn[None] * cross(first - second, along)
        else:
            ahead, further = ((1 + value_at(self.axial, begins + part * steps, a, b))[None] * along for part in GAUSS)
            way = steps[None] * (ahead + further) / 2 + by_turn[None] * (cross(first, further) - cross(second, ahead))
        q, displacements = screw(turn.reshape(3, -1), way.reshape(3, -1))

        def onward(carry, step):
            position, quaternion = carry
            turn, way = step
            position = position + rotated(quaternion, way)
            quaternion = unit(product(quaternion, turn))
            return (position, quaternion), (position, quaternion)

        begin = jnp.zeros(3, s.dtype), jnp.array([1.0, 0.0, 0.0, 0.0], s.dtype)
        _, (positions, quaternions) = jax.lax.scan(onward, begin, (q.T, displacements.T))
        positions = jnp.concatenate([begin[0][None], positions[STEPS - 1 :: STEPS]])
        quaternions = jnp.concatenate([begin[1][None], quaternions[STEPS - 1 :: STEPS]])
        return Poses(positions.T, quaternions.T)


class SplinedCurve(eqx.Module):
    """Splines of a curve in space and of its directors d1, made once for as many places as are asked for."""

    curve: Spline
    directors: Spline

    def poses(self, s: Float[Array, "*k"]) -> tuple[Float[Array, "3 *k"], Float[Array, "3 3 *k"]]:
        """Positions and frames."""
        slope = _slope(self.curve, s)
        t = slope / _size(slope)[None]
        d1 = self.directors.at(s)
        d1 -= dot(d1, t)[None] * t
        d1 /= _size(d1)[None]
        return self.curve.at(s), jnp.stack([d1, cross(t, d1), t], axis=1)

    def strains(self, s: Float[Array, "*k"]) -> Float[Array, "3 *k"]:
        """Curvature along d1 and d2, and twist."""
        (_, frames), (_, change) = jax.jvp(self.poses, (s,), (jnp.ones_like(s),))
        d2, t = frames[:, 1], frames[:, 2]
        by_d1, by_d2, _ = (change[:, k] for k in range(3))
        return jnp.stack([dot(by_d2, t), -dot(by_d1, t), dot(by_d1, d2)])


class SpaceCurve(eqx.Module):
    """A smooth curve through points [m], the arclengths of these as parts of the whole, and directors d1 there."""

    points: Float[Array, "k 3"]
    s: Float[Array, "k"]
    d1: Float[Array, "k 3"]

    @staticmethod
    def through(points: Any, d2: Any, frames: Any) -> tuple["SpaceCurve", Float[Array, ""]]:
        """The curve, and its length."""
        shape = np.shape(points)
        if len(shape) != 2 or shape[0] < 4 or shape[1] != 3:
            raise ValueError(f"points must have the shape (m, 3) with m >= 4, got {shape}")
        points = jnp.asarray(number_array(points, "points", shape))
        if is_known(points) and not np.all(np.linalg.norm(np.diff(np.asarray(points), axis=0), axis=1) > 0):
            raise ValueError("points must not repeat one after another: their tangent is not known")
        s, tangents = _arclengths_and_tangents(points)
        if frames is not None:
            given = jnp.asarray(number_array(frames, "frames", (shape[0], 3, 3)))
            for k, frame in enumerate(given if is_known(given) else ()):
                rotation(frame, f"frames[{k}]")
            if is_known(given, tangents) and not np.max(np.abs(np.asarray(given[..., 2].T - tangents))) < 0.1:
                raise ValueError("frames must have the tangents of the curve through points as their third columns")
            d1 = given[..., 0].T
        else:
            t = tangents[:, 0]
            across = jnp.asarray(direction(d2, "d2")).astype(t.dtype)
            first = jnp.cross(across, t)
            size = jnp.sqrt(jnp.sum(first**2))
            if is_known(size) and not float(size) > 1e-6:
                if d2 is DEFAULT_D2:
                    raise ValueError(
                        "d2 must not be parallel to the first tangent, as its default (0, 1, 0) is: give d2"
                    )
                raise ValueError(f"d2 must not be parallel to the first tangent, got {d2}")
            d1 = _carried(first / size, tangents)
        return SpaceCurve(points, s / s[-1], d1.T), s[-1]

    def scaled(self, length: Float[Array, ""]) -> "SpaceCurve":
        return SpaceCurve(self.points / length, self.s, self.d1)

    @property
    def splined(self) -> SplinedCurve:
        return SplinedCurve(Spline.through(self.s, self.points), Spline.through(self.s, self.d1))

    def world(self, s: Float[Array, "k"]) -> Poses:
        """In the axes in which the points are given."""
        positions, frames = self.splined.poses(s)
        quaternions = jax.vmap(from_frame, 2, 1)(frames)
        return Poses(positions, continuous(quaternions))

    def poses(self, s: Float[Array, "k"]) -> Poses:
        world = self.world(s)
        first = inverse(world.quaternions[:, :1]) + 0 * world.quaternions
        return Poses(
            rotated(first, world.positions - world.positions[:, :1]), continuous(product(first, world.quaternions))
        )

    def at(self, s: Float[Array, "*k"], a: Float[Array, "*k"], b: Float[Array, "*k"]) -> Float[Array, "3 *k"]:
        return self.splined.strains(s)


RestShape = RestStrain | SpaceCurve


@compiled
def _arclengths_and_tangents(points: Float[Array, "k 3"]) -> tuple[Float[Array, "k"], Float[Array, "3 k"]]:
    """Of the curve through points, at these."""
    # By the sums of the chords first, then by the arclengths of that curve.
    chords = jnp.sqrt(jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1))
    knots = jnp.concatenate([jnp.zeros_like(chords[:1]), jnp.cumsum(chords)])
    spline = Spline.through(knots, points)
    parts = jnp.array(LENGTH_POINTS, knots.dtype)
    arclengths = knots[:-1, None] + jnp.diff(knots)[:, None] * parts[None]
    speed = _size(_slope(spline, arclengths))
    lengths = jnp.diff(knots) * jnp.sum(speed * jnp.array(LENGTH_WEIGHTS, knots.dtype)[None], axis=1)
    s = jnp.concatenate([jnp.zeros_like(lengths[:1]), jnp.cumsum(lengths)])
    slopes = _slope(Spline.through(s, points), s)
    return s, slopes / _size(slopes)[None]


@compiled
def _carried(d1: Float[Array, "3"], tangents: Float[Array, "3 k"]) -> Float[Array, "3 k"]:
    """A director at the first tangent, carried along all of them without twist."""
    first = from_frame(jnp.stack([d1, jnp.cross(tangents[:, 0], d1), tangents[:, 0]], axis=1))
    return columns(carried(first, tangents))[:, 0]


def _slope(spline: Spline, s: Float[Array, "*k"]) -> Float[Array, "3 *k"]:
    return jax.jvp(spline.at, (s,), (jnp.ones_like(s),))[1]


def _size(vectors: Float[Array, "3 *k"]) -> Float[Array, "*k"]:
    return jnp.sqrt(dot(vectors, vectors))


def ends(
    rest: RestShape, length: Float[Array, ""], position: Any, frame: Any
) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], tuple[Float[Array, "3"], Float[Array, "3 3"]]]:
    """Position and frame of both ends of a rod of this rest shape, from those of the start."""
    is_curve = isinstance(rest, SpaceCurve)
    parts = jnp.linspace(0.0, 1.0, ENDS_POINTS + 1, dtype=length.dtype)
    if isinstance(rest, SpaceCurve):
        poses = rest.world(parts)
    else:
        poses = rest.poses(_with_jumps(rest, parts * length))
    if position is None and frame is None and is_curve:
        q = poses.quaternions
        return tuple((poses.positions[:, k], columns(q[:, k])) for k in (0, -1))  # pyright: ignore[reportReturnType]
    start = jnp.zeros(3, length.dtype) if position is None else jnp.asarray(vector(position, "position"))
    turn = jnp.eye(3, dtype=length.dtype) if frame is None else jnp.asarray(rotation(frame, "frame"))
    first = columns(poses.quaternions[:, 0])
    relative = first.T @ columns(poses.quaternions[:, -1])
    way = first.T @ (poses.positions[:, -1] - poses.positions[:, 0])
    return (start, turn), (start + turn @ way, turn @ relative)


def _with_jumps(rest: RestStrain, s: Float[Array, "k"]) -> Float[Array, "m"]:
    """These arclengths, and those at which the strain jumps."""
    values = (*(rest.curvature or ()), rest.twist, rest.axial)
    jumps = [value.jumps for value in values if isinstance(value, Steps)]
    return jnp.sort(jnp.concatenate([s, *jumps]))
