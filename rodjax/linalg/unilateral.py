"""The minimum of a quadratic model of a rod, or several, whose gaps may only close: which contacts are closed.

With u the motion of the nodes, a contact of the pressure p0 and the gap g has in the model the pressure

    p(u) = max(0, p0 - (g + N^T u)/c)

with the contact compliance c, and the energy c p(u)^2/2, so that the model is convex where its stiffness is positive,
and piecewise quadratic. Each step of a semismooth Newton method is one factorisation, with the contacts closed that are
so at the last iterate. The first ones are taken whole, as that most often ends soonest; later ones are followed by a
line search on the model itself, so that the method cannot cycle. Under loads without a potential, and where rods slide
through clips, the stiffness is not symmetric: the line search is one of the model of its symmetric part, and steps that
lead up there are taken whole. It ends where a whole step closes and opens no contact. Where many contacts close or
open, it would advance by one or two at a time: then much softer contacts are sought first, and from these harder ones.

Coulomb friction with bounds that are given stays within that: with s the slip, tangential, the force on the node is

    q(u) = q0 - (s + P u)/c, no longer than its bound

of the energy c |q|^2/2, and beyond the bound one that is linear in |q0 - (s + P u)/c|: convex as well.
A contact that sticks is three closed rows, P; what one that slips does as it turns is in the stiffness of its node.
"""

from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.chain_factors import ChainFactors, factor_chain
from rodjax.linalg.chain_rows import ContactRows

# The most factorisations; those before softer contacts are tried, of MOST_COMPLIANT [L^3/EI] and then harder by
# HARDENING at a time; with each compliance the first so many are followed by whole steps; steps of each line search.
MOST_FACTORS = 60
FIRST_FACTORS = 6
MOST_COMPLIANT = 1e-4
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
        normal, tangential = self._split(trial)
        return self._joined(jnp.where(normal > 0, normal, 0.0), _clipped(tangential, self.bounds))

    def is_closed(self, trial: Float[Array, "r n+1"]) -> Bool[Array, "r n+1"]:
        """Whether a contact closes, or sticks."""
        if self.bounds is None:
            return trial > 0
        normal, tangential = self._split(trial)
        sticks = _lengths(tangential) < self.bounds
        return self._joined(normal > 0, jnp.broadcast_to(sticks[:, None], tangential.shape))

    def energy(self, trial: Float[Array, "r n+1"], contact_compliance: Float[Array, ""]) -> Float[Array, ""]:
        return contact_compliance / 2 * self._squares(trial)

    def _squares(self, trial: Float[Array, "r n+1"]) -> Float[Array, ""]:
        if self.bounds is None:
            return jnp.sum(jnp.where(trial > 0, trial, 0.0) ** 2)
        normal, tangential = self._split(trial)
        lengths, bounds = _lengths(tangential), self.bounds
        of_friction = jnp.where(lengths < bounds, lengths**2, bounds * (2 * lengths - bounds))
        return jnp.sum(jnp.where(normal > 0, normal, 0.0) ** 2) + jnp.sum(of_friction)

    def slope(
        self, trial: Float[Array, "r n+1"], falls: Float[Array, "r n+1"], contact_compliance: Array
    ) -> Float[Array, ""]:
        """The derivative of that along -falls."""
        return -contact_compliance * jnp.sum(self.allowed(trial) * falls)

    def growth(
        self, trial: Float[Array, "r n+1"], falls: Float[Array, "r n+1"], contact_compliance: Array
    ) -> Float[Array, ""]:
        """The second derivative of it."""
        return contact_compliance * self._squares_of(trial, falls)

    def _squares_of(self, trial: Float[Array, "r n+1"], falls: Float[Array, "r n+1"]) -> Float[Array, ""]:
        if self.bounds is None:
            return jnp.sum(jnp.where(trial > 0, falls, 0.0) * falls)
        normal, tangential = self._split(trial)
        of_normal, of_tangential = self._split(falls)
        directions, parts = self._slipping(tangential)
        along = jnp.sum(directions * of_tangential, axis=1)
        of_friction = parts * (jnp.sum(of_tangential**2, axis=1) - along**2)
        return jnp.sum(jnp.where(normal > 0, of_normal, 0.0) * of_normal) + jnp.sum(of_friction)

    def slipping(
        self, trial: Float[Array, "r n+1"], contacts: ContactRows, contact_compliance: Float[Array, ""]
    ) -> tuple[Array, Array] | None:
        """The stiffness at the nodes of what slips there, and the forces there that do not depend on the motion."""
        if self.bounds is None:
            return None
        along = contacts.normals[len(self.gaps) - 3 * len(self.bounds) :].reshape(-1, 3, *contacts.normals.shape[1:])
        _, tangential = self._split(trial)
        _, begin = self._split(self.pressures - self.gaps / contact_compliance)
        directions, parts = self._slipping(tangential)
        slips = (_lengths(tangential) >= self.bounds)[:, None]
        turning = jnp.where(slips[:, None], _across(directions) * parts[:, None, None], 0.0)
        force = jnp.where(slips, self.bounds[:, None] * directions, 0.0)
        force += jnp.einsum("fcdn,fdn->fcn", turning, begin)
        stiffness = jnp.einsum("fcna,fcdn,fdnb->nab", along, turning / contact_compliance, along)
        return stiffness, jnp.einsum("fcna,fcn->na", along, force)

    def turned(self, trial: Float[Array, "r n+1"], other: Float[Array, "r n+1"]) -> Bool[Array, ""]:
        """Whether a slip has another direction in one trial than in another."""
        if self.bounds is None:
            return jnp.array(False)
        (here, _), (there, _) = (self._slipping(self._split(each)[1]) for each in (trial, other))
        turned = jnp.max(jnp.abs(here - there), axis=1)
        return jnp.any(self.bounds * turned > SAME_DIRECTION * jnp.max(self.bounds))

    def _split(self, rows: Array) -> tuple[Array, Array]:
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
    squares = jnp.sum(vectors**2, axis=1)
    is_zero = squares == 0
    # With the derivative 0 at 0.
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, squares)))


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


