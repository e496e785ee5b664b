"""Equilibrium equations linearised at a point, as a branch of equilibria is followed by them: of a rod or a harness.

Motions (changes of an equilibrium) and residuals are trees of arrays of one structure; the work of a residual in a
motion is the sum of the products of their numbers.
"""

from abc import abstractmethod
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Inverse iterations for the motion whose stiffness is nearest to zero: where it is near, one gains six digits.
INVERSE_ITERATIONS = 4


class MotionMetric(Protocol):
    """A scalar product of motions."""

    def inner(self, motion: Any, other: Any) -> Float[Array, ""]: ...

    def times(self, motion: Any) -> Any:
        """The residual whose work in any other motion is the inner product with it."""
        ...


class PlaceFactors(Protocol):
    """The factors of a linearised system that is regular."""

    @property
    def negative(self) -> Int[Array, ""]:
        """The number of negative eigenvalues under the constraints."""
        ...

    def solve(self, residual: Any) -> Any: ...


class Place(eqx.Module):
    """A point, and the equilibrium equations linearised there: their `residual`."""

    @property
    @abstractmethod
    def kept(self) -> Any:
        """What a loop has to keep of it, with the parameter and the point."""

    @property
    @abstractmethod
    def residual(self) -> Any: ...

    @property
    @abstractmethod
    def magnitude(self) -> Float[Array, ""]:
        """The largest component of the gradient, as results tell it [EI/L^2]."""

    @property
    @abstractmethod
    def is_balanced(self) -> Bool[Array, ""]: ...

    @property
    @abstractmethod
    def metric(self) -> MotionMetric: ...

    @property
    @abstractmethod
    def generic(self) -> Any:
        """A motion along no other."""

    @property
    def has_symmetry(self) -> bool:
        """Whether the linearised system is symmetric: else `transposed` has its transpose."""
        return True

    def transposed(self) -> "Place":
        return self

    @abstractmethod
    def neutral(self) -> Any:
        """The turn of the whole that leaves it in equilibrium, of length 1, or no motion."""

    @abstractmethod
    def times(self, motion: Any) -> Any:
        """The change of the residual in a motion."""

    @abstractmethod
    def regularized(self, neutral: Any) -> PlaceFactors:
        """The factors, with a spring against the neutral motion."""

    @abstractmethod
    def components(self, direction: Any) -> Any:
        """The motion of a direction in global axes, as `direction_of` the problem gives it."""

    @abstractmethod
    def work_share(self, motion: Any) -> Float[Array, ""]:
        """What the change with the parameter does in a motion of length 1, as a part of the most that one of its size
        could.
        """


def work(motion: Any, residual: Any) -> Float[Array, ""]:
    """Of a residual in a motion."""
    products = jax.tree.map(lambda x, y: jnp.sum(x * y), motion, residual)
    return jax.tree.reduce(jnp.add, products)


def added(motion: Any, other: Any, share: Float[Array, ""]) -> Any:
    return jax.tree.map(lambda x, y: x + share * y, motion, other)


def scaled(motion: Any, factor: Float[Array, ""]) -> Any:
    return jax.tree.map(lambda x: factor * x, motion)


def less(motion: Any, other: Any, metric: MotionMetric) -> Any:
    """The part at right angles to another motion of length 1, or to none."""
    return added(motion, other, -metric.inner(motion, other))


def nearest_to_zero(place: Place, neutral: Any, others: tuple[Any, ...] = ()) -> tuple[Float[Array, ""], Any]:
    """The eigenvalue [EI/L^2] nearest to zero and its motion, of length 1, at right angles to the others."""
    metric, factors = place.metric, place.regularized(neutral)

    def unit(motion: Any) -> Any:
        for other in (neutral, *others):
            motion = less(motion, other, metric)
        size = jnp.sqrt(metric.inner(motion, motion))
        return jax.tree.map(lambda x: x / size, motion)

    def closer(_, motion: Any) -> Any:
        return unit(factors.solve(metric.times(motion)))

    motion = jax.lax.fori_loop(0, INVERSE_ITERATIONS, closer, unit(place.generic))
    return work(motion, place.times(motion)), motion


def left_of(place: Place, neutral: Any, motion: Any, others: tuple[Any, ...] = ()) -> Any:
    """The left eigenvector to the eigenvalue nearest to zero, whose motion is given: the same where the system has
    symmetry, else on its side.
    """
    if place.has_symmetry:
        return motion
    left = nearest_to_zero(place.transposed(), neutral, others)[1]
    return scaled(left, jnp.sign(place.metric.inner(left, motion)))
