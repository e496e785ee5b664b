"""What does each part of an iteration cost, and what does an absent term save?

Microseconds of one evaluation in a compiled loop, on one thread: Newton's method on the mixed form, with and without
torsion, gravity and the way out of a plane; its derivatives written out and by JAX; its linear algebra and a dense
solve; the kernels of nonlinear CG. Then C++ for the same, where its program is given (`rod eval`), and how the parts
share the time of a step of Fig. 1 of Linn & Stephan (2008).

    OMP_NUM_THREADS=1 python experiments/kernels.py [--segments 10 50 100] [--limit BINARY] [--out DIR]
"""

import argparse
import functools
import math
import re
import statistics
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import Timed, compiled, conditions, number, save_rows, set_up

import rodjax
from rodjax import Newton, Scene, Swivel, problems
from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.finite_difference import FiniteDifference, Polyline
from rodjax.discretization.joints import (
    Joints,
    bending_derivatives,
    joints,
    tangent_bases,
    twist_derivatives,
    with_held_tangents,
)
from rodjax.discretization.mixed import MixedForm
from rodjax.discretization.mixed_point import MixedPoint
from rodjax.discretization.results import resultants
from rodjax.geometry.vectors import dot
from rodjax.linalg.saddle_point import SaddlePointSystem, factor, factor_and_solve
from rodjax.mechanics.strain import swept_angle
from rodjax.model.plane import plane
from rodjax.model.scene import nondimensional
from rodjax.paths.path import stack_scenes
from rodjax.solving.first_state import first_state
from rodjax.solving.options import Options
from rodjax.solving.result import build_result
from rodjax.solving.solver_state import Found, SolverState
from rodjax.solving.status import Outcome

LOOPS = 300
NUDGE = 1e-30
DENSE_UP_TO = 100  # segments; a dense solve takes the cube of their number
# The parts of a turn of Newton's loop, and what nonlinear CG does in its place.
LINEARIZED, FACTORED, MOVED = "linearized, torsion", "factor_and_solve", "moved, torsion"
GRADIENT = "energy and gradient, torsion"
LIMIT = re.compile(r"N= *(\d+) +E\+grad: (\S+) ns/segment min.*\+LDL: (\S+) ns/segment min")


class Kernel(NamedTuple):
    """`function(fixed, varying)`: arguments that a loop leaves as they are, and those that differ in every pass."""

    what: str
    function: Callable[[Any, Any], Any]
    fixed: Any
    varying: Any


class Row(NamedTuple):
    what: str
    segments: int
    us: float  # least of the repeats
    compile_s: float


class Step(NamedTuple):
    """A step of Fig. 1: means of the path's 25, and shares of the time by the times above.

    Every evaluation counts as one factorisation; those that a Hessian without definiteness adds are in the rest.
    """

    segments: int
    ms: float
    iterations: float
    evaluations: float
    linearized: float
    factored: float
    moved: float
    rest: float  # loop, conditionals, prediction, results


class Discretized(NamedTuple):
    """A scene on a mesh, in the unknowns of both solvers."""

    scene: Scene
    form: MixedForm
    point: MixedPoint
    problem: FiniteDifference
    polyline: Polyline


def scenes() -> dict[str, Scene]:
    twisted = problems.omega(0.6, 1.0)
    swivel = Swivel(twisted.end.position, twisted.end.frame[:, 2])  # pyright: ignore[reportAttributeAccessIssue]
    gravity = (0, 0, -9.81)
    return {
        "bending and stretch": Scene(twisted.rod, twisted.start, swivel),
        "gravity": Scene(twisted.rod, twisted.start, swivel, gravity=gravity),
        "torsion": twisted,
        "torsion and gravity": Scene(twisted.rod, twisted.start, twisted.end, gravity=gravity),
    }


@eqx.filter_jit
def discretized(scene: Scene, segments: int) -> Discretized:
    options = Options(segments, "finite_difference", Newton(), planar=False)
    state, first = first_state(scene, problems.figure_1_start(), options)
    scaled, _ = nondimensional(scene)
    assert isinstance(state.shape, Polyline)
    problem, polyline = FiniteDifference.begin(scaled, state.shape, first)
    form = MixedForm.of(scaled, EdgeTangents.of(scaled, segments))
    return Discretized(scene, form, problem.mixed_point(polyline), problem, polyline)


