"""What a hand can move in a scene: poses of ends, clips and obstacles, and a few numbers.

`Controls` are all of it at one moment; `scene_of` makes the scene of them, and between two of them there are others, so
that a large move can be made in pieces.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rodjax.checks import leaf, namespace, number_array, rotation, vector
from rodjax.model.along import Along
from rodjax.model.harness import Harness, scenes_of
from rodjax.model.obstacles import Box, Capsule, Cylinder, Obstacle, Pipe, Plane, Sphere, Union
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Clip, Hinge, Pin, Spring, Support, Swivel, frame
from rodjax.model.supports import Slider as Slide
from rodjax.model.triangle_mesh import Mesh

# How far sliders go, as multiples of the scene's own number.
LENGTH_RANGE, STIFFNESS_RANGE, GRAVITY_RANGE = (0.5, 1.5), (0.1, 4.0), (0.0, 2.0)


class Pose(NamedTuple):
    """Where something is [m], and how it is turned: a rotation matrix."""

    position: Float[np.ndarray, "3"]
    frame: Float[np.ndarray, "3 3"]


class Handle(NamedTuple):
    """What can be taken in the hand. `name`: its key in `Controls.poses`; `turns`: whether it can be turned, too."""

    name: str
    label: str
    turns: bool


class Slider(NamedTuple):
    """A number that can be changed, in `unit`, from `low` to `high`; `name`: its key in `Controls.numbers`."""

    name: str
    label: str
    unit: str
    low: float
    high: float


@functools.partial(jax.tree_util.register_dataclass, data_fields=["poses", "numbers"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class Controls:
    """All poses and numbers of a scene at one moment. Those of an obstacle are relative to its place in the scene."""

    poses: Mapping[str, Pose]
    numbers: Mapping[str, float]

    def changed(self, changes: Mapping[str, Any]) -> "Controls":
        """With other poses and numbers, by their names. Raises `ValueError` or `TypeError` for what is none."""
        poses, numbers = dict(self.poses), dict(self.numbers)
        for name, value in changes.items():
            if name in poses:
                position = np.array(vector(value[0], f"{name}.position"), float)
                turn = poses[name].frame if value[1] is None else np.array(rotation(value[1], f"{name}.frame"), float)
                poses[name] = Pose(position, turn)
            elif name in numbers:
                numbers[name] = float(number_array(value, name))
            else:
                raise ValueError(f"there is nothing to move named {name!r}, but {', '.join([*poses, *numbers])}")
        return Controls(poses, numbers)

    def between(self, other: "Controls", fraction: float) -> "Controls":
        """This for 0, the other for 1; frames turn about one axis."""
        if fraction >= 1.0:
            return other
        poses = {name: _pose_between(pose, other.poses[name], fraction) for name, pose in self.poses.items()}
        numbers = {
            name: (1 - fraction) * value + fraction * other.numbers[name] for name, value in self.numbers.items()
        }
        return Controls(poses, numbers)

    def distance(self, other: "Controls", sliders: Mapping[str, Slider], length: float) -> float:
        """How far apart the two are: the largest of displacements by `length`, of turns [rad], and of the ways of
        sliders by their whole way.
        """
        distances = [0.0]
        for name, pose in self.poses.items():
            there = other.poses[name]
            if pose is not there:
                distances += [
                    float(np.linalg.norm(there.position - pose.position)) / length,
                    angle_between(pose, there),
                ]
        for name, value in self.numbers.items():
            slider = sliders[name]
            distances.append(abs(other.numbers[name] - value) / (slider.high - slider.low))
        return max(distances)


def angle_between(pose: Pose, other: Pose) -> float:
    """By which one turns to the other [rad]."""
    if pose.frame is other.frame:
        return 0.0
    # Of the chord, which tells small angles where the cosine does not.
    chord = float(np.linalg.norm(other.frame - pose.frame)) / math.sqrt(8)
    return 2 * math.asin(min(chord, 1.0))


def _pose_between(pose: Pose, other: Pose, fraction: float) -> Pose:
    if pose is other:
        return pose
    position = (1 - fraction) * pose.position + fraction * other.position
    if angle_between(pose, other) == 0.0:
        return Pose(position, other.frame)
    turn = Rotation.from_matrix(other.frame @ pose.frame.T).as_rotvec()
    return Pose(position, Rotation.from_rotvec(fraction * turn).as_matrix() @ pose.frame)


# --- of a scene ------------------------------------------------------------------------------------------------------


def rods_of(scene: Scene | Harness) -> dict[str, Scene]:
    """The rods by what the names of their controls begin with: nothing where there is only one."""
    return scenes_of(scene, "{}/")


def handles_of(scene: Scene | Harness) -> dict[str, Handle]:
    """What can be taken in the hand: ends that are held, clips, obstacles of the library, and supports of joints."""
    handles = {}
    for prefix, rod in rods_of(scene).items():
        for handle in _handles_of_rod(rod):
            label = f"{prefix[:-1]}: {handle.label}" if prefix else handle.label
            handles[prefix + handle.name] = Handle(prefix + handle.name, label, handle.turns)
    for name, support in _supports(scene).items():
        handles[name] = Handle(name, name.replace("joints/", "joint "), not isinstance(support, Pin))
    return handles


def shared_obstacles(scene: Scene | Harness) -> dict[str, list[str]]:
    """The names of each obstacle, of which a harness has one for each rod beside it: by the first, all."""
    found: list[tuple[Obstacle, list[str]]] = []
    for prefix, rod in rods_of(scene).items():
        for k, obstacle in enumerate(rod.obstacles):
            name = f"{prefix}obstacles[{k}]"
            same = next((names for one, names in found if prefix and bool(eqx.tree_equal(one, obstacle))), None)
            if same is None:
                found.append((obstacle, [name]))
            else:
                same.append(name)
    return {names[0]: names for _, names in found}


def obstacle_of(scene: Scene | Harness, name: str) -> Obstacle:
    prefix, _, own = name.rpartition("/")
    return rods_of(scene)[f"{prefix}/" if prefix else ""].obstacles[_index(own)]


def _supports(scene: Scene | Harness) -> dict[str, Support]:
    """Of the joints of a harness, those that there are."""
    if isinstance(scene, Scene):
        return {}
    joints = zip(scene.joint_names, scene.bodies, strict=True)
    return {f"joints/{name}": body.support for name, body in joints if body.support is not None}


def _handles_of_rod(scene: Scene) -> list[Handle]:
    handles = []
    for name, end in (("start", scene.start), ("end", scene.end)):
        if isinstance(end, Clamp | Swivel | Pin):
            handles.append(Handle(name, f"{name} ({type(end).__name__.lower()})", not isinstance(end, Pin)))
    for k, clip in enumerate(scene.clips):
        handles.append(Handle(f"clips[{k}]", f"clip {k}", clip.direction is not None))
    for k, obstacle in enumerate(scene.obstacles):
        if _can_move(obstacle):
            label = f"obstacle {k} ({type(obstacle).__name__.lower()})"
            handles.append(Handle(f"obstacles[{k}]", label, not isinstance(obstacle, Sphere)))
    return handles


# Numbers that the rods of a harness have in common.
SHARED = ("rod.EI", "rod.GJ", "gravity")


def sliders_of(scene: Scene | Harness) -> dict[str, Slider]:
    """The numbers that have a slider; stiffnesses and gravity those of all rods of a harness together."""
    sliders = {}
    for prefix, rod in rods_of(scene).items():
        for slider in _sliders_of_rod(rod):
            if not prefix or slider.name in SHARED:
                sliders[slider.name] = slider
            else:
                name, label = prefix + slider.name, f"{prefix[:-1]}: {slider.label}"
                sliders[name] = slider._replace(name=name, label=label)
    return sliders


def _sliders_of_rod(scene: Scene) -> list[Slider]:
    rod, length = scene.rod, float(scene.rod.length)
    sliders = []
    varies = any(isinstance(leaf, Along) for leaf in jax.tree.leaves(rod, is_leaf=lambda x: isinstance(x, Along)))
    if not varies and rod.rest_centerline is None:
        sliders.append(Slider("rod.length", "length", "m", *(factor * length for factor in LENGTH_RANGE)))
    if rod.law is None:
        sliders.append(Slider("rod.EI", "bending stiffness", "times", *STIFFNESS_RANGE))
        sliders.append(Slider("rod.GJ", "torsional stiffness", "times", *STIFFNESS_RANGE))
    if scene.gravity is not None:
        sliders.append(Slider("gravity", "gravity", "times", *GRAVITY_RANGE))
    arclengths = [0.0, *(float(clip.at) for clip in scene.clips), length]
    for k, clip in enumerate(scene.clips):
        if not clip.sliding:
            before, at, after = arclengths[k : k + 3]
            # Half of the way to the neighbours, so that clips keep their order and a span its length.
            sliders.append(Slider(f"clips[{k}].at", f"clip {k} at", "m", (before + at) / 2, (at + after) / 2))
    return sliders


def controls_of(scene: Scene | Harness) -> Controls:
    """Where the handles and sliders stand."""
    poses, numbers = {}, {}
    for prefix, rod in rods_of(scene).items():
        found = _controls_of_rod(rod)
        poses |= {prefix + name: pose for name, pose in found.poses.items()}
        numbers |= {name if name in SHARED else prefix + name: number for name, number in found.numbers.items()}
    for name, support in _supports(scene).items():
        poses[name] = Pose(np.array(place_of(support), float), np.eye(3))
    return Controls(poses, numbers)


def place_of(support: Any) -> Any:
    """The position of a support [m]."""
    return place_of(support.support) if isinstance(support, Spring) else support.position


def _controls_of_rod(scene: Scene) -> Controls:
    poses = {}
    for name in (handle.name for handle in _handles_of_rod(scene)):
        if name in ("start", "end"):
            end = getattr(scene, name)
            poses[name] = Pose(np.array(end.position, float), _frame_of(end))
        elif name.startswith("clips"):
            clip = scene.clips[_index(name)]
            poses[name] = Pose(np.array(clip.position, float), _frame_of(clip))
        else:
            poses[name] = Pose(center_of(scene.obstacles[_index(name)]), np.eye(3))
    numbers = {slider.name: 1.0 for slider in _sliders_of_rod(scene)}
    for name in numbers:
        if name == "rod.length":
            numbers[name] = float(scene.rod.length)
        elif name.startswith("clips"):
            numbers[name] = float(scene.clips[_index(name)].at)
    return Controls(poses, numbers)


def _index(name: str) -> int:
    """Of `clips[2].at`: 2."""
    return int(name[name.index("[") + 1 : name.index("]")])


def _frame_of(held: Any) -> Float[np.ndarray, "3 3"]:
    """That of a support; where it holds no twist, or no direction, any that goes with what it holds."""
    if getattr(held, "frame", None) is not None:
        return np.array(held.frame, float)
    tangent = getattr(held, "tangent", None)
    if tangent is None:
        return np.eye(3)
    tangent = np.array(tangent, float)
    return np.array(frame(tangent, np.eye(3)[np.argmin(np.abs(tangent))]), float)


def scene_of(scene: Scene | Harness, controls: Controls) -> Any:
    """The scene, or harness, at controls, known or traced. Raises `ValueError` where that makes no sense, as far as it
    is known.
    """
    rods = []
    for prefix, rod in rods_of(scene).items():
        shared = (["rod.EI", "rod.GJ"] if rod.rod.law is None else []) + ([] if rod.gravity is None else ["gravity"])
        numbers = _of_rod(controls.numbers, prefix) | {name: controls.numbers[name] for name in shared}
        rods.append(_rod_scene(rod, Controls(_of_rod(controls.poses, prefix), numbers)))
    if isinstance(scene, Scene):
        return rods[0]
    supports = _supports(scene)
    joints = {}
    for name, body in zip(scene.joint_names, scene.bodies, strict=True):
        key = f"joints/{name}"
        if key in supports:
            support = _support_moved(supports[key], controls.poses[key])
            body = eqx.tree_at(lambda body: body.support, body, support)
        joints[name] = body
    return Harness(dict(zip(scene, rods, strict=True)), joints, scene.contact_names)


def _of_rod(values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Those whose names begin with its prefix, by the rest of them."""
    return {name[len(prefix) :]: value for name, value in values.items() if name.startswith(prefix)}


