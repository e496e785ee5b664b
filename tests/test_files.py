"""save() and load(): bitwise round trips, what VTK reads, files that are always whole, and errors in words."""

import dataclasses
import errno
import functools
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_scenes
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkIOHDF import vtkHDFReader

import rodjax as rj
from rodjax import (
    Clamp,
    Clip,
    DistributedCouple,
    DistributedForce,
    Equilibrium,
    Free,
    Law,
    Pin,
    PointCouple,
    PointForce,
    Rod,
    Scene,
    Smooth,
    Steps,
    Swivel,
    frame,
    problems,
    solve,
    solve_path,
)
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.hermite import Curve
from rodjax.discretization.nodal_point import Friction
from rodjax.io.files import FIELDS, FORMAT, KINDS, OLDEST_FORMAT, load, save
from rodjax.mechanics.passage import Before
from rodjax.solving.result_form import form_and_point

ORIGIN, FAR, GRAVITY = (0.0, 0.0, 0.0), (0.7, 0.1, 0.0), (0.0, 0.3, -9.81)
CLAMP = Clamp(ORIGIN, frame((1, 0, 0)))


def scene_with_everything(twist: float) -> Scene:
    """Clamps, gravity, turns and two point forces."""
    forces = [PointForce(0.43, (0.001, 0.0, 0.002)), PointForce(0.8, (0.0, 0.001, 0.0))]
    end = Clamp(FAR, frame((1, 0.3, 0), (0, np.cos(twist), np.sin(twist))))
    return Scene(problems.cable(), CLAMP, end, GRAVITY, forces, turns=1)


# Every kind of support and load at both ends; a rod without radius.
SCENES = {
    "clamps": scene_with_everything(0.0),
    "swivels": Scene(problems.cable(), Swivel(ORIGIN, (1, 0, 1)), Swivel(FAR, (0, 0, 1))),
    "pins": Scene(Rod(1.0, 1 / 3, 0.2, 1e4), Pin(ORIGIN), Pin(FAR)),
    "free end": Scene(problems.cable(), CLAMP, Free((0, 0.1, 1 / 3), (0.1, 0, 0)), GRAVITY),
    "free start": Scene(problems.cable(), Free((0, 0.1, 1 / 3), (0.1, 0, 0)), CLAMP),
}


def steps(value: float) -> Steps:
    return Steps((1 / 3, 0.6), value * np.array([1.0, 1.5, 1 / 3]))


def smooth(value: float) -> Smooth:
    return Smooth((0.0, 0.3, 0.7, 1.0), value * np.array([1.0, 1 / 3, 0.7, 1.2]))


GENERAL = ("numbers", "steps", "smooth", "both", "curve", "one stiffness", *(f"shear {k}" for k in range(5)))


