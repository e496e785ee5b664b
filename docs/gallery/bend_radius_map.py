"""Where may the end of a hose of 1.1 m be, so that it is not bent too tightly? A sweep of 400 positions."""

from pathlib import Path

import h5py
import jax
import numpy as np
from matplotlib.figure import Figure

import rodjax as rj

jax.config.update("jax_enable_x64", True)

COUNT = 20
HOSE = """
[rod]
section = "tube"
length = "1.1 m"
outer_radius = "11 mm"
inner_radius = "7.5 mm"
youngs_modulus = "9 MPa"
poisson_ratio = 0.49
density = "1250 kg/m^3"
[start]
support = "clamp"
position = "[0, 0, 0] mm"
tangent = [0, 0, 1]
[end]
support = "clamp"
position = "[700, 0, 250] mm"
tangent = [1, 0, 0]
[loads]
gravity = "[0, 0, -9.81] m/s^2"
"""
GRID = f"""
"end.position.0" = {{ from = "600 mm", to = "800 mm", count = {COUNT} }}
"end.position.2" = {{ from = "150 mm", to = "350 mm", count = {COUNT} }}
"""
Path("hose.toml").write_text(HOSE)
Path("grid.toml").write_text(GRID)
done = rj.sweep("hose.toml", "grid.toml", "sweep.h5", also=["bend_radius"])
print(f"{done.cases} cases; not converged: {done.failed}; above rtol = {done.rtol:g}: {done.missed}")
assert not done.failed
assert not done.missed

with h5py.File("sweep.h5") as file:
    x, z = (1e3 * file[f"parameters/end.position.{k}"][()].reshape(COUNT, COUNT) for k in (0, 2))
    radius = 1e3 * file["bend_radius"][()].reshape(COUNT, COUNT)
print(f"bend radius {radius.min():.1f} to {radius.max():.1f} mm")

figure = Figure(figsize=(6, 4.4), layout="constrained")
axes = figure.add_subplot(xlabel="x of the end [mm]", ylabel="z of the end [mm]")
image = axes.pcolormesh(x, z, radius, shading="nearest", cmap="viridis")
axes.contour(x, z, radius, levels=np.arange(0, 400, 10), colors="white", linewidths=0.7)
figure.colorbar(image, label="smallest bend radius of the centerline [mm]")
figure.savefig("bend_radius_map.png", dpi=90)
