"""The truth for tests: the continuum rod, eqs. (1)-(5) of Linn & Stephan (2008), by shooting with scipy.

Independent of rodjax's energy: it integrates the equilibrium equations and moves the unknown force and moment at
s = 0 until the far end fits. One interval of shooting serves the moderately loaded rods of the tests.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from rodjax import Clamp, Equilibrium, Free, Scene


class Continuum:
    """The solution near a discrete equilibrium: `nodes_at(s)`, forces and moments, elastic energy."""

    def __init__(self, scene: Scene, near: Equilibrium):
        assert isinstance(scene.start, Clamp)
        self.scene = scene
        self.EI, self.GJ, self.EA, self.length = (
            float(x) for x in (scene.rod.EI, scene.rod.GJ, scene.rod.EA, scene.rod.length)
        )
        gravity = np.zeros(3) if scene.gravity is None else np.asarray(scene.gravity)
        self.line_load = float(scene.rod.mass_per_length) * gravity
        self.units = np.repeat([self.EI / self.length**2, self.EI / self.length], 3)
        guess = np.concatenate([near.start_force, near.start_moment]) / self.units
        found = root(self._mismatch, guess, tol=1e-12)
        # hybr may report slow progress once at rounding: the mismatch itself is the verdict.
        assert np.max(np.abs(self._mismatch(found.x))) < 1e-9, found.message
        self.start_force, self.start_moment = np.split(found.x * self.units, 2)
        self._solution = self._integrate(found.x)
        end = self._solution.y[:, -1]
        self.end_force, self.end_moment = end[12:15], end[15:18]
        self.elastic_energy = end[18]

    def nodes_at(self, s: np.ndarray) -> np.ndarray:
        return self._solution.sol(s)[:3].T

    def _integrate(self, loads: np.ndarray):
        start = self.scene.start
        assert isinstance(start, Clamp)
        y0 = np.concatenate([start.position, np.asarray(start.frame).ravel(), loads * self.units, [0.0]])
        span = (0.0, self.length)
        return solve_ivp(self._slope, span, y0, method="DOP853", rtol=1e-11, atol=1e-13, dense_output=True)

    def _slope(self, _, y):
        frame = y[3:12].reshape(3, 3)
        force, moment = y[12:15], y[15:18]
        t = frame[:, 2]
        tension, torque = t @ force, t @ moment
        across = moment - torque * t
        darboux = across / self.EI + torque / self.GJ * t
        dphi = (1 + tension / self.EA) * t
        energy = (across @ across / self.EI + torque**2 / self.GJ + tension**2 / self.EA) / 2
        dframe = np.cross(darboux, frame, axisa=0, axisb=0, axisc=0)
        return np.concatenate([dphi, dframe.ravel(), -self.line_load, -np.cross(dphi, force), [energy]])

    def _mismatch(self, loads):
        end = self._integrate(loads).y[:, -1]
        support = self.scene.end
        if isinstance(support, Free):
            force = np.zeros(3) if support.force is None else np.asarray(support.force)
            return np.concatenate([end[12:15] - force, end[15:18]]) / self.units
        assert isinstance(support, Clamp)
        turn = Rotation.from_matrix(end[3:12].reshape(3, 3) @ np.asarray(support.frame).T).as_rotvec()
        return np.concatenate([(end[:3] - np.asarray(support.position)) / self.length, turn])
