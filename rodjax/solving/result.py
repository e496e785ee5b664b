"""What a solve gives: the equilibrium of a scene, and how far it is to be believed."""

import dataclasses
import functools
import math
from abc import abstractmethod
from collections.abc import Callable
from html import escape
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import instance, is_known, leaf, number_list
from rodjax.discretization.cells import ElementCells
from rodjax.discretization.contact_error import depths_of_elements, with_contacts
from rodjax.discretization.contact_gaps import distances_and_normals
from rodjax.discretization.dead_loads import energy_of_origin
from rodjax.discretization.error import (
    Errors,
    Sizes,
    errors_of_differences,
    errors_of_elements,
    longest,
    on_elements,
)
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.form import Form, Point
from rodjax.discretization.form_results import clip_moments_of, positions_between_nodes, resultants_of
from rodjax.discretization.forms import form_of
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_error import errors_of_frames, framed_on_elements
from rodjax.discretization.framed_results import strains_beside_nodes
from rodjax.discretization.hermite import Curve, QuadraticRotationElements
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.motion import neutral_axis
from rodjax.discretization.moving_mesh import NEARLY_OUT
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.nodal_point import Friction, Nodal
from rodjax.discretization.node_contacts import SLIPS, STICKS, exerted_by_itself, exerted_by_obstacles, shares
from rodjax.discretization.potentials import at_both
from rodjax.discretization.shape import Shape
from rodjax.geometry.interpolation import cubic
from rodjax.geometry.vectors import dot, root
from rodjax.linalg.saddle_point import factor
from rodjax.mechanics.passage import Before, Passage, Sampled, passage
from rodjax.mechanics.taut import taut
from rodjax.model.obstacles import InUnits
from rodjax.model.rod import Rod
from rodjax.model.scene import (
    Scene,
    has_contacts,
    has_free_ends,
    has_node_positions,
    has_potential,
    nondimensional,
    slid,
    slides,
)
from rodjax.model.summaries import value_text
from rodjax.model.supports import Held
from rodjax.programs.compilation import compiled
from rodjax.solving.sliding import change_with_axial_forces, sliding_at
from rodjax.solving.stability import examined
from rodjax.solving.status import Outcome, Status, is_converged, with_strain
from rodjax.units import Units
from rodjax.warn import warn

# A rod deeper within an obstacle than this part of its radius is so by forces beyond all loads on it, as in a jam.
MOST_PENETRATION = 1e-4
# Beyond this |axial strain| a cable or hose is damaged, and stiffnesses that are constant are no longer those it has.
DEFAULT_STRAIN_LIMIT = 0.05
# Of several rods that came through obstacles, so many are named.
MOST_NAMED = 3
# A rod is called too short where it lacks this part of its length.
LEAST_LACKING = 1e-3


# An element, or an edge of finite differences, along which the rod turns by more than this [rad] is too coarse for any
# figure: in 64 random scenes the shape was then off by 0.2 to 40 % of the length on elements, by 2 to 8 % on edges.
MOST_TURN = {"hermite": 3.0, "finite_difference": math.pi / 2}


# What makes pictures for notebooks, as HTML, of those that are there; drawing is none of this module's imports.
pictures: "list[Callable[[Equilibrium], str]]" = []


class NotConvergedWarning(UserWarning):
    """A solve ended without an equilibrium; the message says why."""


class OverstretchedWarning(UserWarning):
    """An equilibrium is strained by more than `strain_limit`; the message says by how much, and where."""


class MeshWarning(UserWarning):
    """A mesh whose errors were not estimated: one that is far too coarse, or of the default size inside `jit`."""


class PrecisionWarning(UserWarning):
    """Numbers of single precision, and what they cost."""


class Described(eqx.Module):
    """A result that `describe` lets say in words what it is."""

    @abstractmethod
    def in_words(self) -> str: ...


class SolverState(eqx.Module):
    """What a warm start begins from: the nondimensional unknowns, to the last bit, with their units.

    `shape`: a `Polyline` by finite differences, a `Curve` by Hermite elements, a `FramedCurve` by either where frames
    are unknown; `end_force`: the forces of the layout (`discretization.layout`): the force at s = L as each span sees
    it, with the forces of the clips beyond, zero where that ends freely; with obstacles, or loads
    without a potential, as each segment sees it, with those of clips and contacts;
    `arclengths`: those at which the rod passes its sliding clips, as parts of its length, where there are some;
    `clip_moments`: in the continuum, where no mesh gives them; `before`: in scenes with obstacles, where the rod is, or
    was when it last was sound: a solve that begins here is judged by it;
    `pressures`: of each obstacle on each node; `friction`: where obstacles have some, with the memory from which this
    was found: what begins here has that of `as_memory`.
    """

    shape: Shape
    end_force: Float[Array, "... 3 parts"] | Float[Array, "... 3"]  # the second only in files, until format 8
    units: Units
    arclengths: Float[Array, "... slides"] | None = None
    clip_moments: Float[Array, "... clips 3"] | None = None
    before: Before | None = None
    pressures: Float[Array, "... k n+1"] | None = None
    friction: Friction | None = None

    def as_memory(self) -> "SolverState":
        """As what the next step of a path begins from: slips are counted from here."""
        if self.friction is None:
            return self
        nodes = self.units.origin[None] + self.units.length * self.shape.nodes
        return dataclasses.replace(self, friction=dataclasses.replace(self.friction, reference=nodes))

    def point(self, total_twist: Float[Array, ""]) -> Any:
        """The unknowns of the form of one equilibrium."""
        point = self.shape.point(self.end_force, total_twist)
        if self.pressures is None:
            return point
        relaxed = jnp.zeros_like(self.pressures[:, 0])
        return dataclasses.replace(point, nodal=Nodal(self.shape.nodes, self.pressures, relaxed, self.friction))


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