def _support_moved(support: Any, pose: Pose) -> Any:
    """To the position of a pose, and turned by its frame."""
    if isinstance(support, Spring):
        return eqx.tree_at(lambda spring: spring.support, support, _support_moved(support.support, pose))
    xp = namespace(support, pose)
    changes = {"position": pose.position}
    if getattr(support, "frame", None) is not None:
        changes["frame"] = pose.frame @ xp.asarray(support.frame)
    if isinstance(support, Hinge):
        changes["axis"] = pose.frame @ xp.asarray(support.axis)
    if isinstance(support, Slide):
        changes["directions"] = xp.asarray(support.directions) @ pose.frame.T
    return eqx.tree_at(
        lambda support: [getattr(support, name) for name in changes],
        support,
        [_like(getattr(support, name), value) for name, value in changes.items()],
    )


def _rod_scene(scene: Scene, controls: Controls) -> Scene:
    poses, numbers = controls.poses, controls.numbers
    clips = [_clip_at(clip, poses[f"clips[{k}]"], numbers.get(f"clips[{k}].at")) for k, clip in enumerate(scene.clips)]
    obstacles = [_obstacle_at(one, poses.get(f"obstacles[{k}]")) for k, one in enumerate(scene.obstacles)]
    return Scene(
        _rod_at(scene.rod, controls),
        _support_at(scene.start, poses.get("start")),
        _support_at(scene.end, poses.get("end")),
        _times(scene.gravity, numbers["gravity"]) if "gravity" in numbers else None,
        scene.point_forces,
        scene.turns,
        scene.distributed,
        clips,
        obstacles,
        scene.potentials,
        scene.point_couples,
        scene.self_contact,
    )