@functools.cache
def general_scene(name: str) -> Scene:
    """Of rods that vary, have two bending stiffnesses or a rest shape, and of loads that follow them."""
    angles = np.linspace(0, 1.5, 6)
    arc = np.stack([np.sin(angles), 0 * angles, 1 - np.cos(angles)], axis=1)
    follower, dead = DistributedForce((0, 0.001, 1 / 300), follower=True), DistributedForce((0, 0.001, 0.0))
    couple = DistributedCouple((0, 1e-5, 0), follower=True)
    if name.startswith("shear"):
        GA, strain = [
            (300.0, 0.01),
            (steps(300.0), steps(0.01)),
            (smooth(300.0), smooth(0.01)),
            ((300.0, 200.0), None),
            ((steps(300.0), smooth(300.0)), 0.01),
        ][int(name[-1])]
        loads = {
            "point_couples": [PointCouple(0.4, (0, 1e-5, 0)), PointCouple(0.5, (0, 1e-5, 0), follower=True)],
            "point_forces": [PointForce(0.6, (0, 1e-5, 0), follower=True)],
            "distributed": [
                dataclasses.replace(load, part=jnp.array([0.2, 1 / 3])) for load in (follower, dead, couple)
            ],
        }
        return Scene(Rod(1.0, 4e-3, 3e-3, 500.0, GA=GA, rest_strain=strain), CLAMP, Free(), **loads)
    rod, end, distributed = {
        "numbers": (Rod(1.0, (4e-3, 1 / 300), 3e-3, 500.0, 0.1, None, (0.1, 1 / 3), 1 / 7), Free(), ()),
        "steps": (Rod(1.0, steps(4e-3), steps(3e-3), steps(1e3), steps(0.1), steps(0.01)), Free(), [follower]),
        "smooth": (
            Rod(1.0, smooth(4e-3), smooth(3e-3), smooth(1e3), smooth(0.1), smooth(0.01)),
            Free(ORIGIN, ORIGIN, True),
            (),
        ),
        "both": (
            Rod(1.0, (steps(4e-3), smooth(4e-3)), 3e-3, 500.0, 0.0, None, (smooth(0.3), steps(0.2)), smooth(0.2)),
            Free((0.0, 1e-3, 0.0), follower=True),
            [couple, dead, follower],
        ),
        "curve": (Rod.from_centerline(arc, (4e-3, 3e-3), 3e-3, 500.0), Free(), [dead, DistributedCouple((0, 0, 1e-5))]),
        "one stiffness": (Rod(1.0, 4e-3, 3e-3, 500.0, rest_twist=steps(0.2)), Free(), [couple]),
    }[name]
    return Scene(rod, CLAMP, end, (0.0, 0.0, -0.5), distributed=distributed)


@pytest.fixture(scope="session")
def single() -> Equilibrium:
    return solve(problems.omega(1.0, 0.3), segments=8)


@pytest.fixture(scope="session")
def path_of_three(single) -> Equilibrium:
    return solve_path([problems.omega(1.0, turn) for turn in (0.3, 0.6, 0.9)], segments=8, guess=single)


@pytest.fixture(scope="session")
def loaded_path() -> Equilibrium:
    """By finite differences."""
    scenes = [scene_with_everything(twist) for twist in (0.0, 0.1, 0.2)]
    path = solve_path(scenes, segments=8, discretization="finite_difference")
    assert np.all(path.converged)
    return path


@pytest.fixture(params=["single", "path_of_three", "loaded_path"])
def equilibrium(request) -> Equilibrium:
    return request.getfixturevalue(request.param)


@pytest.fixture
def saved(single, tmp_path):
    save(single, tmp_path / "rod.vtkhdf")
    return tmp_path / "rod.vtkhdf"


