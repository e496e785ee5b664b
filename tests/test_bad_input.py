"""Bad input, by hypothesis: one clear message before anything is compiled, no traceback, and nothing lost.

A property takes an example and the `World`, and returns where a bad input was refused as it should be. All are tried a
few times, in the slow run more than 5000 times together. The examples are the same in every run.
"""

import contextlib
import copy
import io
import json
import os
import re
import resource
import shutil
import string
import subprocess
import sys
import tempfile
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import h5py
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, reject, settings
from hypothesis.configuration import set_hypothesis_home_dir
from hypothesis.extra import numpy as hnp

import rodjax as rj
from rodjax.cli import main
from rodjax.io.files import load, save
from rodjax.io.quantities import QUANTITIES
from rodjax.io.scene_file import read_scene_file
from rodjax.io.scene_writing import write_scene
from rodjax.sweeps.chunk import ERRORS
from rodjax.sweeps.sweep import sweep

# What hypothesis keeps for itself goes beside other temporary files, not into the tree.
set_hypothesis_home_dir(os.path.join(tempfile.gettempdir(), "rodjax-hypothesis"))

SHORT, LONG = 24, 200
# So many of those that fill a disk, a sixth of a second each, in the place of the long run's.
DEAR = {"full_disks": 40, "full_disks_of_a_solve": 40, "full_disks_of_a_merge": 40, "full_disks_of_a_sweep": 40}
PROPERTIES: dict[str, tuple[st.SearchStrategy, Callable]] = {}


def bad_input(strategy: st.SearchStrategy) -> Callable:
    """Makes a property of a function of an example and the `World`."""

    def register(check: Callable) -> Callable:
        PROPERTIES[check.__name__] = strategy, check
        return check

    return register


class Accepted(BaseException):
    """Raised in the place of a solve."""


class Samples(NamedTuple):
    """Results to save, load and sweep, of made-up numbers: here nothing may be solved."""

    single: rj.Equilibrium
    path: rj.Equilibrium
    sweeps: Path  # a folder with a whole sweep, its two shards, and the parts of one that was stopped


class World:
    """An empty folder, the command, and a library that cannot solve."""

    def __init__(self, folder: Path, samples: Samples, capsys: pytest.CaptureFixture[str]):
        self.samples, self._folder, self._capsys = samples, folder, capsys

    def run(self, *arguments: Any) -> tuple[int, str]:
        """Exit code and stderr of the command."""
        self._capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        return code, self._capsys.readouterr().err

    def refused(self, *arguments: Any) -> str:
        """The one line with which the command refuses."""
        code, err = self.run(*arguments)
        assert code == 2
        assert re.fullmatch(r"rodjax: [^\n]+\n", err)
        assert len(err) < 1500
        return err

    def empty_folder(self) -> Path:
        os.chdir(self._folder)
        shutil.rmtree("folder", ignore_errors=True)
        os.mkdir("folder")
        os.chdir("folder")
        return self._folder / "folder"


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> Samples:
    scene = rj.Scene(rj.Rod(1.0, 1.0, 1.0, 1e3, 0.1, 0.01), *CLAMPS, (0, 0, -1), [rj.PointForce(0.5, (0, 0, 1))], 0)

    def numbers(leaf: Any) -> jax.Array:
        size = max(leaf.size, 2)
        return jax.device_put(np.linspace(0, 1, size)[: leaf.size].reshape(leaf.shape).astype(leaf.dtype))

    single = jax.eval_shape(lambda scene: rj.solve(scene, segments=4), scene)
    path = jax.eval_shape(lambda scene: rj.solve_path([scene] * 3, segments=4), scene)

    folder = tmp_path_factory.mktemp("sweeps")
    scene_file, grid = folder / "scene.toml", folder / "grid.toml"
    scene_file.write_text(document(DOCUMENTS[1]))
    grid.write_text(GRID)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rodjax.sweeps.chunk.solve_batch", made_up_batch)
        patch.setattr("rodjax.sweeps.chunk._errors", made_up_errors)
        for name, shard in (("whole", (1, 1)), ("1", (1, 2)), ("2", (2, 2))):
            sweep(scene_file, grid, folder / f"{name}.h5", shard=shard, chunk=2)
        patch.setattr("rodjax.sweeps.sweep.assemble", lambda *_: sys.exit())
        with pytest.raises(SystemExit):
            sweep(scene_file, grid, folder / "out.h5", chunk=2)
    return Samples(jax.tree.map(numbers, single), jax.tree.map(numbers, path), folder)


def made_up_batch(scenes: rj.Scene, segments: int, **_: Any) -> Any:
    """Numbers in the place of solutions, for each case its own."""
    count = len(scenes.rod.EI)
    numbers = np.asarray(scenes.rod.EI)[:, None] + np.arange(3.0)
    names = ("residual", "energy", "elastic_energy", "total_twist")
    vectors = ("start_force", "start_moment", "end_force", "end_moment")
    flags = ("converged", "stable")
    return types.SimpleNamespace(
        **dict.fromkeys(names, numbers[:, 0]),
        **dict.fromkeys(vectors, numbers),
        **{name: np.ones(count, bool) for name in flags},
        **{name: np.ones(count, int) for name in ("status", "iterations")},
        nodes=np.tile(numbers[:, None], (1, segments + 1, 1)),
    )


def made_up_errors(result: Any) -> dict[str, np.ndarray]:
    return dict.fromkeys(ERRORS, result.energy)


@pytest.fixture
def world(tmp_path, samples, capsys, monkeypatch) -> World:
    def solved(*_, **options):
        raise Accepted

    modules = {
        "solving.equilibrium": ("_solve",),
        "solving.first_state": ("_first_state",),
        "paths.path": ("_solve_path",),
        "paths.batch": ("_solve_many",),
    }
    for module, names in modules.items():
        for name in names:
            monkeypatch.setattr(f"rodjax.{module}.{name}", solved)
    monkeypatch.setattr("rodjax.sweeps.chunk.solve_batch", solved)
    monkeypatch.setattr(rj, "fit", solved)
    monkeypatch.setattr("rodjax.cli._set_up_jax", lambda: None)
    monkeypatch.chdir(tmp_path)
    return World(tmp_path, samples, capsys)


def assert_refused(call: Callable[[], Any], *named: str) -> None:
    """A `ValueError` or `TypeError` of the library's own, which says what is allowed and what was given."""
    with pytest.raises((ValueError, TypeError)) as caught:
        call()
    assert type(caught.value) in (ValueError, TypeError)
    message = str(caught.value)
    assert all(name in message for name in named)
    assert re.search(r"\bmust\b|\bneed|\bthe ends are|\bcan turn freely|\bhold no", message)
    assert re.search(" got | where |: |, but ", message)
    assert "\n" not in message
    assert len(message) < 700


# --- arguments of the Python API -------------------------------------------------------------------------------------

LEVEL = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
CLAMPS = rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((0.8, 0, 0), LEVEL)
ROD = rj.Rod(1.0, 1.0, 1.0, 1e3)
SCENE = rj.Scene(ROD, *CLAMPS, gravity=(0, 0, -1))

ODDITIES = [None, ..., rj.Rod, print, SCENE, b"1", 1j, True, np.bool_(True), {}, set(), [], "", "1.0"]
ODDITIES += [10**400, -(10**400), [10**400] * 3, [[1.0, 2.0], [3.0]], [None] * 3, ["a", "b", "c"]]
ODDITIES += [np.array("a"), np.array([True, False, True]), np.datetime64("2026-01-01"), np.array([1j, 0, 0])]
ANYTHING = st.one_of(
    st.sampled_from(ODDITIES),
    st.text(max_size=9),
    st.binary(max_size=9),
    st.complex_numbers(),
    st.lists(st.text(max_size=3), min_size=1, max_size=4),
    st.dictionaries(st.text(max_size=3), st.floats(), min_size=1, max_size=3),
    st.builds(object),
    st.integers(4300, 5000).map(lambda digits: 10**digits),  # more than Python shows
)
AS = st.sampled_from([np.asarray, jax.device_put, np.ndarray.tolist, lambda array: array.astype(np.float32)])


