"""Derivatives of the equilibrium of a harness, by the implicit function theorem."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import is_known
from rodjax.linalg.small_matrices import inverse_matrix
from rodjax.model.harness import Bodies, Harness, clamped, rotated
from rodjax.model.scene import Scene
from rodjax.programs.linear import linear
from rodjax.solving.assembly import Poses
from rodjax.solving.harness_forces import body_forces, contact_forces, energy_of, stacked
from rodjax.solving.harness_result import HarnessEquilibrium, Solution
from rodjax.solving.implicit import differentiable, with_zeros
from rodjax.solving.result import Equilibrium
from rodjax.solving.rod_contact_results import TouchingRods, touching_rods

# Of contacts of bodies, beside the stiffest motion of these, and how often what it gives way by is asked for again.
ENDS_COMPLIANCE = 1e-4
ENDS_HARDENINGS = 4


def differentiable_harness(harness: Harness, result: HarnessEquilibrium) -> HarnessEquilibrium:
    """What a search found, with the derivatives by the harness that the search for it has not."""
    return result if is_known(harness) else _differentiable(harness, result)


def differentiable_by(subject: Scene | Harness, result: Solution) -> Any:
    """The same of a scene or a harness."""
    if isinstance(subject, Harness):
        assert isinstance(result, HarnessEquilibrium)
        return differentiable_harness(subject, result)
    assert isinstance(result, Equilibrium)
    return differentiable(subject, result)


@eqx.filter_custom_jvp
def _differentiable(harness: Harness, result: HarnessEquilibrium) -> HarnessEquilibrium:
    return result


@_differentiable.def_jvp
def _(primals, tangents):
    harness, result = primals
    change = with_zeros(tangents[0], harness)
    value = _differentiable(harness, result)
    return value, _change_of_result(*jax.lax.optimization_barrier((harness, value)), change)


@linear
def _change_of_result(harness: Harness, result: HarnessEquilibrium, change: Harness) -> HarnessEquilibrium:
    near = _Near.of(harness, result)
    by_unknown = jax.vmap(lambda way: jax.jvp(lambda x: near.at(harness, x), (near.nowhere,), (way,))[1])
    of_unknown, stiffness = by_unknown(jnp.eye(near.size, dtype=near.nowhere.dtype))
    of_change, lacking = jax.jvp(lambda harness: near.at(harness, near.nowhere), (harness,), (change,))[1]
    unknown = near.solved(stiffness.T, -lacking)

    def total(of_unknown: Array, of_change: Array) -> Array | None:
        return None if of_change.dtype == jax.dtypes.float0 else of_change + jnp.tensordot(unknown, of_unknown, 1)

    return jax.tree.map(total, of_unknown, of_change)


def jacobian(
    function: Callable[[Array, Any, Any], tuple[Any, Any]],
    subject_at: Callable[[Array], Any],
    u: Float[Array, "n"],
    result: Solution,
) -> tuple[Any, Any, Any]:
    """Of the first output of a function of `u`, the scene or harness there and its equilibrium the value, and the
    derivatives by `u` along a leading axis; the second output. The rods of a harness are linearised in one place of the
    program, where `jax.jacfwd` of it has two.
    """
    near = _Near.of(subject_at(u), result) if isinstance(result, HarnessEquilibrium) else None

    def found(u: Float[Array, "n"], unknown: Float[Array, "k"]) -> tuple[Any, Any]:
        subject = subject_at(u)
        if near is None:
            value, other = function(u, subject, differentiable_by(subject, result))
            return (value, unknown), other
        there, lacking = near.at(subject, unknown)
        value, other = function(u, subject, there)
        return (value, lacking), other

    nowhere = jnp.zeros(0, u.dtype) if near is None else near.nowhere
    ways = jnp.split(jnp.eye(len(u) + len(nowhere), dtype=u.dtype), [len(u)], axis=1)
    along = jax.vmap(lambda *way: jax.jvp(found, (u, nowhere), way, has_aux=True), out_axes=(None, 0, None))
    (value, _), (rates, lacking), other = along(*ways)
    if near is None:
        return value, rates, other
    n = len(u)
    unknowns = near.solved(lacking[n:].T, -lacking[:n].T)  # (k, n)
    return value, jax.tree.map(lambda rate: rate[:n] + jnp.tensordot(unknowns.T, rate[n:], 1), rates), other


class _Near(NamedTuple):
    """A harness near its equilibrium, as a function of its numbers and of what is unknown: motions of bodies, contacts
    between rods, pressures of bodies on obstacles. The rods, between clamps at the bodies, have derivatives of their
    own.
    """

    result: HarnessEquilibrium
    others: Bodies
    touching: TouchingRods | None
    nowhere: Float[Array, "k"]  # the unknowns of the equilibrium

    @staticmethod
    def of(harness: Harness, result: HarnessEquilibrium) -> "_Near":
        harness, result = jax.lax.stop_gradient((harness, result))
        of_rods = result.rod_pressures, result.wide_wells
        touching = touching_rods(harness, result.groups, *of_rods, result.members)
        others, dtype = Bodies.of(harness), result.positions.dtype
        touches = jnp.zeros(0, dtype) if touching is None else touching.values
        nowhere = jnp.concatenate([jnp.zeros(len(others.columns), dtype), touches, result.end_pressures])
        return _Near(result, others, touching, nowhere)

    @property
    def size(self) -> int:
        return len(self.nowhere)

    def _split(self, unknown: Float[Array, "k"]) -> list[Array]:
        return jnp.split(unknown, self._sizes)

    @property
    def _sizes(self) -> list[int]:
        bodies = len(self.others.columns)
        return [bodies, self.size - len(self.result.end_pressures)]

    def at(self, harness: Harness, unknown: Float[Array, "k"]) -> tuple[HarnessEquilibrium, Float[Array, "k"]]:
        """The harness with these unknowns; what is out of balance of the bodies, what contacts between rods lack, and
        the gaps of bodies that are closed, pressures where they are open.
        """
        result, touching = self.result, self.touching
        motions, touches, pressures = self._split(unknown)
        bodies = Bodies.of(harness)
        positions, frames = bodies.followed(self.others, result.positions, result.frames)
        each = (bodies.motions @ motions).reshape(len(positions), 6)
        there = Poses(positions + each[:, :3], rotated(frames, each[:, 3:]))
        rods = []
        for number, (numbers, group) in enumerate(zip(result.members, result.groups, strict=True)):
            scenes = stacked([clamped(harness.scenes[k], harness, *there) for k in numbers])
            if touching is not None:
                scenes = touching.loaded(scenes, number, touches)
            rods.append(differentiable(scenes, group))
        forces = body_forces(harness, rods, bodies, there, result.members)
        pushes, gaps = contact_forces(harness, result.members, there, pressures)
        lacking = [bodies.motions.T @ (forces + pushes).reshape(-1)]
        lacking += [touches if touching is None else touching.lacking(rods, touches)]
        lacking += [jnp.where(result.end_pressures > 0, gaps, pressures)]
        rod_pressures = result.rod_pressures if touching is None else touching.pressures(result.rod_pressures, touches)
        found = dataclasses.replace(
            result,
            groups=tuple(rods),
            positions=there.positions,
            frames=there.frames,
            energy=energy_of(rods, bodies, there),
            contact_forces=pushes[:, :3],
            end_pressures=pressures,
            rod_pressures=rod_pressures,
            harness=harness,
        )
        return found, jnp.concatenate(lacking)

    def solved(self, matrix: Float[Array, "k k"], right: Float[Array, "k ..."]) -> Float[Array, "k ..."]:
        """Where contacts of several rods with a body are one, who bears it is undetermined: softened, and what that
        gives way by asked for again.
        """
        bodies, count = self._sizes
        if self.size == count:
            return jnp.linalg.solve(matrix, right) if count else right
        stiffest = jnp.max(jnp.abs(jnp.diagonal(matrix)[:bodies]))
        is_pressure = np.arange(self.size) >= count
        soft = matrix + jnp.diag(jnp.where(is_pressure, ENDS_COMPLIANCE / stiffest, 0.0).astype(right.dtype))
        inverse = inverse_matrix(soft)
        found = inverse @ right
        for _ in range(ENDS_HARDENINGS):
            found += inverse @ (right - matrix @ found)
        return found
