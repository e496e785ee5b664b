"""What an equilibrium of any form says at its nodes, ends and clips."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.form import Form
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_results import clip_moments_of_frames, resultants_of_frames
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.results import Resultants, clip_moments, resultants


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
