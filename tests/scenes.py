"""Scenes that several tests look at."""

import itertools
from collections.abc import Sequence

from rodjax import Clamp, Free, Mesh, Pin, PointForce, Scene, Swivel, frame, problems

GRAVITY = (0.0, 3.0, -9.81)
ORIGIN = (0.0, 0.0, 0.0)
# Of three cables that meet in a joint, as files have it.
ROD = '{ section = "circular", length = "30 cm", radius = "3 mm", youngs_modulus = "10 MPa", poisson_ratio = 0.5 }'
BRANCHES = f"""
[cables.trunk]
rod = {ROD}
start = {{ support = "clamp", position = "[0, 0, 0] m", tangent = [1, 0, 0], d2 = [0, 1, 0] }}
end = {{ support = "joint", joint = "y", tangent = [1, 0, 0], d2 = [0, 1, 0], offset = "[-5, 0, 0] mm" }}
[cables.left]
rod = {ROD}
start = {{ support = "joint", joint = "y", tangent = [1, 1, 0], d2 = [0, 0, 1] }}
end = {{ support = "clamp", position = "[50, 15, 0] cm", tangent = [1, 0, 0], d2 = [0, 0, 1] }}
[cables.right]
rod = {ROD}
start = {{ support = "joint", joint = "y", tangent = [1, -1, 0], d2 = [0, 0, 1] }}
end = {{ support = "pin", position = "[50, -15, 0] cm" }}
[joints.y]
force = "[0, 0, -0.1] N"
[loads]
gravity = "[0, 0, -9.81] m/s^2"
"""


def loaded_scenes() -> dict[str, Scene]:
    """One of each kind of supports and loads, of a thick rod, so that stretch matters."""
    rod = problems.cable(20.0)
    clamp, other = Clamp(ORIGIN, frame((1, 0, -1))), Clamp((0.5, 0.2, 0.0), frame((1, 1, 1)))
    load = [PointForce(0.43, (0.1, 0.0, 0.2))]
    EI = float(rod.EI)
    return {
        "clamps": Scene(rod, clamp, other, GRAVITY, load),
        "clamp-swivel": Scene(rod, clamp, Swivel((0.5, 0.2, 0.0), (1, 1, 1))),
        "pins": Scene(rod, Pin(ORIGIN), Pin((0.5, 0.2, 0.0)), GRAVITY),
        "cantilever": Scene(rod, clamp, Free(force=(0.0, EI, 2 * EI)), point_forces=load),
        "free start": Scene(rod, Free(), other, GRAVITY),
        "end moment": Scene(rod, clamp, Free(force=(0.0, EI, 0.0), moment=(EI, 2 * EI, -EI))),
        "start moment": Scene(rod, Free(moment=(EI, 2 * EI, -EI)), other, GRAVITY),
    }


def box_mesh(low: Sequence[float], high: Sequence[float]) -> Mesh:
    """A box along the axes between two corners, as triangles."""
    corners = list(itertools.product(*zip(low, high, strict=True)))
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return Mesh(corners, [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])
