"""The minimum of a quadratic model of a rod whose gaps may only close: which contacts of a `ChainSystem` are closed.

With u the motion of the nodes, a contact of the pressure p0 and the gap g has in the model the pressure

    p(u) = max(0, p0 - (g + N^T u)/softness)

and the energy softness p(u)^2/2, so that the model is convex where its stiffness is positive, and piecewise quadratic.
Each step of a semismooth Newton method is one factorisation, with the contacts closed that are so at the last iterate.
The first ones are taken whole, as that most often ends soonest; later ones are followed by a line search on the model
itself, so that the method cannot cycle; under loads without a potential, where the model has no value, all are whole.
It ends where a whole step closes and opens no contact. Where many contacts close or open, it would advance by one or
two at a time: then much softer contacts are sought first, and from these harder ones.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.chain import ChainSystem, factor_chain

# The most factorisations; those before softer contacts are tried, of SOFTEST [L^3/EI] and then harder by HARDENING at
# a time; with each softness the first so many are followed by whole steps; steps of each line search.
MOST_FACTORS = 60
FIRST_FACTORS = 6
SOFTEST = 1e-4
HARDENING = 1e4
WHOLE_STEPS = 12
LINE_STEPS = 12


class Unilateral(eqx.Module):
    """Gaps and pressures of k obstacles and the nodes."""

    gaps: Float[Array, "k n+1"]
    pressures: Float[Array, "k n+1"]


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
    is_closed: Bool[Array, "k n+1"]
    softness: Float[Array, ""]
    is_minimum: Bool[Array, ""]
    is_done: Bool[Array, ""]
    since: Int[Array, ""]  # factorisations with this softness
    count: Int[Array, ""]


def minimized(system: ChainSystem, f: Float[Array, "b m"], c: Float[Array, "j"], contacts: Unilateral) -> ModelMinimum:
    """From right sides f and c without what the pressures do: forces on the rotations, gaps of the elements, forces on
    the nodes. The contacts closed in the system are those of the first factorisation. The pressures in the result are
    what they change by.
    """
    final = system.contacts.softness
    open_system = system.closed_where(jnp.zeros(contacts.gaps.shape, bool))
    of_border, _, of_nodes, of_elements = open_system.parted(c)

    def solved(is_closed: Bool[Array, "k n+1"], softness: Float[Array, ""]):
        here = eqx.tree_at(lambda system: system.contacts.softness, system.closed_where(is_closed), softness)
        pushed = here.contacts.pushed(jnp.where(is_closed, contacts.pressures, 0.0))
        by_contacts = jnp.where(is_closed, contacts.gaps, contacts.pressures)
        nodes = of_nodes + jnp.where(here.held[:, None], 0.0, pushed)
        right = [part.reshape(-1) for part in (of_border, by_contacts, nodes, of_elements)]
        factors = factor_chain(here)
        return factors.is_minimum, *factors.solve_softly(f, jnp.concatenate(right))

    def opening(y: Float[Array, "j"]) -> Float[Array, "k n+1"]:
        """By how much the gaps grow."""
        return open_system.contacts.rates(open_system.parted(y)[2])

    def work(x: Array, y: Array, by: tuple[Array, Array]) -> Float[Array, ""]:
        first, _, u, force = open_system.parted(y)
        moments, rows = by
        border, _, balance, gap = open_system.parted(rows)
        return jnp.sum(x * moments) + jnp.sum(u * balance) - jnp.sum(force * gap) - jnp.sum(first * border)

    def improved(state: _State) -> _State:
        softness = state.softness
        is_minimum, x, y = solved(state.is_closed, softness)
        # Without symmetry there is no model that could be least.
        is_early = (state.since < WHOLE_STEPS) | (system.loads is not None)
        dx, dy = x - state.x, y - state.y
        _, _, du, _ = open_system.parted(dy)
        # The model along the way from the last iterate to this one: the rows of border and elements hold at both.
        ahead, here = open_system.times(dx, dy), open_system.times(state.x, state.y)
        slope = (work(state.x, state.y, ahead) + work(dx, dy, here)) / 2 - jnp.sum(f * dx) - jnp.sum(of_nodes * du)
        curvature = work(dx, dy, ahead)
        before, rate = contacts.gaps + opening(state.y), opening(dy)
        pressures, falls = contacts.pressures - before / softness, rate / softness

        def rise(part: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
            """The slope of the model there, and how much that grows."""
            there = pressures - part * falls
            pushes = there > 0
            by_part = jnp.where(pushes, falls, 0.0) * softness
            return slope + part * curvature - jnp.sum(by_part * there), curvature + jnp.sum(by_part * falls)

        def closer(_, bracket: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            low, high, part = bracket
            value, growth = rise(part)
            low, high = jnp.where(value < 0, part, low), jnp.where(value < 0, high, part)
            newton = part - value / growth
            return low, high, jnp.where((newton > low) & (newton < high), newton, (low + high) / 2)

        zero, one = jnp.zeros_like(slope), jnp.ones_like(slope)
        squares = [jnp.sum(jnp.where(p > 0, p, 0.0) ** 2) for p in (pressures, pressures - falls)]
        is_whole = is_early | (slope + curvature / 2 + softness / 2 * (squares[1] - squares[0]) <= 0)
        part = jnp.where(is_whole, one, jax.lax.fori_loop(0, LINE_STEPS, closer, (zero, one, one))[2])
        is_closed = pressures - part * falls > 0
        is_same = jnp.all(is_closed == state.is_closed) & is_whole
        # Where the contacts are not found at once, softer ones are, and harder ones from these.
        is_late = (state.count + 1 == FIRST_FACTORS) & ~is_same
        harder = jnp.where(softness > HARDENING * final, softness / HARDENING, final)
        return _State(
            state.x + part * dx,
            state.y + part * dy,
            is_closed,
            jnp.where(is_late & (final < SOFTEST), SOFTEST, jnp.where(is_same, harder, softness)),
            is_minimum,
            (is_same & (softness <= final)) | ~is_minimum,
            jnp.where(is_late | is_same, 0, state.since + 1),
            state.count + 1,
        )

    count = jnp.zeros((), int)
    no = jnp.array(False)
    begin = _State(jnp.zeros_like(f), jnp.zeros_like(c), system.contacts.is_closed, final, no, no, count, count)
    end = jax.lax.while_loop(lambda state: ~state.is_done & (state.count < MOST_FACTORS), improved, begin)
    pressures = contacts.pressures - (contacts.gaps + opening(end.y)) / final
    change = jnp.where(pressures > 0, pressures, 0.0) - contacts.pressures
    first, _, u, force = open_system.parted(end.y)
    y = jnp.concatenate([part.reshape(-1) for part in (first, change, u, force)])
    return ModelMinimum(end.x, y, end.is_minimum & end.is_done, end.count)
