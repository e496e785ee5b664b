"""save() and load(): an `Equilibrium`, or that of a harness, in one VTKHDF file, which ParaView draws and rodjax reads
back to the last bit.

The file is HDF5 with two groups. `/VTKHDF` holds the picture, for ParaView and other programs on VTK: see `vtk_parts`.
`/rodjax` holds every field of `Equilibrium` under its own name, each with the attributes `units` and `description`, so
that `load` needs no pickle and other programs need no rodjax. Of a harness `/rodjax/cables/0`, ... hold these fields of
each rod, and `joints/start`, `joints/end` there how it is fixed in a joint; `/rodjax/joints/0`, ... hold what acts on
these. A hash follows after the end of the HDF5 file, by which `load` finds damage.
"""

import dataclasses
import io
import os
import types
import typing
from pathlib import Path
from typing import Any

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np

from rodjax.atomic_write import has_seal, replace_file, seal
from rodjax.checks import file_path, instance, is_known, one_of, shown
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.framed_curve import FramedCurve
from rodjax.discretization.hermite import Curve
from rodjax.io.vtk_parts import write_picture
from rodjax.model.along import Smooth, Steps
from rodjax.model.harness import ENDS, Body, Harness
from rodjax.model.loads import DistributedCouple, DistributedForce
from rodjax.model.obstacles import Box, Capsule, Cylinder, Obstacle, Pipe, Plane, Sphere, Union
from rodjax.model.scene import Scene, has_node_positions, under_contact
from rodjax.model.supports import Clamp, Free, Hinge, Joint, Pin, Slider, Spring, Swivel
from rodjax.model.triangle_mesh import Mesh
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_warnings import PrecisionWarning
from rodjax.solving.status import Status
from rodjax.version import __version__
from rodjax.warn import warn

SUFFIX = ".vtkhdf"
# Of the group /rodjax. Raise it where an older rodjax could not read what this one writes, and with it the oldest one
# that this one reads where fields are asked for that the older ones lack.
FORMAT = 13
OLDEST_FORMAT = 7
# Of the equilibrium of a harness, which rodjax of format 13 cannot read.
HARNESS_FORMAT = 15
# Of a rod that touches itself.
SELF_CONTACT_FORMAT = 16
# Of a harness whose rods may touch one another; before it, 17, all wells were narrow.
ROD_CONTACT_FORMAT = 18

# What files of harnesses lack until format 14, which had no obstacles.
_OF_CONTACTS = ("contact_forces", "end_pressures")
# What those lack whose rods do not touch one another, and what older ones lack.
_OF_ROD_CONTACTS, _OF_WELLS = ("rod_pressures", "wide_wells"), "wide_wells"

# The name in files of a field that the code names otherwise.
STORED_AS = {"arclengths": "places"}

