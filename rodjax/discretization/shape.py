"""What a solve starts from and ends in: the nodes, and the unknowns of its discretization."""

from abc import abstractmethod
from typing import Any, Self

import equinox as eqx
from jaxtyping import Array, Float

from rodjax.discretization.form import Form


class Shape(eqx.Module):
    """A centerline in nondimensional units, to the last bit."""

    nodes: eqx.AbstractVar[Float[Array, "n+1 3"]]

    @abstractmethod
    def point(self, end_force: Float[Array, "3 parts"], total_twist: Float[Array, ""]) -> Any:
        """The unknowns of its form, with these."""

    @abstractmethod
    def with_unknowns(self, point: Any) -> Self:
        """With the tangents or frames of a point of its form."""

    @abstractmethod
    def points(self, pieces: int) -> Float[Array, "k 3"]:
        """`pieces` + 1 equally spaced points of it."""

    @abstractmethod
    def in_units(self, scale: Float[Array, ""], shift: Float[Array, "3"]) -> Self:
        """Scaled, then shifted."""

    @abstractmethod
    def reached(self, form: Form, point: Any) -> Self:
        """The shape of a solution."""

    @abstractmethod
    def change_to(self, other: Any) -> Float[Array, ""]:
        """Largest difference to another of its kind, as a part of the length that it belongs to."""

    @abstractmethod
    def extrapolated(self, older: Any, ratio: Float[Array, ""]) -> Self:
        """From an older one of its kind through this one, on by so much of the way between, as far as tangents go."""
