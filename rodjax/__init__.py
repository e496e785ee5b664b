"""Shape, forces and derivatives of cables, hoses and wires: quasistatic extensible Kirchhoff rods in JAX."""

import importlib
from typing import TYPE_CHECKING

from rodjax.model.along import Smooth, Steps
from rodjax.model.harness import Body, Harness
from rodjax.model.loads import DistributedCouple, DistributedForce, PointCouple, PointForce, Potential
from rodjax.model.obstacles import Box, Capsule, Cylinder, Distance, Obstacle, Pipe, Plane, Sphere, Union
from rodjax.model.rod import Law, Rod
from rodjax.model.scene import Scene
from rodjax.model.supports import (
    Clamp,
    Clip,
    Free,
    Hinge,
    Joint,
    Pin,
    Slider,
    Spring,
    Swivel,
    frame,
    rotate,
)
from rodjax.model.triangle_mesh import Mesh
from rodjax.programs.answers import numpy_first
from rodjax.programs.compilation import enable_compilation_cache
from rodjax.programs.kept import keep_programs
from rodjax.solving.description import describe
from rodjax.solving.guess import Guess
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.line_search import LineSearch
from rodjax.solving.newton import Newton
from rodjax.solving.nonlinear_cg import NonlinearCG
from rodjax.solving.result import Equilibrium, pictures
from rodjax.solving.result_warnings import MeshWarning, NotConvergedWarning, OverstretchedWarning, PrecisionWarning
from rodjax.solving.solve import solve
from rodjax.solving.status import Status
from rodjax.version import __version__ as __version__

if TYPE_CHECKING:
    from rodjax import problems
    from rodjax.analysis.clearance import Clearance, clearance
    from rodjax.analysis.continuum import solve_continuum
    from rodjax.analysis.curvature import most_curved
    from rodjax.analysis.discrete_energy import energy, residual
    from rodjax.analysis.sensitivity import end_stiffness, sensitivities
    from rodjax.filming import film
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
    from rodjax.io.cad import write_dxf
    from rodjax.io.files import load, save
    from rodjax.io.harness_file import read_scene
    from rodjax.io.quantities import SceneFileError
    from rodjax.io.scene_writing import write_scene
    from rodjax.io.tables import centerline_table, write_table
    from rodjax.paths.batch import solve_batch
    from rodjax.paths.continuation import Branch, CriticalPoint, critical_point, critical_points, follow, switch_branch
    from rodjax.paths.harness_modes import HarnessMode
    from rodjax.paths.modes import Mode, lowest_mode, squared_frequencies
    from rodjax.paths.path import solve_path
    from rodjax.paths.tracing import BranchEnd
    from rodjax.routing.limits import Limits
    from rodjax.routing.margins import Margins, margins
    from rodjax.routing.objective import Objective
    from rodjax.routing.report import Report, report
    from rodjax.routing.route import Route, route
    from rodjax.routing.tolerances import Envelope, Tolerance, tolerances
    from rodjax.routing.variables import Between, OnLine, OnPatch, OnSurface, Turned
    from rodjax.sweeps.sweep import sweep
    from rodjax.window.opening import view

__all__ = [
    "Between",
    "Body",
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
    "Harness",
    "HarnessEquilibrium",
    "HarnessMode",
    "Hinge",
    "Joint",
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
    "PointCouple",
    "PointForce",
    "Potential",
    "PrecisionWarning",
    "Reading",
    "Report",
    "Rod",
    "Route",
    "Scene",
    "SceneFileError",
    "Slider",
    "Smooth",
    "Sphere",
    "Spring",
    "Status",
    "Steps",
    "Swivel",
    "Tolerance",
    "Turned",
    "Union",
    "Unknown",
    "centerline_table",
    "clearance",
    "critical_point",
    "critical_points",
    "describe",
    "enable_compilation_cache",
    "end_stiffness",
    "energy",
    "film",
    "fit",
    "fit_each",
    "follow",
    "frame",
    "keep_programs",
    "load",
    "lowest_mode",
    "margins",
    "most_curved",
    "numpy_first",
    "orthographic",
    "pinhole",
    "problems",
    "read_scene",
    "report",
    "residual",
    "rotate",
    "route",
    "save",
    "sensitivities",
    "solve",
    "solve_batch",
    "solve_continuum",
    "solve_path",
    "squared_frequencies",
    "sweep",
    "switch_branch",
    "tolerances",
    "view",
    "write_dxf",
    "write_scene",
    "write_table",
]


# What a single solve does not need is imported where it is first asked for: diffrax, optimistix and scipy alone take a
# second, files, paths and the analysis of equilibria a third of what is left.
_LATER = {
    **dict.fromkeys(("Clearance", "clearance"), "analysis.clearance"),
    "most_curved": "analysis.curvature",
    **dict.fromkeys(("end_stiffness", "sensitivities"), "analysis.sensitivity"),
    **dict.fromkeys(("load", "save"), "io.files"),
    "SceneFileError": "io.quantities",
    "read_scene": "io.harness_file",
    "write_scene": "io.scene_writing",
    "write_dxf": "io.cad",
    **dict.fromkeys(("centerline_table", "write_table"), "io.tables"),
    **dict.fromkeys(("energy", "residual"), "analysis.discrete_energy"),
    "solve_batch": "paths.batch",
    **dict.fromkeys(
        ("Branch", "CriticalPoint", "critical_point", "critical_points", "follow", "switch_branch"),
        "paths.continuation",
    ),
    "HarnessMode": "paths.harness_modes",
    **dict.fromkeys(("Mode", "lowest_mode", "squared_frequencies"), "paths.modes"),
    "solve_path": "paths.path",
    "BranchEnd": "paths.tracing",
    "solve_continuum": "analysis.continuum",
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
    "sweep": "sweeps.sweep",
    "film": "filming",
    "view": "window.opening",
    **dict.fromkeys(("Between", "OnLine", "OnPatch", "OnSurface", "Turned"), "routing.variables"),
}


def _drawn(equilibrium: Equilibrium | HarnessEquilibrium) -> str:
    """A picture for a notebook, by what takes a second to import."""
    return importlib.import_module("rodjax.plot").picture_html(equilibrium)


pictures.append(_drawn)


def __dir__() -> list[str]:
    """The public names, those that are imported when they are first asked for too."""
    return sorted([*__all__, "__version__", "plot"])


def __getattr__(name: str):
    if name in _LATER:
        value = getattr(importlib.import_module(f"rodjax.{_LATER[name]}"), name)
        globals()[name] = value  # found there from now on
        return value
    if name in ("plot", "problems"):
        return importlib.import_module(f"rodjax.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
