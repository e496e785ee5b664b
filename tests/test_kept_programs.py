"""Programs kept on disk: found by all that they depend on, harmless where they are damaged or cannot be written."""

import errno
import functools
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import rodjax as rj
from rodjax.programs import blas, kept
from rodjax.programs.compilation import compiled

# Solves, inverts a matrix by LAPACK, and says how many programs were traced and compiled for that and what was found.
SCRIPT = """
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np, rodjax as rj
from rodjax.programs.compilation import compiled as by_program
traced, compiled = [0], [0]
def listen(name, *_, **more):
    compiled[0] += name.endswith("backend_compile_duration")
    traced[0] += name.endswith("jaxpr_trace_duration")
jax.monitoring.register_event_duration_secs_listener(listen)
clamp = rj.Clamp((0, 0, 0), rj.frame(tangent=(1, 0, 0)))
result = rj.solve(rj.Scene(rj.Rod(1.0, 1.0, 1.0, 1e4), clamp, rj.Free(moment=(0.1, 0.2, 0.3))), segments=4)
def inverse(matrix):
    return jax.numpy.linalg.inv(matrix)
inverse.__module__ = "rodjax.example"
found = by_program(inverse)(np.diag([2.0, 4.0]))
print(traced[0], compiled[0], result.nodes.tolist(), found.tolist())
"""


@pytest.fixture
def folder(tmp_path, compiled_at_once):
    """A new folder in which executables are kept, without JAX's cache: what comes from there cannot be."""
    jaxs = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield rj.keep_programs(tmp_path / "programs")
    rj.keep_programs(False)
    jax.config.update("jax_compilation_cache_dir", jaxs)
    compilation_cache.reset_cache()


def program(scale: float = 2.0, name: str = "scaled"):
    """A small program as if it were the library's, new to this process."""

    def scaled(x, options=None):
        return {"scaled": scale * x} if options is None else (x, options)

    scaled.__module__, scaled.__qualname__ = "rodjax.example", name
    return compiled(scaled)


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.program"))


@pytest.mark.parametrize("first", ["on", "off"])
def test_another_process_neither_traces_nor_compiles(tmp_path, first):
    def run() -> tuple[int, int, str]:
        settings = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
        settings |= {"RODJAX_CACHE": str(tmp_path), "RODJAX_NUMPY_FIRST": first}
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=settings, capture_output=True, text=True, check=True, timeout=300
        )
        traces, programs, said = done.stdout.split(" ", 2)
        return int(traces), int(programs), said

    (traces, programs, there), (traced_again, again, here) = run(), run()
    assert traces >= 2
    assert programs >= 2 if first == "off" else programs == 0
    assert again == 0
    # Where an executable calls LAPACK, JAX prepares that by tracing a call of its own.
    assert traced_again == (first == "off")
    assert "[0.5, 0.0]" in there
    assert there == here
    assert {path.suffix for path in tmp_path.iterdir()} == {".program" if first == "off" else ".numpy"}


def test_code_is_kept_and_found_by_its_arguments(folder):
    """First answers come from the code, also in another process, and the executable is made when asked for again."""
    x = np.arange(3.0)
    with rj.numpy_first():
        np.testing.assert_array_equal(program()(x)["scaled"], [0, 2, 4])
        assert [path.suffix for path in folder.iterdir()] == [".numpy"]
        # As if by another version of the source: what is kept under that name is taken.
        other = program(scale=5.0)
        np.testing.assert_array_equal(other(x)["scaled"], [0, 2, 4])
        np.testing.assert_array_equal(other(np.arange(4.0))["scaled"], [0, 5, 10, 15])
    assert len(list(folder.glob("*.numpy"))) == 2
    np.testing.assert_array_equal(other(np.arange(4.0))["scaled"], [0, 5, 10, 15])
    assert len(files(folder)) == 1  # outside of `numpy_first`


def test_a_program_is_found_by_its_arguments(folder):
    x = jnp.arange(3.0)
    np.testing.assert_array_equal(program()(x)["scaled"], [0, 2, 4])
    assert len(files(folder)) == 1
    # As if by another version of the source: what is kept under that name is taken, for NumPy's numbers too.
    for same in (x, np.asarray(x)):
        np.testing.assert_array_equal(program(scale=5.0)(same)["scaled"], [0, 2, 4])
    for other in (jnp.arange(4.0), np.float32([1, 2]), 1.5, 2):
        result = program(scale=5.0)(other)["scaled"]
        np.testing.assert_array_equal(result, 5.0 * np.asarray(other))
    assert len(files(folder)) == 5
    with jax.default_matmul_precision("float32"):
        assert program(scale=5.0)(x)["scaled"][1] == 5.0
    assert len(files(folder)) == 6
    # Of a weak type, as JAX calls numbers of no stated precision.
    assert program(scale=5.0)(jnp.asarray(1.0))["scaled"] == 5.0
    assert program(scale=6.0)(jnp.asarray(1.0, dtype=float))["scaled"] == 6.0
    assert len(files(folder)) == 8
    # Structure and static values count too.
    program()(x, rj.Newton())
    program()(x, rj.NonlinearCG())
    assert len(files(folder)) == 10


