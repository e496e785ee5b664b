"""What `rodjax solve` prints."""

from pathlib import Path
from typing import Any

import numpy as np

import rodjax
from rodjax.analysis.curvature import curvature_along
from rodjax.io.scene_file import SceneFile
from rodjax.solving.result import Equilibrium
from rodjax.solving.status import Status


def header(path: Path, file: SceneFile, result: Equilibrium) -> str:
    scene = file.scenes[0]
    supports = " to ".join(
        "clamp fitted without torsion" if name in file.unclocked else type(end).__name__.lower()
        for name, end in (("start", scene.start), ("end", scene.end))
    )
    scenes = f", {len(file.scenes)} scenes" if file.is_path else ""
    mesh = f"{result.s.shape[-1] - 1} segments"
    if file.segments is None:  # otherwise the estimate would be a program more to compile
        error = np.max(np.asarray(result.error_estimate)[np.asarray(result.converged)], initial=0.0)
        mesh += f", error of the shape about {error:.0e} of the length"
    return f"{path}: {supports}, {float(scene.rod.length):g} m{scenes}, {mesh}"


def rod_table(result: Equilibrium) -> list[str]:
    def vector(values: Any) -> str:
        # Adding zero makes zeros of -0.
        return "".join(f"{float(value) + 0.0:12.4g}" for value in values)

    twist, elastic, scene = float(result.total_twist), float(result.elastic_energy), result.scene
    forces, moments = np.asarray(result.clip_forces), np.asarray(result.clip_moments)
    rows = [f"{f'clip {k}':9}{vector(forces[k])}   {vector(moments[k])}" for k in range(len(scene.clips))]
    for k, forces in enumerate(np.asarray(result.obstacle_forces)):
        rows.append(f"{'':9}{vector(forces.sum(0))}   {_named(result, k)}")
    return [
        rodjax.describe(result),
        f"energy       {elastic:.6g} J elastic, {float(result.energy) - elastic:.6g} J of the loads",
        f"total twist  {twist:.6g} rad ({np.degrees(twist):.4g} deg)",
        "The part of the rod beyond s exerts on the part before it, at the end the support on the rod:",
        f"{'':9}{'force [N]':>36}   {'moment [N m]':>36}",
        f"{'s = 0':9}{vector(result.start_force)}   {vector(result.start_moment)}",
        f"{'s = L':9}{vector(result.end_force)}   {vector(result.end_moment)}",
        *(["Clips and obstacles exert on the rod:"] if rows else []),
        *rows,
        *_bends_and_clearances(result),
    ]


def _bends_and_clearances(result: Equilibrium) -> list[str]:
    largest = float(np.max(curvature_along(result)[1]))
    first, last = (round(float(s), 4) for s in rodjax.most_curved(result))
    rows = [f"smallest bend radius  {1 / largest:.4g} m, between s = {first:g} and {last:g} m"] if largest else []
    if result.scene.obstacles:
        found = rodjax.clearance(result, result.scene.obstacles)
        for k, (distance, s) in enumerate(zip(np.asarray(found.distance), np.asarray(found.s), strict=True)):
            rows.append(f"clearance to {_named(result, k)}  {distance:.4g} m at s = {s:.4g} m")
    return rows


def _named(result: Equilibrium, k: int) -> str:
    return f"obstacles[{k}] ({type(result.scene.obstacles[k]).__name__})"


def path_table(path: Equilibrium) -> list[str]:
    titles = ("twist [deg]", "energy [J]", "|end force| [N]", "|end moment| [N m]", "residual", "iterations")
    rows = [f"{'step':>4}" + "".join(f"{title:>{len(title) + 3}}" for title in titles) + "   status"]
    columns = [
        np.degrees(path.total_twist),
        path.energy,
        np.linalg.norm(path.end_force, axis=-1),
        np.linalg.norm(path.end_moment, axis=-1),
        path.residual,
        path.iterations,
    ]
    for step, status in enumerate(np.asarray(path.status)):
        cells = [f"{float(c[step]):{len(t) + 3}.5g}" for t, c in zip(titles, columns, strict=True)]
        rows.append(f"{step:4}" + "".join(cells) + f"   {Status(status).name.lower().replace('_', ' ')}")
    return rows


def harness_table(result: rodjax.HarnessEquilibrium) -> list[str]:
    """One row for each cable and each joint."""
    wide = max(map(len, (*result, *result.joints, "cable")))
    rows = [f"{'cable':{wide}}  length [m]  segments  bend radius [m]  |f| s=0 [N]  |f| s=L [N]  |m| s=0, s=L [N m]"]
    for name, rod in result.items():
        bend = 1 / max(float(np.max(curvature_along(rod)[1])), 1e-300)
        forces = [float(np.linalg.norm(force)) for force in (rod.start_force, rod.end_force)]
        moments = [float(np.linalg.norm(moment)) for moment in (rod.start_moment, rod.end_moment)]
        rows.append(
            f"{name:{wide}}{float(rod.s[-1]):12.4g}{rod.s.shape[-1] - 1:10}{bend:17.4g}"
            f"{forces[0]:13.4g}{forces[1]:13.4g}{moments[0]:12.4g}{moments[1]:10.4g}"
        )
    rows.append(f"{'joint':{wide}}  position [m]")
    for name, body in result.joints.items():
        rows.append(f"{name:{wide}}" + "".join(f"{float(value) + 0.0:12.4g}" for value in body.position))
    return [rodjax.describe(result), f"energy       {float(result.energy):.6g} J", *rows]
