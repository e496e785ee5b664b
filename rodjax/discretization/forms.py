"""The form of a scene on the mesh of a shape: by tangents where these say all, else by frames."""

from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.form import Form
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_curve import FramedCurve, cells_of
from rodjax.discretization.hermite import Curve, QuadraticRotationElements
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.nodal_forms import NodalFrames, NodalTangents
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import TangentField
from rodjax.model.scene import Scene, has_node_places


def form_of(scene: Scene, shape: Shape) -> Form:
    """Of a nondimensional scene."""
    if isinstance(shape, FramedCurve):
        cells = cells_of(scene, shape)
        return NodalFrames.of(scene, cells) if has_node_places(scene) else FrameForm.of(scene, cells)
    if has_node_places(scene):
        return NodalTangents.of(scene, field_of(scene, shape))
    return MixedForm.of(scene, field_of(scene, shape))


def field_of(scene: Scene, shape: Shape) -> TangentField:
    if isinstance(shape, Curve):
        return QuadraticRotationElements.of(scene, shape.s)
    return EdgeTangents.of(scene, len(shape.nodes) - 1)
