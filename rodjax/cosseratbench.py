"""rodjax as a solver of cosseratbench, a benchmark of rod solvers (`pip install 'rodjax[cosseratbench]'`).

cosseratbench finds `RodjaxSolver` by its entry point: `cosseratbench run cantilever catenary crossing --solver rodjax`.
"""

import importlib
from typing import Any

import jax
import numpy as np

import rodjax
from rodjax.model.supports import Support

# Not by `import`: where it is not installed, a type checker takes this very file for it.
bench: Any = importlib.import_module("cosseratbench")


class RodjaxSolver:
    """The equilibrium between ends that do not move: the first frame is the given shape, all others are it.

    `scenario` and what `run` returns are a `Scenario` and a `Trajectory` of cosseratbench. Its runner reports as
    unsupported what raises `NotImplementedError` here: dynamics, driven ends, rods that nothing holds, and friction but
    of obstacles on one rod with two free ends, which lies where it is given: from there it slips.
    """

    name = "rodjax"
    backend_version = rodjax.__version__
    capabilities = frozenset(
        {
            bench.Capability.STRETCH,
            bench.Capability.ROD_CONTACT,
            bench.Capability.CYLINDER_CONTACT,
            bench.Capability.PLANE_CONTACT,
        }
    )

    def __init__(self, time_step_scale: float = 1.0):
        # There is no time step; taken for a sweep over those of all solvers.
        del time_step_scale

    def settings(self, scenario: Any, *, n_elements: int, n_frames: int) -> dict[str, str]:
        return {"method": "equilibrium by Newton's method, no time step", "discretization": "Hermite elements"}

    def run(self, scenario: Any, *, n_elements: int, n_frames: int) -> Any:
        with jax.enable_x64(True):
            result = self.equilibrium(scenario, n_elements)
        if not result.converged:
            raise bench.Diverged(f"rodjax: {rodjax.describe(result)}")
        found = [result] if isinstance(result, rodjax.Equilibrium) else list(result.values())
        still, nodes, directions = n_frames - 1, [], []
        for rod, shape in zip(scenario.rods, found, strict=True):
            nodes.append(np.stack([rod.nodes(n_elements), *[np.asarray(shape.nodes)] * still]))
            directions.append(np.stack([rod.directors(n_elements), *[directors(rod, shape)] * still]))
        return bench.Trajectory(np.linspace(0.0, scenario.duration, n_frames), tuple(nodes), tuple(directions))

    def equilibrium(self, scenario: Any, segments: int) -> rodjax.Equilibrium | rodjax.HarnessEquilibrium:
        """From the given shapes, which are free of twist."""
        scene = self.scene(scenario, segments)
        guesses = [rodjax.Guess(rod.nodes(segments)) for rod in scenario.rods]
        if isinstance(scene, rodjax.Scene):
            return rodjax.solve(scene, segments=segments, guess=guesses[0], strain_limit=None)
        guess = dict(zip(scene.names, guesses, strict=True))
        return rodjax.solve(scene, segments=segments, guess=guess, strain_limit=None)

    def scene(self, scenario: Any, segments: int) -> rodjax.Scene | rodjax.Harness:
        if not scenario.quasi_static:
            raise NotImplementedError("dynamics")
        is_rough = any(each.friction for each in (*scenario.rods, *scenario.obstacles))
        if is_rough and (len(scenario.rods) > 1 or scenario.rods[0].friction or not lies_free(scenario.rods[0])):
            # It has a memory, of which a shape to begin with says nothing where something else holds the rod.
            raise NotImplementedError("friction")
        scenes = [scene(scenario, rod, segments) for rod in scenario.rods]
        if len(scenes) == 1:
            return scenes[0]
        return rodjax.Harness({f"rod{k}": each for k, each in enumerate(scenes)}, contact=True)


def scene(scenario: Any, rod: Any, segments: int) -> rodjax.Scene:
    """Of one rod of the scenario."""
    if rod.start_motion is not None or rod.end_motion is not None:
        raise NotImplementedError("driven ends")
    if lies_free(rod) and not any(given.friction for given in scenario.obstacles):
        raise NotImplementedError("a rod that nothing holds")
    material = rod.material
    body = rodjax.Rod.circular(
        rod.length, rod.radius, material.youngs_modulus, shear_modulus=material.shear_modulus, density=material.density
    )
    start, end = (support(rod, end, segments) for end in (bench.End.START, bench.End.END))
    return rodjax.Scene(
        body,
        start,
        end,
        gravity=scenario.gravity if any(scenario.gravity) else None,
        obstacles=tuple(map(obstacle, scenario.obstacles)),
        self_contact=scenario.self_contact,
    )


def lies_free(rod: Any) -> bool:
    return bench.EndCondition.FREE is rod.start is rod.end


def obstacle(given: Any) -> rodjax.Plane | rodjax.Cylinder:
    friction = float(given.friction)
    if isinstance(given, bench.scenario.Plane):
        return rodjax.Plane(given.point, given.unit_normal, friction=friction)
    half = given.length / 2 * given.unit_axis
    return rodjax.Cylinder(given.center - half, given.center + half, given.radius, friction=friction)


def support(rod: Any, end: Any, segments: int) -> Support:
    """What holds an end as the scenario has it; a load on a held end moves nothing."""
    k = 0 if end is bench.End.START else -1
    condition = rod.condition(end)
    if condition is bench.EndCondition.FREE:
        forces = [load.force for load in rod.loads if load.at is end]
        return rodjax.Free(force=np.sum(forces, axis=0) if forces else None)
    position = rod.centerline[k]
    if condition is bench.EndCondition.PINNED:
        return rodjax.Pin(position)
    tangent = np.diff(np.asarray(rod.centerline), axis=0)[k]
    d1 = rod.directors(segments)[k]
    return rodjax.Clamp(position, rodjax.frame(tangent, np.cross(tangent, d1)))


def directors(rod: Any, result: rodjax.Equilibrium) -> np.ndarray:
    """d1 at right angles to the edges between the nodes (n, 3).

    Without a clamp the rod is free to spin, and free of twist: as the given shape, it begins with `rod.normal`.
    """
    nodes = np.asarray(result.nodes)
    if bench.EndCondition.CLAMPED not in (rod.start, rod.end):
        return bench.scenario.parallel_transport(nodes, np.asarray(rod.normal, float))
    d1 = np.asarray(result.frames)[:, :, 0]
    middle, edges = d1[:-1] + d1[1:], np.diff(nodes, axis=0)
    middle -= np.sum(middle * edges, axis=1, keepdims=True) / np.sum(edges**2, axis=1, keepdims=True) * edges
    return middle / np.linalg.norm(middle, axis=1, keepdims=True)
