"""What print, dir and notebooks show, and the energy of a scene for an optimiser of one's own."""

import os
import pydoc
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import rodjax as rj
from rodjax import problems

CLAMP = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0)))


def test_rods_and_scenes_are_printed_with_their_units():
    rod = rj.Rod(1.5, (4e-3, 5e-3), 3e-3, rj.Steps([0.5], [500.0, 700.0]), 0.1, rest_curvature=(0.5, 0.0))
    assert str(rod) == (
        "Rod: length 1.5 m, EI (0.004, 0.005) N m^2, GJ 0.003 N m^2, EA 500 to 700 N (Steps), "
        "mass_per_length 0.1 kg/m, rest_curvature (0.5, 0) 1/m"
    )
    scene = rj.Scene(
        rod, CLAMP, rj.Free(), (0, 0, -9.81), obstacles=(), clips=[rj.Clip(0.5, (0.4, 0.1, 0), sliding=True)]
    )
    lines = str(scene).split("\n  ")
    assert lines[0] == "Scene"
    assert lines[2] == "start: Clamp: position (0, 0, 0) m, tangent (1, 0, 0)"
    assert lines[4:] == ["gravity: (0, 0, -9.81) m/s^2", "clips[0]: Clip: at 0.5 m, position (0.4, 0.1, 0) m, sliding"]
    jax.jit(lambda rod: (str(rod), rod.EA.values)[1])(rod)  # traced numbers have no values


def test_results_are_printed_with_their_units():
    result = rj.solve(problems.hanging_cable(), segments=8)
    told = str(result)
    assert told.startswith("Equilibrium of 8 segments\n  status: converged: ")
    assert f"end force: ({float(result.end_force[0]):.4g}, 0, {float(result.end_force[2]):.4g}) N" in told
    assert f"tension: {float(np.min(result.tension)):.4g} to {float(np.max(result.tension)):.4g} N" in told
    html = result._repr_html_()
    assert html.startswith("<table>")
    assert html.count("<tr>") == told.count("\n")
    many = str(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), result))
    assert "Equilibrium of 2 scenes, 8 segments" in many
    assert "status: 2 converged" in many
    assert "in magnitude" in many


def hanging_harness() -> rj.Harness:
    """Two cables that hang from clamps and meet in a body with a mass."""
    rod, weight = rj.Rod(1.0, 5e-3, 3e-3, 800.0, 0.1, radius=5e-3), (0, 0, -9.81)
    first = rj.Scene(rod, CLAMP, rj.Joint("y"), weight)
    second = rj.Scene(rod, rj.Joint("y"), rj.Clamp((1.6, 0, 0), rj.frame((1, 0, 0))), weight)
    return rj.Harness({"trunk": first, "branch": second}, {"y": rj.Body(mass=0.1)})


def test_harnesses_are_printed_with_their_units():
    harness = hanging_harness()
    lines = str(harness).split("\n  ")
    assert lines[:2] == ["Harness: 2 cables, 1 joint", f"trunk: {harness['trunk'].rod}"]
    assert lines[2:4] == [
        "  start: Clamp: position (0, 0, 0) m, tangent (1, 0, 0)",
        "  end: Joint: name y, third axis (0, 0, 1), offset (0, 0, 0) m",
    ]
    assert lines[-1] == "joint y: Body: mass 0.1 kg"
    hung = dict.fromkeys("abc", rj.Scene(harness["trunk"].rod, CLAMP, rj.Free(), (0, 0, -9.81)))
    assert str(rj.Harness(hung, contact=True)).endswith("\n  may touch: a and b; a and c; b and c")
    found = rj.solve(harness, segments=8)
    told = str(found)
    assert told.startswith("Equilibrium of 2 cables, 1 joint\n  status: converged: ")
    assert f"joint y: position ({float(found.joints['y'].position[0]):.4g}, " in told
    x, y, z = (f"{float(force) + 0.0:.4g}" for force in found["branch"].end_force)
    assert told.split("\n")[-1].startswith("  branch: 8 segments, curvature ")
    assert told.endswith(f"end force ({x}, {y}, {z}) N")
    html = found._repr_html_()
    assert html.count("<tr>") == told.count("\n")
    assert html.endswith('">')
    assert html.count("<img") == 1
    many = str(jax.tree.map(lambda leaf: np.stack([leaf, np.asarray(leaf) + (leaf.dtype.kind == "f")]), found))
    assert many.startswith("Equilibrium of 2 harnesses, 2 cables, 1 joint\n")
    assert f"joint y: position ({float(found.positions[0, 0]):.4g} to {float(found.positions[0, 0]) + 1:.4g}, " in many
    mode = rj.lowest_mode(found)
    assert str(mode).startswith(f"Mode of a harness: stiffness {float(mode.stiffness):.4g} N, largest motion of ")