def kernels(segments: int) -> Iterator[Kernel]:
    """All lines of the table; a scene has torsion where the name of the kernel does not say otherwise."""
    given = {name: discretized(scene, segments) for name, scene in scenes().items()}
    for name, at in given.items():
        yield Kernel(f"linearized, {name}", linearized, at.form, at.point)
    for name in ("bending and stretch", "gravity"):
        at = given[name]
        planar = at.form.in_axes(plane(at.form.scene)[1])
        yield Kernel(f"linearized, {name}, in a plane", linearized, planar, at.point)
    at = given["torsion"]
    yield Kernel("derivatives of all joints, written out", written_out, at.form, at.point)
    yield Kernel("derivatives of all joints, by JAX", of_all_joints, at.form, at.point)
    yield Kernel("derivatives of each joint, jax.hessian", of_each_joint, at.form, at.point)

    here, flat = jax.jit(linearized)(at.form, at.point), jax.jit(linearized)(planar, at.point)
    right_side = here.gradient, here.constraint_residual
    yield Kernel(FACTORED, solved, None, (here.system, *right_side))
    yield Kernel("factor_and_solve, in a plane", solved, None, (flat.system, flat.gradient, flat.constraint_residual))
    yield Kernel("Factors.solve", lambda factors, f: factors.solve(*f), jax.jit(factor)(here.system), right_side)
    if segments <= DENSE_UP_TO:
        unknowns = jnp.concatenate([here.gradient.T.ravel(), here.constraint_residual])
        yield Kernel("jnp.linalg.solve, dense", lambda _, f: jnp.linalg.solve(*f), None, (full(here.system), unknowns))
    step = here.bases, 1e-3 * here.gradient, jnp.zeros((3, 1))
    yield Kernel(MOVED, lambda form, given: form.retract(*given), at.form, (at.point, *step))
    yield Kernel("resultants", at_nodes, at.form, at.point)
    count = jnp.zeros((), int)
    state = SolverState(at.polyline, at.point.end_force, nondimensional(at.scene)[1])
    found = Found(state, at.point, Outcome(jnp.zeros(()), count, count, count), jnp.array(True))
    yield Kernel("resultants, energies, SI units", in_units, at.scene, found)

    free = given["bending and stretch"]
    yield Kernel("energy and gradient, bending and stretch", energy_and_gradient, free.problem, free.polyline)
    yield Kernel(GRADIENT, energy_and_gradient, at.problem, at.polyline)
    yield Kernel("gauss_newton, factorised", gauss_newton, at.problem, at.polyline)
    preconditioner = jax.jit(gauss_newton)(at.problem, at.polyline)
    gradient = energy_and_gradient(at.problem, at.polyline)[1]
    yield Kernel(
        "precondition", lambda fixed, f: fixed[0].precondition(fixed[1], f), (at.problem, preconditioner), gradient
    )


def linearized(form: MixedForm, point: MixedPoint):
    return form.linearized(point)


def solved(_, given):
    return factor_and_solve(*given)


def gauss_newton(problem: FiniteDifference, polyline: Polyline):
    return problem.gauss_newton(polyline)


def energy_and_gradient(problem: FiniteDifference, polyline: Polyline):
    return problem.energy_and_gradient(polyline)


def at_nodes(form: MixedForm, point: MixedPoint):
    return resultants(form, point)


def in_units(scene: Scene, found: Found):
    return build_result(scene, found, jnp.ones((), int))


def written_out(form: MixedForm, point: MixedPoint):
    """Derivatives of bending and torsion by rotations of the tangents beside each joint, as the library has them."""
    scene = form.scene
    bases = tangent_bases(with_held_tangents(scene, point.tangents))
    at, beside = joints(scene, point.tangents), (bases[..., :-1], bases[..., 1:])
    torque = scene.rod.GJ * point.total_twist
    bent, twisted = bending_derivatives(scene.rod, at, beside), twist_derivatives(at, beside)
    return jax.tree.map(lambda b, t: b + torque * t, bent, twisted)