class Equilibrium(eqx.Module):
    """The equilibrium of a scene, or several of them along a leading axis `...` of every field.

    Forces and moments are what the part of the rod beyond s exerts on the part before it, global axes, moments about
    the centerline: at s = L what the support applies to the rod, at s = 0 the reverse of it.

    - `s` [..., n+1] arclength of the nodes, m
    - `nodes` [..., n+1, 3] centerline, m
    - `frames` [..., n+1, 3, 3] material frames, columns d1, d2, t; `tangents` [..., n+1, 3] phi'/|phi'|, their last
      column but in rods with shear, where that is the normal d3 of the section
    - `curvature` [..., n+1] |t x t'|, 1/m, with shear |d3 x d3'|
    - `twist` [..., n+1] Omega, rad/m; `total_twist` [...] its integral, rad, not reduced
    - `tension` [..., n+1] N; `axial_strain` [..., n+1] |phi'| - 1; with shear the components of force and phi' along d3
    - `shear_strain` [..., n+1, 2] of rods with shear, else `None`: the components of phi' along d1 and d2
    - `energy` [...] elastic energy minus the work of dead forces, J, zero of height at the origin; the work of loads
      without a potential depends on the way and is left out; `elastic_energy` [...] J
    - `start_force`, `start_moment`, `end_force`, `end_moment` [..., 3] N, N m
    - `clip_forces`, `clip_moments` [..., clips, 3] N, N m: what each clip applies to the rod, moments about its
      position, zero where it holds no direction, without a torque where it holds no twist; the moments are computed
      when they are asked for. Of rods whose frames are unknown curvature, twist, axial and shear strain are those just
      beyond a node where they jump, at a clip, a load or another section, and tension the mean of both sides
    - `contact_forces` [..., n+1, 3] N: what obstacles, other rods of a harness and the rod itself apply to the rod at
      each node, and its part of what they apply in each element beside it; `obstacle_forces` [..., obstacles,
      n+1, 3] N: what each of them does, friction included; `friction_forces` [..., obstacles, n+1, 3] N: the tangential
      part of that, at most `friction` times the rest; `contact_states` [..., obstacles, n+1] int: 0 where a node does
      not touch an obstacle, 1 where it sticks, 2 where it has slipped since the last equilibrium, or is without
      friction; `gaps` [..., obstacles, n+1] m: from the surface of the rod at each node to each obstacle, negative
      within it. Computed when asked for
    - `self_contacts`: of a scene with `self_contact` the `SelfContacts` of the rod. Computed when asked for
    - `converged` [...] bool; `status` [...] code, in words by `rodjax.describe`: `OVERSTRETCHED` for an equilibrium
      whose largest |axial_strain| is above the `strain_limit` of the solve
    - `stable` [...] bool: converged, and the energy has no negative curvature there; with loads that have no potential
      (dead moments, couples along the rod, follower loads) this is not examined and False, and
      `rodjax.squared_frequencies` tells
    - `iterations` [...] of the solver; `evaluations` [...] of the energy and its gradient; `substeps` [...] solves that
      a step of a path took: 1, or more where it was split
    - `residual` [...] largest component of the gradient, in EI/L^2
    - `error_estimate` [...] of the mesh: largest distance of a node from the continuum, relative to L; computed when it
      is asked for. With it `force_error`, `moment_error`, `curvature_error` [...]: estimated errors of the mesh in the
      forces and moments of the rod, its ends and clips, relative to the largest force (at least EI/L^2) and the largest
      moment (at least 0.1 EI/L) in the rod, and in the curvature at a node, relative to the largest at any (at least
      0.1/L). Between the nodes the rod may be bent more than at them; `rodjax.most_curved` tells where it may be bent
      most. `moment_error` counts that obstacles touch at a few places only
    - `critical` [...] bool: a motion has no stiffness left, as at a fold or where equilibria branch, so derivatives
      are not numbers. A turn of the whole rod that leaves it in equilibrium does not count. Computed when asked for
    - `index` [...] int: the number of motions along which the energy falls, 0 at a minimum; -1 where it is not
      examined, under loads without a potential and in the continuum. Computed when asked for
    - `free_index` [...] int: the same where the pose of an end was unknown, this being free; else `None`. `index`,
      `critical` and `neutral` are those of the rod between clamps at the poses that were found
    - `neutral` [...] bool: the whole rod can turn about an axis and stays in equilibrium, as between clamps on one
      line. Computed when asked for
    - `scene`: what was solved, its sliding clips `at` the arclengths where the rod passes them
    - `discretization`: `"finite_difference"`, `"hermite"` or `"continuum"`
    - `state`: what a solve that begins from here takes over
    """

    s: Float[Array, "... n+1"]
    nodes: Float[Array, "... n+1 3"]
    frames: Float[Array, "... n+1 3 3"]
    curvature: Float[Array, "... n+1"]
    twist: Float[Array, "... n+1"]
    total_twist: Float[Array, "..."]
    tension: Float[Array, "... n+1"]
    axial_strain: Float[Array, "... n+1"]
    energy: Float[Array, "..."]
    elastic_energy: Float[Array, "..."]
    start_force: Float[Array, "... 3"]
    start_moment: Float[Array, "... 3"]
    end_force: Float[Array, "... 3"]
    end_moment: Float[Array, "... 3"]
    converged: Bool[Array, "..."]
    stable: Bool[Array, "..."]
    status: Int[Array, "..."]
    iterations: Int[Array, "..."]
    evaluations: Int[Array, "..."]
    substeps: Int[Array, "..."]
    residual: Float[Array, "..."]
    scene: Scene
    state: SolverState
    discretization: str = eqx.field(static=True)
    shear_strain: Float[Array, "... n+1 2"] | None = None
    free_index: Int[Array, "..."] | None = None

    @property
    def tangents(self) -> Float[Array, "... n+1 3"]:
        if self.shear_strain is None:
            return self.frames[..., 2]
        along = slopes(self)
        return along / jnp.sqrt(jnp.sum(along**2, axis=-1, keepdims=True))

    def __str__(self) -> str:
        """How the solve ended, and the largest and last values along the rod with their units."""
        return "\n".join([f"Equilibrium of {_stack_told(self)}", *(f"  {name}: {told}" for name, told in _told(self))])

    def _repr_html_(self) -> str:
        """The same as a table, and of a single one a picture, which notebooks show."""
        rows = "".join(
            f"<tr><td style='text-align:left'>{escape(name)}</td><td style='text-align:left'>{escape(told)}</td></tr>"
            for name, told in _told(self)
        )
        table = f"<table><caption>Equilibrium of {escape(_stack_told(self))}</caption>{rows}</table>"
        return table if self.s.ndim > 1 or not is_known(self) else table + "".join(drawn(self) for drawn in pictures)

    @property
    def clip_forces(self) -> Float[Array, "... clips 3"]:
        if not self.scene.clips:
            return jnp.zeros((*self.s.shape[:-1], 0, 3), self.s.dtype)
        if has_node_positions(self.scene):
            return _node_forces(self)[0]
        if has_free_ends(self.scene):
            return _clip_forces(self)
        seen = self.state.end_force * self.state.units.force[..., None, None]
        return jnp.swapaxes(seen[..., :-1] - seen[..., 1:], -1, -2)

    @property
    def contact_forces(self) -> Float[Array, "... n+1 3"]:
        if not has_contacts(self.scene) and self.scene.contact_loads is None:
            return jnp.zeros_like(self.nodes)
        return _node_forces(self)[1]

    @property
    def obstacle_forces(self) -> Float[Array, "... obstacles n+1 3"]:
        return _contacts(self).forces

    @property
    def friction_forces(self) -> Float[Array, "... obstacles n+1 3"]:
        return _contacts(self).friction

    @property
    def contact_states(self) -> Int[Array, "... obstacles n+1"]:
        return _contacts(self).states

    @property
    def gaps(self) -> Float[Array, "... obstacles n+1"]:
        return _contacts(self).gaps

    @property
    def self_contacts(self) -> "SelfContacts":
        return _self_contacts(self)

    @property
    def clip_moments(self) -> Float[Array, "... clips 3"]:
        if not self.scene.clips:
            return jnp.zeros((*self.s.shape[:-1], 0, 3), self.s.dtype)
        if self.state.clip_moments is not None:
            return self.state.clip_moments * self.state.units.energy[..., None, None]
        return _clip_moments(self)

    @property
    def error_estimate(self) -> Float[Array, "..."]:
        errors = estimated_errors(self).nodes
        return jnp.sqrt(jnp.max(jnp.sum(errors**2, axis=-1), axis=-1))

    @property
    def force_error(self) -> Float[Array, "..."]:
        return estimated_errors(self).force

    @property
    def moment_error(self) -> Float[Array, "..."]:
        return _moment_error(estimated_errors(self))

    @property
    def curvature_error(self) -> Float[Array, "..."]:
        return estimated_errors(self).curvature

    @property
    def critical(self) -> Bool[Array, "..."]:
        return _examination(self).critical

    @property
    def index(self) -> Int[Array, "..."]:
        return _examination(self).index

    @property
    def neutral(self) -> Bool[Array, "..."]:
        return _examination(self).neutral

    def position_at(self, s: Any) -> Float[Array, "... k 3"]:
        """Centerline at arclengths `s` (k,) [m] from 0 to L, [..., k, 3].

        Between the nodes of elements a polynomial of fifth degree by position, tangent and curvature, as accurate as
        the nodes; between those of finite differences a cubic.

        Raises `ValueError` where an arclength lies beyond the rod.
        """
        s = leaf(number_list(s, "s")).astype(self.s.dtype)
        if is_known(s, self.s):
            numbers, length = np.asarray(s), float(np.min(np.asarray(self.s)[..., -1]))
            if np.any(numbers < 0) or np.any(numbers > length):
                raise ValueError(f"s must lie in 0 to {length:g} m, got {np.min(numbers):g} to {np.max(numbers):g} m")
        return positions_at(self, s)


