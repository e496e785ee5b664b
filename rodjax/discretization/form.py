"""What the two forms of a scene, by its tangents and by its frames, have in common."""

from abc import abstractmethod
from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.dead_loads import total_force
from rodjax.linalg import AnySystem
from rodjax.scene import Scene, held_at_both_ends
from rodjax.supports import Free, Held

# Shift of the Hessian in every factorisation [EI/L^2 per rad and length]. An equilibrium with neutral modes, such as
# a rod that can spin about the line through both clamps, is then regular; modes softer than this count as neutral. It
# costs Newton a factor of 1e7 a step instead of quadratic convergence. The softest mode of a clamped rod has pi^2.
NEUTRAL = 1e-6
# Multiple of eps (stiffness or force + 4 N^2) that is taken for the rounding floor of the gradient.
FLOOR_SAFETY = 4.0
# Where the gradient is at the tolerance, the polyline must close to this multiple of it: a hundredth, as a bent rod has
# about 100 EI/L^3 of stiffness; or to so many roundings.
CLOSURE_TOLERANCE = 0.01
CLOSURE_ROUNDINGS = 64


class Linearization(eqx.Module):
    """First and second derivatives of L at a point, by rotations in `bases`, by F and by a torque.

    `gradient`: by the rotations; `closure`: by F, what the rod lacks of the span, before it a zero for the torque;
    `residual`: largest force left on a node; `energy`: L, without the work of a dead moment.
    """

    bases: Float[Array, "3 b n"]
    gradient: Float[Array, "b n"]
    closure: Float[Array, "k"]
    system: AnySystem
    energy: Float[Array, ""]
    residual: Float[Array, ""]


class Point(Protocol):
    """The unknowns of a form, and what is known with them."""

    @property
    def tangents(self) -> Float[Array, "3 m"]: ...

    @property
    def end_force(self) -> Float[Array, "3 *spans"]:
        """The force at s = L between held ends, else zero; with clips, for each span in turn, with the forces of the
        clips beyond it.
        """
        ...

    @property
    def total_twist(self) -> Float[Array, ""]:
        """In radians, zero where there is no torsion."""
        ...


