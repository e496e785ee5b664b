"""The minimum of the model of a rod (`unilateral`) with a few further unknowns, such as arclengths of sliding clips.

The gaps depend on these too. A solution is one factorisation of the rod, with the contacts closed that are so at the
last iterate, and a column for each further unknown (`bordered`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.linalg.bordered import BorderedSystem, Vectors
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.unilateral import ModelMinimum, OfChain, Unilateral, sought, with_exerted, work
from rodjax.programs.stacks import of_each

Motion = tuple[Array, Array, Array]


class _OfBorder(eqx.Module):
    """The model of `minimized_with_border`, whose motions are x, y and z; `chain`: the model with z = 0."""

    border: BorderedSystem
    g: Float[Array, "j"]
    gap_rates: Float[Array, "j r n+1"]
    chain: OfChain

    def _columns(self, is_closed: Bool[Array, "r n+1"]) -> Vectors:
        """What z does to the other rows; the rows of closed contacts are their gaps, with a minus."""

        def of_y(column: Float[Array, "k"], rates: Float[Array, "r n+1"]) -> Float[Array, "k"]:
            first, _, nodes, elements = self.chain.system.split(column)
            parts = first, jnp.where(is_closed, -rates, 0.0), nodes, elements
            return jnp.concatenate([part.reshape(-1) for part in parts])

        return Vectors(self.border.columns.x, of_each(of_y)(self.border.columns.y, self.gap_rates))

    def solved(
        self,
        is_closed: Bool[Array, "r n+1"],
        trial: Float[Array, "r n+1"],
        contact_compliance: Float[Array, ""],
        memory: None,
    ) -> tuple[Bool[Array, ""], Motion, None]:
        chain, f, c = self.chain.factored(is_closed, trial, contact_compliance)
        columns = self._columns(is_closed)
        sides = (jnp.concatenate([part, last[None]]) for part, last in zip(columns, (f, c), strict=True))
        x, y = jax.vmap(chain.solve_softly)(*sides)
        factors = self.border.factored(chain, Vectors(x[:-1], y[:-1]))
        x, y = factors.joined(x[-1], y[-1], self.g)
        z, y = self.border.split(y)
        return chain.is_minimum & factors.goes_down(z), (x, y, z), None

    def opening(self, motion: Motion) -> Float[Array, "r n+1"]:
        x, y, z = motion
        return self.chain.opening((x, y)) + jnp.tensordot(z, self.gap_rates, 1)

    def along(self, motion: Motion, change: Motion, memory: None) -> tuple[Float[Array, ""], Float[Array, ""]]:
        ahead, here, system = self._times(change), self._times(motion), self.chain.system

        def works(motion: Motion, by: Motion) -> Float[Array, ""]:
            return work(system, motion[:2], by[:2]) + jnp.sum(motion[2] * by[2])

        x, y, z = change
        slope = (works(motion, ahead) + works(change, here)) / 2
        slope -= jnp.sum(self.chain.f * x) + jnp.sum(system.split(self.chain.c)[2] * system.split(y)[2])
        return slope - jnp.sum(self.g * z), works(change, ahead)

    def _times(self, motion: Motion) -> Motion:
        x, y, z = motion
        moments, rows = self.chain.system.times(x, y)
        of_x, of_y = self._columns(jnp.zeros(self.chain.contacts.gaps.shape, bool)).times(z)
        return moments + of_x, rows + of_y, self.border.rows.dots(x, y) + self.border.corner @ z


def minimized_with_border(
    border: BorderedSystem,
    g: Float[Array, "j"],
    gap_rates: Float[Array, "j r n+1"],
    system: ChainSystem,
    f: Float[Array, "b m"],
    c: Float[Array, "k"],
    contacts: Unilateral,
) -> ModelMinimum:
    """As `minimized`, which has the last four arguments. `g`: the right side of the further unknowns z; `gap_rates`:
    the derivatives of the gaps by z. In the result z stands before the other multipliers.
    """
    contact_compliance = system.contacts.contact_compliance
    open_system = system.closed_where(jnp.zeros(contacts.gaps.shape, bool))
    model = _OfBorder(border, g, gap_rates, OfChain(open_system, f, c, contacts))
    nowhere = jnp.zeros_like(f), jnp.zeros_like(c), jnp.zeros_like(g)
    end = sought(model, contacts, system.contacts.is_closed, contact_compliance, nowhere)
    x, y, z = end.motion
    trial = end.exerted(contacts, model.opening(end.motion), contact_compliance)
    y = jnp.concatenate([z, with_exerted(system, contacts, trial, y)])
    return ModelMinimum(x, y, end.is_minimum & end.is_done, end.count)
