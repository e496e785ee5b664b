"""What a solve gives: the equilibrium of a scene, and how far it is to be believed."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import is_known, leaf, number_list
from rodjax.discretization.cells import ElementCells
from rodjax.discretization.dead_loads import energy_of_origin
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.form_results import positions_between_nodes, resultants_of
from rodjax.discretization.forms import form_of
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_results import strains_beside_nodes
from rodjax.discretization.hermite import QuadraticRotationElements
from rodjax.geometry.interpolation import cubic
from rodjax.geometry.vectors import dot, root
from rodjax.linalg.saddle_point import factor
from rodjax.model.scene import Scene, has_contacts, has_free_ends, has_node_positions, nondimensional, slid
from rodjax.programs.compilation import compiled
from rodjax.solving import applied_forces
from rodjax.solving.result_errors import estimated_errors, moment_error_of
from rodjax.solving.result_form import form_and_point, free_form_and_point, over_leading_axes
from rodjax.solving.result_summary import title_of, told_html, told_text, values_told
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.stability import examined
from rodjax.solving.status import Status, is_converged, with_strain

# Beyond this |axial strain| a cable or hose is damaged, and stiffnesses that are constant are no longer those it has.
DEFAULT_STRAIN_LIMIT = 0.05

# What makes pictures for notebooks, as HTML, of a rod or harness; drawing is none of this module's imports.
pictures: list[Callable[[Any], str]] = []


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
        return told_text(title_of(self), values_told(self))

    def _repr_html_(self) -> str:
        """The same as a table, and of a single one a picture, which notebooks show."""
        has_picture = self.s.ndim == 1 and is_known(self)
        return told_html(title_of(self), values_told(self), [drawn(self) for drawn in pictures] if has_picture else ())

    @property
    def clip_forces(self) -> Float[Array, "... clips 3"]:
        if not self.scene.clips:
            return jnp.zeros((*self.s.shape[:-1], 0, 3), self.s.dtype)
        if has_node_positions(self.scene):
            return applied_forces.node_forces(self)[0]
        if has_free_ends(self.scene):
            return applied_forces.clip_forces(self)
        seen = self.state.end_force * self.state.units.force[..., None, None]
        return jnp.swapaxes(seen[..., :-1] - seen[..., 1:], -1, -2)

    @property
    def contact_forces(self) -> Float[Array, "... n+1 3"]:
        if not has_contacts(self.scene) and self.scene.contact_loads is None:
            return jnp.zeros_like(self.nodes)
        return applied_forces.node_forces(self)[1]

    @property
    def obstacle_forces(self) -> Float[Array, "... obstacles n+1 3"]:
        return applied_forces.contacts(self).forces

    @property
    def friction_forces(self) -> Float[Array, "... obstacles n+1 3"]:
        return applied_forces.contacts(self).friction

    @property
    def contact_states(self) -> Int[Array, "... obstacles n+1"]:
        return applied_forces.contacts(self).states

    @property
    def gaps(self) -> Float[Array, "... obstacles n+1"]:
        return applied_forces.contacts(self).gaps

    @property
    def self_contacts(self) -> applied_forces.SelfContacts:
        return applied_forces.self_contacts(self)

    @property
    def clip_moments(self) -> Float[Array, "... clips 3"]:
        if not self.scene.clips:
            return jnp.zeros((*self.s.shape[:-1], 0, 3), self.s.dtype)
        if self.state.clip_moments is not None:
            return self.state.clip_moments * self.state.units.energy[..., None, None]
        return applied_forces.clip_moments(self)

    @property
    def error_estimate(self) -> Float[Array, "..."]:
        errors = estimated_errors(self).nodes
        return jnp.sqrt(jnp.max(jnp.sum(errors**2, axis=-1), axis=-1))

    @property
    def force_error(self) -> Float[Array, "..."]:
        return estimated_errors(self).force

    @property
    def moment_error(self) -> Float[Array, "..."]:
        return moment_error_of(estimated_errors(self))

    @property
    def curvature_error(self) -> Float[Array, "..."]:
        return estimated_errors(self).curvature

    @property
    def critical(self) -> Bool[Array, "..."]:
        return examination_of(self).critical

    @property
    def index(self) -> Int[Array, "..."]:
        return examination_of(self).index

    @property
    def neutral(self) -> Bool[Array, "..."]:
        return examination_of(self).neutral

    def position_at(self, s: Any) -> Float[Array, "... k 3"]:
        """Centerline at arclengths `s` (k,) [m] from 0 to L, [..., k, 3].

        Between the nodes of elements a polynomial of fifth degree, as accurate as the nodes: by position, tangent and
        curvature, or by the slopes of a rod with frames; between those of finite differences a cubic.

        Raises `ValueError` where an arclength lies beyond the rod.
        """
        s = leaf(number_list(s, "s")).astype(self.s.dtype)
        if is_known(s, self.s):
            numbers, length = np.asarray(s), float(np.min(np.asarray(self.s)[..., -1]))
            if np.any(numbers < 0) or np.any(numbers > length):
                raise ValueError(f"s must lie in 0 to {length:g} m, got {np.min(numbers):g} to {np.max(numbers):g} m")
        return positions_at(self, s)


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


class Examination(eqx.Module):
    critical: Bool[Array, "..."]
    index: Int[Array, "..."]
    neutral: Bool[Array, "..."]


@over_leading_axes
def examination_of(equilibrium: Equilibrium) -> Examination:
    nothing = Examination(jnp.array(False), jnp.full((), -1), jnp.array(False))
    if equilibrium.discretization == "continuum":
        return nothing
    form, point = free_form_and_point(equilibrium)
    here = form.linearized(point)
    _, critical, neutral = examined(form, point, here, equilibrium.residual)
    if not form.has_potential:
        return eqx.tree_at(lambda nothing: nothing.critical, nothing, critical)
    negative = factor(form.regular(here.system), is_regularized=True).negative
    return Examination(critical, negative, jnp.any(neutral.turn.rotation != 0))


@compiled
def slopes(equilibrium: Equilibrium) -> Float[Array, "... n+1 3"]:
    """phi' at the nodes."""
    frames, shear = equilibrium.frames, equilibrium.shear_strain
    along = 1 + equilibrium.axial_strain[..., None]
    if shear is None:
        return along * frames[..., 2]
    return jnp.sum(frames * jnp.concatenate([shear, along], axis=-1)[..., None, :], axis=-1)


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
