"""The minimum of a quadratic model of a rod whose gaps may only close: which contacts of a `ChainSystem` are closed.

With v the motion of the nodes, a contact of the pressure p0 and the gap g has in the model the pressure

    p(v) = max(0, p0 - (g + N^T v)/softness)

and the energy softness p(v)^2/2, so that the model is convex where its stiffness is positive, and piecewise quadratic. Each
step of a semismooth Newton method is one factorisation, with the contacts closed that are so at the last iterate, and a
line search on the model itself, so that it cannot cycle. It ends where a whole step closes and opens no contact.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.chain import ChainSystem, factor_chain

# The most factorisations, and the parts of a step that the line search looks at.
MOST_FACTORS = 40
PARTS = 0.5 ** np.arange(12)


class Unilateral(eqx.Module):
    """Gaps and pressures of the contact points, k at a place."""

    gaps: Float[Array, "k p"]
    pressures: Float[Array, "k p"]

    def closed(self, softness: Float[Array, ""]) -> Bool[Array, "k p"]:
        """Which contacts push where nothing has moved yet."""
        return self.pressures * softness > self.gaps


class ModelMinimum(eqx.Module):
    """Motion and multipliers, as of `ChainFactors.solve`; whether the stiffness was positive with the contacts closed
    that are so in the end; factorisations.
    """

    x: Float[Array, "b m"]
    y: Float[Array, "j"]
    is_minimum: Bool[Array, ""]
    count: Int[Array, ""]


class _State(eqx.Module):
    x: Float[Array, "b m"]
    y: Float[Array, "j"]
    is_closed: Bool[Array, "k p"]
    is_minimum: Bool[Array, ""]
    is_done: Bool[Array, ""]
    count: Int[Array, ""]


def minimized(system: ChainSystem, f: Float[Array, "b m"], c: Float[Array, "j"], contacts: Unilateral) -> ModelMinimum:
    """From right sides f and c without what the pressures do: forces on the rotations, gaps of the elements, forces on
    the nodes. The pressures in the result are what they change by.
    """
    softness, shape = system.contacts.softness, contacts.gaps.shape
    nothing_closed = jnp.zeros(shape, bool)
    open_system = system.closed_where(nothing_closed)
    of_border, _, of_nodes, of_elements = open_system.parted(c)

    def solved(is_closed: Bool[Array, "k p"]):
        here = system.closed_where(is_closed)
        pushed = here.contacts.pushed(jnp.where(is_closed, contacts.pressures, 0.0))
        b = len(f)
        by_contacts = jnp.where(is_closed, contacts.gaps, contacts.pressures)
        nodes = of_nodes + jnp.where(here.held[:, None], 0.0, pushed[:, b:])
        right = [part.reshape(-1) for part in (of_border, by_contacts, nodes, of_elements)]
        factors = factor_chain(here)
        return factors.is_minimum, *factors.solve(f.at[:, ::2].add(pushed[:, :b].T), jnp.concatenate(right))

    def opening(x: Float[Array, "b m"], y: Float[Array, "j"]) -> Float[Array, "k p"]:
        """By how much the gaps grow."""
        _, _, u, _ = open_system.parted(y)
        return open_system.contacts.rates(open_system.of_nodes(x, u))

    def work(x: Array, y: Array, by: tuple[Array, Array]) -> Float[Array, ""]:
        first, _, u, force = open_system.parted(y)
        moments, rows = by
        border, _, balance, gap = open_system.parted(rows)
        return jnp.sum(x * moments) + jnp.sum(u * balance) - jnp.sum(force * gap) - jnp.sum(first * border)

    def improved(state: _State) -> _State:
        is_minimum, x, y = solved(state.is_closed)
        is_first = state.count == 0
        dx, dy = x - state.x, y - state.y
        _, _, du, _ = open_system.parted(dy)
        # The model along the way from the last iterate to this one: the rows of border and elements hold at both.
        ahead, here = open_system.times(dx, dy), open_system.times(state.x, state.y)
        slope = (work(state.x, state.y, ahead) + work(dx, dy, here)) / 2 - jnp.sum(f * dx) - jnp.sum(of_nodes * du)
        curvature = work(dx, dy, ahead)
        before, rate = contacts.gaps + opening(state.x, state.y), opening(dx, dy)
        parts = jnp.asarray(PARTS, slope.dtype)
        pressures = contacts.pressures[None] - (before[None] + parts[:, None, None] * rate[None]) / softness
        pressures = jnp.where(pressures > 0, pressures, 0.0)
        energies = parts * slope + parts**2 * curvature / 2 + softness / 2 * jnp.sum(pressures**2, axis=(1, 2))
        best = jnp.where(is_first, 0, jnp.argmin(energies))
        part = parts[best]
        is_closed = pressures[best] > 0
        is_same = jnp.all(is_closed == state.is_closed) & (best == 0)
        return _State(
            state.x + part * dx,
            state.y + part * dy,
            is_closed,
            is_minimum,
            is_same | ~is_minimum,
            state.count + 1,
        )

    count = jnp.zeros((), int)
    begin = _State(jnp.zeros_like(f), jnp.zeros_like(c), contacts.closed(softness), jnp.array(False), jnp.array(False), count)
    end = jax.lax.while_loop(lambda state: ~state.is_done & (state.count < MOST_FACTORS), improved, begin)
    pressures = contacts.pressures - (contacts.gaps + opening(end.x, end.y)) / softness
    change = jnp.where(pressures > 0, pressures, 0.0) - contacts.pressures
    first, _, u, force = open_system.parted(end.y)
    y = jnp.concatenate([part.reshape(-1) for part in (first, change, u, force)])
    return ModelMinimum(end.x, y, end.is_minimum, end.count)
