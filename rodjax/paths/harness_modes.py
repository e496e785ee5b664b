"""The softest motion of a harness: of all its rods and joints together."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import is_known
from rodjax.discretization.contact_gaps import model_compliance
from rodjax.discretization.form import Form, Linearization
from rodjax.discretization.nodal import NodalForm
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import factor
from rodjax.model.harness import Bodies
from rodjax.model.scene import nondimensional
from rodjax.model.summaries import range_text
from rodjax.paths.assembled import (
    AssembledSystem,
    GroupSystem,
    HarnessMotion,
    LinearizedRod,
    generic_motion,
    unit_of_stiffness,
)
from rodjax.programs.compilation import compiled
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, Poses, Rods
from rodjax.solving.coupling import Coupling, RodInBodies, end_contacts
from rodjax.solving.harness_forces import ends_of, split_pressures
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result_form import form_and_point
from rodjax.solving.result_summary import motion_text
from rodjax.solving.stability import INVERSE_ITERATIONS, below_lowest


class HarnessMode(eqx.Module):
    """The motion in which the equilibrium of a harness is softest.

    - `stiffness` N: the second variation of the energy in this motion, by the integral along all rods of the squared
      change of the tangents, or of the frames where these are unknown; negative where the energy falls. Derivatives by
      the harness are exact, of two motions equally soft those of one
    - `displacements`: by the names of the rods, of their nodes (n+1, 3), the largest of all 1; taken as fixed by
      derivatives
    """

    stiffness: Float[Array, ""]
    displacements: dict[str, Float[Array, "n+1 3"]]

    def __str__(self) -> str:
        """The stiffness, and where the motion is largest."""
        if not is_known(self):
            return "Mode of a harness: values not known inside jax.jit, vmap or grad"
        name = max(self.displacements, key=lambda name: float(np.max(np.abs(np.asarray(self.displacements[name])))))
        where = motion_text(self.displacements[name])
        return f"Mode of a harness: stiffness {range_text(self.stiffness, 'N')}, largest motion of {name} {where}"


class _Group(NamedTuple):
    """Rods of one structure, stacked, with closed contacts."""

    rods: RodInBodies
    point: Any
    linearized: LinearizedRod


def _of_rod(rod: RodInBodies, point: Any, pressures: Float[Array, "o 2"] | None) -> LinearizedRod:
    found, form = LinearizedRod.of(rod, point), rod.form
    if pressures is None:
        return found
    assert isinstance(form, NodalForm)
    at_ends, couple = end_contacts(rod, form, pressures, found.coupling)
    rates = jnp.where(at_ends.is_closed[..., None], at_ends.rates, 0.0)
    stiff = jnp.einsum("oei,oej->eij", rates, rates) / model_compliance(form)
    couple = couple._replace(second=couple.second + jax.scipy.linalg.block_diag(*stiff))
    return found._replace(coupling=couple._replace(of_constraints=_with_gaps(found.here, couple)))


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
        forms, of_group = of_each(form_and_point)(group)
        units = of_each(lambda scene: nondimensional(scene)[1])(group.scene)
        all_rods.append(Rods(forms, group.state.shape, units, *ends_of(harness, numbers)))
        points.append(of_group)
    assembly, found = Assembly.of(tuple(all_rods), bodies), []
    pressures = split_pressures(harness, result.members, result.end_pressures)
    for rods, point, of_ends in zip(all_rods, points, pressures, strict=True):
        each = assembly.rods(rods, poses)
        of_ends = None if of_ends is None else of_ends / rods.units.force[:, None, None]
        found.append(_Group(each, point, of_each(_of_rod)(each, point, of_ends)))
    return assembly, found


@compiled
def harness_mode(result: HarnessEquilibrium) -> HarnessMode:
    """See `rodjax.paths.modes.lowest_mode`."""
    assembly, groups = _groups(result)
    system = _system(result, assembly, groups)
    fixed = jax.lax.stop_gradient((result, assembly, groups, system))
    stiffness, motion = _softest(*fixed[2:])
    # As of one rod (`solving.stability.softest`): the quotient is stationary at its motion.
    residual = system.times(motion)
    works = [jnp.sum(a * b) for a, b in zip(jax.tree.leaves(motion), jax.tree.leaves(residual), strict=True)]
    quotient = sum(works[1:], works[0]) / system.metric.inner(motion, motion)
    mode = _mode(*fixed, motion, stiffness)
    stiffness += quotient - jax.lax.stop_gradient(quotient)
    return eqx.tree_at(lambda mode: mode.stiffness, mode, stiffness * unit_of_stiffness(assembly))


def _softest(groups: list[_Group], system: AssembledSystem) -> tuple[Float[Array, ""], HarnessMotion]:
    """The lowest eigenvalue, in the unit of the assembly, and its motion."""

    def lies_below(value: Float[Array, ""]) -> Bool[Array, ""]:
        return system.shifted(-value).factored(factor).negative > 0

    low = below_lowest(lies_below, jnp.ones((), system.springs.dtype))
    factors, metric = system.shifted(-low).factored(factor), system.metric

    def closer(_, found: tuple[HarnessMotion, Float[Array, ""]]) -> tuple[HarnessMotion, Float[Array, ""]]:
        motion = factors.solve(metric.times(found[0]))
        size = jnp.sqrt(metric.inner(motion, motion))
        share = metric.inner(motion, found[0])
        return jax.tree.map(lambda x: x / size, motion), low + share / size**2

    linearized = tuple(group.linearized for group in groups)
    generic = generic_motion(linearized, tuple(group.point for group in groups), system)
    motion, stiffness = jax.lax.fori_loop(0, INVERSE_ITERATIONS, closer, (generic, low))
    return stiffness, motion


@compiled
def mode_of_motion(result: HarnessEquilibrium, stiffness: Float[Array, ""], motion: HarnessMotion) -> HarnessMode:
    """A motion of an equilibrium in SI units, and its stiffness in the unit of the assembly."""
    assembly, groups = _groups(result)
    return _mode(result, assembly, groups, _system(result, assembly, groups), motion, stiffness)


def _system(result: HarnessEquilibrium, assembly: Assembly, groups: list[_Group]) -> AssembledSystem:
    _, springs = assembly.body_derivatives(Poses(result.positions, result.frames))
    all_rods = zip(assembly.groups, groups, strict=True)
    systems = tuple(GroupSystem.of(assembly, rods, group.linearized) for rods, group in all_rods)
    return AssembledSystem.of(assembly, systems, springs)


def _mode(
    result: HarnessEquilibrium,
    assembly: Assembly,
    groups: list[_Group],
    system: AssembledSystem,
    motion: HarnessMotion,
    stiffness: Float[Array, ""],
) -> HarnessMode:
    displacements: dict[str, Array] = {}
    for numbers, group, of_group, x in zip(result.members, groups, system.groups, motion.rods, strict=True):
        bases, of_ends = group.linearized.here.bases, of_group.along @ motion.bodies
        moved = of_each(_displaced)(group.rods, group.point, bases, x.rotation, x.multipliers, of_ends)
        displacements |= {result.names[number]: moved[k] for k, number in enumerate(numbers)}
    largest = jnp.sqrt(jnp.max(jnp.stack([jnp.max(jnp.sum(moved**2, axis=1)) for moved in displacements.values()])))
    stiffness = stiffness * unit_of_stiffness(assembly)
    return HarnessMode(stiffness, {name: displacements[name] / largest for name in result.names})


def _displaced(
    rod: RodInBodies,
    point: Any,
    bases: Float[Array, "3 b m"],
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
        return there.nodes_of(there.holding(there.retract(point, bases, part * rotation, part * change, step)))

    zero = jnp.zeros((), motions.dtype)
    return rod.units.length * jax.jvp(nodes, (zero,), (jnp.ones_like(zero),))[1]
