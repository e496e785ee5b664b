"""Parts of scenes, of the tables of files: what is alike in many of them is read once."""

import pickle
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from rodjax.io.quantities import check_keys, si_values

# What is read of so many tables a reader keeps at most, about 10 MB.
MAX_KEPT = 10_000
Part = TypeVar("Part")


class PartReader:
    """Makes parts of scenes of tables; what is alike in many of them, such as the cases of a sweep, is read once.

    Errors are `SceneFileError`s without the name of the file.
    """

    def __init__(self):
        self._parts: dict[tuple[Callable, bytes], Any] = {}

    def part(self, make: Callable[..., Part], *arguments: Any) -> Part:
        """`make(self, *arguments)`, of this or an earlier call with the same arguments. Nobody may change it."""
        key = make, pickle.dumps(arguments)
        known = self._parts
        if key in known:
            return known[key]
        made = make(self, *arguments)
        if len(known) >= MAX_KEPT:  # not cleared: another thread may be about to take a part out
            known = self._parts = {}
        known[key] = made
        return made

    def si_values(
        self, table: Any, where: str, required: Sequence[str], optional: Sequence[str], other: Sequence[str] = ()
    ) -> dict[str, Float[np.ndarray, "..."]]:
        """As `quantities.si_values`."""
        check_keys(table, where, required, (*optional, *other))
        return {key: self.part(_si_value, where, key, value) for key, value in table.items() if key not in other}


def _si_value(reader: PartReader, where: str, key: str, value: Any) -> Float[np.ndarray, "..."]:
    return si_values({key: value}, where, (), (key,))[key]