def assert_same(actual: Equilibrium, expected: Equilibrium) -> None:
    """The same tree and the same arrays, to the last bit."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


def with_frames(result: Equilibrium, count: int) -> Equilibrium:
    """The result with so many frames of any kind for the state of its solver."""
    shape = result.state.shape
    framed = FramedCurve(shape.nodes, jnp.ones((4, count)) / 2, jnp.linspace(0.0, 1.0, len(shape.nodes)))
    return eqx.tree_at(lambda result: result.state.shape, result, framed)


@pytest.fixture
def no_picture(monkeypatch):
    """For results put together of parts that do not belong to one another, of which there is nothing to draw."""
    monkeypatch.setattr("rodjax.io.files.write_picture", lambda root, equilibrium: None)


# --- round trip -----------------------------------------------------------------------------------------------------


def test_load_gives_back_every_bit(equilibrium, tmp_path):
    save(equilibrium, tmp_path / "rod.vtkhdf")
    assert_same(load(tmp_path / "rod.vtkhdf"), equilibrium)


def test_the_error_is_estimated_after_load_too(equilibrium, tmp_path):
    save(equilibrium, tmp_path / "rod.vtkhdf")
    estimate = load(tmp_path / "rod.vtkhdf").error_estimate
    np.testing.assert_array_equal(estimate, equilibrium.error_estimate)
    assert np.all(estimate > 0)


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize("count", [None, 2])
@pytest.mark.parametrize("name", [*SCENES, *GENERAL])
def test_every_kind_of_scene_comes_back(name, count, single, tmp_path):
    of_scene = dataclasses.replace(single, scene=SCENES[name] if name in SCENES else general_scene(name))
    if count is not None:
        of_scene = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf + leaf]), of_scene)
    save(of_scene, str(tmp_path / "rod.vtkhdf"))
    assert_same(load(str(tmp_path / "rod.vtkhdf")), of_scene)


@pytest.mark.usefixtures("no_picture")
def test_scenes_of_every_class_come_back_whatever_their_sizes(single, tmp_path):
    """The sizes of a scene's arrays have nothing to do with the mesh: some were taken for those of its nodes."""
    rng, seen = np.random.default_rng(1), set()

    def look(name: str, entry: h5py.Group | h5py.Dataset) -> None:
        if name.startswith("scene/"):
            seen.add(str(entry.attrs.get("kind", re.sub(r"/\d+(?=/|$)", "/*", name))))

    for k in range(60):
        result = dataclasses.replace(single, scene=random_scenes.scene(rng))
        if k % 3 == 0:  # steps of a path
            count = int(rng.integers(1, 12))
            result = jax.tree.map(lambda leaf, count=count: jnp.asarray(np.stack([leaf] * count)), result)
        save(result, tmp_path / "rod.vtkhdf")
        assert_same(load(tmp_path / "rod.vtkhdf"), result)
        with h5py.File(tmp_path / "rod.vtkhdf", "r") as file:
            group = file["rodjax"]
            assert isinstance(group, h5py.Group)
            group.visititems(look)
    kinds = {name for name, kind in KINDS.items() if not issubclass(kind, Polyline | Curve | FramedCurve)}
    everywhere = ("scene/clips", "scene/point_", "scene/distributed", "scene/rod/GA", "scene/rod/rest_strain")
    assert seen >= kinds | {place for place in FIELDS if place.startswith(everywhere)} | {"scene/obstacles/*/friction"}


@pytest.mark.parametrize(
    ("name", "discretization"),
    [
        ("steps", "hermite"),
        ("numbers", "finite_difference"),
        pytest.param("both", "hermite", marks=pytest.mark.slow),
        pytest.param("curve", "hermite", marks=pytest.mark.slow),
        pytest.param("one stiffness", "hermite", marks=pytest.mark.slow),
    ],
)
def test_results_with_frames_come_back(name, discretization, tmp_path):
    solved = solve(general_scene(name), segments=4, discretization=discretization)
    assert bool(solved.converged)
    assert isinstance(solved.state.shape, FramedCurve)
    save(solved, tmp_path / "rod.vtkhdf")
    assert_same(load(tmp_path / "rod.vtkhdf"), solved)


@pytest.mark.parametrize("ends", [(CLAMP, Free()), (Free(), CLAMP)])
def test_forces_of_spans_are_read(ends):
    """Under follower loads files until format 10 have forces in spans, not in elements: none where one end is free."""
    loads = [DistributedForce((0, 0.001, 1 / 300), follower=True), DistributedForce((0, 0.001, 0.0))]
    solved = solve(Scene(Rod(1.0, (4e-3, 3e-3), 3e-3, 500.0), *ends, distributed=loads), segments=4)
    older = eqx.tree_at(lambda result: result.state.end_force, solved, jnp.zeros((3, 1)))
    (_, point), (_, read) = form_and_point(solved), form_and_point(older)
    # To the residual of 1e-8 EI/L^2.
    np.testing.assert_allclose(read.end_force, point.end_force, atol=1e-8)


@pytest.mark.usefixtures("no_picture")
def test_results_that_no_form_has_are_refused(tmp_path):
    """Rods by frames under loads without a potential by finite differences, as files until format 10 may have them."""
    solved = solve(general_scene("numbers"), segments=4, discretization="finite_difference")
    follower = (DistributedForce((0, 0.001, 1 / 300), follower=True),)
    older = eqx.tree_at(lambda result: result.scene.distributed, solved, follower)
    save(older, tmp_path / "rod.vtkhdf")
    with pytest.raises(ValueError, match=r"rod\.vtkhdf is a result by finite differences .* solve its scene again"):
        load(tmp_path / "rod.vtkhdf")


