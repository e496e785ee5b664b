"""What a long call is doing, for whoever listens: nobody, unless the command line does."""

import sys
import threading
import time
from collections.abc import Callable
from typing import TextIO

# Seconds after which a call that is not done says what it does, and between two lines of that.
QUIET, BETWEEN = 2.0, 1.0

_listener: Callable[[str], None] | None = None


def note(text: str) -> None:
    """Tells a listener, if there is one, what begins now."""
    if _listener is not None:
        _listener(text)


class Narrator:
    """Within its block, prints what a call notes, once the block has taken `QUIET` seconds."""

    def __init__(self, stream: TextIO | None = None):
        self._stream, self._text, self._shown = stream, "", ""
        self._last, self._lock = 0.0, threading.Lock()
        self._timer = threading.Timer(QUIET, self._show)

    def __enter__(self) -> "Narrator":
        global _listener
        self._begin = time.monotonic()
        self._timer.daemon = True
        self._timer.start()
        _listener = self._note
        return self

    def __exit__(self, *_: object) -> None:
        global _listener
        _listener = None
        self._timer.cancel()

    def _note(self, text: str) -> None:
        self._text = text
        now = time.monotonic()
        if now > self._begin + QUIET and now > self._last + BETWEEN:
            self._show()

    def _show(self) -> None:
        with self._lock:
            if self._text and self._text != self._shown:
                self._shown, self._last = self._text, time.monotonic()
                seconds = self._last - self._begin
                print(f"rodjax: {self._text} ({seconds:.0f} s)", file=self._stream or sys.stderr, flush=True)
