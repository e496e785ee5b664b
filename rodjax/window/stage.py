"""The three-dimensional part of the window: the rod, its loads, obstacles and handles, as nodes of a viser scene."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rodjax.checks import leaf
from rodjax.model.along import Along
from rodjax.model.surfaces import surfaces
from rodjax.plot import largest_radius, radius_along
from rodjax.window import tube
from rodjax.window.controls import Pose, center_of
from rodjax.window.reading import Reading
from rodjax.window.session import Session

# By the length of the rod: the least radius that can be seen, that of a rod without one, the longest arrow, and the
# size of handles. By the extent of what is seen: how far away the camera is, and how far the panel moves the middle.
LEAST_RADIUS, DEFAULT_RADIUS, ARROW, HANDLE = 0.002, 0.004, 0.15, 0.1
CAMERA, PANEL = 0.95, 0.18
# Below these parts of EI/L^2 and EI/L forces and moments are rounding.
LEAST_LOAD = 1e-6
# Of Okabe and Ito, told apart by all eyes: forces, moments.
FORCE_COLOR, MOMENT_COLOR, OBSTACLE_COLOR, CAP_COLOR = (213, 94, 0), (0, 114, 178), (150, 155, 160), (120, 120, 120)

Moved = Callable[[str, Pose, str], None]


class Stage:
    """Draws what a session shows. `server`: of viser; `moved`: called with the name of a handle that is dragged, its
    pose, and "start", "update" or "end".
    """

    def __init__(self, server: Any, session: Session, moved: Moved):
        self.server, self.session = server, session
        self.length = float(session.scene.rod.length)
        self.parts: dict[str, Any] = {}
        self.obstacles: dict[str, Any] = {}
        self.placed = dict(session.now.controls.poses)  # where obstacles are drawn
        self.handles = {name: self._handle(name, moved) for name in session.handles}
        self.arrows: dict[str, Any] = {}
        self._draw_obstacles()
        points = session.reading.centerline
        low, high = points.min(axis=0), points.max(axis=0)
        extent = max(float(np.linalg.norm(high - low)), 0.2 * self.length)
        # The panel hides the right of the picture.
        middle = (low + high) / 2 + PANEL * extent * np.array([1.0, 0.0, 0.0])
        server.initial_camera.look_at = tuple(middle)
        server.initial_camera.position = tuple(middle + CAMERA * extent * np.array([0.0, -0.92, 0.4]))
        server.initial_camera.near = 1e-3 * self.length
        server.initial_camera.far = 1e3 * self.length

    # --- the rod ---

    @property
    def note(self) -> str:
        """Where the rod is not drawn as thick as it is."""
        radius = self.session.scene.rod.radius
        if radius is None:
            return "The rod has no radius; it is drawn with one."
        times = self._radius() / largest_radius(radius)
        return "" if times == 1 else f"The rod is drawn {times:.2g} times as thick as it is."

    def _radius(self) -> float:
        radius = self.session.scene.rod.radius
        return (
            DEFAULT_RADIUS * self.length if radius is None else max(largest_radius(radius), LEAST_RADIUS * self.length)
        )

    def _radii(self, reading: Reading) -> float | Float[np.ndarray, "k"]:
        radius, thickest = self.session.scene.rod.radius, self._radius()
        if not isinstance(radius, Along):
            return thickest
        return thickest / largest_radius(radius) * radius_along(radius, leaf(reading.s))

    def draw(self, reading: Reading, quantity: str, scale: tube.Scale) -> None:
        """The rod, coloured by a quantity."""
        surface = tube.Surface(reading.centerline, reading.d1, reading.d2, self._radii(reading))
        shown = {f"/rod/strip {k}": part for k, part in enumerate(surface.strips)}
        shown["/rod/caps"] = surface.caps
        for k, part in enumerate(surface.bands(reading.values[quantity], scale)):
            shown[f"/rod/band {k}"] = part
        for name in set(self.parts) - set(shown):
            self.parts.pop(name).remove()
        for name, part in shown.items():
            self._show_part(name, part, self._color(name, scale))

    @staticmethod
    def _color(name: str, scale: tube.Scale) -> tuple[int, int, int]:
        if name == "/rod/caps":
            return CAP_COLOR
        k = int(name.split()[-1])
        red, green, blue = tube.STRIP_COLORS[k] if "strip" in name else scale.colors[k]
        return int(red), int(green), int(blue)

    def _show_part(self, name: str, part: tube.Part, color: tuple[int, int, int]) -> None:
        if name not in self.parts:
            self.parts[name] = self.server.scene.add_mesh_simple(
                name, part.vertices, part.faces, color=color, cast_shadow=False, receive_shadow=False
            )
            return
        drawn = self.parts[name]
        drawn.vertices = part.vertices
        if drawn.color != color:
            drawn.color = color
        if drawn.faces.shape != part.faces.shape or not np.array_equal(drawn.faces, part.faces):
            drawn.faces = part.faces

    # --- loads ---

    def draw_loads(self, reading: Reading, visible: bool) -> None:
        """Arrows for the forces on the rod, and two-headed ones for the moments at its ends."""
        units = self.session.result.state.units
        self._arrows("forces", reading.feet, reading.forces, float(units.force), FORCE_COLOR, (1.0,), visible)
        self._arrows(
            "moments", reading.feet[:2], reading.moments, float(units.energy), MOMENT_COLOR, (1.0, 0.8), visible
        )

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
            drawn.points, drawn.visible = points, visible
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
        obstacles = self.session.scene.obstacles
        for k, faces in enumerate(surfaces(obstacles, self.session.reading.centerline) if obstacles else []):
            name = f"obstacles[{k}]"
            pivot = center_of(obstacles[k]) if name in self.session.handles else np.zeros(3)
            vertices = (faces.reshape(-1, 3) - pivot).astype(np.float32)
            first = 4 * np.arange(len(faces))[:, None]
            triangles = (first + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3).astype(np.uint32)
            self.obstacles[name] = self.server.scene.add_mesh_simple(
                f"/obstacles/{k}", vertices, triangles, color=OBSTACLE_COLOR, opacity=0.65, flat_shading=True,
                side="double", position=tuple(pivot), cast_shadow=False, receive_shadow=False,
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
            if handles:
                _place(self.handles[name], pose)

    def show_handles(self, visible: bool) -> None:
        for drawn in self.handles.values():
            drawn.visible = visible


def _place(drawn: Any, pose: Pose) -> None:
    drawn.position, drawn.wxyz = tuple(pose.position), quaternion(pose.frame)


def quaternion(frame: Float[np.ndarray, "3 3"]) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rotation matrix."""
    x, y, z, w = Rotation.from_matrix(frame).as_quat()
    return float(w), float(x), float(y), float(z)


def matrix(wxyz: Any) -> Float[np.ndarray, "3 3"]:
    w, x, y, z = (float(number) for number in wxyz)
    return Rotation.from_quat([x, y, z, w]).as_matrix()
