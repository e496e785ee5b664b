"""What a form by frames is made of besides its unknowns: what resists, what the rod is at rest, and dead loads."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.cells import Cells, ElementCells, JointCells, strains_between
from rodjax.discretization.dead_loads import forces_beyond_points
from rodjax.discretization.layout import SpanForces
from rodjax.discretization.rest_correction import RestCorrection
from rodjax.model.along import Along
from rodjax.model.loads import DistributedForce, length_before, loaded_length
from rodjax.model.scene import Scene, dead_forces


def parts_of(scene: Scene, field: Cells) -> dict[str, Any]:
    """The fields of a `framed.FrameForm`."""
    sections = field.sections(scene.rod)
    rest_strains, rest_correction = _at_rest(scene, field, sections.rest_axial)
    return {
        "scene": scene,
        "field": field,
        "sections": sections,
        "rest_strains": rest_strains,
        "rest_correction": rest_correction,
        "loads": _dead_loads(scene, field),
        "layout": SpanForces.of(scene, field.clip_nodes, field.lengths.shape[1]),
    }


def _at_rest(
    scene: Scene, cells: Cells, rest_axial: Float[Array, "k n"] | None
) -> tuple[Float[Array, "3 k n"] | None, RestCorrection | None]:
    """The strains of the rod at rest by the formula of the cells, and the correction of its segment vectors."""
    rest = scene.rod.rest_shape
    if rest is None:
        return None, None
    # At the nodes and between them, so that both are at hand: of finite differences the frames of the inner nodes are
    # left out.
    poses = rest.poses(ElementCells(cells.s).arclengths)
    is_joints = isinstance(cells, JointCells)
    q = poses.quaternions
    frames = jnp.concatenate([q[:, :1], q[:, 1::2], q[:, -1:]], axis=1) if is_joints else q
    strains = strains_between(cells, frames)
    edges = jnp.diff(poses.positions[:, ::2], axis=1)
    return strains, RestCorrection.of(cells, frames, strains, edges, q[:, 1::2], rest_axial)


def _dead_loads(scene: Scene, cells: Cells) -> Float[Array, "3 k n"]:
    s = cells.strain_arclengths
    one = jnp.ones((), s.dtype)
    loads = []
    if scene.gravity is not None:
        mass = scene.rod.mass_per_length
        loads.append((scene.gravity, mass.integral(s) if isinstance(mass, Along) else s, 1.0))
    for load in scene.distributed:
        if isinstance(load, DistributedForce) and not load.follower:
            loads.append((load.force, length_before(load, s), loaded_length(load, one)))
    loads += [(load.force, 1.0 - cells.parts_before(load.at), 1.0) for load in dead_forces(scene)]
    return forces_beyond_points(scene, cells.clip_nodes, loads, jnp.zeros_like(s))
