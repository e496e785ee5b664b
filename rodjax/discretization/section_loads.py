"""Force and moment through the rod along its elements, as `form_results` has them at its ends."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import ElementCells
from rodjax.discretization.form import Form
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_results import through_cells
from rodjax.discretization.hermite import QuadraticRotationElements
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.results import element_end_moments


def is_known_along(form: Form) -> bool:
    """Whether `section_loads` takes a form: one on elements."""
    return isinstance(form.field, QuadraticRotationElements | ElementCells)


def section_loads(form: Form, point: Any) -> tuple[Float[Array, "3 2 n"], Float[Array, "3 2 n"]]:
    """Section forces and section moments at both ends of each element, on its side of the node, nondimensional."""
    if isinstance(form, FrameForm):
        through = through_cells(form, point)
        return through.forces[:, ::2], through.end_moments
    assert isinstance(form, MixedForm)
    fields = form.fields_on_elements(point)
    return form.with_fields(form.forces(point), fields)[:, ::2], element_end_moments(form, point, fields)


def loads_between(
    ends: tuple[Float[Array, "3 2 n"], Float[Array, "3 2 n"]],
    nodes: Float[Array, "n+1 3"],
    slopes: Float[Array, "n+1 3"],
    s: Float[Array, "n+1"],
    cell: Array,
    x: Float[Array, "k"],
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
    """Section force and section moment within elements, at the fraction `x` of each `cell`.

    `ends`: of `section_loads`; `slopes`: phi' at the nodes. The force is linear in an element. The moment is a cubic
    whose slopes are -phi' x F at both ends, and what the element lacks of its balance, such as couples, spread evenly.
    """
    forces, moments = (jnp.moveaxis(values, (1, 2), (0, 1))[:, cell] for values in ends)
    h = (s[cell + 1] - s[cell])[:, None]
    first, last = nodes[cell], nodes[cell + 1]
    rates = [-jnp.cross(slopes[cell + k], forces[k]) for k in range(2)]
    mean = -jnp.cross(last - first, (forces[0] + forces[1]) / 2) / h
    couple = (moments[1] - moments[0]) / h - mean
    a, b = h * (rates[0] + couple), h * (rates[1] + couple)
    x = x[:, None]
    y = 1 - x
    moment = (1 + 2 * x) * y**2 * moments[0] + x * y**2 * a + x**2 * (3 - 2 * x) * moments[1] - x**2 * y * b
    return y * forces[0] + x * forces[1], moment