class Found(eqx.Module):
    """Where a solver stopped, nondimensional."""

    state: SolverState
    point: Any
    outcome: Outcome
    is_stable: Bool[Array, ""]


def build_result(
    scene: Scene, found: Found, substeps: Int[Array, ""], strain_limit: Float[Array, ""] | float = DEFAULT_STRAIN_LIMIT
) -> Equilibrium:
    """What a solver found, in SI units; infinite where no strain is too large."""
    if found.state.arclengths is not None:
        scene = slid(scene, found.state.arclengths * scene.rod.length)
    scaled, units = nondimensional(scene)
    point, outcome = found.point, found.outcome
    nodes = found.state.shape.nodes
    form = form_of(scaled, found.state.shape)
    results = resultants_of(form, point)
    elastic_energy = form.elastic_energy(point)
    potential = elastic_energy + form.load_energy(point)
    converged = is_converged(outcome.status)
    axial_strain = results.axial_strain
    is_collapsed = ~converged & (jnp.min(axial_strain) <= -1)
    status = jnp.where(is_collapsed, Status.COLLAPSED, with_strain(outcome.status, axial_strain, strain_limit))
    return Equilibrium(
        s=form.field.s * scene.rod.length,
        nodes=units.origin[None] + units.length * nodes,
        frames=results.frames,
        curvature=results.curvature / units.length,
        twist=results.twist / units.length,
        total_twist=point.total_twist,
        tension=results.tension * units.force,
        axial_strain=axial_strain,
        energy=units.energy * potential + energy_of_origin(scaled, units),
        elastic_energy=units.energy * elastic_energy,
        start_force=results.start_force * units.force,
        start_moment=results.start_moment * units.energy,
        end_force=results.end_force * units.force,
        end_moment=results.end_moment * units.energy,
        converged=converged,
        stable=converged & found.is_stable,
        status=status,
        iterations=outcome.iterations,
        evaluations=outcome.evaluations,
        substeps=substeps,
        residual=outcome.residual,
        scene=scene,
        state=dataclasses.replace(found.state, units=units),
        discretization="hermite"
        if isinstance(form.field, QuadraticRotationElements | ElementCells)
        else "finite_difference",
        shear_strain=results.shear_strain,
    )


