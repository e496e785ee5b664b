"""What a solve of a harness gives: the equilibria of its rods, and the poses of its bodies."""

import itertools
from collections.abc import Iterator
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import is_known, leaf
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.model.summaries import range_text
from rodjax.model.supports import Clip, Held
from rodjax.solving.description import Described, describe, least_radius
from rodjax.solving.result import Equilibrium, pictures
from rodjax.solving.result_summary import harness_told, title_of_harness, told_html, told_text
from rodjax.solving.rod_contact_results import RodContacts, rod_contacts
from rodjax.solving.status import Status


class BodyPose(eqx.Module):
    """`position` [..., 3] m; `frame` [..., 3, 3], columns the axes of the body; `contact_force` [..., 3] N, which
    obstacles exert on the body where rods end in it.
    """

    position: Float[Array, "... 3"]
    frame: Float[Array, "... 3 3"]
    contact_force: Float[Array, "... 3"]


class HarnessEquilibrium(Described):
    """The equilibrium of a harness, or several of them along a leading axis `...` of every field.

    `result["trunk"]` is the `Equilibrium` of that rod, with clamps at the poses that were found in the place of its
    joints: its `index`, `critical`, `neutral` and estimated errors are those of the rod between these clamps.
    Iteration, `len`, `names`, `keys`, `values` and `items` are as of a dict of rods; `joints["y"].position` and
    `.frame` the pose of a body, and `.contact_force` what obstacles do there, of `contact_forces` [..., joints, 3] N.

    - `energy` [...] J: of rods, springs and dead loads, zero of height at the origin, without the work of dead moments
    - `converged` [...] bool, `status` [...] code, in words by `rodjax.describe`
    - `stable` [...] bool: converged, and no motion of rods and bodies lowers the energy; not examined and False under
      loads without a potential, as a dead moment on a body that may turn about several axes, or follower loads
    - `index` [...] int: how many independent motions lower it, -1 where it is not examined
    - `iterations`, `evaluations` [...] of the solver; `residual` [...] largest component of the gradient, in EI/L^2 of
      each rod, of a body in that of its stiffest rod
    - `end_pressures` [..., c] N: of the contacts of bodies, of each stack of `groups` by rod, obstacle and end
    - `rod_contacts`: of rods that may touch, by both names in the order of the harness, the `RodContacts` of elements
      of the first one with the second one. Computed when asked for
    - `rod_pressures` [..., c] N: of contacts between rods, by the stacks of both, pair and element of the first one
    - `wide_wells` [..., c] bool: which of these stay near the middle of their element, as where rods lie along others
    """

    # In the place of an equilibrium.
    instead: ClassVar[str] = "take one of its rods, result[name], or all of them, result.items()"

    groups: tuple[Equilibrium, ...]
    positions: Float[Array, "... j 3"]
    frames: Float[Array, "... j 3 3"]
    energy: Float[Array, "..."]
    converged: Bool[Array, "..."]
    stable: Bool[Array, "..."]
    index: Int[Array, "..."]
    status: Int[Array, "..."]
    iterations: Int[Array, "..."]
    evaluations: Int[Array, "..."]
    residual: Float[Array, "..."]
    contact_forces: Float[Array, "... j 3"]
    end_pressures: Float[Array, "... c"]
    rod_pressures: Float[Array, "... c"]
    wide_wells: Bool[Array, "... c"]
    harness: Harness
    members: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __str__(self) -> str:
        """How the solve ended, where the joints are, and of each cable a line of values with their units."""
        return told_text(title_of_harness(self), harness_told(self))

    def _repr_html_(self) -> str:
        """The same as a table, and of a single one a picture, which notebooks show."""
        has_picture = self.energy.ndim == 0 and is_known(self)
        drawn = [drawn(self) for drawn in pictures] if has_picture else ()
        return told_html(title_of_harness(self), harness_told(self), drawn)

    @property
    def names(self) -> tuple[str, ...]:
        return self.harness.names

    @property
    def joints(self) -> dict[str, BodyPose]:
        return {
            name: BodyPose(self.positions[..., j, :], self.frames[..., j, :, :], self.contact_forces[..., j, :])
            for j, name in enumerate(self.harness.joint_names)
        }

    @property
    def rod_contacts(self) -> dict[tuple[str, str], RodContacts]:
        if not self.harness.contact:
            return {}
        return rod_contacts(self.harness, self.groups, self.rod_pressures, self.wide_wells, members=self.members)

    @property
    def segments(self) -> list[int]:
        """Of the mesh of each rod."""
        found = {
            number: group.s.shape[-1] - 1
            for members, group in zip(self.members, self.groups, strict=True)
            for number in members
        }
        return [found[number] for number in range(len(self))]

    def __getitem__(self, name: str) -> Equilibrium:
        if name not in self.names:
            known = ", ".join(map(repr, self.names))
            raise KeyError(f"no rod {name!r} in this harness: its rods are {known}")
        return self.rod(self.names.index(name))

    def rod(self, number: int) -> Equilibrium:
        """By its place among the `names`."""
        for members, group in zip(self.members, self.groups, strict=True):
            if number in members:
                return _taken(group, members.index(number), self.energy.ndim)
        raise IndexError(number)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def keys(self) -> tuple[str, ...]:
        return self.names

    def values(self) -> list[Equilibrium]:
        return [self.rod(number) for number in range(len(self))]

    def items(self) -> list[tuple[str, Equilibrium]]:
        return list(zip(self.names, self.values(), strict=True))

    def in_words(self) -> str:
        if np.ndim(self.status):
            codes, counts = np.unique(np.asarray(self.status), return_counts=True)
            return "\n".join(f"{count} {Status(code).message}" for code, count in zip(codes, counts, strict=True))
        lines = [self.outcome]
        if bool(self.converged) and int(self.index) > 0:
            lines[0] += f"; a saddle: {int(self.index)} motions lower the energy"
        if bool(self.converged) and not self.harness.has_potential:
            lines[0] += "; under loads without a potential, so that no energy tells whether it is stable"
        return "\n".join(lines + self._contacts_told() + [f"{name}: {describe(rod)}" for name, rod in self.items()])

    @property
    def outcome(self) -> str:
        """Of one equilibrium, in words."""
        told = Status(int(self.status)).message
        told += f"; residual {float(self.residual):.1e} EI/L^2 after {int(self.iterations)} iterations"
        return "; ".join([told, *([] if bool(self.converged) else self._held_too_near())])

    def _held_too_near(self) -> list[str]:
        """Of rods that may touch, which supports or clips hold places nearer to one another than the radii allow."""
        told = []
        for pair in self.harness.contact:
            names, scenes = [self.names[k] for k in pair], [self.harness.scenes[k] for k in pair]
            allowed = sum(least_radius(scene.rod) for scene in scenes)
            for (place, x), (other, y) in itertools.product(*map(_held_places, scenes)):
                distance = float(np.linalg.norm(x - y))
                if distance < allowed:
                    told.append(
                        f"{names[0]} ({place}) and {names[1]} ({other}) are held {distance:.4g} m apart, less than "
                        f"their radii together, {allowed:.4g} m"
                    )
        return told

    def _contacts_told(self) -> list[str]:
        """Of one equilibrium, which rods touch one another, with which force and where."""
        if not bool(self.converged) or not self.harness.contact:
            return []
        told = []
        for (first, second), found in self.rod_contacts.items():
            found = jax.tree.map(np.asarray, found)
            touching = np.linalg.norm(found.forces, axis=-1) > 0
            if np.any(touching):
                s, other_s = found.s[touching], found.other_s[touching]
                where = f"{first} at s = {range_text(s, 'm')} and {second} at s = {range_text(other_s, 'm')}"
                force = np.linalg.norm(found.forces.sum(0))
                told.append(f"{first} and {second} touch, {where}, and push one another with {force:.4g} N")
        return told if told else ["no rods touch one another"]


