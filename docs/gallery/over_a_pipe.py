"""A cable hangs over a pipe, which bears part of its weight."""

import jax
import numpy as np

import rodjax as rj
from rodjax.plot import plot_rod

jax.config.update("jax_enable_x64", True)

cable = rj.Rod.circular(length=1.0, radius=8e-3, youngs_modulus=5e6, poisson_ratio=0.5, density=1500)
start = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0)))
end = rj.Clamp((0.7, 0, 0), rj.frame((1, 0, 0)))
pipe = rj.Capsule((0.4, -0.2, -0.27), (0.4, 0.2, -0.27), 0.03)
result = rj.solve(rj.Scene(cable, start, end, gravity=(0, 0, -9.81), obstacles=[pipe]), segments=48)

print(rj.describe(result))
pushed = np.sum(result.obstacle_forces[0], axis=0)
held = result.end_force - result.start_force
weight = 9.81 * float(cable.mass_per_length) * 1.0
print(f"the pipe bears {pushed[2]:.3f} N of {weight:.3f} N")
assert result.converged
assert pushed[2] > 0.1 * weight
assert abs(pushed[2] + held[2] - weight) < 1e-6 * weight  # what bears the cable is its weight

axes = plot_rod(result)
axes.figure.savefig("over_a_pipe.png", dpi=90)
