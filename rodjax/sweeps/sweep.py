"""Sweeps in chunks, on any number of cores and machines, and their results in one file: see `rodjax.sweeps`."""

import importlib.metadata
import io
import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np

from rodjax.atomic_write import replace_file, seal
from rodjax.checks import file_path, whole_number
from rodjax.file_lock import LockedError, locked
from rodjax.io.harness_file import HarnessFile
from rodjax.io.scene_file import SceneFile
from rodjax.model.harness import Harness, check_without_friction
from rodjax.notes import bar, told
from rodjax.programs.tasks import TaskError, as_completed, checked_executor, checked_threads
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.options import DEFAULT_RTOL
from rodjax.solving.result_warnings import MeshWarning, NotConvergedWarning, OverstretchedWarning
from rodjax.solving.solve import solve
from rodjax.sweeps.cases import MAX_CASES, CaseReader, SweepError
from rodjax.sweeps.chunk import Arrays, Chunk, solved_chunk
from rodjax.sweeps.manifest import FORMAT, Manifest, differences, is_sealed, manifest_of, sha256
from rodjax.sweeps.quantities import checked_quantities
from rodjax.sweeps.result import Summary, arrays, assemble, summary
from rodjax.version import __version__
from rodjax.warn import silenced

SUFFIX = ".h5"
# Cases of a chunk: as many as `solve_batch` takes in one call, for which it needs 200 MB at 50 segments.
DEFAULT_CHUNK = 1024


# --- what is solved --------------------------------------------------------------------------------------------------


def _manifest(reader: CaseReader, shard: tuple[int, int], chunk: int | None) -> Manifest:
    """What is to be solved, but for the mesh."""
    count, scene = reader.cases.count, reader.first.scenes[0]
    return Manifest(
        scene_sha256=sha256(reader.scene_text),
        over_sha256=sha256(reader.over_text),
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
        cables=json.dumps(_checked_names(scene.names) if isinstance(scene, Harness) else ()),
        joints=json.dumps(_checked_names(scene.joint_names) if isinstance(scene, Harness) else ()),
    )


def _checked_names(names: Sequence[str]) -> Sequence[str]:
    for name in names:
        if "/" in name or name in ("", ".", ".."):
            raise SweepError(f"names of cables and joints must be those of groups of HDF5, without /, got {name!r}")
    return names


def _with_mesh(manifest: Manifest, first: SceneFile | HarnessFile) -> Manifest:
    """The mesh of the scene file, or one on which the first case has the error that is asked for."""
    if first.segments is not None:
        return manifest._replace(segments=first.segments, discretization=first.discretization or "hermite")
    # As a case of the sweep it is counted, and has its errors.
    with silenced(NotConvergedWarning, OverstretchedWarning, MeshWarning):
        result = solve(first.scenes[0], rtol=manifest.rtol, discretization=first.discretization)
    if isinstance(result, HarnessEquilibrium):
        return manifest._replace(segments=max(result.segments), discretization="hermite")
    return manifest._replace(segments=result.s.shape[-1] - 1, discretization=result.discretization)


# --- the run ---------------------------------------------------------------------------------------------------------


