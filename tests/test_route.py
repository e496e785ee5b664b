"""route(): an optimum in closed form, rates beside differences, obstacles, bits, and words for what cannot be kept."""

from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from route_rates import assert_rates_are_those_of_solves

import rodjax as rj
from rodjax.programs.tasks import Workers
from rodjax.routing.problem import spare_lengths
from rodjax.routing.rounds import Rounds
from rodjax.routing.route import _Fleet, _problem
from rodjax.routing.search import Numbers, Search, Settings
from rodjax.routing.variables import with_numbers

RADIUS = 0.005
AWAY = rj.Sphere((0.0, 1.0, 0.0), 0.05)
TIGHT = rj.Newton(tolerance=1e-12)
VARIABLES = [
    rj.Between("end.position.0", 0.05, 0.25),
    rj.Between("end.position.2", 0.05, 0.25),
    rj.Between("rod.length", 0.1, 0.45),
]
HERE = Workers(None, 1)


def corner() -> rj.Scene:
    """A cable that turns by a right angle, from x to z."""
    rod = rj.Rod(0.3, 0.02, 0.015, 2e4, 0.15, RADIUS)
    return rj.Scene(rod, rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), rj.Clamp((0.2, 0, 0.2), rj.frame((0, 0, 1))))


def routed(bend_radius=9.0, obstacle=AWAY, seed=0, **workers) -> rj.Route:
    limits = rj.Limits(bend_radius=bend_radius, clearance=0.01)
    options = dict(limits=limits, obstacles=[obstacle], names=["the ball"], starts=4, segments=16, solver=TIGHT)
    return rj.route(corner(), VARIABLES, seed=seed, **options, **workers)


@pytest.fixture(scope="module")
def shortest() -> rj.Route:
    return routed()


def test_the_shortest_turn_is_an_arc(shortest):
    """Of all curves of a least radius of curvature that turn by a right angle, the shortest is the arc."""
    radius = 9 * 2 * RADIUS + RADIUS
    assert shortest.feasible
    # The limit is kept on 32 elements, of fourth order: 1e-6 of the curvature; the reserve for that is about as much.
    assert shortest.objective == pytest.approx(np.pi / 2 * radius, rel=1e-5)
    assert shortest.optimal
    assert np.all(shortest.starts.optimal)
    # The length goes with the radius, 2 * 9 times the rod's and once that: a whole limit more adds 2 * 9 of it.
    assert shortest.multipliers == {"bend radius": pytest.approx(np.pi / 2 * 18 * RADIUS, rel=1e-3)}
    assert "optimal to first order" in str(shortest)
    assert "active limits: bend radius (0.0014 for 1 %)" in str(shortest)
    # Where the end is, the length depends on by the square.
    np.testing.assert_allclose(shortest.numbers[:2], radius, rtol=3e-3)
    assert shortest.names == ("end.position.0", "end.position.2", "rod.length")
    assert shortest.units == ("m", "m", "m")
    assert shortest.values["rod.length"] == pytest.approx(shortest.objective, rel=1e-12)
    assert shortest.margins.names == ("bend radius", "clearance to the ball")
    assert 0 <= float(shortest.margins.margin[0]) < 3e-3
    assert shortest.verified.s.shape == (33,)
    np.testing.assert_array_equal(shortest.starts.feasible, True)
    np.testing.assert_allclose(shortest.starts.objective, shortest.objective, rtol=1e-3)
    # The length is the objective, and of no influence on itself but by one.
    np.testing.assert_allclose(shortest.gradients["objective"], [0, 0, 1], atol=1e-12)
    assert shortest.gradients["bend radius"].shape == (3,)
    assert "keeps to all limits" in str(shortest)
    assert "4 of 4 starts" in str(shortest)


def test_the_designs_of_the_search_are_kept(shortest):
    """From a start to the route."""
    designs = shortest.designs
    assert eqx.tree_equal(jax.tree.map(lambda leaf: leaf[-1], designs), shortest.scene)
    lengths = np.asarray(designs.rod.length)
    assert 4 < len(lengths) <= 1 + int(np.max(shortest.starts.iterations))
    # Converging: the last steps are smaller than the first.
    steps = np.abs(np.diff(lengths))
    assert np.max(steps[-2:]) < 0.01 * np.max(steps)
    path = rj.solve_path(designs, segments=16, solver=TIGHT)
    np.testing.assert_allclose(path.nodes[-1], shortest.equilibrium.nodes, atol=1e-9)


