"""The programs that `peers.py` compares, each set up for a problem on a mesh with the settings that served it best."""

import contextlib
import importlib
import importlib.metadata
import itertools
import math
import os
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import numpy as np
from measuring import compiled
from scipy.spatial.transform import Rotation

import rodjax
from rodjax import Clamp, Free, Scene, problems
from rodjax.model.supports import Support
from rodjax.paths.path import stack_scenes
from rodjax.solving.options import Discretization

# The section of `problems.cable`, for programs that ask for moduli [m, Pa, Pa, kg/m^3].
RADIUS, YOUNGS_MODULUS, SHEAR_MODULUS, DENSITY = 5e-3, 1e7, 1e7 / 3, 1200.0
# Damped dynamics has come to rest where no node moves by more than this [m] in 0.1 s; the clock stops after 20 s.
STILL, STILL_FOR, LONGEST = 2e-5, 0.1, 20.0


class Problem(NamedTuple):
    """Scenes of which each is solved from the last, and the unstretched shape from which the other programs begin."""

    name: str
    title: str
    scenes: list[Scene]
    angle: Callable[[np.ndarray], np.ndarray]  # of the tangent above the x axis [rad] at arclengths


class Contender(Protocol):
    """A program set up for a problem on a mesh; subclasses are made with these two."""

    program: str
    elements: int
    notes: str

    def solve(self) -> None:
        """All scenes of the problem from its start: what is timed."""
        ...

    def nodes(self) -> np.ndarray:
        """Nodes (elements + 1, 3) [m] of the last scene; NaN where it was not reached."""
        ...


def benchmark_problems() -> list[Problem]:
    half = problems.ARC_HALF_ANGLE
    return [
        Problem("P1", "P1: cantilever, a solve", [problems.cantilever()], np.zeros_like),
        Problem("P2", "P2: Fig. 1, a step", problems.figure_1(), lambda s: half * (2 * s - 1)),
        # J0(0.91838617) = 0.8: the ends are level and 0.8 m apart.
        Problem(
            "P3",
            "P3: hanging cable, a solve",
            [problems.hanging_cable()],
            lambda s: -0.91838617 * np.sin(2 * math.pi * s),
        ),
    ]


