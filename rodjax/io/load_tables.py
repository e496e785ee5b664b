"""The table `[loads]` of a scene file."""

from collections.abc import Callable
from typing import Any

import numpy as np

from rodjax.io.part_reader import PartReader
from rodjax.io.quantities import flag, named, table_list
from rodjax.model.loads import DistributedCouple, DistributedForce, PointCouple, PointForce

DISTRIBUTED = {"distributed_force": (DistributedForce, "force"), "distributed_couple": (DistributedCouple, "couple")}


def loads_of(
    reader: PartReader, table: Any
) -> tuple[dict[str, np.ndarray], list[PointForce], list[DistributedForce | DistributedCouple], list[PointCouple]]:
    values = reader.si_values(table, "loads", (), ("gravity",), other=("point_force", "point_couple", *DISTRIBUTED))

    def at_points(make: Callable[..., Any], name: str, key: str) -> list[Any]:
        found = []
        for k, load in enumerate(table_list(table.get(name, []), f"loads.{name}")):
            where = f"loads.{name}[{k}]"
            with named(where):
                numbers = reader.si_values(load, where, ("at", key), (), other=("follower",))
                found.append(make(**numbers, follower=flag(load, where, "follower")))
        return found

    forces = at_points(PointForce, "point_force", "force")
    distributed = []
    for name in (name for name in table if name in DISTRIBUTED):
        make, key = DISTRIBUTED[name]
        for k, load in enumerate(table_list(table[name], f"loads.{name}")):
            where = f"loads.{name}[{k}]"
            numbers = reader.si_values(load, where, (key,), ("part",), other=("follower",))
            with named(where):
                distributed.append(make(numbers[key], flag(load, where, "follower"), numbers.get("part")))
    return values, forces, distributed, at_points(PointCouple, "point_couple", "couple")
