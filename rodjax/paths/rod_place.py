"""A rod on a branch of equilibria: its scenes between those of a sequence, and its equations linearised."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import Form, Linearization, Point
from rodjax.discretization.joints import generic_field
from rodjax.discretization.motion import Metric, Motion, neutral_turn
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.node_contacts import GAP_WEIGHT
from rodjax.discretization.sliding import SlidingForm, SlidingPoint, at_its_arclengths
from rodjax.geometry.vectors import components
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.bordered import BorderedFactors, BorderedSystem, Vectors
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import AnyFactors, AnySystem, SaddlePointSystem, factor, transposed
from rodjax.mechanics.passage import Before
from rodjax.model.scene import Scene, between, nondimensional
from rodjax.paths.place import Place, work
from rodjax.solving.newton import STAGNATION
from rodjax.solving.result import Equilibrium, build_result
from rodjax.solving.result_form import form_and_point, free_form_and_point
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.stability import carried_to
from rodjax.solving.status import Outcome

# A point lies on the branch when no force larger than this is left on a node [EI/L^2], or rounding allows no less.
TOLERANCE = 1e-9
# The most by which a correction turns a tangent [rad].
MAX_ROTATION = 1.0
# Stiffness of the spring against a neutral turn [EI/L], that of a softly held rod.
SPRING = 10.0
# Stiffness of the springs that hold a rod while its system is factorised [EI/L], and the parts it is held in.
SPRING_STIFFNESS = 100.0
PARTS = 4


class Regularized(eqx.Module):
    """The factors of a linearisation that has its springs."""

    factors: AnyFactors
    holds: int = eqx.field(static=True)

    @property
    def negative(self) -> Int[Array, ""]:
        """The number of negative eigenvalues under the constraints: a hold is none of these."""
        factors = self.factors
        if isinstance(factors, BorderedFactors):
            return factors.inner.negative + factors.below_by_pivots + self.holds
        return factors.negative + self.holds

    def solve(
        self, rotation: Float[Array, "b m"], multipliers: Float[Array, "k"]
    ) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        rotation, found = self.factors.solve(rotation, jnp.pad(multipliers, (0, self.holds)))
        return rotation, found[: len(multipliers)]


class RodFactors(NamedTuple):
    """See `PlaceFactors`."""

    factors: Regularized

    @property
    def negative(self) -> Int[Array, ""]:
        return self.factors.negative

    def solve(self, residual: Motion) -> Motion:
        return Motion(*self.factors.solve(residual.rotation, residual.multipliers))


def regularized(system: AnySystem, neutral: Motion) -> Regularized:
    """The factors of a shifted linearisation with a spring against its neutral turn, where this turns a tangent most.

    What is at right angles to the turn has the same solution but for a share of the turn, with all digits.

    A loop that slides along its rod, or a rod that is free but for its closure constraint, makes the part without
    border nearly singular where the whole is not, and pivots are not exchanged. So springs hold the rod at a few places
    that are eliminated last, and as many multipliers, columns of the border, take their moments away again: exactly. A
    chain from node to node has the forces that close it between them.
    """
    place = jnp.argmax(jnp.sum(neutral.rotation**2, axis=0))
    turn = neutral.rotation[:, place]
    squared = jnp.sum(turn**2)
    spring = SPRING * turn[:, None] * turn[None] / jnp.where(squared > 0, squared, 1.0)
    if isinstance(system, BorderedSystem):
        inner, holds = _held(system.inner, place, spring)
        columns, rows = (
            Vectors(part.x, jnp.pad(part.y, ((0, 0), (0, holds)))) for part in (system.columns, system.rows)
        )
        system = dataclasses.replace(system, inner=inner, columns=columns, rows=rows)
        return Regularized(factor(system), holds)
    system, holds = _held(system, place, spring)
    return Regularized(factor(system), holds)


def _held(
    system: SaddlePointSystem | ChainSystem, place: Int[Array, ""], spring: Float[Array, "b b"]
) -> tuple[SaddlePointSystem | ChainSystem, int]:
    """With a spring at one point, and the multipliers that take away what holds the rod at others: so many."""
    diagonal = system.diagonal.at[:, :, place].add(spring)
    if isinstance(system, ChainSystem):
        return dataclasses.replace(system, diagonal=diagonal), 0
    b, m = diagonal.shape[1:]
    stride = 2 ** math.ceil(math.log2(max(m - 1, 1) / PARTS)) if m > PARTS else 1
    held_points = np.arange(stride, m - 1, stride)
    holds = b * len(held_points)
    border = np.zeros((b, b, len(held_points), m))
    for component in range(b):
        border[component, component, np.arange(len(held_points)), held_points] = 1.0
    border = jnp.asarray(border.reshape(b, holds, m), system.border.dtype)
    held = jnp.sum(border, axis=1)
    identity = jnp.eye(b, dtype=held.dtype)[..., None]
    diagonal += SPRING_STIFFNESS * identity * held[None]
    k = len(system.compliance)
    compliance = jnp.zeros((k + holds, k + holds), held.dtype).at[:k, :k].set(system.compliance)
    compliance = compliance.at[k:, k:].set(-jnp.eye(holds, dtype=held.dtype) / SPRING_STIFFNESS)
    system = SaddlePointSystem(
        diagonal, system.lower, jnp.concatenate([system.border, border], axis=1), compliance, across=system.across
    )
    return system, holds


class BranchContacts(eqx.Module):
    """The contacts of a point of a branch: which count as `closed`; what of each must not become negative, the pressure
    of a closed one and the gap of another [EI/L^2], and the `rates` of these along the branch.
    """

    closed: Bool[Array, "k n+1"]
    amounts: Float[Array, "k n+1"]
    rates: Float[Array, "k n+1"]


class Direction(eqx.Module):
    """A motion with its turns as vectors in global axes: the changes of tangents, or rotations of frames."""

    turns: Float[Array, "3 m"]
    multipliers: Float[Array, "k"]


class RodPlace(Place):
    """See `Place`: of a rod. `change`: of the residual with the parameter, where it is asked for."""

    form: Form
    point: Point
    here: Linearization
    change: Motion | None

    @property
    def kept(self) -> tuple[Linearization, Motion | None]:
        return self.here, self.change

    @property
    def residual(self) -> Motion:
        return Motion(self.here.gradient, self.here.constraint_residual)

    @property
    def magnitude(self) -> Float[Array, ""]:
        return self.here.residual

    @property
    def is_balanced(self) -> Bool[Array, ""]:
        least = jnp.maximum(TOLERANCE, STAGNATION * self.form.rounding_floor(self.point))
        return (self.here.residual <= least) & self.form.is_closed(self.here.constraint_residual, 0.0)

    @property
    def metric(self) -> Metric:
        return Metric.of(self.form, self.here)

    @property
    def generic(self) -> Motion:
        rotation = components(self.here.bases, generic_field(self.point.tangents))
        return Motion(rotation, jnp.zeros_like(self.here.constraint_residual))

    @property
    def has_symmetry(self) -> bool:
        return not self.form.sliding_count

    def transposed(self) -> "RodPlace":
        return eqx.tree_at(lambda place: place.here.system, self, transposed(self.here.system))

    def neutral(self) -> Motion:
        turn = neutral_turn(self.form, self.point, self.here)
        squared = self.metric.inner(turn, turn)
        return jax.tree.map(lambda x: x / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), turn)

    def times(self, motion: Motion) -> Motion:
        return Motion(*self.here.system.times(motion.rotation, motion.multipliers))

    def regularized(self, neutral: Motion) -> RodFactors:
        return RodFactors(regularized(self.form.regular(self.here.system), neutral))

    def components(self, direction: Direction) -> Motion:
        return Motion(components(self.here.bases, direction.turns), direction.multipliers)

    def work_share(self, motion: Motion) -> Float[Array, ""]:
        change, mass = self.change, self.metric.mass
        assert change is not None
        is_free = mass > 0
        forces = jnp.where(is_free, 1 / jnp.where(is_free, mass, 1.0), 0.0)[None] * change.rotation**2
        gaps, pulls = (jnp.sqrt(jnp.sum(x**2)) for x in (change.multipliers, motion.multipliers))
        most = jnp.sqrt(jnp.sum(forces)) + gaps * (1 + pulls)
        return work(motion, change) / jnp.where(most > 0, most, 1.0)


def scene_at(scenes: Scene, segment: Int[Array, ""], parameter: Float[Array, ""]) -> Scene:
    """The scene of a parameter between the scenes number `segment` and the next one; beyond them on in a line."""
    scene, other = (jax.tree.map(lambda leaf, k=k: leaf[segment + k], scenes) for k in (0, 1))
    return between(scene, other, parameter - segment.astype(parameter.dtype))


class RodProblem(eqx.Module):
    """The scenes about an equilibrium, and what they make of it under other parameters; `closed`: the contacts that
    count as closed, `None` for those that press.
    """

    scenes: Scene
    segment: Int[Array, ""]
    equilibrium: Equilibrium
    closed: Bool[Array, "k n+1"] | None = None

    @property
    def point(self) -> Point:
        return free_form_and_point(self.equilibrium)[1]

    @property
    def scale(self) -> float:
        """The change of the parameter that counts as much as one radian all along the rod."""
        return float(self.scenes.rod.length.shape[0] - 1)

    def _at(self, parameter: Float[Array, ""], point: Point, motion: Motion | None = None) -> tuple[Form, Point]:
        scaled, _ = nondimensional(scene_at(self.scenes, self.segment, parameter))
        state = self.equilibrium.state
        form, point = carried_to(scaled, state.shape, point, motion, made_at=state.arclengths)
        if self.closed is None:
            return form, point
        if isinstance(form, SlidingForm):
            first = dataclasses.replace(form.first, closed=self.closed)
            return dataclasses.replace(form, first=first), point
        return dataclasses.replace(form, closed=self.closed), point

    def moved(self, parameter: Float[Array, ""], point: Point, motion: Motion) -> Point:
        """The point carried to a parameter, and moved there."""
        return self._at(parameter, point, motion)[1]

    def located(self, parameter: Float[Array, ""], point: Point) -> RodPlace:
        """The equations at the point carried to a parameter."""
        form, point = self._at(parameter, point)
        return RodPlace(form, point, form.linearized(point), None)

    def linearized(self, parameter: Float[Array, ""], point: Point) -> RodPlace:
        """The same with the change of the residual with the parameter."""

        def residual(parameter):
            place = self.located(parameter, point)
            return place.residual, place

        _, change, place = jax.jvp(residual, (parameter,), (jnp.ones_like(parameter),), has_aux=True)
        return dataclasses.replace(place, change=change)

    def again(self, parameter: Float[Array, ""], point: Point, kept: tuple[Linearization, Motion | None]) -> RodPlace:
        """The place of which a loop kept the linearisation."""
        return RodPlace(*self._at(parameter, point), *kept)

    def departure(
        self, parameter: Float[Array, ""], motion: Motion, share: Float[Array, ""]
    ) -> tuple[Direction, Float[Array, ""] | None]:
        """A motion in global axes, and the part of that much of it that a step may be; `None` where it may be all."""
        form, begin = self._at(parameter, self.point)
        reach = form.longest_step(begin, form.others(share * motion.multipliers))
        turns = short_sum(form.bases_at(begin) * motion.rotation[None], axis=1)
        return Direction(turns, motion.multipliers), reach

    def retracted(self, place: RodPlace, motion: Motion) -> tuple[Float[Array, ""], Point]:
        """The part of a motion that a correction may take, and the point after that."""
        form, point = place.form, place.point
        part = jnp.minimum(1.0, MAX_ROTATION / jnp.max(jnp.abs(motion.rotation)))
        longest = form.longest_step(point, form.others(motion.multipliers))
        part = part if longest is None else jnp.minimum(part, longest)
        force_change = form.layout.forces(form.force_components(part * motion.multipliers))
        others = form.others(part * motion.multipliers)
        return part, form.retract(point, place.here.bases, part * motion.rotation, force_change, others)

    def result(
        self, parameter: Float[Array, ""], place: RodPlace, outcome: Outcome, index: Int[Array, ""]
    ) -> Equilibrium:
        scene = scene_at(self.scenes, self.segment, parameter)
        units = nondimensional(scene)[1]
        arclengths = place.point.arclengths if isinstance(place.point, SlidingPoint) else None
        form, point = at_its_arclengths(place.form, place.point)
        shape = self.equilibrium.state.shape.reached(form, point)
        state = SolverState(shape, point.end_force, units, arclengths)
        if isinstance(form, NodalForm) and scene.obstacles:
            points, _, _ = form.samples(shape.nodes, point)
            before = Before(units.origin[None] + units.length * points, scene.obstacles)
            state = dataclasses.replace(state, pressures=point.nodal.pressures, before=before)
        return build_result(scene, Found(state, point, outcome, index == 0), jnp.ones((), int))

    def amounts(self, place: RodPlace) -> Float[Array, "k n+1"]:
        """See `BranchContacts`."""
        form, point = at_its_arclengths(place.form, place.point)
        assert isinstance(form, NodalForm)
        assert form.closed is not None
        return jnp.where(form.closed, point.nodal.pressures, GAP_WEIGHT * form.gaps(point))

    def contacts(
        self, parameter: Float[Array, ""], place: RodPlace, motion: Motion, rate: Float[Array, ""]
    ) -> BranchContacts | None:
        """Those at a place, and how they change along a motion and a change of the parameter; `None` without such."""
        if self.closed is None:
            return None

        def amounts(parameter: Float[Array, ""], motion: Motion) -> Float[Array, "k n+1"]:
            form, point = self._at(parameter, place.point, motion)
            return self.amounts(dataclasses.replace(place, form=form, point=point))

        still = jax.tree.map(jnp.zeros_like, motion)
        return BranchContacts(self.closed, *jax.jvp(amounts, (parameter, still), (rate, motion)))


def pressing(result: Equilibrium) -> Bool[Array, "k n+1"] | None:
    """The contacts with obstacles that press; `None` without obstacles."""
    form, point = form_and_point(result)
    if not result.scene.obstacles:
        return None
    assert isinstance(form, NodalForm)
    return point.nodal.pressures > GAP_WEIGHT * form.gaps(point)


def no_motion(result: Equilibrium) -> Motion:
    """A motion of an equilibrium that leaves it where it is."""

    def residual_vectors(result: Equilibrium) -> Motion:
        form, point = free_form_and_point(result)
        here = form.linearized(point)
        return Motion(here.gradient, here.constraint_residual)

    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(residual_vectors, result))
