"""Meshes for an accuracy that is asked for: how many elements, and where."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization.error import Errors
from rodjax.solving.penetration import MOST_PENETRATION

# The order of the shape error in 1/segments, and the numbers of segments: few, as each is a program to compile.
ORDERS = {"finite_difference": 2, "hermite": 4}
SIZES = {
    "finite_difference": (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096),
    "hermite": (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512),
}
# The estimated error may be off by a few percent, and a mesh that just misses costs another solve.
SAFETY = 1.2
# Forces, moments and curvatures are derivatives of the shape: their errors are 3 to 10 times that of the shape in a rod
# between clamps, 10 to 60 times in spans between clips.
SECTION_FACTOR = 10.0
# By segments^order: a cable bent by a turn under its weight has 1 to 5.
TYPICAL_ERROR = 2.0
# The mesh grows by this much at least, and at most: an estimate on a mesh too coarse is not to be believed that far.
LEAST_GROWTH, MOST_GROWTH = 1.2, 4.0
# The longest element is at most so many times as long as one of equal elements, and neighbours differ by this factor.
LONGEST = 2.0
GRADING = 2.0
# The shortest where a rod lies deeper within an obstacle between nodes than at them, as contacts on both sides of an
# element press on each other by its stiffness, EI/h^3.
SHORTEST_IN_CONTACT = 1 / 8
# Contacts press in with so high an order of the mesh, or not because of it.
LEAST_ORDER = 1.5


def error_by_rtol(errors: Errors) -> Float[np.ndarray, "..."]:
    """What `rtol` is to be kept by: the error of the shape, and those of forces, moments and curvatures, which may be
    `SECTION_FACTOR` times as large.
    """
    shape = np.max(np.linalg.norm(errors.nodes, axis=-1), axis=-1)
    sections = np.maximum(np.maximum(errors.force, errors.moment), errors.curvature)
    return np.maximum(shape, sections / SECTION_FACTOR)


def first_size(rtol: float, discretization: str, least: int = 0) -> int:
    """The number of segments to begin with: mostly enough, as each number of them is a program to compile."""
    return _at_least(max((TYPICAL_ERROR / rtol) ** (1 / ORDERS[discretization]), least), discretization)


def next_size(segments: int, error: float, rtol: float, discretization: str) -> int:
    """The number of segments for a relative error `rtol`, after `segments` had an estimated `error` (NaN: unknown)."""
    growth = (SAFETY * error / rtol) ** (1 / ORDERS[discretization]) if error == error else 2.0
    return _at_least(segments * min(max(growth, LEAST_GROWTH), MOST_GROWTH), discretization)


def _at_least(wanted: float, discretization: str) -> int:
    sizes = SIZES[discretization]
    return next((size for size in sizes if size >= wanted), sizes[-1])


def graded(
    s: Float[Array, "n+1"], defects: Float[Array, "n"], segments: int, shortest: float = 0.0
) -> Float[Array, "k+1"]:
    """Nodes of a mesh on which all elements would have the same defect, of fifth order in their length; `shortest`:
    element, as a part of one of equal elements.
    """
    h = jnp.diff(s)
    density = (defects + jnp.finfo(h.dtype).tiny) ** (1 / (ORDERS["hermite"] + 1)) / h
    density /= jnp.sum(density * h)
    if shortest:
        density = jnp.minimum(density, 1 / shortest)
    density = jnp.maximum(density, 1 / LONGEST)

    def spread(density, _):
        beside = jnp.maximum(jnp.concatenate([density[1:], density[-1:]]), jnp.concatenate([density[:1], density[:-1]]))
        return jnp.maximum(density, beside / GRADING), None

    density, _ = jax.lax.scan(spread, density, length=8)
    sums = jnp.concatenate([jnp.zeros(1, h.dtype), jnp.cumsum(density * h)])
    nodes = jnp.interp(jnp.linspace(0.0, 1.0, segments + 1, dtype=h.dtype) * sums[-1], sums, s)
    return nodes.at[0].set(0.0).at[-1].set(1.0)


def normalized(values: Float[Array, "n"]) -> Float[np.ndarray, "n"]:
    """Parts of their sum; nothing of nothing."""
    numbers = np.asarray(values)
    return numbers / (np.sum(numbers) + np.finfo(numbers.dtype).tiny)


class Depth:
    """How deep contacts press a rod in, from mesh to mesh."""

    def __init__(self):
        self._last: tuple[int, float] | None = None
        self._is_counted = True

    def lacking(self, errors: Errors, segments: int, converged: Bool[np.ndarray, "k"] | None = None) -> float:
        """What is allowed is 1; 0 where a finer mesh does not help: on an edge, or in a jam."""
        if errors.depths is None or not self._is_counted:
            return 0.0
        depths = np.max(np.asarray(errors.depths), axis=-1)
        most = float(np.max(depths if converged is None else depths[converged], initial=0.0)) / MOST_PENETRATION
        if self._last is not None and min(most, self._last[1]) > 1:
            coarser, before = self._last
            self._is_counted = most < before * (coarser / segments) ** LEAST_ORDER
        self._last = segments, most
        return most if self._is_counted else 0.0
