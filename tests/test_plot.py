import io
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from rodjax import (
    Clamp,
    Clip,
    Free,
    Plane,
    PointForce,
    Rod,
    Scene,
    Smooth,
    Steps,
    drawing,
    frame,
    plot,
    problems,
    solve,
)
from rodjax.discretization.twist import angle_about, transport_along

SEGMENTS = 10
TURNS = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2, 2 * np.pi)


@pytest.fixture(scope="module")
def stages():
    found = [
        solve(
            problems.omega(problems.ARC_HALF_ANGLE, 0.0),
            segments=SEGMENTS,
            discretization="finite_difference",
            guess=problems.figure_1_start(),
        )
    ]
    for turn in TURNS:
        found.append(
            solve(
                problems.omega(np.pi / 6, turn), segments=SEGMENTS, discretization="finite_difference", guess=found[-1]
            )
        )
    return found


@pytest.fixture(scope="module")
def twisted(stages):
    return stages[-1]


def pixels(figure: Figure) -> np.ndarray:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=60)
    file.seek(0)
    return imread(file)[..., :3]


def strip_middle(points):
    """Direction from the centerline to the middle of the black strip."""
    first, last = points[:, 0], points[:, drawing.STRIP_FACES]
    return (first + last) / 2


def test_the_surface_lies_at_the_radius_from_the_centerline(twisted):
    _, centerline, points = drawing.tube(twisted, 0.02)
    distance = np.linalg.norm(points - centerline[:, None], axis=-1)
    np.testing.assert_allclose(distance, 0.02, rtol=1e-12)
    along = np.gradient(centerline, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    slope = np.einsum("kmi,ki->km", points - centerline[:, None], along) / 0.02
    assert np.abs(slope[2:-2]).max() < 0.01


def test_the_tube_is_smooth_between_ten_segments(twisted):
    _, centerline, _ = drawing.tube(twisted, 0.02)
    edges = np.diff(centerline, axis=0)
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    corners = np.degrees(np.arccos(np.sum(edges[1:] * edges[:-1], axis=1)))
    assert len(corners) > 10 * SEGMENTS
    assert corners.max() < 4


def test_the_strip_runs_along_d1_at_the_nodes(twisted):
    s, centerline, points = drawing.tube(twisted, 0.02)
    strip = strip_middle(points) - centerline
    strip /= np.linalg.norm(strip, axis=1, keepdims=True)
    at_nodes = [int(np.argmin(np.abs(s - node))) for node in twisted.s]
    np.testing.assert_allclose(s[at_nodes], twisted.s, atol=1e-12)
    np.testing.assert_allclose(strip[at_nodes], twisted.frames[:, :, 0], atol=1e-10)


def test_directors_between_nodes_pass_through_those_at_nodes_of_unequal_elements():
    level = frame((1.0, 0.0, 0.0))
    turned = frame((1.0, 0.0, 0.0), (0.0, 1.0, 2.0))
    clip = Clip(0.33, (0.3, 0.0, -0.05))
    scene = Scene(problems.cable(), Clamp((0, 0, 0), level), Clamp((0.8, 0, 0), turned), clips=[clip])
    equilibrium = solve(scene, segments=10)
    assert np.ptp(np.diff(equilibrium.s)) > 0.01
    _, tangents, d1 = drawing.framed_at(equilibrium, equilibrium.s)
    np.testing.assert_allclose(tangents, equilibrium.tangents, atol=1e-10)
    np.testing.assert_allclose(d1, equilibrium.frames[:, :, 0], atol=1e-10)


def test_the_strip_winds_by_the_total_twist(twisted):
    _, centerline, points = drawing.tube(twisted, 0.02)
    strip = strip_middle(points) - centerline
    strip /= np.linalg.norm(strip, axis=1, keepdims=True)
    edges = np.diff(centerline, axis=0)
    tangents = jnp.asarray(edges / np.linalg.norm(edges, axis=1, keepdims=True))
    tangents = jnp.concatenate([twisted.tangents[:1], tangents, twisted.tangents[-1:]]).T
    carried = transport_along(jnp.asarray(strip[0]), tangents)
    angle = angle_about(tangents[:, -1], carried[:, -1], jnp.asarray(strip[-1]))
    # The twist of the smooth curve through the nodes differs from that of the polyline by its discretization error.
    assert abs(angle % (2 * np.pi) - twisted.total_twist) < 0.15


def test_the_strip_keeps_turns_within_a_segment():
    """Straight rod, two segments, three turns: more than a turn from node to node."""
    rod = Rod(1.0, EI=1.0, GJ=0.2, EA=1e4)  # soft in torsion, so that it stays straight
    level = frame((1.0, 0.0, 0.0))
    straight = Scene(rod, Clamp((0.0, 0.0, 0.0), level), Clamp((1.0, 0.0, 0.0), level), turns=3)
    equilibrium = solve(straight, segments=2, discretization="finite_difference")
    _, centerline, points = drawing.tube(equilibrium, 0.02)
    strip = strip_middle(points) - centerline
    angle = np.unwrap(np.arctan2(strip[:, 2], strip[:, 1]))
    assert abs(angle[-1] - angle[0]) == pytest.approx(6 * np.pi, abs=1e-6)


def test_the_strips_are_painted_on_the_tube(twisted):
    figure = plot.figure_of(plot.plot_rod(twisted))
    pixels(figure)
    (surface,) = [a for a in figure.axes[0].collections if isinstance(a, Poly3DCollection)]
    colors = np.asarray(surface.get_facecolor())
    s, _, _ = drawing.tube(twisted, 0.02)
    rings = len(s) - 1
    assert len(colors) == (rings + 2) * drawing.FACES_AROUND  # with two caps
    is_black = np.all(colors[:, :3] == 0, axis=1)
    assert is_black.sum() == (rings + 2) * drawing.STRIP_FACES
    is_grey = np.ptp(colors[:, :3], axis=1) < 1e-12
    assert is_grey.sum() == 2 * (rings + 2) * drawing.STRIP_FACES


@pytest.mark.parametrize(
    ("color_by", "label"),
    [("curvature", "curvature [1/m]"), ("twist", "twist rate [rad/m]"), ("tension", "tension [N]")],
)
def test_the_color_bar_has_units_and_the_range_of_the_field(twisted, color_by, label):
    figure = plot.figure_of(plot.plot_rod(twisted, color_by=color_by))
    _, bar = figure.axes
    assert bar.get_ylabel() == label
    low, high = bar.get_ylim()
    values = np.asarray(getattr(twisted, color_by))
    if color_by == "twist":  # constant along the rod
        values = np.array([0.9, 1.1]) * values[0]
    np.testing.assert_allclose((low, high), (values.min(), values.max()))


def test_all_axes_have_one_scale(twisted):
    axes = plot.plot_rod(twisted)
    spans = [np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    ratio = np.asarray(axes._box_aspect) / spans  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(ratio, ratio[0])
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis), ("z", axes.zaxis)):
        assert axis.get_label_text() == f"{name} [m]"