def optional(strategy: st.SearchStrategy) -> st.SearchStrategy:
    return strategy.filter(lambda value: value is not None)


@st.composite
def wrong_shape(draw, shape: tuple[int, ...]):
    shapes = hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4).filter(lambda other: other != shape)
    return draw(AS)(np.full(draw(shapes), 0.5))


@st.composite
def not_finite(draw, shape: tuple[int, ...]):
    array = np.full(shape, 0.5)
    array.flat[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    return draw(AS)(array)


def numbers(shape: tuple[int, ...] = (), *others: st.SearchStrategy) -> st.SearchStrategy:
    """What is no number, or array of numbers, of this shape; and others that are not allowed."""
    return st.one_of(ANYTHING, wrong_shape(shape), not_finite(shape), *others)


def beyond(least: float, most: float) -> st.SearchStrategy:
    """Numbers that do not lie between."""
    return st.floats(max_value=least) | st.floats(min_value=most)


def whole(least: int, most: int) -> st.SearchStrategy:
    integers = st.integers(max_value=least - 1) | st.integers(min_value=most + 1)
    return st.one_of(ANYTHING, st.floats(), integers, wrong_shape(()))


def other_than(*allowed: str) -> st.SearchStrategy:
    return (ANYTHING | st.integers()).filter(lambda value: not (isinstance(value, str) and value in allowed))


def is_far_from_rotation(matrix: np.ndarray) -> bool:
    return np.max(np.abs(matrix.T @ matrix - np.eye(3))) > 1e-4 or np.linalg.det(matrix) < 0


POSITIVE = numbers((), st.floats(max_value=0), st.integers(max_value=0))
NOT_NEGATIVE = numbers((), st.floats(max_value=-1e-300))
VECTOR, DIRECTION = numbers((3,)), numbers((3,), st.just((0, 0, 0)))
MATRICES = hnp.arrays(float, (3, 3), elements=st.floats(-2, 2)).filter(is_far_from_rotation)
ROTATION = numbers((3, 3), MATRICES, st.just(np.diag([1.0, 1, -1])), st.just(np.full((3, 3), 1e200)))
SCALAR = numbers()


def is_points(value: Any) -> bool:
    if not isinstance(value, list | np.ndarray | jax.Array):
        return False
    shape = np.shape(np.array(value, object))
    return len(shape) == 2 and shape[0] > 1 and shape[1] == 3


# Functions, good arguments, and bad ones to take the place of one of them.
SECTION = dict(length=1.0, youngs_modulus=1e7, shear_modulus=3e6, density=1e3)
MODULI = dict(length=POSITIVE, youngs_modulus=POSITIVE, shear_modulus=optional(POSITIVE), density=NOT_NEGATIVE)
SEGMENT = dict(start=(0, 0, 0), end=(0, 0, 1), radius=0.1)
TETRAHEDRON = [(0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)]
CALLS: dict[str, tuple[Callable, dict[str, Any], dict[str, st.SearchStrategy]]] = {
    "Rod": (
        rj.Rod,
        dict(length=1.0, EI=1.0, GJ=1.0, EA=1.0),
        dict.fromkeys(("length", "EI", "GJ", "EA"), POSITIVE)
        | dict(mass_per_length=NOT_NEGATIVE, radius=optional(POSITIVE)),
    ),
    "circular": (rj.Rod.circular, SECTION | dict(radius=0.01), MODULI | dict(radius=POSITIVE)),
    "tube": (
        rj.Rod.tube,
        SECTION | dict(outer_radius=0.01, inner_radius=0.009),
        MODULI | dict(outer_radius=POSITIVE | st.floats(0, 0.009), inner_radius=POSITIVE | st.floats(min_value=0.01)),
    ),
    "poisson": (
        rj.Rod.circular,
        dict(length=1.0, radius=0.01, youngs_modulus=1e7, poisson_ratio=0.3),
        dict(poisson_ratio=optional(numbers((), beyond(-1, 0.5000001)))),
    ),
    "Clamp": (rj.Clamp, dict(position=(0, 0, 0), frame=LEVEL), dict(position=VECTOR, frame=ROTATION)),
    "Swivel": (rj.Swivel, dict(position=(0, 0, 0), tangent=(1, 0, 0)), dict(position=VECTOR, tangent=DIRECTION)),
    "Pin": (rj.Pin, {}, dict(position=VECTOR)),
    "Free": (rj.Free, {}, dict(force=optional(VECTOR), moment=optional(VECTOR))),
    "PointForce": (rj.PointForce, dict(at=0.5, force=(0, 0, 1)), dict(at=NOT_NEGATIVE, force=VECTOR)),
    "frame": (
        rj.frame,
        dict(tangent=(1, 0, 0), d2=(0, 1, 0)),
        dict(tangent=DIRECTION, d2=DIRECTION | st.floats(min_value=1e-9).map(lambda x: (x, 0, 0))),
    ),
    "rotate": (
        rj.rotate,
        dict(frame=LEVEL, rotation_vector=(0, 0, 0)),
        dict(frame=ROTATION, rotation_vector=VECTOR | st.just((1e200, 0, 0))),
    ),
    "Plane": (rj.Plane, dict(point=(0, 0, 0), normal=(0, 0, 1)), dict(point=VECTOR, normal=DIRECTION)),
    "Sphere": (rj.Sphere, dict(center=(0, 0, 0), radius=1.0), dict(center=VECTOR, radius=POSITIVE)),
    "Capsule": (rj.Capsule, SEGMENT, dict(start=VECTOR, end=VECTOR | st.just((0, 0, 0)), radius=POSITIVE)),
    "Pipe": (
        rj.Pipe,
        dict(points=np.eye(3), radius=1.0),
        dict(points=not_finite((4, 3)) | numbers((4, 3)).filter(lambda value: not is_points(value)), radius=POSITIVE),
    ),
    "Cylinder": (rj.Cylinder, SEGMENT, dict(start=VECTOR, end=VECTOR | st.just((0, 0, 0)), radius=POSITIVE)),
    "Box": (
        rj.Box,
        dict(center=(0, 0, 0), size=(1, 1, 1)),
        dict(center=VECTOR, size=VECTOR | st.floats(max_value=0).map(lambda x: (1, x, 1)), frame=optional(ROTATION)),
    ),
    "Mesh": (
        rj.Mesh,
        dict(vertices=np.eye(4)[:, :3], faces=TETRAHEDRON),
        dict(
            vertices=not_finite((4, 3)) | numbers((4, 3)).filter(lambda value: not is_points(value)),
            faces=ANYTHING
            | st.integers(min_value=4).map(lambda vertex: [*TETRAHEDRON[:3], (0, vertex, 3)])
            | st.just(TETRAHEDRON[:3]),
        ),
    ),
    "Guess": (
        rj.Guess,
        dict(points=np.eye(3), total_twist=0.0),
        dict(
            points=not_finite((4, 3)) | numbers((4, 3)).filter(lambda value: not is_points(value)), total_twist=SCALAR
        ),
    ),
    "Scene": (
        rj.Scene,
        dict(rod=ROD, start=CLAMPS[0], end=CLAMPS[1]),
        dict.fromkeys(("rod", "start", "end"), ANYTHING)
        | dict(
            gravity=optional(VECTOR),
            turns=optional(numbers((), st.floats(0.1, 0.9))),
            point_forces=st.one_of(
                st.sampled_from([None, 5, 0.5, True, rj.PointForce(0.5, (0, 0, 1)), "no", b"no"]),
                st.lists(ANYTHING, min_size=1, max_size=3),
                st.floats(1.1, 9).map(lambda at: [rj.PointForce(at, (0, 0, 1))]),
            ),
        ),
    ),
    "Newton": (
        rj.Newton,
        {},
        dict(tolerance=NOT_NEGATIVE, max_iterations=whole(1, 10**9), max_rotation=numbers((), beyond(0, 3))),
    ),
    "NonlinearCG": (
        rj.NonlinearCG,
        {},
        dict(
            preconditioner=st.text().filter(lambda text: text != "gauss_newton") | st.integers() | st.booleans(),
            tolerance=NOT_NEGATIVE,
            max_iterations=whole(1, 10**9),
            refresh=whole(1, 10**9),
            line_search=ANYTHING,
        ),
    ),
    "LineSearch": (
        rj.LineSearch,
        {},
        dict(
            curvature=numbers((), beyond(0, 1)),
            energy_tolerance=numbers((), beyond(0, 1)),
            expansion=numbers((), st.floats(max_value=1.1)),
            max_trials=whole(2, 1000),
        ),
    ),
}


@st.composite
def bad_calls(draw, names: list[str]):
    function, good, bad = CALLS[draw(st.sampled_from(names))]
    name = draw(st.sampled_from(sorted(bad)))
    return function, good | {name: draw(bad[name])}, name


def refuses_the_argument(example, world):
    function, arguments, name = example
    assert_refused(lambda: function(**arguments), name)


for group in (["Rod", "circular", "tube", "poisson"], ["Clamp", "Swivel", "Pin", "Free", "PointForce"]):
    PROPERTIES["arguments of " + ", ".join(group)] = bad_calls(group), refuses_the_argument
for group in (["Plane", "Sphere", "Capsule", "Pipe"], ["Cylinder", "Box", "Mesh"]):
    PROPERTIES["arguments of " + ", ".join(group)] = bad_calls(group), refuses_the_argument
for group in (["frame", "rotate"], ["Scene", "Guess"], ["Newton", "NonlinearCG", "LineSearch"]):
    PROPERTIES["arguments of " + ", ".join(group)] = bad_calls(group), refuses_the_argument


PIN, FREE, FORCE = rj.Pin((0, 0, 0)), rj.Free(), [rj.PointForce(0.5, (0, 0, 1))]
SWIVEL = rj.Swivel((0, 0, 0), (1, 0, 0))
VECTORS = st.tuples(*[st.floats(-1e9, 1e9)] * 3)
# Supports and loads that allow no equilibrium, and the beginning of what is said.
UNSOUND = st.one_of(
    st.floats(1.51, 1e300).map(lambda x: ("the ends", dict(start=PIN, end=rj.Pin((0, x, 0))))),
    VECTORS.map(lambda x: ("Free at the start and Free", dict(start=FREE, end=rj.Free(x)))),
    VECTORS.map(lambda x: ("Pin at the start and Free", dict(start=rj.Pin(x), end=FREE))),
    VECTORS.map(lambda x: ("Pin at the start and Free", dict(start=PIN, end=rj.Free(x, x)))),
    VECTORS.map(lambda x: ("Swivel at the start and Free", dict(start=SWIVEL, end=rj.Free(moment=x), gravity=x))),
    st.integers().map(lambda turns: ("turns", dict(start=CLAMPS[0], end=PIN, turns=turns))),
)


@bad_input(UNSOUND)
def scenes_without_an_equilibrium(example, world):
    named, arguments = example
    assert_refused(lambda: rj.Scene(ROD, **arguments), named)


OPTIONS = dict(
    segments=optional(whole(2, 100_000) | st.just(10**6)),
    rtol=optional(numbers((), beyond(9.9e-11, 1.0001))),
    discretization=optional(other_than("finite_difference", "hermite")),
    solver=optional(ANYTHING),
    guess=optional(ANYTHING),
    planar=ANYTHING.filter(lambda value: not isinstance(value, bool)),
    find=other_than("minimum", "equilibrium"),
)
CG = rj.NonlinearCG()
# Options that are good alone: the one that is named, and all.
CONTRADICTIONS = [
    ("segments", dict(segments=4, rtol=1e-3)),
    ("solver", dict(solver=CG, discretization="hermite")),
    ("solver", dict(solver=CG, planar=True)),
    ("solver", dict(solver=CG, find="equilibrium")),
]
SOLVES: list[Callable] = [
    lambda **options: rj.solve(SCENE, **options),
    lambda **options: rj.solve_path([SCENE, SCENE], **options),
    lambda **options: rj.solve_batch([SCENE, SCENE], **options),
    lambda **options: rj.end_stiffness(SCENE, **options),
    lambda **options: rj.sensitivities(SCENE, of=["nodes"], wrt=["rod.EI"], **options),
]


@st.composite
def bad_options(draw):
    solve = draw(st.sampled_from(SOLVES))
    if draw(st.integers(0, 9)) == 0:
        return solve, *draw(st.sampled_from(CONTRADICTIONS))
    name = draw(st.sampled_from(sorted(OPTIONS)))
    return solve, name, {name: draw(OPTIONS[name])}


@bad_input(bad_options())
def options_of_a_solve(example, world):
    solve, name, options = example
    assert_refused(lambda: solve(**options), name)


STACK = jax.tree.map(lambda leaf: jax.device_put(np.stack([leaf, leaf])), SCENE)
OTHER = rj.Scene(ROD, *CLAMPS)
PLANAR_ONLY = rj.Scene(ROD, CLAMPS[0], rj.Pin((0.5, 0.5, 0.5)), gravity=(0, 1, 0))
WORDS_AND_NUMBERS: st.SearchStrategy[Any] = st.text(string.ascii_letters + ".", min_size=1, max_size=12) | st.integers()
NAMES = st.lists(WORDS_AND_NUMBERS, min_size=1, max_size=3)
# What is called, and what the message names.
OTHER_CALLS = st.one_of(
    st.tuples(st.sampled_from([rj.solve, rj.end_stiffness]), ANYTHING.filter(lambda x: x is not SCENE)).map(
        lambda x: (lambda: x[0](x[1]), "scene")
    ),
    st.lists(ANYTHING.filter(lambda x: x is not SCENE), min_size=1, max_size=3).map(
        lambda x: (lambda: rj.solve_path([SCENE, *x]), "scenes[1]")
    ),
    NAMES.map(lambda x: (lambda: rj.sensitivities(SCENE, of=x, wrt=["rod.EI"]), "of")),
    NAMES.map(lambda x: (lambda: rj.sensitivities(SCENE, of=["nodes"], wrt=x), "wrt")),
    st.sampled_from(
        [
            (lambda: rj.solve(STACK), "scene"),
            (lambda: rj.solve_path([]), "scenes"),
            (lambda: rj.solve_batch([]), "scenes"),
            (lambda: rj.solve_path(SCENE), "scenes"),
            (lambda: rj.solve_path([SCENE, OTHER]), "scenes"),
            (lambda: rj.solve_batch([[SCENE], [SCENE, SCENE]]), "scenes"),
            (lambda: rj.solve(PLANAR_ONLY, planar=True), "planar"),
            (lambda: rj.end_stiffness(rj.Scene(ROD, CLAMPS[0], FREE)), "scene.end"),
            (lambda: rj.end_stiffness(rj.Scene(ROD, CLAMPS[0], SWIVEL)), "scene.end"),
        ]
    ),
)


@bad_input(OTHER_CALLS)
def other_arguments(example, world):
    call, name = example
    assert_refused(call, name)


# Calls with a result, and what the message names.
ALIENS_TO_A_CALL: dict[str, st.SearchStrategy] = {
    "s": st.one_of(
        ANYTHING, not_finite((3,)), beyond(-1e-9, 1.0001), wrong_shape((3,)).filter(lambda x: np.ndim(x) > 1)
    ),
    "equilibrium": ANYTHING,
    "scenes": st.one_of(st.integers(), st.floats(), st.booleans(), st.none(), st.builds(object)),
    "progress": ANYTHING.filter(lambda value: value is not None and not isinstance(value, bool)),
    "of": st.one_of(st.integers(), st.none(), st.just([]), st.just("nodes"), st.builds(object)),
}


@bad_input(
    st.sampled_from(sorted(ALIENS_TO_A_CALL)).flatmap(lambda name: st.tuples(st.just(name), ALIENS_TO_A_CALL[name]))
)
def results_and_sequences(example, world):
    name, value = example
    calls: dict[str, list[Callable]] = {
        "s": [lambda: world.samples.single.position_at(value), lambda: world.samples.path.position_at(value)],
        "equilibrium": [lambda: rj.describe(value)],
        "scenes": [lambda: rj.solve_path(value), lambda: rj.solve_batch(value), lambda: rj.solve_batch([value])],
        "progress": [
            lambda: rj.solve_path([SCENE], segments=4, progress=value),
            lambda: rj.solve_batch([SCENE], segments=4, progress=value),
            lambda: rj.solve(SCENE, segments=4, progress=value),
        ],
        "of": [lambda: rj.sensitivities(SCENE, of=value, wrt=["rod.EI"])],
    }
    for call in calls[name]:
        assert_refused(call, name)


def test_a_stack_is_no_guess_for_one_scene(world):
    for solve in (lambda **guess: rj.solve(SCENE, **guess), lambda **guess: rj.solve_path([SCENE], **guess)):
        assert_refused(lambda solve=solve: solve(guess=world.samples.path), "guess must be a single equilibrium")


@st.composite
def bad_file_arguments(draw):
    function = draw(st.sampled_from(["save", "load", "read_scene", "write_scene"]))
    first = dict(save="equilibrium", write_scene="scene").get(function)
    if first and draw(st.booleans()):
        good = SCENE if first == "scene" else None
        return function, (draw(ANYTHING.filter(lambda value: value is not good)), "a.vtkhdf"), first
    path = ANYTHING.filter(lambda value: not isinstance(value, str)) | st.just("a\0.vtkhdf")
    if function in ("save", "load"):
        path |= st.text(string.ascii_letters + "./", max_size=9)
    return function, (draw(path),), "path"


@bad_input(bad_file_arguments())
def names_of_files(example, world):
    function, arguments, name = example
    if name == "path" and function == "save":
        arguments = world.samples.single, *arguments
    if name == "path" and function == "write_scene":
        arguments = SCENE, *arguments
    world.empty_folder()
    assert_refused(lambda: getattr(rj, function)(*arguments), name)
    assert os.listdir() == []


# --- scene files -----------------------------------------------------------------------------------------------------


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


def document(content: dict[str, Any]) -> str:
    return "\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in content.items()) + "\n"


CLAMPED = dict(support="clamp", position="[0, 0, 0] m", tangent=[1, 0, 0], d2=[0, 1, 0])
STIFF = dict(length="1 m", EI="4.9e-3 N m^2", GJ="3.3e-3 N m^2", EA="785 N")
SOUND = dict(youngs_modulus="10 MPa", density="1200 kg/m^3")
DOCUMENTS: list[dict[str, Any]] = [
    dict(
        rod=dict(section="circular", length="100 cm", radius="5 mm", poisson_ratio=0.5, **SOUND),
        start=CLAMPED | dict(spin="10 deg"),
        end=dict(support="clamp", position="[80, 0, 0] cm", frame=LEVEL.tolist(), spin="0 deg"),
        loads=dict(gravity="[0, 0, -9.81] m/s^2", point_force=[dict(at="0.5 m", force="[0, 0, -0.2] N")]),
        solve=dict(rtol=1e-3, discretization="hermite"),
        path=[
            dict(steps=2, start=dict(tangent=[1, 1, 0]), end=dict(position="[50, 0, 0] cm")),
            dict(steps=3, end=dict(spin="90 deg")),
        ],
    ),
    dict(
        rod=STIFF | dict(mass_per_length="0.1 kg/m", radius="5 mm"),
        start=CLAMPED,
        end=dict(support="clamp", position="[0.8, 0, 0] m", tangent=[1, 0, 0], d2=[0, 1, 0], turns=1),
        loads=dict(gravity="[0, 0, -9.81] m/s^2"),
        solve=dict(segments=4, discretization="finite_difference"),
    ),
    dict(
        rod=SOUND | dict(section="tube", length="1 m", outer_radius="5 mm", inner_radius="4 mm", shear_modulus="3 MPa"),
        start=dict(support="swivel", position="[0, 0, 0] m", tangent=[1, 0, 0]),
        end=dict(support="pin", position="[0.8, 0, 0] m"),
    ),
    dict(rod=STIFF, start=CLAMPED, end=dict(support="free", force="[0, 0, 1] N", moment="[0, 0, 1] N m")),
]
Place = tuple[str | int, ...]


def places(value: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """All tables and values with where they are."""
    if place:
        yield place, value
    entries = value.items() if isinstance(value, dict) else enumerate(value) if is_tables(value) else ()
    for key, entry in entries:
        yield from places(entry, (*place, key))


def is_tables(value: Any) -> bool:
    return isinstance(value, list) and isinstance(value[0], dict)


def dotted(place: Place) -> str:
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in place).removeprefix(".")


def entry(content: Any, place: Place) -> Any:
    for key in place:
        content = content[key]
    return content


# Text in which no unit and no number is.
NONSENSE = st.text("qxzQXZ ßé_", max_size=12)
WRONG_UNITS = st.sampled_from(["kg^3", "K", "A m^7", "cd", "%", "m m m m", "qx", "9**9**9", "m**", "(m", "furlong/day"])
NUMBER = st.floats(-1e6, 1e6).map(repr)
OF_NO_KIND = st.one_of(st.booleans(), st.just({}), st.just([]), st.just([[]]), NONSENSE.map(lambda text: {text: 1}))
SIGNED = {"position", "tangent", "d2", "frame", "spin", "turns", "force", "moment", "gravity", "poisson_ratio"}


def arrays_for_toml(shape: tuple[int, ...]) -> st.SearchStrategy:
    """Lists of numbers of another shape, or with one that is not finite."""
    shapes = hnp.array_shapes(min_dims=0, max_dims=3, min_side=1, max_side=4).filter(lambda other: other != shape)
    other = shapes.map(lambda shape: np.full(shape, 0.5).tolist())
    size = int(np.prod(shape))

    def with_one(example: tuple[int, Any]) -> Any:
        array = np.full(size, 0.5, object)
        array[example[0]] = example[1]
        return array.reshape(shape).tolist()

    return other | st.tuples(st.integers(0, size - 1), st.sampled_from([np.nan, np.inf, -np.inf, 10**400])).map(
        with_one
    )


def bad_value(key: str) -> st.SearchStrategy:
    """Values that a key of a scene file must not have."""
    if key in ("support", "section", "discretization"):
        return st.one_of(NONSENSE, st.integers(), st.floats(), OF_NO_KIND)
    if key in ("segments", "steps"):
        integers = st.integers(max_value=1 if key == "segments" else 0) | st.integers(min_value=100_001)
        return st.one_of(NONSENSE, integers, st.just(10**6), st.floats(), OF_NO_KIND)
    if key == "rtol":
        return st.one_of(NONSENSE, beyond(0, 1.001), st.just(np.nan), OF_NO_KIND, st.just("1e-3"))
    unit, shape, _ = QUANTITIES[key]
    if not unit:
        others = {
            "poisson_ratio": beyond(-1, 0.5001),
            "turns": st.floats(0.1, 0.9),
            "frame": MATRICES.map(np.ndarray.tolist),
        }.get(key, st.just([0, 0, 0]))
        return st.one_of(NONSENSE, arrays_for_toml(shape), OF_NO_KIND, NUMBER, others)
    good = json.dumps(np.full(shape, 0.5).tolist())
    values = [NONSENSE, OF_NO_KIND, st.integers(), st.floats(), NUMBER, st.just(good), arrays_for_toml(shape)]
    values += [WRONG_UNITS.map(lambda wrong: f"{good} {wrong}"), arrays_for_toml(shape).map(lambda x: f"{x} {unit}")]
    values += [st.sampled_from([f"{good} {unit} {unit}", f"{unit} {good}", f"1e999 {unit}", f"{unit}", f"0x1 {unit}"])]
    if key not in SIGNED:
        values.append(st.floats(max_value=-1e-300).map(lambda x: f"{x} {unit}"))
    return st.one_of(values)


@st.composite
def documents_with_a_bad_value(draw):
    content = copy.deepcopy(draw(st.sampled_from(DOCUMENTS)))
    leaves = [place for place, value in places(content) if not isinstance(value, dict) and not is_tables(value)]
    place = draw(st.sampled_from(leaves))
    entry(content, place[:-1])[place[-1]] = draw(bad_value(str(place[-1])))
    return content, dotted(place)


def says_what_is_allowed(line: str) -> bool:
    return re.search(r" must |allowed are |is missing|is not allowed|is needed|exactly one of", line) is not None


@bad_input(documents_with_a_bad_value())
def values_in_a_scene_file(example, world):
    content, key = example
    Path("scene.toml").write_text(document(content), encoding="utf-8")
    line = world.refused("solve", "scene.toml")
    assert line.startswith(f"rodjax: scene.toml: {key} ")
    assert says_what_is_allowed(line)


OPTIONAL = {"d2", "spin", "turns", "loads", "gravity", "point_force", "solve", "rtol", "segments", "discretization"}
OPTIONAL |= {"path", "steps", "density", "mass_per_length", "radius", "force", "moment"}


@st.composite
def documents_with_a_bad_key(draw):
    """A key that is missing, misspelt, in the wrong table, or no table; and what of it the message must name."""
    content = copy.deepcopy(draw(st.sampled_from(DOCUMENTS)))
    place = draw(st.sampled_from([place for place, _ in places(content) if isinstance(place[-1], str)]))
    table, key, parent = entry(content, place[:-1]), str(place[-1]), dotted(place[:-1])
    unknown = draw(st.text(string.ascii_letters + "_- .", min_size=1, max_size=9)) + "X"
    kind = draw(st.sampled_from(["missing", "misspelt", "unknown", "no table"]))
    if kind == "missing":
        assume(parent.startswith(("rod", "start", "end", "loads.point_force")) or not parent)
        assume(key not in OPTIONAL - ({"radius"} if "section" in table else set()) or "point_force[" in parent)
        del table[key]
        # A rod without its section is one of given stiffnesses, which it lacks.
        return content, parent or key
    if kind == "misspelt":
        table[unknown] = table.pop(key)
        return content, parent
    if kind == "unknown":
        table[unknown] = draw(st.sampled_from([1, 0.5, "1 m", [], {}, True]))
        return content, " ".join(unknown.split())
    assume(isinstance(table[key], dict | list) and key not in QUANTITIES)
    table[key] = draw(st.one_of(NONSENSE, st.integers(), st.floats(), st.booleans(), st.lists(NONSENSE, min_size=1)))
    return content, dotted(place)


@bad_input(documents_with_a_bad_key())
def keys_in_a_scene_file(example, world):
    content, named = example
    Path("scene.toml").write_text(document(content), encoding="utf-8")
    line = world.refused("solve", "scene.toml")
    assert line.startswith("rodjax: scene.toml: ")
    assert named in line
    assert says_what_is_allowed(line)


@st.composite
def damaged_texts(draw):
    """Scene files after slips of the keyboard and of the disk; some of them may make sense."""
    content = bytearray(document(draw(st.sampled_from(DOCUMENTS))).encode())
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(content)))
        kind = draw(st.sampled_from(["insert", "delete", "replace", "cut"]))
        if kind == "cut":
            del content[at:]
        else:
            new = draw(st.binary(max_size=3) | st.text(string.printable, max_size=3).map(str.encode))
            content[at : at + (0 if kind == "insert" else draw(st.integers(1, 9)))] = b"" if kind == "delete" else new
    return bytes(content)


