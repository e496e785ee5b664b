"""What is measured on a rod at rest, and how far it is from what an equilibrium says.

A measurement gives the deviations of the measured numbers from the computed ones by their standard deviations, one row
for each point, force or reading. Nuisance parameters of a rig, such as the scale of a photograph, are numbers of a
measurement, which can be unknowns as those of a scene can.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from rodjax.checks import instance, is_known, leaf, number_array, number_list, one_of, positive, shown, vector
from rodjax.model.harness import Harness, check_without_friction
from rodjax.model.scene import Scene
from rodjax.model.supports import frame, rotate
from rodjax.paths.path import stack_scenes
from rodjax.solving.guess import Guess
from rodjax.solving.harness_result import Solution
from rodjax.solving.result import Equilibrium

# Places on a rod among which the one nearest to a measured point is sought, for each segment of the mesh.
PLACES = 8
# Steps of Newton's method towards the foot of the perpendicular from there, each of which squares the distance.
FOOT_STEPS = 2


class Measurement(eqx.Module):
    """Numbers measured on one rod.

    `weights` (k,): the inverse standard deviations of its rows, 0 of what is absent, 1 where they are not known.
    `cable`: the name of the rod, of a harness.
    """

    weights: eqx.AbstractVar[Float[Array, "k"]]
    has_sd: eqx.AbstractVar[bool]
    cable: eqx.AbstractVar[str | None]

    def of_rod(self, result: Solution) -> Any:
        """The part of a result that it is of: its cable; of what names none, as a `Reading` may, the whole."""
        return result if self.cable is None or isinstance(result, Equilibrium) else result[self.cable]

    @abstractmethod
    def deviations(self, equilibrium: Equilibrium) -> Float[Array, "k d"]:
        """Measured minus computed, in the unit of the measurement."""

    @property
    @abstractmethod
    def numbers(self) -> int:
        """How many numbers each row counts for."""

    @property
    @abstractmethod
    def unit(self) -> str: ...

    @property
    @abstractmethod
    def values(self) -> Float[Array, "..."]:
        """The measured numbers."""

    @property
    def kind(self) -> Any:
        """What measurements must have in common to be stacked."""
        return jax.tree.structure(self), tuple(leaf.shape for leaf in jax.tree.leaves(self))

    @abstractmethod
    def moved(self, change: Float[Array, "k d"]) -> "Measurement":
        """With changes added to what was measured."""

    def with_rows(self, count: int) -> "Measurement":
        """With so many rows, those added of no weight, where rows are many; else itself."""
        return self


class Centerline(Measurement):
    """Points of the centerline.

    - `points`: (m, 3) [m], or (m, 2) as a `camera` sees them. A part of the rod is enough.
    - `s`: (m,) their arclengths [m]; `None` where these are not known: what counts then is the distance from the curve.
    - `sd`: standard deviation of each coordinate, a number or (m,), [m], with a `camera` in its unit; `None`: the same
      for all points and unknown, which takes that all measurements of a fit are so.
    - `camera`: (3, 4) matrix that maps (x, y, z, 1) to (u w, v w, w), such as `rodjax.orthographic` or `rodjax.pinhole`
      give.
    - Nuisance parameters of the rig, which the fit can take for unknowns: what is measured is `scale` times the
      position in the scene, turned by the rotation vector `turn` [rad] and moved by `offset` [m]; `s` is too small by
      `shift` [m].
    - `cable`: of a harness the name of the rod.

    Raises `ValueError` or `TypeError` for shapes and numbers that make no sense.
    """

    points: Float[Array, "m d"]
    s: Float[Array, "m"] | None
    weights: Float[Array, "m"]
    camera: Float[Array, "3 4"] | None
    scale: Float[Array, ""]
    turn: Float[Array, "3"]
    offset: Float[Array, "3"]
    shift: Float[Array, ""]
    has_sd: bool = eqx.field(static=True)
    cable: str | None = eqx.field(static=True)

    def __init__(
        self,
        points: Any,
        s: Any = None,
        sd: Any = None,
        *,
        camera: Any = None,
        scale: Any = 1.0,
        turn: Any = (0.0, 0.0, 0.0),
        offset: Any = (0.0, 0.0, 0.0),
        shift: Any = 0.0,
        cable: str | None = None,
    ):
        shape = np.shape(points)
        components = 3 if camera is None else 2
        if len(shape) != 2 or shape[0] < 1 or shape[1] != components:
            kind = "(m, 3)" if camera is None else "(m, 2), as there is a camera,"
            raise ValueError(f"points must have the shape {kind} with m >= 1, got {shape}")
        self.points = leaf(number_array(points, "points", shape))
        self.s = None if s is None else leaf(_of_length(s, "s", shape[0]))
        if s is not None and is_known(self.s) and np.any(np.asarray(self.s) < 0):
            raise ValueError(f"s must not be negative, got {float(np.min(np.asarray(self.s))):g} m")
        self.weights = _weights(sd, shape[0])
        self.camera = None if camera is None else leaf(number_array(camera, "camera", (3, 4)))
        self.scale = leaf(positive(scale, "scale"))
        self.turn = leaf(vector(turn, "turn"))
        self.offset = leaf(vector(offset, "offset"))
        self.shift = leaf(number_array(shift, "shift"))
        self.has_sd = sd is not None
        self.cable = _cable(cable)

    @property
    def numbers(self) -> int:
        # A point beside a curve of unknown arclength tells nothing along the curve.
        return self.points.shape[-1] - (self.s is None)

    @property
    def unit(self) -> str:
        return "m" if self.is_affine else "px"

    @property
    def values(self) -> Float[Array, "m d"]:
        return self.points

    @property
    def kind(self) -> Any:
        return jax.tree.structure(self), self.points.shape[1]

    def moved(self, change: Float[Array, "m d"]) -> "Centerline":
        return eqx.tree_at(lambda measured: measured.points, self, self.points + change)

    def with_rows(self, count: int) -> "Centerline":
        if count == len(self.weights):
            return self
        rows = np.minimum(np.arange(count), len(self.weights) - 1)
        weights = np.asarray(self.weights)[rows] * (np.arange(count) < len(self.weights))
        new = [leaf(np.asarray(self.points)[rows]), leaf(weights)]
        picked = eqx.tree_at(lambda measured: [measured.points, measured.weights], self, new)
        if self.s is None:
            return picked
        return eqx.tree_at(lambda measured: measured.s, picked, leaf(np.asarray(self.s)[rows]))

    @property
    def is_affine(self) -> bool:
        """Whether what is measured is a linear function of the positions, but for a constant."""
        return self.camera is None or bool(np.all(np.asarray(self.camera)[2] == (0, 0, 0, 1)))

    def lifted(self, through: Float[np.ndarray, "3"]) -> Float[np.ndarray, "m 3"]:
        """The points in the scene, where `is_affine`; those of a picture at the depth of a point of the scene."""
        linear = float(self.scale) * Rotation.from_rotvec(np.array(self.turn)).as_matrix()
        constant = np.asarray(self.offset)
        if self.camera is not None:
            camera = np.asarray(self.camera)
            linear, constant = camera[:2, :3] @ linear, camera[:2, :3] @ constant + camera[:2, 3]
        beyond = np.asarray(self.points) - (linear @ through + constant)
        return through + beyond @ np.linalg.pinv(linear).T

    def seen(self, positions: Float[Array, "k 3"]) -> Float[Array, "k d"]:
        """Positions in the scene as the rig measures them."""
        placed = self.scale * positions @ rotate(jnp.eye(3, dtype=positions.dtype), self.turn).T + self.offset[None]
        if self.camera is None:
            return placed
        homogeneous = placed @ self.camera[:, :3].T + self.camera[:, 3][None]
        return homogeneous[:, :2] / homogeneous[:, 2:]

    def deviations(self, equilibrium: Equilibrium) -> Float[Array, "m d"]:
        if self.s is not None:
            return self.points - self.seen(equilibrium.position_at(self.s + self.shift))

        def curve(s: Float[Array, "k"]) -> Float[Array, "k d"]:
            return self.seen(equilibrium.position_at(s))

        foot, along = jax.lax.stop_gradient(_feet(curve, self.points, equilibrium.scene.rod.length, equilibrium.s))
        across = self.points - curve(foot)
        return across - jnp.sum(across * along, axis=1, keepdims=True) * along


def _feet(
    curve: Callable[[Array], Array], points: Float[Array, "m d"], length: Float[Array, ""], nodes: Float[Array, "n+1"]
) -> tuple[Float[Array, "m"], Float[Array, "m d"]]:
    """The arclengths of the feet of the perpendiculars from points to a curve, and its unit tangents there."""
    grid = jnp.linspace(0.0, 1.0, PLACES * (len(nodes) - 1) + 1, dtype=length.dtype) * length
    squares = jnp.sum((points[:, None] - curve(grid)[None]) ** 2, axis=-1)
    foot = grid[jnp.argmin(squares, axis=1)]
    for _ in range(FOOT_STEPS):
        here, slope = jax.jvp(curve, (foot,), (jnp.ones_like(foot),))
        foot += jnp.sum((points - here) * slope, axis=1) / jnp.sum(slope**2, axis=1)
        foot = jnp.clip(foot, 0.0, length)
    _, slope = jax.jvp(curve, (foot,), (jnp.ones_like(foot),))
    # Beyond an end the distance from the end counts, in all directions.
    is_inside = (foot > 0) & (foot < length)
    along = slope / jnp.sqrt(jnp.sum(slope**2, axis=1, keepdims=True))
    return foot, jnp.where(is_inside[:, None], along, 0.0)


class _EndLoad(Measurement):
    value: Float[Array, "k"]
    direction: Float[Array, "3"] | None
    weights: Float[Array, "1"]
    end: str = eqx.field(static=True)
    has_sd: bool = eqx.field(static=True)
    cable: str | None = eqx.field(static=True)

    def __init__(self, value: Any, sd: Any, end: str, direction: Any, cable: str | None):
        self.value = leaf(vector(value, "value") if direction is None else number_array(value, "value").reshape(1))
        self.direction = None if direction is None else leaf(vector(direction, "direction"))
        one_of(end, "end", ("start", "end"))
        self.weights = _weights(sd, 1)
        self.end = end
        self.has_sd = sd is not None
        self.cable = _cable(cable)

    @property
    def numbers(self) -> int:
        return self.value.shape[-1]

    @property
    def values(self) -> Float[Array, "k"]:
        return self.value

    def moved(self, change: Float[Array, "1 k"]) -> "_EndLoad":
        return eqx.tree_at(lambda measured: measured.value, self, self.value + change[0])

    @abstractmethod
    def computed(self, equilibrium: Equilibrium) -> Float[Array, "3"]: ...

    def deviations(self, equilibrium: Equilibrium) -> Float[Array, "1 k"]:
        computed = self.computed(equilibrium)
        # What the support applies to the rod.
        computed = computed if self.end == "end" else -computed
        if self.direction is not None:
            computed = jnp.sum(self.direction * computed)[None]
        return (self.value - computed)[None]


class EndForce(_EndLoad):
    """The force (3,) [N] that a support applies to the rod, `end`: `"start"` or `"end"`.

    `direction` (3,): that in which a load cell measures; the force is then one number. `sd`: standard deviation of each
    component [N], `None` as in `Centerline`. `cable`: of a harness the name of the rod.
    """

    def __init__(
        self, value: Any, sd: Any = None, *, end: str = "end", direction: Any = None, cable: str | None = None
    ):
        super().__init__(value, sd, end, direction, cable)

    def computed(self, equilibrium: Equilibrium) -> Float[Array, "3"]:
        return equilibrium.end_force if self.end == "end" else equilibrium.start_force

    @property
    def unit(self) -> str:
        return "N"


class EndMoment(_EndLoad):
    """The moment (3,) [N m] about the centerline that a support applies to the rod; otherwise as `EndForce`."""

    def __init__(
        self, value: Any, sd: Any = None, *, end: str = "end", direction: Any = None, cable: str | None = None
    ):
        super().__init__(value, sd, end, direction, cable)

    def computed(self, equilibrium: Equilibrium) -> Float[Array, "3"]:
        return equilibrium.end_moment if self.end == "end" else equilibrium.start_moment

    @property
    def unit(self) -> str:
        return "N m"


class Reading(Measurement):
    """Anything else that an equilibrium tells: `of(equilibrium)` gives numbers (k,), or one, to compare with `value`.

    `of`: a function in JAX, the same object for all experiments of a kind; `unit`: for the report; `cable`: of a
    harness the name of the rod whose `Equilibrium` it takes, `None`: it takes the `HarnessEquilibrium`.
    """

    value: Float[Array, "k"]
    weights: Float[Array, "k"]
    of: Callable[[Any], Any] = eqx.field(static=True)
    quantity: str = eqx.field(static=True)
    has_sd: bool = eqx.field(static=True)
    cable: str | None = eqx.field(static=True)

    def __init__(
        self, of: Callable[[Any], Any], value: Any, sd: Any = None, *, unit: str = "", cable: str | None = None
    ):
        if not callable(of):
            raise TypeError(f"of must be a function of an Equilibrium, got {shown(of)}")
        self.of = of
        self.value = leaf(number_list(value, "value"))
        self.weights = _weights(sd, len(self.value))
        self.quantity = unit
        self.has_sd = sd is not None
        self.cable = _cable(cable)

    @property
    def numbers(self) -> int:
        return 1

    @property
    def unit(self) -> str:
        return self.quantity

    @property
    def values(self) -> Float[Array, "k"]:
        return self.value

    def moved(self, change: Float[Array, "k 1"]) -> "Reading":
        return eqx.tree_at(lambda measured: measured.value, self, self.value + change[:, 0])

    def deviations(self, equilibrium: Any) -> Float[Array, "k 1"]:
        return (self.value - jnp.reshape(self.of(equilibrium), self.value.shape))[:, None]


class Experiment(eqx.Module):
    """A rod or harness at rest and what was measured on it.

    - `scene`: `Scene` or `Harness`, as nominal; unknowns replace numbers of it.
    - `measured`: one measurement or a list: `Centerline`, `EndForce`, `EndMoment`, `Reading`; in a harness each names
      its `cable`.
    - `cluster`: name of the repeat, day or specimen, whose measurements share their errors; `None`: the experiment is a
      cluster of its own.
    - `guess`: `Guess` for the first solve; `None`: the measured centerline, where it has arclengths, three coordinates
      and spans nine tenths of the rod, else the library's own, which is that of a harness too.
    - `name`: for the report.
    """

    scene: Any  # a `Scene` or `Harness`
    measured: tuple[Measurement, ...]
    guess: Guess | None
    cluster: str | None = eqx.field(static=True)
    name: str | None = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene | Harness,
        measured: Measurement | Sequence[Measurement],
        *,
        cluster: Any = None,
        guess: Guess | None = None,
        name: str | None = None,
    ):
        instance(scene, "scene", (Scene, Harness))
        length = (scene.scenes[0] if isinstance(scene, Harness) else scene).rod.length
        if length.ndim:
            raise ValueError(f"scene must be a single one, got a stack of shape {length.shape}")
        check_without_friction(scene, "an Experiment")
        measured = (measured,) if isinstance(measured, Measurement) else tuple(measured)
        if not measured:
            raise ValueError("measured must hold at least one measurement, got none")
        for k, measurement in enumerate(measured):
            instance(measurement, f"measured[{k}]", Measurement)
            _check_arclengths(measurement, _scene_of(measurement, scene, k), k)
        if guess is not None:
            instance(guess, "guess", Guess)
            if isinstance(scene, Harness):
                raise ValueError("guess must be None for a harness, whose first shape is the library's own")
        self.scene = scene
        self.measured = measured
        self.guess = guess
        self.cluster = None if cluster is None else str(cluster)
        self.name = name


class CriticalValue(eqx.Module):
    """A measured parameter at which a rod becomes unstable.

    - `scenes`: two or more, between which the parameter runs from 0 on as for `rodjax.critical_point`.
    - `value`: of the parameter, as measured; `sd`: its standard deviation.
    - `options`: of `rodjax.critical_point`, such as `start`.

    `cluster`, `name`: as for `Experiment`.
    """

    scenes: Scene
    value: Float[Array, ""]
    sd: Float[Array, ""]
    options: tuple[tuple[str, Any], ...] = eqx.field(static=True)
    cluster: str | None = eqx.field(static=True)
    name: str | None = eqx.field(static=True)

    def __init__(
        self,
        scenes: Sequence[Scene] | Scene,
        value: Any,
        sd: Any,
        *,
        cluster: Any = None,
        name: str | None = None,
        **options: Any,
    ):
        self.scenes = stack_scenes(scenes)
        self.value = leaf(number_array(value, "value"))
        self.sd = leaf(positive(sd, "sd"))
        self.options = tuple(options.items())
        self.cluster = None if cluster is None else str(cluster)
        self.name = name


def orthographic(right: Any, down: Any, origin: Any = (0.0, 0.0, 0.0)) -> Float[Array, "3 4"]:
    """The camera far away that sees (u, v) [m], the components along `right` and `down` (3,) from `origin` (3,) [m]."""
    axes = np.stack([frame(right, down)[:, 2], frame(right, down)[:, 1]])
    rows = np.concatenate([axes, -(axes @ np.asarray(vector(origin, "origin")))[:, None]], axis=1)
    return leaf(np.concatenate([rows, [[0.0, 0.0, 0.0, 1.0]]]))


def pinhole(position: Any, view: Any, down: Any, focal_length: Any, center: Any = (0.0, 0.0)) -> Float[Array, "3 4"]:
    """A camera at `position` (3,) [m] that looks along `view` (3,), with `down` (3,) downwards in its image.

    `focal_length` [px]; `center` (2,) [px], the pixel on the axis. Without distortion.
    """
    axes = np.asarray(frame(view, down))  # columns: to the right, down, along the view
    f = float(positive(focal_length, "focal_length"))
    u, v = np.asarray(number_array(center, "center", (2,)))
    inner = np.array([[f, 0.0, u], [0.0, f, v], [0.0, 0.0, 1.0]])
    outer = np.concatenate([axes.T, -(axes.T @ np.asarray(vector(position, "position")))[:, None]], axis=1)
    return leaf(inner @ outer)


def _weights(sd: Any, count: int) -> Float[Array, "count"]:
    if sd is None:
        return leaf(np.ones(count, jax.dtypes.canonicalize_dtype(float)))
    values = np.asarray(number_array(sd, "sd", np.shape(sd)))
    if values.shape not in ((), (count,)):
        raise ValueError(f"sd must be a number or {count} of them, got an array of shape {values.shape}")
    if not np.all(values > 0):
        raise ValueError(f"sd must be positive, got {float(np.min(values)):g}")
    return leaf(np.broadcast_to(1 / values, (count,)).copy())


def _of_length(value: Any, name: str, count: int) -> Float[Array, "count"]:
    numbers = number_list(value, name)
    if numbers.shape != (count,):
        raise ValueError(f"{name} must hold {count} numbers, one for each point, got {numbers.shape[0]}")
    return leaf(numbers)


def _cable(name: Any) -> str | None:
    if name is not None:
        instance(name, "cable", str)
    return name


def _scene_of(measurement: Measurement, scene: Scene | Harness, k: int) -> Scene | None:
    """Of the rod on which it was measured; of the whole harness none."""
    name = measurement.cable
    if isinstance(scene, Scene):
        if name is not None:
            raise ValueError(f"measured[{k}].cable must be None for a Scene, which has one, got {name!r}")
        return scene
    if name is None and isinstance(measurement, Reading):
        return None
    if name not in scene.names:
        raise ValueError(f"measured[{k}].cable must be one of {', '.join(map(repr, scene.names))}, got {name!r}")
    return scene[name]


def _check_arclengths(measurement: Measurement, scene: Scene | None, k: int) -> None:
    if scene is None:
        return
    if isinstance(measurement, Centerline) and measurement.s is not None and is_known(measurement.s, scene.rod.length):
        largest, length = float(np.max(np.asarray(measurement.s))), float(scene.rod.length)
        if largest > length * (1 + 1e-9):
            raise ValueError(f"measured[{k}].s must lie in 0 to {length:g} m, got {largest:g} m")
