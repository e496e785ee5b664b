"""Harnesses: rods whose ends meet in rigid bodies with unknown poses."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import instance, is_known, leaf, namespace, not_negative, sequence, vector
from rodjax.geometry.rotations import rotation_vector
from rodjax.model.along import largest_beside
from rodjax.model.scene import (
    Scene,
    between,
    dead_end_moment,
    has_potential,
    needs_frames,
    slides,
    support_between,
)
from rodjax.model.summaries import harness_text
from rodjax.model.supports import Clamp, Free, Hinge, Joint, Movable, Pin, Slider, Spring, Support, rotate

# Names of the bodies at the ends of a scene that are a Hinge, Slider or Spring.
ENDS = ("start", "end")


class Body(eqx.Module):
    """What acts on a joint of a harness beside its rods.

    `force`: (3,) [N] at its position, and `moment`: (3,) [N m], both dead, global axes; `mass` [kg] at its position,
    under the gravity of its rods; `support`: `Clamp`, `Pin`, `Hinge`, `Slider` or `Spring`, which holds the position
    and the axes of the body as it holds those of an end, or `None`.
    """

    force: Float[Array, "3"] | None
    moment: Float[Array, "3"] | None
    mass: Float[Array, ""] | None
    support: Support | None

    def __init__(self, force: Any = None, moment: Any = None, mass: Any = 0.0, support: Support | None = None):
        self.force = None if force is None else leaf(vector(force, "force"))
        self.moment = None if moment is None else leaf(vector(moment, "moment"))
        mass = not_negative(0.0 if mass is None else mass, "mass")
        self.mass = None if is_known(mass) and float(mass) == 0 else leaf(mass)
        if support is not None:
            instance(support, "support", (Clamp, Pin, Hinge, Slider, Spring))
        self.support = support


class Harness(eqx.Module):
    """Rods whose ends are fixed in common rigid bodies: trees and loops.

    **Arguments:**

    - `cables`: `{name: Scene}`; an end that is a `Joint` belongs to the body of that name.
    - `joints`: `{name: Body}`, for bodies with loads or supports; others need not be named.
    - `contact`: which rods, all with a radius, touch one another without friction: `False` for none, `True` for every
        pair that shares no joint, or pairs of their names, which share none either: there their ends meet. Each element
        touches another rod where it is nearest to it, at most 32 at a time between rods of two structures. No step of a
        search leads a rod through another; on which side of one another they lie is that of the lines between the
        places that hold them, where these cross, of `guess`, or of the last step of a path.

    A rod touches the obstacles of its own scene, and a joint those of its rods at the places where these end in it,
    there without friction, unless a support of its own holds it in a direction. Without contact between rods one end
    must be a `Joint`.

    Raises `ValueError` for a body without a rod, for rods that nothing holds, for a mass under no gravity or several,
    for a scene with a dead moment on the free end of a plain rod, and for a sliding clip of a rod that touches others.
    """

    # In the place of a scene.
    instead: ClassVar[str] = (
        "rodjax.solve, solve_path, solve_batch, follow and end_stiffness take it, others the scene of a rod with "
        "clamps where its joints were found: result[name].scene"
    )

    scenes: tuple[Scene, ...]
    bodies: tuple[Body, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    # Numbers of rods, the lower one first.
    contact: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def __init__(
        self,
        cables: Mapping[str, Scene],
        joints: Mapping[str, Body] | None = None,
        contact: bool | Sequence[tuple[str, str]] = False,
    ) -> None:
        instance(cables, "cables", Mapping)
        joints = {} if joints is None else joints
        instance(joints, "joints", Mapping)
        for name, scene in cables.items():
            instance(name, "the name of a cable", str)
            instance(scene, f"cables[{name!r}]", Scene)
            _check_scene(scene, f"cables[{name!r}]")
        found = [end.name for scene in cables.values() for end in (scene.start, scene.end) if isinstance(end, Joint)]
        for name, body in joints.items():
            instance(body, f"joints[{name!r}]", Body)
            if name not in found:
                known = ", ".join(map(repr, dict.fromkeys(found))) or "none"
                raise ValueError(f"joints[{name!r}] has no rod: the ends of the cables name {known}")
        self.contact = _checked_contact(contact, cables)
        if not found and not self.contact:
            raise ValueError(
                "a harness must have an end that is a Joint, or contact between rods; rodjax.solve takes scenes without"
            )
        self.names = tuple(cables)
        self.scenes = tuple(cables.values())
        self.joint_names = tuple(dict.fromkeys(found))
        self.bodies = tuple(joints.get(name, Body()) for name in self.joint_names)
        _check_held(self)
        for name, body in zip(self.joint_names, self.bodies, strict=True):
            if body.mass is not None:
                _gravity(self, name)

    def __str__(self) -> str:
        return harness_text(self)

    def __getitem__(self, name: str) -> Scene:
        return self.scenes[self.names.index(name)]

    @property
    def contact_names(self) -> list[tuple[str, str]]:
        """Of the rods that may touch one another."""
        return [(self.names[first], self.names[second]) for first, second in self.contact]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def has_potential(self) -> bool:
        """Whether all loads have one: a dead moment has none on a body that may turn about more than one axis, nor
        have those of `rodjax.model.scene.has_potential`.
        """
        turn = [_motions(body.support).rotations.shape[1] > 1 for body in self.bodies if body.moment is not None]
        return all(map(has_potential, self.scenes)) and not any(turn)


def _checked_contact(contact: Any, cables: Mapping[str, Scene]) -> tuple[tuple[int, int], ...]:
    names = tuple(cables)
    if isinstance(contact, bool):
        every = itertools.combinations(range(len(names)), 2) if contact else ()
        pairs = tuple((a, b) for a, b in every if not _shared(cables[names[a]], cables[names[b]]))
        if contact and not pairs:
            raise ValueError("contact must be False in a harness of which no two cables are without a common joint")
    else:
        pairs = tuple(sorted({_checked_pair(pair, names) for pair in sequence(contact, "contact", "pair of names")}))
    for first, second in pairs:
        shared = _shared(cables[names[first]], cables[names[second]])
        if shared:
            raise ValueError(
                f"contact must be of cables without a common joint, as their ends meet there, got {names[first]!r} and "
                f"{names[second]!r}, which both end in {min(shared)!r}"
            )
    for number in sorted({number for pair in pairs for number in pair}):
        scene, name = cables[names[number]], f"cables[{names[number]!r}]"
        if scene.rod.radius is None:
            raise ValueError(f"{name}.rod must have a radius, as it may touch another cable, got None")
        if slides(scene):
            raise ValueError(f"{name}.clips must not slide, as it may touch another cable: leave it out of contact")
    return pairs


def _shared(first: Scene, second: Scene) -> set[str]:
    """The joints in which both rods end."""
    one, other = ({end.name for end in (scene.start, scene.end) if isinstance(end, Joint)} for scene in (first, second))
    return one & other


def _checked_pair(pair: Any, names: tuple[str, ...]) -> tuple[int, int]:
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise ValueError(f"contact must be True, False or pairs of names of cables, got {pair!r} among them")
    for name in pair:
        if name not in names:
            known = ", ".join(map(repr, names))
            raise ValueError(f"contact names the cable {name!r}, but the cables are {known}")
    if pair[0] == pair[1]:
        raise ValueError(
            f"contact must be of different cables, got {pair[0]!r} twice: self_contact=True in its scene is that"
        )
    first, second = sorted(names.index(name) for name in pair)
    return first, second


def _check_scene(scene: Scene, name: str) -> None:
    if scene.rod.length.ndim:
        raise ValueError(f"{name} must be a single scene, got a stack of shape {scene.rod.length.shape}")
    for end in ENDS:
        support = getattr(scene, end)
        if isinstance(support, Movable) and not isinstance(support, Joint):
            raise ValueError(
                f"{name}.{end} must not be a {type(support).__name__} in a harness: make it a Joint, and give its Body "
                "that support"
            )
    check_movable(scene, name)


def check_movable(scene: Scene, name: str) -> None:
    """Raises `ValueError` for what a rod with ends of unknown pose cannot have."""
    if dead_end_moment(scene) is not None and not needs_frames(scene):
        raise ValueError(
            f"{name} must have no dead moment on the free end of a plain rod where its other end has an unknown pose: "
            "make that end a Joint of a Harness, and give its Body the moment"
        )
    if scene.rod.length.dtype != jnp.float64:
        raise ValueError(f"{name} must be in double precision: jax.config.update('jax_enable_x64', True) before")


def _check_held(harness: Harness) -> None:
    """Each rod hangs on something that holds a position."""
    groups = {name: name for name in harness.joint_names}

    def root(name: str) -> str:
        while groups[name] != name:
            name = groups[name]
        return name

    held = {name for name, body in zip(harness.joint_names, harness.bodies, strict=True) if body.support is not None}
    for scene in harness.scenes:
        of_rod = [end.name for end in (scene.start, scene.end) if isinstance(end, Joint)]
        if len(of_rod) == 2:
            groups[root(of_rod[0])] = root(of_rod[1])
        elif of_rod and not isinstance(_other(scene), Free):
            held.add(of_rod[0])
        if of_rod and scene.clips:
            held.add(of_rod[0])
    is_held = {root(name) for name in held}
    for name in harness.joint_names:
        if root(name) not in is_held:
            raise ValueError(f"nothing holds the rods at the joint {name!r}: give an end a support, or its Body")


def _other(scene: Scene) -> Support:
    return scene.end if isinstance(scene.start, Joint) else scene.start


def _gravity(harness: Harness, name: str) -> Float[Array, "3"]:
    """That of the rods at a joint."""
    found = [
        scene.gravity
        for scene in harness.scenes
        for end in (scene.start, scene.end)
        if isinstance(end, Joint) and end.name == name and scene.gravity is not None
    ]
    if not found:
        raise ValueError(f"joints[{name!r}].mass needs a rod with gravity at the joint, got none")
    if is_known(found) and any(np.any(np.asarray(one) != np.asarray(found[0])) for one in found):
        raise ValueError(f"joints[{name!r}].mass must have rods of one gravity, got several")
    return found[0]


class _Motions(NamedTuple):
    """How a support lets a body move: from where, along which directions, about which axes, against which springs."""

    position: Any
    frame: Any
    translations: Any
    rotations: Any
    translation: Any
    rotation: Any


def _motions(support: Support | None) -> _Motions:
    none, everything = np.zeros((3, 0)), np.eye(3)
    if isinstance(support, Spring):
        inner = _motions(support.support)
        translations, rotations = inner.translations, inner.rotations
        if support.translation is not None and translations.shape[1] == 0:
            translations = everything
        if support.rotation is not None and rotations.shape[1] == 0:
            rotations = everything
        return _Motions(inner.position, inner.frame, translations, rotations, support.translation, support.rotation)
    if isinstance(support, Clamp):
        return _Motions(support.position, support.frame, none, none, None, None)
    if isinstance(support, Pin):
        return _Motions(support.position, None, none, everything, None, None)
    if isinstance(support, Hinge):
        return _Motions(support.position, support.frame, none, support.axis[:, None], None, None)
    if isinstance(support, Slider):
        rotations = everything if support.frame is None else none
        return _Motions(support.position, support.frame, support.directions.T, rotations, None, None)
    return _Motions(None, None, everything, everything, None, None)


def floating(harness: Harness) -> tuple[bool, ...]:
    """Of each body whether it may move in all directions."""
    return tuple(_motions(body.support).translations.shape[1] == 3 for body in harness.bodies)


def harness_between(harness: Harness, other: Harness, fraction: Float[Array, ""]) -> Harness:
    """A harness on the way from one to another of its structure, as `rodjax.model.scene.between`."""
    mixed = jax.tree.map(lambda a, b: a + fraction * (b - a), harness, other)
    scenes = [between(*both, fraction) for both in zip(harness.scenes, other.scenes, strict=True)]
    supports = [
        support_between(one.support, two.support, fraction)
        for one, two in zip(harness.bodies, other.bodies, strict=True)
        if one.support is not None and two.support is not None
    ]

    def parts(harness: Harness) -> list[Any]:
        return [*harness.scenes, *(body.support for body in harness.bodies if body.support is not None)]

    return eqx.tree_at(parts, mixed, [*scenes, *supports])


class Bodies(eqx.Module):
    """All bodies of a harness, stacked; SI units, global axes.

    `position`, `frame`: of their supports, of free ones zero and the identity; `translations`, `rotations`: columns,
    the directions and axes along which they move, zero beyond these; springs and loads, `None` where no body has one.
    `floats`: of bodies that may move in all directions, which obstacles push where rods end in them; the places of
    others are given, as those of ends of a scene are.
    """

    position: Float[Array, "j 3"]
    frame: Float[Array, "j 3 3"]
    translations: Float[Array, "j 3 3"]
    rotations: Float[Array, "j 3 3"]
    force: Float[Array, "j 3"] | None
    moment: Float[Array, "j 3"] | None
    translation: Float[Array, "j 3 3"] | None
    rotation: Float[Array, "j 3 3"] | None
    has_frame: tuple[bool, ...] = eqx.field(static=True)
    floats: tuple[bool, ...] = eqx.field(static=True)
    columns: tuple[int, ...] = eqx.field(static=True)  # those of `motions` that are there

    @staticmethod
    def of(harness: Harness) -> "Bodies":
        dtype = harness.scenes[0].rod.length.dtype
        found = [_motions(body.support) for body in harness.bodies]
        forces = [_force_on(harness, name) for name in harness.joint_names]
        columns = [
            6 * j + first + k
            for j, motions in enumerate(found)
            for first, basis in ((0, motions.translations), (3, motions.rotations))
            for k in range(basis.shape[1])
        ]
        return Bodies(
            position=_stacked([motions.position for motions in found], np.zeros(3), dtype),
            frame=_stacked([motions.frame for motions in found], np.eye(3), dtype),
            translations=_stacked([_padded(motions.translations) for motions in found], np.zeros((3, 3)), dtype),
            rotations=_stacked([_padded(motions.rotations) for motions in found], np.zeros((3, 3)), dtype),
            force=_stacked_if_any(forces, np.zeros(3), dtype),
            moment=_stacked_if_any([body.moment for body in harness.bodies], np.zeros(3), dtype),
            translation=_stacked_if_any([_matrix(motions.translation) for motions in found], np.zeros((3, 3)), dtype),
            rotation=_stacked_if_any([_matrix(motions.rotation) for motions in found], np.zeros((3, 3)), dtype),
            has_frame=tuple(motions.frame is not None for motions in found),
            floats=floating(harness),
            columns=tuple(columns),
        )

    @property
    def motions(self) -> Float[Array, "6j k"]:
        """The directions (u, r) in which the bodies can move, one column each; rows of body after body."""
        count = len(self.position)
        if not self.columns:
            return jnp.zeros((6 * count, 0), self.position.dtype)
        each = jnp.zeros((count, 6, count, 6), self.position.dtype)
        j = np.arange(count)
        each = each.at[j, :3, j, :3].set(self.translations).at[j, 3:, j, 3:].set(self.rotations)
        return each.reshape(6 * count, 6 * count)[:, np.array(self.columns, int)]

    @property
    def under_moments(self) -> Float[Array, "j 3 3"]:
        """What dead moments M add to the stiffness against rotation vectors r: -M x r / 2. What potentials apply to a
        body changes by their second derivatives with respect to r and, where it is not zero, by half of its cross
        product with r; at equilibrium it is -M, which stays as it is.
        """
        assert self.moment is not None
        return jax.vmap(lambda moment: jnp.cross(moment[None], jnp.eye(3, dtype=moment.dtype)).T / -2)(self.moment)

    def energies(
        self, positions: Float[Array, "j 3"], frames: Float[Array, "j 3 3"], turns: Float[Array, "j 3"]
    ) -> Float[Array, "j"]:
        """Of springs and dead loads [J]; the work of dead moments is that of `turns`, rotation vectors from where it is
        counted.
        """
        energies = jnp.zeros(len(positions), positions.dtype)
        if self.force is not None:
            energies -= jnp.sum(self.force * positions, axis=1)
        if self.moment is not None:
            energies -= jnp.sum(self.moment * turns, axis=1)
        if self.translation is not None:
            away = positions - self.position
            energies += jnp.einsum("ji,jik,jk->j", away, self.translation, away) / 2
        if self.rotation is not None:
            turned = rotation_vectors(frames, self.frame)
            energies += jnp.einsum("ji,jik,jk->j", turned, self.rotation, turned) / 2
        return energies

    def followed(
        self, others: "Bodies", positions: Float[Array, "j 3"], frames: Float[Array, "j 3 3"]
    ) -> tuple[Float[Array, "j 3"], Float[Array, "j 3 3"]]:
        """Poses under these supports, of those under others: displaced and turned from them as before."""
        if not len(positions):
            return positions, frames
        away = jnp.einsum("jik,jlk,jl->ji", self.translations, others.translations, positions - others.position)
        turned = rotation_vectors(frames, others.frame)
        turned = jnp.einsum("jik,jlk,jl->ji", self.rotations, others.rotations, turned)
        is_framed = np.array(self.has_frame)[:, None, None]
        return self.position + away, jnp.where(is_framed, rotated(self.frame, turned), frames)


def rotated(frames: Float[Array, "j 3 3"], turns: Float[Array, "j 3"]) -> Float[Array, "j 3 3"]:
    """Frames turned by rotation vectors, global axes."""
    return jax.vmap(rotate)(frames, turns)


def _padded(basis: Any) -> Any:
    xp = namespace(basis)
    return xp.concatenate([basis, np.zeros((3, 3 - basis.shape[1]))], axis=1)


def _force_on(harness: Harness, name: str) -> Any:
    body = harness.bodies[harness.joint_names.index(name)]
    if body.mass is None:
        return body.force
    weight = body.mass * _gravity(harness, name)
    return weight if body.force is None else weight + body.force


def _matrix(stiffness: Any) -> Any:
    if stiffness is None or stiffness.ndim:
        return stiffness
    return stiffness * jnp.eye(3, dtype=stiffness.dtype)


def _stacked(values: list[Any], default: np.ndarray, dtype: Any) -> Array:
    if not values:
        return jnp.zeros((0, *default.shape), dtype)
    return jnp.stack([jnp.asarray(default, dtype) if value is None else value for value in values])


def _stacked_if_any(values: list[Any], default: np.ndarray, dtype: Any) -> Array | None:
    return None if all(value is None for value in values) else _stacked(values, default, dtype)


def rotation_vectors(frames: Float[Array, "j 3 3"], others: Float[Array, "j 3 3"]) -> Float[Array, "j 3"]:
    """From other frames to frames, global axes, no longer than pi."""
    return jax.vmap(rotation_vector)(others, frames)


def joint_ends(scene: Scene, joint_names: tuple[str, ...]) -> tuple[tuple[int, int], Any, Any]:
    """The bodies at both ends of a rod, and frames and offsets in them."""
    ends = (scene.start, scene.end)
    numbers = tuple(joint_names.index(end.name) if isinstance(end, Joint) else -1 for end in ends)
    frames = [end.frame if isinstance(end, Joint) else np.eye(3) for end in ends]
    offsets = [end.offset if isinstance(end, Joint) else np.zeros(3) for end in ends]
    return (numbers[0], numbers[1]), frames, offsets


def end_radii(scene: Scene) -> Float[Array, "2"]:
    """Of the rod at its ends [m]."""
    length, radius = scene.rod.length, scene.rod.radius
    assert radius is not None
    return jnp.broadcast_to(largest_beside(radius, jnp.stack([jnp.zeros_like(length), length])), (2,))


def clamped(scene: Scene, harness: Harness, positions: Any, frames: Any) -> Scene:
    """The scene of a rod with clamps in the place of its joints, at poses of the bodies."""
    ends = []
    for end in (scene.start, scene.end):
        if isinstance(end, Joint):
            j = harness.joint_names.index(end.name)
            end = clamp_at(end, positions[j], frames[j])
        ends.append(end)
    return eqx.tree_at(lambda scene: (scene.start, scene.end), scene, tuple(ends))


def clamp_at(end: Joint, position: Float[Array, "3"], frame: Float[Array, "3 3"]) -> Clamp:
    """What holds the end of a rod where its body is at a pose."""
    return Clamp(position + frame @ end.offset, frame @ end.frame)


def has_movable_ends(scene: Scene) -> bool:
    """Whether the pose of an end is unknown."""
    return isinstance(scene.start, Movable) or isinstance(scene.end, Movable)


def scenes_of(scene: Scene | Harness, prefix: str = "{}") -> dict[str, Scene]:
    """The scenes of all rods, by `prefix` with the name of each; by nothing where there is only one."""
    if isinstance(scene, Scene):
        return {"": scene}
    return dict(zip(map(prefix.format, scene.names), scene.scenes, strict=True))


def check_without_friction(subject: Scene | Harness, name: str) -> None:
    """Raises `ValueError` where what `name` does has no path along which friction could act."""
    for of, scene in scenes_of(subject, "cables[{!r}].").items():
        for k, obstacle in enumerate(scene.obstacles):
            if obstacle.friction is not None:
                raise ValueError(f"{of}obstacles[{k}].friction must be 0 in {name}: it acts along a path only")


def of_one_rod(scene: Scene) -> Harness:
    """A scene whose ends are a `Hinge`, `Slider` or `Spring`, as a harness with bodies that these support."""
    check_movable(scene, "scene")
    ends, joints = [], {}
    for name in ENDS:
        end = getattr(scene, name)
        if isinstance(end, Joint):
            raise ValueError(f"scene.{name} is a Joint: make a Harness of the scene and solve that")
        if isinstance(end, Movable):
            joints[name] = Body(support=end)
            end = Joint(name)
        ends.append(end)
    scene = eqx.tree_at(lambda scene: (scene.start, scene.end), scene, tuple(ends))
    return Harness({"rod": scene}, joints)
