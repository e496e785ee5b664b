"""The three-dimensional part of the window: rods, their loads, obstacles and handles, as nodes of a viser scene."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rodjax.drawing import largest_radius
from rodjax.model.obstacles import Obstacle
from rodjax.model.surfaces import surfaces
from rodjax.window import tube
from rodjax.window.controls import Pose, center_of, obstacle_of, rods_of
from rodjax.window.reading import Pieces, Reading
from rodjax.window.session import Session

# By the length of the rod: the least radius that can be seen, that of a rod without one, the longest arrow, and the
# size of handles. By the extent of what is seen: how far away the camera is, and how far the panel moves the middle.
LEAST_RADIUS, DEFAULT_RADIUS, ARROW, HANDLE = 0.002, 0.004, 0.15, 0.1
CAMERA, PANEL = 0.8, 0.16
# By the largest radius, that of a joint; and how pale other shapes are.
JOINT, FAN_OPACITY, DARK_FAN_OPACITY = 1.6, 0.18, 0.3
# Scales that differ by less look the same.
SAME_SCALE = 0.01
# Below these parts of EI/L^2 and EI/L forces and moments are rounding.
LEAST_LOAD = 1e-6
# Of Okabe and Ito, told apart by all eyes: forces, moments.
FORCE_COLOR, MOMENT_COLOR, OBSTACLE_COLOR, JOINT_COLOR = (213, 94, 0), (0, 114, 178), (150, 155, 160), (120, 120, 120)
# Of other shapes, on a light and on a dark page.
FAN_COLOR, DARK_FAN_COLOR = (110, 120, 130), (215, 222, 230)

Moved = Callable[[str, Pose, str], None]


class Stage:
    """Draws what a session shows. `server`: of viser; `moved`: called with the name of a handle that is dragged, its
    pose, and "start", "update" or "end".
    """

    def __init__(self, server: Any, session: Session, moved: Moved):
        self.server, self.session = server, session
        self.rods = [scene.rod for scene in rods_of(session.scene).values()]
        self.length = session.length
        # As many times as thick as they are.
        self.thickness = np.array(
            [
                self._radius(rod.radius) / (1.0 if rod.radius is None else largest_radius(rod.radius))
                for rod in self.rods
            ],
            np.float32,
        )
        self.force = max(float(rod.bending_scale) for rod in self.rods) / self.length**2  # EI/L^2
        self.meshes: dict[str, Any] = {}
        self.joints: Any = None
        self.obstacles: dict[str, Any] = {}
        self.placed = dict(session.now.controls.poses)  # where obstacles are drawn
        self.handles = {name: self._handle(name, moved) for name in session.handles}
        self.arrows: dict[str, Any] = {}
        self._draw_obstacles()
        self._draw_beside()
        points = np.concatenate([reading.centerline for reading in session.readings])
        low, high = points.min(axis=0), points.max(axis=0)
        extent = max(float(np.linalg.norm(high - low)), 0.2 * self.length)
        # The panel hides the right of the picture.
        middle = (low + high) / 2 + PANEL * extent * np.array([1.0, 0.0, 0.0])
        server.initial_camera.look_at = tuple(middle)
        server.initial_camera.position = tuple(middle + CAMERA * extent * np.array([0.0, -0.92, 0.4]))
        server.initial_camera.near = 1e-2 * self.length
        server.initial_camera.far = 1e2 * self.length

    # --- the rods ---

    @property
    def note(self) -> str:
        """Where rods are not drawn as thick as they are."""
        if any(rod.radius is None for rod in self.rods):
            return "A rod without a radius is drawn with one."
        times = np.max(self.thickness)
        return "" if times == 1 else f"The thinnest rod is drawn {times:.2g} times as thick as it is."

    def _radius(self, radius: Any) -> float:
        """With which a rod is drawn that has this one."""
        if radius is None:
            return DEFAULT_RADIUS * self.length
        return max(largest_radius(radius), LEAST_RADIUS * self.length)

    def _pieces(self, readings: Sequence[Reading]) -> Pieces:
        """Of all rods."""
        positions, wxyzs, scales = map(np.concatenate, zip(*(reading.pieces for reading in readings), strict=True))
        counts = [len(reading.pieces.positions) for reading in readings]
        scales[:, :2] *= np.repeat(self.thickness, counts)[:, None]
        return Pieces(positions, wxyzs, scales)

    def draw(self, readings: Sequence[Reading], quantity: str, scale: tube.Scale) -> None:
        """The rods, coloured by a quantity."""
        pieces = self._pieces(readings)
        colors = [tube.colors_of(reading.values[quantity], scale) for reading in readings]
        colors = tube.as_light(np.concatenate(colors))
        both = Pieces(
            np.concatenate([pieces.positions] * 2),
            np.concatenate([pieces.wxyzs, tube.half_turned(np.asarray(pieces.wxyzs))]),
            np.concatenate([pieces.scales] * 2),
        )
        if not self.meshes:
            strips = np.repeat(tube.as_light(np.array(tube.STRIP_COLORS)), len(colors), axis=0)
            self.meshes = {
                "tube": self._batched("/rods/tube", tube.cylinder(), pieces, colors),
                "strips": self._batched("/rods/strips", tube.strip(), both, strips),
            }
            return
        _move_to(self.meshes["tube"], pieces)
        _move_to(self.meshes["strips"], both)
        if not np.array_equal(self.meshes["tube"].batched_colors, colors):
            self.meshes["tube"].batched_colors = colors

    def _batched(self, name: str, mesh: tube.Faces, pieces: Pieces, colors: Any, **more: Any) -> Any:
        return self.server.scene.add_batched_meshes_simple(
            name, mesh.vertices, mesh.faces, pieces.wxyzs, pieces.positions, batched_scales=pieces.scales,
            batched_colors=colors, lod="off", cast_shadow=False, receive_shadow=False, **more,
        )  # fmt: skip

    def draw_fan(self, many: Sequence[Sequence[Reading]], is_dark: bool) -> None:
        """Other shapes of the rods, pale, on a light or a dark page; none where there are none."""
        fan = self.meshes.pop("fan", None)
        if fan is not None:
            fan.remove()
        if many:
            pieces = Pieces(*map(np.concatenate, zip(*map(self._pieces, many), strict=True)))
            color, opacity = (DARK_FAN_COLOR, DARK_FAN_OPACITY) if is_dark else (FAN_COLOR, FAN_OPACITY)
            self.meshes["fan"] = self._batched(
                "/fan", tube.cylinder(), pieces, tube.as_light(np.array(color)), opacity=opacity
            )

    def draw_joints(self, positions: Float[np.ndarray, "j 3"]) -> None:
        """The bodies in which rods of a harness meet."""
        size = JOINT * max(self._radius(rod.radius) for rod in self.rods)
        count = len(positions)
        turns = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1))
        pieces = Pieces(positions.astype(np.float32), turns, np.full((count, 3), size, np.float32))
        if self.joints is None:
            self.joints = self._batched("/joints", tube.ball(), pieces, tube.as_light(np.array(JOINT_COLOR)))
        else:
            self.joints.batched_positions = pieces.positions

    # --- loads ---

    def draw_loads(self, readings: Sequence[Reading], visible: bool) -> None:
        """Arrows for the forces on the rods, and two-headed ones for the moments at their ends."""
        feet, forces = (np.concatenate([getattr(one, name) for one in readings]) for name in ("feet", "forces"))
        ends, moments = np.concatenate([one.feet[:2] for one in readings]), [one.moments for one in readings]
        self._arrows("forces", feet, forces, self.force, FORCE_COLOR, (1.0,), visible)
        moment = self.force * self.length
        self._arrows("moments", ends, np.concatenate(moments), moment, MOMENT_COLOR, (1.0, 0.8), visible)

    def _arrows(self, name: str, feet, loads, unit: float, color, heads: tuple[float, ...], visible: bool) -> None:
        sizes = np.linalg.norm(loads, axis=1)
        is_seen = sizes > LEAST_LOAD * unit
        lines = [np.zeros((0, 2, 3))]
        if is_seen.any():
            feet, along = feet[is_seen], loads[is_seen] * (ARROW * self.length / np.max(sizes))
            lines += [np.stack([feet, feet + head * along], axis=1) for head in heads]
        points = np.concatenate(lines).astype(np.float32)
        drawn = self.arrows.get(name)
        if drawn is not None and len(drawn.points) == len(points):
            drawn.points = points
            if drawn.visible != visible:
                drawn.visible = visible
            return
        if drawn is not None:
            drawn.remove()
        size = ARROW * self.length
        self.arrows[name] = self.server.scene.add_arrows(
            f"/loads/{name}", points, color, shaft_radius=0.02 * size, head_radius=0.06 * size, head_length=0.16 * size,
            visible=visible,
        )  # fmt: skip

    # --- obstacles and handles ---

    def _draw_obstacles(self) -> None:
        obstacles = self._obstacles_of_scene()
        around = np.concatenate([reading.centerline for reading in self.session.readings])
        drawn = surfaces(list(obstacles.values()), around) if obstacles else []
        for (name, obstacle), faces in zip(obstacles.items(), drawn, strict=True):
            pivot = center_of(obstacle) if name in self.session.handles else np.zeros(3)
            self.obstacles[name] = self._obstacle(f"/obstacles/{name}", faces, pivot)

    def _obstacles_of_scene(self) -> dict[str, Obstacle]:
        return {name: obstacle_of(self.session.scene, name) for name in self.session.obstacles}

    def _draw_beside(self) -> None:
        """Obstacles that do not touch the rods, and stay where they are; those of the scene are drawn already."""
        of_scene = self._obstacles_of_scene().values()
        beside = [one for one in self.session.beside.values() if not any(eqx.tree_equal(one, o) for o in of_scene)]
        around = np.concatenate([reading.centerline for reading in self.session.readings])
        for k, faces in enumerate(surfaces(beside, around) if beside else []):
            self._obstacle(f"/beside/{k}", faces, np.zeros(3))

    def _obstacle(self, name: str, faces: Float[np.ndarray, "f 4 3"], pivot: Float[np.ndarray, "3"]) -> Any:
        vertices = (faces.reshape(-1, 3) - pivot).astype(np.float32)
        first = 4 * np.arange(len(faces))[:, None]
        triangles = (first + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3).astype(np.uint32)
        return self.server.scene.add_mesh_simple(
            name, vertices, triangles, color=OBSTACLE_COLOR, opacity=0.65, flat_shading=True, side="double",
            position=tuple(pivot), cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _handle(self, name: str, moved: Moved) -> Any:
        handle, pose = self.session.handles[name], self.session.now.controls.poses[name]
        drawn = self.server.scene.add_transform_controls(
            f"/handles/{name}", scale=HANDLE * self.length, disable_rotations=not handle.turns, depth_test=False,
            opacity=0.8, position=tuple(pose.position), wxyz=quaternion(pose.frame),
        )  # fmt: skip

        async def dragged(event: Any) -> None:
            # Here, not in a thread of a pool, in which moves would overtake one another.
            moved(name, Pose(np.array(event.target.position, float), matrix(event.target.wxyz)), event.phase)

        drawn.on_update(dragged)
        return drawn

    def place(self, handles: bool) -> None:
        """Obstacles, and handles where these too shall go, to where the session has them."""
        for name, pose in self.session.now.controls.poses.items():
            if name in self.obstacles and pose is not self.placed.get(name):
                _place(self.obstacles[name], pose)
                self.placed[name] = pose
            if handles and name in self.handles:
                _place(self.handles[name], pose)

    def show_handles(self, visible: bool) -> None:
        for drawn in self.handles.values():
            drawn.visible = visible


def _move_to(mesh: Any, pieces: Pieces) -> None:
    mesh.batched_positions, mesh.batched_wxyzs = pieces.positions, pieces.wxyzs
    if np.max(np.abs(pieces.scales - mesh.batched_scales) - SAME_SCALE * pieces.scales) > 0:
        mesh.batched_scales = pieces.scales


def _place(drawn: Any, pose: Pose) -> None:
    drawn.position, drawn.wxyz = tuple(pose.position), quaternion(pose.frame)


def quaternion(frame: Float[np.ndarray, "3 3"]) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rotation matrix."""
    x, y, z, w = Rotation.from_matrix(frame).as_quat()
    return float(w), float(x), float(y), float(z)


def matrix(wxyz: Any) -> Float[np.ndarray, "3 3"]:
    w, x, y, z = (float(number) for number in wxyz)
    return Rotation.from_quat([x, y, z, w]).as_matrix()
