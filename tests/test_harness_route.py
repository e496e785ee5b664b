"""route() of harnesses: an optimum in closed form, rates beside differences, files and reports."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from route_rates import assert_rates_are_those_of_solves

import rodjax as rj
from rodjax import cli
from rodjax.routing.files import read_route_file
from rodjax.routing.route import _problem

RADIUS = 0.005
TIGHT = rj.Newton(tolerance=1e-12)
LIMITS = rj.Limits(bend_radius=9.0)
VARIABLES = [
    rj.Between("cables.last.end.position.0", 0.05, 0.25),
    rj.Between("cables.last.end.position.2", 0.05, 0.25),
    rj.Between("cables.first.rod.length", 0.02, 0.3),
]


def corner() -> rj.Harness:
    """A cable that turns by a right angle, from x to z, cut in two."""
    rods = [rj.Rod(length, 0.02, 0.015, 2e4, 0.15, RADIUS) for length in (0.2, 0.1)]
    start, end = (
        rj.Clamp(place, rj.frame(tangent)) for place, tangent in (((0, 0, 0), (1, 0, 0)), ((0.2, 0, 0.2), (0, 0, 1)))
    )
    return rj.Harness(
        {"first": rj.Scene(rods[0], start, rj.Joint("cut")), "last": rj.Scene(rods[1], rj.Joint("cut"), end)}
    )


@pytest.fixture(scope="module")
def shortest() -> rj.Route:
    return rj.route(corner(), VARIABLES, limits=LIMITS, starts=2, segments=12, solver=TIGHT)


def test_the_shortest_turn_is_an_arc(shortest):
    """Of all curves of a least radius of curvature that turn by a right angle, the shortest is the arc."""
    radius = 9 * 2 * RADIUS + RADIUS
    assert shortest.feasible
    assert shortest.optimal
    # As of a single cable: the limit is kept on meshes twice as fine, of fourth order.
    assert shortest.objective == pytest.approx(np.pi / 2 * radius, rel=1e-5)
    np.testing.assert_allclose(shortest.numbers[:2], radius, rtol=3e-3)
    assert shortest.numbers[2] == pytest.approx(shortest.objective - 0.1, rel=1e-12)
    # Each cable has its limit; both together what a single one has: 2 * 9 radii more by the whole limit.
    assert set(shortest.multipliers) == {"first: bend radius", "last: bend radius"}
    assert sum(shortest.multipliers.values()) == pytest.approx(np.pi / 2 * 18 * RADIUS, rel=1e-3)
    assert shortest.margins.names == ("first: bend radius", "last: bend radius")
    assert isinstance(shortest.verified, rj.HarnessEquilibrium)
    assert shortest.verified.segments == [24, 24]
    assert "on a mesh of 24 segments" in str(shortest)
    assert shortest.gradients["last: bend radius"].shape == (3,)
    np.testing.assert_allclose(shortest.gradients["objective"], [0, 0, 1], atol=1e-12)


def test_the_designs_of_the_search_are_kept(shortest):
    lengths = np.asarray(shortest.designs["first"].rod.length)
    assert lengths[-1] == shortest.numbers[2]
    assert 4 < len(lengths) <= 1 + int(np.max(shortest.starts.iterations))


def test_rates_are_those_of_solves():
    problem, _ = _problem(corner(), VARIABLES, LIMITS, None, (), None, 12, TIGHT)
    assert_rates_are_those_of_solves(problem, 2, np.array([0.6, 0.5, 0.5]))


def test_a_report_has_what_a_route_found_of_each_cable(shortest):
    report = rj.report(shortest)
    first, last = report.cables
    assert first.gradients is not None
    assert last.gradients is not None
    assert first.gradients.margins == last.gradients.margins == ("bend radius",)
    np.testing.assert_array_equal(last.gradients.derivatives[0], shortest.gradients["last: bend radius"])
    # Once for both, above them, in text and page.
    for told, first in ((str(report), "--- first"), (report.html(), "<h2>first</h2>")):
        for once in ("It is optimal to first order", "upper bound"):
            assert told.count(once) == 1, once
            assert told.index(once) < told.index(first)


FILE = """
scene = "corner.toml"
starts = 2

[limits]
bend_radius = 9

[[variables]]
kind = "between"
key = "cables.last.end.position.0"
lower = "50 mm"
upper = "250 mm"

[[variables]]
kind = "between"
key = "cables.last.end.position.2"
lower = "50 mm"
upper = "250 mm"

[[variables]]
kind = "between"
key = "cables.first.rod.length"
lower = "20 mm"
upper = "300 mm"
"""


def test_the_command_finds_the_same(shortest, tmp_path, capsys):
    rj.write_scene(corner(), tmp_path / "corner.toml", segments=12)
    (tmp_path / "route.toml").write_text(FILE)
    assert cli.main(["route", str(tmp_path / "route.toml"), "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    assert "It is optimal to first order" in told
    assert "route.toml, 24 segments" in told
    assert "--- first: kept" in told
    found = json.loads((tmp_path / "out" / "route.json").read_text())
    # To the tolerance of the search; this one is by the default solver.
    assert found["objective"] == pytest.approx(shortest.objective, rel=1e-6)
    again = rj.read_scene(tmp_path / "out" / "scene.toml")
    assert isinstance(again, rj.Harness)
    assert again["first"].rod.length == found["values"]["cables.first.rod.length"]


def test_the_harness_of_the_experiments_is_one_to_route():
    file = read_route_file(Path(__file__).parents[1] / "experiments" / "routes" / "harness.toml", for_route=True)
    assert isinstance(file.of_route.scenes[0], rj.Harness)
    assert [variable.key.split(".")[1] for variable in file.variables] == ["left", "right", "trunk"]


def test_what_makes_no_sense_is_refused():
    stack = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), corner())
    with pytest.raises(ValueError, match="scene must be a single one, got a stack"):
        rj.route(stack, VARIABLES, limits=LIMITS)
    with pytest.raises(ValueError, match=r"'rod\.length' is no number of this harness; there are cables\.first\.rod"):
        rj.route(corner(), [rj.Between("rod.length", 0.1, 0.2)])
    thin = [dataclasses.replace(scene, rod=rj.Rod(0.2, 0.02, 0.015, 2e4)) for scene in corner().scenes]
    harness = rj.Harness(dict(zip(("first", "last"), thin, strict=True)))
    with pytest.raises(ValueError, match=r"first: limits\.bend_radius must be None for a rod without a radius"):
        rj.route(harness, VARIABLES, limits=LIMITS)
