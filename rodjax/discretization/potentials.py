"""Fields of forces: potentials that depend on where the rod is, at nodes that have positions of their own.

The energy of a field along an element is that of the cubic through the positions and slopes of its nodes, by the
trapezoidal rule with the correction of its ends, of fourth order:

    h/2 (V_start + V_end) + h^2/12 (V'_start - V'_end),    V' = grad V . t + dV/ds

A field along a part of the rod is that of the elements within. So each node has a part of its own, a function of its
position and tangent, and no node is coupled with another; between elements of one length the corrections cancel.
Stretch and shear are left out of V', where they would be h^2 times their strains.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.geometry.vectors import cross, dot
from rodjax.model.loads import acting, densities
from rodjax.model.scene import Scene


class NodeEnergy(NamedTuple):
    """Of the fields at the nodes: energy, its derivatives by their rotations, the second ones by positions and
    rotations of the nodes.
    """

    energy: Float[Array, "n+1"]
    by_rotation: Float[Array, "b n+1"]
    by_positions: Float[Array, "n+1 3 3"]
    turning: Float[Array, "b 3 n+1"]
    by_rotations: Float[Array, "b b n+1"]


class PointForces(NamedTuple):
    """Forces of q obstacles within n elements, at the parts t of these, and the first node's share of each."""

    t: Float[Array, "q n"]
    forces: Float[Array, "q 3 n"]
    shares: Float[Array, "q n"]

    def beyond_parabola(self, x: Float[Array, ""], begin: Float[Array, ""], steps: int) -> Float[Array, "3 n"]:
        """What the forces through the elements, which jump, are at their part x beyond those of `section_forces`, which
        are parabolas; a jump within the one of so many steps that begins there counts in all of it as in the mean.
        """
        passed = jnp.clip((begin - self.t) * steps + 1, 0.0, 1.0)
        start = jnp.sum(self.shares[:, None] * self.forces, axis=0)
        jumps = start - jnp.sum(passed[:, None] * self.forces, axis=0)
        end = start - jnp.sum(self.forces, axis=0)
        return jumps - (1 - x) * (1 - 2 * x) * start + x * (1 - x) * (start + end) - x * (2 * x - 1) * end


class OnElements(NamedTuple):
    """Of the fields at both ends of each element: the derivatives of its energy by the positions and the tangents of
    its nodes, and the force per length there; `points`: what they have at one place of an element.
    """

    by_position: Float[Array, "3 2 n"]
    by_tangent: Float[Array, "3 2 n"]
    density: Float[Array, "3 2 n"]
    points: PointForces | None = None

    def added_to(self, others: "OnElements | None") -> "OnElements":
        """To others without such places."""
        if others is None:
            return self
        return OnElements(
            others.by_position + self.by_position,
            others.by_tangent + self.by_tangent,
            others.density + self.density,
            self.points,
        )


def _beside(
    scene: Scene,
    position: Float[Array, "3"],
    tangent: Float[Array, "3"],
    s: Float[Array, ""],
    weights: Float[Array, "fields"],
    corrections: Float[Array, "fields"],
) -> Float[Array, ""]:
    def of_fields(position: Float[Array, "3"], s: Float[Array, ""]) -> Float[Array, "fields"]:
        return densities(scene.potentials, position, s)

    values, rates = jax.jvp(of_fields, (position, s), (tangent, jnp.ones_like(s)))
    return jnp.sum(weights * values + corrections * rates)


def _weights(scene: Scene, s: Float[Array, "n+1"]) -> tuple[Float[Array, "n+1 fields"], Float[Array, "n+1 fields"]]:
    h = jnp.diff(s)[:, None] * acting(scene.potentials, (s[1:] + s[:-1]) / 2)
    before, after = jnp.pad(h, ((1, 0), (0, 0))), jnp.pad(h, ((0, 1), (0, 0)))
    return (before + after) / 2, (after**2 - before**2) / 12


def node_energies(
    scene: Scene, s: Float[Array, "n+1"], positions: Float[Array, "n+1 3"], tangents: Float[Array, "3 n+1"]
) -> Float[Array, "n+1"]:
    """Of a nondimensional scene."""
    weights = _weights(scene, s)
    return jax.vmap(lambda *node: _beside(scene, *node))(positions, tangents.T, s, *weights)


def by_position(
    scene: Scene, s: Float[Array, "n+1"], positions: Float[Array, "n+1 3"], tangents: Float[Array, "3 n+1"]
) -> Float[Array, "n+1 3"]:
    return jax.grad(lambda positions: jnp.sum(node_energies(scene, s, positions, tangents)))(positions)


