"""The potential energy of a scene as a function of its nodes, and its gradient, for an optimiser of one's own."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import instance, leaf, number_array
from rodjax.discretization.dead_loads import energy_of_origin
from rodjax.discretization.finite_difference import FiniteDifference, Polyline, twist_reference
from rodjax.discretization.first_twist import FirstTwist
from rodjax.model.scene import Scene, has_node_positions, has_potential, nondimensional
from rodjax.model.supports import Clamp, Held


def energy(scene: Scene, nodes: Any, total_twist: Any = 0.0) -> Float[Array, ""]:
    """The potential energy W of a scene whose centerline is a polyline [J].

    W = sum h [EI/2 kappa^2 + EA/2 e^2] + GJ/(2 L) (total twist)^2 - work of the dead loads, eq. (7) of Linn & Stephan
    (2008) by their finite differences, with curvature kappa = 2 tan(turn/2)/h at a node between edges of the reference
    length h, and axial strain e of an edge. It is what `rodjax.NonlinearCG` minimises: at the nodes of
    `rodjax.solve(scene, segments=n, discretization="finite_difference")` it is the `energy` of the result, and its
    gradient vanishes there. Differentiable any number of times by the nodes and by the numbers of the scene, under
    `jit` and `vmap`.

    **Arguments:**

    - `scene`: of a rod that is straight, isotropic and the same all along, under loads with a potential, without clips,
        obstacles and fields.
    - `nodes`: (n + 1, 3) [m], at equal steps of reference arclength, n >= 2; none of them on its neighbour. Nodes at
        held ends count as they are given: keep them where the supports are.
    - `total_twist` [rad]: between two clamps; of those that the frames allow on this polyline, the nearest is meant.

    Raises `ValueError` or `TypeError` for other scenes and nodes. The nodes are absolute positions, whose rounding
    leaves a gradient of about EA eps + 4 EI/L^2 eps n^3: choose the tolerance of an optimiser above it.
    """
    _check(scene)
    nodes = leaf(number_array(nodes, "nodes", (len(nodes), 3)))
    if len(nodes) < 3:
        raise ValueError(f"nodes must be at least 3, of 2 edges, got {len(nodes)}")
    scaled, units = nondimensional(scene)
    polyline = Polyline.through((nodes.astype(scaled.rod.length.dtype) - units.origin[None]) / units.length)
    problem = FiniteDifference(scaled, None)
    if isinstance(scaled.start, Clamp) and isinstance(scaled.end, Clamp):
        # The twist is carried from the same polyline, which stays where it is as the nodes move.
        twist = FirstTwist(jnp.asarray(number_array(total_twist, "total_twist"), polyline.nodes.dtype))
        fixed, begin = jax.lax.stop_gradient((scaled, polyline))
        problem = problem.with_reference(twist_reference(fixed, begin, begin, twist))
    return problem.energies(polyline).total * units.energy + energy_of_origin(scaled, units)


def residual(scene: Scene, nodes: Any, total_twist: Any = 0.0) -> Float[Array, "n+1 3"]:
    """The force out of balance at each node of a polyline [N]: the gradient of `energy` by the nodes, with zeros at
    held ends. Zero at an equilibrium. Arguments and errors as for `energy`.
    """
    _check(scene)
    held = np.ones((np.shape(nodes)[0], 1))
    held[[0, -1], 0] = [not isinstance(end, Held) for end in (scene.start, scene.end)]
    nodes = jnp.asarray(nodes)
    gradient = jax.grad(lambda nodes: energy(scene, nodes, total_twist))(nodes)
    return gradient * jnp.asarray(held, gradient.dtype)


def _check(scene: Scene) -> None:
    instance(scene, "scene", Scene)
    unfit = {
        "rod that varies, is curved at rest, or has two bending stiffnesses or a law": not scene.rod.is_plain,
        "loads without a potential": not has_potential(scene),
        "loads along the rod": bool(scene.distributed),
        "clips": bool(scene.clips),
        "obstacles or fields": has_node_positions(scene),
    }
    for what, holds in unfit.items():
        if holds:
            raise ValueError(f"scene must have no {what}: the energy is that of plain rods by finite differences")