def test_a_thin_rod_is_drawn_thicker_and_the_picture_says_so(twisted):
    def notes(axes):
        return [text.get_text() for text in axes.texts]

    assert notes(plot.plot_rod(twisted, radius=0.005)) == [""]
    assert notes(plot.plot_rod(twisted, radius=0.015)) == ["drawn 3 times as thick as it is"]
    size = float(np.max(np.ptp(np.asarray(twisted.nodes), axis=0)))
    times = drawing.LEAST_RADIUS * size / 0.005
    assert notes(plot.plot_rod(twisted)) == [f"drawn {times:.2g} times as thick as it is"]


def test_a_rod_that_varies_is_drawn_as_thick_as_it_is(twisted):
    """In proportion where the thickest place is drawn thicker."""
    length = float(twisted.s[-1])

    def drawn(radius):
        rod = Rod(length, 1.0, 1.0, 1.0, radius=radius)
        changed = eqx.tree_at(lambda found: found.scene.rod.radius, twisted, rod.radius)
        s, centerline, points = drawing.tube(changed, 0.04)
        distance = np.linalg.norm(points - centerline[:, None], axis=-1)
        np.testing.assert_allclose(distance, distance[:, :1] * np.ones_like(distance), rtol=1e-12)
        (note,) = [text.get_text() for text in plot.plot_rod(changed, radius=0.04).texts]
        assert note == "drawn 2 times as thick as it is"
        return s / length, distance[:, 0]

    s, distance = drawn(Steps([0.3 * length], [0.01, 0.02]))
    away = np.abs(s - 0.3) > 0.01
    np.testing.assert_allclose(distance[away], np.where(s < 0.3, 0.02, 0.04)[away], rtol=1e-12)
    s, distance = drawn(Smooth([0, length], [0.01, 0.02]))
    np.testing.assert_allclose(distance, 0.02 * (1 + s), rtol=1e-9)