def joint_energy(form: MixedForm, point: MixedPoint):
    """The same two energies as a function of rotations (4, k) of the joints beside it, and those joints with bases.

    Of the rotated tangents it has what counts at no rotation, the terms up to the second order.
    """
    scene = form.scene
    torque = scene.rod.GJ * point.total_twist

    def rotated(tangents, basis, rotation):
        return (1 - dot(rotation, rotation) / 2)[None] * tangents + jnp.sum(basis * rotation[None], axis=1)

    def energy(rotations, at: Joints, bases):
        before, after = rotated(at.before, bases[0], rotations[:2]), rotated(at.after, bases[1], rotations[2:])
        twist = swept_angle(before, after, at.before, at.after)
        return Joints(before, after, at.spacing).bending_energy(scene.rod) + torque * jnp.sum(twist)

    bases = tangent_bases(with_held_tangents(scene, point.tangents))
    return energy, (joints(scene, point.tangents), (bases[..., :-1], bases[..., 1:]))


def of_all_joints(form: MixedForm, point: MixedPoint):
    """Their derivatives (4, k) and (4, 4, k) by JAX: as joints do not couple, four directions serve for all of them."""
    energy, given = joint_energy(form, point)
    none = jnp.zeros((4, len(given[0].spacing)))
    gradient = jax.grad(lambda rotations: energy(rotations, *given))
    along = lambda e: jax.jvp(gradient, (none,), (jnp.broadcast_to(e[:, None], none.shape),))  # noqa: E731
    return jax.vmap(along, out_axes=(None, 0))(jnp.eye(4))


def of_each_joint(form: MixedForm, point: MixedPoint):
    """The same by `jax.hessian` of one joint, for each of them."""
    energy, given = joint_energy(form, point)

    def derivatives(one):
        function = lambda rotations: energy(rotations[:, None], *jax.tree.map(lambda x: x[..., None], one))  # noqa: E731
        return jax.grad(function)(jnp.zeros(4)), jax.hessian(function)(jnp.zeros(4))

    return jax.vmap(derivatives, in_axes=-1, out_axes=-1)(given)


def full(system: SaddlePointSystem) -> jax.Array:
    """The whole matrix, unknowns joint by joint and the border last."""
    b, k, n = system.border.shape
    i = np.arange(n)
    h = jnp.zeros((n, b, n, b)).at[i, :, i].set(jnp.moveaxis(system.diagonal, -1, 0))
    h = h.at[i[1:], :, i[:-1]].set(jnp.moveaxis(system.lower, -1, 0))
    h = h.at[i[:-1], :, i[1:]].set(system.lower.T).reshape(n * b, n * b)
    border = jnp.moveaxis(system.border, -1, 0).reshape(n * b, k)
    return jnp.block([[h, border], [border.T, -system.compliance]])


def looped(kernel: Kernel) -> Callable:
    """A program of `LOOPS` evaluations. The arguments of each depend on the last, and all results are stored."""

    def run(fixed, varying):
        def step(_, carry):
            varying, results = carry
            nudge = NUDGE * next(filter(eqx.is_inexact_array, jax.tree.leaves(results))).ravel()[0]
            varying = jax.tree.map(lambda x: x + nudge if eqx.is_inexact_array(x) else x, varying)
            return varying, kernel.function(fixed, varying)

        shapes = jax.eval_shape(kernel.function, fixed, varying)
        results = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return jax.lax.fori_loop(0, LOOPS, step, (varying, results))

    return run


def measured(meshes: Sequence[int], repeats: int) -> list[Row]:
    rows = []
    for n in meshes:
        for kernel in kernels(n):
            arguments = kernel.fixed, kernel.varying
            program, seconds = compiled(looped(kernel), *arguments)
            rows.append(Row(kernel.what, n, least_ms(program, arguments, repeats) * 1e3 / LOOPS, seconds))
    return rows


def least_ms(program: Callable, arguments: tuple, repeats: int) -> float:
    runs = Timed(lambda: program(*arguments))
    runs.round(repeats)
    return min(runs.times)


