"""Cells of a rod whose frames are unknown: the strains, segment vectors and loads of neighbouring frames.

Two kinds, as for rods whose tangents suffice: `JointCells`, the finite differences of the report, with a frame at the
middle of each edge and at both ends, of second order; and `ElementCells`, with frames at both ends and in the middle of
an element, of fourth order. Both see only rotations between neighbours, so that no parametrisation has a pole.

A cell is strained by what its strains exceed those of the stress-free rod by, where these come from the same formula
at the frames of the stress-free rod, and its segment vector is corrected by what the quadrature misses there
(`rest_correction`). So a rod at rest has no residual on any mesh.
Arrays have the components first, then the frames of a cell or its strain points, then the cells.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.checks import Numbers, namespace
from rodjax.discretization.element_bending import SIMPSON
from rodjax.discretization.element_points import interleaved, of_elements, parts_before, scatter_add
from rodjax.discretization.element_strains import ElementStrains
from rodjax.discretization.nodes import LEAST_ELEMENT, varying, with_nodes_of
from rodjax.geometry.rotations import inverse, product, unit
from rodjax.linalg.blocks import short_sum
from rodjax.mechanics.energy import Sections
from rodjax.model.along import stiffness_at, value_at
from rodjax.model.rod import Rod
from rodjax.model.scene import Scene

# The frame that turns the correction of a segment vector: of an edge its own, of an element that in the middle.
REFERENCE = 1


class Cells(Protocol):
    """m frames along a rod in n cells of p frames each; each frame of a cell is a strain point."""

    @property
    def s(self) -> Float[Array, "nodes"]:
        """Arclengths of the nodes: 0, ..., 1."""
        ...

    @property
    def clip_nodes(self) -> Int[Array, "clips"] | None:
        """The numbers of the nodes at which clips hold the rod; `None` without clips."""
        ...

    @property
    def arclengths(self) -> Float[Array, "m"]:
        """Arclengths of the frames."""
        ...

    @property
    def weights(self) -> Float[Array, "m"]:
        """The length of rod that each frame stands for."""
        ...

    @property
    def finest(self) -> Float[Array, ""]:
        """The shortest distance between frames."""
        ...

    @property
    def lengths(self) -> Float[Array, "p n"]:
        """The length of rod that each strain point stands for."""
        ...

    @property
    def strain_arclengths(self) -> Float[Array, "p n"]:
        """Arclengths of the strain points."""
        ...

    def gather(self, by_frame: Float[Array, "c m"]) -> Float[Array, "c p n"]: ...

    def at_nodes(self, quaternions: Float[Array, "4 m"]) -> Float[Array, "4 nodes"]:
        """The frames at the nodes."""
        ...

    def scatter_add(self, by_cell: Float[Array, "... p n"]) -> Float[Array, "... m"]:
        """Sums over the cells at each frame."""
        ...

    # The components of what is `seen` on which strains depend.
    coordinates: ClassVar[slice]

    def seen(self, quaternions: Float[Array, "4 p n"]) -> Float[Array, "4 p-1 n"]:
        """The other frames of each cell seen from that of its reference."""
        ...

    def strains(self, seen: Float[Array, "c p-1 n"]) -> "Strains":
        """By the coordinates of each other frame."""
        ...

    def segment_vectors(
        self, by_strain: Float[Array, "3 p n"], rest: Float[Array, "3 n"]
    ) -> Float[Array, "3 segments"]:
        """From node to node: the sum of weighted slopes at the strain points and of the correction of each cell."""
        ...

    def rest_of(self, by_segment: Float[Array, "3 segments"]) -> Float[Array, "3 n"]:
        """The corrections of segment vectors as those of the cells."""
        ...

    def of_segments(self, by_segment: Float[Array, "segments"]) -> Float[Array, "p n"]:
        """At each strain point what is given for the segment to which it belongs; zero without such."""
        ...

    def sections(self, rod: Rod) -> Sections:
        """What resists at the strain points."""
        ...

    def parts_before(self, at: Float[Array, ""]) -> Float[Array, "p n"]:
        """How much of the length of each strain point lies before an arclength."""
        ...

    def couplings(self, blocks: Float[Array, "p 3 p 3 n"]) -> tuple[Array, Array, Array | None]:
        """The blocks (b, b, ...) on the diagonal, between neighbours, and between ends of elements."""
        ...


class Strains(Protocol):
    """Curvature along d1 and d2, and twist, at the strain points."""

    @property
    def values(self) -> Float[Array, "3 p n"]: ...

    @property
    def jacobian(self) -> Float[Array, "3 p c q n"]:
        """By the coordinates of the q other frames: [i, k, j, e] of component i at point k by j of frame e."""
        ...

    def curving(self, moments: Float[Array, "3 p n"]) -> Float[Array, "q c q c n"]:
        """Second derivatives by the coordinates, times moments at the points: [e, i, f, j]."""
        ...


class JointStrains(NamedTuple):
    """Of the rotation between two frames, a swing by the angle a and half of a spin before and after it, 2 tan(a/2) and
    the spin: alone the curvature of `strain.squared_curvature_between`, and a twist that adds up.
    """

    seen: Float[Array, "4 1 n"]
    spacing: Float[Array, "n"]

    @property
    def values(self) -> Float[Array, "3 2 n"]:
        return self._at(self.seen[:, 0])

    def _at(self, seen: Float[Array, "4 n"]) -> Float[Array, "3 2 n"]:
        w, x, y, z = seen
        swing = -2 / (jnp.sqrt(w * w + z * z) * self.spacing)
        strain = jnp.stack([swing * x, swing * y, -2 * jnp.arctan2(z, w) / self.spacing])
        return jnp.stack([strain, strain], axis=1)

    @property
    def jacobian(self) -> Float[Array, "3 2 4 1 n"]:
        return jnp.moveaxis(self._by_each(self._at), 0, 2)[:, :, :, None]

    def curving(self, moments: Float[Array, "3 2 n"]) -> Float[Array, "1 4 1 4 n"]:
        def slopes(seen: Float[Array, "4 n"]) -> Float[Array, "4 n"]:
            return jax.grad(lambda seen: jnp.sum(moments * self._at(seen)))(seen)

        return self._by_each(slopes)[None, :, None]

    def _by_each(self, function: Callable[[Float[Array, "4 n"]], Array]) -> Array:
        """The derivatives by each coordinate, changed in all cells at once."""
        here = self.seen[:, 0]
        directions = jnp.eye(4, dtype=here.dtype)[..., None] * jnp.ones_like(here)[None]
        return jax.vmap(lambda direction: jax.jvp(function, (here,), (direction,))[1])(directions)


class JointCells(eqx.Module):
    """n equal edges, n + 2 frames: of the start, of the edges and of the end; cells are the joints between them."""

    s: Float[Array, "n+1"]
    coordinates: ClassVar[slice] = slice(0, 4)

    @property
    def clip_nodes(self) -> None:
        return None

    @property
    def segments(self) -> int:
        return len(self.s) - 1

    @property
    def arclengths(self) -> Float[Array, "n+2"]:
        return jnp.concatenate([self.s[:1], (self.s[:-1] + self.s[1:]) / 2, self.s[-1:]])

    @property
    def finest(self) -> Float[Array, ""]:
        return 1 / jnp.asarray(self.segments, self.s.dtype)

    @property
    def spacing(self) -> Float[Array, "n+1"]:
        return jnp.diff(self.arclengths)

    @property
    def lengths(self) -> Float[Array, "2 n+1"]:
        half = jnp.diff(self.s) / 2
        none = jnp.zeros_like(half[:1])
        return jnp.stack([jnp.concatenate([none, half]), jnp.concatenate([half, none])])

    @property
    def weights(self) -> Float[Array, "n+2"]:
        half = self.spacing / 2
        none = jnp.zeros_like(half[:1])
        return jnp.concatenate([half, none]) + jnp.concatenate([none, half])

    @property
    def strain_arclengths(self) -> Float[Array, "2 n+1"]:
        return jnp.stack([self.arclengths[:-1], self.arclengths[1:]])

    def gather(self, by_frame: Float[Array, "c m"]) -> Float[Array, "c 2 n"]:
        return jnp.stack([by_frame[:, :-1], by_frame[:, 1:]], axis=1)

    def at_nodes(self, quaternions: Float[Array, "4 n+2"]) -> Float[Array, "4 n+1"]:
        """Half way between those of the edges beside."""
        between = unit(quaternions[:, 1:-2] + quaternions[:, 2:-1])
        return jnp.concatenate([quaternions[:, :1], between, quaternions[:, -1:]], axis=1)

    def scatter_add(self, by_cell: Float[Array, "... 2 n"]) -> Float[Array, "... m"]:
        none = jnp.zeros_like(by_cell[..., 0, :1])
        before, after = by_cell[..., 0, :], by_cell[..., 1, :]
        return jnp.concatenate([before, none], axis=-1) + jnp.concatenate([none, after], axis=-1)

    def seen(self, quaternions: Float[Array, "4 2 n"]) -> Float[Array, "4 1 n"]:
        return product(inverse(quaternions[:, 1]), quaternions[:, 0])[:, None]

    def strains(self, seen: Float[Array, "4 1 n"]) -> "JointStrains":
        return JointStrains(seen, self.spacing)

    def segment_vectors(
        self, by_strain: Float[Array, "3 2 n"], rest: Float[Array, "3 n"]
    ) -> Float[Array, "3 segments"]:
        return by_strain[:, 1, :-1] + by_strain[:, 0, 1:] + rest[:, :-1]

    def rest_of(self, by_segment: Float[Array, "3 segments"]) -> Float[Array, "3 n"]:
        return jnp.pad(by_segment, ((0, 0), (0, 1)))

    def of_segments(self, by_segment: Float[Array, "segments"]) -> Float[Array, "2 n"]:
        return jnp.stack([jnp.pad(by_segment, (1, 0)), jnp.pad(by_segment, (0, 1))])

    def sections(self, rod: Rod) -> Sections:
        a, b = self.arclengths[:-1], self.arclengths[1:]
        *of_joints, of_edges = rod.stiffnesses
        joints = [stiffness_at(value, (a + b) / 2, a, b) for value in of_joints]
        # The strain of an edge is one, in both of its joints.
        a, b = self.s[:-1], self.s[1:]
        middles = (a + b) / 2

        def of_both(edges: Float[Array, "n"]) -> Float[Array, "2 n+1"]:
            return jnp.stack([jnp.concatenate([edges[:1], edges]), jnp.concatenate([edges, edges[-1:]])])

        EA = of_both(stiffness_at(of_edges, middles, a, b))
        EI1, EI2, GJ = (jnp.stack([joint, joint]) for joint in joints)
        pair, strain = rod.shear_pair, rod.rest_strain
        GA = None if pair is None else jnp.stack([of_both(stiffness_at(value, middles, a, b)) for value in pair])
        rest_axial = None if strain is None else of_both(value_at(strain, middles, a, b))
        return Sections(jnp.stack([EI1, EI2]), GJ, EA, self.strain_arclengths, rod.law, GA, rest_axial)

    def parts_before(self, at: Float[Array, ""]) -> Float[Array, "2 n+1"]:
        of_edges = jnp.clip((at - self.s[:-1]) / jnp.diff(self.s), 0.0, 1.0)
        none = jnp.zeros_like(of_edges[:1])
        return jnp.stack([jnp.concatenate([none, of_edges]), jnp.concatenate([of_edges, none])])

    def couplings(self, blocks: Float[Array, "2 3 2 3 n"]) -> tuple[Array, Array, None]:
        diagonal = self.scatter_add(jnp.stack([blocks[0, :, 0], blocks[1, :, 1]], axis=-2))
        return diagonal, blocks[1, :, 0], None


class ElementCells(eqx.Module):
    """n elements between nodes at the arclengths `s`; frames at nodes and middles in turn.

    Seen from its middle, the frame in an element turns by the rotation vector v(s), a parabola through those of both
    ends: helices are exact. The strains at the three points enter with Simpson's weights. As in `hermite`, the length
    of v is the angle as far as its tenth power, and beyond grows without bound as this approaches pi.
    `clip_nodes`: the numbers of the nodes at which clips hold the rod, where there are clips.
    """

    s: Float[Array, "n+1"]
    clip_nodes: Int[Array, "clips"] | None = None
    coordinates: ClassVar[slice] = slice(1, 4)  # of less than half a turn

    @staticmethod
    def of(scene: Scene, s: Float[Array, "n+1"]) -> "ElementCells":
        """On these nodes, moved so that one lies at each clip, each point force and each jump of the rod."""
        return ElementCells(*with_nodes_of(scene, s))

    @property
    def h(self) -> Float[Array, "n"]:
        return jnp.diff(self.s)

    @property
    def arclengths(self) -> Float[Array, "m"]:
        return interleaved(self.s, (self.s[:-1] + self.s[1:]) / 2)

    @property
    def finest(self) -> Float[Array, ""]:
        return jnp.min(self.h) / 2

    @property
    def lengths(self) -> Float[Array, "3 n"]:
        return jnp.array(SIMPSON, self.s.dtype)[:, None] * self.h[None]

    @property
    def weights(self) -> Float[Array, "m"]:
        return self.scatter_add(self.lengths)

    @property
    def strain_arclengths(self) -> Float[Array, "3 n"]:
        return jnp.stack([self.s[:-1], (self.s[:-1] + self.s[1:]) / 2, self.s[1:]])

    def gather(self, by_frame: Float[Array, "c m"]) -> Float[Array, "c 3 n"]:
        return jnp.stack(of_elements(by_frame), axis=1)

    def at_nodes(self, quaternions: Float[Array, "4 m"]) -> Float[Array, "4 n+1"]:
        return quaternions[:, ::2]

    def scatter_add(self, by_cell: Float[Array, "... 3 n"]) -> Float[Array, "... m"]:
        return scatter_add(*(by_cell[..., k, :] for k in range(3)))

    def seen(self, quaternions: Float[Array, "4 3 n"]) -> Float[Array, "4 2 n"]:
        middle = inverse(quaternions[:, 1])
        seen = jnp.stack([product(middle, quaternions[:, 0]), product(middle, quaternions[:, 2])], axis=1)
        return jnp.where(seen[:1] < 0, -seen, seen)

    def strains(self, seen: Float[Array, "3 2 n"]) -> ElementStrains:
        return ElementStrains(seen, self.h)

    def segment_vectors(self, by_strain: Float[Array, "3 3 n"], rest: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        return short_sum(by_strain, axis=1) + rest

    def rest_of(self, by_segment: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        return by_segment

    def of_segments(self, by_segment: Float[Array, "n"]) -> Float[Array, "3 n"]:
        return jnp.stack([by_segment] * 3)

    def sections(self, rod: Rod) -> Sections:
        s = self.strain_arclengths
        a, b = (jnp.broadcast_to(end[None], s.shape) for end in (self.s[:-1], self.s[1:]))
        EI1, EI2, GJ, EA = (stiffness_at(value, s, a, b) for value in rod.stiffnesses)
        GA = None if rod.shear_pair is None else jnp.stack([stiffness_at(value, s, a, b) for value in rod.shear_pair])
        rest_axial = None if rod.rest_strain is None else value_at(rod.rest_strain, s, a, b)
        return Sections(jnp.stack([EI1, EI2]), GJ, EA, s, rod.law, GA, rest_axial)

    def parts_before(self, at: Float[Array, ""]) -> Float[Array, "3 n"]:
        return parts_before(self.s, at)

    def couplings(self, blocks: Float[Array, "3 3 3 3 n"]) -> tuple[Array, Array, Array]:
        diagonal = self.scatter_add(jnp.stack([blocks[k, :, k] for k in range(3)], axis=-2))
        between = jnp.stack([blocks[1, :, 0], blocks[2, :, 1]], axis=-1)
        return diagonal, between.reshape(*between.shape[:2], -1), blocks[2, :, 0]


def segments_for_jumps(scene: Scene) -> tuple[Float[Numbers, "..."], Float[Numbers, "..."]] | None:
    """The fewest elements of a mesh that has a node at each jump of a rod, a whole number, and how near to another
    place with a node such a jump lies, as a part of the length; `None` where nothing jumps. Also of stacked scenes.
    """
    jumps = varying(scene)
    if not jumps:
        return None
    xp = namespace(scene)
    length = xp.asarray(scene.rod.length)[..., None]
    others = [xp.asarray(held.at)[..., None] for held in (*scene.clips, *scene.point_forces)]
    jumps = xp.concatenate([xp.asarray(steps) for steps in jumps], axis=-1) / length
    arclengths = xp.concatenate(
        [xp.zeros_like(length), xp.ones_like(length), *(at / length for at in others), jumps], -1
    )
    is_apart = xp.diff(xp.sort(arclengths, axis=-1), axis=-1) > SAME_PLACE
    spans = xp.sum(is_apart.astype(arclengths.dtype), axis=-1)
    gaps = xp.abs(jumps[..., :, None] - arclengths[..., None, :])
    gap = xp.min(xp.where(gaps > SAME_PLACE, gaps, 1.0), axis=(-2, -1))
    return xp.maximum(spans, xp.ceil(LEAST_ELEMENT / gap * (1 + 1e-9))), gap


# Arclengths that differ by less, as parts of the length, are the same but for rounding.
SAME_PLACE = 1e-12


def strains_between(cells: Cells, quaternions: Float[Array, "4 m"]) -> Float[Array, "3 p n"]:
    """Curvature along d1 and d2, and twist, at the strain points of cells between these frames."""
    return cells.strains(cells.seen(cells.gather(quaternions))[cells.coordinates]).values
