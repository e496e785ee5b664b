"""What clips, obstacles and the rod itself apply to the rod of an equilibrium."""

from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.discretization.contact_gaps import distances_and_normals
from rodjax.discretization.form_results import clip_moments_of
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.node_contacts import exerted_by_itself, exerted_by_obstacles, shares
from rodjax.discretization.potentials import at_both
from rodjax.solving.result_form import form_and_point, over_leading_axes

if TYPE_CHECKING:
    from rodjax.solving.result import Equilibrium


class SelfContacts(eqx.Module):
    """Where each of n elements of a rod is nearest to the rod beyond it, and what one part applies to the other there.

    - `s`, `beyond` [..., n] arclengths of both places, m
    - `gaps` [..., n] m between the surfaces there as contact counts them (`Scene`, `self_contact`), infinite where an
      element has nothing beyond it but neighbours
    - `forces` [..., n, 3] N: on the rod at `s`, and their reverse at `beyond`; zero where the parts do not touch
    """

    s: Float[Array, "... n"]
    beyond: Float[Array, "... n"]
    gaps: Float[Array, "... n"]
    forces: Float[Array, "... n 3"]


@over_leading_axes
def clip_forces(equilibrium: "Equilibrium") -> Float[Array, "clips 3"]:
    form, point = form_and_point(equilibrium)
    return form.clip_forces(point).T * equilibrium.state.units.force


@over_leading_axes
def node_forces(equilibrium: "Equilibrium") -> tuple[Float[Array, "clips 3"], Float[Array, "n+1 3"]]:
    """What clips and what obstacles apply to the rod, of a scene whose nodes have positions of their own."""
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    forces = form.applied(point)
    if form.scene.contact_loads is not None:
        forces += at_both(form.scene.contact_loads.on_positions)
    forces = forces.T * equilibrium.state.units.force
    clips = jnp.zeros(0, int) if form.field.clip_nodes is None else form.field.clip_nodes
    within = shares(form, point) * equilibrium.state.units.force
    return (forces - within)[clips], jnp.where(form.is_held[:, None], within, forces)


class Contacts(eqx.Module):
    """Of each obstacle with each node, as the properties of `Equilibrium`."""

    forces: Float[Array, "... k n+1 3"]
    friction: Float[Array, "... k n+1 3"]
    states: Int[Array, "... k n+1"]
    gaps: Float[Array, "... k n+1"]


def contacts(equilibrium: "Equilibrium") -> Contacts:
    if equilibrium.scene.obstacles:
        return _contacts_of(equilibrium)
    shape = *equilibrium.s.shape[:-1], 0, equilibrium.s.shape[-1]
    nothing = jnp.zeros(shape, equilibrium.s.dtype)
    none = jnp.zeros((*shape, 3), equilibrium.s.dtype)
    return Contacts(none, none, jnp.zeros(shape, int), nothing)


@over_leading_axes
def _contacts_of(equilibrium: "Equilibrium") -> Contacts:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    units = equilibrium.state.units
    distances, _ = distances_and_normals(form.scene, point.nodal.positions)
    pushes, drags, states = exerted_by_obstacles(form, point)
    gaps = (distances - form.radius[None]) * units.length
    return Contacts((pushes + drags) * units.force, drags * units.force, states, gaps)


def self_contacts(equilibrium: "Equilibrium") -> SelfContacts:
    if equilibrium.scene.self_contact:
        return _self_contacts_of(equilibrium)
    nothing = jnp.zeros((*equilibrium.s.shape[:-1], 0), equilibrium.s.dtype)
    return SelfContacts(nothing, nothing, nothing, jnp.zeros((*nothing.shape, 3), nothing.dtype))


@over_leading_axes
def _self_contacts_of(equilibrium: "Equilibrium") -> SelfContacts:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    units = equilibrium.state.units
    found = exerted_by_itself(form, point)
    return SelfContacts(
        found.s * units.length, found.beyond * units.length, found.gaps * units.length, found.forces.T * units.force
    )


@over_leading_axes
def clip_moments(equilibrium: "Equilibrium") -> Float[Array, "clips 3"]:
    form, point = form_and_point(equilibrium)
    return clip_moments_of(form, point) * equilibrium.state.units.energy
