"""Calls that take long say what they do: in a terminal or where it is asked for, and never elsewhere."""

import io
import re
import sys
import time

import pytest

import rodjax as rj
from rodjax import notes
from rodjax.notes import Narrator, bar, note, noted, told
from rodjax.programs.answers import COMPILING, one_answer
from rodjax.programs.tasks import in_order


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def short_times(monkeypatch):
    """Calls take long that take longer than 50 ms."""
    monkeypatch.setattr(notes, "QUIET", 0.05)
    monkeypatch.setattr(notes, "BETWEEN", 0.01)
    monkeypatch.setattr(notes, "SPACING", 0.0)


def stderr(monkeypatch, stream):
    """In the test itself, as pytest has a stderr of its own there."""
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def said(stream):
    return [line.split(" (")[0] for line in stream.getvalue().splitlines()]


def wait_for(text, stream):
    """The thread that looks after narrators is woken within 50 ms, unless the machine is busy."""
    end = time.monotonic() + 10
    while text not in stream.getvalue() and time.monotonic() < end:
        time.sleep(0.01)
    assert text in stream.getvalue()


def test_a_long_call_says_what_it_does(short_times, monkeypatch):
    """Once it has taken a while, what has begun last; and nothing outside of the block."""
    terminal = stderr(monkeypatch, Terminal())
    with told(None):
        note("first")
        note("second")
        wait_for("second", terminal)
        with noted("third"):
            wait_for("third", terminal)
        with told(None):  # a call within tells of itself to the outer one
            note("fourth")
        wait_for("fourth", terminal)
    note("fifth")
    time.sleep(0.1)
    assert said(terminal) == [f"rodjax: {number}" for number in ("second", "third", "fourth")]
    assert re.fullmatch(r"rodjax: second \(0 s\)", terminal.getvalue().splitlines()[0])


@one_answer
def slow(progress=None):
    note("at work")
    time.sleep(0.2)


def test_it_is_told_where_someone_watches_or_asks(short_times, monkeypatch):
    terminal = stderr(monkeypatch, Terminal())
    slow()
    assert said(terminal) == ["rodjax: at work"]
    slow(progress=False)
    with told(False):
        slow()  # nor what is called within
    assert said(terminal) == ["rodjax: at work"]
    file = stderr(monkeypatch, io.StringIO())
    slow()
    assert not file.getvalue()
    slow(progress=True)
    assert said(file) == ["rodjax: at work"]
    cell = stderr(monkeypatch, io.StringIO())
    monkeypatch.setitem(sys.modules, "ipykernel", notes)  # as in a notebook, whose stderr is no terminal
    slow()
    assert said(cell) == ["rodjax: at work"]


def test_what_is_quick_says_nothing(monkeypatch):
    monkeypatch.setattr(notes, "QUIET", 60.0)  # however busy the machine is
    terminal = stderr(monkeypatch, Terminal())
    rj.solve(rj.problems.hanging_cable(), segments=8)
    assert not terminal.getvalue()


def test_solves_and_programs_are_told(monkeypatch):
    told_of = []

    class Listener(Narrator):
        def __setattr__(self, name, value):
            if name == "text":
                told_of.append(value)
            super().__setattr__(name, value)

    with rj.numpy_first(False), Listener(io.StringIO()):
        rj.solve(rj.problems.cantilever(), segments=3)
    assert "solving on 3 segments" in told_of
    assert COMPILING in told_of


def test_a_bar_counts_parts_and_what_is_done_within_them(monkeypatch):
    stream = stderr(monkeypatch, io.StringIO())
    with told(True), bar(8, "cases") as drawn:
        for _ in range(2):
            with bar(3, "cases") as inner, bar(7, "rounds") as other:
                inner.update(3)
                other.update(7)
            drawn.update(4)
    counts = [int(count) for count in re.findall(r"(\d)/8", stream.getvalue())]
    assert counts == sorted(counts)
    assert counts[-1] == 8
    assert "8/8" in stream.getvalue()
    assert "rounds" not in stream.getvalue()


def test_parts_are_counted(monkeypatch):
    stream = stderr(monkeypatch, io.StringIO())
    with told(True):
        assert in_order(abs, [(-1,), (2,), (-3,)], threads=1, unit="numbers") == [1, 2, 3]
    assert "3/3" in stream.getvalue()


def test_progress_must_be_true_false_or_none():
    with pytest.raises(TypeError, match="progress must be a bool, got 'yes'"):
        rj.solve(rj.problems.hanging_cable(), segments=8, progress="yes")  # pyright: ignore[reportArgumentType]
