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
RODS = ("plain", "along", "pair", "rest", "shear", "curve")


def inside(rng: np.random.Generator, count: int) -> np.ndarray:
    """So many arclengths that increase; two of one scene are the same, or far enough apart for nodes of their own."""
    return (np.sort(rng.choice(30, count, replace=False)) + 2 / 3) / 31 * LENGTH


def along(rng: np.random.Generator) -> Any:
    """A number, steps or a spline, of numbers that use all their digits; no spline falls below zero between them."""
    size = int(rng.integers(1, 7))
    values = 1 + 0.1 * rng.random(size + 1)
    match rng.integers(3):
        case 0:
            return values[0]
        case 1:
            return rj.Steps(inside(rng, size), values)
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
    more: dict[str, Any] = {}
    if kind == "shear":
        more = {"GA": (along(rng), along(rng)) if rng.integers(2) else along(rng)}
        more |= {"rest_strain": along(rng)} if rng.integers(2) else {}
    found = rj.Rod(LENGTH, stiffness, along(rng), along(rng), along(rng), along(rng), *rest, **more)
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


def clips(rng: np.random.Generator) -> list[rj.Clip]:
    count = int(rng.integers(0, 5))
    found = []
    for k, at in enumerate(inside(rng, count)):
        tangent = dict(tangent=rng.normal(size=3))
        held: list[dict[str, Any]] = [{}, tangent, dict(sliding=True), tangent | dict(sliding=True)]
        held.append(dict(frame=frame(rng)))
        found.append(rj.Clip(at, (0.8 * at, 0.01 * k, 0.0), **held[rng.integers(len(held))]))
    return found


def distributed(rng: np.random.Generator) -> rj.DistributedForce | rj.DistributedCouple:
    kind = rj.DistributedForce if rng.integers(2) else rj.DistributedCouple
    part = inside(rng, 2) if rng.integers(2) else None
    return kind(rng.normal(size=3), bool(rng.integers(2)), part)


def obstacle(rng: np.random.Generator, kind: str, depth: int = 0) -> Obstacle:
    a, b, size = rng.normal(size=3), rng.normal(size=3) + 5, rng.random(3) + 0.1
    # Of the parts of a union none has friction of its own.
    friction = rng.random() if depth == 0 and rng.integers(2) else 0.0
    if kind == "Union":
        # Of unions in one another files hold two.
        kinds = [*OBSTACLES[:-1], "Union"] if depth < 1 else OBSTACLES[:-1]
        parts = (obstacle(rng, one, depth + 1) for one in rng.choice(kinds, rng.integers(1, 5)))
        return rj.Union(*parts, friction=friction)
    bodies = int(rng.integers(1, 4))
    return {
        "Plane": lambda: rj.Plane(a, b, friction),
        "Sphere": lambda: rj.Sphere(a, size[0], friction),
        "Capsule": lambda: rj.Capsule(a, b, size[0], friction),
        "Pipe": lambda: rj.Pipe(rng.normal(size=(rng.integers(2, 25), 3)), size[0], friction),
        "Cylinder": lambda: rj.Cylinder(a, b, size[0], friction),
        "Box": lambda: rj.Box(a, size, frame(rng) if rng.integers(2) else None, friction),
        "Mesh": lambda: rj.Mesh(
            np.concatenate([CORNERS + 3 * k + a for k in range(bodies)]),
            np.concatenate([FACES + 4 * k for k in range(bodies)]),
            friction,
        ),
    }[kind]()


OBSTACLES = ["Plane", "Sphere", "Capsule", "Pipe", "Cylinder", "Box", "Mesh", "Union"]


def scene(rng: np.random.Generator, *, for_text: bool = False) -> rj.Scene:
    """A scene; `for_text`: without what a scene file cannot hold, curves and meshes."""
    kinds = list(rng.choice(END_FRAMES, 2))
    kinds[rng.integers(2)] = "clamp"  # which holds whatever acts on the other
    start, end = (support(rng, one, at) for one, at in zip(kinds, (0.0, 0.8), strict=True))
    loads = [distributed(rng) for _ in range(rng.integers(0, 4))]
    # Files keep the order among the forces and among the couples.
    loads.sort(key=lambda load: type(load).__name__)
    held = clips(rng)
    has_turns = kinds == ["clamp", "clamp"] and all(clip.frame is None for clip in held)
    names = [name for name in OBSTACLES if not (for_text and name in ("Mesh", "Union"))]
    found = rod(rng, str(rng.choice(RODS[:-1] if for_text else RODS)))
    touches = bool(rng.integers(2)) and found.radius is not None
    return rj.Scene(
        found if for_text else resized(rng, found),
        start,
        end,
        rng.normal(size=3) if rng.integers(2) else None,
        [rj.PointForce(at, rng.normal(size=3), bool(rng.integers(2))) for at in inside(rng, int(rng.integers(0, 4)))],
        int(rng.integers(-3, 4)) if has_turns and rng.integers(2) else None,
        loads,
        held,
        [obstacle(rng, str(one)) for one in rng.choice(names, rng.integers(1, 5))] if touches else [],
        point_couples=[
            rj.PointCouple(at, rng.normal(size=3), bool(rng.integers(2))) for at in inside(rng, int(rng.integers(0, 3)))
        ],
    )
