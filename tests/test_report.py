"""Reports of routes: their numbers beside the equilibrium's, verdicts, and what they write."""

import csv
import io
import json
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from matplotlib.image import imread

import rodjax as rj
from rodjax.analysis.reactions import axes_of
from rodjax.drawing import AZIMUTH, seen_axes
from rodjax.model import surfaces as routing_surfaces
from rodjax.model.surfaces import MOST_TRIANGLES, surfaces
from rodjax.routing import report_text, web_page
from rodjax.routing.cable_report import Gradients
from rodjax.routing.report import FILES
from rodjax.routing.view_data import azimuth, cable_view, coloring, extent

RADIUS = 0.006
GRAVITY = (0.0, 0.0, -9.81)
NAMES = ["floor", "</script><b>pipe & 'co'"]
OBSTACLES = [
    rj.Plane((0, 0, -0.02), (0, 0, 1)),
    rj.Capsule((0.1, -0.1, 0.02), (0.16, 0.2, 0.0), 0.02),
]
LIMITS = rj.Limits(bend_radius=5, clearance=0.008, clip_force=20, end_moment=1, length=0.7)
GRADIENTS = Gradients(
    ("clips.0.at", "weight"),
    ("m", ""),
    np.array([0.2, 2.0]),
    ("bend radius", "length"),
    np.array([[3.0, 0.1], [0.0, -0.5]]),
)


@pytest.fixture(scope="module")
def equilibrium():
    rod = rj.Rod.circular(0.62, RADIUS, 2e7, poisson_ratio=0.45, density=1300.0)
    start = rj.Clamp((0, 0, 0.1), rj.frame((1, 0, 0.3)))
    end = rj.Clamp((0.42, 0.12, 0.02), rj.frame((0.3, 1, 0)))
    clips = [rj.Clip(0.2, (0.18, 0.02, 0.09), (1, 0, -0.2)), rj.Clip(0.42, (0.37, -0.03, 0.04))]
    return rj.solve(rj.Scene(rod, start, end, GRAVITY, clips=clips), segments=12)


@pytest.fixture(scope="module")
def lying():
    """On a floor and over a pipe, which push it."""
    rod = rj.Rod.circular(0.62, RADIUS, 2e6, poisson_ratio=0.45, density=1300.0)
    start = rj.Clamp((0, 0, 0.05), rj.frame((1, 0, 0)))
    end = rj.Clamp((0.55, 0.05, 0.04), rj.frame((1, 0, 0)))
    obstacles = [rj.Plane((0, 0, 0), (0, 0, 1)), rj.Capsule((0.4, -0.2, 0.01), (0.4, 0.2, 0.01), 0.01)]
    return rj.solve(rj.Scene(rod, start, end, GRAVITY, obstacles=obstacles), segments=24)


@pytest.fixture(scope="module")
def report(equilibrium):
    return rj.report(
        equilibrium, limits=LIMITS, obstacles=OBSTACLES, names=NAMES, gradients=GRADIENTS, title="Line <1>"
    )


