"""How much a rod is bent, at places as close as limits are looked at, and where it may be bent most."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.analysis.clearance import POINTS, arclengths_between
from rodjax.checks import instance, leaf
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.hermite import Curve
from rodjax.geometry.vectors import root
from rodjax.solving.result import Equilibrium, beside_nodes
from rodjax.solving.result_errors import estimated_errors
from rodjax.solving.result_form import over_leading_axes


def most_curved(equilibrium: Equilibrium) -> Float[Array, "... 2"]:
    """The interval of arclength [m] in which the largest curvature lies, given `Equilibrium.curvature_error` and the
    bounds on the curvature between the places where it is known. NaN for the continuum.

    Where several places are about equally curved, the interval spans all of them. Not inside `jit`.
    """
    instance(equilibrium, "equilibrium", Equilibrium)
    s, curvature = (np.asarray(x) for x in curvature_along(equilibrium))
    errors = estimated_errors(equilibrium)
    size = np.asarray(errors.curvature) * np.asarray(errors.scale.curvature)
    error = size / np.asarray(equilibrium.state.units.length)
    # A parabola through three places exceeds the larger one of two neighbours by no more than an eighth of this.
    bump = np.abs(np.diff(curvature, n=2, axis=-1))
    bump = np.concatenate([bump[..., :1], bump, bump[..., -1:]], axis=-1)
    largest, bump = (np.maximum(x[..., 1:], x[..., :-1]) for x in (curvature, bump))
    is_possible = largest + bump / 8 >= (np.max(curvature, axis=-1) - 2 * error)[..., None]
    first = np.min(np.where(is_possible, s[..., :-1], np.inf), axis=-1)
    last = np.max(np.where(is_possible, s[..., 1:], -np.inf), axis=-1)
    return leaf(np.where(np.isfinite(error)[..., None], np.stack([first, last], axis=-1), np.nan))


@over_leading_axes
def curvature_along(equilibrium: Equilibrium) -> tuple[Float[Array, "... k"], Float[Array, "... k"]]:
    """Arclengths [m] one after another, as close as limits are looked at, and the curvature there [1/m]."""
    if not isinstance(equilibrium.state.shape, Curve):
        return at_nodes(equilibrium)
    s = within_elements(equilibrium)
    return s, curvature_within(equilibrium, s)


def has_sides(equilibrium: Equilibrium) -> bool:
    """Whether strains are looked at on both sides of the nodes by the frames there."""
    return bool(equilibrium.scene.clips) and isinstance(equilibrium.state.shape, FramedCurve)


def at_nodes(equilibrium: Equilibrium) -> tuple[Float[Array, "... k"], Float[Array, "... k"]]:
    """Arclengths and curvature, at nodes or beside them."""
    along = beside_nodes(equilibrium) if has_sides(equilibrium) else equilibrium
    return along.s, along.curvature


def within_elements(equilibrium: Equilibrium) -> Float[Array, "k"]:
    """Places of elements, just beside the nodes too: at a clip that holds a direction the curvature jumps."""
    inset = float(jnp.finfo(equilibrium.s.dtype).eps) ** 0.5
    fractions = np.array([inset, *(np.arange(1, POINTS + 1) / (POINTS + 1)), 1 - inset])
    return arclengths_between(equilibrium, fractions)[:-1]


def curvature_within(equilibrium: Equilibrium, s: Float[Array, "k"]) -> Float[Array, "k"]:
    def slope(s: Float[Array, "k"]) -> Float[Array, "k 3"]:
        return jax.jvp(equilibrium.position_at, (s,), (jnp.ones_like(s),))[1]

    first, second = jax.jvp(slope, (s,), (jnp.ones_like(s),))
    across = jnp.cross(first, second)
    squared = jnp.sum(first**2, axis=1)
    return root(jnp.sum(across**2, axis=1)) / squared**1.5
