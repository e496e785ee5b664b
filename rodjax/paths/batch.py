"""Batches: many independent scenes of one structure, each solved from its own start.

`jax.vmap` of a solve runs every rod until the slowest has converged. Here so many rods as are quick to compute side by
side, the lanes, make their turns of Newton's method together, and a lane whose rod is done takes the next scene: one
compiled loop without idle work, until there are no more scenes. Many scenes go in chunks, which threads share.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from rodjax.checks import instance, is_known, leaf, sequence
from rodjax.discretization.first_twist import FirstTwist
from rodjax.discretization.mixed import MixedForm
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene, has_friction, has_node_positions, slides
from rodjax.notes import bar
from rodjax.paths.harness_path import harness_batch, unstacked
from rodjax.paths.path import check_still, path_from, stack_scenes
from rodjax.programs.answers import one_answer
from rodjax.programs.compilation import compiled
from rodjax.programs.tasks import as_completed, checked_threads
from rodjax.solving.equilibrium import is_here, refined_together
from rodjax.solving.first_state import first_state
from rodjax.solving.guess import Guess
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.implicit import differentiable, not_differentiated
from rodjax.solving.newton import Find, Newton, NewtonEnd, NewtonState, begin, ended, is_running, turn
from rodjax.solving.options import Discretization, Options, Solver, checked_options, checked_strain_limit
from rodjax.solving.ranges import check_ranges, with_ranges
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium, build_result
from rodjax.solving.result_warnings import warn_of_outcome
from rodjax.solving.search import Search, in_units_of, solve_from
from rodjax.solving.solver_state import Found, SolverState

# Rods computed side by side: more amortise what a loop costs beside its numbers, and wait for the last rods of all. On
# an H200 8192 take 1.14 us a scene at 50 segments, 1024 take 1.78.
LANES, ACCELERATOR_LANES = 8, 8192
# Scenes in one call of a compiled program, and up to how many scenes in all: of the first that allows so many; more go
# by the last. The fewer in a call, the more threads share them, and the longer lanes idle at its end: 128 take 11 %
# more time a scene than 1024, 256 take 6 %. What is prepared for a scene takes some 20 kB at 50 segments.
CHUNKS = ((16, 16), (128, 128), (256, 4096), (1024, math.inf))
# The same of scenes that go one after another, of which none waits at the end.
IN_TURN = 4
ACCELERATOR_CHUNKS = ((1024, 1024), (8192, 8192), (65536, math.inf))


@one_answer
def solve_batch(
    scenes: Sequence[Scene] | Sequence[Sequence[Scene]] | Scene | Sequence[Harness] | Harness,
    *,
    segments: int | None = None,
    rtol: float | None = None,
    discretization: Discretization | None = None,
    solver: Solver | None = None,
    guess: Any = None,
    planar: bool = False,
    find: Find = "minimum",
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
    mesh: Mesh | None = None,
    threads: int | None = None,
    progress: bool | None = None,
) -> Any:
    """The equilibria of independent scenes of one structure, or of independent paths; or of harnesses.

    **Arguments:**

    - `scenes`: `Scene`s of one structure, or one `Scene` whose leaves have a leading axis; or sequences of `Scene`s of
        one length, each a path as for `rodjax.solve_path`, or one `Scene` with two leading axes, paths and steps; or
        `Harness`es of one structure, or one `Harness` with a leading axis, each solved by itself.
    - `guess`: one for all scenes, or an `Equilibrium` with a leading axis, one for each, from which friction acts.
    - `mesh`: a `jax.sharding.Mesh` of one axis whose devices share the scenes; `None`: JAX's default device. Over
        several processes every one of them passes the same scenes, as many as the devices or a multiple.
    - `threads`: the most that share many scenes, without `mesh`; `None`: the environment variable `RODJAX_THREADS`,
        or one for each core. The result of compiled programs (`rodjax.numpy_first`) is the same to the last bit
        whatever their number.
    - `progress`: whether a bar on stderr tells of it; `None`: in a terminal or notebook, after 2 s.
    - `segments`, `rtol`, `discretization`, `solver`, `planar`, `find`, `strain_limit`: as for `rodjax.solve`. All
        scenes have one mesh: where the estimated error of any is above `rtol`, all are solved on a finer one.

    Returns an `Equilibrium` with a leading axis, one entry a scene; for paths with two. A scene that does not converge
    is marked, and all others are not affected. Of harnesses a `HarnessEquilibrium`.
    """
    if isinstance(scenes, Harness):
        if scenes.scenes[0].rod.length.ndim != 1:
            raise ValueError("scenes must be several harnesses, a list or one with a leading axis, got a single one")
        scenes = list(unstacked(scenes))
    if isinstance(scenes, (list, tuple)) and scenes and isinstance(scenes[0], Harness):
        if mesh is not None:
            raise ValueError("mesh must be None for harnesses, each of which is solved by itself")
        numbers: dict[str, Any] = {"segments": segments, "rtol": rtol, "guess": guess, "strain_limit": strain_limit}
        how: dict[str, Any] = {"discretization": discretization, "solver": solver, "planar": planar, "find": find}
        return _of_harnesses(cast(Sequence[Harness], scenes), threads=threads, **numbers, **how)
    stacked = _stacked(cast(Sequence[Scene] | Sequence[Sequence[Scene]] | Scene, scenes))
    check_ranges(*not_differentiated(stacked))
    return solve_stack(
        stacked,
        guess,
        segments=segments,
        rtol=rtol,
        discretization=discretization,
        solver=solver,
        planar=planar,
        find=find,
        strain_limit=strain_limit,
        mesh=mesh,
        threads=threads,
    )


def solve_stack(
    stacked: Scene | Harness,
    guess: Any = None,
    *,
    strain_limit: Any = DEFAULT_STRAIN_LIMIT,
    mesh: Mesh | None = None,
    threads: int | None = None,
    **settings: Any,
) -> Any:
    """The same of stacked scenes of which some may have supports that are too far apart, as in a search; or of stacked
    harnesses, of which no warning tells what is wrong with them.

    `settings`: the other arguments of `solve_batch`.
    """
    if isinstance(stacked, Harness):
        harnesses, how = list(unstacked(stacked)), {"strain_limit": strain_limit, "threads": threads}
        return _of_harnesses(harnesses, guess=guess, is_told=False, **how, **settings)
    threads = checked_threads(threads)
    if mesh is not None:
        instance(mesh, "mesh", Mesh)
        if len(mesh.axis_names) != 1:
            raise ValueError(f"mesh must have one axis, got {mesh.axis_names}")
    given, guess = not_differentiated(stacked, guess)
    count = given.rod.length.shape[0]
    if isinstance(guess, Equilibrium) and guess.s.ndim > 1 and guess.s.shape[:-1] != (count,):
        raise ValueError(f"guess must be single or hold {count}, one for each scene; got a stack {guess.s.shape[:-1]}")
    if given.rod.length.ndim == 2:
        check_still(given, axis=1)
    options, rtol = checked_options(given, guess=guess, **settings)
    strain_limit = checked_strain_limit(strain_limit)

    def solve(options: Options, last: Equilibrium | None) -> Equilibrium:
        # A path has one guess, for its first scene; a step with friction is one from the guess.
        begin = guess if last is None or last.s.ndim > 2 or has_friction(given) else last
        return _in_chunks(given, begin, strain_limit, options, mesh, threads)

    result = with_ranges(given, refined_together(solve, options, rtol))
    if is_here(result):
        warn_of_outcome(result, strain_limit)
    return differentiable(stacked, result)


def _of_harnesses(harnesses: Sequence[Harness], *, guess: Any, **options: Any) -> HarnessEquilibrium:
    processor = None if is_on_processor() or not is_known(harnesses, guess) else _processor()
    if processor is None:
        return harness_batch(harnesses, guess=guess, **options)
    # One at a time an accelerator only waits for its next small program.
    with jax.default_device(processor):
        harnesses, guess = jax.tree.map(np.asarray, (harnesses, guess))
        return harness_batch(harnesses, guess=guess, **options)


def _stacked(scenes: Sequence[Scene] | Sequence[Sequence[Scene]] | Scene) -> Scene:
    if isinstance(scenes, Scene):
        return scenes if scenes.rod.length.ndim == 2 else stack_scenes(scenes)
    rows = sequence(scenes, "scenes", "Scene, or of lists of them")
    for k, row in enumerate(rows):
        instance(row, f"scenes[{k}]", (Scene, Sequence))
    rows = [row if isinstance(row, Scene) else stack_scenes(row) for row in rows]
    lengths = {row.rod.length.shape for row in rows}
    if len(lengths) > 1:
        raise ValueError(f"scenes must be single scenes or paths of one length, got shapes {sorted(lengths)}")
    return stack_scenes(rows)


def is_on_processor(mesh: Mesh | None = None) -> bool:
    """Whether programs run on a processor: on the devices of a mesh, or on JAX's default device."""
    if mesh is not None:
        return mesh.devices.flat[0].platform == "cpu"
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return getattr(device, "platform", device or jax.default_backend()) == "cpu"


