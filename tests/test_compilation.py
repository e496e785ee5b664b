"""Compiled programs: the persistent cache, and as many in memory as a process has room for."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax.programs import answers, compilation, kept, parts
from rodjax.programs.parts import traced_once
from rodjax.programs.stacks import of_each


def test_the_cache_is_filled(tmp_path):
    code = (
        "import sys, rodjax as rj; rj.numpy_first(False); print(rj.enable_compilation_cache(sys.argv[1]));"
        "rj.solve(rj.problems.cantilever(0.1), segments=4)"
    )
    folder = tmp_path / "new" / "folder"
    run = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == str(folder)
    assert any(folder.iterdir())


@pytest.mark.skipif(compilation._most_maps() is None, reason="Linux alone counts the memory maps of a process")
def test_programs_are_dropped_before_the_process_has_too_many_maps(monkeypatch, caplog, compiled_at_once):
    """Without, some hundred meshes crash it: here as many as fit beside those that are there already."""

    def solve(segments: int) -> rj.Equilibrium:
        return rj.solve(rj.problems.cantilever(0.1), segments=segments, discretization="finite_difference")

    compilation._say_once.cache_clear()
    first = solve(5)
    most = compilation._most_maps()
    assert most is not None
    # As if the process might have a program's maps more, and no others.
    room = compilation._maps() + 50
    monkeypatch.setattr(compilation, "SHARE_OF_MAPS", room / most)
    for segments in (6, 7, 8):
        assert solve(segments).converged
        assert compilation._maps() <= room
    assert len([record for record in caplog.records if "drops compiled programs" in record.message]) == 1
    again = solve(5)
    np.testing.assert_array_equal(again.nodes, first.nodes)


def test_programs_are_kept_where_there_is_room(caplog):
    rj.solve(rj.problems.cantilever(0.1), segments=5, discretization="finite_difference")
    assert not caplog.records


def test_the_loops_of_a_huge_program_are_left_as_they_are(monkeypatch, compiled_at_once):
    """The pass that moves numbers out of them is asked not to, for a program of so many operations alone."""
    asked, compile_lowered = [], kept.compile_lowered

    def compile_told(lowered, options):
        asked.append(options.items() >= answers.OF_HUGE.items())
        return compile_lowered(lowered, options)

    monkeypatch.setattr(kept, "compile_lowered", compile_told)
    for operations in (1, 1000):
        monkeypatch.setattr(answers, "HUGE", operations)
        small = compilation.compiled(lambda x: jnp.sin(x) + 1.0)
        np.testing.assert_allclose(small(jnp.asarray(0.5)), np.sin(0.5) + 1.0, rtol=1e-14)
    assert asked == [True, False]


@pytest.mark.exhaustive
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="Linux alone tells the memory of a process so")
def test_five_hundred_meshes_in_one_process():
    """Compiled, some 90 would crash it, at 75 MB each; as NumPy code 400 of them took 612 MB, most of it JAX's own."""
    code = """
import sys, jax; jax.config.update("jax_enable_x64", True)
import rodjax as rj
scene = rj.problems.hanging_cable()
def resident(): return int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20
for segments in range(4, 504):
    assert rj.solve(scene, segments=segments).converged
    if segments == 100: early = resident()
print(resident() - early)
"""
    settings = {**os.environ, "RODJAX_NUMPY_FIRST": "on", "RODJAX_CACHE": "off"}
    run = subprocess.run([sys.executable, "-c", code], env=settings, capture_output=True, text=True, check=True)
    assert float(run.stdout) < 1000


def test_a_part_of_programs_is_traced_once(monkeypatch):
    """Also for derivatives and stacks, whose numbers are those of the function itself."""
    traced = []

    @traced_once
    def part(x, pair):
        traced.append(isinstance(x, jax.core.Tracer))
        return jnp.sin(x) * pair[0] + pair[1]

    x, factor = jnp.linspace(0.0, 1.0, 5), jnp.array(2.0)

    def both(x):
        return part(x, (factor, x)) + part(2 * x, (factor, x))

    expected = 2 * (np.sin(x) + np.sin(2 * np.asarray(x))) + 2 * np.asarray(x)
    np.testing.assert_allclose(both(x), expected, rtol=1e-15)
    assert traced == [False, False]  # as it is
    traced.clear()
    np.testing.assert_allclose(jax.jit(both)(x), expected, rtol=1e-14)
    slopes = jax.jit(jax.vmap(jax.grad(lambda x: jnp.sum(both(x)))))(jnp.stack([x, x + 1]))
    by_hand = 2 * (np.cos(np.stack([x, x + 1])) + 2 * np.cos(2 * np.stack([x, x + 1]))) + 2
    np.testing.assert_allclose(slopes, by_hand, rtol=1e-14)
    assert traced == [True]
    # As many traces as there is room for.
    monkeypatch.setattr(parts, "MOST", 0)
    jax.jit(lambda x: both(x))(jnp.ones(3))
    assert len(traced) == 3


def test_a_solve_and_its_derivative_trace_the_linearisation_once(monkeypatch):
    """JAX differentiates and transposes what it has traced for the search."""
    (part,) = (part for part in parts._parts if part.function.__qualname__ == "MixedForm.linearized")
    traced, linearized = [], part.function
    monkeypatch.setattr(part, "inside", None)
    monkeypatch.setattr(part, "function", lambda *args: traced.append(1) or linearized(*args))
    x = rj.frame(tangent=(1, 0, 0))

    def force(distance):
        ends = rj.Clamp((0, 0, 0), x), rj.Clamp((distance, 0, 0), x)
        return rj.solve(rj.Scene(rj.problems.cable(), *ends, gravity=(0, 0, -9.81)), segments=6).end_force[0]

    slope = jax.grad(force)(0.8)
    assert len(traced) == 1
    # Beside 1e-7 of it that the search leaves in the difference.
    assert abs(slope - (force(0.8 + 1e-4) - force(0.8 - 1e-4)) / 2e-4) < 1e-5 * abs(slope)


def test_a_stack_of_one_is_no_stack():
    """Its branches stay branches; larger ones are those of `vmap`."""

    def function(x: dict[str, jax.Array], power: jax.Array) -> tuple[jax.Array, None]:
        return jax.lax.cond(x["a"][0] > 0, lambda: x["a"] ** power, lambda: x["b"]), None

    three = {"a": jnp.array([[1.0, 2.0], [-1.0, 2.0], [3.0, 1.0]]), "b": jnp.arange(6.0).reshape(3, 2)}
    one = jax.tree.map(lambda x: x[1:2], three)
    for stack, name in ((three, "select_n"), (one, "cond")):
        found, nothing = of_each(function, (0, None))(stack, jnp.array(2.0))
        np.testing.assert_array_equal(found, jax.vmap(function, (0, None))(stack, jnp.array(2.0))[0])
        assert nothing is None
        traced = jax.make_jaxpr(of_each(function, (0, None)))(stack, jnp.array(2.0))
        assert name in {equation.primitive.name for equation in traced.eqns}