@pytest.fixture(scope="module")
def saved(report, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "new"
    assert report.save(folder) == [folder / name for name in FILES]
    return folder


def facts(report) -> dict:
    return {fact.name: fact for fact in report.cables[0].facts}


def with_margins(report, margins, **changed):
    """The report with other margins, or other facts, of its one cable."""
    old, count = report.cables[0].margins, len(margins)
    static = {name: getattr(old, name)[:count] for name in ("names", "units", "kinds")}
    found = rj.Margins(
        **static, value=old.value[:count], limit=old.limit[:count], margin=np.array(margins), s=old.s[:count]
    )
    return type(report)(report.title, (report.cables[0]._replace(margins=found, **changed),), (), ())


# --- numbers ---------------------------------------------------------------------------------------------------------


def test_numbers_are_those_of_the_equilibrium(report, equilibrium):
    told = facts(report)
    margins = rj.margins(equilibrium, LIMITS, OBSTACLES, NAMES)
    expected = dict(zip(margins.names, np.asarray(margins.margin).tolist(), strict=True))
    assert report.margins == pytest.approx(expected, rel=1e-9)
    assert told["free length"].value == 0.62
    strain = np.asarray(equilibrium.axial_strain)
    # By the positions of a fine polyline, 240 edges of radius of curvature 0.05 m: 1e-6.
    way = np.diff(np.asarray(equilibrium.position_at(np.linspace(0, 0.62, 241))), axis=0)
    assert told["stretched length"].value == pytest.approx(np.sum(np.linalg.norm(way, axis=1)), rel=1e-4)
    # Looked for between the nodes too, it is at most that at the nodes, and not much less on this mesh.
    at_nodes = 1 / np.max(np.asarray(equilibrium.curvature)) - RADIUS
    assert 0.9 * at_nodes < told["smallest inside bend radius"].value <= at_nodes * (1 + 1e-9)
    assert f"{told['smallest inside bend radius'].value / (2 * RADIUS):.3g} times" in (
        told["smallest inside bend radius"].note
    )
    first, last = 1e3 * np.asarray(rj.most_curved(equilibrium))
    assert f"within its error between s = {first:.4g} and {last:.4g} mm" in told["smallest inside bend radius"].note
    assert first <= 1e3 * told["smallest inside bend radius"].s <= last
    clearance = rj.clearance(equilibrium, OBSTACLES)
    nearest = int(np.argmin(clearance.distance))
    # Margins look between places too, which are 10 mm apart: h^2/8 by a curvature of 20 1/m.
    assert told["smallest clearance"].value == pytest.approx(float(clearance.distance[nearest]), abs=2.5e-4)
    assert told["smallest clearance"].s == pytest.approx(float(clearance.s[nearest]), abs=0.01)
    assert told["smallest clearance"].note == f"to {NAMES[nearest]}"
    assert told["largest twist rate"].value == float(np.max(np.abs(equilibrium.twist)))
    assert told["largest strain"].value == np.max(np.abs(strain))
    # All of it is compressed.
    assert float(np.max(equilibrium.tension)) < 0
    assert told["largest compression"].value == -float(np.min(equilibrium.tension))
    assert told["least compression"].value == -float(np.max(equilibrium.tension))
    assert told["elastic energy"].value == float(equilibrium.elastic_energy)
    assert told["mass"].value == pytest.approx(1300 * np.pi * RADIUS**2 * 0.62, rel=1e-12)
    assert told["lowest eigenvalue"].value == float(rj.lowest_mode(equilibrium).stiffness)
    assert told["estimated error of the shape"].value == pytest.approx(0.62 * float(equilibrium.error_estimate))


def test_supports_carry_the_weight_in_any_axes(report, equilibrium):
    found = report.cables[0].reactions
    assert [reaction.name for reaction in found] == ["start", "clip 0", "clip 1", "end"]
    assert [reaction.kind for reaction in found] == ["clamp", "clip", "clip", "clamp"]
    weight = 1300 * np.pi * RADIUS**2 * 0.62 * 9.81
    np.testing.assert_allclose(sum(reaction.force for reaction in found), [0, 0, weight], atol=1e-12 * weight * 100)
    np.testing.assert_array_equal(found[1].moment, equilibrium.clip_moments[0])
    np.testing.assert_array_equal(found[0].moment, -equilibrium.start_moment)
    for reaction in found:
        tangent, left, up = reaction.axes
        np.testing.assert_allclose(reaction.axes @ reaction.axes.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(np.cross(tangent, left), up, atol=1e-14)
        assert left[2] == pytest.approx(0, abs=1e-15)  # level
        assert up[2] > 0
        node = int(np.argmin(np.abs(equilibrium.s - reaction.s)))
        np.testing.assert_array_equal(tangent, equilibrium.tangents[node])
        np.testing.assert_array_equal(reaction.position, equilibrium.nodes[node])
    # A clip that leaves the rod free to spin bears no moment along it, one that holds no direction none.
    assert abs(found[1].axes[0] @ found[1].moment) < 1e-12
    np.testing.assert_array_equal(found[2].moment, 0)


def test_upright_supports_have_axes_too():
    axes = np.stack(axes_of(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1)


# --- words -----------------------------------------------------------------------------------------------------------


def test_the_verdict_comes_first(report):
    title, verdict = str(report).splitlines()[:2]
    assert title == "Line <1>"
    broken = [name for name, margin in report.margins.items() if margin < 0]
    assert broken == ["bend radius", "clearance to floor"]
    assert verdict.startswith("NOT kept: 2 of 8 limits: clearance to floor, ")
    radius = facts(report)["smallest inside bend radius"]
    told = f"bend radius, {1e3 * radius.value:.4g} mm of at least 60 mm ({100 * report.margins['bend radius']:.1f} %)"
    assert f"; {told} at s = {1e3 * radius.s:.4g} mm" in verdict
    assert report.kept is False
    assert str(report).count("NOT KEPT") == 2


def test_verdicts(report):
    kept = with_margins(report, [0.5, 0.2, 0.0])
    assert kept.kept is True
    assert kept.verdict.startswith("kept: all 3 limits; tightest: clearance to </script>")
    unknown = with_margins(report, [0.5, np.nan])
    assert unknown.kept is False
    assert unknown.verdict.startswith("NOT kept: 1 of 2 limits: clearance to floor")
    assert "not a number" in unknown.verdict
    infinite = with_margins(report, [np.inf])
    assert infinite.verdict.startswith("kept: the one limit; tightest: bend radius")
    assert "unlimited" in str(infinite)
    assert report_text.amount(np.inf, "m") == "infinite"
    assert json.loads(json.dumps(infinite.as_dict(), allow_nan=False))["margins"] == {"bend radius": None}
    many = with_margins(report, [-0.5, -0.4, -0.3, -0.2, -0.1])
    assert many.verdict.endswith("and 2 more")


def test_what_did_not_converge_or_is_not_stable_is_told(report, equilibrium, monkeypatch):
    monkeypatch.setattr(report_text, "is_unstable", lambda found: True)
    assert with_margins(report, [0.5]).verdict.endswith("; but the equilibrium is NOT stable")
    lost = eqx.tree_at(lambda found: found.converged, equilibrium, jnp.array(False))
    told = rj.report(lost, limits=LIMITS, obstacles=OBSTACLES, names=NAMES)
    assert told.kept is False
    assert told.verdict == "NOT converged: the numbers below are not those of an equilibrium"
    assert told.as_dict()["converged"] is False
    assert facts(told)["lowest eigenvalue"].value is None
    infinite = eqx.tree_at(lambda found: found.nodes, equilibrium, equilibrium.nodes * jnp.inf)
    with pytest.raises(ValueError, match="equilibrium must have a finite shape: converged"):
        rj.report(infinite)


def test_a_limit_of_zero_has_a_margin_in_its_unit():
    assert report_text.percent(0.0123, 0.0, "m") == "+12.3 mm"
    assert report_text.percent(-0.0123, 0.0, "m") == "-12.3 mm"
    assert report_text.percent(0.25, 4.0, "N") == "+25.0 %"


def test_without_limits_it_describes(equilibrium):
    told = rj.report(equilibrium)
    assert told.kept is None
    assert told.verdict == "no limits given"
    assert told.margins == {}
    assert "smallest inside bend radius" in str(told)
    assert "smallest clearance" not in str(told)


def test_several_cables_are_told_one_by_one(report, equilibrium):
    loose = rj.Limits(length=0.7)
    told = rj.report({"a": equilibrium, "b": equilibrium}, limits=[loose, rj.Limits(length=0.5)])
    assert told.margins == {"a: length": pytest.approx(0.08 / 0.7), "b: length": pytest.approx(-0.12 / 0.5)}
    assert told.kept is False
    assert told.verdict.startswith("NOT kept: 1 of 2 limits: b: length, 620 mm of at most 500 mm (-24.0 %)")
    assert "--- a: kept" in str(told)
    assert "--- b: NOT kept" in str(told)
    assert rj.report([equilibrium, equilibrium], limits=[loose, None]).kept is True


def test_what_pushes_the_cable_is_told_and_drawn(lying, tmp_path):
    floor, _ = lying.scene.obstacles
    report = rj.report(lying, obstacles=[floor], names=["floor"])
    (cable,) = report.cables
    assert {push.name for push in cable.pushes} == {"obstacles[0] (Plane)", "obstacles[1] (Capsule)"}
    rod = lying.scene.rod
    weight = float(rod.mass_per_length * rod.length) * np.array(GRAVITY)
    acting = [one.force for one in (*cable.reactions, *cable.pushes)]
    # In equilibrium to 1e-8 EI/L^2, by the tolerance of the search.
    assert np.max(np.abs(np.sum(acting, axis=0) + weight)) < 1e-8 * float(rod.EI / rod.length**2)
    for push in cable.pushes:
        within = (lying.s >= push.first) & (lying.s <= push.last)
        low, high = np.min(lying.nodes[within], axis=0), np.max(lying.nodes[within], axis=0)
        # A mean of coordinates may differ from them by rounding.
        assert np.all((low - 1e-12 <= push.position) & (push.position <= high + 1e-12))

    report.save(tmp_path)
    told = json.loads((tmp_path / "report.json").read_text())["cables"][0]["contacts"]
    np.testing.assert_allclose([one["force"] for one in told], [push.force for push in cable.pushes], rtol=1e-12)
    rows = list(csv.reader(io.StringIO((tmp_path / "report.csv").read_text())))
    assert sum(row[1] == "contact" for row in rows) == 4 * len(cable.pushes)
    heading = "what obstacles apply"
    assert heading in (tmp_path / "report.txt").read_text()
    assert heading in (tmp_path / "report.html").read_text()
    # The floor by the name that was given, and once.
    (legend,) = report.figure().legends
    assert [text.get_text() for text in legend.get_texts()] == ["floor", "obstacles[1] (Capsule)"]
    written = {text.get_text() for text in report.figure().axes[0].texts}
    assert {f"{np.linalg.norm(push.force):.3g} N" for push in cable.pushes} <= written


def test_a_cable_within_an_obstacle_is_told(equilibrium, lying):
    wall = rj.Plane((0.2, 0.0, 0.0), (-1.0, 0.0, 0.0))
    verdict = rj.report(equilibrium, obstacles=[wall]).verdict
    depth = float(np.max(equilibrium.nodes[:, 0])) - 0.2 + RADIUS
    said = re.fullmatch(r"no limits given; but it lies (.*) mm within an obstacle, .*", verdict)
    assert said is not None
    # Nodes are the places looked at but for those between them, and the number has four digits.
    assert float(said[1]) == pytest.approx(1e3 * depth, rel=2e-3)
    asked = rj.report(equilibrium, obstacles=[wall], limits=rj.Limits(clearance=0.0)).verdict
    assert "but it lies" not in asked
    # Between its nodes a cable is within what it lies on by less than a hundredth of its radius.
    assert "but it lies" not in rj.report(lying, obstacles=lying.scene.obstacles).verdict


def test_limits_of_clips_are_of_cables_that_have_clips(equilibrium):
    """Of all cables the others."""
    scene = equilibrium.scene
    bare = rj.solve(rj.Scene(scene.rod, scene.start, scene.end, GRAVITY), segments=12)
    told = rj.report({"held": equilibrium, "bare": bare}, limits=rj.Limits(clip_force=20, length=0.7))
    assert list(told.margins) == ["held: force of clip 0", "held: force of clip 1", "held: length", "bare: length"]
    only = rj.report({"held": equilibrium, "bare": bare}, limits=rj.Limits(clip_force=20))
    assert [cable.kept for cable in only.cables] == [True, None]


def test_derivatives_are_told_by_the_units_of_engineers(report):
    lines = str(report).splitlines()
    rows = {
        line.split("  ")[0]: line.split()
        for line in lines[lines.index(next(line for line in lines if line.startswith("Change of each margin"))) :]
    }
    assert rows["now"][1:] == ["200", "mm", "2"]
    # 3 a metre are 0.3 % a millimetre.
    assert rows["bend radius"][2:] == ["+0.3", "%/mm", "+10", "%/1"]
    assert report.as_dict()["cables"][0]["gradients"]["clips.0.at"] == {
        "unit": "m",
        "value": 0.2,
        "margins": {"bend radius": 3.0, "length": 0.0},
    }


@pytest.mark.slow
def test_the_eigenvalue_of_a_rod_that_slides(equilibrium):
    scene = equilibrium.scene
    clips = [scene.clips[0], rj.Clip(0.42, scene.clips[1].position, sliding=True)]
    slides = rj.solve(rj.Scene(scene.rod, scene.start, scene.end, GRAVITY, clips=clips), segments=12)
    told = rj.report(slides, limits=LIMITS, obstacles=OBSTACLES)
    fact = facts(told)["lowest eigenvalue"]
    assert fact.value == float(rj.lowest_mode(slides).stiffness)
    assert told.cables[0].reactions[2].kind == "sliding clip"
    assert told.cables[0].reactions[2].s == pytest.approx(float(slides.scene.clips[1].at))


# --- files -----------------------------------------------------------------------------------------------------------


def refuse(constant):
    raise AssertionError(f"{constant} is not JSON")


def test_json_is_strict_and_holds_the_margins(saved, report):
    told = json.loads((saved / "report.json").read_text(), parse_constant=refuse)
    assert told["margins"] == report.margins
    assert told["kept"] is False
    assert told["verdict"] == report.verdict
    (cable,) = told["cables"]
    assert cable["status"] == "converged"
    assert cable["facts"]["free length"] == {"value": 0.62, "unit": "m", "s": None, "note": "unstretched"}
    assert [support["name"] for support in cable["supports"]] == ["start", "clip 0", "clip 1", "end"]
    assert cable["limits"][0]["kept"] is False


def test_csv_holds_all_numbers(saved, report):
    rows = list(csv.DictReader(io.StringIO((saved / "report.csv").read_text())))
    assert all(len(row) == 10 and None not in row for row in rows)
    limits = {row["name"]: float(row["margin"]) for row in rows if row["kind"] == "limit"}
    assert limits == report.margins
    forces = {row["name"]: float(row["value"]) for row in rows if row["kind"] == "force"}
    assert forces["end x"] == report.cables[0].reactions[-1].force[0]
    assert forces["clip 0 magnitude"] == pytest.approx(np.linalg.norm(report.cables[0].reactions[1].force))
    assert float(next(r for r in rows if r["name"] == "bend radius by clips.0.at")["value"]) == 3.0


def test_the_text_and_the_picture_are_written(saved, report):
    assert (saved / "report.txt").read_text() == f"{report}\n"
    image = imread(saved / "report.png")[..., :3]
    assert np.mean(np.any(image < 0.9, axis=-1)) > 0.05


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_what_the_page_says_can_be_read_on_a_light_and_a_dark_one(saved, theme):
    """Contrast of at least 4.5, as WCAG 2.2 asks of text, of words and lines on all that they may stand on."""
    page = (saved / "report.html").read_text()
    found = re.findall(r":root \{(.*?)\}", page, re.S)[theme == "dark"]
    colors = dict(re.findall(r"--(\w+): #([0-9a-f]{6})", found))

    def luminance(name: str) -> float:
        shares = np.array([int(colors[name][k : k + 2], 16) / 255 for k in (0, 2, 4)])
        linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    assert (luminance("page") < luminance("ink")) == (theme == "dark")
    pairs = [(word, on) for word in ("ink", "soft", "bad") for on in ("page", "hover")]
    pairs += [(word, on) for word in ("ink", "soft", "load", "x", "y", "z") for on in ("sky", "ground")]
    pairs += [("ink", on) for on in ("plain", "kept", "broken")]
    for word, on in pairs:
        low, high = sorted((luminance(word), luminance(on)))
        assert (high + 0.05) / (low + 0.05) > 4.5, (word, on)


def test_the_page_loads_nothing_and_hides_no_tags_in_names(saved, report):
    page = (saved / "report.html").read_text()
    assert len(page) < 1e6
    assert not re.search(r"https?:|//cdn|src=|@import|url\((?!#)", page)
    assert "default-src 'none'" in page
    assert page.count("</script>") == 2
    assert "&lt;/script&gt;&lt;b&gt;pipe &amp; &#x27;co&#x27;" in page
    assert "<b>" not in page
    assert "<title>Line &lt;1&gt;</title>" in page
    assert page.index("NOT kept") < page.index("<table")
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1], parse_constant=refuse)
    (cable,) = data["cables"]
    assert len(cable["points"]) == len(cable["s"]) == len(cable["tension"]) == len(cable["margins"])
    worst = int(np.argmin(cable["margins"]))
    # The worst of 241 places beside the worst of those of the mesh.
    assert cable["margins"][worst] == pytest.approx(report.margins["bend radius"], abs=2e-3)
    assert cable["s"][worst] == pytest.approx(facts(report)["smallest inside bend radius"].s, abs=0.01)
    assert len(data["obstacles"]) == 2
    assert len(data["clips"]) == 2
    size = np.linalg.norm(report.cables[0].reactions[0].force)
    assert data["forces"][0]["label"] == f"{size:.3g} N"
    for surface in data["obstacles"]:
        assert max(max(face) for face in surface["faces"]) == len(surface["vertices"]) - 1


def test_a_name_like_a_place_in_the_template_is_a_name(report):
    strange = type(report)("@DATA@", report.cables, (), ())
    assert "<title>@DATA@</title>" in web_page.web_page(strange, strange._sights)


def test_the_report_says_what_it_was_made_of(saved, equilibrium):
    made = rj.report(equilibrium, obstacles=OBSTACLES, names=NAMES, source="line.toml, rtol = 0.001")
    assert f"by rodjax {rj.__version__} of line.toml, rtol = 0.001" in str(made)
    text = (saved / "report.txt").read_text()
    assert re.search(r"made on \d{4}-\d\d-\d\d by rodjax", text)
    told = json.loads((saved / "report.json").read_text())
    inputs = told["cables"][0]["inputs"]
    assert f"EI {float(equilibrium.scene.rod.EI):.4g} N m^2" in inputs["rod"]
    assert inputs["gravity"] == "(0, 0, -9.81) m/s^2"
    assert inputs["clips[1]"] == "Clip: at 0.42 m, position (0.37, -0.03, 0.04) m"
    assert inputs["obstacle floor"] == "Plane: point (0, 0, -0.02) m, normal (0, 0, 1)"
    assert inputs["mesh"] == "12 segments (hermite)"
    assert all(name in text for name in inputs)
    errors = {name: fact["value"] for name, fact in told["cables"][0]["facts"].items() if name.startswith("estimated")}
    assert errors["estimated error of the moments"] == float(equilibrium.moment_error)
    assert errors["estimated error of the smallest bend radius"] == float(equilibrium.curvature_error)
    page = (saved / "report.html").read_text()
    assert all(part in page for part in ("made on ", "<h2>inputs</h2>", "along the cable", "@media print"))


def test_diagrams_have_the_limits_on_them(report, equilibrium):
    figure = report.along()
    panels = {axes.get_ylabel(): axes for axes in figure.axes}
    assert list(panels)[:5] == ["curvature [1/m]", "twist [deg/m]", "tension [N]", "moment [N m]", "clearance [mm]"]
    curvature, limit = panels["curvature [1/m]"].get_lines()[:2]
    # An inside bend radius of 5 diameters: 11 radii of the centerline.
    np.testing.assert_allclose(limit.get_ydata(), 1 / (11 * RADIUS))
    assert (np.max(curvature.get_ydata()) > 1 / (11 * RADIUS)) == (report.margins["bend radius"] < 0)
    lines = panels["clearance [mm]"].get_lines()
    assert [line.get_label() for line in lines[:2]] == NAMES
    smallest = min(np.min(line.get_ydata()) for line in lines[:2])
    # Between 401 places 1.5 mm apart it may be smaller by h^2/8 times the curvature of 20 1/m.
    assert smallest == pytest.approx(1e3 * facts(report)["smallest clearance"].value, abs=0.01)
    bending = panels["moment [N m]"].get_lines()[0].get_ydata()
    held = float(
        np.linalg.norm(
            equilibrium.end_moment - (equilibrium.end_moment @ equilibrium.tangents[-1]) * equilibrium.tangents[-1]
        )
    )
    assert bending[-1] == pytest.approx(held, rel=1e-9)


# --- pictures --------------------------------------------------------------------------------------------------------


def test_the_picture_names_what_it_shows(report):
    figure = report.figure()
    axes, bar = figure.axes
    assert bar.get_ylabel() == "margin of the inside bend radius"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == NAMES
    written = [text.get_text() for text in axes.texts]
    sizes = [f"{np.linalg.norm(reaction.force):.3g} N" for reaction in report.cables[0].reactions]
    assert written[:2] == ["clip 0", "clip 1"]
    assert written[2:6] == sizes
    # None of them on another.
    right, up, _ = seen_axes(AZIMUTH)
    positions = [np.array([right, up]) @ text.get_position_3d() for text in axes.texts[:6]]
    apart = [np.abs(a - b) for k, a in enumerate(positions) for b in positions[:k]]
    assert all(np.max(way) > 0.01 for way in apart)


def test_places_that_bend_too_much_are_red(report, equilibrium):
    (seen,) = report._sights
    colors = coloring([seen])
    red, _, blue, _ = colors.of(seen, seen.s).T
    assert np.all((red > blue) | (seen.margin >= 0))
    assert np.all(blue[seen.margin > 0.8] > red[seen.margin > 0.8])
    assert np.any(seen.margin < 0)
    without = coloring([cable_view("a", equilibrium, None, extent([equilibrium]))])
    assert without.label == "curvature [1/m]"
    assert not without.is_margin


def test_no_wall_stands_before_the_picture(report):
    assert azimuth(report._sights, OBSTACLES) == AZIMUTH
    for normal in ((0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)):
        view = azimuth(report._sights, [*OBSTACLES, rj.Plane((0, 0, 0), normal)])
        right, up, near = seen_axes(view)
        assert near @ np.array(normal) > 0
        np.testing.assert_allclose(np.cross(right, up), near, atol=1e-15)


POINTS = np.array([[-0.5, -0.5, -0.5], [0.9, 0.6, 0.6]])
FRAME = np.asarray(rj.frame((1, 2, 3), (0, 1, 1)))
TORUS = trimesh.creation.torus(0.4, 0.15, major_sections=24, minor_sections=12)
SHAPES = {
    "plane": rj.Plane((0, 0, -0.2), (1, 2, 2)),
    "sphere": rj.Sphere((0.3, -0.2, 0.1), 0.4),
    "capsule": rj.Capsule((0, 0, 0), (1, 0, 0), 0.2),
    "pipe": rj.Pipe([(0, 0, 0), (0.6, 0, 0), (0.6, 0.5, 0.2)], 0.2),
    "cylinder": rj.Cylinder((0, 0, 0), (0, 0.6, 0.8), 0.3),
    "box": rj.Box((0.3, -0.2, 0.1), (0.8, 0.5, 0.3), FRAME),
    "union": rj.Union(rj.Sphere((0, 0, 0), 0.4), rj.Box((1, 0, 0), (0.5, 0.5, 0.5))),
    "mesh": rj.Mesh(TORUS.vertices, TORUS.faces),
    "function": rj.Distance(lambda p: 3 * (jnp.sqrt(p[0] ** 2 + 2 * p[1] ** 2 + p[2] ** 2 + 1e-9) - 0.3)),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_surfaces_lie_on_obstacles_and_are_seen_from_outside(kind):
    obstacle = SHAPES[kind]
    (faces,) = surfaces([obstacle], POINTS)
    assert 10 < len(faces) <= MOST_TRIANGLES
    distance = np.asarray(obstacle.distance(faces.reshape(-1, 3)))
    if kind in ("union", "pipe"):  # a part may lie in another
        assert np.max(distance) < 1e-12
    else:
        # Those of what has only a distance come onto it by two steps of Newton from a tenth of a cell, 5 mm.
        np.testing.assert_allclose(distance, 0, atol=1e-5 if kind == "function" else 1e-12)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals += np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 0])
    out = 1e-4 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    middles = faces.mean(axis=1)
    rises = np.asarray(obstacle.distance(middles + out)) - np.asarray(obstacle.distance(middles - out))
    assert np.all(rises > 0) or kind == "union"