def start_shape(problem: Problem, elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (n+1, 3) and material frames there (n+1, 3, 3), columns (d1, d2, t)."""
    fine = 100
    angle = problem.angle((np.arange(fine * elements) + 0.5) / (fine * elements))
    steps = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1) / len(angle)
    offsets = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[::fine]
    return clamped(problem.scenes[0].start)[0] + offsets, planar_frames(problem.angle(arclengths(elements)))


def planar_frames(angle: np.ndarray) -> np.ndarray:
    cosine, sine, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    d1, d2, t = (sine, zero, -cosine), (zero, zero + 1, zero), (cosine, zero, sine)
    return np.moveaxis(np.array([d1, d2, t]), -1, 0).swapaxes(1, 2)


def arclengths(elements: int) -> np.ndarray:
    return np.linspace(0.0, 1.0, elements + 1)


def clamped(support: Support) -> tuple[np.ndarray, np.ndarray]:
    """Position and frame of a clamp."""
    assert isinstance(support, Clamp)
    return np.asarray(support.position), np.asarray(support.frame)


def clamps(scene: Scene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Position and frame of the clamps, that at the start first."""
    return [clamped(support) for support in (scene.start, scene.end) if isinstance(support, Clamp)]


def tip_force(scene: Scene) -> np.ndarray | None:
    """The dead force on a free end [N]."""
    return np.asarray(scene.end.force) if isinstance(scene.end, Free) and scene.end.force is not None else None


class Rodjax:
    """The default solver: P1 and P3 cold, from the library's own first shape, P2 as a path."""

    def __init__(self, problem: Problem, segments: int, discretization: Discretization, *, planar: bool = False):
        kind = "elements" if discretization == "hermite" else "differences"
        self.program = f"rodjax {rodjax.__version__}, {kind}{', planar' * planar}"
        self.elements = segments
        options: dict[str, Any] = {"segments": segments, "discretization": discretization, "planar": planar}
        if len(problem.scenes) > 1:
            self._scenes, guess = stack_scenes(problem.scenes), problems.figure_1_start()
            self._program, _ = compiled(lambda scenes: rodjax.solve_path(scenes, guess=guess, **options), self._scenes)
        else:
            self._scenes = problem.scenes[0]
            self._program, _ = compiled(lambda scene: rodjax.solve(scene, **options), self._scenes)
        self.solve()
        words = "Hermite elements" if discretization == "hermite" else "finite differences"
        iterations = np.mean(self.result.iterations)
        self.notes = f"{'2-D' if planar else '3-D'} {words}, {iterations:.0f} iterations a scene"
        if not np.all(self.result.converged):
            self.notes += ", NOT CONVERGED"

    def solve(self) -> None:
        self.result: rodjax.Equilibrium = jax.block_until_ready(self._program(self._scenes))

    def nodes(self) -> np.ndarray:
        return np.asarray(self.result.nodes).reshape(-1, self.elements + 1, 3)[-1]


class Exudyn:
    """What both Exudyn models share: from the first state through all scenes by the static solver."""

    def __init__(self, problem: Problem, elements: int, tolerance: float):
        os.environ.setdefault("EXUDYN_MODULE", "fast")  # without range checks, which it says on import
        with contextlib.redirect_stdout(None):
            self._exudyn = importlib.import_module("exudyn")
            self._items = importlib.import_module("exudyn.itemInterface")
        self.program, self.elements, self._problem = f"Exudyn {self._exudyn.__version__}", elements, problem
        self._settings = self._solver_settings(tolerance)
        self._container = self._exudyn.SystemContainer()  # the system lives as long as this
        self._system = self._container.AddSystem()
        self._nodes = self._build()
        self._system.Assemble()
        self._start = self._system.systemData.GetSystemState()
        self._reached = False

    def _solver_settings(self, tolerance: float) -> Any:
        """A load step by full Newton (modified Newton was slower) and sparse LU, no files, no words."""
        settings = self._exudyn.SimulationSettings()
        settings.solution.file.write = False
        settings.linearSolver.solverType = self._exudyn.LinearSolverType.EigenSparse
        solver = settings.staticSolver
        solver.verboseMode, solver.numberOfLoadSteps, solver.adaptiveStep = 0, 1, False
        solver.newton.relativeTolerance, solver.newton.absoluteTolerance = tolerance, 1e-2 * tolerance
        solver.newton.maxIterations = 50
        return settings

    def _build(self) -> list[Any]:
        """Fills the system with everything and returns its nodes."""
        raise NotImplementedError

    def _moves(self, scene: Scene) -> Iterator[None]:
        """Sets the supports for one load step after another."""
        yield

    def solve(self) -> None:
        data, initial = self._system.systemData, self._exudyn.ConfigurationType.Initial
        data.SetSystemState(self._start, configuration=initial)
        self._reached = False
        for scene in self._problem.scenes:
            for _ in self._moves(scene):
                # What mbs.SolveStatic calls; that prints pages about a failure.
                if not self._exudyn.MainSolverStatic().SolveSystem(self._system, self._settings):
                    return
                data.SetSystemState(data.GetSystemState(), configuration=initial)
        self._reached = True

    def nodes(self) -> np.ndarray:
        position = self._exudyn.OutputVariableType.Position
        found = np.array([self._system.GetNodeOutput(node, position) for node in self._nodes])
        return found if self._reached else np.full_like(found, math.nan)


class ExudynCable(Exudyn):
    """P1 and P3 in their plane by cubic elements; what is z here is y there."""

    def __init__(self, problem: Problem, elements: int):
        # 1e-8 leaves 5e-8 L of error in P1, more than 80 elements make. P3 does not get to 1e-12 there, nor needs to.
        super().__init__(problem, elements, 1e-12 if problem.name == "P1" and elements > 40 else 1e-8)
        self.notes = "2-D ANCFCable2D, static, one load step"

    def _build(self) -> list[Any]:
        items, system, scene = self._items, self._system, self._problem.scenes[0]
        points, frames = start_shape(self._problem, self.elements)
        nodes = []
        for s, point, frame in zip(arclengths(self.elements), points, frames, strict=True):
            straight = np.array([s, 0.0, 1.0, 0.0])
            begin = np.concatenate([point[[0, 2]], frame[[0, 2], 2]])
            node = items.NodePoint2DSlope1(referenceCoordinates=straight, initialCoordinates=begin - straight)
            nodes.append(system.AddNode(node))
        for pair in itertools.pairwise(nodes):
            cable = items.ObjectANCFCable2D(
                length=1 / self.elements,
                massPerLength=float(scene.rod.mass_per_length),
                bendingStiffness=float(scene.rod.EI),
                axialStiffness=float(scene.rod.EA),
                nodeNumbers=list(pair),
                useReducedOrderIntegration=1,  # quicker, with as small an error
            )
            body = system.AddObject(cable)
            if scene.gravity is not None:
                marker = system.AddMarker(items.MarkerBodyMass(bodyNumber=body))
                gravity = [0.0, float(scene.gravity[2]), 0.0]
                system.AddLoad(items.LoadMassProportional(markerNumber=marker, loadVector=gravity))
        ground = system.AddMarker(
            items.MarkerNodeCoordinate(nodeNumber=system.AddNode(items.NodePointGround()), coordinate=0)
        )
        for node, s, (position, _) in zip((nodes[0], nodes[-1]), (0.0, 1.0), clamps(scene), strict=False):
            # The slope along x stays free: it is the stretch.
            for coordinate, offset in ((0, position[0] - s), (1, position[2]), (3, 0.0)):
                marker = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=coordinate))
                system.AddObject(items.CoordinateConstraint(markerNumbers=[ground, marker], offset=offset))
        force = tip_force(scene)
        if force is not None:
            marker = system.AddMarker(items.MarkerNodePosition(nodeNumber=nodes[-1]))
            system.AddLoad(items.LoadForceVector(markerNumber=marker, loadVector=[force[0], force[2], 0.0]))
        return nodes

    def nodes(self) -> np.ndarray:
        return super().nodes()[:, [0, 2, 1]]


