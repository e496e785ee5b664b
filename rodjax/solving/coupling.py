"""What a rod of a harness gives to the bodies in which it ends: derivatives by the motions of these.

A motion (u, r) of a body: displacement in parts of a length, and rotation vector about global axes. It carries the end
of a rod to position + length u + exp(r) arm, and turns its frame by r. L depends on positions through the spans alone,
linearly; its derivatives by the frame of an end are those of a linearisation in which the ends may turn
(`Form.released`).
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import EndTurn, Form, Linearization
from rodjax.discretization.layout import SpanForces
from rodjax.linalg.saddle_point import SaddlePointSystem
from rodjax.model.supports import Clamp, rotate
from rodjax.units import Units

ENDS = (0, -1)


class RodInBodies(NamedTuple):
    """One rod, with the poses of the bodies at its ends, `length` the unit of their displacements."""

    form: Form
    units: Units
    is_joint: Bool[Array, "2"]
    frame: Float[Array, "2 3 3"]
    offset: Float[Array, "2 3"]
    position_of_body: Float[Array, "2 3"]
    frame_of_body: Float[Array, "2 3 3"]
    length: Float[Array, ""]

    def moved(self, motions: Float[Array, "2 6"] | None = None) -> Form:
        """The form with its ends at the poses of the bodies, moved."""
        scene = self.form.scene
        ends = []
        for end, support in enumerate((scene.start, scene.end)):
            if isinstance(support, Clamp):
                place, frame = self.position_of_body[end], self.frame_of_body[end]
                if motions is not None:
                    place += self.length * motions[end, :3]
                    frame = rotate(frame, motions[end, 3:])
                place = (place + frame @ self.offset[end] - self.units.origin) / self.units.length
                place = jnp.where(self.is_joint[end], place, support.position)
                frame = jnp.where(self.is_joint[end], frame @ self.frame[end], support.frame)
                support = eqx.tree_at(lambda clamp: (clamp.position, clamp.frame), support, (place, frame))
            ends.append(support)
        scene = eqx.tree_at(lambda scene: (scene.start, scene.end), scene, tuple(ends))
        return eqx.tree_at(lambda form: form.scene, self.form, scene)

    def arm(self, end: int) -> Float[Array, "3"]:
        """From the body to the end of the rod, in the unit of length of the rod."""
        return self.frame_of_body[end] @ self.offset[end] / self.units.length

    def carried(self, end: int) -> Float[Array, "3 6"]:
        """The derivative of the position of an end by the motion of its body."""
        x, y, z = self.arm(end)
        zero = jnp.zeros_like(x)
        turning = jnp.stack([jnp.stack([zero, z, -y]), jnp.stack([-z, zero, x]), jnp.stack([y, -x, zero])])
        shift = self.length / self.units.length * jnp.eye(3, dtype=x.dtype)
        return jnp.concatenate([shift, turning], axis=1)


class Coupling(NamedTuple):
    """Derivatives of a rod's L by the motions of its ends: first, second, and of its gradient and closure."""

    first: Float[Array, "12"]
    second: Float[Array, "12 12"]
    of_gradient: Float[Array, "b m 12"]
    of_closure: Float[Array, "k 12"]


def linearized_with_ends(rod: RodInBodies, form: Form, point: Any) -> tuple[Linearization, Coupling]:
    """The linearisation of a rod, whose form has its ends where they are, and what couples it to these."""
    released = form.released(point)
    return held(form, released), coupling(rod, form, point, released)


def held(form: Form, released: Linearization) -> Linearization:
    """With the ends held that clamps hold."""
    free, system = _free(form, released), released.system
    assert isinstance(system, SaddlePointSystem)
    identity = np.eye(len(system.diagonal), dtype=free.dtype)[..., None]
    blocks = free[None, None]
    across = system.across
    if across is not None:
        across = across * blocks[..., 2::2] * blocks[..., 0:-1:2]
    system = SaddlePointSystem(
        system.diagonal * blocks + identity * (1 - blocks),
        system.lower * blocks[..., 1:] * blocks[..., :-1],
        system.border * blocks,
        system.compliance,
        across=across,
    )
    bases, gradient = released.bases * blocks, released.gradient * free[None]
    return dataclasses.replace(released, bases=bases, gradient=gradient, system=system)


