"""The report's discretization: central differences and the trapezoidal rule on nodes equally spaced in arclength.

Bending lives at the nodes, stretch on the edges between them. Where an end holds the tangent, the half cell between
the end node, whose tangent is prescribed, and the middle of the first edge has a bending energy of its own: second
order in the spacing, as measured in `docs/design.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.discretization.twist import (
    FramedTangents,
    TwistReference,
    angle_about,
    total_twist,
    transport,
    transport_along,
)
from rodjax.energy import dead_load_energy, density
from rodjax.linalg import BlockCholesky, SymmetricBlockTridiagonal, pair_blocks
from rodjax.rod import Rod
from rodjax.scene import Scene, dead_end_moment
from rodjax.strain import axial_strain, curvature
from rodjax.supports import Clamp, Directed, Free, Held, Support, Swivel
from rodjax.units import Units


class Polyline(eqx.Module):
    """Nodes and the edges between them.

    The edges are kept, not recomputed: as differences of nodes they would be off by the rounding of the positions,
    which a fine mesh turns into forces of eps N^3 EI/L^2. Kept edges leave eps N^2.
    """

    nodes: Float[Array, "n+1 3"]
    edges: Float[Array, "n 3"]

    @staticmethod
    def through(nodes: Float[Array, "n+1 3"]) -> "Polyline":
        return Polyline(nodes, jnp.diff(nodes, axis=0))

    def moved(self, displacement: Float[Array, "n+1 3"]) -> "Polyline":
        return Polyline(self.nodes + displacement, self.edges + jnp.diff(displacement, axis=0))


class Energies(eqx.Module):
    """The parts of the potential energy; absent ones are `None`."""

    bending: Float[Array, ""]
    stretching: Float[Array, ""]
    torsion: Float[Array, ""] | None
    loads: Float[Array, ""] | None

    @property
    def elastic(self) -> Float[Array, ""]:
        return self.bending + self.stretching + (0 if self.torsion is None else self.torsion)

    @property
    def total(self) -> Float[Array, ""]:
        return self.elastic + (0 if self.loads is None else self.loads)


class FiniteDifference(eqx.Module):
    """A nondimensional scene on a polyline: energy, gradient, preconditioner and results as functions of a `Polyline`.

    Displacements in the arguments and results of the public methods are those of the nodes that are free to move,
    (m, 3): the rows for held ends are left out. `reference` is the state from which the total twist is carried;
    `None` in scenes without torsion.
    """

    scene: Scene
    reference: TwistReference | None

    @staticmethod
    def begin(scene: Scene, guess: Polyline, guess_twist: Float[Array, ""]) -> tuple["FiniteDifference", Polyline]:
        """The discretized scene, and the polyline from which to seek its solution: the guess moved to the held ends.

        The total twist is, of those which the end frames allow on that polyline, the one nearest to `guess_twist`
        [rad], or that of `scene.turns`.
        """
        polyline = _moved_to_ends(guess, scene)
        return FiniteDifference(scene, _twist_reference(scene, polyline, guess_twist)), polyline

    # --- unknowns: the one place that knows which nodes move -------------------------------------------------------

    def _all_nodes(self, displacement: Float[Array, "m 3"]) -> Float[Array, "n+1 3"]:
        held = (isinstance(self.scene.start, Held), isinstance(self.scene.end, Held))
        return jnp.pad(displacement, ((int(held[0]), int(held[1])), (0, 0)))

    def _free_nodes(self, rows: Float[Array, "n+1 ..."]) -> Float[Array, "m ..."]:
        first = int(isinstance(self.scene.start, Held))
        return rows[first : len(rows) - int(isinstance(self.scene.end, Held))]

    def moved(self, polyline: Polyline, displacement: Float[Array, "m 3"]) -> Polyline:
        return polyline.moved(self._all_nodes(displacement))

    def reference_at(self, polyline: Polyline) -> TwistReference | None:
        """This polyline as the reference of the total twist: no tangent may turn by pi from it."""
        if self.reference is None:
            return None
        return TwistReference(_framed_tangents(self.scene, polyline), self.total_twist(polyline))

    def with_reference(self, reference: TwistReference | None) -> "FiniteDifference":
        return FiniteDifference(self.scene, reference)

    # --- energy ----------------------------------------------------------------------------------------------------

    def energies(self, polyline: Polyline) -> Energies:
        h = 1 / len(polyline.edges)
        rod = self.scene.rod
        dphi = polyline.edges / h
        tangents, spacing = _with_end_tangents(self.scene, jax.vmap(_unit)(dphi))
        bending = jax.vmap(_joint_energy, in_axes=(None, 0, 0, 0))(rod, tangents[:-1], tangents[1:], spacing)
        stretching = h * jax.vmap(lambda dphi: density(rod, axial_strain=axial_strain(dphi)))(dphi)
        torsion = None
        if self.reference is not None:
            torsion = density(rod, twist=self.total_twist(polyline))
        return Energies(jnp.sum(bending), jnp.sum(stretching), torsion, self._load_energy(polyline))

    def _load_energy(self, polyline: Polyline) -> Float[Array, ""] | None:
        scene = self.scene
        nodes = polyline.nodes
        terms = []
        if scene.gravity is not None:
            weights = _trapezoidal_weights(len(nodes), nodes.dtype)
            terms.append(dead_load_energy(scene.gravity, weights @ nodes))
        for load in scene.point_forces:
            terms.append(dead_load_energy(load.force, _position_on(nodes, load.at)))
        for end, node in ((scene.start, nodes[0]), (scene.end, nodes[-1])):
            if isinstance(end, Free) and end.force is not None:
                terms.append(dead_load_energy(end.force, node))
        return sum(terms[1:], terms[0]) if terms else None

    def total_twist(self, polyline: Polyline) -> Float[Array, ""]:
        """Total twist [rad]: fixed by two clamps, or in equilibrium with a dead moment; zero where an end can spin."""
        moment = dead_end_moment(self.scene)
        if self.reference is not None:
            return total_twist(self.reference, _framed_tangents(self.scene, polyline))
        if moment is not None:
            return _end_torque(self.scene, moment, polyline) / self.scene.rod.GJ
        return jnp.zeros((), polyline.nodes.dtype)

    def energy_of_origin(self, units: Units) -> Float[Array, ""]:
        """Potential energy [J] of all dead forces at the origin of the nondimensional scene."""
        scene = self.scene
        forces = [load.force for load in scene.point_forces]
        forces += [end.force for end in (scene.start, scene.end) if isinstance(end, Free) and end.force is not None]
        if scene.gravity is not None:
            forces.append(scene.gravity)
        energy = sum((dead_load_energy(force, units.origin) for force in forces), jnp.zeros_like(units.length))
        return energy * units.force

    def elastic_energy(self, polyline: Polyline) -> Float[Array, ""]:
        """Energy stored in the rod, with the torsion under a dead moment, which no frame prescribes."""
        elastic = self.energies(polyline).elastic
        if dead_end_moment(self.scene) is not None:
            elastic += density(self.scene.rod, twist=self.total_twist(polyline))
        return elastic

    # --- gradient --------------------------------------------------------------------------------------------------

    @property
    def has_potential(self) -> bool:
        """Whether the loads have a potential, so that equilibria are stationary points of an energy."""
        return dead_end_moment(self.scene) is None

    def energy_from(self, polyline: Polyline, moved: Polyline, energy: Float[Array, ""]) -> Float[Array, ""]:
        """The energy after a motion, `energy`, less the work of loads without a potential on the way, to second order.

        By this a step is judged; without a dead moment it is the energy.
        """
        return energy - self._virtual_work(polyline, moved, self.scene)

    def energy_and_gradient(self, polyline: Polyline) -> tuple[Float[Array, ""], Float[Array, "m 3"]]:
        """Potential energy, and the gradient of energy less virtual work by the displacements."""

        def potential(displacement):
            moved = self.moved(polyline, displacement)
            energy = self.energies(moved).total
            return energy - self._virtual_work(polyline, moved, self.scene), energy

        gradient, energy = jax.grad(potential, has_aux=True)(self.no_displacement(polyline))
        return energy, gradient

    def _virtual_work(self, polyline: Polyline, moved: Polyline, turned: Scene) -> Float[Array, ""] | float:
        """Work of a dead end moment M on a small motion: M . (rotation of the end), its derivative exact at no motion.

        The end tangent turns by t x dt, and the end section spins about it by as much as keeps the torque M . t.
        `turned` is the scene with its ends in the moved position.
        """
        moment = dead_end_moment(self.scene)
        if moment is None:
            return 0.0
        edge = 0 if isinstance(self.scene.start, Free) else -1
        tangent, moved_tangent = (_unit(p.edges[edge]) for p in (polyline, moved))
        reference = TwistReference(_framed_tangents(self.scene, polyline), jnp.zeros_like(tangent[0]))
        twist_change = total_twist(reference, _framed_tangents(turned, moved))
        torque = _end_torque(self.scene, moment, polyline)
        return jnp.sum(moment * jnp.cross(tangent, moved_tangent)) - torque * twist_change

    def rounding_floor(self, polyline: Polyline) -> Float[Array, ""]:
        """Gradient [EI/L^2] that rounding alone leaves at an equilibrium of this mesh, see `docs/design.md`."""
        n = len(polyline.edges)
        eps = jnp.finfo(polyline.edges.dtype).eps
        return FLOOR_SAFETY * eps * (self.scene.rod.EA + 4.0 * n**2)

    def no_displacement(self, polyline: Polyline) -> Float[Array, "m 3"]:
        return jnp.zeros_like(self._free_nodes(polyline.nodes))

    def largest_step(self, displacement: Float[Array, "m 3"]) -> Float[Array, ""]:
        """The multiple of a displacement that changes no edge by more than half of its length."""
        changes = jnp.diff(self._all_nodes(displacement), axis=0)
        largest = jnp.sqrt(jnp.max(jnp.sum(changes**2, axis=1)))
        return 0.5 / len(changes) / jnp.maximum(largest, jnp.finfo(largest.dtype).tiny)

    # --- preconditioner --------------------------------------------------------------------------------------------

    def gauss_newton(self, polyline: Polyline) -> SymmetricBlockTridiagonal:
        """The Gauss-Newton Hessian of bending and stretch: positive definite, block-banded, nodes taken in pairs.

        Torsion is left out: it would add a full matrix of rank one.
        """
        scene = self.scene
        h = 1 / len(polyline.edges)
        dphi = polyline.edges / h
        points, spacing = _with_end_tangents(scene, dphi)
        bending = jax.vmap(_joint_stiffness, in_axes=(None, 0, 0, 0))(scene.rod, points[:-1], points[1:], spacing)
        stretching = h * jax.vmap(_stretch_stiffness, in_axes=(None, 0))(scene.rod, dphi)
        # By the edges: joint k couples points k and k + 1, of which the prescribed end tangents do not vary.
        zero = jnp.zeros((1, 3, 3), dphi.dtype)
        by_point = jnp.concatenate([bending[:, :3, :3], zero]) + jnp.concatenate([zero, bending[:, 3:, 3:]])
        first, n = int(isinstance(scene.start, Directed)), len(dphi)
        diagonal = (by_point[first : first + n] + stretching) / h**2
        lower = bending[first : first + n - 1, 3:, :3] / h**2
        # By the nodes: edge i is node i + 1 less node i.
        lower_before, lower_after = jnp.concatenate([zero, lower]), jnp.concatenate([lower, zero])
        below = lower_before - diagonal + lower_after
        by_node = (
            jnp.concatenate([zero, diagonal])
            + jnp.concatenate([diagonal, zero])
            - jnp.concatenate([zero, lower + jnp.swapaxes(lower, 1, 2), zero])
        )
        if not (isinstance(scene.start, Directed) or isinstance(scene.end, Directed)):
            by_node += PIN_STIFFNESS * h * jnp.eye(3, dtype=dphi.dtype)[None]
        free = self._free_nodes(by_node)
        offset = int(isinstance(scene.start, Held))
        m = len(free)
        return pair_blocks(free, below[offset : offset + m - 1], -lower[offset : offset + m - 2])

    def precondition(self, factors: BlockCholesky, gradient: Float[Array, "m 3"]) -> Float[Array, "m 3"]:
        """The displacement that the factorised `gauss_newton` gives for a gradient."""
        pairs = -(-len(gradient) // 2)
        filled = jnp.pad(gradient, ((0, 2 * pairs - len(gradient)), (0, 0)))
        return factors.solve(filled.reshape(pairs, 6)).reshape(-1, 3)[: len(gradient)]

    # --- results ---------------------------------------------------------------------------------------------------

    def resultants(self, polyline: Polyline) -> "Resultants":
        """Frames, strains and section forces at the nodes, forces and moments at the ends."""
        scene, rod = self.scene, self.scene.rod
        n = len(polyline.edges)
        h = 1 / n
        dphi = polyline.edges / h
        edge_tangents = jax.vmap(_unit)(dphi)
        (start_force, start_moment), (end_force, end_moment) = self._end_loads(polyline)

        start_tangent = _end_tangent(scene.start, edge_tangents[0], h)
        end_tangent = _end_tangent(scene.end, edge_tangents[-1], h)
        inner_tangents = jax.vmap(_unit)(edge_tangents[:-1] + edge_tangents[1:])
        tangents = jnp.concatenate([start_tangent[None], inner_tangents, end_tangent[None]])
        twist = self.total_twist(polyline)
        frames = _frames(scene, edge_tangents, tangents, twist)

        inner_curvature = jax.vmap(_joint_curvature, in_axes=(0, 0, None))(edge_tangents[:-1], edge_tangents[1:], h)
        end_curvatures = [
            _across(moment, tangent) / rod.EI
            for moment, tangent in ((start_moment, start_tangent), (end_moment, end_tangent))
        ]
        curvatures = jnp.concatenate([end_curvatures[0][None], inner_curvature, end_curvatures[1][None]])
        edge_tension = rod.EA * jax.vmap(axial_strain)(dphi)
        end_tensions = [jnp.sum(start_force * start_tangent), jnp.sum(end_force * end_tangent)]
        tension = jnp.concatenate(
            [end_tensions[0][None], (edge_tension[:-1] + edge_tension[1:]) / 2, end_tensions[1][None]]
        )
        return Resultants(
            frames=frames,
            curvature=jnp.sqrt(jnp.sum(curvatures**2, axis=1)),
            twist=jnp.full(n + 1, twist),
            total_twist=twist,
            tension=tension,
            start_force=start_force,
            start_moment=start_moment,
            end_force=end_force,
            end_moment=end_moment,
        )

    def _end_loads(self, polyline: Polyline) -> list[tuple[Float[Array, "3"], Float[Array, "3"]]]:
        """(f, m) at s = 0 and s = L: derivatives of the energy by the positions and rotations of the ends."""

        def potential(displacement, rotations):
            moved = polyline.moved(displacement)
            ends = (_rotated(self.scene.start, rotations[0]), _rotated(self.scene.end, rotations[1]))
            scene = eqx.tree_at(lambda scene: (scene.start, scene.end), self.scene, ends)
            energy = FiniteDifference(scene, self.reference).energies(moved).total
            return energy - self._virtual_work(polyline, moved, scene)

        no_rotations = jnp.zeros((2, 3), polyline.nodes.dtype)
        forces, moments = jax.grad(potential, argnums=(0, 1))(jnp.zeros_like(polyline.nodes), no_rotations)
        loads = []
        for end, node, sign in ((self.scene.start, 0, -1), (self.scene.end, -1, 1)):
            if isinstance(end, Free):
                zero = jnp.zeros(3, polyline.nodes.dtype)
                force = zero if end.force is None else end.force
                moment = zero if end.moment is None else end.moment
                loads.append((sign * force, sign * moment))
            else:
                loads.append((sign * forces[node], sign * moments[node]))
        return loads


class Resultants(eqx.Module):
    """What a solution says at its nodes and ends; names and signs as in `rodjax.Equilibrium`, nondimensional."""

    frames: Float[Array, "n+1 3 3"]
    curvature: Float[Array, "n+1"]
    twist: Float[Array, "n+1"]
    total_twist: Float[Array, ""]
    tension: Float[Array, "n+1"]
    start_force: Float[Array, "3"]
    start_moment: Float[Array, "3"]
    end_force: Float[Array, "3"]
    end_moment: Float[Array, "3"]


# Stiffness against rigid motion, in units of EI/L^3 per length, that the preconditioner adds where no end holds a
# tangent: a rod between pins can turn without bending. A hundredth of the softest bending mode, pi^4.
PIN_STIFFNESS = 1.0


# Multiple of eps (EA + 4 N^2) that is taken for the rounding floor of the gradient.
FLOOR_SAFETY = 4.0


def _moved_to_ends(guess: Polyline, scene: Scene) -> Polyline:
    """The guess moved to the held ends, by a displacement linear in s; unchanged to the last bit where it fits."""
    start, end = scene.start, scene.end
    offsets = [
        end.position - node for end, node in ((start, guess.nodes[0]), (end, guess.nodes[-1])) if isinstance(end, Held)
    ]
    at_start, at_end = offsets[0], offsets[-1]  # the same where only one end is held
    s = jnp.linspace(0.0, 1.0, len(guess.nodes), dtype=guess.nodes.dtype)[:, None]
    polyline = guess.moved((1 - s) * at_start[None] + s * at_end[None])
    nodes = polyline.nodes
    if isinstance(start, Held):
        nodes = nodes.at[0].set(start.position)
    if isinstance(end, Held):
        nodes = nodes.at[-1].set(end.position)
    return Polyline(nodes, polyline.edges)


def _with_end_tangents(scene: Scene, dphi: Float[Array, "n 3"]) -> tuple[Float[Array, "k 3"], Float[Array, "k-1"]]:
    """phi' along the edges, with the prescribed tangents before and after, and the distances between these points."""
    h = 1 / len(dphi)
    points, spacing = [dphi], [jnp.full(len(dphi) - 1, h, dphi.dtype)]
    half = jnp.full(1, h / 2, dphi.dtype)
    if isinstance(scene.start, Directed):
        points, spacing = [scene.start.tangent[None], *points], [half, *spacing]
    if isinstance(scene.end, Directed):
        points, spacing = [*points, scene.end.tangent[None]], [*spacing, half]
    return jnp.concatenate(points), jnp.concatenate(spacing)


