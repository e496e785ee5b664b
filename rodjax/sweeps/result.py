"""The file that a sweep gives: written, merged of shards, and summed up."""

import csv
import dataclasses
import io
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from rodjax.atomic_write import replace_file, seal
from rodjax.checks import file_path
from rodjax.io.scene_keys import unit_of
from rodjax.solving.status import Status
from rodjax.sweeps.cases import SweepError
from rodjax.sweeps.chunk import DESCRIPTIONS, ERRORS, INTEGERS, OF_ROD, RESULTS, Arrays, error_by_rtol
from rodjax.sweeps.manifest import Manifest, differences, manifest_of, opened

PARQUET_SUFFIX = ".parquet"


@dataclasses.dataclass(frozen=True)
class Summary:
    """What a file holds: number of cases, numbers of those that did not converge, largest shape error of the others.

    `missed`: numbers of cases that converged, but not to `rtol`, which is 0 where none was asked for; `overstretched`:
    of those strained by more than `strain_limit`.
    """

    cases: int
    failed: list[int]
    error: float
    rtol: float
    missed: list[int]
    overstretched: list[int]


def merge(shards: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str]) -> Summary:
    """Puts the results of all shards of a sweep together: the same file as without shards.

    Raises `SweepError` where they are of different sweeps, or one is missing or there twice.
    """
    output = file_path(output, "output")
    if output.exists():
        raise SweepError(f"{output} is there already; remove it or write to another file")
    paths = _in_order([file_path(path, "shards") for path in shards])
    manifest = manifest_of(paths[0])._replace(shard="1/1")
    with opened(paths[0]) as file:
        texts = {name: str(file.attrs[name]) for name in ("scene", "over")}
    rows = (arrays(paths[chunk % len(paths)], manifest, chunk, chunk // len(paths)) for chunk in manifest.chunks)
    assemble(output, output.with_name(output.name + ".tmp"), manifest, texts, rows)
    return summary(output)


def _in_order(paths: list[Path]) -> list[Path]:
    """The shards from 1 to n."""
    manifests = {path: manifest_of(path) for path in paths}
    first = manifests[paths[0]]
    count = int(first.shard.split("/")[1])
    by_shard: dict[str, Path] = {}
    for path in paths:
        stored = manifests[path]
        differing = differences(first, stored._replace(shard=first.shard))
        if differing:
            raise SweepError(
                f"{path} does not belong to {paths[0]}: different in {differing}".replace(" now)", " here)")
            )
        if int(stored.shard.split("/")[1]) != count:
            raise SweepError(f"{path} is shard {stored.shard}, but {paths[0]} is shard {first.shard}")
        if stored.shard in by_shard:
            raise SweepError(f"shard {stored.shard} is there twice: {by_shard[stored.shard]} and {path}")
        by_shard[stored.shard] = path
    wanted = [f"{k + 1}/{count}" for k in range(count)]
    missing = [shard for shard in wanted if shard not in by_shard]
    if missing:
        first = ", ".join(missing[:10]) + (", ..." if len(missing) > 10 else "")
        raise SweepError(f"all {count} shards are needed, missing: {first}")
    return [by_shard[shard] for shard in wanted]


def arrays(path: Path, manifest: Manifest, chunk: int, position: int = 0) -> dict[str, np.ndarray]:
    """The datasets of a chunk, by its position in a shard."""
    cases, arrays = manifest.cases_of(chunk), {}
    rows = slice(position * manifest.chunk, position * manifest.chunk + len(cases))

    def add(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset):
            arrays[name] = entry[rows]

    with opened(path) as file:
        file.visititems(add)
    names = manifest.names(("case", "segments", *RESULTS, *ERRORS), OF_ROD)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise SweepError(f"{path} is damaged: it lacks {', '.join(missing)}")
    if not np.array_equal(arrays["case"], cases):
        raise SweepError(f"{path} is damaged: it does not hold the cases {cases[0]} to {cases[-1]}")
    for name, values in arrays.items():
        kind, shape = _kind_and_shape(name, values, manifest)
        if values.dtype.kind != kind or values.shape != (len(cases), *shape):
            raise SweepError(f"{path} is damaged: {name} has {values.dtype} of shape {values.shape[1:]} for each case")
    return arrays


def _kind_and_shape(name: str, values: np.ndarray, manifest: Manifest) -> tuple[str, tuple[int, ...]]:
    """What NumPy calls the numbers of a dataset, and their shape for each case."""
    is_parameter, name = name.startswith("parameters/"), _field(name)
    if is_parameter or name in manifest.quantities:
        return "f", values.shape[1:]
    kind = "b" if name in ("converged", "stable") else "i" if name in INTEGERS else "f"
    if name == "nodes":
        return kind, (manifest.segments + 1, 3)
    return kind, (3,) if name.endswith(("_force", "_moment", "position")) else ()


def _field(name: str) -> str:
    """What a dataset is, of whichever cable or joint."""
    return name.rpartition("/")[2]


def assemble(
    output: Path, temporary: Path, manifest: Manifest, texts: dict[str, str], chunks: Iterable[Arrays]
) -> None:
    """Writes the result chunk by chunk beside its place and then puts it there, in one step."""
    row = 0
    datasets: dict[str, h5py.Dataset] = {}
    try:
        with open(temporary, "wb+") as stream:
            with h5py.File(stream, "w") as file:
                file.attrs.update(texts | manifest.attributes())
                for arrays in chunks:
                    if not datasets:
                        datasets = {name: _dataset(file, name, manifest.rows, arrays[name]) for name in arrays}
                    if {name: values.shape[1:] for name, values in arrays.items()} != {
                        name: dataset.shape[1:] for name, dataset in datasets.items()
                    }:
                        raise SweepError(f"{output} cannot be put together: its parts are damaged, they differ in kind")
                    for name, values in arrays.items():
                        datasets[name][row : row + len(values)] = values
                    row += len(arrays["case"])
            seal(stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, output)
    finally:
        with suppress(OSError):
            temporary.unlink()


def _dataset(file: h5py.File, name: str, rows: int, values: np.ndarray) -> h5py.Dataset:
    dataset = file.create_dataset(name, (rows, *values.shape[1:]), values.dtype)
    if name.startswith("parameters/"):
        unit = unit_of(name.removeprefix("parameters/"))
        dataset.attrs["units"], dataset.attrs["description"] = unit, "value of this key of the scene file"
    else:
        dataset.attrs["units"], dataset.attrs["description"] = DESCRIPTIONS[_field(name)]
    return dataset


def columns(sweep: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """All of a sweep but its `nodes`, by columns of one number a case, the number of the case first. Components of
    vectors go by their numbers, as in the keys of scene files. The names of the columns end with their units.

    `pandas.DataFrame(columns("sweep.h5"))` makes a data frame of it. Raises `SweepError` for what is no sweep.
    """
    found: dict[str, np.ndarray] = {}

    def add(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset) and _field(name) != "nodes":
            unit, values = entry.attrs["units"], entry[()]
            for index in np.ndindex(values.shape[1:]):
                place = "".join(f".{k}" for k in index)
                column = name.removeprefix("parameters/") if name.startswith("parameters/") else name.replace("/", ".")
                found[f"{column}{place} [{unit}]"] = values[(slice(None), *index)]

    with opened(file_path(sweep, "sweep")) as file:
        Manifest.of(file.attrs, Path(sweep))
        file.visititems(add)
    return {"case [1]": found.pop("case [1]")} | found


def write_csv(sweep: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Writes the `columns` of a sweep as comma-separated values, one row a case.

    Raises `SweepError` for what is no sweep, `OSError` where the file cannot be written.
    """
    found = columns(sweep)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(found)
    writer.writerows(zip(*(values.tolist() for values in found.values()), strict=True))
    replace_file(file_path(path, "path", ".csv"), text.getvalue().encode())


def write_parquet(sweep: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Writes the `columns` of a sweep as an Apache Parquet file, for pandas, polars and DuckDB; numbers keep their
    types.

    Raises `ImportError` without pyarrow (`pip install 'rodjax[parquet]'`), `SweepError` for what is no sweep, `OSError`
    where the file cannot be written.
    """
    path = file_path(path, "path", PARQUET_SUFFIX)
    check_parquet()
    import pyarrow
    from pyarrow import parquet

    image = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.table(columns(sweep)), image)
    replace_file(path, image.getvalue().to_pybytes())


def check_parquet() -> None:
    """Raises `ImportError` where Parquet files cannot be written, before a long sweep."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise ImportError("Parquet files need pyarrow: pip install 'rodjax[parquet]'") from None


def summary(path: Path) -> Summary:
    with opened(path) as file:
        case, converged, status = (np.asarray(file[name]) for name in ("case", "converged", "status"))
        errors = {name: np.asarray(file[name]) for name in ERRORS}
        rtol = Manifest.of(file.attrs, path).rtol
    return Summary(
        cases=len(case),
        failed=case[~converged].tolist(),
        error=float(np.max(errors["error_estimate"][converged], initial=0.0)),
        rtol=rtol,
        missed=case[converged & ~(error_by_rtol(errors) <= rtol)].tolist() if rtol else [],
        overstretched=case[status == Status.OVERSTRETCHED].tolist(),
    )