def _held_places(scene: Scene) -> list[tuple[str, Float[np.ndarray, "3"]]]:
    """The supports and clips that hold a rod where they are, and where that is."""
    clips = [(f"clips[{k}]", clip) for k, clip in enumerate(scene.clips)]
    held = [("start", scene.start), ("end", scene.end), *clips]
    return [(name, np.asarray(one.position)) for name, one in held if isinstance(one, Held | Clip)]


Solution = Equilibrium | HarnessEquilibrium


def solved_in(result: Solution) -> Scene | Harness:
    """Of which an equilibrium is."""
    return result.scene if isinstance(result, Equilibrium) else result.harness


def results_of(result: Solution, prefix: str = "{}: ") -> dict[str, Equilibrium]:
    """Those of all rods, by `prefix` with the name of each; by nothing where there is only one."""
    if isinstance(result, HarnessEquilibrium):
        return {prefix.format(name): rod for name, rod in result.items()}
    return {"": result}


def _taken(stacked: Equilibrium, place: int, axis: int) -> Equilibrium:
    """One of equilibria stacked along an axis."""

    def taken(stack: Array) -> Array:
        if is_known(stack):
            return leaf(np.asarray(stack)[(slice(None),) * axis + (place,)])
        return jax.lax.index_in_dim(stack, place, axis, keepdims=False)

    return jax.tree.map(taken, stacked)