class ExudynBeam(Exudyn):
    """P2 by geometrically exact beams; their frames are (t, d1, d2)."""

    # Newton diverges where the end turns by pi/8 in fewer, on any mesh tried.
    load_steps = 4

    def __init__(self, problem: Problem, elements: int):
        super().__init__(problem, elements, 1e-4)  # the shape is that at 1e-8, on any mesh tried
        # With the analytic Jacobian an iteration costs half as much, but Newton needs more load steps, and diverges on
        # 40 elements.
        self._settings.staticSolver.newton.numericalDifferentiation.forODE2 = True
        self.notes = f"3-D BeamGeometricallyExact, static, {self.load_steps} load steps to a step that turns the end"

    def _build(self) -> list[Any]:
        items, system, rod = self._items, self._system, self._problem.scenes[0].rod
        EI, GJ, EA, mass = (float(x) for x in (rod.EI, rod.GJ, rod.EA, rod.mass_per_length))
        section = self._exudyn.BeamSection()
        section.massPerLength = mass
        section.inertia = np.diag([2.0, 1.0, 1.0]) * mass * RADIUS**2 / 4
        # G A, of the material. A softer one takes fewer load steps but moves the shape: a tenth of it lets no mesh
        # come closer than 2e-4 L.
        GA = EA * SHEAR_MODULUS / YOUNGS_MODULUS
        section.stiffnessMatrix = np.diag([EA, GA, GA, GJ, EI, EI])
        nodes = []
        for s, point, frame in zip(arclengths(self.elements), *start_shape(self._problem, self.elements), strict=True):
            straight = np.array([s, 0, 0, 1, 0, 0, 0])  # position and Euler parameters
            quaternion = Rotation.from_matrix(axial_first(frame)).as_quat(canonical=True, scalar_first=True)
            begin = np.concatenate([point, quaternion])
            node = items.NodeRigidBodyEP(referenceCoordinates=straight, initialCoordinates=begin - straight)
            nodes.append(system.AddNode(node))
        for pair in itertools.pairwise(nodes):
            system.AddObject(
                items.ObjectBeamGeometricallyExact(
                    nodeNumbers=list(pair), length=1 / self.elements, sectionData=section
                )
            )
        ground = system.AddObject(items.ObjectGround())
        self._held = []
        for node in (nodes[0], nodes[-1]):
            held = system.AddMarker(items.MarkerBodyRigid(bodyNumber=ground))
            marker = system.AddMarker(items.MarkerNodeRigid(nodeNumber=node))
            system.AddObject(items.ObjectJointGeneric(markerNumbers=[held, marker]))
            self._held.append(held)
        return nodes

    def solve(self) -> None:
        self._frames = start_shape(self._problem, self.elements)[1][[0, -1]]
        super().solve()

    def _moves(self, scene: Scene) -> Iterator[None]:
        before = self._frames
        positions, self._frames = (np.array(values) for values in zip(*clamps(scene), strict=True))
        turns = Rotation.from_matrix(before.swapaxes(1, 2) @ self._frames).as_rotvec()
        is_turned = np.max(np.abs(turns[:, 2])) > 1e-6
        for k in range(1, 1 + (self.load_steps if is_turned else 1)):
            part = Rotation.from_rotvec(turns * k / (self.load_steps if is_turned else 1)).as_matrix()
            for marker, position, frame in zip(self._held, positions, before @ part, strict=True):
                place = self._exudyn.HT(rotation=axial_first(frame), translation=position)
                self._system.SetMarkerParameter(marker, "localHT", place)
            yield


