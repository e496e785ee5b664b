"""Rods that touch themselves: a rod that is twisted into a plectoneme, and a knot that is pulled tight.

- A straight rod between clamps 0.7 L apart is turned on by 0.7 rad a step until it snaps into contact with itself, and
  on from there. Before it snaps it is solved without contact. How many steps converge, in how many iterations, at how
  many places the rod touches itself, and its end moment by that of a ply, two strands that wind around each other as
  helices, under the same tension (Clauvelin, Audoly & Neukirch, "Elasticity and electrostatics of plectonemic DNA",
  Biophys. J. 96, 2009; `moment_of_ply`).
- An overhand knot is pulled to ends 0.7 L apart, from a sketch of it, and the rod then made thinner. For a thin rod
  the tension is EI/(2 R^2), R the radius of its loop, and the length along which it touches itself is in proportion
  to sqrt(r R) (Audoly, Clauvelin & Neukirch, "Elastic knots", Phys. Rev. Lett. 99, 2007).

    python experiments/self_contact.py [--elements 64] [--steps 15] [--radius 0.01] [--knot-elements 160]
"""

import argparse
import functools

import jax
import numpy as np
from scipy.optimize import brentq

import rodjax

STIFFNESS_RATIO, SPAN, STEP = 0.8, 0.7, 0.7
# Steps before the rod snaps.
BEFORE = 28
# From a sketch, and where contacts wander along the knot, some take near a hundred iterations.
PATIENT = rodjax.Newton(max_iterations=300)
# Ends of the knot and radii, in turn.
KNOTS = ((0.7, 0.002), (0.7, 0.0015), (0.7, 0.001), (0.7, 0.0007), (0.7, 0.0005))


def scene(angle: float, radius: float = 0.01, *, touches: bool = True) -> rodjax.Scene:
    """In units of EI and L."""
    d2 = (0.0, np.cos(angle), np.sin(angle))
    start, end = (
        rodjax.Clamp((x, 0.0, 0.0), rodjax.frame((1.0, 0.0, 0.0), d2=axis))
        for x, axis in ((0.0, (0, 1, 0)), (SPAN, d2))
    )
    rod = rodjax.Rod(1.0, 1.0, STIFFNESS_RATIO, 1e4, radius=radius)
    return rodjax.Scene(rod, start, end, self_contact=touches)


def before_it_snaps(elements: int) -> rodjax.Equilibrium:
    result = None
    for step in range(BEFORE):
        result = rodjax.solve(scene(STEP * step, touches=False), segments=elements, guess=result)
    assert result is not None
    return result


def moment_of_ply(tension: float, radius: float) -> float:
    """Along the ends of a long ply, whose strands lean by `lean` to its axis: its energy is least by its length and by
    `lean`, under a tension and a moment.
    """

    def lacking(lean: float) -> float:
        return np.sin(lean) ** 4 * (1 / 2 + 1 / np.cos(2 * lean)) - tension * radius**2

    lean = float(brentq(lacking, 0.0, np.pi / 4 - 1e-9))  # pyright: ignore
    return 2 * np.cos(lean) * np.sin(lean) ** 3 / np.cos(2 * lean) / radius


def twisted(elements: int, steps: int, radius: float) -> list[rodjax.Equilibrium]:
    """The equilibrium before it snaps, and those of the steps."""
    results = [before_it_snaps(elements)]
    print("end turned  converged  iterations  total twist  elastic energy  contacts  largest force  tension  moment")
    print("     [rad]                              [rad]          [EI/L]                  [EI/L^2]          by a ply's")
    for step in range(BEFORE, BEFORE + steps):
        one = scene(STEP * step, radius)
        result = rodjax.solve(one, segments=elements, guess=results[-1], strain_limit=None)
        results.append(result)
        forces = np.linalg.norm(result.self_contacts.forces, axis=1)
        tension, moment = float(result.end_force[0]), abs(float(result.end_moment[0]))
        print(
            f"{STEP * step:10.1f}  {'yes' if result.converged else 'no':>9}  {int(result.iterations):10}"
            f"  {float(result.total_twist):11.3f}  {float(result.elastic_energy):14.3f}  {np.sum(forces > 0):8}"
            f"  {np.max(forces):13.1f}  {tension:7.1f}  {moment / moment_of_ply(tension, radius):6.3f}",
            flush=True,
        )
    print(f"{sum(bool(result.converged) for result in results[1:])} of {steps} converged")
    return results