def _clip_at(clip: Clip, pose: Pose, at: float | None) -> Clip:
    tangent = None if clip.tangent is None else pose.frame[:, 2]
    frame = None if clip.frame is None else pose.frame
    return Clip(clip.at if at is None else at, pose.position, tangent, clip.sliding, frame)


def _obstacle_at(obstacle: Obstacle, pose: Pose | None) -> Obstacle:
    return obstacle if pose is None else moved(obstacle, center_of(obstacle), pose)


def _support_at(support: Support, pose: Pose | None) -> Support:
    if pose is None:
        return support
    if isinstance(support, Clamp):
        return Clamp(pose.position, pose.frame)
    return Swivel(pose.position, pose.frame[:, 2]) if isinstance(support, Swivel) else Pin(pose.position)


def _rod_at(rod: Rod, controls: Controls) -> Rod:
    numbers = controls.numbers
    if "rod.length" in numbers:
        rod = eqx.tree_at(lambda rod: rod.length, rod, _like(rod.length, numbers["rod.length"]))
    for name in ("EI", "GJ"):
        factor = numbers.get(f"rod.{name}")
        if factor is not None:
            rod = eqx.tree_at(lambda rod, name=name: getattr(rod, name), rod, _times(getattr(rod, name), factor))
    return rod


