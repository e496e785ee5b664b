"""Several searches at once, each in a thread, whose points are evaluated together.

A round evaluates one point of every search that still runs, when all of them have asked: so what is evaluated together,
and with it every result to its last bit, does not depend on how threads are scheduled.
"""

import threading
from collections.abc import Callable, Sequence
from typing import Any

from rodjax.programs.tasks import inherited


class _StoppedError(Exception):
    """Ends a search whose rounds are over."""


class Rounds:
    """`searches`: functions of `ask`, which gives the value of a point; `evaluate`: of {number of a search: its point}
    the values, {number: value}.
    """

    def __init__(
        self, searches: Sequence[Callable[[Callable[[Any], Any]], Any]], evaluate: Callable[[dict[int, Any]], dict]
    ):
        self._searches, self._evaluate = searches, evaluate
        self._changed = threading.Condition()
        self._running = set(range(len(searches)))
        self._asked: dict[int, Any] = {}
        self._answers: dict[int, Any] = {}
        self._found: dict[int, Any] = {}
        self._error: BaseException | None = None
        self._is_stopped = False

    def run(self) -> list[Any]:
        """What the searches return. Where one of them, or an evaluation, raises, all end and it is raised here."""
        self._entered = inherited()
        threads = [
            threading.Thread(target=self._search, args=(k,), name=f"search {k}", daemon=True)
            for k in range(len(self._searches))
        ]
        try:
            for thread in threads:
                thread.start()
            self._rounds()
        finally:
            with self._changed:
                self._is_stopped = True
                self._changed.notify_all()
            for thread in threads:
                if thread.ident is not None:
                    thread.join()
        if self._error is not None:
            raise self._error
        return [self._found[k] for k in range(len(self._searches))]

    def _rounds(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._error is not None or self._asked.keys() >= self._running)
                if self._error is not None or not self._running:
                    return
                asked, self._asked = self._asked, {}
            answers = self._evaluate(dict(sorted(asked.items())))
            with self._changed:
                self._answers.update(answers)
                self._changed.notify_all()

    def _search(self, k: int) -> None:
        def ask(point: Any) -> Any:
            with self._changed:
                self._asked[k] = point
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._is_stopped or k in self._answers)
                if self._is_stopped:
                    raise _StoppedError
                return self._answers.pop(k)

        try:
            with self._entered():
                found = self._searches[k](ask)
        except _StoppedError:
            return
        except BaseException as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()
            return
        with self._changed:
            self._found[k] = found
            self._running.discard(k)
            self._changed.notify_all()