def over_leading_axes(function: Callable, *, is_patient: bool = True) -> Callable:
    """The function of one equilibrium as one of any number of them, `compiled`: patiently, as most results are asked
    for a few of their numbers only.
    """

    @functools.wraps(function)
    def mapped(equilibrium: Any, *shared: Any):
        mapped = function
        for _ in range(equilibrium.status.ndim):
            mapped = jax.vmap(mapped, in_axes=(0, *[None] * len(shared)))
        return mapped(equilibrium, *shared)

    return compiled(mapped, is_patient=is_patient)


def estimated_errors(equilibrium: Equilibrium) -> Errors:
    """How far the equilibrium is from the continuum; of the continuum itself not a number."""
    if is_known(equilibrium):
        errors = _errors(equilibrium, np.zeros((*equilibrium.status.shape, 3), equilibrium.s.dtype))
        # Few rods can turn as a whole: the program that looks for such a turn is theirs.
        if not np.asarray(errors.is_soft).any():
            return errors
    return _errors(equilibrium, _neutral_axis(equilibrium))


def _moment_error(errors: Errors) -> Float[Array, "..."]:
    return errors.moment if errors.misplaced is None else errors.moment + errors.misplaced


# This and the next are parts of solves without `segments`.
@functools.partial(over_leading_axes, is_patient=False)
def _neutral_axis(equilibrium: Equilibrium) -> Float[Array, "3"]:
    """About which the whole rod can turn and stays in equilibrium, on the elements that errors are estimated on."""
    if equilibrium.discretization == "continuum":
        return jnp.zeros(3, equilibrium.s.dtype)
    form, point = _on_elements(equilibrium)
    if not form.has_potential:
        return jnp.zeros(3, equilibrium.s.dtype)
    return neutral_axis(form, point, form.linearized(point))


def _on_elements(equilibrium: Equilibrium) -> tuple[Form, Any]:
    form, point = form_and_point(equilibrium)
    if isinstance(form, FrameForm):
        return framed_on_elements(form, point)
    if isinstance(form, MixedForm) and not isinstance(equilibrium.state.shape, Curve):
        return on_elements(form, point, equilibrium.tangents.T)
    return form, point


@compiled
def _errors(equilibrium: Equilibrium, axis: Float[Array, "... 3"]) -> Errors:
    """Without what turns the whole rod about an axis that is not zero."""
    mapped = _errors_of
    for _ in range(equilibrium.s.ndim - 1):
        mapped = jax.vmap(mapped)
    return mapped(equilibrium, axis)


def _errors_of(equilibrium: Equilibrium, axis: Float[Array, "3"]) -> Errors:
    state = equilibrium.state
    if equilibrium.discretization == "continuum":
        unknown = Sizes(*[jnp.full((), jnp.nan, equilibrium.nodes.dtype)] * 3)
        return Errors(jnp.full_like(equilibrium.nodes, jnp.nan), *unknown, unknown, jnp.array(False), None)
    form, point = form_and_point(equilibrium)
    if isinstance(form, FrameForm):
        errors = errors_of_frames(form, point, axis)
    elif isinstance(state.shape, Curve):
        assert isinstance(form, MixedForm)
        errors = errors_of_elements(form, point, axis)
    else:
        assert isinstance(form, MixedForm)
        errors = errors_of_differences(form, point, state.shape.nodes, equilibrium.tangents.T, axis)
    if isinstance(form, NodalForm) and form.scene.obstacles:
        errors = with_contacts(errors, form, point)
    if errors.axial is None:
        return errors
    # The rod slides until the axial forces of the continuum vanish, and all of it moves with that.
    nodes, forces, moments, curvature = change_with_axial_forces(form.scene, state.shape, point, -errors.axial)
    more = Sizes(longest(forces), longest(moments), jnp.max(jnp.abs(curvature))).relative_to(errors.scale)
    return errors._replace(
        nodes=errors.nodes + nodes,
        force=errors.force + more.force,
        moment=errors.moment + more.moment,
        curvature=errors.curvature + more.curvature,
    )


class _Examination(eqx.Module):
    critical: Bool[Array, "..."]
    index: Int[Array, "..."]
    neutral: Bool[Array, "..."]


@over_leading_axes
def _examination(equilibrium: Equilibrium) -> _Examination:
    nothing = _Examination(jnp.array(False), jnp.full((), -1), jnp.array(False))
    if equilibrium.discretization == "continuum":
        return nothing
    form, point = free_form_and_point(equilibrium)
    here = form.linearized(point)
    _, critical, neutral = examined(form, point, here, equilibrium.residual)
    if not form.has_potential:
        return eqx.tree_at(lambda nothing: nothing.critical, nothing, critical)
    negative = factor(form.regular(here.system), is_regularized=True).negative
    return _Examination(critical, negative, jnp.any(neutral.turn.rotation != 0))


