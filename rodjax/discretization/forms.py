"""The form of a scene on the mesh of a shape: by tangents where these say all, else by frames."""

from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.form import Form
from rodjax.discretization.framed_curve import FramedCurve, form_of_frames
from rodjax.discretization.hermite import Curve, HermiteElements
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import TangentField
from rodjax.discretization.touching import TouchingForm
from rodjax.scene import Scene


def form_of(scene: Scene, shape: Shape) -> Form:
    """Of a nondimensional scene."""
    if isinstance(shape, FramedCurve):
        return form_of_frames(scene, shape)
    if scene.obstacles:
        return TouchingForm.of(scene, field_of(scene, shape))
    return MixedForm.of(scene, field_of(scene, shape))


def field_of(scene: Scene, shape: Shape) -> TangentField:
    if isinstance(shape, Curve):
        return HermiteElements.of(scene, shape.s)
    return EdgeTangents.of(scene, len(shape.nodes) - 1)
