"""The linearised equations of all rods and bodies of a harness as one system: its factors, metric and motions.

The system of each rod between clamps is factorised by itself, and what is left for the motions of the bodies is small
and dense, as in `rodjax.solving.condensation`. In the metric the squares of the turns of all rods count by the parts of
their lengths in that of all, with the ends that turn with bodies.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.discretization.form import NEUTRAL, Form, Linearization
from rodjax.discretization.joints import generic_field
from rodjax.discretization.motion import Metric, Motion
from rodjax.geometry.vectors import components
from rodjax.linalg.saddle_point import AnySystem
from rodjax.model.supports import Clamp
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, Rods
from rodjax.solving.condensation import LEAST_STIFFNESS
from rodjax.solving.coupling import ENDS, Coupling, RodInBodies, coupling, held


class HarnessMotion(eqx.Module):
    """A change of an equilibrium: of the rods of each group, stacked, and of the bodies along `Bodies.motions`."""

    rods: tuple[Motion, ...]
    bodies: Float[Array, "q"]


class LinearizedRod(NamedTuple):
    """A rod with its ends held, what couples it to the bodies there, and its part of the metric."""

    here: Linearization
    coupling: Coupling
    mass: Float[Array, "m"]
    of_ends: Float[Array, "12 12"]

    @staticmethod
    def of(rod: RodInBodies, point: Any) -> "LinearizedRod":
        """`rod.form` with its ends where the bodies are, and a point that holds them."""
        form: Form = rod.form
        released = form.released(point)
        here = held(form, released)
        of_ends = jnp.zeros((2, 6, 2, 6), here.gradient.dtype)
        for number, (end, support) in enumerate(zip(ENDS, (form.scene.start, form.scene.end), strict=True)):
            if isinstance(support, Clamp):
                turn = form.end_turn(point, released, end).rotation
                of_ends = of_ends.at[number, 3:, number, 3:].set(form.field.weights[end] * turn.T @ turn)
        mass = Metric.of(form, here).mass
        return LinearizedRod(here, coupling(rod, form, point, released), mass, of_ends.reshape(12, 12))


class GroupSystem(eqx.Module):
    """Linearised rods of one structure, stacked, in their own units: `couplings` with the bodies; `along`: the motions
    of their ends with those of the bodies; `mass`, `of_ends`: of the metric, by rotations and by motions of the ends;
    `energies`, `lengths`: parts of the unit of energy and of the length of all rods.
    """

    system: AnySystem
    couplings: Coupling
    along: Float[Array, "k 12 q"]
    mass: Float[Array, "k m"]
    of_ends: Float[Array, "k 12 12"]
    energies: Float[Array, "k"]
    lengths: Float[Array, "k"]

    @staticmethod
    def of(assembly: Assembly, group: Rods, rods: LinearizedRod) -> "GroupSystem":
        """`rods`: stacked."""
        motions = assembly.bodies.motions
        at_bodies = jnp.pad(motions, ((0, 6), (0, 0))).reshape(-1, 6, motions.shape[1])
        along = at_bodies[group.body].reshape(len(group.body), 12, -1)
        lengths = group.units.length / total_length(assembly)
        system = rods.here.system
        return GroupSystem(system, rods.coupling, along, rods.mass, rods.of_ends, assembly.shares(group), lengths)

    def shifted(self, value: Float[Array, ""]) -> "GroupSystem":
        """With a multiple of the metric added."""
        return self._with_shifts(value * self.lengths / self.energies)

    def regular(self) -> "GroupSystem":
        """So little shifted that derivatives do not show it: by no more than a rod alone."""
        return self._with_shifts(NEUTRAL * jnp.minimum(self.lengths / self.energies, 1.0))

    def _with_shifts(self, shifts: Float[Array, "k"]) -> "GroupSystem":
        system = of_each(lambda system, shift: system.shifted(shift))(self.system, shifts[:, None] * self.mass)
        second = self.couplings.second + shifts[:, None, None] * self.of_ends
        return dataclasses.replace(self, system=system, couplings=self.couplings._replace(second=second))

    def of_bodies(self, loads: Float[Array, "k 12"]) -> Float[Array, "q"]:
        """What loads on the ends are along the motions of the bodies, summed over the rods."""
        return jnp.einsum("k,kiq,ki->q", self.energies, self.along, loads)


def total_length(assembly: Assembly) -> Float[Array, ""]:
    """Of all rods [m]."""
    return sum((jnp.sum(rods.units.length) for rods in assembly.groups), jnp.zeros_like(assembly.length))


def unit_of_stiffness(assembly: Assembly) -> Float[Array, ""]:
    """Of eigenvalues in the metric [N]."""
    return assembly.energy / total_length(assembly)


class AssembledFactors(NamedTuple):
    """`by_motions`: the solutions of the rods for motions of their ends; `values`, `vectors`: of the stiffness that is
    left for the bodies; `negative`: the number of negative eigenvalues under the constraints.
    """

    groups: tuple[GroupSystem, ...]
    factors: tuple[Any, ...]
    by_motions: tuple[Motion, ...]
    values: Float[Array, "q"]
    vectors: Float[Array, "q q"]
    negative: Int[Array, ""]

    def solve(self, residual: HarnessMotion) -> HarnessMotion:
        loads, first = residual.bodies, []
        for group, factors, right in zip(self.groups, self.factors, residual.rods, strict=True):
            right = jax.tree.map(lambda x, group=group: of_each(jnp.divide)(x, group.energies), right)
            here = Motion(*of_each(_solved)(factors, right.rotation, right.multipliers))
            first.append(here)
            of_ends = jnp.einsum("kbmi,kbm->ki", group.couplings.of_gradient, here.rotation)
            of_ends += jnp.einsum("kci,kc->ki", group.couplings.of_constraints, here.multipliers)
            loads -= group.of_bodies(of_ends)
        values = jnp.where(jnp.abs(self.values) < LEAST_STIFFNESS, LEAST_STIFFNESS, self.values)
        bodies = self.vectors @ ((self.vectors.T @ loads) / values)
        rods = []
        for group, by_motions, here in zip(self.groups, self.by_motions, first, strict=True):
            of_ends = group.along @ bodies
            rotation = here.rotation - jnp.einsum("kbmi,ki->kbm", by_motions.rotation, of_ends)
            rods.append(Motion(rotation, here.multipliers - jnp.einsum("kci,ki->kc", by_motions.multipliers, of_ends)))
        return HarnessMotion(tuple(rods), bodies)


def _solved(factors: Any, rotation: Array, multipliers: Array) -> tuple[Array, Array]:
    return factors.solve(rotation, multipliers)


class HarnessMetric(NamedTuple):
    """The square of a motion: that of the turns of all rods and their ends, by their parts of the length of all."""

    groups: tuple[GroupSystem, ...]

    def inner(self, motion: HarnessMotion, other: HarnessMotion) -> Float[Array, ""]:
        total = jnp.zeros((), motion.bodies.dtype)
        for group, x, y in zip(self.groups, motion.rods, other.rods, strict=True):
            each = jnp.sum(group.mass[:, None] * x.rotation * y.rotation, axis=(1, 2))
            each += jnp.einsum("ki,kij,kj->k", group.along @ motion.bodies, group.of_ends, group.along @ other.bodies)
            total += jnp.sum(group.lengths * each)
        return total

    def times(self, motion: HarnessMotion) -> HarnessMotion:
        """The residual whose work in any other motion is the inner product with it."""
        bodies, rods = jnp.zeros_like(motion.bodies), []
        for group, x in zip(self.groups, motion.rods, strict=True):
            rotation = group.lengths[:, None, None] * group.mass[:, None] * x.rotation
            rods.append(Motion(rotation, jnp.zeros_like(x.multipliers)))
            of_ends = jnp.einsum("kij,kj->ki", group.of_ends, group.along @ motion.bodies)
            bodies += jnp.einsum("k,kiq,ki->q", group.lengths, group.along, of_ends)
        return HarnessMotion(tuple(rods), bodies)


class AssembledSystem(eqx.Module):
    """Of all rods and bodies; `springs`: second derivatives of the energies of the bodies, along their motions. Its
    matrix is in the unit of energy of the assembly.
    """

    groups: tuple[GroupSystem, ...]
    springs: Float[Array, "q q"]

    @staticmethod
    def of(assembly: Assembly, groups: tuple[GroupSystem, ...], springs: Float[Array, "j 6 6"]) -> "AssembledSystem":
        motions = assembly.bodies.motions
        return AssembledSystem(groups, motions.T @ jax.scipy.linalg.block_diag(*springs) @ motions)

    @property
    def metric(self) -> HarnessMetric:
        return HarnessMetric(self.groups)

    def times(self, motion: HarnessMotion) -> HarnessMotion:
        bodies, rods = self.springs @ motion.bodies, []
        for group, x in zip(self.groups, motion.rods, strict=True):
            couple, of_ends = group.couplings, group.along @ motion.bodies
            rotation, multipliers = of_each(lambda system, x, y: system.times(x, y))(
                group.system, x.rotation, x.multipliers
            )
            rotation += jnp.einsum("kbmi,ki->kbm", couple.of_gradient, of_ends)
            multipliers += jnp.einsum("kci,ki->kc", couple.of_constraints, of_ends)
            loads = jnp.einsum("kij,kj->ki", couple.second, of_ends)
            loads += jnp.einsum("kbmi,kbm->ki", couple.of_gradient, x.rotation)
            loads += jnp.einsum("kci,kc->ki", couple.of_constraints, x.multipliers)
            bodies += group.of_bodies(loads)
            energies = group.energies
            rods.append(Motion(energies[:, None, None] * rotation, energies[:, None] * multipliers))
        return HarnessMotion(tuple(rods), bodies)

    def shifted(self, value: Float[Array, ""]) -> "AssembledSystem":
        """With a multiple of the metric added."""
        return dataclasses.replace(self, groups=tuple(group.shifted(value) for group in self.groups))

    def regular(self) -> "AssembledSystem":
        """So little shifted that derivatives do not show it."""
        return dataclasses.replace(self, groups=tuple(group.regular() for group in self.groups))

    def factored(self, factor: Callable[[AnySystem], Any]) -> AssembledFactors:
        """`factor`: of the system of one rod."""
        stiffness, negative = self.springs, jnp.zeros((), int)
        all_factors, all_by_motions = [], []
        for group in self.groups:

            def of_rod(system: AnySystem, couple: Coupling):
                factors = factor(system)
                rotations, multipliers = jax.vmap(factors.solve, (-1, -1), -1)(
                    couple.of_gradient, couple.of_constraints
                )
                left = couple.second - couple.of_constraints.T @ multipliers
                left -= jnp.einsum("bmi,bmj->ij", couple.of_gradient, rotations)
                return factors, Motion(rotations, multipliers), left

            factors, by_motions, left = of_each(of_rod)(group.system, group.couplings)
            stiffness += jnp.einsum("k,kip,kij,kjq->pq", group.energies, group.along, left, group.along)
            negative += jnp.sum(factors.negative)
            all_factors.append(factors)
            all_by_motions.append(by_motions)
        values, vectors = jnp.linalg.eigh((stiffness + stiffness.T) / 2)
        negative += jnp.sum(values < 0)
        return AssembledFactors(self.groups, tuple(all_factors), tuple(all_by_motions), values, vectors, negative)


def generic_motion(rods: tuple[LinearizedRod, ...], points: tuple[Any, ...], system: AssembledSystem) -> HarnessMotion:
    """A motion along no other."""
    motions = []
    for each, point in zip(rods, points, strict=True):
        rotation = of_each(lambda here, point: components(here.bases, generic_field(point.tangents)))(each.here, point)
        motions.append(Motion(rotation, jnp.zeros_like(each.here.constraint_residual)))
    return HarnessMotion(tuple(motions), jnp.ones(len(system.springs), system.springs.dtype))