def _penetration(equilibrium: Equilibrium) -> Float[np.ndarray, "..."]:
    """How deep the rod lies within obstacles, at nodes and between them, as a part of the radius."""
    if not equilibrium.scene.obstacles:
        return np.zeros(equilibrium.s.shape[:-1])
    return np.asarray(_deepest(equilibrium))


@over_leading_axes
def _deepest(equilibrium: Equilibrium) -> Float[Array, ""]:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    return jnp.max(depths_of_elements(form, point))


@over_leading_axes
def _clip_forces(equilibrium: Equilibrium) -> Float[Array, "clips 3"]:
    form, point = form_and_point(equilibrium)
    return form.clip_forces(point).T * equilibrium.state.units.force


@over_leading_axes
def _node_forces(equilibrium: Equilibrium) -> tuple[Float[Array, "clips 3"], Float[Array, "n+1 3"]]:
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


class _Contacts(eqx.Module):
    """Of each obstacle with each node, as the properties of `Equilibrium`."""

    forces: Float[Array, "... k n+1 3"]
    friction: Float[Array, "... k n+1 3"]
    states: Int[Array, "... k n+1"]
    gaps: Float[Array, "... k n+1"]


def _contacts(equilibrium: Equilibrium) -> _Contacts:
    if equilibrium.scene.obstacles:
        return _contacts_of(equilibrium)
    shape = *equilibrium.s.shape[:-1], 0, equilibrium.s.shape[-1]
    nothing = jnp.zeros(shape, equilibrium.s.dtype)
    none = jnp.zeros((*shape, 3), equilibrium.s.dtype)
    return _Contacts(none, none, jnp.zeros(shape, int), nothing)


@over_leading_axes
def _contacts_of(equilibrium: Equilibrium) -> _Contacts:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    units = equilibrium.state.units
    distances, _ = distances_and_normals(form.scene, point.nodal.positions)
    pushes, drags, states = exerted_by_obstacles(form, point)
    gaps = (distances - form.radius[None]) * units.length
    return _Contacts((pushes + drags) * units.force, drags * units.force, states, gaps)


def _self_contacts(equilibrium: Equilibrium) -> SelfContacts:
    if equilibrium.scene.self_contact:
        return _self_contacts_of(equilibrium)
    nothing = jnp.zeros((*equilibrium.s.shape[:-1], 0), equilibrium.s.dtype)
    return SelfContacts(nothing, nothing, nothing, jnp.zeros((*nothing.shape, 3), nothing.dtype))


@over_leading_axes
def _self_contacts_of(equilibrium: Equilibrium) -> SelfContacts:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    units = equilibrium.state.units
    found = exerted_by_itself(form, point)
    return SelfContacts(
        found.s * units.length, found.beyond * units.length, found.gaps * units.length, found.forces.T * units.force
    )


@compiled
def slopes(equilibrium: Equilibrium) -> Float[Array, "... n+1 3"]:
    """phi' at the nodes."""
    frames, shear = equilibrium.frames, equilibrium.shear_strain
    along = 1 + equilibrium.axial_strain[..., None]
    if shear is None:
        return along * frames[..., 2]
    return jnp.sum(frames * jnp.concatenate([shear, along], axis=-1)[..., None, :], axis=-1)


@over_leading_axes
def _clip_moments(equilibrium: Equilibrium) -> Float[Array, "clips 3"]:
    form, point = form_and_point(equilibrium)
    return clip_moments_of(form, point) * equilibrium.state.units.energy


class Sides(eqx.Module):
    """Arclengths [m] of both ends of each element in turn; curvature [1/m], twist [rad/m] and axial strain there."""

    s: Float[Array, "... 2n"]
    curvature: Float[Array, "... 2n"]
    twist: Float[Array, "... 2n"]
    axial_strain: Float[Array, "... 2n"]


@over_leading_axes
def beside_nodes(equilibrium: Equilibrium) -> Sides:
    """Of an equilibrium on elements whose frames are unknown, on both sides of its nodes: at clips they jump."""
    form, point = form_and_point(equilibrium)
    assert isinstance(form, FrameForm)
    s, strains, axial = strains_beside_nodes(form, point)
    length = equilibrium.state.units.length
    curvature = root(dot(strains[:2], strains[:2]))
    return Sides(s * length, curvature / length, strains[2] / length, axial)


@over_leading_axes
def positions_at(equilibrium: Equilibrium, s: Float[Array, "k"]) -> Float[Array, "k 3"]:
    shape, units = equilibrium.state.shape, equilibrium.state.units
    form, point = form_and_point(equilibrium)
    if isinstance(shape, Polyline):
        slopes = (1 + equilibrium.axial_strain)[:, None] * equilibrium.tangents
        return cubic(equilibrium.s, equilibrium.nodes, slopes, s)
    positions = positions_between_nodes(form, point, shape.nodes, s / units.length)
    return units.origin[None] + units.length * positions


def form_and_point(equilibrium: Equilibrium) -> tuple[Form, Any]:
    scaled, _ = nondimensional(equilibrium.scene)
    state = equilibrium.state
    form, point = form_of(scaled, state.shape), state.point(equilibrium.total_twist)
    return form, form.begun(point, state.shape.nodes, state.pressures, state.friction)


def free_form_and_point(equilibrium: Equilibrium) -> tuple[Form, Any]:
    """The same with the arclengths of sliding clips among the unknowns."""
    form, point = form_and_point(equilibrium)
    return sliding_at(form.scene, equilibrium.state.shape, point) if slides(equilibrium.scene) else (form, point)


