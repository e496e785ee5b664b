"""Are the derivatives of a solve exact, and what do they cost?

Derivatives of shapes, forces and moments by both discretizations, each beside differences of eighth order of solves on
the same mesh, and beside closed forms or the differentiated continuum, to which they converge as the mesh does. Then
the time of `jax.value_and_grad` of a solve over that of the solve, one after the other in turn.

    python experiments/derivative_table.py [--only cantilever point_force] [--no-cost] [--rounds 15] [--out docs]

In SI units; the rods of the closed forms have EI = L = 1 and EA L^2/EI = 1e9.
"""

import argparse
import math
import os
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import Timed, compiled, conditions, set_up
from scipy.special import ellipe, ellipk
from validation import LEVEL, ORIGIN, cantilever_tip, root, table

import rodjax
from rodjax import Clamp, Equilibrium, Free, Guess, Newton, PointForce, Rod, Scene, frame, problems, rotate
from rodjax.analysis.sensitivity import moved

INEXTENSIBLE = 1e9  # EA L^2/EI
# Below the default, as what is left of the residual is divided by the steps of the differences.
SOLVER = Newton(tolerance=1e-12)
# Of eighth order.
DIFFERENCES = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
# Steps: of lengths in L, of angles in rad, of other numbers relative to them.
STEPS = {"end.position": 4e-3, "end.frame": 1e-2}
OTHER_STEP = 2e-2  # also of the closed forms
INTERVALS = 8  # of the continuum
# What must hold: an error beside the differences, and the order in which that beside the exact one falls, unless it is
# as small as what the references themselves have.
DIFFERENCES_BOUND = 1e-7
ORDERS = {"finite_difference": 1.7, "hermite": 3.5}
REFERENCE_ERROR = 1e-7
COST_BOUND = 1.4
COST_SEGMENTS = 50
PARAMETERS = 10_000
REPEATS = 40

# By the name of a number: derivatives along k directions, in the last axis.
Derivatives = dict[str, np.ndarray]


class Mesh(NamedTuple):
    discretization: str
    segments: int

    def __str__(self) -> str:
        return f"{self.discretization.replace('_', ' ')}, {self.segments}"

    @property
    def options(self) -> dict[str, Any]:
        return {"discretization": self.discretization, "segments": self.segments}


# The better first, from which the continuum is sought.
MESHES = (Mesh("hermite", 16), Mesh("finite_difference", 50))


class Exact(NamedTuple):
    """A quantity, and its derivatives by numbers of the scene along their directions."""

    value: np.ndarray
    by: Derivatives


class Case(NamedTuple):
    """A scene; `by`: numbers and the directions (k, ...) in which they change; `of`: fields and what of them counts."""

    name: str
    scene: Scene
    guess: Guess | Equilibrium | None
    by: dict[str, np.ndarray]
    of: dict[str, tuple[str, Callable[[Any], Any]]]
    exact: Callable[["Case", Equilibrium], dict[str, Exact]]


class Row(NamedTuple):
    """A line of the table; errors relative to the size of the derivative."""

    case: str
    quantity: str
    by: str
    mesh: Mesh
    size: float
    beside_differences: float
    beside_exact: float
    finer: float  # the same on a mesh of twice as many segments
    shape_error: float

    @property
    def order(self) -> float:
        return math.log2(self.beside_exact / self.finer)

    @property
    def is_within(self) -> bool:
        converges = self.order >= ORDERS[self.mesh.discretization] or self.finer <= REFERENCE_ERROR
        return self.beside_differences <= DIFFERENCES_BOUND and converges


# --- scenes and what is exact -----------------------------------------------------------------------------------------