def _free(form: Form, released: Linearization) -> Float[Array, "m"]:
    """1 at points that may turn, 0 at clamped ends."""
    free = np.ones(released.gradient.shape[1])
    for end, support in zip(ENDS, (form.scene.start, form.scene.end), strict=True):
        if isinstance(support, Clamp):
            free[end] = 0.0
    return jnp.asarray(free, released.gradient.dtype)


def coupling(rod: RodInBodies, form: Form, point: Any, released: Linearization) -> Coupling:
    (b, m), dtype = released.gradient.shape, released.gradient.dtype
    ends = [
        _Turning(number, end, form.end_turn(point, released, end))
        for number, (end, support) in enumerate(zip(ENDS, (form.scene.start, form.scene.end), strict=True))
        if isinstance(support, Clamp)
    ]
    # By rotations of the frames, as if arms had no length: three columns for each end.
    columns = jnp.zeros((b, m, 2, 3), dtype)
    for number, end, turn in ends:
        columns = columns.at[:, end, number].set(turn.rotation)
    columns = columns.reshape(b, m, 6)
    nothing = jnp.zeros_like(released.closure)
    turned, lacking = jax.vmap(lambda column: released.system.times(column, nothing), -1, -1)(columns)
    bent = jnp.einsum("bmk,bml->kl", columns, turned).reshape(2, 3, 2, 3)
    turned = turned * _free(form, released)[None, :, None]
    first = jnp.zeros((2, 6), dtype)
    second = jnp.zeros((2, 6, 2, 6), dtype).at[:, 3:, :, 3:].set(bent)
    of_gradient = jnp.pad(turned.reshape(b, m, 2, 3), ((0, 0), (0, 0), (0, 0), (3, 0)))
    of_closure = jnp.pad(lacking.reshape(-1, 2, 3), ((0, 0), (0, 0), (3, 0)))
    for number, end, turn in ends:
        arm, carried = rod.arm(number), rod.carried(number)
        pull, spans = _by_position(form, point, end)
        by_turn = turn.first + turn.rotation.T @ released.gradient[:, end]
        first = first.at[number].set(pull @ carried).at[number, 3:].add(by_turn)
        # exp(r) arm = arm + r x arm + r x (r x arm) / 2
        lifted = (pull[:, None] * arm[None] + arm[:, None] * pull[None]) / 2 - (pull @ arm) * jnp.eye(3, dtype=dtype)
        second = second.at[number, 3:, number, 3:].add(turn.second + lifted)
        of_closure = of_closure.at[len(of_closure) - len(spans) :, number].add(spans @ carried)
        if turn.torque is not None:
            of_closure = of_closure.at[0, number, 3:].add(turn.torque)
    return Coupling(
        first.reshape(12), second.reshape(12, 12), of_gradient.reshape(b, m, 12), of_closure.reshape(-1, 12)
    )


class _Turning(NamedTuple):
    """A clamped end: its number, its place among the points, and what turns with its frame."""

    number: int
    end: int
    turn: EndTurn


def _by_position(form: Form, point: Any, end: int) -> tuple[Float[Array, "3"], Float[Array, "size 3"]]:
    """The derivatives of L and of the spans by the position of an end."""
    layout, sign = form.layout, 1.0 if end else -1.0
    assert isinstance(layout, SpanForces)
    direction = np.zeros((3, layout.parts, 3))
    direction[:, end] = sign * np.eye(3)
    pull = sign * form.end_forces(point)[end]
    return pull, jax.vmap(layout.components, -1, -1)(jnp.asarray(direction, pull.dtype))
