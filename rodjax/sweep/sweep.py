"""Sweeps in chunks, on any number of machines, and their results in one file: see `rodjax.sweep`."""

import dataclasses
import hashlib
import importlib.metadata
import io
import json
import os
import shutil
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from rodjax.atomic_write import has_seal, replace_file, seal
from rodjax.checks import file_path, whole_number
from rodjax.io.files import FIELDS
from rodjax.io.scene_file import SceneFile
from rodjax.io.scene_keys import unit_of
from rodjax.model.scene import Scene, check_without_friction
from rodjax.paths.batch import solve_batch
from rodjax.programs.answers import numpy_first
from rodjax.solving.equilibrium import DEFAULT_RTOL, MAX_SEGMENTS, solve
from rodjax.solving.refinement import ORDERS, SAFETY, SECTION_FACTOR, SIZES
from rodjax.solving.result import (
    Equilibrium,
    MeshWarning,
    NotConvergedWarning,
    OverstretchedWarning,
    estimated_errors,
    positions_at,
)
from rodjax.solving.status import Status
from rodjax.sweep.cases import MAX_CASES, CaseReader, SweepError
from rodjax.version import __version__

SUFFIX = ".h5"
# Of the file and the folder. Raise it where an older rodjax could not go on with what this one writes.
FORMAT = 2
# Cases of a chunk: as many as `solve_batch` takes in one call, for which it needs 200 MB at 50 segments.
DEFAULT_CHUNK = 1024

RESULTS = (
    *("status", "converged", "stable", "iterations", "residual", "energy", "elastic_energy"),
    *("total_twist", "start_force", "start_moment", "end_force", "end_moment", "nodes"),
)
# Estimated errors of the mesh, each relative as in `Equilibrium`.
ERRORS = ("error_estimate", "force_error", "moment_error", "curvature_error")
DESCRIPTIONS = FIELDS | {
    "case": ("1", "number of the case, from 0"),
    "error_estimate": ("1", "of the mesh: largest distance of a node from the continuum, by the length"),
    "force_error": ("1", "of the mesh: largest error of the force, by the largest force in the rod"),
    "moment_error": ("1", "of the mesh: largest error of the moment, by the largest moment in the rod"),
    "curvature_error": ("1", "of the mesh: largest error of the curvature, by the largest curvature"),
    "segments": ("1", "of the mesh on which the case was solved"),
}

INTEGERS = ("case", "status", "iterations", "segments")
# Arclengths that differ by less than this part of the length are the same.
SAME_PLACE = 1e-9

Arrays = Mapping[str, np.ndarray]


# --- what is solved --------------------------------------------------------------------------------------------------


