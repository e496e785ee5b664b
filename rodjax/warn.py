"""Warnings that point at the line of the user's that called, however deep inside the library they are given."""

import contextlib
import sys
import threading
import warnings
from collections.abc import Iterator


class _Silenced(threading.local):
    """The categories that this thread keeps to itself."""

    categories: tuple[type[Warning], ...] = ()


_silenced = _Silenced()


def warn(message: str, category: type[Warning]) -> None:
    if issubclass(category, _silenced.categories):
        return
    frame, level = sys._getframe(1), 2
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] == __package__:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


@contextlib.contextmanager
def silenced(*categories: type[Warning]) -> Iterator[None]:
    """In here, and in this thread alone, the library's own warnings of these categories are not given.

    (`warnings.catch_warnings` changes the filters of all threads, and two of them leave it in the wrong order.)
    """
    before = _silenced.categories
    _silenced.categories = (*before, *categories)
    try:
        yield
    finally:
        _silenced.categories = before