def describe(equilibrium: Equilibrium | Described) -> str:
    """How a solve ended, in words, what is special about the equilibrium, and the estimated errors of its mesh.

    Of several: each with its count, and the largest errors of those that converged. Of a harness: of the whole, then
    of each rod.
    """
    if isinstance(equilibrium, Described):
        return equilibrium.in_words()
    instance(equilibrium, "equilibrium", Equilibrium)
    examination = jax.tree.map(np.asarray, _examination(equilibrium))  # JAX would compile each comparison
    converged, axial_strain = np.asarray(equilibrium.converged), np.asarray(equilibrium.axial_strain)
    potential = np.full(converged.shape, has_potential(equilibrium.scene))
    remarks = {
        "a saddle: there are motions that lower the energy": _index(equilibrium, examination) > 0,
        "neutral: the whole rod can turn about an axis and stays in equilibrium": examination.neutral,
        "critical (a motion has no stiffness left), so that derivatives are not numbers": examination.critical,
        "under loads without a potential, so that no energy tells whether it is stable": ~np.asarray(potential),
        "pressed to nothing somewhere (axial strain below -1): EA is too small": np.any(axial_strain <= -1, axis=-1),
        f"pressed into an obstacle by more than {MOST_PENETRATION:g} of the radius": _penetration(equilibrium)
        > MOST_PENETRATION,
    }
    counts = {remark: int(np.sum(np.asarray(holds) & converged)) for remark, holds in remarks.items()}
    strain = [_largest_strain(equilibrium)] if np.any(_is_overstretched(equilibrium)) else []
    told = _errors_told(equilibrium)
    if converged.ndim == 0:
        special = [remark for remark, count in counts.items() if count]
        return "; ".join([_outcome(equilibrium), *strain, *special, *_contacts_told(equilibrium), *told])
    special = [f"{count} {remark}" for remark, count in counts.items() if count]
    return "\n".join([_outcome(equilibrium), *strain, *special, *told])


def _stack_told(equilibrium: Equilibrium) -> str:
    shape, segments = equilibrium.s.shape[:-1], equilibrium.s.shape[-1] - 1
    scenes = f"{' x '.join(map(str, shape))} scenes, " if shape else ""
    return f"{scenes}{segments} segments"


def _told(equilibrium: Equilibrium) -> list[tuple[str, str]]:
    """What `print` shows: of several rods the range of each value. Nothing that takes a program to be computed."""
    if not is_known(equilibrium):
        return [("values", "not known inside jax.jit, vmap or grad")]
    codes, counts = np.unique(np.asarray(equilibrium.status), return_counts=True)
    many = equilibrium.status.ndim > 0
    outcome = "; ".join(
        f"{count} {Status(code).message}" if many else Status(code).message
        for code, count in zip(codes, counts, strict=True)
    )

    def between(values: Any, unit: str) -> str:
        values = np.asarray(values)
        low, high = float(np.min(values)), float(np.max(values))
        return f"{low + 0.0:.4g} {unit}" if low == high else f"{low + 0.0:.4g} to {high + 0.0:.4g} {unit}"

    def vectors(values: Any, unit: str) -> str:
        if many:
            return f"{between(np.linalg.norm(values, axis=-1), unit)} in magnitude"
        return value_text(np.asarray(values), unit)

    told = [("status", outcome), ("residual", between(equilibrium.residual, "EI/L^2"))]
    told.append(("iterations", between(equilibrium.iterations, "").strip()))
    told += [("length", between(equilibrium.scene.rod.length, "m")), ("energy", between(equilibrium.energy, "J"))]
    told += [
        (name.replace("_", " "), between(getattr(equilibrium, name), unit))
        for name, unit in (
            ("elastic_energy", "J"),
            ("total_twist", "rad"),
            ("curvature", "1/m"),
            ("tension", "N"),
            ("axial_strain", ""),
        )
    ]
    told += [
        (f"{end} {kind}", vectors(getattr(equilibrium, f"{end}_{kind}"), unit))
        for end in ("start", "end")
        for kind, unit in (("force", "N"), ("moment", "N m"))
    ]
    return [(name, line.strip()) for name, line in told]


def _index(equilibrium: Equilibrium, examination: _Examination) -> Int[np.ndarray, "..."]:
    return np.asarray(examination.index if equilibrium.free_index is None else equilibrium.free_index)


def _is_overstretched(equilibrium: Equilibrium) -> Bool[np.ndarray, "..."]:
    return np.asarray(equilibrium.status) == Status.OVERSTRETCHED


def _largest_strain(equilibrium: Equilibrium) -> str:
    """The largest |axial strain| among the overstretched rods, and where it is."""
    strain = np.asarray(equilibrium.axial_strain)
    size = np.where(_is_overstretched(equilibrium)[..., None], np.abs(strain), 0.0)
    *case, node = np.unravel_index(np.argmax(size), size.shape)
    place = f"{100 * strain[(*case, node)]:+.3g} % at s = {float(np.asarray(equilibrium.s)[(*case, node)]):.4g} m"
    numbers = ", ".join(str(int(k)) for k in case)
    return f"largest axial strain {place}" + (f" of case {numbers}" if case else "")


def _contacts_told(equilibrium: Equilibrium) -> list[str]:
    """Of one equilibrium, which obstacles push on the rod, and where it pushes on itself, how much and where."""
    told = []
    if not bool(equilibrium.converged):
        return told
    if equilibrium.scene.self_contact:
        told += _self_contacts_told(equilibrium)
    if not equilibrium.scene.obstacles:
        return told
    s, contacts = np.asarray(equilibrium.s), jax.tree.map(np.asarray, _contacts(equilibrium))
    for k, forces in enumerate(contacts.forces - contacts.friction):
        touched = s[np.linalg.norm(forces, axis=-1) > 0]
        if touched.size:
            first, last = float(touched[0]), float(touched[-1])
            where = f"at s = {first:.4g} m" if first == last else f"between s = {first:.4g} and {last:.4g} m"
            kind = type(equilibrium.scene.obstacles[k]).__name__
            pushes = f"obstacles[{k}] ({kind}) pushes with {np.linalg.norm(forces.sum(0)):.4g} N {where}"
            told.append(pushes + _friction_told(equilibrium, contacts, k))
    return told


