"""Results of harnesses in files: to the last bit, for ParaView, and of which format."""

import h5py
import jax
import numpy as np
import pytest
from vtkmodules.vtkIOHDF import vtkHDFReader

import rodjax
from rodjax import Body, Clamp, Harness, HarnessEquilibrium, Hinge, Joint, Rod, Scene, Slider, Spring
from rodjax.io.files import FIELDS, FORMAT, HARNESS_FIELDS, HARNESS_FORMAT, load, save

GRAVITY = (0.0, 3.0, -9.81)
ALONG = rodjax.frame((1, 0, 0))


def branching(load: float) -> Harness:
    """Rods of two structures, one between the rods of the other; a loaded body, and one on a spring."""
    plain = Rod.circular(0.5, 0.005, 1e7, poisson_ratio=0.5, density=1200.0)
    strip = Rod(0.5, (plain.EI, 2 * plain.EI), plain.GJ, plain.EA, plain.mass_per_length, rest_twist=1 / 3)
    joint = Joint("a/b", ALONG, (0.01, 0.0, 1 / 300))
    cables = {
        "the trunk": Scene(plain, Clamp((0, 0, 0), ALONG), joint, gravity=GRAVITY),
        "strip": Scene(strip, joint, Joint("far", ALONG), gravity=GRAVITY),
        "the-trunk": Scene(plain, joint, Clamp((0.8, 0.3, 0.0), ALONG), gravity=GRAVITY),
    }
    soft = Spring(Clamp((0.95, 0.0, 0.0), np.eye(3)), 50.0, np.diag([1.0, 2.0, 1 / 3]))
    return Harness(cables, {"a/b": Body((0.0, 0.0, load), mass=0.01), "far": Body(support=soft)})


@pytest.fixture(scope="module")
def path() -> HarnessEquilibrium:
    return rodjax.solve_path([branching(0.0), branching(0.1)], segments=4)


@pytest.fixture(scope="module")
def single(path) -> HarnessEquilibrium:
    assert path.members == ((0, 2), (1,))
    return jax.tree.map(lambda leaf: leaf[1], path)


def assert_same(actual, expected) -> None:
    """The same tree and the same arrays, to the last bit."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


@pytest.mark.parametrize("kind", ["single", "path"])
def test_a_harness_comes_back_to_the_last_bit(kind, request, tmp_path):
    result = request.getfixturevalue(kind)
    save(result, tmp_path / "harness.vtkhdf")
    assert_same(load(tmp_path / "harness.vtkhdf"), result)


def test_what_was_loaded_is_a_guess(single, tmp_path):
    save(single, tmp_path / "harness.vtkhdf")
    loaded = load(tmp_path / "harness.vtkhdf")
    assert isinstance(loaded, HarnessEquilibrium)
    assert rodjax.solve(loaded.harness, segments=4, guess=loaded).iterations == 0


def test_paraview_shows_all_cables_and_joints(path, tmp_path):
    save(path, tmp_path / "harness.vtkhdf")
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "harness.vtkhdf"))
    reader.Update()
    shown = reader.GetOutputDataObject(0)
    names = [shown.GetMetaData(k).Get(shown.NAME()) for k in range(shown.GetNumberOfPartitionedDataSets())]
    cables = ["the_trunk", "strip", "the_trunk_2"]
    supports = ["the_trunk_supports", "strip_supports", "the_trunk_supports_2"]
    assert sorted(names) == sorted([*cables, *supports, "joints"])
    for name, rod in zip(cables, path.values(), strict=True):
        points = shown.GetPartition(names.index(name), 0).GetPoints()
        found = [points.GetPoint(0), points.GetPoint(points.GetNumberOfPoints() - 1)]
        np.testing.assert_allclose(found, rod.nodes[0, [0, -1]], rtol=0, atol=1e-7)  # of single precision
    assert shown.GetPartition(names.index("joints"), 0).GetNumberOfPoints() == 2


def test_every_dataset_of_a_harness_has_units_and_a_description(single, tmp_path):
    held = [Hinge((0, 0, 0), ALONG, (0, 1, 0)), Slider((0, 0, 0), [(1, 0, 0)]), single.harness.bodies[1].support]
    seen = set()
    for support in held:
        bodies = Body((1, 0, 0), (0, 1, 0), 1.0, support), single.harness.bodies[1]
        harness = Harness(
            dict(zip(single.names, single.harness.scenes, strict=True)), dict(zip(("a/b", "far"), bodies, strict=True))
        )
        result = HarnessEquilibrium(**{**vars(single), "harness": harness})
        save(result, tmp_path / "harness.vtkhdf")
        assert_same(load(tmp_path / "harness.vtkhdf"), jax.tree.map(jax.numpy.asarray, result))

        def look(_: str, entry: h5py.Group | h5py.Dataset) -> None:
            if isinstance(entry, h5py.Dataset):
                seen.add(tuple(entry.attrs[name] for name in ("units", "description")))
                assert all(entry.attrs[name] for name in ("units", "description"))

        with h5py.File(tmp_path / "harness.vtkhdf", "r") as file:
            file["rodjax"].visititems(look)
    assert seen >= set(HARNESS_FIELDS.values())
    assert seen <= set(HARNESS_FIELDS.values()) | set(FIELDS.values())


def test_files_of_harnesses_have_a_format_of_their_own(single, tmp_path):
    """So that rodjax of format 13 tells to be updated; those of single rods it reads as before."""
    save(single, tmp_path / "harness.vtkhdf")
    save(single["strip"], tmp_path / "strip.vtkhdf")
    with h5py.File(tmp_path / "strip.vtkhdf", "r") as file:
        assert file["rodjax"].attrs["format"] == FORMAT == 13
    with h5py.File(tmp_path / "harness.vtkhdf", "r+") as file:
        assert file["rodjax"].attrs["format"] == HARNESS_FORMAT == 15
        file["rodjax"].attrs["format"] = 16
    with pytest.raises(ValueError, match=r"has format 16, written by .* reads formats up to 15: update it"):
        load(tmp_path / "harness.vtkhdf")


def test_files_without_contacts_are_read(path, tmp_path):
    """Of format 14, before rods of harnesses touched anything."""
    save(path, tmp_path / "harness.vtkhdf")
    with h5py.File(tmp_path / "harness.vtkhdf", "r+") as file:
        file["rodjax"].attrs["format"] = 14
        for name in ("contact_forces", "end_pressures"):
            del file["rodjax"][name]
    assert_same(load(tmp_path / "harness.vtkhdf"), path)


def test_damage_is_told(single, tmp_path):
    for place, message in (
        ("rodjax/cables/0/joints/end/offset", "lacks /rodjax/cables/0/joints/end/offset"),
        ("rodjax/cables/1", "has no group /1"),
        ("rodjax/positions", "lacks /rodjax/positions"),
    ):
        save(single, tmp_path / "harness.vtkhdf")
        with h5py.File(tmp_path / "harness.vtkhdf", "r+") as file:
            del file[place]
        with pytest.raises(ValueError, match=message):
            load(tmp_path / "harness.vtkhdf")
