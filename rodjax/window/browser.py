"""The window in the browser: a session, a viser server that shows it, and one thread between the two."""

import contextlib
import functools
import gc
import io
import logging
import socket
import threading
import time
import webbrowser
from collections.abc import Callable
from typing import Any

import numpy as np

from rodjax.checks import whole_number
from rodjax.filming import best_suffix, film_content
from rodjax.model.harness import Harness
from rodjax.programs.tasks import inherited
from rodjax.routing.limits import Limits
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.window.controls import Pose, rods_of
from rodjax.window.files import path_file, scene_file
from rodjax.window.mailbox import Mailbox
from rodjax.window.numbers import least_bend_radius, rows
from rodjax.window.origins import only_own_pages
from rodjax.window.panel import Buttons, Panel
from rodjax.window.reading import QUANTITIES, readings_of
from rodjax.window.session import Report, Session
from rodjax.window.stage import Stage
from rodjax.window.tube import Scale, covers, scale_over

# Seconds: without a move after which a rod is at rest, between numbers and between looks at stability while it moves,
# between frames of a recording, and without a number after which a slider is taken anew.
REST, NUMBERS, STABILITY, FRAME, STRETCH = 0.05, 0.1, 0.25, 1 / 30, 0.5
# While a rod moves, the time between looks at stability is so many times that of a look: few moves wait for one.
SELDOM = 200
# Shapes that a fan shows at most, and pixels of a film, which the browser shall have drawn in so many seconds each.
MOST_IN_FAN, FILM, FILM_SECONDS = 100, (960, 640), 20.0
MARGIN = "share of the bend limit"
_log = logging.getLogger("rodjax")