def _joint_curvature(
    before: Float[Array, "3"], after: Float[Array, "3"], spacing: Float[Array, ""] | float
) -> Float[Array, "3"]:
    """Curvature from the unit tangents at two points, by central differences halfway between them.

    It grows beyond bounds as the tangents turn against each other. From phi' instead of t it would vanish for edges of
    different length folded upon each other, and the rod would have a way through the fold.
    """
    return curvature((before + after) / 2, (after - before) / spacing)


def _joint_energy(
    rod: Rod, before: Float[Array, "3"], after: Float[Array, "3"], spacing: Float[Array, ""]
) -> Float[Array, ""]:
    return spacing * density(rod, curvature=_joint_curvature(before, after, spacing))


def _joint_stiffness(
    rod: Rod, before: Float[Array, "3"], after: Float[Array, "3"], spacing: Float[Array, ""]
) -> Float[Array, "6 6"]:
    """Gauss-Newton Hessian of a joint's energy by phi' at the two points: J^T (d2w) J, J = d(curvature)."""

    def strain(before, after):
        return _joint_curvature(_unit(before), _unit(after), spacing)

    jacobian = jnp.concatenate(jax.jacfwd(strain, argnums=(0, 1))(before, after), axis=1)
    stiffness = jax.hessian(lambda strain: density(rod, curvature=strain))(strain(before, after))
    return spacing * jacobian.T @ stiffness @ jacobian


