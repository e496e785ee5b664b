"""The window in a real browser, headless: what it shows, a handle dragged by the mouse, and that it ends cleanly."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from matplotlib import get_cachedir
from matplotlib.image import imread
from PIL import Image, ImageSequence

import rodjax as rj
from rodjax.window.controls import Pose
from rodjax.window.session import Session

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
# WebGL by the processor, and no sandbox, which needs rights that a container lacks.
FLAGS = ["--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
FLAGS += ["--no-sandbox"]
WIDTH, HEIGHT = 1280, 800
SECONDS = 300.0  # a busy machine compiles for minutes
LEVEL = rj.frame((1.0, 0.0, 0.0))

pytestmark = pytest.mark.slow
viser = pytest.importorskip("viser", reason="the window needs viser: pip install 'rodjax[view]'")


def scene() -> rj.Scene:
    cable = rj.Rod.circular(1.0, 8e-3, 1e7, poisson_ratio=0.5, density=1200)
    clips = [rj.Clip(0.5, (0.4, 0.02, -0.12))]
    return rj.Scene(cable, rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((0.8, 0, 0), LEVEL), (0, 0, -9.81), clips=clips)


def until(holds, what: str) -> None:
    end = time.monotonic() + SECONDS
    while not holds():
        assert time.monotonic() < end, f"waited {SECONDS:g} s for {what}"
        time.sleep(0.05)


def listening(port: int, host: str) -> bool:
    try:
        with urllib.request.urlopen(f"http://{host}:{port}", timeout=5.0) as answer:
            return answer.status == 200
    except urllib.error.URLError:
        return False


class Camera:
    """Where points in space are in the picture."""

    def __init__(self, camera):
        self.wxyz, self.position, self.fov = np.array(camera.wxyz), np.array(camera.position), camera.fov

    def pixels(self, points) -> np.ndarray:
        rotation = viser.transforms.SO3(self.wxyz).as_matrix()
        x, y, z = ((np.atleast_2d(points) - self.position) @ rotation).T
        focal = HEIGHT / 2 / np.tan(self.fov / 2)
        return np.stack([WIDTH / 2 + focal * x / z, HEIGHT / 2 + focal * y / z], axis=1)


def drawn_share(page, camera: Camera, points) -> float:
    """The share of points in space at which the picture is darker than its white background."""
    image = imread(io.BytesIO(page.screenshot()))[..., :3]
    is_dark = image.min(axis=-1) < 0.75
    columns, rows = np.round(camera.pixels(points)).astype(int).T
    near = [is_dark[r - 2 : r + 3, c - 2 : c + 3].any() for r, c in zip(rows, columns, strict=True)]
    return float(np.mean(near))


def saved_film(page, window, folder) -> np.ndarray:
    """Three moves are recorded, and the pictures that the browser draws of them downloaded."""
    pose = window.session.now.controls.poses["end"]
    window.command(lambda: window.record(True))
    for k in range(3):
        window.drag("end", Pose(pose.position + np.array([0.0, 0.0, 0.06 * (k + 1)]), pose.frame))
        until(lambda k=k: len(window.session.recorded) == k + 2, "a move to be recorded")
    window.command(lambda: window.record(False))
    page.get_by_role("button", name="Record").or_(page.get_by_text("Record", exact=True)).first.click()
    with page.expect_download(timeout=1e3 * SECONDS) as download:
        page.get_by_role("button", name="Save film").click()
        page.get_by_role("link", name="film").or_(page.get_by_text("Download film", exact=False)).first.click(
            timeout=1e3 * SECONDS
        )
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    if path.suffix == ".gif":
        images = ImageSequence.Iterator(Image.open(path))
        return np.stack([np.asarray(image.convert("RGB")) for image in images])
    imageio = pytest.importorskip("imageio.v3")
    return imageio.imread(path.read_bytes(), extension=path.suffix, plugin="pyav")


def test_a_rod_is_dragged_in_the_browser(tmp_path):
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="a browser is driven by playwright: pip install playwright"
    )
    if BROWSER is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    before = set(threading.enumerate())
    window = rj.view(Session(scene(), segments=10).result, 0, open_browser=False, block=False)
    port = window.server.get_port()
    assert listening(port, "127.0.0.1")
    assert not listening(port, "127.0.0.2")  # another address of this machine, as from the network
    session, requests, problems = window.session, [], []
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
        page.goto(window.url)
        message = page.locator("#rodjax-message")
        force = page.locator('[data-row="force, end"]')
        until(lambda: message.count() and "Drag" in message.text_content(), "the window to be ready")
        page.get_by_role("checkbox", name="Forces and moments").uncheck()
        until(window.server.get_clients, "the camera of the browser")
        camera = Camera(next(iter(window.server.get_clients().values())).camera)
        shape = session.reading.centerline[1:-1]
        until(lambda: drawn_share(page, camera, shape) > 0.95, "the rod to be drawn")

        # The arrow of the handle along the rod, at 0.8 of its length.
        pose = session.now.controls.poses["end"]
        grip, aim = camera.pixels([pose.position + offset for offset in ((0.08, 0, 0), (-0.02, 0, 0))])
        text, moves = force.text_content(), []
        window.on_drawn = lambda report: moves.append(time.monotonic())
        page.mouse.move(*grip)
        time.sleep(0.5)  # a frame, in which the handle sees the mouse
        page.mouse.down()
        for share in np.linspace(0.0, 1.0, 12):
            page.mouse.move(*(grip + share * (aim - grip)))
        page.mouse.up()
        until(lambda: session.now.controls.poses["end"].position[0] < 0.72, "the rod to follow")
        until(lambda: force.text_content() != text, "the numbers to change")
        # All that the browser tells of the drag, which comes one by one.
        count = len(moves)
        while not moves or len(moves) != count or time.monotonic() - moves[-1] < 1.5:
            count = len(moves)
            time.sleep(0.1)
        reached = session.now.controls.poses["end"].position
        np.testing.assert_allclose(reached, (0.7, 0, 0), atol=0.015)  # some ten pixels
        np.testing.assert_allclose(session.result.nodes[-1], reached, atol=1e-9)
        until(lambda: force.text_content() == f"{np.linalg.norm(session.result.end_force):.4g} N", "the newest numbers")
        page.get_by_role("checkbox", name="Handles").uncheck()
        until(lambda: drawn_share(page, camera, session.reading.centerline[1:-1]) > 0.95, "the new shape")
        assert drawn_share(page, camera, shape) < 0.7  # the old one is gone, but where the two cross

        with page.expect_download() as download:
            page.get_by_role("button", name="Save scene").click()
            # viser asks its user, by a link in a note
            page.get_by_role("link", name="scene.toml").or_(page.get_by_text("Download", exact=False)).first.click()
        download.value.save_as(tmp_path / "scene.toml")
        saved = tomllib.loads((tmp_path / "scene.toml").read_text())
        assert saved["end"]["position"] == f"[{', '.join(map(repr, map(float, reached)))}] m"

        page.get_by_role("checkbox", name="Dark page").check()
        until(lambda: imread(io.BytesIO(page.screenshot()))[5, 5, :3].max() < 0.3, "the dark page")
        page.get_by_role("checkbox", name="Dark page").uncheck()
        until(lambda: imread(io.BytesIO(page.screenshot()))[5, 5, :3].min() > 0.9, "the light page")
        film = saved_film(page, window, tmp_path)
        assert film.shape == (4, 640, 960, 3)
        dark = [np.mean(picture.min(axis=-1) < 200) for picture in film]
        assert min(dark) > 0.002  # the rod is in each of them
        changed = [np.mean(np.abs(film[k + 1].astype(int) - film[k]).max(axis=-1) > 60) for k in range(3)]
        assert min(changed) > 0.001  # and elsewhere in the next

        page.get_by_role("button", name="Undo").click()
        until(lambda: session.now.controls.poses["end"].position[0] == 0.8, "the move to be undone")
        browser.close()
    window.close()
    window.close()  # does nothing
    assert not problems
    own = (window.url, f"blob:{window.url}", "data:")
    assert [url for url in requests if not url.startswith(own)] == []
    assert not listening(port, "127.0.0.1")
    until(lambda: set(threading.enumerate()) <= before, "all threads to end")


# Tells what the command opens, in the end; where the tests run in the background of a shell, Ctrl-C would be ignored.
WATCHED = """
import json, os, signal, sys
import rodjax.cli
signal.signal(signal.SIGINT, signal.default_int_handler)
opened = []
def watch(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes, os.PathLike)):
        is_written = (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC) != 0
        opened.append((os.path.abspath(os.fsdecode(arguments[0])), is_written))