def limit_table(program: Path, times: dict[tuple[str, int], float]) -> str:
    """Nanoseconds per segment beside those that the C++ program prints."""
    output = subprocess.run([str(program.resolve()), "eval"], capture_output=True, text=True, check=True).stdout
    lines = [
        f"\nns per segment{'energy and gradient':>30}{f'linearized, {FACTORED} (C++: LDL, no solve)':>60}",
        f"{'N':>14}" + f"{'here':>12}{'C++':>9}{'ratio':>9}" + f"{'here':>42}{'C++':>9}{'ratio':>9}",
    ]
    for n, gradient, newton in LIMIT.findall(output):
        if (GRADIENT, int(n)) in times:
            ours = times[GRADIENT, int(n)], times[LINEARIZED, int(n)] + times[FACTORED, int(n)]
            pairs = [(us * 1e3 / int(n), float(ns)) for us, ns in zip(ours, (gradient, newton), strict=True)]
            cells = [f"{here:.0f}{limit:9.0f}{here / limit:9.1f}" for here, limit in pairs]
            lines.append(f"{n:>14}{cells[0]:>30}{cells[1]:>60}")
    return "\n".join(lines)


def step_of_figure_1(segments: int, times: dict[tuple[str, int], float], repeats: int) -> Step:
    arguments = stack_scenes(problems.figure_1()), problems.figure_1_start()
    solve = functools.partial(rodjax.solve_path, segments=segments, discretization="finite_difference")
    program, _ = compiled(lambda scenes, guess: solve(scenes, guess=guess), *arguments)
    path: rodjax.Equilibrium = program(*arguments)
    ms = least_ms(program, arguments, repeats) / len(path.residual)
    evaluations = float(np.mean(path.evaluations))
    linearized, factored, moved = (
        evaluations * times[part, segments] / 1e3 / ms for part in (LINEARIZED, FACTORED, MOVED)
    )
    return Step(
        segments=segments,
        ms=ms,
        iterations=float(np.mean(path.iterations)),
        evaluations=evaluations,
        linearized=linearized,
        factored=factored,
        moved=moved,
        rest=1 - linearized - factored - moved,
    )


def main(argv: Sequence[str] | None = None) -> tuple[list[Row], list[Step]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, nargs="+", default=[10, 50, 100, 500, 1000])
    parser.add_argument("--steps-at", type=int, nargs="+", default=[50, 100], help="meshes for the steps of Fig. 1")
    parser.add_argument("--limit", type=Path, help="the C++ program")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, help="folder for kernels.csv and kernels_step.csv")
    options = parser.parse_args(argv)
    set_up()

    meshes = sorted({*options.segments, *options.steps_at})
    print(f"microseconds, least of {options.repeats}; {conditions()}")
    print(f"{'':42}" + "".join(f"{f'N={n}':>10}" for n in meshes) + f"{'compile [s]':>13}")
    rows = measured(meshes, options.repeats)
    times = {(row.what, row.segments): row.us for row in rows}
    for what in dict.fromkeys(row.what for row in rows):
        seconds = statistics.median(row.compile_s for row in rows if row.what == what)
        print(
            f"{what:42}"
            + "".join(number(times.get((what, n), math.nan), ".2f", 10) for n in meshes)
            + f"{seconds:13.1f}"
        )
    if options.limit is not None:
        print(limit_table(options.limit, times))

    steps = [step_of_figure_1(n, times, options.repeats) for n in options.steps_at]
    print(f"\nstep of Fig. 1 {'N':>6}{'ms':>9}{'iterations':>12}{'evaluations':>13}", end="")
    print(f"{'linearized':>13}{'factor_and_solve':>18}{'moved':>8}{'rest':>8}")
    for step in steps:
        print(f"{step.segments:21}{step.ms:9.3f}{step.iterations:12.1f}{step.evaluations:13.1f}", end="")
        print(f"{step.linearized:13.0%}{step.factored:18.0%}{step.moved:8.0%}{step.rest:8.0%}")
    if options.out is not None:
        save_rows(rows, options.out / "kernels.csv")
        save_rows(steps, options.out / "kernels_step.csv")
    return rows, steps


if __name__ == "__main__":
    main()