@functools.cache
def sketch_of_knot(part: float = 0.5) -> rodjax.Guess:
    """A trefoil, cut where it is farthest out, with straight ends; the knot is this part of the length."""
    t = np.linspace(0.0, 2 * np.pi, 2001)
    knot = np.stack([(2 + np.cos(3 * t)) * np.cos(2 * t), (2 + np.cos(3 * t)) * np.sin(2 * t), np.sin(3 * t)], axis=1)
    knot[:, 2] += 0.35 * (t / np.pi - 1)  # so that the ends part where they cross
    knot *= part / np.sum(np.linalg.norm(np.diff(knot, axis=0), axis=1))
    into, out = (way / np.linalg.norm(way) for way in (knot[1] - knot[0], knot[-1] - knot[-2]))
    straight = np.linspace((1 - part) / 2, 0.0, 800)[:-1, None]
    points = np.concatenate([knot[0] - straight * into, knot, knot[-1] + straight[::-1] * out])
    x = points[-1] - points[0]
    x /= np.linalg.norm(x)
    y = np.cross(x, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    points = (points - points[0]) @ np.stack([x, y, np.cross(x, y)]).T
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    even = np.linspace(0.0, along[-1], 401)
    return rodjax.Guess(np.stack([np.interp(even, along, row) for row in points.T], axis=1) / along[-1])


def knot(span: float, radius: float) -> rodjax.Scene:
    """Of a rod without torsion, in units of EI and L."""
    ends = (
        rodjax.Swivel((0, 0, 0), (1, 0, 0)),
        rodjax.Clamp((span, 0, 0), rodjax.frame((1, 0, 0), d2=(0, 1, 0))),
    )
    return rodjax.Scene(rodjax.Rod(1.0, 1.0, 1.0, 1e6, radius=radius), *ends, self_contact=True)


def tightened(elements: int) -> list[rodjax.Equilibrium]:
    """The knots of `KNOTS`."""
    results: list[rodjax.Equilibrium] = []
    print("ends apart  radius  converged  iterations  tension R^2/EI  sqrt(r/R)  touches along")
    print("       [L]     [L]                                                        [sqrt(r R)]")
    for span, radius in KNOTS:
        guess = results[-1] if results else sketch_of_knot()
        result = rodjax.solve(knot(span, radius), segments=elements, guess=guess, solver=PATIENT, strain_limit=None)
        results.append(result)
        found, middle = result.self_contacts, elements // 2
        touching = np.flatnonzero(np.linalg.norm(found.forces, axis=1) > 0)
        loop = 1 / np.mean(result.curvature[middle - 3 : middle + 4])
        along = (found.s[touching[-1]] - found.s[touching[0]]) / np.sqrt(radius * loop) if len(touching) else 0.0
        print(
            f"{span:10.2f}  {radius:6.4f}  {'yes' if result.converged else 'no':>9}  {int(result.iterations):10}"
            f"  {float(result.end_force[0]) * loop**2:14.4f}  {np.sqrt(radius / loop):9.4f}  {along:13.3f}",
            flush=True,
        )
    return results


def main(arguments: list[str] | None = None) -> list[rodjax.Equilibrium]:
    """The equilibria of `twisted`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--elements", type=int, default=64)
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--radius", type=float, default=0.01)
    parser.add_argument("--knot-elements", type=int, default=160, help="0 for no knot")
    options = parser.parse_args(arguments)
    results = twisted(options.elements, options.steps, options.radius)
    if options.knot_elements:
        tightened(options.knot_elements)
    return results


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
