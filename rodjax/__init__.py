"""Shape, forces and derivatives of cables, hoses and wires: quasistatic extensible Kirchhoff rods in JAX."""

import importlib
from typing import TYPE_CHECKING

from rodjax import problems
from rodjax.along import Smooth, Steps
from rodjax.batch import solve_batch
from rodjax.clearance import Clearance, clearance
from rodjax.compilation import enable_compilation_cache, numpy_first
from rodjax.continuation import Branch, CriticalPoint, critical_point, critical_points, follow, switch_branch
from rodjax.equilibrium import solve
from rodjax.files import load, save
from rodjax.guess import Guess
from rodjax.kept_programs import keep_programs
from rodjax.loads import DistributedCouple, DistributedForce, PointForce
from rodjax.modes import Mode, lowest_mode, squared_frequencies
from rodjax.obstacles import Box, Capsule, Cylinder, Distance, Obstacle, Pipe, Plane, Sphere, Union
from rodjax.path import solve_path
from rodjax.result import Equilibrium, MeshWarning, NotConvergedWarning, OverstretchedWarning, describe
from rodjax.rod import Law, Rod
from rodjax.scene import Scene
from rodjax.scene_file import SceneFileError, read_scene
from rodjax.scene_writing import write_scene
from rodjax.sensitivity import end_stiffness, sensitivities
from rodjax.solvers.line_search import LineSearch
from rodjax.solvers.newton import Newton
from rodjax.solvers.nonlinear_cg import NonlinearCG
from rodjax.status import Status
from rodjax.supports import Clamp, Clip, Free, Pin, Swivel, frame, rotate
from rodjax.tracing import BranchEnd
from rodjax.triangle_mesh import Mesh

if TYPE_CHECKING:
    from rodjax.continuum import solve_continuum
    from rodjax.identification.each import Fits, fit_each
    from rodjax.identification.fit import fit
    from rodjax.identification.measurements import (
        Centerline,
        CriticalValue,
        EndForce,
        EndMoment,
        Experiment,
        Reading,
        orthographic,
        pinhole,
    )
    from rodjax.identification.result import Fit, NotIdentifiableError
    from rodjax.identification.unknowns import Unknown
    from rodjax.routing.limits import Limits
    from rodjax.routing.margins import Margins, margins
    from rodjax.routing.objective import Objective
    from rodjax.routing.report import Report, report
    from rodjax.routing.route import Route, route
    from rodjax.routing.tolerances import Envelope, Tolerance, tolerances
    from rodjax.routing.variables import Between, OnLine, OnPatch, OnSurface, Turned

__version__ = "0.1.0"

__all__ = [
    "Between",
    "Box",
    "Branch",
    "BranchEnd",
    "Capsule",
    "Centerline",
    "Clamp",
    "Clearance",
    "Clip",
    "CriticalPoint",
    "CriticalValue",
    "Cylinder",
    "Distance",
    "DistributedCouple",
    "DistributedForce",
    "EndForce",
    "EndMoment",
    "Envelope",
    "Equilibrium",
    "Experiment",
    "Fit",
    "Fits",
    "Free",
    "Guess",
    "Law",
    "Limits",
    "LineSearch",
    "Margins",
    "Mesh",
    "MeshWarning",
    "Mode",
    "Newton",
    "NonlinearCG",
    "NotConvergedWarning",
    "NotIdentifiableError",
    "Objective",
    "Obstacle",
    "OnLine",
    "OnPatch",
    "OnSurface",
    "OverstretchedWarning",
    "Pin",
    "Pipe",
    "Plane",
    "PointForce",
    "Reading",
    "Report",
    "Rod",
    "Route",
    "Scene",
    "SceneFileError",
    "Smooth",
    "Sphere",
    "Status",
    "Steps",
    "Swivel",
    "Tolerance",
    "Turned",
    "Union",
    "Unknown",
    "clearance",
    "critical_point",
    "critical_points",
    "describe",
    "enable_compilation_cache",
    "end_stiffness",
    "fit",
    "fit_each",
    "follow",
    "frame",
    "keep_programs",
    "load",
    "lowest_mode",
    "margins",
    "numpy_first",
    "orthographic",
    "pinhole",
    "problems",
    "read_scene",
    "report",
    "rotate",
    "route",
    "save",
    "sensitivities",
    "solve",
    "solve_batch",
    "solve_continuum",
    "solve_path",
    "squared_frequencies",
    "switch_branch",
    "tolerances",
    "write_scene",
]


# diffrax, optimistix and scipy take a second to import, which a solve without them need not wait for.
_LATER = {
    "solve_continuum": "continuum",
    "fit": "identification.fit",
    "Fit": "identification.result",
    "NotIdentifiableError": "identification.result",
    "fit_each": "identification.each",
    "Fits": "identification.each",
    "Unknown": "identification.unknowns",
    **dict.fromkeys(
        (
            "Centerline",
            "CriticalValue",
            "EndForce",
            "EndMoment",
            "Experiment",
            "Reading",
            "orthographic",
            "pinhole",
        ),
        "identification.measurements",
    ),
    "Limits": "routing.limits",
    "Margins": "routing.margins",
    "Envelope": "routing.tolerances",
    "Tolerance": "routing.tolerances",
    "tolerances": "routing.tolerances",
    "margins": "routing.margins",
    "Report": "routing.report",
    "report": "routing.report",
    "Objective": "routing.objective",
    "Route": "routing.route",
    "route": "routing.route",
    **dict.fromkeys(("Between", "OnLine", "OnPatch", "OnSurface", "Turned"), "routing.variables"),
}


def __getattr__(name: str):
    if name in _LATER:
        return getattr(importlib.import_module(f"rodjax.{_LATER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
