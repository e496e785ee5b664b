"""How far equilibria on a mesh are from those of the continuum, as estimated."""

import functools
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import is_known
from rodjax.discretization.contact_error import with_contacts
from rodjax.discretization.error import Errors, Sizes, errors_of_differences, errors_of_elements, longest, on_elements
from rodjax.discretization.form import Form
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_error import errors_of_frames, framed_on_elements
from rodjax.discretization.hermite import Curve
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.motion import neutral_axis
from rodjax.discretization.nodal import NodalForm
from rodjax.programs.compilation import compiled
from rodjax.solving.result_form import form_and_point, over_leading_axes
from rodjax.solving.sliding import change_with_axial_forces

if TYPE_CHECKING:
    from rodjax.solving.result import Equilibrium


def estimated_errors(equilibrium: "Equilibrium") -> Errors:
    """How far the equilibrium is from the continuum; of the continuum itself not a number."""
    if is_known(equilibrium):
        errors = _errors(equilibrium, np.zeros((*equilibrium.status.shape, 3), equilibrium.s.dtype))
        # Few rods can turn as a whole: the program that looks for such a turn is theirs.
        if not np.asarray(errors.is_soft).any():
            return errors
    return _errors(equilibrium, _neutral_axis(equilibrium))


def moment_error_of(errors: Errors) -> Float[Array, "..."]:
    return errors.moment if errors.misplaced is None else errors.moment + errors.misplaced


# This and the next are parts of solves without `segments`.
@functools.partial(over_leading_axes, is_patient=False)
def _neutral_axis(equilibrium: "Equilibrium") -> Float[Array, "3"]:
    """About which the whole rod can turn and stays in equilibrium, on the elements that errors are estimated on."""
    if equilibrium.discretization == "continuum":
        return jnp.zeros(3, equilibrium.s.dtype)
    form, point = _on_elements(equilibrium)
    if not form.has_potential:
        return jnp.zeros(3, equilibrium.s.dtype)
    return neutral_axis(form, point, form.linearized(point))


def _on_elements(equilibrium: "Equilibrium") -> tuple[Form, Any]:
    form, point = form_and_point(equilibrium)
    if isinstance(form, FrameForm):
        return framed_on_elements(form, point)
    if isinstance(form, MixedForm) and not isinstance(equilibrium.state.shape, Curve):
        return on_elements(form, point, equilibrium.tangents.T)
    return form, point


@compiled
def _errors(equilibrium: "Equilibrium", axis: Float[Array, "... 3"]) -> Errors:
    """Without what turns the whole rod about an axis that is not zero."""
    mapped = _errors_of
    for _ in range(equilibrium.s.ndim - 1):
        mapped = jax.vmap(mapped)
    return mapped(equilibrium, axis)


def _errors_of(equilibrium: "Equilibrium", axis: Float[Array, "3"]) -> Errors:
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
