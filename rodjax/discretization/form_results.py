"""What an equilibrium of any form says at its nodes, ends and clips."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.form import Form
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_results import clip_moments_of_frames, positions_between_frames, resultants_of_frames
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.results import Resultants, clip_moments, positions_between, resultants


def resultants_of(form: Form, point: Any) -> Resultants:
    if isinstance(form, FrameForm):
        return resultants_of_frames(form, point)
    assert isinstance(form, MixedForm)
    return resultants(form, point)


def clip_moments_of(form: Form, point: Any) -> Float[Array, "clips 3"]:
    """What the clips apply to the rod, nondimensional."""
    if not form.scene.clips:
        return jnp.zeros((0, 3), point.tangents.dtype)
    if isinstance(form, FrameForm):
        return clip_moments_of_frames(form, point)
    assert isinstance(form, MixedForm)
    return clip_moments(form, point)


def positions_between_nodes(
    form: Form, point: Any, nodes: Float[Array, "n+1 3"], s: Float[Array, "k"]
) -> Float[Array, "k 3"]:
    """The centerline at arclengths between the nodes of elements."""
    if isinstance(form, FrameForm):
        return positions_between_frames(form, point, nodes, s)
    assert isinstance(form, MixedForm)
    return positions_between(form, point, nodes, s)
