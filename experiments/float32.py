"""What single precision is good for: shape, force and iterations beside double precision, by slenderness and mesh.

P3, a cable between clamps under its weight, and a cable in space with a turn, each in both precisions on the same mesh.
On graphics processors single precision is the faster by far; here only what it
is worth.
"""

import argparse
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from measuring import conditions, set_up

import rodjax
from rodjax import Clamp, Equilibrium, Rod, Scene, Status, frame

SLENDERNESS = (10.0, 100.0, 1e3, 1e4, 1e5, 1e6)


class Row(NamedTuple):
    """Of single precision: errors beside double precision, relative to L and to the largest force or EI/L^2."""

    scene: str
    slenderness: float
    segments: int
    shape: float
    force: float
    residual: float
    iterations: int
    iterations_in_double: int
    status: str


def scenes(slenderness: float) -> dict[str, Scene]:
    # The weight is that of P3, w L^3/EI = 60, at any slenderness.
    rod = Rod(1.0, 1.0, 2 / 3, 4 * slenderness**2, mass_per_length=60 / 9.81)
    turned = frame((1, 1, 0.5), (0, 0, 1))
    return {
        "P3": rodjax.problems.hanging_cable(rod=rod),
        "space, a turn": Scene(rod, Clamp((0, 0, 0), frame((1, 0, 0))), Clamp((0.5, 0.2, 0.1), turned), turns=1),
    }


def main(argv: Sequence[str] | None = None) -> list[Row]:
    options = _options(argv)
    set_up()
    rodjax.enable_compilation_cache()
    print(conditions())
    print(" scene          L/R     N  shape error  force error  residual  iterations (double)  status")
    rows = []
    for slenderness in options.slenderness:
        for name, scene in scenes(slenderness).items():
            for segments in options.segments:
                rows.append(compared(name, slenderness, scene, segments))
                row = rows[-1]
                print(
                    f" {row.scene:14} {row.slenderness:5.0e} {row.segments:4d}  {row.shape:11.1e}  {row.force:11.1e}  "
                    f"{row.residual:8.1e}  {row.iterations:10d} ({row.iterations_in_double:d})  {row.status}",
                    flush=True,
                )
    return rows


def compared(name: str, slenderness: float, scene: Scene, segments: int) -> Row:
    double = _quietly(lambda: rodjax.solve(scene, segments=segments, strain_limit=None))
    single = _quietly(lambda: rodjax.solve(in_single_precision(scene), segments=segments, strain_limit=None))
    length, unit = float(scene.rod.length), float(scene.rod.EI / scene.rod.length**2)
    size = max(unit, float(jnp.max(jnp.abs(double.end_force))))
    return Row(
        name,
        slenderness,
        segments,
        float(np.max(np.abs(np.asarray(single.nodes, float) - double.nodes))) / length,
        float(np.max(np.abs(np.asarray(single.end_force, float) - double.end_force))) / size,
        float(single.residual),
        int(single.iterations),
        int(double.iterations),
        Status(int(single.status)).name,
    )


def in_single_precision(scene: Scene) -> Scene:
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), scene)


def _quietly(solve: Callable[[], Equilibrium]) -> Equilibrium:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rodjax.NotConvergedWarning)
        return solve()


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slenderness", type=float, nargs="+", default=SLENDERNESS, help="L/R")
    parser.add_argument("--segments", type=int, nargs="+", default=(8, 32, 128))
    return parser.parse_args(argv)


if __name__ == "__main__":
    main()
