"""Shape, forces and derivatives of cables, hoses and wires: quasistatic extensible Kirchhoff rods in JAX."""

from typing import TYPE_CHECKING

from rodjax import problems
from rodjax.along import Smooth, Steps
from rodjax.batch import solve_batch
from rodjax.compilation import enable_compilation_cache
from rodjax.continuation import Branch, CriticalPoint, critical_point, critical_points, follow, switch_branch
from rodjax.equilibrium import solve
from rodjax.files import load, save
from rodjax.guess import Guess
from rodjax.loads import DistributedCouple, DistributedForce, PointForce
from rodjax.modes import Mode, lowest_mode, squared_frequencies
from rodjax.path import solve_path
from rodjax.result import Equilibrium, NotConvergedWarning, describe
from rodjax.rod import Law, Rod
from rodjax.scene import Scene
from rodjax.scene_file import SceneFileError, read_scene, write_scene
from rodjax.sensitivity import end_stiffness, sensitivities
from rodjax.solvers.line_search import LineSearch
from rodjax.solvers.newton import Newton
from rodjax.solvers.nonlinear_cg import NonlinearCG
from rodjax.status import Status
from rodjax.supports import Clamp, Clip, Free, Pin, Swivel, frame, rotate
from rodjax.tracing import BranchEnd

if TYPE_CHECKING:
    from rodjax.continuum import solve_continuum

__version__ = "0.1.0"

__all__ = [
    "Branch",
    "BranchEnd",
    "Clamp",
    "Clip",
    "CriticalPoint",
    "DistributedCouple",
    "DistributedForce",
    "Equilibrium",
    "Free",
    "Guess",
    "Law",
    "LineSearch",
    "Mode",
    "Newton",
    "NonlinearCG",
    "NotConvergedWarning",
    "Pin",
    "PointForce",
    "Rod",
    "Scene",
    "SceneFileError",
    "Smooth",
    "Status",
    "Steps",
    "Swivel",
    "critical_point",
    "critical_points",
    "describe",
    "enable_compilation_cache",
    "end_stiffness",
    "follow",
    "frame",
    "load",
    "lowest_mode",
    "problems",
    "read_scene",
    "rotate",
    "save",
    "sensitivities",
    "solve",
    "solve_batch",
    "solve_continuum",
    "solve_path",
    "squared_frequencies",
    "switch_branch",
    "write_scene",
]


def __getattr__(name: str):
    # diffrax and optimistix take a second to import, which a solve without them need not wait for.
    if name == "solve_continuum":
        from rodjax.continuum import solve_continuum

        return solve_continuum
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