class Model(Protocol):
    """A quadratic model but for its contacts; motions and `memory` are any pytrees."""

    def solved(
        self, is_closed: Array, trial: Array, contact_compliance: Array, memory: Any
    ) -> tuple[Bool[Array, ""], Any, Any]:
        """With these contacts closed, and what they would exert at the last iterate: whether that is a minimum, the
        motion to it, and what the next solution needs to know.
        """
        ...

    def opening(self, motion: Any) -> Array:
        """By how much the gaps grow."""
        ...

    def along(self, motion: Any, change: Any, memory: Any) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Slope and curvature of the model without contacts from a motion along a change, where its stiffness is the
        symmetric part: the rows of multipliers hold at both.
        """
        ...


class Contacts(Protocol):
    """As `Unilateral`."""

    gaps: Array
    pressures: Array

    def allowed(self, trial: Array) -> Array: ...
    def is_closed(self, trial: Array) -> Array: ...
    def energy(self, trial: Array, contact_compliance: Array) -> Float[Array, ""]: ...
    def slope(self, trial: Array, falls: Array, contact_compliance: Array) -> Float[Array, ""]: ...
    def growth(self, trial: Array, falls: Array, contact_compliance: Array) -> Float[Array, ""]: ...
    def turned(self, trial: Array, other: Array) -> Bool[Array, ""]: ...


class Sought(eqx.Module):
    """Where a search ended, with the last of `Model.solved`; `trial`: what contacts would exert there, if they could
    pull, and had no bounds.
    """

    motion: Any
    memory: Any
    trial: Array
    is_closed: Array
    level: Float[Array, ""]  # the least compliance
    is_minimum: Bool[Array, ""]
    is_done: Bool[Array, ""]
    since: Int[Array, ""]  # factorisations with this level
    count: Int[Array, ""]

    def exerted(self, contacts: Contacts, opening: Array, contact_compliance: Array) -> Array:
        """What contacts of this compliance would exert there. Where they were not found, their gaps would be forces out
        of all proportion: then what those of the last iterate do.
        """
        found = contacts.pressures - (contacts.gaps + opening) / contact_compliance
        return jnp.where(self.is_done, found, self.trial)


def sought(
    model: Model, contacts: Contacts, is_closed: Array, contact_compliance: Array, nowhere: Any, memory: Any = None
) -> Sought:
    """The minimum of a model from the contacts that are closed first, with contacts of this compliance."""

    def improved(state: Sought) -> Sought:
        here = jnp.maximum(contact_compliance, state.level)
        is_minimum, motion, memory = model.solved(state.is_closed, state.trial, here, state.memory)
        change = jax.tree.map(jnp.subtract, motion, state.motion)
        # The model along the way from the last iterate to this one.
        slope, curvature = model.along(state.motion, change, memory)
        before, rate = contacts.gaps + model.opening(state.motion), model.opening(change)
        pressures, falls = contacts.pressures - before / here, rate / here

        def rise(part: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
            """The slope of the model there, and how much that grows."""
            there = pressures - part * falls
            rise = slope + part * curvature + contacts.slope(there, falls, here)
            return rise, curvature + contacts.growth(there, falls, here)

        def closer(_, bracket: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            low, high, part = bracket
            value, growth = rise(part)
            low, high = jnp.where(value < 0, part, low), jnp.where(value < 0, high, part)
            newton = part - value / growth
            return low, high, jnp.where((newton > low) & (newton < high), newton, (low + high) / 2)

        zero, one = jnp.zeros_like(slope), jnp.ones_like(slope)
        whole = pressures - falls
        gained = contacts.energy(whole, here) - contacts.energy(pressures, here)
        is_same = jnp.all(contacts.is_closed(whole) == state.is_closed) & ~contacts.turned(whole, state.trial)
        goes_down, goes_up = slope + curvature / 2 + gained <= 0, rise(zero)[0] >= 0
        is_whole = (state.since < WHOLE_STEPS) | is_same | goes_down | goes_up
        part = jnp.where(is_whole, one, jax.lax.fori_loop(0, LINE_STEPS, closer, (zero, one, one))[2])
        trial = pressures - part * falls
        is_closed = contacts.is_closed(trial)
        # Where the contacts are not found at once, softer ones are, and harder ones from these.
        hardest = jnp.min(contact_compliance)
        is_late = (state.count + 1 == FIRST_FACTORS) & ~is_same
        harder = jnp.where(state.level > HARDENING * hardest, state.level / HARDENING, 0.0)
        # With softer contacts the model may have no minimum where it has one.
        is_too_soft = ~is_minimum & (state.level > hardest)
        level = jnp.where(is_late & (hardest < MOST_COMPLIANT), MOST_COMPLIANT, jnp.where(is_same, harder, state.level))
        motion = jax.tree.map(lambda here, change: here + part * change, state.motion, change)
        kept, found = (state.motion, state.memory, state.trial, state.is_closed), (motion, memory, trial, is_closed)
        motion, memory, trial, is_closed = jax.tree.map(lambda old, new: jnp.where(is_too_soft, old, new), kept, found)
        return Sought(
            motion,
            memory,
            trial,
            is_closed,
            jnp.where(is_too_soft, harder, level),
            is_minimum,
            ((is_same & (state.level <= hardest)) | ~is_minimum) & ~is_too_soft,
            jnp.where(is_late | is_same | is_too_soft, 0, state.since + 1),
            state.count + 1,
        )

    count, no = jnp.zeros((), int), jnp.array(False)
    trial = contacts.pressures - contacts.gaps / contact_compliance
    level = jnp.zeros((), trial.dtype)
    begin = Sought(nowhere, memory, trial, is_closed, level, no, no, count, count)
    return jax.lax.while_loop(lambda state: ~state.is_done & (state.count < MOST_FACTORS), improved, begin)


class OfChain(eqx.Module):
    """The model of `minimized`, whose motions are x and y."""

    system: ChainSystem  # with no contact closed
    f: Float[Array, "b m"]
    c: Float[Array, "j"]
    contacts: Unilateral

    def solved(
        self,
        is_closed: Bool[Array, "r n+1"],
        trial: Float[Array, "r n+1"],
        contact_compliance: Float[Array, ""],
        memory: None,
    ) -> tuple[Bool[Array, ""], tuple[Array, Array], None]:
        factors, f, c = self.factored(is_closed, trial, contact_compliance)
        return factors.is_minimum, factors.solve_softly(f, c), None

    def factored(
        self, is_closed: Bool[Array, "r n+1"], trial: Float[Array, "r n+1"], contact_compliance: Float[Array, ""]
    ) -> tuple[ChainFactors, Float[Array, "b m"], Float[Array, "j"]]:
        """With these contacts closed, and the right sides."""
        here = closed_softly(self.system, is_closed, contact_compliance)
        f, c = with_pressures(here, self.contacts, self.f, self.c)
        here, c = with_slips(here, self.contacts, c, trial)
        return factor_chain(here), f, c

    def opening(self, motion: tuple[Array, Array]) -> Float[Array, "r n+1"]:
        x, y = motion
        return self.system.contacts.rates(x, self.system.split(y)[2])

    def along(
        self, motion: tuple[Array, Array], change: tuple[Array, Array], memory: None
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        ahead, here = self.system.times(*change), self.system.times(*motion)
        _, _, du, _ = self.system.split(change[1])
        _, _, of_nodes, _ = self.system.split(self.c)
        slope = (work(self.system, motion, ahead) + work(self.system, change, here)) / 2
        slope -= jnp.sum(self.f * change[0]) + jnp.sum(of_nodes * du)
        return slope, work(self.system, change, ahead)


def closed_softly(
    system: ChainSystem, is_closed: Bool[Array, "r n+1"], contact_compliance: Float[Array, ""]
) -> ChainSystem:
    return eqx.tree_at(
        lambda system: system.contacts.contact_compliance, system.closed_where(is_closed), contact_compliance
    )


def with_pressures(
    system: ChainSystem, contacts: Unilateral, f: Float[Array, "b m"], c: Float[Array, "j"]
) -> tuple[Float[Array, "b m"], Float[Array, "j"]]:
    """The right sides of a model with the pressures of the contacts that are closed."""
    is_closed = system.contacts.is_closed
    pressures = jnp.where(is_closed, contacts.pressures, 0.0)
    first, _, nodes, elements = system.split(c)
    nodes += jnp.where(system.held[:, None], 0.0, system.contacts.pushed(pressures))
    rows = jnp.where(is_closed, contacts.gaps, contacts.pressures)
    right = [part.reshape(-1) for part in (first, rows, nodes, elements)]
    return system.contacts.turned(pressures, f), jnp.concatenate(right)


def with_slips(
    system: ChainSystem, contacts: Unilateral, c: Float[Array, "j"], trial: Float[Array, "r n+1"]
) -> tuple[ChainSystem, Float[Array, "j"]]:
    """System and right side with what slips."""
    slipping = contacts.slipping(trial, system.contacts, system.contacts.contact_compliance)
    if slipping is None:
        return system, c
    first, rows, nodes, gaps = system.split(c)
    nodes += jnp.where(system.held[:, None], 0.0, slipping[1])
    c = jnp.concatenate([part.reshape(-1) for part in (first, rows, nodes, gaps)])
    return eqx.tree_at(lambda system: system.stiffness, system, system.stiffness + slipping[0]), c


def work(system: ChainSystem, motion: tuple[Array, Array], by: tuple[Array, Array]) -> Float[Array, ""]:
    """Of a motion on rows of the system, those of multipliers with the other sign."""
    (x, y), (moments, rows) = motion, by
    first, _, u, force = system.split(y)
    border, _, balance, gap = system.split(rows)
    return jnp.sum(x * moments) + jnp.sum(u * balance) - jnp.sum(force * gap) - jnp.sum(first * border)


def minimized(system: ChainSystem, f: Float[Array, "b m"], c: Float[Array, "j"], contacts: Unilateral) -> ModelMinimum:
    """From right sides f and c without what the pressures do: forces on the rotations, gaps of the elements, forces on
    the nodes. The contacts closed in the system are those of the first factorisation. The pressures in the result are
    what they change by.
    """
    contact_compliance = system.contacts.contact_compliance
    open_system = system.closed_where(jnp.zeros(contacts.gaps.shape, bool))
    model = OfChain(open_system, f, c, contacts)
    nowhere = jnp.zeros_like(f), jnp.zeros_like(c)
    end = sought(model, contacts, system.contacts.is_closed, contact_compliance, nowhere)
    x, y = end.motion
    y = with_exerted(system, contacts, end.exerted(contacts, model.opening(end.motion), contact_compliance), y)
    return ModelMinimum(x, y, end.is_minimum & end.is_done, end.count)


def with_exerted(
    system: ChainSystem, contacts: Unilateral, trial: Float[Array, "r n+1"], y: Float[Array, "j"]
) -> Float[Array, "j"]:
    """Multipliers with the changes of what contacts exert."""
    first, _, u, force = system.split(y)
    parts = first, contacts.allowed(trial) - contacts.pressures, u, force
    return jnp.concatenate([part.reshape(-1) for part in parts])