# Units and meaning of each field, by its path under /rodjax.
FIELDS = {
    "s": ("m", "arclength of the nodes"),
    "nodes": ("m", "centerline"),
    "frames": ("1", "material frames at the nodes, columns d1, d2, t"),
    "curvature": ("1/m", "|t x t'| at the nodes"),
    "twist": ("rad/m", "twist Omega at the nodes"),
    "total_twist": ("rad", "integral of the twist, not reduced by whole turns"),
    "tension": ("N", "tension at the nodes"),
    "axial_strain": ("1", "axial strain |phi'| - 1 at the nodes, with shear along d3"),
    "shear_strain": ("1", "with shear: components of phi' along d1 and d2 at the nodes"),
    "energy": ("J", "elastic energy minus the work of dead forces, zero of height at the origin"),
    "elastic_energy": ("J", "elastic energy"),
    "start_force": ("N", "force of the rod beyond s = 0 on the support there, global axes"),
    "start_moment": ("N m", "moment of the rod beyond s = 0 on the support there, about the centerline, global axes"),
    "end_force": ("N", "force of the support at s = L on the rod, global axes"),
    "end_moment": ("N m", "moment of the support at s = L on the rod, about the centerline, global axes"),
    "converged": ("1", "whether the solve converged"),
    "stable": ("1", "whether the energy has no negative curvature there"),
    "free_index": ("1", "motions along which the energy falls, where the pose of an end was unknown and is free"),
    "status": ("1", "how the solve ended: " + ", ".join(f"{status.value} {status.name}" for status in Status)),
    "iterations": ("1", "iterations of the solver"),
    "evaluations": ("1", "evaluations of the energy and its gradient"),
    "substeps": ("1", "solves that a step of a path took"),
    "residual": ("1", "largest component of the gradient, in EI/L^2"),
    "state/shape/nodes": ("1", "nodes in which the solver works: in state/units/length from state/units/origin"),
    "state/shape/edges": ("1", "finite differences: differences of these nodes, free of the rounding of the positions"),
    "state/shape/tangents": ("1", "Hermite elements: unit tangents at nodes and middles of the elements in turn"),
    "state/shape/quaternions": ("1", "frames of a general rod, at nodes and middles of the elements, or by joints"),
    "state/shape/s": ("1", "Hermite elements and frames: arclength of the nodes as a part of the length"),
    "state/end_force": (
        "1",
        "force at s = L as each span between held places sees it, with obstacles each element, solver's units",
    ),
    "state/places": ("1", "arclengths at which the rod passes its sliding clips, as parts of the length"),
    "state/clip_moments": ("1", "moments of the clips on the rod in the continuum, in the solver's units"),
    "state/before/points": ("m", "with obstacles: where the rod last was sound, at equal steps of arclength"),
    "state/pressures": (
        "1",
        "forces of each obstacle on nodes and within elements, between elements and the rod beyond; solver's units",
    ),
    "state/friction/forces": ("1", "tangential forces of obstacles with friction on each node, in the solver's units"),
    "state/friction/reference": ("m", "nodes in the equilibrium before, from which slips are counted; NaN from rest"),
    "state/units/origin": ("m", "origin of the solver's coordinates"),
    "state/units/length": ("m", "the solver's unit of length, L"),
    "state/units/energy": ("J", "the solver's unit of energy, EI/L"),
    "scene/gravity": ("m/s^2", "gravity"),
    "scene/turns": ("1", "whole turns of the end frame beyond the total twist of the initial shape"),
    "scene/rod/length": ("m", "length of the rod"),
    **{
        f"scene/rod/{place}{leaf}": (leaf_unit or unit, description + what)
        for place, unit, description in (
            ("EI", "N m^2", "bending stiffness"),
            ("EI/*", "N m^2", "bending stiffness about d1 and d2"),
            ("GJ", "N m^2", "torsional stiffness"),
            ("EA", "N", "axial stiffness"),
            ("GA", "N", "shear stiffness"),
            ("GA/*", "N", "shear stiffness along d1 and d2"),
            ("mass_per_length", "kg/m", "mass per length"),
            ("radius", "m", "radius of the rod, for pictures"),
            ("rest_curvature/*", "1/m", "curvature without stress, t x t' along d1 and d2"),
            ("rest_twist", "rad/m", "twist without stress"),
            ("rest_strain", "1", "axial strain without stress"),
        )
        for leaf, leaf_unit, what in (
            ("", "", ""),
            ("/jumps", "m", ": arclengths at which it jumps"),
            ("/s", "m", ": arclengths of the values of a cubic spline"),
            ("/values", "", ": values between the jumps, or at the arclengths s"),
        )
    },
    "scene/rod/rest_centerline/points": ("m", "points of the centerline without stress"),
    "scene/rod/rest_centerline/s": ("1", "arclengths of these points as parts of the length"),
    "scene/rod/rest_centerline/d1": ("1", "directors d1 at these points"),
    "scene/point_forces/*/at": ("m", "arclength at which a force acts"),
    "scene/point_forces/*/force": ("N", "force on the rod, global axes or, of a follower, the frame there"),
    "scene/point_couples/*/at": ("m", "arclength at which a couple acts"),
    "scene/point_couples/*/couple": ("N m", "couple on the rod, global axes or, of a follower, the frame there"),
    "scene/clips/*/at": ("m", "arclength at which a clip holds the rod"),
    "scene/clips/*/position": ("m", "position that a clip holds, global axes"),
    "scene/clips/*/tangent": ("1", "tangent that a clip holds, global axes"),
    "scene/clips/*/frame": ("1", "frame that a clip holds, columns d1, d2, t, global axes"),
    **{
        f"{where}/obstacles/*{part}/{name}": (unit, f"{description}, global axes")
        for where in ("scene", "state/before")
        for part in ("", "/obstacles/*", "/obstacles/*/obstacles/*")
        for name, unit, description in (
            ("point", "m", "point of the plane of a half space"),
            ("normal", "1", "direction out of a half space"),
            ("center", "m", "centre of a ball or box"),
            ("radius", "m", "radius of a ball, capsule, pipe or cylinder"),
            ("start", "m", "where the axis of a capsule or cylinder begins"),
            ("end", "m", "where the axis of a capsule or cylinder ends"),
            ("points", "m", "along the axis of a pipe"),
            ("size", "m", "edges of a box"),
            ("frame", "1", "directions of these edges, in columns"),
            ("triangles", "m", "corners of the triangles of a body"),
        )
    },
    **{f"{where}/obstacles/*/friction": ("1", "coefficient of friction") for where in ("scene", "state/before")},
    "scene/distributed/*/force": ("N/m", "force per length, global axes or, of a follower, material frames"),
    "scene/distributed/*/part": ("m", "arclengths between which a load acts"),
    "scene/distributed/*/couple": ("N m/m", "couple per length, global axes or, of a follower, material frames"),
    **{
        f"scene/{end}/{name}": (unit, f"{description} at s = {place}, {axes}")
        for end, place in (("start", "0"), ("end", "L"))
        for name, unit, description, axes in (
            ("position", "m", "position that the support holds", "global axes"),
            ("frame", "1", "frame that the support holds, columns d1, d2, t,", "global axes"),
            ("tangent", "1", "tangent that the support holds", "global axes"),
            ("force", "N", "force on the rod", "global axes or, of a follower, the frame there"),
            ("moment", "N m", "moment on the rod", "global axes or, of a follower, the frame there"),
        )
    },
}
# The same of harnesses, by their place within a rod, a joint or the file.
HARNESS_FIELDS = {
    "harness/positions": ("m", "positions of the joints"),
    "harness/frames": ("1", "frames of the joints, columns their axes"),
    "harness/energy": ("J", "energy of rods, springs and dead loads, zero of height at the origin"),
    "harness/stable": ("1", "whether no motion of rods and joints lowers the energy"),
    "harness/index": ("1", "independent motions of rods and joints that lower the energy"),
    "harness/residual": ("1", "largest component of the gradient, in EI/L^2 of each rod"),
    "harness/contact_forces": ("N", "forces of obstacles on the joints, where rods end in them"),
    "harness/end_pressures": ("N", "of contacts of the joints, of each stack of rods by rod, obstacle and end"),
    **{f"harness/{name}": FIELDS[name] for name in ("converged", "status", "iterations", "evaluations")},
    "end/frame": ("1", "frame of the end of the rod in the axes of the joint, columns d1, d2, t"),
    "end/offset": ("m", "from the position of the joint to the end of the rod, in the axes of the joint"),
    "joint/force": ("N", "dead force on the joint, global axes"),
    "joint/moment": ("N m", "dead moment on the joint, global axes"),
    "joint/mass": ("kg", "mass of the joint, under the gravity of its rods"),
    **{
        f"joint/support/{inner}{name}": (unit, f"{description}, global axes")
        for inner in ("", "support/")
        for name, unit, description in (
            ("position", "m", "position that the support of the joint holds"),
            ("frame", "1", "frame that the support of the joint holds, columns its axes"),
            ("axis", "1", "axis of a hinge"),
            ("directions", "1", "directions in which a slider moves"),
        )
    },
    "joint/support/translation": ("N/m", "stiffness of the spring against displacements"),
    "joint/support/rotation": ("N m/rad", "stiffness of the spring against rotations"),
}
# The same of harnesses whose rods may touch one another.
ROD_CONTACT_FIELDS = {
    "harness/rod_pressures": ("N", "of contacts between rods, of stacks of these by pair and element of the first one"),
    "harness/wide_wells": ("1", "whether each of these stays near the middle of its element"),
    "scene/contact_loads/on_positions": ("N", "forces of other rods on the nodes at start and end of each element"),
    "scene/contact_loads/on_tangents": ("N m", "what other rods apply to the tangents of these nodes"),
}
DISCRETIZATIONS = ("finite_difference", "hermite", "continuum")
OBSTACLES = (Plane, Sphere, Capsule, Pipe, Cylinder, Box, Union, Mesh)
# Loads of which files of older formats have none.
LATER = ("potentials", "point_couples")
# The attribute of a group that tells how many entries a group in it has; older files of each format lack it.
NUMBER_OF = "number_of_"
# How deep unions may lie in one another in a file.
MOST_UNIONS = 2
# What stands in the attribute `kind` of a group: which of several classes the values are of.
KINDS = {
    kind.__name__: kind
    for kind in (
        *(Clamp, Swivel, Pin, Free),
        *(Polyline, Curve, FramedCurve),
        *(Steps, Smooth),
        *(DistributedForce, DistributedCouple),
        *OBSTACLES,
    )
}
# The same of the supports of joints.
JOINT_KINDS = {kind.__name__: kind for kind in (Clamp, Pin, Hinge, Slider, Spring)}


