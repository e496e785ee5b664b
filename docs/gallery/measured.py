"""Stiffness and weight of a cable from points on its centerline, measured to 1 mm, and the force on its end."""

import jax
import numpy as np

import rodjax as rj
from rodjax.identification.plots import plot_shapes

jax.config.update("jax_enable_x64", True)

start = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0)))
end = rj.Clamp((0.7, 0, 0), rj.frame((1, 0, 0)))


def scene(EI, mass_per_length):
    return rj.Scene(rj.Rod(1.0, EI, 0.7 * EI, 1e4, mass_per_length), start, end, gravity=(0, 0, -9.81))


# Measurements made up of a cable that is known, so that the answer is.
true = rj.solve(scene(8e-3, 0.12), segments=16)
s, random = np.linspace(0.1, 0.9, 17), np.random.default_rng(1)
points = np.asarray(true.position_at(s)) + 1e-3 * random.normal(size=(17, 3))
force = np.asarray(true.end_force) + 5e-3 * random.normal(size=3)

experiment = rj.Experiment(scene(5e-3, 0.1), [rj.Centerline(points, s, sd=1e-3), rj.EndForce(force, sd=5e-3)])
fit = rj.fit([experiment], ["rod.EI", "rod.mass_per_length"], segments=16)
print(fit.report())
low, high = fit.interval("rod.EI")
assert low < 8e-3 < high

figure = plot_shapes(fit)
figure.savefig("measured.png", dpi=90)