def cantilever() -> Case:
    """P1 at F L^2/EI = 4; the tip along and down."""
    load = 4.0
    scene = Scene(Rod(1.0, 1.0, 0.8, INEXTENSIBLE), Clamp(ORIGIN, frame(LEVEL)), Free(force=(0.0, 0.0, -load)))

    def tip(EI: float = 1.0, length: float = 1.0, force: float = load) -> np.ndarray:
        sideways, inward, _ = cantilever_tip(force * length**2 / EI)
        return length * np.array([1 - inward, -sideways])

    def exact(*_: Any) -> dict[str, Exact]:
        by = {
            "rod.EI": differences(lambda h: tip(EI=1 + h), OTHER_STEP),
            "rod.length": differences(lambda h: tip(length=1 + h), OTHER_STEP),
            "end.force": differences(lambda h: tip(force=load + h), OTHER_STEP),
        }
        return {"tip": Exact(tip(), {name: column[:, None] for name, column in by.items()})}

    by = {"rod.EI": np.ones(1), "rod.length": np.ones(1), "end.force": np.array([[0.0, 0.0, -1.0]])}
    return Case("cantilever, F L²/EI = 4", scene, None, by, {"tip": ("nodes", lambda nodes: nodes[-1, ::2])}, exact)


def clamped() -> Case:
    """The elastica buckled between level clamps at D = 0.8 L; thrust and rise."""
    span = 0.8
    ends = Clamp(ORIGIN, frame(LEVEL)), Clamp((span, 0.0, 0.0), frame(LEVEL))
    x = np.linspace(0.0, 1.0, 101)
    bow = Guess(np.stack([span * x, 0 * x, 0.13 * (1 - np.cos(2 * math.pi * x))], axis=1))

    def thrust_and_rise(D: float) -> np.ndarray:
        m = root(lambda m: 2 * ellipe(m) / ellipk(m) - 1 - D, 1e-9, 0.8)
        return np.array([16 * float(ellipk(m)) ** 2, math.sqrt(m) / float(ellipk(m))])

    def exact(*_: Any) -> dict[str, Exact]:
        values, slopes = thrust_and_rise(span), differences(lambda h: thrust_and_rise(span + h), OTHER_STEP)
        return {
            name: Exact(values[k : k + 1], {"end.position": slopes[k : k + 1, None]})
            for k, name in enumerate(("thrust", "rise"))
        }

    of = {
        "thrust": ("end_force", lambda force: -force[:1]),
        # Nothing keeps the rod from turning about the line through the clamps.
        "rise": ("nodes", lambda nodes: jnp.linalg.norm(nodes[len(nodes) // 2, 1:], keepdims=True)),
    }
    scene = Scene(Rod(1.0, 1.0, 0.8, INEXTENSIBLE), *ends)
    return Case("clamped elastica, D = 0.8 L", scene, bow, {"end.position": np.array([LEVEL])}, of, exact)


def twisted() -> Case:
    tangent = np.array([1.0, 0.3, 0.5]) / math.sqrt(1.34)
    end = Clamp((0.7, 0.2, 0.1), rotate(frame(tangent), 1.5 * tangent))
    scene = Scene(problems.cable(20.0), Clamp(ORIGIN, frame((1.0, 0.0, -0.5))), end, gravity=(0.0, 0.0, -9.81))
    return in_space("clamps, gravity, twist", scene)


def figure_1() -> Case:
    """Without gravity."""
    scenes = problems.figure_1()
    path = rodjax.solve_path(scenes, segments=16, guess=problems.figure_1_start())
    return in_space("P2, stage f", scenes[-1], jax.tree.map(lambda leaf: leaf[-1], path))


def point_force() -> Case:
    ends = Clamp(ORIGIN, frame((1.0, 0.2, 0.0))), Clamp((0.8, 0.1, 0.0), frame((1.0, 0.0, 0.3)))
    load = PointForce(0.5, (1.0, 3.0, -5.0))
    return in_space("cable, point force", Scene(problems.cable(50.0), *ends, (0.0, 0.0, -9.81), [load]))


def in_space(name: str, scene: Scene, guess: Equilibrium | None = None) -> Case:
    scalars = ["rod.EI", "rod.GJ", "rod.EA", *(["rod.mass_per_length"] if scene.gravity is not None else [])]
    by = {"end.position": np.eye(3), "end.frame": np.eye(3)} | {name: np.ones(1) for name in scalars}
    fields = {"shape": "nodes", "end force": "end_force", "end moment": "end_moment"}
    of = {quantity: (field, jnp.asarray) for quantity, field in fields.items()}
    return Case(name, scene, guess, by, of, of_continuum)


def of_continuum(case: Case, near: Equilibrium) -> dict[str, Exact]:
    """On a mesh that has the nodes of all others."""
    segments = math.lcm(*(mesh.segments for mesh in MESHES))

    def fields(changes: dict[str, jax.Array], scene: Scene, near: Equilibrium) -> tuple[dict, dict]:
        exact = rodjax.solve_continuum(moved(scene, changes), near, intervals=INTERVALS, segments=segments)
        values = {field: getattr(exact, field) for field, _ in case.of.values()}
        return values, values | {"converged": exact.converged}

    nowhere = {name: jnp.zeros(directions.shape[1:]) for name, directions in case.by.items()}
    by_number, values = jax.jit(jax.jacfwd(fields, has_aux=True))(nowhere, case.scene, near)
    if not values["converged"]:
        raise RuntimeError(f"{case.name}: the continuum did not converge")
    return {
        quantity: Exact(np.asarray(values[field]), along(case, by_number[field]))
        for quantity, (field, _) in case.of.items()
    }


CASES = {
    "cantilever": cantilever,
    "clamped": clamped,
    "twisted": twisted,
    "figure_1": figure_1,
    "point_force": point_force,
}

# --- comparison -------------------------------------------------------------------------------------------------------


def rows(case: Case) -> list[Row]:
    found: list[Row] = []
    exact: dict[str, Exact] | None = None
    for mesh in MESHES:
        fine = mesh._replace(segments=2 * mesh.segments)
        base = solved(case, case.guess, mesh)
        finer = solved(case, base, fine)
        exact = exact or case.exact(case, finer)
        tables = of_solve(case, base, mesh), of_differences(case, base, mesh), of_solve(case, finer, fine)
        shape_error = float(base.error_estimate)
        for quantity, reference in exact.items():
            for name, exact_one in reference.by.items():
                ours, by_differences, of_finer = (table[quantity][name] for table in tables)
                of_exact = at_nodes_of(ours, exact_one)
                errors = (
                    relative(ours, by_differences),
                    relative(ours, of_exact),
                    relative(at_nodes_of(ours, of_finer), of_exact),
                )
                size = float(np.linalg.norm(of_exact))
                found.append(Row(case.name, quantity, name, mesh, size, *errors, shape_error))
    return found


def solved(case: Case, guess: Guess | Equilibrium | None, mesh: Mesh, **changes: jax.Array) -> Equilibrium:
    """`changes`: of numbers of the scene, by their names."""
    result = rodjax.solve(moved(case.scene, changes), guess=guess, solver=SOLVER, **mesh.options)
    if not result.converged:
        raise RuntimeError(f"{case.name}, changed by {changes}: {rodjax.describe(result)}")
    return result


def of_solve(case: Case, base: Equilibrium, mesh: Mesh) -> dict[str, Derivatives]:
    """Of each quantity, by the library."""
    fields = list(dict.fromkeys(field for field, _ in case.of.values()))
    found = rodjax.sensitivities(case.scene, of=fields, wrt=list(case.by), guess=base, solver=SOLVER, **mesh.options)

    def of_quantity(value: jax.Array, measure: Callable[[Any], Any], columns: np.ndarray) -> np.ndarray:
        changes = [jax.jvp(measure, (value,), (jnp.asarray(change),))[1] for change in np.moveaxis(columns, -1, 0)]
        return np.stack(changes, axis=-1)

    return {
        quantity: {
            name: of_quantity(getattr(base, field), measure, columns)
            for name, columns in along(case, found[field]).items()
        }
        for quantity, (field, measure) in case.of.items()
    }


def of_differences(case: Case, base: Equilibrium, mesh: Mesh) -> dict[str, Derivatives]:
    """Of each quantity, by solves that all begin from the same."""
    found: dict[str, Derivatives] = {quantity: {} for quantity in case.of}
    for name, directions in case.by.items():
        columns = [differences_along(case, base, mesh, name, direction) for direction in directions]
        for k, by in enumerate(found.values()):
            by[name] = np.stack([column[k] for column in columns], axis=-1)
    return found


def differences_along(case: Case, base: Equilibrium, mesh: Mesh, name: str, direction: np.ndarray) -> list[np.ndarray]:
    def measured(result: Equilibrium) -> list[np.ndarray]:
        return [np.asarray(measure(getattr(result, field))) for field, measure in case.of.values()]

    def at(h: float) -> np.ndarray:
        changed = solved(case, base, mesh, **{name: jnp.asarray(h * direction)})
        return np.concatenate([np.ravel(value) for value in measured(changed)])

    size = float(getattr(case.scene.rod, name.removeprefix("rod."))) if name.startswith("rod.") else 1.0
    column = differences(at, size * STEPS.get(name, OTHER_STEP))
    shapes = [value.shape for value in measured(base)]
    parts = np.split(column, np.cumsum([math.prod(shape) for shape in shapes])[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def differences(function: Callable[[float], np.ndarray], h: float) -> np.ndarray:
    """The derivative at zero."""
    terms = [weight * (function(k * h) - function(-k * h)) for k, weight in enumerate(DIFFERENCES, start=1)]
    return np.sum(terms, axis=0) / h


def along(case: Case, by_number: dict[str, Any]) -> Derivatives:
    """Derivatives by whole numbers as those along the directions of the case."""
    found = {}
    for name, directions in case.by.items():
        axes = list(range(1, directions.ndim))
        columns = np.tensordot(directions, by_number[name], (axes, [k - directions.ndim for k in axes]))
        found[name] = np.moveaxis(columns, 0, -1)
    return found


def at_nodes_of(coarse: np.ndarray, fine: np.ndarray) -> np.ndarray:
    return fine if len(fine) == len(coarse) else fine[:: (len(fine) - 1) // (len(coarse) - 1)]


def relative(ours: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(ours - reference) / np.linalg.norm(reference))


# --- cost -------------------------------------------------------------------------------------------------------------


class Cost(NamedTuple):
    """Medians [ms] of a solve alone and beside its derivatives, and the median of their ratios, each of one round."""

    by: str
    mesh: Mesh
    start: str
    iterations: int
    solve: float
    both: float
    ratio: float


def with_EI(EI: jax.Array) -> Scene:
    return eqx.tree_at(lambda scene: scene.rod.EI, problems.hanging_cable(), EI)


def of_many(x: jax.Array) -> Scene:
    """EI and gravity by smooth means of all numbers."""
    scene = problems.hanging_cable()
    means = jnp.stack([jnp.mean(x), jnp.mean(x**2), jnp.mean(x**3), jnp.mean(x**4)])
    assert scene.gravity is not None
    changed = scene.rod.EI * (1 + means[3]), scene.gravity + means[:3]
    return eqx.tree_at(lambda scene: (scene.rod.EI, scene.gravity), scene, changed)


def costs(mesh: Mesh, rounds: int) -> list[Cost]:
    scene = problems.hanging_cable()
    many = jnp.asarray(np.random.default_rng(0).uniform(-0.3, 0.3, PARAMETERS))
    kinds: dict[str, tuple[Callable[[Any], Scene], Any]] = {
        "EI": (with_EI, scene.rod.EI),
        "all numbers of the scene": (lambda scene: scene, scene),
        "all numbers, clamps in space": (lambda scene: scene, twisted().scene),
        f"{PARAMETERS} parameters": (of_many, many),
    }
    found = []
    for name, (scene_of, here) in kinds.items():
        # All numbers but those of frames.
        nearby = jax.tree.map(lambda leaf: leaf if leaf.shape == (3, 3) else 1.01 * leaf, here)
        for start, guess in (("cold", None), ("warm", rodjax.solve(scene_of(nearby), **mesh.options))):
            solve, both, ratio, iterations = timed(mesh, scene_of, here, guess, rounds)
            found.append(Cost(name, mesh, start, iterations, solve, both, ratio))
    return found


def timed(
    mesh: Mesh, scene_of: Callable[[Any], Scene], here: Any, guess: Equilibrium | None, rounds: int
) -> tuple[float, float, float, int]:
    def pull(parameters: Any, guess: Equilibrium | None) -> tuple[jax.Array, jax.Array]:
        result = rodjax.solve(scene_of(parameters), guess=guess, **mesh.options)
        return result.end_force[2], result.iterations

    alone, _ = compiled(pull, here, guess)
    both, _ = compiled(jax.value_and_grad(pull, has_aux=True), here, guess)
    runs = Timed(lambda: alone(here, guess)), Timed(lambda: both(here, guess))
    times = [[run.round(REPEATS) for run in runs] for _ in range(rounds)]
    ratio = statistics.median(second / first for first, second in times)
    first, second = (statistics.median(column) for column in zip(*times, strict=True))
    return first, second, ratio, int(runs[0].result[1])


# --- tables -----------------------------------------------------------------------------------------------------------

HEADINGS = (
    "scene",
    "derivative of",
    "by",
    "mesh",
    "size",
    "beside differences",
    "beside exact",
    "order",
    "shape error",
)
COST_HEADINGS = ("by", "mesh", "start", "iterations", "solve [ms]", "with gradient [ms]", "ratio")

INTRODUCTION = """\
# Derivatives

Inside `jax.jit`, `vmap` and `grad` the numbers of a scene are traced, so that no mesh can be chosen for `rtol`. Without
`segments=` the mesh has 32 elements (50 edges), and derivatives deviate by its errors from those on another mesh; a
`MeshWarning` says so once. State `segments=` where that matters.

Printed by `experiments/derivative_table.py`, on {conditions}.

## Are they exact?

- {rows} rows; beyond a bound, marked (!): {beyond}
- largest relative error beside differences of the same mesh: {worst:.1e}, bound {bound:.0e}
- largest relative error beside the exact ones: {of_meshes}; lowest order seen: {orders}

**Columns.** `size`: of the exact derivative, SI units, root of the sum of squares over all components (of a position,
or of the rotation vector of a frame, all three; of the shape, all nodes). `beside differences`: of eighth order, of
solves on the same mesh to a residual of 1e-12, steps of 0.004 L, 0.01 rad and 2 %. `beside exact`: the error of the
mesh, on N segments; `order`: the power of 1/N with which it falls to 2 N segments, at least {finite_difference} for
finite differences (second order) and {hermite} for Hermite elements (fourth). `shape error`: `error_estimate`, largest
distance of a node from the continuum, in L. All other errors are relative to the size.

**What is exact.** *Cantilever* and *clamped elastica*: elliptic integrals as in [validation](validation.md), by
differences of eighth order of the closed form, for rods with EI = L = 1 and EA L²/EI = 1e9. The others, in space:
`jax.jacfwd` of `rodjax.solve_continuum`. *Clamps, gravity, twist*: L/R = 20, the end frame turned by 1.5 rad about a
tangent out of the plane; *P2, stage f*: `rodjax.problems.figure_1`, a full turn of the end frame, L/R = 200; *cable,
point force*: L/R = 50, clamps that are not in a plane, 5.9 N at L/2.

"""

COSTS = """\
## What do they cost?

`jax.value_and_grad` of a component of the end force, compiled, beside the same function without its gradient: medians
of {rounds} rounds that alternate, each the median of {repeats} runs, and the median of the ratios of the rounds. The
hanging cable of `rodjax.problems`, Newton with its defaults; *cold* from no guess, *warm* from the equilibrium of
numbers that are 1 % larger. *Clamps in space*: the scene of the first table with gravity and twist. The {parameters}
parameters enter EI and gravity through means of their powers. One thread of XLA; other work ran on the machine
meanwhile, load {load:.1f} at the end.

- ratios from a cold start: {cold}, bound {bound}, beyond it marked (!); from a warm one: {warm}
- a gradient takes as long as {iterations:.1f} iterations: (ratio - 1) times those of the solve, median of the cold rows

"""


def cells(row: Row) -> tuple[str, ...]:
    mark = "" if row.is_within else " (!)"
    errors = f"{row.beside_differences:.1e}", f"{row.beside_exact:.1e}", f"{row.order:.1f}{mark}"
    return row.case, row.quantity, f"`{row.by}`", str(row.mesh), f"{row.size:.3g}", *errors, f"{row.shape_error:.1e}"


def cost_cells(cost: Cost) -> tuple[str, ...]:
    mark = " (!)" if cost.start == "cold" and not cost.ratio <= COST_BOUND else ""
    times = f"{cost.solve:.3f}", f"{cost.both:.3f}", f"{cost.ratio:.2f}{mark}"
    return cost.by, str(cost.mesh), cost.start, str(cost.iterations), *times


def markdown(rows: Sequence[Row]) -> str:
    of_meshes = [[row for row in rows if row.mesh == mesh] for mesh in MESHES]
    beyond = [f"{row.case}, {row.quantity} by {row.by}, {row.mesh}" for row in rows if not row.is_within]
    introduction = INTRODUCTION.format(
        conditions=conditions(),
        rows=len(rows),
        beyond="; ".join(beyond) or "none",
        worst=max(row.beside_differences for row in rows),
        bound=DIFFERENCES_BOUND,
        of_meshes="; ".join(f"{of[0].mesh}: {max(row.beside_exact for row in of):.1e}" for of in of_meshes),
        orders="; ".join(f"{of[0].mesh}: {min(row.order for row in of):.1f}" for of in of_meshes),
        **ORDERS,
    )
    return introduction + table([HEADINGS, (*["---"] * 4, *["---:"] * 5), *map(cells, rows)])


def costs_markdown(costs: Sequence[Cost], rounds: int) -> str:
    ranges = {}
    for start in ("cold", "warm"):
        ratios = [cost.ratio for cost in costs if cost.start == start]
        ranges[start] = f"{min(ratios):.2f} to {max(ratios):.2f}"
    iterations = statistics.median((cost.ratio - 1) * cost.iterations for cost in costs if cost.start == "cold")
    text = COSTS.format(
        rounds=rounds,
        repeats=REPEATS,
        parameters=PARAMETERS,
        load=os.getloadavg()[0],
        bound=COST_BOUND,
        iterations=iterations,
        **ranges,
    )
    return text + table([COST_HEADINGS, (*["---"] * 3, *["---:"] * 4), *map(cost_cells, costs)])


def main(argv: Sequence[str] | None = None) -> tuple[list[Row], list[Cost]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--no-cost", action="store_true", help="the first table alone")
    parser.add_argument("--rounds", type=int, default=15, help="of alternating runs")
    parser.add_argument("--out", type=Path, help="folder for derivatives.md")
    options = parser.parse_args(argv)
    set_up()
    rodjax.enable_compilation_cache()
    print(conditions())
    found: list[Row] = []
    for name in options.only:
        of_case = rows(CASES[name]())
        print("\n".join(" | ".join(cells(row)) for row in of_case), flush=True)
        found += of_case
        jax.clear_caches()  # programs that are not needed again: they take memory maps, of which there are 65530
    paid: list[Cost] = []
    if not options.no_cost:
        for mesh in MESHES:
            of_mesh = costs(mesh._replace(segments=COST_SEGMENTS), options.rounds)
            print("\n".join(" | ".join(cost_cells(cost)) for cost in of_mesh), flush=True)
            paid += of_mesh
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        sections = [markdown(found), *([costs_markdown(paid, options.rounds)] if paid else [])]
        (options.out / "derivatives.md").write_text("\n".join(sections))
    return found, paid


if __name__ == "__main__":
    main()
