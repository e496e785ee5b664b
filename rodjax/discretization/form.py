"""The interface of a discretized scene: unknowns, retraction of steps, derivatives, forces."""

from abc import abstractmethod
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.dead_loads import total_force
from rodjax.discretization.layout import ForceLayout, held_positions, nodes_along
from rodjax.discretization.nodal_point import Friction, Nodal, NodalChange
from rodjax.discretization.potentials import OnElements, at_both, section_forces
from rodjax.geometry.vectors import dot
from rodjax.linalg.saddle_point import AnySystem, factor_and_solve
from rodjax.model.scene import Scene, has_free_ends
from rodjax.model.supports import Free, Held

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

    `gradient`: dL by the rotations; `constraint_residual`: dL/dF, the residual of the closure of each span, before it
    a zero for the torque; `residual`: largest force left on a node; `energy`: L, without the work of a dead moment;
    `gaps`: of contacts, which `energy` leaves out; `reference_displacements`: of the nodes since the last
    equilibrium, where there is friction.
    """

    bases: Float[Array, "3 b n"]
    gradient: Float[Array, "b n"]
    constraint_residual: Float[Array, "k"]
    system: AnySystem
    energy: Float[Array, ""]
    residual: Float[Array, ""]
    gaps: Float[Array, "k n+1"] | None = None
    reference_displacements: Float[Array, "n+1 3"] | None = None


class HeldLoads(NamedTuple):
    """What loads without a potential exert at a point on rotations and nodes. The merit of a step has their work as if
    they stayed so.
    """

    moments: Float[Array, "b m"]
    forces: Float[Array, "3 n+1"]

    def work(self, rotation: Float[Array, "b m"], others: NodalChange) -> Float[Array, ""]:
        return jnp.sum(self.moments * rotation) + jnp.sum(self.forces * others.displacements.T)


class EndTurn(NamedTuple):
    """What turns with the frame of a clamped end about global axes, beside the position: `rotation`, the rotations at
    the end in the bases of a released linearisation, and what these leave out of the derivatives of L: `torque`, by the
    axes, of the constraint residual of the torque, `None` where there is none; `first` and `second` ones of L.
    """

    rotation: Float[Array, "b 3"]
    torque: Float[Array, "3"] | None
    first: Float[Array, "3"]
    second: Float[Array, "3 3"]


class Point(Protocol):
    """The unknowns of a form, and what is known with them."""

    @property
    def tangents(self) -> Float[Array, "3 m"]: ...

    @property
    def end_force(self) -> Float[Array, "3 parts"]:
        """The force at s = L as each part of the layout sees it, with what clips and contacts beyond it apply."""
        ...

    @property
    def total_twist(self) -> Float[Array, ""]:
        """In radians, zero where there is no torsion."""
        ...

    @property
    def nodal(self) -> Nodal | None: ...


class Form(eqx.Module):
    """A scene whose unknowns are rotations along the rod, and forces through it where it is held at several places.

    The border of its system has one column for each multiplier; the last ones are the unknown forces of the layout.
    """

    scene: eqx.AbstractVar[Scene]
    field: eqx.AbstractVar[Any]
    layout: eqx.AbstractVar[ForceLayout]

    @property
    @abstractmethod
    def has_potential(self) -> bool:
        """Whether all loads have one."""

    @abstractmethod
    def bases_at(self, point: Any) -> Float[Array, "3 b m"]:
        """The bases of the rotations that are free at a point; zero where a support holds the rod."""

    @abstractmethod
    def turn(self, point: Any, bases: Float[Array, "3 b m"], axis: Float[Array, "3"]) -> Float[Array, "b m"]:
        """The rotations, in these bases, of a rigid turn of the whole rod about an axis."""

    def spin(self, bases: Float[Array, "3 b m"]) -> Float[Array, "b m"] | None:
        """The rotations that spin all sections about their tangents; `None` where spin is not an unknown."""
        return None

    @abstractmethod
    def holding(self, point: Any) -> Any:
        """The point with the values that the supports prescribe."""

    @abstractmethod
    def settled(self, point: Any) -> Any:
        """The point where a solver stopped, with all that is known of it."""

    @property
    def sliding_count(self) -> int:
        """How many of the multipliers, the first ones, are arclengths of sliding clips."""
        return 0

    @property
    def carries_twist(self) -> bool:
        """Whether steps carry the total twist as an unknown; else it is computed from the frames."""
        return False

    def allowed_twist(self, point: Any) -> Float[Array, ""]:
        """The total twist of a balanced point [rad] that the frames of its ends allow, where steps carry it."""
        return point.total_twist

    @abstractmethod
    def retract(
        self,
        point: Any,
        bases: Float[Array, "3 b m"],
        rotation: Float[Array, "b m"],
        force_change: Float[Array, "3 parts"],
        others: Any = None,
    ) -> Any:
        """The retraction of a step: rotations in the bases of the point, a change of force, and `others`."""

    def no_others(self, point: Any) -> Any:
        """`others` of a step that changes nothing but rotations and forces."""
        return None if point.nodal is None else NodalChange.nothing(point.nodal)

    def longest_step(self, point: Any, others: Any) -> Float[Array, ""] | None:
        """The largest part of a step that its `others` allow; `None` where they allow all of it."""
        return None

    def is_blocked(self, point: Any) -> Bool[Array, ""] | None:
        """Whether the search can go on with another form only; `None` where that cannot happen."""
        return None

    def has_slid_out(self, point: Any, is_given_up: Bool[Array, ""]) -> Bool[Array, ""] | None:
        """Whether the rod has slid out of a clip, or where the search is given up is about to; `None` where it slides
        through none.
        """
        return None

    def nodal_held(self, nodal: Any) -> Any:
        """With held nodes at the positions of their supports."""
        return nodal

    def retracted_nodal(self, point: Any, others: Any) -> Any:
        """The positions and pressures of a point after a step."""
        return point.nodal

    def others(self, multipliers: Float[Array, "k"]) -> Any:
        """The changes of a step beside rotations and forces, from its multipliers; `None` without such unknowns."""
        return None

    def scaled(self, others: Any, motion: Any, multipliers: Any) -> Any:
        """`others` of a step with these parts of their motions and of their multipliers."""
        return jax.tree.map(lambda change: motion * change, others)

    @abstractmethod
    def in_plane(self, point: Any, normal: Float[Array, "3"], axes: Float[Array, "3 2"]) -> tuple["Form", Any]:
        """The form of a rod that stays in the plane of two axes, and the point projected into it."""

    @abstractmethod
    def in_plane_of(self, other: "Form") -> "Form":
        """This form restricted to the plane of another form of the same scene, or free in space as that is."""

    @abstractmethod
    def out_of_plane(self, normal: Float[Array, "3"]) -> "Form":
        """The form of the motions out of the plane of a planar form; of all motions where the two kinds couple."""

    def stays_in_plane(self, point: Any) -> Bool[Array, ""]:
        """Whether an equilibrium has no moment out of its plane, which supports and loads alone do not show."""
        return jnp.array(True)

    def accepts(self, point: Any, trial: Any, is_better: Bool[Array, ""]) -> Bool[Array, ""]:
        """Whether the step from a point to a trial is accepted; `is_better`: whether its merit is low enough."""
        return is_better

    @abstractmethod
    def linearized(self, point: Any) -> Linearization: ...

    def released(self, point: Any) -> Linearization:
        """The linearisation with free rotations of clamped ends, the total twist following by smallest rotations;
        `residual` leaves these ends out.
        """
        raise NotImplementedError(f"{type(self).__name__} has a force in each element")

    def end_turn(self, point: Any, released: Linearization, end: int) -> EndTurn:
        """The rigid turn of the clamped start, 0, or end, -1."""
        axes = jnp.eye(3, dtype=released.gradient.dtype)
        rotation = jnp.stack([self.turn(point, released.bases, axis)[:, end] for axis in axes], axis=1)
        nothing = jnp.zeros_like(axes)
        return EndTurn(rotation, None, nothing[0], nothing)

    def accepted(self, point: Any, here: Linearization) -> Any:
        """The point from which the search goes on, updated by its linearisation."""
        return point

    def searching(self, point: Any) -> Any:
        """The point as a search begins from it."""
        return point

    @property
    def holds_loads(self) -> bool:
        """Whether steps are judged with loads that have no potential held as they are at the point."""
        return False

    def held_loads(self, point: Any) -> HeldLoads:
        """What loads without a potential exert at a point."""
        raise NotImplementedError(f"{type(self).__name__} holds no loads")

    def touches(self, point: Any) -> Bool[Array, ""]:
        """Whether forces of contacts act."""
        return jnp.array(False)

    @property
    def refines(self) -> bool:
        """Whether `refined` does something."""
        return False

    def refined(self, point: Any, is_balanced: Bool[Array, ""]) -> tuple[Any, Bool[Array, ""]]:
        """A balanced point with what a search changes at its end alone, or one that is not balanced at its beginning
        with what it changes there; and whether the search goes on from there.
        """
        return point, jnp.array(False)

    def ended(self, point: Any) -> Any:
        """The point where a search ends."""
        return point

    def objective(self, here: Linearization, point: Any, others: Any) -> Float[Array, ""]:
        """The merit that a step from `point` has to lower, with its `others`, at a linearisation along it."""
        return here.energy

    def half_square(self, here: Linearization) -> Float[Array, ""]:
        """Half of the squared gradient, without the constraint residual: the merit where no minimum is sought."""
        return jnp.sum(here.gradient**2 / self.field.weights[None]) / 2

    def sought(
        self, here: Linearization, point: Any, system: AnySystem, push: Float[Array, "b m"]
    ) -> tuple[Bool[Array, ""], Float[Array, "b m"], Float[Array, "k"]]:
        """The step of a system, that of a linearisation or a stiffer one: whether its stiffness is positive, rotations,
        multipliers. `push`: a force added to leave a saddle.
        """
        found = factor_and_solve(system, push - here.gradient, -here.constraint_residual, is_regularized=True)
        factors, rotation, multipliers = found
        return factors.is_minimum, rotation, multipliers

    def coupled(self, point: Any, system: AnySystem) -> AnySystem:
        """The system of a linearisation with what makes it the derivative of `residual_vectors`, if that is not
        symmetric.
        """
        return system

    def residual_vectors(self, point: Any) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        """The gradient and the constraint residual of the linearisation alone."""
        here = self.linearized(point)
        return here.gradient, here.constraint_residual

    def lagrangian(self, point: Any) -> tuple[Float[Array, ""], Float[Array, "c"]]:
        """L at a point, as `Linearization.energy`, and the residual of the closure constraints: for automatic
        differentiation, also by the poses of supports.
        """
        raise NotImplementedError(f"{type(self).__name__} has a force in each element")

    @abstractmethod
    def under_force(
        self,
        point: Any,
        here: Linearization,
        rotation: Float[Array, "b m"],
        change: Float[Array, "3 parts"],
        others: Any,
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        """Under changed forces, at a point: the residual of the closure constraints and its rate along the rotations of
        a step; the change of L, and the change of its rate.
        """

    def shifted(self, system: Any, shift: Float[Array, ""]) -> Any:
        """The system of a step that a shift makes shorter."""
        return system.shifted(shift)

    @abstractmethod
    def regular(self, system: AnySystem) -> Any:
        """The system of a linearisation, shifted so that neutral modes are regular."""

    @abstractmethod
    def rounding_floor(self, point: Any) -> Float[Array, ""]:
        """Residual [EI/L^2] that rounding alone leaves at an equilibrium of this mesh, see `docs/design.md`."""

    @abstractmethod
    def edges(self, point: Any) -> Float[Array, "segments 3"]:
        """The vectors from node to node."""

    @abstractmethod
    def elastic_energy(self, point: Any) -> Float[Array, ""]: ...

    @abstractmethod
    def load_energy(self, point: Any) -> Float[Array, ""]:
        """The potential of gravity and dead forces, zero at the origin."""

    @property
    def clip_nodes(self) -> Int[Array, "clips"] | None:
        """The numbers of the nodes at which clips hold the rod; `None` without clips."""
        return self.field.clip_nodes

    @property
    def held_positions(self) -> tuple[Float[Array, "3 h"], Int[Array, "h"]]:
        """The positions that are held along the rod, and the numbers of the nodes there."""
        return held_positions(self.scene, self.field.s, self.clip_nodes)

    def nodes(self, edges: Float[Array, "n 3"]) -> Float[Array, "n+1 3"]:
        """Nodes along the edges, at held places to the last digit."""
        return nodes_along(self.scene, self.field.s, self.clip_nodes, edges)

    def begun(
        self,
        point: Any,
        nodes: Float[Array, "n+1 3"],
        pressures: Float[Array, "k n+1"] | None,
        friction: Friction | None,
    ) -> Any:
        """The point with positions of nodes, pressures and friction, where the form has them as unknowns."""
        return point

    def fields_on_elements(self, point: Any) -> OnElements | None:
        """`None` without fields."""
        return None

    def with_fields(self, forces: Float[Array, "3 3 n"], fields: OnElements | None) -> Float[Array, "3 3 n"]:
        """The section forces at start, middle and end of the elements: `forces` plus those of fields along them."""
        return forces if fields is None else section_forces(forces, fields, jnp.diff(self.field.s))

    def nodes_of(self, point: Any) -> Float[Array, "n+1 3"]:
        return self.nodes(self.edges(point)) if point.nodal is None else point.nodal.positions

    def end_forces(self, point: Any, fields: OnElements | None) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The section forces at s = 0 and s = L; `fields`: those on elements."""
        total, none = total_force(self.scene), jnp.zeros(3, point.tangents.dtype)
        start_given, end_given = (
            end.force if isinstance(end, Free) and end.force is not None else none
            for end in (self.scene.start, self.scene.end)
        )
        first, last = point.end_force[:, 0], point.end_force[:, -1]
        start = -start_given if isinstance(self.scene.start, Free) else first + total
        end = last - total if isinstance(self.scene.start, Free) else last
        end = end_given if isinstance(self.scene.end, Free) else end
        if fields is None:
            return start, end
        on_nodes = at_both(fields.by_position)
        # Of ends that are held: a given force is one.
        start = start - on_nodes[:, 0] if isinstance(self.scene.start, Held) else start
        return start, end + on_nodes[:, -1] if isinstance(self.scene.end, Held) else end

    @abstractmethod
    def tangents_in_clips(self, point: Any) -> Float[Array, "3 clips"]: ...

    def clip_forces(self, point: Any) -> Float[Array, "3 clips"]:
        """Of each clip on the rod."""
        forces = point.end_force[:, :-1] - point.end_force[:, 1:]
        # In the first span all loads count as those before: see `dead_loads.counted_from`.
        return forces.at[:, 0].add(-total_force(self.scene)) if has_free_ends(self.scene) else forces

    def axial_forces(self, point: Any) -> Float[Array, "slides"]:
        """The axial forces of the sliding clips on the rod."""
        along = dot(self.clip_forces(point), self.tangents_in_clips(point))
        return along[np.array([k for k, clip in enumerate(self.scene.clips) if clip.sliding])]

    def force_components(self, multipliers: Float[Array, "k"]) -> Float[Array, "c"]:
        """The components that belong to the forces of the layout, of a vector over all multipliers."""
        return multipliers[len(multipliers) - self.layout.size :]

    def force_turned(self, point: Any, axis: Float[Array, "3"]) -> Float[Array, "c"]:
        """The components of the change of the forces in a rigid turn of the whole rod about an axis."""
        return self.layout.components(jnp.cross(axis[:, None], point.end_force, axis=0))

    def multipliers_turned(
        self, point: Any, axis: Float[Array, "3"], multipliers: Float[Array, "k"]
    ) -> Float[Array, "k"]:
        """The change of all multipliers in that turn."""
        of_force = self.force_turned(point, axis)
        return multipliers.at[len(multipliers) - len(of_force) :].set(of_force)

    def is_closed(self, constraint_residual: Float[Array, "k"], tolerance: float) -> Bool[Array, ""]:
        """Whether the closure constraints hold as accurately as a residual of this tolerance needs."""
        least = CLOSURE_ROUNDINGS * jnp.finfo(constraint_residual.dtype).eps
        return jnp.all(jnp.abs(constraint_residual) <= jnp.maximum(CLOSURE_TOLERANCE * tolerance, least))
