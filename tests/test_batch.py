"""Batches: as each scene by itself, whatever the others do, on one device or several."""

import math
import os
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import Clamp, Scene, frame, problems, rotate, solve_batch, solve_path
from rodjax.paths import batch

OPTIONS = {"segments": 8, "discretization": "finite_difference"}
COUNT = 40


def random_scenes(count: int = COUNT, seed: int = 0) -> list[Scene]:
    """Cables between clamps that are turned by about a radian."""
    rng = np.random.default_rng(seed)
    rod = problems.cable()

    def clamp(position):
        return Clamp(position, rotate(frame((1, 0, 0)), rng.normal(size=3)))

    middle = np.array([0.7, 0.0, 0.0])
    ends = [(clamp((0, 0, 0)), clamp(middle + rng.uniform(-0.1, 0.1, 3))) for _ in range(count)]
    return [Scene(rod, *pair, gravity=(0, 0, -9.81)) for pair in ends]


def stack(results):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *results)


def assert_same(result, expected, rtol=1e-12):
    """The same to rounding of numbers up to EI/L^2 = 5e-3 N and 1 m, and counters alike."""
    for ours, theirs in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        if jnp.issubdtype(ours.dtype, jnp.floating):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=rtol * max(1.0, float(np.max(np.abs(theirs)))))
        else:
            np.testing.assert_array_equal(ours, theirs)


def test_each_scene_is_solved_as_by_itself():
    scenes = random_scenes()
    assert len(scenes) > 2 * batch.LANES  # lanes are handed over
    result = solve_batch(scenes, **OPTIONS)
    alone = stack([rj.solve(scene, **OPTIONS) for scene in scenes])
    assert np.all(result.converged)
    assert len(np.unique(alone.iterations)) > 1
    # Rounding differs between the programs; curvatures at the fourth digit of L sum some hundred of them.
    np.testing.assert_array_equal(result.iterations, alone.iterations)
    for name in ("nodes", "frames", "end_force", "end_moment", "total_twist", "energy", "tension"):
        np.testing.assert_allclose(getattr(result, name), getattr(alone, name), rtol=0, atol=1e-11, err_msg=name)


def test_a_scene_that_does_not_converge_leaves_the_others_alone():
    scenes = random_scenes()
    few = rj.Newton(max_iterations=7)
    with pytest.warns(rj.NotConvergedWarning, match="largest number of iterations"):
        result = solve_batch(scenes, solver=few, **OPTIONS)
    full = solve_batch(scenes, **OPTIONS)
    easy = np.asarray(full.iterations) < 7
    assert 0 < np.sum(easy) < COUNT
    np.testing.assert_array_equal(np.asarray(result.converged)[easy], True)
    np.testing.assert_array_equal(np.asarray(result.status)[np.asarray(full.iterations) > 7], rj.Status.MAX_ITERATIONS)
    np.testing.assert_array_equal(np.asarray(result.nodes)[easy], np.asarray(full.nodes)[easy])


def test_guesses():
    scenes = random_scenes()
    first = solve_batch(scenes, **OPTIONS)
    again = solve_batch(scenes, guess=first, **OPTIONS)
    np.testing.assert_array_equal(again.iterations, 0)
    np.testing.assert_array_equal(again.nodes, first.nodes)
    from_one = solve_batch(scenes[:3], guess=jax.tree.map(lambda leaf: leaf[0], first), **OPTIONS)
    assert int(from_one.iterations[0]) == 0
    with pytest.raises(ValueError, match="one for each scene"):
        solve_batch(scenes[:3], guess=first, **OPTIONS)


