"""What a fit is worth: covariances, classical and by clusters, and what the data do not determine."""

import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rodjax.identification.least_squares import NormalEquations
from rodjax.identification.unknowns import Unknown

# A combination of unknowns that may change by so many of their large sizes within one standard deviation is one that
# the data do not determine: by a factor of 20 on a log scale.
LARGEST_DEVIATION = 3.0
# The same where the information is rounding beside that of the best known combination: derivatives have ten digits.
LEAST_INFORMATION = 1e-15
# A held number whose relative standard error would be above this is hardly to be found.
HARDLY_FOUND = 0.3
# Parts of a combination that are smaller beside the largest are not named.
LEAST_PART = 0.03


class Combination(NamedTuple):
    """Unknowns that the data tell only together, or not at all: `parts` are changes that leave all measurements.

    `parts`: by label, factors on a log scale, else in the unit of the unknown; `deviation`: how far it may go within a
    standard deviation, in such changes.
    """

    parts: dict[str, tuple[float, str]]
    deviation: float

    @property
    def words(self) -> str:
        told = [
            f"{name} {'x' if unit == 'x' else '+'} {part:.3g}{'' if unit in ('x', '') else ' ' + unit}"
            for name, (part, unit) in self.parts.items()
        ]
        return " with ".join(told)


class Blocks(NamedTuple):
    """The information on the unknowns in common (s) and of each experiment (o), by their sizes; 1 for what is fixed."""

    ss: Float[np.ndarray, "p p"]
    so: Float[np.ndarray, "e p q"]
    oo: Float[np.ndarray, "e q q"]

    @staticmethod
    def of(normal: NormalEquations, is_free: Bool[np.ndarray, "e q"]) -> "Blocks":
        fixed = np.eye(is_free.shape[1])[None] * ~is_free[..., None]
        return Blocks(np.asarray(normal.ss, float), np.asarray(normal.so, float), np.asarray(normal.oo, float) + fixed)

    def of_shared(self, p: int) -> "Blocks":
        """Of the first p unknowns in common."""
        return Blocks(self.ss[:p, :p], self.so[:, :p], self.oo)

    @property
    def following(self) -> Float[np.ndarray, "e q p"]:
        """How the own unknowns follow those in common: o = -F s."""
        return inverse(self.oo) @ np.swapaxes(self.so, 1, 2)

    @property
    def on_shared(self) -> Float[np.ndarray, "p p"]:
        """What is left of the information on those in common where the others are unknown too."""
        return self.ss - np.einsum("epq,eqr->pr", self.so, self.following)

    def covariance(self) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "e q q"]]:
        """Of those in common, and of those of each experiment, for deviations of one."""
        shared = inverse(self.on_shared)
        following = self.following
        return shared, inverse(self.oo) + following @ shared @ np.swapaxes(following, 1, 2)