def save(equilibrium: Equilibrium | HarnessEquilibrium, path: str | os.PathLike[str]) -> None:
    """Writes a result to a `.vtkhdf` file, which ParaView opens and `rodjax.load` reads back to the last bit.

    A path becomes time steps, with the number of the step for the time. The file is replaced as a whole: whatever goes
    wrong, `path` holds the old file or the new one.

    Raises `ValueError` or `TypeError` for what cannot be saved, `OSError` where the file cannot be written.
    """
    path = file_path(path, "path", SUFFIX)
    replace_file(path, file_content(equilibrium))


def file_content(equilibrium: Equilibrium | HarnessEquilibrium) -> bytes:
    """What `save` writes, with the same errors."""
    instance(equilibrium, "equilibrium", (Equilibrium, HarnessEquilibrium))
    if not is_known(equilibrium):
        raise ValueError("equilibrium must hold numbers, got a traced one: call save outside jax.jit, vmap and grad")
    is_harness = isinstance(equilibrium, HarnessEquilibrium)
    for name, rod in equilibrium.items() if is_harness else [(None, equilibrium)]:
        _check_scene(rod.scene, "equilibrium.scene" if name is None else f"equilibrium[{name!r}].scene")
    leading = equilibrium.energy.shape
    if len(leading) > 1:
        raise ValueError(
            f"equilibrium must be a single one or a path with one leading axis, got leading axes {leading}: "
            "save one path at a time, such as jax.tree.map(lambda leaf: leaf[0], equilibrium)"
        )
    equilibrium = jax.tree.map(np.asarray, equilibrium)
    # Put together in memory: an error of the disk is then an ordinary one, and HDF5 never holds a half-written file.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        write_picture(file.create_group("VTKHDF", track_order=True), equilibrium)
        group = file.create_group("rodjax")
        if isinstance(equilibrium, HarnessEquilibrium):
            _write_harness(group, equilibrium)
        else:
            _write(group, equilibrium)
        group.attrs.update({"format": _format_of(equilibrium), "version": __version__})
    seal(image)
    return image.getvalue()


