"""Rods and bodies of an assembly linearised at a state of a search, and what is out of balance there."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.form import Linearization
from rodjax.discretization.joints import generic_field
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.sliding import SETTLED, SlidingForm
from rodjax.discretization.sliding_point import SlidingLinearization
from rodjax.geometry.vectors import components
from rodjax.model.scene import scene_axes
from rodjax.programs.stacks import of_each
from rodjax.solving.assembly import Assembly, State
from rodjax.solving.coupling import Coupling, EndContacts, RodInBodies, end_contacts, linearized_with_ends
from rodjax.solving.newton import STAGNATION, Newton
from rodjax.solving.rod_contact import Contacts
from rodjax.solving.status import Status


class Here(NamedTuple):
    """Of a group of rods at a state."""

    rods: RodInBodies
    points: Any
    linearization: Linearization
    coupling: Coupling
    at_ends: EndContacts | None
    floor: Float[Array, "k"]
    aside: Float[Array, "k b m"]


class Balance(NamedTuple):
    """What is out of balance: of the bodies before their supports, `gradient`, and the largest of all; `balanced`: the
    status with which the search may end, else RUNNING; `is_settled`: near an equilibrium, sliding apart.
    """

    gradient: Float[Array, "j 6"]
    stiffness: Float[Array, "j 6 6"]
    residuals: tuple[Float[Array, "k"], ...]
    residual: Float[Array, ""]
    floor: Float[Array, ""]
    balanced: Int[Array, ""]
    is_balanced: Bool[Array, ""]
    is_settled: Bool[Array, ""]


def linearized_rod(
    rod: RodInBodies, point: Any, pressures: Float[Array, "o 2"] | None
) -> tuple[Any, Linearization, Coupling, EndContacts | None, Array, Array]:
    form = rod.form_at()
    point = form.holding(point)
    here, coupling = linearized_with_ends(rod, form, point)
    point, at_ends = form.accepted(point, here), None
    if pressures is not None:
        assert isinstance(form, NodalForm | SlidingForm)
        at_ends, coupling = end_contacts(rod, form, pressures, coupling)
        here = dataclasses.replace(here, residual=jnp.maximum(here.residual, at_ends.residual))
    aside = components(here.bases, generic_field(point.tangents, scene_axes(form.scene)))
    return point, here, coupling, at_ends, form.rounding_floor(point), aside


def changed_in_contact(all_here: list[Here], of_all: Any, of_contacts: Any, changed: Any) -> tuple[Any, ...]:
    """What all groups have, changed by what those with contacts have."""
    in_contact = iter(of_contacts)
    return tuple(
        one if here.at_ends is None else changed(one, next(in_contact))
        for here, one in zip(all_here, of_all, strict=True)
    )


def balance_at(
    assembly: Assembly, all_here: list[Here], touching: tuple[Contacts, ...], state: State, solver: Newton
) -> Balance:
    forces = tuple(here.coupling.first for here in all_here)
    gradient, stiffness = assembly.body_derivatives(state.poses)
    gradient, residual = assembly.balance_of_bodies(gradient, forces)
    is_settled = residual <= SETTLED
    floor, is_closed = jnp.zeros_like(residual), jnp.array(True)
    for group, here in zip(assembly.groups, all_here, strict=True):
        residual = jnp.maximum(residual, jnp.max(here.linearization.residual))
        is_settled &= jnp.all(_is_settled(here.linearization))
        floor = jnp.maximum(floor, jnp.max(here.floor))
        closed = of_each(lambda form, constraint_residual: form.is_closed(constraint_residual, solver.tolerance))
        is_closed &= jnp.all(closed(group.form, here.linearization.constraint_residual))
    for contacts in touching:
        residual = jnp.maximum(residual, contacts.residual)
    balanced = jnp.where(residual <= floor, Status.ROUNDING_FLOOR, Status.RUNNING)
    balanced = jnp.where(residual <= solver.tolerance, Status.CONVERGED, balanced)
    stagnates = (state.iterations > 0) & (residual > state.residual / 2) & (residual <= STAGNATION * floor)
    balanced = jnp.where(stagnates & (balanced == Status.RUNNING), Status.ROUNDING_FLOOR, balanced)
    is_balanced = is_closed & (balanced != Status.RUNNING)
    residuals = tuple(here.linearization.residual for here in all_here)
    return Balance(gradient, stiffness, residuals, residual, floor, balanced, is_balanced, is_settled)


def _is_settled(here: Linearization) -> Bool[Array, "k"]:
    return here.slides if isinstance(here, SlidingLinearization) else here.residual <= SETTLED


def sliding_once_settled(all_here: list[Here], state: State, balance: Balance) -> list[Here]:
    """Rods slide through clips once all of the harness is near its equilibrium at the arclengths where they are."""
    found = []
    for here, last in zip(all_here, state.points, strict=True):
        linearization = here.linearization
        if isinstance(linearization, SlidingLinearization):
            slides = last.slides | balance.is_settled
            here = here._replace(
                points=dataclasses.replace(here.points, slides=slides),
                linearization=dataclasses.replace(linearization, slides=slides),
            )
        found.append(here)
    return found
