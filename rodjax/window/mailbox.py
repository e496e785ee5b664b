"""What the browser asks for, in the order in which it did; of moves that nobody has taken yet only the newest."""

import threading
from collections.abc import Callable
from typing import Any

Moves = dict[str, Any]
Item = Moves | Callable[[], None]


class Mailbox:
    """Moves by the name of what is moved, and commands, for one thread to take."""

    def __init__(self) -> None:
        self._items: list[Item] = []
        self._filled = threading.Condition()
        self._is_closed = False

    def move(self, name: str, value: Any) -> None:
        """A newer move takes the place of an older one of the same name, as far as no command came between."""
        with self._filled:
            if not self._items or not isinstance(self._items[-1], dict):
                self._items.append({})
            last = self._items[-1]
            assert isinstance(last, dict)
            last[name] = value
            self._filled.notify()

    def command(self, do: Callable[[], None]) -> None:
        with self._filled:
            self._items.append(do)
            self._filled.notify()

    def close(self) -> None:
        with self._filled:
            self._is_closed = True
            self._filled.notify_all()

    @property
    def is_empty(self) -> bool:
        return not self._items

    @property
    def is_closed(self) -> bool:
        return self._is_closed

    def take(self, seconds: float | None) -> Item | None:
        """What came first; `None` where nothing comes for so long, or the box is closed."""
        with self._filled:
            self._filled.wait_for(lambda: self._items or self._is_closed, seconds)
            return None if self._is_closed or not self._items else self._items.pop(0)
