"""Planar frames of elastic, extensible rods by shooting with SciPy: a code that shares no line with rodjax.

Places (x, y, angle of the tangent); of a section the force n = (nx, ny) and moment m that what lies beyond exerts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares, root


class PlanarRod(NamedTuple):
    """`start`, `end`: the name of a joint with the angle of the tangent in it, or a fixed (x, y, angle or None)."""

    length: float
    EI: float
    EA: float
    start: tuple
    end: tuple
    weight: tuple[float, float] = (0.0, 0.0)  # per length


def _shot(rod: PlanarRod, start: np.ndarray) -> np.ndarray:
    def rates(_, y):
        _, _, angle, nx, ny, m = y
        c, s = np.cos(angle), np.sin(angle)
        stretch = 1 + (nx * c + ny * s) / rod.EA
        return stretch * c, stretch * s, m / rod.EI, -rod.weight[0], -rod.weight[1], -stretch * (c * ny - s * nx)

    return solve_ivp(rates, (0.0, rod.length), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


Loads = dict[str, tuple[float, float, float]]


def solve_frame(
    rods: Sequence[PlanarRod], loads: Loads, guess: np.ndarray, poses: dict
) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Poses of the joints, and states at the starts of the rods. `guess`: (nx, ny, m) of each rod at its start."""
    joints, begins, _ = _solve(rods, loads, guess, poses, None)
    return joints, begins


def load_that_holds(
    rods: Sequence[PlanarRod], loads: Loads, guess: np.ndarray, poses: dict, held: tuple[str, int, float]
) -> float:
    """The component of the load on a joint under which that component of its pose has a given value: also at a limit
    point, where the load determines no pose. `held`: the joint, the component and the value.
    """
    return _solve(rods, loads, guess, poses, held)[2]


def _solve(
    rods: Sequence[PlanarRod], loads: Loads, guess: np.ndarray, poses: dict, held: tuple[str, int, float] | None
) -> tuple[dict[str, np.ndarray], list[np.ndarray], float]:
    names = list(loads)
    scale = max(rod.EI / rod.length**2 for rod in rods)
    place = -1 if held is None else 3 * names.index(held[0]) + held[1]

    def pose(support: tuple, joints: dict) -> tuple:
        if isinstance(support[0], str):
            x, y, angle = joints[support[0]]
            return x, y, angle + support[1]
        return support

    def split(unknowns: np.ndarray) -> tuple[dict, np.ndarray, dict]:
        """In the place of a pose that is held the unknown is the load."""
        of_joints, forces = unknowns[: 3 * len(names)].copy(), unknowns[3 * len(names) :].reshape(-1, 3)
        given = np.array([loads[name] for name in names], float).reshape(-1)
        if held is not None:
            given[place], of_joints[place] = scale * of_joints[place], held[2]
        joints = dict(zip(names, of_joints.reshape(-1, 3), strict=True))
        return joints, forces, dict(zip(names, given.reshape(-1, 3), strict=True))

    def begins(unknowns: np.ndarray) -> list[np.ndarray]:
        joints, forces, _ = split(unknowns)
        found = []
        for rod, (nx, ny, m) in zip(rods, forces, strict=True):
            x, y, angle = pose(rod.start, joints)
            # At a pin the moment is zero, and the third unknown the angle.
            found.append(np.array([x, y, m, nx, ny, 0.0] if angle is None else [x, y, angle, nx, ny, m]))
        return found

    def lacking(unknowns: np.ndarray) -> np.ndarray:
        joints, _, balance = split(unknowns)
        rows = []
        for rod, begin in zip(rods, begins(unknowns), strict=True):
            end = _shot(rod, begin)
            if isinstance(rod.start[0], str):
                balance[rod.start[0]] += begin[3:]
            x, y, angle = pose(rod.end, joints)
            rows += [end[0] - x, end[1] - y, end[5] / rod.EI if angle is None else end[2] - angle]
            if isinstance(rod.end[0], str):
                balance[rod.end[0]] -= end[3:]
        return np.concatenate([rows, *[of_joint / scale for of_joint in balance.values()]])

    first = np.concatenate([np.ravel([poses[name] for name in names]), np.ravel(guess)])
    if held is not None:
        first[place] = loads[held[0]][held[1]] / scale
    found = root(lacking, first, tol=1e-13)
    if not found.success:
        # Derivatives of one-sided differences end at 4e-10 here and there, at other loads on other processors.
        found = least_squares(lacking, found.x, jac="3-point", x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15)
    assert np.max(np.abs(lacking(found.x))) < 1e-10
    load = 0.0 if held is None else scale * found.x[place]
    return split(found.x)[0], begins(found.x), float(load)