@pytest.mark.slow
def test_a_path_with_frames_comes_back(tmp_path):
    scenes = [dataclasses.replace(general_scene("steps"), gravity=jnp.array([0.0, 0.0, g])) for g in (-0.5, -0.6, -0.7)]
    path = solve_path(scenes, segments=4)
    assert np.all(path.converged)
    save(path, tmp_path / "rod.vtkhdf")
    assert_same(load(tmp_path / "rod.vtkhdf"), path)


def test_results_of_ends_that_move_come_back(tmp_path):
    ends = rj.Spring(CLAMP, translation=1e3), rj.Hinge(FAR, frame((1, 0, 0)), (0, 1, 0))
    scene = Scene(problems.cable(), *ends, GRAVITY)
    solved = solve(scene, segments=8)
    assert bool(solved.converged)
    save(solved, tmp_path / "rod.vtkhdf")
    assert_same(load(tmp_path / "rod.vtkhdf"), solved)


class Hardening(Law):
    """Stiffer where it is bent more."""

    factor: jax.Array

    def __call__(self, curvature, twist, axial_strain, s):
        return self.factor * jnp.sum(curvature**4)


def test_a_law_cannot_be_saved(single, tmp_path):
    law = Hardening(jnp.asarray(0.1))
    of_law = eqx.tree_at(lambda result: result.scene.rod.law, single, law, is_leaf=lambda leaf: leaf is None)
    with pytest.raises(ValueError, match=r"scene\.rod\.law must be None, got a Hardening: a law is code.* be saved"):
        save(of_law, tmp_path / "rod.vtkhdf")
    assert not os.listdir(tmp_path)


@pytest.mark.usefixtures("no_picture")
def test_not_a_number_and_float32_survive(single, tmp_path):
    odd = dataclasses.replace(single, residual=jnp.asarray(np.nan), tension=single.tension.astype(jnp.float32))
    save(odd, tmp_path / "rod.vtkhdf")
    assert_same(load(tmp_path / "rod.vtkhdf"), odd)


def test_warm_start_from_a_file_takes_no_iteration(single, saved):
    again = solve(problems.omega(1.0, 0.3), segments=8, guess=load(saved))
    assert int(again.iterations) == 0
    np.testing.assert_array_equal(again.nodes, single.nodes)
    assert_same(again, solve(problems.omega(1.0, 0.3), segments=8, guess=single))


def test_same_result_gives_the_same_bytes(single, saved):
    first = saved.read_bytes()
    save(single, saved)
    assert saved.read_bytes() == first


# --- what is in the file --------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_picture")
def test_every_dataset_has_units_and_a_description(single, loaded_path, tmp_path):
    seen = set()

    def look(name: str, entry: h5py.Group | h5py.Dataset) -> None:
        if isinstance(entry, h5py.Dataset):
            place = re.sub(r"/\d+(?=/|$)", "/*", name)
            seen.add(place)
            assert (entry.attrs["units"], entry.attrs["description"]) == FIELDS[place]
            assert all(FIELDS[place])

    scene = single.scene
    clips = [Clip(0.5, (0.4, 0.0, 0.0), (1.0, 0.0, 0.0), sliding=True), Clip(0.6, (0.45, 0.0, 0.0), frame=np.eye(3))]
    clipped = Scene(scene.rod, scene.start, scene.end, scene.gravity, scene.point_forces, clips=clips)
    corners = [(0, 0, -1), (1, 0, -1), (0, 1, -1), (0, 0, -2)]
    bodies = [
        rj.Plane((0, 0, -2), (0, 0, 1)),
        rj.Cylinder((0, 0, -2), (1, 0, -2), 0.1),
        rj.Pipe([(0, 0, -2), (1, 0, -2)], 0.1),
        rj.Box((0, 0, -2), (1, 1, 1), np.eye(3)),
        rj.Sphere((0, 0, -2), 0.1),
        rj.Mesh(corners, [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]),
    ]
    obstacles = [*bodies, rj.Union(*bodies, rj.Union(*bodies), friction=0.2)]
    touching = Scene(scene.rod, scene.start, scene.end, scene.gravity, scene.point_forces, obstacles=obstacles)
    scenes = [*SCENES.values(), *map(general_scene, GENERAL), clipped, touching]
    results = [loaded_path, with_frames(single, 10), *(dataclasses.replace(single, scene=scene) for scene in scenes)]
    before = Before(single.nodes, touching.obstacles)
    state = dataclasses.replace(single.state, arclengths=single.s[:1], clip_moments=single.nodes[:1], before=before)
    state = dataclasses.replace(state, pressures=single.s[None], friction=Friction.from_rest(1, single.nodes))
    results.append(dataclasses.replace(single, state=state))
    results.append(dataclasses.replace(single, shear_strain=single.nodes[:, :2], free_index=single.iterations))
    for result in results:
        save(result, tmp_path / "rod.vtkhdf")
        with h5py.File(tmp_path / "rod.vtkhdf", "r") as file:
            group = file["rodjax"]
            assert isinstance(group, h5py.Group)
            group.visititems(look)
    assert seen == set(FIELDS)


