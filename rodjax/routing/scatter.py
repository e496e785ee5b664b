"""How the quantities of a rod or harness at rest scatter with numbers of it: by derivatives, and by solves."""

import functools
import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.checks import Numbers
from rodjax.identification.unknowns import nominal, with_values
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import has_potential
from rodjax.model.supports import Free
from rodjax.notes import bar
from rodjax.paths.batch import chunk_size, lane_count, solve_stack
from rodjax.paths.modes import lowest_mode
from rodjax.programs.compilation import compiled
from rodjax.programs.tasks import Workers, as_completed, in_order, rows_of
from rodjax.routing.limits import Limits
from rodjax.routing.margins import measured
from rodjax.solving.harness_derivatives import jacobian
from rodjax.solving.harness_result import HarnessEquilibrium, Solution, results_of, solved_in
from rodjax.solving.result_warnings import NotConvergedWarning
from rodjax.warn import silenced

# Of the three-point rule of Gauss & Hermite, in standard deviations.
STEP = math.sqrt(3.0)


class Quantities(NamedTuple):
    """What scatters: values of limits, nodes of the centerline across itself, forces at both ends; or changes of it.
    Nodes and forces are those of one rod after another.
    """

    values: Float[Numbers, "... m"]
    nodes: Float[Numbers, "... n 3"]
    forces: Float[Numbers, "... 2r 3"]


class Moments(NamedTuple):
    """Of quantities: their means, less the quantities as they should be, and covariances, of values variances."""

    shift: Quantities
    values: Float[np.ndarray, "m"]
    nodes: Float[np.ndarray, "n 3 3"]
    forces: Float[np.ndarray, "2r 3 3"]

    @staticmethod
    def sums(changes: Quantities) -> "Moments":
        """Sums over a leading axis, of changes and of their products."""
        products = [np.einsum("knc,knd->ncd", x, x) for x in (changes.nodes, changes.forces)]
        return Moments(
            Quantities(*(np.sum(x, axis=0) for x in changes)), np.sum(np.square(changes.values), axis=0), *products
        )


class Slopes(NamedTuple):
    """Quantities as they should be, their derivatives by p independent normal numbers of deviation 1; and so the
    stiffness of the softest motion, not a number where that has none.
    """

    here: Quantities
    by: Quantities
    stiffness: Float[Numbers, ""]
    stiffness_by: Float[Numbers, "p"]


class Part(NamedTuple):
    """Of one rod among all: what its names begin with, where its nodes are, and its number."""

    prefix: str
    nodes: slice
    number: int


