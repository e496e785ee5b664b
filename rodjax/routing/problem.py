"""A route as numbers: from design variables in 0 to 1 to what is least, what must not be negative, and their rates."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.geometry.vectors import dot, root
from rodjax.model.along import Along
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene
from rodjax.model.supports import Clip, Held, Support
from rodjax.programs.compilation import compiled
from rodjax.programs.parts import traced_once
from rodjax.routing.limits import Limits
from rodjax.routing.margins import Measured, measured
from rodjax.routing.objective import Objective
from rodjax.routing.variables import Variable, leaf_names, with_numbers
from rodjax.solving.equilibrium import Solver
from rodjax.solving.implicit import differentiable
from rodjax.solving.result import Equilibrium

T = TypeVar("T")


class Problem(eqx.Module):
    """What `route` was asked for."""

    scene: Scene
    variables: tuple[Variable, ...]
    limits: Limits | None
    obstacles: tuple[Obstacle, ...]
    objective: Objective
    segments: int = eqx.field(static=True)
    solver: Solver = eqx.field(static=True)

    def scene_at(self, u: Float[Array, "n"]) -> Scene:
        return with_numbers(self.scene, self.variables, u)


class Evaluation(eqx.Module):
    """A design, or several along a leading axis. Rates are by the variables in 0 to 1.

    - `objective`; `slacks` (m,): not negative where all limits are kept, the first of them `spare`, of `spans`
    - `kept`: what the limits are compared with, at the worst place of each
    - `rates` (1 + m + k, n): of the objective, the slacks and the margins of `kept`.
    """

    design: Float[Array, "... n"]
    objective: Float[Array, "..."]
    slacks: Float[Array, "... m"]
    spare: Float[Array, "... spans"]
    kept: list[Measured]
    rates: Float[Array, "... r n"]
    result: Equilibrium
    is_valid: Bool[Array, "..."]


def spans(problem: Problem, scene: Scene) -> Float[Array, "spans"]:
    """By how much the rod between held places is longer than the straight way, as parts of the rod's length, and than
    a rod is that is pulled as tight as the limits of force allow.

    Of a rod that may become shorter or move, else nothing: a rod that is given is as it is. Sliding clips hold no place
    of the rod.
    """
    names = leaf_names(problem.scene, problem.variables)
    length = scene.rod.length
    supports: list[tuple[Float[Array, ""], Support | Clip, bool]] = [(jnp.zeros_like(length), scene.start, False)]
    supports += [(clip.at, clip, clip.sliding) for clip in scene.clips]
    supports += [(length, scene.end, False)]
    if not any(name == "rod.length" or name.endswith((".at", ".position")) for name in names):
        return jnp.zeros(0, length.dtype)
    found = []
    before = None
    for k, (s, support, is_sliding) in enumerate(supports):
        if not isinstance(support, Held | Clip):
            continue
        if before is not None:
            gap = support.position - before[1]
            way = before[2] + root(dot(gap, gap))
            if is_sliding:
                before = before[0], support.position, way, before[3]
                continue
            strain = _most_strain(problem.limits, scene, min(before[3], len(supports) - 1 - k))
            found.append(((1 + strain) * (s - before[0]) - way) / length)
        before = s, support.position, jnp.zeros_like(length), k
    return jnp.stack(found) if found else jnp.zeros(0, length.dtype)


def _most_strain(limits: Limits | None, scene: Scene, clips: int) -> Float[Array, ""]:
    """Of a span with so many clips between it and an end: the tension is that of the end and what the clips bear."""
    most = jnp.zeros_like(scene.rod.length)
    if limits is None or limits.end_force is None or (clips and limits.clip_force is None):
        return most
    stiffness = scene.rod.EA.values if isinstance(scene.rod.EA, Along) else scene.rod.EA
    force = limits.end_force if limits.clip_force is None else limits.end_force + clips * limits.clip_force
    return force.astype(most.dtype) / jnp.max(stiffness)


def is_ordered(scene: Scene) -> Bool[Array, ""]:
    """Whether clips follow one another along the rod, each further on by a hundredth of a part of it."""
    length = scene.rod.length
    s = jnp.stack([jnp.zeros_like(length), *(clip.at for clip in scene.clips), length])
    return jnp.all(jnp.diff(s) > 0.01 * length / len(s))


@compiled
def spare_lengths(problem: Problem, designs: Float[Array, "k n"]) -> Float[Array, "k"]:
    """The least of the spans of each design, minus infinity where clips do not follow one another."""

    def one(u: Float[Array, "n"]) -> Float[Array, ""]:
        scene = problem.scene_at(u)
        least = jnp.min(spans(problem, scene), initial=jnp.inf)
        return jnp.where(is_ordered(scene), least, -jnp.inf)

    return jax.vmap(one)(designs)


@compiled
def scenes_of(problem: Problem, designs: Float[Array, "k n"]) -> Scene:
    return jax.vmap(problem.scene_at)(designs)


def _kept(problem: Problem, result: Equilibrium) -> list[Measured]:
    if problem.limits is None:
        return []
    return measured(result, problem.limits, problem.obstacles, everywhere=True)


@traced_once
def _values(
    problem: Problem, scene: Scene, result: Equilibrium
) -> tuple[Float[Array, ""], Float[Array, "m"], Float[Array, "spans"], list[Measured]]:
    """The objective, the slacks, which of them are of spans, and what they are of."""
    spare = spans(problem, scene)
    kept = _kept(problem, result)
    return problem.objective.of(result), jnp.concatenate([spare, *(each.slack for each in kept)]), spare, kept


@traced_once
def _evaluated(problem: Problem, design: Float[Array, "n"], result: Equilibrium) -> Evaluation:
    def outputs(u: Float[Array, "n"]) -> tuple[Float[Array, "r"], Any]:
        scene = problem.scene_at(u)
        objective, slacks, spare, kept = _values(problem, scene, differentiable(scene, result))
        worst = [jnp.argmin(jax.lax.stop_gradient(each.margin)) for each in kept]
        kept = [jax.tree.map(lambda x, k=k: x[k][None], each) for each, k in zip(kept, worst, strict=True)]
        margins = [each.margin for each in kept]
        return jnp.concatenate([objective[None], slacks, *margins]), (objective, slacks, spare, kept)

    rates, (objective, slacks, spare, kept) = jax.jacfwd(outputs, has_aux=True)(design)
    numbers = jnp.concatenate([objective[None], slacks])
    is_valid = result.converged & is_ordered(problem.scene_at(design))
    is_valid &= jnp.all(jnp.isfinite(numbers)) & jnp.all(jnp.isfinite(rates[: len(numbers)]))
    return Evaluation(design, objective, slacks, spare, kept, rates, result, is_valid)


@compiled
def arranged(
    problem: Problem, designs: Float[Array, "k n"], guesses: Equilibrium, order: Int[Array, "k"]
) -> tuple[Float[Array, "k n"], Scene, Equilibrium]:
    """Designs and guesses in this order, and the scenes; where clips do not follow one another, that of the guess."""

    def scene(design: Float[Array, "n"], guess: Equilibrium) -> Scene:
        scene = problem.scene_at(design)
        is_possible = is_ordered(scene)
        return jax.tree.map(lambda a, b: jnp.where(is_possible, a, b), scene, guess.scene)

    designs, guesses = jax.tree.map(lambda leaf: leaf[order], (designs, guesses))
    return designs, jax.vmap(scene)(designs, guesses), guesses


@compiled
def evaluated(
    problem: Problem,
    designs: Float[Array, "k n"],
    results: Equilibrium,
    last: Evaluation,
    order: Int[Array, "k"],
    count: Int[Array, ""],
) -> Evaluation:
    """What the first `count` of the designs give with their equilibria, put where `order` says, into the last."""

    def one(k: Int[Array, ""], found: Evaluation) -> Evaluation:
        design, result = jax.tree.map(lambda leaf: leaf[k], (designs, results))
        new = _evaluated(problem, design, result)
        return jax.tree.map(lambda all, one: all.at[order[k]].set(one), found, new)

    return jax.lax.fori_loop(0, count, one, last)


@compiled
def valued(
    problem: Problem, designs: Float[Array, "k n"], results: Equilibrium
) -> tuple[Float[Array, "k"], Float[Array, "k m"], Bool[Array, "k"]]:
    """The same without rates: objectives, slacks, and whether designs have an equilibrium."""

    def one(design: Float[Array, "n"], result: Equilibrium):
        scene = problem.scene_at(design)
        objective, slacks, _, _ = _values(problem, scene, result)
        is_valid = result.converged & is_ordered(scene) & jnp.all(jnp.isfinite(slacks)) & jnp.isfinite(objective)
        return objective, slacks, is_valid

    return jax.lax.map(lambda entry: one(*entry), (designs, results))


def group_starts(problem: Problem, guesses: Equilibrium) -> tuple[int, ...]:
    """The number of the first slack of each span, and of each thing that is limited."""
    one = _kind_of_one(guesses)
    _, _, spare, kept = jax.eval_shape(_values, problem, one.scene, one)
    count = spare.shape[0]
    sizes = [each.slack.shape[0] for each in kept]
    return (*range(count), *(count + sum(sizes[:k]) for k in range(len(sizes))))


def nothing_evaluated(problem: Problem, designs: Float[Array, "k n"], guesses: Equilibrium) -> Evaluation:
    """What comes before the first evaluation."""
    found = jax.eval_shape(_evaluated, problem, *_kind_of_one((designs, guesses)))
    return jax.tree.map(lambda leaf: jnp.zeros((len(designs), *leaf.shape), leaf.dtype), found)


def _kind_of_one(stack: T) -> T:
    """Shapes and types of an entry."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), stack)


@compiled
def chosen(which: Bool[Array, "k"], new: Any, old: Any) -> Any:
    """Of two stacks, entry by entry."""
    return jax.tree.map(lambda a, b: jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)