TEXTS = st.text(max_size=50).map(lambda text: text.encode("utf-8", "replace"))


@bad_input(damaged_texts() | st.binary(max_size=50) | TEXTS)
def damaged_scene_files(content, world):
    Path("scene.toml").write_bytes(content)
    try:
        line = world.refused("solve", "scene.toml")
    except Accepted:
        reject()
    assert line.startswith("rodjax: scene.toml: ")


FILE_NAMES = st.text("abü", max_size=9)


@bad_input(st.tuples(st.sampled_from(["missing", "folder", "below a file", "deep", "dots"]), FILE_NAMES))
def unreadable_scene_files(example, world):
    kind, name = example
    folder = world.empty_folder()
    path = folder / f"{name}.toml"
    if kind == "folder":
        path.mkdir()
    elif kind == "below a file":
        path.touch()
        path = path / "scene.toml"
    elif kind in ("deep", "dots"):
        path.write_text("a = " + 9999 * "[" if kind == "deep" else f"rod.{2000 * 'a.'}a = 1")
    line = world.refused("solve", path)
    assert name.strip() in line
    assert re.search("cannot be read|is not valid TOML", line)


# --- the command line ------------------------------------------------------------------------------------------------

WORDS = st.text(string.ascii_letters + string.digits + "/.", max_size=9).map(lambda text: f"x{text}")
COMMANDS = st.one_of(
    WORDS.map(lambda word: ([word], "solve")),
    WORDS.map(lambda word: (["solve", "scene.toml", f"--{word}"], word)),
    WORDS.map(lambda word: (["solve", "scene.toml", "-o", word], "-o must")),
    WORDS.map(lambda word: (["solve", "scene.toml", "-o", f"{word}/a.vtkhdf"], "-o must")),
    WORDS.map(lambda word: (["solve", "scene.toml", "--plot", word], "--plot must")),
    WORDS.map(lambda word: (["demo", "--segments", word], "--segments")),
    beyond(2, 1e5).map(lambda number: (["demo", f"--segments={number}"], "--segments")),
    WORDS.map(lambda word: (["sweep", "scene.toml", "--over", "grid.toml", "-o", word], "-o must")),
    WORDS.map(lambda word: (["sweep", "scene.toml", "--over", word, "-o", "a.h5"], word)),
    WORDS.map(lambda word: (["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.h5", "--chunk", word], "--chunk")),
    WORDS.map(lambda word: (["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.h5", "--shard", word], "--shard")),
    st.integers(max_value=0).map(
        lambda number: (["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.h5", f"--chunk={number}"], "--chunk")
    ),
    st.tuples(st.integers().filter(lambda index: index != 1), st.integers() | st.integers(5, 10**40)).map(
        lambda shard: (
            ["sweep", "scene.toml", "--over", "grid.toml", "-o", "a.h5", f"--shard={shard[0]}/{shard[1]}"],
            "shard",
        )
    ),
    WORDS.map(lambda word: (["fit", word, "data.csv"], word)),
    WORDS.map(lambda word: (["fit", "fit.toml", "data.csv", "--out", f"scene.toml/{word}"], "--out must be a folder")),
    WORDS.map(lambda word: (["merge", f"{word}.h5", "-o", "a.h5"], word)),
    WORDS.map(lambda word: (["merge", "scene.toml", word, "-o", "a.h5"], "scene.toml")),
)