def test_loads_are_drawn_with_their_size(twisted):
    texts = [text.get_text() for text in plot.plot_rod(twisted, loads=True).texts]
    expected = []
    for loads, unit in (
        ((twisted.start_force, twisted.end_force), "N"),
        ((twisted.start_moment, twisted.end_moment), "N m"),
    ):
        expected += [f"{np.linalg.norm(load):.3g} {unit}" for load in loads]
    assert texts[:-1] == expected


def hanging_loop():
    """Whose ends are close together, and so are the arrows at them."""
    down, up = frame((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)), frame((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    scene = Scene(problems.cable(), Clamp((0, 0, 0), down), Clamp((0.3, 0, 0), up), gravity=(0.0, 0.0, -9.81))
    return solve(scene, segments=SEGMENTS)


@pytest.mark.parametrize("kind", ["a loop", "twisted"])
def test_words_in_a_picture_are_whole_and_none_is_on_another(kind, twisted, monkeypatch):
    draw, places = Text.draw, {}

    def noted(text, renderer, *arguments):
        places[text] = text.get_window_extent(renderer)  # those in space are where they are seen while they are drawn
        draw(text, renderer, *arguments)

    monkeypatch.setattr(Text, "draw", noted)
    axes = plot.plot_rod(hanging_loop() if kind == "a loop" else twisted, loads=True)
    figure = plot.figure_of(axes)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = [*axes.texts, axes.xaxis.label, axes.yaxis.label, axes.zaxis.label]
    boxes = [places[text] for text in drawn if text.get_text()]
    assert len(boxes) == 4 + 3 + 1
    width, height = canvas.get_width_height()
    for k, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height
        assert not any(box.overlaps(other) for other in boxes[:k])


def test_a_free_end_without_load_has_no_arrow(cable):
    force = PointForce(0.5, (0.0, 0.0, -0.01))
    scene = Scene(cable, Clamp((0.0, 0.0, 0.0), frame((1.0, 0.0, 0.0))), Free(), point_forces=[force])
    equilibrium = solve(scene, segments=SEGMENTS, discretization="finite_difference")
    texts = [text.get_text() for text in plot.plot_rod(equilibrium, loads=True).texts]
    assert texts[0] == "0.01 N"
    assert [text.split()[-1] for text in texts[:-1]] == ["N", "m"]


def test_contact_forces_are_lines_from_where_they_press(cable):
    """A cable on a floor: one line for each node that lies, from below, the longest where a metre is pressed most."""
    ends = (Clamp((x, 0.0, 0.0), frame((1.0, 0.0, 0.0))) for x in (0.0, 0.8))
    scene = Scene(cable, *ends, gravity=(0.0, 0.0, -9.81), obstacles=[Plane((0.0, 0.0, -0.1), (0.0, 0.0, 1.0))])
    lying = solve(scene, segments=16)
    axes = plot.plot_rod(lying, loads=True)
    (lines,) = (part for part in axes.collections if isinstance(part, Line3DCollection) and len(part._segments3d) > 3)  # pyright: ignore[reportAttributeAccessIssue]
    ends_of_lines = np.asarray(lines._segments3d)  # pyright: ignore[reportAttributeAccessIssue]
    forces, steps = np.asarray(lying.contact_forces), np.diff(np.asarray(lying.s))
    touching = forces[:, 2] > 0
    np.testing.assert_allclose(ends_of_lines[:, 0, :2], np.asarray(lying.nodes)[touching, :2], atol=1e-12)
    ways = ends_of_lines[:, 1] - ends_of_lines[:, 0]
    pressures = (forces[:, 2] / ((np.append(steps, 0) + np.append(0, steps)) / 2))[touching]
    np.testing.assert_allclose(ways[:, 2] / np.min(ways[:, 2]), pressures / np.max(pressures), atol=1e-12)
    assert f"at most {np.max(pressures):.3g} N/m" in axes.texts[-1].get_text()


def test_pictures_are_not_blank(twisted):
    for axes in (plot.plot_rod(twisted, loads=True), plot.plot_along(twisted)[0]):
        image = pixels(plot.figure_of(axes))
        assert np.mean(np.any(image < 0.9, axis=-1)) > 0.01
        assert np.all(image[0] == 1)  # nothing cut off at the top


def test_pictures_are_drawn_in_axes_of_another_figure(stages, twisted):
    """Which are returned; nothing but the color bar of each is added to the figure, and nothing drawn elsewhere."""
    figure = Figure()
    spaces = [cast(Axes3D, figure.add_subplot(2, 3, k, projection="3d")) for k in (1, 2, 3)]
    planes = [figure.add_subplot(2, 3, k) for k in (4, 5, 6)]
    assert plot.plot_rod(twisted, axes=spaces[0]) is spaces[0]
    assert plot.plot_along(twisted, axes=planes) == tuple(planes)
    assert plot.plot_along(twisted, axes=np.array(planes)) == tuple(planes)  # as `subplots` returns them
    assert plot.plot_figure_1(stages, stages=(1, 5), axes=spaces[1:]) == tuple(spaces[1:])
    assert len(figure.axes) == 6 + 2
    assert [len(axes.collections) for axes in spaces] == [1, 1, 1]
    assert [len(axes.lines) for axes in planes] == [2, 2, 2]
    assert plot.figure_of(planes[0]) is figure


def test_axes_that_no_picture_can_be_drawn_in_are_refused(stages, twisted):
    plane = Figure().add_subplot()
    with pytest.raises(TypeError, match=r"axes must be an? Axes3D"):
        plot.plot_rod(twisted, axes=plane)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="axes must hold 3 axes, one for each panel, got 1"):
        plot.plot_along(twisted, axes=[plane])
    with pytest.raises(TypeError, match="axes must be a list of axes, got <Axes:"):
        plot.plot_along(twisted, axes=plane)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"axes\[0\] must be an? Axes3D"):
        plot.plot_figure_1(stages, stages=[0], axes=[plane])  # pyright: ignore[reportArgumentType]