def _format_of(equilibrium: Equilibrium | HarnessEquilibrium) -> int:
    """The oldest that can hold it."""
    if isinstance(equilibrium, HarnessEquilibrium):
        return ROD_CONTACT_FORMAT if equilibrium.harness.contact else HARNESS_FORMAT
    return SELF_CONTACT_FORMAT if equilibrium.scene.self_contact else FORMAT


def _check_scene(scene: Scene, name: str) -> None:
    if scene.rod.law is not None:
        raise ValueError(
            f"{name}.rod.law must be None, got a {type(scene.rod.law).__name__}: a law is code, which cannot be saved"
        )
    if scene.potentials:
        raise ValueError(f"{name}.potentials must be (): a potential is code, which cannot be saved")
    _check_obstacles(scene.obstacles, f"{name}.obstacles", MOST_UNIONS)


def _check_obstacles(obstacles: tuple[Obstacle, ...], name: str, unions: int) -> None:
    for k, obstacle in enumerate(obstacles):
        if type(obstacle) not in OBSTACLES:
            raise ValueError(f"{name}[{k}] is a {type(obstacle).__name__}: code of one's own, which cannot be saved")
        if isinstance(obstacle, Union):
            if not unions:
                raise ValueError(
                    f"{name}[{k}] is a Union within {MOST_UNIONS} others, which cannot be saved: put them into one"
                )
            _check_obstacles(obstacle.obstacles, f"{name}[{k}].obstacles", unions - 1)


