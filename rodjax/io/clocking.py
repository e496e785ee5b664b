"""Whether clamps of a scene file may leave their clocking, the angle of their frame about the tangent, unstated.

Such a clamp is fitted without torsion. Where a result would depend on what is not stated the file is refused.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.io.quantities import SceneFileError
from rodjax.model.loads import DistributedCouple, DistributedForce, PointCouple, PointForce
from rodjax.model.rod import Rod
from rodjax.model.supports import Clip

# SI values of the tables start, end and loads, by table and key.
Values = dict[str, dict[str, Float[np.ndarray, "..."]]]


def is_unclocked(values: Mapping[str, np.ndarray]) -> bool:
    """Whether a clamp holds a tangent and does not say where d2 points."""
    return "frame" not in values and "d2" not in values


def check_clocked(key: str, unclocked: Sequence[str], where: str) -> None:
    """Raises `SceneFileError` for a number of a frame, by its dotted name, that the scene file does not state."""
    end, _, of_end = key.partition(".")
    if end in unclocked and of_end.split(".")[0] == "frame":
        raise SceneFileError(f"{where}: {key} needs {end}.d2 or {end}.frame in the scene file, from which it turns")


class Clocking(NamedTuple):
    """What a file says of it: the `kinds` of its ends, which of them are `unclocked` clamps, what of the rod, its clips
    and loads counts, the `values` of the first scene and those that change `along` a path, which ends are free ones
    with loads that follow, which are `spun` in the first scene, and whole turns or `None`.
    """

    kinds: Mapping[str, str]
    unclocked: Sequence[str]
    rod: Rod
    clips: Sequence[Clip]
    loads: Sequence[PointForce | PointCouple | DistributedForce | DistributedCouple]
    values: Values
    along: Sequence[Values]
    followers: Mapping[str, bool]
    spun: set[str]
    turns: np.ndarray | None

    def check(self) -> bool:
        """Raises `SceneFileError` where clocking counts that is not stated.

        Returns whether the one unclocked clamp must resist torsion, with any clocking: then nothing else does.
        """
        for name in self.unclocked:
            for reason in self.reasons(name):
                raise SceneFileError(f"{name}.d2 or {name}.frame is needed for a clamp {reason}")
        return self.resists

    def reasons(self, name: str) -> Iterator[str]:
        """Why the clocking of this clamp must be stated; nothing where it need not be."""
        (other,) = {"start", "end"} - {name}
        if (
            isinstance(self.rod.EI, tuple)
            or isinstance(self.rod.GA, tuple)
            or self.rod.rest_curvature is not None
            or self.rod.rest_centerline is not None
        ):
            yield "of a rod whose section or rest shape is not the same all around its tangent"
        if self.turns is not None:
            yield "where end.turns is given: they are counted between two frames"
        if self.kinds[other] == "clamp" and not self.holds_frames:
            changed = {key for target in self.along for key in ("spin", "d2") if key in target[other]}
            for key in sorted(changed | ({"spin"} if other in self.spun else set())):
                yield f"opposite to {other}.{key}: without it the rod is not twisted but turns along"
        if self.follows_across and not self.has_clocking:
            yield "where loads follow the rod: their directions are those of its frames"
        if self.has_couples and (self.has_clocking or len(self.unclocked) > 1):
            yield "where couples along the rod twist it against another clamp"
        if self.resists and any("tangent" in target[name] for target in self.along):
            yield "that resists a moment about its tangent and turns along the path"

    @property
    def holds_frames(self) -> bool:
        return any(clip.frame is not None for clip in self.clips)

    @property
    def has_clocking(self) -> bool:
        """Whether anything says how the rod is turned about its tangent."""
        clamps = [name for name, kind in self.kinds.items() if kind == "clamp"]
        return self.holds_frames or len(clamps) > len(self.unclocked)

    @property
    def has_couples(self) -> bool:
        return any(isinstance(load, DistributedCouple | PointCouple) for load in self.loads)

    @property
    def follows_across(self) -> bool:
        """Whether a load that follows the rod has a part across it, along d1 or d2."""
        loads: list[Any] = [
            getattr(load, "couple", getattr(load, "force", None)) for load in self.loads if load.follower
        ]
        for name in (name for name, follower in self.followers.items() if follower):
            loads += [load for target in (self.values, *self.along) for load in target[name].values()]
        return any(np.any(np.asarray(load)[:2]) for load in loads)

    @property
    def resists(self) -> bool:
        """Whether a single clamp, and nothing else, keeps loads from turning the rod about its tangent."""
        if len(self.unclocked) != 1 or self.has_clocking:
            return False
        has_moment = any("moment" in self.values[name] for name in self.kinds)
        follows = any(self.followers.values()) or any(load.follower for load in self.loads)
        return has_moment or follows or self.has_couples