sys.addaudithook(watch)
code = rodjax.cli.main()
print(json.dumps(opened))
sys.exit(code)
"""
# Where programs and what the system tells of itself are; matplotlib keeps a list of fonts.
PROGRAMS = (sys.prefix, sys.base_prefix, str(Path(rj.__file__).parent), "/usr", "/etc", "/proc", "/sys", "/dev")
FONTS = get_cachedir()


def test_the_command_opens_a_window_and_ends_at_ctrl_c(tmp_path):
    """And reads no file but the scene and programs, and writes none. It compiles what a cantilever needs."""
    cantilever = rj.Scene(rj.problems.cable(), rj.Clamp((0, 0, 0), LEVEL), rj.Free(force=(0, 0, -1e-3)))
    rj.write_scene(cantilever, tmp_path / "scene.toml", segments=4)
    main = WATCHED
    command = [sys.executable, "-W", "error", "-c", main, "view", "scene.toml", "--port", "0", "--no-browser"]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        # Python itself would write what it compiles of the packages.
        env=os.environ | {"RODJAX_CACHE": "off", "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("rodjax: the window is at http://127.0.0.1:")
    port = int(line.split(";")[0].rsplit(":", 1)[1])
    assert listening(port, "127.0.0.1")
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=SECONDS)
    assert (process.returncode, errors) == (0, "")
    opened = json.loads(out)
    assert [str(tmp_path / "scene.toml"), False] in opened
    assert {path for path, _ in opened if not path.startswith((*PROGRAMS, FONTS))} == {str(tmp_path / "scene.toml")}
    assert {path for path, is_written in opened if is_written and not path.startswith(FONTS)} <= {os.devnull}
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]
    assert not listening(port, "127.0.0.1")


def test_what_is_recorded_is_played_and_undone_without_a_browser(by_numpy_code):
    """By the commands that the buttons give."""
    window = rj.view(scene(), 0, open_browser=False, block=False, segments=10)
    session, panel = window.session, window.panel
    done, sent = threading.Event(), []

    def finished(*commands) -> None:
        done.clear()
        for command in commands:
            window.command(command)
        window.command(done.set)
        assert done.wait(SECONDS)

    try:
        until(lambda: window.is_ready, "the window to be ready")
        window.on_drawn = lambda report: sent.append(report)
        finished(lambda: window.record(True))
        place = session.now.controls.poses["end"]
        for k, phase in enumerate(["start", "update", "end"]):
            window.drag("end", Pose(place.position - [0.02 * k, 0, 0], place.frame), phase)
            finished()
        finished(lambda: window.record(False))
        assert [report.moved for report in sent] == [True, True, True]
        assert len(session.recorded) == 4
        assert (panel.frame.min, panel.frame.max, panel.frame.value, panel.frame.disabled) == (0, 3, 3, False)
        finished(lambda: window.show_recorded(0))
        assert session.result.nodes[-1, 0] == pytest.approx(0.8)
        assert window.stage.handles["end"].position[0] == pytest.approx(0.8)
        window.command(window.play)  # which stops as soon as something else is asked for
        until(lambda: abs(session.result.nodes[-1, 0] - 0.76) < 1e-9, "the last moment")
        window.drag("end", Pose(np.array([9.0, 0, 0]), place.frame), "start")
        finished()
        assert "the ends are 9 m apart" in panel.message.content
        finished(window.undo)  # what was refused is no move: back to before the three of them
        assert session.result.nodes[-1, 0] == pytest.approx(0.8)
        window.drag("end", Pose(np.array([0.78, 0, 0]), place.frame), "start")
        finished()
        assert session.result.nodes[-1, 0] == pytest.approx(0.78)
        finished(window.start_over)
        assert session.result.nodes[-1, 0] == pytest.approx(0.8)
        finished(lambda: window.color_by("tension"), window.fit_colors, lambda: 1 / 0)
        assert "ZeroDivisionError" in panel.message.content  # and it lives on
        finished(lambda: window.show_loads(False))
        assert not window.stage.arrows["forces"].visible
    finally:
        window.close()
