"""Scenes that lie in a plane: supports and loads are symmetric to it, and the rod may be sought in it alone."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import is_known
from rodjax.model.along import Along
from rodjax.model.loads import DistributedForce
from rodjax.model.scene import Scene, dead_end_moment, dead_forces
from rodjax.model.supports import Clamp, Clip, Directed, Free, Held
from rodjax.programs.compilation import compiled

# Directions count as lying in the plane up to this part of their length: six digits, as typed.
TOLERANCE = 1e-5


def plane(scene: Scene, tangents: Float[Array, "3 n"] | None = None) -> tuple[Float[Array, "3"], Float[Array, "3 2"]]:
    """The unit normal of the plane in which a scene lies, and two axes in it.

    Where all of a scene lies along one line, the plane is that of the rod's first shape, given by its `tangents`.
    """
    directions = _directions(scene)
    if tangents is None:
        tangents = directions.T
    lead = directions[jnp.argmax(jnp.sum(directions**2, axis=1))]
    lead = jnp.where(jnp.any(lead != 0), lead, tangents[:, 0])
    by_scene, by_shape = _normal_to(lead, directions), _normal_to(lead, tangents.T)
    any_normal = jnp.cross(lead, jnp.eye(3, dtype=lead.dtype)[jnp.argmin(jnp.abs(lead))])
    normal = jnp.where(jnp.sum(by_shape**2) > TOLERANCE**2, by_shape, any_normal)
    normal = jnp.where(jnp.sum(by_scene**2) > TOLERANCE**2, by_scene, normal)
    normal /= jnp.sqrt(jnp.sum(normal**2))
    first = lead - jnp.sum(lead * normal) * normal
    first /= jnp.sqrt(jnp.sum(first**2))
    return normal, jnp.stack([first, jnp.cross(normal, first)], axis=1)


def _normal_to(lead: Float[Array, "3"], directions: Float[Array, "k 3"]) -> Float[Array, "3"]:
    """The largest of the normals to one direction and each of the others."""
    normals = jnp.cross(jnp.broadcast_to(lead[None], directions.shape), directions)
    return normals[jnp.argmax(jnp.sum(normals**2, axis=1))]


def is_planar(scene: Scene, twist: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a scene is symmetric to a plane, and the total twist to stay near to [rad] nearer to none than to 2 pi.

    What `check_planar` tells of its structure is left out, and of rods by frames what shows in the plane alone:
    sections, shapes at rest and loads that follow the rod may push it out (`Form.stays_in_plane`).
    """
    leaving, twisting = _asymmetry(scene)
    is_untwisted = jnp.abs(twist) < jnp.pi
    if not (isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp)):
        is_untwisted = jnp.ones_like(is_untwisted)
    return (leaving <= TOLERANCE) & (twisting <= TOLERANCE) & is_untwisted


def check_planar(scene: Scene, twist: Float[Array, "..."] | float) -> None:
    """Raises `ValueError` where a scene, or one of a stack of them, is not symmetric to a plane, as far as is known.

    `twist`: the total twist of the guess [rad].
    """
    if dead_end_moment(scene) is not None:
        raise ValueError("planar must be False for a moment on a free end")
    rest_twist = scene.rod.rest_twist
    if rest_twist is not None and (isinstance(rest_twist, Along) or not is_known(rest_twist) or np.any(rest_twist)):
        raise ValueError("planar must be False for a rod that is twisted at rest: it leaves the plane as it bends")
    if scene.turns is not None:
        raise ValueError("planar must be False for a scene with turns: a twisted rod leaves the plane")
    has_torsion = isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp)
    if has_torsion and is_known(twist) and not np.max(np.abs(twist)) < np.pi:
        raise ValueError(
            f"planar must be False for a guess with turns, got a total twist of {np.max(np.abs(twist)):.3g} rad: "
            "a twisted rod leaves the plane"
        )
    if not is_known(scene):
        return
    leaving, twisting = map(np.asarray, _asymmetries(scene))
    if not np.max(leaving) <= TOLERANCE:
        raise ValueError(
            "planar must be False for this scene: supports and loads must lie in one plane, "
            f"but one of them leaves it by {np.max(leaving):.1g} of its length"
        )
    if not np.max(twisting) <= TOLERANCE:
        raise ValueError(
            "planar must be False for this scene: its end frames twist the rod, which then leaves the plane"
        )


def _asymmetry(scene: Scene) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How far directions of a scene leave its plane, and how far the end frames hold the normal differently."""
    directions = _directions(scene)
    normal, _ = plane(scene)
    leaving = jnp.max(jnp.abs(directions @ normal))
    if not (isinstance(scene.start, Clamp) and isinstance(scene.end, Clamp)):
        return leaving, jnp.zeros_like(leaving)
    return leaving, jnp.max(jnp.abs(normal @ scene.start.frame - normal @ scene.end.frame))


@compiled
def _asymmetries(scene: Scene) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The same of a scene or a stack of them."""
    return (jax.vmap(_asymmetry) if scene.rod.length.ndim else _asymmetry)(scene)


def _directions(scene: Scene) -> Float[Array, "k 3"]:
    """Unit vectors that span the plane, zero where a scene happens to give none."""
    vectors = [end.tangent for end in (scene.start, scene.end) if isinstance(end, Directed)]
    vectors += [clip.direction for clip in scene.clips if clip.direction is not None]
    positions = [held.position for held in (scene.start, *scene.clips, scene.end) if isinstance(held, Held | Clip)]
    vectors += [position - positions[0] for position in positions[1:]]
    if scene.gravity is not None:
        vectors.append(scene.gravity)
    vectors += [load.force for load in dead_forces(scene)]
    vectors += [load.force for load in scene.distributed if isinstance(load, DistributedForce) and not load.follower]
    ends = [end for end in (scene.start, scene.end) if isinstance(end, Free) and not end.follower]
    vectors += [end.force for end in ends if end.force is not None]
    sizes = [jnp.sqrt(jnp.sum(vector**2)) for vector in vectors]
    return jnp.stack([vector / jnp.where(size > 0, size, 1.0) for vector, size in zip(vectors, sizes, strict=True)])