def load(path: str | os.PathLike[str]) -> Equilibrium | HarnessEquilibrium:
    """Reads what `rodjax.save` wrote: the same result to the last bit, which serves as a `guess` too.

    Where the file holds float64 while JAX is set to float32 the numbers are rounded, and a `PrecisionWarning` says so.
    Raises `OSError` where the file cannot be read, such as `FileNotFoundError`; `ValueError` where it is no result of
    rodjax.
    """
    path = file_path(path, "path", SUFFIX)
    image = io.BytesIO(path.read_bytes())
    try:
        has_seal(image)
    except ValueError as error:
        raise ValueError(f"{path} is not a readable HDF5 file: {error}") from None
    try:
        with h5py.File(image, "r") as file:
            _group(file, "VTKHDF", path)
            group = _group(file, "rodjax", path)
            _check_format(group, path)
            is_harness = group.attrs.get("kind") == HarnessEquilibrium.__name__
            equilibrium = _read_harness(group, path) if is_harness else _read_rod(group, path)
    # What h5py raises for a file that is not HDF5, is cut short or damaged.
    except (OSError, KeyError, RuntimeError, TypeError, OverflowError) as error:
        raise ValueError(f"{path} is not a readable HDF5 file: {error}") from error
    if jnp.zeros(()).dtype == np.float32 and any(leaf.dtype == np.float64 for leaf in jax.tree.leaves(equilibrium)):
        warn(
            f"{path} holds float64 numbers, which are rounded to float32: "
            'call jax.config.update("jax_enable_x64", True) before anything else to keep them',
            PrecisionWarning,
        )
    return jax.tree.map(jnp.asarray, equilibrium)


def _read_rod(group: h5py.Group, path: Path) -> Equilibrium:
    points = group.get("s")
    equilibrium = _read(group, (Equilibrium,), path, points.shape if isinstance(points, h5py.Dataset) else ())
    forces = equilibrium.state.end_force
    if forces.ndim == equilibrium.s.ndim:  # of a rod without clips, until format 8: of its one span
        equilibrium = eqx.tree_at(lambda result: result.state.end_force, equilibrium, forces[..., None])
    shape = equilibrium.state.shape
    if isinstance(shape, FramedCurve) and shape.is_of_joints and has_node_positions(equilibrium.scene):
        raise ValueError(
            f"{path} is a result by finite differences under loads without a potential, of a rod by frames, which this "
            "rodjax has no longer: solve its scene again"
        )
    return equilibrium


def _group(file: h5py.Group, name: str, path: Path) -> h5py.Group:
    group = file.get(name)
    if not isinstance(group, h5py.Group):
        raise ValueError(f"{path} has no group /{name}: load reads files that rodjax.save wrote")
    return group


def _check_format(group: h5py.Group, path: Path) -> None:
    written = group.attrs.get("format")
    if not isinstance(written, np.integer):
        raise ValueError(f"{path} lacks the attribute format of /rodjax: load reads files that rodjax.save wrote")
    newest = _newest_of(group)
    if written > newest:
        raise ValueError(
            f"{path} has format {written}, written by rodjax {group.attrs.get('version')}; "
            f"this rodjax reads formats up to {newest}: update it"
        )
    if written < OLDEST_FORMAT:
        raise ValueError(
            f"{path} has format {written}, written by rodjax {group.attrs.get('version')}, which lacks fields of "
            f"format {OLDEST_FORMAT}: solve its scene again"
        )