def test_branches_and_modes_are_printed_in_words():
    """A strut buckles at pi^2/4 of EI/L^2."""
    strut = rj.Rod(1.0, 1.0, 0.8, 1e6)
    pressed = [rj.Scene(strut, CLAMP, rj.Free(force=(-force, 0, 0))) for force in (0.0, 4.0)]
    branch = rj.follow(pressed, segments=8, max_points=12)
    first, *others = str(branch).split("\n  ")
    assert first.startswith("Branch of 12 points, parameter 0 to ")
    assert first.endswith(", index 0 to 2: it has as many points as were allowed")
    (point,) = branch.critical_points
    assert others == [str(point)]
    assert str(point).startswith("Another branch crosses at parameter 0.6169, index 0 before and 2 after; Mode: ")
    assert str(point).endswith(") at node 8 of 8")
    # Traced numbers have no values.
    jax.jit(lambda branch: (str(branch), str(branch.critical_points[0]), branch.parameter)[2])(branch)


def test_dir_and_pydoc_are_complete():
    assert set(rj.__all__) <= set(dir(rj))
    assert not [name for name in dir(rj) if name.startswith("_") and name != "__version__"]
    assert all(hasattr(rj, name) for name in dir(rj))
    text = pydoc.render_doc(rj, renderer=pydoc.plaintext)
    # Also what is imported when it is asked for.
    assert all(f"{name}" in text for name in ("solve", "route", "report", "energy"))
    undocumented = [name for name in rj.__all__ if not (getattr(rj, name).__doc__ or "").strip()]
    assert not undocumented


# --- the energy -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scene",
    [pytest.param(problems.hanging_cable(), marks=pytest.mark.slow, id="hanging"), problems.omega(1.0, 0.7)],
)
def test_energy_and_residual_are_those_of_the_solve(scene):
    """Where the rod is in equilibrium; and the residual is the gradient there and elsewhere."""
    found = rj.solve(scene, segments=12, discretization="finite_difference")
    energy = rj.energy(scene, found.nodes, found.total_twist)
    np.testing.assert_allclose(energy, found.energy, rtol=1e-9)
    # To the tolerance of 1e-8 EI/L^2 and the rounding of positions, 4 EI/L^2 eps 12^3 and EA eps.
    assert np.max(np.abs(rj.residual(scene, found.nodes, found.total_twist))) < 1e-7
    rng = np.random.default_rng(1)
    nodes = np.asarray(found.nodes) + 1e-3 * rng.normal(size=(13, 3))
    nodes[[0, -1]] = np.asarray(found.nodes)[[0, -1]]
    direction = rng.normal(size=(13, 3))
    direction[[0, -1]] = 0
    step = 1e-6
    ends = [float(rj.energy(scene, nodes + sign * step * direction, found.total_twist)) for sign in (-1, 1)]
    slope = float(jnp.sum(rj.residual(scene, nodes, found.total_twist) * direction))
    # A central difference of an energy of second derivatives up to EA n/L = 1e4: 1e-6 of the slope.
    assert (ends[1] - ends[0]) / (2 * step) == pytest.approx(slope, rel=1e-5)


def test_an_optimiser_of_ones_own_finds_the_equilibrium():
    """SciPy's, over the free nodes of a soft cable; from a catenary-like parabola."""
    cable = rj.Rod(1.0, 5e-3, 3e-3, 50.0, mass_per_length=0.1)
    scene = rj.Scene(cable, CLAMP, rj.Clamp((0.8, 0, 0), rj.frame((1, 0, 0))), (0.0, 0.0, -9.81))
    found = rj.solve(scene, segments=8, discretization="finite_difference")
    x = np.linspace(0, 1, 9)
    start = np.stack([0.8 * x, 0 * x, -0.9 * x * (1 - x)], axis=1)

    def nodes(free):
        return jnp.concatenate([start[:1], free.reshape(-1, 3), start[-1:]])

    value = jax.jit(lambda free: rj.energy(scene, nodes(free)))
    slope = jax.jit(lambda free: rj.residual(scene, nodes(free))[1:-1].ravel())
    best = scipy.optimize.minimize(value, start[1:-1].ravel(), jac=slope, method="BFGS", options={"gtol": 1e-7})
    np.testing.assert_allclose(nodes(best.x), found.nodes, atol=1e-5)
    assert best.fun == pytest.approx(float(found.energy), rel=1e-8)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (dict(clips=[rj.Clip(0.5, (0.4, 0.0, -0.1))]), "scene must have no clips"),
        (dict(end=rj.Free(moment=(0, 0.01, 0))), "scene must have no loads without a potential"),
        (dict(rod=rj.Rod(1.0, (4e-3, 5e-3), 3e-3, 500.0)), "scene must have no rod that varies"),
    ],
)
def test_scenes_without_such_an_energy_are_refused(change, said):
    parts = dict(rod=problems.cable(), start=CLAMP, end=rj.Clamp((0.8, 0, 0), rj.frame((1, 0, 0)))) | change
    with pytest.raises(ValueError, match=said):
        rj.energy(rj.Scene(**parts), np.linspace((0, 0, 0), (1, 0, 0), 9))
    with pytest.raises(ValueError, match="nodes must be at least 3, of 2 edges, got 2"):
        rj.energy(problems.hanging_cable(), [(0, 0, 0), (0.8, 0, 0)])


@pytest.mark.slow
def test_single_precision_is_said_once():
    code = """
import warnings
import rodjax as rj
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for _ in range(2):
        rj.solve(rj.problems.hanging_cable(), segments=8)
print([str(w.message) for w in caught if w.category is rj.PrecisionWarning])
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=_without_x64())
    assert said.stdout.count("the numbers are float32") == 1


def _without_x64():
    return {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
