"""Tables of derivatives: against differences, the energy and closed forms; symmetry of stiffness; errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy_programs import by_numpy
from scenes import loaded_scenes

import rodjax as rj
from rodjax import Clamp, Pin, Rod, Scene, end_stiffness, frame, rotate, sensitivities

SCENES = loaded_scenes()
OPTIONS = {"segments": 8, "discretization": "finite_difference", "solver": rj.Newton(tolerance=1e-12)}

# Each number of the scene with clamps, and how it is reached.
NUMBERS = {
    "rod.EI": lambda scene: scene.rod.EI,
    "start.frame": lambda scene: scene.start.frame,
    "end.position": lambda scene: scene.end.position,
    "gravity": lambda scene: scene.gravity,
    "point_forces.0.at": lambda scene: scene.point_forces[0].at,
    "point_forces.0.force": lambda scene: scene.point_forces[0].force,
}


def changed(scene: Scene, name: str, change: np.ndarray) -> Scene:
    number = NUMBERS[name](scene)
    new = rotate(number, change) if name.endswith("frame") else number + jnp.asarray(change)
    return eqx.tree_at(NUMBERS[name], scene, new)


def test_sensitivities_are_those_of_differences():
    scene, fields = SCENES["clamps"], ("nodes", "tension", "total_twist", "end_moment")
    base = rj.solve(scene, **OPTIONS)
    table = sensitivities(scene, of=fields, wrt=list(NUMBERS), **OPTIONS)
    assert list(table) == list(fields)
    assert list(table["nodes"]) == list(NUMBERS)
    rng = np.random.default_rng(0)
    for name in NUMBERS:
        shape = table["nodes"][name].shape[2:]
        size = float(scene.rod.EI) if name == "rod.EI" else 1.0
        direction = size * rng.uniform(0.5, 1.0, shape)

        def at(h, name=name, direction=direction):
            return rj.solve(changed(scene, name, h * direction), guess=base, **OPTIONS)

        h = 2e-3
        low, lower, high, higher = at(-h), at(-2 * h), at(h), at(2 * h)
        for of in fields:
            derivative = table[of][name]
            assert derivative.shape == getattr(base, of).shape + shape
            found = np.tensordot(derivative, direction, len(shape))
            one, two = (getattr(b, of) - getattr(a, of) for a, b in ((low, high), (lower, higher)))
            expected = (8 * one - two) / (12 * h)
            # Differences of fourth order: h^4 of the fifth derivative, and 1e-12/h of the residual. Seen: 1e-8.
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * float(np.max(np.abs(expected))))


def test_the_energy_changes_by_the_work_of_the_support():
    # One output of many inputs: in reverse.
    scene = SCENES["clamps"]
    table = sensitivities(scene, of=["energy"], wrt=["end.position", "end.frame", "start.position"], **OPTIONS)
    result = rj.solve(scene, **OPTIONS)
    # To the residual, 1e-12 EI/L^2 of forces of 10 EI/L^2.
    np.testing.assert_allclose(table["energy"]["end.position"], result.end_force, rtol=1e-10)
    np.testing.assert_allclose(table["energy"]["end.frame"], result.end_moment, rtol=1e-10)
    np.testing.assert_allclose(table["energy"]["start.position"], -result.start_force, rtol=1e-10)


def test_end_stiffness_is_symmetric_and_the_hessian_of_the_energy():
    scene = SCENES["clamps"]
    base = rj.solve(scene, **OPTIONS)
    stiffness = end_stiffness(scene, **OPTIONS)
    assert stiffness.shape == (6, 6)
    largest = float(np.max(np.abs(stiffness)))
    np.testing.assert_allclose(stiffness, stiffness.T, rtol=0, atol=1e-9 * largest)

    def energy(displacement):
        end = Clamp(scene.end.position + displacement, scene.end.frame)
        return rj.solve(eqx.tree_at(lambda scene: scene.end, scene, end), guess=base, **OPTIONS).energy

    hessian = by_numpy(jax.hessian(energy))(jnp.zeros(3))
    np.testing.assert_allclose(stiffness[:3, :3], hessian, rtol=0, atol=1e-9 * largest)


@pytest.mark.slow
def test_end_stiffness_of_a_straight_beam():
    length, EI, GJ, EA = 2.0, 3.0, 1.7, 5e3
    scene = Scene(Rod(length, EI, GJ, EA), Clamp((0, 0, 0), frame((1, 0, 0))), Clamp((length, 0, 0), frame((1, 0, 0))))
    expected = np.diag([EA / length, *[12 * EI / length**3] * 2, GJ / length, *[4 * EI / length] * 2])
    # A displacement along y is met by a moment about -z, one along z by a moment about +y.
    for displacement, rotation, sign in ((1, 5, -1), (2, 4, 1)):
        expected[displacement, rotation] = expected[rotation, displacement] = sign * 6 * EI / length**2
    # Elements of third degree hold the deflections of a straight beam: exact but for roundings of EA/L.
    stiffness = end_stiffness(scene, segments=8, discretization="hermite")
    np.testing.assert_allclose(stiffness, expected, rtol=0, atol=1e-9 * EA / length)
    np.testing.assert_allclose(stiffness[1:, 1:], expected[1:, 1:], rtol=0, atol=1e-9 * EI / length)
    # By finite differences of second order: h^2 of 12 EI/L^3, at h = L/8 of this size.
    coarse = end_stiffness(scene, segments=8, discretization="finite_difference")
    np.testing.assert_allclose(coarse, expected, rtol=0, atol=12 * EI / length**3 * 2 / 8**2)


@pytest.mark.slow
def test_end_stiffness_of_a_pin():
    length, EI, EA = 2.0, 3.0, 5e3
    scene = Scene(Rod(length, EI, EI, EA), Clamp((0, 0, 0), frame((1, 0, 0))), Pin((length, 0, 0)))
    stiffness = end_stiffness(scene, segments=8, discretization="hermite")
    expected = np.diag([EA / length, *[3 * EI / length**3] * 2])
    np.testing.assert_allclose(stiffness, expected, rtol=0, atol=1e-9 * EA / length)
    np.testing.assert_allclose(stiffness[1:, 1:], expected[1:, 1:], rtol=0, atol=1e-9 * EI / length)


@pytest.mark.slow
def test_hermite_elements_with_a_dead_moment_and_turns():
    # The free end's numbers, and a stiffness beside turns that a scene states.
    EI = float(SCENES["start moment"].rod.EI)
    (table,) = sensitivities(
        SCENES["start moment"], of=["total_twist"], wrt=["start.moment", "end.frame"], segments=8
    ).values()
    assert table["start.moment"].shape == (3,)
    assert float(np.max(np.abs(table["start.moment"]))) * EI > 0.01
    scene = SCENES["clamps"]
    turned = Scene(scene.rod, scene.start, scene.end, turns=1)
    stiffness = end_stiffness(turned, segments=8, solver=OPTIONS["solver"])
    np.testing.assert_allclose(stiffness, stiffness.T, rtol=0, atol=1e-9 * float(np.max(np.abs(stiffness))))


def test_unknown_names():
    scene = SCENES["clamps"]
    with pytest.raises(
        ValueError, match=r"of must be names of real fields of Equilibrium, got 'force'; allowed are s,"
    ):
        sensitivities(scene, of=["force"], wrt=["rod.EI"])
    with pytest.raises(ValueError, match=r"wrt must be names of numbers of this scene, got 'end.force'; .*rod.length"):
        sensitivities(scene, of=["nodes"], wrt=["end.force"])
    with pytest.raises(TypeError, match=r"of must be a list of names, such as \['nodes'\]"):
        sensitivities(scene, of="nodes", wrt=["rod.EI"])
    with pytest.raises(TypeError, match="scene must be a Scene"):
        sensitivities(scene.rod, of=["nodes"], wrt=["rod.EI"])


def test_ends_without_a_stiffness():
    with pytest.raises(ValueError, match="got Free; make it a Clamp or Pin"):
        end_stiffness(SCENES["cantilever"])
    with pytest.raises(ValueError, match="got Swivel"):
        end_stiffness(SCENES["clamp-swivel"])