def _self_contacts_told(equilibrium: Equilibrium) -> list[str]:
    found = jax.tree.map(np.asarray, equilibrium.self_contacts)
    forces = np.linalg.norm(found.forces, axis=-1)
    in_contact = np.flatnonzero(forces > 0)
    if not in_contact.size:
        return ["does not touch itself"]
    s, beyond = found.s[in_contact], found.beyond[in_contact]
    most = in_contact[np.argmax(forces[in_contact])]
    where = f"s = {s.min():.4g} to {s.max():.4g} m and s = {beyond.min():.4g} to {beyond.max():.4g} m"
    if in_contact.size == 1:
        where = f"s = {s[0]:.4g} m and s = {beyond[0]:.4g} m"
    places = "place" if in_contact.size == 1 else "places"
    return [f"touches itself at {in_contact.size} {places}, {where}, the largest force {forces[most]:.4g} N"]


def _friction_told(equilibrium: Equilibrium, contacts: _Contacts, k: int) -> str:
    if equilibrium.scene.obstacles[k].friction is None:
        return ""
    friction = equilibrium.state.friction
    if friction is None or np.any(np.isnan(friction.reference)):
        return ", without friction as from rest"
    drag = np.linalg.norm(contacts.friction[k].sum(0))
    sticks, slips = (int(np.sum(contacts.states[k] == state)) for state in (STICKS, SLIPS))
    return f", drags with {drag:.4g} N, sticks at {sticks} nodes and slips at {slips}"


def _errors_told(equilibrium: Equilibrium) -> list[str]:
    """The estimated errors, of several the largest; nothing where there are none."""
    converged = np.asarray(equilibrium.converged)
    if equilibrium.discretization == "continuum" or not np.any(converged):
        return []
    errors = estimated_errors(equilibrium)
    sizes = (
        np.max(np.linalg.norm(errors.nodes, axis=-1), axis=-1),
        errors.force,
        _moment_error(errors),
        errors.curvature,
    )
    shape, *others = (float(np.max(np.asarray(size)[converged])) for size in sizes)
    force, moment, curvature = (f"{100 * error:.2g} %" for error in others)
    return [
        f"estimated errors on {equilibrium.s.shape[-1] - 1} segments: shape {shape:.1e} of the length, forces {force}, "
        f"moments {moment}, curvature {curvature} of the largest"
    ]


def _outcome(equilibrium: Equilibrium) -> str:
    codes, counts = np.unique(np.asarray(equilibrium.status), return_counts=True)
    messages = {code: Status(code).message for code in codes}
    if Status.PASSED_THROUGH in messages:
        messages[Status.PASSED_THROUGH] += _passages(equilibrium)
    if Status.SLID_OUT in messages and equilibrium.status.ndim == 0:
        messages[Status.SLID_OUT] += _last_clips(equilibrium.scene)
    if equilibrium.status.ndim == 0:
        return (
            f"{messages[codes[0]]}; residual {float(equilibrium.residual):.1e} EI/L^2 "
            f"after {int(equilibrium.iterations)} iterations{_stuck_within(equilibrium)}{_too_short(equilibrium)}"
        )
    return "\n".join(f"{count} {messages[code]}" for code, count in zip(codes, counts, strict=True))


def _last_clips(scene: Scene) -> str:
    """Which clips hold nothing any more, or have come to the next one."""
    length = float(scene.rod.length)
    places = np.array([0.0, *(float(clip.at) for clip in scene.clips), length])
    near = np.diff(places) < NEARLY_OUT * length
    which = [k for k, clip in enumerate(scene.clips) if clip.sliding and (near[k] or near[k + 1])]
    return "".join(f", clips[{k}], which has come to {places[k + 1]:.4g} of {length:.4g} m" for k in which)


def _stuck_within(equilibrium: Equilibrium) -> str:
    """In which obstacle a rod lies that found no equilibrium, and where."""
    if bool(equilibrium.converged) or equilibrium.status == Status.PASSED_THROUGH or not equilibrium.scene.obstacles:
        return ""
    found = _passage_of(equilibrium)
    if not found.is_within:
        return ""
    return f"; the rod lies {_place_of(found, equilibrium)}"


def _too_short(equilibrium: Equilibrium) -> str:
    """By how much a rod that found no equilibrium, or a far too strained one, is shorter than a string that is pulled
    taut around the obstacles on the side where the rod last was sound.
    """
    scene, before = equilibrium.scene, equilibrium.state.before
    start, end = scene.start, scene.end
    if before is None or not isinstance(start, Held) or not isinstance(end, Held) or scene.clips:
        return ""
    if bool(equilibrium.converged) and not bool(_is_overstretched(equilibrium)):
        return ""
    radius, length = float(np.min(_radii(scene.rod))), float(scene.rod.length)
    ends = np.asarray(start.position), np.asarray(end.position)
    points = np.asarray(before.points).copy()
    points[0], points[-1] = ends
    distances = np.min([np.asarray(obstacle.distance(points[1:-1])) for obstacle in scene.obstacles], axis=0)
    if not np.all(distances > 0):  # it began on no side
        return ""
    needed, touched = taut(leaf(points), scene.obstacles, leaf(np.asarray(radius)))
    lacking = float(needed) - length
    if lacking < LEAST_LACKING * length:
        return ""
    names = [f"obstacles[{k}] ({type(scene.obstacles[k]).__name__})" for k in np.flatnonzero(np.asarray(touched))]
    where = f" to pass {' and '.join(names)} on the side where it was" if names else " to reach from end to end"
    return f"; the rod is at least {lacking:.2g} m too short{where}"


