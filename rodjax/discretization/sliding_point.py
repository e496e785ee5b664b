"""The unknowns of a rod that slides through clips, and its linearisation: those of a form, and arclengths of clips."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import Linearization
from rodjax.discretization.nodal_point import Nodal
from rodjax.linalg.bordered import BorderedSystem


class SlidingPoint(eqx.Module):
    """The unknowns of the form at fixed arclengths (`inner`), and the arclengths of the sliding clips.

    `slides`: whether the next step changes the arclengths; `excess`: dW/ds + R . t where the last step began, an error
    of the mesh.
    """

    inner: Any
    arclengths: Float[Array, "j"]
    slides: Bool[Array, ""]
    excess: Float[Array, "j"]

    @staticmethod
    def settled_at(point: Any, arclengths: Float[Array, "j"]) -> "SlidingPoint":
        """The point of an equilibrium at these arclengths."""
        return SlidingPoint(point, arclengths, jnp.array(True), jnp.zeros_like(arclengths))

    def excess_at(self, arclengths: Float[Array, "j"]) -> Float[Array, ""]:
        """What the mesh adds to the energy from the arclengths of this point to others."""
        return jnp.sum(self.excess * (arclengths - self.arclengths))

    @property
    def tangents(self) -> Float[Array, "3 m"]:
        return self.inner.tangents

    @property
    def end_force(self) -> Float[Array, "3 parts"]:
        return self.inner.end_force

    @property
    def total_twist(self) -> Float[Array, ""]:
        return self.inner.total_twist

    @property
    def nodal(self) -> Nodal | None:
        return self.inner.nodal


class SlidingChange(NamedTuple):
    """The change of a step; `others`: that of the form at fixed arclengths."""

    arclengths: Float[Array, "j"]
    others: Any

    @property
    def displacements(self) -> Float[Array, "n+1 3"]:
        """Of the nodes, where these have positions of their own."""
        return self.others.displacements


class SlidingLinearization(Linearization):
    """A linearisation with the arclengths, whether a step changes them, and dW/ds + R . t (`excess`); `gap_rates`: of
    all rows of contacts, by the arclengths, `None` without contacts.
    """

    arclengths: Float[Array, "j"] = eqx.field(kw_only=True)
    slides: Bool[Array, ""] = eqx.field(kw_only=True)
    excess: Float[Array, "j"] = eqx.field(kw_only=True)
    gap_rates: Float[Array, "j r n+1"] | None = eqx.field(kw_only=True)

    @property
    def at_arclengths(self) -> Linearization:
        """The linearisation of the form at fixed arclengths."""
        assert isinstance(self.system, BorderedSystem)
        constraint_residual = self.constraint_residual[len(self.arclengths) :]
        parts = (self.bases, self.gradient, constraint_residual, self.system.inner, self.energy, self.residual)
        return Linearization(*parts, self.gaps, self.reference_displacements)