def _newest_of(group: h5py.Group) -> int:
    """The format in which this rodjax writes what a file holds."""
    if group.attrs.get("kind") == HarnessEquilibrium.__name__:
        return ROD_CONTACT_FORMAT if "contact" in group.attrs else HARNESS_FORMAT
    scene = group.get("scene")
    touches_itself = isinstance(scene, h5py.Group) and bool(scene.attrs.get("self_contact"))
    return SELF_CONTACT_FORMAT if touches_itself else FORMAT


def _write(group: h5py.Group, module: eqx.Module, place: str = "") -> None:
    if type(module).__name__ in KINDS | JOINT_KINDS:
        group.attrs["kind"] = type(module).__name__
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if field.metadata.get("static"):
            group.attrs[field.name] = value
        else:
            name = STORED_AS.get(field.name, field.name)
            _write_value(group, name, value, f"{place}{name}")


def _write_value(group: h5py.Group, name: str, value: Any, place: str) -> None:
    if isinstance(value, eqx.Module):
        _write(group.create_group(name), value, f"{place}/")
    elif isinstance(value, tuple):
        entries = group.create_group(name)
        group.attrs[NUMBER_OF + name] = len(value)
        for k, entry in enumerate(value):
            _write_value(entries, str(k), entry, f"{place}/*")
    elif value is not None:
        dataset = group.create_dataset(name, data=value)
        dataset.attrs["units"], dataset.attrs["description"] = (FIELDS | HARNESS_FIELDS | ROD_CONTACT_FIELDS)[place]


def _read(
    group: h5py.Group, classes: tuple[Any, ...], path: Path, shape: tuple[int, ...], kinds: dict[str, Any] = KINDS
) -> Any:
    """A module of one of the classes, or of the one below them that the group names, with NumPy arrays for leaves.

    `shape`: of the arclengths of the nodes; `kinds`: the classes that a group may name.
    """
    allowed = [name for name, known in kinds.items() if issubclass(known, classes)]
    kind = classes[0]
    if allowed:
        name = group.attrs.get("kind")
        if not isinstance(name, str) or name not in allowed:
            raise ValueError(f"{path} says of {group.name} that it is {name}; allowed are {', '.join(allowed)}")
        kind = kinds[name]
    # As it was written, without the checks of its constructor, which take a single scene of sensible numbers.
    module = object.__new__(kind)
    for field in dataclasses.fields(kind):
        if field.metadata.get("static"):
            value = _static(group, field, path)
        elif field.name in LATER and field.name not in group and NUMBER_OF + field.name not in group.attrs:
            value = ()
        else:
            name = STORED_AS.get(field.name, field.name)
            value = _read_value(group, name, field.type, path, shape, kinds)
        object.__setattr__(module, field.name, value)
    return module


def _static(group: h5py.Group, field: dataclasses.Field, path: Path) -> Any:
    # Files until format 12 have no `follower` of a point force.
    has_default = field.default is not dataclasses.MISSING
    value = group.attrs.get(field.name, np.bool_(field.default)) if has_default else group.attrs[field.name]
    if field.type is not bool:
        one_of(value, f"{path}: {field.name}", DISCRETIZATIONS)
        return value
    if not isinstance(value, np.bool_):
        raise ValueError(f"{path} is damaged: {field.name} of {group.name} must be true or false, got {shown(value)}")
    return bool(value)


