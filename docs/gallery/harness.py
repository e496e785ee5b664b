"""A trunk branches into two cables; a moulded joint of 20 g hangs freely between them."""

import jax
import numpy as np

import rodjax as rj
from rodjax.plot import plot_harness

jax.config.update("jax_enable_x64", True)

gravity = (0, 0, -9.81)
trunk = rj.Rod.circular(0.42, 6e-3, 1e7, poisson_ratio=0.5, density=1400)
branch = rj.Rod.circular(0.34, 4e-3, 1e7, poisson_ratio=0.5, density=1400)


def pointing(x, y):
    """How a cable sits in the joint, or in a wall: its direction, with d2 upwards."""
    return rj.frame((x, y, 0), d2=(0, 0, 1))


wall = rj.Clamp((0, 0, 0), pointing(1, 0))
left, right = (rj.Clamp((0.65, side * 0.16, -0.05), pointing(1, 0)) for side in (1, -1))
cables = {
    "trunk": rj.Scene(trunk, wall, rj.Joint("y", pointing(1, 0)), gravity),
    "left": rj.Scene(branch, rj.Joint("y", pointing(1, 0.6)), left, gravity),
    "right": rj.Scene(branch, rj.Joint("y", pointing(1, -0.6)), right, gravity),
}
result = rj.solve(rj.Harness(cables, joints={"y": rj.Body(mass=0.02, force=(0, 0, -9.81 * 0.02))}), segments=12)

print(rj.describe(result))
y = result.joints["y"].position
print(f"the joint hangs at x = {y[0]:.4f} m, z = {y[2]:.4f} m")
assert result.converged
assert abs(y[1]) < 1e-6  # both sides are alike
np.testing.assert_allclose(result["left"].start_force[2], result["right"].start_force[2], rtol=1e-5)

axes = plot_harness(result)
axes.figure.savefig("harness.png", dpi=90)
