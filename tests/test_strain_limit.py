"""A rod that is strained by more than a cable bears is an equilibrium, and said to be strained: everywhere."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.cli import main

LENGTH, EA = 0.6, 832.0
ROD = rj.Rod(LENGTH, 4.9e-3, 3.3e-3, EA, radius=0.005)
LEVEL = np.asarray(rj.frame((1, 0, 0)))
MESH = {"segments": 8}


def between_clamps(distance):
    """Straight, with the strain distance/LENGTH - 1: the exact solution on every mesh."""
    return rj.Scene(ROD, rj.Clamp((0, 0, 0), LEVEL), rj.Clamp(jnp.array([1.0, 0, 0]) * distance, LEVEL))


def test_a_taut_rod_is_told_by_status_warning_and_words():
    with pytest.warns(rj.OverstretchedWarning, match=r"strain_limit = 5 %: largest axial strain \+25 % at s = "):
        taut = rj.solve(between_clamps(0.75), **MESH)
    # 25 % is exact; rounding of a residual of 1e-8 EI/L^2.
    np.testing.assert_allclose(taut.energy, EA * 0.25**2 / 2 * LENGTH, rtol=1e-8)
    assert bool(taut.converged)
    assert int(taut.status) == rj.Status.OVERSTRETCHED
    assert "strained by more than `strain_limit`" in rj.describe(taut)
    assert "largest axial strain +25 % at s = " in rj.describe(taut)


def test_warnings_point_at_the_line_that_called():
    scenes = jax.vmap(between_clamps)(jnp.array([0.5, 0.75]))
    calls = [
        lambda: rj.solve(between_clamps(0.75), **MESH),
        lambda: rj.solve_batch(scenes, **MESH),
        lambda: rj.solve_path(scenes, **MESH),
    ]
    for call in calls:
        with pytest.warns(rj.OverstretchedWarning) as caught:
            call()
        assert {warning.filename for warning in caught} == {__file__}


def test_of_a_harness_the_strained_cable_is_named():
    stiff = rj.Rod(LENGTH, 4.9e-3, 3.3e-3, 100 * EA, radius=0.005)
    joint = rj.Joint("joint", LEVEL)
    clamps = rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((1.353, 0, 0), LEVEL)
    cables = {"feed": rj.Scene(stiff, clamps[0], joint), "return": rj.Scene(ROD, joint, clamps[1])}
    with pytest.warns(rj.OverstretchedWarning) as caught:
        rj.solve(rj.Harness(cables), **MESH)
    # In series: (1.353 - 1.2)/1.01 of the length of the softer one.
    assert [str(warning.message) for warning in caught] == [
        "cable 'return' is strained by more than strain_limit = 5 %: largest axial strain +25.2 % at s = 0 m"
    ]


def test_in_the_continuum_too():
    with pytest.warns(rj.OverstretchedWarning, match=r"largest axial strain \+25 % at s = "):
        rj.solve_continuum(between_clamps(0.75))


def test_the_limit_is_an_argument_that_compiles_nothing():
    scene = between_clamps(0.75)
    for limit, status in ((0.26, rj.Status.CONVERGED), (0.24, rj.Status.OVERSTRETCHED), (None, rj.Status.CONVERGED)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = rj.solve(scene, strain_limit=limit, **MESH)
        assert int(result.status) == status
        assert bool(caught) == (status == rj.Status.OVERSTRETCHED)
    for wrong in (0.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="strain_limit must be"):
            rj.solve(scene, strain_limit=wrong, **MESH)
    traced = jax.jit(lambda limit: rj.solve(scene, strain_limit=limit, **MESH).status)
    assert [int(traced(limit)) for limit in (0.24, 0.26)] == [rj.Status.OVERSTRETCHED, rj.Status.CONVERGED]


def test_a_pressed_rod_is_told_as_a_stretched_one():
    straight = rj.Guess(np.linspace([0, 0, 0], [0.5, 0, 0], 9))
    with pytest.warns(rj.OverstretchedWarning, match=r"largest axial strain -16\.7 % at"):
        found = rj.solve(between_clamps(0.5), guess=straight, find="equilibrium", **MESH)
    assert bool(found.converged)
    np.testing.assert_allclose(found.axial_strain, 0.5 / LENGTH - 1, rtol=1e-8)
    assert int(found.status) == rj.Status.OVERSTRETCHED


@pytest.mark.slow
def test_batches_tell_which():
    distances = (0.5, 0.75, 0.62)
    scenes = [between_clamps(distance) for distance in distances]
    expected = [rj.Status.CONVERGED, rj.Status.OVERSTRETCHED, rj.Status.CONVERGED]
    with pytest.warns(rj.OverstretchedWarning, match=r"1 rod is strained .* of case 1"):
        batch = rj.solve_batch(scenes, **MESH)
    np.testing.assert_array_equal(batch.status, expected)
    with pytest.warns(rj.OverstretchedWarning, match=r"2 rods are .* 1 %"):
        rj.solve_batch(scenes, strain_limit=0.01, **MESH)


@pytest.mark.slow
def test_paths_tell_which():
    with pytest.warns(rj.OverstretchedWarning, match="of case 1"):
        path = rj.solve_path([between_clamps(distance) for distance in (0.5, 0.75)], **MESH)
    np.testing.assert_array_equal(path.status, [rj.Status.CONVERGED, rj.Status.OVERSTRETCHED])
    assert "1 converged, but the rod is strained" in rj.describe(path)


SCENE = """
[rod]
length = "0.6 m"
EI = "4.9e-3 N m^2"
GJ = "3.3e-3 N m^2"
EA = "832 N"
radius = "5 mm"

[start]
support = "clamp"
position = "[0, 0, 0] m"
tangent = [1, 0, 0]
d2 = [0, 1, 0]

[end]
support = "clamp"
position = "[0.75, 0, 0] m"
tangent = [1, 0, 0]
d2 = [0, 1, 0]

[solve]
segments = 8
"""


@pytest.mark.slow
def test_the_command_warns_and_reports_say_it(tmp_path, capsys):
    scene = tmp_path / "taut.toml"
    scene.write_text(SCENE)
    assert main(["solve", str(scene)]) == 0
    out, err = capsys.readouterr()
    assert "strained by more than `strain_limit`" in out
    assert err.startswith(f"rodjax: {scene}: warning: the rod is strained by more than strain_limit = 5 %")
    assert err.count("\n") == 1
    scene.write_text(SCENE + "strain_limit = 0.3\n")
    assert main(["solve", str(scene)]) == 0
    assert capsys.readouterr().err == ""
    scene.write_text(SCENE + "strain_limit = -0.3\n")
    assert main(["solve", str(scene)]) == 2
    assert "solve: strain_limit must be positive" in capsys.readouterr().err
    with pytest.warns(rj.OverstretchedWarning):
        taut = rj.solve(between_clamps(0.75), **MESH)
    report = rj.report(taut, limits=rj.Limits(end_force=1e4))
    assert "the axial strain reaches 25 %, which has no limit here" in report.verdict
    assert "NOT kept" in rj.report(taut, limits=rj.Limits(strain=0.1)).verdict
