"""Equilibria as points of their forms, from which the rest is computed of them."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax

from rodjax.discretization.form import Form
from rodjax.discretization.forms import form_of
from rodjax.model.scene import nondimensional, slides
from rodjax.programs.compilation import compiled
from rodjax.solving.sliding import sliding_at

if TYPE_CHECKING:
    from rodjax.solving.result import Equilibrium


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


def form_and_point(equilibrium: "Equilibrium") -> tuple[Form, Any]:
    scaled, _ = nondimensional(equilibrium.scene)
    state = equilibrium.state
    form, point = form_of(scaled, state.shape), state.point(equilibrium.total_twist)
    return form, form.begun(point, state.shape.nodes, state.pressures, state.friction)


def free_form_and_point(equilibrium: "Equilibrium") -> tuple[Form, Any]:
    """The same with the arclengths of sliding clips among the unknowns."""
    form, point = form_and_point(equilibrium)
    return sliding_at(form.scene, equilibrium.state.shape, point) if slides(equilibrium.scene) else (form, point)