def _read_value(
    group: h5py.Group, name: str, annotation: Any, path: Path, shape: tuple[int, ...], kinds: dict[str, Any]
) -> Any:
    """What a group has under a name: of one of the types that the annotation allows."""
    is_union = typing.get_origin(annotation) in (types.UnionType, typing.Union)
    annotations = typing.get_args(annotation) if is_union else (annotation,)
    classes = tuple(one for one in annotations if dataclasses.is_dataclass(one))
    of_tuple = next((typing.get_args(one) for one in annotations if typing.get_origin(one) is tuple), None)
    of_arrays = [one for one in annotations if hasattr(one, "dim_str")]
    entry = group.get(name)
    number = group.attrs.get(NUMBER_OF + name)
    found = len(entry) if isinstance(entry, h5py.Group) else 0
    if number is not None and not (isinstance(entry, h5py.Group) and np.array_equal(number, found)):
        raise ValueError(f"{path} is damaged: {group.name}/{name} must have {shown(number)} entries, got {found}")
    if isinstance(entry, h5py.Group) and of_tuple and not (classes and "kind" in entry.attrs):
        items = of_tuple[:1] * len(entry) if of_tuple[-1] is Ellipsis else of_tuple
        return tuple(_read_value(entry, str(k), item, path, shape, kinds) for k, item in enumerate(items))
    if isinstance(entry, h5py.Group) and classes:
        return _read(entry, classes, path, shape, kinds)
    if isinstance(entry, h5py.Dataset) and of_arrays:
        axes = len(entry.shape or ()) - max(len(shape) - 1, 0)
        fitting = [one for one in of_arrays if len(one.dim_str.replace("...", "").split()) == axes]
        return _array(entry, [*fitting, *of_arrays][0], path, shape)
    if entry is None and types.NoneType in annotations:
        return None
    raise ValueError(f"{path} lacks {group.name}/{name}: it is damaged, or rodjax.save did not write it")