def test_another_source_is_another_program(folder, monkeypatch):
    program()(1.0)
    monkeypatch.setattr(kept, "_surroundings", lambda: "another version")
    assert program(scale=5.0)(1.0)["scaled"] == 5.0
    assert len(files(folder)) == 2


class Elsewhere(eqx.Module):
    value: float = 1.0


def test_what_is_defined_elsewhere_is_not_kept(folder):
    """Its source may change, and its name stay the same."""
    program()(1.0, Elsewhere())
    outside = compiled(lambda x: x)
    assert outside(1.0) == 1.0
    # A program of another device.
    x = jax.device_put(jnp.ones(3), jax.devices()[0])
    np.testing.assert_array_equal(program()(x)["scaled"], [2, 2, 2])
    assert not files(folder)


def cut(content: bytes) -> bytes:
    return content[:100]


def changed(content: bytes) -> bytes:
    # Its last byte, whatever it is, into another.
    return content[:-1] + bytes([content[-1] ^ 0xFF])


def emptied(_: bytes) -> bytes:
    return b""


@pytest.mark.parametrize("damage", [cut, changed, emptied])
def test_a_damaged_file_is_written_anew(folder, damage):
    program()(1.0)
    (file,) = files(folder)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert program(scale=3.0)(1.0)["scaled"] == 3.0
    assert program(scale=4.0)(1.0)["scaled"] == 3.0  # what was written anew


def test_a_folder_that_cannot_be_written_to_is_told_of_once(folder, monkeypatch, caplog):
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(kept, "replace_file", full)
    for value in (1.0, np.ones(2)):
        np.testing.assert_array_equal(program()(value)["scaled"], 2 * value)
    assert len(caplog.records) == 1
    assert "No space left on device" in caplog.text
    # A folder that is a file.
    (folder.parent / "file").touch()
    rj.keep_programs(folder.parent / "file")
    assert program()(np.ones(3))["scaled"][0] == 2.0
    assert len(caplog.records) == 2


def test_programs_that_call_blas_are_kept_as_such(folder):
    def inverse(x):
        return jnp.linalg.inv(x)

    inverse.__module__, inverse.__qualname__ = "rodjax.example", "inverse"
    found = []
    for rows in (blas.FEW_ROWS, blas.FEW_ROWS + 1):
        matrix = np.eye(rows) + 1.0
        before = files(folder)
        compiled(inverse)(matrix)
        (file,) = set(files(folder)) - set(before)
        program = kept.load(file.stem, jax.tree.structure(((matrix,), {})))
        np.testing.assert_allclose(program(matrix), np.linalg.inv(matrix), atol=1e-14)
        found.append(isinstance(program, functools.partial))
    assert found == [False, True]


def test_those_used_longest_ago_go(folder, monkeypatch):
    program()(np.ones(1))
    (first,) = files(folder)
    size = first.stat().st_size
    monkeypatch.setattr(kept, "MOST_BYTES", int(4.5 * size))
    for k in range(2, 5):
        program()(np.ones(k))
    for age, file in enumerate(sorted(files(folder), key=lambda file: file != first)):
        os.utime(file, (1e9 - age, 1e9 - age))
    assert len(files(folder)) == 4
    program()(np.ones(1))  # used now
    program()(np.ones(5))
    # Three quarters of what fits are left, the first among them.
    assert len(files(folder)) == 3
    assert first in files(folder)


def test_it_can_be_turned_off(folder):
    assert rj.keep_programs(False) is None
    program()(1.0)
    assert not folder.exists()
    with pytest.raises(TypeError, match=r"where must be True, False or the name of a folder, got 1\.5"):
        rj.keep_programs(1.5)
    with pytest.raises(ValueError, match="where must be the name of a file, without null characters"):
        rj.keep_programs("a\0b")


@pytest.mark.parametrize(("value", "asked"), [("", True), ("on", True), ("Off", False), ("0", False), ("/a/b", "/a/b")])
def test_the_variable_says_where(value, asked):
    assert kept.said(value) == asked


def test_what_jax_had_in_its_own_cache_is_not_kept(folder, tmp_path):
    """XLA would write down a program without its code."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    program()(1.0)
    (file,) = files(folder)
    file.unlink()
    assert program()(1.0)["scaled"] == 2.0
    assert not files(folder)


def test_a_user_without_a_home_keeps_none(monkeypatch):
    monkeypatch.setattr("platformdirs.user_cache_path", lambda *args, **more: Path("~/.cache"))
    assert rj.keep_programs() is None
    rj.keep_programs(False)


class Stiffer(rj.Law):
    """A law of the user's."""

    def __call__(self, curvature, twist, axial_strain, s):
        return jnp.sum(curvature**2) + twist**2 + axial_strain**2


def test_no_program_under_a_law_of_the_users_is_kept():
    def name(scene: object) -> str | None:
        return kept.name_of("rodjax.example", {}, (), jax.tree.structure(scene), ())

    assert name(rj.problems.cable()) is not None
    assert name(Stiffer()) is None
    assert name((rj.problems.cable(), Stiffer())) is None


def test_calls_in_a_trace_stay_parts_of_it(folder):
    inside = program()
    np.testing.assert_array_equal(jax.vmap(inside)(jnp.ones(2))["scaled"], [2, 2])
    assert jax.grad(lambda x: inside(x)["scaled"])(1.0) == 2.0
    assert not files(folder)