@bad_input(COMMANDS)
def command_lines(example, world):
    arguments, named = example
    if not Path("grid.toml").exists():
        Path("scene.toml").write_text(document(DOCUMENTS[1]))
        Path("grid.toml").write_text(GRID)
    assert named in world.refused(*arguments)
    assert sorted(os.listdir()) == ["grid.toml", "scene.toml"]


# --- sweeps ----------------------------------------------------------------------------------------------------------

# Four cases: in chunks of two both shards have one.
GRID = '"rod.EI" = [4e-3, 5e-3]\n"end.position.0" = [0.7, 0.8]\n'
BAD_EI = st.one_of(
    NONSENSE,
    OF_NO_KIND,
    st.sampled_from([np.nan, np.inf, -np.inf, 10**400, -(10**400), "1 m", "nan N m^2", "[1, 2] N m^2"]),
    st.floats(max_value=-1e-300),
    WRONG_UNITS.map(lambda wrong: f"1 {wrong}"),
)
BAD_COUNTS = st.one_of(st.integers(max_value=1), st.integers(min_value=10**8 + 1), NONSENSE, st.floats())
BAD_RANGES = st.one_of(
    st.tuples(st.just("count"), BAD_COUNTS),
    st.tuples(st.sampled_from(["from", "to"]), BAD_EI),
    st.tuples(st.just("spacing"), NONSENSE | st.integers()),
    st.tuples(NONSENSE.filter(bool), st.integers()),
)
BAD_CELLS = st.sampled_from(["", "stiff", "nan", "-inf", "1 m", "1e999", "[1]", "[", "-1", '"', "true"])


