"""Branches of harnesses: a column cut in two and joined is the column. Folds: test_frames_of_literature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Body, Clamp, Free, Harness, Joint, Plane, Rod, Scene, frame

LEVEL = frame((1.0, 0.0, 0.0))
START = Clamp((0.0, 0.0, 0.0), LEVEL)
LOAD, SEGMENTS = 4.0, 8
# EA L^2/EI of 1e8 shifts Euler's load by 2.5e-8 of it, 16 elements by less than 1e-7.
EA = 1e8


def load_on(load) -> jax.Array:
    return jnp.array([-load, 0.0, 0.0])


def column(load, EI=1.0) -> Scene:
    return Scene(Rod(1.0, EI, 0.8, EA), START, Free(force=load_on(load)))


def cut(load, EI=1.0) -> Harness:
    """The same column in two halves, which end in bodies."""
    half = Rod(0.5, EI, 0.8, EA)
    halves = {
        "low": Scene(half, Joint("base", LEVEL), Joint("middle", LEVEL)),
        "high": Scene(half, Joint("middle", LEVEL), Joint("top", LEVEL)),
    }
    return Harness(halves, {"base": Body(support=Clamp((0.0, 0.0, 0.0), np.eye(3))), "top": Body(force=load_on(load))})


def ends(EI=1.0) -> list[Harness]:
    return [cut(0.0, EI), cut(LOAD, EI)]


@pytest.fixture(scope="module")
def buckling() -> rj.CriticalPoint:
    return rj.critical_point(ends(), segments=SEGMENTS)


@pytest.mark.slow
def test_a_column_cut_in_two_buckles_as_the_column(buckling):
    whole = rj.critical_point([column(0.0), column(LOAD)], segments=2 * SEGMENTS)
    # The elements are the same: what is left is the tolerance of the search, 1e-9 EI/L^2.
    assert abs(LOAD * (buckling.parameter - whole.parameter)) < 1e-8
    assert LOAD * buckling.parameter == pytest.approx(np.pi**2 / 4, rel=1e-7)
    assert (buckling.kind, buckling.index_before, buckling.index_after) == ("branch", 0, 2)
    assert abs(buckling.mode.stiffness) < 1e-8
    # 1 - cos(pi s / (2 L)), from the clamp to the free end.
    moved = jnp.concatenate([buckling.mode.displacements["low"], buckling.mode.displacements["high"][1:]])
    s = np.linspace(0.0, 1.0, 2 * SEGMENTS + 1)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1 - np.cos(np.pi * s / 2), atol=1e-5)


@pytest.mark.slow
def test_its_load_grows_with_its_stiffness(buckling):
    rate = jax.grad(lambda EI: rj.critical_point(ends(EI), segments=SEGMENTS).parameter)(1.0)
    # The load is pi^2 EI / (4 L^2), but for the 2.5e-8 by which the column is shortened, a part that goes with EI.
    assert rate == pytest.approx(float(buckling.parameter), rel=1e-7)


@pytest.mark.slow
def test_its_buckled_branch_is_that_of_the_column(buckling):
    parameter, beside = rj.switch_branch(ends(), buckling)
    assert beside.converged
    assert parameter > buckling.parameter
    # As the column may bend to any side, the buckled one can turn about its axis: neutral, and no critical motion.
    branch = rj.follow(ends(), guess=beside, start=float(parameter), max_step=0.2)
    assert branch.ended == rj.BranchEnd.SCENES
    assert not branch.critical_points
    assert np.all(branch.index == 0)
    assert np.all(branch.equilibria.stable)
    assert branch.parameter[-1] == 1.0
    aside = rj.Guess([(0.0, 0.0, 0.0), (0.5, 0.3, 0.0), (0.6, 0.7, 0.0)])
    whole = rj.solve(column(LOAD), segments=2 * SEGMENTS, guess=aside)
    assert branch.equilibria.energy[-1] == pytest.approx(float(whole.energy), rel=1e-12)
    assert branch.equilibria.rod(1).nodes.shape == (len(branch.parameter), SEGMENTS + 1, 3)


@pytest.mark.slow
def test_a_path_stops_before_it_buckles(buckling):
    scenes = [cut(load) for load in (0.0, LOAD / 2, LOAD)]
    path = rj.solve_path(scenes, segments=SEGMENTS, at_critical="stop")
    assert path.energy.shape == (2,)
    (found,) = rj.critical_points([scenes[0], scenes[2]], jax.tree.map(lambda leaf: leaf[jnp.array([0, 1])], path))
    assert found.parameter == pytest.approx(float(buckling.parameter), abs=1e-9)


NEAR = Scene(Rod(0.5, 1.0, 0.8, EA, radius=0.01), START, Joint("top"), obstacles=[Plane((0, 0, -1), (0, 0, 1))])
BESIDE = Harness({"rod": NEAR})
THICK = Rod(1.0, 1.0, 0.8, EA, radius=0.01)
TOUCHING = Harness(
    {str(x): Scene(THICK, Clamp((x, 0.0, 0.0), np.eye(3)), Clamp((x, 0.0, 1.0), np.eye(3))) for x in (0.0, 0.1)},
    contact=True,
)


@pytest.mark.parametrize(
    ("take", "message"),
    [
        (lambda: rj.follow([BESIDE, BESIDE]), "follow needs scenes without obstacles"),
        (lambda: rj.follow([TOUCHING, TOUCHING]), "follow needs scenes without contact"),
        (lambda: rj.critical_point([cut(0.0)]), "scenes must be at least two"),
        (lambda: rj.follow([cut(0.0), BESIDE]), r"scenes\[1\] must have the structure of scenes\[0\]"),
        (lambda: rj.follow(ends(), guess=rj.Guess([(0, 0, 0), (1, 0, 0)])), "guess must be a HarnessEquilibrium"),
        (
            lambda: rj.solve_path([BESIDE, BESIDE], at_critical="stop"),
            "at_critical must be 'jump' for scenes with obstacles",
        ),
        (lambda: rj.follow([column(0.0), cut(0.0)]), r"scenes\[1\] is a Harness"),
        (
            lambda: jax.jit(lambda load: rj.follow([cut(0.0), cut(load)]).parameter)(1.0),
            "follow needs scenes of known numbers",
        ),
    ],
)
def test_what_is_refused(take, message):
    with pytest.raises((TypeError, ValueError), match=message) as error:
        take()
    assert "\n" not in str(error.value)
