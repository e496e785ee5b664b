"""Scenes of every class that files hold, with random sizes of every array: to be written and read, not to be solved."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import rodjax as rj
from rodjax.model.obstacles import Obstacle
from rodjax.model.rest import SpaceCurve
from rodjax.model.supports import Support

LENGTH = 1.0
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
END_FRAMES = ("clamp", "swivel", "pin", "free", "loaded", "follower")
RODS = ("plain", "along", "pair", "rest", "curve")


def along(rng: np.random.Generator) -> Any:
    """A number, steps or a spline, of numbers that use all their digits; no spline falls below zero between them."""
    size = int(rng.integers(1, 7))
    values = 1 + 0.1 * rng.random(size + 1)
    inside = np.cumsum(0.5 + rng.random(size + 1))
    match rng.integers(3):
        case 0:
            return values[0]
        case 1:
            return rj.Steps(inside[:-1] / inside[-1] * LENGTH, values)
    return rj.Smooth([0.0, 0.4, LENGTH], values[:1] * [1.0, 1.1, 1.2])


def resized(rng: np.random.Generator, rod: rj.Rod) -> rj.Rod:
    """With splines of other sizes: to make a rod of them takes a program for each size."""

    def spline(value: Any) -> Any:
        if not isinstance(value, rj.Smooth):
            return value
        size = int(rng.integers(2, 30))
        return eqx.tree_at(lambda one: (one.s, one.values), value, tuple(jnp.asarray(rng.random((2, size)))))

    return jax.tree.map(spline, rod, is_leaf=lambda value: isinstance(value, rj.Smooth))


def rod(rng: np.random.Generator, kind: str) -> rj.Rod:
    if kind == "plain":
        return rj.Rod(LENGTH, *rng.random(4) + 0.1, radius=0.01)
    pair = (along(rng), along(rng))
    rest = ((along(rng), along(rng)), along(rng)) if kind == "rest" else (None, None)
    stiffness = along(rng) if kind == "along" else pair
    found = rj.Rod(LENGTH, stiffness, along(rng), along(rng), along(rng), along(rng), *rest)
    if kind != "curve":
        return found
    size = int(rng.integers(4, 30))
    curve = SpaceCurve(*(jnp.asarray(rng.random(shape)) for shape in ((size, 3), (size,), (size, 3))))
    return eqx.tree_at(lambda rod: rod.rest_centerline, found, curve, is_leaf=lambda value: value is None)


def frame(rng: np.random.Generator) -> Any:
    return rj.frame(rng.normal(size=3), rng.normal(size=3))


def support(rng: np.random.Generator, kind: str, end: float) -> Support:
    position = np.array([end, 0, 0]) + 0.005 * rng.normal(size=3)
    if kind in ("free", "loaded", "follower"):
        force, moment = rng.normal(size=(2, 3))
        return {
            "free": rj.Free(),
            "loaded": rj.Free(force),
            "follower": rj.Free(force, moment, follower=True),
        }[kind]
    if kind == "clamp":
        return rj.Clamp(position, frame(rng))
    return rj.Swivel(position, rng.normal(size=3)) if kind == "swivel" else rj.Pin(position)


def clips(rng: np.random.Generator, with_frames: bool) -> list[rj.Clip]:
    count = int(rng.integers(0, 5))
    found = []
    for k, at in enumerate((np.arange(count) + 0.5 + 0.2 * rng.random(count)) / max(count, 1) * LENGTH):
        held: list[dict[str, Any]] = [{}, dict(tangent=rng.normal(size=3)), dict(sliding=True), dict(frame=frame(rng))]
        found.append(rj.Clip(at, (0.8 * at, 0.01 * k, 0.0), **held[rng.integers(4 if with_frames else 3)]))
    return found


def obstacle(rng: np.random.Generator, kind: str, depth: int = 0) -> Obstacle:
    a, b, size = rng.normal(size=3), rng.normal(size=3) + 5, rng.random(3) + 0.1
    if kind == "Union":
        # Of unions in one another files hold two.
        kinds = [*OBSTACLES[:-1], "Union"] if depth < 1 else OBSTACLES[:-1]
        return rj.Union(*(obstacle(rng, one, depth + 1) for one in rng.choice(kinds, rng.integers(1, 5))))
    bodies = int(rng.integers(1, 4))
    return {
        "Plane": lambda: rj.Plane(a, b),
        "Sphere": lambda: rj.Sphere(a, size[0]),
        "Capsule": lambda: rj.Capsule(a, b, size[0]),
        "Pipe": lambda: rj.Pipe(rng.normal(size=(rng.integers(2, 25), 3)), size[0]),
        "Cylinder": lambda: rj.Cylinder(a, b, size[0]),
        "Box": lambda: rj.Box(a, size, frame(rng) if rng.integers(2) else None),
        "Mesh": lambda: rj.Mesh(
            np.concatenate([CORNERS + 3 * k + a for k in range(bodies)]),
            np.concatenate([FACES + 4 * k for k in range(bodies)]),
        ),
    }[kind]()


OBSTACLES = ["Plane", "Sphere", "Capsule", "Pipe", "Cylinder", "Box", "Mesh", "Union"]


def scene(rng: np.random.Generator, *, for_text: bool = False) -> rj.Scene:
    """A scene; `for_text`: without what a scene file cannot hold, curves and meshes."""
    touches = bool(rng.integers(2))
    kind = "plain" if touches else str(rng.choice(RODS[:-1] if for_text else RODS))
    kinds = list(rng.choice(END_FRAMES[:-2] if touches else END_FRAMES, 2))
    kinds[rng.integers(2)] = "clamp"  # which holds whatever acts on the other
    start, end = (support(rng, one, at) for one, at in zip(kinds, (0.0, 0.8), strict=True))
    loads = [
        (rj.DistributedForce if rng.integers(2) else rj.DistributedCouple)(rng.normal(size=3), bool(rng.integers(2)))
        for _ in range(0 if touches else rng.integers(0, 4))
    ]
    # Files keep the order among the forces and among the couples.
    loads.sort(key=lambda load: type(load).__name__)
    held = clips(rng, with_frames=not touches) if "follower" not in kinds else []
    # Rods with obstacles, or with frames along them, slide through no clips.
    if kind != "plain" or touches or loads or any(clip.frame is not None for clip in held):
        held = [clip for clip in held if not clip.sliding]
    has_turns = kinds == ["clamp", "clamp"] and all(clip.frame is None for clip in held)
    names = [name for name in OBSTACLES if not (for_text and name in ("Mesh", "Union"))]
    found = rod(rng, kind)
    return rj.Scene(
        found if for_text else resized(rng, found),
        start,
        end,
        rng.normal(size=3) if rng.integers(2) else None,
        [rj.PointForce(at, rng.normal(size=3)) for at in rng.random(rng.integers(0, 4))],
        int(rng.integers(-3, 4)) if has_turns and rng.integers(2) else None,
        loads,
        held,
        [obstacle(rng, str(one)) for one in rng.choice(names, rng.integers(1, 5))] if touches else [],
    )