def test_rates_are_those_of_solves():
    limits = rj.Limits(bend_radius=9.0, clearance=0.01)
    problem, _ = _problem(corner(), VARIABLES, limits, None, [AWAY], None, 16, TIGHT)
    assert_rates_are_those_of_solves(problem, 4, np.array([0.6, 0.5, 0.6]))


def test_a_design_without_a_mesh_is_not_drawn():
    """A clip at 0.1 to 0.2 m passes a force that follows the rod at 0.15 m, which needs an element of its own beside
    it: a twentieth of one of 16 at least.
    """
    rod, *ends = corner().rod, corner().start, corner().end
    force = rj.PointForce(0.15, (0.0, 0.0, 0.1), follower=True)
    scene = rj.Scene(rod, *ends, clips=[rj.Clip(0.1, (0.09, 0, 0.02))], point_forces=[force])
    moved = [rj.Between("clips.0.at", 0.1, 0.2)]
    problem, _ = _problem(scene, moved, rj.Limits(bend_radius=9.0), None, (), None, 16, TIGHT)
    least = 0.05 * 0.3 / 16 / 0.1
    spare = np.asarray(spare_lengths(problem, 0.5 + least * jnp.array([[-0.9], [-1.1], [1.1]])))
    assert spare[0] == -np.inf
    assert np.all(np.isfinite(spare[1:]))


def test_a_start_without_an_equilibrium_is_drawn_again(monkeypatch):
    solve, calls = _Fleet._solved_cold, []

    def missing_one(self, designs):
        results = solve(self, designs)
        calls.append(designs.copy())
        # In the first two draws the third start has none.
        return eqx.tree_at(lambda r: r.converged, results, results.converged.at[2].set(len(calls) > 2))

    monkeypatch.setattr(_Fleet, "_solved_cold", missing_one)
    problem, _ = _problem(corner(), VARIABLES, rj.Limits(bend_radius=9.0), None, (), None, 16, TIGHT)
    fleet = _Fleet(problem, 4, np.random.default_rng(0), HERE)
    assert fleet.redrawn == 2
    np.testing.assert_array_equal(fleet.solves, [1, 1, 3, 1])
    others = [0, 1, 3]
    np.testing.assert_array_equal(calls[2][others], calls[0][others])
    assert np.all(calls[2][2] != calls[0][2])
    np.testing.assert_array_equal(fleet._starts, calls[2])


@pytest.mark.slow
def test_a_softest_motion_may_be_limited(shortest):
    stiffness = float(rj.lowest_mode(shortest.verified).stiffness)
    limits = rj.Limits(bend_radius=9.0, stability=0.9 * stiffness)
    route = rj.route(corner(), VARIABLES, limits=limits, starts=1, segments=16, solver=TIGHT)
    assert route.feasible
    kept = dict(zip(route.margins.names, np.asarray(route.margins.margin), strict=True))
    # The same arc as without: what is asked of the motion it has, to the reserve of the bend radius.
    assert kept["stability"] == pytest.approx(1 / 0.9 - 1, abs=5e-3)
    assert route.objective == pytest.approx(shortest.objective, rel=1e-4)
    stiffer = rj.Limits(bend_radius=1e-3, stability=4 * stiffness)  # the same programs
    route = rj.route(corner(), VARIABLES, limits=stiffer, starts=1, segments=16, solver=TIGHT)
    assert route.feasible
    found = float(rj.lowest_mode(route.verified).stiffness)
    assert found >= 4 * stiffness
    kept = dict(zip(route.margins.names, np.asarray(route.margins.margin), strict=True))
    assert kept["stability"] == pytest.approx(found / (4 * stiffness) - 1, abs=1e-6)


@pytest.mark.slow
def test_the_softest_motion_of_a_rod_that_slides_may_be_limited():
    """The least energy is that of a slacker rod: the limit is active, to the reserve for the mesh."""
    scene = corner()
    clip = rj.Clip(0.16, (0.13, 0.0, 0.07), sliding=True)
    scene = rj.Scene(scene.rod, scene.start, scene.end, clips=[clip])
    stiffness = 35.126  # of the scene as it is
    limits = rj.Limits(stability=1.2 * stiffness)
    variables = [rj.Between("end.position.0", 0.17, 0.21)]
    route = rj.route(
        scene, variables, limits=limits, objective=rj.Objective(energy=1.0), starts=1, segments=16, solver=TIGHT
    )
    assert route.feasible
    found = float(rj.lowest_mode(route.verified).stiffness)
    assert found == pytest.approx(1.2 * stiffness, rel=0.01)
    assert route.margins.names == ("stability",)
    assert float(route.margins.value[0]) == pytest.approx(found)


