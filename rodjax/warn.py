"""Warnings that point at the line of the user's that called, however deep inside the library they are given."""

import sys
import warnings


def warn(message: str, category: type[Warning]) -> None:
    frame, level = sys._getframe(1), 2
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] == __package__:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