@st.composite
def bad_sweeps(draw):
    """The texts of a scene, and of a grid or table; and what the message must name."""
    kind = draw(st.sampled_from(["values", "range", "key", "vector", "product", "scene", "table", "damage"]))
    scene, name, grid = DOCUMENTS[1], "grid.toml", document({"rod.GJ": [3e-3]})
    if kind == "values":
        values = [4e-3] * draw(st.integers(0, 3))
        values.insert(draw(st.integers(0, len(values))), draw(BAD_EI))
        return scene, name, document({"rod.EI": values}), "EI"
    if kind == "range":
        key, value = draw(BAD_RANGES)
        return scene, name, document({"rod.EI": {"from": 4e-3, "to": 5e-3, "count": 3} | {key: value}}), "rod.EI"
    if kind == "key":
        known = ["rod.EI.0", f"end.position.{5000 * '9'}", "end.position.3", "solve.rtol", "end.force"]
        key = draw(WORDS | st.sampled_from(known))
        return scene, name, document({key: [0.5]}), key[:12]
    if kind == "vector":
        return scene, name, document({"end.position": [draw(arrays_for_toml((3,)))]}), "end.position"
    if kind == "product":
        ranges = {"from": 1.0, "to": 2.0, "count": draw(st.integers(10**5, 10**6))}
        return scene, name, document({"rod.EI": ranges, "rod.GJ": ranges, "rod.EA": ranges, "rod.length": ranges}), name
    if kind == "scene":
        content, key = draw(documents_with_a_bad_value())
        assume(not {"section", "path"} & {*content, *content["rod"]} and key != "rod.GJ")
        return content, name, grid, key
    rows = ["rod.EI,end.position.0", "4e-3,0.7", f"{draw(BAD_CELLS)},0.8"]
    if kind == "table":
        return scene, "grid.csv", "\n".join(rows), "grid.csv"
    at = draw(st.integers(0, len(GRID) - 1))
    return scene, name, GRID[:at] + draw(st.text(max_size=3)) + GRID[at + draw(st.integers(0, 3)) :], None