@pytest.mark.slow
def test_an_obstacle_in_the_way_is_passed(shortest):
    """A ball on the arc: the way around it is longer, and clear of it on a finer mesh."""
    ball = rj.Sphere(np.asarray(shortest.equilibrium.nodes[8]) + np.array([0.0, 0.002, 0.0]), 0.01)
    around = routed(obstacle=ball)
    assert around.feasible
    assert around.objective > 1.01 * shortest.objective
    finer = rj.solve(around.scene, segments=64, guess=around.equilibrium)
    # As far as asked, to the samples of `clearance`, 1 mm apart.
    assert float(rj.clearance(finer, [ball]).distance[0]) >= 0.01 * (1 - 1e-4)


@pytest.mark.slow
def test_what_cannot_be_kept_is_said(shortest):
    """A bend radius of 0.4 m in a space of 0.25 m."""
    route = routed(bend_radius=40.0)
    assert not route.feasible
    assert not np.any(route.starts.feasible)
    assert np.all(route.starts.violation > 0)
    assert "No route was found that keeps to all limits: 0 of 4" in str(route)
    assert "bend radius by" in str(route)
    assert float(route.margins.margin[0]) < 0


def test_an_error_in_one_search_ends_all():
    def failing(ask):
        ask(1)
        raise ZeroDivisionError("in a search")

    def endless(ask):
        while True:
            ask(2)

    with pytest.raises(ZeroDivisionError, match="in a search"):
        Rounds([endless, failing, endless], lambda asked: asked).run()

    def interrupted(asked):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Rounds([endless, endless], interrupted).run()


def test_a_taut_trial_takes_no_solve():
    """Down to 0.001 of the length too little, or twice of what there was at the start: where rod is left for a way x^2
    of at most 0.25, the first step from 0.1 goes straight on to 1.
    """

    def spares_asked(begin: float, spare) -> np.ndarray:
        asked = []

        def evaluated(design):
            asked.append(0.25 - design[0] ** 2)
            return Numbers(1 - design[0], np.array([asked[-1]]), np.array([[-1.0], [-2 * design[0]]]), True)

        first = evaluated(np.array([begin]))
        settings = Settings(1.0, 1e-3, 1e-9, 20)
        Search(np.array([begin]), first, settings, lambda asked: evaluated(asked.design), spare).run()
        # The best is where the reserve of 0.001 is left.
        assert asked[-1] == pytest.approx(1e-3, abs=1e-6)
        return np.array(asked)

    assert np.min(spares_asked(0.1, lambda design: np.inf)) == -0.75
    assert np.min(spares_asked(0.1, lambda design: 0.25 - design[0] ** 2)) >= -1e-3
    from_taut = spares_asked(0.6, lambda design: 0.25 - design[0] ** 2)
    assert np.min(from_taut) >= -0.22
    assert np.min(from_taut[1:]) < -1e-3


def test_a_search_tells_where_it_stood():
    """Down a parabola with the minimum at 0.7: from where it began, each place lower than the one before."""

    def evaluated(design):
        return Numbers((design[0] - 0.7) ** 2, np.zeros(0), np.array([[2 * (design[0] - 0.7)]]), True)

    begin = np.array([0.1])
    search = Search(
        begin,
        evaluated(begin),
        Settings(1.0, np.zeros(0), 1e-12, 20),
        lambda asked: evaluated(asked.design),
        lambda design: np.inf,
    )
    stood = np.array(search.run().designs)[:, 0]
    assert stood[0] == 0.1
    assert stood[-1] == pytest.approx(0.7, abs=1e-6)
    assert np.all(np.diff((stood - 0.7) ** 2) < 0)