class Form(eqx.Module):
    """A scene whose unknowns are rotations along the rod, and the force at s = L where both ends are held.

    The border of its system has one column for each multiplier; the last ones are components of that force. `axes`:
    those in which it lies, `None` for all of space.
    """

    scene: eqx.AbstractVar[Scene]
    field: eqx.AbstractVar[Any]
    axes: eqx.AbstractVar[Float[Array, "3 a"] | None]

    @property
    @abstractmethod
    def has_potential(self) -> bool:
        """Whether all loads have one."""

    @abstractmethod
    def bases_at(self, point: Any) -> Float[Array, "3 b m"]:
        """Those along which the rod may turn at a point: none where a support holds it."""

    @abstractmethod
    def turn(self, point: Any, bases: Float[Array, "3 b m"], axis: Float[Array, "3"]) -> Float[Array, "b m"]:
        """The rotations that turn the whole rod about an axis."""

    @abstractmethod
    def holding(self, point: Any) -> Any:
        """The point with what the supports hold."""

    @abstractmethod
    def settled(self, point: Any) -> Any:
        """The point where a solver stopped, with all that is known of it."""

    @abstractmethod
    def moved(
        self,
        point: Any,
        bases: Float[Array, "3 b m"],
        rotation: Float[Array, "b m"],
        force_change: Float[Array, "3"],
    ) -> Any:
        """The point turned by rotations in its bases, and under another force."""

    def accepts(self, point: Any, trial: Any, is_better: Bool[Array, ""]) -> Bool[Array, ""]:
        """Whether a step goes from a point to another, which is better or not judged."""
        return is_better

    @abstractmethod
    def linearized(self, point: Any) -> Linearization: ...

    def unbalanced(self, point: Any) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        """The gradient and the closure of the linearisation alone."""
        here = self.linearized(point)
        return here.gradient, here.closure

    @abstractmethod
    def under_force(
        self, point: Any, bases: Float[Array, "3 b m"], rotation: Float[Array, "b m"], change: Float[Array, "3"]
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        """With another end force: what the rod lacks of its span and the rate of that as it begins to turn; by how much
        L differs, and by how much the rate of L does.
        """

    @abstractmethod
    def regular(self, system: AnySystem) -> Any:
        """The system of a linearisation, neutral modes held."""

    @abstractmethod
    def rounding_floor(self, point: Any) -> Float[Array, ""]:
        """Residual [EI/L^2] that rounding alone leaves at an equilibrium of this mesh, see `docs/design.md`."""

    @abstractmethod
    def edges(self, point: Any) -> Float[Array, "segments 3"]:
        """From node to node."""

    @abstractmethod
    def elastic_energy(self, point: Any) -> Float[Array, ""]: ...

    @abstractmethod
    def load_energy(self, point: Any) -> Float[Array, ""]:
        """The potential of gravity and dead forces, zero at the origin."""

    def nodes(self, edges: Float[Array, "n 3"]) -> Float[Array, "n+1 3"]:
        """Nodes along the edges, between held ends to the last digit."""
        start, end = self.scene.start, self.scene.end
        if not isinstance(start, Held):
            assert isinstance(end, Held), "a scene holds at least one position"
            return jnp.concatenate([end.position[None] - jnp.cumsum(edges[::-1], axis=0)[::-1], end.position[None]])
        nodes = start.position[None] + jnp.concatenate([jnp.zeros((1, 3), edges.dtype), jnp.cumsum(edges, axis=0)])
        if isinstance(end, Held):
            s = jnp.linspace(0.0, 1.0, len(nodes), dtype=nodes.dtype)[:, None]
            nodes = (nodes + s * (end.position - nodes[-1])[None]).at[-1].set(end.position)
        return nodes

    def end_forces(self, point: Any) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The section forces at s = 0 and s = L."""
        total = total_force(self.scene)
        for end, sign in ((self.scene.start, -1), (self.scene.end, 1)):
            if isinstance(end, Free):
                given = jnp.zeros_like(total) if end.force is None else sign * end.force
                return (given, -total) if sign < 0 else (total, given)
        return point.end_force + total, point.end_force

    @property
    def _closures(self) -> int:
        """How many of the multipliers are components of the end force: the last ones."""
        if not held_at_both_ends(self.scene):
            return 0
        return 3 if self.axes is None else self.axes.shape[1]

    def closure(self, multipliers: Float[Array, "k"]) -> Float[Array, "c"]:
        """The part for the end force, of what is given for all multipliers."""
        return multipliers[len(multipliers) - self._closures :]

    def of_force(self, vector: Float[Array, "3 *spans"]) -> Float[Array, "c"]:
        """The components of a vector, with clips one for each span, that belong to the end force."""
        if not self._closures:
            return jnp.zeros(0, vector.dtype)
        return vector if self.axes is None else vector @ self.axes

    def force_turned(self, point: Any, axis: Float[Array, "3"]) -> Float[Array, "c"]:
        """The components of what the end force changes by as the whole rod turns about an axis."""
        return self.of_force(jnp.cross(axis, point.end_force))

    def multipliers_turned(
        self, point: Any, axis: Float[Array, "3"], multipliers: Float[Array, "k"]
    ) -> Float[Array, "k"]:
        """The same with zeros, as many as `multipliers`, before it."""
        of_force = self.force_turned(point, axis)
        return multipliers.at[len(multipliers) - len(of_force) :].set(of_force)

    def force_change(self, closure: Float[Array, "c"]) -> Float[Array, "3 *spans"]:
        """A change of the end force from its components."""
        if not self._closures:
            return jnp.zeros(3, closure.dtype)
        return closure if self.axes is None else self.axes @ closure

    def is_closed(self, closure: Float[Array, "k"], tolerance: float) -> Bool[Array, ""]:
        """Whether the polyline spans its ends as well as befits a residual of this tolerance."""
        least = CLOSURE_ROUNDINGS * jnp.finfo(closure.dtype).eps
        return jnp.all(jnp.abs(closure) <= jnp.maximum(CLOSURE_TOLERANCE * tolerance, least))
