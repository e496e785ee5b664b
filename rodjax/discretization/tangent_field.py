"""What a discretization in tangents hands to the mixed form."""

from typing import Protocol

import equinox as eqx
from jaxtyping import Array, Float, Int

from rodjax.model.scene import Scene


class Blocks(eqx.Module):
    """First and second derivatives of an energy by rotations of the tangents at m points along the rod.

    `gradient` and `diagonal`, the blocks (i, i) of the second derivatives: what each of n cells adds at its p points,
    to be summed by `of_points`; `lower[..., i]`: block (i + 1, i); `across[..., i]`: (2 i + 2, 2 i), between the ends
    of an element with a point in its middle.
    """

    gradient: Float[Array, "b p n"]
    diagonal: Float[Array, "b b p n"]
    lower: Float[Array, "b b m-1"]
    across: Float[Array, "b b (m-1)/2"] | None = None


class TangentField(Protocol):
    """Unit tangents at m points along the rod, and the strains, places and loads that belong to them.

    `bases` in the arguments are those of `append_prescribed`; what comes back belongs to the m points.
    """

    @property
    def s(self) -> Float[Array, "n+1"]:
        """Arclengths of the nodes: 0, ..., 1."""
        ...

    @property
    def weights(self) -> Float[Array, "m"]:
        """The length of rod that each point stands for."""
        ...

    @property
    def clip_nodes(self) -> Int[Array, "clips"] | None:
        """The numbers of the nodes at which clips hold the rod; `None` without clips."""
        ...

    @property
    def finest(self) -> Float[Array, ""]:
        """The shortest distance between points."""
        ...

    def append_prescribed(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, "3 k"]:
        """With the tangents that supports hold beyond the points."""
        ...

    def apply_prescribed(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        """With those at the points that supports hold in their place."""
        ...

    def basis(self, scene: Scene, bases: Float[Array, "3 b k"]) -> Float[Array, "3 b m"]:
        """The directions in which the tangents may turn: none where a support holds one."""
        ...

    def held(self, scene: Scene, diagonal: Float[Array, "b b m"]) -> Float[Array, "b b m"]:
        """With a unit block for each tangent that does not turn."""
        ...

    def bending_energy(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, ""]: ...

    def bending(
        self, scene: Scene, tangents: Float[Array, "3 m"], bases: Float[Array, "3 b k"]
    ) -> tuple[Float[Array, ""], Blocks]:
        """The bending energy and its derivatives by rotations of the tangents."""
        ...

    def twist(self, scene: Scene, tangents: Float[Array, "3 m"], bases: Float[Array, "3 b k"]) -> Blocks:
        """Derivatives of the total twist by rotations of the tangents."""
        ...

    def swept(self, scene: Scene, old: Float[Array, "3 m"], new: Float[Array, "3 m"]) -> Float[Array, ""]:
        """What the total twist gains as the tangents move while the end frames follow by smallest rotations [rad]."""
        ...

    def principal_twist(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, ""]:
        """The total twist between two clamps [rad], up to whole turns."""
        ...

    @property
    def quadrature_weights(self) -> Float[Array, "p n"]:
        """The length of rod that each of the p points of a cell stands for; a cell lies between two nodes."""
        ...

    def tangents_in_clips(self, scene: Scene, tangents: Float[Array, "3 m"]) -> Float[Array, "3 clips"]: ...

    def gather(self, by_point: Float[Array, "*c m"]) -> Float[Array, "*c p n"]:
        """What belongs to the points of each cell."""
        ...

    def scatter_add(self, by_side: Float[Array, "*c p n"]) -> Float[Array, "*c m"]:
        """Sums over the cells at each point."""
        ...

    def loads_beyond(self, scene: Scene) -> Float[Array, "3 p n"]:
        """What the loads beyond the points of each cell exert, on its side of a point force at a node; where the start
        is free, less all of them.
        """
        ...

    def residual(self, scene: Scene, gradient: Float[Array, "3 m"], lengths: Float[Array, "m"]) -> Float[Array, ""]:
        """The largest force [EI/L^2] that a gradient of the energy by rotations leaves."""
        ...