class Scattering(eqx.Module):
    """An equilibrium whose scene or harness scatters: the numbers of these keys by `root` times independent normal
    ones.
    """

    equilibrium: Solution
    keys: tuple[str, ...] = eqx.field(static=True)
    root: Float[Array, "p p"]
    limits: Limits | None
    obstacles: tuple[Obstacle, ...]

    @property
    def parts(self) -> list[Part]:
        """The rods."""
        rods = results_of(self.equilibrium)
        ends = np.cumsum([0, *(rod.s.shape[-1] for rod in rods.values())]).tolist()
        return [Part(prefix, slice(*ends[k : k + 2]), k) for k, prefix in enumerate(rods)]

    def scene(self, z: Float[Array, "p"]) -> Any:
        scene: Any = solved_in(self.equilibrium)
        changes = self.root.astype(z.dtype) @ z
        values = [nominal([key], scene) + change for key, change in zip(self.keys, changes, strict=True)]
        return with_values(scene, [[key] for key in self.keys], ["linear"] * len(self.keys), values)

    def scenes(self, zs: Float[np.ndarray, "k p"]) -> Any:
        """Along a leading axis."""
        return _scenes(self, zs)

    def quantities(self, equilibrium: Solution) -> Quantities:
        values = jnp.zeros(0, equilibrium.energy.dtype)
        if self.limits is not None:
            values = jnp.concatenate([each.value for each in measured(equilibrium, self.limits, self.obstacles)])
        nodes, forces = [], []
        pairs = zip(results_of(equilibrium).values(), results_of(self.equilibrium).values(), strict=True)
        for rod, as_it_should_be in pairs:
            along = as_it_should_be.tangents
            scene = as_it_should_be.scene
            for end, node in ((scene.start, 0), (scene.end, -1)):
                if isinstance(end, Free):
                    along = along.at[node].set(0.0)
            nodes.append(rod.nodes - jnp.sum(rod.nodes * along, axis=1)[:, None] * along)
            forces += [rod.start_force, rod.end_force]
        return Quantities(values, jnp.concatenate(nodes), jnp.stack(forces))

    def slopes(self) -> Slopes:
        return jax.tree.map(np.asarray, _slopes(self))

    def solved(
        self, zs: Float[np.ndarray, "k p"], workers: Workers
    ) -> Iterator[tuple[int, Quantities, Bool[np.ndarray, "k"]]]:
        """Of the rods with these numbers, so many at a time, in any order: the number of the part, the quantities, and
        which of its rods are at rest.
        """
        size, total = chunk_size(len(zs)), len(zs)
        if isinstance(self.equilibrium, HarnessEquilibrium):
            # One after another: none is solved to fill a part.
            size = min(size, total)
            options: dict[str, Any] = {"segments": self.equilibrium.segments}
        else:
            n = self.equilibrium.s.shape[-1] - 1
            options = {"segments": n, "discretization": self.equilibrium.discretization}
        # A saddle that is kept would be left otherwise.
        options["find"] = "minimum" if bool(self.equilibrium.stable) else "equilibrium"
        parts = ((self, zs[rows_of(first, size, total)], options) for first in range(0, total, size))
        if workers.executor is None and total <= size:  # no parts, and so by NumPy code at first
            results: Iterable[tuple[int, Any]] = enumerate(in_order(_solved_part, [*parts], threads=workers.threads))
        else:
            results = as_completed(_solved_part, parts, **workers._asdict(), count=-(-total // size))
        with bar(total, "cases") as drawn:
            for number, part in results:
                drawn.update(min(size, total - number * size))
                yield number, *jax.tree.map(lambda x, k=number: x[: total - k * size], part)


def _solved_part(
    scattering: Scattering, zs: Float[np.ndarray, "k p"], options: dict[str, Any]
) -> tuple[Quantities, Bool[np.ndarray, "k"]]:
    # How many did not converge is what the caller is told.
    with silenced(NotConvergedWarning):
        rods = solve_stack(scattering.scenes(zs), guess=scattering.equilibrium, strain_limit=None, **options)
    return jax.tree.map(np.asarray, (_quantities(scattering, rods), rods.converged))


@compiled
def _slopes(scattering: Scattering) -> Slopes:
    result = scattering.equilibrium
    if isinstance(result, HarnessEquilibrium):
        is_examined = result.harness.has_potential and not result.harness.contact
    else:
        is_examined = has_potential(result.scene)

    def found(_: Array, __: Any, near: Solution) -> tuple[tuple[Quantities, Float[Array, ""]], None]:
        stiffness = lowest_mode(near).stiffness if is_examined else jnp.full_like(near.energy, jnp.nan)
        return (scattering.quantities(near), stiffness), None

    z = jnp.zeros(len(scattering.root), result.energy.dtype)
    (here, stiffness), (by, stiffness_by), _ = jacobian(found, scattering.scene, z, result)
    return Slopes(here, by, stiffness, stiffness_by)


@compiled
def _scenes(scattering: Scattering, zs: Float[Array, "k p"]) -> Any:
    return jax.vmap(scattering.scene)(zs.astype(scattering.equilibrium.energy.dtype))


@compiled
def _quantities(scattering: Scattering, rods: Solution) -> Quantities:
    # Not by `batch_size`: there may be no values.
    count = rods.energy.shape[0]
    at_once = math.gcd(count, lane_count())
    lanes = jax.tree.map(lambda x: x.reshape(count // at_once, at_once, *x.shape[1:]), rods)
    found = jax.lax.map(jax.vmap(scattering.quantities), lanes)
    return Quantities(*(x.reshape(count, *x.shape[2:]) for x in found))


def by_derivatives(slopes: Slopes) -> Moments:
    """Of the normal distribution of the first order."""
    nothing = Quantities(*(np.zeros_like(x) for x in slopes.here))
    return Moments.sums(slopes.by)._replace(shift=nothing)


def by_samples(
    scattering: Scattering, here: Quantities, zs: Float[np.ndarray, "k p"], workers: Workers
) -> tuple[Moments, Float[np.ndarray, "c m"]]:
    """Of a Monte Carlo, and the values of its c rods that are at rest."""
    parts = {}
    for number, found, converged in scattering.solved(zs, workers):
        changes = Quantities(*(x[converged] - x0[None] for x, x0 in zip(found, here, strict=True)))
        parts[number] = Moments.sums(changes), found.values[converged]
    # Sums in the order of the parts, so that roundings do not depend on which was done first.
    sums_of, values = zip(*(parts[number] for number in sorted(parts)), strict=True)
    count = sum(map(len, values))
    sums = jax.tree.map(lambda *x: functools.reduce(np.add, x), *sums_of)
    mean = Quantities(*(x / max(count, 1) for x in sums.shift))
    last = max(count - 1, 1)
    squares = [np.einsum("nc,nd->ncd", x, x) for x in (mean.nodes, mean.forces)]
    moments = Moments(
        mean,
        np.maximum(sums.values - count * mean.values**2, 0.0) / last,
        *((x - count * square) / last for x, square in zip(sums[2:], squares, strict=True)),
    )
    return moments, np.concatenate(values)


def by_few(scattering: Scattering, slopes: Slopes, workers: Workers) -> tuple[Moments, Moments, int]:
    """By the three-point rule along each of the p normal numbers, as if each acted alone; of the values also along the
    direction in which each grows most; and how many of the rods are not at rest, in whose stead is the first order.
    """
    p, m = len(scattering.root), len(slopes.here.values)
    steepest = np.nan_to_num(slopes.by.values.T, posinf=0.0, neginf=0.0)
    sizes = np.linalg.norm(steepest, axis=1, keepdims=True)
    directions = np.concatenate([np.eye(p), steepest / np.where(sizes > 0, sizes, 1.0)])
    signed = np.concatenate([STEP * directions, -STEP * directions])
    chunks = {number: part for number, *part in scattering.solved(signed, workers)}
    founds, at_rest = zip(*(chunks[number] for number in sorted(chunks)), strict=True)
    converged = np.concatenate(at_rest)
    rods = Quantities(*(np.concatenate(x) for x in zip(*founds, strict=True)))
    # Without rods at rest on both sides nothing is known beyond the first order.
    is_known = np.all(converged.reshape(2, -1), axis=0)
    changes = []
    for x, x0, by in zip(rods, slopes.here, slopes.by, strict=True):
        change = (x - x0[None]).reshape(2, p + m, *x0.shape)
        linear = np.tensordot(signed, by, 1).reshape(change.shape)
        changes.append(np.where(is_known.reshape(1, -1, *[1] * x0.ndim), change, linear))
    slope = Quantities(*((x[0] - x[1]) / (2 * STEP) for x in changes))
    bend = Quantities(*((x[0] + x[1]) / STEP**2 for x in changes))

    def moments(slope: Quantities, bend: Quantities) -> Moments:
        first, second = Moments.sums(slope), Moments.sums(bend)
        total = jax.tree.map(lambda a, b: a + b / 2, first, second)
        return total._replace(shift=Quantities(*(x / 2 for x in second.shift)))

    each = moments(*(Quantities(*(x[:p] for x in of)) for of in (slope, bend)))
    own = range(m), range(p, p + m)
    steep_slope, steep_bend = (of.values[own[1], own[0]] for of in (slope, bend))
    steep = each._replace(shift=each.shift._replace(values=steep_bend / 2), values=steep_slope**2 + steep_bend**2 / 2)
    return each, steep, int(np.sum(~converged))