def _times(value: Any, factor: Any) -> Any:
    """A stiffness, or a pair, that may vary along the rod."""
    if isinstance(value, tuple):
        return tuple(_times(one, factor) for one in value)
    if isinstance(value, Along):
        return eqx.tree_at(lambda along: along.values, value, _times(value.values, factor))
    return _like(value, namespace(value, factor).asarray(value) * factor)


def _like(old: Any, new: Any) -> Any:
    return leaf(namespace(new).asarray(new, old.dtype))


# --- obstacles -------------------------------------------------------------------------------------------------------

_POINTS = {Plane: ("point",), Sphere: ("center",), Capsule: ("start", "end"), Cylinder: ("start", "end")}
_POINTS |= {Box: ("center",), Pipe: ("points",), Mesh: ("triangles",)}


def _can_move(obstacle: Obstacle) -> bool:
    if isinstance(obstacle, Union):
        return all(map(_can_move, obstacle.obstacles))
    return type(obstacle) in _POINTS


def center_of(obstacle: Obstacle) -> Float[np.ndarray, "3"]:
    """The middle of the points that say where an obstacle of the library is [m]."""
    if isinstance(obstacle, Union):
        xp, centers = namespace(obstacle), [center_of(part) for part in obstacle.obstacles]
        return xp.mean(xp.stack(centers), axis=0)
    xp = namespace(obstacle)
    points = [xp.asarray(getattr(obstacle, name)).reshape(-1, 3) for name in _POINTS[type(obstacle)]]
    points = xp.concatenate(points)
    return (points.min(axis=0) + points.max(axis=0)) / 2


def with_frames(obstacle: Obstacle) -> Obstacle:
    """The same with a frame for each box, so that turning one is no other structure, which would be compiled anew."""
    if isinstance(obstacle, Union):
        return Union(*map(with_frames, obstacle.obstacles))
    if isinstance(obstacle, Box) and obstacle.frame is None:
        return Box(obstacle.center, obstacle.size, np.eye(3, dtype=obstacle.size.dtype))
    return obstacle


def moved(obstacle: Obstacle, pivot: Float[np.ndarray, "3"], pose: Pose) -> Obstacle:
    """An obstacle of the library turned by the frame of a pose about a pivot, which goes to its position."""
    if isinstance(obstacle, Union):
        return Union(*(moved(part, pivot, pose) for part in obstacle.obstacles))
    names = list(_POINTS[type(obstacle)])
    xp = namespace(obstacle, pose)

    def moved_point(points: Any) -> Any:
        return xp.add(pose.position, (xp.asarray(points) - pivot) @ pose.frame.T)

    values = [moved_point(getattr(obstacle, name)) for name in names]
    if isinstance(obstacle, Plane):
        names.append("normal")
        values.append(pose.frame @ xp.asarray(obstacle.normal))
    if isinstance(obstacle, Box):
        names.append("frame")
        values.append(pose.frame if obstacle.frame is None else pose.frame @ xp.asarray(obstacle.frame))
    dtype = jax.tree.leaves(obstacle)[0].dtype
    return eqx.tree_at(
        lambda obstacle: [getattr(obstacle, name) for name in names],
        obstacle,
        [leaf(xp.asarray(value, dtype)) for value in values],
        is_leaf=lambda x: x is None,
    )