def _processor() -> Any:
    """JAX's device for it; `None` where JAX was told to have none."""
    with contextlib.suppress(RuntimeError):
        return jax.devices("cpu")[0]
    return None


def lane_count(mesh: Mesh | None = None) -> int:
    """So many rods are computed side by side."""
    return LANES if is_on_processor(mesh) else ACCELERATOR_LANES


def chunk_size(count: int, mesh: Mesh | None = None) -> int:
    """Scenes in one call, of so many in all; that threads share them changes nothing."""
    chunks = CHUNKS if is_on_processor(mesh) else ACCELERATOR_CHUNKS
    return next(size for size, most in chunks if count <= most)


def _in_chunks(
    scenes: Scene,
    guess: Guess | Equilibrium | None,
    strain_limit: Float[Array, ""] | float,
    options: Options,
    mesh: Mesh | None,
    threads: int,
) -> Equilibrium:
    count = scenes.rod.length.shape[0]
    each = _is_stack(guess)
    devices = 1 if mesh is None else mesh.size
    share = -(-count // devices)
    lanes, chunk = lane_count(mesh), chunk_size(share, mesh)
    is_traced, is_in_turn = not is_known(scenes, guess), _go_in_turn(scenes, options)
    if is_in_turn and mesh is None and is_on_processor():
        chunk = IN_TURN
    elif is_in_turn and mesh is None and not is_traced:
        processor = _processor()  # see `_of_harnesses`
        if processor is not None:
            with jax.default_device(processor):
                scenes, guess = jax.tree.map(np.asarray, (scenes, guess))
                return _in_chunks(scenes, guess, strain_limit, options, None, threads)
    if mesh is not None and (is_traced or jax.process_count() > 1):
        if count % devices:
            raise ValueError(
                f"scenes must be a multiple of the {devices} devices of mesh, inside jit or over several processes; "
                f"got {count}"
            )
        chunk = share
    if is_traced:
        return _solve_many(scenes, guess, jnp.full(devices, share), strain_limit, options, mesh, lanes)

    def solved(first: int) -> Equilibrium:
        last = min(first + chunk * devices, count)
        part = functools.partial(_part, first=first, last=last, size=chunk * devices)
        counts = np.clip(last - first - chunk * np.arange(devices), 0, chunk)
        inputs = jax.tree.map(part, scenes), jax.tree.map(part, guess) if each else guess, counts
        if mesh is not None:
            sharding = jax.sharding.NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))
            whole = jax.sharding.NamedSharding(mesh, PartitionSpec())
            shardings = (sharding, sharding if each else whole, sharding)
            inputs = tuple(jax.device_put(x, place) for x, place in zip(inputs, shardings, strict=True))
        return jax.block_until_ready(_solve_many(*inputs, strain_limit, options, mesh, lanes))

    firsts = range(0, count, chunk * devices)
    if len(firsts) == 1:
        parts = {0: solved(0)}
    else:
        # Of several devices each call uses all; one accelerator has no room for many.
        at_once = 1 if mesh is not None else threads if is_on_processor() else min(threads, 2)
        # A few that go one after another take less time by NumPy code than the compiler does.
        results = as_completed(
            solved, ((first,) for first in firsts), threads=at_once, by_numpy=is_in_turn, count=len(firsts)
        )
        parts = {}
        with bar(count, "cases") as drawn:
            for k, part in results:
                parts[k] = part
                drawn.update(min(chunk * devices, count - firsts[k]))
    if count == chunk * devices:
        return parts[0]
    found = [parts[k] for k in range(len(parts))]
    if not is_on_processor(mesh):  # results stay there
        return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *found)
    return jax.tree.map(lambda *x: jax.device_put(np.concatenate(x)[:count]), *found)