def inverse(matrix: Float[np.ndarray, "*k n n"]) -> Float[np.ndarray, "*k n n"]:
    """Of symmetric matrices; with large numbers for what is nothing but rounding."""
    if matrix.shape[-1] == 0:
        return matrix
    values, vectors = np.linalg.eigh(matrix)
    least = LEAST_INFORMATION * np.max(np.abs(values), axis=-1, keepdims=True)
    values = np.where(values > least, values, np.maximum(least, np.finfo(float).tiny))
    return (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def undetermined(
    blocks: Blocks, dispersion: float, shared: Sequence[Unknown], own: Sequence[Unknown], length: float
) -> list[Combination]:
    """The combinations of unknowns that the data do not determine, for deviations of this variance."""
    found: list[Combination] = []
    q = len(own)
    alone = [_weak(matrix, dispersion) for matrix in blocks.oo]
    for vectors in alone:
        for vector, deviation in vectors:
            combination = _combination(own, vector, deviation, length)
            if combination.words not in [other.words for other in found]:
                found.append(combination)
    if found:
        return found
    following = blocks.following
    for vector, deviation in _weak(blocks.on_shared, dispersion):
        # Those of the experiment in which they follow most stand for all.
        follows = -following @ vector
        most = follows[np.argmax(np.sum(follows**2, axis=1))] if q else np.zeros(0)
        found.append(_combination([*shared, *own], np.concatenate([vector, most]), deviation, length))
    return found


def _weak(matrix: Float[np.ndarray, "n n"], dispersion: float) -> list[tuple[Float[np.ndarray, "n"], float]]:
    """Directions in which there is too little information, with their standard deviations."""
    if matrix.shape[0] == 0:
        return []
    values, vectors = np.linalg.eigh(matrix)
    rounding = LEAST_INFORMATION * max(float(values[-1]), np.finfo(float).tiny)
    weak = []
    for value, vector in zip(values, vectors.T, strict=True):
        deviation = math.sqrt(dispersion / value) if value > rounding else math.inf
        if deviation > LARGEST_DEVIATION:
            weak.append((vector, deviation))
    return weak


def _combination(
    unknowns: Sequence[Unknown], vector: Float[np.ndarray, "n"], deviation: float, length: float
) -> Combination:
    """The direction, by changes of which the largest is its unknown's size."""
    largest = int(np.argmax(np.abs(vector)))
    vector = vector / vector[largest]
    parts = {
        unknown.label: part_of(unknown, float(share), length)
        for unknown, share in zip(unknowns, vector, strict=True)
        if abs(share) > LEAST_PART
    }
    return Combination(parts, deviation)


def part_of(unknown: Unknown, share: float, length: float) -> tuple[float, str]:
    """A change by a share of an unknown's size, and its unit."""
    change = share * unknown.natural_size(length)
    return (math.exp(change), "x") if unknown.scale == "log" else (change, unknown.unit)


def rates(unknowns: Sequence[Unknown], at: Float[np.ndarray, "*e n"], length: float) -> Float[np.ndarray, "*e n"]:
    """The change of each value by its unknown's coordinate in its sizes."""
    is_log = np.array([unknown.scale == "log" for unknown in unknowns], bool)
    sizes = np.array([unknown.natural_size(length) for unknown in unknowns])
    return np.where(is_log, at, 1.0) * sizes


def held_numbers(
    blocks: Blocks, dispersion: float, unknowns: Sequence[Unknown], held: Sequence[Unknown], length: float
) -> list[str]:
    """Whether the data would tell numbers that were held: one sentence for each. Blocks have those behind the others.

    `unknowns`: those in common.
    """
    p = len(unknowns)
    information = blocks.on_shared
    inner = inverse(information[:p, :p])
    told = []
    for k, one in enumerate(held, start=p):
        alone = information[k, k]
        across = information[:p, k]
        left = alone - across @ inner @ across
        if not alone > 0 or math.sqrt(dispersion / alone) > LARGEST_DEVIATION:
            told.append(f"{one.label} cannot be found from these measurements: they do not depend on it")
            continue
        deviation = math.sqrt(dispersion / left) if left > LEAST_INFORMATION * 1e3 * alone else math.inf
        if deviation > LARGEST_DEVIATION:
            follows = np.concatenate([-inner @ across, [1.0]])
            combination = _combination([*unknowns, one], follows, deviation, length)
            told.append(f"{one.label} cannot be told apart: {combination.words} leaves all measurements as they are")
        else:
            can = "could" if deviation < HARDLY_FOUND else "could hardly"
            size = "a relative" if one.scale == "log" else "a"
            told.append(
                f"{one.label} {can} be found too, with {size} standard error of {_size(one, deviation, length)}"
            )
    return told


def _size(unknown: Unknown, deviation: float, length: float) -> str:
    return f"{deviation * unknown.natural_size(length):.2g}{'' if unknown.scale == 'log' else ' ' + unknown.unit}"


def clustered(
    blocks: Blocks,
    scores: Float[np.ndarray, "e p"],
    labels: Sequence[Hashable],
    slope: float,
    numbers: int,
    unknowns: int,
    is_used: Bool[np.ndarray, "e"],
) -> tuple[Float[np.ndarray, "p p"], int]:
    """The covariance of the unknowns in common from the scatter of whole clusters, and their number.

    Liang & Zeger (1986), with the small-sample factor G/(G-1) (n-1)/(n-k).
    """
    used = [label for label, is_in in zip(labels, is_used, strict=True) if is_in]
    names = list(dict.fromkeys(used))
    count = len(names)
    if count < 2 or numbers <= unknowns:
        return np.full_like(blocks.ss, np.nan), count
    sums = np.stack(
        [np.sum([s for s, label in zip(scores, labels, strict=True) if label == name], axis=0) for name in names]
    )
    bread = inverse(blocks.on_shared) / slope
    factor = count / (count - 1) * (numbers - 1) / (numbers - unknowns)
    return factor * bread @ (sums.T @ sums) @ bread, count