def at_nodes(
    scene: Scene,
    s: Float[Array, "n+1"],
    positions: Float[Array, "n+1 3"],
    tangents: Float[Array, "3 n+1"],
    axes: Float[Array, "3 b n+1"],
) -> NodeEnergy:
    """`axes`: about which the tangents turn, zero where they are held."""

    def of_node(position, tangent, axes, s, weights, corrections):
        def energy(change: Float[Array, "3+b"]) -> Float[Array, ""]:
            turn = axes @ change[3:]
            across = jnp.cross(turn, tangent)
            turned = tangent + across + jnp.cross(turn, across) / 2
            return _beside(scene, position + change[:3], turned, s, weights, corrections)

        nothing = jnp.zeros(3 + axes.shape[1], position.dtype)
        return *jax.value_and_grad(energy)(nothing), jax.hessian(energy)(nothing)

    nodes = positions, tangents.T, axes.transpose(2, 0, 1), s, *_weights(scene, s)
    energy, first, second = jax.vmap(of_node)(*nodes)
    return NodeEnergy(
        energy,
        first[:, 3:].T,
        second[:, :3, :3],
        second[:, 3:, :3].transpose(1, 2, 0),
        second[:, 3:, 3:].transpose(1, 2, 0),
    )


def at_both(of_elements: Float[Array, "3 2 n"]) -> Float[Array, "3 n+1"]:
    """What both ends of the elements have, at the nodes."""
    return jnp.pad(of_elements[:, 0], ((0, 0), (0, 1))) + jnp.pad(of_elements[:, 1], ((0, 0), (1, 0)))


def of_pulls(
    pulls: Float[Array, "3 n+1"], tangents: Float[Array, "3 n+1"], axes: Float[Array, "3 b n+1"]
) -> NodeEnergy:
    """The derivatives of -sum pull . tangent, whose value is not counted."""
    by_rotation = -dot(pulls[:, None], cross(axes, jnp.broadcast_to(tangents[:, None], axes.shape)))
    # A tangent t that turns by w, then v, under a pull f: half of both orders, w (v.t) + v (w.t) less 2 t (w.v).
    pulled, leaned = (jnp.einsum("cbn,cn->bn", axes, v) for v in (pulls, tangents))
    mixed = (pulled[:, None] * leaned[None] + leaned[:, None] * pulled[None]) / 2
    by_rotations = dot(pulls, tangents)[None, None] * jnp.einsum("cbn,can->ban", axes, axes) - mixed
    nothing = jnp.zeros((tangents.shape[1], 3, 3), pulls.dtype)
    turning = jnp.zeros((axes.shape[1], 3, tangents.shape[1]), pulls.dtype)
    return NodeEnergy(nothing[:, 0, 0], by_rotation, nothing, turning, by_rotations)


def on_elements(
    scene: Scene, s: Float[Array, "n+1"], positions: Float[Array, "n+1 3"], tangents: Float[Array, "3 n+1"]
) -> OnElements:
    h, on_element = jnp.diff(s), acting(scene.potentials, (s[1:] + s[:-1]) / 2)

    def at_end(k: int, sign: int) -> tuple[Array, Array, Array]:
        nodes = slice(k, len(s) - 1 + k)

        def of_node(position, tangent, s, h, acts):
            def energy(position, tangent):
                return _beside(scene, position, tangent, s, h / 2 * acts, sign * h**2 / 12 * acts)

            density = jax.grad(lambda position: jnp.sum(acts * densities(scene.potentials, position, s)))(position)
            return *jax.grad(energy, argnums=(0, 1))(position, tangent), -density

        return jax.vmap(of_node)(positions[nodes], tangents.T[nodes], s[nodes], h, on_element)

    ends = zip(at_end(0, 1), at_end(1, -1), strict=True)
    by_position, by_tangent, density = (jnp.stack([start.T, end.T], axis=1) for start, end in ends)
    return OnElements(by_position, by_tangent, density)


def section_forces(forces: Float[Array, "3 3 n"], fields: OnElements, h: Float[Array, "n"]) -> Float[Array, "3 3 n"]:
    """The forces through start, middle and end of the elements, of those without the fields: parabolas."""
    start, end = -fields.by_position[:, 0], fields.by_position[:, 1]
    mean = h[None] / 12 * (fields.density[:, 0] - fields.density[:, 1])
    return forces + jnp.stack([start, 3 / 2 * mean - (start + end) / 4, end], axis=1)
