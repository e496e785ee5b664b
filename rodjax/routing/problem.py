"""A route as numbers: from design variables in 0 to 1 to what is least, what must not be negative, and their rates."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.cells import segments_for_jumps
from rodjax.geometry.vectors import dot, root
from rodjax.model.along import Along
from rodjax.model.harness import Harness, scenes_of
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene
from rodjax.model.supports import Clip, Held, Support
from rodjax.programs.compilation import compiled
from rodjax.programs.parts import traced_once
from rodjax.routing.limits import Limits
from rodjax.routing.margins import Measured, measured
from rodjax.routing.objective import Objective
from rodjax.routing.variables import Variable, leaf_names, with_numbers
from rodjax.solving.harness_derivatives import jacobian
from rodjax.solving.harness_result import Solution, solved_in
from rodjax.solving.options import Solver

T = TypeVar("T")


class Problem(eqx.Module):
    """What `route` was asked for."""

    scene: Scene | Harness
    variables: tuple[Variable, ...]
    limits: Limits | None
    obstacles: tuple[Obstacle, ...]
    objective: Objective
    segments: int = eqx.field(static=True)
    solver: Solver = eqx.field(static=True)

    def scene_at(self, u: Float[Array, "n"]) -> Any:
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
    result: Solution
    is_valid: Bool[Array, "..."]


def spans(problem: Problem, scene: Scene | Harness) -> list[Float[Array, "spans"]]:
    """By how much a rod between held places is longer than the straight way, as parts of the rod's length, and than
    a rod is that is pulled as tight as the limits of force allow; of each rod.

    Of a rod that may become shorter or move, else nothing: a rod that is given is as it is. Sliding clips hold no place
    of the rod, nor do joints.
    """
    names = leaf_names(problem.scene, problem.variables)
    tightening = [name for name in names if name.endswith((".length", ".at", ".position"))]
    return [
        _spans_of_rod(problem.limits, rod)
        if any(name.startswith(path) for name in tightening)
        else jnp.zeros(0, rod.rod.length.dtype)
        for path, rod in scenes_of(scene, "cables.{}.").items()
    ]


def span_names(problem: Problem) -> tuple[str, ...]:
    """Of all spans, as `spans` has them one after another."""
    of_rods = zip(scenes_of(problem.scene, "{}: "), jax.eval_shape(lambda: spans(problem, problem.scene)), strict=True)
    return tuple(f"{prefix}length of the rod in span {k}" for prefix, found in of_rods for k in range(len(found)))


def _spans_of_rod(limits: Limits | None, scene: Scene) -> Float[Array, "spans"]:
    length = scene.rod.length
    supports: list[tuple[Float[Array, ""], Support | Clip, bool]] = [(jnp.zeros_like(length), scene.start, False)]
    supports += [(clip.at, clip, clip.sliding) for clip in scene.clips]
    supports += [(length, scene.end, False)]
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
            strain = _most_strain(limits, scene, min(before[3], len(supports) - 1 - k))
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


def is_meshed(problem: Problem, scene: Scene | Harness) -> Bool[Array, ""]:
    """Whether clips follow one another along each rod, each further on by a hundredth of a part of it, and none is so
    near to a jump that the mesh cannot tell them apart.
    """
    good = []
    for rod in scenes_of(scene).values():
        length = rod.rod.length
        s = jnp.stack([jnp.zeros_like(length), *(clip.at for clip in rod.clips), length])
        good.append(jnp.all(jnp.diff(s) > 0.01 * length / len(s)))
        needed = segments_for_jumps(rod)
        if needed is not None:
            good.append(needed[0] <= problem.segments)
    return jnp.all(jnp.stack(good))


def _spare(problem: Problem, scene: Scene | Harness) -> Float[Array, "spans"]:
    return jnp.concatenate(spans(problem, scene))


@compiled
def spare_lengths(problem: Problem, designs: Float[Array, "k n"]) -> Float[Array, "k"]:
    """The least of the spans of each design, minus infinity where there is no mesh for it."""

    def one(u: Float[Array, "n"]) -> Float[Array, ""]:
        scene = problem.scene_at(u)
        least = jnp.min(_spare(problem, scene), initial=jnp.inf)
        return jnp.where(is_meshed(problem, scene), least, -jnp.inf)

    return jax.vmap(one)(designs)


@compiled
def scenes_at(problem: Problem, designs: Float[Array, "k n"]) -> Any:
    """Along a leading axis."""
    return jax.vmap(problem.scene_at)(designs)


def _kept(problem: Problem, result: Solution) -> list[Measured]:
    if problem.limits is None:
        return []
    return measured(result, problem.limits, problem.obstacles, everywhere=True)


@traced_once
def _values(
    problem: Problem, scene: Scene | Harness, result: Solution
) -> tuple[Float[Array, ""], Float[Array, "m"], Float[Array, "spans"], list[Measured]]:
    """The objective, the slacks, which of them are of spans, and what they are of."""
    spare = _spare(problem, scene)
    kept = _kept(problem, result)
    return problem.objective.of(result), jnp.concatenate([spare, *(each.slack for each in kept)]), spare, kept


@traced_once
def _evaluated(problem: Problem, design: Float[Array, "n"], result: Solution) -> Evaluation:
    def outputs(_: Array, scene: Scene | Harness, near: Solution) -> tuple[Float[Array, "r"], Any]:
        objective, slacks, spare, kept = _values(problem, scene, near)
        worst = [jnp.argmin(jax.lax.stop_gradient(each.margin)) for each in kept]
        kept = [jax.tree.map(lambda x, k=k: x[k][None], each) for each, k in zip(kept, worst, strict=True)]
        margins = [each.margin for each in kept]
        return jnp.concatenate([objective[None], slacks, *margins]), (objective, slacks, spare, kept)

    _, by, (objective, slacks, spare, kept) = jacobian(outputs, problem.scene_at, design, result)
    rates = by.T
    numbers = jnp.concatenate([objective[None], slacks])
    is_valid = result.converged & is_meshed(problem, problem.scene_at(design))
    is_valid &= jnp.all(jnp.isfinite(numbers)) & jnp.all(jnp.isfinite(rates[: len(numbers)]))
    return Evaluation(design, objective, slacks, spare, kept, rates, result, is_valid)


@compiled
def arranged(
    problem: Problem, designs: Float[Array, "k n"], guesses: Solution, order: Int[Array, "k"]
) -> tuple[Float[Array, "k n"], Any, Solution]:
    """Designs and guesses in this order, and the scenes; where there is no mesh for one, that of the guess."""

    def scene(design: Float[Array, "n"], guess: Solution) -> Any:
        scene = problem.scene_at(design)
        is_possible = is_meshed(problem, scene)
        return jax.tree.map(lambda a, b: jnp.where(is_possible, a, b), scene, solved_in(guess))

    designs, guesses = jax.tree.map(lambda leaf: leaf[order], (designs, guesses))
    return designs, jax.vmap(scene)(designs, guesses), guesses


@compiled
def evaluated(
    problem: Problem,
    designs: Float[Array, "k n"],
    results: Solution,
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
    problem: Problem, designs: Float[Array, "k n"], results: Solution
) -> tuple[Float[Array, "k"], Float[Array, "k m"], Bool[Array, "k"]]:
    """The same without rates: objectives, slacks, and whether designs have an equilibrium."""

    def one(design: Float[Array, "n"], result: Solution):
        scene = problem.scene_at(design)
        objective, slacks, _, _ = _values(problem, scene, result)
        is_valid = result.converged & is_meshed(problem, scene)
        is_valid &= jnp.all(jnp.isfinite(slacks)) & jnp.isfinite(objective)
        return objective, slacks, is_valid

    return jax.lax.map(lambda entry: one(*entry), (designs, results))


def group_starts(problem: Problem, guesses: Solution) -> tuple[int, ...]:
    """The number of the first slack of each span, and of each thing that is limited."""
    one = _kind_of_one(guesses)
    _, _, spare, kept = jax.eval_shape(_values, problem, solved_in(one), one)
    count = spare.shape[0]
    sizes = [each.slack.shape[0] for each in kept]
    return (*range(count), *(count + sum(sizes[:k]) for k in range(len(sizes))))


def nothing_evaluated(problem: Problem, designs: Float[Array, "k n"], guesses: Solution) -> Evaluation:
    """What comes before the first evaluation."""
    count, unknowns = designs.shape

    def zeros(*shape: int, dtype: Any = designs.dtype) -> jax.Array:
        return jnp.zeros((count, *shape), dtype)

    # By the shapes of values alone: those of rates follow, and tracing derivatives takes seconds.
    one = _kind_of_one(guesses)
    objective, slacks, spare, kept = jax.eval_shape(_values, problem, solved_in(one), one)
    return Evaluation(
        design=zeros(unknowns),
        objective=zeros(dtype=objective.dtype),
        slacks=zeros(*slacks.shape, dtype=slacks.dtype),
        spare=zeros(*spare.shape, dtype=spare.dtype),
        kept=[jax.tree.map(lambda leaf: zeros(1, *leaf.shape[1:], dtype=leaf.dtype), each) for each in kept],
        rates=zeros(1 + slacks.shape[0] + len(kept), unknowns),
        result=jax.tree.map(jnp.zeros_like, guesses),
        is_valid=zeros(dtype=bool),
    )


def _kind_of_one(stack: T) -> T:
    """Shapes and types of an entry."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), stack)


@compiled
def chosen(which: Bool[Array, "k"], new: Any, old: Any) -> Any:
    """Of two stacks, entry by entry."""
    return jax.tree.map(lambda a, b: jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)
