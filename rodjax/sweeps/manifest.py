"""What a sweep solves, and what its files say of it: see `rodjax.sweeps`."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from jaxtyping import Int

from rodjax.atomic_write import has_seal
from rodjax.solving.options import MAX_SEGMENTS
from rodjax.sweeps.cases import MAX_CASES, SweepError

# Of the file and the folder. Raise it where an older rodjax could not go on with what this one writes.
FORMAT = 4
# What the names of the datasets of a cable begin with.
OF_CABLE = "cables/{}/"


class Manifest(NamedTuple):
    """All that the result depends on. `scene_sha256` and `over_sha256` are of the texts; `shard` is i/n; `rtol` is 0
    where the mesh is given; `also`: names of further quantities, with commas; `cables`, `joints`: names of those of a
    harness, as JSON.
    """

    scene_sha256: str
    over_sha256: str
    cases: int
    chunk: int
    shard: str
    segments: int
    rtol: float
    discretization: str
    precision: str
    format: int
    version: str
    jaxlib: str
    platform: str
    also: str = ""
    cables: str = "[]"
    joints: str = "[]"

    @property
    def fingerprint(self) -> str:
        """The same for all shards of a sweep."""
        return sha256(json.dumps(self._replace(shard="")._asdict(), sort_keys=True))

    @property
    def chunks(self) -> range:
        """Numbers of the chunks of this shard."""
        index, count = map(int, self.shard.split("/"))
        return range(index - 1, -(-self.cases // self.chunk), count)

    def cases_of(self, chunk: int) -> Int[np.ndarray, "k"]:
        return np.arange(chunk * self.chunk, min((chunk + 1) * self.chunk, self.cases))

    @property
    def quantities(self) -> list[str]:
        """Names of those that are written beside the results of every sweep."""
        return [name for name in self.also.split(",") if name]

    @property
    def prefixes(self) -> list[str]:
        """What the names of the datasets of each rod begin with."""
        return [OF_CABLE.format(name) for name in json.loads(self.cables)] or [""]

    def names(self, of_whole: Sequence[str], of_rod: Sequence[str]) -> list[str]:
        """Of the datasets of the whole and of each rod."""
        of_joints = [f"joints/{name}/position" for name in json.loads(self.joints)]
        of_rods = [f"{prefix}{name}" for prefix in self.prefixes for name in (*of_rod, *self.quantities)]
        return [*of_whole, *of_rods, *of_joints]

    @property
    def rows(self) -> int:
        """Number of cases of this shard."""
        return sum(len(self.cases_of(chunk)) for chunk in self.chunks)

    def attributes(self) -> dict[str, Any]:
        return self._asdict() | {"fingerprint": self.fingerprint}

    @classmethod
    def of(cls, attributes: Mapping[str, Any], path: Path) -> "Manifest":
        try:
            known = cls._field_defaults | dict(attributes)
            manifest = cls(**{name: kind(known[name]) for name, kind in cls.__annotations__.items()})
            index, count = map(int, manifest.shard.split("/"))
        except (KeyError, TypeError, ValueError):
            raise SweepError(f"{path} is not of rodjax sweep, or of another version of it") from None
        is_sweep = min(manifest.chunk, manifest.cases) > 0 and manifest.cases <= MAX_CASES and 1 <= index <= count
        if not is_sweep or not manifest.chunks or not 2 <= manifest.segments <= MAX_SEGMENTS:
            raise SweepError(f"{path} is damaged: no sweep is like what it says")
        return manifest


NAMES = {
    "scene_sha256": "the scene file",
    "over_sha256": "the grid or table",
    "version": "the version of rodjax",
    "jaxlib": "the version of jaxlib",
}


def differences(stored: Manifest, wanted: Manifest) -> str:
    """What differs, in words; empty where nothing does."""
    pairs = zip(stored._asdict().items(), wanted, strict=True)
    return ", ".join(
        NAMES[name] if name.endswith("sha256") else f"{NAMES.get(name, name)} ({old}, not {new})"
        for (name, old), new in pairs
        if old != new
    )


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def manifest_of(result: Path) -> Manifest:
    is_sealed(result)
    with opened(result) as file:
        return Manifest.of(file.attrs, result)


def is_sealed(path: Path) -> bool:
    try:
        with open(path, "rb") as file:
            return has_seal(file)
    except FileNotFoundError:
        raise SweepError(f"{path} is not there") from None
    except ValueError as error:
        raise SweepError(f"{path} is not a readable HDF5 file: {error}") from None


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to read; makes errors in words of those of a file that is none, or is damaged."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except FileNotFoundError:
        raise SweepError(f"{path} is not there") from None
    except SweepError:
        raise
    except (OSError, KeyError, RuntimeError, TypeError, ValueError, OverflowError) as error:
        raise SweepError(f"{path} is not a readable HDF5 file: {error}") from None