def test_the_file_names_its_format_and_its_classes(saved):
    with h5py.File(saved, "r") as file:
        assert file["rodjax"].attrs["format"] == FORMAT
        assert re.fullmatch(r"\d+\.\d+\.\d+.*", str(file["rodjax"].attrs["version"]))
        assert file["rodjax"].attrs["discretization"] == "hermite"
        kinds = {place: file[f"rodjax/{place}"].attrs["kind"] for place in ("scene/start", "scene/end", "state/shape")}
    assert kinds == {"scene/start": "Clamp", "scene/end": "Clamp", "state/shape": "Curve"}


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize("count", [10, 17])
def test_frames_are_as_many_as_a_mesh_of_their_nodes_has(count, single, tmp_path):
    framed = with_frames(single, count)
    save(framed, tmp_path / "rod.vtkhdf")
    assert_same(load(tmp_path / "rod.vtkhdf"), framed)
    save(with_frames(single, count + 1), tmp_path / "rod.vtkhdf")
    with pytest.raises(ValueError, match=r"quaternions must be Float of shape \(4, 17 or 10\), got .*\(4, 1[18]\)"):
        load(tmp_path / "rod.vtkhdf")


@pytest.mark.usefixtures("no_picture")
def test_alongs_and_loads_along_the_rod_name_their_classes(single, tmp_path):
    save(dataclasses.replace(single, scene=general_scene("both")), tmp_path / "rod.vtkhdf")
    places = {"rod/EI/0": "Steps", "rod/EI/1": "Smooth", "rod/rest_twist": "Smooth"}
    places |= {f"distributed/{k}": f"Distributed{name}" for k, name in enumerate(("Couple", "Force", "Force"))}
    with h5py.File(tmp_path / "rod.vtkhdf", "r+") as file:
        attributes = {place: file[f"rodjax/scene/{place}"].attrs for place in places}
        assert {place: entry["kind"] for place, entry in attributes.items()} == places
        assert [bool(attributes[f"distributed/{k}"]["follower"]) for k in range(3)] == [True, False, True]
        attributes["distributed/0"]["kind"] = "Clamp"
    with pytest.raises(ValueError, match=r"distributed/0 that it is Clamp; allowed are DistributedForce, Distrib"):
        load(tmp_path / "rod.vtkhdf")


@pytest.mark.usefixtures("no_picture")
def test_a_follower_is_true_or_false(single, tmp_path):
    save(dataclasses.replace(single, scene=general_scene("both")), tmp_path / "rod.vtkhdf")
    with h5py.File(tmp_path / "rod.vtkhdf", "r+") as file:
        file["rodjax/scene/end"].attrs["follower"] = "hermite"
    with pytest.raises(ValueError, match=r"follower of /rodjax/scene/end must be true or false, got 'hermite'"):
        load(tmp_path / "rod.vtkhdf")