def test_large_meshes_are_drawn_by_fewer_triangles_and_long_ones_by_more():
    fine = trimesh.creation.icosphere(5, 0.3)
    (faces,) = surfaces([rj.Mesh(fine.vertices, fine.faces)], POINTS)
    assert len(fine.faces) > MOST_TRIANGLES >= len(faces) > MOST_TRIANGLES / 4
    # Corners move by half a cell of the grid at most.
    np.testing.assert_allclose(np.linalg.norm(faces, axis=-1), 0.3, atol=0.02)
    box = trimesh.creation.box((1, 1, 1))
    (faces,) = surfaces([rj.Mesh(box.vertices, box.faces)], POINTS)
    assert len(faces) > 100
    area = np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(6)


def test_only_what_is_near_is_drawn():
    far = [rj.Sphere((9, 0, 0), 0.5), rj.Plane((0, 0, -9), (0, 0, 1)), rj.Distance(lambda p: p[0] + 9)]
    assert [len(faces) for faces in surfaces(far, POINTS)] == [0, 0, 0]
    (pipe,) = surfaces([rj.Cylinder((-9, 0, 0), (9, 0, 0), 0.1)], POINTS)
    assert np.ptp(pipe[..., 0]) < 4
    floor, ball = surfaces([rj.Plane((0, 0, -0.6), (0, 0, 1)), rj.Sphere((1.5, 0, 0), 0.2)], POINTS)
    assert np.max(floor[..., 0]) > np.max(ball[..., 0])
    np.testing.assert_allclose(floor[..., 2], -0.6)
    assert len(floor) > routing_surfaces.FACES_ALONG**2 / 2


# --- mistakes --------------------------------------------------------------------------------------------------------


def test_mistakes_are_told(equilibrium):
    def told(*arguments, **options):
        with pytest.raises((ValueError, TypeError)) as found:
            rj.report(*arguments, **options)
        return str(found.value)

    assert told([]) == "equilibrium must be at least one Equilibrium, got none"
    assert told(3).startswith("equilibrium must be a list of Equilibrium, got 3")
    assert "limits must be one for all cables, or one for each of 1, got 2" in told(equilibrium, limits=[None, None])
    assert "limits[0] must be a Limits, got 3" in told(equilibrium, limits=[3])
    assert "names must be 1 different ones" in told(equilibrium, obstacles=OBSTACLES[:1], names=["a", "b"])
    assert "obstacles[0] must be an Obstacle" in told(equilibrium, obstacles=[3])
    assert "title must be a str" in told(equilibrium, title=3)
    stack = jax.tree.map(lambda x: jnp.stack([x, x]), equilibrium)
    assert "got a stack of shape (2,)" in told(stack)