class Manifest(NamedTuple):
    """All that the result depends on. `scene_sha256` and `over_sha256` are of the texts; `shard` is i/n; `rtol` is 0
    where the mesh is given.
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

    @property
    def fingerprint(self) -> str:
        """The same for all shards of a sweep."""
        return _sha256(json.dumps(self._replace(shard="")._asdict(), sort_keys=True))

    @property
    def chunks(self) -> range:
        """Numbers of the chunks of this shard."""
        index, count = map(int, self.shard.split("/"))
        return range(index - 1, -(-self.cases // self.chunk), count)

    def cases_of(self, chunk: int) -> Int[np.ndarray, "k"]:
        return np.arange(chunk * self.chunk, min((chunk + 1) * self.chunk, self.cases))

    @property
    def rows(self) -> int:
        """Number of cases of this shard."""
        return sum(len(self.cases_of(chunk)) for chunk in self.chunks)

    def attributes(self) -> dict[str, Any]:
        return self._asdict() | {"fingerprint": self.fingerprint}

    @classmethod
    def of(cls, attributes: Mapping[str, Any], path: Path) -> "Manifest":
        try:
            manifest = cls(**{name: kind(attributes[name]) for name, kind in cls.__annotations__.items()})
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


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _manifest(reader: CaseReader, shard: tuple[int, int], chunk: int | None) -> Manifest:
    """What is to be solved, but for the mesh."""
    count = reader.cases.count
    return Manifest(
        scene_sha256=_sha256(reader.scene_text),
        over_sha256=_sha256(reader.over_text),
        cases=count,
        # Of a small sweep one chunk, which need not be filled up.
        chunk=min(DEFAULT_CHUNK if chunk is None else chunk, count),
        shard=f"{shard[0]}/{shard[1]}",
        segments=0,
        rtol=0.0 if reader.first.segments is not None else reader.first.rtol or DEFAULT_RTOL,
        discretization="",
        precision=str(jnp.zeros(()).dtype),
        format=FORMAT,
        version=__version__,
        jaxlib=importlib.metadata.version("jaxlib"),
        platform=jax.default_backend(),
    )


def _with_mesh(manifest: Manifest, first: SceneFile) -> Manifest:
    """The mesh of the scene file, or one on which the first case has the error that is asked for."""
    if first.segments is not None:
        return manifest._replace(segments=first.segments, discretization=first.discretization or "hermite")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConvergedWarning)  # as a case of the sweep it is counted
        warnings.simplefilter("ignore", OverstretchedWarning)
        warnings.simplefilter("ignore", MeshWarning)  # each case has its errors
        result = solve(first.scenes[0], rtol=manifest.rtol, discretization=first.discretization)
    return manifest._replace(segments=result.s.shape[-1] - 1, discretization=result.discretization)


# --- the run ---------------------------------------------------------------------------------------------------------


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


def sweep(
    scene: str | os.PathLike[str],
    over: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    shard: tuple[int, int] = (1, 1),
    chunk: int | None = None,
    resume: bool = False,
    progress: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> Summary:
    """Solves a scene file for all cases of a grid or table and writes the results to one HDF5 file.

    This module says what the files are.

    **Arguments:**

    - `scene`: a scene file without `[[path]]`.
    - `over`: `.toml`, a grid, or `.csv`, a table.
    - `output`: the `.h5` file to write; it appears when all is done.
    - `shard`: `(i, n)`: only chunk i of every n, from 1; `merge` puts the n results together.
    - `chunk`: cases solved at a time; `None` for 1024, or as it was where one resumes.
    - `resume`: go on with what an earlier call, which was stopped, left.
    - `progress`: draw a bar on stderr.
    - `say`: gets a line on the mesh and on what was resumed.

    Raises `SweepError` for what the user can mend: before anything is solved, but for a case that makes no sense though
    the extreme ones do; `OSError` where a file cannot be written.
    """
    output = file_path(output, "output")
    try:
        index, count = shard
        whole_number(index, "shard[0]", 1, whole_number(count, "shard[1]", 1, MAX_CASES))
        if chunk is not None:
            whole_number(chunk, "chunk", 1, sys.maxsize)
    except (TypeError, ValueError) as error:
        raise SweepError(str(error)) from None
    reader = CaseReader(file_path(scene, "scene"), file_path(over, "over"))
    try:
        check_without_friction(reader.first.scenes[0], "a sweep")
    except ValueError as error:
        raise SweepError(f"{scene}: {error}") from None
    parts = output.with_name(output.name + ".parts")
    if resume and chunk is None:
        chunk = _earlier_chunk(output, parts)
    manifest = _manifest(reader, shard, chunk)
    if not manifest.chunks:
        raise SweepError(
            f"shard {manifest.shard} would be empty: {_chunks(manifest)}; take fewer shards or a smaller chunk"
        )
    _check_place(output, parts, resume)
    if output.exists():
        _check_same(_manifest_of(output), manifest, output)
        shutil.rmtree(parts, ignore_errors=True)
        say(f"{output} is complete, nothing is left to do")
        return summary(output)
    manifest = _begin(reader, manifest, parts, say)
    with numpy_first(False):  # bits that do not depend on where a sweep was stopped
        _solve_chunks(reader, manifest, parts, progress)
    files = (_arrays(_part(parts, chunk), manifest, chunk) for chunk in manifest.chunks)
    texts = {"scene": reader.scene_text, "over": reader.over_text}
    _assemble(output, parts / "assembled.tmp", manifest, texts, files)
    shutil.rmtree(parts)
    return summary(output)


def _chunks(manifest: Manifest) -> str:
    count = -(-manifest.cases // manifest.chunk)
    return f"{manifest.cases} cases in {count} chunk{'s' if count > 1 else ''} of {manifest.chunk}"


def _check_place(output: Path, parts: Path, resume: bool) -> None:
    if resume:
        return
    if output.exists():
        raise SweepError(f"{output} is there already; remove it or write to another file")
    if parts.exists():
        raise SweepError(f"{parts} holds what a stopped sweep had finished; go on with --resume, or remove the folder")


def _earlier_chunk(output: Path, parts: Path) -> int | None:
    if output.exists():
        return _manifest_of(output).chunk
    if (parts / "manifest.json").exists():
        return _manifest_in(parts).chunk
    return None


def _manifest_in(parts: Path) -> Manifest:
    file = parts / "manifest.json"
    try:
        return Manifest.of(json.loads(file.read_text()), file)
    except (ValueError, RecursionError) as error:
        raise error if isinstance(error, SweepError) else SweepError(f"{file} is not of rodjax sweep") from None


def _manifest_of(result: Path) -> Manifest:
    _is_sealed(result)
    with _opened(result) as file:
        return Manifest.of(file.attrs, result)


def _check_same(stored: Manifest, wanted: Manifest, path: Path) -> None:
    """Of the mesh nothing is known before a solve, and all that it depends on is compared."""
    differing = differences(stored, wanted._replace(segments=stored.segments, discretization=stored.discretization))
    if differing:
        raise SweepError(f"{path} is of another sweep, different in {differing}; give the same, or another -o")


def _begin(reader: CaseReader, manifest: Manifest, parts: Path, say: Callable[[str], None]) -> Manifest:
    """Makes the folder, or takes over the mesh of the one that is there."""
    file = parts / "manifest.json"
    if file.exists():
        stored = _manifest_in(parts)
        _check_same(stored, manifest, parts)
        if stored.fingerprint != json.loads(file.read_text()).get("fingerprint"):
            raise SweepError(f"{file} is damaged; remove {parts} to begin anew")
        done = sum(_is_there(_part(parts, chunk)) for chunk in manifest.chunks)
        say(f"resumed: {done} of {len(manifest.chunks)} chunks are there")
        return stored
    # A mistake found after hours would have to be mended in the grid, which would then be another sweep. To read all
    # cases at once would take minutes.
    reader.scenes(np.array(reader.cases.extremes()))
    manifest = _with_mesh(manifest, reader.first)
    wanted = f", as case 0 needs for rtol = {manifest.rtol:g}; cases that need more get them" if manifest.rtol else ""
    say(f"{_chunks(manifest)}, {manifest.segments} segments ({manifest.discretization}){wanted}")
    # Without a manifest nobody knows what is in a folder.
    if parts.exists():
        shutil.rmtree(parts)
    parts.mkdir()
    replace_file(file, json.dumps(manifest.attributes(), indent=1).encode())
    return manifest


def _bar(manifest: Manifest, chunks: Sequence[int], done: int, progress: bool) -> Iterator[int]:
    """The chunks, with a bar that counts their cases."""
    from tqdm import tqdm

    with tqdm(total=manifest.rows, initial=done, unit=" cases", disable=not progress, file=sys.stderr) as bar:
        for chunk in chunks:
            yield chunk
            bar.update(len(manifest.cases_of(chunk)))


def _part(parts: Path, chunk: int) -> Path:
    return parts / f"chunk-{chunk:06d}{SUFFIX}"


def _is_there(part: Path) -> bool:
    """Whether a finished chunk is there; a damaged one is solved again."""
    try:
        return part.exists() and _is_sealed(part)
    except SweepError:
        return False


def _is_sealed(path: Path) -> bool:
    try:
        with open(path, "rb") as file:
            return has_seal(file)
    except FileNotFoundError:
        raise SweepError(f"{path} is not there") from None
    except ValueError as error:
        raise SweepError(f"{path} is not a readable HDF5 file: {error}") from None


def _solve_chunks(reader: CaseReader, manifest: Manifest, parts: Path, progress: bool) -> None:
    missing = [chunk for chunk in manifest.chunks if not _is_there(_part(parts, chunk))]
    done = manifest.rows - sum(len(manifest.cases_of(chunk)) for chunk in missing)
    for chunk in _bar(manifest, missing, done, progress):
        arrays = _solved(reader, manifest, manifest.cases_of(chunk))
        # Put together in memory, as `rodjax.save` does.
        image = io.BytesIO()
        with h5py.File(image, "w") as file:
            for name, values in arrays.items():
                file.create_dataset(name, data=values)
        seal(image)
        replace_file(_part(parts, chunk), image.getvalue())


def _solved(reader: CaseReader, manifest: Manifest, cases: Int[np.ndarray, "k"]) -> dict[str, np.ndarray]:
    scenes = reader.scenes(cases)
    scenes += scenes[-1:] * (manifest.chunk - len(cases))
    stacked = _stacked(scenes)
    settings: Any = dict(segments=manifest.segments, discretization=manifest.discretization)
    settings |= {"strain_limit": reader.first.strain_limit}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConvergedWarning)  # said in the end, for all together
        warnings.simplefilter("ignore", OverstretchedWarning)
        warnings.simplefilter("ignore", MeshWarning)  # each case has its errors
        result = solve_batch(stacked, **settings)
        arrays = {name: values[: len(cases)] for name, values in _values(result).items()}
        arrays["segments"] = np.full(len(cases), manifest.segments)
        if manifest.rtol:
            arrays = _refined(arrays, stacked, result, manifest, settings)
    parameters = {f"parameters/{key}": values for key, values in reader.cases.of(cases).items()}
    return {"case": cases} | arrays | parameters


def _values(result: Equilibrium) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(result, name)) for name in RESULTS} | _errors(result)


def _errors(result: Equilibrium) -> dict[str, np.ndarray]:
    """All estimated errors at once: each property of a result would compute the estimate anew."""
    errors = estimated_errors(result)
    shape = np.max(np.linalg.norm(errors.nodes, axis=-1), axis=-1)
    sections = (np.asarray(error) for error in (errors.force, errors.moment, errors.curvature))
    return dict(zip(ERRORS, (shape, *sections), strict=True))


def _error_by_rtol(arrays: Arrays) -> Float[np.ndarray, "k"]:
    """What `rtol` is to be kept by, as in `solve`."""
    shape, *sections = (arrays[name] for name in ERRORS)
    return np.maximum(shape, np.max(sections, axis=0) / SECTION_FACTOR)


def _refined(
    arrays: Arrays, scenes: Scene, result: Equilibrium, manifest: Manifest, settings: dict[str, Any]
) -> dict[str, np.ndarray]:
    """With the cases whose estimated error is above `rtol` solved again, on finer meshes, each from the last one."""
    arrays = {name: values.copy() for name, values in arrays.items()}
    segments, rtol, finest = manifest.segments, manifest.rtol, SIZES[manifest.discretization][-1]
    s, cases = np.asarray(result.s), np.arange(len(arrays["segments"]))
    while True:
        error = _error_by_rtol(arrays)[cases]
        which = np.flatnonzero(arrays["converged"][cases] & ~(error <= rtol))
        factor = _growth(error[which], manifest, finest // segments) if len(which) else 1
        if factor < 2:
            return arrays
        segments, cases = factor * segments, cases[which]
        scenes, result = _rows((scenes, result), which)
        settings = settings | {"segments": segments}
        result = solve_batch(scenes, guess=result, **settings)
        found = _values(result) | {"nodes": _nodes_at(result, s[cases]), "segments": np.full(len(cases), segments)}
        # What does not converge on a finer mesh stays as it was, above `rtol`.
        better = np.flatnonzero(found["converged"])
        for name, values in found.items():
            arrays[name][cases[better]] = values[better]
        cases, (scenes, result) = cases[better], _rows((scenes, result), better)


def _rows(stacks: tuple[Scene, Equilibrium], which: Int[np.ndarray, "k"]) -> tuple[Scene, Equilibrium]:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[which], stacks)


def _growth(errors: Float[np.ndarray, "k"], manifest: Manifest, most: int) -> int:
    """How many times as fine the next mesh is, 4, 2, or 1 where none may be."""
    lacking = SAFETY * float(np.max(errors)) / manifest.rtol
    wanted = 4 if lacking > 2 ** ORDERS[manifest.discretization] else 2
    return max(factor for factor in (1, 2, 4) if factor <= min(wanted, most))


def _nodes_at(result: Equilibrium, s: Float[np.ndarray, "k n+1"]) -> Float[np.ndarray, "k n+1 3"]:
    """The centerlines at other arclengths, of each case its own: at nodes, unless clips have moved these."""
    every = (result.s.shape[-1] - 1) // (s.shape[-1] - 1)
    if np.allclose(result.s[:, ::every], s, rtol=0, atol=SAME_PLACE * np.max(s)):
        return np.asarray(result.nodes[:, ::every])
    return np.asarray(jax.vmap(positions_at)(result, jnp.asarray(s)))


def _stacked(scenes: list[Scene]) -> Scene:
    """One scene with a leading axis on every leaf. What many scenes share is one array, which is looked at once."""
    known: dict[int, np.ndarray] = {}

    def stacked(*leaves: jax.Array) -> jax.Array:
        for leaf in leaves:
            if id(leaf) not in known:
                known[id(leaf)] = np.asarray(leaf)
        return jax.device_put(np.stack([known[id(leaf)] for leaf in leaves]))

    return jax.tree.map(stacked, *scenes)


# --- the result ------------------------------------------------------------------------------------------------------


def merge(shards: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str]) -> Summary:
    """Puts the results of all shards of a sweep together: the same file as without shards.

    Raises `SweepError` where they are of different sweeps, or one is missing or there twice.
    """
    output = file_path(output, "output")
    if output.exists():
        raise SweepError(f"{output} is there already; remove it or write to another file")
    paths = _in_order([file_path(path, "shards") for path in shards])
    manifest = _manifest_of(paths[0])._replace(shard="1/1")
    with _opened(paths[0]) as file:
        texts = {name: str(file.attrs[name]) for name in ("scene", "over")}
    rows = (_arrays(paths[chunk % len(paths)], manifest, chunk, chunk // len(paths)) for chunk in manifest.chunks)
    _assemble(output, output.with_name(output.name + ".tmp"), manifest, texts, rows)
    return summary(output)


def _in_order(paths: list[Path]) -> list[Path]:
    """The shards from 1 to n."""
    manifests = {path: _manifest_of(path) for path in paths}
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


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
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


def _arrays(path: Path, manifest: Manifest, chunk: int, position: int = 0) -> dict[str, np.ndarray]:
    """The datasets of a chunk, by its position in a shard."""
    cases, arrays = manifest.cases_of(chunk), {}
    rows = slice(position * manifest.chunk, position * manifest.chunk + len(cases))

    def add(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset):
            arrays[name] = entry[rows]

    with _opened(path) as file:
        file.visititems(add)
    missing = [name for name in ("case", "segments", *RESULTS, *ERRORS) if name not in arrays]
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
    if name.startswith("parameters/"):
        return "f", values.shape[1:]
    kind = "b" if name in ("converged", "stable") else "i" if name in INTEGERS else "f"
    if name == "nodes":
        return kind, (manifest.segments + 1, 3)
    return kind, (3,) if name.endswith(("_force", "_moment")) else ()


def _assemble(
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
        dataset.attrs["units"], dataset.attrs["description"] = DESCRIPTIONS[name]
    return dataset


def summary(path: Path) -> Summary:
    with _opened(path) as file:
        case, converged, status = (np.asarray(file[name]) for name in ("case", "converged", "status"))
        errors = {name: np.asarray(file[name]) for name in ERRORS}
        rtol = Manifest.of(file.attrs, path).rtol
    return Summary(
        cases=len(case),
        failed=case[~converged].tolist(),
        error=float(np.max(errors["error_estimate"][converged], initial=0.0)),
        rtol=rtol,
        missed=case[converged & ~(_error_by_rtol(errors) <= rtol)].tolist() if rtol else [],
        overstretched=case[status == Status.OVERSTRETCHED].tolist(),
    )