def axial_first(frame: np.ndarray) -> np.ndarray:
    """Columns (t, d1, d2) of a frame with columns (d1, d2, t)."""
    return frame[:, [2, 0, 1]]


def come_to_rest(run: Callable[[], None], nodes: Callable[[], np.ndarray]) -> bool:
    """Repeats `run`, of `STILL_FOR` seconds of the rod's time each, until no node moves any more."""
    last = nodes()
    for _ in range(round(LONGEST / STILL_FOR)):
        run()
        moved, last = np.max(np.abs(nodes() - last)), nodes()
        if moved < STILL:
            return True
        if not moved < 1.0:
            break
    return False


class PyElastica:
    """Position Verlet with a uniform damping rate.

    The rotational inertia, which the shape at rest does not know, is so large that shear vibrations allow the time step
    that stretch allows: some 15 times fewer steps on 10 elements.
    """

    # Of damping [1/s]: the quickest to rest.
    rates: ClassVar = {"P1": 2.0, "P2": 20.0, "P3": 10.0}

    def __init__(self, problem: Problem, elements: int):
        elastica = importlib.import_module("elastica")
        self.program = f"PyElastica {importlib.metadata.version('pyelastica')}"
        self.elements, self._problem = elements, problem
        scene = problem.scenes[0]
        points, _ = start_shape(problem, elements)
        directors = planar_frames(problem.angle((arclengths(elements)[1:] + arclengths(elements)[:-1]) / 2))
        self._rod = elastica.CosseratRod.straight_rod(
            elements,
            start=points[0],
            direction=np.array([1.0, 0.0, 0.0]),
            normal=np.array([0.0, 0.0, -1.0]),
            base_length=1.0,
            base_radius=RADIUS,
            density=DENSITY,
            youngs_modulus=YOUNGS_MODULUS,
            shear_modulus=SHEAR_MODULUS,
        )
        # The rod is straight when free of stress; these are where it begins.
        self._start = points.T, directors.transpose(2, 1, 0)
        crossing = 1 / elements / math.sqrt(YOUNGS_MODULUS / DENSITY)  # of an element by a wave of stretch [s]
        slowed = float(np.min(self._rod.shear_matrix[0, 0])) * (crossing / 2) ** 2  # rotational inertia a length
        factor = slowed / (DENSITY * math.pi * RADIUS**4 / 4)
        self._rod.mass_second_moment_of_inertia *= factor
        self._rod.inv_mass_second_moment_of_inertia /= factor
        self._time_step = 0.6 * crossing
        self.notes = f"3-D CosseratRod, damped to rest, {self._time_step * 1e3:.2f} ms a time step, enlarged inertia"

        held: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._held = held

        class Ends(elastica.ConstraintBase):
            def constrain_values(self, system, time):
                for k, (position, frame) in held.items():
                    system.position_collection[:, k] = position
                    system.director_collection[..., k] = frame.T

            def constrain_rates(self, system, time):
                for k in held:
                    system.velocity_collection[:, k] = 0.0
                    system.omega_collection[:, k] = 0.0

        parts = (elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping)
        self._simulator: Any = type("Simulator", parts, {})()
        self._simulator.append(self._rod)
        self._simulator.constrain(self._rod).using(
            Ends, constrained_position_idx=(0, -1), constrained_director_idx=(0, -1)
        )
        damping = {"uniform_damping_constant": self.rates[problem.name], "time_step": self._time_step}
        self._simulator.dampen(self._rod).using(elastica.AnalyticalLinearDamper, **damping)
        force = tip_force(scene)
        if force is not None:
            self._simulator.add_forcing_to(self._rod).using(
                elastica.EndpointForces, np.zeros(3), force, ramp_up_time=1e-9
            )
        if scene.gravity is not None:
            self._simulator.add_forcing_to(self._rod).using(elastica.GravityForces, np.asarray(scene.gravity))
        self._simulator.finalize()
        self._stepper = elastica.PositionVerlet()
        self._reached = False

    def _run(self) -> None:
        for _ in range(round(STILL_FOR / self._time_step)):
            self._time = self._stepper.step(self._simulator, self._time, self._time_step)

    def solve(self) -> None:
        rod, self._time = self._rod, 0.0
        rod.position_collection[:], rod.director_collection[:] = self._start
        rod.velocity_collection[:] = 0.0
        rod.omega_collection[:] = 0.0
        self._reached = False
        for scene in self._problem.scenes:
            self._held.update(zip((0, -1), clamps(scene), strict=False))
            if not come_to_rest(self._run, self._positions):
                return
        self._reached = True

    def _positions(self) -> np.ndarray:
        return self._rod.position_collection.T.copy()

    def nodes(self) -> np.ndarray:
        return self._positions() if self._reached else np.full((self.elements + 1, 3), math.nan)


