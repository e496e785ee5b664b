"""What acts on the bodies of a harness: rods, springs, dead loads, and obstacles where rods end in them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import leaf
from rodjax.model.harness import Bodies, Harness, end_radii, floating, joint_ends, rotated
from rodjax.model.scene import has_contacts
from rodjax.solving.assembly import Poses
from rodjax.solving.options import Options
from rodjax.solving.result import Equilibrium
from rodjax.solving.rod_contact import Members, groups_in_contact


def stacked(parts: list[Any]) -> Any:
    """Along a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)


def ends_of(harness: Harness, numbers: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Of some rods the bodies, frames and offsets of both ends; the number of all bodies for none."""
    count, dtype = len(harness.bodies), harness.scenes[0].rod.length.dtype
    found = [joint_ends(harness.scenes[number], harness.joint_names) for number in numbers]
    bodies = jnp.array([[count if j < 0 else j for j in body] for body, _, _ in found])
    frames = jnp.stack([jnp.stack([jnp.asarray(frame, dtype) for frame in two]) for _, two, _ in found])
    offsets = jnp.stack([jnp.stack([jnp.asarray(offset, dtype) for offset in two]) for _, _, two in found])
    return bodies, frames, offsets


def body_forces(
    harness: Harness, rods: list[Equilibrium], bodies: Bodies, poses: Poses, members: Members
) -> Float[Array, "j 6"]:
    """Forces [N] and moments about their positions [N m] on the bodies, of rods, springs and dead loads, global axes:
    what supports hold against.
    """
    count = len(harness.bodies)
    total = jnp.zeros((count + 1, 6), poses.positions.dtype)
    frames = jnp.pad(poses.frames, ((0, 1), (0, 0), (0, 0)))
    for numbers, group in zip(members, rods, strict=True):
        body, _, offset = ends_of(harness, numbers)
        of_ends = (group.start_force, group.start_moment), (group.end_force, group.end_moment)
        for end, (sign, (force, moment)) in enumerate(zip((1, -1), of_ends, strict=True)):
            arms = jnp.einsum("kij,kj->ki", frames[body[:, end]], offset[:, end])
            about = moment + jnp.cross(arms, force)
            total = total.at[body[:, end]].add(sign * jnp.concatenate([force, about], axis=1))

    def energy(motions: Float[Array, "j 6"]) -> Float[Array, ""]:
        there = poses.positions + motions[:, :3], rotated(poses.frames, motions[:, 3:])
        return jnp.sum(bodies.energies(*there, motions[:, 3:]))

    return total[:count] - jax.grad(energy)(jnp.zeros((count, 6), total.dtype))


def energy_of(rods: list[Equilibrium], bodies: Bodies, poses: Poses) -> Float[Array, ""]:
    """Of rods, springs and dead loads [J]."""
    energies = bodies.energies(*poses, jnp.zeros_like(poses.positions))
    return jnp.sum(energies) + sum(jnp.sum(rod.energy) for rod in rods)


# --- pressures of contacts --------------------------------------------------------------------------------------------


def _of_obstacles(harness: Harness, members: Members) -> list[int]:
    """How many obstacles the rods of each group have."""
    return [len(harness.scenes[numbers[0]].obstacles) for numbers in members]


def no_pressures(harness: Harness, members: Members) -> Float[Array, "c"]:
    counts = [2 * count * len(numbers) for count, numbers in zip(_of_obstacles(harness, members), members, strict=True)]
    return leaf(np.zeros(sum(counts), harness.scenes[0].rod.length.dtype))


def split_pressures(harness: Harness, members: Members, pressures: Float[Array, "c"]) -> list[Array | None]:
    """Of each group (rods, obstacles, ends); `None` of rods that touch nothing."""
    found, first, touched = [], 0, groups_in_contact(harness.contact, members)
    for group, (count, numbers) in enumerate(zip(_of_obstacles(harness, members), members, strict=True)):
        size = 2 * count * len(numbers)
        of_group = pressures[first : first + size].reshape(len(numbers), count, 2)
        touches = has_contacts(harness.scenes[numbers[0]]) or group in touched
        found.append(of_group if touches else None)
        first += size
    return found


def no_rod_pressures(
    harness: Harness, members: Members, options: tuple[Options, ...]
) -> tuple[Float[Array, "c"], Bool[Array, "c"]]:
    """Of contacts between rods, of each kind of pairs by pair and element of its first rod; wells, all wide."""
    counts = {number: option.segments for numbers, option in zip(members, options, strict=True) for number in numbers}
    count = sum(counts[first] for first, _ in harness.contact)
    return leaf(np.zeros(count, harness.scenes[0].rod.length.dtype)), leaf(np.ones(count, bool))


def contact_forces(
    harness: Harness, members: Members, poses: Poses, pressures: Float[Array, "c"]
) -> tuple[Float[Array, "j 6"], Float[Array, "c"]]:
    """Forces [N] of obstacles on the bodies where rods end in them, and moments about their positions [N m]; the gaps
    there [m], none at ends that are in no body.
    """
    count, floats = len(harness.bodies), floating(harness)
    total, gaps = jnp.zeros((count + 1, 6), poses.positions.dtype), []
    for numbers, of_group in zip(members, split_pressures(harness, members, pressures), strict=True):
        if of_group is None:
            continue
        for number, of_rod in zip(numbers, of_group, strict=True):
            scene = harness.scenes[number]
            bodies, _, offsets = joint_ends(scene, harness.joint_names)
            radius = end_radii(scene)
            for obstacle, of_ends in zip(scene.obstacles, of_rod, strict=True):
                of_obstacle = []
                for body, offset, thick, pressure in zip(bodies, offsets, radius, of_ends, strict=True):
                    if body < 0 or not floats[body]:
                        of_obstacle.append(jnp.ones_like(thick))
                        continue
                    arm = poses.frames[body] @ offset
                    distance, normal = jax.value_and_grad(obstacle.at)(poses.positions[body] + arm)
                    force = pressure * normal
                    total = total.at[body].add(jnp.concatenate([force, jnp.cross(arm, force)]))
                    of_obstacle.append(distance - thick)
                gaps.append(jnp.stack(of_obstacle))
    return total[:count], jnp.concatenate(gaps) if gaps else jnp.zeros_like(pressures)
