"""Does a solve end in a minimum, whatever the scene, from the library's own first shape?

Random scenes (20000; `--scenes`) over all pairs of supports: end frames uniform on SO(3), span 0.02 L to 1.2 L, weight
w L^3/EI 0 to 1e4, turns -5 to 5 between clamps, 4 to 500 segments, L/R 10 to 1e6. All of one pair and mesh are solved
by `solve_batch` at its defaults. Every claim of a minimum is examined again: the factorisation's inertia of all, and
the dense eigenvalues of a sample. Prints outcomes, the slowest cases, the worst residuals, and what failed with its
reason and seed.
"""

import argparse
import itertools
import time
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation
from measuring import conditions, set_up

import rodjax
from rodjax import Clamp, Equilibrium, Free, Pin, Rod, Scene, Status, Swivel
from rodjax.discretization.form import NEUTRAL
from rodjax.linalg.saddle_point import SaddlePointSystem
from rodjax.solving.result_form import form_and_point, over_leading_axes

KINDS: dict[str, Callable] = {
    "clamp": lambda position, frame: Clamp(position, frame),
    "swivel": lambda position, frame: Swivel(position, frame[:, 2]),
    "pin": lambda position, frame: Pin(position),
    "free": lambda position, frame: Free(),
}
PAIRS = [
    (start, end) for start, end in itertools.product(KINDS, KINDS) if KINDS[start] is not KINDS["free"] or end != "free"
]
SIZES = (4, 8, 15, 32, 63, 125, 250, 500)
# Meshes of each pair of supports, each a program to compile.
SIZES_OF_A_PAIR = 3
# A hang: so many times the work of the median scene.
HANG = 50
# Dense eigenvalues below so many roundings of the largest have no sign.
ROUNDINGS = 64


class Numbers(NamedTuple):
    """What is random in a scene, dimensionless; a leading axis for many scenes."""

    slenderness: np.ndarray
    span: np.ndarray
    chord: np.ndarray
    start: np.ndarray
    end: np.ndarray
    load: np.ndarray
    down: np.ndarray
    turns: np.ndarray


class Group(NamedTuple):
    """All scenes of one pair of supports on one mesh, and what was found."""

    pair: tuple[str, str]
    segments: int
    numbers: Numbers
    result: Equilibrium
    seconds: float
    negative: np.ndarray
    is_minimum: np.ndarray


def main(argv: Sequence[str] | None = None) -> list[Group]:
    options = _options(argv)
    set_up()
    rodjax.enable_compilation_cache()
    print(conditions())
    meshes = [
        (pair, SIZES[(len(PAIRS) * k + number) * 5 % len(SIZES)])
        for number, pair in enumerate(PAIRS)
        for k in range(options.meshes)
    ]
    generator = np.random.default_rng(options.seed)
    share = -(-options.scenes // len(meshes))
    groups: list[Group] = []
    for pair, segments in meshes:
        if options.only and "-".join(pair) not in options.only:
            draw(generator, share)
            continue
        groups.append(solved(pair, segments, draw(generator, share)))
        _print_group(groups[-1])
    print()
    _print_failures(groups)
    if options.sample:
        _check_dense(groups, options.sample, generator)
    return groups


def draw(generator: np.random.Generator, count: int) -> Numbers:
    def directions() -> np.ndarray:
        vectors = generator.normal(size=(count, 3))
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    def frames() -> np.ndarray:
        quaternions = generator.normal(size=(count, 4))
        return np.asarray(jax.vmap(lambda q: Rotation.from_quat(q).as_matrix())(jnp.asarray(quaternions)))

    # The load from none to 1e4, as often below 1 as in each decade above.
    decades = generator.uniform(-1.0, 4.0, count)
    return Numbers(
        slenderness=10 ** generator.uniform(1.0, 6.0, count),
        span=generator.uniform(0.02, 1.2, count),
        chord=directions(),
        start=frames(),
        end=frames(),
        load=np.where(decades < 0, np.maximum(0.0, decades + 0.5) * 2, 10**decades),
        down=directions(),
        turns=generator.integers(-5, 6, count).astype(float),
    )


def scene(pair: tuple[str, str], numbers: Numbers) -> Scene:
    """The rod has EI = 1 N m^2 and L = 1 m; gravity gives it the weight."""
    EI, ratio = 1.0, numbers.slenderness
    rod = Rod(1.0, EI, EI / 1.3, 4 * EI * ratio**2, mass_per_length=1.0)
    start = KINDS[pair[0]](jnp.zeros(3), numbers.start)
    end = KINDS[pair[1]](numbers.span * numbers.chord, numbers.end)
    turns = numbers.turns if pair == ("clamp", "clamp") else None
    return Scene(rod, start, end, gravity=numbers.load * numbers.down, turns=turns)


def solved(pair: tuple[str, str], segments: int, numbers: Numbers) -> Group:
    scenes = jax.vmap(lambda numbers: scene(pair, numbers))(jax.tree.map(jnp.asarray, numbers))
    begin = time.perf_counter()
    result = jax.block_until_ready(_quietly(lambda: rodjax.solve_batch(scenes, segments=segments, strain_limit=None)))
    seconds = time.perf_counter() - begin
    index = np.asarray(result.index)
    is_minimum = np.asarray(result.converged & result.stable) & (index == 0)
    return Group(pair, segments, numbers, result, seconds, index, is_minimum)


def _quietly(function: Callable[[], Equilibrium]) -> Equilibrium:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rodjax.NotConvergedWarning)
        return function()


