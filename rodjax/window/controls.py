"""What a hand can move in a scene: poses of ends, clips and obstacles, and a few numbers.

`Controls` are all of it at one moment; `SceneMaker` makes the scene of them, and between two of them there are others,
so that a large move can be made in pieces.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rodjax.checks import leaf, number_array, rotation, vector
from rodjax.model.along import Along
from rodjax.model.obstacles import Box, Capsule, Cylinder, Obstacle, Pipe, Plane, Sphere, Union
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Clip, Pin, Support, Swivel, frame
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
        ways = [0.0]
        for name, pose in self.poses.items():
            there = other.poses[name]
            if pose is not there:
                ways += [float(np.linalg.norm(there.position - pose.position)) / length, angle_between(pose, there)]
        for name, value in self.numbers.items():
            slider = sliders[name]
            ways.append(abs(other.numbers[name] - value) / (slider.high - slider.low))
        return max(ways)


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


def handles_of(scene: Scene) -> dict[str, Handle]:
    """What of a scene can be taken in the hand: ends that are held, clips, and obstacles of the library."""
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
    return {handle.name: handle for handle in handles}


def sliders_of(scene: Scene) -> dict[str, Slider]:
    """The numbers of a scene that have a slider."""
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
    places = [0.0, *(float(clip.at) for clip in scene.clips), length]
    for k, clip in enumerate(scene.clips):
        if not clip.sliding:
            before, at, after = places[k : k + 3]
            # Half of the way to the neighbours, so that clips keep their order and a span its length.
            sliders.append(Slider(f"clips[{k}].at", f"clip {k} at", "m", (before + at) / 2, (at + after) / 2))
    return {slider.name: slider for slider in sliders}


def controls_of(scene: Scene) -> Controls:
    """Where the handles and sliders of a scene stand."""
    poses = {}
    for name in handles_of(scene):
        if name in ("start", "end"):
            end = getattr(scene, name)
            poses[name] = Pose(np.array(end.position, float), _frame_of(end))
        elif name.startswith("clips"):
            clip = scene.clips[_index(name)]
            poses[name] = Pose(np.array(clip.position, float), _frame_of(clip))
        else:
            poses[name] = Pose(center_of(scene.obstacles[_index(name)]), np.eye(3))
    numbers = dict.fromkeys(sliders_of(scene), 1.0)
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


class SceneMaker:
    """Makes the scene of controls; parts that have not moved since the last one are taken from there."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self._parts: dict[str, tuple[tuple, Any]] = {}

    def __call__(self, controls: Controls) -> Scene:
        """Raises `ValueError` where the scene makes no sense."""
        scene, poses, numbers = self.scene, controls.poses, controls.numbers
        of_rod = [numbers.get(f"rod.{name}") for name in ("length", "EI", "GJ")]
        clips, obstacles = [], []
        for k, clip in enumerate(scene.clips):
            pose, at = poses[f"clips[{k}]"], numbers.get(f"clips[{k}].at")
            clips.append(self._part(f"clips[{k}]", (pose, at), lambda c=clip, p=pose, at=at: _clip_at(c, p, at)))
        for k, obstacle in enumerate(scene.obstacles):
            pose = poses.get(f"obstacles[{k}]")
            obstacles.append(self._part(f"obstacles[{k}]", (pose,), lambda o=obstacle, p=pose: _obstacle_at(o, p)))
        factor = numbers.get("gravity")
        return Scene(
            self._part("rod", tuple(of_rod), lambda: _rod_at(scene.rod, controls)),
            self._part("start", (poses.get("start"),), lambda: _support_at(scene.start, poses.get("start"))),
            self._part("end", (poses.get("end"),), lambda: _support_at(scene.end, poses.get("end"))),
            self._part("gravity", (factor,), lambda: None if factor is None else _times(scene.gravity, factor)),
            scene.point_forces,
            scene.turns,
            scene.distributed,
            clips,
            obstacles,
            scene.potentials,
            scene.point_couples,
        )

    def _part(self, name: str, key: tuple, make: Callable[[], Any]) -> Any:
        last, part = self._parts.get(name, (None, None))
        is_same = last is not None and all(
            a is b or (isinstance(a, float) and a == b) for a, b in zip(key, last, strict=True)
        )
        if not is_same:
            part = make()
            self._parts[name] = key, part
        return part


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
        factor = numbers.get(f"rod.{name}", 1.0)
        if factor != 1.0:
            rod = eqx.tree_at(lambda rod, name=name: getattr(rod, name), rod, _times(getattr(rod, name), factor))
    return rod


def _times(value: Any, factor: float) -> Any:
    """A stiffness, or a pair, that may vary along the rod."""
    if isinstance(value, tuple):
        return tuple(_times(one, factor) for one in value)
    if isinstance(value, Along):
        return eqx.tree_at(lambda along: along.values, value, _times(value.values, factor))
    return _like(value, np.asarray(value) * factor)


def _like(old: Any, new: Any) -> Any:
    return leaf(np.asarray(new, old.dtype))


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
        return np.mean([center_of(part) for part in obstacle.obstacles], axis=0)
    points = [np.array(getattr(obstacle, name), float).reshape(-1, 3) for name in _POINTS[type(obstacle)]]
    points = np.concatenate(points)
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
    if np.array_equal(pose.position, pivot) and np.array_equal(pose.frame, np.eye(3)):
        return obstacle
    if isinstance(obstacle, Union):
        return Union(*(moved(part, pivot, pose) for part in obstacle.obstacles))
    names = list(_POINTS[type(obstacle)])
    values = [pose.position + (np.asarray(getattr(obstacle, name)) - pivot) @ pose.frame.T for name in names]
    if isinstance(obstacle, Plane):
        names.append("normal")
        values.append(pose.frame @ np.asarray(obstacle.normal))
    if isinstance(obstacle, Box):
        names.append("frame")
        values.append(pose.frame if obstacle.frame is None else pose.frame @ np.asarray(obstacle.frame))
    dtype = jax.tree.leaves(obstacle)[0].dtype
    return eqx.tree_at(
        lambda obstacle: [getattr(obstacle, name) for name in names],
        obstacle,
        [leaf(np.asarray(value, dtype)) for value in values],
        is_leaf=lambda x: x is None,
    )