def _radii(rod: Rod) -> Float[np.ndarray, "k"]:
    """All numbers of the radius along a rod: those between which it varies are not smaller."""
    assert rod.radius is not None
    return np.atleast_1d(np.asarray(getattr(rod.radius, "values", rod.radius)))


def _passages(equilibrium: Equilibrium) -> str:
    """Which obstacles those that came through one did, and where."""
    found = _passage_of(equilibrium)
    passed = np.argwhere((np.asarray(equilibrium.status) == Status.PASSED_THROUGH) & ~np.asarray(found.is_sound))
    named = []
    for index in map(tuple, passed[:MOST_NAMED]):
        which = f"{list(map(int, index))}: " if index else ""
        named.append(which + _place_of(found, equilibrium, index))
    more = [f"and {len(passed) - MOST_NAMED} more"] if len(passed) > MOST_NAMED else []
    return "".join(f" ({part})" for part in [", ".join([*named, *more])] if part)


def _place_of(found: Passage, equilibrium: Equilibrium, index: tuple[int, ...] = ()) -> str:
    k, s = int(found.obstacle[index]), float(found.place[index] * equilibrium.scene.rod.length[index])
    how = "within" if found.is_within[index] else "through"
    return f"{how} obstacles[{k}] ({type(equilibrium.scene.obstacles[k]).__name__}) at s = {s:.4g} m"


@over_leading_axes
def _passage_of(equilibrium: Equilibrium) -> Passage:
    form, point = form_and_point(equilibrium)
    assert isinstance(form, NodalForm)
    state = equilibrium.state
    if state.before is None:  # of a file of an earlier version
        return Passage(
            jnp.full((), -1), jnp.full_like(equilibrium.residual, jnp.nan), jnp.array(False), jnp.array(False)
        )
    found = passage(state.before, sampled(form, point, state.shape.nodes, state.units))
    return found


def sampled(form: NodalForm, point: Point, nodes: Float[Array, "n+1 3"], units: Units) -> Sampled:
    """Where a rod is, at a point of a form with these nodes."""
    points, radius, held = form.samples(nodes, point)
    points, held = (units.origin[None] + units.length * place for place in (points, held))
    obstacles = tuple(obstacle.obstacle for obstacle in form.scene.obstacles if isinstance(obstacle, InUnits))
    return Sampled(points, units.length * radius, held, obstacles)


def warn_if_coarse(equilibrium: Equilibrium) -> None:
    """Where the numbers alone show that a given mesh is far too coarse: no program is needed for that."""
    curvature, s = np.asarray(equilibrium.curvature), np.asarray(equilibrium.s)
    turn = np.maximum(curvature[..., 1:], curvature[..., :-1]) * (s[..., 1:] - s[..., :-1])
    by_tangent = equilibrium.discretization == "finite_difference"  # their curvature is 2 tan(turn/2)/h
    limit = MOST_TURN[equilibrium.discretization]
    is_coarse = (turn > (2 * math.tan(limit / 2) if by_tangent else limit)).any(-1)
    if not is_coarse.any():
        return
    is_coarse &= np.asarray(equilibrium.converged)
    if is_coarse.any():
        many = f" in {np.sum(is_coarse)} of {is_coarse.size} scenes" if is_coarse.ndim else ""
        most = np.max(turn[is_coarse])
        most = 2 * np.arctan(most / 2) if by_tangent else most
        most = f"{most:.1f} rad" if most < 2 * math.pi else "more than a whole turn"  # no figure on such a mesh
        warn(
            f"the mesh of {s.shape[-1] - 1} segments is too coarse{many}: the rod turns by {most} along one of them; "
            "more segments, or rtol in the place of segments, may help; rodjax.describe tells the errors",
            MeshWarning,
        )


@functools.cache
def warn_of_unknown_mesh(segments: int) -> None:
    """Once in a process: where numbers are not known, no error can be looked at and no mesh chosen."""
    warn(
        f"the mesh is one of {segments} segments, whatever its errors, as numbers are not known inside jax.jit, vmap "
        "or grad: values and derivatives differ by those errors from what the same solve gives outside, on a mesh "
        "chosen for rtol; segments= states a mesh (this is said once)",
        MeshWarning,
    )


@functools.cache
def warn_of_single_precision() -> None:
    """Once in a process; the errors are those of `experiments/float32.py`."""
    warn(
        "the numbers are float32, JAX's default: beside double precision the shape is off by 3e-8 to 2e-4 of the "
        "length and the forces by 4e-6 to 5e-4, more on finer meshes; obstacles need float64. For more call "
        'jax.config.update("jax_enable_x64", True) before anything else (this is said once)',
        PrecisionWarning,
    )


def warn_of_outcome(equilibrium: Equilibrium, strain_limit: Float[Array, ""] | float = DEFAULT_STRAIN_LIMIT) -> None:
    """Where statuses are known, of those that are not converged and of those above a strain."""
    if not is_known(equilibrium.status):
        return
    status = np.asarray(equilibrium.status)
    if not status.any():  # all CONVERGED
        return
    if not np.all(np.asarray(equilibrium.converged)):
        warn(_outcome(equilibrium), NotConvergedWarning)
    is_overstretched = status == Status.OVERSTRETCHED
    # In the continuum strains may be traced where the status is not.
    if not is_overstretched.any() or not is_known(equilibrium.axial_strain, strain_limit):
        return
    count = int(np.sum(is_overstretched))
    rods = "the rod is" if not status.ndim else "1 rod is" if count == 1 else f"{count} rods are"
    warn(
        f"{rods} strained by more than strain_limit = {100 * float(strain_limit):g} %: {_largest_strain(equilibrium)}"
        f"{'' if status.ndim else _too_short(equilibrium)}",
        OverstretchedWarning,
    )