def _go_in_turn(scenes: Scene, options: Options) -> bool:
    """Whether scenes are solved one after another: side by side all would wait for the slowest in each of the loops
    that a solve has within its own.
    """
    is_path = scenes.rod.length.ndim == 2
    return is_path or not isinstance(options.solver, Newton) or slides(scenes) or has_node_positions(scenes)


def _is_stack(guess: Guess | Equilibrium | None) -> bool:
    return isinstance(guess, Equilibrium) and guess.s.ndim > 1


def _part(x: Array, first: int, last: int, size: int) -> Any:
    """Entries `first` to `last`, and the last of them again up to `size`."""
    if last - first == size == len(x):
        return x
    if is_on_processor():
        if last - first == size:
            return np.asarray(x)[first:last]
        return np.asarray(x)[np.minimum(np.arange(first, first + size), last - 1)]
    if last - first == size:
        return jax.lax.dynamic_slice_in_dim(x, first, size)
    return jnp.asarray(x)[np.minimum(np.arange(first, first + size), last - 1)]


def solve_first(scenes: Scene | Harness, guesses: Any, count: int, options: Options) -> Any:
    """The first `count` of stacked scenes or harnesses, each from its guess, without derivatives; of the others nothing
    of use.
    """
    if isinstance(scenes, Harness) or _go_in_turn(scenes, options):
        first, begins = jax.tree.map(lambda x: np.asarray(x)[:count], (scenes, guesses))
        if isinstance(first, Harness):
            numbers: dict[str, Any] = {"segments": options.segments, "solver": options.solver, "find": options.find}
            found = solve_stack(first, begins, strain_limit=None, **numbers)
        else:
            found = _in_chunks(first, begins, DEFAULT_STRAIN_LIMIT, options, None, checked_threads(None))
        which = np.minimum(np.arange(len(guesses.energy)), count - 1)
        return jax.tree.map(lambda x: leaf(np.asarray(x)[which]), found)
    return _solve_many(scenes, guesses, np.array([count]), DEFAULT_STRAIN_LIMIT, options, None, lane_count())


