"""Corners of a branch beside obstacles: where a contact opens or closes.

Between two corners the closed contacts stay closed and others open, and the branch is smooth. A step that leaves a
closed contact without pressure, or an open one without a gap, ends where the first of them is so. There that contact
changes, and the branch goes on to where its pressure, or its gap, grows: perhaps back in the parameter. Others that
have neither pressure nor gap there, as by symmetry, change with it where they would not stay so.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rodjax.paths.branch import Station
from rodjax.paths.line import Line, Step, towards

# Pressures, and gaps times their weight, count as none up to this [EI/L^2].
NO_PRESSURE = 1e-7
# A rate counts as none up to this part of the largest one.
NO_RATE = 1e-9
# The search for a corner ends at this part of a step, or after so many trials, of which every so many halves.
LEAST_PART = 1e-12
MAX_TRIALS = 60
HALVED = 4
# So often contacts change at one corner before it is given up.
MAX_CHANGES = 20


class Corner(NamedTuple):
    """The step as far as the corner, the row and node of the contact that changes, and the same point with the contacts
    with which the branch goes on.
    """

    step: Step
    contact: tuple[int, int]
    beyond: Station


def corner_in(line: Line, step: Step) -> Corner | None:
    """The first corner within a step; `None` where its contacts stay as they are.

    Raises `TooLongError` where a step must be shorter for that to be told, or no choice of contacts goes on.
    """
    if not changes_contacts(step.there):
        return None
    before, after, rates = _amounts(line.station), _amounts(step.there), _rates(line.station)
    is_none = before <= NO_PRESSURE
    falls = is_none & (after < -NO_PRESSURE)
    if np.any(falls & (rates >= 0)):
        raise TooLongError
    if np.any(falls):
        here = Step(line.station, 0.0, step.at, None, 1.0)
        return _passed(line, here, _place_of(np.where(falls, rates, np.inf)))
    low = last = _Trial(0.0, line.station, np.where(is_none, np.inf, before))
    high = here = _Trial(1.0, step.there, np.where(is_none, np.inf, after))
    for trial in range(1, MAX_TRIALS):
        width = high.part - low.part
        if abs(here.least) <= NO_PRESSURE or width <= LEAST_PART:
            break
        part = _first_zero(low, high, last, here) if trial % HALVED else low.part + width / 2
        there = step.at(part)
        if not there.equilibrium.converged:
            raise TooLongError
        last, here = here, _Trial(part, there, np.where(is_none, np.inf, _amounts(there)))
        low, high = (here, high) if here.least > 0 else (low, here)
    if abs(here.least) > NO_PRESSURE:
        here = high
    part = here.part
    landed = Step(here.station, part * step.length, lambda share: step.at(share * part), None, 1.0)
    return _passed(line, landed, _place_of(here.amounts))


class _Trial(NamedTuple):
    """What was found at a part of a step, infinite for contacts that have neither pressure nor gap at its beginning."""

    part: float
    station: Station
    amounts: Float[np.ndarray, "k n+1"]

    @property
    def least(self) -> float:
        return float(np.min(self.amounts))


def _first_zero(low: _Trial, high: _Trial, last: _Trial, here: _Trial) -> float:
    """Where the first contact of those that are negative at the upper part changes its sign: by the last two parts
    where that is between, else by the lower and the upper one.
    """
    falls = high.amounts < 0
    before, after = low.amounts[falls], high.amounts[falls]
    shares = before / (before - after)
    first = np.argmin(shares)
    width = high.part - low.part
    found = low.part + float(shares[first]) * width
    values = last.amounts[falls][first], here.amounts[falls][first]
    if values[0] != values[1]:
        nearer = here.part - float(values[1] / (values[1] - values[0])) * (here.part - last.part)
        if low.part < nearer < high.part:
            return nearer
    return found


def _passed(line: Line, step: Step, contact: tuple[int, int]) -> Corner:
    """With the contacts of which none would lose its pressure or its gap."""
    station = step.there
    closed, parameter = np.array(station.closed), station.parameter
    may_change = np.abs(_amounts(station)) <= NO_PRESSURE
    closed[contact] ^= True
    for _ in range(MAX_CHANGES):
        here = line.scenes, line.segment, parameter, station.equilibrium
        beyond = towards(*here, station.along, 0.0, float(parameter), closed)
        if not beyond.equilibrium.converged:
            break
        rates = _rates(beyond)
        if rates[contact] < 0:
            beyond, rates = beyond.reversed(), -rates
        wrong = may_change & (rates < -NO_RATE * np.max(np.abs(rates)))
        if not np.any(wrong):
            return Corner(step, contact, beyond)
        closed ^= wrong
    raise TooLongError


class TooLongError(Exception):
    """A step must be shorter."""


def changes_contacts(station: Station) -> bool:
    """Whether a closed contact has lost its pressure on the way, or an open one its gap."""
    return station.contacts is not None and bool(np.any(_amounts(station) < -NO_PRESSURE))


def _amounts(station: Station) -> Float[np.ndarray, "k n+1"]:
    assert station.contacts is not None
    return np.asarray(station.contacts.amounts)


def _rates(station: Station) -> Float[np.ndarray, "k n+1"]:
    assert station.contacts is not None
    return np.asarray(station.contacts.rates)


def _place_of(amounts: Float[np.ndarray, "k n+1"]) -> tuple[int, int]:
    """Where they are least."""
    row, node = np.unravel_index(np.argmin(amounts), amounts.shape)
    return int(row), int(node)
