"""Equilibria in a few lines, with values and units: what `print` shows of them."""

from typing import TYPE_CHECKING, Any

import numpy as np

from rodjax.checks import is_known
from rodjax.model.summaries import value_text
from rodjax.solving.status import Status

if TYPE_CHECKING:
    from rodjax.solving.result import Equilibrium


def stack_told(equilibrium: "Equilibrium") -> str:
    shape, segments = equilibrium.s.shape[:-1], equilibrium.s.shape[-1] - 1
    scenes = f"{' x '.join(map(str, shape))} scenes, " if shape else ""
    return f"{scenes}{segments} segments"


def values_told(equilibrium: "Equilibrium") -> list[tuple[str, str]]:
    """What `print` shows: of several rods the range of each value. Nothing that takes a program to be computed."""
    if not is_known(equilibrium):
        return [("values", "not known inside jax.jit, vmap or grad")]
    codes, counts = np.unique(np.asarray(equilibrium.status), return_counts=True)
    many = equilibrium.status.ndim > 0
    outcome = "; ".join(
        f"{count} {Status(code).message}" if many else Status(code).message
        for code, count in zip(codes, counts, strict=True)
    )

    def between(values: Any, unit: str) -> str:
        values = np.asarray(values)
        low, high = float(np.min(values)), float(np.max(values))
        return f"{low + 0.0:.4g} {unit}" if low == high else f"{low + 0.0:.4g} to {high + 0.0:.4g} {unit}"

    def vectors(values: Any, unit: str) -> str:
        if many:
            return f"{between(np.linalg.norm(values, axis=-1), unit)} in magnitude"
        return value_text(np.asarray(values), unit)

    told = [("status", outcome), ("residual", between(equilibrium.residual, "EI/L^2"))]
    told.append(("iterations", between(equilibrium.iterations, "").strip()))
    told += [("length", between(equilibrium.scene.rod.length, "m")), ("energy", between(equilibrium.energy, "J"))]
    told += [
        (name.replace("_", " "), between(getattr(equilibrium, name), unit))
        for name, unit in (
            ("elastic_energy", "J"),
            ("total_twist", "rad"),
            ("curvature", "1/m"),
            ("tension", "N"),
            ("axial_strain", ""),
        )
    ]
    told += [
        (f"{end} {kind}", vectors(getattr(equilibrium, f"{end}_{kind}"), unit))
        for end in ("start", "end")
        for kind, unit in (("force", "N"), ("moment", "N m"))
    ]
    return [(name, line.strip()) for name, line in told]
