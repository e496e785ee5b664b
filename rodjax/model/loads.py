"""Loads along the rod. Gravity is a vector of the scene; loads on a free end belong to `Free`."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import instance, is_known, leaf, not_negative, number_array, shown, vector
from rodjax.units import Units


class PointForce(eqx.Module):
    """A force at an arclength. `at`: arclength s [m]; `force`: (3,) [N], a dead one along global axes; or, where
    `follower` is True, along the material frame (d1, d2, t) of the section, which has no potential: inside the rod, as
    on an end it is one of `Free`.
    """

    at: Float[Array, ""]
    force: Float[Array, "3"]
    follower: bool = eqx.field(static=True, default=False)

    def __init__(self, at: Any, force: Any, follower: bool = False):
        self.at = leaf(not_negative(at, "at"))
        self.force = leaf(vector(force, "force"))
        instance(follower, "follower", bool)
        self.follower = follower

    def in_units(self, units: Units) -> "PointForce":
        """The same force in the units of the rod: see `rodjax.model.scene.nondimensional`."""
        return PointForce(self.at / units.length, self.force / units.force, self.follower)


class ContactLoads(eqx.Module):
    """What other rods of a harness apply to a rod in contact, on a mesh of n elements: forces [N] on the nodes at start
    and end of each element, and what is conjugate to their tangents [N m].
    """

    on_positions: Float[Array, "3 2 n"]
    on_tangents: Float[Array, "3 2 n"]

    def in_units(self, units: Units) -> "ContactLoads":
        return self.times(1 / units.force, 1 / units.energy)

    def times(self, force: Float[Array, ""], energy: Float[Array, ""]) -> "ContactLoads":
        return ContactLoads(self.on_positions * force, self.on_tangents * energy)


class PointCouple(eqx.Module):
    """A couple at an arclength inside the rod; it has no potential. `at`: arclength s [m]; `couple`: (3,) [N m], along
    global axes, or, where `follower` is True, along the material frame (d1, d2, t) of the section.
    """

    at: Float[Array, ""]
    couple: Float[Array, "3"]
    follower: bool = eqx.field(static=True)

    def __init__(self, at: Any, couple: Any, follower: bool = False):
        self.at = leaf(not_negative(at, "at"))
        self.couple = leaf(vector(couple, "couple"))
        instance(follower, "follower", bool)
        self.follower = follower

    def in_units(self, units: Units) -> "PointCouple":
        return PointCouple(self.at / units.length, self.couple / units.energy, self.follower)


class DistributedForce(eqx.Module):
    """A force per length along the rod: (3,) [N/m].

    `force`: along global axes; or, where `follower` is True, along the material frame (d1, d2, t) of each section, as
    of a pressure or a flow, which has no potential. `part`: (2,) [m], the arclengths between which it acts, where
    meshes of elements have nodes as at jumps of `Steps`; `None` for all along the rod.
    """

    force: Float[Array, "3"]
    part: Float[Array, "2"] | None
    follower: bool = eqx.field(static=True)

    def __init__(self, force: Any, follower: bool = False, part: Any = None):
        self.force = leaf(vector(force, "force"))
        instance(follower, "follower", bool)
        self.follower = follower
        self.part = _part(part)

    def in_units(self, units: Units) -> "DistributedForce":
        part = None if self.part is None else self.part / units.length
        return DistributedForce(self.force * (units.length / units.force), self.follower, part)


class DistributedCouple(eqx.Module):
    """A couple per length along the rod: (3,) [N m/m]; it has no potential.

    `couple`: along global axes, or, where `follower` is True, along the material frame (d1, d2, t) of each section.
    `part`: as of a `DistributedForce`.
    """

    couple: Float[Array, "3"]
    part: Float[Array, "2"] | None
    follower: bool = eqx.field(static=True)

    def __init__(self, couple: Any, follower: bool = False, part: Any = None):
        self.couple = leaf(vector(couple, "couple"))
        instance(follower, "follower", bool)
        self.follower = follower
        self.part = _part(part)

    def in_units(self, units: Units) -> "DistributedCouple":
        part = None if self.part is None else self.part / units.length
        return DistributedCouple(self.couple * (units.length / units.energy), self.follower, part)


def _part(part: Any) -> Float[Array, "2"] | None:
    if part is None:
        return None
    part = leaf(number_array(part, "part", (2,)))
    if is_known(part) and not 0 <= float(part[0]) < float(part[1]):
        raise ValueError(f"part must be two arclengths from 0 m on that increase, got {np.asarray(part).tolist()}")
    return part


def loaded_length(load: DistributedForce | DistributedCouple, length: Float[Array, ""]) -> Float[Array, ""]:
    """Of a rod of this length."""
    return length if load.part is None else load.part[1] - load.part[0]


def length_before(load: DistributedForce | DistributedCouple, s: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """How much of the loaded length lies before arclengths."""
    return s if load.part is None else jnp.clip(s - load.part[0], 0.0, load.part[1] - load.part[0])


def per_length(load: DistributedForce | DistributedCouple, s: Float[Array, "*k"]) -> Float[Array, "3 *k"]:
    """The load at arclengths, which are none of those where its part ends."""
    value = load.couple if isinstance(load, DistributedCouple) else load.force
    value = jnp.broadcast_to(value.reshape(3, *[1] * s.ndim), (3, *s.shape))
    return value if load.part is None else jnp.where(_is_within(load.part, s)[None], value, 0.0)


def _is_within(part: Float[Array, "2"], s: Float[Array, "*k"]) -> Bool[Array, "*k"]:
    return (s > part[0]) & (s < part[1])


class Potential(eqx.Module):
    """A field of forces along the rod: buoyancy, an elastic bedding, a magnet.

    `density`: from a position (3,) [m] and the arclength [m] to the energy per reference length () [J/m], in JAX; the
    force per length on the rod is minus its gradient by the position. It is differentiated three times, and must be
    smooth: the error of a field that has kinks is of lower order. Numbers in it are differentiable where it is a
    pytree, such as an `equinox.Module` with a `__call__` or a `jax.tree_util.Partial` of a function and its numbers; a
    plain function is part of the program, compiled for it: make it once, not for each scene. `part`: as of a
    `DistributedForce`.

    Raises `TypeError` or `ValueError` for a density that cannot be called so or gives no single real number.
    """

    density: Callable[[Float[Array, "3"], Float[Array, ""]], Float[Array, ""]]
    part: Float[Array, "2"] | None

    def __init__(self, density: Callable[[Float[Array, "3"], Float[Array, ""]], Float[Array, ""]], part: Any = None):
        if not callable(density):
            raise TypeError(f"density must be a function of a position (3,) and an arclength, got {shown(density)}")
        if any(callable(part) for part in jax.tree.leaves(density)):
            density = jax.tree_util.Partial(density)
        self.density = jax.tree.map(leaf, density)
        self.part = _part(part)

    def __call__(self, position: Float[Array, "3"], s: Float[Array, ""]) -> Float[Array, ""]:
        return self.density(position, s)

    def in_units(self, units: Units) -> "ScaledPotential":
        return ScaledPotential(self, units.origin, units.length, units.energy)


def densities(
    potentials: Sequence[Potential], position: Float[Array, "3"], s: Float[Array, ""]
) -> Float[Array, "fields"]:
    return jnp.stack([potential(position, s) for potential in potentials])


def acting(potentials: Sequence[Potential], s: Float[Array, "*k"]) -> Float[Array, "*k fields"]:
    """1 where a field acts, 0 elsewhere: at arclengths that are none of those where a part ends."""
    parts = [potential.part for potential in potentials]
    acts = [jnp.ones_like(s) if part is None else _is_within(part, s).astype(s.dtype) for part in parts]
    return jnp.stack(acts, axis=-1)


class ScaledPotential(Potential):
    """The same in other units: seen from `origin` (3,) [m], in parts of `length` [m] and `energy` [J]."""

    origin: Float[Array, "3"]
    length: Float[Array, ""]
    energy: Float[Array, ""]

    def __init__(
        self, potential: Potential, origin: Float[Array, "3"], length: Float[Array, ""], energy: Float[Array, ""]
    ):
        self.density, self.origin, self.length, self.energy = potential.density, origin, length, energy
        self.part = None if potential.part is None else potential.part / length

    def __call__(self, position: Float[Array, "3"], s: Float[Array, ""]) -> Float[Array, ""]:
        return self.density(self.origin + self.length * position, self.length * s) * (self.length / self.energy)


def check_potential(potential: Potential, name: str) -> None:
    """Raises `ValueError` where a potential does not give one real number."""
    leaves, structure = jax.tree.flatten(potential)
    try:
        found = _given_by(structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves))
    except TypeError as error:
        raise TypeError(f"{name} must be a function of a position (3,) and an arclength in JAX: {error}") from error
    if getattr(found, "shape", None) != () or not jnp.issubdtype(found.dtype, jnp.floating):
        raise ValueError(f"{name} must give one real number for a position (3,) and an arclength, got {shown(found)}")


@functools.lru_cache
def _given_by(structure: Any, leaves: tuple[Any, ...]) -> Any:
    """What a potential of these leaves, shapes and types, gives for one place."""
    dtype = leaves[0][1] if leaves else jnp.zeros(()).dtype
    arrays = [jax.ShapeDtypeStruct(*leaf) for leaf in leaves]
    place, s = jax.ShapeDtypeStruct((3,), dtype), jax.ShapeDtypeStruct((), dtype)
    potential = jax.tree.unflatten(structure, arrays)
    return jax.eval_shape(lambda potential, place, s: potential(place, s), potential, place, s)
