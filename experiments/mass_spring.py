"""What does a chain of masses and springs, without frames, make of Fig. 1? All of its bending and none of its twist.

The model that Linn & Stephan (2008) argue against: point masses, stretching springs between neighbours and bending
springs between next-but-one neighbours. A clamp holds two masses, so that it holds a direction but cannot be turned.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float
from matplotlib.figure import Figure

import rodjax
from rodjax import problems

STAGES = {0: "a", 9: "b", 13: "c", 17: "d", 21: "e", 25: "f"}  # after so many steps
WORDS = ("circle segment", "Omega", "90°", "180°", "270°", "360°")
COLORS = ("0.6", "C0", "C2", "C8", "C1", "C3")
# Norm of the gradient [EI/L^2]. The springs' energies differ by less than rounding where it is much below: the stiffest
# mode is 1e7 EI/L^3, the softest, in which an error shows, is 14.
GRADIENT_TOLERANCE = 1e-4


class Chain(eqx.Module):
    """Masses at s = -h/2, h/2, ..., L + h/2; each clamp sits in the middle of an outer edge, which it holds."""

    rod: rodjax.Rod
    held: Float[Array, "4 3"]  # positions of the first two and the last two masses

    @staticmethod
    def between(scene: rodjax.Scene, segments: int) -> "Chain":
        half = scene.rod.length / segments / 2
        clamps = [end for end in (scene.start, scene.end) if isinstance(end, rodjax.Clamp)]
        held = [clamp.position + sign * half * clamp.frame[:, 2] for clamp in clamps for sign in (-1, 1)]
        return Chain(scene.rod, jnp.stack(held))

    def masses(self, free: Float[Array, "n-2 3"]) -> Float[Array, "n+2 3"]:
        return jnp.concatenate([self.held[:2], free, self.held[2:]])

    def energy(self, free: Float[Array, "n-2 3"]) -> Float[Array, ""]:
        """Energy of the springs [J].

        The bending springs push with the constant force 2 EI/h^2 and the stretching springs pull against them, so that
        a joint bent by a small angle a stores EI a^2/(2h). Springs at rest over 2h would store a^4: soft when straight.
        """
        masses = self.masses(free)
        h = self.rod.length / (len(free) + 2)
        edges = jnp.linalg.norm(jnp.diff(masses, axis=0), axis=1)
        across = jnp.linalg.norm(masses[2:] - masses[:-2], axis=1)
        bending = 2 * self.rod.EI / h**2 * jnp.sum(edges[:-1] + edges[1:] - across)
        return self.rod.EA / (2 * h) * jnp.sum((edges - h) ** 2) + bending


@jax.jit
def value_and_gradient(chain: Chain, free: Float[Array, "n-2 3"]):
    return jax.value_and_grad(chain.energy)(free)


@jax.jit
def hessian(chain: Chain, free: Float[Array, "n-2 3"]):
    return jax.hessian(chain.energy)(free).reshape(free.size, free.size)


def relaxed(chain: Chain, free: np.ndarray) -> np.ndarray:
    """The free masses in equilibrium, from a warm start; lengths in L and energies in EI/L for the minimiser."""
    length, energy = float(chain.rod.length), float(chain.rod.EI / chain.rod.length)

    def positions(x):
        return x.reshape(-1, 3) * length

    def objective(x):
        value, gradient = value_and_gradient(chain, positions(x))
        return float(value) / energy, np.asarray(gradient).ravel() * length / energy

    result = scipy.optimize.minimize(
        objective,
        free.ravel() / length,
        jac=True,
        hess=lambda x: np.asarray(hessian(chain, positions(x))) * length**2 / energy,
        method="trust-exact",
        options={"gtol": GRADIENT_TOLERANCE, "maxiter": 2000},
    )
    if not result.success:
        raise RuntimeError(f"the chain found no equilibrium: {result.message}")
    return positions(result.x)


class Stage(NamedTuple):
    chain: Float[np.ndarray, "n 3"]
    rod: Float[np.ndarray, "n 3"]


def stages(segments: int) -> dict[str, Stage]:
    """Both models at s = h/2, 3h/2, ..., L - h/2 [m] in the six stages of Fig. 1."""
    scenes = [problems.omega(problems.ARC_HALF_ANGLE, 0.0), *problems.figure_1()]
    guess = problems.figure_1_start()
    path = rodjax.solve_path(scenes, segments=segments, discretization="finite_difference", guess=guess)
    h = scenes[0].rod.length / segments
    rods = np.asarray(path.position_at(h * (jnp.arange(segments, dtype=h.dtype) + 0.5)))
    free = rods[0, 1:-1]
    found = {}
    for step, scene in enumerate(scenes):
        chain = Chain.between(scene, segments)
        free = relaxed(chain, free)
        if step in STAGES:
            found[STAGES[step]] = Stage(np.asarray(chain.masses(jnp.asarray(free)))[1:-1], rods[step])
    return found


def table(found: dict[str, Stage]) -> list[dict[str, str | float]]:
    """Lowest height, deflection out of the plane, and how far the point that moved most is from stage (b) [m]."""
    rows = []
    for words, (stage, result) in zip(WORDS, found.items(), strict=True):
        row: dict[str, str | float] = {"stage": stage, "name": words}
        for model in ("chain", "rod"):
            points, before = getattr(result, model), getattr(found["b"], model)
            row[f"{model}_lowest"] = float(points[:, 2].min())
            row[f"{model}_out_of_plane"] = float(np.abs(points[:, 1]).max())
            row[f"{model}_from_b"] = float(np.linalg.norm(points - before, axis=1).max())
        rows.append(row)
    return rows


def picture(found: dict[str, Stage]) -> Figure:
    """Front and top view of every stage, chain and rod side by side; coinciding curves show as rings."""
    figure = Figure(figsize=(11, 6.3), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=(2, 1))
    for column, model in enumerate(("chain", "rod")):
        for k, (stage, result) in enumerate(found.items()):
            points = getattr(result, model)
            width = 2.0 + 2.0 * (5 - k) if model == "chain" and stage != "a" else 2.0
            for panel, axis in zip(panels[:, column], (2, 1), strict=True):
                panel.plot(points[:, 0], points[:, axis], color=COLORS[k], lw=width, label=f"({stage}) {WORDS[k]}")
        panels[0, column].set_title({"chain": "masses and springs: (b) to (f) coincide", "rod": "rodjax"}[model])
        panels[1, column].set_xlabel("x [m]")
    for row, label, limits in zip(
        panels, ("height z [m]", "out of plane y [m]"), ((-0.4, 0.0), (-0.1, 0.1)), strict=True
    ):
        row[0].set(ylabel=label, ylim=limits)
    for panel in panels.flat:
        panel.set_aspect("equal")
        panel.grid(color="0.92")
    figure.legend(*panels[0, 1].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return figure


def main(argv: Sequence[str] | None = None) -> list[dict[str, str | float]]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--segments", type=int, default=20)
    parser.add_argument("--out", type=Path, help="folder for mass_spring.csv and mass_spring.png")
    arguments = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    found = stages(arguments.segments)
    rows = table(found)
    print(f"{arguments.segments} segments, lengths in mm: masses and springs | rodjax")
    print(f"{'stage':20}" + 2 * f" |{'lowest':>8}{'off plane':>11}{'from (b)':>10}")
    for row in rows:
        # Adding zero turns -0 into 0.
        cells = [round(1e3 * float(value), 1) + 0.0 for value in list(row.values())[2:]]
        print(f"({row['stage']}) {row['name']:16}" + (2 * " |{:8.1f}{:11.1f}{:10.1f}").format(*cells))
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        with open(arguments.out / "mass_spring.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        picture(found).savefig(arguments.out / "mass_spring.png", dpi=110)
    return rows


if __name__ == "__main__":
    main()
