"""How the results of a solve change with the numbers of its scene, as tables: no search is repeated for them."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.checks import instance, sequence
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.model.supports import Clamp, Free, Pin, rotate
from rodjax.programs.answers import one_answer
from rodjax.programs.compilation import compiled
from rodjax.solving.harness_derivatives import differentiable_by, differentiable_harness
from rodjax.solving.harness_result import HarnessEquilibrium, Solution
from rodjax.solving.implicit import differentiable
from rodjax.solving.result import Equilibrium
from rodjax.solving.solve import solve

FIELDS = (
    "s",
    "nodes",
    "frames",
    "tangents",
    "curvature",
    "twist",
    "total_twist",
    "tension",
    "axial_strain",
    "shear_strain",
    "energy",
    "elastic_energy",
    "start_force",
    "start_moment",
    "end_force",
    "end_moment",
    "clip_forces",
    "clip_moments",
)
# Of a joint of a harness.
JOINT_FIELDS = ("position", "frame", "contact_force")


@one_answer
def sensitivities(
    scene: Scene | Harness, *, of: Sequence[str], wrt: Sequence[str], **options: Any
) -> dict[str, dict[str, Float[Array, "..."]]]:
    """The derivatives of an equilibrium by numbers of its scene: `{of: {wrt: array}}`.

    `sensitivities(scene, of=["end_force"], wrt=["rod.EI"])["end_force"]["rod.EI"]` are the three numbers dF/d(EI). One
    solve and one compiled program give all, in forward mode where the inputs are fewer than the outputs, else in
    reverse.

    **Arguments:**

    - `scene`: `Scene` or `Harness`.
    - `of`: names of fields of `Equilibrium` that are real numbers, such as `"nodes"` or `"end_force"`; of a harness
        those of a cable, `"cables.NAME.end_force"`, of a joint, `"joints.NAME.position"`, `"joints.NAME.frame"` or
        `"joints.NAME.contact_force"`, or `"energy"`.
    - `wrt`: dotted names of numbers of the scene: `"rod.EI"`, `"end.position"`, `"point_forces.0.force"`,
        `"clips.0.at"`, `"gravity"`. A frame changes by a rotation vector [rad] about global axes, as in
        `rodjax.rotate`; of the tangent of a `Swivel` or `Clip` only changes across it matter. What is absent from a
        scene, such as a gravity of `None`, has no derivative. Of a harness `"cables.NAME.rod.EI"`, of the scene of a
        cable, and `"joints.NAME.mass"`, of a `Body`.
    - `options`: of `rodjax.solve`. They choose the mesh, on which the derivatives are exact.

    Each array has the shape of the field followed by that of the number, (3,) for a frame, in SI units of the one over
    those of the other. Where the solve did not converge, or at a critical equilibrium, they are NaN. Raises
    `ValueError` or `TypeError` for names that are not among these, or options that `rodjax.solve` refuses.
    """
    instance(scene, "scene", (Scene, Harness))
    if isinstance(scene, Harness):
        of = _checked_names("of", of, _fields_of(scene), "real fields of this harness")
        kind = "numbers of this harness"
    else:
        of = _checked_names("of", of, FIELDS, "real fields of Equilibrium")
        if "shear_strain" in of and scene.rod.GA is None:
            raise ValueError("of must not have 'shear_strain' of a rod without GA: its sections do not shear")
        kind = "numbers of this scene"
    wrt = _checked_names("wrt", wrt, tuple(named_numbers(scene)), kind)
    found = _derivatives(scene, solve(scene, **options), of, wrt)
    return {field: {number: found[field][number] for number in wrt} for field in of}  # JAX sorts names


@one_answer
def end_stiffness(scene: Scene | Harness, cable: str | None = None, **options: Any) -> Float[Array, "k k"]:
    """The stiffness that the support at s = L feels: second derivatives of the energy by its motion, global axes. Of a
    `Harness` the support of the rod `cable`, while all other rods and the joints follow.

    Of a `Clamp` (6, 6), rows and columns (ux, uy, uz, rx, ry, rz), displacement [m] and rotation vector [rad]: blocks
    in N/m, N, N and N m. Of a `Pin` (3, 3), displacements alone [N/m]. `options`: of `rodjax.solve`.

    Rows are the changes of `end_force` and `end_moment`, save that of the moment by a rotation: rotations do not
    commute, so dM/dr is the symmetric second derivative of the energy less half of the matrix [M x] of the cross
    product with `end_moment`, which is added here. The whole is symmetric unless a dead moment acts on the other end,
    which has no energy. NaN where `sensitivities` are NaN.

    Raises `ValueError` for an end that is `Free`, a `Swivel` or a `Joint`, or a `cable` that is not there.
    """
    instance(scene, "scene", (Scene, Harness))
    if isinstance(scene, Harness):
        if cable not in scene.names:
            raise ValueError(f"cable must be one of {', '.join(map(repr, scene.names))}, got {cable!r}")
        _check_end(scene[cable], f"scene[{cable!r}]")
        return _end_stiffness_in(scene, solve(scene, **options), scene.names.index(cable))
    if cable is not None:
        raise ValueError(f"cable must be None for a Scene, which has one, got {cable!r}")
    _check_end(scene, "scene")
    return _end_stiffness(scene, solve(scene, **options))


def _check_end(scene: Scene, name: str) -> None:
    if isinstance(scene.end, Free):
        raise ValueError(f"{name}.end must hold a position to have a stiffness, got Free; make it a Clamp or Pin")
    if not isinstance(scene.end, Clamp | Pin):
        raise ValueError(f"{name}.end must be a Clamp (6 x 6) or a Pin (3 x 3), got {type(scene.end).__name__}")


@compiled
def _end_stiffness(scene: Scene, result: Equilibrium) -> Float[Array, "k k"]:
    return _stiffness(scene, result, lambda near: differentiable(near, result))


@functools.partial(compiled, static_argnames=("number",))
def _end_stiffness_in(harness: Harness, result: HarnessEquilibrium, number: int) -> Float[Array, "k k"]:
    def rod(near: Scene) -> Equilibrium:
        changed = eqx.tree_at(lambda harness: harness.scenes[number], harness, near)
        return differentiable_harness(changed, result).rod(number)

    return _stiffness(harness.scenes[number], result.rod(number), rod)


def _stiffness(scene: Scene, result: Equilibrium, near: Callable[[Scene], Equilibrium]) -> Float[Array, "k k"]:
    """`near`: the equilibrium with other numbers of the scene."""
    if isinstance(scene.end, Pin):
        return _by_numbers(scene, result, near, ("end_force",), ("end.position",))["end_force"]["end.position"]
    rows = _by_numbers(scene, result, near, ("end_force", "end_moment"), ("end.position", "end.frame"))
    force, moment = ([rows[of][wrt] for wrt in ("end.position", "end.frame")] for of in ("end_force", "end_moment"))
    moment[1] += 0.5 * jnp.cross(result.end_moment[:, None], jnp.eye(3, dtype=moment[1].dtype), axis=0)
    return jnp.block([force, moment])


_T = TypeVar("_T", Scene, Harness)


def moved(scene: _T, changes: dict[str, Float[Array, "..."]]) -> _T:
    """The scene with changes added to the numbers of these names; frames are turned by rotation vectors (3,) [rad]."""
    numbers = named_numbers(scene)
    changed = [
        rotate(numbers[name], change) if _is_frame(name) else numbers[name] + change for name, change in changes.items()
    ]
    return eqx.tree_at(lambda scene: [named_numbers(scene)[name] for name in changes], scene, changed)


@functools.partial(compiled, static_argnames=("of", "wrt"))
def _derivatives(
    scene: Scene | Harness, result: Solution, of: tuple[str, ...], wrt: tuple[str, ...]
) -> dict[str, dict[str, Float[Array, "..."]]]:
    """By the implicit function theorem at a result, whose mesh is kept."""
    return _by_numbers(scene, result, lambda near: differentiable_by(near, result), of, wrt)


def _fields_of(harness: Harness) -> tuple[str, ...]:
    """The names of real numbers of its equilibrium."""
    of_rods = [
        f"cables.{name}.{field}"
        for name in harness
        for field in FIELDS
        if field != "shear_strain" or harness[name].rod.GA is not None
    ]
    of_joints = [f"joints.{name}.{field}" for name in harness.joint_names for field in JOINT_FIELDS]
    return (*of_rods, *of_joints, "energy")


def _field(result: Solution, name: str) -> Float[Array, "..."]:
    if isinstance(result, Equilibrium) or name == "energy":
        return getattr(result, name)
    kind, rest = name.split(".", 1)
    owner, field = rest.rsplit(".", 1)
    return getattr(result[owner] if kind == "cables" else result.joints[owner], field)


def _by_numbers(
    scene: Any,
    result: Solution,
    near: Callable[[Any], Solution],
    of: tuple[str, ...],
    wrt: tuple[str, ...],
) -> dict[str, dict[str, Float[Array, "..."]]]:
    def fields(changes: dict[str, Float[Array, "..."]]) -> dict[str, Float[Array, "..."]]:
        found = near(moved(scene, changes))
        return {name: _field(found, name) for name in of}

    numbers = named_numbers(scene)
    nowhere = {name: jnp.zeros_like(numbers[name][0] if _is_frame(name) else numbers[name]) for name in wrt}
    outputs = sum(_field(result, name).size for name in of)
    inputs = sum(change.size for change in nowhere.values())
    return (jax.jacfwd if inputs <= outputs else jax.jacrev)(fields)(nowhere)


def named_numbers(scene: Scene | Harness) -> dict[str, Float[Array, "..."]]:
    """The numbers of a scene by their dotted names; turns are whole and have no derivative."""
    if isinstance(scene, Harness):
        parts = {f"cables.{name}": one for name, one in zip(scene.names, scene.scenes, strict=True)}
        if scene.joint_names:  # `eqx.tree_at`, in which this is called, has no empty tuples
            parts |= {f"joints.{name}": one for name, one in zip(scene.joint_names, scene.bodies, strict=True)}
        return {f"{where}.{name}": leaf for where, part in parts.items() for name, leaf in _named(part).items()}
    return _named(scene)


def _named(part: eqx.Module) -> dict[str, Float[Array, "..."]]:
    leaves, _ = jax.tree.flatten_with_path(part)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    return {name: leaf for name, leaf in named.items() if name != "turns"}


def _is_frame(name: str) -> bool:
    return name.endswith(".frame")


def _checked_names(argument: str, names: Any, allowed: Sequence[str], kind: str) -> tuple[str, ...]:
    if isinstance(names, str):
        raise TypeError(f"{argument} must be a list of names, such as [{names!r}], got {names!r} alone")
    names = sequence(names, argument, "names")
    if not names:
        raise ValueError(f"{argument} must hold at least one name, got none; allowed are {', '.join(allowed)}")
    for name in names:
        if name not in allowed:
            raise ValueError(f"{argument} must be names of {kind}, got {name!r}; allowed are {', '.join(allowed)}")
    return names
