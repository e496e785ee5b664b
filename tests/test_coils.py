"""Rods that turn often, at rest or by their ends: no coil and no turn is lost, whatever the mesh."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.discretization.turning import turn_between_points
from rodjax.solving.status import Status

EI, GJ = 1e-3, 0.8e-3
RADIUS, PITCH = 0.02, 0.004
LEVEL = rj.frame((1, 0, 0))
ORIGIN = np.zeros(3)
FLAT = {"EI": (4e-3, 8e-3), "GJ": 4e-3, "EA": 800.0}


def spring(coils: int) -> rj.Rod:
    """Wound as a helix, whose frames are Frenet's."""
    coil = math.hypot(2 * math.pi * RADIUS, PITCH)
    curvature, torsion = 4 * math.pi**2 * RADIUS / coil**2, 2 * math.pi * PITCH / coil**2
    return rj.Rod(coils * coil, (EI, EI), GJ, 1e5, rest_curvature=(curvature, 0.0), rest_twist=torsion)


def helix(part: np.ndarray, coils: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and frames at these parts of the length."""
    angle, coil = 2 * np.pi * coils * part, math.hypot(2 * math.pi * RADIUS, PITCH)
    inwards = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0 * angle + PITCH / (2 * np.pi * RADIUS)], axis=-1)
    t = along * 2 * np.pi * RADIUS / coil
    d1 = np.cross(t, inwards)
    positions = -RADIUS * inwards + np.stack([0 * angle, 0 * angle, PITCH * coils * part], axis=-1)
    return positions, np.stack([d1, np.cross(t, d1), t], axis=-1)


def held(coils: int, pulled: float = 0.0) -> rj.Scene:
    positions, frames = helix(np.array([0.0, 1.0]), coils)
    end = positions[1] + np.array([0.0, 0.0, pulled])
    return rj.Scene(spring(coils), rj.Clamp(positions[0], frames[0]), rj.Clamp(end, frames[1]))


def twisted(**scene) -> rj.Scene:
    """A flat rod, taut; ten turns at rest."""
    rod = rj.Rod(length=1.0, **FLAT, rest_twist=scene.pop("rest_twist", 20 * math.pi))
    return rj.Scene(rod, rj.Clamp(ORIGIN, LEVEL), rj.Clamp((1.02, 0, 0), LEVEL), **scene)


def test_a_spring_of_ten_coils():
    """At rest it lies where the helix does, between nodes too; pulled, it has the stiffness of the theory of springs.

    On a first mesh of 8 elements, more than a whole turn each, it ended in another equilibrium, 20 EI/L higher.
    """
    resting = rj.solve(held(10))
    assert resting.elastic_energy < 1e-12 * EI / resting.scene.rod.length
    length = float(resting.s[-1])
    places = np.linspace(0, 1, 501)
    off = np.linalg.norm(np.asarray(resting.position_at(places * length)) - helix(places, 10)[0], axis=1)
    # 3.4e-7 were seen, where 1.8e-7 are estimated of the nodes alone; by cubics it was 1.2e-4.
    assert np.max(off) < 1e-6 * length
    # Love 1927, section 271: by 0.4 % less stiff than ten coils whose ends are held so that they do not turn.
    slope = math.atan(PITCH / (2 * math.pi * RADIUS))
    stiffness = 1 / (length * RADIUS**2 * (math.cos(slope) ** 2 / GJ + math.sin(slope) ** 2 / EI))
    pulled = rj.solve(held(10, 1e-3), guess=resting)
    np.testing.assert_allclose(pulled.end_force[2], stiffness * 1e-3, rtol=5e-3)


@pytest.mark.parametrize("turns", [3, 10])
def test_stated_turns_are_those_of_the_rod(turns):
    """Of a rod with ten turns at rest, on the library's mesh; on 8 elements it had 16 less.

    Twisted evenly and straight: the energy is that of the law for torsion, and of the stretch.
    """
    result = rj.solve(twisted(turns=turns))
    assert result.converged
    # By the mesh of this many turns 1e-7 of them were seen.
    np.testing.assert_allclose(result.total_twist, 2 * math.pi * turns, atol=1e-4)
    energy = FLAT["GJ"] * (2 * math.pi * (turns - 10)) ** 2 / 2 + FLAT["EA"] * 0.02**2 / 2
    np.testing.assert_allclose(result.energy, energy, rtol=1e-5)


def test_a_guess_on_too_coarse_a_mesh_gets_a_finer_one():
    guess = rj.solve(twisted(rest_twist=0.0, turns=0), segments=8)
    result = rj.solve(twisted(rest_twist=0.0, turns=10), guess=guess)
    np.testing.assert_allclose(result.total_twist, 20 * math.pi, atol=1e-4)


def test_meshes_on_which_turns_are_lost_are_refused():
    for scene in (twisted(), twisted(rest_twist=0.0, turns=10)):
        with pytest.raises(ValueError, match=r"segments must be some 1[12] or more, as the rod at rest"):
            rj.solve(scene, segments=8)
    with pytest.raises(ValueError, match=r"segments must be .* got a mesh of 512"):
        rj.solve(twisted(rest_twist=2 * math.pi * 600))

    @jax.jit
    @jax.vmap
    def statuses(rest_twist):
        return rj.solve(twisted(rest_twist=rest_twist), segments=8).status

    assert statuses(jnp.array([6.0, 20.0]) * math.pi).tolist() == [Status.CONVERGED, Status.OUT_OF_RANGE]


def test_a_twist_that_a_mesh_hardly_tells_is_warned_of():
    with pytest.warns(rj.MeshWarning, match="the mesh of 16 segments is too coarse"):
        rj.solve(twisted(rest_twist=0.0, turns=10), segments=16)


def turn_of(rod: rj.Rod, segments: int, discretization: str = "hermite"):
    return turn_between_points(rj.Scene(rod, rj.Clamp(ORIGIN, LEVEL), rj.Free()), segments, discretization)


def test_the_turn_between_points():
    """Closed forms; what varies along the rod is sampled at 1024 places."""
    constant = rj.Rod(2.0, **FLAT, rest_curvature=(3.0, 0.0), rest_twist=4.0)
    np.testing.assert_allclose([turn_of(constant, 5), turn_of(constant, 5, "finite_difference")], [1.0, 2.0])
    steps = rj.Rod(2.0, **FLAT, rest_twist=rj.Steps([1.5], [1.0, -8.0]))
    np.testing.assert_allclose(turn_of(steps, 4), 2.0, rtol=1e-12)
    # (2/s0) s ds over the last of eight parts: 1 - (7/8)^2.
    smooth = rj.Rod(2.0, **FLAT, rest_curvature=(rj.Smooth([0.0, 1.0, 2.0], [0.0, 0.5, 1.0]), 0.0))
    np.testing.assert_allclose(turn_of(smooth, 4), 15 / 64, rtol=1e-3)
    # A circle of eight eighths; between 100 points chords count.
    angles = np.linspace(0, 2 * np.pi, 101)
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    circle = rj.Rod.from_centerline(points, **FLAT, d2=(0, 0, 1))
    np.testing.assert_allclose(turn_of(circle, 4), 2 * np.pi / 8, rtol=1e-3)
    assert turn_of(rj.Rod(2.0, **FLAT), 1) is None
    stacked = jax.vmap(lambda twist: twisted(rest_twist=twist))(jnp.array([1.0, 7.0]))
    np.testing.assert_allclose(turn_between_points(stacked, 7, "finite_difference"), [1 / 7, 1.0])