@pytest.mark.parametrize("place", ["scene/start", "state/shape"])
def test_a_group_of_no_known_kind_is_named(place, saved, tmp_path):
    damaged = tmp_path / "damaged.vtkhdf"
    damaged.write_bytes(saved.read_bytes())
    for kind in ("Spring", None):
        with h5py.File(damaged, "r+") as file:
            attributes = file[f"rodjax/{place}"].attrs
            attributes.update({"kind": kind}) if kind else attributes.pop("kind")
        with pytest.raises(ValueError, match=f"says of /rodjax/{place} that it is {kind}; allowed are (Clamp|Poly)"):
            load(damaged)


def test_vtk_takes_the_number_of_the_step_for_the_time(path_of_three, tmp_path):
    save(path_of_three, tmp_path / "rod.vtkhdf")
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "rod.vtkhdf"))
    reader.UpdateInformation()
    information = reader.GetOutputInformation(0)
    assert information.Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) == (0.0, 1.0, 2.0)


# --- a file is the old one or the new one ---------------------------------------------------------------------------


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_failed_write_leaves_the_old_file_and_nothing_else(step, path_of_three, single, saved, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match=r"rod\.vtkhdf: No space left on device") as raised:
        save(path_of_three, saved)
    monkeypatch.undo()
    assert raised.value.errno == errno.ENOSPC
    assert os.listdir(saved.parent) == ["rod.vtkhdf"]
    assert_same(load(saved), single)