@bad_input(bad_sweeps())
def cases_of_a_sweep(example, world):
    scene, name, grid, named = example
    Path("scene.toml").write_text(document(scene), encoding="utf-8")
    Path(name).write_text(grid, encoding="utf-8", errors="replace")
    try:
        line = world.refused("sweep", "scene.toml", "--over", name, "-o", "out.h5")
    except Accepted:
        assert named is None
        shutil.rmtree("out.h5.parts")
        reject()
    assert re.match(r"rodjax: (scene\.toml|grid\.toml|grid\.csv): ", line)
    assert (named or "") in line
    assert not Path("out.h5").exists()
    assert not Path("out.h5.parts").exists()


# --- fits ------------------------------------------------------------------------------------------------------------

FITS = Path(__file__).parents[1] / "experiments" / "fits"
BAD_VALUES = st.one_of(NONSENSE, OF_NO_KIND, arrays_for_toml((2,)), WRONG_UNITS.map(lambda wrong: f"1 {wrong}"))


@st.composite
def bad_fits(draw):
    """The name of one of the files of the example, what becomes of its text, and what the message must name."""
    kind = draw(st.sampled_from(["cell", "title", "value"]))
    if kind == "value":
        text = (FITS / "fit.toml").read_text()
        found = draw(st.sampled_from(list(re.finditer(r"^(\w+) = (.*?)(?=  #|$)", text, re.M))))
        value = document({"a": draw(BAD_VALUES)}).partition("=")[2].strip()
        return "fit.toml", text[: found.start(2)] + value + text[found.end(2) :], None
    rows = [row.split(",") for row in (FITS / "data.csv").read_text().splitlines()]
    column = draw(st.integers(2, len(rows[0]) - 1))
    bad = draw(st.sampled_from(["stiff", "nan", "-inf", "1 m", "1e999", "[1]", "[", "true", "1,1", "1e-3 mm mm"]))
    if kind == "cell":
        row = draw(st.sampled_from([k for k, row in enumerate(rows) if k and row[column]]))
        rows[row][column] = bad
        return "data.csv", "\n".join(map(",".join, rows)), f"line {row + 1}"
    title = f"{draw(WORDS)}x"
    rows[0][column] = title
    return "data.csv", "\n".join(map(",".join, rows)), "column"


def copy_fit():
    for source in FITS.iterdir():
        shutil.copy(source, source.name)


@bad_input(bad_fits())
def measurements(example, world):
    name, text, named = example
    copy_fit()
    Path(name).write_text(text, encoding="utf-8", errors="replace")
    try:
        line = world.refused("fit", "fit.toml", "data.csv")
    except Accepted:
        assert named is None
        reject()
    assert re.match(rf"rodjax: ({name}|[^:]*: cannot be read)", line)
    assert (named or "") in line
    assert not Path("rodjax-fit").exists()


# --- damaged files ---------------------------------------------------------------------------------------------------


@st.composite
def damage(draw):
    """What happens to a file, as a function of its bytes."""
    kind = draw(st.sampled_from(["cut", "flip", "zero", "insert", "delete", "append", "swap"]))
    part, size, bits = draw(st.floats(0, 1, exclude_max=True)), draw(st.integers(1, 600)), draw(st.integers(1, 255))

    def damaged(content: bytes) -> bytes:
        at = int(part * len(content))
        before, hit, after = content[:at], content[at : at + size], content[at + size :]
        return {
            "cut": before,
            "flip": before + bytes([hit[0] ^ bits]) + content[at + 1 :],
            "zero": before + bytes(len(hit)) + after,
            "insert": before + bytes([bits] * size) + hit + after,
            "delete": before + after,
            "append": content + bytes([bits] * size),
            "swap": after + hit + before,
        }[kind]

    return damaged


def opened(path: str | Path, mode: Literal["r", "r+"] = "r") -> Any:
    """An HDF5 file, of whose entries pyright does not know the kind."""
    return h5py.File(path, mode)


