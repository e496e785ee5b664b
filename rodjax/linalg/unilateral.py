"""The minimum of a quadratic model of a rod whose gaps may only close: which contacts of a `ChainSystem` are closed.

With u the motion of the nodes, a contact of the pressure p0 and the gap g has in the model the pressure

    p(u) = max(0, p0 - (g + N^T u)/softness)

and the energy softness p(u)^2/2, so that the model is convex where its stiffness is positive, and piecewise quadratic.
Each step of a semismooth Newton method is one factorisation, with the contacts closed that are so at the last iterate.
The first ones are taken whole, as that most often ends soonest; later ones are followed by a line search on the model
itself, so that the method cannot cycle; under loads without a potential, where the model has no value, all are whole
without friction, and with it the slope of a model of the same symmetric part is looked for along the line.
It ends where a whole step closes and opens no contact. Where many contacts close or open, it would advance by one or
two at a time: then much softer contacts are sought first, and from these harder ones.

Coulomb friction with bounds that are given stays within that: with s the slip, tangential, the force on the node is

    q(u) = q0 - (s + P u)/softness, no longer than its bound

of the energy softness |q|^2/2, and beyond the bound one that is linear in |q0 - (s + P u)/softness|: convex as well.
A contact that sticks is three closed rows, P; what one that slips does as it turns is in the stiffness of its node.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.chain import ChainSystem, ContactRows, factor_chain

# The most factorisations; those before softer contacts are tried, of SOFTEST [L^3/EI] and then harder by HARDENING at
# a time; with each softness the first so many are followed by whole steps; steps of each line search.
MOST_FACTORS = 60
FIRST_FACTORS = 6
SOFTEST = 1e-4
HARDENING = 1e4
WHOLE_STEPS = 12
LINE_STEPS = 12


# Slips are known where they turn by less than this in a step of the semismooth method [rad], less where bounds are low.
SAME_DIRECTION = 1e-6


class Unilateral(eqx.Module):
    """Gaps and pressures of k obstacles and the nodes, and below them three rows for each of f obstacles with friction:
    slips and tangential forces; `bounds`: of the latter, `None` without friction.
    """

    gaps: Float[Array, "r n+1"]
    pressures: Float[Array, "r n+1"]
    bounds: Float[Array, "f n+1"] | None = None

    def allowed(self, trial: Float[Array, "r n+1"]) -> Float[Array, "r n+1"]:
        """What the contacts exert where they would exert `trial`, if they could pull, and had no bounds."""
        if self.bounds is None:
            return jnp.where(trial > 0, trial, 0.0)
        normal, tangential = self._parted(trial)
        return self._joined(jnp.where(normal > 0, normal, 0.0), _clipped(tangential, self.bounds))

    def is_closed(self, trial: Float[Array, "r n+1"]) -> Bool[Array, "r n+1"]:
        """Whether a contact closes, or sticks."""
        if self.bounds is None:
            return trial > 0
        normal, tangential = self._parted(trial)
        sticks = _lengths(tangential) < self.bounds
        return self._joined(normal > 0, jnp.broadcast_to(sticks[:, None], tangential.shape))

    def energy(self, trial: Float[Array, "r n+1"]) -> Float[Array, ""]:
        """Twice that of the contacts, over their softness."""
        if self.bounds is None:
            return jnp.sum(jnp.where(trial > 0, trial, 0.0) ** 2)
        normal, tangential = self._parted(trial)
        lengths, bounds = _lengths(tangential), self.bounds
        of_friction = jnp.where(lengths < bounds, lengths**2, bounds * (2 * lengths - bounds))
        return jnp.sum(jnp.where(normal > 0, normal, 0.0) ** 2) + jnp.sum(of_friction)

    def growth(self, trial: Float[Array, "r n+1"], falls: Float[Array, "r n+1"]) -> Float[Array, ""]:
        """The second derivative of half of that along -falls."""
        if self.bounds is None:
            return jnp.sum(jnp.where(trial > 0, falls, 0.0) * falls)
        normal, tangential = self._parted(trial)
        of_normal, of_tangential = self._parted(falls)
        directions, parts = self._slipping(tangential)
        along = jnp.sum(directions * of_tangential, axis=1)
        of_friction = parts * (jnp.sum(of_tangential**2, axis=1) - along**2)
        return jnp.sum(jnp.where(normal > 0, of_normal, 0.0) * of_normal) + jnp.sum(of_friction)

    def slipping(
        self, trial: Float[Array, "r n+1"], contacts: ContactRows, softness: Float[Array, ""]
    ) -> tuple[Array, Array] | None:
        """The stiffness at the nodes of what slips there, and the forces there that do not depend on the motion."""
        if self.bounds is None:
            return None
        along = contacts.normals[len(self.gaps) - 3 * len(self.bounds) :].reshape(-1, 3, *contacts.normals.shape[1:])
        _, tangential = self._parted(trial)
        _, begin = self._parted(self.pressures - self.gaps / softness)
        directions, parts = self._slipping(tangential)
        slips = (_lengths(tangential) >= self.bounds)[:, None]
        turning = jnp.where(slips[:, None], _across(directions) * parts[:, None, None], 0.0)
        force = jnp.where(slips, self.bounds[:, None] * directions, 0.0)
        force += jnp.einsum("fcdn,fdn->fcn", turning, begin)
        stiffness = jnp.einsum("fcna,fcdn,fdnb->nab", along, turning / softness, along)
        return stiffness, jnp.einsum("fcna,fcn->na", along, force)

    def turned(self, trial: Float[Array, "r n+1"], other: Float[Array, "r n+1"]) -> Bool[Array, ""]:
        """Whether a slip has another direction in one trial than in another."""
        if self.bounds is None:
            return jnp.array(False)
        (here, _), (there, _) = (self._slipping(self._parted(each)[1]) for each in (trial, other))
        turned = jnp.max(jnp.abs(here - there), axis=1)
        return jnp.any(self.bounds * turned > SAME_DIRECTION * jnp.max(self.bounds))

    def _parted(self, rows: Array) -> tuple[Array, Array]:
        """Of pressures (k, n+1), and of tangential forces (f, 3, n+1)."""
        assert self.bounds is not None
        count, nodes = self.bounds.shape
        k = len(rows) - 3 * count
        return rows[:k], rows[k:].reshape(count, 3, nodes)

    def _joined(self, normal: Array, tangential: Array) -> Array:
        return jnp.concatenate([normal, tangential.reshape(-1, normal.shape[1])])

    def _slipping(self, tangential: Float[Array, "f 3 n+1"]) -> tuple[Array, Array]:
        """Directions, zero for what sticks; and bounds as parts of what would be exerted, at most 1."""
        assert self.bounds is not None
        lengths = _lengths(tangential)
        slips = lengths >= self.bounds
        safe = jnp.where(lengths > 0, lengths, 1.0)
        directions = jnp.where(slips[:, None], tangential / safe[:, None], 0.0)
        return directions, jnp.where(slips, self.bounds / safe, 1.0)


def _clipped(forces: Float[Array, "f 3 n+1"], bounds: Float[Array, "f n+1"]) -> Float[Array, "f 3 n+1"]:
    """No longer than their bounds."""
    lengths = _lengths(forces)
    return forces * jnp.where(lengths > bounds, bounds / jnp.where(lengths > 0, lengths, 1.0), 1.0)[:, None]


def _lengths(vectors: Float[Array, "f 3 n+1"]) -> Float[Array, "f n+1"]:
    return jnp.sqrt(jnp.sum(vectors**2, axis=1))


def _across(directions: Float[Array, "f 3 n+1"]) -> Float[Array, "f 3 3 n+1"]:
    """What of a vector is across directions."""
    identity = jnp.eye(3, dtype=directions.dtype)[None, :, :, None]
    return identity - directions[:, :, None] * directions[:, None]


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
    trial: Float[Array, "r n+1"]  # what contacts would exert there, if they could pull, and had no bounds
    is_closed: Bool[Array, "r n+1"]
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

    def solved(is_closed: Bool[Array, "r n+1"], trial: Float[Array, "r n+1"], softness: Float[Array, ""]):
        here = eqx.tree_at(lambda system: system.contacts.softness, system.closed_where(is_closed), softness)
        pressures = jnp.where(is_closed, contacts.pressures, 0.0)
        pushed = here.contacts.pushed(pressures)
        slipping = contacts.slipping(trial, here.contacts, softness)
        if slipping is not None:
            here = eqx.tree_at(lambda system: system.stiffness, here, here.stiffness + slipping[0])
            pushed += slipping[1]
        by_contacts = jnp.where(is_closed, contacts.gaps, contacts.pressures)
        nodes = of_nodes + jnp.where(here.held[:, None], 0.0, pushed)
        right = [part.reshape(-1) for part in (of_border, by_contacts, nodes, of_elements)]
        factors = factor_chain(here)
        turned = here.contacts.turned(pressures, f)
        return factors.is_minimum, *factors.solve_softly(turned, jnp.concatenate(right))

    def opening(x: Float[Array, "b m"], y: Float[Array, "j"]) -> Float[Array, "r n+1"]:
        """By how much the gaps grow."""
        return open_system.contacts.rates(x, open_system.parted(y)[2])

    def work(x: Array, y: Array, by: tuple[Array, Array]) -> Float[Array, ""]:
        first, _, u, force = open_system.parted(y)
        moments, rows = by
        border, _, balance, gap = open_system.parted(rows)
        return jnp.sum(x * moments) + jnp.sum(u * balance) - jnp.sum(force * gap) - jnp.sum(first * border)

    def improved(state: _State) -> _State:
        softness = state.softness
        is_minimum, x, y = solved(state.is_closed, state.trial, softness)
        # Without symmetry there is no model that could be least.
        is_early = (state.since < WHOLE_STEPS) | (system.loads is not None and contacts.bounds is None)
        dx, dy = x - state.x, y - state.y
        _, _, du, _ = open_system.parted(dy)
        # The model along the way from the last iterate to this one: the rows of border and elements hold at both.
        ahead, here = open_system.times(dx, dy), open_system.times(state.x, state.y)
        slope = (work(state.x, state.y, ahead) + work(dx, dy, here)) / 2 - jnp.sum(f * dx) - jnp.sum(of_nodes * du)
        curvature = work(dx, dy, ahead)
        before, rate = contacts.gaps + opening(state.x, state.y), opening(dx, dy)
        pressures, falls = contacts.pressures - before / softness, rate / softness

        def rise(part: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
            """The slope of the model there, and how much that grows."""
            there = pressures - part * falls
            work = softness * jnp.sum(contacts.allowed(there) * falls)
            return slope + part * curvature - work, curvature + softness * contacts.growth(there, falls)

        def closer(_, bracket: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            low, high, part = bracket
            value, growth = rise(part)
            low, high = jnp.where(value < 0, part, low), jnp.where(value < 0, high, part)
            newton = part - value / growth
            return low, high, jnp.where((newton > low) & (newton < high), newton, (low + high) / 2)

        zero, one = jnp.zeros_like(slope), jnp.ones_like(slope)
        squares = [contacts.energy(pressures), contacts.energy(pressures - falls)]
        is_whole = is_early | (slope + curvature / 2 + softness / 2 * (squares[1] - squares[0]) <= 0)
        part = jnp.where(is_whole, one, jax.lax.fori_loop(0, LINE_STEPS, closer, (zero, one, one))[2])
        trial = pressures - part * falls
        is_closed = contacts.is_closed(trial)
        is_same = jnp.all(is_closed == state.is_closed) & ~contacts.turned(trial, state.trial) & is_whole
        # Where the contacts are not found at once, softer ones are, and harder ones from these.
        is_late = (state.count + 1 == FIRST_FACTORS) & ~is_same
        harder = jnp.where(softness > HARDENING * final, softness / HARDENING, final)
        return _State(
            state.x + part * dx,
            state.y + part * dy,
            trial,
            is_closed,
            jnp.where(is_late & (final < SOFTEST), SOFTEST, jnp.where(is_same, harder, softness)),
            is_minimum,
            (is_same & (softness <= final)) | ~is_minimum,
            jnp.where(is_late | is_same, 0, state.since + 1),
            state.count + 1,
        )

    count = jnp.zeros((), int)
    no = jnp.array(False)
    trial = contacts.pressures - contacts.gaps / final
    begin = _State(jnp.zeros_like(f), jnp.zeros_like(c), trial, system.contacts.is_closed, final, no, no, count, count)
    end = jax.lax.while_loop(lambda state: ~state.is_done & (state.count < MOST_FACTORS), improved, begin)
    exerted = contacts.allowed(contacts.pressures - (contacts.gaps + opening(end.x, end.y)) / final)
    first, _, u, force = open_system.parted(end.y)
    y = jnp.concatenate([part.reshape(-1) for part in (first, exerted - contacts.pressures, u, force)])
    return ModelMinimum(end.x, y, end.is_minimum & end.is_done, end.count)
