"""A straight rod between clamps 0.7 L apart is turned on until it snaps into contact with itself, and on from there.

How many steps converge, in how many iterations, and at how many places the rod touches itself.

The clamps are turned by 0.7 rad a step; before it snaps the rod is solved without contact.

    python experiments/self_contact.py [--elements 64] [--steps 15]
"""

import argparse

import jax
import numpy as np

import rodjax

RADIUS, STIFFNESS_RATIO, SPAN, STEP = 0.01, 0.8, 0.7, 0.7
# Steps before the rod snaps.
BEFORE = 28


def scene(angle: float, *, touches: bool = True) -> rodjax.Scene:
    """In units of EI and L."""
    d2 = (0.0, np.cos(angle), np.sin(angle))
    start, end = (
        rodjax.Clamp((x, 0.0, 0.0), rodjax.frame((1.0, 0.0, 0.0), d2=axis))
        for x, axis in ((0.0, (0, 1, 0)), (SPAN, d2))
    )
    rod = rodjax.Rod(1.0, 1.0, STIFFNESS_RATIO, 1e4, radius=RADIUS)
    return rodjax.Scene(rod, start, end, self_contact=touches)


def before_it_snaps(elements: int) -> rodjax.Equilibrium:
    result = None
    for step in range(BEFORE):
        result = rodjax.solve(scene(STEP * step, touches=False), segments=elements, guess=result)
    assert result is not None
    return result


def main(arguments: list[str] | None = None) -> list[rodjax.Equilibrium]:
    """The equilibrium before it snaps, and those of the steps."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--elements", type=int, default=64)
    parser.add_argument("--steps", type=int, default=15)
    options = parser.parse_args(arguments)
    results = [before_it_snaps(options.elements)]
    print("end turned  converged  iterations  total twist  elastic energy  contacts  least gap  largest force")
    print("     [rad]                              [rad]          [EI/L]             [radius]       [EI/L^2]")
    for step in range(BEFORE, BEFORE + options.steps):
        result = rodjax.solve(scene(STEP * step), segments=options.elements, guess=results[-1], strain_limit=None)
        results.append(result)
        found = result.self_contacts
        forces = np.linalg.norm(found.forces, axis=1)
        print(
            f"{STEP * step:10.1f}  {'yes' if result.converged else 'no':>9}  {int(result.iterations):10}"
            f"  {float(result.total_twist):11.3f}  {float(result.elastic_energy):14.3f}  {np.sum(forces > 0):8}"
            f"  {float(np.min(found.gaps)) / RADIUS:9.1e}  {np.max(forces):13.1f}",
            flush=True,
        )
    print(f"{sum(bool(result.converged) for result in results[1:])} of {options.steps} converged")
    return results


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
