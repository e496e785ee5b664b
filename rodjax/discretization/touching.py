"""A rod that touches obstacles: the forms with a force of its own in each element, and pressure on its nodes.

Where a node is nearer to an obstacle than the rod is thick, it is pushed back by a force in proportion to how deep it
is, straight out of the obstacle, so that the energy stays a smooth function: without friction. The stiffness is so
high that loads of the size of those on the rod press it in by a small part of its radius only.

The force through an element is that of all loads and contacts beyond it: unknown, one for each element, as the position
of each node is. At a node the forces on its two sides differ by the contact; from node to node the way is that of the
element (`chain.ChainSystem`). Positions follow from the elements, so that tangents or frames and forces alone make a
point. Elements only. Contact acts at the nodes; between them the rod is not looked at.
"""

import dataclasses
import functools
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import FLOOR_SAFETY, Form
from rodjax.geometry.interpolation import cubic
from rodjax.geometry.vectors import dot
from rodjax.mechanics.passage import PLACES
from rodjax.model.along import Value, largest_beside, value_at
from rodjax.model.loads import DistributedForce
from rodjax.model.obstacles import Obstacle, least
from rodjax.model.supports import Free

# A contact as strong as all loads together, and bending of BENDING [EI/L^2], goes so deep, in parts of the radius.
PENETRATION = 3e-5
BENDING = 100.0
# The most of a contact that counts as it curves, in terms of that which the elements know of: beside one another in a
# corner each of two obstacles may push as much as both together.
MOST_CURVING = 2.0
# A step takes no place deeper than this, in parts of the radius, into an obstacle; one that is there already so much
# deeper. Its way is looked at at most so often, further on each time by its distance, or so much at least.
DEEPEST = 0.5
DEEPER = 0.125
LEAST_WAY = 0.05
MOST_LOOKS = 24
# Places on the line to a held node that the rod does not reach yet.
BETWEEN = 7


