"""The form of a scene on the mesh of a shape: by tangents where these say all, else by frames."""

from typing import Any

from rodjax.discretization.cells import ElementCells, JointCells
from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.form import Form
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_curve import FramedCurve, cells_of
from rodjax.discretization.hermite import Curve, QuadraticRotationElements
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.nodal_forms import NodalFrames, NodalTangents
from rodjax.discretization.shape import Shape
from rodjax.discretization.tangent_field import TangentField
from rodjax.model.scene import Scene, has_node_positions


def form_of(scene: Scene, shape: Shape) -> Form:
    """Of a nondimensional scene."""
    return form_on(scene, cells_of(scene, shape) if isinstance(shape, FramedCurve) else field_of(scene, shape))


def form_on(scene: Scene, field: Any) -> Form:
    """On a mesh that is given: a `TangentField`, or `Cells` of frames."""
    if isinstance(field, JointCells | ElementCells):
        return NodalFrames.of(scene, field) if has_node_positions(scene) else FrameForm.of(scene, field)
    return NodalTangents.of(scene, field) if has_node_positions(scene) else MixedForm.of(scene, field)


def field_of(scene: Scene, shape: Shape) -> TangentField:
    if isinstance(shape, Curve):
        return QuadraticRotationElements.of(scene, shape.s)
    return EdgeTangents.of(scene, len(shape.nodes) - 1)
