"""The softest motion of an equilibrium."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.checks import instance
from rodjax.discretization.mixed import Linearization, MixedForm, MixedPoint
from rodjax.result import Equilibrium, form_and_point, over_leading_axes
from rodjax.scene import nondimensional
from rodjax.stability import Motion, softest
from rodjax.units import Units


class Mode(eqx.Module):
    """The motion in which an equilibrium is softest; of several ones along a leading axis `...`.

    - `stiffness` [...] N: the second variation of the energy in this motion, by the integral along the rod of the
      squared change of the tangent. Negative where the energy falls, zero for a neutral motion. A straight strut
      loses as much of it as it is pressed
    - `displacement` [..., n+1, 3] of the nodes, the largest 1
    """

    stiffness: Float[Array, "..."]
    displacement: Float[Array, "... n+1 3"]


def lowest_mode(equilibrium: Equilibrium) -> Mode:
    """The lowest eigenvalue of the energy's second variation at an equilibrium under its supports, and its motion.

    Motions out of a plane in which the rod lies count too. Sections spin without resistance of inertia, so that the
    metric is that of the tangents: eigenvalues are in N, `EI/L^2` in nondimensional form. O(n).

    Raises `TypeError` for anything but an `Equilibrium`, `ValueError` for one of the continuum or under a dead moment,
    which has no potential.
    """
    instance(equilibrium, "equilibrium", Equilibrium)
    if equilibrium.discretization == "continuum":
        raise ValueError("equilibrium must be of elements or finite differences, got one of the continuum")
    return _lowest_mode(equilibrium)


@over_leading_axes
def _lowest_mode(equilibrium: Equilibrium) -> Mode:
    form, point = form_and_point(equilibrium)
    if not form.has_potential:
        raise ValueError("equilibrium must have a potential: a dead moment on a free end has none")
    here = form.linearized(point)
    return mode_of(form, point, here, *softest(form, point, here), nondimensional(equilibrium.scene)[1])


def mode_of(
    form: MixedForm,
    point: MixedPoint,
    here: Linearization,
    stiffness: Float[Array, ""],
    motion: Motion,
    units: Units,
) -> Mode:
    """A motion of an equilibrium and its nondimensional stiffness, as a `Mode`."""
    force_change = form.force_change(form.closure(motion.multipliers))

    def nodes(amount: Float[Array, ""]) -> Float[Array, "n+1 3"]:
        return form.nodes(form.edges(form.moved(point, here.bases, amount * motion.rotation, amount * force_change)))

    _, displacement = jax.jvp(nodes, (jnp.zeros_like(stiffness),), (jnp.ones_like(stiffness),))
    largest = jnp.sqrt(jnp.max(jnp.sum(displacement**2, axis=1)))
    return Mode(stiffness * units.force, displacement / largest)
