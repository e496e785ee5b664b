"""What a long call is doing, for whoever watches: lines on stderr, and bars."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, TextIO

from rodjax.checks import instance

# Seconds after which a call that is not done says what it does, and the least between two lines of that.
QUIET, BETWEEN = 2.0, 1.0
# A line comes no sooner than after this part of the time so far: a call of an hour says some forty.
SPACING = 0.25

_narrator: "Narrator | None" = None


def in_notebook() -> bool:
    return "ipykernel" in sys.modules


def is_watched() -> bool:
    """Whether a person reads what goes to stderr: in a terminal or a notebook."""
    return in_notebook() or (sys.stderr is not None and sys.stderr.isatty())


def told(progress: bool | None) -> contextlib.AbstractContextManager[Any]:
    """Within its block a call that takes longer than `QUIET` seconds says what it does; `None`: where it is watched."""
    if progress is not None:
        instance(progress, "progress", bool)
    if not (progress or is_watched()):
        return contextlib.nullcontext()
    return Narrator(is_silent=progress is False, bars_at_once=bool(progress))


def note(text: str) -> None:
    """What begins now."""
    if _narrator is not None:
        _narrator.text = text


@contextlib.contextmanager
def noted(text: str) -> Iterator[None]:
    """What is done within the block; after it goes on what was noted before."""
    narrator = _narrator
    if narrator is None:
        yield
        return
    before, narrator.text = narrator.text, text
    try:
        yield
    finally:
        narrator.text = before


class Bar:
    """A bar of a narrator, or none. `ahead` shows work within a part, which `update` by the part then leaves out."""

    def __init__(self, unit: str, drawn: Any = None):
        self.unit, self._drawn, self._shown = unit, drawn, 0

    def update(self, count: int = 1) -> None:
        known = min(self._shown, count)
        self._shown -= known
        self._draw(count - known)

    def describe(self, text: str) -> None:
        if self._drawn is not None:
            self._drawn.set_description(text)

    def ahead(self, count: int) -> None:
        if self._drawn is not None and self._drawn.total is not None:
            count = min(count, self._drawn.total - self._drawn.n)
            self._shown += count
            self._draw(count)

    def _draw(self, count: int) -> None:
        if self._drawn is not None:
            self._drawn.update(count)


class _Within(Bar):
    """A bar within another one's block, which counts on that where it counts the same."""

    def __init__(self, unit: str, outer: Bar):
        super().__init__(unit)
        self._outer = outer if outer.unit == unit else None

    def update(self, count: int = 1) -> None:
        if self._outer is not None:
            self._outer.ahead(count)


@contextlib.contextmanager
def bar(total: int | None, unit: str, initial: int = 0) -> Iterator[Bar]:
    """A bar in the place of lines, where there is a narrator."""
    narrator = _narrator
    if narrator is None or narrator.is_silent:
        yield Bar(unit)
    elif narrator.bar is not None:
        yield _Within(unit, narrator.bar)
    else:
        from tqdm import tqdm  # which a solve need not wait for

        delay = 0.0 if narrator.bars_at_once else max(narrator.begin + QUIET - time.monotonic(), 0.0)
        with tqdm(total=total, initial=initial, unit=f" {unit}", delay=delay, file=narrator.stream) as drawn:
            narrator.bar = Bar(unit, drawn)
            try:
                yield narrator.bar
            finally:
                narrator.bar = None


class Narrator:
    """Within its block, prints what a call notes, once the block has taken `QUIET` seconds; within another one's block
    that one prints.
    """

    def __init__(self, stream: TextIO | None = None, is_silent: bool = False, bars_at_once: bool = False):
        self.stream, self.is_silent, self.bars_at_once = stream or sys.stderr, is_silent, bars_at_once
        self.text = self._shown = ""
        self.bar: Bar | None = None
        self.begin = self.due = 0.0

    def __enter__(self) -> "Narrator":
        global _narrator
        if _narrator is None:
            self.begin = time.monotonic()
            self.due = self.begin + QUIET
            _narrator = self
            if not self.is_silent:
                _watch()
        return self

    def __exit__(self, *_: object) -> None:
        global _narrator
        if _narrator is self:
            _narrator = None

    def say(self) -> None:
        """Prints what was noted last, unless it stands there already."""
        now = time.monotonic()
        self.due = now + max(BETWEEN, SPACING * (now - self.begin))
        text = self.text
        if text and text != self._shown and self.bar is None and not self.is_silent:
            self._shown = text
            print(f"rodjax: {text} ({now - self.begin:.0f} s)", file=self.stream, flush=True)


_begun = threading.Event()
_watcher: threading.Thread | None = None


def _watch() -> None:
    """One thread of the process looks after all narrators: to begin one costs a call of a millisecond nothing."""
    global _watcher
    _begun.set()
    if _watcher is None or not _watcher.is_alive():
        _watcher = threading.Thread(target=_look, daemon=True)
        _watcher.start()


def _look() -> None:
    while _begun.wait():
        _begun.clear()
        while (narrator := _narrator) is not None:
            wait = narrator.due - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            else:
                narrator.say()
