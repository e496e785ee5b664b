"""Does the window keep up with a hand?

A hand that moves and turns at random (`interactive.hand`), by 5 mm and 3 degrees a move at most, drags an end of cables
of 32 elements each, 90 times a second, in a window that nobody looks at: through its mailbox, its thread and all that
it sends to a browser. What is measured is the time from a move received to its shape sent, and the processor time that
the process takes for each move, by which other programs on the machine do not count. It needs viser: pip install
'rodjax[view]'.

With --browser the same hand moves in a window that Chromium shows, headless: how many shapes a second the window makes,
how many reach the browser, and how many pictures that draws, here by the processor. It needs playwright and Chromium
besides.
"""

import argparse
import shutil
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from interactive import hand
from measuring import conditions, save_rows, set_up

import rodjax
from rodjax.window.browser import Window
from rodjax.window.controls import Pose
from rodjax.window.session import Report, Session

SEGMENTS = 32
PERIOD = 1 / 90  # [s]
WARM_UP = 20  # first moves, which do not count
# [ms] and the share of moves that shall be sooner.
TARGETS = {"two clips": (5.0, 99.9), "two obstacles": (15.0, 99.0), "harness of five": (25.0, 99.0)}
CHROMIUM = "chromium", "chromium-browser", "google-chrome", "chrome"
# WebGL by the processor, and no sandbox, which needs rights that a container lacks.
FLAGS = ["--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
FLAGS += ["--no-sandbox"]
# Small, as the processor that draws it is the one that solves.
SIZE = 480, 320
COUNT_PICTURES = "window.drawn = 0; const count = () => { window.drawn++; requestAnimationFrame(count); }; count();"


class Row(NamedTuple):
    """Latencies [ms] of a scene; `solved`: of these the median of the session's own part, without what is sent;
    `processor`: the median of the processor time of a move.
    """

    scene: str
    moves: int
    median: float
    percent_99: float
    percent_99_9: float
    worst: float
    solved: float
    processor: float
    target: float
    target_percent: float
    within: float  # share of moves within the target
    not_moved: int  # refused, or not all of the way
    iterations_median: float
    iterations_max: int


class Dragged(NamedTuple):
    """What is dragged: a handle by its name, from where it is in the beginning."""

    scene: rodjax.Scene | rodjax.Harness
    handle: str
    begin: rodjax.Clamp


def scenes() -> dict[str, Dragged]:
    level = rodjax.frame((1.0, 0.0, 0.0))
    ends = rodjax.Clamp((0.0, 0.0, 0.0), level), rodjax.Clamp((0.8, 0.0, 0.0), level)
    cable, gravity = rodjax.problems.cable(), (0.0, 0.0, -9.81)
    clips = [rodjax.Clip(0.25, (0.22, 0.02, -0.08)), rodjax.Clip(0.5, (0.42, -0.02, -0.14))]
    pipes = [rodjax.Capsule((x, -0.5, -0.16), (x, 0.5, -0.16), 0.03) for x in (0.25, 0.55)]
    harness = harness_of_five()
    hand_holds = harness["right"].end
    assert isinstance(hand_holds, rodjax.Clamp)
    return {
        "two clips": Dragged(rodjax.Scene(cable, *ends, gravity, clips=clips), "end", ends[1]),
        "two obstacles": Dragged(rodjax.Scene(cable, *ends, gravity, obstacles=pipes), "end", ends[1]),
        "harness of five": Dragged(harness, "right/end", hand_holds),
    }


def harness_of_five() -> rodjax.Harness:
    """A trunk that parts in two, of which each parts in two: five cables, two joints."""
    cable, gravity = rodjax.problems.cable(), (0.0, 0.0, -9.81)
    level, back = rodjax.frame((1.0, 0.0, 0.0)), rodjax.frame((-1.0, 0.0, 0.0))

    def branch(joint: str, end: tuple[float, float, float]) -> rodjax.Scene:
        return rodjax.Scene(cable, rodjax.Joint(joint, level), rodjax.Clamp(end, level), gravity)

    return rodjax.Harness(
        {
            "trunk": rodjax.Scene(cable, rodjax.Joint("first", level), rodjax.Joint("second", level), gravity),
            "back": rodjax.Scene(cable, rodjax.Joint("first", back), rodjax.Clamp((-0.8, 0.3, 0.0), back), gravity),
            "under": rodjax.Scene(cable, rodjax.Joint("first", back), rodjax.Clamp((-0.8, -0.3, 0.0), back), gravity),
            "left": branch("second", (1.6, 0.3, 0.0)),
            "right": branch("second", (1.6, -0.3, 0.0)),
        }
    )


def latencies(
    dragged: Dragged, moves: int, seed: int, period: float = PERIOD
) -> tuple[np.ndarray, np.ndarray, list[Report]]:
    """Of each move of a hand [ms], its processor time [ms], and what it led to."""
    session = Session(dragged.scene, segments=SEGMENTS)
    window = Window(session, port=0)
    sent, reports = threading.Event(), []

    def drawn(report: Report) -> None:
        reports.append(report)
        sent.set()

    window.on_drawn = drawn
    try:
        while not window.is_ready:
            time.sleep(0.05)
        positions, frames = hand(dragged.begin, np.zeros(3), moves + WARM_UP, seed)
        times, processor = [], []
        due = time.perf_counter()
        for position, frame in zip(positions, frames, strict=True):
            due = max(due + period, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))
            sent.clear()
            begin, begin_processor = time.perf_counter(), time.process_time()
            window.drag(dragged.handle, Pose(position, frame))
            sent.wait()
            times.append(1e3 * (time.perf_counter() - begin))
            processor.append(1e3 * (time.process_time() - begin_processor))
    finally:
        window.close()
    return np.array(times[WARM_UP:]), np.array(processor[WARM_UP:]), reports[WARM_UP:]


