"""The rods of a harness between clamps, and which of them are stacked."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from rodjax.checks import leaf
from rodjax.model.harness import Harness
from rodjax.model.loads import ContactLoads
from rodjax.model.scene import Scene, under_contact
from rodjax.model.supports import Clamp, Joint
from rodjax.solving.options import Options
from rodjax.solving.rod_contact import Members


def clamped_rods(harness: Harness, counts: Sequence[int] | None = None) -> list[Scene]:
    """The scenes of the rods with clamps, at no place in particular, where their ends are joints; `counts`: of elements
    of each rod, where they are known.
    """
    clamp = _clamp(harness.scenes[0].rod.length.dtype)

    def structure(scene: Scene) -> Scene:
        # `eqx.tree_at` would take longer than the solve.
        new = object.__new__(Scene)
        for field in dataclasses.fields(Scene):
            value = getattr(scene, field.name)
            object.__setattr__(new, field.name, clamp if isinstance(value, Joint) else value)
        return new

    found = [structure(scene) for scene in harness.scenes]
    return (
        found
        if counts is None
        else [touchable(harness, *each) for each in zip(range(len(found)), found, counts, strict=True)]
    )


def touchable(harness: Harness, number: int, scene: Scene, elements: int) -> Scene:
    """The scene of a rod on a mesh, with what others apply to it, nothing at first, if it may touch any."""
    if not any(number in pair for pair in harness.contact):
        return scene
    nothing = np.zeros((3, 2, elements), scene.rod.length.dtype)
    return under_contact(scene, ContactLoads(leaf(nothing), leaf(nothing)))


@functools.cache
def _clamp(dtype: Any) -> Clamp:
    return Clamp(np.zeros(3, dtype), np.eye(3, dtype=dtype))


def members_of(structures: list[Scene], all_options: tuple[Options, ...]) -> Members:
    """The numbers of the rods of one structure and mesh."""
    found: dict[Any, list[int]] = {}
    for number, (scene, options) in enumerate(zip(structures, all_options, strict=True)):
        leaves, tree = jax.tree.flatten(scene)
        key = tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), options.segments
        found.setdefault(key, []).append(number)
    return tuple(map(tuple, found.values()))