class Window:
    """A session that a browser shows; it lives until `close`.

    **Arguments:**

    - `session`: `Session`.
    - `port`: 0 for any that is free. `host`: who may connect; the default only programs of this machine.
    - `limits`: of `rodjax.Limits`, against which numbers are shown; `None` for none.
    - `dark`: whether the page is dark. `together`: whether all steps of the session are shown in the beginning.

    `on_drawn` is called with the report of each move whose shape has been sent, in the window's own thread.

    Raises `ImportError` without viser, `OSError` where nothing can be opened at host and port.
    """

    def __init__(
        self,
        session: Session,
        port: int = 8080,
        host: str = "127.0.0.1",
        limits: Limits | None = None,
        dark: bool = False,
        together: bool = False,
    ):
        self.session, self.limits = session, limits
        self.quantity, self.with_loads = "curvature", True
        self.scales: dict[str, Scale] = {}
        self.report = Report(session.readings, "", True, False, int(session.result.iterations), 0.0)
        self._mailbox, self._closed, self._ready = Mailbox(), threading.Event(), threading.Event()
        self._stability_known = threading.Event()
        self._compiling: threading.Thread | None = None
        self._has_fan = False
        self.on_drawn: Callable[[Report], None] = lambda report: None
        self._numbers_at = self._stability_due = self._slid_at = 0.0
        self._slid = ""
        self.server = started(port, host)
        shown = "127.0.0.1" if host == "0.0.0.0" else f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.server.get_port()}"
        self.show_dark(dark)
        # A tunnel through a server of viser's would let anybody in.
        self.server.request_share_url = _no_tunnel
        least = [least_bend_radius(scene, limits) for scene in rods_of(session.scene).values()]
        self._least_radii = None if None in least else [float(radius or 0) for radius in least]
        self.stage = Stage(self.server, session, self.drag)
        self.panel = self._panel()
        self.panel.show_frames(len(session.recorded), len(session.recorded) - 1)
        self._draw()
        if together:
            self.panel.fan.value = True
            self.show_fan(True)
        self._thread = threading.Thread(target=self._run, name="rodjax window", daemon=True)
        self._thread.start()

    def open(self) -> None:
        """Shows the window in the user's browser."""
        webbrowser.open(self.url)

    def close(self) -> None:
        """Ends the server and its threads. A second call does nothing."""
        if self._mailbox.is_closed:
            return
        self._mailbox.close()
        self._closed.set()
        self._thread.join()
        if self._compiling is not None:
            self._compiling.join()
        gc.unfreeze()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def wait(self) -> None:
        """Until Ctrl-C, then closes."""
        try:
            # Not the thread itself: a join that is interrupted takes it for ended (Python 3.11).
            while not self._closed.wait(0.5):
                pass
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    # --- what the browser asks for ---

    def _panel(self) -> Panel:
        colors = dict(QUANTITIES)
        if "pressure" not in self.session.reading.values:
            colors.pop("pressure")
        if self._least_radii is not None:
            colors[MARGIN] = MARGIN
        later = self._mailbox.command
        buttons = Buttons(
            undo=lambda: later(self.undo),
            start_over=lambda: later(self.start_over),
            save_scene=lambda client: later(lambda: self._download(client, "scene.toml", scene_file)),
            color_by=lambda name: later(lambda: self.color_by(name)),
            fit_colors=lambda: later(self.fit_colors),
            show_loads=lambda on: later(lambda: self.show_loads(on)),
            show_handles=self.stage.show_handles,
            show_dark=lambda on: later(lambda: self.show_dark(on)),
            number=self._number,
            record=lambda on: later(lambda: self.record(on)),
            play=lambda: later(self.play),
            show_recorded=lambda k: self._mailbox.move("recorded", k),
            show_fan=lambda on: later(lambda: self.show_fan(on)),
            save_film=lambda client: later(lambda: self.save_film(client)),
            save_recording=lambda client: later(lambda: self._download(client, "path.vtkhdf", path_file)),
        )
        numbers = dict(self.session.now.controls.numbers)
        sliders, has_steps = list(self.session.sliders.values()), bool(self.session.recorded)
        return Panel(self.server.gui, sliders, numbers, colors, buttons, has_steps, self.is_dark)

    def drag(self, name: str, pose: Pose, phase: str = "update") -> None:
        """A handle has been dragged to a pose, as the browser tells it: at the "start", an "update" or the "end"."""
        if phase == "start":
            self._mailbox.command(self.session.mark)
        self._mailbox.move(name, pose)
        if phase == "end":
            self._mailbox.command(lambda: self.stage.place(handles=True))

    def _number(self, name: str, value: float) -> None:
        # One stretch of a slider is undone at once, and its numbers are coalesced.
        now = time.monotonic()
        if name != self._slid or now - self._slid_at > STRETCH:
            self._mailbox.command(self.session.mark)
        self._slid, self._slid_at = name, now
        self._mailbox.move(name, value)

    def _repr_html_(self) -> str:
        """The window itself, in a notebook on this machine."""
        return f'<iframe src="{self.url}" width="100%" height="600" style="border:0"></iframe>'

    # --- the thread that does it ---

    def _run(self) -> None:
        self._do(self._warm_up)
        while not self._mailbox.is_closed:
            item = self._mailbox.take(REST if self._is_unsettled else None)
            if self._mailbox.is_closed:
                return
            if item is None:
                self._do(self._settle)
            elif callable(item):
                self._do(item)
            else:
                moves = item
                self._do(lambda moves=moves: self._moved(moves))

    def _do(self, command: Callable[[], None]) -> None:
        """Whatever goes wrong is said, and the window lives on."""
        try:
            command()
        except Exception as error:
            _log.exception("the window could not do what it was asked")
            self.panel.say(f"{type(error).__name__}: {' '.join(str(error).split())}", is_bad=True)

    def _warm_up(self) -> None:
        self.panel.say("compiling: a few seconds, once for this kind of scene")
        self.session.warm_up(lambda: not self._mailbox.is_closed)
        if isinstance(self.session.scene, Harness) and self.session.can_settle:
            # That takes up to a minute: until then the index of the last solve is shown.
            entered = inherited()
            prepare = functools.partial(self._prepare_stability, entered)
            self._compiling = threading.Thread(target=self._do, args=(prepare,), daemon=True)
            self._compiling.start()
        else:
            self._stability_known.set()
        self._settle()
        # A full collection would look at millions of objects of JAX, for a tenth of a second in the middle of a move.
        gc.collect()
        gc.freeze()
        self._ready.set()

    def _prepare_stability(self, entered: Callable[[], contextlib.AbstractContextManager]) -> None:
        with entered():
            self.session.prepare_stability()
        self._stability_known.set()
        self._mailbox.command(self._settle)

    @property
    def is_ready(self) -> bool:
        """Whether all that moves need is compiled."""
        return self._ready.is_set()

    @property
    def _hint(self) -> str:
        return f"Drag an arrow or a ring of a handle. {self.stage.note}"

    @property
    def _is_unsettled(self) -> bool:
        awaits = self.session.softest is None and self.session.can_settle and self._stability_known.is_set()
        return self._numbers_at == 0.0 or awaits

    def _moved(self, moves: dict[str, Any]) -> None:
        frame = moves.pop("recorded", None)
        if frame is not None:
            self.show_recorded(int(frame))
        if not moves:
            return
        self.report = self.session.move(moves)
        self.stage.place(handles=False)
        self._draw()
        # viser would send what has come together 60 times a second at most: shapes wait, and some are left out.
        self.server.flush()
        self.on_drawn(self.report)
        now = time.monotonic()
        if self._mailbox.is_empty and now > self._stability_due:
            self._look_at_stability()
        if self.report.message or now - self._numbers_at > NUMBERS:
            self._show_numbers()
        else:
            self._numbers_at = 0.0  # later, at rest

    def _settle(self) -> None:
        self._look_at_stability()
        self._show_numbers()

    def _look_at_stability(self) -> None:
        if not self._stability_known.is_set():
            return
        begin = time.monotonic()
        self.session.settle()
        now = time.monotonic()
        self._stability_due = now + max(STABILITY, SELDOM * (now - begin))

    def _show_numbers(self) -> None:
        self._numbers_at = time.monotonic()
        self.panel.show_rows(rows(self.session, self.report, self.limits))
        text = self.report.message or ("the rod is about to snap" if self.session.is_soft else "")
        self.panel.say(text or self._hint, is_bad=bool(text))

    def _draw(self) -> None:
        readings = self.report.readings
        if self._least_radii is not None:
            for reading, least in zip(readings, self._least_radii, strict=True):
                reading.values[MARGIN] = least * reading.values["curvature"]
        values = np.concatenate([reading.values[self.quantity] for reading in readings])
        scale = self.scales.get(self.quantity)
        if scale is None or not covers(scale, values):
            low, high = float(np.min(values)), float(np.max(values))
            if scale is not None:  # it only grows, so that a colour keeps its meaning
                low, high = min(low, float(scale.edges[0])), max(high, float(scale.edges[-1]))
            scale = self.scales[self.quantity] = scale_over(low, high)
            self.panel.show_legend(scale)
        with self.server.atomic():
            self.stage.draw(readings, self.quantity, scale)
            self.stage.draw_loads(readings, self.with_loads)
            if isinstance(self.session.result, HarnessEquilibrium):
                self.stage.draw_joints(np.asarray(self.session.result.positions))

    def _show_all(self) -> None:
        """After a jump to another moment: handles and sliders go along."""
        self.stage.place(handles=True)
        self.panel.show_numbers(dict(self.session.now.controls.numbers))
        self._draw()
        self._settle()

    # --- commands, for the window's thread ---

    def command(self, do: Callable[[], None]) -> None:
        """Has a command done by the window's thread, after all that was asked for before."""
        self._mailbox.command(do)

    def undo(self) -> None:
        self.report = self.session.undo()
        self._show_all()

    def start_over(self) -> None:
        self.session.mark()
        self._jump(lambda: self.session.show(self.session.first))

    def _jump(self, show: Callable[[], Any]) -> None:
        begin = time.perf_counter()
        self.report = Report(show(), "", True, False, 0, 1e3 * (time.perf_counter() - begin))
        self._show_all()

    def color_by(self, name: str) -> None:
        self.quantity = name
        if name in self.scales:
            self.panel.show_legend(self.scales[name])
        self._draw()

    def fit_colors(self) -> None:
        self.scales.pop(self.quantity, None)
        self._draw()

    def show_loads(self, on: bool) -> None:
        self.with_loads = on
        self._draw()

    def show_dark(self, on: bool) -> None:
        self.is_dark = on
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=on)
        if self._has_fan:
            self.show_fan(True)  # in other colours

    def record(self, on: bool) -> None:
        self.session.record(on)
        if not on:
            self.panel.show_frames(len(self.session.recorded), len(self.session.recorded) - 1)
        self.panel.say("every move is recorded" if on else f"{len(self.session.recorded)} moments are recorded")

    def show_recorded(self, k: int) -> None:
        if self.session.recorded and not self.session.is_recording:
            moment = self.session.recorded[min(k, len(self.session.recorded) - 1)]
            self._jump(lambda: self.session.show(moment))

    def show_fan(self, on: bool) -> None:
        """All steps that are recorded at once, or every so many of them."""
        self._has_fan = on
        steps = self.session.recorded
        chosen = np.unique(np.linspace(0, len(steps) - 1, MOST_IN_FAN).round().astype(int)) if on and steps else []
        self.stage.draw_fan([readings_of(steps[k].result) for k in chosen], self.is_dark)

    def save_film(self, client: Any) -> None:
        """All steps as the browser that asks for it shows them."""
        steps = self.session.recorded
        if not steps:
            self.panel.say("not saved: nothing is recorded yet", is_bad=True)
            return
        frames = []
        for k in range(len(steps)):
            if self._mailbox.is_closed:
                return
            self.panel.say(f"the film is made: step {k + 1} of {len(steps)}")
            self.show_recorded(k)
            frames.append(np.asarray(client.get_render(height=FILM[1], width=FILM[0], timeout=FILM_SECONDS))[..., :3])
        name = f"film{best_suffix()}"
        client.send_file_download(name, film_content(frames, name))
        self.panel.say(f"{name} is ready to be downloaded")

    def play(self) -> None:
        for k in range(len(self.session.recorded)):
            if not self._mailbox.is_empty or self._mailbox.is_closed:
                return  # something else was asked for
            begin = time.monotonic()
            self.show_recorded(k)
            self.panel.frame.value = k
            time.sleep(max(0.0, FRAME - (time.monotonic() - begin)))

    def _download(self, client: Any, name: str, make: Callable[[Session], tuple[bytes, str]]) -> None:
        """To the browser that asked for it: this process writes no file."""
        try:
            self.panel.say(f"{name} is made")
            content, note = make(self.session)
        except (ImportError, ValueError) as error:
            self.panel.say(f"not saved: {error}", is_bad=True)
            return
        client.send_file_download(name, content)
        self.panel.say(f"{name}: {note}" if note else f"{name} is ready to be downloaded")


def started(port: int, host: str) -> Any:
    """A viser server at exactly this address."""
    try:
        import viser
    except ImportError:
        raise ImportError("view needs viser, got none: pip install 'rodjax[view]'") from None
    port = whole_number(port, "port", 0, 65535)
    # viser would take the next port, or wait forever.
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise OSError(f"port {port} of {host} cannot be opened: {error.strerror}") from None
    with contextlib.redirect_stdout(io.StringIO()), only_own_pages(host):
        return viser.ViserServer(host=host, port=port, label="rodjax", verbose=False)


def _no_tunnel(verbose: bool = True) -> None:
    _log.warning("a browser asked to share the window beyond this machine, which rodjax does not do")
