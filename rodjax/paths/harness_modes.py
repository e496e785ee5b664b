"""The softest motion of a harness: of all its rods and joints together."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.contact_gaps import model_compliance
from rodjax.discretization.form import Form, Linearization
from rodjax.discretization.joints import generic_field
from rodjax.discretization.motion import Metric
from rodjax.discretization.nodal import NodalForm
from rodjax.geometry.vectors import components
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import factor
from rodjax.model.harness import Bodies
from rodjax.model.scene import nondimensional
from rodjax.model.supports import Clamp
from rodjax.programs.compilation import compiled
from rodjax.solving.assembly import Assembly, Poses, Rods
from rodjax.solving.coupling import ENDS, Coupling, RodInBodies, coupling, end_contacts, held
from rodjax.solving.harness import ends_of, split_pressures
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import form_and_point
from rodjax.solving.stability import INVERSE_ITERATIONS, below_lowest


class HarnessMode(eqx.Module):
    """The motion in which the equilibrium of a harness is softest.

    - `stiffness` N: the second variation of the energy in this motion, by the integral along all rods of the squared
      change of the tangents, or of the frames where these are unknown; negative where the energy falls
    - `displacements`: by the names of the rods, of their nodes (n+1, 3), the largest of all 1
    """

    stiffness: Float[Array, ""]
    displacements: dict[str, Float[Array, "n+1 3"]]


class _Group(NamedTuple):
    """Rods of one structure, stacked: their linearisations, what couples them to bodies, with closed contacts; the
    squares of their motions, by rotations and by motions of the ends; and the unit of energy in that of all.
    """

    rods: RodInBodies
    point: object
    here: Linearization
    coupling: Coupling
    mass: Float[Array, "k m"]
    of_ends: Float[Array, "k 12 12"]
    body: Array
    shares: Float[Array, "k"]


def _of_rod(rod: RodInBodies, point: object, pressures: Float[Array, "o 2"] | None):
    form = rod.form
    released = form.released(point)
    here, couple = held(form, released), coupling(rod, form, point, released)
    of_ends = jnp.zeros((2, 6, 2, 6), here.gradient.dtype)
    for number, (end, support) in enumerate(zip(ENDS, (form.scene.start, form.scene.end), strict=True)):
        if isinstance(support, Clamp):
            turn = form.end_turn(point, released, end).rotation
            of_ends = of_ends.at[number, 3:, number, 3:].set(form.field.weights[end] * turn.T @ turn)
    if pressures is not None:
        assert isinstance(form, NodalForm)
        at_ends, couple = end_contacts(rod, form, pressures, couple)
        rates = jnp.where(at_ends.is_closed[..., None], at_ends.rates, 0.0)
        stiff = jnp.einsum("oei,oej->eij", rates, rates) / model_compliance(form)
        couple = couple._replace(second=couple.second + jax.scipy.linalg.block_diag(*stiff))
        couple = couple._replace(of_constraints=_with_gaps(here, couple))
    return here, couple, Metric.of(form, here).mass / rod.units.force, of_ends.reshape(12, 12) / rod.units.force


def _with_gaps(here: Linearization, couple: Coupling) -> Float[Array, "k 12"]:
    """The rows of what the motions of the ends add to the constraint residual, with those of closed contacts."""
    system = here.system
    assert isinstance(system, ChainSystem)
    assert couple.of_gaps is not None
    is_closed, first = system.contacts.is_closed, len(system.compliance)
    rates = -jnp.where(is_closed[..., None], couple.of_gaps, 0.0).reshape(-1, 12)
    return couple.of_constraints.at[first : first + is_closed.size].set(rates)


def _groups(result: HarnessEquilibrium) -> tuple[Assembly, list[_Group]]:
    harness = result.harness
    bodies, poses = Bodies.of(harness), Poses(result.positions, result.frames)
    all_rods, points = [], []
    for numbers, group in zip(result.members, result.groups, strict=True):
        forms, of_group = jax.vmap(form_and_point)(group)
        units = jax.vmap(lambda scene: nondimensional(scene)[1])(group.scene)
        all_rods.append(Rods(forms, group.state.shape, units, *ends_of(harness, numbers)))
        points.append(of_group)
    assembly, found = Assembly.of(tuple(all_rods), bodies), []
    pressures = split_pressures(harness, result.members, result.end_pressures)
    for rods, point, of_ends in zip(all_rods, points, pressures, strict=True):
        each = assembly.rods(rods, poses)
        of_ends = None if of_ends is None else of_ends / rods.units.force[:, None, None]
        found.append(_Group(each, point, *jax.vmap(_of_rod)(each, point, of_ends), rods.body, assembly.shares(rods)))
    return assembly, found


@compiled
def harness_mode(result: HarnessEquilibrium) -> HarnessMode:
    """See `rodjax.paths.modes.lowest_mode`."""
    assembly, groups = _groups(result)
    motions, dtype = assembly.bodies.motions, result.positions.dtype
    _, springs = assembly.body_derivatives(Poses(result.positions, result.frames))
    springs = motions.T @ jax.scipy.linalg.block_diag(*springs) @ motions
    at_bodies = jnp.pad(motions, ((0, 6), (0, 0))).reshape(-1, 6, motions.shape[1])

    def along(group: _Group) -> Float[Array, "k 12 q"]:
        return at_bodies[group.body].reshape(len(group.body), 12, -1)

    def factored(value: Float[Array, ""]):
        """The factors of all rods, their solutions by motions of the ends, and the stiffness left for the bodies."""
        stiffness, found = springs, []
        for group in groups:

            def of_rod(here: Linearization, couple: Coupling, mass: Array, of_ends: Array):
                factors = factor(here.system.shifted(-value * mass))
                solved = jax.vmap(factors.solve, (-1, -1), -1)(couple.of_gradient, couple.of_constraints)
                left = couple.second - value * of_ends - couple.of_constraints.T @ solved[1]
                return factors, solved, left - jnp.einsum("bmi,bmj->ij", couple.of_gradient, solved[0])

            factors, solved, left = jax.vmap(of_rod)(group.here, group.coupling, group.mass, group.of_ends)
            stiffness += jnp.einsum("k,kip,kij,kjq->pq", group.shares, along(group), left, along(group))
            found.append((factors, solved))
        return found, (stiffness + stiffness.T) / 2

    def lies_below(value: Float[Array, ""]) -> Bool[Array, ""]:
        found, stiffness = factored(value)
        count = jnp.sum(jnp.linalg.eigvalsh(stiffness) < 0)
        return count + sum(jnp.sum(factors.negative) for factors, _ in found) > 0

    low = below_lowest(lies_below, assembly.energy / assembly.length)
    found, stiffness = factored(low)

    def squared(rotations: list[Array], q: Array, others: list[Array], p: Array) -> Float[Array, ""]:
        total = jnp.zeros((), dtype)
        for group, x, y in zip(groups, rotations, others, strict=True):
            of_q, of_p = along(group) @ q, along(group) @ p
            each = jnp.sum(group.mass[:, None] * x * y, axis=(1, 2))
            each += jnp.einsum("ki,kij,kj->k", of_q, group.of_ends, of_p)
            total += jnp.sum(group.shares * each)
        return total

    def solved(rotations: list[Array], q: Array) -> tuple[list[Array], list[Array], Array]:
        force, first = jnp.zeros_like(q), []
        for group, (factors, _), x in zip(groups, found, rotations, strict=True):
            right = group.mass[:, None] * x
            nothing = jnp.zeros_like(group.here.constraint_residual)
            here = jax.vmap(lambda factors, f, c: factors.solve(f, c))(factors, right, nothing)
            first.append(here)
            loads = jnp.einsum("kbmi,kbm->ki", group.coupling.of_gradient, here[0])
            loads += jnp.einsum("kci,kc->ki", group.coupling.of_constraints, here[1])
            own = jnp.einsum("kij,kj->ki", group.of_ends, along(group) @ q)
            force += jnp.einsum("k,kiq,ki->q", group.shares, along(group), own - loads)
        moved = jnp.linalg.solve(stiffness, force) if len(q) else q
        results, multipliers = [], []
        for group, (_, by_motions), (x, y) in zip(groups, found, first, strict=True):
            of_ends = along(group) @ moved
            results.append(x - jnp.einsum("kbmi,ki->kbm", by_motions[0], of_ends))
            multipliers.append(y - jnp.einsum("kci,ki->kc", by_motions[1], of_ends))
        return results, multipliers, moved

    generic = [
        jax.vmap(lambda here, point: components(here.bases, generic_field(point.tangents)))(group.here, group.point)
        for group in groups
    ]

    def closer(_, state):
        rotations, _, q, _ = state
        new, multipliers, moved = solved(rotations, q)
        size = jnp.sqrt(squared(new, moved, new, moved))
        share = squared(new, moved, rotations, q)
        scaled = jax.tree.map(lambda value: value / size, (new, multipliers, moved))
        return *scaled, low + share / size**2

    nothing = [jnp.zeros_like(group.here.constraint_residual) for group in groups]
    begin = generic, nothing, jnp.ones(motions.shape[1], dtype), low
    rotations, multipliers, q, value = jax.lax.fori_loop(0, INVERSE_ITERATIONS, closer, begin)

    displacements: dict[str, Array] = {}
    for numbers, group, x, y in zip(result.members, groups, rotations, multipliers, strict=True):
        moved = jax.vmap(_displaced)(group.rods, group.point, group.here, x, y, along(group) @ q)
        displacements |= {result.names[number]: moved[k] for k, number in enumerate(numbers)}
    largest = jnp.sqrt(jnp.max(jnp.stack([jnp.max(jnp.sum(moved**2, axis=1)) for moved in displacements.values()])))
    return HarnessMode(value, {name: displacements[name] / largest for name in result.names})


def _displaced(
    rod: RodInBodies,
    point: object,
    here: Linearization,
    rotation: Array,
    multipliers: Array,
    motions: Float[Array, "12"],
) -> Float[Array, "n+1 3"]:
    """Of the nodes, as a motion begins."""
    form: Form = rod.form
    change, others = form.layout.forces(form.force_components(multipliers)), form.others(multipliers)

    def nodes(part: Float[Array, ""]) -> Float[Array, "n+1 3"]:
        there = rod.form_at(part * motions.reshape(2, 6))
        step = jax.tree.map(lambda value: part * value, others)
        return there.nodes_of(there.holding(there.retract(point, here.bases, part * rotation, part * change, step)))

    zero = jnp.zeros((), motions.dtype)
    return rod.units.length * jax.jvp(nodes, (zero,), (jnp.ones_like(zero),))[1]