def _stretch_stiffness(rod: Rod, dphi: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Gauss-Newton Hessian of the stretching density by phi'."""
    jacobian = jax.grad(axial_strain)(dphi)
    stiffness = jax.hessian(lambda strain: density(rod, axial_strain=strain))(axial_strain(dphi))
    return stiffness * jacobian[:, None] * jacobian[None, :]


def _trapezoidal_weights(count: int, dtype) -> Float[Array, "n+1"]:
    weights = jnp.full(count, 1 / (count - 1), dtype)
    return weights.at[jnp.array([0, -1])].multiply(0.5)


def _position_on(nodes: Float[Array, "n+1 3"], s: Float[Array, ""]) -> Float[Array, "3"]:
    """Position at an arclength, linear between the nodes."""
    n = len(nodes) - 1
    cell = jnp.clip(jnp.floor(s * n).astype(int), 0, n - 1)
    t = s * n - cell.astype(s.dtype)
    return (1 - t) * nodes[cell] + t * nodes[cell + 1]


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    return vector / jnp.sqrt(jnp.sum(vector**2))


def _across(vector: Float[Array, "3"], axis: Float[Array, "3"]) -> Float[Array, "3"]:
    """The part of `vector` at right angles to the unit `axis`."""
    return vector - jnp.sum(vector * axis) * axis


def _rotated(end: Support, omega: Float[Array, "3"]) -> Support:
    """The support turned by a small rotation vector [rad], to first order: exact for derivatives at no rotation."""
    if isinstance(end, Clamp):
        turned = end.frame + jax.vmap(jnp.cross, in_axes=(None, 1), out_axes=1)(omega, end.frame)
        return eqx.tree_at(lambda end: end.frame, end, turned)
    if isinstance(end, Swivel):
        return eqx.tree_at(lambda end: end.tangent, end, end.tangent + jnp.cross(omega, end.tangent))
    return end


def _end_tangent(end: Support, edge_tangent: Float[Array, "3"], h: float) -> Float[Array, "3"]:
    """The tangent at an end: prescribed, or that of the edge, turned by what a dead moment bends half an edge."""
    if isinstance(end, Directed):
        return end.tangent
    if isinstance(end, Free) and end.moment is not None:
        return _unit(edge_tangent + h / 2 * jnp.cross(end.moment, edge_tangent))
    return edge_tangent


# --- torsion ---------------------------------------------------------------------------------------------------------


def _framed_tangents(scene: Scene, polyline: Polyline) -> FramedTangents:
    tangents = [jax.vmap(_unit)(polyline.edges)]
    if isinstance(scene.start, Directed):
        tangents = [scene.start.tangent[None], *tangents]
    if isinstance(scene.end, Directed):
        tangents = [*tangents, scene.end.tangent[None]]
    start_d1, end_d1 = (end.frame[:, 0] if isinstance(end, Clamp) else None for end in (scene.start, scene.end))
    return FramedTangents(jnp.concatenate(tangents), start_d1, end_d1)


def _twist_reference(scene: Scene, polyline: Polyline, guess_twist: Float[Array, ""]) -> TwistReference | None:
    state = _framed_tangents(scene, polyline)
    if state.start_d1 is None or state.end_d1 is None:
        return None
    carried = transport_along(state.start_d1, state.tangents)[-1]
    principal = angle_about(state.tangents[-1], carried, state.end_d1)
    if scene.turns is None:
        turns = jnp.round((guess_twist - principal) / (2 * jnp.pi))
    else:
        turns = scene.turns
    return TwistReference(state, principal + 2 * jnp.pi * turns)


def _end_torque(scene: Scene, moment: Float[Array, "3"], polyline: Polyline) -> Float[Array, ""]:
    """The twisting moment GJ Omega that a dead moment on the free end raises, constant along the rod."""
    if isinstance(scene.start, Free):
        return -jnp.sum(moment * _unit(polyline.edges[0]))
    return jnp.sum(moment * _unit(polyline.edges[-1]))


def _frames(
    scene: Scene,
    edge_tangents: Float[Array, "n 3"],
    tangents: Float[Array, "n+1 3"],
    twist: Float[Array, ""],
) -> Float[Array, "n+1 3 3"]:
    """Material frames at the nodes, from the end that holds the twist (or a choice where none does)."""
    n = len(edge_tangents)
    start_d1 = scene.start.frame[:, 0] if isinstance(scene.start, Clamp) else _any_normal(tangents[0])
    along_edges = transport_along(start_d1, jnp.concatenate([tangents[:1], edge_tangents]))
    # A node's tangent lies on the arc between those of its edges, so that the last node closes the chain.
    d1 = jax.vmap(transport)(along_edges[1:], edge_tangents, tangents[1:])
    d1 = jnp.concatenate([start_d1[None], d1])
    angle = twist * jnp.linspace(0.0, 1.0, n + 1, dtype=twist.dtype)
    if isinstance(scene.end, Clamp) and not isinstance(scene.start, Clamp):
        angle += angle_about(tangents[-1], d1[-1], scene.end.frame[:, 0]) - angle[-1]
    d2 = jax.vmap(jnp.cross)(tangents, d1)
    turned = jnp.cos(angle)[:, None] * d1 + jnp.sin(angle)[:, None] * d2
    return jnp.stack([turned, jax.vmap(jnp.cross)(tangents, turned), tangents], axis=-1)


def _any_normal(tangent: Float[Array, "3"]) -> Float[Array, "3"]:
    axis = jnp.eye(3, dtype=tangent.dtype)[jnp.argmin(jnp.abs(tangent))]
    return _unit(jnp.cross(tangent, axis))