@functools.partial(compiled, static_argnames=("mesh", "lanes"))
def _solve_many(
    scenes: Scene,
    guess: Guess | Equilibrium | None,
    counts: Int[Array, "devices"],
    strain_limit: Float[Array, ""] | float,
    options: Options,
    mesh: Mesh | None,
    lanes: int,
) -> Equilibrium:
    """The first of the scenes, as many as `counts` tells each device; of the rest something without meaning."""
    solve = functools.partial(_solve_here, lanes=min(lanes, len(scenes.rod.length) // len(counts)))
    if mesh is None:
        return solve(scenes, guess, counts, strain_limit, options)
    # Not `jit` with sharded inputs, which would ask all devices in each turn whether all are done.
    shared = PartitionSpec(mesh.axis_names[0])
    whole = PartitionSpec()
    specs = (shared, shared if _is_stack(guess) else whole, shared, whole, whole)
    many = jax.shard_map(solve, mesh=mesh, in_specs=specs, out_specs=shared, check_vma=False)
    return many(scenes, guess, counts, *jax.tree.map(jnp.asarray, (strain_limit, options)))


def _solve_here(
    scenes: Scene,
    guess: Guess | Equilibrium | None,
    counts: Int[Array, "1"],
    strain_limit: Float[Array, ""] | float,
    options: Options,
    *,
    lanes: int,
) -> Equilibrium:
    if scenes.rod.length.ndim == 2:
        path = functools.partial(path_from, strain_limit=strain_limit, options=options)
        return _in_turn(path, scenes, guess, counts[0])

    def state(scene: Scene, guess: Guess | Equilibrium | None) -> tuple[SolverState, FirstTwist]:
        return first_state(scene, guess, options)

    def search(scene: Scene, start: tuple[SolverState, FirstTwist]) -> Search:
        return Search.of(*in_units_of(scene, start[0]), start[1], options)

    def result(scene: Scene, found: Found) -> Equilibrium:
        return build_result(scene, found, jnp.ones((), int), strain_limit)

    if _go_in_turn(scenes, options):

        def whole(scene: Scene, guess: Guess | Equilibrium | None) -> Equilibrium:
            return result(scene, solve_from(scene, *state(scene, guess), options))

        return _in_turn(whole, scenes, guess, counts[0])
    assert isinstance(options.solver, Newton)
    starts = jax.vmap(state, (0, 0 if _is_stack(guess) else None))(scenes, guess)
    mapped = functools.partial(_mapped, lanes)
    searches = mapped(search, scenes, starts)
    ends = _ends(searches, counts[0], lanes, options.solver, options.find)
    return mapped(lambda scene, search, end: result(scene, search.found(end)), scenes, searches, ends)


def _in_turn(
    solve: Callable[[Scene, Any], Equilibrium],
    scenes: Scene,
    guess: Guess | Equilibrium | None,
    count: Int[Array, ""],
) -> Equilibrium:
    """The first `count` one after another."""
    is_each = _is_stack(guess)

    def solved(k: Int[Array, ""]) -> Equilibrium:
        scene, own = jax.tree.map(lambda leaf: leaf[k], (scenes, guess if is_each else None))
        return solve(scene, own if is_each else guess)

    def added(k: Int[Array, ""], results: Equilibrium) -> Equilibrium:
        return jax.tree.map(lambda all, new: all.at[k].set(new), results, solved(k))

    total = len(scenes.rod.length)
    struct = jax.eval_shape(solved, jnp.zeros((), int))
    results = jax.tree.map(lambda leaf: jnp.zeros((total, *leaf.shape), leaf.dtype), struct)
    return jax.lax.fori_loop(0, count, added, results)


def _mapped(lanes: int, function: Callable, *stacks: Any) -> Any:
    """`function` of each entry of the stacks, so many at a time as fit into a processor's cache."""
    return jax.lax.map(lambda entries: function(*entries), stacks, batch_size=lanes)


class _Lanes(eqx.Module):
    """The lanes: which search each is at, one past the last where none is left; and what has been found."""

    search: Int[Array, "lanes"]
    forms: MixedForm
    states: NewtonState
    following: Int[Array, ""]
    ends: NewtonEnd


def _ends(searches: Search, count: Int[Array, ""], lanes: int, solver: Newton, find: Find) -> NewtonEnd:
    """Where the first `count` of the searches end."""
    total, begun = searches.point.total_twist.shape[0], jax.vmap(functools.partial(begin, find=find))

    def started(search: Int[Array, "lanes"]) -> tuple[MixedForm, NewtonState]:
        at = jnp.minimum(search, total - 1)
        forms, points = jax.tree.map(lambda leaf: leaf[at], (searches.form, searches.point))
        return forms, begun(forms, points)

    def advanced(lanes: _Lanes) -> _Lanes:
        going = is_running(lanes.states)
        states = jax.vmap(functools.partial(turn, solver=solver, find=find))(lanes.forms, lanes.states)
        states = _chosen(going, states, lanes.states)
        lanes = eqx.tree_at(lambda lanes: lanes.states, lanes, states)
        # Apart from what each lane computes: on an accelerator a sum is one block's work, and would draw that along.
        ends, used = jax.lax.optimization_barrier((~is_running(states), lanes.search < count))
        done = ends & used
        # Handing over takes longer than a turn of one rod, and so waits for a few.
        enough = jnp.where(lanes.following < count, len(done) // 4, jnp.sum(used))
        return jax.lax.cond(jnp.sum(done) >= jnp.maximum(enough, 1), handed_over, lambda lanes, _: lanes, lanes, done)

    def handed_over(lanes: _Lanes, done: Bool[Array, "lanes"]) -> _Lanes:
        ends = jax.vmap(ended)(lanes.forms, lanes.states)
        to = jnp.where(done, lanes.search, total)
        ends = jax.tree.map(lambda all, new: all.at[to].set(new, mode="drop"), lanes.ends, ends)
        following = lanes.following + jnp.cumsum(done)
        search = jnp.where(done, jnp.minimum(following - 1, count), lanes.search)
        forms, states = _chosen(done, started(search), (lanes.forms, lanes.states))
        return _Lanes(search, forms, states, following[-1], ends)

    first = jnp.minimum(jnp.arange(lanes), count)
    forms, states = started(first)
    nothing = jax.eval_shape(jax.vmap(ended), searches.form, begun(searches.form, searches.point))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), nothing)
    start = _Lanes(first, forms, states, jnp.minimum(jnp.full_like(count, lanes), count), nothing)
    return jax.lax.while_loop(lambda lanes: jnp.any(lanes.search < count), advanced, start).ends


def _chosen(which: Bool[Array, "lanes"], new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)