class TouchingForm(Form):
    """A nondimensional scene with obstacles; the `end_force` of its points is (3, n): that through each element.

    `softening`: by how much the contacts are softer than those of a result, 1 or less; `is_cautious`: an obstacle that
    curves away counts only by the forces that the elements know of. On the way to an equilibrium a contact may be far
    too deep for its stiffness, and would throw the rod off a round obstacle.
    """

    softening: Float[Array, ""] = eqx.field(kw_only=True)
    is_cautious: bool = eqx.field(kw_only=True, static=True, default=False)

    @abstractmethod
    def node_slopes(self, point: Any) -> Float[Array, "n+1 3"]:
        """The derivative of the centerline by arclength at the nodes."""

    @abstractmethod
    def largest_force(self, point: Any) -> Float[Array, ""]:
        """The largest component of a force through the rod."""

    def softened(self, softening: Float[Array, ""]) -> "TouchingForm":
        """On the way to an equilibrium."""
        return dataclasses.replace(self, softening=softening, is_cautious=True)

    # --- what is unknown ---------------------------------------------------------------------------------------------

    def multipliers_turned(
        self, point: Any, axis: Float[Array, "3"], multipliers: Float[Array, "k"]
    ) -> Float[Array, "k"]:
        positions = self.positions(self.edges(point))
        places, _ = self.held_places
        arms = jnp.where(self.is_held[:, None], 0.0, positions - places[:, 0][None])
        by_node = jnp.cross(axis[None], arms).reshape(-1)
        of_force = self.force_turned(point, axis)
        return multipliers.at[-len(by_node) - len(of_force) :].set(jnp.concatenate([by_node, of_force]))

    def axial_forces(self, point: Any) -> Float[Array, "slides"]:
        nodes = self.clip_nodes
        assert nodes is not None
        along = dot(self.at_nodes(point.end_force)[:, nodes], self.tangents_in_clips(point))
        return along[np.array([k for k, clip in enumerate(self.scene.clips) if clip.sliding])]

    def is_closed(self, closure: Float[Array, "k"], tolerance: float) -> Bool[Array, ""]:
        return super().is_closed(self.closure(closure), tolerance)

    # --- places and contacts -----------------------------------------------------------------------------------------

    @staticmethod
    def at_nodes(end_force: Float[Array, "3 n"]) -> Float[Array, "3 n+1"]:
        """What clips, contacts and supports apply at the nodes, of the forces through the elements."""
        around = jnp.pad(end_force, ((0, 0), (1, 1)))
        return around[:, :-1] - around[:, 1:]

    @property
    def is_held(self) -> Bool[Array, "n+1"]:
        _, nodes = self.held_places
        return jnp.zeros(len(self.field.s), bool).at[nodes].set(True)

    def positions(self, edges: Float[Array, "n 3"]) -> Float[Array, "n+1 3"]:
        """Nodes along the edges, each from the last held one before it, or from the first."""
        places, held = self.held_places
        sums = jnp.concatenate([jnp.zeros((1, 3), edges.dtype), jnp.cumsum(edges, axis=0)])
        last = jnp.maximum(jnp.searchsorted(held, jnp.arange(len(sums)), side="right") - 1, 0)
        return places.T[last] + (sums - sums[held[last]])

    @property
    def radius(self) -> Float[Array, "n+1"]:
        """At the nodes; of a radius that jumps, the larger one beside the node."""
        return largest_beside(self._radius, self.field.s)

    def radius_in_elements(self, parts: Float[Array, "k"]) -> Float[Array, "n k"]:
        """At places in each element, as parts of it."""
        s = self.field.s
        begin, end = (jnp.broadcast_to(side[:, None], (len(s) - 1, len(parts))) for side in (s[:-1], s[1:]))
        return value_at(self._radius, begin + parts[None] * (end - begin), begin, end)

    @property
    def _radius(self) -> Value:
        radius = self.scene.rod.radius
        assert radius is not None, "a scene with obstacles has a radius"
        return radius

    @property
    def stiffness(self) -> Float[Array, ""]:
        """Of a contact [EI/L^3]."""
        scene = self.scene
        forces = [load.force for load in scene.point_forces]
        forces += [end.force for end in (scene.start, scene.end) if isinstance(end, Free) and end.force is not None]
        forces += [] if scene.gravity is None else [scene.gravity]
        forces += [load.force for load in scene.distributed if isinstance(load, DistributedForce)]
        load = jnp.asarray(BENDING, self.field.s.dtype)
        for force in forces:
            load += jnp.sqrt(1.0 + jnp.sum(force**2))
        radius = self.radius
        return self.softening * load / (PENETRATION * radius[jnp.argmin(radius)])

    def depths(self, positions: Float[Array, "n+1 3"]) -> Float[Array, "obstacles n+1"]:
        """How far the rod is within each obstacle, at the nodes that are free to move; 0 outside."""
        return jnp.stack([self._depths(obstacle, positions) for obstacle in self.scene.obstacles])

    def _depths(self, obstacle: Obstacle, positions: Float[Array, "n+1 3"]) -> Float[Array, "n+1"]:
        depths = self.radius - jax.vmap(obstacle.at)(positions)
        return jnp.where((depths > 0) & ~self.is_held, depths, 0.0)

    def depths_at(self, positions: Float[Array, "k 3"], radius: Float[Array, "k"]) -> Float[Array, "k"]:
        """How far the rod is within the nearest obstacle at places, by its radius there; 0 outside."""
        distances = jnp.stack([jax.vmap(obstacle.at)(positions) for obstacle in self.scene.obstacles])
        return jnp.maximum(1 - jnp.min(distances, axis=0) / radius, 0.0)

    def accepts(self, point: Any, trial: Any, is_better: Bool[Array, ""]) -> Bool[Array, ""]:
        """Only where all places go straight from one to the other without getting too deep into an obstacle."""
        before, after = self._looked_at(point), self._looked_at(trial)
        ways = after - before
        lengths = jnp.sqrt(jnp.sum(ways**2, axis=1))
        radius = self.radius
        rim = jnp.append(radius, jnp.repeat(radius[self.held_places[1][1:]], BETWEEN))

        def distances(positions: Float[Array, "k 3"]) -> Float[Array, "k"]:
            return least(*(jax.vmap(obstacle.at)(positions) for obstacle in self.scene.obstacles))

        first = distances(before)
        bound = least(DEEPEST * rim, first - DEEPER * rim)

        # No place is nearer than its distance: so far each may go, and is looked at again.
        def ahead(gone: Float[Array, "k"], gaps: Float[Array, "k"]) -> Float[Array, "k"]:
            return gone + jnp.maximum(gaps, LEAST_WAY * rim)

        def looked(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            gone, _, count = state
            parts = jnp.minimum(gone / jnp.where(lengths > 0, lengths, 1.0), 1.0)
            gaps = distances(before + parts[:, None] * ways) - bound
            return ahead(gone, gaps), jnp.any(gaps < 0), count + 1

        def goes_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
            gone, is_blocked, count = state
            return is_better & jnp.any(gone < lengths) & ~is_blocked & (count < MOST_LOOKS)

        begin = ahead(jnp.zeros_like(lengths), first - bound), jnp.array(False), jnp.zeros((), int)
        gone, is_blocked, _ = jax.lax.while_loop(goes_on, looked, begin)
        return is_better & ~is_blocked & jnp.all(gone >= lengths)

    def _looked_at(self, point: Any) -> Float[Array, "k 3"]:
        """The nodes, and places on what the rod lacks of the way to each held one: else it would pass there."""
        nodes = self.positions(self.edges(point))
        _, held = self.held_places
        lacking = nodes[held[1:]] - nodes[held[1:] - 1]
        parts = jnp.linspace(0.0, 1.0, BETWEEN + 2, dtype=nodes.dtype)[1:-1]
        across = nodes[held[1:] - 1][:, None] + parts[None, :, None] * lacking[:, None]
        return jnp.concatenate([nodes, across.reshape(-1, 3)])

    def places(self, nodes: Float[Array, "n+1 3"], point: Any) -> tuple[Array, Array, Array]:
        """At equal steps of arclength, as many as `passage` looks at: the centerline, the radius, and in an element
        beside a held node this, elsewhere not a number.
        """
        s = self.field.s
        x = jnp.linspace(0.0, 1.0, PLACES, dtype=s.dtype)
        points = cubic(s, nodes, self.node_slopes(point), x)
        cell = jnp.clip(jnp.searchsorted(s, x, side="right") - 1, 0, len(s) - 2)
        radius = value_at(self._radius, x, s[cell], s[cell + 1])
        beside = jnp.where(self.is_held[cell + 1][:, None], nodes[cell + 1], jnp.nan)
        return points, radius, jnp.where(self.is_held[cell][:, None], nodes[cell], beside)

    def _contact_energy(self, positions: Float[Array, "n+1 3"]) -> Float[Array, ""]:
        return self.stiffness / 2 * jnp.sum(self.depths(positions) ** 2)

    def _contacts(
        self, positions: Float[Array, "n+1 3"], forces: Float[Array, "n+1 3"]
    ) -> tuple[Float[Array, "n+1 3"], Float[Array, "n+1 3 3"]]:
        """First and second derivatives of the energy of the contacts by the positions of the nodes.

        `forces`: of the contacts, as those through the elements have them.
        """
        nothing = jnp.zeros_like(positions), jnp.zeros((*positions.shape, 3), positions.dtype)
        most = MOST_CURVING * jnp.sqrt(jnp.sum(forces**2, axis=1)) if self.is_cautious else None
        first, second = nothing
        for obstacle in self.scene.obstacles:
            # Where the rod is far from all of an obstacle, the distance is all that is computed of it.
            touches = jnp.any(self._depths(obstacle, positions) > 0)
            one, two = jax.lax.cond(
                touches, functools.partial(self._contacts_with, obstacle, most), lambda _: nothing, positions
            )
            first, second = first + one, second + two
        return first, second

    def _contacts_with(
        self, obstacle: Obstacle, most: Float[Array, "n+1"] | None, positions: Float[Array, "n+1 3"]
    ) -> tuple[Float[Array, "n+1 3"], Float[Array, "n+1 3 3"]]:
        depths = self._depths(obstacle, positions)
        normals, curvatures = jax.vmap(lambda x: (jax.grad(obstacle.at)(x), jax.hessian(obstacle.at)(x)))(positions)
        pressures = self.stiffness * depths
        curving = pressures if most is None else jnp.where(pressures > most, most, pressures)
        stiffnesses = jnp.where(depths > 0, self.stiffness, 0.0)
        second = stiffnesses[:, None, None] * normals[:, :, None] * normals[:, None]
        return -pressures[:, None] * normals, second - curving[:, None, None] * curvatures

    def _balance(
        self, edges: Float[Array, "n 3"], end_force: Float[Array, "3 n"]
    ) -> tuple[Float[Array, "n+1 3"], Float[Array, "n+1 3 3"]]:
        """What is out of balance at the nodes, and the stiffness of the contacts there."""
        pushing = self.at_nodes(end_force).T
        first, second = self._contacts(self.positions(edges), pushing)
        return jnp.where(self.is_held[:, None], 0.0, first + pushing), second

    def _gaps(self, edges: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """What the elements lack of the ways between their nodes: those before held nodes."""
        places, held = self.held_places
        sums = jnp.concatenate([jnp.zeros((1, 3), edges.dtype), jnp.cumsum(edges, axis=0)])
        missing = jnp.diff(places, axis=1).T - jnp.diff(sums[held], axis=0)
        return jnp.zeros_like(edges).at[held[1:] - 1].set(missing)

    def load_energy(self, point: Any) -> Float[Array, ""]:
        return super().load_energy(point) + self._contact_energy(self.positions(self.edges(point)))  # pyright: ignore

    def rounding_floor(self, point: Any) -> Float[Array, ""]:
        floor = super().rounding_floor(point)  # pyright: ignore
        return floor + FLOOR_SAFETY * jnp.finfo(floor.dtype).eps * self.stiffness