def test_a_picture_is_dark_where_the_style_of_matplotlib_is(twisted):
    """Page, words, and what is behind these."""
    with style.context("dark_background"):
        for axes in (plot.plot_rod(twisted, loads=True), plot.plot_along(twisted)[0]):
            image = pixels(plot.figure_of(axes))
            assert np.all(image[0] == 0)
            assert image.max() > 0.9  # of words
        (effect,) = plot.plot_rod(twisted, loads=True).texts[0].get_path_effects()
    assert isinstance(effect, withStroke)
    assert effect._gc["foreground"] == "black"  # pyright: ignore[reportAttributeAccessIssue]


def test_plot_along_shows_the_fields(twisted):
    panels = plot.plot_along(twisted)
    assert [axes.get_ylabel() for axes in panels] == list(drawing.LABELS.values())
    assert panels[-1].get_xlabel() == "arclength s [m]"
    for axes, name in zip(panels, drawing.LABELS, strict=True):
        np.testing.assert_array_equal(axes.lines[0].get_xdata(), twisted.s)
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), getattr(twisted, name))


def test_figure_1_shows_six_stages_alike(stages):
    panels = plot.plot_figure_1(stages)
    figure = plot.figure_of(panels[0])
    titles = [axes.get_title() for axes in panels]
    assert titles[0] == "(a) circle segment\ntotal twist 0°"
    assert titles[1].startswith("(b) upside-down Omega, no twist\n")
    assert titles[5].startswith("(f) end frame turned by 360°\n")
    assert len({(axes.get_xlim(), axes.get_ylim(), axes.get_zlim(), axes.elev, axes.azim) for axes in panels}) == 1
    assert figure.axes[6].get_ylabel() == "curvature [1/m]"
    assert pixels(figure).std() > 0.05
    chosen = plot.plot_figure_1(stages, stages=(1, 5))
    assert [axes.get_title()[:3] for axes in chosen] == ["(b)", "(f)"]


def test_errors_say_what_is_allowed(stages, twisted):
    with pytest.raises(ValueError, match="color_by must be 'curvature' or 'twist' or 'tension', got 'strain'"):
        plot.plot_rod(twisted, color_by="strain")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="radius must be positive"):
        plot.plot_rod(twisted, radius=0.0)
    with pytest.raises(ValueError, match=r"equilibrium must be a single equilibrium, got a stack of shape \(2,\)"):
        plot.plot_along(jax.tree.map(lambda *leaves: jnp.stack(leaves), twisted, twisted))
    with pytest.raises(ValueError, match=r"path must hold the 6 stages \(a\) to \(f\), got 5 equilibria"):
        plot.plot_figure_1(stages[:5])
    with pytest.raises(ValueError, match="stages must be some of 0 to 5"):
        plot.plot_figure_1(stages, stages=(6,))
