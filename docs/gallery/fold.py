"""An arch is pressed down at its top: its branch of equilibria turns back at a fold, beyond which it is unstable."""

import jax
import numpy as np
from matplotlib.figure import Figure

import rodjax as rj

jax.config.update("jax_enable_x64", True)

strip = rj.Rod(1.0, EI=(100.0, 1.0), GJ=100.0, EA=1e5)  # 100 times as stiff out of the plane as in it
start = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0)))
end = rj.Clamp((0.9, 0, 0), rj.frame((1, 0, 0)))
s = np.linspace(0, 1, 201)
arch = rj.Guess(np.stack([0.9 * s, 0 * s, 0.2 * np.sin(np.pi * s) ** 2], axis=1))
LARGEST = 60.0  # N
scenes = [
    rj.Scene(strip, start, end, point_forces=[rj.PointForce(0.48, (0, 0, -force))]) for force in (-LARGEST, LARGEST)
]
branch = rj.follow(scenes, segments=16, guess=arch, start=0.5, max_points=60)

force = LARGEST * (2 * np.asarray(branch.parameter) - 1)
height = np.asarray(branch.equilibria.position_at([0.48])[:, 0, 2])
print(f"{len(force)} equilibria, which end with: {branch.ended.name}")
folds = [point for point in branch.critical_points if point.kind == "fold"]
for point in folds:
    print(f"fold at {LARGEST * (2 * float(point.parameter) - 1):.3f} N")
(fold,) = folds  # at a larger force the arch snaps through
assert (fold.index_before, fold.index_after) == (0, 1)

figure = Figure(figsize=(6, 4), layout="constrained")
axes = figure.add_subplot(xlabel="height of the loaded point [m]", ylabel="force [N]")
is_stable = np.asarray(branch.index) == 0
axes.plot(height, force, color="0.7", linewidth=1)
axes.plot(height[is_stable], force[is_stable], "o", color="#225ea8", markersize=3, label="stable")
axes.plot(height[~is_stable], force[~is_stable], "o", color="#c0271c", markersize=3, label="unstable")
place = float(fold.equilibrium.position_at([0.48])[0, 2])
axes.plot(place, LARGEST * (2 * float(fold.parameter) - 1), "k^", label="fold")
axes.legend()
figure.savefig("fold.png", dpi=90)