def _print_group(group: Group) -> None:
    result = group.result
    evaluations = np.asarray(result.evaluations)
    residual = np.where(result.converged, result.residual, 0.0)
    codes, counts = np.unique(np.asarray(result.status), return_counts=True)
    status = ", ".join(f"{count} {Status(code).name}" for code, count in zip(codes, counts, strict=True))
    print(
        f"{'-'.join(group.pair):>14} N = {group.segments:3d}: {np.mean(group.is_minimum):8.2%} minima of "
        f"{len(evaluations)}, evaluations {np.median(evaluations):.0f} (99 % {np.percentile(evaluations, 99):.0f}, "
        f"most {np.max(evaluations)}), residual <= {np.max(residual):.1e}, {group.seconds:.1f} s; {status}",
        flush=True,
    )


def _print_failures(groups: list[Group]) -> None:
    evaluations = np.concatenate([np.asarray(group.result.evaluations) for group in groups])
    minima = np.concatenate([group.is_minimum for group in groups])
    claims = np.concatenate([np.asarray(group.result.converged) for group in groups])
    small = np.concatenate([np.asarray(group.result.residual) <= 1e-8 for group in groups])
    print(f"{np.sum(minima)} of {len(minima)} ended in a verified minimum: {np.mean(minima):.3%}")
    print(f"of these {np.sum(minima & small)} with a residual below 1e-8, the others at the rounding floor above it")
    print(f"{np.sum(claims & ~minima)} claims of convergence that are no minimum")
    most = HANG * np.median(evaluations)
    print(f"{np.sum(evaluations > most)} took more than {HANG} times the median work of {np.median(evaluations):.0f}")
    for group in groups:
        for case in np.flatnonzero(~group.is_minimum):
            result, n = (jax.tree.map(lambda leaf, case=case: leaf[case], x) for x in (group.result, group.numbers))
            print(
                f"  {'-'.join(group.pair)} N = {group.segments} case {case}: {Status(int(result.status)).name}, "
                f"residual {float(result.residual):.1e}, index {group.negative[case]}, "
                f"{int(result.iterations)} iterations; L/R = {n.slenderness:.3g}, span {n.span:.3f}, "
                f"load {n.load:.3g}, turns {n.turns:.0f}"
            )


@over_leading_axes
def _dense(equilibrium: Equilibrium) -> tuple[jax.Array, jax.Array]:
    """The bordered Hessian by the rotations of the tangents as one dense matrix, identity where a tangent is held; and
    as many zeros as it has multipliers.
    """
    form, point = form_and_point(equilibrium)
    system = form.linearized(point).system
    assert isinstance(system, SaddlePointSystem)
    b, k, m = system.border.shape
    columns = jnp.eye(b * m + k)
    f, c = jax.vmap(lambda x: system.times(x[: b * m].reshape(b, m), x[b * m :]))(columns)
    return jnp.concatenate([f.reshape(len(columns), -1), c], axis=1), jnp.zeros(k)


def _check_dense(groups: list[Group], sample: int, generator: np.random.Generator) -> None:
    """The number of negative eigenvalues, from the dense matrices of a sample."""
    agree, looked_at, near = 0, 0, 0
    converged = [
        (group, case)
        for group in groups
        if group.segments <= 125
        for case in np.flatnonzero(np.asarray(group.result.converged))
    ]
    for number in generator.choice(len(converged), min(sample, len(converged)), replace=False):
        group, case = converged[number]
        matrix, multipliers = _dense(jax.tree.map(lambda leaf, case=case: leaf[case], group.result))
        values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
        looked_at += 1
        rounding = ROUNDINGS * np.finfo(float).eps * np.max(np.abs(values))
        if np.min(np.abs(values)) < max(10 * NEUTRAL / len(values), rounding):
            near += 1
            continue
        negative = np.sum(values < 0) - len(multipliers)
        agree += int(negative == group.negative[case])
        if negative != group.negative[case]:
            print(
                f"  {'-'.join(group.pair)} N = {group.segments} case {case}: index {group.negative[case]}, of the "
                f"dense matrix {negative}; nearest to zero {np.sort(np.abs(values))[:3] * len(values)}"
            )
    print(f"dense eigenvalues of {looked_at} converged: {agree} agree with the index, {near} too near zero to tell")


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20_000)
    parser.add_argument("--meshes", type=int, default=SIZES_OF_A_PAIR, help="of each pair of supports")
    parser.add_argument("--sample", type=int, default=1000, help="scenes whose dense eigenvalues are looked at")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="pairs of supports, such as clamp-pin")
    return parser.parse_args(argv)


if __name__ == "__main__":
    main()