def test_interrupted_write_leaves_the_old_file_and_nothing_else(path_of_three, single, saved, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save(path_of_three, saved)
    assert os.listdir(saved.parent) == ["rod.vtkhdf"]
    assert_same(load(saved), single)


WRITE_FOREVER = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
from rodjax.io.files import load, save
versions = [load(path) for path in sys.argv[2:]]
save(versions[0], sys.argv[1])
print("writing", flush=True)
while True:
    for version in versions:
        save(version, sys.argv[1])
"""


def test_killed_writer_leaves_a_whole_file(path_of_three, tmp_path):
    long = jax.tree.map(lambda leaf: jnp.repeat(leaf, 100, axis=0), path_of_three)
    versions = [long, dataclasses.replace(long, energy=-long.energy)]
    sources = [tmp_path / "first.vtkhdf", tmp_path / "second.vtkhdf"]
    for version, source in zip(versions, sources, strict=True):
        save(version, source)
    whole = sources[0].stat().st_size
    (tmp_path / "target").mkdir()
    target = tmp_path / "target" / "rod.vtkhdf"
    for _ in range(2):
        command = [sys.executable, "-c", WRITE_FOREVER, *map(str, [target, *sources])]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"writing\n"
            while not any(0 < size < whole for size in sizes(target.parent)):
                assert writer.poll() is None
            writer.send_signal(signal.SIGKILL)
        found = load(target)
        assert_same(found, versions[int(found.energy[0] != long.energy[0])])


def sizes(folder: Path) -> list[int]:
    """Sizes of the files in a folder in which files come and go."""
    found = []
    for file in folder.iterdir():
        with suppress(FileNotFoundError):
            found.append(file.stat().st_size)
    return found


# --- errors ---------------------------------------------------------------------------------------------------------


def test_other_suffixes_are_refused(single, tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.vtkhdf, got .*rod\.h5"):
        save(single, tmp_path / "rod.h5")
    with pytest.raises(ValueError, match=r"must end in \.vtkhdf, got 'rod'"):
        load("rod")


def test_only_an_equilibrium_can_be_saved(single, tmp_path):
    with pytest.raises(TypeError, match=r"equilibrium must be an? Equilibrium"):
        save(single.nodes, tmp_path / "rod.vtkhdf")


def test_two_leading_axes_are_refused(path_of_three, tmp_path):
    grid = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), path_of_three)
    with pytest.raises(ValueError, match=r"one leading axis, got leading axes \(2, 3\)"):
        save(grid, tmp_path / "rod.vtkhdf")
    assert not os.listdir(tmp_path)


def test_traced_results_are_refused(single, tmp_path):
    with pytest.raises(ValueError, match=r"call save outside jax\.jit"):
        eqx.filter_jit(lambda equilibrium: save(equilibrium, tmp_path / "rod.vtkhdf"))(single)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.vtkhdf"):
        load(tmp_path / "nowhere.vtkhdf")


def test_folders_that_cannot_be_written_are_named(single, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"cannot write rod\.vtkhdf: No such file or directory.*/nowhere'"):
        save(single, tmp_path / "nowhere" / "rod.vtkhdf")
    (tmp_path / "note").touch()
    with pytest.raises(NotADirectoryError, match=r"cannot write rod\.vtkhdf: Not a directory.*/note'"):
        save(single, tmp_path / "note" / "rod.vtkhdf")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folders_without_permission_are_named(single, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError, match=r"cannot write rod\.vtkhdf: Permission denied"):
        save(single, tmp_path / "rod.vtkhdf")


@pytest.mark.parametrize("part", [0.0, 0.5, 0.99])
def test_a_file_cut_short_is_refused(part, saved):
    saved.write_bytes(saved.read_bytes()[: int(part * saved.stat().st_size)])
    with pytest.raises(ValueError, match=r"rod\.vtkhdf is not a readable HDF5 file"):
        load(saved)


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        ("VTKHDF", "has no group /VTKHDF: load reads files that rodjax.save wrote"),
        ("rodjax", "has no group /rodjax: load reads files that rodjax.save wrote"),
        ("rodjax/end_force", "lacks /rodjax/end_force"),
        ("rodjax/state", "lacks /rodjax/state"),
        ("rodjax/state/units/length", "lacks /rodjax/state/units/length"),
        ("rodjax/scene", "lacks /rodjax/scene"),
        ("rodjax/scene/rod/EI", "lacks /rodjax/scene/rod/EI"),
    ],
)
def test_what_a_file_lacks_is_named(missing, message, saved):
    with h5py.File(saved, "r+") as file:
        del file[missing]
    with pytest.raises(ValueError, match=rf"rod\.vtkhdf {message}"):
        load(saved)


def test_the_oldest_format_that_lacks_nothing_is_read(saved):
    expected = load(saved)
    with h5py.File(saved, "r+") as file:
        file["rodjax"].attrs.update({"format": OLDEST_FORMAT, "version": "0.0"})
        force = file["rodjax/state/end_force"][...]
        del file["rodjax/state/end_force"]
        file["rodjax/state/end_force"] = force[..., 0]  # as rods without clips had it
    jax.tree.map(np.testing.assert_array_equal, load(saved), expected)


def test_other_and_absent_formats_are_refused(saved):
    with h5py.File(saved, "r+") as file:
        file["rodjax"].attrs.update({"format": FORMAT + 1, "version": "9.0"})
    with pytest.raises(ValueError, match=rf"format {FORMAT + 1}, written by rodjax 9\.0; .* up to {FORMAT}: update it"):
        load(saved)
    with h5py.File(saved, "r+") as file:
        file["rodjax"].attrs.update({"format": 1, "version": "0.0"})
    with pytest.raises(ValueError, match=r"format 1, written by rodjax 0\.0, .* solve its scene again"):
        load(saved)
    with h5py.File(saved, "r+") as file:
        del file["rodjax"].attrs["format"]
    with pytest.raises(ValueError, match="lacks the attribute format of /rodjax"):
        load(saved)


def test_numbers_are_never_rounded_silently(saved, single):
    with jax.enable_x64(False), pytest.warns(rj.PrecisionWarning, match=r"holds float64 numbers, .*jax_enable_x64"):
        rounded = load(saved)
    assert rounded.nodes.dtype == np.float32
    np.testing.assert_allclose(rounded.nodes, single.nodes, atol=1e-7)  # half a rounding of 1 m