def test_chunks_do_not_show(monkeypatch):
    scenes = random_scenes()
    whole = solve_batch(scenes, **OPTIONS)
    monkeypatch.setattr(batch, "CHUNKS", ((16, math.inf),))
    parts = solve_batch(scenes, progress=True, threads=1, **OPTIONS)
    assert_same(parts, whole)  # other programs, and so other roundings
    names = set()
    solve_many = batch._solve_many

    def watched(*arguments):
        names.add(threading.current_thread().name)
        time.sleep(0.05)  # so that no thread does all
        return solve_many(*arguments)

    monkeypatch.setattr(batch, "_solve_many", watched)
    for count in (2, 4):
        names.clear()
        shared = solve_batch(scenes, threads=count, **OPTIONS)
        assert 1 < len(names) <= count
        for ours, theirs in zip(jax.tree.leaves(shared), jax.tree.leaves(parts), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_threads_share_the_few_that_go_one_after_another(monkeypatch):
    scenes, by_cg = random_scenes(10), {**OPTIONS, "solver": rj.NonlinearCG()}
    with rj.numpy_first(False):
        alone = solve_batch(scenes, threads=1, **by_cg)
    names, solve_many = set(), batch._solve_many

    def watched(*arguments):
        names.add(threading.current_thread().name)
        time.sleep(0.05)  # so that no thread does all
        return solve_many(*arguments)

    monkeypatch.setattr(batch, "_solve_many", watched)
    shared = solve_batch(scenes, threads=2, **by_cg)
    assert len(names) == 2
    for ours, theirs in zip(jax.tree.leaves(shared), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_side_by_side_as_on_an_accelerator(monkeypatch):
    """All rods of a chunk at once; those that go one after another on a processor."""
    on = []

    def is_on_processor(mesh=None):
        on.append(jax.config.jax_default_device is not None)
        return on[-1]

    scenes = random_scenes(20)
    monkeypatch.setattr(batch, "CHUNKS", ((16, math.inf),))
    expected = solve_batch(scenes, **OPTIONS)
    with rj.numpy_first(False):
        by_cg = solve_batch(scenes, solver=rj.NonlinearCG(), **OPTIONS)
    monkeypatch.setattr(batch, "is_on_processor", is_on_processor)
    monkeypatch.setattr(batch, "ACCELERATOR_CHUNKS", ((16, math.inf),))
    at_once, in_turn = [], batch.as_completed

    def as_completed(solved, parts, threads, **options):
        at_once.append(threads)
        return in_turn(solved, parts, threads=threads, **options)

    monkeypatch.setattr(batch, "as_completed", as_completed)
    for threads in (1, 4):
        assert_same(solve_batch(scenes, threads=threads, **OPTIONS), expected)
    # Two chunks under way at most: it has no room for more.
    assert at_once == [1, 2]
    assert not any(on)
    assert_same(solve_batch(scenes, threads=2, solver=rj.NonlinearCG(), **OPTIONS), by_cg)
    assert any(on)


def test_harnesses_go_to_the_processor_where_there_is_an_accelerator(monkeypatch):
    scene, cut = random_scenes(1)[0], rj.Joint("cut", np.eye(3))
    harness = rj.Harness({"a": Scene(scene.rod, scene.start, cut), "b": Scene(scene.rod, cut, scene.end)})
    monkeypatch.setattr(batch, "harness_batch", lambda harnesses, **_: jax.config.jax_default_device)
    assert batch.solve_batch([harness]) is None
    monkeypatch.setattr(batch, "is_on_processor", lambda mesh=None: False)
    assert batch.solve_batch([harness]).platform == "cpu"


def test_what_fills_up_a_chunk_is_not_solved():
    scenes = batch._stacked(random_scenes(5))

    def solve(scene, guess):
        return {"end": scene.end.position + guess, "length": scene.rod.length}

    found = jax.jit(lambda count: batch._in_turn(solve, scenes, 1.0, count))(3)
    np.testing.assert_array_equal(found["end"][:3], scenes.end.position[:3] + 1.0)
    np.testing.assert_array_equal(found["length"], [1.0, 1.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize(("count", "size"), [(1, 16), (17, 128), (129, 256), (1024, 256), (4097, 1024)])
def test_how_many_scenes_go_in_one_call(count, size):
    assert batch.chunk_size(count) == size


@pytest.mark.slow
def test_one_mesh_for_a_tolerance():
    result = solve_batch(random_scenes(5), rtol=1e-3)
    assert np.all(result.error_estimate <= 1e-3)
    assert result.discretization == "hermite"


@pytest.mark.slow
def test_paths():
    rod = problems.cable()

    def path(turn):
        ends = [Clamp((0.7, 0, 0), rotate(frame((1, 0, 0)), (part * turn, 0.1, 0.2))) for part in (0.0, 0.5, 1.0)]
        return [Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), end) for end in ends]

    paths = [path(1.0), path(-2.0), path(3.0)]
    result = solve_batch(paths, **OPTIONS)
    assert result.nodes.shape == (3, 3, 9, 3)
    alone = stack([solve_path(path, **OPTIONS) for path in paths])
    np.testing.assert_allclose(result.nodes, alone.nodes, rtol=0, atol=1e-11)
    np.testing.assert_allclose(result.total_twist, alone.total_twist, rtol=0, atol=1e-11)
    with pytest.raises(ValueError, match="one length"):
        solve_batch([paths[0], paths[1][:2]], **OPTIONS)


@pytest.mark.slow
def test_derivatives_and_transformations():
    rod = problems.cable()
    loads = jnp.array([1.0, 2.0, 4.0])

    def scene(load):
        force = load * rod.EI * jnp.array([0.0, 0.0, -1.0])
        return Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), rj.Free(force=force))

    def tips(loads):
        return solve_batch(jax.vmap(scene)(loads), **OPTIONS).nodes[:, -1, 2]

    def tip(load):
        return rj.solve(scene(load), **OPTIONS).nodes[-1, 2]

    by_batch = jax.grad(lambda loads: jnp.sum(tips(loads)))(loads)
    one_by_one = jax.vmap(jax.grad(tip))(loads)
    compiled = jax.jit(jax.jacobian(tips))(loads)
    np.testing.assert_allclose(by_batch, one_by_one, rtol=1e-12)  # rounding
    np.testing.assert_allclose(compiled, np.diag(one_by_one), rtol=0, atol=1e-12)