def sweep(
    scene: str | os.PathLike[str],
    over: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    shard: tuple[int, int] = (1, 1),
    chunk: int | None = None,
    resume: bool = False,
    also: Sequence[str] = (),
    executor: Executor | None = None,
    threads: int | None = None,
    progress: bool | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Summary:
    """Solves a scene file for all cases of a grid or table and writes the results to one HDF5 file.

    `rodjax.sweeps` says what the files are.

    **Arguments:**

    - `scene`: a scene file without `[[path]]`, or the file of a harness.
    - `over`: `.toml`, a grid, or `.csv`, a table.
    - `output`: the `.h5` file to write; it appears when all is done.
    - `shard`: `(i, n)`: only chunk i of every n, from 1; `rodjax merge` puts the n results together. For array jobs,
        whose machines do not talk to each other.
    - `chunk`: cases solved at a time; `None` for 1024, or as it was where one resumes.
    - `resume`: go on with what an earlier call, which was stopped, left.
    - `also`: names of further quantities to write, such as `["bend_radius", "clip_forces"]`; `rodjax.sweeps` lists
        them.
    - `executor`: what solves the chunks, anything with the interface of `concurrent.futures.Executor`, such as
        `client.get_executor()` of Dask; files are read and written here alone. `None`: threads of this process.
    - `threads`: how many, `None`: the environment variable `RODJAX_THREADS`, or one for each core.
    - `progress`: whether a bar on stderr tells of it; `None`: in a terminal or notebook, after 2 s.
    - `say`: gets a line on the mesh and on what was resumed.

    Raises `SweepError` for invalid input, before anything is solved, unless the extreme cases are valid and another is
    not; where another process writes the same file; and where an executor fails, whose finished chunks are kept.
    `OSError` where a file cannot be written. Whoever solves the chunks, on processors of one type the result is the
    same to the last bit.
    """
    output = file_path(output, "output")
    try:
        index, count = shard
        whole_number(index, "shard[0]", 1, whole_number(count, "shard[1]", 1, MAX_CASES))
        if chunk is not None:
            whole_number(chunk, "chunk", 1, sys.maxsize)
    except (TypeError, ValueError) as error:
        raise SweepError(str(error)) from None
    executor, threads = checked_executor(executor), checked_threads(threads)
    reader = CaseReader(file_path(scene, "scene"), file_path(over, "over"))
    try:
        check_without_friction(reader.first.scenes[0], "a sweep")
    except ValueError as error:
        raise SweepError(f"{scene}: {error}") from None
    parts = output.with_name(output.name + ".parts")
    if resume and chunk is None:
        chunk = _earlier_chunk(output, parts)
    manifest = _manifest(reader, shard, chunk)
    manifest = manifest._replace(also=",".join(checked_quantities(also, reader.first.scenes[0])))
    if not manifest.chunks:
        raise SweepError(
            f"shard {manifest.shard} would be empty: {_chunks(manifest)}; take fewer shards or a smaller chunk"
        )
    try:
        with locked(output), told(progress):
            return _swept(reader, manifest, output, parts, resume, executor, threads, say)
    except LockedError as error:
        raise SweepError(str(error)) from None


def _swept(
    reader: CaseReader,
    manifest: Manifest,
    output: Path,
    parts: Path,
    resume: bool,
    executor: Executor | None,
    threads: int,
    say: Callable[[str], None],
) -> Summary:
    _check_place(output, parts, resume)
    if output.exists():
        _check_same(manifest_of(output), manifest, output)
        shutil.rmtree(parts, ignore_errors=True)
        say(f"{output} is complete, nothing is left to do")
        return summary(output)
    manifest = _begin(reader, manifest, parts, say)
    missing = [chunk for chunk in manifest.chunks if not _is_there(_part(parts, chunk))]
    tasks = ((_chunk(reader, manifest, chunk),) for chunk in missing)
    done = manifest.rows - sum(len(manifest.cases_of(chunk)) for chunk in missing)
    with bar(manifest.rows, "cases", done) as drawn:
        try:
            workers = {"executor": executor, "threads": threads, "count": len(missing)}
            for k, solved in as_completed(solved_chunk, tasks, **workers):
                _write(_part(parts, missing[k]), solved)
                drawn.update(len(solved["case"]))
        except TaskError as error:
            raise SweepError(f"{error}; the finished chunks are in {parts}: go on with --resume") from error
    files = (arrays(_part(parts, chunk), manifest, chunk) for chunk in manifest.chunks)
    texts = {"scene": reader.scene_text, "over": reader.over_text}
    assemble(output, parts / "assembled.tmp", manifest, texts, files)
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
        return manifest_of(output).chunk
    if (parts / "manifest.json").exists():
        return _manifest_in(parts).chunk
    return None


def _manifest_in(parts: Path) -> Manifest:
    file = parts / "manifest.json"
    try:
        return Manifest.of(json.loads(file.read_text()), file)
    except (ValueError, RecursionError) as error:
        raise error if isinstance(error, SweepError) else SweepError(f"{file} is not of rodjax sweep") from None


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


def _part(parts: Path, chunk: int) -> Path:
    return parts / f"chunk-{chunk:06d}{SUFFIX}"


def _is_there(part: Path) -> bool:
    """Whether a finished chunk is there; a damaged one is solved again."""
    try:
        return part.exists() and is_sealed(part)
    except SweepError:
        return False


def _chunk(reader: CaseReader, manifest: Manifest, chunk: int) -> Chunk:
    cases = manifest.cases_of(chunk)
    return Chunk(reader.of_cases, manifest, reader.first.strain_limit, cases, reader.cases.of(cases))


def _write(part: Path, datasets: Arrays) -> None:
    # Put together in memory, as `rodjax.save` does.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        for name, values in datasets.items():
            file.create_dataset(name, data=values)
    seal(image)
    replace_file(part, image.getvalue())
