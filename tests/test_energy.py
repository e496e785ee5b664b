"""The density against its formula."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rodjax import Rod
from rodjax.mechanics.energy import (
    axial_strain_under,
    bending_moment_at,
    curvature_under,
    dead_load_energy,
    density,
    torque_at,
    twist_under,
)

ROD = Rod(1.0, EI=2.0, GJ=3.0, EA=5.0)


def test_density_is_half_stiffness_times_strain_squared():
    np.testing.assert_allclose(density(ROD, squared_curvature=jnp.array(5.0)), 2 / 2 * 5)
    np.testing.assert_allclose(density(ROD, twist=jnp.array(4.0)), 3 / 2 * 16)
    np.testing.assert_allclose(density(ROD, axial_strain=jnp.array(0.1)), 5 / 2 * 0.01)
    together = density(ROD, squared_curvature=jnp.array(5.0), twist=jnp.array(4.0), axial_strain=jnp.array(0.1))
    np.testing.assert_allclose(together, 5 + 24 + 0.025)


def test_section_forces_are_derivatives_of_the_density():
    bending = lambda kappa: density(ROD, squared_curvature=jnp.sum(kappa**2))  # noqa: E731
    np.testing.assert_allclose(jax.grad(bending)(jnp.array([0.0, 3, 0])), [0, 6, 0])
    np.testing.assert_allclose(jax.grad(lambda twist: density(ROD, twist=twist))(jnp.array(2.0)), 6)


def test_axial_strain_under_a_tension():
    tension = jnp.array([0.0, 1.0, -2.0])
    # The density is quadratic, so that its one Newton step is exact.
    np.testing.assert_allclose(axial_strain_under(ROD, tension), tension / 5, rtol=1e-15)
    np.testing.assert_allclose(jax.grad(lambda n: axial_strain_under(ROD, n))(jnp.array(3.0)), 1 / 5, rtol=1e-15)


def test_strains_under_moments_are_those_that_have_them():
    strains = jnp.array([[0.0, 1.5], [-2.0, 3.0]])
    np.testing.assert_allclose(bending_moment_at(ROD, strains), 2 * strains, rtol=1e-15)
    np.testing.assert_allclose(torque_at(ROD, strains), 3 * strains, rtol=1e-15)
    np.testing.assert_allclose(curvature_under(ROD, bending_moment_at(ROD, strains)), strains, rtol=1e-15)
    np.testing.assert_allclose(twist_under(ROD, torque_at(ROD, strains)), strains, rtol=1e-15)


def test_a_dead_force_is_minus_the_gradient_of_its_energy():
    force = jnp.array([1.0, -2, 3])
    np.testing.assert_allclose(jax.grad(dead_load_energy, argnums=1)(force, jnp.ones(3)), -force)


# Solved and printed: shape, energies, forces, moments, curvature and estimated errors, by all discretizations.
SOLVED = """
import json, sys
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
import rodjax as rj
from rodjax.mechanics import energy
EI, GJ, EA = json.loads(sys.argv[1])
if sys.argv[2] == "more":
    def density(rod, squared_curvature=None, twist=None, axial_strain=None):
        terms = [] if squared_curvature is None else [1.5 * rod.EI / 2 * squared_curvature]
        terms += [] if twist is None else [1.3 * rod.GJ / 2 * twist**2]
        terms += [] if axial_strain is None else [1.25 * rod.EA / 2 * axial_strain**2]
        return sum(terms[1:], terms[0])
    energy.density.__code__ = density.__code__  # for all who have it by name
rod = rj.Rod(1.0, EI, GJ, EA, 0.3)
start, gravity = rj.Clamp((0, 0, 0), rj.frame((1, 0, 0))), (0, 0, -9.81)
ends = rj.Clamp((0.7, 0.1, 0), rj.rotate(rj.frame((1, 0, 0)), (1.5, 0.5, 0))), rj.Free(moment=(0.5, 1.5, 0.2))
scenes = [rj.Scene(rod, start, end, gravity) for end in ends]
kinds = ("hermite", "finite_difference")
results = [rj.solve(scene, segments=12, discretization=kind) for scene in scenes for kind in kinds]
numbers = [[x.error_estimate, x.force_error, x.moment_error, x.curvature_error] for x in results]
results.append(rj.solve_continuum(scenes[0], guess=results[0]))
fields = "nodes curvature twist tension axial_strain elastic_energy start_moment end_moment end_force"
numbers += [[getattr(x, field) for field in fields.split()] for x in results]
print(json.dumps(np.concatenate([np.ravel(x) for x in jax.tree.leaves(numbers)]).tolist()))
"""


@pytest.mark.slow
def test_a_term_of_the_density_is_obeyed_everywhere():
    """Half of EI, 0.3 of GJ and a quarter of EA as a term of their own are as good as in the numbers of the rod."""
    runs = (([1.0, 0.8, 1e3], "more"), ([1.5, 0.8 * 1.3, 1.25e3], "plain"))
    found = []
    # Programs kept on disk know nothing of a function that was replaced.
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "RODJAX_CACHE": "off"}
    for stiffnesses, kind in runs:
        command = [sys.executable, "-c", SOLVED, json.dumps(stiffnesses), kind]
        ran = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        found.append(np.array(json.loads(ran.stdout.splitlines()[-1])))
    # Both converge to a residual of 1e-8 of their own units or better, errors to the residual of their estimates.
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-8)