class Shapes(NamedTuple):
    """Of so many moves in so many seconds: shapes made, those of them that reached the browser, and pictures drawn."""

    scene: str
    moves: int
    seconds: float
    made: int
    received: int
    drawn: int


def chromium() -> str | None:
    return next(filter(None, map(shutil.which, CHROMIUM)), None)


def shapes_in_browser(name: str, moves: int, seed: int, period: float = PERIOD) -> Shapes:
    """Of a hand in a scene, as Chromium sees it."""
    from playwright import sync_api

    dragged = scenes()[name]
    window = Window(Session(dragged.scene, segments=SEGMENTS), port=0)
    received, made = [], []
    with sync_api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.on("websocket", lambda socket: socket.on("framereceived", lambda frame: received.append(frame)))
            page.goto(window.url)
            while not window.is_ready or not window.server.get_clients():
                page.wait_for_timeout(100)
            page.wait_for_timeout(2000)  # until all that was there is drawn
            page.evaluate(COUNT_PICTURES)
            window.on_drawn = made.append
            positions, frames = hand(dragged.begin, np.zeros(3), moves, seed)

            def drag() -> None:
                due = time.perf_counter()
                for position, frame in zip(positions, frames, strict=True):
                    due += period
                    time.sleep(max(0.0, due - time.perf_counter()))
                    window.drag(dragged.handle, Pose(position, frame))

            thread, before, begin = threading.Thread(target=drag), len(received), time.perf_counter()
            thread.start()
            while thread.is_alive():
                page.wait_for_timeout(20)
            seconds, drawn = time.perf_counter() - begin, page.evaluate("window.drawn")
            page.wait_for_timeout(500)  # what is on its way
            shapes = sum(map(carries_shape, received[before:]))
            browser.close()
        finally:
            window.close()
    return Shapes(name, moves, seconds, len(made), shapes, drawn)


def carries_shape(frame: str | bytes) -> bool:
    """Whether a message of viser moves a rod: behind two sizes of 8 bytes is what it says, compressed."""
    import zstandard

    if isinstance(frame, str) or len(frame) < 16:
        return False
    size = int.from_bytes(frame[8:16], "little")
    return b"batched_positions" in zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size])


def told(shapes: Shapes) -> str:
    rates = [count / shapes.seconds for count in (shapes.moves, shapes.made, shapes.received, shapes.drawn)]
    return f"{shapes.scene:16}" + "".join(f"{rate:12.1f}" for rate in rates)


def row(name: str, times: np.ndarray, processor: np.ndarray, reports: Sequence[Report]) -> Row:
    median, percent_99, percent_99_9 = np.percentile(times, [50, 99, 99.9])
    target, target_percent = TARGETS[name]
    iterations = [report.iterations for report in reports]
    return Row(
        scene=name,
        moves=len(times),
        median=float(median),
        percent_99=float(percent_99),
        percent_99_9=float(percent_99_9),
        worst=float(np.max(times)),
        solved=float(np.median([report.milliseconds for report in reports])),
        processor=float(np.median(processor)),
        target=target,
        target_percent=target_percent,
        within=float(100 * np.mean(times <= target)),
        not_moved=sum(not report.moved for report in reports),
        iterations_median=float(np.median(iterations)),
        iterations_max=int(np.max(iterations)),
    )


HEADER = (
    f"{'':16}|{'from a move to its shape sent [ms]':^45}|{'proc.':>7}|{'within':^20}|{'not':>6}|{'iterations':^12}\n"
    f"{'scene':16}|{'median':>9}{'99 %':>9}{'99.9 %':>9}{'worst':>9}{'solved':>9}|{'[ms]':>7}|{'target':>20}"
    f"|{'moved':>6}|{'median':>7}{'max':>5}"
)


def line(row: Row) -> str:
    within = f"{row.within:.2f} % in {row.target:g} ms"
    return (
        f"{row.scene:16}|{row.median:9.2f}{row.percent_99:9.2f}{row.percent_99_9:9.2f}{row.worst:9.2f}{row.solved:9.2f}"
        f"|{row.processor:7.2f}|{within:>20}|{row.not_moved:6}|{row.iterations_median:7.0f}{row.iterations_max:5}"
    )


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--moves", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for window_latency.csv")
    parser.add_argument("--browser", action="store_true", help="shapes a second in Chromium instead")
    arguments = parser.parse_args(argv)
    set_up()
    if arguments.browser:
        print(f"{arguments.moves} moves, {SEGMENTS} elements, seed {arguments.seed}; {conditions()}")
        print(f"{'a second:':16}{'moves':>12}{'made':>12}{'received':>12}{'drawn':>12}")
        for name in arguments.scene:
            print(told(shapes_in_browser(name, arguments.moves, arguments.seed)), flush=True)
        return []
    print(f"{arguments.moves} moves, {SEGMENTS} elements, seed {arguments.seed}; {conditions()}")
    print(HEADER)
    rows = []
    for name in arguments.scene:
        found = row(name, *latencies(scenes()[name], arguments.moves, arguments.seed))
        print(line(found), flush=True)
        rows.append(found)
    if arguments.out is not None:
        save_rows(rows, arguments.out / "window_latency.csv")
    return rows


if __name__ == "__main__":
    main()