class MuJoCo:
    """Rigid cylinders on ball joints, with moments by the cable plugin; the ends are welded to bodies that are moved.

    The joints are damped by the moment that a vibration of the given rate brings to rest soonest.
    """

    # [rad/s]: the quickest to rest.
    rates: ClassVar = {"P1": 0.8, "P2": 20.0, "P3": 10.0}
    # [s]: the largest that the joints (P1) and the welds (P2, P3) bear on coarse meshes.
    time_steps: ClassVar = {"P1": 5e-3, "P2": 1e-3, "P3": 2e-3}

    def __init__(self, problem: Problem, elements: int):
        self._mujoco = importlib.import_module("mujoco")
        self.program = f"MuJoCo {self._mujoco.__version__}"
        self.elements, self._problem = elements, problem
        # The cable's moments are explicit: the finer the mesh, the quicker it bends.
        self._time_step = min(self.time_steps[problem.name], (4.0 if problem.name == "P1" else 0.4) / elements**2)
        points, _ = start_shape(problem, elements)
        self._model = self._mujoco.MjModel.from_xml_string(self._xml(points))
        self._data = self._mujoco.MjData(self._model)
        self._mujoco.mj_forward(self._model, self._data)
        names = ["B_first", *(f"B_{k}" for k in range(1, elements - 1)), "B_last"]
        self._bodies = [self._model.body(name).id for name in names]
        # A body's axes as turned from the frame of its edge, for the two at the ends.
        edges = np.diff(points, axis=0)
        self._edge = np.linalg.norm(edges[-1])
        axes = self._data.xmat[self._bodies].reshape(-1, 3, 3)
        frames = planar_frames(np.arctan2(edges[:, 2], edges[:, 0]))
        self._axes = (frames.swapaxes(1, 2) @ axes)[[0, -1]]
        self.notes = f"3-D cable plugin, damped to rest, {self._time_step * 1e3:g} ms a time step"
        self._reached = False

    def _xml(self, points: np.ndarray) -> str:
        scene = self._problem.scenes[0]
        gravity = np.zeros(3) if scene.gravity is None else np.asarray(scene.gravity)
        damping = 2 * float(scene.rod.EI) * self.elements / self.rates[self._problem.name]
        # Without a stiff impedance a weld gives way by a tenth of a radian.
        weld = 'relpose="0 0 0 1 0 0 0" solref="0.002 1" solimp="0.9999 0.9999 0.001 0.5 2"'
        is_free = isinstance(scene.end, Free)
        holders = "" if is_free else '<body mocap="true" name="start"/><body mocap="true" name="end"/>'
        welds = f'<weld body1="B_first" body2="start" {weld}/><weld body1="B_last" body2="end" {weld}/>'
        pull = '<actuator><motor site="S_last" refsite="origin" gear="0 0 1 0 0 0"/></actuator>'
        return f"""
            <mujoco>
              <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
              <option timestep="{self._time_step}" gravity="{vector(gravity)}" integrator="implicitfast">
                <flag contact="disable"/>
              </option>
              <worldbody>
                <site name="origin"/>
                {holders}
                <composite type="cable" prefix="" vertex="{vector(points)}" initial="{"none" if is_free else "free"}">
                  <plugin plugin="mujoco.elasticity.cable">
                    <config key="bend" value="{YOUNGS_MODULUS}"/>
                    <config key="twist" value="{SHEAR_MODULUS}"/>
                    <config key="flat" value="true"/>
                  </plugin>
                  <joint kind="main" damping="{damping}"/>
                  <geom type="cylinder" size="{RADIUS}" density="{DENSITY}"/>
                </composite>
              </worldbody>
              {pull if is_free else f"<equality>{welds}</equality>"}
            </mujoco>"""

    def _hold(self, scene: Scene) -> None:
        force = tip_force(scene)
        if force is not None:
            self._data.ctrl[0] = force[2]
            return
        for k, (position, frame) in enumerate(clamps(scene)):
            # A body stands at the first node of its edge.
            self._data.mocap_pos[k] = position - (self._edge * frame[:, 2] if k else 0.0)
            quaternion = Rotation.from_matrix(frame @ self._axes[k]).as_quat(scalar_first=True)
            self._data.mocap_quat[k] = quaternion

    def solve(self) -> None:
        self._mujoco.mj_resetData(self._model, self._data)
        self._mujoco.mj_forward(self._model, self._data)
        self._reached = False
        steps = round(STILL_FOR / self._time_step)
        for scene in self._problem.scenes:
            self._hold(scene)
            if not come_to_rest(lambda: self._mujoco.mj_step(self._model, self._data, steps), self._positions):
                return
        # Where it diverges it begins anew by itself, and warns.
        self._reached = not any(warning.number for warning in self._data.warning)

    def _positions(self) -> np.ndarray:
        return np.concatenate([self._data.xpos[self._bodies], [self._data.site("S_last").xpos]])

    def nodes(self) -> np.ndarray:
        return self._positions() if self._reached else np.full((self.elements + 1, 3), math.nan)


def vector(numbers: np.ndarray) -> str:
    """Numbers as an attribute in XML."""
    return " ".join(f"{number:.10g}" for number in np.ravel(numbers))
