"""A harness on a branch of equilibria: its harnesses between those of a sequence, and its equations linearised."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import NEUTRAL
from rodjax.discretization.forms import form_of
from rodjax.discretization.motion import Motion
from rodjax.geometry.vectors import components
from rodjax.linalg.blocks import short_sum
from rodjax.linalg.saddle_point import AnySystem
from rodjax.model.harness import Bodies, Harness, clamped, harness_between
from rodjax.model.scene import Scene, nondimensional
from rodjax.paths.assembled import (
    AssembledFactors,
    AssembledSystem,
    GroupSystem,
    HarnessMetric,
    HarnessMotion,
    LinearizedRod,
    generic_motion,
)
from rodjax.paths.place import Place, work
from rodjax.paths.rod_place import MAX_ROTATION, SPRING, TOLERANCE, Direction, Regularized, regularized
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, Poses, Rods
from rodjax.solving.coupling import RodInBodies
from rodjax.solving.harness_forces import ends_of
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.harness_search import harness_equilibrium
from rodjax.solving.newton import STAGNATION
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium
from rodjax.solving.result_form import form_and_point
from rodjax.solving.status import Outcome


class HarnessPoint(NamedTuple):
    """Of the rods of each group, stacked, and of the bodies; the poses as they were under the harness of the
    equilibrium with which a step begins, from which they follow their supports.
    """

    rods: tuple[Any, ...]
    poses: Poses


class Under(NamedTuple):
    """What the unknowns are under one value of the parameter: all rods and bodies, and the poses of these."""

    assembly: Assembly
    poses: Poses

    def rods(self) -> list[RodInBodies]:
        """With their ends where the bodies are."""
        return [
            of_each(lambda rod: rod._replace(form=rod.form_at()))(self.assembly.rods(group, self.poses))
            for group in self.assembly.groups
        ]


class HarnessPlace(Place):
    """See `Place`: of a harness. `springs`: first and second derivatives of the energies of the bodies; `change`: of
    the residual with the parameter, where it is asked for.
    """

    under: Under
    point: HarnessPoint
    rods: tuple[LinearizedRod, ...]
    springs: tuple[Float[Array, "j 6"], Float[Array, "j 6 6"]]
    system: AssembledSystem
    change: HarnessMotion | None

    @staticmethod
    def of(
        under: Under, point: HarnessPoint, rods: tuple[LinearizedRod, ...], springs: Any, change: HarnessMotion | None
    ) -> "HarnessPlace":
        pairs = zip(under.assembly.groups, rods, strict=True)
        groups = tuple(GroupSystem.of(under.assembly, *pair) for pair in pairs)
        system = AssembledSystem.of(under.assembly, groups, springs[1])
        return HarnessPlace(under, point, rods, springs, system, change)

    @property
    def kept(self) -> tuple[Any, ...]:
        return self.rods, self.springs, self.change

    def _of_bodies(self) -> tuple[Float[Array, "j 6"], Float[Array, ""]]:
        forces = tuple(rods.coupling.first for rods in self.rods)
        return self.under.assembly.balance_of_bodies(self.springs[0], forces)

    @property
    def residual(self) -> HarnessMotion:
        assembly, rods = self.under.assembly, []
        for group, each in zip(assembly.groups, self.rods, strict=True):
            shares = assembly.shares(group)
            here = each.here
            rods.append(Motion(shares[:, None, None] * here.gradient, shares[:, None] * here.constraint_residual))
        return HarnessMotion(tuple(rods), assembly.bodies.motions.T @ self._of_bodies()[0].reshape(-1))

    @property
    def residuals(self) -> tuple[Float[Array, "k"], ...]:
        return tuple(each.here.residual for each in self.rods)

    @property
    def magnitude(self) -> Float[Array, ""]:
        largest = self._of_bodies()[1]
        for residuals in self.residuals:
            largest = jnp.maximum(largest, jnp.max(residuals))
        return largest

    @property
    def is_balanced(self) -> Bool[Array, ""]:
        least, is_closed = jnp.asarray(TOLERANCE, self.springs[0].dtype), jnp.array(True)
        for group, points, each in zip(self.under.rods(), self.point.rods, self.rods, strict=True):
            floors = of_each(lambda form, point: form.rounding_floor(point))(group.form, points)
            least = jnp.maximum(least, STAGNATION * jnp.max(floors))
            closed = of_each(lambda form, residual: form.is_closed(residual, 0.0))
            is_closed &= jnp.all(closed(group.form, each.here.constraint_residual))
        return (self.magnitude <= least) & is_closed

    @property
    def metric(self) -> HarnessMetric:
        return self.system.metric

    @property
    def generic(self) -> HarnessMotion:
        return generic_motion(self.rods, self.point.rods, self.system)

    def times(self, motion: HarnessMotion) -> HarnessMotion:
        return self.system.times(motion)

    def neutral(self) -> HarnessMotion:
        """Of the turns and displacements of the whole the one that changes nothing, if there is one; none in fields,
        which know of places.
        """
        assembly, poses, dtype = self.under.assembly, self.under.poses, self.springs[0].dtype
        motions, all_rods, system = assembly.bodies.motions, self.under.rods(), self.system
        has_fields = any(points.nodal is not None for points in self.point.rods)

        def moved(whole: Float[Array, "6"]) -> tuple[HarnessMotion, Float[Array, "6j"]]:
            """A displacement and a turn of all, and what supports keep the bodies from."""
            away, axis = whole[:3], whole[3:]
            turns = jnp.broadcast_to(axis[None], poses.positions.shape)
            arms = (poses.positions - jnp.mean(poses.positions, axis=0, keepdims=True)) / assembly.length
            shifts = away[None] + jnp.cross(turns, arms)
            of_bodies = jnp.concatenate([shifts, turns], axis=1).reshape(-1)
            rods = []
            for group, points, each in zip(all_rods, self.point.rods, self.rods, strict=True):

                def turned(rod: RodInBodies, point: Any, each: LinearizedRod) -> Motion:
                    here, form = each.here, rod.form
                    nothing = jnp.zeros_like(here.constraint_residual)
                    turn = form.turn(point, here.bases, axis)
                    return Motion(turn, form.multipliers_turned(point, axis, nothing))

                rods.append(of_each(turned)(group, points, each))
            along = motions.T @ of_bodies
            return HarnessMotion(tuple(rods), along), of_bodies - motions @ along

        def tried(whole: Float[Array, "6"]) -> tuple[HarnessMotion, HarnessMotion, Float[Array, "6j"]]:
            motion, kept_from = moved(whole)
            return motion, system.times(motion), kept_from

        found, changes, kept_from = jax.lax.map(tried, jnp.eye(6, dtype=dtype))
        missing = jnp.concatenate([leaf.reshape(6, -1) for leaf in jax.tree.leaves((changes, kept_from))], axis=1)
        sizes = jnp.sqrt(jnp.sum(missing**2, axis=1))
        sizes = jnp.where(sizes > NEUTRAL, sizes, 1.0)
        rows = missing / sizes[:, None]
        whole = jnp.linalg.eigh(rows @ rows.T)[1][:, 0] / sizes
        motion = jax.tree.map(lambda x: jnp.tensordot(whole, x, 1), found)
        size = jnp.max(jnp.abs(motion.bodies), initial=0.0)
        least = NEUTRAL * size / missing.shape[1]
        is_neutral = (size > 0) & (jnp.max(jnp.abs(whole @ missing)) <= least) & (not has_fields)
        squared = self.metric.inner(motion, motion)
        size = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), size)
        return jax.tree.map(lambda x: jnp.where(is_neutral, x / size, 0.0), motion)

    def regularized(self, neutral: HarnessMotion) -> AssembledFactors:
        system, turn = self.system.regular(), neutral.bodies
        squared = turn @ turn
        spring = SPRING * turn[:, None] * turn[None] / jnp.where(squared > 0, squared, 1.0)
        return dataclasses.replace(system, springs=system.springs + spring).factored(_held)

    def components(self, direction: tuple[tuple[Direction, ...], Float[Array, "q"]]) -> HarnessMotion:
        of_rods, bodies = direction
        rods = []
        for each, one in zip(self.rods, of_rods, strict=True):
            rods.append(Motion(of_each(components)(each.here.bases, one.turns), one.multipliers))
        return HarnessMotion(tuple(rods), bodies)

    def work_share(self, motion: HarnessMotion) -> Float[Array, ""]:
        change, system = self.change, self.system
        assert change is not None
        squared, pulls = jnp.zeros((), motion.bodies.dtype), jnp.sum(motion.bodies**2)
        gaps = jnp.sum(change.bodies**2)
        for group, by, x in zip(system.groups, change.rods, motion.rods, strict=True):
            mass = group.lengths[:, None] * group.mass
            is_free = mass > 0
            squared += jnp.sum(jnp.where(is_free, 1 / jnp.where(is_free, mass, 1.0), 0.0)[:, None] * by.rotation**2)
            gaps += jnp.sum(by.multipliers**2)
            pulls += jnp.sum(x.multipliers**2)
        most = jnp.sqrt(squared) + jnp.sqrt(gaps) * (1 + jnp.sqrt(pulls))
        return work(motion, change) / jnp.where(most > 0, most, 1.0)


def _held(system: AnySystem) -> Regularized:
    """The factors of a rod between its clamps, held softly while it is factorised."""
    b, m = system.diagonal.shape[1:]
    nothing = Motion(jnp.zeros((b, m), system.diagonal.dtype), jnp.zeros(0, system.diagonal.dtype))
    return regularized(system, nothing)


def harness_at(harnesses: Harness, segment: Int[Array, ""], parameter: Float[Array, ""]) -> Harness:
    """The harness of a parameter between those number `segment` and the next one; beyond them on in a line."""
    harness, other = (jax.tree.map(lambda leaf, k=k: leaf[segment + k], harnesses) for k in (0, 1))
    return harness_between(harness, other, parameter - segment.astype(parameter.dtype))


class HarnessProblem(eqx.Module):
    """The harnesses about an equilibrium, and what they make of it under other parameters."""

    harnesses: Harness
    segment: Int[Array, ""]
    equilibrium: HarnessEquilibrium

    @property
    def point(self) -> HarnessPoint:
        result = self.equilibrium
        points = tuple(of_each(lambda rod: form_and_point(rod)[1])(group) for group in result.groups)
        return HarnessPoint(points, Poses(result.positions, result.frames))

    @property
    def scale(self) -> float:
        """The change of the parameter that counts as much as one radian all along the rods."""
        return float(self.harnesses.scenes[0].rod.length.shape[0] - 1)

    def _harness(self, parameter: Float[Array, ""]) -> Harness:
        return harness_at(self.harnesses, self.segment, parameter)

    def _under(self, parameter: Float[Array, ""], poses: Poses) -> Under:
        harness, result = self._harness(parameter), self.equilibrium
        bodies, before = Bodies.of(harness), Bodies.of(result.harness)
        first = Poses(*bodies.followed(before, result.positions, result.frames))
        groups = []
        for numbers, group in zip(result.members, result.groups, strict=True):
            scenes = [clamped(harness.scenes[number], harness, *first) for number in numbers]
            scenes = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)

            def scaled_form(scene: Scene, shape: Any):
                scaled, units = nondimensional(scene)
                return form_of(scaled, shape), units

            forms, units = of_each(scaled_form)(scenes, group.state.shape)
            groups.append(Rods(forms, group.state.shape, units, *ends_of(harness, numbers)))
        return Under(Assembly.of(tuple(groups), bodies), Poses(*bodies.followed(before, *poses)))

    def _retracted(self, under: Under, points: tuple[Any, ...], bases: Any, motion: HarnessMotion) -> HarnessPoint:
        """The point after a motion."""
        assembly = under.assembly
        of_bodies = (assembly.bodies.motions @ motion.bodies).reshape(assembly.count, 6)
        padded, rods = jnp.pad(of_bodies, ((0, 1), (0, 0))), []
        for group, point, own, x in zip(assembly.groups, points, bases, motion.rods, strict=True):

            def of_rod(rod: RodInBodies, point: Any, bases: Array, x: Motion, of_ends: Float[Array, "2 6"]) -> Any:
                form = rod.form_at(of_ends)
                change = form.layout.forces(form.force_components(x.multipliers))
                return form.holding(form.retract(point, bases, x.rotation, change, form.others(x.multipliers)))

            rods.append(of_each(of_rod)(assembly.rods(group, under.poses), point, own, x, padded[group.body]))
        poses = under.poses.retract(of_bodies, assembly.length)
        before = Bodies.of(self.equilibrium.harness)
        return HarnessPoint(tuple(rods), Poses(*before.followed(assembly.bodies, *poses)))

    def _held(self, under: Under, points: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(
            of_each(lambda rod, point: rod.form.holding(point))(rods, point)
            for rods, point in zip(under.rods(), points, strict=True)
        )

    def _bases(self, under: Under, points: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(
            of_each(lambda rod, point: rod.form.bases_at(point))(rods, point)
            for rods, point in zip(under.rods(), points, strict=True)
        )

    def moved(self, parameter: Float[Array, ""], point: HarnessPoint, motion: HarnessMotion) -> HarnessPoint:
        """The point carried to a parameter, and moved there."""
        under = self._under(parameter, point.poses)
        points = self._held(under, point.rods)
        return self._retracted(under, points, self._bases(under, points), motion)

    def located(self, parameter: Float[Array, ""], point: HarnessPoint) -> HarnessPlace:
        """The equations at the point carried to a parameter."""
        under = self._under(parameter, point.poses)
        points = self._held(under, point.rods)
        rods = tuple(of_each(LinearizedRod.of)(*pair) for pair in zip(under.rods(), points, strict=True))
        springs = under.assembly.body_derivatives(under.poses)
        return HarnessPlace.of(under, HarnessPoint(points, point.poses), rods, springs, None)

    def linearized(self, parameter: Float[Array, ""], point: HarnessPoint) -> HarnessPlace:
        """The same with the change of the residual with the parameter."""

        def residual(parameter):
            place = self.located(parameter, point)
            return place.residual, place

        _, change, place = jax.jvp(residual, (parameter,), (jnp.ones_like(parameter),), has_aux=True)
        return dataclasses.replace(place, change=change)

    def again(self, parameter: Float[Array, ""], point: HarnessPoint, kept: tuple[Any, ...]) -> HarnessPlace:
        """The place of which a loop kept the linearisation."""
        under = self._under(parameter, point.poses)
        return HarnessPlace.of(under, HarnessPoint(self._held(under, point.rods), point.poses), *kept)

    def departure(
        self, parameter: Float[Array, ""], motion: HarnessMotion, share: Float[Array, ""]
    ) -> tuple[tuple[tuple[Direction, ...], Float[Array, "q"]], None]:
        """A motion of the equilibrium in global axes; a step may be any part of it."""

        def turns(rod: Equilibrium, rotation: Float[Array, "b m"]) -> Float[Array, "3 m"]:
            form, point = form_and_point(rod)
            return short_sum(form.bases_at(point) * rotation[None], axis=1)

        directions = [
            Direction(of_each(turns)(group, x.rotation), x.multipliers)
            for group, x in zip(self.equilibrium.groups, motion.rods, strict=True)
        ]
        return (tuple(directions), motion.bodies), None

    def retracted(self, place: HarnessPlace, motion: HarnessMotion) -> tuple[Float[Array, ""], HarnessPoint]:
        """The part of a motion that a correction may take, and the point after that."""
        assembly = place.under.assembly
        of_bodies = (assembly.bodies.motions @ motion.bodies).reshape(assembly.count, 6)
        largest = jnp.max(jnp.abs(of_bodies[:, 3:]), initial=0.0)
        for x in motion.rods:
            largest = jnp.maximum(largest, jnp.max(jnp.abs(x.rotation)))
        part = jnp.minimum(1.0, MAX_ROTATION / largest)
        bases = tuple(each.here.bases for each in place.rods)
        motion = jax.tree.map(lambda x: part * x, motion)
        return part, self._retracted(place.under, place.point.rods, bases, motion)

    def result(
        self, parameter: Float[Array, ""], place: HarnessPlace, outcome: Outcome, index: Int[Array, ""]
    ) -> HarnessEquilibrium:
        under, result = place.under, self.equilibrium
        state = under.assembly.begin(place.point.rods, tuple(None for _ in place.rods), (), (), under.poses)
        end = state._replace(
            residual=outcome.residual,
            residuals=place.residuals,
            iterations=outcome.iterations,
            evaluations=outcome.evaluations,
            status=outcome.status,
            negative=index.astype(int),
        )
        begun = tuple((None, None) for _ in place.rods)
        rest = result.members, under.assembly, end, result.end_pressures, DEFAULT_STRAIN_LIMIT, begun
        return harness_equilibrium(self._harness(parameter), *rest)


def no_motion(result: HarnessEquilibrium) -> HarnessMotion:
    """A motion of an equilibrium that leaves it where it is."""

    def residual_vectors(result: HarnessEquilibrium) -> HarnessMotion:
        rods = []
        for group in result.groups:
            rods.append(Motion(*of_each(lambda rod: _vectors(*form_and_point(rod)))(group)))
        return HarnessMotion(tuple(rods), jnp.zeros(len(Bodies.of(result.harness).columns), result.positions.dtype))

    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(residual_vectors, result))


def _vectors(form: Any, point: Any) -> tuple[Array, Array]:
    here = form.linearized(point)
    return here.gradient, here.constraint_residual
