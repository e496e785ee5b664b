"""How far can the gradient fall? Residual where rounding stops the solver, over mesh and slenderness.

The estimate in `FiniteDifference.rounding_floor` is FLOOR_SAFETY eps (EA L^2/EI + 4 N^2); this prints the residual that
is left, in units of eps (EA L^2/EI + 4 N^2), when that estimate is switched off and the solver tries to go below it.

    python experiments/rounding_floor.py [--segments 10 50 200 1000] [--slenderness 20 200 2000]
"""

import argparse
import sys
import warnings
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

import rodjax
from rodjax import problems
from rodjax.discretization import finite_difference


def main(argv: Sequence[str] | None = None) -> dict[tuple[int, float], float]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, nargs="+", default=[10, 50, 200, 1000])
    parser.add_argument("--slenderness", type=float, nargs="+", default=[20.0, 200.0, 2000.0])
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", rodjax.NotConvergedWarning)  # no tolerance can be met here
    safety, finite_difference.FLOOR_SAFETY = finite_difference.FLOOR_SAFETY, 0.0
    try:
        return table(options.segments, options.slenderness)
    finally:
        finite_difference.FLOOR_SAFETY = safety


def table(segments: Sequence[int], slendernesses: Sequence[float]) -> dict[tuple[int, float], float]:
    eps = float(jnp.finfo(float).eps)
    ratios = {}
    print(f"{'N':>6}{'L/R':>8}{'residual':>12}{'/ eps (EA + 4 N^2)':>22}{'eps N^3, as if from positions':>32}")
    for slenderness in slendernesses:
        scene = problems.omega(1.2, 1.0, problems.cable(slenderness))
        stretch = float(scene.rod.EA / scene.rod.EI)
        for n in segments:
            solver = rodjax.NonlinearCG(tolerance=0.0, max_iterations=400)
            result = rodjax.solve(
                scene, segments=n, discretization="finite_difference", guess=problems.figure_1_start(), solver=solver
            )
            ratio = float(result.residual) / (eps * (stretch + 4 * n**2))
            ratios[n, slenderness] = ratio
            print(f"{n:6}{slenderness:8g}{float(result.residual):12.1e}{ratio:22.2f}{eps * n**3:32.1e}", flush=True)
    print(f"largest ratio {np.max(list(ratios.values())):.2f}")
    return ratios


if __name__ == "__main__":
    main(sys.argv[1:])