def _array(dataset: h5py.Dataset, kind: Any, path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """The numbers of a dataset, which are of the kind and shape with which the field is annotated."""
    *leading, nodes = shape or (0,)
    # "m": nodes and middles of elements, or two ends and the middles between nodes; of other names any size.
    sizes = {"n+1": (nodes,), "n": (nodes - 1,), "m": (2 * nodes - 1, nodes + 1), "3": (3,), "4": (4,)}
    if "/scene/" in str(dataset.name):  # made without a mesh: its names are sizes of its own
        sizes = {name: allowed for name, allowed in sizes.items() if name.isdigit()}
    names = [name for name in kind.dim_str.split() if name != "..."]
    wanted = [*((size,) for size in leading), *(sizes.get(name) for name in names)]
    shape_there = dataset.shape or ()  # of an empty dataset None
    fits = len(shape_there) == len(wanted)
    fits &= all(not allowed or size in allowed for size, allowed in zip(shape_there, wanted, strict=False))
    if not fits or dataset.shape is None or dataset.dtype.name not in kind.dtypes:
        described = ", ".join(" or ".join(map(str, allowed)) if allowed else "any" for allowed in wanted)
        raise ValueError(
            f"{path} is damaged: {dataset.name} must be {kind.dtype.__name__} of shape ({described}), "
            f"got {dataset.dtype.name} of shape {dataset.shape}"
        )
    return dataset[()]


# --- harnesses -------------------------------------------------------------------------------------------------------


def _write_harness(group: h5py.Group, result: HarnessEquilibrium) -> None:
    group.attrs["kind"] = HarnessEquilibrium.__name__
    cables = group.create_group("cables")
    of_group = {number: k for k, members in enumerate(result.members) for number in members}
    for number, (name, rod) in enumerate(result.items()):
        cable = cables.create_group(str(number))
        cable.attrs.update({"name": name, "group": of_group[number]})
        _write(cable, jax.tree.map(np.asarray, rod))
        joined = result.harness.scenes[number]
        for end in ENDS:
            joint = getattr(joined, end)
            if isinstance(joint, Joint):
                place = cable.create_group(f"joints/{end}")
                place.attrs["name"] = joint.name
                for field in ("frame", "offset"):
                    _write_value(place, field, getattr(joint, field), f"end/{field}")
    joints = group.create_group("joints")
    for number, (name, body) in enumerate(zip(result.harness.joint_names, result.harness.bodies, strict=True)):
        joint = joints.create_group(str(number))
        joint.attrs["name"] = name
        _write(joint, body, "joint/")
    if result.harness.contact:
        group.attrs["contact"] = np.array(result.harness.contact)
    for name in _harness_arrays():
        if name not in _OF_ROD_CONTACTS or result.harness.contact:
            _write_value(group, name, getattr(result, name), f"harness/{name}")


def _harness_arrays() -> dict[str, Any]:
    """The fields of a `HarnessEquilibrium` that are arrays, and what they are annotated with."""
    fields = dataclasses.fields(HarnessEquilibrium)
    return {field.name: field.type for field in fields if hasattr(field.type, "dim_str")}


def _read_harness(group: h5py.Group, path: Path) -> HarnessEquilibrium:
    names, rods, scenes, groups = [], [], [], {}
    for number, cable in enumerate(_numbered(group, "cables", path)):
        names.append(_name(cable, path))
        groups.setdefault(np.asarray(cable.attrs["group"]).item(), []).append(number)
        rods.append(_read_rod(cable, path))
        scenes.append(_joined(rods[-1], cable, path))
    shape = rods[0].s.shape
    joint_groups = _numbered(group, "joints", path)
    harness = object.__new__(Harness)
    for name, value in {
        "scenes": tuple(scenes),
        "bodies": tuple(_read(joint, (Body,), path, shape, JOINT_KINDS) for joint in joint_groups),
        "names": tuple(names),
        "joint_names": tuple(_name(joint, path) for joint in joint_groups),
        "contact": _contact(group, len(names), path),
    }.items():
        object.__setattr__(harness, name, value)
    members = tuple(tuple(groups[k]) for k in sorted(groups))
    axis = len(shape) - 1
    stacked = tuple(
        jax.tree.map(lambda *leaves: np.stack(leaves, axis), *(rods[number] for number in numbers))
        for numbers in members
    )
    written = int(np.asarray(group.attrs["format"]))
    arrays = {
        name: _read_value(group, name, annotation, path, shape, KINDS)
        for name, annotation in _harness_arrays().items()
        if (written >= HARNESS_FORMAT or name not in _OF_CONTACTS)
        and (harness.contact or name not in _OF_ROD_CONTACTS)
        and (written >= ROD_CONTACT_FORMAT or name != _OF_WELLS)
    }
    if not harness.contact:
        arrays["rod_pressures"] = np.zeros((*shape[:-1], 0), arrays["positions"].dtype)
    arrays.setdefault(_OF_WELLS, np.zeros_like(arrays["rod_pressures"], bool))
    if written < HARNESS_FORMAT:
        arrays["contact_forces"] = np.zeros_like(arrays["positions"])
        arrays["end_pressures"] = np.zeros((*shape[:-1], 0), arrays["positions"].dtype)
    return HarnessEquilibrium(groups=stacked, harness=harness, members=members, **arrays)


def _contact(group: h5py.Group, cables: int, path: Path) -> tuple[tuple[int, int], ...]:
    """The numbers of the cables that may touch one another."""
    pairs = np.asarray(group.attrs.get("contact", np.zeros((0, 2), int)))
    fits = pairs.ndim == 2 and pairs.shape[1:] == (2,) and np.issubdtype(pairs.dtype, np.integer)
    if not fits or np.any(pairs < 0) or np.any(pairs >= cables) or np.any(pairs[:, 0] >= pairs[:, 1]):
        raise ValueError(f"{path} is damaged: contact must hold pairs of numbers of its {cables} cables")
    return tuple((int(first), int(second)) for first, second in pairs)


def _joined(rod: Equilibrium, cable: h5py.Group, path: Path) -> Scene:
    """The scene of a rod with joints in the place of the clamps that stand for them."""
    scene = under_contact(rod.scene, None)
    for end in ENDS:
        place = cable.get(f"joints/{end}")
        if isinstance(place, h5py.Group):
            joint = object.__new__(Joint)
            object.__setattr__(joint, "name", _name(place, path))
            for field in dataclasses.fields(Joint):
                if not field.metadata.get("static"):
                    value = _read_value(place, field.name, field.type, path, rod.s.shape, KINDS)
                    object.__setattr__(joint, field.name, value)
            scene = eqx.tree_at(lambda scene, end=end: getattr(scene, end), scene, joint)
    return scene


def _numbered(group: h5py.Group, name: str, path: Path) -> list[h5py.Group]:
    entries = _group(group, name, path)
    return [_group(entries, str(number), path) for number in range(len(entries))]


def _name(group: h5py.Group, path: Path) -> str:
    name = group.attrs.get("name")
    if not isinstance(name, str):
        raise ValueError(f"{path} is damaged: {group.name} lacks the attribute name")
    return name