ON_DEVICES = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
processes, number = int(sys.argv[2]), int(sys.argv[3])
if processes > 1:
    jax.distributed.initialize(f"127.0.0.1:{sys.argv[4]}", processes, number)
import numpy as np
from test_batch import OPTIONS, assert_same, random_scenes
import rodjax as rj
from rodjax.paths import batch
from rodjax.paths.path import stack_scenes
rj.enable_compilation_cache()
mesh = jax.make_mesh((jax.device_count(),), ("scenes",), axis_types=(jax.sharding.AxisType.Auto,))
scenes = random_scenes()
assert jax.device_count() > 1 and len(scenes) % jax.device_count() == 0
shared = rj.solve_batch(scenes, mesh=mesh, **OPTIONS)
assert len(shared.s.sharding.device_set) == jax.device_count() or processes == 1
alone = rj.solve_batch(scenes, **OPTIONS)
for ours, theirs in zip(jax.tree.leaves(shared), jax.tree.leaves(alone), strict=True):
    for piece in ours.addressable_shards:
        assert_same(piece.data, np.asarray(theirs)[piece.index])
if processes == 1:
    odd = rj.solve_batch(scenes[:-3], mesh=mesh, **OPTIONS)
    assert_same(odd.nodes, alone.nodes[:-3])
    stacked = stack_scenes(scenes)
    nodes = jax.jit(lambda scenes: rj.solve_batch(scenes, mesh=mesh, **OPTIONS).nodes)
    assert_same(nodes(stacked), alone.nodes)
    try:
        nodes(jax.tree.map(lambda leaf: leaf[:-3], stacked))
    except ValueError as error:
        assert "scenes must be a multiple of the 4 devices of mesh" in str(error)
    else:
        raise AssertionError("scenes that the devices cannot share were taken")
    options = batch.checked_options(scenes[0], 8, None, "finite_difference", None, None, False)[0]
    counts = np.full(jax.device_count(), len(scenes) // jax.device_count())
    program = jax.jit(batch._solve_many, static_argnames=("options", "mesh", "lanes"))
    lowered = program.lower(stacked, None, counts, 0.05, options=options, mesh=mesh, lanes=8)
    text = lowered.compile().as_text()
    assert "while(" in text
    for collective in ("all-reduce", "all-gather", "all-to-all", "collective-permute"):
        assert collective + "(" not in text, collective
print("passed", number)
"""


def run(*arguments: str, devices: int) -> subprocess.Popen:
    flags = os.environ.get("XLA_FLAGS", "") + f" --xla_force_host_platform_device_count={devices}"
    command = [sys.executable, "-c", ON_DEVICES, os.path.dirname(__file__), *arguments]
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_four_devices():
    process = run("1", "0", devices=4)
    output, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    assert "passed" in output


@pytest.mark.slow
def test_two_processes():
    import socket

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    processes = [run("2", str(number), port, devices=1) for number in range(2)]
    for process in processes:
        output, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors
        assert "passed" in output


def test_arguments():
    scenes = random_scenes(2)
    with pytest.raises(TypeError, match="mesh must be a Mesh"):
        solve_batch(scenes, mesh="all", **OPTIONS)
    with pytest.raises(ValueError, match="threads must be a whole number from 1 to 4096, got 0"):
        solve_batch(scenes, threads=0, **OPTIONS)
    with pytest.raises(ValueError, match="at least one scene"):
        solve_batch([], **OPTIONS)
    with pytest.raises(ValueError, match="single scene"):
        solve_batch(scenes[0], **OPTIONS)