def leaves_of(tree: Any) -> list[tuple]:
    return [(leaf.dtype, leaf.shape, np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(tree)]


def assert_refused_or_same(path: str, expected: rj.Equilibrium) -> None:
    try:
        found = load(path)
    except ValueError as error:
        said = f"{type(error).__name__}: {error}"
    else:
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        assert leaves_of(found) == leaves_of(expected)
        return
    assert re.match(rf"ValueError: {path}:? (is not a readable HDF5 file|has no|lacks|says|is damaged)", said)


@bad_input(st.tuples(st.sampled_from(["single", "path"]), damage()))
def damaged_results(example, world):
    name, damaged = example
    expected = getattr(world.samples, name)
    save(expected, "a.vtkhdf")
    Path("a.vtkhdf").write_bytes(damaged(Path("a.vtkhdf").read_bytes()))
    assert_refused_or_same("a.vtkhdf", expected)


@bad_input(st.tuples(st.sampled_from(["fit.toml", "scene.toml", "data.csv"]), damage()))
def damaged_fits(example, world):
    name, damaged = example
    copy_fit()
    Path(name).write_bytes(damaged(Path(name).read_bytes()))
    try:
        world.refused("fit", "fit.toml", "data.csv")
    except Accepted:
        reject()
    assert not Path("rodjax-fit").exists()


MAY_BE_MISSING = {"scene/gravity", "scene/turns", "scene/rod/radius"}
REPLACEMENTS: dict[str, Callable[[np.ndarray], Any]] = {
    "text": lambda _: "text",
    "fewer": lambda values: np.zeros((2, *values.shape)),
    "reshaped": lambda values: values.reshape(-1, 1, 1, 1),
    "complex": lambda values: values * 1j,
    "kind": lambda values: values.astype(np.int64 if values.dtype.kind in "fb" else float),
    "nothing": lambda _: h5py.Empty("f"),
    "bytes": lambda values: values.astype("S9"),
    "objects": lambda values: np.full(values.shape, "a", object),
}


@bad_input(
    st.tuples(
        st.sampled_from(["single", "path"]),
        st.floats(0, 1, exclude_max=True),
        st.sampled_from(["missing", "group", *REPLACEMENTS]),
        st.text(string.ascii_letters, max_size=9),
    )
)
def results_with_an_alien_dataset(example, world):
    name, part, kind, word = example
    expected = getattr(world.samples, name)
    save(expected, "a.vtkhdf")
    with opened("a.vtkhdf", "r+") as file:
        group, found = file["rodjax"], []
        group.visititems(lambda place, entry: found.append(place))
        place = found[int(part * len(found))]
        old = group[place]
        values = old[()] if isinstance(old, h5py.Dataset) else np.zeros(1)
        assume(kind != "missing" or place not in MAY_BE_MISSING)
        assume(kind != "group" or isinstance(old, h5py.Dataset))
        del group[place]
        if kind == "group":
            group.create_group(place)[word or "a"] = 1
        elif kind != "missing":
            group[place] = REPLACEMENTS[kind](values)
    with pytest.raises(ValueError, match=r"a\.vtkhdf ") as caught:
        load("a.vtkhdf")
    assert type(caught.value) is ValueError


def test_a_result_that_lacks_an_entry_is_refused(world):
    """Each entry in turn: a load or an obstacle that is gone is no smaller scene."""
    save(world.samples.single, "a.vtkhdf")
    with opened("a.vtkhdf") as file:
        found = []
        file["rodjax"].visititems(lambda place, entry: found.append(place))
    assert len(found) > 50
    for place in set(found) - MAY_BE_MISSING:
        save(world.samples.single, "a.vtkhdf")
        with opened("a.vtkhdf", "r+") as file:
            del file["rodjax"][place]
        with pytest.raises(ValueError, match=r"a\.vtkhdf "):
            load("a.vtkhdf")


def contents(path: str | Path) -> dict[str, Any]:
    """All datasets and attributes of a file."""
    with opened(path) as file:
        found = {name: np.asarray(value).tolist() for name, value in file.attrs.items()}
        file.visititems(lambda name, entry: found.update({name: entry[()].tolist()} if hasattr(entry, "shape") else {}))
    return found


def copied(world: World, *names: str) -> None:
    """An empty folder with these of the files of a sweep."""
    world.empty_folder()
    for name in names:
        source = world.samples.sweeps / name
        shutil.copytree(source, name) if source.is_dir() else shutil.copy(source, name)


def damage_to(name: str, damaged: Callable[[bytes], bytes]) -> None:
    Path(name).write_bytes(damaged(Path(name).read_bytes()))


@bad_input(st.tuples(st.sampled_from(["1.h5", "2.h5"]), damage()))
def damaged_shards(example, world):
    name, damaged = example
    copied(world, "1.h5", "2.h5")
    damage_to(name, damaged)
    code, err = world.run("merge", "1.h5", "2.h5", "-o", "out.h5")
    if code == 0:
        assert contents("out.h5") == contents(world.samples.sweeps / "whole.h5")
    else:
        assert code == 2
        assert re.fullmatch(rf"rodjax: {re.escape(name)} [^\n]*\n", err)
        assert sorted(os.listdir()) == ["1.h5", "2.h5"]


ALIENS = ["chunk", "position", "missing", "text", "shape", "kind", "extra"]
DATASETS = ["case", "energy", "nodes", "converged", "parameters/rod.EI"]


@bad_input(st.tuples(st.sampled_from(ALIENS), st.sampled_from(DATASETS), st.integers(1, 10**6)))
def shards_with_an_alien_dataset(example, world):
    kind, name, number = example
    copied(world, "1.h5", "2.h5")
    with opened("2.h5", "r+") as file:
        values = file[name][()]
        if kind == "chunk":
            file.attrs["chunk"] = number if number != 2 else 0
        elif kind == "position":
            file["case"][0] = number + 3
        elif kind == "extra":
            file[f"extra{number}"] = values
        else:
            del file[name]
            if kind != "missing":
                shape = (2, number % 99 + 4) if kind == "shape" else values.shape
                file[name] = "text" if kind == "text" else np.full(shape, 1j * number)
    line = world.refused("merge", "1.h5", "2.h5", "-o", "out.h5")
    assert "2.h5" in line or "out.h5" in line
    assert sorted(os.listdir()) == ["1.h5", "2.h5"]


RESUME = "sweep", "scene.toml", "--over", "grid.toml", "-o", "out.h5", "--resume"
SWEEP = "scene.toml", "grid.toml", "out.h5.parts"


@bad_input(st.tuples(st.sampled_from(["chunk-000000.h5", "chunk-000001.h5", "manifest.json"]), damage()))
def damaged_parts(example, world):
    """What was finished is kept, or solved again; never is it taken for what it is not."""
    name, damaged = example
    copied(world, *SWEEP)
    damage_to(f"out.h5.parts/{name}", damaged)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rodjax.sweeps.chunk.solve_batch", made_up_batch)
        patch.setattr("rodjax.sweeps.chunk._errors", made_up_errors)
        code, err = world.run(*RESUME)
    if code == 0:
        assert contents("out.h5") == contents(world.samples.sweeps / "whole.h5")
    else:
        assert code == 2
        assert re.fullmatch(r"rodjax: out\.h5\.parts[^\n]*\n", err)
        assert len(os.listdir("out.h5.parts")) == 3


@bad_input(damage())
def damaged_sweeps(damaged, world):
    copied(world, "scene.toml", "grid.toml", "whole.h5")
    os.rename("whole.h5", "out.h5")
    damage_to("out.h5", damaged)
    code, err = world.run(*RESUME)
    if code == 0:
        assert contents("out.h5") == contents(world.samples.sweeps / "whole.h5")
    else:
        assert code == 2
        assert re.fullmatch(r"rodjax: out\.h5 [^\n]*\n", err)


def damaged_ends(content: bytes) -> Iterator[bytes]:
    """With the seal's mark gone, and content before it: as zeros, cut out, in another order."""
    inside, beyond = len(content) - 100, len(content) - 20
    yield content[:inside] + bytes(beyond - inside) + content[beyond:]
    yield content[:-50] + content[-36:]
    yield content[:inside] + content[inside:beyond][::-1] + content[beyond:]


def test_a_damaged_seal_does_not_hide_damage_before_it(world):
    copied(world, "scene.toml", "grid.toml", "whole.h5")
    save(world.samples.single, "a.vtkhdf")
    for damaged in damaged_ends(Path("a.vtkhdf").read_bytes()):
        Path("a.vtkhdf").write_bytes(damaged)
        with pytest.raises(ValueError, match="is damaged: the seal after its end is missing"):
            load("a.vtkhdf")
    for damaged in damaged_ends(Path("whole.h5").read_bytes()):
        Path("out.h5").write_bytes(damaged)
        code, err = world.run(*RESUME)
        assert code == 2
        assert re.fullmatch(r"rodjax: out\.h5 [^\n]*is damaged: the seal after its end is missing[^\n]*\n", err)


# --- places that cannot be written to --------------------------------------------------------------------------------


@contextlib.contextmanager
def full_disk(after: int) -> Iterator[None]:
    """Files cannot grow beyond so many bytes; nothing is compiled into the cache of all tests, to be cut off there."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    seconds = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", float("inf"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (after, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)


@bad_input(st.tuples(st.sampled_from(["a.vtkhdf", "a.toml"]), st.floats(0, 1, exclude_max=True)))
def full_disks(example, world):
    name, part = example
    world.empty_folder()
    write = {"a.vtkhdf": lambda: save(world.samples.single, name), "a.toml": lambda: write_scene(SCENE, name)}[name]
    write()
    before = Path(name).read_bytes()
    with full_disk(int(part * len(before))), pytest.raises(OSError, match=rf"cannot write {name}: File too large"):
        write()
    assert Path(name).read_bytes() == before
    assert os.listdir() == [name]


@bad_input(st.floats(0, 0.99))
def full_disks_of_a_solve(part, world):
    world.empty_folder()
    Path("scene.toml").write_text(document(DOCUMENTS[1]))
    save(world.samples.path, "out.vtkhdf")
    before = Path("out.vtkhdf").read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rj, "describe", lambda equilibrium: "described")
        patch.setattr(rj, "solve", lambda scene, **options: world.samples.single)
        with full_disk(int(part * len(before) / 2)):
            line = world.refused("solve", "scene.toml", "-o", "out.vtkhdf")
    assert line == "rodjax: cannot write out.vtkhdf: File too large; folder: .\n"
    assert Path("out.vtkhdf").read_bytes() == before
    assert sorted(os.listdir()) == ["out.vtkhdf", "scene.toml"]


@bad_input(st.floats(0, 0.99))
def full_disks_of_a_merge(part, world):
    copied(world, "1.h5", "2.h5")
    with full_disk(int(part * (world.samples.sweeps / "whole.h5").stat().st_size)):
        line = world.refused("merge", "1.h5", "2.h5", "-o", "out.h5")
    assert "File too large" in line
    assert sorted(os.listdir()) == ["1.h5", "2.h5"]


@bad_input(st.floats(0, 0.99))
def full_disks_of_a_sweep(part, world):
    """What was finished is there when there is room again."""
    copied(world, "scene.toml", "grid.toml")
    whole = world.samples.sweeps / "whole.h5"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rodjax.sweeps.chunk.solve_batch", made_up_batch)
        patch.setattr("rodjax.sweeps.chunk._errors", made_up_errors)
        with full_disk(int(part * whole.stat().st_size)):
            line = world.refused(*RESUME[:-1], "--chunk", 2)
        assert "File too large" in line
        assert not Path("out.h5").exists()
        for chunk in Path("out.h5.parts").glob("chunk*"):
            assert chunk.read_bytes() == (world.samples.sweeps / chunk).read_bytes()
        assert world.run(*RESUME, "--chunk", 2) == (0, "")
    assert contents("out.h5") == contents(whole)


COMMANDS_THAT_WRITE = ["solve", "plot", "sweep", "merge", "demo"]
PLACES = {"missing": "missing/", "file": "note/", "proc": "/proc/", "folder": "", "read-only": "read-only/"}


class Picture:
    """Axes, and their figure."""

    def get_figure(self, root: bool) -> "Picture":
        return self

    def savefig(self, image: io.BytesIO, format: str) -> None:
        image.write(1000 * format.encode())


@bad_input(st.tuples(st.sampled_from(COMMANDS_THAT_WRITE), st.sampled_from(sorted(PLACES)), FILE_NAMES))
def unwritable_places(example, world):
    command, kind, name = example
    assume(not (kind == "read-only" and os.geteuid() == 0))
    assume(not (command == "demo" and kind != "file"))
    copied(world, "scene.toml", "grid.toml", "1.h5", "2.h5")
    file = f"{name}." + dict(solve="vtkhdf", plot="svg", demo="").get(command, "h5")
    Path("note").write_text("old")
    os.mkdir("read-only", 0o500)
    if kind == "folder":
        os.mkdir(file)
    path = PLACES[kind] + file
    arguments = {
        "solve": ("solve", "scene.toml", "-o", path),
        "plot": ("solve", "scene.toml", "--plot", path),
        "sweep": ("sweep", "scene.toml", "--over", "grid.toml", "-o", path),
        "merge": ("merge", "1.h5", "2.h5", "-o", path),
        "demo": ("demo", "--out", path),
    }[command]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rj, "describe", lambda equilibrium: "described")
        patch.setattr(rj, "solve", lambda scene, **options: world.samples.single)
        patch.setattr("rodjax.plot.plot_rod", lambda equilibrium: Picture())
        patch.setattr("rodjax.sweeps.chunk.solve_batch", made_up_batch)
        patch.setattr("rodjax.sweeps.chunk._errors", made_up_errors)
        line = world.refused(*arguments)
    assert name.strip() in line
    assert Path("note").read_text() == "old"


# --- all of them -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PROPERTIES)
def test_bad_input_is_refused(name, world, record_property, pytestconfig):
    strategy, check = PROPERTIES[name]
    examples = LONG if pytestconfig.getoption("--slow") else SHORT
    examples, tried = min(examples, DEAR.get(name, examples)), 0

    quiet: dict[str, Any] = dict(database=None, deadline=None, suppress_health_check=list(HealthCheck))

    @settings(max_examples=examples, derandomize=True, **quiet)
    @given(strategy)
    def try_one(example):
        nonlocal tried
        check(example, world)
        tried += 1

    try_one()
    record_property("bad inputs", tried)
    assert tried >= examples


def test_the_slow_run_tries_five_thousand_bad_inputs():
    assert sum(DEAR.get(name, LONG) for name in PROPERTIES) >= 5000


def test_the_documents_make_sense(world):
    for content in DOCUMENTS:
        Path("scene.toml").write_text(document(content))
        read_scene_file("scene.toml")
        with pytest.raises(Accepted):
            main(["solve", "scene.toml"])


def test_a_full_disk_leaves_the_old_picture(world, monkeypatch):
    Path("scene.toml").write_text(document(DOCUMENTS[1]))
    monkeypatch.setattr(rj, "describe", lambda equilibrium: "described")
    monkeypatch.setattr(rj, "solve", lambda scene, **options: world.samples.single)
    monkeypatch.setattr("rodjax.plot.plot_rod", lambda equilibrium: Picture())
    Path("a.png").write_bytes(b"old")
    with full_disk(1000):
        assert "cannot write a.png: File too large" in world.refused("solve", "scene.toml", "--plot", "a.png")
    assert Path("a.png").read_bytes() == b"old"


PRINT_IN_VAIN = """
import sys
import rodjax.cli
rodjax.cli.run_solve = lambda arguments: print("result") or 0
sys.exit(rodjax.cli.main(["solve", "scene.toml"]))
"""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_for_what_is_printed_is_one_line():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-c", PRINT_IN_VAIN]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "rodjax: [Errno 28] No space left on device\n")


@pytest.mark.skipif(sys.platform == "win32", reason="where nobody reads is another error")
def test_where_nobody_reads_on_there_is_no_message():
    """As after `| head`."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-c", PRINT_IN_VAIN]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")