def test_variables():
    scene = rj.Scene(
        rj.Rod(1.0, 0.02, 0.015, 2e4),
        rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))),
        rj.Swivel((0.8, 0, 0), (1, 0, 0)),
        clips=[rj.Clip(0.4, (0.3, 0, 0), (1, 0, 0.2)), rj.Clip(0.7, (0.6, 0, 0))],
    )
    variables = (
        rj.OnLine("clips.0.position", (0.2, 0, 0), (0.4, 0, 0.2)),
        rj.OnSurface("clips.1.position", lambda u, v: jnp.stack([0.5 + 0.2 * u, 0.1 * v, 0.0 * u])),
        rj.Turned("clips.0.tangent", 0.3),
        rj.Turned("start.frame", 0.2),
        rj.Between("clips.0.at", 0.3, 0.5),
    )
    count = sum(variable.count for variable in variables)
    assert count == 9
    moved = with_numbers(scene, variables, jnp.array([0.25, 0.5, 1.0, 1.0, 1.0, 0.5, 0.5, 1.0, 0.75]))
    np.testing.assert_allclose(moved.clips[0].position, (0.25, 0, 0.05), atol=1e-15)
    np.testing.assert_allclose(moved.clips[1].position, (0.6, 0.1, 0), atol=1e-15)
    assert float(moved.clips[0].at) == pytest.approx(0.45)
    # A corner of the square is on the rim of the disc: the full angle.
    cosine = float(moved.clips[0].tangent @ scene.clips[0].tangent)
    assert np.arccos(cosine) == pytest.approx(0.3, rel=1e-9)
    # The third number turns about the tangent alone.
    np.testing.assert_allclose(moved.start.frame[:, 2], (1, 0, 0), atol=1e-15)
    assert float(moved.start.frame[:, 0] @ scene.start.frame[:, 0]) == pytest.approx(np.cos(0.2), rel=1e-12)
    starts = [variable.start(np.asarray(value)) for variable, value in zip(variables, _nominal(scene), strict=True)]
    expected = ([0.25], [0.5, 0], [0.5, 0.5], [0.5] * 3, [0.5])
    for start, number in zip(starts, expected, strict=True):
        np.testing.assert_allclose(start, number, atol=1e-12)


def _nominal(scene: rj.Scene):
    first, second = scene.clips
    return first.position, second.position, first.tangent, scene.start.frame, first.at


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ([], "variables must hold at least one"),
        ([rj.Between("clips.0.at", 0.1, 0.2)], "'clips.0.at' is no number of this scene; there are rod.length"),
        ([rj.Between("end.position", 0.1, 0.2)], r"lower and upper of end.position must be numbers of shape \(3,\)"),
        ([rj.Between("end.frame", 0.1, 0.2)], "end.frame is a direction or frame: rodjax.Turned varies it"),
        ([rj.Turned("end.position", 0.1)], "end.position is no direction or frame"),
        ([rj.OnLine("rod.length", (0, 0, 0), (1, 0, 0))], "rod.length is no position"),
        ([rj.Between("rod.length", 0.1, 0.2)] * 2, r"variables\[1\]: rod.length varies already"),
        (
            [rj.Between("end.position.2", 0.1, 0.2), rj.OnLine("end.position", (0, 0, 0), (1, 0, 0))],
            r"variables\[1\]: end.position varies already",
        ),
    ],
)
def test_variables_are_checked(variables, message):
    with pytest.raises(ValueError, match=message):
        rj.route(corner(), variables)


def test_arguments_are_checked():
    length = [rj.Between("rod.length", 0.2, 0.3)]
    with pytest.raises(ValueError, match=r"lower must be below upper for rod\.length, got 0\.3 and 0\.2"):
        rj.Between("rod.length", 0.3, 0.2)
    with pytest.raises(TypeError, match="scene must be a Scene or Harness, got 3"):
        rj.route(3, length)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="limits must have a clearance where there are obstacles"):
        rj.route(corner(), length, obstacles=[AWAY])
    with pytest.raises(ValueError, match="Objective must have at least one weight above 0"):
        rj.Objective(length=0)
    with pytest.raises(ValueError, match="starts must be a whole number from 1"):
        rj.route(corner(), length, starts=0)
    with pytest.raises(TypeError, match="solver must be a Newton"):
        rj.route(corner(), length, solver=rj.NonlinearCG())  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_the_same_arguments_give_the_same_bits_whoever_searches(shortest, monkeypatch):
    """In groups of two, again and by others, the same to the last bit; the arc as in one group. As executables: which
    of the first answers are NumPy code, equal to rounding, is a matter of time.

    The last test, as what is compiled here has other last bits than the NumPy code of the others.
    """
    monkeypatch.setattr("rodjax.routing.route.GROUP", 2)
    with ThreadPoolExecutor(2) as engine:
        kinds: list[dict] = [{"threads": 1}, {"threads": 1}, {"threads": 2}, {"executor": engine}]
        with rj.numpy_first(False):  # cold solves of all starts, too
            first, *others = (routed(**kind) for kind in kinds)
    assert first.feasible
    assert first.objective == pytest.approx(shortest.objective, rel=1e-5)
    np.testing.assert_array_equal(first.starts.feasible, True)
    for other in others:
        assert jax.tree.structure(other) == jax.tree.structure(first)
        for ours, theirs in zip(jax.tree.leaves(other), jax.tree.leaves(first), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert other.starts.message == first.starts.message
        assert other.multipliers == first.multipliers
