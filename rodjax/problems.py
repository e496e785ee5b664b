"""Benchmark problems: Fig. 1 of Linn & Stephan (2008) and two planar ones, as scenes of one cable."""

import math
from collections.abc import Sequence

import numpy as np

from rodjax.model.rod import Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Free, frame
from rodjax.solving.guess import Guess

# Half angle a of a circular arc of length 1 over a chord of 0.6: sin(a)/a = 0.6.
ARC_HALF_ANGLE = 1.6600348132646194
SPAN = 0.6


def cable(slenderness: float = 200.0) -> Rod:
    """Cable C: 1 m long, E = 1e7 Pa, G = E/3, density 1200 kg/m^3; `slenderness` L/R, 200 for a radius of 5 mm."""
    return Rod.circular(1.0, 1.0 / slenderness, 1e7, shear_modulus=1e7 / 3, density=1200.0)


def omega(tilt: float, turn: float, rod: Rod | None = None) -> Scene:
    """One scene of Fig. 1 of Linn & Stephan (2008): two clamps 0.6 m apart on the x axis.

    `tilt` [rad]: angle of the end tangents below and above the x axis; `turn` [rad]: of the end frame about its
    tangent.
    """
    cosine, sine = math.cos(tilt), math.sin(tilt)
    start = frame((cosine, 0.0, -sine))
    end = np.asarray(frame((cosine, 0.0, sine)))
    d1 = math.cos(turn) * end[:, 0] + math.sin(turn) * end[:, 1]
    turned = np.stack([d1, np.cross(end[:, 2], d1), end[:, 2]], axis=-1)
    return Scene(rod or cable(), Clamp((-SPAN / 2, 0.0, 0.0), start), Clamp((SPAN / 2, 0.0, 0.0), turned))


def figure_1(rod: Rod | None = None) -> list[Scene]:
    """The 25 steps of Fig. 1: in 9 the end tangents of a circle segment turn inward, in 16 the end frame by 2 pi."""
    tilts = np.linspace(ARC_HALF_ANGLE, math.pi / 6, 10)[1:]
    turns = np.linspace(0.0, 2 * math.pi, 17)[1:]
    bend = [omega(tilt, 0.0, rod) for tilt in tilts]
    return bend + [omega(math.pi / 6, turn, rod) for turn in turns]


def figure_1_start(points: int = 401) -> Guess:
    """Stage (a) of Fig. 1, from which its path begins: the circle segment of length 1 m over the two clamps."""
    angle = np.linspace(-ARC_HALF_ANGLE, ARC_HALF_ANGLE, points)
    radius = 0.5 / ARC_HALF_ANGLE
    zero = np.zeros_like(angle)
    return Guess(np.stack([radius * np.sin(angle), zero, radius * (math.cos(ARC_HALF_ANGLE) - np.cos(angle))], axis=1))


def cantilever(load: float = 4.0, rod: Rod | None = None) -> Scene:
    """A cantilever clamped along +x at the origin under a dead tip force along -z of F L^2/EI = `load`."""
    rod = rod or cable()
    force = load * float(rod.EI) / float(rod.length) ** 2
    return Scene(rod, Clamp((0.0, 0.0, 0.0), frame((1.0, 0.0, 0.0))), Free(force=(0.0, 0.0, -force)))


def hanging_cable(span: float = 0.8, gravity: Sequence[float] = (0.0, 0.0, -9.81), rod: Rod | None = None) -> Scene:
    """A cable clamped along +x at both ends, `span` [m] apart, sagging under gravity."""
    level = frame((1.0, 0.0, 0.0))
    return Scene(rod or cable(), Clamp((0.0, 0.0, 0.0), level), Clamp((span, 0.0, 0.0), level), gravity=gravity)
